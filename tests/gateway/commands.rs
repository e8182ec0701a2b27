//! The way of a command from outside: leases and clients that are killed, a stop under a full queue, a broker that is
//! away, repetitions, refusals, the audit.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use crate::process::{Running, api, free_port, get, mbpoll_write, point, until, until_ready};
use crate::tools::{run_well, tool};

const SET: &str = "drivegate/test/drive/pump-1/set";

pub(crate) struct Plant {
    _simulator: Running,
    gateway: Running,
    pub(crate) modbus: u16,
    mqtt: u16,
    pub(crate) http: u16,
    folder: tempfile::TempDir,
}

impl Plant {
    pub(crate) fn start(baud: u32) -> Plant {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("line1").display().to_string();
        let baud = baud.to_string();
        let simulator = Running::drivegate(&["simulate", "--addresses", "1-2", "--link", &link, "--baud", &baud]);
        simulator.until_printed("Ctrl-C ends");
        let (modbus, mqtt, http) = (free_port(), free_port(), free_port());
        let file = folder.path().join("drivegate.toml");
        let text = format!(
            "[gateway]\nname = \"test\"\n\
             [[bus]]\nname = \"line1\"\nport = \"{link}\"\nbaud = {baud}\nsilence = \"chars\"\n\
             [[bus.drive]]\nname = \"pump-1\"\naddress = 1\nprofile = \"vacon-nx\"\naccess = \"control\"\n\
             supervision = {{ timeout = \"3s\", action = \"stop\" }}\n\
             [[bus.drive]]\nname = \"pump-2\"\naddress = 2\nprofile = \"vacon-nx\"\naccess = \"control\"\n\
             [modbus_tcp]\nlisten = [\"127.0.0.1:{modbus}\"]\nwrite = [\"127.0.0.0/8\"]\n\
             [mqtt]\nurl = \"mqtt://127.0.0.1:{mqtt}\"\ncommands = true\n\
             [http]\nlisten = \"127.0.0.1:{http}\"\n"
        );
        std::fs::write(&file, text).unwrap();
        let gateway = Running::drivegate(&["run", "--config", &file.display().to_string()]);
        until_ready(http);
        Plant {
            _simulator: simulator,
            gateway,
            modbus,
            mqtt,
            http,
            folder,
        }
    }

    /// A broker; the gateway is connected to it when this returns.
    fn broker(&self) -> Running {
        let file = self.folder.path().join("mosquitto.conf");
        std::fs::write(
            &file,
            format!("listener {} 127.0.0.1\nallow_anonymous true\n", self.mqtt),
        )
        .unwrap();
        let broker = Running::start(&tool("mosquitto"), &["-c", &file.display().to_string()]);
        self.until_metric("drivegate_mqtt_connected 1");
        broker
    }

    fn until_metric(&self, line: &str) {
        until(line, || get(self.http, "/metrics")?.1.contains(line).then_some(()));
    }

    pub(crate) fn until_state(&self, drive: &str, state: &str) {
        until(&format!("{drive} is {state}"), || {
            (api(self.http, drive)["state"] == state).then_some(())
        });
    }

    pub(crate) fn audit(&self) -> Vec<serde_json::Value> {
        serde_json::from_str(&get(self.http, "/api/v1/audit").unwrap().1).unwrap()
    }

    fn publish(&self, arguments: &[&str]) {
        let port = self.mqtt.to_string();
        run_well(
            &tool("mosquitto_pub"),
            &[&["-h", "127.0.0.1", "-V", "5", "-q", "1", "-p", &port], arguments].concat(),
        );
    }
}

#[test]
fn a_client_that_is_killed_leaves_a_lease_that_runs_out() {
    let plant = Plant::start(38_400);
    // A program that holds its connection and renews the lease by the heartbeat until it is killed.
    let script = format!(
        "exec 3<>/dev/tcp/127.0.0.1/{}; while :; do printf '\\0\\1\\0\\0\\0\\6\\1\\6\\201\\3\\0\\1' >&3; sleep 0.5; done",
        plant.modbus
    );
    let mut client = Running::start(Path::new("/bin/bash"), &["-c", &script]);
    mbpoll_write(plant.modbus, 1, 33_024, &[1]).unwrap();
    plant.until_state("pump-1", "running");
    std::thread::sleep(std::time::Duration::from_secs(4));
    assert_eq!(api(plant.http, "pump-1")["state"], "running", "heartbeats hold it");
    client.signal("KILL");
    client.ended();
    plant.until_state("pump-1", "ready");
    plant.until_metric("drivegate_supervision_actions_total{bus=\"line1\",drive=\"pump-1\"} 1");
    let stop = until("the audit of the stop", || {
        plant.audit().into_iter().find(|r| r["source"] == "supervision")
    });
    assert_eq!(
        (&stop["drive"], &stop["command"]),
        (&"pump-1".into(), &"run=false".into())
    );
}

