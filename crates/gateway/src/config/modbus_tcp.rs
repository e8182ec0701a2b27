//! Reads `[modbus_tcp]`, `[[modbus_tcp.listener]]` and `[modbus_tcp.tls]`.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;
use std::time::SystemTime;

use ipnet::IpNet;

use super::http::Listener as Address;
use super::key::Key;
use super::keys::{LISTENER, MODBUS_TCP, ROLES, TLS};
use super::{files, stale, values};
use drivegate_model::document::{Place, Reader};
use drivegate_north::modbus_tcp::{self, Identity, Registers, Role, Tls, View};
use drivegate_north::tls::TlsFile;

/// Default address of the short form, used if `listen` is absent.
const DEFAULT_LISTEN: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 1502);

/// Name and place of a `default_drive`, with the buses that its listener shows.
pub(super) type DefaultDrive = (String, Place, Option<Vec<String>>);

/// `[modbus_tcp]` as read.
pub(super) struct ModbusTcp {
    /// Absent when a certificate or key cannot be used, which is reported.
    pub(super) options: Option<modbus_tcp::Options>,
    /// The former place of the key of `[gateway]`.
    pub(super) stale_after: stale::Written,
    pub(super) addresses: Vec<Address>,
    /// The buses that each listener shows, `None` for all buses.
    pub(super) selections: Vec<Option<Vec<String>>>,
    /// The drives at units 0 and 255.
    pub(super) default_drives: Vec<DefaultDrive>,
    /// Whether any client could write.
    pub(super) commands: bool,
}

/// Reads the section; `buses` are the names that a listener can select.
pub(super) fn read(reader: &Reader<'_>, base: &Path, buses: &[&str]) -> ModbusTcp {
    let allow = MODBUS_TCP.allow.get(reader);
    let write = MODBUS_TCP.write.get(reader);
    let inherited = Inherited {
        allow: &allow,
        write: &write,
        buses,
    };
    let tables = MODBUS_TCP.listener.tables(reader);
    let tls_table = MODBUS_TCP.tls.table(reader);
    let mut found = Found::default();
    // With listeners of its own or TLS, the short form counts only if `listen` is present.
    if reader.has(MODBUS_TCP.listen.name) || (tables.is_empty() && tls_table.is_none()) {
        found.add(short_form(reader, &inherited), reader);
    }
    for table in &tables {
        let listener = read_listener(table, &inherited);
        table.finish();
        found.add(listener, table);
    }
    let commands_in_clear = found.listeners.iter().any(|listener| !listener.write.is_empty());
    let tls = tls_table.as_ref().map(|table| {
        let tls = read_tls(table, base, &inherited);
        table.finish();
        found
            .addresses
            .extend(tls.listen.iter().map(|a| (*a, TLS.listen.place(table))));
        found.selections.push(tls.buses.clone());
        tls
    });
    let commands = commands_in_clear
        || tls
            .as_ref()
            .is_some_and(|tls| tls.roles.values().any(|role| *role == Role::Control));
    let max_connections = MODBUS_TCP.max_connections.get(reader);
    let max_connections_per_address = MODBUS_TCP.max_connections_per_address.get(reader);
    let tls_allow = tls.iter().flat_map(|tls| &tls.allow);
    let allowed: Vec<&IpNet> = found.listeners.iter().flat_map(|l| &l.allow).chain(tls_allow).collect();
    warn_of_shares(reader, &allowed, max_connections, max_connections_per_address);
    let idle_timeout = MODBUS_TCP.idle_timeout.get(reader);
    let uncached = MODBUS_TCP.uncached.get(reader);
    let stale_after = stale::written(&MODBUS_TCP.stale_after, reader);
    reader.finish();
    let Found {
        listeners,
        addresses,
        selections,
        default_drives,
    } = found;
    let tls = match tls {
        None => Some(None),
        Some(read) => read.into_tls().map(Some),
    };
    let options = tls.map(|tls| modbus_tcp::Options {
        listeners,
        tls,
        max_connections,
        max_connections_per_address,
        idle_timeout,
        uncached,
    });
    ModbusTcp {
        options,
        stale_after,
        addresses,
        selections,
        default_drives,
        commands,
    }
}

/// Settings that a listener takes from `[modbus_tcp]` unless it has its own, and the names of the buses.
struct Inherited<'a> {
    allow: &'a [IpNet],
    write: &'a [IpNet],
    buses: &'a [&'a str],
}

#[derive(Default)]
struct Found {
    listeners: Vec<modbus_tcp::Listener>,
    addresses: Vec<Address>,
    selections: Vec<Option<Vec<String>>>,
    default_drives: Vec<DefaultDrive>,
}

