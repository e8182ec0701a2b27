//! The map as text: tables as text.

use std::fmt::Write as _;

use comfy_table::{Table as TextTable, presets};

use super::rows::{COLUMNS, Row, drive_rows};
use super::{Listener, Map};
use crate::printable;
use drivegate_core::process_image::{Access, DriveSpec};
use drivegate_model::drive::raw_writes;
use drivegate_north::modbus_tcp::Registers;
use drivegate_north::register_map::GATEWAY_UNIT;
use drivegate_proto::Table;

/// The whole map as tables.
pub(super) fn render(map: &Map<'_>) -> String {
    let specs: Vec<&DriveSpec> = map.drives.iter().map(|d| &d.image.spec).collect();
    let mut out = format!("Modbus TCP register map of {}\n\nUnits\n", map.plant.gateway);
    out += &units(&specs, map.view.default_drive.as_deref());
    if map.listeners.len() > 1 {
        out += "\nListeners\n";
        out += &listeners(map.listeners);
    }
    out += "\nAddresses are PDU addresses, from 0.";
    let model = match map.view.registers {
        Registers::Model => "from 0x8000 on",
        Registers::ModelAtZero => "below 0x0300",
        Registers::Raw => "",
    };
    if !model.is_empty() {
        let _ = write!(
            out,
            " Functions 03 and 04 read both tables of the blocks {model};\n32-bit values have the high word first; age \
             and state show why a value is not available."
        );
    }
    out.push('\n');
    let mut seen: Vec<&DriveSpec> = Vec::new();
    for drive in &map.drives {
        let spec = &drive.image.spec;
        let profile = &spec.profile;
        let is_same = |other: &DriveSpec| other.profile.name == profile.name && other.raw_writes == spec.raw_writes;
        if seen.iter().any(|other| is_same(other)) {
            continue;
        }
        seen.push(spec);
        let units: Vec<String> = specs
            .iter()
            .filter(|other| is_same(other))
            .map(|s| s.unit.to_string())
            .collect();
        let _ = write!(
            out,
            "\nProfile {} ({}), units {}\n",
            profile.name,
            printable::line(&profile.title),
            units.join(", ")
        );
        // Registers that a unit of this profile can have; the table above shows which units can be written.
        out += &rows(&drive_rows(drive, Access::Control, map.view.registers));
        let _ = write!(out, "\nAddresses of the drive itself, profile {}\n", profile.name);
        out += &ranges(spec);
    }
    if map.view.default_drive.is_none() {
        out += "\nThe gateway itself, unit 255\n";
        out += &rows(&map.gateway);
    }
    out
}

fn units(specs: &[&DriveSpec], default_drive: Option<&str>) -> String {
    let units = specs.iter().map(|s| {
        let access = match s.access {
            Access::Monitor => "monitor: every write is refused",
            Access::Control => "control",
            Access::Listen => "listens only: every write is refused",
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
    let gateway = match default_drive {
        None => vec![GATEWAY_UNIT.to_string(), "the gateway itself".to_string()],
        Some(name) => vec![format!("0, {GATEWAY_UNIT}"), name.to_string()],
    };
    table(
        &["unit", "drive", "bus", "address", "profile", "access"],
        units.chain([gateway]),
    )
}

fn listeners(listeners: &[Listener]) -> String {
    let cells = listeners.iter().map(|listener| {
        let addresses: Vec<String> = listener.addresses.iter().map(ToString::to_string).collect();
        let buses = listener
            .view
            .buses
            .as_ref()
            .map_or_else(|| "all".to_string(), |names| names.join(", "));
        let tls = if listener.tls { "yes" } else { "no" };
        let default_drive = listener.view.default_drive.clone();
        vec![
            addresses.join(", "),
            tls.to_string(),
            buses,
            listener.writers.clone(),
            listener.view.registers.name().to_string(),
            default_drive.unwrap_or_else(|| "gateway".to_string()),
        ]
    });
    table(
        &["address", "TLS", "buses", "who may write", "view", "units 0 and 255"],
        cells,
    )
}

fn rows(rows: &[Row]) -> String {
    table(&COLUMNS, rows.iter().map(|r| r.cells().to_vec()))
}

fn table(header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> String {
    let mut table = TextTable::new();
    table
        .load_preset(presets::NOTHING)
        .set_header(header.iter().map(|h| h.replace('_', " ")));
    table.add_rows(rows.map(|row| row.into_iter().map(|cell| printable::line(&cell))));
    let mut out: String = table.trim_fmt();
    out.push('\n');
    out
}

/// Addresses of the raw view beyond the points.
fn ranges(spec: &DriveSpec) -> String {
    let header = [
        "table",
        "first",
        "last",
        "read at once",
        "written at once",
        "raw writes refused",
        "note",
    ];
    let profile = &spec.profile;
    let refused = spec.raw_writes.refused_ranges(profile);
    let rows = profile.ranges.iter().map(|range| {
        let table = match range.table {
            Table::Holding if profile.input_is_holding => "holding, input",
            table => table.name(),
        };
        let written = if range.write == 0 {
            "read-only".to_string()
        } else {
            range.write.to_string()
        };
        let (first, last) = range.addresses.clone().into_inner();
        let note = range.note.clone();
        let refused: Vec<_> = refused
            .iter()
            .filter(|(table, lost)| *table == range.table && lost.start() <= &last && &first <= lost.end())
            .map(|(table, lost)| (*table, first.max(*lost.start())..=last.min(*lost.end())))
            .collect();
        vec![
            table.to_string(),
            first.to_string(),
            last.to_string(),
            range.read.to_string(),
            written,
            raw_writes::addresses_in_words(&refused),
            note,
        ]
    });
    table(&header, rows)
}
