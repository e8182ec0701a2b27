//! The simulated two-wire line: which character is on it at which time, silence, collisions. Pure; the time is an argument.
//!
//! A master on a pseudo-terminal writes a whole frame at once. Here the frame takes as long as on a real wire: its
//! first character begins when the bytes were read, or right after the preceding characters. The protocol decides
//! when a frame is complete (Modbus RTU: after 3.5 characters of silence; see [`framing`]); then the turnaround of
//! the drive passes, and its reply begins.
//!
//! A strict drive, as drives of the field do, does not hear a Modbus RTU request that begins before 3.5 characters of
//! silence.

use super::SimTime;
use super::faults::{Burst, Fault, FaultPlan, Kind};
use super::framing;
use super::slave::{FrameMeaning, ReceivedRequest, Slaves, refuse};
use super::statistics::{Direction, Lateness, Recorded, Statistics, Transcript};
use drivegate_proto::{Exception, LineFormat, Protocol, rtu};
use std::collections::BTreeMap;
use std::time::Duration;

/// How the bytes of a reply reach the master.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// All bytes at the end of the last character: a master that ends a reply by its length notices no difference.
    Whole,
    /// Chunks of this number of characters, as a UART empties its FIFO (14 of 16 is usual); with 1, each byte is
    /// delivered separately.
    Chunks(u8),
    /// Whole, at the next multiple of this time: the latency timer of a USB adapter.
    Steps(Duration),
}

/// The connection between the simulated drives and the master.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wire {
    /// A port without a baud rate: the time on the wire is simulated.
    Simulated,
    /// A real UART: received bytes have already been on the wire, and bytes go onto it when they are written.
    Real,
    /// No time on the wire, no silence to keep: as fast as the programs are.
    Instant,
}

/// Rules for the timing of a simulated line.
#[derive(Debug, Clone)]
pub struct LineRules {
    /// Protocol of the drives.
    pub protocol: Protocol,
    /// Baud rate and character format.
    pub format: LineFormat,
    /// Time between the end of a request (with Modbus RTU: its last character and 3.5 characters of silence) and
    /// the reply. A drive whose manual states another time uses that one.
    pub turnaround: Duration,
    /// Whether drives ignore a request that comes too early; such a request is counted in any case.
    pub strict: bool,
    /// How the bytes of a reply reach the master.
    pub delivery: Delivery,
    /// Connection between the drives and the master.
    pub wire: Wire,
}

impl LineRules {
    /// A strict Modbus RTU line with whole delivery and a turnaround of 0.5 ms.
    pub fn new(format: LineFormat) -> LineRules {
        LineRules::of(Protocol::ModbusRtu, format)
    }

    /// Default rules for drives of `protocol`.
    pub fn of(protocol: Protocol, format: LineFormat) -> LineRules {
        LineRules {
            protocol,
            format,
            turnaround: Duration::from_micros(500),
            strict: true,
            delivery: Delivery::Whole,
            wire: Wire::Simulated,
        }
    }
}

/// Time after which an incomplete Modbus RTU frame ends, if the time on the wire is unknown.
const FRAGMENT: Duration = Duration::from_millis(20);
/// Share of the silence before a request that may be missing.
const TOLERANCE: f64 = 0.03;
/// Maximum number of bursts that wait for delivery; late replies beyond that are lost.
const MOST_OUTGOING: usize = 64;

/// How the start of a request relates to the traffic before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    Clean,
    TooEarly,
    Collided,
}

/// A frame of the master on the wire.
#[derive(Debug)]
struct Incoming {
    start: SimTime,
    end: SimTime,
    bytes: Vec<u8>,
    verdict: Verdict,
    /// Whether the last character arrived, in a protocol in which a character ends a frame.
    ended: bool,
}

/// Characters of a drive that are on the wire or waiting for it.
#[derive(Debug)]
struct Outgoing {
    start: SimTime,
    bytes: Vec<u8>,
    sent: usize,
    chunk: usize,
    kind: Kind,
}

/// When the line must be serviced next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wake {
    /// Time of the wake-up.
    pub at: SimTime,
    /// Whether bytes are due at this time: the thread must then wake exactly in time.
    pub delivery: bool,
}

