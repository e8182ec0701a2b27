//! Decodes the traffic of another master and its drives, transaction by transaction. Pure: bytes and time are
//! arguments.
//!
//! A reply is accepted only if it is certain which request it answers:
//!
//! - its request came directly before it, with at most the glitch of a line that changes direction between them: a request that
//!   was mangled on the way may be among more;
//! - address, function, length, echo and check code fit it;
//! - it could not be a request itself (a read of 17 to 24 bits has replies of that form);
//! - no reply that looks the same is still to come. The other master sends its next request after its own time limit, and the
//!   late reply to the one before looks like the reply to this one. So for a second after a request that got no reply, replies
//!   that look like its reply are not believed ([`LateReplies`], [`N2LateReplies`]); the same request again is, as either
//!   reply is true of it.
//!
//! Replies that are not accepted are counted and shown in the trace, and change no value. A mid-stream start, lost
//! bytes and collisions cost only the affected transactions: decoding resumes at the next valid request.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::late_replies::{FORGOTTEN_AFTER, LateReplies};
use crate::n2_late_replies::{LateRequest, N2LateReplies, Taken};
use crate::transaction::{Ended, MAY_BE_LATE};
use drivegate_proto::frames::{ADAPTER_DELAY, Cut, Frames, GLITCH, Piece, are_sound, may_be_request};
use drivegate_proto::n2::{self, N2Options};
use drivegate_proto::{LineFormat, Protocol, Reply, Request, RequestPdu};

/// Time after which a request without a reply has ended, unless the next request comes first: the longest
/// `response_timeout`.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time after which no late N2 reply can arrive, as for the gateway as a master.
const N2_LATE: Duration = n2::RESPONSE_TIMEOUT.saturating_mul(3);
/// Bytes of garbage that are kept of one transaction.
const KEPT: usize = 512;

const NO_REPLY_IN_FRONT: &str = "invalid bytes came between request and reply";
const AMBIGUOUS: &str = "it could be a request as well";
const BEHIND_MANGLED: &str = "it may be the late reply to a damaged request";

/// A piece of received traffic.
#[derive(Debug, Clone, PartialEq)]
pub enum Traffic {
    /// A transaction: a request and its result.
    Exchange(Box<Exchange>),
    /// Bytes that belong to no transaction.
    Stray {
        bytes: Vec<u8>,
        /// When the bytes had arrived.
        at: Instant,
        /// Since when the line had been silent before these bytes.
        quiet_since: Instant,
    },
}

/// A request of the other master, and the result.
#[derive(Debug, Clone, PartialEq)]
pub struct Exchange {
    /// The polled address; 0 is the broadcast.
    pub address: u8,
    /// The request; `None` for a command without a request in the codec.
    pub request: Option<Request>,
    /// The frame of the request.
    pub frame: Vec<u8>,
    /// Since when the line had been silent before the request.
    pub quiet_since: Instant,
    /// When the request began on the line.
    pub began: Instant,
    /// When the request was complete.
    pub sent: Instant,
    /// All bytes received after the request.
    pub heard: Vec<u8>,
    /// When the first byte of the reply began; `None` if no bytes arrived.
    pub replied: Option<Instant>,
    /// When the transaction ended.
    pub at: Instant,
    /// The latest time the replied request was sent: earlier than `at`, if the reply may belong to an earlier attempt.
    pub asked_by: Instant,
    /// How the transaction ended; `None` for a broadcast, which gets no reply.
    pub ended: Option<Ended>,
    /// Why a reply is not accepted.
    pub doubt: Option<&'static str>,
}

impl Exchange {
    /// The reply, if it certainly answers this request.
    pub fn believed(&self) -> Option<(&Request, &Reply)> {
        match (&self.request, &self.ended, self.doubt) {
            (Some(request), Some(Ended::Reply(reply)), None) => Some((request, reply)),
            _ => None,
        }
    }
}

/// The bytes of a piece, and when its first and its last character were on the wire.
struct Frame {
    bytes: Vec<u8>,
    began: Instant,
    ended: Instant,
}

/// A request whose reply may still arrive.
#[derive(Debug)]
struct Open {
    address: u8,
    request: Option<Request>,
    frame: Vec<u8>,
    quiet_since: Instant,
    began: Instant,
    sent: Instant,
    /// Bytes after the request that are not a frame.
    garbage: Vec<u8>,
    /// Whether the request could also be a reply; the next request would then look like a reply to it.
    ambiguous: bool,
}

