//! Waits that are exact to some ten microseconds, for the line, the simulated line and the measuring rod.

use rustix::event::{PollFd, Timespec, poll};
use rustix::io::Errno;
use std::io;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};

/// Precedence of a thread that serves a line, on the scale of `nice`.
const PRECEDENCE: i32 = -10;

/// Asks the kernel to wake this thread at the time it named: by default it may be 50 microseconds late, to save power.
/// And to let it go before others that want the processor, which the kernel allows to root, with CAP_SYS_NICE and within
/// RLIMIT_NICE: a thread of a line needs little time, but needs it at once. Where either is refused, waits are later and
/// nothing else changes.
pub fn sharpen_timers() {
    if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!("timer slack stays as it is: {error}");
    }
    // Linux takes "this process" for the calling thread alone.
    if let Err(error) = rustix::process::setpriority_process(None, PRECEDENCE) {
        tracing::debug!("no precedence over other threads: {error}");
    }
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

/// Waits until `at`: sleeps, and watches the clock for the last `spin` of it.
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

/// How late the kernel wakes a thread, and so how much earlier it has to be asked to: some microseconds on bare metal,
/// 50 to 80 on a virtual machine. What is left of the wait is spun.
#[derive(Debug, Clone, Copy)]
pub(super) struct WakeUps {
    mean: Duration,
    deviation: Duration,
}

/// No processor spins for longer than that, ...
const MOST_SPIN: Duration = Duration::from_micros(120);
/// ... and a wake-up that is this late met a busy processor: spinning more would make it busier.
const BUSY: Duration = Duration::from_micros(250);

impl WakeUps {
    /// As on a virtual machine, until some were seen.
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
