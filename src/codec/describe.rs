//! Frames in plain words, one line each, for people who look at a line.
//!
//! Registers are in hexadecimal as on the wire, addresses are PDU addresses, counted from 0.

use std::fmt::Write as _;
use std::ops::Range;

use super::n2::Region;
use super::{Decoded, Exception, Protocol, Reply, Request, RequestPdu, Table, n2};

/// Values that a line shows; the bytes of the frame have the others.
const SHOWN: usize = 16;

/// What some bytes of an exchange are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The request, sent back by an adapter that hears itself.
    Echo,
    /// The reply to the request, perhaps an exception.
    Reply,
    /// A sound frame of somebody else.
    Foreign,
    /// No sound frame.
    Garbage,
}

/// A part of what was received in an exchange.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// What it is.
    pub kind: Kind,
    /// Where it stands among the bytes.
    pub range: Range<usize>,
}

/// Splits what came after `request`, whose frame was `frame`, into its parts, in the order of arrival. `answered`: the
/// exchange ended with a reply, which tells the reply to a write from an echo of it.
pub fn parts(protocol: Protocol, request: &Request, frame: &[u8], bytes: &[u8], answered: bool) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut at = 0;
    let mut echo_seen = false;
    while let Some(rest) = bytes.get(at..).filter(|rest| !rest.is_empty()) {
        let noise = protocol.noise(rest);
        let (kind, used) = match protocol.decode(request, rest) {
            _ if noise > 0 => (Kind::Garbage, noise),
            _ if !echo_seen && is_echo(protocol, request, frame, rest, answered) => (Kind::Echo, frame.len()),
            Decoded::Reply { used, .. } => (Kind::Reply, used),
            Decoded::Foreign { used } => (Kind::Foreign, used),
            Decoded::Incomplete | Decoded::Corrupt(_) => {
                (Kind::Garbage, garbage_len(protocol, request, rest, answered))
            }
        };
        echo_seen |= kind == Kind::Echo;
        // Never empty, so that the loop ends.
        let end = (at + used.max(1)).min(bytes.len());
        parts.push(Part { kind, range: at..end });
        at = end;
        if kind == Kind::Reply {
            break;
        }
    }
    if at < bytes.len() {
        parts.push(Part {
            kind: behind(protocol, bytes.get(at..).unwrap_or_default()),
            range: at..bytes.len(),
        });
    }
    parts
}

/// Most requests cannot be answered by their own frame; the write of one register is, so there only a second frame, or
/// the lack of an answer, tells.
fn is_echo(protocol: Protocol, request: &Request, frame: &[u8], rest: &[u8], answered: bool) -> bool {
    let Some(more) = rest.strip_prefix(frame).filter(|_| !frame.is_empty()) else {
        return false;
    };
    let like_its_reply = matches!(protocol.decode(request, frame), Decoded::Reply { .. });
    !like_its_reply || !answered || more.starts_with(frame)
}

/// Bytes until the reply that was believed although it stands behind garbage, or all. Exceptions and acknowledgements are
/// not believed there.
fn garbage_len(protocol: Protocol, request: &Request, rest: &[u8], answered: bool) -> usize {
    let is_reply = |at: &usize| {
        let behind = rest.get(*at..).unwrap_or_default();
        let begins = |&first: &u8| protocol.may_begin_behind_garbage(request.address, first);
        if !behind.first().is_some_and(begins) {
            return false;
        }
        match protocol.decode(request, behind) {
            Decoded::Reply { reply, .. } => !matches!(reply, Reply::Exception(_)),
            _ => false,
        }
    };
    let believed = answered && matches!(request.pdu, RequestPdu::Read { .. });
    let at = (1..rest.len()).find(is_reply).filter(|_| believed);
    at.unwrap_or(rest.len())
}

fn behind(protocol: Protocol, bytes: &[u8]) -> Kind {
    match protocol.open_frame(bytes) {
        Some(_) => Kind::Foreign,
        None if protocol == Protocol::N2 && n2_answer_in(bytes) => Kind::Foreign,
        None => Kind::Garbage,
    }
}

/// The characters of a protocol that is text: control characters by their pictures, such as `␍␊`, and what is none of
/// ASCII as `\xFF`.
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
        RequestPdu::N2(_) => n2_command(request).unwrap_or_default(),
    }
}

/// A request as that protocol's users know it: `read AI 2 value` and not `read input 2..3` on N2.
pub fn request_on(protocol: Protocol, pdu: &RequestPdu) -> String {
    let own = (protocol == Protocol::N2).then(|| n2_command(pdu)).flatten();
    own.unwrap_or_else(|| request(pdu))
}

