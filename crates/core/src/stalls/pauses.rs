//! The pauses of the process, each counted once even if several threads notice it; and whether a thread that reads
//! orders is stalled now.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::{Stall, UNNOTICED};

/// The pauses of the process. Clones share the same data.
#[derive(Debug, Clone, Default)]
pub struct Pauses(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    stops: Notify,
}

#[derive(Debug, Default)]
struct State {
    last: Option<Stall>,
    count: u64,
    time: Duration,
    readers: Vec<Weak<Beat>>,
}

/// Shows that a thread which reads orders runs.
#[derive(Debug, Clone)]
pub struct Heartbeat(Arc<Beat>);

#[derive(Debug)]
struct Beat {
    base: Instant,
    /// When the thread last ran, in nanoseconds after `base`.
    ran: AtomicU64,
}

impl Heartbeat {
    /// Notes that the thread runs at `now`.
    pub fn note_run(&self, now: Instant) {
        self.0.ran.store(self.since_base(now), Ordering::Relaxed);
    }

    /// When the thread last ran.
    pub fn last(&self) -> Instant {
        self.0.last()
    }

    fn since_base(&self, now: Instant) -> u64 {
        let since = now.saturating_duration_since(self.0.base).as_nanos();
        u64::try_from(since).unwrap_or(u64::MAX)
    }
}

impl Beat {
    fn last(&self) -> Instant {
        self.base + Duration::from_nanos(self.ran.load(Ordering::Relaxed))
    }
}

impl Pauses {
    fn state(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes an accepted stop. Each thread that reads orders then records that it runs: bytes read after a later
    /// stall arrived after the stop, so that the stop does not remove the order of a healthy client.
    pub fn note_stop(&self) {
        self.0.stops.notify_waiters();
    }

    /// Waits for the next stop that is accepted.
    pub async fn next_stop(&self) {
        self.0.stops.notified().await;
    }

    /// Adds a pause of a thread. Returns whether it is new, that is, does not overlap a pause of another thread.
    pub fn note(&self, pause: Stall) -> bool {
        let mut state = self.state();
        let last = state
            .last
            .filter(|last| pause.began < last.ended && last.began < pause.ended);
        let all = last.map_or(pause, |last| {
            Stall::new(last.began.min(pause.began), last.ended.max(pause.ended))
        });
        state.time += all.length() - last.map_or(Duration::ZERO, |last| last.length());
        state.count += u64::from(last.is_none());
        state.last = Some(all);
        last.is_none()
    }

    /// Number of pauses, and their total length.
    pub fn total(&self) -> (u64, Duration) {
        let state = self.state();
        (state.count, state.time)
    }

    /// The heartbeat of another thread that reads orders, and runs at `now`.
    pub fn reader(&self, now: Instant) -> Heartbeat {
        let beat = Arc::new(Beat {
            base: now,
            ran: AtomicU64::new(0),
        });
        let mut state = self.state();
        state.readers.retain(|beat| beat.strong_count() > 0);
        state.readers.push(Arc::downgrade(&beat));
        Heartbeat(beat)
    }

    /// Whether a thread that reads orders is stalled now: no orders or heartbeats are received over its connections.
    pub fn readers_are_blocked(&self, now: Instant) -> bool {
        let state = self.state();
        let mut readers = state.readers.iter().filter_map(Weak::upgrade);
        readers.any(|beat| now.saturating_duration_since(beat.last()) > UNNOTICED)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_pause_that_several_threads_had_is_one() {
        let (pauses, now) = (Pauses::default(), Instant::now());
        let had = |from, to| pauses.note(Stall::new(now + SECOND * from, now + SECOND * to));
        assert!(had(1, 4));
        assert!(!had(1, 4), "another thread");
        assert!(!had(2, 5), "one that ran later");
        assert_eq!(pauses.total(), (1, 4 * SECOND));
        assert!(had(5, 8));
        assert_eq!(pauses.total(), (2, 7 * SECOND));
    }

    #[test]
    fn a_reader_that_does_not_run_hears_nobody() {
        let (pauses, now) = (Pauses::default(), Instant::now());
        assert!(!pauses.readers_are_blocked(now + SECOND), "there is none");
        let (one, other) = (pauses.reader(now), pauses.reader(now));
        assert!(!pauses.readers_are_blocked(now + UNNOTICED));
        one.note_run(now + SECOND);
        assert_eq!(one.last(), now + SECOND);
        assert!(pauses.readers_are_blocked(now + SECOND), "the other one does not run");
        drop(other);
        assert!(!pauses.readers_are_blocked(now + SECOND), "it has ended");
    }
}
