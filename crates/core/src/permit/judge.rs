//! The list of rules, and the judgement of an order by it. Pure: time is an argument.

use std::time::Instant;

use super::gate::{DriveGate, Gate};
use super::reference_limits::LastWritten;
use super::rules;
use crate::drive::DriveIndex;
use crate::order::{Asks, Effect, Intent, Order, Origin, Outcome, Refusal};
use crate::process_image::Reading;

/// A moment at which an order is judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// It is complete and takes its place in the queue.
    Accept,
    /// The line is free for it.
    Turn,
    /// Its next frame is about to go.
    Write,
}

/// What is to become of an order.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// It goes on.
    Go,
    /// It is judged again at that time.
    Wait(Instant),
    /// The state of the drive is read first, in the same command, and it is judged by that.
    LookFirst,
    /// It ends so.
    Refuse(Outcome),
}

impl Verdict {
    /// It ends with that refusal.
    pub(super) fn refuse(refusal: Refusal) -> Verdict {
        Verdict::Refuse(Outcome::Refused(refusal))
    }

    /// It goes on unless it is refused.
    pub(super) fn unless(refusal: Option<Refusal>) -> Verdict {
        refusal.map_or(Verdict::Go, Verdict::refuse)
    }
}

/// What is seen of a drive when an order to it is judged.
#[derive(Debug)]
pub struct Seen<'a> {
    /// Its image.
    pub reading: Reading<'a>,
    /// When its reference and its frequency range were written last, if the order has its turn.
    pub written: Option<LastWritten>,
}

/// What is seen of the drives of a bus.
pub trait Facts {
    /// What is seen of that drive; none where there is no such drive.
    fn seen(&self, drive: DriveIndex) -> Option<Seen<'_>>;
}

/// Nothing is seen of any drive: no rule refuses an order for what it would see.
impl Facts for () {
    fn seen(&self, _: DriveIndex) -> Option<Seen<'_>> {
        None
    }
}

/// One question: may this order go on, as far as that drive is concerned?
#[derive(Debug)]
pub struct Ask<'a> {
    /// The moment.
    pub stage: Stage,
    /// Now.
    pub now: Instant,
    /// The drive, one of those that the order reaches.
    pub drive: DriveIndex,
    /// The order.
    pub intent: &'a Intent,
    /// Who gave it.
    pub origin: &'a Origin,
    /// What is seen of the drive.
    pub seen: Option<&'a Seen<'a>>,
}

impl Ask<'_> {
    /// What the order does to the drive.
    pub fn effect(&self) -> Effect {
        self.intent.effects.on(self.drive)
    }

    /// What it requires of the hold of the drive.
    pub fn asks(&self) -> Asks {
        Asks::of(&self.intent.order, self.effect())
    }

    /// Whether it is a write, and no stop.
    pub(super) fn changes(&self) -> bool {
        !self.effect().stops && !matches!(self.intent.order, Order::Read(_))
    }
}

/// One rule.
pub(super) struct Rule {
    /// The moments at which it is asked; its file says why not at others.
    pub(super) stages: &'static [Stage],
    /// Whether stops are judged by it, too.
    pub(super) binds_stops: bool,
    /// The judgement.
    pub(super) judge: fn(&Ask<'_>, &DriveGate, &Gate) -> Verdict,
}

/// All rules, in the order in which they are asked.
const RULES: [Rule; 9] = [
    rules::access::RULE,
    rules::age::RULE,
    rules::restore_lock::RULE,
    rules::holder::RULE,
    rules::priorities::RULE,
    rules::drill::RULE,
    rules::interlock::RULE,
    rules::guard::RULE,
    rules::limits::RULE,
];

/// Judges an order by every rule that is asked at its moment. The first refusal ends it; of several waits the longest counts.
pub(super) fn judge(ask: &Ask<'_>, drive: &DriveGate, gate: &Gate) -> Verdict {
    let stops = ask.effect().stops;
    let mut verdict = Verdict::Go;
    let asked = RULES.iter().filter(|rule| rule.stages.contains(&ask.stage));
    for rule in asked.filter(|rule| rule.binds_stops || !stops) {
        match ((rule.judge)(ask, drive, gate), &verdict) {
            (refused @ Verdict::Refuse(_), _) => return refused,
            (Verdict::Wait(until), Verdict::Wait(before)) => verdict = Verdict::Wait(until.max(*before)),
            (Verdict::Go, _) | (Verdict::LookFirst, Verdict::Wait(_)) => {}
            (wait, _) => verdict = wait,
        }
    }
    verdict
}

#[cfg(test)]
mod tests;
