//! Profile files: TOML to a validated [`Profile`], every fault with its line.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::model::ModelPoint;
use super::profile::{AddressRange, FaultText, Form, Point, PollClass, Profile, Profiles, Raw, Source};
use crate::codec::{Protocol, Table};
use crate::document::{self, Document, Problem, Reader};

const BUILT_IN: [(&str, &str); 1] = [("vacon-nx.toml", include_str!("../../profiles/vacon-nx.toml"))];

impl Profiles {
    /// The profiles that are part of the program.
    pub fn built_in() -> Profiles {
        let mut profiles = Profiles::default();
        for (file, source) in BUILT_IN {
            if let Ok(profile) = Profile::parse(file, source, true) {
                profiles.insert(profile);
            }
        }
        profiles
    }

    /// Adds the profiles of the files `*.toml` in `directory`; a built-in of the same name is replaced.
    pub fn load(&mut self, directory: &Path) -> Vec<Problem> {
        let mut problems = Vec::new();
        let files = match files_of(directory) {
            Ok(files) => files,
            Err(error) => {
                let message =
                    format!("cannot read the profile directory: {error}; check `profile_dirs` and permissions");
                let file = directory.display().to_string();
                return vec![Problem {
                    file,
                    line: None,
                    key: String::new(),
                    message,
                }];
            }
        };
        let mut seen: BTreeMap<String, PathBuf> = BTreeMap::new();
        for path in files {
            let parsed = document::read_file(&path)
                .map_err(|problem| vec![problem])
                .and_then(|source| Profile::parse(&path.display().to_string(), &source, false));
            match parsed {
                Ok(profile) => {
                    if let Some(other) = seen.insert(profile.name.clone(), path.clone()) {
                        problems.push(Problem {
                            file: path.display().to_string(),
                            line: None,
                            key: "name".to_string(),
                            message: format!(
                                "profile `{}` is also in {}; rename one of them",
                                profile.name,
                                other.display()
                            ),
                        });
                    }
                    self.insert(profile);
                }
                Err(found) => problems.extend(found),
            }
        }
        problems
    }
}

fn files_of(directory: &Path) -> std::io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == "toml") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

impl Profile {
    /// Reads and validates the profile `source`, the text of `file`.
    ///
    /// # Errors
    /// Every fault of the file, with line and key.
    pub fn parse(file: &str, source: &str, built_in: bool) -> Result<Profile, Vec<Problem>> {
        let document = Document::parse(file, source);
        let profile = read_profile(&document.reader(), built_in);
        let problems = document.into_problems();
        match profile {
            Some(profile) if problems.is_empty() => Ok(profile),
            _ => Err(problems),
        }
    }
}

fn read_profile(reader: &Reader<'_>, built_in: bool) -> Option<Profile> {
    let name: Option<String> = reader.required("name");
    if name.as_deref().is_some_and(|n| !is_name(n, '-')) {
        reader.problem("name", "the name may hold a-z, 0-9 and -; rename the profile");
    }
    let protocols = read_protocols(reader);
    let addresses = read_pair::<u8>(reader, "addresses").unwrap_or(1..=247);
    if addresses.is_empty() || *addresses.start() == 0 {
        reader.problem(
            "addresses",
            "the first address is 0 or above the last; write for example [1, 247]",
        );
    }
    let input_is_holding = reader.or("input_is_holding", false);
    let ranges: Vec<AddressRange> = reader.tables("range").into_iter().filter_map(read_range).collect();
    let tables = reader.tables("point");
    if tables.is_empty() {
        reader.problem("point", "the profile has no point; write at least one [[point]]");
    }
    let names: Vec<String> = tables.iter().map(|t| t.optional("name").unwrap_or_default()).collect();
    let points: Vec<Point> = tables
        .into_iter()
        .enumerate()
        .filter_map(|(i, table)| read_point(table, i, &names, &ranges))
        .collect();
    let mut faults = read_faults(reader, "faults", true);
    for (code, text) in read_faults(reader, "faults_unverified", false) {
        faults.entry(code).or_insert(text);
    }
    let model = ModelPoint::ALL
        .iter()
        .map(|m| points.iter().position(|p| p.model == Some(*m)))
        .collect();
    let profile = Profile {
        name: name.clone().unwrap_or_default(),
        title: reader.or("title", String::new()),
        source: reader.or("source", String::new()),
        built_in,
        protocols,
        bauds: reader.or("bauds", Vec::new()),
        addresses,
        turnaround: reader.or("turnaround", Duration::from_millis(2)),
        update_period: reader.or("update_period", Duration::from_millis(10)),
        confirm_within: reader.or("confirm_within", Duration::from_secs(2)),
        input_is_holding,
        simulator: reader.optional("simulator"),
        ranges,
        points,
        faults,
        model,
    };
    reader.finish();
    name.map(|_| profile)
}

