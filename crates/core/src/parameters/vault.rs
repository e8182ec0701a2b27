//! The readings and restores in progress, one of each per drive, and the results of the last ones.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::file::ParameterFile;
use super::journal::JournalFile;
use super::names::Names;
use super::plan::Plan;
use super::store::Store;
use crate::process_image::{Machine, RestoreLock};

/// How far the reading of a drive is.
#[derive(Debug, Clone, PartialEq)]
pub struct Status {
    /// Number of the reading: a later one has a higher number.
    pub number: u64,
    /// Number of addresses requested so far, and of all.
    pub progress: (usize, usize),
    /// Estimated time until the reading ends.
    pub remaining: Option<Duration>,
    /// What is read now.
    pub now: Option<String>,
    /// Why the reading waits.
    pub waits: Option<String>,
    /// Result of the reading; `None` while it is in progress.
    pub result: Option<Result<Arc<ParameterFile>, String>>,
}

/// The stage of a restore.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RestoreStage {
    /// The drive's present parameters are being read.
    Reading,
    /// The plan is ready; the requester decides.
    Prepared,
    /// The restore must not be carried out, for these reasons.
    Refused(Vec<String>),
    /// The parameters are being written.
    Working,
    /// The restore has ended, with a summary.
    Ended(String),
    /// The restore was given up: the reason and the remedy.
    Failed(String),
}

/// The prepared plan of a restore.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Prepared {
    /// The writes of the restore.
    pub plan: Plan,
    /// The risks the user accepts.
    pub risks: Vec<String>,
}

/// How far the restore of a drive is.
#[derive(Debug, Clone, PartialEq)]
pub struct RestoreStatus {
    /// Number of the restore: a later one has a higher number.
    pub number: u64,
    /// Stage of the restore.
    pub stage: RestoreStage,
    /// Addresses that were read, or parameters that were written, and all.
    pub progress: (usize, usize),
    /// Why the restore has to wait at present.
    pub waits: Option<String>,
    /// Plan of the restore, once it is known.
    pub prepared: Arc<Prepared>,
    /// Whether a user asked to end the restore before the next parameter.
    pub is_unwanted: bool,
}

impl RestoreStatus {
    /// Whether the drive is read or written.
    pub fn is_in_progress(&self) -> bool {
        matches!(self.stage, RestoreStage::Reading | RestoreStage::Working)
    }
}

#[derive(Debug, Default)]
struct State {
    numbered: u64,
    restores: BTreeMap<Machine, RestoreStatus>,
    restore_locks: BTreeMap<Machine, Arc<RestoreLock>>,
    /// Machines for which it is known whether they have a journal.
    looked_for: BTreeSet<Machine>,
    /// Number of the last search for journals.
    searches: u64,
    /// Journals without a drive that an event has reported.
    orphans: BTreeSet<PathBuf>,
    readings: BTreeMap<Machine, Status>,
    /// The last reading of each drive since the gateway started, whether the disk took it or not.
    last: BTreeMap<Machine, Arc<ParameterFile>>,
    changed: BTreeMap<(String, String), u64>,
    names: BTreeMap<String, Arc<Names>>,
    store: Option<Store>,
    /// Configured drives that this process does not serve, with their names: a journal may belong to one of them.
    others: Vec<(Machine, String)>,
}

/// The readings of all drives of the gateway.
#[derive(Debug, Default)]
pub struct Vault(Mutex<State>);

impl Vault {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets where readings are stored from now on (`None`: nowhere), and for each profile the parameter names that
    /// precede those of the profile.
    pub fn configure(&self, store: Option<Store>, names: BTreeMap<String, Arc<Names>>) {
        let mut state = self.lock();
        (state.store, state.names) = (store, names);
    }

    /// Sets the configured drives that this process does not serve; a gateway process serves all of its drives.
    pub fn set_others(&self, others: Vec<(Machine, String)>) {
        self.lock().others = others;
    }

    /// The configured drives that this process does not serve, with their names.
    pub fn others(&self) -> Vec<(Machine, String)> {
        self.lock().others.clone()
    }

    /// The store in which readings are kept.
    pub fn store(&self) -> Option<Store> {
        self.lock().store.clone()
    }

    /// Names that take precedence over those of a profile.
    pub fn names(&self, profile: &str) -> Arc<Names> {
        self.lock().names.get(profile).cloned().unwrap_or_default()
    }

    /// Parameters that changed and that the gateway did not write, by bus and drive.
    pub fn changed(&self) -> BTreeMap<(String, String), u64> {
        self.lock().changed.clone()
    }

    /// Adds `count` to the changed parameters of the drive.
    pub fn count_changed(&self, bus: &str, drive: &str, count: u64) {
        *self
            .lock()
            .changed
            .entry((bus.to_string(), drive.to_string()))
            .or_default() += count;
    }

    /// Progress of the last reading of this drive, if there was one since the gateway started.
    pub fn status(&self, drive: &Machine) -> Option<Status> {
        self.lock().readings.get(drive).cloned()
    }

    /// The last reading of that drive that succeeded since the gateway started.
    pub fn last(&self, drive: &Machine) -> Option<Arc<ParameterFile>> {
        self.lock().last.get(drive).cloned()
    }

