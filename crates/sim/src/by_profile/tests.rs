//! Families by hand: their words from the figures of the manuals, not from their profiles.

use proptest::prelude::*;

use super::*;
use crate::drive::profile::Profiles;
use crate::simulated_drive::{DriveOptions, ModelOptions, SimulatedDrive};

/// What a master sends.
#[derive(Debug, Clone, Copy)]
enum Order {
    /// A register by function 06.
    Word(u16, u16),
    /// One by function 16.
    Single(u16, u16),
    /// Two registers by function 16.
    Pair(u16, u16, u16),
    Coil(u16, bool),
}

use Order::{Coil, Pair, Single, Word};

impl Order {
    fn pdu(self) -> RequestPdu {
        match self {
            Word(address, value) => RequestPdu::WriteRegister { address, value },
            Single(start, value) => RequestPdu::WriteRegisters {
                start,
                values: vec![value],
            },
            Pair(start, high, low) => RequestPdu::WriteRegisters {
                start,
                values: vec![high, low],
            },
            Coil(address, on) => RequestPdu::WriteCoil { address, on },
        }
    }
}

struct Bench {
    drive: SimulatedDrive,
    trip_address: u16,
    now: SimTime,
}

impl Bench {
    fn of(profile: &Arc<Profile>) -> Bench {
        let mut model = ModelOptions::of_profile(profile).unwrap();
        assert!(matches!(model, ModelOptions::Profile(_)), "{}", profile.name);
        model.set_trip_register(true);
        let trip_address = model.trip_address();
        Bench {
            drive: SimulatedDrive::new(DriveOptions::new(1, model), SimTime::ZERO),
            trip_address,
            now: SimTime::ZERO,
        }
    }

    fn named(name: &str) -> Bench {
        Bench::of(Profiles::built_in().get(name).unwrap())
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
        let request = RequestPdu::Read {
            table,
            start: address,
            count: 1,
        };
        self.ask(&request)
            .into_words()
            .unwrap_or_else(|| panic!("{table:?} {address}"))[0]
    }
}

struct Case {
    profile: &'static str,
    /// Half of 50 Hz.
    reference: &'static [Order],
    start: &'static [Order],
    stop: &'static [Order],
    reverse: &'static [Order],
    reset: &'static [Order],
    /// Each alone, at standstill: they start nothing.
    idle: &'static [Order],
    /// The status register while it runs forward: address, bits that count and what they are, from the manuals.
    runs: (u16, u16, u16),
    fault: (u16, u16, u16),
}

