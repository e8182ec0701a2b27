//! The stop of one drive: placed, repeated if it failed, acknowledged.

use std::time::{Duration, Instant};

use super::{Stopped, StoppedDrive};
use crate::order::{Answer, Authority, Order, Origin, Outcome, Refusal};
use crate::plant::{DriveHandle, OrderRequest, Placed, Plant};
use crate::process_image::{Machine, Standstill};
use drivegate_model::drive::{ModelPoint, Value};

/// Wait before a stop that failed is placed again; twice as long each time.
const AGAIN: Duration = Duration::from_millis(100);
/// Longest pause before a failed stop is placed again.
const LONGEST_AGAIN: Duration = Duration::from_secs(1);

/// The stop of one drive.
#[derive(Debug)]
pub(crate) struct OneStop {
    pub(crate) machine: Machine,
    drive: String,
    origin: Origin,
    step: Step,
    /// The reason of the last failed stop.
    failed: Option<String>,
    /// Wait before the stop is repeated.
    pause: Duration,
    /// A read after the acknowledgement showed that the motor is at standstill, and no later read shows it turning.
    stood: bool,
    /// Whether the motor was seen to turn again after it had been standing.
    restarted: bool,
    /// Number of the last command before the stop that may start the drive.
    last_starter: u64,
}

#[derive(Debug)]
enum Step {
    /// The stop is in the queue of its bus, or being sent.
    Placed(Placed),
    /// The stop failed, and is placed again at this time.
    Again(Instant),
    /// The drive acknowledged the stop at this time.
    Acknowledged(Instant),
    /// The stop cannot be given to the drive.
    Refused,
}

impl OneStop {
    /// Gives the drive its stop.
    pub(crate) fn place(drive: &DriveHandle, machine: Machine, origin: &Origin, now: Instant) -> OneStop {
        let mut stop = OneStop::unsent(machine, drive.image.spec.name.clone(), origin);
        stop.try_at(drive, now);
        stop
    }

    /// The stop of a drive of that name, which cannot be given to it.
    pub(super) fn refused(machine: Machine, drive: String, origin: &Origin, refusal: &Refusal) -> OneStop {
        OneStop {
            failed: Some(refusal.to_string()),
            ..OneStop::unsent(machine, drive, origin)
        }
    }

    fn unsent(machine: Machine, drive: String, origin: &Origin) -> OneStop {
        OneStop {
            machine,
            drive,
            // A stop in progress is completed even if a reload removes the client's right.
            origin: origin.clone().lasting(),
            step: Step::Refused,
            failed: None,
            pause: AGAIN,
            stood: false,
            restarted: false,
            last_starter: 0,
        }
    }

    fn try_at(&mut self, drive: &DriveHandle, now: Instant) {
        let profile = &drive.image.spec.profile;
        // The number is taken before the stop is placed: a later command may be sent after the stop.
        self.last_starter = drive.last_starter();
        self.step = match profile.model_index(ModelPoint::Run) {
            Some(run) => {
                let order = Order::Points(vec![(run, Value::Bool(false))]);
                // The right to stop was checked when the stop all was accepted.
                let request = OrderRequest::new(order, self.origin.clone(), Authority::Write).at_once();
                Step::Placed(drive.place(request, now))
            }
            None => {
                self.failed = Some(format!("its profile `{}` has no `run`", profile.name));
                Step::Refused
            }
        };
    }

    /// Whether a stop of this client joins this one, so that nothing is written for it: this one waits for its
    /// acknowledgement or has it, and nothing is known to have started the motor since.
    pub(crate) fn is_joined(&self, drive: &DriveHandle, by: &Origin, now: Instant) -> bool {
        let stands_good = match &self.step {
            Step::Placed(_) => true,
            Step::Acknowledged(at) => {
                let reading = drive.reading(now);
                let run = reading.model(ModelPoint::Run);
                let runs = run.good().is_some_and(|run| run.as_bool()) && run.at.is_some_and(|read| read > *at);
                reading.snapshot.link.is_online() && !self.restarted && !runs
            }
            Step::Again(_) | Step::Refused => false,
        };
        stands_good && drive.joins_stop(self.last_starter, by, now)
    }

