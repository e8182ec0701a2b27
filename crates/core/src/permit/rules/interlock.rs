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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::order::{Origin, SourceKind};
    use crate::permit::rules::tests::{DRIVE, RUNS, SECOND, STANDS, Trial};
    use crate::start_guard::{BusGuards, Guards, Interlock};
    use crate::testkit::{bus_spec, controlled, image, nx, read};
    use drivegate_proto::Table;

    /// A drive that may start while `ready` of `valve` is set.
    fn trial(valve: &str, motor: &str) -> Trial {
        let mut spec = controlled("d1", "b", 1, &nx());
        if valve != "no interlock" {
            spec.interlocks = vec![Interlock {
                drive: "valve".to_string(),
                point: "ready".to_string(),
                is: true,
                trip: false,
            }];
        }
        let mut trial = Trial::of(spec);
        let process_data = if motor == "runs" { RUNS } else { STANDS };
        read(&trial.image, 2100, process_data, trial.now);
        let run = u16::from(motor != "stands");
        let control_word = |snapshot: &mut crate::process_image::Snapshot| {
            snapshot.store(Table::Holding, 2000, &[run, 0, 0], trial.now);
        };
        trial.image.update(control_word);
        let other = image(controlled("valve", "b", 2, &nx()));
        match valve {
            "ready" => read(&other, 2100, &[1, 0, 0, 0], trial.now),
            "not ready" => read(&other, 2100, &[0, 0, 0, 0], trial.now),
            "ready long ago" => read(&other, 2100, &[1, 0, 0, 0], trial.now - 11 * SECOND),
            _ => {}
        }
        let (shared, bus) = (Arc::new(Guards::default()), bus_spec("b"));
        if let Some(guards) = BusGuards::of(&shared, &bus, [&trial.image.spec, &other.spec]) {
            guards.begin();
            let images = [&trial.image, &other].map(|image| (bus.machine(&image.spec), image.clone()));
            shared.watch(images, 10 * SECOND, trial.now);
            guards.update(DRIVE, &trial.image.reading(trial.now, 10 * SECOND));
            trial.gate.set_starts(Some(guards));
        }
        trial
    }

    #[test]
    fn what_turns_a_standing_motor_needs_a_good_reading_of_its_interlocks() {
        let unmet = "interlocked interlocked interlocked";
        // The interlock, the motor, the order, and what becomes of that.
        let table = [
            ("no interlock", "stands", "start", "go go go"),
            ("ready", "stands", "start", "go go go"),
            ("not ready", "stands", "start", unmet),
            ("ready long ago", "stands", "start", unmet),
            ("never read", "stands", "start", unmet),
            ("not ready", "runs", "start", "go go go"),
            ("not ready", "waits at 0 Hz", "start", unmet),
            ("ready", "waits at 0 Hz", "reference", "go go go"),
            ("not ready", "waits at 0 Hz", "reference", unmet),
            ("not ready", "stands", "reference", "go go go"),
            ("not ready", "runs", "reference", "go go go"),
            ("not ready", "stands", "reset", "go go go"),
            ("not ready", "stands", "reverse", "go go go"),
            ("not ready", "stands", "read", "go go go"),
            ("not ready", "runs", "stop", "- - -"),
        ];
        let client = Origin::new(SourceKind::Http, "alice");
        for (valve, motor, order, expected) in table {
            let verdicts = trial(valve, motor).verdicts(&RULE, order, &client);
            assert_eq!(verdicts, expected, "{valve}, the motor {motor}: {order}");
        }
    }
}
