//! JSON Schema of the configuration, for editors.
//!
//! Words, bounds and defaults come from the constants that the loader uses, and a test holds the keys
//! against the keys that the loader asks for.

use std::ops::RangeInclusive;
use std::time::Duration;

use serde_json::{Map, Value, json};

use super::{bus, drive, log, modbus_tcp as modbus, mqtt, north, values};
use crate::codec::Protocol;
use crate::document::format_duration;
use crate::drive::ModelPoint;

/// A number and a unit, as [`crate::document::parse_duration`] reads it.
const DURATION: &str = r"^\s*(\d+\.?\d*|\.\d+)\s*(us|µs|ms|s|min|h)\s*$";
/// As [`crate::document::parse_size`] reads it.
const SIZE: &str = r"^\s*\d+\s*(B|KiB|MiB|GiB)\s*$";

/// The schema, draft 2020-12.
pub fn schema() -> Value {
    let mut root = table(
        "Configuration of drivegate. Variables DRIVEGATE__SECTION__KEY override any key of it; relative paths \
         are seen from the directory of the file.",
        &["gateway"],
        [
            ("gateway", gateway()),
            (
                "bus",
                tables("Serial lines (or serial device servers) with their drives.", bus()),
            ),
            ("modbus_tcp", modbus_tcp()),
            ("mqtt", mqtt()),
            ("http", http()),
            ("log", log()),
        ],
    );
    if let Value::Object(root) = &mut root {
        root.insert("$schema".into(), "https://json-schema.org/draft/2020-12/schema".into());
        root.insert("title".into(), "drivegate".into());
    }
    root
}

fn gateway() -> Value {
    table(
        "The gateway itself.",
        &["name"],
        [
            ("name", name("Name of the gateway: MQTT topics, metric label.", "-")),
            (
                "profile_dirs",
                list(
                    "Directories of your own profiles (*.toml); one with the name of a built-in profile replaces it.",
                    text("A directory."),
                ),
            ),
        ],
    )
}

fn bus() -> Value {
    table(
        "One line with its drives.",
        &["name", "port"],
        [
            ("name", name("Name of the bus, unique.", "-_")),
            (
                "port",
                text(
                    "Path of the serial device, best under /dev/serial/by-id, or tcp://host:port (raw serial \
                     over TCP).",
                ),
            ),
            (
                "protocol",
                with_default(
                    words("What the drives speak.", Protocol::ALL.iter().map(|p| p.name())),
                    bus::DEFAULT_PROTOCOL.name(),
                ),
            ),
            (
                "baud",
                with_default(number("Bits a second.", &bus::BAUDS), bus::DEFAULT_BAUD),
            ),
            (
                "format",
                pattern(
                    &format!(
                        "Data bits, parity, stop bits; without it {}, with modbus-ascii {}.",
                        bus::DEFAULT_FORMAT,
                        bus::DEFAULT_ASCII_FORMAT
                    ),
                    "^[78][NEOneo][12]$",
                ),
            ),
            (
                "rs485",
                with_default(
                    words(
                        "Who switches the direction: the adapter itself (off) or the kernel by RTS.",
                        bus::RS485.iter().map(|(w, _)| *w),
                    ),
                    "off",
                ),
            ),
            (
                "cycle",
                duration(
                    "Cadence aimed at for process data (poll class fast).",
                    Some(bus::DEFAULT_CYCLE),
                ),
            ),
            (
                "slow_cycle",
                duration(
                    "Cadence aimed at for the poll class slow.",
                    Some(bus::DEFAULT_SLOW_CYCLE),
                ),
            ),
            (
                "response_timeout",
                duration(
                    "Time for the first byte of a reply; wire time is added.",
                    Some(bus::DEFAULT_RESPONSE_TIMEOUT),
                ),
            ),
            (
                "retries",
                with_default(number("Tries after the first.", &bus::RETRIES), bus::DEFAULT_RETRIES),
            ),
            (
                "silence",
                json!({
                    "description": "Silence before each request: spec is 3.5 characters, 1.75 ms above 19200 baud; chars is 3.5 characters at any baud; a duration is for slow drives.",
                    "anyOf": [{ "enum": ["spec", "chars"] }, { "type": "string", "pattern": DURATION }],
                    "default": "spec",
                }),
            ),
            ("drive", tables("The drives on the line.", drive())),
        ],
    )
}

