//! The guards of one bus: whether a command to its drives may start them. Pure: time is an argument.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::ledger::{Guards, Kept, Ledger};
use super::motor::Motor;
use super::passage::ByRun;
use super::{Guard, Guarded, Interlock, Reason, Seen, Unable, Unmet, shown};
use crate::command::{Command, Effect, Refusal};
use crate::drive::{DriveIndex, ModelPoint, PerDrive, Plan, Value};
use crate::process_image::{BusSpec, DriveSpec, Link, Machine, Reading};
use crate::stop_all::Standstill;

/// Time until a start that waits for the disk is looked at again.
const LOOK: Duration = Duration::from_millis(2);

/// The guards of the drives of one bus.
#[derive(Debug)]
pub struct BusGuards {
    shared: Arc<Guards>,
    /// By their place on the bus; none for a drive without guards.
    drives: PerDrive<Option<Guarding>>,
}

/// The guards of one drive.
#[derive(Debug)]
struct Guarding {
    machine: Machine,
    group: Arc<str>,
    guard: Guard,
    interlocks: Vec<Interlock>,
    /// It says whether its motor runs.
    tells_running: bool,
}

/// Whether a start may be written.
#[derive(Debug, Clone, PartialEq)]
pub enum Clearance {
    /// Yes: it is counted, and on disk.
    Go,
    /// Not before then.
    Wait(Instant),
    /// No.
    Refused(Refusal),
}

