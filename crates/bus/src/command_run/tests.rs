use drivegate_testkit::window;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot::Receiver;

use super::*;
use drivegate_core::order::{Admitted, Answer, CommandLog, Origin, Refusal, SourceKind};
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{DriveIndex, Value};
use drivegate_proto::{Exception, RequestPdu, Table};

mod directions;
mod elsewhere;
mod functions;
mod looking;
mod on_change;
mod repetitions;

struct ObedientDrive {
    profile: Arc<Profile>,
    words: KnownWords,
    now: Instant,
    /// Control word and reference of the drive.
    drive: BTreeMap<u16, u16>,
    running: bool,
}

impl ObedientDrive {
    fn new(control_word: u16) -> ObedientDrive {
        let drive = BTreeMap::from([(2000, control_word), (2002, 0)]);
        ObedientDrive {
            profile: Profiles::built_in().get("vacon-nx").unwrap().clone(),
            words: KnownWords::default(),
            now: Instant::now(),
            drive,
            running: false,
        }
    }

    fn begin(&self, points: &[(&str, f64)], urgency: Urgency) -> (CommandRun, Receiver<Answer>) {
        let values = points
            .iter()
            .map(|(name, v)| {
                let index = self.profile.point_index(name).unwrap();
                let bool = matches!(*name, "run" | "reverse" | "fault_reset");
                (
                    index,
                    if bool {
                        Value::Bool(*v != 0.0)
                    } else {
                        Value::Number(*v)
                    },
                )
            })
            .collect();
        let origin = Origin::new(SourceKind::Mqtt, "t");
        let command_log = Arc::new(CommandLog::default());
        let (ticket, receiver) = Ticket::new(origin, "d", String::new(), true, self.now, command_log);
        let admitted = Admitted {
            order: Order::Points(values),
            urgency,
            reference_only: false,
            ranges: Vec::new(),
        };
        let command = Command::new(
            DriveIndex::new(0),
            admitted,
            &self.profile,
            window(self.now, Duration::from_secs(1)),
            ticket,
        );
        (CommandRun::new(command, &self.profile), receiver)
    }

    /// Registers of the drive; the status words show that it is controlled by the bus, and whether its motor runs.
    fn shows(&self, start: u16, count: u16) -> Reply {
        let status = [(2100, u16::from(self.running) << 1), (2101, 1 << 13)];
        let word = |address| {
            let of_status = status.iter().find(|(of, _)| *of == address);
            of_status.map_or_else(|| self.drive[&address], |(_, word)| *word)
        };
        Reply::Registers((start..start + count).map(word).collect())
    }

    /// Runs the command against a drive that does as commanded; the writes as (ms, address, value).
    fn run(&mut self, run: &mut CommandRun) -> Vec<(u128, u16, u16)> {
        let start = self.now;
        let mut writes = Vec::new();
        for _ in 0..50 {
            match run.next(&self.words, &self.profile, self.running, self.now) {
                Next::Done => return writes,
                Next::Wait(until) => self.now = until,
                Next::Send(step) => {
                    run.sent(&step);
                    let reply = match step.pdu {
                        RequestPdu::Read { start, count, .. } => self.shows(start, count),
                        RequestPdu::WriteRegister { address, value } => {
                            writes.push(((self.now - start).as_millis(), address, value));
                            self.drive.insert(address, value);
                            Reply::Written
                        }
                        _ => unreachable!(),
                    };
                    self.words.advance_to(self.now);
                    if run.answered(&step, reply, &mut self.words).is_some() {
                        return writes;
                    }
                }
            }
        }
        panic!("the command does not end");
    }
}

#[test]
fn bits_of_others_are_kept_and_the_word_is_read_first() {
    let mut bench = ObedientDrive::new(0x0800);
    let (mut run, _answer) = bench.begin(&[("run", 1.0)], Urgency::Command);
    assert!(asks(&sends(&bench, &mut run)));
    assert_eq!(bench.run(&mut run), [(0, 2000, 0x0801)]);
    assert_eq!(run.success(), Outcome::Acknowledged(Reply::Written));
}

#[test]
fn safe_order() {
    let mut bench = ObedientDrive::new(0);
    let (mut start, _a) = bench.begin(
        &[("run", 1.0), ("reverse", 1.0), ("speed_reference", 50.0)],
        Urgency::Command,
    );
    assert_eq!(
        bench.run(&mut start),
        [(0, 2002, 5000), (0, 2000, 3)],
        "reference before run, one control word"
    );
    let (mut stop, _b) = bench.begin(&[("speed_reference", 0.0), ("run", 0.0)], Urgency::Stop);
    assert_eq!(
        bench.run(&mut stop),
        [(0, 2000, 2), (0, 2002, 0)],
        "stop before anything"
    );
}

