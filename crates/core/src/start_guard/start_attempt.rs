//! A start by an order: the motor goes from standstill to running, and further run commands have a special meaning
//! meanwhile. Pure: time is an argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::MotorReading;

/// If a motor is seen to start later than this after its word, the start counts from then, not from the word.
const STARTS_WITHIN: Duration = Duration::from_secs(30);
/// Time after the word that starts a motor for which the motor may still be read as standing.
pub(super) const SETTLES: Duration = Duration::from_secs(1);

/// Why a drive cannot start its motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unable {
    /// The drive has a fault.
    Fault,
    /// The drive reports that it is not ready. Some families become ready by the words of a start.
    NotReady,
}

/// Effect on the motor of a run command that is written now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ByRun {
    /// The run command changes nothing: the motor runs for certain.
    Runs,
    /// The repetition of a start that is in progress and already counted.
    Repeats,
    /// The repetition of a run command that the drive could not follow; it does not count while the drive cannot
    /// follow.
    Vain,
    /// The command starts the motor.
    Starts,
}

/// How far a start has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Progress {
    /// No reading shows the start yet.
    Awaited,
    /// The motor turns but does not count as running yet.
    Turns,
    /// The motor was seen running.
    Ran,
    /// The start is over: the motor is at standstill again, or the drive did not accept the command.
    Over,
    /// The drive could not start, and did not.
    Vain,
}

/// A start by an order, counted from the last word of the order.
#[derive(Debug, Clone)]
pub(super) struct StartAttempt {
    /// Number of the start's command.
    pub(super) number: u64,
    pub(super) client: Arc<str>,
    pub(super) progress: Progress,
    /// When the word of the start was written.
    pub(super) written: Instant,
    /// When a run command was last written: the word of the start or a repetition.
    pub(super) last: Instant,
    /// Time from which the start counts.
    pub(super) counted: Instant,
    /// The drive could not start before the word, nor in any reading since.
    pub(super) unable: bool,
    /// Whether the drive was offline since.
    pub(super) away: bool,
    /// Since when the motor had been standing before the start.
    pub(super) stood: Option<Instant>,
}

/// Effect of a reading of the running motor on the starts that count.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum StartEffect {
    /// The reading changes nothing.
    Nothing,
    /// The expected start happened.
    Started,
    /// The expected start happened so late that it counts from now on.
    StartedLate,
    /// A start that does not count yet, and the client that caused it, if known.
    Another(Option<Arc<str>>),
}

/// Other facts about the motor: its last stop, and the run command as the drive last reported it.
#[derive(Debug, Clone, Copy)]
pub(super) struct MotorFacts {
    pub(super) stop: Option<Instant>,
    pub(super) commanded: Option<(bool, Instant)>,
}

impl StartAttempt {
    fn is_stopped(&self, besides: MotorFacts) -> bool {
        besides.stop.is_some_and(|stop| stop > self.last)
    }

    /// Effect of a run command on a motor that may be standing.
    pub(super) fn by_run(&self, besides: MotorFacts) -> ByRun {
        // The run command was taken away since, at the drive itself or by another source.
        let is_off = besides.commanded.is_some_and(|(on, at)| !on && at > self.last);
        match self.progress {
            _ if self.is_stopped(besides) || self.away => ByRun::Starts,
            Progress::Vain => ByRun::Vain,
            Progress::Awaited => ByRun::Repeats,
            Progress::Turns | Progress::Ran if !is_off => ByRun::Repeats,
            Progress::Turns | Progress::Ran | Progress::Over => ByRun::Starts,
        }
    }

    /// Notes that the motor is seen to run; with `came`, the previous reading showed it not running.
    pub(super) fn is_seen_running(&mut self, came: bool, besides: MotorFacts, at: Instant) -> StartEffect {
        if self.progress == Progress::Over {
            return if came {
                StartEffect::Another(None)
            } else {
                StartEffect::Nothing
            };
        }
        let before = std::mem::replace(&mut self.progress, Progress::Ran);
        match before {
            Progress::Vain => return StartEffect::Another(Some(self.client.clone())),
            Progress::Awaited | Progress::Turns if came => {}
            _ => return StartEffect::Nothing,
        }
        let may_be_of_others = self.away || self.is_stopped(besides);
        if may_be_of_others && at > self.last + STARTS_WITHIN {
            return StartEffect::Another(None);
        }
        // The run command was on all the time, so the expected start happened.
        if at > self.counted + STARTS_WITHIN {
            StartEffect::StartedLate
        } else {
            StartEffect::Started
        }
    }

    /// Notes that the motor does not run. Returns whether this start failed, from this reading on.
    pub(super) fn is_seen_not_running(&mut self, seen: &MotorReading, besides: MotorFacts) -> bool {
        let before = self.progress;
        self.unable &= seen.unable.is_some();
        let has_fault = seen.unable.is_some_and(|(why, _)| why == Unable::Fault);
        self.progress = match before {
            Progress::Ran | Progress::Over => Progress::Over,
            Progress::Turns if seen.stands || has_fault => Progress::Over,
            Progress::Turns => Progress::Turns,
            Progress::Vain if seen.unable.is_some() => Progress::Vain,
            Progress::Vain => Progress::Over,
            Progress::Awaited => self.awaited(seen, besides),
        };
        before != Progress::Vain && self.progress == Progress::Vain
    }

    fn awaited(&self, seen: &MotorReading, besides: MotorFacts) -> Progress {
        let is_on = besides.commanded.is_some_and(|(on, at)| on && at > self.written);
        let shown = |is_shown: bool| if is_shown { Progress::Vain } else { Progress::Awaited };
        match seen.unable {
            Some((Unable::Fault, at)) if self.unable => shown(at > self.written),
            Some((Unable::NotReady, at)) if self.unable && seen.stands => shown(at >= self.written + SETTLES),
            // The motor may have started and the drive tripped at once.
            Some((Unable::Fault, at)) if at > self.written => Progress::Over,
            _ if !seen.stands => Progress::Turns,
            _ if self.is_stopped(besides) => Progress::Over,
            // The motor waits at a reference of zero, in sleep mode, or is blocked by a terminal.
            _ if is_on => Progress::Awaited,
            _ if seen.at >= self.last + SETTLES => Progress::Over,
            _ => Progress::Awaited,
        }
    }
}
