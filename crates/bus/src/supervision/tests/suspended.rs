//! A client that returns while the action of its lease is due or on its way.

use super::*;

const ACTIONS: [LeaseAction; 2] = [LeaseAction::Stop, LeaseAction::SpeedReference(20.0)];

/// A drive whose lease has expired, with its action waiting.
fn ran_out(action: LeaseAction) -> SupervisedDrive {
    let mut rig = SupervisedDrive::new(action);
    rig.heartbeat();
    rig.look(5_000, true);
    assert_eq!((rig.reported(), rig.bus.queue.lock().len()), (1, 1));
    rig
}

#[test]
fn an_order_that_reaches_the_wire_takes_the_place_of_an_action_that_waits() {
    for action in ACTIONS {
        let mut rig = ran_out(action);
        let mut order = rig.order();
        rig.look(10, true);
        assert_eq!(rig.own_results(), ["withdrawn"]);
        rig.look(1_000, true);
        rig.begin();
        rig.look(10, true);
        let (urgency, step) = rig.send();
        let ended = rig.drive.answered(urgency, &step, Reply::Written, rig.now);
        rig.end(&ended.expect("the end"));
        assert_eq!(order.try_recv().unwrap().outcome, acknowledged());
        assert!(rig.after(4_900, true).is_none(), "it commands the drive");
        assert!(rig.after(100, true).is_some(), "until it falls silent again");
        assert_eq!(rig.reported(), 2);
    }
}

#[test]
fn the_action_is_due_again_when_the_order_ends_without_reaching_the_wire() {
    for action in ACTIONS {
        for begun in [false, true] {
            let mut rig = ran_out(action.clone());
            let mut order = rig.order();
            rig.look(10, true);
            assert_eq!(rig.own_results(), ["withdrawn"]);
            if begun {
                rig.begin();
                rig.look(10, true);
                rig.end(&Outcome::Offline);
            } else {
                rig.look(1_980, true);
                assert_eq!(rig.bus.queue.lock().len(), 1, "suspended");
                rig.look(10, true);
            }
            rig.look(10, true);
            let again = rig.take().expect("the action");
            assert!(is_action(&again) && order.try_recv().is_ok());
            assert_eq!(rig.reported(), 1, "the lease ran out once");
        }
    }
}

#[test]
fn an_action_that_failed_is_not_tried_again_while_a_client_is_back() {
    let mut rig = ran_out(LeaseAction::Stop);
    let action = rig.take().expect("the stop");
    action.answer(&Outcome::TimedOut, rig.now);
    let _order = rig.order();
    for _ in 0..19 {
        rig.look(100, true);
        assert_eq!(rig.bus.queue.lock().len(), 1, "the order alone");
    }
    rig.look(1_000, true);
    assert!(is_action(&rig.take().expect("the stop")));
}
