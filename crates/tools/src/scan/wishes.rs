//! The profiles that the command line names for drives whose family no read shows. Pure.

use super::found::Found;
use crate::addresses::{Addresses, parse_addresses};
use drivegate_model::document::nearest;
use drivegate_model::drive::Profile;
use drivegate_model::drive::profile::Profiles;

/// A profile that the command line names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Wish {
    /// The drives it is for; without addresses those that it does not contradict.
    addresses: Option<Addresses>,
    profile: String,
}

/// `NAME`, or `ADDRESSES=NAME`.
pub(super) fn parse_wish(text: &str) -> Result<Wish, String> {
    let (addresses, name) = match text.split_once('=') {
        Some((addresses, name)) => (Some(parse_addresses(addresses)?), name),
        None => (None, text),
    };
    Ok(Wish {
        addresses,
        profile: name.trim().to_string(),
    })
}

/// Refuses names that no profile has.
pub(super) fn check(wishes: &[Wish], profiles: &Profiles) -> Result<(), String> {
    let Some(unknown) = wishes.iter().find(|wish| profiles.get(&wish.profile).is_none()) else {
        return Ok(());
    };
    let name = &unknown.profile;
    let remedy = match nearest(name, profiles.names()) {
        Some(near) => format!("did you mean `{near}`?"),
        None => "`drivegate profiles` lists them".to_string(),
    };
    Err(format!("there is no profile `{name}`; --profile; {remedy}"))
}

/// Gives a drive the profile that was named for it. A remark if a wish without addresses contradicts what the drive
/// answered: then the drive keeps the profile that its answers show.
pub(super) fn apply(wishes: &[Wish], found: &mut Found, profiles: &Profiles) -> Option<String> {
    let fits = |wish: &&Wish| {
        profiles
            .get(&wish.profile)
            .is_some_and(|profile| can_be(profile, found))
    };
    let named = |wish: &&Wish| {
        wish.addresses
            .as_ref()
            .is_some_and(|all| all.0.contains(&found.address))
    };
    let by_address = wishes.iter().filter(fits).find(named);
    let plain = || wishes.iter().filter(fits).find(|wish| wish.addresses.is_none());
    let wish = by_address.or_else(plain)?;
    let is_told = by_address.is_some()
        || found.profiles.is_empty()
        || profiles
            .get(&wish.profile)
            .is_some_and(|profile| is_kind_of(profile, found));
    if !is_told {
        return Some(format!(
            "the drive at address {0} answers like {1}, so it does not get the profile {2}; --profile {0}={2} gives it that",
            found.address,
            found.profiles.join(" or "),
            wish.profile
        ));
    }
    found.choose(&wish.profile);
    None
}

/// Whether a drive of that profile can be at the address, with the protocol that was answered.
pub(crate) fn can_be(profile: &Profile, found: &Found) -> bool {
    profile.protocols.contains(&found.setting.protocol) && profile.addresses.contains(&found.address)
}

/// Whether the answers fit the profile, or the one that it is based on.
fn is_kind_of(profile: &Profile, found: &Found) -> bool {
    let fits = |name: &String| found.profiles.contains(name);
    fits(&profile.name) || profile.base.as_ref().is_some_and(fits)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::Setting;
    use drivegate_proto::{LineFormat, Protocol};

    #[test]
    fn a_named_profile_does_not_contradict_what_a_drive_answers() {
        let profiles = Profiles::built_in();
        let after = |wishes: &[&str], address, fitting: &[&str]| {
            let wishes: Vec<Wish> = wishes.iter().map(|text| parse_wish(text).unwrap()).collect();
            check(&wishes, &profiles).unwrap();
            let mut found = Found {
                setting: Setting {
                    protocol: Protocol::ModbusRtu,
                    format: LineFormat::new(9600, "8N1").unwrap(),
                },
                address,
                profiles: fitting.iter().map(ToString::to_string).collect(),
                chosen: false,
                nameplate: String::new(),
                unanswered: 0,
                turnaround: None,
            };
            let remark = apply(&wishes, &mut found, &profiles);
            (found.profiles.join(","), found.chosen, remark.is_some())
        };
        let is = |name: &str, chosen, remark| (name.to_string(), chosen, remark);
        assert_eq!(after(&["weg-cfw"], 1, &[]), is("weg-cfw", true, false));
        assert_eq!(after(&["weg-cfw"], 1, &["vacon-nx"]), is("vacon-nx", false, true));
        assert_eq!(after(&["1-2=weg-cfw"], 2, &["vacon-nx"]), is("weg-cfw", true, false));
        assert_eq!(after(&["1-2=weg-cfw"], 3, &[]), is("", false, false));
        assert_eq!(after(&["weg-cfw", "3=ls-g100"], 3, &[]), is("ls-g100", true, false));
        // One of several, and a kind of the one that fits.
        let either = after(&["eaton-svx"], 1, &["eaton-hvx", "eaton-svx"]);
        assert_eq!(either, is("eaton-svx", true, false));
        assert_eq!(
            after(&["danfoss-fc51"], 1, &["danfoss-fc"]),
            is("danfoss-fc51", true, false)
        );
        // A profile of another protocol cannot be meant.
        assert_eq!(after(&["1=vacon-nx-n2"], 1, &[]), is("", false, false));
    }

    #[test]
    fn names_that_no_profile_has() {
        let refused = |text: &str| check(&[parse_wish(text).unwrap()], &Profiles::built_in()).unwrap_err();
        let near = refused("weg-cwf");
        assert!(near.ends_with("--profile; did you mean `weg-cfw`?"), "{near}");
        assert!(refused("1=zzz").ends_with("`drivegate profiles` lists them"));
        assert!(parse_wish("x=weg-cfw").is_err());
    }
}
