//! The sections, and the gateway itself.

use super::forms::*;
use super::{authority, bacnet, bus, drill, http, log, modbus_tcp, mqtt, params, recordings};

keys! {
    /// Configuration of drivegate. Environment variables DRIVEGATE__SECTION__KEY override any key of it; relative
    /// paths are relative to the directory of the file.
    ROOT: Root {
        /// The gateway itself.
        gateway: Present = Own { schema: Gateway::schema, range: "[gateway]" }, required;
        /// Serial lines, or serial device servers, with their drives.
        bus: Present = Own { schema: || each(bus::Bus::schema()), range: "[[bus]]" }, or "none";
        /// Modbus TCP server; not started without this section.
        modbus_tcp: Present = Own { schema: modbus_tcp::ModbusTcp::schema, range: "[modbus_tcp]" }, or "not started";
        /// MQTT client; not started without this section.
        mqtt: Present = Own { schema: mqtt::Mqtt::schema, range: "[mqtt]" }, or "not started";
        /// HTTP server for metrics, health and the status page; not started without this section.
        http: Present = Own { schema: http::Http::schema, range: "[http]" }, or "not started";
        /// BACnet/IP server; not started without this section.
        bacnet: Present = Own { schema: bacnet::Bacnet::schema, range: "[bacnet]" }, or "not started";
        /// Who holds a drive; off without this section.
        authority: Present = Own { schema: authority::AuthorityTable::schema, range: "[authority]" }, or "off";
        /// How stops are proven; not possible without this section.
        drill: Present = Own { schema: drill::DrillTable::schema, range: "[drill]" }, or "off";
        /// File of all commands; not written without this section.
        audit: Present = Own { schema: log::AuditTable::schema, range: "[audit]" }, or "not written";
        /// What the recorder keeps.
        recordings: Present = Own { schema: recordings::Recordings::schema, range: "[recordings]" }, or "the defaults";
        /// When parameters are read by themselves, and what they are called.
        params: Present = Own { schema: params::Params::schema, range: "[params]" }, or "only on request";
        /// What is logged.
        log: Present = Own { schema: log::Log::schema, range: "[log]" }, or "the defaults";
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
        /// Older samples of process data are [stale](#stale), on every interface. If not set, it is three cycles on a
        /// slower bus; if set, it applies to every bus.
        stale_after: Duration = TIMES, default "1s";
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
