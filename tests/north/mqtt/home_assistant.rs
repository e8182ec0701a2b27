//! Discovery for Home Assistant as a broker and its clients receive it. The real Home Assistant runs in `make interop`.

use std::collections::BTreeSet;

use drivegate_mqtt::{Buffer, Options};
use serde_json::Value;
use tempfile::TempDir;

use super::bench::*;

const DEVICES: &str = "homeassistant/device/drivegate_hall";

fn discovery(port: u16) -> Options {
    Options {
        home_assistant: Some("homeassistant".to_string()),
        ..options(port)
    }
}

fn topic(device: &str) -> String {
    format!("{DEVICES}/{device}/config")
}

/// Keys of the entities of a message, except those that are only removed.
fn entities(message: &Value) -> BTreeSet<String> {
    let all = message["cmps"].as_object().unwrap().iter();
    let described = all.filter(|(_, entity)| entity.get("uniq_id").is_some());
    described.map(|(key, _)| key.clone()).collect()
}

#[test]
fn each_drive_has_a_retained_message_whose_topics_exist() {
    let broker = Broker::start();
    let gateway = Gateway::start(discovery(broker.port), plant(&["p1", "m2"]));
    let watcher = Watcher::new(&broker, "#");
    for device in ["gateway", "drive_p1", "drive_m2"] {
        watcher.wait("the message", |m| m.topic == topic(device));
    }
    watcher.wait("the state", |m| m.topic == "drivegate/hall/drive/m2/state");
    watcher.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    let late = Watcher::new(&broker, "#");
    let mut ids = BTreeSet::new();
    for (device, controls) in [("gateway", 0), ("drive_p1", 4), ("drive_m2", 0)] {
        let message = late.wait("the message", |m| m.topic == topic(device));
        assert!(message.retain && message.qos == 1);
        let message = message.json();
        let published: BTreeSet<String> = watcher.all().into_iter().map(|m| m.topic).collect();
        let components = message["cmps"].as_object().unwrap();
        let described: Vec<&Value> = components.values().filter(|e| e.get("uniq_id").is_some()).collect();
        let of = |key: &str| -> Vec<&str> { described.iter().filter_map(|e| e[key].as_str()).collect() };
        // Values that are not good, and events, have no retained message.
        let shown = of("stat_t").into_iter().filter(|t| published.contains(*t)).count();
        assert!(
            shown > 4 && shown >= described.len() / 2,
            "{shown} of {}: {published:?}",
            described.len()
        );
        assert_eq!(of("cmd_t").len(), controls, "{device}");
        assert!(of("cmd_t").iter().all(|t| *t == "drivegate/hall/drive/p1/set"));
        ids.extend(of("uniq_id").into_iter().map(str::to_string));
        let count = ids.len();
        assert!(count >= described.len());
        for availability in message["avty"].as_array().unwrap() {
            assert!(
                published.contains(availability["t"].as_str().unwrap()),
                "{availability}"
            );
        }
    }
    gateway.stop();
}

#[test]
fn a_birth_of_home_assistant_brings_everything_again() {
    let broker = Broker::start();
    let gateway = Gateway::start(discovery(broker.port), plant(&["p1"]));
    let watcher = Watcher::with(&broker, "homeassistant/#", &["--retain-as-published"]);
    watcher.wait("the message", |m| m.topic == topic("drive_p1"));
    watcher.clear();
    broker.publish("homeassistant/status", "offline", &[]);
    broker.publish("homeassistant/status", "online", &[]);
    for device in ["gateway", "drive_p1"] {
        let message = watcher.wait("the message", |m| m.topic == topic(device));
        assert!(message.retain && !message.payload.is_empty());
    }
    assert_eq!(watcher.payloads(&topic("drive_p1")).len(), 1);
    gateway.stop();
}

#[test]
fn commands_of_home_assistant_reach_the_drive() {
    let broker = Broker::start();
    let mut options = discovery(broker.port);
    options.require_id = true;
    let gateway = Gateway::start(options, plant(&["p1"]));
    let watcher = Watcher::new(&broker, "#");
    let message = watcher.wait("the message", |m| m.topic == topic("drive_p1")).json();
    let number = &message["cmps"]["number_speed_reference"];
    assert_eq!((&number["min"], &number["max"]), (&0.0.into(), &80.0.into()));
    for (component, value) in [("number_speed_reference", "40.5"), ("switch_run", "true")] {
        let component = &message["cmps"][component];
        let template = component["cmd_tpl"].as_str().unwrap();
        let sent = template.replace("{{ now().timestamp() }}", "1763829997.25");
        let sent = sent.replace("{{ value }}", value);
        broker.publish(component["cmd_t"].as_str().unwrap(), &sent, &[]);
    }
    let orders = wait_for("both orders", || {
        Some(gateway.ordered()).filter(|orders| orders.len() == 2)
    });
    let names: Vec<&str> = orders
        .iter()
        .flat_map(|(_, points, _)| points)
        .map(|(name, _)| name.as_str())
        .collect();
    assert_eq!(names, ["speed_reference", "run"]);
    gateway.stop();
}

