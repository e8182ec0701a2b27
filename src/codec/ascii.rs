//! Modbus ASCII frames: colon, hexadecimal digits, LRC, CR LF (drives.md 5.1, worked frames section 7.3).

use super::checksum::lrc;
use super::modbus::{MAX_PDU, Reply, RequestPdu};
use super::{Decoded, Request};

/// Longest frame: colon, address, PDU and LRC as two digits a byte, CR LF.
pub const LONGEST: usize = chars(MAX_PDU);

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
    out.push(b':');
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

/// What `bytes` are as the answer to `request`.
pub fn decode_reply(request: &Request, bytes: &[u8]) -> Decoded {
    let Some(end) = bytes.iter().position(|b| *b == b'\n') else {
        return if bytes.len() >= LONGEST {
            Decoded::Corrupt("no end of a frame in the longest one's characters")
        } else {
            Decoded::Incomplete
        };
    };
    let used = end + 1;
    let line = bytes.get(..used).unwrap_or_default();
    let Some((address, pdu)) = open_frame(line) else {
        return Decoded::Corrupt("the frame is no colon, hexadecimal digits, LRC, CR LF");
    };
    if address != request.address {
        return Decoded::Foreign { used };
    }
    match Reply::decode(&request.pdu, &pdu) {
        Ok(reply) => Decoded::Reply { used, reply },
        Err(_) => Decoded::Foreign { used },
    }
}

/// Length of the frame of a master that starts `bytes`, up to its LF; `None` while it is not whole.
pub fn request_len(bytes: &[u8]) -> Option<usize> {
    bytes.iter().position(|b| *b == b'\n').map(|end| end + 1)
}

/// The address and PDU of a whole frame whose LRC is right; a new colon begins the frame anew.
pub fn open_frame(frame: &[u8]) -> Option<(u8, Vec<u8>)> {
    let colon = frame.iter().rposition(|b| *b == b':')?;
    let digits = frame.get(colon + 1..)?.strip_suffix(b"\r\n")?;
    if digits.len() % 2 != 0 {
        return None;
    }
    let bytes: Option<Vec<u8>> = digits
        .chunks_exact(2)
        .map(|pair| Some(value(*pair.first()?)? << 4 | value(*pair.get(1)?)?))
        .collect();
    let bytes = bytes?;
    let (check, body) = bytes.split_last()?;
    if body.len() < 2 || lrc(body) != *check {
        return None;
    }
    let (address, pdu) = body.split_first()?;
    Some((*address, pdu.to_vec()))
}

/// The request in a whole frame, as a slave reads it; `None` when the frame or its LRC is wrong.
pub fn decode_request(frame: &[u8]) -> Option<(u8, super::rtu::ReceivedPdu)> {
    let (address, pdu) = open_frame(frame)?;
    let function = *pdu.first()?;
    Some((address, RequestPdu::decode(&pdu).map_err(|code| (function, code))))
}

fn digit(nibble: u8) -> u8 {
    if nibble < 10 { b'0' + nibble } else { b'A' + nibble - 10 }
}

fn value(digit: u8) -> Option<u8> {
    char::from(digit).to_digit(16).map(|v| v as u8)
}
