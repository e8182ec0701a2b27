//! Decides what is sent next: cycles, fairness and back-off. Pure: time is an argument.
//!
//! Decides what the bus sends next. Order: stop, other commands, forwarded reads, due fast polls, due slow polls,
//! background transactions. Five rules modify this order: after eight commands in a row a due poll goes first;
//! commands, and the reads that they cause, get no more of a line that is busy with polls than process data; slow
//! polls that had less than their share of the time ([`slow_share`]) go before fast ones; background transactions
//! have the idle time and otherwise a small share ([`drivegate_core::order::Pace`]); a drive that does not answer is probed
//! so rarely that it costs at most 2 %.

mod background;
mod choice;
mod drives;
mod outcome;
mod share;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

pub use self::background::Admission;
use self::background::BackgroundShare;
pub(crate) use self::drives::TRIAL_PAUSE;
use self::drives::{DriveSchedule, Item, Presence, singles};
use self::share::CommandShare;
use drivegate_core::order::Urgency;
use drivegate_model::drive::{DriveIndex, PerDrive, Plan, PlannedRead, PollClass};
use drivegate_proto::Exception;

/// Number of consecutive commands after which a due poll is sent first.
pub const COMMANDS_IN_A_ROW: u32 = 8;
/// Share of a saturated line that slow polls get at least.
pub const SLOW_SHARE: f64 = 0.05;
/// Largest share that slow polls get, however many they are.
const MOST_SLOW_SHARE: f64 = 1.0 / 3.0;
/// Share of the time left by commands that slow polls get while some values were never read: unknown values are
/// more urgent than known ones.
const FIRST_SHARE: f64 = 0.5;

/// Share of a saturated line for slow polls whose cycle would need `demand`: with many requests (one per object on
/// N2) they get more than the minimum, and finish a round in six times their cycle.
pub fn slow_share(demand: f64) -> f64 {
    (demand / 6.0).clamp(SLOW_SHARE, MOST_SLOW_SHARE)
}

/// Maximum credit that slow polls collect while no slow poll is due, in requests of the longest kind.
const MOST_CREDIT: f64 = 1.5;

/// A planned read of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Poll {
    /// Index of the drive on the bus.
    pub drive: DriveIndex,
    /// The planned read.
    pub read: PlannedRead,
    /// Whether the poll is a probe, which finds out whether the drive replies (again).
    pub probe: bool,
}

/// The next action that the schedule chooses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Decision {
    /// Take a command of at least that rank.
    Command(Urgency),
    /// Read the registers of this poll.
    Poll(Poll),
    /// No request is due before this time.
    Idle(Instant),
}

/// Result of a poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Polled {
    /// The drive replied to the poll.
    Ok,
    /// The drive refused the read.
    Refused(Exception),
    /// The drive gave no valid answer.
    Failed,
    /// An invalid reply: retried, but the drive does not count as absent so soon.
    Garbled,
}

/// The change of a drive's state caused by a poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// The result of the poll does not change the state of the drive.
    None,
    /// The drive replies (again).
    Online,
    /// The drive no longer replies.
    Offline,
    /// The drive refuses these addresses.
    Unavailable(PlannedRead, Exception),
}

/// Cadence of the poll classes of a bus.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cadence {
    /// Configured cadence of the fast class.
    pub fast: Duration,
    /// Configured cadence of the slow class.
    pub slow: Duration,
    /// Number of retries for a drive without a setting of its own.
    pub retries: u32,
}

/// A round of the fast class that was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoundStart {
    /// When the round of fast polls started.
    pub at: Instant,
    /// Time since the start of the round before.
    pub cycle: Option<Duration>,
}

/// The reason why a poll was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PollReason {
    Due,
    /// A slow poll that is sent before fast ones.
    OnCredit,
    /// The poll was requested by a command.
    Asked,
}

