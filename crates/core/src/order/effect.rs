//! Effects of a command on each drive that it reaches, from the profiles of the drives; determined once, when the
//! command is accepted. Pure.

use super::{Order, Touched, Urgency, written};
use drivegate_model::drive::{DriveIndex, ModelPoint, Profile};
use drivegate_proto::Table;

/// Rights that a command requires from the hold of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Asks {
    /// An order that may start the motor: needs the hold, takes a free drive.
    Run,
    /// A reference or a direction needs the hold and takes a free drive as well, but starts nothing.
    Steer,
    /// A fault reset, a parameter, any other raw write: passes if the drive is free, and takes no hold.
    Other,
    /// The write takes the run command away, so every rule lets it pass.
    Stop,
    /// The order needs no right to the drive: a read, or a write of a restore that has started and must not be left
    /// half done.
    Nothing,
}

impl Asks {
    /// Rights that an order with this effect requires.
    pub fn of(order: &Order, effect: Effect) -> Asks {
        match order {
            _ if effect.stops => Asks::Stop,
            Order::Read(_) | Order::Parameter(_) => Asks::Nothing,
            Order::Points(_) | Order::Write(_) if effect.may_run() => Asks::Run,
            Order::Points(_) | Order::Write(_) if effect.steers() => Asks::Steer,
            Order::Points(_) | Order::Write(_) => Asks::Other,
        }
    }

    /// Whether the order takes the hold of a free drive.
    pub fn takes_hold(self) -> bool {
        matches!(self, Asks::Run | Asks::Steer)
    }
}

/// Effect of a command on one drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Effect {
    /// Whether the command takes the run command away, with the rights of a stop.
    pub stops: bool,
    /// The run command that the effect sets.
    pub run: Option<bool>,
    /// The direction that the effect sets.
    pub reverse: Option<bool>,
    /// Whether the effect sets a reference.
    pub reference: bool,
    /// Whether the order writes a raw word to the register of the run command that is not a stop.
    pub word: bool,
}

impl Effect {
    /// Unknown effect: the command may start the motor and set a reference.
    pub const UNKNOWN: Effect = Effect {
        stops: false,
        run: Some(true),
        reverse: None,
        reference: true,
        word: true,
    };

    /// The effect of a command of that rank on a drive of that profile.
    pub fn of_command(order: &Order, urgency: Urgency, profile: &Profile) -> Effect {
        Effect {
            stops: urgency == Urgency::Stop,
            ..Effect::of(order, profile)
        }
    }

    /// Whether the effect starts a motor that is at standstill.
    pub fn starts(self) -> bool {
        !self.stops && self.run == Some(true)
    }

    /// Whether the order writes a run command, or a word to its register that is not a stop.
    pub fn may_run(self) -> bool {
        self.run == Some(true) || self.word
    }

    /// Whether the effect sets a reference or a direction.
    pub fn steers(self) -> bool {
        self.reverse.is_some() || self.reference
    }

    /// The effect of an order on a drive with this profile, independent of its rank.
    pub fn of(order: &Order, profile: &Profile) -> Effect {
        match order {
            Order::Points(values) => {
                let mut effect = Effect::default();
                for (index, value) in values {
                    let is = |point: ModelPoint| {
                        profile
                            .model_index(point)
                            .is_some_and(|own| profile.behind(own) == profile.behind(*index))
                    };
                    if is(ModelPoint::Run) {
                        effect.run = Some(value.as_bool());
                    }
                    if is(ModelPoint::Reverse) {
                        effect.reverse = Some(value.as_bool());
                    }
                    effect.reference |= is(ModelPoint::SpeedReference) || is(ModelPoint::FrequencyReference);
                }
                effect
            }
            Order::Write(pdu) => match written(pdu) {
                Some((table, items)) => raw(profile, table, &items),
                None => Effect::UNKNOWN,
            },
            Order::Read(_) | Order::Parameter(_) => Effect::default(),
        }
    }
}

