//! Whether a slot of a BACnet priority array keeps the order, and whether what follows from a write to a slot still does.

use crate::order::{Holder, Order, Outcome, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, drive: &DriveGate, _: &Gate) -> Verdict {
    if matches!(ask.intent.order, Order::Read(_)) {
        return Verdict::Go;
    }
    // An accepted write keeps its slot; whether the order follows from the slots was checked before.
    let follows = |write| ask.stage != Stage::Accept || drive.priorities.still_follows(write);
    if !ask.intent.slot.as_ref().is_none_or(follows) {
        return Verdict::Refuse(Outcome::Replaced);
    }
    let protects = drive.priorities.refuses(ask.origin, ask.effect());
    Verdict::unless(protects.map(|protects| {
        let (what, priority) = (protects.what.name(), protects.priority);
        Refusal::HeldByOther(Box::new(Holder {
            who: format!("the BACnet client {}", protects.client),
            rank: format!("priority {priority}"),
            keeps: format!("holds `{what}` until it releases that slot"),
            left_s: None,
        }))
    }))
}
