//! Handover in a reload: another bus replaces the one that serves a queue, and takes over the waiting stops.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Instant;

use super::{CommandQueue, Pending};
use crate::order::{Command, Effects, Outcome, Touched, Work};
use drivegate_model::drive::DriveIndex;

/// The queue that serves a drive now, and the index of the drive there, for all queues that served it before: after
/// any number of reloads the first queue finds the present one, even if those in between no longer exist.
#[derive(Debug, Clone)]
pub(super) struct PresentQueue(Arc<Mutex<(Weak<CommandQueue>, DriveIndex)>>);

impl PresentQueue {
    fn new(queue: &Arc<CommandQueue>, place: DriveIndex) -> PresentQueue {
        PresentQueue(Arc::new(Mutex::new((Arc::downgrade(queue), place))))
    }

    fn set(&self, queue: &Arc<CommandQueue>, place: DriveIndex) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = (Arc::downgrade(queue), place);
    }

    /// The queue that serves the drive now; `None` if no bus serves the drive any more.
    pub(super) fn served_by(&self) -> Option<(Arc<CommandQueue>, DriveIndex)> {
        let served_by = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        Some((served_by.0.upgrade()?, served_by.1))
    }
}

impl Pending {
    /// Whether another bus is replacing the one of this queue.
    pub fn is_ending(&self) -> bool {
        self.ending
    }

    /// Whether a stop waits or is in progress for a drive that no bus serves after this one.
    fn has_last_stops(&self) -> bool {
        let begun = |drive: &DriveIndex| self.begun_stops.iter().any(|stop| stop.drive == *drive);
        self.last.iter().any(begun) || self.waiting.iter().any(|c| c.is_stop() && self.is_last(c))
    }

    /// Whether no bus sends anything to the drive of a command after this one.
    pub(super) fn is_last(&self, command: &Command) -> bool {
        command.drive().is_some_and(|drive| self.last.contains(&drive))
    }

    /// Passes on a stop that the bus had started when it ended: the bus that replaces it sends the stop.
    ///
    /// # Errors
    /// If no bus replaces this one.
    pub fn give_back(&mut self, stop: Command) -> Result<(), Box<Command>> {
        if self.ending {
            self.waiting.push_front(stop);
            Ok(())
        } else {
            Err(Box::new(stop))
        }
    }

    /// Takes over a stop that another bus had accepted and counted.
    fn inherit(&mut self, mut stop: Command, now: Instant) {
        if let Work::Stop(work) = &mut stop.work {
            work.is_inherited = true;
        }
        match &self.closed {
            Some(outcome) => stop.answer(&outcome.clone(), now),
            None => self.push_stop(stop, now),
        }
    }
}

impl Command {
    /// Changes the index of its drive to the one on the bus that serves the drive now.
    pub(super) fn move_to(&mut self, place: DriveIndex) {
        if let Some(drive) = self.drive() {
            self.intent.effects = Effects::on_one(place, self.effect(drive), Touched::Anything);
        }
        self.intent.target = place.into();
    }
}

impl CommandQueue {
    /// Prepares for the replacement of the bus: stops wait for the next bus, except those of the drives of `last`,
    /// which have none and are sent now; all other commands end.
    pub fn begin_handover(&self, last: Vec<DriveIndex>, now: Instant) {
        let outcome = Outcome::ShuttingDown;
        self.background().close(&outcome, now);
        let mut pending = self.lock();
        let waiting = std::mem::take(&mut pending.waiting);
        let kept_away = waiting.iter().filter(|c| !c.is_stop());
        kept_away.for_each(|command| pending.renew_by(command));
        pending.waiting = waiting;
        pending.remove(now, &outcome, |c| !c.is_stop());
        pending.closed = Some(outcome);
        pending.ending = true;
        let is_last = |c: &&mut Command| c.drive().is_some_and(|drive| last.contains(&drive));
        let hurried = pending.waiting.iter_mut().filter(is_last);
        hurried.for_each(Command::end_delay);
        pending.last = last;
        drop(pending);
        self.wake();
    }

    /// Whether the bus that is about to be replaced still has to send a stop which no other bus sends.
    pub fn has_last_stops(&self) -> bool {
        self.lock().has_last_stops()
    }

    /// Hands the stops of the drive to another queue, where the drive has this index: the waiting stops, and those
    /// given to this queue later. The other queue also takes over the gate's state of the drive.
    pub(crate) fn hand_over(&self, drive: DriveIndex, heir: &Arc<CommandQueue>, place: DriveIndex, now: Instant) {
        let mut pending = self.lock();
        let mut of_heir = heir.lock();
        let (stops, others): (VecDeque<Command>, _) = std::mem::take(&mut pending.waiting)
            .into_iter()
            .partition(|c| c.intent.target == drive && c.is_stop());
        pending.waiting = others;
        for mut stop in stops {
            stop.move_to(place);
            match stop.client_waits_until() {
                Some(_) => of_heir.inherit(stop, now),
                // Only stops with a waiting client are handed over: supervision repeats its own actions.
                None => stop.answer(&Outcome::ShuttingDown, now),
            }
        }
        drop(of_heir);
        let found_by = pending.found_by.remove(&drive);
        let served_by = found_by.unwrap_or_else(|| PresentQueue::new(heir, place));
        served_by.set(heir, place);
        heir.lock().found_by.insert(place, served_by.clone());
        pending.heirs.insert(drive, served_by);
        heir.wake();
    }
}