/// Decodes a line that another master owns.
#[derive(Debug)]
pub struct Decoder {
    protocol: Protocol,
    frames: Frames,
    /// The N2 options of the drives, by address.
    n2: BTreeMap<u8, N2Options>,
    open: Option<Open>,
    /// Garbage since the last valid frame, while no request is open.
    garbage: Vec<u8>,
    quiet_since: Option<Instant>,
    late: BTreeMap<u8, LateReplies>,
    n2_late: N2LateReplies,
    /// Until when the reply to a damaged request may arrive.
    mangled_until: Option<Instant>,
}

impl Decoder {
    /// A decoder for a line without any bytes so far. `n2` has the options of its drives, by address.
    pub fn new(protocol: Protocol, format: LineFormat, n2: BTreeMap<u8, N2Options>) -> Decoder {
        Decoder {
            protocol,
            frames: Frames::new(protocol, format, ADAPTER_DELAY),
            n2,
            open: None,
            garbage: Vec::new(),
            quiet_since: None,
            late: BTreeMap::new(),
            n2_late: N2LateReplies::default(),
            mangled_until: None,
        }
    }

    /// When [`Decoder::on_time`] must be called next.
    pub fn wake_at(&self) -> Option<Instant> {
        let over = self.open.as_ref().map(|open| open.sent + PATIENCE);
        over.into_iter().chain(self.frames.patience()).min()
    }

    /// Adds bytes, the last of which arrived at `now`.
    pub fn on_bytes(&mut self, bytes: &[u8], now: Instant, heard: &mut Vec<Traffic>) {
        // A frame whose time for its rest has ended is cut before the new bytes are added.
        self.on_time(now.checked_sub(Duration::from_nanos(1)).unwrap_or(now), heard);
        self.frames.add(bytes, now);
        self.cut(now, heard);
    }

    /// Processes the passage of time.
    pub fn on_time(&mut self, now: Instant, heard: &mut Vec<Traffic>) {
        self.cut(now, heard);
        if self.open.as_ref().is_some_and(|open| now >= open.sent + PATIENCE) {
            self.give_up(now, heard);
        }
    }

    fn cut(&mut self, now: Instant, heard: &mut Vec<Traffic>) {
        loop {
            let open = self.open.as_ref().filter(|open| open.garbage.len() <= GLITCH);
            let request = open.and_then(|open| open.request.as_ref());
            let Some(piece) = self.frames.next(request, now) else {
                return;
            };
            let quiet_since = self.quiet_since.replace(piece.ended).unwrap_or(piece.began);
            let Piece {
                cut,
                bytes,
                began,
                ended,
            } = piece;
            let frame = Frame { bytes, began, ended };
            match cut {
                Cut::Request { address, pdu } => self.asked(address, pdu, frame, quiet_since, heard),
                Cut::Reply { reply, ambiguous } => self.answered(reply, ambiguous, &frame, heard),
                Cut::Garbage => self.garbage(frame, quiet_since, heard),
            }
        }
    }

    fn asked(
        &mut self,
        address: u8,
        pdu: Option<RequestPdu>,
        frame: Frame,
        quiet_since: Instant,
        heard: &mut Vec<Traffic>,
    ) {
        self.give_up(frame.began, heard);
        let garbage = std::mem::take(&mut self.garbage);
        if may_be_request(self.protocol, garbage.len()) && !are_sound(self.protocol, &garbage) {
            self.mangled_until = Some(frame.began + FORGOTTEN_AFTER);
        }
        let n2 = self.n2.get(&address).copied().unwrap_or_default();
        let open = Open {
            address,
            ambiguous: pdu.as_ref().is_some_and(|pdu| self.could_be_reply(pdu)),
            request: pdu.map(|pdu| Request { address, pdu, n2 }),
            frame: frame.bytes,
            quiet_since,
            began: frame.began,
            sent: frame.ended,
            garbage: Vec::new(),
        };
        let is_broadcast = open.address == 0;
        self.open = Some(open);
        if is_broadcast {
            self.over(None, frame.ended, None, None, heard);
        }
    }

    /// Whether the frame of this request could be a reply to the request before it: 24 bits, or a list of registers.
    fn could_be_reply(&self, pdu: &RequestPdu) -> bool {
        let mut bytes = Vec::new();
        pdu.encode(&mut bytes);
        let announced = bytes.get(1).map_or(0, |byte| usize::from(*byte));
        let fits = self.protocol != Protocol::N2 && announced + 2 == bytes.len();
        match pdu {
            RequestPdu::Read { table, .. } => fits && table.is_bits(),
            RequestPdu::ReadWrite { .. } => fits && announced.is_multiple_of(2),
            _ => false,
        }
    }

