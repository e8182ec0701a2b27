//! The guards of one bus: their results for its drives. The rules that use them are in `permit`. Pure: time is an argument.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::ledger::{Guards, SaveProgress};
use super::motor::Motor;
use super::start_attempt::ByRun;
use super::{Guard, Guarded, Interlock, MotorReading, Reason, Unable, Unmet, shown};
use crate::order::{Effects, Refusal};
use crate::process_image::{BusSpec, DriveSpec, Link, Machine, Reading, Standstill};
use drivegate_model::drive::{DriveIndex, ModelPoint, PerDrive, Plan, Value};

/// Time until a start that waits for the disk is looked at again.
const LOOK: Duration = Duration::from_millis(2);

/// The guards of the drives of one bus.
#[derive(Debug)]
pub struct BusGuards {
    shared: Arc<Guards>,
    /// Guards by index of the drive on the bus; `None` for a drive without guards.
    drives: PerDrive<Option<Guarding>>,
}

/// The guards of one drive.
#[derive(Debug)]
struct Guarding {
    machine: Machine,
    group: Arc<str>,
    guard: Guard,
    interlocks: Vec<Interlock>,
    /// Whether the drive reports that its motor runs.
    tells_running: bool,
}

/// Whether a cleared start may be written now.
#[derive(Debug, Clone, PartialEq)]
pub enum Clearance {
    /// The start is permitted: counted, and on disk.
    Go,
    /// The start is not cleared before this time.
    Wait(Instant),
    /// The start is refused because it cannot be counted.
    Refused(Guarded),
}

