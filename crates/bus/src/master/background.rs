//! Background transactions: when one is sent, and the result.

use std::time::{Duration, Instant};

use super::permission::AtTurn;
use super::{Master, Purpose, Turn, TurnEnd};
use crate::n2_session::Progress;
use crate::news::News;
use crate::schedule::Admission;
use crate::start_gate::Start;
use crate::stop_of_line::BROADCAST_PAUSE;
use crate::transaction::{CONNECTION_CLOSED, Ended};
use drivegate_core::order::{
    BackgroundRequest, Command, Interruption, Order, Origin, Outcome, Pace, PassedOn, Refusal, SourceKind, Target,
    Urgency, Work, written,
};
use drivegate_core::permit::{Stage, Verdict, client_access};
use drivegate_model::drive::plan::WireTime;
use drivegate_model::drive::{DriveIndex, PlannedRead, PollClass};
use drivegate_proto::rtu::LONGEST;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Time of a transaction whose request is not decoded, at most.
const LONGEST_UNCHECKED: Duration = Duration::from_millis(500);

/// What background traffic sends next: a command to drives that waited its turn among the others, or a background request.
#[derive(Debug)]
pub(super) enum Sending {
    Command(Box<Command>),
    Request(Box<BackgroundRequest>),
}

/// A background transaction that was chosen for sending.
#[derive(Debug)]
pub(super) struct ChosenTransaction {
    pub(super) sending: Sending,
    /// The share that pays for the time of the transaction; `None` if it goes as a command.
    pub(super) admission: Option<Admission>,
    /// Whether its transaction is on the line, or was.
    pub(super) sent: bool,
}

impl ChosenTransaction {
    /// The command to drives of the bus, if this is one.
    pub(super) fn command(&self) -> Option<&Command> {
        match &self.sending {
            Sending::Command(command) => Some(command),
            Sending::Request(_) => None,
        }
    }

    /// Number of the command among those to drives of the bus.
    pub(super) fn number(&self) -> Option<u64> {
        Some(self.command()?.intent.number)
    }

    fn passed_on(&self) -> Option<&PassedOn> {
        match &self.sending {
            Sending::Command(command) => command.as_passed_on(),
            Sending::Request(request) => request.passed_on.as_ref(),
        }
    }

    fn origin(&self) -> &Origin {
        match &self.sending {
            Sending::Command(command) => command.ticket.origin(),
            Sending::Request(request) => request.ticket.origin(),
        }
    }

    fn target(&self) -> Target {
        match &self.sending {
            Sending::Command(command) => command.intent.target,
            Sending::Request(request) => request.target,
        }
    }

    fn expires(&self) -> Instant {
        match &self.sending {
            Sending::Command(command) => command.intent.window.expires,
            Sending::Request(request) => request.expires,
        }
    }

    fn pace(&self) -> Pace {
        match &self.sending {
            Sending::Command(_) => Pace::Brisk,
            Sending::Request(request) => request.pace,
        }
    }

    fn pdu(&self) -> Option<&RequestPdu> {
        match &self.sending {
            Sending::Request(request) => Some(&request.pdu),
            Sending::Command(command) => match &command.intent.order {
                Order::Write(pdu) | Order::Read(pdu) => Some(pdu),
                Order::Points(_) | Order::Parameter(_) => None,
            },
        }
    }

    pub(super) fn turn(&self) -> Option<Turn> {
        Some(Turn {
            purpose: Purpose::Background(self.target()),
            pdu: self.pdu()?.clone(),
        })
    }

    /// Reports the outcome, with the frame of the reply for a tool.
    fn answer(self, outcome: Outcome, frame: Vec<u8>, now: Instant) {
        let (ticket, passed_on) = match self.sending {
            Sending::Command(command) => match command.work {
                Work::PassedOn(passed_on) => (command.ticket, Some(passed_on)),
                Work::Stop(_) | Work::Set(_) | Work::Read => (command.ticket, None),
            },
            Sending::Request(request) => (request.ticket, request.passed_on),
        };
        if let Some(passed_on) = passed_on {
            // The tool may have disconnected, so an error is ignored.
            let _ = passed_on.frame.send(frame);
        }
        ticket.answer(outcome, now);
    }
}

