//! Reads `[[bus]]`: the line and its drives.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use super::drive::{self, Surroundings};
use super::keys::{BUS, RESERVED};
use super::settings::BusSettings;
use super::{line, port, slot};
use drivegate_bus::predict::faster_points;
use drivegate_bus::{BusOptions, Mode};
use drivegate_core::process_image::{Access, BusSpec, DriveSpec, is_modbus_tcp};
use drivegate_model::document::{Finding, Place, Reader, format_duration};
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::wire::Silence;
use drivegate_proto::{LineFormat, Protocol, n2};

/// `response_timeout` above which a warning is given.
const LONG_TIMEOUT: Duration = Duration::from_secs(1);

/// The valid settings of a `[[bus]]`.
pub(super) struct Found {
    pub(super) name: Option<(String, Place)>,
    pub(super) port: Option<(String, Place)>,
    pub(super) drives: Vec<drive::Found>,
    pub(super) settings: Option<BusSettings>,
    pub(super) slots: Vec<slot::Found>,
    /// Places of `cycle` and `slow_cycle`.
    pub(super) cadence: (Place, Place),
}

pub(super) fn read(reader: &Reader<'_>, base: &Path, profiles: &Profiles, faulty: &BTreeSet<String>) -> Found {
    let name = BUS.name.placed(reader);
    let port = BUS.port.read(reader);
    let port = port.and_then(|text| reader.accept(BUS.port.name, port::check(&text, base)));
    let is_modbus_tcp = port.as_deref().is_some_and(is_modbus_tcp);
    // A wrong protocol is an error already; the rest is checked as for the default.
    let protocol = BUS.protocol.read(reader).unwrap_or(Protocol::ModbusRtu);
    if let Some(port) = &port {
        port::check_keys(reader, port, protocol);
    }
    let format = if is_modbus_tcp {
        Some(LineFormat::NETWORK)
    } else {
        read_format(reader, protocol)
    };
    let (cycle, slow_cycle) = read_cadence(reader);
    let options = read_options(reader, protocol, format.as_ref(), port.as_deref());
    let around = Surroundings {
        bus: name.as_ref().map_or("", |(name, _)| name),
        protocol,
        is_modbus_tcp,
        profiles,
        faulty,
    };
    let tables = BUS.drive.tables(reader);
    if !reader.has(BUS.drive.name) {
        reader.warning(BUS.drive.name, "the bus has no drive", "write [[bus.drive]] for each");
    }
    let drives: Vec<drive::Found> = tables.iter().map(|table| drive::read(table, &around)).collect();
    if options.mode == Mode::Listen {
        check_listening(reader, &drives);
    }
    check_only_one(reader, &drives, protocol, is_modbus_tcp);
    if protocol == Protocol::N2 {
        check_numbers(reader, &drives, options.mode);
    }
    if let Some(port) = &port {
        port::check_dial_in(reader, port, &drives);
    }
    let slots = slot::read(
        reader,
        base,
        &slot::Surroundings {
            bus: name.as_ref().map(|(name, _)| name.as_str()),
            protocol,
            format,
            mode: options.mode,
            drives: drives.iter().map(|drive| drive.access.0).collect(),
        },
    );
    reader.finish();
    let access = |mut spec: DriveSpec| {
        if options.mode == Mode::Listen {
            (spec.access, spec.refresh) = (Access::Listen, None);
        }
        spec
    };
    let specs = drives.iter().map(|d| d.spec.clone().map(access));
    let specs: Option<Vec<DriveSpec>> = specs.collect();
    let settings = match (&name, &port, format, specs) {
        (Some((name, _)), Some(port), Some(format), Some(drives)) => {
            check_fit(reader, &format, &options, &drives);
            let spec = BusSpec {
                name: name.clone(),
                port: port.clone(),
                protocol,
                format,
                cycle,
                slow_cycle,
            };
            let asks = options.mode == Mode::Master;
            let faster = asks.then(|| faster_points(&spec, options.silence, &drives)).flatten();
            let drives = faster.unwrap_or(drives);
            Some(BusSettings { spec, options, drives })
        }
        _ => None,
    };
    Found {
        port: port.map(|port| (port, BUS.port.place(reader))),
        cadence: (BUS.cycle.place(reader), BUS.slow_cycle.place(reader)),
        name,
        drives,
        settings,
        slots,
    }
}