fn drive() -> Value {
    let writable = json!({
        "type": "array", "items": { "type": "number" }, "minItems": 2, "maxItems": 2,
        "description": "Lowest and highest value in the point's unit; what lies outside is refused.",
    });
    table(
        "One drive.",
        &["name", "address", "profile"],
        [
            ("name", name("Name of the drive, unique in the gateway.", "-_")),
            (
                "address",
                number("Address on the bus; 247 at most on Modbus.", &drive::N2_ADDRESSES),
            ),
            (
                "profile",
                pattern(
                    "Family of the drive; `drivegate profiles` lists them.",
                    "^[a-z][a-z0-9-]*$",
                ),
            ),
            (
                "unit",
                number(
                    "Modbus TCP unit id, unique in the gateway; without it the address.",
                    &drive::UNITS,
                ),
            ),
            (
                "access",
                with_default(
                    words(
                        "monitor: every write is refused. control: writes are passed on.",
                        drive::ACCESS.iter().map(|(w, _)| *w),
                    ),
                    "monitor",
                ),
            ),
            (
                "limits",
                json!({
                    "type": "object",
                    "description": format!("Limits of commands by point, such as {}.", ModelPoint::SpeedReference.name()),
                    "additionalProperties": writable,
                }),
            ),
            ("supervision", supervision()),
            (
                "on_shutdown",
                with_default(
                    words(
                        "What is done with the drive when the gateway stops.",
                        drive::ON_SHUTDOWN.iter().map(|(w, _)| *w),
                    ),
                    "hold",
                ),
            ),
            (
                "turnaround",
                duration(
                    "Time the drive takes to begin its answer, for the prediction only; without it the profile's.",
                    None,
                ),
            ),
            (
                "frequency_range",
                json!({
                    "type": "array", "minItems": 2, "maxItems": 2,
                    "items": { "type": "number", "minimum": 0, "maximum": drive::MOST_HERTZ },
                    "description": "Minimum and maximum frequency in Hz, for drives whose own parameters cannot be read.",
                }),
            ),
        ],
    )
}

fn supervision() -> Value {
    let reference = table(
        "Go to this speed reference.",
        &["speed_reference"],
        [(
            "speed_reference",
            json!({ "type": "number", "description": "Percent." }),
        )],
    );
    let words = words(
        "stop: stop the drive. hold: only tell.",
        drive::ACTIONS.iter().map(|(w, _)| *w),
    );
    table(
        "Lease of the drive: when no commanding client is heard of in time, the action is taken once. Not a \
         safety function.",
        &["timeout"],
        [
            (
                "timeout",
                duration("Time without any accepted write or heartbeat.", None),
            ),
            (
                "action",
                json!({ "anyOf": [words, reference], "default": "stop", "description": "What is done then, while the drive runs." }),
            ),
        ],
    )
}

