//! Every key of the configuration, once. The doc comment of a key is its meaning, in the schema and in
//! `docs/configuration.md` too; after its type come its form and what holds when it is absent.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use ipnet::IpNet;
use serde_json::{Value, json};

use super::capped::Capped;
use super::key::{
    DURATION, Figure, Flag, Key, List, Name, Number, Own, Parsed, Present, Preset, SIZE, Text, Time, Words, table,
};
use super::log::{self, LogFormat};
use super::mqtt::TelemetryTopic;
use super::{authority, bacnet, bus, http, modbus_tcp, mqtt, recordings, values};
use crate::bus::Mode;
use crate::codec::Protocol;
use crate::codec::wire::Silence;
use crate::document::format_duration;
use crate::line::{Level, MOST_RTS_DELAY, Rs485, Spin};
use crate::north::bacnet::WhenOffline;
use crate::north::modbus_tcp::{Role, Uncached};
use crate::north::mqtt::History;
use crate::north::slot::SlotAccess;
use crate::process_image::{Access, LeaseAction, OnShutdown, ParamsAccess};
use crate::start_guard::MOST_STARTS;

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
                name: key_name(stringify!($key)),
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
                    $((key_name(stringify!($key)), required(&$constant.$key.default), $constant.$key.schema()),)*
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
    (@ by_protocol $default:expr) => { Preset::ByProtocol($default) };
    (@ or $words:expr) => { Preset::Words($words) };
    (@ default $value:expr) => { Preset::Value(stringify!($value)) };
}

