//! `drivegate map`: the Modbus TCP register map of a configuration, for the SCADA engineer.

use std::fmt::Write as _;
use std::io;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use comfy_table::{Table as TextTable, presets};

use super::{DEFAULT_CONFIG, EXIT_CONFIG, EXIT_FAILED, report};
use crate::cache::{Access, BusImage, DriveImage, DriveSpec};
use crate::codec::Table;
use crate::command::CommandQueue;
use crate::config::{BusSettings, Settings, environment};
use crate::drive::profile::{Form as RawForm, Raw};
use crate::drive::{ModelPoint, Plan, Point, PollClass, Profile};
use crate::north::register_map::{BLOCKS, BUS_BLOCK, BUS_REGISTERS, Content, Entry, GATEWAY_UNIT};
use crate::plant::{BusHandle, Plant};

/// Prints the Modbus TCP register map of a configuration, for the SCADA engineer.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate map --config /etc/drivegate/drivegate.toml --csv > registers.csv")]
pub(super) struct Args {
    /// Configuration file
    #[arg(long, value_name = "FILE", default_value = DEFAULT_CONFIG)]
    config: PathBuf,
    /// Comma-separated values, one line for each register of each unit
    #[arg(long)]
    csv: bool,
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
    note: String,
}

const COLUMNS: [&str; 13] = [
    "view",
    "table",
    "address",
    "hex",
    "reference",
    "registers",
    "name",
    "type",
    "scale",
    "unit",
    "not_available",
    "access",
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
    match plant(&settings) {
        Ok(plant) => report::print(&render(&plant, args.csv)),
        Err(why) => {
            report::error(&format!("cannot lay out the map: {why}; map; free file descriptors"));
            ExitCode::from(EXIT_FAILED)
        }
    }
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

/// The map of all units: with `csv` one line for each register of each unit, else tables for people, one for
/// each profile.
fn render(plant: &Plant, csv: bool) -> String {
    if csv { render_csv(plant) } else { render_text(plant) }
}

fn render_csv(plant: &Plant) -> String {
    let mut out = format!("unit,drive,{}\n", COLUMNS.join(","));
    let mut line = |unit: u8, drive: &str, row: &Row| {
        let cells = [unit.to_string(), drive.to_string()].into_iter().chain(row.cells());
        let cells: Vec<String> = cells.map(|c| quoted(&c)).collect();
        let _ = writeln!(out, "{}", cells.join(","));
    };
    for drive in plant.drives() {
        let spec = &drive.image.spec;
        for row in drive_rows(&spec.profile, &drive.image.plan, spec.access) {
            line(spec.unit, &spec.name, &row);
        }
    }
    for row in gateway_rows(plant) {
        line(GATEWAY_UNIT, "", &row);
    }
    out
}

/// A field of RFC 4180.
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_string()
    }
}

fn render_text(plant: &Plant) -> String {
    let drives: Vec<_> = plant.drives().collect();
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
    out += "\nAddresses are PDU addresses, from 0. Functions 03 and 04 read both tables of the blocks from 0x8000 on;\n\
            32-bit values lie high word first; age and state tell why a value is not available.\n";
    let mut seen: Vec<&str> = Vec::new();
    for drive in &drives {
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
    out += &rows(&gateway_rows(plant));
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
        .map(|entry| entry_row(profile, entry, access));
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

fn entry_row(profile: &Profile, entry: &Entry, access: Access) -> Row {
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
    let writable = entry.is_command() && access == Access::Control;
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
    if !plan.reads.iter().any(|r| r.covers(raw.table, raw.address)) {
        notes.push("not polled: read from the drive on request".to_string());
    } else if point.class != PollClass::Fast {
        notes.push(format!("poll class {}", point.class.name()));
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
        note: notes.join("; "),
    }
}

fn gateway_rows(plant: &Plant) -> Vec<Row> {
    let buses = (0u16..).zip(&plant.buses);
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
mod tests {
    use std::collections::BTreeMap;
    use std::time::Duration;

    use super::*;
    use crate::cache::{BusSpec, OnShutdown};
    use crate::codec::{LineFormat, Protocol};
    use crate::drive::profile::Profiles;

    fn plant() -> Plant {
        let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
        let drive = |name: &str, unit, access| {
            let spec = DriveSpec {
                name: name.to_string(),
                bus: "line1".to_string(),
                address: unit,
                unit,
                profile: profile.clone(),
                access,
                limits: BTreeMap::new(),
                supervision: None,
                on_shutdown: OnShutdown::Hold,
                turnaround: Duration::ZERO,
                frequency_range: None,
            };
            Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
        };
        let spec = BusSpec {
            name: "line1".to_string(),
            port: "/dev/null".to_string(),
            protocol: Protocol::ModbusRtu,
            format: LineFormat::new(38_400, "8N1").unwrap(),
            cycle: Duration::from_millis(10),
            slow_cycle: Duration::from_secs(1),
        };
        let drives = vec![drive("pump-1", 1, Access::Control), drive("pump-2", 2, Access::Monitor)];
        let image = Arc::new(BusImage::new(spec, drives));
        let queue = Arc::new(CommandQueue::new().unwrap());
        Plant {
            gateway: "pump-house".to_string(),
            stale_after: Duration::from_secs(1),
            buses: vec![BusHandle { image, queue }],
            events: Default::default(),
            writes: Default::default(),
        }
    }

    #[test]
    fn csv_has_one_line_a_register() {
        let csv = render(&plant(), true);
        let mut lines = csv.lines();
        let columns = lines.next().unwrap().split(',').count();
        assert_eq!(columns, 15);
        for wanted in [
            "1,pump-1,common,\"holding, input\",32772,0x8004,432773,1,actual_speed,i16,0.01,%,0x8000,read,",
            "1,pump-1,common,\"holding, input\",32781,0x800D,432782,2,energy,u32,1,kWh,0xFFFFFFFF,read,\
             never available: this family lacks it",
            "1,pump-1,command,\"holding, input\",33025,0x8101,433026,1,speed_reference,i16,0.01,%,0x8000,\"read, write\",",
            "2,pump-2,command,\"holding, input\",33025,0x8101,433026,1,speed_reference,i16,0.01,%,0x8000,read,",
            "1,pump-1,float,\"holding, input\",33282,0x8202,433283,2,output_frequency,f32,1,Hz,NaN,read,",
            "1,pump-1,raw,\"holding, input\",2103,0x0837,402104,1,output_frequency,i16,0.01,Hz,,read,",
            "255,,gateway,\"input, holding\",3,0x0003,300004,1,line1: line load,u16,0.1,%,,read,",
        ] {
            assert!(csv.lines().any(|line| line == wanted), "{wanted} is missing in\n{csv}");
        }
    }

    #[test]
    fn text_tells_units_and_each_profile_once() {
        let text = render(&plant(), false);
        assert!(
            text.contains("\nProfile vacon-nx (Vacon NX, OPTC2/OPTC8 board, Modbus RTU), units 1, 2\n"),
            "{text}"
        );
        assert_eq!(text.matches("Profile vacon-nx").count(), 1);
        assert!(text.contains("monitor: every write is refused"));
        assert!(
            text.lines().all(|line| line == line.trim_end()),
            "no blanks at line ends"
        );
    }

    #[test]
    fn fields_are_quoted_where_they_must() {
        assert_eq!(quoted("a"), "a");
        assert_eq!(quoted("a \"b\", c"), "\"a \"\"b\"\", c\"");
    }
}
