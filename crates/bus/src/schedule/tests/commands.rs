//! How commands and polls share the line.

use super::*;
use drivegate_model::drive::DriveIndex;

#[test]
fn eight_commands_then_a_poll() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    rig.log.clear();
    for _ in 0..108 {
        rig.step(Some(Urgency::Command));
    }
    let first = rig.log.iter().take_while(|(_, d)| matches!(d, Decision::Command(_)));
    assert_eq!(first.count(), 8);
    let mut row = 0;
    for (_, decision) in &rig.log {
        row = if matches!(decision, Decision::Command(_)) {
            row + 1
        } else {
            0
        };
        assert!(row <= 8);
    }
    let fast = rig.polls(PollClass::Fast)[&0];
    let slow: usize = rig.polls(PollClass::Slow).values().sum();
    let commands = rig.log.len() - fast - slow;
    assert_eq!(commands - fast, 8, "behind the first eight, each has its half");
}

/// Ten seconds of a line at 38400 baud whose two drives get writes continuously: time of fast polls, slow polls, reads
/// for commands, and commands. `again` is the rank of the command that always waits.
fn flooded(again: Option<Urgency>) -> ([Duration; 4], Duration) {
    let ms = |fraction: f64| Duration::from_secs_f64(fraction / 1e3);
    let (fast, slow, command) = (ms(11.44), ms(7.28), ms(6.76));
    let mut rig = PolledLine::new(2, Duration::from_millis(10));
    rig.run(Duration::from_secs(2));
    let (start, mut taken) = (rig.now, [Duration::ZERO; 4]);
    let (mut drive, mut confirmed, mut longest) = (0, start, Duration::ZERO);
    while rig.now < start + Duration::from_secs(10) {
        match rig.schedule.next(rig.now, again) {
            Decision::Idle(until) => rig.now = until,
            Decision::Command(urgency) => {
                rig.now += command;
                taken[3] += command;
                rig.schedule.command_done(urgency, command);
                drive = 1 - drive;
                rig.schedule.read_soon(
                    DriveIndex::new(drive),
                    |read| read.covers(Table::Holding, 2002),
                    rig.now,
                );
            }
            Decision::Poll(poll) => {
                let took = if poll.read.class == PollClass::Fast { fast } else { slow };
                rig.now += took;
                let kind = match (poll.read.class, rig.schedule.turn) {
                    (PollClass::Fast, _) => 0,
                    (_, PollReason::Asked) => 2,
                    _ => 1,
                };
                taken[kind] += took;
                if kind > 0 && poll.drive == 0 {
                    longest = longest.max(rig.now - confirmed);
                    confirmed = rig.now;
                }
                rig.schedule.poll_done(&poll, Polled::Ok, took, rig.now);
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
    let mut rig = PolledLine::new(10, Duration::from_millis(10));
    rig.run(Duration::from_millis(3210));
    for drive in [3, 4] {
        assert_eq!(
            rig.step(Some(Urgency::Command)),
            Decision::Command(Urgency::Command),
            "to drive {drive}"
        );
        rig.schedule.read_soon(
            DriveIndex::new(drive),
            |read| read.covers(Table::Holding, 2002),
            rig.now,
        );
        let Decision::Poll(poll) = rig.step(None) else {
            panic!("nothing is read");
        };
        assert_eq!((poll.drive.place(), poll.read.start), (drive, 2000));
        rig.run(COST * 2);
    }
}

proptest::proptest! {
    #[test]
    fn a_flood_leaves_polls_half_of_a_saturated_line(
        costs in proptest::collection::vec((1u64..40, 1u64..40, proptest::bool::weighted(0.8)), 200..600),
        drives in 1usize..12,
    ) {
        let mut rig = PolledLine::new(drives, Duration::from_millis(1));
        rig.run(Duration::from_secs(1));
        let (mut commands, mut polls) = (Duration::ZERO, Duration::ZERO);
        for (command, poll, waiting) in costs {
            let rank = waiting.then_some(Urgency::Command);
            let (command, poll_took) = (Duration::from_millis(command), Duration::from_millis(poll));
            match rig.schedule.next(rig.now, rank) {
                Decision::Command(urgency) => {
                    rig.now += command;
                    commands += command;
                    rig.schedule.command_done(urgency, command);
                }
                Decision::Poll(poll) => {
                    rig.now += poll_took;
                    polls += poll_took;
                    rig.schedule.poll_done(&poll, Polled::Ok, poll_took, rig.now);
                }
                Decision::Idle(until) => rig.now = until,
            }
            // A burst of eight and one command on top.
            proptest::prop_assert!(commands <= polls + Duration::from_millis(9 * 40), "{commands:?} {polls:?}");
        }
    }
}

#[test]
fn a_stop_goes_before_the_due_poll_even_after_eight_commands() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    for _ in 0..8 {
        assert_eq!(
            rig.schedule.next(rig.now, Some(Urgency::Command)),
            Decision::Command(Urgency::Command)
        );
        rig.schedule.command_done(Urgency::Command, COST);
        rig.now += COST;
    }
    assert!(matches!(
        rig.schedule.next(rig.now, Some(Urgency::Command)),
        Decision::Poll(_)
    ));
    assert_eq!(
        rig.schedule.next(rig.now, Some(Urgency::Stop)),
        Decision::Command(Urgency::Stop)
    );
}

#[test]
fn what_was_never_read_and_a_flood_of_stops_leave_process_data_its_share() {
    let mut rig = PolledLine::new(60, Duration::from_millis(10));
    while !(0..60).all(|drive| rig.schedule.is_online(DriveIndex::new(drive))) {
        rig.step(None);
    }
    rig.log.clear();
    for _ in 0..160 {
        rig.step(Some(Urgency::Stop));
    }
    let fast: usize = rig.polls(PollClass::Fast).values().sum();
    let others = [PollClass::Slow, PollClass::Once].map(|class| rig.polls(class).values().sum::<usize>());
    assert!(fast >= 35 && others[0] + others[1] >= 30, "{fast} {others:?}");
}

#[test]
fn a_command_does_not_pay_for_all_the_stops_before_it() {
    let mut rig = PolledLine::new(2, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    for _ in 0..400 {
        match rig.schedule.next(rig.now, Some(Urgency::Stop)) {
            Decision::Command(urgency) => {
                rig.now += COST * 3;
                rig.schedule.command_done(urgency, COST * 3);
            }
            _ => {
                rig.step(None);
            }
        }
    }
    rig.log.clear();
    while !matches!(rig.step(Some(Urgency::Command)), Decision::Command(_)) {}
    assert!(rig.log.len() <= 3, "{} polls before it", rig.log.len());
}
