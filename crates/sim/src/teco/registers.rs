//! The registers of the simulated TECO 7300PA and the order of its refusals (reference/drives.md 5.2 to 5.6).

use super::super::model::{Model, unsigned};
use super::parameters::{self, RegisterKind};
use super::{Mode, TecoDrive, TecoOptions};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Function codes that the card supports.
const FUNCTIONS: [u8; 4] = [0x03, 0x06, 0x08, 0x10];
/// Maximum number of registers per message.
const MOST_REGISTERS: u16 = 16;
/// 00H: wrong check code.
pub(super) const CHECK_ERROR: Exception = Exception::Modbus(0x00);
/// Error 21H: value out of range, or a parameter that cannot be written over the bus.
const DATA_ERROR: Exception = Exception::Modbus(0x21);
/// 22H: Sn, Cn or On written in DRIVE mode, or saving while the drive runs.
const WRITE_ERROR: Exception = Exception::Modbus(0x22);
/// Register that saves the parameters when it is written.
const SAVE: u16 = 0x0900;
/// Greatest frequency reference, 0.01 Hz.
const MOST_FREQUENCY: u16 = 18_000;
/// PA-C software version 1.0.
const VERSION: u16 = 10;

/// Part of the drive that a register belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Register {
    Control,
    Monitor,
    Parameter(RegisterKind),
    Save,
    Trip,
}

fn span(start: u16, count: u16) -> Result<std::ops::Range<u16>, Exception> {
    if !(1..=MOST_REGISTERS).contains(&count) {
        return Err(Exception::VALUE);
    }
    start.checked_add(count).map(|end| start..end).ok_or(Exception::ADDRESS)
}

/// Broadcasts write the operation signals and the frequency reference only (reference/drives.md 9.9).
pub(super) fn allows_broadcast(request: &RequestPdu) -> bool {
    let allowed = 1..=2u16;
    match request {
        RequestPdu::WriteRegister { address, .. } => allowed.contains(address),
        RequestPdu::WriteRegisters { start, values } => {
            let last = usize::from(*start) + values.len().saturating_sub(1);
            allowed.contains(start) && last <= usize::from(*allowed.end())
        }
        _ => false,
    }
}

/// The reply to a PDU that is not a valid request; a plain slave replies with `exception`. Incomplete messages get
/// no reply, nor do messages whose byte count does not match the bytes (reference/drives.md 5.6, 9.8).
pub(super) fn refusal(pdu: &[u8], exception: Exception) -> Option<Exception> {
    let (&function, body) = pdu.split_first()?;
    if !FUNCTIONS.contains(&function) {
        return Some(Exception::FUNCTION);
    }
    let count = || {
        body.get(2..4)
            .map(|bytes| bytes.iter().fold(0u16, |n, b| (n << 8) | u16::from(*b)))
    };
    let whole = match function {
        0x10 => body.get(4).is_some_and(|bytes| usize::from(*bytes) + 5 == body.len()),
        _ => body.len() == 4,
    };
    match function {
        _ if !whole => None,
        0x03 | 0x10 if !count().is_some_and(|count| (1..=MOST_REGISTERS).contains(&count)) => Some(Exception::VALUE),
        _ => Some(exception),
    }
}

impl TecoDrive {
    /// Function, count, address, mode, value: in that order.
    pub(super) fn reply(&mut self, request: &RequestPdu) -> Result<Reply, Exception> {
        match *request {
            RequestPdu::Read {
                table: Table::Holding,
                start,
                count,
            } => span(start, count)?
                .map(|address| self.read(address))
                .collect::<Result<_, _>>()
                .map(Reply::Registers),
            RequestPdu::WriteRegister { address, value } => self.write(address, &[value]).map(|()| Reply::Written),
            RequestPdu::WriteRegisters { start, ref values } => self.write(start, values).map(|()| Reply::Written),
            RequestPdu::Diagnostics { subfunction: 0, data } => Ok(Reply::Diagnostics(data)),
            _ => Err(Exception::FUNCTION),
        }
    }