#[test]
fn reset_is_a_pulse_whatever_the_level_and_starts_nothing() {
    let mut bench = ObedientDrive::new(0);
    let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
    assert_eq!(bench.run(&mut reset), [(0, 2000, 4), (20, 2000, 0)]);
    // The reset bit is already set, and so is the run bit, although the motor is at standstill with a fault.
    let mut bench = ObedientDrive::new(0x0005);
    let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
    assert_eq!(bench.run(&mut reset), [(0, 2000, 0), (20, 2000, 4), (40, 2000, 0)]);
    // A motor that runs keeps its run bit.
    let mut bench = ObedientDrive::new(0x0001);
    bench.running = true;
    let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
    assert_eq!(bench.run(&mut reset), [(0, 2000, 5), (20, 2000, 1)]);
    // Reset and run in one command: a new edge after the pulse.
    let mut bench = ObedientDrive::new(0x0001);
    let (mut both, _a) = bench.begin(&[("run", 1.0), ("fault_reset", 1.0)], Urgency::Command);
    assert_eq!(
        bench.run(&mut both),
        [(0, 2000, 0), (20, 2000, 4), (40, 2000, 0), (40, 2000, 1)]
    );
}

#[test]
fn a_stop_purges_what_was_begun() {
    let mut bench = ObedientDrive::new(0);
    bench.words.learn(Table::Holding, 2000, 0);
    let points = [("run", 1.0), ("speed_reference", 50.0)];
    let (mut start, _a) = bench.begin(&points, Urgency::Command);
    let sent = sends(&bench, &mut start);
    assert_eq!(sent, reference(5000));
    start.sent(&sent);
    assert_eq!(start.answered(&sent, Reply::Written, &mut bench.words), None);
    // The run bit is not sent any more; the reference was.
    let cut_short = Outcome::Interrupted(Interruption::Stop);
    assert_eq!(start.purge(), Some(cut_short.clone()));
    // The start is on the wire, and its answer is pending.
    let (mut start, _a) = bench.begin(&points, Urgency::Command);
    let sent = sends(&bench, &mut start);
    start.sent(&sent);
    assert_eq!(start.purge(), Some(cut_short));
    // A read that precedes the write changes nothing in the drive.
    bench.words.forget();
    let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
    let read = sends(&bench, &mut start);
    start.sent(&read);
    assert!(asks(&read) && !start.has_begun());
    assert_eq!(start.purge(), Some(Outcome::Purged));
}

#[test]
fn what_was_begun_and_runs_out_of_time_is_not_told_to_be_unsent() {
    let mut bench = ObedientDrive::new(0);
    bench.words.learn(Table::Holding, 2000, 0);
    let late = bench.now + Duration::from_secs(1);
    for (on_the_wire, outcome) in [
        (false, Outcome::Expired),
        (true, Outcome::Interrupted(Interruption::Expired)),
    ] {
        let (mut start, _a) = bench.begin(&[("run", 1.0), ("speed_reference", 50.0)], Urgency::Command);
        let step = sends(&bench, &mut start);
        if on_the_wire {
            start.sent(&step);
            assert_eq!(start.answered(&step, Reply::Written, &mut bench.words), None);
        }
        assert!(start.is_late(late) && !start.is_late(bench.now));
        assert_eq!(start.next(&bench.words, &bench.profile, false, late), Next::Done);
        assert_eq!(start.success(), outcome);
    }
}

#[test]
fn who_is_abandoned_is_told_whether_it_was_sent() {
    let mut bench = ObedientDrive::new(0);
    bench.words.learn(Table::Holding, 2000, 0);
    for (on_the_wire, outcome) in [
        (false, Outcome::BusDown),
        (true, Outcome::Interrupted(Interruption::BusDown)),
    ] {
        let (mut start, mut answer) = bench.begin(&[("run", 1.0)], Urgency::Command);
        let step = sends(&bench, &mut start);
        if on_the_wire {
            start.sent(&step);
        }
        start.abandon(Outcome::BusDown, Interruption::BusDown, bench.now);
        assert_eq!(answer.try_recv().unwrap().outcome, outcome);
    }
}

