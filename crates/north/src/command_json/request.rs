//! Reads the JSON of commands.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt;
use std::time::{Duration, Instant};

use serde::Serialize;
use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::Value as Json;
use serde_json::value::RawValue;

use drivegate_core::order::{Answer, Arrival, Authority, DEFAULT_EXPIRY, Order, Origin, Parts, Refusal, stop_of};
use drivegate_core::permit::{meant_another, sets_twice};
use drivegate_core::plant::{DriveHandle, OrderRequest, Placed, Plant};
use drivegate_model::document::nearest;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{PointIndex, Profile, Value};

/// Maximum size of a command, bytes.
pub const MAX_PAYLOAD: usize = 64 * 1024;
/// Maximum length of an `id`, bytes.
pub const MAX_ID: usize = 256;
/// Maximum of `expires_ms`.
const MAX_EXPIRY_MS: u64 = 60_000;
/// Maximum length of a name that is compared with the known ones, bytes.
const MAX_NAME: usize = 64;

/// Points to be set: index in the profile and value.
pub(crate) type Points = Vec<(PointIndex, Value)>;

/// The `id` of a command: a number or a string, returned as it was written.
#[derive(Debug, Clone, Serialize)]
#[serde(transparent)]
pub struct Id(Box<RawValue>);

impl Id {
    /// The `id` exactly as the client wrote it.
    pub fn text(&self) -> &str {
        self.0.get()
    }

    fn of(value: Box<RawValue>) -> Option<Id> {
        let text = value.get();
        let sound = match text.chars().next()? {
            '"' => serde_json::from_str::<String>(text).is_ok_and(|text| text.len() <= MAX_ID),
            '-' | '0'..='9' => text.len() <= MAX_ID,
            _ => false,
        };
        sound.then_some(Id(value))
    }
}

impl PartialEq for Id {
    fn eq(&self, other: &Id) -> bool {
        self.text() == other.text()
    }
}

/// The payload for messages: printable and short.
pub fn excerpt(payload: &[u8]) -> String {
    let text = String::from_utf8_lossy(payload.get(..payload.len().min(200)).unwrap_or_default());
    let mut short = String::new();
    for c in text.chars().take(80) {
        if c.is_control() {
            short.extend(c.escape_default());
        } else {
            short.push(c);
        }
    }
    let dots = if payload.len() > 80 { "…" } else { "" };
    format!("`{short}{dots}`")
}

/// The `id` of an object, read before the rest, so that a client can match the result to its request even if the
/// rest is invalid. `None` if the payload is not JSON or contains several ids.
pub fn find_id(payload: &[u8]) -> Option<Id> {
    let OnlyId(id) = serde_json::from_slice(payload).ok()?;
    Id::of(id?)
}

/// The parsed content of a command.
#[derive(Debug, Clone, PartialEq)]
pub struct ParsedCommand {
    pub points: Points,
    pub expiry: Duration,
    /// Why everything except a stop is refused; `points` then holds the points of the stop.
    pub refused: Option<Refusal>,
    /// Whether a start that must wait does wait.
    pub wait: bool,
}

impl ParsedCommand {
    /// A command with `points`, where `refused` is the error of the part that is not understood.
    ///
    /// # Errors
    /// If the request is refused: contains the refusal. A request with a stop is never refused.
    pub fn new(
        points: Points,
        expiry: Duration,
        refused: Option<Refusal>,
        profile: &Profile,
    ) -> Result<ParsedCommand, Refusal> {
        let points = match &refused {
            None => points,
            Some(refusal) => stop_of(&points, profile).ok_or_else(|| refusal.clone())?,
        };
        Ok(ParsedCommand {
            points,
            expiry,
            refused,
            wait: false,
        })
    }

    /// Whether the command contains a stop, which is executed whatever happens to the rest.
    pub fn stops(&self, profile: &Profile) -> bool {
        stop_of(&self.points, profile).is_some()
    }

    /// Whether the command contains more than a stop, so that a repetition of it is not executed.
    pub fn does_more(&self, profile: &Profile) -> bool {
        let whole = || matches!(Parts::of(Order::Points(self.points.clone()), profile), Parts::One(_));
        self.refused.is_none() && !(self.stops(profile) && whole())
    }

