//! Drills in progress, and the file in which they are saved.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::drill::{DrillState, Drills, LOOK, SavedDrills};
use drivegate_core::files::State as _;
use drivegate_core::files::names::DRILLS;
use drivegate_core::order::{Origin, SourceKind};
use drivegate_core::plant::SharedPlant;
use drivegate_north::patience::Patience;
use drivegate_north::state_file::{self, LATE, StateFile};

/// Interval of the looks at an armed drill.
const IDLE: Duration = Duration::from_millis(500);
/// Time limit for the last stop of a drill that the shutdown ends, and for saving it afterwards.
const LAST_STOP: Duration = Duration::from_secs(3);

/// The file of the drills; `None` while drills are not kept.
pub(super) type DrillsFile = Arc<Mutex<Option<Target>>>;

/// Where drills are saved. A file that was not read is not overwritten.
#[derive(Debug)]
pub(super) enum Target {
    Unread(PathBuf),
    Read(PathBuf),
}

fn lock(file: &DrillsFile) -> MutexGuard<'_, Option<Target>> {
    file.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The file once it may be written.
fn path(file: &DrillsFile) -> Option<PathBuf> {
    match &*lock(file) {
        Some(Target::Read(path)) => Some(path.clone()),
        Some(Target::Unread(_)) | None => None,
    }
}

/// Saves drills in this state directory from now on. Drills saved there earlier are taken over.
pub(super) async fn keep_in(file: &DrillsFile, state_dir: Option<&Path>, patience: &Patience, drills: &Arc<Drills>) {
    drills.keep(state_dir.is_some());
    let Some(path) = state_dir.map(|dir| dir.join(DRILLS)) else {
        *lock(file) = None;
        return;
    };
    if let Some(Target::Unread(same) | Target::Read(same)) = &*lock(file)
        && *same == path
    {
        return;
    }
    *lock(file) = Some(Target::Unread(path.clone()));
    let reading = state_file::read::<SavedDrills>(path.clone());
    let taken_up = {
        let (file, drills, path) = (file.clone(), drills.clone(), path.clone());
        async move {
            // A thread that panicked has logged that, and the file stays unread.
            let Ok(found) = reading.await else { return };
            let mut target = lock(&file);
            // A reload may have chosen another file meanwhile.
            if matches!(&*target, Some(Target::Unread(awaited)) if *awaited == path) {
                found.into_iter().for_each(|saved| drills.restore(saved));
                *target = Some(Target::Read(path));
            }
        }
    };
    if patience.wait(taken_up).await.is_none() {
        SavedDrills::WORDS.not_read(&path, &LATE);
    }
}

/// Evaluates drills as long as the gateway runs, and keeps their file up to date.
pub(super) fn watch(plant: SharedPlant, drills: Arc<Drills>, file: DrillsFile) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        let mut saved = StateFile::new(SavedDrills::WORDS);
        loop {
            // The end of the wait by time or by a signal is a reason to look.
            let _ = tokio::time::timeout(IDLE, drills.begun()).await;
            loop {
                let goes_on = drills.advance(&plant.load(), Instant::now(), SystemTime::now());
                save(&mut saved, &drills, path(&file));
                if !goes_on && !saved.is_writing() {
                    break;
                }
                tokio::time::sleep(LOOK).await;
            }
        }
    })
}

/// Keeps the file up to date in parallel to the drill: a slow disk delays no stop.
fn save(saved: &mut StateFile<(PathBuf, u64)>, drills: &Drills, path: Option<PathBuf>) {
    let now = Instant::now();
    match saved.ended(now) {
        Some(Ok((_, generation))) => drills.kept(*generation, now),
        Some(Err(why)) => drills.not_kept(&why, SystemTime::now()),
        None => {}
    }
    if let Some((path, (generation, state))) = path.zip(drills.to_keep()) {
        saved.keep((path, generation), now, move |(path, _)| state.save(path));
    }
}

/// Ends a drill because the gateway or the bus of the drive ends; the drill stops its motor.
pub(super) async fn end(
    plant: &SharedPlant,
    drills: &Drills,
    file: &DrillsFile,
    by: &str,
    of_bus: impl Fn(&str) -> bool,
) {
    let reports = drills.reports().into_iter();
    let mut running = reports.filter(|report| !report.state.is_over());
    let running = running.find(|report| of_bus(&report.bus));
    let Some(report) = running else { return };
    let who = Origin::new(SourceKind::Shutdown, by);
    // The drill may have ended meanwhile, so an error is ignored.
    let _ = drills.abort(&report.id, &who, Instant::now(), SystemTime::now());
    let until = Instant::now() + LAST_STOP;
    while Instant::now() < until && drills.advance(&plant.load(), Instant::now(), SystemTime::now()) {
        tokio::time::sleep(LOOK).await;
    }
    let ended = drills
        .report(&report.id)
        .is_some_and(|report| report.state != DrillState::Running);
    if !ended {
        tracing::error!(
            target: "drivegate::daemon", drive = %report.drive,
            "the stop with which a drill ends was not acknowledged in time ({by}); check the motor"
        );
    }
    until_on_disk(drills, file).await;
}

/// Waits until the task that looks at drills has written the file.
async fn until_on_disk(drills: &Drills, file: &DrillsFile) {
    let until = Instant::now() + LAST_STOP;
    while path(file).is_some() && !drills.is_kept() {
        if Instant::now() >= until {
            tracing::error!(
                target: "drivegate::daemon",
                "the end of a drill is not on disk after {} s; the next start stops its motor once more; check the disk",
                LAST_STOP.as_secs()
            );
            return;
        }
        drills.wake();
        tokio::time::sleep(LOOK).await;
    }
}
