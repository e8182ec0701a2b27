//! A drive of any family, simulated from its profile: it runs and stops by its words, and shows that in its states.

use std::collections::BTreeMap;
use std::sync::Arc;

use drivegate_core::order::written;
use drivegate_model::drive::control::{Control, ControlItem, Mask, Run, Setting, Until};
use drivegate_model::drive::profile::Form;
use drivegate_model::drive::{Derived, ModelPoint, Profile, Raw, Source};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

pub(super) struct FamilyDrive {
    profile: Arc<Profile>,
    /// Registers that show states; one may share its address with the control word.
    items: BTreeMap<(Table, u16), u16>,
    /// What was written.
    written: BTreeMap<(Table, u16), u16>,
    pub(super) runs: bool,
    /// Function 16 is unknown to the drive.
    pub(super) only_06: bool,
}

impl FamilyDrive {
    /// A drive without a fault that the bus controls, whose motor is at standstill.
    pub(super) fn new(profile: &Arc<Profile>) -> FamilyDrive {
        let mut drive = FamilyDrive {
            profile: profile.clone(),
            items: BTreeMap::new(),
            written: BTreeMap::new(),
            runs: false,
            only_06: false,
        };
        drive.show(ModelPoint::Remote, true);
        drive.stand();
        drive
    }

    fn control(&self) -> Control {
        self.profile.control.clone().unwrap()
    }

    fn state(&mut self, mask: Mask, on: bool) {
        let raw = self.profile.points.get(mask.point).unwrap().raw().unwrap();
        let (bits, is) = (mask.mask as u16, mask.is as u16);
        let word = self.items.entry((raw.table, raw.address)).or_default();
        if on {
            *word = *word & !bits | is;
        } else if *word & bits == is {
            *word = if is == 0 {
                *word | (bits & bits.wrapping_neg())
            } else {
                *word & !bits
            };
        }
    }

    /// Shows this state; does nothing if the profile has no such point.
    pub(super) fn show(&mut self, point: ModelPoint, on: bool) {
        let profile = self.profile.clone();
        match profile.model_point(point).map(|point| &point.source) {
            Some(Source::Derived(Derived::State { any })) => {
                if on {
                    self.state(any[0], true)
                } else {
                    any.iter().for_each(|mask| self.state(*mask, false))
                }
            }
            Some(Source::Raw(raw)) => self.bit(raw, on),
            _ => {}
        }
    }

    fn bit(&mut self, raw: &Raw, on: bool) {
        let word = self.items.entry((raw.table, raw.address)).or_default();
        match (raw.form, &raw.equals) {
            (Form::Bit { bit, invert }, _) => {
                *word = if on != invert {
                    *word | 1 << bit
                } else {
                    *word & !(1 << bit)
                };
            }
            // Any low byte other than 0 has this meaning, so 1 is used.
            (Form::Bits { first: 0, .. }, Some(_)) => *word = u16::from(on),
            _ => panic!("{raw:?}"),
        }
    }

    /// Shows this word in a register that shows states.
    pub(super) fn show_word(&mut self, address: u16, word: u16) {
        self.items.insert((Table::Holding, address), word);
    }

    /// The motor turns from now on.
    pub(super) fn run(&mut self) {
        self.runs = true;
        self.show(ModelPoint::Ready, true);
        self.show(ModelPoint::Running, true);
    }

    /// Stops the motor at once.
    pub(super) fn stand(&mut self) {
        self.runs = false;
        self.show(ModelPoint::Running, false);
        self.show(ModelPoint::Ready, true);
    }

    /// The mains were switched off and on: the motor is at standstill, and the words are lost.
    pub(super) fn power_cycle(&mut self) {
        *self = FamilyDrive::new(&self.profile.clone());
    }

    pub(super) fn word(&self) -> u16 {
        let at = self.control().at;
        self.written.get(&(at.table, at.address)).copied().unwrap_or(0)
    }

    /// Writes the control word as another master.
    pub(super) fn write_word(&mut self, word: u16) {
        let at = self.control().at;
        self.takes(at.table, at.address, word);
    }

    fn takes(&mut self, table: Table, address: u16, word: u16) {
        let (control, place) = (self.control(), ControlItem { table, address });
        self.written.insert((table, address), word);
        let word = if place == control.at {
            control.without_reset(word)
        } else {
            word
        };
        if control.is_stop(place, word) {
            self.stand();
        } else if control.is_run(place, word) {
            self.run();
        }
        if let Run::Steps(steps) = &control.run {
            let turned = control.reverse.map_or(0, |reverse| reverse.mask);
            let is = |write: &Setting| (word ^ write.value) & write.mask & !turned == 0;
            for step in steps.iter().filter(|step| place == control.at && is(&step.write)) {
                if let Until::State(mask) = step.until {
                    self.state(mask, true);
                }
            }
        }
    }

    pub(super) fn answer(&mut self, pdu: &RequestPdu) -> Reply {
        if let RequestPdu::Read { table, start, count } = pdu {
            let shadow = !self.control().is_read();
            let at = self.control().at;
            let word = |address: u16| {
                let place = (*table, address);
                let hidden = shadow && place == (at.table, at.address);
                let written = || {
                    if hidden {
                        Some(&0x5555)
                    } else {
                        self.written.get(&place)
                    }
                };
                self.items.get(&place).or_else(written).copied().unwrap_or(0)
            };
            let words: Vec<u16> = (*start..start.saturating_add(*count)).map(word).collect();
            return match table {
                Table::Coil | Table::DiscreteInput => Reply::Bits(words.iter().map(|word| *word != 0).collect()),
                Table::Holding | Table::Input => Reply::Registers(words),
            };
        }
        if self.only_06 && matches!(pdu, RequestPdu::WriteRegisters { .. }) {
            return Reply::Exception(Exception::FUNCTION);
        }
        let Some((table, items)) = written(pdu) else {
            return Reply::Exception(Exception::FUNCTION);
        };
        for (address, word) in items {
            self.takes(table, address, word);
        }
        Reply::Written
    }
}
