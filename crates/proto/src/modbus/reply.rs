//! Replies to and from bytes, each against its request.

use super::{Exception, RequestPdu, be, counted, pack, put, unpack, words};

/// A reply of a slave.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// Reply to functions 1 and 2: as many bits as requested.
    Bits(Vec<bool>),
    /// Reply to functions 3, 4 and 23: the registers.
    Registers(Vec<u16>),
    /// Reply to functions 5, 6, 15, 16 and 22, whose echo matches the request.
    Written,
    /// Reply to function 8: the data word.
    Diagnostics(u16),
    /// Reply to function 43/14: the bytes after the MEI type.
    DeviceIdentification(Vec<u8>),
    /// Reply to N2's Identify: the device type.
    Identified(u8),
    /// Reply to an N2 poll: the digits of the report, empty if nothing changed.
    Changes(Vec<u8>),
    /// Reply to a request that is not decoded: the PDU, or on N2 the line without its CR.
    Other(Vec<u8>),
    /// The drive refused the request.
    Exception(Exception),
}

impl Reply {
    /// The values that were read: registers, or bits as 0 and 1.
    pub fn words(&self) -> Option<Vec<u16>> {
        self.clone().into_words()
    }

    /// The words of the reply like [`Reply::words`], without a copy.
    pub fn into_words(self) -> Option<Vec<u16>> {
        match self {
            Reply::Registers(words) => Some(words),
            Reply::Bits(bits) => Some(bits.into_iter().map(u16::from).collect()),
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
            Reply::Other(pdu) => out.extend_from_slice(pdu),
            Reply::Identified(_) | Reply::Changes(_) => encode_exception(request.function(), Exception::FUNCTION, out),
            Reply::Written | Reply::Exception(_) => encode_echo(request, out),
        }
    }

    /// Decodes the reply in `pdu` if it matches `request`.
    ///
    /// # Errors
    /// [`Misfit`] if function, byte count or echo do not match: the frame is not the reply to this request.
    pub fn decode(request: &RequestPdu, pdu: &[u8]) -> Result<Reply, Misfit> {
        let (&function, body) = pdu.split_first().ok_or(Misfit)?;
        if function == request.function() | 0x80 {
            return match body {
                // No exception of Modbus. TECO's table has 00 for a wrong check code (reference/drives.md 5.6 and 9.8): the line
                // refuses, not the drive, and the request is repeated.
                [0] => Err(Misfit),
                [code] => Ok(Reply::Exception(Exception::Modbus(*code))),
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
            RequestPdu::Other(_) => Ok(Reply::Other(pdu.to_vec())),
            _ => {
                let mut echo = Vec::with_capacity(8);
                encode_echo(request, &mut echo);
                if echo == pdu { Ok(Reply::Written) } else { Err(Misfit) }
            }
        }
    }
}

/// The frame is valid but does not answer the request: the bus drops it and keeps waiting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Misfit;

/// Appends an exception PDU.
pub fn encode_exception(function: u8, code: Exception, out: &mut Vec<u8>) {
    out.extend_from_slice(&[function | 0x80, code.code()]);
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
