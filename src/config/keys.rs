//! Every key of the configuration, once. The doc comment of a key is its meaning, in the schema and in
//! `docs/configuration.md` too; after its type come its form and what holds when it is absent.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use ipnet::IpNet;
use serde_json::{Value, json};

use super::key::{
    DURATION, Flag, Key, List, Name, Number, Own, Parsed, Present, Preset, SIZE, Text, Time, Words, table,
};
use super::log::{self, LogFormat};
use super::{bus, modbus_tcp, mqtt, values};
use crate::codec::Protocol;
use crate::codec::wire::Silence;
use crate::line::Rs485;
use crate::north::modbus_tcp::{Role, Uncached};
use crate::process_image::{Access, LeaseAction, OnShutdown};

/// Declares tables: for each a type with its keys as fields, a constant of it, its schema and its documentation.
macro_rules! keys {
    ($($(#[doc = $about:literal])+ $constant:ident: $table:ident {
        $($(#[doc = $meaning:literal])+ $key:ident: $type:ty = $form:expr, $kind:ident $($default:expr)?;)*
    })+) => {$(
        pub(super) struct $table {
            $(pub(super) $key: Key<$type>,)*
        }

        pub(super) const $constant: $table = $table {
            $($key: Key {
                name: stringify!($key),
                form: &$form,
                default: keys!(@ $kind $($default)?),
                meaning: concat!($($meaning),+),
            },)*
        };

        impl $table {
            /// The JSON Schema of the table.
            pub(super) fn schema() -> Value {
                let required = |default: &Preset| matches!(default, Preset::Required);
                table(concat!($($about),+), vec![
                    $((stringify!($key), required(&$constant.$key.default), $constant.$key.schema()),)*
                ])
            }
        }
    )+

        /// Each table by the name of its type, with its rows in the documentation.
        #[cfg(test)]
        pub(super) fn documentation() -> std::collections::BTreeMap<&'static str, Vec<[String; 4]>> {
            [$((stringify!($table), vec![$($constant.$key.row(),)*]),)+].into()
        }
    };
    (@ required) => { Preset::Required };
    (@ or $words:expr) => { Preset::Words($words) };
    (@ default $value:expr) => { Preset::Value(stringify!($value)) };
}

const MILLISECOND: Duration = Duration::from_millis(1);
const HOUR: Duration = Duration::from_secs(3600);
/// Range of cadences and timeouts.
const TIMES: Time = Time(MILLISECOND..=HOUR);
/// Range of `idle_timeout`.
pub(super) const IDLE: Time = Time(Duration::from_secs(1)..=Duration::from_secs(7 * 86_400));
/// Most that `frequency_range` may contain, Hz.
pub(super) const MOST_HERTZ: f64 = 10_000.0;
const BROADCAST: Option<(i64, &str)> = Some((0, "address 0 is the broadcast, not a drive"));
/// Addresses on a Modbus line.
pub(super) const MODBUS_ADDRESSES: Number = Number(1..=247, BROADCAST);
/// Addresses on a line of N2; each family has its own range within.
pub(super) const N2_ADDRESSES: Number = Number(1..=255, BROADCAST);
const CONNECTIONS: Number = Number(1..=10_000, None);
const PATH: Text = Text("", "a path in quotes");
const STRING: Text = Text("", "a string in quotes");

pub(super) const PROTOCOLS: Words<Protocol> = Words(&[
    (Protocol::ModbusRtu.name(), Protocol::ModbusRtu),
    (Protocol::ModbusAscii.name(), Protocol::ModbusAscii),
    (Protocol::N2.name(), Protocol::N2),
]);
/// The actions that are words.
pub(super) const ACTIONS: Words<LeaseAction> = Words(&[("stop", LeaseAction::Stop), ("hold", LeaseAction::Hold)]);
pub(super) const ROLES: Words<Role> = Words(&[("monitor", Role::Monitor), ("control", Role::Control)]);

const ADDRESSES: List<SocketAddr> = List {
    parse: values::socket,
    empty: Some("write for example [\"127.0.0.1:1502\"]"),
    range: "addresses with ports, such as [\"127.0.0.1:1502\"]",
};
const NETWORKS: List<IpNet> = List {
    parse: values::network,
    empty: None,
    range: "networks, such as [\"192.168.1.0/24\"]",
};
const BUSES: List<String> = List {
    parse: values::any_text,
    empty: Some("name a bus, or leave the key out for all"),
    range: "names of buses",
};

/// A list of tables with this schema.
fn each(item: Value) -> Value {
    json!({ "type": "array", "items": item })
}

fn number_pair(least: Option<f64>, most: Option<f64>) -> Value {
    let mut item = json!({ "type": "number" });
    for (name, bound) in [("minimum", least), ("maximum", most)] {
        if let (Value::Object(item), Some(bound)) = (&mut item, bound) {
            item.insert(name.into(), bound.into());
        }
    }
    json!({ "type": "array", "items": item, "minItems": 2, "maxItems": 2 })
}

keys! {
    /// Configuration of drivegate. Environment variables DRIVEGATE__SECTION__KEY override any key of it; relative
    /// paths are relative to the directory of the file.
    ROOT: Root {
        /// The gateway itself.
        gateway: Present = Own { schema: Gateway::schema, range: "[gateway]" }, required;
        /// Serial lines, or serial device servers, with their drives.
        bus: Present = Own { schema: || each(Bus::schema()), range: "[[bus]]" }, or "none";
        /// Modbus TCP server; not started without this section.
        modbus_tcp: Present = Own { schema: ModbusTcp::schema, range: "[modbus_tcp]" }, or "not started";
        /// MQTT client; not started without this section.
        mqtt: Present = Own { schema: Mqtt::schema, range: "[mqtt]" }, or "not started";
        /// HTTP server for metrics, health and the status page; not started without this section.
        http: Present = Own { schema: Http::schema, range: "[http]" }, or "not started";
        /// What is logged.
        log: Present = Own { schema: Log::schema, range: "[log]" }, or "the defaults";
    }

    /// The gateway itself.
    GATEWAY: Gateway {
        /// Name of the gateway, in MQTT topics and in the metric `drivegate_build_info`.
        name: String = Name("-"), required;
        /// Path of the local socket, mode 0660, by which `drivegate read` and `drivegate write` [reach the running
        /// gateway](commissioning.md#through-the-gateway); `""`: none. If it cannot be opened, a warning is logged and the
        /// gateway runs without it.
        socket: PathBuf = PATH, or "`drivegate.sock` in the runtime directory";
        /// Directories of your own [profiles](profiles.md), `*.toml`; a file with the name of a built-in profile
        /// replaces it.
        profile_dirs: Vec<PathBuf> = List { parse: values::path, empty: None, range: "directories" }, or "none";
    }

    /// One line with its drives.
    BUS: Bus {
        /// Name of the bus, unique; label of metrics, MQTT topic.
        name: String = Name("-_"), required;
        /// Serial port, best by its stable name under `/dev/serial/by-id`; or a device server that passes bytes through
        /// unchanged (raw serial over TCP, not Modbus TCP). A host name is resolved whenever the port is opened; while
        /// that fails, its last addresses are used. Each port belongs to one bus.
        port: String = Text("", "a path, or \"tcp://host:port\""), required;
        /// Protocol of the drives; a drive's profile must support it.
        protocol: Protocol = PROTOCOLS, default "modbus-rtu";
        /// Bits per second. N2 is always 9600 8N1; a rate that the profile does not list gives a warning.
        baud: u32 = Number(300..=4_000_000, None), default 9600;
        /// Data bits 7 or 8, parity `N`, `E` or `O`, stop bits 1 or 2, as set on the drives. Modbus RTU needs 8 data bits.
        /// Modbus ASCII usually has 7, so that a character has 10 bits: `"7N2"` (a TECO card with all switches off),
        /// `"7E1"`, `"7O1"`; devices with 8 exist.
        format: String = Text("^[78][NEOneo][12]$", "a format such as \"8N1\""),
            or "`\"8N1\"`; Modbus ASCII: `\"7N2\"`";
        /// What switches the direction of the line: `"off"` the adapter itself, as nearly all do; `"kernel"` the driver of
        /// the port, by RTS, high while sending; `"kernel-inverted"` low while sending.
        rs485: Rs485 = Words(&[
            ("off", Rs485::Off), ("kernel", Rs485::Kernel), ("kernel-inverted", Rs485::KernelInverted),
        ]), default "off";
        /// Cadence aimed at for process data (poll class fast). If the line cannot carry it, rounds follow one another
        /// without a pause; `check` warns beforehand.
        cycle: Duration = TIMES, default "10ms";
        /// Cadence aimed at for poll class slow: temperatures and the like.
        slow_cycle: Duration = TIMES, default "1s";
        /// Time for the first byte of a reply; wire time is added. N2: `"250ms"`.
        response_timeout: Duration = TIMES, default "100ms";
        /// Tries after the first before a drive counts as offline. N2: `2`.
        retries: u32 = Number(0..=10, None), default 1;
        /// Silence before each request. `"spec"`: 3.5 characters, fixed at 1.75 ms above 19200 baud, as in the Modbus
        /// specification. `"chars"`: 3.5 characters at any baud, which is faster at 38400 and above and more than most
        /// drives need. A duration: for drives that need more. Modbus ASCII frames need no silence between them; it is
        /// kept all the same, for drives that release the line late.
        silence: Silence = Parsed {
            parse: bus::parse_silence, words: &["spec", "chars"], pattern: DURATION,
            range: "\"spec\", \"chars\" or a duration up to \"1s\"",
        }, default "spec";
        /// The drives on the line.
        drive: Present = Own { schema: || each(Drive::schema()), range: "[[bus.drive]]" }, or "none";
    }

    /// One drive.
    DRIVE: Drive {
        /// Name of the drive, unique in the gateway; topics, labels.
        name: String = Name("-_"), required;
        /// Address on the line, unique on the bus; 247 at most on Modbus. The profile may allow fewer.
        address: u8 = N2_ADDRESSES, required;
        /// Family of the drive: its points and limits; `drivegate profiles` lists them.
        profile: String = Text("^[a-z][a-z0-9-]*$", "the name of a profile"), required;
        /// Modbus TCP unit id, unique on each listener of `[modbus_tcp]`. 255 is the gateway itself.
        unit: u8 = Number(1..=254, Some((255, "unit 255 is the gateway itself"))), or "the address";
        /// `"monitor"`: every write is refused. `"control"`: writes of clients that may write are passed on.
        access: Access = Words(&[("monitor", Access::Monitor), ("control", Access::Control)]), default "monitor";
        /// Limits of commands by point, in the point's unit, within the drive's own range. A value outside is refused,
        /// never clamped. Limits in percent also apply to commands in Hz and to raw writes, and the other way round.
        limits: Present = Own {
            schema: || json!({ "type": "object", "additionalProperties": number_pair(None, None) }),
            range: "{ point = [lowest, highest] }",
        }, or "none";
        /// Lease of the drive. Not a safety function.
        supervision: Present = Own { schema: Supervision::schema, range: "[bus.drive.supervision]" }, or "none";
        /// What is written when the gateway stops: nothing, or a stop. `check` reports how long the stops of a line take, and
        /// warns where that is longer than the systemd unit allows (`TimeoutStopSec=90s`, of which 10 s are for the
        /// rest). Nothing is ever written to a monitored drive: `check` warns of a stop there, and of `supervision`.
        on_shutdown: OnShutdown = Words(&[("hold", OnShutdown::Hold), ("stop", OnShutdown::Stop)]), default "hold";
        /// Time the drive takes to begin its reply, for the prediction of `check` only; the measured one is a metric.
        turnaround: Duration = Time(Duration::ZERO..=Duration::from_secs(1)), or "the profile's";
        /// Minimum and maximum frequency, used to convert `frequency_reference` when the drive's own cannot be read, or
        /// were not read [recently](commands.md#limits-and-frequencies).
        frequency_range: Present = Own {
            schema: || number_pair(Some(0.0), Some(MOST_HERTZ)),
            range: "[lowest, highest], Hz",
        }, or "none";
    }

    /// Lease of the drive: when it runs out while the drive runs, the action is taken once. Not a safety function.
    SUPERVISION: Supervision {
        /// Time after which the lease runs out. Every command that reaches the wire and every accepted heartbeat renews it.
        timeout: Duration = Time(Duration::from_millis(50)..=HOUR), required;
        /// What is done then, while the drive runs: `"stop"` stops it, `"hold"` only raises the event, `{ speed_reference =
        /// 20.0 }` (percent) writes this reference.
        action: Present = Own {
            schema: || json!({ "anyOf": [ { "enum": ["stop", "hold"] }, Reference::schema() ] }),
            range: "\"stop\", \"hold\" or { speed_reference = 20.0 }",
        }, default "stop";
        /// Whether a drive that runs when the gateway starts gets its lease started: the clock only, nothing is written;
        /// see [leases](commands.md#leases).
        adopt: bool = Flag, default false;
    }

    /// Write this speed reference.
    REFERENCE: Reference {
        /// Speed reference in percent.
        speed_reference: Present = Own { schema: || json!({ "type": "number" }), range: "a number" }, required;
    }

    /// Modbus TCP server; not started without this section.
    MODBUS_TCP: ModbusTcp {
        /// Where clients connect. Port 502 needs a privilege that the service does not have. With a `listener` or `tls`
        /// section and without this key there is no listener here.
        listen: Vec<SocketAddr> = ADDRESSES, or "`[\"127.0.0.1:1502\"]`";
        /// Who may connect.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8", "::1/128"];
        /// Who may write. Modbus TCP has no passwords: keep it narrow, or use TLS.
        write: Vec<IpNet> = NETWORKS, default [];
        /// Connections at one time, of all listeners together. The daemon raises its own limit of open files as far as it
        /// may, and warns.
        max_connections: usize = CONNECTIONS, default 64;
        /// Connections at one time from one address.
        max_connections_per_address: usize = CONNECTIONS, or "none";
        /// A connection without a request for this time is closed. A peer that vanished is detected by keepalive after
        /// 90 s in any case.
        idle_timeout: Option<Duration> = Parsed {
            parse: modbus_tcp::parse_idle, words: &["off"], pattern: DURATION,
            range: "\"off\", or \"1s\" to \"168h\"",
        }, default "1h";
        /// Raw reads of registers that are not polled: forwarded to the drive, or refused with exception 02.
        uncached: Uncached = Words(&[("forward", Uncached::Forward), ("refuse", Uncached::Refuse)]), default "forward";
        /// Older samples of process data are stale, on every side of the gateway; see [stale](#stale). Where it is not
        /// written, it is three rounds on a bus that is slower.
        stale_after: Duration = TIMES, default "1s";
        /// Listeners with their own rights and their own choice of buses.
        listener: Present = Own { schema: || each(Listener::schema()), range: "[[modbus_tcp.listener]]" }, or "none";
        /// Listener with TLS.
        tls: Present = Own { schema: Tls::schema, range: "[modbus_tcp.tls]" }, or "none";
    }

    /// A listener of its own.
    LISTENER: Listener {
        /// Where clients connect.
        listen: Vec<SocketAddr> = ADDRESSES, required;
        /// Who may connect.
        allow: Vec<IpNet> = NETWORKS, or "that of `[modbus_tcp]`";
        /// Who may write.
        write: Vec<IpNet> = NETWORKS, or "that of `[modbus_tcp]`";
        /// Buses whose drives are shown; any other unit is answered with exception 0x0A.
        buses: Vec<String> = BUSES, or "all";
    }

    /// Modbus/TCP Security: TLS in which the clients present certificates.
    TLS: Tls {
        /// Where clients connect. Ports below 1024 need a privilege that the service does not have.
        listen: Vec<SocketAddr> = ADDRESSES, default ["127.0.0.1:802"];
        /// Who may connect.
        allow: Vec<IpNet> = NETWORKS, or "that of `[modbus_tcp]`";
        /// Buses whose drives are shown.
        buses: Vec<String> = BUSES, or "all";
        /// PEM file of the server's certificate, with those between it and its CA.
        certificate: PathBuf = PATH, required;
        /// PEM file of the certificate's private key.
        key: PathBuf = PATH, required;
        /// PEM file of the CA (or several) whose clients are let in.
        client_ca: PathBuf = PATH, required;
        /// What the roles in client certificates may do; no role and any other role may read.
        roles: Present = Own {
            schema: || {
                let words: Vec<&str> = ROLES.0.iter().map(|(word, _)| *word).collect();
                json!({ "type": "object", "additionalProperties": { "enum": words } })
            },
            range: "{ role = \"control\" } or \"monitor\"",
        }, or "none";
    }

    /// MQTT client; not started without this section.
    MQTT: Mqtt {
        /// The broker; `mqtts` is TLS, its port 8883 unless given.
        url: mqtt::Broker = Parsed {
            parse: mqtt::parse_url, words: &[], pattern: "^mqtts?://",
            range: "\"mqtt://host[:port]\" or \"mqtts://host[:port]\"",
        }, default "mqtt://127.0.0.1:1883";
        /// Client id, unique at the broker.
        client_id: String = Parsed { parse: mqtt::parse_client_id, words: &[], pattern: "", range: "a string in quotes" },
            or "`drivegate-` and the gateway's name";
        /// User at the broker.
        username: String = STRING, or "none";
        /// Password of the user; `password_file` is better.
        password: String = STRING, or "none";
        /// File whose only line is the password: a systemd credential, a container secret.
        password_file: PathBuf = PATH, or "none";
        /// PEM file of the CA certificates that the broker's certificate is checked against.
        ca: PathBuf = PATH, or "the system's";
        /// PEM file of the client certificate; needs `key`.
        certificate: PathBuf = PATH, or "none";
        /// PEM file of the client certificate's private key.
        key: PathBuf = PATH, or "none";
        /// First levels of all topics.
        base: String = Parsed {
            parse: mqtt::parse_base, words: &[], pattern: "", range: "a topic without + and #",
        }, default "drivegate";
        /// How often values are published.
        publish: Present = Own { schema: Publish::schema, range: "[mqtt.publish]" }, or "the defaults";
        /// Whether the set topics are served, for drives with `access = "control"`. Whoever may publish there commands the
        /// drives: restrict it at the broker.
        commands: bool = Flag, default false;
        /// Where events are kept while the broker is away.
        buffer: Present = Own { schema: Buffer::schema, range: "[mqtt.buffer]" }, or "in memory only";
        /// Discovery for Home Assistant, which this version does not serve.
        home_assistant: Present = Own { schema: || json!({ "const": false }), range: "false" }, default false;
    }

    /// How often values are published.
    PUBLISH: Publish {
        /// Least time between two messages of a topic.
        min_interval: Duration = Time(Duration::ZERO..=HOUR), default "100ms";
        /// A value is published again after this time even if it did not change.
        max_interval: Duration = Time(Duration::from_millis(10)..=Duration::from_secs(86_400)), default "60s";
    }

    /// Where events are kept while the broker is away; in memory only without this table.
    BUFFER: Buffer {
        /// Directory.
        dir: PathBuf = PATH, default "/var/lib/drivegate";
        /// Most bytes on disk; the oldest events are dropped first.
        max_bytes: u64 = Parsed {
            parse: mqtt::parse_buffer_size, words: &[], pattern: SIZE, range: "\"64KiB\" to \"1024GiB\"",
        }, default "64MiB";
    }

    /// HTTP server for metrics, health and the status page; not started without this section.
    HTTP: Http {
        /// Status page, metrics, health and JSON interface. Nothing can be written here, but there is no access control
        /// either: to let others in, put a reverse proxy in front of it or a firewall around it.
        listen: SocketAddr = Parsed {
            parse: values::socket, words: &[], pattern: "", range: "an address with a port",
        }, default "127.0.0.1:9488";
    }

    /// What is logged.
    LOG: Log {
        /// Level, also per target: `"info,drivegate::bus=debug"` logs more of the buses. Every command is logged under
        /// target `audit`, at `"warn"` and `"error"` too; only `"off"` and `audit=off` end that.
        level: String = Parsed {
            parse: log::parse_level, words: &[], pattern: log::PATTERN,
            range: "\"off\", \"error\", \"warn\", \"info\", \"debug\" or \"trace\"",
        }, default "info";
        /// `"auto"`: for the journal under systemd, coloured text on a terminal, else one JSON object per line.
        format: LogFormat = Words(&[
            ("auto", LogFormat::Auto), ("journal", LogFormat::Journal), ("text", LogFormat::Text),
            ("json", LogFormat::Json),
        ]), default "auto";
    }
}

/// JSON Schema of the configuration, draft 2020-12, for editors.
pub(crate) fn schema() -> Value {
    let mut root = Root::schema();
    if let Value::Object(root) = &mut root {
        root.insert("$schema".into(), "https://json-schema.org/draft/2020-12/schema".into());
        root.insert("title".into(), "drivegate".into());
    }
    root
}
