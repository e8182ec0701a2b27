//! The motor of every simulated drive: ramps, shaft, load, heat (reference/drives.md, section 10).

/// The motor's nameplate data and the drive's ramps, from the parameters of any drive model.
#[derive(Debug, Clone, Copy)]
pub struct Ratings {
    /// Maximum frequency, to which the ramp times belong, Hz.
    pub maximum: f64,
    /// Time from 0 to the maximum frequency, s.
    pub acceleration: f64,
    /// Time from the maximum frequency to 0, s.
    pub deceleration: f64,
    /// Nominal voltage, V.
    pub voltage: f64,
    /// Nominal frequency, Hz.
    pub frequency: f64,
    /// Nominal speed, rpm.
    pub speed: f64,
    /// Nominal current, A.
    pub current: f64,
    pub cos_phi: f64,
}

/// The load and the mains of one drive.
///
/// The defaults make the worked status frame of reference/drives.md 7.4: at 25 Hz 750 rpm, 1.2 A, torque 10.5 %, power 5.3 %,
/// 200.0 V on the motor and 560 V in the DC link.
#[derive(Debug, Clone, Copy)]
pub struct Load {
    /// Torque that the load takes at standstill, % of nominal.
    pub base_torque: f64,
    /// Torque at nominal frequency, % of nominal; it grows with the square of the speed, as pumps and fans do.
    pub full_torque: f64,
    /// Torque that accelerates the load to nominal frequency in one second, % of nominal.
    pub inertia: f64,
    /// Supply, V; the DC link has 1.35 times as much.
    pub mains: f64,
    /// Temperature of the air at the heatsink, °C.
    pub ambient: f64,
}

impl Default for Load {
    fn default() -> Self {
        Load {
            base_torque: 2.0,
            full_torque: 36.0,
            inertia: 15.0,
            mains: 415.0,
            ambient: 27.0,
        }
    }
}

/// Rise of the heatsink above ambient at nominal current, kelvin, and its time constant, s.
const HEATSINK: (f64, f64) = (38.0, 180.0);
/// Calculated heat of the motor at nominal current, %, and its time constant, s.
const MOTOR_HEAT: (f64, f64) = (82.0, 900.0);
/// Time in which a coasting motor slows down from nominal frequency, s.
const COAST_TIME: f64 = 8.0;
/// Sag of the DC link at nominal power, V.
const DC_SAG: f64 = 6.0;

/// How the inverter feeds the motor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Feed {
    /// The inverter does not feed the motor: the motor coasts or is at standstill.
    Off,
    /// The inverter drives the motor towards this frequency, Hz; negative is counterclockwise.
    To(f64),
}

/// The state of the motor and the inverter.
#[derive(Debug, Clone)]
pub(crate) struct Motor {
    /// Output frequency, Hz, negative for counterclockwise; 0 while the inverter is off.
    pub output: f64,
    /// Frequency that the shaft turns with, Hz.
    pub shaft: f64,
    /// Whether the inverter feeds the motor.
    pub fed: bool,
    /// Torque, % of nominal.
    pub torque: f64,
    /// Temperature of the heatsink, °C.
    pub heatsink: f64,
    /// Calculated heat of the motor, %.
    pub heat: f64,
}

impl Motor {
    /// A cold motor at rest.
    pub(crate) fn new(load: &Load) -> Motor {
        Motor {
            output: 0.0,
            shaft: 0.0,
            fed: false,
            torque: 0.0,
            heatsink: load.ambient,
            heat: 0.0,
        }
    }

    /// Switches the inverter off at once; the shaft keeps turning.
    pub(crate) fn release(&mut self) {
        self.fed = false;
        self.output = 0.0;
    }

    /// Advances the motor by `dt` seconds.
    pub(crate) fn step(&mut self, dt: f64, feed: Feed, ratings: &Ratings, load: &Load) {
        let before = self.shaft;
        match feed {
            Feed::Off => {
                self.release();
                self.shaft = towards(self.shaft, 0.0, ratings.frequency / COAST_TIME * dt);
            }
            Feed::To(target) => {
                if !self.fed {
                    // If the motor is already turning, the inverter catches it at its present speed.
                    self.fed = true;
                    self.output = self.shaft;
                }
                self.output = self.ramp(dt, target, ratings);
                self.shaft = self.output;
            }
        }
        let acceleration = (self.shaft - before) / dt / ratings.frequency;
        self.torque = if self.fed {
            self.load_torque(ratings, load) + load.inertia * acceleration
        } else {
            0.0
        };
        let warmth = (self.current(ratings) / ratings.current).powi(2);
        let cool = if self.fed { HEATSINK.0 * warmth } else { 0.0 };
        self.heatsink += (load.ambient + cool - self.heatsink) * dt / HEATSINK.1;
        self.heat += (MOTOR_HEAT.0 * warmth - self.heat) * dt / MOTOR_HEAT.1;
    }

