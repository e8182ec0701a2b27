//! What happened: state changes that people and the cloud want to know of, each published once.

mod fair_ring;
mod refusals;

use std::hash::{BuildHasher, RandomState};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Instant, SystemTime};

use serde::Serialize;
use tokio::sync::broadcast;

pub use fair_ring::FairRing;
pub use refusals::RefusalLimit;

/// Events that a listener may be behind: one of every drive of 66 full lines at once, 16 of every one of a thousand drives.
pub const BURST: usize = 16_384;
/// Events of drives and buses kept for late readers.
const KEPT: usize = 4096;
/// Refused commands kept beside them.
const REFUSALS_KEPT: usize = 512;

/// What kind of thing happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// A drive answers (again).
    Online,
    /// A drive does not answer any more.
    Offline,
    /// A fault came up, or its code changed.
    Fault,
    /// The fault is gone.
    FaultEnd,
    /// A motor started.
    Started,
    /// A motor stopped.
    Stopped,
    /// A warning came up.
    Warning,
    /// The warning is gone.
    WarningEnd,
    /// The fieldbus became the control place of a drive, or no longer is.
    ControlPlace,
    /// A drive has started anew.
    Restarted,
    /// A drive says that it is another device than its profile expects.
    UnlikeProfile,
    /// A lease ran out and its action was taken.
    Supervision,
    /// A drive that takes commands has neither a lease nor a response of its own to a silent master.
    Unsupervised,
    /// A command was refused.
    RefusedCommand,
    /// An acknowledged command showed no effect in time.
    NotConfirmed,
    /// The port of a bus was opened.
    BusUp,
    /// The port of a bus was lost or cannot be opened.
    BusDown,
    /// A recording was made, or lost.
    Recording,
    /// A new configuration was not applied; the former one goes on.
    ReloadRefused,
    /// The other master of a line commands a drive.
    ForeignCommand,
    /// A verdict about a line came, became firmer, or went.
    Diagnosis,
}

impl EventKind {
    /// All kinds.
    pub const ALL: [EventKind; 21] = [
        EventKind::Online,
        EventKind::Offline,
        EventKind::Fault,
        EventKind::FaultEnd,
        EventKind::Started,
        EventKind::Stopped,
        EventKind::Warning,
        EventKind::WarningEnd,
        EventKind::ControlPlace,
        EventKind::Restarted,
        EventKind::UnlikeProfile,
        EventKind::Supervision,
        EventKind::Unsupervised,
        EventKind::RefusedCommand,
        EventKind::NotConfirmed,
        EventKind::BusUp,
        EventKind::BusDown,
        EventKind::Recording,
        EventKind::ReloadRefused,
        EventKind::ForeignCommand,
        EventKind::Diagnosis,
    ];

    /// Whether somebody should look: the log has it as a warning.
    pub fn is_trouble(self) -> bool {
        match self {
            EventKind::Offline
            | EventKind::Fault
            | EventKind::Warning
            | EventKind::UnlikeProfile
            | EventKind::Supervision
            | EventKind::Unsupervised
            | EventKind::NotConfirmed
            | EventKind::BusDown
            | EventKind::Diagnosis
            | EventKind::ReloadRefused => true,
            EventKind::Online
            | EventKind::FaultEnd
            | EventKind::Started
            | EventKind::Stopped
            | EventKind::WarningEnd
            | EventKind::ControlPlace
            | EventKind::Restarted
            | EventKind::RefusedCommand
            | EventKind::BusUp
            | EventKind::Recording
            | EventKind::ForeignCommand => false,
        }
    }

    /// The name in payloads.
    pub fn name(self) -> &'static str {
        match self {
            EventKind::Online => "online",
            EventKind::Offline => "offline",
            EventKind::Fault => "fault",
            EventKind::FaultEnd => "fault_end",
            EventKind::Started => "started",
            EventKind::Stopped => "stopped",
            EventKind::Warning => "warning",
            EventKind::WarningEnd => "warning_end",
            EventKind::ControlPlace => "control_place",
            EventKind::Restarted => "restarted",
            EventKind::UnlikeProfile => "unlike_profile",
            EventKind::Supervision => "supervision",
            EventKind::Unsupervised => "unsupervised",
            EventKind::RefusedCommand => "refused_command",
            EventKind::NotConfirmed => "not_confirmed",
            EventKind::BusUp => "bus_up",
            EventKind::BusDown => "bus_down",
            EventKind::Recording => "recording",
            EventKind::ReloadRefused => "reload_refused",
            EventKind::ForeignCommand => "foreign_command",
            EventKind::Diagnosis => "diagnosis",
        }
    }
}

