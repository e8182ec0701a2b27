//! Stop all on a line that loses and damages frames, with an absent drive and a reload in between: the answer is
//! true for each drive, every drive that answers stands in the end, and afterwards the line works as before.

use std::time::Duration;

use drivegate_core::order::{Origin, SourceKind};
use drivegate_core::process_image::Access;
use drivegate_core::stop_all::{LOOK, Scope, StopAll, StopReport, Stopped, StoppedDrive};
use drivegate_proto::Protocol;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::statistics::Recorded;

use super::bus::Parts;
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

const DRIVES: u8 = 5;

fn works() -> Line {
    line("vacon-nx", Protocol::ModbusRtu, 19_200, DRIVES)
}

/// Incident while the order is in progress.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Meanwhile {
    Nothing,
    /// The bus is restarted, as a reload does.
    Reload,
    /// A drive is offline since before the order, and returns long after the answer.
    Away,
}

fn turns(rig: &mut Rig, address: u8) -> bool {
    rig.with_drive(address, |drive, _| drive.state().running)
}

/// Gives the order, waits for its answer, and compares the answer with the drives themselves.
fn stop_all(rig: &mut Rig, meanwhile: Meanwhile) -> StopReport {
    let origin = Origin::new(SourceKind::Http, "alice");
    let orders = StopAll::default();
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
        orders.advance(&rig.plant, rig.now);
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
        rig.until("online", PATIENCE, |rig| {
            rig.drive(address).reading(rig.now).snapshot.link.is_online()
        });
        let outcome = rig.set(address, &[("run", 1.0), ("speed_reference", 60.0)]);
        assert!(outcome.is_ok(), "drive {address}: {outcome}");
    }
}

#[test]
fn what_is_said_to_stand_stands_and_all_stands_in_the_end() {
    for meanwhile in [Meanwhile::Nothing, Meanwhile::Reload, Meanwhile::Away] {
        for faults in ["", "drop=0.35,corrupt=0.2", "late:60ms=0.2,busy=0.2"] {
            let mut rig = Rig::of(&works());
            start_all(&mut rig);
            if !faults.is_empty() {
                rig.set_faults(FaultPlan::new(faults.parse().unwrap(), 7));
            }
            if meanwhile == Meanwhile::Away {
                rig.set_alive(3, false);
                rig.run(Duration::from_secs(5));
            }
            let report = stop_all(&mut rig, meanwhile);
            let away = report.drives.iter().find(|drive| drive.drive == "d0-3").unwrap();
            match meanwhile {
                Meanwhile::Away => assert_eq!(away.outcome, Stopped::Unproven, "{faults}"),
                // Every stop is retried until it is acknowledged; whether a motor was read since depends on the line.
                _ => {
                    let acknowledged = |reason: &String| reason.starts_with("it acknowledged its stop");
                    let proven = |drive: &StoppedDrive| drive.reason.as_ref().is_none_or(acknowledged);
                    assert!(
                        report.drives.iter().all(proven),
                        "{meanwhile:?} with {faults}: {report:?}"
                    );
                    for address in 1..=DRIVES {
                        assert!(
                            !turns(&mut rig, address),
                            "drive {address}, {meanwhile:?} with {faults}"
                        );
                    }
                }
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
                (1..=DRIVES).all(|address| rig.state(address) == drivegate_model::drive::State::Running)
            });
        }
    }
}

/// Number of stops of single drives on the wire after the first `before` requests; with `broadcasts`, also those of
/// all drives.
fn stops_since(rig: &Rig, before: usize, broadcasts: bool) -> usize {
    let requests = rig.requests();
    let is_stop = |frame: &&Recorded| {
        let is_meant = broadcasts || frame.bytes.first() != Some(&0);
        is_meant && frame.bytes.get(1) == Some(&6)
    };
    requests[before..].iter().filter(is_stop).count()
}

