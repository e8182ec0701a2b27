//! A key of the configuration: its name, form, default and meaning. The loader uses it, and the JSON Schema and the
//! tables of `docs/configuration.md` are generated from it.

use std::ops::RangeInclusive;
use std::time::Duration;

use serde_json::{Map, Value, json};

use super::values::{self, NAME_LENGTH};
use drivegate_model::document::{Document, Finding, FromNode, Place, Reader, ValueError, format_duration, parse_size};
use drivegate_proto::Protocol;

/// Pattern of a duration, a number and a unit, as [`drivegate_model::document::parse_duration`] reads it.
pub(super) const DURATION: &str = r"^\s*(\d+\.?\d*|\.\d+)\s*(us|µs|ms|s|min|m|h)\s*$";
/// Pattern of a size, as [`drivegate_model::document::parse_size`] reads it.
const SIZE: &str = r"^\s*\d+\s*(B|KiB|MiB|GiB)\s*$";

/// A key whose value is a `T`.
pub(super) struct Key<T: 'static> {
    pub(super) name: &'static str,
    pub(super) form: &'static dyn Form<T>,
    pub(super) default: Preset,
    /// A sentence or several, in the Markdown of the documentation.
    pub(super) meaning: &'static str,
}

/// The value that an absent key has.
pub(super) enum Preset {
    /// The key is required, so it has no default.
    Required,
    /// A fixed default value, in notation that is both TOML and JSON.
    Value(&'static str),
    /// A default value for a bus of this protocol, in notation that is both TOML and JSON.
    ByProtocol(fn(Protocol) -> String),
    /// The loader decides the default; described as text.
    Words(&'static str),
}

/// The form in which a value is written.
pub(super) trait Form<T> {
    /// The value of `key`, which is present; an invalid one is reported.
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<T>;

    /// JSON Schema of the value, without description and default.
    fn schema(&self) -> Value;

    /// Values that may be written, for messages and the documentation.
    fn range(&self) -> String;
}

impl<T> Key<T> {
    /// The value, or the default if the key is absent. `None` also if the value is invalid; the problem is reported.
    pub(super) fn read(&self, reader: &Reader<'_>) -> Option<T> {
        if reader.has(self.name) {
            return self.form.read(reader, self.name);
        }
        if matches!(self.default, Preset::Required) {
            let what = format!("`{}` is missing", self.name);
            reader.problem(self.name, what, format!("write {}", self.form.range()));
        }
        self.read_default()
    }

    /// The default value, if the key has one.
    pub(super) fn read_default(&self) -> Option<T> {
        match self.default {
            Preset::Value(text) => self.read_text(text),
            _ => None,
        }
    }

    fn read_text(&self, text: &str) -> Option<T> {
        let document = Document::parse("default", &format!("{} = {text}", self.name));
        self.form.read(&document.reader(), self.name)
    }

    /// The value of a key whose default depends on the protocol of the bus; `None` if the value is invalid, which is reported.
    pub(super) fn read_on(&self, reader: &Reader<'_>, protocol: Protocol) -> Option<T> {
        match self.default {
            Preset::ByProtocol(default) if !reader.has(self.name) => self.read_text(&default(protocol)),
            _ => self.read(reader),
        }
    }

    /// The value, or the default if the value is invalid.
    pub(super) fn get_on(&self, reader: &Reader<'_>, protocol: Protocol) -> T
    where
        T: Default,
    {
        let default = || match self.default {
            Preset::ByProtocol(default) => self.read_text(&default(protocol)),
            _ => self.read_default(),
        };
        self.read_on(reader, protocol).or_else(default).unwrap_or_default()
    }

    /// The value of a key with a default. The default also replaces an invalid value.
    pub(super) fn get(&self, reader: &Reader<'_>) -> T
    where
        T: Default,
    {
        self.read(reader).or_else(|| self.read_default()).unwrap_or_default()
    }

    /// The value if the key is present and valid, whatever the default.
    pub(super) fn written(&self, reader: &Reader<'_>) -> Option<T> {
        reader.has(self.name).then(|| self.form.read(reader, self.name))?
    }

    /// Place of the key in the file, or of its table if the key is absent.
    pub(super) fn place(&self, reader: &Reader<'_>) -> Place {
        reader.place_of(self.name)
    }

    /// The value of a key without default, with its place in the file.
    pub(super) fn placed(&self, reader: &Reader<'_>) -> Option<(T, Place)> {
        Some((self.read(reader)?, self.place(reader)))
    }

    pub(super) fn schema(&self) -> Value {
        let mut schema = self.form.schema();
        if let Value::Object(schema) = &mut schema {
            let mut description = plain(self.meaning);
            match self.default {
                Preset::Required => {}
                Preset::Value(text) => {
                    schema.insert("default".into(), serde_json::from_str(text).unwrap_or_default());
                }
                Preset::ByProtocol(default) => description += &format!(" Default: {}.", by_protocol(default)),
                Preset::Words(text) => description += &format!(" Default: {text}."),
            }
            schema.insert("description".into(), description.into());
        }
        schema
    }

    /// Key, default, range and meaning, for the documentation.
    #[cfg(test)]
    pub(super) fn row(&self) -> [String; 4] {
        let default = match self.default {
            Preset::Required => "required".to_string(),
            Preset::Value(text) => format!("`{text}`"),
            Preset::ByProtocol(default) => by_protocol(default),
            Preset::Words(text) => text.to_string(),
        };
        let range = match self.form.range() {
            code if code.starts_with(['[', '{']) => format!("`{code}`"),
            text => text,
        };
        [
            format!("`{}`", self.name),
            default,
            range,
            self.meaning.trim().to_string(),
        ]
    }
}

/// A default that depends on the protocol, as text: the value for Modbus RTU, then the ones that differ.
fn by_protocol(default: fn(Protocol) -> String) -> String {
    let usual = default(Protocol::ModbusRtu);
    let mut text = format!("`{usual}`");
    for (protocol, name) in [(Protocol::ModbusAscii, "Modbus ASCII"), (Protocol::N2, "N2")] {
        let own = default(protocol);
        if own != usual {
            text += &format!("; {name}: `{own}`");
        }
    }
    text
}

/// The name of a key whose field is a keyword of Rust is written as `r#name`.
pub(super) const fn key_name(field: &'static str) -> &'static str {
    match field.as_bytes() {
        [b'r', b'#', ..] => field.split_at(2).1,
        _ => field,
    }
}

/// Markdown text without link targets.
pub(super) fn plain(text: &str) -> String {
    let mut plain = String::new();
    let mut rest = text.trim();
    while let Some((before, after)) = rest.split_once("](") {
        let (before, label) = before.rsplit_once('[').unwrap_or((before, ""));
        plain += &format!("{before}{label}");
        rest = after.split_once(')').map_or("", |(_, rest)| rest);
    }
    plain + rest
}

/// The schema of a table: its description, and for each key its name, whether it is required, and its schema.
pub(super) fn table(about: &str, keys: Vec<(&'static str, bool, Value)>) -> Value {
    let required: Vec<&str> = keys
        .iter()
        .filter(|(_, required, _)| *required)
        .map(|(k, ..)| *k)
        .collect();
    let properties: Map<String, Value> = keys
        .into_iter()
        .map(|(key, _, value)| (key.to_string(), value))
        .collect();
    json!({
        "type": "object",
        "description": plain(about),
        "properties": properties,
        "required": required,
        "additionalProperties": false,
    })
}

/// A name that can be part of topics, labels and addresses; the given characters are allowed in addition to letters
/// and digits.
pub(super) struct Name(pub(super) &'static str);

impl Form<String> for Name {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<String> {
        reader.parsed(key, |text| values::check_name(text, self.0).map(|()| text.to_string()))
    }

    fn schema(&self) -> Value {
        // In a character class of a pattern, a hyphen stands for itself if it is last.
        let joints: String = self.0.chars().rev().collect();
        json!({ "type": "string", "pattern": format!("^[a-z0-9][a-z0-9{joints}]{{0,{}}}$", NAME_LENGTH - 1) })
    }

    fn range(&self) -> String {
        "a name in quotes".to_string()
    }
}

/// Any string that matches the pattern; the loader checks the rest. The second text says what to write.
pub(super) struct Text(pub(super) &'static str, pub(super) &'static str);

impl<T: FromNode> Form<T> for Text {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<T> {
        reader.optional(key)
    }

    fn schema(&self) -> Value {
        match self.0 {
            "" => json!({ "type": "string" }),
            pattern => json!({ "type": "string", "pattern": pattern }),
        }
    }

    fn range(&self) -> String {
        self.1.to_string()
    }
}

/// A string that is parsed; any of `words`, or what `pattern` matches.
pub(super) struct Parsed<T> {
    pub(super) parse: fn(&str) -> Result<T, Finding>,
    pub(super) words: &'static [&'static str],
    pub(super) pattern: &'static str,
    pub(super) range: &'static str,
}

impl<T> Form<T> for Parsed<T> {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<T> {
        let text: String = of_type(reader, key, &format!("{}, in quotes", self.range))?;
        reader.accept(key, (self.parse)(&text))
    }

    fn schema(&self) -> Value {
        let text: Value = Form::<String>::schema(&Text(self.pattern, ""));
        match self.words {
            [] => text,
            words => json!({ "anyOf": [{ "enum": words }, text] }),
        }
    }

    fn range(&self) -> String {
        self.range.to_string()
    }
}

/// The value of a key whose range is more specific than its type, so that the message for a wrong type shows the range.
fn of_type<T: FromNode>(reader: &Reader<'_>, key: &str, range: &str) -> Option<T> {
    let value = T::from_node(reader.raw(key)?);
    reader.accept(
        key,
        value.map_err(|error| match error {
            // A range without an example or words is less specific than the type.
            ValueError::Type(..) | ValueError::NotAList(..) if range.contains(['[', ',', '"']) => {
                Finding::new(error.to_string(), format!("write {range}"))
            }
            error => error.into(),
        }),
    )
}

/// A key that is true or false.
pub(super) struct Flag;

impl Form<bool> for Flag {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<bool> {
        reader.optional(key)
    }

    fn schema(&self) -> Value {
        json!({ "type": "boolean" })
    }

    fn range(&self) -> String {
        bool::WANTED.to_string()
    }
}

/// A key that is a number.
pub(super) struct Figure;

impl Form<f64> for Figure {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<f64> {
        reader.optional(key)
    }

    fn schema(&self) -> Value {
        json!({ "type": "number" })
    }

    fn range(&self) -> String {
        "a number".to_string()
    }
}

/// A whole number in the range; one number outside it may have its own message.
pub(super) struct Number(pub(super) RangeInclusive<i64>, pub(super) Option<(i64, &'static str)>);

impl<T: TryFrom<i64>> Form<T> for Number {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<T> {
        let value: i64 = reader.optional(key)?;
        let fitting = T::try_from(value).ok().filter(|_| self.0.contains(&value));
        if fitting.is_none() {
            let what = match self.1 {
                Some((special, what)) if special == value => what.to_string(),
                _ => format!("{value} is out of range"),
            };
            reader.problem(key, what, format!("write {}", Form::<T>::range(self)));
        }
        fitting
    }

    fn schema(&self) -> Value {
        json!({ "type": "integer", "minimum": self.0.start(), "maximum": self.0.end() })
    }

    fn range(&self) -> String {
        format!("{} to {}", self.0.start(), self.0.end())
    }
}

/// A duration within the range.
pub(super) struct Time(pub(super) RangeInclusive<Duration>);

impl Time {
    /// Whether `value` is within the range.
    pub(super) fn check(&self, value: Duration) -> Result<Duration, Finding> {
        if self.0.contains(&value) {
            return Ok(value);
        }
        let what = format!("{} is out of range", format_duration(value));
        Err(Finding::new(what, format!("write {}", self.range())))
    }
}

impl Form<Duration> for Time {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<Duration> {
        let value = reader.optional(key)?;
        reader.accept(key, self.check(value))
    }

    fn schema(&self) -> Value {
        json!({ "type": "string", "pattern": DURATION })
    }

    fn range(&self) -> String {
        let [least, most] = [self.0.start(), self.0.end()].map(|time| format_duration(*time));
        format!("\"{least}\" to \"{most}\"")
    }
}

/// A size in bytes within the range.
pub(super) struct Size(pub(super) RangeInclusive<u64>);

impl Form<u64> for Size {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<u64> {
        let text: String = of_type(reader, key, &format!("{}, in quotes", self.range()))?;
        let size = parse_size(&text).map_err(Finding::from).and_then(|bytes| {
            if self.0.contains(&bytes) {
                Ok(bytes)
            } else {
                Err(Finding::new(
                    format!("{text} is out of range"),
                    format!("write {}", self.range()),
                ))
            }
        });
        reader.accept(key, size)
    }

    fn schema(&self) -> Value {
        json!({ "type": "string", "pattern": SIZE })
    }

    fn range(&self) -> String {
        let shown = |bytes: u64| {
            let units = [(30, "GiB"), (20, "MiB"), (10, "KiB")];
            let unit = units.into_iter().find(|(shift, _)| bytes >> shift > 0);
            unit.map_or_else(
                || format!("{bytes}B"),
                |(shift, unit)| format!("{}{unit}", bytes >> shift),
            )
        };
        format!("\"{}\" to \"{}\"", shown(*self.0.start()), shown(*self.0.end()))
    }
}

/// One of several words, each with the value it stands for.
pub(super) struct Words<T: 'static>(pub(super) &'static [(&'static str, T)]);

impl<T: Clone> Words<T> {
    pub(super) fn find(&self, text: &str) -> Result<T, Finding> {
        let known = self.0.iter().find(|(word, _)| *word == text);
        known
            .map(|(_, value)| value.clone())
            .ok_or_else(|| values::unknown_word(text, self.words()))
    }

    fn words(&self) -> impl Iterator<Item = &'static str> + Clone {
        self.0.iter().map(|(word, _)| *word)
    }
}

impl<T: Clone> Form<T> for Words<T> {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<T> {
        let text: String = of_type(reader, key, &values::any_of(self.words()))?;
        reader.accept(key, self.find(&text))
    }

    fn schema(&self) -> Value {
        json!({ "enum": self.words().collect::<Vec<_>>() })
    }

    fn range(&self) -> String {
        values::any_of(self.words())
    }
}

/// A list of strings, each parsed; every bad item is a problem.
pub(super) struct List<T> {
    pub(super) parse: fn(&str) -> Result<T, Finding>,
    /// Remedy for an empty list; `None` if the list may be empty.
    pub(super) empty: Option<&'static str>,
    pub(super) range: &'static str,
}

impl<T> Form<Vec<T>> for List<T> {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<Vec<T>> {
        let items: Vec<String> = of_type(reader, key, self.range)?;
        if let (true, Some(remedy)) = (items.is_empty(), self.empty) {
            reader.problem(key, "the list is empty", remedy);
        }
        let parsed = items.iter().map(|item| reader.accept(key, (self.parse)(item)));
        Some(parsed.flatten().collect())
    }

    fn schema(&self) -> Value {
        let mut schema = json!({ "type": "array", "items": { "type": "string" } });
        if let (Value::Object(schema), Some(_)) = (&mut schema, self.empty) {
            schema.insert("minItems".into(), 1.into());
        }
        schema
    }

    fn range(&self) -> String {
        self.range.to_string()
    }
}

/// A value that the loader reads itself, with the reader of the key.
pub(super) struct Own {
    pub(super) schema: fn() -> Value,
    pub(super) range: &'static str,
}

/// Whether a key of the form [`Own`] is present.
pub(super) struct Present;

impl Form<Present> for Own {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<Present> {
        reader.has(key).then_some(Present)
    }

    fn schema(&self) -> Value {
        (self.schema)()
    }

    fn range(&self) -> String {
        self.range.to_string()
    }
}

impl Key<Present> {
    /// The reader of the key's table.
    pub(super) fn table<'d>(&self, reader: &Reader<'d>) -> Option<Reader<'d>> {
        reader.table(self.name)
    }

    /// The readers of the list of tables.
    pub(super) fn tables<'d>(&self, reader: &Reader<'d>) -> Vec<Reader<'d>> {
        reader.tables(self.name)
    }
}
