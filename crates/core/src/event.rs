//! Events: state changes, each published once.

mod fair_ring;
mod kind;
mod log;
mod refusals;
#[cfg(test)]
mod tests;

use std::borrow::Cow;
use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Instant, SystemTime};

use serde::Serialize;
use tokio::sync::broadcast;

use crate::stalls::{Pauses, Stall};

pub use fair_ring::{FairRing, in_order};
pub use kind::EventKind;
pub use log::{Before, LineError, Search, from_line};
pub use refusals::RefusalLimit;

/// Maximum number of events by which a listener may lag behind: one event for each drive of 66 full lines, or 16 events
/// for each of a thousand drives.
pub const BURST: usize = 16_384;
/// Number of events that a listener of a small plant may lag behind: 16 for each of 256 drives. This buffer is
/// allocated at the start.
const SMALL_BURST: usize = 4096;
/// Number of events for each drive that a listener may lag behind.
const OF_EACH_DRIVE: usize = 16;
/// Events of drives and buses kept for late readers.
const KEPT: usize = 4096;
/// Refused commands kept in addition.
const REFUSALS_KEPT: usize = 512;

/// One event.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Event {
    /// Running number within a run of the process, from 1.
    pub id: u64,
    /// The run of the gateway that had the event.
    #[schema(value_type = String)]
    pub boot: Boot,
    /// Time at which the event happened.
    #[serde(serialize_with = "rfc3339")]
    #[schema(value_type = String)]
    pub time: SystemTime,
    /// The kind of event.
    #[serde(rename = "event")]
    #[schema(value_type = String)]
    pub kind: EventKind,
    /// The bus; empty if the whole gateway is meant.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub bus: String,
    /// The drive, unless the whole bus is meant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drive: Option<String>,
    /// Fault code; `None` for other events.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault_code: Option<i64>,
    /// Refused commands only: number of refusals of one client that the event covers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count: Option<u64>,
    /// Only for starts and stops: the client whose command caused the event, if a command through this gateway did.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    /// Description of the event for people.
    pub text: String,
    /// The recording that was made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordingMade>,
}

/// A recording that was made.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct RecordingMade {
    /// Id of the recording.
    pub id: String,
    /// Trigger of the recording.
    #[schema(value_type = String)]
    pub trigger: Cow<'static, str>,
    /// Summary of the recording.
    pub summary: String,
}

impl Event {
    /// An event of the gateway as a whole, in this run; publishing sets the number of the event.
    pub fn new(kind: EventKind, time: SystemTime, text: String) -> Event {
        Event {
            id: 0,
            boot: Boot::default(),
            time,
            kind,
            bus: String::new(),
            drive: None,
            fault_code: None,
            count: None,
            by: None,
            text,
            recording: None,
        }
    }
}

/// A run of the gateway process: the present one, or an earlier one by its name.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Boot(Option<Arc<str>>);

impl Boot {
    /// The run with this name.
    pub fn named(name: &str) -> Boot {
        Boot(Some(name).filter(|name| *name != boot()).map(Arc::from))
    }

    pub fn name(&self) -> &str {
        self.0.as_deref().unwrap_or_else(|| boot())
    }
}

impl Serialize for Boot {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// The name of this run of the process, different at every start: together with it, the number of an event is unique.
pub fn boot() -> &'static str {
    static BOOT: OnceLock<String> = OnceLock::new();
    BOOT.get_or_init(|| {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let random = RandomState::new().hash_one((now.unwrap_or_default(), std::process::id()));
        format!("{random:016x}")
    })
}

/// RFC 3339 with milliseconds, UTC.
pub fn rfc3339<S: serde::Serializer>(time: &SystemTime, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&humantime::format_rfc3339_millis(*time))
}

/// A command that was refused.
#[derive(Debug)]
pub struct RefusedCommand<'r> {
    /// The client under the name by which shares are counted.
    pub client: &'r Arc<str>,
    /// Code of the reason for the refusal.
    pub reason: &'static str,
    /// Kind of the event.
    pub kind: EventKind,
    /// Names of the bus and the drive; both empty if the event concerns no particular one.
    pub bus: &'r str,
    pub drive: &'r str,
    /// Description of the refusal for people.
    pub text: String,
}

/// The channel through which events are published and received.
#[derive(Debug, Clone)]
pub struct Events {
    sender: broadcast::Sender<Arc<Event>>,
    store: Arc<Mutex<Store>>,
    pauses: Pauses,
}

/// The latest events. Events of drives and buses are stored separately from refused commands, and no drive or kind
/// displaces another.
///
/// Each event is stored as its line of JSON in one block of memory. As an [`Event`] it would take six blocks and
/// twice the bytes; thousands of such small blocks, freed over months, would fragment the memory.
#[derive(Debug)]
struct Store {
    /// Number of the last event of this run.
    number: u64,
    /// Number of events of earlier runs, which precede those of this run.
    earlier: u64,
    kept: FairRing<(EventKind, Arc<str>), Arc<str>>,
    refused: FairRing<Arc<str>, Arc<str>>,
    limit: RefusalLimit<Event>,
}

impl Default for Events {
    fn default() -> Self {
        Events::of_drives(BURST / OF_EACH_DRIVE)
    }
}

