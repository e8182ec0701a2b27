//! The decoder of a line that another master owns, without drives: every accepted reply was sent to the request
//! that the decoder names, with frames whose order, damage and delay a seed decides.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use drivegate_bus::listener::{Decoder, Traffic};
use drivegate_proto::{LineFormat, Protocol, Reply, Request, RequestPdu, Table, ascii, n2, rtu};

/// Replies that a decoder accepts from successive frames, each with a pause in ms before it: address, first
/// register, words.
fn believed(protocol: Protocol, frames: &[(&[u8], u64)]) -> Vec<(u8, u16, Vec<u16>)> {
    let format = LineFormat::new(19_200, "8N1").unwrap();
    let mut decoder = Decoder::new(protocol, format, BTreeMap::new());
    let (mut heard, mut now) = (Vec::new(), Instant::now());
    for (frame, pause) in frames {
        now += Duration::from_millis(*pause);
        decoder.on_time(now, &mut heard);
        now += format.chars(frame.len());
        decoder.on_bytes(frame, now, &mut heard);
    }
    decoder.on_time(now + Duration::from_secs(10), &mut heard);
    heard.iter().filter_map(read).collect()
}

/// A read that is believed.
fn read(heard: &Traffic) -> Option<(u8, u16, Vec<u16>)> {
    let Traffic::Exchange(exchange) = heard else {
        return None;
    };
    let (request, reply) = exchange.believed()?;
    let RequestPdu::Read { start, .. } = request.pdu else {
        return None;
    };
    Some((exchange.address, start, reply.words()?))
}

fn framed(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = Vec::new();
    rtu::encode_frame(address, pdu, &mut frame);
    frame
}

#[test]
fn a_reply_is_believed_only_where_it_is_sure_what_it_answers() {
    let one = framed(1, &[3, 0, 10, 0, 1]);
    let two = framed(1, &[3, 0, 20, 0, 1]);
    let other = framed(2, &[3, 0, 20, 0, 1]);
    let (said, said_by_2) = (framed(1, &[3, 2, 0, 5]), framed(2, &[3, 2, 0, 6]));
    let all = |frames: &[(&[u8], u64)]| believed(Protocol::ModbusRtu, frames);
    let first = (1, 10, vec![5]);
    assert_eq!(all(&[(&one, 5), (&said, 5)]), std::slice::from_ref(&first));
    // Reception begins in the middle of a transaction, and two transactions arrive in one lump.
    let lump = [one.clone(), said.clone(), two.clone(), said.clone()].concat();
    assert_eq!(all(&[(&said[3..], 5), (&lump, 5)]), [first.clone(), (1, 20, vec![5])]);
    // The other master gave up the first request, so the reply may be the late one. For the same request, the reply
    // is true in both cases.
    assert_eq!(all(&[(&one, 5), (&two, 200), (&said, 5)]), []);
    assert_eq!(all(&[(&one, 5), (&one, 200), (&said, 5)]), std::slice::from_ref(&first));
    assert_eq!(all(&[(&one, 5), (&two, 900), (&said, 5)]), []);
    let later = [(&one[..], 5), (&two, 200), (&said, 5), (&two, 1100), (&said, 5)];
    assert_eq!(all(&later), [(1, 20, vec![5])]);
    // A late reply of one drive is not taken for a reply of another drive.
    assert_eq!(all(&[(&one, 5), (&other, 200), (&said_by_2, 5)]), [(2, 20, vec![6])]);
    // A glitch before the reply does not matter; more bytes may have been another request.
    let behind = |count: usize| [vec![0xFE; count], said.clone()].concat();
    assert_eq!(all(&[(&one, 5), (&behind(2), 5)]), std::slice::from_ref(&first));
    let mut mangled = two.clone();
    mangled[3] ^= 1;
    assert_eq!(all(&[(&one, 5), (&mangled, 200), (&said, 5)]), []);
    // A mangled request without a reply: whose reply is the next one?
    assert_eq!(all(&[(&mangled, 5), (&one, 200), (&said, 5)]), []);
    let answered = [(&mangled[..], 5), (&said, 5), (&one, 200), (&said, 5)];
    assert_eq!(all(&answered), std::slice::from_ref(&first));
    // A frame with an unknown function is nevertheless a valid frame.
    let unknown = framed(1, &[0x41, 9]);
    assert_eq!(all(&[(&unknown, 5), (&one, 200), (&said, 5)]), [first]);
}

