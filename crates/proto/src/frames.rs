//! Splits the bytes on a line into requests, replies and other pieces. Pure: time is an argument.
//!
//! Drivers and adapters deliver bytes late and in lumps, so silence proves little. A frame is recognised by its
//! content: a request by function, length and check code; a reply by the preceding request. Silence only discards
//! incomplete frames.

use std::time::{Duration, Instant};

use super::n2::{self, Command};
use super::{Decoded, LineFormat, Protocol, Reply, Request, RequestPdu, ascii, rtu};

/// Time for which a USB adapter may hold bytes back, with a margin.
pub const ADAPTER_DELAY: Duration = Duration::from_millis(30);
/// Highest address of a drive by the Modbus specification.
pub const HIGHEST_ADDRESS: u8 = 247;
/// Bytes that are kept while no frame is found among them; no frame is longer.
const MOST_BYTES: usize = 1024;
/// Up to this many characters before a reply count as a glitch of a line that changes direction, not as a damaged
/// request.
pub const GLITCH: usize = 2;

/// The piece found at the beginning of the bytes.
#[derive(Debug, Clone, PartialEq)]
pub enum Cut {
    /// A request of the other master; the PDU is `None` if the codec does not know it.
    Request {
        /// Address of the drive; 0 is the broadcast.
        address: u8,
        /// The request, if it was decoded.
        pdu: Option<RequestPdu>,
    },
    /// The reply to the request that is open.
    Reply {
        /// The decoded reply.
        reply: Reply,
        /// Whether the bytes could be a request of the other master as well.
        ambiguous: bool,
    },
    /// Bytes that are neither a request nor the reply.
    Garbage,
}

/// A piece of the received bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// The content of the piece.
    pub cut: Cut,
    /// The bytes of the piece, as received.
    pub bytes: Vec<u8>,
    /// Start of its first character on the wire, estimated from the arrival of the bytes.
    pub began: Instant,
    /// End of its last character on the wire, estimated from the arrival of the bytes.
    pub ended: Instant,
}

/// Result of a search for a frame at one position in the bytes.
enum FrameSearch {
    Is(usize, Cut),
    /// The bytes may become a frame when more arrive. `true` means that the received part already makes a reply likely.
    MayBecome(bool),
    Nothing,
}

/// Bytes that are not split into frames yet, with their times.
#[derive(Debug)]
pub struct Frames {
    protocol: Protocol,
    format: LineFormat,
    bytes: Vec<u8>,
    /// When the last bit of each character arrived.
    times: Vec<Instant>,
    last: Option<Instant>,
    held_back: Duration,
    highest: u8,
}

impl Frames {
    /// Starts without any received bytes. The rest of an incomplete frame is no longer expected after silence of
    /// `held_back` in addition to 3.5 characters.
    pub fn new(protocol: Protocol, format: LineFormat, held_back: Duration) -> Frames {
        Frames {
            protocol,
            format,
            held_back,
            highest: HIGHEST_ADDRESS,
            bytes: Vec::new(),
            times: Vec::new(),
            last: None,
        }
    }

    /// Sets the highest address of Modbus requests, which is [`HIGHEST_ADDRESS`] at first.
    pub fn set_highest_address(&mut self, highest: u8) {
        self.highest = highest;
    }

    /// Adds bytes that arrived at `now`: the last of them just then, the others earlier by their wire time, but not
    /// before previously received bytes.
    pub fn add(&mut self, bytes: &[u8], now: Instant) {
        for (place, byte) in bytes.iter().enumerate() {
            let behind = self.format.chars(bytes.len() - 1 - place);
            let at = now.checked_sub(behind).unwrap_or(now);
            let at = self.last.map_or(at, |last| at.max(last));
            self.last = Some(at);
            self.bytes.push(*byte);
            self.times.push(at);
        }
    }

