//! Start, reference, fault and reset through `run` and `simulate` in separate processes: by mbpoll and by Mosquitto.

use crate::support::process::{Running, api, get, mbpoll_read, mbpoll_write, read_registers, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, controlled, drive};
use crate::support::tools::{feed, tool};

/// A site with simulated drives, a broker and a gateway.
struct Plant {
    site: Site,
    gateway: Running,
    _others: [Running; 2],
}

/// PDU address of ID 1999: a write trips the simulated drive with that fault code.
const TRIP: u16 = 1998;

fn plant() -> Plant {
    let drives = controlled(
        "pump-1",
        1,
        "limits = { speed_reference = [0.0, 80.0] }\nraw_writes = [[1998, 1998]]",
    ) + &drive("pump-2", 2, "");
    let site = Site::of(&[LINE1, &drives, MODBUS_TCP, MQTT, HTTP]);
    let others = [site.simulate(&["--addresses", "1-2", "--baud", "38400"]), site.broker()];
    let gateway = site.run_ready();
    site.until_connected(true);
    Plant {
        site,
        gateway,
        _others: others,
    }
}

#[test]
fn by_mbpoll() {
    let Plant { site, gateway, .. } = &plant();
    let modbus = site.modbus;
    site.until_state("pump-1", "ready");
    write_registers(modbus, 1, 33_025, &[5000]);
    write_registers(modbus, 1, 33_024, &[1]);
    let common = until("25.00 Hz, at_reference, online and not stale", || {
        let words = mbpoll_read(modbus, 1, 32_768, 19).ok()?;
        (words[5] == 2500 && words[0] & 0xC020 == 0x8020).then_some(words)
    });
    assert_eq!(common[1], 3, "running");
    assert_eq!(common[4], 5000, "actual speed 50.00 %");
    let raw = read_registers(modbus, 1, 2100, 11);
    assert_eq!((raw[2], raw[3]), (5000, 2500));
    until("the drive's own refusal", || {
        mbpoll_read(modbus, 1, 6000, 5)
            .err()
            .filter(|why| why.contains("Illegal data address"))
    });

    write_registers(modbus, 1, TRIP, &[9]);
    site.until_state("pump-1", "fault");
    assert_eq!(read_registers(modbus, 1, 32_771, 1), [9]);
    write_registers(modbus, 1, 33_024, &[4]);
    site.until_state("pump-1", "ready");
    site.until_point("pump-1", "running", false);

    let refused = mbpoll_write(modbus, 1, 33_025, &[8001]).unwrap_err();
    assert!(refused.contains("Illegal data value"), "{refused}");
    let monitored = mbpoll_write(modbus, 2, 33_024, &[1]).unwrap_err();
    assert!(monitored.contains("Illegal function"), "{monitored}");
    // The refusal is audited.
    gateway.until_printed("outside the limits 0 to 80");
}

#[test]
fn by_mosquitto() {
    let Plant { site, .. } = &plant();
    site.until_state("pump-1", "ready");
    site.order("pump-1/set", "{\"run\": true, \"speed_reference\": 50, \"id\": 1}");
    site.until_point("pump-1", "output_frequency", 25.0);
    write_registers(site.modbus, 1, TRIP, &[1]);
    site.until_state("pump-1", "fault");
    site.order("pump-1/set", "{\"fault_reset\": true}");
    site.until_state("pump-1", "ready");
    for (drive, payload, code) in [
        ("pump-1", "{\"speed_reference\": 81}", "bad_value"),
        ("pump-1", "{\"speed_reference\": \"fast\"}", "bad_value"),
        ("pump-1", "{\"sped_reference\": 5}", "not_writable"),
        ("pump-2", "{\"run\": true}", "not_allowed"),
    ] {
        let refused = site.ask(&format!("{drive}/set"), payload);
        assert_eq!(
            (&refused["ok"], &refused["error"]["code"]),
            (&false.into(), &code.into()),
            "{payload}: {refused}"
        );
    }
    // A retained message is never a command, and a bare value is one.
    site.publish(&["-r", "-t", "drivegate/test/drive/pump-1/set/run", "-m", "true"]);
    site.publish(&["-t", "drivegate/test/drive/pump-1/set/speed_reference", "-m", "20"]);
    site.until_point("pump-1", "speed_reference", 20.0);
    assert_eq!(api(site.http, "pump-1")["state"], "ready");
}

#[test]
fn metrics_please_promtool_and_a_bad_reload_changes_nothing() {
    let Plant { site, gateway, .. } = &plant();
    let (_, metrics) = get(site.http, "/metrics").unwrap();
    let checked = feed(&tool("promtool"), &["check", "metrics"], &metrics);
    assert!(checked.status.success(), "{checked:?}");

    let good = site.change("baud = 38400", "bawd = 38400");
    gateway.signal("HUP");
    gateway.until_printed("keeping the current configuration");
    assert!(gateway.output().contains("did you mean `baud`?"), "and it says why");
    site.configure(&[&good]);
    site.change("name = \"pump-2\"", "name = \"pump-two\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    until("the new name", || {
        get(site.http, "/api/v1/drives/pump-two").filter(|(status, _)| *status == 200)
    });
    site.until_state("pump-1", "ready");
}
