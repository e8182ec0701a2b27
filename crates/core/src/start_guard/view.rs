//! The guards of one bus: whether a command to its drives may start them. Pure: time is an argument.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::ledger::{Guards, Kept, Ledger};
use super::{Guard, Guarded, Interlock, Reason, Seen, Unmet, shown};
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
    /// Those of a bus; none where nothing of it is guarded.
    pub fn of<'d>(
        shared: &Arc<Guards>,
        bus: &BusSpec,
        drives: impl IntoIterator<Item = &'d DriveSpec>,
    ) -> Option<Arc<BusGuards>> {
        let mut ledger = shared.lock();
        let drives = drives.into_iter().map(|drive| {
            if !drive.is_guarded() {
                return None;
            }
            let machine = bus.machine(drive);
            let group = drive.starts_with();
            ledger.register(&machine, &group);
            let profile = &drive.profile;
            let running = profile.model_index(ModelPoint::Running);
            Some(Guarding {
                machine,
                group,
                guard: drive.guard.unwrap_or_default(),
                interlocks: drive.interlocks.clone(),
                tells_running: running.is_some_and(|index| Plan::of(profile).shows(profile, index)),
            })
        });
        let drives: PerDrive<Option<Guarding>> = drives.collect();
        let any = drives.iter().any(Option::is_some);
        drop(ledger);
        any.then(|| {
            Arc::new(BusGuards {
                shared: shared.clone(),
                drives,
            })
        })
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
        if !ledger.motor(&of.machine)?.is_started_by_run() {
            return None;
        }
        let refused = self.interlocked(of, now).or_else(|| {
            let wait = ledger.hindered(&of.machine, &of.guard, now)?;
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
            let starts = ledger.motor(&of.machine).is_none_or(|motor| motor.is_started_by_run());
            starts.then(|| ledger.hindered(&of.machine, &of.guard, now)).flatten()
        })
    }

    /// The interlocks that do not hold, or of them those that stop the motor.
    pub fn unmet(&self, drive: DriveIndex, trips_only: bool, now: Instant) -> Vec<Unmet> {
        let of = self.of_drive(drive);
        of.map_or_else(Vec::new, |of| self.unmet_of(of, trips_only, now))
    }

    /// Whether an interlock of that drive stops its motor.
    pub fn trips(&self, drive: DriveIndex) -> bool {
        let of = self.of_drive(drive);
        of.is_some_and(|of| of.interlocks.iter().any(|interlock| interlock.trip))
    }

    fn unmet_of(&self, of: &Guarding, trips_only: bool, now: Instant) -> Vec<Unmet> {
        if of.interlocks.is_empty() {
            return Vec::new();
        }
        let around = self.shared.around();
        let wanted = of.interlocks.iter().filter(|interlock| interlock.trip || !trips_only);
        wanted.filter_map(|interlock| interlock.unmet(&around, now)).collect()
    }

    fn interlocked(&self, of: &Guarding, now: Instant) -> Option<Guarded> {
        let unmet = self.unmet_of(of, false, now);
        let unmet: Vec<String> = unmet.iter().map(Unmet::to_string).collect();
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
        let starts = |of: &&&Guarding| ledger.motor(&of.machine).is_some_and(|motor| motor.is_started_by_run());
        let started: Vec<&Guarding> = started.iter().filter(starts).copied().collect();
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
        started: &[&'g Guarding],
        command: &Command,
        now: Instant,
    ) -> Result<Option<Instant>, (&'g Guarding, Guarded)> {
        let mut waits: Option<Instant> = None;
        for of in started {
            if let Some(refused) = self.interlocked(of, now) {
                return Err((of, refused));
            }
            let cleared = ledger
                .motor(&of.machine)
                .is_some_and(|motor| motor.is_cleared(command.number));
            if cleared {
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
        if let Some(of) = started.iter().find(|of| self.is_together(of, started)) {
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

    /// Whether that drive is not to be started together with another of these.
    fn is_together(&self, of: &Guarding, started: &[&Guarding]) -> bool {
        let other = |other: &&Guarding| other.machine != of.machine && other.group == of.group;
        !of.guard.stagger.is_zero() && started.iter().any(other)
    }

    /// Counts what is not counted yet, and looks whether that is on disk.
    fn count(&self, ledger: &mut Ledger, started: &[&Guarding], command: &Command, now: Instant) -> Clearance {
        let number = command.number;
        let mut changed = false;
        for of in started {
            if !ledger.motor(&of.machine).is_some_and(|motor| motor.is_cleared(number)) {
                ledger.reserve(&of.machine, number, command.expires, now);
                changed = true;
            }
        }
        if changed {
            self.shared.tell_change();
        }
        let mut clearance = Clearance::Go;
        for of in started {
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
                    started.iter().for_each(|of| ledger.withdraw(&of.machine));
                    return Clearance::Refused(refusal(refused));
                }
            }
        }
        clearance
    }

    /// Whether the next write of a command that was cleared may go, if it starts the motor by now.
    ///
    /// # Errors
    /// Why not: an interlock does not hold any more, or the motor, which ran when the order was judged, has stopped.
    pub fn may_write(&self, drive: DriveIndex, number: u64, now: Instant) -> Result<(), Refusal> {
        let Some(of) = self.of_drive(drive) else { return Ok(()) };
        let ledger = self.shared.lock();
        let Some(motor) = ledger.motor(&of.machine).filter(|motor| motor.is_started_by_run()) else {
            return Ok(());
        };
        let stopped = || Guarded {
            reason: Reason::MinOff,
            why: "the motor was running when the command arrived, and has stopped since; send it again".to_string(),
            retry_after: of.guard.min_off,
        };
        let refused = match motor.is_cleared(number) {
            true => self.interlocked(of, now),
            false => Some(stopped()),
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
    Some(Seen {
        running: runs,
        commanded: commanded.good().map(Value::as_bool).zip(commanded.at),
        stands: !running && !turns(),
        at: sample.at?,
    })
}
