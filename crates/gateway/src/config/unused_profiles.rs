//! Faults of profile files that no drive uses: a stray file in a profile directory does not keep the gateway from starting.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use drivegate_model::document::{Node, Problem, Raw};
use drivegate_model::drive::profile::Profiles;

/// The names of the profiles that the drives of a configuration name.
pub(super) fn named_by_drives(root: &Node) -> BTreeSet<String> {
    let tables = |of: &Node, key: &str| -> Vec<Node> {
        match of.entry(key).map(|node| &node.value) {
            Some(Raw::Array(all)) => all.clone(),
            _ => Vec::new(),
        }
    };
    let drives = tables(root, "bus").into_iter().flat_map(|bus| tables(&bus, "drive"));
    let name = |drive: Node| match drive.entry("profile").map(|node| &node.value) {
        Some(Raw::Text(name)) => Some(name.clone()),
        _ => None,
    };
    drives.filter_map(name).collect()
}

/// The files with faults: the name that each gives, and its base.
pub(super) type Faulty = BTreeMap<String, (Option<String>, Option<String>)>;

/// The profile files in which these problems are.
pub(super) fn faulty(problems: &[Problem]) -> Faulty {
    let files: BTreeSet<&str> = problems.iter().map(|problem| problem.file.as_str()).collect();
    files
        .into_iter()
        .map(|file| (file.to_string(), Profiles::names_in(Path::new(file))))
        .collect()
}

/// The names under which drives look for the profiles of these files: a file without a name is probably called as its profile.
pub(super) fn meant(faulty: Faulty) -> BTreeSet<String> {
    let of_file = |file: &str| Path::new(file).file_stem()?.to_str().map(str::to_string);
    let names = faulty.into_iter();
    names
        .filter_map(|(file, (name, _))| name.or_else(|| of_file(&file)))
        .collect()
}

/// Divides the faults of profile files into errors and warnings: warnings are faults of files that give a name which neither a
/// drive nor, by its base, a profile of a drive uses.
pub(super) fn divide(
    problems: Vec<Problem>,
    names: &Faulty,
    named: &BTreeSet<String>,
    profiles: &Profiles,
) -> (Vec<Problem>, Vec<Problem>) {
    let mut used = named.clone();
    let mut open: Vec<String> = used.iter().cloned().collect();
    while let Some(name) = open.pop() {
        let faulty = names.values().filter(|(own, _)| own.as_ref() == Some(&name));
        let bases = faulty.filter_map(|(_, base)| base.clone());
        let bases: Vec<String> = bases
            .chain(profiles.get(&name).and_then(|profile| profile.base.clone()))
            .collect();
        open.extend(bases.into_iter().filter(|base| used.insert(base.clone())));
    }
    let is_used = |problem: &Problem| match names.get(&problem.file) {
        Some((Some(name), _)) => used.contains(name),
        // A problem of the directory itself, or of a file without a name, which may define the profile that a drive misses.
        _ => named.iter().any(|name| profiles.get(name).is_none()) || Path::new(&problem.file).is_dir(),
    };
    let (errors, mut warnings): (Vec<Problem>, Vec<Problem>) = problems.into_iter().partition(is_used);
    for warning in &mut warnings {
        if names.get(&warning.file).is_some_and(|(name, _)| name.is_some()) {
            warning.finding.what += ", in a profile that no drive uses";
        }
    }
    (errors, warnings)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Files with one fault each. The fault is an error if a drive uses the profile, and otherwise a warning.
    #[test]
    fn a_fault_counts_where_a_drive_depends_on_its_file() {
        let folder = tempfile::TempDir::new().unwrap();
        let write = |file: &str, text: &str| std::fs::write(folder.path().join(file), text).unwrap();
        write("nx.toml", "name = \"vacon-nx\"\nprotocols = [\"x\"]\n");
        write("meter.toml", "name = \"meter\"\nprotocols = [\"x\"]\n");
        write("ours.toml", "name = \"ours\"\nbase = \"meter\"\nturnaround = \"5ms\"\n");
        write("mine.toml", "name = \"mine\"\nbase = \"vacon-nx\"\n");
        write("gateway.toml", "[gateway]\nname = \"g\"\n");
        let mut profiles = Profiles::built_in();
        let problems = profiles.load(folder.path());
        let errors = |named: &[&str]| {
            let named = named.iter().map(|name| name.to_string()).collect();
            let (errors, warnings) = divide(problems.clone(), &faulty(&problems), &named, &profiles);
            assert_eq!(errors.len() + warnings.len(), problems.len());
            let file = |problem: &Problem| {
                Path::new(&problem.file)
                    .file_name()
                    .unwrap()
                    .to_string_lossy()
                    .into_owned()
            };
            errors
                .iter()
                .map(file)
                .collect::<BTreeSet<_>>()
                .into_iter()
                .collect::<Vec<_>>()
        };
        assert_eq!(errors(&[]), [""; 0]);
        assert_eq!(errors(&["vacon-cx"]), [""; 0]);
        assert_eq!(errors(&["vacon-nx"]), ["nx.toml"], "it was to replace the built-in one");
        assert_eq!(errors(&["mine"]), ["nx.toml"], "a base that was to be replaced");
        assert!(
            errors(&["ours"]).contains(&"meter.toml".to_string()),
            "a base that is faulty"
        );
        let names = meant(faulty(&problems));
        let all = ["gateway", "meter", "ours", "vacon-nx"];
        assert!(all.iter().all(|name| names.contains(*name)), "{names:?}");
        let missing = errors(&["other"]);
        assert!(missing.contains(&"gateway.toml".to_string()), "{missing:?}");
    }
}