    pub(crate) fn is_acknowledged(&self) -> bool {
        matches!(self.step, Step::Acknowledged(_))
    }

    /// Whether the stop cannot be given to the drive.
    pub(crate) fn is_refused(&self) -> bool {
        matches!(self.step, Step::Refused)
    }

    /// Why the stop has not been acknowledged.
    pub(crate) fn why_not(&self) -> String {
        let why = self.failed.as_deref().unwrap_or("it got no reply");
        format!("not acknowledged: {why}")
    }

    /// Whether a read since then shows that the motor is at standstill.
    pub(crate) fn motor_stands(&self, plant: &Plant, now: Instant) -> bool {
        self.outcome(plant, now).outcome == Stopped::Standing
    }

    /// Whether the stop failed at least once.
    pub(crate) fn has_failed(&self) -> bool {
        self.failed.is_some()
    }

    /// Checks the result, and repeats the stop if it failed. A reload may have moved the drive to another bus.
    pub(crate) fn advance(&mut self, plant: &Plant, now: Instant) {
        match &mut self.step {
            Step::Placed(placed) => {
                let accepted = placed.accepted();
                let Some(Answer { outcome, latency }) = placed.answer() else {
                    return;
                };
                self.step = match outcome {
                    outcome if outcome.is_ok() => Step::Acknowledged(accepted + latency),
                    Outcome::Refused(refusal) => {
                        self.failed = Some(refusal.to_string());
                        Step::Refused
                    }
                    outcome => {
                        self.failed = Some(outcome.to_string());
                        let at = now + self.pause;
                        self.pause = LONGEST_AGAIN.min(2 * self.pause);
                        Step::Again(at)
                    }
                };
            }
            Step::Again(at) if now >= *at => match plant.drive_at(&self.machine) {
                Some(drive) => self.try_at(&drive, now),
                None => {
                    self.failed = Some("the drive is no longer configured".to_string());
                    self.step = Step::Refused;
                }
            },
            Step::Acknowledged(at) => {
                let seen = plant
                    .drive_at(&self.machine)
                    .map(|drive| drive.reading(now).standstill(Some(*at)));
                match seen {
                    Some(Standstill::Stands) => self.stood = true,
                    Some(Standstill::Turns(_)) => self.restarted |= std::mem::take(&mut self.stood),
                    // On a slow line a value becomes old before it is read again.
                    Some(Standstill::Unknown(_)) | None => {}
                }
            }
            Step::Again(_) | Step::Refused => {}
        }
    }

    /// The outcome for the drive.
    pub(crate) fn outcome(&self, plant: &Plant, now: Instant) -> StoppedDrive {
        let (outcome, reason) = match (&self.step, plant.drive_at(&self.machine)) {
            (Step::Acknowledged(_), Some(drive)) if self.stood && drive.reading(now).may_turn().is_none() => {
                (Stopped::Standing, None)
            }
            (Step::Acknowledged(at), Some(drive)) => match drive.reading(now).standstill(Some(*at)) {
                Standstill::Stands => (Stopped::Standing, None),
                Standstill::Turns(what) => (
                    Stopped::Stopping,
                    Some(format!("it acknowledged its stop but still turns: {what}")),
                ),
                Standstill::Unknown(why) => (Stopped::Unproven, Some(format!("it acknowledged its stop, but {why}"))),
            },
            (Step::Acknowledged(_), None) => (
                Stopped::Unproven,
                Some("it acknowledged its stop and is no longer configured".to_string()),
            ),
            (Step::Refused, _) => {
                let why = self.failed.as_deref().unwrap_or_default();
                (Stopped::Unproven, Some(format!("its stop was not sent: {why}")))
            }
            (Step::Placed(_) | Step::Again(_), _) => {
                let why = match &self.failed {
                    Some(why) => format!("it did not acknowledge its stop: {why}"),
                    None => "its stop is still waiting for its turn on the line".to_string(),
                };
                (Stopped::Unproven, Some(why))
            }
        };
        StoppedDrive {
            drive: self.drive.clone(),
            outcome,
            reason,
        }
    }
}