/// A request that a drive carried out, whatever happened to its reply on the line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Act {
    /// When the last character of the request had arrived.
    pub at: SimTime,
    /// Address of the drive.
    pub address: u8,
    /// Frame of the drive's reply, without the effects of faults.
    pub reply: Vec<u8>,
}

/// A half-duplex line with its drives.
#[derive(Debug)]
pub struct HalfDuplex {
    rules: LineRules,
    slaves: Slaves,
    faults: FaultPlan,
    incoming: Option<Incoming>,
    outgoing: Vec<Outgoing>,
    /// Until when each drive is still sending its replies, by address.
    said_until: BTreeMap<u8, SimTime>,
    /// End of the last frame that the master sent or could expect.
    last_end: Option<SimTime>,
    /// End of the last reply that the master could foresee; may be in the future.
    reply_end: Option<SimTime>,
    /// Time from the last reply to the request received last.
    pause_before: Duration,
    /// End of the last characters sent by fault injection; may be in the future.
    provoked_end: Option<SimTime>,
    statistics: Statistics,
    lateness: Lateness,
    transcript: Transcript,
    /// Requests carried out since the last [`HalfDuplex::take_acts`]; `None` until its first call.
    acts: Option<Vec<Act>>,
}

impl HalfDuplex {
    /// A line without traffic so far.
    pub fn new(rules: LineRules, slaves: Slaves, faults: FaultPlan, transcript: Transcript) -> HalfDuplex {
        HalfDuplex {
            rules,
            slaves,
            faults,
            incoming: None,
            outgoing: Vec::new(),
            said_until: BTreeMap::new(),
            last_end: None,
            reply_end: None,
            pause_before: Duration::MAX,
            provoked_end: None,
            statistics: Statistics::default(),
            lateness: Lateness::default(),
            transcript,
            acts: None,
        }
    }

    /// Returns the actions of the drives since the last call; recorded from the first call on.
    pub fn take_acts(&mut self) -> Vec<Act> {
        self.acts.replace(Vec::new()).unwrap_or_default()
    }

    /// The rules that the line follows.
    pub fn rules(&self) -> &LineRules {
        &self.rules
    }

    /// The drives on the line.
    pub fn slaves(&mut self) -> &mut Slaves {
        &mut self.slaves
    }

    /// Replaces the faults from the next request on.
    pub fn set_faults(&mut self, faults: FaultPlan) {
        self.faults = faults;
    }

    /// Counters of the line so far.
    pub fn statistics(&self) -> Statistics {
        self.statistics
    }

    /// How late the simulator delivered.
    pub fn lateness(&mut self) -> &mut Lateness {
        &mut self.lateness
    }

    /// Bytes that the port did not take.
    pub fn lost(&mut self, bytes: usize) {
        self.statistics.bytes_lost += bytes as u64;
    }

    /// The frames recorded so far.
    pub fn transcript(&self) -> &Transcript {
        &self.transcript
    }

    /// Replaces the transcript by an empty one of that length.
    pub fn record(&mut self, limit: usize) {
        self.transcript = Transcript::new(limit);
    }

    /// Interrupts the line: all characters on it are lost.
    pub fn cut(&mut self) {
        self.incoming = None;
        self.outgoing.clear();
        self.said_until.clear();
        self.last_end = None;
        self.reply_end = None;
        self.provoked_end = None;
    }

    /// Silence that ends a frame, and that a request has to wait for; zero where characters delimit frames.
    fn silence(&self) -> Duration {
        match self.rules.wire {
            Wire::Instant => Duration::ZERO,
            _ => self.rules.protocol.recognition(&self.rules.format),
        }
    }

    fn chars(&self, count: usize) -> Duration {
        match self.rules.wire {
            Wire::Instant => Duration::ZERO,
            _ => self.rules.format.chars(count),
        }
    }

    /// Bytes of the master that were read from the port at `now`.
    pub fn on_bytes(&mut self, bytes: &[u8], now: SimTime) {
        self.on_time(now);
        self.statistics.bytes_in += bytes.len() as u64;
        let mut at = match self.rules.wire {
            Wire::Real => now.saturating_sub(self.chars(bytes.len())),
            Wire::Simulated | Wire::Instant => now,
        };
        for piece in framing::pieces(self.rules.protocol, bytes) {
            at = self.on_piece(piece, at);
        }
        if self.rules.wire == Wire::Instant {
            self.on_time(now);
        }
    }

