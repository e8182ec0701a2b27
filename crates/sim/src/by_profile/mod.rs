//! A simulated drive or meter of any profile. Its registers come from the points of the profile; its reaction to
//! the control word comes from the hand-written [`words`] if the family is known, otherwise from `[control]`
//! ([`said`]). Pure.

mod effect;
mod figures;
mod reactions;
mod registers;
mod state_bits;
mod status;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use self::reactions::{FAMILIES, Family, KnownState, MotorEffect, WordEffect};
use self::registers::Registers;
use super::SimTime;
use super::model::{AT_REFERENCE_BAND, Body, Command, Model, UPDATE_PERIOD};
use super::motor::{Feed, Load, Ratings};
use super::parameter_set::Writes;
use super::random::Random;
use drivegate_model::drive::control::{Control, ControlItem, Run, Until};
use drivegate_model::drive::{Bound, ModelPoint, PointIndex, Profile, Source, Value};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// Time that a drive takes to reach the next state of its start sequence.
const SETTLE: Duration = Duration::from_millis(30);
/// Maximum frequency in Hz if the profile states none.
const MAXIMUM: f64 = 50.0;
/// Registers for causing a fault, each followed by one for panel control: the first pair that is not in the profile
/// is used.
const TRIP_ADDRESSES: [u16; 3] = [9998, 19_998, 29_998];

/// Options of a drive of any profile.
#[derive(Debug, Clone)]
pub struct ProfileOptions {
    /// Profile of the drive.
    pub profile: Arc<Profile>,
    /// Whether the simulator's own registers exist: a fault code trips the drive, and 1 in the register after it
    /// switches to panel control.
    pub trip_register: bool,
    /// Time before a reply; with `None`, the line determines it.
    pub turnaround: Option<Duration>,
    /// Values of points that the motor does not change, by index.
    pub values: BTreeMap<PointIndex, Given>,
}

/// The given value of a point.
#[derive(Debug, Clone, PartialEq)]
pub enum Given {
    /// A number in the unit of the point; 1 is true.
    Number(f64),
    Text(String),
}

impl ProfileOptions {
    /// Options of a drive with this profile.
    pub fn new(profile: &Arc<Profile>) -> ProfileOptions {
        ProfileOptions {
            profile: Arc::clone(profile),
            trip_register: false,
            turnaround: Some(profile.turnaround),
            values: BTreeMap::new(),
        }
    }

    /// Whether drives of the profile can be simulated: not with an N2 board, and not if `simulator` is an unknown name.
    pub fn can_simulate(profile: &Profile) -> bool {
        let named = profile.simulator.as_deref();
        let known = named.is_none_or(|name| name == BY_CONTROL || FAMILIES.iter().any(|family| family.name == name));
        known && !profile.protocols.contains(&drivegate_proto::Protocol::N2)
    }

    /// PDU address of the holding register that trips the drive; the next one switches to panel control.
    pub fn trip_address(&self) -> u16 {
        let is_free = |address: &u16| {
            let ranges = &self.profile.ranges;
            !ranges.iter().any(|range| {
                range.table == Table::Holding
                    && range.addresses.start() <= &(address + 1)
                    && range.addresses.end() >= address
            })
        };
        let [first, ..] = TRIP_ADDRESSES;
        TRIP_ADDRESSES.into_iter().find(is_free).unwrap_or(first)
    }
}

/// Value of `simulator` in a profile whose drive follows `[control]` although its base family has hand-written words.
const BY_CONTROL: &str = "control";

/// A simulated drive of any profile.
#[derive(Debug, Clone)]
pub struct ProfileDrive {
    options: ProfileOptions,
    family: Option<Family>,
    control: Option<Control>,
    registers: Registers,
    ratings: Ratings,
    load: Load,
    body: Body,
    /// The control word that was last in force.
    word: u16,
    /// Number of words of the start sequence that the drive has received, and when its status shows that.
    position: usize,
    shows_at: SimTime,
    /// The run command that holds: in reverse or not.
    run: Option<bool>,
    reverse: bool,
    coasts: bool,
    remote: bool,
    /// Consumed energy, kWh.
    energy: f64,
    hours: f64,
}

impl ProfileDrive {
    /// A drive that is switched on at `now`, with the motor at rest.
    pub fn new(options: ProfileOptions, now: SimTime) -> ProfileDrive {
        let load = Load::default();
        let profile = Arc::clone(&options.profile);
        let control = profile.control.clone();
        let name = profile.simulator.as_deref();
        let family = FAMILIES.into_iter().find(|family| Some(family.name) == name);
        let ratings = Ratings {
            maximum: maximum(&profile),
            acceleration: 3.0,
            deceleration: 3.0,
            voltage: 400.0,
            frequency: 50.0,
            speed: 1440.0,
            current: 6.3,
            cos_phi: 0.82,
        };
        let mut drive = ProfileDrive {
            registers: Registers::new(&profile, control.as_ref()),
            family,
            control,
            ratings,
            body: Body::new(&load, now),
            load,
            word: 0,
            position: 0,
            shows_at: now,
            run: None,
            reverse: false,
            coasts: false,
            remote: true,
            energy: 487.0,
            hours: 310.25,
            options,
        };
        drive.fill_in();
        drive.refresh();
        drive
    }

