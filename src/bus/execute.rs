//! A command step by step: control words from a shadow, pulses, safe order. Pure.

mod actions;
mod shadow;

use std::collections::VecDeque;
use std::time::Instant;

pub use self::shadow::Shadow;

use self::actions::{Action, Check, Known, actions, names_run, request, sets_all_bits, sparing, unsendable};
use self::shadow::{learn, note_write};
use super::confirm::{self, Effect};
use crate::codec::{Exception, Reply, RequestPdu};
use crate::command::{Command, Order, Outcome, Receipt, Ticket, Urgency};
use crate::drive::Profile;

/// What a command needs next.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// This request on the line.
    Send(RequestPdu),
    /// Nothing before then.
    Wait(Instant),
    /// It is done.
    Done,
}

/// A command that the bus has begun.
#[derive(Debug)]
pub struct Execution {
    /// Index of the drive.
    pub drive: usize,
    /// Rank.
    pub urgency: Urgency,
    actions: VecDeque<Action>,
    not_before: Option<Instant>,
    ticket: Ticket,
    effects: Vec<Effect>,
    expires: Instant,
    /// Set when it ends before all was sent.
    cut: Option<Outcome>,
    /// How the last try without an answer failed: [`Outcome::TimedOut`] or [`Outcome::Garbled`].
    unanswered: Outcome,
    /// Nothing is left but the end of a pulse, which is sent whatever happens.
    only_ends: bool,
    reply: Reply,
    failures: u32,
    /// A write was sent and not answered: whether the drive took it is not known.
    in_doubt: bool,
    /// It sets every bit that can be commanded, reset bits apart.
    whole: bool,
    /// It says whether the motor is to run.
    names_run: bool,
    /// What the drive last said of its motor.
    running: bool,
    /// Whether the drive was asked for what it has before it is written.
    check: Check,
    /// The drive does not tell its own word: bits that the command does not set are written as 0.
    blind: bool,
    /// It waited for a late reply since it was decided on last.
    held_up: bool,
}

impl Execution {
    /// Lays the command out in the order that is safe: a stop before anything, references before run, a reset
    /// before a new run edge. One that cannot be sent as a whole is refused; only of a stop goes out what can.
    pub fn new(command: Command, profile: &Profile) -> Execution {
        let Command {
            drive,
            order,
            urgency,
            ticket,
            expires,
            ..
        } = command;
        let effects = confirm::effects(profile, &order);
        let whole = matches!(&order, Order::Points(values) if sets_all_bits(profile, values));
        let names_run = matches!(&order, Order::Points(values) if names_run(profile, values));
        let unsendable = match &order {
            Order::Points(values) => unsendable(profile, values),
            Order::Write(_) | Order::Read(_) => None,
        };
        let actions = match order {
            Order::Write(pdu) | Order::Read(pdu) => VecDeque::from([Action::Send(pdu)]),
            Order::Points(_) if unsendable.is_some() && urgency != Urgency::Stop => VecDeque::new(),
            Order::Points(values) => actions(profile, &values, urgency == Urgency::Stop),
        };
        let actions = actions
            .into_iter()
            .flat_map(|action| sparing(action, profile))
            .collect();
        Execution {
            drive,
            urgency,
            actions,
            not_before: None,
            ticket,
            effects,
            expires,
            cut: unsendable.map(Outcome::Refused),
            unanswered: Outcome::TimedOut,
            only_ends: false,
            reply: Reply::Written,
            failures: 0,
            in_doubt: false,
            whole,
            names_run,
            running: true,
            check: Check::NotYet,
            blind: false,
            held_up: false,
        }
    }

    /// What the command needs next. `running` is what the drive last said. Once its time ran out nothing of it is
    /// sent any more, but a reset bit that is set is taken away.
    pub fn next(&mut self, shadow: &Shadow, profile: &Profile, running: bool, now: Instant) -> Next {
        self.running = running;
        if self.is_late(now) {
            let outcome = if self.failures > 0 || self.in_doubt {
                self.unanswered.clone()
            } else {
                Outcome::Expired
            };
            self.cut_off(outcome);
        }
        if let Some(at) = self.not_before {
            if now < at {
                return Next::Wait(at);
            }
            self.not_before = None;
        }
        loop {
            let Some(action) = self.actions.front() else {
                return Next::Done;
            };
            if let Action::Hold(time) = action {
                let until = now + *time;
                self.actions.pop_front();
                self.not_before = Some(until);
                return Next::Wait(until);
            }
            let known = Known {
                check: self.check,
                blind: self.blind,
                names_run: self.names_run,
                running,
            };
            match request(action, self.drive, shadow, profile, known) {
                Some(pdu) => return Next::Send(pdu),
                // Nothing to take away: the pulse starts at once, without the pause behind. Nothing to change: nothing is
                // overridden that would have to be released.
                None => {
                    self.pop();
                    if matches!(self.actions.front(), Some(Action::Hold(_) | Action::Release(_))) {
                        self.pop();
                    }
                }
            }
        }
    }

