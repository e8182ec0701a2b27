//! The built-in profiles against the tables of the reference (reference/drives.md 13.1, 13.2, 3 to 6), written from those tables
//! and not from the profiles; and worked replies of the manuals, decoded.

use super::derive::{Bound, Derived};
use super::profile::{Form, Profiles};
use super::{ModelPoint, PollClass, Profile, Source, Step, Value};
use drivegate_proto::{Protocol, Table};

fn profile(name: &str) -> std::sync::Arc<Profile> {
    Profiles::built_in().get(name).unwrap().clone()
}

/// A point as text: `table address[.bit] x scale`, `!` for an inverted bit, `derive` for a derived point, `-` for no point.
fn place(profile: &Profile, name: &str) -> String {
    let Some(point) = profile.point_index(name).and_then(|i| profile.points.get(i)) else {
        return "-".to_string();
    };
    let raw = match &point.source {
        Source::Derived(derived) => return format!("derive {}", derived.name()),
        Source::Raw(raw) => raw,
    };
    let table = match raw.table {
        Table::Holding => "HR",
        Table::Input => "IR",
        Table::Coil => "CO",
        Table::DiscreteInput => "DI",
    };
    match raw.form {
        Form::Bit { invert, .. } if raw.table.is_bits() => {
            format!("{table} {}{}", raw.address, if invert { "!" } else { "" })
        }
        Form::Bit { bit, invert } => format!("{table} {}.{bit}{}", raw.address, if invert { "!" } else { "" }),
        _ if raw.scale == 1.0 => format!("{table} {}", raw.address),
        _ => format!("{table} {} x {}", raw.address, raw.scale),
    }
}

