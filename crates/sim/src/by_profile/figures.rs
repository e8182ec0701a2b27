//! The values of the points of a simulated drive of any profile.

use std::collections::BTreeMap;

use super::super::SimTime;
use super::super::model::{Model, unsigned};
use super::state_bits::{Bits, Key, Wish, fulfilled};
use super::status::Shows;
use super::{AT_REFERENCE_BAND, Given, ProfileDrive};
use drivegate_model::drive::control::{Control, Mask, OwnWord, Run, Until};
use drivegate_model::drive::profile::{Form, Part, PollClass, Raw};
use drivegate_model::drive::{Derived, ModelPoint, Point, PointIndex, Profile, Source, Value};
use drivegate_proto::Table;

/// Rank of a state that was given.
const GIVEN: u8 = 0;
/// Power of the simulated motor, kW.
const NOMINAL_POWER: f64 = 3.0;
/// Torque of the simulated motor, Nm.
const NOMINAL_TORQUE: f64 = 19.9;

impl ProfileDrive {
    pub(super) fn kilowatts(&self) -> f64 {
        self.body.motor.power(&self.ratings) / 100.0 * NOMINAL_POWER
    }

    /// Fills in values that do not depend on the motor: given values, otherwise plausible ones for the unit.
    pub(super) fn fill_in(&mut self) {
        let profile = self.profile();
        for parameter in &profile.parameters.named {
            let key = (Table::Holding, parameter.address);
            let scale = if parameter.label.scale > 0.0 {
                parameter.label.scale
            } else {
                1.0
            };
            let least = parameter.range.as_ref().map_or(0.0, |range| *range.start() / scale);
            self.registers.place(
                key,
                Part {
                    mask: u16::MAX,
                    value: unsigned(least),
                },
            );
        }
        // Points with a scale or a factor in another register are set after that register.
        let (scaled, plain): (Vec<PointIndex>, Vec<PointIndex>) = profile
            .points
            .indexes()
            .partition(|index| raw_of(&profile, *index).is_some_and(|raw| raw.scaled_by().next().is_some()));
        for index in plain.into_iter().chain(scaled) {
            let Some((point, raw)) = profile.points.get(index).and_then(|point| Some((point, point.raw()?))) else {
                continue;
            };
            let given = self.options.values.get(&index).cloned();
            if self.is_kept_back(point, raw) && given.is_none() {
                continue;
            }
            match given.or_else(|| usual(point, raw)) {
                Some(Given::Text(text)) => self.put(raw, &raw.text_parts(&text)),
                Some(Given::Number(number)) => match raw.state_parts() {
                    Some(_) => {}
                    None => self.put_number(&profile, raw, number),
                },
                None => {}
            }
        }
    }

    /// Whether a command register stays 0 until it is written.
    fn is_kept_back(&self, point: &Point, raw: &Raw) -> bool {
        let is_place = |control: &drivegate_model::drive::control::Control| {
            let places = super::effect::places(control);
            places.iter().any(|place| raw.covers(place.table, place.address))
        };
        let reference = matches!(
            point.model,
            Some(ModelPoint::SpeedReference | ModelPoint::FrequencyReference)
        );
        reference || self.control.as_ref().is_some_and(is_place)
    }

    fn put(&mut self, raw: &Raw, parts: &[Part]) {
        for (address, part) in raw.addresses().zip(parts) {
            self.registers.place((raw.table, address), *part);
        }
    }

    fn put_number(&mut self, profile: &Profile, raw: &Raw, number: f64) {
        let power = raw.scale_from.and_then(|index| self.value_of(profile, index));
        let factors = raw
            .factor_from
            .iter()
            .filter_map(|index| self.value_of(profile, *index));
        let factor: f64 = factors
            .map(|factor| factor.as_f64())
            .filter(|factor| *factor != 0.0)
            .product();
        let number = if is_signed(raw) { number } else { number.abs() };
        let parts = raw.number_parts(number / factor, power.map_or(0, |power| power.as_f64() as i64));
        self.put(raw, &parts);
    }

    /// The value of a point from the present content of its registers.
    fn value_of(&self, profile: &Profile, index: PointIndex) -> Option<Value> {
        let raw = raw_of(profile, index)?;
        let words: Option<Vec<u16>> = raw
            .addresses()
            .map(|address| self.registers.get(raw.table, address))
            .collect();
        raw.decode(&words?, profile.points.get(index)?.kind())
    }

