//! Recognises by its first bytes which kind of server is at the other end of a connection that should be a raw serial port.

use super::rfc2217::is_greeting;
use drivegate_proto::checksum::crc16;

/// Number of bytes that decide: the length of an exception of Modbus TCP.
const ENOUGH: usize = 9;
/// Maximum number of requests whose first bytes are remembered.
const ASKED: usize = 32;

/// The kind of server at the other end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Server {
    /// A serial port, or a server that is not recognised.
    Raw,
    /// A telnet server would take a byte 255 in a request for a command and double it in a reply.
    Telnet,
    /// A Modbus TCP server takes the beginning of each request for a transaction id.
    ModbusTcp,
}

impl Server {
    pub(super) const fn words(self) -> &'static str {
        match self {
            Server::Raw => "the port is raw",
            Server::Telnet => {
                "the device server speaks telnet on this port; write rfc2217:// instead of tcp://, or the server's raw TCP port"
            }
            Server::ModbusTcp => {
                "a Modbus TCP server answers on this port, but tcp:// sends the frames of the serial line (RTU over \
                 TCP); write modbus-tcp:// instead of tcp://, or set the converter to raw TCP (also called \
                 transparent, TCP server or RTU over TCP)"
            }
        }
    }
}

/// The first bytes received, and the beginnings of the requests before.
#[derive(Debug, Default)]
pub(super) struct FirstBytes {
    asked: Vec<[u8; 2]>,
    came: Vec<u8>,
}

impl FirstBytes {
    /// Notes that a request is sent.
    pub(super) fn sent(&mut self, frame: &[u8]) {
        if let [address, function, ..] = *frame
            && self.asked.len() < ASKED
            && !self.asked.contains(&[address, function])
        {
            self.asked.push([address, function]);
        }
    }

    /// The unit id in the first bytes.
    pub(super) fn unit(&self) -> u8 {
        self.came.first().copied().unwrap_or_default()
    }

    /// The drive of the first request.
    pub(super) fn first_unit(&self) -> Option<u8> {
        self.asked.first().map(|[unit, _]| *unit)
    }

    /// Whether no bytes were received yet.
    pub(super) fn is_empty(&self) -> bool {
        self.came.is_empty()
    }

    /// Notes received bytes; returns `None` while the kind of server is undecided.
    pub(super) fn received(&mut self, bytes: &[u8]) -> Option<Server> {
        let room = ENOUGH - self.came.len().min(ENOUGH);
        self.came.extend(bytes.iter().take(room));
        match (is_greeting(&self.came), self.is_modbus_tcp()) {
            (Some(true), _) => Some(Server::Telnet),
            (_, Some(true)) => Some(Server::ModbusTcp),
            (Some(false), Some(false)) => Some(Server::Raw),
            _ => None,
        }
    }

    /// Whether the bytes are a reply of Modbus TCP to a request of RTU: the first two bytes of the request as its transaction
    /// id, the protocol id 0, a length, a unit and a function. In RTU they would be the reply to a write to register 0, which
    /// the check code shows, or one without data.
    fn is_modbus_tcp(&self) -> Option<bool> {
        let begins = |from: usize, with: &[u8]| {
            let seen = self.came.get(from..).unwrap_or_default();
            seen.iter().zip(with).all(|(seen, with)| seen == with)
        };
        if !begins(2, &[0, 0, 0]) || !self.asked.iter().any(|asked| begins(0, asked)) {
            return Some(false);
        }
        let [head @ .., crc_low, crc_high, code] = self.came.as_slice() else {
            return None;
        };
        if head.len() + 3 < ENOUGH {
            return None;
        }
        let is_rtu = crc16(head) == u16::from_le_bytes([*crc_low, *crc_high]);
        let length = head.get(5).copied().unwrap_or_default();
        let fits = match *crc_high {
            0x80.. => length == 3 && (1..=11).contains(code),
            function => length >= 3 && matches!(function, 1..=6 | 15 | 16 | 22 | 23 | 43),
        };
        Some(!is_rtu && fits)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use drivegate_proto::rtu;

    fn frame(address: u8, pdu: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        rtu::encode_frame(address, pdu, &mut out);
        out
    }

    /// The kind of server recognised when these bytes arrive one by one after the request.
    fn seen(request: &[u8], bytes: &[u8]) -> Option<Server> {
        let mut first = FirstBytes::default();
        first.sent(request);
        bytes.iter().find_map(|byte| first.received(&[*byte]))
    }

    #[test]
    fn replies_of_modbus_tcp() {
        let request = frame(1, &[3, 0x08, 0x34, 0, 11]);
        for reply in [
            &[1, 3, 0, 0, 0, 3, 0x7B, 0x83, 1][..],
            &[1, 3, 0, 0, 0, 3, 0xC4, 0x8B, 0x0B],
            &[1, 3, 0, 0, 0, 5, 1, 3, 2, 0, 7],
        ] {
            assert_eq!(seen(&request, reply), Some(Server::ModbusTcp), "{reply:02X?}");
            let mut first = FirstBytes::default();
            first.sent(&request);
            assert_eq!(first.received(reply), Some(Server::ModbusTcp));
            assert_eq!(
                seen(&frame(2, &[3, 0, 0, 0, 1]), reply),
                Some(Server::Raw),
                "nobody asked that"
            );
        }
        assert_eq!(seen(&request, &[255, 253, 3]), Some(Server::Telnet));
    }

    #[test]
    fn replies_of_a_line_are_none() {
        // Writes to register 0: the echo of the request looks like the head of a reply of Modbus TCP.
        for (function, value) in [(6, 3), (6, 5), (5, 0), (15, 16), (16, 3)] {
            let request = frame(1, &[function, 0, 0, 0, value]);
            let twice = [request.clone(), request.clone()].concat();
            assert_eq!(seen(&request, &twice), Some(Server::Raw), "{function} {value}");
        }
        let request = frame(1, &[3, 0, 0, 0, 2]);
        assert_eq!(seen(&request, &frame(1, &[3, 4, 0, 0, 0, 0])), Some(Server::Raw));
        assert_eq!(seen(&request, &frame(1, &[0x83, 2])), Some(Server::Raw));
        assert_eq!(seen(&request, &[0, 0, 0]), Some(Server::Raw));
    }

    proptest! {
        #[test]
        fn any_bytes(asked in prop::collection::vec(any::<u8>(), 0..9), pieces in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..5), 0..9)) {
            let mut first = FirstBytes::default();
            first.sent(&asked);
            for piece in pieces {
                let _ = first.received(&piece);
            }
        }

        /// No reply of a drive to any read or write is recognised as another server.
        #[test]
        fn any_reply_of_a_drive(address in 1u8..=247, start: u16, count in 1u16..=125, data in prop::collection::vec(any::<u8>(), 250)) {
            let [[high, low], [more, few]] = [start, count].map(u16::to_be_bytes);
            let bytes = 2 * count as usize;
            let read = [&[3, bytes as u8], &data[..bytes]].concat();
            for (request, reply) in [
                (frame(address, &[3, high, low, more, few]), frame(address, &read)),
                (frame(address, &[6, high, low, more, few]), frame(address, &[6, high, low, more, few])),
                (frame(address, &[16, high, low, more, few]), frame(address, &[16, high, low, more, few])),
            ] {
                let twice = [reply.clone(), reply].concat();
                prop_assert!(matches!(seen(&request, &twice), None | Some(Server::Raw)));
            }
        }
    }
}