#[test]
fn a_reply_of_bits_that_could_be_a_request_is_not_believed() {
    // With 24 bits, the reply has as many bytes as a request.
    let ask = framed(1, &[1, 0, 0, 0, 24]);
    let reply = framed(1, &[1, 3, 0x12, 0x00, 0x10]);
    assert_eq!(believed(Protocol::ModbusRtu, &[(&ask, 5), (&reply, 5)]), []);
    // This reply cannot be a request: 0xF012 bits are too many.
    let reply = framed(1, &[1, 3, 0x12, 0xF0, 0x12]);
    assert_eq!(believed(Protocol::ModbusRtu, &[(&ask, 5), (&reply, 5)]).len(), 1);
    let line = |pdu: &[u8]| {
        let mut frame = Vec::new();
        ascii::encode_frame(1, pdu, &mut frame);
        frame
    };
    let (ask, reply) = (line(&[1, 0, 0, 0, 24]), line(&[1, 3, 0x12, 0x00, 0x10]));
    assert_eq!(believed(Protocol::ModbusAscii, &[(&ask, 5), (&reply, 5)]), []);
}

#[test]
fn an_n2_reply_belongs_to_the_request_before_it() {
    let (read, state) = (&b">0111020388\r"[..], &b">0112020288\r"[..]);
    let other = &b">0211020389\r"[..];
    let sum = b"42700000".iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    let float = format!("A42700000{sum:02X}\r").into_bytes();
    let all = |frames: &[(&[u8], u64)]| believed(Protocol::N2, frames);
    assert_eq!(all(&[(read, 5), (&float, 5)]), [(1, 2, vec![0x4270, 0])]);
    assert_eq!(all(&[(state, 5), (b"A4064\r", 5)]), [(1, 1, vec![1])]);
    // The float may be the late reply for another object or drive; a state is not a float, and a float of the same
    // object is true in any case.
    assert_eq!(all(&[(other, 5), (read, 300), (&float, 5)]), []);
    assert_eq!(all(&[(read, 5), (read, 300), (&float, 5)]), [(1, 2, vec![0x4270, 0])]);
    assert_eq!(all(&[(read, 5), (state, 300), (b"A4064\r", 5)]), [(1, 1, vec![1])]);
}

/// Random numbers from a seed.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ (mixed >> 31)
    }

    fn below(&mut self, end: u64) -> u64 {
        self.next() % end
    }

    fn chance(&mut self, share: f64) -> bool {
        (self.next() >> 11) as f64 / ((1u64 << 53) as f64) < share
    }
}

/// Faults of the line: shares of bytes, and shares of replies.
#[derive(Debug, Clone, Copy, Default)]
struct Fate {
    garbled: f64,
    lost: f64,
    added: f64,
    silent: f64,
    late: f64,
}

/// A master, drives whose words are all different, and the decoder that listens to them.
struct Talk {
    protocol: Protocol,
    format: LineFormat,
    decoder: Decoder,
    dice: Dice,
    fate: Fate,
    began: Instant,
    now: Duration,
    /// Frames of drives that have not been sent yet.
    coming: Vec<(Duration, Vec<u8>)>,
    said: BTreeMap<(u8, u16), VecDeque<Vec<u16>>>,
    heard: Vec<Traffic>,
    counter: u32,
    believed: u64,
}

