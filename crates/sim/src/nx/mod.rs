//! A simulated Vacon NX, Eaton SVX or Eaton HVX drive with its OPTC2 or OPTC8 board, as described in
//! reference/drives.md sections 3 and 10.
//!
//! Pure: the time is an argument, and the drive works in steps of 10 ms, its update period. At each step it takes
//! over the process data in and updates the process data out, so a bit that a master sets and clears within one
//! step has no effect, as on the real drive.

#[cfg(test)]
mod eaton_tests;
mod options;
pub mod parameters;
mod registers;
mod signals;
#[cfg(test)]
mod tests;

pub use super::model::{Beyond, Command, ReadOnly, UPDATE_PERIOD};
pub use super::motor::Load;
pub use options::{Base, NxOptions, SpeedReference, Unit, Values};
pub use registers::{Hole, Limits};
pub use signals::StatusBits;

use std::collections::BTreeMap;

use self::parameters::{Settings, StopFunction, parameters};
use super::SimTime;
use super::model::{AT_REFERENCE_BAND, Body, Model};
use super::motor::Feed;
use super::parameter_set::{ParameterSet, Writes};
use super::random::Random;
use drivegate_proto::{Reply, RequestPdu};

/// Registers of process data in and out, IDs 2001..=2011 and 2101..=2111.
const PROCESS_DATA: usize = 11;

/// Control word, ID 2001 (reference/drives.md 3.4).
pub mod control_word {
    pub const RUN: u16 = 1 << 0;
    /// Control word bit: counterclockwise.
    pub const REVERSE: u16 = 1 << 1;
    /// Control word bit: fault reset by rising edge.
    pub const RESET: u16 = 1 << 2;
    /// HVX: enable bypass.
    pub const BYPASS: u16 = 1 << 3;
    /// HVX: pass through to relay output RO1.
    pub const RELAY_1: u16 = 1 << 10;
    /// HVX: pass through to relay output RO2.
    pub const RELAY_2: u16 = 1 << 11;
    /// HVX: pass through to digital output DO1.
    pub const DIGITAL_OUTPUT: u16 = 1 << 12;
    /// HVX: activate fire mode.
    pub const FIRE_MODE: u16 = 1 << 13;
}

/// Status word, ID 2101 (reference/drives.md 3.6).
pub mod status_word {
    pub const READY: u16 = 1 << 0;
    /// Status word bit: running.
    pub const RUN: u16 = 1 << 1;
    /// Status word bit: counterclockwise.
    pub const REVERSE: u16 = 1 << 2;
    pub const FAULT: u16 = 1 << 3;
    pub const WARNING: u16 = 1 << 4;
    /// Status word bit: reference reached.
    pub const AT_REFERENCE: u16 = 1 << 5;
    /// Status word bit: motor at zero speed.
    pub const ZERO_SPEED: u16 = 1 << 6;
    pub const FLUX_READY: u16 = 1 << 7;
    /// Torque control's speed limit is **not** active.
    pub const NO_SPEED_LIMIT: u16 = 1 << 8;
    /// The encoder detects counterclockwise rotation.
    pub const ENCODER_REVERSE: u16 = 1 << 9;
    /// Status bit: undervoltage fast stop is **not** active.
    pub const NO_UNDERVOLTAGE_STOP: u16 = 1 << 10;
    /// HVX: bypass activated.
    pub const BYPASS: u16 = 1 << 6;
    /// HVX: fire mode activated.
    pub const FIRE_MODE: u16 = 1 << 7;
    /// HVX: **not** interlocked.
    pub const NOT_INTERLOCKED: u16 = 1 << 8;
}

/// Fault code: fieldbus fault (reference/drives.md 3.11).
pub const FIELDBUS_FAULT: u16 = 53;

/// Control place from which a drive takes its commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlPlace {
    /// Control by the I/O terminals.
    Terminals,
    Panel,
    Fieldbus,
}

impl ControlPlace {
    fn from_parameter(value: u16) -> ControlPlace {
        match value {
            1 => ControlPlace::Terminals,
            2 => ControlPlace::Panel,
            _ => ControlPlace::Fieldbus,
        }
    }

    fn parameter(self) -> u16 {
        match self {
            ControlPlace::Terminals => 1,
            ControlPlace::Panel => 2,
            ControlPlace::Fieldbus => 3,
        }
    }
}

/// State of a drive as seen from outside, for tests and for the demo's display.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NxState {
    /// Status word, ID 2101.
    pub status: u16,
    /// Control word that a master wrote, ID 2001.
    pub control: u16,
    /// Speed reference that a master wrote, ID 2003, 0.01 %.
    pub reference: i16,
    /// Output frequency, Hz.
    pub output: f64,
    /// Active fault, 0 for none.
    pub fault: u16,
}

