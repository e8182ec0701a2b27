//! A recording as JSON and as CSV. Pure.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::{Duration, SystemTime};

use serde::{Serialize, Serializer};
use serde_json::{Map, Value as Json, json};

use super::decoded::Decoder;
use super::recording::{CommandNote, EventNote, Frame, Header, Recording};

/// The recording as a JSON object: the header, `values` by point, `samples` with theirs, `events`, `commands`, and `frames` with what they say.
/// The text is written a sample at a time: as a tree, a recording of 1 MB takes 10 MB of memory.
pub fn json(recording: &Recording) -> String {
    let mut header = match serde_json::to_value(&recording.header) {
        Ok(Json::Object(header)) => header,
        _ => Map::new(),
    };
    let names = (0..).map(|place| name(recording, place));
    let known: BTreeMap<&str, &Json> = names.zip(&recording.header.values).collect();
    header.insert("values".into(), json!(known));
    let object = RecordingObject {
        header,
        samples: Samples(recording),
        events: &recording.events,
        commands: &recording.commands,
        frames: Frames(recording),
    };
    // Strings, numbers and null can always be serialized.
    serde_json::to_string(&object).unwrap_or_default()
}

/// A recording as JSON.
#[derive(Serialize, utoipa::ToSchema)]
pub struct RecordingObject<'r> {
    #[serde(flatten)]
    #[schema(value_type = Header)]
    header: Map<String, Json>,
    #[schema(value_type = Vec<SampleObject<'r>>)]
    samples: Samples<'r>,
    events: &'r [EventNote],
    commands: &'r [CommandNote],
    #[schema(value_type = Vec<FrameObject<'r>>)]
    frames: Frames<'r>,
}

struct Samples<'r>(&'r Recording);

impl Serialize for Samples<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Samples(recording) = self;
        serializer.collect_seq(recording.samples.iter().map(|sample| {
            let read = recording.header.reads.get(sample.read);
            let points = read.map_or(&[][..], |read| &read.points);
            let names = points.iter().map(|place| name(recording, *place));
            SampleObject {
                t: sample.t,
                points: names.zip(recording.values(sample)).collect(),
            }
        }))
    }
}

struct Frames<'r>(&'r Recording);

impl Serialize for Frames<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Frames(recording) = self;
        let mut decoder = Decoder::new(&recording.header.bus.protocol);
        serializer.collect_seq(recording.frames.iter().map(|frame| {
            let decode = decoder.next(frame);
            FrameObject { frame, decode }
        }))
    }
}

/// A frame and what it says.
#[derive(Serialize, utoipa::ToSchema)]
#[schema(as = DecodedFrame)]
struct FrameObject<'r> {
    #[serde(flatten)]
    frame: &'r Frame,
    /// As `drivegate trace` says it; empty for a timeout.
    decode: String,
}

/// The values of one read.
#[derive(Serialize, utoipa::ToSchema)]
#[schema(as = RecordedSample)]
struct SampleObject<'r> {
    /// Time of the read, s from the trigger.
    t: f64,
    /// The values by point; `null` where the sample has none.
    points: BTreeMap<&'r str, &'r Json>,
}

/// The name of a point.
fn name(recording: &Recording, place: usize) -> &str {
    let column = recording.header.points.get(place);
    column.map_or("", |column| column.name.as_str())
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
    if t >= 0.0 {
        start?.checked_add(apart)
    } else {
        start?.checked_sub(apart)
    }
}
