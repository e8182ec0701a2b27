//! What docs/commissioning.md says of each family at the cabinet, generated from the built-in profiles.

use std::fmt::Write;

use drivegate::drive::Step;
use drivegate::drive::profile::{Profile, Profiles};

/// Each family that is not based on another, and the one that it is compared with.
const FAMILIES: [(&str, Option<&str>); 8] = [
    ("vacon-nx", None),
    ("vacon-nx-n2", Some("vacon-nx")),
    ("eaton-svx", Some("vacon-nx")),
    ("eaton-hvx", Some("vacon-nx")),
    ("eaton-hvx-n2", Some("eaton-hvx")),
    ("vacon-cx", None),
    ("teco-7300pa", None),
    ("teco-7300pa-n2", Some("teco-7300pa")),
];

pub(crate) fn lists() -> String {
    let profiles = Profiles::built_in();
    let mut text = String::new();
    for (name, other) in FAMILIES {
        let profile = profiles.get(name).unwrap();
        let other = other.map(|other| profiles.get(other).unwrap().as_ref());
        text += &family(profile, other);
    }
    let here = |name: &str| FAMILIES.iter().any(|(family, _)| *family == name);
    let missing = profiles.iter().find(|one| one.base.is_none() && !here(&one.name));
    assert!(missing.is_none(), "{missing:?} is missing here");
    text + "\n"
}

/// All lines, or those that the other family does not have.
fn family(profile: &Profile, other: Option<&Profile>) -> String {
    let but = other.map_or(String::new(), |other| format!(", as `{}` except", other.name));
    let mut text = format!("\n### `{}`{but}\n\n", profile.name);
    for step in Step::ALL {
        let known = other.map_or(&[][..], |other| other.commissioning.lines(step));
        let lines = profile
            .commissioning
            .lines(step)
            .iter()
            .filter(|line| !known.contains(line));
        for (place, line) in lines.enumerate() {
            let head = if place == 0 {
                format!("**{}**: ", step.title())
            } else {
                String::new()
            };
            let _ = writeln!(text, "- {head}{line}");
        }
    }
    text
}
