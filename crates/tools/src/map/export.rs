//! The map for programs: CSV for a spreadsheet or an import, JSON for the rest.

use std::fmt::Write as _;
use std::ops::RangeInclusive;

use serde_json::{Map as Object, Value, json};

use super::Map;
use super::rows::{COLUMNS, Row, drive_rows};
use drivegate_core::process_image::{Access, DriveSpec};
use drivegate_north::register_map::GATEWAY_UNIT;
use drivegate_proto::Table;

/// Rows of all units, with unit and drive.
fn rows(map: &Map<'_>) -> Vec<(u8, String, Row)> {
    let mut all = Vec::new();
    for drive in &map.drives {
        let spec = &drive.image.spec;
        let rows = drive_rows(drive, spec.access, map.view.registers);
        all.extend(rows.into_iter().map(|row| (spec.unit, spec.name.clone(), row)));
    }
    all.extend(map.gateway.iter().map(|row| (GATEWAY_UNIT, String::new(), row.clone())));
    all
}

/// The addresses that the profile lets write and `raw_writes` of the drive does not.
fn refused(spec: &DriveSpec) -> Vec<Value> {
    let ranges = spec.raw_writes.refused_ranges(&spec.profile);
    let range = |(table, range): &(Table, RangeInclusive<u16>)| json!({ "table": table.name(), "first": range.start(), "last": range.end() });
    ranges.iter().map(range).collect()
}

/// CSV with a line for each register of each unit.
pub(super) fn csv(map: &Map<'_>) -> String {
    let mut out = format!("unit,drive,{}\n", COLUMNS.join(","));
    for (unit, drive, row) in rows(map) {
        let cells = [unit.to_string(), drive].into_iter().chain(row.cells());
        let cells: Vec<String> = cells.map(|c| quoted(&c)).collect();
        let _ = writeln!(out, "{}", cells.join(","));
    }
    out
}

/// A field of RFC 4180.
pub(super) fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_string()
    }
}

/// Listeners, units and registers; the keys of a register are the columns of the CSV.
pub(super) fn json(map: &Map<'_>) -> String {
    let listeners = map.listeners.iter().map(|l| {
        json!({
            "addresses": l.addresses,
            "tls": l.tls,
            "buses": l.view.buses,
            "writers": l.writers,
            "view": l.view.registers.name(),
            "default_drive": l.view.default_drive,
        })
    });
    let units = map.drives.iter().map(|drive| {
        let spec = &drive.image.spec;
        json!({
            "unit": spec.unit,
            "drive": spec.name,
            "bus": spec.bus,
            "address": spec.address,
            "profile": spec.profile.name,
            "access": if spec.access == Access::Control { "control" } else { "monitor" },
            "raw_writes_refused": refused(spec),
        })
    });
    let registers = rows(map).into_iter().map(|(unit, drive, row)| {
        let mut object = Object::new();
        object.insert("unit".into(), unit.into());
        object.insert(
            "drive".into(),
            if drive.is_empty() { Value::Null } else { drive.into() },
        );
        for (column, cell) in COLUMNS.iter().zip(row.cells()) {
            let value = match *column {
                "address" => row.address.into(),
                "registers" => row.items.into(),
                _ => Value::String(cell),
            };
            object.insert((*column).into(), value);
        }
        Value::Object(object)
    });
    let all = json!({
        "gateway": map.plant.gateway,
        "listeners": listeners.collect::<Vec<_>>(),
        "units": units.collect::<Vec<_>>(),
        "registers": registers.collect::<Vec<_>>(),
    });
    format!("{all:#}\n")
}
