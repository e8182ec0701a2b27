//! Checks an order by configuration, profile and limits: first the right to write, then the address, then the
//! value. Gives the reason for a refusal in words. Pure.

mod raw_write;

pub use self::raw_write::broken_limit;
use self::raw_write::{raw_write, stops};
use super::reference_limits::keeps_limits;
use crate::order::{
    Admitted, Authority, Becomes, FrequencyRange, Order, ParameterOrder, Refusal, Urgency, as_held, becomes, rests_on,
};
use crate::process_image::{Access, DriveSpec, ParamsAccess, Reading, RestoreLock};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::profile::AddressRange;
use drivegate_model::drive::{Derived, ModelPoint, Point, PointIndex, Source, Value};
use drivegate_proto::Table;

/// Values of an enumeration that a refusal names.
const MOST_TEXTS: usize = 12;

/// Checks an order against what client and drive allow, the profile and the limits, and converts it.
///
/// `client` is the authority of the client.
///
/// # Errors
/// If the order is refused. Authority, address and value are checked in this order; no value is clamped.
pub fn admit(order: Order, drive: &Reading<'_>, client: Authority) -> Result<Admitted, Refusal> {
    let alone = |order: Order, urgency: Urgency| Admitted {
        order,
        urgency,
        reference_only: false,
        ranges: Vec::new(),
    };
    match order {
        Order::Read(_) if drive.spec.access == Access::Listen => Err(Refusal::NotWritable(listens(drive))),
        Order::Read(_) => Ok(alone(order, Urgency::Read)),
        Order::Write(pdu) => {
            authority(drive, client)?;
            let ranges = raw_write(drive, &pdu)?;
            let urgency = if stops(drive, &pdu) {
                Urgency::Stop
            } else {
                Urgency::Command
            };
            let order = Order::Write(pdu);
            keeps_limits(drive, &order)?;
            Ok(Admitted {
                ranges,
                ..alone(order, urgency)
            })
        }
        Order::Points(values) => {
            authority(drive, client)?;
            let admitted = points(drive, values)?;
            keeps_limits(drive, &admitted.order)?;
            Ok(admitted)
        }
        Order::Parameter(order) => {
            authority(drive, client)?;
            parameter(drive, &order)?;
            Ok(alone(Order::Parameter(order), Urgency::Command))
        }
    }
}

/// Parameters are written only by a restore, if the drive's configuration allows it and while the restore holds the
/// drive.
fn parameter(drive: &Reading<'_>, order: &ParameterOrder) -> Result<(), Refusal> {
    let (spec, id) = (drive.spec, &order.id);
    may_restore(spec).map_err(Refusal::NotAllowed)?;
    if drive.restore_lock.and_then(RestoreLock::reason).is_none() {
        return Err(Refusal::NotAllowed(format!(
            "parameter {id} of `{}` can only be written by a restore; nothing was written",
            spec.name
        )));
    }
    let words = order.to.words().len();
    if spec
        .profile
        .commands_in(order.address, u16::try_from(words).unwrap_or(u16::MAX))
    {
        return Err(past_commands(drive, &format!("parameter {id}")));
    }
    let takes = |range: &AddressRange| usize::from(range.write) >= words;
    if !spec.profile.range(Table::Holding, order.address).is_some_and(takes) {
        return Err(Refusal::NotWritable(format!(
            "parameter {id} of `{}` is read-only or unknown",
            spec.name
        )));
    }
    Ok(())
}

/// The refusal of a write that would command the drive, although it is not an order of the model.
fn past_commands(drive: &Reading<'_>, what: &str) -> Refusal {
    Refusal::NotWritable(format!(
        "{what} of `{}` lies where the drive is commanded, so writing it could start the motor; nothing was written",
        drive.spec.name
    ))
}