    fn profile(&self) -> Arc<Profile> {
        Arc::clone(&self.options.profile)
    }

    /// How many words of the start sequence the status shows as received.
    fn shown_position(&self, now: SimTime) -> usize {
        if now >= self.shows_at {
            self.position
        } else {
            self.position.saturating_sub(1)
        }
    }

    /// Processes a value that was written to a register that may take commands.
    fn apply_word(&mut self, place: ControlItem, word: u16, now: SimTime) {
        let Some(control) = self.control.clone() else {
            return;
        };
        if !self.remote {
            return;
        }
        let registers = &self.registers;
        let known = KnownState {
            before: self.word,
            position: self.shown_position(now),
            faulted: self.body.latch.fault() != 0,
            reverse: self.reverse,
            at: &|table, address| registers.get(table, address).unwrap_or(0),
        };
        let told = match self.family {
            Some(family) if place == control.at => Some((family.word)(&known, word)),
            Some(family) => (family.other)(place.table, place.address, word).or_else(|| {
                // The write may have changed the direction, for example, so the control word is evaluated again.
                let again = (family.word)(&known, self.word);
                let plain = WordEffect { resets: false, ..again };
                matches!(plain.does, MotorEffect::Runs { .. }).then_some(plain)
            }),
            None if effect::places(&control).contains(&place) => Some(effect::effect_of(&control, &known, place, word)),
            None => None,
        };
        let Some(told) = told else {
            return;
        };
        if place == control.at {
            self.word = told.word;
        }
        self.obey(told, now);
    }

    fn obey(&mut self, told: WordEffect, now: SimTime) {
        let once = self.acts_once();
        let restarts = self.family.map_or_else(
            || self.control.as_ref().is_some_and(|control| control.restarts_on_reset),
            |family| family.restarts_on_reset,
        );
        if told.resets && self.body.latch.fault() != 0 {
            self.body.latch.reset();
            // Other drives must see the run command switched off first.
            if restarts || self.run.is_none() {
                self.body.latch.obeys(false);
            }
        }
        let faulted = self.body.latch.fault() != 0;
        match told.does {
            MotorEffect::Nothing => {}
            MotorEffect::Prepares(position) => {
                self.halt();
                self.enter_position(if faulted { 0 } else { position }, now);
            }
            MotorEffect::Runs { .. } if faulted && once => {}
            MotorEffect::Runs { reverse } => {
                (self.run, self.reverse, self.coasts) = (Some(reverse), reverse, false);
                self.position = self.position.max(self.steps().saturating_sub(1));
            }
            MotorEffect::Stops => {
                self.halt();
                self.position = 0;
            }
            MotorEffect::Coasts => {
                self.halt();
                (self.position, self.coasts) = (0, true);
            }
            MotorEffect::Trips => self.trip(1),
        }
    }

    /// Whether a run command only acts at the moment when it is written.
    fn acts_once(&self) -> bool {
        let said = || self.control.as_ref().is_some_and(effect::acts_once);
        self.family.map_or_else(said, |family| family.acts_once)
    }

    /// Moves the drive to another state of the start sequence; staying in the same state takes no time.
    fn enter_position(&mut self, position: usize, now: SimTime) {
        if self.position < position {
            let step = position.saturating_sub(1);
            let time = match self.control.as_ref().map(|control| &control.run) {
                Some(Run::Steps(steps)) => steps.get(step).map_or(SETTLE, |step| match step.until {
                    Until::Time(time) => time,
                    Until::Written => Duration::ZERO,
                    Until::State(_) => SETTLE,
                }),
                _ => Duration::ZERO,
            };
            self.shows_at = now + time;
        }
        self.position = position;
    }

    fn steps(&self) -> usize {
        match self.control.as_ref().map(|control| &control.run) {
            Some(Run::Steps(steps)) => steps.len(),
            _ => 0,
        }
    }

    /// The run command ends; a pulse shorter than a step counts.
    fn halt(&mut self) {
        self.run = None;
        self.body.latch.obeys(false);
    }

    /// Stops the motor by another source than the bus: the drive no longer runs by the previous word, although the
    /// word still reads back.
    fn stop_motor(&mut self) {
        self.halt();
        self.word = 0;
    }

    /// The reference in Hz, with its sign.
    fn reference(&self) -> f64 {
        let hertz = |model: ModelPoint, factor: f64| self.commanded(model).map(|value| value * factor);
        let frequency = hertz(ModelPoint::FrequencyReference, 1.0);
        let speed = || hertz(ModelPoint::SpeedReference, self.ratings.maximum / 100.0);
        let found = frequency.or_else(speed).unwrap_or(self.ratings.maximum);
        found.clamp(-self.ratings.maximum, self.ratings.maximum)
    }

