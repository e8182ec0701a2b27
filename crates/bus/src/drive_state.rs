//! The master's state of one drive, except its image, polls and N2 session.

use std::time::{Duration, Instant};

use super::command_run::{CommandRun, KnownWords, Need, Next, Step, read_place};
use super::confirm::Confirmations;
use super::late_replies::LateReplies;
use super::n2_late_replies::N2LateReplies;
use super::per_rank::PerRank;
use super::refresh::{End, OrderEnd, Refresh};
use super::repeated_stops::RepeatedStops;
use super::supervision::Supervision;
use super::unanswered_stops::VainStops;
use drivegate_core::order::{Command, Interruption, Order, Origin, Outcome, Urgency};
use drivegate_core::permit::LastWritten;
use drivegate_core::process_image::{Access, DriveImage, DriveSpec, Reading};
use drivegate_model::drive::control::Control;
use drivegate_model::drive::{DriveIndex, ModelPoint, Point, Profile};
use drivegate_proto::{Reply, Table};

/// A status older than this, or than three rounds of the line, does not show whether the motor runs.
pub(super) const FRESH: Duration = Duration::from_secs(2);

#[derive(Debug)]
pub(super) struct DriveState {
    /// A status older than that does not show whether the motor runs.
    pub(super) fresh: Duration,
    /// Known command words of the drive.
    pub(super) words: KnownWords,
    /// Registers that orders write, and the register of the command word if the drive reports its own word: these
    /// are learned from every read.
    pub(super) commanded: Vec<(Table, u16)>,
    /// Replies that the drive may still send.
    pub(super) late: LateReplies,
    pub(super) repeated_stops: RepeatedStops,
    /// Lease and supervision of the drive.
    pub(super) supervision: Supervision,
    /// Refresh of orders for the drive's own timeout.
    pub(super) refresh: Refresh,
    /// Why the refresh ended; `None` after that was reported.
    pub(super) refresh_ended: Option<End>,
    /// Commands that the drive acknowledged but whose effect it has not shown yet.
    pub(super) confirmations: Confirmations,
    /// Started commands, one of each rank, so that commands of a rank keep their order.
    runs: PerRank<Option<CommandRun>>,
    /// When a stop was acknowledged after which nothing was sent but references and more stops, acknowledged too.
    stopped: Option<Instant>,
    /// Stops that the drive left without a reply.
    pub(super) vain_stops: VainStops,
    /// Duration of the longest recent transaction.
    pub(super) answers_within: Duration,
    /// Whether the drive was read since its confirmations were checked.
    pub(super) was_read: bool,
    /// When reference, and an end of the frequency range, were last written, whether or not the drive accepted it.
    pub(super) written: LastWritten,
    /// A start (true) or a stop was acknowledged, and the guards have not been informed yet.
    pub(super) acknowledged: Option<bool>,
    /// Whether `[authority]` is on: the senders of executed commands are then recorded, and whether these were stops.
    pub(super) has_authority: bool,
    pub(super) carried_out: Vec<(Origin, bool)>,
    /// Whether the drive is under local control; `None` while that is unknown.
    pub(super) local: Option<bool>,
}

/// Next need of the started commands of a drive.
#[derive(Debug)]
pub(super) enum NextNeed {
    /// A step of the command of that rank.
    Step(Urgency, Step),
    /// Nothing is sent before this time.
    Wait(Instant),
    Nothing,
}

fn commanded(profile: &Profile) -> Vec<(Table, u16)> {
    let written = profile.points.iter().filter(|point| point.write);
    let written = written.filter_map(Point::raw);
    let written = written.flat_map(|raw| raw.addresses().map(|address| (raw.table, address)));
    let word = read_place(profile).map(|place| (place.table, place.address));
    written.chain(word).collect()
}

/// How often what was ordered is written again: never to a drive that is only monitored, nor without a lease, which ends that
/// when the client falls silent.
fn refresh_of(spec: &DriveSpec) -> Option<Duration> {
    spec.refresh
        .filter(|_| spec.access == Access::Control && spec.supervision.is_some())
}

