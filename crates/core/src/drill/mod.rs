//! Drills: a motor is started at low speed and stopped in each way that must stop it, and the measured stopping
//! time is kept.
//!
//! [`Drills::arm`] prepares a drill, [`Drills::start`] begins it within [`ARMED`] for the same client, and a task of the gateway calls
//! [`Drills::look`] while it is running. Only one drill runs at a time. Every drill ends with a stop, also one that a crash
//! interrupts: where drills are kept on disk, the motor starts only after the start was written, and the next process sends the stop.
//! Pure: time is an argument.

mod report;
mod run;

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::Notify;

pub use self::report::{DrillReport, DrillState, DrillStep, Kind, Proof, SavedDrills, StopProof};
use self::run::{Ended, Run};
use crate::order::Origin;
use crate::plant::{DriveHandle, Plant};
use crate::process_image::{Access, DriveSpec, Machine};
use drivegate_model::drive::ModelPoint;

/// Time within which an armed drill must be started.
pub const ARMED: Duration = Duration::from_secs(60);
/// Interval at which a drill in progress is evaluated.
pub const LOOK: Duration = Duration::from_millis(20);
/// Maximum number of drill reports that are kept.
const MOST_REPORTS: usize = 200;
/// Maximum number of combinations of machine and way to stop whose last proof is kept.
const MOST_PROOFS: usize = 16_384;

/// `[drill]` of the configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrillOptions {
    /// Highest speed at which a motor is stopped, % of its range.
    pub max_speed: f64,
    /// Time limit for the motor to stop, measured from the cause of the stop.
    pub limit: Duration,
    /// Age from which a proof is too old.
    pub every: Duration,
}

/// Why a drill cannot be armed, started or ended.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DrillRefusal {
    /// No drill has this id.
    #[error("there is no drill `{0}`")]
    Unknown(String),
    /// This drive does not allow the drill, for the reason given.
    #[error("{0}; nothing was started")]
    NotPossible(String),
    /// The drill is not possible now, or not for this client.
    #[error("{0}; nothing was started")]
    NotNow(String),
}

/// The ways to stop that can be tested on a drive. The test with a silent client needs supervision.
pub fn ways(spec: &DriveSpec) -> Vec<Kind> {
    let starts = [ModelPoint::Run, ModelPoint::SpeedReference];
    let can = spec.access == Access::Control && starts.iter().all(|point| spec.profile.model_index(*point).is_some());
    let has = |kind: &&Kind| can && (**kind != Kind::Client || spec.supervision.is_some());
    Kind::ALL.iter().filter(has).copied().collect()
}

fn not_possible(why: impl Into<String>) -> DrillRefusal {
    DrillRefusal::NotPossible(why.into())
}

fn not_now(why: impl Into<String>) -> DrillRefusal {
    DrillRefusal::NotNow(why.into())
}

/// The drills of the gateway.
#[derive(Debug, Default)]
pub struct Drills {
    state: Mutex<State>,
    begun: Notify,
}

#[derive(Debug, Default)]
struct State {
    options: Option<DrillOptions>,
    run: Option<Run>,
    ended: VecDeque<DrillReport>,
    proofs: Vec<Proof>,
    /// Drills that a crash interrupted; their motors may still run.
    cut_off: Vec<DrillReport>,
    /// Ended drills that are not in audit and events yet.
    unpublished: Vec<Ended>,
    /// Whether drills are kept on disk.
    keeps: bool,
    /// Counter of changes that must be saved.
    generation: u64,
    kept: u64,
}

impl Drills {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the options; with `None`, no drill can be armed.
    pub fn set_options(&self, options: Option<DrillOptions>) {
        self.state().options = options;
    }

    /// The options; `None` if drills are off.
    pub fn options(&self) -> Option<DrillOptions> {
        self.state().options
    }

