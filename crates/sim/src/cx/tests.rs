//! Behaviour of the simulated CX against reference/drives.md, sections 4, 7.2 and 10, in virtual time.

use super::super::model::Beyond;
use super::options::Limits;
use super::*;
use crate::in_time::InTime;
use drivegate_proto::{Table, rtu};
use std::time::Duration;

type CxInTime = InTime<CxDrive>;

impl CxInTime {
    fn new(options: CxOptions) -> CxInTime {
        InTime::of(CxDrive::new(options, SimTime::ZERO))
    }

    fn plain() -> CxInTime {
        CxInTime::new(CxOptions::default())
    }

    fn bits(&mut self, table: Table, start: u16, count: u16) -> Result<Vec<bool>, Exception> {
        match self.ask(&RequestPdu::read(table, start, count)) {
            Some(Reply::Bits(bits)) => Ok(bits),
            Some(Reply::Exception(exception)) => Err(exception),
            other => panic!("{other:?}"),
        }
    }

    fn variable(&mut self, n: u16) -> u16 {
        self.registers(Table::Input, n - 1, 1).unwrap()[0]
    }

    /// Discrete inputs as a number: source 1, ready 2, run 4, reverse 8, fault 16.
    fn status(&mut self) -> u16 {
        let bits = self.bits(Table::DiscreteInput, 0, 5).unwrap();
        bits.iter().rev().fold(0, |word, on| (word << 1) | u16::from(*on))
    }

    fn coil(&mut self, address: u16, on: bool) -> Result<(), Exception> {
        self.written(&RequestPdu::WriteCoil { address, on })
    }

    fn diagnose(&mut self, subfunction: u16, data: u16) -> Option<Reply> {
        self.drive.bus_message();
        self.ask(&RequestPdu::Diagnostics { subfunction, data })
    }

    fn run_at(&mut self, hundredths: u16) {
        self.write(0, &[hundredths]).unwrap();
        self.coil(0, true).unwrap();
        self.wait(8000);
    }
}

fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace()
        .map(|b| u8::from_str_radix(b, 16).unwrap())
        .collect()
}

/// Reply of the drive with address 1 to a frame, as hexadecimal text.
fn exchange(drive: &mut CxDrive, frame: &str, now: SimTime) -> String {
    let (address, request) = rtu::decode_request(&hex(frame)).unwrap();
    let mut out = Vec::new();
    drive.bus_message();
    match (address, request) {
        (0, Ok(request)) => drive.broadcast(&request, now),
        (_, Ok(request)) => {
            if let Some(reply) = drive.answer(&request, now) {
                let mut pdu = Vec::new();
                reply.encode(&request, &mut pdu);
                rtu::encode_frame(address, &pdu, &mut out);
            }
        }
        (_, Err((function, exception))) => {
            let exception = drive.malformed(&[function], exception, now).unwrap();
            rtu::encode_frame(address, &[function | 0x80, exception.code()], &mut out);
        }
    }
    out.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" ")
}