fn read_protocols(reader: &Reader<'_>) -> Vec<Protocol> {
    let names: Vec<String> = reader.required("protocols").unwrap_or_default();
    let mut protocols = Vec::new();
    for name in names {
        match Protocol::from_name(&name) {
            Some(protocol) => protocols.push(protocol),
            None => {
                let known: Vec<&str> = Protocol::ALL.iter().map(|p| p.name()).collect();
                reader.problem(
                    "protocols",
                    format!("unknown protocol `{name}`; known: {}", known.join(", ")),
                );
            }
        }
    }
    protocols
}

fn read_pair<T: document::FromNode + Copy + PartialOrd>(reader: &Reader<'_>, key: &str) -> Option<RangeInclusive<T>> {
    let pair: Vec<T> = reader.optional(key)?;
    match pair.as_slice() {
        [low, high] if low <= high => Some(*low..=*high),
        _ => {
            reader.problem(key, "two values are wanted, the lower one first; write [low, high]");
            None
        }
    }
}

fn read_table(reader: &Reader<'_>, key: &str, text: &str) -> Option<Table> {
    let table = Table::from_name(text);
    if table.is_none() {
        reader.problem(
            key,
            format!("unknown table `{text}`; known: coil, discrete-input, input, holding"),
        );
    }
    table
}

fn read_range(reader: Reader<'_>) -> Option<AddressRange> {
    let text: Option<String> = reader.required("table");
    let table = text.and_then(|text| read_table(&reader, "table", &text));
    let first: Option<u16> = reader.required("first");
    let last: Option<u16> = reader.required("last");
    let read: u16 = reader.or("read", 1);
    let write: u16 = reader.or("write", 0);
    let holes = reader.or("holes", false);
    let note = reader.or("note", String::new());
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
            format!("{last} lies before the first address {first}; swap them"),
        );
    }
    if read == 0 || read > table.max_read() {
        reader.problem(
            "read",
            format!("{read} is out of range; write 1 to {}", table.max_read()),
        );
    }
    if write > 123 {
        reader.problem("write", format!("{write} is out of range; write 0 (read-only) to 123"));
    }
    reader.finish();
    Some(AddressRange {
        table,
        addresses: first..=last,
        read,
        write,
        holes,
        note,
    })
}

