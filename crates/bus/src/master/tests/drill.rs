//! A drill on the line: what is sent to a drive meanwhile, and what counts as proven.

use super::*;
use drivegate_core::drill::{DrillOptions, DrillReport, DrillState, Drills, Kind};
use drivegate_core::event::EventKind;
use drivegate_core::plant::Plant;

const LIMIT: Duration = Duration::from_secs(2);

fn plant(rig: &Rig) -> (Plant, Drills) {
    let plant = Plant::new("g", Duration::from_secs(1), vec![rig.bus.clone()]);
    let drills = Drills::default();
    drills.set_options(Some(DrillOptions {
        max_speed: 20.0,
        limit: LIMIT,
        every: Duration::from_secs(3600),
    }));
    (plant, drills)
}

/// Drills the first of two drives; `meanwhile` is called with the report of each step.
fn drill(kind: Kind, mut meanwhile: impl FnMut(&mut Rig, &DrillReport)) -> (Rig, DrillReport) {
    let mut rig = Rig::new(2);
    // The drive accepts orders from the fieldbus, and turns at 10 % when it runs.
    rig.drives[0].holding.extend([(2101, 1 << 13), (2102, 1000)]);
    rig.run(Duration::from_secs(2));
    rig.bus.image.update_health(|health| health.up = true);
    let (plant, drills) = plant(&rig);
    let (alice, time) = (Origin::new(SourceKind::Http, "alice"), SystemTime::now());
    let drive = plant.drives().next().unwrap();
    let armed = drills.arm(&drive, (&[kind], Some(10.0)), &alice, rig.now, time);
    let id = armed.unwrap().id;
    drills.start(&plant, &id, &alice, rig.now, time).unwrap();
    let until = rig.now + Duration::from_secs(60);
    loop {
        rig.step();
        assert!(rig.now < until, "it does not end: {:?}", drills.report(&id));
        meanwhile(&mut rig, &drills.report(&id).unwrap());
        if !drills.advance(&plant, rig.now, time) {
            break;
        }
    }
    assert!(!rig.runs(0), "every drill ends with a stop");
    assert_eq!(rig.bus.image.drives[0].restore_lock.reason(), None);
    assert_eq!(rig.bus.queue.quiet(rig.now), None);
    let report = drills.report(&id).unwrap();
    assert_eq!(report.last_stop.as_deref(), Some("acknowledged"), "{report:#?}");
    (rig, report)
}

fn says(report: &DrillReport, text: &str) -> bool {
    report.text.contains(text)
}

#[test]
fn a_silent_gateway_sends_a_drive_nothing_and_its_fault_proves_the_stop() {
    let mut silence: Option<(Instant, usize)> = None;
    let (rig, report) = drill(Kind::Gateway, |rig, report| {
        if says(report, "nothing is sent") {
            let (began, _) = *silence.get_or_insert((rig.now, rig.wire.len()));
            if rig.now > began + LIMIT / 2 {
                rig.drives[0].holding.insert(2100, 8);
            }
        }
    });
    assert_eq!(report.state, DrillState::Passed, "{report:#?}");
    let (began, from) = silence.unwrap();
    let meanwhile = rig.wire[from..]
        .iter()
        .take_while(|(at, _)| *at < began + LIMIT - 2 * COST);
    let asked: Vec<usize> = meanwhile.map(|(_, turn)| drive_of(turn)).collect();
    assert!(!asked.contains(&0), "it was sent something");
    assert!(asked.len() > 50, "the other drive is read as ever: {}", asked.len());
}

#[test]
fn a_drive_that_goes_on_turning_fails() {
    let (_, report) = drill(Kind::Gateway, |_, _| {});
    assert_eq!(report.state, DrillState::Failed, "{report:#?}");
    assert!(
        says(&report, "after a silence of 2 s the motor still turns"),
        "{report:#?}"
    );
}

/// An incident that occurs before the motor reaches standstill.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meanwhile {
    /// The first replies after a silence are lost; the motor stops before any reply arrives.
    Lost,
    /// The whole process is stalled.
    Pause,
    /// The task that evaluates drills is stalled, and the bus continues.
    PauseOfDrills,
}

