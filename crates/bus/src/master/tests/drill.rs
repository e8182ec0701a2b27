//! A drill on the line: what a drive is sent meanwhile, and what counts as proven.

use super::*;
use crate::plant::Plant;
use drivegate_core::drill::{DrillOptions, DrillReport, DrillState, Kind};

const LIMIT: Duration = Duration::from_secs(2);

/// Drills the first of two drives; `meanwhile` is called with what is said of it.
fn drill(kind: Kind, mut meanwhile: impl FnMut(&mut Rig, &DrillReport)) -> (Rig, DrillReport) {
    let mut rig = Rig::new(2);
    // It takes orders from the fieldbus, and turns at 10 % where it turns.
    rig.drives[0].holding.extend([(2101, 1 << 13), (2102, 1000)]);
    rig.run(Duration::from_secs(2));
    rig.bus.image.update_health(|health| health.up = true);
    let plant = Plant {
        writes: rig.stats.clone(),
        ..Plant::new("g", Duration::from_secs(1), vec![rig.bus.clone()])
    };
    let drills = plant.drills.clone();
    drills.set_options(Some(DrillOptions {
        max_speed: 20.0,
        limit: LIMIT,
        every: Duration::from_secs(3600),
    }));
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
        if !drills.look(&plant, rig.now, time) {
            break;
        }
    }
    assert!(!rig.runs(0), "every drill ends with a stop");
    assert_eq!(rig.bus.image.drives[0].hold.why(), None);
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
    let asked: Vec<usize> = meanwhile.map(|(_, turn)| turn.drive).collect();
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

#[test]
fn a_switch_to_local_in_the_silence_proves_nothing() {
    let (_, report) = drill(Kind::Gateway, |rig, report| {
        if says(report, "nothing is sent") {
            rig.drives[0].holding.extend([(2101, 0), (2000, 0)]);
        }
    });
    assert_eq!(report.state, DrillState::Aborted, "{report:#?}");
    assert!(says(&report, "local control place"), "{report:#?}");
    assert_eq!(report.steps[0].state, DrillState::Aborted, "no proof: {report:#?}");
}

#[test]
fn a_silent_client_stops_a_motor_by_its_lease_only() {
    let (_, report) = drill(Kind::Client, |_, _| {});
    assert_eq!(report.state, DrillState::Passed, "{report:#?}");
    let took = report.steps[0].took_ms.unwrap();
    assert!((500..1_000).contains(&took), "its lease is 500 ms: {took} ms");
    // The motor stands for another reason before that.
    let (_, report) = drill(Kind::Client, |rig, report| {
        if says(report, "the client is silent") {
            rig.drives[0].holding.insert(2000, 0);
        }
    });
    assert_eq!(report.state, DrillState::NotProven, "{report:#?}");
    assert!(says(&report, "before its supervision stopped it"), "{report:#?}");
}
