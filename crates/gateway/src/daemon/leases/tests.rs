use std::time::Instant;

use super::*;
use crate::config::Settings;
use drivegate_bus::command_run::OrderedDirection;
use drivegate_bus::supervision::Lease;

/// A lease that has been running since then.
fn held(since: Instant) -> CarriedState {
    CarriedState {
        lease: Lease::held(since),
        ..CarriedState::default()
    }
}

const LEASE: &str = "supervision = { timeout = \"5s\" }\n";

/// A bus on this port with these drives, each given by name, address and access.
fn bus(port: &str, drives: &[(&str, u8, &str)]) -> BusSettings {
    let drive = |(name, address, access): &(&str, u8, &str)| {
        format!(
            "[[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"vacon-nx\"\naccess = \"{access}\"\n{}",
            if *access == "control" { LEASE } else { "" }
        )
    };
    let text = format!("[gateway]\nname = \"g\"\n[[bus]]\nname = \"line1\"\nport = \"{port}\"\n")
        + &drives.iter().map(drive).collect::<String>();
    let loaded = Settings::parse("t.toml", &text, std::iter::empty());
    loaded
        .settings
        .unwrap_or_else(|| panic!("{:?}", loaded.errors))
        .buses
        .remove(0)
}

/// Returns the events and the leases with which `after` continues, if the first drive of `before` had a lease and
/// the second had none.
fn reloaded(before: &BusSettings, after: &BusSettings) -> (Vec<bool>, Vec<String>) {
    let mut leases = Leases::default();
    leases.left(before, vec![held(Instant::now()), CarriedState::default()]);
    let of = leases
        .of(after, Instant::now())
        .into_iter()
        .map(|carried| carried.lease.ends().is_some())
        .collect();
    let told = leases.ended(SystemTime::now()).map(|event| {
        assert_eq!(event.kind, EventKind::Supervision);
        format!("{}: {}", event.drive.unwrap_or_default(), event.text)
    });
    (of, told.collect())
}

#[test]
fn a_lease_goes_with_the_machine_and_where_it_ends_that_is_told() {
    let two = [("pump-1", 1, "control"), ("pump-2", 2, "control")];
    let before = bus("/dev/ttyUSB0", &two);
    for (after, held) in [
        (&two[..], vec![true, false]),
        (&[("fan", 1, "control"), ("pump-2", 2, "control")], vec![true, false]),
        (&[("pump-1", 2, "control"), ("pump-2", 1, "control")], vec![false, true]),
        (&[("pump-2", 2, "control"), ("pump-1", 1, "control")], vec![false, true]),
    ] {
        assert_eq!(
            reloaded(&before, &bus("/dev/ttyUSB0", after)),
            (held, Vec::new()),
            "{after:?}"
        );
    }
    for (port, after) in [
        (
            "/dev/ttyUSB0",
            &[("pump-1", 3, "control"), ("pump-2", 2, "control")][..],
        ),
        ("/dev/ttyUSB1", &two),
        ("/dev/ttyUSB0", &[("pump-1", 1, "monitor"), ("pump-2", 2, "control")]),
        ("/dev/ttyUSB0", &[("pump-1", 2, "control")]),
    ] {
        let (held, told) = reloaded(&before, &bus(port, after));
        assert!(held.iter().all(|held| !held), "{after:?}");
        assert_eq!(told.len(), 1, "{told:?}");
        assert!(
            told[0].starts_with(
                "pump-1: the reload ended the lease of pump-1 (address 1 on /dev/ttyUSB0, profile `vacon-nx`)"
            ),
            "{told:?}"
        );
    }
}

