//! A point of a profile: where its value comes from, how often it is read, what may be written.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use super::super::derive::Derived;
use super::super::model::{Kind, ModelPoint, Value};
use super::raw::{Form, Raw};
use crate::drive::PointIndex;

/// How often a point is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum PollClass {
    /// Process data, read every `cycle`.
    Fast,
    /// Polled every `slow_cycle`.
    Slow,
    /// Read only when the drive comes online.
    Once,
    /// Read once after a new fault; see [`super::Profile::on_fault`].
    Fault,
    /// Read when the drive comes online and when a comparison needs it; see [`Point::monitor`].
    Monitor,
    /// Never polled, only read on request.
    Never,
}

impl PollClass {
    /// The name of the class in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            PollClass::Fast => "fast",
            PollClass::Slow => "slow",
            PollClass::Once => "once",
            PollClass::Fault => "fault",
            PollClass::Monitor => "monitor",
            PollClass::Never => "never",
        }
    }
}

/// A named value of a drive.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Public name.
    pub name: String,
    /// The point of the common model that this point provides.
    pub model: Option<ModelPoint>,
    /// Unit, empty for states and codes.
    pub unit: String,
    /// Source of the value.
    pub source: Source,
    /// How often the point is read.
    pub class: PollClass,
    /// Whether this slow point is read in the fast class on lines that can carry it.
    pub fast_if_carried: bool,
    /// The point that always has the value which this point has only with a certain selector setting of the drive:
    /// the two are compared when the drive comes online.
    pub monitor: Option<PointIndex>,
    /// Whether the point can be commanded.
    pub write: bool,
    /// The point that receives the commands, in the same unit, if the drive reports the value elsewhere.
    pub write_to: Option<PointIndex>,
    /// Written as a pulse 0, 1, 0.
    pub pulse: bool,
    /// Whether the point is written only if the drive is not known to have the value already, because the value is stored
    /// in EEPROM with limited write cycles.
    pub on_change: bool,
    /// Range of commands in engineering units.
    pub range: Option<RangeInclusive<f64>>,
    /// Texts of the values of an enumeration.
    pub texts: BTreeMap<i64, String>,
    /// Whether the point takes other values than those of `texts`, too.
    pub unlisted: bool,
    /// A helper for other points that no server shows and that cannot be commanded.
    pub hidden: bool,
    /// A state of the point that keeps the motor from running.
    pub blocks: Option<Blocks>,
    /// Whether an available manual confirms the address.
    pub verified: bool,
    /// Note for the user.
    pub note: String,
}

/// A state of a point that keeps the motor from running.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Blocks {
    /// The cause in one word, for programs.
    pub cause: String,
    /// The state in which the point blocks the motor: true or not zero, or false.
    pub when: bool,
    /// The remedy for the block.
    pub remedy: String,
}

/// Source of a value.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// The value is in registers or bits of the drive.
    Raw(Raw),
    /// The point is derived from other points.
    Derived(Derived),
}

impl Point {
    /// A point of the common model that is derived, or that is never read as a separate value.
    pub(in crate::drive) fn of_model(model: ModelPoint, source: Source) -> Point {
        Point {
            name: model.name().to_string(),
            model: Some(model),
            unit: model.unit().to_string(),
            source,
            class: PollClass::Never,
            fast_if_carried: false,
            monitor: None,
            write: false,
            write_to: None,
            pulse: false,
            on_change: false,
            range: None,
            texts: BTreeMap::new(),
            unlisted: false,
            hidden: false,
            blocks: None,
            verified: true,
            note: String::new(),
        }
    }

    /// Whether users can command the point.
    pub fn is_commanded(&self) -> bool {
        self.write && !self.hidden
    }

    /// Whether polling provides the value: from its own registers, or derived from points that are polled.
    pub fn is_read(&self) -> bool {
        self.raw().is_none() || self.class != PollClass::Never
    }

    /// Kind of the point's values.
    pub fn kind(&self) -> Kind {
        use Derived::{All, Equal, LowestBit, State, Zero};
        match (&self.source, self.model) {
            (Source::Raw(raw), _) if raw.is_bool() => Kind::Bool,
            (Source::Raw(raw), _) if matches!(raw.form, Form::Text { .. }) => Kind::Text,
            (Source::Derived(Zero { .. } | Equal { .. } | All { .. } | State { .. }), _) => Kind::Bool,
            (_, Some(model)) => model.kind(),
            (Source::Derived(LowestBit { .. }), None) => Kind::Integer,
            (Source::Raw(raw), None) if raw.is_code() => Kind::Integer,
            _ if !self.texts.is_empty() => Kind::Integer,
            _ => Kind::Number,
        }
    }

    /// The text of an enumeration's value, or of a bit with texts.
    pub fn text_of(&self, value: Value) -> Option<&str> {
        let code = match value {
            Value::Integer(code) => code,
            Value::Bool(state) => i64::from(state),
            Value::Number(_) | Value::Unsigned(_) | Value::Text(_) => return None,
        };
        self.texts.get(&code).map(String::as_str)
    }

    /// The enumeration value with this text; `None` also if several values have it.
    pub fn code_of(&self, text: &str) -> Option<i64> {
        let mut codes = self.texts.iter().filter(|(_, meaning)| *meaning == text);
        let first = codes.next().map(|(code, _)| *code);
        first.filter(|_| codes.next().is_none())
    }

    /// The raw source of the point; `None` if it is derived.
    pub fn raw(&self) -> Option<&Raw> {
        match &self.source {
            Source::Raw(raw) => Some(raw),
            Source::Derived(_) => None,
        }
    }
}
