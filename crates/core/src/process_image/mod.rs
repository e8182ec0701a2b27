//! The process image: the latest state of every drive and bus. One writer per bus, any number of readers.
//!
//! The writer replaces a drive's [`Snapshot`] as a whole after each transaction, so a reader always sees the registers
//! of one poll together: a torn 32-bit value is impossible, and no reader waits for a writer.

mod contradiction;
mod health;
mod reading;
mod restore_lock;
mod snapshot;
mod standstill;
mod tape;
mod trace;

pub use health::{BusHealth, Histogram, HistogramSnapshot, Outcome, PollCycle};
pub use reading::Reading;
pub use restore_lock::RestoreLock;
pub use snapshot::{Cadence, Link, Snapshot, Unavailable};
pub use standstill::Standstill;
pub use tape::{TAPE_BYTES, Tape, Taped, TapedFrame, TapedRead, Taping, Verdict};
pub use trace::{Direction, FrameRecord, Trace};

pub use crate::spec::{
    Access, BusSpec, DriveSpec, LeaseAction, Machine, OnShutdown, ParamsAccess, PointTrigger, Supervision, Timing,
    TriggerLimit, is_modbus_tcp,
};

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use tokio::sync::Notify;

use self::health::TURNAROUNDS;
use crate::diagnosis::Diagnosis;
use drivegate_model::drive::{ModelPoint, PerDrive, Plan, Point, PointIndex, Profile, Value};

