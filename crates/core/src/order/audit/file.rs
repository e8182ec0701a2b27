//! The audit file: a thread writes records from two bounded queues, one of them for commands that were sent. No
//! command waits for it: while the disk is slow, full or missing, records wait, and those beyond the queues are
//! counted as lost. A reload that configures another file starts another thread on the same queues, so that no
//! record is lost in between.

use std::collections::{HashMap, VecDeque};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use tokio::sync::watch;

use super::AuditRecord;
use super::chain::{self, Chain, Entry, Hash, Tail};
use crate::files::Rotated;

/// Maximum number of records that wait for the disk: those of commands that were sent, and all others.
const WAITING: (usize, usize) = (8192, 1024);
/// Time after which written records survive a power failure, and after which a disk that failed is tried again.
const SYNC: Duration = Duration::from_secs(1);
/// Interval at which the hash of the last line is logged.
const HASH_LOGGED: Duration = Duration::from_secs(60);
/// Number of files that share `max_bytes`.
const FILES: u64 = 8;
/// Longest end of a file that is searched for its last entry, bytes.
const LONGEST_TAIL: u64 = 64 << 20;

/// Settings of the audit file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AuditFileOptions {
    /// Path of the current file; older ones have `.1` to `.7` after that name.
    pub path: PathBuf,
    /// Size of all files, bytes.
    pub max_bytes: u64,
}

impl AuditFileOptions {
    fn rotated(&self) -> Rotated {
        Rotated::new(self.path.clone(), self.max_bytes, FILES)
    }

    /// Paths of all audit files that may exist, oldest first.
    pub fn files(&self) -> Vec<PathBuf> {
        self.rotated().all()
    }
}

/// Handle of the thread that writes the audit.
#[derive(Debug)]
pub struct AuditFile {
    options: AuditFileOptions,
    shared: Arc<Shared>,
    /// Closes when the thread has ended; a successor waits for that.
    ended: watch::Receiver<()>,
}

#[derive(Debug, Default)]
struct Shared {
    queues: Mutex<Queues>,
    wake: Condvar,
    /// Held by the thread that writes the file at that path, to its end: a reload may name a file again that an earlier thread
    /// still writes.
    files: Mutex<HashMap<PathBuf, Arc<Mutex<()>>>>,
}

#[derive(Debug, Default)]
struct Queues {
    sent: VecDeque<Arc<AuditRecord>>,
    unsent: VecDeque<Arc<AuditRecord>>,
    /// Records lost since the start: sent, unsent.
    lost: (u64, u64),
    /// Losses that are recorded in the file.
    recorded: (u64, u64),
    /// Number of started threads; only the newest continues.
    threads: u64,
    end: bool,
}

impl Shared {
    fn queues(&self) -> MutexGuard<'_, Queues> {
        self.queues.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn file(&self, path: &Path) -> Arc<Mutex<()>> {
        let mut files = self.files.lock().unwrap_or_else(PoisonError::into_inner);
        files.retain(|_, file| Arc::strong_count(file) > 1);
        files.entry(path.to_path_buf()).or_default().clone()
    }

    /// The record to write next; records of sent commands go first.
    fn next(&self) -> Option<(Arc<AuditRecord>, bool)> {
        let mut queues = self.queues();
        let sent = queues.sent.pop_front().map(|record| (record, true));
        sent.or_else(|| queues.unsent.pop_front().map(|record| (record, false)))
    }

    fn put_back(&self, record: Arc<AuditRecord>, sent: bool) {
        let mut queues = self.queues();
        let queue = if sent { &mut queues.sent } else { &mut queues.unsent };
        queue.push_front(record);
    }

    /// How many records wait, as text.
    fn waiting(&self) -> String {
        let queues = self.queues();
        format!(
            "{} records of commands that were sent and {} others wait in memory, where {} and {} have room",
            queues.sent.len(),
            queues.unsent.len(),
            WAITING.0,
            WAITING.1
        )
    }

    /// Waits until there is something to write, at most until `deadline`; returns whether this thread must end.
    fn wait(&self, thread: u64, deadline: Instant, for_records: bool) -> bool {
        let mut queues = self.queues();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let ready = for_records && !(queues.sent.is_empty() && queues.unsent.is_empty());
            let end = queues.end || queues.threads > thread;
            if end || ready || left.is_zero() {
                return end;
            }
            let waited = self.wake.wait_timeout(queues, left);
            queues = waited.map_or_else(|poisoned| poisoned.into_inner().0, |(queues, _)| queues);
        }
    }
}

impl AuditFile {
    /// Starts the thread that writes the audit.
    ///
    /// # Errors
    /// If the system does not provide a thread.
    pub fn start(options: AuditFileOptions) -> io::Result<AuditFile> {
        AuditFile::behind(Arc::default(), options)
    }