impl Master {
    /// The background transaction to send now, in time that is left over (`idle`) or instead of a poll that is due.
    ///
    /// # Errors
    /// When to check again; `None` if no request waits.
    pub(super) fn background(&mut self, idle: bool, now: Instant) -> Result<Turn, Option<Instant>> {
        if !self.drop_background_in_vain(now) && self.bus.queue.lock().is_empty() {
            return Err(None);
        }
        let mut again: Option<Instant> = None;
        // Both kinds take turns, since they have equal shares.
        for passed_on in [!self.passed_on_last, self.passed_on_last] {
            let paces = if passed_on { &Pace::ALL[..1] } else { &Pace::ALL[..] };
            for pace in paces {
                let begun = if passed_on {
                    self.pass_on(idle, now)
                } else {
                    self.begin_background(*pace, idle, now)
                };
                match begun {
                    Ok(turn) => {
                        self.passed_on_last = passed_on;
                        return Ok(turn);
                    }
                    Err(at) => again = again.into_iter().chain(at).min(),
                }
            }
        }
        Err(again)
    }

    /// Returns a chosen request that was not sent to the choice.
    pub(super) fn put_back_background(&mut self, now: Instant) {
        let Some(begun) = self.background.take_if(|begun| !begun.sent) else {
            return;
        };
        match begun.sending {
            Sending::Command(command) => self.bus.queue.lock().put_back(*command, now),
            Sending::Request(request) => self.bus.queue.background().put_back(*request, now),
        }
    }

    /// Ends requests that can no longer be sent: they expired, or their drive is offline. Returns whether others wait.
    fn drop_background_in_vain(&mut self, now: Instant) -> bool {
        let Master { bus, schedule, .. } = self;
        let mut queue = bus.queue.background();
        if !queue.is_empty() {
            queue.remove(now, &Outcome::Expired, |r| r.expires <= now);
            queue.remove(now, &Outcome::Replaced, BackgroundRequest::is_unwanted);
            let bus = &bus.image.spec.name;
            let lost = |request: &BackgroundRequest| lost_right(request, Stage::Turn, bus);
            let refusal = queue.iter().find_map(lost);
            if let Some(refusal) = refusal {
                queue.remove(now, &Outcome::Refused(refusal), |request| lost(request).is_some());
            }
            queue.remove(now, &Outcome::Offline, |request| {
                request.target.drive().is_some_and(|drive| !schedule.is_online(drive))
            });
        }
        !queue.is_empty()
    }

    /// Takes the next request of this pace from the queue, if it may be sent.
    fn begin_background(&mut self, pace: Pace, idle: bool, now: Instant) -> Result<Turn, Option<Instant>> {
        let queue = self.bus.queue.clone();
        let mut waiting = queue.background();
        if waiting.is_empty() {
            return Err(None);
        }
        let mut blocked: Option<Instant> = None;
        let Master { drives, waits, .. } = self;
        let may = |request: &BackgroundRequest| {
            let until = waits.blocks(request.target, &request.pdu, drives, now);
            let until = until.max(waits.quiet_until(request));
            blocked = blocked.into_iter().chain(until).min();
            until.is_none()
        };
        let Some(number) = waiting.next(pace, may) else {
            return Err(blocked);
        };
        let Some(request) = waiting.get(number) else {
            return Err(blocked);
        };
        let cost = self.exchange_cost(request.target, &request.pdu);
        let admission = self.schedule.admits_background(pace, cost, idle, now);
        if let Admission::NotBefore(at) = admission {
            return Err(blocked.into_iter().chain([at]).min());
        }
        let Some(request) = waiting.take(number) else {
            return Err(blocked);
        };
        let begun = self.background.insert(ChosenTransaction {
            sending: Sending::Request(Box::new(request)),
            admission: Some(admission),
            sent: false,
        });
        begun.turn().ok_or(blocked)
    }

    /// Duration of the transaction, as far as the profile gives it.
    pub(super) fn exchange_cost(&self, target: Target, pdu: &RequestPdu) -> Duration {
        let spec = &self.bus.image.spec;
        let image = target.drive().map(|drive| self.bus.image.drives.of(drive));
        let (turnaround, silence) = image.map_or((Duration::ZERO, self.silence), |image| {
            (image.spec.turnaround, image.spec.timing.silence_around(self.silence))
        });
        WireTime::of(spec.protocol, &spec.format, pdu).total(turnaround, silence)
    }

    /// Whether the chosen background transaction may still be sent.
    pub(super) fn background_is_due(&self, now: Instant) -> bool {
        let Some(begun) = self.background.as_ref().filter(|begun| begun.expires() > now) else {
            return false;
        };
        let bus = &self.bus.image.spec.name;
        let command = match &begun.sending {
            Sending::Command(command) => command,
            // A request that has lost its right is refused when the next choice is made.
            Sending::Request(request) => return lost_right(request, Stage::Write, bus).is_none(),
        };
        let facts = AtTurn::of(&self.drives, &self.bus.image.drives, now);
        let mut pending = self.bus.queue.lock();
        // A stop that was ordered while the line became silent.
        let stopped = command
            .reach()
            .any(|drive| pending.was_stopped(drive) && !command.stops(drive));
        !stopped && pending.gate.judge(Stage::Write, command, &facts, now) == Verdict::Go
    }

