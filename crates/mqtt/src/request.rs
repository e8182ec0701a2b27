//! Parses the messages on set topics.

use std::sync::Arc;
use std::time::Duration;

use rumqttc::Publish;
use serde_json::Value as Json;

use drivegate_core::order::{Arrival, DEFAULT_EXPIRY, Origin, Refusal, SourceKind};
use drivegate_model::drive::Profile;
use drivegate_north::command_json::{
    self, Id, MAX_PAYLOAD, ParsedCommand, Taken, check_size, excerpt, find_id, resolve,
};

/// A message on a set topic.
#[derive(Debug, Clone, Default)]
pub struct Incoming {
    pub topic: String,
    /// A JSON object, or a bare value.
    pub payload: Vec<u8>,
    /// Whether the message is or was retained, and is therefore not a command.
    pub retain: bool,
    /// Whether the broker marks the message as a repetition.
    pub dup: bool,
    /// Packet id, which identifies the repetition of the broker.
    pub packet: u16,
    /// Topic where the client expects the result.
    pub response_topic: Option<String>,
    /// Correlation data that is sent back with the result.
    pub correlation: Option<Vec<u8>>,
    /// Remaining time until the message expires, s.
    pub expiry: Option<u32>,
    /// The sender, from the user property `who`.
    pub who: Option<String>,
    /// Size of a payload that was too long; `payload` then contains only its `id`.
    pub oversized: Option<usize>,
    /// When the message arrived; `None` if it is processed at once.
    pub arrival: Option<Arrival>,
}

impl Incoming {
    /// A message that arrived at this time; `None` if its topic is not UTF-8.
    pub(super) fn of(publish: Publish, arrival: Arrival) -> Option<Incoming> {
        let properties = publish.properties.unwrap_or_default();
        let who = properties.user_properties.into_iter().find(|(name, _)| name == "who");
        let mut incoming = Incoming {
            topic: String::from_utf8(publish.topic.to_vec()).ok()?,
            payload: Vec::new(),
            retain: publish.retain,
            dup: publish.dup,
            packet: publish.pkid,
            response_topic: properties.response_topic,
            correlation: properties.correlation_data.map(|data| data.to_vec()),
            expiry: properties.message_expiry_interval,
            who: who.map(|(_, who)| who),
            oversized: None,
            arrival: Some(arrival),
        };
        if publish.payload.len() <= MAX_PAYLOAD {
            incoming.payload = publish.payload.to_vec();
        } else {
            let id = find_id(&publish.payload).map_or_else(|| "null".to_string(), |id| id.text().to_string());
            incoming.payload = format!("{{\"id\":{id}}}").into_bytes();
            incoming.oversized = Some(publish.payload.len());
        }
        Some(incoming)
    }

    /// The sender: given by the topic, which the broker's access rules protect; for the audit, also by its user property.
    pub(super) fn origin(&self, client: &Arc<str>, kind: SourceKind) -> Origin {
        let who = self.who.as_deref().map(|who| excerpt(who.as_bytes()));
        let who = who.as_deref().map_or(self.topic.as_str(), |who| who.trim_matches('`'));
        Origin::of(client.clone(), kind, who)
    }

    /// The parts of the message by which a repetition is recognised.
    pub(super) fn taken(&self) -> Taken<'_> {
        Taken {
            topic: &self.topic,
            payload: &self.payload,
            answer_to: (self.response_topic.as_deref(), self.correlation.as_deref()),
            dup: self.dup,
            packet: self.packet,
            expiry: self.expiry,
        }
    }
}

/// The `id` of a message, read before the rest, so that a client can match the result to its request even if the
/// rest is invalid. `None` if the payload is not JSON or contains several ids.
pub(super) fn id(incoming: &Incoming, point: Option<&str>) -> Option<Id> {
    match point {
        Some(_) => None,
        None => find_id(&incoming.payload),
    }
}

