//! The schedule's state of each drive: its reads, whether it replies, and blocks that it refuses in part.

use std::time::{Duration, Instant};

use super::Change;
use drivegate_model::drive::{Plan, PlannedRead, PollClass};
use drivegate_proto::Exception;

/// Share of the line that probes of a drive which does not answer take. The promise is 2 %; three such drives among ten
/// were measured to cost 6.5 % with just that.
const DEAD_SHARE: f64 = 0.016;
/// First and longest pause between two probes of a drive that does not answer.
const PROBE_PAUSE: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(10));
/// One in this number of probes reads something else, because the usual read may be one that the drive never
/// answers. The second number is for a drive with only one read, of which parts are then read.
const OTHER_PROBE: (usize, usize) = (3, 2);
/// Times after a drive went offline at which it is probed at any cost, because most outages are short. The drive
/// has saved the time for it out of its share while it was online.
const EARLY_PROBES: [Duration; 3] = [
    Duration::from_millis(500),
    Duration::from_millis(1_000),
    Duration::from_millis(2_000),
];
/// First and longest pause before a refused request is repeated: a drive that is starting may refuse registers that
/// it soon has, and one that never has them must not take time from others.
const REFUSED_PAUSE: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(60));

/// First and longest pause before a request is repeated that is not answered while the drive answers others.
pub(super) const MUTE_PAUSE: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(60));
/// Pause before the next request that a drive may leave unanswered, as a multiple of the time that the last such
/// request took on the line: while the silent register is being located, and once it is known.
const SOUGHT_PAUSE: u32 = 4;
const KNOWN_PAUSE: u32 = 50;
/// How often a register is tried again before it counts as one that the drive never answers.
const TRIED_AGAIN: u32 = 3;

/// Pause before a read that no manual describes is tried again: after a failure, and after a reply that proved nothing.
pub(crate) const TRIAL_PAUSE: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(20));

/// Time of process data without a failure that shows a healthy line.
const SOUND_FOR: Duration = Duration::from_secs(10);
/// Pause before a slow request is tried again that the drive was too busy for.
const BUSY_PAUSE: Duration = Duration::from_secs(1);
/// Replies in a row that the drive is busy, after which nothing waits for the read any more.
const MOST_BUSY: u32 = 3;

#[derive(Debug, Clone)]
pub(super) struct Item {
    pub(super) read: PlannedRead,
    /// The planned read of which this one is a part.
    pub(super) origin: PlannedRead,
    pub(super) due: Instant,
    /// Whether the read is postponed because a late reply to another request could be mistaken for its own.
    pub(super) postponed: bool,
    pub(super) cost: Duration,
    pub(super) refused: bool,
    /// Whether the drive answers other reads but not this one, which does not make the drive offline.
    pub(super) never_answers: bool,
    /// Number of consecutive refusals.
    pub(super) refusals: u32,
    /// Number of consecutive replies by which the drive is busy, or fails.
    pub(super) busy: u32,
    pub(super) failures: u32,
    /// Time of the last failed poll of this item.
    pub(super) failed_at: Option<Instant>,
    /// A read of the once class, or one for a fault, that is still to be done.
    pub(super) is_pending: bool,
    /// Whether the read was never answered so far.
    pub(super) unread: bool,
    /// Whether the drive answered the read since it came online.
    pub(super) is_answered: bool,
    /// When a command changed the registers of this item; it is then read before the round, so that the command is
    /// confirmed soon.
    pub(super) changed_at: Option<Instant>,
    /// When the parts of a refused block may be joined again, since it may have been refused by mistake.
    pub(super) whole_again: Option<Instant>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Presence {
    Online,
    /// The drive is offline: time of the next probe, and the pause before it.
    Away(Instant, Duration),
}

#[derive(Debug)]
pub(super) struct DriveSchedule {
    /// Number of retries after a failed attempt.
    pub(super) retries: u32,
    pub(super) presence: Presence,
    /// Until when a drill lets nothing be sent to the drive.
    pub(super) quiet_until: Option<Instant>,
    /// How often a probe was postponed since one was sent.
    pub(super) put_off: u32,
    pub(super) early: EarlyProbes,
    pub(super) tried: bool,
    /// Whether the drive answered a session step (Identify, poll of N2) since its last probe.
    pub(super) heard: bool,
    /// Whether the drive left a command unanswered: a fast poll then shows whether it is present, before anything
    /// else is read.
    pub(super) doubted: bool,
    pub(super) failures: u32,
    pub(super) garbled: u32,
    /// Whether the last request got no answer.
    pub(super) unanswered: bool,
    /// The unanswered read after which the drive counted as away, and the probes since.
    pub(super) failed_read: Option<PlannedRead>,
    pub(super) probes: usize,
    /// The last failed poll of process data.
    pub(super) troubled: Option<Instant>,
    pub(super) items: Vec<Item>,
    /// Reads of the plan that decide the drive's state.
    pub(super) behind_state: Vec<PlannedRead>,
    /// Slow reads of the plan that show bits of the status word.
    pub(super) behind_status_word: Vec<PlannedRead>,
    /// Reads that are longer than a manual describes and that no reply has proved since the drive came online.
    trials: Vec<PlannedRead>,
    pub(super) unproved: Vec<PlannedRead>,
}

/// The probes of a drive soon after it went offline.
#[derive(Debug)]
pub(super) struct EarlyProbes {
    /// Number of probes that the drive may have at any cost; restored completely once it has answered for [`SOUND_FOR`].
    free: usize,
    /// Time on the line that the drive has saved up for more early probes.
    saved: Duration,
    /// Since when the drive has been online, which earns time for probes.
    online_since: Option<Instant>,
    /// When the drive went away, and the number of early probes since.
    outage: Option<(Instant, usize)>,
}

impl Default for EarlyProbes {
    fn default() -> Self {
        EarlyProbes {
            free: EARLY_PROBES.len(),
            saved: Duration::ZERO,
            online_since: None,
            outage: None,
        }
    }
}

impl EarlyProbes {
    /// Notes that the drive answers again.
    pub(super) fn answers_again(&mut self, now: Instant) {
        (self.online_since, self.outage) = (Some(now), None);
    }

