//! The dialogue with one tool, bytes in and out, with the time as an argument.
//!
//! A line has one request at a time: a tool that sends another request has given up the previous one, whose answer
//! is dropped, however it ends. A request already accepted for the bus is still carried out.

use std::future::poll_fn;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use super::framing::{Framing, ToolFrame};
use super::request::{Meaning, Refused, ToolRequest};
use super::terms::{Decision, Tool, Work};
use crate::SlotOutcome;
use drivegate_core::order::{Arrival, Outcome};
use drivegate_proto::{Protocol, Reply, RequestPdu};

/// Time from the end of a request within which a tool is answered; later, the answer is dropped.
pub(super) const ANSWER_WITHIN: Duration = Duration::from_secs(1);
/// Time that a byte of a tool takes at least: no line of 460,800 baud brings more, so a tool that floods costs little.
const BYTE_TIME: Duration = Duration::from_micros(20);
/// Minimum interval between two requests to the bus, stops excepted, for a tool that sends again before it is answered.
const MIN_REQUEST_INTERVAL: Duration = Duration::from_millis(20);

/// A request that waits for its answer.
#[derive(Debug)]
struct Pending {
    request: ToolRequest,
    pdu: RequestPdu,
    work: Work,
    deadline: Instant,
}

/// A request that was not given to the bus yet.
#[derive(Debug)]
struct Held {
    request: ToolRequest,
    /// How the request arrived.
    arrival: Arrival,
    /// Number of stops given to the request's drives when the request was complete.
    stops: u64,
    until: Instant,
    deadline: Instant,
}

/// The dialogue with a tool.
#[derive(Debug)]
pub(super) struct Dialogue {
    tool: Arc<Tool>,
    framing: Framing,
    pending: Option<Pending>,
    held: Option<Held>,
    /// When the last request was given to the bus.
    asked: Option<Instant>,
    /// When reading from the tool continues; `None` means at once.
    reads_at: Option<Instant>,
    /// The reply to the tool.
    pub(super) output: Vec<u8>,
}

impl Dialogue {
    pub(super) fn new(tool: Arc<Tool>) -> Dialogue {
        Dialogue {
            framing: Framing::new(tool.protocol(), tool.format()),
            tool,
            pending: None,
            held: None,
            asked: None,
            reads_at: None,
            output: Vec::new(),
        }
    }

    /// Name of the tool for the log.
    pub(super) fn who(&self) -> &str {
        self.tool.who()
    }

    /// Whether an answer is due.
    pub(super) fn is_waiting(&self) -> bool {
        self.pending.is_some() || self.held.is_some()
    }

    /// Processes bytes of the tool with this arrival, read at `now`. The requests in them are in the queue of the
    /// bus when this returns, or held until [`Dialogue::wake_at`]. Returns whether there were any.
    pub(super) fn received(&mut self, bytes: &[u8], arrival: Arrival, now: Instant) -> bool {
        let count = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
        self.reads_at = now.checked_add(BYTE_TIME.saturating_mul(count));
        self.framing.set_highest_address(self.tool.highest_address());
        self.framing.add(bytes, arrival, now);
        self.on_time(now)
    }

    /// Whether more of the tool is read now; if not, from [`Dialogue::wake_at`] on.
    pub(super) fn reads(&self) -> bool {
        self.reads_at.is_none()
    }

    /// Time went by. Whether the tool made a request by that.
    pub(super) fn on_time(&mut self, now: Instant) -> bool {
        self.reads_at = self.reads_at.filter(|at| *at > now);
        let mut any = false;
        while let Some(said) = self.framing.next(now) {
            match said {
                ToolFrame::Request(request) => {
                    any = true;
                    let arrival = self.framing.arrival().unwrap_or_else(|| Arrival::now(now));
                    self.asked_for(request, arrival, now);
                }
                ToolFrame::Broken => self.tool.count(SlotOutcome::Broken),
            }
        }
        if self.held.as_ref().is_some_and(|held| held.until <= now)
            && let Some(held) = self.held.take()
        {
            self.go(held, now);
        }
        if self.pending.as_ref().is_some_and(|pending| pending.deadline <= now) {
            self.give_up(SlotOutcome::Late);
        }
        any
    }

    /// When [`Dialogue::on_time`] has something to do.
    pub(super) fn wake_at(&self) -> Option<Instant> {
        let pending = self.pending.as_ref().map(|pending| pending.deadline);
        let held = self.held.as_ref().map(|held| held.until);
        [pending, held, self.framing.patience(), self.reads_at]
            .into_iter()
            .flatten()
            .min()
    }

