//! Refreshes of several drives of one line.

use super::*;

/// A drive for which an order always waits may not be fed; that keeps no other drive from its feeding.
#[test]
fn a_drive_that_may_not_be_fed_now_holds_up_no_other() {
    for (name, _) in FAMILIES {
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
        let (from, until) = (rig.wire.len(), rig.now + Duration::from_secs(10));
        let (mut percent, mut answers) = (10.0, Vec::new());
        while rig.now < until {
            if !rig.bus.queue.lock().awaits(DriveIndex::new(0)) {
                percent = if percent > 40.0 { 10.0 } else { percent + 0.5 };
                answers.push(rig.order(0, "client", ModelPoint::SpeedReference, Value::Number(percent)));
            }
            rig.step();
        }
        let is_fed = |turn: &Turn| matches!(turn.purpose, Purpose::Refresh(_)) && turn.pdu.is_write();
        let fed = rig.wire[from..].iter().filter(|(_, turn)| is_fed(turn));
        let fed = fed.filter(|(_, turn)| turn.target() == DriveIndex::new(1)).count();
        assert!(fed >= 7, "{name}: {fed} in 10 s");
    }
}
