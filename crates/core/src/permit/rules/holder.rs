//! The holder of the drive, the client for which a stop reserved it, and the clients that must take the drive
//! before a start.
//!
//! A stop is judged only when it is accepted, since a repeated word of a cyclic client is not a stop; an accepted
//! stop is always sent.

use crate::order::{Asks, Holder, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: true,
    judge,
};

fn judge(ask: &Ask<'_>, drive: &DriveGate, gate: &Gate) -> Verdict {
    if ask.effect().stops && ask.stage != Stage::Accept {
        return Verdict::Go;
    }
    let refused = gate.judge_hold(drive, ask.origin, ask.asks(), ask.now);
    Verdict::unless(refused.or_else(|| stops_first(ask, drive)))
}

/// Refuses the start if, since a reload, the machine has a name under which this client commanded another machine.
fn stops_first(ask: &Ask<'_>, drive: &DriveGate) -> Option<Refusal> {
    let is_meant = ask.asks() == Asks::Run && drive.must_stop_first.contains(ask.origin.client());
    is_meant.then(|| {
        Refusal::NeedsTake(Box::new(Holder {
            who: "a reload".to_string(),
            rank: "configuration".to_string(),
            keeps: "gave this name to another machine while this client commanded; send a stop, or take the drive, before run"
                .to_string(),
            left_s: None,
        }))
    })
}
