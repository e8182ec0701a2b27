//! Applies the result of a transaction: to the drive, its samples, the schedule and the command.

use std::time::{Duration, Instant};

use super::{Before, LineUse, Master, Purpose, Turn, TurnEnd};
use crate::command_run::{Step, StepPurpose};
use crate::n2_late_replies::LateRequest;
use crate::n2_session::Progress;
use crate::news::News;
use crate::schedule::{Change, Poll, Polled, TRIAL_PAUSE};
use crate::transaction::{CONNECTION_CLOSED, Ended, MAY_BE_LATE};
use drivegate_core::order::{Command, Outcome, Pace, Target, Urgency, is_range_end, written};
use drivegate_core::permit::is_reference;
use drivegate_model::drive::{DriveIndex, PlannedRead, Point, PointIndex};
use drivegate_proto::n2::Session;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

impl Master {
    /// Applies the effects of a turn's transaction that has ended.
    pub fn done(&mut self, turn: &Turn, end: TurnEnd, now: Instant, news: &mut Vec<News>) {
        self.note_late(turn, &end, now);
        match &turn.purpose {
            Purpose::Session(drive, step, before) => self.session_went_on(*drive, *step, before, end, now, news),
            Purpose::Poll(poll) => self.polled(poll, end, now, news),
            Purpose::Background(_) => self.background_over(turn, end, now, news),
            Purpose::Refresh(drive) => self.refreshed(*drive, &turn.pdu, end, now, news),
            Purpose::Command {
                drive,
                slot,
                rank,
                step,
            } => {
                let step = Step {
                    purpose: *step,
                    pdu: turn.pdu.clone(),
                };
                self.schedule.command_done(*rank, end.took);
                self.commanded(*drive, *slot, &step, end, now, news);
            }
        }
    }

    /// A drive has a new fault: the fault points of its profile are read.
    pub(crate) fn fault_came(&mut self, drive: DriveIndex, now: Instant) {
        let image = self.bus.image.drives.of(drive);
        let profile = &image.spec.profile;
        let points = profile
            .on_fault
            .iter()
            .filter_map(|index| profile.points.get(*index)?.raw());
        let wanted: Vec<_> = points.map(|raw| (raw.table, raw.address)).collect();
        let covers = |read: &PlannedRead| wanted.iter().any(|(table, address)| read.covers(*table, *address));
        self.schedule.fault_came(drive, covers, now);
    }

    /// Schedules the read of monitoring points for this time.
    pub fn monitor(&mut self, drive: DriveIndex, point: PointIndex, at: Instant) {
        let image = self.bus.image.drives.of(drive);
        let raw = image.spec.profile.points.get(point).and_then(Point::raw);
        let covers = |read: &PlannedRead| raw.is_some_and(|raw| read.covers(raw.table, raw.address));
        self.schedule.monitor(drive, covers, at);
    }

    /// Records the reply that may still arrive for the transaction. None is expected if the drive's own reply
    /// arrived damaged, unless the damaged one may have been a late reply to an earlier transaction.
    fn note_late(&mut self, turn: &Turn, end: &TurnEnd, now: Instant) {
        let target = turn.target();
        if self.is_broadcast(target) {
            // A broadcast has no reply.
            return;
        }
        let came_mangled = self.came_mangled(end);
        if !self.waits.sessions.is_empty() {
            self.note_late_on_n2(turn, end, came_mangled, now);
        }
        let mut drive = target.drive().map(|drive| self.drives.of_mut(drive));
        match &end.ended {
            Ended::Reply(reply) => {
                if !says_no_answer(reply) {
                    if let Some(drive) = &mut drive {
                        drive.exchanged(end.took);
                        if !matches!(reply, Reply::Exception(_)) {
                            drive.late.settled_by(&turn.pdu, now);
                        }
                    }
                    if let Some(drive) = target.drive() {
                        *self.probes.of_mut(drive) = 0;
                    }
                }
                self.note_answered(turn);
            }
            // A valid reply may follow the damaged one.
            Ended::Corrupt(_) if came_mangled => self.note_answered(turn),
            Ended::Silent | Ended::Corrupt(_) if self.bus.image.spec.tells_replies_apart() => {
                let image = target.drive().map(|drive| self.bus.image.drives.of(drive));
                if let Some((drive, image)) = drive.zip(image) {
                    drive.repeated_stops.not_answered(&image.spec.profile, &turn.pdu, now);
                }
            }
            Ended::Silent | Ended::Corrupt(_) if self.waits.sessions.is_empty() => {
                let late = match target {
                    Target::Drive(_) => drive.map(|drive| &mut drive.late),
                    Target::Address(address) => {
                        self.waits.strangers.retain(|_, late| late.may_come(now));
                        Some(self.waits.strangers.entry(address).or_default())
                    }
                };
                if let Some(late) = late {
                    late.given_up(&turn.pdu, end.began, now);
                }
            }
            Ended::Silent | Ended::Corrupt(_) => {}
        }
    }

