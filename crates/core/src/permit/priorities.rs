//! The priority arrays of a drive, for clients that command by priorities: only what they wrote and is still in
//! force. Pure.
//!
//! The slots order these clients among themselves: the occupied slot with the lowest number governs. A command from
//! any other interface has no slot; when it is accepted it withdraws the entries that it overrules, so that nothing
//! starts later by itself. The arrays are part of the gate of the bus, so that they and the commands have one order
//! of acceptance.

mod void;

use std::sync::Arc;
use std::time::Instant;

use crate::order::{Commanded, Effect, Entry, Origin, Outcome, SlotWrite, SourceKind};
use drivegate_model::drive::{ModelPoint, Value};

pub use void::VoidSlot;

/// Number of priorities of an array.
pub const PRIORITIES: usize = 16;
/// Priorities up to this one protect people and refuse commands from other interfaces.
pub const PROTECTING: u8 = 5;

/// The consequence of a write to a slot.
#[derive(Debug, Clone, PartialEq)]
pub enum Follows {
    /// No command follows: the entry does not govern, or the drive does not change.
    Nothing,
    /// The value for this point becomes an order of the client that wrote it.
    Order(Commanded, Box<Entry>),
    /// The last value of `run` is given back: a stop.
    Stop,
}

/// How a write to a slot ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Settled {
    /// The entry is in force at the drive.
    Done,
    /// The write was not carried out: the slot is unchanged.
    Failed,
    /// The effect on the drive is unknown until the next reading.
    Unknown,
}

impl Settled {
    /// The result of a write whose command had that outcome.
    pub fn of(outcome: &Outcome) -> Settled {
        match outcome {
            Outcome::Acknowledged(_) => Settled::Done,
            Outcome::TimedOut | Outcome::Garbled | Outcome::Interrupted(_) | Outcome::Unknown(_) => Settled::Unknown,
            Outcome::StopOnly(_) | Outcome::StopFailed(_) => Settled::Unknown,
            Outcome::Exception(_)
            | Outcome::Refused(_)
            | Outcome::Expired
            | Outcome::Replaced
            | Outcome::Purged
            | Outcome::Withdrawn
            | Outcome::NotTaken(_)
            | Outcome::NotStopped
            | Outcome::BusDown
            | Outcome::Offline
            | Outcome::QueueFull
            | Outcome::ShuttingDown => Settled::Failed,
        }
    }
}

/// A slot: the entry in force, and a requested one that is not settled.
#[derive(Debug, Clone, Default)]
struct Slot {
    stands: Option<Entry>,
    /// Number of the write that set the slot.
    by: u64,
    asked: Vec<(u64, Option<Entry>)>,
    /// An entry that may be in force, and since when.
    uncertain: Option<(Entry, Instant)>,
}

impl Slot {
    /// The effective entry: the last requested entry, or else the entry that is in force.
    fn counts(&self) -> Option<&Entry> {
        match self.asked.last() {
            Some((_, entry)) => entry.as_ref(),
            None => self.stands.as_ref(),
        }
    }

    fn clear_if(&mut self, is: impl Fn(&Entry) -> bool) {
        let gone = |entry: &mut Option<Entry>| {
            if entry.as_ref().is_some_and(&is) {
                *entry = None;
            }
        };
        gone(&mut self.stands);
        self.asked.iter_mut().for_each(|(_, entry)| gone(entry));
        if self.uncertain.as_ref().is_some_and(|(entry, _)| is(entry)) {
            self.uncertain = None;
        }
    }

    fn is_empty(&self) -> bool {
        self.stands.is_none() && self.asked.is_empty() && self.uncertain.is_none()
    }
}

/// The priority arrays of a drive.
#[derive(Debug, Clone, Default)]
struct Arrays([[Slot; PRIORITIES]; 4]);

/// The arrays of a drive, and the last commander.
#[derive(Debug, Clone, Default)]
pub struct Priorities {
    arrays: Option<Box<Arrays>>,
    /// Number of commands accepted so far.
    orders: u64,
    /// Origin and time of the last order.
    last: Option<(Origin, Instant)>,
}

