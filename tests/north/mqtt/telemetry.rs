//! Published telemetry: topics, payloads and times.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use drivegate_core::event::{Event, EventKind};
use drivegate_core::process_image::Link;
use drivegate_mqtt::{Buffer, Qos};
use tempfile::TempDir;

use super::bench::*;

#[test]
fn all_topics_are_there_retained() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1", "p2"]));
    let watcher = Watcher::new(&broker, "drivegate/#");
    watcher.wait_payload("drivegate/hall/status", "online");
    watcher.wait("state of p2", |m| m.topic == "drivegate/hall/drive/p2/state");
    watcher.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    // A client that subscribes later receives all topics as retained messages.
    let late = Watcher::new(&broker, "drivegate/#");
    for (topic, payload) in [
        ("status", "online"),
        ("drive/p1/point/running", "true"),
        ("drive/p1/point/output_frequency", "25"),
        ("drive/p1/point/motor_current", "1.2"),
        ("drive/p1/point/state", "running"),
        ("drive/p1/point/fault_code", "0"),
    ] {
        let seen = late.wait_payload(&format!("drivegate/hall/{topic}"), payload);
        assert!(seen.retain, "{topic}");
    }
    let state = late.wait("the state", |m| m.topic == "drivegate/hall/drive/p1/state");
    assert!(state.retain && state.qos == 0);
    let state = state.json();
    assert_eq!(
        (&state["state"], &state["quality"]),
        (&"running".into(), &"good".into())
    );
    assert_eq!(state["output_frequency"], 25.0);
    assert_eq!(state["heatsink_temperature"], serde_json::Value::Null);
    assert_eq!(state["point_quality"]["heatsink_temperature"], "bad");
    let time = humantime::parse_rfc3339(state["time"].as_str().unwrap()).unwrap();
    assert!(SystemTime::now().duration_since(time).unwrap() < DEADLINE);
    assert!(state["age_ms"].is_u64());
    let bus = late.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    assert!(bus.retain);
    let bus = bus.json();
    assert_eq!(
        (&bus["state"], &bus["drives"], &bus["online"]),
        (&"up".into(), &2.into(), &2.into())
    );
    // Points that are not good have no retained message.
    assert!(
        late.payloads("drivegate/hall/drive/p1/point/heatsink_temperature")
            .is_empty()
    );
    assert!(gateway.connected());
    gateway.stop();
}

/// Some brokers close the connection at a retained message.
#[test]
fn nothing_is_retained_where_that_is_not_wanted() {
    let broker = Broker::start();
    let options = drivegate_mqtt::Options {
        retain: false,
        ..options(broker.port)
    };
    let watcher = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    watcher.wait("the state", |m| m.topic == "drivegate/hall/drive/p1/state");
    watcher.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    gateway.stop();
    watcher.wait_payload("drivegate/hall/status", "offline");
    // A broker that has retained messages sends them before it acknowledges a new message.
    let late = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(self::options(broker.port), plant(&["p2"]));
    late.wait_payload("drivegate/hall/status", "online");
    assert!(late.payloads("drivegate/hall/drive/p1/state").is_empty());
    assert_eq!(late.payloads("drivegate/hall/status"), ["online"]);
    gateway.stop();
}

#[test]
fn changes_are_published_and_lost_values_taken_away() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let watcher = Watcher::new(&broker, "drivegate/#");
    let point = "drivegate/hall/drive/p1/point/output_frequency";
    watcher.wait_payload(point, "25");
    gateway.read("p1", 2610);
    watcher.wait_payload(point, "26.1");
    watcher.wait("the new state", |m| {
        m.topic.ends_with("p1/state") && m.payload.contains("26.1")
    });
    watcher.clear();
    let drive = gateway.plant.load().drive("p1").unwrap();
    drive.image.update(|s| s.link = Link::Offline(SystemTime::now()));
    watcher.wait_payload(point, "");
    watcher.wait_payload("drivegate/hall/drive/p1/point/state", "offline");
    let state = watcher.wait("the state", |m| {
        m.topic.ends_with("p1/state") && m.payload.contains("\"offline\"")
    });
    assert_eq!(state.json()["quality"], "stale");
    assert_eq!(state.json()["output_frequency"], serde_json::Value::Null);
    assert_eq!(broker.retained(point), None);
    gateway.stop();
}

#[test]
fn events_pass_through_and_are_not_retained() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let topic = "drivegate/hall/drive/p1/event";
    let watcher = Watcher::with(&broker, topic, &["--retain-as-published"]);
    gateway.wait_connected(true);
    let time = gateway.publish_event("p1", EventKind::Fault, "fault 53: fieldbus fault");
    let event = watcher.wait("the event", |m| m.topic == topic);
    assert!(!event.retain && event.qos == 1);
    let event = event.json();
    assert_eq!(
        (&event["event"], &event["drive"], &event["bus"]),
        (&"fault".into(), &"p1".into(), &"line1".into())
    );
    assert_eq!(event["boot"].as_str().unwrap().len(), 16);
    assert_eq!(event["time"], humantime::format_rfc3339_millis(time).to_string());
    assert_eq!(event["text"], "fault 53: fieldbus fault");
    assert_eq!(broker.retained(topic), None);
    wait_for("the acknowledgement", || (gateway.buffered() == 0).then_some(()));
    gateway.stop();
}

