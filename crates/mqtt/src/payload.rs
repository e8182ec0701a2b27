//! Content of the payloads; `topics` has the names of their topics. `publisher` decides which topics a drive has
//! and when they are published.

use std::time::{Duration, SystemTime};

use serde::ser::{Serialize, SerializeMap, Serializer};

use super::topics::Topics;
use drivegate_core::event::Event;
use drivegate_core::permit::HoldView;
use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{BusHealth, Reading, value_or_null};
use drivegate_model::drive::{ModelPoint, Point, PointIndex, Profile, Quality, State, Value};
use drivegate_north::command_json::HoldFields;

/// The published points of a drive: index in the profile and name. No name is a key of the state object, since
/// profiles reject such names.
pub(super) fn published_points(profile: &Profile) -> Vec<(PointIndex, &str)> {
    drivegate_core::process_image::public_points(profile)
}

/// The state object of a drive without its times; it is published when it changes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct StateContent {
    /// State of the drive; `None` if it is unknown.
    pub(super) state: Option<State>,
    pub(super) quality: Quality,
    /// Why the motor does not run: one word for each cause.
    pub(super) blocked_by: Vec<String>,
    /// How long `min_run` still delays an ordinary stop, in whole seconds.
    pub(super) stop_waits: Option<u64>,
    /// Whether the orders of the drive are being written again; `None` for a drive whose orders are never written again.
    pub(super) refreshing: Option<bool>,
    /// Holder of the drive; `None` if `[authority]` is off.
    pub(super) hold: Option<HoldFields>,
    /// Value (only if good) and quality of each published point.
    pub(super) points: Vec<(Option<Value>, Quality)>,
}

/// The key and the text of an enumeration; the text is empty unless the value is good.
pub(super) fn text_beside(point: &Point, value: Option<Value>) -> Option<(String, &str)> {
    let text = value.and_then(|value| point.text_of(value)).unwrap_or_default();
    (!point.texts.is_empty()).then(|| (format!("{}_text", point.name), text))
}

impl StateContent {
    pub(super) fn of(
        reading: &Reading<'_>,
        points: impl Iterator<Item = PointIndex>,
        blocked_by: Vec<String>,
        stop_waits: Option<Duration>,
        hold: Option<HoldView>,
    ) -> StateContent {
        let shown = |index| {
            let sample = reading.sample(index);
            (sample.good(), sample.quality)
        };
        StateContent {
            state: reading.state(),
            quality: reading.overall(),
            blocked_by,
            stop_waits: stop_waits.map(|time| u64::try_from(time.as_millis().div_ceil(1000)).unwrap_or(u64::MAX)),
            refreshing: None,
            hold: hold.map(HoldFields::from),
            points: points.map(shown).collect(),
        }
    }
}

/// The state object of a drive.
pub(super) struct StateObject<'s> {
    pub(super) shown: &'s StateContent,
    /// Names of the points in `shown.points`.
    pub(super) names: &'s [String],
    /// The points' indices in the profile.
    pub(super) indices: &'s [PointIndex],
    pub(super) profile: &'s Profile,
    pub(super) fault_text: String,
    pub(super) age: Option<Duration>,
    /// Time of day of the values.
    pub(super) wall: SystemTime,
    /// Whether the state is from the past, as part of the history.
    pub(super) historical: bool,
    /// Number of points that are left out because the broker takes no larger message.
    pub(super) omitted: usize,
}

