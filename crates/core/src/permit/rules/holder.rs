//! The holder of the drive, the client for which a stop reserved it, and the clients that must take the drive
//! before a start.
//!
//! A stop is judged only when it is accepted, since a repeated word of a cyclic client is not a stop; an accepted
//! stop is always sent.

use crate::order::{Asks, Holder, Refusal};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: true,
    judge,
};

fn judge(ask: &Ask<'_>, drive: &DriveGate, gate: &Gate) -> Verdict {
    if ask.effect().stops && ask.stage != Stage::Accept {
        return Verdict::Go;
    }
    let refused = gate.judge_hold(drive, ask.origin, ask.asks(), ask.now);
    Verdict::unless(refused.or_else(|| stops_first(ask, drive)))
}

/// Refuses the start if, since a reload, the machine has a name under which this client commanded another machine.
fn stops_first(ask: &Ask<'_>, drive: &DriveGate) -> Option<Refusal> {
    let is_meant = ask.asks() == Asks::Run && drive.must_stop_first.contains(ask.origin.client());
    is_meant.then(|| {
        Refusal::NeedsTake(Box::new(Holder {
            who: "a reload".to_string(),
            rank: "configuration".to_string(),
            keeps: "gave this name to another machine while this client commanded; send a stop, or take the drive, before run"
                .to_string(),
            left_s: None,
        }))
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::order::{Origin, Proof, SourceKind};
    use crate::permit::rules::tests::{SECOND, Trial};
    use crate::permit::{Mode, Principal, Rules, Verb};

    /// Alice and Bob are operators; the controller, which repeats its word, and the cloud are below them.
    fn rules(mode: Mode) -> Arc<Rules> {
        let topic = |name: &str, rank, cyclic| Principal {
            mqtt: Some(name.to_string()),
            cyclic,
            ..Principal::new(name, rank)
        };
        Arc::new(Rules {
            mode,
            ranks: ["site", "operator", "automation", "remote"].map(Into::into).to_vec(),
            lease: 30 * SECOND,
            stop_at_local: true,
            principals: vec![
                topic("site", 0, false),
                topic("alice", 1, false),
                topic("bob", 1, false),
                topic("plc", 2, true),
                topic("cloud", 3, false),
            ],
        })
    }

    fn client(name: &str) -> Origin {
        match name {
            "supervision" => Origin::new(SourceKind::Supervision, Origin::LEASE),
            name => Origin::new(SourceKind::Mqtt, name).proven(Proof::Topic(name.into())),
        }
    }

    /// Brings the drive into that state under these rules.
    fn prepare(trial: &mut Trial, state: &str, rules: &Rules) {
        let (holding, now, told) = (&mut trial.drive.holding, trial.now, &mut Vec::new());
        let claim = |name: &str| rules.claim_of(&client(name));
        let (bob, alice, plc) = (claim("bob"), claim("alice"), claim("plc"));
        match state {
            "free" => {}
            "held by bob" => holding.act(bob.as_ref(), Verb::Take, rules, now, told).unwrap(),
            "stopped by bob" => holding.accepted(bob.as_ref(), Asks::Stop, rules, now, told),
            "stopped by bob while the plc ran it" => {
                holding.accepted(plc.as_ref(), Asks::Run, rules, now, told);
                holding.accepted(bob.as_ref(), Asks::Stop, rules, now, told);
                let denial = holding.judge(plc.as_ref(), Asks::Run, rules, now).unwrap_err();
                holding.refused(plc.as_ref(), Asks::Run, &denial, rules, now);
                trial.now += 31 * SECOND;
            }
            "stopped by the plc, started by alice" => {
                holding.accepted(plc.as_ref(), Asks::Stop, rules, now, told);
                holding.stop_acknowledged(plc.as_ref().unwrap());
                holding.accepted(alice.as_ref(), Asks::Run, rules, now, told);
            }
            "at its panel" => holding.set_local(true, told),
            "another machine" => trial.drive.must_stop_first.push(client("alice").client().clone()),
            other => panic!("no state {other}"),
        }
    }

    #[test]
    fn who_does_not_hold_the_drive_only_stops_it() {
        let (off, advisory, exclusive) = (None, Some(Mode::Advisory), Some(Mode::Exclusive));
        let (free, all) = ("go go go", "held_by_other held_by_other held_by_other");
        let take = "needs_take needs_take needs_take";
        let ran = "stopped by bob while the plc ran it";
        let repeats = "stopped by the plc, started by alice";
        // The mode of `[authority]`, the state of the drive, the client, its order, and what becomes of that.
        let table = [
            (off, "free", "alice", "start", free),
            (exclusive, "free", "alice", "start", free),
            (exclusive, "free", "alice", "stop", free),
            (
                exclusive,
                "free",
                "stranger",
                "start",
                "not_allowed not_allowed not_allowed",
            ),
            (exclusive, "free", "stranger", "stop", free),
            (exclusive, "free", "stranger", "read", free),
            (advisory, "free", "stranger", "start", free),
            (exclusive, "held by bob", "bob", "start", free),
            (exclusive, "held by bob", "alice", "start", all),
            (exclusive, "held by bob", "alice", "reference", all),
            (exclusive, "held by bob", "alice", "reverse", all),
            (exclusive, "held by bob", "alice", "reset", all),
            (exclusive, "held by bob", "alice", "read", free),
            (exclusive, "held by bob", "alice", "parameter", free),
            (exclusive, "held by bob", "alice", "stop", free),
            (exclusive, "held by bob", "site", "start", all),
            (exclusive, "held by bob", "supervision", "reference", free),
            (advisory, "held by bob", "alice", "start", free),
            (exclusive, "stopped by bob", "cloud", "start", all),
            (exclusive, "stopped by bob", "cloud", "reset", all),
            (exclusive, "stopped by bob", "cloud", "stop", free),
            (exclusive, "stopped by bob", "alice", "start", free),
            (exclusive, "stopped by bob", "site", "start", free),
            (exclusive, ran, "plc", "start", take),
            (exclusive, ran, "plc", "reference", free),
            (exclusive, ran, "plc", "stop", free),
            (exclusive, ran, "alice", "start", free),
            (exclusive, "at its panel", "alice", "start", all),
            (exclusive, "at its panel", "alice", "reference", all),
            (exclusive, "at its panel", "alice", "stop", free),
            // An accepted stop is sent, also where a repetition of it would not be accepted any more.
            (exclusive, repeats, "plc", "stop", "held_by_other go go"),
            (exclusive, repeats, "bob", "stop", free),
            (exclusive, repeats, "supervision", "stop", free),
            (off, "another machine", "alice", "start", take),
            (exclusive, "another machine", "alice", "start", take),
            (off, "another machine", "alice", "reference", free),
            (off, "another machine", "alice", "stop", free),
            (off, "another machine", "bob", "start", free),
        ];
        for (mode, state, who, order, expected) in table {
            let mut trial = Trial::new();
            prepare(&mut trial, state, &rules(Mode::Exclusive));
            trial.gate.set_rules(mode.map(rules));
            let verdicts = trial.verdicts(&RULE, order, &client(who));
            assert_eq!(verdicts, expected, "{mode:?}, {state}: {order} of {who}");
        }
    }
}
