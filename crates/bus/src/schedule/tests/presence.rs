//! Drives that are away, refuse or cannot be understood.

use super::*;
use drivegate_model::drive::DriveIndex;
use drivegate_model::drive::profile::Profiles;

impl PolledLine {
    /// Lets the schedule choose polls for `time`; every poll takes `COST` and is answered by `answer`. Returns the changes.
    fn answer(&mut self, time: Duration, mut answer: impl FnMut(&Poll, Instant) -> Polled) -> Vec<Change> {
        let (end, mut changes) = (self.now + time, Vec::new());
        while self.now < end {
            match self.schedule.next(self.now, None) {
                Decision::Idle(until) => self.now = until,
                Decision::Command(_) => unreachable!(),
                Decision::Poll(poll) => {
                    self.now += COST;
                    let polled = answer(&poll, self.now);
                    changes.push(self.schedule.poll_done(&poll, polled, COST, self.now));
                }
            }
        }
        changes
    }
}

fn refused_if(refused: bool) -> Polled {
    if refused {
        Polled::Refused(Exception::ADDRESS)
    } else {
        Polled::Ok
    }
}

#[test]
fn dead_drives_cost_two_percent_each() {
    let mut all = PolledLine::new(7, Duration::from_millis(10));
    let mut some = PolledLine::new(10, Duration::from_millis(10));
    some.dead = vec![2, 5, 9];
    for rig in [&mut all, &mut some] {
        // The first probes may cost more than the limit.
        rig.run(Duration::from_secs(10));
        rig.log.clear();
        rig.run(Duration::from_secs(60));
    }
    let total = |rig: &PolledLine| rig.polls(PollClass::Fast).values().sum::<usize>() as f64;
    let ratio = total(&some) / total(&all);
    assert!(ratio >= 0.94, "{ratio}");
    assert_eq!(some.offline, [2, 5, 9], "reported once each");
    // The drive returns within ten seconds, and its class `once` is read again.
    some.dead.clear();
    some.log.clear();
    some.run(Duration::from_secs(14));
    for drive in [2, 5, 9] {
        assert!(
            some.polls(PollClass::Fast).contains_key(&drive),
            "{drive} is polled again"
        );
        assert_eq!(some.polls(PollClass::Once)[&drive], 1);
    }
}

#[test]
fn a_drive_that_dies_is_offline_after_the_retries() {
    let mut rig = PolledLine::new(2, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    rig.dead = vec![1];
    let died = rig.now;
    while rig.offline.is_empty() {
        rig.step(None);
    }
    assert!(rig.now - died <= COST * 10 * 2 + COST * 3, "two tries");
    assert!(!rig.schedule.is_online(DriveIndex::new(1)) && rig.schedule.is_online(DriveIndex::new(0)));
}

#[test]
fn a_drive_that_was_silent_for_a_moment_is_back_after_half_a_second() {
    let mut rig = PolledLine::new(2, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    rig.dead = vec![1];
    while rig.offline.is_empty() {
        rig.step(None);
    }
    let away = rig.now;
    rig.dead.clear();
    while !rig.schedule.is_online(DriveIndex::new(1)) {
        rig.step(None);
    }
    assert!(
        rig.now - away <= Duration::from_millis(500) + COST * 3,
        "{:?}",
        rig.now - away
    );
}

#[test]
fn refused_blocks_are_split_joined_and_retried_slowly() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    let bad = 2105;
    let mut asked = Vec::new();
    let changes = rig.answer(Duration::from_secs(30), |poll, _| {
        asked.push((poll.read.start, poll.read.count));
        refused_if(poll.read.covers(Table::Holding, bad))
    });
    let reported = changes.into_iter().filter_map(|change| match change {
        Change::Unavailable(read, _) => Some(read.start),
        _ => None,
    });
    let unavailable: Vec<u16> = reported.collect();
    assert_eq!(unavailable, [bad]);
    let tail: Vec<_> = asked
        .iter()
        .rev()
        .take(20)
        .filter(|(start, _)| *start >= 2100)
        .collect();
    assert!(
        tail.iter().all(|read| **read == (2100, 5) || **read == (2106, 5)),
        "{tail:?}"
    );
    assert!(rig.schedule.is_online(DriveIndex::new(0)));
}

#[test]
fn what_a_starting_drive_refuses_is_there_soon() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    let starts = rig.now;
    let mut asked = Vec::new();
    rig.answer(Duration::from_secs(40), |poll, now| {
        asked.push((now - starts, poll.read.start, poll.read.count));
        refused_if(now - starts < Duration::from_millis(1500))
    });
    let whole = asked
        .iter()
        .find(|(at, start, count)| *at > Duration::from_secs(2) && (*start, *count) == (2100, 11));
    let after = whole.expect("the process data as a whole").0;
    assert!(after < Duration::from_secs(4), "{after:?}");
}

