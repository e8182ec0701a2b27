//! The stored history of drives and buses: trends, counters, the last hour of each line. One writer, the recorder's
//! thread; any number of readers, which can delay only that thread.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::Clock;
use super::counters::{Counters, Totals};
use super::line::LineHistory;
use super::trend::{DriveTrend, Reach};
use crate::process_image::{BusImage, DriveSpec, Reading, TapedRead};
use drivegate_model::drive::Profile;

/// Maximum number of drives removed from the configuration whose counters are kept, in case they return.
const MOST_ABSENT: usize = 4096;

/// The past of all drives and buses.
#[derive(Debug, Default)]
pub struct History {
    known: Mutex<Known>,
}

#[derive(Debug, Default)]
struct Known {
    drives: BTreeMap<String, Arc<DriveHistory>>,
    lines: BTreeMap<String, Arc<Mutex<LineHistory>>>,
    /// Counters of drives that are not configured now.
    absent: BTreeMap<String, Totals>,
}

/// The history of a drive: counters and trends.
#[derive(Debug)]
pub struct DriveHistory {
    /// The machine of the trends: another drive of that name has other trends.
    bus: String,
    address: u8,
    profile: Arc<Profile>,
    trend: Mutex<DriveTrend>,
    counters: Mutex<Counters>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl History {
    /// The history of the drive with this name; `None` before its bus was started.
    pub fn drive(&self, name: &str) -> Option<Arc<DriveHistory>> {
        lock(&self.known).drives.get(name).cloned()
    }

    /// The last hour of the bus with this name; `None` before the bus was started.
    pub fn line(&self, bus: &str) -> Option<Arc<Mutex<LineHistory>>> {
        lock(&self.known).lines.get(bus).cloned()
    }

    /// The counters of a drive.
    pub fn totals(&self, drive: &str) -> Totals {
        let known = lock(&self.known);
        let counted = known.drives.get(drive).map(|drive| drive.totals());
        counted.or_else(|| known.absent.get(drive).copied()).unwrap_or_default()
    }

    /// The counters of all drives, including absent ones.
    pub(crate) fn all_totals(&self) -> BTreeMap<String, Totals> {
        let known = lock(&self.known);
        let mut all = known.absent.clone();
        all.extend(known.drives.iter().map(|(name, drive)| (name.clone(), drive.totals())));
        all
    }

    /// Adds the totals of earlier runs.
    pub(crate) fn count_on(&self, totals: BTreeMap<String, Totals>) {
        let known = &mut *lock(&self.known);
        for (name, before) in totals {
            match known.drives.get(&name) {
                Some(drive) => lock(&drive.counters).add(before),
                None => {
                    let absent = known.absent.entry(name).or_default();
                    *absent = absent.after(before);
                }
            }
        }
    }

    /// The history of a drive, kept over a reload: counters always, trends if bus, address and profile are unchanged.
    pub(super) fn of(&self, spec: &DriveSpec, reach: Reach, clock: Clock) -> Arc<DriveHistory> {
        let mut known = lock(&self.known);
        let before = known.drives.get(&spec.name).cloned();
        if let Some(same) = before.as_ref().filter(|before| before.is_of(spec)) {
            return same.clone();
        }
        let counted = before.map(|before| before.totals());
        let counted = counted.or_else(|| known.absent.remove(&spec.name));
        let new = Arc::new(DriveHistory {
            bus: spec.bus.clone(),
            address: spec.address,
            profile: spec.profile.clone(),
            trend: Mutex::new(DriveTrend::new(&spec.profile, reach, clock)),
            counters: Mutex::new(Counters::from(counted.unwrap_or_default())),
        });
        known.drives.insert(spec.name.clone(), new.clone());
        new
    }

    /// The last hour of a bus that is about to start.
    pub(super) fn of_line(&self, bus: &BusImage, clock: Clock) -> Arc<Mutex<LineHistory>> {
        let new = Arc::new(Mutex::new(LineHistory::new(bus, clock)));
        lock(&self.known).lines.insert(bus.spec.name.clone(), new.clone());
        new
    }

    /// Removes the history of all other buses and their drives, except the counters.
    pub(super) fn keep_only(&self, buses: &[Arc<BusImage>]) {
        let known = &mut *lock(&self.known);
        known
            .lines
            .retain(|name, _| buses.iter().any(|bus| bus.spec.name == *name));
        let drives = || buses.iter().flat_map(|bus| &bus.drives);
        known.drives.retain(|name, drive| {
            let is_there = drives().any(|image| image.spec.name == *name);
            if !is_there && known.absent.len() < MOST_ABSENT {
                known.absent.insert(name.clone(), drive.totals());
            }
            is_there
        });
    }
}

impl DriveHistory {
    fn is_of(&self, spec: &DriveSpec) -> bool {
        (&self.bus, self.address, &self.profile) == (&spec.bus, spec.address, &spec.profile)
    }

    pub fn trend(&self) -> MutexGuard<'_, DriveTrend> {
        lock(&self.trend)
    }

    /// The present totals of the drive.
    pub fn totals(&self) -> Totals {
        lock(&self.counters).totals()
    }

    /// Processes a read of the drive, which shows `reading` right after it; `known` is the reading of the drive's
    /// image.
    pub(super) fn read(&self, read: &TapedRead, reading: &Reading<'_>, known: &Reading<'_>) {
        self.trend().read(read, reading, known);
        lock(&self.counters).read(reading, known);
    }

    /// Notes that the drive was offline.
    pub(super) fn interrupt(&self) {
        self.trend().interrupt();
        lock(&self.counters).interrupt();
    }
}
