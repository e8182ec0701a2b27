//! What is known of the drives' own command words.

use std::collections::BTreeMap;

use super::actions::Check;
use crate::codec::{Reply, RequestPdu, Table};
use crate::command::written;

/// The registers of all drives of a bus whose bits are commanded, as the drives have them.
///
/// Filled by reading the drive's own words and by acknowledged writes, never by assumption.
#[derive(Debug, Default)]
pub struct Shadow(BTreeMap<(usize, Table, u16), u16>);

impl Shadow {
    /// A word that the drive has.
    pub fn learn(&mut self, drive: usize, table: Table, address: u16, word: u16) {
        if matches!(table, Table::Holding | Table::Coil) {
            self.0.insert((drive, table, address), word);
        }
    }

    /// The word, if it is known.
    pub fn get(&self, drive: usize, address: u16) -> Option<u16> {
        self.0.get(&(drive, Table::Holding, address)).copied()
    }

    /// Whether the drive is known to have all of that.
    pub(super) fn has(&self, drive: usize, table: Table, items: &[(u16, u16)]) -> bool {
        let has = |(address, word): &(u16, u16)| self.0.get(&(drive, table, *address)) == Some(word);
        items.iter().all(has)
    }

    /// Whether the drive is known to have something else than that, by now or earlier.
    pub(super) fn differs(&self, drive: usize, table: Table, items: &[(u16, u16)]) -> bool {
        let known = |address: u16| self.0.get(&(drive, table, address));
        items
            .iter()
            .any(|(address, word)| known(*address).is_some_and(|has| has != word))
    }

    /// The drive may have started anew: its words are read again before a bit is changed.
    pub fn forget(&mut self, drive: usize) {
        self.0.retain(|(of, _, _), _| *of != drive);
    }
}

/// What the drive has, as it says.
pub(super) fn learn(drive: usize, sent: &RequestPdu, reply: &Reply, shadow: &mut Shadow) -> Check {
    let (RequestPdu::Read { table, start, count }, Some(words)) = (sent, reply.words()) else {
        return Check::InVain;
    };
    for (address, word) in (*start..).zip(&words) {
        shadow.learn(drive, *table, address, *word);
    }
    if words.len() == usize::from(*count) {
        Check::Read
    } else {
        Check::InVain
    }
}

/// Acknowledged words are known from then on.
pub(super) fn note_write(drive: usize, sent: &RequestPdu, shadow: &mut Shadow) {
    if let Some((table, items)) = written(sent) {
        for (address, word) in items {
            shadow.learn(drive, table, address, word);
        }
    }
}