    /// Keeps the request whose reply a duplicate may follow.
    pub(super) fn note_answered(&mut self, turn: &Turn) {
        let [last, before] = &mut self.last_answered;
        *before = last.replace((turn.target(), turn.pdu.clone()));
    }

    /// Whether the drive's own reply arrived damaged; false if the damaged one may have been a late reply to an
    /// earlier transaction.
    fn came_mangled(&self, end: &TurnEnd) -> bool {
        end.mangled && !self.late_before
    }

    /// Records the reply that may still arrive on an N2 line. Reads that waited for a late reply that will not come
    /// are due again.
    fn note_late_on_n2(&mut self, turn: &Turn, end: &TurnEnd, came_mangled: bool, now: Instant) {
        let address = match turn.target() {
            Target::Drive(drive) => self.bus.image.drives.of(drive).spec.address,
            Target::Address(address) => address,
        };
        let window = self.n2_window();
        let asked = LateRequest {
            address,
            pdu: &turn.pdu,
            device: turn.drive().map_or(0, |drive| self.waits.sessions.device(drive)),
            at: end.began,
        };
        match &end.ended {
            Ended::Reply(Reply::Exception(_)) => {}
            Ended::Reply(_) => {
                self.waits.n2_late.answered(address, &turn.pdu, window, now);
                let Master {
                    schedule, waits, bus, ..
                } = self;
                let drives = &bus.image.drives;
                schedule.recall(now, |drive, read| {
                    let address = drives.of(drive).spec.address;
                    waits.n2_late.blocks_poll(address, read, now).is_none()
                });
            }
            Ended::Corrupt(_) if came_mangled => {}
            Ended::Corrupt(MAY_BE_LATE) => self.waits.n2_late.doubted(asked, window, now),
            Ended::Silent | Ended::Corrupt(_) => self.waits.n2_late.given_up(asked, window, now),
        }
    }

    /// Handles the end of a step that N2 needs before a poll or a command: the poll or command is chosen again, or
    /// has failed with the step.
    fn session_went_on(
        &mut self,
        drive: DriveIndex,
        step: Session,
        before: &Before,
        end: TurnEnd,
        now: Instant,
        news: &mut Vec<News>,
    ) {
        let progress = self.waits.sessions.done(drive, step, &end.ended, now);
        match progress {
            Progress::Going | Progress::Failed => {}
            Progress::Unlike(device) => news.push(News::Unlike(drive, device)),
            Progress::Changed => self.schedule.read_again(drive, now),
            Progress::Restarted => self.restarted(drive, now, news),
        }
        let failed = progress == Progress::Failed;
        let ended = match end.ended {
            Ended::Corrupt(why) => Ended::Corrupt(why),
            // The session step has failed, whatever the answer was.
            Ended::Silent | Ended::Reply(_) => Ended::Silent,
        };
        let end = TurnEnd { ended, ..end };
        match before {
            Before::Poll(poll) if failed => self.polled(poll, end, now, news),
            Before::Poll(_) => self.schedule.session_done(drive),
            Before::Command(slot, rank) => {
                self.schedule.command_done(*rank, end.took);
                if failed {
                    self.step_failed(drive, *slot, &unheard(step), &end.ended, end.line_use(), now);
                }
            }
        }
    }

