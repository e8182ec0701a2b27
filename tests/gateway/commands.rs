//! Commands from outside, from the client to the drive: leases and clients that are killed, a stop while the queue
//! is full, a broker that is not available, repetitions, refusals, the audit.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;

use crate::support::process::{PATIENCE, Running, mbpoll_write, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, controlled};
use crate::support::tools::{run, tool};

const SET: &str = "drivegate/test/drive/pump-1/set";

struct Plant {
    site: Site,
    gateway: Running,
    _simulator: Running,
}

/// Drives `pump-1` and `pump-2` at that baud rate; `keys` are further lines of the first.
fn plant(baud: &str, keys: &str) -> Plant {
    let bus = LINE1.replace("38400", baud);
    let drives = controlled("pump-1", 1, keys) + &controlled("pump-2", 2, "raw_writes = true");
    let site = Site::of(&[&bus, &drives, MODBUS_TCP, MQTT, HTTP]);
    let simulator = site.simulate(&["--addresses", "1-2", "--baud", baud]);
    let gateway = site.run_ready();
    Plant {
        site,
        gateway,
        _simulator: simulator,
    }
}

#[test]
fn a_client_that_is_killed_leaves_a_lease_that_runs_out() {
    let Plant { site, .. } = &plant("38400", "supervision = { timeout = \"3s\", action = \"stop\" }");
    // A program that keeps its connection open and commands the motor to run until it is killed.
    let script = format!(
        "exec 3<>/dev/tcp/127.0.0.1/{}; while :; do printf '\\0\\1\\0\\0\\0\\6\\1\\6\\201\\0\\0\\1' >&3; sleep 0.5; done",
        site.modbus
    );
    let mut client = Running::start(Path::new("/bin/bash"), &["-c", &script]);
    site.until_state("pump-1", "running");
    client.signal("KILL");
    client.ended();
    site.until_state("pump-1", "ready");
    site.until_metric("drivegate_supervision_actions_total{bus=\"line1\",drive=\"pump-1\"} 1");
    let stop = until("the audit of the stop", || {
        site.audit().into_iter().find(|r| r["source"] == "supervision")
    });
    assert_eq!(
        (&stop["drive"], &stop["command"]),
        (&"pump-1".into(), &"run=false".into())
    );
}

#[test]
fn a_stop_under_a_full_queue_comes_first() {
    // A line so slow that the flood waits.
    let Plant { site, .. } = &plant("2400", "");
    write_registers(site.modbus, 1, 33_024, &[1]);
    site.until_state("pump-1", "running");
    let mut flood = TcpStream::connect(("127.0.0.1", site.modbus)).unwrap();
    let mut frames = Vec::new();
    for transaction in 0u16..100 {
        let [high, low] = transaction.to_be_bytes();
        // The flood repeatedly writes "reverse off" to the raw control word of the other drive.
        frames.extend([high, low, 0, 0, 0, 6, 2, 6, 0x07, 0xD1, 0, low]);
    }
    flood.write_all(&frames).unwrap();
    // The stop gets a place in the queue and is sent; `tests/world` proves that it is the very next request on the line.
    until("the stop", || {
        let reported = mbpoll_write(site.modbus, 1, 33_024, &[0]);
        assert!(
            !reported.as_ref().is_err_and(|why| why.contains("busy")),
            "{reported:?}"
        );
        reported.ok()
    });
    site.until_state("pump-1", "ready");
    // Each request of the flood gets exactly one answer: written, or refused because the queue was full or it expired.
    flood.set_read_timeout(Some(PATIENCE)).unwrap();
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
    let Plant { site, .. } = &plant("2400", "");
    let broker = site.broker();
    site.until_connected(true);
    site.publish(&[
        "-t",
        SET,
        "-m",
        "{\"id\": 1, \"speed_reference\": 10, \"expires_ms\": 60000}",
    ]);
    site.until_point("pump-1", "speed_reference", 10.0);
    drop(broker);
    site.until_connected(false);
    // The library of the client keeps the message until the broker is available again; by then the message has expired.
    let port = site.mqtt.to_string();
    let client = ["-h", "127.0.0.1", "-p", &port, "-t", SET];
    let message = ["-m", "{\"run\": true, \"expires_ms\": 100}"];
    let late = run(&tool("mosquitto_pub"), &[&client[..], &message].concat());
    assert!(!late.status.success(), "there is no broker");
    let _broker = site.broker();
    site.until_connected(true);
    site.publish(&[
        "-t",
        SET,
        "-m",
        "{\"id\": 2, \"speed_reference\": 20, \"expires_ms\": 60000}",
    ]);
    site.until_point("pump-1", "speed_reference", 20.0);
    assert_eq!(site.point("pump-1", "run"), false);
    // A transaction takes longer than the command is valid, so the command has expired when its turn comes.
    until("an expired command", || {
        site.publish(&["-t", SET, "-m", "{\"speed_reference\": 30, \"expires_ms\": 1}"]);
        site.audit().into_iter().find(|r| r["result"] == "expired")
    });
    let runs = |r: &serde_json::Value| r["command"].as_str().unwrap().contains("run=true");
    assert!(!site.audit().iter().any(runs));
}

#[test]
fn confirmed_repeated_refused_and_audited() {
    let Plant { site, gateway, .. } = &plant("38400", "");
    let _broker = site.broker();
    site.until_connected(true);
    site.until_point("pump-1", "run", false);
    let start = "{\"id\": \"start-1\", \"run\": true, \"speed_reference\": 50, \"expires_ms\": 60000}";
    for _ in 0..3 {
        site.publish(&["-t", SET, "-m", start]);
    }
    site.until_state("pump-1", "running");
    let record = until("the audit of the start", || {
        site.audit().into_iter().find(|r| r["result"] == "confirmed")
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
        site.point("pump-1", "frequency_reference").is_number().then_some(())
    });
    // A later command of the same client shows that the repetitions were received and not carried out.
    for (payload, why) in [
        ("{\"speed_reference\": 50, \"frequency_reference\": 30}", "twice"),
        ("{\"speed_reference\": NaN}", "not JSON"),
        ("{\"speed_reference\": \"50\"}", "quotes"),
        ("{\"speed_reference\": 1000}", "outside the limits"),
    ] {
        site.publish(&["-t", SET, "-m", payload]);
        let refused = until(why, || {
            site.audit()
                .into_iter()
                .find(|r| r["text"].as_str().unwrap().contains(why))
        });
        assert_eq!(refused["result"], "bad_value");
    }
    let starts = site.audit().iter().filter(|r| r["result"] == "confirmed").count();
    assert_eq!(starts, 1, "{:?}", site.audit());
    // Modbus TCP refuses a write of both references, and of bits without a meaning.
    let both = mbpoll_write(site.modbus, 1, 33_025, &[5000, 3000]).unwrap_err();
    assert!(both.contains("Illegal data value"), "{both}");
    let bits = mbpoll_write(site.modbus, 1, 33_024, &[0x0100]).unwrap_err();
    assert!(bits.contains("Illegal data value"), "{bits}");
    // The second write is of the same kind, so it may be counted first.
    let modbus = until("both in the audit", || {
        let mut modbus = site.audit();
        modbus.retain(|r| r["source"] == "modbus_tcp");
        (modbus.iter().filter_map(|r| r["count"].as_u64()).sum::<u64>() == 2).then_some(modbus)
    });
    assert!(
        modbus
            .iter()
            .all(|r| r["client"].as_str().unwrap().starts_with("127.0.0.1:"))
    );
    // The journal has it, too.
    gateway.until_printed("confirmed_us");
}
