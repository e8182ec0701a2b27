//! A write to a slot of a BACnet priority array, and the entry that it leaves there. Pure.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use super::Origin;
use drivegate_model::drive::{ModelPoint, Value};

/// A point that is commanded by priorities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Commanded {
    /// The array of the run command.
    Run,
    /// The array of the direction.
    Reverse,
    /// The array of the speed reference.
    SpeedReference,
    /// The array of the frequency reference.
    FrequencyReference,
}

impl Commanded {
    /// All points with a priority array.
    pub const ALL: [Commanded; 4] = [
        Commanded::Run,
        Commanded::Reverse,
        Commanded::SpeedReference,
        Commanded::FrequencyReference,
    ];

    /// The point of the common model.
    pub fn point(self) -> ModelPoint {
        match self {
            Commanded::Run => ModelPoint::Run,
            Commanded::Reverse => ModelPoint::Reverse,
            Commanded::SpeedReference => ModelPoint::SpeedReference,
            Commanded::FrequencyReference => ModelPoint::FrequencyReference,
        }
    }

    /// Points that count as one to the drive: both references do.
    pub(crate) fn together(self) -> &'static [Commanded] {
        match self {
            Commanded::Run => &[Commanded::Run],
            Commanded::Reverse => &[Commanded::Reverse],
            Commanded::SpeedReference | Commanded::FrequencyReference => {
                &[Commanded::SpeedReference, Commanded::FrequencyReference]
            }
        }
    }
}

/// The entry in a slot of a priority array.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The value, in the unit of the point.
    pub value: Value,
    /// The client that wrote the entry.
    pub origin: Origin,
    /// When the entry was written.
    pub at: Instant,
    pub(crate) number: u64,
}

impl Entry {
    /// An entry written by this client.
    pub fn new(value: Value, origin: Origin, at: Instant) -> Entry {
        Entry {
            value,
            origin,
            at,
            number: number(),
        }
    }
}

/// A new number for a write; a later write has a greater number.
fn number() -> u64 {
    static LAST: AtomicU64 = AtomicU64::new(1);
    LAST.fetch_add(1, Ordering::Relaxed)
}

/// A write to a slot of a priority array. The resulting order carries it, so that both are accepted together.
#[derive(Debug, Clone, PartialEq)]
pub struct SlotWrite {
    /// Number that identifies the write.
    pub id: u64,
    /// Point of the priority array.
    pub what: Commanded,
    /// 1..=16.
    pub priority: u8,
    /// The new entry; `None` releases the slot.
    pub entry: Option<Entry>,
    /// Slots that this write also releases: the commands of their owners were refused when they became effective.
    pub released_too: Vec<(Commanded, u8)>,
    /// The entry that is planned to govern as a result.
    pub(crate) heir: Option<u64>,
}

impl SlotWrite {
    /// A write that was not made yet.
    pub fn new(what: Commanded, priority: u8, entry: Option<Entry>) -> SlotWrite {
        SlotWrite {
            id: number(),
            what,
            priority,
            entry,
            released_too: Vec::new(),
            heir: None,
        }
    }

    /// Plans the write; `entry` is the entry that governs afterwards.
    pub fn governed_by(mut self, entry: &Entry) -> SlotWrite {
        self.heir = Some(entry.number);
        self
    }
}
