//! Modbus ASCII frames: colon, hexadecimal digits, LRC, CR LF (reference/drives.md 5.1, worked frames section 7.3).
//!
//! Modbus ASCII. A frame has a definite start and end, so anything outside of it is recognised at once: characters
//! before a colon are noise, and a colon inside a frame starts it again. Digits are sent in upper case and accepted
//! in either case. Only a slave needs the pause of 1 s between two characters that ends a frame; a master has its
//! deadline.

use super::checksum::lrc;
use super::modbus::{MAX_PDU, Reply, RequestPdu};
use super::{Decoded, Request};

/// Longest frame: colon, address, PDU and LRC as two digits a byte, CR LF.
pub const LONGEST: usize = chars(MAX_PDU);

const BEGIN: u8 = b':';
const END: u8 = b'\n';

const TOO_SHORT: &str = "it is shorter than any frame";

/// Characters of the frame around a PDU of that length.
pub const fn chars(pdu: usize) -> usize {
    1 + 2 * (1 + pdu + 1) + 2
}

/// Appends `address`, `pdu` and LRC to `out` as one frame, in upper case.
pub fn encode_frame(address: u8, pdu: &[u8], out: &mut Vec<u8>) {
    let mut body = Vec::with_capacity(pdu.len() + 2);
    body.push(address);
    body.extend_from_slice(pdu);
    body.push(lrc(&body));
    out.push(BEGIN);
    for byte in body {
        out.extend([digit(byte >> 4), digit(byte & 0x0F)]);
    }
    out.extend(*b"\r\n");
}

/// Appends the request's frame to `out`.
pub fn encode_request(request: &Request, out: &mut Vec<u8>) {
    let mut pdu = Vec::with_capacity(request.pdu.encoded_len());
    request.pdu.encode(&mut pdu);
    encode_frame(request.address, &pdu, out);
}

/// Decodes `bytes` as the answer to `request`. `used` of a reply includes the noise before it.
pub fn decode_reply(request: &Request, bytes: &[u8]) -> Decoded {
    let start = noise(bytes);
    let rest = bytes.get(start..).unwrap_or_default();
    let end = rest.iter().position(|&b| b == END).map(|at| at + 1);
    let Some(frame) = end.and_then(|end| rest.get(..end)) else {
        return match unfinished(rest) {
            Ok(()) if bytes.len() < LONGEST => Decoded::Incomplete,
            // Noise before the frame may make the bytes longer than the longest frame.
            Ok(()) if rest.first() == Some(&BEGIN) && rest.len() < LONGEST => Decoded::Incomplete,
            Ok(()) => Decoded::Corrupt("no end of a frame in the characters of the longest one"),
            Err(why) => Decoded::Corrupt(why),
        };
    };
    let used = start + frame.len();
    let (address, pdu) = match parse(frame) {
        Ok(parsed) => parsed,
        Err(why) => return Decoded::Corrupt(why),
    };
    if address != request.address {
        return Decoded::Foreign { used };
    }
    match Reply::decode(&request.pdu, &pdu) {
        Ok(reply) => Decoded::Reply { used, reply },
        Err(_) => Decoded::Foreign { used },
    }
}

/// Characters before the first frame that cannot belong to it: everything up to its colon, or to the last colon if
/// several precede a line feed. Without any colon, all of them.
pub fn noise(bytes: &[u8]) -> usize {
    let Some(first) = bytes.iter().position(|&b| b == BEGIN) else {
        return bytes.len();
    };
    let line = bytes
        .get(first..)
        .unwrap_or_default()
        .split(|&b| b == END)
        .next()
        .unwrap_or_default();
    first + line.iter().rposition(|&b| b == BEGIN).unwrap_or(0)
}

/// Length of a master's frame up to its first line feed; `None` while the line feed has not arrived.
pub fn request_len(bytes: &[u8]) -> Option<usize> {
    bytes.iter().position(|&b| b == END).map(|end| end + 1)
}

