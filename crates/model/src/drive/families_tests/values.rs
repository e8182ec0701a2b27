//! Worked replies and fault masks of the manuals, decoded.

use super::*;

/// Checks the values that example replies of a drive mean.
#[test]
fn worked_replies() {
    let read = |name: &str, point: &str, words: &[u16]| {
        let profile = profile(name);
        let point = &profile.points.get(profile.point_index(point).unwrap()).unwrap();
        point.raw().unwrap().decode(words, point.kind()).unwrap()
    };
    let number = Value::Number;
    // The reply of 7.4: running at reference under fieldbus control.
    for (point, word, value) in [
        ("ready", 0x0023, Value::Bool(true)),
        ("at_reference", 0x0023, Value::Bool(true)),
        ("reversed", 0x0023, Value::Bool(false)),
        ("remote", 0x2000, Value::Bool(true)),
        ("actual_speed", 0x1388, number(50.0)),
        ("output_frequency", 0x09C4, number(25.0)),
        ("motor_speed", 0x02EE, number(750.0)),
        ("motor_current", 0x000C, number(1.2)),
        ("motor_torque", 0x0069, number(10.5)),
        ("motor_power", 0x0035, number(5.3)),
        ("motor_voltage", 0x07D0, number(200.0)),
        ("dc_link_voltage", 0x0230, number(560.0)),
        ("fault_code", 0x0035, Value::Integer(53)),
        ("speed_reference", 0xEC78, number(-50.0)),
        ("torque_speed_limit_active", 0x0541, Value::Bool(false)),
        ("undervoltage_stop_active", 0x0541, Value::Bool(false)),
    ] {
        assert_eq!(read("vacon-nx", point, &[word]), value, "{point}");
    }
    // Healthy and idle, section 10.
    assert_eq!(read("eaton-hvx", "interlocked", &[0x0101]), Value::Bool(false));
    assert_eq!(read("eaton-hvx", "output_frequency", &[0x09C4]), number(25.0));
    assert_eq!(read("vacon-cx", "motor_current", &[156]), number(15.6));
    assert_eq!(read("vacon-cx", "fault_code", &[1]), Value::Integer(1));
    assert_eq!(read("vacon-cx", "frequency_reference", &[1000]), number(10.0));
    assert_eq!(read("vacon-cx", "maximum_frequency", &[50]), number(50.0));
    assert_eq!(read("teco-7300pa", "frequency_reference", &[0x1770]), number(60.0));
    assert_eq!(read("teco-7300pa", "frequency_command", &[0x1388]), number(50.0));
    assert_eq!(read("teco-7300pa", "maximum_frequency", &[0x0258]), number(60.0));
    assert_eq!(read("teco-7300pa", "acceleration_time", &[0x0064]), number(10.0));
    assert_eq!(read("teco-7300pa", "ready", &[0x0005]), Value::Bool(true));
    assert_eq!(read("teco-7300pa", "software_version", &[10]), number(1.0));
    assert_eq!(read("teco-7300pa", "main_speed_input", &[1023]), number(100.0));
    assert_eq!(read("teco-7300pa", "analog_output_1", &[255]), number(100.0));
    for name in ["vacon-nx-n2", "eaton-hvx-n2", "teco-7300pa-n2"] {
        assert_eq!(read(name, "output_frequency", &[0x41C8, 0x0000]), number(25.0));
    }
    assert_eq!(read("vacon-nx-n2", "fault_code", &[0x0035]), Value::Integer(53));
    // 50.0 MWh.
    assert_eq!(read("eaton-hvx-n2", "energy", &[0x4248, 0x0000]), number(50_000.0));
}

/// The fault mask of TECO, 13.3.
#[test]
fn teco_faults() {
    for name in ["teco-7300pa", "teco-7300pa-n2"] {
        let profile = profile(name);
        let Source::Derived(lowest) = &profile.model_point(ModelPoint::FaultCode).unwrap().source else {
            panic!("{name}");
        };
        for (bit, text) in [
            (0, "overcurrent or ground fault"),
            (1, "overvoltage"),
            (2, "inverter overload"),
            (3, "inverter overheat"),
            (7, "external fault"),
            (8, "control circuit fault"),
            (9, "motor overload"),
            (12, "undervoltage or power loss"),
        ] {
            // A higher bit that is also set does not count.
            let code = lowest.value([Value::Number(f64::from((1 << bit) | 0x1000))], None);
            let Some(Value::Integer(code)) = code else {
                panic!("{name} {bit}")
            };
            assert_eq!((code, profile.fault_text(code).as_str()), (bit + 1, text), "{name}");
            let fault = &profile.faults[&u16::try_from(code).unwrap()];
            assert!(
                !fault.panel.is_empty() && fault.remedy.ends_with("(general advice)"),
                "{name} {code}"
            );
        }
        assert_eq!(lowest.value([Value::Integer(0)], None), Some(Value::Integer(0)));
        assert_eq!(profile.faults[&8].panel, "EF3, EF5, EF6, EF7, EF8");
    }
}
