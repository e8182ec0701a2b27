//! Points without a manual, titles that name the doubt, and steps at the cabinet.

use super::*;

/// Doubts about a profile appear in its title.
#[test]
fn titles_of_unverified_profiles() {
    for profile in Profiles::built_in().iter() {
        let doubt = profile.described().ends_with(" (not verified on hardware)");
        assert_eq!(doubt, !profile.verified, "{}", profile.name);
        assert!(profile.described().starts_with(&profile.title));
    }
}

/// Points that no manual of the family states, or that manuals state differently.
#[test]
fn what_is_not_confirmed() {
    for (name, points) in [
        (
            "vacon-nx",
            &[
                "minimum_frequency",
                "maximum_frequency",
                "acceleration_time",
                "deceleration_time",
            ][..],
        ),
        (
            "eaton-svx",
            &["maximum_frequency", "output_frequency", "fieldbus_fault_response"],
        ),
        ("eaton-hvx", &["maximum_frequency", "output_frequency", "interlocked"]),
        (
            "vacon-cx",
            &["ready", "fault", "reversed", "remote", "reverse", "fault_reset"],
        ),
    ] {
        let profile = profile(name);
        for point in points {
            assert!(
                !profile
                    .points
                    .get(profile.point_index(point).unwrap())
                    .unwrap()
                    .verified,
                "{point} of {name}"
            );
        }
    }
    for (name, point) in [
        ("vacon-cx", "running"),
        ("vacon-cx", "run"),
        ("eaton-hvx", "bypass_active"),
    ] {
        let profile = profile(name);
        assert!(
            profile
                .points
                .get(profile.point_index(point).unwrap())
                .unwrap()
                .verified,
            "{point} of {name}"
        );
    }
    let width = profile("teco-7300pa-n2");
    let width = &width
        .points
        .get(width.point_index("jump_frequency_width").unwrap())
        .unwrap();
    assert_eq!(width.range, Some(0.0..=25.5));
    for (name, formats) in [
        ("vacon-cx", &["8N2", "8N1", "8E1", "8O1"][..]),
        ("teco-7300pa", &["7N2", "7E1", "7O1"]),
    ] {
        assert_eq!(profile(name).formats, formats);
        assert!(!profile(name).bauds.contains(&38_400), "{name}");
    }
}

/// Every family with an available manual has commissioning steps from it, and families with one board share one list.
#[test]
fn steps_at_the_cabinet() {
    for family in Profiles::built_in().iter().filter(|profile| profile.verified) {
        for step in Step::ALL {
            // No manual has a test of TECO.
            let is_blank = step == Step::Test && family.name.starts_with("teco");
            assert_eq!(
                family.commissioning.lines(step).is_empty(),
                is_blank,
                "{} {}",
                family.name,
                step.name()
            );
        }
    }
    let nx = profile("vacon-nx");
    for name in ["vacon-nx-n2", "eaton-svx", "eaton-hvx", "eaton-hvx-n2"] {
        let other = profile(name);
        for step in [Step::Connect, Step::Terminate, Step::Lamps] {
            assert_eq!(other.commissioning.lines(step), nx.commissioning.lines(step), "{name}");
        }
    }
    let lamps = nx.commissioning.lines(Step::Lamps);
    assert!(lamps[0].starts_with("green LED (FS) steady: the board is active and has seen no message yet"));
}