#[test]
fn what_was_not_read_in_time_is_not_proven() {
    for (kind, when, meanwhile, says) in [
        (Kind::Gateway, "nothing is sent", Meanwhile::Lost, "was read only"),
        (Kind::Gateway, "nothing is sent", Meanwhile::Pause, "was read only 4."),
        (
            Kind::Order,
            "a stop command",
            Meanwhile::Pause,
            "standstill was seen first after 6.",
        ),
        (
            Kind::Order,
            "a stop command",
            Meanwhile::PauseOfDrills,
            "standstill was seen first after 6.",
        ),
        (
            Kind::Client,
            "the client is silent",
            Meanwhile::Pause,
            "the gateway paused for 6.0 s meanwhile; after 2 s the motor still turns",
        ),
        (
            Kind::Client,
            "the client is silent",
            Meanwhile::PauseOfDrills,
            "standstill was seen first after 6.",
        ),
    ] {
        let mut began = None;
        let (_, report) = drill(kind, |rig, report| {
            if !report.text.contains(when) {
                return;
            }
            let first = began.is_none();
            let since = *began.get_or_insert(rig.now);
            if kind == Kind::Gateway && rig.now > since + LIMIT / 2 {
                rig.drives[0].holding.insert(2100, 8);
            }
            match meanwhile {
                Meanwhile::Lost => rig.drives[0].silent = rig.now < since + LIMIT + Duration::from_secs(3),
                Meanwhile::Pause if first => {
                    rig.drives[0]
                        .holding
                        .insert(2100, if kind == Kind::Gateway { 8 } else { 0 });
                    rig.now += 3 * LIMIT;
                }
                Meanwhile::PauseOfDrills if first => {
                    rig.run(LIMIT / 2);
                    rig.drives[0]
                        .holding
                        .insert(2100, if kind == Kind::Gateway { 8 } else { 0 });
                    rig.run(5 * LIMIT / 2);
                }
                Meanwhile::Pause | Meanwhile::PauseOfDrills => {}
            }
        });
        let about = format!("{kind:?}, {meanwhile:?}: {report:#?}");
        assert_eq!(report.state, DrillState::NotProven, "{about}");
        assert!(report.text.contains(says), "{about}");
        assert_eq!(report.steps[0].took_ms, None, "{about}");
    }
}

#[test]
fn a_standstill_counts_from_when_it_was_seen() {
    // The motor turns for another second after its stop, like a braked motor.
    let mut began = None;
    let (_, report) = drill(Kind::Order, |rig, report| {
        if says(report, "a stop command") {
            let since = *began.get_or_insert(rig.now);
            let turns = rig.now < since + Duration::from_secs(1);
            rig.drives[0].holding.insert(2000, u16::from(turns));
        }
    });
    assert_eq!(report.state, DrillState::Passed, "{report:#?}");
    let took = report.steps[0].took_ms.unwrap();
    assert!((1_000..1_200).contains(&took), "{took} ms");
    // The motor stops just in time, and the reply that would have shown it is lost.
    let mut began = None;
    let (_, report) = drill(Kind::Order, |rig, report| {
        if says(report, "a stop command") {
            let since = *began.get_or_insert(rig.now);
            let turns = rig.now < since + LIMIT - Duration::from_millis(50);
            rig.drives[0].holding.insert(2000, u16::from(turns));
            rig.drives[0].silent = !turns && rig.now < since + LIMIT + Duration::from_millis(50);
        }
    });
    assert_eq!(report.state, DrillState::NotProven, "{report:#?}");
    // A motor that was seen turning after the limit has failed the drill.
    let mut began = None;
    let (_, report) = drill(Kind::Order, |rig, report| {
        if says(report, "a stop command") {
            let since = *began.get_or_insert(rig.now);
            let turns = rig.now < since + LIMIT + Duration::from_millis(200);
            rig.drives[0].holding.insert(2000, u16::from(turns));
        }
    });
    assert_eq!(report.state, DrillState::Failed, "{report:#?}");
    assert!(says(&report, "after 2 s the motor still turns"), "{report:#?}");
}

#[test]
fn a_motor_that_stands_before_its_cause_proves_nothing() {
    let (_, report) = drill(Kind::Order, |rig, report| {
        if says(report, "the motor turns at") {
            rig.drives[0].holding.insert(2000, 0);
        }
    });
    assert_eq!(report.state, DrillState::NotProven, "{report:#?}");
    assert!(
        says(&report, "the motor stopped before it was to be stopped"),
        "{report:#?}"
    );
}

#[test]
fn a_switch_to_local_in_the_silence_proves_nothing() {
    let (_, report) = drill(Kind::Gateway, |rig, report| {
        if says(report, "nothing is sent") {
            rig.drives[0].holding.extend([(2101, 0), (2000, 0)]);
        }
    });
    assert_eq!(report.state, DrillState::Aborted, "{report:#?}");
    assert!(says(&report, "local control"), "{report:#?}");
    assert_eq!(report.steps[0].state, DrillState::Aborted, "no proof: {report:#?}");
}

#[test]
fn a_silent_client_stops_a_motor_by_its_lease_only() {
    let (_, report) = drill(Kind::Client, |_, _| {});
    assert_eq!(report.state, DrillState::Passed, "{report:#?}");
    let took = report.steps[0].took_ms.unwrap();
    assert!((500..1_000).contains(&took), "its lease is 500 ms: {took} ms");
    // The motor reaches standstill before that, for another reason.
    let (_, report) = drill(Kind::Client, |rig, report| {
        if says(report, "the client is silent") {
            rig.drives[0].holding.insert(2000, 0);
        }
    });
    assert_eq!(report.state, DrillState::NotProven, "{report:#?}");
    assert!(says(&report, "before its supervision acted"), "{report:#?}");
}

