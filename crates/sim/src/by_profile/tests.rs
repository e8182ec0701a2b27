//! Families tested by hand: their words come from the manuals, not from their profiles.

use drivegate_testkit::Order::Word;
use drivegate_testkit::{Family, Order, families, number, orders, rows};
use proptest::prelude::*;

use super::*;
use crate::simulated_drive::{DriveOptions, ModelOptions, SimulatedDrive};
use drivegate_model::drive::identify::{self, Nameplate};
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::Protocol;

mod own_profile;

struct ProfiledDrive {
    drive: SimulatedDrive,
    trip_address: u16,
    now: SimTime,
}

impl ProfiledDrive {
    fn of(profile: &Arc<Profile>) -> ProfiledDrive {
        let mut model = ModelOptions::of_profile(profile).unwrap();
        assert!(matches!(model, ModelOptions::Profile(_)), "{}", profile.name);
        model.set_trip_register(true);
        let trip_address = model.trip_address();
        ProfiledDrive {
            drive: SimulatedDrive::new(DriveOptions::new(1, model), SimTime::ZERO),
            trip_address,
            now: SimTime::ZERO,
        }
    }

    fn named(name: &str) -> ProfiledDrive {
        ProfiledDrive::of(Profiles::built_in().get(name).unwrap())
    }

    fn ask(&mut self, request: &RequestPdu) -> Reply {
        self.drive.answer(request, self.now).unwrap()
    }

    /// Sends the orders, 100 ms apart.
    fn send(&mut self, orders: &[Order]) {
        for order in orders {
            assert_eq!(self.ask(&order.pdu()), Reply::Written, "{order:?}");
            self.wait(100);
        }
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += Duration::from_millis(milliseconds);
        self.drive.advance(self.now);
    }

    fn output(&self) -> f64 {
        self.drive.state().output
    }

    fn register(&mut self, table: Table, address: u16) -> u16 {
        let request = RequestPdu::read(table, address, 1);
        self.ask(&request)
            .into_words()
            .unwrap_or_else(|| panic!("{table:?} {address}"))[0]
    }
}

/// A family, and what its drives must show.
struct Case {
    family: Family,
    reset: Vec<Order>,
    /// The status register while the motor runs forward: address, relevant bits, and their values, from the manuals.
    runs: [u16; 3],
    fault: [u16; 3],
    /// Orders that must not start the motor when each is given alone at standstill.
    idle: Vec<Order>,
}

