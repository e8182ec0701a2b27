//! The last hour of a line, minute by minute: load, cycle, and failures by drive. Pure: time is an argument, the
//! figures are the counters of the image.

use std::time::{Duration, Instant, SystemTime};

use super::Clock;
use super::buckets::Buckets;
use super::trend::{Bucket, epoch, number};
use crate::process_image::{BusImage, DriveImage, Outcome};

/// Number of steps that are kept.
pub const STEPS: usize = 60;
/// Length of a step.
pub const STEP: Duration = Duration::from_secs(60);
/// Interval in which the counters are read.
pub const LOOK: Duration = Duration::from_secs(1);

/// Memory of a line, and of each of its drives, bytes.
pub const BYTES: (usize, usize) = (2 * STEPS * size_of::<Bucket>(), STEPS * size_of::<Option<Exchanges>>());

/// Number of transactions in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Exchanges {
    /// Number of all transactions.
    pub all: u32,
    /// Number of transactions without a valid reply.
    pub failed: u32,
}

/// The last hour of a line.
#[derive(Debug)]
pub struct LineHistory {
    epoch: Instant,
    looked: Option<Instant>,
    load: Buckets<Bucket>,
    cycle: Buckets<Bucket>,
    drives: Vec<DriveLine>,
}

#[derive(Debug)]
struct DriveLine {
    steps: Buckets<Option<Exchanges>>,
    /// All and failed transactions up to the end of the previous step.
    before: (u64, u64),
}

/// Least, greatest and last figure of a step.
pub type Figures = (f32, f32, f32);

/// The last hour, oldest step first.
#[derive(Debug, Clone, PartialEq)]
pub struct LastHour {
    /// Start of the first step.
    pub from: SystemTime,
    /// Share of the time that the line was in use, 0..=1.
    pub load: Vec<Option<Figures>>,
    /// Cycle of the fast class, s.
    pub cycle: Vec<Option<Figures>>,
    /// Steps of each drive, in the order of the bus; `None` while the gateway did not run.
    pub drives: Vec<Vec<Option<Exchanges>>>,
}

/// All transactions of a drive so far, and those that failed.
fn exchanges(drive: &DriveImage) -> (u64, u64) {
    let all = Outcome::ALL.iter().map(|outcome| drive.counted(*outcome)).sum();
    (all, drive.counted(Outcome::Timeout) + drive.counted(Outcome::Corrupt))
}

impl LineHistory {
    /// The history of a bus that is about to start.
    pub fn new(bus: &BusImage, clock: Clock) -> LineHistory {
        let drive = |drive| DriveLine {
            steps: Buckets::new(STEPS),
            before: exchanges(drive),
        };
        LineHistory {
            epoch: epoch(clock),
            looked: None,
            load: Buckets::new(STEPS),
            cycle: Buckets::new(STEPS),
            drives: bus.drives.iter().map(|image| drive(image)).collect(),
        }
    }

    /// Reads the counters of the bus when the next step is due.
    pub fn sample_if_due(&mut self, bus: &BusImage, now: Instant) {
        if self
            .looked
            .is_some_and(|looked| now.saturating_duration_since(looked) < LOOK)
        {
            return;
        }
        self.looked = Some(now);
        let step = number(now.saturating_duration_since(self.epoch), STEP);
        let health = bus.health();
        let figures = [
            (&mut self.load, health.load),
            (&mut self.cycle, health.fast.last.map(|cycle| cycle.as_secs_f64())),
        ];
        for (buckets, figure) in figures {
            if let (Some(bucket), Some(figure)) = (buckets.step_mut(step), figure.filter(|_| health.up)) {
                bucket.add(figure as f32);
            }
        }
        for (line, image) in self.drives.iter_mut().zip(&bus.drives) {
            let counted = exchanges(image);
            let since = |now: u64, before: u64| u32::try_from(now.saturating_sub(before)).unwrap_or(u32::MAX);
            if let Some(bucket) = line.steps.step_mut(step) {
                let bucket = bucket.get_or_insert_default();
                bucket.all = bucket.all.saturating_add(since(counted.0, line.before.0));
                bucket.failed = bucket.failed.saturating_add(since(counted.1, line.before.1));
            }
            line.before = counted;
        }
    }

    pub fn last_hour(&self, clock: Clock) -> LastHour {
        let now = number(clock.now.saturating_duration_since(self.epoch), STEP);
        let figures = |bucket: Bucket| (!bucket.is_empty()).then_some((bucket.min, bucket.max, bucket.last));
        // Start of the first step. This time may be before the history began.
        let first = (now + 1) as i64 - STEPS as i64;
        let apart = STEP * u32::try_from(first.unsigned_abs()).unwrap_or(u32::MAX);
        let begin = clock.wall_at(self.epoch);
        let from = if first < 0 {
            begin.checked_sub(apart).unwrap_or(SystemTime::UNIX_EPOCH)
        } else {
            begin + apart
        };
        LastHour {
            from,
            load: hour(&self.load, now, figures),
            cycle: hour(&self.cycle, now, figures),
            drives: self
                .drives
                .iter()
                .map(|drive| hour(&drive.steps, now, |exchanges| exchanges))
                .collect(),
        }
    }
}

/// The steps of the last hour; their number is fixed, so steps before the beginning are unknown.
fn hour<T: Copy + Default, R>(buckets: &Buckets<T>, now: u64, show: impl Fn(T) -> Option<R>) -> Vec<Option<R>> {
    let step = |place: u64| {
        let number = (now + 1 + place).checked_sub(STEPS as u64)?;
        show(buckets.get(number)?)
    };
    (0..STEPS as u64).map(step).collect()
}
