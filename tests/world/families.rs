//! Every family of the reference, over every protocol that it supports, commanded through one sequence and read by
//! one set of names: the differences are in the profiles, and clients need not know them.

use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::Protocol;
use drivegate_sim::simulated_drive::ModelOptions;

use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

/// Columns: profile, a fault as in the drive's own registers, and the code and the text shown to clients.
const FAMILIES: [(&str, u16, i64, &str); 14] = [
    ("vacon-nx", 53, 53, "fieldbus fault"),
    ("vacon-nx-n2", 53, 53, "fieldbus fault"),
    ("vacon-nx-multipurpose", 53, 53, "fieldbus fault"),
    ("vacon-nx-pid", 53, 53, "fieldbus fault"),
    ("vacon-nx-pump-fan", 53, 53, "fieldbus fault"),
    ("eaton-svx", 53, 53, "fieldbus fault"),
    ("eaton-svx-multipurpose", 53, 53, "fieldbus fault"),
    ("eaton-svx-pid", 53, 53, "fieldbus fault"),
    ("eaton-svx-pump-fan", 53, 53, "fieldbus fault"),
    ("eaton-hvx", 53, 53, "fieldbus fault"),
    ("eaton-hvx-n2", 53, 53, "fieldbus fault"),
    ("vacon-cx", 1, 1, "overcurrent"),
    // The lowest bit of the mask, counted from 1.
    ("teco-7300pa", 0x0002, 2, "overvoltage"),
    ("teco-7300pa-n2", 0x0002, 2, "overvoltage"),
];

/// Points that every family must have.
const EVERYWHERE: [ModelPoint; 12] = [
    ModelPoint::Ready,
    ModelPoint::Running,
    ModelPoint::Reversed,
    ModelPoint::Fault,
    ModelPoint::AtReference,
    ModelPoint::ZeroSpeed,
    ModelPoint::OutputFrequency,
    ModelPoint::MotorCurrent,
    ModelPoint::MotorVoltage,
    ModelPoint::DcLinkVoltage,
    ModelPoint::FaultCode,
    ModelPoint::SpeedReference,
];

/// The line with the factory settings of a drive family.
fn works(family: &'static str, protocol: Protocol) -> Line {
    let (baud, format) = match protocol {
        Protocol::ModbusRtu => (19_200, "8N2"),
        Protocol::ModbusAscii => (19_200, "7N2"),
        Protocol::N2 => (9600, "8N1"),
    };
    Line {
        format,
        spec: |spec| {
            // The range is set only for families that do not report their frequencies.
            let reported = spec.profile.point_index("maximum_frequency").is_some();
            spec.frequency_range = (!reported).then_some(0.0..=60.0);
        },
        ..line(family, protocol, baud, 1)
    }
}

fn set(rig: &mut Rig, points: &[(&str, f64)]) {
    let outcome = rig.set(1, points);
    assert!(outcome.is_ok(), "{points:?}: {outcome}");
}

fn number(rig: &Rig, point: ModelPoint) -> Option<f64> {
    rig.good(1, point).map(Value::as_f64)
}

/// Stop, run forward, 50 %, reverse, a provoked fault, reset, stop.
fn operate(line: &Line, fault: u16, code: i64, text: &str) {
    let (yes, no) = (Value::Bool(true), Value::Bool(false));
    let mut rig = Rig::of(line);
    rig.until("all common points", PATIENCE, |rig| {
        EVERYWHERE.iter().all(|point| rig.good(1, *point).is_some())
    });
    set(&mut rig, &[("run", 0.0)]);
    rig.until_state(1, State::Ready);
    rig.until_good(1, ModelPoint::ZeroSpeed, yes);

    set(&mut rig, &[("run", 1.0), ("reverse", 0.0), ("speed_reference", 50.0)]);
    rig.until_state(1, State::Running);
    rig.until_good(1, ModelPoint::AtReference, yes);
    rig.until("the reference read back", PATIENCE, |rig| {
        number(rig, ModelPoint::SpeedReference) == Some(50.0)
    });
    // The drive may report "at reference" a few hertz before it reaches the reference.
    rig.until("half of 50 or 60 Hz", PATIENCE, |rig| {
        number(rig, ModelPoint::OutputFrequency).is_some_and(|output| [25.0, 30.0].contains(&output))
    });
    rig.until_good(1, ModelPoint::Reversed, no);
    rig.until_good(1, ModelPoint::ZeroSpeed, no);
    rig.until("a current", PATIENCE, |rig| {
        number(rig, ModelPoint::MotorCurrent).is_some_and(|current| current > 0.0)
    });

    set(&mut rig, &[("reverse", 1.0)]);
    rig.until_good(1, ModelPoint::Reversed, yes);
    assert_ne!(
        rig.good(1, ModelPoint::Running),
        Some(no),
        "turning it round does not stop it"
    );

    rig.with_drive(1, |drive, _| drive.trip(fault));
    rig.until_state(1, State::Fault);
    rig.until_good(1, ModelPoint::FaultCode, Value::Integer(code));
    assert_eq!(rig.drive(1).reading(rig.now).fault_text(), text);

    set(&mut rig, &[("fault_reset", 1.0)]);
    rig.until_state(1, State::Ready);
    rig.until_good(1, ModelPoint::FaultCode, Value::Integer(0));
    rig.until_good(1, ModelPoint::ZeroSpeed, yes);
    assert_ne!(rig.good(1, ModelPoint::Running), Some(yes), "a reset starts nothing");

    set(&mut rig, &[("run", 1.0), ("reverse", 0.0)]);
    rig.until_state(1, State::Running);
    set(&mut rig, &[("run", 0.0)]);
    rig.until_state(1, State::Ready);
}

