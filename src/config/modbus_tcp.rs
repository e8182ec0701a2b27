//! `[modbus_tcp]`, `[[modbus_tcp.listener]]` and `[modbus_tcp.tls]`.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use ipnet::IpNet;

use super::north::Listener as Address;
use super::{bus, values};
use crate::document::{Place, Raw, Reader, nearest};
use crate::north::modbus_tcp::{self, Identity, Role, Tls, TlsFile, Uncached};

/// Words of `uncached`.
pub(super) const UNCACHED: [(&str, Uncached); 2] = [("forward", Uncached::Forward), ("refuse", Uncached::Refuse)];
/// Words of `roles`.
pub(super) const ROLES: [(&str, Role); 2] = [("monitor", Role::Monitor), ("control", Role::Control)];
/// Connections at one time.
pub(super) const CONNECTIONS: RangeInclusive<usize> = 1..=10_000;
/// Time without a request.
pub(super) const IDLE: RangeInclusive<Duration> = Duration::from_secs(1)..=Duration::from_secs(7 * 86_400);
/// The word for no limit.
pub(super) const OFF: &str = "off";

pub(super) const DEFAULT_LISTEN: &str = "127.0.0.1:1502";
/// The port that the specification of Modbus/TCP Security has registered.
pub(super) const DEFAULT_TLS_LISTEN: &str = "127.0.0.1:802";
pub(super) const DEFAULT_CONNECTIONS: usize = 64;
pub(super) const DEFAULT_IDLE: Duration = Duration::from_secs(3600);
pub(super) const DEFAULT_STALE_AFTER: Duration = Duration::from_secs(1);
pub(super) const DEFAULT_ALLOW: [&str; 2] = ["127.0.0.0/8", "::1/128"];

/// `[modbus_tcp]` as read.
pub(super) struct ModbusTcp {
    /// Absent when a certificate or key cannot be used, which is a problem already told.
    pub(super) options: Option<modbus_tcp::Options>,
    pub(super) stale_after: Duration,
    pub(super) stale_written: bool,
    pub(super) stale_place: Place,
    pub(super) addresses: Vec<Address>,
    /// What each listener shows: `None` all buses.
    pub(super) selections: Vec<Option<Vec<String>>>,
    /// Whether any client could write.
    pub(super) commands: bool,
}

/// Reads the section; `buses` are the names that a listener can select.
pub(super) fn read(reader: &Reader<'_>, base: &Path, buses: &[&str]) -> ModbusTcp {
    let allow = values::list(reader, "allow", loopback(), values::network);
    let write = values::list(reader, "write", Vec::new(), values::network);
    let inherited = Inherited {
        allow: &allow,
        write: &write,
        buses,
    };
    let tables = reader.tables("listener");
    let tls_table = reader.table("tls");
    let mut found = Found::default();
    // Who writes listeners of his own or TLS wants those; the short form is there when it is written, or alone.
    if reader.has("listen") || (tables.is_empty() && tls_table.is_none()) {
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
            .extend(tls.listen.iter().map(|a| (*a, table.place_of("listen"))));
        found.selections.push(tls.buses.clone());
        tls
    });
    let commands = commands_in_clear
        || tls
            .as_ref()
            .is_some_and(|tls| tls.roles.values().any(|role| *role == Role::Control));
    let max_connections = values::number(reader, "max_connections", DEFAULT_CONNECTIONS, &CONNECTIONS);
    let per_address = values::optional_number(reader, "max_connections_per_address", &CONNECTIONS);
    let idle_timeout = read_idle(reader);
    let uncached = values::choice(reader, "uncached", Uncached::Forward, &UNCACHED);
    let stale_after = values::duration(reader, "stale_after", DEFAULT_STALE_AFTER, &bus::TIMES);
    let stale_written = reader.has("stale_after");
    reader.finish();
    let Found {
        listeners,
        addresses,
        selections,
    } = found;
    let tls = match tls {
        None => Some(None),
        Some(read) => read.into_tls().map(Some),
    };
    let options = tls.map(|tls| modbus_tcp::Options {
        listeners,
        tls,
        max_connections,
        max_connections_per_address: per_address,
        idle_timeout,
        uncached,
    });
    ModbusTcp {
        options,
        stale_after,
        stale_written,
        stale_place: reader.place_of("stale_after"),
        addresses,
        selections,
        commands,
    }
}

/// What a listener has from `[modbus_tcp]` when it does not say otherwise, and the buses there are.
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
}

impl Found {
    fn add(&mut self, listener: modbus_tcp::Listener, reader: &Reader<'_>) {
        warn_of_reach(reader, &listener);
        let place = reader.place_of("listen");
        self.addresses
            .extend(listener.listen.iter().map(|a| (*a, place.clone())));
        self.selections.push(listener.buses.clone());
        self.listeners.push(listener);
    }
}

fn short_form(reader: &Reader<'_>, inherited: &Inherited<'_>) -> modbus_tcp::Listener {
    modbus_tcp::Listener {
        section: "[modbus_tcp]".to_string(),
        listen: read_listen(reader, DEFAULT_LISTEN),
        allow: inherited.allow.to_vec(),
        write: inherited.write.to_vec(),
        buses: None,
    }
}

