//! The holder of a drive, on the line: no order of another client, and every stop.

use super::*;
use drivegate_core::order::{Arrival, Proof, Refusal};
use drivegate_core::permit::{Mode, Principal, Rules, Verb};
use drivegate_core::plant::{DriveHandle, OrderRequest, Plant};
use drivegate_model::drive::DriveIndex;
use std::time::Duration as Time;

/// Bit by which the NX reports that the fieldbus controls it.
const FIELDBUS: (u16, u16) = (2101, 1 << 13);

fn guarded(drives: u8, mode: Mode) -> (Rig, Plant) {
    let mut rig = Rig::new(drives);
    let principals = ["op", "plc", "cloud"]
        .into_iter()
        .zip(1..)
        .map(|(name, rank)| Principal {
            mqtt: Some(name.to_string()),
            ..Principal::new(name, rank)
        });
    let rules = Rules {
        mode,
        ranks: ["site", "operator", "automation", "remote"].map(Into::into).to_vec(),
        lease: Time::from_secs(30),
        stop_at_local: true,
        principals: principals.collect(),
    };
    rig.bus.queue.set_authority(Some(Arc::new(rules)));
    for drive in &mut rig.drives {
        drive.holding.insert(FIELDBUS.0, FIELDBUS.1);
    }
    rig.run(Time::from_secs(2));
    rig.bus.image.update_health(|health| health.up = true);
    let plant = Plant::new("g", Time::from_secs(1), vec![rig.bus.clone()]);
    (rig, plant)
}

fn drive(plant: &Plant, index: usize) -> DriveHandle {
    plant.drives().nth(index).unwrap()
}

fn who(name: &str) -> Origin {
    Origin::new(SourceKind::Mqtt, name).proven(Proof::Topic(name.into()))
}

fn place(rig: &Rig, plant: &Plant, name: &str, point: ModelPoint, value: Value) -> drivegate_core::plant::Placed {
    let drive = drive(plant, 0);
    let index = drive.image.spec.profile.model_index(point).unwrap();
    let order = Order::Points(vec![(index, value)]);
    drive.place(OrderRequest::new(order, who(name), Authority::Write), rig.now)
}

fn code(placed: &mut drivegate_core::plant::Placed) -> &'static str {
    placed.answer().map_or("none", |answer| answer.outcome.code())
}

fn writes(rig: &Rig, from: usize) -> usize {
    let wire = rig.wire.get(from..).unwrap_or_default();
    wire.iter().filter(|(_, turn)| turn.pdu().is_write()).count()
}

#[test]
fn only_the_holder_is_on_the_wire_and_every_stop() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    let mut run = place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true));
    rig.run(Time::from_millis(200));
    assert_eq!((code(&mut run), rig.runs(0)), ("acknowledged", true));
    let from = rig.wire.len();
    for name in ["op", "cloud", "stranger"] {
        let points = [
            (ModelPoint::Run, Value::Bool(true)),
            (ModelPoint::SpeedReference, Value::Number(10.0)),
            (ModelPoint::FaultReset, Value::Bool(true)),
        ];
        for (point, value) in points {
            drive(&plant, 0).heartbeat(&who("plc"), rig.now);
            let mut refused = place(&rig, &plant, name, point, value);
            rig.run(Time::from_millis(60));
            let expected = if name == "stranger" {
                "not_allowed"
            } else {
                "held_by_other"
            };
            assert_eq!(code(&mut refused), expected, "{name} {point:?}");
        }
    }
    assert_eq!(writes(&rig, from), 0);
    let mut stop = place(&rig, &plant, "cloud", ModelPoint::Run, Value::Bool(false));
    rig.run(Time::from_millis(200));
    assert_eq!((code(&mut stop), rig.runs(0)), ("acknowledged", false));
    // The stopper has a lower rank: the PLC takes the drive with an order.
    let mut run = place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true));
    rig.run(Time::from_millis(200));
    assert_eq!((code(&mut run), rig.runs(0)), ("acknowledged", true));
    let mut stop = place(&rig, &plant, "stranger", ModelPoint::Run, Value::Bool(false));
    rig.run(Time::from_millis(200));
    assert_eq!((code(&mut stop), rig.runs(0)), ("acknowledged", false));
}

