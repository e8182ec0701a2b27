//! A Vacon NX drive with its OPTC2 or OPTC8 board, as drives.md section 3 and 10 describe it.
//!
//! Pure: the time is an argument, and the drive works in steps of 10 ms, its update period. At each step it takes over
//! the process data in and refreshes the process data out, so a bit that a master sets and clears within one step is
//! never seen, as on the real drive.

pub mod motor;
mod options;
pub mod parameters;
mod registers;
#[cfg(test)]
mod tests;

pub use motor::Load;
pub use options::{NxOptions, StatusBits, Values};
pub use registers::{Beyond, Hole, Limits, ReadOnly};

use self::motor::{Drive, Motor};
use self::parameters::{Parameters, Settings, StopFunction};
use super::SimTime;
use std::time::Duration;

/// Inputs are taken over and outputs refreshed every 10 ms (drives.md 3.3).
pub const UPDATE_PERIOD: Duration = Duration::from_millis(10);

/// A drive that nobody looked at for longer skips the rest of the time instead of living through it.
const LONGEST_CATCH_UP: Duration = Duration::from_secs(600);

/// Registers of process data in and out, IDs 2001..=2011 and 2101..=2111.
const PROCESS_DATA: usize = 11;

/// Control word, ID 2001 (drives.md 3.4).
pub mod control_word {
    /// Run.
    pub const RUN: u16 = 1 << 0;
    /// Counterclockwise.
    pub const REVERSE: u16 = 1 << 1;
    /// Fault reset by rising edge.
    pub const RESET: u16 = 1 << 2;
}

/// Status word, ID 2101 (drives.md 3.6).
pub mod status_word {
    /// Ready.
    pub const READY: u16 = 1 << 0;
    /// Running.
    pub const RUN: u16 = 1 << 1;
    /// Counterclockwise.
    pub const REVERSE: u16 = 1 << 2;
    /// Faulted.
    pub const FAULT: u16 = 1 << 3;
    /// Warning.
    pub const WARNING: u16 = 1 << 4;
    /// Reference reached.
    pub const AT_REFERENCE: u16 = 1 << 5;
    /// Motor at zero speed.
    pub const ZERO_SPEED: u16 = 1 << 6;
    /// Flux ready.
    pub const FLUX_READY: u16 = 1 << 7;
    /// Torque control's speed limit is **not** active.
    pub const NO_SPEED_LIMIT: u16 = 1 << 8;
    /// Encoder sees counterclockwise.
    pub const ENCODER_REVERSE: u16 = 1 << 9;
    /// Undervoltage fast stop is **not** active.
    pub const NO_UNDERVOLTAGE_STOP: u16 = 1 << 10;
    /// The bits that all drives of the family have.
    pub const COMMON: u16 = READY | RUN | REVERSE | FAULT | WARNING | AT_REFERENCE;
}

/// Fault code: fieldbus fault (drives.md 3.11).
pub const FIELDBUS_FAULT: u16 = 53;

/// Output and reference closer than this count as reached, Hz: below what a register can show.
const AT_REFERENCE_BAND: f64 = 0.005;

/// Where a drive takes its commands from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlPlace {
    /// I/O terminals.
    Terminals,
    /// Panel.
    Panel,
    /// Fieldbus.
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

    /// Its bit in the general status word, ID 2102 (drives.md 3.7).
    fn status_bit(self) -> u16 {
        match self {
            ControlPlace::Fieldbus => 1 << 13,
            ControlPlace::Panel => 1 << 14,
            ControlPlace::Terminals => 1 << 15,
        }
    }
}

/// Run, direction and speed from whoever has the control place.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Command {
    /// Run.
    pub run: bool,
    /// Counterclockwise.
    pub reverse: bool,
    /// Speed reference, 0.01 % of the band between minimum and maximum frequency, -10000..=10000.
    pub reference: i16,
}

/// What a drive looks like from outside, for tests and for the demo's display.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NxState {
    /// Status word, ID 2101.
    pub status: u16,
    /// Control word as a master wrote it, ID 2001.
    pub control: u16,
    /// Speed reference as a master wrote it, ID 2003, 0.01 %.
    pub reference: i16,
    /// Output frequency, Hz.
    pub output: f64,
    /// Active fault, 0 for none.
    pub fault: u16,
}