const CASES: &[Case] = &[
    Case {
        profile: "abb-acs550",
        reference: &[Word(1, 10_000)],
        start: &[Word(0, 0x047E), Word(0, 0x047F)],
        stop: &[Word(0, 0x047E)],
        reverse: &[Word(1, 0xD8F0), Word(0, 0x047F)],
        reset: &[Word(0, 0x047E), Word(0, 0x04FE), Word(0, 0x047E)],
        idle: &[
            Word(0, 0x047F),
            Word(0, 0x0001),
            Word(0, 0x0477),
            Word(0, 0x04FF),
            Word(0, 0x007F),
            Word(0, 0x04FE),
        ],
        runs: (3, 0x000F, 0x0007),
        fault: (3, 0x000C, 0x0008),
    },
    Case {
        profile: "abb-acs580",
        reference: &[Word(1, 10_000)],
        start: &[Word(0, 0x047E), Word(0, 0x047F)],
        stop: &[Word(0, 0x047E)],
        reverse: &[Word(1, 0xD8F0), Word(0, 0x047F)],
        reset: &[Word(0, 0x047E), Word(0, 0x04FE), Word(0, 0x047E)],
        idle: &[Word(0, 0x047F), Word(0, 0x0001)],
        runs: (3, 0x000F, 0x0007),
        fault: (3, 0x000C, 0x0008),
    },
    Case {
        profile: "danfoss-fc",
        reference: &[Word(50_009, 0x2000)],
        start: &[Word(49_999, 0x047C)],
        stop: &[Word(49_999, 0x043C)],
        reverse: &[Word(49_999, 0x847C)],
        reset: &[Word(49_999, 0x043C), Word(49_999, 0x04BC), Word(49_999, 0x043C)],
        idle: &[
            Word(49_999, 0x007C),
            Word(49_999, 0x0474),
            Word(49_999, 0x045C),
            Word(49_999, 0x046C),
            Word(49_999, 0x04BC),
        ],
        runs: (50_199, 0x080B, 0x0803),
        fault: (50_199, 0x0808, 0x0008),
    },
    Case {
        profile: "siemens-v20",
        reference: &[Word(100, 0x2000)],
        start: &[Word(99, 0x047E), Word(99, 0x047F)],
        stop: &[Word(99, 0x047E)],
        reverse: &[Word(99, 0x0C7F)],
        reset: &[Word(99, 0x047E), Word(99, 0x04FE), Word(99, 0x047E)],
        idle: &[Word(99, 0x047F), Word(99, 0x007F), Word(99, 0x047D), Word(99, 0x047B)],
        runs: (109, 0x000F, 0x0007),
        fault: (109, 0x000C, 0x0008),
    },
    Case {
        profile: "siemens-g120",
        reference: &[Word(100, 0x2000)],
        start: &[Word(99, 0x047E), Word(99, 0x047F)],
        stop: &[Word(99, 0x047E)],
        reverse: &[Word(100, 0xE000), Word(99, 0x047F)],
        reset: &[Word(99, 0x047E), Word(99, 0x04FE), Word(99, 0x047E)],
        idle: &[Word(99, 0x047F), Word(99, 0x0077)],
        runs: (109, 0x000F, 0x0007),
        fault: (109, 0x000C, 0x0008),
    },
    Case {
        profile: "schneider-altivar",
        reference: &[Word(8502, 250)],
        start: &[Word(8501, 6), Word(8501, 7), Word(8501, 15)],
        stop: &[Word(8501, 7)],
        reverse: &[Word(8501, 0x080F)],
        reset: &[Word(8501, 0), Word(8501, 0x80), Word(8501, 0)],
        idle: &[
            Word(8501, 15),
            Word(8501, 7),
            Word(8501, 0x80),
            Word(8501, 6),
            Word(8501, 3),
        ],
        runs: (3201, 0x006F, 0x0027),
        fault: (3201, 0x004F, 0x0008),
    },
    Case {
        profile: "yaskawa-v1000",
        reference: &[Single(2, 2500)],
        start: &[Single(1, 1)],
        stop: &[Single(1, 0)],
        reverse: &[Single(1, 2)],
        reset: &[Single(1, 0), Single(1, 8), Single(1, 0)],
        idle: &[Single(1, 3), Single(1, 8), Single(1, 0x10)],
        runs: (0x4B, 0x0081, 0x0001),
        fault: (0x4B, 0x0081, 0x0080),
    },
    Case {
        profile: "delta-ms300",
        reference: &[Word(0x2001, 2500)],
        start: &[Word(0x2000, 0x12)],
        stop: &[Word(0x2000, 1)],
        reverse: &[Word(0x2000, 0x22)],
        reset: &[Word(0x2002, 2), Word(0x2002, 0)],
        idle: &[Word(0x2000, 0), Word(0x2000, 0x10), Word(0x2002, 2), Word(0x2000, 3)],
        runs: (0x2101, 0x001B, 0x0003),
        fault: (0x2100, 0x00FF, 0x0004),
    },
    Case {
        profile: "invt-goodrive",
        reference: &[Word(0x2001, 2500)],
        start: &[Word(0x2000, 1)],
        stop: &[Word(0x2000, 5)],
        reverse: &[Word(0x2000, 2)],
        reset: &[Word(0x2000, 7)],
        idle: &[Word(0x2000, 0), Word(0x2000, 6), Word(0x2000, 7)],
        runs: (0x2100, 0xFFFF, 1),
        fault: (0x2102, 0xFFFF, 4),
    },
    Case {
        profile: "mitsubishi-d700",
        reference: &[Word(13, 2500)],
        start: &[Word(8, 2)],
        stop: &[Word(8, 0)],
        reverse: &[Word(8, 4)],
        reset: &[],
        idle: &[Word(8, 6), Word(8, 1), Word(8, 8)],
        runs: (8, 0x0081, 0x0001),
        fault: (8, 0x0081, 0x0080),
    },
    Case {
        profile: "invertek-optidrive",
        reference: &[Word(1, 250)],
        start: &[Word(0, 1)],
        stop: &[Word(0, 0)],
        reverse: &[],
        reset: &[Word(0, 0), Word(0, 4), Word(0, 0)],
        idle: &[Word(0, 9), Word(0, 4), Word(0, 2)],
        runs: (5, 0x0003, 0x0001),
        fault: (5, 0x0003, 0x0002),
    },
    Case {
        profile: "weg-cfw",
        reference: &[Word(683, 4096)],
        start: &[Word(682, 0x17)],
        stop: &[Word(682, 0x16)],
        reverse: &[Word(682, 0x13)],
        reset: &[Word(682, 0x16), Word(682, 0x96), Word(682, 0x16)],
        idle: &[Word(682, 0x07), Word(682, 0x15), Word(682, 0x96), Word(682, 0x57)],
        runs: (680, 0x8100, 0x0100),
        fault: (680, 0x8100, 0x8000),
    },
    Case {
        profile: "fuji-frenic",
        reference: &[Word(0x0705, 2500)],
        start: &[Word(0x0706, 1)],
        stop: &[Word(0x0706, 0)],
        reverse: &[Word(0x0706, 2)],
        reset: &[Word(0x0706, 0), Word(0x0706, 0x8000), Word(0x0706, 0)],
        idle: &[Word(0x0706, 3), Word(0x0706, 0x8000), Word(0x0706, 4)],
        runs: (0x080E, 0x0809, 0x0001),
        fault: (0x080E, 0x0800, 0x0800),
    },
    Case {
        profile: "hitachi-wj200",
        reference: &[Pair(0, 0, 2500)],
        start: &[Coil(1, false), Coil(0, true)],
        stop: &[Coil(0, false)],
        reverse: &[Coil(1, true), Coil(0, true)],
        reset: &[Coil(0, false), Coil(3, true), Coil(3, false)],
        idle: &[Coil(1, true), Coil(3, true)],
        runs: (0x1001, 0xFFFF, 2500),
        fault: (0x1001, 0xFFFF, 0),
    },
    Case {
        profile: "toshiba-vf-s15",
        reference: &[Word(0xFA01, 2500)],
        start: &[Word(0xFA00, 0xC400)],
        stop: &[Word(0xFA00, 0xC000)],
        reverse: &[Word(0xFA00, 0xC600)],
        reset: &[Word(0xFA00, 0xC000), Word(0xFA00, 0xE000), Word(0xFA00, 0xC000)],
        idle: &[Word(0xFA00, 0x0400), Word(0xFA00, 0xCC00), Word(0xFA00, 0xE000)],
        runs: (0xFD01, 0x0602, 0x0400),
        fault: (0xFD01, 0x0402, 0x0002),
    },
    Case {
        profile: "ls-g100",
        reference: &[Word(4, 2500)],
        start: &[Word(5, 2)],
        stop: &[Word(5, 1)],
        reverse: &[Word(5, 4)],
        reset: &[Word(5, 8)],
        idle: &[Word(5, 0), Word(5, 6), Word(5, 8), Word(5, 0x12)],
        runs: (13, 0x000E, 0x0002),
        fault: (13, 0x000E, 0x0008),
    },
    Case {
        profile: "teco-f510",
        reference: &[Word(0x2502, 2500)],
        start: &[Word(0x2501, 1)],
        stop: &[Word(0x2501, 0)],
        reverse: &[Word(0x2501, 3)],
        reset: &[Word(0x2501, 0), Word(0x2501, 8), Word(0x2501, 0)],
        idle: &[Word(0x2501, 2), Word(0x2501, 8), Word(0x2501, 0x10)],
        runs: (0x2520, 0x000B, 0x0001),
        fault: (0x2520, 0x0009, 0x0008),
    },
    Case {
        profile: "vacon-10",
        reference: &[Word(2002, 5000)],
        start: &[Word(2000, 1)],
        stop: &[Word(2000, 0)],
        reverse: &[Word(2000, 3)],
        reset: &[Word(2000, 0), Word(2000, 4), Word(2000, 0)],
        idle: &[Word(2000, 2), Word(2000, 4)],
        runs: (2100, 0x000E, 0x0002),
        fault: (2100, 0x000A, 0x0008),
    },
];

