//! Stops in the queue of a bus: they go ahead of everything, at most two wait for each drive (one bare, one with
//! more values), and they end other commands. Pure: time is an argument.

use std::time::Instant;

use tokio::sync::oneshot;

use super::Pending;
use crate::order::{Command, Haste, Order, Origin, Outcome, Work};
use drivegate_model::drive::DriveIndex;

/// The wish of the gateway, which is about to end, that a bus stops its drives.
#[derive(Debug)]
pub struct Stopping {
    pub(super) deadline: Instant,
    pub(super) report: oneshot::Sender<Vec<NotStopped>>,
}

/// A drive that did not get, or did not acknowledge, the stop that the gateway required before it ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotStopped {
    /// Name of the drive.
    pub drive: String,
    /// The result of the stop, as text.
    pub why: String,
}

impl std::fmt::Display for NotStopped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "`{}` {}", self.drive, self.why)
    }
}

impl Stopping {
    /// When the gateway ends even without all stops.
    pub fn deadline(&self) -> Instant {
        self.deadline
    }

    /// The bus has finished; `missing` are the drives that were not stopped.
    pub fn report(self, missing: Vec<NotStopped>) {
        // The gateway may have stopped waiting, so an error is ignored.
        let _ = self.report.send(missing);
    }
}

/// A stop that was taken for sending.
#[derive(Debug)]
pub(super) struct BegunStop {
    pub(super) drive: DriveIndex,
    /// Whether a client waits for the stop.
    is_of_client: bool,
}

impl BegunStop {
    /// The entry for a command that is taken for sending, if it is the stop of a drive.
    pub(super) fn of(command: &Command) -> Option<BegunStop> {
        let drive = command.drive().filter(|_| command.is_stop())?;
        let is_of_client = command.client_waits_until().is_some();
        Some(BegunStop { drive, is_of_client })
    }
}

impl Pending {
    /// Delays a stop within `min_run`, and a stop that a cyclic client only repeats: a repetition is not a second stop.
    pub(super) fn delay(&self, command: &mut Command) {
        let is_usual = matches!(&command.work, Work::Stop(stop) if stop.haste == Haste::Usual);
        let delays = is_usual && (self.gate.may_be_delayed(command) || self.repeats(command));
        // What ends before the delay does would lose the stop.
        let delays = delays && !self.is_last(command) && !self.stops_only;
        if let Work::Stop(stop) = &mut command.work
            && delays
        {
            stop.haste = Haste::Delayed;
        }
    }

    /// Whether a cyclic client repeats its waiting delayed stop.
    fn repeats(&self, stop: &Command) -> bool {
        let origin = stop.ticket.origin();
        let alike = |c: &Command| c.intent.target == stop.intent.target && c.intent.order == stop.intent.order;
        let own = |c: &Command| c.ticket.origin().client() == origin.client();
        let waits = |c: &Command| c.is_delayed_stop() && alike(c) && own(c);
        self.waiting.iter().any(waits) && self.gate.is_cyclic(origin)
    }

    /// Until when `min_run` delays the waiting stop of the drive.
    pub fn stop_waits(&self, drive: DriveIndex, now: Instant) -> Option<Instant> {
        let delayed = |c: &Command| c.is_delayed_stop() && c.intent.target == drive;
        self.waiting
            .iter()
            .any(delayed)
            .then(|| self.gate.stop_waits(drive, now))?
    }

    /// Notes that the stops taken for sending have ended, except those of the drives that are still `stopping`.
    pub fn settle_stops(&mut self, stopping: impl Fn(DriveIndex) -> bool) {
        self.begun_stops.retain(|stop| stopping(stop.drive));
    }

    /// Whether a client's stop waits, or was taken for sending and has not ended.
    pub(super) fn has_client_stops(&self) -> bool {
        let waits = |c: &Command| c.is_stop() && c.client_waits_until().is_some();
        self.begun_stops.iter().any(|stop| stop.is_of_client) || self.waiting.iter().any(waits)
    }

