//! `[modbus_tcp]` and `[http]`.

use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::time::Duration;

use ipnet::IpNet;

use super::{bus, values};
use crate::document::{Place, Raw, Reader};
use crate::north::modbus_tcp::Uncached;
use crate::north::{http, modbus_tcp};

/// Words of `uncached`.
pub(super) const UNCACHED: [(&str, Uncached); 2] = [("forward", Uncached::Forward), ("refuse", Uncached::Refuse)];
/// Connections at one time.
pub(super) const CONNECTIONS: RangeInclusive<usize> = 1..=10_000;

pub(super) const DEFAULT_MODBUS_TCP: &str = "127.0.0.1:1502";
pub(super) const DEFAULT_HTTP: &str = "127.0.0.1:9488";
pub(super) const DEFAULT_CONNECTIONS: usize = 64;
pub(super) const DEFAULT_STALE_AFTER: Duration = Duration::from_secs(1);
pub(super) const DEFAULT_ALLOW: [&str; 2] = ["127.0.0.0/8", "::1/128"];

/// An address that a server listens on, and where it stands.
pub(super) type Listener = (SocketAddr, Place);

/// `[modbus_tcp]` as read.
pub(super) struct ModbusTcp {
    pub(super) options: modbus_tcp::Options,
    pub(super) stale_after: Duration,
    pub(super) stale_place: Place,
    pub(super) listeners: Vec<Listener>,
}

pub(super) fn read_modbus_tcp(reader: &Reader<'_>) -> ModbusTcp {
    let default: Vec<SocketAddr> = values::socket(DEFAULT_MODBUS_TCP).into_iter().collect();
    let listen = values::list(reader, "listen", default, values::socket);
    if matches!(reader.raw("listen").map(|node| &node.value), Some(Raw::Array(items)) if items.is_empty()) {
        reader.problem(
            "listen",
            format!("the list is empty; write for example [\"{DEFAULT_MODBUS_TCP}\"]"),
        );
    }
    let allow = values::list(reader, "allow", loopback(), values::network);
    let write = values::list(reader, "write", Vec::new(), values::network);
    let options = modbus_tcp::Options {
        listen,
        allow,
        write,
        max_connections: values::number(reader, "max_connections", DEFAULT_CONNECTIONS, &CONNECTIONS),
        uncached: values::choice(reader, "uncached", Uncached::Forward, &UNCACHED),
    };
    let stale_after = values::duration(reader, "stale_after", DEFAULT_STALE_AFTER, &bus::TIMES);
    if reader.has("tls") {
        reader.problem("tls", "[modbus_tcp.tls] is not served by this version; remove it");
    }
    reader.finish();
    warn_of_reach(reader, &options);
    let place = reader.place_of("listen");
    ModbusTcp {
        listeners: options.listen.iter().map(|a| (*a, place.clone())).collect(),
        options,
        stale_after,
        stale_place: reader.place_of("stale_after"),
    }
}

fn loopback() -> Vec<IpNet> {
    DEFAULT_ALLOW
        .iter()
        .filter_map(|net| values::network(net).ok())
        .collect()
}

/// Who can reach the server and who cannot, where that is probably not meant.
fn warn_of_reach(reader: &Reader<'_>, options: &modbus_tcp::Options) {
    for network in &options.write {
        if !options.allow.iter().any(|allowed| allowed.contains(network)) {
            reader.warning(
                "write",
                format!("{network} may write but not all of it may connect; add it to `allow`"),
            );
        }
    }
    let open = options.listen.iter().find(|address| !address.ip().is_loopback());
    let Some(open) = open else { return };
    if !options.write.is_empty() {
        reader.warning(
            "listen",
            format!(
                "{open} is reached from the network, and Modbus TCP knows no passwords: addresses in `write` \
                 command drives; keep `write` as narrow as it can be"
            ),
        );
    }
    let only_here = options.allow.iter().all(|net| net.network().is_loopback());
    if only_here && reader.has("listen") {
        reader.warning(
            "listen",
            format!("{open} listens to the network but `allow` lets nobody in from there; add the network to `allow`"),
        );
    }
}

pub(super) fn read_http(reader: &Reader<'_>) -> (Option<http::Options>, Option<Listener>) {
    let listen = match reader.has("listen") {
        true => reader.parsed("listen", values::socket),
        false => values::socket(DEFAULT_HTTP).ok(),
    };
    reader.finish();
    (
        listen.map(|listen| http::Options { listen }),
        listen.map(|listen| (listen, reader.place_of("listen"))),
    )
}