/// Columns: profile, reset, status register while running and with a fault, words that start nothing.
const CASES: &str = "\
abb-acs550         | 0=0x47E,0x4FE,0x47E         | 3 0x000F 0x0007      | 3 0x000C 0x0008      | 0=0x47F,0x1,0x477,0x4FF,0x7F,0x4FE
abb-acs580         | 0=0x47E,0x4FE,0x47E         | 3 0x000F 0x0007      | 3 0x000C 0x0008      | 0=0x47F,0x1
danfoss-fc         | 49999=0x43C,0x4BC,0x43C     | 50199 0x080B 0x0803  | 50199 0x0808 0x0008  | 49999=0x7C,0x474,0x45C,0x46C,0x4BC
siemens-v20        | 99=0x47E,0x4FE,0x47E        | 109 0x000F 0x0007    | 109 0x000C 0x0008    | 99=0x47F,0x7F,0x47D,0x47B
siemens-g120       | 99=0x47E,0x4FE,0x47E        | 109 0x000F 0x0007    | 109 0x000C 0x0008    | 99=0x47F,0x77
schneider-altivar  | 8501=0,0x80,0               | 3201 0x006F 0x0027   | 3201 0x004F 0x0008   | 8501=15,7,0x80,6,3
yaskawa-v1000      | 1=[0] 1=[8] 1=[0]           | 0x4B 0x0081 0x0001   | 0x4B 0x0081 0x0080   | 1=[3] 1=[8] 1=[0x10]
delta-ms300        | 0x2002=2,0                  | 0x2101 0x001B 0x0003 | 0x2100 0x00FF 0x0004 | 0x2000=0,0x10 0x2002=2 0x2000=3
invt-goodrive      | 0x2000=7                    | 0x2100 0xFFFF 1      | 0x2102 0xFFFF 4      | 0x2000=0,6,7
mitsubishi-d700    | 1=0x9696                    | 8 0x0081 0x0001      | 8 0x0081 0x0080      | 8=6,1,8
invertek-optidrive | 0=0,4,0                     | 5 0x0003 0x0001      | 5 0x0003 0x0002      | 0=9,4,2
weg-cfw            | 682=0x16,0x96,0x16          | 680 0x8100 0x0100    | 680 0x8100 0x8000    | 682=0x7,0x15,0x96,0x57
fuji-frenic        | 0x0706=0,0x8000,0           | 0x080E 0x0809 0x0001 | 0x080E 0x0800 0x0800 | 0x0706=3,0x8000,4
hitachi-wj200      | 0=off 3=on 3=off            | 0x1001 0xFFFF 2500   | 0x1001 0xFFFF 0      | 1=on 3=on
toshiba-vf-s15     | 0xFA00=0xC000,0xE000,0xC000 | 0xFD01 0x0602 0x0400 | 0xFD01 0x0402 0x0002 | 0xFA00=0x400,0xCC00,0xE000
ls-g100            | 5=8                         | 13 0x000E 0x0002     | 13 0x000E 0x0008     | 5=0,6,8,0x12
teco-f510          | 0x2501=0,8,0                | 0x2520 0x000B 0x0001 | 0x2520 0x0009 0x0008 | 0x2501=2,8,0x10
vacon-10           | 2000=0,4,0                  | 2100 0x000E 0x0002   | 2100 0x000A 0x0008   | 2000=2,4";

/// All cases in the order of [`families`].
fn cases() -> Vec<Case> {
    let register = |text: &str| -> [u16; 3] {
        let numbers: Vec<u16> = text.split_whitespace().map(number).collect();
        numbers.try_into().unwrap()
    };
    let rows = rows::<5>(CASES).into_iter();
    let case = |(family, [profile, reset, runs, fault, idle]): (Family, [&str; 5])| {
        assert_eq!(family.profile, profile);
        Case {
            family,
            reset: orders(reset),
            runs: register(runs),
            fault: register(fault),
            idle: orders(idle),
        }
    };
    let families = families();
    assert_eq!(families.len(), rows.len());
    families.into_iter().zip(rows).map(case).collect()
}

/// A rig whose motor turns forward at 25 Hz.
fn running(case: &Case) -> ProfiledDrive {
    let mut rig = ProfiledDrive::named(case.family.profile);
    rig.send(&case.family.reference);
    rig.send(&case.family.start);
    rig.wait(5000);
    assert!(
        (rig.output() - 25.0).abs() < 0.01,
        "{}: {}",
        case.family.profile,
        rig.output()
    );
    rig
}

#[test]
fn every_family_starts_turns_and_stops_by_its_words() {
    for case in &cases() {
        let name = case.family.profile;
        let mut rig = running(case);
        let [address, mask, is] = case.runs;
        assert_eq!(rig.register(Table::Holding, address) & mask, is, "{name}");
        rig.send(&case.family.stop);
        assert!(rig.output() > 20.0, "{name}: the motor ramps");
        rig.wait(5000);
        assert_eq!(rig.output(), 0.0, "{name}");
        assert_ne!(rig.register(Table::Holding, address) & mask, is, "{name}");
        if !case.family.reverse.is_empty() {
            rig.send(&case.family.start);
            rig.wait(3000);
            rig.send(&case.family.reverse);
            rig.wait(8000);
            assert!((rig.output() + 25.0).abs() < 0.01, "{name}: {}", rig.output());
            rig.send(&case.family.stop);
            rig.wait(5000);
            assert_eq!(rig.output(), 0.0, "{name}");
        }
    }
}

