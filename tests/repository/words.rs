//! Documents and messages are in the words that engineers of the field use, and spelled right.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::tools::root;

/// Words that must not occur in pages and messages, with their replacements.
const INSTEAD: [(&str, &str); 31] = [
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
    ("of which", "two sentences"),
    ("that there is", "fewer words"),
    ("reckon", "calculate"),
    ("reckoned", "calculated"),
    ("reckons", "calculates"),
    ("at hand", "available"),
    ("as ever", "as usual"),
    ("exchange", "transaction"),
    ("exchanges", "transactions"),
    ("fell silent", "went silent"),
    ("all the same", "still, anyway"),
    ("taken for", "mistaken for"),
    ("in vain", "without success"),
    ("trying again", "retrying"),
    ("asked again", "retried"),
    ("believed", "valid, accepted"),
    ("ran out", "expired"),
    ("runs out", "expires"),
    ("somebody", "someone"),
    ("everybody", "everyone"),
    ("lately", "recently"),
];

/// Limit for README and docs, without decisions.
const MOST_WORDS: usize = 50_000;

/// Phrases that are allowed although a part of them is refused.
const RIGHT: [&str; 9] = [
    "there is no",
    "there are no",
    "is no longer",
    "are no longer",
    "is no better",
    "are no better",
    "key exchange",
    // "data . exchange" is part of a file format.
    "data . exchange",
    "begun . by",
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

/// The prose of a page with the number of each line: without fenced blocks and without text between backticks.
fn prose(text: &str) -> Vec<(usize, String)> {
    let (mut inside, mut found) = (false, Vec::new());
    for (number, line) in text.lines().enumerate() {
        if line.starts_with("```") {
            inside = !inside;
        } else if !inside {
            let plain: Vec<&str> = line.split('`').step_by(2).collect();
            found.push((number + 1, plain.join("`")));
        }
    }
    found
}

/// The string literals of code with the number of the line where each begins: without comments and modules of tests.
fn literals(code: &str) -> Vec<(usize, String)> {
    let code = code.split("mod tests {").next().unwrap_or_default();
    let (mut rest, mut line, mut found) = (code, 1, Vec::new());
    while let Some(c) = rest.chars().next() {
        let length = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if c == '"' {
            let end = closing(&rest[1..]);
            found.push((line, rest[1..=end].replace("\\n", " ")));
            end + 2
        } else if c == '\'' {
            // A character, which may be a quotation mark; otherwise a lifetime.
            let is_char = |text: &str| rest[1..].starts_with(text) && rest[1 + text.len()..].starts_with('\'');
            ["\"", "\\\"", "\\'", "\\\\"]
                .iter()
                .find(|text| is_char(text))
                .map_or(1, |text| text.len() + 2)
        } else {
            c.len_utf8()
        };
        let length = length.min(rest.len());
        line += rest[..length].matches('\n').count();
        rest = &rest[length..];
    }
    found
}

/// Index of the end of a string literal; `text` begins after its opening quotation mark.
pub(super) fn closing(text: &str) -> usize {
    let mut escaped = false;
    let end = text.char_indices().find(|(_, c)| {
        let is_end = *c == '"' && !escaped;
        escaped = *c == '\\' && !escaped;
        is_end
    });
    end.map_or(text.len(), |(at, _)| at)
}

/// The text of a message without its placeholders and without the parts between backticks.
fn said(literal: &str) -> String {
    let (mut depth, mut plain) = (0_u32, String::new());
    for c in literal.chars() {
        match c {
            '{' => depth += 1,
            '}' => depth = depth.saturating_sub(1),
            c if depth == 0 => plain.push(c),
            _ => {}
        }
    }
    plain
        .replace("\\\n", " ")
        .split('`')
        .step_by(2)
        .collect::<Vec<_>>()
        .join("`")
}

/// All Rust files below the folders, including tests.
fn rust_files(folders: &[&str]) -> Vec<PathBuf> {
    let mut open: Vec<PathBuf> = folders.iter().map(|folder| root().join(folder)).collect();
    let mut found = Vec::new();
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

/// Whether a file, or a folder that contains it, has only tests.
pub(super) fn is_test(path: &Path) -> bool {
    let parts = path.strip_prefix(root()).unwrap().iter();
    parts.map(|part| part.to_string_lossy()).any(|name| {
        matches!(&*name, "tests" | "tests.rs" | "testkit") || name.trim_end_matches(".rs").ends_with("_tests")
    })
}

#[test]
fn the_messages_are_in_plain_words() {
    let (mut seen, mut found) = (0, Vec::new());
    for file in rust_files(&["src", "crates"]) {
        if is_test(&file) {
            continue;
        }
        for (number, literal) in literals(&fs::read_to_string(&file).unwrap()) {
            // A single word is a name or a part of a format, so it is skipped.
            let text = said(&literal);
            if text.split_whitespace().count() < 2 {
                continue;
            }
            seen += 1;
            if let Some((word, instead)) = unwanted(&text) {
                found.push(format!(
                    "{}:{number}: \"{word}\"; instead: {instead}; {text}",
                    file.display()
                ));
            }
        }
    }
    assert!(seen > 1_500, "{seen}");
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn messages_are_found_in_code() {
    let code = "fn f<'a>() { g('\"', \"it is told\", \"a \\\"b\\\" {told}\"); } // \"told\"\n\n\"x\\ny\"\n#[cfg(test)]\nmod tests { \"told\" }";
    let expected = [(1, "it is told"), (1, "a \\\"b\\\" {told}"), (3, "x y")];
    assert_eq!(literals(code), expected.map(|(line, text)| (line, text.to_string())));
    assert_eq!(said("a {told} b `told` c"), "a  b ` c");
}

/// The words of a line in lower case, with a blank at each end; a punctuation mark counts as a word, so that no
/// phrase matches across it.
fn words(line: &str) -> String {
    let mut apart = String::new();
    for c in line.to_lowercase().chars() {
        if c.is_alphanumeric() || c.is_whitespace() {
            apart.push(c);
        } else {
            apart.push_str(" . ");
        }
    }
    let words: Vec<&str> = apart.split_whitespace().collect();
    let line = format!(" {} ", words.join(" "));
    let without = |line: String, right: &&str| line.replace(&format!(" {right} "), " . ");
    RIGHT.iter().fold(line, without)
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
                found.push(format!("{}:{number}: \"{word}\"; instead: {instead}", page.display()));
            }
        }
    }
    assert!(found.is_empty(), "{found:#?}");
}

