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