#[test]
fn words_that_start_nothing() {
    for case in &cases() {
        for order in &case.idle {
            let mut rig = ProfiledDrive::named(case.family.profile);
            rig.send(&case.family.reference);
            let _refused = rig.ask(&order.pdu());
            rig.wait(1000);
            assert!(!rig.drive.state().running, "{}: {order:?}", case.family.profile);
        }
        // Without the first word of the start sequence, a drive must not run.
        if case.family.start.len() > 1 && case.family.profile != "hitachi-wj200" {
            let mut rig = ProfiledDrive::named(case.family.profile);
            rig.send(&case.family.reference);
            rig.send(&case.family.start[1..]);
            rig.wait(1000);
            assert!(!rig.drive.state().running, "{}", case.family.profile);
        }
    }
}

#[test]
fn faults_are_reset_and_start_nothing() {
    for case in &cases() {
        let name = case.family.profile;
        let mut rig = running(case);
        let trip = Word(rig.trip_address, 4);
        rig.send(&[trip]);
        assert_eq!((rig.drive.state().fault, rig.output()), (4, 0.0), "{name}");
        let [address, mask, is] = case.fault;
        assert_eq!(rig.register(Table::Holding, address) & mask, is, "{name}");
        rig.send(&case.family.start);
        rig.wait(1000);
        assert!(!rig.drive.state().running, "{name}: with a fault");
        if case.reset.is_empty() {
            continue;
        }
        rig.send(&case.reset);
        rig.wait(1000);
        assert_eq!((rig.drive.state().fault, rig.output()), (0, 0.0), "{name}");
        rig.send(&case.family.stop);
        rig.send(&case.family.start);
        rig.wait(5000);
        assert!((rig.output() - 25.0).abs() < 0.01, "{name}: runs anew");
    }
}

/// Fuji and Vacon 10: a reset while the run command is on starts the motor; with other families the command must be
/// given again.
#[test]
fn a_reset_with_a_run_command() {
    for (name, orders, starts) in [
        ("fuji-frenic", [Word(0x0706, 1), Word(0x0706, 0x8001)], true),
        ("vacon-10", [Word(2000, 1), Word(2000, 5)], true),
        ("weg-cfw", [Word(682, 0x17), Word(682, 0x97)], false),
    ] {
        let mut rig = ProfiledDrive::named(name);
        rig.send(&[Word(rig.trip_address, 1)]);
        rig.send(&orders);
        rig.wait(1000);
        assert_eq!(
            (rig.drive.state().fault, rig.drive.state().running),
            (0, starts),
            "{name}"
        );
    }
}

/// Panel control: the motor stops, the bus is ignored, and a command written meanwhile does not start the motor afterwards.
#[test]
fn a_drive_at_its_panel_does_not_obey_the_bus() {
    for case in &cases() {
        let mut rig = running(case);
        let panel = rig.trip_address + 1;
        rig.send(&[Word(panel, 1)]);
        rig.wait(5000);
        assert_eq!(
            (rig.output(), rig.drive.state().remote),
            (0.0, false),
            "{}",
            case.family.profile
        );
        rig.send(&case.family.start);
        rig.send(&[Word(panel, 0)]);
        rig.wait(1000);
        assert!(!rig.drive.state().running, "{}", case.family.profile);
        rig.send(&case.family.stop);
        rig.send(&case.family.start);
        rig.wait(1000);
        assert!(rig.drive.state().running, "{}", case.family.profile);
    }
}

/// A Delta drive that shows how long the motor has been decelerating.
#[test]
fn a_motor_that_comes_down() {
    let delta = cases()
        .into_iter()
        .find(|case| case.family.profile == "delta-ms300")
        .unwrap();
    let mut rig = running(&delta);
    rig.send(&delta.family.stop);
    assert_eq!(rig.register(Table::Holding, 0x2101) & 3, 1);
    rig.wait(5000);
    assert_eq!(rig.register(Table::Holding, 0x2101) & 3, 0);
}

