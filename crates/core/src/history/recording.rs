//! A recording and the form of its file (`docs/history.md`): a JSON object a line, the header first, the end last. Pure.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::ops::Range;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::Value as Json;

use super::trigger::TriggerKind;
use crate::process_image::Verdict;
use drivegate_proto::Table;
use drivegate_proto::checksum::crc16;

/// Version of the recording format.
pub const VERSION: u32 = 1;
/// File name extension of recordings.
pub const ENDING: &str = "dgrec";

/// The subject of a recording, and its summary.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedHeader)]
pub struct Header {
    /// [`VERSION`] of the format; this key marks the file as a recording.
    pub drivegate_recording: u32,
    /// Id of the recording: time of the trigger and the drive.
    pub id: String,
    /// Time of the trigger, RFC 3339 with microseconds, UTC. All times below are seconds from it.
    pub time: String,
    /// Trigger of the recording.
    #[schema(value_type = String)]
    pub trigger: TriggerKind,
    /// Summary of the recording, in one sentence.
    pub summary: String,
    /// Whether the recording is among the first of a storm of recordings, which are kept longer.
    pub first: bool,
    /// Further triggers during the recording.
    pub more: Vec<Further>,
    pub drive: Drive,
    pub bus: Bus,
    /// Start of the recording, s from the trigger.
    pub from: f64,
    /// End of the recording, s from the trigger.
    pub to: f64,
    /// The points, in the order of `values` here.
    pub points: Vec<Column>,
    /// The values known at the trigger, of any age. In the JSON of the gateway they are keyed by point.
    #[schema(value_type = BTreeMap<String, Json>)]
    pub values: Vec<Json>,
    /// The reads that the samples are of.
    pub reads: Vec<Read>,
    /// Entries that the recorder missed since the gateway started; 0 on a healthy machine.
    pub lost: u64,
}

/// A further trigger.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedFurther)]
pub struct Further {
    /// Time of the trigger, s from the first one.
    pub t: f64,
    /// Kind of the further trigger.
    #[schema(value_type = String)]
    pub trigger: TriggerKind,
    /// Description of the trigger.
    pub text: String,
}

/// The drive of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedDrive)]
pub struct Drive {
    pub name: String,
    /// Address on the bus.
    pub address: u8,
    /// Name of the drive's profile.
    pub profile: String,
}

/// The bus of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedBus)]
pub struct Bus {
    pub name: String,
    pub protocol: String,
    /// Baud rate and character format.
    pub format: String,
    /// Names of the drives of the bus; a frame refers to a drive by its index in this list.
    pub drives: Vec<String>,
}

/// A point of the recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedColumn)]
pub struct Column {
    pub name: String,
    /// Unit; empty for states and codes.
    pub unit: String,
}

/// A read of the plan to which samples refer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedRead)]
pub struct Read {
    #[schema(value_type = String)]
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// Number of registers or bits.
    pub count: u16,
    /// The points of this read, by their index in the header.
    pub points: Vec<usize>,
}

/// A read of the drive; its values are given by [`Recording::values`].
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Time of the read, s from the trigger.
    pub t: f64,
    /// Position of the read in the header.
    pub read: usize,
    /// Positions of the values of the sample among the values of all samples.
    values: Range<usize>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct EventNote {
    /// Time of the event, s from the trigger.
    pub t: f64,
    /// Kind of the event.
    pub event: String,
    /// Text of the event.
    pub text: String,
}

/// A completed command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct CommandNote {
    /// When the command completed, s from the trigger.
    pub t: f64,
    /// Kind of the source.
    pub source: String,
    /// Client that gave the command.
    pub client: String,
    /// The command as text.
    pub command: String,
    /// Result code.
    pub result: String,
    /// Time from acceptance to result, ms.
    pub latency_ms: f64,
}

/// Bytes on the line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = RecordedFrame)]
pub struct Frame {
    /// Time of a request: when the port accepted it. Time of a reply: when its last byte arrived.
    pub t: f64,
    /// Position of the addressed drive in the header.
    pub drive: Option<usize>,
    /// How the transaction of the frame ended.
    #[schema(value_type = String)]
    pub verdict: Verdict,
    /// The bytes; in the file two hexadecimal digits each.
    #[serde(rename = "hex", with = "hexadecimal")]
    #[schema(value_type = String)]
    pub bytes: Arc<[u8]>,
}

mod hexadecimal {
    use std::borrow::Cow;
    use std::sync::Arc;