    /// Whether a reading is in progress.
    pub fn is_reading(&self, drive: &Machine) -> bool {
        self.lock()
            .readings
            .get(drive)
            .is_some_and(|reading| reading.result.is_none())
    }

    /// Notes that a reading of this drive begins.
    ///
    /// # Errors
    /// If a backup of the drive is already in progress: contains its number.
    pub fn begin(&self, drive: &Machine) -> Result<u64, u64> {
        let mut state = self.lock();
        if let Some(reading) = state.readings.get(drive).filter(|reading| reading.result.is_none()) {
            return Err(reading.number);
        }
        state.numbered += 1;
        let number = state.numbered;
        let begun = Status {
            number,
            progress: (0, 0),
            remaining: None,
            now: None,
            waits: None,
            result: None,
        };
        state.readings.insert(drive.clone(), begun);
        Ok(number)
    }

    /// The reading of that drive has ended.
    pub fn end(&self, drive: &Machine, result: Result<ParameterFile, String>) {
        let mut state = self.lock();
        let result = result.map(Arc::new);
        if let Ok(file) = &result {
            state.last.insert(drive.clone(), file.clone());
        }
        if let Some(reading) = state.readings.get_mut(drive) {
            (reading.waits, reading.remaining, reading.now) = (None, None, None);
            reading.result = Some(result);
        }
    }

    /// Updates the status of the reading of this drive.
    pub fn update(&self, drive: &Machine, change: impl FnOnce(&mut Status)) {
        if let Some(reading) = self.lock().readings.get_mut(drive) {
            change(reading);
        }
    }

    /// The hold of this drive; the hold stays the same when the configuration changes.
    pub fn restore_lock(&self, drive: &Machine) -> Arc<RestoreLock> {
        self.lock().restore_locks.entry(drive.clone()).or_default().clone()
    }

    /// Path of the journal for a restore that begins, by the name of the drive; `None` without a store.
    pub fn journal(&self, drive: &str) -> Option<JournalFile> {
        let state = self.lock();
        Some(JournalFile::new(state.store.as_ref()?.dir(), drive))
    }

    /// Whether it is not known yet if this machine has a journal.
    pub fn is_new(&self, drive: &Machine) -> bool {
        !self.lock().looked_for.contains(drive)
    }

    /// Notes that the search for a journal of this machine is over.
    pub fn looked_for(&self, drive: &Machine) {
        self.lock().looked_for.insert(drive.clone());
    }

    /// Begins a search for journals, which replaces an earlier one that goes on; returns its number.
    pub fn begin_search(&self) -> u64 {
        let mut state = self.lock();
        state.searches += 1;
        state.searches
    }

    /// Whether no later search for journals has begun.
    pub fn is_last_search(&self, number: u64) -> bool {
        self.lock().searches == number
    }

    /// Sets the journals without a drive. Returns the new ones.
    pub fn new_orphans(&self, orphans: BTreeSet<PathBuf>) -> BTreeSet<PathBuf> {
        let before = std::mem::replace(&mut self.lock().orphans, orphans.clone());
        orphans.difference(&before).cloned().collect()
    }

    /// Progress of the last restore of this drive, if there was one since the gateway started.
    pub fn restore(&self, drive: &Machine) -> Option<RestoreStatus> {
        self.lock().restores.get(drive).cloned()
    }

    /// Starts a restore of the drive at this stage; returns the number of the restore.
    ///
    /// # Errors
    /// If another restore of the drive is in progress.
    pub fn begin_restore(&self, drive: &Machine, name: &str, stage: RestoreStage) -> Result<u64, String> {
        let mut state = self.lock();
        if state.restores.get(drive).is_some_and(RestoreStatus::is_in_progress) {
            return Err(format!("a restore of the parameters of `{name}` is already running"));
        }
        state.numbered += 1;
        let begun = RestoreStatus {
            number: state.numbered,
            stage,
            progress: (0, 0),
            waits: None,
            prepared: Arc::default(),
            is_unwanted: false,
        };
        let number = begun.number;
        state.restores.insert(drive.clone(), begun);
        Ok(number)
    }

    /// Lets the prepared restore with this number start writing; returns the prepared restore.
    ///
    /// # Errors
    /// If the restore is not the last one, or not prepared.
    pub fn carry_out(&self, drive: &Machine, name: &str, number: u64) -> Result<Arc<Prepared>, String> {
        let mut state = self.lock();
        let restore = state.restores.get_mut(drive).filter(|restore| restore.number == number);
        let restore = restore.filter(|restore| restore.stage == RestoreStage::Prepared);
        let restore = restore.ok_or_else(|| format!("that restore of `{name}` is no longer prepared"))?;
        restore.stage = RestoreStage::Working;
        restore.progress = (0, restore.prepared.plan.writes.len());
        Ok(restore.prepared.clone())
    }

    /// Updates the status of the restore of this drive.
    pub fn update_restore(&self, drive: &Machine, change: impl FnOnce(&mut RestoreStatus)) {
        if let Some(restore) = self.lock().restores.get_mut(drive) {
            change(restore);
        }
    }
}
