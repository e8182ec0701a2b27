//! Checks that names, ports, addresses, units and listeners are unique.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use super::bus::Found;
use super::http::Listener;
use super::modbus_tcp::DefaultDrive;
use drivegate_line::split_dial_in;
use drivegate_model::document::{Document, Place, nearest};

pub(super) fn check(document: &Document, buses: &[Found]) {
    let names = buses.iter().filter_map(|bus| bus.name.as_ref());
    check_names(document, "bus", "buses", names);
    let drives = || buses.iter().flat_map(|bus| &bus.drives);
    check_names(
        document,
        "drive",
        "drives",
        drives().filter_map(|drive| drive.name.as_ref()),
    );
    check_ports(document, buses);
    check_dial_in(document, buses);
    check_ptys(document, buses);
    check_addresses(document, buses);
}

/// The line of a key as text: ` (line 7)`, or nothing.
fn line(place: &Place) -> String {
    place.line.map_or_else(String::new, |line| format!(" (line {line})"))
}

fn check_names<'a>(document: &Document, what: &str, many: &str, names: impl Iterator<Item = &'a (String, Place)>) {
    let mut seen: BTreeMap<&str, &Place> = BTreeMap::new();
    for (name, place) in names {
        match seen.get(name.as_str()) {
            Some(first) => document.problem(
                place,
                format!(
                    "there are two {many} `{name}`, the other is {}{}",
                    first.key.trim_end_matches(".name"),
                    line(first)
                ),
                format!("rename this {what}"),
            ),
            None => {
                seen.insert(name, place);
            }
        }
    }
}

fn check_ports(document: &Document, buses: &[Found]) {
    let mut seen: Vec<(&str, PathBuf, String)> = Vec::new();
    for bus in buses {
        let Some((port, place)) = &bus.port else { continue };
        let device = device(port);
        let name = bus
            .name
            .as_ref()
            .map_or(String::new(), |(name, _)| format!(" `{name}`"));
        let Some((other, _, owner)) = seen.iter().find(|(_, other, _)| *other == device) else {
            seen.push((port, device, name));
            continue;
        };
        let how = if *other == port {
            String::new()
        } else {
            format!(", as {other}, which is the same device")
        };
        document.problem(
            place,
            format!("the port {port} already belongs to bus{owner}{how}"),
            "give each bus its own port",
        );
    }
}

/// Devices that dial in at one address are distinguished by their texts: no text may be the beginning of another.
fn check_dial_in(document: &Document, buses: &[Found]) {
    let mut seen: Vec<(&str, &str)> = Vec::new();
    for (port, place) in buses.iter().filter_map(|bus| bus.port.as_ref()) {
        let Some(at) = port.strip_prefix("tcp-listen://") else {
            continue;
        };
        let (address, id) = split_dial_in(at);
        let alike = |other: &str| other != id && (other.starts_with(id) || id.starts_with(other));
        if let Some((_, other)) = seen.iter().find(|(at, other)| *at == address && alike(other)) {
            let [id, other] = [id, other].map(|id| match id {
                "" => "no text".to_string(),
                id => format!("the text `{id}`"),
            });
            document.problem(
                place,
                format!("{id} cannot be distinguished from {other} of another bus at {address}"),
                "give each bus at one address a text that is not the beginning of another one",
            );
        }
        seen.push((address, id));
    }
}

/// A slot creates the serial port for its tool: the path must not be used by another slot or by a line.
fn check_ptys(document: &Document, buses: &[Found]) {
    let mut seen: Vec<(&Path, String)> = Vec::new();
    for (port, place) in buses.iter().filter_map(|bus| bus.port.as_ref()) {
        seen.push((Path::new(port), format!("{}{}", place.key, line(place))));
    }
    for (path, place) in buses
        .iter()
        .flat_map(|bus| &bus.slots)
        .filter_map(|slot| slot.pty.as_ref())
    {
        if let Some((_, owner)) = seen.iter().find(|(other, _)| other == path) {
            document.problem(
                place,
                format!("the path {} already belongs to {owner}", path.display()),
                "give each slot its own path",
            );
        }
        seen.push((path, format!("{}{}", place.key, line(place))));
    }
}

/// The device behind a port: symbolic links resolved as far as they exist now.
fn device(port: &str) -> PathBuf {
    if port.contains("://") {
        return PathBuf::from(port.to_ascii_lowercase());
    }
    std::fs::canonicalize(port).unwrap_or_else(|_| Path::new(port).to_path_buf())
}

