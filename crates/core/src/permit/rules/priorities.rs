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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::order::{Commanded, Entry, Origin, SlotWrite, SourceKind};
    use crate::permit::rules::tests::Trial;
    use Commanded::{Run, SpeedReference};
    use drivegate_model::drive::Value;

    /// Occupies a slot, as a BACnet client did that was acknowledged.
    fn occupy(trial: &mut Trial, what: Commanded, priority: u8, value: Value) -> Entry {
        let entry = Entry::new(value, Origin::new(SourceKind::Bacnet, "fire"), trial.now);
        trial.drive.priorities.restore(what, priority, entry.clone());
        entry
    }

    #[test]
    fn slots_that_protect_people_refuse_orders_from_elsewhere() {
        use SourceKind::{Bacnet, Http, ModbusTcp, Supervision};
        let (off, on, forty) = (Value::Bool(false), Value::Bool(true), Value::Number(40.0));
        let held = "held_by_other held_by_other held_by_other";
        // The occupied slot, the way in, the order, and what becomes of that.
        let table = [
            (None, Http, "start", "go go go"),
            (Some((Run, 1, off)), Http, "start", held),
            (Some((Run, 5, off)), Http, "start", held),
            (Some((Run, 5, off)), ModbusTcp, "start", held),
            (Some((Run, 6, off)), Http, "start", "go go go"),
            (Some((Run, 5, on)), Http, "start", "go go go"),
            (Some((Run, 5, off)), Bacnet, "start", "go go go"),
            (Some((Run, 5, off)), Supervision, "start", "go go go"),
            (Some((Run, 5, off)), Http, "reference", "go go go"),
            (Some((Run, 5, off)), Http, "reset", "go go go"),
            (Some((Run, 5, off)), Http, "read", "go go go"),
            (Some((Run, 5, off)), Http, "stop", "- - -"),
            (Some((Run, 5, on)), Http, "stop", "- - -"),
            (Some((SpeedReference, 5, forty)), Http, "reference", held),
            (Some((SpeedReference, 6, forty)), Http, "reference", "go go go"),
            (Some((SpeedReference, 5, forty)), Bacnet, "reference", "go go go"),
            (Some((SpeedReference, 5, forty)), Http, "start", "go go go"),
        ];
        for (slot, kind, order, expected) in table {
            let mut trial = Trial::new();
            if let Some((what, priority, value)) = slot {
                occupy(&mut trial, what, priority, value);
            }
            let verdicts = trial.verdicts(&RULE, order, &Origin::new(kind, "c"));
            assert_eq!(verdicts, expected, "{slot:?}: {order} of {kind:?}");
        }
    }

    #[test]
    fn an_order_of_a_slot_is_accepted_only_while_it_follows_from_the_slots() {
        let (off, on) = (Value::Bool(false), Value::Bool(true));
        let client = Origin::new(SourceKind::Bacnet, "cooling");
        // The slots of others, the write to slot 8 (`None` releases it, an order of the next slot follows), and what
        // becomes of the start that was planned.
        let table = [
            (vec![], Some(on), "go go go"),
            (vec![(10, off)], Some(on), "go go go"),
            (vec![(3, off)], Some(on), "replaced go go"),
            (vec![(10, on)], None, "go go go"),
            (vec![], None, "replaced go go"),
            (vec![(3, on), (10, on)], None, "replaced go go"),
        ];
        for (slots, value, expected) in table {
            let mut trial = Trial::new();
            let entry = |value: Value| Entry::new(value, client.clone(), trial.now);
            let (own, written) = (entry(on), value.map(entry));
            let mut heir = written.clone();
            for (priority, value) in &slots {
                let other = occupy(&mut trial, Run, *priority, *value);
                heir = heir.or(Some(other).filter(|_| *priority > 8));
            }
            if written.is_none() {
                trial.drive.priorities.restore(Run, 8, own.clone());
            }
            let write = SlotWrite::new(Run, 8, written);
            let mut intent = trial.intent("start");
            intent.slot = Some(write.governed_by(&heir.unwrap_or(own)));
            let verdicts = trial.verdicts_on(&RULE, &intent, &client);
            assert_eq!(verdicts, expected, "{slots:?} and {value:?} at 8");
        }
    }
}