/// A simulated Vacon NX.
#[derive(Debug, Clone)]
pub struct NxDrive {
    options: NxOptions,
    parameters: Parameters,
    settings: Settings,
    motor: Motor,
    /// Process data in as written, IDs 2001 to 2011.
    input: [u16; PROCESS_DATA],
    /// Process data out as last refreshed, IDs 2101 to 2111.
    output: [u16; PROCESS_DATA],
    /// Control word of the step before, for edges.
    last_control: u16,
    /// Commands of panel and terminals.
    local: Command,
    /// A run bit is obeyed only after it was seen 0 without a fault.
    armed: bool,
    running: bool,
    /// A fault that stops by ramp: the motor is still brought down.
    stopping: bool,
    fault: u16,
    warning: bool,
    lost_master: bool,
    interlock: bool,
    powered: bool,
    busy_until: SimTime,
    heard: Option<SimTime>,
    next_step: SimTime,
}

impl NxDrive {
    /// A drive that is switched on at `now`, with the motor at rest.
    pub fn new(options: NxOptions, now: SimTime) -> NxDrive {
        let mut parameters = Parameters::default();
        for &(id, value) in &options.parameters {
            let _ = parameters.set(id, value);
        }
        let mut drive = NxDrive {
            settings: parameters.settings(),
            motor: Motor::new(&options.load),
            parameters,
            options,
            input: [0; PROCESS_DATA],
            output: [0; PROCESS_DATA],
            last_control: 0,
            local: Command::default(),
            armed: true,
            running: false,
            stopping: false,
            fault: 0,
            warning: false,
            lost_master: false,
            interlock: false,
            powered: true,
            busy_until: SimTime::ZERO,
            heard: None,
            next_step: now + UPDATE_PERIOD,
        };
        drive.refresh();
        drive
    }

    /// Lives on until `now`, in steps of the update period.
    pub fn advance(&mut self, now: SimTime) {
        if now.saturating_sub(self.next_step) > LONGEST_CATCH_UP {
            self.next_step = now - LONGEST_CATCH_UP;
        }
        while self.next_step <= now {
            let at = self.next_step;
            self.next_step += UPDATE_PERIOD;
            if self.powered {
                self.step(at);
            }
        }
    }

    /// A valid message to this drive or to all was on the bus: restarts the supervision.
    pub fn heard(&mut self, now: SimTime) {
        self.heard = Some(now);
        self.lost_master = false;
    }

