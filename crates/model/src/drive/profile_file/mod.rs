//! Profile files: parses TOML into a validated [`Profile`] and reports every error with its line. `BUILT_IN` lists
//! the profiles that are part of the program.

mod base;
mod commissioning;
mod control;
mod derived;
mod identify;
mod interpretation;
mod n2;
mod parameter_rules;
mod parameters;
mod place;
mod points;
mod ranges;
mod reference;
mod reset;
mod states;
mod whole_profile;

use crate::drive::{PerPoint, PointIndex};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use super::model::ModelPoint;
use super::parameters::ParameterList;
use super::profile::{AddressRange, FaultText, Point, Profile, Profiles, Source};
use crate::document::{self, Document, Finding, Node, Problem, Reader};
use derived::{check_derived, check_sums, keep_ends_fresh};
use drivegate_proto::{LineFormat, Protocol};
use points::{check_factors, check_monitor, check_object, check_scale, check_target, read_point};
use ranges::{Offsets, check_overlaps, read_functions, read_range};

macro_rules! files {
    ($($name:literal,)*) => {
        &[$(($name, include_str!(concat!("../../../../../profiles/", $name))),)*]
    };
}

/// The built-in profiles. A base precedes the profiles that are based on it, and has no base itself.
const BUILT_IN: &[(&str, &str)] = files![
    "eaton-hvx-n2.toml",
    "eaton-hvx.toml",
    "eaton-svx.toml",
    "teco-7300pa-n2.toml",
    "teco-7300pa.toml",
    "vacon-cx.toml",
    "vacon-nx-n2.toml",
    "vacon-nx.toml",
    "eaton-svx-multipurpose.toml",
    "eaton-svx-pid.toml",
    "eaton-svx-pump-fan.toml",
    "vacon-nx-multipurpose.toml",
    "vacon-nx-pid.toml",
    "vacon-nx-pump-fan.toml",
    "abb-acs550.toml",
    "abb-acs580.toml",
    "danfoss-fc.toml",
    "danfoss-fc51.toml",
    "delta-ms300.toml",
    "fuji-frenic.toml",
    "hitachi-wj200.toml",
    "invertek-optidrive.toml",
    "invertek-eco.toml",
    "invt-goodrive.toml",
    "lenze-i550.toml",
    "ls-g100.toml",
    "mitsubishi-d700.toml",
    "schneider-altivar.toml",
    "siemens-g120.toml",
    "siemens-v20.toml",
    "teco-f510.toml",
    "toshiba-vf-s15.toml",
    "vacon-10.toml",
    "weg-cfw.toml",
    "yaskawa-v1000.toml",
];

/// Maximum number of nested bases that are followed; no valid set of files has that many.
const MOST_BASES: usize = 16;

impl Profiles {
    /// The profiles that are part of the program.
    pub fn built_in() -> Profiles {
        static READ: LazyLock<Profiles> = LazyLock::new(|| {
            let mut profiles = Profiles::default();
            for &(file, source) in BUILT_IN {
                if let Ok(profile) = Profile::parse_over(file, source, true, &profiles) {
                    profiles.insert(Profile {
                        text: Cow::Borrowed(source),
                        ..profile
                    });
                }
            }
            profiles
        });
        READ.clone()
    }

    /// The name and the base in a profile file; `None` for what is missing or cannot be read.
    pub fn names_in(file: &Path) -> (Option<String>, Option<String>) {
        let source = document::read_file(file).unwrap_or_default();
        base::peek(&Document::parse(file.display().to_string(), &source))
    }

    /// Adds the profiles of the files `*.toml` in `directory`; they replace built-in ones with equal names. A file
    /// may have any other of them as its `base`, in any order.
    pub fn load(&mut self, directory: &Path) -> Vec<Problem> {
        let mut problems = Vec::new();
        let files = match files_of(directory) {
            Ok(files) => files,
            Err(error) => {
                let what = format!("cannot read the profile directory: {error}");
                let finding = Finding::new(what, "check its path and its permissions");
                return vec![Problem::of_file(directory.display().to_string(), "", finding)];
            }
        };
        let mut waiting = Vec::new();
        for path in files {
            let file = path.display().to_string();
            match document::read_file(&path) {
                Ok(source) if is_configuration(&Document::parse(&file, &source)) => {
                    let what = "this is a configuration, not a profile";
                    let finding = Finding::new(what, "move it out of the directory of the profiles");
                    problems.push(Problem::of_file(file, "", finding));
                }
                Ok(source) => waiting.push(Waiting::new(file, source)),
                Err(problem) => problems.push(problem),
            }
        }
        let mut seen: BTreeMap<String, String> = BTreeMap::new();
        while let Some(next) = waiting.iter().position(|file| !file.waits_for_any_of(&waiting)) {
            let Waiting { file, source, .. } = waiting.remove(next);
            match Profile::parse_over(&file, &source, false, self) {
                Ok(profile) => {
                    if let Some(other) = seen.insert(profile.name.clone(), file.clone()) {
                        let what = format!("profile `{}` is also in {other}", profile.name);
                        problems.push(Problem::of_file(file, "name", Finding::new(what, "rename one of them")));
                    }
                    self.insert(profile);
                }
                Err(found) => problems.extend(found),
            }
        }
        for file in waiting {
            let base = file.base.unwrap_or_default();
            let what = format!("`{base}` is itself based on this profile");
            problems.push(Problem::of_file(
                file.file,
                "base",
                Finding::new(what, "remove the base of one of them"),
            ));
        }
        problems
    }
}

