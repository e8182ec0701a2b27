//! Start, reference, fault and reset through `run` and `simulate` in processes of their own: by mbpoll, by Mosquitto.

use std::process::Command;

use crate::process::{Running, api, free_port, get, mbpoll_read, mbpoll_write, point, until, until_ready};
use crate::tools::{run_well, tool};

/// Simulated drives, a broker, a gateway.
struct Plant {
    _simulator: Running,
    _broker: Running,
    gateway: Running,
    modbus: u16,
    mqtt: u16,
    http: u16,
    folder: tempfile::TempDir,
}

/// PDU address of ID 1999: a write trips the simulated drive with that fault code.
const TRIP: u16 = 1998;

impl Plant {
    fn start() -> Plant {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("line1").display().to_string();
        let simulator = Running::drivegate(&["simulate", "--addresses", "1-2", "--link", &link, "--baud", "38400"]);
        simulator.until_printed("Ctrl-C ends");
        let (modbus, mqtt, http) = (free_port(), free_port(), free_port());
        let broker_file = folder.path().join("mosquitto.conf");
        std::fs::write(
            &broker_file,
            format!("listener {mqtt} 127.0.0.1\nallow_anonymous true\n"),
        )
        .unwrap();
        let broker = Running::start(&tool("mosquitto"), &["-c", &broker_file.display().to_string()]);
        let file = folder.path().join("drivegate.toml");
        std::fs::write(&file, Plant::configuration(&link, modbus, mqtt, http)).unwrap();
        let gateway = Running::drivegate(&["run", "--config", &file.display().to_string()]);
        until_ready(http);
        until("MQTT connected", || {
            get(http, "/metrics")?
                .1
                .contains("drivegate_mqtt_connected 1")
                .then_some(())
        });
        Plant {
            _simulator: simulator,
            _broker: broker,
            gateway,
            modbus,
            mqtt,
            http,
            folder,
        }
    }

    fn configuration(link: &str, modbus: u16, mqtt: u16, http: u16) -> String {
        format!(
            "[gateway]\nname = \"test\"\n\
             [[bus]]\nname = \"line1\"\nport = \"{link}\"\nbaud = 38400\nsilence = \"chars\"\n\
             [[bus.drive]]\nname = \"pump-1\"\naddress = 1\nprofile = \"vacon-nx\"\naccess = \"control\"\n\
             limits = {{ speed_reference = [0.0, 80.0] }}\n\
             [[bus.drive]]\nname = \"pump-2\"\naddress = 2\nprofile = \"vacon-nx\"\n\
             [modbus_tcp]\nlisten = [\"127.0.0.1:{modbus}\"]\nwrite = [\"127.0.0.1/32\"]\n\
             [mqtt]\nurl = \"mqtt://127.0.0.1:{mqtt}\"\ncommands = true\n\
             [http]\nlisten = \"127.0.0.1:{http}\"\n"
        )
    }

    fn publish(&self, arguments: &[&str]) {
        let mut all = vec!["-h", "127.0.0.1", "-q", "1", "-p"];
        let port = self.mqtt.to_string();
        all.push(&port);
        all.extend(arguments);
        run_well(&tool("mosquitto_pub"), &all);
    }

    /// Asks by a v5 request and returns the response.
    fn ask(&self, drive: &str, payload: &str) -> serde_json::Value {
        let port = self.mqtt.to_string();
        let topic = format!("drivegate/test/drive/{drive}/set");
        let output = Command::new(tool("mosquitto_rr"))
            .args([
                "-h",
                "127.0.0.1",
                "-p",
                &port,
                "-V",
                "5",
                "-q",
                "1",
                "-W",
                "20",
                "-t",
                &topic,
            ])
            .args([
                "-e",
                "answers/here",
                "-D",
                "publish",
                "correlation-data",
                "7",
                "-m",
                payload,
            ])
            .output()
            .unwrap();
        serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {output:?}"))
    }

    fn until_state(&self, drive: &str, state: &str) {
        until(&format!("{drive} is {state}"), || {
            (api(self.http, drive)["state"] == state).then_some(())
        });
    }
}