fn read_point(reader: Reader<'_>, index: usize, names: &[String], ranges: &[AddressRange]) -> Option<Point> {
    let name: String = reader.required("name").unwrap_or_default();
    if !is_name(&name, '_') {
        reader.problem("name", "a point's name is snake_case: a-z, 0-9 and _; rename the point");
    }
    if names.iter().take(index).any(|n| *n == name) {
        reader.problem("name", format!("there are two points `{name}`; rename one of them"));
    }
    let model = ModelPoint::from_name(&name);
    let source = if reader.has("derive") {
        read_derived(&reader, names)
    } else {
        read_raw(&reader, ranges)
    };
    let unit = match model {
        Some(model) => {
            if reader.has("unit") && reader.optional::<String>("unit").as_deref() != Some(model.unit()) {
                reader.problem(
                    "unit",
                    format!("the unit of `{name}` is fixed to `{}`; leave the key out", model.unit()),
                );
            }
            model.unit().to_string()
        }
        None => reader.or("unit", String::new()),
    };
    let derived = !matches!(source, Some(Source::Raw(_)));
    let class = if derived { PollClass::Never } else { read_class(&reader) };
    let point = Point {
        name,
        model,
        unit,
        class,
        write: reader.or("write", false),
        pulse: reader.or("pulse", false),
        range: read_pair::<f64>(&reader, "range"),
        verified: reader.or("verified", true),
        note: reader.or("note", String::new()),
        source: source.unwrap_or(Source::Band {
            of: index,
            minimum: index,
            maximum: index,
        }),
    };
    check_write(&reader, &point, ranges);
    reader.finish();
    Some(point)
}

fn read_class(reader: &Reader<'_>) -> PollClass {
    let class = reader.parsed("class", |text| match text {
        "fast" => Ok(PollClass::Fast),
        "slow" => Ok(PollClass::Slow),
        "once" => Ok(PollClass::Once),
        "never" => Ok(PollClass::Never),
        other => Err(format!("unknown poll class `{other}`; write fast, slow, once or never")),
    });
    class.unwrap_or(PollClass::Slow)
}

fn read_derived(reader: &Reader<'_>, names: &[String]) -> Option<Source> {
    reader.parsed("derive", |text| match text {
        "band" => Ok(()),
        other => Err(format!("unknown derivation `{other}`; known: band")),
    });
    let other = |key: &str| -> Option<usize> {
        let name: String = reader.required(key)?;
        let index = names.iter().position(|n| *n == name);
        if index.is_none() {
            let near = document::nearest(&name, names.iter().map(String::as_str));
            let remedy = near.map_or_else(
                || "name a point of this profile".to_string(),
                |n| format!("did you mean `{n}`?"),
            );
            reader.problem(key, format!("there is no point `{name}`; {remedy}"));
        }
        index
    };
    let (of, minimum, maximum) = (other("of"), other("minimum"), other("maximum"));
    Some(Source::Band {
        of: of?,
        minimum: minimum?,
        maximum: maximum?,
    })
}

/// `holding 2100.3`: table, PDU address, bit.
fn read_raw(reader: &Reader<'_>, ranges: &[AddressRange]) -> Option<Source> {
    let at: String = reader.required("at")?;
    let bad =
        || format!("`{at}` is no place; write table and PDU address, such as \"holding 2103\" or \"holding 2100.3\"");
    let Some((table, place)) = at.split_once(' ') else {
        reader.problem("at", bad());
        return None;
    };
    let table = read_table(reader, "at", table)?;
    let (address, bit) = match place.split_once('.') {
        Some((address, bit)) => (
            address.parse::<u16>().ok(),
            bit.parse::<u8>().ok().filter(|b| *b < 16).map(Some),
        ),
        None => (place.parse::<u16>().ok(), Some(None)),
    };
    let (Some(address), Some(bit)) = (address, bit) else {
        reader.problem("at", bad());
        return None;
    };
    let invert = reader.or("invert", false);
    let form = read_form(reader, table, bit, invert)?;
    let raw = Raw {
        table,
        address,
        form,
        scale: reader.or("scale", 1.0),
        offset: reader.or("offset", 0.0),
    };
    if raw.scale == 0.0 {
        reader.problem(
            "scale",
            "a scale of 0 loses every value; write the engineering value of one count",
        );
    }
    if !ranges
        .iter()
        .any(|r| r.table == table && r.addresses.contains(&address))
    {
        reader.problem(
            "at",
            format!("{table} {address} lies in no [[range]] of the profile; add the range"),
        );
    }
    Some(Source::Raw(raw))
}

