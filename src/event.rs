//! What happened: state changes that people and the cloud want to know of, each published once.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use serde::Serialize;
use tokio::sync::broadcast;

/// Events that a listener may be behind: one of every drive of 66 full lines at once, 16 of every one of a thousand drives.
pub const BURST: usize = 16_384;
/// Events kept for late readers.
const KEPT: usize = 4096;
/// Refused commands of one drive that are published within [`REFUSALS_IN`]: a client without authority can send them at any rate.
const REFUSALS: u32 = 10;
/// The time for which refused commands are counted.
const REFUSALS_IN: Duration = Duration::from_secs(1);

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
}

impl EventKind {
    /// Whether somebody should look: the log has it as a warning.
    pub fn is_trouble(self) -> bool {
        match self {
            EventKind::Offline
            | EventKind::Fault
            | EventKind::UnlikeProfile
            | EventKind::Supervision
            | EventKind::Unsupervised
            | EventKind::NotConfirmed
            | EventKind::BusDown => true,
            EventKind::Online
            | EventKind::FaultEnd
            | EventKind::Restarted
            | EventKind::RefusedCommand
            | EventKind::BusUp
            | EventKind::Recording => false,
        }
    }

    /// The name in payloads.
    pub fn name(self) -> &'static str {
        match self {
            EventKind::Online => "online",
            EventKind::Offline => "offline",
            EventKind::Fault => "fault",
            EventKind::FaultEnd => "fault_end",
            EventKind::Restarted => "restarted",
            EventKind::UnlikeProfile => "unlike_profile",
            EventKind::Supervision => "supervision",
            EventKind::Unsupervised => "unsupervised",
            EventKind::RefusedCommand => "refused_command",
            EventKind::NotConfirmed => "not_confirmed",
            EventKind::BusUp => "bus_up",
            EventKind::BusDown => "bus_down",
            EventKind::Recording => "recording",
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

/// RFC 3339 with milliseconds, UTC.
pub fn rfc3339<S: serde::Serializer>(time: &SystemTime, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&humantime::format_rfc3339_millis(*time))
}

/// Where events are published and received.
#[derive(Debug, Clone)]
pub struct Events {
    sender: broadcast::Sender<Arc<Event>>,
    kept: Arc<Mutex<(u64, VecDeque<Arc<Event>>)>>,
    /// By drive; names come from the configuration, so they are few.
    refusals: Arc<Mutex<BTreeMap<String, Refusals>>>,
}

/// Refused commands of a drive.
#[derive(Debug)]
struct Refusals {
    since: Instant,
    published: u32,
    omitted: u64,
}

impl Refusals {
    /// Whether one may be published now, and how many were left out before it.
    fn admit(&mut self, now: Instant) -> Option<u64> {
        if now.saturating_duration_since(self.since) >= REFUSALS_IN {
            self.since = now;
            self.published = 0;
        }
        if self.published == REFUSALS {
            self.omitted += 1;
            return None;
        }
        self.published += 1;
        Some(std::mem::take(&mut self.omitted))
    }
}

impl Default for Events {
    fn default() -> Self {
        Events {
            sender: broadcast::channel(BURST).0,
            kept: Arc::default(),
            refusals: Arc::default(),
        }
    }
}

impl Events {
    /// Publishes an event; its id is set here.
    pub fn publish(&self, mut event: Event) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.0 += 1;
        event.id = kept.0;
        let (kind, drive) = (event.kind.name(), event.drive.as_deref().unwrap_or(""));
        if event.kind.is_trouble() {
            tracing::warn!(target: "drivegate::event", kind, bus = %event.bus, drive, "{}", event.text);
        } else {
            tracing::info!(target: "drivegate::event", kind, bus = %event.bus, drive, "{}", event.text);
        }
        let event = Arc::new(event);
        if kept.1.len() == KEPT {
            kept.1.pop_front();
        }
        kept.1.push_back(event.clone());
        // Nobody listening is no error.
        let _ = self.sender.send(event);
    }

    /// Publishes that a command to `drive` was refused: ten a second at most, the next one says how many were left out.
    /// The audit has them all.
    pub fn publish_refusal(&self, bus: &str, drive: &str, mut text: String, now: Instant) {
        let omitted = {
            let mut refusals = self.refusals.lock().unwrap_or_else(PoisonError::into_inner);
            let of_drive = refusals.entry(drive.to_string()).or_insert(Refusals {
                since: now,
                published: 0,
                omitted: 0,
            });
            of_drive.admit(now)
        };
        let Some(omitted) = omitted else { return };
        if omitted > 0 {
            text = format!("{text} ({omitted} more refused before are in the audit log)");
        }
        self.publish(Event {
            id: 0,
            time: SystemTime::now(),
            kind: EventKind::RefusedCommand,
            bus: bus.to_string(),
            drive: Some(drive.to_string()),
            fault_code: None,
            text,
            recording: None,
        });
    }

    /// Hears all events from now on; a listener that is more than [`BURST`] behind loses the oldest.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<Event>> {
        self.sender.subscribe()
    }

    /// The last 4,096 events, oldest first.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn event(text: String) -> Event {
        Event {
            id: 0,
            time: SystemTime::UNIX_EPOCH,
            kind: EventKind::Offline,
            bus: "line1".to_string(),
            drive: None,
            fault_code: None,
            text,
            recording: None,
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
    fn a_flood_of_refusals_is_counted_not_told() {
        let events = Events::default();
        let now = Instant::now();
        for _ in 0..1000 {
            events.publish_refusal("line1", "pump-1", "refused".to_string(), now);
        }
        events.publish_refusal("line1", "pump-2", "refused".to_string(), now);
        assert_eq!(
            events.recent().len(),
            11,
            "ten of one drive, none of them at the cost of another drive"
        );
        events.publish_refusal("line1", "pump-1", "refused".to_string(), now + REFUSALS_IN);
        let last = events.recent().last().map(|e| e.text.clone()).unwrap();
        assert_eq!(last, "refused (990 more refused before are in the audit log)");
    }
}
