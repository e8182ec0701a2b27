//! Commands that stop a drive and do something else, too: the stop is sent separately, with the rights of a stop, and
//! the rest is checked, queued and completed as a separate command. Pure.

use std::sync::{Arc, OnceLock};

use super::{Order, Outcome, written};
use drivegate_model::drive::{ModelPoint, PointIndex, Profile, Value};
use drivegate_proto::{RequestPdu, Table};

/// A command split into its stop and its rest.
#[derive(Debug, Clone, PartialEq)]
pub enum Parts {
    /// The order has no stop, or consists only of a stop.
    One(Order),
    /// The stop part of the order, and the rest.
    Two(Order, Order),
}

/// The role of a point in a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// The point takes the run command away.
    Stop,
    /// The point sets the run command to run.
    Run,
    /// The point takes another command away (direction, reset), as the control word of a stop does; such a write
    /// alone is not a stop.
    Clears,
    Other,
}

impl Parts {
    /// Splits the stop off a command. A contradictory one that both stops and runs is left whole.
    pub fn of(order: Order, profile: &Profile) -> Parts {
        match order {
            Order::Points(values) => of_points(values, profile),
            Order::Write(pdu) => match stop_in(&pdu, profile) {
                Some(stop) => Parts::Two(Order::Write(stop), Order::Write(pdu)),
                None => Parts::One(Order::Write(pdu)),
            },
            Order::Read(_) | Order::Parameter(_) => Parts::One(order),
        }
    }
}

/// The stop part of a command: the values that are written even if the rest is refused. `None` if the command does
/// not stop, or contradicts itself.
pub fn stop_of(values: &[(PointIndex, Value)], profile: &Profile) -> Option<Vec<(PointIndex, Value)>> {
    let role = |(index, value): &(PointIndex, Value)| role(profile, *index, *value);
    let stops = values.iter().any(|value| role(value) == Role::Stop);
    let runs = values.iter().any(|value| role(value) == Role::Run);
    if !stops || runs {
        return None;
    }
    let mut stop: Vec<(PointIndex, Value)> = Vec::new();
    for value in values {
        if matches!(role(value), Role::Stop | Role::Clears) && !stop.iter().any(|(index, _)| *index == value.0) {
            stop.push(*value);
        }
    }
    Some(stop)
}

fn of_points(values: Vec<(PointIndex, Value)>, profile: &Profile) -> Parts {
    let Some(stop) = stop_of(&values, profile) else {
        return Parts::One(Order::Points(values));
    };
    let other = |(index, value): &(PointIndex, Value)| role(profile, *index, *value) == Role::Other;
    let rest: Vec<(PointIndex, Value)> = values.into_iter().filter(other).collect();
    if rest.is_empty() {
        Parts::One(Order::Points(stop))
    } else {
        Parts::Two(Order::Points(stop), Order::Points(rest))
    }
}

fn role(profile: &Profile, index: PointIndex, value: Value) -> Role {
    // A point may take its commands at another point's address.
    let place = profile
        .points
        .get(index)
        .and_then(|point| point.write_to)
        .unwrap_or(index);
    let is = |point: ModelPoint| profile.model_index(point) == Some(place);
    match value.as_f64() {
        0.0 if is(ModelPoint::Run) => Role::Stop,
        _ if is(ModelPoint::Run) => Role::Run,
        0.0 if is(ModelPoint::Reverse) || is(ModelPoint::FaultReset) => Role::Clears,
        _ => Role::Other,
    }
}

/// The write of only the control word, or its coil, taken from a write of several items that clears the run command.
fn stop_in(pdu: &RequestPdu, profile: &Profile) -> Option<RequestPdu> {
    let (table, items) = written(pdu)?;
    let stops = |(address, value): &&(u16, u16)| profile.is_stop(table, *address, *value);
    let (address, value) = *items.iter().find(stops).filter(|_| items.len() > 1)?;
    Some(match table {
        Table::Coil | Table::DiscreteInput => RequestPdu::WriteCoil {
            address,
            on: value != 0,
        },
        Table::Holding | Table::Input => RequestPdu::WriteRegister { address, value },
    })
}

/// Result of the stop of a compound command, shared with its rest: after a failed stop the rest is not sent.
#[derive(Debug, Clone, Default)]
pub struct StopEnd(Arc<OnceLock<bool>>);

impl StopEnd {
    pub(super) fn note(&self, outcome: &Outcome) {
        // Only the first result counts.
        let _ = self.0.set(outcome.is_ok());
    }

