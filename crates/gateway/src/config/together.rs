//! Errors and warnings about combinations of sections.

use std::time::Duration;

use super::keys::{DRIVE, ROOT};
use super::{bacnet, bus, drive, http, interlocks, modbus_tcp, unique};
use drivegate_core::process_image::{Access, LeaseAction};
use drivegate_model::document::{Finding, Place, Reader};

/// The sections by which clients reach the drives.
pub(super) struct Clients<'c> {
    pub(super) modbus_tcp: Option<&'c modbus_tcp::ModbusTcp>,
    pub(super) mqtt: Option<&'c Option<drivegate_mqtt::Options>>,
    pub(super) http: Option<&'c http::Http>,
    pub(super) bacnet: Option<&'c bacnet::Bacnet>,
}

/// Checks combinations of sections.
pub(super) fn judge(reader: &Reader<'_>, buses: &[bus::Found], clients: &Clients<'_>) {
    let Clients {
        modbus_tcp,
        mqtt,
        http,
        bacnet,
    } = *clients;
    unique::check(reader.document(), buses);
    interlocks::check(reader.document(), buses);
    // Without Modbus TCP unit ids are not used, and a gateway may have more drives than unit ids exist.
    if let Some(modbus_tcp) = modbus_tcp {
        unique::check_units(reader.document(), buses, &modbus_tcp.selections);
        unique::check_default_drives(reader.document(), buses, &modbus_tcp.default_drives);
    }
    if let Some(bacnet) = bacnet {
        bacnet::check_instances(reader, buses, bacnet);
    }
    let http_listener = http.and_then(|http| http.listener.as_ref());
    let listeners = modbus_tcp.into_iter().flat_map(|m| &m.addresses).chain(http_listener);
    let slots = || buses.iter().flat_map(|bus| &bus.slots);
    let listeners = listeners.chain(slots().flat_map(|slot| &slot.listeners));
    unique::check_listeners(reader.document(), listeners);
    if mqtt.is_some_and(|m| m.as_ref().is_some_and(|m| m.commands && m.home_assistant.is_some())) {
        check_numbers_of_home_assistant(reader, buses);
    }
    warn_of_emptiness(reader);
    let commanded = modbus_tcp.is_some_and(|m| m.commands)
        || mqtt.is_some_and(|m| m.as_ref().is_none_or(|m| m.commands))
        || http.is_some_and(|http| http.commands)
        || bacnet.is_some_and(|bacnet| bacnet.commands)
        || slots().any(|slot| slot.writes);
    if !commanded {
        warn_of_idle_control(reader, buses);
    }
    if reader.document().is_sound() {
        // If there are errors, a default may have replaced a wrong value, or an unknown key be the misspelled one:
        // a warning about that would be misleading.
        if commanded {
            warn_of_missing_leases(reader, buses);
        }
        warn_of_idle_stops(reader, buses);
        warn_of_long_shutdowns(reader, buses);
        warn_of_refreshes(reader, buses);
        warn_of_cadence(reader, buses);
    }
}

/// Refuses limits whose lowest value equals the highest: Home Assistant would refuse the whole drive because of them.
fn check_numbers_of_home_assistant(reader: &Reader<'_>, buses: &[bus::Found]) {
    for drive in buses.iter().flat_map(|bus| &bus.drives) {
        let Some(spec) = drive.spec.as_ref().filter(|_| drive.access.0 == Access::Control) else {
            continue;
        };
        for (point, range) in spec.limits.iter().filter(|(_, range)| range.start() == range.end()) {
            let only = range.start();
            reader.document().problem(
                &drive.limits,
                format!("the limits of `{point}` allow only {only}, and Home Assistant accepts no such number"),
                "write a range, access = \"monitor\", or home_assistant = false",
            );
        }
    }
}