/// Worked frames of reference/drives.md 7.2 and 7.4, in an order in which a drive with a 29.6 A motor reaches their states.
#[test]
fn worked_frames() {
    let mut drive = CxDrive::new(
        CxOptions {
            parameters: vec![((1, 11), 296)],
            ..CxOptions::default()
        },
        SimTime::ZERO,
    );
    let script = [
        (1, "01 03 00 65 00 01 94 15", "01 03 02 00 32 39 91"),
        (1, "01 06 01 2D 00 19 D9 F5", "01 06 01 2D 00 19 D9 F5"),
        (1, "01 01 04 2E 00 01 9C F3", "01 81 02 C1 91"),
        (1, "01 06 00 00 03 E8 89 74", "01 06 00 00 03 E8 89 74"),
        (1, "01 03 00 00 00 01 84 0A", "01 03 02 03 E8 B8 FA"),
        (1, "01 05 00 00 FF 00 8C 3A", "01 05 00 00 FF 00 8C 3A"),
        (2, "01 02 00 02 00 01 18 0A", "01 02 01 01 60 48"),
        (9, "01 02 00 00 00 05 B8 09", "01 02 01 07 E0 4A"),
        (9, "01 04 00 02 00 01 90 0A", "01 04 02 00 9C B9 59"),
        (9, "01 05 00 01 FF 00 DD FA", "01 05 00 01 FF 00 DD FA"),
        (15, "01 02 00 03 00 01 49 CA", "01 02 01 01 60 48"),
        (15, "01 05 00 00 00 00 CD CA", "01 05 00 00 00 00 CD CA"),
        (20, "01 02 00 02 00 01 18 0A", "01 02 01 00 A1 88"),
        (20, "01 05 00 00 FF 00 8C 3A", "01 05 00 00 FF 00 8C 3A"),
        (21, "00 05 00 00 00 00 CC 1B", ""),
        (25, "01 02 00 02 00 01 18 0A", "01 02 01 00 A1 88"),
        (25, "01 08 00 00 A5 37 DA 8D", "01 08 00 00 A5 37 DA 8D"),
        (25, "01 08 00 0A 00 00 C0 09", "01 08 00 0A 00 00 C0 09"),
        (25, "01 08 00 0B 00 00 91 C9", "01 08 00 0B 00 01 50 09"),
        (25, "01 08 00 0F 00 00 D0 08", "01 08 00 0F 00 00 D0 08"),
        (25, "01 08 00 04 00 00 A1 CA", ""),
        (25, "01 05 00 00 FF 00 8C 3A", ""),
        (25, "01 08 00 01 00 00 B1 CB", ""),
        (25, "01 08 00 01 00 00 B1 CB", "01 08 00 01 00 00 B1 CB"),
    ];
    for (seconds, request, reply) in script {
        let now = Duration::from_secs(seconds);
        assert_eq!(exchange(&mut drive, request, now), reply, "{request} at {seconds} s");
    }
    let now = Duration::from_secs(30);
    drive.trip(1);
    let faulted = [
        ("01 04 00 64 00 01 70 15", "01 04 02 00 01 78 F0"),
        ("01 05 00 02 FF 00 2D FA", "01 05 00 02 FF 00 2D FA"),
        ("01 05 00 02 00 00 6C 0A", "01 05 00 02 00 00 6C 0A"),
        ("01 04 00 64 00 01 70 15", "01 04 02 00 00 B9 30"),
    ];
    for (request, reply) in faulted {
        assert_eq!(exchange(&mut drive, request, now), reply, "{request}");
    }
    drive.set_failed(true);
    assert_eq!(exchange(&mut drive, "01 06 00 00 03 E8 89 74", now), "01 86 04 43 A3");
}

#[test]
fn start_stop_and_direction() {
    let mut rig = CxInTime::plain();
    assert_eq!(rig.status(), 0b00011, "fieldbus and ready");
    rig.run_at(2500);
    assert_eq!(rig.status(), 0b00111);
    assert_eq!(
        rig.registers(Table::Input, 0, 7),
        Ok(vec![2500, 750, 12, 11, 5, 200, 560])
    );
    rig.coil(1, true).unwrap();
    rig.wait(8000);
    assert_eq!(rig.status(), 0b01111);
    assert_eq!(rig.variable(1) as i16, -2500);
    assert_eq!(rig.variable(2) as i16, -750);
    assert_eq!(rig.bits(Table::Coil, 0, 3), Ok(vec![true, true, false]));
    rig.coil(0, false).unwrap();
    rig.wait(8000);
    assert_eq!((rig.status(), rig.variable(1)), (0b00011, 0));
}

/// reference/drives.md 4.3: from Par 1.1 to Par 1.2.
#[test]
fn reference_range() {
    let mut rig = CxInTime::plain();
    assert_eq!(rig.write(0, &[5000]), Ok(()));
    assert_eq!(rig.write(0, &[5001]), Err(Exception::VALUE));
    rig.write(100, &[10]).unwrap();
    assert_eq!(rig.write(0, &[999]), Err(Exception::VALUE));
    assert_eq!(rig.registers(Table::Holding, 0, 1), Ok(vec![5000]));
    rig.write(101, &[40]).unwrap();
    rig.coil(0, true).unwrap();
    rig.wait(8000);
    assert_eq!(rig.variable(1), 4000, "a parameter that came later bounds it too");
    assert_eq!(rig.write(100, &[41]), Err(Exception::VALUE), "minimum above maximum");
    assert_eq!(rig.write(101, &[9]), Err(Exception::VALUE));

    let mut rig = CxInTime::new(CxOptions {
        reference_out_of_range: OutOfRange::Clamp,
        parameters: vec![((1, 1), 10)],
        ..CxOptions::default()
    });
    assert_eq!(
        (rig.write(0, &[60_000]), rig.registers(Table::Holding, 0, 1)),
        (Ok(()), Ok(vec![5000]))
    );
    assert_eq!(
        (rig.write(0, &[3]), rig.registers(Table::Holding, 0, 1)),
        (Ok(()), Ok(vec![1000]))
    );
}