    /// The value of a reference that is written to a register.
    fn commanded(&self, model: ModelPoint) -> Option<f64> {
        let point = self.options.profile.model_point(model).filter(|point| point.write)?;
        let target = point.write_to.and_then(|index| self.options.profile.points.get(index));
        let point = target.unwrap_or(point);
        let raw = point.raw()?;
        let words: Option<Vec<u16>> = raw
            .addresses()
            .map(|address| self.registers.get(raw.table, address))
            .collect();
        raw.decode(&words?, point.kind()).map(Value::as_f64)
    }

    /// Switches the drive to panel control, which stops the motor, or back to the bus, which must command it again.
    fn give_to_bus(&mut self, on: bool) {
        if self.remote != on {
            (self.remote, self.position) = (on, 0);
            self.stop_motor();
        }
    }
}

impl Model for ProfileDrive {
    fn body(&self) -> &Body {
        &self.body
    }

    fn body_mut(&mut self) -> &mut Body {
        &mut self.body
    }

    fn step(&mut self, _now: SimTime) {
        self.body.running = self.body.latch.obeys(self.run.is_some());
        let feed = if self.body.running {
            Feed::To(self.target())
        } else if self.body.latch.fault() == 0 && self.body.motor.fed && self.body.motor.output != 0.0 && !self.coasts {
            Feed::To(0.0)
        } else {
            Feed::Off
        };
        let seconds = UPDATE_PERIOD.as_secs_f64();
        self.body.motor.step(seconds, feed, &self.ratings, &self.load);
        let hours = seconds / 3600.0;
        self.energy += self.kilowatts().max(0.0) * hours;
        self.hours += hours;
    }

    fn ready(&self) -> bool {
        self.body.latch.fault() == 0
    }

    fn target(&self) -> f64 {
        let reference = self.reference();
        if self.run.unwrap_or(self.reverse) {
            -reference
        } else {
            reference
        }
    }

    fn remote(&self) -> bool {
        self.remote
    }

    fn answer(&mut self, request: &RequestPdu, now: SimTime) -> Option<Reply> {
        self.advance(now);
        Some(self.reply(request, now).unwrap_or_else(Reply::Exception))
    }

    fn malformed(&mut self, pdu: &[u8], exception: Exception, _now: SimTime) -> Option<Exception> {
        let known = pdu.first().is_some_and(|function| self.has_function(*function));
        Some(if known { exception } else { Exception::FUNCTION })
    }

    fn broadcast(&mut self, request: &RequestPdu, now: SimTime) {
        self.advance(now);
        if request.is_write() {
            let _refused_in_silence = self.reply(request, now);
        }
    }

    fn power_on(&mut self, now: SimTime) {
        let fresh = ProfileDrive::new(self.options.clone(), now);
        let kept = self.registers.clone();
        *self = ProfileDrive {
            energy: self.energy,
            hours: self.hours,
            remote: self.remote,
            ..fresh
        };
        let profile = self.profile();
        self.registers.keep_settings(&kept, &profile, self.control.as_ref());
        self.refresh();
    }

    fn trip(&mut self, fault: u16) {
        if fault != 0 && self.body.latch.fault() == 0 {
            self.body.trip(fault);
            self.position = 0;
            if self.acts_once() || self.steps() > 0 {
                self.run = None;
            }
        }
    }

    fn parameter_writes(&self) -> BTreeMap<u16, Writes> {
        BTreeMap::new()
    }

    fn fill_parameters(&mut self, _random: &mut Random) {}

    fn usual_faults(&self) -> &'static [u16] {
        &[1, 2, 3]
    }

    fn command(&mut self, command: Command) {
        if command.run {
            (self.run, self.reverse, self.coasts) = (Some(command.reverse), command.reverse, false);
            self.position = self.steps().saturating_sub(1);
        } else {
            self.stop_motor();
        }
        let percent = f64::from(command.reference) / 100.0;
        self.set_reference(percent);
    }

    fn set_reset(&mut self, on: bool) {
        if on {
            self.body.latch.reset();
            self.body.latch.obeys(self.run.is_some());
        }
    }

    fn set_remote(&mut self, on: bool) {
        self.give_to_bus(on);
    }
}

/// The frequency at 100 %, Hz.
fn maximum(profile: &Profile) -> f64 {
    let ends = profile.points.iter().filter_map(|point| match &point.source {
        Source::Derived(derived) => derived.band(),
        Source::Raw(_) => None,
    });
    let mut fixed = ends.filter_map(|(_, _, maximum)| match maximum {
        Bound::Fixed(hertz) => Some(hertz),
        Bound::Point(_) | Bound::Configured => None,
    });
    fixed.find(|hertz| (1.0..=600.0).contains(hertz)).unwrap_or(MAXIMUM)
}
