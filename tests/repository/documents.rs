//! The documents are true: commands, links, and every configuration in them.

mod cabinet;
mod commands;
mod drives;
mod timeouts;

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::tools::{root, run_well};
use tempfile::TempDir;

const DRIVEGATE: &str = env!("CARGO_BIN_EXE_drivegate");

pub(super) fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// All documents for people.
fn documents() -> Vec<PathBuf> {
    let mut found = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"]
        .map(|name| root().join(name))
        .to_vec();
    found.extend(files(&root().join("docs"), "md"));
    found
}

/// All files below `dir` with this extension.
pub(super) fn files(dir: &Path, extension: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path, extension));
        } else if path.extension().is_some_and(|e| e == extension) {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// The fenced blocks of this language.
fn blocks(text: &str, language: &str) -> Vec<String> {
    let opening = format!("\n```{language}\n");
    let inside = text.split(&opening).skip(1);
    inside
        .map(|rest| rest.split("\n```").next().unwrap().to_string() + "\n")
        .collect()
}

#[test]
fn every_configuration_that_ships_is_valid() {
    let mut configurations = files(&root().join("deploy"), "toml");
    assert!(configurations.len() >= 2);
    let dir = TempDir::new().unwrap();
    // The certificates that the documentation creates for its configuration.
    let (script, tls) = (
        root().join("docs/modbus-tls-ca.sh"),
        dir.path().join("tls").display().to_string(),
    );
    run_well(&script, &[&tls, "ca"]);
    run_well(
        &script,
        &[&tls, "server", "gateway", "pump-house.example", "192.168.1.5"],
    );
    fs::write(dir.path().join("tokens"), "").unwrap();
    fs::write(dir.path().join("users"), "").unwrap();
    for document in documents() {
        for (i, block) in blocks(&read(&document), "toml").iter().enumerate() {
            if is_profile(block) {
                continue;
            }
            let name = document.file_stem().unwrap().to_string_lossy().into_owned();
            let path = dir.path().join(format!("{name}-{i}.toml"));
            // A block that shows one section is completed to a file with the other sections.
            let head = if block.contains("[gateway]") {
                ""
            } else {
                "[gateway]\nname = \"g\"\n\n"
            };
            // The directory of an installed gateway does not exist here, so another one replaces it.
            let profiles = dir.path().join("profiles");
            fs::create_dir_all(&profiles).unwrap();
            let block = block.replace("/etc/drivegate/profiles", &profiles.display().to_string());
            fs::write(&path, format!("{head}{block}")).unwrap();
            configurations.push(path);
        }
    }
    for path in configurations {
        run_well(
            Path::new(DRIVEGATE),
            &["check", "--config", &path.display().to_string()],
        );
    }
}

/// Every test that the threat model names as a proof must exist.
#[test]
fn the_tests_of_the_threat_model_exist() {
    let text = read(&root().join("docs/threat-model.md"));
    let table = text.split("## Defences").nth(1).unwrap().split("\n## ").next().unwrap();
    let code: String = ["src", "crates", "tests"]
        .map(|folder| files(&root().join(folder), "rs"))
        .iter()
        .flatten()
        .map(|file| read(file))
        .collect();
    let is_name = |word: &&str| {
        word.contains('_')
            && word
                .chars()
                .all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit())
    };
    let proofs = table
        .lines()
        .filter_map(|line| line.trim_end_matches(" |").rsplit_once(" | "));
    let named: Vec<&str> = proofs
        .flat_map(|(_, proof)| proof.split('`').skip(1).step_by(2))
        .filter(is_name)
        .collect();
    assert!(named.len() > 30, "{named:?}");
    let missing: Vec<&&str> = named
        .iter()
        .filter(|name| !code.contains(&format!("fn {name}(")))
        .collect();
    assert!(missing.is_empty(), "{missing:?}");
}

fn is_profile(block: &str) -> bool {
    let named = block.contains("\nbase = ") || block.contains("\nprotocols = ");
    let part = block.starts_with("[n2]") || block.starts_with("[parameters]");
    named && !block.contains("[mqtt]") || part
}

