//! The words last written at 0x8100.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

/// The word last written at 0x8100 by any client, by drive name: a fault reset is a change of its bit 2.
#[derive(Debug, Default)]
pub(super) struct CommandWords(Mutex<HashMap<String, Option<u16>>>);

impl CommandWords {
    /// Calls `update` with the word of a drive while no other client can change it.
    pub(super) fn update<T>(&self, drive: &str, update: impl FnOnce(&mut Option<u16>) -> T) -> T {
        let mut words = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut word = words.get(drive).copied().unwrap_or_default();
        let result = update(&mut word);
        words.insert(drive.to_string(), word);
        result
    }
}