fn read_listener(reader: &Reader<'_>, inherited: &Inherited<'_>) -> modbus_tcp::Listener {
    if !reader.has("listen") {
        reader.problem(
            "listen",
            format!("`listen` is missing; write for example [\"{DEFAULT_LISTEN}\"]"),
        );
    }
    modbus_tcp::Listener {
        section: "[[modbus_tcp.listener]]".to_string(),
        listen: if reader.has("listen") {
            read_listen(reader, DEFAULT_LISTEN)
        } else {
            Vec::new()
        },
        allow: values::list(reader, "allow", inherited.allow.to_vec(), values::network),
        write: values::list(reader, "write", inherited.write.to_vec(), values::network),
        buses: read_buses(reader, inherited.buses),
    }
}

fn read_listen(reader: &Reader<'_>, default: &str) -> Vec<SocketAddr> {
    let preset = values::socket(default).into_iter().collect();
    let listen = values::list(reader, "listen", preset, values::socket);
    if is_empty(reader, "listen") {
        reader.problem(
            "listen",
            format!("the list is empty; write for example [\"{default}\"]"),
        );
    }
    listen
}

fn is_empty(reader: &Reader<'_>, key: &str) -> bool {
    matches!(reader.raw(key).map(|node| &node.value), Some(Raw::Array(items)) if items.is_empty())
}

/// Names of buses that the file has.
fn read_buses(reader: &Reader<'_>, known: &[&str]) -> Option<Vec<String>> {
    if !reader.has("buses") {
        return None;
    }
    if is_empty(reader, "buses") {
        reader.problem("buses", "the list is empty; name a bus, or leave the key out for all");
    }
    let one = |name: &str| {
        if known.contains(&name) {
            return Ok(name.to_string());
        }
        Err(match nearest(name, known.iter().copied()) {
            Some(near) => format!("there is no bus `{name}`; did you mean `{near}`?"),
            None if known.is_empty() => format!("there is no bus `{name}`; the file has none that could be shown"),
            None => format!("there is no bus `{name}`; write one of {}", known.join(", ")),
        })
    };
    Some(values::list(reader, "buses", Vec::new(), one))
}

/// `idle_timeout`: a duration, or the word for none.
fn read_idle(reader: &Reader<'_>) -> Option<Duration> {
    let off = reader.raw("idle_timeout").is_some_and(|node| match &node.value {
        Raw::Text(text) | Raw::Env(text) => text == OFF,
        _ => false,
    });
    (!off).then(|| values::duration(reader, "idle_timeout", DEFAULT_IDLE, &IDLE))
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
        listen: read_listen(reader, DEFAULT_TLS_LISTEN),
        allow: values::list(reader, "allow", inherited.allow.to_vec(), values::network),
        buses: read_buses(reader, inherited.buses),
        identity: read_identity(reader, base),
        roles: read_roles(reader),
    }
}

/// Everything about the files is tried here, so that `check` tells what clients would run into.
fn read_identity(reader: &Reader<'_>, base: &Path) -> Option<Identity> {
    let path = |key: &str| reader.required::<PathBuf>(key).map(|path| values::resolved(base, path));
    let (certificate, key, client_ca) = (path("certificate"), path("key"), path("client_ca"));
    let name = |file: TlsFile| match file {
        TlsFile::Certificate => "certificate",
        TlsFile::Key => "key",
        TlsFile::ClientCa => "client_ca",
    };
    match Identity::load(&certificate?, &key?, &client_ca?, SystemTime::now()) {
        Ok((identity, warnings)) => {
            warnings
                .iter()
                .for_each(|fault| reader.warning(name(fault.file), fault.to_string()));
            Some(identity)
        }
        Err(errors) => {
            errors
                .iter()
                .for_each(|fault| reader.problem(name(fault.file), fault.to_string()));
            None
        }
    }
}

fn read_roles(reader: &Reader<'_>) -> BTreeMap<String, Role> {
    let mut roles = BTreeMap::new();
    if let Some(table) = reader.table("roles") {
        for name in table.keys() {
            if name.is_empty() {
                table.problem(name, "a role without a name is none; remove it");
            }
            roles.insert(name.to_string(), values::choice(&table, name, Role::Monitor, &ROLES));
        }
    }
    if !roles.values().any(|role| *role == Role::Control) && reader.document().is_sound() {
        reader.warning(
            "roles",
            "no role may write, so every TLS client only reads; write for example roles = { operator = \"control\" }",
        );
    }
    roles
}

fn loopback() -> Vec<IpNet> {
    DEFAULT_ALLOW
        .iter()
        .filter_map(|net| values::network(net).ok())
        .collect()
}

/// Who can reach a listener and who cannot, where that is probably not meant.
fn warn_of_reach(reader: &Reader<'_>, listener: &modbus_tcp::Listener) {
    for network in &listener.write {
        if !listener.allow.iter().any(|allowed| allowed.contains(network)) {
            reader.warning(
                "write",
                format!("{network} may write but not all of it may connect; add it to `allow`"),
            );
        }
    }
    let open = listener.listen.iter().find(|address| !address.ip().is_loopback());
    let Some(open) = open else { return };
    if !listener.write.is_empty() {
        reader.warning(
            "listen",
            format!(
                "{open} is reached from the network, and Modbus TCP knows no passwords: addresses in `write` \
                 command drives; keep `write` as narrow as it can be, or use [modbus_tcp.tls]"
            ),
        );
    }
    let only_here = listener.allow.iter().all(|net| net.network().is_loopback());
    if only_here && reader.has("listen") {
        reader.warning(
            "listen",
            format!("{open} listens to the network but `allow` lets nobody in from there; add the network to `allow`"),
        );
    }
}
