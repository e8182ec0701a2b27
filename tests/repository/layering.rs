//! A file imports only from its own room and from rooms above it; `north` and `bus` never name each other.
//!
//! The check reads the source text: every path that begins with `crate::`, with `drivegate::` in the binary, or
//! with enough `super::` to leave its room, in `use` groups and in plain paths, test code included. Comments and
//! strings do not count.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The rooms from the bottom of the house to its door.
const ROOMS: [&str; 20] = [
    "version",
    "document",
    "files",
    "codec",
    "drive",
    "event",
    "diagnosis",
    "process_image",
    "command",
    "history",
    "parameters",
    "plant",
    "line",
    "bus",
    "north",
    "sim",
    "config",
    "daemon",
    "cli",
    "main",
];

/// Rooms that meet at `process_image` and `command` only, whatever their order.
const STRANGERS: [(&str, &str); 2] = [("north", "bus"), ("bus", "north")];

#[test]
fn no_file_imports_from_a_room_below_it() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let texts: BTreeMap<PathBuf, String> = rust_files(&src)
        .into_iter()
        .map(|file| {
            (
                file.strip_prefix(&src).unwrap().to_path_buf(),
                fs::read_to_string(&file).unwrap(),
            )
        })
        .collect();
    let modules = modules_of_all(&texts);
    let mut faults = Vec::new();
    let mut paths_seen = 0;
    for (file, text) in &texts {
        paths_seen += crate_paths(&modules[file], text).len();
        faults.extend(check(file, &modules[file], text));
    }
    assert!(
        paths_seen > 20,
        "only {paths_seen} paths found in src: the reader of paths is broken"
    );
    assert!(
        faults.is_empty(),
        "upward imports; the order of the rooms stands in docs/architecture.md:\n{}",
        faults.join("\n")
    );
}

#[test]
fn an_upward_import_is_caught() {
    let upward = [
        ("process_image/mod.rs", "use crate::bus::Task;"),
        (
            "process_image/mod.rs",
            "use crate::{codec::Request, bus::{self, Task}};",
        ),
        (
            "process_image/mod.rs",
            "fn f() { let x = crate::north::http::serve(); }",
        ),
        ("process_image/mod.rs", "use super::bus::Task;"),
        ("process_image/health.rs", "use super::super::bus::Task;"),
        (
            "process_image/health.rs",
            "mod tests { use super::super::super::bus::Task; }",
        ),
        (
            "process_image/mod.rs",
            "#[cfg(test)]\nmod tests {\n    use crate::sim::Wire;\n}",
        ),
        (
            "process_image/mod.rs",
            "macro_rules! m { () => { $crate::plant::Plant }; }",
        ),
        ("plant.rs", "use super::daemon;"),
        (
            "process_image/mod.rs",
            "const A: char = '\"'; use crate::bus::Task; // \"",
        ),
        ("process_image/mod.rs", "fn f<'a>(s: &'a str) {} use crate::bus::Task;"),
        (
            "process_image/mod.rs",
            "const A: &str = r#\"\"\"#; use crate::bus::Task;",
        ),
        ("north/mqtt.rs", "use crate::bus::Task;"),
        ("bus/mod.rs", "use crate::north::http;"),
        ("process_image/mod.rs", "use crate::*;"),
        ("process_image/mod.rs", "use crate as house;"),
        ("process_image/mod.rs", "use crate::unheard_of::Thing;"),
        ("unheard_of.rs", "use crate::codec::Request;"),
        ("daemon.rs", "use crate::main::parse;"),
        ("daemon.rs", "use crate::cli::run;"),
    ];
    for (file, text) in upward {
        assert_eq!(check_alone(file, text).len(), 1, "{file}: {text}");
    }
}

#[test]
fn a_downward_import_is_fine() {
    let downward = [
        (
            "process_image/mod.rs",
            "use crate::codec::Request;\nuse crate::{drive::Value, event::Event};",
        ),
        (
            "process_image/mod.rs",
            "use crate::process_image::health::BusHealth;\nuse self::health::Other;",
        ),
        (
            "process_image/health.rs",
            "use super::Snapshot;\nmod tests { use super::super::Snapshot; use super::*; }",
        ),
        (
            "process_image/mod.rs",
            "//! See [`crate::bus::Task`].\n/* use crate::north; /* crate::bus::x */ */",
        ),
        (
            "process_image/mod.rs",
            "const A: &str = \"crate::bus::Task\"; const B: &str = r#\"\" crate::bus::x \"#;",
        ),
        (
            "process_image/mod.rs",
            "pub(crate) fn f() {}\npub(in crate::process_image) fn g() {}",
        ),
        ("cli/run.rs", "use crate::daemon::Daemon;"),
        ("main.rs", "use drivegate::cli;\nfn main() { drivegate::daemon::run() }"),
        ("lib.rs", "pub mod bus;\npub use crate::north::NorthStats;"),
        ("bin/measure.rs", "use drivegate::sim::Wire;"),
    ];
    for (file, text) in downward {
        assert_eq!(check_alone(file, text), Vec::<String>::new(), "{file}: {text}");
    }
}