#[test]
fn every_family_is_operated_alike_over_each_protocol_it_speaks() {
    let built_in = Profiles::built_in();
    let here = |name: &str| FAMILIES.iter().any(|(family, ..)| *family == name);
    let has_simulator = |name: &str| ModelOptions::by_name(name).is_some();
    let simulated = built_in
        .iter()
        .filter(|profile| profile.simulator.as_deref().is_some_and(has_simulator));
    assert!(
        simulated.map(|profile| profile.name.as_str()).all(here),
        "no family is left out"
    );
    for (family, fault, code, text) in FAMILIES {
        for protocol in &built_in.get(family).unwrap().protocols {
            println!("{family} over {}", protocol.name());
            operate(&works(family, *protocol), fault, code, text);
        }
    }
}

/// Process data in reaches the register of its application, and is read back under its name.
#[test]
fn process_data_in_is_written_by_the_name_of_its_application() {
    let multipurpose = [
        ("torque_reference", 2003, 12.5, 125),
        ("free_analog_input", 2004, -12.5, -1250),
    ];
    let pid = [
        ("pid_setpoint", 2003, 40.0, 4000),
        ("pid_actual_value_1", 2004, 38.25, 3825),
        ("pid_actual_value_2", 2005, -1.0, -100),
    ];
    for (family, points) in [
        ("vacon-nx-multipurpose", &multipurpose[..]),
        ("vacon-nx-pid", &pid),
        ("vacon-nx-pump-fan", &pid),
        ("eaton-svx-multipurpose", &multipurpose),
        ("eaton-svx-pid", &pid),
        ("eaton-svx-pump-fan", &pid),
        (
            "eaton-hvx",
            &[
                ("pid_setpoint", 2003, 40.0, 4000),
                ("sensor_feedback", 2004, 38.25, 3825),
            ],
        ),
    ] {
        let mut rig = Rig::of(&works(family, Protocol::ModbusRtu));
        rig.until_state(1, State::Ready);
        for (name, register, value, word) in points {
            set(&mut rig, &[(name, *value)]);
            assert_eq!(rig.word(1, *register).cast_signed(), *word, "{name} of {family}");
            rig.until(name, PATIENCE, |rig| rig.value(1, name) == Some(Value::Number(*value)));
        }
        assert_eq!(rig.word(1, 2000), 0, "{family}: the control word stays as it was");
    }
}

/// The application's bits of the control word change no other bit, in particular not the run command.
#[test]
fn bits_of_the_application_leave_run_and_stop_alone() {
    let mut rig = Rig::of(&works("vacon-nx", Protocol::ModbusRtu));
    rig.until_state(1, State::Ready);
    set(&mut rig, &[("control_bit_3", 1.0)]);
    set(&mut rig, &[("control_bit_15", 1.0)]);
    assert_eq!(rig.word(1, 2000), 0x8008);
    rig.run(PATIENCE / 6);
    assert_eq!(rig.state(1), State::Ready, "it starts nothing");

    set(&mut rig, &[("run", 1.0), ("speed_reference", 50.0)]);
    rig.until_state(1, State::Running);
    set(&mut rig, &[("control_bit_3", 0.0)]);
    assert_eq!(rig.word(1, 2000), 0x8001, "it stops nothing");
    // The motor was stopped elsewhere meanwhile; the next bit does not start it again.
    rig.at_the_drive(1, 2000, 0x8000);
    set(&mut rig, &[("control_bit_4", 1.0)]);
    assert_eq!(rig.word(1, 2000), 0x8010);
    rig.until_state(1, State::Ready);

    set(&mut rig, &[("run", 1.0)]);
    rig.until_state(1, State::Running);
    set(&mut rig, &[("run", 0.0)]);
    assert_eq!(rig.word(1, 2000), 0x8010, "a stop leaves them as they are");
    rig.until_state(1, State::Ready);
}
