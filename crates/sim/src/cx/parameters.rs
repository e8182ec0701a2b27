//! Parameters of the simulated CX by their address (reference/drives.md 4.3).
//!
//! The manual names only Par 0.1, 1.1, 1.2 and 3.2. The others, their ranges and defaults are plausible values of
//! the drive's applications, so that there are parameters to read and the motor has nameplate data.

use super::super::motor::Ratings;
use super::super::parameter_set::ParameterSet;

/// The address of a parameter, 1..=99 of group 0..=98: groups 1 to 98 by hundreds, group 0 at the end.
pub(super) const fn address(group: u16, number: u16) -> u16 {
    let block = if group == 0 { 99 } else { group };
    100 * block + number - 1
}

const MINIMUM_FREQUENCY: u16 = address(1, 1);
const MAXIMUM_FREQUENCY: u16 = address(1, 2);
const ACCELERATION_TIME: u16 = address(1, 3);
const DECELERATION_TIME: u16 = address(1, 4);
const NOMINAL_VOLTAGE: u16 = address(1, 8);
const NOMINAL_FREQUENCY: u16 = address(1, 9);
const NOMINAL_SPEED: u16 = address(1, 10);
const NOMINAL_CURRENT: u16 = address(1, 11);

/// (group, number, minimum, maximum, default). Frequencies are in Hz here.
const TABLE: [(u16, u16, u16, u16, u16); 28] = [
    (0, 1, 0, 7, 0),
    (0, 2, 0, 1, 0),
    (1, 1, 0, 500, 0),
    (1, 2, 1, 500, 50),
    (1, 3, 1, 30_000, 30),
    (1, 4, 1, 30_000, 30),
    (1, 5, 1, 10_000, 44),
    (1, 6, 0, 2, 0),
    (1, 7, 0, 1, 0),
    (1, 8, 180, 690, 400),
    (1, 9, 8, 500, 50),
    (1, 10, 24, 20_000, 1500),
    (1, 11, 1, 60_000, 22),
    (1, 12, 180, 690, 400),
    (1, 13, 0, 1, 0),
    (1, 14, 0, 1, 0),
    (2, 1, 0, 3, 0),
    (2, 2, 0, 10, 1),
    (2, 3, 0, 10, 7),
    (2, 4, 0, 1, 0),
    (3, 1, 0, 7, 1),
    (3, 2, 0, 1000, 100),
    (3, 3, 0, 1, 0),
    (4, 1, 0, 100, 0),
    (4, 2, 0, 100, 0),
    (4, 5, 0, 1, 0),
    (4, 6, 0, 1, 0),
    (4, 7, 0, 1, 1),
];

/// cos phi of the motor, which no parameter holds.
const COS_PHI: f64 = 0.85;

/// All parameters of one drive by address, which survive a power cycle; each write over the bus is stored permanently.
#[derive(Debug, Clone)]
pub(super) struct Parameters {
    pub(super) set: ParameterSet,
    frequency_step: f64,
}

impl Parameters {
    /// `frequency_step`: Hz that one count of a frequency is.
    pub(super) fn new(frequency_step: f64) -> Parameters {
        let set = TABLE.map(|(group, number, min, max, value)| {
            let key = address(group, number);
            let step = if [MINIMUM_FREQUENCY, MAXIMUM_FREQUENCY, NOMINAL_FREQUENCY].contains(&key) {
                frequency_step
            } else {
                1.0
            };
            let counts = |number: u16| (f64::from(number) / step) as u16;
            (key, counts(min), counts(max), counts(value))
        });
        Parameters {
            set: ParameterSet::new(set)
                .limited([(MAXIMUM_FREQUENCY, MINIMUM_FREQUENCY)])
                .kept_at_once(),
            frequency_step,
        }
    }

    /// The minimum frequency parameter, Hz.
    pub(super) fn minimum(&self) -> f64 {
        f64::from(self.set.number(MINIMUM_FREQUENCY)) * self.frequency_step
    }

    /// Ratings of the motor and its ramps, from the parameters.
    pub(super) fn ratings(&self) -> Ratings {
        let number = |key| f64::from(self.set.number(key));
        Ratings {
            maximum: number(MAXIMUM_FREQUENCY) * self.frequency_step,
            acceleration: number(ACCELERATION_TIME) / 10.0,
            deceleration: number(DECELERATION_TIME) / 10.0,
            voltage: number(NOMINAL_VOLTAGE),
            frequency: number(NOMINAL_FREQUENCY) * self.frequency_step,
            speed: number(NOMINAL_SPEED),
            current: number(NOMINAL_CURRENT) / 10.0,
            cos_phi: COS_PHI,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::parameter_set::Refused;
    use super::*;

    #[test]
    fn addresses_of_the_manual() {
        assert_eq!((address(1, 2), address(3, 2), address(0, 1)), (101, 301, 9900));
        assert_eq!((address(98, 1), address(98, 99), address(0, 99)), (9800, 9898, 9998));
    }

    #[test]
    fn steps_of_a_frequency() {
        for step in [1.0, 0.1, 0.01] {
            let mut parameters = Parameters::new(step);
            assert_eq!(parameters.ratings().maximum, 50.0);
            assert_eq!(
                parameters.set.set(MINIMUM_FREQUENCY, (51.0 / step) as u16),
                Err(Refused::Value)
            );
            assert_eq!(parameters.set.set(MINIMUM_FREQUENCY, (10.0 / step) as u16), Ok(()));
            assert!((parameters.minimum() - 10.0).abs() < 1e-9);
            assert!(parameters.set.iter().all(|p| p.min <= p.value && p.value <= p.max));
        }
    }
}
