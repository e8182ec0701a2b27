//! One exchange on the line: pure, driven by bytes and time.

use std::time::{Duration, Instant};

use crate::codec::{Decoded, Protocol, Reply, Request, RequestPdu};

/// How an exchange ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ended {
    /// The drive answered, perhaps with an exception: it is alive.
    Reply(Reply),
    /// Nothing believable came within the deadline: towards offline.
    Silent,
    /// An answer that cannot be believed: tried again once the line is silent.
    Corrupt(&'static str),
}

/// What is to be done next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// Wait for bytes until then.
    Wait(Instant),
    /// The exchange is over.
    Done(Ended),
}

/// An exchange whose request is on the line.
#[derive(Debug)]
pub struct Transaction<'r> {
    protocol: Protocol,
    request: &'r Request,
    frame: &'r [u8],
    received: Vec<u8>,
    seen: Vec<u8>,
    deadline: Instant,
    first_byte: Option<Instant>,
    foreign: u32,
    echo: bool,
    echo_seen: bool,
}

impl<'r> Transaction<'r> {
    /// The request whose `frame` was given to the line. The deadline is set once: end of transmission, time
    /// for the first byte, wire time of the reply. `echo`: the adapter is known to send back what it is given.
    pub fn new(
        protocol: Protocol,
        request: &'r Request,
        frame: &'r [u8],
        end_of_transmission: Instant,
        response_timeout: Duration,
        reply_time: Duration,
        echo: bool,
    ) -> Transaction<'r> {
        Transaction {
            protocol,
            request,
            frame,
            received: Vec::with_capacity(260),
            seen: Vec::with_capacity(260),
            deadline: end_of_transmission + response_timeout + reply_time,
            first_byte: None,
            foreign: 0,
            echo,
            echo_seen: false,
        }
    }

    /// Bytes came in.
    pub fn on_bytes(&mut self, now: Instant, bytes: &[u8]) -> Step {
        self.first_byte.get_or_insert(now);
        self.received.extend_from_slice(bytes);
        self.seen.extend_from_slice(bytes);
        loop {
            if self.strip_echo() {
                continue;
            }
            match self.protocol.decode(self.request, &self.received) {
                Decoded::Incomplete => return self.on_time(now),
                Decoded::Reply { used, reply } => {
                    self.received.drain(..used.min(self.received.len()));
                    return Step::Done(Ended::Reply(reply));
                }
                Decoded::Foreign { used } => {
                    self.foreign += 1;
                    self.received.drain(..used.min(self.received.len()));
                    self.first_byte = (!self.received.is_empty()).then_some(now);
                    if self.received.is_empty() {
                        return self.on_time(now);
                    }
                }
                // The echo of the request can look like a broken reply until it is whole.
                Decoded::Corrupt(_) if self.frame.starts_with(&self.received) => return self.on_time(now),
                Decoded::Corrupt(why) => return Step::Done(Ended::Corrupt(why)),
            }
        }
    }

    /// Time went by.
    pub fn on_time(&mut self, now: Instant) -> Step {
        if now < self.deadline {
            return Step::Wait(self.deadline);
        }
        let ended = if self.received.is_empty() {
            Ended::Silent
        } else {
            Ended::Corrupt("the reply is incomplete")
        };
        Step::Done(ended)
    }

    /// An adapter that hears itself sends the request back before the reply. A read cannot be answered by its own
    /// frame, so it shows the echo; the reply to a write can, so there the echo must be known already.
    fn strip_echo(&mut self) -> bool {
        let read = matches!(self.request.pdu, RequestPdu::Read { .. });
        let tells = !self.echo_seen && (self.echo || read);
        if !tells || !self.received.starts_with(self.frame) {
            return false;
        }
        self.received.drain(..self.frame.len());
        self.first_byte = None;
        self.echo_seen = true;
        true
    }

    /// Whether the request came back as an echo in this exchange.
    pub fn echo_seen(&self) -> bool {
        self.echo_seen
    }

    /// When the first byte of the (last) frame came.
    pub fn first_byte(&self) -> Option<Instant> {
        self.first_byte
    }

    /// Frames that were nobody's answer.
    pub fn foreign(&self) -> u32 {
        self.foreign
    }

    /// All bytes that came in this exchange.
    pub fn seen(&self) -> &[u8] {
        &self.seen
    }

    /// Bytes that came behind the reply, or were no reply.
    pub fn rest(&self) -> &[u8] {
        &self.received
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::{Table, rtu};

    fn request() -> (Request, Vec<u8>) {
        let pdu = RequestPdu::Read {
            table: Table::Holding,
            start: 732,
            count: 1,
        };
        let request = Request { address: 1, pdu };
        let mut frame = Vec::new();
        rtu::encode_request(&request, &mut frame);
        (request, frame)
    }

    fn reply(value: u16) -> Vec<u8> {
        let [high, low] = value.to_be_bytes();
        let mut frame = Vec::new();
        rtu::encode_frame(1, &[3, 2, high, low], &mut frame);
        frame
    }

    fn start<'r>(request: &'r Request, frame: &'r [u8], now: Instant) -> Transaction<'r> {
        let ms = Duration::from_millis;
        Transaction::new(Protocol::ModbusRtu, request, frame, now, ms(100), ms(5), false)
    }

    fn done(value: u16) -> Step {
        Step::Done(Ended::Reply(Reply::Registers(vec![value])))
    }

    #[test]
    fn single_bytes_make_a_reply() {
        let (request, frame) = request();
        let now = Instant::now();
        let mut transaction = start(&request, &frame, now);
        let bytes = reply(2);
        for byte in &bytes[..bytes.len() - 1] {
            assert!(matches!(transaction.on_bytes(now, &[*byte]), Step::Wait(_)));
        }
        assert_eq!(transaction.on_bytes(now, &bytes[bytes.len() - 1..]), done(2));
        assert!(transaction.rest().is_empty());
    }

    #[test]
    fn the_deadline_is_set_once() {
        let (request, frame) = request();
        let now = Instant::now();
        let deadline = now + Duration::from_millis(105);
        let mut transaction = start(&request, &frame, now);
        let mut foreign = Vec::new();
        rtu::encode_frame(9, &[3, 2, 0, 1], &mut foreign);
        assert_eq!(
            transaction.on_bytes(now + Duration::from_millis(90), &foreign),
            Step::Wait(deadline)
        );
        assert_eq!(transaction.foreign(), 1);
        assert_eq!(transaction.on_time(deadline), Step::Done(Ended::Silent));
        let mut transaction = start(&request, &frame, now);
        transaction.on_bytes(now, &[1, 3]);
        assert_eq!(
            transaction.on_time(deadline),
            Step::Done(Ended::Corrupt("the reply is incomplete"))
        );
    }

    #[test]
    fn foreign_frame_and_reply_in_one_piece() {
        let (request, frame) = request();
        let mut bytes = Vec::new();
        rtu::encode_frame(9, &[3, 2, 0, 1], &mut bytes);
        bytes.extend(reply(7));
        bytes.push(0xFF);
        let mut transaction = start(&request, &frame, Instant::now());
        assert_eq!(transaction.on_bytes(Instant::now(), &bytes), done(7));
        assert_eq!(transaction.rest(), [0xFF]);
    }

    #[test]
    fn echo_is_dropped_even_where_it_looks_like_a_reply() {
        // 01 03 02 DC …: read as a reply it would be one register 0xDC00.
        let (request, frame) = request();
        let now = Instant::now();
        let mut transaction = start(&request, &frame, now);
        for byte in &frame {
            assert!(matches!(transaction.on_bytes(now, &[*byte]), Step::Wait(_)));
        }
        assert!(transaction.echo_seen());
        assert_eq!(transaction.on_bytes(now, &reply(2)), done(2));
    }

    #[test]
    fn a_known_echo_does_not_acknowledge_a_write() {
        let request = Request {
            address: 1,
            pdu: RequestPdu::WriteRegister {
                address: 2000,
                value: 1,
            },
        };
        let mut frame = Vec::new();
        rtu::encode_request(&request, &mut frame);
        let now = Instant::now();
        let ms = Duration::from_millis;
        let begin = |echo| Transaction::new(Protocol::ModbusRtu, &request, &frame, now, ms(100), ms(5), echo);
        assert_eq!(
            begin(false).on_bytes(now, &frame),
            Step::Done(Ended::Reply(Reply::Written))
        );
        let mut transaction = begin(true);
        assert!(matches!(transaction.on_bytes(now, &frame), Step::Wait(_)));
        assert_eq!(
            transaction.on_bytes(now, &frame),
            Step::Done(Ended::Reply(Reply::Written))
        );
    }

    #[test]
    fn corrupt_bytes_end_the_exchange() {
        let (request, frame) = request();
        let mut bytes = reply(2);
        bytes[3] ^= 0x10;
        let mut transaction = start(&request, &frame, Instant::now());
        assert_eq!(
            transaction.on_bytes(Instant::now(), &bytes),
            Step::Done(Ended::Corrupt("check code is wrong"))
        );
    }
}