#[test]
fn every_profile_that_is_shown_is_sound() {
    let dir = TempDir::new().unwrap();
    let all = documents().into_iter().flat_map(|page| blocks(&read(&page), "toml"));
    let shown: Vec<String> = all.filter(|b| is_profile(b)).collect();
    assert!(shown.len() >= 5);
    for (i, mut block) in shown.into_iter().enumerate() {
        // A block that shows one section of a profile is inserted into a complete profile.
        for (section, base) in [("[n2]", "vacon-nx-n2"), ("[parameters]", "teco-7300pa")] {
            if block.starts_with(section) {
                block = format!("name = \"part-{i}\"\nbase = \"{base}\"\n{block}");
            }
        }
        fs::write(dir.path().join(format!("{i}.toml")), block).unwrap();
    }
    let listed = run_well(
        Path::new(DRIVEGATE),
        &["profiles", "--profile-dir", &dir.path().display().to_string()],
    );
    for name in ["our-hvx", "our-nx", "small-meter", "bit-drive", "cia402-drive"] {
        assert!(listed.contains(name), "{listed}");
    }
}

/// Puts `text` between the comment `<!-- name -->` and the next `<!-- end -->` of a page, or fails if the page
/// differs. `DRIVEGATE_WRITE_DOCS=1` writes the page instead.
fn generated(page: &str, name: &str, text: &str) {
    let path = root().join("docs").join(page);
    let old = read(&path);
    let start = format!("<!-- {name} -->\n");
    let (head, rest) = old.split_once(&start).unwrap();
    let (_, tail) = rest.split_once("<!-- end -->").unwrap();
    let new = format!("{head}{start}{text}<!-- end -->{tail}");
    if std::env::var_os("DRIVEGATE_WRITE_DOCS").is_some() {
        fs::write(&path, new).unwrap();
    } else {
        assert!(
            old == new,
            "docs/{page} is out of date; run DRIVEGATE_WRITE_DOCS=1 cargo test --test repository documents"
        );
    }
}

/// The four examples at the start of the page are valid profiles, which read and command as the page says.
#[test]
fn the_page_of_profiles_begins_with_four_profiles() {
    use drivegate_model::drive::control::Run;
    use drivegate_model::drive::{ModelPoint, Plan, PollClass, Profile};
    let page = read(&root().join("docs/profiles.md"));
    let (_, examples) = page.split_once("\n## Four examples\n").unwrap();
    let (examples, _) = examples.split_once("\n## ").unwrap();
    let profiles: Vec<Profile> = blocks(examples, "toml")
        .iter()
        .map(|text| Profile::parse("p.toml", text, false).unwrap_or_else(|why| panic!("{text}\n{why:?}")))
        .collect();
    let [meter, ratios, bits, cia402] = &profiles[..] else {
        panic!("{} examples", profiles.len());
    };
    for profile in [meter, ratios, bits, cia402] {
        assert_eq!(profile.warnings, [], "{}", profile.name);
    }
    let text = &blocks(examples, "toml")[0];
    assert_eq!(
        text.lines().filter(|line| !line.is_empty()).count(),
        9,
        "about ten lines"
    );
    let reads = |profile: &Profile, class| {
        let reads = Plan::of(profile)
            .reads
            .into_iter()
            .filter(move |read| read.class == class);
        reads.map(|read| (read.start, read.count)).collect::<Vec<_>>()
    };
    assert_eq!(reads(meter, PollClass::Fast), [(0, 2), (4, 2)]);
    assert_eq!(
        (reads(meter, PollClass::Slow), reads(meter, PollClass::Once)),
        (vec![(8, 4)], vec![(20, 8)])
    );
    // The counter's parts, and both bytes, are read in one request.
    assert_eq!(reads(ratios, PollClass::Slow), [(31, 3)]);
    let control = |profile: &Profile| profile.control.clone().unwrap();
    let at = control(bits).at;
    assert_eq!(bits.runs_by(at.table, at.address, 3), Some(true));
    assert_eq!(bits.runs_by(at.table, at.address, 2), Some(false));
    assert!(!control(bits).admits(at, 5), "an external fault");
    assert_eq!(reads(bits, PollClass::Fast), [(0x2520, 5)]);
    let Run::Steps(steps) = control(cia402).run else {
        panic!("no steps");
    };
    let words: Vec<u16> = steps.iter().map(|step| step.write.value).collect();
    assert_eq!(words, [6, 7, 15]);
    assert_eq!(control(cia402).stop_word(0x080F), 0x0807);
    assert!(
        [ModelPoint::Running, ModelPoint::Fault]
            .iter()
            .all(|point| cia402.model_index(*point).is_some())
    );
}

