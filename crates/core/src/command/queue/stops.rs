//! Stops in the queue of a bus: ahead of everything, one that does nothing else and one that does for each drive, and what they
//! end. Pure: time is an argument.

use std::time::Instant;

use tokio::sync::oneshot;

use super::Pending;
use crate::command::{Command, Order, Origin, Outcome, SourceKind, Urgency};
use crate::drive::DriveIndex;
use crate::order::{Connection, LastStops};

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
        let last = self.last_stops.get(&stop.drive).and_then(LastStops::at);
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

    /// Keeps which drives a command stops, for the orders that were given before.
    pub(super) fn note_stops(&mut self, command: &Command, now: Instant) {
        let origin = command.ticket.origin();
        if command.urgency == Urgency::Stop {
            self.stopped_by.insert(command.drive, origin.clone());
            *self.stops.entry(command.drive).or_default() += 1;
        }
        let arrival = command.arrival.as_ref();
        let connection = arrival.map_or_else(|| Connection::opened(now), |arrival| arrival.connection.clone());
        for drive in command.reach().iter().filter(|drive| command.stops(**drive)) {
            if !self.repeats_its_word(*drive, origin) {
                self.last_stops.entry(*drive).or_default().note(&connection, now);
            }
        }
    }

    /// Of each drive one stop waits that does nothing else, and one that does. Later ones join theirs if they ask for
    /// the same, and are answered with it; of two that also do different things, the newer one is sent.
    pub(super) fn push_stop(&mut self, stop: Command, now: Instant) {
        let drive = stop.drive;
        self.note_accepted(&stop, now);
        self.remove(now, &Outcome::Purged, |c| {
            c.reaches(drive) && c.urgency == Urgency::Command && !c.stops(drive)
        });
        if !self.stopped.contains(&drive) {
            self.stopped.push(drive);
        }
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
