//! Applies the drive's reply to a step of a command, or its absence. Pure.

use std::time::Duration;

use super::awaited_state::LOOK_PAUSE;
use super::functions::other_function;
use super::parameter::Then;
use super::steps::{Action, Check};
use super::word::Word;
use super::{CommandRun, Doubt, Ending, KnownWords, Pause, Phase, Step, StepPurpose};
use drivegate_core::order::{Outcome, Urgency};
use drivegate_proto::{Exception, Reply, RequestPdu};

/// Pause before a parameter is read back once more.
const LOOK_AGAIN: Duration = Duration::from_millis(100);
/// First and longest pause before a step is repeated because the drive was busy.
const BUSY_PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_millis(500));
/// Longest such pause before a stop: a gateway that is about to end has little time for it.
const BUSY_STOP: Duration = Duration::from_millis(100);
/// Number of consecutive attempts to end a pulse. Nothing else ends a pulse.
const MOST_BUSY: u32 = 10;

impl CommandRun {
    /// The drive answered the step that [`CommandRun::next`] gave. The outcome, when the command has ended.
    pub fn answered(&mut self, step: &Step, reply: Reply, words: &mut KnownWords) -> Option<Outcome> {
        if reply == Reply::Exception(Exception::FUNCTION) && self.has_another_function(step, words) {
            return None;
        }
        if self.by_other_function && step.pdu.is_write() && !matches!(reply, Reply::Exception(_)) {
            words.functions.took(&step.pdu);
            self.by_other_function = false;
        }
        if self.parameter().is_some() {
            return self.parameter_answered(step, &reply, words);
        }
        // A successful read between the tries of a write does not allow more tries.
        let is_read = matches!(step.purpose, StepPurpose::ReadWord | StepPurpose::Look);
        if !self.in_doubt() || !is_read {
            self.tries.failures = 0;
        }
        // An exception shows nothing about an earlier try that was not answered.
        if step.pdu.is_write() && !matches!(reply, Reply::Exception(_)) {
            self.tries.doubt = Doubt::No;
        }
        if self.waits_while_busy(step, &reply) {
            return None;
        }
        self.tries.busy = 0;
        match (step.purpose, reply) {
            (StepPurpose::Release, Reply::Exception(code)) => self.not_released(&code.to_string()),
            (StepPurpose::Compare, reply) => {
                self.known.check = learn(step, &reply, words);
                None
            }
            (StepPurpose::ReadWord, Reply::Exception(code)) => self.word_refused(step, code, words),
            (StepPurpose::ReadWord, reply) => match learn(step, &reply, words) {
                Check::Read => {
                    self.known.check = Check::Read;
                    None
                }
                _ => Some(Outcome::Exception(Exception::DEVICE_FAILURE)),
            },
            (StepPurpose::AskState, reply) => self.state_answered(&reply),
            (StepPurpose::Look, Reply::Exception(code)) => {
                self.not_seen(&format!("the drive refused that with {code}"), Outcome::Exception(code))
            }
            (StepPurpose::Look, reply) => {
                self.looked(&reply);
                None
            }
            // The exception does not show what happened to an earlier attempt that was not answered.
            (StepPurpose::Execute, Reply::Exception(code)) if self.in_doubt() => self.ended(Outcome::Unknown(code)),
            (StepPurpose::Execute, Reply::Exception(code)) => self.ended(Outcome::Exception(code)),
            (purpose, reply) => {
                words.written(&step.pdu);
                if let (StepPurpose::Execute, Ending::Acknowledged(of_order)) = (purpose, &mut self.ending) {
                    *of_order = reply;
                }
                if let Some(Action::Word(Word::Direction(to) | Word::Run(Some(to)))) = self.actions.front() {
                    words.direction = Some(*to);
                }
                self.pop();
                self.actions.is_empty().then(|| self.success())
            }
        }
    }

    /// The state for which a sequence waits, or another one.
    fn state_answered(&mut self, reply: &Reply) -> Option<Outcome> {
        if let Reply::Exception(code) = reply
            && !code.is_busy()
        {
            return self.ended(Outcome::Exception(*code));
        }
        let Some(Action::Await(state)) = self.actions.front_mut() else {
            return None;
        };
        if state.is_shown(reply) {
            self.pop();
            return self.actions.is_empty().then(|| self.success());
        }
        self.pause = Pause::Repeat(LOOK_PAUSE);
        None
    }

