//! The master of a line: decides the next request and applies results. Pure: time is an argument.
//!
//! [`Master::next`] chooses among stops, other commands, forwarded reads, polls and background transactions;
//! [`Master::done`] takes the result of a transaction and returns the changes. The state of one drive is in its
//! `DriveState`. Choosing is in `choose`, transactions are in `turn`, their times in `timing`, results in `results`,
//! background transactions in `background`, leases in `lease`; the end of a bus is in `handover`, that of the gateway in
//! `shutdown`.

mod awaited_direction;
mod background;
mod choose;
mod handover;
mod holder;
mod lease;
mod passed_on;
mod pauses;
mod permission;
mod refreshing;
mod remains;
mod results;
mod shutdown;
mod timing;
mod turn;
mod waits;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

pub use self::handover::{CarriedState, Handover};
pub use self::remains::Remains;
pub use self::turn::{Before, Purpose, Turn, TurnEnd};

use self::background::ChosenTransaction;
use self::choose::Turns;
use self::holder::report_control;
pub(crate) use self::lease::supervise;
use self::shutdown::Shutdown;
use self::turn::LineUse;
use self::waits::Waits;
use super::BusOptions;
use super::drive_state::DriveState;
use super::late_replies::are_alike;
use super::line_state::Sending;
use super::n2_late_replies::{N2LateReplies, n2_look_alike};
use super::n2_session::N2Sessions;
use super::news::News;
use super::schedule::{Cadence, Schedule};
use super::start_gate::StartGate;
use drivegate_core::order::{DEFAULT_EXPIRY, Interruption, Origin, Outcome, SourceKind, Target, Urgency};
use drivegate_core::plant::BusHandle;
use drivegate_model::drive::plan::WireTime;
use drivegate_model::drive::{DriveIndex, ModelPoint, PerDrive, Plan, PlannedRead, PollClass, Value};
use drivegate_proto::{Protocol, RequestPdu};

/// Longest time between two checks of the bus at its drives and queue.
const LOOK_ROUND: Duration = Duration::from_millis(100);

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
            drive.words.take_over(carried.direction);
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
            // Between the writes of a start, a stop would stop what a client has just ordered. If the start ends before its
            // run command, the stop goes then.
            if !drive.is_starting(index) && drive.repeated_stops.take_due(now) {
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
        self.turns.sent();
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
            let of_start = matches!(
                turn.purpose,
                Purpose::Command {
                    slot: Urgency::Command,
                    ..
                }
            ) && drive.is_starting(index);
            drive
                .repeated_stops
                .sending(&image.spec.profile, &turn.pdu, of_start, now);
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
        match &turn.purpose {
            Purpose::Background(_) => self.background_sent(now),
            Purpose::Poll(poll) | Purpose::Session(_, _, Before::Poll(poll)) if poll.probe => {
                self.schedule.probe_sent(poll.drive);
            }
            _ => {}
        }
        self.others_before_refresh(turn);
        let mut late = self
            .drives
            .iter()
            .map(|drive| &drive.late)
            .chain(self.waits.strangers.values());
        self.late_before = self.waits.n2_late.may_come(now) || late.any(|late| late.may_come(now));
        let n2 = !self.waits.sessions.is_empty();
        let is_alike = |(of, answered): &(Target, RequestPdu)| {
            if n2 {
                // An N2 reply does not even show its drive.
                n2_look_alike(answered, &turn.pdu)
            } else {
                *of == turn.target() && are_alike(answered, &turn.pdu)
            }
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

    /// The reads that each drive never answers although it answers others.
    pub(crate) fn unanswered(&self) -> PerDrive<Vec<PlannedRead>> {
        self.schedule.unanswered()
    }

    /// The late replies that may still arrive on an N2 line, for the bytes of a transaction.
    pub(crate) fn n2_late(&mut self) -> &mut N2LateReplies {
        &mut self.waits.n2_late
    }
}

#[cfg(test)]
mod tests;
