//! `drivegate profiles import`: a register list becomes a profile.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;

use drivegate_core::parameters::cells;
use drivegate_model::document::{Finding, Problem, nearest};
use drivegate_model::drive::Profile;
use drivegate_proto::Table;

/// Column names of a point list.
const COLUMNS: [&str; 17] = [
    "name",
    "address",
    "table",
    "bit",
    "type",
    "byte",
    "order",
    "scale",
    "scale_from",
    "factor_from",
    "offset",
    "unit",
    "class",
    "mask",
    "note",
    "write",
    "min",
];
const MAX: &str = "max";
/// Items of a read request, where the list gives no number.
const READ: u16 = 16;
/// Maximum number of rows of a point list.
const MOST_ROWS: usize = 10_000;

/// The profile that the list `text` of the file `path` makes.
///
/// # Errors
/// If the list is invalid: contains the problems, each with its line.
pub(super) fn profile(path: &Path, text: &str) -> Result<String, Vec<Problem>> {
    let file = path.display().to_string();
    let mut problems: Vec<Problem> = Vec::new();
    let problem = |line: usize, (key, what, remedy): (&str, String, String)| {
        let mut problem = Problem::of_file(file.clone(), key, Finding::new(what, remedy));
        problem.line = Some(line);
        problem
    };
    let mut rows = rows(text);
    let Some((_, header)) = rows.next() else {
        let remedy = "write a header line, such as name,address,type";
        return Err(vec![problem(1, mistake("", "the list is empty", remedy))]);
    };
    let header: Vec<String> = header.iter().map(|name| name.trim().to_lowercase()).collect();
    let known = || COLUMNS.into_iter().chain([MAX]);
    for name in header.iter().filter(|name| !known().any(|known| known == *name)) {
        let near = nearest(name, known()).map(|near| format!("did you mean `{near}`?"));
        let remedy = near.unwrap_or_else(|| format!("known: {}", known().collect::<Vec<_>>().join(", ")));
        problems.push(problem(1, (name, format!("unknown column `{name}`"), remedy)));
    }
    for needed in ["name", "address"] {
        if !header.iter().any(|name| name == needed) {
            let missing = mistake(needed, format!("there is no column `{needed}`"), "add it");
            problems.push(problem(1, missing));
        }
    }
    let mut points = Vec::new();
    let mut names = BTreeSet::new();
    for (line, cells) in rows {
        if points.len() >= MOST_ROWS {
            let long = mistake("", format!("more than {MOST_ROWS} lines"), "split the list");
            problems.push(problem(line, long));
            break;
        }
        let cells: BTreeMap<&str, &str> = header
            .iter()
            .map(String::as_str)
            .zip(cells.iter().map(|cell| cell.trim()))
            .collect();
        match point(&cells, &mut names) {
            Ok(point) => points.push((line, point)),
            Err(mistake) => problems.push(problem(line, mistake)),
        }
    }
    if points.is_empty() && problems.is_empty() {
        problems.push(problem(
            1,
            mistake("", "the list has no register", "write a line for each"),
        ));
    }
    if !problems.is_empty() {
        return Err(problems);
    }
    let name = path
        .file_stem()
        .map(|stem| words(&stem.to_string_lossy(), '-'))
        .unwrap_or_default();
    let text = written(&name, &points);
    check(&file, &text, &points)?;
    Ok(text)
}

/// Lines of the list with their cells; empty lines are left out.
fn rows(text: &str) -> impl Iterator<Item = (usize, Vec<String>)> {
    let text = text.trim_start_matches('\u{feff}');
    let first = text.lines().next().unwrap_or_default();
    let separator = ['\t', ';', ',']
        .into_iter()
        .find(|separator| first.contains(*separator));
    let separator = separator.unwrap_or(',');
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    lines.map(move |(place, line)| (place + 1, cells(line, |c| c == separator).0))
}

/// A point read from the list.
struct Row {
    table: Table,
    address: u16,
    items: u16,
    write: bool,
    toml: String,
}

