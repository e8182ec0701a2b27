//! A client that is back, while the action of its lease is due or on its way.

use super::*;

const ACTIONS: [LeaseAction; 2] = [LeaseAction::Stop, LeaseAction::SpeedReference(20.0)];

/// The lease of a drive has run out, and its action waits.
fn ran_out(action: LeaseAction) -> Bench {
    let mut bench = Bench::new(action);
    bench.heartbeat();
    bench.look(5_000, true);
    assert_eq!((bench.reported(), bench.bus.queue.lock().len()), (1, 1));
    bench
}

#[test]
fn an_order_that_reaches_the_wire_takes_the_place_of_an_action_that_waits() {
    for action in ACTIONS {
        let mut bench = ran_out(action);
        let mut order = bench.order();
        bench.look(10, true);
        assert_eq!(bench.own_results(), ["withdrawn"]);
        bench.look(1_000, true);
        bench.begin();
        bench.look(10, true);
        let (urgency, step) = bench.send();
        let ended = bench.drive.answered(urgency, &step, Reply::Written);
        bench.end(&ended.expect("the end"));
        assert_eq!(order.try_recv().unwrap().outcome, acknowledged());
        assert!(bench.after(4_900, true).is_none(), "it commands the drive");
        assert!(bench.after(100, true).is_some(), "until it falls silent again");
        assert_eq!(bench.reported(), 2);
    }
}

#[test]
fn the_action_is_due_again_when_the_order_ends_without_reaching_the_wire() {
    for action in ACTIONS {
        for begun in [false, true] {
            let mut bench = ran_out(action.clone());
            let mut order = bench.order();
            bench.look(10, true);
            assert_eq!(bench.own_results(), ["withdrawn"]);
            if begun {
                bench.begin();
                bench.look(10, true);
                bench.end(&Outcome::Offline);
            } else {
                bench.look(1_980, true);
                assert_eq!(bench.bus.queue.lock().len(), 1, "suspended");
                bench.look(10, true);
            }
            bench.look(10, true);
            let again = bench.take().expect("the action");
            assert!(is_action(&again) && order.try_recv().is_ok());
            assert_eq!(bench.reported(), 1, "the lease ran out once");
        }
    }
}

#[test]
fn an_action_that_failed_is_not_tried_again_while_a_client_is_back() {
    let mut bench = ran_out(LeaseAction::Stop);
    let action = bench.take().expect("the stop");
    action.answer(&Outcome::TimedOut, bench.now);
    let _order = bench.order();
    for _ in 0..19 {
        bench.look(100, true);
        assert_eq!(bench.bus.queue.lock().len(), 1, "the order alone");
    }
    bench.look(1_000, true);
    assert!(is_action(&bench.take().expect("the stop")));
}