    /// Trips the drive with a fault code; 0 does nothing.
    pub fn trip(&mut self, code: u16) {
        self.fail(code, StopFunction::Coast);
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

    /// Hands control to the fieldbus, the panel or the terminals, as parameter ID 125 does.
    pub fn set_control_place(&mut self, place: ControlPlace) {
        let _ = self.parameters.set(parameters::CONTROL_PLACE, place.parameter());
        self.settings = self.parameters.settings();
    }

    /// What panel and terminals command; obeyed while one of them is the control place.
    pub fn set_local(&mut self, command: Command) {
        self.local = command;
    }

    /// Writes process data in as another master on the bus would: control word and speed reference.
    pub fn set_fieldbus(&mut self, command: Command) {
        let word = u16::from(command.run) * control_word::RUN + u16::from(command.reverse) * control_word::REVERSE;
        self.set_input(0, word);
        self.set_input(2, command.reference as u16);
    }

    /// Pulls the fault reset bit up or down.
    pub fn set_reset(&mut self, on: bool) {
        let rest = self.input(0) & !control_word::RESET;
        self.set_input(0, rest | if on { control_word::RESET } else { 0 });
    }

    /// Switches the supply off: the drive answers nothing and the motor coasts unseen.
    pub fn power_off(&mut self) {
        self.powered = false;
    }

    /// Switches the supply on again: process data is 0, faults are gone, parameters are kept.
    pub fn power_on(&mut self, now: SimTime) {
        let kept = std::mem::take(&mut self.options.parameters);
        let mut fresh = NxDrive::new(self.options.clone(), now);
        fresh.options.parameters = kept;
        fresh.parameters = self.parameters.clone();
        fresh.settings = fresh.parameters.settings();
        fresh.refresh();
        *self = fresh;
    }

    /// Whether the drive has supply; without it, it answers nothing.
    pub fn powered(&self) -> bool {
        self.powered
    }

    /// What the drive looks like from outside.
    pub fn state(&self) -> NxState {
        NxState {
            status: self.status(),
            control: self.input(0),
            reference: self.input(2) as i16,
            output: self.motor.output,
            fault: self.fault,
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
        if code == 0 || self.fault != 0 {
            return;
        }
        self.stopping = stop == StopFunction::Ramp && self.motor.fed;
        self.fault = code;
        self.running = false;
        self.armed = false;
    }

    /// One update period: supervision, commands, motor, process data out.
    fn step(&mut self, now: SimTime) {
        self.supervise(now);
        let command = self.take_over();
        if !command.run && self.fault == 0 {
            self.armed = true;
        }
        let may_run = self.fault == 0 && !self.interlock;
        self.running = command.run && self.armed && may_run;
        let target = self.target(command);
        // A ramped stop keeps the inverter on until the motor stands.
        let ramping_down = self.motor.fed
            && self.motor.output != 0.0
            && if self.fault == 0 {
                self.settings.stop == StopFunction::Ramp && !self.interlock
            } else {
                self.stopping
            };
        let drive = match (self.running, ramping_down) {
            (true, _) => Drive::To(target),
            (false, true) => Drive::To(0.0),
            (false, false) => Drive::Off,
        };
        self.motor
            .step(UPDATE_PERIOD.as_secs_f64(), drive, &self.settings, &self.options.load);
        self.refresh();
    }

    /// The drive's own bus watchdog and P2.7.22 (drives.md 3.11). It starts with the first message: a board that never
    /// heard a master waits for one.
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

    /// Takes the process data in over; the control word counts only while fieldbus is the control place.
    fn take_over(&mut self) -> Command {
        let word = self.input(0);
        let risen = word & !self.last_control;
        self.last_control = word;
        if self.settings.place != ControlPlace::Fieldbus {
            return self.local;
        }
        if risen & control_word::RESET != 0 {
            self.fault = 0;
            self.stopping = false;
        }
        Command {
            run: word & control_word::RUN != 0,
            reverse: word & control_word::REVERSE != 0,
            reference: self.input(2) as i16,
        }
    }

    /// f = fmin + reference/10000 x (fmax - fmin), the sign exclusive-or the direction bit (drives.md 3.5).
    fn target(&self, command: Command) -> f64 {
        let share = f64::from(command.reference.unsigned_abs()).min(10_000.0) / 10_000.0;
        let frequency = self.settings.minimum + share * (self.settings.maximum - self.settings.minimum);
        if command.reverse != (command.reference < 0) {
            -frequency
        } else {
            frequency
        }
    }

    /// The command that holds now, for the at-reference bit and ID 25.
    fn command(&self) -> Command {
        match self.settings.place {
            ControlPlace::Fieldbus => Command {
                run: self.last_control & control_word::RUN != 0,
                reverse: self.last_control & control_word::REVERSE != 0,
                reference: self.input(2) as i16,
            },
            _ => self.local,
        }
    }

    fn status(&self) -> u16 {
        let motor = &self.motor;
        let bit = |on: bool, mask: u16| if on { mask } else { 0 };
        let reached = self.running && (motor.output - self.target(self.command())).abs() < AT_REFERENCE_BAND;
        let warned = self.warning || (self.lost_master && self.settings.fieldbus_fault == 1);
        let word = bit(self.fault == 0 && !self.interlock, status_word::READY)
            | bit(motor.fed && self.fault == 0, status_word::RUN)
            | bit(self.turns_reverse(), status_word::REVERSE)
            | bit(self.fault != 0, status_word::FAULT)
            | bit(warned, status_word::WARNING)
            | bit(reached, status_word::AT_REFERENCE)
            | bit(motor.shaft == 0.0, status_word::ZERO_SPEED)
            | bit(motor.fed, status_word::FLUX_READY)
            | bit(motor.shaft < 0.0, status_word::ENCODER_REVERSE)
            | status_word::NO_SPEED_LIMIT
            | status_word::NO_UNDERVOLTAGE_STOP;
        match self.options.status {
            StatusBits::Full => word,
            StatusBits::Common => word & status_word::COMMON,
        }
    }

    /// The direction that the motor turns in; at rest, the one a running drive is about to turn it in.
    fn turns_reverse(&self) -> bool {
        let shaft = self.motor.shaft;
        shaft < 0.0 || (shaft == 0.0 && self.running && self.target(self.command()) < 0.0)
    }
}
