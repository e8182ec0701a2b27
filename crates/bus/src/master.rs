//! The master of a line: decides the next request and applies results. Pure: time is an argument.
//!
//! [`Master::next`] chooses among stops, other commands, forwarded reads, polls and background transactions;
//! [`Master::done`] takes the result of a transaction and returns the changes. The state of one drive is in its
//! `DriveState`. Choosing is in `choose`, results are in `results`, background transactions in `background`, the end of
//! the gateway is in `shutdown`.

mod background;
mod choose;
mod holder;
mod passed_on;
mod pauses;
mod permission;
mod refreshing;
mod remains;
mod results;
mod shutdown;
mod waits;

use self::waits::Waits;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

pub use self::remains::Remains;

use self::background::ChosenTransaction;
use self::choose::Turns;
use self::holder::report_control;
use self::shutdown::Shutdown;
use super::BusOptions;
use super::command_run::StepPurpose;
use super::drive_state::DriveState;
use super::late_replies::{FORGOTTEN_AFTER, LateReplies, are_alike};
use super::line_state::{Learned, Sending};
use super::n2_late_replies::{N2LateReplies, n2_look_alike};
use super::n2_session::N2Sessions;
use super::news::News;
use super::refresh::Repeated;
use super::repeated_stops::RepeatedStops;
use super::schedule::{Cadence, Poll, Schedule};
use super::start_gate::StartGate;
use super::supervision::{Demand, Lease, Orders};
use super::transaction::Ended;
use drivegate_core::order::{DEFAULT_EXPIRY, Interruption, Origin, Outcome, SourceKind, Target, Urgency};
use drivegate_core::plant::{BusHandle, turn_away};
use drivegate_core::process_image::{DriveImage, Timing};
use drivegate_model::drive::plan::WireTime;
use drivegate_model::drive::{DriveIndex, ModelPoint, PerDrive, Plan, PlannedRead, PollClass, Value};
use drivegate_proto::n2::Session;
use drivegate_proto::{Protocol, RequestPdu};

/// Longest time between two checks of the bus at its drives and queue.
const LOOK_ROUND: Duration = Duration::from_millis(100);
/// Number of response timeouts within which a late N2 reply may arrive.
const N2_LATE: u32 = 3;
/// Longest wait for a late reply: a silent drive is probed within 10 s.
const LONGEST_N2_LATE: Duration = Duration::from_secs(9);
/// Time for the first byte of the reply to a probe of an offline drive, or to a stop, unless the drive is known to
/// be slower: probing it every 10 s then costs less than 2 % of the line.
const PROBE_TIMEOUT: Duration = Duration::from_millis(160);
/// One in this number of probes waits as long as any other request, because the drive may be slow.
const PATIENT_PROBES: u32 = 6;

/// A transaction to send: purpose and request.
#[derive(Debug, Clone, PartialEq)]
pub struct Turn {
    /// Purpose of the transaction, with its drive.
    pub purpose: Purpose,
    pdu: RequestPdu,
}

/// The purpose of a transaction.
#[derive(Debug, Clone, PartialEq)]
pub enum Purpose {
    /// A poll of the drive.
    Poll(Poll),
    /// A step of the started command in that slot, competing with that rank.
    Command {
        /// The drive of the command.
        drive: DriveIndex,
        /// The slot of the drive's started command.
        slot: Urgency,
        /// Rank with which the command competes for the line.
        rank: Urgency,
        /// The purpose of the command's step.
        step: StepPurpose,
    },
    /// The background request that is next to be sent.
    Background(Target),
    /// A step of the refresh of the drive.
    Refresh(DriveIndex),
    /// A step of the N2 session with the drive, needed before a read of the plan or a step of the started command in
    /// that slot.
    Session(DriveIndex, Session, Before),
}

/// Continuation after a step of an N2 session.
#[derive(Debug, Clone, PartialEq)]
pub enum Before {
    /// A poll of the drive.
    Poll(Poll),
    /// A step of a started command: slot and rank.
    Command(Urgency, Urgency),
}

