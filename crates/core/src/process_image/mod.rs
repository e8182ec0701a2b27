//! The process image: the latest state of every drive and bus. One writer per bus, any number of readers.
//!
//! The writer replaces a drive's [`Snapshot`] as a whole after each transaction, so a reader always sees the
//! registers of one poll together: a torn 32-bit value is impossible, and nobody waits for anybody.

mod contradiction;
mod health;
mod hold;
mod snapshot;
mod tape;
mod trace;

pub use health::{BusHealth, Histogram, HistogramSnapshot, Outcome, PollCycle};
pub use hold::Hold;
pub use snapshot::{Cadence, Link, Reading, Snapshot, Unavailable};
pub use tape::{TAPE_BYTES, Tape, Taped, TapedFrame, TapedRead, Taping, Verdict};
pub use trace::{Direction, FrameRecord, Trace};

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use tokio::sync::Notify;

use self::health::TURNAROUNDS;
use crate::codec::{LineFormat, Protocol};
use crate::diagnosis::Diagnosis;
use crate::drive::{ModelPoint, Plan, Point, PollClass, Profile, RawWrites, Value};
use crate::start_guard::{Guard, Interlock};

/// Whether a drive may be commanded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Access {
    /// Every write is refused.
    #[default]
    Monitor,
    /// Writes are passed on.
    Control,
    /// Another master owns the line (`mode = "listen"` of the bus): nothing is ever sent.
    Listen,
}

/// The permitted access to a drive's parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ParamsAccess {
    #[default]
    Read,
    /// They are restored, too.
    Write,
}

/// The action when a drive's lease expires.
#[derive(Debug, Clone, PartialEq)]
pub enum LeaseAction {
    /// Stop the drive.
    Stop,
    /// Only raise the event.
    Hold,
    /// Set the speed reference, percent.
    SpeedReference(f64),
}

/// Lease of a drive, renewed by commands that reach the wire and by accepted heartbeats.
#[derive(Debug, Clone, PartialEq)]
pub struct Supervision {
    /// Time without renewal after which the lease expires.
    pub timeout: Duration,
    /// The action then.
    pub action: LeaseAction,
    /// A drive that runs when the gateway starts gets its lease started: the clock only, nothing is written.
    pub adopt: bool,
}

/// The action for a drive at shutdown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OnShutdown {
    /// Nothing is written.
    #[default]
    Hold,
    /// The stop is written and its acknowledgement awaited.
    Stop,
}

/// A drive as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveSpec {
    /// Name, unique in the gateway.
    pub name: String,
    /// Name of its bus.
    pub bus: String,
    /// Address on the bus, 1..=247.
    pub address: u8,
    /// Modbus TCP unit id, 1..=254.
    pub unit: u8,
    /// Its family.
    pub profile: Arc<Profile>,
    /// Group of drives that are stopped together, and started one after the other.
    pub group: Option<String>,
    /// How often and how soon it may be started.
    pub guard: Option<Guard>,
    /// The interlocks of its starts.
    pub interlocks: Vec<Interlock>,
    /// A drive of its group starts at a distance from the others, so that its own starts count.
    pub staggers: bool,
    /// Whether it may be commanded.
    pub access: Access,
    /// Limits of commands in engineering units, by point name.
    pub limits: BTreeMap<String, RangeInclusive<f64>>,
    /// Lease, if there is one.
    pub supervision: Option<Supervision>,
    /// The action at shutdown.
    pub on_shutdown: OnShutdown,
    /// Time the drive takes to begin its answer, for the prediction.
    pub turnaround: Duration,
    /// Minimum and maximum frequency, Hz, where the drive's own parameters cannot be read.
    pub frequency_range: Option<RangeInclusive<f64>>,
    /// Values besides faults at which a recording is made.
    pub triggers: Vec<PointTrigger>,
    /// The permitted raw writes besides writable points.
    pub raw_writes: RawWrites,
    /// The permitted access to its parameters.
    pub params: ParamsAccess,
}

