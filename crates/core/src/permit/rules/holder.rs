//! Who holds the drive, for whom a stop reserved it, and who has to take it before a start.
//!
//! A stop is asked only when it is accepted, since a word that a cyclic client repeats is no stop; an accepted stop is sent.

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
    Verdict::unless(gate.judge_hold(drive, ask.origin, ask.asks(), ask.now))
}
