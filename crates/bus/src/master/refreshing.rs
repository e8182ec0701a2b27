//! When the refresh of a drive is sent, and what follows from the replies to its steps.

use std::time::{Duration, Instant};

use super::permission::AtTurn;
use super::{Master, Purpose, Turn, TurnEnd};
use crate::drive_state::DriveState;
use crate::news::News;
use crate::refresh::{Around, End};
use crate::transaction::Ended;
use drivegate_core::order::{Arrival, Effect, Effects, Intent, Order, Origin, Outcome, SourceKind, Touched, Window};
use drivegate_core::permit::{Ask, Facts, Stage, Verdict, broken_limit};
use drivegate_model::drive::{DriveIndex, PlannedRead, PollClass};
use drivegate_proto::{Reply, RequestPdu, Table};

/// Limit for the time of refreshes that polls get back.
const MOST_DEBT: Duration = Duration::from_secs(2);

/// Whether a refresh may write now.
enum May {
    Yes,
    NotNow,
    No(End),
}

impl Master {
    /// Ends refreshes that time, samples or accepted orders contradict, and reports which refreshes continue.
    pub(super) fn check_refreshes(&mut self, now: Instant, news: &mut Vec<News>) {
        let Master { bus, drives, .. } = self;
        for ((index, drive), image) in drives.enumerate_mut().zip(&bus.image.drives) {
            if image.spec.refresh.is_none() {
                continue;
            }
            if drive.refresh.has_begun() && !drive.has_runs() {
                let queue = bus.queue.lock();
                let around = Around {
                    stops: queue.gate.stops(index),
                    delayed: queue.stop_waits(index, now).is_some(),
                    held: drive.supervision.is_held(),
                };
                drop(queue);
                let ended = drive.refresh.check(&image.reading(now, drive.fresh), around);
                drive.refresh_ended = ended.or(drive.refresh_ended.take());
            }
            // A stop is the usual end, and not reported.
            if let Some(why) = drive.refresh_ended.take().filter(|why| *why != End::Stop) {
                news.push(News::RefreshEnded {
                    drive: index,
                    why: why.to_string(),
                });
            }
            image.set_refreshing(drive.refresh.is_going());
        }
    }

    /// The next step of a refresh round that has done its reads: only stops, and orders to this drive, go between
    /// its frames.
    pub(super) fn refresh_goes_on(&mut self, now: Instant) -> Option<Turn> {
        if self.refreshes_cease() {
            return None;
        }
        let under_way = |(_, drive): &(DriveIndex, &DriveState)| drive.refresh.is_under_way() && !drive.has_runs();
        let (index, _) = self.drives.enumerate().find(under_way)?;
        self.refresh_step(index, now)
    }

    /// The first step of the round that is due longest, of those that may go now. Polls get the line for as long as refreshes
    /// had it, unless it is `idle`.
    pub(super) fn refresh(&mut self, idle: bool, now: Instant) -> Option<Turn> {
        if !self.refresh_debt.is_zero() && !idle {
            return None;
        }
        let mut due: Vec<(Instant, DriveIndex)> = self.due_refreshes().filter(|(due, _)| *due <= now).collect();
        due.sort_unstable();
        due.into_iter()
            .find_map(|(_, index)| match self.may_begin_refresh(index, now) {
                May::Yes => self.refresh_step(index, now),
                May::NotNow => None,
                May::No(why) => {
                    self.end_refresh(index, why);
                    None
                }
            })
    }

    /// When to look for the next round on an idle line. A round that is due and may not go is asked about again a moment later.
    pub(super) fn next_refresh(&self, now: Instant) -> Option<Instant> {
        let at = |due: Instant| if due > now { due } else { now + super::LOOK_ROUND };
        self.due_refreshes().map(|(due, _)| at(due)).min()
    }

    /// Whether nothing is repeated any more because the gateway stops.
    fn refreshes_cease(&self) -> bool {
        self.shutdown.is_some()
    }

    /// Whether nothing may be sent to this drive because of a drill that tests the drive's own timeout.
    fn is_quiet(&self, index: DriveIndex) -> bool {
        self.waits.quiet.is_some_and(|(quiet, _)| quiet == index)
    }