fn read_cadence(reader: &Reader<'_>) -> (Duration, Duration) {
    let (cycle, slow_cycle) = (BUS.cycle.get(reader), BUS.slow_cycle.get(reader));
    if slow_cycle < cycle {
        let [slow, fast] = [slow_cycle, cycle].map(format_duration);
        reader.warning(
            BUS.slow_cycle.name,
            format!("slow_cycle = {slow} is shorter than cycle = {fast}"),
            "swap them or raise slow_cycle",
        );
    }
    (cycle, slow_cycle)
}

fn read_options(
    reader: &Reader<'_>,
    protocol: Protocol,
    format: Option<&LineFormat>,
    port: Option<&str>,
) -> BusOptions {
    let options = BusOptions {
        response_timeout: BUS.response_timeout.get_on(reader, protocol),
        retries: BUS.retries.get_on(reader, protocol),
        silence: match format {
            Some(&LineFormat::NETWORK) => Silence::Fixed(Duration::ZERO),
            _ => read_silence(reader, protocol, format),
        },
        line: line::read(reader, port),
        mode: BUS.mode.get(reader),
        allow: BUS.allow.get(reader),
    };
    if options.response_timeout > LONG_TIMEOUT {
        let [timeout, limit] = [options.response_timeout, LONG_TIMEOUT].map(format_duration);
        reader.warning(
            BUS.response_timeout.name,
            format!("each attempt to reach an absent drive takes the line for {timeout}"),
            format!(
                "write {limit} or less; drives start their replies within milliseconds, device servers within 0.5 s"
            ),
        );
    }
    options
}

/// Requests of another master on an N2 line are read by the numbers of the maps, which drives that count from 0 do not
/// have.
fn check_numbers(reader: &Reader<'_>, drives: &[drive::Found], mode: Mode) {
    let from_zero = |drive: &&drive::Found| {
        drive
            .spec
            .as_ref()
            .is_some_and(|spec| spec.profile.n2.first_object == 0)
    };
    let Some(drive) = drives.iter().find(from_zero) else {
        return;
    };
    let name = drive.name.as_ref().map_or("?", |(name, _)| name);
    let keys = [
        (BUS.slot.name, reader.has(BUS.slot.name)),
        (BUS.mode.name, mode == Mode::Listen),
    ];
    for (key, _) in keys.iter().filter(|(_, is)| *is) {
        reader.problem(
            key,
            format!("drive `{name}` counts its objects from 0 (first_object), which is known for the gateway's own requests only"),
            format!("leave `{key}` out"),
        );
    }
}

/// Address 248 is reserved; devices that answer at any address treat it as their own.
fn check_only_one(reader: &Reader<'_>, drives: &[drive::Found], protocol: Protocol, is_modbus_tcp: bool) {
    if protocol == Protocol::N2 || is_modbus_tcp {
        return;
    }
    let addresses = drives.iter().filter_map(|drive| drive.address.as_ref());
    for (_, place) in addresses.filter(|(address, _)| *address == RESERVED) {
        if drives.len() == 1 {
            reader.document().warning(
                place,
                "address 248 is reserved by the Modbus specification; some devices answer at it whatever their address is",
                "write the address of the device, 1 to 247, if it has one",
            );
        } else {
            reader.document().problem(
                place,
                "a device that answers at address 248 answers at every address, so it must be the only one on its line",
                "write an address from 1 to 247, or put the device on a bus of its own",
            );
        }
    }
}

/// A key that needs a frame of the gateway on a line where it sends none is an error; a key that only sets how it would
/// poll has no effect.
fn check_listening(reader: &Reader<'_>, drives: &[drive::Found]) {
    for drive in drives {
        let name = drive.name.as_ref().map_or("?", |(name, _)| name);
        let control = (drive.access.0 == Access::Control).then_some(&drive.access.1);
        let wishes = [
            (control, "access = \"control\"", "access"),
            (drive.lease.as_ref(), "supervision", "supervision"),
            (drive.shutdown_stop.as_ref(), "on_shutdown = \"stop\"", "on_shutdown"),
            (drive.refresh.as_ref(), "refresh", "refresh"),
        ];
        for (place, wish, key) in wishes {
            let Some(place) = place else { continue };
            reader.document().problem(
                place,
                format!(
                    "`{wish}` of drive `{name}` needs a gateway that writes, but this bus only listens (mode = \
                         \"listen\")"
                ),
                format!("leave {key} out, or make the gateway the only master of the line and write mode = \"master\""),
            );
        }
    }
    let keys = [
        BUS.cycle.name,
        BUS.slow_cycle.name,
        BUS.response_timeout.name,
        BUS.silence.name,
        BUS.rs485.name,
        BUS.rts.name,
        BUS.spin.name,
    ];
    for key in keys.into_iter().filter(|key| reader.has(key)) {
        reader.warning(
            key,
            format!("`{key}` has no effect on a bus that only listens: the gateway sends nothing and leaves RTS low"),
            "leave the key out",
        );
    }
}

