//! The thread that reads and writes the files of one kind of message.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use flume::{Receiver, RecvTimeoutError};
use tokio::sync::mpsc;

use super::super::Buffer;
use super::super::message_log::MessageLog;
use super::topics_file::TopicsFile;
use super::{Job, Loaded, Shared, Writer};

/// Messages that are written at a time.
const BATCH: usize = 1024;
/// Time after which messages on disk survive a power failure.
const SYNC: Duration = Duration::from_secs(1);
/// Attempts to lock the directory, and the wait between them: a process that is stopping may still have it locked. The
/// client before a reload is waited for longer.
pub(super) const LOCK_ATTEMPTS: u32 = 20;
pub(super) const LOCK_WAIT: Duration = Duration::from_millis(50);
/// Attempts while the client before a reload still writes: a minute, in which new messages wait for the buffer.
const WRITTEN_ATTEMPTS: u32 = 1200;

/// The thread that owns the files.
pub(super) struct Thread {
    dir: PathBuf,
    journal: MessageLog,
    report: mpsc::Sender<Loaded>,
    shared: Arc<Shared>,
    /// The list of topics; `None` without the lock, because it then belongs to another gateway.
    topics: Option<TopicsFile>,
    /// Whether the last write failed; logged once.
    failing: bool,
    synced: Instant,
}

impl Thread {
    /// Opens the files of messages with this name, and reports the messages of earlier runs.
    pub(super) fn open(
        buffer: &Buffer,
        name: &'static str,
        report: mpsc::Sender<Loaded>,
        (shared, before): (Arc<Shared>, &[Writer]),
    ) -> Thread {
        let dir = buffer.dir.clone();
        let opened = open_log(buffer, name, before);
        let topics = opened.is_some().then(|| TopicsFile::in_dir(&dir));
        let journal = opened.unwrap_or_else(MessageLog::in_memory);
        let waiting = journal.waiting();
        if waiting > 0 {
            tracing::info!(
                target: "drivegate::north::mqtt", "{waiting} earlier {name} in {} are waiting for the broker",
                dir.display()
            );
        }
        let thread = Thread {
            topics,
            dir,
            journal,
            report,
            shared,
            failing: false,
            synced: Instant::now(),
        };
        thread.report(Loaded::Opened {
            through: thread.journal.through(),
            last: thread.journal.last,
            topics: thread.topics.as_ref().map(TopicsFile::read).unwrap_or_default(),
        });
        thread
    }

    /// Executes jobs until all senders of jobs have been dropped.
    pub(super) fn work(mut self, jobs: &Receiver<Job>) {
        loop {
            let mut load = None;
            let mut next = match jobs.recv_timeout(SYNC) {
                Ok(job) => Some(job),
                Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            let mut count = 0;
            while let Some(job) = next.take() {
                match job {
                    Job::Append(message, sent) => {
                        self.shared.bytes.fetch_sub(message.bytes(), Ordering::Relaxed);
                        self.journal.append(message, sent);
                    }
                    Job::Acknowledge(number) => self.journal.acknowledge(number),
                    Job::Load(most) => load = Some(most),
                    Job::Topics(topics) => self.with_topics(|file| file.keep(topics)),
                }
                count += 1;
                // The report covers the messages present at this moment, no later ones.
                if count < BATCH && load.is_none() {
                    next = jobs.try_recv().ok();
                }
            }
            if let Some(most) = load {
                self.load(most);
            }
            self.write();
        }
        self.write();
        self.sync();
        self.with_topics(TopicsFile::retry);
        let unkept = self.journal.unkept();
        if unkept > 0 {
            self.shared.lost(unkept);
            tracing::error!(
                target: "drivegate::north::mqtt", "{unkept} messages that the broker did not accept are lost: {} does \
                                                   not accept them either; check mqtt.buffer",
                self.dir.display()
            );
        }
    }

    fn load(&mut self, most: usize) {
        let messages = self.journal.take(most);
        let through = self.journal.through();
        self.report(Loaded::Messages { messages, through });
    }

    fn report(&self, loaded: Loaded) {
        // At most two reports are on their way; the client may have ended.
        let _ = self.report.try_send(loaded);
    }

    fn write(&mut self) {
        let written = self.journal.write();
        match written {
            Ok(true) if std::mem::take(&mut self.failing) => {
                tracing::info!(target: "drivegate::north::mqtt", "the MQTT buffer in {} works again", self.dir.display());
            }
            Err(error) if !std::mem::replace(&mut self.failing, true) => {
                tracing::error!(
                    target: "drivegate::north::mqtt", "cannot write to {}: {error}; the newest messages wait in memory; check mqtt.buffer",
                    self.dir.display()
                );
            }
            _ => {}
        }
        if self.journal.take_wiped() {
            self.with_topics(TopicsFile::restore);
        }
        self.shared.lost(self.journal.take_lost());
        let gone = self.journal.lost_up_to.get();
        self.shared.gone.store(gone, Ordering::Relaxed);
        self.shared.missing.store(self.journal.counted, Ordering::Relaxed);
        if self.synced.elapsed() >= SYNC {
            self.sync();
            self.with_topics(TopicsFile::retry);
        }
    }

    fn with_topics(&mut self, act: impl FnOnce(&mut TopicsFile)) {
        if let Some(file) = &mut self.topics {
            act(file);
        }
    }

    fn sync(&mut self) {
        if let Some(file) = self.journal.unsynced()
            && let Err(error) = file.sync_data()
        {
            let dir = self.dir.display();
            tracing::warn!(target: "drivegate::north::mqtt", "{dir}: {error}; buffered messages may not survive a power failure");
        }
        self.synced = Instant::now();
    }
}

/// Opens and locks the log, after the writers `before`, which have locked it and write what they have; `None` if that is
/// not possible, which is logged.
fn open_log(buffer: &Buffer, name: &'static str, before: &[Writer]) -> Option<MessageLog> {
    let mut attempts = 0;
    loop {
        // A writer unlocks the log before it ends, so the attempt after its end finds no lock of it.
        let is_written = attempts < WRITTEN_ATTEMPTS && before.iter().any(Writer::is_running);
        if is_written && attempts >= LOCK_ATTEMPTS {
            // All of them come first, in whatever order they end.
            attempts += 1;
            std::thread::sleep(LOCK_WAIT);
            continue;
        }
        match MessageLog::open(&buffer.dir, name, buffer.max_bytes) {
            Ok(log) => return Some(log),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock && (is_written || attempts < LOCK_ATTEMPTS) => {
                attempts += 1;
                if attempts == LOCK_ATTEMPTS && is_written {
                    tracing::warn!(
                        target: "drivegate::north::mqtt", "{}: the disk is slow, {name} from before the reload are \
                                                           still being written; new ones wait",
                        buffer.dir.display()
                    );
                }
                std::thread::sleep(LOCK_WAIT);
            }
            Err(error) => {
                tracing::error!(
                    target: "drivegate::north::mqtt", "cannot keep {name} in {}: {error}; keeping them in memory; check mqtt.buffer",
                    buffer.dir.display()
                );
                return None;
            }
        }
    }
}
