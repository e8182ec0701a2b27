//! Reads `[parameters]`: the parameters of a family.
//!
//! `list`: rows `id, address, name, unit, scale` and perhaps `, least, greatest`; `spans`: `"id 100 1998"` or `"group 100 9898"`;
//! `identification`: names of points. The other keys are read in `parameter_rules`.

use crate::drive::PerPoint;
use std::ops::RangeInclusive;

use super::super::parameters::{Label, Numbering, Parameter, ParameterList, Span, WriteRules};
use super::super::profile::{AddressRange, Point};
use super::parameter_rules;
use super::place::parse_address;
use crate::document::Reader;

pub(super) fn read(
    reader: &Reader<'_>,
    bases: &[&ParameterList],
    points: &PerPoint<Point>,
    ranges: &[AddressRange],
) -> ParameterList {
    let Some(table) = reader.table("parameters") else {
        return ParameterList::default();
    };
    let rows: Vec<String> = table.or("list", Vec::new());
    let mut named = Vec::with_capacity(rows.len());
    for row in &rows {
        match read_row(row) {
            Ok(parameter) => named.push(parameter),
            Err(why) => table.problem(
                "list",
                format!("`{row}`: {why}"),
                "write \"id, address, name, unit, scale\", such as \"Cn-02, 0x0201, Max. output frequency, Hz, 0.1\"; \
                 followed, if known, by \"least, greatest\" in the unit",
            ),
        }
    }
    named.sort_by_key(|parameter| parameter.address);
    if let Some(twice) = named
        .windows(2)
        .find(|pair| matches!(pair, [a, b] if a.address == b.address))
    {
        let id = twice.first().map_or("", |parameter| parameter.id.as_str());
        table.problem(
            "list",
            format!("the address of `{id}` is listed twice"),
            "list each parameter once",
        );
    }
    let texts: Vec<String> = table.or("spans", Vec::new());
    let spans = texts.iter().filter_map(|text| {
        let span = read_span(text);
        if span.is_none() {
            table.problem(
                "spans",
                format!("`{text}` is not a span"),
                "write for example \"id 100 1998\"",
            );
        }
        span
    });
    let spans = spans.collect();
    let names: Vec<String> = table.or("identification", Vec::new());
    let identification = names.iter().filter_map(|name| {
        let index = points.position(|point| point.name == *name && point.raw().is_some());
        if index.is_none() {
            table.problem(
                "identification",
                format!("there is no point `{name}` with an address of its own"),
                "name points of the profile",
            );
        }
        index
    });
    let mut list = ParameterList {
        identification: identification.collect(),
        named,
        spans,
        rules: WriteRules::default(),
    };
    list.rules = parameter_rules::read(&table, &list, bases, points, ranges);
    table.finish();
    list
}

fn read_span(text: &str) -> Option<Span> {
    let mut words = text.split(' ');
    let numbering = match words.next()? {
        "id" => Numbering::Id,
        "group" => Numbering::Group,
        _ => return None,
    };
    let (first, last) = (parse_address(words.next()?)?, parse_address(words.next()?)?);
    (first <= last && words.next().is_none()).then_some(Span { first, last, numbering })
}

fn read_row(row: &str) -> Result<Parameter, String> {
    let fields: Vec<&str> = row.split(',').map(str::trim).collect();
    let (id, address, name, unit, scale, range) = match fields.as_slice() {
        [id, address, name, unit, scale] => (id, address, name, unit, scale, None),
        [id, address, name, unit, scale, least, greatest] => {
            let range = read_range(least, greatest)?;
            (id, address, name, unit, scale, Some(range))
        }
        _ => return Err(format!("{} fields instead of 5 or 7", fields.len())),
    };
    if id.is_empty() || id.contains(['#', '=']) {
        return Err("the id is empty or contains # or =".to_string());
    }
    let scale: f64 = scale.parse().map_err(|_| format!("`{scale}` is not a scale"))?;
    let fits = |range: &RangeInclusive<f64>| scale == 0.0 || (range.end() / scale).abs() <= MOST_COUNTS;
    if let Some(range) = range.as_ref().filter(|range| !fits(range)) {
        return Err(format!(
            "{} {unit} is more than a register holds at a scale of {scale}; the range is in the unit",
            range.end()
        ));
    }
    Ok(Parameter {
        id: id.to_string(),
        address: parse_address(address).ok_or_else(|| format!("`{address}` is not an address"))?,
        label: Label {
            name: name.to_string(),
            unit: unit.to_string(),
            scale,
        },
        range,
    })
}

/// Highest number in a register, with room for rounding.
const MOST_COUNTS: f64 = 65_535.5;

fn read_range(least: &str, greatest: &str) -> Result<RangeInclusive<f64>, String> {
    let number = |text: &str| text.parse().ok().filter(|value: &f64| value.is_finite());
    match (number(least), number(greatest)) {
        (Some(least), Some(greatest)) if least <= greatest => Ok(least..=greatest),
        _ => Err(format!("`{least}` to `{greatest}` is not a range")),
    }
}