#[test]
fn a_command_that_was_held_up_asks_again_for_the_word() {
    let mut bench = ObedientDrive::new(1);
    bench.running = true;
    let (mut reverse, _a) = bench.begin(&[("reverse", 1.0)], Urgency::Command);
    let read = sends(&bench, &mut reverse);
    let reported = Reply::Registers(vec![1]);
    assert_eq!(reverse.answered(&read, reported, &mut bench.words), None);
    looks(&mut bench, &mut reverse);
    assert_eq!(sends(&bench, &mut reverse), word(3));
    assert!(reverse.is_checked(), "nothing goes between");
    reverse.hold_up();
    assert!(reverse.asks_again(), "the motor may have been stopped meanwhile");
    assert!(asks(&sends(&bench, &mut reverse)));
    assert!(!reverse.asks_again(), "once");
}

#[test]
fn a_stop_lets_a_pulse_end() {
    let mut bench = ObedientDrive::new(0);
    bench.words.learn(Table::Holding, 2000, 0);
    let (mut both, _a) = bench.begin(&[("run", 1.0), ("fault_reset", 1.0)], Urgency::Command);
    let high = word(4);
    assert_eq!(sends(&bench, &mut both), high);
    both.sent(&high);
    assert_eq!(both.answered(&high, Reply::Written, &mut bench.words), None);
    assert_eq!(both.purge(), None);
    assert_eq!(bench.run(&mut both), [(20, 2000, 0)], "no run behind the stop");
    assert_eq!(both.success(), Outcome::Interrupted(Interruption::Stop));
}

