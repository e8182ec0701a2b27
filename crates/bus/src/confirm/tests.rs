use drivegate_testkit::audited;
use std::sync::Arc;

use proptest::prelude::*;

use super::*;
use crate::codec::{Reply, RequestPdu, Table};
use crate::command::{Origin, Outcome, SourceKind, Ticket, WriteStats};
use crate::drive::profile::Profiles;
use crate::process_image::{Access, DriveImage, DriveSpec, Link};

struct Bench {
    drive: DriveImage,
    stats: Arc<WriteStats>,
    confirmations: Confirmations,
    /// Of the command that was acknowledged last.
    confirmation: Option<tokio::sync::oneshot::Receiver<Result<Duration, String>>>,
    now: Instant,
}

impl Bench {
    fn new() -> Bench {
        Bench::of("vacon-nx")
    }

    fn of(profile: &str) -> Bench {
        let spec = DriveSpec {
            access: Access::Control,
            turnaround: Duration::ZERO,
            ..DriveSpec::new("d", "b", 1, Profiles::built_in().get(profile).unwrap().clone())
        };
        let drive = DriveImage::new(spec, Duration::from_secs(1));
        drive.update(|s| s.link = Link::Online(std::time::SystemTime::now()));
        let mut bench = Bench {
            drive,
            stats: Arc::default(),
            confirmations: Confirmations::default(),
            confirmation: None,
            now: Instant::now(),
        };
        bench.read(2100, &[0]);
        bench
    }

    fn receipt(&mut self) -> Receipt {
        let origin = Origin::new(SourceKind::Mqtt, "t");
        let (mut ticket, _) = Ticket::new(origin, "d", "it".to_string(), true, self.now, self.stats.clone());
        self.confirmation = Some(ticket.confirmation());
        ticket.acknowledge(Outcome::Acknowledged(Reply::Written), self.now)
    }

    fn acknowledge(&mut self, order: &Order) {
        let receipt = self.receipt();
        let effects = effects(&self.drive.spec.profile, order);
        let reading = self.drive.reading(self.now, Duration::from_secs(1));
        self.confirmations.watch(effects, vec![receipt], &reading, self.now);
    }

    fn order(&self, point: &str, value: Value) -> Order {
        let index = self.drive.spec.profile.point_index(point).unwrap();
        Order::Points(vec![(index, value)])
    }

    fn set(&mut self, point: &str, value: Value) {
        self.acknowledge(&self.order(point, value));
    }

    /// 10 ms later the drive answered with these words.
    fn read(&mut self, start: u16, words: &[u16]) {
        self.now += Duration::from_millis(10);
        let now = self.now;
        self.drive.update(|s| s.store(Table::Holding, start, words, now));
        let reading = self.drive.reading(now, Duration::from_secs(1));
        self.confirmations.look(&reading, now);
    }

    fn results(&self) -> Vec<serde_json::Value> {
        audited(self.stats.audit())
            .iter()
            .map(|r| r["result"].clone())
            .collect()
    }

    fn expired(&mut self) -> Vec<String> {
        let late = self.confirmations.expire(&self.drive.spec.profile, self.now);
        late.into_iter().map(|late| late.text).collect()
    }

    /// The motor runs, at that speed; all of it is 50 Hz.
    fn speed(&mut self, percent: f64) {
        let hundredths = |value: f64| (value * 100.0) as i16 as u16;
        self.read(2100, &[2, 0, hundredths(percent), hundredths(percent / 2.0)]);
    }
}

#[test]
fn only_a_read_after_the_acknowledgement_confirms() {
    let mut bench = Bench::new();
    bench.read(2100, &[2]);
    bench.set("run", Value::Bool(true));
    let reading_before = bench.drive.reading(bench.now, Duration::from_secs(1));
    let now = bench.now;
    bench.confirmations.look(&reading_before, now);
    assert!(bench.results().is_empty(), "the old sample proves nothing");
    bench.read(2100, &[2]);
    assert_eq!(bench.results(), ["confirmed"]);
    assert_eq!(audited(bench.stats.audit())[0]["confirmed_ms"], 10.0);
    assert!(bench.expired().is_empty());
}

