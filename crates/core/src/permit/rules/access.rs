//! Whether the client of a command may write at all. The present configuration decides: a right that a reload has
//! removed since the first byte of a request no longer counts when the request is complete, and a waiting command
//! or a sequence in progress is not continued.
//!
//! A stop needs the right when it is accepted. An accepted stop is always sent: otherwise the motor might keep
//! running against the client's will.
//!
//! Refusals by the profile, the access of the drive and the access of the point come from [`crate::permit::admit`]
//! before this rule, since the effects of an order are known only then. They are not checked again: a reload that
//! changes the access of a drive or a point restarts the bus, which ends the orders waiting there.

use crate::order::{Interruption, Order, Origin, Outcome, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: true,
    judge,
};

fn judge(ask: &Ask<'_>, _: &DriveGate, _: &Gate) -> Verdict {
    let Some(seen) = ask.seen.filter(|_| !matches!(ask.intent.order, Order::Read(_))) else {
        return Verdict::Go;
    };
    match client_access(ask.stage, ask.effect().stops, ask.origin, &seen.reading.spec.bus) {
        Ok(()) => Verdict::Go,
        Err(_) if ask.stage == Stage::Write => Verdict::Refuse(Outcome::Interrupted(Interruption::RightLost)),
        Err(refusal) => Verdict::refuse(refusal),
    }
}

/// Judges a command at that stage; `may_write` is what its client is allowed now.
///
/// # Errors
/// If the right is missing; contains the refusal.
pub fn access(stage: Stage, is_stop: bool, may_write: bool) -> Result<(), Refusal> {
    let why = match (stage, may_write) {
        (_, true) => return Ok(()),
        (Stage::Turn | Stage::Write, false) if is_stop => return Ok(()),
        (Stage::Accept, false) => "this client may no longer write: a reload removed its right",
        (Stage::Turn | Stage::Write, false) => {
            "a reload removed the right of this client to write while the command waited"
        }
    };
    Err(Refusal::NotAllowed(format!("{why}; nothing was written")))
}

/// The refusal of a command whose client lost its right after the turn of the command, before anything was written.
pub fn right_lost() -> Refusal {
    Refusal::NotAllowed("a reload removed the right of this client to write; nothing was written".to_string())
}

/// Judges a command of this client for a drive of this bus.
///
/// # Errors
/// If the client has no right to write; contains the refusal.
pub fn client_access(stage: Stage, is_stop: bool, origin: &Origin, bus: &str) -> Result<(), Refusal> {
    access(stage, is_stop, origin.right().allows(bus))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::order::{Right, SourceKind};

    #[test]
    fn whoever_has_lost_the_right_writes_nothing_but_the_stop_that_was_accepted() {
        use Stage::{Accept, Turn, Write};
        let table = [
            (Accept, false, true, true),
            (Accept, true, true, true),
            (Accept, false, false, false),
            (Accept, true, false, false),
            (Turn, false, true, true),
            (Turn, true, true, true),
            (Turn, false, false, false),
            (Turn, true, false, true),
            (Write, false, true, true),
            (Write, true, true, true),
            (Write, false, false, false),
            (Write, true, false, true),
        ];
        for (stage, is_stop, may_write, passes) in table {
            let judged = access(stage, is_stop, may_write);
            assert_eq!(judged.is_ok(), passes, "{stage:?} stop {is_stop} right {may_write}");
            if let Err(refusal) = judged {
                assert_eq!(refusal.code(), "not_allowed");
                assert!(refusal.to_string().contains("a reload removed"), "{refusal}");
            }
        }
    }

    #[test]
    fn the_right_is_that_of_now() {
        let grants = Arc::new(AtomicBool::new(true));
        let own = Origin::new(SourceKind::Mqtt, "cloud");
        let client = own.clone().with_right(Right::of(grants.clone()));
        let judged = |origin: &Origin| client_access(Stage::Turn, false, origin, "line1").is_ok();
        assert!(judged(&own) && judged(&client));
        grants.store(false, Ordering::Release);
        assert!(judged(&own) && !judged(&client));
        assert!(judged(&client.clone().lasting()), "what has to come to its end");
        grants.store(true, Ordering::Release);
        assert!(judged(&client));
        assert_eq!(own, client.lasting(), "a client is the same with any right");
    }
}