/// A bench whose motor turns forward at 25 Hz.
fn running(case: &Case) -> Bench {
    let mut bench = Bench::named(case.profile);
    bench.send(case.reference);
    bench.send(case.start);
    bench.wait(5000);
    assert!(
        (bench.output() - 25.0).abs() < 0.01,
        "{}: {}",
        case.profile,
        bench.output()
    );
    bench
}

#[test]
fn every_family_starts_turns_and_stops_by_its_words() {
    for case in CASES {
        let name = case.profile;
        let mut bench = running(case);
        let (address, mask, is) = case.runs;
        assert_eq!(bench.register(Table::Holding, address) & mask, is, "{name}");
        bench.send(case.stop);
        assert!(bench.output() > 20.0, "{name}: the motor ramps");
        bench.wait(5000);
        assert_eq!(bench.output(), 0.0, "{name}");
        assert_ne!(bench.register(Table::Holding, address) & mask, is, "{name}");
        if !case.reverse.is_empty() {
            bench.send(case.start);
            bench.wait(3000);
            bench.send(case.reverse);
            bench.wait(8000);
            assert!((bench.output() + 25.0).abs() < 0.01, "{name}: {}", bench.output());
            bench.send(case.stop);
            bench.wait(5000);
            assert_eq!(bench.output(), 0.0, "{name}");
        }
    }
}

