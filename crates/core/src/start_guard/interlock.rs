//! Whether the points hold that a start needs. Pure.

use std::fmt;
use std::time::Instant;

use super::Interlock;
use super::ledger::Around;
use crate::drive::{Quality, Sample, Value};

/// An interlock that does not hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unmet {
    drive: String,
    point: String,
    is: bool,
    /// The actual state of the point.
    but: String,
    was_read: bool,
    /// When its last value was read, if that met the interlock, and is only too old.
    met_last: Option<Instant>,
}

impl Unmet {
    /// Whether the point was read since the gateway started.
    pub fn was_read(&self) -> bool {
        self.was_read
    }

    /// When its last value was read, if that met the interlock and is only too old now.
    pub fn met_last(&self) -> Option<Instant> {
        self.met_last
    }
}

impl fmt::Display for Unmet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Unmet {
            drive, point, is, but, ..
        } = self;
        write!(f, "`{point}` of {drive} must be {is}, but {but}")
    }
}

impl Interlock {
    /// Returns it if not satisfied. Only a good sample satisfies it.
    pub(super) fn unmet(&self, around: &Around, now: Instant) -> Option<Unmet> {
        let (but, sample) = self.differs(around, now)?;
        let last = sample.filter(|sample| sample.quality == Quality::Stale && sample.at.is_some());
        let met = last.filter(|sample| sample.value.is_some_and(|value| value.as_bool() == self.is));
        Some(Unmet {
            // There is nothing to be read where there is no such drive or point.
            was_read: sample.is_none_or(|sample| sample.at.is_some()),
            met_last: met.and_then(|sample| sample.at),
            drive: self.drive.clone(),
            point: self.point.clone(),
            is: self.is,
            but,
        })
    }

    /// The actual state of the point if the interlock is not satisfied, and its sample if there is one.
    fn differs(&self, around: &Around, now: Instant) -> Option<(String, Option<Sample>)> {
        let Some(image) = around.images.get(&self.drive) else {
            return Some(("there is no such drive".to_string(), None));
        };
        let Some(index) = image.spec.profile.point_index(&self.point) else {
            return Some(("the drive has no such point".to_string(), None));
        };
        let reading = image.reading(now, around.stale_after);
        let sample = reading.sample(index);
        let age = || {
            sample
                .at
                .map_or(0.0, |at| now.saturating_duration_since(at).as_secs_f64())
        };
        let but = match sample.good().map(Value::as_bool) {
            Some(is) if is == self.is => return None,
            Some(is) => format!("is {is}"),
            None if !reading.snapshot.link.is_online() => "is unknown: the drive is offline".to_string(),
            None if sample.at.is_none() => "was never read".to_string(),
            None if sample.quality == Quality::Stale => format!("is stale: read {:.1} s ago", age()),
            None => "is unknown: its value is bad".to_string(),
        };
        Some((but, Some(sample)))
    }
}
