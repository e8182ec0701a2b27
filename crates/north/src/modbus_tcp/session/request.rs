//! What a request covers, and what a family has for it. Pure.

use std::borrow::Cow;

use crate::modbus_tcp::routes::{At, EarlierUnit, Registers};
use crate::register_map::{self, STOP_ALL};
use drivegate_core::order::{self, Order, Parts, Refusal};
use drivegate_core::plant::DriveHandle;
use drivegate_model::drive::{ModelPoint, Profile, Value};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// What a request writes; of function 23 its write.
pub(super) fn write_part(request: &RequestPdu) -> Cow<'_, RequestPdu> {
    match request {
        RequestPdu::ReadWrite {
            write_start, values, ..
        } => Cow::Owned(RequestPdu::write_registers(*write_start, values)),
        request => Cow::Borrowed(request),
    }
}

/// The holding registers that a request sets.
pub(super) fn registers_written(request: &RequestPdu) -> Vec<(u16, u16)> {
    let written = order::written(&write_part(request)).filter(|(table, _)| *table == Table::Holding);
    written.map(|(_, items)| items).unwrap_or_default()
}

/// Whether a write to holding registers sets the register to 1.
pub(super) fn stops_by(request: &RequestPdu, register: u16) -> bool {
    registers_written(request).contains(&(register, 1))
}

impl Registers {
    /// The stop in a write of registers that is carried out without the rest.
    pub(super) fn stop_in(self, drive: &DriveHandle, (start, values): (u16, &[u16])) -> Option<Order> {
        let count = u16::try_from(values.len()).ok()?;
        let start = match self.locate(start, count) {
            At::Drive => {
                let order = Order::Write(RequestPdu::write_registers(start, values));
                return stop_of(drive, order);
            }
            At::Model(start) => start,
            At::Nowhere => self.around_the_command_word(start, count)?,
        };
        let before = register_map::CommandContext {
            word: None,
            fault: false,
        };
        let command = register_map::command(&drive.image.spec.profile, start, values, before).ok()?;
        stop_of(drive, Order::Points(command.points))
    }
}

/// The stop part of an order.
fn stop_of(drive: &DriveHandle, order: Order) -> Option<Order> {
    match Parts::of(order, &drive.image.spec.profile) {
        Parts::Two(stop, _) => Some(stop),
        Parts::One(order) => drive.stop_meant(&order, drive).map(|_| order),
    }
}

impl EarlierUnit {
    /// The stop that a write contains by the meaning that its registers had.
    pub(super) fn stop(&self, drive: &DriveHandle, request: &RequestPdu) -> Option<Order> {
        let run = drive.image.spec.profile.model_index(ModelPoint::Run)?;
        let stop = Order::Points(vec![(run, Value::Bool(false))]);
        if self.is_default && stops_by(request, STOP_ALL) {
            return Some(stop);
        }
        let write = write_part(request);
        let is_stop = match write.as_ref() {
            RequestPdu::WriteRegister { address, value } => {
                self.registers.stop_in(drive, (*address, &[*value])).is_some()
            }
            RequestPdu::WriteRegisters { start, values } => self.registers.stop_in(drive, (*start, values)).is_some(),
            _ => drive.stop_meant(&Order::Write(write.into_owned()), drive).is_some(),
        };
        is_stop.then_some(stop)
    }
}

/// The refusal of the values next to a stop that is carried out.
pub(super) fn not_readable(code: Exception, address: u16) -> Refusal {
    match code {
        Exception::ADDRESS => {
            Refusal::NotWritable(format!("0x{address:04X} is followed by a register that does not exist"))
        }
        code => Refusal::BadValue(format!("register 0x{address:04X} cannot be read now ({code})")),
    }
}

/// Whether a write that stops all drives names no other register.
pub(super) fn stops_all_only(request: &RequestPdu) -> bool {
    order::written(request).is_some_and(|(_, items)| items.len() == 1)
}

/// Whether the family has the table that a function code accesses. No family supports 22; 23 is carried out as 16 and 3.
pub(super) fn has_function(profile: &Profile, function: u8) -> bool {
    let table = match function {
        1 | 5 | 15 => Table::Coil,
        2 => Table::DiscreteInput,
        3 | 6 | 16 | 23 => Table::Holding,
        4 => profile.canonical(Table::Input),
        _ => return false,
    };
    profile.ranges.iter().any(|r| r.table == table)
}

/// Maximum number of items in one read of this span, from the limits of the profile's ranges that it touches.
pub(super) fn read_limit(profile: &Profile, table: Table, start: u16, count: u16) -> u16 {
    let table = profile.canonical(table);
    let last = start.saturating_add(count.saturating_sub(1));
    let touched = profile
        .ranges
        .iter()
        .filter(|r| r.table == table && *r.addresses.start() <= last && start <= *r.addresses.end());
    touched.map(|r| r.read).min().unwrap_or(table.max_read())
}

/// Whether the reply of a drive has the form that the request expects.
pub(super) fn answers(request: &RequestPdu, reply: &Reply) -> bool {
    match (request, reply) {
        (RequestPdu::Read { table, count, .. }, Reply::Bits(bits)) => {
            table.is_bits() && bits.len() == usize::from(*count)
        }
        (RequestPdu::Read { table, count, .. }, Reply::Registers(words)) => {
            !table.is_bits() && words.len() == usize::from(*count)
        }
        (RequestPdu::ReadWrite { read_count, .. }, Reply::Registers(words)) => words.len() == usize::from(*read_count),
        (RequestPdu::ReadWrite { .. }, _) => false,
        (_, Reply::Written) => request.is_write(),
        _ => false,
    }
}