/// The address and PDU of a whole frame whose LRC is right. Characters before its (last) colon do not matter.
pub fn open_frame(frame: &[u8]) -> Option<(u8, Vec<u8>)> {
    parse(frame.get(noise(frame)..)?).ok()
}

/// The address and PDU of a damaged frame without its LRC, as far as they can be trusted.
pub fn damaged_frame(frame: &[u8]) -> Option<(u8, Vec<u8>)> {
    let body = body(frame.get(noise(frame)..)?).ok()?;
    check(&body).err()?;
    match body.as_slice() {
        [address, pdu @ .., _] => Some((*address, pdu.to_vec())),
        _ => None,
    }
}

/// The request in a complete frame, as a slave decodes it; `None` if the frame or its LRC is wrong (a slave stays silent).
pub fn decode_request(frame: &[u8]) -> Option<(u8, super::rtu::ReceivedPdu)> {
    let (address, pdu) = open_frame(frame)?;
    let function = *pdu.first()?;
    Some((address, RequestPdu::decode(&pdu).map_err(|code| (function, code))))
}

/// Whether characters without a line feed, from a colon on, can still become a frame.
fn unfinished(frame: &[u8]) -> Result<(), &'static str> {
    let Some((_, rest)) = frame.split_first() else {
        return Ok(());
    };
    let digits = rest.strip_suffix(b"\r").unwrap_or(rest);
    digits.iter().try_for_each(|&b| value(b).map(|_| ()))
}

/// Address and PDU of a frame from its colon to its line feed, or the reason why it is not a valid frame.
fn parse(frame: &[u8]) -> Result<(u8, Vec<u8>), &'static str> {
    let body = body(frame)?;
    check(&body)?;
    match body.as_slice() {
        [address, pdu @ .., _] => Ok((*address, pdu.to_vec())),
        _ => Err(TOO_SHORT),
    }
}

/// Address, PDU and LRC between the colon of a frame and its line feed, or the reason why the frame has none.
fn body(frame: &[u8]) -> Result<Vec<u8>, &'static str> {
    let line = frame.strip_prefix(b":").ok_or("it does not start with a colon")?;
    let line = line.strip_suffix(b"\n").ok_or("it does not end with a line feed")?;
    let digits = line
        .strip_suffix(b"\r")
        .ok_or("a line feed without a carriage return before it")?;
    if digits.len() > LONGEST - 3 {
        return Err("it is longer than any frame");
    }
    let mut values = Vec::with_capacity(digits.len());
    for &digit in digits {
        values.push(value(digit)?);
    }
    let (pairs, odd) = values.as_chunks::<2>();
    if !odd.is_empty() {
        return Err("an odd number of hexadecimal digits");
    }
    let body: Vec<u8> = pairs.iter().map(|[high, low]| high << 4 | low).collect();
    if body.len() < 3 { Err(TOO_SHORT) } else { Ok(body) }
}

fn check(body: &[u8]) -> Result<(), &'static str> {
    match body.split_last() {
        Some((check, rest)) if lrc(rest) == *check => Ok(()),
        _ => Err("check code (LRC) is wrong"),
    }
}

/// The digit of a value below 16.
pub(crate) fn digit(nibble: u8) -> u8 {
    if nibble < 10 { b'0' + nibble } else { b'A' + nibble - 10 }
}

/// The value of a digit, or the problem with a character in place of a digit.
fn value(character: u8) -> Result<u8, &'static str> {
    match character {
        b'0'..=b'9' => Ok(character - b'0'),
        b'A'..=b'F' => Ok(character - b'A' + 10),
        b'a'..=b'f' => Ok(character - b'a' + 10),
        b'\r' => Err("a carriage return without a line feed behind it"),
        0x80.. => Err("a character has bit 7 set: noise, or the data bits and parity are not the drive's"),
        _ => Err("a character is not a hexadecimal digit"),
    }
}

#[cfg(test)]
mod tests;
