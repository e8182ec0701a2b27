//! Frames as plain text, one line each, for people who watch a line.
//!
//! Registers are in hexadecimal as on the wire, addresses are PDU addresses, counted from 0.

mod n2_words;
mod parts;

use std::fmt::Write as _;

use super::{Decoded, Exception, Protocol, Reply, Request, RequestPdu, Table};

pub use parts::{Kind, Part, parts};

/// Values that a line shows; the bytes of the frame have the others.
const SHOWN: usize = 16;

/// The characters of a text protocol: control characters as symbols such as `␍␊`, and bytes outside of ASCII as `\xFF`.
pub fn text(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(bytes.len() + 4);
    for &byte in bytes {
        match byte {
            0x20..0x7F => text.push(char::from(byte)),
            0x00..0x20 => text.extend(char::from_u32(0x2400 + u32::from(byte))),
            0x7F => text.push('\u{2421}'),
            // Writing to a string cannot fail.
            0x80.. => drop(write!(text, "\\x{byte:02X}")),
        }
    }
    text
}

/// A request: `read holding 2100..2110`, `write holding 2000 = 0x0001`.
pub fn request(request: &RequestPdu) -> String {
    match request {
        RequestPdu::Read { table, start, count } => format!("read {}", span(*table, *start, usize::from(*count))),
        RequestPdu::WriteCoil { address, on } => {
            format!(
                "write {} = {}",
                span(Table::Coil, *address, 1),
                if *on { "on" } else { "off" }
            )
        }
        RequestPdu::WriteRegister { address, value } => {
            format!("write {} = 0x{value:04X}", span(Table::Holding, *address, 1))
        }
        RequestPdu::WriteCoils { start, bits } => {
            format!("write {} = {}", span(Table::Coil, *start, bits.len()), bit_list(bits))
        }
        RequestPdu::WriteRegisters { start, values } => {
            format!(
                "write {} = {}",
                span(Table::Holding, *start, values.len()),
                word_list(values)
            )
        }
        RequestPdu::MaskWrite {
            address,
            and_mask,
            or_mask,
        } => format!(
            "mask {}: and 0x{and_mask:04X}, or 0x{or_mask:04X}",
            span(Table::Holding, *address, 1)
        ),
        RequestPdu::ReadWrite {
            read_start,
            read_count,
            write_start,
            values,
        } => format!(
            "write {} = {}, then read {}",
            span(Table::Holding, *write_start, values.len()),
            word_list(values),
            span(Table::Holding, *read_start, usize::from(*read_count))
        ),
        RequestPdu::Diagnostics { subfunction, data } => format!("diagnostics {subfunction}: 0x{data:04X}"),
        RequestPdu::DeviceIdentification { code, object } => {
            format!("device identification: code {code} from object {object}")
        }
        RequestPdu::N2(_) => n2_words::command(request).unwrap_or_default(),
        RequestPdu::Other(pdu) => format!(
            "function {}, {} of data",
            request.function(),
            counted(pdu.len().saturating_sub(1), "byte")
        ),
    }
}

/// A request in the terms of users of the protocol: on N2 `read AI 2 value` and not `read input 2..3`.
pub fn request_on(protocol: Protocol, pdu: &RequestPdu) -> String {
    if let (Protocol::N2, RequestPdu::Other(digits)) = (protocol, pdu) {
        return format!("command {}", text(digits));
    }
    let own = (protocol == Protocol::N2).then(|| n2_words::command(pdu)).flatten();
    own.unwrap_or_else(|| request(pdu))
}

/// Describes the bytes received in a transaction, against its request: `3 registers: 0023 2000 1388`, `exception 02
/// (illegal data address)`, `foreign: address 3, function 3, 2 registers`, `7 of 27 bytes`.
pub fn reply(protocol: Protocol, asked: &Request, bytes: &[u8]) -> String {
    match protocol.decode(asked, bytes) {
        Decoded::Reply { reply, .. } if protocol == Protocol::N2 => n2_words::answer(&asked.pdu, &reply),
        Decoded::Reply { reply, .. } => answer(&reply),
        Decoded::Foreign { .. } => stray(protocol, bytes),
        Decoded::Incomplete => format!("{} of {} bytes", bytes.len(), protocol.reply_chars(&asked.pdu)),
        Decoded::Corrupt(_) => no_frame(bytes),
    }
}

