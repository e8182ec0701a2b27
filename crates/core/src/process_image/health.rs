//! Figures of a bus: state, load, cycles, counters and histograms.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use serde::Serialize;

/// The result of a transaction, as counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The drive answered.
    Ok,
    /// The drive answered with an exception.
    Exception,
    /// No answer arrived within the deadline.
    Timeout,
    /// The reply was invalid.
    Corrupt,
}

impl Outcome {
    pub const ALL: [Outcome; 4] = [Outcome::Ok, Outcome::Exception, Outcome::Timeout, Outcome::Corrupt];

    /// The outcome's label in metrics.
    pub fn name(self) -> &'static str {
        match self {
            Outcome::Ok => "ok",
            Outcome::Exception => "exception",
            Outcome::Timeout => "timeout",
            Outcome::Corrupt => "corrupt",
        }
    }
}

/// The measured cadence of a poll class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PollCycle {
    /// Time from the start of the round before the last one to the start of the last one, once two have started.
    pub last: Option<Duration>,
    /// Number of rounds started.
    pub rounds: u64,
}

/// State and figures of a bus.
#[derive(Debug, Clone, Default)]
pub struct BusHealth {
    /// Whether the port is open.
    pub up: bool,
    /// Whether the port was tried at least once.
    pub tried: bool,
    /// When `up` last changed.
    pub since: Option<SystemTime>,
    /// Why the port is not open, and what the bus does next.
    pub reason: Option<String>,
    /// Share of the last second that the line was in use (frames, turnaround, silence), 0..=1; `None` until the port was
    /// open for a second.
    pub load: Option<f64>,
    /// Rounds of the fast class.
    pub fast: PollCycle,
    /// Rounds of the slow class.
    pub slow: PollCycle,
    /// Number of foreign frames received.
    pub foreign: u64,
    /// How often the port was opened.
    pub opened: u64,
    /// How often a device server closed its connection after it had answered over it, and was connected again at once.
    pub reconnects: u64,
    /// On a line that another master owns: addresses that answer that master and are not configured; `None` if the
    /// gateway is the master.
    pub unknown: Option<Vec<u8>>,
}

/// Upper bounds of the buckets, s: from a frame at 115200 baud to a dead line.
const BOUNDS: [f64; 16] = [
    0.001, 0.002, 0.003, 0.005, 0.0075, 0.010, 0.0125, 0.015, 0.020, 0.030, 0.050, 0.1, 0.25, 0.5, 1.0, 5.0,
];

/// Upper bounds of the turnaround histogram, s.
pub(super) const TURNAROUNDS: [f64; BOUNDS.len()] = [
    0.000_25, 0.0005, 0.001, 0.0015, 0.002, 0.003, 0.004, 0.005, 0.0075, 0.010, 0.015, 0.020, 0.030, 0.050, 0.1, 0.5,
];

/// A histogram of times that any thread may add to.
#[derive(Debug)]
pub struct Histogram {
    bounds: &'static [f64; BOUNDS.len()],
    counts: [AtomicU64; BOUNDS.len() + 1],
    sum_nanos: AtomicU64,
}

/// The figures of a [`Histogram`] at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct HistogramSnapshot {
    /// Upper bound in seconds and own (not cumulated) count of each bucket; the last is unbounded.
    pub buckets: Vec<(f64, u64)>,
    /// Sum of all observed times, s.
    pub sum: f64,
    /// Number of observed times.
    pub count: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Histogram::new()
    }
}

impl Histogram {
    /// An empty histogram of transactions and cycles.
    pub fn new() -> Histogram {
        Histogram::of(&BOUNDS)
    }

    /// An empty histogram with these upper bounds, s.
    pub(super) fn of(bounds: &'static [f64; BOUNDS.len()]) -> Histogram {
        Histogram {
            bounds,
            counts: Default::default(),
            sum_nanos: AtomicU64::new(0),
        }
    }

    /// Adds an observed time.
    pub fn observe(&self, time: Duration) {
        let seconds = time.as_secs_f64();
        let bucket = self.bounds.partition_point(|bound| *bound < seconds);
        if let Some(count) = self.counts.get(bucket) {
            count.fetch_add(1, Ordering::Relaxed);
        }
        self.sum_nanos
            .fetch_add(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    /// The present figures of the histogram.
    pub fn snapshot(&self) -> HistogramSnapshot {
        let bounds = self.bounds.iter().copied().chain([f64::MAX]);
        let buckets: Vec<_> = bounds
            .zip(&self.counts)
            .map(|(b, c)| (b, c.load(Ordering::Relaxed)))
            .collect();
        let count = buckets.iter().map(|(_, c)| c).sum();
        let sum = Duration::from_nanos(self.sum_nanos.load(Ordering::Relaxed)).as_secs_f64();
        HistogramSnapshot { buckets, sum, count }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_fall_into_their_buckets() {
        let histogram = Histogram::new();
        for ms in [1, 1, 10, 60_000] {
            histogram.observe(Duration::from_millis(ms));
        }
        let figures = histogram.snapshot();
        assert_eq!(figures.count, 4);
        assert_eq!(figures.buckets[0], (0.001, 2));
        assert_eq!(figures.buckets[5], (0.010, 1));
        assert_eq!(figures.buckets[16].1, 1);
        assert!((figures.sum - 60.012).abs() < 1e-9);
    }
}
