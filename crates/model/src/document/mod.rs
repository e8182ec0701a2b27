//! TOML documents that record the place of every value, for the configuration and the profiles.
//!
//! A [`Reader`] returns the values of one table. Keys that are missing, unknown or have the wrong type are
//! collected as [`Problem`]s with file, line and key, so that one run reports every error of a file. A key counts
//! as known once it was requested: [`Reader::finish`] reports all others, each with the most similar known key.
//!
//! `tree` has the values, `value` the types as which they can be read, `mistakes` common notations that are not TOML.

mod file;
mod mistakes;
mod reader;
mod tree;
mod value;

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fmt;

use serde::{Serialize, Serializer};

pub use drivegate_proto::duration::format as format_duration;
pub use file::read_file;
pub use reader::{Reader, candidates, nearest};
pub use tree::{Entry, Node, Raw};
pub use value::{FromNode, ValueError, parse_duration, parse_size};

/// A fault with its remedy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// The fault, as text.
    pub what: String,
    /// The remedy for the fault; empty if there is nothing to add.
    pub remedy: String,
}

impl Finding {
    /// A finding with fault and remedy.
    pub fn new(what: impl Into<String>, remedy: impl Into<String>) -> Finding {
        Finding {
            what: what.into(),
            remedy: remedy.into(),
        }
    }
}

impl fmt::Display for Finding {
    /// The fault and the advice in the form `what; what to do`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)?;
        match self.remedy.as_str() {
            "" => Ok(()),
            remedy => write!(f, "; {remedy}"),
        }
    }
}

impl std::error::Error for Finding {}

/// A finding with its place in a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// Name of the file, or of the environment variable that overrides it.
    pub file: String,
    /// Line of the file, counted from 1; absent if the problem has no line.
    pub line: Option<usize>,
    /// Dotted path of the key, such as `bus[0].drive[1].address`.
    pub key: String,
    /// The fault with its remedy.
    #[serde(rename = "message", serialize_with = "as_text")]
    pub finding: Finding,
}

impl Problem {
    /// A problem of a whole file, or of `key` in it, without a line number.
    pub fn of_file(file: impl Into<String>, key: &str, finding: Finding) -> Problem {
        Problem {
            file: file.into(),
            line: None,
            key: key.to_string(),
            finding,
        }
    }
}

impl fmt::Display for Problem {
    /// Formats as `what; file:line, key; what to do`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut place = self.file.clone();
        if let Some(line) = self.line {
            place += &format!(":{line}");
        }
        if !self.key.is_empty() {
            place += &format!(", {}", self.key);
        }
        let what = format!("{}; {place}", self.finding.what);
        Finding::new(what, self.finding.remedy.as_str()).fmt(f)
    }
}

fn as_text<S: Serializer>(finding: &Finding, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(finding)
}

/// The place of a value in a document.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Place {
    /// Line of the file, from 1.
    pub line: Option<usize>,
    /// Environment variable that set the value instead of the file.
    pub env: Option<String>,
    /// Dotted path of the key.
    pub key: String,
}

/// A parsed file with the problems found in it so far.
#[derive(Debug, Clone)]
pub struct Document {
    file: String,
    root: Node,
    /// Syntax errors. Any other finding may be only a consequence of these.
    syntax: Vec<Problem>,
    problems: RefCell<Vec<Problem>>,
    warnings: RefCell<Vec<Problem>>,
    known: RefCell<BTreeSet<String>>,
}

impl Document {
    /// Parses `source`, the text of `file`. The first syntax error becomes the only problem; everything that can be
    /// parsed is kept.
    pub fn parse(file: impl Into<String>, source: &str) -> Document {
        let (root, errors) = tree::parse(source);
        let mut document = Document {
            file: file.into(),
            root,
            syntax: Vec::new(),
            problems: RefCell::default(),
            warnings: RefCell::default(),
            known: RefCell::default(),
        };
        // A missing bracket makes every later line an error, so only the first error is reported.
        for (line, message) in errors.into_iter().take(1) {
            let place = Place {
                line,
                ..Place::default()
            };
            let named = mistakes::named(source, line);
            let found = named.unwrap_or_else(|| Finding::new(message, ""));
            let what = format!("not valid TOML: {}", found.what);
            let problem = document.problem_at(&place, Finding::new(what, found.remedy));
            document.syntax.push(problem);
        }
        document
    }

