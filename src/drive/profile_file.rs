//! Profile files: TOML to a validated [`Profile`], every fault with its line.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::derive::{Bound, Derived};
use super::model::ModelPoint;
use super::profile::{AddressRange, FaultText, Form, Point, PollClass, Profile, Profiles, Raw, Source, WordOrder};
use crate::codec::{Protocol, Table};
use crate::document::{self, Document, Problem, Reader};

const BUILT_IN: [(&str, &str); 8] = [
    ("eaton-hvx-n2.toml", include_str!("../../profiles/eaton-hvx-n2.toml")),
    ("eaton-hvx.toml", include_str!("../../profiles/eaton-hvx.toml")),
    ("eaton-svx.toml", include_str!("../../profiles/eaton-svx.toml")),
    (
        "teco-7300pa-n2.toml",
        include_str!("../../profiles/teco-7300pa-n2.toml"),
    ),
    ("teco-7300pa.toml", include_str!("../../profiles/teco-7300pa.toml")),
    ("vacon-cx.toml", include_str!("../../profiles/vacon-cx.toml")),
    ("vacon-nx-n2.toml", include_str!("../../profiles/vacon-nx-n2.toml")),
    ("vacon-nx.toml", include_str!("../../profiles/vacon-nx.toml")),
];

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
    let offsets = Offsets::read(reader);
    let ranges: Vec<AddressRange> = reader
        .tables("range")
        .into_iter()
        .filter_map(|table| read_range(table, &offsets))
        .collect();
    let tables = reader.tables("point");
    if tables.is_empty() {
        reader.problem("point", "the profile has no point; write at least one [[point]]");
    }
    let names: Vec<String> = tables.iter().map(|t| t.optional("name").unwrap_or_default()).collect();
    let points: Vec<Point> = (0..)
        .zip(&tables)
        .filter_map(|(i, table)| read_point(table, i, &names, &ranges, &offsets))
        .collect();
    for (index, table) in tables.iter().enumerate() {
        check_derived(table, index, &points);
        check_target(table, index, &points);
    }
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

fn read_range(reader: Reader<'_>, offsets: &Offsets) -> Option<AddressRange> {
    let text: Option<String> = reader.required("table");
    let table = text.and_then(|text| read_table(&reader, "table", &text));
    let first: Option<u16> = reader.required("first");
    let last: Option<u16> = reader.required("last");
    let read: u16 = reader.or("read", 1);
    let write: u16 = reader.or("write", 0);
    let holes = reader.or("holes", false);
    let note = reader.or("note", String::new());
    let write_when = reader.or("write_when", String::new());
    let first = first.and_then(|at| offsets.applied(&reader, "first", table?, at));
    let last = last.and_then(|at| offsets.applied(&reader, "last", table?, at));
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
        write_when,
        note,
    })
}