#[test]
fn a_stop_is_confirmed_when_the_motor_does_not_run_or_stands() {
    for (words, confirmed) in [
        (&[2, 0, 4900, 2450][..], false),
        (&[2, 0, 99, 49], false),
        (&[2, 0, 0, 0], true),
        // Between 10 and 50 Hz, at its minimum, in either direction.
        (&[2, 0, 0, 1000], false),
        (&[2, 0, 0, 0_u16.wrapping_sub(1000)], false),
        (&[0, 0, 4000, 2000], true),
    ] {
        let mut bench = Bench::new();
        bench.speed(50.0);
        bench.set("run", Value::Bool(false));
        bench.read(2100, words);
        assert_eq!(!bench.results().is_empty(), confirmed, "{words:?}");
        if confirmed {
            assert_eq!(bench.results(), ["confirmed"]);
        }
    }
}

/// From 10 Hz down the speed in percent of the band from 10 Hz says nothing any more.
#[test]
fn below_the_minimum_frequency_the_motor_still_slows_down() {
    let mut bench = Bench::new();
    bench.read(2100, &[2, 0, 0, 1000]);
    bench.set("run", Value::Bool(false));
    for hundredths in (1..1000).rev() {
        bench.read(2100, &[2, 0, 0, hundredths]);
        assert!(bench.expired().is_empty(), "at {hundredths} x 0.01 Hz");
    }
    bench.read(2100, &[2, 0, 0, 0]);
    assert!(bench.confirmations.is_empty() && bench.expired().is_empty());
    assert_eq!(bench.results(), ["acknowledged"], "nobody waited for 10 s");
}

#[test]
fn a_ripple_of_the_speed_does_not_confirm_a_stop_that_the_drive_ignores() {
    let mut bench = Bench::new();
    bench.speed(50.0);
    bench.set("run", Value::Bool(false));
    let mut reported = Vec::new();
    for round in 0..400 {
        bench.speed(if round % 2 == 0 { 49.4 } else { 50.6 });
        reported.append(&mut bench.expired());
        assert!(!bench.results().contains(&"confirmed".into()));
    }
    assert_eq!(reported.len(), 1, "{reported:?}");
    assert!(reported[0].ends_with("the motor does not stop"), "{reported:?}");
    assert_eq!(bench.results(), ["acknowledged"]);
    assert!(bench.confirmations.is_empty());
}

#[test]
fn a_drive_that_was_not_read_since_is_not_said_to_run_on() {
    let mut bench = Bench::new();
    bench.speed(50.0);
    bench.set("run", Value::Bool(false));
    bench.now += Duration::from_secs(3);
    assert!(bench.expired().is_empty(), "nothing was read since");
    assert_eq!(bench.results(), ["acknowledged"], "nobody waits that long");
    bench.read(2100, &[0, 0, 0]);
    assert!(bench.expired().is_empty() && bench.confirmations.is_empty());

    bench.set("run", Value::Bool(true));
    bench.now += Duration::from_secs(3);
    bench.read(2100, &[0, 0, 0]);
    let reports = bench.expired();
    assert!(reports[0].ends_with("the motor does not run"), "{reports:?}");

    bench.set("run", Value::Bool(true));
    bench.now += Duration::from_secs(30);
    let reports = bench.expired();
    assert!(reports[0].contains("was not read within 10s"), "{reports:?}");
}

/// A busy line reads the motor in every round and the control word now and then.
#[test]
fn what_is_read_seldom_is_not_missing_before_it_was_read() {
    let order = |bench: &mut Bench, reverse: bool| {
        let points = [("run", true), ("reverse", reverse)];
        let index = |name: &str| bench.drive.spec.profile.point_index(name).unwrap();
        let values = points.map(|(name, on)| (index(name), Value::Bool(on)));
        bench.acknowledge(&Order::Points(values.to_vec()));
    };
    let mut bench = Bench::new();
    order(&mut bench, false);
    bench.read(2100, &[2]);
    bench.now += Duration::from_secs(3);
    assert!(bench.expired().is_empty(), "its direction was not read since");
    bench.now += Duration::from_secs(4);
    bench.read(2000, &[1]);
    assert!(bench.expired().is_empty() && bench.confirmations.is_empty());

    // What was read is told in time, and what is read later then.
    order(&mut bench, true);
    bench.read(2100, &[0]);
    bench.now += Duration::from_secs(2);
    let reports = bench.expired();
    assert!(reports[0].ends_with("within 2s: the motor does not run"), "{reports:?}");
    bench.now += Duration::from_secs(4);
    bench.read(2000, &[1]);
    let reports = bench.expired();
    assert!(
        reports[0].ends_with("within 6s: `reverse` does not read true"),
        "{reports:?}"
    );
    assert!(bench.confirmations.is_empty());

    // Never read: not known, once.
    order(&mut bench, true);
    bench.read(2100, &[2]);
    bench.now += Duration::from_secs(9);
    assert!(bench.expired().is_empty());
    bench.now += Duration::from_secs(2);
    let reports = bench.expired();
    assert!(reports[0].contains("was not read within 10s"), "{reports:?}");
    bench.now += Duration::from_secs(60);
    assert!(bench.expired().is_empty() && bench.confirmations.is_empty());
}

