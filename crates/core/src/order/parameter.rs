//! The order that writes one parameter.

use drivegate_model::drive::parameters::RawValue;
use drivegate_proto::{RequestPdu, Table};

/// A parameter to set. The bus reads the value and whether the motor runs, writes, and reads the value back; nothing
/// else is sent between the reply that the motor is stopped and the write. A drive that already has the value is not
/// written, to save its memory: the reply is then that of the read.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterOrder {
    /// Id of the parameter in its family.
    pub id: String,
    /// PDU address of the parameter's (first) holding register.
    pub address: u16,
    /// The value that the drive must have before the write, unless it already has `to`; `None` for a write-only
    /// register, which is written once and not read back.
    pub from: Option<RawValue>,
    /// The value to write.
    pub to: RawValue,
}

impl ParameterOrder {
    /// The read of the parameter's value.
    pub fn read(&self) -> RequestPdu {
        RequestPdu::Read {
            table: Table::Holding,
            start: self.address,
            count: if matches!(self.to, RawValue::Float(_)) { 2 } else { 1 },
        }
    }

    /// The write of the parameter.
    pub fn write(&self) -> RequestPdu {
        match self.to {
            RawValue::Word(value) => RequestPdu::WriteRegister {
                address: self.address,
                value,
            },
            RawValue::Float(_) => RequestPdu::WriteRegisters {
                start: self.address,
                values: self.to.words(),
            },
        }
    }

    /// The order in one line of text, for the audit.
    pub fn what(&self) -> String {
        let (id, to) = (&self.id, self.to.number());
        match self.from {
            Some(from) => format!("parameter {id}: {} -> {to}", from.number()),
            None => format!("{id}: {to}"),
        }
    }
}
