//! Modbus PDUs: what RTU, ASCII and TCP share, from both ends.
//!
//! A master encodes requests and decodes replies; the Modbus TCP server and the simulated drives
//! do it the other way round with the same types.

use super::n2::Session;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Largest PDU of the protocol, function code included.
pub const MAX_PDU: usize = 253;

/// The four tables of Modbus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Table {
    /// Read and write bits, 0xxxx.
    Coil,
    /// Read-only bits, 1xxxx.
    DiscreteInput,
    /// Read-only registers, 3xxxx.
    Input,
    /// Read and write registers, 4xxxx.
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

    /// Whether its items are bits.
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

    /// The table of that name.
    pub fn from_name(name: &str) -> Option<Table> {
        [Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding]
            .into_iter()
            .find(|t| t.name() == name)
    }

    /// Most items that one request of the protocol may read.
    pub fn max_read(self) -> u16 {
        if self.is_bits() { 2000 } else { 125 }
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A Modbus exception code.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Exception(pub u8);

impl Exception {
    /// 01: the function is not known or not allowed.
    pub const FUNCTION: Exception = Exception(0x01);
    /// 02: the address is not known or not allowed.
    pub const ADDRESS: Exception = Exception(0x02);
    /// 03: the value or the count is not allowed.
    pub const VALUE: Exception = Exception(0x03);
    /// 04: the device failed.
    pub const DEVICE_FAILURE: Exception = Exception(0x04);
    /// 06: the device is busy.
    pub const BUSY: Exception = Exception(0x06);
    /// 0x0A: the gateway has no way to that unit.
    pub const GATEWAY_PATH: Exception = Exception(0x0A);
    /// 0x0B: the device behind the gateway does not answer.
    pub const GATEWAY_TARGET: Exception = Exception(0x0B);

    /// N2 error 00: the drive has restarted and waits for Identify.
    pub const N2_RESTARTED: Exception = Exception(0x80);

    /// An N2 error code (two printed digits, read as hexadecimal), kept apart from the codes of Modbus.
    pub fn n2(code: u8) -> Exception {
        Exception(0x80 | code)
    }

    /// Whether the same request would be refused again: function, address or value, not the state of the drive.
    pub fn is_about_request(self) -> bool {
        matches!(self.0, 0x01..=0x03 | 0x21 | 0x81 | 0x85 | 0x90..=0x92)
    }

    /// What the code means, by the Modbus specification and the TECO list (drives.md 5.6).
    pub fn meaning(self) -> &'static str {
        match self.0 {
            0x01 => "illegal function",
            0x02 => "illegal data address",
            0x03 => "illegal data value",
            0x04 => "device failure",
            0x05 => "acknowledge, still working",
            0x06 => "device busy",
            0x08 => "memory parity error",
            0x0A => "gateway path unavailable",
            0x0B => "device behind the gateway does not answer",
            0x21 => "data value error (TECO)",
            0x22 => "register write error: only in PRGM mode (TECO)",
            0x80 => "N2 00: the drive has restarted and waits for Identify",
            0x81 => "N2 01: command not understood",
            0x82 => "N2 02: checksum error",
            0x83 => "N2 03: message too long",
            0x85 => "N2 05: field size wrong for the command",
            0x90 => "N2 10: invalid data, out of the expected range",
            0x91 => "N2 11: invalid command for the data type, or only in PRGM mode (TECO)",
            0x92 => "N2 12: the value is read-only",
            _ => "unknown exception",
        }
    }
}

impl fmt::Display for Exception {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "exception {:02X} ({})", self.0, self.meaning())
    }
}

/// A request of a master.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RequestPdu {
    /// Functions 1 to 4.
    Read {
        /// Which table.
        table: Table,
        /// First PDU address.
        start: u16,
        /// Items, 1..=125 registers or 1..=2000 bits.
        count: u16,
    },
    /// Function 5.
    WriteCoil {
        /// PDU address.
        address: u16,
        /// State to set.
        on: bool,
    },
    /// Function 6.
    WriteRegister {
        /// PDU address.
        address: u16,
        /// Value.
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
        /// Bits to keep.
        and_mask: u16,
        /// Bits to set where not kept.
        or_mask: u16,
    },
    /// Function 23: writes, then reads.
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
    /// Function 8.
    Diagnostics {
        /// Subfunction.
        subfunction: u16,
        /// Data word.
        data: u16,
    },
    /// Function 43, MEI type 14.
    DeviceIdentification {
        /// Read device id code: 1 basic, 2 regular, 3 extended, 4 one object.
        code: u8,
        /// First object.
        object: u8,
    },
    /// What only a bus of N2 says: no function of Modbus, never encoded as one.
    N2(Session),
}