impl BusGuards {
    /// The guards of a bus; `None` if none of its drives is guarded. They take effect with [`BusGuards::begin`].
    pub fn of<'d>(
        shared: &Arc<Guards>,
        bus: &BusSpec,
        drives: impl IntoIterator<Item = &'d DriveSpec>,
    ) -> Option<Arc<BusGuards>> {
        let drives = drives.into_iter().map(|drive| {
            if !drive.counts_starts() {
                return None;
            }
            let profile = &drive.profile;
            let running = profile.model_index(ModelPoint::Running);
            Some(Guarding {
                machine: bus.machine(drive),
                group: drive.starts_with(),
                guard: drive.guard.unwrap_or_default(),
                interlocks: drive.interlocks.clone(),
                tells_running: running.is_some_and(|index| Plan::of(profile).shows(profile, index)),
            })
        });
        let drives: PerDrive<Option<Guarding>> = drives.collect();
        let any = drives.iter().any(Option::is_some);
        any.then(|| {
            Arc::new(BusGuards {
                shared: shared.clone(),
                drives,
            })
        })
    }

    /// Puts these guards into effect, when the bus is about to start. Until then, and if the reload is refused, the
    /// drives keep the guards of the previous bus.
    pub fn begin(&self) {
        let mut ledger = self.shared.lock();
        for of in self.drives.iter().flatten() {
            ledger.register(&of.machine, &of.group);
        }
    }

    fn of_drive(&self, drive: DriveIndex) -> Option<&Guarding> {
        self.drives.get(drive)?.as_ref()
    }

    /// Whether the starts of that drive count.
    pub fn guards(&self, drive: DriveIndex) -> bool {
        self.of_drive(drive).is_some()
    }

    /// Guarded drives that an order with these effects may start.
    pub fn started_by(&self, effects: &Effects) -> impl Iterator<Item = DriveIndex> {
        let started = effects
            .iter()
            .filter(|(drive, effect)| effect.starts() && self.by_run(*drive) != ByRun::Runs);
        started.map(|(drive, _)| drive)
    }

    /// Effect on the motor of a run command written now; a drive without guards counts as running.
    pub fn by_run(&self, drive: DriveIndex) -> ByRun {
        let Some(of) = self.of_drive(drive) else {
            return ByRun::Runs;
        };
        self.shared.lock().motor(&of.machine).map_or(ByRun::Runs, Motor::by_run)
    }

    /// Whether a cleared start of an order has not been written to the drive yet: that order starts the motor, if
    /// anything does.
    pub fn has_cleared(&self, drive: DriveIndex) -> bool {
        let Some(of) = self.of_drive(drive) else { return false };
        let ledger = self.shared.lock();
        ledger.motor(&of.machine).is_some_and(|motor| motor.reserved.is_some())
    }

    /// Whether the start of that order was cleared for the drive.
    pub fn is_cleared(&self, drive: DriveIndex, number: u64) -> bool {
        let Some(of) = self.of_drive(drive) else { return false };
        let ledger = self.shared.lock();
        ledger.motor(&of.machine).is_some_and(|motor| motor.is_cleared(number))
    }

    /// Why the guard of the drive does not permit a start now, and when it will.
    pub fn hindered(&self, drive: DriveIndex, now: Instant) -> Option<Guarded> {
        let of = self.of_drive(drive)?;
        self.shared.lock().hindered(&of.machine, &of.guard, now)
    }

    /// Why interlocks prevent a start of the drive now.
    pub fn interlocked(&self, drive: DriveIndex, now: Instant) -> Option<Guarded> {
        self.interlocked_of(self.of_drive(drive)?, now)
    }

    /// A refusal if the motor ran or could not start when the order was judged, and that has changed since: the
    /// order would be a start that was never cleared.
    pub fn changed_since(&self, drive: DriveIndex) -> Option<Guarded> {
        let of = self.of_drive(drive)?;
        Some(Guarded {
            reason: Reason::MinOff,
            why: "the motor was running, or the drive could not start, when the command arrived, and that has changed since; \
                  send it again"
                .to_string(),
            retry_after: of.guard.min_off,
        })
    }

    /// A refusal if this drive must not be started together with the other drives of the same order.
    pub fn too_close_together(&self, drive: DriveIndex, effects: &Effects) -> Option<Guarded> {
        let of = self.of_drive(drive).filter(|of| !of.guard.stagger.is_zero())?;
        let others = self
            .started_by(effects)
            .filter(|other| self.by_run(*other) != ByRun::Repeats);
        let mut others = others.filter_map(|other| self.of_drive(other));
        others.find(|other| other.machine != of.machine && other.group == of.group)?;
        Some(Guarded {
            reason: Reason::Stagger,
            why: format!(
                "one command would start several drives whose starts must be {} apart (guard.stagger); start them one \
                 by one",
                shown(of.guard.stagger)
            ),
            retry_after: of.guard.stagger,
        })
    }

    /// Why the motor must not be started now, as text for people; nothing is counted.
    pub(crate) fn hindrance(&self, drive: DriveIndex, now: Instant) -> Option<Guarded> {
        let of = self.of_drive(drive)?;
        let interlocked = self.interlocked_of(of, now);
        interlocked.or_else(|| {
            let ledger = self.shared.lock();
            // A motor that runs by its order, with a reference of zero, is not hindered.
            let by_run = ledger.motor(&of.machine).map(Motor::by_run);
            let starts = !matches!(by_run, Some(ByRun::Runs | ByRun::Repeats));
            starts.then(|| ledger.hindered(&of.machine, &of.guard, now)).flatten()
        })
    }

    /// The interlocks that no longer hold and require the running motor of the drive to stop; `stood` is the end of
    /// the last pause of its bus.
    pub fn tripped(&self, drive: DriveIndex, stood: Option<Instant>, now: Instant) -> Vec<Unmet> {
        let Some(of) = self.of_drive(drive) else {
            return Vec::new();
        };
        let around = self.shared.around();
        let trips = of.interlocks.iter().filter(|interlock| interlock.trip);
        trips
            .filter_map(|interlock| interlock.trips(&around, stood, now))
            .collect()
    }

    /// Whether an interlock of the drive stops its motor.
    pub fn trips(&self, drive: DriveIndex) -> bool {
        let of = self.of_drive(drive);
        of.is_some_and(|of| of.interlocks.iter().any(|interlock| interlock.trip))
    }

    fn interlocked_of(&self, of: &Guarding, now: Instant) -> Option<Guarded> {
        if of.interlocks.is_empty() {
            return None;
        }
        let around = self.shared.around();
        let unmet = of
            .interlocks
            .iter()
            .filter_map(|interlock| interlock.unmet(&around, now));
        let unmet: Vec<String> = unmet.map(|unmet| unmet.to_string()).collect();
        (!unmet.is_empty()).then(|| Guarded {
            reason: Reason::Interlock,
            why: format!("an interlock is not satisfied: {}", unmet.join(", ")),
            retry_after: Duration::ZERO,
        })
    }

    /// Clears an order that is about to be sent: its starts of these drives are counted once, and it is sent when
    /// they are on disk. The order is not written later than `expires`.
    pub fn clear(&self, started: &[DriveIndex], number: u64, expires: Instant, now: Instant) -> Clearance {
        let started: Vec<&Guarding> = started.iter().filter_map(|drive| self.of_drive(*drive)).collect();
        let mut ledger = self.shared.lock();
        let mut changed = false;
        for of in &started {
            let Some(motor) = ledger.motor(&of.machine) else {
                continue;
            };
            if motor.by_run() == ByRun::Starts && !motor.is_cleared(number) {
                ledger.reserve(&of.machine, number, expires, now);
                changed = true;
            }
        }
        if changed {
            self.shared.notify_change();
        }
        let mut clearance = Clearance::Go;
        for of in &started {
            let Some(reserved) = ledger.motor(&of.machine).and_then(|motor| motor.reserved) else {
                continue;
            };
            match ledger.kept(&reserved, now) {
                SaveProgress::Yes => {}
                SaveProgress::NotYet => clearance = Clearance::Wait(now + LOOK),
                SaveProgress::Failed(why) => {
                    started.iter().for_each(|of| ledger.withdraw(&of.machine));
                    return Clearance::Refused(Guarded {
                        reason: Reason::StateFile,
                        why: format!("its start cannot be counted: {why}; check state_dir of [gateway] and the disk"),
                        retry_after: super::ledger::DISK,
                    });
                }
            }
        }
        clearance
    }

    /// Counts a start of the drive that its guard or an interlock refused.
    pub fn count_refused(&self, drive: DriveIndex, refusal: &Refusal) {
        let reason = match refusal {
            Refusal::Guarded(guarded) => guarded.reason,
            Refusal::Interlocked(_) => Reason::Interlock,
            _ => return,
        };
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().count_refused(&of.machine, reason);
        }
    }

    /// Notes that a word of a command of this client that starts the motor is being sent.
    pub fn start_written(&self, drive: DriveIndex, number: u64, client: &Arc<str>, now: Instant) {
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().start_written(&of.machine, number, client, now);
            self.shared.notify_change();
        }
    }

    /// Ends a cleared command: its unwritten starts count as made.
    pub fn settle(&self, drive: DriveIndex, number: u64) {
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().settle(&of.machine, Some(number));
        }
    }

    /// The drive acknowledged a start or a stop.
    pub fn acknowledged(&self, drive: DriveIndex, run: bool, now: Instant) {
        if let Some(of) = self.of_drive(drive).filter(|of| !of.tells_running) {
            self.shared.lock().with(&of.machine, |motor| {
                if run {
                    motor.start_acknowledged(now)
                } else {
                    motor.stop_acknowledged(now)
                }
            });
        }
    }

    /// Notes that a stop is being sent.
    pub fn stop_written(&self, drive: DriveIndex, now: Instant) {
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().with(&of.machine, |motor| motor.stop_written(now));
        }
    }

    /// Updates the motor's state from a reading.
    pub fn update(&self, drive: DriveIndex, reading: &Reading<'_>) {
        let Some(of) = self.of_drive(drive) else { return };
        let seen = seen(reading);
        let is_away = matches!(reading.snapshot.link, Link::Offline(_));
        let mut ledger = self.shared.lock();
        let started = match seen {
            Some(seen) => ledger.seen(&of.machine, seen),
            None => {
                ledger.with(&of.machine, |motor| {
                    if is_away {
                        motor.note_offline()
                    } else if !of.tells_running {
                        motor.begin_unreported(reading.now)
                    } else {
                        motor.unseen()
                    }
                });
                false
            }
        };
        drop(ledger);
        if started {
            self.shared.notify_change();
        }
    }

    /// Whether a stop of this client is an ordinary one, which waits for `min_run`: the first since its own order
    /// started the motor.
    pub(crate) fn is_ordinary_stop(&self, drive: DriveIndex, client: &str, last_stop: Option<Instant>) -> bool {
        let of = self.of_drive(drive).filter(|of| !of.guard.min_run.is_zero());
        of.is_some_and(|of| {
            let ledger = self.shared.lock();
            let motor = ledger.motor(&of.machine);
            motor.is_some_and(|motor| motor.is_ordinary_stop(client, last_stop))
        })
    }

    /// Until when `min_run` delays an ordinary stop of the drive.
    pub fn stop_waits(&self, drive: DriveIndex, now: Instant) -> Option<Instant> {
        let of = self.of_drive(drive)?;
        self.shared.lock().motor(&of.machine)?.stop_waits(&of.guard, now)
    }

    /// Starts of this drive that were refused, by reason; empty if the drive is not guarded.
    pub fn refused(&self, drive: DriveIndex) -> BTreeMap<Reason, u64> {
        let of = self.of_drive(drive);
        of.map_or_else(BTreeMap::new, |of| self.shared.lock().refused(&of.machine))
    }
}

/// The motor's state from a reading; `None` if the reading does not show whether the motor runs.
fn seen(reading: &Reading<'_>) -> Option<MotorReading> {
    let sample = reading.model(ModelPoint::Running);
    let running = sample.good()?.as_bool();
    // The running bit of a faulted drive may be from before the fault; the motor does not run by its run command then.
    let runs = running && !reading.is_set(ModelPoint::Fault);
    let commanded = reading.model(ModelPoint::Run);
    let turns = || matches!(reading.standstill(None), Standstill::Turns(_));
    let told = |point: ModelPoint, as_told: bool| {
        let sample = reading.model(point);
        let is_told = sample.good().is_some_and(|value| value.as_bool() == as_told);
        sample.at.filter(|_| is_told)
    };
    let fault = told(ModelPoint::Fault, true).map(|at| (Unable::Fault, at));
    let not_ready = || told(ModelPoint::Ready, false).map(|at| (Unable::NotReady, at));
    Some(MotorReading {
        running: runs,
        commanded: commanded.good().map(Value::as_bool).zip(commanded.at),
        stands: !running && !turns(),
        unable: fault.or_else(not_ready).filter(|_| !runs),
        at: sample.at?,
    })
}
