//! State kept across a restart with `keep_priorities`: inactive values of `run` at the priorities that protect
//! people. After the restart these values refuse starts as before; nothing is written to a drive.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use futures_util::FutureExt as _;
use serde::{Deserialize, Serialize};
use tokio::task::JoinHandle;

use super::rights::HostRights;
use crate::NorthState;
use crate::patience::DISK;
use drivegate_core::event::{Event, EventKind, Events};
use drivegate_core::files;
use drivegate_core::order::{Commanded, Entry, Origin, SourceKind};
use drivegate_core::permit::PROTECTING;
use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{Access, Machine};
use drivegate_model::drive::Value;

/// The name of the file in `state_dir`.
pub(super) const FILE: &str = "bacnet-priorities.json";
/// Longest file that the gateway reads.
const LONGEST: u64 = 4 << 20;
/// Time between two tries to write the file.
const AGAIN: Duration = Duration::from_secs(10);
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct KeptSlot {
    #[serde(flatten)]
    machine: Machine,
    priority: u8,
    who: String,
    client: String,
}

pub(super) fn of_plant(plant: &Plant) -> Vec<KeptSlot> {
    let mut all = Vec::new();
    for drive in plant
        .drives()
        .filter(|drive| drive.image.spec.access == Access::Control)
    {
        let machine = drive.machine();
        drive.priorities(|priorities| {
            all.extend(priorities.kept().map(|(priority, entry)| KeptSlot {
                machine: machine.clone(),
                priority,
                who: entry.origin.who.clone(),
                client: entry.origin.client().to_string(),
            }));
        });
    }
    all
}

/// Restores the saved entries into their slots. An entry is void if its client may no longer write, or its drive no
/// longer exists.
pub(super) fn restore(plant: &Plant, rights: &HostRights, slots: &[KeptSlot], now: Instant, time: SystemTime) {
    for slot in slots.iter().filter(|slot| (1..=PROTECTING).contains(&slot.priority)) {
        let Some(drive) = plant.drive_at(&slot.machine) else {
            plant.events.publish(slot.void(time));
            continue;
        };
        let origin = Origin::of(Arc::from(slot.client.as_str()), SourceKind::Bacnet, slot.who.clone());
        let origin = origin.with_right(rights.of_name(&slot.who));
        drive.priorities(|all| {
            if all.entry(Commanded::Run, slot.priority).is_none() {
                all.restore(
                    Commanded::Run,
                    slot.priority,
                    Entry::new(Value::Bool(false), origin, now),
                );
            }
        });
    }
    let void = |bus: &BusHandle| bus.void_slots(Some(&plant.events), time);
    plant.buses.iter().for_each(void);
}

impl KeptSlot {
    /// The event for a slot that is not restored.
    fn void(&self, time: SystemTime) -> Event {
        let Machine { port, address, .. } = &self.machine;
        let text = format!(
            "BACnet client {} held `run` inactive at priority {} of the drive at address {address} on {port} before the \
             restart; as the gateway is configured now it may not, so that slot is void",
            self.who, self.priority
        );
        Event::new(EventKind::SlotVoid, time, text)
    }
}

/// Reads the file with the kept slots; a missing file holds no slots.
///
/// # Errors
/// If the file cannot be read, or is not a list of slots.
pub(super) fn load(path: &Path) -> Result<Vec<KeptSlot>, String> {
    match files::read(path, LONGEST)? {
        Some(text) => serde_json::from_slice(&text).map_err(|error| error.to_string()),
        None => Ok(Vec::new()),
    }
}

/// Writes the file of saved slots.
///
/// # Errors
/// If the file cannot be written.
fn save(path: &Path, slots: &[KeptSlot]) -> Result<(), String> {
    let text = serde_json::to_vec_pretty(slots).map_err(|error| error.to_string())?;
    files::replace(path, &text).map_err(|error| error.to_string())
}

fn remove(path: &Path) -> Result<(), String> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error.to_string()),
        _ => Ok(()),
    }
}

/// Notes that a server is about to load the slots of an earlier run: until then no motor is started.
pub fn expect(stats: &NorthState, state_dir: &Path) {
    stats.awaited.slots.begin(state_dir.join(FILE));
}

/// Discards the slots of an earlier run, at the start of a gateway that does not save slots. No later configuration
/// revives them.
pub async fn discard(stats: &NorthState, state_dir: &Path, events: &Events) {
    stats.kept_slots_read.store(true, Ordering::Relaxed);
    let (path, events) = (state_dir.join(FILE), events.clone());
    let discard = move || {
        for slot in load(&path).unwrap_or_default() {
            events.publish(slot.void(SystemTime::now()));
        }
        if let Err(why) = remove(&path) {
            tracing::error!(
                target: "drivegate::bacnet",
                "cannot remove {}: {why}; remove it, or its slots come back with keep_priorities", path.display()
            );
        }
    };
    // On a slow disk the file is discarded after this function returns.
    let _ = stats.patience.read(discard).await;
}