/// Table 13.1: Vacon NX, Eaton SVX and HVX, Vacon CX, TECO.
#[test]
fn modbus_families() {
    let rows = [
        ("ready", "HR 2100.0", "HR 2100.0", "DI 1", "HR 32.2"),
        ("running", "HR 2100.1", "HR 2100.1", "DI 2", "HR 32.0"),
        ("reversed", "HR 2100.2", "HR 2100.2", "DI 3", "HR 32.1"),
        ("fault", "HR 2100.3", "HR 2100.3", "DI 4", "HR 32.3"),
        ("warning", "HR 2100.4", "HR 2100.4", "-", "-"),
        ("at_reference", "HR 2100.5", "HR 2100.5", "derive equal", "HR 44.2"),
        ("zero_speed", "HR 2100.6", "derive zero", "derive zero", "HR 44.1"),
        ("remote", "HR 2101.13", "-", "DI 0", "derive all"),
        ("panel_control", "HR 2101.14", "-", "-", "-"),
        ("io_control", "HR 2101.15", "-", "-", "-"),
        ("actual_speed", "HR 2102 x 0.01", "HR 2102 x 0.01", "-", "-"),
        (
            "output_frequency",
            "HR 2103 x 0.01",
            "HR 2103 x 0.01",
            "IR 0 x 0.01",
            "HR 36 x 0.01",
        ),
        ("motor_speed", "HR 2104", "HR 2104", "IR 1", "-"),
        (
            "motor_current",
            "HR 2105 x 0.1",
            "HR 2105 x 0.1",
            "IR 2 x 0.1",
            "HR 39 x 0.1",
        ),
        ("motor_torque", "HR 2106 x 0.1", "HR 2106 x 0.1", "IR 3", "-"),
        ("motor_power", "HR 2107 x 0.1", "HR 2107 x 0.1", "IR 4", "-"),
        ("motor_voltage", "HR 2108 x 0.1", "HR 2108 x 0.1", "IR 5", "HR 40"),
        ("dc_link_voltage", "HR 2109", "HR 2109", "IR 6", "HR 49"),
        ("heatsink_temperature", "HR 7", "HR 7", "IR 7", "-"),
        // 0.001 MWh is 1 kWh, 0.01 days are 0.24 h.
        ("energy", "-", "-", "IR 10", "-"),
        ("trip_energy", "-", "-", "IR 11", "-"),
        ("operating_hours", "-", "-", "IR 8 x 0.24", "-"),
        ("trip_hours", "-", "-", "IR 9 x 0.01", "-"),
        ("fault_code", "HR 2110", "HR 2110", "IR 100", "derive lowest_bit"),
        ("fault_code_id99", "HR 98", "HR 98", "-", "-"),
        // Documents of relatives [X7]: compared with process data.
        ("output_frequency_id1", "HR 0 x 0.01", "HR 0 x 0.01", "-", "-"),
        ("motor_speed_id2", "HR 1", "HR 1", "-", "-"),
        ("motor_torque_id4", "HR 3 x 0.1", "HR 3 x 0.1", "-", "-"),
        ("motor_power_id5", "HR 4 x 0.1", "HR 4 x 0.1", "-", "-"),
        ("motor_voltage_id6", "HR 5 x 0.1", "HR 5 x 0.1", "-", "-"),
        ("dc_link_voltage_id7", "HR 6", "HR 6", "-", "-"),
        ("motor_current_id45", "HR 44 x 0.1", "HR 44 x 0.1", "-", "-"),
        ("fault_mask", "-", "-", "-", "HR 33"),
        (
            "speed_reference",
            "HR 2002 x 0.01",
            "HR 2002 x 0.01",
            "derive percent",
            "derive percent",
        ),
        (
            "frequency_reference",
            "derive band",
            "derive band",
            "HR 0 x 0.01",
            "HR 35 x 0.01",
        ),
        ("frequency_command", "-", "-", "-", "HR 2 x 0.01"),
        ("run", "HR 2000.0", "HR 2000.0", "CO 0", "HR 1.0"),
        ("reverse", "HR 2000.1", "HR 2000.1", "CO 1", "HR 1.1"),
        ("fault_reset", "HR 2000.2", "HR 2000.2", "CO 2", "HR 1.3"),
        ("external_fault", "-", "-", "-", "HR 1.2"),
        ("run_from_bus", "-", "-", "-", "HR 44.10!"),
        ("reference_from_bus", "-", "-", "-", "HR 44.9!"),
        (
            "maximum_frequency",
            "HR 101 x 0.01",
            "HR 101 x 0.01",
            "HR 101",
            "HR 513 x 0.1",
        ),
    ];
    for (point, nx, eaton, cx, teco) in rows {
        // The default selection of process data out 8 of HVX is in another manual [E table 5-3].
        let hvx = match point {
            "fault_code" => "HR 98",
            "fault_code_id99" => "-",
            _ => eaton,
        };
        for (name, wanted) in [
            ("vacon-nx", nx),
            ("eaton-svx", eaton),
            ("eaton-hvx", hvx),
            ("vacon-cx", cx),
            ("teco-7300pa", teco),
        ] {
            assert_eq!(place(&profile(name), point), wanted, "{point} of {name}");
        }
    }
    let hvx = profile("eaton-hvx");
    for (point, wanted) in [
        ("bypass_active", "HR 2100.6"),
        ("fire_mode_active", "HR 2100.7"),
        ("interlocked", "HR 2100.8!"),
        ("bypass", "HR 2000.3"),
        ("fieldbus_input_3", "HR 2000.4"),
        ("fieldbus_input_6", "HR 2000.7"),
        ("pass_through_relay_1", "HR 2000.10"),
        ("pass_through_relay_2", "HR 2000.11"),
        ("pass_through_output_1", "HR 2000.12"),
        ("fire_mode", "HR 2000.13"),
        ("pm_setback", "HR 2000.14"),
        ("pid_setpoint", "HR 2003 x 0.01"),
    ] {
        assert_eq!(place(&hvx, point), wanted, "{point}");
        assert_eq!(place(&profile("eaton-svx"), point), "-", "{point} is none of SVX");
    }
    // BO 4 to 16 and BI 8 to 15 as in the N2 map.
    let (nx, n2) = (profile("vacon-nx"), profile("vacon-nx-n2"));
    for bit in 3..16 {
        let name = format!("control_bit_{bit}");
        assert_eq!(place(&nx, &name), format!("HR 2000.{bit}"));
        assert_eq!(place(&n2, &name), format!("CO {bit}"));
    }
    for bit in 0..8 {
        let name = format!("general_{bit}");
        assert_eq!(place(&nx, &name), format!("HR 2101.{bit}"));
        assert_eq!(place(&n2, &name), format!("DI {}", bit + 7));
    }
}