#[test]
fn addresses_blocks_and_limits() {
    let mut rig = CxInTime::plain();
    let (address, value) = (Exception::ADDRESS, Exception::VALUE);
    assert_eq!(
        rig.registers(Table::Holding, 9900, 2),
        Ok(vec![0, 0]),
        "group 0 at the end"
    );
    assert_eq!(rig.registers(Table::Holding, 100, 14).map(|v| v.len()), Ok(14));
    for pdu in [1, 98, 99, 114, 199, 299, 9799, 9899, 9999, 10_000, u16::MAX] {
        assert_eq!(rig.registers(Table::Holding, pdu, 1), Err(address), "holding {pdu}");
        assert_eq!(rig.write(pdu, &[0]), Err(address), "holding {pdu}");
    }
    assert_eq!(rig.registers(Table::Input, 0, 20).map(|v| v.len()), Ok(20));
    for pdu in [20, 98, 99, 101, u16::MAX] {
        assert_eq!(rig.registers(Table::Input, pdu, 1), Err(address), "input {pdu}");
    }
    assert_eq!(rig.registers(Table::Input, 100, 1), Ok(vec![0]));
    assert_eq!(rig.registers(Table::Input, 0, 21), Err(value), "21 registers");
    assert_eq!(rig.bits(Table::Coil, 0, 9), Err(value), "9 bits");
    assert_eq!(rig.bits(Table::Coil, 2, 2), Err(address));
    assert_eq!(rig.bits(Table::DiscreteInput, 5, 1), Err(address));
    assert_eq!(rig.coil(3, true), Err(address));
    assert_eq!(rig.write(102, &[0]), Err(value), "below the range of Par 1.3");
    let mut single = CxInTime::new(CxOptions {
        limits: Limits {
            bits: 1,
            registers: 1,
            beyond: Beyond::Address,
        },
        ..CxOptions::default()
    });
    assert_eq!(single.registers(Table::Input, 0, 2), Err(address));
    assert_eq!(single.bits(Table::DiscreteInput, 0, 2), Err(address));
    assert!(single.bits(Table::DiscreteInput, 4, 1).is_ok());
}

/// reference/drives.md 9.6.
#[test]
fn an_address_offset_per_table() {
    let mut rig = CxInTime::new(CxOptions {
        offset: AddressOffset {
            discrete_input: 1,
            input: 1,
            holding: 1,
            ..AddressOffset::default()
        },
        ..CxOptions::default()
    });
    // The frames of the start-up test: the reference is written to 1, and the run state is read from 3.
    rig.coil(0, true).unwrap();
    rig.write(1, &[1000]).unwrap();
    rig.wait(8000);
    assert_eq!(rig.bits(Table::DiscreteInput, 3, 1), Ok(vec![true]));
    assert_eq!(rig.registers(Table::Input, 1, 1), Ok(vec![1000]));
    assert_eq!(rig.registers(Table::Holding, 102, 1), Ok(vec![50]), "Par 1.2");
    assert_eq!(rig.registers(Table::Input, 101, 1), Ok(vec![0]), "active fault");
    assert_eq!(rig.registers(Table::Holding, 0, 1), Err(Exception::ADDRESS));
    assert_eq!(rig.bits(Table::DiscreteInput, 0, 1), Err(Exception::ADDRESS));
}

