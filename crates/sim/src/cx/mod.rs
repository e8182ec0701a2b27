//! A simulated Vacon CX, CXL or CXS drive with its Modbus board, as described in reference/drives.md sections 4 and 10.
//!
//! Pure: the time is an argument. Loss of the master changes nothing, because the manual describes no supervision
//! of the bus.

mod diagnostics;
mod options;
mod parameters;
mod registers;
#[cfg(test)]
mod tests;

pub(crate) use diagnostics::Counters;
pub use options::{AddressOffset, CxOptions, OutOfRange};

use std::collections::BTreeMap;

use self::diagnostics::{Diagnostics, count};
use self::parameters::Parameters;
use super::SimTime;
use super::model::{AT_REFERENCE_BAND, Body, Command, Model, UPDATE_PERIOD, unsigned};
use super::motor::{Feed, Ratings};
use super::parameter_set::Writes;
use super::random::Random;
use drivegate_proto::{Exception, Reply, RequestPdu};

/// The control bits (reference/drives.md 4.2).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Coils {
    run: bool,
    reverse: bool,
    reset: bool,
}

/// Lifetime counters of the drive; they survive a power cycle.
#[derive(Debug, Clone, Copy)]
struct Totals {
    /// Counter of operating days.
    days: f64,
    /// Operating hours since the counter was reset.
    trip_hours: f64,
    /// Energy counter, MWh.
    energy: f64,
    /// Energy since the counter was reset, MWh.
    trip_energy: f64,
}

impl Default for Totals {
    /// A drive that has been at work for some weeks.
    fn default() -> Self {
        Totals {
            days: 42.5,
            trip_hours: 310.25,
            energy: 0.487,
            trip_energy: 0.141,
        }
    }
}

/// kW at the shaft of the motor, with an efficiency of 85 %.
fn nominal_power(plate: &Ratings) -> f64 {
    3f64.sqrt() * plate.voltage * plate.current * plate.cos_phi * 0.85 / 1000.0
}

/// A simulated Vacon CX.
#[derive(Debug, Clone)]
pub struct CxDrive {
    options: CxOptions,
    parameters: Parameters,
    ratings: Ratings,
    /// Rated power of the unit, kW: that of the motor it was delivered for.
    unit_power: f64,
    body: Body,
    totals: Totals,
    diagnostics: Diagnostics,
    coils: Coils,
    /// Frequency reference that the drive accepted, 0.01 Hz.
    reference: u16,
    /// Whether the fieldbus is the active control source.
    fieldbus: bool,
    /// Command from the panel; obeyed while the fieldbus is not the control source.
    local: Command,
    failed: bool,
    busy_until: SimTime,
}

impl CxDrive {
    /// A drive that is switched on at `now`, with the motor at rest.
    pub fn new(options: CxOptions, now: SimTime) -> CxDrive {
        let mut parameters = Parameters::new(options.frequency_step);
        for &((group, number), value) in &options.parameters {
            if group <= 98 && (1..=99).contains(&number) {
                let _ = parameters.set.set(parameters::address(group, number), value);
            }
        }
        let ratings = parameters.ratings();
        CxDrive {
            unit_power: nominal_power(&ratings),
            ratings,
            body: Body::new(&options.load, now),
            totals: Totals::default(),
            diagnostics: Diagnostics::default(),
            coils: Coils::default(),
            reference: 0,
            fieldbus: options.fieldbus,
            local: Command::default(),
            failed: false,
            busy_until: SimTime::ZERO,
            parameters,
            options,
        }
    }

    /// Commands from the panel; obeyed while the fieldbus is not the control source.
    pub fn set_local(&mut self, command: Command) {
        self.local = command;
    }

    /// Answers every request before `until` with exception 06, but for diagnostics.
    pub fn set_busy(&mut self, until: SimTime) {
        self.busy_until = until;
    }

    /// Answers every request with exception 04, slave device error, but for diagnostics.
    pub fn set_failed(&mut self, on: bool) {
        self.failed = on;
    }

    /// The event counters of the board.
    pub fn counters(&self) -> Counters {
        self.diagnostics.counters
    }

    /// Whether the board is in Listen Only Mode.
    pub fn listens_only(&self) -> bool {
        self.diagnostics.listens_only()
    }

    fn set_run(&mut self, on: bool) {
        self.coils.run = on;
        // A pulse shorter than a step counts.
        if self.fieldbus && !on {
            self.body.latch.obeys(false);
        }
    }

    fn pull_reset(&mut self, on: bool) {
        if self.fieldbus && on && !self.coils.reset {
            self.body.latch.reset();
            // A run coil that is off already is seen off now.
            self.body.latch.obeys(self.coils.run);
        }
        self.coils.reset = on;
    }

    /// The command in force: run and reference.
    fn held(&self) -> (bool, f64) {
        if !self.fieldbus {
            return (self.local.run, self.frequency(self.local));
        }
        let (minimum, maximum) = (self.parameters.minimum(), self.ratings.maximum);
        let frequency = (f64::from(self.reference) / 100.0).min(maximum).max(minimum);
        (self.coils.run, if self.coils.reverse { -frequency } else { frequency })
    }

