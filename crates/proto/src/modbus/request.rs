//! Encodes and decodes requests.

use super::super::n2::Session;
use super::{Exception, Table, be, counted, pack, put, unpack, words};

/// A request of a master.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RequestPdu {
    /// Read by functions 1 to 4.
    Read {
        /// The table that is read.
        table: Table,
        /// First PDU address.
        start: u16,
        /// Number of items: 1..=125 registers or 1..=2000 bits.
        count: u16,
    },
    /// Write of one coil by function 5.
    WriteCoil {
        /// PDU address.
        address: u16,
        /// State of the coil to set.
        on: bool,
    },
    /// Write of one register by function 6.
    WriteRegister {
        /// PDU address.
        address: u16,
        /// Value to write.
        value: u16,
    },
    /// Function 15.
    WriteCoils {
        /// First PDU address.
        start: u16,
        /// 1..=1968 states.
        bits: Vec<bool>,
    },
    /// Function 16.
    WriteRegisters {
        /// First PDU address.
        start: u16,
        /// 1..=123 values.
        values: Vec<u16>,
    },
    /// Function 22: `(old and and_mask) or (or_mask and not and_mask)`.
    MaskWrite {
        /// PDU address.
        address: u16,
        /// Bits of the register to keep.
        and_mask: u16,
        /// Bits to set where they are not kept.
        or_mask: u16,
    },
    /// Function 23: first writes, then reads.
    ReadWrite {
        /// First PDU address to read.
        read_start: u16,
        /// Registers to read, 1..=125.
        read_count: u16,
        /// First PDU address to write.
        write_start: u16,
        /// 1..=121 values to write.
        values: Vec<u16>,
    },
    /// Diagnostics by function 8.
    Diagnostics {
        /// Number of the subfunction.
        subfunction: u16,
        /// Data word of the subfunction.
        data: u16,
    },
    /// Function 43, MEI type 14.
    DeviceIdentification {
        /// Read device id code: 1 basic, 2 regular, 3 extended, 4 one object.
        code: u8,
        /// First object to read.
        object: u8,
    },
    /// Session commands that exist only on an N2 bus; never encoded as a Modbus function.
    N2(Session),
    /// A request that is passed on unchanged: the PDU of a function that is not decoded here, or on N2 the digits
    /// of a command between address and checksum.
    Other(Vec<u8>),
}

impl RequestPdu {
    /// Functions 1 to 4: `count` items of a table from PDU address `start`.
    pub const fn read(table: Table, start: u16, count: u16) -> RequestPdu {
        RequestPdu::Read { table, start, count }
    }

    /// Write of one holding register by function 6.
    pub const fn write_register(address: u16, value: u16) -> RequestPdu {
        RequestPdu::WriteRegister { address, value }
    }

    /// Function 16: holding registers from PDU address `start`.
    pub fn write_registers(start: u16, values: &[u16]) -> RequestPdu {
        RequestPdu::WriteRegisters {
            start,
            values: values.to_vec(),
        }
    }

    /// The function code; 0, which is not a valid code, for requests outside of Modbus.
    pub fn function(&self) -> u8 {
        match self {
            RequestPdu::Read { table, .. } => table.read_function(),
            RequestPdu::WriteCoil { .. } => 5,
            RequestPdu::WriteRegister { .. } => 6,
            RequestPdu::Diagnostics { .. } => 8,
            RequestPdu::WriteCoils { .. } => 15,
            RequestPdu::WriteRegisters { .. } => 16,
            RequestPdu::MaskWrite { .. } => 22,
            RequestPdu::ReadWrite { .. } => 23,
            RequestPdu::DeviceIdentification { .. } => 43,
            RequestPdu::N2(_) => 0,
            RequestPdu::Other(pdu) => pdu.first().copied().unwrap_or_default(),
        }
    }

    /// Whether the request changes something in the drive, as far as it can be decoded.
    pub fn is_write(&self) -> bool {
        matches!(
            self,
            RequestPdu::WriteCoil { .. }
                | RequestPdu::WriteRegister { .. }
                | RequestPdu::WriteCoils { .. }
                | RequestPdu::WriteRegisters { .. }
                | RequestPdu::MaskWrite { .. }
                | RequestPdu::ReadWrite { .. }
        )
    }

    /// Bytes of the encoded PDU.
    pub fn encoded_len(&self) -> usize {
        match self {
            RequestPdu::Read { .. } | RequestPdu::WriteCoil { .. } | RequestPdu::WriteRegister { .. } => 5,
            RequestPdu::Diagnostics { .. } => 5,
            RequestPdu::WriteCoils { bits, .. } => 6 + bits.len().div_ceil(8),
            RequestPdu::WriteRegisters { values, .. } => 6 + 2 * values.len(),
            RequestPdu::MaskWrite { .. } => 7,
            RequestPdu::ReadWrite { values, .. } => 10 + 2 * values.len(),
            RequestPdu::DeviceIdentification { .. } => 4,
            RequestPdu::N2(_) => 0,
            RequestPdu::Other(pdu) => pdu.len(),
        }
    }

    /// Length in bytes of the regular reply's PDU; its minimum if only the reply shows the length.
    pub fn reply_len(&self) -> usize {
        match self {
            RequestPdu::Read { table, count, .. } => {
                2 + if table.is_bits() {
                    usize::from(*count).div_ceil(8)
                } else {
                    2 * usize::from(*count)
                }
            }
            RequestPdu::ReadWrite { read_count, .. } => 2 + 2 * usize::from(*read_count),
            RequestPdu::MaskWrite { .. } => 7,
            RequestPdu::DeviceIdentification { .. } => 7,
            RequestPdu::Other(_) => 1,
            _ => 5,
        }
    }

