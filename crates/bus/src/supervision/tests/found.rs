//! Requirements on the state machine where answers and heartbeats cross.

use super::*;

fn ran_out() -> SupervisedDrive {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    rig.look(5_000, true);
    rig
}

#[test]
fn a_heartbeat_takes_back_an_action_that_waits() {
    let mut rig = ran_out();
    rig.heartbeat();
    rig.look(10, true);
    assert_eq!(
        rig.own_results(),
        ["withdrawn"],
        "it would override the client that is back"
    );
    assert!(rig.take().is_none());
}

#[test]
fn an_answer_of_an_earlier_lease_does_not_stand_for_the_action_of_the_next() {
    let mut rig = ran_out();
    let action = rig.take().expect("the stop");
    // The action is already on the wire when the heartbeat arrives.
    rig.heartbeat();
    rig.look(10, true);
    action.answer(&acknowledged(), rig.now);
    assert!(rig.after(4_900, true).is_none());
    assert!(
        rig.after(90, true).is_some(),
        "the lease ran out again, and the motor runs"
    );
    assert_eq!(rig.reported(), 2);
}

#[test]
fn an_action_that_was_acknowledged_while_an_order_waited_is_not_written_again() {
    let mut rig = ran_out();
    let action = rig.take().expect("the stop");
    let _order = rig.order();
    rig.look(10, true);
    assert_eq!(rig.own_results(), [""; 0], "it is not taken back from the wire");
    action.answer(&acknowledged(), rig.now);
    rig.look(10, true);
    rig.look(2_000, true);
    assert!(
        rig.take().is_none(),
        "the order never reached the wire, and the action was written"
    );
}