#[test]
fn a_path_attribute_moves_a_file() {
    let text = |text: &str| text.to_string();
    let texts = BTreeMap::from([
        (
            PathBuf::from("bus/plan.rs"),
            text("#[cfg(test)]\n#[path = \"plan_tests.rs\"]\nmod tests;\n"),
        ),
        (
            PathBuf::from("bus/plan_tests.rs"),
            text("use super::super::schedule::Job; use super::super::super::north;"),
        ),
    ]);
    let file = Path::new("bus/plan_tests.rs");
    let modules = &modules_of_all(&texts)[file];
    assert_eq!(modules.join("::"), "bus::plan::tests");
    let faults = check(file, modules, &texts[file]);
    assert_eq!(faults, ["src/bus/plan_tests.rs:1: `bus` must not name `north`"]);
}

/// Modules of `drive`: each uses only those before it.
const DRIVE: [&str; 6] = ["model", "derive", "profile", "plan", "identify", "profile_file"];

/// `module: later` for each module of `drive` that names a later one.
fn arrows_back(module: &str, text: &str) -> Vec<String> {
    let rank = DRIVE.iter().position(|m| *m == module).unwrap();
    let names = |later: &&&str| {
        ["super::", "drive::"]
            .iter()
            .any(|up| text.contains(&format!("{up}{later}::")))
    };
    let later = DRIVE[rank + 1..].iter().filter(names);
    later.map(|later| format!("{module}: {later}")).collect()
}

#[test]
fn the_modules_of_drive_have_no_circle() {
    assert_eq!(arrows_back("derive", "use super::profile::tidy;"), ["derive: profile"]);
    let drive = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/drive");
    let mut found = Vec::new();
    for file in rust_files(&drive) {
        let modules = modules_of(file.strip_prefix(&drive).unwrap());
        if let Some(module) = modules.first().filter(|module| DRIVE.contains(&module.as_str())) {
            found.extend(arrows_back(module, &fs::read_to_string(&file).unwrap()));
        }
    }
    assert_eq!(found, Vec::<String>::new());
}