    /// Handles a drive that has restarted: nothing known about it is valid any more.
    pub(super) fn restarted(&mut self, drive: DriveIndex, now: Instant, news: &mut Vec<News>) {
        self.drives.of_mut(drive).restarted();
        self.schedule.read_again(drive, now);
        news.push(News::Restarted(drive));
    }

    /// Applies the result of a poll.
    fn polled(&mut self, poll: &Poll, end: TurnEnd, now: Instant, news: &mut Vec<News>) {
        self.refresh_debt = self.refresh_debt.saturating_sub(end.took);
        // After a session step before the poll, this is already recorded.
        let heard = self.waits.sessions.transaction_ended(poll.drive, &end.ended);
        if heard == Progress::Restarted {
            self.restarted(poll.drive, now, news);
        }
        let took = end.took;
        let used = end.line_use();
        let polled = match end.ended {
            Ended::Reply(_) if heard == Progress::Failed => Polled::Failed,
            // A gateway in between cannot reach the drive: its exception shows nothing about the drive.
            Ended::Reply(reply) if says_no_answer(&reply) => Polled::Failed,
            Ended::Reply(Reply::Exception(code)) => Polled::Refused(code),
            Ended::Reply(reply) if self.proves_nothing(poll, &reply) => {
                self.schedule.not_proved(poll.drive, &poll.read, TRIAL_PAUSE.1, now);
                Polled::Ok
            }
            Ended::Reply(reply) => {
                self.read(poll.drive, poll.read, reply, used, now, news);
                Polled::Ok
            }
            // The reply may have been lost by the stall: the drive does not count as offline before another request.
            Ended::Silent if end.stood => Polled::Garbled,
            // The drive is present, although such an early reply is not accepted yet.
            Ended::Silent if end.doubted => Polled::Garbled,
            Ended::Silent => Polled::Failed,
            Ended::Corrupt(_) => Polled::Garbled,
        };
        if poll.probe && matches!(polled, Polled::Failed | Polled::Garbled) {
            let probes = self.probes.of_mut(poll.drive);
            *probes = probes.saturating_add(1);
        }
        let change = self.schedule.poll_done(poll, polled, took, now);
        if poll.probe && end.doubted {
            // The drive is present: a second early reply is accepted, so the drive is requested at once instead of
            // with the next probe.
            self.schedule.seen(poll.drive, now);
        }
        if let Some(round) = self.schedule.take_slow_round() {
            news.push(News::SlowRound(round.cycle));
        }
        match change {
            Change::Online => news.push(News::Online(poll.drive)),
            Change::Offline => self.went_offline(poll.drive, now, news),
            Change::Unavailable(read, exception) => news.push(News::Unavailable(poll.drive, read, exception)),
            Change::None => {}
        }
    }

    /// Whether the reply to a read that no manual describes may come from a drive that ignores the number of items:
    /// all items after the first are 0. A reply with more proves the read until the drive goes offline.
    fn proves_nothing(&mut self, poll: &Poll, reply: &Reply) -> bool {
        if !self.schedule.is_trial(poll.drive, &poll.read) {
            return false;
        }
        let shows_more = reply
            .words()
            .is_some_and(|words| words.iter().skip(1).any(|word| *word != 0));
        if shows_more {
            self.schedule.proved(poll.drive, &poll.read);
        }
        !shows_more
    }

    /// Handles a drive that no longer replies: all waiting commands are answered, except the stop, which serves as a probe.
    fn went_offline(&mut self, index: DriveIndex, now: Instant, news: &mut Vec<News>) {
        self.drives.of_mut(index).went_offline(now);
        self.waits.sessions.gone(index);
        let gone = |c: &Command| c.intent.target == index && !c.is_stop();
        self.bus.queue.lock().remove(now, &Outcome::Offline, gone);
        news.push(News::Offline(index));
    }

