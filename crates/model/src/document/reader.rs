//! The reader of one table: typed values by key; missing, wrong and unknown keys become problems.

use std::cell::{Cell, RefCell};

use super::tree::entries;
use super::{Document, Entry, Finding, FromNode, Node, Place, Raw};

/// Returns the keys of one table.
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

    /// The document that the reader belongs to.
    pub fn document(&self) -> &'d Document {
        self.document
    }

    /// The place of `key`, or of the table if the key is absent.
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
    pub fn problem(&self, key: &str, what: impl Into<String>, remedy: impl Into<String>) {
        self.document.problem(&self.place_of(key), what, remedy);
    }

    /// Adds a finding about the value of `key`.
    pub(crate) fn finding(&self, key: &str, finding: impl Into<Finding>) {
        let Finding { what, remedy } = finding.into();
        self.problem(key, what, remedy);
    }

    /// The value of `outcome`. An error is reported as a problem at `key`, and `None` is returned.
    pub fn accept<T, E: Into<Finding>>(&self, key: &str, outcome: Result<T, E>) -> Option<T> {
        outcome.map_err(|error| self.finding(key, error)).ok()
    }

    /// Adds a warning at `key`.
    pub fn warning(&self, key: &str, what: impl Into<String>, remedy: impl Into<String>) {
        self.document.warning(&self.place_of(key), what, remedy);
    }

    /// All keys of the table, known or not.
    pub fn keys(&self) -> Vec<&'d str> {
        self.entries.iter().map(|(key, _, _)| key.as_str()).collect()
    }

    /// Whether the table has `key`; the key then counts as known.
    pub fn has(&self, key: &str) -> bool {
        self.know(key);
        self.find(key).is_some()
    }

    /// The untyped value of `key`.
    pub fn raw(&self, key: &str) -> Option<&'d Node> {
        self.know(key);
        self.find(key)
    }

    /// The value of `key` if the key is present and the value is valid.
    pub fn optional<T: FromNode>(&self, key: &str) -> Option<T> {
        self.know(key);
        let node = self.find(key)?;
        self.accept(key, T::from_node(node))
    }

    /// The value of `key`; a missing key is a problem.
    pub fn required<T: FromNode>(&self, key: &str) -> Option<T> {
        if !self.has(key) {
            self.problem(key, format!("`{key}` is missing"), format!("write {}", T::WANTED));
        }
        self.optional(key)
    }

    /// The value of `key`, or `default` if the value is absent or wrong.
    pub(crate) fn or<T: FromNode>(&self, key: &str, default: T) -> T {
        self.optional(key).unwrap_or(default)
    }

    /// The value of `key` parsed from a string.
    pub fn parsed<T, E: Into<Finding>>(&self, key: &str, parse: impl FnOnce(&str) -> Result<T, E>) -> Option<T> {
        let text: String = self.optional(key)?;
        self.accept(key, parse(&text))
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
                    format!("`{key}` is {}, not a table", node.value.kind()),
                    format!("write [{}] on a line of its own, and its keys below", self.header(key)),
                );
                None
            }
        }
    }

    /// The readers of the array of tables `key`; empty if the array is absent.
    pub fn tables(&self, key: &str) -> Vec<Reader<'d>> {
        self.know(key);
        let Some(node) = self.find(key) else { return Vec::new() };
        let items = match &node.value {
            Raw::Array(items) if items.iter().all(|i| matches!(i.value, Raw::Table(_))) => items,
            other => {
                self.problem(
                    key,
                    format!("`{key}` is {}, not a list of tables", other.kind()),
                    format!("write [[{}]]", self.header(key)),
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

    /// Accepts unknown keys, for a table whose reported error may explain them.
    pub(crate) fn tolerate(&self) {
        self.lenient.set(true);
    }

    /// Reports the keys that were never requested, each with the nearest known key.
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
            let names = || known.iter().map(String::as_str);
            let elsewhere = named_elsewhere(key).filter(|(own, _)| names().any(|name| name == *own));
            let remedy = match (elsewhere, nearest(key, names())) {
                (Some((own, example)), _) => format!("write `{own}`, such as {own} = {example}"),
                (None, Some(near)) => format!("did you mean `{near}`?"),
                (None, None) => format!("known here: {}", known.join(", ")),
            };
            self.document.problem(&place, format!("unknown key `{key}`"), remedy);
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

    /// The path in the form that the header of a table has.
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

/// The key that corresponds to a name used by other programs, with an example of its value.
fn named_elsewhere(key: &str) -> Option<(&'static str, &'static str)> {
    match key {
        "parity" | "stopbits" | "stop_bits" | "databits" | "data_bits" | "bytesize" => Some(("format", "\"8E1\"")),
        "slave" | "slave_id" | "slaveid" | "station" | "node" | "node_id" => Some(("address", "1")),
        "device" | "tty" | "com" => Some(("port", "\"/dev/serial/by-id/…\"")),
        _ => None,
    }
}

/// The known word most similar to `word`, if it is close enough to be a misspelling, or is the only one that
/// contains its parts.
pub fn nearest<'a>(word: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    match candidates(word, known).as_slice() {
        [only] => Some(only),
        _ => None,
    }
}

/// The known words that `word` may stand for: the one it is a misspelling of, otherwise those that contain its
/// parts (`speed_ref` is part of `speed_reference`), the shortest first, at most four.
pub fn candidates<'a>(word: &str, known: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let known: Vec<&str> = known.collect();
    let mut best: Option<(usize, &str)> = None;
    for candidate in &known {
        let distance = strsim::damerau_levenshtein(word, candidate);
        let near = distance <= 1 + candidate.len() / 4;
        if near && best.is_none_or(|(least, _)| distance < least) {
            best = Some((distance, candidate));
        }
    }
    if let Some((_, candidate)) = best {
        return vec![candidate];
    }
    let mut having = known;
    having.retain(|candidate| has_parts(candidate, word));
    having.sort_by_key(|candidate| candidate.len());
    having.truncate(MOST_CANDIDATES);
    having
}

