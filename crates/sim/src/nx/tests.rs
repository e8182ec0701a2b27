//! Behaviour of the simulated NX against reference/drives.md, sections 3 and 10, in virtual time.

use super::*;
use crate::codec::{Exception, Table};
use std::time::Duration;

/// A drive and its clock.
pub(super) struct Bench {
    pub(super) drive: NxDrive,
    now: SimTime,
}

impl Bench {
    pub(super) fn new(options: NxOptions) -> Bench {
        Bench {
            drive: NxDrive::new(options, SimTime::ZERO),
            now: SimTime::ZERO,
        }
    }

    fn with_parameters(parameters: &[(u16, u16)]) -> Bench {
        Bench::new(NxOptions {
            parameters: parameters.to_vec(),
            ..NxOptions::default()
        })
    }

    pub(super) fn wait(&mut self, milliseconds: u64) -> &mut Bench {
        self.now += Duration::from_millis(milliseconds);
        self.drive.advance(self.now);
        self
    }

    pub(super) fn read(&mut self, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        let pdu = RequestPdu::Read {
            table: Table::Holding,
            start,
            count,
        };
        let holding = self.drive.answer(&pdu, self.now).unwrap();
        let input = self.drive.answer(
            &RequestPdu::Read {
                table: Table::Input,
                start,
                count,
            },
            self.now,
        );
        let input = input.unwrap();
        assert_eq!(
            holding, input,
            "every register answers to 03 and 04 alike (reference/drives.md 3.1)"
        );
        match holding {
            Reply::Registers(values) => Ok(values),
            Reply::Exception(exception) => Err(exception),
            other => panic!("{other:?}"),
        }
    }

    pub(super) fn one(&mut self, start: u16) -> u16 {
        self.read(start, 1).unwrap()[0]
    }

