//! Differences between two parameter files. Pure.

use super::file::{Entry, Id, ParameterFile};
use drivegate_model::drive::parameters::RawValue;

/// A parameter with different values in two files.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// Id of the parameter.
    pub id: Id,
    /// Value before; `None` if the parameter was missing or not read.
    pub before: Option<RawValue>,
    /// Value after; `None` if the parameter was missing or not read.
    pub after: Option<RawValue>,
    /// The value before with its unit, for people.
    pub note_before: String,
    /// The value after with its unit, for people.
    pub note_after: String,
}

impl Difference {
    /// The difference as one line: `102: 5000 → 10000 (50.00 Hz, Maximum frequency → 100.00 Hz, Maximum frequency)`.
    pub fn line(&self) -> String {
        let value = |value: Option<RawValue>, note: &str| match value {
            None => "not there".to_string(),
            // The note begins with the value in its unit, if the unit is known.
            Some(value) => match note.split(", ").next().filter(|shown| begins_with_number(shown)) {
                Some(shown) => shown.to_string(),
                None => match value {
                    RawValue::Word(word) => word.to_string(),
                    RawValue::Float(bits) => f32::from_bits(bits).to_string(),
                },
            },
        };
        let note = if self.note_after.is_empty() {
            &self.note_before
        } else {
            &self.note_after
        };
        let name = match note.split_once(", ") {
            Some((shown, name)) if begins_with_number(shown) => name,
            _ if begins_with_number(note) => "",
            _ => note.as_str(),
        };
        let (before, after) = (
            value(self.before, &self.note_before),
            value(self.after, &self.note_after),
        );
        match name {
            "" => format!("{}: {before} → {after}", self.id),
            name => format!("{} {name}: {before} → {after}", self.id),
        }
    }
}

fn begins_with_number(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_digit() || c == '-')
}

/// The differences, by name. A parameter that one side could not read differs unless neither could.
pub fn differences(before: &ParameterFile, after: &ParameterFile) -> Vec<Difference> {
    let ids: std::collections::BTreeSet<&Id> = before.values.keys().chain(after.values.keys()).collect();
    let value = |entry: Option<&Entry>| entry.and_then(|entry| entry.value.clone().ok());
    let note = |entry: Option<&Entry>| entry.map_or(String::new(), |entry| entry.note.clone());
    let differing = ids.into_iter().filter_map(|id| {
        let (there, here) = (before.values.get(id), after.values.get(id));
        let (was, is) = (value(there), value(here));
        (was != is).then(|| Difference {
            id: id.clone(),
            before: was,
            after: is,
            note_before: note(there),
            note_after: note(here),
        })
    });
    differing.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(values: &[(&str, Option<u16>, &str)]) -> ParameterFile {
        let values = values.iter().map(|(id, value, note)| {
            let entry = Entry {
                value: value.map(RawValue::Word).ok_or_else(|| "no answer".to_string()),
                note: (*note).to_string(),
            };
            (Id::new(id), entry)
        });
        ParameterFile {
            values: values.collect(),
            ..ParameterFile::default()
        }
    }

    #[test]
    fn lines_tell_what_changed_in_its_unit() {
        let before = file(&[
            ("101", Some(0), "x"),
            ("102", Some(5000), "50.00 Hz, Maximum frequency"),
            ("7", Some(1), ""),
        ]);
        let after = file(&[
            ("101", Some(0), "other words are no difference"),
            ("102", Some(10_000), "100.00 Hz, Maximum frequency"),
            ("8", Some(3), "Mode"),
            ("7", None, ""),
        ]);
        let lines: Vec<String> = differences(&before, &after).iter().map(Difference::line).collect();
        assert_eq!(
            lines,
            [
                "7: 1 → not there",
                "8 Mode: not there → 3",
                "102 Maximum frequency: 50.00 Hz → 100.00 Hz",
            ]
        );
        assert_eq!(differences(&after, &after), []);
    }
}