#[test]
fn functions_of_other_devices_are_illegal() {
    let mut rig = CxInTime::plain();
    for request in [
        RequestPdu::write_registers(0, &[1]),
        RequestPdu::WriteCoils {
            start: 0,
            bits: vec![true],
        },
        RequestPdu::MaskWrite {
            address: 0,
            and_mask: 0,
            or_mask: 1,
        },
        RequestPdu::DeviceIdentification { code: 1, object: 0 },
    ] {
        assert_eq!(rig.ask(&request), Some(Reply::Exception(Exception::FUNCTION)));
    }
    let now = rig.now;
    for (pdu, exception) in [
        (&[0x10, 0, 0, 0, 9, 1][..], Exception::FUNCTION),
        (&[0x05, 0, 0, 0x12, 0x34], Exception::VALUE),
    ] {
        assert_eq!(rig.drive.malformed(pdu, Exception::VALUE, now), Some(exception));
    }
    rig.drive.set_busy(Duration::from_secs(1));
    assert_eq!(rig.write(0, &[0]), Err(Exception::BUSY));
    assert_eq!(rig.diagnose(0, 7), Some(Reply::Diagnostics(7)), "the board is not busy");
    rig.wait(1000);
    assert_eq!(rig.write(0, &[0]), Ok(()));
}

#[test]
fn control_source() {
    let mut rig = CxInTime::plain();
    rig.drive.set_remote(false);
    rig.run_at(5000);
    assert_eq!(rig.status(), 0b00010, "stored, not obeyed");
    rig.drive.set_local(Command {
        run: true,
        reverse: true,
        reference: 2000,
    });
    rig.wait(8000);
    assert_eq!((rig.status(), rig.variable(1) as i16), (0b01110, -1000));
    rig.drive.trip(1);
    rig.coil(2, true).unwrap();
    assert_eq!(rig.registers(Table::Input, 100, 1), Ok(vec![1]), "nor is a reset");
    rig.coil(2, false).unwrap();
    rig.drive.set_remote(true);
    rig.coil(2, true).unwrap();
    assert_eq!(rig.status(), 0b01011, "reset; the motor still coasts counterclockwise");
}

#[test]
fn fault_reset_by_rising_edge_and_no_restart_by_itself() {
    let mut rig = CxInTime::plain();
    rig.run_at(5000);
    rig.drive.trip(14);
    rig.drive.trip(1);
    rig.wait(20);
    assert_eq!(rig.status() & 0b10110, 0b10000);
    assert_eq!(rig.variable(1), 0, "the inverter is off");
    rig.coil(2, true).unwrap();
    assert_eq!(rig.registers(Table::Input, 100, 1), Ok(vec![0]));
    rig.wait(1000);
    assert_eq!(
        rig.status() & 0b10110,
        0b00010,
        "ready, but the run coil needs a new edge"
    );
    rig.drive.trip(1);
    rig.coil(2, true).unwrap();
    assert_eq!(
        rig.registers(Table::Input, 100, 1),
        Ok(vec![1]),
        "a coil that stays on resets nothing"
    );
    rig.coil(2, false).unwrap();
    rig.coil(2, true).unwrap();
    rig.coil(0, false).unwrap();
    rig.coil(0, true).unwrap();
    rig.wait(20);
    assert_eq!(rig.status() & 0b10110, 0b00110);
}

/// reference/drives.md 4.6.
#[test]
fn counters_of_the_board() {
    let mut rig = CxInTime::plain();
    let value = |reply: Option<Reply>| match reply {
        Some(Reply::Diagnostics(value)) => value,
        other => panic!("{other:?}"),
    };
    for _ in 0..3 {
        rig.drive.bus_error();
    }
    rig.drive.bus_message();
    rig.drive.bus_message();
    let _ = rig.write(5000, &[0]);
    let now = rig.now;
    rig.drive
        .broadcast(&RequestPdu::WriteCoil { address: 0, on: false }, now);
    rig.drive.malformed(&[0x07], Exception::FUNCTION, now);
    // There were four messages to this drive; each read of the counter counts itself.
    assert_eq!(value(rig.diagnose(0x000B, 0)), 3);
    assert_eq!(value(rig.diagnose(0x000C, 0)), 3);
    assert_eq!(value(rig.diagnose(0x000D, 0)), 2);
    assert_eq!(value(rig.diagnose(0x000E, 0)), 7);
    assert_eq!(value(rig.diagnose(0x000F, 0)), 1);
    assert_eq!(rig.diagnose(0x000A, 0), Some(Reply::Diagnostics(0)));
    assert_eq!(rig.drive.counters(), Counters::default());
    for bad in [0x0002, 0x0003, 0x0009, 0x0010, 0xFFFF] {
        let reply = rig.diagnose(bad, 0);
        assert_eq!(reply, Some(Reply::Exception(Exception::FUNCTION)), "{bad:04X}");
    }
    for bad in [0x0001, 0x0004, 0x000A, 0x000F] {
        let reply = rig.diagnose(bad, 1);
        assert_eq!(reply, Some(Reply::Exception(Exception::VALUE)), "{bad:04X}");
    }
    rig.diagnose(0x000A, 0);
    for _ in 0..0x1_0000 {
        rig.drive.bus_message();
    }
    assert_eq!(value(rig.diagnose(0x000B, 0)), 1, "they wrap at 16 bits");
}