impl DriveState {
    /// State of a drive about which nothing is known yet; its status is read at most every `round`.
    pub(super) fn new(spec: &DriveSpec, round: Duration) -> DriveState {
        let profile = &spec.profile;
        DriveState {
            fresh: FRESH.max(3 * round),
            words: KnownWords::default(),
            commanded: commanded(profile),
            late: LateReplies::default(),
            repeated_stops: RepeatedStops::default(),
            supervision: Supervision::default(),
            refresh: Refresh::new(profile, refresh_of(spec)),
            refresh_ended: None,
            confirmations: Confirmations::default(),
            runs: PerRank::default(),
            stopped: None,
            vain_stops: VainStops::default(),
            answers_within: Duration::ZERO,
            was_read: false,
            written: LastWritten::default(),
            acknowledged: None,
            has_authority: false,
            carried_out: Vec::new(),
            local: None,
        }
    }

    /// The drive replied, in a transaction that took the line for `took`.
    pub(super) fn exchanged(&mut self, took: Duration) {
        self.vain_stops.answered();
        self.answers_within = took.max(self.answers_within - self.answers_within / 64);
    }

    /// The started command of this rank.
    pub(super) fn run(&mut self, urgency: Urgency) -> Option<&mut CommandRun> {
        self.runs.of_mut(urgency).as_mut()
    }

    /// Whether a command of that rank has started.
    pub(super) fn is_busy(&self, urgency: Urgency) -> bool {
        self.runs.of(urgency).is_some()
    }

    /// Whether a command has begun to start the motor of this drive, perhaps by a sequence of words; not the stop that follows
    /// a start that failed.
    pub(super) fn is_starting(&self, index: DriveIndex) -> bool {
        let run = self.runs.command.as_ref();
        run.is_some_and(|run| run.has_begun() && run.may_write_on() && run.intent().effects.on(index).starts())
    }

    /// Whether any command has started.
    pub(super) fn has_runs(&self) -> bool {
        self.runs.iter().any(Option::is_some)
    }

    pub(super) fn begin(&mut self, run: CommandRun) {
        let place = self.runs.of_mut(run.urgency());
        *place = Some(run);
    }

    /// Time until which a started client command holds the lease.
    pub(super) fn client_holds_until(&self) -> Option<Instant> {
        let of_client = self.runs.iter().flatten().filter(|run| run.is_heard());
        of_client.map(CommandRun::expires).max()
    }

    /// The next need of the started commands at `now`, highest rank first. Commands that have ended get their result.
    pub(super) fn next_need(&mut self, image: &DriveImage, n2_late: &N2LateReplies, now: Instant) -> Need<NextNeed> {
        let reading = image.reading(now, self.fresh);
        let profile = &image.spec.profile;
        self.words.see_turning(turning(&reading));
        let mut wake_at: Option<Instant> = None;
        let mut wait = |until: Instant| wake_at = Some(wake_at.map_or(until, |at: Instant| at.min(until)));
        let mut order = [Urgency::Stop, Urgency::Command, Urgency::Read];
        if self.pulse_is_put_off() {
            order.swap(0, 1);
        }
        for urgency in order {
            loop {
                // The motor state of a faulted drive may be from before the fault; the drive then does not run by
                // its run command.
                let running = reading.is_set(ModelPoint::Running) && !reading.is_set(ModelPoint::Fault);
                let Some(run) = self.runs.of_mut(urgency) else {
                    break;
                };
                let next = match run.need(&self.words, profile, running, now) {
                    Need::Next(next) => next,
                    Need::Judge(repeats) => return Need::Judge(repeats),
                };
                match next {
                    Next::Send(step) => {
                        // A stop does not wait for late replies: it is sent at once.
                        let blocked = self.late.blocks(&step.pdu, now).max(n2_late.blocks(&step.pdu, now));
                        if let Some(until) = blocked.filter(|_| run.waits_for_late()) {
                            run.hold_up();
                            wait(until.min(run.expires().max(now + Duration::from_millis(1))));
                            break;
                        }
                        if !run.asks_again() {
                            return Need::Next(NextNeed::Step(urgency, step));
                        }
                    }
                    Next::Wait(until) => {
                        wait(until);
                        break;
                    }
                    Next::Done => {
                        let outcome = run.success();
                        self.end(urgency, &outcome, image, now);
                        break;
                    }
                }
            }
        }
        Need::Next(wake_at.map_or(NextNeed::Nothing, NextNeed::Wait))
    }

