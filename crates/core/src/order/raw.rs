//! The registers that a raw write sets. Pure.

use drivegate_proto::{RequestPdu, Table};

/// The registers (or coils, as 0 and 1) that a raw write sets, as address and value.
pub fn written(pdu: &RequestPdu) -> Option<(Table, Vec<(u16, u16)>)> {
    let many = |start: u16, values: &mut dyn Iterator<Item = u16>| -> Vec<(u16, u16)> {
        (0u16..)
            .zip(values)
            .filter_map(|(i, v)| Some((start.checked_add(i)?, v)))
            .collect()
    };
    match pdu {
        RequestPdu::WriteRegister { address, value } => Some((Table::Holding, vec![(*address, *value)])),
        RequestPdu::WriteRegisters { start, values } => {
            Some((Table::Holding, many(*start, &mut values.iter().copied())))
        }
        RequestPdu::WriteCoil { address, on } => Some((Table::Coil, vec![(*address, u16::from(*on))])),
        RequestPdu::WriteCoils { start, bits } => {
            Some((Table::Coil, many(*start, &mut bits.iter().map(|b| u16::from(*b)))))
        }
        _ => None,
    }
}