#[test]
fn the_page_of_the_command_line_is_made_from_it() {
    generated("command-line.md", "commands", &commands::table());
}

#[test]
fn the_page_of_drives_says_what_the_profiles_deliver() {
    generated("drives.md", "tables", &drives::tables());
}

#[test]
fn the_page_of_commissioning_says_what_the_profiles_deliver() {
    generated("commissioning.md", "cabinet", &cabinet::lists());
}

#[test]
fn the_page_of_safety_says_what_feeds_each_timeout() {
    generated("safety.md", "timeouts", &timeouts::table());
}

#[test]
fn the_two_commands_of_the_readme_exist() {
    let readme = read(&root().join("README.md"));
    assert!(readme.contains("\ncargo run --release -- demo "));
    assert!(readme.contains("\nmake test "));
    let makefile = read(&root().join("Makefile"));
    assert!(makefile.contains("\ntest: "));
    let ci = read(&root().join(".ci/run"));
    assert!(ci.contains("make test"), "CI runs the same command");
}

/// The contents of the book name every page and nothing else.
#[test]
fn the_contents_name_every_page() {
    let docs = root().join("docs");
    let contents = read(&docs.join("SUMMARY.md"));
    let mut named: Vec<PathBuf> = links(&contents).map(|link| docs.join(link)).collect();
    named.push(docs.join("SUMMARY.md"));
    named.sort();
    assert_eq!(named, files(&docs, "md"));
}

fn links(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| rest.split(')').next())
}

