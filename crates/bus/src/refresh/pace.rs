//! Whether a motor slows down although no order here demands it: another master may have stopped a drive whose control
//! word cannot be read. Pure.

use super::ordered::Reference;
use drivegate_model::drive::{ModelPoint, Profile, Raw};

/// Share of the reference within which a motor keeps its speed, by which it may stay below its reference, and by which a
/// motor that slows down there becomes slower from look to look, at least. A speed that is measured differs by less.
const BAND: f64 = 0.005;

/// Share of the reference by which a drive that compensates slip may turn faster than its reference.
const SLIP: f64 = 0.05;

/// Share of the reference by which a motor that kept its speed has at least become slower in the first look behind a stop,
/// and below its reference from look to look. A wrong first look costs one refresh, and the next look decides.
const FIRST_FALL: f64 = 0.001;

/// Speed of a refreshed motor in relation to the reference of the last order.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) enum Pace {
    /// The motor follows the order, or turns at another speed, as with a process controller in the drive.
    #[default]
    Free,
    /// The motor was at its reference in the last look, at this speed.
    Arrived(f64),
    /// The motor kept its speed at its reference in at least two consecutive looks.
    Steady(Kept),
    /// The motor kept its speed at its reference, and has slowed down to this speed since.
    Falls(f64),
}

/// Speeds of a motor that is at its reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Kept {
    low: f64,
    high: f64,
}

impl Kept {
    /// Whether a motor with this speed has slowed down: it is below the lowest speed by more than its speeds differ, and by
    /// more than `least`.
    fn is_left_by(self, speed: f64, least: f64) -> bool {
        speed < self.low - (self.high - self.low).max(least)
    }

    fn of(speed: f64) -> Kept {
        Kept {
            low: speed,
            high: speed,
        }
    }

    fn with(self, speed: f64) -> Kept {
        Kept {
            low: self.low.min(speed),
            high: self.high.max(speed),
        }
    }
}

impl Pace {
    /// The pace after a look at the speed, in the unit of the reference.
    pub(super) fn after(self, speed: f64, reference: f64) -> Pace {
        let (speed, reference) = (speed.abs(), reference.abs());
        let band = reference * BAND;
        let is_there = (reference - band..=reference * (1.0 + SLIP)).contains(&speed);
        // Slip compensation turns the motor faster by its load, which may change for many periods.
        let is_below = speed < reference;
        // At its reference a motor may drift by its load; a long ramp falls little from look to look.
        let fall = if is_there { band } else { reference * FIRST_FALL };
        let together = |kept: Kept| is_there && kept.high - kept.low <= band;
        match self {
            Pace::Steady(kept) if kept.is_left_by(speed, reference * FIRST_FALL) => Pace::Falls(speed),
            // A motor that brakes at 0 Hz still shows that it runs.
            Pace::Falls(last) if is_below && speed < last - fall || speed <= band => Pace::Falls(speed),
            Pace::Steady(kept) if together(kept.with(speed)) => Pace::Steady(kept.with(speed)),
            Pace::Arrived(last) | Pace::Falls(last) if together(Kept::of(last).with(speed)) => {
                Pace::Steady(Kept::of(last).with(speed))
            }
            _ if is_there => Pace::Arrived(speed),
            _ => Pace::Free,
        }
    }
}

/// The points that show a reference and the speed in one unit, from the drive's registers; `None` if the profile does not
/// have both.
pub(super) fn compared(profile: &Profile) -> Option<[ModelPoint; 2]> {
    let pairs = [
        [ModelPoint::SpeedReference, ModelPoint::ActualSpeed],
        [ModelPoint::FrequencyReference, ModelPoint::OutputFrequency],
    ];
    let is_raw = |point: &ModelPoint| raw(profile, *point).is_some();
    pairs.into_iter().find(|pair| pair.iter().all(is_raw))
}

/// Value of a reference that was written, in the unit of the speed to which it is compared.
pub(super) fn value(profile: &Profile, reference: Reference) -> Option<f64> {
    let [of, _] = compared(profile)?;
    let index = profile.model_index(of)?;
    let raw = raw(profile, of).filter(|raw| raw.address == reference.start)?;
    let kind = profile.points.get(index)?.kind();
    raw.decode(reference.words(), kind).map(|value| value.as_f64())
}

