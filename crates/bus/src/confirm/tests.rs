use drivegate_testkit::{audited, controlled, online, ticket};
use std::sync::Arc;

use proptest::prelude::*;

use super::*;
use drivegate_core::order::{CommandLog, Outcome};
use drivegate_core::process_image::{DriveImage, DriveSpec};
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::{Reply, RequestPdu, Table};

struct CommandedDrive {
    drive: DriveImage,
    command_log: Arc<CommandLog>,
    confirmations: Confirmations,
    /// Confirmation of the command that was acknowledged last.
    confirmation: Option<tokio::sync::oneshot::Receiver<Result<Duration, String>>>,
    now: Instant,
}

impl CommandedDrive {
    fn new() -> CommandedDrive {
        CommandedDrive::of("vacon-nx")
    }

    fn of(profile: &str) -> CommandedDrive {
        let spec = DriveSpec {
            turnaround: Duration::ZERO,
            ..controlled("d", "b", 1, &drivegate_testkit::profile(profile))
        };
        let drive = DriveImage::new(spec, Duration::from_secs(1));
        online(&drive);
        let mut rig = CommandedDrive {
            drive,
            command_log: Arc::default(),
            confirmations: Confirmations::default(),
            confirmation: None,
            now: Instant::now(),
        };
        rig.read(2100, &[0]);
        rig
    }

