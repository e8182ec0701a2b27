//! The events that wait: on disk where a buffer is configured and usable, else in memory.

use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::Buffer;
use super::journal::{Journal, RecordId};
use super::outbox::{Message, Outbox};

/// Time after which events on disk are safe from a power cut.
const SYNC: Duration = Duration::from_secs(1);
/// Attempts to get the directory, and the wait between them: a process that is just ending still holds it.
const LOCK_ATTEMPTS: u32 = 20;
const LOCK_WAIT: Duration = Duration::from_millis(50);

/// The way of an event into the outbox: over the disk, or straight on.
#[derive(Debug, Default)]
pub(super) struct EventStore {
    dir: PathBuf,
    journal: Option<Journal>,
    /// The last attempt to write failed, which was logged.
    failing: bool,
    synced: Option<Instant>,
}

impl EventStore {
    /// Opens the buffer. One that cannot be used is logged, and events are kept in memory.
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
                    tell_unusable(&dir, &error);
                    break None;
                }
            }
        };
        let waiting = journal.as_ref().map_or(0, Journal::unloaded);
        if waiting > 0 {
            tracing::info!("{waiting} events from before wait in {} for the broker", dir.display());
        }
        EventStore {
            dir,
            journal,
            ..EventStore::default()
        }
    }

    /// Takes an event in.
    pub(super) fn push(&mut self, message: Message, outbox: &mut Outbox) {
        match self.journal.as_mut().map(|journal| journal.append(&message)) {
            Some(Ok(())) => self.failing = false,
            Some(Err(error)) => {
                if !std::mem::replace(&mut self.failing, true) {
                    tell_unusable(&self.dir, &error);
                }
                outbox.push_event(message, None);
            }
            None => outbox.push_event(message, None),
        }
    }

    /// Loads events from the disk as far as the outbox has room.
    pub(super) fn refill(&mut self, outbox: &mut Outbox) {
        let Some(journal) = &mut self.journal else { return };
        for _ in 0..outbox.room() {
            match journal.load() {
                Some((record, message)) => outbox.push_event(message, Some(record)),
                None => return,
            }
        }
    }

    /// The broker has the event of that record.
    pub(super) fn acknowledge(&mut self, record: RecordId) {
        if let Some(Err(error)) = self.journal.as_mut().map(|journal| journal.acknowledge(record)) {
            tracing::warn!("{}: {error}; events may be delivered twice", self.dir.display());
        }
    }

    /// Makes what was written safe from a power cut, now and then and not in this thread.
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
                    tracing::warn!("{dir}: {error}; buffered events may not survive a power cut");
                }
            });
        }
    }

    /// Events on disk that are not in the outbox.
    pub(super) fn waiting(&self) -> u64 {
        self.journal.as_ref().map_or(0, Journal::unloaded)
    }

    /// Events that were dropped because the buffer was full or damaged.
    pub(super) fn dropped(&self) -> u64 {
        self.journal.as_ref().map_or(0, Journal::dropped)
    }
}

fn tell_unusable(dir: &Path, error: &io::Error) {
    tracing::error!(
        "events cannot be kept in {}: {error}; they are kept in memory; check mqtt.buffer",
        dir.display()
    );
}
