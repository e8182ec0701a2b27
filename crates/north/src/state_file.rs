//! State files of the daemon and the servers, read and written on threads of their own: a disk that hangs delays nobody.

use std::path::PathBuf;
use std::time::Instant;

use drivegate_core::files::state::AGAIN;
use drivegate_core::files::{State, Words};
use futures_util::FutureExt as _;
use tokio::sync::oneshot;
use tokio::task::{JoinHandle, spawn_blocking};

/// Why a file is not read yet when the wait for it ends: the disk hangs, or has refused so far.
pub const LATE: &str = "the disk has not returned it yet";

/// Reads a state file, and again while the disk refuses, as long as the channel is open. It yields `None` if there is no file,
/// or one of no use, which is renamed. Must be called within a Tokio runtime.
pub fn read<T: State>(path: PathBuf) -> oneshot::Receiver<Option<T>> {
    let (found, reading) = oneshot::channel();
    spawn_blocking(move || {
        let content = T::insist(&path, |_| {
            std::thread::sleep(AGAIN);
            !found.is_closed()
        });
        // The receiver may have ended meanwhile.
        content.map(|content| found.send(content).is_ok())
    });
    reading
}

/// A state file that is kept up to date by one write after the other. A mark stands for a state: the file is written while
/// the wanted mark is not the one on disk. A failed write is repeated at intervals, or at once for another mark.
#[derive(Debug)]
pub struct StateFile<M> {
    words: Words,
    /// Mark of the state on disk.
    written: M,
    writing: Option<(M, JoinHandle<Result<(), String>>)>,
    /// The last write, if it failed, with the time at which that was noted.
    failed: Option<(M, Instant)>,
}

