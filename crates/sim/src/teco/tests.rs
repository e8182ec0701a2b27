//! Behaviour of the simulated TECO 7300PA against reference/drives.md, sections 5, 7.3 and 10, in virtual time.

use super::super::model::ReadOnly;
use super::super::motor::Load;
use super::options::{DetectionLevels, Digits};
use super::*;
use crate::in_time::InTime;
use drivegate_proto::{Exception, Table, lrc};
use std::time::Duration;

const VALUE: Exception = Exception::Modbus(0x21);
const MODE: Exception = Exception::Modbus(0x22);

type TecoInTime = InTime<TecoDrive>;

impl TecoInTime {
    fn new(options: TecoOptions) -> TecoInTime {
        InTime::of(TecoDrive::new(options, SimTime::ZERO))
    }

    fn plain() -> TecoInTime {
        TecoInTime::new(TecoOptions::default())
    }

    fn with_parameters(parameters: &[(u16, u16)]) -> TecoInTime {
        TecoInTime::new(TecoOptions {
            parameters: parameters.to_vec(),
            ..TecoOptions::default()
        })
    }

    fn read(&mut self, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        self.registers(Table::Holding, start, count)
    }

    fn one(&mut self, address: u16) -> u16 {
        self.read(address, 1).unwrap()[0]
    }

    /// Operation signals and frequency, and time to settle.
    fn command(&mut self, word: u16, hundredths: u16) {
        self.write(1, &[word, hundredths]).unwrap();
        self.wait(8000);
    }

    fn power_cycle(&mut self) {
        self.drive.power_off();
        let now = self.wait(1000).now;
        self.drive.power_on(now);
        self.wait(20);
    }
}

/// Reply of the drive with address 1 to a frame, without CR LF.
fn exchange(drive: &mut TecoDrive, frame: &str, now: SimTime) -> String {
    let bytes: Vec<u8> = (1..frame.len() - 1)
        .step_by(2)
        .map(|at| u8::from_str_radix(&frame[at..at + 2], 16).unwrap())
        .collect();
    let (check, body) = bytes.split_last().unwrap();
    assert_eq!(lrc(body), *check, "{frame}");
    let (address, pdu) = body.split_first().unwrap();
    let mut answer = vec![*address];
    match RequestPdu::decode(pdu) {
        Ok(request) if *address == 0 => {
            drive.broadcast(&request, now);
            return String::new();
        }
        Ok(request) => drive.answer(&request, now).unwrap().encode(&request, &mut answer),
        Err(exception) => match drive.malformed(pdu, exception, now) {
            Some(exception) => answer.extend([pdu[0] | 0x80, exception.code()]),
            None => return String::new(),
        },
    }
    answer.push(lrc(&answer));
    let digits: Vec<String> = answer.iter().map(|byte| format!("{byte:02X}")).collect();
    format!(":{}", digits.concat())
}

/// Worked frames of reference/drives.md 7.3 and 7.4, in an order in which the drive reaches their states. Register
/// 0009H controls the outputs, since the status reply of the reference shows them off.
#[test]
fn worked_frames() {
    let mut drive = TecoDrive::new(
        TecoOptions {
            parameters: vec![(0x0114, 15), (0x0115, 15), (0x0116, 15)],
            ..TecoOptions::default()
        },
        SimTime::ZERO,
    );
    let script = [
        (1, ":01080000AA55F8", ":01080000AA55F8"),
        (1, ":01060002177070", ":01060002177070"),
        (1, ":010300020001F9", ":010302177073"),
        (1, ":011000010001020001EA", ":011000010001ED"),
        (9, ":010300200002DA", ":01030400050000F3"),
        (9, ":0106020102589C", ":01862257"),
        (9, ":010609000000F0", ":01862257"),
        (9, ":01100500000204006400641C", ":011005000002E8"),
        (9, ":010300200011CB", ":01830379"),
        (9, ":010400200001DA", ":0184017A"),
        (9, ":010600010003F5", ":010600010003F5"),
        (49, ":0103002C0001CF", ":0103020055A5"),
        (49, ":0006000213885D", ""),
        (69, ":010300240001D7", ":01030213885F"),
        (69, ":000600010000F9", ""),
        (99, ":0103002C0001CF", ":0103020042B8"),
        (99, ":010609000000F0", ":010609000000F0"),
        (99, ":010600010008F0", ":010600010008F0"),
        (99, ":010600010000F8", ":010600010000F8"),
        (99, ":010300100001EB", ":0183027A"),
        (99, ":01060002FFFFF9", ":01862158"),
    ];
    for (seconds, request, reply) in script {
        let now = Duration::from_secs(seconds);
        assert_eq!(exchange(&mut drive, request, now), reply, "{request} at {seconds} s");
    }
    let now = Duration::from_secs(100);
    for (request, registers) in [(":010300200010CC", 16), (":010300230006D3", 6)] {
        assert_eq!(exchange(&mut drive, request, now).len(), 9 + 4 * registers, "{request}");
    }
    drive.set_mode(Mode::Program);
    assert_eq!(exchange(&mut drive, ":0106020102589C", now), ":0106020102589C");
}