    use serde::{Deserialize, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(bytes: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&super::hex(bytes))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Arc<[u8]>, D::Error> {
        let digits = Cow::<str>::deserialize(deserializer)?;
        let bytes = crate::hex::decode(&digits).map(Arc::from);
        bytes.ok_or_else(|| serde::de::Error::custom("the bytes of the frame are not hexadecimal"))
    }
}

/// A line of the file after the header.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Line<'l> {
    Sample(SampleLine<'l>),
    Event(Cow<'l, EventNote>),
    Command(Cow<'l, CommandNote>),
    Frame(Cow<'l, Frame>),
    End(End),
}

/// A sample with its values.
#[derive(Debug, Serialize, Deserialize)]
struct SampleLine<'l> {
    t: f64,
    read: usize,
    /// A value for each point of the read; null if the point has none.
    values: Cow<'l, [Json]>,
}

/// The last line of a recording, which completes it.
#[derive(Debug, Serialize, Deserialize)]
struct End {
    /// Number of lines before this one.
    lines: usize,
    /// CRC-16 (of Modbus) of all bytes before this line.
    check: String,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Header of the recording.
    pub header: Header,
    /// The samples, oldest first.
    pub samples: Vec<Sample>,
    /// The values of all samples: in one list, as a recording has thousands of samples.
    values: Vec<Json>,
    /// Events, oldest first.
    pub events: Vec<EventNote>,
    /// Commands, oldest first.
    pub commands: Vec<CommandNote>,
    /// Frames of the line, oldest first.
    pub frames: Vec<Frame>,
}

/// Why bytes are not a valid recording.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{what}, at byte {offset}")]
pub struct RecordingError {
    /// Offset of the fault in the file.
    pub offset: usize,
    /// The defect, as text.
    pub what: String,
}

fn fault(offset: usize, what: impl Into<String>) -> RecordingError {
    let what = what.into();
    RecordingError { offset, what }
}

impl Header {
    /// Reads the header of a file from its beginning, and where the next line begins.
    ///
    /// # Errors
    /// If the bytes do not begin with a header of this version.
    pub fn parse(bytes: &[u8]) -> Result<(Header, usize), RecordingError> {
        let end = bytes.iter().position(|byte| *byte == b'\n');
        let line = bytes.get(..end.unwrap_or(bytes.len())).unwrap_or_default();
        let value: BTreeMap<String, Json> = match serde_json::from_slice(line) {
            Ok(value) => value,
            Err(_) if end.is_none() && line.starts_with(b"{\"drivegate_recording\":") => {
                return Err(fault(bytes.len(), "the file ends within its header: it is truncated"));
            }
            Err(error) if line.starts_with(b"{\"drivegate_recording\":") => {
                return Err(fault(error.column(), format!("the header is damaged ({error})")));
            }
            Err(_) => return Err(fault(0, "this is not a recording of drivegate")),
        };
        match value.get("drivegate_recording").and_then(Json::as_u64) {
            None => return Err(fault(0, "this is not a recording of drivegate")),
            Some(version) if version != u64::from(VERSION) => {
                let what = format!("the recording has version {version}, this program reads version {VERSION}");
                return Err(fault(0, what));
            }
            Some(_) => {}
        }
        let header = serde_json::from_slice(line)
            .map_err(|error| fault(error.column(), format!("the header is damaged ({error})")))?;
        match end {
            Some(end) => Ok((header, end + 1)),
            None => Err(fault(bytes.len(), "the file ends after its header: it is truncated")),
        }
    }
}

impl Recording {
    /// A recording without samples.
    pub fn new(header: Header) -> Recording {
        Recording {
            header,
            samples: Vec::new(),
            values: Vec::new(),
            events: Vec::new(),
            commands: Vec::new(),
            frames: Vec::new(),
        }
    }

    /// Appends a sample.
    pub(super) fn add_sample(&mut self, t: f64, read: usize, values: impl IntoIterator<Item = Json>) {
        let start = self.values.len();
        self.values.extend(values);
        let values = start..self.values.len();
        self.samples.push(Sample { t, read, values });
    }

    /// A value for each point of the read of this sample; null if the point has none.
    pub fn values(&self, sample: &Sample) -> &[Json] {
        self.values.get(sample.values.clone()).unwrap_or_default()
    }

    /// The bytes of the recording's file.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(128 * (self.samples.len() + self.frames.len()) + 4096);
        add(&mut bytes, &self.header);
        let events = self.events.iter().map(|event| Line::Event(Cow::Borrowed(event)));
        let commands = self
            .commands
            .iter()
            .map(|command| Line::Command(Cow::Borrowed(command)));
        let samples = self.samples.iter().map(|sample| {
            Line::Sample(SampleLine {
                t: sample.t,
                read: sample.read,
                values: self.values(sample).into(),
            })
        });
        let frames = self.frames.iter().map(|frame| Line::Frame(Cow::Borrowed(frame)));
        let mut lines = 1;
        for line in events.chain(commands).chain(samples).chain(frames) {
            add(&mut bytes, &line);
            lines += 1;
        }
        let check = format!("{:04X}", crc16(&bytes));
        add(&mut bytes, &Line::End(End { lines, check }));
        bytes
    }

    /// Parses the bytes of a recording file.
    ///
    /// # Errors
    /// If the bytes are not an intact recording of this version: contains the fault and its position.
    pub fn parse(bytes: &[u8]) -> Result<Recording, RecordingError> {
        let (header, mut offset) = Header::parse(bytes)?;
        let mut recording = Recording::new(header);
        let mut lines = 1;
        loop {
            let rest = bytes.get(offset..).unwrap_or_default();
            let Some(length) = rest.iter().position(|byte| *byte == b'\n') else {
                return Err(fault(bytes.len(), "the file has no end line: it is truncated"));
            };
            let text = rest.get(..length).unwrap_or_default();
            let line: Line<'_> = serde_json::from_slice(text)
                .map_err(|error| fault(offset + error.column(), format!("the line is damaged ({error})")))?;
            match line {
                Line::Sample(sample) => {
                    let read = recording.header.reads.get(sample.read);
                    if read.is_none_or(|read| read.points.len() != sample.values.len()) {
                        return Err(fault(offset, "the sample does not fit the reads of the header"));
                    }
                    recording.add_sample(sample.t, sample.read, sample.values.into_owned());
                }
                Line::Event(event) => recording.events.push(event.into_owned()),
                Line::Command(command) => recording.commands.push(command.into_owned()),
                Line::Frame(frame) => recording.frames.push(frame.into_owned()),
                Line::End(end) => {
                    recording.check_end(bytes, offset, lines, &end)?;
                    let after = offset + length + 1;
                    return match bytes.len() {
                        all if all > after => Err(fault(after, "there is data after the end line")),
                        _ => Ok(recording),
                    };
                }
            }
            lines += 1;
            offset += length + 1;
        }
    }

    fn check_end(&self, bytes: &[u8], offset: usize, lines: usize, end: &End) -> Result<(), RecordingError> {
        if end.lines != lines {
            return Err(fault(
                offset,
                format!("{lines} lines instead of {}: some are missing", end.lines),
            ));
        }
        let check = format!("{:04X}", crc16(bytes.get(..offset).unwrap_or_default()));
        if end.check != check {
            let what = format!("the check code of the data before is {check} instead of {}", end.check);
            return Err(fault(offset, what));
        }
        let places = self.header.reads.iter().flat_map(|read| &read.points);
        if places.max().is_some_and(|place| *place >= self.header.points.len()) {
            return Err(fault(0, "a read in the header names a point that does not exist"));
        }
        Ok(())
    }

    /// The values of a point with the times at which they were read.
    pub fn values_of(&self, point: &str) -> Vec<(f64, &Json)> {
        let Some(place) = self.header.points.iter().position(|column| column.name == point) else {
            return Vec::new();
        };
        let value = |sample: &'_ Sample| -> Option<usize> {
            let read = self.header.reads.get(sample.read)?;
            read.points.iter().position(|of| *of == place)
        };
        let samples = self.samples.iter();
        samples
            .filter_map(|sample| Some((sample.t, self.values(sample).get(value(sample)?)?)))
            .collect()
    }
}

fn add(bytes: &mut Vec<u8>, line: &impl Serialize) {
    // Strings and numbers can always be written to memory.
    let _ = serde_json::to_writer(&mut *bytes, line);
    bytes.push(b'\n');
}

/// Two hexadecimal digits for each byte.
pub fn hex(bytes: &[u8]) -> String {
    let mut digits = String::with_capacity(2 * bytes.len());
    for byte in bytes {
        // Writing to a string cannot fail.
        let _ = write!(digits, "{byte:02X}");
    }
    digits
}
