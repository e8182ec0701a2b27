//! Evidence about the line in the bytes of one transaction.

use drivegate_proto::{Decoded, Protocol, Reply, Request, RequestPdu};

/// Stray bytes before a reply that still look like a line without bias or a late adapter.
const MOST_STRAY: usize = 3;
/// First bytes of a reply that are restored to check whether the rest is valid.
const MOST_LOST: usize = 2;

/// The form of the received bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// No bytes were received.
    Nothing,
    /// Only the reply was received, without stray bytes.
    Sound,
    /// Stray bytes were received before the reply; `true` if all of them are zero.
    Led(bool),
    /// The reply would be valid with its first bytes.
    StartLost,
    /// The echo of the request was received without its last bytes.
    CutEcho,
    /// More bytes than the reply could have.
    Overlong,
    /// The reply breaks off.
    EndLost,
    /// The reply ends too early.
    Garbled,
}

/// What the bytes of a transaction show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signature {
    /// The request was echoed before the reply; `None` if this is not certain.
    pub echoed: Option<bool>,
    /// The shape of the received bytes apart from the reply.
    pub shape: Shape,
}

/// Evaluates `seen`, all bytes received after the request `frame` was sent; `answered` means that they contain the reply.
pub fn of(protocol: Protocol, request: &Request, frame: &[u8], seen: &[u8], answered: bool) -> Signature {
    let is_read = matches!(request.pdu, RequestPdu::Read { .. }) || protocol == Protocol::N2;
    let echoed = is_read && !frame.is_empty() && seen.starts_with(frame);
    let heard = if echoed {
        seen.get(frame.len()..).unwrap_or_default()
    } else {
        seen
    };
    Signature {
        echoed: (is_read && !seen.is_empty()).then_some(echoed),
        shape: shape(protocol, request, frame, heard, answered),
    }
}

fn shape(protocol: Protocol, request: &Request, frame: &[u8], heard: &[u8], answered: bool) -> Shape {
    let is_reply = |bytes: &[u8]| match protocol.decode(request, bytes) {
        Decoded::Reply { reply, .. } => answered || !matches!(reply, Reply::Exception(_)),
        _ => false,
    };
    let Some(&first) = heard.first() else {
        return Shape::Nothing;
    };
    if answered && begins(protocol, request.address, first) {
        return Shape::Sound;
    }
    let stray = (1..=MOST_STRAY).find(|count| {
        let rest = heard.get(*count..).unwrap_or_default();
        rest.first()
            .is_some_and(|&first| begins(protocol, request.address, first))
            && is_reply(rest)
    });
    if let Some(stray) = stray {
        return Shape::Led(heard.iter().take(stray).all(|byte| *byte == 0));
    }
    if answered {
        return Shape::Sound;
    }
    if start_lost(protocol, request, heard) {
        return Shape::StartLost;
    }
    if heard.len() > 1 && heard.len() < frame.len() && frame.starts_with(heard) {
        return Shape::CutEcho;
    }
    if is_overlong(protocol, request, heard.len()) {
        Shape::Overlong
    } else if heard.len() < protocol.least_reply_chars(&request.pdu) && protocol.begins_reply(request, heard) {
        Shape::EndLost
    } else {
        Shape::Garbled
    }
}

/// Whether a reply to the request cannot have this number of characters; N2 has numbers of two lengths.
fn is_overlong(protocol: Protocol, request: &Request, count: usize) -> bool {
    let (least, most) = (
        protocol.least_reply_chars(&request.pdu),
        protocol.reply_chars(&request.pdu),
    );
    count > most || (protocol == Protocol::N2 && most < least + 4 && count > least && count < most)
}

/// Index of the first character that cannot occur inside a frame of a text protocol.
pub fn misfit(protocol: Protocol, seen: &[u8]) -> Option<usize> {
    if !protocol.is_text() {
        return None;
    }
    let inside = seen.get(1..seen.len().saturating_sub(2))?;
    inside
        .iter()
        .position(|byte| !byte.is_ascii_hexdigit())
        .map(|place| place + 1)
}

/// Whether a reply from this address may begin with this byte.
fn begins(protocol: Protocol, address: u8, first: u8) -> bool {
    match protocol {
        Protocol::ModbusRtu => first == address,
        Protocol::ModbusAscii => first == b':',
        Protocol::N2 => matches!(first, b'A' | b'N'),
    }
}

