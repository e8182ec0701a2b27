//! TOML documents that know the place of every value, for the configuration and the profiles.
//!
//! A [`Reader`] hands out the keys of one table. What is missing, of the wrong type or unknown is
//! collected as a [`Problem`] with file, line and key, so that one run reports every fault of a
//! file. A key is known when somebody asked for it: [`Reader::finish`] reports the others, with
//! the nearest known one.

mod file;

pub use file::read_file;

use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;
use toml::de::{DeTable, DeValue};

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

/// One key of a table: the key, its line, the value.
pub type Entry = (String, Option<usize>, Node);

/// A value and its place.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    /// The value.
    pub value: Raw,
    line: Option<usize>,
    env: Option<String>,
}

impl Node {
    /// The value of `key`, if this is a table that has it.
    pub fn entry(&self, key: &str) -> Option<&Node> {
        entries(self).iter().find(|(k, ..)| k == key).map(|(_, _, node)| node)
    }

    /// Line of the file, from 1.
    pub fn line(&self) -> Option<usize> {
        self.line
    }

    /// Takes the place of another value, so that what is told of this one is told there.
    pub fn stand_where(&mut self, other: &Node) {
        self.line = other.line;
        self.env = other.env.clone();
    }

    /// The same for a document of another file: what is told of it names `what` instead of a line.
    pub fn told_as(&self, what: &str) -> Node {
        let value = match &self.value {
            Raw::Table(entries) => {
                let told = entries
                    .iter()
                    .map(|(key, _, node)| (key.clone(), None, node.told_as(what)));
                Raw::Table(told.collect())
            }
            Raw::Array(items) => Raw::Array(items.iter().map(|item| item.told_as(what)).collect()),
            other => other.clone(),
        };
        Node {
            value,
            line: None,
            env: Some(what.to_string()),
        }
    }

    /// A table without keys.
    pub fn empty_table(env: Option<String>) -> Node {
        Node {
            value: Raw::Table(Vec::new()),
            line: None,
            env,
        }
    }
}

/// A TOML value.
#[derive(Debug, Clone, PartialEq)]
pub enum Raw {
    /// A string.
    Text(String),
    /// A 64-bit integer.
    Integer(i64),
    /// A float.
    Float(f64),
    /// A boolean.
    Bool(bool),
    /// An array.
    Array(Vec<Node>),
    /// A table: key, line of the key, value.
    Table(Vec<Entry>),
    /// Text of an environment variable, read as whatever type is wanted.
    Env(String),
    /// A date or an integer beyond 64 bits: no key takes one.
    Other,
}