/// The place of an N2 object, as the map of the contract defines it.
fn object(name: &str) -> String {
    let (kind, number) = name.split_once(' ').unwrap_or(("-", "0"));
    let (number, scale) = number
        .split_once(" x ")
        .map_or((number, String::new()), |(n, s)| (n, format!(" x {s}")));
    let number: u16 = number.parse().unwrap();
    match kind {
        "AI" => format!("IR {}{scale}", 2 * (number - 1)),
        "AO" => format!("HR {}{scale}", 2 * (number - 1)),
        "BI" => format!("DI {}", number - 1),
        "BO" => format!("CO {}", number - 1),
        "ADI" => format!("IR {}", 0x4000 + number - 1),
        _ => "-".to_string(),
    }
}

/// Table 13.2 and the maps 6.6, 6.7: Vacon NX, Eaton HVX, TECO.
#[test]
fn n2_families() {
    let rows = [
        ("ready", "BI 1", "BI 1", "BI 3"),
        ("running", "BI 2", "BI 2", "BI 1"),
        ("reversed", "BI 3", "BI 3", "BI 2"),
        ("fault", "BI 4", "BI 4", "BI 4"),
        ("warning", "BI 5", "BI 5", "-"),
        ("at_reference", "BI 6", "BI 6", "BI 6"),
        ("zero_speed", "BI 7", "derive zero", "BI 5"),
        ("remote", "-", "-", "-"),
        ("hand_auto", "-", "BI 11", "-"),
        ("hoa_on", "-", "BI 12", "-"),
        ("interlocked", "-", "BI 8", "-"),
        ("bypass_active", "-", "BI 9", "-"),
        ("fire_mode_active", "-", "BI 10", "-"),
        ("output_frequency", "AI 2", "AI 2", "AI 2"),
        ("motor_speed", "AI 3", "AI 3", "-"),
        ("motor_current", "AI 6", "AI 6", "AI 3"),
        ("motor_torque", "AI 10", "AI 10", "-"),
        ("motor_power", "AI 4", "AI 4", "-"),
        ("motor_voltage", "AI 8", "AI 8", "AI 4"),
        ("dc_link_voltage", "AI 7", "AI 7", "AI 7"),
        ("heatsink_temperature", "AI 9", "AI 9", "-"),
        ("energy", "AI 5 x 1000", "AI 5 x 1000", "-"),
        ("trip_energy", "AI 13", "AI 13", "-"),
        ("operating_hours", "-", "AI 11 x 24", "-"),
        ("trip_hours", "AI 12", "-", "-"),
        ("motor_temperature", "AI 15", "AI 15", "-"),
        ("torque_reference", "AI 14", "AI 14", "-"),
        ("process_data_out_1", "AI 16", "AI 16", "-"),
        ("process_data_out_8", "AI 23", "AI 23", "-"),
        ("fault_code", "ADI 1", "ADI 1", "derive lowest_bit"),
        ("fault_mask", "-", "-", "AI 8"),
        ("frequency_reference", "AI 1", "AI 1", "AI 1"),
        ("speed_reference", "AO 1", "AO 1", "derive percent"),
        ("frequency_command", "derive band", "derive band", "AO 1"),
        ("current_limit", "AO 2", "AO 2", "-"),
        ("minimum_frequency", "AO 3", "AO 3", "-"),
        ("maximum_frequency", "AO 4", "AO 4", "-"),
        ("acceleration_time", "AO 5", "AO 5", "AO 5"),
        ("deceleration_time", "AO 6", "AO 6", "AO 6"),
        ("pid_setpoint", "-", "AO 7", "-"),
        ("sensor_feedback", "-", "AO 8", "-"),
        ("process_data_in_4", "AO 10 x 100", "-", "-"),
        ("jog_frequency", "-", "-", "AO 4"),
        ("pid_detection_gain", "-", "-", "AO 9"),
        ("frequency_upper_bound", "-", "-", "AO 13"),
        ("frequency_lower_bound", "-", "-", "AO 14"),
        ("jump_frequency_width", "-", "-", "AO 18"),
        ("stall_level_running", "-", "-", "AO 20"),
        ("auto_restarts", "-", "-", "AO 21"),
        ("terminal_aux_function", "-", "-", "AO 22"),
        ("run", "BO 1", "BO 1", "BO 1"),
        ("reverse", "BO 2", "BO 2", "BO 2"),
        ("fault_reset", "BO 3", "BO 3", "BO 4"),
        ("external_fault", "-", "-", "BO 3"),
        ("bypass", "-", "BO 4", "-"),
        ("fieldbus_input_6", "-", "BO 8", "-"),
        ("pass_through_relay_1", "-", "BO 11", "-"),
        ("fire_mode", "-", "BO 14", "-"),
        ("pm_setback", "-", "BO 15", "-"),
        ("control_bit_15", "BO 16", "-", "-"),
        ("multifunction_4", "-", "-", "BO 8"),
        ("output_r2a_command", "-", "-", "BO 11"),
        ("energy_saving", "-", "-", "BO 12"),
        ("terminal_1", "-", "-", "BI 14"),
        ("output_r2a_state", "-", "-", "BI 24"),
        ("reference_missing", "-", "-", "BI 13"),
        ("main_speed_input", "-", "-", "AI 5"),
        ("software_version", "-", "-", "AI 10"),
    ];
    for (point, nx, hvx, teco) in rows {
        for (name, wanted) in [("vacon-nx-n2", nx), ("eaton-hvx-n2", hvx), ("teco-7300pa-n2", teco)] {
            let wanted = if wanted.starts_with("derive") {
                wanted.to_string()
            } else {
                object(wanted)
            };
            assert_eq!(place(&profile(name), point), wanted, "{point} of {name}");
        }
    }
}