    /// Processes characters of one frame that begin at `at` or right after the previous ones; returns their end.
    fn on_piece(&mut self, piece: &[u8], at: SimTime) -> SimTime {
        let protocol = self.rules.protocol;
        let fresh = piece.first().is_some_and(|&first| framing::begins(protocol, first));
        let mut begun = at;
        if let Some(frame) = self.incoming.take_if(|frame| fresh || frame.ended) {
            begun = begun.max(frame.end);
            self.finish(&frame);
        }
        if self.incoming.is_none() {
            let verdict = self.verdict(begun);
            if verdict == Verdict::Collided {
                self.spoil(begun);
            }
            self.incoming = Some(Incoming {
                start: begun,
                end: begun,
                bytes: Vec::new(),
                verdict,
                ended: false,
            });
        }
        let wire_time = self.chars(piece.len());
        let Some(incoming) = &mut self.incoming else {
            return begun;
        };
        incoming.end = incoming.end.max(begun) + wire_time;
        incoming.ended = piece.last().is_some_and(|&last| framing::ends(protocol, last));
        let room = framing::kept(protocol).saturating_sub(incoming.bytes.len());
        incoming.bytes.extend(piece.iter().take(room));
        incoming.end
    }

    /// Judges a request that begins at `start`: clean, too early, or in collision with a reply.
    fn verdict(&self, start: SimTime) -> Verdict {
        let least = self.silence().mul_f64(1.0 - TOLERANCE);
        if self.rules.wire == Wire::Instant {
            Verdict::Clean
        } else if self.reply_end.is_some_and(|end| start < end) {
            Verdict::Collided
        } else if self.last_end.max(self.reply_end).is_some_and(|end| start < end + least) {
            Verdict::TooEarly
        } else {
            Verdict::Clean
        }
    }

    /// Ends the master's frame if that is complete by `now`.
    pub fn on_time(&mut self, now: SimTime) {
        if let Some(frame) = self.incoming.take_if(|frame| Self::is_over(frame, &self.rules, now)) {
            self.finish(&frame);
        }
    }

    fn finish(&mut self, frame: &Incoming) {
        let heard_at = frame.end + self.silence();
        self.pause_before = self
            .reply_end
            .map_or(Duration::MAX, |end| frame.start.saturating_sub(end));
        self.last_end = Some(frame.end);
        let met_fault = self.provoked_end.is_some_and(|end| frame.start < end + self.silence());
        self.statistics.provoked_overlaps += u64::from(met_fault && self.rules.wire != Wire::Instant);
        self.transcript.record(|| Recorded {
            direction: Direction::ToDrives,
            start: frame.start,
            end: frame.end,
            bytes: frame.bytes.clone(),
        });
        match frame.verdict {
            Verdict::Clean => self.hear(frame, heard_at),
            Verdict::TooEarly => {
                self.statistics.silence_violations += 1;
                if !self.rules.strict {
                    self.hear(frame, heard_at);
                }
            }
            Verdict::Collided => self.statistics.collisions += 1,
        }
    }

    fn is_over(frame: &Incoming, rules: &LineRules, now: SimTime) -> bool {
        now >= frame.end + Self::end_after(frame, rules)
    }

    /// Pause after which a frame ends, unless a character ended it. Drivers and adapters of real ports deliver
    /// bytes with pauses, and an instant line has no time, so an incomplete frame is waited for there.
    fn end_after(frame: &Incoming, rules: &LineRules) -> Duration {
        if rules.protocol != Protocol::ModbusRtu {
            return if frame.ended {
                Duration::ZERO
            } else {
                framing::LONGEST_PAUSE
            };
        }
        let silence = rules.format.silence_chars();
        let whole = || rtu::request_len(&frame.bytes).is_some_and(|len| len <= frame.bytes.len());
        match rules.wire {
            Wire::Instant if whole() => Duration::ZERO,
            Wire::Instant => FRAGMENT,
            Wire::Real if !whole() => silence.max(FRAGMENT),
            Wire::Simulated | Wire::Real => silence,
        }
    }

    /// Damages the rest of a reply, because two senders transmit at the same time.
    fn spoil(&mut self, from: SimTime) {
        let format = self.rules.format;
        for burst in self.outgoing.iter_mut().filter(|burst| burst.kind != Kind::Provoked) {
            let (start, sent) = (burst.start, burst.sent);
            for (index, byte) in burst.bytes.iter_mut().enumerate().skip(sent) {
                if start + format.chars(index + 1) > from {
                    *byte = !*byte;
                }
            }
        }
    }