#[test]
fn exceptions_and_silence_end_it() {
    let bench = ObedientDrive::new(0);
    let mut words = KnownWords::default();
    let (mut command, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
    let sent = reference(100);
    let failed = Exception::DEVICE_FAILURE;
    let refused = command.answered(&sent, Reply::Exception(failed), &mut words);
    assert_eq!(refused, Some(Outcome::Exception(failed)));
    let (mut command, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
    assert_eq!(command.failed(&sent, Outcome::TimedOut, 1), None);
    assert_eq!(command.failed(&sent, Outcome::TimedOut, 1), Some(Outcome::TimedOut));
    // The last attempt determines the outcome; if time runs out in between, the outcome is that of the attempt before.
    let (mut command, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
    assert_eq!(command.failed(&sent, Outcome::TimedOut, 1), None);
    assert_eq!(command.failed(&sent, Outcome::Garbled, 1), Some(Outcome::Garbled));
    let (mut command, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
    assert_eq!(command.failed(&sent, Outcome::Garbled, 1), None);
    let late = bench.now + Duration::from_secs(3600);
    assert_eq!(command.next(&words, &bench.profile, false, late), Next::Done);
    assert_eq!(command.success(), Outcome::Garbled);
}

/// The next step of the command, which must be a request.
fn sends(bench: &ObedientDrive, command: &mut CommandRun) -> Step {
    match command.next(&bench.words, &bench.profile, bench.running, bench.now) {
        Next::Send(step) => step,
        other => panic!("{other:?}"),
    }
}

/// The command reads whether the motor runs, and gets the reply.
fn looks(bench: &mut ObedientDrive, command: &mut CommandRun) {
    let step = sends(bench, command);
    assert_eq!(step.purpose, StepPurpose::Look, "{step:?}");
    let RequestPdu::Read { start, count, .. } = step.pdu else {
        panic!("{step:?}");
    };
    let shown = bench.shows(start, count);
    command.sent(&step);
    assert_eq!(command.answered(&step, shown, &mut bench.words), None);
}

fn execute(pdu: RequestPdu) -> Step {
    let purpose = StepPurpose::Execute;
    Step { purpose, pdu }
}

fn word(value: u16) -> Step {
    execute(RequestPdu::WriteRegister { address: 2000, value })
}

fn reference(value: u16) -> Step {
    execute(RequestPdu::WriteRegister { address: 2002, value })
}

/// Whether the step reads the control word.
fn asks(step: &Step) -> bool {
    let pdu = RequestPdu::Read {
        table: Table::Holding,
        start: 2000,
        count: 1,
    };
    let purpose = StepPurpose::ReadWord;
    *step == Step { purpose, pdu }
}

#[test]
fn a_stop_does_not_depend_on_a_read() {
    let mut bench = ObedientDrive::new(1);
    bench.running = true;
    let refused = Reply::Exception(Exception::BUSY);
    for answer in [Some(refused), None] {
        let (mut stop, _a) = bench.begin(&[("run", 0.0)], Urgency::Stop);
        let read = sends(&bench, &mut stop);
        assert!(asks(&read));
        let ended = match answer {
            Some(reply) => stop.answered(&read, reply, &mut bench.words),
            None => stop.failed(&read, Outcome::TimedOut, 3),
        };
        assert_eq!(ended, None);
        assert_eq!(sends(&bench, &mut stop), word(0));
    }
}

#[test]
fn a_drive_that_keeps_its_word_to_itself_is_commanded_all_the_same() {
    let mut bench = ObedientDrive::new(0);
    let refused = || Reply::Exception(Exception::ADDRESS);
    let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
    let read = sends(&bench, &mut start);
    assert_eq!(start.answered(&read, refused(), &mut bench.words), None);
    assert_eq!(sends(&bench, &mut start), word(1));
    assert!(start.answered(&word(1), Reply::Written, &mut bench.words).is_some());
    assert_eq!(
        bench.words.get(Table::Holding, 2000),
        Some(1),
        "known from the acknowledged write on"
    );
    // A read that is never answered: after the tries.
    let mut bench = ObedientDrive::new(0);
    let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
    assert_eq!(start.failed(&read, Outcome::TimedOut, 1), None);
    assert_eq!(sends(&bench, &mut start), read);
    assert_eq!(start.failed(&read, Outcome::TimedOut, 1), None);
    assert_eq!(sends(&bench, &mut start), word(1));
    // A drive that is only busy is not overruled.
    let (mut start, _a) = bench.begin(&[("run", 1.0)], Urgency::Command);
    let busy = start.answered(&read, Reply::Exception(Exception::BUSY), &mut bench.words);
    assert_eq!(busy, None);
    let next = start.next(&bench.words, &bench.profile, false, bench.now);
    assert!(matches!(next, Next::Wait(at) if at > bench.now), "{next:?}");
    bench.now += Duration::from_millis(100);
    assert_eq!(sends(&bench, &mut start), read, "it is asked again");
}

/// A drive evaluates its control word once per update period: a bit that the previous word cleared and that is set
/// again at once does not count as an edge.
#[test]
fn a_reset_bit_that_a_stop_took_away_is_low_as_long_as_between_two_pulses() {
    for (late, expected) in [(0, 20), (15, 5), (5000, 0)] {
        let mut bench = ObedientDrive::new(5);
        bench.words.learn(Table::Holding, 2000, 5);
        let (mut stop, _a) = bench.begin(&[("run", 0.0)], Urgency::Stop);
        assert_eq!(bench.run(&mut stop), [(0, 2000, 0)]);
        bench.now += Duration::from_millis(late);
        let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
        assert_eq!(bench.run(&mut reset)[0], (expected, 2000, 4), "{late} ms later");
    }
}

/// The drive is too busy for the write of a command, which is repeated: the time of each attempt after the first,
/// and the outcome.
fn busy(points: &[(&str, f64)], urgency: Urgency, times: usize) -> (Vec<u128>, Outcome) {
    let mut bench = ObedientDrive::new(0);
    bench.words.learn(Table::Holding, 2000, 1);
    let (mut run, _a) = bench.begin(points, urgency);
    let (start, mut tries) = (bench.now, Vec::new());
    let busy = || Reply::Exception(Exception::BUSY);
    loop {
        match run.next(&bench.words, &bench.profile, false, bench.now) {
            Next::Wait(until) => bench.now = until,
            Next::Done => return (tries, run.success()),
            Next::Send(step) => {
                run.sent(&step);
                tries.push((bench.now - start).as_millis());
                let reply = if tries.len() > times { Reply::Written } else { busy() };
                if let Some(outcome) = run.answered(&step, reply, &mut bench.words) {
                    return (tries, outcome);
                }
            }
        }
    }
}

#[test]
fn a_drive_that_is_busy_is_written_again_until_the_time_of_the_command_is_over() {
    let acknowledged = Outcome::Acknowledged(Reply::Written);
    // A stop has only the second in which the gateway ends.
    assert_eq!(busy(&[("run", 0.0)], Urgency::Stop, 9).0.last(), Some(&850));
    for (points, urgency, all) in [
        (&[("run", 0.0)], Urgency::Stop, &[0, 50, 150, 250, 350][..]),
        (&[("speed_reference", 1.0)], Urgency::Command, &[0, 50, 150, 350, 750]),
    ] {
        assert_eq!(busy(points, urgency, 2), (vec![0, 50, 150], acknowledged.clone()));
        let (tries, outcome) = busy(points, urgency, usize::MAX);
        assert_eq!(tries[..5], *all);
        assert_eq!(outcome, Outcome::Exception(Exception::BUSY), "it did not take it");
    }
    // An earlier write without an answer may have been taken.
    let mut bench = ObedientDrive::new(0);
    let (mut run, _a) = bench.begin(&[("speed_reference", 1.0)], Urgency::Command);
    let sent = sends(&bench, &mut run);
    run.sent(&sent);
    assert_eq!(run.failed(&sent, Outcome::Unknown(Exception::GATEWAY_TARGET), 1), None);
    assert!(!run.is_owed());
    let busy = Reply::Exception(Exception::BUSY);
    assert_eq!(run.answered(&sent, busy, &mut bench.words), None);
    assert!(!run.is_owed());
    bench.now += Duration::from_secs(1);
    assert_eq!(run.next(&bench.words, &bench.profile, false, bench.now), Next::Done);
    assert_eq!(run.success(), Outcome::Unknown(Exception::GATEWAY_TARGET));
}

#[test]
fn the_end_of_a_pulse_is_tried_again_too_but_not_for_ever() {
    let mut bench = ObedientDrive::new(0);
    bench.words.learn(Table::Holding, 2000, 0);
    let (mut reset, _a) = bench.begin(&[("fault_reset", 1.0)], Urgency::Command);
    let high = sends(&bench, &mut reset);
    reset.sent(&high);
    assert_eq!(reset.answered(&high, Reply::Written, &mut bench.words), None);
    bench.now += Duration::from_secs(2);
    let (began, mut tries) = (bench.now, 0);
    let ended = loop {
        match reset.next(&bench.words, &bench.profile, false, bench.now) {
            Next::Wait(until) => bench.now = until,
            Next::Send(step) => {
                assert_eq!(step, word(0));
                tries += 1;
                let busy = Reply::Exception(Exception::BUSY);
                if let Some(outcome) = reset.answered(&step, busy, &mut bench.words) {
                    break outcome;
                }
            }
            Next::Done => panic!("the bit is set still"),
        }
    };
    assert_eq!(ended, Outcome::Exception(Exception::BUSY));
    assert!(tries > 5 && bench.now - began < Duration::from_secs(5), "{tries}");
}

#[test]
fn an_unknown_word_is_not_guessed_while_the_motor_runs() {
    let mut bench = ObedientDrive::new(1);
    bench.running = true;
    let refused = || Reply::Exception(Exception::ADDRESS);
    for points in [&[("reverse", 1.0)][..], &[("run", 1.0)], &[("fault_reset", 1.0)]] {
        let (mut command, _a) = bench.begin(points, Urgency::Command);
        let read = sends(&bench, &mut command);
        let ended = command.answered(&read, refused(), &mut bench.words);
        assert_eq!(ended, Some(Outcome::Exception(Exception::ADDRESS)), "{points:?}");
    }
    let order = [("run", 1.0), ("reverse", 1.0)];
    // The other bits of the word are used by the application.
    let (mut both, _a) = bench.begin(&order, Urgency::Command);
    let read = sends(&bench, &mut both);
    let ended = both.answered(&read, refused(), &mut bench.words);
    assert_eq!(ended, Some(Outcome::Exception(Exception::ADDRESS)));
    // A family whose control word has no other bits.
    bench.profile = Profiles::built_in().get("eaton-svx").unwrap().clone();
    let (mut both, _a) = bench.begin(&order, Urgency::Command);
    let read = sends(&bench, &mut both);
    assert_eq!(both.answered(&read, refused(), &mut bench.words), None);
    assert_eq!(sends(&bench, &mut both), word(3));
}

#[test]
fn what_cannot_be_sent_is_no_success() {
    let refused = |run: &CommandRun| matches!(run.success(), Outcome::Refused(_));
    // The derived value is written to another point, which the order does not name.
    let mut bench = ObedientDrive::new(0);
    let (mut derived, _a) = bench.begin(&[("run", 1.0), ("frequency_reference", 20.0)], Urgency::Command);
    assert_eq!(bench.run(&mut derived), [], "not a part of it either");
    assert!(refused(&derived), "{:?}", derived.success());
    let (mut large, _a) = bench.begin(&[("speed_reference", 1e9)], Urgency::Command);
    assert_eq!(bench.run(&mut large), []);
    assert!(refused(&large), "{:?}", large.success());
    // The parts of a stop that can be sent are sent.
    let mut bench = ObedientDrive::new(1);
    let (mut stop, _a) = bench.begin(&[("frequency_reference", 0.0), ("run", 0.0)], Urgency::Stop);
    assert_eq!(bench.run(&mut stop), [(0, 2000, 0)]);
    assert!(refused(&stop), "{:?}", stop.success());
}