#[derive(Debug)]
pub struct DriveImage {
    /// Configuration of the drive.
    pub spec: DriveSpec,
    /// The planned requests that read the drive.
    pub plan: Plan,
    /// Why the drive accepts only stops; empty if it accepts all commands.
    pub restore_lock: Arc<RestoreLock>,
    /// Cadence of the slow class, which the staleness of slow points depends on.
    slow_cycle: Duration,
    /// Minimum age in ns at which process data becomes stale, for a line that cannot be faster; a reload may change it.
    stale_floor: AtomicU64,
    snapshot: ArcSwap<Snapshot>,
    /// Listeners that every update wakes.
    listeners: ArcSwap<Vec<Weak<Notify>>>,
    outcomes: [AtomicU64; Outcome::ALL.len()],
    /// Turnaround measured, ns; 0 if there is no measurement yet.
    turnaround: AtomicU64,
    /// Histogram of measured turnarounds.
    turnarounds: Histogram,
    /// The last heartbeat that the bus has not taken note of.
    heartbeat: Mutex<Option<Instant>>,
    supervisions: AtomicU64,
    supervision_failures: AtomicU64,
    unsupervised: AtomicBool,
    refreshing: AtomicBool,
    refresh_writes: AtomicU64,
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
            restore_lock: Arc::default(),
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
            refreshing: AtomicBool::new(false),
            refresh_writes: AtomicU64::new(0),
            written: Mutex::default(),
        }
    }

    /// Uses the restore lock of an earlier image of the drive.
    #[must_use]
    pub fn with_restore_lock(self, restore_lock: Arc<RestoreLock>) -> DriveImage {
        DriveImage { restore_lock, ..self }
    }

    /// Notes the values that the drive accepted for holding registers: parameters among them did not change by themselves.
    pub fn note_written(&self, items: &[(u16, u16)], now: Instant) {
        let parameters = &self.spec.profile.parameters;
        let is_parameter = |address: u16| parameters.id(address).is_some();
        let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        let parameters = items.iter().filter(|(address, _)| is_parameter(*address));
        written.extend(parameters.map(|(address, value)| (*address, (*value, now))));
    }

    /// Takes over from the image before a reload which registers were written since the parameters were last read.
    pub(crate) fn take_over(&self, before: &DriveImage) {
        let before = before.written.lock().unwrap_or_else(PoisonError::into_inner).clone();
        *self.written.lock().unwrap_or_else(PoisonError::into_inner) = before;
    }

    /// The value that the gateway wrote to that parameter since the parameters were read last, and when.
    pub fn written(&self, address: u16) -> Option<(u16, Instant)> {
        let written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        written.get(&address).copied()
    }

    /// Notes that the parameters were read, starting at `begun`: the reading contains values written before that.
    pub fn forget_written(&self, begun: Instant) {
        let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        written.retain(|_, (_, at)| *at >= begun);
    }

    /// Process data is not stale before that age: the line cannot renew it faster.
    pub fn with_stale_floor(self, stale_floor: Duration) -> DriveImage {
        self.set_stale_floor(stale_floor);
        self
    }

    /// Sets the minimum age at which data becomes stale for a drive that is already being read; see
    /// [`DriveImage::with_stale_floor`].
    pub fn set_stale_floor(&self, stale_floor: Duration) {
        let nanos = u64::try_from(stale_floor.as_nanos()).unwrap_or(u64::MAX);
        self.stale_floor.store(nanos, Ordering::Relaxed);
    }

    /// The present snapshot; the returned one never changes.
    pub fn snapshot(&self) -> Arc<Snapshot> {
        self.snapshot.load_full()
    }

    /// Changes the image in one step. Only the bus that owns the drive may call this.
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

    /// Wakes `listener` at every update from now on, until it is dropped.
    pub fn notify(&self, listener: &Arc<Notify>) {
        let listener = Arc::downgrade(listener);
        self.listeners.rcu(|listeners| {
            let others = listeners
                .iter()
                .filter(|other| other.strong_count() > 0 && !other.ptr_eq(&listener));
            others.chain([&listener]).cloned().collect::<Vec<_>>()
        });
    }

    /// A view of the drive for a reader at `now`.
    pub fn reading(&self, now: Instant, stale_after: Duration) -> Reading<'_> {
        let stale_after = stale_after.max(Duration::from_nanos(self.stale_floor.load(Ordering::Relaxed)));
        Reading::new(&self.spec, self.snapshot(), now, stale_after, self.slow_cycle)
            .with_restore_lock(&self.restore_lock)
    }

    /// Counts a transaction by its outcome.
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

    /// Takes into account a time from the end of a request to the start of its reply; single late wake-ups are
    /// smoothed out.
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

    /// Histogram of turnarounds so far.
    pub fn turnarounds(&self) -> HistogramSnapshot {
        self.turnarounds.snapshot()
    }

    /// A commanding client sent its heartbeat: the lease runs again.
    pub fn renew_lease(&self, now: Instant) {
        if self.spec.supervision.is_some() {
            *self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner) = Some(now);
        }
    }

    /// The last heartbeat since the previous call. Only the bus itself may call this.
    pub fn take_heartbeat(&self) -> Option<Instant> {
        self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Whether a heartbeat arrived since the bus processed the last one.
    pub fn has_heartbeat(&self) -> bool {
        self.heartbeat.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// Notes whether the drive runs without a lease because no client is known to have commanded it.
    pub fn set_unsupervised(&self, unsupervised: bool) {
        self.unsupervised.store(unsupervised, Ordering::Relaxed);
    }

    /// Whether the drive has supervision but runs without a lease, because no client is known to have commanded it.
    pub fn is_unsupervised(&self) -> bool {
        self.unsupervised.load(Ordering::Relaxed)
    }

    /// Notes whether the last order is being written repeatedly because of the drive's own timeout.
    pub fn set_refreshing(&self, refreshing: bool) {
        self.refreshing.store(refreshing, Ordering::Relaxed);
    }

    /// Whether the last order is being written repeatedly because of the drive's own timeout.
    pub fn is_refreshing(&self) -> bool {
        self.refreshing.load(Ordering::Relaxed)
    }

    /// Counts a write request of a refresh.
    pub fn count_refresh_write(&self) {
        self.refresh_writes.fetch_add(1, Ordering::Relaxed);
    }

    /// Write requests of refreshes so far.
    pub fn refresh_writes(&self) -> u64 {
        self.refresh_writes.load(Ordering::Relaxed)
    }

    /// Counts a try of the action of a lease, or of the stop of a shutdown, that failed.
    pub fn count_supervision_failure(&self) {
        self.supervision_failures.fetch_add(1, Ordering::Relaxed);
    }

    /// Number of failed attempts of supervision so far.
    pub fn supervision_failures(&self) -> u64 {
        self.supervision_failures.load(Ordering::Relaxed)
    }

    /// Counts a lease that expired while the drive ran or had its run command.
    pub fn count_supervision(&self) {
        self.supervisions.fetch_add(1, Ordering::Relaxed);
    }

    /// Number of leases that expired while the drive ran or had its run command.
    pub fn supervisions(&self) -> u64 {
        self.supervisions.load(Ordering::Relaxed)
    }
}

/// The image of one bus and its drives.
#[derive(Debug)]
pub struct BusImage {
    /// Configuration of the bus.
    pub spec: BusSpec,
    /// The drives of the bus, in the order of the file.
    pub drives: PerDrive<Arc<DriveImage>>,
    /// Histogram of transaction times, s.
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
            drives: drives.into(),
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

    /// Whether the port is open.
    pub fn is_up(&self) -> bool {
        self.health.lock().unwrap_or_else(PoisonError::into_inner).up
    }

    /// Whether opening the port was attempted since the bus was last started, as by a reload.
    pub fn is_tried(&self) -> bool {
        self.health.lock().unwrap_or_else(PoisonError::into_inner).tried
    }

    /// Changes state and figures of the bus. Only the bus itself may call this.
    pub fn update_health(&self, change: impl FnOnce(&mut BusHealth)) {
        change(&mut self.health.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Transactions of all drives so far.
    pub fn transactions_total(&self) -> u64 {
        Outcome::ALL.iter().map(|&o| self.counted(o)).sum()
    }

    /// Failed transactions: no reply or an invalid one.
    pub fn errors_total(&self) -> u64 {
        self.counted(Outcome::Timeout) + self.counted(Outcome::Corrupt)
    }

    /// Number of drives that answer.
    pub fn online(&self) -> usize {
        self.drives.iter().filter(|d| d.snapshot().link.is_online()).count()
    }

    fn counted(&self, outcome: Outcome) -> u64 {
        self.drives.iter().map(|d| d.counted(outcome)).sum()
    }
}

/// A point's value in the public JSON of a drive: `null` if no good value is known.
pub fn value_or_null(value: Option<Value>) -> serde_json::Value {
    value.map_or(serde_json::Value::Null, |v| match v {
        Value::Bool(b) => b.into(),
        Value::Integer(i) => i.into(),
        Value::Number(n) => n.into(),
        Value::Unsigned(u) => u.into(),
        Value::Text(text) => text.shown().into(),
    })
}

/// The model points and profile points of a drive with their names, in their public order; without hidden points,
/// and without points that are never read.
pub fn public_points(profile: &Profile) -> Vec<(PointIndex, &str)> {
    let is_read = |point: &Point| !point.hidden && point.is_read();
    let model = ModelPoint::ALL
        .iter()
        .filter_map(|m| profile.model_index(*m).map(|i| (i, m.name())));
    let own = profile
        .points
        .enumerate()
        .filter(|(_, p)| p.model.is_none())
        .map(|(i, p)| (i, p.name.as_str()));
    let all = model.chain(own);
    all.filter(|(i, _)| profile.points.get(*i).is_some_and(is_read))
        .collect()
}
