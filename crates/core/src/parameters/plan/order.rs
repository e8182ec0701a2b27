//! The order of writes in which limits between parameters hold at every step.
//!
//! A write is safe if it breaks no limit that held before it. Of the safe writes, the one with the lowest address
//! goes first. There always is a safe one: of the rising values, the one whose upper limits have all risen; if none
//! rises any more, of the falling values the one whose lower limits have all fallen. A limit that does not hold in
//! the end is ignored.

use std::collections::BTreeMap;

use super::ParameterWrite;
use drivegate_model::drive::parameters::{Limit, RawValue};

/// The writes in an order in which no limit is violated; `present` is the value of the drive at an address.
pub(super) fn safe(
    mut waiting: Vec<ParameterWrite>,
    limits: &[Limit],
    present: impl Fn(u16) -> Option<RawValue>,
) -> Vec<ParameterWrite> {
    waiting.sort_by_key(|write| write.address);
    let bound = limits.iter().flat_map(|limit| [limit.upper, limit.lower]);
    let values = bound.filter_map(|address| Some((address, present(address)?.number())));
    let mut held: BTreeMap<u16, f64> = values.collect();
    let mut end = held.clone();
    end.extend(waiting.iter().map(|write| (write.address, write.to.number())));
    let limits: Vec<&Limit> = limits.iter().filter(|limit| holds(limit, &end)).collect();
    let mut ordered = Vec::with_capacity(waiting.len());
    while !waiting.is_empty() {
        let is_safe = |write: &ParameterWrite| {
            let concerned = |limit: &&&Limit| [limit.upper, limit.lower].contains(&write.address);
            let mut concerned = limits.iter().filter(concerned).peekable();
            if concerned.peek().is_none() {
                return true;
            }
            let mut after = held.clone();
            after.insert(write.address, write.to.number());
            concerned.all(|limit| holds(limit, &after) || !holds(limit, &held))
        };
        // Limits that depend on each other in a circle could leave no possible write; no profile can have such limits.
        let next = waiting.iter().position(is_safe).unwrap_or(0);
        let write = waiting.remove(next);
        held.insert(write.address, write.to.number());
        ordered.push(write);
    }
    ordered
}

/// Whether a limit is met. A limit with an unknown value counts as met.
fn holds(limit: &Limit, values: &BTreeMap<u16, f64>) -> bool {
    match (values.get(&limit.upper), values.get(&limit.lower)) {
        (Some(upper), Some(lower)) => upper >= lower,
        _ => true,
    }
}
