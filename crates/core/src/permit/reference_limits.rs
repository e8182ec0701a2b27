//! Checks the present reference when a command changes the frequency range that its limits depend on: 80 % that were 40
//! Hz become 80 Hz if the maximum frequency is doubled. Pure.

use std::time::Instant;

use crate::order::{Order, Refusal, written};
use crate::process_image::Reading;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::parameters::RawValue;
use drivegate_model::drive::{Bound, Derived, PointIndex, Profile, Source, Value};
use drivegate_proto::Table;

/// When reference and range of a drive were written last; values read before that are not valid.
#[derive(Debug, Clone, Copy, Default)]
pub struct LastWritten {
    /// When a reference was last written.
    pub reference: Option<Instant>,
    /// When an end of the frequency range was last written.
    pub range: Option<Instant>,
}

/// The state of a drive on which limits depend.
struct Standing<'a> {
    drive: &'a Reading<'a>,
    /// The points with a register of their own that the command sets.
    sets: &'a [(PointIndex, Value)],
    /// When a started command last wrote; readings older than that are ignored. `None` if the command has not started yet.
    begun: Option<LastWritten>,
}

/// Checks whether the present reference keeps the limits once the command is executed.
///
/// # Errors
/// If a limit would be exceeded, or it is unknown whether it would be.
pub(super) fn keeps_limits(drive: &Reading<'_>, order: &Order) -> Result<(), Refusal> {
    judge(drive, &set_by(drive, order), None)
}

/// Repeats the check of the admission for an order that has started: another order may have been carried out since.
///
/// # Errors
/// If a limit would no longer be kept; contains the refusal.
pub(super) fn still_keeps_limits(drive: &Reading<'_>, order: &Order, last: LastWritten) -> Result<(), Refusal> {
    judge(drive, &set_by(drive, order), Some(last))
}

/// The limits that writing these parameters would violate, as text: those of the parameters themselves, and those
/// of the present reference.
pub fn limits_passed(drive: &Reading<'_>, parameters: impl Iterator<Item = (u16, RawValue)>) -> Vec<String> {
    let profile = &drive.spec.profile;
    let items: Vec<(u16, u16)> = parameters
        .flat_map(|(address, value)| {
            (0u16..)
                .map(move |place| address.saturating_add(place))
                .zip(value.words())
        })
        .collect();
    let sets = points_of(profile, Table::Holding, &items);
    let mut passed = Vec::new();
    for (index, value) in &sets {
        let Some(point) = profile.points.get(*index) else {
            continue;
        };
        let limits = drive.spec.limits.get(&point.name);
        if let Some(limits) = limits.filter(|limits| !limits.contains(&value.as_f64())) {
            let (low, high, unit) = (limits.start(), limits.end(), &point.unit);
            passed.push(format!(
                "`{}` would be {value} {unit}, outside the limits {low} to {high} {unit} of `{}`",
                point.name, drive.spec.name
            ));
        }
    }
    passed.extend(judge(drive, &sets, None).err().map(|refusal| refusal.to_string()));
    passed
}

/// Whether the register is a reference whose value in another unit rests on the frequency range.
pub fn is_reference(profile: &Profile, table: Table, address: u16) -> bool {
    let bands = profile.points.iter().filter_map(|point| match &point.source {
        Source::Derived(derived) if point.write => derived.band(),
        _ => None,
    });
    let mut raws = bands.filter_map(|(of, ..)| profile.points.get(of)?.raw());
    raws.any(|raw| raw.covers(table, address))
}

/// The points with a register of their own that a command sets.
fn set_by(drive: &Reading<'_>, order: &Order) -> Vec<(PointIndex, Value)> {
    let profile = &drive.spec.profile;
    match order {
        _ if drive.spec.limits.is_empty() => Vec::new(),
        Order::Points(values) => values.clone(),
        Order::Write(pdu) => match written(pdu) {
            Some((table, items)) => points_of(profile, table, &items),
            None => Vec::new(),
        },
        Order::Read(_) | Order::Parameter(_) => Vec::new(),
    }
}