/// A mistake in a list: key, problem, remedy.
type Mistake = (&'static str, String, String);

fn mistake(key: &'static str, what: impl Into<String>, remedy: &str) -> Mistake {
    (key, what.into(), remedy.to_string())
}

fn point(cells: &BTreeMap<&str, &str>, names: &mut BTreeSet<String>) -> Result<Row, Mistake> {
    let cell = |key: &str| cells.get(key).copied().filter(|cell| !cell.is_empty());
    let name = words(cell("name").unwrap_or_default(), '_');
    if name.is_empty() {
        return Err(mistake("name", "the register has no name", "write one with letters"));
    }
    let (table, address) = place(cell("address").unwrap_or_default(), cell("table"))?;
    let bit = match cell("bit") {
        None => String::new(),
        Some(bit) => format!(".{bit}"),
    };
    let name = unique(name, names);
    let mut toml = format!(
        "[[point]]\nname = \"{name}\"\nat = \"{} {address}{bit}\"\n",
        table.name()
    );
    for key in ["type", "byte", "order", "unit", "class", "note"] {
        if let Some(text) = cell(key) {
            let _ = writeln!(toml, "{key} = {}", quoted(text));
        }
    }
    for key in ["scale_from", "factor_from"] {
        if let Some(text) = cell(key) {
            let _ = writeln!(toml, "{key} = {}", names_in(text));
        }
    }
    for key in ["scale", "offset", "mask"] {
        if let Some(text) = cell(key) {
            let _ = writeln!(toml, "{key} = {}", number(key, text)?);
        }
    }
    let write = match cell("write").map(str::to_lowercase).as_deref() {
        None | Some("no" | "n" | "0" | "false" | "r") => false,
        Some("yes" | "y" | "1" | "true" | "rw" | "w") => true,
        Some(other) => {
            let what = format!("`{other}` is neither yes nor no");
            return Err(mistake("write", what, "write yes or no"));
        }
    };
    if write {
        toml += "write = true\n";
    }
    match (cell("min"), cell(MAX)) {
        (Some(min), Some(max)) => {
            let _ = writeln!(toml, "range = [{}, {}]", number("min", min)?, number("max", max)?);
        }
        (None, None) => {}
        _ => {
            return Err(mistake("min", "a range has two ends", "write min and max, or neither"));
        }
    }
    Ok(Row {
        table,
        address,
        items: items(cell("type").unwrap_or_default()),
        write,
        toml,
    })
}

/// The point names in a cell, as this list writes them: one, or several with `*` or `+` between them.
fn names_in(text: &str) -> String {
    let names: Vec<String> = text.split(['*', '+']).map(|name| quoted(&words(name, '_'))).collect();
    match names.as_slice() {
        [one] => one.clone(),
        several => format!("[{}]", several.join(", ")),
    }
}

/// Registers of a type; of an unknown one, which the profile reports, 1.
fn items(kind: &str) -> u16 {
    match kind {
        "u32" | "i32" | "f32" | "bcd32" => 2,
        "u64" | "i64" | "f64" => 4,
        text => text.strip_prefix("string:").and_then(|n| n.parse().ok()).unwrap_or(1),
    }
}

/// Letters and digits in lower case, joined; starts with a letter.
fn words(text: &str, joint: char) -> String {
    let lower = text.to_lowercase();
    let parts = lower
        .split(|c: char| !c.is_ascii_alphanumeric())
        .filter(|part| !part.is_empty());
    let joined = parts.collect::<Vec<_>>().join(&joint.to_string());
    if joined.starts_with(|c: char| c.is_ascii_digit()) {
        format!("p{joint}{joined}")
    } else {
        joined
    }
}

fn unique(name: String, names: &mut BTreeSet<String>) -> String {
    let all = std::iter::once(name.clone()).chain((2..).map(|n| format!("{name}_{n}")));
    let mut free = all.filter(|name| !names.contains(name));
    let name = free.next().unwrap_or(name);
    names.insert(name.clone());
    name
}

/// Table and PDU address; a reference number counts from 1.
fn place(text: &str, table: Option<&str>) -> Result<(Table, u16), Mistake> {
    let bad = || {
        let what = match text {
            "" => "the register has no address".to_string(),
            text => format!("`{text}` is not an address"),
        };
        let remedy = "write a PDU address such as 256 or 0x100, or a reference number such as 40257";
        mistake("address", what, remedy)
    };
    let digits = text.bytes().all(|byte| byte.is_ascii_digit());
    if let (None, 5 | 6, true) = (table, text.len(), digits) {
        let (first, number) = text.split_at(1);
        let of = match first {
            "0" => Table::Coil,
            "1" => Table::DiscreteInput,
            "3" => Table::Input,
            "4" => Table::Holding,
            _ => return Err(bad()),
        };
        let number: u32 = number.parse().map_err(|_| bad())?;
        let address = number
            .checked_sub(1)
            .and_then(|n| u16::try_from(n).ok())
            .ok_or_else(bad)?;
        return Ok((of, address));
    }
    let lower = text.to_lowercase();
    let address = match lower.strip_prefix("0x").or_else(|| lower.strip_suffix('h')) {
        Some(hex) => u16::from_str_radix(hex, 16).map_err(|_| bad())?,
        None => text.parse().map_err(|_| bad())?,
    };
    let table = table.unwrap_or("holding").to_lowercase();
    let of = Table::from_name(&table).ok_or_else(|| {
        let known = "write holding, input, coil or discrete-input";
        mistake("table", format!("unknown table `{table}`"), known)
    })?;
    Ok((of, address))
}

/// A number in the form of TOML; a decimal comma is accepted.
fn number(key: &'static str, text: &str) -> Result<String, Mistake> {
    let dotted = text.replace(',', ".");
    let hex = dotted
        .strip_prefix("0x")
        .is_some_and(|hex| u64::from_str_radix(hex, 16).is_ok());
    let plain = dotted.parse::<i64>().map(|n| n.to_string());
    let real = || {
        dotted
            .parse::<f64>()
            .ok()
            .filter(|n| n.is_finite())
            .map(|n| format!("{n:?}"))
    };
    match (hex, plain) {
        (true, _) => Ok(dotted),
        (false, Ok(whole)) => Ok(whole),
        (false, Err(_)) => {
            let what = || format!("`{text}` is not a number");
            real().ok_or_else(|| mistake(key, what(), "write a number, such as 0.1"))
        }
    }
}

fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => quoted.push(' '),
            c => quoted.push(c),
        }
    }
    quoted + "\""
}

