//! Writes of values that a drive keeps in memory that wears out: N2 overrides.

use super::*;
use drivegate_proto::n2::Session;

/// 50 % as the float of AO 1.
const HALF: [u16; 2] = [0x4248, 0x0000];

fn bench() -> ObedientDrive {
    ObedientDrive {
        profile: Profiles::built_in().get("vacon-nx-n2").unwrap().clone(),
        ..ObedientDrive::new(0)
    }
}

fn read(table: Table, count: u16) -> Step {
    let start = 0;
    let purpose = StepPurpose::Compare;
    let pdu = RequestPdu::Read { table, start, count };
    Step { purpose, pdu }
}

fn override_ao() -> Step {
    let (start, values) = (0, HALF.to_vec());
    execute(RequestPdu::WriteRegisters { start, values })
}

fn release() -> Step {
    let (table, address) = (Table::Holding, 0);
    let purpose = StepPurpose::Release;
    let pdu = RequestPdu::N2(Session::Release { table, address });
    Step { purpose, pdu }
}

fn coil(address: u16, on: bool) -> Step {
    execute(RequestPdu::WriteCoil { address, on })
}

/// The last read of AO 1 showed another value.
fn changed(bench: &mut ObedientDrive) {
    bench.words.learn(Table::Holding, 0, 0);
    bench.words.learn(Table::Holding, 1, HALF[1]);
}

fn reference(bench: &ObedientDrive) -> CommandRun {
    bench.begin(&[("speed_reference", 50.0)], Urgency::Command).0
}

#[test]
fn what_the_drive_has_is_read_and_not_written() {
    let mut bench = bench();
    let mut command = reference(&bench);
    assert_eq!(sends(&bench, &mut command), read(Table::Holding, 2));
    let has = Reply::Registers(HALF.to_vec());
    assert_eq!(command.answered(&read(Table::Holding, 2), has, &mut bench.words), None);
    // Neither the override nor its release is sent.
    let next = command.next(&bench.words, &bench.profile, false, bench.now);
    assert_eq!(next, Next::Done);
    assert_eq!(command.success(), Outcome::Acknowledged(Reply::Written));
}

#[test]
fn what_was_read_earlier_lets_write_and_leaves_nothing_out() {
    let mut bench = bench();
    changed(&mut bench);
    assert_eq!(sends(&bench, &mut reference(&bench)), override_ao());
    // The drive had the value at the last read but may have another one by now, so it is read again.
    bench.words.learn(Table::Holding, 0, HALF[0]);
    for (has, next) in [(HALF[0], Next::Done), (0x429A, Next::Send(override_ao()))] {
        let mut command = reference(&bench);
        let check = sends(&bench, &mut command);
        assert_eq!(check, read(Table::Holding, 2));
        let has = Reply::Registers(vec![has, HALF[1]]);
        assert_eq!(command.answered(&check, has, &mut bench.words), None);
        assert_eq!(command.next(&bench.words, &bench.profile, false, bench.now), next);
    }
}

#[test]
fn a_drive_that_does_not_tell_is_written() {
    let mut bench = bench();
    let mut command = reference(&bench);
    let check = sends(&bench, &mut command);
    let refused = Reply::Exception(Exception::N2(0x10));
    assert_eq!(command.answered(&check, refused, &mut bench.words), None);
    assert_eq!(sends(&bench, &mut command), override_ao());
}

#[test]
fn a_release_is_behind_the_override_and_may_fail() {
    let refused = Reply::Exception(Exception::N2(0x11));
    for answer in [Some(Reply::Written), Some(refused), None] {
        let mut bench = bench();
        changed(&mut bench);
        let mut command = reference(&bench);
        assert_eq!(sends(&bench, &mut command), override_ao());
        assert_eq!(command.answered(&override_ao(), Reply::Written, &mut bench.words), None);
        assert_eq!(sends(&bench, &mut command), release());
        let ended = match answer {
            Some(reply) => command.answered(&release(), reply, &mut bench.words),
            None => {
                assert_eq!(
                    command.failed(&release(), Outcome::TimedOut, 1),
                    None,
                    "it is tried again"
                );
                assert_eq!(sends(&bench, &mut command), release());
                command.failed(&release(), Outcome::TimedOut, 1)
            }
        };
        assert_eq!(ended, Some(Outcome::Acknowledged(Reply::Written)));
        assert!(!command.in_doubt(), "what was overridden is known");
    }
}

#[test]
fn an_override_that_is_refused_is_not_released() {
    let mut bench = bench();
    changed(&mut bench);
    let mut command = reference(&bench);
    assert_eq!(sends(&bench, &mut command), override_ao());
    let refused = Exception::N2(0x10);
    let ended = command.answered(&override_ao(), Reply::Exception(refused), &mut bench.words);
    assert_eq!(ended, Some(Outcome::Exception(refused)));
}

#[test]
fn a_stop_is_never_left_out() {
    let mut bench = bench();
    bench.words.learn(Table::Coil, 0, 0);
    for urgency in [Urgency::Stop, Urgency::Command] {
        let (mut stop, _answer) = bench.begin(&[("run", 0.0)], urgency);
        assert_eq!(sends(&bench, &mut stop), coil(0, false));
    }
    // A start is left out if the drive reports that it already has the run command.
    for (has, next) in [(true, Next::Done), (false, Next::Send(coil(0, true)))] {
        bench.words.learn(Table::Coil, 0, 1);
        let (mut start, _answer) = bench.begin(&[("run", 1.0)], Urgency::Command);
        let check = sends(&bench, &mut start);
        assert_eq!(check, read(Table::Coil, 1));
        assert_eq!(start.answered(&check, Reply::Bits(vec![has]), &mut bench.words), None);
        assert_eq!(start.next(&bench.words, &bench.profile, true, bench.now), next);
    }
}

#[test]
fn a_pulse_is_never_left_out() {
    let mut bench = bench();
    bench.running = true;
    for (address, word) in [(0, 0), (2, 0)] {
        bench.words.learn(Table::Coil, address, word);
    }
    let (mut reset, _answer) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
    let mut sent = Vec::new();
    loop {
        match reset.next(&bench.words, &bench.profile, bench.running, bench.now) {
            Next::Wait(until) => bench.now = until,
            Next::Done => break,
            Next::Send(step) => {
                let over = reset.answered(&step, Reply::Written, &mut bench.words).is_some();
                sent.push(step);
                if over {
                    break;
                }
            }
        }
    }
    assert_eq!(sent, [coil(2, false), coil(2, true), coil(2, false)]);
}