/// The name of a key whose field is a keyword of Rust is written as `r#name`.
const fn key_name(field: &'static str) -> &'static str {
    match field.as_bytes() {
        [b'r', b'#', ..] => field.split_at(2).1,
        _ => field,
    }
}

const MILLISECOND: Duration = Duration::from_millis(1);
const HOUR: Duration = Duration::from_secs(3600);
/// Ten years.
const LONGEST_EVERY: Duration = Duration::from_secs(10 * 8760 * 3600);
/// Range of cadences and timeouts.
const TIMES: Time = Time(MILLISECOND..=HOUR);
/// `response_timeout`: an hour was allowed before. A master that waits so long for an absent drive serves no other
/// drive.
pub(super) const RESPONSE_TIMEOUT: Capped = Capped {
    range: MILLISECOND..=Duration::from_secs(5),
    before: HOUR,
    why: "is longer than any drive takes to start its reply",
    until: "0.2",
};
/// Range of the delays of RS-485 by the kernel, in whole milliseconds.
const RTS_DELAYS: Time = Time(Duration::ZERO..=MOST_RTS_DELAY);
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
const SOCKET: Parsed<SocketAddr> = Parsed {
    parse: values::socket,
    words: &[],
    pattern: "",
    range: "an address with a port",
};
const PATH: Text = Text("", "a path in quotes");
const STRING: Text = Text("", "a string in quotes");

pub(super) const PROTOCOLS: Words<Protocol> = Words(&[
    (Protocol::ModbusRtu.name(), Protocol::ModbusRtu),
    (Protocol::ModbusAscii.name(), Protocol::ModbusAscii),
    (Protocol::N2.name(), Protocol::N2),
]);
/// Levels of RTS and DTR.
const LEVELS: Words<Level> = Words(&[("driver", Level::Driver), ("on", Level::On), ("off", Level::Off)]);
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

const SPARKPLUG_ID: Parsed<String> = Parsed {
    parse: mqtt::parse_sparkplug_id,
    words: &[],
    pattern: "^[^/+#]+$",
    range: "an id without /, + and #",
};

const HOSTS: List<String> = List {
    parse: http::parse_host,
    empty: None,
    range: "host names or addresses, such as [\"gateway.example.com\"]",
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
        /// BACnet/IP server; not started without this section.
        bacnet: Present = Own { schema: Bacnet::schema, range: "[bacnet]" }, or "not started";
        /// Who holds a drive; off without this section.
        authority: Present = Own { schema: AuthorityTable::schema, range: "[authority]" }, or "off";
        /// How stops are proven; not possible without this section.
        drill: Present = Own { schema: DrillTable::schema, range: "[drill]" }, or "off";
        /// File of all commands; not written without this section.
        audit: Present = Own { schema: AuditTable::schema, range: "[audit]" }, or "not written";
        /// What the recorder keeps.
        recordings: Present = Own { schema: Recordings::schema, range: "[recordings]" }, or "the defaults";
        /// When parameters are read by themselves, and what they are called.
        params: Present = Own { schema: Params::schema, range: "[params]" }, or "only on request";
        /// What is logged.
        log: Present = Own { schema: Log::schema, range: "[log]" }, or "the defaults";
    }

    /// The gateway itself.
    GATEWAY: Gateway {
        /// Name of the gateway, used in MQTT topics and in the metric `drivegate_build_info`.
        name: String = Name("-"), required;
        /// Path of the local socket, mode 0660, for `drivegate read`, `write`, `reload` and `health` to [reach the
        /// running gateway](commissioning.md#through-the-gateway); `""`: none.
        socket: PathBuf = PATH, or "`drivegate.sock` in the runtime directory";
        /// Directory for stored data: [recordings](history.md#recordings), [events, run hours and starts](history.md),
        /// [parameters](parameters.md), and the [audit file](commands.md#the-audit-file).
        state_dir: PathBuf = PATH, or "the state directory of the systemd unit, else `/var/lib/drivegate`";
        /// Directories with custom [profiles](profiles.md), `*.toml`; one with the name of a built-in profile replaces
        /// it.
        profile_dirs: Vec<PathBuf> = List { parse: values::path, empty: None, range: "directories" }, or "none";
    }

    /// One line with its drives.
    BUS: Bus {
        /// Name of the bus, unique; metric label, MQTT topic.
        name: String = Name("-_"), required;
        /// Serial port, preferably by its name under `/dev/serial/by-id`; or a device server that passes bytes through
        /// (`tcp://`: raw serial over TCP, not Modbus TCP), or one whose port drivegate sets up with `baud` and
        /// `format` (`rfc2217://`). Each port belongs to one bus.
        port: String = Text("", "a path, \"tcp://host:port\" or \"rfc2217://host:port\""), required;
        /// `"listen"`: another master owns the line; the gateway sends nothing and shows what that master reads, see
        /// [Listening](troubleshooting.md#listening-to-a-line-that-another-master-owns). Its drives cannot have `access
        /// = "control"`, `supervision` or `on_shutdown = "stop"`.
        mode: Mode = Words(&[("master", Mode::Master), ("listen", Mode::Listen)]), default "master";
        /// Protocol of the drives; every drive's profile must support it.
        protocol: Protocol = PROTOCOLS, default "modbus-rtu";
        /// Bits per second. N2 always uses 9600 8N1; a rate that the profile does not list causes a warning.
        baud: u32 = Number(300..=4_000_000, None), default 9600;
        /// Data bits 7 or 8, parity `N`, `E` or `O`, stop bits 1 or 2, as set on the drives. Modbus RTU needs 8 data
        /// bits; Modbus ASCII usually has 7 (`"7N2"`: a TECO card with all switches off). A format that the profile
        /// does not list causes a warning.
        format: String = Text("^[78][NEOneo][12]$", "a format such as \"8N1\""),
            by_protocol |protocol| format!("\"{}\"", bus::default_format(protocol));
        /// What switches the direction of the line: the adapter itself, as nearly all do (`"off"`), or the port driver
        /// with RTS high (`"kernel"`) or low (`"kernel-inverted"`) while sending.
        rs485: Rs485 = Words(&[
            ("off", Rs485::Off), ("kernel", Rs485::Kernel), ("kernel-inverted", Rs485::KernelInverted),
        ]), default "off";
        /// With `rs485 = "kernel"`: time between switching to sending and the first bit, in whole milliseconds.
        /// Settings that the driver does not accept, of this and the next three keys, are logged when the port is
        /// opened.
        rts_before_send: Duration = RTS_DELAYS, default "0ms";
        /// With `rs485 = "kernel"`: time between the last bit and switching back; a reply that starts earlier is lost.
        rts_after_send: Duration = RTS_DELAYS, default "0ms";
        /// With `rs485 = "kernel"`: whether the port receives what it sends. Only for drivers that otherwise receive
        /// nothing.
        rx_during_tx: bool = Flag, default false;
        /// With `rs485 = "kernel"`: whether the driver switches on the board's terminating resistor.
        termination: bool = Flag, default false;
        /// Level of RTS, for adapters that are powered or enabled by it; also with `rfc2217://`. `"driver"`: on, as Linux leaves
        /// it. Not with `rs485 = "kernel"`.
        rts: Level = LEVELS, default "driver";
        /// Level of DTR, likewise.
        dtr: Level = LEVELS, default "driver";
        /// Whether the end of a short wait is spent watching the clock, so that requests leave on time. `"auto"`: with
        /// more than one processor. `"off"` saves processor time on small boxes; requests leave up to 0.1 ms later.
        spin: Spin = Words(&[("auto", Spin::Auto), ("on", Spin::On), ("off", Spin::Off)]), default "auto";
        /// Target poll cycle of process data (poll class fast). If the line cannot carry it, cycles follow one another
        /// without a pause.
        cycle: Duration = TIMES, default "10ms";
        /// Target poll cycle of class slow. A motor speed that is slow in its profile is read every `cycle` if the line
        /// has time for it (`fast_if_carried`).
        slow_cycle: Duration = TIMES, default "1s";
        /// Time a drive may take to start its reply; the time on the wire is added. Each attempt to reach an absent
        /// drive takes the line for that time.
        response_timeout: Duration = RESPONSE_TIMEOUT,
            by_protocol |protocol| format!("\"{}\"", format_duration(protocol.usual_timeout()));
        /// Retries after the first attempt before a drive counts as offline.
        retries: u32 = Number(0..=10, None), by_protocol |protocol| bus::default_retries(protocol).to_string();
        /// Silence before each request. `"spec"`: 3.5 characters, fixed at 1.75 ms above 19200 baud, as in the Modbus
        /// specification. `"chars"`: 3.5 characters at any baud rate, which is faster at 38400 and above and enough for
        /// most drives. A duration: for drives that need more. N2: `"5ms"`.
        silence: Silence = Parsed {
            parse: bus::parse_silence, words: &["spec", "chars"], pattern: DURATION,
            range: "\"spec\", \"chars\" or a duration up to \"1s\"",
        }, default "spec";
        /// The drives on the line.
        drive: Present = Own { schema: || each(Drive::schema()), range: "[[bus.drive]]" }, or "none";
        /// Access to the line for vendors' tools, see [Tool slot](tool-slot.md).
        slot: Present = Own { schema: || each(SlotTable::schema()), range: "[[bus.slot]]" }, or "none";
    }

    /// A slot for vendors' tools: a program that speaks the protocol of the line, as if it were alone on it.
    SLOT: SlotTable {
        /// Address for the bare frames of the line: Modbus RTU or ASCII over TCP (not Modbus TCP), or N2.
        listen: SocketAddr = SOCKET, or "none";
        /// Address of a COM port by RFC 2217, for programs on Windows behind a COM port redirector.
        rfc2217: SocketAddr = SOCKET, or "none";
        /// Path of a serial port (a link to a pseudo-terminal, mode 0660) that a program on this machine opens.
        pty: PathBuf = PATH, or "none";
        /// `"read"`: every request that may write is refused. `"write"`: writes are passed on like those of a Modbus
        /// TCP client that may write. `"raw"`: also what cannot be checked: broadcasts, functions that drivegate does
        /// not decode, writes to addresses without a configured drive.
        access: SlotAccess = Words(&[
            ("read", SlotAccess::Read), ("write", SlotAccess::Write), ("raw", SlotAccess::Raw),
        ]), default "read";
        /// Who may connect to `listen` and `rfc2217`.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8", "::1/128"];
        /// A connection without a request for this time is closed.
        idle_timeout: Option<Duration> = Parsed {
            parse: modbus_tcp::parse_idle, words: &["off"], pattern: DURATION,
            range: "\"off\", or \"1s\" to \"168h\"",
        }, default "10min";
    }

    /// One drive.
    DRIVE: Drive {
        /// Name of the drive, unique in the gateway; used in topics and labels.
        name: String = Name("-_"), required;
        /// Address on the line, unique on the bus; 247 at most on Modbus. The profile may allow fewer.
        address: u8 = N2_ADDRESSES, required;
        /// Family of the drive: its points and limits; `drivegate profiles` lists them.
        profile: String = Text("^[a-z][a-z0-9-]*$", "the name of a profile"), required;
        /// Modbus TCP unit id, unique on each listener of `[modbus_tcp]`. 255 is the gateway itself.
        unit: u8 = Number(1..=254, Some((255, "unit 255 is the gateway itself"))), or "the address";
        /// Drives that [stop all](commands.md#stop-all) can stop together, and that share a [`stagger`](commands.md#guards).
        group: String = Name("-_"), or "none";
        /// `"monitor"`: every write is refused. `"control"`: writes by authorised clients are passed on.
        access: Access = Words(&[("monitor", Access::Monitor), ("control", Access::Control)]), default "monitor";
        /// Limits for written values by point, in the point's unit, within the drive's own range. A value outside is
        /// refused, never clamped. Limits in percent also apply to commands in Hz and to raw writes, and vice versa.
        limits: Present = Own {
            schema: || json!({ "type": "object", "additionalProperties": number_pair(None, None) }),
            range: "{ point = [lowest, highest] }",
        }, or "none";
        /// Lease of the drive. Not a safety function.
        supervision: Present = Own { schema: Supervision::schema, range: "[bus.drive.supervision]" }, or "none";
        /// How often and how soon the motor may be [started](commands.md#guards).
        guard: Present = Own { schema: GuardTable::schema, range: "[bus.drive.guard]" }, or "none";
        /// Conditions for [starting](commands.md#interlocks) the motor.(commands.md#interlocks).
        interlocks: Present = Own { schema: || each(InterlockTable::schema()), range: "[[bus.drive.interlocks]]" }, or "none";
        /// What is written at [shutdown](commands.md#shutdown): nothing, or a stop. Nothing is ever written to a
        /// monitored drive.
        on_shutdown: OnShutdown = Words(&[("hold", OnShutdown::Hold), ("stop", OnShutdown::Stop)]), default "hold";
        /// Time the drive takes to start its reply, used only for the prediction of `check`; the measured value is a
        /// metric.
        turnaround: Duration = Time(Duration::ZERO..=Duration::from_secs(1)), or "the profile's";
        /// Minimum and maximum frequency, used to convert `frequency_reference` if the drive's own cannot be read, or
        /// were not read [recently](commands.md#limits-and-frequencies).
        frequency_range: Present = Own {
            schema: || number_pair(Some(0.0), Some(MOST_HERTZ)),
            range: "[lowest, highest], Hz",
        }, or "none";
        /// What [raw writes](modbus-tcp.md#what-raw-writes-may-set) may set in addition to the registers of writable
        /// points: nothing, everything that the profile allows (`true`), or ranges of PDU addresses, for registers and
        /// coils alike.
        raw_writes: Present = Own {
            schema: || json!({ "anyOf": [{ "type": "boolean" }, { "type": "array", "items": {
                "type": "array", "items": { "type": "integer", "minimum": 0, "maximum": u16::MAX },
                "minItems": 2, "maxItems": 2,
            } }] }),
            range: "true, false or ranges of PDU addresses such as [[101, 199]]",
        }, or "`false`";
        /// What may be done with its [parameters](parameters.md#restoring): `"read"`, or `"write"`: they may also be
        /// restored, which needs `access = "control"`.
        params: ParamsAccess = Words(&[("read", ParamsAccess::Read), ("write", ParamsAccess::Write)]), default "read";
        /// Values that trigger a [recording](history.md#recordings), in addition to faults.
        trigger: Present = Own { schema: || each(Trigger::schema()), range: "[[bus.drive.trigger]]" }, or "none";
    }

    /// A value that makes a recording: `above` or `below` a limit, for a time.
    TRIGGER: Trigger {
        /// A polled numeric point of the drive.
        point: String = Text("^[a-z][a-z0-9_]*$", "the name of a point"), required;
        /// The value must be above this, in the point's unit.
        above: f64 = Figure, or "none";
        /// The value must be below this, in the point's unit.
        below: f64 = Figure, or "none";
        /// For how long without interruption.
        r#for: Duration = Time(Duration::ZERO..=HOUR), default "0s";
    }

    /// Lease of the drive: if it expires while the drive runs, the action is executed once. Not a safety function.
    SUPERVISION: Supervision {
        /// Time after which the lease expires. Every command sent on the line and every accepted heartbeat renews it.
        timeout: Duration = Time(Duration::from_millis(50)..=HOUR), required;
        /// Action then, if the drive runs: `"stop"` stops it, `"hold"` only raises the event,
        /// `{ speed_reference = 20.0 }` (percent) writes this reference.
        action: Present = Own {
            schema: || json!({ "anyOf": [ { "enum": ["stop", "hold"] }, Reference::schema() ] }),
            range: "\"stop\", \"hold\" or { speed_reference = 20.0 }",
        }, default "stop";
        /// Whether a drive that is running when the gateway starts gets its [lease](commands.md#leases) immediately;
        /// nothing is written.
        adopt: bool = Flag, default false;
    }

    /// Guard of the motor: starts that come too often or too soon are refused.
    GUARD: GuardTable {
        /// Maximum starts within any hour.
        starts_per_hour: u32 = Number(1..=MOST_STARTS as i64, None), or "any number";
        /// Time the motor must be stopped before a start.
        min_off: Duration = Time(Duration::ZERO..=HOUR), default "0s";
        /// Time the motor must run before an [ordinary stop](commands.md#guards).
        min_run: Duration = Time(Duration::ZERO..=HOUR), default "0s";
        /// Time between two starts in the same `group`; without `group`, on the same bus.
        stagger: Duration = Time(Duration::ZERO..=HOUR), default "0s";
    }

    /// Interlock of the motor: a point of another drive that must hold before a start.
    INTERLOCK: InterlockTable {
        /// Name of the other drive.
        drive: String = Name("-_"), required;
        /// A polled boolean point of it. If it is not good, the interlock is not satisfied.
        point: String = Text("^[a-z][a-z0-9_]*$", "the name of a point"), required;
        /// Required value of the point.
        is: bool = Flag, default true;
        /// Whether the running motor is stopped when the interlock is no longer satisfied.
        trip: bool = Flag, default false;
    }

    /// Speed reference to write.
    REFERENCE: Reference {
        /// Speed reference in percent.
        speed_reference: Present = Own { schema: || json!({ "type": "number" }), range: "a number" }, required;
    }

    /// Modbus TCP server; not started without this section.
    MODBUS_TCP: ModbusTcp {
        /// Listen addresses. Port 502 needs [a privilege](installation.md#port-502). Without this key, no listener is
        /// opened here if there is a `listener` or `tls` section.
        listen: Vec<SocketAddr> = ADDRESSES, or "`[\"127.0.0.1:1502\"]`";
        /// Who may connect.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8", "::1/128"];
        /// Who may write; no one by default. Modbus TCP has no passwords: keep it narrow, or use TLS.
        write: Vec<IpNet> = NETWORKS, default [];
        /// Concurrent connections, over all listeners; an eighth of them reserved for clients that may write. If the
        /// system does not permit enough open files, fewer are served, with a warning.
        max_connections: usize = CONNECTIONS, default 64;
        /// Concurrent connections from one address. Clients behind one NAT or proxy share an address.
        max_connections_per_address: usize = CONNECTIONS, default 16;
        /// A connection without a request for this time is closed.
        idle_timeout: Option<Duration> = Parsed {
            parse: modbus_tcp::parse_idle, words: &["off"], pattern: DURATION,
            range: "\"off\", or \"1s\" to \"168h\"",
        }, default "1h";
        /// Raw reads of registers that are not polled: forwarded to the drive, or refused with exception 02.
        uncached: Uncached = Words(&[("forward", Uncached::Forward), ("refuse", Uncached::Refuse)]), default "forward";
        /// Older samples of process data are [stale](#stale), on every interface. If not set, it is three cycles on a
        /// slower bus; if set, it applies to every bus.
        stale_after: Duration = TIMES, default "1s";
        /// Listeners with separate permissions and buses.
        listener: Present = Own { schema: || each(Listener::schema()), range: "[[modbus_tcp.listener]]" }, or "none";
        /// Listener with TLS.
        tls: Present = Own { schema: Tls::schema, range: "[modbus_tcp.tls]" }, or "none";
    }

    /// A listener of its own.
    LISTENER: Listener {
        /// Listen addresses.
        listen: Vec<SocketAddr> = ADDRESSES, required;
        /// Who may connect.
        allow: Vec<IpNet> = NETWORKS, or "that of `[modbus_tcp]`";
        /// Who may write.
        write: Vec<IpNet> = NETWORKS, or "that of `[modbus_tcp]`";
        /// Buses whose drives are served; any other unit gets exception 0x0A.
        buses: Vec<String> = BUSES, or "all";
    }

    /// Modbus/TCP Security: TLS in which the clients present certificates.
    TLS: Tls {
        /// Listen addresses. Ports below 1024 need [a privilege](installation.md#port-502).
        listen: Vec<SocketAddr> = ADDRESSES, default ["127.0.0.1:802"];
        /// Who may connect.
        allow: Vec<IpNet> = NETWORKS, or "that of `[modbus_tcp]`";
        /// Buses whose drives are served.
        buses: Vec<String> = BUSES, or "all";
        /// PEM file with the server's certificate chain: its certificate and the intermediate ones.
        certificate: PathBuf = PATH, required;
        /// PEM file of the certificate's private key.
        key: PathBuf = PATH, required;
        /// PEM file with one or more CAs whose client certificates are accepted.
        client_ca: PathBuf = PATH, required;
        /// PEM or DER file with the [certificate revocation lists](modbus-tcp.md#revocation) of the CAs in `client_ca`.
        /// Each CA needs a list; one that is out of date stays in force, with a warning.
        client_crl: PathBuf = PATH, or "none";
        /// Permissions of the roles in client certificates; clients without a role or with any other role may only
        /// read.
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
        /// The broker; `mqtts` uses TLS, default port 8883.
        url: mqtt::Broker = Parsed {
            parse: mqtt::parse_url, words: &[], pattern: "^mqtts?://",
            range: "\"mqtt://host[:port]\" or \"mqtts://host[:port]\"",
        }, default "mqtt://127.0.0.1:1883";
        /// [Further brokers](mqtt.md#several-brokers), tried in order after `url`; with its credentials, all `mqtts://` or none.
        urls: Vec<mqtt::Broker> = List {
            parse: mqtt::parse_url, empty: None, range: "addresses such as [\"mqtt://broker-2:1883\"]",
        }, default [];
        /// Client id, unique on the broker.
        client_id: String = Parsed { parse: mqtt::parse_client_id, words: &[], pattern: "", range: "a string in quotes" },
            or "`drivegate-` and the gateway's name";
        /// User name on the broker.
        username: String = Parsed { parse: mqtt::parse_username, words: &[], pattern: "", range: "a string in quotes" }, or "none";
        /// Password of the user; `password_file` is better.
        password: String = STRING, or "none";
        /// File whose only line is the password, such as a systemd credential or a container secret.
        password_file: PathBuf = PATH, or "none";
        /// PEM file with the CA certificates used to verify the broker's certificate.
        ca: PathBuf = PATH, or "the system's";
        /// PEM file of the client certificate; needs `key`.
        certificate: PathBuf = PATH, or "none";
        /// PEM file of the client certificate's private key.
        key: PathBuf = PATH, or "none";
        /// Prefix of all topics.
        base: String = Parsed {
            parse: mqtt::parse_base, words: &[], pattern: "", range: "a topic without + and #",
        }, default "drivegate";
        /// Which telemetry is published: the state of each drive as one object, each point as a bare value, or both.
        topics: Vec<TelemetryTopic> = List {
            parse: mqtt::parse_topic, empty: Some("write [\"state\"], [\"points\"] or both"),
            range: "[\"state\", \"points\"] or one of them",
        }, default ["state", "points"];
        /// Quality of service of published messages.
        qos: Present = Own { schema: MqttQos::schema, range: "[mqtt.qos]" }, or "the defaults";
        /// The broker drops telemetry that is older (message expiry); `"0s"`: never.
        expiry: Duration = Time(Duration::ZERO..=Duration::from_secs(365 * 86_400)), default "5min";
        /// The broker drops `online`, and telemetry at the latest, after this time; renewed after half of it; `"0s"`:
        /// never.
        message_expiry: Duration = Time(Duration::ZERO..=Duration::from_secs(365 * 86_400)), default "10min";
        /// Values of an outage that are published afterwards, on `history` topics: those that changed, or all samples.
        history: History = Words(&[
            ("off", History::Off), ("changes", History::Changes), ("all", History::All),
        ]), default "off";
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
            parse: mqtt::parse_filter, empty: None, range: "topic filters, such as [\"drivegate/answers/#\"]",
        }, default [];
        /// Where events and history are buffered while the broker is unreachable.
        buffer: Present = Own { schema: Buffer::schema, range: "[mqtt.buffer]" }, or "in memory only";
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
            parse: mqtt::parse_base, words: &[], pattern: "", range: "a topic without + and #",
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

    /// Where events and history are buffered while the broker is unreachable; without this table, in memory only.
    BUFFER: Buffer {
        /// Directory of the buffer.
        dir: PathBuf = PATH, default "/var/lib/drivegate";
        /// Maximum size on disk; beyond it the oldest events are dropped.
        max_bytes: u64 = Parsed {
            parse: mqtt::parse_buffer_size, words: &[], pattern: SIZE, range: "\"64KiB\" to \"1024GiB\"",
        }, default "64MiB";
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
            parse: mqtt::parse_primary_host, words: &[], pattern: "^[^/+#]*$", range: "an id without /, + and #, or \"\"",
        }, default "";
        /// Whether data messages name their metrics by aliases, which are shorter.
        alias: bool = Flag, default true;
        /// Whether values of an outage are published afterwards, as historical.
        history: bool = Flag, default true;
    }

    /// HTTP server for metrics, health and the status page; not started without this section.
    HTTP: Http {
        /// Status page, metrics, health and JSON interface. Read-only without `commands`; open to everyone who can connect
        /// unless there is a `tokens_file`.
        listen: SocketAddr = SOCKET, default "127.0.0.1:9488";
        /// Names and addresses, without a port, by which the server is reached in addition to `localhost`, the host
        /// name of this machine and its own addresses. Requests for any other [host](http.md#hosts) get 421.
        hosts: Vec<String> = HOSTS, default [];
        /// File of access [tokens](http.md#tokens), made by `drivegate token add`. With it, all paths except `/healthz`
        /// and `/readyz` require a token.
        tokens_file: PathBuf = PATH, or "none";
        /// Whether [users](commands.md#over-http) may command drives with `access = "control"`. Needs `users_file`, and
        /// `certificate` or a `listen` on the loopback.
        commands: bool = Flag, default false;
        /// File of the users who may command, made by `drivegate user add`.
        users_file: PathBuf = PATH, or "none";
        /// PEM file with the server's certificate chain, for [https](http.md#tls); needs `key`.
        certificate: PathBuf = PATH, or "none";
        /// PEM file of the certificate's private key.
        key: PathBuf = PATH, or "none";
    }

    /// [BACnet/IP](bacnet.md) server; not started without this section. The gateway is device `device`, each drive device `device`
    /// + `unit` on a virtual network of its own.
    BACNET: Bacnet {
        /// Listen address: that of one interface, whose broadcast address is used, or `0.0.0.0`, which needs `allow`.
        listen: SocketAddr = SOCKET, default "127.0.0.1:47808";
        /// Device instance of the gateway; it and those of all drives must be unique in the whole BACnet network.
        device: u32 = Number(0..=4_194_302, None), default 100;
        /// Number of the virtual network of the drives, unique in the whole BACnet network.
        network: u16 = Number(1..=65_534, Some((65_535, "network 65535 means all networks"))), default 1001;
        /// An offline drive: `"silent"`: does not answer; `"fault"`: answers with the flag fault.
        offline: WhenOffline = Words(&[("silent", WhenOffline::Silent), ("fault", WhenOffline::Fault)]), default "silent";
        /// Whether clients in `write` may command drives with `access = "control"`.
        commands: bool = Flag, default false;
        /// Who may read.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8"];
        /// Who may write; no one by default. BACnet has no passwords: keep it narrow.
        write: Vec<IpNet> = NETWORKS, default [];
        /// Whether `run` = inactive at priority 1 to 5 survives a restart: it refuses starts as before; nothing is
        /// written.
        keep_priorities: bool = Flag, default false;
        /// BBMD in another subnet where the gateway registers as a foreign device, to receive its broadcasts; `""`:
        /// none.
        bbmd: Option<(String, u16)> = Parsed {
            parse: bacnet::parse_bbmd, words: &[], pattern: "", range: "\"host:port\", or \"\"",
        }, default "";
        /// Vendor identifier, registered with ASHRAE; 0 is that of ASHRAE itself.
        vendor: u16 = Number(0..=65_535, None), default 0;
        /// File whose only line is the password of DeviceCommunicationControl; without it, that service is refused.
        dcc_password_file: PathBuf = PATH, or "none";
        /// Buses whose drives are devices; `[]`: all. Units must be unique among them.
        buses: Vec<String> = List { parse: values::any_text, empty: None, range: "names of buses" }, default [];
    }

    /// [Who holds a drive](commands.md#who-holds-a-drive), where several clients command it.
    AUTHORITY: AuthorityTable {
        /// `"exclusive"`: only its holder commands a drive, except stops. `"advisory"`: everything is reported, nothing
        /// refused.
        mode: Option<authority::Mode> = Words(&[
            ("off", None), ("advisory", Some(authority::Mode::Advisory)), ("exclusive", Some(authority::Mode::Exclusive)),
        ]), default "off";
        /// Ranks, highest first.
        ranks: Vec<String> = List {
            parse: authority::parse_rank, empty: Some("name at least one rank"), range: "names of ranks",
        }, default ["site", "operator", "automation", "remote"];
        /// How long a hold lasts without renewal, and how long a stop reserves the drive.
        lease: Duration = Time(Duration::from_secs(1)..=HOUR), default "30s";
        /// Whether a stop is written when a drive whose run command is set is switched to local control, so that
        /// nothing starts when it is switched back.
        stop_at_local: bool = Flag, default true;
        /// Clients that may hold drives.
        principal: Present = Own { schema: || each(PrincipalTable::schema()), range: "[[authority.principal]]" }, or "none";
    }

    /// [Drills](safety.md#drills): proving that motors stop.
    DRILL: DrillTable {
        /// Highest speed of a drill, % of the motor's range, more than 0 to 100.
        max_speed: f64 = Figure, default 20.0;
        /// Time within which the motor must stop: longer than the timeouts of its supervision and of the drive itself.
        limit: Duration = Time(Duration::from_secs(1)..=HOUR), default "10s";
        /// Age after which `check`, page and metrics report a proof as too old.
        every: Duration = Time(HOUR..=LONGEST_EVERY), default "8760h";
    }

    /// One who may hold drives, whichever way in it uses. Rights stay what `allow`, `write`, roles and `commands` say.
    PRINCIPAL: PrincipalTable {
        /// Its name.
        name: String = Name("-_"), required;
        /// Its rank.
        rank: String = Name("-_"), required;
        /// Its addresses over Modbus TCP and TCP slots; the longest prefix counts.
        modbus_tcp: Vec<IpNet> = NETWORKS, default [];
        /// The name (CN) in its certificate, over Modbus TCP with TLS.
        certificate: String = STRING, or "none";
        /// Its user over HTTP.
        http_user: String = STRING, or "none";
        /// WHO in its MQTT topics `…/as/WHO/set`; the access rules of the broker secure them.
        mqtt: String = Name("-_"), or "none";
        /// Whether it is the Sparkplug host.
        sparkplug: bool = Flag, default false;
        /// Its addresses over BACnet; the longest prefix counts.
        bacnet: Vec<IpNet> = NETWORKS, default [];
        /// Its user name or user id at the local socket. Anyone else there has the first rank.
        socket: String = STRING, or "none";
        /// It writes its command word cyclically, as most PLCs do: a word that repeats its last stop is not a new stop.
        cyclic: bool = Flag, default false;
    }

    /// File of all commands, in which every change shows; see [the audit file](commands.md#the-audit-file).
    AUDIT: AuditTable {
        /// The file, used for nothing else; a relative path is relative to `state_dir` of `[gateway]`.
        file: PathBuf = PATH, default "audit.jsonl";
        /// Total size of the file and the seven older ones; the oldest is deleted.
        max_bytes: u64 = Parsed {
            parse: mqtt::parse_buffer_size, words: &[], pattern: SIZE, range: "\"64KiB\" to \"1024GiB\"",
        }, default "64MiB";
    }

    /// What the recorder keeps: [recordings](history.md#recordings) of the time around faults.
    RECORDINGS: Recordings {
        /// Time recorded before the trigger.
        before: Duration = Time(Duration::from_secs(1)..=Duration::from_secs(600)), default "30s";
        /// Time recorded after it.
        after: Duration = Time(Duration::ZERO..=Duration::from_secs(600)), default "10s";
        /// Maximum size of all recordings on disk.
        max_bytes: u64 = Parsed {
            parse: recordings::parse_size_limit, words: &[], pattern: SIZE, range: "\"1MiB\" to \"1024GiB\"",
        }, default "256MiB";
        /// Maximum number of recordings; 0: nothing is recorded.
        max_count: usize = Number(0..=100_000, None), default 200;
        /// Whether a warning of a drive also triggers a recording.
        warnings: bool = Flag, default false;
    }

    /// When [parameters](parameters.md) are read by themselves, and what they are called.
    PARAMS: Params {
        /// How often all parameters of every drive are read, one drive per bus at a time. Readings are kept in `params`
        /// of the `state_dir`; changes not made by the gateway raise an event.
        every: Duration = Time(Duration::from_secs(60)..=Duration::from_secs(366 * 86_400)), or "never";
        /// Your own lists of names, units and scales, [CSV](parameters.md#names-of-your-own); `vacon-cx.csv` is for the
        /// drives of profile `vacon-cx`.
        names: Vec<PathBuf> = List { parse: values::path, empty: None, range: "files" }, or "none";
    }

    /// What is logged.
    LOG: Log {
        /// Level, also per target: `"info,drivegate::bus=debug"` logs more about the buses. Every command is logged
        /// under target `audit`, even at `"error"`; only `"off"` and `audit=off` disable that.
        level: String = Parsed {
            parse: log::parse_level, words: &[], pattern: log::PATTERN,
            range: "\"off\", \"error\", \"warn\", \"info\", \"debug\" or \"trace\"",
        }, default "info";
        /// `"auto"`: journal format under systemd, coloured text on a terminal, otherwise one JSON object per line.
        format: LogFormat = Words(&[
            ("auto", LogFormat::Auto), ("journal", LogFormat::Journal), ("text", LogFormat::Text),
            ("json", LogFormat::Json),
        ]), default "auto";
    }
}

/// JSON Schema of the configuration, draft 2020-12, for editors.
pub fn schema() -> Value {
    let mut root = Root::schema();
    if let Value::Object(root) = &mut root {
        root.insert("$schema".into(), "https://json-schema.org/draft/2020-12/schema".into());
        root.insert("title".into(), "drivegate".into());
    }
    root
}
