use std::time::{Duration, SystemTime};

use super::*;
use crate::files::State as _;
use crate::process_image::{DriveSpec, LeaseAction, Supervision};
use crate::testkit;

fn machine(address: u8) -> Machine {
    Machine {
        port: "/dev/x".to_string(),
        address,
        profile: "vacon-nx".to_string(),
    }
}

fn at(seconds: u64) -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000 + seconds)
}

#[test]
fn a_proof_is_of_its_machine_and_way_and_grows_old() {
    let hour = Duration::from_secs(3600);
    let saved = SavedDrills::new(
        Vec::new(),
        vec![
            Proof::new(&machine(1), Kind::Order, at(0), true),
            Proof::new(&machine(1), Kind::Client, at(0), false),
        ],
    );
    let unproven = |address, after| saved.unproven(&machine(address), &Kind::ALL, hour, at(after));
    assert_eq!(
        unproven(1, 60),
        [Kind::Client, Kind::Gateway],
        "one failed, one was never tried"
    );
    assert_eq!(unproven(1, 3_601), Kind::ALL);
    assert_eq!(unproven(2, 60), Kind::ALL);
    // A clock that was set back makes nothing old.
    let before = at(0) - hour;
    assert_eq!(saved.unproven(&machine(1), &[Kind::Order], hour, before), []);
}

#[test]
fn files_of_others_are_refused_with_a_reason() {
    let saved = SavedDrills::new(Vec::new(), vec![Proof::new(&machine(1), Kind::Order, at(0), true)]);
    let text = serde_json::to_string(&saved).unwrap();
    assert_eq!(SavedDrills::from_json(text.as_bytes()), Ok(saved));
    for (text, why) in [
        ("{", "EOF"),
        ("[]", "invalid"),
        (
            "{\"drivegate_drills\": 2, \"reports\": [], \"proofs\": []}",
            "version 2",
        ),
    ] {
        let error = SavedDrills::from_json(text.as_bytes()).unwrap_err();
        assert!(error.contains(why), "{text}: {error}");
    }
}

#[test]
fn a_silent_client_stops_what_has_supervision() {
    let profile = testkit::nx();
    let mut spec = DriveSpec::new("p", "b", 1, profile);
    assert_eq!(ways(&spec), [], "it is monitored only");
    spec.access = Access::Control;
    assert_eq!(ways(&spec), [Kind::Order, Kind::Gateway]);
    spec.supervision = Some(Supervision {
        timeout: Duration::from_secs(1),
        action: LeaseAction::Stop,
        adopt: false,
    });
    assert_eq!(ways(&spec), Kind::ALL);
    spec.profile = testkit::profile("lenze-i550");
    assert_eq!(ways(&spec), [], "nothing starts it");
}

#[test]
fn what_is_kept_is_bounded() {
    let drills = Drills::default();
    let proofs = (0..20_000).map(|n| Proof::new(&machine((n % 250) as u8), Kind::Order, at(n), true));
    drills.restore(SavedDrills::new(Vec::new(), proofs.collect()));
    let kept: usize = (0..250).map(|address| drills.proofs(&machine(address)).len()).sum();
    assert_eq!(kept, MOST_PROOFS);
    assert_eq!(drills.to_keep(), None, "nothing new");
}