/// Whether parameters of a drive may be restored.
///
/// # Errors
/// If the drive does not permit a restore: contains the reason and the remedy.
pub fn may_restore(spec: &DriveSpec) -> Result<(), String> {
    let name = &spec.name;
    if spec.access != Access::Control {
        return Err(format!(
            "drive `{name}` is only monitored; set access = \"control\" and params = \"write\" for it"
        ));
    }
    if spec.params != ParamsAccess::Write {
        return Err(format!(
            "the parameters of `{name}` are read-only; set params = \"write\" for the drive"
        ));
    }
    Ok(())
}

/// Reason why nothing is sent on a line that another master owns.
fn listens(drive: &Reading<'_>) -> String {
    format!(
        "bus `{}` only listens (mode = \"listen\"), another master owns its line; nothing is sent to `{}`",
        drive.spec.bus, drive.spec.name
    )
}

/// Whether a client may command the drive at all.
///
/// # Errors
/// If the client may not write; contains the refusal.
pub fn authority(drive: &Reading<'_>, client: Authority) -> Result<(), Refusal> {
    if drive.spec.access == Access::Listen {
        return Err(Refusal::NotAllowed(listens(drive)));
    }
    if client == Authority::ReadOnly {
        return Err(Refusal::NotAllowed(
            "this client may not write: its address is not in `write`, or, with TLS, its certificate has no role that \
             `roles` maps to \"control\""
                .to_string(),
        ));
    }
    if drive.spec.access == Access::Monitor {
        let name = &drive.spec.name;
        return Err(Refusal::NotAllowed(format!(
            "drive `{name}` is only monitored; set access = \"control\" for it"
        )));
    }
    Ok(())
}

fn points(drive: &Reading<'_>, values: Vec<(PointIndex, Value)>) -> Result<Admitted, Refusal> {
    let profile = &drive.spec.profile;
    if values.is_empty() {
        return Err(Refusal::BadValue(
            "the command names no point; nothing was written".to_string(),
        ));
    }
    let mut resolved: Vec<(PointIndex, Value)> = Vec::with_capacity(values.len());
    let mut ranges = Vec::new();
    for (index, value) in values {
        let point = profile.points.get(index).filter(|p| p.write).ok_or_else(|| {
            let name = profile.points.get(index).map_or("?", |p| p.name.as_str());
            Refusal::NotWritable(format!("`{name}` of `{}` cannot be written", drive.spec.name))
        })?;
        let value = checked(drive, index, point, value)?;
        let asked = index;
        let (index, value) = resolve(drive, index, point, value)?;
        if profile.is_past_commands(index) {
            return Err(past_commands(drive, &format!("`{}`", point.name)));
        }
        related_limits(drive, asked, index, value)?;
        if resolved.iter().any(|(other, _)| *other == index) {
            return Err(sets_twice(profile.points.get(index).map_or("", |p| p.name.as_str())));
        }
        ranges.extend(rests_on(drive, asked, (index, value)));
        resolved.push((index, value));
    }
    let set = |end: &PointIndex| resolved.iter().any(|(index, _)| index == end);
    if let Some(end) = ranges.iter().flat_map(FrequencyRange::ends).find(set) {
        return Err(changes_its_range(
            profile.points.get(end).map_or("", |p| p.name.as_str()),
        ));
    }
    let is = |point: ModelPoint, wanted: Option<bool>| {
        resolved
            .iter()
            .any(|(i, v)| profile.model_index(point) == Some(*i) && wanted.is_none_or(|wanted| v.as_bool() == wanted))
    };
    let stop = is(ModelPoint::Run, Some(false));
    let bits = resolved
        .iter()
        .any(|(i, _)| profile.points.get(*i).is_some_and(|p| p.kind() == Kind::Bool));
    let urgency = if stop { Urgency::Stop } else { Urgency::Command };
    Ok(Admitted {
        order: Order::Points(resolved),
        urgency,
        reference_only: !bits,
        ranges,
    })
}

