//! How long a start and a reload wait for the disk.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// Longest wait for a file.
pub const DISK: Duration = Duration::from_secs(2);
/// Longest wait for a file while another one is overdue.
const NEXT: Duration = Duration::from_millis(100);

/// The wait for files that are read at a start or a reload. A disk that hangs is waited for once, not once for each file.
#[derive(Debug, Clone, Default)]
pub struct Patience {
    /// How many waits were given up whose work is not done yet.
    overdue: Arc<AtomicUsize>,
}

impl Patience {
    /// The result of `work`; `None` if the disk does not answer in time: the work goes on then, and its result is dropped.
    /// Must be called within a Tokio runtime.
    pub async fn wait<T: Send + 'static>(&self, work: impl Future<Output = T> + Send + 'static) -> Option<T> {
        let limit = match self.overdue.load(Ordering::Relaxed) {
            0 => DISK,
            _ => NEXT,
        };
        let mut work = Box::pin(work);
        if let Ok(done) = tokio::time::timeout(limit, work.as_mut()).await {
            return Some(done);
        }
        self.overdue.fetch_add(1, Ordering::Relaxed);
        let overdue = self.overdue.clone();
        tokio::spawn(async move {
            work.await;
            overdue.fetch_sub(1, Ordering::Relaxed);
        });
        None
    }

    /// What `read` finds, away from the runtime.
    ///
    /// # Errors
    /// The disk does not answer in time, or `read` panicked, which is logged.
    pub async fn read<T: Send + 'static>(&self, read: impl FnOnce() -> T + Send + 'static) -> Result<T, String> {
        match self.wait(tokio::task::spawn_blocking(read)).await {
            Some(Ok(found)) => Ok(found),
            Some(Err(error)) => Err(error.to_string()),
            None => Err(late()),
        }
    }
}

/// Why there is nothing from a disk that does not answer.
pub fn late() -> String {
    format!("the disk did not answer within {} s", DISK.as_secs())
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
        // The disk answers again.
        drop((answer, other));
        tokio::time::sleep(Duration::from_millis(1)).await;
        let begun = Instant::now();
        let (_answer, hangs) = oneshot::channel::<()>();
        assert_eq!(patience.wait(hangs).await, None);
        assert_eq!(begun.elapsed(), DISK);
    }
}