    /// It must wait for a late reply: what it has read by then is old.
    pub fn held_up(&mut self) {
        self.held_up = true;
    }

    /// It may go on. Whether it asks again first for what it read before it was held up: a motor may have been stopped
    /// meanwhile.
    pub fn asks_again(&mut self) -> bool {
        let again = std::mem::take(&mut self.held_up) && self.check == Check::Read;
        if again {
            self.check = Check::NotYet;
        }
        again
    }

    fn pop(&mut self) {
        self.actions.pop_front();
        self.check = Check::NotYet;
    }

    /// Its time ran out, and what is left of it was not cut off yet.
    pub fn is_late(&self, now: Instant) -> bool {
        now >= self.expires && !self.only_ends
    }

    /// The drive answered the request that [`Execution::next`] gave. The outcome, when the command is over.
    pub fn answered(&mut self, sent: &RequestPdu, reply: Reply, shadow: &mut Shadow) -> Option<Outcome> {
        // A read between the tries of a write does not make them more.
        if !self.in_doubt || !self.reads_word(sent) {
            self.failures = 0;
        }
        // An exception tells nothing of an earlier try that was not answered.
        if sent.is_write() && !matches!(reply, Reply::Exception(_)) {
            self.in_doubt = false;
        }
        if let (Some(Action::Release(_)), Reply::Exception(code)) = (self.actions.front(), &reply) {
            return self.not_released(&code.to_string());
        }
        if self.checks(sent) {
            self.check = learn(self.drive, sent, &reply, shadow);
            return None;
        }
        if let Reply::Exception(code) = reply {
            let kept_back = [Exception::FUNCTION, Exception::ADDRESS, Exception::VALUE].contains(&code);
            if self.reads_word(sent) && self.goes_on(kept_back && self.knows(sent, shadow)) {
                return None;
            }
            if self.reads_word(sent) && (kept_back || self.urgency == Urgency::Stop) {
                return self.without_word(Outcome::Exception(code));
            }
            return Some(Outcome::Exception(code));
        }
        note_write(self.drive, sent, shadow);
        if let RequestPdu::Read { table, start, .. } = sent
            && self.reads_word(sent)
        {
            // The drive's own word, read because the shadow did not have it, or only as it was once.
            return match reply {
                Reply::Registers(words) => {
                    let word = words.first().copied()?;
                    shadow.learn(self.drive, *table, *start, word);
                    self.check = Check::Read;
                    None
                }
                _ => Some(Outcome::Exception(Exception::DEVICE_FAILURE)),
            };
        }
        if !matches!(self.actions.front(), Some(Action::Release(_))) {
            self.reply = reply;
        }
        self.pop();
        self.actions.is_empty().then(|| self.success())
    }

    /// Whether that request asks for what the drive has before it is written.
    fn checks(&self, sent: &RequestPdu) -> bool {
        matches!(
            (sent, self.actions.front()),
            (RequestPdu::Read { .. }, Some(Action::Change { .. }))
        )
    }

    /// The value stands all the same: a supervisor that looks away does not see changes at the panel, no more.
    fn not_released(&mut self, why: &str) -> Option<Outcome> {
        tracing::warn!("an output was written but not released to the drive's own control: {why}");
        self.failures = 0;
        self.pop();
        self.actions.is_empty().then(|| self.success())
    }

