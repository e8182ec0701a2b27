//! The documents are in the words that engineers of the field use, and spelled right.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use crate::support::tools::root;

/// What no page says, and what it says instead. A word matches as a whole, in upper and lower case; a blank in it stands for
/// any space.
const INSTEAD: [(&str, &str); 23] = [
    ("told", "reported, shown"),
    ("tells", "reports, shows, says"),
    ("tell apart", "distinguish"),
    ("heard", "received"),
    ("begun", "started"),
    ("anew", "again"),
    ("beside", "next to, besides"),
    ("whoever", "anyone who, the client that"),
    ("is no", "is not a"),
    ("are no", "are not"),
    ("of which", "name it again"),
    ("that there is", "leave it out"),
    ("reckon", "calculate"),
    ("reckoned", "calculated"),
    ("reckons", "calculates"),
    ("by itself alone", "alone"),
    ("at hand", "available"),
    ("as ever", "as usual"),
    ("aught", "anything"),
    ("of its own making", "its own"),
    ("whatever comes", "in any case"),
    ("exchange", "transaction"),
    ("exchanges", "transactions"),
];

/// README, CONTRIBUTING and all pages below docs.
fn pages() -> Vec<PathBuf> {
    let mut found = vec![root().join("README.md"), root().join("CONTRIBUTING.md")];
    for folder in ["docs", "docs/decisions", "crates/proto"] {
        let entries = fs::read_dir(root().join(folder)).unwrap();
        let paths = entries.map(|entry| entry.unwrap().path());
        found.extend(paths.filter(|path| path.extension().is_some_and(|extension| extension == "md")));
    }
    found.sort();
    found
}

/// The prose of a page with the number of each line: without fenced blocks and without what stands between backticks.
fn prose(text: &str) -> Vec<(usize, String)> {
    let (mut inside, mut found) = (false, Vec::new());
    for (number, line) in text.lines().enumerate() {
        if line.starts_with("```") {
            inside = !inside;
        } else if !inside {
            let plain: Vec<&str> = line.split('`').step_by(2).collect();
            found.push((number + 1, plain.join(" ")));
        }
    }
    found
}

/// The words of a line in lower case, with a blank at each end.
fn words(line: &str) -> String {
    let lower = line.to_lowercase();
    let words = lower
        .split(|c: char| !c.is_alphanumeric())
        .filter(|word| !word.is_empty());
    format!(" {} ", words.collect::<Vec<_>>().join(" "))
}

fn unwanted(line: &str) -> Option<(&'static str, &'static str)> {
    let words = words(line);
    INSTEAD
        .into_iter()
        .find(|(word, _)| words.contains(&format!(" {word} ")))
}

#[test]
fn the_pages_are_in_plain_words() {
    let mut found = Vec::new();
    for page in pages() {
        for (number, line) in prose(&fs::read_to_string(&page).unwrap()) {
            if let Some((word, instead)) = unwanted(&line) {
                found.push(format!("{}:{number}: \"{word}\": {instead}", page.display()));
            }
        }
    }
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn unwanted_words_are_noticed() {
    for line in [
        "It is told once.",
        "| Begun | x |",
        "that is no number",
        "Whoever asks",
        "(beside it)",
    ] {
        assert!(unwanted(line).is_some(), "{line}");
    }
    for line in [
        "besides it",
        "this is not a number",
        "stole and untold",
        "which of these",
    ] {
        assert!(unwanted(line).is_none(), "{line}");
    }
    let text = "a `told` b\n```text\ntold\n```\nend";
    assert_eq!(prose(text), [(1, "a   b".to_string()), (5, "end".to_string())]);
}

/// Spelling, by an independent program; `typos.toml` has the names that it does not know.
#[test]
fn the_pages_are_spelled_right() {
    let typos = root().join(".tools/venv/bin/typos");
    let checked = Command::new(&typos)
        .args(["--config", "typos.toml", "--format", "brief"])
        .args([
            "docs",
            "README.md",
            "CONTRIBUTING.md",
            "SECURITY.md",
            "CHANGELOG.md",
            "crates",
            "src",
        ])
        .current_dir(root())
        .output()
        .unwrap_or_else(|error| panic!("{}: {error}; run `make tools`", typos.display()));
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stdout));
}