    /// The drive answered a read.
    fn read(
        &mut self,
        index: DriveIndex,
        read: PlannedRead,
        reply: Reply,
        used: LineUse,
        now: Instant,
        news: &mut Vec<News>,
    ) {
        let pdu = read.pdu();
        let drive = self.drives.of_mut(index);
        let address = self.bus.image.drives.of(index).spec.address;
        let asked = self.waits.n2_late.asked_by(address, &pdu, used.at);
        let at = asked.unwrap_or_else(|| drive.late.asked_by(&pdu, used.at));
        drive.late.answered(&pdu, used.began, now);
        if let Some(words) = reply.into_words() {
            self.learn(index, read, words, at, news);
        }
    }

    /// Stores the drive's values at the addresses of a read, as of `at`.
    pub(super) fn learn(
        &mut self,
        index: DriveIndex,
        read: PlannedRead,
        words: Vec<u16>,
        at: Instant,
        news: &mut Vec<News>,
    ) {
        let drive = self.drives.of_mut(index);
        drive.was_read = true;
        for &(table, address) in drive.commanded.iter().filter(|(table, _)| *table == read.table) {
            let place = address.checked_sub(read.start).map(usize::from);
            if let Some(word) = place.and_then(|place| words.get(place)) {
                drive.words.learn(table, address, *word);
            }
        }
        news.push(News::Read {
            drive: index,
            read,
            words,
            at,
        });
    }

    /// Applies the result of a transaction to its command.
    fn commanded(
        &mut self,
        index: DriveIndex,
        slot: Urgency,
        step: &Step,
        end: TurnEnd,
        now: Instant,
        news: &mut Vec<News>,
    ) {
        let run = self.drives.of_mut(index).run(slot);
        let of_tool = run.is_some_and(|run| run.is_of_tool());
        if of_tool && slot != Urgency::Stop {
            self.schedule.background_owes(Pace::Brisk, end.took);
        }
        if self.waits.sessions.transaction_ended(index, &end.ended) == Progress::Restarted {
            self.restarted(index, now, news);
        }
        let used = end.line_use();
        let reply = match end.ended {
            // The drive ignored the step, which is repeated once the drive is identified.
            Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => {
                self.step_failed(index, slot, &unheard(Session::Identify), &Ended::Silent, used, now);
                return;
            }
            Ended::Reply(reply) if !leaves_open(&reply, step) => reply,
            ended => {
                if matches!(&ended, Ended::Reply(reply) if !says_no_answer(reply)) {
                    self.schedule.seen(index, now);
                }
                self.step_failed(index, slot, step, &ended, used, now);
                self.read_back(index, step, now);
                return;
            }
        };
        self.schedule.seen(index, now);
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        if !matches!(reply, Reply::Exception(_)) {
            let believed = !drive.late.proves_nothing(&step.pdu, end.began, now);
            drive.late.answered(&step.pdu, end.began, now);
            if !believed {
                if let Some(run) = drive.run(slot).filter(|_| step.pdu.is_write()) {
                    run.doubted();
                }
                return;
            }
        }
        if let Some((Table::Holding, items)) = written(&step.pdu)
            && !matches!(reply, Reply::Exception(_))
        {
            image.note_written(&items, now);
        }
        if step.pdu.is_write() && !matches!(reply, Reply::Exception(_)) {
            drive.refresh.ordered(&image.spec.profile, &step.pdu, now);
        }
        let outcome = drive.answered(slot, step, reply, now);
        if let Some(run) = drive.run(slot).filter(|_| end.stood) {
            // The reply lay unread during a stall, so it does not show the drive as it is now.
            run.others_go_first();
        }
        if let Some(outcome) = outcome {
            drive.end(slot, &outcome, image, now);
        }
        self.read_back(index, step, now);
    }

