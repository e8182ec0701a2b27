//! Identifies the family of a drive by reads whose outcome differs between families. Pure.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::profile::{Probe, Profile, Profiles};
use crate::codec::Protocol;

/// All probes of the profiles for `protocol`.
pub fn probes(profiles: &Profiles, protocol: Protocol) -> Vec<Probe> {
    let speaking = profiles.iter().filter(|p| p.protocols.contains(&protocol));
    let mut probes: Vec<Probe> = speaking.flat_map(|p| p.identify.iter().map(|e| e.probe)).collect();
    probes.sort();
    probes.dedup();
    probes
}

/// The profiles that fit all outcomes, reduced to those with the most probes. `outcomes` holds whether a probe was
/// answered with values; a probe without an answer is absent and fits no profile.
pub fn fitting(profiles: &Profiles, protocol: Protocol, outcomes: &BTreeMap<Probe, bool>) -> Vec<Arc<Profile>> {
    let fits = |profile: &&Arc<Profile>| {
        profile.protocols.contains(&protocol)
            && !profile.identify.is_empty()
            && profile
                .identify
                .iter()
                .all(|e| outcomes.get(&e.probe) == Some(&e.values))
    };
    let fitting: Vec<&Arc<Profile>> = profiles.iter().filter(fits).collect();
    let most = fitting.iter().map(|p| p.identify.len()).max().unwrap_or(0);
    fitting
        .into_iter()
        .filter(|p| p.identify.len() == most)
        .cloned()
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::Table;

    fn profiles() -> Profiles {
        let mut profiles = Profiles::default();
        let one = |name: &str, identify: &str| {
            let text = format!(
                "name = \"{name}\"\nprotocols = [\"modbus-rtu\"]\n{identify}\n[[range]]\ntable = \"holding\"\n\
                 first = 0\nlast = 9\n[[point]]\nname = \"a\"\nat = \"holding 0\"\n"
            );
            Profile::parse("p.toml", &text, false).unwrap()
        };
        let expect = |read: &str, answer: &str| format!("[[identify]]\nread = \"{read}\"\nanswer = \"{answer}\"\n");
        profiles.insert(one("plain", &expect("holding 0 1", "values")));
        profiles.insert(one(
            "special",
            &(expect("holding 0 1", "values") + &expect("coil 0x10 2", "refused")),
        ));
        profiles.insert(one("silent", ""));
        profiles
    }

    #[test]
    fn the_profile_with_most_probes_wins() {
        let profiles = profiles();
        let [coil, holding] = probes(&profiles, Protocol::ModbusRtu)[..] else {
            panic!()
        };
        assert_eq!((coil.table, coil.start, coil.count), (Table::Coil, 16, 2));
        let names = |outcomes: &[(Probe, bool)]| -> Vec<String> {
            let outcomes = outcomes.iter().copied().collect();
            let fitting = fitting(&profiles, Protocol::ModbusRtu, &outcomes);
            fitting.iter().map(|p| p.name.clone()).collect()
        };
        assert_eq!(names(&[(holding, true), (coil, false)]), ["special"]);
        assert_eq!(names(&[(holding, true), (coil, true)]), ["plain"]);
        assert_eq!(names(&[(holding, true)]), ["plain"], "no answer to the other");
        assert!(names(&[(holding, false), (coil, false)]).is_empty());
        assert!(fitting(&profiles, Protocol::N2, &BTreeMap::from([(holding, true)])).is_empty());
    }
}
