//! The list of rules, and how an order is judged by them. Pure: time is an argument.

use std::time::Instant;

use super::gate::{DriveGate, Gate};
use super::reference_limits::LastWritten;
use super::rules;
use super::rules::standing::Repeats;
use crate::order::{Asks, Effect, Intent, Order, Origin, Outcome, Refusal};
use crate::process_image::Reading;
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// Output frequency in Hz below which a motor with its run command on counts as standing or in sleep mode.
const TURNS: f64 = 0.5;

/// A moment at which an order is judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// The order is complete and is about to enter the queue.
    Accept,
    /// The line is free for the order.
    Turn,
    /// The next frame of the order is about to be sent.
    Write,
}

/// The result of judging an order.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// The order may proceed.
    Go,
    /// The order is judged again at this time.
    Wait(Instant),
    /// The state of the drive is read first, within the same command, and the command is judged by this state.
    LookFirst,
    /// The order ends with this outcome.
    Refuse(Outcome),
}

impl Verdict {
    /// The order ends with this refusal.
    pub(super) fn refuse(refusal: Refusal) -> Verdict {
        Verdict::Refuse(Outcome::Refused(refusal))
    }

    /// Refuses the order if there is a refusal; otherwise the order may proceed.
    pub(super) fn unless(refusal: Option<Refusal>) -> Verdict {
        refusal.map_or(Verdict::Go, Verdict::refuse)
    }
}

/// State of a drive when an order to it is judged.
#[derive(Debug)]
pub struct DriveFacts<'a> {
    /// Process image of the drive.
    pub reading: Reading<'a>,
    /// When reference and frequency range of the drive were last written; set only if the order is about to be sent.
    pub written: Option<LastWritten>,
    /// Run command in the drive's word as the bus knows it, from reads and acknowledged writes; `None` if unknown.
    pub run: Option<bool>,
    /// What the word that is about to be sent would repeat of the drive's word; `None` if it repeats nothing, or if no
    /// word is about to be sent.
    pub repeats: Option<Repeats>,
}

impl DriveFacts<'_> {
    /// Whether the motor is at standstill and its run command is on. Where nothing shows the run command, it counts as on
    /// when the order is about to be sent.
    fn waits_for_a_reference(&self) -> bool {
        let reading = &self.reading;
        let stands = match reading.model(ModelPoint::OutputFrequency).good().map(Value::as_f64) {
            Some(hertz) => hertz.abs() < TURNS,
            None => !reading.is_set(ModelPoint::Running),
        };
        let told = || reading.model(ModelPoint::Run).good().map(Value::as_bool);
        let may_be_on = || reading.is_set(ModelPoint::Running) || self.written.is_some();
        stands && self.run.or_else(told).unwrap_or_else(may_be_on)
    }
}

/// Access to the state of the drives of a bus.
pub trait Facts {
    /// State of the drive with this index; `None` if the bus has no such drive.
    fn seen(&self, drive: DriveIndex) -> Option<DriveFacts<'_>>;
}

/// Facts of no drives, so that no rule that needs a reading refuses an order.
impl Facts for () {
    fn seen(&self, _: DriveIndex) -> Option<DriveFacts<'_>> {
        None
    }
}

/// The input of a rule: an order, one drive that it reaches, and the stage and time of the judgement.
#[derive(Debug)]
pub struct Ask<'a> {
    /// The stage at which the order is judged.
    pub stage: Stage,
    /// Time of the judgement.
    pub now: Instant,
    /// The drive that the rule judges, one of those that the order reaches.
    pub drive: DriveIndex,
    /// The intent of the order.
    pub intent: &'a Intent,
    /// Origin of the order.
    pub origin: &'a Origin,
    /// State of the drive; `None` if unknown.
    pub seen: Option<&'a DriveFacts<'a>>,
}

impl Ask<'_> {
    /// Effect of the order on the drive.
    pub fn effect(&self) -> Effect {
        self.intent.effects.on(self.drive)
    }

    /// Rights that the order requires from the hold of the drive.
    pub fn asks(&self) -> Asks {
        Asks::of(&self.intent.order, self.effect())
    }

    /// Whether the order sets a reference that would turn a motor at standstill whose run command is on.
    pub(super) fn wakes(&self) -> bool {
        let effect = self.effect();
        effect.reference && !effect.stops && self.seen.is_some_and(DriveFacts::waits_for_a_reference)
    }

    /// Whether the order is a write, but not a stop.
    pub(super) fn changes(&self) -> bool {
        !self.effect().stops && !matches!(self.intent.order, Order::Read(_))
    }
}

/// A rule with the stages at which it applies.
pub(super) struct Rule {
    /// The moments at which the rule is evaluated; the rule's file explains why not at others.
    pub(super) stages: &'static [Stage],
    /// Whether the rule applies to stops, too.
    pub(super) binds_stops: bool,
    /// The function that judges an order.
    pub(super) judge: fn(&Ask<'_>, &DriveGate, &Gate) -> Verdict,
}

/// All rules in their order of evaluation.
const RULES: [Rule; 11] = [
    rules::access::RULE,
    rules::age::RULE,
    rules::restore_lock::RULE,
    rules::awaited_file::RULE,
    rules::holder::RULE,
    rules::priorities::RULE,
    rules::drill::RULE,
    rules::interlock::RULE,
    rules::guard::RULE,
    rules::limits::RULE,
    rules::standing::RULE,
];

/// Judges an order by every rule of its stage. The first refusal ends the evaluation; of several waits the longest counts.
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
