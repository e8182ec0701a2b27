//! A drive family as data: its points, their addresses and scales, and what the drive permits. `profile_file` reads
//! the files and lists the built-in ones.

mod commands;
mod point;
mod raw;

use crate::drive::{PerPoint, PointIndex};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use super::commissioning::Commissioning;
use super::control::Control;
use super::model::ModelPoint;
use super::parameters::ParameterList;
use crate::document::{Node, Problem};
use drivegate_proto::{N2Options, Protocol, RequestPdu, Table};

pub use point::{Blocks, Point, PollClass, Source};
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
        if self.registers_by_16 {
            RequestPdu::WriteRegisters {
                start: address,
                values: vec![value],
            }
        } else {
            RequestPdu::WriteRegister { address, value }
        }
    }

    /// The write of one coil.
    pub fn write_coil(self, address: u16, on: bool) -> RequestPdu {
        if self.coils_by_15 {
            RequestPdu::WriteCoils {
                start: address,
                bits: vec![on],
            }
        } else {
            RequestPdu::WriteCoil { address, on }
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
        if self.verified {
            Cow::Borrowed(&self.title)
        } else {
            Cow::Owned(
                format!("{} (not verified on hardware)", self.title)
                    .trim_start()
                    .to_string(),
            )
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
