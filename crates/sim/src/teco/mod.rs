//! A simulated TECO 7300PA drive with its PA-C card, as described in reference/drives.md sections 5 and 10.
//!
//! Pure: the time is an argument. Cn-31 only supervises the link between the drive and its card, which never fails
//! here, so loss of the bus master changes nothing: the motor continues by its last command.

mod options;
mod parameters;
mod registers;
mod signals;
#[cfg(test)]
mod tests;

pub(crate) use options::{Mode, TecoOptions};

use std::collections::BTreeMap;

use self::parameters::{Parameters, function};
use super::SimTime;
use super::model::{Body, Command, Model, UPDATE_PERIOD, unsigned};
use super::motor::{Feed, Ratings};
use super::parameter_set::Writes;
use super::random::Random;
use drivegate_proto::{Exception, Reply, RequestPdu};

/// Bits of the operation signals, register 0001H (reference/drives.md 5.3).
pub(crate) mod operation {
    pub(crate) const RUN: u16 = 1 << 0;
    pub(crate) const REVERSE: u16 = 1 << 1;
    pub(crate) const EXTERNAL_FAULT: u16 = 1 << 2;
    /// Control bit: fault reset.
    pub(crate) const RESET: u16 = 1 << 3;
    /// Multifunction reference 1; 2 to 4 follow.
    pub(crate) const MULTIFUNCTION_1: u16 = 1 << 4;
}

/// Bits of the fault contents, register 0021H (reference/drives.md 5.4).
pub(crate) mod fault {
    /// Fault bit: overcurrent or ground fault.
    pub(crate) const OVERCURRENT: u16 = 1 << 0;
    pub(crate) const OVERVOLTAGE: u16 = 1 << 1;
    pub(crate) const INVERTER_OVERLOAD: u16 = 1 << 2;
    /// Fault bit: inverter overheat.
    pub(crate) const OVERHEAT: u16 = 1 << 3;
    /// Fault bit: external fault.
    pub(crate) const EXTERNAL: u16 = 1 << 7;
    pub(crate) const CONTROL_CIRCUIT: u16 = 1 << 8;
    pub(crate) const MOTOR_OVERLOAD: u16 = 1 << 9;
    /// Fault bit: undervoltage or power loss.
    pub(crate) const POWER: u16 = 1 << 12;
    /// All bits that have a meaning.
    pub(crate) const ALL: u16 =
        OVERCURRENT | OVERVOLTAGE | INVERTER_OVERLOAD | OVERHEAT | EXTERNAL | CONTROL_CIRCUIT | MOTOR_OVERLOAD | POWER;
}

/// Bits of the drive's terminals; bit 0 is terminal 1.
mod terminal {
    pub(super) const FORWARD: u16 = 1 << 0;
    pub(super) const REVERSE: u16 = 1 << 1;
    pub(super) const EXTERNAL_FAULT: u16 = 1 << 2;
    /// Terminal 5, multifunction reference 1; 6 to 8 follow.
    pub(super) const MULTIFUNCTION_1: u16 = 1 << 4;
}

/// The control registers that have a meaning.
#[derive(Debug, Clone, Copy, Default)]
struct Control {
    /// 0001H.
    operation: u16,
    /// 0002H, 0.01 Hz.
    frequency: u16,
    /// 0009H.
    outputs: u16,
    /// 000AH and 000BH.
    analogue: [u16; 2],
}

/// A simulated TECO 7300PA.
#[derive(Debug, Clone)]
pub(crate) struct TecoDrive {
    options: TecoOptions,
    parameters: Parameters,
    ratings: Ratings,
    body: Body,
    mode: Mode,
    control: Control,
    /// States of terminals 1 to 8.
    terminals: u16,
    /// State of frequency detections 1 and 2, which have a hysteresis.
    detected: [bool; 2],
    /// Time above the level of overtorque detection, s.
    overtorque: f64,
}

impl TecoDrive {
    /// A drive that is switched on at `now`, with the motor at rest.
    pub(crate) fn new(options: TecoOptions, now: SimTime) -> TecoDrive {
        let parameters = Parameters::new(options.digits, &options.parameters);
        TecoDrive {
            ratings: parameters.ratings(),
            body: Body::new(&options.load, now),
            mode: options.mode,
            control: Control::default(),
            terminals: 0,
            detected: [false; 2],
            overtorque: 0.0,
            parameters,
            options,
        }
    }

    /// Switches the operator between PRGM and DRIVE. A running motor is stopped and then needs a new run command.
    pub(crate) fn set_mode(&mut self, mode: Mode) {
        self.mode = mode;
        self.body.latch.disarm();
        self.take_over();
    }

    /// Closes and opens terminals 1 to 8, bit 0 terminal 1.
    #[cfg(test)]
    fn set_terminals(&mut self, closed: u8) {
        self.terminals = u16::from(closed);
        self.take_over();
    }

    /// A digit of Sn-08, counted from the last.
    fn operation_digit(&self, from_last: usize) -> bool {
        self.options
            .digits
            .is_set(self.parameters.number(parameters::SN_08), from_last)
    }

    /// Sn-08 `---0`.
    fn frequency_from_bus(&self) -> bool {
        !self.operation_digit(0)
    }

    /// Sn-08 `--0-`.
    fn run_from_bus(&self) -> bool {
        !self.operation_digit(1)
    }

    /// Whether the bus or the terminals order the motor to run.
    fn is_told_to_run(&self) -> bool {
        if self.run_from_bus() {
            self.control.operation & operation::RUN != 0
        } else {
            (self.terminals & terminal::FORWARD != 0) != (self.terminals & terminal::REVERSE != 0)
        }
    }