    /// Starts the thread that replaces this writer and takes over the waiting records and the number of lost ones.
    /// If an earlier thread still writes the same file, the new one waits for its end.
    ///
    /// # Errors
    /// If the system does not provide a thread: then this file continues to be written.
    pub fn succeed(&self, options: AuditFileOptions) -> io::Result<AuditFile> {
        AuditFile::behind(self.shared.clone(), options)
    }

    fn behind(shared: Arc<Shared>, options: AuditFileOptions) -> io::Result<AuditFile> {
        let (end, ended) = watch::channel(());
        let file = options.rotated();
        let own = shared.file(file.path());
        let mut queues = shared.queues();
        let number = queues.threads + 1;
        let writer = Writer::new(file, shared.clone(), number);
        std::thread::Builder::new().name("audit".to_string()).spawn(move || {
            // A panic of the thread before was logged.
            let _own = own.lock().unwrap_or_else(PoisonError::into_inner);
            writer.run();
            drop(end);
        })?;
        queues.threads = number;
        drop(queues);
        shared.wake.notify_all();
        Ok(AuditFile { options, shared, ended })
    }

    /// Options of the file.
    pub fn options(&self) -> &AuditFileOptions {
        &self.options
    }

    /// Queues a record; never waits for the disk.
    pub(super) fn push(&self, record: Arc<AuditRecord>, sent: bool) {
        let mut queues = self.shared.queues();
        let Queues {
            sent: first,
            unsent,
            lost,
            ..
        } = &mut *queues;
        let (queue, room, lost) = if sent {
            (first, WAITING.0, &mut lost.0)
        } else {
            (unsent, WAITING.1, &mut lost.1)
        };
        if queue.len() < room {
            queue.push_back(record);
        } else {
            *lost += 1;
        }
        self.shared.wake.notify_one();
    }

    /// Records lost since the start: those of commands that were sent, and all others.
    pub fn lost(&self) -> (u64, u64) {
        self.shared.queues().lost
    }

    /// Writes waiting records, as far as the disk accepts them, and ends the thread. A hanging disk blocks this
    /// call forever, so callers must set a time limit.
    pub async fn stop(&self) {
        self.shared.queues().end = true;
        self.shared.wake.notify_all();
        let mut ended = self.ended.clone();
        while ended.changed().await.is_ok() {}
    }
}

#[derive(Debug)]
struct Writer {
    file: Rotated,
    shared: Arc<Shared>,
    /// End of the chain of hashes; `None` until the file was opened for the first time.
    chain: Option<Chain>,
    /// Whether writing fails at present, which is logged once.
    failing: bool,
    /// Number of this thread among the writers.
    thread: u64,
    logged: (Option<Hash>, Instant),
}

impl Writer {
    fn new(file: Rotated, shared: Arc<Shared>, thread: u64) -> Writer {
        Writer {
            file,
            shared,
            chain: None,
            failing: false,
            thread,
            logged: (None, Instant::now()),
        }
    }

    fn run(mut self) {
        let mut tick = Instant::now();
        loop {
            let end = self.shared.wait(self.thread, tick, !self.failing);
            let due = end || Instant::now() >= tick;
            if due {
                tick = Instant::now() + SYNC;
            }
            let done = self.work(due);
            self.report(done, end);
            if end {
                return;
            }
        }
    }

    /// Writes what waits; `due` is once a second.
    fn work(&mut self, due: bool) -> io::Result<()> {
        if due && self.file.is_replaced() {
            self.file.close();
        }
        while let Some((record, sent)) = self.shared.next() {
            let entry = if sent {
                Entry::Sent(&record)
            } else {
                Entry::NotSent(&record)
            };
            if let Err(error) = self.write(&entry) {
                self.shared.put_back(record, sent);
                return Err(error);
            }
        }
        if !due {
            return Ok(());
        }
        let (lost, recorded) = {
            let queues = self.shared.queues();
            (queues.lost, queues.recorded)
        };
        let (sent, not_sent) = (lost.0 - recorded.0, lost.1 - recorded.1);
        if sent + not_sent > 0 {
            let time = SystemTime::now();
            self.write(&Entry::Lost { time, sent, not_sent })?;
            self.shared.queues().recorded = lost;
            tracing::warn!(
                target: "drivegate::command::audit", "audit file: {sent} records of commands that were sent and {not_sent} others were lost; the log has them"
            );
        }
        if !self.file.is_open() {
            self.open()?;
        }
        self.file.sync()
    }

