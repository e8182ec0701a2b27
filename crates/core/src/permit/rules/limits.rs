//! Whether the values of an order still keep the limits, and whether the readings behind those limits are still valid.
//!
//! At the stage "accept" the limits are checked while the order is converted ([`crate::permit::admit`]), since its
//! values come from the range on which they depend. At the stage "write" nothing can have changed: between the
//! first and the last frame of an order no other order to the drive is sent.

use crate::order::{FrequencyRange, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::permit::reference_limits::still_keeps_limits;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Turn],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    let Some((seen, written)) = ask.seen.and_then(|seen| Some((seen, seen.written?))) else {
        return Verdict::Go;
    };
    let holds = |range: &FrequencyRange| range.holds(&seen.reading, written.range);
    if !ask.intent.ranges.iter().all(holds) {
        return Verdict::refuse(Refusal::NotKnown(
            "the drive's frequency range was written, or changed, since the command was accepted; nothing was written; \
             send it again"
                .to_string(),
        ));
    }
    let kept = still_keeps_limits(&seen.reading, &ask.intent.order, written);
    Verdict::unless(kept.err())
}
