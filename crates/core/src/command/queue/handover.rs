//! A reload: another bus takes the place of the one that serves a queue, and the stops that wait in it are handed over.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use super::{CommandQueue, Pending};
use crate::command::{Command, Outcome, Urgency};
use crate::drive::DriveIndex;

impl Pending {
    /// Whether another bus takes the place of this one.
    pub fn is_ending(&self) -> bool {
        self.ending
    }

    /// A stop that the bus had started when it ended: the bus that takes its place sends it.
    ///
    /// # Errors
    /// None takes its place.
    pub fn give_back(&mut self, stop: Command) -> Result<(), Box<Command>> {
        match self.ending {
            true => {
                self.waiting.push_front(stop);
                Ok(())
            }
            false => Err(Box::new(stop)),
        }
    }

    /// A stop that was given to the bus before; it was counted there.
    fn inherit(&mut self, mut stop: Command, now: Instant) {
        self.numbered += 1;
        stop.number = self.numbered;
        // Its consequences were noted there, too.
        (stop.effects, stop.slot) = (Vec::new(), None);
        match &self.closed {
            Some(outcome) => stop.answer(&outcome.clone(), now),
            None => self.push_stop(stop, now),
        }
    }
}

impl CommandQueue {
    /// The bus is about to be replaced: stops wait for the next bus, everything else ends.
    pub fn begin_handover(&self, now: Instant) {
        let outcome = Outcome::ShuttingDown;
        self.background().close(&outcome, now);
        let mut pending = self.lock();
        pending.remove(now, &outcome, |c| c.urgency != Urgency::Stop);
        pending.closed = Some(outcome);
        pending.ending = true;
    }

    /// From now on the stops of that drive are those of another queue, in which it has that place: those that wait, and those
    /// that are still given to this one.
    pub(crate) fn hand_over(&self, drive: DriveIndex, heir: &Arc<CommandQueue>, place: DriveIndex, now: Instant) {
        let mut pending = self.lock();
        let last_stops = pending.last_stops.get(&drive).cloned();
        let mut of_heir = heir.lock();
        if let Some(stops) = last_stops {
            of_heir.last_stops.insert(place, stops);
        }
        of_heir.paused = of_heir.paused.or(pending.paused);
        let (stops, others): (VecDeque<Command>, _) = std::mem::take(&mut pending.waiting)
            .into_iter()
            .partition(|c| c.drive == drive && c.urgency == Urgency::Stop);
        pending.waiting = others;
        for mut stop in stops {
            stop.drive = place;
            match stop.client_waits_until() {
                Some(_) => of_heir.inherit(stop, now),
                // The lease knows the pending actions of supervision.
                None => stop.answer(&Outcome::ShuttingDown, now),
            }
        }
        drop(of_heir);
        pending.heirs.insert(drive, (heir.clone(), place));
        heir.wake();
    }
}
