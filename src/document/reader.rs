//! The reader of one table: typed values by key, and what is missing, wrong or unknown as problems.

use std::cell::{Cell, RefCell};

use super::tree::entries;
use super::{Document, Entry, FromNode, Node, Place, Raw};

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
    /// The reader of the table `node` of `document`.
    pub(super) fn of(document: &'d Document, node: &'d Node, place: Place) -> Reader<'d> {
        Reader {
            document,
            entries: entries(node),
            place,
            known: RefCell::default(),
            lenient: Cell::new(false),
        }
    }

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
        Reader::of(self.document, node, place)
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
