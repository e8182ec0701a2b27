//! Single courses of events, told step by step.

use super::*;

#[test]
fn an_unanswered_stop_is_not_undone_by_a_bit_of_another_client() {
    let mut model = Model::found();
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
    model.goes_well(60);
    assert_eq!(model.words[0][&CONTROL], 2, "reverse is set, run stays away");
    model.end();
}

#[test]
fn a_stop_is_not_acknowledged_by_the_late_answer_to_another_write() {
    let mut model = Model::found();
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
    model.goes_well(4);
    assert_eq!(model.words[0][&CONTROL], 0);
    model.end();
}

/// A drive owes a reply, and twelve commands of one client wait for that: those of another drive go on.
#[test]
fn what_waits_for_one_drive_does_not_hold_up_another() {
    for kind in [Kind::RawRead, Kind::Reverse, Kind::RawRuns] {
        let mut model = Model::found();
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
        model.goes_well(12);
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

/// A drive owes the answer to a run; a reset has been set and the word read, and its end, which looks like that run, waits.
/// Until when.
fn held_up() -> (Model, Instant) {
    let mut model = Model::found();
    model.command(0, 0, Kind::RawRun, Duration::from_millis(51));
    model.exchange(Line::AnswerLost);
    // The drive says that its motor runs.
    model.words[0].insert(2100, 2);
    model.goes_well(10);
    model.command(0, 0, Kind::Reset, Duration::from_secs(5));
    model.goes_well(40);
    assert_eq!(model.words[0][&CONTROL], 5);
    let end = RequestPdu::WriteRegister {
        address: CONTROL,
        value: 1,
    };
    let until = model.desk.debts.blocks(0, &end, model.now).expect("the end waits");
    (model, until)
}

#[test]
fn the_end_of_a_pulse_that_was_held_up_does_not_undo_a_stop_that_is_not_answered() {
    let (mut model, until) = held_up();
    while model.now + Duration::from_millis(30) < until {
        model.exchange(Line::Good);
    }
    model.command(1, 0, Kind::RawStop, Duration::from_millis(1));
    model.exchange(Line::AnswerLost);
    assert!(model.now > until && model.words[0][&CONTROL] == 0);
    model.goes_well(20);
    assert_eq!(model.words[0][&CONTROL], 0);
    model.end();
}

#[test]
fn the_end_of_a_pulse_that_was_held_up_does_not_undo_a_stop_at_the_panel() {
    let (mut model, until) = held_up();
    while model.now + Duration::from_millis(6) < until {
        model.exchange(Line::Good);
    }
    model.words[0].insert(CONTROL, 4);
    model.may_run[0] = None;
    model.now = until;
    model.goes_well(20);
    assert_eq!(model.words[0][&CONTROL], 0);
    model.end();
}
