//! How a simulated drive finds a master's frames among the characters on its line, and how it frames its replies,
//! for each protocol.
//!
//! | | a frame begins | it is over | silence before it |
//! |---|---|---|---|
//! | Modbus RTU | after silence | after 3.5 characters of silence | 3.5 characters |
//! | Modbus ASCII | with a colon, in the middle of another too | with LF; a pause of 1 s throws it away | none |
//! | N2 | with `>` | with CR; the same pause | none |

use std::time::Duration;

use drivegate_proto::{Protocol, ascii, rtu};

/// Longest pause between two characters of one Modbus ASCII frame (Modbus over serial line, 2.5.2.1), also used for N2.
pub(crate) const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// Whether the character begins a frame, regardless of the preceding characters.
pub(crate) fn begins(protocol: Protocol, character: u8) -> bool {
    match protocol {
        Protocol::ModbusRtu => false,
        Protocol::ModbusAscii => character == b':',
        Protocol::N2 => character == b'>',
    }
}

/// Whether a frame is over with that character.
pub(crate) fn ends(protocol: Protocol, character: u8) -> bool {
    match protocol {
        Protocol::ModbusRtu => false,
        Protocol::ModbusAscii => character == b'\n',
        Protocol::N2 => character == b'\r',
    }
}

/// The characters in pieces, each of which belongs to one frame only.
pub(crate) fn pieces(protocol: Protocol, characters: &[u8]) -> impl Iterator<Item = &[u8]> {
    characters.chunk_by(move |&last, &next| !ends(protocol, last) && !begins(protocol, next))
}

/// Number of characters of a frame that a drive keeps; further ones until the end of the frame are thrown away.
pub(crate) fn kept(protocol: Protocol) -> usize {
    match protocol {
        Protocol::ModbusRtu | Protocol::N2 => 300,
        Protocol::ModbusAscii => ascii::LONGEST,
    }
}

/// Address and request of a valid Modbus frame; if its PDU is invalid, the function of the request with the
/// exception that refuses it.
pub(crate) fn open(protocol: Protocol, frame: &[u8]) -> Option<(u8, rtu::ReceivedPdu)> {
    match protocol {
        Protocol::ModbusRtu => rtu::decode_request(frame),
        Protocol::ModbusAscii => ascii::decode_request(frame),
        Protocol::N2 => None,
    }
}

/// The PDU of a valid Modbus frame.
pub(crate) fn pdu(protocol: Protocol, frame: &[u8]) -> Option<Vec<u8>> {
    match protocol {
        Protocol::ModbusRtu => rtu::open_frame(frame).map(|(_, pdu)| pdu.to_vec()),
        Protocol::ModbusAscii => ascii::open_frame(frame).map(|(_, pdu)| pdu),
        Protocol::N2 => None,
    }
}

/// Address and function of a frame that is complete except for a wrong check code. In Modbus RTU only the check
/// code shows that a frame is complete.
pub(crate) fn damaged(protocol: Protocol, frame: &[u8]) -> Option<(u8, u8)> {
    match protocol {
        Protocol::ModbusAscii => {
            let (address, pdu) = ascii::damaged_frame(frame)?;
            Some((address, *pdu.first()?))
        }
        Protocol::ModbusRtu | Protocol::N2 => None,
    }
}

/// Appends the frame of a Modbus PDU to `out`.
pub(crate) fn close(protocol: Protocol, address: u8, pdu: &[u8], out: &mut Vec<u8>) {
    match protocol {
        Protocol::ModbusRtu => rtu::encode_frame(address, pdu, out),
        Protocol::ModbusAscii => ascii::encode_frame(address, pdu, out),
        Protocol::N2 => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(protocol: Protocol, text: &str) -> Vec<&str> {
        pieces(protocol, text.as_bytes())
            .map(|piece| std::str::from_utf8(piece).unwrap())
            .collect()
    }

    #[test]
    fn characters_fall_into_frames() {
        let text = "xx:0103\r:01\r\n\n:02>03\r";
        assert_eq!(
            split(Protocol::ModbusAscii, text),
            ["xx", ":0103\r", ":01\r\n", "\n", ":02>03\r"]
        );
        assert_eq!(split(Protocol::N2, text), ["xx:0103\r", ":01\r", "\n\n:02", ">03\r"]);
        assert_eq!(split(Protocol::ModbusRtu, text), [text]);
        assert!(split(Protocol::ModbusAscii, "").is_empty());
    }
}
