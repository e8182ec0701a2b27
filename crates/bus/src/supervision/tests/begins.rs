//! When a lease begins, and what holds it.

use super::*;
use crate::drive::DriveIndex;

#[test]
fn an_order_that_waits_holds_the_lease_no_longer_than_it_may_wait() {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.heartbeat();
    bench.look(4_900, true);
    let mut order = bench.order();
    for _ in 0..19 {
        bench.look(100, true);
        assert_eq!(bench.reported(), 0);
    }
    bench.look(100, true);
    assert_eq!(bench.reported(), 1, "its time is over, and it never reached the wire");
    assert!(is_action(&bench.take().expect("the stop")));
    assert_eq!(order.try_recv().unwrap().outcome, Outcome::Purged);
}

#[test]
fn a_lease_that_nobody_held_does_not_begin_by_an_order_that_waits() {
    let mut bench = Bench::new(LeaseAction::Stop);
    let _order = bench.order();
    bench.look(1_000, true);
    assert_eq!(bench.drive.supervision.lease(), Lease::default());
    assert_eq!(bench.news, [], "the client is there, its order only waits");
    bench.look(1_000, true);
    assert_eq!(bench.news, [News::RunsUnsupervised(DriveIndex::new(0), Adopted::No)]);
}

#[test]
fn a_lease_begins_anew_when_the_order_ends() {
    type End = fn(&mut Bench);
    let ends: [End; 5] = [
        |bench| bench.end(&acknowledged()),
        |bench| bench.end(&Outcome::TimedOut),
        |bench| bench.end(&Outcome::Garbled),
        |bench| bench.end(&Outcome::Exception(Exception::BUSY)),
        |bench| {
            let now = bench.now;
            bench.drive.close(&Outcome::BusDown, Interruption::BusDown, now);
        },
    ];
    for (index, end) in ends.into_iter().enumerate() {
        let mut bench = Bench::new(LeaseAction::Stop);
        let _answer = bench.order();
        bench.begin();
        bench.send();
        bench.look(1_500, true);
        end(&mut bench);
        bench.look(4_900, true);
        assert_eq!(bench.reported(), 0, "end {index}");
        bench.look(100, true);
        assert_eq!(bench.reported(), 1, "end {index}");
    }
}

#[test]
fn a_read_that_an_order_needs_first_has_reached_the_wire() {
    let mut bench = Bench::new(LeaseAction::Stop);
    let _answer = bench.order_of(ModelPoint::Reverse, Value::Bool(true));
    bench.begin();
    let (_, step) = bench.send();
    assert!(!step.pdu.is_write());
    bench.look(1_500, true);
    bench.end(&Outcome::TimedOut);
    bench.look(4_900, true);
    assert_eq!(bench.reported(), 0);
    bench.look(100, true);
    assert_eq!(bench.reported(), 1);
}

#[test]
fn what_did_not_reach_the_wire_and_what_no_client_wanted_renews_nothing() {
    // Begun, and over before anything of it was sent.
    let mut bench = Bench::new(LeaseAction::Stop);
    let _answer = bench.order();
    bench.begin();
    bench.end(&Outcome::Expired);
    assert_eq!(bench.drive.supervision.lease(), Lease::default());
    // Replaced and purged while it waited.
    let _older = bench.order();
    let _newer = bench.order();
    let _stop = bench.order_of(ModelPoint::Run, Value::Bool(false));
    bench.bus.queue.lock().remove(bench.now, &Outcome::Expired, |_| true);
    bench.look(10, false);
    assert_eq!(bench.drive.supervision.lease(), Lease::default());
    // The gateway's own order.
    let mut bench = Bench::new(LeaseAction::SpeedReference(20.0));
    bench.heartbeat();
    bench.look(5_000, true);
    bench.begin();
    bench.look(100, true);
    let (urgency, step) = bench.send();
    let ended = bench.drive.answered(urgency, &step, Reply::Written);
    bench.end(&ended.expect("the end"));
    for _ in 0..20 {
        assert!(bench.after(1_000, true).is_none(), "once");
    }
    assert_eq!(bench.reported(), 1, "the action began no lease");
}

#[test]
fn a_read_renews_nothing_and_holds_nothing() {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.heartbeat();
    bench.look(4_900, true);
    let pdu = RequestPdu::Read {
        table: Table::Holding,
        start: 0,
        count: 1,
    };
    let image = bench.image();
    let admitted = admit(
        Order::Read(pdu),
        &image.reading(bench.now, DEFAULT_EXPIRY),
        Authority::Write,
    )
    .unwrap();
    let origin = Origin::new(SourceKind::ModbusTcp, "10.0.0.1:1");
    let (ticket, _answer) = Ticket::new(origin, "d", String::new(), false, bench.now, bench.stats.clone());
    let command = Command::new(DriveIndex::new(0), admitted, bench.now + DEFAULT_EXPIRY, ticket);
    bench.bus.queue.submit(command, bench.now);
    bench.look(50, true);
    bench.begin();
    bench.send();
    bench.look(50, true);
    assert_eq!(bench.reported(), 1);
}
