//! The known command words of a drive.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use super::functions::TakenFunctions;
use crate::codec::{RequestPdu, Table};
use crate::drive::Profile;
use crate::drive::control::Control;
use crate::order::written;

/// The registers and coils of a drive whose bits are commanded, as the drive has them.
///
/// Filled by reading the drive's own words and by acknowledged writes, never by assumption.
#[derive(Debug, Default)]
pub struct KnownWords {
    words: BTreeMap<(Table, u16), u16>,
    /// The bits that a write took away last, and when, of each word.
    fell: BTreeMap<(Table, u16), (u16, Instant)>,
    /// Arrival time of the reply that is being applied.
    now: Option<Instant>,
    /// The stop word by each of the control words that the drive may have, where they are two.
    stop: Option<u16>,
    /// The direction that was ordered last, where no bit of the drive keeps it until the next start.
    pub(super) direction: Option<bool>,
    /// Whether the ordered direction differs from the drive's word: the next start uses it.
    waits_for_start: bool,
    /// Words that were read successfully at least once.
    reported: BTreeSet<(Table, u16)>,
    /// The functions that the drive takes, which it keeps over a restart.
    pub(super) functions: TakenFunctions,
}

impl KnownWords {
    /// A word that the drive reports.
    pub(crate) fn learn(&mut self, table: Table, address: u16, word: u16) {
        if matches!(table, Table::Holding | Table::Coil) {
            self.words.insert((table, address), word);
            self.reported.insert((table, address));
            self.stop = None;
        }
    }

    /// Stores acknowledged words as known.
    pub fn written(&mut self, sent: &RequestPdu) {
        self.stop = None;
        if let RequestPdu::MaskWrite { address, .. } = sent {
            // Other bits of the word may have been changed since.
            self.words.remove(&(Table::Holding, *address));
        }
        for (table, address, word) in written(sent).into_iter().flat_map(|(table, items)| {
            let place = move |(address, word)| (table, address, word);
            items.into_iter().map(place)
        }) {
            let before = self.words.insert((table, address), word);
            let fell = before.map_or(!word, |before| before & !word);
            if let Some(now) = self.now.filter(|_| fell != 0) {
                self.fell.insert((table, address), (fell, now));
            }
        }
    }

    /// A write in the form that the drive takes.
    pub(crate) fn formed(&self, pdu: RequestPdu, profile: &Profile) -> RequestPdu {
        self.functions.form(pdu, profile)
    }

    /// The reply that is applied next came at `now`.
    pub(crate) fn come_to(&mut self, now: Instant) {
        self.now = Some(now);
    }

    /// When the last write took one of these bits of a word away, if it did.
    pub(super) fn fell(&self, table: Table, address: u16, bits: u16) -> Option<Instant> {
        let (fell, at) = self.fell.get(&(table, address))?;
        (fell & bits != 0).then_some(*at)
    }

    /// Forgets these words, which the drive may or may not have taken. A stop needs no known word if it is the same with the
    /// control word from before and with this one.
    pub(crate) fn in_doubt(&mut self, table: Table, items: &[(u16, u16)], control: Option<&Control>) {
        for (address, word) in items {
            let before = self.words.remove(&(table, *address));
            let here = |control: &&Control| (control.at.table, control.at.address) == (table, *address);
            if let Some(control) = control.filter(here) {
                let by = |word: u16| control.stop_word(control.standing(word));
                let before = before.map(by).or(self.stop);
                self.stop = before.filter(|before| *before == by(*word));
            }
        }
    }

    /// The stop word, where the control word of the drive is one of two, and it is that by either.
    pub(super) fn stop_by_either(&self) -> Option<u16> {
        self.stop
    }

    /// Whether the drive reported that word, at any time.
    pub(super) fn is_reported(&self, table: Table, address: u16) -> bool {
        self.reported.contains(&(table, address))
    }

    /// The word at an address, if it is known.
    pub fn get(&self, table: Table, address: u16) -> Option<u16> {
        self.words.get(&(table, address)).copied()
    }

    /// Whether the drive is known to have all of that.
    pub(super) fn has(&self, table: Table, items: &[(u16, u16)]) -> bool {
        items
            .iter()
            .all(|(address, word)| self.get(table, *address) == Some(*word))
    }

    /// Whether the drive is known to have something else than that, by now or earlier.
    pub(super) fn differs(&self, table: Table, items: &[(u16, u16)]) -> bool {
        items
            .iter()
            .any(|(address, word)| self.get(table, *address).is_some_and(|has| has != *word))
    }

    /// A direction that was ordered and not written.
    pub(crate) fn keep_direction(&mut self, reverse: bool) {
        (self.direction, self.waits_for_start) = (Some(reverse), true);
    }

    /// Another order has set the direction since, or started the motor.
    pub(crate) fn forget_direction(&mut self) {
        self.waits_for_start = false;
    }

    /// The direction that was kept for the next start.
    pub(super) fn at_next_start(&self) -> Option<bool> {
        self.direction.filter(|_| self.waits_for_start)
    }

    /// Forgets the words of a drive that may have restarted or taken an unanswered write: they are read again before a
    /// bit is changed.
    pub fn forget(&mut self) {
        self.words.clear();
        self.stop = None;
    }
}
