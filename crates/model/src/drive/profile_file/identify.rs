//! `[[identify]]`: `read = "holding 2100 11"`, `answer = "values"` or `"refused"`.

use super::super::profile::{Expected, Probe};
use super::place::parse_address;
use crate::document::{Finding, Reader};
use drivegate_proto::Table;

pub(super) fn read(reader: &Reader<'_>) -> Vec<Expected> {
    reader.tables("identify").iter().filter_map(read_one).collect()
}

/// `nameplates = ["WEG CFW500"]`: a vendor and the beginning of a product, or the vendor alone.
pub(super) fn nameplates(reader: &Reader<'_>) -> Vec<String> {
    let plates: Vec<String> = reader.or("nameplates", Vec::new());
    if plates.iter().any(|plate| plate.trim().is_empty()) {
        reader.problem(
            "nameplates",
            "an empty nameplate fits every drive",
            "write vendor and beginning of the product, such as [\"WEG CFW500\"]",
        );
    }
    plates
}

fn read_one(reader: &Reader<'_>) -> Option<Expected> {
    let form = "write table, first PDU address and count, such as \"holding 2100 11\"";
    let probe = reader.parsed("read", |text| {
        let mut words = text.split(' ');
        let table = words.next().and_then(Table::from_name);
        let mut number = || words.next().and_then(parse_address);
        match (table, number(), number()) {
            (Some(table), Some(start), Some(count)) if (1..=table.max_read()).contains(&count) => {
                Ok(Probe { table, start, count })
            }
            _ => Err(Finding::new(format!("`{text}` is not a read"), form)),
        }
    });
    if !reader.has("read") {
        reader.problem("read", "`read` is missing", form);
    }
    let values = reader.parsed("answer", |text| match text {
        "values" => Ok(true),
        "refused" => Ok(false),
        other => Err(Finding::new(
            format!("unknown answer `{other}`"),
            "write \"values\" or \"refused\"",
        )),
    });
    reader.finish();
    Some(Expected {
        probe: probe?,
        values: values.unwrap_or(true),
    })
}