#[test]
fn while_the_motor_slows_down_nobody_waits_any_longer_and_nothing_is_told() {
    let mut bench = Bench::new();
    bench.speed(90.0);
    bench.set("run", Value::Bool(false));
    let since = bench.now;
    // 10 % a second: at zero after 9 s.
    loop {
        let passed = (bench.now - since).as_secs_f64();
        let speed = 90.0 - 10.0 * passed;
        if speed <= 0.5 {
            break;
        }
        bench.speed(speed);
        assert!(bench.expired().is_empty(), "at {speed} %");
        let in_time = bench.now - since < Duration::from_secs(2);
        let wanted: &[&str] = if in_time { &[] } else { &["acknowledged"] };
        assert_eq!(bench.results(), wanted, "after {passed} s");
    }
    bench.speed(0.0);
    assert!(bench.confirmations.is_empty(), "it stands");
    bench.now += Duration::from_secs(60);
    assert!(bench.expired().is_empty());
    assert_eq!(bench.results(), ["acknowledged"], "answered once");
}

#[test]
fn a_fall_that_ceases_above_zero_is_told() {
    let mut bench = Bench::new();
    bench.speed(90.0);
    bench.set("run", Value::Bool(false));
    let since = bench.now;
    let mut reported = Vec::new();
    let mut at = None;
    while bench.now < since + Duration::from_secs(12) {
        let passed = (bench.now - since).as_secs_f64();
        // It falls to 40 % within 5 s and stays there.
        bench.speed((90.0 - 10.0 * passed).max(40.0));
        reported.append(&mut bench.expired());
        if reported.len() == 1 {
            at.get_or_insert(bench.now - since);
        }
    }
    assert_eq!(reported.len(), 1, "{reported:?}");
    let at = at.unwrap().as_secs_f64();
    assert!(
        (6.9..7.1).contains(&at),
        "the profile's time after the fall ceased: {at} s"
    );
    assert_eq!(bench.results(), ["acknowledged"]);
}

#[test]
fn all_who_joined_a_stop_are_told_that_it_is_confirmed() {
    let mut bench = Bench::new();
    bench.speed(50.0);
    let (a, b) = (bench.receipt(), bench.receipt());
    let effects = effects(&bench.drive.spec.profile, &bench.order("run", Value::Bool(false)));
    let reading = bench.drive.reading(bench.now, Duration::from_secs(1));
    bench.confirmations.watch(effects, vec![a, b], &reading, bench.now);
    bench.read(2100, &[0]);
    assert_eq!(bench.results(), ["confirmed", "confirmed"]);
}

#[test]
fn references_and_raw_writes_are_read_back() {
    let mut bench = Bench::new();
    bench.set("speed_reference", Value::Number(33.333));
    bench.read(2002, &[0]);
    assert!(bench.results().is_empty());
    bench.read(2002, &[3333]);
    assert_eq!(bench.results(), ["confirmed"]);
    bench.acknowledge(&Order::Write(RequestPdu::WriteRegisters {
        start: 2000,
        values: vec![1, 0, 2000],
    }));
    bench.read(2000, &[1, 0, 2000]);
    assert_eq!(
        bench.results().len(),
        1,
        "the run bit was read back, the motor does not run yet"
    );
    bench.read(2100, &[2]);
    assert_eq!(bench.results(), ["confirmed", "confirmed"]);
}

#[test]
fn what_shows_too_late_is_not_confirmed() {
    let mut bench = Bench::new();
    bench.set("run", Value::Bool(true));
    bench.now += Duration::from_secs(2);
    bench.read(2100, &[2]);
    assert_eq!(bench.results(), ["acknowledged"]);
    assert!(bench.expired().is_empty(), "the first read since shows it");
}

