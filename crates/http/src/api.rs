//! The JSON objects of drives and buses. Fields are added, never renamed or removed.

use std::collections::HashSet;
use std::time::{Duration, Instant, SystemTime};

use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

use drivegate_core::diagnosis::{self, Counted, Verdict};
use drivegate_core::drill::StopProof;
use drivegate_core::history::History;
use drivegate_core::plant::{BusHandle, DriveHandle};
use drivegate_core::process_image::{
    Access, BusImage, Link, Outcome, PollCycle, Reading, public_points, value_or_null,
};
use drivegate_model::drive::why::Cause;
use drivegate_model::drive::{self, ModelPoint, PointIndex, Quality, State};
use drivegate_north::command_json::HoldFields;

/// A point in time on both clocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clock {
    now: Instant,
    wall: SystemTime,
}

impl Clock {
    pub(super) fn new(now: Instant, wall: SystemTime) -> Clock {
        Clock { now, wall }
    }

    fn age(&self, at: Instant) -> Duration {
        self.now.saturating_duration_since(at)
    }

    fn wall(&self, at: Instant) -> Option<Time> {
        self.wall.checked_sub(self.age(at)).map(Time)
    }
}

/// RFC 3339 with milliseconds, UTC.
#[derive(Debug, Serialize)]
struct Time(#[serde(serialize_with = "drivegate_core::event::rfc3339")] SystemTime);

/// A drive with all its points.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Drive<'d> {
    name: &'d str,
    bus: &'d str,
    address: u8,
    unit: u8,
    profile: &'d str,
    /// `false` if the profile is not tested on hardware; otherwise absent.
    #[serde(skip_serializing_if = "Clone::clone")]
    profile_verified: bool,
    access: &'static str,
    /// State of the drive; `null` while it is unknown.
    #[schema(value_type = Option<String>)]
    state: Option<State>,
    #[schema(value_type = String)]
    quality: Quality,
    online: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    since: Option<Time>,
    age_ms: Option<u64>,
    fault_text: String,
    /// Why the drive does not run, in one word each.
    blocked_by: Vec<String>,
    /// The causes with evidence and remedy.
    why: Vec<Cause>,
    /// Why the drive accepts no commands but stops.
    #[serde(skip_serializing_if = "Option::is_none")]
    held: Option<String>,
    /// Time for which an ordinary stop still waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    stop_waits_ms: Option<u64>,
    /// Whether the last orders are being written again because of the drive's own timeout.
    refreshing: bool,
    /// Holder of the drive, where `[authority]` is on.
    #[serde(flatten)]
    #[schema(value_type = HoldFields)]
    hold: Option<HoldFields>,
    /// Stops proven by drills, if `[drill]` is on.
    #[serde(skip_serializing_if = "Option::is_none")]
    stops: Option<Vec<StopProof>>,
    turnaround_ms: Option<f64>,
    transactions: Outcomes,
    /// Number of starts; `null` if the drive does not report whether it runs.
    starts: Option<u64>,
    running_seconds: Option<f64>,
    /// Energy; `null` where the drive does not count it.
    energy_kwh: Option<f64>,
    #[schema(value_type = std::collections::HashMap<String, Point<'d>>)]
    points: Points<'d>,
}

impl<'d> Drive<'d> {
    pub(super) fn new(drive: &'d DriveHandle, history: &History, clock: Clock) -> Drive<'d> {
        let image = &drive.image;
        let spec = &image.spec;
        let reading = drive.reading(clock.now);
        let since = match reading.snapshot.link {
            Link::Untried => None,
            Link::Online(since) | Link::Offline(since) => Some(Time(since)),
        };
        let why = drive.why(&reading);
        let totals = history.totals(&spec.name);
        let tells_running = spec.profile.model_index(ModelPoint::Running).is_some();
        Drive {
            name: &spec.name,
            bus: &spec.bus,
            address: spec.address,
            unit: spec.unit,
            profile: &spec.profile.name,
            profile_verified: spec.profile.verified,
            access: match spec.access {
                Access::Monitor | Access::Listen => "monitor",
                Access::Control => "control",
            },
            state: reading.state(),
            quality: reading.overall(),
            online: reading.snapshot.link.is_online(),
            since,
            age_ms: reading.age().map(millis),
            fault_text: reading.fault_text(),
            blocked_by: why.names(),
            why: why.causes,
            held: image.restore_lock.reason().map(|why| why.to_string()),
            stop_waits_ms: drive.stop_waits(clock.now).map(millis),
            refreshing: image.is_refreshing(),
            hold: drive.hold_view(None, clock.now).map(|(view, _)| view.into()),
            stops: None,
            turnaround_ms: image.turnaround().map(fine_millis),
            transactions: Outcomes::new(|outcome| image.counted(outcome)),
            starts: tells_running.then_some(totals.starts),
            running_seconds: tells_running.then(|| rounded(totals.running_seconds, 1000.0)),
            energy_kwh: totals.energy_kwh,
            points: Points {
                reading,
                clock,
                shown: None,
            },
        }
    }

    /// Adds what drills have proven about the stops of the drive.
    pub(super) fn proven(mut self, stops: Option<Vec<StopProof>>) -> Drive<'d> {
        self.stops = stops;
        self
    }

    /// Shows only these of its points.
    pub(super) fn only(mut self, shown: Option<&'d HashSet<String>>) -> Drive<'d> {
        self.points.shown = shown;
        self
    }
}

/// Number of transactions by their outcome.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Outcomes {
    ok: u64,
    exception: u64,
    timeout: u64,
    corrupt: u64,
}