    /// Whether stops were sent repeatedly before the end of a pulse, and the next stop is not on the wire yet.
    fn pulse_is_put_off(&self) -> bool {
        let PerRank { stop, command, .. } = &self.runs;
        let waits = command.as_ref().is_some_and(CommandRun::is_deferred);
        waits && !stop.as_ref().is_some_and(CommandRun::reached_the_wire)
    }

    /// The drive replied to a step of a started command. Returns the outcome when the command has ended.
    pub(super) fn answered(&mut self, urgency: Urgency, step: &Step, reply: Reply, now: Instant) -> Option<Outcome> {
        self.words.advance_to(now);
        let run = self.runs.of_mut(urgency).as_mut()?;
        run.answered(step, reply, &mut self.words)
    }

    /// Ends a started command with its outcome.
    pub(super) fn end(&mut self, urgency: Urgency, outcome: &Outcome, image: &DriveImage, now: Instant) {
        let Some(run) = self.runs.of_mut(urgency).take() else {
            return;
        };
        if run.in_doubt() {
            self.forget_words();
        }
        self.refresh_after(&run, outcome, image, now);
        if run.is_heard() && run.reached_the_wire() {
            self.supervision.renew(now);
        }
        if self.has_authority && outcome.is_ok() {
            let is_stop = urgency == Urgency::Stop;
            self.carried_out
                .extend(run.origins().map(|origin| (origin.clone(), is_stop)));
        }
        if urgency == Urgency::Stop && run.has_begun() {
            // Repeated stops must not reset the time of the first.
            self.stopped = outcome.is_ok().then(|| self.stopped.unwrap_or(now));
        }
        if urgency == Urgency::Stop
            && let Some(overtaken) = self.run(Urgency::Command)
        {
            overtaken.overtaken();
        }
        if outcome.is_ok() {
            match urgency {
                Urgency::Stop => self.acknowledged = Some(false),
                Urgency::Command if run.start.is_some() => self.acknowledged = Some(true),
                Urgency::Command | Urgency::Read => {}
            }
            run.note_direction(&mut self.words);
            let (effects, receipts) = run.acknowledge(outcome, now);
            self.confirmations
                .watch(effects, receipts, &image.reading(now, self.fresh), now);
        } else {
            run.finish(outcome, now);
        }
    }

    /// Updates the refresh when a command has ended.
    fn refresh_after(&mut self, run: &CommandRun, outcome: &Outcome, image: &DriveImage, now: Instant) {
        let is_command = matches!(run.intent().order, Order::Points(_) | Order::Write(_));
        if !is_command || !run.has_begun() {
            return;
        }
        let is_drill = run.origins().any(Origin::is_drill);
        let how = match outcome {
            outcome if outcome.is_ok() && run.is_of_client() && is_drill => OrderEnd::Drill,
            outcome if outcome.is_ok() && run.is_of_client() => OrderEnd::Done,
            outcome if outcome.is_ok() && run.is_of_supervision() && run.urgency() == Urgency::Command => {
                OrderEnd::Action
            }
            outcome if outcome.is_ok() => OrderEnd::Other,
            Outcome::Exception(_) | Outcome::Refused(_) | Outcome::Expired if !run.in_doubt() => OrderEnd::Partly,
            Outcome::Interrupted(Interruption::Expired) if !run.in_doubt() => OrderEnd::Partly,
            _ => OrderEnd::Unknown,
        };
        let held = self.supervision.is_held();
        let ended = self.refresh.order_over(&image.spec.profile, how, held, now);
        self.refresh_ended = ended.or(self.refresh_ended.take());
    }

