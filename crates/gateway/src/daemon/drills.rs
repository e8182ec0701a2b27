//! Drills in progress, and the file in which they are saved.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::drill::{DrillState, Drills, LOOK, SavedDrills};
use drivegate_core::files;
use drivegate_core::files::names::DRILLS;
use drivegate_core::order::{Origin, SourceKind};
use drivegate_core::plant::SharedPlant;
use drivegate_north::patience::Patience;

/// Interval of the looks at an armed drill.
const IDLE: Duration = Duration::from_millis(500);
/// Time between two tries to write the file.
const AGAIN: Duration = Duration::from_secs(10);
/// Time limit for the last stop of a drill that the shutdown ends, and for saving it afterwards.
const LAST_STOP: Duration = Duration::from_secs(3);
/// Largest valid size of the file, bytes.
const LONGEST: u64 = 16 << 20;

/// The file of the drills; `None` while drills are not kept.
pub(super) type DrillsFile = Arc<Mutex<Option<PathBuf>>>;

fn path(file: &DrillsFile) -> Option<PathBuf> {
    file.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// Saves drills in this state directory from now on. Drills saved in the previous state directory are taken over.
pub(super) async fn keep_in(file: &DrillsFile, state_dir: Option<&Path>, patience: &Patience, drills: &Drills) {
    let new = state_dir.map(|dir| dir.join(DRILLS));
    drills.keep(new.is_some());
    let before = std::mem::replace(&mut *file.lock().unwrap_or_else(PoisonError::into_inner), new.clone());
    let Some(path) = new.filter(|new| before.as_ref() != Some(new)) else {
        return;
    };
    let found = patience.read({
        let path = path.clone();
        move || load(&path)
    });
    match found.await.and_then(|found| found) {
        Ok(Some(saved)) => drills.restore(saved),
        Ok(None) => {}
        Err(why) => tracing::error!(
            target: "drivegate::daemon",
            "cannot read {}: {why}; earlier drills are unknown, and the next drill replaces the file; move it away to \
             keep it",
            path.display()
        ),
    }
}

/// Reads the drills saved in a file; `None` if the file does not exist.
///
/// # Errors
/// If the file cannot be read, or is not a file of drills.
pub fn load(path: &Path) -> Result<Option<SavedDrills>, String> {
    let bytes = files::read(path, LONGEST)?;
    bytes.map(|bytes| SavedDrills::from_json(&bytes)).transpose()
}

/// Evaluates drills as long as the gateway runs, and keeps their file up to date.
pub(super) fn watch(plant: SharedPlant, drills: Arc<Drills>, file: DrillsFile) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        let mut writer = Writer::default();
        loop {
            // The end of the wait by time or by a signal is a reason to look.
            let _ = tokio::time::timeout(IDLE, drills.begun()).await;
            loop {
                let goes_on = drills.advance(&plant.load(), Instant::now(), SystemTime::now());
                writer.advance(&drills, &file).await;
                if !goes_on && writer.writing.is_none() {
                    break;
                }
                tokio::time::sleep(LOOK).await;
            }
        }
    })
}

type Writing = tokio::task::JoinHandle<(u64, Result<(), String>)>;

/// Writes the file in parallel to the drill: a slow disk delays no stop.
#[derive(Default)]
struct Writer {
    writing: Option<Writing>,
    /// When a failed write is tried again.
    again: Option<Instant>,
}

impl Writer {
    /// Processes the result of a completed write, and starts the next one that is due.
    async fn advance(&mut self, drills: &Drills, file: &DrillsFile) {
        if let Some(writing) = self.writing.take_if(|writing| writing.is_finished()) {
            match writing.await {
                Ok((generation, Ok(()))) => {
                    if self.again.take().is_some() {
                        tracing::info!(target: "drivegate::daemon", "the drills are on disk again");
                    }
                    drills.kept(generation, Instant::now());
                }
                Ok((_, Err(why))) => self.failed(drills, &why),
                Err(error) => self.failed(drills, &error.to_string()),
            }
        }
        // If a drill is waiting for the write, it is repeated at once.
        let waits = self.again.is_some_and(|again| Instant::now() < again) && !drills.waits_for_disk();
        if self.writing.is_none() && !waits {
            self.writing = begin_to_write(drills, file);
        }
    }

    fn failed(&mut self, drills: &Drills, why: &str) {
        if self.again.replace(Instant::now() + AGAIN).is_none() {
            tracing::error!(
                target: "drivegate::daemon",
                "the drills cannot be written: {why}; no drill starts until they can; retrying every {} s; check the disk",
                AGAIN.as_secs()
            );
        }
        drills.not_kept(why, SystemTime::now());
    }
}

fn begin_to_write(drills: &Drills, file: &DrillsFile) -> Option<Writing> {
    let path = path(file)?;
    let (generation, saved) = drills.to_keep()?;
    let write = move || {
        let text = serde_json::to_vec_pretty(&saved).map_err(|error| error.to_string())?;
        files::replace(&path, &text).map_err(|error| format!("{}: {error}", path.display()))
    };
    Some(tokio::task::spawn_blocking(move || (generation, write())))
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