fn read_point(
    reader: &Reader<'_>,
    index: usize,
    names: &[String],
    ranges: &[AddressRange],
    offsets: &Offsets,
) -> Option<Point> {
    let name: String = reader.required("name").unwrap_or_default();
    if !is_name(&name, '_') {
        reader.problem("name", "a point's name is snake_case: a-z, 0-9 and _; rename the point");
    }
    if names.iter().take(index).any(|n| *n == name) {
        reader.problem("name", format!("there are two points `{name}`; rename one of them"));
    }
    let model = ModelPoint::from_name(&name);
    let source = if reader.has("derive") {
        read_derived(reader, names)
    } else {
        read_raw(reader, ranges, offsets)
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
    let class = if derived { PollClass::Never } else { read_class(reader) };
    let point = Point {
        name,
        model,
        unit,
        class,
        write: reader.or("write", false),
        write_to: reader
            .optional::<String>("write_to")
            .and_then(|name| point_of(reader, "write_to", &name, names)),
        pulse: reader.or("pulse", false),
        on_change: reader.or("on_change", false),
        range: read_pair::<f64>(reader, "range"),
        texts: read_texts(reader),
        verified: reader.or("verified", true),
        note: reader.or("note", String::new()),
        source: source.unwrap_or(Source::Derived(Derived::All { of: Vec::new() })),
    };
    check_write(reader, &point, ranges);
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
    const KNOWN: [&str; 6] = ["band", "percent", "zero", "equal", "all", "lowest_bit"];
    let kind = reader.parsed("derive", |text| {
        let known = KNOWN.into_iter().find(|known| *known == text);
        known.ok_or_else(|| format!("unknown derivation `{text}`; known: {}", KNOWN.join(", ")))
    })?;
    let index = |key: &str, name: &str| point_of(reader, key, name, names);
    let other = |key: &str| -> Option<usize> { index(key, &reader.required::<String>(key)?) };
    let within = |default: f64| reader.or("within", default);
    let derived = match kind {
        "band" | "percent" => {
            let (of, minimum, maximum) = (
                other("of"),
                read_bound(reader, "minimum", names, Some(Bound::Fixed(0.0))),
                read_bound(reader, "maximum", names, None),
            );
            let (of, minimum, maximum) = (of?, minimum?, maximum?);
            if kind == "band" {
                Derived::Band { of, minimum, maximum }
            } else {
                Derived::Percent { of, minimum, maximum }
            }
        }
        "zero" => Derived::Zero {
            of: other("of")?,
            within: within(0.0),
        },
        "equal" => {
            let (of, to) = (other("of"), other("to"));
            Derived::Equal {
                of: of?,
                to: to?,
                within: within(0.0),
            }
        }
        "all" => {
            let all: Vec<String> = reader.required("of")?;
            let of: Option<Vec<usize>> = all.iter().map(|name| index("of", name)).collect();
            Derived::All { of: of? }
        }
        _ => Derived::LowestBit { of: other("of")? },
    };
    Some(Source::Derived(derived))
}

fn point_of(reader: &Reader<'_>, key: &str, name: &str, names: &[String]) -> Option<usize> {
    let index = names.iter().position(|n| n == name);
    if index.is_none() {
        let near = document::nearest(name, names.iter().map(String::as_str));
        let remedy = near.map_or_else(
            || "name a point of this profile".to_string(),
            |n| format!("did you mean `{n}`?"),
        );
        reader.problem(key, format!("there is no point `{name}`; {remedy}"));
    }
    index
}

/// The end of a band: the name of a point, or a figure.
fn read_bound(reader: &Reader<'_>, key: &str, names: &[String], default: Option<Bound>) -> Option<Bound> {
    match reader.raw(key).map(|node| &node.value) {
        None if default.is_some() => default,
        Some(document::Raw::Float(_) | document::Raw::Integer(_)) => reader.optional(key).map(Bound::Fixed),
        _ => {
            let name: String = reader.required(key)?;
            point_of(reader, key, &name, names).map(Bound::Point)
        }
    }
}

/// What is told of derived points: they rest on points that the drive tells itself.
fn check_derived(reader: &Reader<'_>, index: usize, points: &[Point]) {
    let Some(Source::Derived(derived)) = points.get(index).map(|p| &p.source) else {
        return;
    };
    let ends = derived.band().map(|(_, low, high)| [low, high]).into_iter().flatten();
    let ends = ends.filter_map(|bound| match bound {
        Bound::Point(point) => Some(point),
        Bound::Fixed(_) => None,
    });
    for source in derived.sources().into_iter().chain(ends) {
        if let Some(point) = points.get(source).filter(|p| p.raw().is_none()) {
            reader.problem(
                "derive",
                format!("`{}` is derived itself; name points that have `at`", point.name),
            );
        }
    }
}

/// Commands for another point: that one must take them, and may not pass them on again.
fn check_target(reader: &Reader<'_>, index: usize, points: &[Point]) {
    let Some(point) = points.get(index) else { return };
    let Some(target) = point.write_to.and_then(|to| points.get(to)) else {
        return;
    };
    if !point.write {
        reader.problem("write_to", "the point is not written at all; add `write = true`");
    }
    if !target.write || target.write_to.is_some() {
        reader.problem(
            "write_to",
            format!(
                "`{}` takes no commands itself; name a point with `write = true` and without `write_to`",
                target.name
            ),
        );
    } else if target.kind() != point.kind() {
        reader.problem(
            "write_to",
            format!("`{}` is of another kind; name a point with like values", target.name),
        );
    }
}

/// `address_offset`: what the addresses of each table are shifted by on the wire.
#[derive(Debug, Default)]
struct Offsets(BTreeMap<Table, i64>);

impl Offsets {
    const TABLES: [Table; 4] = [Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding];

    fn read(reader: &Reader<'_>) -> Offsets {
        let mut offsets = Offsets::default();
        let Some(given) = reader.table("address_offset") else {
            return offsets;
        };
        for table in Self::TABLES {
            let shift: i64 = given.or(table.name(), 0);
            if (-1..=1).contains(&shift) {
                offsets.0.insert(table, shift);
            } else {
                given.problem(table.name(), format!("{shift} is out of range; write -1, 0 or 1"));
            }
        }
        given.finish();
        offsets
    }

    fn applied(&self, reader: &Reader<'_>, key: &str, table: Table, address: u16) -> Option<u16> {
        let offset = self.0.get(&table).copied().unwrap_or(0);
        let shifted = u16::try_from(i64::from(address) + offset).ok();
        if shifted.is_none() {
            reader.problem(
                key,
                format!("{table} {address} shifted by {offset} is no address; correct `address_offset` or the address"),
            );
        }
        shifted
    }
}

/// `[point.texts]`: what the values of an enumeration mean.
fn read_texts(reader: &Reader<'_>) -> BTreeMap<i64, String> {
    let Some(table) = reader.table("texts") else {
        return BTreeMap::new();
    };
    let mut texts = BTreeMap::new();
    for key in table.keys() {
        let text: Option<String> = table.optional(key);
        match (key.parse::<i64>(), text) {
            (Ok(value), Some(text)) => {
                texts.insert(value, text);
            }
            (Err(_), _) => table.problem(key, format!("`{key}` is no whole number; write value = \"meaning\"")),
            (Ok(_), None) => {}
        }
    }
    table.finish();
    texts
}

/// `holding 2100.3`: table, PDU address, bit.
fn read_raw(reader: &Reader<'_>, ranges: &[AddressRange], offsets: &Offsets) -> Option<Source> {
    let at: String = reader.required("at")?;
    let bad =
        || format!("`{at}` is no place; write table and PDU address, such as \"holding 2103\" or \"holding 2100.3\"");
    let Some((table, place)) = at.split_once(' ') else {
        reader.problem("at", bad());
        return None;
    };
    let table = read_table(reader, "at", table)?;
    let (address, bits) = match place.split_once('.') {
        Some((address, bits)) => (parse_address(address), parse_bits(bits).map(Some)),
        None => (parse_address(place), Some(None)),
    };
    let (Some(address), Some(bits)) = (address, bits) else {
        reader.problem("at", bad());
        return None;
    };
    let address = offsets.applied(reader, "at", table, address)?;
    let invert = reader.or("invert", false);
    let form = read_form(reader, table, bits, invert)?;
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
    check_place(reader, &raw, ranges);
    Some(Source::Raw(raw))
}

/// A PDU address, decimal or as the hexadecimal number of a manual (0x0023).
fn parse_address(text: &str) -> Option<u16> {
    match text.strip_prefix("0x") {
        Some(hex) => u16::from_str_radix(hex, 16).ok(),
        None => text.parse().ok(),
    }
}

/// `3` is one bit, `4-7` a field: the first bit and how many.
fn parse_bits(text: &str) -> Option<(u8, u8)> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    let (first, last): (u8, u8) = (first.parse().ok()?, last.parse().ok()?);
    (first <= last && last < 16).then(|| (first, last - first + 1))
}

