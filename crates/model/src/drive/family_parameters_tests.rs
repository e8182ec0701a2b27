//! Parameters and fault texts of the families that are not verified, against tables by hand.

use super::parameters::{Parameter, has};
use super::profile::Profiles;
use super::{ModelPoint, Profile};

/// Family, then parameters as `id=register`, x and the value of a count where it is known.
const PARAMETERS: &str = "\
abb-acs550 2202=2201x0.1 2203=2202x0.1 2007=2006x0.1 2008=2007x0.1 3018=3017x1 3019=3018x0.1 9905=9904x1 9906=9905x0.1 9908=9907x1
danfoss-fc 1-22=1219x1 1-23=1229x1 1-25=1249x1 4-12=4119x0.1 4-14=4139x0.1
danfoss-fc51 1-22=1219x1 4-14=4139x0.1
delta-ms300 01-00=256x0.01 01-02=258x0.1 01-10=266x0.01 01-11=267x0.01 01-12=268 01-13=269 01-19=275 09-02=2306x1 09-03=2307
hitachi-wj200 A001=4608x1 A002=4609x1 A003=4610x0.1 A004=4611x0.1 b091=4957x1
invt-goodrive P00.01=1x1 P00.03=3x0.01 P00.06=6x1 P00.11=11x0.1 P00.12=12x0.1 P14.04=3588
schneider-altivar tFr=3103x0.1 HSP=3104x0.1 LSP=3105x0.1 ttO=6005x0.1 ACC=9001 dEC=9002 UnS=9601x1 FrS=9602x0.1 nCr=9603x0.1 ItH=9622x0.1
siemens-v20 40001=0 40010=9x0.1 40011=10x0.01 40012=11x0.01 40016=15x0.01
vacon-10 101=100x0.01 102=101x0.01 103=102x0.1 104=103x0.1 117=116x1 172=171x1 601=600x0.1
weg-cfw P0100=100x0.1 P0101=101x0.1 P0135=135x0.1 P0313=313x1 P0314=314x0.1 P0400=400x1 P0401=401x0.1 P0403=403x1 P0407=407x0.01";

fn profile(name: &str) -> std::sync::Arc<Profile> {
    Profiles::built_in().get(name).unwrap().clone()
}

fn parameter<'a>(profile: &'a Profile, id: &str) -> &'a Parameter {
    let mut named = profile.parameters.named.iter();
    named
        .find(|parameter| parameter.id == id)
        .unwrap_or_else(|| panic!("{id} of {}", profile.name))
}

#[test]
fn parameters_are_where_the_sources_have_them() {
    for line in PARAMETERS.lines() {
        let (family, cells) = line.split_once(' ').unwrap();
        let profile = profile(family);
        for cell in cells.split(' ') {
            let (id, place) = cell.split_once('=').unwrap();
            let (address, scale) = place.split_once('x').unwrap_or((place, "0"));
            let found = parameter(&profile, id);
            assert_eq!(found.address.to_string(), address, "{id} of {family}");
            assert_eq!(found.label.scale.to_string(), scale, "{id} of {family}");
        }
    }
}

/// What chooses who commands the drive, and what the drive does without its line, is not restored by the way.
#[test]
fn sources_and_lines_are_restored_by_name_only() {
    for (family, ids) in [
        (
            "abb-acs550",
            &["1001", "1002", "1102", "1103", "3018", "5302", "5305", "9802"][..],
        ),
        ("delta-ms300", &["09-02", "09-03"]),
        ("hitachi-wj200", &["A001", "A002", "b091"]),
        ("invt-goodrive", &["P00.01", "P00.06", "P14.04"]),
        ("schneider-altivar", &["ttO", "CHCF", "Fr1", "Cd1"]),
        ("siemens-v20", &["40001", "40002", "40016"]),
        ("vacon-10", &["117", "172"]),
        (
            "weg-cfw",
            &["P0220", "P0222", "P0226", "P0227", "P0308", "P0313", "P0314"],
        ),
    ] {
        let profile = profile(family);
        for id in ids {
            let address = parameter(&profile, id).address;
            let by_name = &profile.parameters.rules.only_by_name;
            assert!(
                by_name.iter().any(|(range, _)| range.contains(&address)),
                "{id} of {family}"
            );
        }
        let ramps = profile.parameters.named.iter().filter(|parameter| {
            let name = &parameter.label.name;
            name.starts_with("Acceleration") || name.starts_with("Deceleration")
        });
        for ramp in ramps {
            let by_name = &profile.parameters.rules.only_by_name;
            let held_back = by_name.iter().any(|(range, _)| range.contains(&ramp.address));
            assert!(!held_back, "{} of {family}", ramp.id);
        }
    }
    let danfoss = profile("danfoss-fc");
    let volatile = &danfoss.parameters.rules.volatile;
    let mut all = danfoss.parameters.named.iter();
    assert!(all.all(|parameter| has(volatile, parameter.address)));
    for (family, save) in [("abb-acs550", (1606, 1)), ("hitachi-wj200", (0x08FF, 1))] {
        assert_eq!(profile(family).parameters.rules.save, Some(save), "{family}");
    }
}

/// No source for the codes of these was found; docs/drives.md says so.
const WITHOUT_TEXTS: [&str; 4] = ["delta-ms300", "mitsubishi-d700", "toshiba-vf-s15", "yaskawa-v1000"];

#[test]
fn every_fault_code_has_texts_or_is_known_to_have_none() {
    for profile in Profiles::built_in().iter() {
        let shows = profile.model_point(ModelPoint::FaultCode).is_some();
        let without = WITHOUT_TEXTS.contains(&profile.name.as_str());
        assert_eq!(
            profile.faults.is_empty(),
            without || !shows,
            "{}: texts of its fault codes",
            profile.name
        );
    }
    for (family, code, text) in [
        ("abb-acs550", 4, "short circuit"),
        ("abb-acs580", 0x3210, "DC link overvoltage"),
        ("fuji-frenic", 46, "output phase lost"),
        ("invertek-optidrive", 50, "Modbus lost"),
        ("invertek-eco", 50, "Modbus lost"),
        ("invt-goodrive", 13, "input phase lost"),
        ("siemens-v20", 3, "DC link undervoltage"),
        ("vacon-10", 41, "IGBT overtemperature"),
        ("weg-cfw", 74, "earth fault"),
    ] {
        assert_eq!(profile(family).fault_text(code), text, "{family} {code}");
    }
}

/// A family that is not verified says for each fault what may be the cause and what to check.
#[test]
fn faults_have_cause_and_remedy() {
    for profile in Profiles::built_in().iter().filter(|profile| !profile.verified) {
        for (code, fault) in profile.faults.iter().filter(|(_, fault)| !fault.remedy.is_empty()) {
            assert!(!fault.cause.is_empty(), "{code} of {}", profile.name);
            assert!(
                fault.remedy.ends_with(" (general advice)"),
                "{code} of {}",
                profile.name
            );
        }
        let explained = profile.faults.values().filter(|fault| !fault.remedy.is_empty()).count();
        assert!(profile.faults.is_empty() || explained >= 6, "{}", profile.name);
    }
}