impl Talk {
    fn new(protocol: Protocol, baud: u32, fate: Fate, seed: u64) -> Talk {
        let format = LineFormat::new(baud, "8N1").unwrap();
        Talk {
            protocol,
            format,
            decoder: Decoder::new(protocol, format, BTreeMap::new()),
            dice: Dice(seed),
            fate,
            began: Instant::now(),
            now: Duration::from_millis(1),
            coming: Vec::new(),
            said: BTreeMap::new(),
            heard: Vec::new(),
            counter: 0,
            believed: 0,
        }
    }

    /// A frame whose last byte is on the wire now reaches the decoder, in lumps.
    fn carry(&mut self, frame: &[u8]) {
        let mut bytes = Vec::new();
        for byte in frame {
            if self.dice.chance(self.fate.lost) {
                continue;
            }
            let garbled = self.dice.chance(self.fate.garbled);
            let other = self.dice.next() as u8;
            bytes.push(if garbled { other } else { *byte });
            if self.dice.chance(self.fate.added) {
                bytes.push(self.dice.next() as u8);
            }
        }
        let lump = 1 + self.dice.below(16) as usize;
        let (end, count) = (self.began + self.now, bytes.len());
        for (place, part) in bytes.chunks(lump).enumerate() {
            let behind = count - place * lump - part.len();
            let at = end - self.format.chars(behind);
            self.decoder.on_bytes(part, at, &mut self.heard);
        }
        self.check();
    }

    fn check(&mut self) {
        for heard in self.heard.drain(..) {
            let Some((address, start, words)) = read(&heard) else {
                continue;
            };
            self.believed += 1;
            let said = self.said.get(&(address, start));
            let is_true = said.is_some_and(|said| said.contains(&words));
            assert!(
                is_true,
                "{:?} {address} {start}: {words:?} of {said:?}\n{heard:?}",
                self.protocol
            );
        }
    }

    /// The frame of a drive's answer: words that no other answer has.
    fn answer(&mut self, request: &Request) -> Vec<u8> {
        let RequestPdu::Read { table, start, count } = request.pdu else {
            panic!("{request:?}");
        };
        self.counter += 1;
        let mut frame = Vec::new();
        let words = if self.protocol == Protocol::N2 {
            let value = self.counter as f32;
            n2::Answer::bytes(&value.to_be_bytes()).encode(&mut frame);
            vec![(value.to_bits() >> 16) as u16, value.to_bits() as u16]
        } else {
            let words: Vec<u16> = (0..count).map(|_| self.dice.next() as u16).collect();
            let mut pdu = Vec::new();
            Reply::Registers(words.clone()).encode(&request.pdu, &mut pdu);
            match self.protocol {
                Protocol::ModbusAscii => ascii::encode_frame(request.address, &pdu, &mut frame),
                _ => rtu::encode_frame(request.address, &pdu, &mut frame),
            }
            words
        };
        assert!(!table.is_bits());
        let said = self.said.entry((request.address, start)).or_default();
        said.push_back(words);
        if said.len() > 3 {
            said.pop_front();
        }
        frame
    }

