//! A run bit that was taken away behind the gateway's back is not brought back by a command that does not name it.

use super::*;

/// A drive whose word the gateway knows from when it ran.
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
    // Nothing that could start the motor: no read.
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
    for (running, written) in [(true, 3), (false, 2)] {
        let mut bench = bench(1);
        bench.running = running;
        let mut command = reverse(&bench);
        let read = sends(&bench, &mut command);
        let refused = Reply::Exception(Exception::ADDRESS);
        assert_eq!(command.answered(&read, refused, &mut bench.words), None);
        assert_eq!(sends(&bench, &mut command), word(written), "running: {running}");
    }
    // One that is only busy, or silent, is not overruled while its motor runs.
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
            assert_eq!(sends(&bench, &mut command), word(2));
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
    assert_eq!(sends(&bench, &mut command), word(3));
    assert_eq!(command.failed(&word(3), Outcome::TimedOut, 1), None);
    report(&mut command, &mut bench, 0);
    assert_eq!(sends(&bench, &mut command), word(2));
    assert_eq!(command.failed(&word(2), Outcome::TimedOut, 1), Some(Outcome::TimedOut));
}

#[test]
fn no_read_stands_in_the_way_of_the_end_of_a_pulse() {
    let busy = || Some(Reply::Exception(Exception::BUSY));
    for (answer, running, written) in [(busy(), true, 1), (busy(), false, 0), (None, true, 1), (None, false, 0)] {
        let mut bench = bench(1);
        let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
        let read = sends(&bench, &mut reset);
        let has = Reply::Registers(vec![1]);
        assert_eq!(reset.answered(&read, has, &mut bench.words), None);
        assert_eq!(sends(&bench, &mut reset), word(5));
        assert_eq!(reset.answered(&word(5), Reply::Written, &mut bench.words), None);
        bench.now += Duration::from_millis(20);
        bench.running = running;
        assert!(matches!(
            reset.next(&bench.words, &bench.profile, running, bench.now),
            Next::Wait(_)
        ));
        bench.now += Duration::from_millis(20);
        assert!(asks(&sends(&bench, &mut reset)));
        let ended = match answer {
            Some(reply) => reset.answered(&read, reply, &mut bench.words),
            None => reset.failed(&read, Outcome::TimedOut, 3),
        };
        assert_eq!(ended, None);
        assert_eq!(sends(&bench, &mut reset), word(written), "running: {running}");
    }
}
