//! `drivegate map`: the Modbus TCP register map of a configuration, for the SCADA engineer.

use std::fmt::Write as _;
use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use comfy_table::{Table as TextTable, presets};

use super::{DEFAULT_CONFIG, EXIT_CONFIG, EXIT_FAILED, EXIT_USAGE, report};
use crate::cache::{Access, BusImage, DriveImage, DriveSpec};
use crate::codec::Table;
use crate::command::CommandQueue;
use crate::config::{BusSettings, Settings, environment};
use crate::drive::profile::{Form as RawForm, Raw};
use crate::drive::{ModelPoint, Plan, Point, Profile};
use crate::north::modbus_tcp::Role;
use crate::north::register_map::{BLOCKS, BUS_BLOCK, BUS_REGISTERS, Content, Entry, GATEWAY_UNIT};
use crate::plant::{BusHandle, DriveHandle, Plant};

mod export;

/// Prints the Modbus TCP register map of a configuration, for the SCADA engineer.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  drivegate map --config /etc/drivegate/drivegate.toml --csv > registers.csv
  drivegate map --config /etc/drivegate/drivegate.toml --json --listener 127.0.0.1:1503")]
pub(super) struct Args {
    /// Configuration file
    #[arg(long, value_name = "FILE", default_value = DEFAULT_CONFIG)]
    config: PathBuf,
    /// Comma-separated values, one line for each register of each unit
    #[arg(long)]
    csv: bool,
    /// JSON: listeners, units and registers
    #[arg(long, conflicts_with = "csv")]
    json: bool,
    /// Only what the listener at this address shows
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

/// One line of the map.
#[derive(Debug, Clone, PartialEq)]
struct Row {
    view: &'static str,
    /// `holding`, `input`, `holding, input`, `coil`, `discrete-input`.
    table: &'static str,
    address: u16,
    /// The address as many SCADA systems write it: table digit and number from 1.
    reference: String,
    items: u16,
    name: String,
    kind: String,
    scale: String,
    unit: String,
    not_available: &'static str,
    access: &'static str,
    /// Where the value comes from, or a write goes to.
    source: String,
    note: String,
}

const COLUMNS: [&str; 14] = [
    "view",
    "table",
    "address",
    "hex",
    "reference",
    "registers",
    "name",
    "type",
    "scale",
    "engineering_unit",
    "not_available",
    "access",
    "source",
    "note",
];

impl Row {
    fn cells(&self) -> [String; COLUMNS.len()] {
        [
            self.view.to_string(),
            self.table.to_string(),
            self.address.to_string(),
            format!("0x{:04X}", self.address),
            self.reference.clone(),
            self.items.to_string(),
            self.name.clone(),
            self.kind.clone(),
            self.scale.clone(),
            self.unit.clone(),
            self.not_available.to_string(),
            self.access.to_string(),
            self.source.clone(),
            self.note.clone(),
        ]
    }
}

/// Prints the map.
pub(super) fn run(args: &Args) -> ExitCode {
    let loaded = Settings::load(&args.config, environment());
    report::errors(&loaded.errors);
    let Some(settings) = loaded.settings else {
        return ExitCode::from(EXIT_CONFIG);
    };
    let listeners = listeners(&settings);
    let shown = match args.listener {
        None => None,
        Some(address) => match listeners.iter().find(|l| l.addresses.contains(&address)) {
            Some(listener) => listener.buses.clone(),
            None => return unknown_listener(address, &listeners),
        },
    };
    let format = match (args.csv, args.json) {
        (true, _) => Format::Csv,
        (_, true) => Format::Json,
        _ => Format::Text,
    };
    match plant(&settings) {
        Ok(plant) => report::print(&render(&plant, &listeners, shown.as_deref(), format)),
        Err(why) => {
            report::error(&format!("cannot lay out the map: {why}; map; free file descriptors"));
            ExitCode::from(EXIT_FAILED)
        }
    }
}

fn unknown_listener(address: SocketAddr, listeners: &[Listener]) -> ExitCode {
    let known: Vec<String> = listeners
        .iter()
        .flat_map(|l| &l.addresses)
        .map(ToString::to_string)
        .collect();
    let remedy = match known.as_slice() {
        [] => "write [modbus_tcp] into the configuration".to_string(),
        known => format!("write one of {}", known.join(", ")),
    };
    report::error(&format!("nothing listens on {address}; --listener; {remedy}"));
    ExitCode::from(EXIT_USAGE)
}

/// A listener of the Modbus TCP server.
#[derive(Debug, Clone, PartialEq)]
struct Listener {
    addresses: Vec<SocketAddr>,
    tls: bool,
    /// Buses that are shown; `None` shows all.
    buses: Option<Vec<String>>,
    /// Who may write.
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
        buses: listener.buses.clone(),
        writers: joined(listener.write.iter().map(ToString::to_string).collect()),
    });
    let tls = options.tls.iter().map(|tls| {
        let control = tls.roles.iter().filter(|(_, role)| **role == Role::Control);
        Listener {
            addresses: tls.listen.clone(),
            tls: true,
            buses: tls.buses.clone(),
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
        Ok(BusHandle {
            image: Arc::new(BusImage::new(bus.spec.clone(), drives)),
            queue: Arc::new(CommandQueue::new()?),
        })
    };
    Ok(Plant {
        gateway: settings.gateway.clone(),
        stale_after: settings.stale_after,
        buses: settings.buses.iter().map(bus).collect::<io::Result<_>>()?,
        events: Default::default(),
        writes: Default::default(),
    })
}

/// The map of the units on the buses that are `shown`, all without a choice.
fn render(plant: &Plant, listeners: &[Listener], shown: Option<&[String]>, format: Format) -> String {
    let drives = plant
        .drives()
        .filter(|d| shown.is_none_or(|names| names.contains(&d.image.spec.bus)))
        .collect();
    let map = Map {
        plant,
        drives,
        gateway: gateway_rows(plant, shown),
        listeners,
    };
    match format {
        Format::Text => render_text(&map),
        Format::Csv => export::csv(&map),
        Format::Json => export::json(&map),
    }
}

/// What is printed.
struct Map<'a> {
    plant: &'a Plant,
    drives: Vec<DriveHandle>,
    /// Registers of the gateway itself.
    gateway: Vec<Row>,
    listeners: &'a [Listener],
}

