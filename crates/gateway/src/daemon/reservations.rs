//! Saves the reservations that stops left, so that they outlive the process: they are written while the stop is
//! sent, never before it.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::files;
use drivegate_core::files::names::RESERVATIONS;
use drivegate_core::permit::{AwaitedFiles, KeptReservation};
use drivegate_core::plant::SharedPlant;
use drivegate_north::NorthState;

/// Interval of the checks for changed reservations.
const CHECK: Duration = Duration::from_millis(50);
/// Interval of the checks whether a reload has turned `[authority]` on.
const CHECK_AUTHORITY: Duration = Duration::from_secs(1);
/// Largest valid size of the file, bytes.
const LONGEST: u64 = 1 << 20;

/// The file of the reservations; `None` while reservations are not kept.
pub(super) type ReservationsFile = Arc<Mutex<Option<PathBuf>>>;

/// The saved reservations, as far as a change of them changes the file.
type SavedReservations = Vec<(Instant, String, u8)>;

/// Saves the reservations in this state directory from now on.
pub(super) fn keep_in(file: &ReservationsFile, state_dir: Option<&Path>) {
    let path = state_dir.map(|dir| dir.join(RESERVATIONS));
    *file.lock().unwrap_or_else(PoisonError::into_inner) = path;
}

/// Continues with the reservations from before the start. On a disk that hangs this happens later, and until then
/// no motor is started.
pub(super) async fn restore(file: &ReservationsFile, north: &NorthState, plant: &SharedPlant) {
    let Some(path) = path(file) else { return };
    let (awaited, plant) = (north.awaited.clone(), plant.clone());
    awaited.reservations.begin(path.clone());
    let read = tokio::task::spawn_blocking({
        let path = path.clone();
        move || load(&path)
    });
    let taken_up = {
        let path = path.clone();
        async move {
            let found = read.await.map_err(|error| error.to_string()).and_then(|found| found);
            match found {
                Ok(kept) => plant
                    .load()
                    .restore_reservations(&kept, Instant::now(), SystemTime::now()),
                Err(why) => tracing::error!(
                    target: "drivegate::daemon",
                    "cannot read {}: {why}; drives stopped just before the restart are no longer reserved", path.display()
                ),
            }
            awaited.reservations.end();
        }
    };
    if north.patience.wait(taken_up).await.is_none() {
        tracing::error!(
            target: "drivegate::daemon",
            "cannot read {}: {}; no motor is started until it is read; check the disk of state_dir", path.display(), drivegate_north::patience::late()
        );
    }
}

fn path(file: &ReservationsFile) -> Option<PathBuf> {
    file.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

fn load(path: &Path) -> Result<Vec<KeptReservation>, String> {
    match files::read(path, LONGEST)? {
        Some(text) => serde_json::from_slice(&text).map_err(|error| error.to_string()),
        None => Ok(Vec::new()),
    }
}

/// Writes the reservations whenever they change.
pub(super) fn keep(
    plant: SharedPlant,
    file: ReservationsFile,
    awaited: Arc<AwaitedFiles>,
) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        let mut seen = SavedReservations::new();
        let mut told = false;
        loop {
            let has_authority = plant.load().has_authority();
            tokio::time::sleep(if has_authority { CHECK } else { CHECK_AUTHORITY }).await;
            // A file that was not read is not overwritten.
            if awaited.reservations.path().is_some() {
                continue;
            }
            let kept = plant.load().reservations(Instant::now(), SystemTime::now());
            let now: SavedReservations = kept
                .iter()
                .map(|(until, one)| (*until, one.machine.port.clone(), one.machine.address))
                .collect();
            let Some(path) = path(&file).filter(|_| now != seen) else {
                continue;
            };
            let kept: Vec<KeptReservation> = kept.into_iter().map(|(_, one)| one).collect();
            let written = tokio::task::spawn_blocking(move || write(&path, &kept)).await;
            match written {
                Ok(Ok(())) => (seen, told) = (now, false),
                Ok(Err(why)) if !std::mem::replace(&mut told, true) => tracing::error!(
                    target: "drivegate::daemon",
                    "reservations after stops cannot be saved: {why}; they end with the process; retrying"
                ),
                _ => {}
            }
        }
    })
}

fn write(path: &Path, kept: &[KeptReservation]) -> Result<(), String> {
    let text = serde_json::to_vec_pretty(kept).map_err(|error| error.to_string())?;
    files::replace(path, &text).map_err(|error| format!("{}: {error}", path.display()))
}
