//! Single courses of events, told step by step.

use super::*;

#[test]
fn an_unanswered_stop_is_not_undone_by_a_bit_of_another_client() {
    let mut model = Model::new();
    for _ in 0..60 {
        model.exchange(Line::Good);
    }
    let expiry = Duration::from_secs(2);
    model.command(0, 0, Kind::Run, expiry);
    // Its control word may have to be read first.
    for _ in 0..4 {
        if model.words[0][&CONTROL] & 1 == 0 {
            model.exchange(Line::Good);
        }
    }
    assert_eq!(model.words[0][&CONTROL] & 1, 1);
    model.command(0, 0, Kind::Stop, expiry);
    model.exchange(Line::AnswerLost);
    model.exchange(Line::AnswerLost);
    model.command(1, 0, Kind::Reverse, expiry);
    for _ in 0..60 {
        model.exchange(Line::Good);
    }
    assert_eq!(model.words[0][&CONTROL], 2, "reverse is set, run stays away");
    model.end();
}

#[test]
fn a_stop_is_not_acknowledged_by_the_late_answer_to_another_write() {
    let mut model = Model::new();
    for _ in 0..60 {
        model.exchange(Line::Good);
    }
    let expiry = Duration::from_secs(2);
    model.command(0, 0, Kind::RawRuns, expiry);
    while model.late.is_empty() {
        model.exchange(Line::AnswerLate);
    }
    model.command(1, 0, Kind::RawStops, expiry);
    // The drive is busy and does not hear it; what comes is the answer to the run.
    while !model.late.is_empty() {
        model.exchange(Line::RequestLost);
    }
    assert_eq!(model.words[0][&CONTROL], 1);
    for _ in 0..4 {
        model.exchange(Line::Good);
    }
    assert_eq!(model.words[0][&CONTROL], 0);
    model.end();
}

/// A drive owes a reply, and twelve commands of one client wait for that: those of another drive go on.
#[test]
fn what_waits_for_one_drive_does_not_hold_up_another() {
    for kind in [Kind::RawRead, Kind::Reverse, Kind::RawRuns] {
        let mut model = Model::new();
        for _ in 0..60 {
            model.exchange(Line::Good);
        }
        let owed = [
            RequestPdu::Read {
                table: Table::Holding,
                start: 1400,
                count: 1,
            },
            RequestPdu::WriteRegisters {
                start: CONTROL,
                values: vec![0, 1],
            },
        ];
        for pdu in &owed {
            model.desk.debts.given_up(0, pdu, model.now, model.now);
        }
        model.desk.shadow.forget(0);
        let expiry = Duration::from_secs(3);
        for _ in 0..12 {
            model.command(0, 0, kind, expiry);
        }
        for _ in 0..12 {
            model.exchange(Line::Good);
        }
        let began = model.now;
        model.command(1, 1, Kind::RawRun, expiry);
        while model.words[1][&CONTROL] == 0 {
            model.exchange(Line::Good);
            assert!(model.now < began + Duration::from_millis(50), "behind {kind:?}");
        }
        // They are not forgotten either.
        let due = began + Duration::from_secs(2);
        while model.now < due {
            model.exchange(Line::Good);
        }
        for answer in &mut model.answers {
            assert!(answer.try_recv().is_ok(), "{kind:?}");
        }
    }
}
