//! Cadence and fairness of a line in virtual time; tests of commands, absent drives and random cases are in separate files.

use std::collections::BTreeMap;

use super::*;
use drivegate_model::drive::DriveIndex;
use drivegate_proto::Table;

mod chance;
mod commands;
mod presence;
mod silent_points;

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
    Plan {
        reads,
        ..Plan::default()
    }
}

/// A line in virtual time: every exchange takes `COST`, a drive that does not answer ten times that.
struct PolledLine {
    schedule: Schedule,
    now: Instant,
    dead: Vec<usize>,
    log: Vec<(Instant, Decision)>,
    offline: Vec<usize>,
}

impl PolledLine {
    fn new(drives: usize, cycle: Duration) -> PolledLine {
        let plan = plan();
        PolledLine::of(&vec![&plan; drives], cycle)
    }

    fn of(plans: &[&Plan], cycle: Duration) -> PolledLine {
        let now = Instant::now();
        let cadence = Cadence {
            fast: cycle,
            slow: Duration::from_secs(1),
            retries: 1,
        };
        let schedule = Schedule::new(cadence, plans, |_, _| COST, now);
        PolledLine {
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
                let dead = self.dead.contains(&poll.drive.place());
                let took = if dead { COST * 10 } else { COST };
                self.now += took;
                let polled = if dead { Polled::Failed } else { Polled::Ok };
                if self.schedule.poll_done(&poll, polled, took, self.now) == Change::Offline {
                    self.offline.push(poll.drive.place());
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
                *counts.entry(poll.drive.place()).or_default() += 1;
            }
        }
        counts
    }
}

#[test]
fn a_saturated_line_is_never_idle_and_fair() {
    let mut rig = PolledLine::new(10, Duration::from_millis(10));
    rig.run(Duration::from_secs(1));
    rig.log.clear();
    rig.run(Duration::from_secs(20));
    assert!(rig.log.iter().all(|(_, d)| !matches!(d, Decision::Idle(_))));
    let fast = rig.polls(PollClass::Fast);
    let (least, most) = (fast.values().min().unwrap(), fast.values().max().unwrap());
    assert!(most - least <= 1, "{fast:?}");
    // Ten slow polls a second would need 12 %; they get 5 %.
    let slow: usize = rig.polls(PollClass::Slow).values().sum();
    let share = slow as f64 * COST.as_secs_f64() / 20.0;
    assert!((0.045..0.07).contains(&share), "{share}");
}

#[test]
fn slow_polls_get_their_share_where_the_idle_time_fits_none() {
    // Two fast polls take 24 of 30 ms, so no slow poll fits after them. A slow poll would take 2.4 % of the line,
    // which is available.
    let mut rig = PolledLine::new(2, Duration::from_millis(30));
    rig.run(Duration::from_secs(5));
    rig.log.clear();
    rig.run(Duration::from_secs(60));
    let (slow, fast) = (rig.polls(PollClass::Slow), rig.polls(PollClass::Fast));
    assert!(slow.values().all(|n| (59..=61).contains(n)), "{slow:?}");
    assert!(fast.values().all(|n| (1990..=2001).contains(n)), "{fast:?}");
}

#[test]
fn slow_polls_that_fit_into_idle_time_delay_no_round() {
    // Six slow polls are due at once each second; two of them fit after the six fast ones of a round.
    let mut rig = PolledLine::new(6, Duration::from_millis(100));
    rig.run(Duration::from_secs(5));
    let begin = rig.now;
    rig.log.clear();
    rig.run(Duration::from_secs(60));
    let first = |d: &Decision| matches!(d, Decision::Poll(p) if p.read.class == PollClass::Fast && p.drive == 0);
    let rounds: Vec<Instant> = rig.log.iter().filter(|(_, d)| first(d)).map(|(at, _)| *at).collect();
    let cycles: Vec<Duration> = rounds.windows(2).map(|w| w[1] - w[0]).collect();
    assert!(cycles.iter().all(|c| *c == Duration::from_millis(100)), "{cycles:?}");
    assert!(
        rig.polls(PollClass::Slow).values().all(|n| *n >= 59),
        "{:?}",
        rig.now - begin
    );
}

#[test]
fn the_grid_is_kept_without_drift() {
    let mut rig = PolledLine::new(1, Duration::from_millis(30));
    rig.run(Duration::from_secs(30));
    let fast: Vec<Instant> = rig
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
    let mut rig = PolledLine::new(1, cycle);
    rig.run(Duration::from_secs(2));
    let start = rig.schedule.round_due;
    for stall in [7, 31, 95, 1000, 12_345] {
        rig.now += Duration::from_millis(stall);
        rig.log.clear();
        rig.run(cycle * 20);
        let fast: Vec<Instant> = rig
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
    // The slow polls need nearly three lines and get a third of one.
    assert!((65..=75).contains(&slow), "{slow} slow polls in 300 s");
}

#[test]
fn what_a_fault_asks_for_is_read_once_a_fault_and_takes_no_more_than_the_slow_share() {
    let plan = Plan {
        on_fault: vec![read(PollClass::Fault, 98, 1), read(PollClass::Fault, 200, 1)],
        ..plan()
    };
    let now = Instant::now();
    let cadence = Cadence {
        fast: Duration::from_millis(10),
        slow: Duration::from_secs(1),
        retries: 1,
    };
    let plans: Vec<&Plan> = (0..32).map(|_| &plan).collect();
    let mut schedule = Schedule::new(cadence, &plans, |_, _| COST, now);
    let mut at = now;
    // Counts polls by class, and the drives of which all fault reads were made.
    let mut pass = |schedule: &mut Schedule, time: Duration| {
        let (until, mut polls, mut asked) = (at + time, BTreeMap::new(), Vec::new());
        while at < until {
            match schedule.next(at, None) {
                Decision::Idle(until) => at = until,
                Decision::Command(_) => unreachable!(),
                Decision::Poll(poll) => {
                    at += COST;
                    *polls.entry(poll.read.class).or_insert(0) += 1;
                    if poll.read.class == PollClass::Fault {
                        asked.push((poll.read.start, poll.drive.place()));
                    }
                    schedule.poll_done(&poll, Polled::Ok, COST, at);
                }
            }
        }
        (at, polls, asked)
    };
    let (_, _, asked) = pass(&mut schedule, Duration::from_secs(60));
    assert_eq!(asked, [], "never without a fault");
    let (at, before, _) = pass(&mut schedule, Duration::from_secs(60));
    (0..32).for_each(|drive| schedule.fault_came(DriveIndex::new(drive), |read| read.start == 2000, at));
    let (at, after, mut asked) = pass(&mut schedule, Duration::from_secs(60));
    asked.sort_unstable();
    let each: Vec<(u16, usize)> = [98, 200]
        .into_iter()
        .flat_map(|start| (0..32).map(move |d| (start, d)))
        .collect();
    assert_eq!(asked, each);
    let fast = |polls: &BTreeMap<PollClass, i32>| polls[&PollClass::Fast];
    assert!(
        (fast(&before) - fast(&after)).abs() * 100 <= fast(&before),
        "{before:?} {after:?}"
    );
    schedule.fault_came(DriveIndex::new(5), |_| false, at);
    schedule.read_again(DriveIndex::new(5), at);
    let (_, _, asked) = pass(&mut schedule, Duration::from_secs(60));
    assert_eq!(asked.len(), 2, "the next fault asks again");
}

mod trials;