fn render_text(map: &Map<'_>) -> String {
    let (plant, drives) = (map.plant, &map.drives);
    let specs: Vec<&DriveSpec> = drives.iter().map(|d| &d.image.spec).collect();
    let mut out = format!("Modbus TCP register map of {}\n\nUnits\n", plant.gateway);
    let units = specs.iter().map(|s| {
        let access = match s.access {
            Access::Monitor => "monitor: every write is refused",
            Access::Control => "control",
        };
        let address = s.address.to_string();
        vec![
            s.unit.to_string(),
            s.name.clone(),
            s.bus.clone(),
            address,
            s.profile.name.clone(),
            access.to_string(),
        ]
    });
    let gateway = vec![GATEWAY_UNIT.to_string(), "the gateway itself".to_string()];
    out += &table(
        &["unit", "drive", "bus", "address", "profile", "access"],
        units.chain([gateway]),
    );
    if map.listeners.len() > 1 {
        out += "\nListeners\n";
        let cells = map.listeners.iter().map(|listener| {
            let addresses: Vec<String> = listener.addresses.iter().map(ToString::to_string).collect();
            let buses = listener
                .buses
                .as_ref()
                .map_or_else(|| "all".to_string(), |names| names.join(", "));
            let tls = if listener.tls { "yes" } else { "no" };
            vec![addresses.join(", "), tls.to_string(), buses, listener.writers.clone()]
        });
        out += &table(&["address", "TLS", "buses", "who may write"], cells);
    }
    out += "\nAddresses are PDU addresses, from 0. Functions 03 and 04 read both tables of the blocks from 0x8000 on;\n\
            32-bit values lie high word first; age and state tell why a value is not available.\n";
    let mut seen: Vec<&str> = Vec::new();
    for drive in drives {
        let profile = &drive.image.spec.profile;
        if seen.contains(&profile.name.as_str()) {
            continue;
        }
        seen.push(&profile.name);
        let units: Vec<String> = specs
            .iter()
            .filter(|s| s.profile.name == profile.name)
            .map(|s| s.unit.to_string())
            .collect();
        let _ = write!(
            out,
            "\nProfile {} ({}), units {}\n",
            profile.name,
            profile.title,
            units.join(", ")
        );
        // What a unit of this profile can have; the table above tells which units take writes.
        out += &rows(&drive_rows(profile, &drive.image.plan, Access::Control));
        let _ = write!(out, "\nAddresses of the drive itself, profile {}\n", profile.name);
        out += &ranges(profile);
    }
    out += "\nThe gateway itself, unit 255\n";
    out += &rows(&map.gateway);
    out
}