    /// At most one bare stop and one stop that also does more wait for each drive. Later ones join an equal one and
    /// are answered with it; if they differ, the newer one is sent.
    pub(super) fn push_stop(&mut self, stop: Command, now: Instant) {
        let target = stop.intent.target;
        self.gate.accepted(&stop, now);
        if let Some(drive) = target.drive() {
            self.purge(drive, now);
        }
        // A second stop waits for nothing, nor does the first one any more.
        if !stop.is_delayed_stop() {
            let of_drive = self.waiting.iter_mut().filter(|c| c.intent.target == target);
            of_drive.for_each(Command::end_delay);
        }
        let bare = stop.is_bare_stop();
        let alike = |c: &Command| c.intent.target == target && c.is_stop() && c.is_bare_stop() == bare;
        let waiting = self.waiting.iter_mut().find(|c| alike(c));
        match waiting.map(|waiting| (waiting.intent.order == stop.intent.order, &mut waiting.work)) {
            Some((true, Work::Stop(waiting))) => {
                waiting.joined.push((stop.ticket, stop.intent.window.expires));
                if let Work::Stop(stop) = stop.work {
                    waiting.joined.extend(stop.joined);
                }
                return;
            }
            Some(_) => self.remove(now, &Outcome::Replaced, alike),
            None => {}
        }
        self.waiting.push_back(stop);
    }

    /// A stop removes the waiting commands of its drive, and ends the started ones.
    fn purge(&mut self, drive: DriveIndex, now: Instant) {
        self.remove(now, &Outcome::Purged, |c| is_purged(c, drive));
        if !self.stopped.contains(&drive) {
            self.stopped.push(drive);
        }
    }

    /// Lets a stop join one that was accepted at this `last_starter`: the stop is noted like any other, but nothing
    /// is written for it. Returns whether it may join, which requires that no command accepted since may start the
    /// drive.
    pub(crate) fn joins_stop(&mut self, drive: DriveIndex, last_starter: u64, by: &Origin, now: Instant) -> bool {
        let is_served = self.closed.is_none() && !self.heirs.contains_key(&drive);
        if !is_served || self.gate.last_starter(drive) != last_starter {
            return false;
        }
        self.gate.stop_joined(drive, by, now);
        self.purge(drive, now);
        true
    }

    /// Drives for which a stop arrived since the previous call: their commands in progress end, whatever the result
    /// of the stop.
    pub fn take_stopped(&mut self) -> Vec<DriveIndex> {
        std::mem::take(&mut self.stopped)
    }

    /// Withdraws a supervision action that has not started: a client commands the drive again.
    pub fn withdraw_supervision(&mut self, drive: DriveIndex, now: Instant) {
        self.remove(now, &Outcome::Withdrawn, |c| {
            c.intent.target == drive && c.origins().all(Origin::is_lease)
        });
    }

    /// Takes the stops that the gateway requires before it ends; returns them only once.
    pub fn take_stopping(&mut self) -> Option<Stopping> {
        self.stopping.take()
    }
}

/// Whether a stop to the drive drops what waits: every command that reaches the drive and does not stop it too.
fn is_purged(command: &Command, drive: DriveIndex) -> bool {
    command.reaches(drive) && command.is_command() && !command.stops(drive)
}

impl Command {
    /// Whether the stop only takes the run command away.
    pub(super) fn is_bare_stop(&self) -> bool {
        match &self.intent.order {
            Order::Points(values) => values.len() == 1,
            Order::Write(_) | Order::Read(_) | Order::Parameter(_) => false,
        }
    }

    /// Ends the delay of a stop.
    pub(super) fn end_delay(&mut self) {
        if let Work::Stop(stop) = &mut self.work
            && stop.haste == Haste::Delayed
        {
            stop.haste = Haste::AtOnce;
        }
    }
}
