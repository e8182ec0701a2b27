//! One transaction on the line. Pure: driven by bytes and time.
//!
//! Garbage does not end a transaction at once: noise may have hit the start of a valid reply, and the rest of a
//! broken one may still be on the line. The transaction continues until as many characters arrived as a reply has,
//! or no more arrived for their duration, but never beyond the deadline. A complete Modbus reply after garbage is
//! accepted: address, function, length and check code match, which random bytes do once in 2^40; in Modbus ASCII
//! they would also have to be digits between a colon and CR LF. An exception is shorter and may split a block:
//! after garbage it is not accepted, and the request is repeated. N2 replies are never accepted after garbage.
//! Bytes before the colon of a Modbus ASCII frame are not garbage but noise, which its decoder skips.

use std::ops::Range;
use std::time::{Duration, Instant};

use super::n2_late_replies::{N2LateReplies, Taken};
use drivegate_proto::n2::Session;
use drivegate_proto::{Decoded, Exception, Protocol, Reply, Request, RequestPdu};

/// Maximum number of bytes considered in one transaction: further bytes are noise.
const MOST_BYTES: usize = 1024;
/// Silence, in characters, after which no more garbage is expected.
const GARBAGE_GAP: u32 = 4;

/// Silence after a reply of unknown length that makes it complete: longer than a USB adapter buffers bytes.
const WHOLE_AFTER: Duration = Duration::from_millis(20);

/// Reason to reject a reply that may be a late reply to an earlier request.
pub const MAY_BE_LATE: &str = "it may be the late reply to an earlier request";

/// Reason why a transaction has no reply if the device server closed the connection after its request.
pub const CONNECTION_CLOSED: &str = "the device server closed the connection, and no reply arrived over the next one";

/// The result of a transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ended {
    /// The drive replied, perhaps with an exception: it is alive.
    Reply(Reply),
    /// No valid frame arrived before the deadline: counts towards going offline.
    Silent,
    /// An invalid reply: retried once the line is silent.
    Corrupt(&'static str),
}

/// What to do next in a transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// Wait for bytes until this time.
    Wait(Instant),
    /// The transaction has ended.
    Done(Ended),
}

/// The byte lists of an ended transaction, empty: the next one uses their memory, so that no exchange has to allocate it.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    pub(crate) frame: Vec<u8>,
    received: Vec<u8>,
    seen: Vec<u8>,
}

/// What the received bytes are, as far as they end the transaction before its deadline.
#[derive(Debug, Clone, Copy)]
enum Received {
    /// The reply, or a part of it, may follow until the deadline.
    Open,
    /// The bytes may be the whole reply: until when to wait for more.
    Whole(Instant),
    /// The bytes are invalid: the reason, and until when to wait for the rest.
    Garbage(&'static str, Instant),
}

/// Whether the request comes back before its reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Echo {
    /// Nothing is known of the adapter: only a frame that cannot be the reply is an echo.
    Possible,
    /// The adapter is known to echo.
    Expected,
    /// The echo was received and removed.
    Seen,
}

/// A reply that arrived too early to be valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EarlyReply {
    None,
    /// Nothing followed the reply.
    Alone,
    /// More bytes followed the reply.
    Followed,
}

/// A frame that counts as the reply unless another one arrives before the deadline: then the first one was a late reply.
#[derive(Debug)]
struct Held {
    frame: Vec<u8>,
    reply: Reply,
}

/// A transaction whose request is on the line.
#[derive(Debug)]
pub struct Transaction {
    protocol: Protocol,
    request: Request,
    frame: Vec<u8>,
    received: Vec<u8>,
    seen: Vec<u8>,
    deadline: Instant,
    reply_time: Duration,
    state: Received,
    /// Position of the reply's frame in `received`.
    reply: Range<usize>,
    first_byte: Option<Instant>,
    foreign: u32,
    echo: Echo,
    /// A reply complete before this instant cannot answer this request.
    doubted_before: Option<Instant>,
    early: EarlyReply,
    /// Bytes before this instant, other than an echo, arrived before the request ended.
    ignored_before: Option<Instant>,
    held: Option<Held>,
}

