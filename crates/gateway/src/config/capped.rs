//! A duration whose upper limit was lowered: for one minor version a longer one is accepted with a warning.

use std::ops::RangeInclusive;
use std::time::Duration;

use serde_json::Value;

use super::key::{Form, Time};
use drivegate_model::document::{Reader, format_duration};

/// A duration within a range. A longer duration that earlier versions allowed counts as the longest of the range.
pub(super) struct Capped {
    pub(super) range: RangeInclusive<Duration>,
    /// Largest value that an earlier version allowed.
    pub(super) before: Duration,
    /// The reason for the limit, as text that follows the value.
    pub(super) why: &'static str,
    /// The version that will refuse the key, such as `0.2`.
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
        reader.warning(
            key,
            what,
            format!("write at most \"{used}\"; version {} refuses it", self.until),
        );
        Some(most)
    }

    fn schema(&self) -> Value {
        self.now().schema()
    }

    fn range(&self) -> String {
        self.now().range()
    }
}