impl Turn {
    /// Receiver of the request.
    pub fn target(&self) -> Target {
        match &self.purpose {
            Purpose::Poll(poll) => poll.drive.into(),
            Purpose::Command { drive, .. } | Purpose::Refresh(drive) | Purpose::Session(drive, ..) => (*drive).into(),
            Purpose::Background(target) => *target,
        }
    }

    /// The drive that receives the request; `None` if none is configured at its address.
    pub fn drive(&self) -> Option<DriveIndex> {
        self.target().drive()
    }

    /// The request to send.
    pub fn pdu(&self) -> &RequestPdu {
        &self.pdu
    }

    /// The rank of the turn's command; `None` for a poll or a background transaction.
    pub fn rank(&self) -> Option<Urgency> {
        match &self.purpose {
            Purpose::Command { rank, .. } | Purpose::Session(_, _, Before::Command(_, rank)) => Some(*rank),
            Purpose::Poll(_) | Purpose::Background(_) | Purpose::Refresh(_) | Purpose::Session(..) => None,
        }
    }
}

/// The result of a turn.
#[derive(Debug)]
pub struct TurnEnd {
    /// Result of the transaction.
    pub ended: Ended,
    /// When the request was given to the line.
    pub began: Instant,
    /// When the transaction ended: no later than a reply can have left the drive.
    pub at: Instant,
    /// Whether the thread was stalled meanwhile: the missing reply may be due to that.
    pub stood: bool,
    /// Time for which the line was in use.
    pub took: Duration,
    /// The invalid bytes were the drive's own reply, damaged.
    pub mangled: bool,
    /// Whether a complete reply was rejected because the line could not have carried it so soon.
    pub doubted: bool,
    /// The reply frame as the drive sent it, for [`Purpose::Background`].
    pub frame: Vec<u8>,
}

/// How a transaction used the line.
#[derive(Debug, Clone, Copy)]
struct LineUse {
    /// When the request was given to the line.
    began: Instant,
    /// When the transaction ended: no later than a reply can have left the drive.
    at: Instant,
    /// Time for which the line was in use.
    took: Duration,
    /// Whether the thread was stalled meanwhile.
    stood: bool,
}

impl TurnEnd {
    fn line_use(&self) -> LineUse {
        LineUse {
            began: self.began,
            at: self.at,
            took: self.took,
            stood: self.stood,
        }
    }
}

/// State of a drive that continues over a reload.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CarriedState {
    /// Lease of the drive at the handover.
    pub lease: Lease,
    /// Refresh of orders for the drive's own timeout.
    pub repeated: Repeated,
    /// The stops that are to be written again.
    pub stops: RepeatedStops,
}

impl CarriedState {
    /// The lease without the data for refreshes and repetitions.
    #[must_use]
    pub fn alone(self) -> CarriedState {
        CarriedState {
            lease: self.lease,
            ..CarriedState::default()
        }
    }

    /// The lease, with the time limit extended by a period in which the gateway did not run.
    #[must_use]
    pub fn after(self, stood: Duration) -> CarriedState {
        CarriedState {
            lease: self.lease.after(stood),
            ..self.alone()
        }
    }
}

/// State that an ended bus hands over to the next one on the same line.
#[derive(Debug, Clone, Default)]
pub struct Handover {
    /// The leases of its drives, in their order, with the orders that are refreshed under them.
    pub leases: Vec<CarriedState>,
    /// Time until which a reply to its last request may arrive; `None` if no bus used the line before.
    pub quiet_until: Option<Instant>,
    /// What the line has shown to the previous bus.
    pub learned: Option<Learned>,
}