    /// Ends a refresh in progress for this reason.
    pub(super) fn end_refresh(&mut self, why: End) {
        let ended = self.refresh.end(why);
        self.refresh_ended = ended.or(self.refresh_ended.take());
    }

    /// A step of a started command is sent.
    pub(super) fn sent(&mut self, urgency: Urgency, step: &Step, now: Instant) {
        let Some(run) = self.runs.of_mut(urgency) else {
            return;
        };
        run.sent(step);
        if step.pdu.is_write() && urgency != Urgency::Stop && !run.is_reference_only() {
            self.stopped = None;
        }
        if run.is_heard() {
            self.supervision.renew(now);
        }
    }

    /// The drive received a command that is not a started one: a broadcast, or one that is not decoded.
    pub(super) fn foreign_order(&mut self, renews: bool, now: Instant) {
        self.end_refresh(End::Passed);
        self.stopped = None;
        if renews {
            self.supervision.renew(now);
        }
    }

    /// Whether a stop was acknowledged after which no command was sent that is neither stop nor reference.
    pub(super) fn was_stopped(&self) -> bool {
        self.stopped.is_some()
    }

    /// Whether a further stop is redundant: the drive acknowledged one, a later sample shows the motor stopped, and
    /// no command in progress may start it.
    pub(super) fn stands_by_stop(&self, reading: &Reading<'_>) -> bool {
        let begun = self.runs.command.as_ref();
        let running = reading.model(ModelPoint::Running);
        let stands = running.good().is_some_and(|running| !running.as_bool());
        begun.is_none_or(CommandRun::is_reference_only)
            && stands
            && self
                .stopped
                .is_some_and(|stopped| running.at.is_some_and(|at| at > stopped))
    }

    /// Sends a stop before the rest of a command in progress.
    pub(super) fn stop_goes_first(&mut self) {
        if let Some(run) = self.run(Urgency::Command) {
            run.note_stop_sent_first();
        }
    }

    /// A stop arrived, which `min_run` delays or not: started commands end, except clearing a reset bit that is set.
    pub(super) fn purge(&mut self, image: &DriveImage, is_delayed: bool, now: Instant) {
        if !is_delayed {
            self.stop_goes_first();
        }
        let outcome = self.run(Urgency::Command).and_then(CommandRun::purge);
        if let Some(outcome) = outcome {
            self.end(Urgency::Command, &outcome, image, now);
        }
    }

    /// Withdraws a supervision action that was started but not sent: a client commands the drive again.
    pub(super) fn withdraw_supervision(&mut self, now: Instant) {
        for run in self.runs.iter_mut() {
            if let Some(run) = run.take_if(|run| run.is_of_supervision() && run.is_owed()) {
                let outcome = run.taken_back();
                run.finish(&outcome, now);
            }
        }
    }

    /// Forgets the words after an unanswered stop, so that a bit written for another command does not restore what
    /// the stop took away.
    fn forget_words(&mut self) {
        self.words.forget();
    }

    /// The drive no longer replies. A stop is retried; other started commands have failed.
    pub(super) fn went_offline(&mut self, now: Instant) {
        self.refresh.not_answered(now);
        self.words.forget();
        self.stopped = None;
        for urgency in [Urgency::Command, Urgency::Read] {
            if let Some(run) = self.runs.of_mut(urgency).take() {
                self.abandon(run, Outcome::Offline, Interruption::Offline, now);
            }
        }
    }

    /// Ends a started command without its last reply. What a refresh repeats may no longer be what the drive has.
    fn abandon(&mut self, run: CommandRun, unbegun: Outcome, why: Interruption, now: Instant) {
        if run.is_heard() && run.reached_the_wire() {
            self.supervision.renew(now);
        }
        let is_command = matches!(run.intent().order, Order::Points(_) | Order::Write(_));
        if is_command && run.has_begun() {
            self.end_refresh(End::Unknown);
        }
        run.abandon(unbegun, why, now);
    }

