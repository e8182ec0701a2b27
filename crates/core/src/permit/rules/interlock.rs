//! Whether the interlock points of a start are read, good and have the required values; also for a reference that
//! would turn a motor whose run command is on.

use crate::order::Refusal;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::start_guard::ByRun;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, gate: &Gate) -> Verdict {
    let Some(starts) = &gate.starts else { return Verdict::Go };
    let begins = ask.effect().starts() && starts.by_run(ask.drive) != ByRun::Runs;
    if !begins && !ask.wakes() {
        return Verdict::Go;
    }
    let unmet = starts.interlocked(ask.drive, ask.now);
    Verdict::unless(unmet.map(|unmet| Refusal::Interlocked(unmet.why)))
}
