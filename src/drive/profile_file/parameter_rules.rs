//! The keys of `[parameters]` about writing parameters back: `only_by_name`, `nameplate`, `ratings`, `volatile`, `limits`, `save`,
//! `lock`, `note`. A parameter is named by its id, several by `FIRST..LAST`.

use std::ops::RangeInclusive;

use super::super::model::Kind;
use super::super::parameters::{Addresses, Limit, Lock, ParameterList, WriteRules};
use super::super::profile::{AddressRange, Point};
use super::place::parse_address;
use crate::codec::Table;
use crate::document::{Reader, nearest};

/// Reads the rules of `table`; the parameters that they name are those of `list`.
pub(super) fn read(table: &Reader<'_>, list: &ParameterList, points: &[Point], ranges: &[AddressRange]) -> WriteRules {
    let rules = Rules { table, list };
    WriteRules {
        only_by_name: rules.only_by_name(),
        nameplate: rules.addresses("nameplate"),
        ratings: rules.addresses("ratings"),
        volatile: rules.addresses("volatile"),
        limits: rules.limits(),
        save: read_save(table, ranges),
        lock: read_lock(table, list, points),
        note: table.or("note", String::new()),
    }
}

/// A table whose keys name parameters.
struct Rules<'a, 'd> {
    table: &'a Reader<'d>,
    list: &'a ParameterList,
}

impl Rules<'_, '_> {
    fn only_by_name(&self) -> Vec<(RangeInclusive<u16>, String)> {
        const KEY: &str = "only_by_name";
        let rows: Vec<String> = self.table.or(KEY, Vec::new());
        let read = rows.iter().filter_map(|row| {
            let (ids, why) = row.split_once(',').unwrap_or((row, ""));
            if why.trim().is_empty() {
                let what = format!("`{row}` does not say why");
                self.table
                    .problem(KEY, what, "write \"id, reason\", such as \"Sn-23, station address\"");
                return None;
            }
            Some((self.span(KEY, ids)?, why.trim().to_string()))
        });
        read.collect()
    }

    fn addresses(&self, key: &str) -> Addresses {
        let ids: Vec<String> = self.table.or(key, Vec::new());
        ids.iter().filter_map(|ids| self.span(key, ids)).collect()
    }

    /// `Cn-02`, or `On-20..On-24`.
    fn span(&self, key: &str, ids: &str) -> Option<RangeInclusive<u16>> {
        let (first, last) = ids.split_once("..").unwrap_or((ids, ids));
        let (first, last) = (self.address(key, first)?, self.address(key, last)?);
        if first > last {
            let what = format!("`{}` ends before it begins", ids.trim());
            self.table
                .problem(key, what, "write the one with the lower address first");
            return None;
        }
        Some(first..=last)
    }

    fn address(&self, key: &str, id: &str) -> Option<u16> {
        let id = id.trim();
        let address = self.list.address(id);
        if address.is_none() {
            let named = self.list.named.iter().map(|parameter| parameter.id.as_str());
            let near = nearest(id, named).map(|near| format!("did you mean `{near}`?"));
            let remedy = near.unwrap_or_else(|| "name one of `list`, or one that lies in `spans`".to_string());
            self.table.problem(key, format!("there is no parameter `{id}`"), remedy);
        }
        address
    }

    fn limits(&self) -> Vec<Limit> {
        const KEY: &str = "limits";
        let rows: Vec<String> = self.table.or(KEY, Vec::new());
        let read = rows.iter().filter_map(|row| {
            let Some((upper, lower)) = row.split_once(">=") else {
                let what = format!("`{row}` is not a limit");
                self.table.problem(KEY, what, "write for example \"Cn-14 >= Cn-15\"");
                return None;
            };
            let limit = Limit {
                upper: self.address(KEY, upper)?,
                lower: self.address(KEY, lower)?,
            };
            let label = |address| {
                self.list
                    .at(address)
                    .map(|parameter| (&parameter.label.unit, parameter.label.scale))
            };
            if label(limit.upper) != label(limit.lower) {
                let what = format!("the parameters of `{row}` differ in unit or scale");
                self.table
                    .problem(KEY, what, "limit parameters whose counts can be compared");
                return None;
            }
            Some(limit)
        });
        let limits: Vec<Limit> = read.collect();
        if let Some(limit) = in_circle(&limits) {
            let id = self.list.id(limit.upper).unwrap_or_default();
            let what = format!("the limits of `{id}` lead back to itself");
            self.table.problem(KEY, what, "leave one of them out");
        }
        limits
    }
}

/// A limit whose upper parameter is, over others, below itself.
fn in_circle(limits: &[Limit]) -> Option<Limit> {
    let mut left = limits.to_vec();
    // What has nothing below it is in no circle, and neither is what is then left without.
    loop {
        let uppers: Vec<u16> = left.iter().map(|limit| limit.upper).collect();
        let before = left.len();
        left.retain(|limit| uppers.contains(&limit.lower));
        if left.len() == before {
            return left.first().copied();
        }
    }
}

/// `save = "0x0900 = 0"`.
fn read_save(table: &Reader<'_>, ranges: &[AddressRange]) -> Option<(u16, u16)> {
    let text: String = table.optional("save")?;
    let save = text
        .split_once('=')
        .and_then(|(address, value)| Some((parse_address(address.trim())?, parse_address(value.trim())?)));
    let Some((address, value)) = save else {
        table.problem(
            "save",
            format!("`{text}` is not a write"),
            "write for example \"0x0900 = 0\"",
        );
        return None;
    };
    let range = ranges
        .iter()
        .find(|range| range.table == Table::Holding && range.addresses.contains(&address));
    if range.is_none_or(|range| range.write == 0) {
        let what = format!("holding {address} cannot be written");
        table.problem("save", what, "name a register that lies in a [[range]] with `write`");
        return None;
    }
    Some((address, value))
}

/// `[parameters.lock]`: parameters that the drive takes in one mode only.
fn read_lock(parent: &Reader<'_>, list: &ParameterList, points: &[Point]) -> Option<Lock> {
    let table = parent.table("lock")?;
    let of = Rules { table: &table, list }.addresses("of");
    if of.is_empty() {
        table.problem(
            "of",
            "no parameter is named",
            "name parameters, such as [\"Sn-01..Sn-38\"]",
        );
    }
    let name: Option<String> = table.required("while");
    let exception = table.optional("exception");
    let remedy: Option<String> = table.required("remedy");
    table.finish();
    let name = name?;
    let is_it = |point: &Point| point.name == name && point.kind() == Kind::Bool;
    let Some(point) = points.iter().position(is_it) else {
        let states = points.iter().filter(|point| point.kind() == Kind::Bool);
        let near = nearest(&name, states.map(|point| point.name.as_str()));
        let near = near.map(|near| format!("did you mean `{near}`?"));
        let remedy = near.unwrap_or_else(|| "name a point of the profile that is true or false".to_string());
        table.problem("while", format!("there is no state `{name}`"), remedy);
        return None;
    };
    Some(Lock {
        of,
        point,
        exception,
        remedy: remedy?,
    })
}
