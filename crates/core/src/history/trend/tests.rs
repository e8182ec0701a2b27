use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::testkit;

const SECOND: Duration = Duration::from_secs(1);

fn clock() -> Clock {
    Clock {
        now: Instant::now() + Duration::from_secs(1_000_000),
        wall: SystemTime::UNIX_EPOCH + Duration::from_millis(1_770_000_037_250),
    }
}

/// The trends of a drive to which the test adds the values.
struct Rig {
    trend: DriveTrend,
    clock: Clock,
    /// The values that were added: time, value, and how long the value is good.
    fed: Vec<(Instant, f32, Duration)>,
}

impl Rig {
    fn new() -> Rig {
        let clock = clock();
        Rig {
            trend: DriveTrend::new(&testkit::nx(), Reach::FULL, clock),
            clock,
            fed: Vec::new(),
        }
    }

    fn pass(&mut self, time: Duration) {
        self.clock.now += time;
        self.clock.wall += time;
    }

    fn feed(&mut self, value: f32, good_for: Duration) {
        let since = self.clock.now.saturating_duration_since(self.trend.epoch);
        let reach = self.trend.reach;
        let of = |trend: &&mut PointTrend| trend.point == ModelPoint::MotorCurrent;
        let trend = self.trend.points.iter_mut().find(of).unwrap();
        trend
            .kept
            .get_or_insert_with(|| KeptValues::new(reach))
            .add(StepTime::new(since), value, || good_for);
        self.fed.push((self.clock.now, value, good_for));
    }

    /// The last part of a range, as a client requests it.
    fn part(&self, range: Range, clock: Clock) -> Part {
        let from = clock.now - range.span;
        self.trend
            .part(ModelPoint::MotorCurrent, from, clock.now, clock)
            .unwrap()
    }

    /// The expected steps of a range, calculated from all values ever fed in: by the number of the step.
    fn naive(&self, range: Range) -> BTreeMap<u64, (f32, f32, f32)> {
        let number = |at: Instant| at.duration_since(self.trend.epoch).as_secs() / range.step.as_secs();
        let mut steps: BTreeMap<u64, (f32, f32, f32)> = BTreeMap::new();
        for &(at, value, _) in &self.fed {
            let step = steps.entry(number(at)).or_insert((value, value, value));
            *step = (step.0.min(value), step.1.max(value), value);
        }
        for pair in self.fed.windows(2) {
            let [(before, value, _), (after, _, good_for)] = pair else {
                unreachable!()
            };
            if *after - *before <= *good_for {
                for between in number(*before) + 1..number(*after) {
                    steps.entry(between).or_insert((*value, *value, *value));
                }
            }
        }
        let now = number(self.clock.now);
        steps.retain(|step, _| *step + range.buckets() as u64 > now && *step <= now);
        steps
    }

    fn check(&self) {
        for range in self.trend.ranges() {
            let part = self.part(range, self.clock);
            assert_eq!(part.step, range.step);
            assert!(part.steps.len() <= range.buckets());
            let number = |at: u64| {
                let since = Duration::from_millis(at)
                    - (self
                        .clock
                        .wall_at(self.trend.epoch)
                        .duration_since(SystemTime::UNIX_EPOCH)
                        .unwrap());
                since.as_secs() / range.step.as_secs()
            };
            let shown: BTreeMap<u64, _> = part
                .steps
                .iter()
                .flatten()
                .map(|s| (number(s.at), (s.min, s.max, s.last)))
                .collect();
            assert_eq!(shown, self.naive(range), "{range:?}");
        }
    }
}

proptest! {
    /// Compares with a naive model: whatever values come at whatever times, each step of each range shows what was
    /// read in it and nothing else.
    #[test]
    fn every_step_is_that_of_a_naive_model(
        reads in prop::collection::vec((0u32..6, 0u64..4000, -1e6f32..1e6, 0u64..20), 1..300)
    ) {
        let mut rig = Rig::new();
        for (scale, time, value, good_for) in reads {
            // Pauses range from one poll to a weekend.
            let time = Duration::from_millis(time) * [1, 3, 10, 300, 3000, 30_000][scale as usize];
            rig.pass(time);
            rig.feed(value, Duration::from_secs(good_for));
        }
        rig.check();
        rig.pass(7 * SECOND);
        rig.check();
    }

    /// The time of day serves for labels only.
    #[test]
    fn a_clock_that_is_set_moves_labels_and_no_value(ahead in any::<bool>(), seconds in 0u64..2_000_000, polls in 1usize..500) {
        let mut rig = Rig::new();
        for n in 0..polls {
            rig.pass(Duration::from_millis(700));
            rig.feed(n as f32, 2 * SECOND);
        }
        let before = rig.part(RANGES[0], rig.clock);
        let apart = Duration::from_secs(seconds);
        let wall = if ahead { rig.clock.wall + apart } else { rig.clock.wall - apart };
        let after = rig.part(RANGES[0], Clock { wall, ..rig.clock });
        let values = |part: &Part| part.steps.iter().map(|s| s.map(|s| (s.min, s.max, s.last))).collect::<Vec<_>>();
        prop_assert_eq!(values(&before), values(&after));
        let moved = if ahead { before.from + apart } else { before.from - apart };
        prop_assert_eq!(after.from, moved);
        rig.check();
    }
}