/// A command of N2: `read AI 2 value`, `override AO 1 = 50`, `identify`.
fn n2_command(pdu: &RequestPdu) -> Option<String> {
    use n2::Command;
    Some(match n2::command_of(pdu)? {
        Command::Identify => "identify".to_string(),
        Command::Poll { again: false } => "poll for changes".to_string(),
        Command::Poll { again: true } => "poll for changes, acknowledged".to_string(),
        Command::Read { object, .. } => match object.region {
            Region::Bi | Region::Bo => format!("read {object} state"),
            _ => format!("read {object} value"),
        },
        Command::Override { object, data } => match data.as_slice() {
            [a, b, c, d] => format!("override {object} = {}", f32::from_be_bytes([*a, *b, *c, *d])),
            [byte] => format!("override {object} = {byte}"),
            _ => format!("override {object}"),
        },
        Command::Release { object } => format!("release {object}"),
        _ => return None,
    })
}

/// What came back, against its request: `3 registers: 0023 2000 1388`, `exception 02 (illegal data address)`,
/// `foreign: address 3, function 3, 2 registers`, `7 of 27 bytes`.
pub fn reply(protocol: Protocol, asked: &Request, bytes: &[u8]) -> String {
    match protocol.decode(asked, bytes) {
        Decoded::Reply { reply, .. } if protocol == Protocol::N2 => n2_answer(&asked.pdu, &reply),
        Decoded::Reply { reply, .. } => answer(&reply),
        Decoded::Foreign { .. } => stray(protocol, bytes),
        Decoded::Incomplete => format!("{} of {} bytes", bytes.len(), protocol.reply_chars(&asked.pdu)),
        Decoded::Corrupt(_) => no_frame(bytes),
    }
}

