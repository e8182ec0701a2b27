//! Messages of an N2 bus to a drive other than reads and commands (reference/n2.md 2 and 4). Pure: time is an argument.
//!
//! N2 sessions. A drive that has restarted answers nothing before it is identified; then it reports all its values
//! in reply to polls. So a drive is first identified, then its reports are fetched (and discarded: their layout is
//! unknown, values are read), and then it is read. `N00` at any time means that the drive has restarted, so the
//! session begins again.
//!
//! `n2_late_replies` recognises late replies; this module only follows sessions.

use std::time::Instant;

use super::transaction::Ended;
use drivegate_core::order::Urgency;
use drivegate_model::drive::{DriveIndex, PerDrive};
use drivegate_proto::n2::{N2Options, Session};
use drivegate_proto::{Exception, Reply};

/// Number of polls within which a drive must have reported all its changes.
pub const MOST_POLLS: u8 = 16;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// The drive was never identified, or not since it went offline.
    Unknown,
    /// The drive has reported that it waits for Identify.
    Waiting,
    /// The drive is reporting its changes: number of polls left, and whether the next one acknowledges the previous report.
    Reporting { left: u8, again: bool },
    /// The drive can be read and commanded.
    Ready,
}

#[derive(Debug, Clone)]
struct Drive {
    options: N2Options,
    phase: Phase,
    polled: Option<Instant>,
    /// Whether the last request was Identify, and had no reply.
    silent: bool,
    /// Whether the drive has replied since it was identified.
    proved: bool,
    /// The device type that was reported last.
    device: Option<u8>,
    /// Whether the drive has replied to another request since it reported this device type. Otherwise the report may
    /// have been the late reply of another drive.
    device_proved: bool,
}

/// The effect of a transaction on the session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// The session continues; the next step is chosen again.
    Going,
    /// The drive has another device type than its profile; reported once.
    Unlike(u8),
    /// The drive reported a change, so it must be read.
    Changed,
    /// The drive has restarted.
    Restarted,
    /// The drive gave no valid reply.
    Failed,
}

/// The sessions with the drives of a bus; empty on a bus of another protocol.
#[derive(Debug, Default)]
pub struct N2Sessions {
    drives: PerDrive<Drive>,
}

impl N2Sessions {
    /// Sessions with drives that have these options.
    pub fn new(drives: impl IntoIterator<Item = N2Options>) -> N2Sessions {
        let drive = |options: N2Options| Drive {
            phase: first(&options),
            options,
            polled: None,
            silent: false,
            proved: false,
            device: None,
            device_proved: false,
        };
        N2Sessions {
            drives: drives.into_iter().map(drive).collect(),
        }
    }

    /// Whether the bus has sessions at all.
    pub fn is_empty(&self) -> bool {
        self.drives.is_empty()
    }

    /// The step that the drive needs before a read (`None`) or a command. A stop to a drive that was
    /// there and does not reply to Identify is sent all the same, by turns with Identify: perhaps only the drive's replies are
    /// lost, and its motor runs.
    pub fn before(&mut self, drive: DriveIndex, command: Option<Urgency>, now: Instant) -> Option<Session> {
        let drive = self.drives.get_mut(drive)?;
        if matches!(drive.phase, Phase::Unknown | Phase::Waiting) {
            let is_stop = command == Some(Urgency::Stop);
            let goes_first = is_stop && drive.silent && drive.device_proved;
            return (!goes_first).then_some(Session::Identify);
        }
        if command.is_some() {
            return None;
        }
        if drive.phase == Phase::Ready && drive.is_due(now) {
            drive.report();
        }
        match drive.phase {
            Phase::Reporting { again, .. } => Some(Session::Poll { again }),
            _ => None,
        }
    }

    /// Whether a drive that was there must be identified before it can be read.
    pub(crate) fn waits_for_identify(&self, drive: DriveIndex) -> bool {
        let drive = self.drives.get(drive);
        drive.is_some_and(|drive| drive.device_proved && matches!(drive.phase, Phase::Unknown | Phase::Waiting))
    }