    /// Arms a drill that tests these ways to stop, at `speed` % or, without it, at `max_speed`.
    ///
    /// # Errors
    /// If the drill cannot be armed; nothing was started.
    pub fn arm(
        &self,
        drive: &DriveHandle,
        (kinds, speed): (&[Kind], Option<f64>),
        who: &Origin,
        now: Instant,
        time: SystemTime,
    ) -> Result<DrillReport, DrillRefusal> {
        let mut state = self.state();
        let options = state
            .options
            .ok_or_else(|| not_possible("drills are off: the configuration has no [drill]"))?;
        state.drop_armed(now, time);
        if let Some(run) = &state.run {
            let report = run.report();
            return Err(not_now(format!(
                "drill `{}` of drive `{}` is {}; one drill at a time",
                report.id,
                report.drive,
                report.state.name()
            )));
        }
        if let Some(report) = state.cut_off.last() {
            let (id, drive) = (&report.id, &report.drive);
            return Err(not_now(format!(
                "drill `{id}` of drive `{drive}` was interrupted, and its motor is still being stopped"
            )));
        }
        let speed = speed.unwrap_or(options.max_speed);
        check_possible(drive, kinds, speed, options)?;
        may(drive, who, now)?;
        let run = Run::armed(drive, (kinds, speed), options, who, (now, time));
        let report = run.report().clone();
        state.run = Some(run);
        Ok(report)
    }

    /// Starts an armed drill for the client that armed it.
    ///
    /// # Errors
    /// If the drill is not armed, or was armed by another client; nothing was started.
    pub fn start(
        &self,
        plant: &Plant,
        id: &str,
        who: &Origin,
        now: Instant,
        time: SystemTime,
    ) -> Result<DrillReport, DrillRefusal> {
        let mut guard = self.state();
        let state = &mut *guard;
        state.drop_armed(now, time);
        // This goes first: otherwise the drill would mistake the audit record of the end of another drill for a command.
        state.publish(plant, now, time);
        let known = state.report(id).map(|report| report.state);
        let run = state.run.as_mut().filter(|run| run.report().id == id);
        let Some(run) = run else {
            return Err(match known {
                Some(state) => not_now(format!("drill `{id}` is {}", state.name())),
                None => DrillRefusal::Unknown(id.to_string()),
            });
        };
        if run.report().state != DrillState::Armed {
            return Err(not_now(format!("drill `{id}` is {}", run.report().state.name())));
        }
        if !run.is_of(who) {
            return Err(not_now(format!("drill `{id}` was armed by {}", run.report().who)));
        }
        may(run.drive(), who, now)?;
        let keep = state.keeps.then_some(state.generation + 1);
        run.start(plant, keep, now, time);
        let report = run.report().clone();
        state.generation += 1;
        drop(guard);
        self.wake();
        Ok(report)
    }

    /// Ends a drill, which stops the motor. A drill that has ended does not change.
    ///
    /// # Errors
    /// If no drill has this id.
    pub fn abort(&self, id: &str, who: &Origin, now: Instant, time: SystemTime) -> Result<DrillReport, DrillRefusal> {
        let mut state = self.state();
        if let Some(run) = state.run.as_mut().filter(|run| run.report().id == id) {
            run.abort(&format!("{} ended it", run::named(who)), now, time);
            let report = run.report().clone();
            if report.state.is_over() {
                state.end();
            }
            return Ok(report);
        }
        state.report(id).ok_or_else(|| DrillRefusal::Unknown(id.to_string()))
    }

    /// Waits for a drill to start, or for [`wake`](Drills::wake).
    pub async fn begun(&self) {
        self.begun.notified().await;
    }

    /// Ends a wait for [`begun`](Drills::begun).
    pub fn wake(&self) {
        self.begun.notify_one();
    }

    /// Evaluates the drill in progress, and drops a drill that was armed and not started in time. Returns whether
    /// one is in progress.
    pub fn advance(&self, plant: &Plant, now: Instant, time: SystemTime) -> bool {
        let mut state = self.state();
        let goes_on = state.advance(plant, now, time);
        state.publish(plant, now, time);
        goes_on
    }

    /// All known reports, the newest first.
    pub fn reports(&self) -> Vec<DrillReport> {
        let state = self.state();
        let current = state.run.iter().map(Run::report).chain(&state.cut_off).cloned();
        current.chain(state.ended.iter().rev().cloned()).collect()
    }

    /// The report of the drill with this id.
    pub fn report(&self, id: &str) -> Option<DrillReport> {
        self.state().report(id)
    }

    /// The last proof of each way to stop on this machine.
    pub fn proofs(&self, machine: &Machine) -> Vec<Proof> {
        let state = self.state();
        state
            .proofs
            .iter()
            .filter(|proof| proof.machine == *machine)
            .cloned()
            .collect()
    }