fn warn_of_emptiness(reader: &Reader<'_>) {
    let of_file = |key: &str| Place {
        key: key.to_string(),
        ..Place::default()
    };
    if !reader.has(ROOT.bus.name) {
        reader.document().warning(
            &of_file(ROOT.bus.name),
            "the configuration has no bus, so nothing is read",
            "add a [[bus]] with its drives",
        );
    }
    let servers = [ROOT.modbus_tcp.name, ROOT.mqtt.name, ROOT.http.name, ROOT.bacnet.name];
    if !servers.iter().any(|server| reader.has(server)) {
        reader.document().warning(
            &of_file(""),
            "no server is configured, so no client can see the drives",
            "add [modbus_tcp], [mqtt], [http] or [bacnet]",
        );
    }
}

/// Cadences that the line cannot carry.
fn warn_of_cadence(reader: &Reader<'_>, buses: &[bus::Found]) {
    for found in buses {
        let Some(settings) = &found.settings else { continue };
        let prediction = settings.predict();
        if let Some(shortage) = &prediction.shortage {
            let (fast, slow) = &found.cadence;
            let place = if shortage.fast.is_some() { fast } else { slow };
            let Finding { what, remedy } = shortage.finding();
            reader.document().warning(place, what, remedy);
        }
        if let Some(refreshes) = &prediction.late_refreshes {
            let first = refreshes.drives.first().and_then(|place| found.drives.get(*place));
            let place = first.map_or(&found.cadence.0, refresh_place);
            let Finding { what, remedy } = refreshes.finding();
            reader.document().warning(place, what, remedy);
        }
        warn_of_fault_time(reader, found, prediction.fast_cycle);
    }
}

/// Interval between polls from which on a drive may assume that its master is silent. The manual's example is 1 s
/// [T 6.2]; the actual setting can only be read from the drive.
const FAULT_TIME: Duration = Duration::from_secs(1);

/// Warns about drives that may trip because they are polled too rarely.
fn warn_of_fault_time(reader: &Reader<'_>, found: &bus::Found, cycle: Option<Duration>) {
    let fault_time = drivegate_model::drive::COMMUNICATION_FAULT_TIME;
    let Some(cycle) = cycle.filter(|cycle| *cycle > FAULT_TIME / 2) else {
        return;
    };
    let drives = found.drives.iter().filter_map(|drive| drive.spec.as_ref());
    let Some(first) = drives
        .into_iter()
        .find(|spec| spec.profile.point_index(fault_time).is_some())
    else {
        return;
    };
    reader.document().warning(
        &found.cadence.0,
        format!(
            "each drive is polled every {:.2} s, and drive `{}` may trip on a communication fault if that is close to \
             its {fault_time}",
            cycle.as_secs_f64(),
            first.name
        ),
        "set that parameter (Cn-31 of a TECO 7300PA, 1 s in the manual's example) well above the cycle, or raise the \
         baud rate or reduce the number of drives",
    );
}

/// Stops at shutdown that take longer than the service manager waits.
fn warn_of_long_shutdowns(reader: &Reader<'_>, buses: &[bus::Found]) {
    for found in buses {
        let stops = found.drives.iter().find_map(|drive| drive.shutdown_stop.as_ref());
        let (Some(settings), Some(place)) = (&found.settings, stops) else {
            continue;
        };
        if let Some(Finding { what, remedy }) = settings.shutdown_time().beyond_unit(&settings.spec.name) {
            reader.document().warning(place, what, remedy);
        }
    }
}

/// Writes configured for drives that are only monitored.
fn warn_of_idle_stops(reader: &Reader<'_>, buses: &[bus::Found]) {
    for drive in buses.iter().flat_map(|bus| &bus.drives) {
        let (Some((name, _)), Access::Monitor) = (&drive.name, drive.access.0) else {
            continue;
        };
        let effects = [
            (
                &drive.lease,
                "it has no lease that could expire",
                DRIVE.supervision.name,
            ),
            (
                &drive.shutdown_stop,
                "it is not stopped at shutdown",
                DRIVE.on_shutdown.name,
            ),
        ];
        for (place, effect, key) in effects {
            let Some(place) = place else { continue };
            reader.document().warning(
                place,
                format!("drive `{name}` is only monitored, so nothing is ever written to it, and {effect}"),
                format!("set access = \"control\", or leave {key} out"),
            );
        }
    }
}

