//! Starts, run time and energy of a drive, as the gateway sees them. Pure: time is an argument.
//!
//! Only observed time is counted: while a drive is offline, or its running bit is not good, neither time nor starts are
//! added.

use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::process_image::Reading;
use drivegate_model::drive::{ModelPoint, Value};

/// The counters of a drive since it was first seen.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Totals {
    /// Starts: the running bit was seen to become set.
    pub starts: u64,
    /// Time that the motor was seen running, s.
    pub running_seconds: f64,
    /// The drive's own energy counter when it was last read, kWh.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub energy_kwh: Option<f64>,
}

impl Totals {
    /// The sum of these totals and the earlier totals `before`.
    #[must_use]
    pub fn after(self, before: Totals) -> Totals {
        Totals {
            starts: self.starts.saturating_add(before.starts),
            running_seconds: self.running_seconds + before.running_seconds,
            energy_kwh: self.energy_kwh.or(before.energy_kwh),
        }
    }

    /// Whether the values are possible counts.
    pub(crate) fn is_sane(&self) -> bool {
        let fine = |figure: f64| figure.is_finite() && figure >= 0.0;
        fine(self.running_seconds) && self.energy_kwh.is_none_or(f64::is_finite)
    }
}

/// Counters of starts, run time and energy of a drive.
#[derive(Debug, Default)]
pub struct Counters {
    totals: Totals,
    /// Whether the motor ran at the last read, and when that was; `None` once the drive went offline.
    ran: Option<(Instant, bool)>,
}

impl Counters {
    /// Counters that start from these totals.
    pub fn from(totals: Totals) -> Counters {
        Counters { totals, ran: None }
    }

    /// Adds earlier counts.
    pub fn add(&mut self, before: Totals) {
        self.totals = self.totals.after(before);
    }

    /// The present totals.
    pub fn totals(&self) -> Totals {
        self.totals
    }

    /// Counts a read of the drive; `reading` has the values of that read, `known` those of the drive's image, which has the
    /// time for which a value is good.
    pub fn read(&mut self, reading: &Reading<'_>, known: &Reading<'_>) {
        let profile = &reading.spec.profile;
        if let Some(index) = profile.model_index(ModelPoint::Running) {
            let sample = reading.sample(index);
            if let (Some(running), Some(at)) = (sample.good(), sample.at) {
                self.see(running.as_bool(), at, || known.good_for(index));
            }
        }
        if let Some(energy) = reading.model(ModelPoint::Energy).good().map(Value::as_f64) {
            self.totals.energy_kwh = Some(energy);
        }
    }

    /// Processes a reading of the running bit at `at`; the reading before was good for this time.
    fn see(&mut self, running: bool, at: Instant, good_for: impl Fn() -> Duration) {
        if let Some((before, ran)) = self.ran {
            let Some(passed) = at.checked_duration_since(before).filter(|passed| !passed.is_zero()) else {
                return;
            };
            // A motor that was standing and still stands adds nothing, so the expensive part is skipped.
            if ran || running {
                let seen = passed <= good_for();
                if seen && ran {
                    self.totals.running_seconds += passed.as_secs_f64();
                }
                if seen && running && !ran {
                    self.totals.starts += 1;
                }
            }
        }
        self.ran = Some((at, running));
    }

    /// Notes that the drive was offline, so its state during that time is unknown.
    pub fn interrupt(&mut self) {
        self.ran = None;
    }
}
