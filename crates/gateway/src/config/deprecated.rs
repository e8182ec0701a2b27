//! Deprecated keys, each with a warning that says what to write instead: keys that have
//! another name now, and durations beyond what a key allows now. Each for one minor version.

use std::ops::RangeInclusive;
use std::time::Duration;

use serde_json::Value;

use super::key::{Form, Time};
use crate::document::{Document, Reader, format_duration};

/// A key that has another name now.
pub(super) struct Renamed {
    /// The keys of the tables that lead to it; an array of tables counts once: `["bus", "drive"]`.
    pub(super) table: &'static [&'static str],
    /// Its name before.
    pub(super) old: &'static str,
    /// Its name now.
    pub(super) new: &'static str,
    /// The version that no longer takes the old name, such as `0.2`.
    pub(super) until: &'static str,
}

/// Every key that has another name now.
pub(super) const RENAMED: &[Renamed] = &[];

/// Gives renamed keys their present names. Where a table has both, the old one stays, and is reported as unknown.
pub(super) fn rename(document: &mut Document, renamed: &[Renamed]) {
    for key in renamed {
        let Renamed { table, old, new, until } = key;
        for place in document.rename(table, old, new) {
            let remedy = remedy(&format!("write `{new}`"), until);
            document.warning(&place, format!("`{old}` is called `{new}` now"), remedy);
        }
    }
}

fn remedy(instead: &str, until: &str) -> String {
    format!("{instead}; version {until} refuses it")
}

/// A duration of the range; a longer one, up to what was allowed before, counts as the longest of the range.
pub(super) struct Capped {
    pub(super) range: RangeInclusive<Duration>,
    /// What was allowed before.
    pub(super) before: Duration,
    /// Why no longer, after the value.
    pub(super) why: &'static str,
    /// The version that refuses it, such as `0.2`.
    pub(super) until: &'static str,
}

impl Capped {
    fn now(&self) -> Time {
        Time(self.range.clone())
    }
}

impl Form<Duration> for Capped {
    fn read(&self, reader: &Reader<'_>, key: &str) -> Option<Duration> {
        let value: Duration = reader.optional(key)?;
        let most = *self.range.end();
        if !(most..=self.before).contains(&value) || value == most {
            return reader.accept(key, self.now().check(value));
        }
        let [shown, used] = [value, most].map(format_duration);
        let what = format!("{shown} {}; {used} is used", self.why);
        reader.warning(key, what, remedy(&format!("write at most \"{used}\""), self.until));
        Some(most)
    }

    fn schema(&self) -> Value {
        self.now().schema()
    }

    fn range(&self) -> String {
        self.now().range()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: [Renamed; 2] = [
        Renamed {
            table: &["bus", "drive"],
            old: "slave",
            new: "address",
            until: "9.9",
        },
        Renamed {
            table: &["bus"],
            old: "device",
            new: "port",
            until: "9.9",
        },
    ];

    fn renamed(text: &str) -> (Vec<String>, Document) {
        let mut document = Document::parse("t.toml", text);
        rename(&mut document, &TABLE);
        let (errors, warnings) = document.clone().into_findings();
        assert_eq!(errors, []);
        (warnings.iter().map(ToString::to_string).collect(), document)
    }

    #[test]
    fn an_old_name_is_taken_with_a_warning_that_names_the_new_one() {
        let text = "[[bus]]\ndevice = \"a\"\n[[bus.drive]]\naddress = 1\n[[bus.drive]]\nslave = 2\n";
        let (warnings, document) = renamed(text);
        assert_eq!(
            warnings,
            [
                "`device` is called `port` now; t.toml:2, bus[0].device; write `port`; version 9.9 refuses it",
                "`slave` is called `address` now; t.toml:6, bus[0].drive[1].slave; write `address`; version 9.9 refuses it",
            ]
        );
        let reader = document.reader();
        let bus = &reader.tables("bus")[0];
        assert_eq!(bus.optional::<String>("port"), Some("a".to_string()));
        let drives = bus.tables("drive");
        let address = |drive: &Reader<'_>| drive.optional::<i64>("address");
        assert_eq!(drives.iter().map(address).collect::<Vec<_>>(), [Some(1), Some(2)]);
        bus.finish();
        drives.iter().for_each(Reader::finish);
    }

    #[test]
    fn of_two_names_in_one_table_the_old_one_is_unknown() {
        let (warnings, document) = renamed("[[bus]]\ndevice = \"a\"\nport = \"b\"\n[bus.other]\nslave = 1\n");
        assert!(warnings.is_empty());
        let reader = document.reader();
        let bus = &reader.tables("bus")[0];
        assert_eq!(bus.optional::<String>("port"), Some("b".to_string()));
        assert_eq!(bus.keys(), ["device", "port", "other"]);
    }

    #[test]
    fn nothing_is_taken_longer_than_was_promised() {
        let number = |text: &str| -> (u32, u32) {
            let mut parts = text.split('.').map(|part| part.parse().unwrap());
            (parts.next().unwrap(), parts.next().unwrap())
        };
        let this = number(env!("CARGO_PKG_VERSION"));
        let names = RENAMED.iter().map(|key| key.until);
        for until in names.chain([super::super::keys::RESPONSE_TIMEOUT.until]) {
            assert!(
                this < number(until),
                "remove from config/deprecated.rs and keys.rs what ends with {until}"
            );
        }
    }
}
