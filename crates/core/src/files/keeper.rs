//! A thread that writes to disk for the gateway, and its orderly end.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};

use tokio::sync::watch;

/// A running thread that writes to disk.
#[derive(Debug)]
pub struct Keeper {
    dir: PathBuf,
    /// Dropped when the thread is to end.
    end: Sender<()>,
    ended: watch::Receiver<()>,
}

impl Keeper {
    /// Starts a thread that works in this directory until the other end of its channel is dropped.
    ///
    /// # Errors
    /// If the system cannot create a thread.
    pub fn start(name: &str, dir: &Path, work: impl FnOnce(&Receiver<()>) + Send + 'static) -> io::Result<Keeper> {
        let ((end, to_end), (running, ended)) = (channel(), watch::channel(()));
        std::thread::Builder::new().name(name.to_string()).spawn(move || {
            work(&to_end);
            drop(running);
        })?;
        let dir = dir.to_path_buf();
        Ok(Keeper { dir, end, ended })
    }

    /// The directory in which the thread writes.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Writes pending data, as far as the disk accepts it, and ends the thread. A hanging disk blocks this call
    /// forever, so callers must set a time limit.
    pub async fn stop(self) {
        let Keeper { end, mut ended, .. } = self;
        drop(end);
        while ended.changed().await.is_ok() {}
    }
}