#[test]
fn start_stop_and_direction() {
    let mut rig = TecoInTime::plain();
    assert_eq!(rig.read(0x20, 2), Ok(vec![0x0044, 0]), "ready, DO1 shows zero speed");
    assert_eq!((rig.one(0x2C), rig.one(0x40)), (0x0042, 10));
    rig.command(1, 3000);
    assert_eq!(rig.one(0x20), 0x00A5, "running, ready, R2A and R1A on");
    assert_eq!((rig.one(0x2C), rig.one(0x2D)), (0x0055, 0b101));
    assert_eq!(rig.read(0x23, 2), Ok(vec![3000, 3000]));
    assert_eq!(rig.read(0x27, 2), Ok(vec![12, 220]));
    assert_eq!(rig.one(0x31), 594);
    rig.command(3, 3000);
    assert_eq!((rig.one(0x20), rig.one(0x24)), (0x00A7, 3000));
    assert_eq!(rig.drive.state().output, -30.0);
    rig.write(1, &[0]).unwrap();
    rig.wait(200);
    assert_eq!(rig.one(0x20) & 1, 1, "still brought down");
    rig.wait(5000);
    assert_eq!((rig.one(0x20), rig.one(0x24)), (0x0044, 0));
}

#[test]
fn order_of_refusals() {
    let mut rig = TecoInTime::plain();
    assert_eq!(rig.read(0xFFFF, 17), Err(Exception::VALUE), "count before address");
    assert_eq!(rig.read(0xFFFF, 2), Err(Exception::ADDRESS));
    assert_eq!(rig.write(0x0201, &[1801; 17]), Err(Exception::VALUE));
    assert_eq!(
        rig.write(0x023E, &[9999, 0]),
        Err(Exception::ADDRESS),
        "address before mode"
    );
    assert_eq!(rig.write(0x0201, &[9999]), Err(MODE), "mode before value");
    assert_eq!(rig.write(0x0400, &[18_001]), Err(VALUE));
    assert_eq!(rig.write(0x0500, &[100, 60_001]), Err(VALUE));
    assert_eq!(rig.one(0x0500), 30, "nothing of a refused message is taken");
    for address in [
        0x0000, 0x0010, 0x001F, 0x003E, 0x003F, 0x0041, 0x0100, 0x0127, 0x0409, 0x0900, 0x09FF,
    ] {
        assert_eq!(rig.read(address, 1), Err(Exception::ADDRESS), "{address:04X}");
    }
    assert_eq!(rig.write(0x0020, &[0]), Err(Exception::ADDRESS), "a monitor register");
    assert_eq!(rig.read(0x0020, 16).map(|v| v.len()), Ok(16));
    for request in [
        RequestPdu::read(Table::Input, 0x20, 99),
        RequestPdu::WriteCoil { address: 0, on: true },
        RequestPdu::MaskWrite {
            address: 1,
            and_mask: 0,
            or_mask: 1,
        },
        RequestPdu::Diagnostics {
            subfunction: 1,
            data: 0,
        },
    ] {
        assert_eq!(rig.ask(&request), Some(Reply::Exception(Exception::FUNCTION)));
    }
    let mut lenient = TecoInTime::new(TecoOptions {
        read_only: ReadOnly::Ignored,
        locked: vec![0x0501],
        ..TecoOptions::default()
    });
    assert_eq!(lenient.write(0x0020, &[0]), Ok(()));
    assert_ne!(lenient.one(0x0020), 0);
    assert_eq!(lenient.write(0x0501, &[100]), Err(VALUE), "not over the bus");
}

