//! Trends in memory: the least, the greatest and the last value of a point in equal steps of time. Pure: time is an argument.
//!
//! Each value enters every range directly, so the buckets of a coarse range hold the extremes of all readings, not
//! of the values that a finer range kept. Times are monotonic; the time of day only serves for labels.

use std::ops::RangeInclusive;
use std::time::{Duration, Instant, SystemTime};

use super::Clock;
use super::buckets::Buckets;
use crate::process_image::{Reading, TapedRead};
use drivegate_model::drive::{ModelPoint, PointIndex, Profile, Source};
use drivegate_proto::Table;

/// A span of time, and the length of the steps for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Range {
    /// Length of time that the range covers.
    pub span: Duration,
    /// Length of a bucket.
    pub step: Duration,
}

impl Range {
    const fn new(span: u64, step: u64) -> Range {
        Range {
            span: Duration::from_secs(span),
            step: Duration::from_secs(step),
        }
    }

    const fn buckets(self) -> usize {
        (self.span.as_secs() / self.step.as_secs()) as usize
    }
}

/// The ranges, finest first.
pub const RANGES: [Range; 3] = [Range::new(600, 1), Range::new(3600, 5), Range::new(24 * 3600, 120)];

/// Points with a trend, as far as a profile has them; see [`points_of`].
const POINTS: [ModelPoint; 11] = [
    ModelPoint::ActualSpeed,
    ModelPoint::OutputFrequency,
    ModelPoint::MotorSpeed,
    ModelPoint::MotorCurrent,
    ModelPoint::MotorTorque,
    ModelPoint::MotorPower,
    ModelPoint::MotorVoltage,
    ModelPoint::DcLinkVoltage,
    ModelPoint::HeatsinkTemperature,
    ModelPoint::SpeedReference,
    ModelPoint::FrequencyReference,
];

/// Memory of the trend of a point that reaches back as far as [`RANGES`], from its first value on, in bytes.
pub const POINT_BYTES: usize = {
    let [fine, middle, coarse] = RANGES;
    (fine.buckets() + middle.buckets() + coarse.buckets()) * size_of::<Bucket>()
};

/// Memory of all trends of the gateway at most, bytes: about 135 drives of ten points with all of [`RANGES`].
pub const MOST_BYTES: usize = 32 << 20;

/// Memory of the trends of a drive that reach back as far as [`RANGES`], bytes.
pub fn bytes_of(profile: &Profile) -> usize {
    points_of(profile).count() * POINT_BYTES
}

/// How far back trends reach, in thousandths of [`RANGES`]: less if all drives together would take more than
/// [`MOST_BYTES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reach(u16);

impl Reach {
    /// The full reach: all of [`RANGES`].
    pub const FULL: Reach = Reach(1000);
    const LEAST: u16 = 10;

    /// The memory for all drives of these profiles.
    pub fn of<'p>(profiles: impl IntoIterator<Item = &'p Profile>) -> Reach {
        let wanted: usize = profiles.into_iter().map(bytes_of).sum();
        let share = MOST_BYTES.saturating_mul(1000) / wanted.max(1);
        Reach(share.try_into().unwrap_or(u16::MAX).clamp(Reach::LEAST, Reach::FULL.0))
    }

    /// The ranges that are kept, in the order of [`RANGES`].
    pub fn ranges(self) -> [Range; RANGES.len()] {
        RANGES.map(|range| {
            let steps = range.buckets() * usize::from(self.0) / usize::from(Reach::FULL.0);
            Range {
                span: range.step * u32::try_from(steps.max(1)).unwrap_or(u32::MAX),
                step: range.step,
            }
        })
    }

    /// Memory of the trend of a point, from its first value on, in bytes.
    pub(crate) fn point_bytes(self) -> usize {
        let buckets: usize = self.ranges().into_iter().map(Range::buckets).sum();
        buckets * size_of::<Bucket>()
    }

    /// Memory of the trends of a drive at most, bytes.
    pub fn bytes_of(self, profile: &Profile) -> usize {
        points_of(profile).count() * self.point_bytes()
    }
}

/// Points of a profile with a trend. Of the references the one in the unit of the speed that is shown: both say the same.
pub fn points_of(profile: &Profile) -> impl Iterator<Item = (ModelPoint, PointIndex)> {
    let has_speed = profile.model_index(ModelPoint::ActualSpeed).is_some();
    let is_kept = move |point: &ModelPoint| match point {
        ModelPoint::SpeedReference => has_speed,
        ModelPoint::FrequencyReference => !has_speed,
        _ => true,
    };
    let index = |point: ModelPoint| Some((point, profile.model_index(point)?));
    POINTS.into_iter().filter(is_kept).filter_map(index)
}

/// The values of a step; empty if the step has no values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bucket {
    pub(super) min: f32,
    pub(super) max: f32,
    pub(super) last: f32,
}

impl Default for Bucket {
    fn default() -> Bucket {
        let [min, max, last] = [f32::NAN; 3];
        Bucket { min, max, last }
    }
}

