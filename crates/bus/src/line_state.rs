//! The state of a half-duplex line: how long it has been silent, and the transaction in progress. Pure: bytes and
//! time are arguments; a loop with a port, or a test without one, does the rest.

use std::time::{Duration, Instant};

use super::n2_late_replies::N2LateReplies;
use super::transaction::{Buffers, CONNECTION_CLOSED, Ended, Step, Transaction, is_unlike_its_reply};
use drivegate_model::drive::plan::WireTime;
use drivegate_proto::{LineFormat, Protocol, Reply, Request};

/// Time after which the bus sends even on a line that never goes silent, so that a stop can get out.
pub const MAX_WAIT_FOR_SILENCE: Duration = Duration::from_millis(500);

/// Baud rates are off by at most 2 %, and times are not exact: a reply faster than this share of its wire time is
/// too early.
const EARLIEST_REPLY_SHARE: f64 = 0.9;

/// Replies that are complete before the wire could have carried them show a line without wire time: a simulation,
/// or another baud rate behind a device server. A single one may be a late or duplicate reply, and on a busy
/// machine not all replies of such a line are early; so early replies add weight, and each regular reply takes 1
/// back. From this weight on, early replies are accepted.
const WITHOUT_WIRE_TIME: u32 = 64;
/// Greatest weight of early replies: this number of regular replies restores the protection of a line.
const MOST_WEIGHT: u32 = 256;
/// Weight of an early reply that can hardly belong to another request. A single one is enough, until the next regular
/// reply.
const WEIGHT_OF_EARLY: u32 = WITHOUT_WIRE_TIME;
/// Weight of an early reply that was not accepted and not followed by another: two are enough. If the regular reply
/// follows, the early one was a duplicate or a late one, as on a real wire: that removes all weight.
const WEIGHT_OF_DOUBTED: u32 = 40;
/// Weight of such a reply on a Modbus line while the reply to an earlier request may still arrive: most likely the early
/// reply is that one, and a drive that is often a little slower than the time limit has a wire all the same.
const WEIGHT_OF_LATE: u32 = 8;
/// Weight of any early reply on an N2 line, where a reply does not show which request it answers. Three are enough.
const WEIGHT_ON_N2: u32 = 24;
/// Weight that a regular reply takes back on an N2 line, where a duplicate reply whose successor was lost looks
/// like an early one: while fewer than one reply in four is early, the line keeps its protection.
const REGULAR_ON_N2: u32 = 8;
/// Weight of an early reply that was accepted although it could belong to another request. If one reply in nine is
/// like that, the line stays as it is.
const WEIGHT_OF_BELIEVED: u32 = 8;

/// Bytes without a request that may belong to one N2 reply.
const MOST_UNASKED: usize = 512;

/// How a request is to be sent.
#[derive(Debug, Clone, Copy)]
pub struct Sending {
    /// Silence before the request, and after its reply before a request to another drive.
    pub silence: Duration,
    /// Time for the first byte of the reply.
    pub response_timeout: Duration,
    /// Whether a duplicate of the last reply on the line could be mistaken for the reply to this request.
    pub could_be_doubled: bool,
    /// Whether a late reply to an earlier request may arrive.
    pub late_may_come: bool,
}

/// A completed transaction.
#[derive(Debug)]
pub struct Exchanged {
    /// A transaction with its result and all received bytes.
    pub transaction: Transaction,
    /// Result of the transaction.
    pub ended: Ended,
    /// When the request was given to the line.
    pub began: Instant,
    /// When the drive detected the end of the request.
    pub sent: Instant,
    /// When the last bytes arrived that can be the drive's; the end of the request if there were none.
    pub heard_at: Instant,
    /// When the transaction ended. Even if that was noticed late, this is the latest time at which a reply can have
    /// left the drive.
    pub at: Instant,
    /// Time on the wire of the received bytes.
    pub reply_time: Duration,
    /// How long the line was in use, including the silence after the transaction.
    pub took: Duration,
    /// For a reply that was complete before the line could have carried it: the lowest baud rate at which that
    /// would be possible.
    pub beats: Option<u32>,
}

