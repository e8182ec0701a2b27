//! Passes messages that must not be lost to the outbox and, through a separate thread, to the disk: however slow
//! the disk is, nothing else waits for it.
//!
//! While no message waits on disk, a new message goes to the outbox at once, and also to the disk in case the
//! process ends before it is acknowledged. Otherwise it waits behind the messages on disk.

mod thread;
mod topics_file;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Weak};

use flume::{Sender, TrySendError};
use tokio::sync::mpsc;

use self::thread::Thread;
use super::Buffer;
use super::handover::Handover;
use super::number::MessageNumber;
use super::outbox::{KEPT_BYTES, Message};
use drivegate_north::{MqttKind, NorthState};

/// Maximum number of jobs that wait for the disk: a burst of events and its acknowledgements. The size of their
/// messages is at most [`KEPT_BYTES`].
const JOBS: usize = 2 * drivegate_core::event::BURST;

enum Job {
    /// Append this message; the flag is true if it is already in the outbox.
    Append(Message, bool),
    /// Note that all messages up to this one are acknowledged.
    Acknowledge(MessageNumber),
    /// Load at most this number of messages.
    Load(usize),
    /// The retained topics that the gateway publishes from now on.
    Topics(Vec<String>),
}

/// A report from the disk thread.
#[derive(Debug)]
pub(super) enum Loaded {
    /// The messages of earlier runs that wait are those after `through`, up to `last`; and the topics of those runs.
    Opened {
        through: MessageNumber,
        last: MessageNumber,
        topics: Vec<String>,
    },
    /// The next messages; no message up to `through` is left on disk.
    Messages {
        messages: Vec<(MessageNumber, Message)>,
        through: MessageNumber,
    },
}

/// The store of one kind of message.
#[derive(Debug, Default)]
pub(super) struct Store {
    disk: Option<Disk>,
}

#[derive(Debug)]
struct Disk {
    jobs: Sender<Job>,
    loaded: mpsc::Receiver<Loaded>,
    shared: Arc<Shared>,
    progress: Progress,
}

/// How far the messages have come.
#[derive(Debug)]
enum Progress {
    /// The disk thread has not reported the messages of earlier runs, which so many messages of this run follow.
    Opening(u64),
    Open(Numbers),
}

#[derive(Debug)]
struct Numbers {
    /// The last message given to the disk thread.
    last: MessageNumber,
    /// Number up to which no messages wait on disk.
    through: MessageNumber,
    /// Number up to which all messages are acknowledged; `noted` is the number that the disk thread knows.
    acknowledged: MessageNumber,
    noted: MessageNumber,
    loading: bool,
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
    gone: AtomicU64,
    /// Number of lost messages among those after `gone`.
    missing: AtomicU64,
}

/// A thread that writes, or waits to write, the messages of one kind in a directory.
#[derive(Debug, Clone)]
pub(super) struct Writer {
    kind: MqttKind,
    dir: PathBuf,
    /// Dropped by the thread when it ends.
    shared: Weak<Shared>,
}

impl Writer {
    fn is_running(&self) -> bool {
        self.shared.strong_count() > 0
    }

    /// Adds the writer of a new store; returns those before it that have the same files and are still running.
    fn begin(stats: &NorthState, kind: MqttKind, dir: &Path, shared: &Arc<Shared>) -> Vec<Writer> {
        let handover = Handover::of(stats);
        let mut left = handover.lock();
        left.writers.retain(Writer::is_running);
        let same = |writer: &&Writer| writer.kind == kind && writer.dir == dir;
        let before = left.writers.iter().filter(same).cloned().collect();
        left.writers.push(Writer {
            kind,
            dir: dir.to_path_buf(),
            shared: Arc::downgrade(shared),
        });
        before
    }
}

impl Shared {
    fn new(stats: Arc<NorthState>, kind: MqttKind) -> Arc<Shared> {
        Arc::new(Shared {
            stats,
            kind,
            bytes: AtomicUsize::new(0),
            gone: AtomicU64::new(MessageNumber::NONE.get()),
            missing: AtomicU64::new(0),
        })
    }

    fn lost(&self, count: u64) {
        self.stats.mqtt.lost(self.kind, count);
    }

    fn gone(&self) -> MessageNumber {
        MessageNumber::new(self.gone.load(Ordering::Relaxed))
    }
}

impl Progress {
    fn opened(&mut self) -> Option<&mut Numbers> {
        match self {
            Progress::Opening(_) => None,
            Progress::Open(numbers) => Some(numbers),
        }
    }