impl Transaction {
    /// A transaction for the request whose `frame` was sent. The deadline is set once: end of transmission, time for
    /// the first byte, wire time of the reply. `echo`: the adapter is known to echo.
    pub fn new(
        protocol: Protocol,
        request: Request,
        frame: Vec<u8>,
        end_of_transmission: Instant,
        response_timeout: Duration,
        reply_time: Duration,
        echo: bool,
    ) -> Transaction {
        Transaction {
            protocol,
            request,
            frame,
            received: Vec::new(),
            seen: Vec::new(),
            deadline: end_of_transmission + response_timeout + reply_time,
            reply_time,
            state: Received::Open,
            reply: 0..0,
            first_byte: None,
            foreign: 0,
            echo: if echo { Echo::Expected } else { Echo::Possible },
            doubted_before: None,
            early: EarlyReply::None,
            ignored_before: None,
            held: None,
        }
    }

    /// Receives into the memory of an earlier transaction.
    pub(crate) fn receive_into(&mut self, buffers: Buffers) {
        (self.received, self.seen) = (buffers.received, buffers.seen);
    }

    /// The byte lists of an ended transaction.
    pub(crate) fn into_buffers(mut self) -> Buffers {
        self.frame.clear();
        self.received.clear();
        self.seen.clear();
        Buffers {
            frame: self.frame,
            received: self.received,
            seen: self.seen,
        }
    }

    /// Rejects a reply that is complete before `earliest`, because request and reply cannot both have been on the
    /// wire by then: it is a duplicate of the last reply, or the echo of a write.
    pub(crate) fn doubt_before(&mut self, earliest: Instant) {
        self.doubted_before = Some(earliest);
    }

    /// The request is on the wire until `end`: bytes before that, except for the echo, are not a reply.
    pub(crate) fn ignore_before(&mut self, end: Instant) {
        self.ignored_before = Some(end);
    }

    /// Whether a reply arrived too early to be valid.
    pub(crate) fn doubted(&self) -> bool {
        self.early != EarlyReply::None
    }

    /// Whether such a reply was all that arrived.
    pub(crate) fn only_doubted(&self) -> bool {
        self.early == EarlyReply::Alone
    }

    /// Whether the rejected bytes were the drive's reply in damaged form: they begin like it or have its length. No
    /// further reply is then expected.
    pub(crate) fn is_mangled_reply(&self) -> bool {
        self.protocol.begins_reply(&self.request, &self.received)
    }

    /// When the transaction ends at the latest.
    pub fn deadline(&self) -> Instant {
        self.deadline
    }

    /// The frame of the request.
    pub fn frame(&self) -> &[u8] {
        &self.frame
    }

    pub fn request(&self) -> &Request {
        &self.request
    }

    /// Processes received bytes, on a line on which no late reply of N2 may arrive.
    pub fn on_bytes(&mut self, now: Instant, bytes: &[u8]) -> Step {
        self.receive(now, bytes, &mut N2LateReplies::default())
    }