fn rows(rows: &[Row]) -> String {
    table(&COLUMNS, rows.iter().map(|r| r.cells().to_vec()))
}

fn table(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let mut table = TextTable::new();
    table
        .load_preset(presets::NOTHING)
        .set_header(header.iter().map(|h| h.replace('_', " ")));
    table.add_rows(rows);
    let mut out: String = table.trim_fmt();
    out.push('\n');
    out
}

fn drive_rows(profile: &Profile, plan: &Plan, access: Access) -> Vec<Row> {
    let entries = BLOCKS
        .into_iter()
        .flatten()
        .map(|entry| entry_row(profile, plan, entry, access));
    let mut raw: Vec<(&Point, &Raw)> = profile.points.iter().filter_map(|p| Some((p, p.raw()?))).collect();
    raw.sort_by_key(|(_, raw)| (raw.table, raw.address));
    let raw = raw
        .into_iter()
        .map(|(point, raw)| raw_row(profile, plan, point, raw, access));
    entries.chain(raw).collect()
}

/// What the raw view reaches beside the points.
fn ranges(profile: &Profile) -> String {
    let header = ["table", "first", "last", "read at once", "written at once", "note"];
    let rows = profile.ranges.iter().map(|range| {
        let table = match range.table {
            Table::Holding if profile.input_is_holding => "holding, input",
            table => table.name(),
        };
        let written = if range.write == 0 {
            "read only".to_string()
        } else {
            range.write.to_string()
        };
        let (first, last) = range.addresses.clone().into_inner();
        let note = range.note.clone();
        vec![
            table.to_string(),
            first.to_string(),
            last.to_string(),
            range.read.to_string(),
            written,
            note,
        ]
    });
    table(&header, rows)
}

fn entry_row(profile: &Profile, plan: &Plan, entry: &Entry, access: Access) -> Row {
    let (name, unit, mut note) = match entry.content {
        Content::Status => (
            "status",
            "",
            "bits: 0 ready, 1 running, 2 reversed, 3 fault, 4 warning, 5 at_reference, 6 zero_speed, 7 remote, \
             14 stale, 15 online",
        ),
        Content::State => ("state", "", "0 offline, 1 not_ready, 2 ready, 3 running, 4 fault"),
        Content::Age => ("age", "ms", "of the process data; 65534 at most; 0xFFFF never read"),
        Content::Command => ("command", "", "bits: 0 run, 1 reverse, 2 fault_reset (0 to 1)"),
        Content::Heartbeat => ("heartbeat", "", "any write renews the supervision; reads 0"),
        Content::Point(point) => (point.name(), point.unit(), ""),
    };
    let view = match entry.address {
        0x8000..=0x80FF => "common",
        0x8100..=0x81FF => "command",
        _ => "float",
    };
    if let Content::Point(point) = entry.content {
        note = point_note(profile, point, note);
    }
    let takes = |point| profile.model_point(point).is_some_and(|p| p.write);
    let writable = access == Access::Control
        && entry.is_command()
        && match entry.content {
            Content::Point(point) => takes(point),
            Content::Command => takes(ModelPoint::Run),
            _ => true,
        };
    Row {
        view,
        table: "holding, input",
        address: entry.address,
        reference: reference(Table::Holding, entry.address),
        items: entry.form.registers(),
        name: name.to_string(),
        kind: entry.form.name().to_string(),
        scale: format!("{}", 1.0 / entry.per_unit),
        unit: unit.to_string(),
        not_available: match entry.content {
            Content::Status | Content::State | Content::Heartbeat => "",
            Content::Age | Content::Command | Content::Point(_) => entry.form.not_available(),
        },
        access: if writable { "read, write" } else { "read" },
        source: match entry.content {
            Content::Point(point) => point_source(profile, plan, point),
            Content::Command => command_source(profile),
            Content::Status | Content::State | Content::Age | Content::Heartbeat => "gateway".to_string(),
        },
        note: note.to_string(),
    }
}