fn modbus_tcp() -> Value {
    let network = || text("A network such as 192.168.1.0/24, or one address.");
    let listen = |description: &str| nonempty(list(description, text("Address and port.")));
    let buses = || {
        let names = list("Buses whose drives are shown; without it all.", text("Name of a bus."));
        ("buses", nonempty(names))
    };
    let allow = || {
        (
            "allow",
            list("Who may connect; without it as in [modbus_tcp].", network()),
        )
    };
    let listener = table(
        "A listener of its own.",
        &["listen"],
        [
            ("listen", listen("Addresses to listen on.")),
            allow(),
            (
                "write",
                list("Who may write; without it as in [modbus_tcp].", network()),
            ),
            buses(),
        ],
    );
    let roles = json!({
        "type": "object",
        "description": "What the roles in client certificates may do; no role and any other one may read.",
        "additionalProperties": { "enum": modbus::ROLES.map(|(word, _)| word) },
    });
    let tls = table(
        "Modbus/TCP Security: TLS in which the clients show certificates.",
        &["certificate", "key", "client_ca"],
        [
            (
                "listen",
                with_default(listen("Addresses to listen on."), [modbus::DEFAULT_TLS_LISTEN]),
            ),
            allow(),
            buses(),
            (
                "certificate",
                text("PEM file of the server's certificate, with those between it and its CA."),
            ),
            ("key", text("PEM file of the certificate's private key.")),
            ("client_ca", text("PEM file of the CA whose clients are let in.")),
            ("roles", roles),
        ],
    );
    table(
        "Modbus TCP server; not started without this section.",
        &[],
        [
            (
                "listen",
                listen(
                    "Addresses to listen on; without it, and without [[modbus_tcp.listener]] and [modbus_tcp.tls], 127.0.0.1:1502.",
                ),
            ),
            (
                "allow",
                with_default(list("Who may connect.", network()), modbus::DEFAULT_ALLOW),
            ),
            ("write", with_default(list("Who may write.", network()), json!([]))),
            (
                "max_connections",
                with_default(
                    number("Connections at one time.", &modbus::CONNECTIONS),
                    modbus::DEFAULT_CONNECTIONS,
                ),
            ),
            (
                "max_connections_per_address",
                number(
                    "Connections at one time from one address; without it no limit but max_connections.",
                    &modbus::CONNECTIONS,
                ),
            ),
            (
                "idle_timeout",
                json!({
                    "description": "Time without a request after which a connection is closed; off: never.",
                    "anyOf": [{ "enum": [modbus::OFF] }, { "type": "string", "pattern": DURATION }],
                    "default": format_duration(modbus::DEFAULT_IDLE),
                }),
            ),
            (
                "uncached",
                with_default(
                    words(
                        "Raw reads outside the plan: asked of the drive, or refused.",
                        modbus::UNCACHED.iter().map(|(w, _)| *w),
                    ),
                    "forward",
                ),
            ),
            (
                "stale_after",
                duration(
                    "Older samples are stale, on every side of the gateway.",
                    Some(modbus::DEFAULT_STALE_AFTER),
                ),
            ),
            (
                "listener",
                tables(
                    "Listeners with their own rights and their own choice of buses.",
                    listener,
                ),
            ),
            ("tls", tls),
        ],
    )
}

fn mqtt() -> Value {
    let publish = table(
        "How often values are published.",
        &[],
        [
            (
                "min_interval",
                duration(
                    "Least time between two publications of a topic.",
                    Some(mqtt::DEFAULT_MIN_INTERVAL),
                ),
            ),
            (
                "max_interval",
                duration(
                    "Most time between two publications of a topic.",
                    Some(mqtt::DEFAULT_MAX_INTERVAL),
                ),
            ),
        ],
    );
    let buffer = table(
        "Where events are kept while the broker is away; in memory only without this table.",
        &[],
        [
            ("dir", with_default(text("Directory."), mqtt::DEFAULT_BUFFER_DIR)),
            (
                "max_bytes",
                with_default(pattern("Most bytes on disk.", SIZE), mqtt::DEFAULT_BUFFER),
            ),
        ],
    );
    table(
        "MQTT client; not started without this section.",
        &[],
        [
            (
                "url",
                with_default(
                    pattern("The broker; mqtts:// for TLS.", "^mqtts?://"),
                    mqtt::DEFAULT_URL,
                ),
            ),
            (
                "client_id",
                text("Client id; without it drivegate-NAME with the name of the gateway."),
            ),
            ("username", text("User at the broker.")),
            ("password", text("Password of the user; a file is better.")),
            ("password_file", text("File whose one line is the password.")),
            (
                "ca",
                text("PEM file of the certificates that the broker's is checked against; without it the system's."),
            ),
            ("certificate", text("PEM file of the client certificate.")),
            ("key", text("PEM file of the client certificate's key.")),
            (
                "base",
                with_default(text("First levels of all topics."), mqtt::DEFAULT_BASE),
            ),
            ("publish", publish),
            (
                "commands",
                with_default(flag("Whether the set topics are served."), false),
            ),
            ("buffer", buffer),
            (
                "home_assistant",
                json!({ "const": false, "default": false, "description": "Discovery for Home Assistant is not served by this version." }),
            ),
        ],
    )
}