/// Every profile without a dedicated simulator answers for each of its points and for nothing else, within its limits.
#[test]
fn every_profile_answers_its_points() {
    let profiles = Profiles::built_in();
    let mut seen = 0;
    for profile in profiles.iter() {
        let Some(ModelOptions::Profile(_)) = ModelOptions::of_profile(profile) else {
            continue;
        };
        seen += 1;
        let mut rig = ProfiledDrive::of(profile);
        for point in &profile.points {
            let Some(raw) = point.raw() else { continue };
            let read = RequestPdu::read(raw.table, raw.address, raw.form.items());
            let words = rig
                .ask(&read)
                .into_words()
                .unwrap_or_else(|| panic!("{} {}", profile.name, point.name));
            if raw.scale_from.is_none() {
                let value = raw.decode(&words, point.kind());
                let value = value.unwrap_or_else(|| panic!("{} {}: no value", profile.name, point.name));
                let within = point.range.as_ref().is_none_or(|range| range.contains(&value.as_f64()));
                assert!(
                    within || value.as_f64() == 0.0,
                    "{} {}: {value}",
                    profile.name,
                    point.name
                );
            }
        }
        let range = &profile.ranges[0];
        let read = |start, count| RequestPdu::Read {
            table: range.table,
            start,
            count,
        };
        let unknown = (0..=u16::MAX)
            .find(|address| profile.range(range.table, *address).is_none())
            .unwrap();
        assert_eq!(
            rig.ask(&read(unknown, 1)),
            Reply::Exception(Exception::ADDRESS),
            "{}",
            profile.name
        );
        assert_eq!(
            rig.ask(&read(*range.addresses.start(), 0)),
            Reply::Exception(Exception::VALUE)
        );
        assert!(rig.drive.state().ready && !rig.drive.state().running);
    }
    assert!(seen >= 19, "{seen}");
}

/// Requests near the addresses of a profile, and any others.
fn request(profile: Arc<Profile>) -> impl Strategy<Value = RequestPdu> {
    let near: Vec<u16> = profile
        .ranges
        .iter()
        .flat_map(|range| [*range.addresses.start(), *range.addresses.end()])
        .collect();
    let address = prop_oneof![
        4 => (prop::sample::select(near), 0..4u16).prop_map(|(address, more)| address.wrapping_add(more)),
        1 => any::<u16>(),
    ];
    let value = || prop_oneof![0..20u16, 0x0400..0x0500u16, any::<u16>()];
    let table = prop::sample::select(vec![Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding]);
    (address, table, value(), prop::collection::vec(value(), 0..6), 0..6u8).prop_map(
        |(address, table, value, values, kind)| match kind {
            0 => RequestPdu::read(table, address, value % 40),
            1 => RequestPdu::WriteCoil {
                address,
                on: value & 1 == 1,
            },
            2 => RequestPdu::write_register(address, value),
            3 => RequestPdu::WriteRegisters { start: address, values },
            4 => RequestPdu::WriteCoils {
                start: address,
                bits: values.iter().map(|value| value & 1 == 1).collect(),
            },
            _ => RequestPdu::MaskWrite {
                address,
                and_mask: value,
                or_mask: 1,
            },
        },
    )
}

fn any_bench() -> impl Strategy<Value = (Arc<Profile>, Vec<(RequestPdu, u64)>)> {
    let profiles: Vec<Arc<Profile>> = Profiles::built_in().iter().cloned().collect();
    let own = |profile: &Arc<Profile>| matches!(ModelOptions::of_profile(profile), Some(ModelOptions::Profile(_)));
    let profiles: Vec<Arc<Profile>> = profiles.into_iter().filter(own).collect();
    prop::sample::select(profiles).prop_flat_map(|profile| {
        let requests = prop::collection::vec((request(Arc::clone(&profile)), 0..500u64), 1..40);
        (Just(profile), requests)
    })
}

