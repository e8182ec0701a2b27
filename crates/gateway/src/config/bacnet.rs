//! Reads the section `[bacnet]`.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::path::Path;

use super::bus::Found;
use super::keys::{BACNET, DRIVE, Layout};
use super::settings::Unusable;
use super::{files, mqtt, values};
use drivegate_model::document::{Place, Reader};
use drivegate_north::bacnet::{Options, Secret};

/// Highest instance of a device.
const MAX_INSTANCE: u32 = 4_194_302;

/// The section `[bacnet]` as read.
pub(super) struct Bacnet {
    /// Absent when a part cannot be used, which is reported.
    pub(super) options: Option<Options>,
    device: (u32, Place),
    layout: Layout,
    buses: Option<Vec<String>>,
    /// Whether any client could write.
    pub(super) commands: bool,
}

/// Reads the section; `buses` are the names of buses that the section can select.
pub(super) fn read(reader: &Reader<'_>, base: &Path, state_dir: &Path, buses: &[&str]) -> Bacnet {
    let listen = BACNET.listen.read(reader).and_then(|listen| ipv4(reader, listen));
    let allow = BACNET.allow.get(reader);
    let write = BACNET.write.get(reader);
    let commands = BACNET.commands.get(reader);
    let device = BACNET.device.get(reader);
    let layout = BACNET.layout.get(reader);
    let network = BACNET.network.read(reader).map(|network| match layout {
        Layout::Routed => Some(network),
        Layout::Flat => None,
    });
    if layout == Layout::Flat {
        for key in [BACNET.network.name, BACNET.offline.name]
            .into_iter()
            .filter(|key| reader.has(key))
        {
            reader.problem(
                key,
                "layout = \"flat\" has no devices but the gateway's",
                "leave one of them out; a drive that is away shows communication failure",
            );
        }
    }
    let foreign_devices = BACNET.foreign_devices.get(reader);
    let vendor = BACNET.vendor.read(reader);
    let offline = BACNET.offline.get(reader);
    let keep_priorities = BACNET.keep_priorities.get(reader);
    let bbmd = BACNET.bbmd.get(reader);
    if foreign_devices > 0 && bbmd.is_some() {
        reader.problem(
            BACNET.foreign_devices.name,
            "a BBMD is not a foreign device of another one",
            "leave `bbmd` or `foreign_devices` out",
        );
    }
    let password = read_password(reader, base);
    let buses = read_buses(reader, buses);
    let is_open = listen.is_some_and(|listen| listen.ip().is_unspecified()) && !reader.has(BACNET.allow.name);
    if is_open {
        reader.problem(
            BACNET.listen.name,
            "0.0.0.0 receives from every network of this machine, and nothing limits who may read",
            "write `allow`, or the address of one interface",
        );
    }
    let options = listen.zip(network).zip(vendor).filter(|_| !is_open);
    let options = options.map(|((listen, network), vendor)| Options {
        listen,
        device,
        network,
        foreign_devices,
        offline,
        commands,
        allow,
        write,
        keep_priorities,
        bbmd,
        vendor,
        dcc_password: password.as_ref().ok().cloned().flatten(),
        buses: buses.clone(),
        state_dir: state_dir.to_path_buf(),
    });
    if let Some(options) = &options {
        warn(reader, options);
    }
    reader.finish();
    Bacnet {
        device: (device, BACNET.device.place(reader)),
        layout,
        commands: commands && options.as_ref().is_none_or(|options| !options.write.is_empty()),
        options: options.filter(|_| password.is_ok()),
        buses,
    }
}

fn ipv4(reader: &Reader<'_>, listen: SocketAddr) -> Option<SocketAddrV4> {
    match listen {
        SocketAddr::V4(listen) => Some(listen),
        SocketAddr::V6(_) => {
            let what = format!("{listen} is an IPv6 address, but BACnet/IP is served over IPv4 only");
            reader.problem(
                BACNET.listen.name,
                what,
                "write an IPv4 address, such as \"192.168.1.5:47808\"",
            );
            None
        }
    }
}