/// A value that makes a recording when it holds for a time.
#[derive(Debug, Clone, PartialEq)]
pub struct PointTrigger {
    /// Index of the point in the profile.
    pub point: usize,
    pub limit: TriggerLimit,
    /// For how long without interruption.
    pub hold: Duration,
}

/// The side of a limit that triggers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TriggerLimit {
    /// Values above it.
    Above(f64),
    /// Values below it.
    Below(f64),
}

/// A bus as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct BusSpec {
    /// Name, unique in the gateway.
    pub name: String,
    /// Path of the serial port, or `tcp://host:port` or `rfc2217://host:port`.
    pub port: String,
    pub protocol: Protocol,
    /// Baud rate and character format.
    pub format: LineFormat,
    /// Cadence aimed at for process data.
    pub cycle: Duration,
    /// Cadence aimed at for the slow class.
    pub slow_cycle: Duration,
}

/// Which machine a drive is, as far as the configuration says: what a lease, a hold or a journal of it belongs to. The name of
/// a drive, and that of its bus, may come to mean another one.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Machine {
    /// The port of its bus.
    pub port: String,
    /// Its address there.
    pub address: u8,
    /// The name of its profile.
    pub profile: String,
}

impl std::fmt::Display for Machine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Machine { port, address, profile } = self;
        write!(f, "address {address} on {port}, profile `{profile}`")
    }
}

impl BusSpec {
    /// The machine that a drive of this bus is.
    pub fn machine(&self, drive: &DriveSpec) -> Machine {
        Machine {
            port: self.port.clone(),
            address: drive.address,
            profile: drive.profile.name.clone(),
        }
    }
}

#[derive(Debug)]
pub struct DriveImage {
    /// As configured.
    pub spec: DriveSpec,
    /// The requests that read it.
    pub plan: Plan,
    /// Why it accepts only stops, if so.
    pub hold: Arc<Hold>,
    /// Cadence of the slow class, which the staleness of slow points depends on.
    slow_cycle: Duration,
    /// Process data of a line that cannot be faster is not stale before that age, ns; a reload may change it.
    stale_floor: AtomicU64,
    snapshot: ArcSwap<Snapshot>,
    /// Woken by every update.
    listeners: ArcSwap<Vec<Weak<Notify>>>,
    outcomes: [AtomicU64; Outcome::ALL.len()],
    /// Turnaround measured, ns; 0 is none yet.
    turnaround: AtomicU64,
    /// Turnarounds measured.
    turnarounds: Histogram,
    /// The last heartbeat that the bus has not taken note of.
    heartbeat: Mutex<Option<Instant>>,
    supervisions: AtomicU64,
    supervision_failures: AtomicU64,
    unsupervised: AtomicBool,
    /// Values of parameters that the gateway wrote since they were read last, and when, by address.
    written: Mutex<BTreeMap<u16, (u16, Instant)>>,
}

impl DriveImage {
    /// An empty image.
    pub fn new(spec: DriveSpec, slow_cycle: Duration) -> DriveImage {
        let plan = Plan::of(&spec.profile);
        let snapshot = ArcSwap::from_pointee(Snapshot::empty(&plan));
        let outcomes = Default::default();
        DriveImage {
            spec,
            plan,
            hold: Arc::default(),
            slow_cycle,
            stale_floor: AtomicU64::new(0),
            snapshot,
            listeners: ArcSwap::default(),
            outcomes,
            turnaround: AtomicU64::new(0),
            turnarounds: Histogram::of(&TURNAROUNDS),
            heartbeat: Mutex::default(),
            supervisions: AtomicU64::new(0),
            supervision_failures: AtomicU64::new(0),
            unsupervised: AtomicBool::new(false),
            written: Mutex::default(),
        }
    }

    /// The same with the hold of an earlier image of the drive.
    #[must_use]
    pub fn with_hold(self, hold: Arc<Hold>) -> DriveImage {
        DriveImage { hold, ..self }
    }

