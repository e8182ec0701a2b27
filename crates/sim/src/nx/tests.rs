//! Behaviour of the simulated NX against reference/drives.md, sections 3 and 10, in virtual time.

use super::*;
use crate::in_time::InTime;
use drivegate_proto::{Exception, Table};
use std::time::Duration;

pub(super) type NxInTime = InTime<NxDrive>;

impl NxInTime {
    pub(super) fn new(options: NxOptions) -> NxInTime {
        InTime::of(NxDrive::new(options, SimTime::ZERO))
    }

    fn with_parameters(parameters: &[(u16, u16)]) -> NxInTime {
        NxInTime::new(NxOptions {
            parameters: parameters.to_vec(),
            ..NxOptions::default()
        })
    }

    pub(super) fn read(&mut self, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        let holding = self.registers(Table::Holding, start, count);
        assert_eq!(
            holding,
            self.registers(Table::Input, start, count),
            "every register answers to 03 and 04 alike (reference/drives.md 3.1)"
        );
        holding
    }

    pub(super) fn one(&mut self, start: u16) -> u16 {
        self.read(start, 1).unwrap()[0]
    }

    /// Writes and waits until the drive has settled.
    pub(super) fn command(&mut self, word: u16, reference: i16) {
        self.write(2000, &[word, 0, reference as u16]).unwrap();
        self.wait(8000);
    }

    pub(super) fn status(&mut self) -> u16 {
        self.one(2100)
    }
}

const READ_ONLY: Result<(), Exception> = Err(Exception::ADDRESS);

/// reference/drives.md 3.12.
#[test]
fn start_up_test_of_the_manuals() {
    let mut rig = NxInTime::new(NxOptions::default());
    assert_eq!(
        rig.status(),
        0x0541,
        "healthy and idle (reference/drives.md, section 10)"
    );
    assert_eq!(rig.one(2101), 0x2000, "fieldbus is the control place");
    rig.write(2000, &[1]).unwrap();
    rig.wait(20);
    assert_eq!(rig.status() & status_word::RUN, status_word::RUN);
    rig.write(2002, &[5000]).unwrap();
    rig.wait(50);
    assert_eq!(rig.status() & status_word::AT_REFERENCE, 0, "on the way");
    rig.wait(3000);
    assert_eq!(rig.read(2102, 2).unwrap(), [5000, 2500]);
    assert_eq!(rig.status(), 0x05A3);
    assert_eq!(rig.read(2104, 7).unwrap(), [750, 12, 105, 53, 2000, 560, 0]);
    rig.write(2000, &[0]).unwrap();
    rig.wait(100);
    assert_eq!(rig.status() & status_word::RUN, status_word::RUN, "still brought down");
    rig.wait(3000);
    assert_eq!(rig.status(), 0x0541);
}

#[test]
fn references_directions_and_minimum_frequency() {
    for (word, reference, sign) in [(1, 5000, 1.0), (3, 5000, -1.0), (1, -5000, -1.0), (3, -5000, 1.0)] {
        let mut rig = NxInTime::new(NxOptions::default());
        rig.command(word, reference);
        let signed = rig.one(2103) as i16;
        assert_eq!(f64::from(signed), 2500.0 * sign, "word {word} reference {reference}");
        assert_eq!(rig.one(2102) as i16, 2 * signed);
        assert_eq!(rig.status() & status_word::REVERSE != 0, sign < 0.0);
    }
    // f = fmin + reference/10000 x (fmax - fmin): 10 + 0.5 x 50 Hz.
    let mut rig = NxInTime::with_parameters(&[(101, 1000), (102, 6000)]);
    rig.command(1, 5000);
    assert_eq!(rig.read(2102, 2).unwrap(), [5000, 3500]);
    rig.command(1, 0);
    assert_eq!(rig.read(2102, 2).unwrap(), [0, 1000]);
    rig.command(0, 5000);
    assert_eq!(rig.read(2102, 2).unwrap(), [0, 0]);
    assert_eq!(rig.write(2002, &[10_001]), Err(Exception::VALUE));
    assert_eq!(rig.write(2000, &[1, 0, (-10_001i16) as u16]), Err(Exception::VALUE));
    assert_eq!(rig.one(2000), 0, "nothing of a refused message is taken");
}

