//! Whether the threads that read sockets run. A task that wakes ten times a second, and at every stop, shows that
//! the threads of a runtime run. Data that a reader finds before the task has run again is counted as well.
//!
//! The workers of a multi-threaded runtime share a watch: a stall of one of them counts as a stall of all, since
//! its tasks may continue on another worker.

use std::cell::{Cell, RefCell};
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::runtime::{Builder, Runtime};
use tokio::time::MissedTickBehavior;

use drivegate_core::event::Events;
use drivegate_core::stalls::{Dated, Stall, Stalls, TICK, UNNOTICED};
use drivegate_line::since_boot;

thread_local! {
    /// The watch of the runtime that this thread works for.
    static WATCH: RefCell<Option<Arc<Watch>>> = const { RefCell::new(None) };
    /// When this worker last ran, in nanoseconds of its watch; 0 while it is idle, or if the thread is not one of
    /// several workers.
    static WORKER_RAN: Cell<u64> = const { Cell::new(0) };
}

/// Maximum number of pauses that wait to be reported; they are reported ten times a second.
const MOST_UNTOLD: usize = 8;

/// Watches whether the threads of a runtime run.
#[derive(Debug)]
pub struct Watch {
    base: Instant,
    /// The time since the machine was started, suspensions included.
    boot: fn() -> Duration,
    /// Whether a single thread does all the work: its reads then show that it runs.
    single: bool,
    /// When the runtime last ran, in nanoseconds after `base`; 0 before the watch has started: until then nothing
    /// counts as a stall.
    ran: AtomicU64,
    /// By how many nanoseconds the boot-time clock was ahead of the monotonic clock at that time.
    boot_ahead: AtomicU64,
    /// Time until which an earlier stall matters.
    matters_until: AtomicU64,
    stalls: Mutex<Stalls>,
    untold: Mutex<Vec<Stall>>,
    events: OnceLock<Events>,
}

impl Watch {
    /// A watch for a runtime with one thread, or with several.
    pub fn new(single: bool) -> Arc<Watch> {
        Watch::by(single, since_boot)
    }

    /// A watch for readers in virtual time, in which the machine is never suspended; see [`Watch::runs`].
    pub fn in_virtual_time() -> Arc<Watch> {
        Watch::by(true, Duration::default)
    }

    fn by(single: bool, boot: fn() -> Duration) -> Arc<Watch> {
        let base = Instant::now();
        Arc::new(Watch {
            base,
            boot,
            single,
            ran: AtomicU64::new(0),
            boot_ahead: AtomicU64::new(0),
            matters_until: AtomicU64::new(0),
            stalls: Mutex::new(Stalls::new(base, Duration::ZERO)),
            untold: Mutex::default(),
            events: OnceLock::new(),
        })
    }

    /// The watch of the runtime to which this thread belongs. If the runtime has no watch, returns a watch that reports
    /// no stalls.
    pub fn of_this_thread() -> Arc<Watch> {
        let own = WATCH.with(|watch| watch.try_borrow().ok().and_then(|watch| watch.clone()));
        own.unwrap_or_else(|| Watch::new(false))
    }

    /// Adds this thread to the threads of the watched runtime.
    pub fn enter(self: &Arc<Watch>) {
        WATCH.with(|watch| {
            if let Ok(mut watch) = watch.try_borrow_mut() {
                *watch = Some(self.clone());
            }
        });
    }