impl Found {
    fn add(&mut self, listener: modbus_tcp::Listener, reader: &Reader<'_>) {
        warn_of_reach(reader, &listener);
        let place = MODBUS_TCP.listen.place(reader);
        self.addresses
            .extend(listener.listen.iter().map(|a| (*a, place.clone())));
        self.selections.push(listener.view.buses.clone());
        if let Some(drive) = &listener.view.default_drive {
            let place = LISTENER.default_drive.place(reader);
            self.default_drives
                .push((drive.clone(), place, listener.view.buses.clone()));
        }
        self.listeners.push(listener);
    }
}

fn short_form(reader: &Reader<'_>, inherited: &Inherited<'_>) -> modbus_tcp::Listener {
    let listen = MODBUS_TCP.listen.written(reader);
    modbus_tcp::Listener {
        section: "[modbus_tcp]".to_string(),
        listen: listen.unwrap_or_else(|| vec![DEFAULT_LISTEN]),
        allow: inherited.allow.to_vec(),
        write: inherited.write.to_vec(),
        view: View::default(),
    }
}

fn read_listener(reader: &Reader<'_>, inherited: &Inherited<'_>) -> modbus_tcp::Listener {
    let own = |key: &Key<Vec<IpNet>>, inherited: &[IpNet]| key.read(reader).unwrap_or_else(|| inherited.to_vec());
    modbus_tcp::Listener {
        section: "[[modbus_tcp.listener]]".to_string(),
        listen: LISTENER.listen.get(reader),
        allow: own(&LISTENER.allow, inherited.allow),
        write: own(&LISTENER.write, inherited.write),
        view: read_view(reader, inherited),
    }
}

fn read_view(reader: &Reader<'_>, inherited: &Inherited<'_>) -> View {
    let view = LISTENER.view.get(reader);
    let model_at: Option<u16> = LISTENER.model_at.read(reader);
    if let Some(other) = model_at.filter(|at| ![0, 0x8000].contains(at)) {
        reader.problem(
            LISTENER.model_at.name,
            format!("the common model cannot begin at {other}"),
            "write 0 or 0x8000",
        );
    }
    if view == Registers::Raw && reader.has(LISTENER.model_at.name) {
        reader.problem(
            LISTENER.model_at.name,
            "view = \"raw\" shows no common model",
            "leave one of them out",
        );
    }
    View {
        buses: read_buses(reader, &LISTENER.buses, inherited.buses),
        default_drive: LISTENER.default_drive.read(reader),
        registers: match (view, model_at) {
            (Registers::Model, Some(0)) => Registers::ModelAtZero,
            (view, _) => view,
        },
    }
}

/// Names of buses, which the file must have.
fn read_buses(reader: &Reader<'_>, key: &Key<Vec<String>>, known: &[&str]) -> Option<Vec<String>> {
    let mut names = key.read(reader)?;
    let remedy = match known {
        [] => "the file has no bus to serve".to_string(),
        known => format!("write one of {}", known.join(", ")),
    };
    values::known_buses(reader, key.name, &mut names, known, &remedy);
    Some(names)
}

/// `[modbus_tcp.tls]`, whose certificates may not be usable.
struct ReadTls {
    listen: Vec<SocketAddr>,
    allow: Vec<IpNet>,
    buses: Option<Vec<String>>,
    identity: Option<Identity>,
    roles: BTreeMap<String, Role>,
}

impl ReadTls {
    fn into_tls(self) -> Option<Tls> {
        let ReadTls {
            listen,
            allow,
            buses,
            identity,
            roles,
        } = self;
        Some(Tls {
            listen,
            allow,
            buses,
            identity: identity?,
            roles,
        })
    }
}

fn read_tls(reader: &Reader<'_>, base: &Path, inherited: &Inherited<'_>) -> ReadTls {
    ReadTls {
        listen: TLS.listen.get(reader),
        allow: TLS.allow.read(reader).unwrap_or_else(|| inherited.allow.to_vec()),
        buses: read_buses(reader, &TLS.buses, inherited.buses),
        identity: read_identity(reader, base),
        roles: read_roles(reader),
    }
}

