//! The number of the session (bdSeq), which links the death of a node to its birth, kept over restarts in a file.

use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, io};

use drivegate_core::files::{self, names::SPARKPLUG};
use drivegate_north::patience::Patience;
use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::{Instant, timeout_at};

/// Longest wait for writing the file.
const WRITE: Duration = Duration::from_secs(1);

/// Numbers the connections from 0 to 255 and then from 0 again.
#[derive(Debug)]
pub(super) struct BdSeq {
    path: PathBuf,
    number: u8,
    /// Whether a broker has accepted a connection with the number.
    used: bool,
    /// Whether the number is in the file.
    kept: bool,
    /// The number that is being written, which may take longer than [`WRITE`].
    writing: Option<(u8, JoinHandle<io::Result<()>>)>,
}

impl BdSeq {
    /// Continues after the number in the file, which was used last; starts with 0 if there is no file or it cannot be read.
    pub(super) async fn open(dir: &Path, patience: &Patience) -> BdSeq {
        let path = dir.join(SPARKPLUG);
        let read = patience.read({
            let path = path.clone();
            move || fs::read_to_string(path).unwrap_or_default()
        });
        let text = read.await.unwrap_or_default();
        let last: Option<u8> = text.trim().parse().ok();
        BdSeq {
            path,
            number: last.map_or(0, |last| last.wrapping_add(1)),
            used: false,
            kept: false,
            writing: None,
        }
    }

    /// The number of the next connection; it is in the file when this returns, unless the disk is too slow. The
    /// number of a connection that no broker accepted is used again.
    ///
    /// # Errors
    /// If the number could not be written to the file; the number is valid in any case.
    pub(super) async fn next(&mut self) -> (u8, Result<(), String>) {
        if std::mem::take(&mut self.used) {
            (self.number, self.kept) = (self.number.wrapping_add(1), false);
        }
        if self.kept {
            return (self.number, Ok(()));
        }
        let written = self.write(Instant::now() + WRITE).await;
        self.kept = written.is_ok();
        (self.number, written.map_err(|error| error.to_string()))
    }

    async fn write(&mut self, until: Instant) -> io::Result<()> {
        let slow = || io::Error::new(io::ErrorKind::TimedOut, "the disk does not respond");
        if let Some((of, older)) = &mut self.writing {
            // An older number must not replace a newer one.
            let ended = timeout_at(until, older).await.map_err(|_| slow())?;
            let is_written = *of == self.number && matches!(ended, Ok(Ok(())));
            self.writing = None;
            if is_written {
                return Ok(());
            }
        }
        let (path, number) = (self.path.clone(), self.number);
        let work = spawn_blocking(move || files::replace(&path, format!("{number}\n").as_bytes()));
        let (_, work) = self.writing.insert((number, work));
        let ended = timeout_at(until, work).await.map_err(|_| slow())?;
        self.writing = None;
        ended?
    }

    /// Writes the present number again if it is not in the file, without waiting for the disk. Returns whether it is in the
    /// file by now.
    pub(super) async fn keep(&mut self) -> bool {
        if !self.kept {
            self.kept = self.write(Instant::now()).await.is_ok();
        }
        self.kept
    }

    /// A broker accepted the connection with the last number, which is returned.
    pub(super) fn accepted(&mut self) -> u8 {
        self.used = true;
        self.number
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

#[cfg(test)]
mod tests {
    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;

    async fn next(bd_seq: &mut BdSeq) -> u8 {
        // A slow disk takes more than one attempt.
        loop {
            if let (number, Ok(())) = bd_seq.next().await {
                return number;
            }
        }
    }

    async fn reopened(state: &Path) -> u8 {
        next(&mut BdSeq::open(state, &Patience::default()).await).await
    }

    #[tokio::test]
    async fn numbers_go_on_over_restarts() {
        let dir = tempfile::tempdir().unwrap();
        let state = dir.path().join("state");
        let mut bd_seq = BdSeq::open(&state, &Patience::default()).await;
        assert_eq!(
            (next(&mut bd_seq).await, next(&mut bd_seq).await),
            (0, 0),
            "no broker took the first"
        );
        for expected in 1..=255 {
            bd_seq.accepted();
            assert_eq!(next(&mut bd_seq).await, expected);
        }
        bd_seq.accepted();
        assert_eq!(next(&mut bd_seq).await, 0);
        // Killed before or after the broker accepted the connection: the next run cannot know.
        assert_eq!(reopened(&state).await, 1);
        assert_eq!(reopened(&state).await, 2);
        fs::write(state.join(SPARKPLUG), "damaged").unwrap();
        assert_eq!(reopened(&state).await, 0);
    }

    #[tokio::test]
    async fn a_number_that_is_written_late_replaces_no_newer_one() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(SPARKPLUG);
        let partial = path.with_extension(files::PARTIAL);
        // A named pipe without a reader hangs as a disk does.
        let mode = Mode::from_raw_mode(0o600);
        mknodat(CWD, &partial, FileType::Fifo, mode, 0).unwrap();
        let mut bd_seq = BdSeq::open(dir.path(), &Patience::default()).await;
        for expected in 0..2 {
            let (number, written) = bd_seq.next().await;
            assert_eq!((number, written.is_err()), (expected, true));
            bd_seq.accepted();
        }
        assert_eq!(fs::read_to_string(&partial).unwrap(), "0\n", "the second did not begin");
        assert_eq!(next(&mut bd_seq).await, 2);
        assert_eq!(fs::read_to_string(&path).unwrap(), "2\n");
    }

    #[tokio::test]
    async fn what_the_disk_did_not_take_is_written_once_there_is_a_disk() {
        let dir = tempfile::tempdir().unwrap();
        let state = dir.path().join("state");
        fs::write(&state, "no directory").unwrap();
        let mut bd_seq = BdSeq::open(&state, &Patience::default()).await;
        assert!(bd_seq.next().await.1.is_err());
        bd_seq.accepted();
        assert!(!bd_seq.keep().await);
        fs::remove_file(&state).unwrap();
        while !bd_seq.keep().await {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        assert_eq!(fs::read_to_string(state.join(SPARKPLUG)).unwrap(), "0\n");
        assert_eq!(reopened(&state).await, 1);
    }

    #[tokio::test]
    async fn without_a_directory_the_numbers_begin_anew() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "").unwrap();
        let mut bd_seq = BdSeq::open(&file, &Patience::default()).await;
        for expected in 0..3 {
            let (number, written) = bd_seq.next().await;
            assert_eq!((number, written.is_err()), (expected, true));
            bd_seq.accepted();
        }
    }
}
