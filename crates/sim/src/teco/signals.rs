//! Status registers and outputs of the simulated TECO 7300PA (reference/drives.md 5.4).

use super::super::model::{AT_REFERENCE_BAND, Model, bit};
use super::options::DetectionLevels;
use super::{TecoDrive, fault, parameters};

/// Sn-20 to Sn-22: the output is switched by register 0009H.
const BY_REGISTER: u16 = 0x0F;
/// Outputs in the order of Sn-20 to Sn-22, of 0009H and of 002DH: R2A-R2C, DO1, R1A-R1C.
const OUTPUTS: u16 = 3;

impl TecoDrive {
    /// 0020H.
    pub(super) fn status(&self) -> u16 {
        bit(self.body.shows_running(), 1 << 0)
            | bit(self.body.turns_reverse(self.target()), 1 << 1)
            | bit(self.ready(), 1 << 2)
            | bit(self.body.latch.fault() != 0, 1 << 3)
            | (self.outputs() << 5)
    }

    /// 002CH.
    pub(super) fn inverter_status(&self) -> u16 {
        bit(self.body.shows_running(), 1 << 0)
            | bit(self.at_zero_speed(), 1 << 1)
            | bit(self.coincides(), 1 << 2)
            | bit(
                self.coincides() && self.near(self.parameters.tenths(parameters::CN_21)),
                1 << 3,
            )
            | bit(self.detected[0], 1 << 4)
            | bit(self.detected[1], 1 << 5)
            | bit(self.ready(), 1 << 6)
            | bit(self.body.latch.fault() & fault::POWER != 0, 1 << 7)
            | bit(self.baseblocked(), 1 << 8)
            | bit(!self.frequency_from_bus(), 1 << 9)
            | bit(!self.run_from_bus(), 1 << 10)
            | bit(self.overtorque_detected(), 1 << 11)
            | bit(self.body.latch.fault() != 0, 1 << 14)
    }

    /// 002DH: bit 0 R2A-R2C, bit 1 DO1, bit 2 R1A-R1C.
    pub(super) fn outputs(&self) -> u16 {
        (0..OUTPUTS).fold(0, |word, index| {
            let on = match self.parameters.number(parameters::SN_20 + index) {
                0 => self.body.shows_running(),
                1 => self.at_zero_speed(),
                2 => self.coincides(),
                BY_REGISTER => self.control.outputs & (1 << index) != 0,
                _ => false,
            };
            word | (u16::from(on) << index)
        })
    }

    fn at_zero_speed(&self) -> bool {
        self.body.motor.output == 0.0
    }

    /// Output within Cn-22 of the reference. A stopped drive does not follow a reference.
    fn coincides(&self) -> bool {
        self.body.running && self.body.shows_running() && self.near(self.frequency())
    }

    fn near(&self, frequency: f64) -> bool {
        // Even with a width of 0, an output at the frequency counts as near.
        let width = self.width().max(AT_REFERENCE_BAND);
        (self.body.motor.output.abs() - frequency).abs() < width
    }

    /// Cn-22, Hz.
    fn width(&self) -> f64 {
        self.parameters.tenths(parameters::CN_22)
    }

    fn overtorque_detected(&self) -> bool {
        self.overtorque > self.parameters.tenths(parameters::CN_27)
    }

    /// Frequency and overtorque detection, a step of `seconds` later.
    pub(super) fn detect(&mut self, seconds: f64) {
        let output = self.body.motor.output.abs();
        let (first, second) = match self.options.detection_levels {
            DetectionLevels::Cn21 => (parameters::CN_21, parameters::CN_21),
            DetectionLevels::Cn32AndCn33 => (parameters::CN_32, parameters::CN_33),
        };
        let (above, below, width) = (
            self.parameters.tenths(first),
            self.parameters.tenths(second),
            self.width(),
        );
        let [was_above, was_below] = self.detected;
        self.detected = [
            output > above || (was_above && output > (above - width).max(0.0)),
            output < below || (was_below && output < below + width),
        ];
        let level = f64::from(self.parameters.number(parameters::CN_26));
        if self.body.motor.torque.abs() > level {
            self.overtorque += seconds;
        } else {
            self.overtorque = 0.0;
        }
    }
}
