//! Whether a motor is at standstill, as far as readings show. Pure.

use std::time::Instant;

use super::{Reading, Unavailable};
use drivegate_model::drive::{ModelPoint, Point};

/// Causes (`blocks` of a point in the profile) for which a motor may turn whatever its drive does.
const FED_OTHERWISE: [&str; 2] = ["bypass", "fire_mode"];

/// Highest output frequency in Hz at which a motor that does not run counts as being at standstill.
const STANDS: f64 = 0.5;

/// The state of a motor in readings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Standstill {
    /// The motor is at standstill.
    Stands,
    /// The motor turns, with the evidence.
    Turns(String),
    /// Standstill is unknown, for this reason.
    Unknown(String),
}

impl Reading<'_> {
    /// Whether the motor is at standstill, by good samples that were read after `since`: zero speed or no output
    /// frequency, and not running.
    pub fn standstill(&self, since: Option<Instant>) -> Standstill {
        self.standstill_read(since).0
    }

    /// The state of the motor, with the date of the last sample needed to prove it.
    pub fn standstill_read(&self, since: Option<Instant>) -> (Standstill, Option<Instant>) {
        if let Some(why) = self.may_turn() {
            return (Standstill::Unknown(why), None);
        }
        let is_after = |at: Option<Instant>| since.is_none_or(|since| at.is_some_and(|at| at > since));
        let known = |point| {
            let sample = self.model(point);
            sample
                .good()
                .filter(|_| is_after(sample.at))
                .map(|value| (value, sample.at))
        };
        let is = |point| known(point).map(|(value, at)| (value.as_bool(), at));
        let (running, at_zero) = (is(ModelPoint::Running), is(ModelPoint::ZeroSpeed));
        let frequency = known(ModelPoint::OutputFrequency).map(|(hertz, at)| (hertz.as_f64().abs(), at));
        match (running, at_zero, frequency) {
            (Some((true, at)), _, Some((hertz, _))) => (Standstill::Turns(format!("`running` at {hertz:.1} Hz")), at),
            (Some((true, at)), _, None) => (Standstill::Turns("`running`".to_string()), at),
            (_, Some((true, at)), _) => (Standstill::Stands, at),
            (_, _, Some((hertz, at))) if hertz > STANDS => {
                (Standstill::Turns(format!("`output_frequency` {hertz:.1} Hz")), at)
            }
            (Some((false, run)), _, Some((_, at))) => (Standstill::Stands, run.max(at)),
            _ if !self.tells_standstill() => (
                Standstill::Unknown(
                    "standstill cannot be verified: the drive has neither `zero_speed` nor a frequency".to_string(),
                ),
                None,
            ),
            _ => (Standstill::Unknown("it has not been read since".to_string()), None),
        }
    }

    /// Whether the polls of the drive can show that the motor is at standstill.
    fn tells_standstill(&self) -> bool {
        let reads = |point| self.spec.profile.model_point(point).is_some_and(Point::is_read);
        reads(ModelPoint::ZeroSpeed) || (reads(ModelPoint::Running) && reads(ModelPoint::OutputFrequency))
    }

    /// Reason why a motor may turn although its drive has stopped: the point that shows another supply, or does not
    /// exclude one yet. A point that the drive refuses, or that is not polled, does not count.
    pub fn may_turn(&self) -> Option<String> {
        let points = self.spec.profile.points.enumerate();
        let reasons = points.filter_map(|(index, point)| {
            let blocks = point.blocks.as_ref()?;
            if !FED_OTHERWISE.contains(&blocks.cause.as_str()) {
                return None;
            }
            match self.sample(index).good() {
                Some(value) if value.as_bool() == blocks.when => {
                    let state = if value.as_bool() { "on" } else { "off" };
                    Some(format!("`{}` is {state}: {}", point.name, blocks.remedy))
                }
                Some(_) => None,
                None => {
                    let raw = point.raw()?;
                    let is_awaited = self.words(raw.table, raw.address, raw.form.items()) == Err(Unavailable::Stale);
                    is_awaited.then(|| format!("`{}` is unknown", point.name))
                }
            }
        });
        let reasons: Vec<String> = reasons.collect();
        let motor = "the motor may turn although the drive is stopped";
        (!reasons.is_empty()).then(|| format!("{motor}, {}", reasons.join(", ")))
    }
}