/// reference/drives.md 5.6 and 9.8: silence, function, count, in that order.
#[test]
fn messages_that_are_none() {
    let mut rig = TecoInTime::plain();
    let mut refused = |pdu: &[u8]| {
        let exception = RequestPdu::decode(pdu).unwrap_err();
        rig.drive
            .malformed(pdu, exception, SimTime::ZERO)
            .map(|code| code.code())
    };
    assert_eq!(refused(&[0x07]), Some(1));
    assert_eq!(refused(&[0x01, 0]), Some(1));
    assert_eq!(refused(&[0x03, 0, 1]), None, "incomplete");
    assert_eq!(refused(&[0x03, 0, 0x20, 0, 0]), Some(3));
    assert_eq!(refused(&[0x03, 0, 0x20, 1, 0]), Some(3));
    assert_eq!(refused(&[0x06, 0, 1, 0]), None);
    assert_eq!(refused(&[0x08, 0, 0]), None);
    assert_eq!(refused(&[0x10, 0, 1]), None);
    assert_eq!(refused(&[0x10, 0, 1, 0, 1, 2, 0]), None, "byte count and bytes differ");
    assert_eq!(
        refused(&[0x10, 0, 1, 0, 2, 2, 0, 0]),
        Some(3),
        "count and byte count differ"
    );
    assert_eq!(refused(&[0x10, 0, 1, 0, 0, 0]), Some(3));
    assert_eq!(refused(&[0x10, 0xFF, 0xFF, 0, 2, 4, 0, 0, 0, 0]), Some(2));
    assert_eq!(rig.drive.malformed(&[], Exception::FUNCTION, SimTime::ZERO), None);
}

#[test]
fn write_rules_by_mode() {
    let mut rig = TecoInTime::plain();
    assert_eq!((rig.write(0x0400, &[100]), rig.write(0x0519, &[1])), (Ok(()), Ok(())));
    for address in [0x0101, 0x011C, 0x0201, 0x0303, 0x0317] {
        assert_eq!(rig.write(address, &[0]), Err(MODE), "{address:04X} in DRIVE");
        assert!(rig.read(address, 1).is_ok());
    }
    rig.drive.set_mode(Mode::Program);
    assert_eq!(rig.one(0x20) & 4, 0, "not ready");
    assert_eq!(rig.write(0x011C, &[7]), Ok(()));
    assert_eq!(rig.one(0x011C), 0, "reserved");
    assert_eq!(rig.write(0x0003, &[7]), Ok(()));
    assert_eq!(rig.one(0x0003), 0, "reserved");
    assert_eq!(rig.write(0x0201, &[500]), Ok(()));
    assert_eq!(rig.write(0x0113, &[13]), Err(VALUE));
    rig.command(1, 3000);
    assert_eq!(rig.one(0x24), 0, "PRGM does not run");
    rig.drive.set_mode(Mode::Drive);
    rig.wait(1000);
    assert_eq!(rig.one(0x24), 0, "needs a new run command");
    rig.command(0, 3000);
    rig.command(1, 6000);
    assert_eq!(rig.one(0x24), 5000, "the new maximum frequency");
    assert_eq!(rig.write(0x0002, &[18_001]), Err(VALUE));
}

#[test]
fn ram_and_eeprom() {
    let mut rig = TecoInTime::plain();
    rig.drive.set_mode(Mode::Program);
    rig.write(0x0400, &[1111]).unwrap();
    rig.write(0x0313, &[22]).unwrap();
    rig.write(0x0312, &[33]).unwrap();
    rig.power_cycle();
    assert_eq!(rig.one(0x0400), 0, "written to RAM only");
    rig.drive.set_mode(Mode::Program);
    rig.write(0x0400, &[1111]).unwrap();
    rig.write(0x0313, &[22]).unwrap();
    rig.write(0x0312, &[33]).unwrap();
    assert_eq!(rig.write(0x0900, &[0]), Ok(()));
    assert_eq!(rig.one(0x0313), 22);
    rig.write(0x0400, &[2222]).unwrap();
    rig.power_cycle();
    assert_eq!((rig.one(0x0400), rig.one(0x0312)), (1111, 33));
    assert_eq!(rig.one(0x0313), 0, "On-20 is not saved");
    rig.command(1, 3000);
    assert_eq!(rig.write(0x0900, &[0]), Err(MODE), "not while running");
    rig.command(0, 3000);
    assert_eq!(rig.write(0x0900, &[1]), Ok(()));
}

