//! Whether a file of an earlier run that may forbid the start is not read yet, as on a disk that hangs.
//!
//! A start is judged when it is accepted: these files are read once, and no order is accepted before that begins. The write shows
//! more: only then is it known that a reference may turn a motor whose run command the drive does not show.

use crate::order::{Asks, Holder, Refusal};
use crate::permit::Mode;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, gate: &Gate) -> Verdict {
    let may_start = ask.asks() == Asks::Run || ask.wakes();
    if !may_start || !ask.origin.kind.is_client() {
        return Verdict::Go;
    }
    let reserves = gate.rules.as_ref().is_some_and(|rules| rules.mode == Mode::Exclusive);
    let reservations = gate.awaited.reservations.path().filter(|_| reserves);
    let slots = || gate.awaited.slots.path();
    Verdict::unless(reservations.or_else(slots).map(|path| {
        Refusal::HeldByOther(Box::new(Holder {
            who: path.display().to_string(),
            rank: "not read yet".to_string(),
            keeps:
                "may keep the drive for another client, so it is not started until the disk answers; check the disk \
                    of state_dir"
                    .to_string(),
            left_s: None,
        }))
    }))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::order::{Origin, SourceKind};
    use crate::permit::rules::tests::{RUNS, SECOND, STANDS, Trial};
    use crate::permit::{AwaitedFiles, Rules};
    use crate::testkit::read;

    fn rules(mode: Mode) -> Arc<Rules> {
        Arc::new(Rules {
            mode,
            ranks: vec!["site".into()],
            lease: 30 * SECOND,
            stop_at_local: true,
            principals: Vec::new(),
        })
    }

    #[test]
    fn a_start_waits_for_the_files_that_may_forbid_it() {
        use SourceKind::{Bacnet, Http, Interlock, ModbusTcp, Supervision};
        let (advisory, exclusive) = (Some(Mode::Advisory), Some(Mode::Exclusive));
        // The file that is not read yet, the mode of `[authority]`, the client, its order, and what becomes of that.
        let table = [
            ("none", exclusive, Http, "start", "go - go"),
            ("slots", None, Http, "start", "held_by_other - held_by_other"),
            ("slots", None, ModbusTcp, "start", "held_by_other - held_by_other"),
            ("slots", None, Bacnet, "start", "held_by_other - held_by_other"),
            ("slots", exclusive, Http, "start", "held_by_other - held_by_other"),
            ("slots", None, Supervision, "start", "go - go"),
            ("slots", None, Interlock, "stop", "- - -"),
            ("slots", None, Http, "reference", "go - held_by_other"),
            ("slots", None, Http, "reset", "go - go"),
            ("slots", None, Http, "stop", "- - -"),
            ("slots", None, Http, "read", "go - go"),
            ("slots, read since", None, Http, "start", "go - go"),
            ("reservations", None, Http, "start", "go - go"),
            ("reservations", advisory, Http, "start", "go - go"),
            (
                "reservations",
                exclusive,
                Http,
                "start",
                "held_by_other - held_by_other",
            ),
            ("reservations", exclusive, Http, "reference", "go - held_by_other"),
            ("reservations", exclusive, Http, "stop", "- - -"),
            ("reservations, read since", exclusive, Http, "start", "go - go"),
        ];
        for (file, mode, kind, order, expected) in table {
            let mut trial = Trial::new();
            let files = AwaitedFiles::default();
            let awaited = match file.split(',').next() {
                Some("slots") => Some(&files.slots),
                Some("reservations") => Some(&files.reservations),
                _ => None,
            };
            if let Some(awaited) = awaited {
                awaited.begin("state/file.json".into());
                if file.ends_with("read since") {
                    awaited.end();
                }
            }
            trial.gate.set_awaited(Arc::new(files));
            trial.gate.set_rules(mode.map(rules));
            let verdicts = trial.verdicts(&RULE, order, &Origin::new(kind, "c"));
            assert_eq!(verdicts, expected, "{file}, {mode:?}: {order} of {kind:?}");
        }
    }
    #[test]
    fn a_reference_that_turns_a_motor_at_standstill_waits_as_a_start_does() {
        let mut trial = Trial::new();
        let files = AwaitedFiles::default();
        files.slots.begin("state/file.json".into());
        trial.gate.set_awaited(Arc::new(files));
        let client = Origin::new(SourceKind::Http, "c");
        for (process_data, expected) in [
            (&[0x03, 0, 0, 0][..], "held_by_other - held_by_other"),
            (RUNS, "go - go"),
            (STANDS, "go - held_by_other"),
        ] {
            read(&trial.image, 2100, process_data, trial.now);
            assert_eq!(
                trial.verdicts(&RULE, "reference", &client),
                expected,
                "{process_data:?}"
            );
        }
    }
}
