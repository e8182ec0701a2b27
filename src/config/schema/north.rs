//! `[modbus_tcp]`, `[mqtt]` and `[http]`.

use serde_json::{Value, json};

use super::forms::{
    DURATION, SIZE, duration, flag, list, nonempty, number, pattern, table, tables, text, with_default, words,
};
use crate::config::{modbus_tcp as modbus, mqtt, north};
use crate::document::format_duration;

/// `[modbus_tcp]`.
pub(super) fn modbus_tcp() -> Value {
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
            ("tls", tls()),
        ],
    )
}

fn tls() -> Value {
    let roles = json!({
        "type": "object",
        "description": "What the roles in client certificates may do; no role and any other one may read.",
        "additionalProperties": { "enum": modbus::ROLES.map(|(word, _)| word) },
    });
    table(
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
    )
}

fn network() -> Value {
    text("A network such as 192.168.1.0/24, or one address.")
}

fn listen(description: &str) -> Value {
    nonempty(list(description, text("Address and port.")))
}

fn buses() -> (&'static str, Value) {
    let names = list("Buses whose drives are shown; without it all.", text("Name of a bus."));
    ("buses", nonempty(names))
}

fn allow() -> (&'static str, Value) {
    (
        "allow",
        list("Who may connect; without it as in [modbus_tcp].", network()),
    )
}

/// `[mqtt]`.
pub(super) fn mqtt() -> Value {
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

/// `[http]`.
pub(super) fn http() -> Value {
    let listen = with_default(text("Address and port."), north::DEFAULT_HTTP);
    table(
        "HTTP server for metrics, health and the status page; not started without this section.",
        &[],
        [("listen", listen)],
    )
}
