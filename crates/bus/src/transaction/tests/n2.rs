//! Answers on an N2 line that may be late ones.

use super::*;
use crate::n2_late_replies::{LateRequest, N2LateReplies};
use drivegate_proto::Table;

const WINDOW: Duration = Duration::from_millis(750);

fn state(start: u16) -> RequestPdu {
    RequestPdu::read(Table::DiscreteInput, start, 1)
}

/// A transaction that begins while the late reply to the read of a state may still arrive.
fn behind_late_state(pdu: RequestPdu, now: Instant) -> (Transaction, N2LateReplies) {
    let request = Request::new(1, pdu);
    let mut frame = Vec::new();
    Protocol::N2.encode(&request, &mut frame);
    let mut late = N2LateReplies::default();
    let asked = LateRequest {
        address: 2,
        pdu: &state(3),
        device: 0x10,
        at: now,
    };
    late.given_up(asked, WINDOW, now);
    let transaction = Transaction::new(
        Protocol::N2,
        request,
        frame,
        now,
        Duration::from_millis(250),
        Duration::from_millis(15),
        false,
    );
    (transaction, late)
}

#[test]
fn a_drive_that_started_anew_is_believed_unless_another_answer_comes() {
    let now = Instant::now();
    let soon = now + Duration::from_millis(20);
    let float = RequestPdu::read(Table::Input, 0, 2);
    let (mut alone, mut late) = behind_late_state(float.clone(), now);
    let Step::Wait(until) = alone.receive(soon, b"N00\r", &mut late) else {
        panic!("it may be a late one")
    };
    assert_eq!(until, alone.deadline());
    let restarted = Reply::Exception(Exception::N2_RESTARTED);
    assert_eq!(alone.on_time(until), Step::Done(Ended::Reply(restarted)));

    let (mut with_own, mut late) = behind_late_state(float.clone(), now);
    assert!(matches!(with_own.receive(soon, b"N00\r", &mut late), Step::Wait(_)));
    let own = with_own.receive(soon, b"A4248000092\r", &mut late);
    assert!(matches!(own, Step::Done(Ended::Reply(Reply::Registers(_)))), "{own:?}");
    assert!(!late.may_come(soon), "the late one came");

    let (mut other, mut late) = behind_late_state(float, now);
    let refused = other.receive(soon, b"N11\r", &mut late);
    assert_eq!(
        refused,
        Step::Done(Ended::Corrupt(MAY_BE_LATE)),
        "nothing is refused by chance"
    );
}

#[test]
fn an_identity_that_could_be_a_state_is_believed_unless_another_answer_comes() {
    let now = Instant::now();
    let (mut transaction, mut late) = behind_late_state(RequestPdu::N2(Session::Identify), now);
    let Step::Wait(until) = transaction.receive(now, b"A1061\r", &mut late) else {
        panic!("it may be a late state")
    };
    assert!(matches!(transaction.on_time(until), Step::Done(Ended::Reply(_))));
}