#[test]
fn what_a_drive_never_has_is_asked_ever_more_seldom() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    let starts = rig.now;
    let mut asked = Vec::new();
    rig.answer(Duration::from_secs(200), |poll, now| {
        let refused = poll.read.covers(Table::Holding, 2105);
        if refused && poll.read.count == 1 {
            asked.push((now - starts).as_secs());
        }
        refused_if(refused)
    });
    let pauses: Vec<u64> = asked.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert_eq!(pauses, [2, 4, 8, 16, 32, 60, 60]);
}

#[test]
fn a_request_that_is_never_answered_does_not_take_the_drive_away() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    let mut silent_for = |time: Duration| {
        let mut vain = 0;
        let changes = rig.answer(time, |poll, _| {
            let silent = poll.read.class == PollClass::Once;
            vain += u32::from(silent);
            if silent { Polled::Failed } else { Polled::Ok }
        });
        assert!(!changes.contains(&Change::Offline));
        COST * vain
    };
    let sought = silent_for(Duration::from_secs(30));
    assert!(sought < Duration::from_millis(300), "{sought:?}");
    let known = silent_for(Duration::from_secs(60));
    assert!(known < Duration::from_millis(120), "{known:?} of 60 s");
}

#[test]
fn many_dead_drives_at_start_do_not_keep_the_others_waiting() {
    let mut rig = PolledLine::new(31, Duration::from_millis(10));
    rig.dead = (3..31).collect();
    rig.run(Duration::from_secs(10));
    for drive in 0..3 {
        let mut last = None;
        let mut longest = Duration::ZERO;
        for (at, decision) in &rig.log {
            if matches!(decision, Decision::Poll(p) if p.drive == drive && p.read.class == PollClass::Fast) {
                longest = longest.max(last.map_or(Duration::ZERO, |before| *at - before));
                last = Some(*at);
            }
        }
        // A round, one probe between two fast polls, and first reads.
        assert!(longest < Duration::from_millis(700), "drive {drive}: {longest:?}");
    }
    assert_eq!(rig.offline.len(), 28);
}

#[test]
fn a_block_refused_once_by_mistake_is_whole_again_after_a_minute() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    let mut refuse = 1;
    let mut asked = Vec::new();
    rig.answer(Duration::from_secs(70), |poll, _| {
        if poll.read.class == PollClass::Fast {
            asked.push((poll.read.start, poll.read.count));
        }
        let refused = poll.read.count == 11 && refuse > 0;
        refuse -= i32::from(refused);
        refused_if(refused)
    });
    assert!(asked.contains(&(2100, 5)) && asked.contains(&(2105, 6)));
    assert!(asked[asked.len() - 100..].iter().all(|read| *read == (2100, 11)));
}

#[test]
fn a_bad_point_that_is_sound_again_is_read_with_its_neighbours() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    let healed = rig.now + Duration::from_secs(30);
    let mut asked = Vec::new();
    rig.answer(Duration::from_secs(200), |poll, now| {
        if poll.read.class == PollClass::Fast {
            asked.push((poll.read.start, poll.read.count));
        }
        refused_if(now < healed && poll.read.covers(Table::Holding, 2105))
    });
    assert!(
        asked[asked.len() - 100..].iter().all(|read| *read == (2100, 11)),
        "{:?}",
        &asked[asked.len() - 20..]
    );
}