/// Properties of the line learned from its transactions, kept for the next connection to the same line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Learned {
    protocol: Protocol,
    format: LineFormat,
    /// Whether the adapter echoes the bytes it sends.
    echo: bool,
    /// Weight of the replies that arrived faster than the wire could carry them.
    early_weight: u32,
}

/// A line with its settings, and the transaction on it.
#[derive(Debug)]
pub struct LineState {
    protocol: Protocol,
    format: LineFormat,
    silence: Duration,
    /// Silence after the last transaction, as its drive needs.
    owed: Duration,
    /// End of the last character on the line, either direction.
    quiet_since: Instant,
    /// Time before which nothing is sent, because a reply to the previous master may arrive.
    left_alone: Instant,
    learned: Learned,
    underway: Option<Underway>,
    /// Bytes received on an N2 line since the last transaction: late replies come then, too.
    unasked: Vec<u8>,
    /// The last complete frame on an N2 line: an equal one may be its duplicate.
    last_frame: Vec<u8>,
    /// The memory of the last transaction.
    buffers: Buffers,
}

#[derive(Debug)]
struct Underway {
    transaction: Transaction,
    began: Instant,
    sent: Instant,
    earliest: Instant,
    doubtful: bool,
    late: bool,
    /// The connection that took the request was closed.
    cut: bool,
}

impl LineState {
    /// A line that was opened at `now`.
    pub fn new(protocol: Protocol, format: LineFormat, silence: Duration, now: Instant) -> LineState {
        LineState {
            protocol,
            format,
            silence,
            owed: silence,
            quiet_since: now,
            left_alone: now,
            learned: Learned {
                protocol,
                format,
                echo: false,
                early_weight: 0,
            },
            underway: None,
            unasked: Vec::new(),
            last_frame: Vec::new(),
            buffers: Buffers::default(),
        }
    }

    /// Resets the state because the port was reopened. Properties of the line that were measured are kept: without
    /// a known wire time, a line would seem silent for seconds. Replies correct any property that has changed.
    pub fn reset(&mut self, now: Instant) {
        let learned = self.learned;
        *self = LineState {
            learned,
            ..LineState::new(self.protocol, self.format, self.silence, now)
        };
    }

    /// What the transactions have shown about the line.
    pub fn learned(&self) -> Learned {
        self.learned
    }

    /// Adopts the properties that were measured on the same line, if the line has the same settings.
    pub fn take_over(&mut self, learned: Learned) {
        if (learned.protocol, learned.format) == (self.protocol, self.format) {
            self.learned = learned;
        }
    }

    /// Handles a closed connection. A request sent over it may still be on the wire behind the server, and its
    /// reply may arrive over the next connection: the transaction continues until its deadline.
    pub fn cut(&mut self) {
        if let Some(underway) = &mut self.underway {
            underway.cut = true;
        }
    }

    /// End of the last character on the line.
    pub(crate) fn quiet_since(&self) -> Instant {
        self.quiet_since
    }

    /// When a request that has been wanted since `since` may be sent to a drive that needs `own` silence before it:
    /// when the line has been silent long enough, or has babbled too long.
    pub(crate) fn clear_at(&self, since: Instant, own: Duration) -> Instant {
        let since = since.max(self.left_alone);
        let silence = self.silence_before(own);
        let silent = (self.quiet_since + silence).min(since + silence + MAX_WAIT_FOR_SILENCE);
        silent.max(self.left_alone)
    }

    /// Silence before a request to a drive that needs `own`.
    pub(crate) fn silence_before(&self, own: Duration) -> Duration {
        own.max(self.owed)
    }

    /// Silence before a request to a drive without a setting of its own.
    pub(crate) fn silence(&self) -> Duration {
        self.silence
    }

    /// Sends nothing before `until`.
    pub(crate) fn leave_alone(&mut self, until: Instant) {
        self.left_alone = until;
    }

    /// Whether the line was never silent from `since` on for too long.
    pub(crate) fn babbles(&self, since: Instant) -> bool {
        self.quiet_since > since + MAX_WAIT_FOR_SILENCE
    }

    /// Duration of a transaction without a reply.
    pub fn patience(&self, request: &Request, response_timeout: Duration) -> Duration {
        let wire = WireTime::of(self.protocol, &self.format, &request.pdu);
        self.silence + wire.request + response_timeout + wire.reply
    }

