//! State kept across a restart with `keep_priorities`: inactives of `run` at the priorities that protect people. They
//! refuse starts as before; nothing is written to a drive.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::command::{Commanded, Entry, Origin, PROTECTING, SourceKind};
use crate::drive::Value;
use crate::files;
use crate::plant::Plant;
use crate::process_image::{Access, Machine};

/// The name of the file in `state_dir`.
pub(super) const FILE: &str = "bacnet-priorities.json";
/// Longest file that is read.
const LONGEST: u64 = 4 << 20;

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

/// Puts them into their slots again, those of drives that are there.
pub(super) fn restore(plant: &Plant, slots: &[KeptSlot], now: Instant) {
    for slot in slots.iter().filter(|slot| (1..=PROTECTING).contains(&slot.priority)) {
        let drive = plant.drive_at(&slot.machine);
        let Some(drive) = drive.filter(|drive| drive.image.spec.access == Access::Control) else {
            continue;
        };
        let origin = Origin::of(Arc::from(slot.client.as_str()), SourceKind::Bacnet, slot.who.clone());
        drive.priorities(|all| {
            if all.stands(Commanded::Run, slot.priority).is_none() {
                all.restore(
                    Commanded::Run,
                    slot.priority,
                    Entry::new(Value::Bool(false), origin, now),
                );
            }
        });
    }
}

/// Reads the file; one that is not there holds nothing.
///
/// # Errors
/// It cannot be read, or is none of these.
pub(super) fn load(path: &Path) -> Result<Vec<KeptSlot>, String> {
    match files::read(path, LONGEST)? {
        Some(text) => serde_json::from_slice(&text).map_err(|error| error.to_string()),
        None => Ok(Vec::new()),
    }
}

/// Writes the file.
///
/// # Errors
/// It cannot be written.
pub(super) fn save(path: &Path, slots: &[KeptSlot]) -> Result<(), String> {
    let text = serde_json::to_vec_pretty(slots).map_err(|error| error.to_string())?;
    files::replace(path, &text).map_err(|error| error.to_string())
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
}
