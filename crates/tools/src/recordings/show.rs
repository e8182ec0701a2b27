//! A recording as text: what happened in its order, and the samples around the trigger.

use std::fmt::Write as _;

use serde_json::Value as Json;

use crate::{printable, report};
use drivegate_core::history::Recording;
use drivegate_core::history::recording::hex;
use drivegate_core::process_image::Verdict;

/// Samples that are shown before and after the trigger.
const SHOWN: (usize, usize) = (8, 6);
/// Points that are shown if they were read.
const POINTS: [&str; 8] = [
    "fault",
    "fault_code",
    "actual_speed",
    "output_frequency",
    "motor_current",
    "motor_torque",
    "motor_voltage",
    "dc_link_voltage",
];

pub(super) fn text(recording: &Recording) -> String {
    let header = &recording.header;
    let mut text = format!("{}\n{}\n\n", header.id, header.summary);
    let drive = &header.drive;
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "  drive    {} ({}, address {}) on bus {}, {} {}",
        drive.name, drive.profile, drive.address, header.bus.name, header.bus.protocol, header.bus.format
    );
    let _ = writeln!(text, "  trigger  {} at {}", header.trigger.name(), header.time);
    let _ = writeln!(text, "  from     {:.1} s to +{:.1} s", header.from, header.to);
    let _ = writeln!(
        text,
        "  content  {} samples, {} events, {} commands, {} frames\n",
        recording.samples.len(),
        recording.events.len(),
        recording.commands.len(),
        recording.frames.len()
    );
    text + &timeline(recording) + &samples(recording)
}

/// Events, commands and failed transactions in order of time.
fn timeline(recording: &Recording) -> String {
    let mut lines: Vec<(f64, String)> = Vec::new();
    let drives = &recording.header.bus.drives;
    lines.extend(
        recording
            .events
            .iter()
            .map(|e| (e.t, format!("{}: {}", e.event, e.text))),
    );
    lines.extend(
        recording
            .header
            .more
            .iter()
            .map(|m| (m.t, format!("trigger {}: {}", m.trigger.name(), m.text))),
    );
    lines.extend(recording.commands.iter().map(|c| {
        let who = format!("{} {}", c.source, c.client);
        (
            c.t,
            format!(
                "command {} from {who}: {} after {:.1} ms",
                c.command, c.result, c.latency_ms
            ),
        )
    }));
    let failed = recording.frames.iter().filter(|frame| frame.verdict.is_error());
    lines.extend(failed.map(|frame| {
        let name = frame
            .drive
            .and_then(|place| drives.get(place))
            .map_or("-", String::as_str);
        let what = match frame.verdict {
            Verdict::Corrupt => format!("an invalid reply from {name}: {}", hex(&frame.bytes)),
            _ => format!("{name} did not reply"),
        };
        (frame.t, what)
    }));
    lines.sort_by(|a, b| a.0.total_cmp(&b.0));
    let text: String = lines
        .into_iter()
        .map(|(t, line)| format!("{t:+10.3} s  {}\n", printable::line(&line)))
        .collect();
    if text.is_empty() { text } else { text + "\n" }
}

/// The polls around the trigger, with the points that a person looks at first.
fn samples(recording: &Recording) -> String {
    let header = &recording.header;
    let place = |name: &str| header.points.iter().position(|column| column.name == name);
    let places: Vec<usize> = POINTS.iter().filter_map(|name| place(name)).collect();
    let shows = |read: usize| -> usize {
        let points = header.reads.get(read).map_or(&[][..], |read| &read.points);
        points.iter().filter(|point| places.contains(point)).count()
    };
    // The read that shows most of these points.
    let Some(read) = (0..header.reads.len()).max_by_key(|read| shows(*read)) else {
        return String::new();
    };
    let points = header.reads.get(read).map_or(&[][..], |read| &read.points);
    let columns: Vec<(usize, usize)> = places
        .iter()
        .filter_map(|place| Some((points.iter().position(|point| point == place)?, *place)))
        .collect();
    let of_read: Vec<_> = recording.samples.iter().filter(|sample| sample.read == read).collect();
    let after = of_read.partition_point(|sample| sample.t < 0.0);
    let from = after.saturating_sub(SHOWN.0);
    let title = |place: usize| {
        let column = header.points.get(place);
        column.map_or(String::new(), |column| match column.unit.as_str() {
            "" => column.name.clone(),
            unit => format!("{}, {unit}", column.name),
        })
    };
    let titles = columns.iter().map(|(_, place)| title(*place));
    let mut table = report::table(std::iter::once("t, s".to_string()).chain(titles));
    for sample in of_read.iter().skip(from).take(SHOWN.0 + SHOWN.1) {
        let value = |at: usize| match recording.values(sample).get(at) {
            None | Some(Json::Null) => "-".to_string(),
            Some(value) => value.to_string(),
        };
        table.add_row(std::iter::once(format!("{:+.3}", sample.t)).chain(columns.iter().map(|(at, _)| value(*at))));
    }
    (0..=columns.len()).for_each(|column| table.align_right(column));
    report::lines(&table)
}