#[test]
fn zero_speed_is_not_the_same_as_stopped() {
    let mut rig = NxInTime::new(NxOptions::default());
    rig.command(1, 0);
    let running_at_zero = status_word::RUN | status_word::ZERO_SPEED | status_word::AT_REFERENCE;
    assert_eq!(rig.status() & running_at_zero, running_at_zero);
}

/// reference/drives.md 3.2 and 9.26.
#[test]
fn ranges_limits_and_holes() {
    let mut rig = NxInTime::new(NxOptions::default());
    let (address, value) = (Err(Exception::ADDRESS), Err(Exception::VALUE));
    assert_eq!(rig.read(0, 9).map(|v| v.len()), Ok(9));
    assert_eq!(rig.read(0, 10), address, "ID 10 is a hole");
    assert_eq!(rig.read(0, 31), value, "31 actual values");
    assert_eq!(rig.read(850, 31), value, "31 parameters");
    assert_eq!(rig.read(851, 8), Ok(vec![1, 2, 3, 4, 5, 6, 7, 37]));
    assert_eq!(rig.read(98, 1), Ok(vec![0]));
    assert_eq!(rig.read(97, 2), address, "crosses from actual values to the fault code");
    for pdu in [99, 1999, 2099, 2199, 5000, u16::MAX] {
        assert_eq!(rig.read(pdu, 1), address, "PDU {pdu} belongs to no group");
    }
    assert_eq!(rig.read(1998, 3), address, "crosses a border");
    assert_eq!(rig.read(2000, 11).map(|v| v.len()), Ok(11));
    assert_eq!(rig.read(2000, 12), address, "ID 2012 has no meaning");
    assert_eq!(rig.read(2000, 21), value);
    assert_eq!(rig.read(2100, 12), address);
    assert_eq!(rig.read(6000, 5), address, "the manual's example");
    assert_eq!(rig.write(2000, &[0; 11]), Ok(()));
    assert_eq!(rig.write(2000, &[0; 12]), Err(Exception::ADDRESS));
    assert_eq!(rig.write(2000, &[0; 21]), Err(Exception::VALUE));
    assert_eq!(
        rig.write(100, &[0, 5000]),
        Err(Exception::VALUE),
        "one parameter a message"
    );
    for pdu in [0, 98, 2100] {
        assert_eq!(rig.write(pdu, &[1]), READ_ONLY, "PDU {pdu}");
    }
    assert_eq!(rig.write(732, &[4]), Err(Exception::VALUE));
    assert_eq!(rig.write(300, &[0]), Err(Exception::ADDRESS), "no such parameter");

    let beyond = Limits {
        beyond: Beyond::Address,
        ..Limits::VACON
    };
    let mut eaton = NxInTime::new(NxOptions {
        limits: Limits {
            beyond: Beyond::Value,
            ..Limits::EATON
        },
        ..NxOptions::default()
    });
    assert_eq!(eaton.read(0, 2), value);
    let mut lenient = NxInTime::new(NxOptions {
        limits: beyond,
        hole: Hole::Zero,
        read_only: ReadOnly::Ignored,
        ..NxOptions::default()
    });
    assert_eq!(lenient.read(0, 31), address);
    assert_eq!(lenient.read(2100, 12).map(|v| v[11]), Ok(0));
    assert_eq!(lenient.write(2000, &[0; 12]), Ok(()));
    assert_eq!(lenient.write(2100, &[0]), Ok(()));
    assert_ne!(lenient.one(2100), 0);
}