/// A plant with drills that a file keeps, and a drill of its first drive that was started.
fn started() -> (Rig, (Plant, Drills), String) {
    let mut rig = Rig::new(2);
    rig.drives[0].holding.extend([(2101, 1 << 13), (2102, 1000)]);
    rig.run(Duration::from_secs(2));
    rig.bus.image.update_health(|health| health.up = true);
    let (plant, drills) = plant(&rig);
    drills.keep(true);
    let (alice, time) = (Origin::new(SourceKind::Http, "alice"), time(0));
    let drive = plant.drives().next().unwrap();
    let armed = drills.arm(&drive, (&[Kind::Order], Some(10.0)), &alice, rig.now, time);
    let id = armed.unwrap().id;
    drills.start(&plant, &id, &alice, rig.now, time).unwrap();
    (rig, (plant, drills), id)
}

fn time(seconds: u64) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000 + seconds)
}

/// Evaluates the drill for this time; returns whether it is still in progress.
fn look(rig: &mut Rig, (plant, drills): &(Plant, Drills), at: SystemTime, span: Duration) -> bool {
    let until = rig.now + span;
    let mut goes_on = true;
    while rig.now < until {
        rig.step();
        goes_on = drills.advance(plant, rig.now, at);
    }
    goes_on
}

#[test]
fn a_motor_starts_once_the_start_is_on_disk() {
    let (mut rig, plant, id) = started();
    let drills = &plant.1;
    assert!(look(&mut rig, &plant, time(1), Duration::from_secs(2)));
    assert!(!rig.runs(0), "its start is not on disk");
    let (generation, saved) = drills.to_keep().unwrap();
    assert_eq!(saved.reports[0].state, DrillState::Running);
    drills.kept(generation - 1, rig.now);
    look(&mut rig, &plant, time(2), Duration::from_secs(1));
    assert!(!rig.runs(0), "an older state is on disk");
    drills.kept(generation, rig.now);
    look(&mut rig, &plant, time(2), Duration::from_secs(1));
    assert!(rig.runs(0), "{:?}", drills.report(&id));
    look(&mut rig, &plant, time(3), Duration::from_secs(60));
    assert_eq!(drills.report(&id).unwrap().state, DrillState::Passed);
}

#[test]
fn a_start_that_cannot_be_recorded_starts_nothing() {
    let (mut rig, plant, id) = started();
    plant.1.not_kept("no space left", time(1));
    assert!(!look(&mut rig, &plant, time(1), Duration::from_secs(1)));
    let report = plant.1.report(&id).unwrap();
    assert_eq!(report.state, DrillState::Aborted);
    assert!(
        says(&report, "could not be recorded on disk (no space left)"),
        "{report:#?}"
    );
    let (mut rig, plant, id) = started();
    assert!(!look(&mut rig, &plant, time(1), Duration::from_secs(6)));
    // A disk that answers after that starts nothing any more.
    plant.1.kept(u64::MAX, rig.now);
    look(&mut rig, &plant, time(1), Duration::from_secs(1));
    assert!(!rig.runs(0));
    let report = plant.1.report(&id).unwrap();
    assert!(says(&report, "not recorded on disk within 5 s"), "{report:#?}");
}

#[test]
fn the_motor_of_a_drill_that_was_cut_off_is_stopped_at_the_next_start() {
    for (age, stops) in [(30, true), (4_000, false)] {
        let (mut rig, plant, id) = started();
        let (generation, saved) = plant.1.to_keep().unwrap();
        plant.1.kept(generation, rig.now);
        look(&mut rig, &plant, time(1), Duration::from_secs(1));
        assert!(rig.runs(0));
        // The process that starts after the killed one finds the drives as they are.
        let mut killed = std::mem::replace(
            &mut rig,
            Rig::empty(2, "vacon-nx", Protocol::ModbusRtu, Duration::from_millis(10), |spec| {
                spec
            }),
        );
        (rig.drives, rig.now) = (std::mem::take(&mut killed.drives), rig.now.max(killed.now));
        rig.bus.image.update_health(|health| health.up = true);
        let plant = self::plant(&rig);
        plant.1.restore(saved);
        let mut events = plant.0.events.subscribe();
        // The client sends heartbeats, so that no lease stops the motor.
        let (alice, until) = (Origin::new(SourceKind::Http, "alice"), rig.now + Duration::from_secs(2));
        while rig.now < until {
            plant.0.drives().next().unwrap().heartbeat(&alice, rig.now);
            look(&mut rig, &plant, time(age), Duration::from_millis(100));
        }
        assert_eq!(!rig.runs(0), stops, "{age} s");
        let report = plant.1.report(&id).unwrap();
        assert_eq!(report.state, DrillState::Aborted, "{report:#?}");
        assert!(says(&report, "killed or lost power"), "{report:#?}");
        assert_eq!(report.last_stop.as_deref(), stops.then_some("acknowledged"));
        let event = std::iter::from_fn(|| events.try_recv().ok()).find(|event| event.kind == EventKind::Drill);
        assert!(event.is_some_and(|event| event.text.contains("killed or lost power")));
        assert!(
            !plant
                .1
                .to_keep()
                .unwrap()
                .1
                .reports
                .iter()
                .any(|report| !report.state.is_over())
        );
    }
}
