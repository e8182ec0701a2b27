//! The profile of devices whose family no read shows: a question on a terminal, elsewhere a list of what to name.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::sync::Arc;

use super::Stop;
use super::dialog::Keyboard;
use crate::printable;
use crate::scan::{Found, Search, can_be};
use drivegate_model::drive::Profile;
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::Protocol;

/// Asks for the profile of the devices that are not identified, one question a protocol.
pub(super) fn name_the_unknown(search: &mut Search<'_>, stop: &Stop, keyboard: &Keyboard) {
    for protocol in Protocol::ALL {
        let unknown: Vec<&Found> = unknown(&search.found, protocol).collect();
        let profiles = candidates(&search.profiles, &unknown);
        let (Some(places), false) = (addresses(&unknown), profiles.is_empty()) else {
            continue;
        };
        let plates = nameplates(&unknown);
        let _ = write!(io::stderr().lock(), "\n{}", list(&(places + &plates), &profiles));
        let Some(name) = answer(&profiles, stop, keyboard) else {
            continue;
        };
        for found in &mut search.found {
            if found.profiles.is_empty() && found.setting.protocol == protocol {
                found.choose(&name);
            }
        }
    }
}

/// Error and remedy where no device has a profile.
pub(super) fn nobody_is_known(search: &Search<'_>) -> String {
    let all: Vec<&Found> = search.found.iter().collect();
    let names = candidates(&search.profiles, &all);
    let names: Vec<&str> = names.iter().map(|profile| profile.name.as_str()).collect();
    format!(
        "a device answers at {}, but no read shows its family, so there is nothing to show; the configuration above; \
         name its profile: --profile NAME, with one of {} (`drivegate profiles` has makers and types)",
        addresses(&all).unwrap_or_default(),
        names.join(", ")
    )
}

fn unknown(found: &[Found], protocol: Protocol) -> impl Iterator<Item = &Found> {
    let of = move |found: &&Found| found.profiles.is_empty() && found.setting.protocol == protocol;
    found.iter().filter(of)
}

/// `address 3`, or `addresses 3, 4, 7`.
fn addresses(found: &[&Found]) -> Option<String> {
    let numbers: Vec<String> = found.iter().map(|found| found.address.to_string()).collect();
    match numbers.as_slice() {
        [] => None,
        [one] => Some(format!("address {one}")),
        more => Some(format!("addresses {}", more.join(", "))),
    }
}

/// What they call themselves, behind their addresses.
fn nameplates(found: &[&Found]) -> String {
    let plates = found.iter().map(|found| found.nameplate.as_str());
    let plates: BTreeSet<&str> = plates.filter(|plate| !plate.is_empty()).collect();
    if plates.is_empty() {
        String::new()
    } else {
        format!(" ({})", plates.into_iter().collect::<Vec<_>>().join(", "))
    }
}

/// The profiles that all of these can have, by maker.
fn candidates(profiles: &Profiles, found: &[&Found]) -> Vec<Arc<Profile>> {
    let fits = |profile: &&Arc<Profile>| found.iter().all(|found| can_be(profile, found));
    let mut all: Vec<Arc<Profile>> = profiles.iter().filter(fits).cloned().collect();
    all.sort_by_key(|profile| (profile.title.to_lowercase(), profile.name.clone()));
    all
}

fn list(places: &str, profiles: &[Arc<Profile>]) -> String {
    let width = profiles.iter().map(|profile| profile.name.len()).max().unwrap_or(0);
    let one = |(number, profile): (usize, &Arc<Profile>)| {
        let line = format!("  {number:>2}  {:width$}  {}", profile.name, profile.title);
        printable::line(&line) + "\n"
    };
    let lines: String = (1..).zip(profiles).map(one).collect();
    format!("No read shows the family at {places}. Which make is it, by the nameplate?\n{lines}")
}

/// Name of the profile; `None` where none is wanted, or after a signal.
fn answer(profiles: &[Arc<Profile>], stop: &Stop, keyboard: &Keyboard) -> Option<String> {
    loop {
        let answer = keyboard.ask("Number or name, or Enter for none of these:", stop)?;
        if answer.is_empty() {
            return None;
        }
        match chosen(&answer, profiles) {
            Some(profile) => return Some(profile.name.clone()),
            None => drop(writeln!(
                io::stderr().lock(),
                "Write a number from 1 to {}, or a name of the list.",
                profiles.len()
            )),
        }
    }
}

fn chosen<'p>(answer: &str, profiles: &'p [Arc<Profile>]) -> Option<&'p Arc<Profile>> {
    let number = answer.parse::<usize>().ok().and_then(|number| number.checked_sub(1));
    match number {
        Some(place) => profiles.get(place),
        None => profiles.iter().find(|profile| profile.name == answer),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::Setting;
    use drivegate_proto::LineFormat;

    fn found(protocol: Protocol, address: u8) -> Found {
        Found {
            setting: Setting {
                protocol,
                format: LineFormat::new(9600, "8N1").unwrap(),
            },
            address,
            profiles: Vec::new(),
            chosen: false,
            nameplate: String::new(),
            unanswered: 0,
            turnaround: None,
        }
    }

    #[test]
    fn makes_are_listed_for_the_protocol_that_answers() {
        let profiles = Profiles::built_in();
        let (one, other) = (found(Protocol::ModbusRtu, 3), found(Protocol::ModbusRtu, 7));
        let rtu = candidates(&profiles, &[&one, &other]);
        assert!(
            rtu.iter()
                .all(|profile| profile.protocols.contains(&Protocol::ModbusRtu))
        );
        let text = list(&addresses(&[&one, &other]).unwrap(), &rtu);
        assert!(
            text.starts_with("No read shows the family at addresses 3, 7. Which make"),
            "{text}"
        );
        let place = |name: &str| rtu.iter().position(|profile| profile.name == name).unwrap();
        assert!(place("abb-acs550") < place("danfoss-fc51") && place("danfoss-fc51") < place("weg-cfw"));
        let number = (place("weg-cfw") + 1).to_string();
        for (answer, wanted) in [
            (number.as_str(), Some("weg-cfw")),
            ("weg-cfw", Some("weg-cfw")),
            ("0", None),
            ("99", None),
            ("weg", None),
        ] {
            let chosen = chosen(answer, &rtu).map(|profile| profile.name.as_str());
            assert_eq!(chosen, wanted, "{answer}");
        }
        let n2 = candidates(&profiles, &[&found(Protocol::N2, 255)]);
        assert!(!n2.is_empty() && n2.iter().all(|profile| profile.protocols == [Protocol::N2]));
    }
}