#[test]
fn garbled_answers_do_not_take_a_drive_away_at_once_but_at_last() {
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    let mut garbled = 0;
    loop {
        let Decision::Poll(poll) = rig.schedule.next(rig.now, None) else {
            rig.now += Duration::from_millis(1);
            continue;
        };
        rig.now += COST;
        garbled += 1;
        if rig.schedule.poll_done(&poll, Polled::Garbled, COST, rig.now) == Change::Offline {
            break;
        }
        assert!(garbled < 100);
    }
    assert!((8..=12).contains(&garbled), "{garbled}");
}

#[test]
fn a_drive_that_answers_a_command_is_probed_at_once() {
    let mut rig = PolledLine::new(2, Duration::from_millis(10));
    rig.dead = vec![1];
    rig.run(Duration::from_secs(30));
    rig.dead.clear();
    rig.log.clear();
    rig.schedule.seen(DriveIndex::new(1), rig.now);
    let answered = rig.now;
    rig.run(COST * 3);
    assert!(rig.schedule.is_online(DriveIndex::new(1)));
    let probe = |d: &Decision| matches!(d, Decision::Poll(poll) if poll.drive == 1 && poll.probe);
    let probed = rig.log.iter().find(|(_, d)| probe(d)).map(|(at, _)| *at - answered);
    assert!(probed.is_some_and(|after| after <= COST), "{probed:?}");
}

