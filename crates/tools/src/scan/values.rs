//! The first values of a drive, read as soon as the search has found it.

use std::time::{Duration, Instant, SystemTime};

use drivegate_bus::prober::Prober;
use drivegate_bus::transaction::Ended;
use drivegate_core::process_image::{DriveImage, DriveSpec, Link, Reading, value_or_null};
use drivegate_line::Lost;
use drivegate_model::drive::{ModelPoint, PlannedRead, Point, PointIndex, Profile, Quality, Source, State};
use drivegate_proto::{Reply, Request};

/// The points that are shown.
const SHOWN: [ModelPoint; 7] = [
    ModelPoint::Fault,
    ModelPoint::Running,
    ModelPoint::Ready,
    ModelPoint::OutputFrequency,
    ModelPoint::MotorSpeed,
    ModelPoint::MotorCurrent,
    ModelPoint::FaultCode,
];
/// Age of the values that counts as old; they are shown at once.
const STALE_AFTER: Duration = Duration::from_secs(60);
/// Attempts of a read.
const TRIES: u32 = 2;

/// Reads what is shown of a drive: `ready, 0.00 Hz, 0 rpm, 0.0 A`.
///
/// # Errors
/// The port was lost.
pub(super) fn read(prober: &mut Prober<'_>, spec: DriveSpec) -> Result<String, Lost> {
    let address = spec.address;
    let image = DriveImage::new(spec, Duration::from_secs(1));
    image.update(|snapshot| snapshot.link = Link::Online(SystemTime::now()));
    for read in wanted(&image) {
        let request = Request::new(address, read.pdu());
        for _ in 0..TRIES {
            let Ended::Reply(reply) = prober.ask(&request)?.ended else {
                continue;
            };
            let now = Instant::now();
            image.update(|snapshot| match reply {
                Reply::Exception(exception) => snapshot.refuse(read.table, read.start, read.count, exception),
                reply => {
                    snapshot.fast_at = Some(now);
                    snapshot.store(read.table, read.start, &reply.into_words().unwrap_or_default(), now);
                }
            });
            break;
        }
    }
    Ok(figures(&image.reading(Instant::now(), STALE_AFTER)))
}

/// The reads of the plan that the shown points rest on.
fn wanted(image: &DriveImage) -> Vec<PlannedRead> {
    let profile = &image.spec.profile;
    let shown = SHOWN.iter().filter_map(|point| profile.model_index(*point));
    let raw = |index: PointIndex| profile.points.get(index).and_then(Point::raw);
    let places: Vec<_> = shown
        .flat_map(|index| sources(profile, index))
        .filter_map(raw)
        .map(|raw| (raw.table, raw.address))
        .collect();
    let rests_on = |read: &&PlannedRead| places.iter().any(|(table, address)| read.covers(*table, *address));
    image.plan.reads.iter().filter(rests_on).cloned().collect()
}

/// The points that a point is read from.
fn sources(profile: &Profile, index: PointIndex) -> Vec<PointIndex> {
    match profile.points.get(index).map(|point| &point.source) {
        Some(Source::Derived(derived)) => {
            let below = derived.rests_on().into_iter();
            below.flat_map(|index| sources(profile, index)).collect()
        }
        Some(Source::Raw(raw)) => std::iter::once(index).chain(raw.scaled_by()).collect(),
        None => Vec::new(),
    }
}

/// A value with so many digits; empty unless its quality is good.
pub(crate) fn figure(reading: &Reading<'_>, point: ModelPoint, digits: usize) -> String {
    let sample = reading.model(point);
    let value = sample.value.filter(|_| sample.quality == Quality::Good);
    let number = value_or_null(value).as_f64();
    number.map_or_else(String::new, |value| format!("{value:.digits$}"))
}

/// State, frequency, speed, current and fault in one line; what is not good is left out.
fn figures(reading: &Reading<'_>) -> String {
    let with_unit = |point, digits, unit: &str| {
        let figure = figure(reading, point, digits);
        (!figure.is_empty()).then(|| format!("{figure} {unit}"))
    };
    let fault = Some(reading.fault_text()).filter(|text| !text.is_empty());
    let parts = [
        reading.state().map(|state| State::name(state).to_string()),
        with_unit(ModelPoint::OutputFrequency, 2, "Hz"),
        with_unit(ModelPoint::MotorSpeed, 0, "rpm"),
        with_unit(ModelPoint::MotorCurrent, 1, "A"),
        fault,
    ];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    if parts.is_empty() {
        "no values yet".to_string()
    } else {
        parts.join(", ")
    }
}