#[test]
fn functions_of_other_devices_are_illegal() {
    let mut rig = NxInTime::new(NxOptions::default());
    let coil = RequestPdu::read(Table::Coil, 0, 1);
    let identify = RequestPdu::DeviceIdentification { code: 1, object: 0 };
    for pdu in [
        coil,
        identify,
        RequestPdu::MaskWrite {
            address: 2000,
            and_mask: 0,
            or_mask: 1,
        },
    ] {
        assert_eq!(
            rig.drive.answer(&pdu, rig.now),
            Some(Reply::Exception(Exception::FUNCTION))
        );
    }
    rig.drive.set_busy(Duration::from_secs(1));
    assert_eq!(rig.read(2100, 1), Err(Exception::BUSY));
    rig.wait(1000);
    assert!(rig.read(2100, 1).is_ok());
}

#[test]
fn fault_reset_by_rising_edge_and_no_restart_by_itself() {
    let mut rig = NxInTime::new(NxOptions::default());
    rig.command(1, 5000);
    rig.drive.trip(1);
    rig.wait(20);
    assert_eq!(
        (rig.one(98), rig.one(2110), rig.one(36)),
        (1, 1, 1),
        "the same in all three places"
    );
    let running = status_word::READY | status_word::RUN | status_word::FAULT;
    assert_eq!(rig.status() & running, status_word::FAULT);
    assert_eq!(rig.one(2103), 0, "the inverter is off");
    assert!(rig.one(2104) > 0, "the motor coasts");

    rig.write(2000, &[5]).unwrap();
    rig.wait(20);
    assert_eq!(rig.one(98), 0, "reset with the run bit still set");
    rig.wait(1000);
    assert_eq!(rig.status() & status_word::RUN, 0, "needs a new edge of the run bit");
    rig.command(0, 5000);
    rig.command(1, 5000);
    assert_eq!(rig.status() & status_word::RUN, status_word::RUN);

    rig.drive.trip(14);
    rig.write(2000, &[4]).unwrap();
    rig.wait(5);
    rig.write(2000, &[0]).unwrap();
    rig.wait(20);
    assert_eq!(rig.one(98), 14, "a pulse shorter than the update period is not seen");
    rig.write(2000, &[4]).unwrap();
    rig.wait(20);
    assert_eq!(rig.one(98), 0);
    rig.drive.trip(17);
    rig.wait(100);
    assert_eq!(rig.one(98), 17, "a bit that stays set resets nothing");
}

#[test]
fn the_bus_watchdog_and_its_four_responses() {
    for (response, fault, warning, runs) in [
        (0, 0, false, true),
        (1, 0, true, true),
        (2, 53, false, false),
        (3, 53, false, false),
    ] {
        let mut rig = NxInTime::with_parameters(&[(733, response)]);
        rig.wait(60_000);
        assert_eq!(rig.drive.state().fault, 0, "a board that never heard a master waits");
        rig.command(1, 10_000);
        rig.wait(11_900);
        assert_eq!(
            rig.drive.state().status & (status_word::FAULT | status_word::WARNING),
            0,
            "19.9 s"
        );
        rig.wait(200);
        let state = rig.drive.state();
        assert_eq!(state.fault, fault, "P2.7.22 = {response}");
        assert_eq!(
            state.status & status_word::WARNING != 0,
            warning,
            "P2.7.22 = {response}"
        );
        assert_eq!(state.status & status_word::RUN != 0, runs, "P2.7.22 = {response}");
        match response {
            2 => assert!(state.output > 40.0, "ramped down"),
            3 => assert_eq!(state.output, 0.0, "coasts"),
            _ => assert_eq!(state.output, 50.0),
        }
        rig.wait(10);
        rig.status();
        rig.wait(20);
        assert_eq!(rig.status() & status_word::WARNING, 0, "a message ends the warning");
    }
    let mut off = NxInTime::new(NxOptions {
        timeout: Duration::ZERO,
        parameters: vec![(733, 3)],
        ..NxOptions::default()
    });
    off.command(1, 5000);
    off.wait(3_600_000);
    assert_eq!(off.drive.state().fault, 0);
}

