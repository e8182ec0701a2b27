//! `GET /api/v1/drives/{drive}/trend`: past values of a drive.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use axum::Json;
use axum::extract::{Path, RawQuery, State};
use axum::http::header;
use axum::response::IntoResponse;
use serde::Serialize;

use super::app_state::AppState;
use super::query::{self, QueryError};
use super::replies::{Replied, no_drive, not_found};
use drivegate_core::history::trend::{DriveTrend, Part, RANGES, Range, Reach, Step, points_of};
use drivegate_core::history::{Clock, DriveHistory};
use drivegate_model::drive::ModelPoint;

/// Time span shown without `from`.
const SHOWN: Duration = Duration::from_secs(600);

/// The trend requested by a client.
#[derive(Debug, PartialEq)]
struct RequestedTrend {
    /// Names of the points; empty if the request only asks which points exist.
    points: Vec<String>,
    from: SystemTime,
    to: SystemTime,
    csv: bool,
}

impl RequestedTrend {
    fn of(query: Option<&str>, now: SystemTime) -> Result<RequestedTrend, QueryError> {
        let [point, from, to, format] = query::parameters(query, &["point", "from", "to", "format"])?;
        let time = |name, value: Option<String>, otherwise| {
            value.map_or(Ok(otherwise), |value| query::time(name, &value, now))
        };
        let to_text = to.clone().unwrap_or_default();
        let to = time("to", to, now)?.min(now);
        let from = time("from", from, to.checked_sub(SHOWN).unwrap_or(to))?;
        // No trend goes further back than this one.
        let [.., Range { span, .. }] = RANGES;
        let from = now.checked_sub(span).map_or(from, |oldest| from.max(oldest));
        if from > to {
            return Err(QueryError::Value {
                name: "to",
                value: to_text,
                expected: "it must be later than `from`, and `from` not in the future",
            });
        }
        let csv = match format.as_deref() {
            None | Some("json") => false,
            Some("csv") => true,
            Some(other) => {
                return Err(QueryError::Value {
                    name: "format",
                    value: other.to_string(),
                    expected: "it is `json` or `csv`",
                });
            }
        };
        let mut points: Vec<String> = Vec::new();
        for point in point.iter().flat_map(|points| points.split(',')).map(str::trim) {
            // Each point counts once, so that a reply is bounded for any request.
            if !point.is_empty() && points.iter().all(|known| known != point) {
                points.push(point.to_string());
            }
        }
        Ok(RequestedTrend { points, from, to, csv })
    }
}

/// The trends of one drive: without `point` the names of the available ones, with one `point` an object, with
/// several a list of objects.
pub(super) async fn trend(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    RawQuery(query): RawQuery,
) -> Replied {
    let plant = app.plant.load();
    let drive = plant.drive(&name).ok_or_else(|| no_drive(&plant, &name))?;
    let clock = Clock::read();
    let wanted = RequestedTrend::of(query.as_deref(), clock.wall)?;
    let _turn = app.turn().await;
    let history = app.north.history.drive(&name);
    let profile = &drive.image.spec.profile;
    let known: Vec<ModelPoint> = points_of(profile).map(|(point, _)| point).collect();
    let mut points = Vec::new();
    for name in &wanted.points {
        let Some(point) = known.iter().find(|point| point.name() == name) else {
            let known = known.iter().map(|point| point.name().to_string()).collect();
            let drive = &drive.image.spec.name;
            let why = format!("no trend of `{name}` is kept for drive `{drive}`");
            return Err(not_found(why, known));
        };
        points.push(*point);
    }
    let every = points.is_empty() && wanted.csv;
    let points = if every { &known } else { &points };
    let [from, to] = [wanted.from, wanted.to].map(|at| clock.instant_at(at));
    let part = |trend: &DriveTrend, point: &ModelPoint| trend.part(*point, from, to, clock);
    let parts: Vec<Part> = match &history {
        Some(history) => {
            let trend = history.trend();
            points.iter().filter_map(|point| part(&trend, point)).collect()
        }
        // The bus of the drive is just being started, so there is no history yet.
        None => {
            let nothing = DriveTrend::new(profile, Reach::FULL, clock);
            points.iter().filter_map(|point| part(&nothing, point)).collect()
        }
    };
    if wanted.csv {
        let csv = [(header::CONTENT_TYPE, "text/csv; charset=utf-8")];
        return Ok((csv, text(&parts)).into_response());
    }
    Ok(match (&parts[..], &wanted.points[..]) {
        (_, []) => Json(DriveTrends::new(&name, history.as_deref(), &known)).into_response(),
        ([part], [_]) => Json(Shown::new(&name, part)).into_response(),
        _ => {
            let all: Vec<_> = parts.iter().map(|part| Shown::new(&name, part)).collect();
            Json(all).into_response()
        }
    })
}

