//! The orders of a world: their content, progress and outcome.

use std::time::Instant;

use drivegate_core::order::{Order, written};
use drivegate_model::drive::{ModelPoint, Point, PointIndex, Profile, Value};
use drivegate_proto::{RequestPdu, Table};
use drivegate_sim::random::Random;

/// The kind of an order in a world.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wish {
    Reference,
    Run,
    RunAtReference,
    Stop,
    StopAtReference,
    RawStop,
    RawRun,
    /// By function 16, several registers of the control block (Vacon NX).
    RawBlock(bool),
    Reset,
    Reverse,
    /// A parameter that the drive stores: the acceleration time (N2).
    Parameter,
    RawRead,
    /// By function 5, 6 or 16, registers of which the last belongs to no point, or to one that is not writable.
    RawOther,
    /// A speed in the unit that the drive does not use: Hz for one with percent, percent for one with Hz.
    Converted,
}

impl Wish {
    pub fn is_stop(self) -> bool {
        matches!(
            self,
            Wish::Stop | Wish::StopAtReference | Wish::RawStop | Wish::RawBlock(false)
        )
    }

    pub fn is_run(self) -> bool {
        matches!(
            self,
            Wish::Run | Wish::RunAtReference | Wish::RawRun | Wish::RawBlock(true)
        )
    }

    /// Whether the order replaces an older waiting one: a reference, or an equal parameter.
    pub fn replaces(self, older: Wish) -> bool {
        let is_reference = |wish| matches!(wish, Wish::Reference | Wish::Converted);
        (is_reference(self) && (is_reference(older) || older == Wish::StopAtReference))
            || (self == Wish::Parameter && older == self)
    }

    /// A random kind of order.
    pub fn of(dice: &mut Random) -> Wish {
        match dice.within(0..=99) {
            0..=29 => Wish::Reference,
            30..=41 => Wish::Run,
            42..=51 => Wish::RunAtReference,
            52..=68 => Wish::Stop,
            69..=73 => Wish::StopAtReference,
            74..=77 => Wish::RawStop,
            78..=80 => Wish::RawRun,
            81..=82 => Wish::RawBlock(true),
            83..=85 => Wish::RawBlock(false),
            86..=91 => Wish::Reset,
            92..=94 => Wish::Reverse,
            95..=96 => Wish::Parameter,
            _ => Wish::RawRead,
        }
    }
}

/// Words that only one order writes.
pub type Unique = (Table, u16, Vec<u16>);

/// An order with its progress.
#[derive(Debug, Clone)]
pub struct Record {
    pub client: usize,
    pub bus: usize,
    pub drive: usize,
    pub wish: Wish,
    pub accepted: Instant,
    pub expires: Instant,
    pub unique: Option<Unique>,
    /// Place in the order of acceptance; a newer reference takes the place of the one that it replaces.
    pub place: usize,
    /// The earliest possible place of the order: the rest of a waiting stop, which it replaces, is answered with the stop.
    pub earliest: usize,
    pub sent: Option<Instant>,
    pub answer: Option<(String, Instant)>,
    pub read: Option<(RequestPdu, Option<Vec<u16>>)>,
    /// Number of orders to the same drive that were waiting when this one was accepted and that go before it.
    pub before: usize,
    /// Whether a newer reference replaced the order.
    pub succeeded: bool,
}

/// The writable register with a separate figure that sets the speed, and the values that it accepts.
pub fn reference_point(profile: &Profile) -> (PointIndex, &Point) {
    let names = ["speed_reference", "frequency_reference", "frequency_command"];
    let index = names.iter().find_map(|name| {
        let index = profile.point_index(name)?;
        let point = profile.points.get(index).unwrap();
        (point.write && point.write_to.is_none() && point.raw().is_some()).then_some(index)
    });
    let index = index.unwrap_or_else(|| panic!("{} has no reference", profile.name));
    (index, profile.points.get(index).unwrap())
}