impl Raw {
    fn kind(&self) -> &'static str {
        match self {
            Raw::Text(_) | Raw::Env(_) => "a string",
            Raw::Integer(_) => "an integer",
            Raw::Float(_) => "a number",
            Raw::Bool(_) => "a boolean",
            Raw::Array(_) => "an array",
            Raw::Table(_) => "a table",
            Raw::Other => "a date or an oversized number",
        }
    }
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
        let file = file.into();
        let lines = Lines::of(source);
        let (table, errors) = DeTable::parse_recoverable(source);
        let root = Node {
            value: table_of(table.into_inner(), &lines),
            line: None,
            env: None,
        };
        let document = Document {
            file,
            root,
            problems: RefCell::default(),
            warnings: RefCell::default(),
            known: RefCell::default(),
        };
        for error in errors {
            let place = Place {
                line: error.span().map(|s| lines.line(s.start)),
                ..Place::default()
            };
            document.problem(
                &place,
                format!("not valid TOML: {}", error.message().replace('\n', ", ")),
            );
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
                None => set(&mut self.root, &path, &name, value),
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
        Reader {
            document: self,
            entries: entries(&self.root),
            place: Place::default(),
            known: RefCell::default(),
            lenient: Cell::new(false),
        }
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

fn entries(node: &Node) -> &[Entry] {
    match &node.value {
        Raw::Table(entries) => entries,
        _ => &[],
    }
}

/// Starts of the lines of a text.
struct Lines(Vec<usize>);

impl Lines {
    fn of(source: &str) -> Lines {
        Lines(
            source
                .bytes()
                .enumerate()
                .filter(|&(_, b)| b == b'\n')
                .map(|(i, _)| i)
                .collect(),
        )
    }

    fn line(&self, offset: usize) -> usize {
        self.0.partition_point(|&end| end < offset) + 1
    }
}

fn table_of(table: DeTable<'_>, lines: &Lines) -> Raw {
    let entries = table.into_iter().map(|(key, value)| {
        let line = lines.line(key.span().start);
        let span = value.span();
        let node_line = if span.start == 0 && span.end == 0 {
            line
        } else {
            lines.line(span.start)
        };
        let value = value_of(value.into_inner(), lines);
        // A table's own place is its header or key, not the first of its values.
        let node_line = if matches!(value, Raw::Table(_)) {
            line
        } else {
            node_line
        };
        (
            key.into_inner().into_owned(),
            Some(line),
            Node {
                value,
                line: Some(node_line),
                env: None,
            },
        )
    });
    Raw::Table(entries.collect())
}

fn value_of(value: DeValue<'_>, lines: &Lines) -> Raw {
    match value {
        DeValue::String(text) => Raw::Text(text.into_owned()),
        DeValue::Integer(integer) => {
            i64::from_str_radix(integer.as_str(), integer.radix()).map_or(Raw::Other, Raw::Integer)
        }
        DeValue::Float(float) => float.as_str().parse().map_or(Raw::Other, Raw::Float),
        DeValue::Boolean(value) => Raw::Bool(value),
        DeValue::Datetime(_) => Raw::Other,
        DeValue::Array(array) => Raw::Array(
            array
                .into_iter()
                .map(|item| {
                    let line = Some(lines.line(item.span().start));
                    Node {
                        value: value_of(item.into_inner(), lines),
                        line,
                        env: None,
                    }
                })
                .collect(),
        ),
        DeValue::Table(table) => table_of(table, lines),
    }
}

fn set(node: &mut Node, path: &[String], name: &str, text: String) -> Result<(), String> {
    let Some((key, rest)) = path.split_first() else {
        *node = Node {
            value: Raw::Env(text),
            line: None,
            env: Some(name.to_string()),
        };
        return Ok(());
    };
    match &mut node.value {
        Raw::Table(entries) => {
            if let Some((_, _, child)) = entries.iter_mut().find(|(k, _, _)| k == key) {
                return set(child, rest, name, text);
            }
            let mut child = Node::empty_table(Some(name.to_string()));
            set(&mut child, rest, name, text)?;
            entries.push((key.clone(), None, child));
            Ok(())
        }
        Raw::Array(items) => {
            let count = items.len();
            match key.parse::<usize>().ok().and_then(|i| items.get_mut(i)) {
                Some(item) => set(item, rest, name, text),
                None => Err(format!("`{key}` is no element of an array of {count}; count from 0")),
            }
        }
        _ => Err(format!("`{key}` lies below a plain value; override the value itself")),
    }
}

/// Hands out the keys of one table.
#[derive(Debug)]
pub struct Reader<'d> {
    document: &'d Document,
    entries: &'d [Entry],
    place: Place,
    known: RefCell<Vec<String>>,
    lenient: Cell<bool>,
}

impl<'d> Reader<'d> {
    /// Where the table stands.
    pub fn place(&self) -> &Place {
        &self.place
    }

