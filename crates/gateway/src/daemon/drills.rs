//! Drills that are under way, and the file that keeps them.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use crate::command::{Origin, SourceKind};
use crate::drill::{DrillState, Drills, LOOK, SavedDrills};
use crate::files;
use crate::files::names::DRILLS;
use crate::plant::SharedPlant;

/// How often an armed drill is looked at.
const IDLE: Duration = Duration::from_millis(500);
/// Time for the last stop of a drill that the shutdown ends.
const LAST_STOP: Duration = Duration::from_secs(3);
/// A file that is longer is none of these.
const LONGEST: u64 = 16 << 20;

/// The file of the drills; none while nothing is kept.
pub(super) type DrillsFile = Arc<Mutex<Option<PathBuf>>>;

fn path(file: &DrillsFile) -> Option<PathBuf> {
    file.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// From now on they are kept in that state directory. What another one has is taken in.
pub(super) fn keep_in(file: &DrillsFile, state_dir: Option<&Path>, drills: &Drills) {
    let new = state_dir.map(|dir| dir.join(DRILLS));
    let before = std::mem::replace(&mut *file.lock().unwrap_or_else(PoisonError::into_inner), new.clone());
    let Some(path) = new.filter(|new| before.as_ref() != Some(new)) else {
        return;
    };
    match load(&path) {
        Ok(Some(saved)) => drills.restore(saved),
        Ok(None) => {}
        Err(why) => tracing::error!(
            target: "drivegate::daemon",
            "cannot read {}: {why}; what was proven before is not known, and the file is replaced after the next drill; move it away to keep it",
            path.display()
        ),
    }
}

/// What a file has; none where there is none.
///
/// # Errors
/// It cannot be read, or is none of these.
pub fn load(path: &Path) -> Result<Option<SavedDrills>, String> {
    let length = match std::fs::metadata(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        metadata => metadata.map_err(|error| error.to_string())?.len(),
    };
    if length > LONGEST {
        return Err(format!("it has {length} bytes, more than {LONGEST}"));
    }
    let bytes = std::fs::read(path).map_err(|error| error.to_string())?;
    SavedDrills::from_json(&bytes).map(Some)
}

/// Looks at drills as long as the gateway runs, and writes the file after each.
pub(super) fn watch(plant: SharedPlant, file: DrillsFile) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        let drills = plant.load().drills.clone();
        loop {
            // Either is a reason to look.
            let _ = tokio::time::timeout(IDLE, drills.begun()).await;
            while drills.look(&plant.load(), Instant::now(), SystemTime::now()) {
                tokio::time::sleep(LOOK).await;
            }
            write(&drills, &file).await;
        }
    })
}

async fn write(drills: &Drills, file: &DrillsFile) {
    let Some((path, saved)) = path(file).and_then(|path| Some((path, drills.to_keep()?))) else {
        return;
    };
    let written = tokio::task::spawn_blocking(move || {
        let text = serde_json::to_vec_pretty(&saved).map_err(|error| error.to_string())?;
        files::replace(&path, &text).map_err(|error| format!("{}: {error}", path.display()))
    });
    if let Ok(Err(why)) = written.await {
        tracing::error!(
            target: "drivegate::daemon",
            "the drills cannot be written: {why}; they are known until the process ends; check the disk"
        );
    }
}

/// The gateway ends, or the bus of that drill does: so does the drill, with its stop.
pub(super) async fn end(plant: &SharedPlant, file: &DrillsFile, by: &str, of_bus: impl Fn(&str) -> bool) {
    let drills = plant.load().drills.clone();
    let reports = drills.reports().into_iter();
    let mut running = reports.filter(|report| !report.state.is_over());
    let running = running.find(|report| of_bus(&report.bus));
    let Some(report) = running else { return };
    let who = Origin::new(SourceKind::Shutdown, by);
    // It may have ended meanwhile.
    let _ = drills.abort(&report.id, &who, Instant::now(), SystemTime::now());
    let until = Instant::now() + LAST_STOP;
    while Instant::now() < until && drills.look(&plant.load(), Instant::now(), SystemTime::now()) {
        tokio::time::sleep(LOOK).await;
    }
    let ended = drills
        .report(&report.id)
        .is_some_and(|report| report.state != DrillState::Running);
    if !ended {
        tracing::error!(
            target: "drivegate::daemon", drive = %report.drive,
            "the stop with which a drill ends was not acknowledged in time ({by}); look at the motor"
        );
    }
    write(&drills, file).await;
}
