//! The registers of the simulated NX: groups, limits, refusals (drives.md 3.2, 3.3, 3.10).

use super::parameters::{self, Parameters, Refused};
use super::{ControlPlace, NxDrive, PROCESS_DATA, Values};
use crate::codec::{Exception, Reply, RequestPdu, Table};
use crate::sim::SimTime;

/// Registers per message (drives.md 9.26) and the answer to more.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Reading actual values, the fault code and parameters.
    pub read: u16,
    /// Writing parameters.
    pub write: u16,
    /// Reading and writing process data.
    pub process: u16,
    /// The answer to a count beyond the limit; the manuals do not say which.
    pub beyond: Beyond,
}

/// The answer to a count beyond the limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beyond {
    /// Exception 03, illegal data value.
    Value,
    /// Exception 02, illegal data address.
    Address,
}

impl Limits {
    /// Vacon NX: 30 and 1, process data 20 and 20.
    pub const VACON: Limits = Limits {
        read: 30,
        write: 1,
        process: 20,
        beyond: Beyond::Value,
    };
    /// Eaton SVX and HVX: 1 and 1, process data 20 and 20.
    pub const EATON: Limits = Limits {
        read: 1,
        write: 1,
        process: 20,
        beyond: Beyond::Value,
    };
}

impl Default for Limits {
    fn default() -> Self {
        Limits::VACON
    }
}

/// What a register without a meaning inside 2012..=2099 and 2112..=2199 does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hole {
    /// Exception 02.
    Exception,
    /// Reads as 0, writes are acknowledged and forgotten.
    Zero,
}

/// What a write to a read-only register does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadOnly {
    /// Exception 02.
    Exception,
    /// Acknowledged and forgotten.
    Ignored,
}

/// ID of the simulator's own register that trips a fault.
const TRIP: u16 = 1999;

/// The groups of drives.md 3.2; a request may not cross their borders.
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
    /// The reply to a request to this drive that came whole at `now`.
    pub fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Reply {
        self.advance(now);
        self.heard(now);
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
        self.check_count(count, limit)?;
        (first..first.saturating_add(count))
            .map(|id| self.register(id, group))
            .collect()
    }

    fn write(&mut self, start: u16, values: &[u16]) -> Result<(), Exception> {
        let count = u16::try_from(values.len()).map_err(|_| Exception::VALUE)?;
        let (first, group) = self.group_of(start, count)?;
        match group {
            Group::Actual | Group::FaultCode | Group::ProcessOut => match self.options.read_only {
                ReadOnly::Exception => Err(Exception::ADDRESS),
                ReadOnly::Ignored => Ok(()),
            },
            Group::Parameter => {
                self.check_count(count, self.options.limits.write)?;
                values
                    .first()
                    .map_or(Err(Exception::VALUE), |&value| self.write_parameter(first, value))
            }
            Group::ProcessIn => {
                self.check_count(count, self.options.limits.process)?;
                self.write_process(first, values)
            }
        }
    }

    /// The first ID and the one group that holds all registers asked for.
    fn group_of(&self, start: u16, count: u16) -> Result<(u16, Group), Exception> {
        let first = start.checked_add(1).ok_or(Exception::ADDRESS)?;
        let last = start.checked_add(count).ok_or(Exception::ADDRESS)?;
        match (Group::of(first), Group::of(last)) {
            (Some(group), Some(end)) if group == end => Ok((first, group)),
            _ => Err(Exception::ADDRESS),
        }
    }

    fn check_count(&self, count: u16, limit: u16) -> Result<(), Exception> {
        match self.options.limits.beyond {
            _ if (1..=limit).contains(&count) => Ok(()),
            Beyond::Value => Err(Exception::VALUE),
            Beyond::Address => Err(Exception::ADDRESS),
        }
    }

    fn register(&self, id: u16, group: Group) -> Result<u16, Exception> {
        let value = match group {
            Group::Actual => self.actual_value(id),
            Group::FaultCode => Some(self.fault),
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
        self.parameters.set(id, value).map_err(|refused| match refused {
            Refused::Unknown => Exception::ADDRESS,
            Refused::Value => Exception::VALUE,
        })?;
        self.settings = self.parameters.settings();
        Ok(())
    }

    /// All values of one message are taken, or none.
    fn write_process(&mut self, first: u16, values: &[u16]) -> Result<(), Exception> {
        let at = usize::from(first) - 2001;
        if at + values.len() > PROCESS_DATA {
            self.hole()?;
        }
        let reference = 2usize.checked_sub(at).and_then(|offset| values.get(offset));
        if reference.is_some_and(|&r| (r as i16).unsigned_abs() > 10_000) {
            return Err(Exception::VALUE);
        }
        for (register, &value) in self.input.iter_mut().skip(at).zip(values) {
            *register = value;
        }
        Ok(())
    }

    /// Actual values, IDs 1 to 98 (drives.md 11.1), as refreshed with the process data.
    fn actual_value(&self, id: u16) -> Option<u16> {
        let (motor, settings) = (&self.motor, &self.settings);
        let tenths_of_current = unsigned(motor.current(settings) * 10.0);
        Some(match id {
            1 => signed(motor.output * 100.0),
            2 => signed(motor.rpm(settings)),
            3 | 45 => tenths_of_current,
            4 => signed(motor.torque * 10.0),
            5 => signed(motor.power(settings) * 10.0),
            6 => unsigned(motor.voltage(settings) * 10.0),
            7 => unsigned(motor.dc_link(settings, &self.options.load)),
            8 => signed(motor.heatsink),
            9 => signed(motor.heat),
            // Terminals with nothing connected, and the outputs of the demo's wiring.
            13 | 14 | 16 | 18 => 0,
            15 => u16::from(self.local.run && settings.place == ControlPlace::Terminals),
            17 => u16::from(self.running) | (u16::from(self.fault != 0) << 1),
            25 => signed(self.target(self.command()) * 100.0),
            26 => unsigned(20.0 * 100.0 * (motor.output / settings.maximum).abs()),
            37 => self.fault,
            _ => return None,
        })
    }

    /// An item that a selector of process data out may name: an actual value or a parameter.
    fn item(&self, id: u16) -> u16 {
        self.actual_value(id).or_else(|| self.parameters.get(id)).unwrap_or(0)
    }

    /// Refreshes the process data out.
    pub(super) fn refresh(&mut self) {
        let band = self.settings.maximum - self.settings.minimum;
        // Measured in the scale of the reference; below the minimum frequency there is no reference to compare with.
        let above = (self.motor.output.abs() - self.settings.minimum)
            .max(0.0)
            .copysign(self.motor.output);
        let speed = if band > 0.0 { above / band * 10_000.0 } else { 0.0 };
        let head = [self.status(), self.settings.place.status_bit(), signed(speed)];
        let items = (parameters::OUT_SELECTION..).take(PROCESS_DATA - head.len());
        let items: Vec<u16> = items
            .map(|selector| self.item(selected(&self.parameters, selector)))
            .collect();
        for (register, value) in self.output.iter_mut().zip(head.into_iter().chain(items)) {
            *register = value;
        }
    }
}

fn selected(parameters: &Parameters, selector: u16) -> u16 {
    parameters.get(selector).unwrap_or(0)
}

fn signed(value: f64) -> u16 {
    value.round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16 as u16
}

fn unsigned(value: f64) -> u16 {
    value.round().clamp(0.0, f64::from(u16::MAX)) as u16
}