/// The numeric points in these registers.
fn points_of(profile: &Profile, table: Table, items: &[(u16, u16)]) -> Vec<(PointIndex, Value)> {
    let word = |address: u16| items.iter().find(|(at, _)| *at == address).map(|(_, word)| *word);
    let numbers = profile
        .points
        .enumerate()
        .filter(|(_, point)| point.kind() != Kind::Bool);
    numbers
        .filter_map(|(index, point)| {
            let raw = point.raw().filter(|raw| raw.table == table)?;
            let words: Option<Vec<u16>> = raw.addresses().map(word).collect();
            Some((index, raw.decode(&words?, Kind::Number)?))
        })
        .collect()
}

fn judge(drive: &Reading<'_>, sets: &[(PointIndex, Value)], begun: Option<LastWritten>) -> Result<(), Refusal> {
    let profile = &drive.spec.profile;
    let standing = Standing { drive, sets, begun };
    for (index, point) in profile.points.enumerate() {
        let Some(limits) = drive.spec.limits.get(&point.name) else {
            continue;
        };
        let Some((derived, end)) = standing.changed(index) else {
            continue;
        };
        let end = profile.points.get(end).map_or("?", |end| end.name.as_str());
        let Some(figure) = standing.becomes(derived) else {
            return Err(Refusal::NotKnown(format!(
                "the limits of `{}` depend on `{end}`, and its effect on the present reference is unknown: the \
                 reference or the drive's frequency range was not read recently, or was written since; nothing was \
                 written; send it again",
                point.name
            )));
        };
        if !limits.contains(&figure) {
            let (low, high, unit) = (limits.start(), limits.end(), &point.unit);
            return Err(Refusal::BadValue(format!(
                "with that `{end}` the present reference would make `{}` {figure} {unit}, outside the limits {low} to \
                 {high} {unit}; nothing was written; lower the reference first",
                point.name
            )));
        }
    }
    Ok(())
}

impl<'a> Standing<'a> {
    /// The conversion of a point from the reference, and the end of its band that the order sets; `None` if the
    /// order sets neither end.
    fn changed(&self, point: PointIndex) -> Option<(&'a Derived, PointIndex)> {
        let point = self.drive.spec.profile.points.get(point)?;
        match (&point.source, point.write_to) {
            (_, Some(target)) => self.changed(target),
            (Source::Derived(derived), None) => {
                let mut ends = derived.ends();
                Some((derived, ends.find(|end| self.set(*end).is_some())?))
            }
            (Source::Raw(_), None) => None,
        }
    }

    fn set(&self, point: PointIndex) -> Option<f64> {
        let (_, value) = self.sets.iter().find(|(index, _)| *index == point)?;
        Some(value.as_f64())
    }

    /// The value of the point once the command is executed.
    fn becomes(&self, derived: &Derived) -> Option<f64> {
        let (of, minimum, maximum) = derived.band()?;
        let configured = self.drive.spec.frequency_range.as_ref();
        let written = self.begun.unwrap_or_default();
        let end = |bound: Bound, configured: Option<f64>| match bound {
            Bound::Fixed(figure) => Some(figure),
            Bound::Configured => configured,
            Bound::Point(point) => self.known(point, written.range).or(configured),
        };
        let band = (
            end(minimum, configured.map(|range| *range.start()))?,
            end(maximum, configured.map(|range| *range.end()))?,
        );
        let of = self.known(of, written.reference)?;
        Some(derived.value([Value::Number(of)], Some(band))?.as_f64())
    }

    /// The value that the command gives a point, or else its present value.
    fn known(&self, point: PointIndex, written: Option<Instant>) -> Option<f64> {
        if let Some(set) = self.set(point) {
            return Some(set);
        }
        let sample = self.drive.sample(point);
        let at = sample.at?;
        let age = self.drive.now.saturating_duration_since(at);
        let says = match self.begun {
            Some(_) => written.is_none_or(|written| at > written),
            None => age <= self.drive.parameter_age(),
        };
        Some(sample.good().filter(|_| says)?.as_f64())
    }
}

#[cfg(test)]
mod tests;
