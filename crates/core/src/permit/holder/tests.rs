use std::time::{Duration, Instant};

use super::*;
use crate::order::Asks;

mod claims;
mod repeated_stops;

const LEASE: Duration = Duration::from_secs(30);
const RANKS: [&str; 4] = ["site", "operator", "automation", "remote"];

fn rules(mode: Mode) -> Rules {
    Rules {
        mode,
        ranks: RANKS.map(Into::into).to_vec(),
        lease: LEASE,
        stop_at_local: true,
        principals: ["site", "op", "plc", "cloud"]
            .into_iter()
            .zip(0..)
            .map(|(name, rank)| Principal::new(name, rank))
            .chain([Principal {
                cyclic: true,
                ..Principal::new("cycle", 2)
            }])
            .collect(),
    }
}

/// A drive with its rules and a clock.
struct Drive {
    rules: Rules,
    holding: Holding,
    now: Instant,
    told: Vec<HoldChange>,
}

impl Drive {
    fn new() -> Drive {
        Drive {
            rules: rules(Mode::Exclusive),
            holding: Holding::default(),
            now: Instant::now(),
            told: Vec::new(),
        }
    }

    fn who(&self, name: &str) -> Option<Claim> {
        let known = self.rules.principals.iter().find(|p| &*p.name == name)?;
        Some(Claim {
            name: known.name.clone(),
            rank: known.rank,
            cyclic: known.cyclic,
            may_repeat: true,
            breaks: false,
        })
    }

    /// Gives an order; returns the code of its refusal, or an empty string.
    fn order(&mut self, name: &str, asks: Asks) -> &'static str {
        let who = self.who(name);
        match self.holding.judge(who.as_ref(), asks, &self.rules, self.now) {
            Ok(()) => {
                self.holding
                    .accepted(who.as_ref(), asks, &self.rules, self.now, &mut self.told);
                "ok"
            }
            Err(denial) => {
                self.holding.refused(who.as_ref(), asks, &denial, &self.rules, self.now);
                denial.refusal(&self.rules).code()
            }
        }
    }

    fn act(&mut self, name: &str, verb: Verb) -> &'static str {
        let who = self.who(name);
        let acted = self
            .holding
            .act(who.as_ref(), verb, &self.rules, self.now, &mut self.told);
        acted.map_or_else(|denial| denial.refusal(&self.rules).code(), |()| "ok")
    }

    /// The drive acknowledged the last stop of that client.
    fn acknowledged(&mut self, name: &str) {
        let who = self.who(name).unwrap();
        self.holding.stop_acknowledged(&who);
    }

    fn wait(&mut self, seconds: u64) {
        self.now += Duration::from_secs(seconds);
    }

    fn state(&self) -> String {
        let view = self.holding.view(&self.rules, self.now);
        let holder = view.holder.as_deref().unwrap_or("-");
        let left = view.left_s.map_or("-".to_string(), |left| left.to_string());
        format!("{} {holder} {left}", view.state.name())
    }

    fn told(&mut self) -> Vec<String> {
        let told = std::mem::take(&mut self.told);
        let word = |told: HoldChange| match told.what {
            What::Held => format!("{} held", told.who.name),
            What::Released(why) => format!("{} released: {why}", told.who.name),
            What::Broken(by) => format!("{} broken by {}", told.who.name, by.name),
        };
        told.into_iter().map(word).collect()
    }
}

const ALL: [Asks; 5] = [Asks::Run, Asks::Steer, Asks::Other, Asks::Stop, Asks::Nothing];