    fn due_refreshes(&self) -> impl Iterator<Item = (Instant, DriveIndex)> + '_ {
        let may = |index: DriveIndex, drive: &DriveState| {
            !drive.has_runs() && !self.is_quiet(index) && !self.refreshes_cease() && self.schedule.is_online(index)
        };
        let due = move |(index, drive): (DriveIndex, &DriveState)| {
            let due = drive.refresh.due().filter(|_| may(index, drive))?;
            Some((due, index))
        };
        self.drives.enumerate().filter_map(due)
    }

    /// The request of the present step, where the gate lets it pass.
    fn refresh_step(&mut self, index: DriveIndex, now: Instant) -> Option<Turn> {
        match self.may_refresh(index, Stage::Write, now) {
            May::Yes => {}
            May::NotNow => {
                self.drives.of_mut(index).refresh.put_off(now);
                return None;
            }
            May::No(why) => {
                self.end_refresh(index, why);
                return None;
            }
        }
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        let profile = &image.spec.profile;
        let pdu = drive.words.formed(drive.refresh.request(profile)?, profile);
        if let Some(until) = drive.late.blocks(&pdu, now) {
            drive.refresh.put_off(until);
            return None;
        }
        Some(Turn {
            purpose: Purpose::Refresh(index),
            pdu,
        })
    }

    /// The write of a round that stops to other drives overtook too often: such a stop waits for this one frame. A stop to the
    /// drive itself has ended its refresh.
    pub(super) fn owed_refresh(&mut self, now: Instant) -> Option<Turn> {
        let is_owed = |(_, drive): &(DriveIndex, &DriveState)| drive.refresh.is_owed_its_write() && !drive.has_runs();
        let (index, _) = self.drives.enumerate().find(is_owed)?;
        self.refresh_step(index, now)
    }

    /// Whether a chosen frame of a refresh may still be sent.
    pub(super) fn may_still_refresh(&mut self, index: DriveIndex, now: Instant) -> bool {
        let is_under_way = self.drives.of(index).refresh.is_under_way();
        is_under_way && matches!(self.may_refresh(index, Stage::Write, now), May::Yes)
    }

    /// Judges a round before its first step: a reload may have changed the limits since the order.
    fn may_begin_refresh(&self, index: DriveIndex, now: Instant) -> May {
        let (drive, image) = (self.drives.of(index), self.bus.image.drives.of(index));
        let pdu = drive.refresh.writes(&image.spec.profile);
        let broken = pdu.and_then(|pdu| broken_limit(&image.reading(now, drive.fresh), &pdu));
        match broken {
            Some(refusal) => May::No(End::Refused(refusal.to_string())),
            None => self.may_refresh(index, Stage::Turn, now),
        }
    }

    /// Judges a refresh by the rules as an order of the gateway: the order in force is repeated, regardless of
    /// which client holds the drive now.
    fn may_refresh(&self, index: DriveIndex, stage: Stage, now: Instant) -> May {
        let (drive, image) = (self.drives.of(index), self.bus.image.drives.of(index));
        if self.refreshes_cease() || drive.has_runs() || self.is_quiet(index) {
            return May::NotNow;
        }
        let (runs, pdu) = (drive.refresh.runs(), drive.refresh.writes(&image.spec.profile));
        let Some(pdu) = pdu else { return May::NotNow };
        let effect = Effect {
            stops: !runs,
            reference: true,
            ..Effect::default()
        };
        let order = Order::Write(pdu);
        let touched = Touched::of(&order, &[], &image.spec.profile);
        let window = Window {
            arrival: Arrival::now(now),
            expires: now + super::LOOK_ROUND,
            waits: false,
        };
        let intent = Intent::new(index, order, Effects::on_one(index, effect, touched), window);
        let facts = AtTurn::of(&self.drives, &self.bus.image.drives, now);
        let seen = facts.seen(index);
        let origin = Origin::new(SourceKind::Supervision, "refresh");
        let origin = if drive.refresh.is_of_drill() {
            origin.of_drill("refresh".to_string())
        } else {
            origin
        };
        let ask = Ask {
            stage,
            now,
            drive: index,
            intent: &intent,
            origin: &origin,
            seen: seen.as_ref(),
        };
        let mut queue = self.bus.queue.lock();
        if runs && queue.gate.stops(index) != drive.refresh.stops_before() && queue.stop_waits(index, now).is_none() {
            return May::No(End::Stop);
        }
        if queue.awaits(index) {
            return May::NotNow;
        }
        match queue.gate.ask(&ask) {
            Verdict::Go => May::Yes,
            Verdict::Wait(_) | Verdict::LookFirst => May::NotNow,
            Verdict::Refuse(Outcome::Refused(refusal)) => May::No(End::Refused(refusal.to_string())),
            Verdict::Refuse(outcome) => May::No(End::Refused(outcome.to_string())),
        }
    }

    fn end_refresh(&mut self, index: DriveIndex, why: End) {
        self.drives.of_mut(index).end_refresh(why);
    }

    /// A frame is sent: rounds of other drives must read again before they write.
    pub(super) fn others_before_refresh(&mut self, turn: &Turn) {
        for ((index, drive), image) in self.drives.enumerate_mut().zip(&self.bus.image.drives) {
            if drive.refresh.is_under_way() && turn.purpose != Purpose::Refresh(index) {
                let of_another = turn.drive().is_some_and(|drive| drive != index);
                drive.refresh.others_go_first(of_another, &image.spec.profile);
            }
        }
        if let Purpose::Refresh(index) = turn.purpose
            && turn.pdu.is_write()
        {
            self.bus.image.drives.of(index).count_refresh_write();
        }
    }

    /// A step of a refresh has ended.
    pub(super) fn refreshed(
        &mut self,
        index: DriveIndex,
        pdu: &RequestPdu,
        end: TurnEnd,
        now: Instant,
        news: &mut Vec<News>,
    ) {
        self.schedule.refreshed(end.took);
        self.refresh_debt = (self.refresh_debt + end.took).min(MOST_DEBT);
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        let Ended::Reply(reply) = end.ended else {
            drive.refresh.not_answered(now);
            return;
        };
        let is_answer = !matches!(reply, Reply::Exception(_));
        if is_answer {
            let believed = !drive.late.proves_nothing(pdu, end.began, now);
            drive.late.answered(pdu, end.began, now);
            if !believed {
                drive.refresh.not_answered(now);
                return;
            }
        }
        // A stall of the thread began the reads of the round again, so a reply to an earlier read answers none of them.
        let is_before_stall = end.stood && !pdu.is_write();
        if !is_before_stall && let Err(why) = drive.refresh.answered(&image.spec.profile, pdu, &reply, now) {
            drive.end_refresh(why);
        }
        if let (RequestPdu::Read { table, start, count }, Some(words)) = (pdu, reply.words()) {
            self.learn(index, read_of(*table, *start, *count), words, end.at, news);
        }
    }
}

fn read_of(table: Table, start: u16, count: u16) -> PlannedRead {
    PlannedRead {
        class: PollClass::Fast,
        table,
        start,
        count,
        wide: 0,
    }
}
