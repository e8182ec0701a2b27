//! Whether a file of an earlier run that may forbid the start is not read yet, as on a disk that hangs.
//!
//! The rule is checked only when an order is accepted: these files are read once, and no order is accepted before that begins.

use crate::order::{Asks, Holder, Refusal};
use crate::permit::Mode;
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept],
    binds_stops: false,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, gate: &Gate) -> Verdict {
    if ask.asks() != Asks::Run || !ask.origin.kind.is_client() {
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