    /// Lets the drives receive a frame that ended at `now`.
    fn hear(&mut self, frame: &Incoming, now: SimTime) {
        match self.slaves.hear(self.rules.protocol, &frame.bytes, now) {
            FrameMeaning::BadFrame => self.statistics.bad_crc += 1,
            FrameMeaning::Nobody(_) => self.statistics.unanswered += 1,
            FrameMeaning::Broadcast => self.statistics.broadcasts += 1,
            FrameMeaning::Request(asked) => self.reply(frame, &asked, now),
            FrameMeaning::Damaged(asked, exception) => {
                self.statistics.bad_crc += 1;
                let mut reply = Vec::new();
                refuse(&asked, exception, &mut reply);
                self.respond(frame, &asked, None, reply, now);
            }
        }
    }

    fn reply(&mut self, frame: &Incoming, asked: &ReceivedRequest, now: SimTime) {
        self.statistics.requests += 1;
        let slaves = &self.slaves;
        let fault = self.faults.next(asked.address, || slaves.any_runs());
        let fault = match fault {
            Some(Fault::NeedsPause(pause)) if self.pause_before >= pause => None,
            fault => fault,
        };
        self.statistics.faults += u64::from(fault.is_some());
        let mut reply = Vec::with_capacity(64);
        let request = asked.request.as_ref().ok();
        let refused = request.and_then(|pdu| self.faults.refuses(asked.address, pdu));
        match (fault, refused) {
            (None, Some(exception)) => refuse(asked, exception, &mut reply),
            (Some(Fault::Deaf | Fault::NeedsPause(_)), _) => return,
            (Some(Fault::CutRequest | Fault::CutEcho), _) => return self.cut_request(frame, asked, fault, now),
            (Some(Fault::DeafEcho), _) => {}
            (Some(Fault::Exception(code)), _) => refuse(asked, Exception::Modbus(code), &mut reply),
            _ => {
                self.slaves.answer(asked, now, &mut reply);
                if let Some(acts) = &mut self.acts {
                    acts.push(Act {
                        at: now,
                        address: asked.address,
                        reply: reply.clone(),
                    });
                }
                if reply.is_empty() {
                    return;
                }
            }
        }
        self.respond(frame, asked, fault, reply, now);
    }

    /// Gives the drives the request without its last character.
    fn cut_request(&mut self, frame: &Incoming, asked: &ReceivedRequest, fault: Option<Fault>, now: SimTime) {
        let cut = frame.bytes.split_last().map_or(&[][..], |(_, rest)| rest);
        self.statistics.bad_crc += 1;
        let heard = self.slaves.hear(self.rules.protocol, cut, now);
        if fault == Some(Fault::CutEcho) {
            self.respond(frame, asked, fault, Vec::new(), now);
        } else if let FrameMeaning::Damaged(asked, exception) = heard {
            let mut reply = Vec::new();
            refuse(&asked, exception, &mut reply);
            self.respond(frame, &asked, None, reply, now);
        }
    }

    /// Damages the character that is on the line at the peak of the mains, if there is one.
    fn hum(&self, hertz: u8, start: SimTime, bytes: &mut [u8]) {
        let period = Duration::from_secs(1) / u32::from(hertz.max(1));
        let character = self.chars(1);
        let mut at = start;
        for byte in bytes {
            // The peak lasts for a twentieth of the period.
            if at.as_nanos() % period.as_nanos() < period.as_nanos() / 20 + character.as_nanos() {
                *byte ^= 0x24;
                return;
            }
            at += character;
        }
    }