#[test]
fn by_mbpoll() {
    let plant = Plant::start();
    let modbus = plant.modbus;
    plant.until_state("pump-1", "ready");
    mbpoll_write(modbus, 1, 33_025, &[5000]).unwrap();
    mbpoll_write(modbus, 1, 33_024, &[1]).unwrap();
    let common = until("25.00 Hz and at_reference", || {
        let words = mbpoll_read(modbus, 1, 32_768, 19).ok()?;
        (words[5] == 2500 && words[0] & (1 << 5) != 0).then_some(words)
    });
    assert_eq!(common[1], 3, "running");
    assert_eq!(common[4], 5000, "actual speed 50.00 %");
    assert_eq!(common[0] & 0xC000, 0x8000, "online, not stale");
    let raw = mbpoll_read(modbus, 1, 2100, 11).unwrap();
    assert_eq!((raw[2], raw[3]), (5000, 2500));
    let unknown = mbpoll_read(modbus, 1, 6000, 5).unwrap_err();
    assert!(unknown.contains("Illegal data address"), "{unknown}");

    mbpoll_write(modbus, 1, TRIP, &[9]).unwrap();
    plant.until_state("pump-1", "fault");
    assert_eq!(mbpoll_read(modbus, 1, 32_771, 1).unwrap(), [9]);
    mbpoll_write(modbus, 1, 33_024, &[4]).unwrap();
    plant.until_state("pump-1", "ready");
    assert_eq!(point(plant.http, "pump-1", "running"), false, "a reset starts nothing");

    let refused = mbpoll_write(modbus, 1, 33_025, &[8001]).unwrap_err();
    assert!(refused.contains("Illegal data value"), "{refused}");
    let monitored = mbpoll_write(modbus, 2, 33_024, &[1]).unwrap_err();
    assert!(monitored.contains("Illegal function"), "{monitored}");
    assert!(
        plant.gateway.output().contains("outside the limits 0 to 80"),
        "the refusal is audited"
    );
}

#[test]
fn by_mosquitto() {
    let plant = Plant::start();
    plant.until_state("pump-1", "ready");
    let started = plant.ask("pump-1", "{\"run\": true, \"speed_reference\": 50, \"id\": 1}");
    assert_eq!(started["ok"], true, "{started}");
    until("25.00 Hz", || {
        (point(plant.http, "pump-1", "output_frequency") == 25.0).then_some(())
    });
    mbpoll_write(plant.modbus, 1, TRIP, &[1]).unwrap();
    plant.until_state("pump-1", "fault");
    let reset = plant.ask("pump-1", "{\"fault_reset\": true}");
    assert_eq!(reset["ok"], true, "{reset}");
    plant.until_state("pump-1", "ready");
    for (drive, payload, code) in [
        ("pump-1", "{\"speed_reference\": 81}", "bad_value"),
        ("pump-1", "{\"speed_reference\": \"fast\"}", "bad_value"),
        ("pump-1", "{\"sped_reference\": 5}", "not_writable"),
        ("pump-2", "{\"run\": true}", "not_allowed"),
    ] {
        let refused = plant.ask(drive, payload);
        assert_eq!(
            (&refused["ok"], &refused["error"]["code"]),
            (&false.into(), &code.into()),
            "{payload}: {refused}"
        );
    }
    // A retained message is never a command, and a bare value is one.
    plant.publish(&["-r", "-t", "drivegate/test/drive/pump-1/set/run", "-m", "true"]);
    plant.publish(&["-t", "drivegate/test/drive/pump-1/set/speed_reference", "-m", "20"]);
    until("20 % read back", || {
        (point(plant.http, "pump-1", "speed_reference") == 20.0).then_some(())
    });
    assert_eq!(api(plant.http, "pump-1")["state"], "ready");
}

#[test]
fn metrics_please_promtool_and_a_bad_reload_changes_nothing() {
    let plant = Plant::start();
    let (_, metrics) = get(plant.http, "/metrics").unwrap();
    let file = plant.folder.path().join("metrics");
    std::fs::write(&file, &metrics).unwrap();
    let checked = Command::new(tool("promtool"))
        .args(["check", "metrics"])
        .stdin(std::fs::File::open(&file).unwrap())
        .output()
        .unwrap();
    assert!(checked.status.success(), "{checked:?}");

    let configuration = plant.folder.path().join("drivegate.toml");
    let good = std::fs::read_to_string(&configuration).unwrap();
    std::fs::write(&configuration, good.replace("baud = 38400", "bawd = 38400")).unwrap();
    plant.gateway.signal("HUP");
    plant.gateway.until_printed("keeping the current configuration");
    assert!(
        plant.gateway.output().contains("did you mean `baud`?"),
        "and it says why"
    );
    std::fs::write(&configuration, good.replace("name = \"pump-2\"", "name = \"pump-two\"")).unwrap();
    plant.gateway.signal("HUP");
    plant.gateway.until_printed("configuration reloaded");
    until("the new name", || {
        get(plant.http, "/api/v1/drives/pump-two").filter(|(status, _)| *status == 200)
    });
    plant.until_state("pump-1", "ready");
}
