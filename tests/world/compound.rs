//! Orders that stop a drive and do more: the stop is sent even if the rest is invalid, and one answer reports both.

use std::time::Duration;

use drivegate_core::order::{Order, Outcome, Refusal};
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::{Exception, Protocol, RequestPdu};
use drivegate_sim::faults::FaultPlan;

use super::rig::{PATIENCE, Rig, line, write};
use super::scenario::Line;

const CONTROL_WORD: u16 = 2000;
const REFERENCE: u16 = 2002;

/// A drive that runs at 50 %.
fn running(protocol: Protocol, family: &'static str) -> Rig {
    let line = Line {
        spec: |spec| {
            spec.limits.insert("speed_reference".to_string(), 0.0..=80.0);
        },
        ..line(
            family,
            protocol,
            if protocol == Protocol::N2 { 9_600 } else { 38_400 },
            1,
        )
    };
    let mut rig = Rig::of(&line);
    rig.until_state(1, State::Ready);
    assert!(rig.set(1, &[("speed_reference", 50.0), ("run", 1.0)]).is_ok());
    rig.until_state(1, State::Running);
    rig
}

fn nx() -> Rig {
    running(Protocol::ModbusRtu, "vacon-nx")
}

fn block(word: u16, reference: u16) -> Order {
    let values = vec![word, 0, reference];
    Order::Write(RequestPdu::WriteRegisters {
        start: CONTROL_WORD,
        values,
    })
}

/// The writes after the first `since` requests: function and first address.
fn writes(rig: &Rig, since: usize) -> Vec<(u8, u16)> {
    let frames = rig.requests();
    let writes = frames[since..].iter().map(|frame| &frame.bytes);
    let head = |bytes: &Vec<u8>| (bytes[1], u16::from_be_bytes([bytes[2], bytes[3]]));
    writes
        .map(head)
        .filter(|(function, _)| [5, 6, 15, 16].contains(function))
        .collect()
}

fn is_refused(outcome: &Outcome, why: fn(&Refusal) -> bool) -> bool {
    matches!(outcome, Outcome::StopOnly(rest) if matches!(&**rest, Outcome::Refused(refusal) if why(refusal)))
}

#[test]
fn the_stop_goes_first_and_the_rest_behind_it() {
    for (family, protocol) in [("vacon-nx", Protocol::ModbusRtu), ("vacon-nx-n2", Protocol::N2)] {
        let mut rig = running(protocol, family);
        let before = rig.requests().len();
        let outcome = rig.set(1, &[("speed_reference", 30.0), ("run", 0.0)]);
        assert!(outcome.is_ok(), "{family}: {outcome:?}");
        rig.until_state(1, State::Ready);
        rig.until_good(1, ModelPoint::SpeedReference, Value::Number(30.0));
        if protocol == Protocol::ModbusRtu {
            assert_eq!(writes(&rig, before), [(6, CONTROL_WORD), (6, REFERENCE)]);
        }
        let audit = rig.plant.command_log.audit().recent(None);
        let last: Vec<_> = audit.iter().rev().take(2).collect();
        let has = |command: &str| {
            last.iter()
                .any(|line| line.contains(&format!("\"command\":\"{command}\"")))
        };
        assert!(has("run=0") && has("speed_reference=30"), "{last:?}");
    }
}

#[test]
fn a_value_outside_the_limits_does_not_keep_the_stop_back() {
    let mut rig = nx();
    let before = rig.requests().len();
    let outcome = rig.set(1, &[("run", 0.0), ("speed_reference", 90.0)]);
    assert!(
        is_refused(&outcome, |r| matches!(r, Refusal::BadValue(_))),
        "{outcome:?}"
    );
    let text = outcome.to_string();
    assert!(
        text.contains("acknowledged the stop") && text.contains("limits 0 to 80"),
        "{text}"
    );
    assert!(!outcome.is_ok() && outcome.exception() == Some(Exception::VALUE));
    assert_eq!(writes(&rig, before), [(6, CONTROL_WORD)]);
    rig.until_state(1, State::Ready);
    // The control word of a raw block is sent alone.
    let mut rig = nx();
    let before = rig.requests().len();
    let outcome = rig.ordered(1, block(0, 9_000));
    assert!(
        is_refused(&outcome, |r| matches!(r, Refusal::BadValue(_))),
        "{outcome:?}"
    );
    assert_eq!(writes(&rig, before), [(6, CONTROL_WORD)]);
    assert_eq!(rig.word(1, REFERENCE), 5_000);
}

