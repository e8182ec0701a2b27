//! Limits of requests, and which points are commanded and polled.

use super::*;

/// Limits, table 9.26; line facts, section 2; the text of `show` about writes, 5.5.
#[test]
fn limits_and_lines() {
    let limit = |name: &str, table, address| {
        let profile = profile(name);
        profile.range(table, address).map(|r| (r.read, r.write))
    };
    let holding = Table::Holding;
    for (name, address, wanted) in [
        ("vacon-nx", 0, Some((30, 0))),
        ("vacon-nx", 97, Some((30, 0))),
        ("vacon-nx", 98, Some((30, 0))),
        ("vacon-nx", 99, None),
        ("vacon-nx", 1998, Some((30, 1))),
        ("vacon-nx", 1999, None),
        ("vacon-nx", 2010, Some((20, 20))),
        ("vacon-nx", 2011, None),
        ("vacon-nx", 2110, Some((20, 0))),
        ("eaton-svx", 0, Some((1, 0))),
        ("eaton-hvx", 98, Some((1, 0))),
        ("eaton-svx", 100, Some((1, 1))),
        ("eaton-hvx", 2000, Some((20, 20))),
        ("eaton-svx", 2100, Some((20, 0))),
        ("vacon-cx", 0, Some((1, 1))),
        ("vacon-cx", 99, None),
        ("vacon-cx", 9900, Some((1, 1))),
        ("vacon-cx", 9999, None),
        ("teco-7300pa", 0, None),
        ("teco-7300pa", 1, Some((16, 16))),
        ("teco-7300pa", 0x20, Some((16, 0))),
        ("teco-7300pa", 0x3E, None),
        ("teco-7300pa", 0x100, None),
        ("teco-7300pa", 0x126, Some((16, 16))),
        ("teco-7300pa", 0x519, Some((16, 16))),
        ("teco-7300pa", 0x51A, None),
    ] {
        assert_eq!(limit(name, holding, address), wanted, "{name} {address:#06x}");
    }
    for (name, protocol, addresses, turnaround) in [
        ("vacon-nx", Protocol::ModbusRtu, 1..=247, 2),
        ("eaton-svx", Protocol::ModbusRtu, 1..=247, 2),
        ("vacon-cx", Protocol::ModbusRtu, 1..=247, 2),
        ("teco-7300pa", Protocol::ModbusAscii, 1..=31, 15),
        ("teco-7300pa-n2", Protocol::N2, 1..=255, 15),
        ("vacon-nx-n2", Protocol::N2, 1..=247, 5),
    ] {
        let profile = profile(name);
        assert_eq!(
            (&profile.protocols[..], &profile.addresses),
            (&[protocol][..], &addresses),
            "{name}"
        );
        assert_eq!(profile.turnaround.as_millis(), turnaround, "{name}");
    }
    let teco = profile("teco-7300pa");
    let when = |address| teco.range(holding, address).unwrap().write_when.clone();
    for address in [0x0001, 0x0400, 0x0500] {
        assert_eq!(when(address), "always", "control data, An, Bn");
    }
    for address in [0x0101, 0x0200, 0x0300] {
        assert!(
            when(address).starts_with("only while the drive is in PRGM mode"),
            "Sn, Cn, On"
        );
    }
    // Sn-n = 0100H + n, the other groups begin at xx00H (5.8).
    for (point, address) in [
        ("operation_mode_selection_5", 0x0108),
        ("communication_fault_time", 0x021E),
        ("hunting_prevention_gain", 0x0306),
        ("frequency_command_1", 0x0400),
        ("jog_frequency", 0x0408),
        ("acceleration_time", 0x0500),
        ("pump_on_off_detection_level", 0x0519),
        ("save_parameters", 0x0900),
    ] {
        let index = teco.point_index(point).unwrap();
        assert_eq!(
            teco.points.get(index).unwrap().raw().unwrap().address,
            address,
            "{point}"
        );
    }
}

/// Commands of every family whose manual is available; parameters and outputs of N2 are written on change only.
#[test]
fn commands_of_every_family() {
    for profile in Profiles::built_in().iter().filter(|profile| profile.verified) {
        let name = &profile.name;
        for point in [
            ModelPoint::Run,
            ModelPoint::Reverse,
            ModelPoint::FaultReset,
            ModelPoint::SpeedReference,
            ModelPoint::FrequencyReference,
        ] {
            let found = profile
                .model_point(point)
                .unwrap_or_else(|| panic!("{name}: {}", point.name()));
            assert!(found.write, "{name}: {}", point.name());
            assert_eq!(found.pulse, point == ModelPoint::FaultReset, "{name}: {}", point.name());
        }
        assert!(profile.control.is_some(), "{name}");
        if profile.protocols == [Protocol::N2] {
            let outputs = profile
                .points
                .iter()
                .filter(|p| p.raw().is_some_and(|r| r.table == Table::Holding));
            for point in outputs.filter(|p| p.write) {
                assert!(point.on_change, "{name}: {}", point.name);
            }
        }
        // The range of the reference: signed for Vacon NX on Modbus, of maximum frequency for Eaton (9.2).
        if let Source::Derived(Derived::Band { minimum, .. }) =
            &profile.model_point(ModelPoint::FrequencyReference).unwrap().source
        {
            assert_eq!(*minimum == Bound::Fixed(0.0), name.starts_with("eaton"), "{name}");
        }
    }
}

/// A round of the fast class on N2 takes about 35 ms per object: it must stay below a third of a second.
#[test]
fn process_data_is_few_requests() {
    for (name, most) in [
        ("vacon-nx", 1),
        ("eaton-svx", 1),
        ("eaton-hvx", 1),
        ("teco-7300pa", 1),
        ("vacon-cx", 4),
        ("vacon-nx-n2", 7),
        ("eaton-hvx-n2", 7),
        ("teco-7300pa-n2", 7),
    ] {
        let plan = Plan::of(&profile(name));
        let fast = plan.reads.iter().filter(|r| r.class == PollClass::Fast).count();
        assert_eq!(fast, most, "{name}");
    }
}
