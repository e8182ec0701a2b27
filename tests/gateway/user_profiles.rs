//! The energy meter of docs/profiles.md, made by pymodbus, read with the profile of that page.

use std::path::Path;

use crate::support::process::{Running, api, free_port, get, mbpoll_write, read_registers, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site};
use crate::support::tools::{python, root, run, run_well};

/// A profile based on the example, with a float that may be NaN.
const OURS: &str = r#"
name = "our-meter"
base = "energy-meter"
points.current_l1.scale = 10
[[point]]
name = "neutral_current"
at = "input 18"
type = "f32"
unit = "A"
class = "fast"
[[range]]
table = "input"
first = 20
last = 32
read = 13
[[point]]
name = "serial_number"
at = "input 20"
type = "string:4"
class = "once"
[[point]]
name = "impulses"
at = "input 24"
type = "u64"
order = "CDAB"
class = "fast"
[[point]]
name = "decimals"
at = "input 28"
type = "bcd16"
class = "fast"
[[point]]
name = "motor_current"
at = "input 29"
type = "i16"
invalid = [0x7FFF]
class = "fast"
[[point]]
name = "apparent_power"
at = "input 30"
scale_from = "power_of_ten"
unit = "kVA"
class = "fast"
[[point]]
name = "power_of_ten"
at = "input 31"
type = "i16"
hidden = true
class = "fast"
[[point]]
name = "season"
at = "input 32"
mask = 0x00F0
class = "fast"
[point.texts]
10 = "winter"
[[point]]
name = "is_quiet"
at = "input 32"
mask = 0x000F
equals = 5
class = "fast"
[[point]]
name = "display"
at = "holding 257"
write = true
class = "slow"
[point.texts]
3 = "short"
15 = "all of it"
"#;