#[test]
fn control_places() {
    let mut rig = NxInTime::new(NxOptions::default());
    rig.drive.set_control_place(ControlPlace::Panel);
    rig.command(1, 5000);
    assert_eq!((rig.one(2101), rig.one(2103)), (0x4000, 0), "stored, not obeyed");
    assert_eq!(rig.one(2000), 1);
    rig.drive.set_local(Command {
        run: true,
        reverse: true,
        reference: 2000,
    });
    rig.wait(5000);
    assert_eq!(rig.one(2103) as i16, -1000);
    rig.write(124, &[1]).unwrap();
    rig.wait(20);
    assert_eq!(rig.one(2101), 0x8000);
    rig.write(124, &[3]).unwrap();
    rig.wait(8000);
    assert_eq!(
        (rig.one(2101), rig.one(2103)),
        (0x2000, 2500),
        "the stored word counts now"
    );
}

#[test]
fn a_power_cycle_clears_process_data_and_keeps_parameters() {
    let mut rig = NxInTime::new(NxOptions::default());
    rig.write(102, &[50]).unwrap();
    rig.command(1, 5000);
    rig.drive.trip(9);
    rig.drive.power_off();
    rig.wait(1000);
    let now = rig.now;
    rig.drive.power_on(now);
    rig.wait(20);
    assert_eq!((rig.status(), rig.one(98), rig.one(102)), (0x0541, 0, 50));
    assert_eq!(rig.read(2000, 3), Ok(vec![0, 0, 0]));
}

#[test]
fn interlock_and_warning() {
    let mut rig = NxInTime::new(NxOptions::default());
    rig.drive.set_interlock(true);
    rig.command(1, 5000);
    assert_eq!(
        rig.status() & (status_word::READY | status_word::RUN | status_word::FAULT),
        0
    );
    rig.drive.set_interlock(false);
    rig.drive.set_warning(true);
    rig.wait(20);
    assert_eq!(rig.status() & status_word::WARNING, status_word::WARNING);
}

#[test]
fn coasting_stop_by_parameter() {
    let mut rig = NxInTime::with_parameters(&[(506, 0)]);
    rig.command(1, 10_000);
    rig.write(2000, &[0]).unwrap();
    rig.wait(20);
    assert_eq!(rig.one(2103), 0);
    assert_eq!(
        rig.status() & (status_word::RUN | status_word::ZERO_SPEED),
        0,
        "off, and still turning"
    );
    rig.wait(10_000);
    assert_eq!(rig.status(), 0x0541);
}

#[test]
fn tagged_registers_tell_where_they_come_from() {
    let mut rig = NxInTime::new(NxOptions {
        values: Values::Tagged(7),
        ..NxOptions::default()
    });
    assert_eq!(rig.read(2100, 2), Ok(vec![0x0734, 0x0735]));
    assert_eq!(rig.read(0, 1), Ok(vec![0x0700]));
    assert_eq!(rig.read(2000, 1), Ok(vec![0]), "what a master wrote reads back");
    assert_eq!(rig.read(2100, 12), Err(Exception::ADDRESS));
}

#[test]
fn selectors_of_process_data_out() {
    let mut rig = NxInTime::new(NxOptions::default());
    rig.write(858, &[102]).unwrap();
    rig.wait(20);
    assert_eq!(rig.one(2110), 5000, "OUT 8 shows the maximum frequency now");
}

#[test]
fn the_simulators_own_trip_register() {
    let mut rig = NxInTime::new(NxOptions::default());
    assert_eq!(rig.write(1998, &[51]), Err(Exception::ADDRESS), "not unless asked for");
    let mut rig = NxInTime::new(NxOptions {
        trip_register: true,
        ..NxOptions::default()
    });
    rig.write(1998, &[51]).unwrap();
    assert_eq!((rig.one(98), rig.one(1998)), (51, 0));
}
