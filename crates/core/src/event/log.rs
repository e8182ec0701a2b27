//! The history of events: the filter of a search, and the form of an event on disk. Pure.

use std::time::SystemTime;

use serde::Deserialize;

use super::{Boot, Event, EventKind, RecordingMade};

/// Upper limit of a search: only earlier events are found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Before {
    Time(SystemTime),
    /// The event with this number of this run; the event itself is not part of the result.
    Event(Boot, u64),
}

/// The filter of a search for events.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Search {
    /// Kinds to search for; empty for all kinds.
    pub kinds: Vec<EventKind>,
    pub drive: Option<String>,
    pub bus: Option<String>,
    /// Text that one of the event's fields contains, in upper or lower case.
    pub text: Option<String>,
    /// Only events older than this one.
    pub before: Option<Before>,
    /// Largest number of events.
    pub limit: usize,
}

impl Search {
    fn finds(&self, event: &Event, words: Option<&str>) -> bool {
        let is = |wanted: &Option<String>, name: &str| wanted.as_ref().is_none_or(|wanted| wanted == name);
        let texts = || {
            let summary = event.recording.as_ref().map(|made| &made.summary);
            [Some(&event.text), event.drive.as_ref(), event.by.as_ref(), summary]
        };
        let has = |words: &str| {
            let mut texts = texts().into_iter().flatten();
            texts.any(|text| text.to_lowercase().contains(words))
        };
        let is_before = match &self.before {
            Some(Before::Time(time)) => event.time < *time,
            _ => true,
        };
        (self.kinds.is_empty() || self.kinds.contains(&event.kind))
            && is(&self.drive, event.drive.as_deref().unwrap_or_default())
            && is(&self.bus, &event.bus)
            && is_before
            && words.is_none_or(has)
    }
}

/// The newest of `all` (lines, oldest first) that match, newest first.
pub(super) fn newest<'l>(
    all: impl DoubleEndedIterator<Item = &'l str> + ExactSizeIterator + Clone,
    search: &Search,
) -> Vec<Event> {
    let words = search.text.as_ref().map(|text| text.to_lowercase());
    let read = |line: &str| from_line(line.as_bytes()).ok();
    let end = match &search.before {
        // If an event is no longer kept, no older one is kept either.
        Some(Before::Event(boot, id)) => {
            let is_it = |event: Event| event.boot == *boot && event.id >= *id;
            all.clone().position(|line| read(line).is_some_and(is_it)).unwrap_or(0)
        }
        _ => all.len(),
    };
    let candidates = all.take(end).rev().filter_map(read);
    let found = candidates.filter(|event| search.finds(event, words.as_deref()));
    found.take(search.limit).collect()
}

