//! The thread that saves starts in the state directory. A start waits for it, a stop never does.

use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::time::{Duration, Instant, SystemTime};
use std::{fs, io};

use tokio::sync::oneshot;

use super::ledger::AGAIN;
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
        let Some(saved) = load(&path, &guards, end) else { return };
        // A thread that the disk delayed until another one replaced it must not restore its starts.
        if end.try_recv() == Err(TryRecvError::Empty) {
            guards.keep(&saved, Instant::now(), SystemTime::now());
            drop(reading);
            run(&path, &guards, end);
        }
    })?;
    Ok((keeper, read))
}

/// Loads the starts of earlier runs, and tries again while the disk refuses to read them; `None` at the end of the thread.
fn load(path: &Path, guards: &Guards, end: &Receiver<()>) -> Option<Saved> {
    let mut failing = false;
    loop {
        match read(path) {
            Ok(content) => return Some(content.unwrap_or_else(|why| set_aside(path, &why))),
            Err(error) => {
                if !std::mem::replace(&mut failing, true) {
                    tracing::error!(
                        target: "drivegate::start_guard",
                        "cannot read the starts in {}: {error}; drives with a guard are not started until that works; check state_dir \
                         of [gateway] and the disk", path.display()
                    );
                }
                guards.not_read(error.to_string());
            }
        }
        if end.recv_timeout(AGAIN) != Err(RecvTimeoutError::Timeout) {
            return None;
        }
    }
}

/// The starts in the file, or why its content is of no use.
fn read(path: &Path) -> io::Result<Result<Saved, String>> {
    let length = match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Ok(Saved::default())),
        metadata => metadata?.len(),
    };
    if length > LONGEST {
        return Ok(Err(format!("it has {length} bytes, more than {LONGEST}")));
    }
    Ok(Saved::from_json(&fs::read(path)?))
}

/// Renames a file whose content is of no use, and begins without it.
fn set_aside(path: &Path, why: &str) -> Saved {
    let kept = files::set_aside(path, &path.with_extension("damaged"));
    tracing::error!(
        target: "drivegate::start_guard",
        "cannot use the starts in {}: {why}; {kept}, and starts before now are not counted", path.display()
    );
    Saved::default()
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
            let done = files::replace(path, &saved.to_json());
            report(path, &done, &mut failing);
            let done = done.map_err(|error| format!("{}: {error}", path.display()));
            guards.wrote(generation, done, Instant::now());
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
