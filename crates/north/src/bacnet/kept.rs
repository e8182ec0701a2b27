//! State kept across a restart with `keep_priorities`: inactive values of `run` at the priorities that protect
//! people. After the restart these values refuse starts as before; nothing is written to a drive.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Instant, SystemTime};

use serde::{Deserialize, Serialize};

use super::Options;
use super::rights::HostRights;
use crate::NorthState;
use crate::patience::DISK;
use crate::state_file::StateFile;
use drivegate_core::event::{Event, EventKind, Events};
use drivegate_core::files::names::BACNET_PRIORITIES;
use drivegate_core::files::{State, Words};
use drivegate_core::order::{Commanded, Entry, Origin, SourceKind};
use drivegate_core::permit::PROTECTING;
use drivegate_core::plant::{BusHandle, Plant, SharedPlant};
use drivegate_core::process_image::{Access, Machine};
use drivegate_model::drive::Value;

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct KeptSlot {
    #[serde(flatten)]
    machine: Machine,
    priority: u8,
    who: String,
    client: String,
}

/// The slots on disk.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub(super) struct KeptSlots(pub(super) Vec<KeptSlot>);

impl State for KeptSlots {
    const WORDS: Words = Words {
        what: "the BACnet priorities",
        unread: "no motor is started",
        unsaved: "slots do not survive a restart",
        lost: "the slots from before the restart are lost; write them again",
    };
    const VERSION_KEY: &'static str = "drivegate_bacnet_priorities";
    const LONGEST: u64 = 4 << 20;
}

pub(super) fn of_plant(plant: &Plant) -> KeptSlots {
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
    KeptSlots(all)
}

