use std::collections::BTreeMap;

use super::*;
use crate::codec::Table;

const COST: Duration = Duration::from_millis(12);

fn read(class: PollClass, start: u16, count: u16) -> PlannedRead {
    PlannedRead {
        class,
        table: Table::Holding,
        start,
        count,
        wide: 0,
    }
}

fn plan() -> Plan {
    let reads = vec![
        read(PollClass::Fast, 2100, 11),
        read(PollClass::Slow, 2000, 3),
        read(PollClass::Once, 100, 4),
    ];
    Plan { reads }
}

/// A line in virtual time: every exchange takes `COST`, a dead drive ten times that.
struct Bench {
    schedule: Schedule,
    now: Instant,
    dead: Vec<usize>,
    log: Vec<(Instant, Decision)>,
    offline: Vec<usize>,
}

impl Bench {
    fn new(drives: usize, cycle: Duration) -> Bench {
        let plan = plan();
        let plans: Vec<&Plan> = (0..drives).map(|_| &plan).collect();
        let now = Instant::now();
        let cadence = Cadence {
            fast: cycle,
            slow: Duration::from_secs(1),
            retries: 1,
        };
        let schedule = Schedule::new(cadence, &plans, |_, _| COST, now);
        Bench {
            schedule,
            now,
            dead: Vec::new(),
            log: Vec::new(),
            offline: Vec::new(),
        }
    }

    fn step(&mut self, waiting: Option<Urgency>) -> Decision {
        let decision = self.schedule.next(self.now, waiting);
        self.log.push((self.now, decision));
        match decision {
            Decision::Idle(until) => {
                assert!(until > self.now, "idle into the past");
                self.now = until;
            }
            Decision::Command(urgency) => {
                self.now += COST;
                self.schedule.command_done(urgency, COST);
            }
            Decision::Poll(poll) => {
                let dead = self.dead.contains(&poll.drive);
                let took = if dead { COST * 10 } else { COST };
                self.now += took;
                let polled = if dead { Polled::Failed } else { Polled::Ok };
                if self.schedule.poll_done(&poll, polled, took, self.now) == Change::Offline {
                    self.offline.push(poll.drive);
                }
            }
        }
        decision
    }

    fn run(&mut self, time: Duration) {
        let end = self.now + time;
        while self.now < end {
            self.step(None);
        }
    }

    fn polls(&self, class: PollClass) -> BTreeMap<usize, usize> {
        let mut counts = BTreeMap::new();
        for (_, decision) in &self.log {
            if let Decision::Poll(poll) = decision
                && poll.read.class == class
                && !poll.probe
            {
                *counts.entry(poll.drive).or_default() += 1;
            }
        }
        counts
    }
}