#[test]
fn the_energy_meter_of_the_page_is_served() {
    let port = free_port();
    let meter = "cycle = \"50ms\"\nslow_cycle = \"200ms\"\n\
         [[bus.drive]]\nname = \"meter\"\naddress = 7\nprofile = \"our-meter\"\naccess = \"control\"\n\
         limits = { current_transformer_ratio = [1, 500] }\n";
    // The socket is where the commands below look for it: a command that finds no gateway would become a second master.
    let bus = LINE1
        .replace("port = \"line1\"", &format!("port = \"tcp://127.0.0.1:{port}\""))
        .replace("name = \"test\"", "name = \"test\"\nsocket = \"own.sock\"");
    let site = Site::of(&[&bus, meter, MODBUS_TCP, HTTP]);
    let (modbus, http) = (site.modbus, site.http);
    std::fs::copy(root().join("docs/energy-meter.toml"), site.file("energy-meter.toml")).unwrap();
    site.write("a.toml", OURS);
    let peer = root().join("tests/peers/energy_meter.py");
    let _peer = Running::start(&python(), &[&peer.display().to_string(), &port.to_string()]);
    run_well(
        Path::new(env!("CARGO_BIN_EXE_drivegate")),
        &["check", "--config", &site.config()],
    );
    let _gateway = site.run_ready();
    for (name, value) in [
        ("voltage_l1", serde_json::json!(230.5)),
        ("current_l1", serde_json::json!(52.0)),
        ("active_power", serde_json::json!(-2.0)),
        ("energy", serde_json::json!(1234.56)),
        ("reactive_balance", serde_json::json!(-2.0)),
        ("power_factor", serde_json::json!(-0.9)),
        ("line_frequency", serde_json::json!(49.98)),
        ("case_temperature", serde_json::json!(31.0)),
        ("warning", serde_json::json!(true)),
        ("phase_order_wrong", serde_json::json!(true)),
        ("tariff", serde_json::json!(5)),
        ("mode", serde_json::json!(2)),
        ("no_load", serde_json::json!(false)),
        ("current_transformer_ratio", serde_json::json!(40.0)),
        ("relay", serde_json::json!(true)),
        ("serial_number", serde_json::json!("SN-42")),
        ("impulses", serde_json::json!(9_007_199_254_740_993_u64)),
        ("decimals", serde_json::json!(1234.0)),
        ("apparent_power", serde_json::json!(12.34)),
        ("season", serde_json::json!(10)),
        ("is_quiet", serde_json::json!(true)),
        ("display", serde_json::json!(15)),
    ] {
        let read = || Some(site.point("meter", name)).filter(|v| !v.is_null());
        assert_eq!(until(name, read), value, "{name}");
    }
    let points = api(http, "meter")["points"].clone();
    assert_eq!(points["tariff"]["text"], "weekend");
    assert_eq!(points["mode"]["text"], "3 phases, 3 wires");
    assert_eq!(points["power_factor"].get("text"), None);
    // NaN is never served as a value.
    assert_eq!(
        (
            &points["neutral_current"]["value"],
            &points["neutral_current"]["quality"]
        ),
        (&().into(), &"bad".into())
    );
    let (_, metrics) = get(http, "/metrics").unwrap();
    let labels = "bus=\"line1\",drive=\"meter\"";
    for line in [
        format!("drivegate_drive_energy_kilowatthours{{{labels}}} 1234.56"),
        format!("drivegate_point_value{{{labels},point=\"tariff\",unit=\"\"}} 5"),
        format!("drivegate_point_value{{{labels},point=\"active_power\",unit=\"kW\"}} -2"),
    ] {
        assert!(metrics.contains(&line), "{line} is missing in\n{metrics}");
    }
    assert!(!metrics.contains("neutral_current"), "{metrics}");
    // An unavailable value is bad in every interface. A helper point is shown in none. A value that a metric would
    // round is not exported as a metric.
    assert_eq!(
        (&points["motor_current"]["value"], &points["motor_current"]["quality"]),
        (&().into(), &"bad".into())
    );
    assert_eq!(read_registers(modbus, 7, 0x8007, 1), [0x8000]);
    for absent in [
        "motor_current_amperes{bus=",
        "power_of_ten",
        "impulses",
        "serial_number",
    ] {
        assert!(!metrics.contains(absent), "{absent} is in\n{metrics}");
    }
    assert!(metrics.contains("point=\"decimals\",unit=\"\"} 1234"), "{metrics}");
    assert_eq!(points.get("power_of_ten"), None);
    assert_eq!(points["season"]["text"], "winter");
    // An enumeration can be set by its text, and refuses any text that is not listed.
    let program = Path::new(env!("CARGO_BIN_EXE_drivegate"));
    let config = site.config();
    let write = |set: &str| run(program, &["write", "--config", &config, "meter", set]);
    let written = |set: &str| {
        let said = write(set);
        let why = String::from_utf8_lossy(&said.stderr).into_owned();
        assert!(said.status.success(), "{set}: {why}");
    };
    written("display=short");
    site.until_point("meter", "display", 3);
    written("display=all of it");
    site.until_point("meter", "display", 15);
    assert!(!write("display=7").status.success() && !write("display=long").status.success());
    let refused = mbpoll_write(modbus, 7, 257, &[7]).unwrap_err();
    assert!(refused.contains("Illegal data value"), "{refused}");
    let shown = run(program, &["read", "--config", &config, "meter"]);
    let shown = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(
        shown.contains("9007199254740993") && shown.contains("SN-42") && !shown.contains("power_of_ten"),
        "{shown}"
    );
    // The common model and the meter's own registers over Modbus TCP; 32 bits with the high word first.
    assert_eq!(read_registers(modbus, 7, 0x800D, 2), [0, 1235]);
    assert_eq!(read_registers(modbus, 7, 256, 2), [40, 15]);
    write_registers(modbus, 7, 256, &[100]);
    site.until_point("meter", "current_transformer_ratio", 100.0);
    let refused = mbpoll_write(modbus, 7, 256, &[501]).unwrap_err();
    assert!(refused.contains("Illegal data value"), "{refused}");
}