    /// The document it belongs to.
    pub fn document(&self) -> &'d Document {
        self.document
    }

    /// Where `key` stands, or the table when it is absent.
    pub fn place_of(&self, key: &str) -> Place {
        let node = self.find(key);
        let env = node.and_then(|n| n.env.clone()).or_else(|| self.place.env.clone());
        let line = node.and_then(|n| n.line).or(self.place.line);
        Place {
            line: line.filter(|_| env.is_none()),
            env,
            key: self.path(key),
        }
    }

    /// Adds a problem at `key`.
    pub fn problem(&self, key: &str, message: impl Into<String>) {
        self.document.problem(&self.place_of(key), message);
    }

    /// Adds a warning at `key`.
    pub fn warning(&self, key: &str, message: impl Into<String>) {
        self.document.warning(&self.place_of(key), message);
    }

    /// All keys that stand in the table, known or not.
    pub fn keys(&self) -> Vec<&'d str> {
        self.entries.iter().map(|(key, _, _)| key.as_str()).collect()
    }

    /// Whether `key` stands in the table; makes it known.
    pub fn has(&self, key: &str) -> bool {
        self.know(key);
        self.find(key).is_some()
    }

    /// The untyped value of `key`.
    pub fn raw(&self, key: &str) -> Option<&'d Node> {
        self.know(key);
        self.find(key)
    }

    /// The value of `key`, if it is there and right.
    pub fn optional<T: FromNode>(&self, key: &str) -> Option<T> {
        self.know(key);
        let node = self.find(key)?;
        match T::from_node(node) {
            Ok(value) => Some(value),
            Err(message) => {
                self.problem(key, message);
                None
            }
        }
    }

    /// The value of `key`; its absence is a problem.
    pub fn required<T: FromNode>(&self, key: &str) -> Option<T> {
        if !self.has(key) {
            self.problem(key, format!("`{key}` is missing; write {}", T::WANTED));
        }
        self.optional(key)
    }

    /// The value of `key` or, when it is absent or wrong, `default`.
    pub fn or<T: FromNode>(&self, key: &str, default: T) -> T {
        self.optional(key).unwrap_or(default)
    }

    /// The value of `key` parsed from a string.
    pub fn parsed<T>(&self, key: &str, parse: impl FnOnce(&str) -> Result<T, String>) -> Option<T> {
        let text: String = self.optional(key)?;
        match parse(&text) {
            Ok(value) => Some(value),
            Err(message) => {
                self.problem(key, message);
                None
            }
        }
    }

    /// The reader of the table `key`.
    pub fn table(&self, key: &str) -> Option<Reader<'d>> {
        self.know(key);
        let node = self.find(key)?;
        match node.value {
            Raw::Table(_) => Some(self.child(node, self.path(key))),
            _ => {
                self.problem(
                    key,
                    format!(
                        "`{key}` is {}, not a table; write [{}]",
                        node.value.kind(),
                        self.header(key)
                    ),
                );
                None
            }
        }
    }

    /// The readers of the array of tables `key`; none when it is absent.
    pub fn tables(&self, key: &str) -> Vec<Reader<'d>> {
        self.know(key);
        let Some(node) = self.find(key) else { return Vec::new() };
        let items = match &node.value {
            Raw::Array(items) if items.iter().all(|i| matches!(i.value, Raw::Table(_))) => items,
            other => {
                let kind = other.kind();
                self.problem(
                    key,
                    format!(
                        "`{key}` is {kind}, not a list of tables; write [[{}]]",
                        self.header(key)
                    ),
                );
                return Vec::new();
            }
        };
        items
            .iter()
            .enumerate()
            .map(|(i, item)| self.child(item, format!("{}[{i}]", self.path(key))))
            .collect()
    }

    /// The keys asked for so far: what the table may hold.
    pub fn known(&self) -> Vec<String> {
        self.known.borrow().clone()
    }

    /// Lets unknown keys pass, for a table that is broken in a way that is already told.
    pub fn tolerate(&self) {
        self.lenient.set(true);
    }

    /// Reports the keys nobody asked for, with the nearest known one.
    pub fn finish(&self) {
        if self.lenient.get() {
            return;
        }
        let known = self.known.borrow();
        for (key, line, node) in self.entries {
            if known.iter().any(|k| k == key) {
                continue;
            }
            let place = Place {
                line: line.or(node.line),
                env: node.env.clone(),
                key: self.path(key),
            };
            let remedy = match nearest(key, known.iter().map(String::as_str)) {
                Some(near) => format!("did you mean `{near}`?"),
                None => format!("known here: {}", known.join(", ")),
            };
            self.document.problem(&place, format!("unknown key `{key}`; {remedy}"));
        }
    }

    fn child(&self, node: &'d Node, key: String) -> Reader<'d> {
        let place = Place {
            line: node.line,
            env: node.env.clone(),
            key,
        };
        Reader {
            document: self.document,
            entries: entries(node),
            place,
            known: RefCell::default(),
            lenient: Cell::new(false),
        }
    }

    fn find(&self, key: &str) -> Option<&'d Node> {
        self.entries.iter().find(|(k, _, _)| k == key).map(|(_, _, node)| node)
    }

    fn know(&self, key: &str) {
        let mut known = self.known.borrow_mut();
        if !known.iter().any(|k| k == key) {
            known.push(key.to_string());
            self.document
                .known
                .borrow_mut()
                .insert(without_numbers(&self.path(key)));
        }
    }

    /// The path as it stands in the header of a table.
    fn header(&self, key: &str) -> String {
        without_numbers(&self.path(key)).replace("[]", "")
    }

    fn path(&self, key: &str) -> String {
        if self.place.key.is_empty() {
            key.to_string()
        } else {
            format!("{}.{key}", self.place.key)
        }
    }
}