    /// Notes that the drive is to be rediscovered: if it does not answer, it goes offline only then.
    pub(super) fn found_anew(&mut self) {
        self.outage = None;
    }

    /// When the next early probe is due, after a request without success that took `took` on the line; `None` when
    /// the probes are used up.
    fn next(&mut self, now: Instant, took: Duration) -> Option<Instant> {
        if let Some(since) = self.online_since.take() {
            let online = now.saturating_duration_since(since);
            if online >= SOUND_FOR {
                self.free = EARLY_PROBES.len();
            }
            self.saved += online.min(SOUND_FOR).mul_f64(DEAD_SHARE);
        }
        let (since, used) = self.outage.get_or_insert((now, 0));
        let at = *since + *EARLY_PROBES.get(*used)?;
        match self.free.checked_sub(1) {
            Some(free) => self.free = free,
            None => self.saved = self.saved.checked_sub(took)?,
        }
        *used += 1;
        // The others have as much of the line in between.
        Some(at.max(now + took))
    }
}

/// A read of each item of a block.
pub(super) fn singles(block: PlannedRead) -> Vec<PlannedRead> {
    let single = |offset: u16| {
        Some(PlannedRead {
            start: block.start.checked_add(offset)?,
            count: 1,
            wide: 0,
            ..block
        })
    };
    (0..block.count).filter_map(single).collect()
}

impl Item {
    pub(super) fn new(read: PlannedRead, origin: PlannedRead, cost: Duration, now: Instant) -> Item {
        Item {
            read,
            origin,
            due: now,
            postponed: false,
            cost,
            refused: false,
            never_answers: false,
            refusals: 0,
            busy: 0,
            failures: 0,
            failed_at: None,
            is_pending: read.class != PollClass::Fault,
            unread: !matches!(read.class, PollClass::Fault | PollClass::Monitor),
            is_answered: false,
            changed_at: None,
            whole_again: None,
        }
    }

    /// Whether the item is read in every round and is not known to stay unanswered.
    pub(super) fn is_process_data(&self) -> bool {
        self.read.class == PollClass::Fast && !self.never_answers
    }

    pub(super) fn is_slow(&self) -> bool {
        match self.read.class {
            PollClass::Slow => true,
            PollClass::Once | PollClass::Fault | PollClass::Monitor => self.is_pending,
            PollClass::Fast | PollClass::Never => false,
        }
    }
}

impl DriveSchedule {
    /// Whether a drill sends the drive nothing now.
    pub(super) fn is_quiet(&self, now: Instant) -> bool {
        self.quiet_until.is_some_and(|until| now < until)
    }