    /// Gives the command to the drive at `now`: as a whole, or only its stop if the rest, `what`, is refused.
    /// `arrival` is when and how the command arrived.
    ///
    /// # Errors
    /// If the whole command is refused; contains the answer.
    pub fn place(
        self,
        drive: &DriveHandle,
        what: &str,
        origin: Origin,
        arrival: Arrival,
        now: Instant,
    ) -> Result<Placed, Answer> {
        let (write, expiry) = (Authority::Write, self.expiry);
        let Some(refusal) = self.refused else {
            let request = OrderRequest::new(Order::Points(self.points), origin, write).within(expiry);
            return Ok(drive.place(request.waiting(self.wait).arrived(arrival), now));
        };
        match stop_of(&self.points, &drive.image.spec.profile) {
            Some(stop) => {
                let request = OrderRequest::new(Order::Points(stop), origin, write).within(expiry);
                Ok(drive.place(request.without_rest(what, refusal).arrived(arrival), now))
            }
            None => Err(drive.refuse(what, refusal, origin, now)),
        }
    }

    /// Gives `former` the stop of a command, `what`, whose drive name meant this machine when the command arrived and
    /// means no drive now; `None` if the command does not stop.
    pub fn place_at_former(
        self,
        former: &DriveHandle,
        what: &str,
        origin: Origin,
        arrival: Arrival,
        now: Instant,
    ) -> Option<Placed> {
        let stop = stop_of(&self.points, &former.image.spec.profile)?;
        let request = OrderRequest::new(Order::Points(stop), origin, Authority::Write).within(self.expiry);
        let request = request.without_rest(what, meant_another()).arrived(arrival);
        Some(former.place(request.resolved(), now))
    }
}

/// The points and the expiry of a command.
///
/// # Errors
/// If nothing of the command may be executed; contains the refusal.
pub fn order(payload: &[u8], profile: &Profile) -> Result<ParsedCommand, Refusal> {
    let (fields, refused) = object(payload)?;
    points_of(fields, refused, profile)
}

/// Refuses a payload that is too long.
///
/// # Errors
/// If the payload is longer than [`MAX_PAYLOAD`].
pub fn check_size(size: usize) -> Result<(), Refusal> {
    if size > MAX_PAYLOAD {
        Err(Refusal::BadValue(format!(
            "the payload has {size} bytes, at most {MAX_PAYLOAD} are allowed"
        )))
    } else {
        Ok(())
    }
}

/// Reads the points; `refused` is an error of the whole, which a stop ignores.
fn points_of(fields: Fields, refused: Option<Refusal>, profile: &Profile) -> Result<ParsedCommand, Refusal> {
    let mut expiry = DEFAULT_EXPIRY;
    let mut points = Vec::new();
    let mut wait = false;
    let twice = |name: String| sets_twice(excerpt(name.as_bytes()).trim_matches('`'));
    let mut refused = refused.or(fields.twice.map(twice));
    for (name, value) in fields.all {
        let understood = match name.as_str() {
            "id" if is_id(&value) => Ok(()),
            "id" => Err(Refusal::BadValue(format!(
                "`id` is a number or a string of at most {MAX_ID} bytes"
            ))),
            "expires_ms" => request_expiry(&value).map(|time| expiry = time),
            "wait" => request_wait(&value).map(|waits| wait = waits),
            name => resolve(profile, name, &value).map(|point| points.push(point)),
        };
        refused = refused.or(understood.err());
    }
    let asked = ParsedCommand::new(points, expiry, refused, profile)?;
    Ok(ParsedCommand { wait, ..asked })
}

fn request_wait(value: &Json) -> Result<bool, Refusal> {
    let what = || Refusal::BadValue(format!("`wait` = {} is not true or false", brief(value)));
    value.as_bool().ok_or_else(what)
}

fn is_id(value: &Json) -> bool {
    match value {
        Json::Number(_) => true,
        Json::String(text) => text.len() <= MAX_ID,
        _ => false,
    }
}

