//! Words and references that orders of the gateway wrote last. Pure.

use std::time::Instant;

use drivegate_core::process_image::Reading;
use drivegate_model::drive::control::{Control, ControlItem};
use drivegate_proto::Table;

/// Maximum number of registers of a reference.
const LONGEST: usize = 2;

/// The command in force: run or stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum InForce {
    Run,
    Stop,
}

/// The registers of a reference with their values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Reference {
    pub(super) start: u16,
    pub(super) words: [u16; LONGEST],
    pub(super) count: u16,
}

impl Reference {
    pub(super) fn words(&self) -> &[u16] {
        self.words.get(..usize::from(self.count)).unwrap_or(&self.words)
    }
}

/// Words that orders of the gateway wrote last, as far as the drive acknowledged them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Ordered {
    pub(super) does: Option<InForce>,
    /// The control word last written, without a reset.
    pub(super) word: Option<u16>,
    pub(super) reference: Option<Reference>,
    /// The last write of what feeds the timeout.
    pub(super) fed: Option<Instant>,
    /// When the reference was last written.
    pub(super) referred: Option<Instant>,
    /// Whether the drive was seen to report this reference.
    pub(super) tells_reference: bool,
}

impl Ordered {
    /// Whether the registers of the reference were read since it was written, and differ from it although they
    /// matched before.
    pub(super) fn is_foreign(&mut self, reading: &Reading<'_>) -> bool {
        let (Some(reference), Some(referred)) = (self.reference, self.referred) else {
            return false;
        };
        let is_new = |at: Instant| at > referred;
        if !reading
            .snapshot
            .read_at(Table::Holding, reference.start)
            .is_some_and(is_new)
        {
            return false;
        }
        match reading.words(Table::Holding, reference.start, reference.count) {
            Ok(words) => !self.matches_written(&words),
            Err(_) => false,
        }
    }

    /// Notes that the registers of the reference have these values (empty if not read). Returns whether they match
    /// the written reference, as far as the drive reports it.
    pub(super) fn matches_written(&mut self, read: &[u16]) -> bool {
        let Some(reference) = self.reference.filter(|r| read.len() == r.words().len()) else {
            return true;
        };
        let is_told = reference.words() == read;
        let fits = is_told || !self.tells_reference;
        self.tells_reference |= is_told;
        fits
    }
}

/// Effect of a word in this register on run and stop; `None` if it has none.
pub(super) fn in_force(control: &Control, place: ControlItem, word: u16) -> Option<Option<InForce>> {
    let word = if place == control.at {
        control.without_reset(word)
    } else {
        word
    };
    if control.is_own_stop(place, word) {
        return Some(Some(InForce::Stop));
    }
    if control.is_run(place, word) {
        return Some(Some(InForce::Run));
    }
    // After a word that stops by other means, or that neither runs nor stops, nothing is repeated.
    (place == control.at || place == control.run_place()).then_some(None)
}

/// The reference in these items, if its registers are adjacent.
pub(super) fn reference_of(items: &[(u16, u16)]) -> Option<Reference> {
    let (start, _) = *items.first()?;
    let mut words = [0; LONGEST];
    let mut count = 0;
    for ((address, word), place) in items.iter().zip(&mut words) {
        if *address != start.wrapping_add(count) {
            break;
        }
        *place = *word;
        count += 1;
    }
    Some(Reference { start, words, count })
}