    /// A drive without a request so far.
    pub(super) fn new(items: Vec<Item>, plan: &Plan, retries: u32, now: Instant) -> DriveSchedule {
        DriveSchedule {
            retries,
            presence: Presence::Away(now, Duration::ZERO),
            quiet_until: None,
            put_off: 0,
            early: EarlyProbes::default(),
            tried: false,
            heard: false,
            doubted: false,
            failures: 0,
            garbled: 0,
            unanswered: false,
            failed_read: None,
            probes: 0,
            troubled: None,
            items,
            behind_state: plan.behind_state.clone(),
            behind_status_word: plan.behind_status_word.clone(),
            unproved: plan.trials.clone(),
            trials: plan.trials.clone(),
        }
    }

    /// Whether that read is longer than a manual states, and no reply has proved it.
    pub(super) fn is_trial(&self, read: &PlannedRead) -> bool {
        read.count > 1 && self.unproved.iter().any(|block| block.covers(read.table, read.start))
    }

    /// Reads the items of a read singly, and tries the whole read again after the pause.
    pub(super) fn take_apart(&mut self, read: &PlannedRead, now: Instant, pause: Duration) {
        let mut items = self.items.iter().enumerate();
        let Some((index, whole)) = items.find(|(_, item)| item.read == *read && read.count > 1) else {
            return;
        };
        let whole = whole.clone();
        let parts = singles(*read).into_iter().map(|part| Item {
            read: part,
            due: whole.due.min(now),
            whole_again: Some(now + pause),
            ..whole.clone()
        });
        self.items.splice(index..=index, parts.collect::<Vec<_>>());
    }

    /// Notes that the drive is offline: another drive may return in its place, so only reads that every drive
    /// answers are used first.
    fn doubt_trials(&mut self, now: Instant) {
        for block in self.trials.clone() {
            let within: Vec<PlannedRead> = self.items.iter().map(|item| item.read).collect();
            for read in within.iter().filter(|read| block.covers(read.table, read.start)) {
                self.take_apart(read, now, TRIAL_PAUSE.0);
            }
        }
        self.unproved.clone_from(&self.trials);
    }

    /// The drive does not answer; the last request occupied the line for `took`. Sets the time of the next probe:
    /// the first probes follow soon, then the interval doubles, and the probes do not exceed their share of the
    /// line.
    pub(super) fn probe_failed(&mut self, now: Instant, took: Duration) {
        let pause = match self.presence {
            Presence::Online => Duration::ZERO,
            Presence::Away(_, pause) => pause,
        };
        self.heard = false;
        self.doubt_trials(now);
        let (first, longest) = PROBE_PAUSE;
        if let Some(at) = self.early.next(now, took) {
            self.presence = Presence::Away(at, (pause * 2).max(first));
            return;
        }
        self.presence = if pause.is_zero() {
            // The transaction then on the line, and those before the probe, must fit within the longest pause as well.
            Presence::Away(now + (took * 4).clamp(first, longest.mul_f64(0.9)), first)
        } else {
            let doubled = doubled(pause);
            let affordable = took.mul_f64(1.0 / DEAD_SHARE).min(longest);
            Presence::Away(now + doubled.max(affordable), doubled)
        };
    }

    /// When a slow read is due. If a read was postponed for long and failed together with process data, the line
    /// was the cause: it is then due once process data was received without errors for a while.
    pub(super) fn due(&self, item: &Item) -> Instant {
        let Some((failed_at, troubled)) = item.failed_at.zip(self.troubled).filter(|_| item.failures > 0) else {
            return item.due;
        };
        let sound = troubled + SOUND_FOR;
        if failed_at <= sound && item.due > failed_at + SOUND_FOR {
            item.due.min(sound)
        } else {
            item.due
        }
    }

    /// Whether something of a drive that answers was never read, the process data apart.
    pub(super) fn has_unread(&self) -> bool {
        let unread = |item: &Item| item.unread && !item.refused && item.failures == 0 && item.is_slow();
        self.presence == Presence::Online && self.items.iter().any(unread)
    }

