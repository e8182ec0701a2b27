//! A drive family as data: its points, their addresses and scales, and what the drive permits. `profile_file` reads
//! the files and lists the built-in ones.

mod raw;

use crate::drive::{PerPoint, PointIndex};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use super::commissioning::Commissioning;
use super::control::{Always, Control, ControlItem, OwnWord, Reset, Run, Setting};
use super::derive::Derived;
use super::model::{Kind, ModelPoint, Value};
use super::parameters::ParameterList;
use crate::document::{Node, Problem};
use drivegate_proto::{N2Options, Protocol, RequestPdu, Table};

pub use raw::{Equals, Form, MOST_REGISTERS, Order, Part, Raw};

/// A validated profile.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Name in configurations.
    pub name: String,
    /// Title of the family, in one row.
    pub title: String,
    /// Manual and tables the profile is based on.
    pub source: String,
    /// Whether the profile is built into the program; otherwise it came from a file.
    pub built_in: bool,
    /// The base profile of this profile's file.
    pub base: Option<String>,
    /// Protocols of the family.
    pub protocols: Vec<Protocol>,
    /// Baud rates of the family; empty if any is possible.
    pub bauds: Vec<u32>,
    /// Character formats of the family, such as `8N1`, the usual one first; empty if any is possible.
    pub formats: Vec<String>,
    /// Addresses a drive can have.
    pub addresses: RangeInclusive<u8>,
    /// Time that a drive takes to begin its reply; used only for the prediction.
    pub turnaround: Duration,
    /// Update period of the drive's process data; a reset pulse lasts two of these.
    pub update_period: Duration,
    /// Time after an acknowledged command within which a read must show the command's effect.
    pub confirm_within: Duration,
    /// Function 04 reads the same registers as function 03.
    pub input_is_holding: bool,
    /// Reads that identify the family, for `scan`.
    pub identify: Vec<Expected>,
    /// What drives of the family call themselves (function 43/14): vendor and beginning of the product, such as `WEG CFW500`.
    pub nameplates: Vec<String>,
    /// N2 options of the family.
    pub n2: N2Options,
    /// Name of the simulated drive that behaves like the family.
    pub simulator: Option<String>,
    /// Address ranges in ascending order, each with its limits per request.
    pub ranges: Vec<AddressRange>,
    /// The functions by which single items and bits are written.
    pub functions: WriteFunctions,
    /// All points in the order of the file.
    pub points: PerPoint<Point>,
    /// Whether the drive counts received messages, damaged or not, and reports them by function 08 (subfunctions 0B to
    /// 0F).
    pub counts_messages: bool,
    /// Whether the drive may stop by itself when its master goes silent, while no readable point shows whether it does.
    pub may_stop_by_itself: bool,
    /// Whether a broadcast that clears the whole control word stops every drive of the family on the line.
    pub broadcast_stop: bool,
    /// Points that are read at once when a drive has a new fault.
    pub on_fault: Vec<PointIndex>,
    /// How the drive is commanded, where its profile has `[control]`.
    pub control: Option<Control>,
    /// Whether the profile was confirmed on hardware, or made from the manuals of this very family.
    pub verified: bool,
    /// Parameters of the family.
    pub parameters: ParameterList,
    /// Texts of fault codes.
    pub faults: BTreeMap<u16, FaultText>,
    /// Fault codes that mean that the drive's own timeout tripped it.
    pub timeout_faults: Vec<u16>,
    /// Lines for the engineer at the cabinet.
    pub commissioning: Commissioning,
    /// The meaning of a match of the `identify` reads; empty if they prove the family.
    pub identified: String,
    /// Index of each model point in `points`.
    pub(super) model: Vec<Option<PointIndex>>,
    /// The text of the profile's file, without the text of its base.
    pub text: Cow<'static, str>,
    /// The file merged with its base, for profiles based on this one. `None` for built-in profiles: their texts
    /// contain everything in a fifth of the memory.
    pub(super) tree: Option<Node>,
    /// Warnings about probable mistakes; empty for built-in profiles.
    pub warnings: Vec<Problem>,
}

/// Text of a fault code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FaultText {
    /// The text of the fault.
    pub text: String,
    /// The text shown on the drive's panel; empty if no available manual gives it.
    pub panel: String,
    /// Cause of the fault; empty if no available manual gives it.
    pub cause: String,
    /// Remedy for the fault; empty if no available manual gives it.
    pub remedy: String,
    /// Whether an available manual confirms the text.
    pub verified: bool,
}

/// Addresses of one table that may be read or written together.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AddressRange {
    /// Modbus table of the range.
    pub table: Table,
    /// First and last PDU address.
    pub addresses: RangeInclusive<u16>,
    /// Maximum items per read request.
    pub read: u16,
    /// Items per read request that no manual states: such a read is tried, and used once a reply has proved it; 0
    /// means none.
    pub try_read: u16,
    /// Items per write request; 0 is read-only.
    pub write: u16,
    /// A read may cover addresses between two points that no point names.
    pub holes: bool,
    /// A note about when the drive accepts a write; empty if the manual does not state it.
    pub write_when: String,
    /// Note for the user.
    pub note: String,
}