    /// The frame of a request is given to the line at `now`.
    pub fn send(&mut self, request: Request, frame: Vec<u8>, sending: Sending, now: Instant) {
        let wire = WireTime::of(self.protocol, &self.format, &request.pdu);
        let sent = now + self.format.chars(frame.len());
        // A reply cannot be complete before its wire time has passed.
        let least = self.format.chars(self.protocol.least_reply_chars(&request.pdu));
        let earliest = sent + least.mul_f64(EARLIEST_REPLY_SHARE);
        let doubtful = is_doubtful(&request, sending);
        let timeout = sending.response_timeout;
        let mut transaction = Transaction::new(
            self.protocol,
            request,
            frame,
            sent,
            timeout,
            wire.reply,
            self.learned.echo,
        );
        transaction.receive_into(std::mem::take(&mut self.buffers));
        if self.learned.early_weight < WITHOUT_WIRE_TIME {
            transaction.ignore_before(sent);
            if doubtful {
                transaction.doubt_before(earliest);
            }
        }
        self.quiet_since = sent;
        self.unasked.clear();
        self.owed = sending.silence;
        self.underway = Some(Underway {
            transaction,
            began: now,
            sent: sent + wire.recognition,
            earliest,
            doubtful,
            late: sending.late_may_come,
            cut: false,
        });
    }