/// The anchor that a heading gets, here as in the book: lower case, words joined by hyphens, no other signs.
fn anchor(heading: &str) -> String {
    let kept = heading.trim_matches(['#', ' ']).to_lowercase();
    let kept = kept.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

fn anchors(text: &str) -> Vec<String> {
    let mut outside = true;
    let mut found = Vec::new();
    for line in text.lines() {
        if line.starts_with("```") {
            outside = !outside;
        } else if outside && line.starts_with('#') {
            found.push(anchor(line));
        }
    }
    found
}

#[test]
fn links_lead_somewhere() {
    let mut wrong = Vec::new();
    for document in documents() {
        let text = read(&document);
        for link in links(&text).filter(|link| !link.starts_with("http")) {
            let (file, place) = link.split_once('#').unwrap_or((link, ""));
            let target = match file {
                "" => document.clone(),
                file => document.parent().unwrap().join(file),
            };
            let is_right =
                target.exists() && (place.is_empty() || anchors(&read(&target)).contains(&place.to_string()));
            if !is_right {
                wrong.push(format!("{}: {link}", document.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The lines of all shell examples, with a command that continues over several lines as one.
fn examples() -> Vec<(PathBuf, String)> {
    let mut examples = Vec::new();
    for document in documents() {
        let text = read(&document);
        let pieces = text.split("\\\n").map(|piece| piece.trim_start_matches(' '));
        let text = pieces.collect::<String>();
        let shell = blocks(&text, "sh").join("\n");
        let console = blocks(&text, "console").join("\n");
        let typed = console.lines().filter_map(|line| line.strip_prefix("$ "));
        let lines = shell.lines().chain(typed);
        examples.extend(lines.map(|line| (document.clone(), line.to_string())));
    }
    examples
}

/// Every example that is pasted whole must be a command: a description follows `#` or has a separate line.
#[test]
fn examples_can_be_pasted_whole() {
    let examples = examples();
    let wrong: Vec<_> = examples.iter().filter(|(_, line)| has_trailing_prose(line)).collect();
    assert!(examples.len() > 100, "{}", examples.len());
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The words of a command of this program in a shell line; for `docker run IMAGE drivegate`, the words after it.
fn own_words(line: &str) -> Option<Vec<String>> {
    let (mut words, mut quote) = (vec![String::new()], None);
    for c in line.chars() {
        let last = words.last_mut()?;
        match (quote, c) {
            (Some(open), _) if open == c => quote = None,
            (None, '\'' | '"') => quote = Some(c),
            (None, '|' | '>' | '#' | ';' | '&') if last.is_empty() => break,
            (None, ' ') => words.push(String::new()),
            _ => last.push(c),
        }
    }
    words.retain(|word| !word.is_empty());
    let is_prefix = |word: &String| word == "sudo" || word.starts_with('-') || word.contains('=');
    let begins = words.iter().position(|word| !is_prefix(word))?;
    words
        .get(begins)?
        .ends_with("drivegate")
        .then(|| words.split_off(begins))
}

#[test]
fn the_options_of_all_examples_exist() {
    let (mut wrong, mut seen) = (Vec::new(), 0);
    for (document, line) in examples() {
        let Some(words) = own_words(&line) else { continue };
        seen += 1;
        match drivegate_tools::command_line().try_get_matches_from(&words) {
            Err(error) if error.use_stderr() => wrong.push(format!("{}: {line}: {error}", document.display())),
            _ => {}
        }
    }
    assert!(seen > 40, "{seen}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Words after two blanks or more that are neither a comment nor inside quotes nor the rest of a continued line.
fn has_trailing_prose(line: &str) -> bool {
    let mut quote = None;
    // The beginning of the line counts as a blank.
    let mut blanks = 1;
    for c in line.trim_start().chars() {
        match (quote, c) {
            (Some(open), _) if open == c => quote = None,
            (Some(_), _) => {}
            (None, '\'' | '"') if blanks < 2 => quote = Some(c),
            (None, '#') if blanks > 0 => return false,
            (None, ' ') => {
                blanks += 1;
                continue;
            }
            (None, '\\') => {}
            (None, _) if blanks >= 2 => return true,
            (None, _) => {}
        }
        blanks = 0;
    }
    false
}

#[test]
fn prose_behind_a_command_is_noticed() {
    for pasted in ["a  # b", "a -m 'x  y'", "  a \\", "a | b", "# a  b", "a \"x  y\" z"] {
        assert!(!has_trailing_prose(pasted), "{pasted}");
    }
    for wrong in [
        "mbpoll 127.0.0.1 5000              speed reference",
        "a -m 'x'   what it does",
        "a  b",
    ] {
        assert!(has_trailing_prose(wrong), "{wrong}");
    }
}

/// The first line of every fenced example in the comments of a crate, such as `text` or `sh`.
fn examples_in_comments(crate_root: &Path) -> Vec<String> {
    let sources = files(&crate_root.join("src"), "rs");
    let fence = |line: &str| {
        let comment = line.trim_start();
        let comment = comment.strip_prefix("//!").or_else(|| comment.strip_prefix("///"))?;
        Some(comment.trim().strip_prefix("```")?.to_string())
    };
    let of = |path: &PathBuf| read(path).lines().filter_map(fence).step_by(2).collect::<Vec<_>>();
    sources.iter().flat_map(of).collect()
}

/// A package has no doc tests (`doctest = false`, or no library) only where no comment has an example that could be compiled.
#[test]
fn examples_in_comments_are_compiled() {
    let crates = fs::read_dir(root().join("crates")).unwrap();
    let crates = crates.map(|entry| entry.unwrap().path()).chain([root().to_path_buf()]);
    let mut skipped = 0;
    for folder in crates {
        let manifest: toml::Table = read(&folder.join("Cargo.toml")).parse().unwrap();
        let library = manifest.get("lib");
        let tested = library.is_some_and(|lib| lib.get("doctest").and_then(toml::Value::as_bool).unwrap_or(true));
        if tested {
            continue;
        }
        skipped += 1;
        let text = |example: &String| example == "text";
        let (found, at) = (examples_in_comments(&folder), folder.display());
        assert!(
            found.iter().all(text),
            "{at}: doctest = false, but there are examples: {found:?}"
        );
    }
    assert!(skipped > 5, "{skipped}");
}
