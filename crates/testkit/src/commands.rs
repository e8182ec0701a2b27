//! Reads commands from queues without a client, and their audit records.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_core::order::{Answer, Arrival, Audit, Command, CommandLog, Origin, SourceKind, Ticket, Urgency, Window};
use drivegate_core::queue::{CommandQueue, Pending, Ready};
use serde_json::Value;
use tokio::sync::oneshot::Receiver;

/// All kept records of the audit, oldest first. A record that is not valid JSON becomes null.
pub fn audited(audit: &Audit) -> Vec<Value> {
    let lines = audit.recent(None);
    lines
        .iter()
        .map(|line| serde_json::from_str(line).unwrap_or_default())
        .collect()
}

/// Takes the next command of this rank or a higher one, with every drive ready and no stop redundant.
pub fn next_command(pending: &mut Pending, lowest: Urgency, now: Instant) -> Option<Command> {
    let ranks = [Urgency::Stop, Urgency::Command, Urgency::Read];
    let chosen = ranks
        .into_iter()
        .filter(|rank| *rank <= lowest)
        .find_map(|rank| pending.next(rank, now, &(), |_| Ready::Now, |_| false).chosen)?;
    pending.take(chosen)
}

/// Takes the next command of a queue, of any rank.
pub fn take_next(queue: &CommandQueue, now: Instant) -> Option<Command> {
    next_command(&mut queue.lock(), Urgency::Read, now)
}

/// The time window of a command that arrives at `now` over a new connection and may be sent until `expiry` has passed.
pub fn window(now: Instant, expiry: Duration) -> Window {
    Window {
        arrival: Arrival::now(now),
        expires: now + expiry,
        waits: false,
    }
}

/// The ticket of a command of an MQTT client to drive `d`, and where its answer arrives.
pub fn ticket(command_log: &Arc<CommandLog>, now: Instant) -> (Ticket, Receiver<Answer>) {
    let origin = Origin::new(SourceKind::Mqtt, "t");
    Ticket::new(origin, "d", "run=true".to_string(), true, now, command_log.clone())
}
