//! Reads `[authority]`: the clients that may hold drives.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use ipnet::IpNet;

use super::bus;
use super::keys::{AUTHORITY, PRINCIPAL};
use super::settings::Unusable;
use super::together::Clients;
use drivegate_core::permit::{Mode, Principal, Rules};
use drivegate_model::document::{Finding, Reader, nearest};

/// File with the users of the system.
const PASSWD: &str = "/etc/passwd";

/// The section `[authority]` as read.
pub(super) struct Authority {
    /// The rules of authority; `None` if authority is off.
    pub(super) rules: Result<Option<Arc<Rules>>, Unusable>,
}

pub(super) fn read(reader: &Reader<'_>) -> Authority {
    let mode = AUTHORITY.mode.read(reader);
    let ranks = AUTHORITY.ranks.get(reader);
    let lease = AUTHORITY.lease.read(reader);
    let stop_at_local = AUTHORITY.stop_at_local.get(reader);
    let twice = ranks
        .iter()
        .enumerate()
        .find(|(at, rank)| ranks.iter().take(*at).any(|r| r == *rank));
    if let Some((_, rank)) = twice {
        reader.problem(
            AUTHORITY.ranks.name,
            format!("the rank `{rank}` is listed twice"),
            "list each rank once, highest first",
        );
    }
    let tables = AUTHORITY.principal.tables(reader);
    let principals: Vec<Option<Principal>> = tables.iter().map(|table| read_one(table, &ranks)).collect();
    unique(&tables, &principals);
    reader.finish();
    let rules = match (mode, lease, principals.into_iter().collect::<Option<Vec<_>>>()) {
        (Some(None), Some(_), Some(_)) => Ok(None),
        (Some(Some(mode)), Some(lease), Some(principals)) => Ok(Some(Arc::new(Rules {
            mode,
            ranks: ranks.iter().map(|rank| rank.as_str().into()).collect(),
            lease,
            stop_at_local,
            principals,
        }))),
        _ => Err(Unusable),
    };
    Authority { rules }
}

fn read_one(reader: &Reader<'_>, ranks: &[String]) -> Option<Principal> {
    let name = PRINCIPAL.name.read(reader);
    let rank = PRINCIPAL.rank.read(reader);
    let place = rank
        .as_ref()
        .and_then(|rank| ranks.iter().position(|known| known == rank));
    if let (Some(rank), None) = (&rank, place) {
        let remedy = match nearest(rank, ranks.iter().map(String::as_str)) {
            Some(near) => format!("did you mean `{near}`?"),
            None => format!("write one of `ranks`: {}", ranks.join(", ")),
        };
        reader.problem(PRINCIPAL.rank.name, format!("there is no rank `{rank}`"), remedy);
    }
    let text = |text: Option<String>| text.filter(|text| !text.is_empty());
    let socket = text(PRINCIPAL.socket.read(reader));
    let uid = socket
        .as_ref()
        .map(|user| reader.accept(PRINCIPAL.socket.name, uid_of(user)));
    let principal = Principal {
        cyclic: PRINCIPAL.cyclic.get(reader),
        modbus_tcp: PRINCIPAL.modbus_tcp.get(reader),
        certificate: text(PRINCIPAL.certificate.read(reader)),
        http_user: text(PRINCIPAL.http_user.read(reader)),
        mqtt: PRINCIPAL.mqtt.read(reader),
        sparkplug: PRINCIPAL.sparkplug.get(reader),
        bacnet: PRINCIPAL.bacnet.get(reader),
        socket: uid.flatten(),
        ..Principal::new(name.clone().unwrap_or_default(), place.unwrap_or_default())
    };
    if principal.cyclic && !repeats(&principal) {
        reader.problem(
            PRINCIPAL.cyclic.name,
            "a stop over HTTP or the local socket is always a new stop".to_string(),
            "delete this key, or name a client that writes cyclically: modbus_tcp, certificate, mqtt, sparkplug or bacnet",
        );
    }
    reader.finish();
    (name.is_some() && place.is_some() && uid.is_none_or(|uid| uid.is_some())).then_some(principal)
}

/// Whether the principal has an interface over which a client may repeat its stop.
fn repeats(principal: &Principal) -> bool {
    let by_address = !principal.modbus_tcp.is_empty() || !principal.bacnet.is_empty();
    by_address || principal.certificate.is_some() || principal.mqtt.is_some() || principal.sparkplug
}