/// The command in a message on a set topic; `point` is the point of a bare value.
///
/// # Errors
/// If the gateway executes nothing of the message; contains the reason.
pub(super) fn order(incoming: &Incoming, point: Option<&str>, profile: &Profile) -> Result<ParsedCommand, Refusal> {
    if incoming.retain {
        return Err(Refusal::NotAllowed(
            "a retained message is never a command; publish it without the retain flag and clear the topic".to_string(),
        ));
    }
    check_size(incoming.oversized.unwrap_or(incoming.payload.len()))?;
    let mut asked = match point {
        Some(name) => {
            let value = text_of(&incoming.payload, name, profile).map_or_else(|| bare(&incoming.payload), Ok)?;
            let points = vec![resolve(profile, name, &value)?];
            ParsedCommand::new(points, DEFAULT_EXPIRY, None, profile)?
        }
        None => command_json::order(&incoming.payload, profile)?,
    };
    if let Some(seconds) = incoming.expiry {
        asked.expiry = asked.expiry.min(Duration::from_secs(seconds.into()));
    }
    Ok(asked)
}

/// The text of an enumeration, sent as the bare value of its point.
fn text_of(payload: &[u8], name: &str, profile: &Profile) -> Option<Json> {
    let point = profile.points.get(profile.point_index(name)?)?;
    let text = std::str::from_utf8(payload).ok()?.trim();
    point.code_of(text).map(|_| Json::String(text.to_string()))
}

