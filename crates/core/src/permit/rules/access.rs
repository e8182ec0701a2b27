//! Whether the client may write at all, this drive and this point.
//!
//! At accept, where an order is checked and converted by what the configuration and the profile let through, [`crate::permit::admit`]
//! answers this before anything else, since what an order does is only known then. What it let through is not asked again: a
//! reload that changes the access of a drive or a point starts the bus anew, and what waits there ends.

use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Turn, Stage::Write],
    binds_stops: true,
    judge,
};

fn judge(_: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    Verdict::Go
}
