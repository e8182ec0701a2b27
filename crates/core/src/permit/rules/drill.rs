//! Whether a drill is in progress on the drive: no other order is sent meanwhile, and a stop ends the drill. While
//! the drill keeps the line silent, nothing but stops is sent to the drive.

use crate::order::{Holder, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, drive: &DriveGate, _: &Gate) -> Verdict {
    let Some(drill) = &drive.drill else { return Verdict::Go };
    if ask.changes() && !ask.origin.is_drill() {
        return Verdict::refuse(Refusal::HeldByOther(Box::new(Holder {
            who: drill.who.clone(),
            rank: "drill".to_string(),
            keeps: "is in progress; a stop ends it".to_string(),
            left_s: None,
        })));
    }
    match drill.quiet_until {
        Some(until) if ask.now < until => Verdict::Wait(until),
        _ => Verdict::Go,
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::order::{Origin, SourceKind};
    use crate::permit::DrillLock;
    use crate::permit::rules::tests::Trial;

    #[test]
    fn during_a_drill_its_own_orders_pass_and_in_its_silence_only_stops() {
        let (all, silent) = (
            "held_by_other held_by_other held_by_other",
            "wait 500 wait 500 wait 500",
        );
        // The drill, the client, its order, and what becomes of that.
        let table = [
            ("none", "client", "start", "go go go"),
            ("moves", "client", "start", all),
            ("moves", "client", "reference", all),
            ("moves", "client", "reverse", all),
            ("moves", "client", "reset", all),
            ("moves", "client", "parameter", all),
            ("moves", "client", "read", "go go go"),
            ("moves", "client", "stop", "- - -"),
            ("moves", "drill", "start", "go go go"),
            ("moves", "drill", "reference", "go go go"),
            ("is silent", "client", "start", all),
            ("is silent", "client", "read", silent),
            ("is silent", "client", "stop", "- - -"),
            ("is silent", "drill", "reference", silent),
            ("was silent", "client", "start", all),
            ("was silent", "client", "read", "go go go"),
            ("was silent", "drill", "reference", "go go go"),
        ];
        for (drill, who, order, expected) in table {
            let mut trial = Trial::new();
            let half_a_second = Duration::from_millis(500);
            let quiet_until = match drill {
                "is silent" => Some(trial.now + half_a_second),
                "was silent" => Some(trial.now),
                _ => None,
            };
            let who_drills = "drill 1".to_string();
            trial.drive.drill = (drill != "none").then_some(DrillLock {
                who: who_drills.clone(),
                quiet_until,
            });
            let client = Origin::new(SourceKind::Http, "alice");
            let origin = match who {
                "drill" => client.of_drill(who_drills),
                _ => client,
            };
            assert_eq!(
                trial.verdicts(&RULE, order, &origin),
                expected,
                "drill {drill}: {order} of the {who}"
            );
        }
    }
}