    /// When bytes that wait for more are given up; sooner for complete frames that are not a request known to the codec.
    pub fn patience(&self) -> Option<Instant> {
        let last = self.last.filter(|_| !self.bytes.is_empty())?;
        let held_back = match self.protocol {
            Protocol::ModbusRtu if rtu::open_frame(&self.bytes).is_some() => self.held_back.min(ADAPTER_DELAY),
            _ => self.held_back,
        };
        Some(last + self.format.silence_chars() + held_back)
    }

    /// The bytes that are not cut yet.
    pub fn rest(&self) -> &[u8] {
        &self.bytes
    }

    /// The next piece, if one can be split off by `now`; `open` is the request whose reply may arrive.
    pub fn next(&mut self, open: Option<&Request>, now: Instant) -> Option<Piece> {
        if self.bytes.is_empty() {
            return None;
        }
        let silent = self.patience().is_some_and(|until| now >= until) || self.bytes.len() > MOST_BYTES;
        match self.protocol {
            Protocol::ModbusRtu => self.next_rtu(open, silent),
            Protocol::ModbusAscii => self.next_line(b'\n', ascii::LONGEST, open, silent),
            Protocol::N2 => self.next_line(b'\r', n2::LONGEST, open, silent),
        }
    }

    fn next_rtu(&mut self, open: Option<&Request>, silent: bool) -> Option<Piece> {
        let mut incomplete = false;
        for at in 0..self.bytes.len() {
            let rest = self.bytes.get(at..).unwrap_or_default();
            // After more than a short glitch no reply is accepted: the request that it belongs to may be in the garbage.
            let open = open.filter(|_| at <= GLITCH);
            match rtu_at(rest, open, self.highest) {
                FrameSearch::Is(length, cut) if at <= GLITCH && matches!(cut, Cut::Reply { .. }) => {
                    return self.cut(at + length, cut);
                }
                FrameSearch::Is(..) if at > 0 => return self.cut(at, Cut::Garbage),
                FrameSearch::Is(length, cut) => return self.cut(length, cut),
                FrameSearch::MayBecome(true) if !silent => {
                    incomplete = true;
                    break;
                }
                FrameSearch::MayBecome(false) if !silent => incomplete = true,
                _ => {}
            }
        }
        // Bytes that may still become a frame wait for the next frame or for silence; the rest becomes one piece of
        // garbage.
        if incomplete {
            None
        } else {
            self.cut(self.bytes.len(), Cut::Garbage)
        }
    }

    /// The next piece of a protocol whose frames are lines that end with `end`.
    fn next_line(&mut self, end: u8, longest: usize, open: Option<&Request>, silent: bool) -> Option<Piece> {
        let Some(length) = self.bytes.iter().position(|byte| *byte == end).map(|at| at + 1) else {
            if silent || self.bytes.len() > longest {
                return self.cut(self.bytes.len(), Cut::Garbage);
            }
            return None;
        };
        let line = self.bytes.get(..length).unwrap_or_default();
        let begin = begin_of(self.protocol, line);
        let frame = line.get(begin..).unwrap_or_default();
        let cut = line_cut(self.protocol, frame, open.filter(|_| begin <= GLITCH), self.highest);
        // Bytes before a request become a separate piece.
        if begin > 0 && !matches!(cut, Cut::Reply { .. } | Cut::Garbage) {
            return self.cut(begin, Cut::Garbage);
        }
        self.cut(length, cut)
    }

    fn cut(&mut self, length: usize, cut: Cut) -> Option<Piece> {
        let length = length.min(self.bytes.len());
        let bytes: Vec<u8> = self.bytes.drain(..length).collect();
        let times: Vec<Instant> = self.times.drain(..length).collect();
        let (first, last) = (times.first().copied()?, times.last().copied()?);
        Some(Piece {
            cut,
            bytes,
            began: first.checked_sub(self.format.chars(1)).unwrap_or(first),
            ended: last,
        })
    }
}

