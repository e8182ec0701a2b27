//! The thread that saves starts in the state directory. A start waits for it, a stop never does.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::oneshot;

use super::{Guards, Saved};
use crate::files::names::{STARTS, STARTS_LOCK};
use crate::files::state::AGAIN;
use crate::files::{self, Keeper, State as _};

/// Longest wait for a change, so the longest delay at the end of the thread.
const BEAT: Duration = Duration::from_millis(100);

/// What a process does while another one counts starts in the directory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhileTaken {
    /// The gateway waits until a command without a gateway has ended.
    Wait,
    /// A command without a gateway starts no guarded drive.
    GiveUp,
}

/// Saves starts in this directory from now on; those of earlier runs are read from it. Until the channel signals
/// that they were read, guarded drives are not started. One process at a time counts starts in a directory: each would
/// overwrite those of the other.
///
/// # Errors
/// If the system cannot create a thread.
pub fn keep(dir: &Path, guards: Arc<Guards>, taken: WhileTaken) -> io::Result<(Keeper, oneshot::Receiver<()>)> {
    let (path, place) = (dir.join(STARTS), dir.join(STARTS_LOCK));
    let (reading, read) = oneshot::channel();
    guards.await_file(&path);
    let keeper = Keeper::start("starts", dir, move |end| {
        let Some(_lock) = lock(&place, &guards, taken, end) else {
            return;
        };
        let found = Saved::insist(&path, |error| {
            guards.not_read(error.to_string());
            end.recv_timeout(AGAIN) == Err(RecvTimeoutError::Timeout)
        });
        // A thread that the disk delayed until another one replaced it must not restore its starts.
        if let Some(found) = found
            && end.try_recv() == Err(TryRecvError::Empty)
        {
            guards.keep(&found.unwrap_or_default(), Instant::now(), SystemTime::now());
            drop(reading);
            run(&path, &guards, end);
        }
    })?;
    Ok((keeper, read))
}

/// Reads the starts of earlier runs for a process that starts no motor: they are shown, and nothing is written.
pub fn observe(dir: &Path, guards: &Guards) {
    let path = dir.join(STARTS);
    guards.await_file(&path);
    match Saved::load(&path) {
        Ok(found) => guards.keep(&found.unwrap_or_default(), Instant::now(), SystemTime::now()),
        Err(error) => guards.not_read(error.to_string()),
    }
}

/// Locks the starts of a directory for this process, as long as the returned file is open; `None` if the thread is to end,
/// or gives up.
fn lock(place: &Path, guards: &Guards, taken: WhileTaken, end: &Receiver<()>) -> Option<File> {
    let mut failing = false;
    loop {
        let (why, pause) = match open(place).map(|file| (file.try_lock(), file)) {
            Ok((Ok(()), file)) => return Some(file),
            Ok((Err(TryLockError::WouldBlock), _)) => {
                ("another drivegate counts starts there at present".to_string(), BEAT)
            }
            Ok((Err(TryLockError::Error(error)), _)) | Err(error) => (error.to_string(), AGAIN),
        };
        guards.not_read(why.clone());
        if taken == WhileTaken::GiveUp {
            return None;
        }
        if !std::mem::replace(&mut failing, true) {
            Saved::WORDS.not_read(place, &why);
        }
        if end.recv_timeout(pause) != Err(RecvTimeoutError::Timeout) {
            return None;
        }
    }
}

/// Opens the file of the lock, which is created for the first one.
fn open(place: &Path) -> io::Result<File> {
    files::create_dir(place.parent().unwrap_or(place))?;
    let create = || OpenOptions::new().read(true).append(true).create(true).open(place);
    let file = or_read_only(create(), place)?;
    files::give_to_owner(&file, place);
    Ok(file)
}

/// Opens a file that may not be written for reading, which a lock can do with: a command of root leaves it to root where
/// the system does not let root give files away.
fn or_read_only(opened: io::Result<File>, place: &Path) -> io::Result<File> {
    match opened {
        Err(error) if error.kind() == ErrorKind::PermissionDenied => File::open(place).map_err(|_| error),
        opened => opened,
    }
}

fn run(path: &Path, guards: &Guards, end: &Receiver<()>) {
    let mut failing = false;
    loop {
        let ends = end.try_recv() != Err(TryRecvError::Empty);
        let to_write = if ends {
            guards.last_to_write()
        } else {
            guards.wait_to_write(BEAT)
        };
        if let Some((generation, saved)) = to_write {
            let done = saved.save(path);
            Saved::WORDS.report(&done, &mut failing);
            guards.wrote(generation, done, Instant::now());
        }
        if ends {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_may_only_be_read_is_locked_all_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join(STARTS_LOCK);
        let denied = || Err(io::Error::from(ErrorKind::PermissionDenied));
        let missing = or_read_only(denied(), &place).unwrap_err();
        assert_eq!(
            missing.kind(),
            ErrorKind::PermissionDenied,
            "the reason of the first attempt"
        );
        let of_root = open(&place).unwrap();
        let of_service = or_read_only(denied(), &place).unwrap();
        of_root.try_lock().unwrap();
        assert!(matches!(of_service.try_lock(), Err(TryLockError::WouldBlock)));
        of_root.unlock().unwrap();
        of_service.try_lock().unwrap();
        assert!(matches!(of_root.try_lock(), Err(TryLockError::WouldBlock)));
        let full = or_read_only(Err(io::Error::from(ErrorKind::StorageFull)), &place);
        assert_eq!(full.unwrap_err().kind(), ErrorKind::StorageFull);
    }
}