/// Loads the files, so that `check` reports what clients would run into.
fn read_identity(reader: &Reader<'_>, base: &Path) -> Option<Identity> {
    let path = |key: &Key<_>| Some(values::resolved(base, key.read(reader)?));
    let (certificate, key, client_ca) = (path(&TLS.certificate), path(&TLS.key), path(&TLS.client_ca));
    let client_crl = path(&TLS.client_crl);
    let name = |file: TlsFile| match file {
        TlsFile::Certificate => TLS.certificate.name,
        TlsFile::Key => TLS.key.name,
        TlsFile::Ca => TLS.client_ca.name,
        TlsFile::Crl => TLS.client_crl.name,
    };
    let (certificate, key, client_ca) = (certificate?, key?, client_ca?);
    files::warn_of_readers(reader, TLS.key.name, &key);
    let loaded = Identity::load(&certificate, &key, &client_ca, client_crl.as_deref(), SystemTime::now());
    files::reported(reader, loaded, name)
}

fn read_roles(reader: &Reader<'_>) -> BTreeMap<String, Role> {
    let mut roles = BTreeMap::new();
    if let Some(table) = TLS.roles.table(reader) {
        for name in table.keys() {
            if name.is_empty() {
                table.problem(name, "a role needs a name", "remove it");
            }
            let role = table.parsed(name, |text| ROLES.find(text));
            roles.insert(name.to_string(), role.unwrap_or(Role::Monitor));
        }
    }
    if !roles.values().any(|role| *role == Role::Control) && reader.document().is_sound() {
        reader.warning(
            TLS.roles.name,
            "no role may write, so TLS clients can only read",
            "write for example roles = { operator = \"control\" }",
        );
    }
    roles
}

/// Networks whose addresses identify hosts of the same site, not a NAT in between.
const PRIVATE: [&str; 8] = [
    "10.0.0.0/8",
    "172.16.0.0/12",
    "192.168.0.0/16",
    "169.254.0.0/16",
    "127.0.0.0/8",
    "::1/128",
    "fc00::/7",
    "fe80::/10",
];

/// Warns if the share of one address is probably too small: fewer connections are possible than requested, or
/// clients share an address because of a NAT.
fn warn_of_shares(reader: &Reader<'_>, allowed: &[&IpNet], total: usize, per_address: usize) {
    let hosts = |network: &IpNet| {
        if network.network().is_loopback() {
            1
        } else {
            1_usize
                .checked_shl(u32::from(network.max_prefix_len() - network.prefix_len()))
                .unwrap_or(usize::MAX)
        }
    };
    let hosts = allowed
        .iter()
        .map(|network| hosts(network))
        .fold(0, usize::saturating_add);
    let possible = hosts.saturating_mul(per_address);
    if reader.has(MODBUS_TCP.max_connections.name) && hosts > 0 && possible < total {
        reader.warning(
            MODBUS_TCP.max_connections.name,
            format!(
                "at most {possible} connections are possible, {per_address} for each address in `allow`; clients behind \
                 one NAT or proxy share an address"
            ),
            "raise max_connections_per_address, or lower max_connections",
        );
    }
    let is_private = |network: &IpNet| {
        let mut private = PRIVATE.iter().filter_map(|text| text.parse::<IpNet>().ok());
        private.any(|private| private.contains(network))
    };
    let public = allowed
        .iter()
        .find(|network| !is_private(network) && network.prefix_len() < network.max_prefix_len());
    if let (Some(public), false) = (public, reader.has(MODBUS_TCP.max_connections_per_address.name)) {
        reader.warning(
            MODBUS_TCP.allow.name,
            format!(
                "clients in {public} can come through a NAT or proxy; those behind one share its address and the \
                 {per_address} connections that one address may have"
            ),
            "write max_connections_per_address, as many as the clients behind one address need",
        );
    }
}

/// Warns if the clients that can reach a listener are probably not the intended ones.
fn warn_of_reach(reader: &Reader<'_>, listener: &modbus_tcp::Listener) {
    let (listen, write) = (MODBUS_TCP.listen.name, MODBUS_TCP.write.name);
    for network in &listener.write {
        if !listener.allow.iter().any(|allowed| allowed.contains(network)) {
            reader.warning(
                write,
                format!("{network} may write, but not all of it may connect"),
                "add it to `allow`",
            );
        }
    }
    let open = listener.listen.iter().find(|address| !address.ip().is_loopback());
    let Some(open) = open else { return };
    if !listener.write.is_empty() {
        reader.warning(
            listen,
            format!(
                "{open} can be reached from the network, and Modbus TCP has no passwords: addresses in `write` command drives"
            ),
            "keep `write` as narrow as possible, or use [modbus_tcp.tls]",
        );
    }
    let only_here = listener.allow.iter().all(|net| net.network().is_loopback());
    if only_here && reader.has(listen) {
        reader.warning(
            listen,
            format!("{open} listens on the network, but `allow` admits no client from there"),
            "add the network to `allow`",
        );
    }
}
