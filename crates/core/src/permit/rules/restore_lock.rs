//! Whether parameters of the drive are being restored, or were left half restored: then only stops get through.

use crate::order::{Order, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::process_image::RestoreLock;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    // The writes of the restore itself pass the lock.
    if !ask.changes() || matches!(ask.intent.order, Order::Parameter(_)) {
        return Verdict::Go;
    }
    let lock = ask.seen.and_then(|seen| seen.reading.restore_lock);
    let why = lock.and_then(RestoreLock::reason);
    Verdict::unless(why.map(|why| Refusal::NotAllowed(why.to_string())))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::order::{Origin, SourceKind};
    use crate::permit::rules::tests::{SECOND, Trial};
    use crate::process_image::DriveImage;

    #[test]
    fn a_locked_drive_takes_stops_reads_and_the_restore_only() {
        // The lock, the order, and what becomes of it when it is accepted, at its turn, and before each write.
        let table = [
            ("never", "start", "go go go"),
            ("never", "reset", "go go go"),
            ("locked", "start", "not_allowed not_allowed not_allowed"),
            ("locked", "reference", "not_allowed not_allowed not_allowed"),
            ("locked", "reverse", "not_allowed not_allowed not_allowed"),
            ("locked", "reset", "not_allowed not_allowed not_allowed"),
            ("locked", "parameter", "go go go"),
            ("locked", "read", "go go go"),
            ("locked", "stop", "- - -"),
            ("over", "start", "go go go"),
        ];
        let client = Origin::new(SourceKind::Http, "alice");
        for (lock, order, expected) in table {
            let mut trial = Trial::new();
            let held = Arc::new(RestoreLock::default());
            let image = DriveImage::new(trial.image.spec.clone(), SECOND);
            trial.image = Arc::new(image.with_restore_lock(held.clone()));
            if lock != "never" {
                held.set(Some("its parameters are being restored".to_string()));
            }
            if lock == "over" {
                held.set(None);
            }
            assert_eq!(trial.verdicts(&RULE, order, &client), expected, "{lock}: {order}");
        }
    }
}
