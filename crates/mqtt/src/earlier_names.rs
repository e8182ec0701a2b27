//! What the names of buses and groups meant before reloads: a stop of several drives belongs to the machines that its name
//! meant when its first byte arrived. Time is an argument.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use drivegate_core::plant::Plant;
use drivegate_core::stop_all::NamedDrives;

/// Reloads of which the meanings before are kept. A message is minutes old at most: a connection without a complete
/// packet is given up.
const MOST: usize = 8;

/// The meanings before the last reloads, oldest first, each with the time of its end.
#[derive(Debug, Default)]
pub(super) struct EarlierNames(Mutex<VecDeque<(Instant, NamedDrives)>>);

impl EarlierNames {
    fn lock(&self) -> MutexGuard<'_, VecDeque<(Instant, NamedDrives)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that another plant replaces this one at `now`.
    pub(super) fn ended(&self, plant: &Plant, now: Instant) {
        let named = NamedDrives::of(plant);
        let mut earlier = self.lock();
        if earlier.len() >= MOST {
            earlier.pop_front();
        }
        earlier.push_back((now, named));
    }

    /// The meanings at `asked`; `None` if no reload has changed them since.
    pub(super) fn at(&self, asked: Instant) -> Option<NamedDrives> {
        let earlier = self.lock();
        let (_, named) = earlier.iter().find(|(until, _)| asked < *until)?;
        Some(named.clone())
    }
}