impl<M: Clone + Default + PartialEq + Send + 'static> StateFile<M> {
    /// A file whose content has the mark `M::default()`.
    pub fn new(words: Words) -> StateFile<M> {
        StateFile {
            words,
            written: M::default(),
            writing: None,
            failed: None,
        }
    }

    /// Notes that the file was read, and has this mark.
    pub fn holds(&mut self, mark: M) {
        self.written = mark;
    }

    /// Mark of the state on disk.
    pub fn written(&self) -> &M {
        &self.written
    }

    /// Whether a write is in progress.
    pub fn is_writing(&self) -> bool {
        self.writing.is_some()
    }

    /// The result of a write that has ended since the last call.
    pub fn ended(&mut self, now: Instant) -> Option<Result<&M, String>> {
        let (mark, writing) = self.writing.take_if(|(_, writing)| writing.is_finished())?;
        let done = writing.now_or_never()?.unwrap_or_else(|panic| Err(panic.to_string()));
        self.words.report(&done, &mut self.failed.is_some());
        Some(match done {
            Ok(()) => {
                (self.written, self.failed) = (mark, None);
                Ok(&self.written)
            }
            Err(why) => {
                self.failed = Some((mark, now));
                Err(why)
            }
        })
    }

    /// Begins to write the state with this mark, unless it is on disk, another write is in progress, or its last write has
    /// just failed.
    pub fn keep(&mut self, mark: M, now: Instant, write: impl FnOnce(&M) -> Result<(), String> + Send + 'static) {
        let has_failed = |(failed, at): &(M, Instant)| *failed == mark && now < *at + AGAIN;
        if self.is_writing() || self.written == mark || self.failed.as_ref().is_some_and(has_failed) {
            return;
        }
        let of_thread = mark.clone();
        self.writing = Some((mark, spawn_blocking(move || write(&of_thread))));
    }

    /// Waits for the write in progress, and lets the next one begin at once. Whether nothing failed, or is late.
    pub async fn settled(&mut self, until: tokio::time::Instant) -> bool {
        self.failed = None;
        let Some((mark, writing)) = self.writing.take() else {
            return true;
        };
        let is_written = matches!(tokio::time::timeout_at(until, writing).await, Ok(Ok(Ok(()))));
        if is_written {
            self.written = mark;
        }
        is_written
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, Sender, channel};
    use std::time::Duration;

    use drivegate_core::permit::KeptReservations;

    use super::*;

    /// A file whose writes end when the test says so.
    struct Disk {
        file: StateFile<u32>,
        begun: (Sender<u32>, Receiver<u32>),
        now: Instant,
    }

    impl Disk {
        fn new() -> Disk {
            Disk {
                file: StateFile::new(KeptReservations::WORDS),
                begun: channel(),
                now: Instant::now(),
            }
        }

        /// Wants a state on disk; the answer of the disk is sent over the returned channel.
        fn want(&mut self, mark: u32) -> Sender<Result<(), String>> {
            let (answer, awaited) = channel();
            let begun = self.begun.0.clone();
            self.file.keep(mark, self.now, move |mark| {
                begun.send(*mark).unwrap();
                awaited.recv().unwrap()
            });
            answer
        }

        async fn ended(&mut self) -> Result<u32, String> {
            loop {
                if let Some(done) = self.file.ended(self.now) {
                    return done.copied();
                }
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        }
    }

    fn full() -> Result<(), String> {
        Err("marks.json: no space".to_string())
    }

    #[tokio::test]
    async fn one_write_follows_the_other_and_what_is_on_disk_is_not_written() {
        let mut disk = Disk::new();
        disk.want(0);
        assert!(!disk.file.is_writing(), "it is on disk");
        let answer = disk.want(1);
        disk.want(2);
        assert_eq!((disk.begun.1.recv(), disk.begun.1.try_recv().ok()), (Ok(1), None));
        assert_eq!(disk.file.ended(disk.now), None, "the disk hangs, and nobody waits");
        answer.send(Ok(())).unwrap();
        assert_eq!((disk.ended().await, *disk.file.written()), (Ok(1), 1));
        disk.file.holds(2);
        disk.want(2);
        assert!(!disk.file.is_writing());
    }

    #[tokio::test]
    async fn what_the_disk_refused_is_written_again_and_another_state_at_once() {
        let mut disk = Disk::new();
        disk.want(1).send(full()).unwrap();
        assert_eq!(disk.ended().await, Err("marks.json: no space".to_string()));
        disk.now += AGAIN / 2;
        disk.want(1);
        assert!(!disk.file.is_writing(), "too early");
        disk.now += AGAIN / 2;
        disk.want(1).send(full()).unwrap();
        assert!(disk.ended().await.is_err());
        disk.want(2).send(Ok(())).unwrap();
        assert_eq!((disk.ended().await, *disk.file.written()), (Ok(2), 2));
    }

    #[tokio::test]
    async fn the_last_write_waits_for_no_pause_and_not_for_ever() {
        let mut disk = Disk::new();
        let until = tokio::time::Instant::now() + Duration::from_secs(60);
        disk.want(1).send(full()).unwrap();
        assert!(disk.ended().await.is_err());
        assert!(disk.file.settled(until).await);
        disk.want(1).send(Ok(())).unwrap();
        assert!(disk.file.settled(until).await);
        assert_eq!(*disk.file.written(), 1);
        let _hangs = disk.want(2);
        assert!(!disk.file.settled(tokio::time::Instant::now()).await);
    }

    #[tokio::test]
    async fn a_write_that_panics_is_tried_again() {
        let mut disk = Disk::new();
        drop(disk.want(1));
        assert!(disk.ended().await.is_err());
        disk.now += AGAIN;
        disk.want(1).send(Ok(())).unwrap();
        assert_eq!(disk.ended().await, Ok(1));
    }

    #[tokio::test]
    async fn a_file_is_read_as_soon_as_the_disk_returns_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("reservations.json");
        assert_eq!(read::<KeptReservations>(path.clone()).await, Ok(None));
        // A folder of this name cannot be read as a file, until one replaces it at once.
        let (file, link) = (folder.path().join("file.json"), folder.path().join("link"));
        KeptReservations::default().save(&file).unwrap();
        std::os::unix::fs::symlink(folder.path(), &path).unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        let mut reading = read::<KeptReservations>(path.clone());
        tokio::time::sleep(Duration::from_millis(1)).await;
        assert!(reading.try_recv().is_err() && path.is_dir());
        std::fs::rename(&link, &path).unwrap();
        assert_eq!(reading.await, Ok(Some(KeptReservations::default())));
    }
}
