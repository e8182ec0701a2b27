//! Saves events and counters in a thread that receives every event and reads the counters. Nothing waits for this
//! thread: while the disk is slow, full or missing, events are queued, further ones are missing in the file, and
//! everything else continues.

use std::collections::{BTreeMap, VecDeque};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant, SystemTime};

use serde::{Deserialize, Serialize};
use tokio::sync::broadcast::error::TryRecvError;
use tokio::sync::{broadcast, oneshot};

use super::counters::Totals;
use super::drives::History;
use crate::event::{self, Event, Events};
use crate::files::names::{COUNTERS, EVENTS};
use crate::files::{Keeper, Rotated, State, Words};

/// Time within which events reach the disk, and the interval of further attempts after a failure.
const TICK: Duration = Duration::from_secs(1);
/// Interval at which counters reach the keeper: with the time for the write, the most that a power cut costs.
const COUNTERS_EVERY: Duration = Duration::from_secs(45);
/// Size of all files of events, bytes, and their number.
pub(super) const EVENT_FILES: (u64, u64) = (4 << 20, 4);
/// Maximum number of events that wait for the disk.
const WAITING: usize = 4096;
/// Maximum number of drives with counters in a file. A file with more drives was not written by the gateway.
const MOST_DRIVES: usize = 16_384;
#[derive(Debug, Serialize, Deserialize)]
struct CounterFile {
    #[serde(default)]
    time: String,
    drives: BTreeMap<String, Totals>,
}

impl State for CounterFile {
    const WORDS: Words = Words {
        what: "the run hours and starts",
        unread: "they are not saved",
        unsaved: "a restart loses those from now on",
        lost: "counting starts at 0; to continue from it, stop the gateway, repair the file and rename it back",
    };
    const VERSION_KEY: &'static str = "drivegate_counters";
    const LONGEST: u64 = 64 << 20;

    fn check(&self) -> Result<(), String> {
        if self.drives.len() > MOST_DRIVES {
            return Err(format!("it has {} drives, more than {MOST_DRIVES}", self.drives.len()));
        }
        match self.drives.iter().find(|(_, totals)| !totals.is_sane()) {
            Some((drive, _)) => Err(format!("its figures for `{drive}` are impossible")),
            None => Ok(()),
        }
    }

    /// A free name: earlier damaged counters may still be of use to somebody.
    fn aside(path: &Path) -> PathBuf {
        let named = |ending: String| path.with_extension(ending);
        let mut names = (1..1000).map(|number| named(format!("damaged-{number}")));
        names
            .find(|name| !name.exists())
            .unwrap_or_else(|| named("damaged".to_string()))
    }
}

/// Saves events and counters in this directory from now on. For the `first` call of this run, the channel yields
/// the events of earlier runs; later calls yield none.
///
/// # Errors
/// If the system cannot create a thread.
pub fn keep(
    dir: &Path,
    first: bool,
    history: Arc<History>,
    events: &Events,
) -> io::Result<(Keeper, oneshot::Receiver<Vec<Event>>)> {
    let mut writer = Writer::new(dir, first, history, events.subscribe());
    let (found, earlier) = oneshot::channel();
    let keeper = Keeper::start("history", dir, move |end| {
        let earlier = if first { writer.remember() } else { Vec::new() };
        // The receiver no longer exists if the disk was too slow.
        let _ = found.send(earlier);
        writer.run(end);
    })?;
    Ok((keeper, earlier))
}

#[derive(Debug)]
struct Writer {
    events: Rotated,
    heard: broadcast::Receiver<Arc<Event>>,
    waiting: VecDeque<Arc<Event>>,
    /// Events that are missing in the file since it was last written.
    lost: u64,
    counters: PathBuf,
    history: Arc<History>,
    /// The counts of earlier runs are in memory.
    counted_on: bool,
    /// The counters as last written to the file.
    written: Option<BTreeMap<String, Totals>>,
    /// Whether writing fails at present, which is logged once.
    failing: bool,
}

impl Writer {
    fn new(dir: &Path, first: bool, history: Arc<History>, heard: broadcast::Receiver<Arc<Event>>) -> Writer {
        Writer {
            events: Rotated::new(dir.join(EVENTS), EVENT_FILES.0, EVENT_FILES.1),
            heard,
            waiting: VecDeque::new(),
            lost: 0,
            counters: dir.join(COUNTERS),
            history,
            counted_on: !first,
            written: None,
            failing: false,
        }
    }

    fn run(mut self, ended: &Receiver<()>) {
        let mut due = Instant::now() + COUNTERS_EVERY;
        loop {
            let end = ended.recv_timeout(TICK) != Err(RecvTimeoutError::Timeout);
            let now = Instant::now();
            let counters = end || now >= due;
            if counters {
                due = now + COUNTERS_EVERY;
            }
            let done = self.work(counters);
            self.report(done, end);
            if end {
                return;
            }
        }
    }