/// Whether a file in a profile directory is a configuration of the gateway.
fn is_configuration(document: &Document) -> bool {
    let has = |key: &str| document.root().entry(key).is_some();
    !has("name") && (has("gateway") || has("bus"))
}

/// A file whose base may not have been read yet.
struct Waiting {
    file: String,
    source: String,
    name: Option<String>,
    base: Option<String>,
}

impl Waiting {
    fn new(file: String, source: String) -> Waiting {
        let (name, base) = base::peek(&Document::parse(&file, &source));
        Waiting {
            file,
            source,
            name,
            base,
        }
    }

    /// Whether the file waits for one of these files; a file that replaces its own base does not wait.
    fn waits_for_any_of(&self, files: &[Waiting]) -> bool {
        self.base.is_some() && self.base != self.name && files.iter().any(|other| other.name == self.base)
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
    /// Reads and validates the profile `source`, the text of `file`, whose base can only be a built-in profile.
    ///
    /// # Errors
    /// If the file is invalid; contains every error with line and key.
    pub fn parse(file: &str, source: &str, built_in: bool) -> Result<Profile, Vec<Problem>> {
        Profile::parse_over(file, source, built_in, &Profiles::built_in())
    }

    /// Parses a profile file over its base among the `known` profiles.
    ///
    /// # Errors
    /// If the file is invalid; contains every error with line and key.
    pub fn parse_over(file: &str, source: &str, built_in: bool, known: &Profiles) -> Result<Profile, Vec<Problem>> {
        let mut document = Document::parse(file, source);
        let (_, base) = base::peek(&document);
        if let Some(under) = base.as_deref().and_then(|base| known.get(base)) {
            base::lay_over(&mut document, &tree_of(under), &under.name);
        }
        base::change_points(&mut document);
        let profile = read_profile(&document.reader(), built_in, known);
        let tree = (!built_in).then(|| document.root().clone());
        let (problems, warnings) = document.into_findings();
        match profile {
            Some(profile) if problems.is_empty() => Ok(Profile {
                text: Cow::Owned(source.to_string()),
                tree,
                warnings,
                ..profile
            }),
            _ => Err(problems),
        }
    }
}

/// The file of a profile merged with its base. The base of a built-in one is a built-in one without a base.
fn tree_of(profile: &Profile) -> Node {
    if let Some(tree) = &profile.tree {
        return tree.clone();
    }
    let mut document = Document::parse(&profile.name, &profile.text);
    if let Some(base) = &profile.base
        && let Some(under) = Profiles::built_in().get(base)
    {
        base::lay_over(&mut document, &tree_of(under), base);
    }
    document.root().clone()
}

fn read_profile(reader: &Reader<'_>, built_in: bool, known: &Profiles) -> Option<Profile> {
    let name: Option<String> = reader.required("name");
    if name.as_deref().is_some_and(|n| !is_name(n, '-')) {
        let what = format!("`{}` is not a valid name", name.as_deref().unwrap_or_default());
        reader.problem("name", what, "write a-z, 0-9 and -, starting with a letter");
    }
    let base = read_base(reader, known);
    let protocols = read_protocols(reader);
    let addresses = read_pair::<u8>(reader, "addresses").unwrap_or(1..=247);
    if addresses.is_empty() || *addresses.start() == 0 {
        reader.problem(
            "addresses",
            "the first address is 0 or above the last",
            "write for example [1, 247]",
        );
    }
    let input_is_holding = reader.or("input_is_holding", false);
    let offsets = Offsets::read(reader);
    let ranges: Vec<AddressRange> = reader
        .tables("range")
        .iter()
        .filter_map(|table| read_range(table, &offsets))
        .collect();
    check_overlaps(reader, &ranges);
    let tables = reader.tables("point");
    if tables.is_empty() {
        reader.problem("point", "the profile has no point", "write at least one [[point]]");
    }
    let names: Vec<String> = tables.iter().map(|t| t.optional("name").unwrap_or_default()).collect();
    let mut points: PerPoint<Point> = tables
        .iter()
        .enumerate()
        .map(|(place, table)| read_point(table, place, &names, &ranges, &offsets))
        .collect();
    if protocols.contains(&Protocol::N2) {
        n2::write_on_change(&tables, &mut points);
    }
    reference::apply(reader, &mut points);
    keep_ends_fresh(&mut points);
    for (index, table) in points.indexes().zip(&tables) {
        check_derived(table, index, &points);
        check_target(table, index, &points);
        check_monitor(table, index, &points);
        check_scale(table, index, &points);
        check_factors(table, index, &points);
        if protocols.contains(&Protocol::N2) {
            check_object(table, index, &points);
        }
    }
    let update_period = reader.or("update_period", Duration::from_millis(10));
    let around = control::Around {
        points: &points,
        names: &names,
        ranges: &ranges,
        offsets: &offsets,
        update_period,
    };
    let control = control::read(reader, &around);
    let made = states::read(reader, &around);
    let follow = control
        .as_ref()
        .map(|control| control::made_points(control, &points, made.len()));
    for point in made.into_iter().chain(follow.unwrap_or_default()) {
        if names.contains(&point.name) && !point.hidden {
            let what = format!("`{}` follows from [control] or [[state]]", point.name);
            reader.problem("point", what, "leave its [[point]] out");
        }
        points.push(point);
    }
    let mut faults = read_faults(reader, "faults", true);
    for (code, text) in read_faults(reader, "faults_unverified", false) {
        faults.entry(code).or_insert(text);
    }
    read_fault_help(reader, "fault_panel", &mut faults, |fault| &mut fault.panel);
    read_fault_help(reader, "fault_causes", &mut faults, |fault| &mut fault.cause);
    read_fault_help(reader, "fault_remedies", &mut faults, |fault| &mut fault.remedy);
    let model = ModelPoint::ALL
        .iter()
        .map(|m| points.position(|p| p.model == Some(*m)))
        .collect();
    let bases = parameters_of_bases(base.as_deref(), known);
    let mut profile = Profile {
        name: name.clone().unwrap_or_default(),
        title: reader.or("title", String::new()),
        source: reader.or("source", String::new()),
        built_in,
        base,
        bauds: reader.or("bauds", Vec::new()),
        formats: read_formats(reader),
        n2: n2::read_n2(reader, &protocols),
        protocols,
        addresses,
        turnaround: reader.or("turnaround", Duration::from_millis(2)),
        update_period,
        confirm_within: reader.or("confirm_within", Duration::from_secs(2)),
        input_is_holding,
        identify: identify::read(reader),
        nameplates: identify::nameplates(reader),
        simulator: reader.optional("simulator"),
        counts_messages: reader.or("counts_messages", false),
        may_stop_by_itself: reader.or("may_stop_by_itself", false),
        broadcast_stop: reader.or("broadcast_stop", false),
        on_fault: read_on_fault(reader, &points),
        control,
        verified: reader.or("verified", true),
        parameters: parameters::read(reader, &bases, &points, &ranges),
        functions: read_functions(reader, &ranges),
        ranges,
        points,
        faults,
        timeout_faults: reader.or("timeout_faults", Vec::new()),
        commissioning: commissioning::read(reader),
        identified: reader.or("identified", String::new()),
        model,
        text: Cow::Borrowed(""),
        tree: None,
        warnings: Vec::new(),
    };
    if profile.control.is_none() {
        profile.control = profile.control_of_bits();
    }
    check_sums(&tables, &profile);
    whole_profile::check(reader, &profile);
    if profile.broadcast_stop && (profile.protocols.contains(&Protocol::N2) || profile.broadcast_stop().is_none()) {
        reader.problem(
            "broadcast_stop",
            "no broadcast can stop these drives: writing 0 to the register or coil of `run` does not stop them, or \
             the protocol is n2",
            "leave the key out",
        );
    }
    reader.finish();
    name.map(|_| profile)
}

/// The parameters of the base, of the base of that profile, and so on.
fn parameters_of_bases<'k>(base: Option<&str>, known: &'k Profiles) -> Vec<&'k ParameterList> {
    let first = base.and_then(|base| known.get(base));
    let next = |profile: &&'k Arc<Profile>| {
        // A profile that has replaced its own base is the last one in the chain.
        let base = profile.base.as_deref().filter(|base| *base != profile.name)?;
        known.get(base)
    };
    let all = std::iter::successors(first, next).take(MOST_BASES);
    all.map(|profile| &profile.parameters).collect()
}

