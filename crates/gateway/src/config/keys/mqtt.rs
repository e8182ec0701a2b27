//! `[mqtt]` and its tables.

use std::net::IpAddr;

use super::forms::*;
use drivegate_mqtt::History;

/// Longest client id, base or id of Sparkplug, bytes: MQTT allows 65,535 for a whole topic, in which names of drives and points
/// follow, and for a client id, to which `-sparkplug` is added.
const LONGEST_NAME: usize = 16_384;
/// Most levels of a base; brokers allow 200 (Mosquitto) or fewer for a whole topic.
const MOST_LEVELS: usize = 64;
const EXPIRY: Time = Time(Duration::ZERO..=Duration::from_secs(365 * 86_400));
const SPARKPLUG_ID: Parsed<String> = Parsed {
    parse: parse_sparkplug_id,
    words: &[],
    pattern: "^[^/+#]+$",
    range: "an id without /, + and #",
};

keys! {
    /// MQTT client; not started without this section.
    MQTT: Mqtt {
        /// The broker; `mqtts` uses TLS, default port 8883, `ws` and `wss` WebSocket, default ports 80 and 443.
        url: Broker = Parsed {
            parse: parse_url, words: &[], pattern: "^(mqtt|ws)s?://",
            range: "\"mqtt://host[:port]\", \"mqtts://…\", \"ws://host[:port]/path\" or \"wss://…\"",
        }, default "mqtt://127.0.0.1:1883";
        /// [Further brokers](mqtt.md#several-brokers), tried in order after `url`; with its credentials and scheme.
        urls: Vec<Broker> = List {
            parse: parse_url, empty: None, range: "addresses such as [\"mqtt://broker-2:1883\"]",
        }, default [];
        /// HTTP proxy by which the brokers are reached (CONNECT); it resolves their names, and nothing goes past it.
        proxy: ProxyAddress = Parsed {
            parse: parse_proxy, words: &[], pattern: "^http://", range: "\"http://host:port\"",
        }, or "none";
        /// Client id, unique on the broker.
        client_id: String = Parsed { parse: parse_client_id, words: &[], pattern: "", range: "a string in quotes" },
            or "`drivegate-` and the gateway's name";
        /// User name on the broker.
        username: String = Parsed { parse: parse_username, words: &[], pattern: "", range: "a string in quotes" }, or "none";
        /// Password of the user; `password_file` is better.
        password: String = STRING, or "none";
        /// File whose only line is the password, such as a systemd credential, a container secret or a token that another
        /// program renews: it is read for each connection.
        password_file: PathBuf = PATH, or "none";
        /// PEM file with the CA certificates used to verify the broker's certificate.
        ca: PathBuf = PATH, or "the system's";
        /// PEM file of the client certificate; needs `key`.
        certificate: PathBuf = PATH, or "none";
        /// PEM file of the client certificate's private key.
        key: PathBuf = PATH, or "none";
        /// Prefix of all topics.
        base: String = Parsed {
            parse: parse_base, words: &[], pattern: "", range: "a topic without + and #",
        }, default "drivegate";
        /// Which telemetry is published: the state of each drive as one object, each point as a bare value, or both.
        topics: Vec<TelemetryTopic> = List {
            parse: parse_topic, empty: Some("write [\"state\"], [\"points\"] or both"),
            range: "[\"state\", \"points\"] or one of them",
        }, default ["state", "points"];
        /// Quality of service of published messages.
        qos: Present = Own { schema: MqttQos::schema, range: "[mqtt.qos]" }, or "the defaults";
        /// Whether messages are retained; `false` for brokers that [refuse
        /// that](mqtt.md#security-and-brokers).
        retain: bool = Flag, default true;
        /// The broker drops telemetry that is older (message expiry); `"0s"`: never.
        expiry: Duration = EXPIRY, default "5min";
        /// The broker drops `online`, and telemetry at the latest, after this time; renewed after half of it; `"0s"`:
        /// never.
        message_expiry: Duration = EXPIRY, default "10min";
        /// Values of an outage that are published afterwards, on `history` topics: those that changed, or all samples.
        history: History = Words(&[
            ("off", History::Off), ("changes", History::Changes), ("all", History::All),
        ]), default "off";
        /// Most messages that each connection publishes in any second; 0: no limit.
        publish_limit: usize = Number(0..=100_000, None), default 0;
        /// How often values are published.
        publish: Present = Own { schema: Publish::schema, range: "[mqtt.publish]" }, or "the defaults";
        /// Whether commands are accepted on the set topics, for drives with `access = "control"`, from anyone the
        /// broker allows to publish there.
        commands: bool = Flag, default false;
        /// Whether commands without an `id` are refused, except stops: only with an `id` a repetition is recognised.
        require_id: bool = Flag, default false;
        /// Filters of response topics below `base` that results may be sent to. Topics outside `base` are always
        /// allowed.
        response_topics: Vec<String> = List {
            parse: parse_filter, empty: None, range: "topic filters, such as [\"drivegate/answers/#\"]",
        }, default [];
        /// Where events and history are buffered while the broker is unreachable.
        buffer: Present = Own { schema: Buffer::schema, range: "[mqtt.buffer]" }, or "in memory; under systemd 64 MiB on disk";
        /// Discovery for Home Assistant: [the drives appear there](home-assistant.md) by themselves.
        home_assistant: Present = Own {
            schema: || json!({ "anyOf": [{ "const": false }, MqttHomeAssistant::schema()] }),
            range: "[mqtt.home_assistant], or false",
        }, or "off";
        /// The gateway as an edge node of [Sparkplug B](sparkplug.md), on its own connection.
        sparkplug: Present = Own { schema: Sparkplug::schema, range: "[mqtt.sparkplug]" }, or "not published";
    }

    /// Discovery for Home Assistant; off without this table.
    MQTT_HOME_ASSISTANT: MqttHomeAssistant {
        /// The discovery prefix set in Home Assistant.
        discovery_prefix: String = Parsed {
            parse: parse_base, words: &[], pattern: "", range: "a topic without + and #",
        }, default "homeassistant";
    }

    /// How often values are published.
    PUBLISH: Publish {
        /// Minimum time between two messages on a topic.
        min_interval: Duration = Time(Duration::ZERO..=HOUR), default "50ms";
        /// An unchanged value is published again after this time.
        max_interval: Duration = Time(Duration::from_millis(10)..=Duration::from_secs(86_400)), default "60s";
    }

    /// Quality of service of published messages: 0 is sent once, 1 until the broker acknowledges it.
    MQTT_QOS: MqttQos {
        /// For states, points and buses. With 1, a distant broker limits the rate to its receive maximum per round
        /// trip.
        telemetry: u8 = Number(0..=1, None), default 0;
        /// For events and history; results of commands use 1.
        events: u8 = Number(0..=1, None), default 1;
    }

    /// Where events and history are buffered while the broker is unreachable; without this table, in memory, and
    /// under systemd up to 64 MiB on disk.
    BUFFER: Buffer {
        /// Directory of the buffer.
        dir: PathBuf = PATH, default "/var/lib/drivegate";
        /// Maximum size on disk; beyond it the oldest events are dropped.
        max_bytes: u64 = BUFFER_SIZE, default "64MiB";
    }

    /// The gateway as an edge node of [Sparkplug B](sparkplug.md), on a connection of its own to the same broker; its
    /// client id is that of `[mqtt]` with `-sparkplug` after it.
    SPARKPLUG: Sparkplug {
        /// Group id: second level of all its topics.
        group: String = SPARKPLUG_ID, required;
        /// Edge node id, unique in the group.
        node: String = SPARKPLUG_ID, or "the name of the gateway";
        /// Id of the host that must be online: until then, and while it is not, values are kept as history. `""` is none.
        primary_host: String = Parsed {
            parse: parse_primary_host, words: &[], pattern: "^[^/+#]*$", range: "an id without /, + and #, or \"\"",
        }, default "";
        /// Whether data messages name their metrics by aliases, which are shorter.
        alias: bool = Flag, default true;
        /// Whether values of an outage are published afterwards, as historical.
        history: bool = Flag, default true;
    }
}