/// Maximum number of words that a message suggests.
const MOST_CANDIDATES: usize = 4;
/// Shortest part of a word that identifies it.
const LEAST_PART: usize = 3;

/// Whether each part of `word` begins a part of `candidate`.
fn has_parts(candidate: &str, word: &str) -> bool {
    let parts = |text: &str| -> Vec<String> { text.split(['-', '_', ' ']).map(str::to_lowercase).collect() };
    let (wanted, own) = (parts(word), parts(candidate));
    let begins = |part: &String| part.len() >= LEAST_PART && own.iter().any(|own| own.starts_with(part.as_str()));
    wanted.iter().all(begins)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_that_are_meant() {
        let points = [
            "speed_reference",
            "frequency_reference",
            "actual_speed",
            "motor_speed",
            "motor_current",
            "zero_speed",
        ];
        let near = |word: &str| nearest(word, points.into_iter());
        assert_eq!(near("motor_curent"), Some("motor_current"));
        assert_eq!(near("speed_ref"), Some("speed_reference"));
        assert_eq!(near("current"), Some("motor_current"));
        assert_eq!(
            (near("speed"), near("x"), near(""), near("of")),
            (None, None, None, None)
        );
        let several = candidates("speed", points.into_iter());
        assert_eq!(
            several,
            ["zero_speed", "motor_speed", "actual_speed", "speed_reference"]
        );
        let protocols = ["modbus-rtu", "modbus-ascii", "n2"];
        assert_eq!(nearest("rtu", protocols.into_iter()), Some("modbus-rtu"));
        assert_eq!(nearest("modbus", protocols.into_iter()), None);
        assert_eq!(nearest("Modbus RTU", protocols.into_iter()), Some("modbus-rtu"));
    }
}
