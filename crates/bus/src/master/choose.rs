//! Chooses the next transaction: stops, other commands, forwarded reads, polls, background transactions.

use std::time::{Duration, Instant};

use super::passed_on::{drop_in_vain, may_go};
use super::{Before, Master, Purpose, Turn};
use crate::codec::RequestPdu;
use crate::command::{
    Chosen, Command, DEFAULT_EXPIRY, FrequencyRange, Interruption, Order, Origin, Outcome, Refusal, StopEnd, Urgency,
    still_keeps_limits,
};
use crate::command_run::{CommandRun, Step};
use crate::drive::{DriveIndex, PerDrive};
use crate::drive_state::{DriveState, Wanted};
use crate::permit::Moment;
use crate::permit::rules::client_access;
use crate::schedule::{Decision, Poll};

/// Transactions of one rank in a row, while a lower one waits, before that has its turn.
const IN_A_ROW: u32 = 8;
/// Decisions without a transaction before the rest waits for the next look: commands that end without one are answered.
const MOST_DECISIONS: usize = 1000;

/// How old a frequency range may be on which a command rests that has started. Whether it was too old for the command
/// was decided when that was admitted.
const RANGE_AGE: Duration = Duration::from_secs(60);

/// The ranks, the highest first.
const RANKS: [Urgency; 3] = [Urgency::Stop, Urgency::Command, Urgency::Read];

/// How often ranks went before lower ones that waited.
#[derive(Debug, Default)]
pub(super) struct Turns([u32; 3]);

impl Turns {
    /// Which of the ranks that wait has its turn: the highest, unless it had eight in a row.
    fn rank(&self, waits: impl Fn(Urgency) -> bool) -> Option<Urgency> {
        let mut waiting = RANKS.into_iter().filter(|rank| waits(*rank)).peekable();
        while let Some(rank) = waiting.next() {
            let often = self.0.get(rank as usize).copied().unwrap_or(0);
            if often < IN_A_ROW || waiting.peek().is_none() {
                return Some(rank);
            }
        }
        None
    }

    /// That rank has its turn, before lower ones or not.
    fn served(&mut self, rank: Urgency, lower_waits: bool) {
        for (of, count) in RANKS.into_iter().zip(&mut self.0) {
            if of < rank {
                *count = 0;
            } else if of == rank {
                *count = if lower_waits { *count + 1 } else { 0 };
            }
        }
    }
}

/// A step of a started command that can go.
struct Ready {
    drive: DriveIndex,
    slot: Urgency,
    rank: Urgency,
    step: Step,
}

/// All that commands want at one time.
#[derive(Default)]
struct Commands {
    /// By rank.
    ready: [Option<Ready>; 3],
    queued: [Option<Chosen>; 3],
    /// When more of them may go.
    wake_at: Option<Instant>,
}

impl Commands {
    fn wait(&mut self, until: Instant) {
        self.wake_at = Some(self.wake_at.map_or(until, |at| at.min(until)));
    }

    fn waits(&self, rank: Urgency) -> bool {
        let index = rank as usize;
        self.ready.get(index).is_some_and(Option::is_some) || self.queued.get(index).is_some_and(Option::is_some)
    }
}

impl Master {
    /// Chooses until there is something for the line, or nothing to do.
    ///
    /// # Errors
    /// The time until which nothing is to be done, after `now`.
    pub(super) fn choose(&mut self, now: Instant) -> Result<Turn, Instant> {
        let soon = now + Duration::from_millis(1);
        for _ in 0..MOST_DECISIONS {
            if let Some(decided) = self.decide(now) {
                return decided.map_err(|until| until.max(soon));
            }
        }
        Err(soon)
    }