/// The master of a line: chooses and evaluates all transactions.
#[derive(Debug)]
pub struct Master {
    bus: BusHandle,
    retries: u32,
    response_timeout: Duration,
    /// Silence that is kept before each request.
    silence: Duration,
    schedule: Schedule,
    drives: PerDrive<DriveState>,
    /// Conditions that a transaction may have to wait for.
    waits: Waits,
    /// The last two requests with a reply, valid or damaged, the later one first: a duplicate of the reply may arrive.
    /// The duplicate of a long reply takes longer than the next short transaction.
    last_answered: [Option<(Target, RequestPdu)>; 2],
    turns: Turns,
    /// The background request that is next to be sent, or is on the line.
    background: Option<ChosenTransaction>,
    /// The last one was passed on to drives of the bus as a command.
    passed_on_last: bool,
    shutdown: Option<Shutdown>,
    /// Whether this bus, or the one before it, used the line before it was opened.
    successor: bool,
    /// Consecutive probes without a reply, by drive.
    probes: PerDrive<u32>,
    /// Whether a late reply was already possible before the transaction that is on the line.
    late_before: bool,
    /// How much longer refreshes have used the line than polls since then: refreshes may use it at most as long as polls.
    refresh_debt: Duration,
}

impl Master {
    /// The master of a bus that is not open yet. `silence` is kept before each request.
    pub fn new(bus: BusHandle, options: &BusOptions, silence: Duration, before: &Handover, now: Instant) -> Master {
        let spec = &bus.image.spec;
        let images = &bus.image.drives;
        let cadence = Cadence {
            fast: spec.cycle,
            slow: spec.slow_cycle,
            retries: options.retries,
        };
        let plans: PerDrive<&Plan> = images.iter().map(|d| &d.plan).collect();
        let cost = |index: DriveIndex, read: &PlannedRead| {
            let drive = &images.of(index).spec;
            let silence = drive.timing.silence_around(silence);
            WireTime::of(spec.protocol, &spec.format, &read.pdu()).total(drive.turnaround, silence)
        };
        let fast = |(index, plan): (DriveIndex, &&Plan)| -> Duration {
            let reads = plan.reads.iter().filter(|read| read.class == PollClass::Fast);
            reads.map(|read| cost(index, read)).sum()
        };
        let round = spec.cycle.max(plans.enumerate().map(fast).sum());
        let mut schedule = Schedule::new(cadence, &plans, cost, now);
        schedule.try_again(images.iter().map(|image| image.spec.timing.retries));
        let mut drives: PerDrive<DriveState> = images.iter().map(|image| DriveState::new(&image.spec, round)).collect();
        for (drive, carried) in drives.iter_mut().zip(&before.leases) {
            drive.supervision.take_over(carried.lease);
            drive.refresh.take_over(carried.repeated, now);
            drive.repeated_stops = carried.stops;
        }
        let sessions = match spec.protocol {
            Protocol::N2 => N2Sessions::new(images.iter().map(|d| d.spec.profile.n2)),
            Protocol::ModbusRtu | Protocol::ModbusAscii => N2Sessions::default(),
        };
        Master {
            retries: options.retries,
            response_timeout: options.response_timeout,
            silence,
            schedule,
            probes: vec![0; drives.len()].into(),
            drives,
            waits: Waits {
                sessions,
                n2_late: N2LateReplies::default(),
                strangers: BTreeMap::new(),
                starts: StartGate::of(&bus),
                quiet: None,
            },
            last_answered: [None, None],
            turns: Turns::default(),
            background: None,
            passed_on_last: false,
            shutdown: None,
            successor: before.quiet_until.is_some(),
            late_before: false,
            refresh_debt: Duration::ZERO,
            bus,
        }
    }

    /// The port was opened: every drive must be found again.
    pub fn opened(&mut self, now: Instant) {
        self.schedule.reset(now);
        self.waits.sessions.reset();
        self.last_answered = [None, None];
        self.probes.fill(0);
    }

    /// The port is lost: started commands end.
    pub fn lost(&mut self, now: Instant) {
        self.successor = true;
        for drive in &mut self.drives {
            drive.refresh.not_answered(now);
            drive.close(&Outcome::BusDown, Interruption::BusDown, now);
        }
        self.abandon_background(Outcome::BusDown, Interruption::BusDown, now);
    }