    /// Ends the command with this outcome; if its sequence started the motor, a stop is sent first.
    fn ended(&mut self, outcome: Outcome) -> Option<Outcome> {
        if self.urgency == Urgency::Stop || self.phase != Phase::MotorStarted {
            let cut = self.ending.cut().cloned().filter(|_| !self.may_write_on());
            return Some(cut.unwrap_or(outcome));
        }
        self.give_up(outcome);
        None
    }

    /// Whether the drive is too busy for the step, which is then retried, for a command until it expires. A read that a
    /// stop can do without, or that only saves a write, is not retried.
    fn waits_while_busy(&mut self, step: &Step, reply: &Reply) -> bool {
        let waits = match step.purpose {
            StepPurpose::Execute => self.urgency != Urgency::Read,
            StepPurpose::ReadWord | StepPurpose::Look => self.urgency != Urgency::Stop && !self.ends_pulse(),
            _ => false,
        };
        // A read that the drive is still processing has changed nothing, so it is repeated.
        let is_busy = matches!(reply, Reply::Exception(code) if code.is_busy()
            || (*code == Exception::ACKNOWLEDGE && matches!(step.purpose, StepPurpose::ReadWord | StepPurpose::Look)));
        if !(is_busy && waits) || (!self.may_write_on() && self.tries.busy >= MOST_BUSY) {
            return false;
        }
        let (first, longest) = match self.urgency {
            Urgency::Stop => (BUSY_PAUSE.0, BUSY_STOP),
            Urgency::Command | Urgency::Read => BUSY_PAUSE,
        };
        self.pause = Pause::Repeat((first * (1 << self.tries.busy.min(5))).min(longest));
        self.tries.busy = self.tries.busy.saturating_add(1);
        if self.known.check == Check::Read {
            // The word may have changed again by the next attempt.
            self.known.check = Check::NotYet;
        }
        true
    }

    pub(super) fn ends_pulse(&self) -> bool {
        self.actions.front().is_some_and(Action::ends_reset)
    }

    /// Notes that the drive does not know the function of a write. Returns whether the other function can be tried,
    /// once: only so can a drive be stopped that accepts functions 15 and 16 only.
    fn has_another_function(&mut self, step: &Step, words: &mut KnownWords) -> bool {
        if matches!(step.pdu, RequestPdu::MaskWrite { .. }) {
            words.functions.refused(&step.pdu);
            return true;
        }
        let tries =
            step.purpose == StepPurpose::Execute && other_function(&step.pdu).is_some() && !self.by_other_function;
        self.by_other_function |= tries;
        tries
    }

    fn parameter_answered(&mut self, step: &Step, reply: &Reply, words: &mut KnownWords) -> Option<Outcome> {
        if step.pdu.is_write() && !matches!(reply, Reply::Exception(_)) {
            words.written(&step.pdu);
        }
        let unanswered = self.tries.unanswered.clone();
        let run = self.parameter()?;
        let then = run.answered(reply, &unanswered);
        if !run.is_in_doubt() {
            (self.tries.failures, self.tries.doubt) = (0, Doubt::No);
        }
        match then {
            Then::Go => None,
            Then::Pause => {
                self.actions.push_front(Action::Wait(LOOK_AGAIN));
                None
            }
            Then::Over(outcome) => {
                self.actions.clear();
                Some(outcome)
            }
        }
    }

    fn word_refused(&mut self, step: &Step, code: Exception, words: &KnownWords) -> Option<Outcome> {
        // The answer to a read does not show whether an earlier write was taken.
        let refused = if self.in_doubt() {
            self.tries.unanswered.clone()
        } else {
            Outcome::Exception(code)
        };
        if let Some((table, address)) = self.settings()
            && words.is_reported(table, address)
        {
            // The drive reported its settings before the refusal: they may have changed since.
            return Some(refused);
        }
        let kept_back = [Exception::FUNCTION, Exception::ADDRESS, Exception::VALUE].contains(&code);
        let known = matches!(&step.pdu, RequestPdu::Read { table, start, .. } if words.get(*table, *start).is_some());
        if self.continues_with_known_word(kept_back && known) {
            return None;
        }
        if kept_back || self.urgency == Urgency::Stop {
            return self.without_word(refused);
        }
        Some(refused)
    }

