//! Properties of every model, for any requests and any treatment.

use super::*;
use drivegate_proto::Table;
use proptest::prelude::*;

fn drive(name: &str) -> SimulatedDrive {
    let mut model = ModelOptions::by_name(name).unwrap();
    model.set_trip_register(true);
    SimulatedDrive::new(DriveOptions::new(1, model), SimTime::ZERO)
}

fn name() -> impl Strategy<Value = &'static str> {
    prop::sample::select(ModelOptions::NAMES.to_vec())
}

/// Addresses near the meaningful ones of a model, and any others.
fn address() -> impl Strategy<Value = u16> {
    prop_oneof![
        0..0x48u16,
        95..112u16,
        730..735u16,
        1995..2115u16,
        0x0100..0x0128u16,
        0x0200..0x0240u16,
        0x0300..0x0520u16,
        0x08FE..0x0A01u16,
        9895..10_002u16,
        any::<u16>(),
    ]
}

fn request() -> impl Strategy<Value = RequestPdu> {
    let table = prop::sample::select(vec![Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding]);
    let value = || prop_oneof![0..20u16, Just(5000u16), any::<u16>()];
    prop_oneof![
        (table, address(), 0..35u16).prop_map(|(table, start, count)| RequestPdu::Read { table, start, count }),
        (address(), any::<bool>()).prop_map(|(address, on)| RequestPdu::WriteCoil { address, on }),
        (address(), value()).prop_map(|(address, value)| RequestPdu::WriteRegister { address, value }),
        (address(), prop::collection::vec(value(), 0..25))
            .prop_map(|(start, values)| RequestPdu::WriteRegisters { start, values }),
        (0..0x12u16, prop_oneof![Just(0u16), any::<u16>()])
            .prop_map(|(subfunction, data)| RequestPdu::Diagnostics { subfunction, data }),
        (address(), any::<u16>(), any::<u16>()).prop_map(|(address, and_mask, or_mask)| RequestPdu::MaskWrite {
            address,
            and_mask,
            or_mask
        }),
    ]
}

/// An event of a drive in a test.
#[derive(Debug, Clone)]
enum Event {
    Ask(RequestPdu),
    Broadcast(RequestPdu),
    Malformed(Vec<u8>),
    Wait(u64),
    Trip(u16),
    Remote(bool),
    PowerCycle,
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        6 => request().prop_map(Event::Ask),
        1 => request().prop_map(Event::Broadcast),
        1 => prop::collection::vec(any::<u8>(), 0..12).prop_map(Event::Malformed),
        2 => (0..3000u64).prop_map(Event::Wait),
        1 => any::<u16>().prop_map(Event::Trip),
        1 => any::<bool>().prop_map(Event::Remote),
        1 => Just(Event::PowerCycle),
    ]
}

/// An action of a user who commands a drive.
#[derive(Debug, Clone)]
enum Act {
    Run(bool),
    Reset(bool),
    Trip,
    Wait(u64),
}

fn act() -> impl Strategy<Value = Act> {
    prop_oneof![
        any::<bool>().prop_map(Act::Run),
        any::<bool>().prop_map(Act::Reset),
        Just(Act::Trip),
        prop_oneof![0..15u64, 0..1000u64].prop_map(Act::Wait),
    ]
}