/// Reads the password; `None` if no file is configured.
fn read_password(reader: &Reader<'_>, base: &Path) -> Result<Option<Secret>, Unusable> {
    let key = &BACNET.dcc_password_file;
    let Some(file) = key.written(reader).filter(|file| !file.as_os_str().is_empty()) else {
        return Ok(None);
    };
    let path = values::resolved(base, file);
    files::warn_of_readers(reader, key.name, &path);
    let text = reader.accept(key.name, mqtt::secret(&path)).ok_or(Unusable)?;
    Ok(Some(Secret::new(text)))
}

/// The buses that are served; `None` for all buses.
fn read_buses(reader: &Reader<'_>, known: &[&str]) -> Option<Vec<String>> {
    let mut names = BACNET.buses.get(reader);
    let remedy = "write names of buses, or [] for all";
    values::known_buses(reader, BACNET.buses.name, &mut names, known, remedy);
    Some(names).filter(|names| !names.is_empty())
}

fn warn(reader: &Reader<'_>, options: &Options) {
    let (listen, allow, write) = (BACNET.listen.name, BACNET.allow.name, BACNET.write.name);
    for network in &options.write {
        if !options.allow.iter().any(|allowed| allowed.contains(network)) {
            let what = format!("{network} may write, but not all of it may read");
            reader.warning(write, what, "add it to `allow`");
        }
    }
    if options.commands && options.write.is_empty() {
        reader.warning(
            BACNET.commands.name,
            "commands are on, but no client may write",
            "add networks to `write`",
        );
    }
    if !options.commands && !options.write.is_empty() {
        reader.warning(
            write,
            "`commands` is off, so no client may write",
            "set commands = true, or leave `write` out",
        );
    }
    if options.keep_priorities && !options.commands {
        let what = "without `commands` there is nothing to keep";
        reader.warning(
            BACNET.keep_priorities.name,
            what,
            "set commands = true, or leave keep_priorities out",
        );
    }
    if options.listen.ip().is_loopback() {
        return;
    }
    let listening = options.listen;
    if options.commands && !options.write.is_empty() {
        reader.warning(
            listen,
            format!("{listening} can be reached from the network, and BACnet has no passwords: addresses in `write` command drives"),
            "keep `write` as narrow as possible, and BACnet on a network of its own",
        );
    }
    let only_here = options.allow.iter().all(|network| network.network().is_loopback());
    if only_here && listening.ip() != &Ipv4Addr::LOCALHOST {
        let what = format!("{listening} listens on the network, but `allow` admits no client from there");
        reader.warning(allow, what, "add the network to `allow`");
    }
}

/// Checks the device instances of drives, each the sum of the gateway's instance and the unit id: none may occur
/// twice or be too high.
pub(super) fn check_instances(reader: &Reader<'_>, buses: &[Found], bacnet: &Bacnet) {
    let (device, place) = &bacnet.device;
    let is_served = |bus: &&Found| match (&bacnet.buses, &bus.name) {
        (Some(names), Some((name, _))) => names.contains(name),
        _ => true,
    };
    let mut seen: BTreeMap<u8, &str> = BTreeMap::new();
    for drive in buses.iter().filter(is_served).flat_map(|bus| &bus.drives) {
        let (Some((unit, unit_place)), Some((name, _))) = (&drive.unit, &drive.name) else {
            continue;
        };
        if let Some(other) = seen.insert(*unit, name) {
            reader.document().problem(
                unit_place,
                match bacnet.layout {
                    Layout::Routed => format!(
                        "BACnet: drive `{name}` has the same device instance {} as drive `{other}`",
                        device + u32::from(*unit)
                    ),
                    Layout::Flat => {
                        format!("BACnet: drive `{name}` has the same objects as drive `{other}`, by its unit {unit}")
                    }
                },
                format!(
                    "give each its own `{}`, or serve fewer buses with `buses` of [bacnet]",
                    DRIVE.unit.name
                ),
            );
        }
        if bacnet.layout == Layout::Routed && device + u32::from(*unit) > MAX_INSTANCE {
            reader.document().problem(
                place,
                format!(
                    "the device instance of drive `{name}`, {} + {unit}, is above {MAX_INSTANCE}",
                    device
                ),
                "write a lower `device`",
            );
        }
    }
}
