//! Leases: a gateway that polls keeps a drive's own watchdog content even when nobody commands the drive any more.
//! So a drive can have a lease, renewed by accepted writes and heartbeats of a commanding client; when it runs out
//! while the drive runs, the configured action is written once. Not a safety function.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::oneshot::Receiver;

use crate::cache::{DriveSpec, LeaseAction, Reading, Unavailable};
use crate::command::{Answer, Origin, Outcome, Refusal, SourceKind, WriteStats};
use crate::drive::{ModelPoint, Value};
use crate::event::{Event, EventKind, Events};
use crate::plant::{self, BusHandle};

/// How long an action that was not acknowledged waits before it is written again.
const AGAIN: Duration = Duration::from_secs(1);

/// Process data older than this does not tell whether the motor runs.
const FRESH: Duration = Duration::from_secs(2);

/// Watches the leases of one bus.
#[derive(Debug)]
pub struct Leases {
    events: Events,
    stats: Arc<WriteStats>,
    owed: Vec<Owed>,
}

/// An action that is not acknowledged yet. That it is owed stands in the drive's image, which outlives the bus; here is
/// how far it got.
#[derive(Debug)]
struct Owed {
    drive: usize,
    answer: Option<Receiver<Answer>>,
    next_try: Instant,
    /// Why it could not be written, as it was told.
    refused: Option<Refusal>,
}

impl Leases {
    /// Watches with these listeners and counters.
    pub fn new(events: Events, stats: Arc<WriteStats>) -> Leases {
        Leases {
            events,
            stats,
            owed: Vec::new(),
        }
    }

    /// Looks for leases that ran out and for actions that are still owed.
    pub fn look(&mut self, bus: &BusHandle, now: Instant) {
        let drives = bus.image.drives.iter().enumerate();
        for (index, drive) in drives.filter(|(_, drive)| drive.spec.supervision.is_some()) {
            let reading = drive.reading(now, FRESH);
            // Of a drive that does not answer nobody knows whether it runs: its lease stays until it is back.
            if let Some(running) = reading.model(ModelPoint::Running).good().map(Value::as_bool)
                && (running || !may_start(&reading))
                && drive.lease_ran_out(now)
                && running
            {
                drive.count_supervision();
                self.tell_ran_out(&drive.spec);
                drive.owe_action(true);
            }
            if drive.owes_action() && !self.owed.iter().any(|o| o.drive == index) {
                self.owed.push(Owed {
                    drive: index,
                    answer: None,
                    next_try: now,
                    refused: None,
                });
            }
        }
        self.settle(bus, now);
        let mut owed = std::mem::take(&mut self.owed);
        let due = |item: &&mut Owed| item.answer.is_none() && item.next_try <= now;
        for item in owed.iter_mut().filter(due) {
            self.attempt(item, bus, now);
        }
        self.owed = owed;
    }

    /// Takes note of what was answered: an action that was acknowledged is owed no more.
    pub fn settle(&mut self, bus: &BusHandle, now: Instant) {
        self.owed.retain_mut(|item| {
            let Some(drive) = bus.image.drives.get(item.drive) else {
                return false;
            };
            // One that could not be written while nobody commanded must not surprise a client that is back.
            let overtaken = item.answer.is_none() && item.refused.is_some() && drive.has_lease();
            let over = item.settled(now) || overtaken;
            if over {
                drive.owe_action(false);
            }
            !over
        });
    }

    fn tell_ran_out(&self, spec: &DriveSpec) {
        let Some(supervision) = &spec.supervision else {
            return;
        };
        let action = match supervision.action {
            LeaseAction::Stop => "the drive is stopped".to_string(),
            LeaseAction::Hold => "nothing is written".to_string(),
            LeaseAction::SpeedReference(percent) => format!("the speed reference is set to {percent} %"),
        };
        let (name, timeout) = (&spec.name, supervision.timeout);
        self.tell(
            spec,
            format!("no commanding client of {name} for {timeout:?}: {action}"),
        );
    }

    fn tell(&self, spec: &DriveSpec, text: String) {
        self.events.tell(Event {
            id: 0,
            time: SystemTime::now(),
            kind: EventKind::Supervision,
            bus: spec.bus.clone(),
            drive: Some(spec.name.clone()),
            fault_code: None,
            text,
        });
    }

    /// Writes the action. Nothing reaches a drive that does not answer: it is written when the drive is back.
    fn attempt(&self, item: &mut Owed, bus: &BusHandle, now: Instant) {
        let Some(drive) = bus.image.drives.get(item.drive) else {
            return;
        };
        let reading = drive.reading(now, FRESH);
        if !reading.snapshot.link.is_online() {
            return;
        }
        let (point, value) = match drive.spec.supervision.as_ref().map(|s| &s.action) {
            Some(LeaseAction::Stop) => (ModelPoint::Run, Value::Bool(false)),
            Some(LeaseAction::SpeedReference(percent)) => (ModelPoint::SpeedReference, Value::Number(*percent)),
            Some(LeaseAction::Hold) | None => return,
        };
        let origin = Origin::new(SourceKind::Supervision, "lease");
        match bus.own_order(item.drive, &reading, point, value, origin.clone(), &self.stats) {
            Ok(answer) => item.answer = Some(answer),
            Err(refusal) => {
                item.next_try = now + AGAIN;
                if item.refused.as_ref() == Some(&refusal) {
                    return;
                }
                let what = format!("{}={value}", point.name());
                let text = format!(
                    "the lease of {} ran out, and {what} cannot be written: {refusal}; it is tried again every \
                     {AGAIN:?}, until a client commands the drive",
                    drive.spec.name
                );
                self.tell(&drive.spec, text);
                item.refused = Some(refusal.clone());
                plant::turn_away(
                    &self.stats,
                    &drive.spec.name,
                    &what,
                    Outcome::Refused(refusal),
                    origin,
                    now,
                );
            }
        }
    }
}

/// Whether a motor that stands may start without another command: the run command is set in the drive's word, or is not
/// read yet. Of a drive that does not tell it, it is taken to be unset.
fn may_start(reading: &Reading<'_>) -> bool {
    if let Some(run) = reading.model(ModelPoint::Run).good() {
        return run.as_bool();
    }
    let run = reading.spec.profile.model_point(ModelPoint::Run).and_then(|p| p.raw());
    run.is_some_and(|raw| reading.words(raw.table, raw.address, 1) == Err(Unavailable::Stale))
}

impl Owed {
    /// Whether the action was acknowledged; one that failed is owed again after a pause.
    fn settled(&mut self, now: Instant) -> bool {
        let Some(answer) = &mut self.answer else { return false };
        match answer.try_recv() {
            Ok(answer) if answer.outcome.is_ok() => true,
            Err(tokio::sync::oneshot::error::TryRecvError::Empty) => false,
            Ok(_) | Err(_) => {
                self.answer = None;
                self.next_try = now + AGAIN;
                false
            }
        }
    }
}

#[cfg(test)]
mod tests;
