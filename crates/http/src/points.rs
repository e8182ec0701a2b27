//! `GET /api/v1/drives/{name}/points`: points of a drive, with the reason where one has no value.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Json;
use axum::extract::{Path, RawQuery, State};

use super::app_state::AppState;
use super::messages::{NO_REPLY, PointValue, Word};
use super::operating::Viewer;
use super::query;
use super::replies::{Replied, not_found};
use drivegate_core::order::{self, Authority, Order, Origin};
use drivegate_core::plant::{DriveHandle, OrderRequest};
use drivegate_core::process_image::{Link, Reading, Unavailable, public_points};
use drivegate_model::drive::{Point, PointIndex, PollClass, Profile, Quality, Raw, Sample, Source};
use drivegate_proto::{Reply, RequestPdu};

/// Maximum number of points in one request, more than a profile has.
const MAX_POINTS: usize = 1024;
/// Time for all points that are not polled and have to be read from the drive.
const FORWARDED: Duration = Duration::from_secs(10);

/// The points of a drive that are polled, or the points in `names`. A point that is not polled is read from the drive
/// for anyone who may command it.
pub(super) async fn points(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    RawQuery(query): RawQuery,
    viewer: Replied<Viewer>,
) -> Replied<Json<Vec<PointValue>>> {
    let [names] = query::parameters(query.as_deref(), &["names"])?;
    let names = names.unwrap_or_default();
    let names: Vec<&str> = names.split(',').filter(|name| !name.is_empty()).collect();
    let drive = app.drive(&name)?;
    let wanted = wanted(&drive.image.spec.profile, &names).map_err(|why| not_found(why, Vec::new()))?;
    let origin = viewer.ok().map(|Viewer(operator)| operator.origin());
    Ok(Json(read(&drive, wanted, origin).await))
}

/// Reads the points; those that are not polled are read from the drive as `origin`.
async fn read(drive: &DriveHandle, wanted: Vec<RequestedValue>, origin: Option<Origin>) -> Vec<PointValue> {
    let profile = &drive.image.spec.profile;
    let now = Instant::now();
    // A single snapshot of the image, so that all values of one poll belong together.
    let reading = drive.reading(now);
    let mut points = Vec::with_capacity(wanted.len());
    for one in wanted {
        let index = match one {
            RequestedValue::Word(word) => {
                points.push(PointValue::word(word, word_of(word, drive, &reading)));
                continue;
            }
            RequestedValue::Point(index) => index,
        };
        let Some(point) = profile.points.get(index) else {
            continue;
        };
        let not_polled = point.raw().filter(|_| point.class == PollClass::Never);
        points.push(match (not_polled, &origin) {
            (Some(raw), Some(origin)) => forwarded(drive, point, raw, origin.clone(), now + FORWARDED).await,
            _ => PointValue::new(point, &reading.sample(index), || why_not_good(drive, &reading, index)),
        });
    }
    points
}

/// The value that a name in the query stands for.
#[derive(Debug, Clone, Copy)]
enum RequestedValue {
    /// A point, by its index in the profile.
    Point(PointIndex),
    Word(Word),
}

/// The state or fault text of the drive or, if it is not good, the quality of its source and the reason.
fn word_of(word: Word, drive: &DriveHandle, reading: &Reading<'_>) -> Result<String, (Quality, String)> {
    let profile = &reading.spec.profile;
    let bad = word
        .sources()
        .iter()
        .filter_map(|point| profile.model_index(*point))
        .find(|index| {
            let sample = reading.sample(*index);
            sample.good().is_none()
        });
    let not_good = || {
        let index = bad.unwrap_or_default();
        (reading.sample(index).quality, why_not_good(drive, reading, index))
    };
    match word {
        Word::State => reading
            .state()
            .map(|state| state.name().to_string())
            .ok_or_else(not_good),
        Word::FaultText if bad.is_some() => Err(not_good()),
        Word::FaultText => Ok(reading.fault_text()),
    }
}