    /// Whether the stop ended without the drive's acknowledgement.
    pub fn has_failed(&self) -> bool {
        self.0.get() == Some(&false)
    }
}

/// The outcome of a command in two parts; `None` while a part has no outcome.
pub fn joined(stop: Option<Outcome>, rest: Option<Outcome>) -> Option<Outcome> {
    match (stop?, rest) {
        (stop, None) if stop.is_ok() => None,
        (stop, Some(rest)) if stop.is_ok() && rest.is_ok() => Some(stop),
        (stop, Some(rest)) if stop.is_ok() => Some(Outcome::StopOnly(Box::new(rest))),
        // The rest is not sent, or was refused before the stop.
        (stop, _) => Some(Outcome::StopFailed(Box::new(stop))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testkit;

    fn parts(profile: &str, points: &[(&str, f64)]) -> (Vec<String>, Vec<String>) {
        let profile = testkit::profile(profile);
        let values = points.iter().map(|(name, value)| {
            let index = profile.point_index(name).unwrap();
            (index, Value::Number(*value))
        });
        let names = |order: Order| match order {
            Order::Points(values) => values
                .iter()
                .map(|(i, _)| profile.points.get(*i).unwrap().name.clone())
                .collect(),
            _ => Vec::new(),
        };
        match Parts::of(Order::Points(values.collect()), &profile) {
            Parts::One(order) => (names(order), Vec::new()),
            Parts::Two(stop, rest) => (names(stop), names(rest)),
        }
    }

    #[test]
    fn a_stop_goes_alone_with_what_takes_commands_away() {
        for profile in ["vacon-nx", "vacon-nx-n2", "vacon-cx", "teco-7300pa", "teco-7300pa-n2"] {
            let (stop, rest) = parts(profile, &[("speed_reference", 5.0), ("run", 0.0)]);
            assert_eq!(
                (stop, rest),
                (vec!["run".to_string()], vec!["speed_reference".to_string()]),
                "{profile}"
            );
        }
        let (stop, rest) = parts("vacon-nx", &[("run", 0.0), ("reverse", 0.0), ("fault_reset", 0.0)]);
        assert_eq!((stop.len(), rest.len()), (3, 0));
        let (stop, rest) = parts("vacon-nx", &[("run", 0.0), ("reverse", 1.0), ("fault_reset", 1.0)]);
        assert_eq!(
            (stop.join(" "), rest.join(" ")),
            ("run".into(), "reverse fault_reset".into())
        );
        let whole: [&[(&str, f64)]; 3] = [
            &[("run", 1.0), ("speed_reference", 5.0)],
            &[("run", 1.0), ("run", 0.0)],
            &[("reverse", 0.0), ("speed_reference", 5.0)],
        ];
        for points in whole {
            assert_eq!(parts("vacon-nx", points).0.len(), 2, "{points:?}");
        }
        assert_eq!(
            parts("vacon-nx", &[("run", 0.0), ("run", 0.0)]).0.len(),
            1,
            "said twice"
        );
    }

    #[test]
    fn a_block_with_a_stop_is_sent_behind_its_control_word() {
        let profile = testkit::nx();
        let raw = profile.run_place().unwrap();
        let block = |word: u16| RequestPdu::WriteRegisters {
            start: raw.address,
            values: vec![word, 0, 5000],
        };
        let stop = RequestPdu::write_register(raw.address, 0);
        let two = Parts::Two(Order::Write(stop.clone()), Order::Write(block(0)));
        assert_eq!(Parts::of(Order::Write(block(0)), &profile), two);
        for whole in [block(1), stop] {
            let order = Order::Write(whole);
            assert_eq!(Parts::of(order.clone(), &profile), Parts::One(order));
        }
    }

    #[test]
    fn one_answer_tells_both_parts() {
        use drivegate_proto::Reply;
        let done = || Some(Outcome::Acknowledged(Reply::Written));
        assert_eq!(joined(None, done()), None);
        assert_eq!(joined(done(), None), None);
        assert_eq!(joined(done(), done()), done());
        let only = joined(done(), Some(Outcome::Purged)).unwrap();
        assert_eq!((only.code(), only.is_ok()), ("stop_only", false));
        let failed = joined(Some(Outcome::TimedOut), None).unwrap();
        assert_eq!((failed.code(), failed.is_ok()), ("timeout", false));
        assert!(
            failed.to_string().contains("the rest of the command was not sent"),
            "{failed}"
        );
    }
}
