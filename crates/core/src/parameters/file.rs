//! A file of parameters: text that people can read and version control can compare, without any loss of data.
//!
//! ```text
//! # drivegate parameters 1
//! drive: pump-1
//! family: vacon-nx
//! identification: none
//! application: 30 parameters, 9f86d081
//! time: 2026-03-02T07:40:12Z
//! checksum: 5e884898da28047151d0e56f8dc62927
//!
//! 101 = 0      # 0.00 Hz, Minimum frequency
//! 102 = 5000   # 50.00 Hz, Maximum frequency
//! 117 = ?      # not read: the drive refused it with exception 03
//! ```
//!
//! Text after `#` is kept as text. A value without a decimal point is a register, one with a decimal point an N2
//! analog output.

use std::collections::BTreeMap;
use std::fmt::{self, Write as _};

use ring::digest::{SHA256, digest};

use crate::hex;
use drivegate_model::drive::parameters::RawValue;

/// The first line of every file.
const HEAD: &str = "# drivegate parameters 1";
/// Largest file that is read, bytes.
pub(super) const MOST_BYTES: u64 = 4 * 1024 * 1024;
/// Bytes of the checksum that are written.
pub(super) const CHECKSUM: usize = 16;

/// The name of a parameter; sorted as people count: 2 before 10.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Id(String);

impl Id {
    pub fn new(name: &str) -> Id {
        Id(name.to_string())
    }

    pub fn name(&self) -> &str {
        &self.0
    }

    fn parts(&self) -> Vec<(String, u64)> {
        let mut parts: Vec<(String, u64)> = Vec::new();
        let mut in_number = true;
        for character in self.0.chars() {
            let digit = character.to_digit(10).map(u64::from);
            if in_number && digit.is_none() || parts.is_empty() {
                parts.push((String::new(), 0));
            }
            in_number = digit.is_some();
            if let Some((text, number)) = parts.last_mut() {
                match digit {
                    Some(digit) => *number = number.saturating_mul(10).saturating_add(digit),
                    None => text.push(character),
                }
            }
        }
        parts
    }
}

impl Ord for Id {
    fn cmp(&self, other: &Id) -> std::cmp::Ordering {
        (self.parts(), &self.0).cmp(&(other.parts(), &other.0))
    }
}

impl PartialOrd for Id {
    fn partial_cmp(&self, other: &Id) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl fmt::Display for Id {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The entry of a parameter in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// Value of the parameter, or why it was not read.
    pub value: Result<RawValue, String>,
    /// Text with the value in its unit and the name of the parameter.
    pub note: String,
}

/// The parameters of a drive.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ParameterFile {
    /// Name of the drive.
    pub drive: String,
    /// Name of the drive's profile.
    pub family: String,
    /// The drive's identification.
    pub identification: String,
    /// When the parameters were read, RFC 3339.
    pub time: String,
    /// The counters of the line that the drive itself keeps; empty if its family has none.
    pub counters: String,
    /// Values by parameter.
    pub values: BTreeMap<Id, Entry>,
}

/// Reason why a text is not a file of parameters.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FileError {
    /// The text is not a parameter file.
    #[error("it is not a parameter file: its first line is not `{HEAD}`")]
    Other,
    /// The line with this number is not valid.
    #[error("line {0}: {1}")]
    Line(usize, String),
    /// Values were changed by hand, or the file is damaged.
    #[error("its values do not match its checksum: it was edited, or is damaged")]
    Checksum,
}

impl ParameterFile {
    /// The application as far as it can be identified: number of parameters, and a mark of the set.
    pub fn application(&self) -> String {
        let ids: String = self.values.keys().map(|id| format!("{id}\n")).collect();
        let mark = digest_of(&ids, 4);
        format!("{} parameters, {mark}", self.values.len())
    }

    /// The checksum of names and values; the notes are not part of it.
    pub fn checksum(&self) -> String {
        let mut text = format!("{}\n", self.family);
        for (id, entry) in &self.values {
            // Writing to a string does not fail.
            let _ = writeln!(text, "{id}={}", shown(&entry.value));
        }
        digest_of(&text, CHECKSUM)
    }

    /// Number of parameters that were not read.
    pub fn missing(&self) -> usize {
        self.values.values().filter(|entry| entry.value.is_err()).count()
    }