/// The numeric id of a user of this machine.
fn uid_of(user: &str) -> Result<u32, Finding> {
    if let Ok(uid) = user.parse() {
        return Ok(uid);
    }
    let users = std::fs::read_to_string(Path::new(PASSWD)).unwrap_or_default();
    let uid = users.lines().find_map(|line| {
        let mut fields = line.split(':');
        (fields.next() == Some(user)).then(|| fields.nth(1)?.parse().ok())?
    });
    uid.ok_or_else(|| {
        Finding::new(
            format!("there is no user `{user}` in {PASSWD}"),
            "write the name of a user of this machine, or a user id",
        )
    })
}

/// Refuses two principals that one client could match: their names, and their proofs of identity, must be unique.
fn unique(tables: &[Reader<'_>], principals: &[Option<Principal>]) {
    let mut seen: BTreeMap<(&str, String), String> = BTreeMap::new();
    for (table, principal) in tables.iter().zip(principals) {
        let Some(principal) = principal else { continue };
        let text = |key, value: &Option<String>| value.clone().map(|value| (key, value));
        let networks = |key, networks: &[IpNet]| {
            let all: Vec<_> = networks
                .iter()
                .map(|network| (key, network.trunc().to_string()))
                .collect();
            all
        };
        let mut proofs = vec![(PRINCIPAL.name.name, principal.name.to_string())];
        proofs.extend(text(PRINCIPAL.certificate.name, &principal.certificate));
        proofs.extend(text(PRINCIPAL.http_user.name, &principal.http_user));
        proofs.extend(text(PRINCIPAL.mqtt.name, &principal.mqtt));
        proofs.extend(principal.socket.map(|uid| (PRINCIPAL.socket.name, uid.to_string())));
        proofs.extend(
            principal
                .sparkplug
                .then(|| (PRINCIPAL.sparkplug.name, "true".to_string())),
        );
        proofs.extend(networks(PRINCIPAL.modbus_tcp.name, &principal.modbus_tcp));
        proofs.extend(networks(PRINCIPAL.bacnet.name, &principal.bacnet));
        for (key, value) in proofs {
            let other = seen.insert((key, value.clone()), principal.name.to_string());
            if let Some(other) = other {
                table.problem(
                    key,
                    format!("{key} = {value} already belongs to principal `{other}`"),
                    "list each client once, or write a longer prefix",
                );
            }
        }
    }
}

/// The north sides by which clients may command.
pub(super) struct Sides {
    modbus_tcp: bool,
    mqtt: bool,
    sparkplug: bool,
    http: bool,
    bacnet: bool,
    slots: bool,
}

impl Sides {
    pub(super) fn of(clients: &Clients<'_>, buses: &[bus::Found]) -> Sides {
        let mqtt = clients.mqtt.and_then(|mqtt| mqtt.as_ref());
        let mut slots = buses.iter().flat_map(|bus| &bus.slots);
        Sides {
            modbus_tcp: clients.modbus_tcp.is_some_and(|m| m.commands),
            mqtt: mqtt.is_some_and(|m| m.commands),
            sparkplug: mqtt.is_some_and(|m| m.commands && m.sparkplug.is_some()),
            http: clients.http.is_some_and(|http| http.commands),
            bacnet: clients.bacnet.is_some_and(|bacnet| bacnet.commands),
            slots: slots.any(|slot| slot.writes && !slot.listeners.is_empty()),
        }
    }
}

/// Lists each north interface without a principal, where every client may only stop.
pub(super) fn warn_of_nobody(reader: &Reader<'_>, rules: &Rules, sides: &Sides) {
    if rules.mode == Mode::Advisory {
        return;
    }
    let any = |is: fn(&Principal) -> bool| rules.principals.iter().any(is);
    let by_address = any(|p| !p.modbus_tcp.is_empty());
    let all = [
        (
            "Modbus TCP",
            sides.modbus_tcp,
            by_address || any(|p| p.certificate.is_some()),
            "modbus_tcp",
        ),
        ("the tool slots", sides.slots, by_address, "modbus_tcp"),
        ("MQTT", sides.mqtt, any(|p| p.mqtt.is_some()), "mqtt"),
        ("Sparkplug", sides.sparkplug, any(|p| p.sparkplug), "sparkplug"),
        ("HTTP", sides.http, any(|p| p.http_user.is_some()), "http_user"),
        ("BACnet", sides.bacnet, any(|p| !p.bacnet.is_empty()), "bacnet"),
    ];
    for (side, commands, known, key) in all {
        if commands && !known {
            reader.warning(
                AUTHORITY.mode.name,
                format!("over {side} no client is a principal, so clients may only stop"),
                format!("give a principal `{key}`, or turn commands off there"),
            );
        }
    }
}
