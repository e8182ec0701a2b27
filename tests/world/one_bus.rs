//! A bus and its clients: frames, commands, faults, leases, parameters, a port that disappears and returns.

use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_core::order::{Authority, Order, Origin, Outcome, Refusal, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_core::process_image::{Access, LeaseAction, Supervision};
use drivegate_model::drive::{ModelPoint, Quality, State, Value};
use drivegate_proto::{Exception, Protocol, RequestPdu};
use drivegate_sim::faults::{Fault, FaultPlan};
use drivegate_sim::nx::NxOptions;
use drivegate_sim::simulated_drive::ModelOptions;
use drivegate_sim::statistics::Recorded;

use super::bus::Parts;
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

fn nx(baud: u32, drives: u8) -> Line {
    line("vacon-nx", Protocol::ModbusRtu, baud, drives)
}

fn ready(line: &Line) -> Rig {
    let mut rig = Rig::of(line);
    for address in 1..=line.drives {
        rig.until_state(address, State::Ready);
    }
    rig
}

fn hex(frame: &Recorded) -> String {
    let text: Vec<String> = frame.bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    text.join(" ")
}

fn supervised(action: LeaseAction, timeout: Duration) -> Option<Supervision> {
    let adopt = false;
    Some(Supervision { timeout, action, adopt })
}

#[test]
fn the_frames_on_the_line_are_those_of_the_reference() {
    let mut rig = ready(&nx(38_400, 1));
    assert!(rig.set(1, &[("speed_reference", 50.0)]).is_ok());
    assert!(rig.set(1, &[("run", 1.0)]).is_ok());
    rig.until_good(1, ModelPoint::AtReference, Value::Bool(true));
    assert_eq!(rig.good(1, ModelPoint::OutputFrequency), Some(Value::Number(25.0)));
    assert_eq!(rig.good(1, ModelPoint::ActualSpeed), Some(Value::Number(50.0)));
    assert!(rig.set(1, &[("run", 1.0), ("reverse", 1.0)]).is_ok());
    assert!(rig.set(1, &[("speed_reference", -50.0)]).is_ok());
    assert!(rig.set(1, &[("run", 0.0), ("reverse", 0.0)]).is_ok());
    rig.until_state(1, State::Ready);
    assert!(rig.set(1, &[("fault_reset", 1.0)]).is_ok());
    let requests = rig.requests();
    let last = |frame: &str| requests.iter().rev().find(|request| hex(request) == frame);
    // reference/drives.md 7.1 and 7.4, misprints corrected.
    for (meaning, frame) in [
        ("read 2101..2111", "01 03 08 34 00 0B 47 A3"),
        ("read 42001..42003", "01 03 07 D0 00 03 05 46"),
        ("reference 50 %", "01 06 07 D2 13 88 25 D1"),
        ("run", "01 06 07 D0 00 01 48 87"),
        ("run reverse", "01 06 07 D0 00 03 C9 46"),
        ("reference -50 %", "01 06 07 D2 EC 78 64 65"),
        ("stop", "01 06 07 D0 00 00 89 47"),
        ("fault reset", "01 06 07 D0 00 04 88 84"),
    ] {
        assert!(last(frame).is_some(), "{meaning}: {frame} was not on the line");
    }
    let (high, low) = (last("01 06 07 D0 00 04 88 84"), last("01 06 07 D0 00 00 89 47"));
    let held = low.unwrap().start - high.unwrap().end;
    assert!(held >= Duration::from_millis(20), "two update periods: {held:?}");
    let s = rig.bus.wire.statistics();
    assert_eq!((s.silence_violations, s.collisions, s.bad_crc), (0, 0, 0));
}

#[test]
fn a_fault_is_told_and_reset() {
    // A lease is configured, because a missing one would be reported.
    let mut rig = ready(&Line {
        supervision: supervised(LeaseAction::LeaveRunning, PATIENCE),
        ..nx(115_200, 1)
    });
    let mut events = rig.plant.events.subscribe();
    rig.with_drive(1, |drive, _| drive.trip(1));
    rig.until_state(1, State::Fault);
    assert_eq!(rig.good(1, ModelPoint::FaultCode), Some(Value::Integer(1)));
    let event = events.try_recv().unwrap();
    assert_eq!((event.kind, event.fault_code), (EventKind::Fault, Some(1)));
    assert!(event.text.contains("overcurrent"), "{}", event.text);
    assert!(rig.set(1, &[("fault_reset", 1.0)]).is_ok());
    rig.until_state(1, State::Ready);
    assert_eq!(events.try_recv().unwrap().kind, EventKind::FaultEnd);
}

#[test]
fn a_motor_that_was_stopped_elsewhere_is_not_started_by_a_command_that_does_not_name_run() {
    let mut rig = ready(&nx(38_400, 1));
    let address = 2000;
    for (points, left) in [(("reverse", 1.0), 2), (("fault_reset", 1.0), 0), (("reverse", 1.0), 2)] {
        assert!(rig.set(1, &[("run", 1.0), ("reverse", 0.0)]).is_ok());
        rig.until_state(1, State::Running);
        // The gateway cannot have read this change before the command.
        rig.at_the_drive(1, address, 0);
        rig.bus.wire.record(1_000);
        assert!(rig.set(1, &[points]).is_ok());
        assert_eq!(rig.word(1, address), left, "{points:?}");
        let written: Vec<String> = rig.requests().iter().map(hex).collect();
        let runs = |frame: &&String| frame.starts_with("01 06 07 D0 00 0") && "1357".contains(&frame[16..17]);
        assert_eq!(written.iter().find(runs), None, "{points:?}");
    }
}

#[test]
fn a_dead_drive_is_stale_at_once_and_comes_back() {
    let mut rig = ready(&nx(115_200, 2));
    rig.set_alive(2, false);
    rig.until_state(2, State::Offline);
    assert_eq!(rig.sample(2, ModelPoint::OutputFrequency).quality, Quality::Stale);
    assert_eq!(rig.state(1), State::Ready);
    assert_eq!(rig.set(2, &[("run", 1.0)]), Outcome::Offline);
    rig.set_alive(2, true);
    rig.until_state(2, State::Ready);
}

#[test]
fn after_a_replug_everything_is_read_and_nothing_written() {
    let mut rig = Rig::of(&nx(115_200, 2));
    let all_read = |rig: &Rig| {
        [1, 2]
            .iter()
            .all(|drive| rig.good(*drive, ModelPoint::FrequencyReference).is_some())
    };
    rig.until("both drives are read", PATIENCE, all_read);
    assert!(rig.set(1, &[("speed_reference", 20.0), ("run", 1.0)]).is_ok());
    rig.until_state(1, State::Running);
    // The third time, the first exchange also has a fault.
    for lost in [false, false, true] {
        rig.bus.set_open(false, rig.now);
        for address in [1, 2] {
            assert_eq!(rig.sample(address, ModelPoint::OutputFrequency).quality, Quality::Stale);
            assert_eq!(rig.state(address), State::Offline);
        }
        assert_eq!(rig.set(1, &[("run", 1.0)]), Outcome::BusDown);
        rig.bus.wire.record(10_000);
        if lost {
            rig.set_faults(FaultPlan::default().on_request(1, Fault::Drop));
        }
        rig.bus.set_open(true, rig.now);
        rig.until("all is good again", PATIENCE, all_read);
        rig.until_state(1, State::Running);
        let mut once = [0, 0];
        for request in rig.requests() {
            assert_eq!(request.bytes[1], 3, "nothing is written: {request}");
            // Parameters 101..=104 are read once.
            if request.bytes[2..4] == [0, 100] {
                once[usize::from(request.bytes[0]) - 1] += 1;
            }
        }
        assert_eq!(once, [1, 1], "what is read once is read once more");
    }
    assert_eq!(rig.good(1, ModelPoint::SpeedReference), Some(Value::Number(20.0)));
}

#[test]
fn a_stop_overtakes_and_purges() {
    let mut rig = ready(&nx(9_600, 4));
    let mut placed: Vec<_> = [("speed_reference", 10.0), ("run", 1.0)]
        .iter()
        .cycle()
        .take(20)
        .map(|point| {
            let order = rig.points(1, &[*point]);
            rig.place(1, order)
        })
        .collect();
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    for order in &mut placed {
        let outcome = rig.answered(order);
        assert!(matches!(outcome, Outcome::Purged | Outcome::Replaced), "{outcome:?}");
    }
    rig.run(PATIENCE);
    assert_eq!(rig.good(1, ModelPoint::Running), Some(Value::Bool(false)));
}

#[test]
fn a_lease_that_runs_out_stops_the_drive_once() {
    let mut rig = ready(&Line {
        supervision: supervised(LeaseAction::Stop, Duration::from_millis(300)),
        ..nx(115_200, 1)
    });
    let mut events = rig.plant.events.subscribe();
    assert!(rig.set(1, &[("speed_reference", 20.0), ("run", 1.0)]).is_ok());
    rig.until_state(1, State::Running);
    rig.until_state(1, State::Ready);
    rig.run(PATIENCE);
    let events = std::iter::from_fn(|| events.try_recv().ok());
    assert_eq!(events.filter(|event| event.kind == EventKind::Supervision).count(), 1);
}

/// Whatever the drive answers to the read of its running state, the lease acts, and the result is reported.
#[test]
fn a_lease_acts_whatever_the_drive_answers_when_it_is_asked_whether_it_runs() {
    for fault in ["busy=1", "exception:4=1", "exception:5=1", "exception:8=1"] {
        let mut rig = ready(&Line {
            supervision: supervised(LeaseAction::Stop, Duration::from_secs(1)),
            ..line("vacon-cx", Protocol::ModbusRtu, 19_200, 1)
        });
        let mut events = rig.plant.events.subscribe();
        assert!(rig.set(1, &[("frequency_reference", 20.0), ("run", 1.0)]).is_ok());
        rig.until_state(1, State::Running);
        rig.set_faults(FaultPlan::new(fault.parse().unwrap(), 1));
        rig.run(Duration::from_secs(12));
        let told: Vec<EventKind> = std::iter::from_fn(|| events.try_recv().ok())
            .map(|event| event.kind)
            .collect();
        let count = |kind: EventKind| told.iter().filter(|told| **told == kind).count();
        // One event reports that the running state is unknown, the other that the lease expired.
        assert!((1..=2).contains(&count(EventKind::Supervision)), "{fault}: {told:?}");
        assert!(
            (1..=3).contains(&count(EventKind::SupervisionFailed)),
            "{fault}: {told:?}"
        );
        assert_eq!(count(EventKind::Offline), 0, "{fault}: it answers");
        let failures = rig.plant.buses[0].image.drives[0].supervision_failures();
        assert!(failures >= 3, "{fault}: {failures} tries are counted");
        rig.set_faults(FaultPlan::default());
        rig.until_state(1, State::Ready);
    }
}

#[test]
fn a_drive_for_which_only_a_gateway_answers_is_offline() {
    for fault in ["exception:10=1", "exception:11=1"] {
        let mut rig = ready(&nx(115_200, 1));
        rig.set_faults(FaultPlan::new(fault.parse().unwrap(), 1));
        rig.until_state(1, State::Offline);
        let stop = rig.set(1, &[("run", 0.0)]);
        assert_eq!(stop.code(), "unknown", "{fault}");
        rig.set_faults(FaultPlan::default());
        rig.until_state(1, State::Ready);
    }
}

#[test]
fn commands_are_checked_against_the_drive() {
    let mut rig = Rig::of(&nx(115_200, 1));
    let known = |rig: &Rig| rig.good(1, ModelPoint::FrequencyReference).is_some();
    rig.until("the frequency range", PATIENCE, known);
    let outcome = rig.set(1, &[("speed_reference", 101.0)]);
    assert!(matches!(outcome, Outcome::Refused(_)), "{outcome:?}");
    assert!(rig.set(1, &[("frequency_reference", 30.0)]).is_ok());
    rig.until_good(1, ModelPoint::SpeedReference, Value::Number(60.0));
    assert_eq!(rig.good(1, ModelPoint::FrequencyReference), Some(Value::Number(30.0)));
    let unknown = rig.read(1, 6000, 5);
    assert_eq!(unknown, Outcome::Exception(Exception::ADDRESS));
}

/// 50 Hz are all of 50 Hz and half of 100 Hz.
#[test]
fn a_maximum_frequency_changed_at_the_panel_is_followed() {
    /// Maximum frequency, ID 102, 0.01 Hz; PDU address.
    const MAXIMUM_FREQUENCY: u16 = 101;
    let mut rig = ready(&Line {
        spec: |spec| {
            spec.limits.insert("frequency_reference".to_string(), 0.0..=50.0);
        },
        ..nx(38_400, 1)
    });
    let until = |rig: &mut Rig, maximum| {
        let known = |rig: &Rig| rig.value(1, "maximum_frequency") == Some(Value::Number(maximum));
        rig.until("the maximum frequency", PATIENCE, known);
    };
    until(&mut rig, 50.0);
    assert!(rig.set(1, &[("frequency_reference", 50.0)]).is_ok());
    rig.until_good(1, ModelPoint::SpeedReference, Value::Number(100.0));
    rig.at_the_drive(1, MAXIMUM_FREQUENCY, 10_000);
    until(&mut rig, 100.0);
    for beyond in [("frequency_reference", 50.5), ("speed_reference", 50.5)] {
        let outcome = rig.set(1, &[beyond]);
        let refused = matches!(outcome, Outcome::Refused(Refusal::BadValue(_)));
        assert!(refused, "{beyond:?}: {outcome:?}");
    }
    assert!(rig.set(1, &[("frequency_reference", 50.0)]).is_ok());
    rig.until_good(1, ModelPoint::SpeedReference, Value::Number(50.0));
}

/// The percentage counts from the minimum frequency, and its sign reverses the motor: the published value matches
/// the motor.
#[test]
fn a_minimum_frequency_is_that_of_either_direction() {
    /// Minimum frequency, ID 101, 0.01 Hz; PDU address.
    const MINIMUM_FREQUENCY: u16 = 100;
    let mut rig = ready(&nx(38_400, 1));
    rig.at_the_drive(1, MINIMUM_FREQUENCY, 1_000);
    let known = |rig: &Rig| rig.value(1, "minimum_frequency") == Some(Value::Number(10.0));
    rig.until("the minimum frequency", PATIENCE, known);
    assert!(rig.set(1, &[("run", 1.0), ("speed_reference", 0.0)]).is_ok());
    for hertz in [10.0, 30.0, -30.0, 50.0, -20.0] {
        assert!(rig.set(1, &[("frequency_reference", hertz)]).is_ok(), "{hertz} Hz");
        rig.until_good(1, ModelPoint::OutputFrequency, Value::Number(hertz));
        rig.until_good(1, ModelPoint::FrequencyReference, Value::Number(hertz));
    }
    for hertz in [0.0, 5.0, -5.0, -10.0] {
        let outcome = rig.set(1, &[("frequency_reference", hertz)]);
        let refused = matches!(outcome, Outcome::Refused(Refusal::BadValue(_)));
        assert!(refused, "{hertz} Hz: {outcome:?}");
    }
    for (percent, hertz) in [(0.0, 10.0), (-50.0, -30.0)] {
        assert!(rig.set(1, &[("speed_reference", percent)]).is_ok(), "{percent} %");
        rig.until_good(1, ModelPoint::FrequencyReference, Value::Number(hertz));
        rig.until_good(1, ModelPoint::OutputFrequency, Value::Number(hertz));
    }
}

/// A reference in Hz, or one within a limit in Hz, depends on the frequency range that the drive has when it gets
/// the command: neither on one that the command itself changes, nor on one that an earlier command changed and that
/// has not been read since.
#[test]
fn no_command_rests_on_a_frequency_range_that_was_changed() {
    let of = |profile: &'static str| Line {
        spec: |spec| {
            let limits = 0.0..=40.0;
            spec.limits.insert("frequency_reference".to_string(), limits);
        },
        ..line(profile, Protocol::N2, 19_200, 1)
    };
    for (line, reference) in [
        (of("vacon-nx-n2"), ("frequency_reference", 30.0)),
        (of("vacon-nx-n2"), ("speed_reference", 60.0)),
        (of("eaton-hvx-n2"), ("speed_reference", 60.0)),
    ] {
        let mut rig = ready(&line);
        let known = |hertz: f64| move |rig: &Rig| rig.value(1, "maximum_frequency") == Some(Value::Number(hertz));
        rig.until("the maximum frequency", PATIENCE, known(50.0));
        let both = rig.set(1, &[("maximum_frequency", 60.0), reference]);
        assert!(
            matches!(&both, Outcome::Refused(Refusal::BadValue(why)) if why.contains("first")),
            "{both:?}"
        );
        assert!(rig.set(1, &[reference]).is_ok());
        rig.until_good(1, ModelPoint::SpeedReference, Value::Number(60.0));
        let range = rig.points(1, &[("maximum_frequency", 60.0)]);
        let mut range = rig.place(1, range);
        // The reference waits behind the change of the range, and is refused until the range was read. A stop is
        // not affected.
        let behind = rig.points(1, &[reference]);
        let mut behind = rig.place_as("other", 1, behind);
        let written = rig.answered(&mut range);
        assert!(written.is_ok(), "{written:?}");
        let outcome = rig.answered(&mut behind);
        assert!(matches!(outcome, Outcome::Refused(Refusal::NotKnown(_))), "{outcome:?}");
        let again = rig.set(1, &[reference]);
        assert!(matches!(again, Outcome::Refused(_)), "{again:?}");
        let stop = rig.set(1, &[("run", 0.0)]);
        assert!(stop.is_ok(), "{stop:?}");
        rig.until("the new maximum frequency", PATIENCE, known(60.0));
        let again = rig.set(1, &[reference]);
        assert!(again.is_ok(), "{reference:?}: {again:?}");
        let above = rig.set(1, &[("speed_reference", 70.0)]);
        assert!(
            matches!(above, Outcome::Refused(Refusal::BadValue(_))),
            "42 Hz: {above:?}"
        );
    }
}