/// Restores the saved entries into their slots. An entry is void if its client may no longer write, or its drive no
/// longer exists.
pub(super) fn restore(
    plant: &Plant,
    rights: &HostRights,
    KeptSlots(slots): &KeptSlots,
    now: Instant,
    time: SystemTime,
) {
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

fn remove(path: &Path) -> Result<(), String> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(format!("cannot remove {}: {error}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Notes that a server is about to load the slots of an earlier run: until then no motor is started.
pub fn expect(stats: &NorthState, state_dir: &Path) {
    stats.awaited.slots.begin(state_dir.join(BACNET_PRIORITIES));
}

/// Discards the slots of an earlier run, at the start of a gateway that does not save slots. No later configuration
/// revives them.
pub async fn discard(stats: &NorthState, state_dir: &Path, events: &Events) {
    stats.kept_slots_read.store(true, Ordering::Relaxed);
    let (path, events) = (state_dir.join(BACNET_PRIORITIES), events.clone());
    let discard = move || {
        let kept = KeptSlots::load(&path).ok().flatten();
        for slot in kept.into_iter().flat_map(|KeptSlots(slots)| slots) {
            events.publish(slot.void(SystemTime::now()));
        }
        if let Err(why) = remove(&path) {
            tracing::error!(
                target: "drivegate::bacnet",
                "{why}; remove it, or its slots come back with keep_priorities"
            );
        }
    };
    // On a slow disk the file is discarded after this function returns.
    let _ = stats.patience.read(discard).await;
}

/// Restores the slots of an earlier run for a command without a gateway, which serves no BACnet: the slots of its drives
/// refuse starts as in the gateway, and the file stays as it is. While the file cannot be read, no motor is started.
pub async fn obey(stats: &NorthState, options: &Options, plant: &SharedPlant) {
    expect(stats, &options.state_dir);
    let path = options.state_dir.join(BACNET_PRIORITIES);
    if let Ok(Ok(found)) = stats.patience.read(move || KeptSlots::load(&path)).await {
        let plant = plant.load();
        let KeptSlots(mut slots) = found.unwrap_or_default();
        slots.retain(|slot| plant.drive_at(&slot.machine).is_some());
        let rights = HostRights::new(options);
        restore(&plant, &rights, &KeptSlots(slots), Instant::now(), SystemTime::now());
        stats.awaited.slots.end();
    }
}

/// The file of saved slots; the mark is its path with the slots in it, `None` if there is no file.
pub(super) type KeptFile = StateFile<Option<(PathBuf, KeptSlots)>>;

/// Writes the slots to `path` if they are not on disk yet; without `path`, removes the saved ones.
pub(super) fn keep(file: &mut KeptFile, path: Option<PathBuf>, plant: &Plant, now: Instant) {
    // The file has logged a failure.
    let _ = file.ended(now);
    let before = file.written().as_ref().map(|(path, _)| path.clone());
    let outdated = before.filter(|before| Some(before) != path.as_ref());
    let wanted = path.map(|path| (path, of_plant(plant)));
    file.keep(wanted, now, move |wanted| {
        outdated.as_deref().map_or(Ok(()), remove)?;
        wanted.as_ref().map_or(Ok(()), |(path, slots)| slots.save(path))
    });
}

/// Writes the slots a last time and waits for it, within the time limit for the disk.
pub(super) async fn finish(file: &mut KeptFile, path: Option<PathBuf>, plant: &Plant) {
    let until = tokio::time::Instant::now() + DISK;
    if file.settled(until).await {
        keep(file, path, plant, Instant::now());
        file.settled(until).await;
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use drivegate_core::files::PARTIAL;
    use drivegate_core::files::state::AGAIN;

    use super::*;

    #[test]
    fn what_is_saved_is_loaded_and_what_is_broken_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(BACNET_PRIORITIES);
        assert_eq!(KeptSlots::load(&file).unwrap(), None);
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
        let slots = KeptSlots(vec![slot]);
        slots.save(&file).unwrap();
        assert_eq!(KeptSlots::load(&file).unwrap(), Some(slots));
        std::fs::write(&file, "[{").unwrap();
        assert!(KeptSlots::load(&file).is_err());
    }

    /// Waits until the write in progress has ended.
    async fn until_ended(kept: &mut KeptFile, path: Option<&PathBuf>, plant: &Plant, now: Instant) {
        while kept.is_writing() {
            tokio::time::sleep(Duration::from_millis(1)).await;
            keep(kept, path.cloned(), plant, now);
        }
    }

    #[tokio::test]
    async fn what_a_full_disk_refused_is_written_when_there_is_room_unasked() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(BACNET_PRIORITIES);
        // A folder of this name prevents the file from being created.
        let aside = file.with_extension(PARTIAL);
        std::fs::create_dir(&aside).unwrap();
        let plant = Plant::new("test", Duration::from_secs(1), Vec::new());
        let (mut kept, start) = (KeptFile::new(KeptSlots::WORDS), Instant::now());
        keep(&mut kept, Some(file.clone()), &plant, start);
        until_ended(&mut kept, Some(&file), &plant, start).await;
        assert!(!file.exists());
        std::fs::remove_dir(&aside).unwrap();
        keep(&mut kept, Some(file.clone()), &plant, start + AGAIN / 2);
        assert!(!kept.is_writing(), "too early");
        keep(&mut kept, Some(file.clone()), &plant, start + AGAIN);
        until_ended(&mut kept, Some(&file), &plant, start + AGAIN).await;
        assert_eq!(KeptSlots::load(&file).unwrap(), Some(KeptSlots::default()));
        // The slots move with the state directory, and go with `keep_priorities`.
        let elsewhere = folder.path().join("elsewhere").join(BACNET_PRIORITIES);
        keep(&mut kept, Some(elsewhere.clone()), &plant, start);
        until_ended(&mut kept, Some(&elsewhere), &plant, start).await;
        assert!(elsewhere.exists() && !file.exists());
        keep(&mut kept, None, &plant, start);
        until_ended(&mut kept, None, &plant, start).await;
        assert!(!elsewhere.exists());
    }
}
