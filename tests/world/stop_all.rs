//! Stop all on a line that loses and damages frames, with a drive that is away and a reload in between: what the answer says of a
//! drive is so, every drive that answers stands in the end, and afterwards all is as good as before.

use std::time::Duration;

use drivegate::codec::Protocol;
use drivegate::command::{Origin, SourceKind};
use drivegate::sim::faults::FaultPlan;
use drivegate::stop_all::{LOOK, Scope, StopReport, Stopped};

use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

const DRIVES: u8 = 5;

fn works(faults: &str) -> Line {
    Line {
        faults: faults.to_string(),
        ..line("vacon-nx", Protocol::ModbusRtu, 19_200, DRIVES)
    }
}

/// What happens while the order is under way.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meanwhile {
    Nothing,
    /// The bus is started anew, as by a reload.
    Reload,
    /// A drive is away from before the order on, and comes back long after the answer.
    Away,
}

fn turns(rig: &mut Rig, address: u8) -> bool {
    rig.with_drive(address, |drive, _| drive.state().running)
}

/// Gives the order, lets time pass until its answer, and checks what that says against the drives themselves.
fn stop_all(rig: &mut Rig, meanwhile: Meanwhile) -> StopReport {
    let origin = Origin::new(SourceKind::Http, "alice");
    let orders = rig.plant.stop_all.clone();
    let wait = Duration::from_secs(20);
    let mut order = orders
        .order(&rig.plant, &Scope::Gateway, &origin, wait, rig.now)
        .unwrap();
    rig.bus.command_came(rig.now);
    if meanwhile == Meanwhile::Reload {
        rig.run(Duration::from_millis(7));
        rig.restart_now();
    }
    let until = rig.now + PATIENCE;
    loop {
        assert!(rig.now < until, "no answer");
        rig.run(LOOK);
        orders.look(&rig.plant, rig.now);
        rig.bus.command_came(rig.now);
        let Ok(report) = order.report.try_recv() else { continue };
        for address in 1..=DRIVES {
            let name = format!("d0-{address}");
            let said = report.drives.iter().find(|drive| drive.drive == name).unwrap();
            let turns = turns(rig, address);
            assert!(!(said.outcome == Stopped::Standing && turns), "{name} is said to stand");
        }
        let all = report.drives.iter().all(|drive| drive.outcome == Stopped::Standing);
        assert_eq!((report.ok, report.drives.len()), (all, usize::from(DRIVES)));
        return report;
    }
}

fn start_all(rig: &mut Rig) {
    for address in 1..=DRIVES {
        // Lost frames may make it fail; then it is ordered again.
        rig.until("online", PATIENCE, |rig| {
            rig.drive(address).reading(rig.now).snapshot.link.is_online()
        });
        let mut tries = 0;
        while !rig.set(address, &[("run", 1.0), ("speed_reference", 60.0)]).is_ok() {
            tries += 1;
            assert!(tries < 50, "drive {address} does not start");
            rig.run(Duration::from_millis(500));
        }
    }
}

#[test]
fn what_is_said_to_stand_stands_and_all_stands_in_the_end() {
    for meanwhile in [Meanwhile::Nothing, Meanwhile::Reload, Meanwhile::Away] {
        for faults in ["", "drop=0.1,corrupt=0.1", "late:60ms=0.1,busy=0.1"] {
            let mut rig = Rig::of(&works(faults));
            start_all(&mut rig);
            if meanwhile == Meanwhile::Away {
                rig.set_alive(3, false);
                rig.run(Duration::from_secs(5));
            }
            let report = stop_all(&mut rig, meanwhile);
            let away = report.drives.iter().find(|drive| drive.drive == "d0-3").unwrap();
            match meanwhile {
                Meanwhile::Away => assert_eq!(away.outcome, Stopped::Unproven, "{faults}"),
                // The faults are rare enough for stops that are tried again.
                _ => assert!(report.ok, "{meanwhile:?} with {faults}: {report:?}"),
            }
            // The faults end, the drive is back: the next order finds everything as good as ever.
            rig.set_faults(FaultPlan::new(Default::default(), 1));
            rig.set_alive(3, true);
            rig.run(Duration::from_secs(20));
            let report = stop_all(&mut rig, Meanwhile::Nothing);
            assert!(report.ok, "{meanwhile:?} with {faults}: {report:?}");
            for address in 1..=DRIVES {
                assert!(!turns(&mut rig, address), "drive {address}");
            }
            start_all(&mut rig);
            rig.until("all run", PATIENCE, |rig| {
                (1..=DRIVES).all(|address| rig.state(address) == drivegate::drive::State::Running)
            });
        }
    }
}