/// The refusal of a command that sets `point` twice, under its own name or under the name of a point that depends on it.
pub fn sets_twice(point: &str) -> Refusal {
    Refusal::BadValue(format!(
        "the command sets `{point}` twice; set each point once, and only one reference"
    ))
}

fn changes_its_range(end: &str) -> Refusal {
    Refusal::BadValue(format!(
        "the command sets `{end}` and a reference that is converted or limited by it; send `{end}` first, and the \
         reference once that has been read back; nothing was written"
    ))
}

/// The value in the point's kind and within its limits.
fn checked(drive: &Reading<'_>, index: PointIndex, point: &Point, value: Value) -> Result<Value, Refusal> {
    let name = &point.name;
    let number = value.as_f64();
    if !number.is_finite() {
        return Err(Refusal::BadValue(format!(
            "`{name}` = {number} is not a number; nothing was written"
        )));
    }
    if point.kind() == Kind::Bool {
        return match value {
            Value::Bool(_) => Ok(value),
            _ if number == 0.0 || number == 1.0 => Ok(Value::Bool(number == 1.0)),
            _ => Err(Refusal::BadValue(format!(
                "`{name}` = {number} is neither true nor false; nothing was written"
            ))),
        };
    }
    if let Some(limits) = drive.spec.limits_of(index).filter(|l| !l.contains(&number)) {
        let (low, high) = limits.into_inner();
        let unit = match point.unit.as_str() {
            "" => String::new(),
            unit => format!(" {unit}"),
        };
        let text =
            format!("`{name}` = {number}{unit} is outside the limits {low} to {high}{unit}; nothing was written");
        return Err(Refusal::BadValue(text));
    }
    listed(point, value)?;
    Ok(match value {
        Value::Integer(_) | Value::Unsigned(_) if value.exact_f64().is_none() => value,
        _ => Value::Number(number),
    })
}

/// Checks the value of an enumeration: the profile lists the accepted values, unless it allows others.
fn listed(point: &Point, value: Value) -> Result<(), Refusal> {
    let number = value.as_f64();
    let is_known = || point.texts.keys().any(|code| *code as f64 == number);
    if point.texts.is_empty() || !point.write || point.unlisted || is_known() {
        return Ok(());
    }
    let known = point.texts.iter().take(MOST_TEXTS);
    let known: Vec<String> = known.map(|(code, text)| format!("{code} {text}")).collect();
    Err(Refusal::BadValue(format!(
        "`{}` = {number} is not one of its values: {}; nothing was written",
        point.name,
        known.join(", ")
    )))
}

/// Checks the limits of points for the same quantity: a command in Hz keeps the limits in percent, and vice versa. The
/// limit of `asked` is already checked.
fn related_limits(drive: &Reading<'_>, asked: PointIndex, index: PointIndex, value: Value) -> Result<(), Refusal> {
    let written = (index, as_held(drive, (index, value)));
    for (other, point) in drive.spec.profile.points.enumerate() {
        let limits = drive.spec.limits.get(&point.name);
        let Some(limits) = limits.filter(|_| other != asked && other != index) else {
            continue;
        };
        let figure = match becomes(drive, other, written) {
            Becomes::Untouched => continue,
            Becomes::Known(value) => Some(value.as_f64()),
            Becomes::Unknown => None,
        };
        let Some(figure) = figure else {
            return Err(Refusal::NotKnown(format!(
                "the limits of `{}` cannot be checked: the drive's frequency range is unknown, or was not read in the \
                 last {:.0} s; set frequency_range for the drive",
                point.name,
                drive.parameter_age().as_secs_f64()
            )));
        };
        // A negative zero turns the motor in reverse.
        let reverse = figure == 0.0 && figure.is_sign_negative() && *limits.start() >= 0.0;
        if reverse || !limits.contains(&figure) {
            let (low, high, unit) = (limits.start(), limits.end(), &point.unit);
            return Err(Refusal::BadValue(format!(
                "`{}` would be {figure} {unit}, outside the limits {low} to {high} {unit}; nothing was written",
                point.name
            )));
        }
    }
    Ok(())
}

