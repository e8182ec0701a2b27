//! `[speed_reference]`: meaning of the speed reference register of the family (reference/drives.md 9.2, 9.3).

use super::super::derive::{Bound, Derived};
use super::super::profile::{Form, Point, PollClass, Source};
use crate::document::{Finding, Reader};
use crate::drive::{PerPoint, PointIndex};

/// Range of a reference in percent, with and without sign.
const SIGNED: [f64; 2] = [-100.0, 100.0];
const UNSIGNED: [f64; 2] = [0.0, 100.0];

/// Applies the table `speed_reference` of the profile to the points of the references.
pub(super) fn apply(reader: &Reader<'_>, points: &mut PerPoint<Point>) {
    let Some(table) = reader.table("speed_reference") else {
        return;
    };
    let signed: Option<bool> = table.optional("signed");
    let minimum_counts = word(&table, "base", ["max", "min_max"]);
    let hertz = word(&table, "unit", ["percent", "hz"]);
    table.finish();
    let place = |name: &str| points.position(|p| p.name == name);
    let found = place("speed_reference").filter(|i| points.get(*i).is_some_and(|p| p.raw().is_some()));
    let of_reference = |p: &Point| matches!(p.source, Source::Derived(Derived::Band { of, .. }) if Some(of) == found);
    let (Some(speed), Some(frequency)) = (found, points.position(of_reference)) else {
        reader.problem(
            "speed_reference",
            "the family has no register for a reference in percent",
            "leave the table out",
        );
        return;
    };
    let lowest = place("minimum_frequency");
    if let (Some(true), None) = (minimum_counts, lowest) {
        table.problem(
            "base",
            "the profile has no point `minimum_frequency`",
            "write \"max\" or add the point",
        );
        return;
    }
    if let (Some(counts), Some(point)) = (minimum_counts, points.get_mut(frequency))
        && let Source::Derived(Derived::Band { minimum, .. }) = &mut point.source
    {
        *minimum = lowest.filter(|_| counts).map_or(Bound::Fixed(0.0), Bound::Point);
    }
    if let (Some(signed), Some(point)) = (signed, points.get_mut(speed)) {
        sign(point, signed);
    }
    if hertz == Some(true) {
        in_hertz(points, speed, frequency);
    }
}

/// Reads a key with one of two words; returns `true` for the second.
fn word(table: &Reader<'_>, key: &str, words: [&str; 2]) -> Option<bool> {
    let [first, second] = words;
    table.parsed(key, |text| match text {
        _ if text == first => Ok(false),
        _ if text == second => Ok(true),
        other => Err(Finding::new(
            format!("unknown word `{other}`"),
            format!("write \"{first}\" or \"{second}\""),
        )),
    })
}

fn sign(point: &mut Point, signed: bool) {
    if let Source::Raw(raw) = &mut point.source
        && matches!(raw.form, Form::U16 | Form::I16)
    {
        raw.form = if signed { Form::I16 } else { Form::U16 };
    }
    let [low, high] = if signed { SIGNED } else { UNSIGNED };
    point.range = Some(low..=high);
}

/// Swaps the sources of the two points, because the register holds a frequency.
fn in_hertz(points: &mut PerPoint<Point>, speed: PointIndex, frequency: PointIndex) {
    let Some(Source::Derived(Derived::Band { minimum, maximum, .. })) = points.get(frequency).map(|p| p.source.clone())
    else {
        return;
    };
    let percent = Source::Derived(Derived::Percent {
        of: frequency,
        minimum,
        maximum,
    });
    let taken = points.get_mut(speed).map(|point| {
        let raw = std::mem::replace(&mut point.source, percent);
        (
            raw,
            std::mem::replace(&mut point.class, PollClass::Never),
            std::mem::take(&mut point.on_change),
        )
    });
    if let (Some((raw, class, on_change)), Some(point)) = (taken, points.get_mut(frequency)) {
        point.source = raw;
        point.class = class;
        point.on_change = on_change;
    }
}
