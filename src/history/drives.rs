//! What is kept in memory of the past of each drive: trends. One writer, the recorder's thread; any number of readers.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::Clock;
use super::trend::DriveTrend;
use crate::drive::Profile;
use crate::process_image::DriveSpec;

/// The past of all drives.
#[derive(Debug, Default)]
pub struct History {
    drives: Mutex<BTreeMap<String, Arc<DriveHistory>>>,
}

/// The past of a drive.
#[derive(Debug)]
pub struct DriveHistory {
    /// What it was made for: another drive of that name has another past.
    bus: String,
    address: u8,
    profile: Arc<Profile>,
    trend: Mutex<DriveTrend>,
}

impl History {
    fn drives(&self) -> MutexGuard<'_, BTreeMap<String, Arc<DriveHistory>>> {
        self.drives.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The past of the drive of that name; none before its bus was started.
    pub fn drive(&self, name: &str) -> Option<Arc<DriveHistory>> {
        self.drives().get(name).cloned()
    }

    /// The past of a drive, which it keeps over a reload as long as it is the same: bus, address and profile.
    pub(super) fn of(&self, spec: &DriveSpec, clock: Clock) -> Arc<DriveHistory> {
        let mut drives = self.drives();
        if let Some(known) = drives.get(&spec.name).filter(|known| known.is_of(spec)) {
            return known.clone();
        }
        let new = Arc::new(DriveHistory {
            bus: spec.bus.clone(),
            address: spec.address,
            profile: spec.profile.clone(),
            trend: Mutex::new(DriveTrend::new(&spec.profile, clock)),
        });
        drives.insert(spec.name.clone(), new.clone());
        new
    }

    /// Forgets all drives but these.
    pub(super) fn keep_only(&self, is_there: impl Fn(&str) -> bool) {
        self.drives().retain(|name, _| is_there(name));
    }
}

impl DriveHistory {
    fn is_of(&self, spec: &DriveSpec) -> bool {
        (&self.bus, self.address, &self.profile) == (&spec.bus, spec.address, &spec.profile)
    }

    /// Its trends. Whoever holds them holds up the thread that writes them, and no bus.
    pub fn trend(&self) -> MutexGuard<'_, DriveTrend> {
        self.trend.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