/// Slot that blocks commands from other interfaces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Protects {
    /// The client that wrote the slot.
    pub client: String,
    /// Priority of the slot.
    pub priority: u8,
    /// The point that the slot blocks.
    pub what: ModelPoint,
}

impl Priorities {
    fn slot(&self, what: Commanded, priority: u8) -> Option<&Slot> {
        let arrays = self.arrays.as_ref()?;
        arrays.0.get(what as usize)?.get(usize::from(priority).checked_sub(1)?)
    }

    fn slot_mut(&mut self, what: Commanded, priority: u8) -> Option<&mut Slot> {
        let arrays = self.arrays.get_or_insert_default();
        arrays
            .0
            .get_mut(what as usize)?
            .get_mut(usize::from(priority).checked_sub(1)?)
    }

    fn slots_mut(&mut self) -> impl Iterator<Item = (Commanded, u8, &mut Slot)> {
        let arrays = self.arrays.iter_mut().flat_map(|arrays| arrays.0.iter_mut());
        Commanded::ALL
            .into_iter()
            .zip(arrays)
            .flat_map(|(what, array)| (1u8..).zip(array).map(move |(priority, slot)| (what, priority, slot)))
    }

    fn tidy(&mut self) {
        if self.slots_mut().all(|(.., slot)| slot.is_empty()) {
            self.arrays = None;
        }
    }

    /// Number of commands accepted so far.
    pub fn orders(&self) -> u64 {
        self.orders
    }

    /// Origin and time of the last order.
    pub fn last(&self) -> Option<&(Origin, Instant)> {
        self.last.as_ref()
    }

    /// The entry in force in a slot.
    pub fn entry(&self, what: Commanded, priority: u8) -> Option<&Entry> {
        self.slot(what, priority)?.stands.as_ref()
    }

    /// The governing slot, if it belongs to the array of this point.
    pub fn shown(&self, what: Commanded) -> Option<(u8, &Entry)> {
        let (of, priority, entry) = self.lowest(what, |slot| slot.stands.as_ref())?;
        (of == what).then_some((priority, entry))
    }

    /// The governing slot for this point, among all points that mean one thing to the drive, by the entries in force.
    pub fn governing(&self, what: Commanded) -> Option<(Commanded, u8, &Entry)> {
        self.lowest(what, |slot| slot.stands.as_ref())
    }

    fn counting(&self, what: Commanded) -> Option<(Commanded, u8, &Entry)> {
        self.lowest(what, Slot::counts)
    }

    /// The lowest occupied slot among points that count as one; at equal priority the later.
    fn lowest<'a>(
        &'a self,
        what: Commanded,
        entry: impl Fn(&'a Slot) -> Option<&'a Entry>,
    ) -> Option<(Commanded, u8, &'a Entry)> {
        let arrays = self.arrays.as_ref()?;
        let of = |what: &Commanded| {
            let slots = arrays.0.get(*what as usize)?;
            let mut occupied = (1u8..)
                .zip(slots)
                .filter_map(|(priority, slot)| Some((priority, entry(slot)?)));
            let (priority, entry) = occupied.next()?;
            Some((*what, priority, entry))
        };
        let all = what.together().iter().filter_map(of);
        all.min_by_key(|(_, priority, entry)| (*priority, u64::MAX - entry.number))
    }

    /// The consequence of a write, if accepted now.
    pub fn plan(&self, write: &SlotWrite) -> Follows {
        let mut after = self.clone();
        let before = after.counting(write.what).map(|(what, priority, _)| (what, priority));
        let was_empty = after.slot(write.what, write.priority).and_then(Slot::counts).is_none();
        after.ask(write);
        let own = (write.what, write.priority);
        match (&write.entry, after.counting(write.what)) {
            (Some(entry), Some((what, priority, _))) if (what, priority) == own => {
                Follows::Order(what, Box::new(entry.clone()))
            }
            (Some(_), _) => Follows::Nothing,
            (None, _) if was_empty || before != Some(own) => Follows::Nothing,
            (None, Some((what, _, next))) => Follows::Order(what, Box::new(next.clone())),
            (None, None) if write.what == Commanded::Run => Follows::Stop,
            (None, None) => Follows::Nothing,
        }
    }