impl Events {
    /// The events of a gateway with this number of drives: a listener may lag behind by 16 events for each, at
    /// least 4,096 and at most [`BURST`].
    pub fn of_drives(drives: usize) -> Events {
        let burst = drives.saturating_mul(OF_EACH_DRIVE).clamp(SMALL_BURST, BURST);
        Events {
            sender: broadcast::channel(burst).0,
            store: Arc::new(Mutex::new(Store {
                number: 0,
                earlier: 0,
                kept: FairRing::new(KEPT),
                refused: FairRing::new(REFUSALS_KEPT),
                limit: RefusalLimit::default(),
            })),
            pauses: Pauses::default(),
        }
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Publishes an event and sets its id.
    pub fn publish(&self, event: Event) {
        self.publish_in(&mut self.store(), event);
    }

    /// Publishes under the lock, so that listeners receive the events in the order of their ids.
    fn publish_in(&self, store: &mut Store, mut event: Event) {
        store.number += 1;
        event.id = store.number;
        let (kind, drive) = (event.kind.name(), event.drive.as_deref().unwrap_or(""));
        if event.kind.is_trouble() {
            tracing::warn!(target: "drivegate::event", kind, bus = %event.bus, drive, "{}", event.text);
        } else {
            tracing::info!(target: "drivegate::event", kind, bus = %event.bus, drive, count = event.count, "{}", event.text);
        }
        store.keep(&event);
        // Sending fails if there is no subscriber, which is not an error.
        let _ = self.sender.send(Arc::new(event));
    }

    /// The pauses of the process.
    pub fn pauses(&self) -> &Pauses {
        &self.pauses
    }

    /// Publishes a pause of a thread that ended at the calendar time `time`. A pause of several threads is published once.
    pub fn publish_pause(&self, pause: Stall, time: SystemTime) {
        if !self.pauses.note(pause) {
            return;
        }
        let (seconds, over) = (pause.length().as_secs_f64(), (pause.over() - pause.ended).as_secs_f64());
        let text = format!(
            "the gateway stood still for {seconds:.1} s: its process was stopped, its machine suspended or too busy; \
             orders from before are refused as `expired`, and for {over:.1} s only new connections start motors"
        );
        self.publish(Event::new(EventKind::Paused, time, text));
    }

    /// Publishes a refused command. The first one of a kind is published at once; after that, one event a second
    /// for each client covers all further ones.
    pub fn publish_refusal(&self, refused: RefusedCommand<'_>, now: Instant) {
        let drive = Some(refused.drive).filter(|drive| !drive.is_empty());
        let event = Event {
            bus: refused.bus.to_string(),
            drive: drive.map(str::to_string),
            ..Event::new(refused.kind, SystemTime::now(), refused.text)
        };
        let mut store = self.store();
        let passed = store.limit.admit(refused.client, refused.reason, drive, event, now);
        passed
            .into_iter()
            .for_each(|passed| self.publish_counted(&mut store, passed));
    }

    /// Publishes the refusals that waited long enough for their count.
    pub(crate) fn publish_due(&self, now: Instant) {
        let mut store = self.store();
        let due = store.limit.due(now);
        due.into_iter()
            .for_each(|passed| self.publish_counted(&mut store, passed));
    }

    fn publish_counted(&self, store: &mut Store, (mut event, count): (Event, u64)) {
        event.count = Some(count);
        if count > 1 {
            event.text = format!("{} ({count} commands of this client were refused)", event.text);
        }
        self.publish_in(store, event);
    }

    /// Receives all events from now on; a listener that lags behind further than [`Events::of_drives`] allows loses
    /// the oldest ones.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<Event>> {
        self.sender.subscribe()
    }

    /// Restores the events of earlier runs, oldest first. Must be called before the first event of this run.
    pub fn remember(&self, earlier: Vec<Event>) {
        let mut store = self.store();
        for event in earlier {
            store.earlier += 1;
            store.keep(&event);
        }
    }

    /// The last events of this run, oldest first, each with its id as a line of JSON: 4,096 of drives and buses and 512
    /// refused commands at most.
    pub fn recent_lines(&self) -> Vec<(u64, Arc<str>)> {
        let (earlier, all) = {
            let store = self.store();
            (store.earlier, store.lines())
        };
        let of_this_run =
            |(number, line): (u64, Arc<str>)| Some((number.checked_sub(earlier).filter(|id| *id > 0)?, line));
        all.into_iter().filter_map(of_this_run).collect()
    }

    /// The recent events, parsed.
    pub fn recent(&self) -> Vec<Event> {
        let lines = self.recent_lines().into_iter();
        lines.filter_map(|(_, line)| from_line(line.as_bytes()).ok()).collect()
    }

    /// The newest events that match the search, newest first, including those of earlier runs.
    pub fn search(&self, search: &Search) -> Vec<Event> {
        let all = self.store().lines();
        log::newest(all.iter().map(|(_, line)| &**line), search)
    }
}

impl Store {
    fn keep(&mut self, event: &Event) {
        // A time before 1970 or after 9999 cannot be written as a line.
        let Ok(line) = serde_json::to_string(event) else { return };
        let (number, line) = (self.earlier + self.number, Arc::from(line));
        let source = Arc::from(event.drive.as_deref().unwrap_or(&event.bus));
        match event.kind {
            EventKind::RefusedCommand => self.refused.push(source, number, line),
            kind => self.kept.push((kind, source), number, line),
        }
    }

    /// The lines of all kept events with their numbers, oldest first. They are copied without holding the lock, so
    /// publishers do not wait.
    fn lines(&self) -> Vec<(u64, Arc<str>)> {
        in_order(&self.kept, &self.refused)
    }
}
