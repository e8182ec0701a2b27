//! The thread that saves starts in the state directory. A start waits for it, a stop never does.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::oneshot;

use super::{Guards, Saved};
use crate::files::names::STARTS;
use crate::files::state::AGAIN;
use crate::files::{Keeper, State as _};

/// Longest wait for a change, so the longest delay at the end of the thread.
const BEAT: Duration = Duration::from_millis(100);

/// Saves starts in this directory from now on; those of earlier runs are read from it. Until the channel signals
/// that they were read, guarded drives are not started.
///
/// # Errors
/// If the system cannot create a thread.
pub fn keep(dir: &Path, guards: Arc<Guards>) -> io::Result<(Keeper, oneshot::Receiver<()>)> {
    let path = dir.join(STARTS);
    let (reading, read) = oneshot::channel();
    guards.await_file(&path);
    let keeper = Keeper::start("starts", dir, move |end| {
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