    /// Whether the planned order still follows from a write: another interface may have withdrawn its slot since.
    pub(crate) fn still_follows(&self, write: &SlotWrite) -> bool {
        match self.plan(write) {
            Follows::Order(_, entry) => write.heir.is_none_or(|heir| heir == entry.number),
            Follows::Nothing | Follows::Stop => false,
        }
    }

    /// Whether a write to a slot of `run` is a stop: an inactive that governs, or a slot given back to no active.
    pub fn stops(&self, priority: u8, value: Option<bool>) -> bool {
        let below = |(_, governs, _): (Commanded, u8, &Entry)| governs < priority;
        match value {
            Some(true) => false,
            Some(false) => !self.counting(Commanded::Run).is_some_and(below),
            None => match self.plan(&SlotWrite::new(Commanded::Run, priority, None)) {
                Follows::Order(_, entry) => !entry.value.as_bool(),
                Follows::Nothing | Follows::Stop => true,
            },
        }
    }

    /// The slot that governs after a write, if it is not the written one.
    pub fn successor(&self, write: &SlotWrite) -> Option<(Commanded, u8)> {
        let mut after = self.clone();
        after.ask(write);
        let (what, priority, _) = after.counting(write.what)?;
        Some((what, priority)).filter(|next| *next != (write.what, write.priority))
    }

    /// Accepts a write; [`Priorities::settle`] takes its result.
    pub fn ask(&mut self, write: &SlotWrite) {
        if let Some(slot) = self.slot_mut(write.what, write.priority) {
            slot.asked.push((write.id, write.entry.clone()));
        }
        for (what, priority) in &write.released_too {
            if let Some(slot) = self.slot_mut(*what, *priority) {
                slot.asked.push((write.id, None));
            }
        }
    }

    /// Sets how an accepted write ended, at `now`.
    pub fn settle(&mut self, id: u64, settled: Settled, now: Instant) {
        for (.., slot) in self.slots_mut() {
            let Some(place) = slot.asked.iter().position(|(asked, _)| *asked == id) else {
                continue;
            };
            let (_, entry) = slot.asked.remove(place);
            // The later of two writes counts, whichever is answered first.
            if id < slot.by {
                continue;
            }
            match settled {
                Settled::Failed => {}
                Settled::Done => (slot.stands, slot.uncertain, slot.by) = (entry, None, id),
                Settled::Unknown => {
                    slot.stands = None;
                    slot.uncertain = entry.map(|entry| (entry, now));
                    slot.by = id;
                }
            }
        }
        self.tidy();
    }

    /// Settles uncertain entries by readings: `reads` gives a value read since the given time, if there is one.
    pub fn resolve(&mut self, reads: impl Fn(Commanded, Instant) -> Option<Value>) {
        for (what, _, slot) in self.slots_mut() {
            let Some((entry, since)) = &slot.uncertain else {
                continue;
            };
            let Some(value) = reads(what, *since) else { continue };
            let same = (value.as_f64() - entry.value.as_f64()).abs() < 0.05;
            if let Some((entry, _)) = slot.uncertain.take() {
                slot.stands = Some(entry).filter(|_| same);
            }
        }
        self.tidy();
    }

    /// Whether something waits for the next reading.
    pub fn is_uncertain(&self) -> bool {
        let slots = self.arrays.iter().flat_map(|arrays| arrays.0.iter().flatten());
        slots.into_iter().any(|slot| slot.uncertain.is_some())
    }

    /// Sets a slot to its entry from before a restart.
    pub fn restore(&mut self, what: Commanded, priority: u8, entry: Entry) {
        if let Some(slot) = self.slot_mut(what, priority) {
            slot.by = entry.number;
            slot.stands = Some(entry);
        }
    }