    /// The reference as another master writes it.
    pub(super) fn set_reference(&mut self, percent: f64) {
        let profile = self.profile();
        for (model, value) in [
            (ModelPoint::SpeedReference, percent),
            (ModelPoint::FrequencyReference, percent * self.ratings.maximum / 100.0),
        ] {
            let point = profile.model_point(model).filter(|point| point.write);
            let target = point
                .and_then(|point| point.write_to)
                .and_then(|index| profile.points.get(index));
            if let Some(raw) = target.or(point).and_then(Point::raw) {
                self.put_number(&profile, &raw.clone(), value);
            }
        }
    }

    /// Updates all registers for this time.
    pub(super) fn show(&mut self, now: SimTime) {
        let profile = self.profile();
        let mut figures: BTreeMap<Key, u16> = BTreeMap::new();
        for (index, point) in profile.points.enumerate() {
            if let (Some(raw), Some(number)) = (point.raw(), self.figure(index, point))
                && raw.state_parts().is_none()
                && !self.is_written(point, raw)
            {
                self.put_number(&profile, raw, number);
                for (key, part) in bits(raw, &raw.number_parts(0.0, 0)) {
                    *figures.entry(key).or_default() |= part.mask;
                }
            }
        }
        let known = self.show_status(&profile, now);
        let is_decided = |(key, part): &(Key, Part)| {
            let figure = figures.get(key).copied().unwrap_or(0);
            known.contains(key) || part.mask & !figure == 0
        };
        let wishes = self.wishes(&profile, is_decided, now);
        // Clears the bits of all states first, so that no earlier state remains in a register.
        for (key, part) in wishes.iter().flat_map(|wish| wish.any.iter().flatten()) {
            if !known.contains(key) && !self.is_place(*key) {
                let mask = part.mask & !figures.get(key).copied().unwrap_or(0);
                self.registers.place(*key, Part { mask, value: 0 });
            }
        }
        let registers = &self.registers;
        let fixed = fulfilled(&wishes, |(table, address)| registers.get(table, address).unwrap_or(0));
        for (key, part) in fixed {
            self.registers.place(key, part);
        }
    }

    /// Whether a register takes commands and reads back what was written to it.
    fn is_place(&self, (table, address): Key) -> bool {
        let holds = |control: &Control| {
            let places = super::effect::places(control);
            let here = places
                .iter()
                .any(|place| (place.table, place.address) == (table, address));
            here && control.own_word != OwnWord::Shadow
        };
        self.control.as_ref().is_some_and(holds)
    }

    /// Sets the status words of a family with hand-written words, except for bits that were given; returns their places.
    fn show_status(&mut self, profile: &Profile, now: SimTime) -> Vec<Key> {
        let Some(family) = self.family else {
            return Vec::new();
        };
        let words = (family.status)(&self.shows(now));
        let given: Vec<(Key, Part)> = self
            .options
            .values
            .keys()
            .filter_map(|index| raw_of(profile, *index))
            .flat_map(|raw| match raw.state_parts() {
                Some((parts, _)) => bits(raw, &parts),
                None => bits(raw, &raw.number_parts(0.0, 0)),
            })
            .collect();
        for (address, part) in &words {
            let key = (Table::Holding, *address);
            let of = given.iter().filter(|(given, _)| *given == key);
            let mask = part.mask & !of.fold(0, |mask, (_, part)| mask | part.mask);
            self.registers.place(key, Part { mask, ..*part });
        }
        words
            .into_iter()
            .map(|(address, _)| (Table::Holding, address))
            .collect()
    }

    fn shows(&self, now: SimTime) -> Shows {
        Shows {
            position: self.shown_position(now),
            running: self.body.shows_running(),
            commanded: self.run.is_some(),
            ordered_reverse: self.reverse,
            turns_reverse: self.body.turns_reverse(self.target()),
            at_reference: self.is_at_reference(),
            standing: self.body.motor.output == 0.0,
            fault: self.body.latch.fault(),
            remote: self.remote,
            word: self.word,
        }
    }

    fn is_at_reference(&self) -> bool {
        let near = (self.body.motor.output - self.target()).abs() < AT_REFERENCE_BAND;
        self.body.shows_running() && self.run.is_some() && near
    }

