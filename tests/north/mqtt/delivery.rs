//! Brokers that disconnect and return.

use std::time::{Duration, SystemTime};

use drivegate_core::event::EventKind;
use drivegate_mqtt::{Buffer, History};
use tempfile::TempDir;

use super::bench::*;
use crate::support::mqtt::next_message;

const EVENT: &str = "drivegate/hall/drive/p1/event";

fn texts(seen: &[Seen]) -> Vec<String> {
    let text = |m: &Seen| m.json()["text"].as_str().unwrap().to_string();
    seen.iter().map(text).collect()
}

fn time(seen: &Seen) -> String {
    seen.json()["time"].as_str().unwrap().to_string()
}

fn rfc3339(time: SystemTime) -> String {
    humantime::format_rfc3339_millis(time).to_string()
}

#[test]
fn a_broker_that_comes_later_is_found() {
    let mut broker = Broker::prepared(TempDir::new().unwrap(), "allow_anonymous true\n");
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let time_told = gateway.publish_event("p1", EventKind::Fault, "before there was a broker");
    wait_for("the event to be buffered", || (gateway.buffered() == 1).then_some(()));
    assert!(!gateway.connected());
    broker.up();
    let watcher = Watcher::new(&broker, "drivegate/#");
    watcher.wait_payload("drivegate/hall/status", "online");
    gateway.wait_connected(true);
    wait_for("the event to be delivered", || (gateway.buffered() == 0).then_some(()));
    // The watcher may have come too late for the event itself, whose time is checked in the test that cuts a line.
    assert!(
        watcher
            .all()
            .iter()
            .filter(|m| m.topic == EVENT)
            .all(|m| time(m) == rfc3339(time_told))
    );
    gateway.stop();
}

#[test]
fn what_happens_while_a_reload_replaces_the_client_is_published_once() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    gateway.publish_event("p1", EventKind::Fault, "before");
    let mut other = options(broker.port);
    other.min_interval += Duration::from_millis(1);
    let gateway = gateway.replace(other, |gateway| {
        gateway.publish_event("p1", EventKind::FaultEnd, "between");
    });
    gateway.publish_event("p1", EventKind::Fault, "after");
    watcher.wait("the last event", |seen| {
        seen.topic == EVENT && seen.json()["text"] == "after"
    });
    gateway.stop();
    let seen: Vec<Seen> = watcher.all().into_iter().filter(|seen| seen.topic == EVENT).collect();
    assert_eq!(texts(&seen), ["before", "between", "after"]);
}

#[test]
fn a_killed_broker_gets_everything_again() {
    let mut broker = Broker::start();
    let line = CutLine::to(broker.port);
    let gateway = Gateway::start(options(line.port), plant(&["p1"]));
    gateway.wait_connected(true);
    line.cut();
    broker.kill();
    gateway.wait_connected(false);
    gateway.read("p1", 1111);
    broker.up();
    let watcher = Watcher::new(&broker, "#");
    assert!(watcher.all().is_empty(), "the broker has forgotten everything");
    line.mend();
    watcher.wait_payload("drivegate/hall/status", "online");
    watcher.wait_payload("drivegate/hall/drive/p1/point/output_frequency", "11.11");
    watcher.wait("the state", |m| m.topic == "drivegate/hall/drive/p1/state");
    watcher.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    assert_eq!(watcher.all()[0].topic, "drivegate/hall/status", "the birth comes first");
    // The gateway has subscribed again.
    broker.publish("drivegate/hall/drive/p1/set/run", "1", &[]);
    watcher.wait("the result", |m| m.topic == "drivegate/hall/drive/p1/result");
    assert_eq!(gateway.ordered().len(), 1);
    gateway.stop();
}

#[test]
fn a_broker_killed_again_and_again() {
    let mut broker = Broker::start();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    for round in 0..5 {
        gateway.wait_connected(true);
        gateway.read("p1", 1000 + round);
        broker.kill();
        gateway.wait_connected(false);
        broker.up();
    }
    let watcher = Watcher::new(&broker, "drivegate/#");
    watcher.wait_payload("drivegate/hall/status", "online");
    watcher.wait_payload("drivegate/hall/drive/p1/point/output_frequency", "10.04");
    gateway.stop();
}

