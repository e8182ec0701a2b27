//! Passes messages that must not be lost to the outbox and, through a separate thread, to the disk: however slow
//! the disk is, nothing else waits for it.
//!
//! While no message waits on disk, a new message goes to the outbox at once, and also to the disk in case the
//! process ends before it is acknowledged. Otherwise it waits behind the messages on disk.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use flume::{Receiver, RecvTimeoutError, Sender, TrySendError};
use tokio::sync::mpsc;

use super::Buffer;
use super::message_log::MessageLog;
use super::outbox::{KEPT_BYTES, Message};
use drivegate_core::files::names::MQTT_TOPICS;
use drivegate_north::{MqttKind, NorthState};

/// Maximum number of jobs that wait for the disk: a burst of events and its acknowledgements. The size of their
/// messages is at most [`KEPT_BYTES`].
const JOBS: usize = 2 * drivegate_core::event::BURST;
/// Messages that are written at a time.
const BATCH: usize = 1024;
/// Time after which messages on disk survive a power failure.
const SYNC: Duration = Duration::from_secs(1);
/// Attempts to lock the directory, and the wait between them: a process that is stopping may still have it locked.
const LOCK_ATTEMPTS: u32 = 20;
const LOCK_WAIT: Duration = Duration::from_millis(50);

/// Number of a message: from 1 upward in this run; 0 and negative numbers are messages of earlier runs.
pub(super) type Number = i64;

enum Job {
    /// Append this message; the flag is true if it is already in the outbox.
    Append(Message, bool),
    /// Note that all messages up to this one are acknowledged.
    Acknowledge(Number),
    /// Load at most this number of messages.
    Load(usize),
    /// The retained topics that the gateway publishes from now on.
    Topics(Vec<String>),
}

/// A report from the disk thread.
#[derive(Debug)]
pub(super) enum Loaded {
    /// Number of messages from earlier runs, and the topics published in those runs.
    Opened { waiting: u64, topics: Vec<String> },
    /// The next messages; no message up to `through` is left on disk.
    Messages {
        messages: Vec<(Number, Message)>,
        through: Number,
    },
}

/// The store of one kind of message.
#[derive(Debug, Default)]
pub(super) struct Store {
    disk: Option<Disk>,
    /// Number of messages given to the disk thread.
    pushed: Number,
    /// Number up to which no messages wait on disk.
    through: Number,
    /// Number up to which all messages are acknowledged; `told` is the number that the disk thread knows.
    acknowledged: Number,
    told: Number,
    opened: bool,
    loading: bool,
}

#[derive(Debug)]
struct Disk {
    jobs: Sender<Job>,
    loaded: mpsc::Receiver<Loaded>,
    shared: Arc<Shared>,
}

/// State that the client and the thread share.
#[derive(Debug)]
struct Shared {
    stats: Arc<NorthState>,
    /// Kind of all messages of the store.
    kind: MqttKind,
    /// Size of the messages among the jobs.
    bytes: AtomicUsize,
    /// Number of the message up to which nothing is kept, because the buffer was full.
    gone: AtomicI64,
    /// Number of lost messages among those after `gone`.
    missing: AtomicU64,
}

impl Shared {
    fn new(stats: Arc<NorthState>, kind: MqttKind) -> Arc<Shared> {
        Arc::new(Shared {
            stats,
            kind,
            bytes: AtomicUsize::new(0),
            gone: AtomicI64::new(Number::MIN),
            missing: AtomicU64::new(0),
        })
    }

    fn lost(&self, count: u64) {
        self.stats.mqtt.lost(self.kind, count);
    }
}

impl Store {
    /// Opens the buffer with this name for messages of this kind, without waiting for it; without a buffer,
    /// messages are not kept. If the buffer cannot be used, that is logged and messages wait in memory.
    pub(super) fn open(buffer: Option<Buffer>, name: &'static str, stats: &Arc<NorthState>, kind: MqttKind) -> Store {
        let Some(buffer) = buffer else {
            return Store::default();
        };
        // This channel allocates memory as it fills: the channel of the standard library would allocate the space
        // for all jobs at the start.
        let (jobs, todo) = flume::bounded(JOBS);
        let (sender, loaded) = mpsc::channel(4);
        let shared = Shared::new(stats.clone(), kind);
        let of_thread = shared.clone();
        let work = move || Thread::open(&buffer, name, sender, of_thread).work(&todo);
        match std::thread::Builder::new().name(name.to_string()).spawn(work) {
            Ok(_) => Store {
                disk: Some(Disk { jobs, loaded, shared }),
                ..Store::default()
            },
            Err(error) => {
                tracing::error!(target: "drivegate::north::mqtt", "the system provides no thread for the MQTT buffer: {error}; it is not used");
                Store::default()
            }
        }
    }

