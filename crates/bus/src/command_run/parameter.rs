//! A parameter that is set as one command: read the value, check that the motor is stopped, write, read back. Pure.
//!
//! A write without a reply is not repeated before its effect has been read.

use super::state_read::StateRead;
use super::steps::{Step, StepPurpose};
use drivegate_core::order::{Outcome, ParameterOrder, Refusal};
use drivegate_core::permit::parameter;
use drivegate_model::drive::Profile;
use drivegate_model::drive::parameters::RawValue;
use drivegate_proto::n2::Session;
use drivegate_proto::{Reply, RequestPdu, Table};

/// Reads of a value that was acknowledged until it counts as not taken.
const LOOKS: u32 = 3;

/// Stage of a parameter write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// The value is read from the drive.
    Value,
    /// The drive is being read to see whether its motor runs.
    Running,
    /// The motor is at standstill: the write must be the next transaction on the line.
    Write,
    /// Releases the N2 override of the parameter.
    Release,
    /// The value is read from the drive again.
    ReadBack,
}

/// What follows a reply to a parameter step.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Then {
    /// The next step follows at once.
    Go,
    /// The next step follows after a pause.
    Pause,
    Over(Outcome),
}

/// A parameter write in progress.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ParameterRun {
    order: ParameterOrder,
    stage: Stage,
    look: StateRead,
    releases: bool,
    /// A write was sent whose effect is not known.
    in_doubt: bool,
    looks: u32,
}

impl ParameterRun {
    /// The run of a parameter write that has not started; `None` if the family does not report whether its motor runs.
    pub(super) fn new(order: ParameterOrder, profile: &Profile) -> Option<ParameterRun> {
        let look = StateRead::at_running(profile)?;
        let mut run = ParameterRun {
            stage: Stage::Value,
            look,
            releases: profile.releases(Table::Holding),
            in_doubt: false,
            looks: 0,
            order,
        };
        run.stage = run.first();
        Some(run)
    }

    fn first(&self) -> Stage {
        match self.order.from {
            Some(_) => Stage::Value,
            None => Stage::Running,
        }
    }

    /// The request of the present stage.
    pub(super) fn step(&self) -> Step {
        let (purpose, pdu) = match self.stage {
            Stage::Value => (StepPurpose::Compare, self.order.read()),
            Stage::Running => (StepPurpose::Look, self.look.request()),
            Stage::Write => (StepPurpose::Execute, self.order.write()),
            Stage::Release => {
                let (table, address) = (Table::Holding, self.order.address);
                (
                    StepPurpose::Release,
                    RequestPdu::N2(Session::Release { table, address }),
                )
            }
            Stage::ReadBack => (StepPurpose::ReadBack, self.order.read()),
        };
        Step { purpose, pdu }
    }

    /// Whether the motor was just found standing, so that the write must be next on the line.
    pub(super) fn is_checked(&self) -> bool {
        self.stage == Stage::Write
    }

    /// Another request was sent first, so the motor state is read again.
    pub(super) fn check_again(&mut self) {
        if self.stage == Stage::Write {
            self.asks_running();
        }
    }

    /// Notes that the write is on the line.
    pub(super) fn written(&mut self) {
        self.in_doubt = true;
    }

    /// No valid reply arrived: the present value of the drive is read before the next write.
    pub(super) fn begin_again(&mut self) {
        if self.stage != Stage::Release {
            self.look.begin_again();
            self.stage = self.first();
        }
    }

    /// Whether a write was sent whose effect is not known.
    pub(super) fn is_in_doubt(&self) -> bool {
        self.in_doubt
    }

    /// Notes that the override was released, or could not be.
    pub(super) fn released(&mut self) {
        self.stage = Stage::ReadBack;
    }

    /// The drive replied to the present step; `unanswered` is the outcome of a write with an unknown result.
    pub(super) fn answered(&mut self, reply: &Reply, unanswered: &Outcome) -> Then {
        match (self.stage, reply) {
            (Stage::Release, _) => {
                self.released();
                Then::Go
            }
            (Stage::Write, Reply::Exception(code)) => {
                self.in_doubt = false;
                Then::Over(Outcome::Exception(*code))
            }
            (_, Reply::Exception(_)) if self.in_doubt => Then::Over(unanswered.clone()),
            (_, Reply::Exception(code)) => Then::Over(Outcome::Exception(*code)),
            (Stage::Write, _) if self.order.from.is_none() => Then::Over(Outcome::Acknowledged(Reply::Written)),
            (Stage::Write, _) if self.releases => self.go(Stage::Release),
            (Stage::Write, _) => self.go(Stage::ReadBack),
            (Stage::Running, reply) => self.take_running(reply, unanswered),
            (Stage::Value, reply) => self.take_value(reply),
            (Stage::ReadBack, reply) => self.take_read_back(reply),
        }
    }

    fn go(&mut self, stage: Stage) -> Then {
        self.stage = stage;
        Then::Go
    }

    /// Reads whether the motor runs, from the first request on.
    fn asks_running(&mut self) -> Then {
        self.look.begin_again();
        self.go(Stage::Running)
    }

    fn take_running(&mut self, reply: &Reply, unanswered: &Outcome) -> Then {
        if !self.look.take_reply(reply) {
            return Then::Go;
        }
        // A reply without the running state does not prove that the motor is at standstill.
        match parameter(self.look.runs()) {
            Ok(()) => self.go(Stage::Write),
            Err(_) if self.in_doubt && self.order.from.is_none() => Then::Over(unanswered.clone()),
            Err(refusal) => Then::Over(Outcome::Refused(refusal)),
        }
    }

    fn value(&self, reply: &Reply) -> Option<RawValue> {
        RawValue::of_words(&reply.words().unwrap_or_default())
    }

    fn take_value(&mut self, reply: &Reply) -> Then {
        let value = self.value(reply);
        if value.is_some_and(|value| self.order.to.is_shown_by(value)) {
            // The reply itself shows the client that nothing was written.
            let reply = if self.in_doubt { Reply::Written } else { reply.clone() };
            return Then::Over(Outcome::Acknowledged(reply));
        }
        let before = self.order.from;
        if value.zip(before).is_some_and(|(value, from)| from.is_shown_by(value)) {
            // The drive has the former value, so an earlier write was not taken.
            self.in_doubt = false;
            return self.asks_running();
        }
        let shown = shown(value);
        Then::Over(if self.in_doubt {
            Outcome::NotTaken(shown)
        } else {
            Outcome::Refused(Refusal::OtherValue(format!(
                "{shown}, neither its value when the restore started ({}) nor the one to restore ({}): someone \
                 changed it; nothing was written",
                before.map_or(f64::NAN, RawValue::number),
                self.order.to.number()
            )))
        })
    }

    fn take_read_back(&mut self, reply: &Reply) -> Then {
        let value = self.value(reply);
        if value.is_some_and(|value| self.order.to.is_shown_by(value)) {
            return Then::Over(Outcome::Acknowledged(Reply::Written));
        }
        self.looks += 1;
        if self.looks < LOOKS {
            return Then::Pause;
        }
        Then::Over(Outcome::NotTaken(shown(value)))
    }
}

fn shown(value: Option<RawValue>) -> String {
    match value {
        Some(value) => format!("it reads {}", value.number()),
        None => "it does not read as a value".to_string(),
    }
}