#[test]
fn events_wait_in_order_and_telemetry_does_not() {
    let broker = Broker::start();
    let line = CutLine::to(broker.port);
    let watcher = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(options(line.port), plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/drive/p1/point/output_frequency", "25");
    line.cut();
    gateway.wait_connected(false);
    watcher.wait_payload("drivegate/hall/status", "offline");
    watcher.clear();
    let mut reported = Vec::new();
    for n in 0u16..100 {
        gateway.read("p1", 3000 + n);
        reported.push(rfc3339(gateway.publish_event(
            "p1",
            EventKind::Fault,
            &format!("event {n}"),
        )));
    }
    wait_for("the events to be buffered", || {
        (gateway.buffered() == 100).then_some(())
    });
    line.mend();
    let events = watcher.wait_count(EVENT, 100);
    assert_eq!(
        texts(&events),
        (0..100).map(|n| format!("event {n}")).collect::<Vec<_>>()
    );
    assert_eq!(
        events.iter().map(time).collect::<Vec<_>>(),
        reported,
        "with their original times"
    );
    let point = "drivegate/hall/drive/p1/point/output_frequency";
    watcher.wait_payload(point, "30.99");
    assert_eq!(watcher.payloads(point), ["30.99"], "only what holds now");
    wait_for("the buffer to be empty", || (gateway.buffered() == 0).then_some(()));
    gateway.stop();
}

#[test]
fn buffered_events_survive_a_killed_gateway() {
    let broker = Broker::start();
    let line = CutLine::to(broker.port);
    let watcher = Watcher::new(&broker, "drivegate/#");
    let dir = TempDir::new().unwrap();
    let mut options = options(line.port);
    options.buffer = Some(Buffer {
        dir: dir.path().join("events"),
        max_bytes: 1 << 20,
    });
    let gateway = Gateway::start(options.clone(), plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    gateway.publish_event("p1", EventKind::Online, "delivered");
    watcher.wait("the event", |m| m.payload.contains("delivered"));
    wait_for("its acknowledgement", || (gateway.buffered() == 0).then_some(()));
    line.cut();
    gateway.wait_connected(false);
    watcher.clear();
    let publish = |gateway: &Gateway, range: std::ops::Range<usize>| -> Vec<String> {
        let one = |n| rfc3339(gateway.publish_event("p1", EventKind::Fault, &format!("event {n}")));
        range.map(one).collect()
    };
    let mut reported = publish(&gateway, 0..1000);
    wait_for("the events to be buffered", || {
        (gateway.buffered() == 1000).then_some(())
    });
    gateway.kill();
    let gateway = Gateway::start(options, plant(&["p1"]));
    wait_for("the old events", || (gateway.buffered() == 1000).then_some(()));
    reported.extend(publish(&gateway, 1000..1010));
    wait_for("the new events", || (gateway.buffered() == 1010).then_some(()));
    line.mend();
    let events = watcher.wait_count(EVENT, 1010);
    assert_eq!(
        texts(&events),
        (0..1010).map(|n| format!("event {n}")).collect::<Vec<_>>()
    );
    assert_eq!(events.iter().map(time).collect::<Vec<_>>(), reported);
    wait_for("the buffer to be empty", || (gateway.buffered() == 0).then_some(()));
    gateway.stop();
    let bytes = |entry: std::io::Result<std::fs::DirEntry>| {
        let entry = entry.unwrap();
        let log = entry.file_name().to_str().unwrap().ends_with(".log");
        if log { entry.metadata().unwrap().len() } else { 0 }
    };
    let left: u64 = std::fs::read_dir(dir.path().join("events")).unwrap().map(bytes).sum();
    assert_eq!(left, 0);
}

#[test]
fn the_values_of_an_outage_come_afterwards() {
    let broker = Broker::start();
    let line = CutLine::to(broker.port);
    let watcher = Watcher::new(&broker, "drivegate/#");
    let dir = TempDir::new().unwrap();
    let mut options = options(line.port);
    options.telemetry.history = History::Changes;
    options.min_interval = Duration::ZERO;
    options.buffer = Some(Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    });
    let gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    line.cut();
    gateway.wait_connected(false);
    watcher.clear();
    for value in 3000..3120 {
        gateway.read("p1", value);
        // Two arrays are full and stored.
        wait_for("the value to be recorded", || {
            std::thread::sleep(Duration::from_millis(3));
            Some(())
        });
    }
    line.mend();
    let values = || -> Vec<f64> {
        let arrays = watcher.payloads("drivegate/hall/drive/p1/history");
        let entries = arrays.iter().flat_map(|array| {
            let entries: Vec<serde_json::Value> = serde_json::from_str(array).unwrap();
            entries
        });
        let value = |entry: serde_json::Value| {
            assert!(entry["historical"] == true && entry["time"].is_string());
            entry["output_frequency"].as_f64().unwrap()
        };
        entries.map(value).collect()
    };
    wait_for("the last value", || (values().last() == Some(&31.19)).then_some(()));
    assert!(values().is_sorted() && values().len() > 50);
    gateway.stop();
}

#[test]
fn a_burst_of_all_drives_is_delivered() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, EVENT);
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    gateway.wait_connected(true);
    for n in 0..1000 {
        gateway.publish_event("p1", EventKind::Offline, &format!("event {n}"));
    }
    let events = watcher.wait_count(EVENT, 1000);
    assert_eq!(
        texts(&events),
        (0..1000).map(|n| format!("event {n}")).collect::<Vec<_>>()
    );
    gateway.stop();
}

