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
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// Interval of the checks for changed reservations.
const CHECK: Duration = Duration::from_millis(50);
/// Interval of the checks whether a reload has turned `[authority]` on.
const CHECK_AUTHORITY: Duration = Duration::from_secs(1);
/// Time limit for the last save; shorter than the gateway waits for it, so that a failure is logged.
const LAST_SAVE: Duration = Duration::from_millis(900);

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

/// The task that saves the reservations.
#[derive(Debug)]
pub(super) struct Saver {
    end: CancellationToken,
    task: JoinHandle<()>,
}

impl Saver {
    /// Writes the reservations whenever they change.
    pub(super) fn start(plant: SharedPlant, file: ReservationsFile, awaited: Arc<AwaitedFiles>) -> Saver {
        Saver::with_limit(plant, file, awaited, LAST_SAVE)
    }

    /// As [`Saver::start`]; the last save may take `limit`.
    fn with_limit(plant: SharedPlant, file: ReservationsFile, awaited: Arc<AwaitedFiles>, limit: Duration) -> Saver {
        let end = CancellationToken::new();
        let ended = end.clone();
        let task = tokio::spawn(async move {
            let mut saved = StateFile::new(KeptReservations::WORDS);
            let save = |saved: &mut StateFile<_>| {
                // A file that was not read is not overwritten.
                if let Some(path) = path(&file).filter(|_| awaited.reservations.path().is_none()) {
                    save(saved, path, &plant, Instant::now());
                }
            };
            while tokio::time::timeout(pause(&plant), ended.cancelled()).await.is_err() {
                save(&mut saved);
            }
            let until = tokio::time::Instant::now() + limit;
            // A write that is in progress may fail, and lacks what was reserved since it began.
            let _ = saved.settled(until).await;
            // A write that the disk still holds up must not meet a second one in the same file.
            if tokio::time::Instant::now() < until {
                save(&mut saved);
                if saved.settled(until).await {
                    return;
                }
            }
            tracing::error!(
                target: "drivegate::daemon",
                "the reservations of the last stops are not on disk: clients of lower rank may start those drives right after the \
                 next start; check state_dir of [gateway] and the disk"
            );
        });
        Saver { end, task }
    }

    /// Saves what the last stops reserved, and ends.
    pub(super) async fn end(&mut self) {
        self.end.cancel();
        // A task that panicked has logged that.
        let _ = (&mut self.task).await;
    }
}

/// How long the saver waits between two checks.
fn pause(plant: &SharedPlant) -> Duration {
    if plant.load().has_authority() {
        CHECK
    } else {
        CHECK_AUTHORITY
    }
}

/// Begins to write the reservations unless they are on disk.
fn save(saved: &mut StateFile<(PathBuf, SavedReservations)>, path: PathBuf, plant: &SharedPlant, now: Instant) {
    // The file has logged a failure, and keeps its state for the next try.
    let _ = saved.ended(now);
    let kept = plant.load().reservations(now, SystemTime::now());
    let content: SavedReservations = kept
        .iter()
        .map(|(until, one)| (*until, one.machine.port.clone(), one.machine.address))
        .collect();
    let kept = KeptReservations(kept.into_iter().map(|(_, one)| one).collect());
    saved.keep((path, content), now, move |(path, _)| kept.save(path));
}

#[cfg(test)]
mod tests {
    use drivegate_core::order::{Authority, Order, Origin, Proof, SourceKind};
    use drivegate_core::plant::OrderRequest;
    use drivegate_model::drive::{ModelPoint, Value};
    use drivegate_testkit::{nx_plant, online};

    use super::*;
    use crate::config::Settings;

    /// The single thread of this test checks nothing between the stop and the end.
    #[tokio::test]
    async fn what_the_last_stop_reserved_is_on_disk_when_the_saver_has_ended() {
        let folder = tempfile::tempdir().unwrap();
        let text = "[gateway]\nname = \"hall\"\n[authority]\nmode = \"exclusive\"\n[[authority.principal]]\nname = \"alice\"\n\
                    rank = \"operator\"\nmodbus_tcp = [\"10.0.0.5/32\"]\n";
        let loaded = Settings::parse("drivegate.toml", text, std::iter::empty());
        let settings = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors));
        let plant = nx_plant(&["pump"]);
        plant.buses[0].queue.set_authority(settings.authority);
        let drive = plant.drive("pump").unwrap();
        online(&drive.image);
        let file = ReservationsFile::default();
        keep_in(&file, Some(folder.path()));
        let plant = Arc::new(arc_swap::ArcSwap::from_pointee(plant));
        let mut saver = Saver::with_limit(plant, file, Arc::default(), Duration::from_secs(60));
        tokio::task::yield_now().await;
        let run = drive.image.spec.profile.model_index(ModelPoint::Run).unwrap();
        let order = Order::Points(vec![(run, Value::Bool(false))]);
        let proof = Proof::Address("10.0.0.5".parse().unwrap());
        let origin = Origin::new(SourceKind::ModbusTcp, "10.0.0.5:1").proven(proof);
        let _stop = drive.place(OrderRequest::new(order, origin, Authority::Write), Instant::now());
        saver.end().await;
        let saved = KeptReservations::load(&folder.path().join(RESERVATIONS)).unwrap();
        let named = saved.map(|KeptReservations(kept)| kept.into_iter().map(|one| one.who).collect::<Vec<_>>());
        assert_eq!(named, Some(vec!["alice".to_string()]));
    }
}
