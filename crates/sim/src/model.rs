//! The interface of a simulated drive of any model, for line, board, autopilot and tests.

use super::SimTime;
use super::motor::{Feed, Load, Motor};
use super::parameter_set::Writes;
use super::random::Random;
use drivegate_proto::{Exception, Reply, RequestPdu};
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

/// A simulated drive advances in steps of this length: the update period of the Vacon boards (reference/drives.md 3.3).
pub const UPDATE_PERIOD: Duration = Duration::from_millis(10);

/// A drive that was not advanced for longer skips the rest of the time.
const LONGEST_CATCH_UP: Duration = Duration::from_secs(600);

/// Difference of output and reference in Hz below which the reference counts as reached: less than a register can show.
pub(crate) const AT_REFERENCE_BAND: f64 = 0.005;

/// Run, direction and speed from any source that commands a drive.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Command {
    pub run: bool,
    /// Whether the direction is counterclockwise.
    pub reverse: bool,
    /// Speed reference in units of 0.01 % of the drive's 100 %, -10000..=10000.
    pub reference: i16,
}

impl Command {
    /// Share of the drive's 100 %, at most 1, whatever the direction.
    pub(super) fn share(self) -> f64 {
        f64::from(self.reference.unsigned_abs()).min(10_000.0) / 10_000.0
    }

    /// Whether the motor turns counterclockwise: by the direction or a negative reference, but not by both.
    pub(super) fn is_reverse(self) -> bool {
        self.reverse != (self.reference < 0)
    }

    /// A frequency with the sign of the direction.
    pub(super) fn directed(self, frequency: f64) -> f64 {
        if self.is_reverse() { -frequency } else { frequency }
    }
}

/// State of any drive as seen from outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveState {
    /// Whether the drive would run on a run command.
    pub ready: bool,
    /// Whether the inverter feeds the motor.
    pub running: bool,
    /// The motor turns counterclockwise, or is about to.
    pub reverse: bool,
    /// Active fault as the drive's registers show it; 0 for no fault.
    pub fault: u16,
    /// Output frequency, Hz, negative for counterclockwise.
    pub output: f64,
    /// Whether the drive obeys the bus.
    pub remote: bool,
}

/// The parts that every simulated drive has, whatever its model.
#[derive(Debug, Clone)]
pub(crate) struct Body {
    pub(super) motor: Motor,
    pub(super) latch: Latch,
    /// Whether a run command is obeyed.
    pub(super) running: bool,
    powered: bool,
    steps: Steps,
}

impl Body {
    /// Switched on at `now`, with the motor at rest.
    pub(super) fn new(load: &Load, now: SimTime) -> Body {
        Body {
            motor: Motor::new(load),
            latch: Latch::new(),
            running: false,
            powered: true,
            steps: Steps::new(now),
        }
    }

    /// Whether the inverter feeds the motor and no fault hides that.
    pub(super) fn shows_running(&self) -> bool {
        self.motor.fed && self.latch.fault() == 0
    }

    /// Whether the motor turns in reverse; at rest, whether a running drive is about to turn it in reverse, from
    /// its target frequency.
    pub(super) fn turns_reverse(&self, target: f64) -> bool {
        let shaft = self.motor.shaft;
        shaft < 0.0 || (shaft == 0.0 && self.running && target < 0.0)
    }

    /// What feeds the motor of a healthy drive: its target while it runs, then the ramp down to standstill.
    pub(super) fn feed(&self, target: f64) -> Feed {
        if self.running {
            Feed::To(target)
        } else if self.motor.fed && self.motor.output != 0.0 {
            Feed::To(0.0)
        } else {
            Feed::Off
        }
    }

    /// A fault, with which the motor coasts.
    pub(super) fn trip(&mut self, fault: u16) {
        if self.latch.trip(fault) {
            self.running = false;
            self.motor.release();
        }
    }
}

/// A simulated drive with its Modbus board.
///
/// Pure: the time is an argument and never goes back. No method panics for any argument.
pub(crate) trait Model: fmt::Debug {
    /// The parts that the drive has in common with all models.
    fn body(&self) -> &Body;

    /// The common parts of the drive, mutable.
    fn body_mut(&mut self) -> &mut Body;

