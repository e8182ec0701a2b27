//! A drive family as data: its points, where they lie, their scales, and what the drive allows.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use super::model::{Kind, ModelPoint, Value};
use crate::codec::{Protocol, Table};

/// A validated profile.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Name in configurations.
    pub name: String,
    /// One line for people.
    pub title: String,
    /// Manual and tables the profile rests on.
    pub source: String,
    /// Whether the profile is part of the program; else it came from a file.
    pub built_in: bool,
    /// Protocols the family speaks.
    pub protocols: Vec<Protocol>,
    /// Baud rates of the family; empty when any will do.
    pub bauds: Vec<u32>,
    /// Addresses a drive can have.
    pub addresses: RangeInclusive<u8>,
    /// Time a drive takes to begin its answer, for the prediction only.
    pub turnaround: Duration,
    /// Period at which the drive takes over its process data; a reset pulse is held for two of them.
    pub update_period: Duration,
    /// Time after an acknowledged command within which a read must show its effect.
    pub confirm_within: Duration,
    /// Function 04 reads the same registers as function 03.
    pub input_is_holding: bool,
    /// Name of the behaviour that a simulated drive of this profile has.
    pub simulator: Option<String>,
    /// Address ranges with their limits per request, ascending.
    pub ranges: Vec<AddressRange>,
    /// All points, in the order of the file.
    pub points: Vec<Point>,
    /// Texts of fault codes.
    pub faults: BTreeMap<u16, FaultText>,
    /// Index of each model point in `points`.
    pub(super) model: Vec<Option<usize>>,
}

/// Text of a fault code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FaultText {
    /// What the fault is.
    pub text: String,
    /// Whether a manual at hand says so.
    pub verified: bool,
}

/// Addresses of one table that may be read or written together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AddressRange {
    /// Table.
    pub table: Table,
    /// First and last PDU address.
    pub addresses: RangeInclusive<u16>,
    /// Items per read request.
    pub read: u16,
    /// Items per write request; 0 is read-only.
    pub write: u16,
    /// A read may cover addresses between two points that no point names.
    pub holes: bool,
    /// For people.
    pub note: String,
}

/// How often a point is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum PollClass {
    /// Process data, every `cycle`.
    Fast,
    /// Every `slow_cycle`.
    Slow,
    /// When the drive comes online.
    Once,
    /// Never by itself.
    Never,
}

impl PollClass {
    /// The name in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            PollClass::Fast => "fast",
            PollClass::Slow => "slow",
            PollClass::Once => "once",
            PollClass::Never => "never",
        }
    }
}

/// One named value of a drive.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Public name.
    pub name: String,
    /// The point of the common model that it is.
    pub model: Option<ModelPoint>,
    /// Unit, empty for states and codes.
    pub unit: String,
    /// Where the value comes from.
    pub source: Source,
    /// How often it is read.
    pub class: PollClass,
    /// Whether it can be commanded.
    pub write: bool,
    /// Written as a pulse 0, 1, 0.
    pub pulse: bool,
    /// Range of commands in engineering units.
    pub range: Option<RangeInclusive<f64>>,
    /// Whether a manual at hand confirms the address.
    pub verified: bool,
    /// For people.
    pub note: String,
}

/// Where a value comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum Source {
    /// From registers or bits of the drive.
    Raw(Raw),
    /// A percentage of the band between two other points: `min + of / 100 * (max - min)`.
    Band {
        /// Point in percent.
        of: usize,
        /// Point at 0 %.
        minimum: usize,
        /// Point at 100 %.
        maximum: usize,
    },
}

/// Place and form of a raw value.
#[derive(Debug, Clone, PartialEq)]
pub struct Raw {
    /// Table.
    pub table: Table,
    /// First PDU address.
    pub address: u16,
    /// Form.
    pub form: Form,
    /// Engineering value of one count.
    pub scale: f64,
    /// Engineering value of raw 0.
    pub offset: f64,
}

/// Form of a raw value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// One bit of a register (0 = least significant), or the bit itself in a bit table.
    Bit {
        /// Number of the bit.
        bit: u8,
        /// 0 means true.
        invert: bool,
    },
    /// Unsigned 16 bit.
    U16,
    /// Signed 16 bit, two's complement.
    I16,
}

impl Form {
    /// Registers or bits that the value takes.
    pub fn items(self) -> u16 {
        1
    }
}

/// Why a value cannot be written to a point.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Unwritable {
    /// The value does not fit the type of the register.
    #[error("{value} does not fit the register, which holds {least} to {most}")]
    Type {
        /// Value asked for.
        value: f64,
        /// Least value of the register in engineering units.
        least: f64,
        /// Greatest value of the register in engineering units.
        most: f64,
    },
}

impl Raw {
    /// The value in `words`, the registers (or bits as 0 and 1) from `address` on.
    pub fn decode(&self, words: &[u16], kind: Kind) -> Option<Value> {
        let &word = words.first()?;
        let count = match self.form {
            Form::Bit { bit, invert } => return Some(Value::Bool(((word >> bit) & 1 == 1) != invert)),
            Form::U16 => f64::from(word),
            Form::I16 => f64::from(word as i16),
        };
        if kind == Kind::Integer {
            return Some(Value::Integer(count as i64));
        }
        Some(Value::Number(tidy(count * self.scale + self.offset)))
    }

