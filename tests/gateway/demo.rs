//! `drivegate demo`, as the README promises it.

use std::process::Command;

use crate::support::process::{
    Running, api, get, mbpoll_read, point, read_registers, until, until_ready, write_registers,
};
use crate::support::tools::tool;

/// The number behind `mark` in what the demo printed.
fn port(printed: &str, mark: &str) -> u16 {
    let rest = printed
        .split_once(mark)
        .unwrap_or_else(|| panic!("no `{mark}` in\n{printed}"))
        .1;
    rest.chars()
        .take_while(char::is_ascii_digit)
        .collect::<String>()
        .parse()
        .unwrap()
}

#[test]
fn everything_it_prints_works_and_ctrl_c_ends_it() {
    let mut demo = Running::drivegate(&["demo"]);
    let printed = demo.until_printed("Ctrl-C ends the demo.");
    let (http, mqtt, modbus) = (
        port(&printed, "http://127.0.0.1:"),
        port(&printed, "-h 127.0.0.1 -p "),
        port(&printed, "tcp -p "),
    );
    until_ready(http);
    let drives: Vec<serde_json::Value> = serde_json::from_str(&get(http, "/api/v1/drives").unwrap().1).unwrap();
    assert_eq!(drives.len(), 10);
    // By themselves the drives move.
    until("a drive that runs by itself", || {
        ["pump-1", "pump-2", "fan-1"]
            .into_iter()
            .find(|drive| api(http, drive)["state"] == "running")
    });

    let metrics = get(http, "/metrics").unwrap().1;
    assert!(
        metrics.contains("drivegate_drive_output_frequency_hertz{bus=\"line1\",drive=\"pump-1\"}"),
        "{metrics}"
    );
    let payload = "{\"run\": true, \"speed_reference\": 50}";
    let sent = Command::new(tool("mosquitto_pub"))
        .args(["-h", "127.0.0.1", "-p", &mqtt.to_string(), "-q", "1"])
        .args(["-t", "drivegate/demo/drive/pump-1/set", "-m", payload])
        .status();
    assert!(sent.unwrap().success());
    until("pump-1 at its reference", || {
        (point(http, "pump-1", "output_frequency") == 25.0).then_some(())
    });

    // The same words for a TECO on Modbus ASCII and for a Vacon NX on N2: 50 %, run, read, stop.
    for (unit, name, half) in [(7, "conveyor-1", 3000), (8, "ahu-1", 2500)] {
        write_registers(modbus, unit, 33_025, &[5000]);
        write_registers(modbus, unit, 33_024, &[1]);
        until(&format!("{name} at half speed"), || {
            let registers = mbpoll_read(modbus, unit, 32_768, 19).ok()?;
            (registers.get(1) == Some(&3) && registers.get(5) == Some(&half)).then_some(())
        });
        write_registers(modbus, unit, 33_024, &[0]);
    }

    assert_eq!(read_registers(modbus, 1, 32_768, 19).get(5), Some(&2500));
    write_registers(modbus, 1, 33_024, &[0]);
    until("pump-1 stopped", || {
        (api(http, "pump-1")["state"] == "ready").then_some(())
    });

    demo.signal("INT");
    let status = demo.ended();
    assert!(status.success(), "{status}");
}

#[test]
fn a_second_demo_takes_other_ports() {
    let first = Running::drivegate(&["demo"]);
    let taken = first.until_printed("Ctrl-C ends the demo.");
    let second = Running::drivegate(&["demo"]);
    let printed = second.until_printed("Ctrl-C ends the demo.");
    for (mark, what) in [
        ("http://127.0.0.1:", "HTTP"),
        ("-h 127.0.0.1 -p ", "MQTT broker"),
        ("tcp -p ", "Modbus TCP"),
    ] {
        assert_ne!(port(&printed, mark), port(&taken, mark), "{what}");
    }
    assert!(printed.contains(" is in use; "), "it says so:\n{printed}");
    until_ready(port(&printed, "http://127.0.0.1:"));
}