#[test]
fn a_saturated_line_is_never_idle_and_fair() {
    let mut bench = Bench::new(10, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    bench.log.clear();
    bench.run(Duration::from_secs(20));
    assert!(bench.log.iter().all(|(_, d)| !matches!(d, Decision::Idle(_))));
    let fast = bench.polls(PollClass::Fast);
    let (least, most) = (fast.values().min().unwrap(), fast.values().max().unwrap());
    assert!(most - least <= 1, "{fast:?}");
    // Ten slow polls a second would be 12 %; they get 5 %.
    let slow: usize = bench.polls(PollClass::Slow).values().sum();
    let share = slow as f64 * COST.as_secs_f64() / 20.0;
    assert!((0.045..0.07).contains(&share), "{share}");
}

#[test]
fn slow_polls_get_their_share_where_the_idle_time_fits_none() {
    // Two fast polls take 24 of 30 ms: no slow one fits behind them. They would take 2.4 % of the line, which has room.
    let mut bench = Bench::new(2, Duration::from_millis(30));
    bench.run(Duration::from_secs(5));
    bench.log.clear();
    bench.run(Duration::from_secs(60));
    let (slow, fast) = (bench.polls(PollClass::Slow), bench.polls(PollClass::Fast));
    assert!(slow.values().all(|n| (59..=61).contains(n)), "{slow:?}");
    assert!(fast.values().all(|n| (1990..=2001).contains(n)), "{fast:?}");
}

#[test]
fn slow_polls_that_fit_into_idle_time_delay_no_round() {
    // Six slow polls are due at once each second; two of them fit behind the six fast ones of a round.
    let mut bench = Bench::new(6, Duration::from_millis(100));
    bench.run(Duration::from_secs(5));
    let begin = bench.now;
    bench.log.clear();
    bench.run(Duration::from_secs(60));
    let first = |d: &Decision| matches!(d, Decision::Poll(p) if p.read.class == PollClass::Fast && p.drive == 0);
    let rounds: Vec<Instant> = bench.log.iter().filter(|(_, d)| first(d)).map(|(at, _)| *at).collect();
    let cycles: Vec<Duration> = rounds.windows(2).map(|w| w[1] - w[0]).collect();
    assert!(cycles.iter().all(|c| *c == Duration::from_millis(100)), "{cycles:?}");
    assert!(
        bench.polls(PollClass::Slow).values().all(|n| *n >= 59),
        "{:?}",
        bench.now - begin
    );
}

#[test]
fn the_grid_is_kept_without_drift() {
    let mut bench = Bench::new(1, Duration::from_millis(30));
    bench.run(Duration::from_secs(30));
    let fast: Vec<Instant> = bench
        .log
        .iter()
        .filter(|(_, d)| matches!(d, Decision::Poll(p) if p.read.class == PollClass::Fast && !p.probe))
        .map(|(at, _)| *at)
        .collect();
    assert!((999..=1001).contains(&fast.len()), "{}", fast.len());
    let grid = fast.iter().skip(1).filter(|at| {
        let off = (**at - fast[0]).as_micros() % 30_000;
        !(1000..=29_000).contains(&off)
    });
    assert!(grid.count() >= fast.len() - 2, "slow polls fit into the idle time");
}

#[test]
fn a_stall_does_not_move_the_grid() {
    let cycle = Duration::from_millis(30);
    let mut bench = Bench::new(1, cycle);
    bench.run(Duration::from_secs(2));
    let start = bench.schedule.round_due;
    for stall in [7, 31, 95, 1000, 12_345] {
        bench.now += Duration::from_millis(stall);
        bench.log.clear();
        bench.run(cycle * 20);
        let fast: Vec<Instant> = bench
            .log
            .iter()
            .filter(|(_, d)| matches!(d, Decision::Poll(p) if p.read.class == PollClass::Fast))
            .map(|(at, _)| *at)
            .collect();
        assert!(fast.len() <= 22, "no catching up after {stall} ms: {}", fast.len());
        let late = (fast[fast.len() - 1] - start).as_micros() % cycle.as_micros();
        assert_eq!(late, 0, "back on the grid after {stall} ms");
    }
}

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
                bench
                    .schedule
                    .refresh(drive, |read| read.covers(Table::Holding, 2002), bench.now);
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
        bench
            .schedule
            .refresh(drive, |read| read.covers(Table::Holding, 2002), bench.now);
        let Decision::Poll(poll) = bench.step(None) else {
            panic!("nothing is read");
        };
        assert_eq!((poll.drive, poll.read.start), (drive, 2000));
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
fn dead_drives_cost_two_percent_each() {
    let mut all = Bench::new(7, Duration::from_millis(10));
    all.run(Duration::from_secs(60));
    let mut some = Bench::new(10, Duration::from_millis(10));
    some.dead = vec![2, 5, 9];
    some.run(Duration::from_secs(60));
    let total = |bench: &Bench| bench.polls(PollClass::Fast).values().sum::<usize>() as f64;
    let ratio = total(&some) / total(&all);
    assert!(ratio >= 0.94, "{ratio}");
    assert_eq!(some.offline, [2, 5, 9], "told once each");
    // It comes back within ten seconds, and its once class is read again.
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
    let mut bench = Bench::new(2, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    bench.dead = vec![1];
    let died = bench.now;
    while bench.offline.is_empty() {
        bench.step(None);
    }
    assert!(bench.now - died <= COST * 10 * 2 + COST * 3, "two tries");
    assert!(!bench.schedule.is_online(1) && bench.schedule.is_online(0));
}

#[test]
fn refused_blocks_are_split_joined_and_retried_slowly() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    let bad = 2105;
    let mut unavailable = Vec::new();
    let mut asked = Vec::new();
    let end = bench.now + Duration::from_secs(30);
    while bench.now < end {
        match bench.schedule.next(bench.now, None) {
            Decision::Idle(until) => bench.now = until,
            Decision::Command(_) => unreachable!(),
            Decision::Poll(poll) => {
                bench.now += COST;
                let refused = poll.read.covers(Table::Holding, bad);
                let polled = if refused {
                    Polled::Refused(Exception::ADDRESS)
                } else {
                    Polled::Ok
                };
                asked.push((poll.read.start, poll.read.count));
                if let Change::Unavailable(read, _) = bench.schedule.poll_done(&poll, polled, COST, bench.now) {
                    unavailable.push(read.start);
                }
            }
        }
    }
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
    assert!(bench.schedule.is_online(0));
}

#[test]
fn a_request_that_is_never_answered_does_not_take_the_drive_away() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    let mut mute = 0;
    let end = bench.now + Duration::from_secs(30);
    while bench.now < end {
        match bench.schedule.next(bench.now, None) {
            Decision::Idle(until) => bench.now = until,
            Decision::Command(_) => unreachable!(),
            Decision::Poll(poll) => {
                bench.now += COST;
                let silent = poll.read.class == PollClass::Once;
                mute += usize::from(silent);
                let polled = if silent { Polled::Failed } else { Polled::Ok };
                assert_ne!(
                    bench.schedule.poll_done(&poll, polled, COST, bench.now),
                    Change::Offline
                );
            }
        }
    }
    assert_eq!(mute, 5, "first try and one retry, then after 2, 4, 8 s");
}