    /// Waits until nothing is pending: the answer to the last request is in the output, or its time has expired.
    pub(super) async fn finished(&mut self) {
        while self.is_waiting() {
            let wake_at = self.wake_at().map(tokio::time::Instant::from_std);
            let timer = async {
                match wake_at {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                () = poll_fn(|cx| self.poll(cx, Instant::now())) => {}
                () = timer => drop(self.on_time(Instant::now())),
            }
        }
    }

    /// Gives up the requests of a tool that is no longer connected.
    pub(super) fn ended(&mut self) {
        self.give_up(SlotOutcome::Abandoned);
    }

    /// Gives up the previous request, which the tool no longer waits for.
    fn give_up(&mut self, outcome: SlotOutcome) {
        if self.is_waiting() {
            (self.pending, self.held) = (None, None);
            self.tool.count(outcome);
        }
    }

    fn asked_for(&mut self, request: ToolRequest, arrival: Arrival, now: Instant) {
        let impatient = self.is_waiting() && self.asked.is_some_and(|at| now < at + MIN_REQUEST_INTERVAL);
        self.give_up(SlotOutcome::Abandoned);
        let deadline = now + ANSWER_WITHIN;
        let pace = self.tool.pace(&request, now);
        let haste = impatient
            .then_some(self.asked)
            .flatten()
            .map(|at| at + MIN_REQUEST_INTERVAL);
        let until = if pace.is_stop {
            now
        } else {
            pace.not_before.max(haste.unwrap_or(now))
        };
        let held = Held {
            arrival,
            stops: pace.stops,
            request,
            until,
            deadline,
        };
        if until <= now {
            self.go(held, now);
        } else if until < deadline {
            self.held = Some(held);
        } else {
            self.tool.count(SlotOutcome::Late);
        }
    }

    /// Passes a request to the bus, or answers it here.
    fn go(&mut self, held: Held, now: Instant) {
        let Held {
            request,
            arrival,
            stops,
            deadline,
            ..
        } = held;
        self.asked = Some(now);
        match self.tool.decide(&request, arrival, stops, deadline, now) {
            Decision::Refuse(why) => {
                self.tool.count(SlotOutcome::Refused);
                if !request.is_broadcast(self.tool.protocol()) {
                    self.output.extend(request.refusal(self.tool.protocol(), why));
                }
            }
            Decision::Silent => self.tool.count(SlotOutcome::NoAnswer),
            Decision::Wait(work) => {
                let pdu = match &request.meaning {
                    Meaning::Read(pdu) | Meaning::Write(pdu) | Meaning::Unchecked(pdu) => pdu.clone(),
                    Meaning::Faulty(_) => return,
                };
                self.pending = Some(Pending {
                    request,
                    pdu,
                    work,
                    deadline,
                });
            }
        }
    }

    /// Puts the answer of the bus into the output, if it has arrived at `now`.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<()> {
        let Some(pending) = &mut self.pending else {
            return Poll::Pending;
        };
        let Poll::Ready((outcome, frame)) = pending.work.poll(cx) else {
            return Poll::Pending;
        };
        if let Some(pending) = self.pending.take() {
            self.answer(&pending, &outcome, frame, now);
        }
        Poll::Ready(())
    }

    fn answer(&mut self, pending: &Pending, outcome: &Outcome, frame: Option<Vec<u8>>, now: Instant) {
        let protocol = self.tool.protocol();
        if pending.request.is_broadcast(protocol) {
            // A broadcast has no reply; it only counts whether it was sent.
            let sent = outcome.is_ok();
            return self.tool.count(if sent {
                SlotOutcome::Answered
            } else {
                SlotOutcome::NoAnswer
            });
        }
        let answer = match (outcome, frame) {
            (Outcome::Acknowledged(_) | Outcome::Exception(_) | Outcome::Unknown(_), Some(frame)) => Some(frame),
            _ => frame_of(protocol, &pending.request, &pending.pdu, outcome),
        };
        let Some(answer) = answer else {
            // As on a line, a missing reply means silence, whatever the reason.
            return self.tool.count(SlotOutcome::NoAnswer);
        };
        if now >= pending.deadline {
            return self.tool.count(SlotOutcome::Late);
        }
        if self.framing.has_begun() {
            return self.tool.count(SlotOutcome::Abandoned);
        }
        self.tool.count(counted(outcome));
        self.output.extend(answer);
    }
}

fn counted(outcome: &Outcome) -> SlotOutcome {
    match outcome {
        Outcome::Acknowledged(_) => SlotOutcome::Answered,
        Outcome::Refused(_) => SlotOutcome::Refused,
        Outcome::StopOnly(part) | Outcome::StopFailed(part) => counted(part),
        _ => SlotOutcome::Exception,
    }
}