#[test]
fn the_last_will_tells_a_killed_gateway() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let watcher = Watcher::new(&broker, "drivegate/hall/status");
    watcher.wait_payload("drivegate/hall/status", "online");
    gateway.kill();
    watcher.wait_payload("drivegate/hall/status", "offline");
    assert_eq!(broker.retained("drivegate/hall/status").as_deref(), Some("offline"));
}

#[test]
fn a_clean_stop_says_offline_once_and_soon() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let watcher = Watcher::new(&broker, "drivegate/hall/#");
    watcher.wait_payload("drivegate/hall/status", "online");
    gateway.publish_event("p1", EventKind::Restarted, "the last word");
    gateway.stop();
    watcher.wait_payload("drivegate/hall/status", "offline");
    watcher.wait("the event", |m| m.payload.contains("the last word"));
    // The will would have been a second message.
    broker.publish("drivegate/hall/after", "x", &[]);
    watcher.wait_payload("drivegate/hall/after", "x");
    let status = watcher.payloads("drivegate/hall/status");
    assert_eq!(status.iter().filter(|s| *s == "offline").count(), 1, "{status:?}");
}

#[test]
fn stopping_without_a_broker_does_not_wait() {
    let gateway = Gateway::start(options(free_port()), plant(&["p1"]));
    gateway.stop();
}

#[test]
fn telemetry_expires_and_the_status_does_not() {
    let broker = Broker::start();
    let mut options = options(broker.port);
    options.expiry = Some(Duration::from_secs(300));
    options.telemetry_qos = Qos::AtLeastOnce;
    let gateway = Gateway::start(options, plant(&["p1"]));
    let late = Watcher::new(&broker, "drivegate/#");
    late.wait("the state", |m| {
        m.topic == "drivegate/hall/drive/p1/state" && m.qos == 1
    });
    let expiry = |topic: &str| {
        let arguments = ["-t", topic, "-F", "%E", "-W", "2", "-C", "1", "--retained-only"];
        let output = broker.run("mosquitto_sub", &arguments);
        String::from_utf8(output.stdout).unwrap().trim().to_string()
    };
    let state: u32 = expiry("drivegate/hall/drive/p1/state").parse().unwrap();
    assert!((100..=300).contains(&state), "{state}");
    assert_eq!(expiry("drivegate/hall/status").parse::<u32>().unwrap_or_default(), 0);
    gateway.stop();
}

#[test]
fn a_false_status_is_repaired() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let watcher = Watcher::new(&broker, "drivegate/hall/status");
    watcher.wait_payload("drivegate/hall/status", "online");
    // The second false status arrives within a second of the first.
    for repaired in 1..=2 {
        broker.publish("drivegate/hall/status", "offline", &["-r"]);
        wait_for("the status to be repaired", || {
            let all = watcher.payloads("drivegate/hall/status");
            (all.iter().filter(|status| *status == "offline").count() == repaired
                && all.last().is_some_and(|status| status == "online"))
            .then_some(())
        });
    }
    assert_eq!(broker.retained("drivegate/hall/status").as_deref(), Some("online"));
    gateway.stop();
}

#[test]
fn bus_events_reach_the_topics_of_its_drives() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(options(broker.port), plant(&["p1", "p2"]));
    gateway.wait_connected(true);
    gateway.plant.load().events.publish(Event {
        bus: "line1".to_string(),
        ..Event::new(EventKind::BusDown, SystemTime::now(), "unplugged".to_string())
    });
    for drive in ["p1", "p2"] {
        let topic = format!("drivegate/hall/drive/{drive}/event");
        let event = watcher.wait("the event", |m| m.topic == topic).json();
        assert_eq!(event["event"], "bus_down");
    }
    gateway.stop();
}

#[test]
fn after_a_new_name_the_old_topics_are_cleared() {
    let broker = Broker::start();
    let dir = TempDir::new().unwrap();
    let mut options = options(broker.port);
    options.buffer = Some(Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    });
    let gateway = Gateway::start(options.clone(), plant(&["p1"]));
    let watcher = Watcher::new(&broker, "#");
    watcher.wait("the state", |m| m.topic == "drivegate/hall/drive/p1/state");
    gateway.stop();
    options.base = "plant".to_string();
    let gateway = Gateway::start(options, plant(&["p1"]));
    for topic in ["status", "drive/p1/state", "drive/p1/point/running", "bus/line1"] {
        watcher.wait_payload(&format!("drivegate/hall/{topic}"), "");
    }
    watcher.wait("the new state", |m| m.topic == "plant/hall/drive/p1/state");
    assert_eq!(broker.retained("drivegate/#"), None);
    gateway.stop();
}

#[test]
fn a_reload_clears_what_vanished_and_keeps_the_events() {
    let broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1", "p2"]));
    let watcher = Watcher::new(&broker, "drivegate/#");
    watcher.wait("p2", |m| m.topic == "drivegate/hall/drive/p2/state");
    watcher.clear();
    gateway.publish_event("p1", EventKind::Online, "of the old plant");
    gateway.plant.store(Arc::new(plant(&["p1", "p3"])));
    watcher.wait_payload("drivegate/hall/drive/p2/state", "");
    watcher.wait_payload("drivegate/hall/drive/p2/point/running", "");
    watcher.wait("p3", |m| m.topic == "drivegate/hall/drive/p3/state");
    watcher.wait("the old event", |m| m.payload.contains("of the old plant"));
    gateway.publish_event("p3", EventKind::Online, "of the new plant");
    watcher.wait("the new event", |m| m.payload.contains("of the new plant"));
    assert_eq!(broker.retained("drivegate/hall/drive/p2/state"), None);
    gateway.stop();
}