/// `bus[0].drive[12].name` as `bus[].drive[].name`.
fn without_numbers(path: &str) -> String {
    let mut inside = false;
    let keep = |c: &char| {
        let number = inside && c.is_ascii_digit();
        inside = *c == '[' || number;
        !number
    };
    path.chars().filter(keep).collect()
}

/// The known word nearest to `word`, if one is near enough to be meant.
pub fn nearest<'a>(word: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let mut best: Option<(usize, &str)> = None;
    for candidate in known {
        let distance = strsim::damerau_levenshtein(word, candidate);
        let near = distance <= 1 + candidate.len() / 4;
        if near && best.is_none_or(|(least, _)| distance < least) {
            best = Some((distance, candidate));
        }
    }
    best.map(|(_, candidate)| candidate)
}

/// A type that a value can be read as.
pub trait FromNode: Sized {
    /// What to write, for messages: `a string`.
    const WANTED: &'static str;

    /// Reads the value.
    ///
    /// # Errors
    /// What is wrong and what to write instead.
    fn from_node(node: &Node) -> Result<Self, String>;
}

fn wrong<T: FromNode>(node: &Node) -> String {
    match &node.value {
        Raw::Env(text) | Raw::Text(text) => format!("`{text}` is not {}; write {}", T::WANTED, T::WANTED),
        other => format!("{} stands here; write {}", other.kind(), T::WANTED),
    }
}

impl FromNode for String {
    const WANTED: &'static str = "a string in quotes";

