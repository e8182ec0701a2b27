//! When a lease begins, and what holds it.

use super::*;
use drivegate_model::drive::DriveIndex;

#[test]
fn an_order_that_waits_holds_the_lease_no_longer_than_it_may_wait() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    rig.look(4_900, true);
    let mut order = rig.order();
    for _ in 0..19 {
        rig.look(100, true);
        assert_eq!(rig.reported(), 0);
    }
    rig.look(100, true);
    assert_eq!(rig.reported(), 1, "its time is over, and it never reached the wire");
    assert!(is_action(&rig.take().expect("the stop")));
    assert_eq!(order.try_recv().unwrap().outcome, Outcome::Purged);
}

#[test]
fn a_lease_that_nobody_held_does_not_begin_by_an_order_that_waits() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    let _order = rig.order();
    rig.look(1_000, true);
    assert_eq!(rig.drive.supervision.lease(), Lease::default());
    assert_eq!(rig.news, [], "the client is there, its order only waits");
    rig.look(1_000, true);
    assert_eq!(rig.news, [News::RunsUnsupervised(DriveIndex::new(0), Adopted::No)]);
}

#[test]
fn a_lease_begins_anew_when_the_order_ends() {
    type End = fn(&mut SupervisedDrive);
    let ends: [End; 5] = [
        |rig| rig.end(&acknowledged()),
        |rig| rig.end(&Outcome::TimedOut),
        |rig| rig.end(&Outcome::Garbled),
        |rig| rig.end(&Outcome::Exception(Exception::BUSY)),
        |rig| {
            let now = rig.now;
            rig.drive.close(&Outcome::BusDown, Interruption::BusDown, now);
        },
    ];
    for (index, end) in ends.into_iter().enumerate() {
        let mut rig = SupervisedDrive::new(LeaseAction::Stop);
        let _answer = rig.order();
        rig.begin();
        rig.send();
        rig.look(1_500, true);
        end(&mut rig);
        rig.look(4_900, true);
        assert_eq!(rig.reported(), 0, "end {index}");
        rig.look(100, true);
        assert_eq!(rig.reported(), 1, "end {index}");
    }
}

#[test]
fn a_read_that_an_order_needs_first_has_reached_the_wire() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    let _answer = rig.order_of(ModelPoint::Reverse, Value::Bool(true));
    rig.begin();
    let (_, step) = rig.send();
    assert!(!step.pdu.is_write());
    rig.look(1_500, true);
    rig.end(&Outcome::TimedOut);
    rig.look(4_900, true);
    assert_eq!(rig.reported(), 0);
    rig.look(100, true);
    assert_eq!(rig.reported(), 1);
}

#[test]
fn what_did_not_reach_the_wire_and_what_no_client_wanted_renews_nothing() {
    // The order was started, and ended before any part of it was sent.
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    let _answer = rig.order();
    rig.begin();
    rig.end(&Outcome::Expired);
    assert_eq!(rig.drive.supervision.lease(), Lease::default());
    // The orders are replaced and purged while they wait.
    let _older = rig.order();
    let _newer = rig.order();
    let _stop = rig.order_of(ModelPoint::Run, Value::Bool(false));
    rig.bus.queue.lock().remove(rig.now, &Outcome::Expired, |_| true);
    rig.look(10, false);
    assert_eq!(rig.drive.supervision.lease(), Lease::default());
    // An order of the gateway itself starts no lease.
    let mut rig = SupervisedDrive::new(LeaseAction::SpeedReference(20.0));
    rig.heartbeat();
    rig.look(5_000, true);
    rig.begin();
    rig.look(100, true);
    let (urgency, step) = rig.send();
    let ended = rig.drive.answered(urgency, &step, Reply::Written, rig.now);
    rig.end(&ended.expect("the end"));
    for _ in 0..20 {
        assert!(rig.after(1_000, true).is_none(), "once");
    }
    assert_eq!(rig.reported(), 1, "the action began no lease");
}

#[test]
fn a_read_renews_nothing_and_holds_nothing() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    rig.look(4_900, true);
    let pdu = RequestPdu::read(Table::Holding, 0, 1);
    let origin = Origin::new(SourceKind::ModbusTcp, "10.0.0.1:1");
    let window = window(rig.now, DEFAULT_EXPIRY);
    let _answer = submit(&rig.bus, DriveIndex::new(0), origin, Order::Read(pdu), window, rig.now);
    rig.look(50, true);
    rig.begin();
    rig.send();
    rig.look(50, true);
    assert_eq!(rig.reported(), 1);
}
