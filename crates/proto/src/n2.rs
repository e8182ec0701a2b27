//! Metasys N2 (reference/n2.md): frames of both sides, and the objects of a drive mapped onto the tables of Modbus.
//!
//! | object | table | addresses | function |
//! |---|---|---|---|
//! | BI n | discrete input | n - 1 | read of attribute 2, the state is a bit of the status byte |
//! | BO n | coil | n - 1 | the same; written by override |
//! | AI n | input register | 2 (n - 1) and the next, float, high word first | read of attribute 3 |
//! | AO n | holding register | 2 (n - 1) and the next, float, high word first | read of attribute 3; written by override |
//! | ADI n | input register | 0x4000 + n - 1 | read of attribute 2 |
//!
//! A request without an N2 object has no frame and is never sent. Behaviour that no manual specifies is listed in
//! one table, see [`ASSUMPTIONS`]. This module is the master's side; [`command`] has the frames themselves, which a
//! simulated drive decodes and answers with these types.

pub mod assumptions;
pub mod command;
pub mod object;
#[cfg(test)]
mod tests;

use std::time::Duration;

pub use assumptions::{ASSUMPTIONS, Assumption, N2Options, RegionWidth};
pub use command::{Answer, Command};
pub use object::{Object, Region};

use super::modbus::{Reply, RequestPdu, Table};
use super::{Decoded, Exception, Request};
use command::hex_value;

/// Minimum pause between two requests to one drive (reference/n2.md 4).
pub const GAP: Duration = Duration::from_millis(5);

/// Longest message, lead and CR included (reference/n2.md 4).
pub const LONGEST: usize = 256;

/// Baud rate and character format, always (reference/n2.md 1).
pub const BAUD: u32 = 9600;
/// Character format of every N2 line.
pub const FORMAT: &str = "8N1";
/// Time for the first byte of a reply (reference/n2.md 4).
pub const RESPONSE_TIMEOUT: Duration = Duration::from_millis(250);
/// Tries after the first (reference/n2.md 4: three tries).
pub const RETRIES: u32 = 2;

/// Session messages to a drive, in addition to reads and writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Session {
    /// Identify device type. A restarted drive answers no other command before this one.
    Identify,
    /// Poll of the drive for changes.
    Poll {
        /// Whether the poll acknowledges the previous report.
        again: bool,
    },
    /// Returns an overridden object to the drive's own control.
    Release {
        /// Modbus table of the object.
        table: Table,
        /// The first PDU address of the object to release.
        address: u16,
    },
}

/// The N2 command for a request; `None` if no object corresponds to the request.
pub fn command_of(pdu: &RequestPdu) -> Option<Command> {
    match pdu {
        RequestPdu::Read { table, start, count } => {
            let object = Object::containing(*table, *start).filter(|object| object.items() == *count)?;
            let attribute = object.region.value_attribute();
            Some(Command::Read { object, attribute })
        }
        RequestPdu::WriteCoil { address, on } => switch(*address, *on),
        RequestPdu::WriteCoils { start, bits } => match bits.as_slice() {
            [on] => switch(*start, *on),
            _ => None,
        },
        RequestPdu::WriteRegisters { start, values } => match values.as_slice() {
            [high, low] => {
                let object = Object::containing(Table::Holding, *start)?;
                let data = [high.to_be_bytes(), low.to_be_bytes()].concat();
                Some(Command::Override { object, data })
            }
            _ => None,
        },
        RequestPdu::N2(Session::Identify) => Some(Command::Identify),
        RequestPdu::N2(Session::Poll { again }) => Some(Command::Poll { again: *again }),
        RequestPdu::N2(Session::Release { table, address }) => {
            let object = Object::containing(*table, *address)?;
            Some(Command::Release { object })
        }
        _ => None,
    }
}

/// The request that corresponds to a master's command, the inverse of [`command_of`]; `None` if this master has no
/// such request: attributes other than a value, objects in no table, times, memory, uploads.
pub fn pdu_of(command: &Command) -> Option<RequestPdu> {
    match command {
        Command::Identify => Some(RequestPdu::N2(Session::Identify)),
        Command::Poll { again } => Some(RequestPdu::N2(Session::Poll { again: *again })),
        Command::Read { object, attribute } if *attribute == object.region.value_attribute() => {
            let (table, start) = object.place()?;
            let count = object.items();
            Some(RequestPdu::read(table, start, count))
        }
        Command::Override { object, data } => match (object.place()?, data.as_slice()) {
            ((Table::Coil, address), [value]) => Some(RequestPdu::WriteCoil {
                address,
                on: *value != 0,
            }),
            ((Table::Holding, start), [a, b, c, d]) => Some(RequestPdu::write_registers(
                start,
                &[u16::from_be_bytes([*a, *b]), u16::from_be_bytes([*c, *d])],
            )),
            _ => None,
        },
        Command::Release { object } => {
            let (table, address) = object.place()?;
            Some(RequestPdu::N2(Session::Release { table, address }))
        }
        _ => None,
    }
}