fn http() -> Value {
    let listen = with_default(text("Address and port."), north::DEFAULT_HTTP);
    table(
        "HTTP server for metrics, health and the status page; not started without this section.",
        &[],
        [("listen", listen)],
    )
}

fn log() -> Value {
    let levels = log::LEVELS.join("|");
    let level = format!(r"^\s*([A-Za-z0-9_:-]+=)?({levels})\s*(,\s*([A-Za-z0-9_:-]+=)?({levels})\s*)*$");
    table(
        "What is logged.",
        &[],
        [
            (
                "level",
                with_default(
                    pattern("Level, also for each target: info,drivegate::bus=debug.", &level),
                    log::DEFAULT_LEVEL,
                ),
            ),
            (
                "format",
                with_default(
                    words(
                        "auto: the journal's under systemd, coloured text on a terminal, else JSON lines.",
                        log::FORMATS.iter().map(|(w, _)| *w),
                    ),
                    "auto",
                ),
            ),
        ],
    )
}

fn table<const N: usize>(description: &str, required: &[&str], properties: [(&str, Value); N]) -> Value {
    let properties: Map<String, Value> = properties
        .into_iter()
        .map(|(key, value)| (key.to_string(), value))
        .collect();
    json!({
        "type": "object",
        "description": description,
        "properties": properties,
        "required": required,
        "additionalProperties": false,
    })
}

fn tables(description: &str, item: Value) -> Value {
    json!({ "type": "array", "description": description, "items": item })
}

fn list(description: &str, item: Value) -> Value {
    json!({ "type": "array", "description": description, "items": item })
}

fn nonempty(mut list: Value) -> Value {
    if let Value::Object(list) = &mut list {
        list.insert("minItems".into(), 1.into());
    }
    list
}

fn text(description: &str) -> Value {
    json!({ "type": "string", "description": description })
}

fn flag(description: &str) -> Value {
    json!({ "type": "boolean", "description": description })
}

fn pattern(description: &str, pattern: &str) -> Value {
    json!({ "type": "string", "description": description, "pattern": pattern })
}

fn name(description: &str, joints: &str) -> Value {
    let most = values::NAME_LENGTH;
    // A hyphen stands last in the class, where it means itself.
    let joints: String = joints.chars().rev().collect();
    pattern(description, &format!("^[a-z0-9][a-z0-9{joints}]{{0,{}}}$", most - 1))
}

fn words<'a>(description: &str, words: impl Iterator<Item = &'a str>) -> Value {
    json!({ "description": description, "enum": words.collect::<Vec<_>>() })
}

fn number<T: Copy + Into<Value>>(description: &str, bounds: &RangeInclusive<T>) -> Value {
    let (least, most): (Value, Value) = ((*bounds.start()).into(), (*bounds.end()).into());
    json!({ "type": "integer", "description": description, "minimum": least, "maximum": most })
}

fn duration(description: &str, default: Option<Duration>) -> Value {
    let duration = pattern(description, DURATION);
    match default {
        Some(default) => with_default(duration, format_duration(default)),
        None => duration,
    }
}

fn with_default(mut property: Value, default: impl serde::Serialize) -> Value {
    if let Value::Object(property) = &mut property {
        property.insert("default".into(), json!(default));
    }
    property
}