    /// Notes that the background transaction is sent, which counts as a command to every drive that receives it.
    pub(super) fn background_sent(&mut self, now: Instant) {
        let Some(begun) = &mut self.background else { return };
        begun.sent = true;
        let Some(command) = begun.command() else { return };
        let (origin, pdu) = (command.ticket.origin(), begun.pdu());
        for (index, effect) in command.intent.effects.iter() {
            let renews = self.bus.renews(index, origin);
            self.drives.of_mut(index).foreign_order(renews, now);
            if let (Some(starts), Some(pdu)) = (&self.waits.starts, pdu) {
                let start = effect.starts().then(|| Start {
                    number: command.intent.number,
                    client: origin.client().clone(),
                });
                let profile = &self.bus.image.drives.of(index).spec.profile;
                starts.written(index, profile, pdu, start.as_ref(), now);
            }
        }
    }

    /// Answers the request that has started, for which nothing can be done any more.
    pub(super) fn abandon_background(&mut self, unsent: Outcome, why: Interruption, now: Instant) {
        if let Some(begun) = self.background.take() {
            let outcome = if begun.sent { Outcome::Interrupted(why) } else { unsent };
            begun.answer(outcome, Vec::new(), now);
        }
    }

    /// Whether a background transaction requested by a client is chosen for sending.
    pub(super) fn background_of_others(&self) -> bool {
        let begun = self.background.as_ref();
        begun.is_some_and(|begun| begun.origin().kind != SourceKind::Schedule)
    }

    /// Whether the background transaction is the broadcast of the shutdown.
    pub(super) fn stops_the_line(&self) -> bool {
        let begun = self.background.as_ref();
        begun.is_some_and(|begun| begun.origin().kind == SourceKind::Shutdown)
    }

    /// Answers a background transaction that has ended, whatever its result.
    pub(super) fn background_over(&mut self, turn: &Turn, mut end: TurnEnd, now: Instant, news: &mut Vec<News>) {
        let drive = turn.drive();
        if let Some(index) = drive
            && self.waits.sessions.transaction_ended(index, &end.ended) == Progress::Restarted
        {
            self.restarted(index, now, news);
        }
        let Some(begun) = self.background.take() else {
            return;
        };
        let answered = matches!(end.ended, Ended::Reply(_));
        match begun.admission {
            Some(admission) => self
                .schedule
                .background_done(begun.pace(), admission, answered, end.took),
            None => {
                self.schedule.command_done(Urgency::Command, end.took);
                self.schedule.background_owes(begun.pace(), end.took);
            }
        }
        if let Some(index) = drive.filter(|_| answered) {
            self.schedule.seen(index, now);
        }
        let frame = std::mem::take(&mut end.frame);
        let at = end.at;
        let outcome = if self.is_broadcast(begun.target()) && end.ended == Ended::Silent {
            Outcome::Acknowledged(Reply::Written)
        } else {
            self.background_outcome(turn, end, now)
        };
        if begun.passed_on().is_some_and(|passed_on| passed_on.may_write) {
            self.unchecked_write(&begun, turn, &outcome, now);
        } else if let Some(index) = drive.filter(|_| turn.pdu.is_write()) {
            self.note_background_write(index, &turn.pdu, &outcome, now);
        }
        if let (Outcome::Acknowledged(reply), Some(index)) = (&outcome, drive) {
            self.note_background_read(index, &turn.pdu, reply, at, now, news);
        }
        begun.answer(outcome, frame, now);
    }

    /// Stores read values in the process image as well. A drive that a tool identified, or polled for changes, may
    /// have reported a restart or changes to the tool, so it is read again.
    fn note_background_read(
        &mut self,
        index: DriveIndex,
        pdu: &RequestPdu,
        reply: &Reply,
        at: Instant,
        now: Instant,
        news: &mut Vec<News>,
    ) {
        match (pdu, reply) {
            (RequestPdu::Read { table, start, count }, reply) => {
                let read = PlannedRead {
                    class: PollClass::Slow,
                    table: *table,
                    start: *start,
                    count: *count,
                    wide: 0,
                };
                if let Some(words) = reply.words() {
                    self.learn(index, read, words, at, news);
                }
            }
            (_, Reply::Identified(_)) => {
                self.drives.of_mut(index).restarted();
                self.schedule.read_again(index, now);
            }
            (_, Reply::Changes(digits)) if !digits.is_empty() => self.schedule.read_again(index, now),
            _ => {}
        }
    }

