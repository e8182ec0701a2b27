//! What readings go on, one a drive at a time, and what came of the last ones.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::file::ParameterFile;
use super::names::Names;
use super::store::Store;

/// How far the reading of a drive is.
#[derive(Debug, Clone, PartialEq)]
pub struct Status {
    /// Its number: a later reading has a higher one.
    pub number: u64,
    /// Addresses that were asked, and all.
    pub progress: (usize, usize),
    /// Time that it will still take, by what it took so far.
    pub remaining: Option<Duration>,
    /// Why it waits.
    pub waits: Option<String>,
    /// What came of it; nothing while it goes on.
    pub result: Option<Result<Arc<ParameterFile>, String>>,
}

#[derive(Debug, Default)]
struct State {
    numbered: u64,
    readings: BTreeMap<String, Status>,
    /// The last reading of each drive since the gateway started, whether the disk took it or not.
    last: BTreeMap<String, Arc<ParameterFile>>,
    changed: BTreeMap<(String, String), u64>,
    names: BTreeMap<String, Arc<Names>>,
    store: Option<Store>,
}

/// The readings of all drives of the gateway.
#[derive(Debug, Default)]
pub struct Vault(Mutex<State>);

impl Vault {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Where readings are kept from now on (none: nowhere), and the names that go before those of the profiles, by profile.
    pub fn configure(&self, store: Option<Store>, names: BTreeMap<String, Arc<Names>>) {
        let mut state = self.lock();
        (state.store, state.names) = (store, names);
    }

    /// Where readings are kept.
    pub fn store(&self) -> Option<Store> {
        self.lock().store.clone()
    }

    /// Names that go before those of a profile.
    pub fn names(&self, profile: &str) -> Arc<Names> {
        self.lock().names.get(profile).cloned().unwrap_or_default()
    }

    /// Parameters that changed and that the gateway did not write, by bus and drive.
    pub fn changed(&self) -> BTreeMap<(String, String), u64> {
        self.lock().changed.clone()
    }

    /// So many more changed.
    pub fn count_changed(&self, bus: &str, drive: &str, count: u64) {
        *self
            .lock()
            .changed
            .entry((bus.to_string(), drive.to_string()))
            .or_default() += count;
    }

    /// How far the last reading of that drive is, if there was one since the gateway started.
    pub fn status(&self, drive: &str) -> Option<Status> {
        self.lock().readings.get(drive).cloned()
    }

    /// The last reading of that drive that succeeded since the gateway started.
    pub fn last(&self, drive: &str) -> Option<Arc<ParameterFile>> {
        self.lock().last.get(drive).cloned()
    }

    /// Whether a reading goes on.
    pub fn is_reading(&self, drive: &str) -> bool {
        self.lock()
            .readings
            .get(drive)
            .is_some_and(|reading| reading.result.is_none())
    }

    /// A reading of that drive begins.
    ///
    /// # Errors
    /// The number of the one that goes on already.
    pub fn begin(&self, drive: &str) -> Result<u64, u64> {
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
            waits: None,
            result: None,
        };
        state.readings.insert(drive.to_string(), begun);
        Ok(number)
    }

    /// The reading of that drive is over.
    pub fn end(&self, drive: &str, result: Result<ParameterFile, String>) {
        let mut state = self.lock();
        let result = result.map(Arc::new);
        if let Ok(file) = &result {
            state.last.insert(drive.to_string(), file.clone());
        }
        if let Some(reading) = state.readings.get_mut(drive) {
            (reading.waits, reading.remaining) = (None, None);
            reading.result = Some(result);
        }
    }

    /// Something is new of the reading of that drive.
    pub fn update(&self, drive: &str, change: impl FnOnce(&mut Status)) {
        if let Some(reading) = self.lock().readings.get_mut(drive) {
            change(reading);
        }
    }
}
