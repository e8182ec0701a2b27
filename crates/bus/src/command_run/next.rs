//! The next step of a started command. Pure: time is an argument.

use std::time::{Duration, Instant};

use super::control;
use super::functions::other_function;
use super::steps::{Action, Step, step_of};
use super::word::{self, Made, Word};
use super::{CommandRun, KnownWords, Need, Next, Pause, Phase};
use drivegate_core::order::{Interruption, Outcome};
use drivegate_core::permit::Repeats;
use drivegate_model::drive::Profile;
use drivegate_proto::Exception;

/// Result of evaluating a command's first action.
enum First {
    /// This step must be sent.
    Step(Box<Step>),
    /// The action changes nothing: the next one is evaluated.
    Nothing,
    /// The action was removed, or replaced by another one.
    Changed,
    /// The gate first judges what the word would repeat.
    Judge(Repeats),
}

impl CommandRun {
    /// The next step of a command that no gate judges, such as in the proof of a profile: the command itself asks what its
    /// words may repeat.
    pub fn next(&mut self, words: &KnownWords, profile: &Profile, running: bool, now: Instant) -> Next {
        loop {
            match self.need(words, profile, running, now) {
                Need::Next(next) => return next,
                Need::Judge(repeats) => self.judged(repeats, repeats.verdict()),
            }
        }
    }

    /// What the command needs next. `running` is the state that the drive reported last. Once the command has expired
    /// nothing more is sent, except to clear a reset bit that is set.
    pub(crate) fn need(&mut self, words: &KnownWords, profile: &Profile, running: bool, now: Instant) -> Need<Next> {
        (self.known.running, self.known.masks) = (running, words.functions.masks(profile));
        self.end_late(now);
        if let Some(at) = self.pauses_until(now) {
            return Need::Next(Next::Wait(at));
        }
        while let Some(action) = self.actions.front() {
            if let Action::Wait(time) = action {
                let until = now + *time;
                self.look.forget();
                return Need::Next(self.hold_until(until));
            }
            match self.first(words, profile, running, now) {
                First::Step(step) => return Need::Next(Next::Send(self.formed(*step, words, profile))),
                First::Judge(repeats) => return Need::Judge(repeats),
                First::Changed => {}
                First::Nothing => {
                    if let Some(high_at) = self.pass_over(words, profile, now) {
                        return Need::Next(self.hold_until(high_at));
                    }
                }
            }
        }
        Need::Next(Next::Done)
    }

    /// An expired command sends nothing more than the end of a pulse.
    fn end_late(&mut self, now: Instant) {
        if !self.is_late(now) {
            return;
        }
        let outcome = if self.tries.failures > 0 || self.in_doubt() {
            self.tries.unanswered.clone()
        } else if self.tries.busy > 0 {
            Outcome::Exception(Exception::BUSY)
        } else {
            self.unless_begun(Outcome::Expired, Interruption::Expired)
        };
        self.cut_off(outcome);
    }

    /// Since when a step is due that the drive was too busy for; `None` if it was not.
    pub(crate) fn repeats_since(&self) -> Option<Instant> {
        self.tries.due.filter(|_| self.tries.busy > 0)
    }

    /// Until when the command sends nothing; `None` if it may send now.
    fn pauses_until(&mut self, now: Instant) -> Option<Instant> {
        let until = match self.pause {
            Pause::No => None,
            Pause::Repeat(pause) => {
                let expires = self.may_write_on().then_some(self.expires);
                let at = expires.map_or(now + pause, |expires| expires.min(now + pause));
                self.tries.due = Some(at);
                Some(at)
            }
            Pause::Until(at) => Some(at),
        };
        let until = until.filter(|at| now < *at);
        self.pause = until.map_or(Pause::No, Pause::Until);
        until
    }

    /// Removes the pause at the front, which ends at `until`.
    fn hold_until(&mut self, until: Instant) -> Next {
        self.actions.pop_front();
        self.pause = Pause::Until(until);
        Next::Wait(until)
    }

    fn first(&mut self, words: &KnownWords, profile: &Profile, running: bool, now: Instant) -> First {
        let step = match self.actions.front_mut() {
            None => None,
            Some(Action::Await(state)) => match state.state_read(now) {
                Ok(step) => Some(step),
                Err(why) => {
                    self.give_up(Outcome::NotTaken(why));
                    return First::Changed;
                }
            },
            Some(Action::Word(Word::Sequence(word, reverse)))
                if word.is_first && control::is_prepared(profile, words, running) =>
            {
                let reverse = *reverse;
                self.only_last_word(reverse);
                return First::Changed;
            }
            Some(Action::Word(word)) => match word::made(*word, words, profile, self.known, self.look.motor()) {
                Made::Send(step) => Some(step),
                Made::Nothing => None,
                Made::Judge(repeats) if self.is_judged() => return First::Judge(repeats),
                Made::Judge(repeats) => {
                    self.judged(repeats, repeats.verdict());
                    return First::Changed;
                }
                Made::Look => match self.state_request(profile) {
                    Some(step) => Some(step),
                    None => return First::Changed,
                },
                Made::AtNextStart(reverse) => {
                    self.keep_direction(reverse);
                    return First::Changed;
                }
            },
            Some(action) => step_of(action, words, profile, self.known),
        };
        step.map_or(First::Nothing, |step| First::Step(Box::new(step)))
    }

    /// The step in the form that the drive takes.
    fn formed(&mut self, mut step: Step, words: &KnownWords, profile: &Profile) -> Step {
        step.pdu = words.functions.form(step.pdu, profile);
        if let Some(other) = other_function(&step.pdu).filter(|_| self.by_other_function) {
            step.pdu = other;
        }
        step
    }

    /// Skips the first action if it changes nothing. With nothing to take away, a pulse starts at once without its
    /// pause, unless its bits were cleared just before: then it starts when they have been low long enough. With
    /// nothing to change, no override is made that would have to be released.
    fn pass_over(&mut self, words: &KnownWords, profile: &Profile, now: Instant) -> Option<Instant> {
        let fell = self.low_since(words, profile);
        self.pop();
        let wait = match self.actions.front() {
            Some(Action::Wait(time)) => *time,
            _ => Duration::ZERO,
        };
        let high_at = fell.map(|fell| fell + wait).filter(|at| now < *at);
        if high_at.is_none() && matches!(self.actions.front(), Some(Action::Wait(_) | Action::Release(_))) {
            self.pop();
        }
        high_at
    }

    /// When the previous command took away the bits of the next pulse: between two pulses they must be low as long
    /// as within one.
    fn low_since(&self, words: &KnownWords, profile: &Profile) -> Option<Instant> {
        let at = profile.control.as_ref()?.at;
        match self.actions.front() {
            Some(Action::Word(Word::ResetLow(reset))) if reset.place.is_none() => {
                words.fell(at.table, at.address, reset.value)
            }
            _ => None,
        }
    }

    /// The motor already runs by this command: only the last word of the sequence is sent, which changes nothing or
    /// only the direction.
    fn only_last_word(&mut self, reverse: Option<bool>) {
        self.phase = Phase::Repeats;
        let last = |action: &Action| matches!(action, Action::Word(Word::Sequence(word, _)) if word.is_last);
        while self.actions.front().is_some_and(|action| !last(action)) {
            self.pop();
        }
        if let Some(Action::Word(word)) = self.actions.front_mut()
            && let Word::Sequence(last, _) = *word
        {
            // A sequence of one word must not begin again with its first word.
            *word = if last.is_first {
                Word::Run(reverse)
            } else {
                Word::Sequence(last, reverse)
            };
        }
    }
}