#[test]
fn advisory_sends_all_and_counts() {
    let (mut rig, plant) = guarded(1, Mode::Advisory);
    for name in ["plc", "op", "cloud"] {
        let mut reference = place(&rig, &plant, name, ModelPoint::SpeedReference, Value::Number(10.0));
        rig.run(Time::from_millis(200));
        assert_eq!(code(&mut reference), "acknowledged", "{name}");
    }
    assert_eq!(rig.bus.queue.lock().gate.unheld(DriveIndex::new(0)), 2);
    let clients = |rig: &Rig| {
        let unheld = rig.bus.queue.lock().gate.take_unheld();
        let clients = unheld.iter().map(|(_, unheld)| unheld.client.to_string());
        clients.collect::<Vec<_>>()
    };
    assert_eq!(clients(&rig), ["op", "cloud"]);
    // The log has one line per client and minute.
    for (wait, expected) in [(1, vec![]), (60, vec!["op", "cloud"])] {
        rig.run(Time::from_secs(wait));
        for name in ["plc", "op", "cloud", "op", "cloud"] {
            let mut reference = place(&rig, &plant, name, ModelPoint::SpeedReference, Value::Number(10.0));
            rig.run(Time::from_millis(200));
            assert_eq!(code(&mut reference), "acknowledged", "{name}");
        }
        assert_eq!(
            clients(&rig)
                .iter()
                .filter(|client| *client != "plc")
                .collect::<Vec<_>>(),
            expected
        );
    }
}

#[test]
fn what_waits_when_a_hold_is_broken_is_not_sent() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    let mut first = place(&rig, &plant, "plc", ModelPoint::SpeedReference, Value::Number(20.0));
    rig.run(Time::from_millis(200));
    assert_eq!(code(&mut first), "acknowledged");
    let from = rig.wire.len();
    let mut waits = place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true));
    let handle = drive(&plant, 0);
    let refused = handle.hold(
        Verb::Break,
        &who("cloud"),
        Authority::Write,
        (&Arrival::now(rig.now), rig.now),
    );
    assert!(matches!(refused, Err(Refusal::HeldByOther(_))), "{refused:?}");
    handle
        .hold(
            Verb::Break,
            &who("op"),
            Authority::Write,
            (&Arrival::now(rig.now), rig.now),
        )
        .unwrap();
    rig.run(Time::from_millis(300));
    assert_eq!(
        (code(&mut waits), rig.runs(0), writes(&rig, from)),
        ("held_by_other", false, 0)
    );
}

#[test]
fn what_has_begun_goes_no_further_when_a_hold_is_broken() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    // A reference and a run command need two steps.
    let handle = drive(&plant, 0);
    let profile = handle.image.spec.profile.clone();
    let index = |point| profile.model_index(point).unwrap();
    let order = Order::Points(vec![
        (index(ModelPoint::Run), Value::Bool(true)),
        (index(ModelPoint::SpeedReference), Value::Number(30.0)),
    ]);
    let mut both = handle.place(OrderRequest::new(order, who("plc"), Authority::Write), rig.now);
    let from = rig.wire.len();
    while writes(&rig, from) == 0 {
        rig.step();
    }
    assert!(!rig.runs(0), "the reference goes first");
    handle
        .hold(
            Verb::Break,
            &who("op"),
            Authority::Write,
            (&Arrival::now(rig.now), rig.now),
        )
        .unwrap();
    rig.run(Time::from_millis(300));
    assert_eq!((code(&mut both), rig.runs(0)), ("interrupted", false));
}

#[test]
fn the_turn_is_judged_again() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    let mut waits = place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true));
    // Before the command is sent, a reload removes the client, and another one takes the drive.
    let rules = rig.bus.queue.lock().gate.rules().cloned().unwrap();
    let mut fewer = Rules::clone(&rules);
    fewer.principals.retain(|principal| &*principal.name != "plc");
    rig.bus.queue.set_authority(Some(Arc::new(fewer)));
    let from = rig.wire.len();
    rig.run(Time::from_millis(300));
    assert_eq!((code(&mut waits), writes(&rig, from)), ("not_allowed", 0));
}

