//! The texts of docs/commissioning.md for each family at the cabinet, generated from the built-in profiles.

use std::fmt::Write;

use drivegate_model::drive::Step;
use drivegate_model::drive::profile::{Profile, Profiles};

/// Each family that is not based on another, with the one that it is compared with.
const FAMILIES: [(&str, Option<&str>); 8] = [
    ("vacon-nx", None),
    ("vacon-nx-n2", Some("vacon-nx")),
    ("eaton-svx", Some("vacon-nx")),
    ("eaton-hvx", Some("eaton-svx")),
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
    let missing = profiles
        .iter()
        .find(|one| one.verified && one.base.is_none() && !here(&one.name));
    assert!(missing.is_none(), "{missing:?} is missing here");
    text + "\n"
}

/// All steps of a family, or those that differ from the other family: the lines missing there, or all lines of a
/// step if some of the other family's lines do not apply.
fn family(profile: &Profile, other: Option<&Profile>) -> String {
    let but = other.map_or(String::new(), |other| format!(", as `{}` except", other.name));
    let mut text = format!("\n### `{}`{but}\n\n", profile.name);
    for step in Step::ALL {
        let known = other.map_or(&[][..], |other| other.commissioning.lines(step));
        let own = profile.commissioning.lines(step);
        // A line replaces one with the same beginning.
        let beginning = |line: &String| line.split(':').next().map(str::to_string);
        let is_replaced = |line: &String| own.iter().any(|one| beginning(one) == beginning(line));
        let all_hold = known.iter().all(is_replaced);
        let lines = own.iter().filter(|line| !all_hold || !known.contains(line));
        for (place, line) in lines.enumerate() {
            let head = match place {
                0 => format!("**{}**: ", step.title()),
                _ => String::new(),
            };
            let _ = writeln!(text, "- {head}{line}");
        }
        assert!(
            known.is_empty() || !own.is_empty(),
            "{}: {} is lost",
            profile.name,
            step.name()
        );
    }
    text
}
