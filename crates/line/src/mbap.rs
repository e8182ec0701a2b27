//! A device on Modbus TCP (`modbus-tcp://`): converts the frames of a line to those of the network, and back.
//!
//! The bus sends and receives RTU frames. On the network each request has a unique transaction id, and a reply with
//! another id than the last request belongs to a request that was given up: it is dropped, so that no late or
//! duplicate reply is mistaken for the reply to another request (MODBUS Messaging on TCP/IP 1.0b, 3.1.3 and 4.2).

use std::cell::RefCell;
use std::net::TcpStream;
use std::os::fd::{AsFd, BorrowedFd};

use super::{Lost, read, write_all};
use drivegate_proto::rtu;

/// Transaction id, protocol and length, before the unit id.
const HEADER: usize = 6;
/// Unit id and PDU at least, and at most.
const LENGTHS: std::ops::RangeInclusive<usize> = 2..=254;

/// Reason why a connection is given up.
const NO_MODBUS_TCP: &str = "what came is not Modbus TCP; write tcp:// if the server has a raw port";

/// A connection by Modbus TCP.
#[derive(Debug)]
pub(super) struct Mbap {
    stream: TcpStream,
    session: RefCell<Session>,
}

impl Mbap {
    pub(super) fn new(stream: TcpStream) -> Mbap {
        Mbap {
            stream,
            session: RefCell::default(),
        }
    }

    /// Sends the request in an RTU frame to the device.
    pub(super) fn send(&self, frame: &[u8]) -> Result<(), Lost> {
        let Some(sent) = self.session.borrow_mut().ask(frame) else {
            return Ok(());
        };
        write_all(self.stream.as_fd(), &sent)
    }

    /// Reads the reply to the last request as an RTU frame; returns 0 if there is none.
    ///
    /// # Errors
    /// If the port has disappeared, or the bytes are not Modbus TCP.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> Result<usize, Lost> {
        let mut raw = [0; 512];
        let count = read(self.stream.as_fd(), &mut raw)?;
        let came = raw.get(..count).unwrap_or_default();
        let frame = self.session.borrow_mut().received(came).map_err(Lost::new)?;
        for (place, byte) in buffer.iter_mut().zip(&frame) {
            *place = *byte;
        }
        Ok(frame.len().min(buffer.len()))
    }
}

impl AsFd for Mbap {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

/// The transaction ids of a connection. Pure.
#[derive(Debug, Default)]
struct Session {
    last: u16,
    /// Whether the last request has no reply yet.
    awaits: bool,
    received: Vec<u8>,
}

impl Session {
    /// Converts an RTU frame into a frame for the network; `None` if the RTU frame is invalid.
    fn ask(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let (unit, pdu) = rtu::open_frame(frame)?;
        let length = u16::try_from(pdu.len() + 1).ok()?;
        self.last = self.last.wrapping_add(1);
        self.awaits = true;
        let mut sent = Vec::with_capacity(HEADER + 1 + pdu.len());
        for word in [self.last, 0, length] {
            sent.extend_from_slice(&word.to_be_bytes());
        }
        sent.push(unit);
        sent.extend_from_slice(pdu);
        Some(sent)
    }