fn check_addresses(document: &Document, buses: &[Found]) {
    for bus in buses {
        let mut seen: BTreeMap<u8, String> = BTreeMap::new();
        for drive in &bus.drives {
            let Some((address, place)) = &drive.address else {
                continue;
            };
            match seen.get(address) {
                Some(owner) => document.problem(
                    place,
                    format!("address {address} already belongs to {owner} on this bus"),
                    "give each drive of a bus its own address",
                ),
                None => {
                    seen.insert(*address, owner(drive));
                }
            }
        }
    }
}

/// ``drive `pump-1` (line 12)``.
fn owner(drive: &super::drive::Found) -> String {
    match &drive.name {
        Some((name, place)) => format!("drive `{name}`{}", line(place)),
        None => "another drive".to_string(),
    }
}

/// A unit id identifies one drive on each listener. `selections` are the buses that each shows, `None` for all.
pub(super) fn check_units(document: &Document, buses: &[Found], selections: &[Option<Vec<String>>]) {
    let mut reported: Vec<(Option<usize>, u8)> = Vec::new();
    for selection in selections {
        let is_shown = |bus: &Found| match (selection, &bus.name) {
            (Some(names), Some((name, _))) => names.contains(name),
            (Some(_), None) => false,
            (None, _) => true,
        };
        let drives = || {
            let shown = buses.iter().enumerate().filter(|(_, bus)| is_shown(bus));
            shown.flat_map(|(index, bus)| bus.drives.iter().map(move |drive| (index, drive)))
        };
        let mut used: Vec<u8> = drives()
            .filter_map(|(_, d)| d.unit.as_ref())
            .map(|(unit, _)| *unit)
            .collect();
        let mut seen: BTreeMap<u8, (usize, &super::drive::Found)> = BTreeMap::new();
        for (bus, drive) in drives() {
            let Some((unit, place)) = &drive.unit else { continue };
            let Some((other_bus, other)) = seen.get(unit) else {
                seen.insert(*unit, (bus, drive));
                continue;
            };
            // Two drives with one address on a bus are reported as that error instead.
            if bus == *other_bus && drive.unit_is_address && other.unit_is_address {
                continue;
            }
            let first = owner(other);
            // A conflict that two listeners share is reported once.
            if place.line.is_some() && reported.contains(&(place.line, *unit)) {
                continue;
            }
            reported.push((place.line, *unit));
            let remedy = match (1..=254).find(|unit| !used.contains(unit)) {
                Some(free) => {
                    used.push(free);
                    format!(
                        "write unit = {free}, or another free one, or give each bus its own [[modbus_tcp.listener]]"
                    )
                }
                None => {
                    "all 254 units are taken: give each bus its own [[modbus_tcp.listener]], or use a second gateway"
                        .to_string()
                }
            };
            document.problem(place, format!("unit {unit} already belongs to {first}"), remedy);
        }
    }
}

/// Two servers cannot listen on one address; `0.0.0.0` and `[::]` use the port on every address.
pub(super) fn check_listeners<'a>(document: &Document, listeners: impl Iterator<Item = &'a Listener>) {
    let mut seen: Vec<&Listener> = Vec::new();
    for listener in listeners {
        let (address, place) = listener;
        if let Some((other, first)) = seen.iter().find(|(other, _)| collide(*other, *address)) {
            document.problem(
                place,
                format!("{address} collides with {other} of {}{}", first.key, line(first)),
                "give each server its own port",
            );
        }
        seen.push(listener);
    }
}

fn collide(one: SocketAddr, other: SocketAddr) -> bool {
    let everywhere = |a: SocketAddr, b: SocketAddr| a.ip().is_unspecified() && (a.is_ipv6() || b.is_ipv4());
    one.port() == other.port()
        && one.port() != 0
        && (one.ip() == other.ip() || everywhere(one, other) || everywhere(other, one))
}

/// Checks that each `default_drive` is a drive of a bus that its listener shows.
pub(super) fn check_default_drives(document: &Document, buses: &[Found], wanted: &[DefaultDrive]) {
    for (name, place, shown) in wanted {
        let is_shown = |bus: &&Found| match (shown, &bus.name) {
            (Some(shown), Some((bus, _))) => shown.contains(bus),
            _ => true,
        };
        let names = buses.iter().filter(is_shown).flat_map(|bus| &bus.drives);
        let names = names.filter_map(|drive| drive.name.as_ref().map(|(name, _)| name.as_str()));
        let known: Vec<&str> = names.collect();
        if !known.contains(&name.as_str()) {
            let near = nearest(name, known.iter().copied());
            let remedy = near.map_or_else(
                || "write the name of a drive on a bus that the listener shows".to_string(),
                |near| format!("did you mean `{near}`?"),
            );
            document.problem(place, format!("the listener shows no drive `{name}`"), remedy);
        }
    }
}