    /// Watches as long as the runtime runs, and reports pauses.
    pub async fn run(self: Arc<Watch>, events: Events) {
        let pauses = events.pauses().clone();
        let beat = pauses.reader(Instant::now());
        // The events of the first call are used, should there be several.
        let _ = self.events.set(events);
        let mut ticks = tokio::time::interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = ticks.tick() => {}
                () = pauses.next_stop() => {}
            }
            let now = Instant::now();
            beat.note_run(now);
            self.runs(now);
            self.publish_pauses();
        }
    }

    /// The thread runs at `now`, in virtual time. To be called ten times a second.
    pub fn runs(&self, now: Instant) {
        self.tick(now, (self.boot)());
    }

    /// The time since the machine was started.
    pub(super) fn since_boot(&self) -> Duration {
        (self.boot)()
    }

    fn tick(&self, now: Instant, boot: Duration) {
        if self.ran.load(Ordering::Relaxed) != 0 {
            self.turn(now, Some(boot));
        }
        self.ran_at(now, boot);
    }

    fn ran_at(&self, now: Instant, boot: Duration) {
        let at = self.nanos(now);
        self.boot_ahead
            .store(in_nanos(boot).saturating_sub(at), Ordering::Relaxed);
        self.ran.store(at, Ordering::Relaxed);
    }

    fn publish_pauses(&self) {
        let untold = std::mem::take(&mut *self.untold.lock().unwrap_or_else(PoisonError::into_inner));
        for pause in untold {
            if let Some(events) = self.events.get() {
                events.publish_pause(pause, SystemTime::now());
            }
        }
    }

    /// The time in ns. Never 0, because 0 means that there is no time.
    fn nanos(&self, at: Instant) -> u64 {
        in_nanos(at.saturating_duration_since(self.base)).max(1)
    }

    fn stalls(&self) -> MutexGuard<'_, Stalls> {
        self.stalls.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that a reader runs at `now`; `boot` is the time since the machine was started, if it matters. Returns
    /// whether a stall, earlier or just now, affects the arrival time of what is read.
    pub(super) fn turn(&self, now: Instant, boot: Option<Duration>) -> bool {
        let (at, ran) = (self.nanos(now), self.ran.load(Ordering::Relaxed));
        if ran == 0 {
            return false;
        }
        let unnoticed = in_nanos(UNNOTICED);
        let worker = WORKER_RAN.get();
        let ahead = self.boot_ahead.load(Ordering::Relaxed);
        let slept = boot.is_some_and(|boot| in_nanos(boot).saturating_sub(at) > ahead.saturating_add(unnoticed));
        let worker_stood = worker != 0 && at.saturating_sub(worker) > unnoticed;
        if worker != 0 {
            WORKER_RAN.set(at.max(worker));
        }
        if slept || worker_stood || at.saturating_sub(ran) > unnoticed {
            let boot = boot.unwrap_or_else(|| self.since_boot());
            self.note_stall((now, boot), ran, worker_stood.then_some(worker));
        } else if self.single {
            self.ran.fetch_max(at, Ordering::Relaxed);
        }
        at <= self.matters_until.load(Ordering::Relaxed)
    }

    /// Notes that the runtime, or one of its workers, did not run since `ran`.
    fn note_stall(&self, (now, boot): (Instant, Duration), ran: u64, worker: Option<u64>) {
        let at = |nanos: u64| self.base + Duration::from_nanos(nanos);
        let mut stalls = self.stalls();
        let ahead = self.boot_ahead.load(Ordering::Relaxed);
        stalls.go_on(at(ran), Duration::from_nanos(ran.saturating_add(ahead)));
        let all = stalls.observe(now, boot);
        let of_worker = worker.map(|since| Stall::new(at(since), now));
        if let Some(stall) = of_worker {
            stalls.note_stall(stall);
        }
        let until = stalls.matters_until().map_or(0, |until| self.nanos(until));
        self.matters_until.store(until, Ordering::Relaxed);
        drop(stalls);
        self.ran_at(now, boot);
        let longest = all.into_iter().chain(of_worker).max_by_key(Stall::length);
        if let Some(pause) = longest.filter(Stall::is_pause) {
            let mut untold = self.untold.lock().unwrap_or_else(PoisonError::into_inner);
            if untold.len() < MOST_UNTOLD {
                untold.push(pause);
            }
        }
    }

    /// The arrival time of bytes read at `now`; see [`Stalls::date`].
    pub(super) fn date(&self, floor: Instant, waited: bool, now: Instant) -> Dated {
        self.stalls().date(floor, waited, now)
    }

    /// Whether a reader that finds nothing now may miss bytes that arrived during a stall just before.
    pub(super) fn just_stalled(&self, now: Instant) -> bool {
        self.stalls().last().is_some_and(|stall| now <= stall.read_by())
    }

    #[cfg(test)]
    pub(super) fn begin_at(&self, now: Instant) {
        self.ran_at(now, since_boot());
    }

    fn worker_runs(&self) {
        WORKER_RAN.set(self.nanos(Instant::now()));
    }
}