    /// One decision; none where it changed what is to be decided on.
    fn decide(&mut self, now: Instant) -> Option<Result<Turn, Instant>> {
        self.purge(now);
        let quiet = self.bus.queue.quiet(now);
        if quiet != self.waits.quiet {
            self.waits.quiet = quiet;
            self.schedule.keep_quiet(quiet);
        }
        if self.shutdown.is_none()
            && let Some(turn) = self.broadcast_stop(now)
        {
            return Some(Ok(turn));
        }
        let mut commands = self.commands(now);
        if self.shutdown.is_none()
            && !commands.waits(Urgency::Stop)
            && let Some(ready) = self.checked_write(now)
        {
            self.turns.served(Urgency::Command, commands.waits(Urgency::Read));
            return Some(Ok(self.turn(ready, now)));
        }
        let rank = self.turns.rank(|rank| commands.waits(rank));
        if self.shutdown.is_some() {
            if !self.stops_the_line() {
                self.abandon_background(Outcome::ShuttingDown, Interruption::ShuttingDown, now);
            }
            // Polls cease: the line belongs to the stops.
            return match rank {
                Some(rank) => self.command(rank, &mut commands, now),
                // The broadcast that stops the whole line goes before the stops that wait for it.
                None => Some(
                    self.stop_the_line(now)
                        .map_err(|_| commands.wake_at.unwrap_or(now + super::LOOK_ROUND)),
                ),
            };
        }
        let highest = RANKS.into_iter().find(|rank| commands.waits(*rank));
        match self.schedule.next_of(now, rank, highest) {
            // A stop waits for one poll at most, and for nothing else.
            Decision::Poll(poll) if highest == Some(Urgency::Stop) => self.poll(poll, now),
            Decision::Poll(poll) => match self.background(false, now) {
                Ok(turn) => Some(Ok(turn)),
                Err(_) => self.poll(poll, now),
            },
            Decision::Idle(until) => Some(self.background(true, now).map_err(|again| {
                let wake = commands.wake_at.into_iter().chain(again);
                wake.fold(until, Instant::min)
            })),
            Decision::Command(rank) => self.command(rank, &mut commands, now),
        }
    }

    /// The write of a parameter to a drive that said, in the transaction before, that its motor stands: nothing but a
    /// stop goes between the two.
    fn checked_write(&mut self, now: Instant) -> Option<Ready> {
        let (slot, rank) = (Urgency::Command, Urgency::Command);
        let Master { drives, bus, waits, .. } = self;
        let is_checked = |drive: &mut DriveState| drive.run(slot).is_some_and(CommandRun::is_checked);
        let (drive, state) = drives
            .enumerate_mut()
            .find_map(|(index, drive)| is_checked(drive).then_some((index, drive)))?;
        let image = bus.image.drives.get(drive)?;
        match state.wanted(image, &waits.n2_late, now) {
            Wanted::Step(Urgency::Command, step)
                if step.pdu.is_write() && waits.sessions.before(drive, Some(slot), now).is_none() =>
            {
                Some(Ready {
                    drive,
                    slot,
                    rank,
                    step,
                })
            }
            _ => None,
        }
    }

    /// Ends the started commands of a drive after a stop.
    fn purge(&mut self, now: Instant) {
        let stopped = self.bus.queue.lock().take_stopped();
        for index in stopped {
            if let (Some(drive), Some(image)) = (self.drives.get_mut(index), self.bus.image.drives.get(index)) {
                drive.purge(image, now);
            }
        }
        if self.bus.queue.is_guarded() {
            self.end_what_was_taken(now);
        }
    }

    /// Ends the started commands of a client when another one took the drive.
    fn end_what_was_taken(&mut self, now: Instant) {
        let pending = self.bus.queue.lock().take_taken();
        for index in pending {
            if let (Some(drive), Some(image)) = (self.drives.get_mut(index), self.bus.image.drives.get(index)) {
                let refuses = |origin: &Origin| self.bus.queue.lock().hold_ends_run(index, origin, now);
                drive.taken(refuses, Interruption::Taken, image, now);
            }
        }
    }