/// The value of a `set/{point}` message: `true`, `false`, or a number.
fn bare(payload: &[u8]) -> Result<Json, Refusal> {
    let bad = || Refusal::BadValue(format!("{} is not true, false or a number", excerpt(payload)));
    let text = std::str::from_utf8(payload).map_err(|_| bad())?.trim();
    match text {
        "true" => Ok(Json::Bool(true)),
        "false" => Ok(Json::Bool(false)),
        // JSON numbers, and what people write instead: +5, .5, 007. No NaN, no infinity.
        _ if text.chars().all(|c| c.is_ascii_digit() || "+-.eE".contains(c)) => {
            // A whole number keeps every digit.
            let whole = text.parse::<i64>().map(Json::from);
            let whole = whole.or_else(|_| text.parse::<u64>().map(Json::from));
            whole.or_else(|_| {
                let number: f64 = text.parse().map_err(|_| bad())?;
                serde_json::Number::from_f64(number).map(Json::Number).ok_or_else(bad)
            })
        }
        _ => Err(bad()),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use drivegate_model::drive::Value;
    use drivegate_model::drive::profile::Profiles;
    use drivegate_north::command_json::MAX_ID;

    fn profile() -> Arc<Profile> {
        Profiles::built_in().get("vacon-nx").unwrap().clone()
    }

    fn message(payload: &str) -> Incoming {
        Incoming {
            payload: payload.into(),
            ..Incoming::default()
        }
    }

    struct SetRequest {
        /// The id, present even if the rest is refused.
        id: Option<Id>,
        order: Result<ParsedCommand, Refusal>,
    }

    fn read(incoming: &Incoming, point: Option<&str>, profile: &Profile) -> SetRequest {
        SetRequest {
            id: id(incoming, point),
            order: order(incoming, point, profile),
        }
    }

    fn set(payload: &str) -> SetRequest {
        read(&message(payload), None, &profile())
    }

    fn set_point(point: &str, payload: &str) -> Result<Value, Refusal> {
        let order = read(&message(payload), Some(point), &profile()).order;
        order.map(|asked| asked.points[0].1)
    }

    /// The `id` of a request as JSON.
    fn id_of(request: SetRequest) -> Option<Json> {
        request.id.map(|id| serde_json::from_str(id.text()).unwrap())
    }

    fn code(request: SetRequest) -> (&'static str, String) {
        let refusal = request.order.unwrap_err();
        (refusal.code(), refusal.to_string())
    }

    #[test]
    fn an_object_is_one_order() {
        let request = set(r#"{"id": "a-1", "run": true, "speed_reference": 50.5, "expires_ms": 500}"#);
        assert_eq!(request.id.as_ref().map(Id::text), Some("\"a-1\""));
        let ParsedCommand { points, expiry, .. } = request.order.unwrap();
        let index = |name| profile().point_index(name).unwrap();
        let expected = [
            (index("run"), Value::Bool(true)),
            (index("speed_reference"), Value::Number(50.5)),
        ];
        assert_eq!(points, expected);
        assert_eq!(expiry, Duration::from_millis(500));
        let ParsedCommand { points, expiry, .. } = set(r#"{"run": 0, "id": 7}"#).order.unwrap();
        assert_eq!((points[0].1, expiry), (Value::Bool(false), DEFAULT_EXPIRY));
        assert_eq!(set("{}").order.unwrap().points, [], "refused as an empty command later");
    }

    #[test]
    fn errors_are_described() {
        for (payload, wanted, text) in [
            ("run", "bad_value", "`run` is not JSON"),
            ("", "bad_value", "is not JSON"),
            ("[1]", "bad_value", "is not a JSON object"),
            ("true", "bad_value", "is not a JSON object"),
            ("NaN", "bad_value", "is not JSON"),
            (r#"{"run": NaN}"#, "bad_value", "is not JSON"),
            (r#"{"speed_reference": 1e999}"#, "bad_value", "is not JSON"),
            (r#"{"run": true, "run": false}"#, "bad_value", "sets `run` twice"),
            (
                r#"{"sped_reference": 5}"#,
                "not_writable",
                "did you mean `speed_reference`?",
            ),
            (
                r#"{"gobbledygook": 5}"#,
                "not_writable",
                "writable points: run, reverse",
            ),
            (r#"{"ready": true}"#, "not_writable", "`ready` is read-only"),
            (r#"{"speed_reference": "50"}"#, "bad_value", "remove the quotes"),
            (r#"{"speed_reference": true}"#, "bad_value", "is not a number"),
            (r#"{"speed_reference": null}"#, "bad_value", "is not a number"),
            (r#"{"run": "true"}"#, "bad_value", "is not true or false"),
            (r#"{"run": 2}"#, "bad_value", "`run` = 2 is not true or false"),
            (r#"{"run": [true]}"#, "bad_value", "is not true or false"),
            (r#"{"run": true, "expires_ms": 0}"#, "bad_value", "`expires_ms` = 0"),
            (r#"{"run": true, "expires_ms": 60001}"#, "bad_value", "from 1 to 60000"),
            (r#"{"run": true, "expires_ms": 1.5}"#, "bad_value", "`expires_ms` = 1.5"),
            (
                r#"{"run": true, "id": {}}"#,
                "bad_value",
                "`id` is a number or a string",
            ),
        ] {
            let (code, message) = code(set(payload));
            assert_eq!(code, wanted, "{payload}: {message}");
            assert!(message.contains(text), "{payload}: {message}");
        }
    }

    #[test]
    fn a_stop_is_understood_whatever_is_wrong_with_the_rest() {
        let run = profile().point_index("run").unwrap();
        for (payload, text) in [
            (r#"{"run": false, "sped_reference": 5}"#, "did you mean"),
            (r#"{"speed_reference": "5", "run": 0}"#, "remove the quotes"),
            (r#"{"run": false, "ready": true}"#, "is read-only"),
            (r#"{"run": false, "expires_ms": 0}"#, "`expires_ms` = 0"),
            (r#"{"run": false, "id": {}}"#, "`id` is a number or a string"),
            (
                r#"{"run": false, "speed_reference": 1, "speed_reference": 2}"#,
                "twice; set each point once",
            ),
        ] {
            let asked = set(payload).order.expect(payload);
            assert_eq!(asked.points, [(run, Value::Bool(false))], "{payload}");
            assert!(asked.refused.unwrap().to_string().contains(text), "{payload}");
        }
        for (payload, text) in [
            (r#"{"run": false, "speed_reference": NaN}"#, "is not JSON"),
            (r#"{"speed_reference": 1e999, "run": false}"#, "is not JSON"),
            (r#"{"a\"NaN": -Infinity, "run":false}"#, "is not JSON"),
            (r#"{"frequency_reference":nan,"run":0,"id":7}"#, "is not JSON"),
            (r#"{"run": false, "speed_reference": [1, {"x": None}]}"#, "is not JSON"),
        ] {
            let asked = set(payload).order.expect(payload);
            assert_eq!(asked.points, [(run, Value::Bool(false))], "{payload}");
            assert!(asked.refused.unwrap().to_string().contains(text), "{payload}");
        }
        for ambiguous in [
            r#"{"run": false, "run": true}"#,
            r#"{"run": False, "speed_reference": NaN}"#,
            r#"{"run": "NaN, \"run\": false", "x": NaN}"#,
            r#"{"run": false, "run": NaN, "run": true}"#,
            r#"[{"run": false}, NaN]"#,
            r#"{run: false}"#,
            r#"{"run": false"#,
            r#"{"run": "false"}"#,
        ] {
            assert!(set(ambiguous).order.is_err(), "{ambiguous}");
        }
    }

    #[test]
    fn a_refusal_carries_the_id_wherever_it_stands_and_whatever_is_wrong() {
        for (payload, id) in [
            (r#"{"sped": 5, "run": true, "id": 12}"#, 12.into()),
            (r#"{"id": 11, "run": false, "run": true}"#, 11.into()),
            (r#"{"run": false, "run": true, "id": "a"}"#, "a".into()),
            (r#"{"speed_reference": 1e999, "\u0069d": 3}"#, 3.into()),
            (r#"{"id": 4, "expires_ms": 0}"#, 4.into()),
            // Payloads without an `id`, or with an unclear one.
            (r#"{"id": 1, "id": 2}"#, Json::Null),
            (r#"{"id": [1], "run": 2}"#, Json::Null),
            (r#"{"id": null, "run": 2}"#, Json::Null),
            (r#"{"id": 1, "run": NaN}"#, Json::Null),
            (r#"{"id": 1, "run": 2"#, Json::Null),
            (r#"{"id": 1, "run": 2} {}"#, Json::Null),
            (r#"{"run": 2, "ready": {"id": 1}}"#, Json::Null),
            (r#"[{"id": 1}]"#, Json::Null),
            (r#""id""#, Json::Null),
        ] {
            let request = set(payload);
            assert!(request.order.is_err(), "{payload}");
            assert_eq!(id_of(request).unwrap_or_default(), id, "{payload}");
        }
        let long = |n| set(&format!(r#"{{"id": "{}", "sped": 1}}"#, "x".repeat(n))).id;
        assert!(long(MAX_ID).is_some() && long(MAX_ID + 1).is_none());
        let bare = message(r#"{"id": 1}"#);
        assert_eq!(read(&bare, Some("run"), &profile()).id, None);
    }

    #[test]
    fn bare_values() {
        for (payload, value) in [
            ("true", true),
            (" false\n", false),
            ("1", true),
            ("0", false),
            ("0.0", false),
        ] {
            assert_eq!(set_point("run", payload), Ok(Value::Bool(value)), "{payload}");
        }
        for (payload, value) in [("50", 50.0), ("-12.5", -12.5), ("+5", 5.0), (".5", 0.5), ("1e1", 10.0)] {
            assert_eq!(
                set_point("speed_reference", payload),
                Ok(Value::Number(value)),
                "{payload}"
            );
        }
        for bad in [
            "", "on", "TRUE", "nan", "NaN", "inf", "-inf", "1e999", "0x10", "\"50\"", "5 0", "{}", "-", "1,5",
        ] {
            assert!(set_point("speed_reference", bad).is_err(), "{bad}");
        }
        assert!(set_point("speed_reference", "true").is_err());
        assert_eq!(set_point("nothing", "1").unwrap_err().code(), "not_writable");
    }

    /// An enumeration can be written by its text over every interface, and also by its number; whole numbers keep
    /// every digit.
    #[test]
    fn enumerations_are_written_by_text() {
        let text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\nread = 5\n\
            write = 5\n[[point]]\nname = \"count\"\nat = \"holding 1\"\ntype = \"u64\"\nwrite = true\n\
            [[point]]\nname = \"mode\"\nat = \"holding 0\"\nwrite = true\n[point.texts]\n0 = \"off\"\n3 = \"night mode\"\n\
            4 = \"twice\"\n5 = \"twice\"\n";
        let profile = Profile::parse("p.toml", text, false).unwrap();
        let value = |point: Option<&str>, payload: &str| {
            let order = read(&message(payload), point, &profile).order;
            order.map(|asked| asked.points[0].1)
        };
        for (payload, wanted) in [("night mode", 3), ("off", 0)] {
            assert_eq!(value(Some("mode"), payload), Ok(Value::Integer(wanted)));
            let object = format!("{{\"mode\": \"{payload}\"}}");
            assert_eq!(value(None, &object), Ok(Value::Integer(wanted)));
        }
        assert_eq!(value(Some("mode"), "3"), Ok(Value::Number(3.0)));
        for bad in ["night", "twice", "Off"] {
            assert!(value(Some("mode"), bad).is_err(), "{bad}");
        }
        for (number, wanted) in [
            ("9007199254740993", Value::Integer(9_007_199_254_740_993)),
            ("18446744073709551615", Value::Unsigned(u64::MAX)),
        ] {
            assert_eq!(value(None, &format!("{{\"count\": {number}}}")), Ok(wanted));
            assert_eq!(value(Some("count"), number), Ok(wanted));
        }
    }

    #[test]
    fn retained_and_oversized_messages_are_refused() {
        let retained = Incoming {
            retain: true,
            ..message(r#"{"run": true, "id": 40}"#)
        };
        let refused = read(&retained, None, &profile());
        assert_eq!(refused.id.as_ref().map(Id::text), Some("40"));
        let (code_retained, text) = code(refused);
        assert_eq!(code_retained, "not_allowed");
        assert!(text.contains("retained"), "{text}");
        assert!(
            read(
                &Incoming {
                    retain: true,
                    ..message("1")
                },
                Some("run"),
                &profile()
            )
            .order
            .is_err()
        );
        let big = format!(r#"{{"id": "{}"}}"#, "x".repeat(MAX_PAYLOAD));
        assert!(code(set(&big)).1.contains("65536 are allowed"));
        let padded = format!(r#"{{"pad": "{}", "id": 41}}"#, "x".repeat(MAX_PAYLOAD));
        assert_eq!(id_of(set(&padded)), Some(41.into()));
    }

    #[test]
    fn an_id_is_returned_as_it_was_written() {
        for id in ["123456789012345678901234567890", "1.0", "-0", "1e999", r#""ä\u0062""#] {
            let request = set(&format!(r#"{{"id": {id}, "run": 2}}"#));
            assert_eq!(request.id.as_ref().map(Id::text), Some(id));
            assert_eq!(serde_json::to_string(&request.id).unwrap(), id);
        }
    }

    #[test]
    fn of_a_payload_that_is_too_long_the_id_is_kept() {
        let of = |payload: String| {
            let publish = Publish::new("t", rumqttc::mqttbytes::QoS::AtLeastOnce, payload, None);
            Incoming::of(publish, Arrival::now(Instant::now())).unwrap()
        };
        let padding = "x".repeat(300_000);
        let incoming = of(format!(r#"{{"pad": "{padding}", "id": 41}}"#));
        assert!(incoming.payload.len() < 100);
        let refused = read(&incoming, None, &profile());
        assert_eq!(refused.id.as_ref().map(Id::text), Some("41"));
        assert!(code(refused).1.contains("the payload has 3000"));
        assert!(read(&of(padding), None, &profile()).order.is_err());
    }

    #[test]
    fn message_expiry_limits_command_expiry() {
        let expiry = |payload: &str, life| {
            let incoming = Incoming {
                expiry: Some(life),
                ..message(payload)
            };
            read(&incoming, None, &profile()).order.unwrap().expiry
        };
        assert_eq!(expiry(r#"{"run": true}"#, 1), Duration::from_secs(1));
        assert_eq!(expiry(r#"{"run": true}"#, 10), DEFAULT_EXPIRY);
        assert_eq!(
            expiry(r#"{"run": true, "expires_ms": 9000}"#, 5),
            Duration::from_secs(5)
        );
    }

    #[test]
    fn excerpts_are_short() {
        let long = format!(r#"{{"{}": 1}}"#, "n".repeat(60_000));
        let (_, text) = code(set(&long));
        // The length without the names of all points that can be commanded.
        assert!(text.len() < 700, "{}", text.len());
        assert_eq!(excerpt(b"\"a\"\x00b\xff"), "`\"a\"\\u{0}b\u{fffd}`");
    }
}