fn read_form(reader: &Reader<'_>, table: Table, bit: Option<u8>, invert: bool) -> Option<Form> {
    let kind: Option<String> = reader.optional("type");
    match (table.is_bits(), bit, kind.as_deref()) {
        (true, None, None) => Some(Form::Bit { bit: 0, invert }),
        (false, Some(bit), None) => Some(Form::Bit { bit, invert }),
        (false, None, None | Some("u16")) => Some(Form::U16),
        (false, None, Some("i16")) => Some(Form::I16),
        (false, None, Some(other)) => {
            reader.problem("type", format!("unknown type `{other}`; known: u16, i16"));
            None
        }
        (true, _, _) => {
            reader.problem(
                "at",
                "an item of a bit table has neither bit number nor type; leave them out",
            );
            None
        }
        (false, Some(_), Some(_)) => {
            reader.problem("type", "a bit has no type; leave the key out");
            None
        }
    }
}

fn check_write(reader: &Reader<'_>, point: &Point, ranges: &[AddressRange]) {
    if point.pulse && !point.write {
        reader.problem(
            "pulse",
            "only a point that can be written can be a pulse; add `write = true`",
        );
    }
    let Some(raw) = point.raw().filter(|_| point.write) else {
        return;
    };
    let writable = ranges
        .iter()
        .any(|r| r.table == raw.table && r.addresses.contains(&raw.address) && r.write > 0);
    if !writable {
        reader.problem(
            "write",
            format!(
                "{} {} lies in a read-only range; set `write` there",
                raw.table, raw.address
            ),
        );
    }
}

fn read_faults(reader: &Reader<'_>, key: &str, verified: bool) -> BTreeMap<u16, FaultText> {
    let Some(table) = reader.table(key) else {
        return BTreeMap::new();
    };
    let mut faults = BTreeMap::new();
    for code in table.keys() {
        let text: Option<String> = table.optional(code);
        match (code.parse::<u16>(), text) {
            (Ok(number), Some(text)) => {
                faults.insert(number, FaultText { text, verified });
            }
            (Err(_), _) => table.problem(
                code,
                format!("`{code}` is no fault code; write a number from 0 to 65535"),
            ),
            (Ok(_), None) => {}
        }
    }
    table.finish();
    faults
}

/// Lower-case letters, digits and `joint`, beginning with a letter.
fn is_name(text: &str, joint: char) -> bool {
    text.starts_with(|c: char| c.is_ascii_lowercase())
        && text
            .chars()
            .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == joint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_profiles_are_valid() {
        for (file, source) in BUILT_IN {
            let found = Profile::parse(file, source, true).err().unwrap_or_default();
            assert!(
                found.is_empty(),
                "{}",
                found.iter().map(Problem::to_string).collect::<Vec<_>>().join("\n")
            );
        }
        assert_eq!(Profiles::built_in().iter().count(), BUILT_IN.len());
    }

    #[test]
    fn every_mistake_is_told() {
        let source = r#"
name = "My Meter"
protocols = ["modbus-rut"]
[[range]]
table = "holding"
first = 10
last = 5
[[point]]
name = "ready"
at = "holding 10.16"
[[point]]
name = "a"
at = "holding 900"
scael = 2
[[point]]
name = "a"
at = "holding 7"
type = "f16"
unit = "V"
[faults]
x = "y"
"#;
        let found = Profile::parse("meter.toml", source, false).unwrap_err();
        let text: Vec<String> = found.iter().map(Problem::to_string).collect();
        let all = text.join("\n");
        for wanted in [
            "meter.toml:2, name",
            "meter.toml:3, protocols; known: modbus-rtu",
            "meter.toml:7, range[0].last",
            "meter.toml:10, point[0].at",
            "meter.toml:13, point[1].at; add the range",
            "meter.toml:14, point[1].scael; did you mean `scale`?",
            "meter.toml:16, point[2].name",
            "meter.toml:18, point[2].type; known: u16, i16",
            "meter.toml:21, faults.x",
        ] {
            assert!(all.contains(wanted), "{wanted} is missing in\n{all}");
        }
    }
}
