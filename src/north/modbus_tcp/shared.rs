//! What connections share, and what each knows beforehand: who the client is, which drive a unit id means.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::Options;
use crate::north::NorthStats;
use crate::plant::{DriveHandle, Plant, SharedPlant};

/// What all connections share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) options: Options,
    pub(super) plant: SharedPlant,
    pub(super) stats: Arc<NorthStats>,
    /// The word last written at 0x8100, by drive name: a fault reset is a change of its bit 2.
    command_words: Mutex<HashMap<String, u16>>,
}

impl Shared {
    pub(super) fn new(options: Options, plant: SharedPlant, stats: Arc<NorthStats>) -> Shared {
        Shared {
            options,
            plant,
            stats,
            command_words: Mutex::default(),
        }
    }

    /// Does something with the word of a drive that nobody else may change in between.
    pub(super) fn with_command_word<T>(&self, drive: &str, act: impl FnOnce(&mut u16) -> T) -> T {
        let mut words = self.command_words.lock().unwrap_or_else(PoisonError::into_inner);
        let mut word = words.get(drive).copied().unwrap_or_default();
        let result = act(&mut word);
        words.insert(drive.to_string(), word);
        result
    }
}

/// What a client may do, and its name in the audit.
#[derive(Debug, Clone)]
pub(super) struct Authority {
    /// Whether it may write at all.
    pub(super) may_write: bool,
    /// Its address, or later the name in its certificate.
    pub(super) who: String,
}

/// The drives by unit id, as the plant has them now.
#[derive(Debug)]
pub(super) struct Routes {
    pub(super) plant: Arc<Plant>,
    drives: Vec<DriveHandle>,
    /// Place in `drives`.
    units: Vec<Option<u16>>,
}

impl Routes {
    pub(super) fn new(plant: Arc<Plant>) -> Routes {
        let drives: Vec<DriveHandle> = plant.drives().collect();
        let mut units = vec![None; usize::from(u8::MAX) + 1];
        for (place, drive) in (0u16..).zip(&drives) {
            if let Some(unit) = units.get_mut(usize::from(drive.image.spec.unit)) {
                unit.get_or_insert(place);
            }
        }
        Routes { plant, drives, units }
    }

    pub(super) fn drive(&self, unit: u8) -> Option<&DriveHandle> {
        let place = self.units.get(usize::from(unit)).copied().flatten()?;
        self.drives.get(usize::from(place))
    }
}
