//! A recording as JSON and as CSV. Pure.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::{Duration, SystemTime};

use serde_json::{Value as Json, json};

use super::recording::Recording;

/// One JSON object: the header, `samples` with their values by point, `events`, `commands`, `frames`.
pub fn json(recording: &Recording) -> Json {
    let mut json = serde_json::to_value(&recording.header).unwrap_or_default();
    let header = &recording.header;
    let name = |place: usize| header.points.get(place).map_or("", |column| column.name.as_str());
    let samples = recording.samples.iter().map(|sample| {
        let points = header.reads.get(sample.read).map(|read| read.points.as_slice());
        let names = points.unwrap_or_default().iter().map(|place| name(*place));
        let values: BTreeMap<&str, &Json> = names.zip(recording.values(sample)).collect();
        json!({ "t": sample.t, "points": values })
    });
    let known: BTreeMap<&str, &Json> = (0..).map(name).zip(&header.values).collect();
    if let Json::Object(object) = &mut json {
        object.insert("values".into(), json!(known));
        object.insert("samples".into(), samples.collect());
        for (key, list) in [
            ("events", json!(recording.events)),
            ("commands", json!(recording.commands)),
            ("frames", json!(recording.frames)),
        ] {
            object.insert(key.into(), list);
        }
    }
    json
}

/// A line for each sample, with a column for each point that was read: RFC 4180 with a header line. A point that another
/// read shows is empty.
pub fn csv(recording: &Recording) -> String {
    let header = &recording.header;
    let mut places: Vec<usize> = header
        .reads
        .iter()
        .flat_map(|read| read.points.iter().copied())
        .collect();
    places.sort_unstable();
    places.dedup();
    let mut text = "time,t_s".to_string();
    for place in &places {
        let column = header.points.get(*place);
        let (name, unit) = column.map_or(("", ""), |column| (column.name.as_str(), column.unit.as_str()));
        let title = if unit.is_empty() {
            name.to_string()
        } else {
            format!("{name} [{unit}]")
        };
        text += &format!(",{title}");
    }
    text.push('\n');
    let start = humantime::parse_rfc3339(&header.time).ok();
    for sample in &recording.samples {
        // Writing to a string cannot fail.
        let _ = write!(text, "{},{:.6}", time(start, sample.t), sample.t);
        let points = header.reads.get(sample.read).map_or(&[][..], |read| &read.points);
        for place in &places {
            let value = points.iter().position(|point| point == place);
            match value.and_then(|at| recording.values(sample).get(at)) {
                None | Some(Json::Null) => text.push(','),
                Some(value) => drop(write!(text, ",{value}")),
            }
        }
        text.push('\n');
    }
    text
}

/// The time of day `t` seconds after `start`, RFC 3339.
pub(super) fn time(start: Option<SystemTime>, t: f64) -> String {
    moment(start, t).map_or(String::new(), |at| humantime::format_rfc3339_micros(at).to_string())
}

/// The time of day `t` seconds after `start`.
pub(super) fn moment(start: Option<SystemTime>, t: f64) -> Option<SystemTime> {
    let apart = Duration::try_from_secs_f64(t.abs()).ok()?;
    match t >= 0.0 {
        true => start?.checked_add(apart),
        false => start?.checked_sub(apart),
    }
}