proptest! {
    /// Property for any requests: each gets a matching reply, and the motor turns only while there is no fault.
    #[test]
    fn every_reply_fits_its_request((profile, requests) in any_bench()) {
        let mut rig = ProfiledDrive::of(&profile);
        for (request, milliseconds) in requests {
            let reply = rig.ask(&request);
            let mut pdu = Vec::new();
            reply.encode(&request, &mut pdu);
            prop_assert_eq!(Reply::decode(&request, &pdu), Ok(reply), "{} {:?}", profile.name, request);
            rig.wait(milliseconds);
            let state = rig.drive.state();
            prop_assert!(state.fault == 0 || !state.running && !state.ready, "{}: {state:?}", profile.name);
            prop_assert!(state.running || state.output == 0.0, "{}: {state:?}", profile.name);
        }
    }
}

/// A WEG keeps a parameter without supply, a Danfoss has it in its RAM; the save register of a Hitachi exists.
#[test]
fn parameters_without_supply() {
    for (family, address, kept) in [
        ("weg-cfw", 100, 50),
        ("danfoss-fc", 4139, 0),
        ("hitachi-wj200", 0x1203, 50),
    ] {
        let mut rig = ProfiledDrive::named(family);
        assert_eq!(rig.ask(&Word(address, 50).pdu()), Reply::Written, "{family}");
        assert_eq!(rig.register(Table::Holding, address), 50, "{family}");
        rig.drive.power_off();
        rig.drive.power_on(rig.now);
        assert_eq!(rig.register(Table::Holding, address), kept, "{family}");
    }
    let mut hitachi = ProfiledDrive::named("hitachi-wj200");
    assert_eq!(hitachi.ask(&Word(0x08FF, 1).pdu()), Reply::Written);
}

/// The state of a point of the common model as the registers of a drive show it; `None` if the family lacks it.
fn shown(rig: &mut ProfiledDrive, profile: &Profile, point: ModelPoint) -> Option<bool> {
    let mut value = |index: PointIndex| {
        let of = profile.points.get(index).unwrap();
        let raw = of.raw().unwrap();
        let words: Vec<u16> = raw
            .addresses()
            .map(|address| rig.register(raw.table, address))
            .collect();
        raw.decode(&words, of.kind()).unwrap()
    };
    let index = profile.model_index(point)?;
    match &profile.points.get(index)?.source {
        Source::Raw(_) => Some(value(index).as_bool()),
        Source::Derived(derived) => {
            let sources: Vec<Value> = derived.sources().map(value).collect();
            derived.value(sources, None).map(|value| value.as_bool())
        }
    }
}

/// Each state reads back by the profile as what it is, and as nothing else.
#[test]
fn every_family_shows_each_state_and_no_other() {
    for case in &cases() {
        let name = case.family.profile;
        let profile = Profiles::built_in().get(name).unwrap().clone();
        let mut rig = ProfiledDrive::named(name);
        let check = |rig: &mut ProfiledDrive, when: &str, expected: [bool; 8]| {
            for (point, expected) in ModelPoint::STATUS_WORD.into_iter().zip(expected) {
                let found = shown(rig, &profile, point);
                // Some families are ready only while the motor is at standstill.
                let moving = point == ModelPoint::Ready && !["stopped", "tripped"].contains(&when);
                // WEG belongs to the bus with the first word.
                let early = point == ModelPoint::Remote && when == "switched on";
                // For ABB, running means bits 0 to 2, and OFF1 clears bit 1 at once.
                let off = name.starts_with("abb") && when == "coming down" && point == ModelPoint::Running;
                let right = found.is_none_or(|found| found == expected) || moving || early || off;
                assert!(right, "{name}, {when}: {} is {found:?}", point.name());
            }
        };
        let (yes, no) = (true, false);
        check(&mut rig, "switched on", [yes, no, no, no, no, no, yes, yes]);
        rig.send(&case.family.reference);
        rig.send(&case.family.start);
        check(&mut rig, "starting", [yes, yes, no, no, no, no, no, yes]);
        rig.wait(5000);
        let forward = [yes, yes, no, no, no, yes, no, yes];
        check(&mut rig, "running forward", forward);
        rig.send(&case.family.stop);
        check(&mut rig, "coming down", [yes, yes, no, no, no, no, no, yes]);
        rig.wait(5000);
        check(&mut rig, "stopped", [yes, no, no, no, no, no, yes, yes]);
        if !case.family.reverse.is_empty() {
            rig.send(&case.family.reverse);
            rig.wait(5000);
            check(&mut rig, "running in reverse", [yes, yes, yes, no, no, yes, no, yes]);
            rig.send(&case.family.stop);
            rig.wait(5000);
        }
        rig.send(&case.family.reference);
        rig.send(&case.family.start);
        rig.wait(8000);
        check(&mut rig, "running again", forward);
        rig.send(&[Word(rig.trip_address, 4)]);
        check(&mut rig, "tripped", [no, no, no, yes, no, no, yes, yes]);
    }
}

