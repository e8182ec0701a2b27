//! What was chosen is asked about again before it goes out: what may not go is not chosen again without end.

use super::family_drive::FamilyDrive;
use super::*;
use drivegate_core::permit::DrillLock;

/// The gate closes between the look and the write: the order is refused, and not chosen again without end.
#[test]
fn an_order_that_has_looked_is_refused_when_the_gate_closes() {
    let mut tried = 0;
    for name in ["vacon-nx", "danfoss-fc", "vacon-10", "siemens-g120"] {
        let mut rig = Rig::empty(1, name, Protocol::ModbusRtu, Duration::from_millis(100), |spec| {
            DriveSpec {
                supervision: None,
                ..spec
            }
        });
        rig.drives[0].family = Some(FamilyDrive::new(&drivegate_testkit::profile(name)));
        rig.run(Duration::from_secs(12));
        let mut run = rig.switch(0, "client", true);
        rig.run(Duration::from_secs(2));
        assert!(outcome(&mut run).is_some_and(|outcome| outcome.is_ok()), "{name}");
        let mut reset = rig.order(0, "client", ModelPoint::FaultReset, Value::Bool(true));
        let has_looked = |rig: &mut Rig| {
            let run = rig.master.drives[0].run(Urgency::Command);
            run.is_some_and(|run| run.is_checked())
        };
        let until = rig.now + Duration::from_secs(2);
        while !has_looked(&mut rig) && rig.now < until && outcome(&mut reset).is_none() {
            rig.step();
        }
        if !has_looked(&mut rig) {
            continue;
        }
        tried += 1;
        let from = rig.wire.len();
        let lock = DrillLock {
            who: "drill".to_string(),
            quiet_until: None,
        };
        rig.bus.queue.set_drill(DriveIndex::new(0), Some(lock));
        rig.run(Duration::from_secs(1));
        let written = rig.wire[from..].iter().any(|(_, turn)| turn.pdu().is_write());
        let outcome = outcome(&mut reset);
        let refused = matches!(outcome, Some(Outcome::Refused(_)));
        assert!(!written && refused, "{name}: {outcome:?}");
    }
    assert!(tried >= 1);
}

/// The time of a stop begins with its turn, so that one may wait longer than its time. Such a stop holds no lease, and the
/// action of that goes out.
#[test]
fn an_action_goes_out_though_an_order_waits_whose_time_is_over() {
    let mut rig = Rig::empty(1, "vacon-nx", Protocol::ModbusRtu, Duration::from_millis(100), |spec| {
        spec
    });
    rig.run(Duration::from_secs(12));
    let _run = rig.switch(0, "client", true);
    let until = rig.now + Duration::from_secs(3);
    let action = loop {
        assert!(rig.now < until, "no action of the lease");
        let mut news = Vec::new();
        match rig.master.next(rig.now, &mut news) {
            Ok(turn) if turn.rank() == Some(Urgency::Stop) => break turn,
            Ok(turn) => rig.carry_out(turn, &mut news),
            Err(until) => rig.now = until,
        }
        news.iter().for_each(|one| rig.apply(one));
    };
    let at = rig.now;
    rig.now -= 2 * DEFAULT_EXPIRY;
    let _stop = rig.switch(0, "client", false);
    rig.now = at;
    assert!(rig.master.is_still_due(&action, rig.now));
}

/// A client stops a motor again as soon as its last stop is answered, always while the line falls silent before the frame of
/// another client: that frame goes out behind eight stops in a row.
#[test]
fn a_stop_in_each_silence_keeps_no_command_waiting() {
    let mut rig = Rig::at(2, "vacon-nx", Protocol::ModbusRtu, Duration::from_secs(1));
    let mut reference = rig.order(1, "other", ModelPoint::SpeedReference, Value::Number(30.0));
    let mut stop = rig.switch(0, "client", false);
    let mut stops = 0;
    while outcome(&mut reference).is_none() && stops < 20 {
        let mut news = Vec::new();
        match rig.master.next(rig.now, &mut news) {
            Err(until) => rig.now = until,
            Ok(turn) if turn.rank() != Some(Urgency::Stop) && outcome(&mut stop).is_some() => {
                // The motor runs again meanwhile, so the stop goes before everything.
                rig.drives[0].holding.insert(2000, 1);
                stop = rig.switch(0, "client", false);
            }
            Ok(turn) => {
                stops += usize::from(turn.rank() == Some(Urgency::Stop));
                rig.carry_out(turn, &mut news);
            }
        }
        for one in &news {
            rig.apply(one);
        }
    }
    assert!((8..=9).contains(&stops), "{stops} stops before the reference");
}