/// The functions that write to a family, where several are possible.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WriteFunctions {
    /// Whether a register is written by function 16, the only one that the drive takes.
    pub registers_by_16: bool,
    /// Whether a coil is written by function 15.
    pub coils_by_15: bool,
    /// Bits of a register by function 22.
    pub mask_write: bool,
}

impl WriteFunctions {
    /// The write of one register.
    pub fn write_register(self, address: u16, value: u16) -> RequestPdu {
        match self.registers_by_16 {
            true => RequestPdu::WriteRegisters {
                start: address,
                values: vec![value],
            },
            false => RequestPdu::WriteRegister { address, value },
        }
    }

    /// The write of one coil.
    pub fn write_coil(self, address: u16, on: bool) -> RequestPdu {
        match self.coils_by_15 {
            true => RequestPdu::WriteCoils {
                start: address,
                bits: vec![on],
            },
            false => RequestPdu::WriteCoil { address, on },
        }
    }

    /// Differences from other drives, as text; empty if there are none.
    pub fn notes(self) -> Vec<&'static str> {
        let notes = [
            (self.registers_by_16, "one register is written by function 16"),
            (self.coils_by_15, "one coil is written by function 15"),
            (
                self.mask_write,
                "bits of a settings register are written by function 22",
            ),
        ];
        notes.into_iter().filter_map(|(is, text)| is.then_some(text)).collect()
    }
}

/// A read whose outcome differs between families; identification never writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Probe {
    /// Modbus table of the probe.
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// Number of registers or bits.
    pub count: u16,
}

/// How a family responds to a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Expected {
    /// The read that identifies the family.
    pub probe: Probe,
    /// Whether the read is answered with values; otherwise it is refused.
    pub values: bool,
}

impl Probe {
    /// The request to send.
    pub fn pdu(&self) -> RequestPdu {
        RequestPdu::Read {
            table: self.table,
            start: self.start,
            count: self.count,
        }
    }
}