#[test]
fn faults_and_their_reset() {
    let mut rig = TecoInTime::plain();
    rig.command(1, 6000);
    rig.drive.trip(fault::OVERHEAT | 0x8000);
    rig.drive.trip(fault::POWER);
    rig.wait(20);
    assert_eq!(rig.read(0x20, 2).unwrap(), [0x0048, fault::OVERHEAT]);
    assert_eq!(rig.one(0x2C), 0x4002);
    rig.write(1, &[9]).unwrap();
    rig.wait(1000);
    assert_eq!(
        rig.read(0x20, 2),
        Ok(vec![0x0044, 0]),
        "reset, and needs a new run command"
    );
    rig.drive.trip(fault::POWER);
    rig.write(1, &[9]).unwrap();
    assert_eq!(rig.one(0x21), fault::POWER, "a bit that stays set resets nothing");
    assert_eq!(rig.one(0x2C) & 0x4080, 0x4080);
    rig.command(0, 6000);
    rig.command(8, 6000);
    rig.command(1, 6000);
    assert_eq!(rig.one(0x20), 0x00A5);
    rig.drive.trip(0x8000);
    assert_eq!(rig.one(0x21), 0, "no such fault");
}

#[test]
fn external_fault_from_bus_and_terminal() {
    let mut rig = TecoInTime::plain();
    rig.command(1, 3000);
    rig.write(1, &[5]).unwrap();
    assert_eq!(rig.read(0x20, 2).unwrap()[1], fault::EXTERNAL);
    rig.write(1, &[4 + 8]).unwrap();
    assert_eq!(rig.one(0x21), fault::EXTERNAL, "while the bit is on");
    rig.write(1, &[0]).unwrap();
    rig.write(1, &[8]).unwrap();
    assert_eq!(rig.one(0x21), 0);
    rig.drive.set_terminals(0b100);
    assert_eq!((rig.one(0x21), rig.one(0x2B)), (fault::EXTERNAL, 0b100));
}

#[test]
fn sources_of_run_and_frequency() {
    for digits in [Digits::Bits, Digits::Decimal, Digits::Hexadecimal] {
        let mut rig = TecoInTime::new(TecoOptions {
            digits,
            parameters: vec![(0x0400, 1000), (0x0108, digits.register([true, true, false, true]))],
            ..TecoOptions::default()
        });
        rig.command(1, 3000);
        assert_eq!(rig.read(0x23, 2), Ok(vec![1000, 1000]), "An-01");
        assert_eq!(rig.one(0x2C) >> 9 & 0b11, 0b01);
        rig.drive.set_mode(Mode::Program);
        rig.wait(5000);
        let run_by_terminals = digits.register([true, true, true, false]);
        rig.write(0x0108, &[run_by_terminals]).unwrap();
        rig.drive.set_mode(Mode::Drive);
        rig.command(0, 3000);
        rig.command(1, 3000);
        assert_eq!(rig.one(0x24), 0, "0001H does not run it");
        assert_eq!(rig.one(0x2C) >> 9 & 0b11, 0b10);
        rig.drive.set_terminals(0b10);
        rig.wait(8000);
        assert_eq!(
            rig.drive.state().output,
            -30.0,
            "terminal 2, and the frequency of 0002H"
        );
        assert!(!rig.drive.state().remote);
    }
}

#[test]
fn multifunction_references() {
    let steps = [(0x0401, 1500), (0x0402, 2000), (0x0403, 2500), (0x0408, 600)];
    let mut rig = TecoInTime::with_parameters(&steps);
    for (bits, terminals, hundredths) in [
        (0x00, 0, 5000),
        (0x10, 0, 1500),
        (0x20, 0, 2000),
        (0x30, 0, 2500),
        (0x10, 0x20, 2500),
        (0x40, 0, 600),
        (0x70, 0, 600),
    ] {
        rig.drive.set_terminals(terminals);
        rig.command(bits | 1, 5000);
        assert_eq!(rig.one(0x24), hundredths, "{bits:02X} {terminals:02X}");
    }
    rig.command(0x81, 5000);
    assert_eq!(rig.one(0x2C) & 0x0141, 0x0100, "baseblock: neither running nor ready");
    rig.command(0x01, 5000);
    assert_eq!(rig.one(0x20) & 0b101, 0b101);
}