    /// Ends the bus: started commands end. Returns the handover for the next bus. A transaction still on the line is
    /// aborted; it would have ended at `broken_off`.
    pub fn ended(&mut self, broken_off: Option<Instant>, now: Instant) -> Handover {
        if let Some(shutdown) = &mut self.shutdown {
            shutdown.end(&self.bus);
        }
        let mut queue = self.bus.queue.lock();
        for drive in &mut self.drives {
            if queue.is_ending()
                && let Some(stop) = drive.take_stop(now)
                && let Err(stop) = queue.give_back(stop)
            {
                stop.answer(&Outcome::ShuttingDown, now);
            }
        }
        queue.gate.settle(|_| false);
        drop(queue);
        for (drive, image) in self.drives.iter_mut().zip(&self.bus.image.drives) {
            // A heartbeat that arrived while the port was lost has not been evaluated yet.
            if let Some(at) = image.take_heartbeat() {
                drive.supervision.renew(at);
            }
        }
        let close = |drive: &mut DriveState| {
            drive.close(&Outcome::ShuttingDown, Interruption::ShuttingDown, now);
            CarriedState {
                lease: drive.supervision.lease(),
                repeated: drive.refresh.handed_over(),
                stops: drive.repeated_stops,
            }
        };
        let leases = self.drives.iter_mut().map(close).collect();
        self.abandon_background(Outcome::ShuttingDown, Interruption::ShuttingDown, now);
        let late = self
            .drives
            .iter()
            .map(|drive| &drive.late)
            .chain(self.waits.strangers.values());
        let late = late.filter_map(LateReplies::until);
        let window = match self.waits.sessions.is_empty() {
            true => FORGOTTEN_AFTER,
            false => self.n2_window(),
        };
        let broken_off = broken_off.map(|deadline| deadline + window);
        Handover {
            leases,
            learned: None,
            quiet_until: late
                .chain(self.waits.n2_late.until())
                .chain(broken_off)
                .chain([now])
                .max(),
        }
    }

    /// The next transaction to send.
    ///
    /// # Errors
    /// If nothing is to be done yet: the time of the next thing to do, always after `now`.
    pub fn next(&mut self, now: Instant, news: &mut Vec<News>) -> Result<Turn, Instant> {
        self.put_back_background(now);
        self.check(now, news);
        let next = self.choose(now);
        if let Some(round) = self.schedule.take_round() {
            news.push(News::FastRound(round.cycle));
        }
        if let Some(starts) = &mut self.waits.starts {
            news.append(&mut starts.take_news());
        }
        let mut queue = self.bus.queue.lock();
        queue.settle_stops(|drive| self.drives.of(drive).is_stopping());
        let denied = queue.take_denied();
        drop(queue);
        news.extend(denied.into_iter().map(News::Denied));
        next.map_err(|until| until.min(now + LOOK_ROUND))
    }

    /// Checks what time and samples have changed: leases, confirmations, N2 drives that are due for a poll.
    fn check(&mut self, now: Instant, news: &mut Vec<News>) {
        let Master {
            bus, drives, schedule, ..
        } = self;
        let has_authority = bus.queue.has_authority();
        for ((index, drive), image) in drives.enumerate_mut().zip(&bus.image.drives) {
            if !drive.confirmations.is_empty() {
                let to_read = drive.confirmations.take_to_read().into_iter();
                for raw in to_read.filter_map(|point| image.spec.profile.points.get(point)?.raw()) {
                    schedule.read_soon(index, |read| read.covers(raw.table, raw.address), now);
                }
                if std::mem::take(&mut drive.was_read) {
                    drive.confirmations.take_reading(&image.reading(now, drive.fresh), now);
                }
                let late = drive.confirmations.expire(&image.spec.profile, now);
                news.extend(late.into_iter().map(|late| News::NotConfirmed(index, late)));
            }
            if drive.has_authority || has_authority {
                report_control(bus, index, image, drive, has_authority, now);
            }
            if image.spec.supervision.is_some() {
                supervise(bus, index, image, drive, now, news);
            }
            if drive.repeated_stops.take_due(now) {
                let origin = Origin::new(SourceKind::Schedule, Origin::REPEATED_STOP);
                let stop = (ModelPoint::Run, Value::Bool(false));
                let ordered = bus.own_order(index, &image.reading(now, drive.fresh), stop, origin, DEFAULT_EXPIRY);
                // A drive that accepts no orders any more has no start of the gateway pending.
                tracing::debug!(target: "drivegate::bus::master", drive = %image.spec.name, ?ordered, "a stop again");
            }
        }
        self.check_refreshes(now, news);
        self.check_starts(now);
        for drive in self.waits.sessions.neglected(now).collect::<Vec<_>>() {
            self.schedule.ask(drive, now);
        }
        self.check_shutdown(now);
    }