/// The form in which telemetry is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::config) enum TelemetryTopic {
    State,
    Points,
}

/// Address of a broker.
pub(in crate::config) struct Broker {
    pub(in crate::config) host: String,
    pub(in crate::config) port: u16,
    pub(in crate::config) tls: bool,
    /// Path of MQTT over WebSocket; absent for plain TCP.
    pub(in crate::config) path: Option<String>,
}

/// `http://host:port` of a proxy.
pub(in crate::config) struct ProxyAddress {
    pub(in crate::config) host: String,
    pub(in crate::config) port: u16,
}

impl Broker {
    /// Whether the broker is on this machine.
    pub(in crate::config) fn is_here(&self) -> bool {
        let address: Option<IpAddr> = self.host.parse().ok();
        address.map_or(self.host.eq_ignore_ascii_case("localhost"), |address| {
            address.is_loopback()
        })
    }
}

fn parse_client_id(text: &str) -> Result<String, Finding> {
    match text {
        "" => Err(Finding::new(
            "the client id is empty",
            "write a name or leave the key out",
        )),
        text => Ok(within_mqtt("the client id", text, LONGEST_NAME)?.to_string()),
    }
}

fn parse_username(text: &str) -> Result<String, Finding> {
    Ok(within_mqtt("the user name", text, usize::from(u16::MAX))?.to_string())
}