    /// Drill results for each way to stop that can be tested on the drive at `time`; `None` if drills are off.
    pub fn stops(&self, drive: &DriveHandle, time: SystemTime) -> Option<Vec<StopProof>> {
        let state = self.state();
        let every = state.options?.every;
        let machine = drive.machine();
        let of = |kind| {
            let proof = state
                .proofs
                .iter()
                .find(|proof| proof.kind == kind && proof.machine == machine);
            let age = proof.map(|proof| proof.age(time));
            let is_good = proof.is_some_and(|proof| proof.passed) && age.is_some_and(|age| age <= every);
            StopProof {
                kind,
                passed: proof.map(|proof| proof.passed),
                age_s: age.map(|age| age.as_secs()),
                due: !is_good,
            }
        };
        Some(ways(&drive.image.spec).into_iter().map(of).collect())
    }

    /// Loads what an earlier process saved. If a drill was running then, the next evaluations stop its motor.
    pub fn restore(&self, saved: SavedDrills) {
        let mut state = self.state();
        let known = |state: &State, report: &DrillReport| state.report(&report.id).is_some();
        let (over, open): (Vec<_>, Vec<_>) = saved.reports.into_iter().partition(|report| report.state.is_over());
        let cut_off = open.into_iter().filter(|report| !known(&state, report)).collect();
        state.cut_off = cut_off;
        state.ended = over.into();
        state.proofs = saved.proofs;
        state.bound();
    }

    /// Sets whether drills are saved on disk; if so, a drill starts only once that is done.
    pub fn keep(&self, keeps: bool) {
        self.state().keeps = keeps;
    }

    /// The state to write and its generation, until that generation is reported as [`kept`](Drills::kept).
    pub fn to_keep(&self) -> Option<(u64, SavedDrills)> {
        let state = self.state();
        if state.kept == state.generation {
            return None;
        }
        let running = state.run.iter().map(Run::report);
        let open = state
            .cut_off
            .iter()
            .chain(running.filter(|report| report.state == DrillState::Running));
        let reports = state.ended.iter().chain(open).cloned().collect();
        Some((state.generation, SavedDrills::new(reports, state.proofs.clone())))
    }

    /// Whether everything was saved to disk.
    pub fn is_kept(&self) -> bool {
        let state = self.state();
        state.kept == state.generation
    }

    /// Whether a drill waits until its start is on disk.
    pub fn waits_for_disk(&self) -> bool {
        self.state().run.as_ref().is_some_and(Run::waits_for_disk)
    }

    /// Reports that a generation is on disk.
    pub fn kept(&self, generation: u64, now: Instant) {
        let mut state = self.state();
        state.kept = state.kept.max(generation);
        if let Some(run) = &mut state.run {
            run.kept(generation, now);
        }
    }

    /// Reports that writing failed: a drill that waits for the disk does not start.
    pub fn not_kept(&self, why: &str, time: SystemTime) {
        let mut state = self.state();
        if state.run.as_mut().is_some_and(|run| run.not_kept(why, time)) {
            state.end();
        }
    }
}

impl State {
    fn advance(&mut self, plant: &Plant, now: Instant, time: SystemTime) -> bool {
        self.drop_armed(now, time);
        if self.run.is_none() {
            self.stop_cut_off(plant, now, time);
        }
        let Some(run) = &mut self.run else { return false };
        if run.report().state == DrillState::Armed {
            return false;
        }
        if run.advance(plant, now, time) {
            return true;
        }
        self.end();
        false
    }

    /// Adds ended drills to audit and events.
    fn publish(&mut self, plant: &Plant, now: Instant, time: SystemTime) {
        for drill in self.unpublished.drain(..) {
            drill.publish(plant, now, time);
        }
    }

    /// Starts to stop the motor of the next interrupted drill.
    fn stop_cut_off(&mut self, plant: &Plant, now: Instant, time: SystemTime) {
        let Some(report) = self.cut_off.pop() else { return };
        let why = match plant.drive_at(&report.machine()) {
            _ if !run::is_recent(&report, time) => "that was too long ago to stop the motor now",
            None => "the drive is no longer configured, so no stop was sent",
            // The file of the drills was read late: the motor runs by the will of that client.
            Some(drive) if drive.last_starter() != 0 => "a client has started the motor since, so no stop was sent",
            Some(drive) => {
                self.run = Some(Run::cut_off(report, &drive, now));
                return;
            }
        };
        self.over(run::ended_without_stop(report, why, time));
    }