    /// The values that were read.
    pub fn read_values(&self) -> impl Iterator<Item = (&Id, RawValue)> {
        let of = |(id, entry): (&'_ Id, &'_ Entry)| -> Option<RawValue> {
            let _ = id;
            entry.value.as_ref().ok().copied()
        };
        self.values
            .iter()
            .filter_map(move |(id, entry)| Some((id, of((id, entry))?)))
    }

    /// The text of the file.
    pub fn text(&self) -> String {
        let width = self
            .values
            .keys()
            .map(|id| id.name().chars().count())
            .max()
            .unwrap_or(0);
        let mut text = format!(
            "{HEAD}\ndrive: {}\nfamily: {}\nidentification: {}\napplication: {}\ntime: {}\nchecksum: {}\n",
            self.drive,
            self.family,
            self.identification,
            self.application(),
            self.time,
            self.checksum()
        );
        if !self.counters.is_empty() {
            let _ = writeln!(text, "counters: {}", one_line(&self.counters));
        }
        text.push('\n');
        for (id, entry) in &self.values {
            let (id, value) = (id.name(), shown(&entry.value));
            let note = match &entry.value {
                Ok(_) => entry.note.clone(),
                Err(why) if entry.note.is_empty() => format!("not read: {why}"),
                Err(why) => format!("not read: {why}; {}", entry.note),
            };
            let line = format!("{id:width$} = {value:<6} # {}", one_line(&note));
            // Without a note the line ends after the value.
            let _ = writeln!(text, "{}", line.trim_end_matches(" # ").trim_end());
        }
        text
    }

    /// Reads a file; `checked` whether its checksum fits.
    ///
    /// # Errors
    /// If the text is not a parameter file: contains the fault and its line.
    pub fn parse(text: &str) -> Result<ParameterFile, FileError> {
        let mut lines = (1..).zip(text.lines());
        if lines.next().is_none_or(|(_, line)| line.trim_end() != HEAD) {
            return Err(FileError::Other);
        }
        let mut file = ParameterFile::default();
        let mut checksum = String::new();
        for (number, line) in lines {
            // A terminal is to show nothing but text.
            let line = one_line(line);
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let wrong = |what: String| FileError::Line(number, what);
            if let Some((id, rest)) = line.split_once('=') {
                let (value, note) = rest.split_once('#').unwrap_or((rest, ""));
                let id = Id::new(id.trim());
                let entry = entry(value.trim(), note.trim())
                    .ok_or_else(|| wrong(format!("`{}` is not a value; write 0 to 65535", value.trim())))?;
                if file.values.insert(id.clone(), entry).is_some() {
                    return Err(wrong(format!("`{id}` appears twice")));
                }
            } else if let Some((key, value)) = line.split_once(':') {
                let value = value.trim().to_string();
                match key.trim() {
                    "drive" => file.drive = value,
                    "family" => file.family = value,
                    "identification" => file.identification = value,
                    "time" => file.time = value,
                    "counters" => file.counters = value,
                    "checksum" => checksum = value,
                    "application" => {}
                    other => return Err(wrong(format!("unknown key `{other}`"))),
                }
            } else {
                return Err(wrong("neither `key: value` nor `parameter = value`".to_string()));
            }
        }
        if checksum != file.checksum() {
            return Err(FileError::Checksum);
        }
        Ok(file)
    }
}

/// The value as in a file: a value without a decimal point is a register.
fn shown(value: &Result<RawValue, String>) -> String {
    value.as_ref().map_or_else(|_| "?".to_string(), |value| text_of(*value))
}

/// A value as it is written to a file: a value without a decimal point is a register.
pub(super) fn text_of(value: RawValue) -> String {
    match value {
        RawValue::Word(word) => word.to_string(),
        RawValue::Float(bits) => format!("{:?}", f32::from_bits(bits)),
    }
}

/// The value in a text written by [`text_of`].
pub(super) fn value_of(text: &str) -> Option<RawValue> {
    match text.parse::<u16>() {
        Ok(word) => Some(RawValue::Word(word)),
        Err(_) if text.bytes().all(|byte| byte.is_ascii_digit()) => None,
        Err(_) => {
            let value = text.parse::<f32>().ok().filter(|value| value.is_finite())?;
            Some(RawValue::Float(value.to_bits()))
        }
    }
}

fn entry(value: &str, note: &str) -> Option<Entry> {
    if value == "?" {
        let (why, note) = note
            .strip_prefix("not read: ")
            .unwrap_or(note)
            .split_once("; ")
            .unwrap_or((note, ""));
        let why = why.strip_prefix("not read: ").unwrap_or(why);
        return Some(Entry {
            value: Err(why.to_string()),
            note: note.to_string(),
        });
    }
    let value = value_of(value)?;
    Some(Entry {
        value: Ok(value),
        note: note.to_string(),
    })
}