    /// The drive took these values of holding registers: where they are parameters they did not change by themselves.
    pub fn note_written(&self, items: &[(u16, u16)], now: Instant) {
        let parameters = &self.spec.profile.parameters;
        let is_parameter = |address: u16| parameters.id(address).is_some();
        let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        let parameters = items.iter().filter(|(address, _)| is_parameter(*address));
        written.extend(parameters.map(|(address, value)| (*address, (*value, now))));
    }

    /// The image of the same drive before a reload: what was written since the parameters were read last is not forgotten.
    pub(crate) fn take_over(&self, before: &DriveImage) {
        let before = before.written.lock().unwrap_or_else(PoisonError::into_inner).clone();
        *self.written.lock().unwrap_or_else(PoisonError::into_inner) = before;
    }

    /// The value that the gateway wrote to that parameter since the parameters were read last, and when.
    pub fn written(&self, address: u16) -> Option<(u16, Instant)> {
        let written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        written.get(&address).copied()
    }

    /// The parameters were read, from `begun` on: what was written before that is in what was read.
    pub fn forget_written(&self, begun: Instant) {
        let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        written.retain(|_, (_, at)| *at >= begun);
    }

    /// Process data is not stale before that age: the line cannot renew it faster.
    pub fn with_stale_floor(self, stale_floor: Duration) -> DriveImage {
        self.set_stale_floor(stale_floor);
        self
    }

    /// As [`DriveImage::with_stale_floor`], for a drive that is read already.
    pub fn set_stale_floor(&self, stale_floor: Duration) {
        let nanos = u64::try_from(stale_floor.as_nanos()).unwrap_or(u64::MAX);
        self.stale_floor.store(nanos, Ordering::Relaxed);
    }

    /// The present snapshot; it does not change while the caller holds it.
    pub fn snapshot(&self) -> Arc<Snapshot> {
        self.snapshot.load_full()
    }

    /// Changes the image as one step. Only the bus that owns the drive may call this.
    pub fn update(&self, change: impl FnOnce(&mut Snapshot)) {
        let mut next = Snapshot::clone(&self.snapshot.load());
        change(&mut next);
        self.snapshot.store(Arc::new(next));
        for listener in self.listeners.load().iter().filter_map(Weak::upgrade) {
            listener.notify_one();
        }
    }

    /// Whether the image was updated since `seen` was taken.
    pub fn is_newer_than(&self, seen: &Arc<Snapshot>) -> bool {
        !Arc::ptr_eq(&self.snapshot.load(), seen)
    }

    /// Wakes `listener` at every update from now on, as long as it exists.
    pub fn notify(&self, listener: &Arc<Notify>) {
        let listener = Arc::downgrade(listener);
        self.listeners.rcu(|listeners| {
            let others = listeners
                .iter()
                .filter(|other| other.strong_count() > 0 && !other.ptr_eq(&listener));
            others.chain([&listener]).cloned().collect::<Vec<_>>()
        });
    }