fn check_place(reader: &Reader<'_>, raw: &Raw, ranges: &[AddressRange]) {
    let Raw {
        table, address, form, ..
    } = raw;
    let range = ranges
        .iter()
        .find(|r| r.table == *table && r.addresses.contains(address));
    let Some(range) = range else {
        reader.problem(
            "at",
            format!("{table} {address} lies in no [[range]] of the profile; add the range"),
        );
        return;
    };
    let items = form.items();
    if raw.addresses().count() != usize::from(items) || raw.addresses().any(|a| !range.addresses.contains(&a)) {
        reader.problem(
            "at",
            format!("{table} {address} takes {items} registers, which its [[range]] does not hold; widen the range"),
        );
    } else if items > range.read {
        reader.problem(
            "type",
            format!(
                "the value takes {items} registers, its [[range]] reads {}; raise `read` there",
                range.read
            ),
        );
    }
}

fn read_form(reader: &Reader<'_>, table: Table, bits: Option<(u8, u8)>, invert: bool) -> Option<Form> {
    let kind: Option<String> = reader.optional("type");
    let words = match reader.optional::<String>("words").as_deref() {
        None | Some("high-first") => WordOrder::HighFirst,
        Some("low-first") => WordOrder::LowFirst,
        Some(other) => {
            reader.problem(
                "words",
                format!("unknown word order `{other}`; write high-first or low-first"),
            );
            WordOrder::HighFirst
        }
    };
    match (table.is_bits(), bits, kind.as_deref()) {
        (true, None, None) => Some(Form::Bit { bit: 0, invert }),
        (false, Some((bit, 1)), None) => Some(Form::Bit { bit, invert }),
        (false, Some((first, count)), None) => Some(Form::Bits { first, count }),
        (false, None, Some(text)) => form_of(reader, text, words),
        (false, None, None) => Some(Form::U16),
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

fn form_of(reader: &Reader<'_>, kind: &str, words: WordOrder) -> Option<Form> {
    let form = match kind {
        "u16" => Form::U16,
        "i16" => Form::I16,
        "u32" => Form::U32(words),
        "i32" => Form::I32(words),
        "f32" => Form::F32(words),
        other => {
            reader.problem(
                "type",
                format!("unknown type `{other}`; known: u16, i16, u32, i32, f32"),
            );
            return None;
        }
    };
    if form.items() == 1 && reader.has("words") {
        reader.problem(
            "words",
            format!("a {kind} is one register and has no word order; leave the key out"),
        );
    }
    Some(form)
}

fn check_write(reader: &Reader<'_>, point: &Point, ranges: &[AddressRange]) {
    if point.pulse && !point.write {
        reader.problem(
            "pulse",
            "only a point that can be written can be a pulse; add `write = true`",
        );
    }
    let Some(raw) = point.raw().filter(|_| point.write && !reader.has("write_to")) else {
        return;
    };
    let range = ranges
        .iter()
        .find(|r| r.table == raw.table && r.addresses.contains(&raw.address));
    let (most, items) = (range.map_or(0, |r| r.write), raw.form.items());
    if most == 0 {
        reader.problem(
            "write",
            format!(
                "{} {} lies in a read-only range; set `write` there",
                raw.table, raw.address
            ),
        );
    } else if most < items {
        reader.problem(
            "write",
            format!("the value takes {items} registers, its range writes {most}; raise `write` there"),
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
            "meter.toml:3, protocols; known: modbus-rtu, modbus-ascii, n2",
            "meter.toml:7, range[0].last",
            "meter.toml:10, point[0].at",
            "meter.toml:13, point[1].at; add the range",
            "meter.toml:14, point[1].scael; did you mean `scale`?",
            "meter.toml:16, point[2].name",
            "meter.toml:18, point[2].type; known: u16, i16, u32, i32, f32",
            "meter.toml:21, faults.x",
        ] {
            assert!(all.contains(wanted), "{wanted} is missing in\n{all}");
        }
    }
}