fn switch(address: u16, on: bool) -> Option<Command> {
    let object = Object::containing(Table::Coil, address)?;
    let data = vec![u8::from(on)];
    Some(Command::Override { object, data })
}

/// Appends the request's frame to `out`; nothing if the request refers to no object.
pub fn encode_request(request: &Request, out: &mut Vec<u8>) {
    match (&request.pdu, command_of(&request.pdu)) {
        (RequestPdu::Other(text), _) => command::encode_text(request.address, text, out),
        (_, Some(command)) => {
            let command = command.counted_from(request.n2.first_object);
            command.encode(request.address, request.n2.region_width, out);
        }
        (_, None) => {}
    }
}

/// Form of the data in the regular reply to a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// A status byte with the state.
    State,
    /// A float, possibly after a status byte.
    Float,
    /// 16 bits, perhaps behind a byte.
    Integer,
    /// The device type of the drive.
    Identity,
    /// The answer contains change records, possibly none.
    Changes,
    /// An acknowledgement without data.
    Acknowledgement,
    /// Any answer, for a request that is not decoded.
    Any,
}

impl Form {
    /// Whether a late reply of this form could be mistaken for one of the wanted form. A late identity is
    /// distinguished from a state by its value.
    pub fn is_like(self, wanted: Form) -> bool {
        use Form::{Acknowledgement, Any, Changes, Float, Identity, Integer, State};
        matches!(
            (self, wanted),
            (Acknowledgement | Changes, Acknowledgement | Changes)
                | (Changes, Float | Integer)
                | (Float | Integer, Changes)
                | (State, State | Identity)
                | (Identity, Identity)
                | (Integer, Integer)
                | (Float, Float)
                | (Any, _)
                | (_, Any)
        )
    }
}

/// The form of the regular reply to a request; `None` if no object corresponds to the request.
pub fn form(pdu: &RequestPdu) -> Option<Form> {
    if matches!(pdu, RequestPdu::Other(_)) {
        return Some(Form::Any);
    }
    Some(match command_of(pdu)? {
        Command::Read { object, .. } => match object.region {
            Region::Bi | Region::Bo => Form::State,
            Region::Adi => Form::Integer,
            _ => Form::Float,
        },
        Command::Identify => Form::Identity,
        Command::Poll { .. } => Form::Changes,
        _ => Form::Acknowledgement,
    })
}

/// Decodes `bytes` as the answer to `request`.
///
/// Decodes the answer to a request. A reply contains neither address nor command: only its form is compared with
/// the request. Blank characters and glitches of a line that changes direction are skipped before the first letter.
pub fn decode_reply(request: &Request, bytes: &[u8]) -> Decoded {
    let begin = bytes.iter().position(u8::is_ascii_graphic);
    if begin.unwrap_or(bytes.len()) > LONGEST {
        return Decoded::Corrupt("no reply in the longest one's characters");
    }
    let Some(begin) = begin else {
        return Decoded::Incomplete;
    };
    let frame = bytes.get(begin..).unwrap_or_default();
    let Some(length) = frame.iter().position(|byte| *byte == b'\r') else {
        return unended(frame);
    };
    let used = begin + length + 1;
    let line = frame.get(..length).unwrap_or_default();
    match line.first() {
        // The echo of a request, or another master's request: not a reply.
        Some(b'>') => Decoded::Foreign { used },
        _ => match reply_in(request, line) {
            Ok(reply) => Decoded::Reply { used, reply },
            Err(why) => Decoded::Corrupt(why),
        },
    }
}

/// Judges a line without its CR: more bytes may follow, unless the line cannot become a reply.
fn unended(frame: &[u8]) -> Decoded {
    if frame.len() > LONGEST {
        return Decoded::Corrupt("no CR in the longest reply's characters");
    }
    match frame.split_first() {
        Some((b'A' | b'a' | b'N' | b'n', rest)) if rest.iter().all(u8::is_ascii_hexdigit) => Decoded::Incomplete,
        Some((b'>', _)) => Decoded::Incomplete,
        _ => Decoded::Corrupt("the reply is not A or N and hexadecimal digits"),
    }
}