/// A text as brokers take it: they close the connection for others, or must.
fn within_mqtt<'t>(what: &str, text: &'t str, most: usize) -> Result<&'t str, Finding> {
    let odd = |c: &char| c.is_control() || matches!(u32::from(*c), 0xFDD0..=0xFDEF) || u32::from(*c) & 0xFFFE == 0xFFFE;
    if let Some(odd) = text.chars().find(odd) {
        return Err(Finding::new(
            format!("{what} contains U+{:04X}, which MQTT does not allow", u32::from(odd)),
            "write it without control characters",
        ));
    }
    match text.len() {
        bytes if bytes > most => Err(Finding::new(
            format!("{what} has {bytes} bytes"),
            format!("write at most {most} bytes"),
        )),
        _ => Ok(text),
    }
}

fn parse_url(text: &str) -> Result<Broker, Finding> {
    let bad = |why: &str| {
        Finding::new(
            format!("`{}` {why}", hidden(text)),
            "write \"mqtt://host:port\", \"mqtts://host:port\", \"ws://host:port/path\" or \"wss://host:port/path\"",
        )
    };
    let (scheme, rest) = text.split_once("://").ok_or_else(|| bad("has no scheme"))?;
    let (tls, port, web) = match scheme {
        "mqtt" => (false, 1883, false),
        "mqtts" => (true, 8883, false),
        "ws" => (false, 80, true),
        "wss" => (true, 443, true),
        _ => return Err(bad("is not an MQTT address")),
    };
    if rest.contains('@') {
        return Err(Finding::new(
            "the address contains a user",
            "write username and password_file as separate keys",
        ));
    }
    let (server, path) = match rest.split_once('/').filter(|_| web) {
        Some((server, path)) => (server, format!("/{path}")),
        None => (rest.strip_suffix('/').unwrap_or(rest), "/".to_string()),
    };
    let (host, port) = values::host_port(server, Some(port)).ok_or_else(|| bad("has no valid host and port"))?;
    if !path
        .bytes()
        .all(|byte| byte.is_ascii_graphic() && !b"\"<>\\^`{|}#".contains(&byte))
    {
        return Err(bad("has a path with characters that no URL has"));
    }
    let path = web.then_some(path);
    Ok(Broker { host, port, tls, path })
}

fn parse_proxy(text: &str) -> Result<ProxyAddress, Finding> {
    let bad = |why: &str| Finding::new(format!("`{}` {why}", hidden(text)), "write \"http://host:port\"");
    if text.contains('@') {
        return Err(bad("contains a user; proxies that ask for one are not supported"));
    }
    let server = text
        .strip_prefix("http://")
        .ok_or_else(|| bad("is not the address of an HTTP proxy"))?;
    let server = server.strip_suffix('/').unwrap_or(server);
    let (host, port) = values::host_port(server, None).ok_or_else(|| bad("has no valid host and port"))?;
    Ok(ProxyAddress { host, port })
}