    /// Stores a message. Returns it with its number if it must be sent now, or if it cannot be stored; `room` means
    /// that the outbox has room.
    pub(super) fn push(&mut self, message: Message, room: bool) -> Option<(Option<Number>, Message)> {
        let Some(disk) = &self.disk else {
            return Some((None, message));
        };
        let now = self.opened && room && self.through == self.pushed;
        if disk.append(&message, now) {
            self.pushed += 1;
        } else if now {
            return Some((None, message));
        } else {
            disk.shared.lost(1);
            return None;
        }
        if now {
            self.through = self.pushed;
        }
        now.then_some((Some(self.pushed), message))
    }

    /// Loads messages from disk, if there are any that are not in progress.
    pub(super) fn load(&mut self, room: usize) {
        let Some(disk) = &self.disk else { return };
        if room > 0 && self.opened && !self.loading && self.through < self.pushed {
            self.loading = disk.jobs.try_send(Job::Load(room)).is_ok();
        }
    }

    /// The next report of the disk thread; waits until there is one. Cancel safe.
    pub(super) async fn next(&mut self) -> Loaded {
        let report = match &mut self.disk {
            Some(disk) => disk.loaded.recv().await,
            None => None,
        };
        match report {
            Some(report) => report,
            None => std::future::pending().await,
        }
    }

    /// Processes a report; returns the messages to send, and the topics of earlier runs.
    pub(super) fn take(&mut self, loaded: Loaded) -> (Vec<(Number, Message)>, Vec<String>) {
        match loaded {
            Loaded::Opened { waiting, topics } => {
                let older = Number::try_from(waiting).unwrap_or(Number::MAX);
                // Messages of this run may be waiting already.
                (self.opened, self.through) = (true, -older);
                (self.acknowledged, self.told) = (-older, -older);
                (Vec::new(), topics)
            }
            Loaded::Messages { messages, through } => {
                (self.loading, self.through) = (false, through);
                (messages, Vec::new())
            }
        }
    }

    /// Notes that all messages before `oldest`, which waits in the outbox, are acknowledged; with `None`, all that
    /// were loaded.
    pub(super) fn acknowledge(&mut self, oldest: Option<Number>) {
        let acknowledged = oldest.map_or(self.through, |oldest| oldest - 1);
        self.acknowledged = self.acknowledged.max(acknowledged);
        if let Some(disk) = &self.disk
            && self.opened
            && self.told < self.acknowledged
            && disk.jobs.try_send(Job::Acknowledge(self.acknowledged)).is_ok()
        {
            self.told = self.acknowledged;
        }
    }

    /// Keeps the topics that are published, for the next run.
    pub(super) fn remember(&self, topics: Vec<String>) {
        if let Some(disk) = &self.disk {
            let kept = disk.jobs.try_send(Job::Topics(topics));
            if let Err(TrySendError::Full(_)) = kept {
                tracing::warn!(target: "drivegate::north::mqtt", "the MQTT buffer is too slow; topics removed before the next start are not cleared");
            }
        }
    }

    /// Number up to which no messages are stored any more, because the buffer was full; messages up to it that are
    /// in the outbox are lost.
    pub(super) fn gone(&self) -> Number {
        let gone = self.disk.as_ref().map(|disk| disk.shared.gone.load(Ordering::Relaxed));
        gone.unwrap_or(Number::MIN)
    }

    /// Number of messages on disk that are not in the outbox.
    pub(super) fn waiting(&self) -> u64 {
        let Some(disk) = &self.disk else { return 0 };
        let kept = u64::try_from(self.pushed - self.through.max(self.gone())).unwrap_or_default();
        kept.saturating_sub(disk.shared.missing.load(Ordering::Relaxed))
    }

    /// Writes what waits and ends; the caller limits the time.
    pub(super) async fn close(self) {
        if let Some(Disk { jobs, mut loaded, .. }) = self.disk {
            drop(jobs);
            // The channel ends after the last report.
            while loaded.recv().await.is_some() {}
        }
    }
}