/// One event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// Running number within this process, from 1; shown with the [`boot`] of the process.
    #[serde(flatten, serialize_with = "numbered")]
    pub id: u64,
    /// When it happened.
    #[serde(serialize_with = "rfc3339")]
    pub time: SystemTime,
    /// What happened.
    #[serde(rename = "event")]
    pub kind: EventKind,
    /// The bus; empty if the whole gateway is meant.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub bus: String,
    /// The drive, unless the whole bus is meant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drive: Option<String>,
    /// Fault code, where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault_code: Option<i64>,
    /// Refused commands only: how many of one client it stands for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count: Option<u64>,
    /// For people.
    pub text: String,
    /// The recording that was made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordingMade>,
}

/// A recording that was made.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingMade {
    /// Its id.
    pub id: String,
    /// What made it.
    pub trigger: &'static str,
    /// What it shows, for people.
    pub summary: String,
}

/// The name of this run of the process, different at every start: with it, the number of an event is unique.
pub fn boot() -> &'static str {
    static BOOT: OnceLock<String> = OnceLock::new();
    BOOT.get_or_init(|| {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        let random = RandomState::new().hash_one((now.unwrap_or_default(), std::process::id()));
        format!("{random:016x}")
    })
}

fn numbered<S: serde::Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Numbered {
        id: u64,
        boot: &'static str,
    }
    Numbered { id: *id, boot: boot() }.serialize(serializer)
}

/// RFC 3339 with milliseconds, UTC.
pub fn rfc3339<S: serde::Serializer>(time: &SystemTime, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&humantime::format_rfc3339_millis(*time))
}

/// A command that was refused.
#[derive(Debug)]
pub struct RefusedCommand<'r> {
    /// The client, as shares are reckoned.
    pub client: &'r Arc<str>,
    /// Code of the reason.
    pub reason: &'static str,
    /// The bus.
    pub bus: &'r str,
    /// The drive.
    pub drive: &'r str,
    /// For people.
    pub text: String,
}

/// Where events are published and received.
#[derive(Debug, Clone)]
pub struct Events {
    sender: broadcast::Sender<Arc<Event>>,
    store: Arc<Mutex<Store>>,
}

/// The last events. Those of drives and buses are apart from refused commands, and no drive or kind pushes out another.
#[derive(Debug)]
struct Store {
    number: u64,
    kept: FairRing<(EventKind, String), Arc<Event>>,
    refused: FairRing<String, Arc<Event>>,
    limit: RefusalLimit<Event>,
}

impl Default for Events {
    fn default() -> Self {
        Events {
            sender: broadcast::channel(BURST).0,
            store: Arc::new(Mutex::new(Store {
                number: 0,
                kept: FairRing::new(KEPT),
                refused: FairRing::new(REFUSALS_KEPT),
                limit: RefusalLimit::default(),
            })),
        }
    }
}

impl Events {
    fn store(&self) -> MutexGuard<'_, Store> {
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Publishes an event; its id is set here.
    pub fn publish(&self, event: Event) {
        self.publish_in(&mut self.store(), event);
    }

    /// Under the lock, so that listeners hear the events in the order of their ids.
    fn publish_in(&self, store: &mut Store, mut event: Event) {
        store.number += 1;
        event.id = store.number;
        let (kind, drive) = (event.kind.name(), event.drive.as_deref().unwrap_or(""));
        if event.kind.is_trouble() {
            tracing::warn!(target: "drivegate::event", kind, bus = %event.bus, drive, "{}", event.text);
        } else {
            tracing::info!(target: "drivegate::event", kind, bus = %event.bus, drive, count = event.count, "{}", event.text);
        }
        let (number, event) = (event.id, Arc::new(event));
        let source = event.drive.clone().unwrap_or_else(|| event.bus.clone());
        match event.kind {
            EventKind::RefusedCommand => store.refused.push(source, number, event.clone()),
            kind => store.kept.push((kind, source), number, event.clone()),
        }
        // Nobody listening is no error.
        let _ = self.sender.send(event);
    }