impl Bucket {
    pub(super) fn add(&mut self, value: f32) {
        // `min` and `max` ignore a value that is NaN.
        self.min = self.min.min(value);
        self.max = self.max.max(value);
        self.last = value;
    }

    pub(super) fn is_empty(self) -> bool {
        self.last.is_nan()
    }
}

/// The values of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Start of the step, ms since 1970.
    pub at: u64,
    /// The smallest value of the step.
    pub min: f32,
    /// The greatest value of the step.
    pub max: f32,
    /// The last value of the step.
    pub last: f32,
}

/// The part of a trend that a client requested.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Name of the point.
    pub point: &'static str,
    pub unit: &'static str,
    /// Length of a step.
    pub step: Duration,
    /// Start of the first step.
    pub from: SystemTime,
    /// End of the last step.
    pub to: SystemTime,
    /// One entry for each step, oldest first; `None` if nothing good was read in it.
    pub steps: Vec<Option<Step>>,
}

/// Registers: a table and the addresses in it.
type Registers = (Table, RangeInclusive<u16>);

#[derive(Debug)]
struct PointTrend {
    point: ModelPoint,
    /// Index of the point in the profile.
    index: PointIndex,
    /// Registers from which the value is read.
    registers: Vec<Registers>,
    /// Whether the point is derived from points that are read elsewhere, too.
    derived: bool,
    /// The trend's values; `None` before the first one.
    kept: Option<KeptValues>,
}

/// The time of a read, calculated once for all points.
#[derive(Debug, Clone, Copy)]
struct StepTime {
    /// Time since the beginning.
    since: Duration,
    /// Number of the step in each range.
    steps: [u64; RANGES.len()],
}

impl StepTime {
    fn new(since: Duration) -> StepTime {
        StepTime {
            since,
            steps: RANGES.map(|range| number(since, range.step)),
        }
    }
}

/// The kept values of a point's trend.
#[derive(Debug)]
struct KeptValues {
    ranges: [Buckets<Bucket>; RANGES.len()],
    /// The last value and when it was read; `None` once the drive went offline.
    last: Option<(Duration, f32)>,
}

#[derive(Debug)]
pub struct DriveTrend {
    /// Time that the numbers of the buckets are counted from.
    epoch: Instant,
    reach: Reach,
    points: Vec<PointTrend>,
}

impl DriveTrend {
    /// The trends of a drive of that profile, empty.
    pub fn new(profile: &Profile, reach: Reach, clock: Clock) -> DriveTrend {
        let trend = |(point, index): (ModelPoint, PointIndex)| PointTrend {
            point,
            index,
            registers: registers_of(profile, index),
            derived: profile.points.get(index).is_some_and(|point| point.raw().is_none()),
            kept: None,
        };
        DriveTrend {
            epoch: epoch(clock),
            reach,
            points: points_of(profile).map(trend).collect(),
        }
    }

    /// Sets how far back the trend reaches; the newest steps stay.
    pub(crate) fn set_reach(&mut self, reach: Reach) {
        if std::mem::replace(&mut self.reach, reach) == reach {
            return;
        }
        for kept in self.points.iter_mut().filter_map(|point| point.kept.as_mut()) {
            for (buckets, range) in kept.ranges.iter_mut().zip(reach.ranges()) {
                buckets.resize(range.buckets());
            }
        }
    }

    /// The ranges that are kept, finest first.
    pub fn ranges(&self) -> [Range; RANGES.len()] {
        self.reach.ranges()
    }

    /// Adds the values of `read`; `reading` has the drive's values right after it. `known` is the reading of the
    /// drive's image: it shows whether a derived point is good, since the points that it depends on may be from
    /// before the drive went offline, and how long a value is good. A value counts for each step until the next
    /// value, as long as it is good.
    pub fn read(&mut self, read: &TapedRead, reading: &Reading<'_>, known: &Reading<'_>) {
        let time = StepTime::new(read.at.saturating_duration_since(self.epoch));
        for point in &mut self.points {
            if !point.registers.iter().any(|registers| shows(read, registers)) {
                continue;
            }
            let sample = reading.sample(point.index);
            // The words of a value may come in several reads; the value is as old as the oldest of its words.
            let Some(value) = sample.good().filter(|_| sample.at == Some(read.at)) else {
                continue;
            };
            let is_known = || !known.snapshot.link.is_online() || known.sample(point.index).good().is_some();
            if point.derived && !is_known() {
                continue;
            }
            let kept = point.kept.get_or_insert_with(|| KeptValues::new(self.reach));
            kept.add(time, value.as_f64() as f32, || known.good_for(point.index));
        }
    }

    /// The drive was offline: no earlier value counts for the time since.
    pub fn interrupt(&mut self) {
        for kept in self.points.iter_mut().filter_map(|point| point.kept.as_mut()) {
            kept.last = None;
        }
    }

    /// The points, and the memory of each in bytes.
    pub fn points(&self) -> impl Iterator<Item = (ModelPoint, usize)> {
        let bytes = |point: &PointTrend| point.kept.as_ref().map_or(0, |_| self.reach.point_bytes());
        self.points.iter().map(move |point| (point.point, bytes(point)))
    }