#[test]
fn without_commands_there_are_no_controls() {
    let broker = Broker::start();
    let mut options = discovery(broker.port);
    options.commands = false;
    let gateway = Gateway::start(options, plant(&["p1"]));
    let watcher = Watcher::new(&broker, "homeassistant/#");
    let message = watcher.wait("the message", |m| m.topic == topic("drive_p1")).json();
    let entities = entities(&message);
    assert!(entities.contains("binary_sensor_run") && entities.contains("sensor_speed_reference"));
    assert!(
        entities
            .iter()
            .all(|key| !key.starts_with("switch") && !key.starts_with("number"))
    );
    assert_eq!(
        message["cmps"]["switch_run"],
        serde_json::json!({ "p": "switch" }),
        "taken away"
    );
    gateway.stop();
}

#[test]
fn a_drive_that_a_reload_removes_is_cleared() {
    let broker = Broker::start();
    let gateway = Gateway::start(discovery(broker.port), plant(&["p1", "p2"]));
    let watcher = Watcher::new(&broker, "homeassistant/#");
    watcher.wait("the message", |m| m.topic == topic("drive_p2"));
    gateway.plant.store(std::sync::Arc::new(plant(&["p1", "p3"])));
    watcher.wait_payload(&topic("drive_p2"), "");
    watcher.wait("the new drive", |m| m.topic == topic("drive_p3"));
    assert_eq!(broker.retained(&topic("drive_p2")), None);
    gateway.stop();
}

/// Without a buffer the gateway reads the messages of an earlier run from the broker.
#[test]
fn a_drive_that_was_removed_while_the_gateway_was_stopped_is_cleared() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "homeassistant/#");
    let first = Gateway::start(discovery(broker.port), plant(&["p1", "p2"]));
    watcher.wait("the message", |m| m.topic == topic("drive_p2"));
    first.stop();
    broker.publish("homeassistant/device/drivegate_hallway/drive_p9/config", "{}", &["-r"]);
    let second = Gateway::start(discovery(broker.port), plant(&["p1"]));
    watcher.wait_payload(&topic("drive_p2"), "");
    assert!(broker.retained(&topic("drive_p1")).is_some());
    assert!(
        broker
            .retained("homeassistant/device/drivegate_hallway/drive_p9/config")
            .is_some()
    );
    second.stop();
}

#[test]
fn with_a_buffer_switching_it_off_clears_everything() {
    let broker = Broker::start();
    let dir = TempDir::new().unwrap();
    let buffer = || {
        Some(Buffer {
            dir: dir.path().to_path_buf(),
            max_bytes: 1 << 20,
        })
    };
    let watcher = Watcher::new(&broker, "homeassistant/#");
    let mut on = discovery(broker.port);
    on.buffer = buffer();
    let first = Gateway::start(on, plant(&["p1"]));
    watcher.wait("the message", |m| m.topic == topic("drive_p1"));
    first.stop();
    let mut off = options(broker.port);
    off.buffer = buffer();
    let second = Gateway::start(off, plant(&["p1"]));
    for device in ["gateway", "drive_p1"] {
        watcher.wait_payload(&topic(device), "");
    }
    second.stop();
}

#[test]
fn a_broker_with_small_packets_gets_a_drive_in_parts() {
    let broker = Broker::with("allow_anonymous true\nmax_packet_size 4000\n");
    let gateway = Gateway::start(discovery(broker.port), plant(&["p1"]));
    let watcher = Watcher::new(&broker, "homeassistant/#");
    let first = watcher.wait("the first part", |m| m.topic == topic("drive_p1")).json();
    let second = watcher
        .wait("the second part", |m| m.topic == topic("drive_p1__2"))
        .json();
    assert_eq!(first["dev"], second["dev"]);
    assert!(entities(&first).is_disjoint(&entities(&second)));
    assert!(gateway.connected());
    gateway.stop();
}