/// Searches for a frame at the start of `bytes` on a Modbus RTU line.
fn rtu_at(bytes: &[u8], open: Option<&Request>, highest: u8) -> FrameSearch {
    let reply = open.map_or(FrameSearch::Nothing, |open| rtu_reply(bytes, open));
    match (reply, rtu_request(bytes, highest)) {
        (FrameSearch::Is(length, cut), _) => FrameSearch::Is(length, cut),
        // The first three bytes fit the expected reply; a request would have another byte count there.
        (FrameSearch::MayBecome(true), _) => FrameSearch::MayBecome(true),
        (_, FrameSearch::Is(length, cut)) => FrameSearch::Is(length, cut),
        (FrameSearch::MayBecome(_), _) => FrameSearch::MayBecome(false),
        (FrameSearch::Nothing, request) => request,
    }
}

fn rtu_reply(bytes: &[u8], open: &Request) -> FrameSearch {
    let head = [Some(open.address), Some(open.pdu.function()), announced(&open.pdu)];
    let refusal = [Some(open.address), Some(open.pdu.function() | 0x80), None];
    let fits = |head: [Option<u8>; 3]| {
        let pairs = bytes.iter().zip(head);
        pairs
            .into_iter()
            .all(|(byte, wanted)| wanted.is_none_or(|wanted| *byte == wanted))
    };
    if !fits(head) && !fits(refusal) {
        return FrameSearch::Nothing;
    }
    match rtu::decode_reply(open, bytes) {
        Decoded::Reply { used, reply } => {
            let pdu = bytes.get(1..used.saturating_sub(2)).unwrap_or_default();
            match reply_or_request(open, &reply, pdu) {
                Some(cut) => FrameSearch::Is(used, cut),
                None => FrameSearch::Nothing,
            }
        }
        // Two bytes may also be the start of a request.
        Decoded::Incomplete => FrameSearch::MayBecome(bytes.len() > 2 && announced(&open.pdu).is_some()),
        Decoded::Foreign { .. } | Decoded::Corrupt(_) => FrameSearch::Nothing,
    }
}

/// The third byte of a reply to a read: its number of data bytes.
fn announced(pdu: &RequestPdu) -> Option<u8> {
    match pdu {
        RequestPdu::Read { .. } | RequestPdu::ReadWrite { .. } => u8::try_from(pdu.reply_len() - 2).ok(),
        _ => None,
    }
}

/// Judges a PDU that has the form of a reply to `open`. `None` if the PDU repeats the open request. A reply to a
/// read that could also be a request is ambiguous: the other master may be sending another request.
fn reply_or_request(open: &Request, reply: &Reply, pdu: &[u8]) -> Option<Cut> {
    let request = RequestPdu::decode(pdu).ok();
    let reads = matches!(reply, Reply::Bits(_) | Reply::Registers(_));
    if reads && request.as_ref() == Some(&open.pdu) {
        return None;
    }
    Some(Cut::Reply {
        reply: reply.clone(),
        ambiguous: reads && request.is_some(),
    })
}

fn rtu_request(bytes: &[u8], highest: u8) -> FrameSearch {
    let (Some(&address), Some(&function)) = (bytes.first(), bytes.get(1)) else {
        return FrameSearch::MayBecome(false);
    };
    if address > highest || !rtu::is_known(function) {
        return FrameSearch::Nothing;
    }
    // The number of bytes must agree with a count before them.
    let counted = match function {
        15 => (usize::from(word(bytes, 4)).div_ceil(8), 6),
        16 => (2 * usize::from(word(bytes, 4)), 6),
        23 => (2 * usize::from(word(bytes, 8)), 10),
        _ => (0, usize::MAX),
    };
    let announced = bytes.get(counted.1).map(|byte| usize::from(*byte));
    if announced.is_some_and(|bytes| bytes != counted.0 || bytes == 0) {
        return FrameSearch::Nothing;
    }
    let whole = rtu::request_len(bytes).and_then(|length| Some((length, bytes.get(..length)?)));
    let Some((length, frame)) = whole else {
        return FrameSearch::MayBecome(announced.is_some());
    };
    match rtu::decode_request(frame) {
        Some((address, pdu)) => FrameSearch::Is(length, Cut::Request { address, pdu: pdu.ok() }),
        None => FrameSearch::Nothing,
    }
}