impl Serialize for StateObject<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        if self.historical {
            map.serialize_entry("historical", &true)?;
        }
        map.serialize_entry("state", &self.shown.state.map(State::name))?;
        map.serialize_entry("quality", self.shown.quality.name())?;
        let read_at = self.age.and_then(|age| self.wall.checked_sub(age));
        map.serialize_entry("time", &read_at.map(rfc3339))?;
        map.serialize_entry("age_ms", &self.age.map(|a| a.as_millis() as u64))?;
        map.serialize_entry("fault_text", &self.fault_text)?;
        map.serialize_entry("blocked_by", &self.shown.blocked_by)?;
        if let Some(seconds) = self.shown.stop_waits {
            map.serialize_entry("stop_waits_ms", &seconds.saturating_mul(1000))?;
        }
        if let Some(refreshing) = self.shown.refreshing {
            map.serialize_entry("refreshing", &refreshing)?;
        }
        if !self.profile.verified {
            map.serialize_entry("profile_verified", &false)?;
        }
        if let Some(hold) = &self.shown.hold {
            map.serialize_entry("hold", &hold.hold)?;
            map.serialize_entry("holder", &hold.holder)?;
            map.serialize_entry("holder_rank", &hold.holder_rank)?;
            map.serialize_entry("hold_left_s", &hold.hold_left_s)?;
        }
        if self.omitted > 0 {
            map.serialize_entry("omitted", &self.omitted)?;
        }
        let points = || self.names.iter().zip(&self.shown.points);
        for (name, (value, _)) in points() {
            map.serialize_entry(name, &value_or_null(value.map(tidy)))?;
        }
        for (index, (value, _)) in self.indices.iter().zip(&self.shown.points) {
            let point = self.profile.points.get(*index);
            if let Some((key, text)) = point.and_then(|point| text_beside(point, *value)) {
                map.serialize_entry(&key, text)?;
            }
        }
        let differing: serde_json::Map<String, serde_json::Value> = points()
            .filter(|(_, (_, quality))| *quality != self.shown.quality)
            .map(|(name, (_, quality))| (name.clone(), quality.name().into()))
            .collect();
        if !differing.is_empty() {
            map.serialize_entry("point_quality", &differing)?;
        }
        map.end()
    }
}

/// Turns a negative zero into zero.
fn tidy(value: Value) -> Value {
    match value {
        Value::Number(n) => Value::Number(n + 0.0),
        other => other,
    }
}

/// The payload of a point topic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum PointPayload {
    /// No good value is known: an empty payload, which clears the retained value.
    Nothing,
    Value(Value),
    /// The state of the drive.
    State(State),
    /// The text of this fault code.
    FaultText(i64),
}

impl PointPayload {
    /// The payload of a point: its value, if that is good.
    pub(super) fn of(value: Option<Value>) -> PointPayload {
        value.map_or(PointPayload::Nothing, PointPayload::Value)
    }

    /// The payload of a drive's state, if the state is known.
    pub(super) fn state(state: Option<State>) -> PointPayload {
        state.map_or(PointPayload::Nothing, PointPayload::State)
    }

    /// The text of the active fault, if the fault code is good.
    pub(super) fn fault_text(reading: &Reading<'_>) -> PointPayload {
        match reading.model(ModelPoint::FaultCode).good() {
            Some(Value::Integer(code)) => PointPayload::FaultText(code),
            _ => PointPayload::Nothing,
        }
    }

    /// The bytes of the payload: `true`, `false`, a shortest decimal, a word, or nothing.
    pub(super) fn render(self, profile: &Profile) -> Vec<u8> {
        match self {
            PointPayload::Nothing => Vec::new(),
            PointPayload::Value(value) => tidy(value).to_string().into_bytes(),
            PointPayload::State(state) => state.name().into(),
            PointPayload::FaultText(code) => profile.fault_text(code).into_bytes(),
        }
    }
}

/// The part of a bus message that is published at once when it changes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct BusState {
    pub(super) up: bool,
    pub(super) reason: Option<String>,
    pub(super) drives: usize,
    pub(super) online: usize,
}

/// The part of a bus message that changes all the time.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct BusFigures {
    /// The load is not known until the port was open for a second.
    pub(super) load: Option<f64>,
    pub(super) fast_cycle_ms: Option<f64>,
    pub(super) slow_cycle_ms: Option<f64>,
    pub(super) transactions: u64,
    pub(super) errors: u64,
    pub(super) queue: usize,
}