    /// The value was written but could not be released to the drive's own control, which is logged and is not a
    /// failure: only changes at the panel then have no effect.
    fn not_released(&mut self, why: &str) -> Option<Outcome> {
        tracing::warn!(target: "drivegate::bus::command_run", "an output was written but not released to the drive's own control: {why}");
        self.tries.failures = 0;
        self.pop();
        self.actions.is_empty().then(|| self.success())
    }

    /// No valid reply arrived, for the reason `how`. Returns the outcome when all attempts are used up.
    pub fn failed(&mut self, step: &Step, how: Outcome, retries: u32) -> Option<Outcome> {
        self.tries.failures += 1;
        self.tries.unanswered = how;
        if step.pdu.is_write() {
            self.tries.doubt = self.tries.doubt.max(Doubt::Unanswered);
        }
        let over = self.tries.failures > retries;
        if let Some(run) = self.parameter() {
            if step.purpose == StepPurpose::Release && over {
                // The override stays, so the written value remains in force.
                run.released();
                self.tries.failures = 0;
                return None;
            }
            run.begin_again();
            return over.then(|| self.without_answer());
        }
        match step.purpose {
            StepPurpose::Release if over => return self.not_released("no reply"),
            StepPurpose::Compare if self.urgency == Urgency::Stop => {
                self.known.check = Check::InVain;
                return None;
            }
            StepPurpose::Look => {
                let why = match self.tries.unanswered {
                    Outcome::Garbled => "the drive's reply was garbled",
                    _ => "no reply came",
                };
                return over
                    .then(|| self.not_seen(why, self.tries.unanswered.clone()))
                    .flatten();
            }
            StepPurpose::ReadWord if self.settings().is_some() => return over.then(|| self.without_answer()),
            StepPurpose::ReadWord if self.continues_with_known_word(false) => return None,
            StepPurpose::ReadWord if over || self.urgency == Urgency::Stop => {
                return self.without_word(self.tries.unanswered.clone());
            }
            _ => {}
        }
        if step.pdu.is_write() && self.known.check == Check::Read {
            // The word may have changed again by the next attempt.
            self.known.check = Check::NotYet;
        }
        if over && self.phase == Phase::MotorStarted {
            self.give_up(self.tries.unanswered.clone());
            return None;
        }
        over.then(|| self.without_answer())
    }

    fn without_answer(&self) -> Outcome {
        self.ending.cut().unwrap_or(&self.tries.unanswered).clone()
    }

    /// The step was acknowledged, perhaps by a late reply to another request.
    pub(crate) fn doubted(&mut self) {
        self.ask_before_repeating();
        self.tries.doubt = self.tries.doubt.max(Doubt::Unanswered);
    }

    /// Whether the drive may have received a write that it did not answer: its words are then unknown.
    pub(crate) fn in_doubt(&self) -> bool {
        self.tries.doubt != Doubt::No
    }

    /// The word could not be read. Returns whether the command continues with the known word: if the drive never
    /// reports it (`unreadable`), and at the end of a pulse, which must not wait for a read.
    fn continues_with_known_word(&mut self, unreadable: bool) -> bool {
        let goes_on = self.known.check == Check::NotYet && (unreadable || self.ends_pulse());
        if goes_on {
            self.known.check = Check::InVain;
            self.tries.failures = 0;
        }
        goes_on
    }

    /// Decides how a command continues whose word cannot be read from the drive. A stop is sent anyway; so is a
    /// command to a motor at standstill, and one that sets every bit. Any other command could stop or turn a running
    /// motor, and ends with `outcome`.
    fn without_word(&mut self, outcome: Outcome) -> Option<Outcome> {
        if self.urgency != Urgency::Stop && self.known.running && !self.scope.whole {
            return Some(outcome);
        }
        self.known.blind = true;
        self.known.check = Check::InVain;
        self.tries.failures = 0;
        None
    }
}

/// Stores the drive's words from a reply.
fn learn(step: &Step, reply: &Reply, words: &mut KnownWords) -> Check {
    let (RequestPdu::Read { table, start, count }, Some(read)) = (&step.pdu, reply.words()) else {
        return Check::InVain;
    };
    for (address, word) in (*start..).zip(&read) {
        words.learn(*table, address, *word);
    }
    if read.len() == usize::from(*count) {
        Check::Read
    } else {
        Check::InVain
    }
}