#[test]
fn a_second_order_joins_and_one_behind_a_start_does_not() {
    let mut rig = Rig::recorded(&works(), Parts::of(0, &works(), 4));
    start_all(&mut rig);
    rig.run(Duration::from_secs(5));
    let orders = StopAll::default();
    let order = |rig: &mut Rig, who: &str| {
        let origin = Origin::new(SourceKind::Http, who);
        let wait = Duration::from_secs(20);
        let order = orders
            .order(&rig.plant, &Scope::Gateway, &origin, wait, rig.now)
            .unwrap();
        rig.bus.command_came(rig.now);
        order
    };
    let look = |rig: &mut Rig, time: Duration| {
        let until = rig.now + time;
        while rig.now < until {
            rig.run(LOOK);
            orders.advance(&rig.plant, rig.now);
            rig.bus.command_came(rig.now);
        }
    };
    let mut first = order(&mut rig, "alice");
    look(&mut rig, Duration::from_millis(500));
    let before = rig.requests().len();
    let mut second = order(&mut rig, "bob");
    look(&mut rig, Duration::from_millis(200));
    assert_eq!(stops_since(&rig, before, true), 0, "it joins");
    assert!(turns(&mut rig, 1), "it slows down");
    // Another client starts one of the motors before all of them stand.
    let started = rig.set(1, &[("run", 1.0)]);
    assert!(started.is_ok(), "{started}");
    let before = rig.requests().len();
    let mut third = order(&mut rig, "carol");
    look(&mut rig, Duration::from_millis(500));
    assert_eq!(stops_since(&rig, before, false), 1, "one drive may have been started");
    look(&mut rig, Duration::from_secs(20));
    for report in [&mut first, &mut second, &mut third].map(|order| order.report.try_recv().unwrap()) {
        assert!(report.ok && report.drives.len() == usize::from(DRIVES), "{report:?}");
    }
    assert!((1..=DRIVES).all(|address| !turns(&mut rig, address)));
}

/// A third of 132 drives on three lines, each of which has its own schedule: the time from the order to the last
/// stop on the wire, compared with the time for the characters, the silences between frames and the drives'
/// turnaround. If all drives obey it, one broadcast stops the motors first.
#[test]
fn forty_four_drives_are_stopped_as_fast_as_the_line_can() {
    const MANY: u8 = 44;
    for monitored in [false, true] {
        let works = Line {
            spec: if monitored {
                |spec| {
                    if spec.address == MANY {
                        spec.access = Access::Monitor;
                    }
                }
            } else {
                |_| {}
            },
            ..line("vacon-nx", Protocol::ModbusRtu, 19_200, MANY)
        };
        let mut rig = Rig::recorded(&works, Parts::of(0, &works, 3));
        let controlled = MANY - u8::from(monitored);
        for address in 1..=controlled {
            let online = |rig: &Rig| rig.drive(address).reading(rig.now).snapshot.link.is_online();
            rig.until("online", PATIENCE, online);
            let outcome = rig.set(address, &[("run", 1.0), ("speed_reference", 60.0)]);
            assert!(outcome.is_ok(), "drive {address}: {outcome}");
        }
        let before = rig.requests().len();
        let ordered = rig.now;
        let orders = StopAll::default();
        let (origin, wait) = (Origin::new(SourceKind::Http, "alice"), Duration::from_secs(30));
        let mut order = orders
            .order(&rig.plant, &Scope::Gateway, &origin, wait, rig.now)
            .unwrap();
        rig.bus.command_came(rig.now);
        let mut standing = std::collections::BTreeMap::new();
        let report = loop {
            rig.run(LOOK);
            orders.advance(&rig.plant, rig.now);
            rig.bus.command_came(rig.now);
            for address in 1..=controlled {
                if !rig.with_drive(address, |drive, _| drive.state().running) {
                    standing.entry(address).or_insert(rig.now - ordered);
                }
            }
            if let Ok(report) = order.report.try_recv() {
                break report;
            }
        };
        assert!(report.ok, "{report:?}");
        let requests = rig.requests();
        let is_stop = |frame: &&Recorded| frame.bytes.get(1) == Some(&6);
        let stops: Vec<&Recorded> = requests[before..].iter().filter(is_stop).collect();
        let broadcasts = stops.iter().filter(|frame| frame.bytes[0] == 0).count();
        // Request and reply of eight characters, 8N1, each followed by 3.5 characters of silence (11 bits each).
        let exchange = 16.0 * 10.0 / 19_200.0 + 2.0 * 3.5 * 11.0 / 19_200.0 + works.turnaround.as_secs_f64();
        let singles = &stops[broadcasts..];
        let expected = (usize::from(!monitored), usize::from(controlled));
        assert_eq!((broadcasts, singles.len()), expected, "monitored: {monitored}");
        let took = singles.last().unwrap().start - singles[0].start;
        let ratio = took.as_secs_f64() / (f64::from(controlled - 1) * exchange);
        // Polls and reads that show the effect come in between; after the broadcast the stops only confirm it.
        let most = if monitored { 2.5 } else { 5.0 };
        assert!(
            (0.95..most).contains(&ratio),
            "monitored: {monitored}: {took:?}, {ratio:.3} of the minimum"
        );
        let last = standing.values().max().unwrap();
        println!("monitored: {monitored}: {ratio:.2} of the minimum, the last motor stands after {last:?}");
    }
}