    fn commands(&mut self, now: Instant) -> Commands {
        let mut commands = Commands::default();
        let Master { drives, bus, waits, .. } = self;
        for ((index, drive), image) in drives.enumerate_mut().zip(&bus.image.drives) {
            if !drive.has_runs() {
                continue;
            }
            if lost_right(drive, &image.spec.bus) {
                let refuses = |origin: &Origin| may_not_write(origin, &image.spec.bus);
                drive.taken(refuses, Interruption::RightLost, image, now);
            }
            let mut wanted = drive.wanted(image, &waits.n2_late, now);
            while let Some(starts) = &mut waits.starts
                && starts.forbids(index, drive, &wanted, now)
            {
                wanted = drive.wanted(image, &waits.n2_late, now);
            }
            let quiet = waits.quiet.filter(|(quiet, _)| *quiet == index);
            match wanted {
                Wanted::Step(slot, _) if quiet.is_some() && slot != Urgency::Stop => {
                    quiet.into_iter().for_each(|(_, until)| commands.wait(until));
                }
                Wanted::Step(slot, step) => {
                    // What N2 needs said before is blocked by late replies as the step itself is.
                    let before = waits.sessions.before(index, Some(slot), now).map(RequestPdu::N2);
                    let blocked = before.and_then(|before| waits.n2_late.blocks(&before, now));
                    let waits = drive.run(slot).is_some_and(|run| run.waits_for_late());
                    if let Some(until) = blocked.filter(|_| waits) {
                        commands.wait(until);
                        continue;
                    }
                    let rank = drive.run(slot).map_or(slot, |run| run.rank);
                    let place = commands.ready.get_mut(rank as usize);
                    if let Some(place @ None) = place {
                        *place = Some(Ready {
                            drive: index,
                            slot,
                            rank,
                            step,
                        });
                    }
                }
                Wanted::Wait(until) => commands.wait(until),
                Wanted::Nothing => {}
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
        drop_in_vain(&mut pending, &bus.image.drives, now);
        let stands: PerDrive<bool> = drives
            .iter()
            .zip(&bus.image.drives)
            .map(|(drive, image)| drive.was_stopped() && drive.stands_by_stop(&image.reading(now, drive.fresh)))
            .collect();
        let redundant = |drive: DriveIndex| stands.get(drive).copied().unwrap_or(false);
        for rank in RANKS {
            let mut until: Option<Instant> = None;
            let chosen = pending.next(
                rank,
                now,
                |command| {
                    let online = schedule.is_online(command.drive);
                    may_go(command, online, waits, drives, now).unwrap_or_else(|at| {
                        until = Some(until.map_or(at, |before| before.min(at)));
                        false
                    })
                },
                redundant,
            );
            if let Some(place) = commands.queued.get_mut(rank as usize) {
                *place = chosen;
            }
            if let Some(until) = until {
                commands.wait(until);
            }
        }
        if let Some(starts) = &mut waits.starts
            && starts.refuse(&mut pending, now)
        {
            // Others may go instead.
            commands.wait(now);
        }
    }

    /// A command of that rank has its turn: a started one, or the next one of the queue has started.
    fn command(&mut self, rank: Urgency, commands: &mut Commands, now: Instant) -> Option<Result<Turn, Instant>> {
        let lower_waits = RANKS.into_iter().any(|lower| lower > rank && commands.waits(lower));
        let ready = commands.ready.get_mut(rank as usize).and_then(Option::take);
        if let Some(ready) = ready {
            self.turns.served(rank, lower_waits);
            return Some(Ok(self.turn(ready, now)));
        }
        let chosen = commands.queued.get(rank as usize).copied().flatten()?;
        let command = self.bus.queue.lock().take(chosen)?;
        if command.passed_on.is_some() {
            self.turns.served(rank, lower_waits);
            return self.begin_passed_on(command, None, now).map(Ok);
        }
        self.begin(command, chosen.rank, now);
        // Started commands are decided on again: one may wait, or another one may go first.
        None
    }

    /// Begins a command that was taken from the queue. A stop goes to a drive that does not answer too: it is its probe.
    fn begin(&mut self, command: Command, rank: Urgency, now: Instant) {
        let online = self.schedule.is_online(command.drive) || command.urgency == Urgency::Stop;
        let index = command.drive;
        let Some((drive, image)) = self.drives.get_mut(index).zip(self.bus.image.drives.get(index)) else {
            command.answer(&Outcome::Offline, now);
            return;
        };
        if !online {
            command.answer(&Outcome::Offline, now);
            return;
        }
        if command.behind.as_ref().is_some_and(StopEnd::has_failed) {
            command.answer(&Outcome::NotStopped, now);
            return;
        }
        // It was admitted before the drive was held.
        let is_restore = matches!(command.order, Order::Parameter(_));
        if command.urgency == Urgency::Command
            && !is_restore
            && let Some(why) = image.hold.why()
        {
            command.answer(&Outcome::Refused(Refusal::NotAllowed(why.to_string())), now);
            return;
        }
        let (lost, renews) = self.bus.judges_turn(&command, now);
        if let Some(refusal) = lost {
            command.answer(&Outcome::Refused(refusal), now);
            return;
        }
        let reading = image.reading(now, RANGE_AGE);
        let hold = |range: &FrequencyRange| range.holds(&reading, drive.written.range);
        if command.urgency == Urgency::Command && !command.ranges.iter().all(hold) {
            command.answer(&Outcome::Refused(range_changed()), now);
            return;
        }
        if command.urgency == Urgency::Command
            && let Err(refusal) = still_keeps_limits(&reading, &command.order, drive.written)
        {
            command.answer(&Outcome::Refused(refusal), now);
            return;
        }
        let mut command = command;
        if command.urgency == Urgency::Stop {
            // It waited for its turn: its time begins now.
            command.expires = command.expires.max(now + DEFAULT_EXPIRY);
        }
        let start = self
            .waits
            .starts
            .as_ref()
            .and_then(|starts| starts.start_of(&command, index));
        let mut run = CommandRun::new(command, &image.spec.profile);
        (run.rank, run.renews, run.start) = (rank, renews, start);
        drive.begin(run);
    }

    fn turn(&mut self, ready: Ready, now: Instant) -> Turn {
        let Ready {
            drive,
            slot,
            rank,
            step,
        } = ready;
        match self.waits.sessions.before(drive, Some(slot), now) {
            Some(session) => Turn {
                drive,
                purpose: Purpose::Session(session, Before::Command(slot, rank)),
                pdu: RequestPdu::N2(session),
            },
            None => Turn {
                drive,
                purpose: Purpose::Command {
                    slot,
                    rank,
                    step: step.purpose,
                },
                pdu: step.pdu,
            },
        }
    }

    fn poll(&mut self, poll: Poll, now: Instant) -> Option<Result<Turn, Instant>> {
        let pdu = poll.read.pdu();
        let drive = self.drives.get_mut(poll.drive)?;
        let session = self.waits.sessions.before(poll.drive, None, now);
        let address = self.bus.image.drives.get(poll.drive)?.spec.address;
        let on_n2 = match session {
            Some(session) => self.waits.n2_late.blocks(&RequestPdu::N2(session), now),
            None => self.waits.n2_late.blocks_poll(address, &poll.read, now),
        };
        if let Some(until) = drive.late.blocks(&pdu, now).max(on_n2) {
            self.schedule.postpone(&poll, until);
            return None;
        }
        let turn = match session {
            Some(session) => Turn {
                drive: poll.drive,
                purpose: Purpose::Session(session, Before::Poll(poll)),
                pdu: RequestPdu::N2(session),
            },
            None => Turn {
                drive: poll.drive,
                purpose: Purpose::Poll(poll),
                pdu,
            },
        };
        Some(Ok(turn))
    }

    /// Whether a turn that was chosen earlier may still go out at `now`: the time of its command has not expired.
    pub(crate) fn is_still_due(&mut self, turn: &Turn, now: Instant) -> bool {
        if turn.purpose == Purpose::Background {
            return self.background_is_due(now);
        }
        let Some(slot) = turn.slot() else { return true };
        if let Some(starts) = self.waits.starts.as_ref().filter(|_| slot == Urgency::Command)
            && let Some(drive) = self.drives.get_mut(turn.drive)
            && starts.may_not_write(turn.drive, drive, turn.pdu(), now).is_some()
        {
            // It is refused when it is chosen again.
            return false;
        }
        if slot == Urgency::Command
            && let Some(drive) = self.drives.get_mut(turn.drive)
            && lost_right(drive, &self.bus.image.spec.name)
        {
            return false;
        }
        let run = self.drives.get_mut(turn.drive).and_then(|drive| drive.run(slot));
        let Some(run) = run.filter(|run| !run.is_late(now)) else {
            return false;
        };
        if run.is_of_supervision() && run.is_owed() {
            // A client that came back while the line went silent suspends it.
            let beats = self
                .bus
                .image
                .drives
                .get(turn.drive)
                .is_some_and(|image| image.has_heartbeat());
            return !beats && self.bus.queue.lock().client_waits_until(turn.drive).is_none();
        }
        true
    }
}

/// Whether a reload took the right of the client away whose started command may write on.
fn lost_right(drive: &mut DriveState, bus: &str) -> bool {
    let run = drive.run(Urgency::Command).filter(|run| run.may_write_on());
    run.is_some_and(|run| run.origins().any(|origin| may_not_write(origin, bus).is_some()))
}

/// Why that client writes no more to a drive of that bus.
fn may_not_write(origin: &Origin, bus: &str) -> Option<Refusal> {
    client_access(Moment::Write, false, origin, bus).err()
}

fn range_changed() -> Refusal {
    Refusal::NotKnown(
        "the drive's frequency range was written, or changed, since the command was accepted; nothing was written; \
         send it again"
            .to_string(),
    )
}

/// Whether a queued command can be started now.
///
/// # Errors
/// When it can be, if it must wait.
pub(super) fn may_begin(
    drive: &mut DriveState,
    command: &Command,
    online: bool,
    now: Instant,
) -> Result<bool, Instant> {
    // Behind a stop that has started nothing goes before it has ended.
    if drive.is_busy(command.urgency) || (command.urgency == Urgency::Command && drive.is_busy(Urgency::Stop)) {
        return Ok(false);
    }
    if command.urgency == Urgency::Stop {
        return match drive.vain_stops.waits_until(now) {
            Some(until) => Err(until),
            None => Ok(true),
        };
    }
    // A command to a drive that is away is answered at once.
    if let Order::Read(pdu) | Order::Write(pdu) = &command.order
        && online
        && let Some(until) = drive.late.blocks(pdu, now)
    {
        return Err(until);
    }
    Ok(true)
}