fn request_expiry(value: &Json) -> Result<Duration, Refusal> {
    let time = value.as_u64().filter(|ms| (1..=MAX_EXPIRY_MS).contains(ms));
    time.map(Duration::from_millis).ok_or_else(|| {
        Refusal::BadValue(format!(
            "`expires_ms` = {value} is not a whole number from 1 to {MAX_EXPIRY_MS}"
        ))
    })
}

/// The point with this name, and its value. Limits are checked later with the command.
pub fn resolve(profile: &Profile, name: &str, value: &Json) -> Result<(PointIndex, Value), Refusal> {
    let Some(index) = profile.point_index(name) else {
        let writable = || {
            profile
                .points
                .iter()
                .filter(|p| p.is_commanded())
                .map(|p| p.name.as_str())
        };
        let all = || profile.points.iter().filter(|p| !p.hidden).map(|p| p.name.as_str());
        let likely = || nearest(name, writable()).or_else(|| nearest(name, all()));
        let hint = match (name.len() <= MAX_NAME).then(likely).flatten() {
            Some(near) => format!("did you mean `{near}`?"),
            None => format!("writable points: {}", writable().collect::<Vec<_>>().join(", ")),
        };
        let name = excerpt(name.as_bytes());
        return Err(Refusal::NotWritable(format!("there is no point {name}; {hint}")));
    };
    let point = profile.points.get(index).filter(|p| p.is_commanded());
    let Some(point) = point else {
        return Err(Refusal::NotWritable(format!("`{name}` is read-only")));
    };
    let wrong = |wanted: &str| Refusal::BadValue(format!("`{name}` = {} is not {wanted}", brief(value)));
    let value = match (point.kind(), value) {
        (Kind::Bool, Json::Bool(b)) => Value::Bool(*b),
        (Kind::Bool, Json::Number(n)) if n.as_f64() == Some(0.0) => Value::Bool(false),
        (Kind::Bool, Json::Number(n)) if n.as_f64() == Some(1.0) => Value::Bool(true),
        (Kind::Bool, Json::String(text)) if point.code_of(text).is_some() => {
            Value::Bool(point.code_of(text).unwrap_or_default() != 0)
        }
        (Kind::Bool, _) => return Err(wrong("true or false")),
        (Kind::Number | Kind::Integer, Json::Number(n)) if is_long(n) => match (n.as_i64(), n.as_u64()) {
            (Some(whole), _) => Value::Integer(whole),
            (None, Some(whole)) => Value::Unsigned(whole),
            (None, None) => return Err(wrong("a number")),
        },
        (Kind::Number | Kind::Integer, Json::Number(n)) => {
            Value::Number(n.as_f64().filter(|n| n.is_finite()).ok_or_else(|| wrong("a number"))?)
        }
        (Kind::Number | Kind::Integer, Json::String(text)) if !point.texts.is_empty() => match point.code_of(text) {
            Some(code) => Value::Integer(code),
            None => return Err(wrong("one of its texts, or a number")),
        },
        (Kind::Number | Kind::Integer, Json::String(_)) => return Err(wrong("a number; remove the quotes")),
        (Kind::Text, _) => return Err(wrong("written: the point is a text")),
        (Kind::Number | Kind::Integer, _) => return Err(wrong("a number")),
    };
    Ok((index, value))
}

/// A whole number that a number with a fraction does not hold to the last digit.
fn is_long(number: &serde_json::Number) -> bool {
    let whole = number.as_i64().map(Value::Integer);
    let whole = whole.or_else(|| number.as_u64().map(Value::Unsigned));
    whole.is_some_and(|whole| whole.exact_f64().is_none())
}

fn brief(value: &Json) -> String {
    let text = value.to_string();
    match text.char_indices().nth(60) {
        Some((end, _)) => format!("{}…", text.get(..end).unwrap_or_default()),
        None => text,
    }
}