/// A reply of a slave.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// To functions 1 and 2, as many as were asked for.
    Bits(Vec<bool>),
    /// To functions 3, 4 and 23.
    Registers(Vec<u16>),
    /// To functions 5, 6, 15, 16 and 22: the echo fits the request.
    Written,
    /// To function 8: the data word.
    Diagnostics(u16),
    /// To function 43/14: the bytes after the MEI type.
    DeviceIdentification(Vec<u8>),
    /// To N2's Identify: the device type.
    Identified(u8),
    /// To a poll of N2: the digits of the report, none where nothing changed.
    Changes(Vec<u8>),
    /// Refused.
    Exception(Exception),
}

fn be(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))
}

fn put(out: &mut Vec<u8>, word: u16) {
    out.extend_from_slice(&word.to_be_bytes());
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).filter_map(|pair| be(pair, 0)).collect()
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

impl RequestPdu {
    /// The function code; 0, which is none, for what is not of Modbus.
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
        }
    }

    /// Whether the request changes something in the drive.
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
        }
    }

    /// Bytes of the regular reply's PDU; for 43/14, whose length the reply itself tells, its shortest.
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
            _ => 5,
        }
    }

    /// Appends the PDU to `out`.
    pub fn encode(&self, out: &mut Vec<u8>) {
        if matches!(self, RequestPdu::N2(_)) {
            return;
        }
        out.push(self.function());
        match self {
            RequestPdu::N2(_) => {}
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

    /// The request in `pdu`, as a slave reads it.
    ///
    /// # Errors
    /// The exception that the slave answers: 01 for a function that is not known, 03 for a wrong
    /// length, count or value.
    pub fn decode(pdu: &[u8]) -> Result<RequestPdu, Exception> {
        let (&function, body) = pdu.split_first().ok_or(Exception::FUNCTION)?;
        let word = |at| be(body, at).ok_or(Exception::VALUE);
        let exact = |len: usize| {
            if body.len() == len {
                Ok(())
            } else {
                Err(Exception::VALUE)
            }
        };
        let table = match function {
            1 => Some(Table::Coil),
            2 => Some(Table::DiscreteInput),
            3 => Some(Table::Holding),
            4 => Some(Table::Input),
            _ => None,
        };
        if let Some(table) = table {
            exact(4)?;
            let (start, count) = (word(0)?, word(2)?);
            check_span(start, count, table.max_read())?;
            return Ok(RequestPdu::Read { table, start, count });
        }
        match function {
            5 => {
                exact(4)?;
                let on = match word(2)? {
                    0xFF00 => true,
                    0x0000 => false,
                    _ => return Err(Exception::VALUE),
                };
                Ok(RequestPdu::WriteCoil { address: word(0)?, on })
            }
            6 => exact(4).and_then(|()| {
                Ok(RequestPdu::WriteRegister {
                    address: word(0)?,
                    value: word(2)?,
                })
            }),
            8 => exact(4).and_then(|()| {
                Ok(RequestPdu::Diagnostics {
                    subfunction: word(0)?,
                    data: word(2)?,
                })
            }),
            15 => {
                let (start, count) = (word(0)?, word(2)?);
                let data = counted(body, 4, usize::from(count).div_ceil(8))?;
                check_span(start, count, 1968)?;
                Ok(RequestPdu::WriteCoils {
                    start,
                    bits: unpack(data, usize::from(count)),
                })
            }
            16 => {
                let (start, count) = (word(0)?, word(2)?);
                let data = counted(body, 4, 2 * usize::from(count))?;
                check_span(start, count, 123)?;
                Ok(RequestPdu::WriteRegisters {
                    start,
                    values: words(data),
                })
            }
            22 => {
                exact(6)?;
                Ok(RequestPdu::MaskWrite {
                    address: word(0)?,
                    and_mask: word(2)?,
                    or_mask: word(4)?,
                })
            }
            23 => {
                let (read_start, read_count, write_start, count) = (word(0)?, word(2)?, word(4)?, word(6)?);
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
            43 => match body {
                [14, code, object] => Ok(RequestPdu::DeviceIdentification {
                    code: *code,
                    object: *object,
                }),
                [14, ..] => Err(Exception::VALUE),
                _ => Err(Exception::FUNCTION),
            },
            _ => Err(Exception::FUNCTION),
        }
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

impl Reply {
    /// What was read: registers, or bits as 0 and 1.
    pub fn words(&self) -> Option<Vec<u16>> {
        match self {
            Reply::Registers(words) => Some(words.clone()),
            Reply::Bits(bits) => Some(bits.iter().map(|bit| u16::from(*bit)).collect()),
            _ => None,
        }
    }

    /// Appends the reply's PDU to `request` onto `out`.
    pub fn encode(&self, request: &RequestPdu, out: &mut Vec<u8>) {
        if let Reply::Exception(code) = self {
            encode_exception(request.function(), *code, out);
            return;
        }
        match self {
            Reply::Bits(bits) => {
                out.push(request.function());
                out.push(bits.len().div_ceil(8) as u8);
                pack(bits, out);
            }
            Reply::Registers(values) => {
                out.push(request.function());
                out.push((values.len() * 2) as u8);
                values.iter().for_each(|&v| put(out, v));
            }
            Reply::Diagnostics(data) => {
                if let RequestPdu::Diagnostics { subfunction, .. } = request {
                    RequestPdu::Diagnostics {
                        subfunction: *subfunction,
                        data: *data,
                    }
                    .encode(out);
                }
            }
            Reply::DeviceIdentification(body) => {
                out.extend_from_slice(&[43, 14]);
                out.extend_from_slice(body);
            }
            Reply::Identified(_) | Reply::Changes(_) => encode_exception(request.function(), Exception::FUNCTION, out),
            Reply::Written | Reply::Exception(_) => encode_echo(request, out),
        }
    }

    /// What the slave said in `pdu`, if it fits `request`.
    ///
    /// # Errors
    /// [`Misfit`] when function, byte count or echo do not fit: the frame answers something else.
    pub fn decode(request: &RequestPdu, pdu: &[u8]) -> Result<Reply, Misfit> {
        let (&function, body) = pdu.split_first().ok_or(Misfit)?;
        if function == request.function() | 0x80 {
            return match body {
                [code] => Ok(Reply::Exception(Exception(*code))),
                _ => Err(Misfit),
            };
        }
        if function != request.function() {
            return Err(Misfit);
        }
        match request {
            RequestPdu::Read { table, count, .. } if table.is_bits() => {
                let data = counted(body, 0, usize::from(*count).div_ceil(8)).map_err(|_| Misfit)?;
                Ok(Reply::Bits(unpack(data, usize::from(*count))))
            }
            RequestPdu::Read { count, .. } | RequestPdu::ReadWrite { read_count: count, .. } => {
                let data = counted(body, 0, 2 * usize::from(*count)).map_err(|_| Misfit)?;
                Ok(Reply::Registers(words(data)))
            }
            RequestPdu::Diagnostics { subfunction, .. } => {
                if body.len() == 4 && be(body, 0) == Some(*subfunction) {
                    be(body, 2).map(Reply::Diagnostics).ok_or(Misfit)
                } else {
                    Err(Misfit)
                }
            }
            RequestPdu::DeviceIdentification { .. } => match body {
                [14, rest @ ..] if rest.len() >= 5 => Ok(Reply::DeviceIdentification(rest.to_vec())),
                _ => Err(Misfit),
            },
            _ => {
                let mut echo = Vec::with_capacity(8);
                encode_echo(request, &mut echo);
                if echo == pdu { Ok(Reply::Written) } else { Err(Misfit) }
            }
        }
    }
}

/// The frame is sound but no answer to the request: the bus drops it and waits on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Misfit;

/// Appends an exception PDU.
pub fn encode_exception(function: u8, code: Exception, out: &mut Vec<u8>) {
    out.extend_from_slice(&[function | 0x80, code.0]);
}

/// Writes of one item are echoed whole, of several by their first five bytes.
fn encode_echo(request: &RequestPdu, out: &mut Vec<u8>) {
    match request {
        RequestPdu::WriteCoils { start, bits } => {
            out.push(15);
            put(out, *start);
            put(out, bits.len() as u16);
        }
        RequestPdu::WriteRegisters { start, values } => {
            out.push(16);
            put(out, *start);
            put(out, values.len() as u16);
        }
        _ => request.encode(out),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn decode_bytes(bytes: &[u8]) -> Result<RequestPdu, Exception> {
        RequestPdu::decode(bytes)
    }

    #[test]
    fn refused_requests() {
        assert_eq!(decode_bytes(&[]), Err(Exception::FUNCTION));
        assert_eq!(decode_bytes(&[0x41]), Err(Exception::FUNCTION));
        assert_eq!(decode_bytes(&[3, 0, 0, 0, 0]), Err(Exception::VALUE), "quantity 0");
        assert_eq!(decode_bytes(&[3, 0, 0, 0, 126]), Err(Exception::VALUE), "126 registers");
        assert_eq!(
            decode_bytes(&[3, 0xFF, 0xFF, 0, 2]),
            Err(Exception::ADDRESS),
            "past the end"
        );
        assert_eq!(decode_bytes(&[3, 0, 0, 0]), Err(Exception::VALUE), "short");
        assert_eq!(decode_bytes(&[5, 0, 0, 1, 0]), Err(Exception::VALUE), "coil value");
        assert_eq!(
            decode_bytes(&[16, 0, 0, 0, 1, 3, 0, 0, 0]),
            Err(Exception::VALUE),
            "odd byte count"
        );
        assert_eq!(
            decode_bytes(&[15, 0, 0, 0, 100, 1, 0]),
            Err(Exception::VALUE),
            "100 coils in one byte"
        );
        assert_eq!(decode_bytes(&[43, 13, 1, 0]), Err(Exception::FUNCTION));
    }

    fn any_request() -> impl Strategy<Value = RequestPdu> {
        let table = prop_oneof![
            Just(Table::Coil),
            Just(Table::DiscreteInput),
            Just(Table::Input),
            Just(Table::Holding)
        ];
        prop_oneof![
            (table, 0u16..60_000, 1u16..=125).prop_map(|(table, start, count)| RequestPdu::Read {
                table,
                start,
                count
            }),
            (any::<u16>(), any::<bool>()).prop_map(|(address, on)| RequestPdu::WriteCoil { address, on }),
            (any::<u16>(), any::<u16>()).prop_map(|(address, value)| RequestPdu::WriteRegister { address, value }),
            (0u16..60_000, prop::collection::vec(any::<bool>(), 1..1968))
                .prop_map(|(start, bits)| RequestPdu::WriteCoils { start, bits }),
            (0u16..60_000, prop::collection::vec(any::<u16>(), 1..=123))
                .prop_map(|(start, values)| RequestPdu::WriteRegisters { start, values }),
            (any::<u16>(), any::<u16>(), any::<u16>()).prop_map(|(address, and_mask, or_mask)| RequestPdu::MaskWrite {
                address,
                and_mask,
                or_mask
            }),
            (
                0u16..60_000,
                1u16..=125,
                0u16..60_000,
                prop::collection::vec(any::<u16>(), 1..=121)
            )
                .prop_map(|(read_start, read_count, write_start, values)| RequestPdu::ReadWrite {
                    read_start,
                    read_count,
                    write_start,
                    values
                }),
            (any::<u16>(), any::<u16>()).prop_map(|(subfunction, data)| RequestPdu::Diagnostics { subfunction, data }),
            (any::<u8>(), any::<u8>()).prop_map(|(code, object)| RequestPdu::DeviceIdentification { code, object }),
        ]
    }

    fn regular_reply(request: &RequestPdu) -> Reply {
        match request {
            RequestPdu::Read { table, count, .. } if table.is_bits() => {
                Reply::Bits((0..*count).map(|i| i % 3 == 0).collect())
            }
            RequestPdu::Read { count, .. } | RequestPdu::ReadWrite { read_count: count, .. } => {
                Reply::Registers((0..*count).collect())
            }
            RequestPdu::Diagnostics { .. } => Reply::Diagnostics(7),
            RequestPdu::DeviceIdentification { .. } => Reply::DeviceIdentification(vec![1, 1, 0, 0, 0]),
            _ => Reply::Written,
        }
    }

    proptest! {
        #[test]
        fn requests_and_replies_survive_the_round_trip(request in any_request()) {
            let mut bytes = Vec::new();
            request.encode(&mut bytes);
            prop_assert_eq!(bytes.len(), request.encoded_len());
            prop_assert!(bytes.len() <= MAX_PDU);
            prop_assert_eq!(RequestPdu::decode(&bytes), Ok(request.clone()));

            let reply = regular_reply(&request);
            let mut bytes = Vec::new();
            reply.encode(&request, &mut bytes);
            prop_assert_eq!(bytes.len(), request.reply_len());
            prop_assert_eq!(Reply::decode(&request, &bytes), Ok(reply));
        }

        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..300), request in any_request()) {
            let _ = RequestPdu::decode(&bytes);
            let _ = Reply::decode(&request, &bytes);
        }
    }
}
