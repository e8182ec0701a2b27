//! One exchange on the line: pure, driven by bytes and time.
//!
//! Garbage does not end an exchange at once: noise may have run into the beginning of a sound reply, and the rest of a
//! broken one may still be on the line. The exchange goes on until as many characters came as a reply has, or nothing
//! more came for their time, never beyond the deadline. A whole Modbus reply that stands behind the garbage is believed:
//! address, function, length and check code fit, which random bytes do once in 2^40; in Modbus ASCII they would have to
//! be digits between a colon and CR LF too. An exception is shorter and may split a block: behind garbage it is not
//! believed, the request is repeated. N2 replies are not believed there at all. What stands before the colon of a
//! Modbus ASCII frame is no garbage but noise, which its decoder skips.

use std::time::{Duration, Instant};

use crate::codec::{Decoded, Protocol, Reply, Request, RequestPdu};

/// Most bytes looked at in one exchange: more is babble, whatever it says.
const MOST_BYTES: usize = 1024;
/// Silence, in characters, behind garbage after which no more of it is expected.
const GARBAGE_GAP: u32 = 4;

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
    reply_time: Duration,
    /// What came cannot be believed; until when the rest is waited for.
    garbage: Option<(&'static str, Instant)>,
    first_byte: Option<Instant>,
    foreign: u32,
    echo: bool,
    echo_seen: bool,
    /// A reply that is whole before then was not made for this request.
    doubted_before: Option<Instant>,
    doubted: bool,
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
            reply_time,
            garbage: None,
            first_byte: None,
            foreign: 0,
            echo,
            echo_seen: false,
            doubted_before: None,
            doubted: false,
        }
    }

    /// A reply that is whole before `earliest`, when the request and a reply cannot both have been on the wire, is not
    /// believed: it is the last reply once more, or the echo of a write.
    pub fn doubt_before(&mut self, earliest: Instant) {
        self.doubted_before = Some(earliest);
    }

    /// Whether a reply came too early to be believed.
    pub fn doubted(&self) -> bool {
        self.doubted
    }

    /// Whether the bytes that could not be believed are as many as the reply has: nothing is owed any more.
    pub fn is_paid(&self) -> bool {
        self.received.len() >= self.protocol.reply_chars(&self.request.pdu)
    }

    /// Bytes came in.
    pub fn on_bytes(&mut self, now: Instant, bytes: &[u8]) -> Step {
        self.first_byte.get_or_insert(now);
        self.received.extend_from_slice(bytes);
        let room = MOST_BYTES.saturating_sub(self.seen.len());
        self.seen.extend(bytes.iter().take(room));
        if self.received.len() > MOST_BYTES {
            return Step::Done(Ended::Corrupt("the line babbles"));
        }
        loop {
            if self.strip_echo() {
                continue;
            }
            match self.protocol.decode(self.request, &self.received) {
                Decoded::Reply { used, reply } if !self.is_too_early(&reply, now) => return self.replied(used, reply),
                Decoded::Reply { used, .. } | Decoded::Foreign { used } => {
                    self.foreign += 1;
                    self.received.drain(..used.min(self.received.len()));
                    self.first_byte = (!self.received.is_empty()).then_some(now);
                    self.garbage = None;
                    if self.received.is_empty() {
                        return self.on_time(now);
                    }
                }
                // The echo of the request can look like a broken reply until it is whole.
                _ if self.frame.starts_with(&self.received) => return self.on_time(now),
                Decoded::Incomplete => {
                    return self.behind_garbage(now).unwrap_or_else(|| {
                        // A new colon began a frame anew: it has the time until the deadline.
                        self.garbage = None;
                        self.on_time(now)
                    });
                }
                Decoded::Corrupt(why) => {
                    return self.behind_garbage(now).unwrap_or_else(|| {
                        self.garbage = Some((why, now + self.rest_time()));
                        self.on_time(now)
                    });
                }
            }
        }
    }

    fn is_too_early(&mut self, reply: &Reply, now: Instant) -> bool {
        let early = self.doubted_before.is_some_and(|earliest| now < earliest);
        self.doubted |= early && !matches!(reply, Reply::Exception(_));
        early && !matches!(reply, Reply::Exception(_))
    }

    fn replied(&mut self, used: usize, reply: Reply) -> Step {
        self.received.drain(..used.min(self.received.len()));
        Step::Done(Ended::Reply(reply))
    }

    /// The reply that stands whole behind garbage.
    fn behind_garbage(&mut self, now: Instant) -> Option<Step> {
        if self.echo && !self.echo_seen {
            // It could be the echo of a write.
            return None;
        }
        let (at, used, reply) = (1..self.received.len()).find_map(|at| {
            let rest = self.received.get(at..).filter(|rest| {
                rest.first()
                    .is_some_and(|&first| self.protocol.may_begin_behind_garbage(self.request.address, first))
            })?;
            match self.protocol.decode(self.request, rest) {
                Decoded::Reply {
                    reply: Reply::Exception(_),
                    ..
                } => None,
                Decoded::Reply { .. } if self.doubted_before.is_some_and(|earliest| now < earliest) => None,
                Decoded::Reply { used, reply } => Some((at, used, reply)),
                _ => None,
            }
        })?;
        self.foreign += 1;
        Some(self.replied(at + used, reply))
    }

    /// How long characters that belong to the garbage may still come.
    fn rest_time(&self) -> Duration {
        let expected = self.protocol.reply_chars(&self.request.pdu).max(1);
        let missing = expected.saturating_sub(self.received.len()) as u32 + GARBAGE_GAP;
        self.reply_time * missing / expected as u32
    }

    /// Time went by.
    pub fn on_time(&mut self, now: Instant) -> Step {
        let until = self
            .garbage
            .map_or(self.deadline, |(_, until)| until.min(self.deadline));
        if now < until {
            return Step::Wait(until);
        }
        let ended = match self.garbage {
            Some((why, _)) => Ended::Corrupt(why),
            None if self.received.is_empty() => Ended::Silent,
            None => Ended::Corrupt("the reply is incomplete"),
        };
        Step::Done(ended)
    }

    fn is_unlike_its_reply(&self) -> bool {
        is_unlike_its_reply(&self.request.pdu)
    }

    /// An adapter that hears itself sends the request back before the reply. A read cannot be answered by its own
    /// frame, so it shows the echo; the reply to a write of one register can, so there the echo must be known already.
    fn strip_echo(&mut self) -> bool {
        let tells = !self.echo_seen && (self.echo || self.is_unlike_its_reply());
        let noise = self.protocol.noise(&self.received);
        let from_frame = self.received.get(noise..).unwrap_or_default();
        if !tells || !from_frame.starts_with(self.frame) {
            return false;
        }
        self.received.drain(..noise + self.frame.len());
        self.first_byte = None;
        self.echo_seen = true;
        true
    }

    /// Whether the adapter sends back what it is given, as far as this exchange, which ended so, tells. Only an
    /// answered request whose reply looks otherwise tells: a reply without an echo before it means that an earlier echo was a freak, and believing in it would
    /// swallow the acknowledgements of all writes.
    pub fn echoes(&self, ended: &Ended) -> Option<bool> {
        let answered = matches!(ended, Ended::Reply(_));
        (self.is_unlike_its_reply() && (self.echo_seen || answered)).then_some(self.echo_seen)
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

/// Whether an echo of the request cannot pass for its reply.
pub fn is_unlike_its_reply(pdu: &RequestPdu) -> bool {
    use RequestPdu::{Diagnostics, MaskWrite, WriteCoil, WriteRegister};
    !matches!(
        pdu,
        WriteCoil { .. } | WriteRegister { .. } | Diagnostics { .. } | MaskWrite { .. }
    )
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
        let request = Request {
            address: 1,
            pdu,
            n2: Default::default(),
        };
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
        assert_eq!(transaction.on_bytes(now, &reply(2)), done(2));
        let answered = Ended::Reply(Reply::Registers(vec![2]));
        assert_eq!(transaction.echoes(&answered), Some(true));
        let mut transaction = start(&request, &frame, now);
        assert_eq!(transaction.echoes(&Ended::Silent), None);
        assert_eq!(transaction.on_bytes(now, &reply(2)), done(2));
        assert_eq!(
            transaction.echoes(&answered),
            Some(false),
            "an echo that is gone is forgotten"
        );
    }

    #[test]
    fn a_known_echo_does_not_acknowledge_a_write() {
        let request = Request {
            address: 1,
            pdu: RequestPdu::WriteRegister {
                address: 2000,
                value: 1,
            },
            n2: Default::default(),
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
    fn garbage_ends_the_exchange_once_no_more_of_it_can_come() {
        let (request, frame) = request();
        let now = Instant::now();
        let mut bytes = reply(2);
        bytes[3] ^= 0x10;
        let corrupt = |why| Step::Done(Ended::Corrupt(why));
        let char_time = Duration::from_millis(5) / 7;
        let mut transaction = start(&request, &frame, now);
        let Step::Wait(until) = transaction.on_bytes(now, &bytes) else {
            panic!("it ends at once")
        };
        assert!(until - now < char_time * 5, "a whole reply came: {:?}", until - now);
        assert_eq!(transaction.on_time(until), corrupt("check code is wrong"));
        // An impossible function, and the rest of the reply is still on the line.
        let mut transaction = start(&request, &frame, now);
        let Step::Wait(until) = transaction.on_bytes(now, &[1, 0x83, 0x99, 0x99, 0x99]) else {
            panic!("it ends at once")
        };
        assert!(until - now > char_time * 5, "{:?}", until - now);
        assert!(until - now < char_time * 7, "{:?}", until - now);
        // Never beyond the deadline.
        let deadline = now + Duration::from_millis(105);
        assert_eq!(
            transaction.on_bytes(deadline - char_time, &[0x99]),
            Step::Wait(deadline)
        );
        assert_eq!(transaction.on_time(deadline), corrupt("check code is wrong"));
    }

    #[test]
    fn a_reply_behind_noise_is_found_but_no_exception_and_no_echo() {
        let (request, frame) = request();
        let now = Instant::now();
        for noise in [&[0x37][..], &[0x01, 0x83, 0x02], &[0x01, 0x03, 0xFE], &[1, 3, 2, 0, 1]] {
            let mut transaction = start(&request, &frame, now);
            assert!(
                matches!(transaction.on_bytes(now, noise), Step::Wait(_)),
                "{noise:02X?}"
            );
            assert_eq!(transaction.on_bytes(now, &reply(9)), done(9), "{noise:02X?}");
            assert_eq!(transaction.foreign(), 1);
        }
        let mut exception = vec![0x37];
        rtu::encode_frame(1, &[0x83, 2], &mut exception);
        let mut transaction = start(&request, &frame, now);
        assert!(matches!(transaction.on_bytes(now, &exception), Step::Wait(_)));
        let pdu = RequestPdu::WriteRegister {
            address: 2000,
            value: 1,
        };
        let write = Request {
            address: 1,
            pdu,
            n2: Default::default(),
        };
        let mut bytes = vec![0x37];
        rtu::encode_request(&write, &mut bytes);
        let (ms, protocol) = (Duration::from_millis, Protocol::ModbusRtu);
        let begin = |echo| Transaction::new(protocol, &write, &bytes[1..], now, ms(100), ms(5), echo);
        assert_eq!(
            begin(false).on_bytes(now, &bytes),
            Step::Done(Ended::Reply(Reply::Written))
        );
        assert!(matches!(begin(true).on_bytes(now, &bytes), Step::Wait(_)));
    }

    #[test]
    fn the_last_reply_once_more_and_a_stray_echo_are_told_by_their_time() {
        let (request, frame) = request();
        let now = Instant::now();
        let ms = Duration::from_millis;
        let mut transaction = start(&request, &frame, now);
        transaction.doubt_before(now + ms(5));
        assert!(matches!(transaction.on_bytes(now + ms(1), &reply(1)), Step::Wait(_)));
        assert!(transaction.doubted());
        assert_eq!(transaction.on_bytes(now + ms(6), &reply(2)), done(2));
        let mut transaction = start(&request, &frame, now);
        transaction.doubt_before(now + ms(5));
        let mut exception = Vec::new();
        rtu::encode_frame(1, &[0x83, 2], &mut exception);
        assert!(matches!(
            transaction.on_bytes(now + ms(4), &exception),
            Step::Done(Ended::Reply(Reply::Exception(_)))
        ));
    }

    #[test]
    fn babble_is_bounded() {
        let (request, frame) = request();
        let now = Instant::now();
        let mut transaction = start(&request, &frame, now);
        let mut step = Step::Wait(now);
        for _ in 0..40 {
            step = transaction.on_bytes(now, &[0x55; 512]);
        }
        assert!(matches!(step, Step::Done(Ended::Corrupt(_))));
        assert!(transaction.seen().len() <= MOST_BYTES);
    }

    #[test]
    fn frames_to_all_and_of_nobody_are_foreign_and_exception_0_is_an_answer() {
        let (request, frame) = request();
        let now = Instant::now();
        for (address, pdu) in [(0, [3, 2, 0, 1]), (1, [4, 2, 0, 1]), (2, [3, 2, 0, 1])] {
            let mut bytes = Vec::new();
            rtu::encode_frame(address, &pdu, &mut bytes);
            let mut transaction = start(&request, &frame, now);
            assert!(matches!(transaction.on_bytes(now, &bytes), Step::Wait(_)));
            assert_eq!(transaction.foreign(), 1, "{address} {pdu:?}");
        }
        let mut bytes = Vec::new();
        rtu::encode_frame(1, &[0x83, 0], &mut bytes);
        let exception = Step::Done(Ended::Reply(Reply::Exception(crate::codec::Exception(0))));
        assert_eq!(start(&request, &frame, now).on_bytes(now, &bytes), exception);
    }

    /// A read of two registers in Modbus ASCII, its frame and its reply.
    fn in_ascii() -> (Request, Vec<u8>, &'static [u8]) {
        let pdu = RequestPdu::Read {
            table: Table::Holding,
            start: 0x20,
            count: 2,
        };
        let request = Request {
            address: 1,
            pdu,
            n2: Default::default(),
        };
        let mut frame = Vec::new();
        Protocol::ModbusAscii.encode(&request, &mut frame);
        (request, frame, b":01030400050000F3\r\n")
    }

    fn start_ascii<'r>(request: &'r Request, frame: &'r [u8], now: Instant, echo: bool) -> Transaction<'r> {
        let ms = Duration::from_millis;
        Transaction::new(Protocol::ModbusAscii, request, frame, now, ms(100), ms(19), echo)
    }

    #[test]
    fn an_ascii_reply_is_found_behind_noise_foreign_frames_and_broken_ones() {
        let (request, frame, reply) = in_ascii();
        let now = Instant::now();
        let truth = Step::Done(Ended::Reply(Reply::Registers(vec![5, 0])));
        for before in [
            b"".as_slice(),
            b"\xFF\x00\x7F",
            b":0103",
            b":\xFF:!",
            b"\n\r\n",
            b":0203040005000BE7\r\n",
            b":01030400050000F4\r\n",
            b":01030400050000F\r\n",
            b":0103040005\xB0\r\n",
        ] {
            for chunk in [1, 3, 100] {
                let mut transaction = start_ascii(&request, &frame, now, false);
                let bytes = [before, reply, b":"].concat();
                let mut step = Step::Wait(now);
                let mut pieces = bytes.chunks(chunk);
                while let (Step::Wait(_), Some(piece)) = (&step, pieces.next()) {
                    step = transaction.on_bytes(now, piece);
                }
                assert_eq!(step, truth, "{:?} by {chunk}", String::from_utf8_lossy(before));
            }
        }
        // Not behind a broken frame: an exception, which is short.
        let mut transaction = start_ascii(&request, &frame, now, false);
        let bytes = b":01030400050000F4\r\n:0183027A\r\n";
        assert!(matches!(transaction.on_bytes(now, bytes), Step::Wait(_)));
    }

    #[test]
    fn a_broken_ascii_reply_says_why_and_does_not_wait_for_the_deadline() {
        let (request, frame, reply) = in_ascii();
        let now = Instant::now();
        let deadline = now + Duration::from_millis(119);
        for (bytes, why) in [
            (b":01030400050000F4\r\n".as_slice(), "check code (LRC) is wrong"),
            (b":0103040005000F4\r\n", "an odd number of hexadecimal digits"),
            (
                b":01030400050000F3\n",
                "a line feed without a carriage return before it",
            ),
            (
                b":0103\xB40005",
                "a character has bit 7 set: noise, or the data bits and parity are not the drive's",
            ),
        ] {
            let mut transaction = start_ascii(&request, &frame, now, false);
            let Step::Wait(until) = transaction.on_bytes(now, bytes) else {
                panic!("it ends at once")
            };
            assert!(until < deadline, "{why}");
            assert_eq!(transaction.on_time(until), Step::Done(Ended::Corrupt(why)));
            assert_eq!(transaction.is_paid(), bytes.len() >= reply.len());
        }
        // A frame that begins anew has its time, whatever was before it.
        let mut transaction = start_ascii(&request, &frame, now, false);
        assert!(matches!(transaction.on_bytes(now, b":!"), Step::Wait(until) if until < deadline));
        assert_eq!(transaction.on_bytes(now, b":01"), Step::Wait(deadline));
        for unfinished in [&reply[..reply.len() - 1], b"\xFF\xFE", b"0103"] {
            let mut transaction = start_ascii(&request, &frame, now, false);
            assert_eq!(transaction.on_bytes(now, unfinished), Step::Wait(deadline));
            let ended = Step::Done(Ended::Corrupt("the reply is incomplete"));
            assert_eq!(transaction.on_time(deadline), ended);
        }
    }

    #[test]
    fn an_ascii_echo_is_dropped_behind_noise_too() {
        let (request, frame, reply) = in_ascii();
        let now = Instant::now();
        for noise in [b"".as_slice(), b"\x80", b":01"] {
            let mut transaction = start_ascii(&request, &frame, now, false);
            let bytes = [noise, &frame, reply].concat();
            let answered = Ended::Reply(Reply::Registers(vec![5, 0]));
            assert_eq!(transaction.on_bytes(now, &bytes), Step::Done(answered.clone()));
            assert_eq!((transaction.echoes(&answered), transaction.foreign()), (Some(true), 0));
        }
        let write = Request {
            address: 1,
            pdu: RequestPdu::WriteRegister { address: 1, value: 1 },
            n2: Default::default(),
        };
        let mut frame = Vec::new();
        Protocol::ModbusAscii.encode(&write, &mut frame);
        let mut transaction = start_ascii(&write, &frame, now, true);
        let written = Step::Done(Ended::Reply(Reply::Written));
        let bytes = [b"\x80".as_slice(), &frame].concat();
        assert!(matches!(transaction.on_bytes(now, &bytes), Step::Wait(_)));
        assert_eq!(transaction.on_bytes(now, &frame), written);
    }

    mod chance {
        use super::*;
        use proptest::prelude::*;

        /// What a fault makes of a reply on its way.
        fn mutated() -> impl Strategy<Value = Vec<u8>> {
            let truth = reply(0x4711);
            let len = truth.len();
            let other = |address: u8, pdu: Vec<u8>| {
                let mut frame = Vec::new();
                rtu::encode_frame(address, &pdu, &mut frame);
                frame
            };
            let (cut, flipped, whole) = (truth.clone(), truth.clone(), truth.clone());
            prop_oneof![
                Just(whole),
                (0..len).prop_map(move |keep| cut[..keep].to_vec()),
                (0..len * 8).prop_map(move |bit| {
                    let mut frame = flipped.clone();
                    frame[bit / 8] ^= 1 << (bit % 8);
                    frame
                }),
                proptest::collection::vec(any::<u8>(), 0..6),
                (any::<u8>(), any::<u16>()).prop_filter_map("the drive's own", move |(address, value)| {
                    let [high, low] = value.to_be_bytes();
                    (address != 1).then(|| other(address, vec![3, 2, high, low]))
                }),
                any::<u32>().prop_map(move |value| {
                    let mut pdu = vec![3, 4];
                    pdu.extend(value.to_be_bytes());
                    other(1, pdu)
                }),
                any::<u16>().prop_map(move |value| {
                    let [high, low] = value.to_be_bytes();
                    other(1, vec![4, 2, high, low])
                }),
            ]
        }

        proptest! {
            #![proptest_config(ProptestConfig::with_cases(2000))]

            #[test]
            fn only_the_truth_is_believed_and_the_deadline_holds(
                pieces in proptest::collection::vec(mutated(), 0..5),
                chunk in 1usize..20,
                gap_us in 0u64..8000,
            ) {
                let (request, frame) = request();
                let begun = Instant::now();
                let deadline = begun + Duration::from_millis(105);
                let mut transaction = start(&request, &frame, begun);
                let bytes = pieces.concat();
                let mut now = begun;
                let mut step = transaction.on_time(now);
                for piece in bytes.chunks(chunk) {
                    now += Duration::from_micros(gap_us);
                    let Step::Wait(until) = step else { break };
                    prop_assert!(until <= deadline);
                    step = if now >= until { transaction.on_time(until) } else { transaction.on_bytes(now, piece) };
                }
                if let Step::Wait(until) = step {
                    prop_assert!(until <= deadline);
                    step = transaction.on_time(until);
                }
                let Step::Done(ended) = step else {
                    return Err(TestCaseError::fail("it waits beyond what it said"));
                };
                match ended {
                    Ended::Reply(reply) => prop_assert_eq!(reply, Reply::Registers(vec![0x4711])),
                    Ended::Silent | Ended::Corrupt(_) => {}
                }
            }

            #[test]
            fn only_the_truth_is_believed_in_ascii_too(
                pieces in proptest::collection::vec(prop_oneof![
                    Just(b":01030400050000F3\r\n".to_vec()),
                    (0usize..19).prop_map(|keep| b":01030400050000F3\r\n"[..keep].to_vec()),
                    (0usize..19, any::<u8>()).prop_map(|(at, character)| {
                        let mut frame = b":01030400050000F3\r\n".to_vec();
                        frame[at] = character;
                        frame
                    }),
                    (2u8..=247, any::<[u8; 4]>()).prop_map(|(address, [a, b, c, d])| {
                        let mut frame = Vec::new();
                        crate::codec::ascii::encode_frame(address, &[3, 4, a, b, c, d], &mut frame);
                        frame
                    }),
                    proptest::collection::vec(any::<u8>(), 0..6),
                    proptest::collection::vec(
                        prop_oneof![Just(b':'), Just(b'\n'), Just(b'\r'), b'0'..=b'9', any::<u8>()], 0..30),
                ], 0..6),
                chunk in 1usize..20,
                gap_us in 0u64..8000,
            ) {
                let (request, frame, _) = in_ascii();
                let begun = Instant::now();
                let deadline = begun + Duration::from_millis(119);
                let mut transaction = start_ascii(&request, &frame, begun, false);
                let bytes = pieces.concat();
                let mut now = begun;
                let mut step = transaction.on_time(now);
                for piece in bytes.chunks(chunk) {
                    now += Duration::from_micros(gap_us);
                    let Step::Wait(until) = step else { break };
                    prop_assert!(until <= deadline);
                    step = if now >= until { transaction.on_time(until) } else { transaction.on_bytes(now, piece) };
                }
                if let Step::Wait(until) = step {
                    prop_assert!(until <= deadline);
                    step = transaction.on_time(until);
                }
                match step {
                    Step::Done(Ended::Reply(reply)) => prop_assert_eq!(reply, Reply::Registers(vec![5, 0])),
                    Step::Done(Ended::Silent | Ended::Corrupt(_)) => {}
                    Step::Wait(_) => return Err(TestCaseError::fail("it waits beyond what it said")),
                }
            }

            #[test]
            fn a_true_reply_in_time_behind_foreign_frames_is_found(
                strangers in proptest::collection::vec((2u8..=247, any::<u16>()), 0..4),
                noise in proptest::collection::vec(any::<u8>(), 0..4),
                chunk in 1usize..20,
            ) {
                let (request, frame) = request();
                let now = Instant::now();
                let mut bytes = Vec::new();
                let strange = strangers.len() as u32;
                for (address, value) in strangers {
                    let [high, low] = value.to_be_bytes();
                    rtu::encode_frame(address, &[3, 2, high, low], &mut bytes);
                }
                bytes.extend(noise);
                bytes.extend(reply(0x4711));
                let mut transaction = start(&request, &frame, now);
                let mut step = transaction.on_time(now);
                for piece in bytes.chunks(chunk) {
                    if matches!(step, Step::Done(_)) {
                        break;
                    }
                    step = transaction.on_bytes(now, piece);
                }
                // Noise and the first bytes of the reply make a sound frame of nobody once in some ten thousand cases.
                prop_assert!(step == done(0x4711) || transaction.foreign() > strange, "{:?}", step);
            }
        }
    }
}
