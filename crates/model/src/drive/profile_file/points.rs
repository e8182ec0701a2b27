//! Reads `[[point]]`: one named value.

use crate::drive::{PerPoint, PointIndex};
use std::collections::BTreeMap;

use super::super::Value;
use super::super::derive::Derived;
use super::super::model::{Kind, ModelPoint};
use super::super::profile::{AddressRange, Blocks, Form, Order, Point, PollClass, Raw, Source};
use super::derived::{point_of, read_derived};
use super::place::read_raw;
use super::ranges::Offsets;
use super::{is_name, read_pair};
use crate::document::{Finding, Reader};
use drivegate_proto::Table;

/// Names that are keys of states and commands, or have their own metrics: a point with such a name could not be
/// distinguished from them.
const TAKEN: [&str; 20] = [
    "age_ms",
    "blocked_by",
    "command_error",
    "command_result",
    "expires_ms",
    "fault_text",
    "historical",
    "hold",
    "hold_left_s",
    "holder",
    "holder_rank",
    "id",
    "omitted",
    "point_quality",
    "profile_verified",
    "quality",
    "refreshing",
    "state",
    "stop_waits_ms",
    "time",
];
/// Address of ADI 1 of N2 in the table of input registers.
const FIRST_ADI: u16 = 0x4000;

pub(super) fn read_point(
    reader: &Reader<'_>,
    place: usize,
    names: &[String],
    ranges: &[AddressRange],
    offsets: &Offsets,
) -> Point {
    let name: String = reader.required("name").unwrap_or_default();
    if !is_name(&name, '_') {
        reader.problem(
            "name",
            format!("`{name}` is not a valid name"),
            "write a-z, 0-9 and _, starting with a letter",
        );
    }
    if TAKEN.contains(&name.as_str()) {
        reader.problem(
            "name",
            format!("`{name}` is a key that the gateway itself uses in states, commands or metrics"),
            format!("write another name, such as `drive_{name}`"),
        );
    }
    if names.iter().take(place).any(|n| *n == name) {
        reader.problem("name", format!("there are two points `{name}`"), "rename one of them");
    }
    let model = ModelPoint::from_name(&name);
    if model.is_none()
        && let Some(meant) = misspelt(&name)
    {
        reader.warning(
            "name",
            format!("`{name}` is not a point of the common model, but differs from `{meant}` by one letter"),
            format!("write `{meant}`, or choose a name that cannot be mistaken for it"),
        );
    }
    let source = if reader.has("derive") {
        read_derived(reader, names)
    } else {
        read_raw(reader, names, ranges, offsets)
    };
    let found = source.is_some();
    let unit = match model {
        Some(model) => {
            if reader.has("unit") && reader.optional::<String>("unit").as_deref() != Some(model.unit()) {
                reader.problem(
                    "unit",
                    format!("the unit of `{name}` is always `{}`", model.unit()),
                    "leave the key out",
                );
            }
            model.unit().to_string()
        }
        None => reader.or("unit", String::new()),
    };
    // The other keys of a point count as known even if its source is faulty.
    let derived = reader.has("derive");
    let class = if derived { PollClass::Never } else { read_class(reader) };
    let point = Point {
        name,
        model,
        unit,
        class,
        fast_if_carried: reader.or("fast_if_carried", false) && class == PollClass::Slow,
        monitor: reader
            .optional::<String>("monitor")
            .and_then(|name| point_of(reader, "monitor", &name, names)),
        write: reader.or("write", false),
        write_to: reader
            .optional::<String>("write_to")
            .and_then(|name| point_of(reader, "write_to", &name, names)),
        pulse: reader.or("pulse", false),
        on_change: reader.or("on_change", false),
        range: read_pair::<f64>(reader, "range"),
        texts: read_texts(reader),
        unlisted: reader.or("unlisted", false),
        hidden: reader.or("hidden", false),
        blocks: read_blocks(reader),
        verified: reader.or("verified", true),
        note: reader.or("note", String::new()),
        source: source.unwrap_or(Source::Derived(Derived::All { of: Vec::new() })),
    };
    if found {
        check_kind(reader, &point);
        check_write(reader, &point, ranges);
    }
    check_texts(reader, &point, names);
    if point.hidden && point.model.is_some() {
        reader.problem(
            "hidden",
            format!(
                "`{}` is a point of the common model, which every server shows",
                point.name
            ),
            "give a helper a name of its own",
        );
    }
    reader.finish();
    point
}

