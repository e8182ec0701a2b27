//! How long a start and a reload wait for the disk.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

/// Longest wait for the disk.
pub const DISK: Duration = Duration::from_secs(2);
/// Longest wait for a file while another one is overdue.
const NEXT: Duration = Duration::from_millis(100);

/// The wait for files that are read at a start or a reload. A disk that hangs is waited for once, not once for each file.
#[derive(Debug, Clone, Default)]
pub struct Patience {
    /// Number of waits that were given up and whose work is still running.
    overdue: Arc<AtomicUsize>,
    /// Cancelled when the gateway ends: its stops wait for no disk.
    ended: CancellationToken,
}

impl Patience {
    /// The gateway is shutting down. The wait that is in progress, and each later one, takes 0.1 s at most.
    pub fn end(&self) {
        self.ended.cancel();
    }

    /// The result of `work`; `None` if the disk does not answer in time: the work then continues, and its result is
    /// dropped. Must be called within a Tokio runtime.
    pub async fn wait<T: Send + 'static>(&self, work: impl Future<Output = T> + Send + 'static) -> Option<T> {
        let limit = match self.overdue.load(Ordering::Relaxed) {
            0 => DISK,
            _ => NEXT,
        };
        let given_up = async {
            tokio::select! {
                () = tokio::time::sleep(limit) => {}
                () = self.ended.cancelled() => tokio::time::sleep(NEXT.min(limit)).await,
            }
        };
        let mut work = Box::pin(work);
        tokio::select! {
            biased;
            done = work.as_mut() => return Some(done),
            () = given_up => {}
        }
        self.overdue.fetch_add(1, Ordering::Relaxed);
        let overdue = self.overdue.clone();
        tokio::spawn(async move {
            work.await;
            overdue.fetch_sub(1, Ordering::Relaxed);
        });
        None
    }

    /// Runs `read` on a separate thread and waits for its result within the limit.
    ///
    /// # Errors
    /// If the disk does not answer in time, or `read` panicked, which is logged.
    pub async fn read<T: Send + 'static>(&self, read: impl FnOnce() -> T + Send + 'static) -> Result<T, String> {
        match self.wait(tokio::task::spawn_blocking(read)).await {
            Some(Ok(found)) => Ok(found),
            Some(Err(error)) => Err(error.to_string()),
            None => Err(late()),
        }
    }
}

/// Message when the disk does not answer in time.
pub fn late() -> String {
    "the disk did not answer in time".to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::oneshot;
    use tokio::time::Instant;

    #[tokio::test(start_paused = true)]
    async fn a_disk_that_hangs_is_waited_for_once() {
        let patience = Patience::default();
        assert_eq!(patience.wait(async { 7 }).await, Some(7));
        let begun = Instant::now();
        let (answer, hangs) = oneshot::channel::<()>();
        assert_eq!(patience.wait(hangs).await, None);
        assert_eq!(begun.elapsed(), DISK);
        let (other, hangs) = oneshot::channel::<()>();
        assert_eq!(patience.wait(hangs).await, None);
        assert_eq!(begun.elapsed(), DISK + NEXT);
        // The disk answers again from here on.
        drop((answer, other));
        tokio::time::sleep(Duration::from_millis(1)).await;
        let begun = Instant::now();
        let (_answer, hangs) = oneshot::channel::<()>();
        assert_eq!(patience.wait(hangs).await, None);
        assert_eq!(begun.elapsed(), DISK);
    }

    #[tokio::test(start_paused = true)]
    async fn a_gateway_that_ends_waits_for_no_disk() {
        let patience = Patience::default();
        let (begun, ending) = (Instant::now(), patience.clone());
        tokio::spawn(async move {
            tokio::time::sleep(DISK / 4).await;
            ending.end();
        });
        let (_answer, hangs) = oneshot::channel::<()>();
        assert_eq!(patience.wait(hangs).await, None);
        assert_eq!(begun.elapsed(), DISK / 4 + NEXT);
        // An answer that arrives in time is still used.
        let answers = async {
            tokio::time::sleep(NEXT / 2).await;
            7
        };
        assert_eq!(Patience::default().wait(answers).await, Some(7));
        assert_eq!(patience.wait(async { 7 }).await, Some(7));
    }
}
