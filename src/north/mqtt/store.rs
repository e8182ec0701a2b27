//! Stores the events that wait for the broker: on disk if a buffer is configured and usable, else in memory.

use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::Buffer;
use super::journal::{Journal, RecordId};
use super::outbox::{Message, Outbox};

/// Time after which events on disk survive a power failure.
const SYNC: Duration = Duration::from_secs(1);
/// Attempts to lock the directory, and the wait between them: a process that is stopping may still hold it.
const LOCK_ATTEMPTS: u32 = 20;
const LOCK_WAIT: Duration = Duration::from_millis(50);

/// Passes events to the outbox, through the disk if possible.
#[derive(Debug, Default)]
pub(super) struct EventStore {
    dir: PathBuf,
    journal: Option<Journal>,
    /// Whether the last write failed; logged once.
    failing: bool,
    refusals_dropped: u64,
    synced: Option<Instant>,
}

impl EventStore {
    /// Opens the buffer. If it cannot be used, that is logged and events are kept in memory.
    pub(super) async fn open(buffer: Option<Buffer>) -> EventStore {
        let Some(Buffer { dir, max_bytes }) = buffer else {
            return EventStore::default();
        };
        let mut attempts = LOCK_ATTEMPTS;
        let journal = loop {
            attempts -= 1;
            let path = dir.clone();
            let opened = tokio::task::spawn_blocking(move || Journal::open(&path, max_bytes)).await;
            match opened.unwrap_or_else(|e| Err(io::Error::other(e))) {
                Ok(journal) => break Some(journal),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock && attempts > 0 => {
                    tokio::time::sleep(LOCK_WAIT).await;
                }
                Err(error) => {
                    log_unusable(&dir, &error);
                    break None;
                }
            }
        };
        let waiting = journal.as_ref().map_or(0, Journal::unloaded);
        if waiting > 0 {
            tracing::info!(
                "{waiting} earlier events in {} are waiting for the broker",
                dir.display()
            );
        }
        EventStore {
            dir,
            journal,
            ..EventStore::default()
        }
    }

    /// Stores an event. Refusals have a part of the room only, so that they push out no other event; those beyond it are
    /// dropped.
    pub(super) fn push(&mut self, message: Message, is_refusal: bool, outbox: &mut Outbox) {
        if is_refusal && self.journal.as_ref().map_or_else(|| outbox.is_busy(), Journal::is_busy) {
            self.refusals_dropped += 1;
            return;
        }
        match self.journal.as_mut().map(|journal| journal.append(&message)) {
            Some(Ok(())) => self.failing = false,
            Some(Err(error)) => {
                if !std::mem::replace(&mut self.failing, true) {
                    log_unusable(&self.dir, &error);
                }
                outbox.push_event(message, None);
            }
            None => outbox.push_event(message, None),
        }
    }

    /// Loads events from disk while the outbox has room.
    pub(super) fn refill(&mut self, outbox: &mut Outbox) {
        let Some(journal) = &mut self.journal else { return };
        for _ in 0..outbox.room() {
            match journal.load() {
                Some((record, message)) => outbox.push_event(message, Some(record)),
                None => return,
            }
        }
    }

    /// Marks the event of that record as acknowledged.
    pub(super) fn acknowledge(&mut self, record: RecordId) {
        if let Some(Err(error)) = self.journal.as_mut().map(|journal| journal.acknowledge(record)) {
            tracing::warn!("{}: {error}; events may be delivered twice", self.dir.display());
        }
    }

    /// Syncs the written events to disk in another thread, at most once a second.
    pub(super) fn sync(&mut self, now: Instant) {
        if self
            .synced
            .is_some_and(|last| now.saturating_duration_since(last) < SYNC)
        {
            return;
        }
        self.synced = Some(now);
        if let Some(file) = self.journal.as_mut().and_then(Journal::unsynced) {
            let dir = self.dir.display().to_string();
            tokio::task::spawn_blocking(move || {
                if let Err(error) = file.sync_data() {
                    tracing::warn!("{dir}: {error}; buffered events may not survive a power failure");
                }
            });
        }
    }

    /// Number of events on disk that are not in the outbox.
    pub(super) fn waiting(&self) -> u64 {
        self.journal.as_ref().map_or(0, Journal::unloaded)
    }

    /// Number of events dropped because the buffer was full or damaged.
    pub(super) fn dropped(&self) -> u64 {
        self.journal.as_ref().map_or(0, Journal::dropped) + self.refusals_dropped
    }
}

fn log_unusable(dir: &Path, error: &io::Error) {
    tracing::error!(
        "cannot store events in {}: {error}; keeping them in memory; check mqtt.buffer",
        dir.display()
    );
}
