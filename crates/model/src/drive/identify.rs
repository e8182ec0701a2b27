//! Identifies the family of a drive by reads whose outcome differs between families. Pure.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::profile::{Probe, Profile, Profiles};
use drivegate_proto::{Protocol, Table};

/// A read that no profile's drive answers with values: a device that does has values everywhere, and then only what it refuses
/// tells its family.
pub const NOWHERE: Probe = Probe {
    table: Table::Holding,
    start: 0xEEEE,
    count: 1,
};

/// Objects of the device identification (function 43/14): vendor, product, and its name.
pub const VENDOR: u8 = 0;
/// Code of the product.
pub const PRODUCT: u8 = 1;
/// Name of the product, which not every device has.
pub const PRODUCT_NAME: u8 = 4;

/// What a device calls itself: the objects of its identification.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Nameplate(BTreeMap<u8, String>);

impl Nameplate {
    /// Adds the objects of a reply to function 43/14, from the read code on; what is cut short is left out.
    pub fn add(&mut self, reply: &[u8]) {
        let mut rest = reply.get(5..).unwrap_or_default();
        while let [object, length, more @ ..] = rest {
            let Some((text, behind)) = more.split_at_checked(usize::from(*length)) else {
                return;
            };
            let text = String::from_utf8_lossy(text);
            let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
            self.0.insert(*object, text.to_string());
            rest = behind;
        }
    }

    /// The text of an object.
    pub fn get(&self, object: u8) -> Option<&str> {
        self.0.get(&object).map(String::as_str).filter(|text| !text.is_empty())
    }

    /// `WEG CFW-08 7.0A`; empty if the device has no identification.
    pub fn text(&self) -> String {
        let parts = [VENDOR, PRODUCT, PRODUCT_NAME]
            .into_iter()
            .filter_map(|object| self.get(object));
        parts.collect::<Vec<_>>().join(" ")
    }

    /// Whether the vendor is that of `plate`, and a product begins as the rest of it.
    fn fits(&self, plate: &str) -> bool {
        let Some(vendor) = self.get(VENDOR) else { return false };
        let (maker, product) = plate.split_once(' ').unwrap_or((plate, ""));
        let begins = |object| {
            let begin = self.get(object).and_then(|text| text.get(..product.len()));
            begin.is_some_and(|begin| begin.eq_ignore_ascii_case(product))
        };
        vendor.eq_ignore_ascii_case(maker) && (begins(PRODUCT) || begins(PRODUCT_NAME))
    }
}

/// The profiles for `protocol` of which a drive has this nameplate.
pub fn named(profiles: &Profiles, protocol: Protocol, nameplate: &Nameplate) -> Vec<Arc<Profile>> {
    let fits = |profile: &&Arc<Profile>| {
        profile.protocols.contains(&protocol) && profile.nameplates.iter().any(|plate| nameplate.fits(plate))
    };
    profiles.iter().filter(fits).cloned().collect()
}

/// All probes of the profiles for `protocol`.
pub fn probes(profiles: &Profiles, protocol: Protocol) -> Vec<Probe> {
    let speaking = profiles.iter().filter(|p| p.protocols.contains(&protocol));
    let mut probes: Vec<Probe> = speaking.flat_map(|p| p.identify.iter().map(|e| e.probe)).collect();
    if !probes.is_empty() && protocol != Protocol::N2 {
        probes.push(NOWHERE);
    }
    probes.sort();
    probes.dedup();
    probes
}

/// The profiles that fit all outcomes, reduced to those with the most probes. `outcomes` holds whether a probe was
/// answered with values; a probe without an answer is absent and fits no profile. Of a device that has values everywhere,
/// values prove nothing.
pub fn fitting(profiles: &Profiles, protocol: Protocol, outcomes: &BTreeMap<Probe, bool>) -> Vec<Arc<Profile>> {
    let everywhere = outcomes.get(&NOWHERE) == Some(&true);
    let fits = |profile: &&Arc<Profile>| {
        profile.protocols.contains(&protocol)
            && profile.identify.iter().any(|e| !(everywhere && e.values))
            && profile
                .identify
                .iter()
                .all(|e| outcomes.get(&e.probe) == Some(&e.values))
    };
    let fitting: Vec<&Arc<Profile>> = profiles.iter().filter(fits).collect();
    let most = fitting.iter().map(|p| p.identify.len()).max().unwrap_or(0);
    let fitting = fitting.into_iter().filter(|p| p.identify.len() == most);
    let mut fitting: Vec<Arc<Profile>> = fitting.cloned().collect();
    // The first of profiles that cannot be distinguished is used: one that was seen right on hardware.
    fitting.sort_by_key(|profile| !profile.verified);
    fitting
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let [coil, holding, NOWHERE] = probes(&profiles, Protocol::ModbusRtu)[..] else {
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
        assert!(names(&[(holding, true), (coil, true), (NOWHERE, true)]).is_empty());
        assert_eq!(names(&[(holding, true), (coil, false), (NOWHERE, true)]), ["special"]);
        assert!(fitting(&profiles, Protocol::N2, &BTreeMap::from([(holding, true)])).is_empty());
    }

    #[test]
    fn a_nameplate_names_the_family() {
        let reply = |objects: &[(u8, &str)]| {
            let mut reply = vec![1, 1, 0, 0, objects.len() as u8];
            for (object, text) in objects {
                reply.extend([*object, text.len() as u8]);
                reply.extend(text.as_bytes());
            }
            reply
        };
        let profiles = Profiles::built_in();
        let fitting = |objects: &[(u8, &str)]| {
            let mut plate = Nameplate::default();
            plate.add(&reply(objects));
            let names = named(&profiles, Protocol::ModbusRtu, &plate)
                .into_iter()
                .map(|p| p.name.clone());
            (names.collect::<Vec<_>>(), plate.text())
        };
        let (names, text) = fitting(&[(0, "WEG"), (1, "CFW500 10.0A\0"), (2, "V1.80")]);
        assert_eq!(
            (names, text.as_str()),
            (vec!["weg-cfw".to_string()], "WEG CFW500 10.0A")
        );
        // The CFW-08 has other words.
        let (names, text) = fitting(&[(0, "WEG"), (1, "CFW-08 7.0A"), (2, "V3.77")]);
        assert_eq!((names.len(), text.as_str()), (0, "WEG CFW-08 7.0A"));
        let (names, _) = fitting(&[(0, "ABB"), (1, "ASCCL"), (4, "ACS580")]);
        assert_eq!(names, ["abb-acs580"]);
        assert!(fitting(&[(0, "ABB"), (1, "AINFX"), (4, "ACS880")]).0.is_empty());
        assert!(fitting(&[(1, "CFW500"), (4, "ACS580")]).0.is_empty(), "no vendor");
        let mut cut = Nameplate::default();
        cut.add(&[1, 1, 0, 0, 1, 0, 9, b'W']);
        assert_eq!(cut, Nameplate::default());
    }
}
