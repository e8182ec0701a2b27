//! Parameters of the simulated Vacon NX, IDs 101 to 1999.
//!
//! The IDs are those of reference/drives.md 3.11 and 11.1. Ranges and defaults that no available manual states are
//! plausible values of the All in One applications.

use super::super::motor::Ratings;
use super::super::parameter_set::ParameterSet;
use super::ControlPlace;

/// ID of the minimum frequency, 0.01 Hz.
pub const MINIMUM_FREQUENCY: u16 = 101;
/// ID of the maximum frequency, 0.01 Hz.
pub const MAXIMUM_FREQUENCY: u16 = 102;
/// ID of the acceleration time from 0 to the maximum frequency, 0.1 s.
pub const ACCELERATION_TIME: u16 = 103;
/// ID of the deceleration time from the maximum frequency to 0, 0.1 s.
pub const DECELERATION_TIME: u16 = 104;
/// ID of the motor's nominal voltage, V.
pub const NOMINAL_VOLTAGE: u16 = 110;
/// ID of the motor's nominal frequency, 0.01 Hz.
pub const NOMINAL_FREQUENCY: u16 = 111;
/// ID of the motor's nominal speed, rpm.
pub const NOMINAL_SPEED: u16 = 112;
/// ID of the motor's nominal current, 0.1 A.
pub const NOMINAL_CURRENT: u16 = 113;
/// ID of the motor's cos phi, 0.01.
pub const COS_PHI: u16 = 120;
/// ID of the control place: 1 I/O terminals, 2 panel, 3 fieldbus.
pub const CONTROL_PLACE: u16 = 125;
/// ID of the stop function: 0 coasting, 1 ramping.
pub const STOP_FUNCTION: u16 = 506;
/// ID of P2.7.22, the response to a fieldbus fault: 0 none, 1 warning, 2 stop, 3 coast.
pub const FIELDBUS_FAULT_RESPONSE: u16 = 733;
/// ID of P2.7.23, the response to a slot fault, with the values of P2.7.22.
pub const SLOT_FAULT_RESPONSE: u16 = 734;
/// First ID of the eight selectors for process data out.
pub const OUT_SELECTION: u16 = 852;
/// Items of process data out 1 to 8 by default (reference/drives.md 3.8): IDs 1 to 7, then the active fault.
const OUT_DEFAULTS: [u16; 8] = [1, 2, 3, 4, 5, 6, 7, 37];

/// All parameters of one drive by ID, which survive a power cycle; each write over the bus is stored permanently.
pub(super) fn parameters() -> ParameterSet {
    // Fields: ID, minimum, maximum, default.
    let plain = [
        (MINIMUM_FREQUENCY, 0, 32_000, 0),
        (MAXIMUM_FREQUENCY, 100, 32_000, 5000),
        (ACCELERATION_TIME, 1, 30_000, 30),
        (DECELERATION_TIME, 1, 30_000, 30),
        (105, 0, 32_000, 1000),
        (106, 0, 32_000, 2000),
        (107, 1, 4000, 44),
        (108, 0, 3, 0),
        (109, 0, 1, 0),
        (NOMINAL_VOLTAGE, 180, 690, 400),
        (NOMINAL_FREQUENCY, 800, 32_000, 5000),
        (NOMINAL_SPEED, 24, 20_000, 1500),
        (NOMINAL_CURRENT, 1, 60_000, 22),
        (117, 0, 4, 3),
        (COS_PHI, 30, 100, 85),
        (CONTROL_PLACE, 1, 3, 3),
        (505, 0, 1, 0),
        (STOP_FUNCTION, 0, 1, 1),
        (FIELDBUS_FAULT_RESPONSE, 0, 3, 0),
        (SLOT_FAULT_RESPONSE, 0, 3, 0),
        (850, 0, 320, 0),
        (851, 0, 320, 0),
    ];
    let selectors = OUT_DEFAULTS.iter().zip(OUT_SELECTION..);
    let selectors = selectors.map(|(&item, id)| (id, 0, 1999, item));
    let set = ParameterSet::new(plain.into_iter().chain(selectors));
    set.limited([(MAXIMUM_FREQUENCY, MINIMUM_FREQUENCY)]).kept_at_once()
}

/// How the drive stops the motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopFunction {
    /// The motor coasts to a stop.
    Coast,
    /// Slows the motor down with the deceleration time.
    Ramp,
}

/// Parameters in engineering units, decoded once a change.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Minimum frequency, Hz.
    pub minimum: f64,
    /// Ratings of the motor and its ramps.
    pub motor: Ratings,
    /// Control place from which the drive takes its commands.
    pub place: ControlPlace,
    /// How the drive stops its motor.
    pub stop: StopFunction,
    /// P2.7.22.
    pub fieldbus_fault: u16,
}

impl Settings {
    /// The parameters of a drive in engineering units.
    pub(super) fn of(parameters: &ParameterSet) -> Settings {
        let number = |id| f64::from(parameters.number(id));
        Settings {
            minimum: number(MINIMUM_FREQUENCY) / 100.0,
            motor: Ratings {
                maximum: number(MAXIMUM_FREQUENCY) / 100.0,
                acceleration: number(ACCELERATION_TIME) / 10.0,
                deceleration: number(DECELERATION_TIME) / 10.0,
                voltage: number(NOMINAL_VOLTAGE),
                frequency: number(NOMINAL_FREQUENCY) / 100.0,
                speed: number(NOMINAL_SPEED),
                current: number(NOMINAL_CURRENT) / 10.0,
                cos_phi: number(COS_PHI) / 100.0,
            },
            place: ControlPlace::from_parameter(parameters.number(CONTROL_PLACE)),
            stop: if parameters.number(STOP_FUNCTION) == 0 {
                StopFunction::Coast
            } else {
                StopFunction::Ramp
            },
            fieldbus_fault: parameters.number(FIELDBUS_FAULT_RESPONSE),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::parameter_set::Refused;
    use super::*;

    #[test]
    fn ranges_and_order() {
        let mut p = parameters();
        assert!(
            p.iter().all(|p| p.min <= p.value && p.value <= p.max),
            "defaults lie in their ranges"
        );
        assert_eq!(
            p.get(733),
            Some(0),
            "P2.7.22 is 0 out of the box (reference/drives.md 3.11)"
        );
        assert_eq!(p.set(733, 3), Ok(()));
        assert_eq!(p.get(733), Some(3));
        assert_eq!(p.set(733, 4), Err(Refused::Value));
        assert_eq!(p.set(100, 0), Err(Refused::Unknown));
        assert_eq!(p.set(MINIMUM_FREQUENCY, 5001), Err(Refused::Value), "above the maximum");
        assert_eq!(p.get(859), Some(37));
    }
}