/// Reads `on_fault`: points that are read at once when a fault appears; for a derived one, the points it is derived from.
fn read_on_fault(reader: &Reader<'_>, points: &PerPoint<Point>) -> Vec<PointIndex> {
    let names: Vec<String> = reader.or("on_fault", Vec::new());
    let mut found = Vec::new();
    for name in names {
        let index = points.position(|point| point.name == name);
        match index.map(|index| (index, points.get(index).map(|point| &point.source))) {
            Some((_, Some(Source::Derived(derived)))) => found.extend(derived.rests_on()),
            Some((index, _)) => found.push(index),
            None => {
                let near = document::nearest(&name, points.iter().map(|point| point.name.as_str()));
                let near = near.map(|near| format!("did you mean `{near}`?"));
                let remedy = near.unwrap_or_else(|| "name points of the profile".to_string());
                reader.problem("on_fault", format!("there is no point `{name}`"), remedy);
            }
        }
    }
    found
}

/// The base of this profile. The files are merged by now, so only an unknown name remains to be reported.
fn read_base(reader: &Reader<'_>, known: &Profiles) -> Option<String> {
    let base: String = reader.optional("base")?;
    if known.get(&base).is_none() {
        let near = document::nearest(&base, known.names()).map(|near| format!("did you mean `{near}`?"));
        let names: Vec<&str> = known.names().collect();
        let remedy = near.unwrap_or_else(|| format!("known profiles: {}", names.join(", ")));
        reader.problem("base", format!("there is no valid profile `{base}`"), remedy);
        // An unknown key may be explained by the faulty base.
        reader.tolerate();
    }
    Some(base)
}