    /// Appends the PDU to `out`.
    pub fn encode(&self, out: &mut Vec<u8>) {
        match self {
            RequestPdu::N2(_) => return,
            RequestPdu::Other(pdu) => return out.extend_from_slice(pdu),
            _ => out.push(self.function()),
        }
        match self {
            RequestPdu::N2(_) | RequestPdu::Other(_) => {}
            RequestPdu::Read { start, count, .. } => {
                put(out, *start);
                put(out, *count);
            }
            RequestPdu::WriteCoil { address, on } => {
                put(out, *address);
                put(out, if *on { 0xFF00 } else { 0 });
            }
            RequestPdu::WriteRegister { address, value } => {
                put(out, *address);
                put(out, *value);
            }
            RequestPdu::Diagnostics { subfunction, data } => {
                put(out, *subfunction);
                put(out, *data);
            }
            RequestPdu::WriteCoils { start, bits } => {
                put(out, *start);
                put(out, bits.len() as u16);
                out.push(bits.len().div_ceil(8) as u8);
                pack(bits, out);
            }
            RequestPdu::WriteRegisters { start, values } => {
                put(out, *start);
                put(out, values.len() as u16);
                out.push((values.len() * 2) as u8);
                values.iter().for_each(|&v| put(out, v));
            }
            RequestPdu::MaskWrite {
                address,
                and_mask,
                or_mask,
            } => {
                put(out, *address);
                put(out, *and_mask);
                put(out, *or_mask);
            }
            RequestPdu::ReadWrite {
                read_start,
                read_count,
                write_start,
                values,
            } => {
                put(out, *read_start);
                put(out, *read_count);
                put(out, *write_start);
                put(out, values.len() as u16);
                out.push((values.len() * 2) as u8);
                values.iter().for_each(|&v| put(out, v));
            }
            RequestPdu::DeviceIdentification { code, object } => out.extend_from_slice(&[14, *code, *object]),
        }
    }

    /// Decodes the request in `pdu`, as a slave does.
    ///
    /// # Errors
    /// If the slave refuses the request: the exception it answers, 01 for an unknown function, 03 for a wrong
    /// length, count or value.
    pub fn decode(pdu: &[u8]) -> Result<RequestPdu, Exception> {
        let (&function, body) = pdu.split_first().ok_or(Exception::FUNCTION)?;
        match function {
            1 => read(Table::Coil, body),
            2 => read(Table::DiscreteInput, body),
            3 => read(Table::Holding, body),
            4 => read(Table::Input, body),
            5 => match exact(body)? {
                [address, 0xFF00] => Ok(RequestPdu::WriteCoil { address, on: true }),
                [address, 0x0000] => Ok(RequestPdu::WriteCoil { address, on: false }),
                _ => Err(Exception::VALUE),
            },
            6 => exact(body).map(|[address, value]| RequestPdu::WriteRegister { address, value }),
            8 => exact(body).map(|[subfunction, data]| RequestPdu::Diagnostics { subfunction, data }),
            15 => {
                let [start, count] = head(body)?;
                let data = counted(body, 4, usize::from(count).div_ceil(8))?;
                check_span(start, count, 1968)?;
                let bits = unpack(data, usize::from(count));
                Ok(RequestPdu::WriteCoils { start, bits })
            }
            16 => {
                let [start, count] = head(body)?;
                let data = counted(body, 4, 2 * usize::from(count))?;
                check_span(start, count, 123)?;
                let values = words(data);
                Ok(RequestPdu::WriteRegisters { start, values })
            }
            22 => exact(body).map(|[address, and_mask, or_mask]| RequestPdu::MaskWrite {
                address,
                and_mask,
                or_mask,
            }),
            23 => {
                let [read_start, read_count, write_start, count] = head(body)?;
                let data = counted(body, 8, 2 * usize::from(count))?;
                check_span(read_start, read_count, 125)?;
                check_span(write_start, count, 121)?;
                Ok(RequestPdu::ReadWrite {
                    read_start,
                    read_count,
                    write_start,
                    values: words(data),
                })
            }
            43 => match *body {
                [14, code, object] => Ok(RequestPdu::DeviceIdentification { code, object }),
                [14, ..] => Err(Exception::VALUE),
                _ => Err(Exception::FUNCTION),
            },
            _ => Err(Exception::FUNCTION),
        }
    }
}

fn read(table: Table, body: &[u8]) -> Result<RequestPdu, Exception> {
    let [start, count] = exact(body)?;
    check_span(start, count, table.max_read())?;
    Ok(RequestPdu::Read { table, start, count })
}

/// The words at the beginning of `body`; an error if `body` is too short.
fn head<const N: usize>(body: &[u8]) -> Result<[u16; N], Exception> {
    let mut head = [0; N];
    for (i, word) in head.iter_mut().enumerate() {
        *word = be(body, 2 * i).ok_or(Exception::VALUE)?;
    }
    Ok(head)
}

/// The words of `body`; an error if `body` has another length.
fn exact<const N: usize>(body: &[u8]) -> Result<[u16; N], Exception> {
    if body.len() == 2 * N {
        head(body)
    } else {
        Err(Exception::VALUE)
    }
}

/// Count within 1..=max (else 03) and the span within the 65,536 addresses (else 02).
fn check_span(start: u16, count: u16, max: u16) -> Result<(), Exception> {
    if count == 0 || count > max {
        return Err(Exception::VALUE);
    }
    if u32::from(start) + u32::from(count) > 0x1_0000 {
        return Err(Exception::ADDRESS);
    }
    Ok(())
}
