//! What a bus of N2 says to a drive beside reading and commanding it (n2.md 2 and 4). Pure: time is an argument.
//!
//! A drive that has started anew answers nothing before it is identified; then it reports, to polls, all it has. So a
//! drive is identified first, its report is taken (and thrown away: the layout is not known, values are read), then it
//! is read. `N00` at any time means that it has started anew: the same again.
//!
//! A reply names neither drive nor request. After an exchange that was not answered, or not believably, a late value of
//! one drive could pass for that of another. So the whole line has a fence then: it rests for the time of another reply,
//! and the next thing said, to whichever drive, is Identify, whose answer no float and no acknowledgement looks like. A
//! state does (a byte of 10h), and a late identity looks like a state; so a poll comes behind, whose answer is neither.
//! A stop does not wait for that: its acknowledgement is not taken for true, it goes out once more.

use std::time::Instant;

use super::transaction::Ended;
use crate::codec::n2::{N2Options, Session};
use crate::codec::{Exception, Reply};
use crate::command::Urgency;

/// Polls in which a drive has to tell all its changes.
pub const MOST_POLLS: u8 = 16;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Identified never, or not since it went away.
    Unknown,
    /// It has said that it waits for Identify.
    Waiting,
    /// It reports what has changed: polls left, and whether the next one acknowledges the report before.
    Reporting { left: u8, again: bool },
    /// It is read and commanded.
    Ready,
}

/// What has to be answered in its own form before an answer on the line is believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Fence {
    /// Nothing: no answer is owed.
    #[default]
    Open,
    /// Identify, and a poll behind it.
    Identify,
    /// A poll.
    Poll,
}

#[derive(Debug, Clone)]
struct Drive {
    options: N2Options,
    phase: Phase,
    /// A stop went out behind such an exchange and was acknowledged, perhaps late and by mistake.
    stop_repeated: bool,
    polled: Option<Instant>,
    /// It answered something since it was identified.
    proved: bool,
    /// The device type that was told last.
    device: Option<u8>,
}

/// What came of an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// What is due next is decided anew.
    Going,
    /// The drive is of another type than its profile says; told once.
    Unlike(u8),
    /// Something has changed: the drive is to be read.
    Changed,
    /// The drive has started anew.
    Restarted,
    /// It did not answer to be believed.
    Failed,
}

/// The sessions with the drives of a bus; none on a bus of another protocol.
#[derive(Debug, Default)]
pub struct Sessions {
    drives: Vec<Drive>,
    /// Of the line, not of a drive: the answer that is owed could pass for that of any drive.
    fence: Fence,
    /// Until then the line rests: what comes meanwhile is nobody's answer.
    rest: Option<Instant>,
}

impl Sessions {
    /// Sessions with drives of these options.
    pub fn new(drives: impl IntoIterator<Item = N2Options>) -> Sessions {
        let drive = |options: N2Options| Drive {
            phase: first(&options),
            options,
            stop_repeated: false,
            polled: None,
            proved: false,
            device: None,
        };
        Sessions {
            drives: drives.into_iter().map(drive).collect(),
            ..Sessions::default()
        }
    }

    /// Whether the bus has sessions at all.
    pub fn is_empty(&self) -> bool {
        self.drives.is_empty()
    }

    /// What must be said to the drive before it is read (`None`) or commanded.
    pub fn before(&mut self, drive: usize, command: Option<Urgency>, now: Instant) -> Option<Session> {
        let fence = self.fence;
        let drive = self.drives.get_mut(drive)?;
        let fenced = drive.options.identify && command != Some(Urgency::Stop);
        if (fenced && fence == Fence::Identify) || matches!(drive.phase, Phase::Unknown | Phase::Waiting) {
            return Some(Session::Identify);
        }
        let fenced = fenced && fence == Fence::Poll;
        if command.is_some() && !fenced {
            return None;
        }
        if drive.phase == Phase::Ready && (fenced || drive.is_due(now)) {
            drive.report();
        }
        match drive.phase {
            Phase::Reporting { again, .. } => Some(Session::Poll { again }),
            _ => None,
        }
    }

    /// A step that [`Sessions::before`] gave is over.
    pub fn done(&mut self, drive: usize, step: Session, ended: &Ended, now: Instant) -> Progress {
        let heard = self.heard(drive, ended);
        let (Progress::Going, Ended::Reply(reply)) = (heard, ended) else {
            return if step == Session::Identify {
                Progress::Failed
            } else {
                heard
            };
        };
        if self.is_late_identity(step, reply) {
            self.raise();
            return Progress::Failed;
        }
        self.fence = match (self.fence, step) {
            (Fence::Identify, Session::Identify) => Fence::Poll,
            (Fence::Poll, Session::Poll { .. }) => Fence::Open,
            (fence, _) => fence,
        };
        let Some(drive) = self.drives.get_mut(drive) else {
            return Progress::Failed;
        };
        match (step, reply) {
            (Session::Identify, reply) => drive.identified(reply),
            (_, Reply::Changes(digits)) => drive.reported(!digits.is_empty(), now),
            // A drive that knows no polls, or no reports, is read all the same.
            _ => drive.reported(false, now),
        }
    }

