//! TOML documents that know the place of every value, for the configuration and the profiles.
//!
//! A [`Reader`] hands out the keys of one table. What is missing, of the wrong type or unknown is
//! collected as a [`Problem`] with file, line and key, so that one run reports every fault of a
//! file. A key is known when somebody asked for it: [`Reader::finish`] reports the others, with
//! the nearest known one.
//!
//! The values themselves are in `tree`, the types that they can be read as in `value`.

mod file;
mod reader;
mod tree;
mod value;

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fmt;

use serde::Serialize;

use tree::entries;

pub use file::read_file;
pub use reader::{Reader, nearest};
pub use tree::{Entry, Node, Raw};
pub use value::{FromNode, format_duration, parse_duration, parse_size};

/// One fault of a document: what, where, and what to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Problem {
    /// File, or the environment variable that overrides it.
    pub file: String,
    /// Line of the file, from 1; absent where there is none.
    pub line: Option<usize>,
    /// Dotted path of the key, such as `bus[0].drive[1].address`.
    pub key: String,
    /// What is wrong and what to do, separated by `; `.
    pub message: String,
}

impl fmt::Display for Problem {
    /// `what; file:line, key; what to do`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (what, remedy) = match self.message.split_once("; ") {
            Some((what, remedy)) => (what, Some(remedy)),
            None => (self.message.as_str(), None),
        };
        write!(f, "{what}; {}", self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if !self.key.is_empty() {
            write!(f, ", {}", self.key)?;
        }
        match remedy {
            Some(remedy) => write!(f, "; {remedy}"),
            None => Ok(()),
        }
    }
}

/// Where a value stands.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Place {
    /// Line of the file, from 1.
    pub line: Option<usize>,
    /// Environment variable that set the value instead of the file.
    pub env: Option<String>,
    /// Dotted path of the key.
    pub key: String,
}

/// A parsed file and the problems found in it so far.
#[derive(Debug)]
pub struct Document {
    file: String,
    root: Node,
    problems: RefCell<Vec<Problem>>,
    warnings: RefCell<Vec<Problem>>,
    known: RefCell<BTreeSet<String>>,
}

impl Document {
    /// Parses `source`, the text of `file`. Syntax errors become problems; what could be read is kept.
    pub fn parse(file: impl Into<String>, source: &str) -> Document {
        let (root, errors) = tree::parse(source);
        let document = Document {
            file: file.into(),
            root,
            problems: RefCell::default(),
            warnings: RefCell::default(),
            known: RefCell::default(),
        };
        for (line, message) in errors {
            let place = Place {
                line,
                ..Place::default()
            };
            document.problem(&place, format!("not valid TOML: {message}"));
        }
        document
    }

    /// Adds the section `name` of the top level if it is absent, so that variables can set its keys.
    pub fn ensure_section(&mut self, name: &str) {
        let Raw::Table(entries) = &mut self.root.value else {
            return;
        };
        if !entries.iter().any(|(key, _, _)| key == name) {
            entries.push((name.to_string(), None, Node::empty_table(None)));
        }
    }

    /// Lets variables `PREFIX__TABLE__KEY=value` (array elements by number, from 0) replace or add scalars.
    /// The section must be there, tables inside it need not.
    pub fn overlay<I: IntoIterator<Item = (String, String)>>(&mut self, prefix: &str, variables: I) {
        let start = format!("{prefix}__");
        let mut variables: Vec<_> = variables
            .into_iter()
            .filter(|(name, _)| name.starts_with(&start))
            .collect();
        variables.sort();
        for (name, value) in variables {
            let path: Vec<String> = name.split("__").skip(1).map(str::to_lowercase).collect();
            let absent = path
                .first()
                .filter(|section| path.len() > 1 && !self.has_section(section));
            let outcome = match absent {
                Some(section) => Err(format!(
                    "there is no `{section}` in the file to override; add the section to the file first"
                )),
                None => tree::set(&mut self.root, &path, &name, value),
            };
            if let Err(message) = outcome {
                let problem = Problem {
                    file: name,
                    line: None,
                    key: path.join("."),
                    message,
                };
                self.problems.get_mut().push(problem);
            }
        }
    }

    /// The whole tree.
    pub fn root(&self) -> &Node {
        &self.root
    }

    /// Puts another tree in the place of the one that was parsed.
    pub fn set_root(&mut self, root: Node) {
        self.root = root;
    }

    /// The reader of the whole document.
    pub fn reader(&self) -> Reader<'_> {
        Reader::of(self, &self.root, Place::default())
    }

    /// Adds a problem.
    pub fn problem(&self, place: &Place, message: impl Into<String>) {
        self.problems.borrow_mut().push(self.finding(place, message.into()));
    }

    /// Adds a warning: the document can be used, but something in it will not do what it seems to.
    pub fn warning(&self, place: &Place, message: impl Into<String>) {
        self.warnings.borrow_mut().push(self.finding(place, message.into()));
    }

    fn finding(&self, place: &Place, message: String) -> Problem {
        Problem {
            file: place.env.clone().unwrap_or_else(|| self.file.clone()),
            line: place.line,
            key: place.key.clone(),
            message,
        }
    }

    fn has_section(&self, name: &str) -> bool {
        entries(&self.root).iter().any(|(key, _, _)| key == name)
    }

    /// Every key that any reader of this document asked for, as a path without the numbers of array
    /// elements: `bus[].drive[].address`.
    pub fn known_keys(&self) -> BTreeSet<String> {
        self.known.borrow().clone()
    }

    /// Whether no problem was found so far.
    pub fn is_sound(&self) -> bool {
        self.problems.borrow().is_empty()
    }

    /// The file's name as it was given.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Takes the problems, in the order of the lines.
    pub fn into_problems(self) -> Vec<Problem> {
        self.into_findings().0
    }

    /// Takes problems and warnings, each in the order of the lines.
    pub fn into_findings(self) -> (Vec<Problem>, Vec<Problem>) {
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
        document.into_problems().iter().map(Problem::to_string).collect()
    }

    #[test]
    fn every_fault_is_told_with_its_place() {
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
                "an integer stands here; f.toml:2, port; write a string in quotes",
                "`fast` is not a whole number from 0 to 4294967295; f.toml:5, bus[0].baud; write a whole number from 0 to 4294967295",
                "-1 is out of range; f.toml:7, bus[1].baud; write a whole number from 0 to 4294967295",
                "`name` is missing; f.toml, name; write a string in quotes",
            ]
        );
    }

    #[test]
    fn syntax_errors_have_lines() {
        let found = problems("a = 1\nb = = 2\n", |r| {
            let _: Option<i64> = r.optional("a");
            let _ = r.raw("b");
        });
        assert!(found[0].contains("f.toml:2"), "{found:?}");
    }

    #[test]
    fn environment_overrides() {
        let mut document = Document::parse("f.toml", "[mqtt]\nport = 1\n[[bus]]\nbaud = 9600\n");
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
        let found: Vec<String> = document.into_problems().iter().map(|p| p.file.clone()).collect();
        assert_eq!(found, ["DRIVEGATE__BUS__3__BAUD", "DRIVEGATE__HTTP__LISTEN"]);
    }
}