pub(super) fn one_line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// The first bytes of the SHA-256 of a text.
pub(super) fn digest_of(text: &str, count: usize) -> String {
    let digest = digest(&SHA256, text.as_bytes());
    hex::encode(digest.as_ref().get(..count).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn file(values: &[(&str, Result<RawValue, String>, &str)]) -> ParameterFile {
        let values = values.iter().map(|(id, value, note)| {
            let entry = Entry {
                value: value.clone(),
                note: (*note).to_string(),
            };
            (Id::new(id), entry)
        });
        ParameterFile {
            drive: "pump-1".to_string(),
            family: "vacon-nx".to_string(),
            identification: "none".to_string(),
            time: "2026-03-02T07:40:12Z".to_string(),
            counters: "812 messages received, 3 damaged ones".to_string(),
            values: values.collect(),
        }
    }

    #[test]
    fn people_and_version_control_can_read_it() {
        let refused = Err("the drive refused it with exception 03".to_string());
        let file = file(&[
            ("1.10", Ok(RawValue::Word(7)), ""),
            ("1.2", Ok(RawValue::Word(5000)), "50.00 Hz, Maximum frequency"),
            ("1.3", refused, "Acceleration time"),
        ]);
        let text = file.text();
        let values: Vec<&str> = text.lines().skip(9).collect();
        assert_eq!(
            values,
            [
                "1.2  = 5000   # 50.00 Hz, Maximum frequency",
                "1.3  = ?      # not read: the drive refused it with exception 03; Acceleration time",
                "1.10 = 7",
            ]
        );
        assert_eq!(ParameterFile::parse(&text), Ok(file.clone()));
        // A change is one line, apart from time and checksum.
        let edited = text.replace("= 5000", "= 5001");
        assert_eq!(ParameterFile::parse(&edited), Err(FileError::Checksum));
        let commented = text.replace("Maximum frequency", "Fmax");
        assert!(
            ParameterFile::parse(&commented).is_ok(),
            "what is for people may be edited"
        );
    }

    #[test]
    fn what_is_wrong_is_told_with_its_line() {
        assert_eq!(ParameterFile::parse("102 = 5000"), Err(FileError::Other));
        let line = |line: &str| {
            ParameterFile::parse(&format!("{HEAD}\n{line}\n"))
                .unwrap_err()
                .to_string()
        };
        assert!(line("102 = 70000").starts_with("line 2: `70000` is not a value"));
        assert!(line("102 = NaN").starts_with("line 2"));
        assert!(line("a = 1\na = 2").contains("line 3: `a` appears twice"));
        assert!(line("colour: red").contains("unknown key `colour`"));
    }

    #[test]
    fn names_are_sorted_as_people_count() {
        let mut ids = ["10.1", "2.10", "2.9", "Sn-10", "Cn-02", "AO 10", "AO 9", "1999", "101"].map(Id::new);
        ids.sort();
        let names: Vec<&str> = ids.iter().map(Id::name).collect();
        assert_eq!(
            names,
            ["2.9", "2.10", "10.1", "101", "1999", "AO 9", "AO 10", "Cn-02", "Sn-10"]
        );
    }

    proptest! {
        #[test]
        fn nothing_is_lost(
            words in proptest::collection::btree_map(1u16..2000, any::<u16>(), 0..50),
            floats in proptest::collection::btree_map(1u8..30, any::<f32>(), 0..10),
        ) {
            let mut all = file(&[]);
            let mut add = |id: String, value| all.values.insert(
                Id::new(&id),
                Entry { value: Ok(value), note: String::new() },
            );
            for (id, word) in words {
                add(id.to_string(), RawValue::Word(word));
            }
            for (id, float) in floats.into_iter().filter(|(_, float)| float.is_finite()) {
                add(format!("AO {id}"), RawValue::Float(float.to_bits()));
            }
            prop_assert_eq!(ParameterFile::parse(&all.text()), Ok(all));
        }

        #[test]
        fn no_text_is_too_odd(text in "\\PC*", line in "\\PC*") {
            let _ = ParameterFile::parse(&text);
            let _ = ParameterFile::parse(&format!("{HEAD}\n{line}\n"));
        }
    }
}