#[test]
fn bounds_and_detection() {
    let mut rig = TecoInTime::with_parameters(&[(0x020D, 50), (0x020E, 20), (0x0214, 250), (0x0215, 10)]);
    rig.command(1, 6000);
    assert_eq!(rig.one(0x24), 3000, "Cn-14");
    assert_eq!(rig.one(0x2C) & 0x3C, 0x14);
    rig.command(1, 2450);
    assert_eq!(
        rig.one(0x2C) & 0x3C,
        0x3C,
        "within the hysteresis of detection 1, and below its level"
    );
    rig.command(1, 0);
    assert_eq!((rig.one(0x24), rig.one(0x2C) & 0x3C), (1200, 0x24), "Cn-15");
    rig.command(1, 2550);
    assert_eq!(rig.one(0x2C) & 0x3C, 0x3C);
    let mut rig = TecoInTime::new(TecoOptions {
        detection_levels: DetectionLevels::Cn32AndCn33,
        parameters: vec![(0x021F, 400), (0x0220, 200)],
        ..TecoOptions::default()
    });
    rig.command(1, 3000);
    assert_eq!(rig.one(0x2C) & 0x30, 0);
    rig.command(1, 4100);
    assert_eq!(rig.one(0x2C) & 0x30, 0x10);
}

#[test]
fn overtorque() {
    let mut rig = TecoInTime::new(TecoOptions {
        load: Load {
            full_torque: 120.0,
            ..Load::default()
        },
        parameters: vec![(0x0219, 100), (0x021A, 10), (0x0500, 300)],
        ..TecoOptions::default()
    });
    rig.write(1, &[1, 6000]).unwrap();
    rig.wait(30_200);
    assert_eq!(rig.one(0x2C) & 1 << 11, 1 << 11, "above 100 % for 1 s");
}

#[test]
fn outputs_by_register() {
    let mut rig = TecoInTime::with_parameters(&[(0x0114, 15), (0x0115, 15), (0x0116, 15)]);
    assert_eq!(rig.one(0x2D), 0);
    rig.write(0x0009, &[0xFFFA]).unwrap();
    rig.write(0x000A, &[255, 128]).unwrap();
    assert_eq!((rig.one(0x2D), rig.one(0x20)), (0b010, 0x0044));
    assert_eq!(rig.read(0x0009, 3), Ok(vec![0xFFFA, 255, 128]));
}

/// reference/drives.md 9.9.
#[test]
fn broadcasts_reach_two_registers_only() {
    let mut rig = TecoInTime::plain();
    let now = rig.now;
    let both = RequestPdu::write_registers(1, &[1, 3000]);
    rig.drive.broadcast(&both, now);
    assert_eq!(rig.read(1, 2), Ok(vec![1, 3000]));
    for (start, values) in [(1, vec![0, 0, 0]), (0x0400, vec![5]), (0, vec![0, 0])] {
        rig.drive.broadcast(&RequestPdu::WriteRegisters { start, values }, now);
    }
    rig.drive.broadcast(&RequestPdu::write_register(0x0500, 9), now);
    assert_eq!(rig.read(1, 2), Ok(vec![1, 3000]));
    assert_eq!((rig.one(0x0400), rig.one(0x0500)), (0, 30));
}

/// Cn-31 only supervises the link between the drive and its card.
#[test]
fn a_lost_master_changes_nothing() {
    let mut rig = TecoInTime::plain();
    rig.command(1, 6000);
    rig.wait(3_600_000);
    let state = rig.drive.state();
    assert_eq!((state.output, state.fault), (60.0, 0));
}

#[test]
fn the_simulators_own_trip_register() {
    let mut rig = TecoInTime::new(TecoOptions {
        trip_register: true,
        ..TecoOptions::default()
    });
    rig.write(TecoOptions::TRIP_ADDRESS, &[fault::OVERVOLTAGE]).unwrap();
    assert_eq!(
        (rig.one(0x21), rig.one(TecoOptions::TRIP_ADDRESS)),
        (fault::OVERVOLTAGE, 0)
    );
}