    /// How a reader at `now` looks at the drive.
    pub fn reading(&self, now: Instant, stale_after: Duration) -> Reading<'_> {
        let snapshot = self.snapshot();
        Reading {
            spec: &self.spec,
            hold: Some(&self.hold),
            snapshot,
            now,
            stale_after: stale_after.max(Duration::from_nanos(self.stale_floor.load(Ordering::Relaxed))),
            slow_cycle: self.slow_cycle,
        }
    }

    /// Counts one transaction.
    pub fn count(&self, outcome: Outcome) {
        if let Some(counter) = self.outcomes.get(outcome as usize) {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Transactions of that outcome so far.
    pub fn counted(&self, outcome: Outcome) -> u64 {
        self.outcomes
            .get(outcome as usize)
            .map_or(0, |c| c.load(Ordering::Relaxed))
    }

    /// Notes a time from the end of a request to the beginning of its answer; single late wake-ups are smoothed out.
    pub fn set_turnaround(&self, time: Duration) {
        self.turnarounds.observe(time);
        let last = self.turnaround.load(Ordering::Relaxed);
        let time = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).max(1);
        let smooth = if last == 0 { time } else { last - last / 8 + time / 8 };
        self.turnaround.store(smooth.max(1), Ordering::Relaxed);
    }

    /// The turnaround measured, a mean over some eight answers.
    pub fn turnaround(&self) -> Option<Duration> {
        match self.turnaround.load(Ordering::Relaxed) {
            0 => None,
            nanos => Some(Duration::from_nanos(nanos)),
        }
    }

    /// Turnarounds so far.
    pub fn turnarounds(&self) -> HistogramSnapshot {
        self.turnarounds.snapshot()
    }

    /// A commanding client sent its heartbeat: the lease runs again.
    pub fn renew_lease(&self, now: Instant) {
        if self.spec.supervision.is_some() {
            *self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner) = Some(now);
        }
    }

    /// The last heartbeat since the last call. Only the bus itself may call this.
    pub fn take_heartbeat(&self) -> Option<Instant> {
        self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Whether a heartbeat arrived since the bus processed the last one.
    pub fn has_heartbeat(&self) -> bool {
        self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// Notes whether the drive runs without a lease, since no client is known to have commanded it.
    pub fn set_unsupervised(&self, unsupervised: bool) {
        self.unsupervised.store(unsupervised, Ordering::Relaxed);
    }

    /// Whether the drive has supervision, but runs without a lease: no client is known to have commanded it.
    pub fn is_unsupervised(&self) -> bool {
        self.unsupervised.load(Ordering::Relaxed)
    }

    /// Counts a try of the action of a lease, or of the stop of a shutdown, that failed.
    pub fn count_supervision_failure(&self) {
        self.supervision_failures.fetch_add(1, Ordering::Relaxed);
    }

    /// Tries that failed so far.
    pub fn supervision_failures(&self) -> u64 {
        self.supervision_failures.load(Ordering::Relaxed)
    }

    /// Counts a lease that expired while the drive ran, or had its run command.
    pub fn count_supervision(&self) {
        self.supervisions.fetch_add(1, Ordering::Relaxed);
    }

    /// Leases that expired so, so far.
    pub fn supervisions(&self) -> u64 {
        self.supervisions.load(Ordering::Relaxed)
    }
}

/// The image of one bus and its drives.
#[derive(Debug)]
pub struct BusImage {
    /// As configured.
    pub spec: BusSpec,
    /// Its drives, in the order of the file.
    pub drives: Vec<Arc<DriveImage>>,
    /// Time of whole transactions, s.
    pub transactions: Histogram,
    /// Achieved cycle of the fast class, s.
    pub fast_cycles: Histogram,
    /// Achieved cycle of the slow class, s.
    pub slow_cycles: Histogram,
    /// The frames on the line, for anyone who listens.
    pub trace: Trace,
    /// Readings and frames, for recorder, trends and counters.
    pub tape: Tape,
    /// The diagnosis of the line. Only the bus itself may store one.
    pub diagnosis: ArcSwap<Diagnosis>,
    health: Mutex<BusHealth>,
}

impl BusImage {
    /// An image of a bus that is not open yet.
    pub fn new(spec: BusSpec, drives: Vec<Arc<DriveImage>>) -> BusImage {
        BusImage {
            spec,
            drives,
            transactions: Histogram::new(),
            fast_cycles: Histogram::new(),
            slow_cycles: Histogram::new(),
            trace: Trace::default(),
            tape: Tape::default(),
            diagnosis: ArcSwap::default(),
            health: Mutex::new(BusHealth::default()),
        }
    }

    /// State and figures of the bus.
    pub fn health(&self) -> BusHealth {
        self.health.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Whether its port is open.
    pub fn is_up(&self) -> bool {
        self.health.lock().unwrap_or_else(PoisonError::into_inner).up
    }

    /// Whether it was tried to open its port, as a reload starts the bus again.
    pub fn is_tried(&self) -> bool {
        self.health.lock().unwrap_or_else(PoisonError::into_inner).tried
    }

    /// Changes state and figures. Only the bus itself may call this.
    pub fn update_health(&self, change: impl FnOnce(&mut BusHealth)) {
        change(&mut self.health.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Transactions of all drives so far.
    pub fn transactions_total(&self) -> u64 {
        Outcome::ALL.iter().map(|&o| self.counted(o)).sum()
    }

    /// Transactions that failed: no or no sound answer.
    pub fn errors_total(&self) -> u64 {
        self.counted(Outcome::Timeout) + self.counted(Outcome::Corrupt)
    }

    /// Drives that answer.
    pub fn online(&self) -> usize {
        self.drives.iter().filter(|d| d.snapshot().link.is_online()).count()
    }

    fn counted(&self, outcome: Outcome) -> u64 {
        self.drives.iter().map(|d| d.counted(outcome)).sum()
    }
}

impl DriveSpec {
    /// A drive with nothing configured but where it is and what it is: only monitored, its unit is its address.
    pub fn new(name: &str, bus: &str, address: u8, profile: Arc<Profile>) -> DriveSpec {
        DriveSpec {
            name: name.to_string(),
            bus: bus.to_string(),
            address,
            unit: address,
            turnaround: profile.turnaround,
            profile,
            group: None,
            guard: None,
            interlocks: Vec::new(),
            staggers: false,
            access: Access::Monitor,
            limits: BTreeMap::new(),
            supervision: None,
            on_shutdown: OnShutdown::Hold,
            frequency_range: None,
            triggers: Vec::new(),
            raw_writes: RawWrites::Points,
            params: ParamsAccess::Read,
        }
    }

    /// Whether its starts count: for itself or for others.
    pub fn is_guarded(&self) -> bool {
        self.guard.is_some() || self.staggers || !self.interlocks.is_empty()
    }

    /// The drives with which it shares `stagger`, as text: those of its group, else those of its bus.
    pub fn starts_with(&self) -> Arc<str> {
        match &self.group {
            Some(group) => format!("group `{group}`").into(),
            None => format!("bus `{}`", self.bus).into(),
        }
    }

    /// Limits of a command to that point: the configured ones, else the profile's.
    pub fn limits_of(&self, point: usize) -> Option<RangeInclusive<f64>> {
        let point = self.profile.points.get(point)?;
        self.limits.get(&point.name).cloned().or_else(|| point.range.clone())
    }
}

/// Serves as the public shape of a drive in JSON: name to value, `null` where nothing good is known.
pub fn value_or_null(value: Option<Value>) -> serde_json::Value {
    value.map_or(serde_json::Value::Null, |v| match v {
        Value::Bool(b) => b.into(),
        Value::Integer(i) => i.into(),
        Value::Number(n) => n.into(),
        Value::Unsigned(u) => u.into(),
        Value::Text(text) => text.shown().into(),
    })
}

/// The model points and profile points of a drive with their names, in their public order; not those that are never
/// read, of which there is nothing to show, nor hidden ones.
pub fn public_points(profile: &Profile) -> Vec<(usize, &str)> {
    let is_read = |point: &Point| !point.hidden && (point.raw().is_none() || point.class != PollClass::Never);
    let model = ModelPoint::ALL
        .iter()
        .filter_map(|m| profile.model_index(*m).map(|i| (i, m.name())));
    let own = profile
        .points
        .iter()
        .enumerate()
        .filter(|(_, p)| p.model.is_none())
        .map(|(i, p)| (i, p.name.as_str()));
    let all = model.chain(own);
    all.filter(|(i, _)| profile.points.get(*i).is_some_and(is_read))
        .collect()
}