#[test]
fn a_directory_that_cannot_be_used_does_not_stop_the_events() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, EVENT);
    let mut options = options(broker.port);
    options.buffer = Some(Buffer {
        dir: "/proc/drivegate".into(),
        max_bytes: 1 << 20,
    });
    let gateway = Gateway::start(options, plant(&["p1"]));
    gateway.publish_event("p1", EventKind::Fault, "from memory");
    watcher.wait("the event", |m| m.payload.contains("from memory"));
    gateway.stop();
}

#[test]
fn a_broker_that_takes_one_message_at_a_time() {
    let broker = Broker::with("allow_anonymous true\nmax_inflight_messages 1\n");
    let watcher = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    for n in 0..20 {
        gateway.publish_event("p1", EventKind::Fault, &format!("event {n}"));
    }
    let events = watcher.wait_count(EVENT, 20);
    assert_eq!(
        texts(&events),
        (0..20).map(|n| format!("event {n}")).collect::<Vec<_>>()
    );
    watcher.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    broker.publish("drivegate/hall/drive/p1/set/run", "1", &[]);
    watcher.wait("the result", |m| m.topic == "drivegate/hall/drive/p1/result");
    gateway.stop();
}

#[test]
fn a_mosquitto_without_qos_1_or_retained_messages_is_served() {
    for settings in [
        "max_qos 0\n",
        "retain_available false\n",
        "max_qos 0\nretain_available false\n",
    ] {
        let broker = Broker::with(&format!("allow_anonymous true\n{settings}"));
        let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
        gateway.wait_connected(true);
        let said = if settings.contains("retain") {
            "keeps no retained messages"
        } else {
            "has no QoS 1"
        };
        wait_log(broker.port, said);
        // QoS 0 is used because with more, the clients of mosquitto refuse messages themselves.
        let port = broker.port;
        let seen = std::thread::spawn(move || next_message(port, EVENT, &["-W", "240"]));
        while !seen.is_finished() {
            gateway.publish_event("p1", EventKind::Fault, "there");
            std::thread::sleep(Duration::from_millis(50));
        }
        let output = seen.join().unwrap();
        assert!(String::from_utf8_lossy(&output.stdout).contains("there"), "{output:?}");
        gateway.stop();
    }
}

#[test]
fn many_drives_and_a_broker_that_limits_packets() {
    let broker = Broker::with("allow_anonymous true\nmax_packet_size 300\n");
    let watcher = Watcher::new(&broker, "drivegate/#");
    let names: Vec<String> = (0..30).map(|n| format!("p{n}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let gateway = Gateway::start(options(broker.port), plant(&names));
    // The state objects are too large for this broker and lack their last points; everything else gets through.
    for name in &names {
        watcher.wait_payload(&format!("drivegate/hall/drive/{name}/point/output_frequency"), "25");
    }
    watcher.wait("the bus", |m| m.topic == "drivegate/hall/bus/line1");
    let state = watcher.wait("a state", |m| m.topic == "drivegate/hall/drive/p1/state");
    assert!(state.json()["omitted"].as_u64() > Some(0), "{state:?}");
    assert!(gateway.connected());
    assert_eq!(
        watcher.payloads("drivegate/hall/status"),
        ["online"],
        "never disconnected"
    );
    gateway.stop();
}

#[test]
fn a_broker_that_hangs_does_not_hold_up_the_stop() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "drivegate/hall/status");
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    broker.signal("STOP");
    gateway.publish_event("p1", EventKind::Fault, "nobody listens");
    gateway.stop();
    broker.signal("CONT");
    watcher.wait_payload("drivegate/hall/status", "offline");
}