/// The schedule of all requests on a bus.
#[derive(Debug)]
pub struct Schedule {
    cadence: Cadence,
    drives: PerDrive<DriveSchedule>,
    round: VecDeque<(DriveIndex, PlannedRead)>,
    /// Memory in which the reads of a new round are sorted, empty otherwise.
    sorted: Vec<(usize, DriveIndex, PlannedRead)>,
    /// Reads of this round that decide the state of a drive whose state is unknown: no slow poll goes before them.
    state_first: Vec<(DriveIndex, PlannedRead)>,
    round_due: Instant,
    round_started: Option<Instant>,
    new_round: Option<RoundStart>,
    slow_started: Option<Instant>,
    new_slow: Option<RoundStart>,
    /// Time on the line that slow polls have to get before fast ones.
    slow_credit: Duration,
    /// Share of all time that the credit grows by.
    slow_share: f64,
    /// Why the last poll was chosen.
    turn: PollReason,
    /// Time up to which the credit is calculated.
    earned_until: Instant,
    /// Time on the line taken by commands, and by reads they caused, since the last poll.
    commanded: Duration,
    /// Time on the line that slow polls took since the start of the round.
    slow_took: Duration,
    /// Upper limit of the credit of slow polls. More would allow a burst of slow polls that delays fast ones,
    /// although idle time would soon serve the slow ones. With less than one request, and the time until it can be
    /// sent, they would not reach their share.
    most_credit: Duration,
    /// A probe failed since the last fast poll.
    probed: bool,
    share: CommandShare,
    background: BackgroundShare,
}

impl Schedule {
    /// A schedule for drives with these plans; `cost` is the total time of a transaction on the line.
    pub fn new(
        cadence: Cadence,
        plans: &[&Plan],
        cost: impl Fn(DriveIndex, &PlannedRead) -> Duration,
        now: Instant,
    ) -> Self {
        let drives = plans.iter().enumerate().map(|(place, plan)| {
            let index = DriveIndex::new(place);
            let items = plan.all().flat_map(|read| {
                let parts = if plan.trials.contains(read) {
                    singles(*read)
                } else {
                    vec![*read]
                };
                parts.into_iter().map(|part| {
                    let mut item = Item::new(part, *read, cost(index, &part), now);
                    item.whole_again = (part != *read).then(|| now + TRIAL_PAUSE.0);
                    item
                })
            });
            let items = items.collect();
            DriveSchedule::new(items, plan, cadence.retries, now)
        });
        let drives: PerDrive<DriveSchedule> = drives.collect();
        let slow = drives.iter().flat_map(|drive| &drive.items);
        let slow = slow.filter(|item| item.read.class != PollClass::Fast);
        let longest = slow.map(|item| item.cost).max().unwrap_or_default();
        let regular = drives.iter().flat_map(|drive| &drive.items);
        let regular = regular.filter(|item| item.read.class == PollClass::Slow);
        let work: Duration = regular.map(|item| item.cost).sum();
        let demand = work.as_secs_f64() / cadence.slow.as_secs_f64().max(1e-6);
        Schedule {
            cadence,
            drives,
            round: VecDeque::new(),
            sorted: Vec::new(),
            state_first: Vec::new(),
            round_due: now,
            round_started: None,
            new_round: None,
            slow_started: None,
            new_slow: None,
            slow_credit: Duration::ZERO,
            slow_share: slow_share(demand),
            turn: PollReason::Due,
            earned_until: now,
            commanded: Duration::ZERO,
            slow_took: Duration::ZERO,
            most_credit: longest.mul_f64(MOST_CREDIT),
            probed: false,
            share: CommandShare::default(),
            background: BackgroundShare::default(),
        }
    }

    /// Sets the number of retries for each drive that has its own setting.
    pub fn try_again(&mut self, retries: impl Iterator<Item = Option<u32>>) {
        for (drive, own) in self.drives.iter_mut().zip(retries) {
            drive.retries = own.unwrap_or(drive.retries);
        }
    }

