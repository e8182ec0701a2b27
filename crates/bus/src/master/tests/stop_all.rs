//! A stop of all drives: the broadcast and the stops on the line, and the result for each drive.

use super::*;
use drivegate_core::plant::Plant;
use drivegate_core::stop_all::{Scope, StopAll, StopOrder, StopReport, Stopped, WAIT, not_standing};

/// A plant that consists of this bus only.
fn plant(rig: &Rig) -> Plant {
    rig.bus.image.update_health(|health| health.up = true);
    Plant::new("g", Duration::from_secs(1), vec![rig.bus.clone()])
}

fn running(drives: u8) -> Rig {
    let mut rig = Rig::new(drives);
    for drive in &mut rig.drives {
        drive.holding.insert(2000, 1);
    }
    rig.run(Duration::from_secs(2));
    rig
}

fn order(rig: &Rig, plant: &Plant, stop_all: &StopAll, scope: &Scope) -> StopOrder {
    let origin = Origin::new(SourceKind::Http, "alice");
    stop_all.order(plant, scope, &origin, WAIT, rig.now).unwrap()
}

/// Runs until the order is answered.
fn answered(rig: &mut Rig, plant: &Plant, stop_all: &StopAll, order: &mut StopOrder) -> StopReport {
    let begin = rig.now;
    loop {
        rig.step();
        stop_all.advance(plant, rig.now);
        if let Ok(report) = order.report.try_recv() {
            return report;
        }
        assert!(rig.now < begin + WAIT + Duration::from_secs(1), "no answer");
    }
}

fn outcomes(report: &StopReport) -> Vec<Stopped> {
    report.drives.iter().map(|drive| drive.outcome).collect()
}

#[test]
fn a_broadcast_goes_before_all_and_each_drive_is_proven_to_stand() {
    for deaf in [false, true] {
        let mut rig = running(20);
        rig.deaf = deaf;
        let (plant, stop_all) = (plant(&rig), StopAll::default());
        assert_eq!(not_standing(&plant.drives().collect::<Vec<_>>(), rig.now), 20);
        // A busy line: waiting orders do not delay the broadcast.
        let _flood: Vec<_> = (0..20)
            .map(|k| rig.order(k, "plc", ModelPoint::SpeedReference, Value::Number(10.0)))
            .collect();
        let (from, begin) = (rig.wire.len(), rig.now);
        let mut order = order(&rig, &plant, &stop_all, &Scope::Gateway);
        let report = answered(&mut rig, &plant, &stop_all, &mut order);
        assert!(report.ok, "{report:?}");
        assert_eq!(outcomes(&report), [Stopped::Standing; 20]);
        assert_eq!(order.acknowledged.try_recv(), Ok(true));
        // A reading from before the flood may be old when the last drive is seen to stand.
        rig.run(Duration::from_secs(2));
        assert_eq!(not_standing(&plant.drives().collect::<Vec<_>>(), rig.now), 0);
        let writes: Vec<_> = rig.wire[from..]
            .iter()
            .filter(|(_, turn)| turn.pdu().is_write())
            .collect();
        assert_eq!(writes[0].1.target(), Target::Address(0), "the broadcast goes first");
        assert!(writes[0].0 - begin <= COST);
        for drive in 0..20 {
            assert!(
                writes.iter().any(|(_, turn)| turn.target() == DriveIndex::new(drive)),
                "a stop of its own"
            );
            assert!(!rig.runs(drive));
        }
    }
}

/// Each drive has either its previous word, which is known, or the word of the broadcast; the stop is equal for both.
#[test]
fn a_stop_behind_the_broadcast_reads_no_word_that_was_known() {
    let mut rig = running(3);
    let started: Vec<_> = (0..3)
        .map(|k| rig.order(k, "plc", ModelPoint::Run, Value::Bool(true)))
        .collect();
    rig.run(Duration::from_secs(1));
    for mut answer in started {
        assert!(answer.try_recv().unwrap().outcome.is_ok());
    }
    let (plant, stop_all) = (plant(&rig), StopAll::default());
    let from = rig.wire.len();
    let mut order = order(&rig, &plant, &stop_all, &Scope::Gateway);
    assert!(answered(&mut rig, &plant, &stop_all, &mut order).ok);
    let of_word = |turn: &&Turn| {
        let is_poll = matches!(turn.purpose, Purpose::Poll(_));
        !is_poll && matches!(turn.pdu(), RequestPdu::Read { start: 2000, .. })
    };
    let sent: Vec<&Turn> = rig.wire[from..].iter().map(|(_, turn)| turn).collect();
    assert_eq!(sent.iter().filter(|turn| turn.pdu().is_write()).count(), 4);
    assert_eq!(sent.into_iter().find(of_word), None);
}

