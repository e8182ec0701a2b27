//! Slots whose client has lost its right to write: no client could release them any more. Pure.

use super::{Commanded, Entry, Priorities, Slot};

/// An entry that a slot no longer has.
#[derive(Debug, Clone, PartialEq)]
pub struct VoidSlot {
    /// Point of the slot's array.
    pub what: Commanded,
    /// 1..=16.
    pub priority: u8,
    /// Entry of the slot.
    pub entry: Entry,
}

impl Priorities {
    /// Empties the slots whose entry `stays` rejects, including those whose write is still in progress. A right
    /// that is granted again later restores none of them. The drive is not commanded: no reload starts or stops a
    /// motor by a slot.
    pub fn end_without_right(&mut self, stays: impl Fn(Commanded, &Entry) -> bool) -> Vec<VoidSlot> {
        let mut void = Vec::new();
        for (what, priority, slot) in self.slots_mut() {
            let lost = |entry: &&Entry| !stays(what, entry);
            let entry = slot.entries().find(lost).cloned();
            void.extend(entry.map(|entry| VoidSlot { what, priority, entry }));
            slot.clear_if(|entry| lost(&entry));
        }
        self.tidy();
        void
    }
}

impl Slot {
    /// All entries that the slot has or may get, latest first.
    fn entries(&self) -> impl Iterator<Item = &Entry> {
        let asked = self.asked.iter().rev().filter_map(|(_, entry)| entry.as_ref());
        let uncertain = self.uncertain.iter().map(|(entry, _)| entry);
        asked.chain(&self.stands).chain(uncertain)
    }
}
