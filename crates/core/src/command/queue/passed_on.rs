//! Requests passed on for a tool to several drives, or unchecked to one: their place among the other commands of each.

use std::time::Instant;

use super::{Chosen, CommandQueue, Pending};
use crate::command::{BackgroundRequest, Command, Outcome, PassedOn, Touched, Urgency};
use crate::drive::DriveIndex;
use crate::order::Arrival;

impl Pending {
    /// The passed-on requests that may be sent, in order: nothing older waits for any drive that they reach. A stop
    /// that cannot be sent because its drive is offline does not hold up requests that also reach others.
    pub(super) fn passed_on(&self, may: &mut impl FnMut(&Command) -> bool) -> Vec<u64> {
        if self.waiting.iter().all(|c| c.passed_on.is_none()) {
            return Vec::new();
        }
        let stops = self.waiting.iter().filter(|c| c.urgency == Urgency::Stop);
        let mut first: Vec<DriveIndex> = stops.filter(|c| may(c)).map(|c| c.drive).collect();
        let mut all = Vec::new();
        for command in self.waiting.iter().filter(|c| c.urgency == Urgency::Command) {
            let free = command.passed_on.is_some() && command.reach().iter().all(|drive| !first.contains(drive));
            if free && may(command) {
                all.push(command.number);
            }
            first.extend(command.reach());
        }
        all
    }

    /// Passed-on requests that are sent as commands because a command waits for them.
    pub(super) fn pressed(&self) -> Vec<u64> {
        let mut waits: Vec<DriveIndex> = Vec::new();
        let mut pressed = Vec::new();
        for command in self.waiting.iter().rev().filter(|c| c.urgency == Urgency::Command) {
            let presses = command.reach().iter().any(|drive| waits.contains(drive));
            if command.passed_on.is_some() && presses {
                pressed.push(command.number);
            }
            if command.passed_on.is_none() || presses {
                waits.extend(command.reach());
            }
        }
        pressed
    }

    /// The request that is passed on next to several drives, or to one unchecked, where nothing is in a hurry.
    pub fn next_passed_on(&mut self, now: Instant, mut may: impl FnMut(&Command) -> bool) -> Option<Chosen> {
        self.expire(now);
        let rank = Urgency::Command;
        let mut may = |command: &Command| self.waits_for_reads(command, now).is_none() && may(command);
        let number = self.passed_on(&mut may).first().copied();
        number.map(|number| Chosen { rank, number })
    }

    /// The broadcast that goes before all that waits, stops included.
    pub fn first_of_all(&self, now: Instant) -> Option<Chosen> {
        let goes_first = |c: &&Command| c.passed_on.as_ref().is_some_and(|p| p.first) && c.expires > now;
        let rank = Urgency::Stop;
        let number = self.waiting.iter().find(goes_first).map(|c| c.number);
        number.map(|number| Chosen { rank, number })
    }

    /// The command that was chosen.
    pub fn get(&self, chosen: Chosen) -> Option<&Command> {
        self.waiting.iter().find(|c| c.number == chosen.number)
    }

    /// A command that was taken but not sent waits again, ahead of all others, unless a stop arrived for a drive that
    /// it reaches.
    pub fn put_back(&mut self, command: Command, now: Instant) {
        let outcome = match &self.closed {
            Some(outcome) => Some(outcome.clone()),
            None if self.stops_only && !command.ends_the_gateway() => Some(Outcome::ShuttingDown),
            None => {
                let stopped = |drive: &DriveIndex| self.was_stopped(*drive) && !command.stops(*drive);
                command.reach().iter().any(stopped).then_some(Outcome::Purged)
            }
        };
        match outcome {
            Some(outcome) => command.answer(&outcome, now),
            None => self.waiting.push_front(command),
        }
    }

    /// Whether a stop arrived for that drive since the bus last checked.
    pub fn was_stopped(&self, drive: DriveIndex) -> bool {
        self.stopped.contains(&drive)
    }
}

impl CommandQueue {
    /// Takes in what is passed on for a tool, and wakes the bus: a command to drives of the bus has its place among
    /// their other commands, anything else waits with the background requests.
    pub(crate) fn submit_passed_on(
        &self,
        request: BackgroundRequest,
        touched: Touched,
        arrival: Arrival,
        now: Instant,
    ) {
        if request.passed_on.as_ref().is_some_and(PassedOn::is_order) {
            let mut command = request.into_command(touched);
            command.arrival = Some(arrival);
            self.submit(command, now);
        } else {
            self.submit_background(request, now);
        }
    }
}
