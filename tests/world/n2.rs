//! A bus with N2 boards: sessions, overrides, attributes of the boards.

use std::sync::Arc;
use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_core::order::Outcome;
use drivegate_model::drive::{ModelPoint, Profile, Quality, State, Value};
use drivegate_proto::{Exception, Protocol, n2};
use drivegate_sim::faults::FaultPlan;

use super::bus::Parts;
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

fn nx(drives: u8) -> Line {
    Line {
        // The drive reports its frequencies, so none are configured.
        spec: |spec| spec.frequency_range = None,
        ..line("vacon-nx-n2", Protocol::N2, 9600, drives)
    }
}

fn ready(drives: u8) -> Rig {
    let mut rig = Rig::of(&nx(drives));
    for address in 1..=drives {
        rig.until_state(address, State::Ready);
    }
    rig
}

/// The frames of the master as text.
fn requests(rig: &Rig) -> Vec<String> {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim_end().to_string();
    rig.requests().iter().map(|frame| text(&frame.bytes)).collect()
}

fn count(rig: &Rig, prefix: &str) -> usize {
    requests(rig).iter().filter(|frame| frame.starts_with(prefix)).count()
}

#[test]
fn a_drive_is_identified_drained_read_and_commanded() {
    let mut rig = ready(1);
    let begin = requests(&rig);
    assert_eq!(begin[..3], [">01FA7", ">0104C5", ">0105C6"]);
    assert!(begin.iter().position(|frame| frame.starts_with(">011")).unwrap() < 16);
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    assert!(rig.set(1, &[("speed_reference", 50.0), ("run", 1.0)]).is_ok());
    rig.until_good(1, ModelPoint::Running, Value::Bool(true));
    rig.until_good(1, ModelPoint::OutputFrequency, Value::Number(25.0));
    assert!(rig.set(1, &[("reverse", 1.0)]).is_ok());
    rig.until_good(1, ModelPoint::Reversed, Value::Bool(true));
    rig.with_drive(1, |drive, _| drive.trip(1));
    rig.until_good(1, ModelPoint::FaultCode, Value::Integer(1));
    assert_eq!(rig.state(1), State::Fault);
    assert!(rig.set(1, &[("fault_reset", 1.0)]).is_ok());
    rig.until_good(1, ModelPoint::Fault, Value::Bool(false));
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    rig.until_good(1, ModelPoint::Running, Value::Bool(false));
    let frames = requests(&rig);
    for frame in [">017203014248000020", ">017303018F", ">0172040101F0", ">0172040100EF"] {
        assert!(frames.iter().any(|f| f == frame), "{frame}");
    }
    let s = rig.bus.wire.statistics();
    assert_eq!((s.collisions, s.bad_crc, s.unanswered), (0, 0, 0));
}

#[test]
fn what_the_drive_has_already_is_not_written_again() {
    let mut rig = ready(1);
    for _ in 0..3 {
        assert!(rig.set(1, &[("speed_reference", 40.0)]).is_ok());
        assert!(rig.set(1, &[("run", 1.0)]).is_ok());
    }
    assert_eq!(count(&rig, ">01720301"), 1, "override of AO 1");
    assert_eq!(count(&rig, ">0172040101"), 1, "override of BO 1");
    for _ in 0..2 {
        assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    }
    assert_eq!(count(&rig, ">0172040100"), 2, "a stop is never left out");
    // A parameter of the class `once` that was changed at the panel meanwhile: it is read before it is written.
    let name = "acceleration_time";
    assert!(rig.set(1, &[(name, 7.0)]).is_ok());
    assert!(rig.set(1, &[(name, 7.0)]).is_ok());
    assert_eq!(count(&rig, ">01720305"), 1);
    rig.at_the_drive(1, 102, 90);
    assert!(rig.set(1, &[(name, 7.0)]).is_ok());
    assert_eq!(count(&rig, ">01720305"), 2);
}