    /// The trend of a point between two times, in the finest range that reaches back to `from`. Times older than
    /// the longest range, or in the future, are left out. `None` if no trend of the point is kept.
    pub fn part(&self, point: ModelPoint, from: Instant, to: Instant, clock: Clock) -> Option<Part> {
        let trend = self.points.iter().find(|trend| trend.point == point)?;
        let age = clock.now.saturating_duration_since(from);
        let ranges = self.ranges();
        let last = ranges.len() - 1;
        let chosen = ranges.iter().position(|range| age <= range.span).unwrap_or(last);
        let range = ranges.get(chosen)?;
        let number = |at: Instant| number(at.saturating_duration_since(self.epoch), range.step);
        let now = number(clock.now);
        let oldest = (now + 1).saturating_sub(range.buckets() as u64);
        let (first, end) = (number(from).clamp(oldest, now), number(to).clamp(oldest, now));
        // Successive steps have successive times, whatever the clock does meanwhile.
        let at = clock.wall_at(self.epoch) + range.step * u32::try_from(first).unwrap_or(u32::MAX);
        let from = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let from = (from.as_micros() as u64).div_ceil(1000);
        let step = range.step.as_millis() as u64;
        let buckets = trend.kept.as_ref().and_then(|kept| kept.ranges.get(chosen));
        let steps = (first..=end).map(|number| {
            let bucket = buckets?.get(number).filter(|bucket| !bucket.is_empty());
            let Bucket { min, max, last } = bucket?;
            let at = from + (number - first) * step;
            Some(Step { at, min, max, last })
        });
        let wall = |millis: u64| SystemTime::UNIX_EPOCH + Duration::from_millis(millis);
        Some(Part {
            point: point.name(),
            unit: point.unit(),
            step: range.step,
            from: wall(from),
            to: wall(from + (end + 1).saturating_sub(first) * step),
            steps: steps.collect(),
        })
    }
}

impl KeptValues {
    fn new(reach: Reach) -> KeptValues {
        KeptValues {
            ranges: reach.ranges().map(|range| Buckets::new(range.buckets())),
            last: None,
        }
    }

    /// Adds a value that was read at `time`. The previous value was good for `good_for`; this only matters if there are
    /// steps between the two values.
    fn add(&mut self, time: StepTime, value: f32, good_for: impl Fn() -> Duration) {
        let StepTime { since, steps } = time;
        let ([finest, ..], [newest, ..]) = (RANGES, steps);
        let before = self
            .last
            .filter(|(at, _)| number(*at, finest.step) + 1 < newest)
            .filter(|(at, _)| since.saturating_sub(*at) <= good_for());
        for ((buckets, range), number) in self.ranges.iter_mut().zip(RANGES).zip(steps) {
            let between = before.map(|(at, before)| (self::number(at, range.step), before));
            if let Some((at, before)) = between.filter(|(at, _)| at + 1 < number) {
                let first = at.max(number.saturating_sub(buckets.steps() as u64)) + 1;
                for between in first..number {
                    if let Some(bucket) = buckets.step_mut(between) {
                        bucket.add(before);
                    }
                }
            }
            if let Some(bucket) = buckets.step_mut(number) {
                bucket.add(value);
            }
        }
        self.last = Some((since, value));
    }
}

/// Number of the bucket that a time since the beginning falls into.
pub(super) fn number(since: Duration, step: Duration) -> u64 {
    since.as_secs() / step.as_secs().max(1)
}

/// A recent time at which the steps of all ranges begin at whole steps of the time of day, at most one step of the
/// longest range ago.
pub(super) fn epoch(clock: Clock) -> Instant {
    let [.., Range { step, .. }] = RANGES;
    let since = clock.wall.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let into = Duration::from_nanos((since.as_nanos() % step.as_nanos().max(1)) as u64);
    // Shortly after the machine has booted there may be no such instant.
    clock.now.checked_sub(into).unwrap_or(clock.now)
}

fn shows(read: &TapedRead, (table, addresses): &Registers) -> bool {
    let end = usize::from(read.start) + read.words.len();
    let overlap = *addresses.end() >= read.start && usize::from(*addresses.start()) < end;
    read.table == *table && overlap
}

/// The registers that the value of a point is read from, without those of the ends of its band.
fn registers_of(profile: &Profile, index: PointIndex) -> Vec<Registers> {
    let Some(point) = profile.points.get(index) else {
        return Vec::new();
    };
    match &point.source {
        Source::Raw(raw) => {
            let last = raw.address.saturating_add(raw.form.items().saturating_sub(1));
            let monitor = point
                .monitor
                .into_iter()
                .flat_map(|monitor| registers_of(profile, monitor));
            std::iter::once((raw.table, raw.address..=last))
                .chain(monitor)
                .collect()
        }
        // A point depends only on earlier points: the profile is refused otherwise.
        Source::Derived(derived) => {
            let sources = derived.sources().filter(|source| *source != index);
            sources.flat_map(|source| registers_of(profile, source)).collect()
        }
    }
}

#[cfg(test)]
mod tests;