    /// Notes that the drive may or may not have received these words.
    pub(super) fn may_have_taken(&mut self, table: Table, items: &[(u16, u16)], control: Option<&Control>) {
        self.words.in_doubt(table, items, control);
        self.stopped = None;
    }

    /// The drive has restarted, so everything known about it is invalid.
    pub(super) fn restarted(&mut self) {
        self.end_refresh(End::Restart);
        self.words.forget();
        self.stopped = None;
    }

    /// Whether a stop was started and is not over.
    pub(super) fn is_stopping(&self) -> bool {
        self.runs.iter().flatten().any(|run| run.urgency() == Urgency::Stop)
    }

    /// A client's started stop, for the bus that replaces this one.
    pub(super) fn take_stop(&mut self, now: Instant) -> Option<Command> {
        let run = self.runs.stop.take()?;
        if run.is_heard() && run.reached_the_wire() {
            self.supervision.renew(now);
        }
        match run.into_stop() {
            Ok(stop) => Some(stop),
            Err(run) => {
                self.begin(*run);
                None
            }
        }
    }

    /// Ends all started commands; acknowledged ones stay acknowledged.
    pub(super) fn close(&mut self, unbegun: &Outcome, why: Interruption, now: Instant) {
        let PerRank { stop, command, read } = std::mem::take(&mut self.runs);
        for run in [stop, command, read].into_iter().flatten() {
            self.abandon(run, unbegun.clone(), why, now);
        }
        self.confirmations.clear();
        self.words.forget();
        self.stopped = None;
        self.vain_stops.answered();
        self.supervision.settle(now);
    }
}

/// The direction in which the motor turns by its command: `true` if reverse, apart from the sign of the reference; `None` if
/// it stands, runs from its panel, or the drive does not show that.
fn turning(reading: &Reading<'_>) -> Option<bool> {
    let good = |point: ModelPoint| reading.model(point).good();
    let has = |point: ModelPoint| reading.spec.profile.model_index(point);
    let is_local = has(ModelPoint::Remote).is_some() && !reading.is_set(ModelPoint::Remote);
    if is_local || !reading.is_set(ModelPoint::Running) {
        return None;
    }
    let reversed = good(ModelPoint::Reversed)?.as_bool();
    let is_signed = |index| {
        reading
            .spec
            .profile
            .points
            .get(index)?
            .range
            .as_ref()
            .map(|range| *range.start() < 0.0)
    };
    match has(ModelPoint::SpeedReference).and_then(is_signed) {
        Some(true) => Some(reversed != (good(ModelPoint::SpeedReference)?.as_f64() < 0.0)),
        Some(false) | None => Some(reversed),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    /// Danfoss: status 50199 (bit 11 running, 9 not at its panel), actual value 50209 and reference 50009 with a sign.
    #[test]
    fn the_direction_of_a_command_is_seen_apart_from_the_sign_of_the_reference() {
        let (runs, at_panel, stands) = (0x0A07, 0x0807, 0x0207);
        for (status, actual, reference, expected) in [
            (runs, 0x2000, Some(0x2000), Some(false)),
            (runs, -0x2000, Some(0x2000), Some(true)),
            (runs, -0x2000, Some(-0x2000), Some(false)),
            (runs, 0x2000, Some(-0x2000), Some(true)),
            (runs, -0x2000, None, None),
            (at_panel, -0x2000, Some(0x2000), None),
            (stands, -0x2000, Some(0x2000), None),
        ] {
            let profile = drivegate_testkit::profile("danfoss-fc");
            let image = drivegate_testkit::image(drivegate_testkit::controlled("d", "b", 1, &profile));
            drivegate_testkit::online(&image);
            let now = Instant::now();
            let store = |address: u16, word: i16| {
                image.update(|s| s.store(Table::Holding, address, &[word as u16], now));
            };
            store(50199, status);
            store(50209, actual);
            if let Some(reference) = reference {
                store(50009, reference);
            }
            let seen = turning(&image.reading(now, Duration::from_secs(1)));
            assert_eq!(seen, expected, "{status:04X} {actual} {reference:?}");
        }
    }
}