fn written(name: &str, points: &[(usize, Row)]) -> String {
    let name = if name.is_empty() { "imported" } else { name };
    let mut text = format!(
        "# Made from a register list. Adapt to the manual: protocols, bauds, and `read` and `write` of each \
         range.\nname = \"{name}\"\nprotocols = [\"modbus-rtu\"]\nverified = false\n"
    );
    let mut all: Vec<&Row> = points.iter().map(|(_, row)| row).collect();
    all.sort_by_key(|row| (row.table, row.address));
    let end = |row: &Row| u32::from(row.address) + u32::from(row.items.max(1));
    let mut ranges: Vec<(Table, u16, u32, u16, u16)> = Vec::new();
    for row in all {
        let write = if row.write { row.items.max(1) } else { 0 };
        match ranges.last_mut() {
            Some((table, _, last, widest, most)) if *table == row.table && u32::from(row.address) <= *last => {
                (*last, *widest, *most) = ((*last).max(end(row)), (*widest).max(row.items), (*most).max(write));
            }
            _ => ranges.push((row.table, row.address, end(row), row.items, write)),
        }
    }
    for (table, first, end, widest, write) in ranges {
        let length = u16::try_from(end - u32::from(first)).unwrap_or(u16::MAX);
        let read = length.min(READ).max(widest);
        let last = end - 1;
        let _ = write!(
            text,
            "\n[[range]]\ntable = \"{}\"\nfirst = {first}\nlast = {last}\nread = {read}\n",
            table.name()
        );
        if write > 0 {
            let _ = writeln!(text, "write = {write}");
        }
    }
    for (_, row) in points {
        let _ = write!(text, "\n{}", row.toml);
    }
    text
}

