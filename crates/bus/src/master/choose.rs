//! Chooses the next transaction: stops, other commands, forwarded reads, polls, background transactions.

use std::time::{Duration, Instant};

use super::passed_on::{drop_unwanted, is_ready};
use super::permission::{AtTurn, next_need};
use super::{Before, Master, Purpose, Turn};
use crate::command_run::{CommandRun, Step};
use crate::drive_state::{DriveState, NextNeed};
use crate::per_rank::{PerRank, RANKS};
use crate::schedule::{Decision, Poll};
use drivegate_core::order::{Command, DEFAULT_EXPIRY, Interruption, Order, Outcome, StopEnd, Urgency, Work};
use drivegate_core::queue::{Chosen, Ready};
use drivegate_model::drive::{DriveIndex, PerDrive};
use drivegate_proto::RequestPdu;

/// Maximum number of transactions of one rank in a row while a lower rank waits; then the lower one is served.
const IN_A_ROW: u32 = 8;
/// Maximum number of decisions without a transaction before the rest waits for the next call: commands that end without
/// one are answered.
const MOST_DECISIONS: usize = 1000;

/// How often each rank went before waiting lower ones, and queued commands before repetitions of their rank.
#[derive(Debug, Default)]
pub(super) struct Turns {
    in_a_row: PerRank<u32>,
    queued_first: PerRank<u32>,
    chosen: Option<ChosenTurn>,
}

/// The turn of a command that was chosen and is not sent yet. A request that arrives in the silence before the frame may
/// take its place, so the turn counts once it is sent.
#[derive(Debug, Clone, Copy)]
struct ChosenTurn {
    rank: Urgency,
    lower_waits: bool,
    /// Whether the command repeats a step for which its drive was too busy.
    repetition: bool,
}

impl Turns {
    /// Which of the waiting ranks is served next: the highest, unless it had eight transactions in a row.
    fn rank(&self, waits: impl Fn(Urgency) -> bool) -> Option<Urgency> {
        let mut waiting = RANKS.into_iter().filter(|rank| waits(*rank)).peekable();
        while let Some(rank) = waiting.next() {
            if *self.in_a_row.of(rank) < IN_A_ROW || waiting.peek().is_none() {
                return Some(rank);
            }
        }
        None
    }

    /// Whether a queued command begins before a command of its rank that repeats a step for which its drive was too busy.
    /// Busy drives must not keep a stop from other drives, and drives that do not answer must not hold up the repetition for
    /// a busy drive.
    fn begins_before(&mut self, repetition: bool, queued: Chosen) -> bool {
        let first = self.queued_first.of_mut(queued.rank);
        let begins = repetition && *first < if queued.is_last { 1 } else { IN_A_ROW };
        if begins {
            *first += 1;
        }
        begins
    }

    /// Counts the chosen turn of a command: its frame is sent.
    pub(super) fn sent(&mut self) {
        let Some(ChosenTurn {
            rank,
            lower_waits,
            repetition,
        }) = self.chosen.take()
        else {
            return;
        };
        if repetition {
            *self.queued_first.of_mut(rank) = 0;
        }
        for (of, count) in RANKS.into_iter().zip(self.in_a_row.iter_mut()) {
            if of < rank {
                *count = 0;
            } else if of == rank {
                *count = if lower_waits { *count + 1 } else { 0 };
            }
        }
    }
}

/// A step of a started command that can go.
struct NextStep {
    drive: DriveIndex,
    slot: Urgency,
    rank: Urgency,
    step: Step,
    /// Since when a repetition is due for a drive that was busy.
    repeats_since: Option<Instant>,
}

/// What all started commands need at one time.
#[derive(Default)]
struct Commands {
    /// Next steps of commands by rank.
    ready: PerRank<Option<NextStep>>,
    queued: PerRank<Option<Chosen>>,
    /// When further commands may be sent.
    wake_at: Option<Instant>,
}

