//! Reads commands from queues without a client, and their audit records.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_core::order::{
    Answer, Arrival, Audit, Authority, Command, CommandLog, DEFAULT_EXPIRY, Order, Origin, SourceKind, Ticket, Urgency,
    Window,
};
use drivegate_core::permit::admit;
use drivegate_core::plant::BusHandle;
use drivegate_core::queue::{CommandQueue, Pending, Ready};
use drivegate_model::drive::DriveIndex;
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

/// Submits an order of a client that may write to a drive of a bus, and where its answer arrives. The order is admitted by
/// what the drive shows at `now`.
pub fn submit(
    bus: &BusHandle,
    drive: DriveIndex,
    origin: Origin,
    order: Order,
    window: Window,
    now: Instant,
) -> Receiver<Answer> {
    let image = bus.image.drives.of(drive);
    let writes = !matches!(order, Order::Read(_));
    let admitted = admit(order, &image.reading(now, DEFAULT_EXPIRY), Authority::Write).unwrap();
    let (ticket, answer) = Ticket::new(origin, "d", String::new(), writes, now, bus.command_log.clone());
    let command = Command::new(drive, admitted, &image.spec.profile, window, ticket);
    bus.queue.submit(command, &(), now);
    answer
}
