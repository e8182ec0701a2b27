//! Waits that are exact to some ten microseconds, for the line, the simulated line and the measuring rod.

use rustix::event::{PollFd, Timespec, poll};
use rustix::io::Errno;
use std::io;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};

/// Asks the kernel to wake this thread at the time it named: by default it may be 50 microseconds late, to save power.
/// Where that is refused, waits are later and nothing else changes.
pub fn sharpen_timers() {
    if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!("timer slack stays as it is: {error}");
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