    /// Whether a read that the drive neither refuses, nor leaves unanswered, nor is too busy for each time was not answered since the drive came online.
    pub(super) fn awaits(&self, covers: impl Fn(&PlannedRead) -> bool) -> bool {
        let is_read = |class: PollClass| matches!(class, PollClass::Fast | PollClass::Slow | PollClass::Once);
        let is_sound =
            |item: &Item| !item.refused && !item.never_answers && item.failures == 0 && item.busy < MOST_BUSY;
        let awaited = |item: &&Item| !item.is_answered && is_sound(item) && is_read(item.read.class);
        self.presence == Presence::Online && self.items.iter().filter(awaited).any(|item| covers(&item.read))
    }

    /// Whether slow reads wait until process data shows that the drive still answers.
    pub(super) fn waits_for_fast(&self) -> bool {
        self.unanswered && self.items.iter().any(Item::is_process_data)
    }

    /// Whether the answers to this read show that the drive is present. A read that was split or joined since it
    /// was queued shows nothing; the reads that replaced it do.
    pub(super) fn shows_presence(&self, read: &PlannedRead) -> bool {
        let Some(item) = self.items.iter().find(|item| item.read == *read) else {
            return false;
        };
        if self.items.iter().any(Item::is_process_data) {
            item.is_process_data()
        } else {
            !item.never_answers || self.items.iter().all(|item| item.never_answers)
        }
    }

    /// The read that probes whether the drive answers: the first one not known to be unanswered, for which the
    /// reply to the previous probe also counts; every third time another one, including parts of that read.
    pub(super) fn probe(&self) -> Option<PlannedRead> {
        let (known, mute): (Vec<&Item>, Vec<&Item>) = self.items.iter().partition(|item| !item.never_answers);
        let mut all = known.into_iter().chain(mute).map(|item| item.read);
        let first = all.next()?;
        let mut others: Vec<PlannedRead> = all
            .filter(|read| !matches!(read.class, PollClass::Fault | PollClass::Monitor))
            .collect();
        let every = if others.is_empty() {
            OTHER_PROBE.1
        } else {
            OTHER_PROBE.0
        };
        others.extend(parts(first));
        let turn = (self.probes % every == every - 1).then(|| self.probes / every % others.len().max(1));
        turn.and_then(|turn| others.get(turn).copied()).or(Some(first))
    }

    /// Notes that the drive answers other reads but left this one unanswered in every attempt. A block is read in
    /// halves from now on, until the register that silences the drive is found; that register is tried again after
    /// growing pauses. `took` is the time of the request on the line.
    pub(super) fn in_vain(&mut self, read: PlannedRead, took: Duration, now: Instant) {
        self.divide(read, now);
        for item in self.items.iter_mut().filter(|item| item.never_answers) {
            let times = if item.failures > self.retries {
                KNOWN_PAUSE
            } else {
                SOUGHT_PAUSE
            };
            item.due = item.due.max(now + took * times);
        }
    }

    fn divide(&mut self, read: PlannedRead, now: Instant) {
        let retries = self.retries;
        let mut items = self.items.iter_mut().enumerate();
        let Some((index, item)) = items.find(|(_, item)| item.read == read) else {
            // The block was split meanwhile: any of its parts may be the unanswered one.
            let parts = self
                .items
                .iter_mut()
                .filter(|item| read.covers(item.read.table, item.read.start));
            parts.for_each(|part| part.never_answers = true);
            return;
        };
        item.never_answers = true;
        item.failures = item.failures.max(retries + 1);
        let vain = item.failures.saturating_sub(retries + 1);
        item.due = now + (MUTE_PAUSE.0 * (1 << vain.min(5))).min(MUTE_PAUSE.1);
        let origin = item.origin;
        if matches!(read.class, PollClass::Fault | PollClass::Monitor) {
            return;
        }
        if !self.halve(index, now) {
            self.join(origin, now);
        }
    }

    /// Replaces an unanswered block by its halves; false if it cannot be divided.
    fn halve(&mut self, index: usize, now: Instant) -> bool {
        let Some((item, (low, high))) = self
            .items
            .get(index)
            .and_then(|item| Some((item, Plan::halves(item.read)?)))
        else {
            return false;
        };
        let (origin, cost) = (item.origin, item.cost);
        // The whole block was tried often enough, so each half is tried only once.
        let halves = [low, high].map(|half| Item {
            never_answers: true,
            failures: self.retries,
            whole_again: Some(now + REFUSED_PAUSE.1),
            ..Item::new(half, origin, cost, now)
        });
        self.items.splice(index..=index, halves);
        true
    }

