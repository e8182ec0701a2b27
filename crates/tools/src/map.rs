//! `drivegate map`: the Modbus TCP register map of a configuration, for the SCADA engineer, or its BACnet objects.

pub(crate) mod bacnet;
mod export;
mod rows;
mod text;

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use self::rows::{Row, gateway_rows};
use super::failure::{Failure, Outcome};
use super::{default_config, report};
use drivegate_core::plant::{BusHandle, DriveHandle, Plant};
use drivegate_core::process_image::{BusImage, DriveImage, DriveSpec};
use drivegate_core::queue::CommandQueue;
use drivegate_gateway::config::{BusSettings, Settings};
use drivegate_north::modbus_tcp::{Role, View};

/// Prints the Modbus TCP register map of a configuration, or its BACnet objects, for the SCADA engineer.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate map --config /etc/drivegate/drivegate.toml --csv > registers.csv
  drivegate map --config /etc/drivegate/drivegate.toml --json --listener 127.0.0.1:1503
  drivegate map --config /etc/drivegate/drivegate.toml --bacnet --ede plant.csv")]
pub(super) struct Args {
    /// Configuration file
    #[arg(long, value_name = "FILE", default_value_os_t = default_config().to_path_buf())]
    config: PathBuf,
    /// Comma-separated values, one line for each register of each unit
    #[arg(long)]
    csv: bool,
    /// JSON: listeners, units and registers
    #[arg(long, conflicts_with = "csv")]
    json: bool,
    /// BACnet objects instead: device, object, name, type, unit, access
    #[arg(long, conflicts_with_all = ["json", "listener"])]
    bacnet: bool,
    /// Also write an EDE table to FILE, with the tables of state texts and units next to it
    #[arg(long, value_name = "FILE", requires = "bacnet")]
    ede: Option<PathBuf>,
    /// Only the units of the listener at this address
    #[arg(long, value_name = "ADDRESS")]
    listener: Option<SocketAddr>,
}

/// How the map is printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Text,
    Csv,
    Json,
}

/// Prints the register map.
pub(super) fn run(args: &Args) -> Outcome {
    let settings = super::settings(&args.config)?;
    if args.bacnet {
        return bacnet::run(&settings, args.csv, args.ede.as_deref());
    }
    let listeners = listeners(&settings);
    let view = match (args.listener, listeners.as_slice()) {
        (None, [only]) => only.view.clone(),
        (None, _) => View::default(),
        (Some(address), _) => match listeners.iter().find(|l| l.addresses.contains(&address)) {
            Some(listener) => listener.view.clone(),
            None => return Err(Failure::Misused(unknown_listener(address, &listeners))),
        },
    };
    let format = match (args.csv, args.json) {
        (true, _) => Format::Csv,
        (_, true) => Format::Json,
        _ => Format::Text,
    };
    let plant = plant(&settings).map_err(|why| format!("cannot build the map: {why}; map; free file descriptors"))?;
    Ok(report::print(&render(&plant, &listeners, &view, format)))
}

fn unknown_listener(address: SocketAddr, listeners: &[Listener]) -> String {
    let known: Vec<String> = listeners
        .iter()
        .flat_map(|l| &l.addresses)
        .map(ToString::to_string)
        .collect();
    let remedy = match known.as_slice() {
        [] => "add [modbus_tcp] to the configuration".to_string(),
        known => format!("write one of {}", known.join(", ")),
    };
    format!("nothing listens on {address}; --listener; {remedy}")
}

/// A listener of the Modbus TCP server.
#[derive(Debug, Clone, PartialEq)]
struct Listener {
    addresses: Vec<SocketAddr>,
    tls: bool,
    /// The register view that clients see.
    view: View,
    /// Clients that may write.
    writers: String,
}

fn listeners(settings: &Settings) -> Vec<Listener> {
    let Some(options) = &settings.modbus_tcp else {
        return Vec::new();
    };
    let joined = |words: Vec<String>| {
        if words.is_empty() {
            "nobody".to_string()
        } else {
            words.join(", ")
        }
    };
    let plain = options.listeners.iter().map(|listener| Listener {
        addresses: listener.listen.clone(),
        tls: false,
        view: listener.view.clone(),
        writers: joined(listener.write.iter().map(ToString::to_string).collect()),
    });
    let tls = options.tls.iter().map(|tls| {
        let control = tls.roles.iter().filter(|(_, role)| **role == Role::Control);
        Listener {
            addresses: tls.listen.clone(),
            tls: true,
            view: View {
                buses: tls.buses.clone(),
                ..View::default()
            },
            writers: joined(control.map(|(name, _)| format!("role {name}")).collect()),
        }
    });
    plain.chain(tls).collect()
}

/// The plant of a configuration, at rest.
fn plant(settings: &Settings) -> io::Result<Plant> {
    let bus = |bus: &BusSettings| {
        let drive = |spec: &DriveSpec| Arc::new(DriveImage::new(spec.clone(), bus.spec.slow_cycle));
        let drives = bus.drives.iter().map(drive).collect();
        let queue = CommandQueue::new()?;
        queue.set_authority(settings.authority.clone());
        let image = Arc::new(BusImage::new(bus.spec.clone(), drives));
        Ok(BusHandle::new(image, Arc::new(queue), Arc::default()))
    };
    Ok(Plant::new(
        settings.gateway.clone(),
        settings.stale_after.limit,
        settings.buses.iter().map(bus).collect::<io::Result<_>>()?,
    ))
}

/// The map that the clients of a listener see.
fn render(plant: &Plant, listeners: &[Listener], view: &View, format: Format) -> String {
    let shown = view.buses.as_deref();
    let drives = plant
        .drives()
        .filter(|d| shown.is_none_or(|names| names.contains(&d.image.spec.bus)))
        .collect();
    let gateway = match view.default_drive {
        None => gateway_rows(plant, shown),
        Some(_) => Vec::new(),
    };
    let map = Map {
        plant,
        drives,
        gateway,
        listeners,
        view,
    };
    match format {
        Format::Text => text::render(&map),
        Format::Csv => export::csv(&map),
        Format::Json => export::json(&map),
    }
}

/// The printed map.
struct Map<'a> {
    plant: &'a Plant,
    drives: Vec<DriveHandle>,
    /// Registers of the gateway itself.
    gateway: Vec<Row>,
    listeners: &'a [Listener],
    view: &'a View,
}

#[cfg(test)]
mod tests;
