//! The file names in the state directory and in that of the MQTT buffer.

/// File of events; the names of older files end with a number.
pub const EVENTS: &str = "events.jsonl";
/// File of run hours and starts.
pub const COUNTERS: &str = "counters.json";
/// Starts of the last hour of drives with a guard.
pub const STARTS: &str = "starts.json";
/// File that is locked by the process that counts these starts.
pub const STARTS_LOCK: &str = "starts.lock";
/// First part of the names of buffered MQTT events.
pub const MQTT_EVENTS: &str = "mqtt-events";
/// First part of the names of buffered MQTT history.
pub const MQTT_HISTORY: &str = "mqtt-history";
/// Retained MQTT topics of the last run.
pub const MQTT_TOPICS: &str = "mqtt-topics";
/// File with the number of the Sparkplug session.
pub const SPARKPLUG: &str = "sparkplug-bdseq";
/// File of the reservations that stops left.
pub const RESERVATIONS: &str = "reservations.json";
/// File of the drills, and of the time at which each way to stop was last proven.
pub const DRILLS: &str = "drills.json";
/// File of the slots in which BACnet clients hold `run` inactive.
pub const BACNET_PRIORITIES: &str = "bacnet-priorities.json";
/// Directory of the recordings.
pub const RECORDINGS: &str = "recordings";
/// Directory of the parameters.
pub const PARAMS: &str = "params";

/// Start of the names, before a `.` or `-` or their end; counters are written and set aside under other endings.
const OWN: [&str; 12] = [
    EVENTS,
    "counters",
    "starts",
    MQTT_EVENTS,
    MQTT_HISTORY,
    MQTT_TOPICS,
    SPARKPLUG,
    "reservations",
    "drills",
    "bacnet-priorities",
    RECORDINGS,
    PARAMS,
];

/// Whether the gateway itself keeps a file of this name, or may create one later.
pub fn is_own(name: &str) -> bool {
    let rest = |own: &&str| name.strip_prefix(*own);
    OWN.iter()
        .filter_map(rest)
        .any(|rest| rest.is_empty() || rest.starts_with(['.', '-']))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_names_and_others() {
        for own in [
            EVENTS,
            COUNTERS,
            STARTS,
            MQTT_EVENTS,
            MQTT_HISTORY,
            MQTT_TOPICS,
            SPARKPLUG,
            RESERVATIONS,
            DRILLS,
            BACNET_PRIORITIES,
            RECORDINGS,
            PARAMS,
        ] {
            assert!(is_own(own), "{own}");
        }
        for own in [
            "events.jsonl.1",
            "counters.partial",
            "counters.damaged-1",
            STARTS_LOCK,
            "mqtt-events-1.log",
            "mqtt-history-2-30.damaged",
            "mqtt-events.lock",
            "mqtt-topics.new",
        ] {
            assert!(is_own(own), "{own}");
        }
        for other in [
            "audit.jsonl",
            "events.log",
            "commands.jsonl",
            "countersigned",
            "params2",
        ] {
            assert!(!is_own(other), "{other}");
        }
    }
}
