//! Assembles a recording from the rings: converts raw words to points with the drive's profile. Pure.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use serde_json::Value as Json;

use super::recorder::{Capture, Note, NoteBody, reading};
use super::recording::{Bus, Column, CommandNote, Drive, EventNote, Frame, Further, Header, Read, Recording, VERSION};
use super::summary;
use crate::process_image::{Reading, Snapshot, TapedRead, value_or_null};
use drivegate_model::drive::{DriveIndex, PointIndex, Profile, Source};

pub fn assemble(capture: &Capture) -> Recording {
    let spec = &capture.drive.spec;
    let profile = &spec.profile;
    let seconds = |at: Instant| seconds(at, capture.trigger.at);
    let names = capture.bus.drives.iter().map(|drive| drive.spec.name.clone());
    let mut recording = Recording::new(Header {
        drivegate_recording: VERSION,
        id: capture.id.clone(),
        time: humantime::format_rfc3339_micros(capture.clock.wall_at(capture.trigger.at)).to_string(),
        trigger: capture.trigger.kind,
        summary: String::new(),
        first: true,
        more: Vec::new(),
        drive: Drive {
            name: spec.name.clone(),
            address: spec.address,
            profile: profile.name.clone(),
        },
        bus: Bus {
            name: capture.bus.spec.name.clone(),
            protocol: capture.bus.spec.protocol.name().to_string(),
            format: capture.bus.spec.format.to_string(),
            drives: names.collect(),
        },
        from: seconds(capture.span.0),
        to: seconds(capture.span.1),
        points: columns(profile),
        values: Vec::new(),
        reads: Vec::new(),
        lost: capture.lost,
    });
    let further = capture.more.iter().map(|trigger| Further {
        t: seconds(trigger.at),
        trigger: trigger.kind,
        text: trigger.text.clone(),
    });
    recording.header.more = further.collect();
    add_samples(capture, &mut recording);
    for note in &capture.notes {
        add_note(note, seconds(note.at), &mut recording);
    }
    let frames = capture.frames.iter().map(|frame| Frame {
        t: seconds(frame.at),
        drive: frame.drive.map(DriveIndex::place),
        verdict: frame.verdict,
        bytes: frame.bytes.clone(),
    });
    recording.frames = frames.collect();
    recording.header.summary = summary::of(&recording, &capture.trigger.text, profile);
    recording
}

/// Seconds from the trigger, to the microsecond.
fn seconds(at: Instant, trigger: Instant) -> f64 {
    let seconds = match at.checked_duration_since(trigger) {
        Some(after) => after.as_secs_f64(),
        None => -trigger.saturating_duration_since(at).as_secs_f64(),
    };
    (seconds * 1e6).round() / 1e6
}

fn columns(profile: &Profile) -> Vec<Column> {
    let column = |point: &drivegate_model::drive::Point| Column {
        name: point.name.clone(),
        unit: point.unit.clone(),
    };
    profile.points.iter().map(column).collect()
}

fn add_samples(capture: &Capture, recording: &mut Recording) {
    let spec = &capture.drive.spec;
    let mut snapshot = capture.base.clone();
    let mut places: BTreeMap<(u8, u16, usize), usize> = BTreeMap::new();
    let mut at_trigger: Option<Arc<Snapshot>> = None;
    for taped in &capture.samples {
        if taped.at > capture.trigger.at && at_trigger.is_none() {
            at_trigger = Some(snapshot.clone());
        }
        Arc::make_mut(&mut snapshot).store(taped.table, taped.start, &taped.words, taped.at);
        if taped.at < capture.span.0 {
            continue;
        }
        let key = (taped.table.read_function(), taped.start, taped.words.len());
        let reads = &mut recording.header.reads;
        let read = *places.entry(key).or_insert_with(|| {
            reads.push(read_of(&spec.profile, taped));
            reads.len() - 1
        });
        let reading = reading(spec, &snapshot, taped.at);
        let points = reads.get(read).map(|read| read.points.clone()).unwrap_or_default();
        let t = seconds(taped.at, capture.trigger.at);
        recording.add_sample(
            t,
            read,
            points.iter().map(|point| value(&reading, PointIndex::new(*point))),
        );
    }
    let at_trigger = at_trigger.unwrap_or(snapshot);
    let reading = reading(spec, &at_trigger, capture.trigger.at);
    let all = spec.profile.points.indexes();
    recording.header.values = all.map(|point| value(&reading, point)).collect();
}

fn value(reading: &Reading<'_>, point: PointIndex) -> Json {
    value_or_null(reading.sample(point).good())
}

/// The points that a read covers: those whose registers are in the read, and those derived from one of them.
fn read_of(profile: &Profile, taped: &TapedRead) -> Read {
    let end = usize::from(taped.start) + taped.words.len();
    let has = |point: PointIndex| {
        let raw = profile.points.get(point).and_then(|point| point.raw());
        raw.is_some_and(|raw| {
            let within = |address: u16| address >= taped.start && usize::from(address) < end;
            raw.table == taped.table && raw.addresses().all(within)
        })
    };
    let shows = |point: &PointIndex| match profile.points.get(*point).map(|point| &point.source) {
        Some(Source::Raw(_)) => has(*point),
        Some(Source::Derived(derived)) => derived.rests_on().into_iter().any(has),
        None => false,
    };
    let shown = |point: &PointIndex| profile.points.get(*point).is_some_and(|point| !point.hidden);
    Read {
        table: taped.table,
        start: taped.start,
        count: u16::try_from(taped.words.len()).unwrap_or(u16::MAX),
        points: profile
            .points
            .indexes()
            .filter(shown)
            .filter(shows)
            .map(PointIndex::place)
            .collect(),
    }
}

fn add_note(note: &Note, t: f64, recording: &mut Recording) {
    match &note.body {
        NoteBody::Event { kind, text } => recording.events.push(EventNote {
            t,
            event: kind.to_string(),
            text: text.clone(),
        }),
        NoteBody::Command {
            source,
            client,
            command,
            result,
            latency,
        } => recording.commands.push(CommandNote {
            t,
            source: source.to_string(),
            client: client.clone(),
            command: command.clone(),
            result: result.to_string(),
            latency_ms: (latency.as_secs_f64() * 1e6).round() / 1e3,
        }),
    }
}
