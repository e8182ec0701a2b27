//! A stop that its client repeats: sent once, and again where another client started the motor since.

use super::*;
use crate::order::Proof;

#[test]
fn a_cyclic_client_stops_once() {
    let mut drive = Drive::new();
    drive.order("cycle", Asks::Run);
    assert_eq!(drive.order("cycle", Asks::Stop), "ok");
    drive.acknowledged("cycle");
    assert_eq!(drive.state(), "held cycle 30");
    drive.wait(20);
    assert_eq!(drive.order("cycle", Asks::Stop), "ok");
    assert_eq!(drive.state(), "held cycle 10", "a repetition renews nothing");
    drive.wait(10);
    assert_eq!(drive.order("cycle", Asks::Stop), "ok");
    assert_eq!(drive.state(), "free - 0", "and reserves nothing");
    assert_eq!(drive.order("op", Asks::Run), "ok");
    assert_eq!(drive.order("cycle", Asks::Stop), "held_by_other");
    assert_eq!(drive.state(), "held op 30", "nor does it end the hold of another");
    assert_eq!(drive.order("cycle", Asks::Run), "held_by_other");
    assert_eq!(drive.order("cycle", Asks::Stop), "ok", "the change to stop is one");
    assert_eq!(drive.state(), "reserved cycle 30");
    // A client that is not configured as cyclic is detected.
    let mut drive = Drive::new();
    drive.order("plc", Asks::Stop);
    drive.act("op", Verb::Take);
    assert_eq!(drive.holding.repeater(), None);
    drive.order("plc", Asks::Stop);
    assert_eq!(drive.state(), "reserved plc 30");
    assert_eq!(drive.holding.repeater().map(|name| &**name), Some("plc"));
    // An insisting stop of a cyclic client is always a new stop.
    let mut drive = Drive::new();
    let cycle = drive.who("cycle").unwrap();
    drive.order("cycle", Asks::Stop);
    drive.acknowledged("cycle");
    drive.act("op", Verb::Break);
    let insists = Claim { cyclic: false, ..cycle };
    assert_eq!(
        drive.holding.judge(Some(&insists), Asks::Stop, &drive.rules, drive.now),
        Ok(())
    );
}

/// Each row: events after the stop of the cyclic client, whether the drive acknowledged the stop, and the result of
/// repeating it.
#[test]
fn a_repeated_stop_is_not_sent_while_the_motor_was_started_by_another() {
    type Then = fn(&mut Drive);
    let op_starts = |drive: &mut Drive| drive.wait(31);
    let rows: [(&str, bool, Then, &str); 9] = [
        ("nobody started it since", true, |_| {}, "ok"),
        (
            "held by another",
            true,
            |drive| _ = drive.act("op", Verb::Take),
            "held_by_other",
        ),
        (
            "held and started by another",
            true,
            |drive| _ = drive.order("op", Asks::Run),
            "held_by_other",
        ),
        (
            "started by another, whose hold has lapsed",
            true,
            |drive| {
                drive.order("op", Asks::Run);
                drive.wait(31);
            },
            "held_by_other",
        ),
        (
            "started by another, who gave it back",
            true,
            |drive| {
                drive.order("op", Asks::Run);
                drive.act("op", Verb::Release);
            },
            "held_by_other",
        ),
        (
            "started by another, and its own stop was never acknowledged",
            false,
            |drive| {
                drive.order("op", Asks::Run);
                drive.wait(31);
            },
            "ok",
        ),
        (
            "its own word was another one since",
            true,
            |drive| {
                drive.order("op", Asks::Run);
                drive.wait(31);
                drive.order("cycle", Asks::Run);
            },
            "ok",
        ),
        (
            "its own run was refused since",
            true,
            |drive| {
                drive.order("op", Asks::Run);
                assert_eq!(drive.order("cycle", Asks::Run), "held_by_other");
            },
            "ok",
        ),
        (
            "a reference is no other word",
            true,
            |drive| {
                drive.order("op", Asks::Run);
                drive.wait(31);
                assert_eq!(drive.order("cycle", Asks::Steer), "ok");
            },
            "held_by_other",
        ),
    ];
    for (about, is_acknowledged, then, expected) in rows {
        let mut drive = Drive::new();
        assert_eq!(drive.order("cycle", Asks::Stop), "ok");
        if is_acknowledged {
            drive.acknowledged("cycle");
        }
        op_starts(&mut drive);
        then(&mut drive);
        let before = drive.state();
        assert_eq!(drive.order("cycle", Asks::Stop), expected, "{about}");
        if about.starts_with("started by another") {
            assert_eq!(drive.state(), before, "{about}: it neither ends a hold nor reserves");
        }
    }
    // The hold has ended: the refusal names the client that started the motor.
    let mut drive = Drive::new();
    drive.order("cycle", Asks::Stop);
    drive.acknowledged("cycle");
    drive.wait(31);
    drive.order("op", Asks::Run);
    drive.wait(31);
    let cycle = drive.who("cycle");
    let denial = drive.holding.judge(cycle.as_ref(), Asks::Stop, &drive.rules, drive.now);
    let refusal = denial.unwrap_err().refusal(&drive.rules);
    assert_eq!(refusal.holder().unwrap().left_s, Some(0));
    assert!(
        refusal
            .to_string()
            .starts_with("op (operator) started the motor, and this only repeats an earlier stop"),
        "{refusal}"
    );
}