/// Whether the reply becomes valid when its first bytes are restored, either before the received bytes or in place
/// of their damaged beginning.
fn start_lost(protocol: Protocol, request: &Request, heard: &[u8]) -> bool {
    let address = format!("{:02X}", request.address).into_bytes();
    let head: Vec<u8> = match protocol {
        Protocol::ModbusRtu => vec![request.address, request.pdu.function()],
        Protocol::ModbusAscii => [b":".as_slice(), &address].concat(),
        Protocol::N2 => vec![b'A'],
    };
    // In an acknowledgement of two bytes, restored bytes would often fit by chance.
    if heard.len() < 3 {
        return protocol == Protocol::N2 && heard == b"\r" && is_sound(protocol, request, b"A\r");
    }
    (1..=MOST_LOST.min(head.len())).any(|lost| {
        let head = head.get(..lost).unwrap_or_default();
        let whole = |rest: &[u8]| is_sound(protocol, request, &[head, rest].concat());
        whole(heard) || heard.get(lost..).is_some_and(whole)
    })
}

fn is_sound(protocol: Protocol, request: &Request, bytes: &[u8]) -> bool {
    let decoded = protocol.decode(request, bytes);
    matches!(decoded, Decoded::Reply { used, reply } if used == bytes.len() && !matches!(reply, Reply::Exception(_)))
}

/// The drive that unrequested bytes are a reply of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answering {
    /// Only the drive at this address may have answered.
    Address(u8),
    /// Any drive may have sent the reply: N2 replies have no address.
    Anybody,
}

/// The drive that unrequested bytes are a valid reply of, if they are one.
pub fn answer(protocol: Protocol, bytes: &[u8]) -> Option<Answering> {
    match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => protocol
            .open_frame(bytes)
            .map(|(address, _)| Answering::Address(address)),
        Protocol::N2 => {
            let line = bytes.strip_suffix(b"\r")?;
            drivegate_proto::n2::Answer::decode(line)
                .is_ok()
                .then_some(Answering::Anybody)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_proto::{Table, ascii, rtu};

    fn request() -> Request {
        Request::new(5, RequestPdu::read(Table::Holding, 2100, 2))
    }

    fn modbus(protocol: Protocol) -> (Vec<u8>, Vec<u8>) {
        let (mut frame, mut reply) = (Vec::new(), Vec::new());
        protocol.encode(&request(), &mut frame);
        let pdu = [3, 4, 1, 2, 3, 4];
        match protocol {
            Protocol::ModbusAscii => ascii::encode_frame(5, &pdu, &mut reply),
            _ => rtu::encode_frame(5, &pdu, &mut reply),
        }
        (frame, reply)
    }

    #[test]
    fn what_befell_a_reply_shows_in_its_bytes() {
        for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii] {
            let (frame, reply) = modbus(protocol);
            let shape = |bytes: &[u8], answered| of(protocol, &request(), &frame, bytes, answered).shape;
            let mangled = |at: usize| {
                let mut bytes = reply.clone();
                bytes[at] ^= 0x11;
                bytes
            };
            assert_eq!(shape(&reply, true), Shape::Sound);
            assert_eq!(shape(&[], false), Shape::Nothing);
            assert_eq!(shape(&[&[0][..], &reply].concat(), true), Shape::Led(true));
            assert_eq!(shape(&[&[0, 0xFE][..], &reply].concat(), true), Shape::Led(false));
            for lost in 1..=2 {
                assert_eq!(shape(&reply[lost..], false), Shape::StartLost, "{protocol:?} {lost}");
            }
            assert_eq!(shape(&mangled(0), false), Shape::StartLost);
            assert_eq!(shape(&mangled(4), false), Shape::Garbled);
            assert_eq!(shape(&reply[..reply.len() - 1], false), Shape::EndLost);
            assert_eq!(shape(&frame[..frame.len() - 1], false), Shape::CutEcho);
            assert_eq!(shape(&[mangled(4), reply.clone()].concat(), false), Shape::Overlong);
            let echoed = of(
                protocol,
                &request(),
                &frame,
                &[frame.clone(), reply.clone()].concat(),
                true,
            );
            assert_eq!((echoed.echoed, echoed.shape), (Some(true), Shape::Sound));
            assert_eq!(answer(protocol, &reply), Some(Answering::Address(5)));
            assert_eq!(answer(protocol, &reply[1..]), None);
        }
    }
}