    /// Updates the start guards with the state of their drives.
    fn check_starts(&mut self, now: Instant) {
        let Master {
            bus,
            drives,
            waits,
            background,
            ..
        } = self;
        let Some(starts) = &mut waits.starts else { return };
        for ((index, drive), image) in drives.enumerate_mut().zip(&bus.image.drives) {
            if starts.guards(index) {
                let reading = image.reading(now, drive.fresh);
                starts.update(index, drive, &reading);
                starts.check_interlocks(bus, index, image, &drive.words, &reading);
            }
        }
        let mut pending = bus.queue.lock();
        if pending.gate.has_cleared() {
            let background = background.as_ref().and_then(ChosenTransaction::number);
            let begun = drives
                .iter_mut()
                .filter_map(|drive| drive.run(Urgency::Command)?.start.as_ref());
            let begun: Vec<u64> = begun.map(|start| start.number).chain(background).collect();
            let waiting: Vec<u64> = pending.numbers().collect();
            pending
                .gate
                .settle(|number| waiting.contains(&number) || begun.contains(&number));
        }
    }

    /// Notes that the turn is sent at `now`.
    pub fn sending(&mut self, turn: &Turn, now: Instant) -> Sending {
        if let Purpose::Command {
            drive: index,
            slot,
            step,
            ..
        } = &turn.purpose
        {
            let drive = self.drives.of_mut(*index);
            let step = super::command_run::Step {
                purpose: *step,
                pdu: turn.pdu.clone(),
            };
            drive.sent(*slot, &step, now);
            let start = drive.run(*slot).and_then(|run| run.start.clone());
            if let Some(starts) = self.waits.starts.as_ref().filter(|_| step.pdu.is_write()) {
                let profile = &self.bus.image.drives.of(*index).spec.profile;
                starts.written(*index, profile, &step.pdu, start.as_ref(), now);
            }
        }
        if self.bus.image.spec.tells_replies_apart()
            && let Some(index) = turn.drive()
        {
            let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
            drive.repeated_stops.sending(&image.spec.profile, &turn.pdu, now);
        }
        let is_command = matches!(
            turn.purpose,
            Purpose::Command {
                slot: Urgency::Command,
                ..
            }
        );
        for (index, drive) in self.drives.enumerate_mut() {
            if !(is_command && turn.target() == index)
                && let Some(run) = drive.run(Urgency::Command)
            {
                run.others_go_first();
            }
        }
        if let Purpose::Background(_) = turn.purpose {
            self.background_sent(now);
        }
        self.others_before_refresh(turn);
        let mut late = self
            .drives
            .iter()
            .map(|drive| &drive.late)
            .chain(self.waits.strangers.values());
        self.late_before = self.waits.n2_late.may_come(now) || late.any(|late| late.may_come(now));
        let n2 = !self.waits.sessions.is_empty();
        let is_alike = |(of, answered): &(Target, RequestPdu)| match n2 {
            // An N2 reply does not even show its drive.
            true => n2_look_alike(answered, &turn.pdu),
            false => *of == turn.target() && are_alike(answered, &turn.pdu),
        };
        Sending {
            silence: self.silence_of(turn),
            response_timeout: self.timeout_of(turn),
            late_may_come: self.late_before,
            // After reopening a line that was in use, the last request on it is unknown.
            could_be_doubled: match &self.last_answered {
                [None, _] => self.successor,
                answered => answered.iter().flatten().any(is_alike),
            },
        }
    }