    /// Processes received bytes; `late` are the replies that may still arrive on an N2 line.
    pub(crate) fn receive(&mut self, now: Instant, bytes: &[u8], late: &mut N2LateReplies) -> Step {
        self.first_byte.get_or_insert(now);
        self.note_followed(bytes);
        self.received.extend_from_slice(bytes);
        if let Received::Whole(_) = self.state {
            self.state = Received::Open;
        }
        let room = MOST_BYTES.saturating_sub(self.seen.len());
        self.seen.extend(bytes.iter().take(room));
        if self.received.len() > MOST_BYTES {
            return Step::Done(Ended::Corrupt("bytes without end on the line"));
        }
        loop {
            if self.strip_echo() {
                continue;
            }
            if !self.received.is_empty()
                && let Some(held) = self.held.take_if(|_| self.received.contains(&b'\r'))
            {
                self.foreign += 1;
                late.has_arrived(&held.frame, now);
            }
            match late.take(self.request.address, &self.request.pdu, &self.received, now) {
                Taken::Reply => {}
                Taken::Late(used) => {
                    self.foreign += 1;
                    self.received.drain(..used.min(self.received.len()));
                    self.first_byte = (!self.received.is_empty()).then_some(now);
                    self.state = Received::Open;
                    continue;
                }
                Taken::Doubtful => {
                    return if self.awaits_another() && self.held.is_none() && self.hold_doubtful() {
                        self.on_time(now)
                    } else {
                        Step::Done(Ended::Corrupt(MAY_BE_LATE))
                    };
                }
            }
            match self.protocol.decode(&self.request, &self.received) {
                Decoded::Reply { .. } if self.may_go_on() => {
                    let until = now + WHOLE_AFTER;
                    self.state = Received::Whole(match self.state {
                        Received::Garbage(_, rest) => until.min(rest),
                        Received::Open | Received::Whole(_) => until,
                    });
                    return self.on_time(now);
                }
                Decoded::Reply { used, reply } if !self.is_too_early(&reply, now) => {
                    return self.replied(0, used, reply);
                }
                Decoded::Reply { used, .. } | Decoded::Foreign { used } => {
                    self.foreign += 1;
                    self.received.drain(..used.min(self.received.len()));
                    if !self.received.is_empty() && self.early == EarlyReply::Alone {
                        self.early = EarlyReply::Followed;
                    }
                    self.first_byte = (!self.received.is_empty()).then_some(now);
                    self.state = Received::Open;
                    if self.received.is_empty() {
                        return self.on_time(now);
                    }
                }
                // The echo of the request can look like a broken reply until it is complete.
                _ if self.frame.starts_with(&self.received) => return self.on_time(now),
                Decoded::Corrupt(_) if self.ignored_before.is_some_and(|end| now < end) => {
                    self.foreign += 1;
                    self.received.clear();
                    self.first_byte = None;
                    return self.on_time(now);
                }
                Decoded::Incomplete => {
                    return self.behind_garbage(now).unwrap_or_else(|| {
                        // A new colon has started another frame, which may be complete before the deadline.
                        self.state = Received::Open;
                        self.on_time(now)
                    });
                }
                Decoded::Corrupt(why) => {
                    return self.behind_garbage(now).unwrap_or_else(|| {
                        self.state = Received::Garbage(why, now + self.rest_time());
                        self.on_time(now)
                    });
                }
            }
        }
    }

    /// Notes whether bytes follow a reply that was too early.
    fn note_followed(&mut self, bytes: &[u8]) {
        if self.early == EarlyReply::Alone && !bytes.is_empty() {
            self.early = EarlyReply::Followed;
        }
    }

    /// Whether it is worth waiting until the deadline to confirm a doubtful frame: it reports a restart, or the
    /// device type, without which nothing else can be requested. If each such answer were doubted because of the
    /// previous one, that would never end.
    fn awaits_another(&self) -> bool {
        let identifies = matches!(self.request.pdu, RequestPdu::N2(Session::Identify));
        let restarted = matches!(
            self.protocol.decode(&self.request, &self.received),
            Decoded::Reply {
                reply: Reply::Exception(Exception::N2_RESTARTED),
                ..
            }
        );
        identifies || restarted
    }

    /// Keeps the frame at the start of the input as the reply, unless another one arrives.
    fn hold_doubtful(&mut self) -> bool {
        let Decoded::Reply { used, reply } = self.protocol.decode(&self.request, &self.received) else {
            return false;
        };
        let frame = self.received.drain(..used.min(self.received.len())).collect();
        self.held = Some(Held { frame, reply });
        self.state = Received::Open;
        true
    }

    fn is_too_early(&mut self, reply: &Reply, now: Instant) -> bool {
        let is_early = self.doubted_before.is_some_and(|earliest| now < earliest);
        let is_doubted = is_early && !matches!(reply, Reply::Exception(_));
        if is_doubted && self.early == EarlyReply::None {
            self.early = EarlyReply::Alone;
        }
        is_doubted
    }

    fn replied(&mut self, at: usize, used: usize, reply: Reply) -> Step {
        self.reply = at..(at + used).min(self.received.len());
        Step::Done(Ended::Reply(reply))
    }

    /// Whether more may belong to a reply that could be whole.
    fn may_go_on(&self) -> bool {
        let regular = self.received.get(1).is_some_and(|function| function & 0x80 == 0);
        self.protocol == Protocol::ModbusRtu && matches!(self.request.pdu, RequestPdu::Other(_)) && regular
    }

    /// The frame of the reply, as the drive sent it; empty without one.
    pub(crate) fn reply_frame(&self) -> &[u8] {
        let frame = self.received.get(self.reply.clone()).unwrap_or_default();
        let before = match self.protocol {
            // Blanks and glitches of a line that changes direction.
            Protocol::N2 => frame.iter().position(u8::is_ascii_graphic).unwrap_or(0),
            protocol => protocol.noise(frame),
        };
        frame.get(before..).unwrap_or_default()
    }