#[test]
fn a_command_in_vain_is_as_good_as_a_probe() {
    let probed_after = |in_vain: bool| {
        let mut rig = PolledLine::new(2, Duration::from_millis(10));
        rig.run(Duration::from_secs(1));
        rig.dead = vec![1];
        while rig.offline.is_empty() {
            rig.step(None);
        }
        rig.log.clear();
        rig.now += Duration::from_millis(400);
        let from = rig.now;
        if in_vain {
            rig.schedule.probed_in_vain(DriveIndex::new(1), COST * 10, rig.now);
        }
        rig.run(Duration::from_secs(15));
        let probe = |d: &Decision| matches!(d, Decision::Poll(poll) if poll.drive == 1);
        rig.log.iter().find(|(_, d)| probe(d)).map(|(at, _)| *at - from)
    };
    assert!(probed_after(false).unwrap() < Duration::from_millis(150));
    let after = probed_after(true).unwrap();
    assert!((COST * 10..COST * 15).contains(&after), "{after:?}");
    // A failed command does not make an answering drive offline.
    let mut rig = PolledLine::new(1, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    rig.schedule.probed_in_vain(DriveIndex::new(0), COST * 10, rig.now);
    assert!(rig.schedule.is_online(DriveIndex::new(0)));
}

/// Times after the first failure at which a drive that stays away is probed, each probe taking `took`.
fn probes(drive: &mut DriveSchedule, away: Instant, took: Duration, until: Duration) -> Vec<Duration> {
    let (mut now, mut times) = (away, Vec::new());
    while now < away + until {
        drive.probe_failed(now, took);
        let Presence::Away(at, _) = drive.presence else {
            panic!("it is there")
        };
        assert!(
            at >= now + took.min(Duration::from_secs(5)),
            "others have the line meanwhile"
        );
        times.push(at - away);
        now = at + took;
    }
    times
}

#[test]
fn the_first_probes_come_at_half_a_second_one_and_two_whatever_they_cost() {
    let (ms, now) = (Duration::from_millis, Instant::now());
    for took in [ms(10), ms(110), ms(240)] {
        let mut drive = DriveSchedule::new(Vec::new(), &Plan::default(), 1, now);
        let times = probes(&mut drive, now, took, Duration::from_secs(120));
        assert_eq!(times[..3], [ms(500), ms(1_000), ms(2_000)], "{took:?}");
        let later: Vec<Duration> = times[2..].windows(2).map(|pair| pair[1] - pair[0]).collect();
        let affordable = took.mul_f64(50.0).min(Duration::from_secs(10));
        assert!(later.iter().all(|pause| *pause >= affordable), "{later:?}");
        assert!(
            later.iter().all(|pause| *pause <= Duration::from_secs(10) + took),
            "{later:?}"
        );
    }
}

#[test]
fn a_drive_that_comes_and_goes_has_no_more_early_probes_than_it_saved_up() {
    let (ms, took) = (Duration::from_millis, Duration::from_millis(110));
    let mut now = Instant::now();
    let mut drive = DriveSchedule::new(Vec::new(), &Plan::default(), 1, now);
    let mut early = Vec::new();
    for _ in 0..20 {
        drive.presence = Presence::Online;
        drive.early.answers_again(now);
        now += ms(500);
        let times = probes(&mut drive, now, took, ms(2_500));
        early.push(times.iter().filter(|time| **time <= ms(2_000)).count());
        now += ms(3_000);
    }
    assert_eq!(early[0], 3);
    assert!(early[10..].iter().sum::<usize>() <= 12, "{early:?}");
    drive.presence = Presence::Online;
    drive.early.answers_again(now);
    let times = probes(&mut drive, now + Duration::from_secs(30), took, ms(2_500));
    assert_eq!(times[..3], [ms(500), ms(1_000), ms(2_000)], "saved up again");
}

#[test]
fn what_a_bad_line_swallowed_is_due_once_process_data_was_sound_for_a_while() {
    let (second, now) = (Duration::from_secs(1), Instant::now());
    let read = read(PollClass::Slow, 2000, 3);
    let put_off = Item {
        failures: 8,
        failed_at: Some(now),
        due: now + 60 * second,
        ..Item::new(read, read, COST, now)
    };
    let mut drive = DriveSchedule::new(vec![put_off.clone()], &Plan::default(), 1, now);
    assert_eq!(drive.due(&put_off), now + 60 * second, "the drive is mute to it");
    drive.troubled = Some(now + 3 * second);
    assert_eq!(drive.due(&put_off), now + 13 * second);
    drive.troubled = Some(now - 11 * second);
    assert_eq!(drive.due(&put_off), now + 60 * second, "the line was sound by then");
    let answered = Item { failures: 0, ..put_off };
    drive.troubled = Some(now);
    assert_eq!(drive.due(&answered), now + 60 * second);
}

/// Every family that reads bits of the status word with the slow points: the word is complete before any other slow
/// read, except those that commands need.
#[test]
fn the_bits_of_the_status_word_come_before_other_slow_reads() {
    let mut families = 0;
    for profile in Profiles::built_in().iter() {
        let plan = Plan::of(profile);
        if plan.behind_status_word.is_empty() {
            continue;
        }
        families += 1;
        let mut rig = PolledLine::of(&[&plan, &plan, &plan], Duration::from_millis(10));
        rig.run(Duration::from_secs(20));
        for drive in 0..3 {
            let slow = rig.log.iter().filter_map(|(_, decision)| match decision {
                Decision::Poll(poll) if poll.drive.place() == drive && !poll.probe => Some(poll.read),
                _ => None,
            });
            let slow: Vec<PlannedRead> = slow.filter(|read| read.class == PollClass::Slow).collect();
            let (first, others) = slow.split_at(plan.behind_status_word.len());
            let bits = |read: &PlannedRead| plan.behind_status_word.contains(read);
            assert!(first.iter().all(bits), "{}: {first:?}", profile.name);
            assert!(others.iter().any(bits), "{}: they are read again", profile.name);
        }
    }
    assert!(families > 2, "{families}");
}

#[test]
fn absent_drives_whose_probes_were_postponed_together_take_turns() {
    let mut rig = PolledLine::new(3, Duration::from_millis(10));
    let mut probed = Vec::new();
    for _ in 0..6 {
        let mut seen = None;
        // The line is free for one probe, then none may be sent for a while.
        while let Decision::Poll(poll) = rig.schedule.next(rig.now, None) {
            assert!(poll.probe);
            if seen.is_none() {
                rig.schedule.probe_sent(poll.drive);
                seen = Some(poll.drive.place());
            }
            rig.schedule.postpone(&poll, rig.now + COST);
        }
        probed.extend(seen);
        rig.now += COST;
    }
    let count = |drive| probed.iter().filter(|probed| **probed == drive).count();
    assert!([0, 1, 2].map(count).iter().all(|probes| *probes > 0), "{probed:?}");
}
