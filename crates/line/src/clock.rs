//! Waits that are exact to some ten microseconds, for the line, the simulated line and the measuring rod.

use rustix::event::{PollFd, Timespec, poll};
use rustix::io::Errno;
use std::io;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};
use thread_priority::unix::{
    NormalThreadSchedulePolicy, RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// Real-time priority (1 to 99) of a thread that serves a line. Interrupt threads of the kernel have priority 50.
const REAL_TIME: u8 = 10;
/// Priority on the scale of `nice`, where real time is not allowed.
const NICE: i32 = -10;

/// Time since the machine was started, including time during which it was suspended and the clock of [`Instant`]
/// stood still.
pub fn since_boot() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    // The time since boot is never negative.
    let (seconds, nanoseconds) = (u64::try_from(time.tv_sec), u32::try_from(time.tv_nsec));
    Duration::new(seconds.unwrap_or_default(), nanoseconds.unwrap_or_default())
}

/// Requests exact wake-ups for this thread: by default the kernel may be 50 microseconds late to save power. The
/// thread also gets priority over ordinary threads, since a line needs little processor time, but needs it at once:
/// real-time priority, which the kernel allows to root, with CAP_SYS_NICE and within RLIMIT_RTPRIO; otherwise
/// `nice` (RLIMIT_NICE). Among ordinary threads, even the first may wait for the next tick, 4 ms later, while the
/// machine is busy. If everything is refused, wake-ups are later and nothing else changes.
pub fn sharpen_timers() {
    if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!(target: "drivegate::line::clock", "timer slack stays as it is: {error}");
    }
    let Err(refused) = real_time() else {
        return;
    };
    // Linux applies "this process" to the calling thread only.
    match rustix::process::setpriority_process(None, NICE) {
        Ok(()) => tracing::debug!(target: "drivegate::line::clock", "no real-time scheduling, but nice {NICE}: \
                                                                     {refused}"),
        Err(error) => {
            tracing::debug!(target: "drivegate::line::clock", "no priority over other threads: no real-time \
                                                               scheduling: {refused}; no nice: {error}")
        }
    }
}

fn real_time() -> Result<(), String> {
    let priority = ThreadPriorityValue::try_from(REAL_TIME)?;
    // Round robin: the threads of two lines do not wait for each other longer than a slice.
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::RoundRobin);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), policy)
        .map_err(|error| error.to_string())
}

/// Resets the priority that a thread inherited from the line thread that started it.
pub(super) fn be_ordinary() {
    if let Err(error) = ordinary() {
        tracing::debug!(target: "drivegate::line::clock", "a thread keeps the priority of its line: {error}");
    }
}

fn ordinary() -> Result<(), String> {
    // Just below the usual precedence, so that no privilege is needed.
    let priority = ThreadPriorityValue::try_from(45)?;
    let policy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Other);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(priority), policy)
        .map_err(|error| error.to_string())
}

/// Waits until one of `fds` is ready or it is `until`; whether one is ready. A signal ends the wait early.
///
/// # Errors
/// When the system refuses to wait, which only a closed descriptor can cause.
pub fn poll_until(fds: &mut [PollFd<'_>], until: Instant) -> io::Result<bool> {
    let left = until.saturating_duration_since(Instant::now());
    let timeout = Timespec::try_from(left).map_err(|_| io::ErrorKind::InvalidInput)?;
    match poll(fds, Some(&timeout)) {
        Ok(ready) => Ok(ready > 0),
        Err(Errno::INTR) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Waits until `at`: sleeps, and spins on the clock for the last `spin`.
pub fn wait_until(at: Instant, spin: Duration) {
    let asleep = at.checked_sub(spin).unwrap_or(at);
    while Instant::now() < asleep {
        if poll_until(&mut [], asleep).is_err() {
            break;
        }
    }
    while Instant::now() < at {
        std::hint::spin_loop();
    }
}

/// How late the kernel wakes a thread, and therefore how much earlier the wake-up is requested: a few microseconds
/// on bare metal, 50 to 80 on a virtual machine. The thread spins for the rest of the wait.
#[derive(Debug, Clone, Copy)]
pub(super) struct WakeUps {
    mean: Duration,
    deviation: Duration,
}

/// Longest time for which a processor spins, ...
const MOST_SPIN: Duration = Duration::from_micros(120);
/// A wake-up later than this met a busy processor: longer spinning would make it even busier.
const BUSY: Duration = Duration::from_micros(250);

impl WakeUps {
    /// Initial values as on a virtual machine, until real wake-ups were measured.
    pub(super) const fn new() -> WakeUps {
        WakeUps {
            mean: Duration::from_micros(50),
            deviation: Duration::from_micros(5),
        }
    }

    /// A sleeping thread was woken that late.
    pub(super) fn note(&mut self, late: Duration) {
        if late >= BUSY {
            return;
        }
        self.deviation = (self.deviation * 15 + late.abs_diff(self.mean)) / 16;
        self.mean = (self.mean * 15 + late) / 16;
    }

    /// Time before the end of a wait at which the thread is to be woken.
    pub(super) fn spin(&self) -> Duration {
        (self.mean + self.deviation * 2).min(MOST_SPIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether the system lets a thread of this process run in real time, checked with another program.
    fn allowed() -> bool {
        let ask = format!("import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param({REAL_TIME}))");
        let output = std::process::Command::new("python3").args(["-c", &ask]).output();
        output.expect("python3 runs").status.success()
    }

    #[test]
    fn a_thread_of_a_line_takes_real_time_where_it_may_and_nobody_else_does() {
        let policy = || {
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            let fields: Vec<u32> = stat
                .rsplit(')')
                .next()
                .unwrap()
                .split_whitespace()
                .skip(37)
                .take(2)
                .map(|f| f.parse().unwrap())
                .collect();
            (fields[0], fields[1])
        };
        let own = std::thread::spawn(move || {
            sharpen_timers();
            let helper = std::thread::spawn(move || {
                be_ordinary();
                policy()
            });
            assert_eq!(helper.join().unwrap(), (0, 0), "nor who works for it");
            policy()
        });
        // Fields 40 and 41 of proc_pid_stat(5): priority in real time, policy; 2 is round robin.
        let expected = if allowed() { (u32::from(REAL_TIME), 2) } else { (0, 0) };
        assert_eq!(own.join().unwrap(), expected);
        assert_eq!(policy(), (0, 0), "only the thread that asked");
    }

    #[test]
    fn the_spin_follows_the_wake_ups() {
        let us = Duration::from_micros;
        let mut wake_ups = WakeUps::new();
        assert_eq!(wake_ups.spin(), us(60));
        let noted = |wake_ups: &mut WakeUps, late: [u64; 2]| {
            (0..200).for_each(|turn| wake_ups.note(us(late[turn % 2])));
            wake_ups.spin()
        };
        assert!(noted(&mut wake_ups, [4, 4]) < us(6));
        let jittery = noted(&mut wake_ups, [40, 80]);
        assert!((us(80)..us(110)).contains(&jittery), "{jittery:?}");
        assert_eq!(noted(&mut wake_ups, [240, 200]), MOST_SPIN);
        let before = wake_ups.spin();
        assert_eq!(
            noted(&mut wake_ups, [5000, 300]),
            before,
            "a busy processor teaches nothing"
        );
    }
}