    /// Accepts a complete reply after garbage.
    fn behind_garbage(&mut self, now: Instant) -> Option<Step> {
        if self.echo == Echo::Expected {
            // The frame could be the echo of a write.
            return None;
        }
        let (at, used, reply) = (1..self.received.len()).find_map(|at| {
            let rest = self.received.get(at..).filter(|rest| {
                rest.first()
                    .is_some_and(|&first| self.protocol.may_begin_behind_garbage(self.request.address, first))
            })?;
            match self.protocol.decode(&self.request, rest) {
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
        Some(self.replied(at, used, reply))
    }

    /// How long further characters of the garbage may still arrive.
    fn rest_time(&self) -> Duration {
        let expected = self.protocol.reply_chars(&self.request.pdu).max(1);
        let missing = expected.saturating_sub(self.received.len()) as u32 + GARBAGE_GAP;
        self.reply_time * missing / expected as u32
    }

    /// Processes the passage of time.
    pub fn on_time(&mut self, now: Instant) -> Step {
        let until = match self.state {
            Received::Open => self.deadline,
            Received::Whole(until) | Received::Garbage(_, until) => until.min(self.deadline),
        };
        if let Received::Whole(_) = self.state
            && let Decoded::Reply { used, reply } = self.protocol.decode(&self.request, &self.received)
        {
            return if now < until {
                Step::Wait(until)
            } else {
                self.replied(0, used, reply)
            };
        }
        if now < until {
            return Step::Wait(until);
        }
        if let Some(held) = self.held.take().filter(|_| self.received.is_empty()) {
            return Step::Done(Ended::Reply(held.reply));
        }
        let ended = match self.state {
            Received::Garbage(why, _) => Ended::Corrupt(why),
            Received::Open | Received::Whole(_) if self.received.is_empty() => Ended::Silent,
            Received::Open | Received::Whole(_) => Ended::Corrupt("the reply is incomplete"),
        };
        Step::Done(ended)
    }

    /// Removes the echo of the request before the reply, if the adapter receives its own bytes. A read cannot be
    /// answered by its own frame, so such a frame is an echo; the reply to a write of one register can equal the
    /// request, so there it must already be known that the adapter echoes.
    fn strip_echo(&mut self) -> bool {
        let could_be_echo = match self.echo {
            Echo::Possible => is_unlike_its_reply(&self.request.pdu),
            Echo::Expected => true,
            Echo::Seen => false,
        };
        let noise = self.protocol.noise(&self.received);
        let from_frame = self.received.get(noise..).unwrap_or_default();
        if !could_be_echo || !from_frame.starts_with(&self.frame) {
            return false;
        }
        self.received.drain(..noise + self.frame.len());
        self.first_byte = None;
        self.echo = Echo::Seen;
        true
    }

    /// Whether the adapter echoes, as far as this transaction shows. Only an answered request whose reply differs
    /// from it shows this: a reply without an echo before it means that an earlier echo was spurious, and relying
    /// on that one would swallow the acknowledgements of all writes.
    pub fn echoes(&self, ended: &Ended) -> Option<bool> {
        let answered = matches!(ended, Ended::Reply(_));
        let was_seen = self.echo == Echo::Seen;
        (is_unlike_its_reply(&self.request.pdu) && (was_seen || answered)).then_some(was_seen)
    }

    /// When the first byte of the (last) frame arrived.
    pub(crate) fn first_byte(&self) -> Option<Instant> {
        self.first_byte
    }

    /// Number of frames that were not the reply.
    pub fn foreign(&self) -> u32 {
        self.foreign
    }

    /// All bytes received in this transaction.
    pub fn seen(&self) -> &[u8] {
        &self.seen
    }

    /// Bytes after the reply, or that were not a reply.
    pub fn rest(&self) -> &[u8] {
        self.received.get(self.reply.end..).unwrap_or_default()
    }
}

/// Whether an echo of the request cannot pass for its reply.
pub fn is_unlike_its_reply(pdu: &RequestPdu) -> bool {
    use RequestPdu::{Diagnostics, MaskWrite, Other, WriteCoil, WriteRegister};
    !matches!(
        pdu,
        WriteCoil { .. } | WriteRegister { .. } | Diagnostics { .. } | MaskWrite { .. } | Other(_)
    )
}

#[cfg(test)]
mod tests;
