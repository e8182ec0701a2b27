//! Whether the bus threads move, seen from outside the daemon: the watchdog is served during a reload, too.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The beats of all bus threads that run.
#[derive(Debug, Clone, Default)]
pub struct BusHeartbeats(Arc<Mutex<Vec<Watched>>>);

#[derive(Debug)]
struct Watched {
    bus: String,
    beats: Arc<AtomicU64>,
    /// The counter at the previous check.
    before: Option<u64>,
}

impl BusHeartbeats {
    fn watched(&self) -> MutexGuard<'_, Vec<Watched>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Monitors exactly these buses from now on.
    pub(super) fn watch(&self, buses: impl Iterator<Item = (String, Arc<AtomicU64>)>) {
        let before = None;
        *self.watched() = buses.map(|(bus, beats)| Watched { bus, beats, before }).collect();
    }

    /// Whether every bus thread has run since the last call. If not, the watchdog keep-alive must be withheld.
    pub fn is_moving(&self) -> bool {
        let mut moving = true;
        for watched in self.watched().iter_mut() {
            let beats = watched.beats.load(Ordering::Relaxed);
            if watched.before.replace(beats) == Some(beats) {
                tracing::error!(target: "drivegate::daemon::pulse", bus = %watched.bus, "bus thread stalled; withholding the watchdog keep-alive");
                moving = false;
            }
        }
        moving
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_thread_that_stands_still_is_seen_and_one_that_ended_is_not() {
        let beats: [Arc<AtomicU64>; 2] = Default::default();
        let pulse = BusHeartbeats::default();
        let all = || ["a", "b"].map(str::to_string).into_iter().zip(beats.clone());
        pulse.watch(all());
        assert!(pulse.is_moving());
        beats.iter().for_each(|one| _ = one.fetch_add(1, Ordering::Relaxed));
        assert!(pulse.is_moving());
        beats[0].fetch_add(1, Ordering::Relaxed);
        assert!(!pulse.is_moving());
        beats[0].fetch_add(1, Ordering::Relaxed);
        pulse.watch(all().take(1));
        assert!(pulse.is_moving());
    }
}