/// Each map has the number of objects of each kind that 6.6 and 6.7 require, and no object twice.
#[test]
fn n2_maps_are_whole() {
    for (name, ai, bi, ao, bo) in [
        ("vacon-nx-n2", 23, 15, 10, 16),
        ("eaton-hvx-n2", 23, 11, 8, 13),
        ("teco-7300pa-n2", 10, 24, 22, 12),
    ] {
        let profile = profile(name);
        let count = |table, integers: bool| {
            let raw = profile.points.iter().filter_map(|p| p.raw());
            let mut found: Vec<u16> = raw
                .filter(|r| r.table == table && (r.address >= 0x4000) == integers)
                .map(|r| r.address)
                .collect();
            found.sort_unstable();
            let all = found.len();
            found.dedup();
            assert_eq!(found.len(), all, "{name}: an object has two points");
            all
        };
        assert_eq!(
            (
                count(Table::Input, false),
                count(Table::DiscreteInput, false),
                count(Table::Holding, false),
                count(Table::Coil, false)
            ),
            (ai, bi, ao, bo),
            "{name}"
        );
    }
}

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

/// Limits, table 9.26; line facts, section 2; the text of `show` about writes, 5.5.
#[test]
fn limits_and_lines() {
    let limit = |name: &str, table, address| {
        let profile = profile(name);
        profile.range(table, address).map(|r| (r.read, r.write))
    };
    let holding = Table::Holding;
    for (name, address, wanted) in [
        ("vacon-nx", 0, Some((30, 0))),
        ("vacon-nx", 97, Some((30, 0))),
        ("vacon-nx", 98, Some((30, 0))),
        ("vacon-nx", 99, None),
        ("vacon-nx", 1998, Some((30, 1))),
        ("vacon-nx", 1999, None),
        ("vacon-nx", 2010, Some((20, 20))),
        ("vacon-nx", 2011, None),
        ("vacon-nx", 2110, Some((20, 0))),
        ("eaton-svx", 0, Some((1, 0))),
        ("eaton-hvx", 98, Some((1, 0))),
        ("eaton-svx", 100, Some((1, 1))),
        ("eaton-hvx", 2000, Some((20, 20))),
        ("eaton-svx", 2100, Some((20, 0))),
        ("vacon-cx", 0, Some((1, 1))),
        ("vacon-cx", 99, None),
        ("vacon-cx", 9900, Some((1, 1))),
        ("vacon-cx", 9999, None),
        ("teco-7300pa", 0, None),
        ("teco-7300pa", 1, Some((16, 16))),
        ("teco-7300pa", 0x20, Some((16, 0))),
        ("teco-7300pa", 0x3E, None),
        ("teco-7300pa", 0x100, None),
        ("teco-7300pa", 0x126, Some((16, 16))),
        ("teco-7300pa", 0x519, Some((16, 16))),
        ("teco-7300pa", 0x51A, None),
    ] {
        assert_eq!(limit(name, holding, address), wanted, "{name} {address:#06x}");
    }
    for (name, protocol, addresses, turnaround) in [
        ("vacon-nx", Protocol::ModbusRtu, 1..=247, 2),
        ("eaton-svx", Protocol::ModbusRtu, 1..=247, 2),
        ("vacon-cx", Protocol::ModbusRtu, 1..=247, 2),
        ("teco-7300pa", Protocol::ModbusAscii, 1..=31, 15),
        ("teco-7300pa-n2", Protocol::N2, 1..=255, 15),
        ("vacon-nx-n2", Protocol::N2, 1..=247, 5),
    ] {
        let profile = profile(name);
        assert_eq!(
            (&profile.protocols[..], &profile.addresses),
            (&[protocol][..], &addresses),
            "{name}"
        );
        assert_eq!(profile.turnaround.as_millis(), turnaround, "{name}");
    }
    let teco = profile("teco-7300pa");
    let when = |address| teco.range(holding, address).unwrap().write_when.clone();
    for address in [0x0001, 0x0400, 0x0500] {
        assert_eq!(when(address), "always", "control data, An, Bn");
    }
    for address in [0x0101, 0x0200, 0x0300] {
        assert!(
            when(address).starts_with("only while the drive is in PRGM mode"),
            "Sn, Cn, On"
        );
    }
    // Sn-n = 0100H + n, the other groups begin at xx00H (5.8).
    for (point, address) in [
        ("operation_mode_selection_5", 0x0108),
        ("communication_fault_time", 0x021E),
        ("hunting_prevention_gain", 0x0306),
        ("frequency_command_1", 0x0400),
        ("jog_frequency", 0x0408),
        ("acceleration_time", 0x0500),
        ("pump_on_off_detection_level", 0x0519),
        ("save_parameters", 0x0900),
    ] {
        let index = teco.point_index(point).unwrap();
        assert_eq!(
            teco.points.get(index).unwrap().raw().unwrap().address,
            address,
            "{point}"
        );
    }
}

