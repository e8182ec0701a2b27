//! The state of one motor, and when the motor may be started. Pure: time is an argument.
//!
//! A start is one change of the motor from standing to running. The start of an order counts from before its word
//! is written, and only once, however often the order is repeated until the motor was seen to stand again.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::start_attempt::{ByRun, MotorFacts, Progress, SETTLES, StartAttempt, StartEffect};
use super::{Guard, Guarded, MOST_STARTS, Reason, Unable, shown};

/// The time window of `starts_per_hour`.
pub(super) const HOUR: Duration = Duration::from_secs(3600);
/// Time after its start for which a motor counts as running without a reading.
const UNREAD: Duration = Duration::from_secs(2);

/// The motor's state in a reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MotorReading {
    /// Whether the motor runs, without a fault.
    pub running: bool,
    /// Run command as the drive has it, and when that was read.
    pub commanded: Option<(bool, Instant)>,
    /// Whether the motor is at standstill.
    pub stands: bool,
    /// Why the motor does not run and cannot start, and when that was read.
    pub unable: Option<(Unable, Instant)>,
    /// When the state was read.
    pub at: Instant,
}

/// A start that is decided and not written yet.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reserved {
    /// The number of the command.
    pub(super) number: u64,
    pub(super) at: Instant,
    /// The start is not written after this time.
    pub(super) until: Instant,
    /// The generation that must be saved first.
    pub(super) generation: u64,
}

/// The last start of the motor, kept until the motor is seen to stand.
#[derive(Debug, Clone)]
struct Started {
    at: Instant,
    /// The client that commanded the start.
    by: Option<Arc<str>>,
}

/// A motor with the record of its starts.
#[derive(Debug, Clone, Default)]
pub(super) struct Motor {
    /// The last starts, oldest first.
    starts: VecDeque<Instant>,
    pub(super) reserved: Option<Reserved>,
    /// The last start by an order.
    passage: Option<StartAttempt>,
    /// Whether the motor runs, and when that was read; `None` if unknown.
    running: Option<(bool, Instant)>,
    /// Whether the motor ran when its state was last known.
    ran: Option<bool>,
    /// Run command as the drive had it last, and when that was read.
    commanded: Option<(bool, Instant)>,
    /// Whether the motor, by its last reading, does not run and cannot start.
    unable: bool,
    stands_since: Option<Instant>,
    stop_written: Option<Instant>,
    started: Option<Started>,
}