fn rust_files(dir: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// The module path of a file below `src`: `process_image/mod.rs` is `process_image`, `process_image/health.rs` is `process_image`, `health`.
fn modules_of(file: &Path) -> Vec<String> {
    let mut modules: Vec<String> = file
        .with_extension("")
        .components()
        .map(|c| c.as_os_str().to_string_lossy().into_owned())
        .collect();
    if modules.last().is_some_and(|last| last == "mod") {
        modules.pop();
    }
    modules
}

/// The module path of every file: by its place, or where a `#[path = "…"]` puts it.
fn modules_of_all(texts: &BTreeMap<PathBuf, String>) -> BTreeMap<PathBuf, Vec<String>> {
    let mut all: BTreeMap<PathBuf, Vec<String>> = texts.keys().map(|file| (file.clone(), modules_of(file))).collect();
    for (file, text) in texts {
        for rest in text.split("#[path = \"").skip(1) {
            let (path, rest) = rest.split_once("\"]").unwrap();
            let mut words = rest
                .split(|c: char| !c.is_alphanumeric() && c != '_')
                .filter(|w| !w.is_empty());
            let name = words.by_ref().skip_while(|w| *w != "mod").nth(1).unwrap();
            let mut modules = modules_of(file);
            modules.push(name.to_string());
            all.insert(file.parent().unwrap().join(path), modules);
        }
    }
    all
}

fn check_alone(file: &str, text: &str) -> Vec<String> {
    check(Path::new(file), &modules_of(Path::new(file)), text)
}

/// The faults of one file, given by its path below `src` and its module path.
fn check(file: &Path, modules: &[String], text: &str) -> Vec<String> {
    let room = match modules.first().map(String::as_str) {
        // The house itself names all its rooms.
        Some("lib") => return Vec::new(),
        // Further binaries stand at the door like the first.
        Some("bin") => "main",
        Some(room) => room,
        None => return vec![format!("src/{}: no room", file.display())],
    };
    let Some(rank) = ROOMS.iter().position(|r| *r == room) else {
        return vec![format!("src/{}: `{room}` is not in the list of rooms", file.display())];
    };
    let fault = |(line, target): (usize, String)| {
        let why = match ROOMS.iter().position(|r| *r == target) {
            None => format!("`{target}` is no room; import from the room where it stands"),
            Some(_) if STRANGERS.contains(&(room, &target)) => format!("`{room}` must not name `{target}`"),
            Some(of) if of > rank => format!("`{room}` must not import from `{target}`, which stands below it"),
            Some(_) => return None,
        };
        Some(format!("src/{}:{line}: {why}", file.display()))
    };
    crate_paths(modules, text).into_iter().filter_map(fault).collect()
}

/// Line and first segment of every path that starts at the root of the crate.
fn crate_paths(modules: &[String], text: &str) -> Vec<(usize, String)> {
    let tokens = tokens(text);
    let word = |i: usize| tokens.get(i).map_or("", |t| t.text.as_str());
    let mut found = Vec::new();
    // One entry for each open brace: whether it opened an inline module.
    let mut braces: Vec<bool> = Vec::new();
    let mut i = 0;
    while let Some(token) = tokens.get(i) {
        let in_path = i > 0 && word(i - 1) == "::";
        match token.text.as_str() {
            "{" => braces.push(i >= 2 && word(i - 2) == "mod"),
            "}" => {
                braces.pop();
            }
            "crate" if word(i + 1) == "as" => found.push((token.line, "crate".to_string())),
            "crate" | "drivegate" if !in_path && word(i + 1) == "::" => {
                first_segments(&tokens, i + 2, &mut found);
            }
            "super" if !in_path => {
                let inline = braces.iter().filter(|module| **module).count();
                let mut up = 1;
                while word(i + 1) == "::" && word(i + 2) == "super" {
                    up += 1;
                    i += 2;
                }
                if up == modules.len() + inline && word(i + 1) == "::" {
                    first_segments(&tokens, i + 2, &mut found);
                }
            }
            _ => {}
        }
        i += 1;
    }
    found
}

/// The first segments of what follows `crate::` at `start`: one, or each of a group.
fn first_segments(tokens: &[Token], start: usize, found: &mut Vec<(usize, String)>) {
    let Some(first) = tokens.get(start) else { return };
    if first.text != "{" {
        found.push((first.line, first.text.clone()));
        return;
    }
    let mut depth = 0;
    let mut fresh = false;
    for token in &tokens[start..] {
        match token.text.as_str() {
            "{" => {
                depth += 1;
                fresh = depth == 1;
            }
            "}" => depth -= 1,
            "," => fresh = depth == 1,
            _ if fresh => {
                found.push((token.line, token.text.clone()));
                fresh = false;
            }
            _ => {}
        }
        if depth == 0 {
            return;
        }
    }
}

#[derive(Debug, PartialEq)]
struct Token {
    line: usize,
    text: String,
}

/// Words, `::` and single signs of Rust source, without comments, strings and characters.
fn tokens(text: &str) -> Vec<Token> {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let mut tokens = Vec::new();
    let mut line = 1;
    let mut i = 0;
    while i < chars.len() {
        let start = i;
        match at(i) {
            '/' if at(i + 1) == '/' => {
                while i < chars.len() && at(i) != '\n' {
                    i += 1;
                }
            }
            '/' if at(i + 1) == '*' => i = after_comment(&chars, i),
            '"' => i = after_string(&chars, i),
            '\'' if at(i + 1) == '\\' || at(i + 2) == '\'' => {
                i += if at(i + 1) == '\\' { 3 } else { 2 };
                while i < chars.len() && at(i) != '\'' {
                    i += 1;
                }
                i += 1;
            }
            'r' if at(i + 1) == '"' || (at(i + 1) == '#' && matches!(at(i + 2), '"' | '#')) => {
                i = after_raw_string(&chars, i + 1);
            }
            ':' if at(i + 1) == ':' => {
                i += 2;
                tokens.push(Token {
                    line,
                    text: "::".to_string(),
                });
            }
            c if is_word(c) => {
                while is_word(at(i)) && !(at(i) == 'r' && i > start && matches!(at(i + 1), '"' | '#')) {
                    i += 1;
                }
                let text = chars[start..i].iter().collect();
                tokens.push(Token { line, text });
            }
            c => {
                i += 1;
                if !c.is_whitespace() {
                    tokens.push(Token {
                        line,
                        text: c.to_string(),
                    });
                }
            }
        }
        line += chars[start..i.min(chars.len())].iter().filter(|c| **c == '\n').count();
    }
    tokens
}

fn after_comment(chars: &[char], start: usize) -> usize {
    let mut depth = 0;
    let mut i = start;
    while i < chars.len() {
        match chars[i..] {
            ['/', '*', ..] => {
                depth += 1;
                i += 2;
            }
            ['*', '/', ..] => {
                depth -= 1;
                i += 2;
            }
            _ => i += 1,
        }
        if depth == 0 {
            break;
        }
    }
    i
}

fn after_string(chars: &[char], start: usize) -> usize {
    let mut i = start + 1;
    while i < chars.len() {
        match chars[i] {
            '\\' => i += 2,
            '"' => return i + 1,
            _ => i += 1,
        }
    }
    i
}

/// `start` is behind the `r`.
fn after_raw_string(chars: &[char], start: usize) -> usize {
    let hashes = chars[start..].iter().take_while(|c| **c == '#').count();
    let mut i = start + hashes + 1;
    while i < chars.len() {
        let closing = chars[i] == '"' && chars[i + 1..].iter().take(hashes).filter(|c| **c == '#').count() == hashes;
        i += 1;
        if closing {
            return i + hashes;
        }
    }
    i
}
