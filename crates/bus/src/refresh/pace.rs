//! Whether a motor slows down although no order here demands it: another master may have stopped a drive whose control
//! word cannot be read. Pure.

use super::ordered::Reference;
use drivegate_model::drive::{ModelPoint, Profile, Raw};

/// Share of the reference by which a motor at its reference may deviate from it.
const BAND: f64 = 0.005;

/// Speed of a refreshed motor in relation to the reference of the last order.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) enum Pace {
    /// The motor follows the order, or turns at another speed, as with a process controller in the drive.
    #[default]
    Free,
    /// The motor was at its reference in the last look.
    Arrived,
    /// The motor was at its reference in at least two consecutive looks.
    Steady,
    /// The motor was at its reference, and has slowed down to this speed since.
    Falls(f64),
}

impl Pace {
    /// The pace after a look at the speed, in the unit of the reference.
    pub(super) fn after(self, speed: f64, reference: f64) -> Pace {
        let (speed, reference) = (speed.abs(), reference.abs());
        let band = reference * BAND;
        let last = match self {
            Pace::Steady => reference,
            Pace::Falls(last) => last,
            Pace::Free | Pace::Arrived => 0.0,
        };
        match self {
            _ if speed < last - band => Pace::Falls(speed),
            Pace::Arrived | Pace::Steady if (speed - reference).abs() <= band => Pace::Steady,
            _ if (speed - reference).abs() <= band => Pace::Arrived,
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
            (&[0.0, 20.0, 50.0, 50.0, 49.9, 45.0, 40.0, 3.0][..], "ffassvvv"),
            // A stop in the first look at the reference cannot be told from a reversal.
            (&[50.0, 45.0, 30.0], "aff"),
            // A dip, then the motor is back at its reference.
            (&[50.0, 50.0, 48.0, 49.0, 50.0, 50.0], "asvfas"),
            // The motor turns on at a lower speed.
            (&[50.0, 50.0, 48.0, 47.9, 47.9], "asvff"),
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
                        Pace::Arrived => 'a',
                        Pace::Steady => 's',
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
