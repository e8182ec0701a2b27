//! Another master stops a drive whose control word cannot be read, while the gateway refreshes its orders: the motor
//! slows down for seconds, and shows only by its speed that it was stopped.

use std::time::Duration;

use drivegate_core::process_image::{LeaseAction, Supervision};
use drivegate_model::drive::profile::Profiles;
use drivegate_proto::Protocol;
use drivegate_sim::random::Random;
use drivegate_sim::simulated_drive::Command;

use super::bus::{Parts, Seen};
use super::orders::run_command;
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

const EVERY: Duration = Duration::from_millis(500);
/// Longer than the ramp down from the reference.
const RAMP: Duration = Duration::from_secs(6);
/// Reference in percent, as a client writes it, and in hundredths of a percent, as the simulator has it.
const REFERENCE: f64 = 80.0;
const STOPS: u32 = 10;
/// Share of the reference that a motor may have lost before the refresh notices its fall.
const UNNOTICED: f64 = 0.05;

/// Names of the families whose word is repeated and cannot be read.
fn families() -> Vec<&'static str> {
    let built_in = Profiles::built_in();
    let is_hidden = |name: &&str| {
        let profile = built_in.get(name).unwrap();
        let word = profile.repeats().is_ok_and(|repeats| repeats.word);
        word && profile.control.as_ref().is_some_and(|control| !control.is_read())
    };
    [
        "danfoss-fc",
        "fuji-frenic",
        "mitsubishi-d700",
        "teco-f510",
        "toshiba-vf-s15",
        "weg-cfw",
        "yaskawa-v1000",
    ]
    .into_iter()
    .filter(is_hidden)
    .collect()
}

/// A drive that runs at its reference and is refreshed.
fn running(family: &'static str, seed: u64) -> Rig {
    let line = Line {
        cycle: Duration::from_millis(50),
        refresh: Some(EVERY),
        supervision: Some(Supervision {
            timeout: Duration::from_secs(10),
            action: LeaseAction::Stop,
            adopt: false,
        }),
        ..line(family, Protocol::ModbusRtu, 19_200, 1)
    };
    let mut rig = Rig::new(&line, Parts::of(0, &line, seed));
    rig.until("it is read", PATIENCE, Rig::is_whole);
    rig
}

/// Runs for this time with the client present; the refreshes with a run command, each with the speed at which it was sent.
fn refreshes(rig: &mut Rig, time: Duration) -> Vec<f64> {
    let until = rig.now + time;
    let mut sent = Vec::new();
    while let Some(seen) = rig.step(until) {
        rig.bus.handle.image.drives[0].renew_lease(rig.now);
        for seen in seen {
            if let Seen::Sent(asked) = seen
                && asked.is_refresh
                && asked.pdu.is_write()
                && run_command(&rig.bus.profile, &asked.pdu) == Some(true)
            {
                sent.push(rig.with_drive(1, |drive, _| drive.state().output.abs()));
            }
        }
    }
    sent
}

#[test]
fn a_stop_of_another_master_is_overwritten_only_before_the_motor_has_slowed_down() {
    let families = families();
    assert_eq!(families.len(), 7, "{families:?}");
    for (number, family) in families.into_iter().enumerate() {
        let mut dice = Random::new(number as u64);
        let mut rig = running(family, number as u64);
        let mut stayed = 0;
        for _ in 0..STOPS {
            let started = rig.set(1, &[("speed_reference", REFERENCE), ("run", 1.0)]);
            assert!(started.is_ok(), "{family}: {started:?}");
            refreshes(&mut rig, RAMP);
            let moment = dice.within(0..=EVERY.as_millis() as u64);
            refreshes(&mut rig, Duration::from_millis(moment));
            let full = rig.with_drive(1, |drive, _| drive.state().output.abs());
            assert!(full > 30.0, "{family} turns at {full} Hz");
            rig.with_drive(1, |drive, _| {
                drive.command(Command {
                    run: false,
                    reverse: false,
                    reference: (REFERENCE * 100.0) as i16,
                });
            });
            let again = refreshes(&mut rig, RAMP);
            let late: Vec<&f64> = again
                .iter()
                .filter(|speed| **speed < full * (1.0 - UNNOTICED))
                .collect();
            assert!(
                late.is_empty(),
                "{family}: the run command goes out at {late:?} of {full} Hz"
            );
            let stands = rig.with_drive(1, |drive, _| !drive.state().running);
            assert_eq!(stands, again.is_empty(), "{family}: {again:?}");
            stayed += u32::from(stands);
        }
        assert!(
            stayed >= STOPS * 7 / 10,
            "{family}: only {stayed} of {STOPS} stops stayed"
        );
    }
}

/// The client is there: a motor that returns to its reference, and one that turns on at a lower speed, are refreshed again,
/// unless the drive reports the other master's reference.
#[test]
fn a_motor_that_no_longer_slows_down_is_refreshed_again() {
    let mut refreshed = 0;
    for (number, family) in families().into_iter().enumerate() {
        let mut rig = running(family, 100 + number as u64);
        assert!(
            rig.set(1, &[("speed_reference", REFERENCE), ("run", 1.0)]).is_ok(),
            "{family}"
        );
        refreshes(&mut rig, RAMP);
        for part in [0.9, 1.0] {
            rig.with_drive(1, |drive, _| {
                drive.command(Command {
                    run: true,
                    reverse: false,
                    reference: (REFERENCE * 100.0 * part) as i16,
                });
            });
            refreshes(&mut rig, 2 * EVERY);
            let again = refreshes(&mut rig, 3 * EVERY);
            let told = rig
                .value(1, "speed_reference")
                .is_none_or(|value| (value.as_f64() - REFERENCE).abs() > 1.0);
            if told {
                break;
            }
            assert!(
                !again.is_empty(),
                "{family} at {part} of its reference is not refreshed"
            );
            refreshed += 1;
        }
    }
    assert!(refreshed > 3, "only {refreshed} cases");
}