#[test]
fn a_dear_slow_poll_gets_its_turn_on_a_saturated_slow_line() {
    // At 300 baud a read of 11 registers takes 1.4 s.
    let cost = Duration::from_millis(1400);
    let plan = plan();
    let now = Instant::now();
    let cadence = Cadence {
        fast: Duration::from_millis(10),
        slow: Duration::from_secs(1),
        retries: 1,
    };
    let mut schedule = Schedule::new(cadence, &[&plan, &plan], |_, _| cost, now);
    let (mut at, mut slow) = (now, 0);
    while at < now + Duration::from_secs(300) {
        match schedule.next(at, None) {
            Decision::Idle(until) => at = until,
            Decision::Command(_) => unreachable!(),
            Decision::Poll(poll) => {
                at += cost;
                slow += usize::from(poll.read.class == PollClass::Slow);
                schedule.poll_done(&poll, Polled::Ok, cost, at);
            }
        }
    }
    // They ask for nearly three lines and get a third of one.
    assert!((65..=75).contains(&slow), "{slow} slow polls in 300 s");
}

#[test]
fn many_dead_drives_at_start_do_not_keep_the_others_waiting() {
    let mut bench = Bench::new(31, Duration::from_millis(10));
    bench.dead = (3..31).collect();
    bench.run(Duration::from_secs(10));
    for drive in 0..3 {
        let mut last = None;
        let mut longest = Duration::ZERO;
        for (at, decision) in &bench.log {
            if matches!(decision, Decision::Poll(p) if p.drive == drive && p.read.class == PollClass::Fast) {
                longest = longest.max(last.map_or(Duration::ZERO, |before| *at - before));
                last = Some(*at);
            }
        }
        // A round, one probe between two fast polls, and first reads.
        assert!(longest < Duration::from_millis(700), "drive {drive}: {longest:?}");
    }
    assert_eq!(bench.offline.len(), 28);
}

#[test]
fn a_block_refused_once_by_mistake_is_whole_again_after_a_minute() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    let mut refuse = 1;
    let mut asked = Vec::new();
    let end = bench.now + Duration::from_secs(70);
    while bench.now < end {
        match bench.schedule.next(bench.now, None) {
            Decision::Idle(until) => bench.now = until,
            Decision::Command(_) => unreachable!(),
            Decision::Poll(poll) => {
                bench.now += COST;
                let polled = if poll.read.count == 11 && refuse > 0 {
                    refuse -= 1;
                    Polled::Refused(Exception::ADDRESS)
                } else {
                    Polled::Ok
                };
                if poll.read.class == PollClass::Fast {
                    asked.push((poll.read.start, poll.read.count));
                }
                bench.schedule.poll_done(&poll, polled, COST, bench.now);
            }
        }
    }
    assert!(asked.contains(&(2100, 5)) && asked.contains(&(2105, 6)));
    assert!(asked[asked.len() - 100..].iter().all(|read| *read == (2100, 11)));
}

