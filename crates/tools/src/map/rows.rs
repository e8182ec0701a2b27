//! The rows of the map: the content of each address.

use drivegate_core::plant::{BusHandle, DriveHandle, Plant};
use drivegate_core::process_image::Access;
use drivegate_model::drive::profile::{Form as RawForm, Raw};
use drivegate_model::drive::{ModelPoint, Plan, Point, Profile, RawWrites};
use drivegate_north::modbus_tcp::Registers;
use drivegate_north::register_map::{BLOCKS, BUS_BLOCK, BUS_REGISTERS, Content, Entry};
use drivegate_proto::Table;

/// A row of the map.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    pub(super) view: &'static str,
    /// Name of the table: `holding`, `input`, `holding, input`, `coil`, `discrete-input`.
    pub(super) table: &'static str,
    pub(super) address: u16,
    /// The address as many SCADA systems write it: table digit and number from 1.
    pub(super) reference: String,
    pub(super) items: u16,
    pub(super) name: String,
    pub(super) kind: String,
    pub(super) scale: String,
    pub(super) unit: String,
    pub(super) not_available: &'static str,
    pub(super) access: &'static str,
    /// Source of the value, or destination of a write.
    pub(super) source: String,
    pub(super) note: String,
}

/// Names of the cells of a row.
pub(super) const COLUMNS: [&str; 14] = [
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
    /// The cells, in the order of [`COLUMNS`].
    pub(super) fn cells(&self) -> [String; COLUMNS.len()] {
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

/// The registers of one unit at their addresses for clients: the blocks of the common model, then the drive's own
/// registers.
pub(super) fn drive_rows(drive: &DriveHandle, access: Access, registers: Registers) -> Vec<Row> {
    let spec = &drive.image.spec;
    let (profile, plan, raw_writes) = (&spec.profile, &drive.image.plan, &spec.raw_writes);
    let entries = BLOCKS
        .into_iter()
        .flatten()
        // Without [authority] there is no register for the hold.
        .filter(|entry| entry.content != Content::Hold || drive.has_authority())
        .filter_map(|entry| Some((entry, registers.of_model(entry.address)?)))
        .map(|(entry, address)| Row {
            address,
            reference: reference(Table::Holding, address),
            ..entry_row(profile, plan, entry, access)
        });
    let mut raw: Vec<(&Point, &Raw)> = profile
        .points
        .iter()
        .filter(|p| !p.hidden)
        .filter_map(|p| Some((p, p.raw()?)))
        // Other addresses are hidden behind the common model.
        .filter(|(_, raw)| raw.table.is_bits() || registers.shows_the_drives(raw.address, raw.form.items()))
        .collect();
    raw.sort_by_key(|(_, raw)| (raw.table, raw.address));
    let raw = raw.into_iter().map(|(point, raw)| Row {
        access: if access == Access::Control && is_written_raw(profile, raw_writes, raw) {
            "read, write"
        } else {
            "read"
        },
        ..raw_row(profile, plan, point, raw, raw_writes)
    });
    entries.chain(raw).collect()
}

fn entry_row(profile: &Profile, plan: &Plan, entry: &Entry, access: Access) -> Row {
    let (name, unit, mut note) = match entry.content {
        Content::Status => (
            "status",
            "",
            "bits: 0 ready, 1 running, 2 reversed, 3 fault, 4 warning, 5 at_reference, 6 zero_speed, 7 remote, 14 \
             stale (or a bit unknown), 15 online",
        ),
        Content::State => (
            "state",
            "",
            "0 offline, 1 not_ready, 2 ready, 3 running, 4 fault; 0xFFFF unknown",
        ),
        Content::Age => ("age", "ms", "of the process data; at most 65534; 0xFFFF never read"),
        Content::Command => ("command", "", "bits: 0 run, 1 reverse, 2 fault_reset (0 to 1)"),
        Content::Heartbeat => ("heartbeat", "", "any write renews the supervision; reads 0"),
        Content::Holder => (
            "holder",
            "",
            "0 nobody, 1 this client, 2 another, 3 local control place, 4 reserved after a stop; 0xFFFF without [authority]",
        ),
        Content::HoldLeft => ("hold_left", "s", "0xFFFF without [authority], and under local control"),
        Content::Hold => (
            "hold",
            "",
            "with [authority] only: write 1 take or renew, 0 release, 2 break; reads 1 for the holder",
        ),
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
            Content::Status | Content::Heartbeat | Content::Hold => "",
            Content::State
            | Content::Age
            | Content::Command
            | Content::Holder
            | Content::HoldLeft
            | Content::Point(_) => entry.form.not_available(),
        },
        access: if writable { "read, write" } else { "read" },
        source: match entry.content {
            Content::Point(point) => point_source(profile, plan, point),
            Content::Command => command_source(profile),
            Content::Status
            | Content::State
            | Content::Age
            | Content::Heartbeat
            | Content::Holder
            | Content::HoldLeft
            | Content::Hold => "gateway".to_string(),
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

/// The register that a point of the model is read from, or the points that it is derived from.
fn point_source(profile: &Profile, plan: &Plan, point: ModelPoint) -> String {
    let Some(point) = profile.model_point(point) else {
        return "none".to_string();
    };
    match point.raw() {
        Some(raw) => format!("{} {}, {}", raw.table.name(), raw.address, polled(plan, point, raw)),
        None => "derived from other points".to_string(),
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

/// How often a register is read, as text.
fn polled(plan: &Plan, point: &Point, raw: &Raw) -> String {
    if plan.reads.iter().any(|r| r.covers(raw.table, raw.address)) {
        format!("polled {}", point.class.name())
    } else {
        "read from the drive on request".to_string()
    }
}

/// Whether a raw write may set this point alone.
fn is_written_raw(profile: &Profile, raw_writes: &RawWrites, raw: &Raw) -> bool {
    has_writable_range(profile, raw) && raw_writes.refused(profile, raw.table, raw.addresses()).is_none()
}

fn has_writable_range(profile: &Profile, raw: &Raw) -> bool {
    profile
        .range(raw.table, raw.address)
        .is_some_and(|range| range.write > 0)
}

/// Whether one raw write can set the point and the control word.
fn shares_a_block_with_the_control_word(profile: &Profile, raw: &Raw) -> bool {
    let run = profile.run_place();
    let range = profile.range(raw.table, raw.address);
    let pair = run.zip(range).filter(|(run, _)| run.table == raw.table);
    pair.is_some_and(|(run, range)| {
        let span = run.address.abs_diff(raw.address).saturating_add(raw.form.items());
        range.addresses.contains(&run.address) && span <= range.write
    })
}

fn raw_row(profile: &Profile, plan: &Plan, point: &Point, raw: &Raw, raw_writes: &RawWrites) -> Row {
    let kind = match raw.form {
        RawForm::Bit { .. } if raw.table.is_bits() => "bit".to_string(),
        RawForm::Bit { bit, .. } => format!("bit {bit}"),
        RawForm::Bits { first, count } => format!("bits {first}-{}", first.saturating_add(count).saturating_sub(1)),
        _ => raw.type_text().replace(" high-first", ""),
    };
    let mut notes = Vec::new();
    if let Some(power) = raw.scale_from.and_then(|power| profile.points.get(power)) {
        notes.push(format!("times 10^{}", power.name));
    }
    let factors = raw.factor_from.iter().filter_map(|factor| profile.points.get(*factor));
    notes.extend(factors.map(|factor| format!("times {}", factor.name)));
    if !raw.invalid.is_empty() {
        let values: Vec<String> = raw.invalid.iter().map(|value| format!("{value:#06x}")).collect();
        notes.push(format!("{} means not available", values.join(", ")));
    }
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
    if has_writable_range(profile, raw) && !is_written_raw(profile, raw_writes, raw) {
        notes.push(if shares_a_block_with_the_control_word(profile, raw) {
            "written raw only in one request with the control word".to_string()
        } else {
            "raw writes refused, see raw_writes".to_string()
        });
    }
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
        access: "read",
        source: polled(plan, point, raw),
        note: notes.join("; "),
    }
}

/// The registers of the gateway itself, for the buses that are `shown`; `None` shows all.
pub(super) fn gateway_rows(plant: &Plant, shown: Option<&[String]>) -> Vec<Row> {
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
                // Only measured figures can be unavailable; counts and states are known at once.
                not_available: if !register.unit.is_empty() {
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
