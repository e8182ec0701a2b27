//! The stops at a shutdown of the gateway.

use super::*;

#[test]
fn polls_cease_and_every_drive_is_stopped_when_the_gateway_ends() {
    let mut rig = Rig::new(20);
    for drive in 0..20 {
        rig.drives[drive].holding.insert(2000, 1);
    }
    rig.drives[7].silent = true;
    let (from, begin) = (rig.wire.len(), rig.now);
    let missing = rig.shut_down();
    let [missing] = missing.as_slice() else {
        panic!("{missing:?}")
    };
    assert!(missing.starts_with("`d8` did not acknowledge its stop"), "{missing}");
    let running: Vec<usize> = (0..20).filter(|drive| rig.runs(*drive)).collect();
    assert_eq!(running, [7]);
    let poll = |turn: &Turn| matches!(turn.purpose, Purpose::Poll(_));
    assert!(!rig.wire[from..].iter().any(|(_, turn)| poll(turn)), "polls cease");
    // All other drives are stopped before the silent one gets further attempts.
    let last = (0..20).filter(|d| *d != 7).filter_map(|drive| {
        let stop = |(_, turn): &&(Instant, Turn)| turn.drive().is_some_and(|of| of == drive) && turn.pdu().is_write();
        rig.wire[from..].iter().find(stop).map(|(at, _)| *at - begin)
    });
    assert!(last.max().unwrap() < COST * 60);
}

/// Times, after the begin, of the frames of a shutdown: the broadcast and the first single stop.
fn shutdown_of(rig: &mut Rig) -> (Option<Duration>, Duration) {
    let (from, begin) = (rig.wire.len(), rig.now);
    let missing = rig.shut_down();
    assert!(missing.is_empty(), "{missing:?}");
    let first = |broadcast: bool| {
        let mut sent = rig.wire[from..].iter();
        let found = sent.find(|(_, turn)| turn.pdu().is_write() && turn.drive().is_none() == broadcast);
        found.map(|(at, _)| *at - begin)
    };
    (first(true), first(false).expect("each drive has a stop of its own"))
}

#[test]
fn one_broadcast_stops_the_line_before_each_drive_has_its_own_stop() {
    let running = |deaf: bool| {
        let mut rig = Rig::new(20);
        rig.deaf = deaf;
        for drive in &mut rig.drives {
            drive.holding.insert(2000, 1);
        }
        rig
    };
    for deaf in [false, true] {
        let mut rig = running(deaf);
        let (broadcast, single) = shutdown_of(&mut rig);
        assert!(broadcast.expect("one broadcast") <= COST, "{broadcast:?}");
        assert!(single > broadcast.unwrap() && single <= Duration::from_millis(500));
        // A broadcast is not acknowledged, so each drive still gets a separate stop.
        assert!((0..20).all(|drive| !rig.runs(drive)));
    }
    // One drive that must keep running, or must not be commanded, rules out the broadcast.
    let hold = |spec: DriveSpec| DriveSpec {
        on_shutdown: if spec.address == 4 {
            OnShutdown::LeaveRunning
        } else {
            OnShutdown::Stop
        },
        ..spec
    };
    let mut rig = Rig::with(20, "vacon-nx", Protocol::ModbusRtu, Duration::from_millis(10), hold);
    for drive in &mut rig.drives {
        drive.holding.insert(2000, 1);
    }
    let (broadcast, _) = shutdown_of(&mut rig);
    assert_eq!(broadcast, None);
    assert!(rig.runs(3) && (0..20).filter(|drive| *drive != 3).all(|drive| !rig.runs(drive)));
}

#[test]
fn a_drive_that_fell_silent_with_the_shutdown_keeps_no_stop_from_those_that_are_back() {
    let mut rig = Rig::new(3);
    rig.drives[1].silent = true;
    rig.run(Duration::from_secs(2));
    assert!(!rig.master.schedule.is_online(DriveIndex::new(1)));
    rig.drives[1].silent = false;
    rig.drives[1].holding.insert(2000, 1);
    rig.drives[0].silent = true;
    let missing = rig.shut_down();
    let [missing] = missing.as_slice() else {
        panic!("{missing:?}")
    };
    assert!(missing.starts_with("`d1` did not acknowledge its stop"), "{missing}");
    assert!(!rig.runs(1));
}

/// A reload refuses an order in the last moment of a bus: its client is there, so the lease begins anew with the next bus.
#[test]
fn an_order_that_a_reload_refuses_renews_the_lease_that_is_handed_over() {
    let mut rig = Rig::new(1);
    rig.switch(0, "client", true);
    rig.run(Duration::from_millis(300));
    rig.bus.queue.begin_handover(Vec::new(), rig.now);
    let mut refused = rig.order(0, "client", ModelPoint::SpeedReference, Value::Number(40.0));
    assert_eq!(outcome(&mut refused), Some(Outcome::ShuttingDown));
    let handover = rig.master.ended(None, rig.now);
    assert_eq!(handover.leases[0].lease, Lease::held(rig.now));
}