#[test]
fn a_bad_point_that_is_sound_again_is_read_with_its_neighbours() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    let healed = bench.now + Duration::from_secs(30);
    let end = bench.now + Duration::from_secs(200);
    let mut asked = Vec::new();
    while bench.now < end {
        match bench.schedule.next(bench.now, None) {
            Decision::Idle(until) => bench.now = until,
            Decision::Command(_) => unreachable!(),
            Decision::Poll(poll) => {
                bench.now += COST;
                let bad = bench.now < healed && poll.read.covers(Table::Holding, 2105);
                let polled = if bad {
                    Polled::Refused(Exception::ADDRESS)
                } else {
                    Polled::Ok
                };
                if poll.read.class == PollClass::Fast {
                    asked.push((poll.read.start, poll.read.count));
                }
                bench.schedule.poll_done(&poll, polled, COST, bench.now);
            }
        }
    }
    assert!(
        asked[asked.len() - 100..].iter().all(|read| *read == (2100, 11)),
        "{:?}",
        &asked[asked.len() - 20..]
    );
}

#[test]
fn garbled_answers_do_not_take_a_drive_away_at_once_but_at_last() {
    let mut bench = Bench::new(1, Duration::from_millis(10));
    bench.run(Duration::from_secs(1));
    let mut garbled = 0;
    loop {
        let Decision::Poll(poll) = bench.schedule.next(bench.now, None) else {
            bench.now += Duration::from_millis(1);
            continue;
        };
        bench.now += COST;
        garbled += 1;
        if bench.schedule.poll_done(&poll, Polled::Garbled, COST, bench.now) == Change::Offline {
            break;
        }
        assert!(garbled < 100);
    }
    assert!((8..=12).contains(&garbled), "{garbled}");
}

mod chance {
    use proptest::prelude::*;

    use super::*;

    /// A bus with its drives, what its exchanges cost, who is dead, and how hard it is commanded.
    #[derive(Debug, Clone)]
    struct Case {
        plans: Vec<Vec<(u8, u16)>>,
        cost_ms: u64,
        cycle_ms: u64,
        dead: Vec<bool>,
        /// A command arrives so often; `None` never.
        every_ms: Option<u64>,
        seed: u64,
    }

    fn case() -> impl Strategy<Value = Case> {
        let reads = proptest::collection::vec((0u8..3, 1u16..12), 1..5);
        (
            proptest::collection::vec((reads, any::<bool>(), 0u8..4), 1..12),
            2u64..40,
            5u64..500,
            proptest::option::of(1u64..80),
            any::<u64>(),
        )
            .prop_map(|(drives, cost_ms, cycle_ms, every_ms, seed)| Case {
                // One in four is dead.
                dead: drives.iter().map(|(_, flag, dice)| *flag && *dice < 2).collect(),
                plans: drives.into_iter().map(|(reads, _, _)| reads).collect(),
                cost_ms,
                cycle_ms,
                every_ms,
                seed,
            })
    }

    fn plan_of(reads: &[(u8, u16)]) -> Plan {
        let mut at = 0;
        let class = |n: u8| [PollClass::Fast, PollClass::Slow, PollClass::Once][usize::from(n)];
        let mut reads: Vec<PlannedRead> = reads
            .iter()
            .map(|(n, count)| {
                at += 50;
                read(class(*n), at, *count)
            })
            .collect();
        // As the planner puts them: the fast ones first. Each drive has one.
        reads.push(read(PollClass::Fast, 0, 11));
        reads.sort();
        Plan { reads }
    }

    const DEADLINE: Duration = Duration::from_millis(110);
    const SLOW: Duration = Duration::from_secs(1);

