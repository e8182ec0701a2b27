//! The principal that a client is, and the acts upon a hold that its orders are.

use super::*;
use crate::order::{Origin, Proof, SourceKind};

#[test]
fn who_a_client_is() {
    let mut rules = rules(Mode::Exclusive);
    let [site, op, plc, cloud] = [0, 1, 2, 3];
    rules.principals[site].modbus_tcp = vec!["10.0.0.0/8".parse().unwrap()];
    rules.principals[plc].modbus_tcp = vec!["10.0.0.5/32".parse().unwrap(), "fd00::/8".parse().unwrap()];
    rules.principals[plc].bacnet = vec!["10.0.0.0/24".parse().unwrap()];
    rules.principals[op].http_user = Some("alice".to_string());
    rules.principals[op].certificate = Some("op-1".to_string());
    rules.principals[op].socket = Some(1000);
    rules.principals[cloud].mqtt = Some("cloud".to_string());
    rules.principals[cloud].sparkplug = true;
    let name = |proof: Proof| {
        let claim = rules.claim(&proof);
        claim.map_or("nobody".to_string(), |claim| format!("{} {}", claim.name, claim.rank))
    };
    let at = |text: &str| text.parse().unwrap();
    for (proof, expected) in [
        (Proof::Nothing, "nobody"),
        (Proof::Address(at("10.0.0.5")), "plc 2"),
        (Proof::Address(at("10.0.0.6")), "site 0"),
        (Proof::Address(at("::ffff:10.0.0.5")), "plc 2"),
        (Proof::Address(at("fd12::1")), "plc 2"),
        (Proof::Address(at("192.168.0.1")), "nobody"),
        (Proof::Certificate("op-1".into(), at("10.0.0.5")), "op 1"),
        (Proof::Certificate("x".into(), at("10.0.0.5")), "plc 2"),
        (Proof::User("alice".into()), "op 1"),
        (Proof::User("bob".into()), "nobody"),
        (Proof::Topic("cloud".into()), "cloud 3"),
        (Proof::Topic("op".into()), "nobody"),
        (Proof::Sparkplug, "cloud 3"),
        (Proof::Uid(1000), "op 1"),
        (Proof::Uid(7), "socket:7 0"),
        (Proof::Pty("/run/tool".into()), "slot:/run/tool 0"),
        (Proof::Bacnet(at("10.0.0.9"), 1), "plc 2"),
        (Proof::Bacnet(at("10.0.0.9"), 8), "plc 2"),
        (Proof::Bacnet(at("10.0.0.9"), 14), "plc 2"),
        (Proof::Bacnet(at("10.0.0.9"), 16), "plc 3"),
        (Proof::Bacnet(at("10.0.1.9"), 1), "nobody"),
    ] {
        assert_eq!(name(proof.clone()), expected, "{proof:?}");
    }
    let cyclic = |origin: &Origin| rules.claim_of(origin).map(|claim| claim.cyclic);
    let origin = Origin::new(SourceKind::Http, "x").proven(Proof::User("alice".into()));
    assert_eq!(cyclic(&origin), Some(false));
}

#[test]
fn in_bacnet_the_priority_is_the_act() {
    let mut drive = Drive::new();
    drive.rules.principals[1].bacnet = vec!["10.0.0.9/32".parse().unwrap()];
    let claim = |priority: u8| drive.rules.claim(&Proof::Bacnet("10.0.0.9".parse().unwrap(), priority));
    let (high, low) = (claim(8), claim(16));
    let mut holding = Holding::default();
    let plc = drive.who("plc");
    holding.accepted(plc.as_ref(), Asks::Run, &drive.rules, drive.now, &mut drive.told);
    assert!(holding.judge(low.as_ref(), Asks::Run, &drive.rules, drive.now).is_err());
    assert_eq!(holding.judge(high.as_ref(), Asks::Run, &drive.rules, drive.now), Ok(()));
    holding.accepted(high.as_ref(), Asks::Run, &drive.rules, drive.now, &mut drive.told);
    assert_eq!(drive.told(), ["plc held", "plc broken by op"]);
    // A run after a stop of another client is judged like any other run: it does not break the hold.
    let mut holding = Holding::default();
    let site = drive.who("site");
    holding.accepted(site.as_ref(), Asks::Stop, &drive.rules, drive.now, &mut drive.told);
    let denial = holding
        .judge(high.as_ref(), Asks::Run, &drive.rules, drive.now)
        .unwrap_err();
    holding.refused(high.as_ref(), Asks::Run, &denial, &drive.rules, drive.now);
    let later = drive.now + LEASE;
    holding.accepted(plc.as_ref(), Asks::Run, &drive.rules, later, &mut drive.told);
    let again = holding.judge(high.as_ref(), Asks::Run, &drive.rules, later);
    assert!(matches!(again, Err(Denial::NeedsTake(_))), "{again:?}");
}
