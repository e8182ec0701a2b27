//! Which registers of a drive a command sets, and on which it depends: this decides whether two commands may be
//! reordered. Pure.

use super::{FrequencyRange, Order, written};
use drivegate_model::drive::{PointIndex, Profile, Raw};
use drivegate_proto::Table;

/// A register or coil of a drive.
type Item = (Table, u16);

/// The registers that a command sets or uses.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Touched {
    /// The registers are unknown: any may be affected.
    #[default]
    Anything,
    /// Only these registers are set or used.
    These {
        /// Registers that the command sets.
        sets: Vec<Item>,
        /// Registers by which the values were converted or limited.
        rests_on: Vec<Item>,
    },
}

impl Touched {
    /// The registers that an order to a drive of this profile sets and depends on, with these frequency ranges.
    pub fn of(order: &Order, ranges: &[FrequencyRange], profile: &Profile) -> Touched {
        let raw = |index: PointIndex| profile.points.get(index).and_then(|point| point.raw());
        let items = |raw: &Raw| {
            let table = raw.table;
            raw.addresses()
                .map(move |address| (table, address))
                .collect::<Vec<Item>>()
        };
        let sets: Option<Vec<Item>> = match order {
            // A point without a register of its own is refused before it sets anything.
            Order::Points(values) => {
                let raws = values.iter().filter_map(|(index, _)| raw(*index));
                Some(raws.flat_map(items).collect())
            }
            Order::Write(pdu) => written(pdu).map(|(table, items)| {
                let item = |(address, _)| (table, address);
                items.into_iter().map(item).collect()
            }),
            Order::Read(_) => Some(Vec::new()),
            Order::Parameter(_) => None,
        };
        let ends = ranges.iter().flat_map(FrequencyRange::ends).filter_map(raw);
        sets.map_or(Touched::Anything, |sets| Touched::These {
            sets,
            rests_on: ends.flat_map(items).collect(),
        })
    }

    /// Whether the order in which the two commands are sent makes no difference.
    pub(crate) fn commutes(&self, other: &Touched) -> bool {
        let (
            Touched::These { sets, rests_on },
            Touched::These {
                sets: other_sets,
                rests_on: other_rests_on,
            },
        ) = (self, other)
        else {
            return false;
        };
        let apart = |left: &[Item], right: &[Item]| left.iter().all(|item| !right.contains(item));
        apart(sets, other_sets) && apart(sets, other_rests_on) && apart(rests_on, other_sets)
    }
}
