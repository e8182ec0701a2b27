//! Whether an order is still wanted: it has not expired, and no stop was accepted since its first byte came.

use crate::order::{Order, Outcome};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, drive: &DriveGate, _: &Gate) -> Verdict {
    let window = &ask.intent.window;
    // A started order ends by its own clock: it still clears a reset bit that it has set.
    if ask.stage != Stage::Write && window.expires <= ask.now {
        return Verdict::Refuse(Outcome::Expired);
    }
    let reads = matches!(ask.intent.order, Order::Read(_));
    let stopped = drive
        .last_stop
        .as_ref()
        .is_some_and(|stop| stop.is_after(&window.arrival));
    match stopped && !reads {
        true => Verdict::Refuse(Outcome::Purged),
        false => Verdict::Go,
    }
}