fn point_note<'n>(profile: &Profile, point: ModelPoint, note: &'n str) -> &'n str {
    match profile.model_point(point) {
        None => "never available: this family lacks it",
        Some(point) if !point.verified => "address not verified by a manual",
        Some(_) => note,
    }
}

/// The place that a point of the model is read from, or the points that it is made of.
fn point_source(profile: &Profile, plan: &Plan, point: ModelPoint) -> String {
    let Some(point) = profile.model_point(point) else {
        return "none".to_string();
    };
    match point.raw() {
        Some(raw) => format!("{} {}, {}", raw.table.name(), raw.address, polled(plan, point, raw)),
        None => "made of other points".to_string(),
    }
}

/// The command points that the family has.
fn command_source(profile: &Profile) -> String {
    let points = [ModelPoint::Run, ModelPoint::Reverse, ModelPoint::FaultReset];
    let names: Vec<&str> = points
        .into_iter()
        .filter(|p| profile.model_point(*p).is_some())
        .map(ModelPoint::name)
        .collect();
    if names.is_empty() {
        "none".to_string()
    } else {
        names.join(", ")
    }
}

/// How a register comes to be known.
fn polled(plan: &Plan, point: &Point, raw: &Raw) -> String {
    if plan.reads.iter().any(|r| r.covers(raw.table, raw.address)) {
        format!("polled {}", point.class.name())
    } else {
        "asked of the drive on request".to_string()
    }
}

fn raw_row(profile: &Profile, plan: &Plan, point: &Point, raw: &Raw, access: Access) -> Row {
    let kind = match raw.form {
        RawForm::Bit { .. } if raw.table.is_bits() => "bit".to_string(),
        RawForm::Bit { bit, .. } => format!("bit {bit}"),
        RawForm::Bits { first, count } => format!("bits {first}-{}", first.saturating_add(count).saturating_sub(1)),
        other => other.name().to_string(),
    };
    let mut notes = Vec::new();
    if matches!(raw.form, RawForm::Bit { invert: true, .. }) {
        notes.push("0 means true".to_string());
    }
    if raw.offset != 0.0 {
        notes.push(format!("plus {}", raw.offset));
    }
    if !point.verified {
        notes.push("address not verified by a manual".to_string());
    }
    if !point.note.is_empty() {
        notes.push(point.note.clone());
    }
    let range_writes = profile.range(raw.table, raw.address).is_some_and(|r| r.write > 0);
    let both = raw.table == Table::Holding && profile.input_is_holding;
    Row {
        view: "raw",
        table: if both { "holding, input" } else { raw.table.name() },
        address: raw.address,
        reference: reference(raw.table, raw.address),
        items: raw.form.items(),
        name: point.name.clone(),
        kind,
        scale: raw.scale.to_string(),
        unit: point.unit.clone(),
        not_available: "",
        access: if range_writes && access == Access::Control {
            "read, write"
        } else {
            "read"
        },
        source: polled(plan, point, raw),
        note: notes.join("; "),
    }
}

fn gateway_rows(plant: &Plant, shown: Option<&[String]>) -> Vec<Row> {
    let is_shown = |bus: &BusHandle| shown.is_none_or(|names| names.contains(&bus.image.spec.name));
    let buses = (0u16..).zip(&plant.buses).filter(|(_, bus)| is_shown(bus));
    let rows = buses.flat_map(|(place, bus)| {
        BUS_REGISTERS.iter().map(move |register| {
            let address = place.saturating_mul(BUS_BLOCK).saturating_add(register.offset);
            Row {
                view: "gateway",
                table: "input, holding",
                address,
                reference: reference(Table::Input, address),
                items: register.form.registers(),
                name: format!("{}: {}", bus.image.spec.name, register.name),
                kind: register.form.name().to_string(),
                scale: register.scale.to_string(),
                unit: register.unit.to_string(),
                not_available: if register.unit == "ms" {
                    register.form.not_available()
                } else {
                    ""
                },
                access: "read",
                source: "gateway".to_string(),
                note: String::new(),
            }
        })
    });
    rows.collect()
}

/// 4 holding, 3 input, 1 discrete input, 0 coil; then the number from 1, five digits.
fn reference(table: Table, address: u16) -> String {
    let digit = match table {
        Table::Coil => 0,
        Table::DiscreteInput => 1,
        Table::Input => 3,
        Table::Holding => 4,
    };
    format!("{digit}{:05}", u32::from(address) + 1)
}

#[cfg(test)]
mod tests;
