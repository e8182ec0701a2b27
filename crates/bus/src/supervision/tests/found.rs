//! What the state machine must do where answers and heartbeats cross.

use super::*;

fn ran_out() -> Bench {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.heartbeat();
    bench.look(5_000, true);
    bench
}

#[test]
fn a_heartbeat_takes_back_an_action_that_waits() {
    let mut bench = ran_out();
    bench.heartbeat();
    bench.look(10, true);
    assert_eq!(
        bench.own_results(),
        ["withdrawn"],
        "it would override the client that is back"
    );
    assert!(bench.take().is_none());
}

#[test]
fn an_answer_of_an_earlier_lease_does_not_stand_for_the_action_of_the_next() {
    let mut bench = ran_out();
    let action = bench.take().expect("the stop");
    // On the wire when the heartbeat comes.
    bench.heartbeat();
    bench.look(10, true);
    action.answer(&acknowledged(), bench.now);
    assert!(bench.after(4_900, true).is_none());
    assert!(
        bench.after(90, true).is_some(),
        "the lease ran out again, and the motor runs"
    );
    assert_eq!(bench.reported(), 2);
}

#[test]
fn an_action_that_was_acknowledged_while_an_order_waited_is_not_written_again() {
    let mut bench = ran_out();
    let action = bench.take().expect("the stop");
    let _order = bench.order();
    bench.look(10, true);
    assert_eq!(bench.own_results(), [""; 0], "it is not taken back from the wire");
    action.answer(&acknowledged(), bench.now);
    bench.look(10, true);
    bench.look(2_000, true);
    assert!(
        bench.take().is_none(),
        "the order never reached the wire, and the action was written"
    );
}
