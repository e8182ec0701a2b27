//! Refreshes of several drives of one line.

use super::*;

/// Two drives of a family whose motors run, and whose orders are repeated every second.
fn two_that_run(name: &str) -> Rig {
    let profile = drivegate_testkit::profile(name);
    let mut rig = Rig::empty(2, name, Protocol::ModbusRtu, Duration::from_millis(100), |spec| {
        let timeout = Duration::from_secs(3600);
        let supervision = Settings {
            timeout,
            action: LeaseAction::LeaveRunning,
            adopt: false,
        };
        DriveSpec {
            refresh: Some(EVERY),
            supervision: Some(supervision),
            ..spec
        }
    });
    for drive in 0..2 {
        rig.drives[drive].family = Some(FamilyDrive::new(&profile));
    }
    rig.run(Duration::from_secs(12));
    for drive in 0..2 {
        let mut orders = vec![
            rig.order(drive, "client", ModelPoint::SpeedReference, Value::Number(50.0)),
            rig.switch(drive, "client", true),
        ];
        rig.run(Duration::from_secs(3));
        for order in &mut orders {
            let outcome = outcome(order);
            assert!(outcome.as_ref().is_some_and(Outcome::is_ok), "{name}: {outcome:?}");
        }
    }
    rig
}

/// The number of refreshes of the second drive since frame `from`.
fn fed_since(rig: &Rig, from: usize) -> usize {
    let is_fed = |turn: &Turn| matches!(turn.purpose, Purpose::Refresh(_)) && turn.pdu.is_write();
    let fed = rig.wire[from..].iter().filter(|(_, turn)| is_fed(turn));
    fed.filter(|(_, turn)| turn.drive() == Some(DriveIndex::new(1))).count()
}

/// A client runs and stops the other drive in a loop, faster than a round takes: neither keeps the other waiting.
#[test]
fn stops_of_another_drive_without_end_do_not_hold_up_the_word() {
    for (name, _) in FAMILIES {
        let mut rig = two_that_run(name);
        let (from, until) = (rig.wire.len(), rig.now + Duration::from_secs(10));
        let (mut stop, mut given, mut longest) = (rig.switch(0, "duel", false), rig.now, Duration::ZERO);
        let mut runs = Vec::new();
        while rig.now < until {
            if outcome(&mut stop).is_some() {
                longest = longest.max(rig.now - given);
                runs.push(rig.switch(0, "duel", true));
                (stop, given) = (rig.switch(0, "duel", false), rig.now);
            }
            rig.step();
        }
        let fed = fed_since(&rig, from);
        assert!(fed >= 6, "{name}: {fed} in 10 s");
        // A stop has up to five frames.
        assert!(longest <= 10 * COST, "{name}: a stop took {longest:?}");
    }
}

/// A drive for which an order always waits may not be fed; that keeps no other drive from its feeding.
#[test]
fn a_drive_that_may_not_be_fed_now_holds_up_no_other() {
    for (name, _) in FAMILIES {
        let mut rig = two_that_run(name);
        let (from, until) = (rig.wire.len(), rig.now + Duration::from_secs(10));
        let (mut percent, mut answers) = (10.0, Vec::new());
        while rig.now < until {
            if !rig.bus.queue.lock().awaits(DriveIndex::new(0)) {
                percent = if percent > 40.0 { 10.0 } else { percent + 0.5 };
                answers.push(rig.order(0, "client", ModelPoint::SpeedReference, Value::Number(percent)));
            }
            rig.step();
        }
        let fed = fed_since(&rig, from);
        assert!(fed >= 7, "{name}: {fed} in 10 s");
    }
}
