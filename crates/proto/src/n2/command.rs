//! The frames: commands of a master and answers of a drive, each from both ends (reference/n2.md 1 and 2).

use super::assumptions::RegionWidth;
use super::object::{Object, Region};
use crate::ascii::digit;

/// The drive has restarted and waits for Identify.
pub const RESTARTED: u8 = 0x00;
/// Error code: the command is unknown.
pub const UNKNOWN: u8 = 0x01;
/// Error code: the checksum is wrong.
pub const CHECKSUM: u8 = 0x02;
/// The message is longer than 256 characters.
pub const OVERRUN: u8 = 0x03;
/// A field has the wrong size for the command.
pub const SIZE: u8 = 0x05;
/// A field of the command is outside its range.
pub const DATA: u8 = 0x10;
/// The command is not allowed for that type of data.
pub const TYPE: u8 = 0x11;

/// Characters of the longest report of changes (reference/n2.md 2).
pub const LONGEST_REPORT: usize = 200;

/// A command of a master.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Command {
    /// Command F: identify device type.
    Identify,
    /// Command 0/0, whose payload is unknown.
    SyncTime,
    /// Command 0/1: read memory.
    ReadMemory,
    /// 0/4 without, 0/5 with acknowledge of the report before.
    Poll {
        /// Whether the poll acknowledges the previous report.
        again: bool,
    },
    /// Command 0/8: warm reset.
    WarmReset,
    /// Command 0/9: status.
    Status,
    /// Command 1: read an attribute.
    Read {
        /// The object whose attribute is read.
        object: Object,
        /// The attribute that is read.
        attribute: u8,
    },
    /// Command 2: write an attribute.
    Write {
        /// The object whose attribute is written.
        object: Object,
        /// The attribute that is written; internal objects only have their value.
        attribute: u8,
        /// The bytes of the value, as many as were received.
        data: Vec<u8>,
    },
    /// Command 7/2: override.
    Override {
        /// The object that is overridden.
        object: Object,
        /// The value: a float, an integer or a byte.
        data: Vec<u8>,
    },
    /// Command 7/3: release.
    Release {
        /// The object that is released.
        object: Object,
    },
    /// 7/7, 7/8, 8/x, 9/x: commissioning, upload, download; not used here.
    Other,
}

/// Appends the frame of a command whose digits, between address and checksum, are `text`.
pub(super) fn encode_text(address: u8, text: &[u8], out: &mut Vec<u8>) {
    let mut body = Vec::with_capacity(2 + text.len());
    put(address, &mut body);
    body.extend_from_slice(text);
    seal(b'>', &body, out);
}

/// A command as a drive receives it: the address and the command, or the error code to return.
pub type ReceivedCommand = (u8, Result<Command, u8>);

impl Command {
    /// The command with the object numbers of a drive whose first object has that number.
    pub(super) fn counted_from(mut self, first: u8) -> Command {
        if let Command::Read { object, .. }
        | Command::Write { object, .. }
        | Command::Override { object, .. }
        | Command::Release { object } = &mut self
        {
            object.number = object.number.saturating_sub(1).saturating_add(first);
        }
        self
    }

    /// Appends the frame of the command to `out`; [`Command::Other`] has none.
    pub fn encode(&self, address: u8, width: RegionWidth, out: &mut Vec<u8>) {
        let mut body = Vec::with_capacity(24);
        put(address, &mut body);
        match self {
            Command::Identify => body.push(b'F'),
            Command::SyncTime => body.extend(*b"00"),
            Command::ReadMemory => body.extend(*b"01"),
            Command::Poll { again: false } => body.extend(*b"04"),
            Command::Poll { again: true } => body.extend(*b"05"),
            Command::WarmReset => body.extend(*b"08"),
            Command::Status => body.extend(*b"09"),
            Command::Read { object, attribute } => {
                body.push(b'1');
                put_object(*object, RegionWidth::One, &mut body);
                put(*attribute, &mut body);
            }
            Command::Write {
                object,
                attribute,
                data,
            } => {
                body.push(b'2');
                put_object(*object, RegionWidth::One, &mut body);
                if !object.region.is_internal() {
                    put(*attribute, &mut body);
                }
                data.iter().for_each(|byte| put(*byte, &mut body));
            }
            Command::Override { object, data } => {
                body.extend(*b"72");
                put_object(*object, width, &mut body);
                data.iter().for_each(|byte| put(*byte, &mut body));
            }
            Command::Release { object } => {
                body.extend(*b"73");
                put_object(*object, width, &mut body);
            }
            Command::Other => return,
        }
        seal(b'>', &body, out);
    }