    /// The register that means `value`; a bit is merged into `old`.
    ///
    /// # Errors
    /// When the value does not fit the register's type. Nothing is clamped.
    pub fn encode(&self, value: Value, old: u16) -> Result<u16, Unwritable> {
        let (least, most) = match self.form {
            Form::Bit { bit, invert } => {
                let set = value.as_bool() != invert;
                return Ok(if set { old | (1 << bit) } else { old & !(1 << bit) });
            }
            Form::U16 => (0.0, f64::from(u16::MAX)),
            Form::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
        };
        let count = ((value.as_f64() - self.offset) / self.scale).round();
        if !(least..=most).contains(&count) {
            let unit = |c: f64| tidy(c * self.scale + self.offset);
            return Err(Unwritable::Type {
                value: value.as_f64(),
                least: unit(least),
                most: unit(most),
            });
        }
        Ok(count as i32 as u16)
    }
}

/// Takes the dust of binary fractions off a scaled count: 2500 * 0.01 is 25, not 25.000000000000004.
pub fn tidy(value: f64) -> f64 {
    let rounded = (value * 1e6).round() / 1e6;
    if rounded.is_finite() { rounded } else { value }
}

impl Point {
    /// Kind of its values.
    pub fn kind(&self) -> Kind {
        match (&self.source, self.model) {
            (
                Source::Raw(Raw {
                    form: Form::Bit { .. }, ..
                }),
                _,
            ) => Kind::Bool,
            (_, Some(model)) => model.kind(),
            _ => Kind::Number,
        }
    }

    /// Its raw source, if it has one.
    pub fn raw(&self) -> Option<&Raw> {
        match &self.source {
            Source::Raw(raw) => Some(raw),
            Source::Band { .. } => None,
        }
    }
}

impl Profile {
    /// Index of a model point.
    pub fn model_index(&self, point: ModelPoint) -> Option<usize> {
        self.model.get(point.index()).copied().flatten()
    }

    /// The point of the common model.
    pub fn model_point(&self, point: ModelPoint) -> Option<&Point> {
        self.model_index(point).and_then(|i| self.points.get(i))
    }

    /// Index of the point of that name.
    pub fn point_index(&self, name: &str) -> Option<usize> {
        self.points.iter().position(|p| p.name == name)
    }

    /// The range that holds `address`.
    pub fn range(&self, table: Table, address: u16) -> Option<&AddressRange> {
        self.ranges
            .iter()
            .find(|r| r.table == table && r.addresses.contains(&address))
    }

    /// The table that a read of `table` really means in this family.
    pub fn canonical(&self, table: Table) -> Table {
        if table == Table::Input && self.input_is_holding {
            Table::Holding
        } else {
            table
        }
    }

    /// Text of a fault code; a code without text is shown as a plain number.
    pub fn fault_text(&self, code: i64) -> String {
        let known = u16::try_from(code).ok().and_then(|c| self.faults.get(&c));
        match known {
            Some(fault) => fault.text.clone(),
            None if code == 0 => String::new(),
            None => code.to_string(),
        }
    }

    /// Where the run bit lies.
    pub fn run_bit(&self) -> Option<(&Raw, u8, bool)> {
        let raw = self.model_point(ModelPoint::Run)?.raw()?;
        match raw.form {
            Form::Bit { bit, invert } => Some((raw, bit, invert)),
            _ => None,
        }
    }

    /// Whether writing `value` to that register (or coil) takes the run command away: a stop.
    pub fn is_stop(&self, table: Table, address: u16, value: u16) -> bool {
        self.run_bit().is_some_and(|(raw, bit, invert)| {
            raw.table == table && raw.address == address && ((value >> bit) & 1 == 1) == invert
        })
    }
}

/// The profiles of an installation by name: built-in ones and the user's.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Profiles(BTreeMap<String, Arc<Profile>>);

impl Profiles {
    /// Adds a profile; one of the same name is replaced.
    pub fn insert(&mut self, profile: Profile) {
        self.0.insert(profile.name.clone(), Arc::new(profile));
    }

    /// The profile of that name.
    pub fn get(&self, name: &str) -> Option<&Arc<Profile>> {
        self.0.get(name)
    }

    /// All, by name.
    pub fn iter(&self) -> impl Iterator<Item = &Arc<Profile>> {
        self.0.values()
    }

    /// All names.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raw(form: Form, scale: f64) -> Raw {
        Raw {
            table: Table::Holding,
            address: 2002,
            form,
            scale,
            offset: 0.0,
        }
    }

    #[test]
    fn raw_to_engineering_and_back() {
        let reference = raw(Form::I16, 0.01);
        assert_eq!(reference.decode(&[5000], Kind::Number), Some(Value::Number(50.0)));
        assert_eq!(reference.decode(&[0xEC78], Kind::Number), Some(Value::Number(-50.0)));
        assert_eq!(reference.encode(Value::Number(-50.0), 0), Ok(0xEC78));
        assert_eq!(reference.encode(Value::Number(33.333), 0), Ok(3333));
        assert!(reference.encode(Value::Number(400.0), 0).is_err());
        assert!(reference.encode(Value::Number(f64::NAN), 0).is_err());
        assert_eq!(
            raw(Form::U16, 0.1).decode(&[12], Kind::Number),
            Some(Value::Number(1.2))
        );
        assert_eq!(raw(Form::U16, 1.0).decode(&[], Kind::Number), None);
    }

    #[test]
    fn bits_are_merged() {
        let run = raw(Form::Bit { bit: 0, invert: false }, 1.0);
        assert_eq!(run.encode(Value::Bool(true), 0x0102), Ok(0x0103));
        assert_eq!(run.encode(Value::Bool(false), 0x0103), Ok(0x0102));
        let inverted = raw(Form::Bit { bit: 8, invert: true }, 1.0);
        assert_eq!(inverted.decode(&[0x0100], Kind::Bool), Some(Value::Bool(false)));
        assert_eq!(inverted.encode(Value::Bool(true), 0xFFFF), Ok(0xFEFF));
    }
}