/// Why a line of the file is not an event.
#[derive(Debug, thiserror::Error)]
pub enum LineError {
    /// The line is not a JSON object with the fields of an event.
    #[error("{0}")]
    Form(#[from] serde_json::Error),
    /// The time of the event is not valid.
    #[error("its time is not RFC 3339: {0}")]
    Time(#[from] humantime::TimestampError),
}

/// Parses an event from its JSON, as [`Event`] is serialized.
///
/// # Errors
/// If the line is not an event, or of a newer version.
pub fn from_line(line: &[u8]) -> Result<Event, LineError> {
    #[derive(Deserialize)]
    struct Line {
        id: u64,
        boot: String,
        time: String,
        event: EventKind,
        #[serde(default)]
        bus: String,
        drive: Option<String>,
        fault_code: Option<i64>,
        count: Option<u64>,
        by: Option<String>,
        text: String,
        recording: Option<Made>,
    }
    #[derive(Deserialize)]
    struct Made {
        id: String,
        trigger: String,
        summary: String,
    }
    let line: Line = serde_json::from_slice(line)?;
    Ok(Event {
        id: line.id,
        boot: Boot::named(&line.boot),
        time: humantime::parse_rfc3339(&line.time)?,
        kind: line.event,
        bus: line.bus,
        drive: line.drive,
        fault_code: line.fault_code,
        count: line.count,
        by: line.by,
        text: line.text,
        recording: line.recording.map(|made| RecordingMade {
            id: made.id,
            trigger: made.trigger.into(),
            summary: made.summary,
        }),
    })
}

impl Before {
    /// The event that `text` names in the form `BOOT-ID`.
    pub fn event(text: &str) -> Option<Before> {
        let (boot, id) = text.rsplit_once('-')?;
        let is_boot = boot.len() == 16 && boot.bytes().all(|byte| byte.is_ascii_hexdigit());
        let id = id.parse().ok().filter(|_| is_boot)?;
        Some(Before::Event(Boot::named(boot), id))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn event(id: u64, kind: EventKind, drive: &str, text: &str) -> Event {
        Event {
            id,
            bus: "line1".to_string(),
            drive: Some(drive.to_string()),
            ..Event::new(kind, SystemTime::UNIX_EPOCH + Duration::from_secs(id), text.to_string())
        }
    }

    fn all() -> Search {
        Search {
            kinds: Vec::new(),
            drive: None,
            bus: None,
            text: None,
            before: None,
            limit: 100,
        }
    }

    fn ids(search: &Search) -> Vec<u64> {
        let events = [
            event(1, EventKind::Fault, "pump-1", "Overcurrent"),
            event(2, EventKind::Started, "pump-2", "has started"),
            event(3, EventKind::FaultEnd, "pump-1", "the fault is gone"),
            event(4, EventKind::Fault, "pump-2", "fieldbus fault"),
        ];
        let lines = events.map(|event| serde_json::to_string(&event).unwrap());
        newest(lines.iter().map(String::as_str), search)
            .iter()
            .map(|event| event.id)
            .collect()
    }

    #[test]
    fn searches() {
        assert_eq!(ids(&all()), [4, 3, 2, 1]);
        assert_eq!(ids(&Search { limit: 2, ..all() }), [4, 3]);
        let kinds = vec![EventKind::Fault, EventKind::Started];
        assert_eq!(ids(&Search { kinds, ..all() }), [4, 2, 1]);
        let drive = Some("pump-1".to_string());
        assert_eq!(ids(&Search { drive, ..all() }), [3, 1]);
        let bus = Some("line2".to_string());
        assert_eq!(ids(&Search { bus, ..all() }), [0; 0]);
        for (text, expected) in [("FAULT", vec![4, 3]), ("overc", vec![1]), ("pump-2", vec![4, 2])] {
            let text = Some(text.to_string());
            assert_eq!(ids(&Search { text, ..all() }), expected);
        }
        let before = |before| Search {
            before: Some(before),
            ..all()
        };
        let third = SystemTime::UNIX_EPOCH + Duration::from_secs(3);
        assert_eq!(ids(&before(Before::Time(third))), [2, 1]);
        let named = format!("{}-3", super::super::boot());
        assert_eq!(ids(&before(Before::event(&named).unwrap())), [2, 1]);
        assert_eq!(
            ids(&before(Before::event("0123456789abcdef-3").unwrap())),
            [0; 0],
            "another run"
        );
        for other in ["2026-03-01T12:00:00Z", "x-3", "0123456789abcdef-", "7"] {
            assert_eq!(Before::event(other), None, "{other}");
        }
    }

    #[test]
    fn an_event_is_itself_after_a_line() {
        let mut before = event(7, EventKind::Started, "pump-1", "has \"started\"");
        before.by = Some("mqtt drivegate/g/drive/pump-1/set".to_string());
        before.recording = Some(RecordingMade {
            id: "x".to_string(),
            trigger: "fault".into(),
            summary: "s".to_string(),
        });
        let line = serde_json::to_vec(&before).unwrap();
        assert_eq!(from_line(&line).unwrap(), before);
        for wrong in [
            &b"{}"[..],
            b"",
            b"\xff",
            b"[1]",
            br#"{"id":1,"boot":"b","time":"x","event":"fault","text":""}"#,
        ] {
            assert!(from_line(wrong).is_err());
        }
        let newer = br#"{"id":1,"boot":"b","time":"2026-03-01T12:00:00Z","event":"not_yet_invented","text":""}"#;
        assert!(from_line(newer).unwrap_err().to_string().contains("not_yet_invented"));
    }
}