    /// Notes that the drive answered `part` of a block that it does not answer as a whole: the part is read separately.
    pub(super) fn set_apart(&mut self, part: PlannedRead, now: Instant) {
        let contains = |item: &Item| {
            item.read.class == part.class && item.read.count > part.count && item.read.covers(part.table, part.start)
        };
        while let Some(index) = self.items.iter().position(contains) {
            if !self.halve(index, now) {
                return;
            }
        }
    }

    /// The reads that an answering drive never answers, and that cannot be divided further.
    pub(super) fn unanswered(&self) -> Vec<PlannedRead> {
        if self.presence != Presence::Online {
            return Vec::new();
        }
        let vain = |item: &&Item| {
            let often = item.failures > self.retries + TRIED_AGAIN;
            item.never_answers && often && Plan::halves(item.read).is_none()
        };
        self.items.iter().filter(vain).map(|item| item.read).collect()
    }

    /// Splits a refused block until the bad point is found, which is retried slowly.
    pub(super) fn refused(&mut self, read: PlannedRead, exception: Exception, now: Instant) -> Change {
        let addressed = exception.is_about_request();
        let mut items = self.items.iter_mut().enumerate();
        let Some((index, item)) = items.find(|(_, item)| item.read == read) else {
            return Change::None;
        };
        if !addressed {
            // The drive is busy or reports a failure: it is online, its values become older, and the poll is
            // repeated in turn.
            item.busy = item.busy.saturating_add(1);
            item.due = match item.read.class {
                PollClass::Fast => item.due.max(now),
                _ => now + BUSY_PAUSE,
            };
            return Change::None;
        }
        let Some((low, high)) = Plan::halves(read) else {
            let change = if item.refused {
                Change::None
            } else {
                Change::Unavailable(read, exception)
            };
            item.refused = true;
            item.is_pending = !matches!(item.read.class, PollClass::Fault | PollClass::Monitor);
            item.due = now + (REFUSED_PAUSE.0 * (1 << item.refusals.min(5))).min(REFUSED_PAUSE.1);
            item.refusals = item.refusals.saturating_add(1);
            let origin = item.origin;
            self.join(origin, now);
            return change;
        };
        let (origin, cost) = (item.origin, item.cost);
        let mut halves = [Item::new(low, origin, cost, now), Item::new(high, origin, cost, now)];
        for half in &mut halves {
            half.is_pending = true;
            half.whole_again = Some(now + REFUSED_PAUSE.1);
        }
        self.items.splice(index..=index, halves);
        Change::None
    }

    /// Joins the valid reads on both sides of the refused addresses again that were separated by splitting.
    pub(super) fn join(&mut self, origin: PlannedRead, now: Instant) {
        let mut joined: Vec<Item> = Vec::with_capacity(self.items.len());
        for item in self.items.drain(..) {
            match joined.last_mut() {
                Some(last)
                    if item.origin == origin
                        && last.origin == origin
                        && !(item.refused || item.never_answers)
                        && !(last.refused || last.never_answers)
                        && u32::from(last.read.start) + u32::from(last.read.count) == u32::from(item.read.start) =>
                {
                    last.read.append(&item.read);
                    last.is_pending = true;
                    last.due = last.due.min(now);
                    last.whole_again = None;
                }
                _ => joined.push(Item {
                    whole_again: item.whole_again.filter(|_| item.origin != origin),
                    ..item
                }),
            }
        }
        self.items = joined;
    }
}

/// Parts of a block, larger ones first, used to probe a drive that answers all of the block except one register.
fn parts(block: PlannedRead) -> Vec<PlannedRead> {
    let halves = |of: &[PlannedRead]| -> Vec<PlannedRead> {
        let halves = of.iter().filter_map(|part| Plan::halves(*part));
        halves.flat_map(|(low, high)| [low, high]).collect()
    };
    let halved = halves(&[block]);
    let quarters = halves(&halved);
    let eighths = halves(&quarters);
    [halved, quarters, eighths].concat()
}

/// The pause that follows this one between probes of a drive that stays offline.
fn doubled(pause: Duration) -> Duration {
    (pause * 2).min(PROBE_PAUSE.1)
}