    /// Memory for the frame of the next request.
    pub(crate) fn take_frame(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.buffers.frame)
    }

    /// Keeps the memory of an ended transaction for the next one.
    pub(crate) fn keep_buffers(&mut self, transaction: Transaction) {
        self.buffers = transaction.into_buffers();
    }

    /// The frame of the request that is on the line.
    pub fn frame(&self) -> &[u8] {
        self.underway
            .as_ref()
            .map_or(&[], |underway| underway.transaction.frame())
    }

    /// Whether a transaction is in progress.
    pub(crate) fn is_underway(&self) -> bool {
        self.underway.is_some()
    }

    /// Latest time at which the transaction in progress ends.
    pub fn deadline(&self) -> Option<Instant> {
        self.underway.as_ref().map(|underway| underway.transaction.deadline())
    }

    /// Adds bytes received at `now`; `late` are the replies that may still arrive on an N2 line. Returns the transaction if
    /// these bytes complete it.
    pub fn received(&mut self, bytes: &[u8], late: &mut N2LateReplies, now: Instant) -> Option<Exchanged> {
        if !bytes.is_empty() {
            self.begin_silence(now);
        }
        let Some(underway) = self.underway.as_mut() else {
            self.received_unasked(bytes, late, now);
            return None;
        };
        match underway.transaction.receive(now, bytes, late) {
            Step::Wait(_) => None,
            Step::Done(ended) => self.over(ended, now),
        }
    }

    /// Notes the late replies of an N2 line that arrive while no request is on it.
    fn received_unasked(&mut self, bytes: &[u8], late: &mut N2LateReplies, now: Instant) {
        if self.protocol != Protocol::N2 || !late.may_come(now) {
            return;
        }
        self.unasked.extend_from_slice(bytes);
        while let Some(end) = self.unasked.iter().position(|byte| *byte == b'\r') {
            let frame: Vec<u8> = self.unasked.drain(..=end).collect();
            if !self.last_frame.is_empty() && frame.ends_with(&self.last_frame) {
                late.came_again(&frame, now);
            } else {
                late.has_arrived(&frame, now);
            }
            self.last_frame = frame;
        }
        // More than a reply without an end is noise.
        if self.unasked.len() > MOST_UNASKED {
            self.unasked.clear();
        }
    }

    /// Starts the silence before the next request again, because a reply or garbage was on the line.
    fn begin_silence(&mut self, now: Instant) {
        self.quiet_since = now.max(self.quiet_since);
    }

    /// Ends the transaction if its time limit has passed.
    ///
    /// # Errors
    /// If the time limit has not passed: the time until which more bytes are awaited. `None` if there is no
    /// transaction.
    pub fn on_time(&mut self, now: Instant) -> Result<Exchanged, Option<Instant>> {
        let Some(underway) = self.underway.as_mut() else {
            return Err(None);
        };
        match underway.transaction.on_time(now) {
            Step::Wait(until) => Err(Some(until)),
            Step::Done(ended) => self.over(ended, now).ok_or(None),
        }
    }

    fn over(&mut self, ended: Ended, now: Instant) -> Option<Exchanged> {
        let Underway {
            transaction,
            began,
            sent,
            earliest,
            doubtful,
            late,
            cut,
        } = self.underway.take()?;
        let ended = match ended {
            Ended::Silent | Ended::Corrupt(_) if cut => Ended::Corrupt(CONNECTION_CLOSED),
            ended => ended,
        };
        self.learned.echo = transaction.echoes(&ended).unwrap_or(self.learned.echo);
        let early = now < earliest;
        let is_value = matches!(&ended, Ended::Reply(reply) if !matches!(reply, Reply::Exception(_)));
        let beats = (early && is_value).then(|| self.least_baud(&transaction, now.saturating_duration_since(began)));
        self.weigh(&ended, early, (doubtful, late), &transaction);
        if self.protocol == Protocol::N2 {
            self.last_frame.clear();
            self.last_frame.extend_from_slice(transaction.reply_frame());
        }
        let wire = WireTime::of(self.protocol, &self.format, &transaction.request().pdu);
        let reply_time = wire.reply.min(self.format.chars(transaction.seen().len()));
        let at = now.min(transaction.deadline());
        let heard_at = self.quiet_since.min(transaction.deadline());
        Some(Exchanged {
            transaction,
            ended,
            began,
            sent,
            heard_at,
            at,
            reply_time,
            // A reply that arrived faster than the wire could carry it does not free the line sooner.
            took: at.max(heard_at).saturating_duration_since(began) + self.owed,
            beats,
        })
    }

    /// The baud rate at which request and reply take that time, or little longer.
    fn least_baud(&self, transaction: &Transaction, took: Duration) -> u32 {
        let chars = transaction.frame().len() + transaction.seen().len();
        let at_baud = self.format.chars(chars).mul_f64(EARLIEST_REPLY_SHARE).as_secs_f64();
        (f64::from(self.format.baud) * at_baud / took.as_secs_f64().max(1e-6)) as u32
    }

    fn weight_of(&self, weight: u32) -> u32 {
        match self.protocol {
            Protocol::N2 => WEIGHT_ON_N2,
            Protocol::ModbusRtu | Protocol::ModbusAscii => weight,
        }
    }

    /// Evaluates what the end of a transaction shows about the wire time. `early` means that the reply was faster
    /// than the wire; `doubtful` that it could be a duplicate or an echo; `late` that the reply to an earlier request could
    /// arrive.
    fn weigh(&mut self, ended: &Ended, early: bool, (doubtful, late): (bool, bool), transaction: &Transaction) {
        let believed = self.learned.early_weight >= WITHOUT_WIRE_TIME;
        let of_another = doubtful || late;
        let weight = match ended {
            Ended::Reply(Reply::Exception(_)) => 0,
            Ended::Reply(_) if !early => {
                let taken_back = match self.protocol {
                    _ if transaction.doubted() => MOST_WEIGHT,
                    Protocol::N2 => REGULAR_ON_N2,
                    Protocol::ModbusRtu | Protocol::ModbusAscii => 1,
                };
                self.learned.early_weight = self.learned.early_weight.saturating_sub(taken_back);
                0
            }
            Ended::Reply(_) if of_another && believed => WEIGHT_OF_BELIEVED,
            Ended::Reply(_) if of_another => 0,
            Ended::Reply(_) => self.weight_of(WEIGHT_OF_EARLY),
            // The other bytes may be the rest of the same reply.
            Ended::Silent | Ended::Corrupt(_) if transaction.only_doubted() => {
                self.weight_of(if late { WEIGHT_OF_LATE } else { WEIGHT_OF_DOUBTED })
            }
            Ended::Silent | Ended::Corrupt(_) => 0,
        };
        self.learned.early_weight = (self.learned.early_weight + weight).min(MOST_WEIGHT);
    }
}

/// Whether a duplicate of an earlier reply, or an echo of the request, could pass for the reply.
fn is_doubtful(request: &Request, sending: Sending) -> bool {
    sending.could_be_doubled || !is_unlike_its_reply(&request.pdu)
}

#[cfg(test)]
mod tests;
