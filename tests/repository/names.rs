//! Names of files, types and functions are in the words of the field, and one word means one thing.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::tools::root;

/// Names that say nothing of what they name. A file, a type and a function may not have one of them alone.
const EMPTY: [&str; 19] = [
    "came", "does", "heard", "hears", "heirs", "it", "look", "looks", "ran", "said", "says", "stood", "tell", "tells",
    "they", "thing", "things", "told", "went",
];

/// Names that would mean two things, and the only places where they stand for the one.
const RESERVED: [(&str, &str, &[&str]); 3] = [
    (
        "hold",
        "the exclusive right to command a drive",
        &[
            "core/src/plant/hold.rs",
            "north/src/command_json/hold.rs",
            "http/src/operating/hold.rs",
        ],
    ),
    (
        "journal",
        "the record of a restore on disk",
        &["core/src/parameters/journal.rs"],
    ),
    ("offline", "a drive that does not answer", &[]),
];

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// The sources of the product without its tests, with their text.
fn product() -> Vec<(String, String)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(root().join("crates")).unwrap() {
        sources(&entry.unwrap().path().join("src"), &mut found);
    }
    sources(&root().join("src"), &mut found);
    let named = |path: PathBuf| {
        let name = path.strip_prefix(root()).unwrap().display().to_string();
        let text = fs::read_to_string(&path).unwrap();
        let product = text.split("mod tests {").next().unwrap_or_default().to_string();
        (name.trim_start_matches("crates/").to_string(), product)
    };
    let is_product = |(name, _): &(String, String)| !name.contains("tests");
    found.into_iter().map(named).filter(is_product).collect()
}

/// The name that a line of code defines: of a function, a type, or a constant.
fn defined(line: &str) -> Option<&str> {
    const KINDS: [&str; 5] = ["fn", "struct", "enum", "trait", "type"];
    let mut words = line.split_whitespace();
    while let Some(word) = words.next() {
        match word {
            "pub" | "const" | "async" | "unsafe" => {}
            visible if visible.starts_with("pub(") || visible.starts_with("crate::") || visible.ends_with(')') => {}
            kind if KINDS.contains(&kind) => {
                let name = words.next()?;
                return name.split(|c: char| !c.is_alphanumeric() && c != '_').next();
            }
            _ => return None,
        }
    }
    None
}

#[test]
fn every_name_says_what_it_names() {
    let mut wrong = Vec::new();
    for (file, text) in product() {
        let stem = file.rsplit('/').next().unwrap().trim_end_matches(".rs");
        if EMPTY.contains(&stem) || stem == "words" {
            wrong.push(format!("{file}: the name of the file"));
        }
        for (number, line) in text.lines().enumerate() {
            let name = defined(line.trim()).unwrap_or_default();
            if EMPTY.contains(&name.to_lowercase().as_str()) {
                wrong.push(format!("{file}:{}: `{name}`", number + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "names that say nothing:\n{}", wrong.join("\n"));
}

#[test]
fn one_name_means_one_thing() {
    let sources = product();
    for (name, meaning, places) in RESERVED {
        let file = format!("/{name}.rs");
        let found: Vec<&str> = sources
            .iter()
            .map(|(path, _)| path.as_str())
            .filter(|path| path.ends_with(&file))
            .collect();
        let unknown: Vec<_> = found.iter().filter(|path| !places.contains(*path)).collect();
        assert!(unknown.is_empty(), "`{name}` is {meaning}; not so in {unknown:?}");
    }
    let types = |name: &str| {
        let defines = |line: &str| defined(line.trim()) == Some(name);
        sources.iter().filter(|(_, text)| text.lines().any(defines)).count()
    };
    assert_eq!((types("Hold"), types("Offline"), types("Journal")), (0, 0, 1));
}

#[test]
fn definitions_are_found() {
    for (line, expected) in [
        ("pub(crate) fn heard(&self) {", Some("heard")),
        ("pub(in crate::http) async fn look(", Some("look")),
        ("pub struct Told<'a> {", Some("Told")),
        ("    let told = 1;", None),
        ("// fn told", None),
    ] {
        assert_eq!(defined(line.trim()), expected, "{line}");
    }
}
