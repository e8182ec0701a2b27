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

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use super::*;
    use crate::order::{Origin, SourceKind};
    use crate::permit::rules::tests::{DRIVE, RUNS, SECOND, STANDS, Trial};
    use crate::start_guard::{Guard, Guards};
    use crate::testkit::{bus_spec, controlled, nx, read};

    /// Number of an earlier start; no order gets such a number.
    const EARLIER: u64 = u64::MAX;

    /// A drive with this guard, and what was read and written of it until now.
    fn trial(guard: Option<Guard>, past: &str) -> (Trial, Option<Arc<BusGuards>>) {
        let mut spec = controlled("d1", "b", 1, &nx());
        spec.guard = guard;
        let mut trial = Trial::of(spec);
        let (shared, bus, now) = (Arc::new(Guards::default()), bus_spec("b"), trial.now);
        let Some(guards) = BusGuards::of(&shared, &bus, [&trial.image.spec]) else {
            return (trial, None);
        };
        guards.begin();
        let seen = |words: &[u16], ago: Duration| {
            read(&trial.image, 2100, words, now - ago);
            guards.update(DRIVE, &trial.image.reading(now - ago, 10 * SECOND));
        };
        let start = |ago: Duration| {
            guards.clear(&[DRIVE], EARLIER, now + SECOND, now - ago);
            guards.start_written(DRIVE, EARLIER, &Arc::from("bob"), now - ago);
        };
        seen(STANDS, 20 * SECOND);
        match past {
            "stands" => seen(STANDS, Duration::ZERO),
            "another start is cleared" => {
                seen(STANDS, Duration::ZERO);
                guards.clear(&[DRIVE], EARLIER, now + SECOND, now);
            }
            "started just now" => {
                seen(STANDS, Duration::from_millis(10));
                start(Duration::from_millis(5));
            }
            "runs" => {
                start(10 * SECOND);
                seen(RUNS, Duration::ZERO);
            }
            "stopped 1 s ago" => {
                start(10 * SECOND);
                seen(RUNS, 9 * SECOND);
                guards.stop_written(DRIVE, now - 2 * SECOND);
                seen(STANDS, SECOND);
            }
            other => panic!("no state {other}"),
        }
        trial.gate.set_starts(Some(guards.clone()));
        (trial, Some(guards))
    }

    #[test]
    fn a_start_is_counted_and_spaced_and_a_repetition_of_it_is_not() {
        let none: Option<Guard> = None;
        let once = Some(Guard {
            starts_per_hour: Some(1),
            ..Guard::default()
        });
        let off = |seconds: u32| {
            Some(Guard {
                min_off: seconds * SECOND,
                ..Guard::default()
            })
        };
        let refused = "guarded guarded guarded";
        // The guard, what the motor does, the order (a start that may wait has until 2 s from now), and what becomes of that.
        let table = [
            (none, "stands", "start", "go go go"),
            // No start is written that was not cleared, and with that counted, at its turn.
            (once, "stands", "start", "go go guarded"),
            (once, "stands", "cleared start", "go go go"),
            (once, "another start is cleared", "start", "go guarded guarded"),
            (once, "started just now", "start", "go go go"),
            (once, "runs", "start", "go go go"),
            (once, "stopped 1 s ago", "start", refused),
            (once, "stopped 1 s ago", "start that may wait", refused),
            (off(2), "stopped 1 s ago", "start", refused),
            (
                off(2),
                "stopped 1 s ago",
                "start that may wait",
                "wait 1000 wait 1000 guarded",
            ),
            (off(4), "stopped 1 s ago", "start that may wait", refused),
            (off(1), "stopped 1 s ago", "start", "go go guarded"),
            (once, "stopped 1 s ago", "reference", "go go go"),
            (once, "stopped 1 s ago", "reset", "go go go"),
            (once, "stopped 1 s ago", "reverse", "go go go"),
            (once, "stopped 1 s ago", "read", "go go go"),
            (once, "stopped 1 s ago", "stop", "- - -"),
        ];
        let client = Origin::new(SourceKind::Http, "alice");
        for (guard, past, order, expected) in table {
            let (trial, guards) = trial(guard, past);
            let kind = if order.contains("start") { "start" } else { order };
            let mut intent = trial.intent(kind);
            intent.window.waits = order == "start that may wait";
            if let Some(guards) = guards.filter(|_| order == "cleared start") {
                guards.clear(&[DRIVE], intent.number, intent.window.expires, trial.now);
            }
            let verdicts = trial.verdicts_on(&RULE, &intent, &client);
            assert_eq!(verdicts, expected, "{guard:?}, {past}: {order}");
        }
    }
}