fn in_nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

/// A multi-threaded runtime that is watched once [`Watch::run`] runs on it; the calling thread counts as one of its
/// workers.
///
/// # Errors
/// If the system cannot create threads.
pub fn watched_runtime() -> io::Result<Runtime> {
    let watch = Watch::new(false);
    let [start, runs] = [watch.clone(), watch.clone()];
    let runtime = Builder::new_multi_thread()
        .enable_all()
        .on_thread_start(move || start.enter())
        .on_thread_unpark(move || runs.worker_runs())
        .on_thread_park(|| WORKER_RAN.set(0))
        .build()?;
    watch.enter();
    Ok(runtime)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn watching(single: bool) -> (Arc<Watch>, Instant) {
        let watch = Watch::new(single);
        let start = watch.base + MS;
        watch.tick(start, boot(&watch, start));
        (watch, start)
    }

    /// The boot time of a machine that was never suspended.
    fn boot(watch: &Watch, now: Instant) -> Duration {
        Duration::from_secs(5000) + now.duration_since(watch.base)
    }

    fn turn(watch: &Watch, now: Instant) -> bool {
        watch.turn(now, Some(boot(watch, now)))
    }

    #[test]
    fn nothing_is_a_stall_before_it_began() {
        let watch = Watch::new(true);
        assert!(!watch.turn(watch.base + Duration::from_secs(60), None));
    }

    /// The reader detects a stall whether the reader or the watching task runs first after it.
    #[test]
    fn a_reader_knows_of_a_stall_that_has_just_ended() {
        for single in [true, false] {
            for task_first in [true, false] {
                let (watch, start) = watching(single);
                let now = start + 400 * MS;
                if task_first {
                    watch.tick(now, boot(&watch, now));
                }
                assert!(turn(&watch, now + MS));
                let dated = watch.date(start - MS, true, now + MS);
                assert_eq!(dated.earliest, start, "{single}, {task_first}");
                assert!(dated.stall.is_some() && watch.just_stalled(now + MS));
                for later in [100, 200, 251] {
                    let at = now + later * MS;
                    watch.tick(at, boot(&watch, at));
                }
                assert!(!turn(&watch, now + 252 * MS), "it is over");
            }
        }
    }

    #[test]
    fn one_thread_that_reads_runs() {
        let (watch, start) = watching(true);
        for n in 1..50 {
            assert!(!turn(&watch, start + n * 100 * MS));
        }
        let (watch, start) = watching(false);
        let mut turns = (1..50).map(|n| turn(&watch, start + n * 100 * MS));
        assert!(turns.any(|stood| stood), "other workers may stand still");
    }

    #[test]
    fn a_suspended_machine_stood_still() {
        let (watch, start) = watching(true);
        assert!(!turn(&watch, start + MS));
        let now = start + 2 * MS;
        assert!(watch.turn(now, Some(boot(&watch, now) + Duration::from_secs(60))));
        let dated = watch.date(start, true, now);
        assert!(dated.earliest < start && dated.pause.is_some());
    }

    #[test]
    fn a_worker_that_stood_still_is_seen_where_the_others_run() {
        let (watch, start) = watching(false);
        WORKER_RAN.set(watch.nanos(start));
        let now = start + 1200 * MS;
        // Other workers of the runtime ran the watching task.
        for n in 1..12 {
            let at = start + n * 100 * MS;
            watch.ran_at(at, boot(&watch, at));
        }
        assert!(turn(&watch, now));
        let dated = watch.date(start - MS, true, now);
        assert_eq!((dated.earliest, dated.pause.is_some()), (start, true));
        WORKER_RAN.set(0);
        assert!(turn(&watch, now + MS));
    }
}