/// The point of the common model that a name is a slip away from.
fn misspelt(name: &str) -> Option<&'static str> {
    let near = |model: &&'static str| {
        let numbered = name.ends_with(|c: char| c.is_ascii_digit());
        // Most names differ in length by more than one letter, so they need no comparison.
        let near = name.len().abs_diff(model.len()) <= 1;
        near && model.len() > 5 && !numbered && strsim::damerau_levenshtein(name, model) == 1
    };
    ModelPoint::ALL.iter().map(|point| point.name()).find(near)
}

fn read_class(reader: &Reader<'_>) -> PollClass {
    let class = reader.parsed("class", |text| match text {
        "fast" => Ok(PollClass::Fast),
        "slow" => Ok(PollClass::Slow),
        "once" => Ok(PollClass::Once),
        "never" => Ok(PollClass::Never),
        other => Err(Finding::new(
            format!("unknown poll class `{other}`"),
            "write fast, slow, once or never",
        )),
    });
    class.unwrap_or(PollClass::Slow)
}

/// Checks `write_to`: the other point must be writable itself.
pub(super) fn check_target(reader: &Reader<'_>, index: PointIndex, points: &PerPoint<Point>) {
    let Some(point) = points.get(index) else { return };
    let Some(target) = point.write_to.and_then(|to| points.get(to)) else {
        return;
    };
    if !point.write {
        reader.problem("write_to", "the point is not writable", "add `write = true`");
    }
    if is_reference(point) && target.raw().is_some_and(|raw| raw.scale < 0.0) {
        reader.problem(
            "write_to",
            format!(
                "a positive `{}` would be a negative count, with which drives turn in reverse",
                point.name
            ),
            "write a positive scale there",
        );
    }
    if !target.write || target.write_to.is_some() {
        reader.problem(
            "write_to",
            format!("`{}` does not accept commands itself", target.name),
            "name a point with `write = true` and without `write_to`",
        );
    } else if target.kind() != point.kind() {
        reader.problem(
            "write_to",
            format!("`{}` has another type", target.name),
            "name a point with values of the same type",
        );
    }
}

/// Checks `monitor`: both points must have their own registers and values of equal type.
pub(super) fn check_monitor(reader: &Reader<'_>, index: PointIndex, points: &PerPoint<Point>) {
    let Some(point) = points.get(index) else { return };
    let Some(monitor) = point.monitor.and_then(|monitor| points.get(monitor)) else {
        return;
    };
    if point.class != PollClass::Fast || point.raw().is_none() {
        reader.problem(
            "monitor",
            "only a register of process data is compared",
            "set `class = \"fast\"`, or leave `monitor` out",
        );
    }
    let registers = monitor.raw().map(|raw| raw.addresses().collect::<Vec<_>>());
    let same = registers == point.raw().map(|raw| raw.addresses().collect());
    if registers.is_none() || same || monitor.monitor.is_some() {
        reader.problem(
            "monitor",
            format!("`{}` is not a register of its own", monitor.name),
            "name a point that is read from another register",
        );
    } else if (monitor.kind() == Kind::Bool) != (point.kind() == Kind::Bool) || monitor.unit != point.unit {
        reader.problem(
            "monitor",
            format!("`{}` has another type or unit", monitor.name),
            "name a point with values of the same type and unit",
        );
    }
}

/// `blocks`, `blocks_when` and `remedy`: a state that keeps the motor from running.
fn read_blocks(reader: &Reader<'_>) -> Option<Blocks> {
    let cause: Option<String> = reader.optional("blocks");
    let when = reader.or("blocks_when", true);
    let remedy: Option<String> = reader.optional("remedy");
    let Some(cause) = cause else {
        for key in ["blocks_when", "remedy"].into_iter().filter(|key| reader.has(key)) {
            reader.problem(key, "without `blocks` it has no effect", "add `blocks = \"cause\"`");
        }
        return None;
    };
    if !is_name(&cause, '_') {
        let what = format!("`{cause}` is not a valid cause");
        reader.problem("blocks", what, "write a-z, 0-9 and _, starting with a letter");
    }
    if remedy.as_deref().unwrap_or_default().is_empty() {
        reader.problem(
            "remedy",
            "a cause needs a remedy",
            "write what to do as `remedy = \"…\"`",
        );
    }
    Some(Blocks {
        cause,
        when,
        remedy: remedy?,
    })
}