fn read_protocols(reader: &Reader<'_>) -> Vec<Protocol> {
    let names: Vec<String> = reader.required("protocols").unwrap_or_default();
    let none_named = names.is_empty() && reader.has("protocols");
    let mut protocols = Vec::new();
    for name in names {
        match Protocol::from_name(&name) {
            Some(protocol) => protocols.push(protocol),
            None => {
                let known: Vec<&str> = Protocol::ALL.iter().map(|p| p.name()).collect();
                reader.problem(
                    "protocols",
                    format!("unknown protocol `{name}`"),
                    format!("known: {}", known.join(", ")),
                );
            }
        }
    }
    if none_named {
        reader.problem("protocols", "the list is empty", "write for example [\"modbus-rtu\"]");
    }
    if protocols.len() > 1 && protocols.contains(&Protocol::N2) {
        reader.problem(
            "protocols",
            "n2 cannot share a profile with another protocol",
            "write one profile for n2 and another for Modbus",
        );
    }
    protocols
}

/// Reads `formats`: character formats, written as for a bus.
fn read_formats(reader: &Reader<'_>) -> Vec<String> {
    let texts: Vec<String> = reader.or("formats", Vec::new());
    let formats = texts.iter().map(|text| match LineFormat::new(1, text) {
        Ok(format) => Some(format.characters()),
        Err(_) => {
            let what = format!("`{text}` is not a character format");
            reader.problem(
                "formats",
                what,
                "write for example [\"8N1\", \"8E1\"], the usual one first",
            );
            None
        }
    });
    formats.flatten().collect()
}

fn read_pair<T: document::FromNode + Copy + PartialOrd>(reader: &Reader<'_>, key: &str) -> Option<RangeInclusive<T>> {
    let pair: Vec<T> = reader.optional(key)?;
    match pair.as_slice() {
        [low, high] if low <= high => Some(*low..=*high),
        _ => {
            reader.problem(key, "expected two values, the lower one first", "write [low, high]");
            None
        }
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
                let fault = FaultText {
                    text,
                    panel: String::new(),
                    cause: String::new(),
                    remedy: String::new(),
                    verified,
                };
                faults.insert(number, fault);
            }
            (Err(_), _) => table.problem(
                code,
                format!("`{code}` is not a fault code"),
                "write a number from 0 to 65535",
            ),
            (Ok(_), None) => {}
        }
    }
    table.finish();
    faults
}

/// `fault_panel`, `fault_causes` and `fault_remedies`: more about faults that have a text.
fn read_fault_help(
    reader: &Reader<'_>,
    key: &str,
    faults: &mut BTreeMap<u16, FaultText>,
    part: impl Fn(&mut FaultText) -> &mut String,
) {
    let Some(table) = reader.table(key) else { return };
    for code in table.keys() {
        let text: Option<String> = table.optional(code);
        let fault = code.parse::<u16>().ok().and_then(|number| faults.get_mut(&number));
        match (fault, text) {
            (Some(fault), Some(text)) => *part(fault) = text,
            (None, _) => table.problem(
                code,
                format!("there is no text for a fault `{code}`"),
                "add it to [faults] or [faults_unverified]",
            ),
            (Some(_), None) => {}
        }
    }
    table.finish();
}

/// Lower-case letters, digits and `joint`, starting with a letter.
fn is_name(text: &str, joint: char) -> bool {
    text.starts_with(|c: char| c.is_ascii_lowercase())
        && text
            .chars()
            .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == joint)
}

#[cfg(test)]
mod tests;