/// Reports the problems of the profile's points at their lines in the list.
fn check(file: &str, text: &str, points: &[(usize, Row)]) -> Result<(), Vec<Problem>> {
    let Err(problems) = Profile::parse(file, text, false) else {
        return Ok(());
    };
    let place = |mut problem: Problem| {
        let index = problem.key.strip_prefix("point[").and_then(|rest| rest.split_once(']'));
        let index = index
            .and_then(|(index, key)| Some((index.parse::<usize>().ok()?, key.trim_start_matches('.').to_string())));
        problem.line = index
            .as_ref()
            .and_then(|(index, _)| points.get(*index))
            .map(|(line, _)| *line);
        if let Some((_, key)) = index {
            problem.key = key;
        }
        problem
    };
    Err(problems.into_iter().map(place).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Form;

    fn made(text: &str) -> Result<Profile, String> {
        let path = Path::new("our meter 2.csv");
        let all = |problems: Vec<Problem>| problems.iter().map(|p| format!("{p}\n")).collect::<String>();
        let text = profile(path, text).map_err(all)?;
        Profile::parse("p.toml", &text, false).map_err(all)
    }

    #[test]
    fn a_list_becomes_a_profile() {
        let profile = made(
            "\u{feff}Name;Address;Type;Scale;Unit;Class;Write;Min;Max;Bit;Note\n\
             Voltage L1;30001;f32;;V;fast;;;;;\n\
             \"Power; active\";30003;i32;0,001;kW;fast;;;;;\"says \"\"W\"\"\"\n\n\
             Voltage L1;30005;;;;;;;;3;\n\
             1st limit;0x100;u16;0.1;%;once;yes;0;100;;\n\
             Relay;00001;;;;;yes;;;;\n",
        )
        .unwrap();
        assert_eq!((profile.name.as_str(), profile.verified), ("our-meter-2", false));
        let names: Vec<&str> = profile.points.iter().map(|p| p.name.as_str()).collect();
        assert_eq!(
            names,
            ["voltage_l1", "power_active", "voltage_l1_2", "p_1st_limit", "relay"]
        );
        let raw = |place: usize| profile.points[place].raw().unwrap();
        assert_eq!(
            (raw(0).table, raw(0).address, raw(0).form),
            (Table::Input, 0, Form::F32)
        );
        assert_eq!((raw(1).scale, profile.points[1].note.as_str()), (0.001, "says \"W\""));
        assert_eq!(raw(2).form, Form::Bit { bit: 3, invert: false });
        assert_eq!((raw(3).table, raw(3).address), (Table::Holding, 256));
        assert_eq!(profile.points[3].range, Some(0.0..=100.0));
        assert!(profile.points[4].write && raw(4).table == Table::Coil);
        let ranges: Vec<_> = profile
            .ranges
            .iter()
            .map(|r| (r.table, r.addresses.clone(), r.read, r.write))
            .collect();
        assert_eq!(
            ranges,
            [
                (Table::Coil, 0..=0, 1, 1),
                (Table::Input, 0..=4, 5, 0),
                (Table::Holding, 256..=256, 1, 1)
            ]
        );
    }

    #[test]
    fn mistakes_have_the_line_of_the_list() {
        for (text, wanted) in [
            ("", "the list is empty; our meter 2.csv:1"),
            (
                "name,number_address\na,1\n",
                "unknown column `number_address`; our meter 2.csv:1, number_address; known: name, address",
            ),
            (
                "name,address\na,1\n\nb,x9\n",
                "`x9` is not an address; our meter 2.csv:4, address",
            ),
            (
                "name,address\n,1\n",
                "the register has no name; our meter 2.csv:2, name",
            ),
            (
                "name,address,type\na,1,u16\nb,2,u17\n",
                "unknown type `u17`; our meter 2.csv:3, type",
            ),
            (
                "name,address,scale\na,1,big\n",
                "`big` is not a number; our meter 2.csv:2, scale",
            ),
            (
                "name,address,write\na,1,maybe\n",
                "`maybe` is neither yes nor no; our meter 2.csv:2, write",
            ),
            (
                "name,address,min\na,1,3\n",
                "a range has two ends; our meter 2.csv:2, min",
            ),
            ("name,address\ntime,1\n", "our meter 2.csv:2, name"),
        ] {
            let all = made(text).unwrap_err();
            assert!(all.contains(wanted), "{wanted} is missing in\n{all}");
        }
    }
}
