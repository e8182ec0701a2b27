//! `[modbus_tcp]`, its listeners and TLS.

use super::forms::*;
use drivegate_north::modbus_tcp::{Registers, Role, Uncached};

const CONNECTIONS: Number = Number(1..=10_000, None);
pub(in crate::config) const ROLES: Words<Role> = Words(&[("monitor", Role::Monitor), ("control", Role::Control)]);
const ADDRESSES: List<SocketAddr> = List {
    parse: values::socket::<1502>,
    empty: Some("write for example [\"127.0.0.1:1502\"]"),
    range: "addresses with ports, such as [\"127.0.0.1:1502\"]",
};
const TLS_ADDRESSES: List<SocketAddr> = List {
    parse: values::socket::<802>,
    ..ADDRESSES
};
const BUSES: List<String> = List {
    parse: values::any_text,
    empty: Some("name a bus, or leave the key out for all"),
    range: "names of buses",
};

keys! {
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
        idle_timeout: Option<Duration> = IDLE_TIMEOUT, default "1h";
        /// Raw reads of registers that are not polled: forwarded to the drive, or refused with exception 02.
        uncached: Uncached = Words(&[("forward", Uncached::Forward), ("refuse", Uncached::Refuse)]), default "forward";
        /// Former place of `stale_after` of `[gateway]`; version 0.2 refuses it.
        stale_after: Duration = TIMES, or "that of `[gateway]`";
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
        /// Drive that units 0 and 255 are too, for clients whose unit cannot be set. The gateway's own registers, with stop
        /// all, are then at no unit: 1 written to 0x0100 at units 0 and 255 stops that drive.
        default_drive: String = Name("-_"), or "none";
        /// `"model"`: the common model, and the drive's own registers below 0x8000. `"raw"`: only the drive's own, 0 to
        /// 0xFFFF.
        view: Registers = Words(&[("model", Registers::Model), ("raw", Registers::Raw)]), default "model";
        /// Where the common model begins: 0x8000, or [0](modbus-tcp.md#clients-with-few-registers) for clients that know 40001 to
        /// 49999 only. Not with `view = "raw"`.
        model_at: u16 = Number(0..=0x8000, None), or "0x8000";
    }

    /// Modbus/TCP Security: TLS in which the clients present certificates.
    TLS: Tls {
        /// Listen addresses. Ports below 1024 need [a privilege](installation.md#port-502).
        listen: Vec<SocketAddr> = TLS_ADDRESSES, default ["127.0.0.1:802"];
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
}