    /// Whether only a master changes the value.
    fn is_written(&self, point: &Point, raw: &Raw) -> bool {
        let own = self.control.as_ref().is_some_and(|control| {
            let at = raw.covers(control.at.table, control.at.address);
            at && (control.own_word != OwnWord::Shadow || point.class == PollClass::Never)
        });
        own || point.write && point.write_to.is_none()
    }

    /// The value that the simulated motor gives a point.
    fn figure(&self, index: PointIndex, point: &Point) -> Option<f64> {
        let (motor, ratings) = (&self.body.motor, &self.ratings);
        if self.options.values.contains_key(&index) || self.control.is_none() {
            return None;
        }
        let fault = f64::from(self.body.latch.fault());
        if let Some(model) = point.model {
            return Some(match model {
                ModelPoint::ActualSpeed => motor.output / ratings.maximum * 100.0,
                ModelPoint::OutputFrequency => motor.output,
                ModelPoint::MotorSpeed => motor.rpm(ratings),
                ModelPoint::MotorCurrent => motor.current(ratings),
                ModelPoint::MotorTorque => motor.torque,
                ModelPoint::MotorPower => motor.power(ratings),
                ModelPoint::MotorVoltage => motor.voltage(ratings),
                ModelPoint::DcLinkVoltage => motor.dc_link(ratings, &self.load),
                ModelPoint::HeatsinkTemperature => motor.heatsink,
                ModelPoint::Energy => self.energy,
                ModelPoint::OperatingHours => self.hours,
                ModelPoint::FaultCode => fault,
                ModelPoint::SpeedReference => self.target() / ratings.maximum * 100.0,
                ModelPoint::FrequencyReference => self.target(),
                _ => return None,
            });
        }
        let is_mask = |other: &Point| matches!(other.source, Source::Derived(Derived::LowestBit { of }) if of == index);
        if self.options.profile.points.iter().any(is_mask) {
            // The lowest bit, counted from 1, is the code.
            let bit = self.body.latch.fault().checked_sub(1);
            return Some(bit.map_or(0.0, |bit| f64::from(1u32 << bit.min(15))));
        }
        let name = point.name.as_str();
        match point.unit.as_str() {
            "Hz" if name.contains("reference") => Some(self.target()),
            "Hz" if name.contains("output") => Some(motor.output),
            "kW" if name.contains("power") => Some(self.kilowatts()),
            "W" if name.contains("power") => Some(self.kilowatts() * 1000.0),
            "Nm" if name.contains("torque") => Some(motor.torque / 100.0 * NOMINAL_TORQUE),
            "rpm" if name.contains("speed") => Some(motor.rpm(ratings)),
            "%" if name.contains("thermal") => Some(motor.heat),
            "" if name.contains("fault") && !name.contains("last") => Some(fault),
            _ => None,
        }
    }

    /// The states that registers must show in bits that are not determined yet, the most important ones first.
    fn wishes(&self, profile: &Profile, is_decided: impl Fn(&(Key, Part)) -> bool, now: SimTime) -> Vec<Wish> {
        let mut wishes: Vec<(u8, Wish)> = Vec::new();
        for (index, point) in profile.points.enumerate() {
            let Some((rank, is)) = self.state_of(index, point) else {
                continue;
            };
            let (any, want) = match &point.source {
                Source::Raw(raw) if self.is_written(point, raw) => continue,
                Source::Raw(raw) => match raw.state_parts() {
                    Some((parts, inverted)) => (vec![bits(raw, &parts)], is != inverted),
                    None => continue,
                },
                Source::Derived(Derived::State { any }) => {
                    (any.iter().filter_map(|mask| masked(profile, mask)).collect(), is)
                }
                Source::Derived(_) => continue,
            };
            wishes.push((rank, Wish { any, want }));
        }
        wishes.extend(self.sequence(profile, now));
        let is_free = |bits: &Bits| !bits.iter().all(&is_decided);
        wishes.retain(|(rank, wish)| *rank == GIVEN || wish.any.iter().any(is_free));
        wishes.sort_by_key(|(rank, _)| *rank);
        wishes.into_iter().map(|(_, wish)| wish).collect()
    }