    /// What was seen in a minute behind a start of fifteen seconds, in which the dead are found dead.
    #[derive(Default)]
    struct Seen {
        fast_counts: BTreeMap<(usize, u16), usize>,
        longest: BTreeMap<(usize, u16), Duration>,
        slow_longest: BTreeMap<(usize, u16), Duration>,
        dead_time: BTreeMap<usize, Duration>,
        slow_time: Duration,
        stop_waited: u32,
        elapsed: Duration,
    }

    fn simulate(case: &Case) -> Result<Seen, TestCaseError> {
        let plans: Vec<Plan> = case.plans.iter().map(|reads| plan_of(reads)).collect();
        let plan_refs: Vec<&Plan> = plans.iter().collect();
        let cost = |read: &PlannedRead| {
            Duration::from_millis(case.cost_ms) + Duration::from_micros(300) * u32::from(read.count)
        };
        let cadence = Cadence {
            fast: Duration::from_millis(case.cycle_ms),
            slow: SLOW,
            retries: 1,
        };
        let start = Instant::now();
        let mut schedule = Schedule::new(cadence, &plan_refs, |_, read| cost(read), start);
        let (settled, end) = (start + Duration::from_secs(15), start + Duration::from_secs(75));
        let mut seen = Seen::default();
        let mut last: BTreeMap<(usize, PlannedRead), Instant> = BTreeMap::new();
        let (mut now, mut next_command, mut dice) = (start, start, case.seed | 1);
        let mut waiting: std::collections::VecDeque<Urgency> = std::collections::VecDeque::new();
        let mut passed = 0;
        let (mut row, mut stops) = (0, 0);
        while now < end {
            if let Some(every) = case.every_ms {
                while next_command <= now {
                    dice = dice
                        .wrapping_mul(6_364_136_223_846_793_005)
                        .wrapping_add(1_442_695_040_888_963_407);
                    let urgency = match (dice >> 33) % 20 {
                        0 => Urgency::Stop,
                        1..=14 => Urgency::Command,
                        _ => Urgency::Read,
                    };
                    // The queue is bounded.
                    if waiting.len() < 64 {
                        waiting.push_back(urgency);
                    }
                    next_command += Duration::from_millis(every);
                }
            }
            let best = waiting.iter().min().copied();
            let due = matches!(schedule.next(now, None), Decision::Poll(_));
            let decision = schedule.next(now, best);
            if let (true, Decision::Command(urgency)) = (due, decision) {
                let taken = if urgency == Urgency::Stop { stops } else { row };
                prop_assert!(taken < COMMANDS_IN_A_ROW, "{taken} commands before a due poll");
            }
            let counted = now >= settled;
            if best == Some(Urgency::Stop) && !matches!(decision, Decision::Command(Urgency::Stop)) {
                passed += 1;
                seen.stop_waited = seen.stop_waited.max(passed);
            }
            match decision {
                Decision::Idle(until) => {
                    prop_assert!(until > now, "idle into the past");
                    prop_assert!(best.is_none(), "idle while a command waits");
                    now = if case.every_ms.is_some() {
                        until.min(next_command)
                    } else {
                        until
                    };
                }
                Decision::Command(urgency) => {
                    prop_assert_eq!(Some(urgency), best);
                    let at = waiting.iter().position(|u| *u == urgency).unwrap();
                    waiting.remove(at);
                    let took = Duration::from_millis(case.cost_ms);
                    now += took;
                    schedule.command_done(urgency, COST);
                    row += 1;
                    stops = if urgency == Urgency::Stop { stops + 1 } else { 0 };
                    passed = 0;
                }
                Decision::Poll(poll) => {
                    let dead = case.dead[poll.drive];
                    let took = if dead { DEADLINE } else { cost(&poll.read) };
                    now += took;
                    schedule.poll_done(&poll, if dead { Polled::Failed } else { Polled::Ok }, took, now);
                    (row, stops) = (0, 0);
                    if !counted {
                        last.insert((poll.drive, poll.read), now);
                        continue;
                    }
                    if dead {
                        *seen.dead_time.entry(poll.drive).or_default() += took;
                        continue;
                    }
                    let key = (poll.drive, poll.read.start);
                    let gap = now - last.insert((poll.drive, poll.read), now).unwrap_or(settled);
                    match poll.read.class {
                        PollClass::Fast => {
                            *seen.fast_counts.entry(key).or_default() += 1;
                            let longest = seen.longest.entry(key).or_default();
                            *longest = gap.max(*longest);
                        }
                        PollClass::Slow => {
                            seen.slow_time += took;
                            let longest = seen.slow_longest.entry(key).or_default();
                            *longest = gap.max(*longest);
                        }
                        // On a line that is full of commands the start takes long.
                        _ => seen.slow_time += took,
                    }
                }
            }
        }
        for ((drive, read), at) in last {
            if case.dead[drive] {
                continue;
            }
            let of = match read.class {
                PollClass::Fast => &mut seen.longest,
                PollClass::Slow => &mut seen.slow_longest,
                _ => continue,
            };
            let longest = of.entry((drive, read.start)).or_default();
            *longest = (*longest).max(now - at);
        }
        seen.elapsed = now - settled;
        Ok(seen)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(150))]

        #[test]
        fn nothing_starves_and_everybody_has_his_share(case in case()) {
            let seen = simulate(&case)?;
            let plans: Vec<Plan> = case.plans.iter().map(|reads| plan_of(reads)).collect();
            let alive = |drive: usize| !case.dead[drive];
            let of = |class: PollClass| plans.iter().enumerate().filter(|(d, _)| alive(*d))
                .map(|(_, plan)| plan.reads.iter().filter(|r| r.class == class).count()).sum::<usize>() as u32;
            let dearest = Duration::from_millis(case.cost_ms) + Duration::from_micros(300) * 12;
            // A round with its slow polls, eight commands and eight stops before each poll, a probe behind each fast poll.
            let commands = if case.every_ms.is_some() { 17 } else { 1 };
            let dead = case.dead.iter().filter(|dead| **dead).count() as u32;
            let fast = of(PollClass::Fast);
            let round = dearest * commands * (fast * 11 / 10 + 3) + DEADLINE * dead;
            let bound = Duration::from_millis(case.cycle_ms) * 2 + round * 2;
            for (key, longest) in &seen.longest {
                prop_assert!(*longest <= bound, "fast poll {key:?} waited {longest:?}, bound {bound:?}");
            }
            for drive in (0..plans.len()).filter(|d| alive(*d)) {
                for read in plans[drive].reads.iter().filter(|r| r.class == PollClass::Fast) {
                    prop_assert!(seen.fast_counts.contains_key(&(drive, read.start)), "{drive} {read:?} is never read");
                }
                for read in plans[drive].reads.iter().filter(|r| r.class == PollClass::Slow) {
                    prop_assert!(seen.slow_longest.contains_key(&(drive, read.start)), "{drive} {read:?} is never read");
                }
            }
            // All fast polls alike: as often as one another, but for the round that is going on.
            let counts: Vec<usize> = seen.fast_counts.values().copied().collect();
            if let (Some(least), Some(most)) = (counts.iter().min(), counts.iter().max()) {
                prop_assert!(most - least <= 2, "{counts:?}");
            }
            // Slow polls: at 5 % of the line each has its turn; else each second.
            let slow_work = dearest * (of(PollClass::Slow) + of(PollClass::Once));
            let slow_bound = SLOW + (slow_work.mul_f64(1.0 / SLOW_SHARE) + bound) * 2;
            for (key, longest) in &seen.slow_longest {
                prop_assert!(*longest <= slow_bound, "slow poll {key:?} waited {longest:?}, bound {slow_bound:?}");
            }
            // Each slow poll was read each second, or all of them had their share.
            let late = seen.slow_longest.values().any(|longest| *longest > SLOW * 2 + bound);
            let share = seen.slow_time.as_secs_f64() / seen.elapsed.as_secs_f64();
            prop_assert!(!late || share > SLOW_SHARE * 0.8, "slow share {share}");
            prop_assert!(seen.stop_waited <= 1, "a stop waited for {} others", seen.stop_waited);
            for (drive, time) in &seen.dead_time {
                let share = time.as_secs_f64() / seen.elapsed.as_secs_f64();
                prop_assert!(share <= 0.0205, "dead drive {drive} costs {share}");
            }
        }
    }
}