/// Stops by programs may be repetitions; stops by people never are, so a person is never reported as cyclic.
#[test]
fn a_stop_over_http_or_the_socket_is_never_a_repetition() {
    let address = "10.0.0.5".parse().unwrap();
    let network = || vec!["10.0.0.0/24".parse().unwrap()];
    let mut rules = rules(Mode::Exclusive);
    rules.principals = vec![
        Principal {
            cyclic: true,
            modbus_tcp: network(),
            bacnet: network(),
            certificate: Some("line".to_string()),
            http_user: Some("line".to_string()),
            mqtt: Some("line".to_string()),
            sparkplug: true,
            socket: Some(7),
            ..Principal::new("line", 2)
        },
        Principal::new("op", 1),
    ];
    let name = || "line".into();
    for (proof, repeats) in [
        (Proof::Address(address), true),
        (Proof::Certificate(name(), address), true),
        (Proof::Topic(name()), true),
        (Proof::Sparkplug, true),
        (Proof::Bacnet(address, 9), true),
        (Proof::User(name()), false),
        (Proof::Uid(7), false),
        (Proof::Uid(8), false),
        (Proof::Pty("tool".into()), false),
    ] {
        let claim = rules.claim(&proof).unwrap();
        assert_eq!((claim.cyclic, claim.may_repeat), (repeats, repeats), "{proof:?}");
        let mut drive = Drive::new();
        drive.rules = rules.clone();
        let stop = |drive: &mut Drive, claim: &Claim| {
            let judged = drive.holding.judge(Some(claim), Asks::Stop, &drive.rules, drive.now);
            if judged.is_ok() {
                let Drive {
                    holding,
                    rules,
                    now,
                    told,
                } = drive;
                holding.accepted(Some(claim), Asks::Stop, rules, *now, told);
            }
            judged.is_ok()
        };
        assert!(stop(&mut drive, &claim));
        drive.holding.stop_acknowledged(&claim);
        drive.act("op", Verb::Break);
        drive.act("op", Verb::Take);
        assert_eq!(stop(&mut drive, &claim), !repeats, "{proof:?}");
        // A client that is not configured as cyclic is detected where its interface allows repetitions.
        let plain = Claim { cyclic: false, ..claim };
        drive.act("op", Verb::Break);
        drive.act("op", Verb::Take);
        assert!(stop(&mut drive, &plain));
        let found = drive.holding.repeater().is_some();
        assert_eq!(found, repeats, "{proof:?}");
    }
}