impl BusGuards {
    /// Those of a bus; none where nothing of it is guarded. They take effect with [`BusGuards::begin`].
    pub fn of<'d>(
        shared: &Arc<Guards>,
        bus: &BusSpec,
        drives: impl IntoIterator<Item = &'d DriveSpec>,
    ) -> Option<Arc<BusGuards>> {
        let drives = drives.into_iter().map(|drive| {
            if !drive.is_guarded() {
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

    /// The bus is about to begin: from now on the starts of its drives count so. Until then, and after a reload that is
    /// refused, the drives of the bus before it are guarded as they were.
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

    /// Why a command with that effect is not accepted; counted. One that may wait does so until `waits_until`.
    pub fn refuses(
        &self,
        drive: DriveIndex,
        effect: Effect,
        waits_until: Option<Instant>,
        now: Instant,
    ) -> Option<Refusal> {
        let of = self.of_drive(drive).filter(|_| effect.run == Some(true))?;
        let mut ledger = self.shared.lock();
        let motor = ledger.motor(&of.machine)?;
        let by_run = motor.by_run();
        if by_run == ByRun::Runs {
            return None;
        }
        // The order before this one starts it, if it does.
        let is_first = by_run != ByRun::Repeats && motor.reserved.is_none();
        let refused = self.interlocked(of, now).or_else(|| {
            let wait = ledger.hindered(&of.machine, &of.guard, now).filter(|_| is_first)?;
            Some(wait).filter(|wait| waits_until.is_none_or(|until| now + wait.retry_after > until))
        })?;
        ledger.count_refused(&of.machine, refused.reason);
        Some(refusal(refused))
    }

    /// Why the motor may not be started now, as text; not counted.
    pub(crate) fn hindrance(&self, drive: DriveIndex, now: Instant) -> Option<Guarded> {
        let of = self.of_drive(drive)?;
        let interlocked = self.interlocked(of, now);
        interlocked.or_else(|| {
            let ledger = self.shared.lock();
            // One that runs by its order, with a reference of zero, is not kept from a start.
            let by_run = ledger.motor(&of.machine).map(Motor::by_run);
            let starts = !matches!(by_run, Some(ByRun::Runs | ByRun::Repeats));
            starts.then(|| ledger.hindered(&of.machine, &of.guard, now)).flatten()
        })
    }

    /// The interlocks that do not hold and stop the running motor of that drive.
    pub fn tripped(&self, drive: DriveIndex, now: Instant) -> Vec<Unmet> {
        let Some(of) = self.of_drive(drive) else {
            return Vec::new();
        };
        let around = self.shared.around();
        let trips = of.interlocks.iter().filter(|interlock| interlock.trip);
        trips.filter_map(|interlock| interlock.trips(&around, now)).collect()
    }

    /// Whether an interlock of that drive stops its motor.
    pub fn trips(&self, drive: DriveIndex) -> bool {
        let of = self.of_drive(drive);
        of.is_some_and(|of| of.interlocks.iter().any(|interlock| interlock.trip))
    }

    fn interlocked(&self, of: &Guarding, now: Instant) -> Option<Guarded> {
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

    /// A command has its turn. Its start is counted once, when it may be sent.
    pub fn clear(&self, command: &Command, now: Instant) -> Clearance {
        let all = command.reach().iter();
        let started = all.filter(|drive| command.effect(**drive).run == Some(true));
        let started: Vec<&Guarding> = started.filter_map(|drive| self.of_drive(*drive)).collect();
        if started.is_empty() {
            return Clearance::Go;
        }
        let mut ledger = self.shared.lock();
        let by_run = |of: &Guarding| ledger.motor(&of.machine).map_or(ByRun::Runs, Motor::by_run);
        let started = started.into_iter().map(|of| (of, by_run(of)));
        let started: Vec<(&Guarding, ByRun)> = started.filter(|(_, by_run)| *by_run != ByRun::Runs).collect();
        match self.judge(&ledger, &started, command, now) {
            Err((of, refused)) => {
                ledger.count_refused(&of.machine, refused.reason);
                Clearance::Refused(refusal(refused))
            }
            Ok(Some(until)) => Clearance::Wait(until),
            Ok(None) => self.count(&mut ledger, &started, command, now),
        }
    }

    /// Until when the start of these drives waits; none where it may go.
    fn judge<'g>(
        &self,
        ledger: &Ledger,
        started: &[(&'g Guarding, ByRun)],
        command: &Command,
        now: Instant,
    ) -> Result<Option<Instant>, (&'g Guarding, Guarded)> {
        let mut waits: Option<Instant> = None;
        for (of, by_run) in started {
            if let Some(refused) = self.interlocked(of, now) {
                return Err((of, refused));
            }
            let cleared = ledger
                .motor(&of.machine)
                .is_some_and(|motor| motor.is_cleared(command.number));
            if cleared || *by_run == ByRun::Repeats {
                continue;
            }
            if let Some(wait) = ledger.hindered(&of.machine, &of.guard, now) {
                let until = now + wait.retry_after;
                if !command.waits || until > command.expires {
                    return Err((of, wait));
                }
                waits = waits.max(Some(until));
            }
        }
        if let Some((of, _)) = started.iter().find(|(of, _)| is_together(of, started)) {
            let why = format!(
                "one command would start several drives whose starts must be {} apart (guard.stagger); start them one \
                 by one",
                shown(of.guard.stagger)
            );
            let refused = Guarded {
                reason: Reason::Stagger,
                why,
                retry_after: of.guard.stagger,
            };
            return Err((of, refused));
        }
        Ok(waits)
    }

    /// Counts what is not counted yet, and looks whether that is on disk.
    fn count(&self, ledger: &mut Ledger, started: &[(&Guarding, ByRun)], command: &Command, now: Instant) -> Clearance {
        let number = command.number;
        let mut changed = false;
        for (of, by_run) in started {
            let cleared = ledger.motor(&of.machine).is_some_and(|motor| motor.is_cleared(number));
            if *by_run == ByRun::Starts && !cleared {
                ledger.reserve(&of.machine, number, command.expires, now);
                changed = true;
            }
        }
        if changed {
            self.shared.tell_change();
        }
        let mut clearance = Clearance::Go;
        for (of, _) in started {
            let Some(reserved) = ledger.motor(&of.machine).and_then(|motor| motor.reserved) else {
                continue;
            };
            match ledger.kept(&reserved, now) {
                Kept::Yes => {}
                Kept::NotYet => clearance = Clearance::Wait(now + LOOK),
                Kept::Failed(why) => {
                    let refused = Guarded {
                        reason: Reason::StateFile,
                        why: format!("its start cannot be counted: {why}; check state_dir of [gateway] and the disk"),
                        retry_after: super::ledger::DISK,
                    };
                    ledger.count_refused(&of.machine, refused.reason);
                    started.iter().for_each(|(of, _)| ledger.withdraw(&of.machine));
                    return Clearance::Refused(refusal(refused));
                }
            }
        }
        clearance
    }

    /// Whether the next write of a command may go, if the motor does not run for certain by now.
    ///
    /// # Errors
    /// Why not: an interlock does not hold any more, or the command would make a start that was not judged and counted,
    /// since the motor has stopped, or the drive become able to start, after its turn came.
    pub fn may_write(&self, drive: DriveIndex, number: u64, now: Instant) -> Result<(), Refusal> {
        let Some(of) = self.of_drive(drive) else { return Ok(()) };
        let ledger = self.shared.lock();
        let Some(motor) = ledger.motor(&of.machine) else {
            return Ok(());
        };
        let refused = match motor.by_run() {
            ByRun::Runs => None,
            ByRun::Starts if !motor.is_cleared(number) => Some(Guarded {
                reason: Reason::MinOff,
                why: "the motor was running, or the drive could not start, when the command arrived, and that has changed since; \
                      send it again"
                    .to_string(),
                retry_after: of.guard.min_off,
            }),
            ByRun::Repeats | ByRun::Vain | ByRun::Starts => self.interlocked(of, now),
        };
        refused.map_or(Ok(()), |refused| Err(refusal(refused)))
    }

    /// A started command was refused so.
    pub fn count_refused(&self, drive: DriveIndex, refusal: &Refusal) {
        let reason = match refusal {
            Refusal::Guarded(guarded) => guarded.reason,
            _ => Reason::Interlock,
        };
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().count_refused(&of.machine, reason);
        }
    }

    /// A word of a command of that client that starts the motor is sent.
    pub fn start_written(&self, drive: DriveIndex, number: u64, client: &Arc<str>, now: Instant) {
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().start_written(&of.machine, number, client, now);
            self.shared.tell_change();
        }
    }

    /// A cleared command has ended: its unwritten starts count as made.
    pub fn settle(&self, drive: DriveIndex, number: u64) {
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().settle(&of.machine, Some(number));
        }
    }

    /// The drive acknowledged a start or a stop.
    pub fn acknowledged(&self, drive: DriveIndex, run: bool, now: Instant) {
        if let Some(of) = self.of_drive(drive).filter(|of| !of.tells_running) {
            self.shared.lock().with(&of.machine, |motor| match run {
                true => motor.start_acknowledged(now),
                false => motor.stop_acknowledged(now),
            });
        }
    }

    /// A stop is sent.
    pub fn stop_written(&self, drive: DriveIndex, now: Instant) {
        if let Some(of) = self.of_drive(drive) {
            self.shared.lock().with(&of.machine, |motor| motor.stop_written(now));
        }
    }

    /// Updates the state of the drive.
    pub fn look(&self, drive: DriveIndex, reading: &Reading<'_>) {
        let Some(of) = self.of_drive(drive) else { return };
        let seen = seen(reading);
        let is_away = matches!(reading.snapshot.link, Link::Offline(_));
        let mut ledger = self.shared.lock();
        let started = match seen {
            Some(seen) => ledger.seen(&of.machine, seen),
            None => {
                ledger.with(&of.machine, |motor| match is_away {
                    true => motor.away(),
                    false if !of.tells_running => motor.begin_untold(reading.now),
                    false => motor.unseen(),
                });
                false
            }
        };
        drop(ledger);
        if started {
            self.shared.tell_change();
        }
    }

    /// Whether a stop of that client is an ordinary one, which waits for `min_run`: the first since its own order started the
    /// motor.
    pub(crate) fn is_ordinary_stop(&self, drive: DriveIndex, client: &str, last_stop: Option<Instant>) -> bool {
        let of = self.of_drive(drive).filter(|of| !of.guard.min_run.is_zero());
        of.is_some_and(|of| {
            let ledger = self.shared.lock();
            let motor = ledger.motor(&of.machine);
            motor.is_some_and(|motor| motor.is_ordinary_stop(client, last_stop))
        })
    }

    /// Until when an ordinary stop of that drive waits.
    pub fn stop_waits(&self, drive: DriveIndex, now: Instant) -> Option<Instant> {
        let of = self.of_drive(drive)?;
        self.shared.lock().motor(&of.machine)?.stop_waits(&of.guard, now)
    }

    /// Starts of that drive that were refused, by reason; none of one that is not guarded.
    pub fn refused(&self, drive: DriveIndex) -> BTreeMap<Reason, u64> {
        let of = self.of_drive(drive);
        of.map_or_else(BTreeMap::new, |of| self.shared.lock().refused(&of.machine))
    }
}

/// Whether that drive is not to be started together with another of these.
fn is_together(of: &Guarding, started: &[(&Guarding, ByRun)]) -> bool {
    let other = |(other, by_run): &(&Guarding, ByRun)| {
        *by_run != ByRun::Repeats && other.machine != of.machine && other.group == of.group
    };
    !of.guard.stagger.is_zero() && started.iter().any(other)
}

fn refusal(refused: Guarded) -> Refusal {
    match refused.reason {
        Reason::Interlock => Refusal::Interlocked(refused.why),
        _ => Refusal::Guarded(Box::new(refused)),
    }
}

/// The motor's state in a reading; none while that does not show whether it runs.
fn seen(reading: &Reading<'_>) -> Option<Seen> {
    let sample = reading.model(ModelPoint::Running);
    let running = sample.good()?.as_bool();
    // What a faulted drive says of its motor may be from before the fault; it does not run by its run command.
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
    Some(Seen {
        running: runs,
        commanded: commanded.good().map(Value::as_bool).zip(commanded.at),
        stands: !running && !turns(),
        unable: fault.or_else(not_ready).filter(|_| !runs),
        at: sample.at?,
    })
}