/// Doubts about a profile appear in its title.
#[test]
fn titles_of_unverified_profiles() {
    for profile in Profiles::built_in().iter() {
        let doubt = profile.described().ends_with(" (not verified on hardware)");
        assert_eq!(doubt, !profile.verified, "{}", profile.name);
        assert!(profile.described().starts_with(&profile.title));
    }
}

/// Commands of every family whose manual is available; parameters and outputs of N2 are written on change only.
#[test]
fn commands_of_every_family() {
    for profile in Profiles::built_in().iter().filter(|profile| profile.verified) {
        let name = &profile.name;
        for point in [
            ModelPoint::Run,
            ModelPoint::Reverse,
            ModelPoint::FaultReset,
            ModelPoint::SpeedReference,
            ModelPoint::FrequencyReference,
        ] {
            let found = profile
                .model_point(point)
                .unwrap_or_else(|| panic!("{name}: {}", point.name()));
            assert!(found.write, "{name}: {}", point.name());
            assert_eq!(found.pulse, point == ModelPoint::FaultReset, "{name}: {}", point.name());
        }
        assert!(profile.control.is_some(), "{name}");
        if profile.protocols == [Protocol::N2] {
            let outputs = profile
                .points
                .iter()
                .filter(|p| p.raw().is_some_and(|r| r.table == Table::Holding));
            for point in outputs.filter(|p| p.write) {
                assert!(point.on_change, "{name}: {}", point.name);
            }
        }
        // The range of the reference: signed for Vacon NX on Modbus, of maximum frequency for Eaton (9.2).
        if let Source::Derived(Derived::Band { minimum, .. }) =
            &profile.model_point(ModelPoint::FrequencyReference).unwrap().source
        {
            assert_eq!(*minimum == Bound::Fixed(0.0), name.starts_with("eaton"), "{name}");
        }
    }
}

/// A round of the fast class on N2 takes about 35 ms per object: it must stay below a third of a second.
#[test]
fn process_data_is_few_requests() {
    for (name, most) in [
        ("vacon-nx", 1),
        ("eaton-svx", 1),
        ("eaton-hvx", 1),
        ("teco-7300pa", 1),
        ("vacon-cx", 4),
        ("vacon-nx-n2", 7),
        ("eaton-hvx-n2", 7),
        ("teco-7300pa-n2", 7),
    ] {
        let plan = super::Plan::of(&profile(name));
        let fast = plan.reads.iter().filter(|r| r.class == PollClass::Fast).count();
        assert_eq!(fast, most, "{name}");
    }
}