    /// Whether no message on disk precedes the next one.
    fn is_next(&self) -> bool {
        matches!(self, Progress::Open(numbers) if numbers.through == numbers.last)
    }

    /// Counts a message that was given to the disk thread; returns its number if it does not wait on disk.
    fn append(&mut self, now: bool) -> Option<MessageNumber> {
        match self {
            Progress::Opening(count) => {
                *count += 1;
                None
            }
            Progress::Open(numbers) => {
                numbers.last = numbers.last.next();
                now.then(|| {
                    numbers.through = numbers.last;
                    numbers.last
                })
            }
        }
    }

    /// Continues after the messages of earlier runs.
    fn open(&mut self, through: MessageNumber, last: MessageNumber) {
        // Messages of this run may be waiting already.
        if let Progress::Opening(count) = *self {
            *self = Progress::Open(Numbers {
                last: last.plus(count),
                through,
                acknowledged: through,
                noted: through,
                loading: false,
            });
        }
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
        let before = Writer::begin(stats, kind, &buffer.dir, &shared);
        let work = move || Thread::open(&buffer, name, sender, (of_thread, &before)).work(&todo);
        match std::thread::Builder::new().name(name.to_string()).spawn(work) {
            Ok(_) => Store {
                disk: Some(Disk {
                    jobs,
                    loaded,
                    shared,
                    progress: Progress::Opening(0),
                }),
            },
            Err(error) => {
                tracing::error!(target: "drivegate::north::mqtt", "the system provides no thread for the MQTT buffer: {error}; it is not used");
                Store::default()
            }
        }
    }

    /// Stores a message. Returns it with its number if it must be sent now, or if it cannot be stored; `room` means
    /// that the outbox has room.
    pub(super) fn push(&mut self, message: Message, room: bool) -> Option<(Option<MessageNumber>, Message)> {
        let Some(disk) = &mut self.disk else {
            return Some((None, message));
        };
        let now = room && disk.progress.is_next();
        if disk.append(&message, now) {
            let number = disk.progress.append(now)?;
            return Some((Some(number), message));
        }
        if now {
            return Some((None, message));
        }
        disk.shared.lost(1);
        None
    }

    /// Loads messages from disk, if there are any that are not in progress.
    pub(super) fn load(&mut self, room: usize) {
        if let Some(disk) = &mut self.disk
            && let Progress::Open(numbers) = &mut disk.progress
            && room > 0
            && !numbers.loading
            && numbers.through < numbers.last
        {
            numbers.loading = disk.jobs.try_send(Job::Load(room)).is_ok();
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
    pub(super) fn take(&mut self, loaded: Loaded) -> (Vec<(MessageNumber, Message)>, Vec<String>) {
        let progress = self.disk.as_mut().map(|disk| &mut disk.progress);
        match loaded {
            Loaded::Opened { through, last, topics } => {
                if let Some(progress) = progress {
                    progress.open(through, last);
                }
                (Vec::new(), topics)
            }
            Loaded::Messages { messages, through } => {
                if let Some(numbers) = progress.and_then(Progress::opened) {
                    (numbers.loading, numbers.through) = (false, through);
                }
                (messages, Vec::new())
            }
        }
    }

    /// Notes that all messages before `oldest`, which waits in the outbox, are acknowledged; with `None`, all that
    /// were loaded.
    pub(super) fn acknowledge(&mut self, oldest: Option<MessageNumber>) {
        let Some(disk) = &mut self.disk else { return };
        let Progress::Open(numbers) = &mut disk.progress else {
            return;
        };
        let acknowledged = oldest.map_or(numbers.through, MessageNumber::previous);
        numbers.acknowledged = numbers.acknowledged.max(acknowledged);
        if numbers.noted < numbers.acknowledged && disk.jobs.try_send(Job::Acknowledge(numbers.acknowledged)).is_ok() {
            numbers.noted = numbers.acknowledged;
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
    pub(super) fn gone(&self) -> MessageNumber {
        let gone = self.disk.as_ref().map(|disk| disk.shared.gone());
        gone.unwrap_or(MessageNumber::NONE)
    }

    /// Number of messages on disk that are not in the outbox.
    pub(super) fn waiting(&self) -> u64 {
        let Some(disk) = &self.disk else { return 0 };
        let kept = match &disk.progress {
            Progress::Opening(count) => *count,
            Progress::Open(numbers) => numbers.last.since(numbers.through.max(disk.shared.gone())),
        };
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

#[cfg(test)]
mod tests;