#[test]
fn a_held_drive_takes_the_stop_and_nothing_else() {
    let mut rig = nx();
    rig.drive(1)
        .image
        .restore_lock
        .set(Some("its parameters are being restored".to_string()));
    let orders = [
        rig.points(1, &[("run", 0.0), ("speed_reference", 77.0)]),
        rig.points(1, &[("run", 0.0), ("fault_reset", 1.0)]),
        block(0, 7_700),
    ];
    for order in orders {
        let before = rig.requests().len();
        let outcome = rig.ordered(1, order);
        assert!(
            is_refused(&outcome, |r| matches!(r, Refusal::NotAllowed(_))),
            "{outcome:?}"
        );
        assert_eq!(writes(&rig, before), [(6, CONTROL_WORD)]);
    }
    assert_eq!(rig.word(1, REFERENCE), 5_000);
    // A command that only stops is done and acknowledged.
    assert!(rig.set(1, &[("run", 0.0), ("reverse", 0.0)]).is_ok());
    assert!(rig.ordered(1, write(CONTROL_WORD, 0)).is_ok());
    rig.until_state(1, State::Ready);
    rig.drive(1).image.restore_lock.set(None);
    assert!(rig.ordered(1, block(0, 3_000)).is_ok());
    assert_eq!(rig.word(1, REFERENCE), 3_000);
}

#[test]
fn behind_a_stop_that_failed_nothing_is_sent() {
    let mut rig = nx();
    rig.set_alive(1, false);
    let order = rig.points(1, &[("run", 0.0), ("speed_reference", 10.0)]);
    let mut placed = rig.place(1, order);
    let outcome = rig.answered(&mut placed);
    assert!(matches!(outcome, Outcome::StopFailed(_)), "{outcome:?}");
    assert_eq!(outcome.code(), "timeout");
    assert!(outcome.to_string().contains("the rest of the command was not sent"));
    rig.set_alive(1, true);
    rig.run(PATIENCE);
    assert_eq!(rig.word(1, REFERENCE), 5_000);
    // For an offline drive the stop is sent as its probe, and the rest is not sent.
    rig.set_alive(1, false);
    rig.until("offline", PATIENCE, |rig| !rig.is_online(0));
    let order = rig.points(1, &[("run", 0.0), ("speed_reference", 10.0)]);
    let mut placed = rig.place(1, order);
    rig.set_alive(1, true);
    let outcome = rig.answered(&mut placed);
    assert!(
        matches!(&outcome, Outcome::StopOnly(rest) if **rest == Outcome::Offline),
        "{outcome:?}"
    );
    assert_eq!(rig.word(1, REFERENCE), 5_000);
}

/// A stop that the drive refuses is one that failed too.
#[test]
fn behind_a_stop_that_the_drive_refuses_nothing_is_sent() {
    let mut rig = nx();
    rig.set_faults(FaultPlan::new("exception:4=1".parse().unwrap(), 1));
    let before = rig.requests().len();
    let outcome = rig.set(1, &[("run", 0.0), ("speed_reference", 10.0)]);
    assert!(matches!(outcome, Outcome::StopFailed(_)), "{outcome:?}");
    rig.run(Duration::from_secs(3));
    assert!(writes(&rig, before).iter().all(|(_, address)| *address == CONTROL_WORD));
}

#[test]
fn a_later_stop_removes_the_rest() {
    let mut rig = nx();
    let order = rig.points(1, &[("run", 0.0), ("speed_reference", 10.0)]);
    let mut first = rig.place(1, order);
    let stop = rig.points(1, &[("run", 0.0)]);
    let mut second = rig.place(1, stop);
    assert!(rig.answered(&mut second).is_ok());
    let outcome = rig.answered(&mut first);
    assert!(
        matches!(&outcome, Outcome::StopOnly(rest) if **rest == Outcome::Purged),
        "{outcome:?}"
    );
    rig.run(Duration::from_secs(1));
    assert_eq!(rig.word(1, REFERENCE), 5_000);
}

#[test]
fn the_rest_keeps_its_place_among_later_orders() {
    let mut rig = nx();
    let orders = [
        rig.points(1, &[("run", 0.0), ("reverse", 1.0)]),
        rig.points(1, &[("run", 1.0)]),
    ];
    let mut placed: Vec<_> = orders.map(|order| rig.place(1, order)).into();
    for order in &mut placed {
        assert!(rig.answered(order).is_ok());
    }
    assert_eq!(rig.word(1, CONTROL_WORD) & 0b11, 0b11, "stopped, turned round, started");
}
