//! What is known of a drive's own command words.

use std::collections::BTreeMap;

use crate::codec::{RequestPdu, Table};
use crate::command::written;

/// The registers and coils of a drive whose bits are commanded, as the drive has them.
///
/// Filled by reading the drive's own words and by acknowledged writes, never by assumption.
#[derive(Debug, Default)]
pub struct KnownWords(BTreeMap<(Table, u16), u16>);

impl KnownWords {
    /// A word that the drive has.
    pub fn learn(&mut self, table: Table, address: u16, word: u16) {
        if matches!(table, Table::Holding | Table::Coil) {
            self.0.insert((table, address), word);
        }
    }

    /// Acknowledged words are known from then on.
    pub fn written(&mut self, sent: &RequestPdu) {
        for (table, address, word) in written(sent).into_iter().flat_map(|(table, items)| {
            let place = move |(address, word)| (table, address, word);
            items.into_iter().map(place)
        }) {
            self.learn(table, address, word);
        }
    }

    /// The word, if it is known.
    pub fn get(&self, table: Table, address: u16) -> Option<u16> {
        self.0.get(&(table, address)).copied()
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

    /// The drive may have started anew, or taken an unanswered write: its words are read again before a bit is changed.
    pub fn forget(&mut self) {
        self.0.clear();
    }
}