    fn from_node(node: &Node) -> Result<Self, String> {
        match &node.value {
            Raw::Text(text) | Raw::Env(text) => Ok(text.clone()),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

impl FromNode for PathBuf {
    const WANTED: &'static str = "a path in quotes";

    fn from_node(node: &Node) -> Result<Self, String> {
        String::from_node(node)
            .map(PathBuf::from)
            .map_err(|_| wrong::<Self>(node))
    }
}

impl FromNode for bool {
    const WANTED: &'static str = "true or false";

    fn from_node(node: &Node) -> Result<Self, String> {
        match &node.value {
            Raw::Bool(value) => Ok(*value),
            Raw::Env(text) => text.parse().map_err(|_| wrong::<Self>(node)),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

impl FromNode for i64 {
    const WANTED: &'static str = "a whole number";

    fn from_node(node: &Node) -> Result<Self, String> {
        match &node.value {
            Raw::Integer(value) => Ok(*value),
            Raw::Env(text) => text.parse().map_err(|_| wrong::<Self>(node)),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

macro_rules! from_integer {
    ($($type:ty: $wanted:literal),*) => {$(
        impl FromNode for $type {
            const WANTED: &'static str = $wanted;

            fn from_node(node: &Node) -> Result<Self, String> {
                let value = i64::from_node(node).map_err(|_| wrong::<Self>(node))?;
                <$type>::try_from(value)
                    .map_err(|_| format!("{value} is out of range; write {}", Self::WANTED))
            }
        }
    )*};
}

from_integer!(u8: "a whole number from 0 to 255", u16: "a whole number from 0 to 65535",
    u32: "a whole number from 0 to 4294967295", usize: "a whole number, not negative");

impl FromNode for f64 {
    const WANTED: &'static str = "a number";

    fn from_node(node: &Node) -> Result<Self, String> {
        let value = match &node.value {
            Raw::Float(value) => *value,
            Raw::Integer(value) => *value as f64,
            Raw::Env(text) => text.parse().map_err(|_| wrong::<Self>(node))?,
            _ => return Err(wrong::<Self>(node)),
        };
        if value.is_finite() {
            Ok(value)
        } else {
            Err(format!("{value} is no finite number; write {}", Self::WANTED))
        }
    }
}

impl FromNode for Duration {
    const WANTED: &'static str = "a duration in quotes, such as \"10ms\", \"1.5s\" or \"2min\"";

    fn from_node(node: &Node) -> Result<Self, String> {
        match &node.value {
            Raw::Text(text) | Raw::Env(text) => parse_duration(text),
            _ => Err(wrong::<Self>(node)),
        }
    }
}

impl<T: FromNode> FromNode for Vec<T> {
    const WANTED: &'static str = "a list in brackets";

    fn from_node(node: &Node) -> Result<Self, String> {
        match &node.value {
            Raw::Array(items) => items.iter().map(T::from_node).collect(),
            Raw::Env(text) => text
                .split(',')
                .map(|item| {
                    let value = Raw::Env(item.trim().to_string());
                    T::from_node(&Node {
                        value,
                        line: node.line,
                        env: node.env.clone(),
                    })
                })
                .collect(),
            _ => Err(format!("{}, each {}", wrong::<Self>(node), T::WANTED)),
        }
    }
}

/// A duration: a number, not negative, and one of `us`, `ms`, `s`, `min`, `h`.
///
/// # Errors
/// What is wrong and what to write.
pub fn parse_duration(text: &str) -> Result<Duration, String> {
    let bad = || format!("`{text}` is no duration; write {}", Duration::WANTED);
    let trimmed = text.trim();
    let digits = trimmed
        .find(|c: char| !c.is_ascii_digit() && c != '.')
        .ok_or_else(bad)?;
    let (number, unit) = trimmed.split_at(digits);
    let number: f64 = number.parse().map_err(|_| bad())?;
    let seconds = match unit.trim_start() {
        "us" | "µs" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        "min" => 60.0,
        "h" => 3600.0,
        _ => return Err(bad()),
    };
    Duration::try_from_secs_f64(number * seconds).map_err(|_| bad())
}

/// The text that [`parse_duration`] reads as `time`, in the unit that makes it short.
pub fn format_duration(time: Duration) -> String {
    match (time.as_secs(), time.subsec_nanos()) {
        (0, 0) => "0s".to_string(),
        (seconds, 0) if seconds % 3600 == 0 => format!("{}h", seconds / 3600),
        (seconds, 0) if seconds % 60 == 0 => format!("{}min", seconds / 60),
        (0, nanos) if nanos < 1000 => format!("{}us", f64::from(nanos) / 1e3),
        _ => format!("{time:?}"),
    }
}

/// A size in bytes: a number and one of `B`, `KiB`, `MiB`, `GiB`.
///
/// # Errors
/// What is wrong and what to write.
pub fn parse_size(text: &str) -> Result<u64, String> {
    let bad = || format!("`{text}` is no size; write a whole number with B, KiB, MiB or GiB, such as \"64MiB\"");
    let trimmed = text.trim();
    let digits = trimmed.find(|c: char| !c.is_ascii_digit()).ok_or_else(bad)?;
    let (number, unit) = trimmed.split_at(digits);
    let number: u64 = number.parse().map_err(|_| bad())?;
    let shift = match unit.trim_start() {
        "B" => 0,
        "KiB" => 10,
        "MiB" => 20,
        "GiB" => 30,
        _ => return Err(bad()),
    };
    number
        .checked_shl(shift)
        .filter(|v| v >> shift == number)
        .ok_or_else(bad)
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn durations_and_sizes() {
        assert_eq!(parse_duration("0.5ms"), Ok(Duration::from_micros(500)));
        assert_eq!(parse_duration("2min"), Ok(Duration::from_secs(120)));
        assert_eq!(parse_duration("10 s"), Ok(Duration::from_secs(10)));
        for bad in ["", "10", "ms", "-1s", "1d", "1.2.3s", "1e3s"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
        for text in ["0s", "0.5us", "303.819µs", "10ms", "1.5s", "90s", "2min", "1h"] {
            assert_eq!(format_duration(parse_duration(text).unwrap()), text);
        }
        assert_eq!(parse_size("64MiB"), Ok(64 << 20));
        for bad in ["", "64", "64MB", "-1B", "99999999999999999GiB"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }
}
