//! The registers of the simulated NX family: groups, limits, refusals (reference/drives.md 3.2, 3.3, 3.10).

use super::super::model::{Model, signed, unsigned};
use super::parameters::{self, Settings};
use super::{Base, Beyond, ControlPlace, NxDrive, NxOptions, PROCESS_DATA, Unit, Values, control_word};
use crate::SimTime;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Registers per message (reference/drives.md 9.26) and the answer to more.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Reading actual values, the fault code and parameters.
    pub read: u16,
    /// Maximum number of parameters per write.
    pub write: u16,
    /// Maximum number of process data items per message.
    pub process: u16,
    /// The answer to a count beyond the limit; the manuals do not state it.
    pub beyond: Beyond,
}

/// Reaction of a register without a meaning inside 2012..=2099 and 2112..=2199.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hole {
    /// Exception 02.
    Exception,
    /// Reads as 0, writes are acknowledged and forgotten.
    Zero,
}

/// ID of the simulator's own register that trips a fault.
const TRIP: u16 = NxOptions::TRIP_ADDRESS + 1;

/// The groups of reference/drives.md 3.2; a request may not cross the borders of a group.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Group {
    Actual,
    FaultCode,
    Parameter,
    ProcessIn,
    ProcessOut,
}

impl Group {
    fn of(id: u16) -> Option<Group> {
        match id {
            1..=98 => Some(Group::Actual),
            99 => Some(Group::FaultCode),
            101..=1999 => Some(Group::Parameter),
            2001..=2099 => Some(Group::ProcessIn),
            2101..=2199 => Some(Group::ProcessOut),
            _ => None,
        }
    }

    fn is_process(self) -> bool {
        matches!(self, Group::ProcessIn | Group::ProcessOut)
    }
}

impl NxDrive {
    pub(super) fn reply(&mut self, request: &RequestPdu, now: SimTime) -> Reply {
        if now < self.busy_until {
            return Reply::Exception(Exception::BUSY);
        }
        let result = match request {
            RequestPdu::Read {
                table: Table::Holding | Table::Input,
                start,
                count,
            } => self.read(*start, *count).map(Reply::Registers),
            RequestPdu::WriteRegister { address, value } => self.write(*address, &[*value]).map(|()| Reply::Written),
            RequestPdu::WriteRegisters { start, values } => self.write(*start, values).map(|()| Reply::Written),
            _ => Err(Exception::FUNCTION),
        };
        result.unwrap_or_else(Reply::Exception)
    }

    fn read(&self, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        let (first, group) = self.group_of(start, count)?;
        let limit = if group.is_process() {
            self.options.limits.process
        } else {
            self.options.limits.read
        };
        self.options.limits.beyond.check(count, limit)?;
        (first..first.saturating_add(count))
            .map(|id| self.register(id, group))
            .collect()
    }

    fn write(&mut self, start: u16, values: &[u16]) -> Result<(), Exception> {
        let count = u16::try_from(values.len()).map_err(|_| Exception::VALUE)?;
        let (first, group) = self.group_of(start, count)?;
        match group {
            Group::Actual | Group::FaultCode | Group::ProcessOut => self.options.read_only.outcome(),
            Group::Parameter => {
                self.options.limits.beyond.check(count, self.options.limits.write)?;
                values
                    .first()
                    .map_or(Err(Exception::VALUE), |&value| self.write_parameter(first, value))
            }
            Group::ProcessIn => {
                self.options.limits.beyond.check(count, self.options.limits.process)?;
                self.write_process(first, values)
            }
        }
    }

    /// The first ID and the group that holds all requested registers; an error where they span two groups.
    fn group_of(&self, start: u16, count: u16) -> Result<(u16, Group), Exception> {
        let first = start.checked_add(1).ok_or(Exception::ADDRESS)?;
        let last = start.checked_add(count).ok_or(Exception::ADDRESS)?;
        match (Group::of(first), Group::of(last)) {
            (Some(group), Some(end)) if group == end => Ok((first, group)),
            _ => Err(Exception::ADDRESS),
        }
    }

    fn register(&self, id: u16, group: Group) -> Result<u16, Exception> {
        let value = match group {
            Group::Actual => self.actual_value(id),
            Group::FaultCode => Some(self.body.latch.fault()),
            Group::Parameter if id == TRIP && self.options.trip_register => return Ok(0),
            Group::Parameter => return self.parameters.get(id).ok_or(Exception::ADDRESS),
            Group::ProcessIn => {
                return self
                    .input
                    .get(usize::from(id) - 2001)
                    .copied()
                    .map_or_else(|| self.hole(), Ok);
            }
            Group::ProcessOut => self.output.get(usize::from(id) - 2101).copied(),
        };
        match (value, self.options.values) {
            (Some(_), Values::Tagged(tag)) => Ok(u16::from_be_bytes([tag, (id - 1).to_be_bytes()[1]])),
            (Some(value), Values::Physical) => Ok(value),
            (None, _) if group == Group::ProcessOut => self.hole(),
            (None, _) => Err(Exception::ADDRESS),
        }
    }