    fn receipt(&mut self) -> Receipt {
        let (mut ticket, _) = ticket(&self.command_log, self.now);
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

    /// Stores these words as the drive's answer 10 ms later.
    fn read(&mut self, start: u16, words: &[u16]) {
        self.now += Duration::from_millis(10);
        let now = self.now;
        self.drive.update(|s| s.store(Table::Holding, start, words, now));
        let reading = self.drive.reading(now, Duration::from_secs(1));
        self.confirmations.take_reading(&reading, now);
    }

    fn results(&self) -> Vec<serde_json::Value> {
        audited(self.command_log.audit())
            .iter()
            .map(|r| r["result"].clone())
            .collect()
    }

    fn expired(&mut self) -> Vec<String> {
        let late = self.confirmations.expire(&self.drive.spec.profile, self.now);
        late.into_iter().map(|late| late.text).collect()
    }

    /// Sets the motor running at this speed; 100 % is 50 Hz.
    fn speed(&mut self, percent: f64) {
        let hundredths = |value: f64| (value * 100.0) as i16 as u16;
        self.read(2100, &[2, 0, hundredths(percent), hundredths(percent / 2.0)]);
    }
}

#[test]
fn only_a_read_after_the_acknowledgement_confirms() {
    let mut rig = CommandedDrive::new();
    rig.read(2100, &[2]);
    rig.set("run", Value::Bool(true));
    let reading_before = rig.drive.reading(rig.now, Duration::from_secs(1));
    let now = rig.now;
    rig.confirmations.take_reading(&reading_before, now);
    assert!(rig.results().is_empty(), "the old sample proves nothing");
    rig.read(2100, &[2]);
    assert_eq!(rig.results(), ["confirmed"]);
    assert_eq!(audited(rig.command_log.audit())[0]["confirmed_ms"], 10.0);
    assert!(rig.expired().is_empty());
}

#[test]
fn a_stop_is_confirmed_when_the_motor_does_not_run_or_stands() {
    for (words, confirmed) in [
        (&[2, 0, 4900, 2450][..], false),
        (&[2, 0, 99, 49], false),
        (&[2, 0, 0, 0], true),
        // The band is 10 to 50 Hz; the motor runs at its minimum, in either direction.
        (&[2, 0, 0, 1000], false),
        (&[2, 0, 0, 0_u16.wrapping_sub(1000)], false),
        (&[0, 0, 4000, 2000], true),
    ] {
        let mut rig = CommandedDrive::new();
        rig.speed(50.0);
        rig.set("run", Value::Bool(false));
        rig.read(2100, words);
        assert_eq!(!rig.results().is_empty(), confirmed, "{words:?}");
        if confirmed {
            assert_eq!(rig.results(), ["confirmed"]);
        }
    }
}

/// Below 10 Hz, the speed in percent of a band that begins at 10 Hz no longer shows the deceleration.
#[test]
fn below_the_minimum_frequency_the_motor_still_slows_down() {
    let mut rig = CommandedDrive::new();
    rig.read(2100, &[2, 0, 0, 1000]);
    rig.set("run", Value::Bool(false));
    for hundredths in (1..1000).rev() {
        rig.read(2100, &[2, 0, 0, hundredths]);
        assert!(rig.expired().is_empty(), "at {hundredths} x 0.01 Hz");
    }
    rig.read(2100, &[2, 0, 0, 0]);
    assert!(rig.confirmations.is_empty() && rig.expired().is_empty());
    assert_eq!(rig.results(), ["acknowledged"], "nobody waited for 10 s");
    let mut confirmation = rig.confirmation.take().unwrap();
    let told = confirmation.try_recv().unwrap().unwrap_err();
    // 2 s after the order, and 10 ms a read.
    assert_eq!(told, "the motor is still slowing down, 8 Hz");
}

/// Every way in which a family reports its motor and faults confirms its orders: a bit, a state of a word, or a coil.
#[test]
fn every_family_confirms_what_it_shows() {
    let shows_nothing = ["lenze-i550"];
    for profile in Profiles::built_in().iter() {
        let name = profile.name.as_str();
        let order = |point, value| {
            let index = profile.model_index(point)?;
            Some(effects(profile, &Order::Points(vec![(index, Value::Bool(value))])))
        };
        let expected = |effect| {
            if shows_nothing.contains(&name) {
                None
            } else {
                Some(vec![effect])
            }
        };
        assert_eq!(order(ModelPoint::Run, true), expected(Effect::Runs), "{name}");
        assert_eq!(order(ModelPoint::Run, false), expected(Effect::Stops), "{name}");
        // A stop of all drives is proven by one of these.
        let stands = [ModelPoint::ZeroSpeed, ModelPoint::OutputFrequency];
        let read = stands.into_iter().any(|point| profile.model_index(point).is_some());
        assert!(
            read || shows_nothing.contains(&name),
            "{name} does not show that it stands"
        );
        if let Some(effects) = order(ModelPoint::FaultReset, true) {
            assert_eq!(effects, [Effect::NoFault], "{name}");
        }
    }
}

#[test]
fn a_ripple_of_the_speed_does_not_confirm_a_stop_that_the_drive_ignores() {
    let mut rig = CommandedDrive::new();
    rig.speed(50.0);
    rig.set("run", Value::Bool(false));
    let mut reported = Vec::new();
    for round in 0..400 {
        rig.speed(if round % 2 == 0 { 49.4 } else { 50.6 });
        reported.append(&mut rig.expired());
        assert!(!rig.results().contains(&"confirmed".into()));
    }
    assert_eq!(reported.len(), 1, "{reported:?}");
    assert!(reported[0].ends_with("the motor does not stop"), "{reported:?}");
    assert_eq!(rig.results(), ["acknowledged"]);
    assert!(rig.confirmations.is_empty());
}

#[test]
fn a_drive_that_was_not_read_since_is_not_said_to_run_on() {
    let mut rig = CommandedDrive::new();
    rig.speed(50.0);
    rig.set("run", Value::Bool(false));
    rig.now += Duration::from_secs(3);
    assert!(rig.expired().is_empty(), "nothing was read since");
    assert_eq!(rig.results(), ["acknowledged"], "nobody waits that long");
    rig.read(2100, &[0, 0, 0]);
    assert!(rig.expired().is_empty() && rig.confirmations.is_empty());

    rig.set("run", Value::Bool(true));
    rig.now += Duration::from_secs(3);
    rig.read(2100, &[0, 0, 0]);
    let reports = rig.expired();
    assert!(reports[0].ends_with("the motor does not run"), "{reports:?}");

    rig.set("run", Value::Bool(true));
    rig.now += Duration::from_secs(30);
    let reports = rig.expired();
    assert!(reports[0].contains("was not read within 10s"), "{reports:?}");
}

/// A busy line reads the motor in every round and the control word now and then.
#[test]
fn what_is_read_seldom_is_not_missing_before_it_was_read() {
    let order = |rig: &mut CommandedDrive, reverse: bool| {
        let points = [("run", true), ("reverse", reverse)];
        let index = |name: &str| rig.drive.spec.profile.point_index(name).unwrap();
        let values = points.map(|(name, on)| (index(name), Value::Bool(on)));
        rig.acknowledge(&Order::Points(values.to_vec()));
    };
    let mut rig = CommandedDrive::new();
    order(&mut rig, false);
    rig.read(2100, &[2]);
    rig.now += Duration::from_secs(3);
    assert!(rig.expired().is_empty(), "its direction was not read since");
    rig.now += Duration::from_secs(4);
    rig.read(2000, &[1]);
    assert!(rig.expired().is_empty() && rig.confirmations.is_empty());

    // Effects that were read are reported in time, effects that are read later at that later time.
    order(&mut rig, true);
    rig.read(2100, &[0]);
    rig.now += Duration::from_secs(2);
    let reports = rig.expired();
    assert!(reports[0].ends_with("within 2s: the motor does not run"), "{reports:?}");
    rig.now += Duration::from_secs(4);
    rig.read(2000, &[1]);
    let reports = rig.expired();
    assert!(
        reports[0].ends_with("within 6s: `reverse` does not read true"),
        "{reports:?}"
    );
    assert!(rig.confirmations.is_empty());

    // The point was never read: the effect is reported as unknown, once.
    order(&mut rig, true);
    rig.read(2100, &[2]);
    rig.now += Duration::from_secs(9);
    assert!(rig.expired().is_empty());
    rig.now += Duration::from_secs(2);
    let reports = rig.expired();
    assert!(reports[0].contains("was not read within 10s"), "{reports:?}");
    rig.now += Duration::from_secs(60);
    assert!(rig.expired().is_empty() && rig.confirmations.is_empty());
}

#[test]
fn while_the_motor_slows_down_nobody_waits_any_longer_and_nothing_is_told() {
    let mut rig = CommandedDrive::new();
    rig.speed(90.0);
    rig.set("run", Value::Bool(false));
    let since = rig.now;
    // 10 % a second: at zero after 9 s.
    loop {
        let passed = (rig.now - since).as_secs_f64();
        let speed = 90.0 - 10.0 * passed;
        if speed <= 0.5 {
            break;
        }
        rig.speed(speed);
        assert!(rig.expired().is_empty(), "at {speed} %");
        let in_time = rig.now - since < Duration::from_secs(2);
        let wanted: &[&str] = if in_time { &[] } else { &["acknowledged"] };
        assert_eq!(rig.results(), wanted, "after {passed} s");
    }
    rig.speed(0.0);
    assert!(rig.confirmations.is_empty(), "it stands");
    rig.now += Duration::from_secs(60);
    assert!(rig.expired().is_empty());
    assert_eq!(rig.results(), ["acknowledged"], "answered once");
}

#[test]
fn a_fall_that_ceases_above_zero_is_told() {
    let mut rig = CommandedDrive::new();
    rig.speed(90.0);
    rig.set("run", Value::Bool(false));
    let since = rig.now;
    let mut reported = Vec::new();
    let mut at = None;
    while rig.now < since + Duration::from_secs(12) {
        let passed = (rig.now - since).as_secs_f64();
        // The speed falls to 40 % within 5 s and stays there.
        rig.speed((90.0 - 10.0 * passed).max(40.0));
        reported.append(&mut rig.expired());
        if reported.len() == 1 {
            at.get_or_insert(rig.now - since);
        }
    }
    assert_eq!(reported.len(), 1, "{reported:?}");
    let at = at.unwrap().as_secs_f64();
    assert!(
        (6.9..7.1).contains(&at),
        "the profile's time after the fall ceased: {at} s"
    );
    assert_eq!(rig.results(), ["acknowledged"]);
}

#[test]
fn all_who_joined_a_stop_are_told_that_it_is_confirmed() {
    let mut rig = CommandedDrive::new();
    rig.speed(50.0);
    let (a, b) = (rig.receipt(), rig.receipt());
    let effects = effects(&rig.drive.spec.profile, &rig.order("run", Value::Bool(false)));
    let reading = rig.drive.reading(rig.now, Duration::from_secs(1));
    rig.confirmations.watch(effects, vec![a, b], &reading, rig.now);
    rig.read(2100, &[0]);
    assert_eq!(rig.results(), ["confirmed", "confirmed"]);
}

#[test]
fn references_and_raw_writes_are_read_back() {
    let mut rig = CommandedDrive::new();
    rig.set("speed_reference", Value::Number(33.333));
    rig.read(2002, &[0]);
    assert!(rig.results().is_empty());
    rig.read(2002, &[3333]);
    assert_eq!(rig.results(), ["confirmed"]);
    rig.acknowledge(&Order::Write(RequestPdu::write_registers(2000, &[1, 0, 2000])));
    rig.read(2000, &[1, 0, 2000]);
    assert_eq!(
        rig.results().len(),
        1,
        "the run bit was read back, the motor does not run yet"
    );
    rig.read(2100, &[2]);
    assert_eq!(rig.results(), ["confirmed", "confirmed"]);
}

#[test]
fn what_shows_too_late_is_not_confirmed() {
    let mut rig = CommandedDrive::new();
    rig.set("run", Value::Bool(true));
    rig.now += Duration::from_secs(2);
    rig.read(2100, &[2]);
    assert_eq!(rig.results(), ["acknowledged"]);
    assert!(rig.expired().is_empty(), "the first read since shows it");
}

#[test]
fn what_is_not_waited_for_any_more_stays_acknowledged() {
    let mut rig = CommandedDrive::new();
    rig.set("run", Value::Bool(true));
    rig.confirmations.clear();
    assert_eq!(rig.results(), ["acknowledged"]);
    rig.read(2100, &[2]);
    assert!(rig.expired().is_empty() && rig.results().len() == 1);
}

#[test]
fn what_does_not_show_is_told_once_and_what_was_overtaken_is_not() {
    let mut rig = CommandedDrive::new();
    rig.set("fault_reset", Value::Bool(true));
    rig.set("run", Value::Bool(true));
    rig.set("run", Value::Bool(false));
    assert_eq!(rig.results(), ["acknowledged"], "the stop overtook the run");
    rig.read(2100, &[8]);
    assert_eq!(rig.results(), ["acknowledged", "confirmed"], "it stands");
    rig.now += Duration::from_secs(2);
    let reported = rig.expired();
    assert_eq!(reported.len(), 1);
    assert_eq!(
        reported[0],
        "acknowledged run=true but did not show it within 2s: the fault is still active"
    );
    assert_eq!(rig.results(), ["acknowledged", "confirmed", "acknowledged"]);
    assert!(rig.expired().is_empty() && rig.confirmations.is_empty());
}

proptest! {
    /// Property for any reports of a drive after a stop: the stop is confirmed only by a read that showed the drive
    /// not running or at standstill, and by any such read in time; otherwise it stays acknowledged, reported at
    /// most once; and no wait is endless.
    #[test]
    fn a_stop_is_confirmed_or_told_or_neither(
        reads in proptest::collection::vec((1u64..900, any::<bool>(), 0u16..5_000), 1..60),
    ) {
        let mut rig = CommandedDrive::new();
        rig.speed(100.0);
        rig.set("run", Value::Bool(false));
        let since = rig.now;
        let (mut stood, mut stood_in_time, mut reported) = (false, false, Vec::new());
        for (pause, runs, output) in reads {
            let output = output.saturating_sub(250);
            rig.now += Duration::from_millis(pause);
            rig.read(2100, &[if runs { 2 } else { 0 }, 0, 2 * output, output]);
            let shows = !runs || output == 0;
            stood |= shows;
            stood_in_time |= shows && rig.now - since < Duration::from_secs(2);
            reported.append(&mut rig.expired());
            if shows {
                prop_assert!(rig.confirmations.is_empty());
            }
            let confirmed = rig.results() == ["confirmed"];
            prop_assert!(confirmed || !stood_in_time);
            prop_assert!(stood || !confirmed);
            prop_assert!(reported.is_empty() || (reported.len() == 1 && !confirmed));
        }
        // The deceleration ends after some time.
        rig.now += Duration::from_secs(3);
        reported.append(&mut rig.expired());
        prop_assert!(rig.confirmations.is_empty() && reported.len() <= 1);
        prop_assert_eq!(rig.results().len(), 1);
    }
}

/// An HVX whose bypass is on: its drive has stopped, but its motor runs on the mains.
#[test]
fn a_stop_is_not_confirmed_while_the_motor_may_be_fed_past_the_drive() {
    // Status: ready, running, bypass and fire mode.
    const RUNS: u16 = 0b0000_0000_0000_0011;
    const BYPASS: u16 = 1 << 6;
    const FIRE_MODE: u16 = 1 << 7;
    for (past, point) in [(BYPASS, "bypass_active"), (FIRE_MODE, "fire_mode_active")] {
        let mut rig = CommandedDrive::of("eaton-hvx");
        rig.read(2100, &[RUNS, 0]);
        rig.set("run", Value::Bool(false));
        let mut confirmation = rig.confirmation.take().unwrap();
        for _ in 0..600 {
            rig.read(2100, &[past, 0]);
        }
        assert_eq!(rig.results(), ["acknowledged"], "{point}");
        let why = confirmation.try_recv().unwrap().unwrap_err();
        assert!(why.contains(point), "{why}");
        let told = rig.expired();
        assert!(
            told.len() == 1 && told[0].contains("is unknown") && told[0].contains(point),
            "{told:?}"
        );
        let audited = audited(rig.command_log.audit())[0]["text"].to_string();
        assert!(audited.contains(point), "{audited}");
    }
    let mut rig = CommandedDrive::of("eaton-hvx");
    rig.read(2100, &[RUNS, 0]);
    rig.set("run", Value::Bool(false));
    rig.read(2100, &[BYPASS, 0]);
    assert_eq!(rig.results(), [""; 0]);
    rig.read(2100, &[0, 0]);
    assert_eq!(rig.results(), ["confirmed"], "it is off in time");
}
