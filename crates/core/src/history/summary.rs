//! The summary of a recording, in one sentence: "fault 53: fieldbus fault; 1.2 s before: 3 timeouts; speed 82 %,
//! current 114 A, DC 655 V falling". Pure.

use serde_json::Value as Json;

use super::recording::Recording;
use super::trigger::TriggerKind;
use crate::process_image::Verdict;
use drivegate_model::drive::Profile;

/// Errors on the line within this time before the trigger are mentioned in the summary, s.
const ERRORS_BEFORE: f64 = 5.0;
/// Time over which the summary checks whether a value rises or falls.
const TREND: f64 = 2.0;
/// Change, as a share of the greater value, that is worth telling.
const TREND_SHARE: f64 = 0.05;

/// Points that are mentioned, the first of each group that the drive has, and their short names.
const TOLD: [(&[&str], &str); 3] = [
    (&["actual_speed", "output_frequency"], "speed"),
    (&["motor_current"], "current"),
    (&["dc_link_voltage"], "DC"),
];

pub(super) fn of(recording: &Recording, trigger: &str, profile: &Profile) -> String {
    let mut parts = vec![what(recording, trigger, profile)];
    parts.extend(errors(recording));
    let values: Vec<String> = TOLD
        .iter()
        .filter_map(|(points, name)| points.iter().find_map(|point| last_value(recording, point, name)))
        .collect();
    if !values.is_empty() {
        parts.push(values.join(", "));
    }
    parts.join("; ")
}

fn what(recording: &Recording, trigger: &str, profile: &Profile) -> String {
    if recording.header.trigger != TriggerKind::Fault {
        return trigger.to_string();
    }
    // The code may be read a moment after the fault.
    let codes = recording.values_of("fault_code");
    let code = codes.iter().filter(|(t, _)| *t >= 0.0);
    let code = code.filter_map(|(_, code)| code.as_i64()).find(|code| *code != 0);
    match code {
        Some(code) => {
            let text = profile.fault_text(code);
            format!("fault {code}: {text}").trim_end_matches([' ', ':']).to_string()
        }
        None => "fault without a code".to_string(),
    }
}

/// Failed transactions with the drive shortly before the trigger.
fn errors(recording: &Recording) -> Option<String> {
    let drive = &recording.header.drive.name;
    let place = recording.header.bus.drives.iter().position(|name| name == drive);
    let failed = recording.frames.iter().filter(|frame| {
        let recent = frame.t <= 0.0 && frame.t >= -ERRORS_BEFORE;
        recent && frame.drive == place && frame.verdict.is_error()
    });
    let failed: Vec<_> = failed.collect();
    let first = failed.first()?.t;
    let count = |verdict| failed.iter().filter(|frame| frame.verdict == verdict).count();
    let named = |count: usize, one: &str, many: &str| match count {
        0 => None,
        1 => Some(format!("1 {one}")),
        more => Some(format!("{more} {many}")),
    };
    let kinds = [
        named(count(Verdict::Timeout), "timeout", "timeouts"),
        named(count(Verdict::Corrupt), "corrupt reply", "corrupt replies"),
    ];
    let kinds: Vec<String> = kinds.into_iter().flatten().collect();
    Some(format!("{:.1} s before: {}", -first, kinds.join(", ")))
}

/// The last value before the trigger, and its tendency.
fn last_value(recording: &Recording, point: &str, name: &str) -> Option<String> {
    let values = recording.values_of(point);
    let before: Vec<(f64, f64)> = values
        .iter()
        // At the poll that shows the trigger the drive may already have stopped, so only earlier values count.
        .filter(|(t, _)| *t < 0.0)
        .filter_map(|(t, value)| Some((*t, value.as_f64()?)))
        .collect();
    let known = |place: usize| recording.header.values.get(place).and_then(Json::as_f64);
    let place = recording.header.points.iter().position(|column| column.name == point)?;
    let last = before.last().map(|(_, value)| *value).or_else(|| known(place))?;
    let unit = recording
        .header
        .points
        .get(place)
        .map_or("", |column| column.unit.as_str());
    let earlier = before.iter().rev().find(|(t, _)| *t <= -TREND).map(|(_, value)| *value);
    let trend = match earlier {
        Some(earlier) if last - earlier > TREND_SHARE * last.abs().max(earlier.abs()) => " rising",
        Some(earlier) if earlier - last > TREND_SHARE * last.abs().max(earlier.abs()) => " falling",
        _ => "",
    };
    let figure = (last * 10.0).round() / 10.0;
    Some(format!("{name} {figure} {unit}{trend}"))
}