/// A point of the class `once` is not polled again, so a command that has nothing to write there asks for its read.
#[test]
fn a_command_that_changes_nothing_is_confirmed() {
    let mut rig = ready(1);
    let mut events = rig.plant.events.subscribe();
    for _ in 0..2 {
        assert!(rig.set(1, &[("acceleration_time", 7.0)]).is_ok());
        rig.until("a confirmed command", Duration::from_secs(5), |rig| {
            rig.bus.core.remains(rig.now).unconfirmed == 0
        });
    }
    rig.run(PATIENCE);
    let told = std::iter::from_fn(|| events.try_recv().ok());
    let missing: Vec<_> = told.filter(|event| event.kind == EventKind::NotConfirmed).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn what_was_changed_at_the_drive_is_written_again() {
    let mut rig = ready(1);
    assert!(rig.set(1, &[("speed_reference", 25.0)]).is_ok());
    assert!(rig.set(1, &[("run", 1.0)]).is_ok());
    for turn in 1..=3 {
        rig.until_good(1, ModelPoint::SpeedReference, Value::Number(25.0));
        rig.until_good(1, ModelPoint::Running, Value::Bool(true));
        // The gateway cannot have read this change before the command.
        rig.at_the_drive(1, 2002, 7700);
        assert!(rig.set(1, &[("speed_reference", 25.0)]).is_ok());
        assert_eq!(rig.word(1, 2002), 2500, "turn {turn}");
        rig.at_the_drive(1, 2000, 0);
        assert!(rig.set(1, &[("run", 1.0)]).is_ok());
        assert_eq!(count(&rig, ">0172040101"), 1 + turn, "override of BO 1");
    }
}

#[test]
fn a_drive_that_starts_anew_in_mid_run() {
    let mut rig = ready(1);
    assert!(rig.set(1, &[("speed_reference", 50.0), ("run", 1.0)]).is_ok());
    rig.until_good(1, ModelPoint::Running, Value::Bool(true));
    let mut events = rig.plant.events.subscribe();
    let now = rig.bus.sim(rig.now);
    rig.bus.wire.slaves().board(1).unwrap().restart(now);
    rig.until("it is identified again", PATIENCE, |rig| count(rig, ">01F") >= 2);
    let mut reported = || std::iter::from_fn(|| events.try_recv().ok()).any(|e| e.kind == EventKind::Restarted);
    assert!(reported());
    let before = count(&rig, ">01110203");
    rig.until("values are read again", PATIENCE, |rig| {
        count(rig, ">01110203") > before + 2
    });
    rig.until_good(1, ModelPoint::OutputFrequency, Value::Number(25.0));
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    assert!(rig.is_online(0));
    // The supply fails for less time than it takes to be noticed.
    let identified = count(&rig, ">01F");
    rig.with_drive(1, |drive, now| {
        drive.power_off();
        drive.power_on(now);
    });
    rig.until("it waits for Identify once more", PATIENCE, |rig| {
        count(rig, ">01F") > identified
    });
    assert!(reported());
}

#[test]
fn a_profile_of_what_is_read_once_and_a_device_of_another_type() {
    let text = r#"
name = "names-only"
title = "What is read once"
protocols = ["n2"]
[n2]
poll = "1s"
device_type = 0x12
[[range]]
table = "input"
first = 2
last = 3
read = 2
[[point]]
name = "output_frequency"
at = "input 2"
type = "f32"
class = "once"
"#;
    let line = nx(1);
    let mut parts = Parts::of(0, &line, 5);
    parts.profile = Arc::new(Profile::parse("once.toml", text, false).unwrap());
    let mut rig = Rig::recorded(&line, parts);
    rig.until_good(1, ModelPoint::OutputFrequency, Value::Number(0.0));
    let mut reported = rig.plant.events.recent();
    reported.retain(|event| event.kind == EventKind::UnlikeProfile);
    assert_eq!(reported.len(), 1);
    assert!(reported[0].text.contains("type 10h") && reported[0].text.contains("expects 12h"));
    let before = count(&rig, ">0104");
    let polled = |rig: &Rig| count(rig, ">0104") > before + 2;
    rig.until("it is polled though nothing is read", PATIENCE, polled);
    rig.set_alive(1, false);
    rig.until("and missed", PATIENCE, |rig| !rig.is_online(0));
}

#[test]
fn both_forms_of_replies_and_what_is_no_number() {
    let mut rig = Rig::of(&nx(1));
    rig.bus.wire.slaves().board(1).unwrap().options.leading_byte = true;
    rig.until_state(1, State::Ready);
    rig.until_good(1, ModelPoint::OutputFrequency, Value::Number(0.0));
    let current = |rig: &Rig| rig.sample(1, ModelPoint::MotorCurrent);
    rig.until("the current is good", PATIENCE, |rig| {
        current(rig).quality == Quality::Good
    });
    for no_number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        // The bus overrides the AI with NaN or infinity.
        let (region, number) = (n2::Region::Ai, 6);
        let command = n2::Command::Override {
            object: n2::Object { region, number },
            data: no_number.to_be_bytes().to_vec(),
        };
        let now = rig.bus.sim(rig.now);
        let board = rig.bus.wire.slaves().board(1).unwrap();
        board.answer(&Ok(command), now, &mut |_| None, &mut Vec::new());
        rig.until("no number is bad", PATIENCE, |rig| {
            current(rig).quality == Quality::Bad && current(rig).value.is_none()
        });
    }
}