    /// Adds the top-level section `name` if it is absent, so that environment variables can set its keys.
    pub fn ensure_section(&mut self, name: &str) {
        let Raw::Table(entries) = &mut self.root.value else {
            return;
        };
        if !entries.iter().any(|(key, _, _)| key == name) {
            entries.push((name.to_string(), None, Node::empty_table()));
        }
    }

    /// Lets variables `PREFIX__TABLE__KEY=value` (array elements by number, from 0) replace or add scalars. The
    /// table that contains the scalar must exist.
    pub fn overlay<I: IntoIterator<Item = (String, String)>>(&mut self, prefix: &str, variables: I) {
        let start = format!("{prefix}__");
        let mut variables: Vec<_> = variables
            .into_iter()
            .filter(|(name, _)| name.starts_with(&start))
            .collect();
        variables.sort();
        for (name, value) in variables {
            let path: Vec<String> = name.split("__").skip(1).map(str::to_lowercase).collect();
            if let Err(error) = tree::set(&mut self.root, &path, &name, value) {
                let finding = Finding::new(error.to_string(), error.remedy());
                let problem = Problem::of_file(name, &path.join("."), finding);
                self.problems.get_mut().push(problem);
            }
        }
    }

    /// The root table of the document.
    pub fn root(&self) -> &Node {
        &self.root
    }

    /// Replaces the parsed tree.
    pub(crate) fn set_root(&mut self, root: Node) {
        self.root = root;
    }