    fn hole(&self) -> Result<u16, Exception> {
        match self.options.hole {
            Hole::Exception => Err(Exception::ADDRESS),
            Hole::Zero => Ok(0),
        }
    }

    fn write_parameter(&mut self, id: u16, value: u16) -> Result<(), Exception> {
        if id == TRIP && self.options.trip_register {
            self.trip(value);
            return Ok(());
        }
        self.parameters.write(id, value, self.body.motor.fed)?;
        self.settings = Settings::of(&self.parameters);
        Ok(())
    }

    /// Accepts either all values of a message or none.
    fn write_process(&mut self, first: u16, values: &[u16]) -> Result<(), Exception> {
        let at = usize::from(first) - 2001;
        if at + values.len() > PROCESS_DATA {
            self.hole()?;
        }
        let reference = 2usize.checked_sub(at).and_then(|offset| values.get(offset));
        if reference.is_some_and(|&word| !self.allows_reference(word)) {
            return Err(Exception::VALUE);
        }
        for (register, &value) in self.input.iter_mut().skip(at).zip(values) {
            *register = value;
        }
        Ok(())
    }

    fn allows_reference(&self, word: u16) -> bool {
        let rule = self.options.reference;
        let most = match rule.unit {
            Unit::Percent => 10_000,
            Unit::Hertz => unsigned(self.settings.motor.maximum * 100.0),
        };
        let size = if rule.signed {
            (word as i16).unsigned_abs()
        } else {
            word
        };
        size <= most
    }

    /// Actual values, IDs 1 to 98 (reference/drives.md 11.1), as refreshed with the process data.
    fn actual_value(&self, id: u16) -> Option<u16> {
        let (motor, settings, ratings) = (&self.body.motor, &self.settings, &self.settings.motor);
        let tenths_of_current = unsigned(motor.current(ratings) * 10.0);
        Some(match id {
            1 => signed(motor.output / self.options.frequency_step),
            2 => signed(motor.rpm(ratings)),
            3 | 45 => tenths_of_current,
            4 => signed(motor.torque * 10.0),
            5 => signed(motor.power(ratings) * 10.0),
            6 => unsigned(motor.voltage(ratings) * 10.0),
            7 => unsigned(motor.dc_link(ratings, &self.options.load)),
            8 => signed(motor.heatsink),
            9 => signed(motor.heat),
            // Terminals with nothing connected, and the outputs of the demo's wiring.
            13 | 14 | 16 | 18 => 0,
            15 => u16::from(self.local.run && settings.place == ControlPlace::Terminals),
            17 => self.outputs(),
            25 => signed(self.target() * 100.0),
            26 => unsigned(20.0 * 100.0 * (motor.output / ratings.maximum).abs()),
            37 => self.body.latch.fault(),
            _ => return None,
        })
    }

    /// DO1, RO1 and RO2: an HVX with its outputs programmed for "pass through", or running and fault.
    fn outputs(&self) -> u16 {
        let bits = [
            control_word::DIGITAL_OUTPUT,
            control_word::RELAY_1,
            control_word::RELAY_2,
        ];
        if self.options.hvac_control {
            let on = bits.iter().enumerate().filter(|(_, mask)| self.hvac(**mask));
            on.fold(0, |word, (bit, _)| word | (1 << bit))
        } else {
            u16::from(self.body.running) | (u16::from(self.body.latch.fault() != 0) << 1)
        }
    }

    /// An item that a selector of process data out may select: an actual value or a parameter.
    fn item(&self, id: u16) -> u16 {
        self.actual_value(id).or_else(|| self.parameters.get(id)).unwrap_or(0)
    }

    /// The output frequency in the scale of the speed reference, 0.01 %.
    fn actual_speed(&self) -> f64 {
        let (output, minimum, maximum) = (
            self.body.motor.output,
            self.settings.minimum,
            self.settings.motor.maximum,
        );
        let (share, whole) = match self.options.reference.base {
            Base::Maximum => (output.abs(), maximum),
            // Below the minimum frequency there is no reference to compare with.
            Base::Band => ((output.abs() - minimum).max(0.0), maximum - minimum),
        };
        if whole > 0.0 {
            (share / whole * 10_000.0).copysign(output)
        } else {
            0.0
        }
    }

    /// Refreshes the process data out.
    pub(super) fn refresh_output(&mut self) {
        let head = [self.status(), self.general_status(), signed(self.actual_speed())];
        let items = (parameters::OUT_SELECTION..).take(PROCESS_DATA - head.len());
        let items: Vec<u16> = items
            .map(|selector| self.item(self.parameters.number(selector)))
            .collect();
        for (register, value) in self.output.iter_mut().zip(head.into_iter().chain(items)) {
            *register = value;
        }
    }
}