#[test]
fn words_that_start_nothing() {
    for case in CASES {
        for order in case.idle {
            let mut bench = Bench::named(case.profile);
            bench.send(case.reference);
            let _refused = bench.ask(&order.pdu());
            bench.wait(1000);
            assert!(!bench.drive.state().running, "{}: {order:?}", case.profile);
        }
        // Without the first word of its sequence a drive does not run.
        if case.start.len() > 1 && case.profile != "hitachi-wj200" {
            let mut bench = Bench::named(case.profile);
            bench.send(case.reference);
            bench.send(&case.start[1..]);
            bench.wait(1000);
            assert!(!bench.drive.state().running, "{}", case.profile);
        }
    }
}

#[test]
fn faults_are_reset_and_start_nothing() {
    for case in CASES {
        let name = case.profile;
        let mut bench = running(case);
        let trip = Word(bench.trip_address, 4);
        bench.send(&[trip]);
        assert_eq!((bench.drive.state().fault, bench.output()), (4, 0.0), "{name}");
        let (address, mask, is) = case.fault;
        assert_eq!(bench.register(Table::Holding, address) & mask, is, "{name}");
        bench.send(case.start);
        bench.wait(1000);
        assert!(!bench.drive.state().running, "{name}: with a fault");
        if case.reset.is_empty() {
            continue;
        }
        bench.send(case.reset);
        bench.wait(1000);
        assert_eq!((bench.drive.state().fault, bench.output()), (0, 0.0), "{name}");
        bench.send(case.stop);
        bench.send(case.start);
        bench.wait(5000);
        assert!((bench.output() - 25.0).abs() < 0.01, "{name}: runs anew");
    }
}

/// Fuji: a reset with a run command that stands starts the motor; with others the command has to come anew.
#[test]
fn a_reset_with_a_run_command() {
    for (name, orders, starts) in [
        ("fuji-frenic", [Word(0x0706, 1), Word(0x0706, 0x8001)], true),
        ("vacon-10", [Word(2000, 1), Word(2000, 5)], false),
        ("weg-cfw", [Word(682, 0x17), Word(682, 0x97)], false),
    ] {
        let mut bench = Bench::named(name);
        bench.send(&[Word(bench.trip_address, 1)]);
        bench.send(&orders);
        bench.wait(1000);
        assert_eq!(
            (bench.drive.state().fault, bench.drive.state().running),
            (0, starts),
            "{name}"
        );
    }
}

/// The panel: the motor stops, the bus is not obeyed, and a command that came meanwhile does not start it afterwards.
#[test]
fn a_drive_at_its_panel_does_not_obey_the_bus() {
    for case in CASES {
        let mut bench = running(case);
        let panel = bench.trip_address + 1;
        bench.send(&[Word(panel, 1)]);
        bench.wait(5000);
        assert_eq!(
            (bench.output(), bench.drive.state().remote),
            (0.0, false),
            "{}",
            case.profile
        );
        bench.send(case.start);
        bench.send(&[Word(panel, 0)]);
        bench.wait(1000);
        assert!(!bench.drive.state().running, "{}", case.profile);
        bench.send(case.stop);
        bench.send(case.start);
        bench.wait(1000);
        assert!(bench.drive.state().running, "{}", case.profile);
    }
}

