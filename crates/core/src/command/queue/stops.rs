//! Stops in the queue of a bus: ahead of everything, one that does nothing else and one that does for each drive, and what they
//! end. Pure: time is an argument.

use std::time::Instant;

use tokio::sync::oneshot;

use super::Pending;
use crate::command::{Command, Effect, Order, Origin, Outcome, SourceKind, Urgency};
use crate::drive::DriveIndex;

/// The wish of the gateway, which is about to end, that a bus stops its drives.
#[derive(Debug)]
pub struct Stopping {
    pub(super) deadline: Instant,
    pub(super) report: oneshot::Sender<Vec<NotStopped>>,
}

/// A drive that did not get, or did not acknowledge, the stop that the gateway wanted before it ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotStopped {
    /// Its name.
    pub drive: String,
    /// The result of the stop, in words.
    pub why: String,
}

impl std::fmt::Display for NotStopped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "`{}` {}", self.drive, self.why)
    }
}

impl Stopping {
    /// When the gateway ends all the same.
    pub fn deadline(&self) -> Instant {
        self.deadline
    }

    /// The bus has finished; `missing` are the drives that were not stopped.
    pub fn report(self, missing: Vec<NotStopped>) {
        // The gateway may have given up waiting.
        let _ = self.report.send(missing);
    }
}

impl Pending {
    /// Whether a stop waits until its motor has run for a time.
    pub(super) fn is_ordinary(&self, stop: &Command) -> bool {
        let origin = stop.ticket.origin();
        let delayed = matches!(
            origin.kind,
            SourceKind::ModbusTcp | SourceKind::Mqtt | SourceKind::Sparkplug | SourceKind::Bacnet | SourceKind::Slot
        );
        let last = self.stopped_at.get(&stop.drive).copied();
        let delayed = delayed && stop.urgency == Urgency::Stop && !stop.is_urgent;
        let guards = self.guards.as_ref().filter(|_| delayed);
        guards.is_some_and(|guards| guards.is_ordinary_stop(stop.drive, origin.client(), last)) || self.repeats(stop)
    }

    /// Whether a cyclic client gives its waiting ordinary stop again: that is no second stop.
    pub(super) fn repeats(&self, stop: &Command) -> bool {
        let origin = stop.ticket.origin();
        let waits = |c: &Command| c.is_ordinary && c.drive == stop.drive && c.order == stop.order;
        let own = |c: &Command| c.ticket.origin().client() == origin.client();
        let delayed = stop.urgency == Urgency::Stop && !stop.is_urgent;
        delayed && self.waiting.iter().any(|c| waits(c) && own(c)) && self.is_cyclic(origin)
    }

    /// Until when the stop that waits for that drive does so by `min_run`.
    pub fn stop_waits(&self, drive: DriveIndex, now: Instant) -> Option<Instant> {
        let guards = self.guards.as_ref()?;
        let ordinary = |c: &Command| c.is_ordinary && c.drive == drive;
        self.waiting
            .iter()
            .any(ordinary)
            .then(|| guards.stop_waits(drive, now))?
    }

    pub(super) fn note_stop(&mut self, drive: DriveIndex, by: Origin, now: Instant) {
        self.stopped_by.insert(drive, by);
        *self.stops.entry(drive).or_default() += 1;
        let at = self.stopped_at.entry(drive).or_insert(now);
        *at = now.max(*at);
    }

    /// Whether a stop arrived after a command's request began to arrive.
    pub(super) fn is_behind_its_stop(&self, command: &Command) -> bool {
        let stopped = |drive: &DriveIndex| {
            let at = self.stopped_at.get(drive).zip(command.asked);
            at.is_some_and(|(stopped, asked)| asked < *stopped) && !command.stops(*drive)
        };
        command.urgency == Urgency::Command && command.reach().iter().any(stopped)
    }