/// 80 % of 50 Hz are within a limit of 40 Hz, 80 % of 100 Hz are not. Whatever is ordered, in whatever sequence,
/// the drive never gets a reference above the limit.
#[test]
fn the_reference_that_stands_keeps_its_limit_when_the_frequency_range_changes() {
    let of = |profile: &'static str| Line {
        spec: |spec| {
            spec.limits.insert("frequency_reference".to_string(), 0.0..=40.0);
        },
        ..line(profile, Protocol::N2, 19_200, 1)
    };
    for profile in ["vacon-nx-n2", "eaton-hvx-n2"] {
        let mut rig = ready(&of(profile));
        let known = |hertz: f64| move |rig: &Rig| rig.value(1, "maximum_frequency") == Some(Value::Number(hertz));
        rig.until("the maximum frequency", PATIENCE, known(50.0));
        rig.until_good(1, ModelPoint::SpeedReference, Value::Number(0.0));
        // Both orders are in the queue: when the range is written, the reference that was read is no longer the one
        // in force.
        let reference = rig.points(1, &[("speed_reference", 80.0)]);
        let mut reference = rig.place(1, reference);
        let range = rig.points(1, &[("maximum_frequency", 100.0)]);
        let mut range = rig.place_as("other", 1, range);
        assert!(rig.answered(&mut reference).is_ok());
        let outcome = rig.answered(&mut range);
        assert!(matches!(outcome, Outcome::Refused(Refusal::NotKnown(_))), "{outcome:?}");
        rig.until_good(1, ModelPoint::SpeedReference, Value::Number(80.0));
        let outcome = rig.set(1, &[("maximum_frequency", 100.0)]);
        assert!(
            matches!(&outcome, Outcome::Refused(Refusal::BadValue(why)) if why.contains("80 Hz")),
            "{outcome:?}"
        );
        let pdu = RequestPdu::WriteRegisters {
            start: 6,
            values: vec![0x42C8, 0],
        };
        let outcome = rig.ordered(1, Order::Write(pdu));
        assert!(matches!(outcome, Outcome::Refused(Refusal::BadValue(_))), "{outcome:?}");
        assert!(rig.set(1, &[("speed_reference", 40.0)]).is_ok());
        rig.until_good(1, ModelPoint::SpeedReference, Value::Number(40.0));
        assert!(rig.set(1, &[("maximum_frequency", 100.0)]).is_ok());
    }
}