impl Outcomes {
    fn new(counted: impl Fn(Outcome) -> u64) -> Outcomes {
        Outcomes {
            ok: counted(Outcome::Ok),
            exception: counted(Outcome::Exception),
            timeout: counted(Outcome::Timeout),
            corrupt: counted(Outcome::Corrupt),
        }
    }
}

/// The points of a drive by name, in the order of the model.
#[derive(Debug)]
struct Points<'d> {
    reading: Reading<'d>,
    clock: Clock,
    shown: Option<&'d HashSet<String>>,
}

impl Serialize for Points<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let profile = &self.reading.spec.profile;
        let names = public_points(profile);
        let mut map = serializer.serialize_map(None)?;
        let wanted = |name: &str| self.shown.is_none_or(|shown| shown.contains(name));
        for (index, name) in names.into_iter().filter(|(_, name)| wanted(name)) {
            let Some(point) = profile.points.get(index) else {
                continue;
            };
            map.serialize_entry(name, &self.point(index, point))?;
        }
        map.end()
    }
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Point<'p> {
    value: serde_json::Value,
    /// The text of an enumeration's value.
    #[serde(skip_serializing_if = "Option::is_none")]
    text: Option<&'p str>,
    #[schema(value_type = String)]
    quality: Quality,
    unit: &'p str,
    age_ms: Option<u64>,
    #[schema(value_type = Option<String>)]
    time: Option<Time>,
    /// Whether a newer state contradicts the value.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    contradicted: bool,
}

impl Points<'_> {
    /// A stale value is shown with its quality; a bad point has no value.
    fn point<'p>(&self, index: PointIndex, point: &'p drive::Point) -> Point<'p> {
        let sample = self.reading.sample(index);
        let shown = sample.quality != Quality::Bad;
        let at = sample.at.filter(|_| shown);
        let value = sample.value.filter(|_| shown);
        Point {
            value: value_or_null(value),
            text: value.and_then(|value| point.text_of(value)),
            quality: sample.quality,
            unit: &point.unit,
            age_ms: at.map(|at| millis(self.clock.age(at))),
            time: at.and_then(|at| self.clock.wall(at)),
            contradicted: self.reading.is_contradicted(index),
        }
    }
}

/// A bus with its statistics.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Bus<'b> {
    name: &'b str,
    port: &'b str,
    protocol: &'static str,
    baud: u32,
    format: String,
    state: &'static str,
    tried: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    since: Option<Time>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
    drives: usize,
    online: usize,
    /// `null` until the port was open for a second.
    load_ratio: Option<f64>,
    fast: Cycle,
    slow: Cycle,
    transactions: u64,
    errors: u64,
    outcomes: Outcomes,
    foreign_frames: u64,
    opened: u64,
    reconnects: u64,
    queue_depth: usize,
    /// On a line that another master owns: addresses that answer it and have no entry.
    #[serde(skip_serializing_if = "Option::is_none")]
    unknown_drives: Option<Vec<u8>>,
}

/// Cadence of a poll class.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Cycle {
    /// Configured time of a round, ms.
    aim_ms: f64,
    /// Time of the last round.
    cycle_ms: Option<f64>,
    rounds: u64,
}

impl Cycle {
    fn new(aim: Duration, achieved: PollCycle) -> Cycle {
        Cycle {
            aim_ms: fine_millis(aim),
            cycle_ms: achieved.last.map(fine_millis),
            rounds: achieved.rounds,
        }
    }
}

impl<'b> Bus<'b> {
    pub(super) fn new(handle: &'b BusHandle) -> Bus<'b> {
        let image: &BusImage = &handle.image;
        let spec = &image.spec;
        let health = image.health();
        let format = spec.format.to_string();
        Bus {
            name: &spec.name,
            port: &spec.port,
            protocol: spec.protocol.name(),
            baud: spec.format.baud,
            format: format.split_once(' ').map_or("", |(_, text)| text).to_string(),
            state: if health.up { "up" } else { "down" },
            tried: health.tried,
            since: health.since.map(Time),
            reason: health.reason.filter(|_| !health.up),
            drives: image.drives.len(),
            online: image.online(),
            load_ratio: health.load.map(|load| rounded(load, 10_000.0)),
            fast: Cycle::new(spec.cycle, health.fast),
            slow: Cycle::new(spec.slow_cycle, health.slow),
            transactions: image.transactions_total(),
            errors: image.errors_total(),
            outcomes: Outcomes::new(|outcome| image.drives.iter().map(|d| d.counted(outcome)).sum()),
            foreign_frames: health.foreign,
            opened: health.opened,
            reconnects: health.reconnects,
            unknown_drives: health.unknown,
            queue_depth: handle.queue.lock().len(),
        }
    }
}

/// The diagnosis of the line of a bus.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Diagnosis<'d> {
    bus: &'d str,
    /// `null` before the first five seconds have ended.
    #[schema(value_type = Option<String>)]
    time: Option<Time>,
    verdicts: &'d [Verdict],
    /// Valid replies from addresses that were not polled, in the last minute.
    wrong_address: u32,
    /// Counters of the drives in the last minute.
    drives: &'d [Counted],
}

impl<'d> Diagnosis<'d> {
    pub(super) fn new(bus: &'d str, diagnosis: &'d diagnosis::Diagnosis) -> Diagnosis<'d> {
        Diagnosis {
            bus,
            time: diagnosis.at.map(Time),
            verdicts: &diagnosis.verdicts,
            wrong_address: diagnosis.wrong_address,
            drives: &diagnosis.drives,
        }
    }
}

fn millis(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

/// Milliseconds, rounded to the microsecond.
pub(super) fn fine_millis(time: Duration) -> f64 {
    rounded(time.as_secs_f64() * 1000.0, 1000.0)
}

pub(super) fn rounded(value: f64, parts: f64) -> f64 {
    (value * parts).round() / parts
}
