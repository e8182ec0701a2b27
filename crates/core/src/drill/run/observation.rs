//! What a drill observes once the motor should stop, and the verdict.

use std::time::{Duration, Instant, SystemTime};

use super::interruption::{LOCAL, is_local};
use super::{Cause, READ, Run, Step};
use crate::drill::{DrillState, Kind, Proof};
use crate::plant::Placed;
use crate::process_image::{Reading, Standstill};
use crate::stop_all::OneStop;

/// The observation of a test.
enum Seen {
    Nothing,
    Stood { took: Duration, upper_bound: bool },
    Ended(DrillState, String),
}

impl Run {
    pub(super) fn look_at_cause(
        &mut self,
        cause: Instant,
        mut how: Cause,
        reading: &Reading<'_>,
        (now, time): (Instant, SystemTime),
    ) {
        if !matches!(how, Cause::Client { .. }) {
            // Its supervision is to write no stop meanwhile.
            self.drive.heartbeat(&self.own, now);
        }
        let seen = match &mut how {
            Cause::Order(placed) => self.seen_of_order(cause, placed, reading, now),
            Cause::Client { stopped } => match self.seen_since(cause, cause, reading, now) {
                Seen::Stood { .. } if !*stopped => {
                    let why = "the motor stopped before its supervision acted".to_string();
                    Seen::Ended(DrillState::NotProven, why)
                }
                seen => seen,
            },
            Cause::Gateway(until) => self.seen_after(cause, *until, reading, now),
        };
        let limit = self.options.limit;
        let Some(step) = self.report.steps.get_mut(self.at) else {
            return;
        };
        let kind = step.kind;
        match seen {
            Seen::Nothing => self.step = Step::Caused(cause, how),
            Seen::Stood { took, upper_bound } if took <= limit || upper_bound => {
                step.state = DrillState::Passed;
                step.took_ms = Some(u64::try_from(took.as_millis()).unwrap_or(u64::MAX));
                step.upper_bound = upper_bound;
                let at_most = if upper_bound { "at most " } else { "" };
                step.seen = format!("standstill after {at_most}{:.1} s", took.as_secs_f64());
                self.proofs.push(Proof::new(&self.machine, kind, time, true));
                self.report.text.clone_from(&step.seen);
                let stop = OneStop::place(&self.drive, self.machine.clone(), &self.own, now);
                self.stops = self.drive.stops();
                match self.at + 1 < self.report.steps.len() {
                    true => self.go(Step::Clearing(stop), now),
                    false => {
                        self.report.text = "the motor stopped in time each way".to_string();
                        self.go(Step::Ending(DrillState::Passed, stop), now);
                    }
                }
            }
            Seen::Stood { took, .. } => {
                let why = format!(
                    "standstill after {:.1} s; the limit is {} s",
                    took.as_secs_f64(),
                    limit.as_secs_f64()
                );
                self.failed(kind, why, (now, time));
            }
            Seen::Ended(DrillState::Failed, why) => self.failed(kind, why, (now, time)),
            Seen::Ended(state, why) => self.end(state, why, now),
        }
    }

    fn failed(&mut self, kind: Kind, why: String, (now, time): (Instant, SystemTime)) {
        self.proofs.push(Proof::new(&self.machine, kind, time, false));
        self.end(DrillState::Failed, why, now);
    }

    fn seen_of_order(&mut self, cause: Instant, placed: &mut Placed, reading: &Reading<'_>, now: Instant) -> Seen {
        let accepted = placed.accepted();
        match placed.answer() {
            None if now.saturating_duration_since(cause) <= self.options.limit => Seen::Nothing,
            None => Seen::Ended(DrillState::Failed, "the stop was not acknowledged in time".to_string()),
            Some(answer) if answer.outcome.is_ok() => self.seen_since(cause, accepted + answer.latency, reading, now),
            Some(answer) => Seen::Ended(DrillState::Failed, format!("the stop failed: {}", answer.outcome)),
        }
    }

    /// Whether reads after `since` show that the motor stands.
    fn seen_since(&self, cause: Instant, since: Instant, reading: &Reading<'_>, now: Instant) -> Seen {
        let passed = now.saturating_duration_since(cause);
        match reading.standstill(Some(since)) {
            Standstill::Stands => Seen::Stood {
                took: passed,
                upper_bound: false,
            },
            _ if passed <= self.options.limit => Seen::Nothing,
            Standstill::Turns(what) => {
                let seconds = self.options.limit.as_secs_f64();
                Seen::Ended(
                    DrillState::Failed,
                    format!("after {seconds} s the motor still turns: {what}"),
                )
            }
            Standstill::Unknown(why) => {
                Seen::Ended(DrillState::NotProven, format!("standstill was not observed: {why}"))
            }
        }
    }

    /// Whether the first reads after the silence show that the motor stands.
    fn seen_after(&self, cause: Instant, until: Instant, reading: &Reading<'_>, now: Instant) -> Seen {
        if now < until {
            return Seen::Nothing;
        }
        match reading.standstill(Some(until)) {
            // Whether it was this switch that stopped it is not known.
            Standstill::Stands if is_local(reading) => Seen::Ended(DrillState::Aborted, LOCAL.to_string()),
            Standstill::Stands => Seen::Stood {
                took: until.saturating_duration_since(cause),
                upper_bound: true,
            },
            Standstill::Turns(what) => {
                let seconds = self.options.limit.as_secs_f64();
                let why = format!("after a silence of {seconds} s the motor still turns: {what}");
                Seen::Ended(DrillState::Failed, why)
            }
            Standstill::Unknown(_) if now < until + READ => Seen::Nothing,
            Standstill::Unknown(why) => {
                Seen::Ended(DrillState::NotProven, format!("standstill was not observed: {why}"))
            }
        }
    }
}