    fn answered(&mut self, reply: Reply, ambiguous: bool, frame: &Frame, heard: &mut Vec<Traffic>) {
        let Some(open) = &mut self.open else { return };
        open.garbage.extend_from_slice(&frame.bytes);
        let (began, at) = (frame.began, frame.ended);
        let doubt = match () {
            () if ambiguous || open.ambiguous => Some(AMBIGUOUS),
            () if self.mangled_until.is_some_and(|until| began < until) => Some(BEHIND_MANGLED),
            () => self.late(&frame.bytes, at),
        };
        self.over(Some(Ended::Reply(reply)), at, Some(began), doubt, heard);
    }

    /// Why the reply in `bytes` may be a late reply to an earlier request.
    fn late(&mut self, bytes: &[u8], at: Instant) -> Option<&'static str> {
        let request = self.open.as_ref()?.request.as_ref()?;
        let may_be_late = match self.protocol {
            Protocol::N2 => self.n2_late.take(request.address, &request.pdu, bytes, at) != Taken::Reply,
            Protocol::ModbusRtu | Protocol::ModbusAscii => {
                let late = self.late.get_mut(&request.address);
                late.is_some_and(|late| late.blocks(&request.pdu, at).is_some())
            }
        };
        may_be_late.then_some(MAY_BE_LATE)
    }

    fn garbage(&mut self, frame: Frame, quiet_since: Instant, heard: &mut Vec<Traffic>) {
        if let Some(open) = &mut self.open {
            let room = KEPT.saturating_sub(open.garbage.len());
            open.garbage.extend(frame.bytes.iter().take(room));
            return;
        }
        let room = KEPT.saturating_sub(self.garbage.len());
        self.garbage.extend(frame.bytes.iter().take(room));
        heard.push(Traffic::Stray {
            bytes: frame.bytes,
            at: frame.ended,
            quiet_since,
        });
    }

    /// Ends the open request without a reply: the next request came at `now`, or its time limit has passed.
    fn give_up(&mut self, now: Instant, heard: &mut Vec<Traffic>) {
        let Some(open) = &self.open else { return };
        let mangled = open
            .request
            .as_ref()
            .is_some_and(|request| self.protocol.begins_reply(request, &open.garbage) && open.garbage.len() > GLITCH);
        let ended = if open.garbage.len() > GLITCH {
            Ended::Corrupt(NO_REPLY_IN_FRONT)
        } else {
            Ended::Silent
        };
        if let Some(request) = open.request.as_ref().filter(|_| !mangled) {
            match self.protocol {
                Protocol::N2 => {
                    let asked = LateRequest {
                        address: request.address,
                        pdu: &request.pdu,
                        device: request.n2.device_type,
                        at: open.began,
                    };
                    self.n2_late.given_up(asked, N2_LATE, now);
                }
                Protocol::ModbusRtu | Protocol::ModbusAscii => {
                    let late = self.late.entry(request.address).or_default();
                    late.given_up(&request.pdu, open.began, now);
                }
            }
        }
        self.over(Some(ended), now, None, None, heard);
    }

    /// The transaction of the request that is open has ended.
    fn over(
        &mut self,
        ended: Option<Ended>,
        at: Instant,
        replied: Option<Instant>,
        doubt: Option<&'static str>,
        heard: &mut Vec<Traffic>,
    ) {
        let Some(open) = self.open.take() else { return };
        let mut asked_by = at;
        if let (Some(request), Some(Ended::Reply(reply)), None) = (&open.request, &ended, doubt)
            && let Some(late) = self.late.get_mut(&request.address)
        {
            if !matches!(reply, Reply::Exception(_)) {
                late.settled_by(&request.pdu, at);
            }
            asked_by = late.asked_by(&request.pdu, at);
            late.answered(&request.pdu, open.began, at);
        }
        if let (Some(request), Some(Ended::Reply(reply)), None) = (&open.request, &ended, doubt)
            && self.protocol == Protocol::N2
            && !matches!(reply, Reply::Exception(_))
        {
            self.n2_late.answered(request.address, &request.pdu, N2_LATE, at);
            asked_by = self.n2_late.asked_by(request.address, &request.pdu, at).unwrap_or(at);
        }
        heard.push(Traffic::Exchange(Box::new(Exchange {
            address: open.address,
            request: open.request,
            frame: open.frame,
            quiet_since: open.quiet_since,
            began: open.began,
            sent: open.sent,
            heard: open.garbage,
            replied,
            at,
            asked_by,
            ended,
            doubt,
        })));
    }
}
