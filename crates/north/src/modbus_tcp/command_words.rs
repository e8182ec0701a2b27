//! The words last written at 0x8100.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use crate::register_map::{CommandContext, FAULT_RESET};
use drivegate_core::process_image::Machine;

/// The word last written at 0x8100 of each machine by any client, under whatever unit id: a fault reset is a change of
/// its bit 2. For each unit id of a listener, the machine of the last write: a reset bit that a client holds there is
/// no change because a reload put another machine behind the unit id.
#[derive(Debug, Default)]
pub(super) struct CommandWords(Mutex<Words>);

#[derive(Debug, Default)]
struct Words {
    machines: BTreeMap<Machine, u16>,
    units: BTreeMap<ListenerUnit, UnitWord>,
}

/// A unit id as the clients of one listener see it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ListenerUnit {
    pub(super) listener: usize,
    pub(super) unit: u8,
}

/// The last write of a word under a unit id.
#[derive(Debug)]
struct UnitWord {
    machine: Machine,
    /// Whether its reset bit was set.
    resets: bool,
    /// Whether the reset bit is set since the unit id meant another machine.
    is_held: bool,
}

/// The word last written to a machine, as it counts for the next one.
#[derive(Debug, Default)]
pub(super) struct LastWord {
    word: Option<u16>,
    written: Option<u16>,
    is_held: bool,
}

impl LastWord {
    /// What decides whether the next word resets a fault.
    pub(super) fn context(&self, fault: bool) -> CommandContext {
        let held = self.word.unwrap_or_default() | FAULT_RESET;
        CommandContext {
            word: if self.is_held { Some(held) } else { self.word },
            fault: fault && !self.is_held,
        }
    }

    /// Stores the word that a client wrote.
    pub(super) fn write(&mut self, word: u16) {
        (self.word, self.written) = (Some(word), Some(word));
    }

    /// Clears the reset bit, which did not reach the drive, so that the next word with it resets again.
    pub(super) fn forget_reset(&mut self) {
        self.word = self.word.map(|word| word & !FAULT_RESET);
    }
}

impl CommandWords {
    /// Calls `update` with the word last written to this machine while no other client can change it.
    pub(super) fn update<T>(&self, unit: ListenerUnit, machine: Machine, update: impl FnOnce(&mut LastWord) -> T) -> T {
        let mut words = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let before = words.units.get(&unit);
        let mut last = LastWord {
            word: words.machines.get(&machine).copied(),
            written: None,
            is_held: before.is_some_and(|before| before.is_held || (before.resets && before.machine != machine)),
        };
        let result = update(&mut last);
        if let Some(word) = last.written {
            let resets = word & FAULT_RESET != 0;
            let written = UnitWord {
                machine: machine.clone(),
                resets,
                is_held: resets && last.is_held,
            };
            words.units.insert(unit, written);
        }
        if let Some(word) = last.word {
            words.machines.insert(machine, word);
        }
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RUN: u16 = 1;

    fn machine(address: u8) -> Machine {
        Machine {
            port: "/dev/ttyUSB0".to_string(),
            address,
            profile: "vacon-nx".to_string(),
        }
    }

    /// Writes a word to a machine without a fault, or with one; returns whether the word resets.
    fn write(words: &CommandWords, (listener, unit): (usize, u8), address: u8, word: u16, fault: bool) -> bool {
        words.update(ListenerUnit { listener, unit }, machine(address), |last| {
            let resets = last.context(fault).resets(word);
            last.write(word);
            resets
        })
    }

    #[test]
    fn a_word_belongs_to_its_machine_under_any_unit_and_listener() {
        let words = CommandWords::default();
        // Two controllers use the same unit id of two listeners for different drives, in turns.
        for (listener, address) in [(1, 1), (2, 2)] {
            assert!(write(&words, (listener, 1), address, FAULT_RESET, false), "a change");
        }
        for (listener, address) in [(1, 1), (2, 2), (1, 1), (2, 2)] {
            assert!(!write(&words, (listener, 1), address, FAULT_RESET, false), "held");
        }
        write(&words, (1, 1), 1, RUN, false);
        assert!(!write(&words, (2, 1), 2, RUN | FAULT_RESET, false), "held");
        assert!(write(&words, (1, 1), 1, RUN | FAULT_RESET, false), "a change");
        // Another listener shows the first machine, too.
        assert!(!write(&words, (3, 9), 1, RUN | FAULT_RESET, false), "held");
    }

    #[test]
    fn a_held_bit_is_no_change_at_the_machine_that_a_reload_put_behind_the_unit() {
        let words = CommandWords::default();
        let unit = (1, 1);
        write(&words, unit, 1, RUN, false);
        write(&words, unit, 1, FAULT_RESET, false);
        for fault in [false, true, false] {
            assert!(!write(&words, unit, 2, FAULT_RESET, fault), "fault: {fault}");
            assert!(!write(&words, unit, 2, FAULT_RESET | RUN, fault), "fault: {fault}");
        }
        // The client clears the bit and sets it again.
        write(&words, unit, 2, 0, true);
        assert!(write(&words, unit, 2, FAULT_RESET, true));
        assert!(write(&words, unit, 2, FAULT_RESET, true), "as long as the fault stands");
        // A bit that was not set before the reload is a change behind it.
        write(&words, unit, 2, 0, false);
        assert!(write(&words, unit, 3, FAULT_RESET, false));
    }
}