    fn register(&self, address: u16) -> Option<Register> {
        match address {
            0x0001..=0x000F => Some(Register::Control),
            0x0020..=0x003D | 0x0040 => Some(Register::Monitor),
            SAVE => Some(Register::Save),
            TecoOptions::TRIP_ADDRESS if self.options.trip_register => Some(Register::Trip),
            _ => parameters::place(address).map(Register::Parameter),
        }
    }

    fn read(&self, address: u16) -> Result<u16, Exception> {
        match self.register(address) {
            Some(Register::Control) => Ok(self.control_register(address)),
            Some(Register::Monitor) => Ok(self.monitor(address)),
            Some(Register::Parameter(_)) => Ok(self.parameters.number(address)),
            Some(Register::Trip) => Ok(0),
            Some(Register::Save) | None => Err(Exception::ADDRESS),
        }
    }

    /// A control register; reserved ones read as 0.
    fn control_register(&self, address: u16) -> u16 {
        match address {
            0x0001 => self.control.operation,
            0x0002 => self.control.frequency,
            0x0009 => self.control.outputs,
            0x000A => self.control.analogue[0],
            0x000B => self.control.analogue[1],
            _ => 0,
        }
    }

    fn monitor(&self, address: u16) -> u16 {
        let (motor, ratings) = (&self.body.motor, &self.ratings);
        match address {
            0x0020 => self.status(),
            0x0021 => self.body.latch.fault(),
            0x0023 => unsigned(self.frequency() * 100.0),
            0x0024 => unsigned(motor.output.abs() * 100.0),
            0x0027 => unsigned(motor.current(ratings) * 10.0),
            0x0028 => unsigned(motor.voltage(ratings)),
            0x002B => self.terminals,
            0x002C => self.inverter_status(),
            0x002D => self.outputs(),
            0x0031 => unsigned(motor.dc_link(ratings, &self.options.load)),
            0x0040 => VERSION,
            // Analogue inputs with nothing connected, and reserved registers.
            _ => 0,
        }
    }

    /// Accepts either all values of a message or none.
    fn write(&mut self, start: u16, values: &[u16]) -> Result<(), Exception> {
        let count = u16::try_from(values.len()).map_err(|_| Exception::VALUE)?;
        let addresses = span(start, count)?;
        let targets = addresses
            .zip(values)
            .map(|(address, &value)| self.register(address).map(|register| (address, register, value)))
            .collect::<Option<Vec<_>>>()
            .ok_or(Exception::ADDRESS)?;
        if targets.iter().any(|(_, register, _)| *register == Register::Monitor) {
            self.options.read_only.outcome()?;
        }
        if targets.iter().any(|(_, register, _)| self.mode_forbids(*register)) {
            return Err(WRITE_ERROR);
        }
        if targets
            .iter()
            .any(|&(address, register, value)| !self.allows(address, register, value))
        {
            return Err(DATA_ERROR);
        }
        for (address, register, value) in targets {
            self.take(address, register, value);
        }
        Ok(())
    }

    fn mode_forbids(&self, register: Register) -> bool {
        match register {
            Register::Parameter(place) => place.program_only && self.mode == Mode::Drive,
            Register::Save => self.body.motor.fed,
            _ => false,
        }
    }

    fn allows(&self, address: u16, register: Register, value: u16) -> bool {
        match register {
            Register::Control => address != 0x0002 || value <= MOST_FREQUENCY,
            Register::Parameter(place) => {
                place.reserved
                    || (!self.options.locked.contains(&address) && self.parameters.ram.check(address, value).is_ok())
            }
            Register::Monitor | Register::Save | Register::Trip => true,
        }
    }

    fn take(&mut self, address: u16, register: Register, value: u16) {
        match (register, address) {
            (Register::Control, 0x0001) => self.set_operation(value),
            (Register::Control, 0x0002) => self.control.frequency = value,
            (Register::Control, 0x0009) => self.control.outputs = value,
            (Register::Control, 0x000A) => self.control.analogue[0] = value,
            (Register::Control, 0x000B) => self.control.analogue[1] = value,
            (Register::Parameter(_), _) => {
                let _ = self.parameters.ram.write(address, value, self.body.motor.fed);
                self.ratings = self.parameters.ratings();
            }
            (Register::Save, _) => self.parameters.save(),
            (Register::Trip, _) => self.trip(value),
            (Register::Control | Register::Monitor, _) => {}
        }
    }
}