/// A Delta drive shows for how long the motor comes down.
#[test]
fn a_motor_that_comes_down() {
    let delta = CASES.iter().find(|case| case.profile == "delta-ms300").unwrap();
    let mut bench = running(delta);
    bench.send(delta.stop);
    assert_eq!(bench.register(Table::Holding, 0x2101) & 3, 1);
    bench.wait(5000);
    assert_eq!(bench.register(Table::Holding, 0x2101) & 3, 0);
}

/// Every profile without a simulator of its own answers each of its points and nothing else, and as its limits say.
#[test]
fn every_profile_answers_its_points() {
    let profiles = Profiles::built_in();
    let mut seen = 0;
    for profile in profiles.iter() {
        let Some(ModelOptions::Profile(_)) = ModelOptions::of_profile(profile) else {
            continue;
        };
        seen += 1;
        let mut bench = Bench::of(profile);
        for point in &profile.points {
            let Some(raw) = point.raw() else { continue };
            let read = RequestPdu::Read {
                table: raw.table,
                start: raw.address,
                count: raw.form.items(),
            };
            let words = bench
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
            bench.ask(&read(unknown, 1)),
            Reply::Exception(Exception::ADDRESS),
            "{}",
            profile.name
        );
        assert_eq!(
            bench.ask(&read(*range.addresses.start(), 0)),
            Reply::Exception(Exception::VALUE)
        );
        assert!(bench.drive.state().ready && !bench.drive.state().running);
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
            0 => RequestPdu::Read {
                table,
                start: address,
                count: value % 40,
            },
            1 => RequestPdu::WriteCoil {
                address,
                on: value & 1 == 1,
            },
            2 => RequestPdu::WriteRegister { address, value },
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
    /// Whatever a drive is asked, its reply fits, and it turns only where nothing is wrong.
    #[test]
    fn every_reply_fits_its_request((profile, requests) in any_bench()) {
        let mut bench = Bench::of(&profile);
        for (request, milliseconds) in requests {
            let reply = bench.ask(&request);
            let mut pdu = Vec::new();
            reply.encode(&request, &mut pdu);
            prop_assert_eq!(Reply::decode(&request, &pdu), Ok(reply), "{} {:?}", profile.name, request);
            bench.wait(milliseconds);
            let state = bench.drive.state();
            prop_assert!(state.fault == 0 || !state.running && !state.ready, "{}: {state:?}", profile.name);
            prop_assert!(state.running || state.output == 0.0, "{}: {state:?}", profile.name);
        }
    }
}

fn profile(text: &str) -> Arc<Profile> {
    let text = format!("name = \"p\"\nprotocols = [\"modbus-rtu\"]\n{text}");
    Arc::new(Profile::parse("p.toml", &text, false).unwrap_or_else(|why| panic!("{why:?}")))
}

const RANGE: &str = "[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 19\nread = 8\nwrite = 2\n";

/// A drive that nobody knows by hand does what its profile says.
#[test]
fn a_profile_of_ones_own() {
    let text = format!(
        "{RANGE}[ranges]\nsingle_write = 16\n\
         [control]\nat = \"holding 0\"\nalways = {{ set = [10] }}\n\
         run = {{ steps = [{{ write = 0x0406, until = {{ point = \"status_word\", mask = 0x6F, is = 0x21 }} }}, {{ write = 0x0407, time = \"200ms\" }}, {{ write = 0x040F }}] }}\n\
         stop = {{ bit = 3, is = 0 }}\nreverse = {{ bit = 11 }}\nfault_reset = {{ mask = 0x88, value = 0x80 }}\n\
         [[state]]\nis = \"running\"\npoint = \"status_word\"\nmask = 0x6F\nvalue = 0x27\n\
         [[state]]\nis = \"fault\"\npoint = \"status_word\"\nmask = 0x4F\nvalue = 0x08\n\
         [[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"output_frequency\"\nat = \"holding 4\"\ntype = \"i16\"\nscale = 0.1\nclass = \"fast\"\n\
         [[point]]\nname = \"frequency_reference\"\nat = \"holding 1\"\ntype = \"i16\"\nscale = 0.1\nwrite = true\nrange = [0, 50]\n"
    );
    let text =
        text.replace(RANGE, "").replace("[ranges]\nsingle_write = 16\n", "") + "[ranges]\nsingle_write = 16\n" + RANGE;
    let mut bench = Bench::of(&profile(&text));
    let refused = bench.ask(&Word(0, 0x0406).pdu());
    assert_eq!(refused, Reply::Exception(Exception::FUNCTION), "function 16 only");
    let status = |bench: &mut Bench| bench.register(Table::Holding, 3) & 0x6F;
    bench.send(&[Single(1, 250), Single(0, 0x040F), Single(0, 0x0407)]);
    assert!(!bench.drive.state().running, "not prepared");
    assert_ne!(status(&mut bench), 0x21);
    assert_eq!(bench.ask(&Single(0, 0x0406).pdu()), Reply::Written);
    bench.wait(10);
    assert_ne!(status(&mut bench), 0x21, "that takes a while");
    bench.wait(30);
    assert_eq!(status(&mut bench), 0x21);
    // The second step ends by time: what comes earlier is too early.
    bench.send(&[Single(0, 0x0407), Single(0, 0x040F)]);
    assert!(!bench.drive.state().running);
    bench.wait(200);
    bench.send(&[Single(0, 0x0006)]);
    assert!(!bench.drive.state().running, "a word without bit 10 is no step");
    bench.send(&[Single(0, 0x0406), Single(0, 0x0407)]);
    bench.wait(200);
    bench.send(&[Single(0, 0x0C0F)]);
    bench.wait(3000);
    assert_eq!((bench.output(), status(&mut bench)), (-25.0, 0x27));
    assert_eq!(bench.register(Table::Holding, 4) as i16, -250);
    bench.send(&[Word(bench.trip_address, 9)].map(|order| match order {
        Word(address, value) => Single(address, value),
        other => other,
    }));
    assert_eq!(bench.drive.state().fault, 9);
    assert_eq!(bench.register(Table::Holding, 3) & 0x4F, 0x08);
    bench.send(&[Single(0, 0x0480)]);
    assert_eq!(bench.drive.state().fault, 0);
    assert!(!bench.drive.state().running);
}

/// A meter: values as given, settings within their range, texts, a scale in another register.
#[test]
fn a_meter_holds_what_it_was_given() {
    let text = format!(
        "{RANGE}[[point]]\nname = \"voltage\"\nat = \"holding 0\"\ntype = \"f32\"\nunit = \"V\"\nclass = \"fast\"\n\
         [[point]]\nname = \"exponent\"\nat = \"holding 2\"\ntype = \"i16\"\n\
         [[point]]\nname = \"power\"\nat = \"holding 3\"\ntype = \"i16\"\nscale_from = \"exponent\"\nunit = \"kW\"\n\
         [[point]]\nname = \"serial\"\nat = \"holding 4\"\ntype = \"string:4\"\n\
         [[point]]\nname = \"ratio\"\nat = \"holding 8\"\nwrite = true\nrange = [1, 100]\n\
         [[point]]\nname = \"tariff\"\nat = \"holding 9\"\nwrite = true\ntexts = {{ 1 = \"day\", 2 = \"night\" }}\n"
    );
    let text = text.replace(RANGE, "") + RANGE;
    let meter = profile(&text);
    let mut options = ProfileOptions::new(&meter);
    let index = |name: &str| meter.point_index(name).unwrap();
    options.values.insert(index("voltage"), Given::Number(231.5));
    options.values.insert(index("exponent"), Given::Number(-1.0));
    options.values.insert(index("power"), Given::Number(12.3));
    options.values.insert(index("serial"), Given::Text("AB12".to_string()));
    let mut drive = ProfileDrive::new(options, SimTime::ZERO);
    let read = RequestPdu::Read {
        table: Table::Holding,
        start: 0,
        count: 8,
    };
    let words = drive.answer(&read, SimTime::ZERO).unwrap().into_words().unwrap();
    assert_eq!(words[..2], [0x4367, 0x8000], "231.5 as IEEE 754");
    assert_eq!(words[2..4], [0xFFFF, 123]);
    assert_eq!(words[4..8], [0x4142, 0x3132, 0, 0]);
    let mut write = |order: Order| drive.answer(&order.pdu(), SimTime::ZERO).unwrap();
    assert_eq!(write(Word(8, 0)), Reply::Exception(Exception::VALUE), "below its range");
    assert_eq!(write(Word(8, 7)), Reply::Written);
    assert_eq!(write(Word(9, 3)), Reply::Exception(Exception::VALUE), "no text");
    assert_eq!(write(Word(9, 2)), Reply::Written);
}