#[test]
fn a_day_at_the_fastest_poll_shows_every_peak() {
    let mut rig = Rig::new();
    // A short peak in each hour. 10 polls a second are enough to represent more frequent polls.
    for n in 0..24 * 36_000u32 {
        rig.pass(Duration::from_millis(100));
        let peak = n % 36_000 == 18_000;
        rig.fed.clear();
        rig.feed(if peak { 200.0 } else { 50.0 }, SECOND);
    }
    let day = rig.part(RANGES[2], rig.clock);
    let peaks = day.steps.iter().flatten().filter(|step| step.max == 200.0);
    assert_eq!((day.steps.len(), peaks.count()), (720, 24));
    assert!(
        day.steps
            .iter()
            .flatten()
            .all(|step| step.min == 50.0 && step.last == 50.0)
    );
}

#[test]
fn what_was_not_good_is_a_gap_and_slow_values_are_none() {
    let mut rig = Rig::new();
    let values = |part: &Part| part.steps.iter().map(|s| s.map(|s| s.last)).collect::<Vec<_>>();
    let last = |rig: &Rig, seconds: u64| {
        let from = rig.clock.now - Duration::from_secs(seconds);
        rig.trend
            .part(ModelPoint::MotorCurrent, from, rig.clock.now, rig.clock)
            .unwrap()
    };
    rig.feed(1.0, 3 * SECOND);
    rig.pass(3 * SECOND);
    rig.feed(2.0, 3 * SECOND);
    assert_eq!(values(&last(&rig, 3)), [Some(1.0), Some(1.0), Some(1.0), Some(2.0)]);
    rig.pass(3 * SECOND);
    rig.trend.interrupt();
    rig.feed(3.0, 3 * SECOND);
    assert_eq!(
        values(&last(&rig, 3)),
        [Some(2.0), None, None, Some(3.0)],
        "the drive was away"
    );
    rig.pass(4 * SECOND);
    rig.feed(4.0, 3 * SECOND);
    assert_eq!(
        values(&last(&rig, 4)),
        [Some(3.0), None, None, None, Some(4.0)],
        "it was not read for too long"
    );
}

#[test]
fn labels_are_whole_steps_and_what_is_asked_for_is_what_comes() {
    let mut rig = Rig::new();
    for n in 0..7200 {
        rig.pass(SECOND);
        rig.feed(n as f32, SECOND);
    }
    let ago = |seconds: u64| rig.clock.now - Duration::from_secs(seconds);
    let part = |from, to| rig.trend.part(ModelPoint::MotorCurrent, from, to, rig.clock).unwrap();
    for (from, to, step, steps) in [
        (60, 0, 1, 61),
        (590, 580, 1, 11),
        (601, 0, 5, 121),
        (3590, 3580, 5, 3),
        (7100, 6900, 120, 2),
    ] {
        let part = part(ago(from), ago(to));
        let since = part.from.duration_since(SystemTime::UNIX_EPOCH).unwrap();
        assert_eq!(
            (part.step.as_secs(), part.steps.len().min(steps)),
            (step, steps),
            "{from}..{to}"
        );
        assert!(part.steps.len() <= steps + 1);
        assert_eq!((since.as_secs() % step, since.subsec_millis()), (0, 0));
        assert!(part.steps.iter().all(Option::is_some));
        let length = part.to.duration_since(part.from).unwrap();
        assert_eq!(length, part.step * part.steps.len() as u32);
    }
    // The requested span is longer than the kept one, and reaches into the future.
    let all = part(rig.clock.now - 100 * 86_400 * SECOND, rig.clock.now + 86_400 * SECOND);
    assert_eq!(all.steps.iter().flatten().count(), all.steps.len());
    assert!(
        rig.trend
            .part(ModelPoint::FaultCode, ago(1), ago(0), rig.clock)
            .is_none()
    );
    let turned = part(ago(5), ago(50));
    assert_eq!(turned.steps.len(), 0, "nothing lies between");
}

#[test]
fn memory_is_as_stated_and_only_for_what_is_read() {
    let mut rig = Rig::new();
    let nx = testkit::nx();
    assert_eq!(rig.trend.points().map(|(_, bytes)| bytes).sum::<usize>(), 0);
    rig.feed(1.0, SECOND);
    assert_eq!(rig.trend.points().map(|(_, bytes)| bytes).sum::<usize>(), POINT_BYTES);
    assert_eq!((POINT_BYTES, bytes_of(&nx)), (24_480, 10 * 24_480));
    const { assert!(6 * POINT_BYTES <= 150 << 10) };
}

#[test]
fn many_drives_share_the_memory_and_what_they_keep_is_right() {
    let nx = testkit::nx();
    let of = |drives| Reach::of(std::iter::repeat_n(&*nx, drives));
    assert_eq!(of(137), Reach::FULL);
    let reach = of(992);
    let all = 992 * reach.bytes_of(&nx);
    assert!((MOST_BYTES / 10 * 9..=MOST_BYTES).contains(&all), "{all}");
    let mut rig = Rig::new();
    let feed = |rig: &mut Rig, seconds: u64| {
        for second in 0..seconds {
            rig.pass(SECOND);
            rig.feed((second % 97) as f32, SECOND);
        }
    };
    feed(&mut rig, 1500);
    rig.trend.set_reach(reach);
    rig.check();
    feed(&mut rig, 700);
    rig.check();
    // When the trend may reach back further again, forgotten values do not return, and new ones are kept.
    rig.trend.set_reach(Reach::FULL);
    let [fine, ..] = RANGES;
    let shown = rig.part(fine, rig.clock).steps.iter().flatten().count();
    assert_eq!(shown, reach.ranges()[0].buckets());
    feed(&mut rig, 24 * 3600);
    rig.check();
}
