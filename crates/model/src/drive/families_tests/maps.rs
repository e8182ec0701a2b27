//! Registers and objects of each point, against the tables of the reference.

use super::*;

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
            assert!(own.identify.is_empty(), "no read shows the application");
        }
    }
    let hvx = profile("eaton-hvx");
    assert!(
        hvx.points
            .iter()
            .all(|point| !point.name.starts_with("process_data_in"))
    );
}
