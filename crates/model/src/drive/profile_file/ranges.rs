//! `[[range]]`, `[ranges]` and `address_offset`: addresses that may be read and written together, and with which
//! functions.

use std::collections::BTreeMap;

use super::super::profile::{AddressRange, WriteFunctions};
use crate::document::{FromNode, Node, Reader, ValueError};
use drivegate_proto::Table;

pub(super) fn read_table(reader: &Reader<'_>, key: &str, text: &str) -> Option<Table> {
    let table = Table::from_name(text);
    if table.is_none() {
        reader.problem(
            key,
            format!("unknown table `{text}`"),
            "known: coil, discrete-input, input, holding",
        );
    }
    table
}

pub(super) fn read_range(reader: &Reader<'_>, offsets: &Offsets) -> Option<AddressRange> {
    let text: Option<String> = reader.required("table");
    let table = text.and_then(|text| read_table(reader, "table", &text));
    let first: Option<u16> = reader.required("first");
    let last: Option<u16> = reader.required("last");
    let read: u16 = reader.or("read", 1);
    let write: u16 = reader.or("write", 0);
    let holes = reader.or("holes", false);
    let try_read: u16 = reader.or("try_read", 0);
    let is_bits = table.is_some_and(drivegate_proto::Table::is_bits);
    if try_read > 0 && (!is_bits || try_read <= read || try_read > 16) {
        reader.problem(
            "try_read",
            format!("{try_read} is not a number of bits from {} to 16", read + 1),
            "write it for a range of bits, above `read`, or leave it out",
        );
    }
    let note = reader.or("note", String::new());
    let write_when = reader.or("write_when", String::new());
    let first = first.and_then(|at| offsets.applied(reader, "first", table?, at));
    let last = last.and_then(|at| offsets.applied(reader, "last", table?, at));
    let (table, first, last) = match (table, first, last) {
        (Some(table), Some(first), Some(last)) => (table, first, last),
        _ => {
            reader.finish();
            return None;
        }
    };
    if first > last {
        reader.problem(
            "last",
            format!("{last} is before the first address {first}"),
            "swap them",
        );
    }
    if read == 0 || read > table.max_read() {
        reader.problem(
            "read",
            format!("{read} is out of range"),
            format!("write 1 to {}", table.max_read()),
        );
    }
    if write > 123 {
        reader.problem(
            "write",
            format!("{write} is out of range"),
            "write 0 (read-only) to 123",
        );
    }
    reader.finish();
    Some(AddressRange {
        table,
        addresses: first..=last,
        read,
        try_read,
        write,
        holes,
        write_when,
        note,
    })
}

/// Reads the keys of `[ranges]` that hold for all ranges of the drive.
pub(super) fn read_functions(reader: &Reader<'_>, ranges: &[AddressRange]) -> WriteFunctions {
    let mut functions = WriteFunctions::default();
    let Some(given) = reader.table("ranges") else {
        return functions;
    };
    let OneOrMore(single) = given.or("single_write", OneOrMore(Vec::new()));
    for function in &single {
        let (table, by) = match function {
            15 => (Table::Coil, &mut functions.coils_by_15),
            16 => (Table::Holding, &mut functions.registers_by_16),
            _ => {
                let what = format!("{function} is not a function that writes multiple items");
                given.problem("single_write", what, "write 16 (registers), 15 (coils) or [15, 16]");
                continue;
            }
        };
        *by = true;
        if !ranges.iter().any(|range| range.table == table && range.write > 0) {
            let what = format!("no range of table `{table}` can be written");
            given.problem(
                "single_write",
                what,
                format!("leave out {function}, or set `write` of a range"),
            );
        }
    }
    functions.mask_write = given.or("mask_write", false);
    given.finish();
    functions
}

/// A number or a list of numbers.
struct OneOrMore(Vec<u8>);

impl FromNode for OneOrMore {
    const WANTED: &'static str = "a function code, or a list of them";

    fn from_node(node: &Node) -> Result<OneOrMore, ValueError> {
        let one = u8::from_node(node).map(|one| vec![one]);
        one.or_else(|_| Vec::from_node(node)).map(OneOrMore)
    }
}

/// Checks that an address is in one range only. A file with a base may set other limits for a part of a base's range.
pub(super) fn check_overlaps(reader: &Reader<'_>, ranges: &[AddressRange]) {
    let tables = reader.tables("range");
    let mut seen: Vec<(&AddressRange, Option<String>)> = Vec::new();
    if tables.len() != ranges.len() {
        // A range could not be read, which is reported.
        return;
    }
    for (table, range) in tables.iter().zip(ranges) {
        // A range of the base, changed or not, still has keys of the base.
        let of = table.keys().into_iter().find_map(|key| table.place_of(key).env);
        let overlaps = |other: &AddressRange| {
            other.table == range.table
                && other.addresses.start() <= range.addresses.end()
                && range.addresses.start() <= other.addresses.end()
        };
        if let Some((other, _)) = seen.iter().find(|(other, whose)| *whose == of && overlaps(other)) {
            let (first, last) = (other.addresses.start(), other.addresses.end());
            table.problem(
                "first",
                format!("the range overlaps the one from {first} to {last}"),
                "put each address in one range only",
            );
        }
        seen.push((range, of));
    }
}

/// `address_offset`: the shift of the addresses of each table on the wire.
#[derive(Debug, Default)]
pub(super) struct Offsets(BTreeMap<Table, i64>);

impl Offsets {
    const TABLES: [Table; 4] = [Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding];

    pub(super) fn read(reader: &Reader<'_>) -> Offsets {
        let mut offsets = Offsets::default();
        let Some(given) = reader.table("address_offset") else {
            return offsets;
        };
        for table in Self::TABLES {
            let shift: i64 = given.or(table.name(), 0);
            if (-1..=1).contains(&shift) {
                offsets.0.insert(table, shift);
            } else {
                given.problem(table.name(), format!("{shift} is out of range"), "write -1, 0 or 1");
            }
        }
        given.finish();
        offsets
    }

    pub(super) fn applied(&self, reader: &Reader<'_>, key: &str, table: Table, address: u16) -> Option<u16> {
        let offset = self.0.get(&table).copied().unwrap_or(0);
        let shifted = u16::try_from(i64::from(address) + offset).ok();
        if shifted.is_none() {
            reader.problem(
                key,
                format!("{table} {address} shifted by {offset} is not an address"),
                "correct `address_offset` or the address",
            );
        }
        shifted
    }
}