    fn report(&self, id: &str) -> Option<DrillReport> {
        let current = self.run.iter().map(Run::report).chain(&self.cut_off);
        current.chain(&self.ended).find(|report| report.id == id).cloned()
    }

    /// Ends an armed drill that was not started in time.
    fn drop_armed(&mut self, now: Instant, time: SystemTime) {
        if let Some(run) = &mut self.run
            && run.expires(now, time)
        {
            self.end();
        }
    }

    fn end(&mut self) {
        let Some(run) = self.run.take() else { return };
        let (ended, proofs) = run.over();
        let machine = ended.report.machine();
        for proof in proofs {
            self.proofs
                .retain(|old| old.kind != proof.kind || old.machine != machine);
            self.proofs.push(proof);
        }
        self.over(ended);
    }

    fn over(&mut self, ended: Ended) {
        self.ended.push_back(ended.report.clone());
        self.unpublished.push(ended);
        self.bound();
        self.generation += 1;
    }

    fn bound(&mut self) {
        let beyond = self.ended.len().saturating_sub(MOST_REPORTS);
        self.ended.drain(..beyond);
        let beyond = self.proofs.len().saturating_sub(MOST_PROOFS);
        self.proofs.drain(..beyond);
    }
}

/// Checks whether these ways to stop can be tested on this drive.
fn check_possible(drive: &DriveHandle, kinds: &[Kind], speed: f64, options: DrillOptions) -> Result<(), DrillRefusal> {
    let spec = &drive.image.spec;
    if kinds.is_empty() {
        return Err(not_possible("name at least one of order, client, gateway"));
    }
    if !(speed > 0.0 && speed <= options.max_speed) {
        let most = options.max_speed;
        return Err(not_possible(format!(
            "speed is {speed} %, allowed are more than 0 to {most} % (max_speed of [drill])"
        )));
    }
    if spec.access != Access::Control {
        return Err(not_possible(format!(
            "drive `{}` has no access = \"control\"",
            spec.name
        )));
    }
    for point in [ModelPoint::Run, ModelPoint::SpeedReference] {
        if spec.profile.model_index(point).is_none() {
            let (profile, point) = (&spec.profile.name, point.name());
            return Err(not_possible(format!("profile `{profile}` has no `{point}`")));
        }
    }
    if kinds.contains(&Kind::Client) {
        let Some(supervision) = &spec.supervision else {
            return Err(not_possible(format!(
                "drive `{}` has no supervision, so nothing stops it when its client goes silent",
                spec.name
            )));
        };
        if supervision.timeout >= options.limit {
            return Err(not_possible(format!(
                "its supervision acts after {} s, and limit of [drill] is {} s; raise limit",
                supervision.timeout.as_secs_f64(),
                options.limit.as_secs_f64()
            )));
        }
    }
    Ok(())
}

/// Whether the client may start a drill now.
fn may(drive: &DriveHandle, who: &Origin, now: Instant) -> Result<(), DrillRefusal> {
    if let Some((view, own)) = drive.hold_view(Some(who), now)
        && !own
    {
        return Err(not_now(match view.holder {
            Some(holder) => format!("{holder} holds the drive; only the holder may run a drill"),
            None => format!(
                "nobody holds the drive; take it first: drivegate hold {} take",
                drive.image.spec.name
            ),
        }));
    }
    let reading = drive.reading(now);
    if !reading.snapshot.link.is_online() {
        return Err(not_now("the drive is offline"));
    }
    if reading.is_set(ModelPoint::Fault) {
        return Err(not_now("the drive has a fault"));
    }
    if reading
        .model(ModelPoint::Remote)
        .good()
        .is_some_and(|remote| !remote.as_bool())
    {
        return Err(not_now("the drive is under local control"));
    }
    if reading.is_set(ModelPoint::Running) || reading.is_set(ModelPoint::Run) {
        return Err(not_now("the motor is running; stop it first"));
    }
    if let Some(why) = drive.image.restore_lock.reason() {
        return Err(not_now(why.to_string()));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