    fn timeout_of(&self, turn: &Turn) -> Duration {
        if let Some(timeout) = self.passed_on_timeout(turn) {
            return timeout;
        }
        let Target::Drive(index) = turn.target() else {
            return self.response_timeout;
        };
        let probes = *self.probes.of(index);
        let patient = probes <= self.retries_of(index) || probes.is_multiple_of(PATIENT_PROBES);
        let timeout = self.response_timeout_of(index);
        if self.schedule.is_online(index) || patient {
            return timeout;
        }
        timeout.min(PROBE_TIMEOUT.max(2 * self.drives.of(index).answers_within))
    }

    /// The drive's own times, if it has any configured.
    fn timing_of(&self, target: Target) -> Timing {
        let own = |drive| self.bus.image.drives.of(drive).spec.timing;
        target.drive().map_or_else(Timing::default, own)
    }

    pub(super) fn response_timeout_of(&self, target: impl Into<Target>) -> Duration {
        let own = self.timing_of(target.into()).response_timeout;
        own.unwrap_or(self.response_timeout)
    }

    pub(super) fn retries_of(&self, drive: DriveIndex) -> u32 {
        self.timing_of(drive.into()).retries.unwrap_or(self.retries)
    }

    /// Silence before the request of this turn, and after its reply before a request to another drive.
    pub(crate) fn silence_of(&self, turn: &Turn) -> Duration {
        self.timing_of(turn.target()).silence.unwrap_or(self.silence)
    }

    /// Time within which a late reply may arrive on an N2 line.
    pub(super) fn n2_window(&self) -> Duration {
        let own = self
            .bus
            .image
            .drives
            .iter()
            .filter_map(|image| image.spec.timing.response_timeout);
        let longest = own.chain([self.response_timeout]).max().unwrap_or_default();
        (N2_LATE * longest).min(LONGEST_N2_LATE)
    }

    /// The reads that each drive never answers although it answers others.
    pub(crate) fn unanswered(&self) -> PerDrive<Vec<PlannedRead>> {
        self.schedule.unanswered()
    }

    /// The late replies that may still arrive on an N2 line, for the bytes of a transaction.
    pub(crate) fn n2_late(&mut self) -> &mut N2LateReplies {
        &mut self.waits.n2_late
    }
}

/// Evaluates the lease of a drive.
pub(super) fn supervise(
    bus: &BusHandle,
    index: DriveIndex,
    image: &Arc<DriveImage>,
    drive: &mut DriveState,
    now: Instant,
    news: &mut Vec<News>,
) {
    if let Some(at) = image.take_heartbeat() {
        drive.supervision.renew(at);
    }
    let mut queue = bus.queue.lock();
    let (renewed, queued) = (queue.take_renewed(index), queue.client_waits_until(index));
    drop(queue);
    if renewed {
        drive.supervision.renew(now);
    }
    let orders = Orders {
        held_until: queued.max(drive.client_holds_until()),
    };
    let reading = image.reading(now, drive.fresh);
    let DriveState { supervision, words, .. } = drive;
    let demand = supervision.due_action(&reading, words, orders, now, news, index);
    image.set_unsupervised(supervision.runs_unclaimed());
    match demand {
        Demand::None => {}
        Demand::Withdraw => {
            bus.queue.lock().withdraw_supervision(index, now);
            drive.withdraw_supervision(now);
            drive.supervision.withdrawn(now);
        }
        Demand::Write(point, value) => {
            let origin = Origin::new(SourceKind::Supervision, Origin::LEASE);
            let ordered = bus.own_order(index, &reading, (point, value), origin.clone(), DEFAULT_EXPIRY);
            if let Some(refusal) = supervision.ordered(ordered, now) {
                let what = format!("{}={value}", point.name());
                let outcome = Outcome::Refused(refusal.clone());
                turn_away(&bus.command_log, &image.spec.name, &what, outcome, origin, now);
                news.push(News::ActionRefused {
                    drive: index,
                    what,
                    refusal,
                });
            }
        }
    }
}

#[cfg(test)]
mod tests;