    /// Of each drive one stop waits that does nothing else, and one that does. Later ones join theirs if they ask for
    /// the same, and are answered with it; of two that also do different things, the newer one is sent.
    pub(super) fn push_stop(&mut self, stop: Command, now: Instant) {
        let drive = stop.drive;
        self.note_accepted(&stop, now);
        self.purge(drive, now);
        // A second stop waits for nothing, nor does the first one any more.
        if !stop.is_ordinary {
            let of_drive = |c: &&mut Command| c.drive == drive && c.urgency == Urgency::Stop;
            let others = self.waiting.iter_mut().filter(of_drive);
            others.for_each(|c| c.is_ordinary = false);
        }
        let bare = stop.is_bare_stop();
        let alike = |c: &&mut Command| c.drive == drive && c.urgency == Urgency::Stop && c.is_bare_stop() == bare;
        match self.waiting.iter_mut().find(alike) {
            Some(waiting) if waiting.order == stop.order => {
                waiting.joined.push((stop.ticket, stop.expires));
                waiting.joined.extend(stop.joined);
                return;
            }
            Some(_) => self.remove(now, &Outcome::Replaced, |c| {
                c.drive == drive && c.urgency == Urgency::Stop && c.is_bare_stop() == bare
            }),
            None => {}
        }
        self.waiting.push_back(stop);
    }

    /// A stop ends what waits for its drive, and what has started.
    fn purge(&mut self, drive: DriveIndex, now: Instant) {
        self.remove(now, &Outcome::Purged, |c| {
            c.reaches(drive) && c.urgency == Urgency::Command && !c.stops(drive)
        });
        if !self.stopped.contains(&drive) {
            self.stopped.push(drive);
        }
    }

    /// The number of the last command taken in that may start the drive; 0 where there was none.
    pub(crate) fn last_starter(&self, drive: DriveIndex) -> u64 {
        self.starters.get(&drive).copied().unwrap_or_default()
    }

    /// A stop joins one that was taken in when `last_starter` was that: it is noted as any stop, and nothing is written for it.
    /// Whether it may: no command was taken in since that may start the drive.
    pub(crate) fn joins_stop(&mut self, drive: DriveIndex, last_starter: u64, by: &Origin, now: Instant) -> bool {
        let is_served = self.closed.is_none() && !self.heirs.contains_key(&drive);
        if !is_served || self.last_starter(drive) != last_starter {
            return false;
        }
        self.note_stop(drive, by.clone(), now);
        self.hold_stopped(drive, by, now);
        let effect = Effect {
            run: Some(false),
            ..Effect::default()
        };
        self.priorities(drive).accepted(by, effect, None, now);
        self.purge(drive, now);
        true
    }

    /// Drives for which a stop arrived since the last call: their started commands end, whatever the result of the
    /// stop.
    pub fn take_stopped(&mut self) -> Vec<DriveIndex> {
        std::mem::take(&mut self.stopped)
    }

    /// Withdraws a supervision action that has not started: a client commands the drive again.
    pub fn withdraw_supervision(&mut self, drive: DriveIndex, now: Instant) {
        self.remove(now, &Outcome::Withdrawn, |c| {
            c.drive == drive && c.joined.is_empty() && c.ticket.origin().is_lease()
        });
    }

    /// Stops of that drive that were taken in so far, also by the bus before a reload.
    pub fn stops(&self, drive: DriveIndex) -> u64 {
        self.stops.get(&drive).copied().unwrap_or_default()
    }

    /// Who gave the last stop of that drive that was taken in.
    pub(crate) fn last_stop_by(&self, drive: DriveIndex) -> Option<&Origin> {
        self.stopped_by.get(&drive)
    }

    /// The stops that the gateway wants before it ends, once.
    pub fn take_stopping(&mut self) -> Option<Stopping> {
        self.stopping.take()
    }
}

impl Command {
    /// A stop that does nothing but take the run command away.
    pub(super) fn is_bare_stop(&self) -> bool {
        match &self.order {
            Order::Points(values) => values.len() == 1,
            Order::Write(_) | Order::Read(_) | Order::Parameter(_) => false,
        }
    }
}