    /// The output one step on: down to zero first when the direction changes, then up.
    fn ramp(&self, dt: f64, target: f64, ratings: &Ratings) -> f64 {
        let up = ratings.maximum / ratings.acceleration.max(0.1) * dt;
        let down = ratings.maximum / ratings.deceleration.max(0.1) * dt;
        if self.output * target < 0.0 {
            towards(self.output, 0.0, down)
        } else if target.abs() < self.output.abs() {
            towards(self.output, target, down)
        } else {
            towards(self.output, target, up)
        }
    }

    fn load_torque(&self, ratings: &Ratings, load: &Load) -> f64 {
        let ratio = self.shaft / ratings.frequency;
        let magnitude = load.base_torque + (load.full_torque - load.base_torque) * ratio * ratio;
        if self.shaft == 0.0 {
            0.0
        } else {
            magnitude.copysign(self.shaft)
        }
    }

    /// Shaft speed, rpm: the synchronous speed less the slip that the torque costs.
    pub(crate) fn rpm(&self, ratings: &Ratings) -> f64 {
        let pole_pairs = (60.0 * ratings.frequency / ratings.speed.max(1.0)).floor().max(1.0);
        let synchronous = 60.0 / pole_pairs;
        let slip = (synchronous * ratings.frequency - ratings.speed).max(0.0) * self.torque / 100.0;
        if self.shaft == 0.0 {
            0.0
        } else {
            synchronous * self.shaft - slip
        }
    }

    /// Motor current, A: magnetising and torque component at a right angle.
    pub(crate) fn current(&self, ratings: &Ratings) -> f64 {
        if !self.fed {
            return 0.0;
        }
        let magnetising = ratings.current * (1.0 - ratings.cos_phi * ratings.cos_phi).max(0.0).sqrt();
        let active = ratings.current * ratings.cos_phi * self.torque / 100.0;
        magnetising.hypot(active)
    }

    /// Shaft power, % of nominal; negative while the motor brakes.
    pub(crate) fn power(&self, ratings: &Ratings) -> f64 {
        self.torque * self.shaft / ratings.frequency
    }

    /// Motor voltage, V: proportional to the frequency up to the nominal one.
    pub(crate) fn voltage(&self, ratings: &Ratings) -> f64 {
        ratings.voltage * (self.output / ratings.frequency).abs().min(1.0)
    }

    /// DC link voltage, V.
    pub(crate) fn dc_link(&self, ratings: &Ratings, load: &Load) -> f64 {
        1.35 * load.mains - DC_SAG * self.power(ratings) / 100.0
    }
}

fn towards(from: f64, to: f64, step: f64) -> f64 {
    if (to - from).abs() <= step {
        to
    } else {
        from + step.copysign(to - from)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATINGS: Ratings = Ratings {
        maximum: 50.0,
        acceleration: 3.0,
        deceleration: 3.0,
        voltage: 400.0,
        frequency: 50.0,
        speed: 1500.0,
        current: 2.2,
        cos_phi: 0.85,
    };

    #[test]
    fn ramps_by_the_times_of_the_parameters() {
        let load = Load::default();
        let mut motor = Motor::new(&load);
        let steps = |motor: &mut Motor, feed, n| (0..n).for_each(|_| motor.step(0.01, feed, &RATINGS, &load));
        steps(&mut motor, Feed::To(50.0), 150);
        assert!(
            (motor.output - 25.0).abs() < 1e-6,
            "half of 50 Hz after half of 3 s: {}",
            motor.output
        );
        assert!(motor.torque > 10.5, "accelerating takes more than the load alone");
        steps(&mut motor, Feed::To(25.0), 1);
        assert!((motor.current(&RATINGS) - 1.18).abs() < 0.02);
        steps(&mut motor, Feed::To(-25.0), 150);
        assert_eq!(motor.output, 0.0, "through zero on the way to the other direction");
        steps(&mut motor, Feed::To(-25.0), 151);
        assert_eq!(motor.output, -25.0);
        assert!(motor.rpm(&RATINGS) == -750.0 && motor.power(&RATINGS) > 0.0);
        steps(&mut motor, Feed::Off, 100);
        assert!(motor.output == 0.0 && motor.shaft < -15.0, "coasting");
        steps(&mut motor, Feed::To(-25.0), 1);
        assert!(motor.output < -15.0, "picked up at its speed");
    }

    #[test]
    fn slip_of_an_asynchronous_motor() {
        let ratings = Ratings {
            speed: 1440.0,
            ..RATINGS
        };
        let load = Load {
            full_torque: 100.0,
            ..Load::default()
        };
        let mut motor = Motor::new(&load);
        (0..400).for_each(|_| motor.step(0.01, Feed::To(50.0), &ratings, &load));
        assert!((motor.rpm(&ratings) - 1440.0).abs() < 1e-6);
    }
}
