//! How a command ends: withdrawn, interrupted, refused before it is sent, or answered.

use std::time::Instant;

use super::steps::{Action, Check};
use super::word::Word;
use super::{CommandRun, Ending, Pause, Phase, Shown};
use crate::confirm::Effect;
use drivegate_core::order::{Interruption, Outcome, Receipt, Refusal};
use drivegate_core::permit::{AT_NEXT_START, right_lost};
use drivegate_proto::Exception;

impl CommandRun {
    /// Ends the command with this outcome; if it started a motor, that is stopped.
    pub(super) fn give_up(&mut self, outcome: Outcome) {
        self.actions.clear();
        if self.ending.cut().is_none() {
            self.ending = Ending::Cut(outcome);
        }
        let phase = std::mem::replace(&mut self.phase, Phase::OnlyEnds);
        self.drop_repeat();
        (self.tries.failures, self.known.check) = (0, Check::NotYet);
        self.look.forget();
        if phase == Phase::MotorStarted {
            self.actions.push_back(Action::Word(Word::Stop(None)));
        }
    }

    /// Ends a command that the rules refuse, but still sends the end of a pulse. A motor that it started is left to
    /// the client that has since taken the drive or stopped it; otherwise it is stopped.
    pub fn denied(&mut self, outcome: Outcome) {
        let outcome = match outcome {
            Outcome::Refused(refusal @ (Refusal::HeldByOther(_) | Refusal::NeedsTake(_))) => {
                self.leave_motor();
                self.unless_begun(Outcome::Refused(refusal), Interruption::Taken)
            }
            Outcome::Purged => {
                self.leave_motor();
                self.unless_begun(Outcome::Purged, Interruption::Stop)
            }
            Outcome::Interrupted(Interruption::RightLost) => {
                self.leave_motor();
                self.unless_begun(Outcome::Refused(right_lost()), Interruption::RightLost)
            }
            Outcome::Expired => self.unless_begun(Outcome::Expired, Interruption::Expired),
            outcome => outcome,
        };
        self.cut_off(outcome);
    }

    /// Whether the command has had no effect yet: nothing of it was sent, or the drive was busy each time.
    pub fn is_owed(&self) -> bool {
        !self.has_begun() || (self.tries.busy > 0 && !self.in_doubt())
    }

    /// Outcome of a command that is withdrawn before it is sent.
    pub fn taken_back(&self) -> Outcome {
        if self.has_begun() {
            Outcome::Exception(Exception::BUSY)
        } else {
            Outcome::Withdrawn
        }
    }

    /// A stop arrived: remaining steps are cancelled, except clearing a reset bit that is set. Returns the outcome if
    /// that ends the command.
    pub fn purge(&mut self) -> Option<Outcome> {
        // The stop in the queue stops the motor, so no separate stop is needed.
        self.leave_motor();
        self.cut_off(self.unless_begun(Outcome::Purged, Interruption::Stop));
        self.actions.is_empty().then(|| self.success())
    }

    /// Notes that a stop of this motor is sent before the rest of the command, the end of a pulse.
    pub fn note_stop_sent_first(&mut self) {
        self.known.stopped = true;
    }

    /// Leaves the started motor running: the end of the command sends no separate stop.
    fn leave_motor(&mut self) {
        if self.phase == Phase::MotorStarted {
            self.phase = Phase::Steps;
        }
    }

    /// The step that was to be repeated is not sent any more.
    fn drop_repeat(&mut self) {
        if let Pause::Repeat(_) = self.pause {
            self.pause = Pause::No;
        }
    }

    pub(super) fn cut_off(&mut self, outcome: Outcome) {
        let before = self.actions.len();
        // A bit whose setting was sent and not answered may be set.
        if self.tries.failures > 0 && self.actions.front().is_some_and(Action::is_reset) {
            self.actions.pop_front();
        }
        let high = self.actions.iter().any(Action::is_reset);
        self.actions
            .retain(|a| !high && (a.ends_reset() || matches!(a, Action::Wait(_))));
        // If no end of a pulse follows, the remaining pauses are pointless.
        if !self.actions.iter().any(Action::ends_reset) {
            self.actions.clear();
        }
        let left = self.actions.len();
        let phase = std::mem::replace(&mut self.phase, Phase::OnlyEnds);
        if phase == Phase::MotorStarted && before > left {
            self.actions.push_back(Action::Word(Word::Stop(None)));
        }
        self.drop_repeat();
        self.look.forget();
        if before != left {
            self.ending = Ending::Cut(outcome);
            self.tries.failures = 0;
        }
    }

    /// How the command ends when nothing is left to do.
    pub fn success(&self) -> Outcome {
        match &self.ending {
            Ending::Cut(outcome) => outcome.clone(),
            Ending::Acknowledged(reply) => Outcome::Acknowledged(reply.clone()),
        }
    }

    /// Reports the acknowledgement, and the confirmation as far as it is known already. Returns the effects that reads
    /// must still show, and the receipts of the clients that wait for that; both empty without such effects.
    pub fn acknowledge(self, outcome: &Outcome, now: Instant) -> (Vec<Effect>, Vec<Receipt>) {
        let begun = self.has_begun();
        let tickets = std::iter::once(self.ticket).chain(self.joined);
        let receipts = tickets.map(|ticket| ticket.acknowledge(outcome.clone(), now));
        match self.shown {
            Shown::ByReads(effects) => return (effects, receipts.collect()),
            Shown::ReadBack => receipts.for_each(|receipt| receipt.confirm(now)),
            Shown::AtNextStart if begun => receipts.for_each(|receipt| receipt.cannot_be_seen(AT_NEXT_START)),
            Shown::AtNextStart => receipts.for_each(|receipt| receipt.waits(AT_NEXT_START)),
        }
        (Vec::new(), Vec::new())
    }

    /// Ends the command with this outcome.
    pub fn finish(self, outcome: &Outcome, now: Instant) {
        let tickets = std::iter::once(self.ticket).chain(self.joined);
        tickets.for_each(|ticket| ticket.answer(outcome.clone(), now));
    }

    /// Ends a command that cannot continue; with the outcome `unbegun` if nothing of it was sent.
    pub fn abandon(self, unbegun: Outcome, why: Interruption, now: Instant) {
        let cut = self.ending.cut().cloned();
        let outcome = cut.unwrap_or_else(|| self.unless_begun(unbegun, why));
        self.finish(&outcome, now);
    }
}