/// Reads `[point.texts]`: what the values of an enumeration mean.
fn read_texts(reader: &Reader<'_>) -> BTreeMap<i64, String> {
    let Some(table) = reader.table("texts") else {
        return BTreeMap::new();
    };
    let mut texts = BTreeMap::new();
    for key in table.keys() {
        let text: Option<String> = table.optional(key);
        match (key.parse::<i64>(), text) {
            (Ok(value), Some(text)) => {
                texts.insert(value, text);
            }
            (Err(_), _) => table.problem(
                key,
                format!("`{key}` is not a whole number"),
                "write value = \"meaning\"",
            ),
            (Ok(_), None) => {}
        }
    }
    table.finish();
    texts
}

/// Checks that a point of the common model has the kind of the model, and that enumerations and bits have no scale.
fn check_kind(reader: &Reader<'_>, point: &Point) {
    let figure = match &point.source {
        Source::Raw(raw) => !raw.is_bool(),
        Source::Derived(derived) => !matches!(
            derived,
            Derived::Zero { .. } | Derived::Equal { .. } | Derived::All { .. } | Derived::State { .. }
        ),
    };
    let key = if reader.has("derive") { "derive" } else { "at" };
    match point.model.map(ModelPoint::kind) {
        Some(Kind::Bool) if figure => reader.problem(
            key,
            format!("`{}` is true or false", point.name),
            "name a bit, such as \"holding 2100.3\"",
        ),
        Some(_) if point.kind() == Kind::Text => reader.problem(
            "type",
            format!("`{}` is not a text in the common model", point.name),
            "name a register with a number, or choose another name",
        ),
        Some(Kind::Number | Kind::Integer) if !figure => reader.problem(
            key,
            format!("`{}` is a number, not a bit", point.name),
            "name a register",
        ),
        _ => {}
    }
    let scales = ["scale", "offset", "scale_from", "factor_from"];
    if let Some(key) = scales.into_iter().find(|key| reader.has(key))
        && !reader.has("equals")
        && point.raw().is_some()
        && point.kind() != Kind::Number
    {
        reader.problem(
            key,
            format!("`{}` is a state or a code, which has no scale", point.name),
            "leave the key out",
        );
    }
}

fn check_texts(reader: &Reader<'_>, point: &Point, names: &[String]) {
    if point.unlisted && (point.texts.is_empty() || !point.write) {
        reader.problem(
            "unlisted",
            "only a writable enumeration accepts values that `texts` does not list",
            "leave the key out",
        );
    }
    if point.texts.is_empty() {
        return;
    }
    if point.kind() == Kind::Text {
        reader.problem("texts", "a text is not an enumeration", "leave the table out");
    }
    let beside = format!("{}_text", point.name);
    if names.contains(&beside) {
        reader.problem(
            "name",
            format!(
                "the text of `{}` is shown as `{beside}`, which is also a point",
                point.name
            ),
            "rename one of them",
        );
    }
}

/// Checks the object of an N2 point: floats at even addresses below 0x4000, internal integers from there on.
pub(super) fn check_object(reader: &Reader<'_>, index: PointIndex, points: &PerPoint<Point>) {
    let Some(raw) = points
        .get(index)
        .and_then(Point::raw)
        .filter(|raw| !raw.table.is_bits())
    else {
        return;
    };
    let integer = raw.table == Table::Input && raw.address >= FIRST_ADI;
    match raw.form {
        Form::F32 if !integer && raw.address % 2 == 0 && raw.order == Order::Abcd => {}
        Form::U16 | Form::I16 if integer => {}
        _ if integer => reader.problem(
            "at",
            "an ADI has exactly one register",
            "write type = \"i16\" and no bit",
        ),
        _ => reader.problem(
            "at",
            "AI and AO of N2 are floats at even addresses, number n at 2(n-1)",
            "write type = \"f32\" and such an address",
        ),
    }
}