/// Beginnings of a comment whose subject is somewhere else.
const WITHOUT_SUBJECT: [&str; 5] = ["It", "Its", "The same", "Of", "Those"];

/// Comments below this path are the text of `docs/configuration.md`; another test compares the two.
const KEYS: &str = "crates/gateway/src/config/keys";

/// The first line of each paragraph of comments, with its number.
fn paragraphs(code: &str) -> Vec<(usize, &str)> {
    let (mut follows, mut found) = (false, Vec::new());
    for (number, line) in code.lines().enumerate() {
        let comment = line.trim_start().strip_prefix("//");
        let text = comment.map(|comment| comment.trim_start_matches(['/', '!']).trim());
        let text = text.filter(|text| !text.is_empty() && !text.starts_with('#'));
        if let Some(text) = text.filter(|_| !follows) {
            found.push((number + 1, text));
        }
        follows = text.is_some();
    }
    found
}

/// The beginning of a comment that cannot be understood alone.
fn without_subject(text: &str) -> Option<&'static str> {
    WITHOUT_SUBJECT.into_iter().find(|beginning| {
        text.strip_prefix(beginning)
            .is_some_and(|rest| !rest.starts_with(char::is_alphanumeric))
    })
}

#[test]
fn comments_name_their_subject() {
    let (mut seen, mut found) = (0, Vec::new());
    for file in rust_files(&["benches", "crates", "src", "tests"]) {
        if file.starts_with(root().join(KEYS)) {
            continue;
        }
        for (number, text) in paragraphs(&fs::read_to_string(&file).unwrap()) {
            seen += 1;
            if let Some(beginning) = without_subject(text) {
                found.push(format!(
                    "{}:{number}: begins with \"{beginning}\": {text}",
                    file.display()
                ));
            }
        }
    }
    assert!(seen > 10_000, "{seen}");
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn comments_without_a_subject_are_noticed() {
    for text in [
        "It is set.",
        "Its name.",
        "The same, later.",
        "Of a gauge.",
        "Those that wait.",
    ] {
        assert!(without_subject(text).is_some(), "{text}");
    }
    for text in ["Items of a list.", "Offsets.", "Whether it is set.", "The samples."] {
        assert_eq!(without_subject(text), None, "{text}");
    }
    let code =
        "/// A name.\n/// It goes on.\n///\n/// # Errors\n/// It fails.\nlet it = 1; // Of it.\n    // Its end.\n";
    let expected = [(1, "A name."), (5, "It fails."), (7, "Its end.")];
    assert_eq!(paragraphs(code), expected);
}

/// README and the pages below docs, without the decisions, stay a book that one reads.
#[test]
fn the_pages_are_short_enough() {
    let counted = pages().into_iter().filter(|page| {
        let below_docs = page.parent() == Some(&root().join("docs"));
        below_docs || page.ends_with("README.md") && page.parent() == Some(root())
    });
    let words: usize = counted
        .map(|page| fs::read_to_string(page).unwrap().split_whitespace().count())
        .sum();
    assert!(
        (10_000..=MOST_WORDS).contains(&words),
        "{words} words, at most {MOST_WORDS}"
    );
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
        "if there is no value",
        "as it is; no more",
    ] {
        assert_eq!(unwanted(line), None, "{line}");
    }
    let text = "a `told` b\n```text\ntold\n```\nend";
    assert_eq!(prose(text), [(1, "a ` b".to_string()), (5, "end".to_string())]);
}

/// Checks spelling with an independent program; `typos.toml` lists the names that it does not know.
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