fn reply_in(request: &Request, line: &[u8]) -> Result<Reply, &'static str> {
    let answer = Answer::decode(line)?;
    let expected = form(&request.pdu).ok_or("nothing was asked")?;
    let data = match answer {
        // The drive saw a wrong checksum: the line, not the drive, refuses.
        Answer::Nak(command::CHECKSUM) => return Err("the drive saw a wrong checksum (N02)"),
        Answer::Nak(code) => return Ok(Reply::Exception(Exception::N2(code))),
        Answer::Ack | Answer::Data(_) if expected == Form::Any => return Ok(Reply::Other(line.to_vec())),
        Answer::Data(digits) if expected == Form::Changes => return Ok(Reply::Changes(digits)),
        Answer::Data(digits) => bytes_of(&digits).ok_or("an odd number of digits")?,
        Answer::Ack => Vec::new(),
    };
    let word = |high: u8, low: u8| u16::from_be_bytes([high, low]);
    match (expected, data.as_slice()) {
        (Form::Acknowledgement, []) => Ok(Reply::Written),
        (Form::Changes, []) => Ok(Reply::Changes(Vec::new())),
        (Form::Identity, [device]) => Ok(Reply::Identified(*device)),
        (Form::State, [status]) => Ok(state(*status, &request.n2)),
        (Form::Integer, [a, b] | [_, a, b]) => Ok(Reply::Registers(vec![word(*a, *b)])),
        // Any bit pattern is accepted here; NaN becomes "no value" when the point is decoded.
        (Form::Float, [a, b, c, d] | [_, a, b, c, d]) => Ok(Reply::Registers(vec![word(*a, *b), word(*c, *d)])),
        (Form::Acknowledgement, _) => Err("data where an acknowledgement was expected"),
        (_, []) => Err("an acknowledgement where data was expected"),
        (Form::Identity, _) => Err("the reply has not the length of a device type"),
        (Form::State, _) => Err("the reply has not the length of a status byte"),
        (Form::Integer, _) => Err("the reply has not the length of an integer"),
        (Form::Float, _) => Err("the reply has not the length of a float"),
        (Form::Changes | Form::Any, _) => Err("the reply is not a report of changes"),
    }
}

/// The state in a status byte. A value that the drive marks as unreliable is treated as absent.
fn state(status: u8, options: &N2Options) -> Reply {
    let bit = |number: u8| status.checked_shr(u32::from(number)).unwrap_or(0) & 1 == 1;
    if options.unreliable_bit.is_some_and(bit) {
        return Reply::Exception(Exception::DEVICE_FAILURE);
    }
    Reply::Bits(vec![bit(options.state_bit)])
}

fn bytes_of(digits: &[u8]) -> Option<Vec<u8>> {
    if !digits.len().is_multiple_of(2) {
        return None;
    }
    digits
        .chunks_exact(2)
        .map(|pair| Some(hex_value(*pair.first()?)? << 4 | hex_value(*pair.get(1)?)?))
        .collect()
}

/// Characters of the request's frame, with a region of two characters.
pub fn request_chars(request: &RequestPdu) -> usize {
    if let RequestPdu::Other(text) = request {
        return framed(2 + text.len());
    }
    let mut frame = Vec::with_capacity(24);
    if let Some(command) = command_of(request) {
        command.encode(1, RegionWidth::Two, &mut frame);
    }
    frame.len()
}

/// Characters of the longest regular reply's frame: with a byte before the value, or a full report.
pub fn reply_chars(request: &RequestPdu) -> usize {
    framed(match form(request) {
        Some(Form::Float) => 10,
        Some(Form::Integer) => 6,
        Some(Form::Changes | Form::Any) => command::LONGEST_REPORT,
        Some(Form::State | Form::Identity) => 2,
        Some(Form::Acknowledgement) | None => 0,
    })
}

/// Characters of the shortest regular reply's frame.
pub fn least_reply_chars(request: &RequestPdu) -> usize {
    framed(match form(request) {
        Some(Form::Float) => 8,
        Some(Form::Integer) => 4,
        Some(Form::State | Form::Identity) => 2,
        Some(Form::Changes | Form::Acknowledgement | Form::Any) | None => 0,
    })
}

/// Length of a frame: lead, digits with their checksum, CR.
fn framed(digits: usize) -> usize {
    if digits == 0 { 2 } else { 1 + digits + 2 + 1 }
}