fn raw(profile: &Profile, point: ModelPoint) -> Option<&Raw> {
    profile.points.get(profile.model_index(point)?)?.raw()
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::profile::Profiles;

    /// Letters: f free, a arrived, s steady, v falls. One look after another, with a reference of 50 Hz.
    #[test]
    fn a_motor_falls_only_from_its_reference() {
        for (speeds, expected) in [
            // A start, then a stop that nobody here ordered.
            (&[0.0, 20.0, 50.0, 50.0, 49.9, 45.0, 40.0, 3.0][..], "ffasvvvv"),
            // A stop in the first look at the reference cannot be told from a reversal.
            (&[50.0, 45.0, 30.0], "aff"),
            // A dip, then the motor is back at its reference.
            (&[50.0, 50.0, 48.0, 49.0, 50.0, 50.0], "asvfas"),
            // The motor turns on at a lower speed.
            (&[50.0, 50.0, 48.0, 47.96, 47.96], "asvff"),
            // A ramp of five minutes, or of 30 seconds with a period of 0.1 s.
            (&[50.0, 50.0, 49.833, 49.667, 49.5, 49.333, 49.167], "asvvvvv"),
            // A ramp of two minutes: the first looks differ little.
            (&[50.0, 50.0, 49.9, 49.5, 49.1, 48.7], "asvvvv"),
            // The speed drifts, and is not constant.
            (&[50.0, 50.0, 49.9, 49.8, 49.9, 49.8, 49.78], "asvssss"),
            // The end of a ramp, then the drive brakes the standing motor with direct current.
            (&[50.0, 50.0, 30.0, 10.0, 0.2, 0.0, 0.0, 0.0], "asvvvvvv"),
            // A measured speed is never twice the same.
            (&[49.99, 50.02, 49.97, 50.01, 49.94, 50.03, 49.9, 50.0], "asssssss"),
            (&[49.99, 50.02, 49.97, 49.8, 49.4, 45.0], "assvvv"),
            // The drive compensates slip; then it sheds load, then it is stopped.
            (&[51.2, 51.2, 51.2, 50.6, 50.6, 50.6, 50.2, 49.0], "assvssvv"),
            // The load falls for seconds: one refresh is left out, and none where the speed stays above the reference.
            (&[51.25, 51.25, 51.125, 51.0, 50.875, 50.75, 50.625], "asvssas"),
            // A process controller in the drive: the speed does not stay at the reference.
            (&[44.0, 50.0, 53.0, 50.0, 46.0, 40.0, 31.0], "fafafff"),
            // An order that lowers the reference.
            (&[80.0, 70.0, 60.0, 50.0, 50.0], "fffas"),
            // In reverse.
            (&[-50.0, -50.0, -49.0], "asv"),
        ] {
            let mut pace = Pace::default();
            let told: String = speeds
                .iter()
                .map(|speed| {
                    pace = pace.after(*speed, 50.0);
                    match pace {
                        Pace::Free => 'f',
                        Pace::Arrived(_) => 'a',
                        Pace::Steady(_) => 's',
                        Pace::Falls(_) => 'v',
                    }
                })
                .collect();
            assert_eq!(told, expected, "{speeds:?}");
        }
    }

    #[test]
    fn a_motor_without_a_reference_never_falls() {
        let mut pace = Pace::default();
        for speed in [30.0, 0.0, 0.0, 0.0] {
            pace = pace.after(speed, 0.0);
            assert!(!matches!(pace, Pace::Falls(_)), "{pace:?}");
        }
    }

    /// Every family whose repeated word cannot be read shows a speed to compare.
    #[test]
    fn every_family_with_a_word_in_shadow_has_a_speed() {
        let built_in = Profiles::built_in();
        let hidden = |profile: &&Profile| {
            let repeats = profile.repeats().is_ok_and(|repeats| repeats.word);
            repeats && profile.control.as_ref().is_some_and(|control| !control.is_read())
        };
        let names: Vec<&str> = built_in
            .iter()
            .filter(|profile| hidden(&profile.as_ref()))
            .map(|profile| {
                assert!(compared(profile).is_some(), "{}", profile.name);
                profile.name.as_str()
            })
            .collect();
        assert!(names.len() >= 7, "{names:?}");
    }
}