/// A simulated Vacon NX, Eaton SVX or HVX.
#[derive(Debug, Clone)]
pub struct NxDrive {
    options: NxOptions,
    parameters: ParameterSet,
    settings: Settings,
    body: Body,
    /// Process data in as written, IDs 2001 to 2011.
    input: [u16; PROCESS_DATA],
    /// Process data out as last refreshed, IDs 2101 to 2111.
    output: [u16; PROCESS_DATA],
    /// Control word of the step before, for edges.
    last_control: u16,
    /// Commands of panel and terminals.
    local: Command,
    /// A fault that stops by ramp: the motor is still brought down.
    stopping: bool,
    warning: bool,
    lost_master: bool,
    interlock: bool,
    /// Whether the hand-off-auto switch of an HVX is at off.
    switched_off: bool,
    busy_until: SimTime,
    heard: Option<SimTime>,
}

impl NxDrive {
    /// A drive that is switched on at `now`, with the motor at rest.
    pub fn new(options: NxOptions, now: SimTime) -> NxDrive {
        let mut parameters = parameters();
        for &(id, value) in &options.parameters {
            let _ = parameters.set(id, value);
        }
        let mut drive = NxDrive {
            settings: Settings::of(&parameters),
            body: Body::new(&options.load, now),
            parameters,
            options,
            input: [0; PROCESS_DATA],
            output: [0; PROCESS_DATA],
            last_control: 0,
            local: Command::default(),
            stopping: false,
            warning: false,
            lost_master: false,
            interlock: false,
            switched_off: false,
            busy_until: SimTime::ZERO,
            heard: None,
        };
        drive.refresh_output();
        drive
    }

    /// Sets or clears the warning bit.
    pub fn set_warning(&mut self, on: bool) {
        self.warning = on;
    }

    /// Opens or closes the run interlock: an interlocked drive is not ready and does not run.
    pub fn set_interlock(&mut self, on: bool) {
        self.interlock = on;
    }

    /// Answers every request before `until` with exception 06.
    pub fn set_busy(&mut self, until: SimTime) {
        self.busy_until = until;
    }

    /// Gives control to the fieldbus, the panel or the terminals, as parameter ID 125 does.
    pub fn set_control_place(&mut self, place: ControlPlace) {
        let _ = self.parameters.set(parameters::CONTROL_PLACE, place.parameter());
        self.settings = Settings::of(&self.parameters);
    }

    /// Sets the commands from panel and terminals, which are obeyed while one of them is the control place.
    pub fn set_local(&mut self, command: Command) {
        self.local = command;
    }

    /// Turns the hand-off-auto switch of an HVX to off, or to the position of the control place.
    pub fn set_switched_off(&mut self, off: bool) {
        self.switched_off = off;
    }

    /// State of the drive as seen from outside.
    pub fn state(&self) -> NxState {
        NxState {
            status: self.status(),
            control: self.input(0),
            reference: self.input(2) as i16,
            output: self.body.motor.output,
            fault: self.body.latch.fault(),
        }
    }

    fn input(&self, index: usize) -> u16 {
        self.input.get(index).copied().unwrap_or(0)
    }

    fn set_input(&mut self, index: usize, value: u16) {
        if let Some(register) = self.input.get_mut(index) {
            *register = value;
        }
    }

    fn fail(&mut self, code: u16, stop: StopFunction) {
        if self.body.latch.trip(code) {
            self.stopping = stop == StopFunction::Ramp && self.body.motor.fed;
            self.body.running = false;
            if !self.stopping {
                self.body.motor.release();
            }
        }
    }

    /// The drive's own bus watchdog and P2.7.22 (reference/drives.md 3.11). The watchdog starts with the first message: a board
    /// that never received one waits.
    fn supervise(&mut self, now: SimTime) {
        let Some(heard) = self.heard else { return };
        let limit = self.options.timeout;
        if limit.is_zero() || self.lost_master || now.saturating_sub(heard) <= limit {
            return;
        }
        self.lost_master = true;
        match self.settings.fieldbus_fault {
            2 => self.fail(FIELDBUS_FAULT, self.settings.stop),
            3 => self.fail(FIELDBUS_FAULT, StopFunction::Coast),
            _ => {}
        }
    }

    /// Takes over the process data in; the control word is only obeyed while the fieldbus is the control place.
    fn take_over(&mut self) -> Command {
        let word = self.input(0);
        let risen = word & !self.last_control;
        self.last_control = word;
        if self.settings.place == ControlPlace::Fieldbus && risen & control_word::RESET != 0 {
            self.body.latch.reset();
            self.stopping = false;
        }
        self.held()
    }

    /// A control word bit that only the HVX has, while the control word is obeyed.
    fn hvac(&self, mask: u16) -> bool {
        self.options.hvac_control && self.settings.place == ControlPlace::Fieldbus && self.last_control & mask != 0
    }

    /// Whether the motor runs on the mains, so that the inverter is off. An interlock opens the bypass too.
    fn bypassed(&self) -> bool {
        self.hvac(control_word::BYPASS) && !self.interlock
    }