    /// The next action. `waiting` is the rank of the command that would be next.
    pub fn next(&mut self, now: Instant, waiting: Option<Urgency>) -> Decision {
        self.earn(now);
        self.start_round(now);
        self.rejoin(now);
        let poll = self.due_poll(now);
        if poll.is_none() {
            self.share.line_is_free();
        }
        if waiting == Some(Urgency::Stop) && (poll.is_none() || self.share.admits(Urgency::Stop)) {
            return Decision::Command(Urgency::Stop);
        }
        let asked = self.due_asked(now).filter(|_| {
            self.share.reads_before_commands(waiting.is_some()) && (poll.is_none() || self.share.reads_before_polls())
        });
        if let Some(asked) = asked {
            self.turn = PollReason::Asked;
            return Decision::Poll(asked);
        }
        if let Some(urgency) = waiting.filter(|urgency| poll.is_none() || self.share.admits(*urgency)) {
            return Decision::Command(urgency);
        }
        match poll {
            Some(poll) => Decision::Poll(poll),
            None => Decision::Idle(self.next_due(now)),
        }
    }

    /// The next action if `waiting` has its turn before `highest`, which also waits: a stop yields to a command, but
    /// not to the polls that the command must wait for.
    pub(crate) fn next_of(&mut self, now: Instant, waiting: Option<Urgency>, highest: Option<Urgency>) -> Decision {
        match self.next(now, waiting) {
            Decision::Poll(_) if highest != waiting && self.turn != PollReason::Asked => self.next(now, highest),
            decision => decision,
        }
    }

    /// A fast round that was started by the last [`Schedule::next`], reported once.
    pub(crate) fn take_round(&mut self) -> Option<RoundStart> {
        self.new_round.take()
    }

    /// A slow round (the first slow poll after all were done), reported once.
    pub(crate) fn take_slow_round(&mut self) -> Option<RoundStart> {
        self.new_slow.take()
    }

    /// A command (or a step of one) was on the line for `took`.
    pub(crate) fn command_done(&mut self, urgency: Urgency, took: Duration) {
        self.commanded += took;
        self.share.commanded(urgency, took);
    }

    /// Notes that a step of a refresh was on the line for `took`; refreshes have the rank of fast polls.
    pub(crate) fn refreshed(&mut self, took: Duration) {
        self.share.polled(took);
    }

    /// Notes the result of a poll.
    pub(crate) fn poll_done(&mut self, poll: &Poll, polled: Polled, took: Duration, now: Instant) -> Change {
        let items = &mut self.drives.of_mut(poll.drive).items;
        if let Some(item) = items.iter_mut().find(|item| item.read == poll.read) {
            // A read without a result is repeated among the slow polls.
            item.is_pending |= item.changed_at.take().is_some();
        }
        let turn = std::mem::replace(&mut self.turn, PollReason::Due);
        match turn {
            PollReason::Asked => {
                self.commanded += took;
                self.share.read(took);
            }
            // The time of slow polls in their minimum share and of probes of absent drives is not charged to process data.
            PollReason::OnCredit => self.share.polled(Duration::ZERO),
            PollReason::Due if poll.probe => self.share.polled(Duration::ZERO),
            PollReason::Due => self.share.polled(took),
        }
        if poll.read.class == PollClass::Fast {
            if self.round.front() == Some(&(poll.drive, poll.read)) {
                self.round.pop_front();
            }
            self.state_first.retain(|first| *first != (poll.drive, poll.read));
            self.probed = false;
        } else {
            self.slow_credit = match turn {
                PollReason::OnCredit => self.slow_credit.saturating_sub(took),
                PollReason::Asked => self.slow_credit,
                // There was room for this poll, so there will be room for the others too.
                PollReason::Due => Duration::ZERO,
            };
            if turn != PollReason::Asked {
                self.slow_took += took;
            }
            self.note_slow(now);
        }
        if matches!(polled, Polled::Failed | Polled::Garbled) && self.is_trial(poll.drive, &poll.read) {
            // A drive that does not answer a read that no manual describes, or answers it wrongly, is not offline
            // because of that.
            self.not_proved(poll.drive, &poll.read, TRIAL_PAUSE.1, now);
            return Change::None;
        }
        self.probed |= poll.probe && matches!(polled, Polled::Failed | Polled::Garbled);
        match polled {
            Polled::Ok | Polled::Refused(_) => self.answered(poll, polled, now),
            Polled::Failed => self.failed(poll, took, now),
            Polled::Garbled => self.garbled(poll, took, now),
        }
    }