    /// A step got no valid reply. The next stop to a drive that does not answer waits a little, so that repeated
    /// stops do not take the line from the others.
    fn step_failed(
        &mut self,
        index: DriveIndex,
        slot: Urgency,
        step: &Step,
        ended: &Ended,
        used: LineUse,
        now: Instant,
    ) {
        let online = self.schedule.is_online(index);
        let (retries, response_timeout) = (self.retries_of(index), self.response_timeout_of(index));
        // On N2 no poll for reports is sent as long as the acknowledgement of a stop may come late, and no drive is read
        // that is due for such a poll.
        let pauses = if self.waits.sessions.is_empty() {
            Duration::ZERO..=response_timeout
        } else {
            let late = response_timeout + self.n2_window();
            late..=late
        };
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        if *ended == Ended::Corrupt(MAY_BE_LATE) {
            // The step was sent, perhaps without success: it is sent again when its reply can be trusted.
            if let Some(run) = drive.run(slot) {
                run.wait_for_late_replies();
            }
            return;
        }
        let (how, silent) = match ended {
            Ended::Corrupt(CONNECTION_CLOSED) => (Outcome::TimedOut, false),
            Ended::Corrupt(_) => (Outcome::Garbled, false),
            Ended::Reply(reply @ Reply::Exception(code)) if step.pdu.is_write() => {
                (Outcome::Unknown(*code), says_no_answer(reply))
            }
            Ended::Silent | Ended::Reply(_) => (Outcome::TimedOut, true),
        };
        if slot == Urgency::Stop && silent {
            drive.vain_stops.not_answered(used.took);
        }
        let retries = match *ended {
            // The request may never have reached the drive, so the failure shows nothing about the drive.
            Ended::Corrupt(CONNECTION_CLOSED) => retries.max(1),
            // A reply lost during a stall of the thread also earns one more try.
            _ if online => retries.max(u32::from(used.stood)),
            // Even a damaged reply shows that something answers: a stop is tried as often as at a drive that is online.
            Ended::Corrupt(_) if slot == Urgency::Stop => retries,
            // Identify and the stop itself are sent by turns: each needs a try.
            Ended::Silent if slot == Urgency::Stop && self.waits.sessions.waits_for_identify(index) => 1,
            _ => 0,
        };
        let outcome = drive.run(slot).and_then(|run| run.failed(step, how, retries));
        if let Some(outcome) = outcome {
            drive.end(slot, &outcome, image, now);
            if silent {
                drive.vain_stops.in_vain(pauses, now);
                self.schedule.doubted(index);
            }
        }
        if !online && (silent || matches!(ended, Ended::Corrupt(_))) {
            self.schedule.probed_in_vain(index, used.took, now);
        }
    }

    /// Registers were written, or may have been: they are read back soon. If an end of the frequency range is among
    /// them, an earlier reading of the range is invalid, and both ends are read again.
    pub(super) fn note_write(&mut self, index: DriveIndex, table: Table, items: &[(u16, u16)], now: Instant) {
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        let is_end = |address: u16| is_range_end(&image.spec.profile, table, address);
        let range = items.iter().any(|(address, _)| is_end(*address));
        if range {
            drive.written.range = Some(now);
        }
        if items
            .iter()
            .any(|(address, _)| is_reference(&image.spec.profile, table, *address))
        {
            drive.written.reference = Some(now);
        }
        let covers = |read: &PlannedRead| {
            let ends = || (read.start..read.start.saturating_add(read.count)).any(is_end);
            items.iter().any(|(address, _)| read.covers(table, *address)) || (range && read.table == table && ends())
        };
        self.schedule.read_soon(index, covers, now);
    }

    /// Schedules the read-back of written registers.
    fn read_back(&mut self, index: DriveIndex, step: &Step, now: Instant) {
        if let RequestPdu::MaskWrite { address, or_mask, .. } = step.pdu {
            self.note_write(index, Table::Holding, &[(address, or_mask)], now);
        }
        if let Some((table, items)) = written(&step.pdu) {
            self.note_write(index, table, &items, now);
        }
    }
}

/// Whether a gateway in between reports that the drive did not answer.
fn says_no_answer(reply: &Reply) -> bool {
    matches!(reply, Reply::Exception(code) if code.is_no_answer())
}

/// Whether the reply to a step of a command leaves the result open, as if there had been no reply.
fn leaves_open(reply: &Reply, step: &Step) -> bool {
    matches!(reply, Reply::Exception(code) if code.is_no_answer() || (step.pdu.is_write() && code.leaves_open()))
}

/// The session step to send instead of a command's step, because the drive requires it first.
fn unheard(session: Session) -> Step {
    Step {
        purpose: StepPurpose::Execute,
        pdu: RequestPdu::N2(session),
    }
}