impl Commands {
    fn wait(&mut self, until: Instant) {
        self.wake_at = Some(self.wake_at.map_or(until, |at| at.min(until)));
    }

    fn waits(&self, rank: Urgency) -> bool {
        self.ready.of(rank).is_some() || self.queued.of(rank).is_some()
    }
}

/// Result of one decision.
enum Decided {
    /// The request for the line.
    Send(Turn),
    /// Nothing is to be done before this time.
    Wait(Instant),
    /// The conditions for the next decision have changed.
    Again,
}

impl From<Option<Turn>> for Decided {
    fn from(turn: Option<Turn>) -> Decided {
        turn.map_or(Decided::Again, Decided::Send)
    }
}

impl Master {
    /// Makes decisions until there is a request for the line, or nothing to do.
    ///
    /// # Errors
    /// If nothing is to be done yet: the time of the next thing to do, after `now`.
    pub(super) fn choose(&mut self, now: Instant) -> Result<Turn, Instant> {
        let soon = now + Duration::from_millis(1);
        for _ in 0..MOST_DECISIONS {
            match self.decide(now) {
                Decided::Send(turn) => return Ok(turn),
                Decided::Wait(until) => return Err(until.max(soon)),
                Decided::Again => {}
            }
        }
        Err(soon)
    }

    /// Makes one decision.
    fn decide(&mut self, now: Instant) -> Decided {
        self.turns.chosen = None;
        self.purge(now);
        let quiet = self.bus.queue.quiet(now);
        if quiet != self.waits.quiet {
            self.waits.quiet = quiet;
            self.schedule.keep_quiet(quiet);
        }
        if self.shutdown.is_none()
            && let Some(turn) = self.broadcast_stop(now)
        {
            return Decided::Send(turn);
        }
        if self.shutdown.is_none()
            && let Some(turn) = self.owed_refresh(now)
        {
            return Decided::Send(turn);
        }
        let mut commands = self.commands(now);
        if self.shutdown.is_none()
            && !commands.waits(Urgency::Stop)
            && let Some(ready) = self.checked_write(now)
        {
            self.turns.chosen = Some(ChosenTurn {
                rank: Urgency::Command,
                lower_waits: commands.waits(Urgency::Read),
                repetition: false,
            });
            return Decided::Send(self.turn(ready, now));
        }
        if !commands.waits(Urgency::Stop)
            && let Some(turn) = self.refresh_goes_on(now)
        {
            return Decided::Send(turn);
        }
        let highest = RANKS.into_iter().find(|rank| commands.waits(*rank));
        let rank = highest.and_then(|_| self.turns.rank(|rank| commands.waits(rank)));
        if self.polls_cease() {
            if !self.stops_the_line() {
                self.abandon_background(Outcome::ShuttingDown, Interruption::ShuttingDown, now);
            }
            return match rank {
                Some(rank) => self.command(rank, &mut commands, now),
                // The broadcast that stops the whole line goes before the single stops, which wait for it.
                None => match self.stop_the_line(now) {
                    Ok(turn) => Decided::Send(turn),
                    Err(_) => Decided::Wait(commands.wake_at.unwrap_or(now + super::LOOK_ROUND)),
                },
            };
        }
        match self.schedule.next_of(now, rank, highest) {
            // A stop waits for one poll at most, and for nothing else.
            Decision::Poll(poll) if highest == Some(Urgency::Stop) => self.poll(poll, now),
            Decision::Poll(poll) => match self
                .refresh(false, now)
                .ok_or(())
                .or_else(|()| self.background(false, now))
            {
                Ok(turn) => Decided::Send(turn),
                Err(_) => self.poll(poll, now),
            },
            Decision::Idle(until) => {
                let turn = self.refresh(true, now).ok_or(());
                match turn.or_else(|()| self.background(true, now)) {
                    Ok(turn) => Decided::Send(turn),
                    Err(again) => {
                        let wake = commands.wake_at.into_iter().chain(again).chain(self.next_refresh(now));
                        Decided::Wait(wake.fold(until, Instant::min))
                    }
                }
            }
            Decision::Command(rank) => self.command(rank, &mut commands, now),
        }
    }