/// A reference converted to the unit of another point that a command sets.
pub fn converted(drive: &Reading<'_>, (index, value): (PointIndex, Value), to: PointIndex) -> Option<Value> {
    let point = drive.spec.profile.points.get(index)?;
    let written = resolve(drive, index, point, value).ok()?;
    match becomes(drive, to, written) {
        Becomes::Known(value) => Some(value),
        Becomes::Unknown | Becomes::Untouched => None,
    }
}

/// Replaces a derived point by the point that it depends on; the value must fit the register.
fn resolve(
    drive: &Reading<'_>,
    index: PointIndex,
    point: &Point,
    value: Value,
) -> Result<(PointIndex, Value), Refusal> {
    if let Some(target) = point.write_to {
        let base = drive.spec.profile.points.get(target).ok_or_else(|| {
            Refusal::NotWritable(format!("point {target} of `{}` cannot be written", drive.spec.name))
        })?;
        let value = checked(drive, target, base, value)?;
        return resolve(drive, target, base, value);
    }
    match &point.source {
        Source::Raw(raw) => {
            raw.encode(value, 0)
                .map_err(|why| Refusal::BadValue(format!("`{}`: {why}; nothing was written", point.name)))?;
            Ok((index, value))
        }
        // A derived command is converted into control words when the command is sent.
        Source::Derived(Derived::State { .. }) if point.write => Ok((index, value)),
        Source::Derived(derived) => {
            let name = &point.name;
            let Some((of, minimum, maximum)) = derived.band() else {
                return Err(Refusal::NotWritable(format!(
                    "`{name}` is derived from other points and cannot be written"
                )));
            };
            let band = drive.band_for_commands(minimum, maximum).ok_or_else(|| {
                Refusal::NotKnown(format!(
                    "`{name}` needs the drive's frequency range, which is unknown, or was not read in the last {:.0} \
                     s; set frequency_range for the drive",
                    drive.parameter_age().as_secs_f64()
                ))
            })?;
            let base = drive
                .spec
                .profile
                .points
                .get(of)
                .filter(|_| band.1 > band.0)
                .ok_or_else(|| {
                    let (low, high) = band;
                    Refusal::NotWritable(format!("the frequency range {low} to {high} Hz is empty"))
                })?;
            let figure = derived
                .inverse(value.as_f64(), band)
                .ok_or_else(|| below_minimum(point, value, band.0))?;
            // The limits of the derived point were checked before; those of the point behind it apply as well.
            let rounded = Value::Number((figure * 100.0).round() / 100.0);
            let order = resolve(drive, of, base, checked(drive, of, base, rounded)?)?;
            // At the minimum frequency the percentage is 0; the calculation must not give it a sign.
            let back = derived.value([as_held(drive, order)], Some(band)).map(Value::as_f64);
            if band.0 > 0.0 && value.as_f64() < 0.0 && back.is_some_and(|back| back > 0.0) {
                return Err(no_sign(point, value));
            }
            Ok(order)
        }
    }
}

/// Refuses references below the drive's minimum frequency.
fn below_minimum(point: &Point, value: Value, minimum: f64) -> Refusal {
    let (name, unit) = (&point.name, &point.unit);
    Refusal::BadValue(format!(
        "`{name}` = {value} {unit} is below the drive's minimum frequency {minimum} {unit}; nothing was written"
    ))
}

/// The register would hold 0, which turns the motor forward.
fn no_sign(point: &Point, value: Value) -> Refusal {
    let (name, unit) = (&point.name, &point.unit);
    Refusal::BadValue(format!(
        "`{name}` = {value} {unit} is 0 % in reverse, and 0 % has no sign; use `reverse` instead; nothing was written"
    ))
}

#[cfg(test)]
mod tests;
