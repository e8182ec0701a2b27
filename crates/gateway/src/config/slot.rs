//! `[[bus.slot]]`: where vendors' tools reach the line.

use std::path::{Path, PathBuf};

use super::http::Listener;
use super::keys::{BUS, SLOT};
use super::values;
use drivegate_bus::Mode;
use drivegate_core::process_image::Access;
use drivegate_model::document::{Place, Reader};
use drivegate_north::slot::{Slot, SlotAccess};
use drivegate_proto::{LineFormat, Protocol};

/// The valid settings of a `[[bus.slot]]`.
pub(super) struct Found {
    pub(super) listeners: Vec<Listener>,
    pub(super) pty: Option<(PathBuf, Place)>,
    /// Whether the slot's tools may write.
    pub(super) writes: bool,
    pub(super) slot: Option<Slot>,
}

/// The bus that a slot belongs to.
pub(super) struct Surroundings<'s> {
    pub(super) bus: Option<&'s str>,
    pub(super) protocol: Protocol,
    pub(super) format: Option<LineFormat>,
    pub(super) mode: Mode,
    /// Access of the slot to the drives of its bus; only the valid values.
    pub(super) drives: Vec<Access>,
}

/// Reads the slots of a bus.
pub(super) fn read(reader: &Reader<'_>, base: &Path, around: &Surroundings<'_>) -> Vec<Found> {
    let tables = BUS.slot.tables(reader);
    if around.mode == Mode::Listen && !tables.is_empty() {
        reader.problem(
            BUS.slot.name,
            "a slot passes on what a tool sends, but this bus only listens (mode = \"listen\")",
            "leave the slot out, or make the gateway the only master of the line and write mode = \"master\"",
        );
    }
    tables.iter().map(|table| read_one(table, base, around)).collect()
}

fn read_one(reader: &Reader<'_>, base: &Path, around: &Surroundings<'_>) -> Found {
    let (listen, rfc2217) = (SLOT.listen.read(reader), SLOT.rfc2217.read(reader));
    let pty = SLOT.pty.read(reader).map(|path| values::resolved(base, path));
    let access = SLOT.access.get(reader);
    let allow = SLOT.allow.get(reader);
    let idle_timeout = SLOT.idle_timeout.read(reader);
    let placed = [(listen, &SLOT.listen), (rfc2217, &SLOT.rfc2217)];
    let listeners: Vec<Listener> = placed
        .into_iter()
        .filter_map(|(address, key)| Some((address?, key.place(reader))))
        .collect();
    if ![SLOT.listen.name, SLOT.rfc2217.name, SLOT.pty.name]
        .iter()
        .any(|key| reader.has(key))
    {
        reader.problem(
            SLOT.listen.name,
            "the slot has neither `listen` nor `rfc2217` nor `pty`, so no tool can reach it",
            "write for example listen = \"127.0.0.1:4001\", or pty = \"/run/drivegate/line1-tool\"",
        );
    }
    let writes = access != SlotAccess::Read;
    if writes && !around.drives.is_empty() && !around.drives.contains(&Access::Control) {
        reader.warning(
            SLOT.access.name,
            "the slot lets tools write, but every drive on the bus is only monitored, so all writes to them are \
             refused",
            "set access = \"control\" for the drives that may be written, or write access = \"read\"",
        );
    }
    let beyond = allow.iter().find(|network| !network.network().is_loopback());
    if let Some(network) = beyond.filter(|_| writes && !listeners.is_empty()) {
        reader.warning(
            SLOT.allow.name,
            format!("any client in {network} may write to the drives; a slot has neither passwords nor TLS"),
            "keep `allow` narrow, use a tunnel such as ssh, or write access = \"read\"",
        );
    }
    reader.finish();
    let slot = match (around.bus, around.format, idle_timeout) {
        (Some(bus), Some(format), Some(idle_timeout)) => Some(Slot {
            bus: bus.to_string(),
            protocol: around.protocol,
            format,
            listen,
            rfc2217,
            pty: pty.clone(),
            access,
            allow,
            idle_timeout,
        }),
        _ => None,
    };
    Found {
        listeners,
        pty: pty.map(|path| (path, SLOT.pty.place(reader))),
        writes,
        slot,
    }
}
