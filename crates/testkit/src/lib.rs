//! What the tests of several packages share.

use std::time::Instant;

use drivegate_core::command::{Audit, Command, Pending, Urgency};
use serde_json::Value;

/// All records of the audit that are kept, oldest first. What cannot be read as JSON is null.
pub fn audited(audit: &Audit) -> Vec<Value> {
    let lines = audit.recent(None);
    lines
        .iter()
        .map(|line| serde_json::from_str(line).unwrap_or_default())
        .collect()
}

/// Takes the next command of that rank or a higher one, where every drive is free and no stop is redundant.
pub fn next_command(pending: &mut Pending, lowest: Urgency, now: Instant) -> Option<Command> {
    let ranks = [Urgency::Stop, Urgency::Command, Urgency::Read];
    let chosen = ranks
        .into_iter()
        .filter(|rank| *rank <= lowest)
        .find_map(|rank| pending.next(rank, now, |_| true, |_| false))?;
    pending.take(chosen)
}