    /// The reads that each drive never answers although it answers others.
    pub(crate) fn unanswered(&self) -> PerDrive<Vec<PlannedRead>> {
        self.drives.iter().map(DriveSchedule::unanswered).collect()
    }

    /// Notes that the drive replied to a command: it is present, and is probed at once if it was offline.
    pub fn seen(&mut self, drive: DriveIndex, now: Instant) {
        let drive = self.drives.of_mut(drive);
        (drive.failures, drive.doubted) = (0, false);
        if let Presence::Away(at, pause) = drive.presence {
            drive.presence = Presence::Away(at.min(now), pause);
        }
    }

    /// An offline drive did not reply to a command, which counts as a probe: the next one does not follow immediately.
    pub(crate) fn probed_in_vain(&mut self, drive: DriveIndex, took: Duration, now: Instant) {
        let drive = self.drives.of_mut(drive);
        if let Presence::Away(at, pause) = drive.presence {
            drive.presence = Presence::Away(at.max(now + took), pause);
        }
    }

    /// Notes that an online drive did not reply to a command: its process data is read next, to find out whether it
    /// is still present before more is sent.
    pub(crate) fn doubted(&mut self, index: DriveIndex) {
        let drive = self.drives.of_mut(index);
        if drive.presence == Presence::Online
            && !self.round.is_empty()
            && let Some(item) = drive.items.iter().find(|item| item.is_process_data())
        {
            let first = (index, item.read);
            drive.doubted = true;
            self.round.retain(|waiting| *waiting != first);
            self.round.push_front(first);
        }
    }

    /// Whether that read is longer than a manual states, and no reply has proved it.
    pub fn is_trial(&self, drive: DriveIndex, read: &PlannedRead) -> bool {
        self.drives.of(drive).is_trial(read)
    }

    /// Notes that a reply to this read contained more than its first item, which proves the read.
    pub fn proved(&mut self, drive: DriveIndex, read: &PlannedRead) {
        let unproved = &mut self.drives.of_mut(drive).unproved;
        unproved.retain(|block| !block.covers(read.table, read.start));
    }

    /// Notes that no reply has proved this read: its items are read singly, and the whole read is tried again later.
    pub(crate) fn not_proved(&mut self, drive: DriveIndex, read: &PlannedRead, pause: Duration, now: Instant) {
        self.drives.of_mut(drive).take_apart(read, now, pause);
    }

    /// Notes that a probe, or what goes before it, is sent to this drive.
    pub(crate) fn probe_sent(&mut self, drive: DriveIndex) {
        self.drives.of_mut(drive).put_off = 0;
    }

    /// Postpones a poll until this time.
    pub(crate) fn postpone(&mut self, poll: &Poll, until: Instant) {
        self.round.retain(|waiting| *waiting != (poll.drive, poll.read));
        let drive = self.drives.of_mut(poll.drive);
        drive.doubted = false;
        if let (Presence::Away(_, pause), true) = (drive.presence, poll.probe) {
            drive.presence = Presence::Away(until, pause);
            drive.put_off = drive.put_off.saturating_add(1);
        }
        if let Some(item) = drive.items.iter_mut().find(|i| i.read == poll.read) {
            item.postponed = true;
            item.due = item.due.max(until);
            item.changed_at = item.changed_at.map(|since| since.max(until));
        }
    }