#[test]
fn a_garbled_answer_is_told_apart_from_silence() {
    let mut rig = ready(&nx(38_400, 1));
    for (fault, outcome, code) in [
        ("corrupt=1", Outcome::Garbled, Exception::DEVICE_FAILURE),
        ("truncate=1", Outcome::Garbled, Exception::DEVICE_FAILURE),
        ("deaf=1", Outcome::TimedOut, Exception::GATEWAY_TARGET),
    ] {
        rig.until_state(1, State::Ready);
        rig.set_faults(FaultPlan::new(fault.parse().unwrap(), 1));
        let reported = rig.set(1, &[("speed_reference", 20.0)]);
        assert_eq!((reported.exception(), &reported), (Some(code), &outcome), "{fault}");
        rig.set_faults(FaultPlan::default());
    }
}

#[test]
fn a_drive_that_nothing_stops_is_told_once() {
    /// Parameter P2.7.22 of the drive.
    const FIELDBUS_FAULT_RESPONSE: u16 = 733;
    for (access, lease, response, wanted) in [
        (Access::Control, false, 0, 1),
        (Access::Control, true, 0, 0),
        (Access::Control, false, 2, 0),
        (Access::Monitor, false, 0, 0),
    ] {
        let line = Line {
            supervision: supervised(LeaseAction::Stop, PATIENCE).filter(|_| lease),
            spec: match access {
                Access::Control => |_| {},
                Access::Monitor | Access::Listen => |spec| spec.access = Access::Monitor,
            },
            ..nx(115_200, 1)
        };
        let mut parts = Parts::of(0, &line, 5);
        parts.drives[0].model = ModelOptions::Nx(NxOptions {
            parameters: vec![(FIELDBUS_FAULT_RESPONSE, response)],
            ..NxOptions::default()
        });
        let mut rig = Rig::recorded(&line, parts);
        let known = |rig: &Rig| rig.value(1, "fieldbus_fault_response").is_some();
        rig.until("the parameter is read", PATIENCE, known);
        // The drive goes offline and returns, which must not be reported again.
        rig.set_alive(1, false);
        rig.until_state(1, State::Offline);
        rig.set_alive(1, true);
        rig.until("the parameter is read again", PATIENCE, known);
        rig.run(PATIENCE);
        let mut reported = rig.plant.events.recent();
        reported.retain(|event| event.kind == EventKind::Unsupervised);
        assert_eq!(reported.len(), wanted, "{reported:?}");
        for event in reported {
            let text = &event.text;
            let says = |part| text.contains(part);
            assert!(
                says("drive d0-1 keeps running") && says("is off (fieldbus_fault_response)"),
                "{text}"
            );
        }
    }
}

