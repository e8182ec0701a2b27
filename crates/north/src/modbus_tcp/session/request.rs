//! What a request covers, and what a family has for it. Pure.

use crate::modbus_tcp::routes::{At, EarlierUnit};
use crate::register_map::{self, STOP_ALL};
use drivegate_core::order::{self, Order, Refusal};
use drivegate_core::plant::DriveHandle;
use drivegate_model::drive::{ModelPoint, PointIndex, Profile, Value};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Whether a write to holding registers sets the register to 1.
pub(super) fn stops_by(request: &RequestPdu, register: u16) -> bool {
    let items = match request {
        RequestPdu::ReadWrite {
            write_start, values, ..
        } => order::written(&RequestPdu::write_registers(*write_start, values)),
        request => order::written(request),
    };
    items.is_some_and(|(table, items)| table == Table::Holding && items.contains(&(register, 1)))
}

impl EarlierUnit {
    /// The stop that a write contains by the meaning that its registers had.
    pub(super) fn stop(&self, drive: &DriveHandle, request: &RequestPdu) -> Option<Order> {
        let profile = &drive.image.spec.profile;
        let run = profile.model_index(ModelPoint::Run)?;
        let stop = Order::Points(vec![(run, Value::Bool(false))]);
        let write = match request {
            RequestPdu::ReadWrite {
                write_start, values, ..
            } => RequestPdu::write_registers(*write_start, values),
            request => request.clone(),
        };
        if self.is_default && stops_by(&write, STOP_ALL) {
            return Some(stop);
        }
        let (start, values) = match &write {
            RequestPdu::WriteRegister { address, value } => (*address, vec![*value]),
            RequestPdu::WriteRegisters { start, values } => (*start, values.clone()),
            _ => return drive.stop_meant(&Order::Write(write), drive),
        };
        let count = u16::try_from(values.len()).ok()?;
        let start = match self.registers.locate(start, count) {
            At::Drive => return drive.stop_meant(&Order::Write(write), drive),
            At::Model(start) => start,
            At::Nowhere => self.registers.around_the_command_word(start, count)?,
        };
        let before = register_map::CommandContext {
            word: None,
            fault: false,
        };
        let command = register_map::command(profile, start, &values, before).ok()?;
        command.points.contains(&(run, Value::Bool(false))).then_some(stop)
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

/// The stop that an order contains.
pub(super) fn stop_in(drive: &DriveHandle, order: &Order) -> Option<Order> {
    let profile = &drive.image.spec.profile;
    let run = profile.model_index(ModelPoint::Run)?;
    let stops = match order {
        Order::Points(values) => values.contains(&(run, Value::Bool(false))),
        Order::Write(pdu) => order::written(pdu).is_some_and(|(table, items)| {
            let runs = |(address, word): &(u16, u16)| profile.runs_by(table, *address, *word);
            items.iter().find_map(runs) == Some(false)
        }),
        Order::Parameter(_) | Order::Read(_) => false,
    };
    stops.then(|| match order {
        Order::Points(values) => {
            let keeps = |point: &PointIndex| *point == run || profile.model_index(ModelPoint::Reverse) == Some(*point);
            Order::Points(values.iter().filter(|(point, _)| keeps(point)).copied().collect())
        }
        order => order.clone(),
    })
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
