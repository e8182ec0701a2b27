//! A run bit that another source took away is not restored by a command that does not contain it.

use super::*;

/// A drive whose word the gateway knows from a time when it ran.
fn bench(word: u16) -> ObedientDrive {
    let mut bench = ObedientDrive::new(word);
    bench.running = true;
    bench.words.learn(Table::Holding, 2000, 1);
    bench
}

fn reverse(bench: &ObedientDrive) -> CommandRun {
    bench.begin(&[("reverse", 1.0)], Urgency::Command).0
}

#[test]
fn the_word_is_read_before_a_run_bit_that_is_not_named_is_written() {
    for (has, written) in [(0, 2), (1, 3), (0x0800, 0x0802)] {
        let mut bench = bench(has);
        let mut command = reverse(&bench);
        assert!(asks(&sends(&bench, &mut command)));
        assert_eq!(bench.run(&mut command), [(0, 2000, written)], "{has}");
    }
    // No word in these cases could start the motor, so no read is needed.
    let mut bench = bench(0);
    bench.words.learn(Table::Holding, 2000, 0);
    assert_eq!(sends(&bench, &mut reverse(&bench)), word(2));
}

#[test]
fn a_command_that_names_run_is_one_write() {
    let bench = bench(0);
    for (points, urgency, written) in [
        (&[("run", 1.0)][..], Urgency::Command, 1),
        (&[("run", 1.0), ("reverse", 1.0)], Urgency::Command, 3),
        (&[("run", 0.0)], Urgency::Stop, 0),
    ] {
        let (mut command, _a) = bench.begin(points, urgency);
        assert_eq!(sends(&bench, &mut command), word(written));
    }
}

#[test]
fn a_reset_brings_no_run_bit_back() {
    // The process data are from before the stop.
    let mut bench = bench(0);
    let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
    assert_eq!(bench.run(&mut reset), [(0, 2000, 4), (20, 2000, 0)]);
}

#[test]
fn a_drive_that_does_not_tell_keeps_its_run_bit_while_its_motor_runs() {
    for (polled, running) in [(true, true), (false, true), (true, false), (false, false)] {
        let mut bench = bench(1);
        bench.running = polled;
        let mut command = reverse(&bench);
        let read = sends(&bench, &mut command);
        let refused = Reply::Exception(Exception::ADDRESS);
        assert_eq!(command.answered(&read, refused, &mut bench.words), None);
        bench.running = running;
        looks(&mut bench, &mut command);
        let next = command.next(&bench.words, &bench.profile, polled, bench.now);
        let expected = if running { Next::Send(word(3)) } else { Next::Done };
        assert_eq!(next, expected, "polled: {polled}, running: {running}");
    }
    // The run bit of a drive that is only busy, or silent, is kept while its motor runs.
    let mut bench = bench(1);
    let mut command = reverse(&bench);
    let read = sends(&bench, &mut command);
    let busy = Reply::Exception(Exception::BUSY);
    assert_eq!(command.answered(&read, busy, &mut bench.words), None);
    let next = command.next(&bench.words, &bench.profile, true, bench.now);
    assert!(matches!(next, Next::Wait(_)), "{next:?}");
    bench.now += Duration::from_millis(100);
    assert_eq!(
        sends(&bench, &mut command),
        read,
        "nothing is written before it has told"
    );
    for (running, ended) in [(true, Some(Outcome::TimedOut)), (false, None)] {
        bench.running = running;
        let mut command = reverse(&bench);
        for outcome in [None, ended] {
            assert!(asks(&sends(&bench, &mut command)));
            assert_eq!(command.failed(&read, Outcome::TimedOut, 1), outcome);
        }
        if !running {
            looks(&mut bench, &mut command);
            let next = command.next(&bench.words, &bench.profile, false, bench.now);
            assert_eq!(next, Next::Done, "the run bit that is known is not written");
        }
    }
}

#[test]
fn each_try_of_the_write_has_a_read_of_its_own_and_there_are_no_more_of_them() {
    let mut bench = bench(1);
    let mut command = reverse(&bench);
    let report = |command: &mut CommandRun, bench: &mut ObedientDrive, has: u16| {
        let read = sends(bench, command);
        assert!(asks(&read));
        let reported = Reply::Registers(vec![has]);
        assert_eq!(command.answered(&read, reported, &mut bench.words), None);
    };
    report(&mut command, &mut bench, 1);
    looks(&mut bench, &mut command);
    assert_eq!(sends(&bench, &mut command), word(3));
    command.sent(&word(3));
    assert_eq!(command.failed(&word(3), Outcome::TimedOut, 1), None);
    report(&mut command, &mut bench, 0);
    assert_eq!(sends(&bench, &mut command), word(2));
    assert_eq!(command.failed(&word(2), Outcome::TimedOut, 1), Some(Outcome::TimedOut));
}

/// The end of a pulse is always sent; without a read of the motor state it contains no run bit.
#[test]
fn no_read_stands_in_the_way_of_the_end_of_a_pulse() {
    #[derive(Debug, Clone, Copy)]
    enum Heard {
        Word(bool),
        Busy,
        Nothing,
    }
    let busy = || Reply::Exception(Exception::BUSY);
    for (word_told, look, written) in [
        (true, Heard::Word(true), 1),
        (true, Heard::Word(false), 0),
        (true, Heard::Busy, 0),
        (true, Heard::Nothing, 0),
        (false, Heard::Word(true), 1),
        (false, Heard::Word(false), 0),
    ] {
        let mut bench = bench(1);
        let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
        let tells = |reset: &mut CommandRun, bench: &mut ObedientDrive, told: bool| {
            let read = sends(bench, reset);
            assert!(asks(&read));
            let reply = if told { Reply::Registers(vec![1]) } else { busy() };
            assert_eq!(reset.answered(&read, reply, &mut bench.words), None);
        };
        looks(&mut bench, &mut reset);
        tells(&mut reset, &mut bench, true);
        assert_eq!(sends(&bench, &mut reset), word(5));
        reset.sent(&word(5));
        assert_eq!(reset.answered(&word(5), Reply::Written, &mut bench.words), None);
        assert!(matches!(
            reset.next(&bench.words, &bench.profile, true, bench.now),
            Next::Wait(_)
        ));
        bench.now += Duration::from_millis(20);
        tells(&mut reset, &mut bench, word_told);
        match look {
            Heard::Word(running) => {
                bench.running = running;
                looks(&mut bench, &mut reset);
            }
            Heard::Busy => {
                let step = sends(&bench, &mut reset);
                assert_eq!(reset.answered(&step, busy(), &mut bench.words), None);
            }
            Heard::Nothing => {
                let step = sends(&bench, &mut reset);
                assert_eq!(reset.failed(&step, Outcome::TimedOut, 1), None);
                assert_eq!(sends(&bench, &mut reset), step, "it is asked again");
                assert_eq!(reset.failed(&step, Outcome::TimedOut, 1), None);
            }
        }
        assert_eq!(sends(&bench, &mut reset), word(written), "{word_told} {look:?}");
    }
}