#[test]
fn what_is_not_waited_for_any_more_stays_acknowledged() {
    let mut bench = Bench::new();
    bench.set("run", Value::Bool(true));
    bench.confirmations.clear();
    assert_eq!(bench.results(), ["acknowledged"]);
    bench.read(2100, &[2]);
    assert!(bench.expired().is_empty() && bench.results().len() == 1);
}

#[test]
fn what_does_not_show_is_told_once_and_what_was_overtaken_is_not() {
    let mut bench = Bench::new();
    bench.set("fault_reset", Value::Bool(true));
    bench.set("run", Value::Bool(true));
    bench.set("run", Value::Bool(false));
    assert_eq!(bench.results(), ["acknowledged"], "the stop overtook the run");
    bench.read(2100, &[8]);
    assert_eq!(bench.results(), ["acknowledged", "confirmed"], "it stands");
    bench.now += Duration::from_secs(2);
    let reported = bench.expired();
    assert_eq!(reported.len(), 1);
    assert_eq!(
        reported[0],
        "acknowledged it but did not show it within 2s: the fault is still active"
    );
    assert_eq!(bench.results(), ["acknowledged", "confirmed", "acknowledged"]);
    assert!(bench.expired().is_empty() && bench.confirmations.is_empty());
}

proptest! {
    /// Whatever a drive shows after a stop: it is confirmed only by a read that showed it not running or standing, and by any
    /// such read in time; else it stays acknowledged, reported at most once; and nothing is waited for without an end.
    #[test]
    fn a_stop_is_confirmed_or_told_or_neither(
        reads in proptest::collection::vec((1u64..900, any::<bool>(), 0u16..5_000), 1..60),
    ) {
        let mut bench = Bench::new();
        bench.speed(100.0);
        bench.set("run", Value::Bool(false));
        let since = bench.now;
        let (mut stood, mut stood_in_time, mut reported) = (false, false, Vec::new());
        for (pause, runs, output) in reads {
            let output = output.saturating_sub(250);
            bench.now += Duration::from_millis(pause);
            bench.read(2100, &[if runs { 2 } else { 0 }, 0, 2 * output, output]);
            let shows = !runs || output == 0;
            stood |= shows;
            stood_in_time |= shows && bench.now - since < Duration::from_secs(2);
            reported.append(&mut bench.expired());
            if shows {
                prop_assert!(bench.confirmations.is_empty());
            }
            let confirmed = bench.results() == ["confirmed"];
            prop_assert!(confirmed || !stood_in_time);
            prop_assert!(stood || !confirmed);
            prop_assert!(reported.is_empty() || (reported.len() == 1 && !confirmed));
        }
        // A fall ends some day.
        bench.now += Duration::from_secs(3);
        reported.append(&mut bench.expired());
        prop_assert!(bench.confirmations.is_empty() && reported.len() <= 1);
        prop_assert_eq!(bench.results().len(), 1);
    }
}

/// An HVX whose bypass is on: its drive stands, and its motor is on the mains.
#[test]
fn a_stop_is_not_confirmed_while_the_motor_may_be_fed_past_the_drive() {
    // Status: ready, running, bypass and fire mode.
    const RUNS: u16 = 0b0000_0000_0000_0011;
    const BYPASS: u16 = 1 << 6;
    const FIRE_MODE: u16 = 1 << 7;
    for (past, point) in [(BYPASS, "bypass_active"), (FIRE_MODE, "fire_mode_active")] {
        let mut bench = Bench::of("eaton-hvx");
        bench.read(2100, &[RUNS, 0]);
        bench.set("run", Value::Bool(false));
        let mut confirmation = bench.confirmation.take().unwrap();
        for _ in 0..600 {
            bench.read(2100, &[past, 0]);
        }
        assert_eq!(bench.results(), ["acknowledged"], "{point}");
        let why = confirmation.try_recv().unwrap().unwrap_err();
        assert!(why.contains(point), "{why}");
        let told = bench.expired();
        assert!(
            told.len() == 1 && told[0].contains("is unknown") && told[0].contains(point),
            "{told:?}"
        );
        let audited = audited(bench.stats.audit())[0]["text"].to_string();
        assert!(audited.contains(point), "{audited}");
    }
    let mut bench = Bench::of("eaton-hvx");
    bench.read(2100, &[RUNS, 0]);
    bench.set("run", Value::Bool(false));
    bench.read(2100, &[BYPASS, 0]);
    assert_eq!(bench.results(), [""; 0]);
    bench.read(2100, &[0, 0]);
    assert_eq!(bench.results(), ["confirmed"], "it is off in time");
}