#[test]
fn a_stop_that_waits_while_a_reload_starts_the_bus_anew_is_sent() {
    // The reload comes at each step of the transaction before the stop, and of the stop's own transaction.
    for steps in 0..12 {
        let mut rig = ready(&nx(19_200, 2));
        assert!(rig.set(1, &[("speed_reference", 20.0), ("run", 1.0)]).is_ok());
        rig.until_state(1, State::Running);
        let (stop, also) = (
            rig.points(1, &[("run", 0.0)]),
            rig.points(1, &[("run", 0.0), ("speed_reference", 0.0)]),
        );
        let (mut stop, mut also) = (rig.place(1, stop), rig.place(1, also));
        for _ in 0..steps {
            rig.step(rig.now + Duration::from_millis(1));
        }
        let asked = rig.bus.core.asked().cloned();
        rig.restart_now();
        let outcome = rig.answered(&mut stop);
        assert!(outcome.is_ok(), "{steps} {asked:?}: {outcome:?}");
        // Only the stop is handed over, not the rest of its order.
        let outcome = rig.answered(&mut also);
        let stopped = outcome.is_ok() || matches!(outcome, Outcome::StopOnly(_));
        assert!(stopped, "{steps} {asked:?}: {outcome:?}");
        assert_eq!(rig.word(1, 2000) & 1, 0, "{steps}");
        rig.until_state(1, State::Ready);
    }
}

#[test]
fn a_stop_is_taken_while_the_bus_ends_and_before_its_port_is_open_again() {
    let mut rig = ready(&nx(19_200, 1));
    assert!(rig.set(1, &[("speed_reference", 20.0), ("run", 1.0)]).is_ok());
    let before = rig.drive(1);
    let order = rig.points(1, &[("run", 0.0)]);
    let ends = rig.bus.handle.clone();
    ends.queue.begin_handover(Vec::new(), rig.now);
    let mut while_it_ends = before.place(
        OrderRequest::new(order.clone(), Origin::new(SourceKind::Mqtt, "test"), Authority::Write),
        rig.now,
    );
    assert_eq!(while_it_ends.answer(), None);
    rig.restart_now();
    // The client still has the handle of the old bus.
    let mut behind = before.place(
        OrderRequest::new(order, Origin::new(SourceKind::Mqtt, "test"), Authority::Write),
        rig.now,
    );
    assert!(rig.answered(&mut while_it_ends).is_ok() && rig.answered(&mut behind).is_ok());
    assert_eq!(rig.word(1, 2000) & 1, 0);
}
