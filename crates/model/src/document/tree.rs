//! The tree of a document: values with their places, read from TOML or from an environment variable.

use toml::de::{DeTable, DeValue};

/// A key of a table: the key, its line, the value.
pub type Entry = (String, Option<usize>, Node);

/// A value with its place in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    /// The value itself.
    pub value: Raw,
    pub(super) line: Option<usize>,
    pub(super) env: Option<String>,
}

impl Node {
    /// The value of `key`; `None` if this is not a table or lacks the key.
    pub fn entry(&self, key: &str) -> Option<&Node> {
        entries(self).iter().find(|(k, ..)| k == key).map(|(_, _, node)| node)
    }

    /// Line of the file, from 1.
    pub(crate) fn line(&self) -> Option<usize> {
        self.line
    }

    /// Takes over the place of another value: problems of this one are then reported there.
    pub(crate) fn move_to(&mut self, other: &Node) {
        self.line = other.line;
        self.env = other.env.clone();
    }

    /// A copy for a document of another file: its problems name `source` instead of a line.
    pub(crate) fn with_source(&self, source: &str) -> Node {
        let value = match &self.value {
            Raw::Table(entries) => {
                let copies = entries
                    .iter()
                    .map(|(key, _, node)| (key.clone(), None, node.with_source(source)));
                Raw::Table(copies.collect())
            }
            Raw::Array(items) => Raw::Array(items.iter().map(|item| item.with_source(source)).collect()),
            other => other.clone(),
        };
        Node {
            value,
            line: None,
            env: Some(source.to_string()),
        }
    }

    /// A table without keys.
    pub(crate) fn empty_table() -> Node {
        Node {
            value: Raw::Table(Vec::new()),
            line: None,
            env: None,
        }
    }
}

/// A TOML value.
#[derive(Debug, Clone, PartialEq)]
pub enum Raw {
    /// A string value.
    Text(String),
    /// A 64-bit integer.
    Integer(i64),
    /// A float value.
    Float(f64),
    /// A boolean value.
    Bool(bool),
    /// An array of values.
    Array(Vec<Node>),
    /// A table: key, line of the key, value.
    Table(Vec<Entry>),
    /// Text of an environment variable, read as any type.
    Env(String),
    /// A value that no key accepts: `a date`.
    Other(&'static str),
}

impl Raw {
    /// The type as text for messages: `an integer`.
    pub fn kind(&self) -> &'static str {
        match self {
            Raw::Text(_) | Raw::Env(_) => "a string",
            Raw::Integer(_) => "an integer",
            Raw::Float(_) => "a number",
            Raw::Bool(_) => "a boolean",
            Raw::Array(_) => "an array",
            Raw::Table(_) => "a table",
            Raw::Other(kind) => kind,
        }
    }
}

/// The keys of a table; empty for any other value.
pub(super) fn entries(node: &Node) -> &[Entry] {
    match &node.value {
        Raw::Table(entries) => entries,
        _ => &[],
    }
}

/// Parses `source` as far as possible; each error has its line and text.
pub(super) fn parse(source: &str) -> (Node, Vec<(Option<usize>, String)>) {
    let lines = Lines::of(source);
    let (table, errors) = DeTable::parse_recoverable(source);
    let root = Node {
        value: table_of(table.into_inner(), &lines),
        line: None,
        env: None,
    };
    let errors = errors.iter().map(|error| {
        let line = error.span().map(|s| lines.line(s.start));
        (line, error.message().replace('\n', ", "))
    });
    (root, errors.collect())
}

/// Ends of the lines of a text.
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
        // The place of a table is its header or key, not its first value.
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
        DeValue::Integer(integer) => i64::from_str_radix(integer.as_str(), integer.radix())
            .map_or(Raw::Other("an integer with too many digits"), Raw::Integer),
        DeValue::Float(float) => float
            .as_str()
            .parse()
            .map_or(Raw::Other("a number that cannot be read"), Raw::Float),
        DeValue::Boolean(value) => Raw::Bool(value),
        DeValue::Datetime(_) => Raw::Other("a date"),
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

/// Why an environment variable cannot override a value.
#[derive(Debug, thiserror::Error)]
pub(super) enum OverrideError {
    #[error("there is no `{0}` in the file to override")]
    NoSection(String),
    #[error("`{key}` is not an element of an array of {count}")]
    NoElement { key: String, count: usize },
    #[error("`{0}` is below a plain value")]
    BelowValue(String),
}

impl OverrideError {
    /// The remedy for the error.
    pub(super) fn remedy(&self) -> &'static str {
        match self {
            OverrideError::NoSection(_) => "add the section to the file first",
            OverrideError::NoElement { .. } => "count from 0",
            OverrideError::BelowValue(_) => "override the value itself",
        }
    }
}

/// Sets the value at `path` below `root` to the `text` of the variable `name`; its table must exist.
///
/// # Errors
/// If the path leads to no table.
pub(super) fn set(root: &mut Node, path: &[String], name: &str, text: String) -> Result<(), OverrideError> {
    let value = Node {
        value: Raw::Env(text),
        line: None,
        env: Some(name.to_string()),
    };
    let (mut node, mut rest) = (root, path);
    while let Some((key, below)) = rest.split_first() {
        rest = below;
        node = match &mut node.value {
            Raw::Table(entries) => match entries.iter().position(|(k, ..)| k == key) {
                None if rest.is_empty() => {
                    entries.push((key.clone(), None, value));
                    return Ok(());
                }
                place => place
                    .and_then(|place| entries.get_mut(place))
                    .map(|(.., child)| child)
                    .ok_or_else(|| {
                        let passed = path.iter().take(path.len() - rest.len()).cloned();
                        OverrideError::NoSection(passed.collect::<Vec<_>>().join("."))
                    })?,
            },
            Raw::Array(items) => element(items, key)?,
            _ => return Err(OverrideError::BelowValue(key.clone())),
        };
    }
    *node = value;
    Ok(())
}

/// The element of an array that a variable names.
fn element<'n>(items: &'n mut [Node], key: &str) -> Result<&'n mut Node, OverrideError> {
    let count = items.len();
    let item = key.parse::<usize>().ok().and_then(|index| items.get_mut(index));
    item.ok_or_else(|| OverrideError::NoElement {
        key: key.to_string(),
        count,
    })
}