/// Reloads from the first bus to the last, each `pause` after the previous; returns how long ago the lease of
/// `pump-1` was renewed by then.
fn over(buses: &[&BusSettings], pause: Duration) -> Option<Duration> {
    let (parted, mut now) = (RemovedDrives::default(), Instant::now());
    let mut held = vec![self::held(now); buses[0].drives.len()];
    for pair in buses.windows(2) {
        now += pause;
        let (mut leases, _) = parted.recall(now);
        leases.left(pair[0], held);
        held = leases.of(pair[1], now);
        // The drive has a direction, whether or not it is supervised.
        let drives = pair[1].drives.iter().zip(&mut held);
        for (_, carried) in drives.filter(|(drive, _)| drive.supervision.is_none()) {
            carried.direction = Some(OrderedDirection {
                reverse: true,
                at_next_start: false,
            });
        }
        parted.keep(&leases, &[], now);
    }
    let place = buses[buses.len() - 1]
        .drives
        .iter()
        .position(|drive| drive.name == "pump-1")?;
    (0..600)
        .map(Duration::from_secs)
        .find(|ago| now.checked_sub(*ago).map(Lease::held) == Some(held[place].lease))
}

#[test]
fn a_lease_goes_on_when_a_reload_brings_its_drive_back() {
    let all = bus("/dev/ttyUSB0", &[("pump-1", 1, "control"), ("pump-2", 2, "control")]);
    let mut unsupervised = all.clone();
    unsupervised.drives[0].supervision = None;
    for without in [
        bus("/dev/ttyUSB1", &[("pump-1", 1, "control"), ("pump-2", 2, "control")]),
        bus("/dev/ttyUSB0", &[("pump-1", 5, "control"), ("pump-2", 2, "control")]),
        bus("/dev/ttyUSB0", &[("pump-1", 1, "monitor"), ("pump-2", 2, "control")]),
        bus("/dev/ttyUSB0", &[("pump-2", 2, "control")]),
        unsupervised,
    ] {
        // The lease ran for one pause before the first reload; its clock stood still between the two reloads.
        let second = Duration::from_secs(1);
        assert_eq!(over(&[&all, &without, &all], 7 * second), Some(7 * second));
        assert_eq!(over(&[&all, &without, &without, &all], 7 * second), Some(7 * second));
        assert_eq!(over(&[&all, &all, &without], 7 * second), None, "no drive, no lease");
        assert_eq!(over(&[&all, &without, &all], RETURN + second), None, "too late");
        assert_eq!(
            over(&[&all, &without, &all, &all], 7 * second),
            Some(14 * second),
            "it runs again"
        );
    }
}

#[test]
fn a_bus_that_a_reload_stopped_is_freed_after_two_minutes() {
    let (removed, now) = (RemovedDrives::default(), Instant::now());
    let plant = drivegate_testkit::nx_plant(&["p1"]);
    let image = Arc::downgrade(&plant.buses[0].image);
    removed.keep(&Leases::default(), &plant.buses, now);
    drop(plant);
    for (after, is_known) in [(RETURN, true), (RETURN + Duration::from_secs(1), false)] {
        removed.forget(now + after);
        assert_eq!(image.strong_count() > 0, is_known, "{after:?}");
    }
}

#[test]
fn the_direction_of_a_drive_without_supervision_goes_with_the_machine() {
    let drives = [("pump-1", 1, "control"), ("pump-2", 2, "control")];
    let unsupervised = |drives| {
        let mut bus = bus("/dev/ttyUSB0", drives);
        bus.drives.iter_mut().for_each(|drive| drive.supervision = None);
        bus
    };
    let reverse = OrderedDirection {
        reverse: true,
        at_next_start: false,
    };
    let carried = CarriedState {
        direction: Some(reverse),
        ..CarriedState::default()
    };
    let mut leases = Leases::default();
    leases.left(&unsupervised(&drives), vec![carried, CarriedState::default()]);
    let renamed = unsupervised(&[("pump-1", 2, "control"), ("pump-2", 1, "control")]);
    let of = leases.of(&renamed, Instant::now());
    let directions: Vec<_> = of.iter().map(|carried| carried.direction).collect();
    assert_eq!(directions, [None, Some(reverse)]);
}