    /// Whether the present command turns the motor in reverse.
    fn is_told_to_reverse(&self) -> bool {
        if self.run_from_bus() {
            self.control.operation & operation::REVERSE != 0
        } else {
            self.terminals & terminal::REVERSE != 0
        }
    }

    /// Whether a multifunction reference or its terminal calls a function.
    fn calls(&self, wanted: u16) -> bool {
        (0..4u16).any(|index| {
            let on = self.control.operation & (operation::MULTIFUNCTION_1 << index) != 0
                || self.terminals & (terminal::MULTIFUNCTION_1 << index) != 0;
            on && self.parameters.number(parameters::SN_15 + index) == wanted
        })
    }

    fn baseblocked(&self) -> bool {
        self.calls(function::BASEBLOCK)
    }

    /// The frequency that holds now, Hz: jog, a multi-step frequency, or the main one, within Cn-15 and Cn-14.
    fn frequency(&self) -> f64 {
        let step = u16::from(self.calls(function::STEP_1)) + 2 * u16::from(self.calls(function::STEP_2));
        let hundredths = if self.calls(function::JOG) {
            self.parameters.number(parameters::AN_09)
        } else if step == 0 && self.frequency_from_bus() {
            self.control.frequency
        } else {
            self.parameters.number(parameters::AN_01 + step)
        };
        let bound = |register| self.ratings.maximum * f64::from(self.parameters.number(register)) / 100.0;
        (f64::from(hundredths) / 100.0)
            .max(bound(parameters::CN_14 + 1))
            .min(bound(parameters::CN_14))
    }

    /// Applies the effects that a change of a command or a terminal has at once: an external fault, and a run
    /// command that is switched off.
    fn take_over(&mut self) {
        if self.control.operation & operation::EXTERNAL_FAULT != 0 || self.terminals & terminal::EXTERNAL_FAULT != 0 {
            self.trip(fault::EXTERNAL);
        }
        let run = self.is_told_to_run();
        self.body.running = match self.mode {
            Mode::Drive => self.body.latch.obeys(run),
            Mode::Program => {
                self.body.latch.disarm();
                false
            }
        };
    }

    fn set_operation(&mut self, word: u16) {
        let risen = word & !self.control.operation;
        self.control.operation = word;
        if risen & operation::RESET != 0 {
            self.body.latch.reset();
        }
        self.take_over();
    }
}

impl Model for TecoDrive {
    fn body(&self) -> &Body {
        &self.body
    }

    fn body_mut(&mut self) -> &mut Body {
        &mut self.body
    }

    fn step(&mut self, _now: SimTime) {
        self.take_over();
        let feed = if self.body.latch.fault() != 0 || self.baseblocked() {
            Feed::Off
        } else {
            self.body.feed(self.target())
        };
        let seconds = UPDATE_PERIOD.as_secs_f64();
        self.body.motor.step(seconds, feed, &self.ratings, &self.options.load);
        self.detect(seconds);
    }

    fn ready(&self) -> bool {
        self.mode == Mode::Drive && self.body.latch.fault() == 0 && !self.baseblocked()
    }

    fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Option<Reply> {
        self.advance(now);
        Some(self.reply(request).unwrap_or_else(Reply::Exception))
    }

    fn malformed(&mut self, pdu: &[u8], exception: Exception, _now: SimTime) -> Option<Exception> {
        registers::refusal(pdu, exception)
    }

    fn check_error(&self) -> Option<Exception> {
        self.options.answer_check_error.then_some(registers::CHECK_ERROR)
    }

    fn broadcast(&mut self, request: &RequestPdu, now: SimTime) {
        self.advance(now);
        if registers::allows_broadcast(request) {
            let _refused_in_silence = self.reply(request);
        }
    }

    fn power_on(&mut self, now: SimTime) {
        let fresh = TecoDrive::new(self.options.clone(), now);
        let mut parameters = self.parameters.clone();
        parameters.reload();
        *self = TecoDrive {
            ratings: parameters.ratings(),
            parameters,
            terminals: self.terminals,
            ..fresh
        };
        self.body.latch.disarm();
        self.take_over();
    }

    fn parameter_writes(&self) -> BTreeMap<u16, Writes> {
        self.parameters.ram.writes().clone()
    }

    fn fill_parameters(&mut self, random: &mut Random) {
        self.parameters.fill(random);
        self.ratings = self.parameters.ratings();
    }

    fn trip(&mut self, fault: u16) {
        self.body.trip(fault & fault::ALL);
    }

    fn remote(&self) -> bool {
        self.run_from_bus()
    }

    fn target(&self) -> f64 {
        if self.is_told_to_reverse() {
            -self.frequency()
        } else {
            self.frequency()
        }
    }

    fn usual_faults(&self) -> &'static [u16] {
        &[fault::OVERCURRENT, fault::OVERHEAT, fault::MOTOR_OVERLOAD, fault::POWER]
    }

    fn command(&mut self, command: Command) {
        self.control.frequency = unsigned(command.share() * self.ratings.maximum * 100.0);
        let rest = self.control.operation & !(operation::RUN | operation::REVERSE);
        let reverse = command.is_reverse();
        self.set_operation(
            rest | (u16::from(command.run) * operation::RUN) | (u16::from(reverse) * operation::REVERSE),
        );
    }

    fn set_programming(&mut self, on: bool) {
        self.set_mode(if on { Mode::Program } else { Mode::Drive });
    }

    fn set_reset(&mut self, on: bool) {
        let rest = self.control.operation & !operation::RESET;
        self.set_operation(rest | if on { operation::RESET } else { 0 });
    }

    /// Sn-08 in RAM: 1100, or 1111 for operator and terminals.
    fn set_remote(&mut self, on: bool) {
        let word = self.options.digits.register([true, true, !on, !on]);
        let _ = self.parameters.ram.set(parameters::SN_08, word);
        self.take_over();
    }
}