/// How often a point is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum PollClass {
    /// Process data, read every `cycle`.
    Fast,
    /// Polled every `slow_cycle`.
    Slow,
    /// Read only when the drive comes online.
    Once,
    /// Read once after a new fault; see [`Profile::on_fault`].
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
    pub(super) fn of_model(model: ModelPoint, source: Source) -> Point {
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

impl Profile {
    /// Index of a model point.
    pub fn model_index(&self, point: ModelPoint) -> Option<PointIndex> {
        self.model.get(point.index()).copied().flatten()
    }

    /// The point with this meaning in the common model.
    pub fn model_point(&self, point: ModelPoint) -> Option<&Point> {
        self.model_index(point).and_then(|i| self.points.get(i))
    }

    /// The points with their own registers from which a point is read or derived.
    pub fn raw_points_of(&self, point: PointIndex) -> Vec<PointIndex> {
        match self.points.get(point).map(|point| &point.source) {
            Some(Source::Derived(derived)) => {
                let of = derived.rests_on();
                of.into_iter().flat_map(|of| self.raw_points_of(of)).collect()
            }
            Some(Source::Raw(raw)) => std::iter::once(point).chain(raw.scaled_by()).collect(),
            None => Vec::new(),
        }
    }

    /// The profile with its `fast_if_carried` points in the fast class; `None` if it has none.
    pub fn with_faster_points(&self) -> Option<Profile> {
        if !self.points.iter().any(|point| point.fast_if_carried) {
            return None;
        }
        let mut faster = self.clone();
        for point in faster.points.iter_mut().filter(|point| point.fast_if_carried) {
            point.class = PollClass::Fast;
        }
        Some(faster)
    }

    /// Index of the point of that name.
    pub fn point_index(&self, name: &str) -> Option<PointIndex> {
        self.points.position(|p| p.name == name)
    }

    /// The range that contains `address`.
    pub fn range(&self, table: Table, address: u16) -> Option<&AddressRange> {
        self.ranges
            .iter()
            .find(|r| r.table == table && r.addresses.contains(&address))
    }

    /// The table that a read of `table` addresses in this family.
    pub fn canonical(&self, table: Table) -> Table {
        if table == Table::Input && self.input_is_holding {
            Table::Holding
        } else {
            table
        }
    }

    /// The title for display, including any doubt about the profile.
    pub fn described(&self) -> Cow<'_, str> {
        match self.verified {
            true => Cow::Borrowed(&self.title),
            false => Cow::Owned(
                format!("{} (not verified on hardware)", self.title)
                    .trim_start()
                    .to_string(),
            ),
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

    /// The `[control]` table; `None` if points of one bit each define the commands.
    pub fn control_table(&self) -> Option<&Control> {
        self.control
            .as_ref()
            .filter(|control| control.own_word != OwnWord::Kept)
    }

    /// The `[control]` table equivalent to commands that are points of one bit each.
    pub(super) fn control_of_bits(&self) -> Option<Control> {
        let setting = |point: ModelPoint, on: bool| {
            // A run command that no one may give is still recognised as one.
            let is_used = |of: &&Point| of.write || point == ModelPoint::Run;
            let read = self.model_point(point).filter(is_used)?;
            let written = read.write_to.and_then(|to| self.points.get(to));
            let raw = written.unwrap_or(read).raw()?;
            let (bit, invert) = match raw.form {
                Form::Bit { bit, invert } if bit < 16 => (bit, invert),
                _ => return None,
            };
            Some(Setting {
                place: Some(ControlItem::of(raw)),
                mask: 1 << bit,
                value: u16::from(on != invert) << bit,
                once: false,
            })
        };
        let run = setting(ModelPoint::Run, true)?;
        let at = run.place?;
        // A setting within the control word has no separate register.
        let within = |setting: Setting| Setting {
            place: setting.place.filter(|place| *place != at),
            ..setting
        };
        let reset = setting(ModelPoint::FaultReset, true).map(within);
        Some(Control {
            at,
            own_word: OwnWord::Kept,
            always: Always::default(),
            run: Run::One(within(run)),
            stop: within(setting(ModelPoint::Run, false)?),
            also_stop: Vec::new(),
            reverse: setting(ModelPoint::Reverse, true).map(within),
            fault_reset: reset.map(|setting| Reset {
                setting,
                pulse: 2 * self.update_period,
                verified: true,
            }),
            restarts_on_reset: false,
            refresh: None,
            refresh_with_reference: false,
        })
    }

    /// The register to which the run command is written; also read there if the drive allows it.
    pub fn run_place(&self) -> Option<ControlItem> {
        let control = self.control.as_ref().map(Control::run_place);
        control.or_else(|| self.model_point(ModelPoint::Run)?.raw().map(ControlItem::of))
    }

    /// Whether this word, written to this register, is a run command or a stop; `None` if neither.
    pub fn runs_by(&self, table: Table, address: u16, word: u16) -> Option<bool> {
        let (control, place) = (self.control.as_ref()?, ControlItem { table, address });
        let run = control.is_run(place, word).then_some(true);
        run.or(control.is_stop(place, word).then_some(false))
    }

    /// Whether a write of these items is skipped if the drive already has the values, because it stores them in
    /// EEPROM with limited write cycles. On N2 this includes addresses without a point, but never a stop or a
    /// pulse.
    pub fn writes_on_change(&self, table: Table, items: &[(u16, u16)]) -> bool {
        let spared = |address: u16| {
            let covers = |p: &&Point| p.write && p.raw().is_some_and(|raw| raw.covers(table, address));
            let mut points = self.points.iter().filter(covers).peekable();
            match points.peek() {
                Some(_) => points.all(|p| p.on_change),
                None => self.protocols.contains(&Protocol::N2),
            }
        };
        let stops = |(address, value): &(u16, u16)| self.is_stop(table, *address, *value);
        items.iter().all(|(address, _)| spared(*address)) && !items.iter().any(stops)
    }

    /// Whether a register holds settings besides a bit: not the register of the run command, whose other bits no one
    /// else changes unnoticed.
    pub fn is_settings(&self, table: Table, address: u16) -> bool {
        let is_run = self.run_place() == Some(ControlItem { table, address });
        table == Table::Holding && !self.protocols.contains(&Protocol::N2) && !is_run
    }

    /// Whether a write to that table is released afterwards: an analog output of N2.
    pub fn releases(&self, table: Table) -> bool {
        table == Table::Holding && self.n2.release && self.protocols.contains(&Protocol::N2)
    }

    /// The write that stops every drive of the family on a line when it is broadcast: it clears the whole control
    /// word. `None` if the family has no such write.
    pub fn broadcast_stop(&self) -> Option<RequestPdu> {
        let run = self.run_place().filter(|_| self.broadcast_stop)?;
        let pdu = match run.table {
            Table::Coil => self.functions.write_coil(run.address, false),
            Table::Holding => self.functions.write_register(run.address, 0),
            Table::DiscreteInput | Table::Input => return None,
        };
        self.is_stop(run.table, run.address, 0).then_some(pdu)
    }

    /// Whether writing `value` to that register (or coil) clears the run command: a stop.
    pub fn is_stop(&self, table: Table, address: u16, value: u16) -> bool {
        let place = ControlItem { table, address };
        self.control
            .as_ref()
            .is_some_and(|control| control.is_stop(place, value))
    }
}

/// The profiles of an installation by name: built-in ones and the user's.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Profiles(BTreeMap<String, Arc<Profile>>);

impl Profiles {
    /// Adds a profile; replaces an existing one with the same name.
    pub(crate) fn insert(&mut self, profile: Profile) {
        self.0.insert(profile.name.clone(), Arc::new(profile));
    }

    /// The warnings about all profiles.
    pub fn warnings(&self) -> impl Iterator<Item = &Problem> {
        self.0.values().flat_map(|profile| &profile.warnings)
    }

    /// The profile with this name.
    pub fn get(&self, name: &str) -> Option<&Arc<Profile>> {
        self.0.get(name)
    }

    /// All profiles, sorted by name.
    pub fn iter(&self) -> impl Iterator<Item = &Arc<Profile>> {
        self.0.values()
    }

    /// Names of all profiles.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }
}