    /// The write of a parameter to a drive that has just reported that its motor is at standstill: only a stop may come
    /// between the two.
    fn checked_write(&mut self, now: Instant) -> Option<NextStep> {
        let (slot, rank) = (Urgency::Command, Urgency::Command);
        let Master { drives, bus, waits, .. } = self;
        let is_checked = |drive: &mut DriveState| drive.run(slot).is_some_and(CommandRun::is_checked);
        let (drive, state) = drives
            .enumerate_mut()
            .find_map(|(index, drive)| is_checked(drive).then_some((index, drive)))?;
        let image = bus.image.drives.of(drive);
        let want = |state: &mut DriveState| state.next_need(image, &waits.n2_late, now);
        match next_need(bus, drive, state, image, want, now) {
            NextNeed::Step(Urgency::Command, step)
                if step.pdu.is_write() && waits.sessions.before(drive, Some(slot), now).is_none() =>
            {
                Some(NextStep {
                    drive,
                    slot,
                    rank,
                    step,
                    repeats_since: None,
                })
            }
            _ => None,
        }
    }

    /// Ends the started commands of a drive after a stop.
    fn purge(&mut self, now: Instant) {
        let mut queue = self.bus.queue.lock();
        let stopped = queue.take_stopped();
        let stopped: Vec<(DriveIndex, bool)> = stopped
            .into_iter()
            .map(|index| (index, queue.stop_waits(index, now).is_some()))
            .collect();
        drop(queue);
        for (index, is_delayed) in stopped {
            let image = self.bus.image.drives.of(index);
            self.drives.of_mut(index).purge(image, is_delayed, now);
        }
    }

    fn commands(&mut self, now: Instant) -> Commands {
        let mut commands = Commands::default();
        let Master { drives, bus, waits, .. } = self;
        for ((index, drive), image) in drives.enumerate_mut().zip(&bus.image.drives) {
            if !drive.has_runs() {
                continue;
            }
            let want = |drive: &mut DriveState| drive.next_need(image, &waits.n2_late, now);
            match next_need(bus, index, drive, image, want, now) {
                NextNeed::Step(slot, step) => {
                    // Late replies can block the session step that N2 needs first, as they block the step itself.
                    let before = waits.sessions.before(index, Some(slot), now).map(RequestPdu::N2);
                    let blocked = before.and_then(|before| waits.n2_late.blocks(&before, now));
                    let waits = drive.run(slot).is_some_and(|run| run.waits_for_late());
                    if let Some(until) = blocked.filter(|_| waits) {
                        commands.wait(until);
                        continue;
                    }
                    let rank = drive.run(slot).map_or(slot, |run| run.rank);
                    let repeats_since = drive.run(slot).and_then(|run| run.repeats_since());
                    let place = commands.ready.of_mut(rank);
                    if place.as_ref().is_none_or(|other| repeats_since < other.repeats_since) {
                        *place = Some(NextStep {
                            drive: index,
                            slot,
                            rank,
                            step,
                            repeats_since,
                        });
                    }
                }
                NextNeed::Wait(until) => commands.wait(until),
                NextNeed::Nothing => {}
            }
        }
        self.queued(&mut commands, now);
        commands
    }