/// Bytes that nobody asked for: a sound frame of somebody else, or noise.
pub fn stray(protocol: Protocol, bytes: &[u8]) -> String {
    if protocol == Protocol::N2 {
        return n2_stray(bytes);
    }
    let Some((address, pdu)) = protocol.open_frame(bytes) else {
        return no_frame(bytes);
    };
    let [function, data @ ..] = pdu.as_slice() else {
        return no_frame(bytes);
    };
    let what = match (function, data) {
        (code, [exception]) if code & 0x80 != 0 => {
            format!("function {}, {}", code & 0x7F, Exception(*exception))
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
        Reply::Exception(code) => code.to_string(),
    }
}

/// A reply of N2 in the words of its object: `25`, `on`, `acknowledged`, `N11 (…)`.
fn n2_answer(asked: &RequestPdu, reply: &Reply) -> String {
    match reply {
        Reply::Bits(bits) => if bits.first() == Some(&true) { "on" } else { "off" }.to_string(),
        Reply::Registers(words) => match words.as_slice() {
            [high, low] => f32::from_bits(u32::from(*high) << 16 | u32::from(*low)).to_string(),
            [word] => (*word as i16).to_string(),
            _ => answer(reply),
        },
        Reply::Written => "acknowledged".to_string(),
        Reply::Exception(code) if code.0 & 0x80 != 0 => code.meaning().replacen("N2 ", "N", 1),
        // Not the drive's words: its own state was called unreliable.
        Reply::Exception(_) if matches!(asked, RequestPdu::Read { .. }) => "unreliable".to_string(),
        _ => answer(reply),
    }
}

/// A line that nobody asked for: a request of another master, or an answer that came late.
fn n2_stray(bytes: &[u8]) -> String {
    if let Some((address, Ok(_))) = n2::Command::decode(bytes) {
        return format!("foreign: a request to address {address}");
    }
    if n2_answer_in(bytes) {
        return "foreign: an answer that nobody asked for, or too late".to_string();
    }
    no_frame(bytes)
}

/// Whether the bytes are one sound answer of N2.
fn n2_answer_in(bytes: &[u8]) -> bool {
    bytes
        .strip_suffix(b"\r")
        .is_some_and(|line| n2::Answer::decode(line).is_ok())
}

/// The objects behind code, conformity, more-follows, next object and count.
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

/// In groups of eight, the first item first.
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
mod tests {
    use super::super::{ascii, rtu};
    use super::*;
    use proptest::prelude::*;

    const RTU: Protocol = Protocol::ModbusRtu;

    fn hex(text: &str) -> Vec<u8> {
        text.split_whitespace()
            .map(|b| u8::from_str_radix(b, 16).unwrap())
            .collect()
    }

    fn asked(frame: &str) -> Request {
        let (address, pdu) = rtu::decode_request(&hex(frame)).unwrap();
        Request {
            address,
            pdu: pdu.unwrap(),
            n2: Default::default(),
        }
    }

    fn framed(address: u8, pdu: &str) -> Vec<u8> {
        let mut out = Vec::new();
        rtu::encode_frame(address, &hex(pdu), &mut out);
        out
    }

    /// Worked requests of drives.md, section 7, misprints corrected.
    #[test]
    fn requests_of_the_reference() {
        for (frame, text) in [
            ("01 03 07 D0 00 03 05 46", "read holding 2000..2002"),
            ("01 04 07 D0 00 01 31 47", "read input 2000"),
            ("01 06 07 D0 00 01 48 87", "write holding 2000 = 0x0001"),
            ("01 06 07 D2 EC 78 64 65", "write holding 2002 = 0xEC78"),
            (
                "01 10 07 D0 00 03 06 00 01 00 00 13 88 C8 CB",
                "write holding 2000..2002 = 0001 0000 1388",
            ),
            ("01 03 08 34 00 0B 47 A3", "read holding 2100..2110"),
            ("01 05 00 00 FF 00 8C 3A", "write coil 0 = on"),
            ("01 05 00 00 00 00 CD CA", "write coil 0 = off"),
            ("01 02 00 02 00 01 18 0A", "read discrete-input 2"),
        ] {
            assert_eq!(request(&asked(frame).pdu), text, "{frame}");
        }
    }

    #[test]
    fn the_other_requests() {
        for (pdu, text) in [
            (
                RequestPdu::WriteCoils {
                    start: 8,
                    bits: vec![true, false, true, true, false, false, false, false, true],
                },
                "write coil 8..16 = 10110000 1",
            ),
            (
                RequestPdu::MaskWrite {
                    address: 2000,
                    and_mask: 0xFFF2,
                    or_mask: 4,
                },
                "mask holding 2000: and 0xFFF2, or 0x0004",
            ),
            (
                RequestPdu::ReadWrite {
                    read_start: 2100,
                    read_count: 11,
                    write_start: 2002,
                    values: vec![5000],
                },
                "write holding 2002 = 1388, then read holding 2100..2110",
            ),
            (
                RequestPdu::Diagnostics {
                    subfunction: 0,
                    data: 0xA537,
                },
                "diagnostics 0: 0xA537",
            ),
            (
                RequestPdu::DeviceIdentification { code: 1, object: 0 },
                "device identification: code 1 from object 0",
            ),
            (
                RequestPdu::Read {
                    table: Table::Holding,
                    start: u16::MAX,
                    count: 2,
                },
                "read holding 65535..65536",
            ),
        ] {
            assert_eq!(request(&pdu), text);
        }
    }

    #[test]
    fn replies() {
        let eleven = format!("03 16 {}", "00 23 ".repeat(11));
        for (asked_for, pdu, text) in [
            (
                "03 07 D0 00 03",
                "03 06 00 23 20 00 13 88",
                "3 registers: 0023 2000 1388",
            ),
            ("04 07 D0 00 01", "04 02 00 23", "1 register: 0023"),
            (
                "03 08 34 00 0B",
                eleven.as_str(),
                "11 registers: 0023 0023 0023 0023 0023 0023 0023 0023 0023 0023 0023",
            ),
            ("01 00 00 00 0A", "01 02 05 02", "10 bits: 10100000 01"),
            ("06 07 D0 00 01", "06 07 D0 00 01", "written"),
            ("10 07 D0 00 01 02 00 01", "10 07 D0 00 01", "written"),
            ("03 17 70 00 05", "83 02", "exception 02 (illegal data address)"),
            ("08 00 00 A5 37", "08 00 00 A5 37", "diagnostics: 0xA537"),
            (
                "2B 0E 01 00",
                "2B 0E 01 01 00 00 02 00 02 4E 58 01 01 07",
                "device identification, 0 `NX`, 1 `.`",
            ),
        ] {
            let (address, decoded) = rtu::decode_request(&framed(1, asked_for)).unwrap();
            let asked = Request {
                address,
                pdu: decoded.unwrap(),
                n2: Default::default(),
            };
            assert_eq!(reply(RTU, &asked, &framed(1, pdu)), text);
        }
    }

    #[test]
    fn what_is_no_reply() {
        let asked = asked("01 03 07 D0 00 03 05 46");
        for (bytes, text) in [
            (
                framed(3, "03 04 00 01 00 02"),
                "foreign: address 3, function 3, 2 registers",
            ),
            (
                framed(3, "83 02"),
                "foreign: address 3, function 3, exception 02 (illegal data address)",
            ),
            (
                framed(1, "04 06 00 01 00 02 00 03"),
                "foreign: address 1, function 4, 3 registers",
            ),
            (framed(1, "03 02 00 01"), "foreign: address 1, function 3, 1 register"),
            (
                framed(1, "06 07 D0 00 01"),
                "foreign: address 1, function 6, 4 bytes of data",
            ),
            (hex("01 03 06 00"), "4 of 11 bytes"),
            (hex("01 03 06 00 23 20 00 13 88 00 00"), "11 bytes, no sound frame"),
            (Vec::new(), "0 of 11 bytes"),
        ] {
            assert_eq!(reply(RTU, &asked, &bytes), text);
        }
        assert_eq!(stray(RTU, &hex("FF")), "1 byte, no sound frame");
        assert_eq!(
            stray(RTU, &framed(2, "03 02 00 01")),
            "foreign: address 2, function 3, 1 register"
        );
    }

    #[test]
    fn long_lists_end() {
        let words: Vec<u16> = (0..17).collect();
        assert!(word_list(&words).ends_with("000E 000F …"));
        assert!(word_list(&words[..16]).ends_with("000E 000F"));
        assert!(bit_list(&[true; 129]).ends_with("1 …"));
    }

    fn kinds(asked: &Request, bytes: &[u8], answered: bool) -> Vec<(Kind, usize)> {
        let mut frame = Vec::new();
        RTU.encode(asked, &mut frame);
        parts(RTU, asked, &frame, bytes, answered)
            .into_iter()
            .map(|part| (part.kind, part.range.len()))
            .collect()
    }

    #[test]
    fn an_exchange_in_its_parts() {
        let read = asked("01 03 07 D0 00 01 84 87");
        let echo = hex("01 03 07 D0 00 01 84 87");
        let (own, other) = (framed(1, "03 02 00 23"), framed(3, "03 02 00 23"));
        assert_eq!(kinds(&read, &own, true), [(Kind::Reply, 7)]);
        let all = [echo.as_slice(), &other, &own, &[0xFF]].concat();
        assert_eq!(
            kinds(&read, &all, true),
            [
                (Kind::Echo, 8),
                (Kind::Foreign, 7),
                (Kind::Reply, 7),
                (Kind::Garbage, 1)
            ]
        );
        let noisy = [&[0xFF, 0x00], own.as_slice(), &other].concat();
        assert_eq!(
            kinds(&read, &noisy, true),
            [(Kind::Garbage, 2), (Kind::Reply, 7), (Kind::Foreign, 7)]
        );
        assert_eq!(kinds(&read, &own[..5], false), [(Kind::Garbage, 5)]);
        assert_eq!(kinds(&read, &[], false), []);

        let write = asked("01 06 07 D0 00 01 48 87");
        let frame = hex("01 06 07 D0 00 01 48 87");
        assert_eq!(kinds(&write, &frame, true), [(Kind::Reply, 8)]);
        assert_eq!(kinds(&write, &frame, false), [(Kind::Echo, 8)]);
        let twice = [frame.as_slice(), &frame].concat();
        assert_eq!(kinds(&write, &twice, true), [(Kind::Echo, 8), (Kind::Reply, 8)]);
        let write = asked("01 10 07 D0 00 02 04 00 01 00 10 88 CF");
        let all = [
            hex("01 10 07 D0 00 02 04 00 01 00 10 88 CF"),
            framed(1, "10 07 D0 00 02"),
        ]
        .concat();
        assert_eq!(kinds(&write, &all, true), [(Kind::Echo, 13), (Kind::Reply, 8)]);
        assert_eq!(kinds(&read, &noisy, false), [(Kind::Garbage, 16)]);
    }

    /// What the parts of an exchange in Modbus ASCII are.
    fn in_ascii(asked: &Request, bytes: &[u8], answered: bool) -> Vec<(Kind, usize)> {
        let mut frame = Vec::new();
        ascii::encode_request(asked, &mut frame);
        parts(Protocol::ModbusAscii, asked, &frame, bytes, answered)
            .into_iter()
            .map(|part| (part.kind, part.range.len()))
            .collect()
    }

    #[test]
    fn ascii_exchanges_in_their_parts_and_words() {
        let ask = |text: &[u8]| {
            let (address, pdu) = ascii::decode_request(text).unwrap();
            Request {
                address,
                pdu: pdu.unwrap(),
                n2: Default::default(),
            }
        };
        let echo = b":010300200002DA\r\n";
        let read = ask(echo);
        let own = b":01030400050000F3\r\n".as_slice();
        let other = b":0203020023D6\r\n".as_slice();
        assert_eq!(in_ascii(&read, own, true), [(Kind::Reply, 19)]);
        let all = [b"\xFF0:", echo.as_slice(), other, own, b":0"].concat();
        assert_eq!(
            in_ascii(&read, &all, true),
            [
                (Kind::Garbage, 3),
                (Kind::Echo, 17),
                (Kind::Foreign, 15),
                (Kind::Reply, 19),
                (Kind::Garbage, 2)
            ]
        );
        let broken = [b":01030400050000F4\r\n", own, other].concat();
        assert_eq!(
            in_ascii(&read, &broken, true),
            [(Kind::Garbage, 19), (Kind::Reply, 19), (Kind::Foreign, 15)]
        );
        assert_eq!(in_ascii(&read, b"\x80\x81", false), [(Kind::Garbage, 2)]);
        assert_eq!(in_ascii(&read, &own[..7], false), [(Kind::Garbage, 7)]);

        let words = |bytes| reply(Protocol::ModbusAscii, &read, bytes);
        assert_eq!(words(own), "2 registers: 0005 0000");
        assert_eq!(words(b":0183027A\r\n"), "exception 02 (illegal data address)");
        assert_eq!(words(other), "foreign: address 2, function 3, 1 register");
        assert_eq!(words(&own[..7]), "7 of 19 bytes");
        assert_eq!(words(b":01030400050000F4\r\n"), "19 bytes, no sound frame");
    }

    #[test]
    fn text_is_shown_as_text() {
        assert_eq!(text(b":010300200002DA\r\n"), ":010300200002DA\u{240D}\u{240A}");
        assert_eq!(
            text(&[0, 0x1B, b' ', 0x7F, 0x80, 0xFF]),
            "\u{2400}\u{241B} \u{2421}\\x80\\xFF"
        );
        assert_eq!(text(b""), "");
    }

    proptest! {
        #[test]
        fn any_bytes_have_words_and_parts(
            bytes in proptest::collection::vec(prop_oneof![any::<u8>(), Just(b':'), Just(b'\n')], 0..300),
            answered: bool,
            protocol in prop_oneof![Just(RTU), Just(Protocol::ModbusAscii)],
        ) {
            let asked = asked("01 03 07 D0 00 03 05 46");
            prop_assert!(!reply(protocol, &asked, &bytes).is_empty());
            prop_assert!(!stray(protocol, &bytes).is_empty());
            let mut frame = Vec::new();
            protocol.encode(&asked, &mut frame);
            let mut at = 0;
            for part in parts(protocol, &asked, &frame, &bytes, answered) {
                prop_assert_eq!(part.range.start, at);
                prop_assert!(part.range.end > at);
                at = part.range.end;
            }
            prop_assert_eq!(at, bytes.len());
        }
    }

    #[test]
    fn n2_in_the_words_of_its_objects() {
        let read = |table, start, count| RequestPdu::Read { table, start, count };
        let ao = RequestPdu::WriteRegisters {
            start: 0,
            values: vec![0x4248, 0],
        };
        let bo = RequestPdu::WriteCoil { address: 0, on: true };
        let (table, address) = (Table::Holding, 0);
        let cases = [
            (read(Table::Input, 2, 2), "A41C80000A0\r", "read AI 2 value", "25"),
            (read(Table::DiscreteInput, 1, 1), "A4064\r", "read BI 2 state", "on"),
            (read(Table::Input, 0x4000, 1), "A0035C8\r", "read ADI 1 value", "53"),
            (ao, "A\r", "override AO 1 = 50", "acknowledged"),
            (
                bo,
                "N11\r",
                "override BO 1 = 1",
                "N11: invalid command for the data type, or only in PRGM mode (TECO)",
            ),
            (
                RequestPdu::N2(n2::Session::Release { table, address }),
                "A\r",
                "release AO 1",
                "acknowledged",
            ),
            (
                RequestPdu::N2(n2::Session::Identify),
                "A1061\r",
                "identify",
                "device type 10h",
            ),
            (
                RequestPdu::N2(n2::Session::Poll { again: false }),
                "A\r",
                "poll for changes",
                "nothing new",
            ),
        ];
        for (pdu, bytes, asked, told) in cases {
            assert_eq!(request_on(Protocol::N2, &pdu), asked);
            assert_eq!(reply(Protocol::N2, &Request::new(1, pdu), bytes.as_bytes()), told);
        }
        assert_eq!(stray(Protocol::N2, b">01FA7\r"), "foreign: a request to address 1");
        assert_eq!(
            stray(Protocol::N2, b"A1061\r"),
            "foreign: an answer that nobody asked for, or too late"
        );
    }
}
