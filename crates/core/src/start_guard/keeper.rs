//! The thread that saves starts in the state directory. A start waits for it, a stop never does.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::oneshot;

use super::{Guards, Saved};
use crate::files::names::STARTS;
use crate::files::{self, Keeper};

/// Longest wait for a change, so the longest delay at the end of the thread.
const BEAT: Duration = Duration::from_millis(100);
/// Largest file that is read, bytes.
const LONGEST: u64 = 64 << 20;

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
        let saved = load(&path);
        // A thread that the disk delayed until another one replaced it must not restore its starts.
        if end.try_recv() == Err(TryRecvError::Empty) {
            guards.keep(&saved, Instant::now(), SystemTime::now());
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
        if let Some((generation, saved)) = guards.wait_to_write(if ends { Duration::ZERO } else { BEAT }) {
            let done = files::replace(path, &saved.to_json());
            report(path, &done, &mut failing);
            guards.wrote(generation, done.map_err(|error| format!("{}: {error}", path.display())));
        }
        if ends {
            return;
        }
    }
}

/// Logs the first failure, and the end of failures.
fn report(path: &Path, done: &io::Result<()>, failing: &mut bool) {
    match done {
        Ok(()) if std::mem::take(failing) => {
            tracing::warn!(target: "drivegate::start_guard", "counting starts in {} again", path.display());
        }
        Ok(()) => {}
        Err(error) if !std::mem::replace(failing, true) => tracing::error!(
            target: "drivegate::start_guard",
            "cannot count starts in {}: {error}; drives with a guard are not started until that works; check state_dir of \
             [gateway] and the disk", path.display()
        ),
        Err(_) => {}
    }
}

/// Loads the starts of earlier runs. An unusable file is renamed.
fn load(path: &Path) -> Saved {
    let found = files::read(path, LONGEST).and_then(|bytes| match bytes {
        Some(bytes) => Saved::from_json(&bytes),
        None => Ok(Saved::default()),
    });
    found.unwrap_or_else(|why| {
        let kept = files::set_aside(path, &path.with_extension("damaged"));
        tracing::error!(
            target: "drivegate::start_guard",
            "cannot use the starts in {}: {why}; {kept}, and starts before now are not counted", path.display()
        );
        Saved::default()
    })
}