    /// Processes received bytes; returns the RTU frame of the reply to the last request, empty while it is incomplete.
    fn received(&mut self, bytes: &[u8]) -> Result<Vec<u8>, &'static str> {
        self.received.extend_from_slice(bytes);
        let mut reply = Vec::new();
        loop {
            let [id_high, id_low, 0, 0, high, low, ..] = *self.received.as_slice() else {
                let is_protocol = self.received.iter().skip(2).take(2).all(|byte| *byte == 0);
                return if is_protocol { Ok(reply) } else { Err(NO_MODBUS_TCP) };
            };
            let length = usize::from(u16::from_be_bytes([high, low]));
            if !LENGTHS.contains(&length) {
                return Err(NO_MODBUS_TCP);
            }
            let Some(body) = self.received.get(HEADER..HEADER + length) else {
                return Ok(reply);
            };
            let id = u16::from_be_bytes([id_high, id_low]);
            if self.awaits && id == self.last {
                self.awaits = false;
                if let Some((unit, pdu)) = body.split_first() {
                    rtu::encode_frame(*unit, pdu, &mut reply);
                }
            } else {
                tracing::debug!(target: "drivegate::line::mbap", id, last = self.last, "dropped a reply to a request that \
                                                                                        was given up");
            }
            self.received.drain(..HEADER + length);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn frame(unit: u8, pdu: &[u8]) -> Vec<u8> {
        let mut frame = Vec::new();
        rtu::encode_frame(unit, pdu, &mut frame);
        frame
    }

    /// A frame of the network with that id.
    fn of(id: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
        let [high, low] = id.to_be_bytes();
        [&[high, low, 0, 0, 0, pdu.len() as u8 + 1, unit][..], pdu].concat()
    }

    #[test]
    fn a_request_and_its_reply_as_on_the_network() {
        let mut session = Session::default();
        assert_eq!(
            session.ask(&frame(255, &[3, 0, 9, 0, 1])).unwrap(),
            [0, 1, 0, 0, 0, 6, 255, 3, 0, 9, 0, 1]
        );
        let reply = of(1, 255, &[3, 2, 0, 7]);
        for byte in &reply[..reply.len() - 1] {
            assert_eq!(session.received(&[*byte]), Ok(vec![]));
        }
        assert_eq!(
            session.received(&reply[reply.len() - 1..]),
            Ok(frame(255, &[3, 2, 0, 7]))
        );
        assert_eq!(session.received(&reply), Ok(vec![]), "it came twice");
    }

    #[test]
    fn a_reply_to_an_earlier_request_is_dropped_wherever_it_stands() {
        let mut session = Session::default();
        session.ask(&frame(1, &[3, 0, 0, 0, 1]));
        session.ask(&frame(1, &[3, 0, 5, 0, 1]));
        let (late, own) = (of(1, 1, &[3, 2, 0, 1]), of(2, 1, &[3, 2, 0, 2]));
        assert_eq!(session.received(&late), Ok(vec![]));
        let all = [&late[..], &own, &late, &own].concat();
        assert_eq!(session.received(&all), Ok(frame(1, &[3, 2, 0, 2])));
    }

    #[test]
    fn ids_begin_anew_after_the_last_one() {
        let mut session = Session {
            last: u16::MAX,
            ..Session::default()
        };
        assert_eq!(session.ask(&frame(1, &[7])).unwrap()[..2], [0, 0]);
        assert_eq!(session.received(&of(0, 1, &[7, 0])), Ok(frame(1, &[7, 0])));
    }

    #[test]
    fn another_protocol_ends_the_connection() {
        for bad in [
            &[1, 3, 2, 0, 0, 0xB8, 0x44][..],
            &[0, 1, 0, 0, 0, 1, 1],
            &[0, 1, 0, 0, 1, 0, 1],
            b"HTTP/1.1 400 Bad Request",
        ] {
            assert_eq!(Session::default().received(bad), Err(NO_MODBUS_TCP), "{bad:?}");
        }
        assert_eq!(Session::default().ask(&[1, 3, 0]), None, "no frame");
    }

    proptest! {
        #[test]
        fn nothing_that_comes_makes_it_panic_or_gives_a_reply_to_another_request(
            pieces in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..40), 0..20),
        ) {
            let mut session = Session::default();
            let sent = session.ask(&frame(9, &[3, 0, 0, 0, 1])).unwrap();
            for piece in pieces {
                let Ok(reply) = session.received(&piece) else { return Ok(()) };
                prop_assert!(reply.is_empty() || session.last.to_be_bytes() == sent[..2]);
                prop_assert!(session.received.len() <= HEADER + 254 + 40);
            }
        }
    }
}
