//! `GET /api/v1/events/log`: events, including those before the last start.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use axum::Json;
use axum::extract::{RawQuery, State};
use axum::response::IntoResponse;
use serde::Serialize;

use super::app_state::AppState;
use super::query::{self, QueryError};
use super::replies::Replied;
use drivegate_core::event::{Before, Event, EventKind, RecordingMade, Search};
use drivegate_core::history::{Entry, Recordings};

/// Events of a reply without `limit`, and at most.
const LIMITS: (usize, usize) = (100, 1000);

fn search(query: Option<&str>, now: SystemTime) -> Result<Search, QueryError> {
    let known = &["kind", "drive", "bus", "text", "before", "limit"];
    let [kind, drive, bus, text, before, limit] = query::parameters(query, known)?;
    let mut kinds = Vec::new();
    for name in kind
        .iter()
        .flat_map(|kinds| kinds.split(','))
        .filter(|name| !name.is_empty())
    {
        let kind = EventKind::ALL.into_iter().find(|kind| kind.name() == name.trim());
        kinds.push(kind.ok_or_else(|| QueryError::Value {
            name: "kind",
            value: name.to_string(),
            expected: "give values of `event`, such as `fault`, separated by commas",
        })?);
    }
    let point = |text: String| match Before::event(&text) {
        Some(event) => Ok(event),
        None => query::time("before", &text, now).map(Before::Time),
    };
    let count = |text: String| match text.parse::<usize>() {
        Ok(limit) if limit > 0 => Ok(limit.min(LIMITS.1)),
        _ => Err(QueryError::Value {
            name: "limit",
            value: text,
            expected: "a number from 1 to 1000",
        }),
    };
    Ok(Search {
        kinds,
        drive,
        bus,
        text,
        before: before.map(point).transpose()?,
        limit: limit.map_or(Ok(LIMITS.0), count)?,
    })
}

/// Handler: the events that match, newest first.
pub(super) async fn log(State(app): State<Arc<AppState>>, RawQuery(query): RawQuery) -> Replied {
    let search = search(query.as_deref(), SystemTime::now())?;
    let _turn = app.turn().await;
    let plant = app.plant.load();
    let found = plant.events.search(&search);
    let recorded = Recorded::new(&app.north.recordings);
    let shown: Vec<Shown<'_>> = found.iter().map(|event| recorded.show(event)).collect();
    Ok(Json(shown).into_response())
}

/// An event, with the recording that shows it.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Shown<'e> {
    #[serde(flatten)]
    event: &'e Event,
    /// The recording; absent in events that name a recording themselves.
    #[serde(rename = "recording", skip_serializing_if = "Option::is_none")]
    shown_in: Option<RecordingMade>,
}

/// The recordings on disk, sorted by the time that they cover.
struct Recorded {
    before: Duration,
    after: Duration,
    entries: Vec<(SystemTime, Arc<Entry>)>,
}

impl Recorded {
    fn new(recordings: &Recordings) -> Recorded {
        let (before, after) = recordings.span();
        let timed = |entry: Arc<Entry>| Some((humantime::parse_rfc3339(&entry.time).ok()?, entry));
        Recorded {
            before,
            after,
            entries: recordings.list().into_iter().filter_map(timed).collect(),
        }
    }

    /// Adds to an event the recording of its drive that covers the event; of several, the one with the nearest trigger.
    fn show<'e>(&self, event: &'e Event) -> Shown<'e> {
        let covers = |(at, entry): &&(SystemTime, Arc<Entry>)| {
            let of_drive = event.drive.as_ref() == Some(&entry.drive);
            of_drive && event.time + self.before >= *at && event.time <= *at + self.after
        };
        let apart = |(at, _): &&(SystemTime, Arc<Entry>)| match event.time.duration_since(*at) {
            Ok(after) => after,
            Err(before) => before.duration(),
        };
        let wanted = event.recording.is_none();
        let nearest = self.entries.iter().filter(covers).min_by_key(apart).filter(|_| wanted);
        Shown {
            event,
            shown_in: nearest.map(|(_, entry)| RecordingMade {
                id: entry.id.clone(),
                trigger: entry.trigger.name().into(),
                summary: entry.summary.clone(),
            }),
        }
    }
}
