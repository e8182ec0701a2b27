//! Differences of the Eaton SVX and HVX from the Vacon NX (reference/drives.md 3 and 9).

use super::tests::NxInTime;
use super::*;
use drivegate_proto::Exception;

fn svx() -> NxInTime {
    NxInTime::new(NxOptions::svx())
}

fn hvx() -> NxInTime {
    NxInTime::new(NxOptions::hvx())
}

#[test]
fn idle_words() {
    let mut rig = svx();
    assert_eq!(rig.read(2100, 2), Ok(vec![0x0001, 0]));
    let mut rig = hvx();
    assert_eq!(rig.read(2100, 2), Ok(vec![0x0101, 0x0018]), "auto, and not off");
}

#[test]
fn one_register_a_message_but_for_process_data() {
    for mut rig in [svx(), hvx()] {
        for start in [0, 100] {
            assert_eq!(rig.read(start, 1).map(|v| v.len()), Ok(1));
            assert_eq!(rig.read(start, 2), Err(Exception::VALUE));
        }
        assert_eq!(rig.read(98, 1), Ok(vec![0]));
        assert_eq!(rig.read(2100, 11).map(|v| v.len()), Ok(11));
        assert_eq!(rig.write(2000, &[0; 11]), Ok(()));
        assert_eq!(rig.write(102, &[30, 30]), Err(Exception::VALUE));
    }
}

/// reference/drives.md 9.2: unsigned percent of the maximum frequency.
#[test]
fn reference_of_the_maximum_frequency() {
    let mut rig = NxInTime::new(NxOptions {
        parameters: vec![(101, 1000), (102, 6000)],
        ..NxOptions::svx()
    });
    rig.command(1, 5000);
    assert_eq!(rig.read(2100, 4), Ok(vec![0x0023, 0, 5000, 3000]));
    rig.command(3, 10_000);
    assert_eq!(rig.read(2100, 1), Ok(vec![0x0027]));
    assert_eq!(rig.one(2102) as i16, -10_000);
    rig.command(1, 0);
    assert_eq!(rig.one(2103), 1000, "not below the minimum frequency");
    assert_eq!(rig.write(2002, &[10_001]), Err(Exception::VALUE));
    assert_eq!(rig.write(2002, &[(-1i16) as u16]), Err(Exception::VALUE));
}

/// reference/drives.md 9.1 and 9.3.
#[test]
fn configurable_scales() {
    let mut rig = NxInTime::new(NxOptions {
        frequency_step: 0.1,
        reference: SpeedReference {
            unit: Unit::Hertz,
            ..NxOptions::svx().reference
        },
        ..NxOptions::svx()
    });
    rig.command(1, 2500);
    assert_eq!(rig.read(2102, 2), Ok(vec![5000, 250]), "50 % and 25.0 Hz");
    assert_eq!(rig.write(2002, &[5000]), Ok(()));
    assert_eq!(rig.write(2002, &[5001]), Err(Exception::VALUE), "above 50.00 Hz");
}

#[test]
fn the_watchdog_expires_after_ten_seconds() {
    let mut rig = NxInTime::new(NxOptions {
        parameters: vec![(733, 3)],
        ..NxOptions::hvx()
    });
    rig.command(1, 10_000);
    rig.wait(1900);
    assert_eq!(rig.drive.state().fault, 0, "9.9 s");
    rig.wait(200);
    assert_eq!(rig.drive.state().fault, FIELDBUS_FAULT);
}

#[test]
fn interlock_shows_in_both_words_of_an_hvx() {
    let mut rig = hvx();
    rig.drive.set_interlock(true);
    rig.command(1, 5000);
    assert_eq!(rig.read(2100, 2), Ok(vec![0x0000, 0x0019]));
    assert_eq!(rig.one(2103), 0);
}

#[test]
fn bypass_takes_the_motor_from_the_inverter() {
    let mut rig = hvx();
    rig.command(1, 10_000);
    rig.command(1 | control_word::BYPASS, 10_000);
    assert_eq!(rig.read(2100, 4), Ok(vec![0x0141, 0x001A, 0, 0]));
    rig.command(1, 10_000);
    assert_eq!(rig.read(2100, 2), Ok(vec![0x0123, 0x0018]));
    rig.command(control_word::BYPASS, 0);
    rig.drive.set_interlock(true);
    rig.wait(20);
    assert_eq!(rig.status() & status_word::BYPASS, 0, "an interlock opens the bypass");
    let mut svx = svx();
    svx.command(control_word::BYPASS | control_word::FIRE_MODE, 0);
    assert_eq!(svx.status(), 1, "an SVX has no such bits");
}

#[test]
fn fire_mode_runs_at_the_maximum_frequency() {
    let mut rig = hvx();
    rig.command(control_word::FIRE_MODE, 1000);
    assert_eq!(rig.read(2100, 4), Ok(vec![0x01A3, 0x001C, 10_000, 5000]));
    rig.drive.trip(1);
    rig.command(control_word::FIRE_MODE | control_word::RESET, 1000);
    assert_eq!(rig.one(2103), 0, "the fire mode bit needs a new edge after a fault too");
    rig.command(0, 0);
    rig.command(control_word::FIRE_MODE, 0);
    assert_eq!(rig.one(2103), 5000);
}

#[test]
fn hand_off_auto_and_outputs_passed_through() {
    let mut rig = hvx();
    rig.command(control_word::DIGITAL_OUTPUT | control_word::RELAY_2, 0);
    assert_eq!(rig.one(16), 0b101, "DO1 and RO2");
    rig.drive.set_remote(false);
    rig.wait(20);
    assert_eq!(rig.one(2101), 0x0010, "hand");
    assert_eq!(rig.one(16), 0);
    rig.drive.set_remote(true);
    rig.drive.set_switched_off(true);
    rig.command(1, 5000);
    assert_eq!((rig.one(2101), rig.one(2103)), (0x0008, 0), "off");
}