/// A value of the reference that no order has used recently, with its words.
pub fn unique_reference(profile: &Profile, number: usize) -> (PointIndex, Value, Unique) {
    let (index, point) = reference_point(profile);
    let raw = point.raw().unwrap();
    // 0 to 40 in hundredths: within what every family takes, and never what supervision sets (20 %, of any range).
    let hundredths = match number % 4_000 {
        1_000 => 4_001,
        1_200 => 4_002,
        1_600 => 4_003,
        2_000 => 4_004,
        other => other,
    };
    let value = Value::Number(hundredths as f64 / 100.0);
    let words = raw.encode(value, 0).unwrap();
    (index, value, (raw.table, raw.address, words))
}

/// Whether the drive has its reference in percent, so that one in Hz is converted.
pub fn converts_hertz(profile: &Profile) -> bool {
    reference_point(profile).1.unit == "%"
}

/// Words that the converted order of this number writes to a drive with this maximum frequency: half a count may be
/// rounded either way.
pub fn converted(profile: &Profile, number: usize, maximum: f64) -> impl Iterator<Item = Unique> {
    const ROUNDING: f64 = 1e-6;
    let (_, value, _) = unique_reference(profile, number);
    let percent = if converts_hertz(profile) {
        value.as_f64() * 100.0 / maximum
    } else {
        value.as_f64()
    };
    let either = [percent - ROUNDING, percent + ROUNDING];
    either
        .into_iter()
        .filter_map(move |percent| percent_reference(profile, percent, maximum))
}

/// A speed reference in percent of a drive with this maximum frequency, in the units of its register; `None` if it
/// does not fit into a single word.
pub fn percent_reference(profile: &Profile, percent: f64, maximum: f64) -> Option<Unique> {
    let (_, point) = reference_point(profile);
    let raw = point.raw()?;
    let own = if point.unit == "%" {
        percent
    } else {
        percent * maximum / 100.0
    };
    let own = Value::Number((own * 100.0).round() / 100.0);
    Some((raw.table, raw.address, raw.encode(own, 0).ok()?))
}

/// The order for a wish, with the words that only this order writes; `None` if the family has no such order.
pub fn order_of(profile: &Profile, wish: Wish, number: usize) -> Option<(Order, Option<Unique>)> {
    let run = |on: bool| (profile.model_index(ModelPoint::Run).unwrap(), Value::Bool(on));
    let (reference, value, unique) = unique_reference(profile, number);
    let place = profile.run_place().unwrap();
    let started = profile.control.as_ref().unwrap().runs()[0].applied(0);
    let raw_run = |on: bool| match place.table {
        Table::Coil => RequestPdu::WriteCoil {
            address: place.address,
            on,
        },
        _ => RequestPdu::WriteRegister {
            address: place.address,
            value: if on { started } else { 0 },
        },
    };
    let model =
        |point: ModelPoint, value: Value| Some((Order::Points(vec![(profile.model_index(point)?, value)]), None));
    match wish {
        Wish::Reference => Some((Order::Points(vec![(reference, value)]), Some(unique))),
        Wish::Run => Some((Order::Points(vec![run(true)]), None)),
        Wish::RunAtReference => Some((Order::Points(vec![run(true), (reference, value)]), Some(unique))),
        Wish::Stop => Some((Order::Points(vec![run(false)]), None)),
        Wish::StopAtReference => Some((Order::Points(vec![run(false), (reference, value)]), Some(unique))),
        Wish::RawStop => Some((Order::Write(raw_run(false)), None)),
        Wish::RawRun => Some((Order::Write(raw_run(true)), None)),
        Wish::RawBlock(on) => {
            let values = vec![u16::from(on), 0, unique.2[0]];
            (profile.name == "vacon-nx").then_some((
                Order::Write(RequestPdu::WriteRegisters {
                    start: place.address,
                    values,
                }),
                Some(unique),
            ))
        }
        Wish::Reset => model(ModelPoint::FaultReset, Value::Bool(true)),
        Wish::Reverse => model(ModelPoint::Reverse, Value::Bool(number.is_multiple_of(2))),
        Wish::Parameter => {
            let named = profile.point_index("acceleration_time");
            let index = named.filter(|_| profile.name.ends_with("n2"))?;
            let raw = profile.points.get(index).unwrap().raw()?;
            // 1 to 20.99 s.
            let value = Value::Number((100 + number % 2_000) as f64 / 100.0);
            let words = raw.encode(value, 0).ok()?;
            Some((
                Order::Points(vec![(index, value)]),
                Some((raw.table, raw.address, words)),
            ))
        }
        Wish::Converted => {
            let point = if converts_hertz(profile) {
                ModelPoint::FrequencyReference
            } else {
                ModelPoint::SpeedReference
            };
            let writes =
                |index: &PointIndex| profile.points.get(*index).unwrap().write && !profile.name.ends_with("n2");
            let index = profile.model_index(point).filter(writes)?;
            Some((Order::Points(vec![(index, value)]), None))
        }
        Wish::RawOther => Some((Order::Write(raw_other(profile, number)?), None)),
        Wish::RawRead => {
            let (table, start, count) = match profile.name.as_str() {
                "vacon-nx" => (Table::Holding, 1500, 1),
                "vacon-cx" => (Table::Holding, 100, 1),
                _ => return None,
            };
            Some((Order::Read(RequestPdu::Read { table, start, count }), None))
        }
    }
}