fn read_format(reader: &Reader<'_>, protocol: Protocol) -> Option<LineFormat> {
    let key = BUS.format.name;
    let baud = BUS.baud.get(reader);
    let text = BUS.format.read_on(reader, protocol)?;
    let format = LineFormat::new(baud, &text).map_err(|_| {
        Finding::new(
            format!("`{text}` is not a character format"),
            "write data bits 7 or 8, parity N, E or O, stop bits 1 or 2, such as 8N1",
        )
    });
    let format = reader.accept(key, format)?;
    if protocol == Protocol::N2 && !protocol.allows(&format) {
        let key = if format.baud == n2::BAUD { key } else { BUS.baud.name };
        reader.problem(
            key,
            format!("N2 is always {} {}, not {format}", n2::BAUD, n2::FORMAT),
            "leave `baud` and `format` out",
        );
    }
    if protocol == Protocol::ModbusRtu && format.data_bits != 8 {
        reader.problem(
            key,
            "Modbus RTU needs 8 data bits",
            "write for example \"8N1\" or \"8E1\"",
        );
    }
    if protocol == Protocol::ModbusAscii && format.bits_per_char() < 10 {
        reader.warning(
            key,
            "characters of 9 bits: Modbus ASCII drives use 10, with two stop bits if there is no parity",
            "write \"7N2\"",
        );
    }
    Some(format)
}

fn read_silence(reader: &Reader<'_>, protocol: Protocol, format: Option<&LineFormat>) -> Silence {
    let silence = BUS.silence.get(reader);
    if let (Protocol::ModbusRtu, Silence::Fixed(time), Some(format)) = (protocol, silence, format)
        && time < format.silence_chars()
    {
        let [time, least] = [time, format.silence_chars()].map(format_duration);
        reader.warning(
            BUS.silence.name,
            format!("{time} is less than 3.5 characters at {format}, so drives may mistake two frames for one"),
            format!("write \"chars\", or {least} or more"),
        );
    }
    silence
}

/// A character format that the families on the line do not list. A drive that counts in longer characters takes requests
/// for coming too early, and ignores some.
fn check_format(reader: &Reader<'_>, format: &LineFormat, drives: &[DriveSpec]) {
    let characters = format.characters();
    let mut reported: Vec<&str> = Vec::new();
    for profile in drives.iter().map(|drive| &drive.profile) {
        let Some(usual) = profile.formats.first() else { continue };
        if profile.formats.contains(&characters) || reported.contains(&profile.name.as_str()) {
            continue;
        }
        reported.push(&profile.name);
        reader.warning(
            BUS.format.name,
            format!("profile `{}` does not list the format {characters}", profile.name),
            format!(
                "write format = \"{usual}\", or what is set on the drives; the profile lists {}",
                profile.formats.join(", ")
            ),
        );
    }
}

/// Warns about valid settings that suit the drives badly.
fn check_fit(reader: &Reader<'_>, format: &LineFormat, options: &BusOptions, drives: &[DriveSpec]) {
    let mut reported: Vec<&str> = Vec::new();
    if *format != LineFormat::NETWORK {
        check_format(reader, format, drives);
    }
    for drive in drives {
        let profile = &drive.profile;
        let listed = profile.bauds.is_empty() || profile.bauds.contains(&format.baud) || *format == LineFormat::NETWORK;
        if !listed && !reported.contains(&profile.name.as_str()) {
            reported.push(&profile.name);
            let bauds: Vec<String> = profile.bauds.iter().map(u32::to_string).collect();
            reader.warning(
                BUS.baud.name,
                format!("profile `{}` does not list {} baud", profile.name, format.baud),
                format!("check the drives; the profile lists {}", bauds.join(", ")),
            );
        }
        let timeout = drive.timing.response_timeout.unwrap_or(options.response_timeout);
        if drive.turnaround >= timeout {
            let [turnaround, timeout] = [drive.turnaround, timeout].map(format_duration);
            reader.warning(
                BUS.response_timeout.name,
                format!(
                    "drive `{}` takes {turnaround} to start its reply, but response_timeout is {timeout}",
                    drive.name
                ),
                "raise response_timeout of the bus or of the drive",
            );
        }
    }
}
