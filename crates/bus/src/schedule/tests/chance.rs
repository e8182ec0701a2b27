//! Random buses: nothing starves, and every drive and class gets its share.

use std::collections::VecDeque;

use proptest::prelude::*;

use super::*;

/// A random bus: its drives, the cost of transactions, which drives do not answer, and how often commands are sent.
#[derive(Debug, Clone)]
struct Case {
    plans: Vec<Vec<(u8, u16)>>,
    cost_ms: u64,
    cycle_ms: u64,
    dead: Vec<bool>,
    /// Interval of commands; `None` means never.
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
            // About one drive in four does not answer.
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
    // Fast reads are first in the list, as in the order of the planner. Each drive has one fast read.
    reads.push(read(PollClass::Fast, 0, 11));
    reads.sort();
    Plan {
        reads,
        ..Plan::default()
    }
}

const DEADLINE: Duration = Duration::from_millis(110);
const SLOW: Duration = Duration::from_secs(1);

/// Figures of one minute, after a start of fifteen seconds in which the drives that do not answer are detected.
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

impl Seen {
    /// Notes a poll of a drive that answers, `gap` after the previous poll.
    fn read(&mut self, poll: &Poll, took: Duration, gap: Duration) {
        let key = (poll.drive.place(), poll.read.start);
        match poll.read.class {
            PollClass::Fast => {
                *self.fast_counts.entry(key).or_default() += 1;
                self.longest(key, PollClass::Fast, gap);
            }
            PollClass::Slow => {
                self.slow_time += took;
                self.longest(key, PollClass::Slow, gap);
            }
            // On a line full of commands the start takes long, so first reads are counted separately.
            _ => self.slow_time += took,
        }
    }

    fn longest(&mut self, key: (usize, u16), class: PollClass, gap: Duration) {
        let of = match class {
            PollClass::Fast => &mut self.longest,
            PollClass::Slow => &mut self.slow_longest,
            _ => return,
        };
        let longest = of.entry(key).or_default();
        *longest = gap.max(*longest);
    }
}

/// Commands that arrive at a steady pace, each of a rank by chance.
struct Commands {
    every: Option<Duration>,
    next: Instant,
    dice: u64,
    waiting: VecDeque<Urgency>,
}

impl Commands {
    fn new(case: &Case, start: Instant) -> Commands {
        Commands {
            every: case.every_ms.map(Duration::from_millis),
            next: start,
            dice: case.seed | 1,
            waiting: VecDeque::new(),
        }
    }

    fn arrive(&mut self, now: Instant) {
        let Some(every) = self.every else { return };
        while self.next <= now {
            self.dice = self
                .dice
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            let urgency = match (self.dice >> 33) % 20 {
                0 => Urgency::Stop,
                1..=14 => Urgency::Command,
                _ => Urgency::Read,
            };
            // The queue has room for 64 commands.
            if self.waiting.len() < 64 {
                self.waiting.push_back(urgency);
            }
            self.next += every;
        }
    }

    fn best(&self) -> Option<Urgency> {
        self.waiting.iter().min().copied()
    }

    /// When the next command arrives, if any does.
    fn next(&self) -> Option<Instant> {
        self.every.map(|_| self.next)
    }

    fn take(&mut self, urgency: Urgency) {
        let at = self.waiting.iter().position(|u| *u == urgency).unwrap();
        self.waiting.remove(at);
    }
}

fn simulate(case: &Case) -> Result<Seen, TestCaseError> {
    let plans: Vec<Plan> = case.plans.iter().map(|reads| plan_of(reads)).collect();
    let plan_refs: Vec<&Plan> = plans.iter().collect();
    let cost =
        |read: &PlannedRead| Duration::from_millis(case.cost_ms) + Duration::from_micros(300) * u32::from(read.count);
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
    let mut now = start;
    let mut commands = Commands::new(case, start);
    let mut passed = 0;
    let (mut row, mut stops) = (0, 0);
    while now < end {
        commands.arrive(now);
        let best = commands.best();
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
                now = commands.next().map_or(until, |next| until.min(next));
            }
            Decision::Command(urgency) => {
                prop_assert_eq!(Some(urgency), best);
                commands.take(urgency);
                let took = Duration::from_millis(case.cost_ms);
                now += took;
                schedule.command_done(urgency, COST);
                row += 1;
                stops = if urgency == Urgency::Stop { stops + 1 } else { 0 };
                passed = 0;
            }
            Decision::Poll(poll) => {
                let dead = case.dead[poll.drive.place()];
                let took = if dead { DEADLINE } else { cost(&poll.read) };
                now += took;
                schedule.poll_done(&poll, if dead { Polled::Failed } else { Polled::Ok }, took, now);
                (row, stops) = (0, 0);
                let before = last.insert((poll.drive.place(), poll.read), now);
                match (counted, dead) {
                    (false, _) => {}
                    (true, true) => *seen.dead_time.entry(poll.drive.place()).or_default() += took,
                    (true, false) => seen.read(&poll, took, now - before.unwrap_or(settled)),
                }
            }
        }
    }
    for ((drive, read), at) in last {
        if case.dead[drive] {
            continue;
        }
        seen.longest((drive, read.start), read.class, now - at);
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
        // The longest possible round: slow polls, eight commands and eight stops before each poll, a probe after
        // each fast poll.
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
        // All fast polls are read equally often, apart from the round in progress.
        let counts: Vec<usize> = seen.fast_counts.values().copied().collect();
        if let (Some(least), Some(most)) = (counts.iter().min(), counts.iter().max()) {
            prop_assert!(most - least <= 2, "{counts:?}");
        }
        // With 5 % of the line, each slow poll is served in this time; otherwise, each is read every second.
        let slow_work = dearest * (of(PollClass::Slow) + of(PollClass::Once));
        let slow_bound = SLOW + (slow_work.mul_f64(1.0 / SLOW_SHARE) + bound) * 2;
        for (key, longest) in &seen.slow_longest {
            prop_assert!(*longest <= slow_bound, "slow poll {key:?} waited {longest:?}, bound {slow_bound:?}");
        }
        // Each slow poll was read each second, or all of them together got their share.
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
