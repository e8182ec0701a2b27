//! What happened: state changes that people and the cloud want to hear of, each told once.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use serde::Serialize;
use tokio::sync::broadcast;

/// Events kept for late readers, and in flight for each subscriber.
const KEPT: usize = 256;

/// What kind of thing happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
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
    /// A drive has started anew.
    Restarted,
    /// A lease ran out and its action was taken.
    Supervision,
    /// A command was refused.
    RefusedCommand,
    /// An acknowledged command showed no effect in time.
    NotConfirmed,
    /// The port of a bus was opened.
    BusUp,
    /// The port of a bus was lost or cannot be opened.
    BusDown,
}

impl EventKind {
    /// The name in payloads.
    pub fn name(self) -> &'static str {
        match self {
            EventKind::Online => "online",
            EventKind::Offline => "offline",
            EventKind::Fault => "fault",
            EventKind::FaultEnd => "fault_end",
            EventKind::Restarted => "restarted",
            EventKind::Supervision => "supervision",
            EventKind::RefusedCommand => "refused_command",
            EventKind::NotConfirmed => "not_confirmed",
            EventKind::BusUp => "bus_up",
            EventKind::BusDown => "bus_down",
        }
    }
}

/// One event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// Running number within this process, from 1.
    pub id: u64,
    /// When it happened.
    #[serde(serialize_with = "rfc3339")]
    pub time: SystemTime,
    /// What happened.
    #[serde(rename = "event")]
    pub kind: EventKind,
    /// The bus.
    pub bus: String,
    /// The drive, unless the whole bus is meant.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drive: Option<String>,
    /// Fault code, where there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault_code: Option<i64>,
    /// For people.
    pub text: String,
}

/// RFC 3339 with milliseconds, UTC.
pub fn rfc3339<S: serde::Serializer>(time: &SystemTime, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&humantime::format_rfc3339_millis(*time))
}

/// Where events are told and heard.
#[derive(Debug, Clone)]
pub struct Events {
    sender: broadcast::Sender<Arc<Event>>,
    kept: Arc<Mutex<(u64, VecDeque<Arc<Event>>)>>,
}

impl Default for Events {
    fn default() -> Self {
        Events {
            sender: broadcast::channel(KEPT).0,
            kept: Arc::default(),
        }
    }
}

impl Events {
    /// Tells an event; its id is set here.
    pub fn tell(&self, mut event: Event) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.0 += 1;
        event.id = kept.0;
        tracing::info!(target: "drivegate::event", kind = event.kind.name(), bus = %event.bus,
            drive = event.drive.as_deref().unwrap_or(""), "{}", event.text);
        let event = Arc::new(event);
        if kept.1.len() == KEPT {
            kept.1.pop_front();
        }
        kept.1.push_back(event.clone());
        // Nobody listening is no error.
        let _ = self.sender.send(event);
    }

    /// Hears all events from now on; a listener that is 256 behind loses the oldest.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<Event>> {
        self.sender.subscribe()
    }

    /// The last events, oldest first.
    pub fn recent(&self) -> Vec<Arc<Event>> {
        self.kept
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .1
            .iter()
            .cloned()
            .collect()
    }
}