    /// Takes over the counters of earlier runs; returns their events.
    fn remember(&mut self) -> Vec<Event> {
        let opened = self.open();
        let earlier = if opened.is_ok() { self.earlier() } else { Vec::new() };
        let done = opened.and_then(|()| self.count_on());
        self.report(done, false);
        earlier
    }

    /// The events of earlier runs, oldest first.
    fn earlier(&self) -> Vec<Event> {
        let (mut earlier, mut wrong) = (Vec::new(), 0u64);
        for path in self.events.all() {
            let Ok(bytes) = fs::read(&path) else {
                // Some of the rotated files may not exist.
                continue;
            };
            for line in bytes.split(|byte| *byte == b'\n').filter(|line| !line.is_empty()) {
                match event::from_line(line) {
                    Ok(event) => earlier.push(event),
                    Err(_) => wrong += 1,
                }
            }
        }
        if wrong > 0 {
            tracing::warn!(
                target: "drivegate::history",
                "{wrong} lines of {} and the files before it are truncated, or not events that this version knows; \
                 they are kept but not shown", self.events.path().display()
            );
        }
        earlier
    }

    /// Writes pending events, and the counters if due.
    fn work(&mut self, counters: bool) -> io::Result<()> {
        self.hear();
        if self.events.is_replaced() {
            self.events.close();
        }
        // Whoever may write the events may write the counters as well. Another gateway with the same directory gets
        // neither.
        if !self.events.is_open() {
            self.open()?;
        }
        // Events are saved also where the counters cannot be read.
        let counted = self.count_on();
        while let Some(event) = self.waiting.front() {
            let mut line = serde_json::to_vec(&**event).map_err(io::Error::other)?;
            line.push(b'\n');
            if self.events.is_full(line.len()) {
                self.events.rotate()?;
                self.open()?;
            }
            self.events.append(&line)?;
            self.waiting.pop_front();
        }
        self.events.sync()?;
        counted?;
        if counters { self.write_counters() } else { Ok(()) }
    }

    fn hear(&mut self) {
        loop {
            match self.heard.try_recv() {
                Ok(event) if self.waiting.len() < WAITING => self.waiting.push_back(event),
                Ok(_) => self.lost += 1,
                Err(TryRecvError::Lagged(lost)) => self.lost += lost,
                Err(TryRecvError::Empty | TryRecvError::Closed) => return,
            }
        }
    }

    /// Opens the file of events.
    fn open(&mut self) -> io::Result<()> {
        let (file, bytes) = self.events.open()?;
        let ended = bytes == 0 || ends_with_newline(file, bytes)?;
        if !ended {
            // A line cut off by a power failure stays as it is; the line end keeps the next event apart from it.
            self.events.append(b"\n")?;
        }
        Ok(())
    }

    /// Adds the counters of earlier runs, on the first call at which the disk returns them; until then the file stays as it is.
    fn count_on(&mut self) -> io::Result<()> {
        if self.counted_on {
            return Ok(());
        }
        let path = &self.counters;
        let found = CounterFile::take_up(path)
            .map_err(|error| io::Error::new(error.kind(), format!("cannot read {}: {error}", path.display())))?;
        found.into_iter().for_each(|file| self.history.count_on(file.drives));
        self.counted_on = true;
        Ok(())
    }

    fn write_counters(&mut self) -> io::Result<()> {
        let totals = self.history.all_totals();
        if self.written.as_ref() == Some(&totals) {
            return Ok(());
        }
        let file = CounterFile {
            time: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
            drives: totals,
        };
        file.save(&self.counters).map_err(io::Error::other)?;
        self.written = Some(file.drives);
        Ok(())
    }

    /// Logs the first failure, and the end of failures.
    fn report(&mut self, done: io::Result<()>, end: bool) {
        let path = self.events.path().display();
        let waiting = self.waiting.len();
        match done {
            Ok(()) => {
                let lost = std::mem::take(&mut self.lost);
                if std::mem::take(&mut self.failing) || lost > 0 {
                    tracing::warn!(
                        target: "drivegate::history",
                        "writing events and counters again; {lost} events are missing in {path}"
                    );
                }
            }
            Err(error) => {
                if !std::mem::replace(&mut self.failing, true) {
                    tracing::error!(
                        target: "drivegate::history",
                        "cannot save events and counters in {path}: {error}; a restart loses those from now on; \
                         everything else continues; check state_dir of [gateway] and the disk"
                    );
                }
                self.events.close();
                if end {
                    tracing::error!(target: "drivegate::history", "{waiting} events have not been written");
                }
            }
        }
    }
}

fn ends_with_newline(file: &fs::File, bytes: u64) -> io::Result<bool> {
    use std::os::unix::fs::FileExt;
    let mut last = [0];
    file.read_exact_at(&mut last, bytes.saturating_sub(1))?;
    Ok(last == *b"\n")
}

#[cfg(test)]
mod tests;