    /// The queued commands that can be started, the next one of each rank.
    fn queued(&mut self, commands: &mut Commands, now: Instant) {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        if pending.is_empty() {
            return;
        }
        let Master {
            drives,
            schedule,
            bus,
            waits,
            ..
        } = self;
        drop_unwanted(&mut pending, now);
        let stands: PerDrive<bool> = drives
            .iter()
            .zip(&bus.image.drives)
            .map(|(drive, image)| drive.was_stopped() && drive.stands_by_stop(&image.reading(now, drive.fresh)))
            .collect();
        let redundant = |drive: DriveIndex| *stands.of(drive);
        let facts = AtTurn::of(drives, &bus.image.drives, now);
        for rank in RANKS {
            let ready = |command: &Command| is_ready(command, schedule, waits, drives, &bus.image.drives, now);
            let choice = pending.next(rank, now, &facts, ready, redundant);
            *commands.queued.of_mut(rank) = choice.chosen;
            if let Some(until) = choice.wake_at {
                commands.wait(until);
            }
        }
    }

    /// Serves a command of this rank: a started one, or the next one of the queue, which is then started.
    fn command(&mut self, rank: Urgency, commands: &mut Commands, now: Instant) -> Decided {
        let lower_waits = RANKS.into_iter().any(|lower| lower > rank && commands.waits(lower));
        let ready = commands.ready.of_mut(rank).take();
        let queued = *commands.queued.of(rank);
        let repetition = ready.as_ref().is_some_and(|ready| ready.repeats_since.is_some());
        let counted = ChosenTurn {
            rank,
            lower_waits,
            repetition,
        };
        let begins = |turns: &mut Turns| queued.is_some_and(|queued| turns.begins_before(repetition, queued));
        if let Some(ready) = ready.filter(|_| !begins(&mut self.turns)) {
            self.turns.chosen = Some(counted);
            return Decided::Send(self.turn(ready, now));
        }
        let Some(chosen) = queued else {
            return Decided::Again;
        };
        let Some(command) = self.bus.queue.lock().take(chosen) else {
            return Decided::Again;
        };
        if command.as_passed_on().is_some() {
            self.turns.chosen = Some(ChosenTurn {
                repetition: false,
                ..counted
            });
            return self.begin_passed_on(command, None, now).into();
        }
        self.begin(command, chosen.rank, now);
        // The started commands are judged again: one may wait, or another may be sent first.
        Decided::Again
    }

    /// Begins a command from the queue. A stop is sent even to a drive that does not answer: it serves as the probe.
    fn begin(&mut self, mut command: Command, rank: Urgency, now: Instant) {
        let is_served = |index: &DriveIndex| self.schedule.is_online(*index) || command.is_stop();
        let Some(index) = command.drive().filter(is_served) else {
            command.answer(&Outcome::Offline, now);
            return;
        };
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        if let Work::Set(set) = &command.work
            && set.behind.as_ref().is_some_and(StopEnd::has_failed)
        {
            command.answer(&Outcome::NotStopped, now);
            return;
        }
        if command.is_stop() {
            begin_time(&mut command, now);
            drive.stop_goes_first();
        }
        let starts = self.waits.starts.as_ref();
        let start = starts.and_then(|starts| starts.start_of(&command.intent, command.ticket.origin(), index));
        let renews = self.bus.renews_by(&command);
        if !matches!(rank, Urgency::Read) {
            drive.refresh.order_begins(self.bus.queue.lock().gate.stops(index));
        }
        let mut run = CommandRun::new(command, &image.spec.profile);
        (run.rank, run.renews, run.start) = (rank, renews, start);
        drive.begin(run);
    }

    fn turn(&mut self, ready: NextStep, now: Instant) -> Turn {
        let NextStep {
            drive,
            slot,
            rank,
            step,
            ..
        } = ready;
        match self.waits.sessions.before(drive, Some(slot), now) {
            Some(session) => Turn {
                purpose: Purpose::Session(drive, session, Before::Command(slot, rank)),
                pdu: RequestPdu::N2(session),
            },
            None => Turn {
                purpose: Purpose::Command {
                    drive,
                    slot,
                    rank,
                    step: step.purpose,
                },
                pdu: step.pdu,
            },
        }
    }