/// The client releases the drive while its order still waits.
#[test]
fn an_order_whose_drive_is_free_at_its_turn_takes_it() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    let mut waits = place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true));
    let released = drive(&plant, 0).hold(
        Verb::Release,
        &who("plc"),
        Authority::Write,
        (&Arrival::now(rig.now), rig.now),
    );
    assert_eq!(released.unwrap().holder, None);
    rig.run(Time::from_millis(300));
    assert_eq!((code(&mut waits), rig.runs(0)), ("acknowledged", true));
    let (view, own) = drive(&plant, 0).hold_view(Some(&who("plc")), rig.now).unwrap();
    assert!(own, "{view:?}");
    let mut refused = place(&rig, &plant, "cloud", ModelPoint::SpeedReference, Value::Number(10.0));
    assert_eq!(code(&mut refused), "held_by_other");
}

#[test]
fn the_silence_of_the_holder_is_the_one_that_counts() {
    for (name, stops) in [("op", true), ("plc", false)] {
        let (mut rig, plant) = guarded(1, Mode::Exclusive);
        drop(place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true)));
        rig.run(Time::from_millis(100));
        assert!(rig.runs(0));
        for _ in 0..20 {
            drive(&plant, 0).heartbeat(&who(name), rig.now);
            rig.run(Time::from_millis(100));
        }
        assert_eq!(!rig.runs(0), stops, "heartbeats of {name}");
    }
}

#[test]
fn under_local_control_nobody_commands() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    drop(place(
        &rig,
        &plant,
        "plc",
        ModelPoint::SpeedReference,
        Value::Number(20.0),
    ));
    rig.run(Time::from_millis(300));
    let from = rig.wire.len();
    rig.drives[0].holding.insert(FIELDBUS.0, 0);
    rig.run(Time::from_millis(1500));
    assert_eq!(writes(&rig, from), 0, "no run command stood");
    let view = |now| drive(&plant, 0).hold_view(None, now).unwrap().0.state.name();
    assert_eq!(view(rig.now), "local");
    let mut refused = place(&rig, &plant, "plc", ModelPoint::SpeedReference, Value::Number(10.0));
    assert_eq!(code(&mut refused), "held_by_other");
    let mut stop = place(&rig, &plant, "stranger", ModelPoint::Run, Value::Bool(false));
    rig.run(Time::from_millis(300));
    assert_eq!(code(&mut stop), "acknowledged");
    rig.drives[0].holding.insert(FIELDBUS.0, FIELDBUS.1);
    rig.run(Time::from_millis(1500));
    assert_eq!(view(rig.now), "free");
}

#[test]
fn nothing_starts_when_local_control_ends() {
    let (mut rig, plant) = guarded(1, Mode::Exclusive);
    drop(place(&rig, &plant, "plc", ModelPoint::Run, Value::Bool(true)));
    rig.run(Time::from_millis(200));
    assert!(rig.runs(0));
    rig.drives[0].holding.insert(FIELDBUS.0, 0);
    rig.run(Time::from_millis(300));
    assert!(!rig.runs(0), "one stop is written");
    let view = drive(&plant, 0).hold_view(None, rig.now).unwrap().0;
    assert_eq!(view.state.name(), "local");
    let from = rig.wire.len();
    rig.drives[0].holding.insert(FIELDBUS.0, FIELDBUS.1);
    rig.run(Time::from_millis(300));
    assert_eq!(writes(&rig, from), 0, "and nothing at its end");
    let view = drive(&plant, 0).hold_view(None, rig.now).unwrap().0;
    assert_eq!(
        view.state.name(),
        "free",
        "a stop of the gateway's own reserves nothing"
    );
    // Local control is already active when the gateway starts, so nothing is written.
    let mut rig = Rig::new(1);
    rig.drives[0].holding.insert(2000, 1);
    let rules = plant.buses[0].queue.lock().gate.rules().cloned();
    rig.bus.queue.set_authority(rules);
    let from = rig.wire.len();
    rig.run(Time::from_millis(300));
    assert_eq!(writes(&rig, from), 0);
    let drive = drive(&plant, 0);
    let why = drive.why(&drive.reading(rig.now));
    let stopped = why.causes.iter().find(|cause| cause.cause == "stopped_by_gateway");
    let evidence = stopped.map(|cause| cause.evidence.as_str()).unwrap_or_default();
    assert!(
        evidence.contains("the drive was switched to its local control place"),
        "{why:?}"
    );
}
