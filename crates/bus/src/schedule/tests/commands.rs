//! Commands and polls share the line.

use super::*;
use crate::drive::DriveIndex;

#[test]
fn eight_commands_then_a_poll() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    bench.log.clear();
    for _ in 0..108 {
        bench.step(Some(Urgency::Command));
    }
    let first = bench.log.iter().take_while(|(_, d)| matches!(d, Decision::Command(_)));
    assert_eq!(first.count(), 8);
    let mut row = 0;
    for (_, decision) in &bench.log {
        row = if matches!(decision, Decision::Command(_)) {
            row + 1
        } else {
            0
        };
        assert!(row <= 8);
    }
    let fast = bench.polls(PollClass::Fast)[&0];
    let slow: usize = bench.polls(PollClass::Slow).values().sum();
    let commands = bench.log.len() - fast - slow;
    assert_eq!(commands - fast, 8, "behind the first eight, each has its half");
}

/// Ten seconds of a line at 38400 baud whose two drives are written to as often as they will: time of fast polls, slow
/// polls, reads that the commands asked for, and commands. `again` is the rank of the command that waits all the time.
fn flooded(again: Option<Urgency>) -> ([Duration; 4], Duration) {
    let ms = |fraction: f64| Duration::from_secs_f64(fraction / 1e3);
    let (fast, slow, command) = (ms(11.44), ms(7.28), ms(6.76));
    let mut bench = Bench::new(2, Duration::from_millis(10));
    bench.run(Duration::from_secs(2));
    let (start, mut taken) = (bench.now, [Duration::ZERO; 4]);
    let (mut drive, mut confirmed, mut longest) = (0, start, Duration::ZERO);
    while bench.now < start + Duration::from_secs(10) {
        match bench.schedule.next(bench.now, again) {
            Decision::Idle(until) => bench.now = until,
            Decision::Command(urgency) => {
                bench.now += command;
                taken[3] += command;
                bench.schedule.command_done(urgency, command);
                drive = 1 - drive;
                bench.schedule.refresh(
                    DriveIndex::new(drive),
                    |read| read.covers(Table::Holding, 2002),
                    bench.now,
                );
            }
            Decision::Poll(poll) => {
                let took = if poll.read.class == PollClass::Fast { fast } else { slow };
                bench.now += took;
                let kind = match (poll.read.class, bench.schedule.turn) {
                    (PollClass::Fast, _) => 0,
                    (_, Turn::Asked) => 2,
                    _ => 1,
                };
                taken[kind] += took;
                if kind > 0 && poll.drive == 0 {
                    longest = longest.max(bench.now - confirmed);
                    confirmed = bench.now;
                }
                bench.schedule.poll_done(&poll, Polled::Ok, took, bench.now);
            }
        }
    }
    (taken, longest)
}

#[test]
fn what_confirms_a_flood_is_paid_by_the_flood() {
    let (quiet, _) = flooded(None);
    for again in [Urgency::Command, Urgency::Read, Urgency::Stop] {
        let (taken, longest) = flooded(Some(again));
        let ratio = taken[0].as_secs_f64() / quiet[0].as_secs_f64();
        assert!(ratio >= 0.49, "{again:?}: fast polls keep {ratio}, {taken:?}");
        assert!(
            taken[2] + taken[3] > Duration::from_millis(4500),
            "{again:?}: the flood has its half, {taken:?}"
        );
        assert!(
            longest < Duration::from_secs(1),
            "{again:?}: read back after {longest:?}"
        );
    }
}

#[test]
fn a_single_command_is_confirmed_before_the_round_goes_on() {
    let mut bench = Bench::new(10, Duration::from_millis(10));
    bench.run(Duration::from_millis(3210));
    for drive in [3, 4] {
        assert_eq!(
            bench.step(Some(Urgency::Command)),
            Decision::Command(Urgency::Command),
            "to drive {drive}"
        );
        bench.schedule.refresh(
            DriveIndex::new(drive),
            |read| read.covers(Table::Holding, 2002),
            bench.now,
        );
        let Decision::Poll(poll) = bench.step(None) else {
            panic!("nothing is read");
        };
        assert_eq!((poll.drive.place(), poll.read.start), (drive, 2000));
        bench.run(COST * 2);
    }
}

proptest::proptest! {
    #[test]
    fn a_flood_leaves_polls_half_of_a_saturated_line(
        costs in proptest::collection::vec((1u64..40, 1u64..40, proptest::bool::weighted(0.8)), 200..600),
        drives in 1usize..12,
    ) {
        let mut bench = Bench::new(drives, Duration::from_millis(1));
        bench.run(Duration::from_secs(1));
        let (mut commands, mut polls) = (Duration::ZERO, Duration::ZERO);
        for (command, poll, waiting) in costs {
            let rank = waiting.then_some(Urgency::Command);
            let (command, poll_took) = (Duration::from_millis(command), Duration::from_millis(poll));
            match bench.schedule.next(bench.now, rank) {
                Decision::Command(urgency) => {
                    bench.now += command;
                    commands += command;
                    bench.schedule.command_done(urgency, command);
                }
                Decision::Poll(poll) => {
                    bench.now += poll_took;
                    polls += poll_took;
                    bench.schedule.poll_done(&poll, Polled::Ok, poll_took, bench.now);
                }
                Decision::Idle(until) => bench.now = until,
            }
            // A burst of eight and one command on top.
            proptest::prop_assert!(commands <= polls + Duration::from_millis(9 * 40), "{commands:?} {polls:?}");
        }
    }
}

#[test]
fn a_stop_goes_before_the_due_poll_even_after_eight_commands() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    for _ in 0..8 {
        assert_eq!(
            bench.schedule.next(bench.now, Some(Urgency::Command)),
            Decision::Command(Urgency::Command)
        );
        bench.schedule.command_done(Urgency::Command, COST);
        bench.now += COST;
    }
    assert!(matches!(
        bench.schedule.next(bench.now, Some(Urgency::Command)),
        Decision::Poll(_)
    ));
    assert_eq!(
        bench.schedule.next(bench.now, Some(Urgency::Stop)),
        Decision::Command(Urgency::Stop)
    );
}

#[test]
fn what_was_never_read_and_a_flood_of_stops_leave_process_data_its_share() {
    let mut bench = Bench::new(60, Duration::from_millis(10));
    while !(0..60).all(|drive| bench.schedule.is_online(DriveIndex::new(drive))) {
        bench.step(None);
    }
    bench.log.clear();
    for _ in 0..160 {
        bench.step(Some(Urgency::Stop));
    }
    let fast: usize = bench.polls(PollClass::Fast).values().sum();
    let others = [PollClass::Slow, PollClass::Once].map(|class| bench.polls(class).values().sum::<usize>());
    assert!(fast >= 35 && others[0] + others[1] >= 30, "{fast} {others:?}");
}

#[test]
fn a_command_does_not_pay_for_all_the_stops_before_it() {
    let mut bench = Bench::new(2, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    for _ in 0..400 {
        match bench.schedule.next(bench.now, Some(Urgency::Stop)) {
            Decision::Command(urgency) => {
                bench.now += COST * 3;
                bench.schedule.command_done(urgency, COST * 3);
            }
            _ => {
                bench.step(None);
            }
        }
    }
    bench.log.clear();
    while !matches!(bench.step(Some(Urgency::Command)), Decision::Command(_)) {}
    assert!(bench.log.len() <= 3, "{} polls before it", bench.log.len());
}