    fn poll(&mut self, poll: Poll, now: Instant) -> Decided {
        let pdu = poll.read.pdu();
        let drive = self.drives.of_mut(poll.drive);
        let session = self.waits.sessions.before(poll.drive, None, now);
        let address = self.bus.image.drives.of(poll.drive).spec.address;
        let on_n2 = match session {
            Some(session) => self.waits.n2_late.blocks(&RequestPdu::N2(session), now),
            None => self.waits.n2_late.blocks_poll(address, &poll.read, now),
        };
        if let Some(until) = drive.late.blocks(&pdu, now).max(on_n2) {
            self.schedule.postpone(&poll, until);
            return Decided::Again;
        }
        let turn = match session {
            Some(session) => Turn {
                purpose: Purpose::Session(poll.drive, session, Before::Poll(poll)),
                pdu: RequestPdu::N2(session),
            },
            None => Turn {
                purpose: Purpose::Poll(poll),
                pdu,
            },
        };
        Decided::Send(turn)
    }

    /// Whether a turn chosen earlier may still be sent at `now`: the time of its command has not expired.
    pub(crate) fn is_still_due(&mut self, turn: &Turn, now: Instant) -> bool {
        let (drive, slot) = match turn.purpose {
            Purpose::Background(_) => return self.background_is_due(now),
            Purpose::Refresh(drive) => return self.may_still_refresh(drive, now),
            Purpose::Poll(_) | Purpose::Session(_, _, Before::Poll(_)) => return true,
            Purpose::Command { drive, slot, .. } | Purpose::Session(drive, _, Before::Command(slot, _)) => {
                (drive, slot)
            }
        };
        if !self.may_still_write(drive, slot, now) {
            return false;
        }
        let Some(run) = self.run_in_time(drive, slot, now) else {
            return false;
        };
        let is_action = run.is_of_supervision() && run.is_owed();
        !(is_action && self.client_is_back(drive, now))
    }

    /// The command in progress, unless it expired while the bus waited for silence on the line.
    fn run_in_time(&mut self, drive: DriveIndex, slot: Urgency, now: Instant) -> Option<&mut CommandRun> {
        let run = self.drives.of_mut(drive).run(slot);
        run.filter(|run| !run.is_late(now))
    }

    /// Whether a client came back while the line went silent, which suspends the action of its lease. An order that waits
    /// longer than its time, as a stop may, holds no lease: supervision would choose its action again without end.
    fn client_is_back(&self, drive: DriveIndex, now: Instant) -> bool {
        let until = self.bus.queue.lock().client_waits_until(drive);
        self.bus.image.drives.of(drive).has_heartbeat() || until.is_some_and(|until| until > now)
    }

    /// Whether the gateway stops: the line belongs to the stops then.
    fn polls_cease(&self) -> bool {
        self.shutdown.is_some()
    }
}

/// Starts the time limit of a stop when the stop itself starts, however long it waited.
fn begin_time(stop: &mut Command, now: Instant) {
    let window = &mut stop.intent.window;
    window.expires = window.expires.max(now + DEFAULT_EXPIRY);
}

/// Whether a command must wait because a stop of its drive is in progress.
fn waits_for_stop(drive: &DriveState, command: &Command) -> bool {
    command.urgency() == Urgency::Command && drive.is_busy(Urgency::Stop)
}

/// Whether the drive of a queued command is ready for it.
pub(super) fn may_begin(drive: &mut DriveState, command: &Command, online: bool, now: Instant) -> Ready {
    let urgency = command.urgency();
    if drive.is_busy(urgency) || waits_for_stop(drive, command) {
        return Ready::No;
    }
    if urgency == Urgency::Stop {
        let ready = if online { Ready::Now } else { Ready::Last };
        return drive.vain_stops.waits_until(now).map_or(ready, Ready::At);
    }
    // A command to an offline drive is answered at once.
    if let Order::Read(pdu) | Order::Write(pdu) = &command.intent.order
        && online
        && let Some(until) = drive.late.blocks(pdu, now)
    {
        return Ready::At(until);
    }
    Ready::Now
}