    /// The reader of the whole document.
    pub fn reader(&self) -> Reader<'_> {
        Reader::of(self, &self.root, Place::default())
    }

    /// Path of the file.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Adds a problem.
    pub fn problem(&self, place: &Place, what: impl Into<String>, remedy: impl Into<String>) {
        let problem = self.problem_at(place, Finding::new(what, remedy));
        self.problems.borrow_mut().push(problem);
    }

    /// Adds a warning: the document can be used, but a part of it will not have the effect that it seems to have.
    pub fn warning(&self, place: &Place, what: impl Into<String>, remedy: impl Into<String>) {
        let warning = self.problem_at(place, Finding::new(what, remedy));
        self.warnings.borrow_mut().push(warning);
    }

    fn problem_at(&self, place: &Place, finding: Finding) -> Problem {
        Problem {
            file: place.env.clone().unwrap_or_else(|| self.file.clone()),
            line: place.line,
            key: place.key.clone(),
            finding,
        }
    }

    /// Every key that the readers of this document requested, as a path without array indices: `bus[].drive[].address`.
    pub fn known_keys(&self) -> BTreeSet<String> {
        self.known.borrow().clone()
    }

    /// Whether no problem was found so far.
    pub fn is_sound(&self) -> bool {
        self.is_toml() && self.problems.borrow().is_empty()
    }

    /// Whether the file is TOML.
    pub fn is_toml(&self) -> bool {
        self.syntax.is_empty()
    }

    /// Problems and warnings, each sorted by line; for a file that is not TOML only the syntax error.
    pub fn into_findings(self) -> (Vec<Problem>, Vec<Problem>) {
        if !self.is_toml() {
            return (self.syntax, Vec::new());
        }
        let sorted = |mut found: Vec<Problem>| {
            found.sort_by_key(|p| p.line.unwrap_or(usize::MAX));
            found
        };
        (sorted(self.problems.into_inner()), sorted(self.warnings.into_inner()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn problems(text: &str, read: impl Fn(&Reader<'_>)) -> Vec<String> {
        let document = Document::parse("f.toml", text);
        let reader = document.reader();
        read(&reader);
        reader.finish();
        document.into_findings().0.iter().map(Problem::to_string).collect()
    }

    #[test]
    fn every_error_has_its_place() {
        let text = "nmae = \"x\"\nport = 5\n\n[[bus]]\nbaud = \"fast\"\n[[bus]]\nbaud = -1\n";
        let found = problems(text, |r| {
            let _: Option<String> = r.required("name");
            let _: Option<String> = r.optional("port");
            for bus in r.tables("bus") {
                let _: Option<u32> = bus.required("baud");
                bus.finish();
            }
        });
        assert_eq!(
            found,
            [
                "unknown key `nmae`; f.toml:1, nmae; did you mean `name`?",
                "wrong type: an integer; f.toml:2, port; write a string in quotes",
                "`fast` is not a whole number from 0 to 4294967295; f.toml:5, bus[0].baud; write a whole number from 0 to 4294967295",
                "-1 is out of range; f.toml:7, bus[1].baud; write a whole number from 0 to 4294967295",
                "`name` is missing; f.toml, name; write a string in quotes",
            ]
        );
    }

    #[test]
    fn syntax_errors_have_lines() {
        let found = problems("a = 1\nb = = 2\n", |r| {
            let _: Option<String> = r.optional("a");
            let _: Option<String> = r.required("c");
        });
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].contains("f.toml:2"), "{found:?}");
    }

    #[test]
    fn environment_overrides() {
        let mut document = Document::parse("f.toml", "[mqtt]\nport = 1\n[mqtt.publish]\n[[bus]]\nbaud = 9600\n");
        let set = |k: &str, v: &str| (k.to_string(), v.to_string());
        document.ensure_section("log");
        document.overlay(
            "DRIVEGATE",
            [
                set("DRIVEGATE__MQTT__PASSWORD", "1234"),
                set("DRIVEGATE__MQTT__PUBLISH__MIN_INTERVAL", "1s"),
                set("DRIVEGATE__BUS__0__BAUD", "19200"),
                set("DRIVEGATE__LOG__LEVEL", "debug"),
                set("DRIVEGATE__HTTP__LISTEN", "x"),
                set("DRIVEGATE__BUS__3__BAUD", "1"),
                set("DRIVEGATE__BUS__0__DRIVE__0__ADDRESS", "1"),
                set("DRIVEGATE__MQTT__SPARKPLUG__GROUP", "x"),
                set("OTHER", "x"),
            ],
        );
        let reader = document.reader();
        let mqtt = reader.table("mqtt").unwrap();
        assert_eq!(mqtt.optional::<String>("password").as_deref(), Some("1234"));
        let publish = mqtt.table("publish").unwrap();
        assert_eq!(
            publish.optional::<Duration>("min_interval"),
            Some(Duration::from_secs(1))
        );
        assert_eq!(reader.tables("bus")[0].optional::<u32>("baud"), Some(19_200));
        let log = reader.table("log").unwrap();
        assert_eq!(log.optional::<String>("level").as_deref(), Some("debug"));
        assert_eq!(log.place_of("level").env.as_deref(), Some("DRIVEGATE__LOG__LEVEL"));
        let known: Vec<String> = document.known_keys().into_iter().collect();
        assert_eq!(
            known,
            [
                "bus",
                "bus[].baud",
                "log",
                "log.level",
                "mqtt",
                "mqtt.password",
                "mqtt.publish",
                "mqtt.publish.min_interval"
            ]
        );
        let found: Vec<String> = document.into_findings().0.iter().map(Problem::to_string).collect();
        let absent = |key: &str| format!("there is no `{key}` in the file to override");
        assert_eq!(
            found,
            [
                absent("bus.0.drive")
                    + "; DRIVEGATE__BUS__0__DRIVE__0__ADDRESS, bus.0.drive.0.address; add the section to the file first",
                "`3` is not an element of an array of 1; DRIVEGATE__BUS__3__BAUD, bus.3.baud; count from 0".to_string(),
                absent("http") + "; DRIVEGATE__HTTP__LISTEN, http.listen; add the section to the file first",
                absent("mqtt.sparkplug")
                    + "; DRIVEGATE__MQTT__SPARKPLUG__GROUP, mqtt.sparkplug.group; add the section to the file first",
            ]
        );
    }
}