/// Unrequested bytes: another device's valid frame, or noise.
pub fn stray(protocol: Protocol, bytes: &[u8]) -> String {
    if protocol == Protocol::N2 {
        return n2_words::stray(bytes);
    }
    let Some((address, pdu)) = protocol.open_frame(bytes) else {
        return no_frame(bytes);
    };
    let [function, data @ ..] = pdu.as_slice() else {
        return no_frame(bytes);
    };
    let what = match (function, data) {
        (code, [exception]) if code & 0x80 != 0 => {
            format!("function {}, {}", code & 0x7F, Exception::Modbus(*exception))
        }
        (3 | 4 | 23, [count, words @ ..]) if usize::from(*count) == words.len() && words.len() % 2 == 0 => {
            format!("function {function}, {}", counted(words.len() / 2, "register"))
        }
        _ => format!("function {function}, {} of data", counted(data.len(), "byte")),
    };
    format!("foreign: address {address}, {what}")
}

fn answer(reply: &Reply) -> String {
    match reply {
        Reply::Bits(bits) => format!("{}: {}", counted(bits.len(), "bit"), bit_list(bits)),
        Reply::Registers(words) => format!("{}: {}", counted(words.len(), "register"), word_list(words)),
        Reply::Written => "written".to_string(),
        Reply::Diagnostics(word) => format!("diagnostics: 0x{word:04X}"),
        Reply::DeviceIdentification(bytes) => identification(bytes),
        Reply::Identified(device) => format!("device type {device:02X}h"),
        Reply::Changes(digits) if digits.is_empty() => "nothing new".to_string(),
        Reply::Changes(digits) => format!("changes: {}", counted(digits.len(), "digit")),
        Reply::Other(pdu) => counted(pdu.len(), "byte"),
        Reply::Exception(code) => code.to_string(),
    }
}

/// The objects, which follow code, conformity, more-follows, next object and count.
fn identification(bytes: &[u8]) -> String {
    let mut text = "device identification".to_string();
    let mut rest = bytes.get(5..).unwrap_or_default();
    while let [id, len, more @ ..] = rest {
        let len = usize::from(*len).min(more.len());
        let (value, behind) = more.split_at(len);
        let value: String = value.iter().map(|&byte| printable(byte)).collect();
        // Writing to a string cannot fail.
        let _ = write!(text, ", {id} `{value}`");
        rest = behind;
    }
    text
}

fn printable(byte: u8) -> char {
    if byte == b' ' || byte.is_ascii_graphic() {
        char::from(byte)
    } else {
        '.'
    }
}

fn no_frame(bytes: &[u8]) -> String {
    format!("{}, no sound frame", counted(bytes.len(), "byte"))
}

fn counted(count: usize, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// `holding 2100..2110`, both ends included.
fn span(table: Table, start: u16, count: usize) -> String {
    match count {
        0 | 1 => format!("{table} {start}"),
        _ => format!("{table} {start}..{}", usize::from(start) + count - 1),
    }
}

fn word_list(words: &[u16]) -> String {
    let shown: Vec<String> = words.iter().take(SHOWN).map(|word| format!("{word:04X}")).collect();
    shown.join(" ") + more(words.len(), SHOWN)
}

/// The bits in groups of eight, the first item first.
fn bit_list(bits: &[bool]) -> String {
    let shown = bits.get(..8 * SHOWN).unwrap_or(bits);
    let groups: Vec<String> = shown
        .chunks(8)
        .map(|group| group.iter().map(|&bit| if bit { '1' } else { '0' }).collect())
        .collect();
    groups.join(" ") + more(bits.len(), 8 * SHOWN)
}

fn more(count: usize, shown: usize) -> &'static str {
    if count > shown { " …" } else { "" }
}

#[cfg(test)]
mod tests;