#[test]
fn a_stop_under_a_full_queue_comes_first() {
    // Slow enough that the flood waits.
    let plant = Plant::start(2_400);
    mbpoll_write(plant.modbus, 1, 33_024, &[1]).unwrap();
    plant.until_state("pump-1", "running");
    let mut flood = TcpStream::connect(("127.0.0.1", plant.modbus)).unwrap();
    let mut frames = Vec::new();
    for transaction in 0u16..100 {
        let [high, low] = transaction.to_be_bytes();
        // Reverse off by the raw control word of the other drive, again and again.
        frames.extend([high, low, 0, 0, 0, 6, 2, 6, 0x07, 0xD1, 0, low]);
    }
    flood.write_all(&frames).unwrap();
    // It is acknowledged before its time runs out; that it is the very next on the line is proved in `tests/world`.
    mbpoll_write(plant.modbus, 1, 33_024, &[0]).unwrap();
    plant.until_state("pump-1", "ready");
    // Each of the flood has its one answer: written, or refused because the queue was full or its time ran out.
    flood
        .set_read_timeout(Some(std::time::Duration::from_secs(10)))
        .unwrap();
    let mut seen = [0u8; 100];
    for _ in 0..100 {
        let mut head = [0u8; 8];
        flood.read_exact(&mut head).unwrap();
        let mut rest = vec![0u8; usize::from(head[5]) - 2];
        flood.read_exact(&mut rest).unwrap();
        seen[usize::from(head[1])] += 1;
        assert!(
            head[7] == 6 || (head[7] == 0x86 && [6, 0x0B].contains(&rest[0])),
            "{head:?} {rest:?}"
        );
    }
    assert_eq!(seen, [1u8; 100]);
}

#[test]
fn nothing_that_was_sent_while_the_broker_was_away_moves_a_drive() {
    let plant = Plant::start(2_400);
    let broker = plant.broker();
    plant.publish(&["-t", SET, "-m", "{\"id\": 1, \"speed_reference\": 10}"]);
    until("10 %", || {
        (point(plant.http, "pump-1", "speed_reference") == 10.0).then_some(())
    });
    drop(broker);
    plant.until_metric("drivegate_mqtt_connected 0");
    // A client whose library keeps the message until the broker is back; its life is over by then.
    let port = plant.mqtt.to_string();
    let late = Command::new(tool("mosquitto_pub"))
        .args([
            "-h",
            "127.0.0.1",
            "-p",
            &port,
            "-t",
            SET,
            "-m",
            "{\"run\": true, \"expires_ms\": 100}",
        ])
        .output()
        .unwrap();
    assert!(!late.status.success(), "there is no broker");
    let _broker = plant.broker();
    plant.publish(&["-t", SET, "-m", "{\"id\": 2, \"speed_reference\": 20}"]);
    until("20 %", || {
        (point(plant.http, "pump-1", "speed_reference") == 20.0).then_some(())
    });
    assert_eq!(point(plant.http, "pump-1", "run"), false);
    // One that is too old when its turn comes: a transaction takes longer than it lives.
    until("an expired command", || {
        plant.publish(&["-t", SET, "-m", "{\"speed_reference\": 30, \"expires_ms\": 1}"]);
        plant.audit().into_iter().find(|r| r["result"] == "expired")
    });
    assert!(
        plant
            .audit()
            .iter()
            .all(|r| !r["command"].as_str().unwrap().contains("run=true"))
    );
}

#[test]
fn confirmed_repeated_refused_and_audited() {
    let plant = Plant::start(38_400);
    let _broker = plant.broker();
    until("the control word", || {
        (point(plant.http, "pump-1", "run") == false).then_some(())
    });
    let start = "{\"id\": \"start-1\", \"run\": true, \"speed_reference\": 50}";
    for _ in 0..3 {
        plant.publish(&["-t", SET, "-m", start]);
    }
    plant.until_state("pump-1", "running");
    let record = until("the audit of the start", || {
        plant.audit().into_iter().find(|r| r["result"] == "confirmed")
    });
    assert!(
        record["confirmed_ms"].as_f64() > record["latency_ms"].as_f64(),
        "{record}"
    );
    assert_eq!(
        record["points"][0],
        serde_json::json!({"point": "run", "old": false, "new": true})
    );
    assert_eq!(record["client"], SET);
    until("the frequency range", || {
        point(plant.http, "pump-1", "frequency_reference")
            .is_number()
            .then_some(())
    });
    // A later command of the same client shows that the repetitions were seen and not carried out.
    for (payload, why) in [
        ("{\"speed_reference\": 50, \"frequency_reference\": 30}", "twice"),
        ("{\"speed_reference\": NaN}", "not JSON"),
        ("{\"speed_reference\": \"50\"}", "quotes"),
        ("{\"speed_reference\": 1000}", "outside the limits"),
    ] {
        plant.publish(&["-t", SET, "-m", payload]);
        until(why, || {
            let refused = plant
                .audit()
                .into_iter()
                .find(|r| r["text"].as_str().unwrap().contains(why))?;
            assert_eq!(refused["result"], "bad_value");
            Some(())
        });
    }
    let starts = plant.audit().iter().filter(|r| r["result"] == "confirmed").count();
    assert_eq!(starts, 1, "{:?}", plant.audit());
    // The same by Modbus TCP: both references in one write, bits that mean nothing.
    let both = mbpoll_write(plant.modbus, 1, 33_025, &[5000, 3000]).unwrap_err();
    assert!(both.contains("Illegal data value"), "{both}");
    let bits = mbpoll_write(plant.modbus, 1, 33_024, &[0x0100]).unwrap_err();
    assert!(bits.contains("Illegal data value"), "{bits}");
    let modbus: Vec<_> = plant
        .audit()
        .into_iter()
        .filter(|r| r["source"] == "modbus_tcp")
        .collect();
    assert_eq!(modbus.len(), 2);
    assert!(
        modbus
            .iter()
            .all(|r| r["client"].as_str().unwrap().starts_with("127.0.0.1:"))
    );
    assert!(
        plant.gateway.output().contains("confirmed_us"),
        "the journal has it too"
    );
}
