//! The value that a point takes when the register of another point is written. Pure.

use crate::process_image::Reading;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{Point, PointIndex, Source, Value};

/// The value that a point takes when the register of another point is written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Becomes {
    /// The two have nothing to do with each other.
    Untouched,
    /// The band for the conversion is not known.
    Unknown,
    Known(Value),
}

/// Calculates the value that a point takes when the register of another point is written: the same point, the point
/// that takes its commands, or a converted one.
pub(crate) fn becomes(drive: &Reading<'_>, point: PointIndex, written: (PointIndex, Value)) -> Becomes {
    let (index, value) = written;
    if point == index {
        return Becomes::Known(value);
    }
    let Some(entry) = drive.spec.profile.points.get(point) else {
        return Becomes::Untouched;
    };
    if let Some(target) = entry.write_to {
        return becomes(drive, target, written);
    }
    let Source::Derived(derived) = &entry.source else {
        return Becomes::Untouched;
    };
    let Some((of, minimum, maximum)) = derived.band() else {
        return Becomes::Untouched;
    };
    let of = match becomes(drive, of, written) {
        Becomes::Known(of) => of,
        other => return other,
    };
    let band = drive.band_for_commands(minimum, maximum);
    match band.and_then(|band| derived.value([of], Some(band))) {
        Some(value) => Becomes::Known(value),
        None => Becomes::Unknown,
    }
}

/// The value of a raw point as its register stores it; a value rounded to 0 has no sign.
pub(crate) fn as_held(drive: &Reading<'_>, (index, value): (PointIndex, Value)) -> Value {
    let raw = drive.spec.profile.points.get(index).and_then(Point::raw);
    let held = raw.and_then(|raw| raw.decode(&raw.encode(value, 0).ok()?, Kind::Number));
    held.filter(|held| held.as_f64() == 0.0)
        .map_or(value, |_| Value::Number(0.0))
}