    /// The slot that keeps a command of another interface from being accepted.
    pub fn refuses(&self, origin: &Origin, effect: Effect) -> Option<Protects> {
        if origin.kind == SourceKind::Bacnet || !origin.kind.is_client() {
            return None;
        }
        let held = |what: Commanded, point: ModelPoint| {
            let (_, priority, entry) = self.counting(what).filter(|(_, priority, _)| *priority <= PROTECTING)?;
            let protects = what != Commanded::Run || !entry.value.as_bool();
            protects.then(|| Protects {
                client: entry.origin.who.clone(),
                priority,
                what: point,
            })
        };
        let starts = effect.run == Some(true);
        let run = starts.then(|| held(Commanded::Run, ModelPoint::Run)).flatten();
        // A stop passes, whatever else the command contains.
        let reference = effect.reference && effect.run != Some(false);
        run.or_else(|| {
            reference
                .then(|| held(Commanded::SpeedReference, ModelPoint::SpeedReference))
                .flatten()
        })
    }

    /// Notes an accepted command, which withdraws the entries that it overrules, unless the command itself follows
    /// from a slot.
    pub fn accepted(&mut self, origin: &Origin, effect: Effect, write: Option<&SlotWrite>, now: Instant) {
        self.orders += 1;
        self.last = Some((origin.recorded(), now));
        if let Some(write) = write {
            self.ask(write);
            return;
        }
        // A stop of BACnet without a slot was meant for the machine that had the device number before a reload.
        let is_of_slots = origin.kind == SourceKind::Bacnet && effect.run != Some(false);
        if is_of_slots || self.arrays.is_none() {
            return;
        }
        if origin.kind == SourceKind::Supervision {
            self.silenced();
        }
        for (what, priority, slot) in self.slots_mut() {
            // A start or a reference keeps the entries that protect people, even if another slot governs. A stop
            // removes every active entry, so that nothing starts later by itself.
            let protects = priority <= PROTECTING;
            match what {
                Commanded::Run => match effect.run {
                    Some(true) if !protects => slot.clear_if(|entry| !entry.value.as_bool()),
                    Some(false) => slot.clear_if(|entry| entry.value.as_bool()),
                    Some(true) | None => {}
                },
                Commanded::Reverse => {
                    if let Some(reverse) = effect.reverse {
                        slot.clear_if(|entry| entry.value.as_bool() != reverse);
                    }
                }
                Commanded::SpeedReference | Commanded::FrequencyReference => {
                    if effect.reference && !protects {
                        slot.clear_if(|_| true);
                    }
                }
            }
        }
        self.tidy();
    }

    /// The lease of the governing client expired: all of its slots are released.
    pub fn silenced(&mut self) {
        let governs = Commanded::ALL.into_iter().find_map(|what| self.counting(what));
        let Some(client) = governs.map(|(.., entry)| entry.origin.client().clone()) else {
            return;
        };
        self.empty(&client);
    }

    /// Empties all slots of a client.
    pub fn empty(&mut self, client: &Arc<str>) {
        for (.., slot) in self.slots_mut() {
            slot.clear_if(|entry| entry.origin.client() == client);
        }
        self.tidy();
    }

    /// The client whose slot governs.
    pub fn client(&self) -> Option<&Arc<str>> {
        let mut governs = Commanded::ALL.into_iter().filter_map(|what| self.counting(what));
        governs.next().map(|(.., entry)| entry.origin.client())
    }

    /// The entries that survive a restart: inactives of `run` that protect people.
    pub fn kept(&self) -> impl Iterator<Item = (u8, &Entry)> {
        let standing = |priority: u8| Some((priority, self.entry(Commanded::Run, priority)?));
        (1..=PROTECTING)
            .filter_map(standing)
            .filter(|(_, entry)| !entry.value.as_bool())
    }
}

#[cfg(test)]
mod tests;