#[test]
fn what_needs_the_hold() {
    for asks in ALL {
        let takes = matches!(asks, Asks::Run | Asks::Steer);
        let reserves = asks == Asks::Stop;
        let mut free = Drive::new();
        assert_eq!(free.order("plc", asks), "ok", "{asks:?} of a free drive");
        let expected = match (takes, reserves) {
            (true, _) => "held plc 30",
            (_, true) => "reserved plc 30",
            _ => "free - 0",
        };
        assert_eq!(free.state(), expected, "{asks:?}");

        let mut own = Drive::new();
        assert_eq!(own.act("plc", Verb::Take), "ok");
        own.wait(10);
        assert_eq!(own.order("plc", asks), "ok", "{asks:?} of the holder");
        let renewed = if asks == Asks::Nothing {
            "held plc 20"
        } else {
            "held plc 30"
        };
        assert_eq!(own.state(), renewed, "{asks:?}");

        for other in ["site", "op", "cloud", "cycle", "nobody"] {
            let mut held = Drive::new();
            held.act("plc", Verb::Take);
            held.wait(10);
            let expected = match (asks, other) {
                (Asks::Stop | Asks::Nothing, _) => "ok",
                (_, "nobody") => "not_allowed",
                _ => "held_by_other",
            };
            assert_eq!(held.order(other, asks), expected, "{asks:?} of {other}");
            let after = match (asks, other) {
                (Asks::Stop, "nobody") => "free - 0".to_string(),
                (Asks::Stop, _) => format!("reserved {other} 30"),
                _ => "held plc 20".to_string(),
            };
            assert_eq!(held.state(), after, "{asks:?} of {other}");
        }
    }
}

#[test]
fn nobody_only_stops() {
    for asks in ALL {
        let mut drive = Drive::new();
        let expected = match asks {
            Asks::Stop | Asks::Nothing => "ok",
            _ => "not_allowed",
        };
        assert_eq!(drive.order("nobody", asks), expected, "{asks:?}");
        assert_eq!(drive.state(), "free - 0");
    }
    for verb in Verb::ALL {
        assert_eq!(Drive::new().act("nobody", verb), "not_allowed");
    }
}

#[test]
fn the_acts_upon_a_hold() {
    // Columns for each action: the drive is free, held by the client itself, by a lower, an equal and a higher rank.
    let table = [
        (
            Verb::Take,
            "ok",
            "ok",
            "held_by_other",
            "held_by_other",
            "held_by_other",
        ),
        (
            Verb::Renew,
            "needs_take",
            "ok",
            "held_by_other",
            "held_by_other",
            "held_by_other",
        ),
        (Verb::Release, "ok", "ok", "ok", "ok", "ok"),
        (Verb::Break, "ok", "ok", "held_by_other", "held_by_other", "ok"),
    ];
    for (verb, free, own, lower, equal, higher) in table {
        assert_eq!(Drive::new().act("plc", verb), free, "{verb:?} of a free drive");
        for (who, expected) in [("plc", own), ("cloud", lower), ("cycle", equal), ("op", higher)] {
            let mut drive = Drive::new();
            drive.act("plc", Verb::Take);
            drive.wait(1);
            assert_eq!(drive.act(who, verb), expected, "{verb:?} by {who}");
            let after = match (verb, who) {
                (Verb::Release, "plc") => "free - 0",
                (Verb::Release, _) => "held plc 29",
                (Verb::Break, "op") => "held op 30",
                (_, "plc") => "held plc 30",
                _ => "held plc 29",
            };
            assert_eq!(drive.state(), after, "{verb:?} by {who}");
        }
    }
    assert_eq!(Verb::ALL.map(|verb| Verb::of(verb.name())), Verb::ALL.map(Some));
    assert_eq!(Verb::of("steal"), None);
}

#[test]
fn a_hold_ends_with_its_lease_and_says_so() {
    let mut drive = Drive::new();
    drive.order("plc", Asks::Run);
    drive.wait(29);
    let plc = drive.who("plc").unwrap();
    drive.holding.renew(&plc, &drive.rules, drive.now);
    drive.wait(29);
    assert_eq!(drive.state(), "held plc 1");
    let other = drive.who("op").unwrap();
    drive.holding.renew(&other, &drive.rules, drive.now);
    assert_eq!(drive.state(), "held plc 1", "the heartbeat of another renews nothing");
    assert_eq!(drive.order("cloud", Asks::Run), "held_by_other");
    assert_eq!(drive.state(), "held plc 1", "what is refused renews nothing");
    drive.wait(1);
    assert_eq!(drive.state(), "free - 0");
    drive.holding.renew(&plc, &drive.rules, drive.now);
    assert_eq!(drive.state(), "free - 0", "what has ended is not renewed");
    assert!(drive.holding.is_whose_silence_counts(Some(&plc)) && !drive.holding.is_whose_silence_counts(Some(&other)));
    assert_eq!(drive.order("cloud", Asks::Run), "ok");
    assert!(!drive.holding.is_whose_silence_counts(Some(&plc)));
    assert_eq!(
        drive.told(),
        ["plc held", "plc released: its lease ended", "cloud held"]
    );
}