#[test]
fn a_dead_drive_is_probed_by_identify_and_comes_back() {
    let mut rig = ready(2);
    rig.set_alive(2, false);
    rig.until("one is offline", PATIENCE, |rig| {
        rig.state(2) == State::Offline && !rig.is_online(1)
    });
    rig.bus.wire.record(10_000);
    rig.until("it is probed", PATIENCE, |rig| count(rig, ">02F") >= 1);
    assert_eq!(count(&rig, ">02"), count(&rig, ">02F"));
    // Reads of this drive look like unanswered reads of the silent one: they wait until no late reply can arrive.
    rig.until_state(1, State::Ready);
    rig.set_alive(2, true);
    rig.until_state(2, State::Ready);
}

#[test]
fn what_means_no_object_and_what_the_drive_refuses() {
    let mut rig = ready(1);
    assert_eq!(rig.read(1, 1, 2), Outcome::Exception(Exception::ADDRESS));
    assert_eq!(rig.read(1, 0, 4), Outcome::Exception(Exception::ADDRESS));
    assert_eq!(rig.read(1, 98, 2), Outcome::Exception(Exception::N2(0x10)));
    assert!(rig.read(1, 0, 2).is_ok());
}

/// The longest time without a good state of a drive, from now on.
fn longest_without_state(rig: &mut Rig, address: u8, time: Duration) -> Duration {
    let until = rig.now + time;
    let (mut known, mut longest) = (rig.now, Duration::ZERO);
    while rig.step(until).is_some() {
        if rig.drive(address).reading(rig.now).overall() == Quality::Good {
            known = rig.now;
        }
        longest = longest.max(rig.now - known);
    }
    longest
}

/// The share of checks, one every 10 ms, in which the state of the first drive is known.
fn known_state(drives: u8, rates: &str) -> f64 {
    let mut rig = ready(drives);
    rig.set_faults(FaultPlan::new(rates.parse().unwrap(), 7));
    let looks = 60_000;
    let mut known = 0;
    for _ in 0..looks {
        rig.run(Duration::from_millis(10));
        let reading = rig.drive(1);
        let reading = reading.reading(rig.now);
        known += u32::from(reading.overall() == Quality::Good);
    }
    f64::from(known) / f64::from(looks)
}

#[test]
fn the_state_of_a_drive_that_started_anew_is_known_within_a_second() {
    for address in 1..=2 {
        let mut rig = ready(2);
        rig.run(Duration::from_secs(20));
        let now = rig.bus.sim(rig.now);
        rig.bus.wire.slaves().board(address).unwrap().restart(now);
        let without = longest_without_state(&mut rig, address, Duration::from_secs(20));
        assert!(without <= Duration::from_secs(1), "drive {address}: {without:?}");
        let other = longest_without_state(&mut rig, 3 - address, Duration::from_secs(20));
        assert!(other <= Duration::from_secs(1), "the other: {other:?}");
    }
}

#[test]
fn the_state_of_a_drive_that_is_back_is_known_within_a_second() {
    for away in [50, 300, 800, 3_000, 20_000].map(Duration::from_millis) {
        let mut rig = ready(2);
        rig.run(Duration::from_secs(20));
        rig.set_alive(1, false);
        rig.run(away);
        rig.set_alive(1, true);
        let asked = count(&rig, ">01");
        rig.until("it is asked", PATIENCE, |rig| count(rig, ">01") > asked);
        let known = |rig: &Rig| rig.drive(1).reading(rig.now).overall() == Quality::Good;
        let after = rig.until("its state is known", PATIENCE, known);
        assert!(after <= Duration::from_secs(1), "away {away:?}: {after:?}");
    }
}

#[test]
fn the_state_is_mostly_known_on_a_line_that_loses_a_sixth_of_all_replies() {
    let rates = "drop=0.09,corrupt=0.09";
    for (drives, least) in [(1, 0.7), (2, 0.45)] {
        let share = known_state(drives, rates);
        assert!(share >= least, "{drives} drives: {share:.3}");
    }
}

#[test]
fn a_reset_takes_the_run_command_away_once() {
    for (order, stops) in [
        (&[("fault_reset", 1.0)][..], 1),
        (&[("run", 0.0), ("fault_reset", 1.0)], 1),
    ] {
        let mut rig = ready(1);
        assert!(rig.set(1, &[("speed_reference", 50.0), ("run", 1.0)]).is_ok());
        rig.until_good(1, ModelPoint::Running, Value::Bool(true));
        rig.with_drive(1, |drive, _| drive.trip(1));
        rig.until_good(1, ModelPoint::FaultCode, Value::Integer(1));
        let before = count(&rig, ">0172040100");
        assert!(rig.set(1, order).is_ok());
        rig.run(Duration::from_secs(10));
        assert_eq!(count(&rig, ">0172040100") - before, stops, "{order:?}");
        assert_eq!(rig.good(1, ModelPoint::Fault), Some(Value::Bool(false)));
    }
}