    /// The command in a frame from its lead to its CR, as a drive decodes it. A new lead starts the frame again.
    /// `None` for a frame that a drive does not answer: no lead, no CR, no address, or not hexadecimal.
    pub fn decode(frame: &[u8]) -> Option<ReceivedCommand> {
        let line = frame.strip_suffix(b"\r")?;
        let lead = line.iter().rposition(|byte| *byte == b'>')?;
        let text = line.get(lead + 1..)?;
        if text.len() < 5 || !text.iter().all(u8::is_ascii_hexdigit) {
            return None;
        }
        let address = byte_at(text, 0)?;
        if line.len() - lead >= super::LONGEST {
            return Some((address, Err(OVERRUN)));
        }
        let (body, check) = text.split_at_checked(text.len() - 2)?;
        if byte_at(check, 0)? != checksum(body) {
            return Some((address, Err(CHECKSUM)));
        }
        let body = body.get(2..)?;
        Some((address, Command::of(body)))
    }

    /// The command in the digits after the address.
    fn of(body: &[u8]) -> Result<Command, u8> {
        let exactly = |command: Command, length: usize| {
            if body.len() == length { Ok(command) } else { Err(SIZE) }
        };
        match body {
            [b'F' | b'f', ..] => exactly(Command::Identify, 1),
            [b'0', b'0', ..] => Ok(Command::SyncTime),
            [b'0', b'1', ..] => Ok(Command::ReadMemory),
            [b'0', b'4', ..] => exactly(Command::Poll { again: false }, 2),
            [b'0', b'5', ..] => exactly(Command::Poll { again: true }, 2),
            [b'0', b'8', ..] => exactly(Command::WarmReset, 2),
            [b'0', b'9', ..] => exactly(Command::Status, 2),
            [b'1', region, rest @ ..] => {
                let [number, attribute] = bytes(rest)?.try_into().map_err(|_| SIZE)?;
                let object = object(hex_value(*region), number)?;
                Ok(Command::Read { object, attribute })
            }
            [b'2', region, rest @ ..] => write(*region, rest),
            [b'7', b'2', rest @ ..] => {
                let (object, data) = commanded(rest)?;
                Ok(Command::Override { object, data })
            }
            [b'7', b'3', rest @ ..] => match commanded(rest)? {
                (object, data) if data.is_empty() => Ok(Command::Release { object }),
                _ => Err(SIZE),
            },
            [b'7', b'7' | b'8', ..] | [b'8' | b'9', ..] => Ok(Command::Other),
            _ => Err(UNKNOWN),
        }
    }
}

fn write(region: u8, rest: &[u8]) -> Result<Command, u8> {
    let fields = bytes(rest)?;
    let (number, fields) = fields.split_first().ok_or(SIZE)?;
    let object = object(hex_value(region), *number)?;
    let (attribute, data) = if object.region.is_internal() {
        (object.region.value_attribute(), fields)
    } else {
        fields.split_first().map(|(first, rest)| (*first, rest)).ok_or(SIZE)?
    };
    Ok(Command::Write {
        object,
        attribute,
        data: data.to_vec(),
    })
}

/// The object of 7/2 and 7/3, and the characters after it. A region never begins with 0, so a 0 shows the form with
/// two characters.
fn commanded(rest: &[u8]) -> Result<(Object, Vec<u8>), u8> {
    let rest = rest.strip_prefix(b"0").unwrap_or(rest);
    let (region, rest) = rest.split_first().ok_or(SIZE)?;
    let fields = bytes(rest)?;
    let (number, data) = fields.split_first().ok_or(SIZE)?;
    Ok((object(hex_value(*region), *number)?, data.to_vec()))
}