    pub(super) fn write(&mut self, start: u16, values: &[u16]) -> Result<(), Exception> {
        let pdu = match values {
            [value] => RequestPdu::WriteRegister {
                address: start,
                value: *value,
            },
            _ => RequestPdu::WriteRegisters {
                start,
                values: values.to_vec(),
            },
        };
        match self.drive.answer(&pdu, self.now).unwrap() {
            Reply::Written => Ok(()),
            Reply::Exception(exception) => Err(exception),
            other => panic!("{other:?}"),
        }
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
    let mut bench = Bench::new(NxOptions::default());
    assert_eq!(
        bench.status(),
        0x0541,
        "healthy and idle (reference/drives.md, section 10)"
    );
    assert_eq!(bench.one(2101), 0x2000, "fieldbus is the control place");
    bench.write(2000, &[1]).unwrap();
    bench.wait(20);
    assert_eq!(bench.status() & status_word::RUN, status_word::RUN);
    bench.write(2002, &[5000]).unwrap();
    bench.wait(50);
    assert_eq!(bench.status() & status_word::AT_REFERENCE, 0, "on the way");
    bench.wait(3000);
    assert_eq!(bench.read(2102, 2).unwrap(), [5000, 2500]);
    assert_eq!(bench.status(), 0x05A3);
    assert_eq!(bench.read(2104, 7).unwrap(), [750, 12, 105, 53, 2000, 560, 0]);
    bench.write(2000, &[0]).unwrap();
    bench.wait(100);
    assert_eq!(
        bench.status() & status_word::RUN,
        status_word::RUN,
        "still brought down"
    );
    bench.wait(3000);
    assert_eq!(bench.status(), 0x0541);
}

#[test]
fn references_directions_and_minimum_frequency() {
    for (word, reference, sign) in [(1, 5000, 1.0), (3, 5000, -1.0), (1, -5000, -1.0), (3, -5000, 1.0)] {
        let mut bench = Bench::new(NxOptions::default());
        bench.command(word, reference);
        let signed = bench.one(2103) as i16;
        assert_eq!(f64::from(signed), 2500.0 * sign, "word {word} reference {reference}");
        assert_eq!(bench.one(2102) as i16, 2 * signed);
        assert_eq!(bench.status() & status_word::REVERSE != 0, sign < 0.0);
    }
    // f = fmin + reference/10000 x (fmax - fmin): 10 + 0.5 x 50 Hz.
    let mut bench = Bench::with_parameters(&[(101, 1000), (102, 6000)]);
    bench.command(1, 5000);
    assert_eq!(bench.read(2102, 2).unwrap(), [5000, 3500]);
    bench.command(1, 0);
    assert_eq!(bench.read(2102, 2).unwrap(), [0, 1000]);
    bench.command(0, 5000);
    assert_eq!(bench.read(2102, 2).unwrap(), [0, 0]);
    assert_eq!(bench.write(2002, &[10_001]), Err(Exception::VALUE));
    assert_eq!(bench.write(2000, &[1, 0, (-10_001i16) as u16]), Err(Exception::VALUE));
    assert_eq!(bench.one(2000), 0, "nothing of a refused message is taken");
}

#[test]
fn zero_speed_is_not_the_same_as_stopped() {
    let mut bench = Bench::new(NxOptions::default());
    bench.command(1, 0);
    let running_at_zero = status_word::RUN | status_word::ZERO_SPEED | status_word::AT_REFERENCE;
    assert_eq!(bench.status() & running_at_zero, running_at_zero);
}

/// reference/drives.md 3.2 and 9.26.
#[test]
fn ranges_limits_and_holes() {
    let mut bench = Bench::new(NxOptions::default());
    let (address, value) = (Err(Exception::ADDRESS), Err(Exception::VALUE));
    assert_eq!(bench.read(0, 9).map(|v| v.len()), Ok(9));
    assert_eq!(bench.read(0, 10), address, "ID 10 is a hole");
    assert_eq!(bench.read(0, 31), value, "31 actual values");
    assert_eq!(bench.read(850, 31), value, "31 parameters");
    assert_eq!(bench.read(851, 8), Ok(vec![1, 2, 3, 4, 5, 6, 7, 37]));
    assert_eq!(bench.read(98, 1), Ok(vec![0]));
    assert_eq!(
        bench.read(97, 2),
        address,
        "crosses from actual values to the fault code"
    );
    for pdu in [99, 1999, 2099, 2199, 5000, u16::MAX] {
        assert_eq!(bench.read(pdu, 1), address, "PDU {pdu} belongs to no group");
    }
    assert_eq!(bench.read(1998, 3), address, "crosses a border");
    assert_eq!(bench.read(2000, 11).map(|v| v.len()), Ok(11));
    assert_eq!(bench.read(2000, 12), address, "ID 2012 has no meaning");
    assert_eq!(bench.read(2000, 21), value);
    assert_eq!(bench.read(2100, 12), address);
    assert_eq!(bench.read(6000, 5), address, "the manual's example");
    assert_eq!(bench.write(2000, &[0; 11]), Ok(()));
    assert_eq!(bench.write(2000, &[0; 12]), Err(Exception::ADDRESS));
    assert_eq!(bench.write(2000, &[0; 21]), Err(Exception::VALUE));
    assert_eq!(
        bench.write(100, &[0, 5000]),
        Err(Exception::VALUE),
        "one parameter a message"
    );
    for pdu in [0, 98, 2100] {
        assert_eq!(bench.write(pdu, &[1]), READ_ONLY, "PDU {pdu}");
    }
    assert_eq!(bench.write(732, &[4]), Err(Exception::VALUE));
    assert_eq!(bench.write(300, &[0]), Err(Exception::ADDRESS), "no such parameter");

    let beyond = Limits {
        beyond: Beyond::Address,
        ..Limits::VACON
    };
    let mut eaton = Bench::new(NxOptions {
        limits: Limits {
            beyond: Beyond::Value,
            ..Limits::EATON
        },
        ..NxOptions::default()
    });
    assert_eq!(eaton.read(0, 2), value);
    let mut lenient = Bench::new(NxOptions {
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
    let mut bench = Bench::new(NxOptions::default());
    let coil = RequestPdu::Read {
        table: Table::Coil,
        start: 0,
        count: 1,
    };
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
            bench.drive.answer(&pdu, bench.now),
            Some(Reply::Exception(Exception::FUNCTION))
        );
    }
    bench.drive.set_busy(Duration::from_secs(1));
    assert_eq!(bench.read(2100, 1), Err(Exception::BUSY));
    bench.wait(1000);
    assert!(bench.read(2100, 1).is_ok());
}

#[test]
fn fault_reset_by_rising_edge_and_no_restart_by_itself() {
    let mut bench = Bench::new(NxOptions::default());
    bench.command(1, 5000);
    bench.drive.trip(1);
    bench.wait(20);
    assert_eq!(
        (bench.one(98), bench.one(2110), bench.one(36)),
        (1, 1, 1),
        "the same in all three places"
    );
    let running = status_word::READY | status_word::RUN | status_word::FAULT;
    assert_eq!(bench.status() & running, status_word::FAULT);
    assert_eq!(bench.one(2103), 0, "the inverter is off");
    assert!(bench.one(2104) > 0, "the motor coasts");

    bench.write(2000, &[5]).unwrap();
    bench.wait(20);
    assert_eq!(bench.one(98), 0, "reset with the run bit still set");
    bench.wait(1000);
    assert_eq!(bench.status() & status_word::RUN, 0, "needs a new edge of the run bit");
    bench.command(0, 5000);
    bench.command(1, 5000);
    assert_eq!(bench.status() & status_word::RUN, status_word::RUN);

    bench.drive.trip(14);
    bench.write(2000, &[4]).unwrap();
    bench.wait(5);
    bench.write(2000, &[0]).unwrap();
    bench.wait(20);
    assert_eq!(bench.one(98), 14, "a pulse shorter than the update period is not seen");
    bench.write(2000, &[4]).unwrap();
    bench.wait(20);
    assert_eq!(bench.one(98), 0);
    bench.drive.trip(17);
    bench.wait(100);
    assert_eq!(bench.one(98), 17, "a bit that stays set resets nothing");
}

#[test]
fn the_bus_watchdog_and_its_four_responses() {
    for (response, fault, warning, runs) in [
        (0, 0, false, true),
        (1, 0, true, true),
        (2, 53, false, false),
        (3, 53, false, false),
    ] {
        let mut bench = Bench::with_parameters(&[(733, response)]);
        bench.wait(60_000);
        assert_eq!(bench.drive.state().fault, 0, "a board that never heard a master waits");
        bench.command(1, 10_000);
        bench.wait(11_900);
        assert_eq!(
            bench.drive.state().status & (status_word::FAULT | status_word::WARNING),
            0,
            "19.9 s"
        );
        bench.wait(200);
        let state = bench.drive.state();
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
        bench.wait(10);
        bench.status();
        bench.wait(20);
        assert_eq!(bench.status() & status_word::WARNING, 0, "a message ends the warning");
    }
    let mut off = Bench::new(NxOptions {
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
    let mut bench = Bench::new(NxOptions::default());
    bench.drive.set_control_place(ControlPlace::Panel);
    bench.command(1, 5000);
    assert_eq!((bench.one(2101), bench.one(2103)), (0x4000, 0), "stored, not obeyed");
    assert_eq!(bench.one(2000), 1);
    bench.drive.set_local(Command {
        run: true,
        reverse: true,
        reference: 2000,
    });
    bench.wait(5000);
    assert_eq!(bench.one(2103) as i16, -1000);
    bench.write(124, &[1]).unwrap();
    bench.wait(20);
    assert_eq!(bench.one(2101), 0x8000);
    bench.write(124, &[3]).unwrap();
    bench.wait(8000);
    assert_eq!(
        (bench.one(2101), bench.one(2103)),
        (0x2000, 2500),
        "the stored word counts now"
    );
}

#[test]
fn a_power_cycle_clears_process_data_and_keeps_parameters() {
    let mut bench = Bench::new(NxOptions::default());
    bench.write(102, &[50]).unwrap();
    bench.command(1, 5000);
    bench.drive.trip(9);
    bench.drive.power_off();
    bench.wait(1000);
    let now = bench.now;
    bench.drive.power_on(now);
    bench.wait(20);
    assert_eq!((bench.status(), bench.one(98), bench.one(102)), (0x0541, 0, 50));
    assert_eq!(bench.read(2000, 3), Ok(vec![0, 0, 0]));
}

#[test]
fn interlock_and_warning() {
    let mut bench = Bench::new(NxOptions::default());
    bench.drive.set_interlock(true);
    bench.command(1, 5000);
    assert_eq!(
        bench.status() & (status_word::READY | status_word::RUN | status_word::FAULT),
        0
    );
    bench.drive.set_interlock(false);
    bench.drive.set_warning(true);
    bench.wait(20);
    assert_eq!(bench.status() & status_word::WARNING, status_word::WARNING);
}

#[test]
fn coasting_stop_by_parameter() {
    let mut bench = Bench::with_parameters(&[(506, 0)]);
    bench.command(1, 10_000);
    bench.write(2000, &[0]).unwrap();
    bench.wait(20);
    assert_eq!(bench.one(2103), 0);
    assert_eq!(
        bench.status() & (status_word::RUN | status_word::ZERO_SPEED),
        0,
        "off, and still turning"
    );
    bench.wait(10_000);
    assert_eq!(bench.status(), 0x0541);
}

#[test]
fn tagged_registers_tell_where_they_come_from() {
    let mut bench = Bench::new(NxOptions {
        values: Values::Tagged(7),
        ..NxOptions::default()
    });
    assert_eq!(bench.read(2100, 2), Ok(vec![0x0734, 0x0735]));
    assert_eq!(bench.read(0, 1), Ok(vec![0x0700]));
    assert_eq!(bench.read(2000, 1), Ok(vec![0]), "what a master wrote reads back");
    assert_eq!(bench.read(2100, 12), Err(Exception::ADDRESS));
}

#[test]
fn selectors_of_process_data_out() {
    let mut bench = Bench::new(NxOptions::default());
    bench.write(858, &[102]).unwrap();
    bench.wait(20);
    assert_eq!(bench.one(2110), 5000, "OUT 8 shows the maximum frequency now");
}

#[test]
fn the_simulators_own_trip_register() {
    let mut bench = Bench::new(NxOptions::default());
    assert_eq!(
        bench.write(1998, &[51]),
        Err(Exception::ADDRESS),
        "not unless asked for"
    );
    let mut bench = Bench::new(NxOptions {
        trip_register: true,
        ..NxOptions::default()
    });
    bench.write(1998, &[51]).unwrap();
    assert_eq!((bench.one(98), bench.one(1998)), (51, 0));
}