    /// Whether fire mode runs the motor at the maximum frequency, regardless of run bit and reference.
    fn fire_mode(&self) -> bool {
        self.hvac(control_word::FIRE_MODE)
    }

    /// The output frequency for a command, reference/drives.md 3.5: the sign exclusive-or the direction bit.
    fn frequency(&self, command: Command) -> f64 {
        let (minimum, maximum) = (self.settings.minimum, self.settings.motor.maximum);
        if self.fire_mode() {
            return maximum;
        }
        let size = f64::from(command.reference.unsigned_abs());
        let rule = self.options.reference;
        let frequency = match (rule.unit, rule.base) {
            (Unit::Percent, Base::Band) => minimum + size.min(10_000.0) / 10_000.0 * (maximum - minimum),
            (Unit::Percent, Base::Maximum) => (size.min(10_000.0) / 10_000.0 * maximum).max(minimum),
            (Unit::Hertz, _) => (size / 100.0).min(maximum).max(minimum),
        };
        command.directed(frequency)
    }

    /// The command in force.
    fn held(&self) -> Command {
        match self.settings.place {
            ControlPlace::Fieldbus => Command {
                run: self.last_control & control_word::RUN != 0 || self.fire_mode(),
                reverse: self.last_control & control_word::REVERSE != 0,
                reference: self.input(2) as i16,
            },
            _ => self.local,
        }
    }
}

impl Model for NxDrive {
    fn body(&self) -> &Body {
        &self.body
    }

    fn body_mut(&mut self) -> &mut Body {
        &mut self.body
    }

    /// Advances by one update period: supervision, commands, motor.
    fn step(&mut self, now: SimTime) {
        self.supervise(now);
        let command = self.take_over();
        let free = !self.interlock && !self.switched_off && !self.bypassed();
        self.body.running = self.body.latch.obeys(command.run) && free;
        let target = self.frequency(command);
        // A ramped stop keeps the inverter on until the motor has stopped.
        let ramping_down = self.body.motor.fed
            && self.body.motor.output != 0.0
            && if self.body.latch.fault() == 0 {
                self.settings.stop == StopFunction::Ramp && free
            } else {
                self.stopping
            };
        let feed = match (self.body.running, ramping_down) {
            (true, _) => Feed::To(target),
            (false, true) => Feed::To(0.0),
            (false, false) => Feed::Off,
        };
        self.body.motor.step(
            UPDATE_PERIOD.as_secs_f64(),
            feed,
            &self.settings.motor,
            &self.options.load,
        );
    }

    fn refresh(&mut self) {
        self.refresh_output();
    }

    fn ready(&self) -> bool {
        self.body.latch.fault() == 0 && !self.interlock
    }

    fn target(&self) -> f64 {
        self.frequency(self.held())
    }

    fn remote(&self) -> bool {
        self.settings.place == ControlPlace::Fieldbus
    }

    fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Option<Reply> {
        self.advance(now);
        self.message_received(now);
        Some(self.reply(request, now))
    }

    fn broadcast(&mut self, request: &RequestPdu, now: SimTime) {
        self.advance(now);
        self.message_received(now);
        if matches!(
            request,
            RequestPdu::WriteRegister { .. } | RequestPdu::WriteRegisters { .. }
        ) {
            self.reply(request, now);
        }
    }

    /// Restarts the supervision time.
    fn message_received(&mut self, now: SimTime) {
        self.heard = Some(now);
        self.lost_master = false;
    }

    fn power_on(&mut self, now: SimTime) {
        let mut fresh = NxDrive::new(self.options.clone(), now);
        fresh.parameters = self.parameters.clone();
        fresh.settings = Settings::of(&fresh.parameters);
        fresh.refresh_output();
        *self = fresh;
    }

    fn parameter_writes(&self) -> BTreeMap<u16, Writes> {
        let writes = self.parameters.writes().iter();
        writes.map(|(id, writes)| (id.saturating_sub(1), *writes)).collect()
    }

    fn fill_parameters(&mut self, random: &mut Random) {
        self.parameters.fill(random, &[parameters::CONTROL_PLACE]);
        self.settings = Settings::of(&self.parameters);
    }

    fn trip(&mut self, fault: u16) {
        self.fail(fault, StopFunction::Coast);
    }

    /// Overcurrent, drive overtemperature, motor underload, external fault.
    fn usual_faults(&self) -> &'static [u16] {
        &[1, 14, 17, 51]
    }

    fn command(&mut self, command: Command) {
        let word = u16::from(command.run) * control_word::RUN + u16::from(command.reverse) * control_word::REVERSE;
        self.set_input(0, word);
        self.set_input(2, command.reference as u16);
    }

    fn set_reset(&mut self, on: bool) {
        let rest = self.input(0) & !control_word::RESET;
        self.set_input(0, rest | if on { control_word::RESET } else { 0 });
    }

    fn set_remote(&mut self, on: bool) {
        self.set_control_place(if on {
            ControlPlace::Fieldbus
        } else {
            ControlPlace::Panel
        });
    }
}
