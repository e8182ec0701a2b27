//! The words last written at 0x8100.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use drivegate_core::process_image::Machine;

/// The word last written at 0x8100 of each unit by any client, and the machine it was written to: a fault reset is
/// a change of its bit 2. After a reload that puts another machine at a unit, a word that a client repeats changes
/// nothing there.
#[derive(Debug, Default)]
pub(super) struct CommandWords(Mutex<BTreeMap<u8, (Machine, Option<u16>)>>);

impl CommandWords {
    /// Calls `update` with the word last written to this machine at this unit while no other client can change it; `None` if
    /// the unit meant another machine at the last write.
    pub(super) fn update<T>(&self, unit: u8, machine: Machine, update: impl FnOnce(&mut Option<u16>) -> T) -> T {
        let mut words = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let last = words.remove(&unit).filter(|(of, _)| *of == machine);
        let mut word = last.and_then(|(_, word)| word);
        let result = update(&mut word);
        words.insert(unit, (machine, word));
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(address: u8) -> Machine {
        Machine {
            port: "/dev/ttyUSB0".to_string(),
            address,
            profile: "vacon-nx".to_string(),
        }
    }

    #[test]
    fn a_word_belongs_to_the_machine_that_the_unit_meant() {
        let words = CommandWords::default();
        let write = |unit, address, word| words.update(unit, machine(address), |last| last.replace(word));
        assert_eq!(write(2, 1, 1), None);
        assert_eq!(write(2, 1, 5), Some(1));
        assert_eq!(write(3, 2, 1), None, "another unit");
        // A reload swaps the two machines, and swaps them back.
        assert_eq!(write(2, 2, 5), None);
        assert_eq!(write(2, 1, 5), None);
        assert_eq!(write(2, 1, 1), Some(5));
    }
}