/// The fields of an object. Values that are not valid JSON (`NaN`, `1e999`) become null, and the refusal reports them.
fn object(payload: &[u8]) -> Result<(Fields, Option<Refusal>), Refusal> {
    let shape = "send a JSON object such as {\"run\": true, \"speed_reference\": 50}";
    let value: Json = match serde_json::from_slice(payload) {
        Ok(value) => value,
        Err(e) => {
            let refusal = Refusal::BadValue(format!("{} is not JSON: {e}; {shape}", excerpt(payload)));
            let readable = with_nulls(payload).and_then(|text| serde_json::from_str(&text).ok());
            return readable.map(|fields| (fields, Some(refusal.clone()))).ok_or(refusal);
        }
    };
    if !value.is_object() {
        return Err(Refusal::BadValue(format!(
            "{} is not a JSON object; {shape}",
            excerpt(payload)
        )));
    }
    let fields = serde_json::from_slice(payload).map_err(|e| Refusal::BadValue(e.to_string()))?;
    Ok((fields, None))
}

/// The text with null for each bare word and number that JSON does not know.
fn with_nulls(payload: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(payload).ok()?;
    let (mut sound, mut word) = (String::with_capacity(text.len()), String::new());
    let (mut quoted, mut escaped) = (false, false);
    for c in text.chars().chain(std::iter::once(' ')) {
        if !quoted && (c.is_alphanumeric() || "+-._".contains(c)) {
            word.push(c);
            continue;
        }
        if !word.is_empty() {
            let is_sound = serde_json::from_str::<Json>(&word).is_ok();
            sound.push_str(if is_sound { &word } else { "null" });
            word.clear();
        }
        sound.push(c);
        (quoted, escaped) = match c {
            '"' if !escaped => (!quoted, false),
            '\\' => (quoted, quoted && !escaped),
            _ => (quoted, false),
        };
    }
    Some(sound)
}

/// The fields of an object, and the first name that is repeated: that is an error, since it is ambiguous.
#[derive(Debug, Default)]
struct Fields {
    all: Vec<(String, Json)>,
    twice: Option<String>,
}

impl<'de> Deserialize<'de> for Fields {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Fields, D::Error> {
        deserializer.deserialize_map(FieldsVisitor)
    }
}

struct FieldsVisitor;

impl<'de> Visitor<'de> for FieldsVisitor {
    type Value = Fields;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Fields, A::Error> {
        let mut fields = Fields::default();
        let mut names = BTreeSet::new();
        while let Some((name, value)) = map.next_entry::<String, Json>()? {
            if !names.insert(name.clone()) {
                fields.twice.get_or_insert(name.clone());
            }
            fields.all.push((name, value));
        }
        Ok(fields)
    }
}

/// Only the `id` of an object, if it has exactly one; other fields are ignored.
struct OnlyId(Option<Box<RawValue>>);

impl<'de> Deserialize<'de> for OnlyId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<OnlyId, D::Error> {
        deserializer.deserialize_map(IdVisitor)
    }
}

struct IdVisitor;

impl<'de> Visitor<'de> for IdVisitor {
    type Value = OnlyId;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<OnlyId, A::Error> {
        let mut found = Vec::new();
        while let Some(name) = map.next_key::<Cow<'de, str>>()? {
            if name == "id" && found.len() < 2 {
                found.push(map.next_value()?);
            } else {
                map.next_value::<IgnoredAny>()?;
            }
        }
        Ok(OnlyId(found.pop().filter(|_| found.is_empty())))
    }
}

/// The message for an unknown drive, with the nearest name.
fn unknown_drive(name: &str, plant: &Plant) -> String {
    let drives: Vec<_> = plant.drives().map(|d| d.image.spec.name.clone()).collect();
    let near = (name.len() <= MAX_NAME).then(|| nearest(name, drives.iter().map(String::as_str)));
    let hint = near
        .flatten()
        .map_or(String::new(), |near| format!("; did you mean `{near}`?"));
    format!("there is no drive {}{hint}", excerpt(name.as_bytes()))
}

/// The answer to a command for an unknown drive, which is also audited.
pub fn refuse_unknown(plant: &Plant, name: &str, what: &str, origin: Origin, now: Instant) -> Answer {
    let shown = excerpt(name.as_bytes());
    plant.refuse_unknown(shown.trim_matches('`'), what, unknown_drive(name, plant), origin, now)
}