/// Whether bytes that are neither request nor reply still are whole frames: of a function that the codec does not know, or an
/// answer to no request.
pub fn are_sound(protocol: Protocol, bytes: &[u8]) -> bool {
    match protocol {
        Protocol::ModbusRtu => {
            let mut rest = bytes;
            while !rest.is_empty() {
                let whole = |length: &usize| {
                    rest.get(..*length)
                        .is_some_and(|frame| rtu::open_frame(frame).is_some())
                };
                let Some(length) = (4..=rest.len().min(rtu::LONGEST)).find(whole) else {
                    return false;
                };
                rest = rest.get(length..).unwrap_or_default();
            }
            true
        }
        Protocol::ModbusAscii => bytes
            .split_inclusive(|byte| *byte == b'\n')
            .all(|line| ascii::open_frame(line).is_some()),
        Protocol::N2 => bytes.split_inclusive(|byte| *byte == b'\r').all(|line| {
            line.strip_suffix(b"\r")
                .is_some_and(|line| n2::Answer::decode(line).is_ok())
        }),
    }
}

/// Whether so much garbage may be a request that was mangled and got no reply: as much as half of the shortest one, and not as much
/// as that and the shortest reply.
pub fn may_be_request(protocol: Protocol, garbage: usize) -> bool {
    let (request, reply) = match protocol {
        Protocol::ModbusRtu => (8, 5),
        Protocol::ModbusAscii => (17, 11),
        Protocol::N2 => (12, 2),
    };
    (request / 2 + 1..request + reply).contains(&garbage)
}

fn word(bytes: &[u8], at: usize) -> u16 {
    let byte = |at: usize| bytes.get(at).copied().unwrap_or_default();
    u16::from_be_bytes([byte(at), byte(at + 1)])
}

/// Where the frame in a line begins: at its last colon or `>`, or on N2 at its first letter.
fn begin_of(protocol: Protocol, line: &[u8]) -> usize {
    match protocol {
        Protocol::N2 => {
            let request = line.iter().rposition(|byte| *byte == b'>');
            request
                .or_else(|| line.iter().position(u8::is_ascii_graphic))
                .unwrap_or(0)
        }
        Protocol::ModbusAscii | Protocol::ModbusRtu => line.iter().rposition(|byte| *byte == b':').unwrap_or(0),
    }
}

/// Decides what one whole line is: a request, the reply to the open request, or garbage.
fn line_cut(protocol: Protocol, frame: &[u8], open: Option<&Request>, highest: u8) -> Cut {
    let reply = match open.map(|open| (open, protocol.decode(open, frame))) {
        Some((open, Decoded::Reply { reply, .. })) => Some((open, reply)),
        _ => None,
    };
    if protocol == Protocol::N2 {
        return match (Command::decode(frame), reply) {
            (Some((address, Ok(command))), _) => Cut::Request {
                address,
                pdu: n2::pdu_of(&command),
            },
            (None, Some((_, reply))) => Cut::Reply {
                reply,
                ambiguous: false,
            },
            _ => Cut::Garbage,
        };
    }
    let Some((address, pdu)) = ascii::open_frame(frame) else {
        return Cut::Garbage;
    };
    if let Some(cut) = reply.and_then(|(open, reply)| reply_or_request(open, &reply, &pdu)) {
        return cut;
    }
    match RequestPdu::decode(&pdu) {
        Ok(pdu) if address <= highest => Cut::Request {
            address,
            pdu: Some(pdu),
        },
        _ => Cut::Garbage,
    }
}