fn is_reference(point: &Point) -> bool {
    matches!(
        point.model,
        Some(ModelPoint::SpeedReference | ModelPoint::FrequencyReference)
    )
}

fn check_write(reader: &Reader<'_>, point: &Point, ranges: &[AddressRange]) {
    if point.pulse && !point.write {
        reader.problem("pulse", "only a writable point can be a pulse", "add `write = true`");
    }
    if point.pulse && point.kind() != Kind::Bool {
        reader.problem("pulse", "only a bit can be a pulse", "leave the key out");
    }
    if point.on_change && !point.write {
        reader.problem(
            "on_change",
            "only a writable point is written on change",
            "add `write = true`",
        );
    }
    let Some(raw) = point.raw().filter(|_| point.write && !reader.has("write_to")) else {
        return;
    };
    if raw.is_only_read() {
        let keys = ["equals", "mask", "scale_from", "factor_from"];
        let key = keys.into_iter().find(|key| reader.has(key)).unwrap_or("type");
        reader.problem(
            "write",
            format!("such a value cannot be converted back to its registers (`{key}`)"),
            "leave `write` out; bits are written with `at = \"holding 300.4-6\"`",
        );
        return;
    }
    if raw.scale < 0.0 && is_reference(point) {
        reader.problem(
            "scale",
            format!(
                "a positive `{}` would be a negative count, with which drives turn in reverse",
                point.name
            ),
            "write a positive scale",
        );
    }
    let range = ranges
        .iter()
        .find(|r| r.table == raw.table && r.addresses.contains(&raw.address));
    let (most, items) = (range.map_or(0, |r| r.write), raw.form.items());
    let ends = point.range.iter().flat_map(|range| [*range.start(), *range.end()]);
    if let Some(why) = ends.filter_map(|end| raw.encode(Value::Number(end), 0).err()).next() {
        reader.problem(
            "range",
            format!("`range` goes beyond the register: {why}"),
            "write a range within the register, or correct `type`, `scale` or `offset`",
        );
    }
    if most == 0 {
        reader.problem(
            "write",
            format!("{} {} is in a read-only range", raw.table, raw.address),
            "set `write` there",
        );
    } else if most < items {
        reader.problem(
            "write",
            format!("the value takes {items} registers, its range writes {most}"),
            "raise `write` there",
        );
    }
}

/// Checks `scale_from`: an integer that is read from the drive.
pub(super) fn check_scale(reader: &Reader<'_>, index: PointIndex, points: &PerPoint<Point>) {
    let scale = points.get(index).and_then(Point::raw).and_then(|raw| raw.scale_from);
    let Some(scale) = scale.and_then(|scale| points.get(scale)) else {
        return;
    };
    let whole = |raw: &Raw| {
        raw.is_unscaled() && !raw.is_bool() && !matches!(raw.form, Form::F32 | Form::F64 | Form::Text { .. })
    };
    if !scale.raw().is_some_and(whole) {
        reader.problem(
            "scale_from",
            format!("`{}` is not a whole number without a scale of its own", scale.name),
            "name a point with type = \"i16\" and no `scale`",
        );
    } else if scale.class == PollClass::Never {
        reader.problem(
            "scale_from",
            format!("`{}` is never read", scale.name),
            "give it another class",
        );
    }
}

/// Checks `factor_from`: numbers that are read from the drive, and depend on no other.
pub(super) fn check_factors(reader: &Reader<'_>, index: PointIndex, points: &PerPoint<Point>) {
    let factors = points.get(index).and_then(Point::raw).map(|raw| &raw.factor_from);
    for factor in factors.into_iter().flatten().filter_map(|factor| points.get(*factor)) {
        let is_number = |raw: &Raw| raw.scaled_by().next().is_none() && !raw.is_bool();
        if !factor.raw().is_some_and(is_number) || factor.kind() == Kind::Text {
            reader.problem(
                "factor_from",
                format!("`{}` is not a number of a register of its own", factor.name),
                "name a point with `at`, and without `scale_from` and `factor_from`",
            );
        } else if factor.class == PollClass::Never {
            reader.problem(
                "factor_from",
                format!("`{}` is never read", factor.name),
                "give it another class",
            );
        }
    }
}