/// Meaning of process data in by application: [V] tables 28 and 29, [E] tables.
#[test]
fn process_data_in_by_application() {
    let multipurpose = [
        ("torque_reference", "HR 2003 x 0.1"),
        ("free_analog_input", "HR 2004 x 0.01"),
    ];
    let pid = [
        ("pid_setpoint", "HR 2003 x 0.01"),
        ("pid_actual_value_1", "HR 2004 x 0.01"),
        ("pid_actual_value_2", "HR 2005 x 0.01"),
    ];
    for (application, points) in [("multipurpose", &multipurpose[..]), ("pid", &pid), ("pump-fan", &pid)] {
        for family in ["vacon-nx", "eaton-svx"] {
            let (base, own) = (profile(family), profile(&format!("{family}-{application}")));
            assert_eq!((own.base.as_deref(), &own.simulator), (Some(family), &base.simulator));
            for (name, at) in points {
                let point = &own.points.get(own.point_index(name).unwrap()).unwrap();
                assert_eq!(place(&own, name), *at, "{name} of {}", own.name);
                assert!(point.write && point.raw().unwrap().form == Form::I16, "{name}");
            }
            let process_data = own
                .points
                .iter()
                .filter(|point| point.name.starts_with("process_data_in"));
            assert_eq!(process_data.count(), 0, "{}: the rest is not used", own.name);
            // All other points come from the family.
            assert_eq!(own.points.len(), base.points.len() - 8 + points.len());
            assert_eq!((&own.ranges, &own.faults), (&base.ranges, &base.faults));
            assert_eq!(own.commissioning, base.commissioning);
            assert!(own.identify.is_empty(), "no read tells the application");
        }
    }
    let hvx = profile("eaton-hvx");
    assert!(
        hvx.points
            .iter()
            .all(|point| !point.name.starts_with("process_data_in"))
    );
}

/// Points that no manual of the family states, or that manuals state differently.
#[test]
fn what_is_not_confirmed() {
    for (name, points) in [
        (
            "vacon-nx",
            &[
                "minimum_frequency",
                "maximum_frequency",
                "acceleration_time",
                "deceleration_time",
            ][..],
        ),
        (
            "eaton-svx",
            &["maximum_frequency", "output_frequency", "fieldbus_fault_response"],
        ),
        ("eaton-hvx", &["maximum_frequency", "output_frequency", "interlocked"]),
        (
            "vacon-cx",
            &["ready", "fault", "reversed", "remote", "reverse", "fault_reset"],
        ),
    ] {
        let profile = profile(name);
        for point in points {
            assert!(
                !profile
                    .points
                    .get(profile.point_index(point).unwrap())
                    .unwrap()
                    .verified,
                "{point} of {name}"
            );
        }
    }
    for (name, point) in [
        ("vacon-cx", "running"),
        ("vacon-cx", "run"),
        ("eaton-hvx", "bypass_active"),
    ] {
        let profile = profile(name);
        assert!(
            profile
                .points
                .get(profile.point_index(point).unwrap())
                .unwrap()
                .verified,
            "{point} of {name}"
        );
    }
    let width = profile("teco-7300pa-n2");
    let width = &width
        .points
        .get(width.point_index("jump_frequency_width").unwrap())
        .unwrap();
    assert_eq!(width.range, Some(0.0..=25.5));
    for (name, formats) in [
        ("vacon-cx", &["8N2", "8N1", "8E1", "8O1"][..]),
        ("teco-7300pa", &["7N2", "7E1", "7O1"]),
    ] {
        assert_eq!(profile(name).formats, formats);
        assert!(!profile(name).bauds.contains(&38_400), "{name}");
    }
}

/// Every family with an available manual has commissioning steps from it, and families with one board share one list.
#[test]
fn steps_at_the_cabinet() {
    for family in Profiles::built_in().iter().filter(|profile| profile.verified) {
        for step in Step::ALL {
            // No manual has a test of TECO.
            let is_blank = step == Step::Test && family.name.starts_with("teco");
            assert_eq!(
                family.commissioning.lines(step).is_empty(),
                is_blank,
                "{} {}",
                family.name,
                step.name()
            );
        }
    }
    let nx = profile("vacon-nx");
    for name in ["vacon-nx-n2", "eaton-svx", "eaton-hvx", "eaton-hvx-n2"] {
        let other = profile(name);
        for step in [Step::Connect, Step::Terminate, Step::Lamps] {
            assert_eq!(other.commissioning.lines(step), nx.commissioning.lines(step), "{name}");
        }
    }
    let lamps = nx.commissioning.lines(Step::Lamps);
    assert!(lamps[0].starts_with("green LED (FS) steady: the board is active and has seen no message yet"));
}