    /// Makes postponed polls due again, as far as they may be sent now.
    pub fn recall(&mut self, now: Instant, may_go: impl Fn(DriveIndex, &PlannedRead) -> bool) {
        for (index, drive) in self.drives.enumerate_mut() {
            let postponed = drive.items.iter_mut().filter(|item| item.postponed);
            for item in postponed.filter(|item| may_go(index, &item.read)) {
                item.due = item.due.min(now);
                item.changed_at = item.changed_at.map(|since| since.min(now));
            }
        }
    }

    /// Postponed process data that may now be read joins the current round.
    fn rejoin(&mut self, now: Instant) {
        if self.round.is_empty() {
            return;
        }
        for (index, drive) in self.drives.enumerate_mut() {
            let online = drive.presence == Presence::Online;
            for item in drive.items.iter_mut().filter(|item| item.postponed && item.due <= now) {
                item.postponed = false;
                if online && item.read.class == PollClass::Fast && !self.round.contains(&(index, item.read)) {
                    self.round.push_back((index, item.read));
                }
            }
        }
    }

    /// Makes the reads of an address due at once, because a command changed it.
    pub fn read_soon(&mut self, drive: DriveIndex, covers: impl Fn(&PlannedRead) -> bool, now: Instant) {
        let drive = self.drives.of_mut(drive);
        for item in drive
            .items
            .iter_mut()
            .filter(|i| i.read.class != PollClass::Fast && !i.refused && covers(&i.read))
        {
            item.changed_at.get_or_insert(now);
        }
    }

    /// Whether such a read of a drive is still to be answered for the first time since the drive came online.
    pub(crate) fn awaits(&self, drive: DriveIndex, covers: impl Fn(&PlannedRead) -> bool) -> bool {
        self.drives.of(drive).awaits(covers)
    }

    /// Reads everything of a drive again, including points of the class `once`.
    pub(crate) fn read_again(&mut self, index: DriveIndex, now: Instant) {
        let drive = self.drives.of_mut(index);
        let again = |item: &&mut Item| !item.refused && item.read.class != PollClass::Fault;
        for item in drive.items.iter_mut().filter(again) {
            item.is_pending = true;
            item.due = item.due.min(now);
        }
        self.state_first(index, None);
    }

    /// Moves the reads that decide a drive's state to the front of the round, except the one that was just answered.
    fn state_first(&mut self, index: DriveIndex, just_read: Option<PlannedRead>) {
        let drive = self.drives.of(index);
        if drive.presence != Presence::Online {
            return;
        }
        let may_go = |read: &PlannedRead| {
            let sound = |item: &Item| item.read == *read && !item.refused && !item.postponed;
            Some(*read) != just_read && drive.items.iter().any(sound)
        };
        // A block that is not proved yet is read in parts.
        let behind =
            |item: &&Item| drive.behind_state.contains(&item.origin) || drive.behind_state.contains(&item.read);
        let parts: Vec<PlannedRead> = drive.items.iter().filter(behind).map(|item| item.read).collect();
        for read in parts.iter().rev().filter(|read| may_go(read)) {
            self.round.retain(|waiting| *waiting != (index, *read));
            self.round.push_front((index, *read));
            if !self.state_first.contains(&(index, *read)) {
                self.state_first.push((index, *read));
            }
        }
    }

