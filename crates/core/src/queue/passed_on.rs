//! Requests that are passed on for a tool to several drives, or unchecked to one drive: how they are ordered among
//! the other commands of each drive.

use std::time::Instant;

use super::{Choice, Chosen, Pending, Ready};
use crate::order::{Command, Outcome, Urgency};
use crate::permit::{Facts, Verdict};
use drivegate_model::drive::DriveIndex;

impl Pending {
    /// The passed-on requests that may be sent, in order: nothing older waits for any drive that they reach. A stop
    /// that waits because its drive did not answer the last one does not delay requests that also reach other drives.
    pub(super) fn passed_on(&self, may: &mut impl FnMut(&Command) -> bool) -> Vec<u64> {
        if !self.has_passed_on() {
            return Vec::new();
        }
        let stops = self.waiting.iter().filter(|c| c.is_stop());
        let mut first: Vec<DriveIndex> = stops.filter(|c| may(c)).filter_map(Command::drive).collect();
        let mut all = Vec::new();
        for command in self.waiting.iter().filter(|c| c.is_command()) {
            let free = command.as_passed_on().is_some() && command.reach().all(|drive| !first.contains(&drive));
            if free && may(command) {
                all.push(command.intent.number);
            }
            first.extend(command.reach());
        }
        all
    }

    fn has_passed_on(&self) -> bool {
        self.waiting.iter().any(|command| command.as_passed_on().is_some())
    }

    /// Passed-on requests that must be sent like commands because a command waits for them.
    pub(super) fn pressed(&self) -> Vec<u64> {
        let mut pressed = Vec::new();
        if !self.has_passed_on() {
            return pressed;
        }
        let mut waits: Vec<DriveIndex> = Vec::new();
        for command in self.waiting.iter().rev().filter(|c| c.is_command()) {
            let presses = command.reach().any(|drive| waits.contains(&drive));
            let is_passed_on = command.as_passed_on().is_some();
            if is_passed_on && presses {
                pressed.push(command.intent.number);
            }
            if !is_passed_on || presses {
                waits.extend(command.reach());
            }
        }
        pressed
    }

    /// The next request to pass on to several drives, or unchecked to one, if no command waits for one.
    pub fn next_passed_on(
        &mut self,
        now: Instant,
        facts: &dyn Facts,
        mut ready: impl FnMut(&Command) -> Ready,
    ) -> Choice {
        self.expire(now);
        let rank = Urgency::Command;
        let mut choice = Choice::default();
        let numbers = self.passed_on(&mut |command: &Command| match ready(command) {
            Ready::Now | Ready::Last => true,
            Ready::No => false,
            Ready::At(until) => {
                choice.wait(until);
                false
            }
        });
        for number in numbers {
            match self.judge_turn(number, facts, now) {
                Verdict::Go => {
                    choice.chosen = Some(Chosen {
                        rank,
                        is_last: false,
                        number,
                    });
                    break;
                }
                Verdict::Wait(until) => choice.wait(until),
                Verdict::LookFirst => {}
                Verdict::Refuse(_) => choice.wait(now),
            }
        }
        choice
    }

    /// The broadcast that is sent before all other waiting commands, including stops.
    pub fn first_of_all(&self, now: Instant) -> Option<Chosen> {
        let goes_first = |c: &&Command| c.as_passed_on().is_some_and(|p| p.first) && c.intent.window.expires > now;
        let rank = Urgency::Stop;
        let number = self.waiting.iter().find(goes_first).map(|c| c.intent.number);
        number.map(|number| Chosen {
            rank,
            is_last: false,
            number,
        })
    }

    /// The waiting command that was chosen.
    pub fn get(&self, chosen: Chosen) -> Option<&Command> {
        self.waiting.iter().find(|c| c.intent.number == chosen.number)
    }

    /// Returns a command that was taken but not sent to the front of the queue, unless a stop arrived for a drive
    /// that it reaches.
    pub fn put_back(&mut self, command: Command, now: Instant) {
        let outcome = match &self.closed {
            Some(outcome) => Some(outcome.clone()),
            None if self.stops_only && !command.ends_the_gateway() => Some(Outcome::ShuttingDown),
            None => {
                let stopped = |drive: DriveIndex| self.was_stopped(drive) && !command.stops(drive);
                command.reach().any(stopped).then_some(Outcome::Purged)
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