    /// Whether the answer to a poll behind a fence is that to an Identify which was thought to be answered.
    fn is_late_identity(&self, step: Session, reply: &Reply) -> bool {
        let (Fence::Poll, Session::Poll { .. }, Reply::Changes(digits)) = (self.fence, step, reply) else {
            return false;
        };
        let told = |device: u8| digits.eq_ignore_ascii_case(format!("{device:02X}").as_bytes());
        let mut drives = self.drives.iter();
        drives.any(|drive| told(drive.options.device_type) || drive.device.is_some_and(told))
    }

    /// An answer is owed, or one came that nobody asked for.
    fn raise(&mut self) {
        self.fence = Fence::Identify;
        for drive in &mut self.drives {
            drive.stop_repeated = false;
        }
    }

    /// Any exchange with the drive is over; [`Progress::Failed`] where it was refused though just identified.
    pub fn heard(&mut self, drive: usize, ended: &Ended) -> Progress {
        if matches!(ended, Ended::Silent | Ended::Corrupt(_)) {
            if self.drives.is_empty() {
                return Progress::Going;
            }
            self.raise();
            return Progress::Failed;
        }
        let Some(drive) = self.drives.get_mut(drive) else {
            return Progress::Going;
        };
        match ended {
            Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => {
                let known = drive.proved;
                drive.phase = Phase::Waiting;
                drive.proved = false;
                if known { Progress::Restarted } else { Progress::Failed }
            }
            Ended::Reply(Reply::Identified(_)) => Progress::Going,
            _ => {
                drive.proved = true;
                Progress::Going
            }
        }
    }

    /// Characters came that nobody asked for: perhaps the answer to what was asked last.
    pub fn strayed(&mut self) {
        if !self.drives.is_empty() {
            self.raise();
        }
    }

    /// The drive owes an answer, which may come until then. A drive that is known to be away owes none, so that it does
    /// not cost the others more than its probes.
    pub fn owes(&mut self, drive: usize, until: Instant) {
        if self.drives.get(drive).is_some_and(|drive| drive.proved) {
            self.rest = self.rest.max(Some(until));
        }
    }

    /// Whether an answer is owed, so that what cannot be believed may be that one.
    pub fn is_fenced(&self) -> bool {
        self.fence != Fence::Open
    }

    /// Until when nothing but a stop goes on the line.
    pub fn rest(&self) -> Option<Instant> {
        self.rest
    }

    /// Whether the acknowledgement of a stop proves nothing, because it may be that of what was not answered before.
    /// The stop goes out once more, and only once.
    pub fn doubts_stop(&mut self, drive: usize) -> bool {
        let fenced = self.is_fenced();
        let Some(drive) = self.drives.get_mut(drive) else {
            return false;
        };
        let doubted = fenced && !drive.stop_repeated;
        drive.stop_repeated = doubted;
        doubted
    }

    /// Drives that are due for a poll and would not be asked otherwise, because nothing of them is read so often.
    pub fn neglected(&self, now: Instant) -> impl Iterator<Item = usize> {
        let due = move |drive: &Drive| drive.phase == Phase::Ready && drive.polled.is_some() && drive.is_due(now);
        let drives = self.drives.iter().enumerate();
        drives.filter(move |(_, drive)| due(drive)).map(|(index, _)| index)
    }

    /// The drive does not answer any more: it is asked again by Identify.
    pub fn gone(&mut self, drive: usize) {
        if let Some(drive) = self.drives.get_mut(drive) {
            drive.phase = first(&drive.options);
            drive.proved = false;
            drive.polled = None;
        }
    }

    /// The port was lost: all drives are found anew.
    pub fn reset(&mut self) {
        (0..self.drives.len()).for_each(|drive| self.gone(drive));
        self.fence = Fence::Open;
        self.rest = None;
    }
}

fn first(options: &N2Options) -> Phase {
    if options.identify { Phase::Unknown } else { Phase::Ready }
}

impl Drive {
    fn is_due(&self, now: Instant) -> bool {
        let since = |at| now.saturating_duration_since(at);
        self.polled.is_none_or(|at| since(at) >= self.options.poll)
    }

    /// The drive is asked what has changed.
    fn report(&mut self) {
        self.phase = Phase::Reporting {
            left: MOST_POLLS,
            again: false,
        };
    }

    fn identified(&mut self, reply: &Reply) -> Progress {
        match self.phase {
            Phase::Unknown | Phase::Waiting => self.report(),
            // What is acknowledged may never have come.
            Phase::Reporting { left, .. } => self.phase = Phase::Reporting { left, again: false },
            Phase::Ready => {}
        }
        // One that refuses to be identified is there all the same.
        let Reply::Identified(device) = reply else {
            return Progress::Going;
        };
        let before = self.device.replace(*device);
        if *device != self.options.device_type && before != Some(*device) {
            Progress::Unlike(*device)
        } else {
            Progress::Going
        }
    }

    fn reported(&mut self, changes: bool, now: Instant) -> Progress {
        let left = match self.phase {
            Phase::Reporting { left, .. } => left.saturating_sub(1),
            _ => 0,
        };
        if changes && left > 0 {
            self.phase = Phase::Reporting { left, again: true };
            return Progress::Going;
        }
        self.phase = Phase::Ready;
        self.polled = Some(now);
        // The last poll of a series tells of all of it.
        if left + 1 < MOST_POLLS {
            Progress::Changed
        } else {
            Progress::Going
        }
    }
}

#[cfg(test)]
mod tests;