    /// Makes the reads for a new fault due at once: those that the profile names for faults, and the slow reads
    /// that cover more details of it. They take no more of the line than other slow reads.
    pub(crate) fn fault_came(&mut self, drive: DriveIndex, covers: impl Fn(&PlannedRead) -> bool, now: Instant) {
        for item in &mut self.drives.of_mut(drive).items {
            match item.read.class {
                PollClass::Fault => {
                    (item.is_pending, item.refused, item.failures) = (true, false, 0);
                    item.due = now;
                }
                PollClass::Monitor if covers(&item.read) && !item.refused => {
                    item.is_pending = true;
                    item.due = item.due.min(now);
                }
                PollClass::Slow if covers(&item.read) && !item.refused => item.due = item.due.min(now),
                _ => {}
            }
        }
    }

    /// Monitoring registers are to be read again at `due`, as far as the drive has them.
    pub fn monitor(&mut self, drive: DriveIndex, covers: impl Fn(&PlannedRead) -> bool, due: Instant) {
        let items = self.drives.of_mut(drive).items.iter_mut();
        let monitors = items.filter(|item| item.read.class == PollClass::Monitor && !item.refused && !item.is_pending);
        for item in monitors.filter(|item| covers(&item.read)) {
            (item.is_pending, item.due) = (true, due);
        }
    }

    /// Requests a read from a drive, also of points read once.
    pub fn ask(&mut self, drive: DriveIndex, now: Instant) {
        let items = self.drives.of_mut(drive).items.iter_mut();
        let mut sound = items.filter(|item| !item.refused && item.failures == 0);
        if let Some(item) =
            sound.find(|item| !matches!(item.read.class, PollClass::Fast | PollClass::Fault | PollClass::Monitor))
        {
            item.is_pending = true;
            item.due = item.due.min(now);
        }
    }

    /// Notes that a session step was sent before a drive's poll, which is still due: the other polls are served in between.
    pub(crate) fn session_done(&mut self, drive: DriveIndex) {
        let drive = self.drives.of_mut(drive);
        (drive.heard, drive.failures) = (true, 0);
        self.probed = true;
        self.share.polled(Duration::ZERO);
    }

    /// Does not poll this drive until this time; `None` polls all drives.
    pub fn keep_quiet(&mut self, quiet: Option<(DriveIndex, Instant)>) {
        for (index, drive) in self.drives.enumerate_mut() {
            drive.quiet_until = quiet.filter(|(quiet, _)| *quiet == index).map(|(_, until)| until);
        }
        if let Some((quiet, _)) = quiet {
            self.round.retain(|(drive, _)| *drive != quiet);
            self.state_first.retain(|(drive, _)| *drive != quiet);
        }
    }

    /// Whether the drive replies.
    pub fn is_online(&self, drive: DriveIndex) -> bool {
        self.drives.of(drive).presence == Presence::Online
    }

    /// Offline drives, and reads of the others that are postponed after failures.
    pub fn held(&self, now: Instant) -> (usize, usize) {
        let online = |drive: &&DriveSchedule| drive.presence == Presence::Online;
        let put_off = |item: &&Item| {
            !item.refused && (item.failures > 0 || (item.read.class == PollClass::Fast && item.due > now))
        };
        let held = self
            .drives
            .iter()
            .filter(online)
            .flat_map(|drive| &drive.items)
            .filter(put_off);
        (self.drives.iter().filter(|drive| !online(drive)).count(), held.count())
    }

    /// Parts of reads of drives that answer, which are joined again later.
    pub(crate) fn parts(&self) -> usize {
        let online = self.drives.iter().filter(|drive| drive.presence == Presence::Online);
        let items = online.flat_map(|drive| &drive.items);
        items.filter(|item| item.whole_again.is_some()).count()
    }

    /// The port was lost: every drive must be found again.
    pub fn reset(&mut self, now: Instant) {
        self.round.clear();
        self.state_first.clear();
        self.round_due = now;
        self.round_started = None;
        self.slow_started = None;
        for drive in &mut self.drives {
            drive.presence = Presence::Away(now, Duration::ZERO);
            drive.early.found_anew();
            (drive.failures, drive.failed_read) = (0, None);
        }
    }
}

#[cfg(test)]
mod tests;