/// Drives that accept commands while no client may send any.
fn warn_of_idle_control(reader: &Reader<'_>, buses: &[bus::Found]) {
    for drive in buses.iter().flat_map(|bus| &bus.drives) {
        let (Some((name, _)), (Access::Control, place)) = (&drive.name, &drive.access) else {
            continue;
        };
        reader.document().warning(
            place,
            format!("drive `{name}` accepts commands but no client may send any"),
            "set `write` of [modbus_tcp], or `commands = true` of [mqtt], [http] or [bacnet]",
        );
    }
}

/// Warns about controlled drives that nothing stops when the commanding client goes silent.
fn warn_of_missing_leases(reader: &Reader<'_>, buses: &[bus::Found]) {
    for drive in buses.iter().flat_map(|bus| &bus.drives) {
        let (Some(spec), (Access::Control, place)) = (&drive.spec, &drive.access) else {
            continue;
        };
        if spec.supervision.is_some() {
            continue;
        }
        let known = [
            drivegate_model::drive::FIELDBUS_FAULT_RESPONSE,
            drivegate_model::drive::COMMUNICATION_TIMEOUT,
            drivegate_model::drive::COMMUNICATION_ERROR_REACTION,
        ];
        let known: Vec<&str> = known
            .into_iter()
            .filter(|p| spec.profile.point_index(p).is_some())
            .collect();
        let own = if !known.is_empty() {
            format!(
                "the drive's own response to a silent master ({}) may be off, and the gateway keeps polling",
                known.join(" and ")
            )
        } else if spec.profile.may_stop_by_itself {
            "whether the drive itself stops when its master goes silent cannot be read over this protocol".to_string()
        } else {
            "the profile has no parameter for the drive's own response to a silent master".to_string()
        };
        reader.document().warning(
            place,
            format!(
                "drive `{}` has no lease, so it keeps running if its client goes silent",
                spec.name
            ),
            format!("{own}; set supervision = {{ timeout = \"5s\", action = \"stop\" }}"),
        );
    }
}

/// Where the file turns the refresh of this drive on or off.
fn refresh_place(drive: &drive::Found) -> &Place {
    let lease = drive.refresh.as_ref().or(drive.lease.as_ref());
    lease.unwrap_or(&drive.access.1)
}

/// Warns about refreshes that end because of other settings, and about drives that need a refresh and have none.
fn warn_of_refreshes(reader: &Reader<'_>, buses: &[bus::Found]) {
    let key = DRIVE.refresh.name;
    for drive in buses.iter().flat_map(|bus| &bus.drives) {
        let (Some(spec), (Access::Control, _)) = (&drive.spec, &drive.access) else {
            continue;
        };
        let (name, place) = (&spec.name, refresh_place(drive));
        let needs = spec.profile.control.as_ref().and_then(|control| control.refresh);
        match (spec.refresh, &spec.supervision) {
            (None, lease) if needs.is_some() && spec.profile.repeats().is_ok() => {
                let remedy = match lease {
                    None => format!("add [bus.drive.supervision], which turns {key} on"),
                    Some(_) => format!("leave {key} out"),
                };
                reader.document().warning(
                    place,
                    format!(
                        "the own timeout of drive `{name}` counts only writes, and nothing is written between commands: \
                         where it is set, the drive trips"
                    ),
                    format!("{remedy}, or switch that timeout off, or let it count any request, if the drive can"),
                );
            }
            (Some(_), Some(supervision)) if supervision.action == LeaseAction::LeaveRunning => reader.document().warning(
                place,
                format!(
                    "{key} of drive `{name}` ends when its lease expires, and then the drive acts by its own timeout: action = \
                     \"hold\" keeps it running only until that"
                ),
                "write action = \"stop\" or { speed_reference = 20.0 }, or leave it if that is meant",
            ),
            (Some(every), Some(supervision)) if supervision.timeout <= every => reader.document().warning(
                place,
                format!("the lease of drive `{name}` expires before anything is written again ({key})"),
                format!("set {key} below half of the timeout of supervision"),
            ),
            _ => {}
        }
    }
}