/// The trends that a drive has.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct DriveTrends<'d> {
    drive: &'d str,
    ranges: Vec<KeptRange>,
    points: Vec<KeptPoint>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct KeptRange {
    span_s: u64,
    step_s: u64,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct KeptPoint {
    point: &'static str,
    unit: &'static str,
    /// Memory that the trend takes, bytes.
    bytes: usize,
}

impl<'d> DriveTrends<'d> {
    fn new(drive: &'d str, history: Option<&DriveHistory>, known: &[ModelPoint]) -> DriveTrends<'d> {
        let bytes: Vec<_> = history.map_or_else(Vec::new, |history| history.trend().points().collect());
        let ranges = history.map_or(RANGES, |history| history.trend().ranges());
        let of = |point: ModelPoint| bytes.iter().find(|(known, _)| *known == point).map_or(0, |(_, b)| *b);
        let range = |range: Range| KeptRange {
            span_s: range.span.as_secs(),
            step_s: range.step.as_secs(),
        };
        let point = |point: &ModelPoint| KeptPoint {
            point: point.name(),
            unit: point.unit(),
            bytes: of(*point),
        };
        DriveTrends {
            drive,
            ranges: ranges.into_iter().map(range).collect(),
            points: known.iter().map(point).collect(),
        }
    }
}

/// The trend of one point.
#[derive(Debug, Serialize, utoipa::ToSchema)]
#[schema(as = Trend)]
pub(super) struct Shown<'p> {
    drive: &'p str,
    point: &'p str,
    unit: &'p str,
    step_s: u64,
    #[serde(serialize_with = "drivegate_core::event::rfc3339")]
    #[schema(value_type = String)]
    from: SystemTime,
    #[serde(serialize_with = "drivegate_core::event::rfc3339")]
    #[schema(value_type = String)]
    to: SystemTime,
    /// The steps, each with its beginning (ms since 1970) and the least, greatest and last value; `null` without a
    /// value.
    #[schema(value_type = Vec<Option<Vec<f64>>>)]
    samples: Vec<Option<(u64, f32, f32, f32)>>,
}

impl<'p> Shown<'p> {
    fn new(drive: &'p str, part: &'p Part) -> Shown<'p> {
        let sample = |step: &Option<Step>| step.map(|Step { at, min, max, last }| (at, min, max, last));
        Shown {
            drive,
            point: part.point,
            unit: part.unit,
            step_s: part.step.as_secs(),
            from: part.from,
            to: part.to,
            samples: part.steps.iter().map(sample).collect(),
        }
    }
}

/// RFC 4180 with a header line: a line for each step, three columns for each point.
fn text(parts: &[Part]) -> String {
    let mut text = "time".to_string();
    for part in parts {
        for column in ["min", "max", "last"] {
            // Writing to a string cannot fail.
            let _ = write!(text, ",{} {column} [{}]", part.point, part.unit);
        }
    }
    text.push_str("\r\n");
    let Some(first) = parts.first() else { return text };
    let mut at = first.from;
    for number in 0..first.steps.len() {
        let _ = write!(text, "{}", humantime::format_rfc3339_millis(at));
        at += first.step;
        for part in parts {
            match part.steps.get(number).copied().flatten() {
                Some(Step { min, max, last, .. }) => {
                    let _ = write!(text, ",{min},{max},{last}");
                }
                None => text.push_str(",,,"),
            }
        }
        text.push_str("\r\n");
    }
    text
}