    /// Publishes that a command was refused: the first of a kind at once, then one event a second for each client, which
    /// stands for all of them.
    pub fn publish_refusal(&self, refused: RefusedCommand<'_>, now: Instant) {
        let event = Event {
            id: 0,
            time: SystemTime::now(),
            kind: EventKind::RefusedCommand,
            bus: refused.bus.to_string(),
            drive: Some(refused.drive.to_string()),
            fault_code: None,
            count: None,
            text: refused.text,
            recording: None,
        };
        let mut store = self.store();
        let passed = store
            .limit
            .admit(refused.client, refused.reason, Some(refused.drive), event, now);
        passed
            .into_iter()
            .for_each(|passed| self.publish_counted(&mut store, passed));
    }

    /// Publishes the refusals that waited long enough for their count.
    pub fn publish_due(&self, now: Instant) {
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

    /// Hears all events from now on; a listener that is more than [`BURST`] behind loses the oldest.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<Event>> {
        self.sender.subscribe()
    }

    /// The last 4,096 events of drives and buses and the last 512 refused commands, oldest first.
    pub fn recent(&self) -> Vec<Arc<Event>> {
        let store = self.store();
        let all = store.kept.iter().chain(store.refused.iter());
        let mut all: Vec<_> = all.map(|(_, event)| event.clone()).collect();
        all.sort_unstable_by_key(|event| event.id);
        all
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn event(text: String) -> Event {
        Event {
            id: 0,
            time: SystemTime::UNIX_EPOCH,
            kind: EventKind::Offline,
            bus: "line1".to_string(),
            drive: None,
            fault_code: None,
            count: None,
            text,
            recording: None,
        }
    }

    /// A new kind does not compile until it is here, and then in `ALL`.
    #[test]
    fn all_kinds_are_listed() {
        use EventKind::*;
        for (place, kind) in EventKind::ALL.into_iter().enumerate() {
            let last = match kind {
                Online | Offline | Fault | FaultEnd | Started | Stopped | Warning | WarningEnd | ControlPlace
                | Restarted | UnlikeProfile | Supervision | Unsupervised | RefusedCommand | NotConfirmed | BusUp
                | BusDown | Recording | ReloadRefused | ForeignCommand => false,
                Diagnosis => true,
            };
            assert_eq!(kind as usize, place);
            assert_eq!(last, place + 1 == EventKind::ALL.len());
        }
    }

    #[test]
    fn a_burst_of_all_drives_reaches_who_is_busy_and_who_comes_late() {
        let events = Events::default();
        let mut busy = events.subscribe();
        (0..BURST).for_each(|n| events.publish(event(n.to_string())));
        let heard = std::iter::from_fn(|| busy.try_recv().ok());
        assert!(heard.map(|e| e.id).eq(1..=BURST as u64));
        let kept = events.recent();
        assert_eq!(kept.len(), KEPT);
        assert_eq!(kept.last().map(|e| e.id), Some(BURST as u64));
    }

    #[test]
    fn refusals_push_out_no_event_of_a_drive_and_a_drive_none_of_another() {
        let (events, start) = (Events::default(), Instant::now());
        let fault = |drive: &str, kind| Event {
            kind,
            drive: Some(drive.to_string()),
            ..event("F1".to_string())
        };
        events.publish(fault("pump-1", EventKind::Fault));
        let client = |n: u32| Arc::from(format!("modbus_tcp 10.0.0.{}", n % 64));
        for n in 0..100_000 {
            let refused = RefusedCommand {
                client: &client(n),
                reason: "not_allowed",
                bus: "line1",
                drive: "pump-1",
                text: "refused".to_string(),
            };
            events.publish_refusal(refused, start + Duration::from_millis(n.into()));
        }
        events.publish_due(start + Duration::from_secs(200));
        let refused: Vec<_> = events
            .recent()
            .into_iter()
            .filter(|e| e.kind == EventKind::RefusedCommand)
            .collect();
        assert_eq!(refused.len(), REFUSALS_KEPT);
        assert!(
            refused
                .last()
                .unwrap()
                .text
                .contains("commands of this client were refused)")
        );
        (0..2 * KEPT).for_each(|_| events.publish(fault("pump-2", EventKind::Online)));
        (0..2 * KEPT).for_each(|_| events.publish(fault("pump-2", EventKind::Fault)));
        let kept = events.recent();
        assert_eq!(kept.len(), KEPT + REFUSALS_KEPT);
        assert_eq!((kept[0].id, kept[0].drive.as_deref()), (1, Some("pump-1")));
        assert!(kept.is_sorted_by_key(|event| event.id));
    }
}
