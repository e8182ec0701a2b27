//! Drives that answer others and never one point.

use super::*;
use drivegate_model::drive::DriveIndex;
use drivegate_model::drive::profile::Profiles;

/// A drive that never answers reads that cover `address`: its polls, and how often it went offline and returned.
struct Silent {
    rig: PolledLine,
    of: (Table, u16),
    asked: Vec<(Instant, PlannedRead)>,
    went: usize,
    came: usize,
}

impl Silent {
    fn new(plan: &Plan, of: (Table, u16)) -> Silent {
        let rig = PolledLine::of(&[plan], Duration::from_millis(10));
        Silent {
            rig,
            of,
            asked: Vec::new(),
            went: 0,
            came: 0,
        }
    }

    fn run(&mut self, time: Duration) {
        let end = self.rig.now + time;
        while self.rig.now < end {
            let poll = match self.rig.schedule.next(self.rig.now, None) {
                Decision::Idle(until) => {
                    self.rig.now = until;
                    continue;
                }
                Decision::Command(_) => unreachable!(),
                Decision::Poll(poll) => poll,
            };
            let silent = poll.read.covers(self.of.0, self.of.1);
            let took = if silent { COST * 10 } else { COST };
            self.rig.now += took;
            self.asked.push((self.rig.now, poll.read));
            let polled = if silent { Polled::Failed } else { Polled::Ok };
            match self.rig.schedule.poll_done(&poll, polled, took, self.rig.now) {
                Change::Online => self.came += 1,
                Change::Offline => self.went += 1,
                _ => {}
            }
        }
    }

    /// Runs for this time; returns the time, and the part of it that unanswered requests took.
    fn in_vain_of(&mut self, time: Duration) -> (Duration, Duration) {
        self.asked.clear();
        self.run(time);
        let vain = self
            .asked
            .iter()
            .filter(|(_, read)| read.covers(self.of.0, self.of.1))
            .count();
        (time, COST * 10 * u32::try_from(vain).unwrap_or(u32::MAX))
    }

    fn is_online(&self) -> bool {
        self.rig.schedule.is_online(DriveIndex::new(0))
    }
}

#[test]
fn a_point_that_is_never_answered_is_found_in_its_block_and_takes_no_drive_away() {
    let mut drive = Silent::new(&plan(), (Table::Holding, 2105));
    drive.run(Duration::from_secs(10));
    assert!(drive.is_online());
    assert_eq!((drive.went, drive.came), (1, 1), "it was never online before that");
    drive.asked.clear();
    drive.run(Duration::from_secs(40));
    assert_eq!((drive.went, drive.came), (1, 1));
    let of = |start: u16, count: u16| {
        let same = |(_, read): &&(Instant, PlannedRead)| (read.start, read.count) == (start, count);
        drive.asked.iter().filter(same).count()
    };
    assert!(
        of(2100, 5) > 500 && of(2106, 5) > 500,
        "its neighbours are read in every round"
    );
    assert!((1..20).contains(&of(2105, 1)), "{}", of(2105, 1));
    // The point is answered again: read with its neighbours soon, and in every round.
    drive.of.1 = 9;
    drive.run(Duration::from_secs(130));
    drive.asked.clear();
    drive.run(Duration::from_secs(10));
    let whole = drive
        .asked
        .iter()
        .filter(|(_, read)| (read.start, read.count) == (2100, 11));
    assert!(whole.count() > 100, "{:?}", drive.asked.last());
    // A drive that answers no request goes offline after the usual number of attempts.
    drive.of = (Table::Holding, 2100);
    drive.rig.dead = vec![0];
    drive.rig.run(Duration::from_secs(2));
    assert!(!drive.is_online());
}

/// A drive with a single block: halves of the block are asked among the probes, and all but the register is read.
#[test]
fn a_register_in_the_only_block_of_a_drive_is_found() {
    let block = plan().reads.into_iter().next().expect("process data");
    let only = Plan {
        reads: vec![block],
        ..Plan::default()
    };
    for register in block.start..block.start + block.count {
        let mut drive = Silent::new(&only, (block.table, register));
        drive.run(Duration::from_secs(30));
        assert!(drive.is_online(), "{register}");
        assert_eq!((drive.went, drive.came), (1, 1), "{register}");
        let (all, vain) = drive.in_vain_of(Duration::from_secs(60));
        assert!(vain * 50 <= all, "{register}: {vain:?} of {all:?}");
        let found = drive.rig.schedule.unanswered();
        let found: Vec<(u16, u16)> = found.iter().flatten().map(|read| (read.start, read.count)).collect();
        assert_eq!(found, [(register, 1)]);
    }
}

/// A meter never answers one register of a slow block.
#[test]
fn a_register_in_a_slow_block_is_found() {
    let fast = plan().reads.into_iter().next().expect("process data");
    let slow = PlannedRead {
        class: PollClass::Slow,
        start: 4000,
        count: 40,
        wide: 0,
        ..fast
    };
    let both = Plan {
        reads: vec![fast, slow],
        ..Plan::default()
    };
    let mut drive = Silent::new(&both, (slow.table, 4023));
    drive.run(Duration::from_secs(30));
    assert_eq!((drive.went, drive.came), (0, 1));
    let found = drive.rig.schedule.unanswered();
    assert_eq!(
        found
            .iter()
            .flatten()
            .map(|read| (read.start, read.count))
            .collect::<Vec<_>>(),
        [(4023, 1)]
    );
    drive.asked.clear();
    drive.run(Duration::from_secs(30));
    for register in [4000, 4022, 4024, 4039] {
        let reads = drive.asked.iter().filter(|(_, read)| read.covers(slow.table, register));
        assert!(reads.count() > 10, "{register}");
    }
    let (all, vain) = drive.in_vain_of(Duration::from_secs(60));
    assert!(vain * 50 <= all, "{vain:?} of {all:?}");
}

/// For each family, the test lets any one point of its process data stay unanswered.
#[test]
fn of_every_family_any_point_may_keep_silent() {
    for profile in Profiles::built_in().iter() {
        let plan = Plan::of(profile);
        let points = |read: &PlannedRead| {
            (read.start..read.start + read.count)
                .map(|start| (read.table, start))
                .collect()
        };
        let fast = plan.reads.iter().filter(|read| read.class == PollClass::Fast);
        let all: Vec<Vec<(Table, u16)>> = fast.map(points).collect();
        for of in all.concat() {
            let mut drive = Silent::new(&plan, of);
            drive.run(Duration::from_secs(30));
            let others = plan.reads.iter().any(|read| {
                let halves = Plan::halves(*read).map_or(vec![*read], |(low, high)| vec![low, high]);
                halves.iter().any(|part| !part.covers(of.0, of.1))
            });
            let shown = (&profile.name, of);
            assert_eq!(drive.is_online(), others, "{shown:?}");
            assert!(drive.went <= 1, "{shown:?}: it went away {} times", drive.went);
            if others {
                drive.run(Duration::from_secs(120));
                assert!(drive.is_online() && drive.went <= 1, "{shown:?}: {}", drive.went);
            }
        }
    }
}