/// Whether a command to a point sets that register or coil.
pub fn is_of_writable_point(profile: &Profile, table: Table, address: u16) -> bool {
    let sets = |point: &Point| point.write && point.write_to.is_none();
    let mut points = profile.points.iter().filter(|point| sets(point));
    points.any(|point| point.raw().is_some_and(|raw| raw.covers(table, address)))
}

/// A permitted write outside the writable points: near the end of a range, where a simulated drive has nothing that
/// affects its motor, or the general control word; alone, or after a writable register.
fn raw_other(profile: &Profile, number: usize) -> Option<RequestPdu> {
    let ranges = profile.ranges.iter().filter(|range| range.write > 0);
    let last = ranges.flat_map(|range| {
        let (first, last) = range.addresses.clone().into_inner();
        (last.saturating_sub(8).max(first)..=last).map(move |address| (range.table, address, range.write))
    });
    let named = profile.point_index("general_control_word");
    let word = named.and_then(|index| profile.points.get(index).unwrap().raw());
    let word = word.map(|raw| (raw.table, raw.address, 20));
    let is_point = |table, address| {
        let mut points = profile.points.iter();
        points.any(|point| point.raw().is_some_and(|raw| raw.covers(table, address)))
    };
    let candidates: Vec<_> = last
        .filter(|(table, address, _)| !is_point(*table, *address))
        .chain(word)
        .collect();
    let (table, address, most) = *candidates.get(number % candidates.len().max(1))?;
    Some(match table {
        Table::Coil => RequestPdu::WriteCoil { address, on: true },
        _ if profile.name.ends_with("n2") => RequestPdu::WriteRegisters {
            start: address - address % 2,
            values: vec![0; 2],
        },
        // The process data that follow the general control word.
        _ if most > 1 && number.is_multiple_of(2) => RequestPdu::WriteRegisters {
            start: address,
            values: vec![0; 2],
        },
        _ => RequestPdu::WriteRegister { address, value: 0 },
    })
}

/// Whether a write sets exactly these words.
pub fn sets(pdu: &RequestPdu, (table, address, words): &Unique) -> bool {
    written(pdu).is_some_and(|(of, items)| {
        let has = |(offset, word): (usize, &u16)| items.contains(&(address + offset as u16, *word));
        of == *table && words.iter().enumerate().all(has)
    })
}

/// Effect of a write on the run command: sets it, takes it away, or none.
pub fn run_command(profile: &Profile, pdu: &RequestPdu) -> Option<bool> {
    let place = profile.run_place()?;
    let (table, items) = written(pdu)?;
    let (address, word) = items
        .into_iter()
        .find(|(at, _)| table == place.table && *at == place.address)?;
    Some(!profile.is_stop(table, address, word))
}

/// Whether the own timeout of a drive of that family counts a write.
pub fn is_counted(profile: &Profile, pdu: &RequestPdu) -> bool {
    let (Ok(repeats), Some(control)) = (profile.repeats(), &profile.control) else {
        return false;
    };
    let Some((table, items)) = written(pdu) else {
        return false;
    };
    let by_reference = !repeats.word || control.refresh_with_reference;
    table == Table::Holding
        && items.iter().any(|(address, _)| {
            (repeats.word && *address == control.at.address)
                || (by_reference && profile.is_repeated_reference(*address))
        })
}
