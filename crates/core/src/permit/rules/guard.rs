//! Whether the guard of the drive permits a start of its motor now: starts per hour, time since standstill, time
//! between starts of a group.

use crate::order::Refusal;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::start_guard::{BusGuards, ByRun};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, gate: &Gate) -> Verdict {
    let Some(starts) = gate.starts.as_ref().filter(|_| ask.effect().starts()) else {
        return Verdict::Go;
    };
    match (ask.stage, starts.by_run(ask.drive)) {
        // A repeated run command is not a new start until the motor was seen to stand again.
        (_, ByRun::Runs | ByRun::Repeats) => Verdict::Go,
        // Another order that was cleared before starts the motor, if anything does.
        (Stage::Accept, _) if starts.has_cleared(ask.drive) => Verdict::Go,
        (Stage::Accept | Stage::Turn, _) => may_begin(ask, starts),
        (Stage::Write, ByRun::Starts) if !starts.is_cleared(ask.drive, ask.intent.number) => {
            refuse(starts.changed_since(ask.drive))
        }
        (Stage::Write, ByRun::Starts | ByRun::Vain) => Verdict::Go,
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