    /// The states of the start sequence: the reached one must show, later ones must not.
    fn sequence(&self, profile: &Profile, now: SimTime) -> Vec<(u8, Wish)> {
        let Some(Run::Steps(steps)) = self.control.as_ref().map(|control| &control.run) else {
            return Vec::new();
        };
        let position = match self.run {
            Some(_) => steps.len(),
            None => self.shown_position(now),
        };
        let wish = |(step, step_of): (usize, &drivegate_model::drive::control::Step)| {
            let Until::State(mask) = step_of.until else {
                return None;
            };
            let is = step + 1 == position;
            // A step that was passed may still show.
            if step < position && !is {
                return None;
            }
            let any = masked(profile, &mask).into_iter().collect();
            Some((2, Wish { any, want: is }))
        };
        steps.iter().enumerate().filter_map(wish).collect()
    }

    /// Whether the drive is in a state, and how much the state counts.
    fn state_of(&self, index: PointIndex, point: &Point) -> Option<(u8, bool)> {
        if let Some(Given::Number(number)) = self.options.values.get(&index) {
            return Some((GIVEN, *number != 0.0));
        }
        let (motor, target) = (&self.body.motor, self.target());
        let running = self.body.shows_running();
        let fault = self.body.latch.fault() != 0;
        Some(match point.model {
            Some(ModelPoint::Fault) => (1, fault),
            // The direction is shown before the motor runs.
            Some(ModelPoint::Reversed) => (2, self.body.turns_reverse(target)),
            Some(ModelPoint::Running) => (3, running),
            Some(ModelPoint::Remote) => (4, self.remote),
            Some(ModelPoint::Warning) => (5, false),
            Some(ModelPoint::AtReference) => (5, self.is_at_reference()),
            Some(ModelPoint::ZeroSpeed) => (5, motor.output == 0.0),
            Some(ModelPoint::Ready) => (6, self.ready()),
            Some(_) => return None,
            None if point.write => return None,
            None => match &point.blocks {
                Some(blocks) => (7, !blocks.when),
                None => (8, point.name.contains("clockwise") && !self.body.turns_reverse(target)),
            },
        })
    }
}

fn raw_of(profile: &Profile, index: PointIndex) -> Option<&Raw> {
    profile.points.get(index).and_then(Point::raw)
}

fn bits(raw: &Raw, parts: &[Part]) -> Bits {
    let keys = raw.addresses().map(|address| -> Key { (raw.table, address) });
    keys.zip(parts.iter().copied())
        .filter(|(_, part)| part.mask != 0)
        .collect()
}

fn masked(profile: &Profile, mask: &Mask) -> Option<Bits> {
    let raw = raw_of(profile, mask.point)?;
    Some(bits(raw, &raw.masked(mask.mask, mask.is)))
}

fn is_signed(raw: &Raw) -> bool {
    raw.form.is_signed() || matches!(raw.form, Form::F32 | Form::F64)
}

/// A usual value for a point that no motor changes, within the point's range.
fn usual(point: &Point, raw: &Raw) -> Option<Given> {
    if let Form::Text { .. } = raw.form {
        return Some(Given::Text("SIM-0001".to_string()));
    }
    if let Some((code, _)) = point.texts.first_key_value() {
        return Some(Given::Number(*code as f64));
    }
    let name = point.name.as_str();
    let number: f64 = match point.unit.as_str() {
        "V" if name.contains("dc") => 540.0,
        "V" => 230.0,
        "mV" => 230_000.0,
        "A" => 5.2,
        "mA" => 12.5,
        "kW" | "kVA" | "kvar" => 2.4,
        "W" | "VA" | "var" => 2400.0,
        "kWh" | "kvarh" => 1234.5,
        "Wh" | "MWh" => 1234.0,
        "Hz" => 50.0,
        "°C" => 35.5,
        "%" => 42.0,
        "h" => 310.0,
        "s" | "min" | "bar" => 3.0,
        "ms" => 500.0,
        "rpm" => 0.0,
        _ if name.contains("fault") || name.contains("alarm") || name.contains("error") => 0.0,
        // Hidden points are status words or powers of ten.
        _ if point.hidden => 0.0,
        _ if name.contains("scale") || name.contains("exponent") => 0.0,
        _ => 1.0,
    };
    let within = point
        .range
        .as_ref()
        .map_or(number, |range| number.clamp(*range.start(), *range.end()));
    Some(Given::Number(within))
}