impl Disk {
    /// Passes a message to the disk thread, unless too many bytes wait for it.
    fn append(&self, message: &Message, sent: bool) -> bool {
        let bytes = message.bytes();
        if self.shared.bytes.load(Ordering::Relaxed) + bytes > KEPT_BYTES {
            return false;
        }
        // The bytes are counted first, so that the thread cannot subtract them before.
        self.shared.bytes.fetch_add(bytes, Ordering::Relaxed);
        let given = self.jobs.try_send(Job::Append(message.clone(), sent)).is_ok();
        if !given {
            self.shared.bytes.fetch_sub(bytes, Ordering::Relaxed);
        }
        given
    }
}

/// The thread that owns the files.
struct Thread {
    dir: PathBuf,
    journal: MessageLog,
    report: mpsc::Sender<Loaded>,
    shared: Arc<Shared>,
    /// The topics to be kept for the next run.
    topics: Vec<String>,
    /// The last message number of earlier runs.
    base: u64,
    /// Whether the last write failed; logged once.
    failing: bool,
    synced: Instant,
}

impl Thread {
    fn open(buffer: &Buffer, name: &'static str, report: mpsc::Sender<Loaded>, shared: Arc<Shared>) -> Thread {
        let dir = buffer.dir.clone();
        let mut attempts = LOCK_ATTEMPTS;
        let journal = loop {
            attempts -= 1;
            match MessageLog::open(&dir, name, buffer.max_bytes) {
                Ok(journal) => break journal,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock && attempts > 0 => {
                    std::thread::sleep(LOCK_WAIT);
                }
                Err(error) => {
                    tracing::error!(
                        target: "drivegate::north::mqtt", "cannot keep {name} in {}: {error}; keeping them in memory; check mqtt.buffer",
                        dir.display()
                    );
                    break MessageLog::in_memory();
                }
            }
        };
        let waiting = journal.waiting();
        if waiting > 0 {
            tracing::info!(
                target: "drivegate::north::mqtt", "{waiting} earlier {name} in {} are waiting for the broker",
                dir.display()
            );
        }
        let thread = Thread {
            base: journal.last,
            dir,
            journal,
            report,
            shared,
            topics: Vec::new(),
            failing: false,
            synced: Instant::now(),
        };
        let topics = thread.read_topics();
        thread.report(Loaded::Opened { waiting, topics });
        thread
    }

    /// Executes jobs until all senders of jobs have been dropped.
    fn work(mut self, jobs: &Receiver<Job>) {
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
                    Job::Acknowledge(number) => self.journal.acknowledge(self.base.saturating_add_signed(number)),
                    Job::Load(most) => load = Some(most),
                    Job::Topics(topics) => {
                        self.topics = topics;
                        self.write_topics();
                    }
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

    /// Converts a number of the journal to the client's.
    fn number(&self, number: u64) -> Number {
        number as Number - self.base as Number
    }

    fn load(&mut self, most: usize) {
        let taken = self.journal.take(most);
        let messages: Vec<_> = taken.into_iter().map(|(n, m)| (self.number(n), m)).collect();
        let through = self.number(self.journal.through());
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
        if self.journal.take_wiped() && !self.topics.is_empty() {
            self.write_topics();
        }
        self.shared.lost(self.journal.take_lost());
        let (gone, missing) = (self.number(self.journal.lost_up_to), self.journal.counted);
        self.shared.gone.store(gone, Ordering::Relaxed);
        self.shared.missing.store(missing, Ordering::Relaxed);
        if self.synced.elapsed() >= SYNC {
            self.sync();
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

    fn topics_file(&self) -> PathBuf {
        self.dir.join(MQTT_TOPICS)
    }

    fn read_topics(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.topics_file()).unwrap_or_default();
        text.lines().map(str::to_string).collect()
    }

    fn write_topics(&self) {
        let (file, new) = (self.topics_file(), self.dir.join(format!("{MQTT_TOPICS}.new")));
        let written = std::fs::write(&new, self.topics.join("\n")).and_then(|()| std::fs::rename(&new, &file));
        if let Err(error) = written {
            // An incomplete file would only take room from the messages.
            let _ = std::fs::remove_file(&new);
            let file = file.display();
            tracing::warn!(target: "drivegate::north::mqtt", "{file}: {error}; topics removed before the next start are not cleared");
        }
    }
}

#[cfg(test)]
mod tests;