    /// Advances the drive by one update period, which ends at `now`.
    fn step(&mut self, now: SimTime);

    /// Updates the values that a master can read; called after the last of several steps.
    fn refresh(&mut self) {}

    /// Whether the drive would run on a run command.
    fn ready(&self) -> bool;

    /// Target frequency by the command in force, Hz, negative for counterclockwise.
    fn target(&self) -> f64;

    /// Whether the drive obeys the bus.
    fn remote(&self) -> bool;

    /// Advances to `now`, in steps of [`UPDATE_PERIOD`].
    fn advance(&mut self, now: SimTime) {
        let mut stepped = false;
        while let Some(at) = self.body_mut().steps.due(now) {
            if self.body().powered {
                self.step(at);
                stepped = true;
            }
        }
        if stepped {
            self.refresh();
        }
    }

    /// The reply to a request to this drive that was complete at `now`; `None` for silence.
    fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Option<Reply>;

    /// The answer to a valid frame to this drive whose PDU the protocol does not know, where a plain slave returns
    /// `exception`; `None` for silence.
    fn malformed(&mut self, _pdu: &[u8], exception: Exception, now: SimTime) -> Option<Exception> {
        self.message_received(now);
        Some(exception)
    }

    /// Processes a request to all drives.
    fn broadcast(&mut self, request: &RequestPdu, now: SimTime);

    /// Notes a valid message on the bus to this drive or to all drives.
    fn message_received(&mut self, _now: SimTime) {}

    /// Notes a valid frame on the line to any address. Called before the frame takes effect.
    fn bus_message(&mut self) {}

    /// A frame with a wrong check code was on the line.
    fn bus_error(&mut self) {}

    /// The answer to a frame to this drive with a wrong check code; `None` for silence.
    fn check_error(&self) -> Option<Exception> {
        None
    }

    /// Whether the drive has supply; without supply, the drive does not answer.
    fn powered(&self) -> bool {
        self.body().powered
    }

    /// Switches the supply off: the drive does not answer, and its coasting motor is not shown.
    fn power_off(&mut self) {
        self.body_mut().powered = false;
    }

    /// Switches the supply on again: commands are 0, faults are cleared, parameters have their stored values.
    fn power_on(&mut self, now: SimTime);

    /// Trips the drive with this fault, coded as in its registers; 0 does nothing, and a second fault is ignored.
    fn trip(&mut self, fault: u16) {
        self.body_mut().trip(fault);
    }

    /// Writes over the bus into parameters, by PDU address.
    fn parameter_writes(&self) -> BTreeMap<u16, Writes>;

    /// Gives its parameters random valid values, but keeps where it takes commands from.
    fn fill_parameters(&mut self, random: &mut Random);

    /// Faults that occur now and then, for the autopilot.
    fn usual_faults(&self) -> &'static [u16];

    /// Commands the drive as another master on the bus would.
    fn command(&mut self, command: Command);

    /// Pulls the fault reset bit of the bus up or down.
    fn set_reset(&mut self, on: bool);

    /// Gives control of the drive to the bus, or to panel or terminals.
    fn set_remote(&mut self, on: bool);

    /// Switches the mode in which the drive accepts all parameters and does not run. Drives without such a mode do
    /// not change.
    fn set_programming(&mut self, _on: bool) {}

    /// State of the drive as seen from outside.
    fn state(&self) -> DriveState {
        let body = self.body();
        DriveState {
            ready: self.ready(),
            running: body.shows_running(),
            reverse: body.turns_reverse(self.target()),
            fault: body.latch.fault(),
            output: body.motor.output,
            remote: self.remote(),
        }
    }
}

/// The answer to a count beyond the limit of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beyond {
    /// Exception 03, illegal data value.
    Value,
    /// Exception 02, illegal data address.
    Address,
}

impl Beyond {
    /// Checks that a message may contain this number of items.
    ///
    /// # Errors
    /// If the count is zero or exceeds the limit: contains the exception.
    pub fn check(self, count: u16, limit: u16) -> Result<(), Exception> {
        match self {
            _ if (1..=limit).contains(&count) => Ok(()),
            Beyond::Value => Err(Exception::VALUE),
            Beyond::Address => Err(Exception::ADDRESS),
        }
    }
}