fn raw(profile: &Profile, table: Table, items: &[(u16, u16)]) -> Effect {
    let register = |point: ModelPoint| {
        let index = profile.model_index(point)?;
        profile.points.get(profile.behind(index))?.raw()
    };
    let covered = |point: ModelPoint| {
        register(point).is_some_and(|raw| items.iter().any(|(address, _)| raw.covers(table, *address)))
    };
    let runs = |wanted: bool| {
        let mut items = items.iter();
        items.any(|(address, word)| profile.runs_by(table, *address, *word) == Some(wanted))
    };
    // A write with both a run and a stop in it counts as a stop.
    let run = match (runs(false), runs(true)) {
        (true, _) => Some(false),
        (false, true) => Some(true),
        (false, false) => None,
    };
    let bit = |point: ModelPoint| {
        let raw = register(point)?;
        let (_, word) = items.iter().find(|(address, _)| raw.covers(table, *address))?;
        raw.decode(&[*word], drivegate_model::drive::model::Kind::Bool)
    };
    let by_control = || {
        let control = profile.control.as_ref().filter(|control| control.at.table == table)?;
        let (_, word) = items.iter().find(|(address, _)| *address == control.at.address)?;
        control.direction_of(*word)
    };
    let commands = |address: u16| {
        let control = profile.control.as_ref().map(|control| control.at);
        let mut places = profile.run_place().into_iter().chain(control);
        places.any(|place| (place.table, place.address) == (table, address))
    };
    let no_stop = |(address, word): &(u16, u16)| commands(*address) && !profile.is_stop(table, *address, *word);
    Effect {
        stops: false,
        run,
        reverse: bit(ModelPoint::Reverse)
            .map(|value| value.as_bool())
            .or_else(by_control),
        reference: covered(ModelPoint::SpeedReference) || covered(ModelPoint::FrequencyReference),
        word: items.iter().any(no_stop),
    }
}

/// Effects of a command on all drives that it reaches.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Effects {
    on: Vec<(DriveIndex, Effect)>,
    /// The registers that the command sets, and the registers on which it depends.
    pub touches: Touched,
}

impl Effects {
    /// Effects of a command on one drive.
    pub fn on_one(drive: DriveIndex, effect: Effect, touches: Touched) -> Effects {
        Effects {
            on: vec![(drive, effect)],
            touches,
        }
    }

    /// Effects of a command on several drives.
    pub fn on_all(on: Vec<(DriveIndex, Effect)>, touches: Touched) -> Effects {
        Effects { on, touches }
    }

    /// The drives that the command reaches.
    pub fn drives(&self) -> impl Iterator<Item = DriveIndex> + '_ {
        self.on.iter().map(|(drive, _)| *drive)
    }

    /// Effect on this drive; no effect if the command does not reach it.
    pub fn on(&self, drive: DriveIndex) -> Effect {
        let on = self.on.iter().find(|(of, _)| *of == drive);
        on.map(|(_, effect)| *effect).unwrap_or_default()
    }

    /// Every drive that the command reaches, with the effect on it.
    pub fn iter(&self) -> impl Iterator<Item = (DriveIndex, Effect)> + '_ {
        self.on.iter().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_model::drive::Value;
    use drivegate_model::drive::profile::{Form, Profiles};
    use drivegate_proto::RequestPdu;

    #[test]
    fn points_and_registers_say_the_same() {
        let profiles = Profiles::built_in();
        for profile in profiles.iter() {
            let run = profile.model_point(ModelPoint::Run).and_then(|run| run.raw());
            let Some((raw, Form::Bit { bit, invert })) = run.map(|raw| (raw, raw.form)) else {
                continue;
            };
            let point = |point: ModelPoint| profile.model_index(point).unwrap();
            for on in [false, true] {
                let order = Order::Points(vec![(point(ModelPoint::Run), Value::Bool(on))]);
                assert_eq!(Effect::of(&order, profile).run, Some(on), "{}", profile.name);
                let value = u16::from(on != invert) << bit;
                let pdu = match raw.table {
                    Table::Coil => RequestPdu::WriteCoil {
                        address: raw.address,
                        on: on != invert,
                    },
                    _ => RequestPdu::write_register(raw.address, value),
                };
                assert_eq!(
                    Effect::of(&Order::Write(pdu), profile).run,
                    Some(on),
                    "{}",
                    profile.name
                );
            }
            for reference in [ModelPoint::SpeedReference, ModelPoint::FrequencyReference] {
                let Some(index) = profile.model_index(reference) else {
                    continue;
                };
                let order = Order::Points(vec![(index, Value::Number(1.0))]);
                let only = Effect {
                    reference: true,
                    ..Effect::default()
                };
                assert_eq!(Effect::of(&order, profile), only, "{}", profile.name);
            }
        }
        let nx = profiles.get("vacon-nx").unwrap();
        let other = Order::Write(RequestPdu::Other(vec![0x43, 1]));
        assert_eq!(Effect::of(&other, nx), Effect::UNKNOWN);
    }
}
