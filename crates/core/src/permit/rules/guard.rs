//! Whether the guard of the drive lets its motor start now: how often, how long after it stood, how close to others.

use crate::order::Refusal;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::start_guard::BusGuards;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, gate: &Gate) -> Verdict {
    let Some(starts) = &gate.starts else { return Verdict::Go };
    if !ask.effect().starts() || !starts.is_started_by_run(ask.drive) {
        return Verdict::Go;
    }
    match ask.stage {
        Stage::Accept | Stage::Turn => may_begin(ask, starts),
        // Its start was counted when its turn came, or it did not start the motor then.
        Stage::Write if starts.is_cleared(ask.drive, ask.intent.number) => Verdict::Go,
        Stage::Write => refuse(starts.stopped_since(ask.drive)),
    }
}

fn may_begin(ask: &Ask<'_>, starts: &BusGuards) -> Verdict {
    let together = starts.too_close_together(ask.drive, &ask.intent.effects);
    if together.is_some() {
        return refuse(together);
    }
    if starts.is_cleared(ask.drive, ask.intent.number) {
        return Verdict::Go;
    }
    let Some(hindrance) = starts.hindered(ask.drive, ask.now) else {
        return Verdict::Go;
    };
    let at = ask.now + hindrance.retry_after;
    match ask.intent.waits_until() {
        Some(until) if at <= until => Verdict::Wait(at),
        _ => refuse(Some(hindrance)),
    }
}

fn refuse(guarded: Option<crate::order::Guarded>) -> Verdict {
    Verdict::unless(guarded.map(|guarded| Refusal::Guarded(Box::new(guarded))))
}
