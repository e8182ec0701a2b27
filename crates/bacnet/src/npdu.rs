//! The network layer's header (clause 6).

use crate::types::Mac;

/// Network number that means all networks.
pub const GLOBAL: u16 = 0xFFFF;
/// Maximum number of routers that a message may pass.
const HOPS: u8 = 0xFF;

/// A message of the network layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Npdu<'a> {
    /// Destination network and station with the remaining hops; `None` for this network.
    pub to: Option<(u16, Mac, u8)>,
    /// The network and the station that sent the message; `None` if the host itself sent the message.
    pub from: Option<(u16, Mac)>,
    /// Whether the sender expects an answer.
    pub expects: bool,
    /// The content of the message: for an application, or for another router.
    pub payload: Payload<'a>,
}

/// The content of a network layer message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Payload<'a> {
    /// A message of the application layer.
    Application(&'a [u8]),
    /// A message between routers: type and content.
    Network(u8, &'a [u8]),
}

/// Messages between routers.
#[allow(missing_docs)]
pub mod message {
    pub const WHO_IS_ROUTER: u8 = 0x00;
    pub const I_AM_ROUTER: u8 = 0x01;
    pub const REJECT: u8 = 0x03;
    pub const INITIALIZE_TABLE: u8 = 0x06;
    pub const INITIALIZE_TABLE_ACK: u8 = 0x07;
}

fn address(bytes: &[u8], may_be_all: bool) -> Option<((u16, Mac), &[u8])> {
    let [high, low, len, rest @ ..] = bytes else {
        return None;
    };
    let (mac, rest) = rest.split_at_checked(usize::from(*len))?;
    let network = u16::from_be_bytes([*high, *low]);
    if network == 0 || (!may_be_all && (network == GLOBAL || mac.is_empty())) {
        return None;
    }
    Some(((network, Mac::new(mac)?), rest))
}

/// Decodes a message; `None` if the bytes are not a valid message.
pub fn decode(bytes: &[u8]) -> Option<Npdu<'_>> {
    let [1, control, rest @ ..] = bytes else {
        return None;
    };
    let mut rest = rest;
    let (mut to, mut from) = (None, None);
    if control & 0x20 != 0 {
        let (address, after) = address(rest, true)?;
        (to, rest) = (Some(address), after);
    }
    if control & 0x08 != 0 {
        let (address, after) = address(rest, false)?;
        (from, rest) = (Some(address), after);
    }
    let to = match to {
        None => None,
        Some((network, mac)) => {
            let (hops, after) = rest.split_first()?;
            rest = after;
            Some((network, mac, *hops))
        }
    };
    let payload = if control & 0x80 != 0 {
        match rest {
            // Proprietary message types carry a vendor identifier before their content.
            [kind @ 0x80..=0xFF, _, _, rest @ ..] => Payload::Network(*kind, rest),
            [kind @ 0..=0x7F, rest @ ..] => Payload::Network(*kind, rest),
            _ => return None,
        }
    } else {
        Payload::Application(rest)
    };
    Some(Npdu {
        to,
        from,
        expects: control & 0x04 != 0,
        payload,
    })
}

/// Writes a message of the normal priority.
pub fn encode(to: Option<(u16, Mac)>, from: Option<(u16, Mac)>, expects: bool, payload: Payload<'_>) -> Vec<u8> {
    let network = matches!(payload, Payload::Network(..));
    let flag = |set: bool, bit: u8| u8::from(set) << bit;
    let control = flag(network, 7) | flag(to.is_some(), 5) | flag(from.is_some(), 3) | flag(expects, 2);
    let mut bytes = vec![1, control];
    for (network, mac) in [to, from].into_iter().flatten() {
        bytes.extend(network.to_be_bytes());
        bytes.push(u8::try_from(mac.octets().len()).unwrap_or_default());
        bytes.extend(mac.octets());
    }
    if to.is_some() {
        bytes.push(HOPS);
    }
    match payload {
        Payload::Application(apdu) => bytes.extend(apdu),
        Payload::Network(kind, content) => {
            bytes.push(kind);
            bytes.extend(content);
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let (to, from) = (
            Some((5, Mac::new(&[7]).unwrap())),
            Some((1001, Mac::new(&[3]).unwrap())),
        );
        for to in [None, to, Some((GLOBAL, Mac::ALL))] {
            for from in [None, from] {
                for payload in [
                    Payload::Application(&[1, 2]),
                    Payload::Network(message::WHO_IS_ROUTER, &[0, 1]),
                ] {
                    let bytes = encode(to, from, true, payload);
                    let to = to.map(|(network, mac)| (network, mac, HOPS));
                    let expects = true;
                    assert_eq!(
                        decode(&bytes),
                        Some(Npdu {
                            to,
                            from,
                            expects,
                            payload
                        })
                    );
                }
            }
        }
        let global = encode(Some((GLOBAL, Mac::ALL)), None, false, Payload::Application(&[0x10, 8]));
        assert_eq!(global, [1, 0x20, 0xFF, 0xFF, 0, 0xFF, 0x10, 8]);
    }

    #[test]
    fn what_is_wrong_is_nothing() {
        let bad: [&[u8]; 7] = [
            &[2, 0],
            &[1],
            &[1, 0x20, 0, 5],
            &[1, 0x20, 0, 0, 0, 255],
            &[1, 0x08, 0, 5, 0],
            &[1, 0x08, 0xFF, 0xFF, 1, 1],
            &[1, 0x80],
        ];
        for bytes in bad {
            assert_eq!(decode(bytes), None, "{bytes:?}");
        }
    }
}