    /// No believable answer came; `how` tells which way. The outcome, when the tries are used up.
    pub fn failed(&mut self, sent: &RequestPdu, how: Outcome, retries: u32) -> Option<Outcome> {
        self.failures += 1;
        self.unanswered = how;
        self.in_doubt |= sent.is_write();
        let over = self.failures > retries;
        if over && matches!(self.actions.front(), Some(Action::Release(_))) {
            return self.not_released("no answer");
        }
        if self.checks(sent) && self.urgency == Urgency::Stop {
            self.check = Check::InVain;
            return None;
        }
        if self.checks(sent) {
            return over.then(|| self.without_answer());
        }
        if self.reads_word(sent) && self.goes_on(false) {
            return None;
        }
        if self.reads_word(sent) && (over || self.urgency == Urgency::Stop) {
            return self.without_word(self.unanswered.clone());
        }
        if sent.is_write() && self.check == Check::Read {
            // By the next try it may have changed again.
            self.check = Check::NotYet;
        }
        over.then(|| self.without_answer())
    }

    fn without_answer(&self) -> Outcome {
        self.cut.clone().unwrap_or_else(|| self.unanswered.clone())
    }

    /// What was sent was acknowledged, perhaps by a late reply to something else.
    pub fn doubted(&mut self) {
        self.in_doubt = true;
    }

    /// Whether the drive may have taken a write that it did not answer: its words are not known then.
    pub fn in_doubt(&self) -> bool {
        self.in_doubt
    }

    /// The word was asked for in vain. Whether the command goes on with what is known all the same: where the drive never
    /// tells it (`untold`), and at the end of a pulse, which no read stands in the way of.
    fn goes_on(&mut self, untold: bool) -> bool {
        let ends = matches!(self.actions.front(), Some(Action::PulseEnd { .. }));
        let goes_on = self.check == Check::NotYet && (untold || ends);
        if goes_on {
            self.check = Check::InVain;
            self.failures = 0;
        }
        goes_on
    }

    /// Whether the shadow has the word that the request reads.
    fn knows(&self, sent: &RequestPdu, shadow: &Shadow) -> bool {
        matches!(sent, RequestPdu::Read { start, .. } if shadow.get(self.drive, *start).is_some())
    }

    /// Whether that request reads the drive's own word, which the shadow did not have, or only as it was once.
    fn reads_word(&self, sent: &RequestPdu) -> bool {
        matches!(sent, RequestPdu::Read { .. }) && !matches!(self.actions.front(), Some(Action::Send(_)) | None)
    }

    /// The drive does not tell its own word. A stop goes out all the same: no read stands in its way. So does a
    /// command to a motor that stands, and one that sets every bit; another one could stop or turn a motor that runs,
    /// and ends with `outcome`.
    fn without_word(&mut self, outcome: Outcome) -> Option<Outcome> {
        if self.urgency != Urgency::Stop && self.running && !self.whole {
            return Some(outcome);
        }
        self.blind = true;
        self.check = Check::InVain;
        self.failures = 0;
        None
    }

    /// A stop came in: what is not sent yet is not sent any more, but a reset bit that is set is taken away.
    /// Whether the command is over by that.
    pub fn purge(&mut self) -> bool {
        self.cut_off(Outcome::Purged);
        self.actions.is_empty()
    }

    fn cut_off(&mut self, outcome: Outcome) {
        let before = self.actions.len();
        // A bit whose setting was sent and not answered may be set.
        if self.failures > 0 && matches!(self.actions.front(), Some(Action::PulseHigh { .. })) {
            self.actions.pop_front();
        }
        let high = self.actions.iter().any(|a| matches!(a, Action::PulseHigh { .. }));
        self.actions
            .retain(|a| !high && matches!(a, Action::PulseEnd { .. } | Action::Hold(_)));
        // A hold without the end of a pulse behind it holds nothing.
        if !self.actions.iter().any(|a| matches!(a, Action::PulseEnd { .. })) {
            self.actions.clear();
        }
        self.only_ends = true;
        if before != self.actions.len() {
            self.cut = Some(outcome);
            self.failures = 0;
        }
    }

    /// How the command ends when nothing is left to do.
    pub fn success(&self) -> Outcome {
        match &self.cut {
            Some(outcome) => outcome.clone(),
            None => Outcome::Acknowledged(self.reply.clone()),
        }
    }

    /// Answers a command that the drive took; what a read must show, and the receipt that tells so.
    pub fn acknowledge(self, outcome: Outcome, now: Instant) -> (Vec<Effect>, Receipt) {
        (self.effects, self.ticket.acknowledge(outcome, now))
    }

    /// Answers the command.
    pub fn finish(self, outcome: Outcome, now: Instant) {
        self.ticket.answer(outcome, now);
    }
}

#[cfg(test)]
mod tests;
