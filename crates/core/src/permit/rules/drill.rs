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