/// Path of the file for saved slots, and the slots in it.
type Kept = (PathBuf, Vec<KeptSlot>);

/// The file of saved slots, kept up to date by a server with one write after the other.
#[derive(Debug, Default)]
pub(super) struct KeptFile {
    /// Slots known to be on disk, with the path of their file.
    written: Option<Kept>,
    writing: Option<JoinHandle<Result<Option<Kept>, String>>>,
    /// When a failed write is tried again.
    again: Option<Instant>,
}

impl KeptFile {
    /// Notes that the file was read.
    pub(super) fn read(&mut self, path: PathBuf, slots: Vec<KeptSlot>) {
        self.written = Some((path, slots));
    }

    /// Writes these slots to `path` if they are not on disk yet; without `path`, removes the saved ones.
    pub(super) fn keep(&mut self, path: Option<PathBuf>, plant: &Plant, now: Instant) {
        if let Some(done) = self.writing.take_if(|writing| writing.is_finished()) {
            match done.now_or_never() {
                Some(Ok(Ok(written))) => (self.written, self.again) = (written, None),
                Some(Ok(Err(why))) => self.failed(&why, now),
                // A thread that panicked has logged that.
                _ => self.again = Some(now + AGAIN),
            }
        }
        if self.writing.is_some() || self.again.is_some_and(|again| now < again) {
            return;
        }
        let wanted = path.map(|path| (path, of_plant(plant)));
        if wanted == self.written {
            return;
        }
        let before = self.written.as_ref().map(|(path, _)| path.clone());
        self.writing = Some(tokio::task::spawn_blocking(move || {
            let path = wanted.as_ref().map(|(path, _)| path);
            if let Some(outdated) = before.as_ref().filter(|before| Some(*before) != path) {
                remove(outdated)?;
            }
            if let Some((path, slots)) = &wanted {
                save(path, slots)?;
            }
            Ok(wanted)
        }));
    }

    fn failed(&mut self, why: &str, now: Instant) {
        if self.again.replace(now + AGAIN).is_none() {
            tracing::error!(
                target: "drivegate::bacnet",
                "cannot keep {FILE} up to date: {why}; slots may not survive a restart; retrying every {} s",
                AGAIN.as_secs()
            );
        }
    }

    /// Writes the slots a last time and waits for it, within the time limit for the disk.
    pub(super) async fn finish(&mut self, path: Option<PathBuf>, plant: &Plant) {
        let until = tokio::time::Instant::now() + DISK;
        loop {
            if let Some(writing) = self.writing.take() {
                match tokio::time::timeout_at(until, writing).await {
                    Ok(Ok(Ok(written))) => self.written = written,
                    _ => return,
                }
            }
            self.again = None;
            self.keep(path.clone(), plant, Instant::now());
            if self.writing.is_none() {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_saved_is_loaded_and_what_is_broken_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(FILE);
        assert_eq!(load(&file), Ok(Vec::new()));
        let slot = KeptSlot {
            machine: Machine {
                port: "/dev/ttyUSB0".to_string(),
                address: 3,
                profile: "vacon-nx".to_string(),
            },
            priority: 1,
            who: "10.0.0.5:47808".to_string(),
            client: "bacnet 10.0.0.5".to_string(),
        };
        save(&file, std::slice::from_ref(&slot)).unwrap();
        assert_eq!(load(&file), Ok(vec![slot]));
        std::fs::write(&file, "[{").unwrap();
        assert!(load(&file).is_err());
    }

    /// Waits until the write in progress has ended.
    async fn until_ended(kept: &mut KeptFile, path: &Path, plant: &Plant, now: Instant) {
        while kept.writing.is_some() {
            tokio::time::sleep(Duration::from_millis(1)).await;
            kept.keep(Some(path.to_path_buf()), plant, now);
        }
    }

    #[tokio::test]
    async fn what_a_full_disk_refused_is_written_when_there_is_room_unasked() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(FILE);
        // A folder of this name prevents the file from being created.
        let aside = file.with_extension(files::PARTIAL);
        std::fs::create_dir(&aside).unwrap();
        let plant = Plant::new("test", Duration::from_secs(1), Vec::new());
        let (mut kept, start) = (KeptFile::default(), Instant::now());
        kept.keep(Some(file.clone()), &plant, start);
        until_ended(&mut kept, &file, &plant, start).await;
        assert!(kept.again.is_some() && !file.exists());
        std::fs::remove_dir(&aside).unwrap();
        kept.keep(Some(file.clone()), &plant, start + AGAIN / 2);
        assert!(kept.writing.is_none(), "too early");
        kept.keep(Some(file.clone()), &plant, start + AGAIN);
        until_ended(&mut kept, &file, &plant, start + AGAIN).await;
        assert_eq!(load(&file), Ok(Vec::new()));
        assert!(file.exists() && kept.again.is_none());
    }
}