    /// The frequency of a command in percent of the maximum frequency, Hz.
    fn frequency(&self, command: Command) -> f64 {
        command.directed((command.share() * self.ratings.maximum).max(self.parameters.minimum()))
    }

    /// Counts the outcome of a message to this drive.
    fn count_reply(&mut self, reply: Option<Reply>) -> Option<Reply> {
        let counters = &mut self.diagnostics.counters;
        match &reply {
            None => count(&mut counters.no_responses),
            Some(Reply::Exception(_)) => count(&mut counters.exceptions),
            Some(_) => {}
        }
        reply
    }

    /// Listen Only Mode: no request is answered, and only function 08/0001 has an effect.
    fn listen(&mut self, request: Option<&RequestPdu>) {
        match request {
            Some(&RequestPdu::Diagnostics { subfunction, data }) if Diagnostics::is_reinitialise(subfunction, data) => {
                self.diagnostics.reinitialise();
            }
            _ => count(&mut self.diagnostics.counters.no_responses),
        }
    }
}

impl Model for CxDrive {
    fn body(&self) -> &Body {
        &self.body
    }

    fn body_mut(&mut self) -> &mut Body {
        &mut self.body
    }

    fn step(&mut self, _now: SimTime) {
        let (run, target) = self.held();
        self.body.running = self.body.latch.obeys(run);
        let feed = match self.body.latch.fault() {
            0 => self.body.feed(target),
            _ => Feed::Off,
        };
        let seconds = UPDATE_PERIOD.as_secs_f64();
        self.body.motor.step(seconds, feed, &self.ratings, &self.options.load);
        let hours = seconds / 3600.0;
        let energy =
            nominal_power(&self.ratings) / 1000.0 * self.body.motor.power(&self.ratings).max(0.0) / 100.0 * hours;
        self.totals.days += hours / 24.0;
        self.totals.trip_hours += hours;
        self.totals.energy += energy;
        self.totals.trip_energy += energy;
    }

    fn ready(&self) -> bool {
        self.body.latch.fault() == 0
    }

    fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Option<Reply> {
        self.advance(now);
        count(&mut self.diagnostics.counters.slave_messages);
        if self.diagnostics.listens_only() {
            self.listen(Some(request));
            return None;
        }
        let reply = match *request {
            RequestPdu::Diagnostics { subfunction, data } => self.diagnostics.serve(subfunction, data),
            _ => Some(self.reply(request, now).unwrap_or_else(Reply::Exception)),
        };
        self.count_reply(reply)
    }

    fn malformed(&mut self, pdu: &[u8], exception: Exception, _now: SimTime) -> Option<Exception> {
        count(&mut self.diagnostics.counters.slave_messages);
        if self.diagnostics.listens_only() {
            self.listen(None);
            return None;
        }
        let known = pdu
            .first()
            .is_some_and(|function| registers::FUNCTIONS.contains(function));
        let exception = if known { exception } else { Exception::FUNCTION };
        self.count_reply(Some(Reply::Exception(exception)));
        Some(exception)
    }

    fn broadcast(&mut self, request: &RequestPdu, now: SimTime) {
        self.advance(now);
        let counters = &mut self.diagnostics.counters;
        count(&mut counters.slave_messages);
        count(&mut counters.no_responses);
        let writes = matches!(request, RequestPdu::WriteCoil { .. } | RequestPdu::WriteRegister { .. });
        if writes && !self.diagnostics.listens_only() {
            let _refused_in_silence = self.reply(request, now);
        }
    }

    fn bus_message(&mut self) {
        count(&mut self.diagnostics.counters.bus_messages);
    }

    fn bus_error(&mut self) {
        count(&mut self.diagnostics.counters.bus_errors);
    }

    fn power_on(&mut self, now: SimTime) {
        let fresh = CxDrive::new(self.options.clone(), now);
        *self = CxDrive {
            ratings: self.ratings,
            parameters: self.parameters.clone(),
            totals: self.totals,
            ..fresh
        };
    }

    fn parameter_writes(&self) -> BTreeMap<u16, Writes> {
        self.parameters.set.writes().clone()
    }

    fn fill_parameters(&mut self, random: &mut Random) {
        self.parameters.set.fill(random, &[]);
        self.ratings = self.parameters.ratings();
    }

    /// Overcurrent, drive overtemperature, motor underload, external fault.
    fn usual_faults(&self) -> &'static [u16] {
        &[1, 14, 17, 41]
    }

    fn command(&mut self, command: Command) {
        self.set_run(command.run);
        let frequency = self.frequency(command);
        self.coils.reverse = frequency < 0.0;
        self.reference = unsigned(frequency.abs() * 100.0);
    }

    fn set_reset(&mut self, on: bool) {
        self.pull_reset(on);
    }

    fn set_remote(&mut self, on: bool) {
        self.fieldbus = on;
    }

    fn remote(&self) -> bool {
        self.fieldbus
    }

    fn target(&self) -> f64 {
        self.held().1
    }
}
