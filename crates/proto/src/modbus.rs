//! Modbus PDUs, shared by RTU, ASCII and TCP, for both ends.
//!
//! Modbus requests and replies. A master encodes requests and decodes replies; the Modbus TCP server and the
//! simulated drives do the opposite with these types.

mod exception;
mod reply;
mod request;

use serde::{Deserialize, Serialize};
use std::fmt;

pub use exception::Exception;
pub use reply::{Misfit, Reply, encode_exception};
pub use request::RequestPdu;

/// Largest PDU of the protocol, function code included.
pub const MAX_PDU: usize = 253;

/// The four data tables of Modbus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Table {
    /// Bits that can be read and written, 0xxxx.
    Coil,
    /// Bits that can only be read, 1xxxx.
    DiscreteInput,
    /// Registers that can only be read, 3xxxx.
    Input,
    /// Registers that can be read and written, 4xxxx.
    Holding,
}

impl Table {
    /// The function code that reads this table.
    pub fn read_function(self) -> u8 {
        match self {
            Table::Coil => 1,
            Table::DiscreteInput => 2,
            Table::Holding => 3,
            Table::Input => 4,
        }
    }

    /// Whether the items of the table are bits.
    pub fn is_bits(self) -> bool {
        matches!(self, Table::Coil | Table::DiscreteInput)
    }

    /// The name in profiles and output.
    pub fn name(self) -> &'static str {
        match self {
            Table::Coil => "coil",
            Table::DiscreteInput => "discrete-input",
            Table::Input => "input",
            Table::Holding => "holding",
        }
    }

    /// The table with this name.
    pub fn from_name(name: &str) -> Option<Table> {
        [Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding]
            .into_iter()
            .find(|t| t.name() == name)
    }

    /// Maximum number of items of the table that the protocol allows in one read.
    pub fn max_read(self) -> u16 {
        if self.is_bits() { 2000 } else { 125 }
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

fn be(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))
}

fn put(out: &mut Vec<u8>, word: u16) {
    out.extend_from_slice(&word.to_be_bytes());
}

fn words(bytes: &[u8]) -> Vec<u16> {
    let (pairs, _) = bytes.as_chunks();
    pairs.iter().copied().map(u16::from_be_bytes).collect()
}

fn pack(bits: &[bool], out: &mut Vec<u8>) {
    for chunk in bits.chunks(8) {
        out.push(
            chunk
                .iter()
                .enumerate()
                .fold(0, |byte, (i, &bit)| byte | (u8::from(bit) << i)),
        );
    }
}

fn unpack(bytes: &[u8], count: usize) -> Vec<bool> {
    (0..count)
        .map(|i| bytes.get(i / 8).is_some_and(|byte| (byte >> (i % 8)) & 1 == 1))
        .collect()
}

/// The data after the byte count at `at`, when byte count and length are both `len`.
fn counted(body: &[u8], at: usize, len: usize) -> Result<&[u8], Exception> {
    let count = usize::from(*body.get(at).ok_or(Exception::VALUE)?);
    let data = body.get(at + 1..).ok_or(Exception::VALUE)?;
    if count == len && data.len() == len {
        Ok(data)
    } else {
        Err(Exception::VALUE)
    }
}

#[cfg(test)]
mod tests;