    /// Logs the start and the end of a failure once each, and at intervals the hash of the last line.
    fn report(&mut self, done: io::Result<()>, end: bool) {
        let path = self.file.path().to_path_buf();
        let path = path.display();
        match done {
            Ok(()) if std::mem::replace(&mut self.failing, false) => {
                tracing::warn!(target: "drivegate::command::audit", "audit file: writing to {path} again");
            }
            Ok(()) => {}
            Err(error) => {
                self.file.close();
                if !std::mem::replace(&mut self.failing, true) {
                    tracing::error!(
                        target: "drivegate::command::audit", "audit file: cannot write {path}: {error}; commands are \
                                                              still carried out and are in the log; {}; check [audit] \
                                                              and the disk",
                        self.shared.waiting()
                    );
                }
                let queues = self.shared.queues();
                if end && queues.end {
                    let (sent, others) = (queues.sent.len(), queues.unsent.len());
                    tracing::error!(
                        target: "drivegate::command::audit", "audit file: {sent} records of commands that were sent \
                                                              and {others} others have not been written"
                    );
                }
            }
        }
        let hash = self.chain.filter(|chain| chain.seq > 0).map(|chain| chain.last);
        if hash != self.logged.0 && (self.logged.0.is_none() || end || self.logged.1.elapsed() >= HASH_LOGGED) {
            self.logged = (hash, Instant::now());
            if let Some(Chain { seq, last }) = self.chain {
                tracing::info!(target: "audit", file = %path, seq, hash = %last, "last line of the audit file");
            }
        }
    }

    fn write(&mut self, entry: &Entry<'_>) -> io::Result<()> {
        if !self.file.is_open() {
            self.open()?;
        }
        let chain = self.chain.unwrap_or_default();
        let (line, after) = chain.line(entry)?;
        if self.file.is_full(line.len()) {
            self.file.rotate()?;
            self.open()?;
        }
        // A part of a line that could not be removed is named when the file is opened again.
        self.file.append(&line)?;
        self.chain = Some(after);
        Ok(())
    }

    /// Opens the file and finds the end of the chain: in the file itself or, if it is empty, in memory or in the
    /// previous file.
    fn open(&mut self) -> io::Result<()> {
        let opened = self.find_end();
        if opened.is_err() {
            self.file.close();
        }
        opened
    }

    fn find_end(&mut self) -> io::Result<()> {
        let (file, bytes) = self.file.open()?;
        let found = read_tail(file, bytes)?;
        let (fragment, ended) = match found {
            Some(tail) => (tail.fragment, tail.ended),
            None => only_fragment(file, bytes)?,
        };
        let before = match (found, self.chain) {
            (Some(tail), _) => Some(tail.chain),
            (None, Some(chain)) => Some(chain),
            (None, None) => last_of(&self.file.older(1))?,
        };
        self.chain = Some(before.unwrap_or_default());
        if bytes > 0 && !ended {
            self.file.append(b"\n")?;
        }
        if let Some((bytes, sha256)) = fragment {
            tracing::warn!(
                target: "drivegate::command::audit", "audit file: {} ends with {bytes} bytes of a truncated line; \
                                                      they are kept, and recorded as a fragment",
                self.file.path().display()
            );
            let time = SystemTime::now();
            self.write(&Entry::Fragment { time, bytes, sha256 })?;
        }
        Ok(())
    }
}

/// The end of the chain in a file, which may not exist.
fn last_of(path: &Path) -> io::Result<Option<Chain>> {
    match File::open(path) {
        Ok(mut file) => {
            let bytes = file.metadata()?.len();
            Ok(read_tail(&mut file, bytes)?.map(|tail| tail.chain))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// The end of the chain in a file of `bytes` bytes; `None` if the file has no entry.
fn read_tail(file: &mut File, bytes: u64) -> io::Result<Option<Tail>> {
    let mut length = 64 << 10;
    loop {
        let is_whole = length >= bytes;
        let window = read_end(file, bytes, length)?;
        match chain::tail(&window, is_whole) {
            None if !is_whole && length < LONGEST_TAIL => length *= 2,
            found => return Ok(found),
        }
    }
}

fn read_end(file: &mut File, bytes: u64, length: u64) -> io::Result<Vec<u8>> {
    let mut window = Vec::new();
    file.seek(SeekFrom::Start(bytes.saturating_sub(length)))?;
    file.take(length.min(bytes)).read_to_end(&mut window)?;
    Ok(window)
}

/// Checks a file without an entry: either only the fragment of its first line, or not an audit file.
fn only_fragment(file: &mut File, bytes: u64) -> io::Result<(Option<(u64, Hash)>, bool)> {
    let window = read_end(file, bytes, LONGEST_TAIL)?;
    if bytes > LONGEST_TAIL || window.iter().filter(|byte| **byte == b'\n').count() > 1 {
        return Err(io::Error::other(
            "it is not an audit file; move it, or set another `file`",
        ));
    }
    Ok(chain::fragment(&window))
}

#[cfg(test)]
mod tests;