    /// Forgets, for all drives that received an unchecked write, the words that it wrote, and all command words if
    /// the written words are unknown.
    fn unchecked_write(&mut self, begun: &ChosenTransaction, turn: &Turn, outcome: &Outcome, now: Instant) {
        let writes = written(&turn.pdu);
        for index in begun.command().into_iter().flat_map(Command::reach) {
            let renews = self.bus.renews(index, begun.origin());
            let drive = self.drives.of_mut(index);
            drive.foreign_order(renews, now);
            if matches!(outcome, Outcome::Exception(_)) {
                continue;
            }
            match &writes {
                Some((table, items)) => {
                    let profile = &self.bus.image.drives.of(index).spec.profile;
                    drive.may_have_taken(*table, items, profile.control.as_ref());
                    self.note_write(index, *table, items, now);
                }
                None => {
                    drive.restarted();
                    drive.written.range = Some(now);
                }
            }
            self.schedule.read_again(index, now);
        }
    }

    /// Whether a request to that receiver is a broadcast, without a reply.
    pub(super) fn is_broadcast(&self, target: Target) -> bool {
        target == Target::Address(0) && self.waits.sessions.is_empty()
    }

    /// Time limit for the first byte of the reply, where it differs from the gateway's own requests: after a
    /// broadcast the drives get time to carry it out, and a request that is not decoded may take at most
    /// [`LONGEST_UNCHECKED`] of the line.
    pub(super) fn passed_on_timeout(&self, turn: &Turn) -> Option<Duration> {
        if self.is_broadcast(turn.target()) {
            return Some(BROADCAST_PAUSE);
        }
        let RequestPdu::Other(_) = &turn.pdu else { return None };
        let spec = &self.bus.image.spec;
        let wire = WireTime::of(spec.protocol, &spec.format, &turn.pdu);
        // The length of an unchecked reply is only known once it has arrived.
        let patient = self.response_timeout_of(turn.target()) + spec.format.chars(LONGEST);
        Some(patient.min(LONGEST_UNCHECKED.saturating_sub(wire.request + wire.reply)))
    }

    fn background_outcome(&mut self, turn: &Turn, end: TurnEnd, now: Instant) -> Outcome {
        let reply = match end.ended {
            // An ignored request looks like a silent drive.
            Ended::Silent
            | Ended::Corrupt(CONNECTION_CLOSED)
            | Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => return Outcome::TimedOut,
            Ended::Corrupt(_) => return Outcome::Garbled,
            Ended::Reply(Reply::Exception(code)) if turn.pdu.is_write() => return Outcome::of_exception(code),
            Ended::Reply(Reply::Exception(code)) => return Outcome::Exception(code),
            Ended::Reply(reply) => reply,
        };
        let Some(drive) = turn.drive().map(|index| self.drives.of_mut(index)) else {
            return Outcome::Acknowledged(reply);
        };
        let proves_nothing = turn.pdu.is_write() && drive.late.proves_nothing(&turn.pdu, end.began, now);
        // The reply to an earlier try shows the value of that time.
        let older = drive.late.asked_by(&turn.pdu, now) < end.began;
        drive.late.answered(&turn.pdu, end.began, now);
        if proves_nothing || older {
            Outcome::Garbled
        } else {
            Outcome::Acknowledged(reply)
        }
    }

    /// Written registers are read back soon if polled, and the drive's command words are updated.
    fn note_background_write(&mut self, index: DriveIndex, pdu: &RequestPdu, outcome: &Outcome, now: Instant) {
        let words = &mut self.drives.of_mut(index).words;
        match outcome {
            Outcome::Acknowledged(_) => words.written(pdu),
            Outcome::Exception(_) => {}
            _ => words.forget(),
        }
        if let Some((table, items)) = written(pdu) {
            if outcome.is_ok() && table == Table::Holding {
                self.bus.image.drives.of(index).note_written(&items, now);
            }
            self.note_write(index, table, &items, now);
        }
    }
}

/// Why a write for a tool is not sent any more, if its client has lost the right to write to this bus.
fn lost_right(request: &BackgroundRequest, stage: Stage, bus: &str) -> Option<Refusal> {
    request.passed_on.as_ref().filter(|passed_on| passed_on.may_write)?;
    client_access(stage, false, request.ticket.origin(), bus).err()
}