/// The address without what may be a password.
fn hidden(url: &str) -> String {
    match url.rsplit_once('@') {
        Some((_, host)) => format!("…@{host}"),
        None => url.to_string(),
    }
}

fn parse_base(text: &str) -> Result<String, Finding> {
    let levels = || text.split('/');
    let bad = text.contains(['+', '#', '\0']) || text.starts_with('$') || levels().any(str::is_empty);
    if bad {
        return Err(Finding::new(
            format!("`{text}` cannot be the start of a topic"),
            "write levels joined by /, none of them empty, without + and #, not starting with $",
        ));
    }
    if levels().count() > MOST_LEVELS {
        return Err(Finding::new(
            format!("the topic has {} levels", levels().count()),
            format!("write at most {MOST_LEVELS} levels: brokers refuse deeper topics"),
        ));
    }
    Ok(within_mqtt("the topic", text, LONGEST_NAME)?.to_string())
}

fn parse_topic(text: &str) -> Result<TelemetryTopic, Finding> {
    match text {
        "state" => Ok(TelemetryTopic::State),
        "points" => Ok(TelemetryTopic::Points),
        _ => Err(values::unknown_word(text, ["state", "points"].into_iter())),
    }
}

fn parse_filter(text: &str) -> Result<String, Finding> {
    let levels: Vec<&str> = text.split('/').collect();
    let wild = |level: &&str| level.contains(['+', '#']) && level.len() > 1;
    let early = levels.iter().rev().skip(1).any(|level| *level == "#");
    if text.is_empty() || text.contains('\0') || text.starts_with('$') || early || levels.iter().any(wild) {
        return Err(Finding::new(
            format!("`{text}` is not a topic filter"),
            "write levels joined by /, + for any level, # at the end for all below, not starting with $",
        ));
    }
    Ok(text.to_string())
}

/// An id of Sparkplug is a level of topics.
fn parse_sparkplug_id(text: &str) -> Result<String, Finding> {
    if text.is_empty() || text.contains(['/', '+', '#', '\0']) {
        return Err(Finding::new(
            format!("`{text}` cannot be an id of Sparkplug"),
            "write one level of a topic, without /, + and #",
        ));
    }
    if text == "STATE" {
        return Err(Finding::new(
            "`STATE` is reserved for the state of hosts",
            "write another id",
        ));
    }
    Ok(within_mqtt("the id", text, LONGEST_NAME)?.to_string())
}

fn parse_primary_host(text: &str) -> Result<String, Finding> {
    match text {
        "" => Ok(String::new()),
        id => parse_sparkplug_id(id),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broker_addresses() {
        let of = |text| parse_url(text).map(|b| (b.host, b.port, b.tls));
        assert_eq!(of("mqtt://broker"), Ok(("broker".into(), 1883, false)));
        assert_eq!(of("mqtts://broker/"), Ok(("broker".into(), 8883, true)));
        assert_eq!(of("mqtt://[::1]:1884"), Ok(("::1".into(), 1884, false)));
        for bad in [
            "",
            "broker",
            "tcp://b",
            "http://b:1",
            "mqtt://",
            "mqtt://b:x",
            "mqtt://b/topic",
        ] {
            assert!(of(bad).is_err(), "{bad}");
        }
        for url in ["mqtt://me:secret@b", "x://me:secret@b"] {
            let message = of(url).unwrap_err().to_string();
            assert!(!message.contains("secret"), "{message}");
        }
    }

    #[test]
    fn topics() {
        for good in ["drivegate", "plant/hall 2", "ä"] {
            assert!(parse_base(good).is_ok(), "{good}");
        }
        for bad in ["", "/a", "a/", "a//b", "a/+", "#", "$SYS"] {
            assert!(parse_base(bad).is_err(), "{bad}");
        }
    }
}
