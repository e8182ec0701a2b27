//! Reads the configuration with its profiles, certificates and secrets on a separate thread: a file that cannot be
//! read, such as a pipe or one on a share that does not respond, must delay neither signals nor the watchdog.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::Instant;

use drivegate_gateway::config::{self, Loaded, Settings};

/// Time limit for reading the files of a reload.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of threads that read files; those of earlier reloads may still hang.
const MAX_READERS: usize = 4;

/// Why a configuration was not loaded.
#[derive(Debug, thiserror::Error)]
pub(super) enum NotLoaded {
    #[error(
        "its files could not be read within {TIMEOUT:?}: one of them is a pipe or on a file system that does not respond"
    )]
    Timeout,
    #[error("{MAX_READERS} earlier reloads are still waiting for files that cannot be read; restart the service")]
    TooMany,
    #[error("reading the configuration failed; please report this")]
    Panic,
    #[error("cannot start a thread: {0}")]
    Thread(#[from] io::Error),
}

/// A configuration that is being loaded.
#[derive(Debug)]
pub(super) struct Loading {
    loaded: oneshot::Receiver<Loaded>,
    /// Time limit of loading; `None` without one.
    deadline: Option<Instant>,
}

impl Loading {
    /// Begins to read the configuration in `path`.
    ///
    /// # Errors
    /// If the system does not provide a thread.
    pub(super) fn begin(path: &Path, limit: Option<Duration>) -> io::Result<Loading> {
        Loading::counted(path, limit, Reader::new(&Arc::default()))
    }

    fn counted(path: &Path, limit: Option<Duration>, reader: Reader) -> io::Result<Loading> {
        let (sender, loaded) = oneshot::channel();
        let path = path.to_path_buf();
        let read = move || {
            // After the time limit the receiver no longer exists, so an error is ignored.
            let _ = sender.send(Settings::load_proved(&path, config::environment()));
            drop(reader);
        };
        std::thread::Builder::new().name("load".to_string()).spawn(read)?;
        let deadline = limit.map(|limit| Instant::now() + limit);
        Ok(Loading { loaded, deadline })
    }

    /// Waits until the configuration is read; cancel safe.
    pub(super) async fn finished(&mut self) -> Result<Loaded, NotLoaded> {
        let loaded = match self.deadline {
            Some(deadline) => tokio::time::timeout_at(deadline, &mut self.loaded)
                .await
                .map_err(|_| NotLoaded::Timeout)?,
            None => (&mut self.loaded).await,
        };
        loaded.map_err(|_| NotLoaded::Panic)
    }
}

/// Counts a thread that reads files.
#[derive(Debug)]
struct Reader(Arc<AtomicUsize>);

impl Reader {
    fn new(count: &Arc<AtomicUsize>) -> Reader {
        count.fetch_add(1, Ordering::Relaxed);
        Reader(count.clone())
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The loads of a running gateway, one at a time.
#[derive(Debug, Default)]
pub(super) struct Loads {
    loading: Option<Loading>,
    /// Whether another load was requested in the meantime.
    again: bool,
    readers: Arc<AtomicUsize>,
}

impl Loads {
    /// Begins to read the configuration in `path`, after the present load if one is in progress.
    ///
    /// # Errors
    /// If a configuration cannot be read now.
    pub(super) fn begin(&mut self, path: &Path) -> Result<(), NotLoaded> {
        if self.loading.is_some() {
            self.again = true;
            return Ok(());
        }
        if self.readers.load(Ordering::Relaxed) >= MAX_READERS {
            return Err(NotLoaded::TooMany);
        }
        self.loading = Some(Loading::counted(path, Some(TIMEOUT), Reader::new(&self.readers))?);
        Ok(())
    }

    /// The configuration as soon as it was read; waits for ever if none is being read. Cancel safe.
    pub(super) async fn loaded(&mut self) -> Result<Loaded, NotLoaded> {
        let Some(loading) = &mut self.loading else {
            return std::future::pending().await;
        };
        let loaded = loading.finished().await;
        self.loading = None;
        loaded
    }

    /// Whether a configuration is being read.
    pub(super) fn is_loading(&self) -> bool {
        self.loading.is_some()
    }

    /// Whether a reload was requested while the last one was being read.
    pub(super) fn is_wanted_again(&mut self) -> bool {
        std::mem::take(&mut self.again)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::OpenOptionsExt;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_pipe_delays_nothing_and_is_given_up() {
        let dir = tempfile::tempdir().unwrap();
        let pipe = dir.path().join("drivegate.toml");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
        let mut loads = Loads::default();
        for _ in 0..MAX_READERS {
            loads.begin(&pipe).unwrap();
            loads.begin(&pipe).unwrap();
            assert!(matches!(loads.loaded().await, Err(NotLoaded::Timeout)));
            assert!(loads.is_wanted_again() && !loads.is_wanted_again());
        }
        assert!(matches!(loads.begin(&pipe), Err(NotLoaded::TooMany)));
        // Someone writes the file after all; without a reader the system refuses that.
        let without_waiting = i32::try_from(rustix::fs::OFlags::NONBLOCK.bits()).unwrap();
        let deadline = std::time::Instant::now() + Duration::from_secs(60);
        while loads.readers.load(Ordering::Relaxed) > 0 {
            assert!(std::time::Instant::now() < deadline);
            let _ = std::fs::File::options()
                .write(true)
                .custom_flags(without_waiting)
                .open(&pipe);
            std::thread::yield_now();
        }
        std::fs::remove_file(&pipe).unwrap();
        std::fs::write(&pipe, "[gateway]\nname = \"g\"\n").unwrap();
        loads.begin(&pipe).unwrap();
        let mut loading = loads.loading.take().unwrap();
        loading.deadline = None;
        assert_eq!(loading.finished().await.unwrap().settings.unwrap().gateway, "g");
    }
}