pub(super) fn bus_now(bus: &BusHandle) -> (BusState, BusFigures) {
    let BusHealth {
        up,
        reason,
        load,
        fast,
        slow,
        ..
    } = bus.image.health();
    let state = BusState {
        up,
        reason,
        drives: bus.image.drives.len(),
        online: bus.image.online(),
    };
    let figures = BusFigures {
        load: load.map(|load| rounded(load, 1000.0)),
        fast_cycle_ms: fast.last.map(milliseconds),
        slow_cycle_ms: slow.last.map(milliseconds),
        transactions: bus.image.transactions_total(),
        errors: bus.image.errors_total(),
        queue: bus.queue.lock().len(),
    };
    (state, figures)
}

/// The health object of a bus.
pub(super) fn bus_object(state: &BusState, figures: &BusFigures, wall: SystemTime) -> Vec<u8> {
    let object = serde_json::json!({
        "state": if state.up { "up" } else { "down" },
        "reason": state.reason,
        "time": rfc3339(wall),
        "drives": state.drives,
        "online": state.online,
        "load": figures.load,
        "fast_cycle_ms": figures.fast_cycle_ms,
        "slow_cycle_ms": figures.slow_cycle_ms,
        "transactions": figures.transactions,
        "errors": figures.errors,
        "queue": figures.queue,
    });
    object.to_string().into_bytes()
}

/// The event object and its topics: the topic of its drive, or those of all drives of its bus or of the gateway.
pub(super) fn event(topics: &Topics, event: &Event, plant: &Plant) -> (Vec<String>, Vec<u8>) {
    let drives = match &event.drive {
        Some(drive) => vec![drive.clone()],
        None => {
            let meant = |name: &str| event.bus.is_empty() || event.bus == name;
            let buses = plant.buses.iter().filter(|bus| meant(&bus.image.spec.name));
            let drives = buses.flat_map(|bus| &bus.image.drives);
            drives.map(|drive| drive.spec.name.clone()).collect()
        }
    };
    let topic = |drive: &String| topics.drive(drive, "event");
    // Strings and numbers can always be serialized.
    let payload = serde_json::to_vec(event).unwrap_or_default();
    (drives.iter().map(topic).collect(), payload)
}

/// The message about a recording, if the event reports one.
pub(super) fn recording(topics: &Topics, event: &Event) -> Option<(String, Vec<u8>)> {
    let (drive, made) = (event.drive.as_deref()?, event.recording.as_ref()?);
    let payload = serde_json::json!({
        "id": made.id, "time": rfc3339(event.time), "trigger": made.trigger, "summary": made.summary,
    });
    Some((topics.drive(drive, "recording"), payload.to_string().into_bytes()))
}

/// RFC 3339, UTC, milliseconds.
pub(super) fn rfc3339(time: SystemTime) -> String {
    humantime::format_rfc3339_millis(time).to_string()
}

/// Time in milliseconds with three decimals.
pub(super) fn milliseconds(time: Duration) -> f64 {
    rounded(time.as_secs_f64() * 1000.0, 1000.0)
}

fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use drivegate_core::permit::HoldState;
    use drivegate_core::process_image::{DriveImage, DriveSpec, Link};
    use drivegate_proto::Table;

    #[test]
    fn bare_values_are_shortest_decimals() {
        let profile = drivegate_model::drive::profile::Profiles::built_in()
            .get("vacon-nx")
            .unwrap()
            .clone();
        let text = |bare: PointPayload| String::from_utf8(bare.render(&profile)).unwrap();
        for (value, expected) in [
            (Value::Number(25.0), "25"),
            (Value::Number(0.1), "0.1"),
            (Value::Number(-12.34), "-12.34"),
            (Value::Number(-0.0), "0"),
            (Value::Integer(-7), "-7"),
            (Value::Bool(true), "true"),
        ] {
            assert_eq!(text(PointPayload::Value(value)), expected);
        }
        assert_eq!(text(PointPayload::FaultText(53)), "fieldbus fault");
        assert_eq!(text(PointPayload::FaultText(0)), "");
    }

    #[test]
    fn enumerations_have_their_text_beside_them() {
        let source = "name = \"m\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\n\
             [[point]]\nname = \"mode\"\nat = \"holding 1\"\n[point.texts]\n3 = \"auto\"\n";
        let profile = Profile::parse("m.toml", source, false).unwrap();
        let state = |value: Option<i64>| {
            let shown = StateContent {
                hold: None,
                state: Some(State::NotReady),
                quality: Quality::Good,
                blocked_by: Vec::new(),
                stop_waits: None,
                refreshing: None,
                points: vec![(value.map(Value::Integer), Quality::Good)],
            };
            let object = StateObject {
                shown: &shown,
                names: &["mode".to_string()],
                indices: &[PointIndex::new(0)],
                profile: &profile,
                fault_text: String::new(),
                age: None,
                wall: SystemTime::UNIX_EPOCH,
                historical: false,
                omitted: 0,
            };
            serde_json::to_value(&object).unwrap()
        };
        let object = state(Some(3));
        assert_eq!((&object["mode"], &object["mode_text"]), (&3.into(), &"auto".into()));
        let object = state(Some(4));
        assert_eq!((&object["mode"], &object["mode_text"]), (&4.into(), &"".into()));
        let object = state(None);
        assert_eq!(
            (&object["mode"], &object["mode_text"]),
            (&serde_json::Value::Null, &"".into())
        );
        assert_eq!(object.get("profile_verified"), None, "nothing doubtful");
        let doubtful = Profile::parse("m.toml", &format!("verified = false\n{source}"), false).unwrap();
        let of = StateContent {
            state: None,
            quality: Quality::Good,
            blocked_by: Vec::new(),
            hold: None,
            stop_waits: None,
            refreshing: None,
            points: Vec::new(),
        };
        let object = StateObject {
            shown: &of,
            names: &[],
            indices: &[],
            profile: &doubtful,
            fault_text: String::new(),
            age: None,
            wall: SystemTime::UNIX_EPOCH,
            historical: false,
            omitted: 0,
        };
        assert_eq!(serde_json::to_value(&object).unwrap()["profile_verified"], false);
    }

    #[test]
    fn a_state_that_is_not_known_is_null_and_not_good() {
        let cx = drivegate_model::drive::profile::Profiles::built_in()
            .get("vacon-cx")
            .unwrap()
            .clone();
        let second = Duration::from_secs(1);
        let image = DriveImage::new(DriveSpec::new("fan-1", "line1", 1, cx.clone()), second);
        let now = Instant::now();
        image.update(|s| {
            (s.link, s.fast_at) = (Link::Online(SystemTime::UNIX_EPOCH), Some(now));
            s.store(Table::DiscreteInput, 1, &[1], now);
            s.store(Table::DiscreteInput, 4, &[0], now);
        });
        let running = cx.point_index("running").unwrap();
        let ready = cx.point_index("ready").unwrap();
        let shown = StateContent::of(
            &image.reading(now, second),
            [running, ready].into_iter(),
            Vec::new(),
            None,
            None,
        );
        let object = StateObject {
            shown: &shown,
            names: &["running".to_string(), "ready".to_string()],
            indices: &[running, ready],
            profile: &cx,
            fault_text: String::new(),
            age: None,
            wall: SystemTime::UNIX_EPOCH,
            historical: false,
            omitted: 0,
        };
        let object = serde_json::to_value(&object).unwrap();
        assert_eq!(
            (&object["state"], &object["quality"]),
            (&serde_json::Value::Null, &"bad".into())
        );
        assert_eq!(
            (&object["running"], &object["ready"]),
            (&serde_json::Value::Null, &true.into())
        );
        assert_eq!(object["point_quality"], serde_json::json!({"ready": "good"}));
        assert_eq!(PointPayload::state(shown.state), PointPayload::Nothing);
        image.update(|s| s.store(Table::DiscreteInput, 2, &[0], now));
        let shown = StateContent::of(
            &image.reading(now, second),
            [running, ready].into_iter(),
            Vec::new(),
            None,
            None,
        );
        assert_eq!((shown.state, shown.quality), (Some(State::Ready), Quality::Good));
    }

    #[test]
    fn events_of_drives_go_to_their_topic() {
        let topics = Topics::new("drivegate", "hall");
        let mut object = Event {
            id: 4,
            bus: "line1".to_string(),
            drive: Some("p1".to_string()),
            fault_code: Some(53),
            ..Event::new(
                drivegate_core::event::EventKind::FaultEnd,
                SystemTime::UNIX_EPOCH + Duration::from_millis(1_700_000_000_001),
                "gone".to_string(),
            )
        };
        let plant = super::super::fixture::plant(&["p1", "p2"]);
        let (to, payload) = event(&topics, &object, &plant);
        assert_eq!(to, ["drivegate/hall/drive/p1/event"]);
        let payload: serde_json::Value = serde_json::from_slice(&payload).unwrap();
        let boot = drivegate_core::event::boot();
        let expected = serde_json::json!({"id": 4, "boot": boot, "time": "2023-11-14T22:13:20.001Z", "event": "fault_end",
            "bus": "line1", "drive": "p1", "fault_code": 53, "text": "gone"});
        assert_eq!(payload, expected);
        assert_eq!(recording(&topics, &object), None);
        object.recording = Some(drivegate_core::event::RecordingMade {
            id: "20231114T221320.001Z-p1".to_string(),
            trigger: "fault".into(),
            summary: "fault 53".to_string(),
        });
        let (topic, payload) = recording(&topics, &object).unwrap();
        assert_eq!(topic, "drivegate/hall/drive/p1/recording");
        let payload: serde_json::Value = serde_json::from_slice(&payload).unwrap();
        let expected = serde_json::json!({"id": "20231114T221320.001Z-p1", "time": "2023-11-14T22:13:20.001Z",
            "trigger": "fault", "summary": "fault 53"});
        assert_eq!(payload, expected);
        object.drive = None;
        let (to, _) = event(&topics, &object, &plant);
        assert_eq!(to, ["drivegate/hall/drive/p1/event", "drivegate/hall/drive/p2/event"]);
    }

    #[test]
    fn no_point_has_the_name_of_a_key_of_the_state() {
        let source = |name: &str| {
            format!(
                "name = \"m\"\nprotocols = [\"modbus-rtu\"]\nverified = false\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\n\
                 [[point]]\nname = \"{name}\"\nat = \"holding 1\"\n"
            )
        };
        let profile = Profile::parse("m.toml", &source("level"), false).unwrap();
        let shown = StateContent {
            hold: Some(HoldFields::from(HoldView {
                state: HoldState::Free,
                holder: None,
                rank: None,
                left_s: Some(0),
            })),
            state: Some(State::NotReady),
            quality: Quality::Good,
            blocked_by: Vec::new(),
            stop_waits: Some(1),
            refreshing: Some(true),
            points: vec![(Some(Value::Integer(1)), Quality::Stale)],
        };
        let object = StateObject {
            shown: &shown,
            names: &["level".to_string()],
            indices: &[PointIndex::new(0)],
            profile: &profile,
            fault_text: String::new(),
            age: None,
            wall: SystemTime::UNIX_EPOCH,
            historical: true,
            omitted: 1,
        };
        let keys = serde_json::to_value(&object).unwrap();
        let keys: Vec<&String> = keys.as_object().unwrap().keys().collect();
        assert!(keys.len() > 15, "{keys:?}");
        for key in keys.into_iter().filter(|key| *key != "level") {
            assert!(Profile::parse("m.toml", &source(key), false).is_err(), "{key}");
        }
    }
}