#[test]
fn listen_only_mode() {
    let mut rig = CxInTime::plain();
    assert_eq!(rig.diagnose(0x0004, 0), None);
    assert!(rig.drive.listens_only());
    let now = rig.now;
    let run = RequestPdu::WriteCoil { address: 0, on: true };
    assert_eq!(rig.ask(&run), None);
    rig.drive.broadcast(&run, now);
    assert_eq!(rig.drive.malformed(&[0x10, 1], Exception::VALUE, now), None);
    for (subfunction, data) in [(0x0000, 1), (0x000A, 0), (0x0004, 0), (0x0001, 5)] {
        assert_eq!(rig.diagnose(subfunction, data), None);
    }
    assert_eq!(rig.wait(1000).drive.state().output, 0.0, "nothing was acted upon");
    let counters = rig.drive.counters();
    assert_eq!((counters.slave_messages, counters.no_responses), (8, 8));
    assert_eq!(rig.diagnose(0x0001, 0xFF00), None);
    assert!(!rig.drive.listens_only());
    assert_eq!(rig.drive.counters(), Counters::default());
    assert_eq!(rig.status(), 0b00011);
    assert_eq!(rig.diagnose(0x0001, 0xFF00), Some(Reply::Diagnostics(0xFF00)));
}

#[test]
fn a_lost_master_changes_nothing() {
    let mut rig = CxInTime::plain();
    rig.run_at(5000);
    rig.wait(3_600_000);
    let state = rig.drive.state();
    assert_eq!((state.output, state.fault), (50.0, 0));
}

#[test]
fn operating_time_and_energy_go_on() {
    let mut rig = CxInTime::new(CxOptions {
        time_step: 0.1,
        ..CxOptions::default()
    });
    assert_eq!((rig.variable(9), rig.variable(10)), (425, 3102));
    rig.run_at(5000);
    for _ in 0..12 {
        rig.wait(500_000);
    }
    assert_eq!(rig.variable(10), 3119, "100 minutes in tenths of an hour");
    assert_eq!(rig.variable(9), 425, "a tenth of a day is not over");
    let now = rig.now;
    let energy = rig.drive.totals.energy;
    assert!(energy > Totals::default().energy);
    rig.drive.power_off();
    rig.drive.power_on(now);
    assert_eq!(rig.drive.totals.energy, energy);
}

#[test]
fn a_power_cycle_clears_commands_and_keeps_parameters() {
    let mut rig = CxInTime::plain();
    rig.write(101, &[40]).unwrap();
    rig.run_at(3000);
    rig.drive.trip(1);
    rig.diagnose(0x0004, 0);
    rig.drive.power_off();
    assert!(!rig.drive.powered());
    let now = rig.wait(1000).now;
    rig.drive.power_on(now);
    rig.wait(20);
    assert_eq!(rig.status(), 0b00011);
    assert_eq!(rig.registers(Table::Holding, 0, 1), Ok(vec![0]));
    assert_eq!(rig.registers(Table::Holding, 101, 1), Ok(vec![40]));
    assert_eq!(rig.bits(Table::Coil, 0, 3), Ok(vec![false; 3]));
}

#[test]
fn the_simulators_own_trip_register() {
    let mut rig = CxInTime::plain();
    assert_eq!(
        rig.write(CxOptions::TRIP_ADDRESS, &[1]),
        Err(Exception::ADDRESS),
        "not unless asked for"
    );
    let mut rig = CxInTime::new(CxOptions {
        trip_register: true,
        ..CxOptions::default()
    });
    rig.write(CxOptions::TRIP_ADDRESS, &[7]).unwrap();
    assert_eq!(rig.registers(Table::Input, 100, 1), Ok(vec![7]));
    assert_eq!(rig.registers(Table::Holding, CxOptions::TRIP_ADDRESS, 1), Ok(vec![0]));
}