#[test]
fn a_stop_reserves_the_drive_for_its_rank() {
    for (who, expected) in [
        ("site", "ok"),
        ("op", "ok"),
        ("plc", "held_by_other"),
        ("cloud", "held_by_other"),
    ] {
        for asks in [Asks::Run, Asks::Steer, Asks::Other] {
            let mut drive = Drive::new();
            drive.order("op", Asks::Stop);
            assert_eq!(drive.order(who, asks), expected, "{asks:?} of {who}");
        }
        let mut drive = Drive::new();
        drive.order("op", Asks::Stop);
        assert_eq!(drive.act(who, Verb::Take), expected, "{who}");
    }
    let mut drive = Drive::new();
    drive.order("op", Asks::Stop);
    drive.wait(10);
    assert_eq!(drive.order("plc", Asks::Stop), "ok");
    assert_eq!(drive.state(), "reserved op 20", "a lower stop changes nothing");
    drive.order("nobody", Asks::Stop);
    assert_eq!(drive.state(), "reserved op 20", "nor does that of nobody");
    drive.order("site", Asks::Stop);
    assert_eq!(drive.state(), "reserved site 30", "a higher one begins it anew");
    assert_eq!(drive.act("op", Verb::Release), "ok");
    assert_eq!(drive.state(), "reserved site 30", "only its stopper releases it");
    assert_eq!(drive.act("site", Verb::Release), "ok");
    assert_eq!(drive.state(), "free - 0");
    drive.order("op", Asks::Stop);
    drive.wait(30);
    assert_eq!(drive.order("cloud", Asks::Run), "ok", "time ends it");
}

#[test]
fn a_run_that_goes_on_behind_a_stop_needs_a_take() {
    let stopped = || {
        let mut drive = Drive::new();
        drive.order("plc", Asks::Run);
        drive.order("op", Asks::Stop);
        assert_eq!(drive.order("plc", Asks::Run), "held_by_other");
        drive
    };
    // The passage of time does not permit a start while the client repeats its run command.
    let mut drive = stopped();
    for _ in 0..40 {
        drive.wait(29);
        let code = drive.order("plc", Asks::Run);
        assert!(["needs_take", "held_by_other"].contains(&code), "{code}");
    }
    assert_eq!(drive.order("plc", Asks::Run), "needs_take");
    assert_eq!(drive.order("cloud", Asks::Run), "ok", "another client was not refused");
    // A new run is possible after a stop of the client itself, a take, the release by the client that stopped, or
    // ten leases without a run.
    let mut drive = stopped();
    drive.order("plc", Asks::Stop);
    drive.wait(31);
    assert_eq!(drive.order("plc", Asks::Run), "ok");
    let mut drive = stopped();
    drive.wait(31);
    assert_eq!(
        (drive.act("plc", Verb::Take), drive.order("plc", Asks::Run)),
        ("ok", "ok")
    );
    let mut drive = stopped();
    drive.act("op", Verb::Release);
    assert_eq!(drive.order("plc", Asks::Run), "ok");
    let mut drive = stopped();
    drive.wait(299);
    assert_eq!(drive.order("plc", Asks::Run), "needs_take");
    drive.wait(300);
    assert_eq!(drive.order("plc", Asks::Run), "ok");
    // Only taking the drive helps: not a reference that takes it, a renewed hold, a reset, or another client's stop.
    for asks in [Asks::Steer, Asks::Other] {
        let mut drive = stopped();
        drive.wait(31);
        for _ in 0..3 {
            assert_eq!(drive.order("plc", asks), "ok");
            assert_eq!(drive.order("plc", Asks::Run), "needs_take", "{asks:?}");
        }
        drive.act("plc", Verb::Renew);
        assert_eq!(drive.order("plc", Asks::Run), "needs_take", "{asks:?}");
        drive.order("nobody", Asks::Stop);
        assert_eq!(drive.order("plc", Asks::Run), "needs_take", "{asks:?}");
        drive.act("plc", Verb::Take);
        assert_eq!(drive.order("plc", Asks::Run), "ok");
    }
    // A reference does not count as a run command.
    let mut drive = Drive::new();
    drive.order("op", Asks::Stop);
    assert_eq!(drive.order("plc", Asks::Steer), "held_by_other");
    drive.wait(31);
    assert_eq!(drive.order("plc", Asks::Run), "ok");
}