/// Reaction to a write to a read-only register.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadOnly {
    /// Exception 02.
    Exception,
    /// The write is acknowledged and ignored.
    Ignored,
}

impl ReadOnly {
    /// The outcome of a write to a read-only register.
    ///
    /// # Errors
    /// Exception 02, unless the drive ignores such accesses.
    pub fn outcome(self) -> Result<(), Exception> {
        match self {
            ReadOnly::Exception => Err(Exception::ADDRESS),
            ReadOnly::Ignored => Ok(()),
        }
    }
}

/// The steps that a drive has still to live through.
#[derive(Debug, Clone)]
pub(super) struct Steps {
    next: SimTime,
}

impl Steps {
    pub(super) fn new(now: SimTime) -> Steps {
        Steps {
            next: now + UPDATE_PERIOD,
        }
    }

    /// The next step that is due by `now`.
    pub(super) fn due(&mut self, now: SimTime) -> Option<SimTime> {
        if now.saturating_sub(self.next) > LONGEST_CATCH_UP {
            self.next = now - LONGEST_CATCH_UP;
        }
        (self.next <= now).then(|| {
            let at = self.next;
            self.next += UPDATE_PERIOD;
            at
        })
    }
}

/// The fault of a drive, and the condition for running again: the run command must be seen off without a fault
/// before it is obeyed (reference/drives.md 9.24).
#[derive(Debug, Clone)]
pub(super) struct Latch {
    fault: u16,
    armed: bool,
}

impl Latch {
    pub(super) fn new() -> Latch {
        Latch { fault: 0, armed: true }
    }

    /// The active fault, 0 for none.
    pub(super) fn fault(&self) -> u16 {
        self.fault
    }

    /// Trips with a fault. Returns false if a fault is already active, because the first fault remains, or if
    /// `code` means no fault.
    pub(super) fn trip(&mut self, code: u16) -> bool {
        let fresh = self.fault == 0 && code != 0;
        if fresh {
            self.fault = code;
            self.armed = false;
        }
        fresh
    }

    pub(super) fn reset(&mut self) {
        self.fault = 0;
    }

    /// Makes the drive ignore a run command that is on now.
    pub(super) fn disarm(&mut self) {
        self.armed = false;
    }

    /// Whether the drive obeys the present run command.
    pub(super) fn obeys(&mut self, run: bool) -> bool {
        if !run && self.fault == 0 {
            self.armed = true;
        }
        run && self.armed && self.fault == 0
    }
}

/// A figure as the value of a signed register.
pub(super) fn signed(value: f64) -> u16 {
    value.round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16 as u16
}

/// A figure as the value of an unsigned register.
pub(super) fn unsigned(value: f64) -> u16 {
    value.round().clamp(0.0, f64::from(u16::MAX)) as u16
}

/// `mask` if `on`, otherwise 0.
pub(super) fn bit(on: bool, mask: u16) -> u16 {
    if on { mask } else { 0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_latch_wants_a_new_run_command_after_a_fault() {
        let mut latch = Latch::new();
        assert!(latch.obeys(true));
        assert!(latch.trip(7) && !latch.trip(8) && !latch.trip(0));
        assert!(!latch.obeys(true));
        assert!(!latch.obeys(false), "seen off, but with the fault");
        latch.reset();
        assert!(!latch.obeys(true));
        assert!(!latch.obeys(false) && latch.obeys(true));
        latch.disarm();
        assert!(!latch.obeys(true));
    }

    #[test]
    fn steps_catch_up_within_bounds() {
        let mut steps = Steps::new(SimTime::ZERO);
        assert_eq!(steps.due(Duration::from_millis(9)), None);
        assert_eq!(steps.due(Duration::from_millis(25)), Some(Duration::from_millis(10)));
        assert_eq!(steps.due(Duration::from_millis(25)), Some(Duration::from_millis(20)));
        assert_eq!(steps.due(Duration::from_millis(25)), None);
        let year = Duration::from_secs(365 * 86_400);
        assert_eq!(steps.due(year), Some(year - LONGEST_CATCH_UP));
    }
}