proptest! {
    #[test]
    fn nothing_panics_and_every_reply_fits_its_request(
        name in name(),
        events in prop::collection::vec(event(), 1..40),
    ) {
        let mut drive = drive(name);
        let mut now = SimTime::ZERO;
        for event in events {
            match &event {
                Event::Ask(request) => {
                    if let Some(reply) = drive.answer(request, now) {
                        let mut pdu = Vec::new();
                        reply.encode(request, &mut pdu);
                        prop_assert_eq!(Reply::decode(request, &pdu), Ok(reply), "{:?}", request);
                    }
                }
                Event::Broadcast(request) => drive.broadcast_received(request, now),
                Event::Malformed(pdu) => {
                    drive.malformed(pdu, Exception::VALUE, now);
                }
                Event::Wait(milliseconds) => now += Duration::from_millis(*milliseconds),
                Event::Trip(fault) => drive.trip(*fault),
                Event::Remote(on) => drive.set_remote(*on),
                Event::PowerCycle => {
                    drive.power_off();
                    prop_assert!(!drive.answers());
                    drive.power_on(now);
                    prop_assert!(drive.answers());
                }
            }
            drive.advance(now);
            let state = drive.state();
            prop_assert!(state.fault == 0 || (!state.running && !state.ready), "{event:?}: {state:?}");
            prop_assert!(state.running || state.output == 0.0, "{event:?}: {state:?}");
            prop_assert!(state.output.abs() <= 655.35, "{event:?}: {state:?}");
        }
    }

    /// reference/drives.md 9.24: after a fault the run command has to be seen off first.
    #[test]
    fn no_start_after_a_reset_without_a_new_run_command(
        name in name(),
        acts in prop::collection::vec(act(), 1..60),
    ) {
        let mut drive = drive(name);
        let (mut now, mut run, mut may_run) = (SimTime::ZERO, false, true);
        for act in acts {
            match act {
                Act::Run(on) => {
                    run = on;
                    drive.command(Command { run, reverse: false, reference: 5000 });
                }
                Act::Reset(on) => drive.set_reset(on),
                Act::Trip => drive.trip(1),
                Act::Wait(milliseconds) => now += Duration::from_millis(milliseconds),
            }
            drive.advance(now);
            let state = drive.state();
            may_run = state.fault == 0 && (may_run || !run);
            prop_assert!(may_run || !state.running, "{state:?}");
        }
    }
}

#[test]
fn every_model_runs_faults_and_resets_alike() {
    for name in ModelOptions::NAMES {
        let mut drive = drive(name);
        let mut now = SimTime::ZERO;
        let mut settle = |drive: &mut SimulatedDrive, seconds: u64| {
            now += Duration::from_secs(seconds);
            drive.advance(now);
            drive.state()
        };
        let idle = settle(&mut drive, 1);
        assert!(
            idle.ready && idle.remote && !idle.running && idle.fault == 0,
            "{name}: {idle:?}"
        );
        let forward = Command {
            run: true,
            reverse: false,
            reference: 5000,
        };
        drive.command(forward);
        let state = settle(&mut drive, 8);
        assert!(
            state.running && !state.reverse && state.output > 20.0,
            "{name}: {state:?}"
        );
        drive.command(Command {
            reverse: true,
            ..forward
        });
        let reverse = settle(&mut drive, 8);
        assert_eq!((reverse.output, reverse.reverse), (-state.output, true), "{name}");
        drive.trip(1);
        assert_eq!(settle(&mut drive, 1).fault, 1, "{name}");
        drive.command(Command::default());
        drive.set_reset(true);
        let state = settle(&mut drive, 20);
        assert_eq!((state.fault, state.ready, state.output), (0, true, 0.0), "{name}");
    }
}

#[test]
fn trip_registers() {
    for name in ModelOptions::NAMES {
        let model = ModelOptions::by_name(name).unwrap();
        let write = RequestPdu::WriteRegister {
            address: model.trip_address(),
            value: 2,
        };
        let mut plain = SimulatedDrive::new(DriveOptions::new(1, model), SimTime::ZERO);
        assert_eq!(
            plain.answer(&write, SimTime::ZERO),
            Some(Reply::Exception(Exception::ADDRESS)),
            "{name}: no real drive has it"
        );
        let mut drive = drive(name);
        assert_eq!(drive.answer(&write, SimTime::ZERO), Some(Reply::Written), "{name}");
        assert_eq!(drive.state().fault, 2, "{name}");
    }
}

#[test]
fn an_autopilot_runs_any_model() {
    for name in ModelOptions::NAMES {
        let options = DriveOptions {
            autopilot: Some(3),
            ..DriveOptions::new(1, ModelOptions::by_name(name).unwrap())
        };
        let mut drive = SimulatedDrive::new(options, SimTime::ZERO);
        let seen: Vec<DriveState> = (1..900)
            .map(|second| {
                drive.advance(Duration::from_secs(second));
                drive.state()
            })
            .collect();
        assert!(seen.iter().filter(|state| state.running).count() > 200, "{name} runs");
        assert!(seen.iter().any(|state| state.fault != 0), "{name} faults");
        assert!(
            seen.iter().filter(|state| state.fault != 0).count() < 300,
            "{name} recovers"
        );
    }
}
