//! Whether an order still means the machine that it named when its first byte came.
//!
//! At write nothing can have changed: a bus serves the same machines as long as it runs, and a reload ends what waits in the queue
//! of a bus that it replaces.

use crate::order::{Named, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn],
    binds_stops: true,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    // A stop is carried out on the machine that it named.
    match ask.intent.named {
        Named::Formerly if !ask.effect().stops => Verdict::refuse(Refusal::UnknownDrive(
            "the name meant another machine when this request began; nothing was written; send it again".to_string(),
        )),
        Named::This | Named::Formerly => Verdict::Go,
    }
}