#[test]
fn the_local_control_place_comes_first() {
    let mut drive = Drive::new();
    drive.order("site", Asks::Run);
    drive.holding.set_local(true, &mut drive.told);
    assert_eq!(drive.state(), "local local -");
    for who in ["site", "op", "plc", "cloud"] {
        for asks in [Asks::Run, Asks::Steer, Asks::Other] {
            assert_eq!(drive.order(who, asks), "held_by_other", "{who} {asks:?}");
        }
        for verb in [Verb::Take, Verb::Renew, Verb::Break] {
            assert_eq!(drive.act(who, verb), "held_by_other");
        }
    }
    assert_eq!(drive.order("nobody", Asks::Stop), "ok");
    drive.holding.set_local(false, &mut drive.told);
    assert_eq!(drive.state(), "free - 0");
    assert_eq!(drive.told().len(), 2);
    // A reservation continues during local control.
    drive.order("op", Asks::Stop);
    drive.holding.set_local(true, &mut drive.told);
    drive.wait(10);
    drive.holding.set_local(false, &mut drive.told);
    assert_eq!(drive.state(), "reserved op 20");
}

#[test]
fn supervision_stops_with_the_rank_of_the_silent_holder() {
    let mut drive = Drive::new();
    drive
        .holding
        .stopped_by_gateway(true, &drive.rules, drive.now, &mut drive.told);
    assert_eq!(drive.state(), "free - 0", "nobody ever held it");
    drive.order("plc", Asks::Run);
    drive.wait(100);
    drive
        .holding
        .stopped_by_gateway(true, &drive.rules, drive.now, &mut drive.told);
    assert_eq!(drive.state(), "reserved supervision 30");
    assert_eq!(drive.order("cloud", Asks::Run), "held_by_other");
    assert_eq!(drive.order("plc", Asks::Run), "ok");
    drive
        .holding
        .stopped_by_gateway(false, &drive.rules, drive.now, &mut drive.told);
    assert_eq!(drive.state(), "free - 0", "a trip or a shutdown reserves nothing");
}

#[test]
fn advisory_refuses_nothing_and_tells_all() {
    let mut drive = Drive::new();
    drive.rules = rules(Mode::Advisory);
    let [plc, op] = ["plc", "op"].map(|name| drive.who(name).unwrap());
    for who in [&plc, &op, &plc] {
        drive
            .holding
            .accepted(Some(who), Asks::Run, &drive.rules, drive.now, &mut drive.told);
    }
    assert_eq!(drive.state(), "held plc 30", "the last one whose order was accepted");
    let expected = [
        "plc held",
        "plc released: op commanded the drive",
        "op held",
        "op released: plc commanded the drive",
        "plc held",
    ];
    assert_eq!(drive.told(), expected);
}

#[test]
fn a_reload_keeps_whom_it_knows() {
    let mut drive = Drive::new();
    drive.order("plc", Asks::Run);
    let mut fewer = rules(Mode::Exclusive);
    fewer.principals.retain(|p| &*p.name != "cloud");
    drive.holding.keep_known(&fewer, &mut drive.told);
    assert_eq!(drive.state(), "held plc 30");
    fewer.principals.retain(|p| &*p.name != "plc");
    drive.holding.keep_known(&fewer, &mut drive.told);
    assert_eq!(drive.state(), "free - 0");
    assert_eq!(drive.told()[1], "plc released: a reload removed it from [authority]");
}

#[test]
fn a_refusal_names_the_holder() {
    let mut drive = Drive::new();
    drive.act("op", Verb::Take);
    drive.now += Duration::from_millis(5_500);
    let plc = drive.who("plc");
    let denial = drive
        .holding
        .judge(plc.as_ref(), Asks::Run, &drive.rules, drive.now)
        .unwrap_err();
    let refusal = denial.refusal(&drive.rules);
    let holder = refusal.holder().unwrap();
    assert_eq!(
        (holder.who.as_str(), holder.rank.as_str(), holder.left_s),
        ("op", "operator", Some(25))
    );
    let text = refusal.to_string();
    assert_eq!(
        text,
        "op (operator) holds the drive for another 25 s, longer if renewed; it was not sent"
    );
}