    /// Sends a request; drives answer the requests they receive, sometimes late or never.
    fn ask(&mut self, address: u8, start: u16, count: u16) {
        let pdu = RequestPdu::Read {
            table: Table::Holding,
            start,
            count,
        };
        let request = Request::new(address, pdu);
        let mut frame = Vec::new();
        self.protocol.encode(&request, &mut frame);
        // Late replies to earlier requests arrive before this request, or collide with it: then neither is received.
        let end = self.now + self.format.chars(frame.len());
        let (before, rest): (Vec<_>, Vec<_>) = std::mem::take(&mut self.coming)
            .into_iter()
            .partition(|(at, _)| *at <= self.now);
        let (collides, rest): (Vec<_>, Vec<_>) = rest
            .into_iter()
            .partition(|(at, frame)| *at < end + self.format.chars(frame.len()));
        self.coming = rest;
        before.iter().for_each(|(_, frame)| self.carry(frame));
        self.now = end;
        if !collides.is_empty() {
            frame.iter_mut().for_each(|byte| *byte ^= 0x55);
            self.carry(&frame);
            self.now += Duration::from_millis(100);
            return;
        }
        self.carry(&frame);
        let answer = self.answer(&request);
        let turnaround = Duration::from_micros(500 + self.dice.below(4000));
        let due = self.now + turnaround + self.format.chars(answer.len());
        let patience = Duration::from_millis(100) + self.format.chars(answer.len());
        let limit = self.now + patience;
        if self.dice.chance(self.fate.late) {
            let late = Duration::from_millis(90 + self.dice.below(700));
            self.coming.push((due + late, answer));
        } else if !self.dice.chance(self.fate.silent) {
            self.coming.push((due, answer));
        }
        self.coming.sort();
        // The master accepts whatever reply comes first, as real masters do.
        let taken = self.coming.first().map(|(at, _)| *at).filter(|at| *at <= limit);
        if taken.is_some() {
            let (at, frame) = self.coming.remove(0);
            self.now = self.now.max(at);
            self.carry(&frame);
        } else {
            self.now = limit;
        }
        self.now += self.format.silence_spec() + Duration::from_micros(self.dice.below(3000));
        self.decoder.on_time(self.began + self.now, &mut self.heard);
        self.check();
    }

    /// Reads blocks of several lengths from three drives; some of the blocks look alike.
    fn rounds(&mut self, exchanges: u64) {
        let blocks: &[(u16, u16)] = match self.protocol {
            Protocol::N2 => &[(0, 2), (2, 2), (4, 2), (6, 2)],
            _ => &[(2100, 11), (2000, 3), (100, 2), (7, 2), (300, 1), (310, 1)],
        };
        for number in 0..exchanges {
            let place = number as usize;
            let (start, count) = blocks[place % blocks.len()];
            self.ask(1 + (place / blocks.len() % 3) as u8, start, count);
        }
    }
}

/// Lines, with the exchanges that each has of 100,000.
const LINES: [(Protocol, u32, u64); 6] = [
    (Protocol::ModbusRtu, 9600, 25_000),
    (Protocol::ModbusRtu, 38_400, 20_000),
    (Protocol::ModbusRtu, 115_200, 25_000),
    (Protocol::ModbusAscii, 9600, 10_000),
    (Protocol::ModbusAscii, 38_400, 10_000),
    (Protocol::N2, 9600, 10_000),
];

#[test]
fn on_a_sound_line_all_is_believed() {
    for (protocol, baud, exchanges) in LINES {
        let mut talk = Talk::new(protocol, baud, Fate::default(), 1);
        talk.rounds(exchanges);
        assert_eq!(talk.believed, exchanges, "{protocol:?} {baud}");
    }
}

#[test]
fn what_befalls_the_line_makes_no_wrong_value() {
    let garbled = Fate {
        garbled: 0.01,
        ..Fate::default()
    };
    let lost = Fate {
        lost: 0.01,
        ..Fate::default()
    };
    let added = Fate {
        added: 0.01,
        ..Fate::default()
    };
    let late = Fate {
        silent: 0.01,
        late: 0.02,
        ..Fate::default()
    };
    for (protocol, baud, exchanges) in LINES {
        for (seed, (fate, least)) in [(garbled, 0.3), (lost, 0.3), (added, 0.3), (late, 0.1)]
            .into_iter()
            .enumerate()
        {
            let mut talk = Talk::new(protocol, baud, fate, seed as u64 + 7);
            talk.rounds(exchanges / 2);
            let share = talk.believed as f64 / (exchanges / 2) as f64;
            println!("{protocol:?} {baud} {fate:?}: {:.1} % believed", share * 100.0);
            assert!(share > least, "{protocol:?} {baud} {fate:?}: {share}");
        }
    }
}