    /// A step returned by [`N2Sessions::before`] has ended.
    pub fn done(&mut self, drive: DriveIndex, step: Session, ended: &Ended, now: Instant) -> Progress {
        let heard = self.transaction_ended(drive, ended);
        if step == Session::Identify
            && let Some(drive) = self.drives.get_mut(drive)
        {
            drive.silent = *ended == Ended::Silent;
        }
        let (Progress::Going, Ended::Reply(reply)) = (heard, ended) else {
            return if step == Session::Identify {
                Progress::Failed
            } else {
                heard
            };
        };
        let Some(drive) = self.drives.get_mut(drive) else {
            return Progress::Failed;
        };
        match (step, reply) {
            (Session::Identify, reply) => drive.identified(reply),
            (_, Reply::Changes(digits)) => drive.reported(!digits.is_empty(), now),
            // A drive without polls, or without reports, is still read.
            _ => drive.reported(false, now),
        }
    }

    /// Notes the end of any transaction with the drive; [`Progress::Failed`] if it was refused although the drive
    /// was just identified.
    pub fn transaction_ended(&mut self, drive: DriveIndex, ended: &Ended) -> Progress {
        if let Some(drive) = self.drives.get_mut(drive) {
            drive.silent = false;
        }
        if matches!(ended, Ended::Silent | Ended::Corrupt(_)) {
            if *ended == Ended::Silent && self.seemed_identified(drive) {
                self.gone(drive);
            }
            return if self.drives.is_empty() {
                Progress::Going
            } else {
                Progress::Failed
            };
        }
        let Some(drive) = self.drives.get_mut(drive) else {
            return Progress::Going;
        };
        match ended {
            Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => {
                let known = drive.proved;
                drive.phase = Phase::Waiting;
                drive.unproved();
                if known { Progress::Restarted } else { Progress::Failed }
            }
            Ended::Reply(Reply::Identified(_)) => Progress::Going,
            _ => {
                (drive.proved, drive.device_proved) = (true, true);
                Progress::Going
            }
        }
    }

    /// Whether the drive was identified, and has not replied to anything since: the identity may have been the late reply
    /// of another drive.
    fn seemed_identified(&self, drive: DriveIndex) -> bool {
        let drive = self.drives.get(drive);
        drive.is_some_and(|drive| !drive.proved && matches!(drive.phase, Phase::Reporting { .. }))
    }

    /// Drives that are due for a poll and would get no other request, because none of their points is read often enough.
    pub(crate) fn neglected(&self, now: Instant) -> impl Iterator<Item = DriveIndex> {
        let due = move |drive: &Drive| drive.phase == Phase::Ready && drive.polled.is_some() && drive.is_due(now);
        let drives = self.drives.enumerate();
        drives.filter(move |(_, drive)| due(drive)).map(|(index, _)| index)
    }

    /// Notes that the drive no longer replies, so that it must be identified again.
    pub fn gone(&mut self, drive: DriveIndex) {
        if let Some(drive) = self.drives.get_mut(drive) {
            drive.phase = first(&drive.options);
            drive.unproved();
            drive.polled = None;
        }
    }

    /// The device type that the drive reported or, if it has not reported one, the expected device type.
    pub fn device(&self, drive: DriveIndex) -> u8 {
        let drive = self.drives.get(drive);
        drive.map_or(0, |drive| drive.device.unwrap_or(drive.options.device_type))
    }

    /// The port was lost: all drives must be found again.
    pub fn reset(&mut self) {
        self.drives.indexes().for_each(|drive| self.gone(drive));
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

    /// The drive must be identified again. A device type that nothing has confirmed is forgotten: late replies to
    /// Identify would be recognised by it, and the states of other drives mistaken for them.
    fn unproved(&mut self) {
        self.proved = false;
        if !self.device_proved {
            self.device = None;
        }
    }

    /// Starts to poll the drive for changes.
    fn report(&mut self) {
        self.phase = Phase::Reporting {
            left: MOST_POLLS,
            again: false,
        };
    }

    fn identified(&mut self, reply: &Reply) -> Progress {
        match self.phase {
            Phase::Unknown | Phase::Waiting => self.report(),
            // An acknowledged message may never have arrived.
            Phase::Reporting { left, .. } => self.phase = Phase::Reporting { left, again: false },
            Phase::Ready => {}
        }
        // A drive that refuses to be identified is present nevertheless.
        let Reply::Identified(device) = reply else {
            return Progress::Going;
        };
        let before = self.device.replace(*device);
        self.device_proved &= before == Some(*device);
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
        // A whole series of polls counts as changed only once.
        if left + 1 < MOST_POLLS {
            Progress::Changed
        } else {
            Progress::Going
        }
    }
}

#[cfg(test)]
mod tests;