fn wanted(profile: &Profile, names: &[&str]) -> Result<Vec<RequestedValue>, String> {
    if names.len() > MAX_POINTS {
        return Err(format!(
            "{} points are requested; at most {MAX_POINTS} are allowed",
            names.len()
        ));
    }
    if names.is_empty() {
        let all = public_points(profile).into_iter();
        return Ok(all.map(|(index, _)| RequestedValue::Point(index)).collect());
    }
    let of = |name: &&str| {
        let has = |word: &Word| word.sources().iter().any(|point| profile.model_index(*point).is_some());
        let word = || Word::of(name).filter(has).map(RequestedValue::Word);
        let shown = |index: &PointIndex| profile.points.get(*index).is_some_and(|point| !point.hidden);
        let point = profile.point_index(name).filter(shown).map(RequestedValue::Point);
        point
            .or_else(word)
            .ok_or_else(|| format!("profile `{}` has no point `{name}`", profile.name))
    };
    names.iter().map(of).collect()
}

/// Reads a point that is not polled from the drive.
async fn forwarded(drive: &DriveHandle, point: &Point, raw: &Raw, origin: Origin, deadline: Instant) -> PointValue {
    let pdu = RequestPdu::Read {
        table: raw.table,
        start: raw.address,
        count: raw.form.items(),
    };
    let now = Instant::now();
    let expiry = deadline.saturating_duration_since(now);
    let mut placed = drive.place(
        OrderRequest::new(Order::Read(pdu), origin, Authority::ReadOnly).within(expiry),
        now,
    );
    let outcome = placed.answered().await.outcome;
    let words: Option<Vec<u16>> = match &outcome {
        order::Outcome::Acknowledged(Reply::Registers(words)) => Some(words.clone()),
        order::Outcome::Acknowledged(Reply::Bits(bits)) => Some(bits.iter().map(|b| u16::from(*b)).collect()),
        _ => None,
    };
    let was_read = words.is_some();
    let value = words.and_then(|words| raw.decode(&words, point.kind()));
    let sample = Sample {
        value,
        quality: if value.is_some() { Quality::Good } else { Quality::Bad },
        at: None,
    };
    PointValue::new(point, &sample, || {
        if was_read {
            NO_NUMBER.to_string()
        } else {
            outcome.to_string()
        }
    })
}

const NO_NUMBER: &str = "the register does not hold a number";

/// Why a polled or derived point has no good value.
fn why_not_good(drive: &DriveHandle, reading: &Reading<'_>, index: PointIndex) -> String {
    if !drive.bus_up() {
        let reason = drive.bus.image.health().reason;
        return reason.map_or("the bus is down".to_string(), |why| format!("the bus is down: {why}"));
    }
    match reading.snapshot.link {
        Link::Untried => return "the drive has not been polled yet".to_string(),
        Link::Offline(_) => return NO_REPLY.to_string(),
        Link::Online(_) => {}
    }
    let profile = &reading.spec.profile;
    let point = profile.points.get(index);
    let rests_on = match point.map(|point| &point.source) {
        Some(Source::Derived(derived)) => derived.rests_on(),
        _ => vec![index],
    };
    let sources = rests_on.into_iter().filter_map(|source| profile.points.get(source));
    let because = sources.filter_map(|source| {
        let why = why_no_words(reading, source.raw()?)?;
        let is_itself = point.is_some_and(|point| point.name == source.name);
        Some(if is_itself {
            why
        } else {
            format!("`{}`: {why}", source.name)
        })
    });
    because
        .into_iter()
        .next()
        .unwrap_or_else(|| match point.map(|point| &point.source) {
            Some(Source::Derived(_)) => "it cannot be derived: its range is unknown".to_string(),
            _ => NO_NUMBER.to_string(),
        })
}

/// Why the words of a register are not good; `None` if they are good.
fn why_no_words(reading: &Reading<'_>, raw: &Raw) -> Option<String> {
    match reading.words(raw.table, raw.address, raw.form.items()).err()? {
        Unavailable::Refused(code) => Some(format!("the drive refused it with {code}")),
        Unavailable::NotPolled => Some("it is not polled".to_string()),
        Unavailable::Stale => Some(match reading.snapshot.read_at(raw.table, raw.address) {
            Some(at) => {
                let age = reading.now.saturating_duration_since(at).as_secs_f64();
                format!("last read {age:.1} s ago")
            }
            None => "it has not been read yet".to_string(),
        }),
    }
}