/// What a search learns of a drive by its reads: the profiles that fit, and the nameplate.
fn identified(drive: &mut SimulatedDrive, profiles: &Profiles, protocol: Protocol) -> Vec<String> {
    let outcomes = identify::probes(profiles, protocol).into_iter().filter_map(|probe| {
        let values = !matches!(drive.answer(&probe.pdu(), SimTime::ZERO)?, Reply::Exception(_));
        Some((probe, values))
    });
    let outcomes = outcomes.collect();
    let mut fitting = identify::fitting(profiles, protocol, &outcomes);
    let request = RequestPdu::DeviceIdentification { code: 1, object: 0 };
    if fitting.is_empty()
        && let Some(Reply::DeviceIdentification(reply)) = drive.answer(&request, SimTime::ZERO)
    {
        let mut plate = Nameplate::default();
        plate.add(&reply);
        fitting = identify::named(profiles, protocol, &plate);
    }
    fitting.iter().map(|profile| profile.name.clone()).collect()
}

/// Each built-in profile that can be identified is found by its own simulated drive, and by no drive of another family.
#[test]
fn a_drive_is_identified_as_its_own_family_or_not_at_all() {
    let profiles = Profiles::built_in();
    // Families with one board, or with like registers.
    let alike = [("eaton-svx", "eaton-hvx"), ("vacon-nx", "vacon-10")];
    let mut silent = Vec::new();
    for profile in profiles.iter() {
        let Some(model) = ModelOptions::of_profile(profile) else {
            continue;
        };
        let mut drive = SimulatedDrive::new(DriveOptions::new(1, model), SimTime::ZERO);
        // Over N2 drives answer by frames of that protocol; `every_family_is_found_by_reading` searches such lines.
        for protocol in profile.protocols.iter().filter(|one| **one != Protocol::N2) {
            let names = identified(&mut drive, &profiles, *protocol);
            // A profile with a base is an application or a kind of the family, which no read shows.
            let family = profile.base.as_ref().unwrap_or(&profile.name);
            let mut expected = vec![family.clone()];
            expected.extend(alike.iter().filter_map(|(one, other)| match family.as_str() {
                name if name == *one => Some(other.to_string()),
                name if name == *other => Some(one.to_string()),
                _ => None,
            }));
            expected.sort();
            let known = profiles.get(family).unwrap();
            if known.identify.is_empty() && known.nameplates.is_empty() {
                expected.clear();
                silent.push(profile.name.as_str());
            }
            let mut names = names;
            names.sort();
            assert_eq!(names, expected, "{} on {}", profile.name, protocol.name());
        }
    }
    assert!(
        !silent.contains(&"weg-cfw") && silent.contains(&"delta-ms300"),
        "{silent:?}"
    );
}
