//! The observations of a drill once the motor should stop, and the verdict. Each reading is dated as early as
//! possible, since a reply may be a late reply to an earlier request: such a reading proves that the motor still
//! turned at that earlier time. Standstill is proven only at the moment when the reading is evaluated; a standstill
//! not seen in time is not proven.

use std::time::{Duration, Instant, SystemTime};

use super::interruption::{LOCAL, is_local};
use super::{Cause, READ, Run, Step};
use crate::drill::{DrillState, Kind, Proof};
use crate::order::Outcome;
use crate::plant::Placed;
use crate::process_image::{Reading, Standstill};
use crate::stop_all::OneStop;

/// Time after a silence within which the first reading of the drive counts as its state at the end of the silence:
/// on a sound line a reading takes no longer.
const AT_ONCE: Duration = Duration::from_millis(500);

/// What a test of a drill has shown.
enum Observation {
    Nothing,
    Stood { took: Duration, upper_bound: bool },
    Ended(DrillState, String),
}

impl Run {
    pub(super) fn check_cause(
        &mut self,
        cause: Instant,
        mut how: Cause,
        reading: &Reading<'_>,
        (now, time): (Instant, SystemTime),
    ) {
        if !matches!(how, Cause::Client { .. }) {
            // Here the drill does not act as a silent client: its heartbeat prevents the lease from writing a stop.
            self.drive.heartbeat(&self.own, now);
        }
        let by_the_gateway = !matches!(how, Cause::Gateway(_));
        let seen = match &mut how {
            Cause::Order(placed) => self.seen_of_order(cause, placed, reading, now),
            Cause::Client { stopped } => match self.seen_since(cause, cause, reading, now) {
                Observation::Stood { .. } if !*stopped => {
                    let why = "the motor stopped before its supervision acted".to_string();
                    Observation::Ended(DrillState::NotProven, why)
                }
                seen => seen,
            },
            Cause::Gateway(until) => self.seen_after(cause, *until, reading, now),
        };
        let Some(step) = self.report.steps.get_mut(self.at) else {
            return;
        };
        let kind = step.kind;
        match seen {
            Observation::Nothing => self.step = Step::Caused(cause, how),
            Observation::Stood { took, upper_bound } => {
                step.state = DrillState::Passed;
                step.took_ms = Some(u64::try_from(took.as_millis()).unwrap_or(u64::MAX));
                step.upper_bound = upper_bound;
                let at_most = if upper_bound { "at most " } else { "" };
                step.seen = format!("standstill after {at_most}{:.1} s", took.as_secs_f64());
                self.proofs.push(Proof::new(&self.machine, kind, time, true));
                self.report.text.clone_from(&step.seen);
                let stop = OneStop::place(&self.drive, self.machine.clone(), &self.own, now);
                self.stops = self.drive.stops();
                if self.at + 1 < self.report.steps.len() {
                    self.go(Step::Clearing(stop), now);
                } else {
                    self.report.text = "the motor stopped in time each way".to_string();
                    self.go(Step::Ending(DrillState::Passed, stop), now);
                }
            }
            // The stop that the drill should have given or observed may be late for this reason.
            Observation::Ended(DrillState::Failed, why) if by_the_gateway && self.paused.is_some() => {
                let seconds = self.paused.unwrap_or_default().as_secs_f64();
                let why = format!("the gateway paused for {seconds:.1} s meanwhile; {why}");
                self.end(DrillState::NotProven, why, now);
            }
            Observation::Ended(DrillState::Failed, why) => self.failed(kind, why, (now, time)),
            Observation::Ended(state, why) => self.end(state, why, now),
        }
    }

    fn failed(&mut self, kind: Kind, why: String, (now, time): (Instant, SystemTime)) {
        self.proofs.push(Proof::new(&self.machine, kind, time, false));
        self.end(DrillState::Failed, why, now);
    }

    fn seen_of_order(
        &mut self,
        cause: Instant,
        placed: &mut Placed,
        reading: &Reading<'_>,
        now: Instant,
    ) -> Observation {
        let accepted = placed.accepted();
        let why = match placed.answer() {
            Some(answer) if answer.outcome.is_ok() => {
                return self.seen_since(cause, accepted + answer.latency, reading, now);
            }
            Some(answer) if matches!(answer.outcome, Outcome::Exception(_) | Outcome::Refused(_)) => {
                return Observation::Ended(DrillState::Failed, format!("the stop failed: {}", answer.outcome));
            }
            Some(answer) => format!("the stop was not acknowledged: {}", answer.outcome),
            None if now <= cause + self.options.limit => return Observation::Nothing,
            None => "the stop was not acknowledged in time".to_string(),
        };
        match self.seen_since(cause, cause, reading, now) {
            Observation::Stood { .. } => Observation::Ended(DrillState::NotProven, why),
            Observation::Ended(state, seen) => Observation::Ended(state, format!("{why}; {seen}")),
            Observation::Nothing => Observation::Nothing,
        }
    }

    /// Whether reads after `since` show that the motor had stopped within the limit.
    fn seen_since(&self, cause: Instant, since: Instant, reading: &Reading<'_>, now: Instant) -> Observation {
        let (limit, due) = (self.options.limit.as_secs_f64(), cause + self.options.limit);
        let passed = now.saturating_duration_since(cause);
        match reading.standstill_read(Some(since)) {
            (Standstill::Stands, _) if now <= due => Observation::Stood {
                took: passed,
                upper_bound: false,
            },
            (Standstill::Stands, _) => {
                let seconds = passed.as_secs_f64();
                let why = format!("standstill was seen first after {seconds:.1} s; the limit is {limit} s");
                Observation::Ended(DrillState::NotProven, why)
            }
            (Standstill::Turns(what), Some(at)) if at > due => {
                let why = format!("after {limit} s the motor still turns: {what}");
                Observation::Ended(DrillState::Failed, why)
            }
            _ if now <= due + READ => Observation::Nothing,
            (Standstill::Unknown(why), _) => not_observed(&why),
            _ => not_observed("it has not been read since"),
        }
    }

    /// Whether the first reads after the silence show the motor at standstill.
    fn seen_after(&self, cause: Instant, until: Instant, reading: &Reading<'_>, now: Instant) -> Observation {
        if now < until {
            return Observation::Nothing;
        }
        let limit = self.options.limit.as_secs_f64();
        match reading.standstill(Some(until)) {
            // The cause of the standstill may be the switch to local control, so the drill proves nothing.
            Standstill::Stands if is_local(reading) => Observation::Ended(DrillState::Aborted, LOCAL.to_string()),
            Standstill::Stands if now <= until + AT_ONCE => Observation::Stood {
                took: now.saturating_duration_since(cause),
                upper_bound: true,
            },
            Standstill::Stands => {
                let late = now.saturating_duration_since(until).as_secs_f64();
                let why = format!(
                    "the motor stands, but was read only {late:.1} s after the silence of {limit} s: replies were lost, the line was \
                     busy, or the gateway paused"
                );
                Observation::Ended(DrillState::NotProven, why)
            }
            Standstill::Turns(what) => {
                let why = format!("after a silence of {limit} s the motor still turns: {what}");
                Observation::Ended(DrillState::Failed, why)
            }
            Standstill::Unknown(_) if now < until + READ => Observation::Nothing,
            Standstill::Unknown(why) => not_observed(&why),
        }
    }
}

fn not_observed(why: &str) -> Observation {
    Observation::Ended(DrillState::NotProven, format!("standstill was not observed: {why}"))
}