fn object(region: Option<u8>, number: u8) -> Result<Object, u8> {
    let region = region.and_then(Region::from_number).ok_or(DATA)?;
    Ok(Object { region, number })
}

fn bytes(digits: &[u8]) -> Result<Vec<u8>, u8> {
    super::bytes_of(digits).ok_or(SIZE)
}

/// The reply of a drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// The command is done; to a poll: nothing new.
    Ack,
    /// An answer with hexadecimal digits.
    Data(Vec<u8>),
    /// Refused; the two printed digits of the code read as hexadecimal.
    Nak(u8),
}

impl Answer {
    /// An answer that encodes whole bytes.
    pub fn bytes(data: &[u8]) -> Answer {
        let mut digits = Vec::with_capacity(2 * data.len());
        data.iter().for_each(|byte| put(*byte, &mut digits));
        Answer::Data(digits)
    }

    /// Appends the frame of the answer to `out`.
    pub fn encode(&self, out: &mut Vec<u8>) {
        match self {
            Answer::Ack => out.extend(*b"A\r"),
            Answer::Data(digits) => seal(b'A', digits, out),
            Answer::Nak(code) => {
                out.push(b'N');
                put(*code, out);
                out.push(b'\r');
            }
        }
    }

    /// Decodes the answer in a line without its CR.
    ///
    /// # Errors
    /// If the line is not a valid answer; contains the reason.
    pub fn decode(line: &[u8]) -> Result<Answer, &'static str> {
        let (lead, text) = line.split_first().ok_or("the reply is empty")?;
        if !text.iter().all(u8::is_ascii_hexdigit) {
            return Err("the reply is not A or N and hexadecimal digits");
        }
        match (lead, text) {
            (b'A' | b'a', []) => Ok(Answer::Ack),
            (b'A' | b'a', _) => open(text).map(|digits| Answer::Data(digits.to_vec())),
            (b'N' | b'n', [_, _]) => byte_at(text, 0).map(Answer::Nak).ok_or("no error code"),
            (b'N' | b'n', [_, _, _, _]) => {
                open(text).and_then(|code| byte_at(code, 0).map(Answer::Nak).ok_or("no code"))
            }
            (b'N' | b'n', _) => Err("the refusal has not the length of an error code"),
            _ => Err("the reply starts with neither A nor N"),
        }
    }
}

/// The digits before the checksum, which must be correct.
fn open(text: &[u8]) -> Result<&[u8], &'static str> {
    let short = "the reply is too short for a checksum";
    let length = text.len().checked_sub(2).filter(|length| *length > 0).ok_or(short)?;
    let (digits, check) = text.split_at_checked(length).ok_or(short)?;
    if byte_at(check, 0) == Some(checksum(digits)) {
        Ok(digits)
    } else {
        Err("the checksum is wrong")
    }
}

/// Sum of the characters after the leading character, modulo 256 (reference/n2.md 1).
pub fn checksum(text: &[u8]) -> u8 {
    text.iter().fold(0, |sum: u8, byte| sum.wrapping_add(*byte))
}

fn seal(lead: u8, text: &[u8], out: &mut Vec<u8>) {
    out.push(lead);
    out.extend_from_slice(text);
    put(checksum(text), out);
    out.push(b'\r');
}

fn put_object(object: Object, width: RegionWidth, out: &mut Vec<u8>) {
    let region = object.region as u8;
    match width {
        RegionWidth::One => out.push(digit(region)),
        RegionWidth::Two => put(region, out),
    }
    put(object.number, out);
}

fn put(byte: u8, out: &mut Vec<u8>) {
    out.extend([digit(byte >> 4), digit(byte & 0x0F)]);
}

/// The value of a hexadecimal digit.
pub(super) fn hex_value(digit: u8) -> Option<u8> {
    char::from(digit).to_digit(16).map(|value| value as u8)
}

fn byte_at(digits: &[u8], at: usize) -> Option<u8> {
    Some(hex_value(*digits.get(at)?)? << 4 | hex_value(*digits.get(at + 1)?)?)
}
