//! Trends, counters and the last hour of a line, from polls to figures.

use super::*;
use crate::history::trend::Part;

const MINUTE: Duration = Duration::from_secs(60);

fn off() -> RecorderOptions {
    RecorderOptions {
        max_count: 0,
        ..options()
    }
}

impl Rig {
    fn part(&self, point: ModelPoint, seconds: u64) -> Part {
        let from = self.clock.now - Duration::from_secs(seconds);
        let history = self.history();
        let trend = history.trend();
        trend.part(point, from, self.clock.now, self.clock).unwrap()
    }

    fn link(&self, link: Link) {
        self.bus.drives[0].update(|snapshot| snapshot.link = link);
    }

    /// Polls for some time; `runs` says for each poll whether the motor runs.
    fn run(&mut self, time: Duration, runs: impl Fn(usize) -> bool) {
        self.polls(time, |rig, n| {
            let status = if runs(n) { RUNS } else { 1 };
            rig.poll(0, status, 1000 + (n % 100) as u16, 0);
        });
    }
}

#[test]
fn trends_have_the_extremes_of_every_poll_with_and_without_recordings() {
    for options in [options(), off()] {
        let mut rig = Rig::new(options, 1, &[]);
        rig.link(Link::Online(SystemTime::UNIX_EPOCH));
        rig.run(20 * SECOND, |_| true);
        let current = rig.part(ModelPoint::MotorCurrent, 10);
        assert_eq!((current.unit, current.step), ("A", SECOND));
        let whole = &current.steps[1..10];
        assert!(
            whole
                .iter()
                .all(|step| step.is_some_and(|s| (s.min, s.max) == (100.0, 109.9))),
            "{whole:?}"
        );
        let frequency = rig.part(ModelPoint::OutputFrequency, 10);
        assert_eq!(frequency.steps[3].map(|step| step.last), Some(41.0));
        assert_eq!(
            rig.part(ModelPoint::HeatsinkTemperature, 10)
                .steps
                .iter()
                .flatten()
                .count(),
            0,
            "never read"
        );
    }
}

#[test]
fn a_point_made_of_others_needs_all_of_them() {
    let mut rig = Rig::new(options(), 1, &[]);
    rig.link(Link::Online(SystemTime::UNIX_EPOCH));
    rig.run(5 * SECOND, |_| true);
    let nx = &rig.bus.drives[0].spec.profile;
    let derived = nx
        .model_point(ModelPoint::ActualSpeed)
        .is_some_and(|point| point.raw().is_none());
    let speeds = rig.part(ModelPoint::ActualSpeed, 5).steps.iter().flatten().count();
    assert_eq!(speeds > 0, !derived, "the ends of the speed range were never read");
}

#[test]
fn starts_and_run_time_are_what_the_polls_saw() {
    let mut rig = Rig::new(options(), 1, &[]);
    rig.link(Link::Online(SystemTime::UNIX_EPOCH));
    // The motor already runs when the gateway starts, so no start was seen. Then 10 s on, 10 s off.
    rig.run(MINUTE, |n| n / 1000 % 2 == 0);
    let totals = rig.history().totals();
    assert_eq!(totals.starts, 2);
    assert!((totals.running_seconds - 30.0).abs() < 0.02, "{totals:?}");
    // The drive is offline for a minute, in which the motor starts; the next poll shows it running.
    rig.link(Link::Offline(SystemTime::UNIX_EPOCH));
    rig.recorder.tick(rig.clock);
    rig.pass(MINUTE);
    rig.link(Link::Online(SystemTime::UNIX_EPOCH + MINUTE));
    rig.run(10 * SECOND, |_| true);
    let after = rig.history().totals();
    assert_eq!(after.starts, 2, "nobody saw it start");
    assert!(
        (after.running_seconds - totals.running_seconds - 10.0).abs() < 0.2,
        "{after:?}"
    );
    // No poll for longer than a value is good, without the drive being offline.
    rig.pass(MINUTE);
    rig.run(POLL, |_| true);
    assert!(rig.history().totals().running_seconds - after.running_seconds < 0.1);
}

#[test]
fn a_reload_keeps_counters_for_ever_and_trends_of_the_same_drive() {
    let mut rig = Rig::new(options(), 1, &[]);
    rig.link(Link::Online(SystemTime::UNIX_EPOCH));
    rig.run(10 * SECOND, |n| n > 500);
    let counted = rig.history().totals();
    assert_eq!(counted.starts, 1);
    let again = |rig: &mut Rig, address: u8| {
        let spec = DriveSpec {
            address,
            ..rig.bus.drives[0].spec.clone()
        };
        let drive = testkit::image(spec);
        rig.bus = Arc::new(BusImage::new(rig.bus.spec.clone(), vec![drive]));
        rig.recorder
            .adopt(std::slice::from_ref(&rig.bus), STALE_AFTER, rig.clock);
    };
    let address = rig.bus.drives[0].spec.address;
    again(&mut rig, address);
    assert!(rig.part(ModelPoint::MotorCurrent, 8).steps.iter().flatten().count() > 5);
    assert_eq!(rig.history().totals(), counted);
    again(&mut rig, address + 1);
    assert_eq!(
        rig.part(ModelPoint::MotorCurrent, 8).steps.iter().flatten().count(),
        0,
        "another drive"
    );
    assert_eq!(rig.history().totals(), counted);
    // The drive is removed by one reload and returns with another.
    rig.recorder.adopt(&[], STALE_AFTER, rig.clock);
    assert!(rig.history.drive("pump-1").is_none());
    assert_eq!(rig.history.totals("pump-1"), counted);
    again(&mut rig, address);
    assert_eq!(rig.history().totals(), counted);
}

#[test]
fn the_last_hour_of_a_line_counts_every_exchange_once() {
    let mut rig = Rig::new(options(), 2, &[]);
    rig.bus.update_health(|health| {
        health.up = true;
        health.load = Some(0.5);
    });
    for minute in 0..90u64 {
        for _ in 0..60 {
            rig.bus.drives[0].count(Outcome::Ok);
            if minute == 80 {
                rig.bus.drives[1].count(Outcome::Timeout);
            }
            rig.pass(SECOND);
            rig.recorder.tick(rig.clock);
        }
    }
    let line = rig.history.line("line1").unwrap();
    let hour = line.lock().unwrap().last_hour(rig.clock);
    assert_eq!((hour.load.len(), hour.drives.len()), (60, 2));
    let sums = hour.drives.iter().map(|steps| {
        let all: u32 = steps.iter().flatten().map(|step| step.all).sum();
        let failed: u32 = steps.iter().flatten().map(|step| step.failed).sum();
        (all, failed)
    });
    let sums: Vec<_> = sums.collect();
    assert!((3500..=3600).contains(&sums[0].0) && sums[0].1 == 0, "{sums:?}");
    assert_eq!(sums[1], (60, 60));
    assert!(hour.drives[1].iter().flatten().filter(|step| step.failed > 0).count() <= 2);
    assert_eq!(hour.load[30], Some((0.5, 0.5, 0.5)));
    // A gateway that has just started has no data for the time before.
    let young = Rig::new(options(), 1, &[]);
    let line = young.history.line("line1").unwrap();
    let hour = line.lock().unwrap().last_hour(young.clock);
    assert_eq!(hour.drives[0], vec![None; 60]);
}