impl Motor {
    /// Starts of the last hour, one that is decided included.
    pub(super) fn starts(&self) -> impl Iterator<Item = Instant> + '_ {
        let reserved = self.reserved.map(|reserved| reserved.at);
        self.starts.iter().copied().chain(reserved)
    }

    /// The starts to save; a reserved one with the latest time at which it may be written.
    pub(super) fn starts_to_keep(&self) -> impl Iterator<Item = Instant> + '_ {
        let reserved = self.reserved.map(|reserved| reserved.until);
        self.starts.iter().copied().chain(reserved)
    }

    /// Effect of a run command that is written now.
    pub(super) fn by_run(&self) -> ByRun {
        if self.runs_for_certain() {
            return ByRun::Runs;
        }
        let passage = self.passage.as_ref();
        passage.map_or(ByRun::Starts, |passage| passage.by_run(self.besides()))
    }

    fn besides(&self) -> MotorFacts {
        MotorFacts {
            stop: self.stop_written,
            commanded: self.commanded,
        }
    }

    /// When the word of the last start by an order was written.
    fn written(&self) -> Option<Instant> {
        self.passage.as_ref().map(|passage| passage.written)
    }

    /// Whether the motor runs and will continue to run. A motor that slows down after a stop may stand by the time
    /// an order reaches it.
    fn runs_for_certain(&self) -> bool {
        let since_stop = |at: Instant| self.stop_written.is_none_or(|stop| at > stop);
        let written = self.written();
        let stopped_last = self
            .stop_written
            .is_some_and(|stop| written.is_none_or(|start| stop > start));
        let told_on = self.commanded.is_some_and(|(on, at)| on && since_stop(at));
        // The run command was taken away since the start was written, by the gateway or elsewhere.
        let is_off = |(on, at): (bool, Instant)| !on && written.is_none_or(|start| at > start);
        let slows_down = (stopped_last && !told_on) || self.commanded.is_some_and(is_off);
        let runs = |(running, at): (bool, Instant)| running && since_stop(at) && !slows_down;
        self.running.is_some_and(runs)
    }

    /// Whether the start of that command is decided, or written.
    pub(super) fn is_cleared(&self, number: u64) -> bool {
        let reserved = self.reserved.is_some_and(|reserved| reserved.number == number);
        reserved || self.passage.as_ref().is_some_and(|passage| passage.number == number)
    }

    /// Why the motor must not be started now, apart from the interval within its group.
    pub(super) fn hindered(&self, guard: &Guard, now: Instant) -> Option<Guarded> {
        self.too_often(guard, now)
            .into_iter()
            .chain(self.too_soon(guard, now))
            .max_by_key(|wait| wait.retry_after)
    }

    fn too_often(&self, guard: &Guard, now: Instant) -> Option<Guarded> {
        let most = usize::try_from(guard.starts_per_hour?).ok()?;
        let within: Vec<Instant> = self.starts().filter(|at| *at + HOUR > now).collect();
        // The oldest of the last `most` starts leaves the window first.
        let oldest = within.len().checked_sub(most).and_then(|place| within.get(place))?;
        let retry_after = (*oldest + HOUR).saturating_duration_since(now);
        Some(Guarded {
            reason: Reason::StartsPerHour,
            why: format!(
                "{} starts within the last hour, and {most} are allowed (guard.starts_per_hour); it may start in {}",
                within.len(),
                shown(retry_after)
            ),
            retry_after,
        })
    }

    fn too_soon(&self, guard: &Guard, now: Instant) -> Option<Guarded> {
        if guard.min_off.is_zero() {
            return None;
        }
        let (since, retry_after) = match self.stands_since {
            Some(since) => ("", (since + guard.min_off).saturating_duration_since(now)),
            None => (", and has not been seen stopped yet", guard.min_off),
        };
        (!retry_after.is_zero()).then(|| Guarded {
            reason: Reason::MinOff,
            why: format!(
                "the motor must be stopped for {} before a start (guard.min_off){since}; it may start in {}",
                shown(guard.min_off),
                shown(retry_after)
            ),
            retry_after,
        })
    }

    fn count(&mut self, at: Instant) {
        if self.starts.len() >= MOST_STARTS as usize {
            self.starts.pop_front();
        }
        self.starts.push_back(at);
    }

    fn discount(&mut self, at: Instant) {
        if let Some(place) = self.starts.iter().rposition(|start| *start == at) {
            self.starts.remove(place);
        }
    }

    /// Reserves a cleared start.
    pub(super) fn reserve(&mut self, reserved: Reserved) {
        self.settle();
        self.reserved = Some(reserved);
    }

    /// Counts cleared starts as made, whatever their result.
    pub(super) fn settle(&mut self) {
        if let Some(reserved) = self.reserved.take() {
            self.count(reserved.at);
        }
    }

    /// Notes that a word of a command that would start a motor at standstill is being sent. Returns whether this is a start.
    pub(super) fn start_written(&mut self, number: u64, client: &Arc<str>, now: Instant) -> bool {
        let is_next = self.reserved.take_if(|reserved| reserved.number == number).is_some();
        match &mut self.passage {
            _ if is_next => {}
            // Another word of the same start, or a repetition of its last word, moves the start to now.
            Some(passage) if passage.number == number && passage.progress != Progress::Vain => {
                let counted = passage.counted;
                self.discount(counted);
            }
            // The word repeats the same start.
            Some(passage) => {
                passage.last = now;
                return false;
            }
            None => return false,
        }
        self.count(now);
        let same = self.passage.take().filter(|_| !is_next);
        self.passage = Some(StartAttempt {
            number,
            client: client.clone(),
            progress: Progress::Awaited,
            written: now,
            last: now,
            counted: now,
            unable: same.as_ref().map_or(self.unable, |same| same.unable),
            away: false,
            stood: same.map_or(self.stands_since, |same| same.stood),
        });
        // Before the next start the motor must be seen to stand again, even if it was never seen to run.
        self.stands_since = None;
        self.started = Some(Started {
            at: now,
            by: Some(client.clone()),
        });
        true
    }

    /// Notes that the drive acknowledged a start; for a drive that does not report whether it runs, this is the
    /// only sign of it.
    pub(super) fn start_acknowledged(&mut self, now: Instant) {
        (self.running, self.ran, self.stands_since) = (Some((true, now)), Some(true), None);
        self.progresses(Progress::Ran);
    }

    /// Notes that a stop is being sent.
    pub(super) fn stop_written(&mut self, now: Instant) {
        self.stop_written = Some(now);
    }

    /// The drive acknowledged the stop, so the motor counts as stopped.
    pub(super) fn stop_acknowledged(&mut self, now: Instant) {
        (self.running, self.ran, self.started) = (Some((false, now)), Some(false), None);
        self.stands_since.get_or_insert(now);
        self.progresses(Progress::Over);
    }

    fn progresses(&mut self, to: Progress) {
        if let Some(passage) = &mut self.passage {
            passage.progress = to;
        }
    }

    /// Processes a reading of the motor. Returns whether it changed which starts count, or from when.
    pub(super) fn seen(&mut self, seen: MotorReading) -> bool {
        let MotorReading {
            running, stands, at, ..
        } = seen;
        self.commanded = seen.commanded.or(self.commanded);
        let written = self.written();
        if [written, self.stop_written]
            .into_iter()
            .flatten()
            .any(|write| at <= write)
        {
            // The reading is from before the last write.
            return false;
        }
        let came = running && self.ran == Some(false);
        (self.running, self.ran) = (Some((running, at)), Some(running));
        self.unable = seen.unable.is_some();
        if running {
            self.stands_since = None;
            return self.is_seen_running(came, at);
        }
        if stands && written.is_none_or(|written| at >= written + SETTLES) {
            self.stands_since.get_or_insert(at);
        }
        if self.started.as_ref().is_some_and(|started| at > started.at + UNREAD) {
            self.started = None;
        }
        self.is_seen_not_running(&seen)
    }

    fn is_seen_running(&mut self, came: bool, at: Instant) -> bool {
        let besides = self.besides();
        let Some(passage) = &mut self.passage else {
            return came && self.counts_seen(None, at);
        };
        match passage.is_seen_running(came, besides, at) {
            StartEffect::Nothing => false,
            StartEffect::Started => {
                let by = Some(passage.client.clone());
                self.started.get_or_insert(Started { at, by });
                false
            }
            StartEffect::StartedLate => {
                let counted = std::mem::replace(&mut passage.counted, at);
                let by = Some(passage.client.clone());
                self.discount(counted);
                self.counts_seen(by, at)
            }
            StartEffect::Another(by) => self.counts_seen(by, at),
        }
    }

    fn counts_seen(&mut self, by: Option<Arc<str>>, at: Instant) -> bool {
        self.count(at);
        self.started = Some(Started { at, by });
        true
    }

    /// The motor does not run. Whether a start does not count any more.
    fn is_seen_not_running(&mut self, seen: &MotorReading) -> bool {
        let besides = self.besides();
        let Some(passage) = self.passage.as_mut() else {
            return false;
        };
        if !passage.is_seen_not_running(seen, besides) {
            return false;
        }
        let (counted, stood) = (passage.counted, passage.stood);
        self.discount(counted);
        self.stands_since = stood.or(self.stands_since);
        self.started = None;
        true
    }

    /// The drive cannot be read, so the state of the motor is unknown.
    pub(super) fn unseen(&mut self) {
        (self.running, self.unable) = (None, false);
    }

    /// Notes that the drive is offline: its motor may run and stop again unseen.
    pub(super) fn note_offline(&mut self) {
        (self.running, self.unable, self.stands_since) = (None, false, None);
        if let Some(passage) = &mut self.passage {
            passage.away = true;
        }
    }

    /// Notes that no reading shows whether the motor runs; from now on the motor counts as standing.
    pub(super) fn begin_unreported(&mut self, now: Instant) {
        if self.running.is_none() {
            self.stands_since.get_or_insert(now);
        }
    }

    /// Whether a stop of this client is an ordinary one: the first since its own order started the motor.
    pub(super) fn is_ordinary_stop(&self, client: &str, last_stop: Option<Instant>) -> bool {
        let own = |started: &Started| started.by.as_deref() == Some(client);
        let first = |started: &Started| last_stop.is_none_or(|stop| stop < started.at);
        self.started
            .as_ref()
            .is_some_and(|started| own(started) && first(started))
    }

    /// Time until which an ordinary stop waits; `None` if it is not certain that the motor runs.
    pub(super) fn stop_waits(&self, guard: &Guard, now: Instant) -> Option<Instant> {
        let started = self.started.as_ref()?;
        let runs = match self.running {
            Some((running, at)) if at > started.at => running,
            _ => now < started.at + UNREAD,
        };
        Some(started.at + guard.min_run).filter(|until| runs && *until > now)
    }

    /// Adds the starts of an earlier run of the gateway.
    pub(super) fn remember(&mut self, earlier: impl Iterator<Item = Instant>) {
        let mut all: Vec<Instant> = earlier.chain(self.starts.iter().copied()).collect();
        all.sort();
        let spare = all.len().saturating_sub(MOST_STARTS as usize);
        self.starts = all.into_iter().skip(spare).collect();
    }

    /// Whether the motor had no start in the last hour.
    pub(super) fn is_forgotten(&self, now: Instant) -> bool {
        self.starts().all(|at| at + HOUR <= now)
    }
}

#[cfg(test)]
mod tests;