#[test]
fn no_broadcast_reaches_a_drive_that_is_not_concerned() {
    let in_group = |spec: DriveSpec| DriveSpec {
        group: (spec.address != 2).then(|| "pumps".to_string()),
        supervision: None,
        ..spec
    };
    let mut rig = Rig::with(3, "vacon-nx", Protocol::ModbusRtu, Duration::from_millis(10), in_group);
    for drive in &mut rig.drives {
        drive.holding.insert(2000, 1);
    }
    rig.run(Duration::from_secs(2));
    let (plant, stop_all) = (plant(&rig), StopAll::default());
    let from = rig.wire.len();
    let mut order = order(&rig, &plant, &stop_all, &Scope::Group("pumps".to_string()));
    let report = answered(&mut rig, &plant, &stop_all, &mut order);
    assert!(report.ok && report.drives.len() == 2, "{report:?}");
    assert!(rig.wire[from..].iter().all(|(_, turn)| turn.drive().is_some()));
    assert_eq!([0, 1, 2].map(|drive| rig.runs(drive)), [false, true, false]);
}

#[test]
fn a_silent_drive_is_named_and_stopped_once_it_is_back() {
    let mut rig = running(3);
    rig.drives[1].silent = true;
    rig.run(Duration::from_secs(10));
    let (plant, stop_all) = (plant(&rig), StopAll::default());
    let mut first = order(&rig, &plant, &stop_all, &Scope::Gateway);
    let begin = rig.now;
    while first.acknowledged.is_empty() {
        rig.step();
        stop_all.advance(&plant, rig.now);
        assert!(rig.now < begin + Duration::from_secs(2), "the first failure is told");
    }
    assert_eq!(first.acknowledged.try_recv(), Ok(false));
    let report = answered(&mut rig, &plant, &stop_all, &mut first);
    assert!(!report.ok);
    assert_eq!(
        outcomes(&report),
        [Stopped::Standing, Stopped::Unproven, Stopped::Standing]
    );
    assert!(
        report.drives[1]
            .reason
            .as_deref()
            .is_some_and(|why| why.contains("did not acknowledge"))
    );
    assert!(rig.runs(1));
    // The drive is back in the time of the next order: the stop is repeated and works.
    let mut second = order(&rig, &plant, &stop_all, &Scope::Gateway);
    let begin = rig.now;
    while rig.now < begin + Duration::from_secs(3) {
        rig.step();
        stop_all.advance(&plant, rig.now);
    }
    rig.drives[1].silent = false;
    let report = answered(&mut rig, &plant, &stop_all, &mut second);
    assert!(report.ok, "{report:?}");
    assert!(!rig.runs(1));
}

#[test]
fn a_second_order_joins_stops_that_wait_and_sends_those_that_were_acknowledged_again() {
    let mut rig = running(3);
    let (plant, stop_all) = (plant(&rig), StopAll::default());
    let mut first = order(&rig, &plant, &stop_all, &Scope::Gateway);
    let mut second = order(&rig, &plant, &stop_all, &Scope::Bus("b".to_string()));
    assert_eq!(rig.bus.queue.lock().len(), 4, "the broadcast, and a stop each");
    let report = answered(&mut rig, &plant, &stop_all, &mut first);
    assert!(report.ok);
    assert_eq!(second.report.try_recv().unwrap(), report, "one answer for both");
    // A new command stops a motor that was started after the previous one.
    rig.drives[2].holding.insert(2000, 1);
    let mut third = order(&rig, &plant, &stop_all, &Scope::Gateway);
    assert!(answered(&mut rig, &plant, &stop_all, &mut third).ok);
    assert!(!rig.runs(2));
    assert!(!stop_all.advance(&plant, rig.now), "nothing is under way");
}

#[test]
fn a_motor_that_runs_down_is_told_as_stopping() {
    let mut rig = running(2);
    let (plant, stop_all) = (plant(&rig), StopAll::default());
    // The output is at 12 Hz whatever the control word is.
    rig.drives[1].holding.insert(2103, 1200);
    let mut order = order(&rig, &plant, &stop_all, &Scope::Gateway);
    let report = answered(&mut rig, &plant, &stop_all, &mut order);
    assert_eq!(outcomes(&report), [Stopped::Standing, Stopped::Stopping]);
    assert!(
        report.drives[1]
            .reason
            .as_deref()
            .is_some_and(|why| why.contains("12.0 Hz"))
    );
    assert_eq!(order.acknowledged.try_recv(), Ok(true), "its stop was acknowledged");
}
