//! Saves the reservations that stops left, so that they outlive the process: they are written while the stop is
//! sent, never before it.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::files::State as _;
use drivegate_core::files::names::RESERVATIONS;
use drivegate_core::permit::{AwaitedFiles, KeptReservations};
use drivegate_core::plant::SharedPlant;
use drivegate_north::NorthState;
use drivegate_north::state_file::{self, LATE, StateFile};

/// Interval of the checks for changed reservations.
const CHECK: Duration = Duration::from_millis(50);
/// Interval of the checks whether a reload has turned `[authority]` on.
const CHECK_AUTHORITY: Duration = Duration::from_secs(1);

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
    let reading = state_file::read::<KeptReservations>(path.clone());
    let taken_up = async move {
        // A thread that panicked has logged that, and the file stays unread.
        let Ok(found) = reading.await else { return };
        let KeptReservations(kept) = found.unwrap_or_default();
        plant
            .load()
            .restore_reservations(&kept, Instant::now(), SystemTime::now());
        awaited.reservations.end();
    };
    if north.patience.wait(taken_up).await.is_none() {
        KeptReservations::WORDS.not_read(&path, &LATE);
    }
}

fn path(file: &ReservationsFile) -> Option<PathBuf> {
    file.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// Writes the reservations whenever they change.
pub(super) fn keep(
    plant: SharedPlant,
    file: ReservationsFile,
    awaited: Arc<AwaitedFiles>,
) -> tokio::task::JoinHandle<()> {
    tokio::spawn(async move {
        let mut saved = StateFile::new(KeptReservations::WORDS);
        loop {
            let has_authority = plant.load().has_authority();
            tokio::time::sleep(if has_authority { CHECK } else { CHECK_AUTHORITY }).await;
            let now = Instant::now();
            // The file has logged a failure, and keeps its state for the next try.
            let _ = saved.ended(now);
            // A file that was not read is not overwritten.
            let Some(path) = path(&file).filter(|_| awaited.reservations.path().is_none()) else {
                continue;
            };
            let kept = plant.load().reservations(now, SystemTime::now());
            let content: SavedReservations = kept
                .iter()
                .map(|(until, one)| (*until, one.machine.port.clone(), one.machine.address))
                .collect();
            let kept = KeptReservations(kept.into_iter().map(|(_, one)| one).collect());
            saved.keep((path, content), now, move |(path, _)| kept.save(path));
        }
    })
}
