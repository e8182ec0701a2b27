//! The command words of a drive, as far as they are known.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use super::functions::TakenFunctions;
use drivegate_core::order::written;
use drivegate_model::drive::Profile;
use drivegate_model::drive::control::{Control, ControlItem};
use drivegate_proto::{RequestPdu, Table};

/// The registers and coils of a drive whose bits are commanded, as the drive has them.
///
/// Command words learned by reading the drive and from acknowledged writes, never by assumption.
#[derive(Debug, Default)]
pub struct KnownWords {
    words: BTreeMap<(Table, u16), u16>,
    /// The last words of those places that are not known any more.
    before: BTreeMap<(Table, u16), u16>,
    /// For each word, the bits that the last write took away, and when.
    fell: BTreeMap<(Table, u16), (u16, Instant)>,
    /// Arrival time of the reply that is being applied.
    now: Option<Instant>,
    /// The stop word, computed for each control word that the drive may have, if there are two.
    stop: Option<u16>,
    /// The direction that was ordered last, where no bit of the drive keeps it until the next start.
    pub(super) direction: Option<bool>,
    /// The direction in which the motor turns by its command, as the drive shows; `None` if it stands or that is not shown.
    turns: Option<bool>,
    /// Whether the ordered direction differs from the drive's word, so that the next start must set it.
    waits_for_start: bool,
    /// Words that were read successfully at least once.
    reported: BTreeSet<(Table, u16)>,
    /// The function codes that the drive accepts, which a restart of the drive does not change.
    pub(super) functions: TakenFunctions,
}

/// The direction that clients ordered last for a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OrderedDirection {
    /// Whether the motor is to turn in reverse.
    pub reverse: bool,
    /// Whether the next start must set the direction, because no word of the drive has it.
    pub at_next_start: bool,
}

impl KnownWords {
    /// Remembers a word that the drive reports.
    pub(crate) fn learn(&mut self, table: Table, address: u16, word: u16) {
        if matches!(table, Table::Holding | Table::Coil) {
            self.words.insert((table, address), word);
            self.reported.insert((table, address));
            self.stop = None;
        }
    }

    /// Remembers the words of an acknowledged write.
    pub fn written(&mut self, sent: &RequestPdu) {
        self.stop = None;
        if let RequestPdu::MaskWrite {
            address,
            and_mask,
            or_mask,
        } = sent
        {
            // Other bits of the word may have changed since it was known.
            let place = (Table::Holding, *address);
            let masked = self
                .words
                .remove(&place)
                .or_else(|| self.before.get(&place).copied())
                .map(|word| word & and_mask | or_mask & !and_mask);
            self.before.extend(masked.map(|word| (place, word)));
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

    /// Advances the known state to `now`, when the next reply that is applied arrived.
    pub(crate) fn advance_to(&mut self, now: Instant) {
        self.now = Some(now);
    }

    /// When the last write took one of these bits of a word away; `None` if it did not.
    pub(super) fn fell(&self, table: Table, address: u16, bits: u16) -> Option<Instant> {
        let (fell, at) = self.fell.get(&(table, address))?;
        (fell & bits != 0).then_some(*at)
    }

    /// Forgets these words, which the drive may or may not have received. A stop needs no known word if it is equal
    /// for the old and the new control word.
    pub(crate) fn in_doubt(&mut self, table: Table, items: &[(u16, u16)], control: Option<&Control>) {
        for (address, word) in items {
            let before = self.words.remove(&(table, *address));
            self.before.insert((table, *address), *word);
            let here = |control: &&Control| (control.at.table, control.at.address) == (table, *address);
            if let Some(control) = control.filter(here) {
                let by = |word: u16| control.stop_word(control.standing(word));
                let before = before.map(by).or(self.stop);
                self.stop = before.filter(|before| *before == by(*word));
            }
        }
    }

    /// The stop word if the drive has one of two control words and the stop is equal for both.
    pub(super) fn stop_by_either(&self) -> Option<u16> {
        self.stop
    }

    /// Whether the drive reported that word, at any time.
    pub(super) fn is_reported(&self, table: Table, address: u16) -> bool {
        self.reported.contains(&(table, address))
    }

    /// The word at an address; `None` if it is unknown.
    pub fn get(&self, table: Table, address: u16) -> Option<u16> {
        self.words.get(&(table, address)).copied()
    }

    /// Whether the drive is known to have all of that.
    pub(super) fn has(&self, table: Table, items: &[(u16, u16)]) -> bool {
        items
            .iter()
            .all(|(address, word)| self.get(table, *address) == Some(*word))
    }

    /// Whether the drive is known to have, or to have had, other values than these.
    pub(super) fn differs(&self, table: Table, items: &[(u16, u16)]) -> bool {
        items
            .iter()
            .any(|(address, word)| self.get(table, *address).is_some_and(|has| has != *word))
    }

    /// A direction that was ordered and not written.
    pub(crate) fn keep_direction(&mut self, reverse: bool) {
        (self.direction, self.waits_for_start) = (Some(reverse), true);
    }

    /// Forgets the kept direction: another order has since set the direction or started the motor.
    pub(crate) fn forget_direction(&mut self) {
        self.waits_for_start = false;
    }

    /// The direction that was ordered last, for the bus that replaces this one; `None` if none was ordered.
    pub(crate) fn handed_over(&self, control: &Control) -> Option<OrderedDirection> {
        let waiting = self.at_next_start().map(|reverse| OrderedDirection {
            reverse,
            at_next_start: true,
        });
        let last = || {
            let reverse = self.last_direction(control)?;
            Some(OrderedDirection {
                reverse,
                at_next_start: false,
            })
        };
        waiting.or_else(last)
    }

    /// Continues with the direction that was ordered last on the bus before a reload.
    pub(crate) fn take_over(&mut self, ordered: Option<OrderedDirection>) {
        self.direction = ordered.map(|ordered| ordered.reverse);
        self.waits_for_start = ordered.is_some_and(|ordered| ordered.at_next_start);
    }

    /// Notes the direction in which the motor turns by its command, or that this is not known.
    pub(crate) fn see_turning(&mut self, reverse: Option<bool>) {
        self.turns = reverse;
    }

    /// The direction that was ordered last, by a word that may not be known any more; forward if none was ordered. `true` is
    /// reverse.
    pub(super) fn ordered_direction(&self, control: &Control) -> bool {
        self.last_direction(control).unwrap_or(false)
    }

    /// The direction of a run command that names none: as ordered last, and if this run of the gateway ordered none, as the
    /// motor turns, which is not to be reversed.
    pub(super) fn unnamed_direction(&self, control: &Control) -> bool {
        self.last_direction(control).or(self.turns).unwrap_or(false)
    }

    /// The direction that was ordered last; `None` if none was ordered.
    pub(crate) fn last_direction(&self, control: &Control) -> Option<bool> {
        let last = |place: ControlItem| {
            let before = || self.before.get(&(place.table, place.address)).copied();
            self.get(place.table, place.address).or_else(before)
        };
        control.direction_in(last).or(self.direction)
    }

    /// The direction that was kept for the next start.
    pub(super) fn at_next_start(&self) -> Option<bool> {
        self.direction.filter(|_| self.waits_for_start)
    }

    /// Forgets the words of a drive that may have restarted or received an unanswered write: they are read again
    /// before a bit is changed. A direction in them is still the one that was ordered last.
    pub fn forget(&mut self) {
        self.before.append(&mut self.words);
        self.stop = None;
    }
}