    /// Sends a reply on the wire, changed by the fault if there is one.
    fn respond(
        &mut self,
        frame: &Incoming,
        asked: &ReceivedRequest,
        fault: Option<Fault>,
        reply: Vec<u8>,
        now: SimTime,
    ) {
        let gap = match self.rules.wire {
            Wire::Instant => Duration::ZERO,
            _ => self.rules.format.silence_chars(),
        };
        let bursts = self.faults.shape(fault, self.rules.protocol, &frame.bytes, reply, gap);
        self.statistics.replies += u64::from(bursts.iter().any(|burst| burst.kind != Kind::Echo));
        let own = self.slaves.drive(asked.address).and_then(|drive| drive.turnaround());
        let mut at = now + own.unwrap_or(self.rules.turnaround);
        // A drive answers in order, so its pending replies go first. On N2 the master relies on that; with Modbus
        // late replies may overtake each other, which is harder for the master than the behaviour of a real drive.
        if self.rules.protocol == Protocol::N2 {
            at = at.max(self.said_until.get(&asked.address).copied().unwrap_or_default());
        }
        for burst in bursts {
            if burst.kind == Kind::Echo {
                // On a real wire the echo cannot begin earlier, because only now is it known that the fault affects
                // this request.
                let start = if self.rules.wire == Wire::Real {
                    now
                } else {
                    now.saturating_sub(self.chars(burst.bytes.len()))
                };
                self.send(start, burst);
            } else {
                let mut burst = burst;
                if let Some(Fault::Mains(hertz)) = fault {
                    self.hum(hertz, at, &mut burst.bytes);
                }
                at = self.send(at + burst.gap, burst);
                self.said_until.insert(asked.address, at);
            }
        }
    }

    /// Sends a burst on the wire at `start`; returns the end of the burst.
    fn send(&mut self, start: SimTime, burst: Burst) -> SimTime {
        let end = start + self.chars(burst.bytes.len());
        match burst.kind {
            Kind::Regular | Kind::Split => self.reply_end = self.reply_end.max(Some(end)),
            Kind::Provoked => self.provoked_end = self.provoked_end.max(Some(end)),
            Kind::Echo => {}
        }
        let bytes = burst.bytes;
        self.transcript.record(|| Recorded {
            direction: Direction::FromDrives,
            start,
            end,
            bytes: bytes.clone(),
        });
        let chunk = match (burst.kind, self.rules.delivery) {
            (Kind::Split, _) => 1,
            (Kind::Echo, _) | (_, Delivery::Whole | Delivery::Steps(_)) => bytes.len(),
            (_, Delivery::Chunks(size)) => usize::from(size),
        };
        if !bytes.is_empty() && self.outgoing.len() < MOST_OUTGOING {
            self.outgoing.push(Outgoing {
                start,
                bytes,
                sent: 0,
                chunk: chunk.max(1),
                kind: burst.kind,
            });
        }
        end
    }

    /// When the next chunk of a burst is due: at the end of its last character or, if a real UART sends it, at the
    /// start of its first.
    fn due(&self, burst: &Outgoing) -> SimTime {
        let due = match self.rules.wire {
            Wire::Real => burst.start + self.chars(burst.sent),
            _ => burst.start + self.chars((burst.sent + burst.chunk).min(burst.bytes.len())),
        };
        match self.rules.delivery {
            Delivery::Steps(step) if !step.is_zero() => step * due.div_duration_f64(step).ceil() as u32,
            _ => due,
        }
    }

    /// Appends the next bytes that are due by `now` to `out`; returns when they were due.
    pub fn take_due(&mut self, now: SimTime, out: &mut Vec<u8>) -> Option<SimTime> {
        let (index, due) = self
            .outgoing
            .iter()
            .enumerate()
            .map(|(index, burst)| (index, self.due(burst)))
            .filter(|(_, due)| *due <= now)
            .min_by_key(|(_, due)| *due)?;
        let burst = self.outgoing.get_mut(index)?;
        let chunk: &[u8] = burst
            .bytes
            .get(burst.sent..(burst.sent + burst.chunk).min(burst.bytes.len()))?;
        out.extend_from_slice(chunk);
        self.statistics.bytes_out += chunk.len() as u64;
        burst.sent += chunk.len();
        if burst.sent >= burst.bytes.len() {
            self.outgoing.swap_remove(index);
        }
        Some(due)
    }

    /// When the line must be serviced next; `None` while it is idle.
    pub fn wake(&self) -> Option<Wake> {
        let over = |frame: &Incoming| frame.end + Self::end_after(frame, &self.rules);
        let frame = self.incoming.as_ref().map(|frame| Wake {
            at: over(frame),
            delivery: false,
        });
        let delivery = self.outgoing.iter().map(|burst| Wake {
            at: self.due(burst),
            delivery: true,
        });
        delivery.chain(frame).min_by_key(|wake| (wake.at, !wake.delivery))
    }
}

#[cfg(test)]
mod tests;