/// The frame of an answer whose bytes were not kept: to a command that may have taken several transactions. An
/// acknowledgement has one form. Where only the stop of a write was carried out the tool gets an exception for the rest; an
/// unknown result gets silence.
fn frame_of(protocol: Protocol, request: &ToolRequest, pdu: &RequestPdu, outcome: &Outcome) -> Option<Vec<u8>> {
    match outcome {
        Outcome::Acknowledged(Reply::Written) if protocol == Protocol::N2 => Some(b"A\r".to_vec()),
        Outcome::Acknowledged(reply) if protocol != Protocol::N2 => {
            let (mut answer, mut frame) = (Vec::new(), Vec::new());
            reply.encode(pdu, &mut answer);
            protocol.encode_frame(request.address, &answer, &mut frame);
            Some(frame)
        }
        Outcome::Exception(code) if protocol == Protocol::N2 => {
            Some(request.refusal(protocol, Refused::Nak(code.n2_code()?)))
        }
        Outcome::Exception(code) | Outcome::Unknown(code) => Some(request.refusal(protocol, Refused::Exception(*code))),
        Outcome::Refused(refusal) => Some(request.refusal(protocol, Refused::Exception(refusal.exception()))),
        Outcome::StopOnly(rest) => match **rest {
            Outcome::TimedOut | Outcome::Garbled | Outcome::Interrupted(_) => None,
            _ => Some(request.refusal(protocol, Refused::Exception(outcome.exception()?))),
        },
        Outcome::StopFailed(stop) => frame_of(protocol, request, pdu, stop),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_core::order::{Interruption, Refusal};
    use drivegate_proto::Exception;

    /// Exception or error code of the answer to a write of two registers; 0 acknowledges it, `None` is silence.
    fn answer_code(protocol: Protocol, outcome: &Outcome) -> Option<u8> {
        let pdu = RequestPdu::WriteRegisters {
            start: 2000,
            values: vec![0, 9000],
        };
        let request = ToolRequest {
            address: 1,
            function: if protocol == Protocol::N2 { 0 } else { 16 },
            meaning: Meaning::Write(pdu.clone()),
        };
        let frame = frame_of(protocol, &request, &pdu, outcome)?;
        match protocol {
            Protocol::N2 if frame == b"A\r" => Some(0),
            Protocol::N2 => std::str::from_utf8(frame.get(1..3)?).ok()?.parse().ok(),
            Protocol::ModbusAscii => code(&drivegate_proto::ascii::open_frame(&frame)?.1),
            Protocol::ModbusRtu => code(drivegate_proto::rtu::open_frame(&frame)?.1),
        }
    }

    fn code(pdu: &[u8]) -> Option<u8> {
        match pdu {
            [0x90, code] => Some(*code),
            [16, ..] => Some(0),
            _ => None,
        }
    }

    #[test]
    fn the_rest_of_a_stop_is_told_unless_nobody_knows_its_fate() {
        let refused = |refusal: fn(String) -> Refusal| Outcome::Refused(refusal(String::new()));
        let only = |rest| Outcome::StopOnly(Box::new(rest));
        let failed = |stop| Outcome::StopFailed(Box::new(stop));
        for (outcome, modbus, n2) in [
            (Outcome::Acknowledged(Reply::Written), Some(0), Some(0)),
            (only(refused(Refusal::NotAllowed)), Some(1), Some(11)),
            (only(refused(Refusal::NotWritable)), Some(2), Some(11)),
            (only(refused(Refusal::BadValue)), Some(3), Some(10)),
            (
                only(Outcome::Refused(Refusal::HeldByOther(Box::default()))),
                Some(6),
                Some(11),
            ),
            (only(Outcome::Exception(Exception::VALUE)), Some(3), Some(10)),
            (only(Outcome::Exception(Exception::DEVICE_FAILURE)), Some(4), Some(11)),
            (only(Outcome::Purged), Some(6), Some(11)),
            (only(Outcome::QueueFull), Some(6), Some(11)),
            (only(Outcome::Expired), Some(0x0B), Some(11)),
            (only(Outcome::TimedOut), None, None),
            (only(Outcome::Garbled), None, None),
            (only(Outcome::Interrupted(Interruption::Stop)), None, None),
            (failed(Outcome::TimedOut), None, None),
            (failed(Outcome::BusDown), None, None),
            (failed(Outcome::Exception(Exception::VALUE)), Some(3), None),
            (failed(refused(Refusal::NotAllowed)), Some(1), Some(11)),
            // In these cases the slot stays silent, like a line.
            (Outcome::TimedOut, None, None),
            (Outcome::Purged, None, None),
        ] {
            for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii] {
                assert_eq!(answer_code(protocol, &outcome), modbus, "{protocol:?} {outcome:?}");
            }
            assert_eq!(answer_code(Protocol::N2, &outcome), n2, "N2 {outcome:?}");
        }
        let of = |outcome| counted(&outcome);
        assert_eq!(of(only(refused(Refusal::BadValue))), SlotOutcome::Refused);
        assert_eq!(of(only(Outcome::Purged)), SlotOutcome::Exception);
    }
}
