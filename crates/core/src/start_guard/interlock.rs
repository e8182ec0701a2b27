//! Whether the points hold that a start needs. Pure.

use std::fmt;
use std::time::Instant;

use super::Interlock;
use super::drives_by_name::{DrivesByName, Watched};
use drivegate_model::drive::{PointIndex, Quality, Value};

/// An interlock that does not hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unmet {
    drive: String,
    point: String,
    is: bool,
    /// The actual state of the point.
    but: String,
}

impl fmt::Display for Unmet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Unmet { drive, point, is, but } = self;
        write!(f, "`{point}` of {drive} must be {is}, but {but}")
    }
}

impl Interlock {
    /// The interlock if it forbids a start. Only a good sample satisfies an interlock.
    pub(super) fn unmet(&self, around: &DrivesByName, now: Instant) -> Option<Unmet> {
        self.of(around, |watched, index| self.differs(watched, index, around, now))
    }

    /// The interlock if it requires a running motor to stop. A drive whose bus was restarted keeps its earlier
    /// state until it is read. `stood` is the end of the last pause of the bus: a value that was satisfied and has
    /// only become too old then waits for a first reading.
    pub(super) fn trips(&self, around: &DrivesByName, stood: Option<Instant>, now: Instant) -> Option<Unmet> {
        self.of(around, |watched, index| {
            let is_only_old = stood.is_some_and(|until| self.met_before(watched, index, around, (until, now)));
            if is_only_old {
                None
            } else {
                self.differed(watched, index, around, (now, now))
            }
        })
    }

    /// Whether the last value was read before `until`, met the interlock, and is only too old now.
    fn met_before(
        &self,
        watched: &Watched,
        index: PointIndex,
        around: &DrivesByName,
        (until, now): (Instant, Instant),
    ) -> bool {
        let sample = watched.image.reading(now, around.stale_after).sample(index);
        let met = sample.value.is_some_and(|value| value.as_bool() == self.is);
        met && sample.quality == Quality::Stale && sample.at.is_some_and(|at| at <= until)
    }

    fn of(&self, around: &DrivesByName, differs: impl Fn(&Watched, PointIndex) -> Option<String>) -> Option<Unmet> {
        let but = match around.drive(&self.drive) {
            None => Some("there is no such drive".to_string()),
            Some(watched) => match watched.image.spec.profile.point_index(&self.point) {
                None => Some("the drive has no such point".to_string()),
                Some(index) => differs(watched, index),
            },
        };
        Some(Unmet {
            drive: self.drive.clone(),
            point: self.point.clone(),
            is: self.is,
            but: but?,
        })
    }

    /// The state of the point at `at` if the interlock was not satisfied then.
    fn differed(
        &self,
        watched: &Watched,
        index: PointIndex,
        around: &DrivesByName,
        (at, now): (Instant, Instant),
    ) -> Option<String> {
        let Some(anew) = watched.anew(now) else {
            return self.differs(watched, index, around, at);
        };
        let read = watched.image.reading(at, around.stale_after).sample(index).at;
        // The last value read by a bus that ends may grow old while the next one starts.
        if !watched.is_leaving() && read.is_some_and(|read| read > anew.since) {
            return self.differs(watched, index, around, at);
        }
        // A drive that was not configured before stops no motor until it is read.
        let before = anew.before.as_ref()?;
        self.differed(before, index, around, (anew.since, now))
    }

    /// The state of the point if it does not satisfy the interlock.
    fn differs(&self, watched: &Watched, index: PointIndex, around: &DrivesByName, now: Instant) -> Option<String> {
        let reading = watched.image.reading(now, around.stale_after);
        let sample = reading.sample(index);
        let age = || {
            sample
                .at
                .map_or(0.0, |at| now.saturating_duration_since(at).as_secs_f64())
        };
        Some(match sample.good().map(Value::as_bool) {
            Some(is) if is == self.is => return None,
            Some(is) => format!("is {is}"),
            None if !reading.snapshot.link.is_online() => "is unknown: the drive is offline".to_string(),
            None if sample.at.is_none() => "was never read".to_string(),
            None if sample.quality == Quality::Stale => format!("is stale: read {:.1} s ago", age()),
            None => "is unknown: its value is bad".to_string(),
        })
    }
}
