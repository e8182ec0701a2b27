//! The effect of a command on the priority arrays of a drive. Pure.

use crate::codec::Table;
use crate::command::{Order, written};
use crate::drive::{ModelPoint, PointIndex, Profile, Source};

/// The prioritised points that a command sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Effect {
    /// The run command.
    pub run: Option<bool>,
    /// The direction.
    pub reverse: Option<bool>,
    /// A reference.
    pub reference: bool,
    /// A raw word at the place of the run command that is no stop.
    pub word: bool,
}

impl Effect {
    /// Unknown effect: it may start the motor, and set a reference.
    pub const UNKNOWN: Effect = Effect {
        run: Some(true),
        reverse: None,
        reference: true,
        word: true,
    };

    /// The effect of a command on a drive of that profile.
    pub fn of(order: &Order, profile: &Profile) -> Effect {
        match order {
            Order::Points(values) => {
                let mut effect = Effect::default();
                for (index, value) in values {
                    let is = |point: ModelPoint| {
                        profile
                            .model_index(point)
                            .is_some_and(|own| behind(profile, own) == behind(profile, *index))
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

/// The point whose register accepts the commands for a point.
fn behind(profile: &Profile, index: PointIndex) -> PointIndex {
    let mut at = index;
    // A point rests on one with a register, over one that takes its commands.
    for _ in 0..4 {
        let Some(point) = profile.points.get(at) else { return at };
        let next = match (&point.source, point.write_to) {
            (_, Some(target)) => Some(target),
            (Source::Derived(derived), None) => derived.band().map(|(of, ..)| of),
            (Source::Raw(_), None) => None,
        };
        match next {
            Some(next) => at = next,
            None => return at,
        }
    }
    at
}

fn raw(profile: &Profile, table: Table, items: &[(u16, u16)]) -> Effect {
    let register = |point: ModelPoint| {
        let index = profile.model_index(point)?;
        profile.points.get(behind(profile, index))?.raw()
    };
    let covered = |point: ModelPoint| {
        register(point).is_some_and(|raw| items.iter().any(|(address, _)| raw.covers(table, *address)))
    };
    let runs = |wanted: bool| {
        let mut items = items.iter();
        items.any(|(address, word)| profile.runs_by(table, *address, *word) == Some(wanted))
    };
    // One that says both is a stop.
    let run = match (runs(false), runs(true)) {
        (true, _) => Some(false),
        (false, true) => Some(true),
        (false, false) => None,
    };
    let bit = |point: ModelPoint| {
        let raw = register(point)?;
        let (_, word) = items.iter().find(|(address, _)| raw.covers(table, *address))?;
        raw.decode(&[*word], crate::drive::model::Kind::Bool)
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
        run,
        reverse: bit(ModelPoint::Reverse)
            .map(|value| value.as_bool())
            .or_else(by_control),
        reference: covered(ModelPoint::SpeedReference) || covered(ModelPoint::FrequencyReference),
        word: items.iter().any(no_stop),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::RequestPdu;
    use crate::drive::Value;
    use crate::drive::profile::{Form, Profiles};

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
