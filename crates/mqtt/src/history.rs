//! Values of a drive while the broker is away: collected into JSON arrays, which are sent afterwards. Time is an argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::History;
use super::connection::PACKET_OVERHEAD;
use super::payload::StateContent;
use super::publisher::Update;

/// An array is complete with this number of entries or bytes, or this time after its first entry.
const ENTRIES: usize = 50;
const BYTES: usize = 32 << 10;
const COMPLETE: Duration = Duration::from_secs(10);

/// Collects the changed values of one drive.
#[derive(Debug)]
pub(super) struct Recorder {
    topic: Arc<str>,
    last: Option<(StateContent, Instant)>,
    /// Number of entries in the array being filled, and when the array was started.
    entries: usize,
    array: Vec<u8>,
    begun: Option<Instant>,
    /// Largest packet that the broker accepts, bytes, if known.
    max_packet: usize,
    /// Arrays that are complete because the broker takes no larger ones.
    complete: Vec<Update>,
}

impl Recorder {
    pub(super) fn new(topic: Arc<str>) -> Recorder {
        Recorder {
            topic,
            last: None,
            entries: 0,
            array: Vec::new(),
            begun: None,
            max_packet: usize::MAX,
            complete: Vec::new(),
        }
    }

    /// Sets the largest packet that the broker accepts.
    pub(super) fn limit(&mut self, max_packet: usize) {
        self.max_packet = max_packet;
    }

    /// Records the values of a drive: when they changed, or with [`History::All`] when they are `fresh`; at most
    /// once in `min`. Returns how long to wait if it is too early.
    pub(super) fn record(
        &mut self,
        mode: History,
        min: Duration,
        shown: StateContent,
        fresh: bool,
        render: impl FnOnce(&StateContent) -> Option<Vec<u8>>,
        now: Instant,
    ) -> Option<Duration> {
        let changed = self.last.as_ref().is_none_or(|(last, _)| *last != shown);
        let wanted = match mode {
            History::Off => false,
            History::Changes => changed,
            History::All => changed || fresh,
        };
        if !wanted {
            return None;
        }
        let since = self.last.as_ref().map(|(_, at)| now.saturating_duration_since(*at));
        if let Some(early) = since
            .and_then(|since| min.checked_sub(since))
            .filter(|early| !early.is_zero())
        {
            return Some(early);
        }
        if let Some(entry) = render(&shown) {
            let room = self.max_packet.saturating_sub(self.topic.len() + PACKET_OVERHEAD);
            if self.array.len() + entry.len() + 2 > room {
                let array = self.take();
                self.complete.extend(array);
            }
            self.array.push(if self.entries == 0 { b'[' } else { b',' });
            self.array.extend(entry);
            self.entries += 1;
            self.begun.get_or_insert(now);
        }
        self.last = Some((shown, now));
        None
    }

    /// The completed arrays.
    pub(super) fn ripe(&mut self, now: Instant) -> Vec<Update> {
        let old = |begun| now.saturating_duration_since(begun) >= COMPLETE;
        let complete = self.entries >= ENTRIES || self.array.len() >= BYTES || self.begun.is_some_and(old);
        if complete {
            self.take_all()
        } else {
            std::mem::take(&mut self.complete)
        }
    }

    /// All arrays, including the unfinished last one.
    pub(super) fn take_all(&mut self) -> Vec<Update> {
        let last = self.take();
        std::mem::take(&mut self.complete).into_iter().chain(last).collect()
    }

    fn take(&mut self) -> Option<Update> {
        self.begun.take()?;
        self.entries = 0;
        let mut payload = std::mem::take(&mut self.array);
        payload.push(b']');
        Some(Update {
            topic: self.topic.clone(),
            payload,
        })
    }
}
