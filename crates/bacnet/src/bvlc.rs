//! The BACnet Virtual Link Layer of BACnet/IP (annex J).

use std::net::{Ipv4Addr, SocketAddrV4};

/// First octet of every BACnet/IP datagram.
const BACNET_IP: u8 = 0x81;

/// A BACnet/IP datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bvlc<'a> {
    /// The result of a request to a BBMD.
    Result(u16),
    /// A message to this host.
    Unicast(&'a [u8]),
    /// A message to all hosts of this network.
    Broadcast(&'a [u8]),
    /// A broadcast that a BBMD forwards, with the host that sent it.
    Forwarded(SocketAddrV4, &'a [u8]),
    /// A foreign device registers for this number of seconds.
    Register(u16),
    /// A request for the list of foreign devices.
    ReadForeign,
    /// A foreign device is to be forgotten.
    DeleteForeign(SocketAddrV4),
    /// A message of a foreign device to all hosts of this network.
    Distribute(&'a [u8]),
    /// A request that only a BBMD could serve, with the code that refuses it.
    ForBbmd(u16),
}

/// Result code: the registration of a foreign device is refused (J.2.1).
pub const NO_REGISTRATION: u16 = 0x0030;
/// Result code: the deletion of a foreign device is refused (J.2.1).
pub const NO_DELETION: u16 = 0x0050;
/// Result code: the distribution of a broadcast is refused (J.2.1).
pub const NO_DISTRIBUTION: u16 = 0x0060;

/// Decodes a datagram; `None` if it is not BACnet/IP or has an invalid length.
pub fn decode(bytes: &[u8]) -> Option<Bvlc<'_>> {
    let [BACNET_IP, function, high, low, rest @ ..] = bytes else {
        return None;
    };
    if usize::from(u16::from_be_bytes([*high, *low])) != bytes.len() {
        return None;
    }
    Some(match function {
        0x00 => match rest {
            [high, low] => Bvlc::Result(u16::from_be_bytes([*high, *low])),
            _ => return None,
        },
        0x01 => Bvlc::ForBbmd(0x0010),
        0x02 => Bvlc::ForBbmd(0x0020),
        0x04 => match rest {
            [a, b, c, d, high, low, npdu @ ..] => {
                let port = u16::from_be_bytes([*high, *low]);
                Bvlc::Forwarded(SocketAddrV4::new(Ipv4Addr::new(*a, *b, *c, *d), port), npdu)
            }
            _ => return None,
        },
        0x05 => match rest {
            [high, low] => Bvlc::Register(u16::from_be_bytes([*high, *low])),
            _ => Bvlc::ForBbmd(NO_REGISTRATION),
        },
        0x06 => Bvlc::ReadForeign,
        0x08 => match rest {
            [a, b, c, d, high, low] => {
                let port = u16::from_be_bytes([*high, *low]);
                Bvlc::DeleteForeign(SocketAddrV4::new(Ipv4Addr::new(*a, *b, *c, *d), port))
            }
            _ => Bvlc::ForBbmd(NO_DELETION),
        },
        0x09 => Bvlc::Distribute(rest),
        0x0A => Bvlc::Unicast(rest),
        0x0B => Bvlc::Broadcast(rest),
        _ => return None,
    })
}

fn datagram(function: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(body.len() + 4);
    let len = u16::try_from(body.len() + 4).unwrap_or(u16::MAX);
    bytes.extend([BACNET_IP, function]);
    bytes.extend(len.to_be_bytes());
    bytes.extend(body);
    bytes
}

/// A message to one host.
pub fn unicast(npdu: &[u8]) -> Vec<u8> {
    datagram(0x0A, npdu)
}

/// A message to all hosts of this network.
pub fn broadcast(npdu: &[u8]) -> Vec<u8> {
    datagram(0x0B, npdu)
}

/// A message that a BBMD is asked to broadcast.
pub fn distribute(npdu: &[u8]) -> Vec<u8> {
    datagram(0x09, npdu)
}

/// The message that registers a foreign device for this number of seconds.
pub fn register(seconds: u16) -> Vec<u8> {
    datagram(0x05, &seconds.to_be_bytes())
}

/// The datagram that forwards a message for the host that sent it.
pub fn forwarded(origin: SocketAddrV4, npdu: &[u8]) -> Vec<u8> {
    datagram(0x04, &[&octets(origin)[..], npdu].concat())
}

/// The reply with the foreign devices: address, registered time and remaining time, in seconds.
pub fn foreign_devices(all: impl Iterator<Item = (SocketAddrV4, u16, u16)>) -> Vec<u8> {
    let entry = |(host, time, left): (SocketAddrV4, u16, u16)| {
        [&octets(host)[..], &time.to_be_bytes(), &left.to_be_bytes()].concat()
    };
    datagram(0x07, &all.flat_map(entry).collect::<Vec<u8>>())
}

fn octets(host: SocketAddrV4) -> [u8; 6] {
    let [a, b, c, d] = host.ip().octets();
    let [high, low] = host.port().to_be_bytes();
    [a, b, c, d, high, low]
}

/// The result message for a BVLC request.
pub fn result(code: u16) -> Vec<u8> {
    datagram(0x00, &code.to_be_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn datagrams_of_annex_j() {
        assert_eq!(unicast(&[1, 4]), [0x81, 0x0A, 0, 6, 1, 4]);
        assert_eq!(decode(&unicast(&[1, 4])), Some(Bvlc::Unicast(&[1, 4])));
        assert_eq!(decode(&broadcast(&[1])), Some(Bvlc::Broadcast(&[1])));
        assert_eq!(register(60), [0x81, 5, 0, 6, 0, 60]);
        assert_eq!(decode(&register(60)), Some(Bvlc::Register(60)));
        assert_eq!(decode(&distribute(&[1])), Some(Bvlc::Distribute(&[1])));
        let host = "10.0.0.9:47808".parse().unwrap();
        assert_eq!(decode(&forwarded(host, &[1])), Some(Bvlc::Forwarded(host, &[1])));
        let deletion = [0x81, 8, 0, 10, 10, 0, 0, 9, 0xBA, 0xC0];
        assert_eq!(decode(&deletion), Some(Bvlc::DeleteForeign(host)));
        assert_eq!(
            foreign_devices([(host, 60, 90)].into_iter()),
            [0x81, 7, 0, 14, 10, 0, 0, 9, 0xBA, 0xC0, 0, 60, 0, 90]
        );
        assert_eq!(decode(&result(0)), Some(Bvlc::Result(0)));
        let forwarded = [0x81, 4, 0, 11, 10, 0, 0, 9, 0xBA, 0xC0, 1];
        let origin = "10.0.0.9:47808".parse().unwrap();
        assert_eq!(decode(&forwarded), Some(Bvlc::Forwarded(origin, &[1])));
        for bad in [
            &[][..],
            &[0x81, 0x0A, 0, 5],
            &[0x82, 0x0A, 0, 4],
            &[0x81, 0x0C, 0, 4],
            &[0x81, 4, 0, 9, 1, 2, 3, 4, 5],
        ] {
            assert_eq!(decode(bad), None, "{bad:?}");
        }
    }
}
