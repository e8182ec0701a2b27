//! Several brokers: the next one is used when one fails, and an old one returns with old messages.

use std::path::Path;
use std::time::{Duration, Instant};

use drivegate_mqtt::{Options, sparkplug};
use serde_json::json;
use tempfile::TempDir;

use super::bench::{Broker, Gateway, Watcher, at, options, plant, wait_for};

const STATUS: &str = "drivegate/hall/status";
const STATE: &str = "drivegate/hall/drive/p1/state";
const BIRTH: &str = "spBv1.0/plant/NBIRTH/hall";
const DEATH: &str = "spBv1.0/plant/NDEATH/hall";
const HOST: &str = "spBv1.0/STATE/scada";

/// Options for the brokers on these ports, with an edge node.
fn of_ports(ports: &[u16], state_dir: &Path, primary_host: &str) -> Options {
    Options {
        brokers: ports.iter().map(|port| at(*port)).collect(),
        sparkplug: Some(sparkplug::Options {
            group: "plant".to_string(),
            node: "hall".to_string(),
            primary_host: primary_host.to_string(),
            alias: true,
            history: false,
            state_dir: state_dir.to_path_buf(),
        }),
        ..options(0)
    }
}

/// Receives all topics; payloads are shown in hex, since births are not text.
fn all_of(broker: &Broker) -> Watcher {
    Watcher::with(broker, "#", &["-F", "%r|%q|%t|%x"])
}

fn hex(text: &str) -> String {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

/// Waits until both clients are at the broker; prints how long that took since `from`.
fn wait_both(watcher: &Watcher, what: &str, from: Instant) {
    watcher.wait_payload(STATUS, &hex("online"));
    let plain = from.elapsed();
    watcher.wait("the birth", |m| m.topic == BIRTH);
    eprintln!(
        "{what}: plain after {plain:.1?}, Sparkplug after {:.1?} at the latest",
        from.elapsed()
    );
}

fn host(online: bool, timestamp: u64) -> String {
    json!({ "online": online, "timestamp": timestamp }).to_string()
}

#[test]
fn the_next_broker_follows_and_a_working_one_is_kept() {
    let state = TempDir::new().unwrap();
    let mut first = Broker::prepared(TempDir::new().unwrap(), "allow_anonymous true\n");
    let (mut second, mut third) = (Broker::start(), Broker::start());
    let watcher = all_of(&second);
    let from = Instant::now();
    let ports = [first.port, second.port, third.port];
    let gateway = Gateway::start(of_ports(&ports, state.path(), ""), plant(&["p1"]));
    wait_both(&watcher, "the first is dead", from);

    // The first broker is back: the gateway does not return to it while the second one works.
    first.up();
    let on_first = all_of(&first);
    for round in 0..20 {
        let topic = "drivegate/hall/drive/p1/set";
        second.publish(
            topic,
            &format!("{{\"id\": {round}, \"speed_reference\": {round}}}"),
            &[],
        );
        watcher.wait_count("drivegate/hall/drive/p1/result", round + 1);
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(on_first.all(), []);

    // The broker is killed while in use: the third one follows, then the first one.
    let on_third = all_of(&third);
    let from = Instant::now();
    second.kill();
    wait_both(&on_third, "the second was killed", from);
    let from = Instant::now();
    third.kill();
    wait_both(&on_first, "the third was killed", from);
    assert_eq!(gateway.ordered().len(), 20);
    gateway.stop();
    on_first.wait_payload(STATUS, &hex("offline"));
    on_first.wait("the death", |m| m.topic == DEATH);
}

#[test]
fn a_silent_broker_is_left() {
    let state = TempDir::new().unwrap();
    let (first, second) = (Broker::start(), Broker::start());
    let (on_first, on_second) = (all_of(&first), all_of(&second));
    let ports = [first.port, second.port];
    let gateway = Gateway::start(of_ports(&ports, state.path(), ""), plant(&["p1"]));
    wait_both(&on_first, "the first works", Instant::now());
    on_first.clear();
    let from = Instant::now();
    first.signal("STOP");
    wait_both(&on_second, "the first is silent", from);
    // The broker finds the connections closed when it continues, and publishes the last wills.
    first.signal("CONT");
    on_first.wait_payload(STATUS, &hex("offline"));
    on_first.wait("the death", |m| m.topic == DEATH);
    assert_eq!(on_second.payloads(STATUS), [hex("online")]);
    gateway.stop();
}

/// Retained messages of a broker that returns with its stored data `later` while the gateway uses another one.
fn after_return(message_expiry: Option<Duration>, later: Duration) -> [Option<String>; 2] {
    let state = TempDir::new().unwrap();
    let mut first = Broker::prepared(
        TempDir::new().unwrap(),
        "allow_anonymous true\npersistence_location {dir}/\n",
    );
    let conf = first.dir.path().join("mosquitto.conf");
    let text = std::fs::read_to_string(&conf).unwrap();
    std::fs::write(&conf, text.replace("persistence false", "persistence true")).unwrap();
    first.up();
    let second = Broker::start();
    let on_second = all_of(&second);
    let options = Options {
        message_expiry,
        ..of_ports(&[first.port, second.port], state.path(), "")
    };
    let gateway = Gateway::start(options, plant(&["p1"]));
    let kept = || Some((first.retained(STATUS)?, first.retained(STATE)?));
    wait_for("retained messages", || kept().filter(|(status, _)| status == "online"));
    // The signal makes the broker write all its messages to its disk.
    first.signal("USR1");
    wait_for("the disk", || {
        first.dir.path().join("mosquitto.db").is_file().then_some(())
    });
    std::thread::sleep(Duration::from_millis(500));
    first.kill();
    wait_both(&on_second, "the first was killed", Instant::now());
    std::thread::sleep(later);
    first.up();
    let says = [STATUS, STATE].map(|topic| first.retained(topic));
    gateway.stop();
    says
}

#[test]
fn a_broker_that_comes_back_does_not_say_that_a_gateway_elsewhere_is_online() {
    let expiry = Duration::from_secs(2);
    assert_eq!(
        after_return(Some(expiry), expiry + Duration::from_secs(1)),
        [None, None]
    );
    // Without an expiry the old messages still exist.
    let [status, state] = after_return(None, Duration::ZERO);
    assert_eq!((status.as_deref(), state.is_some()), (Some("online"), true));
}

#[test]
fn what_expires_is_renewed_before() {
    let broker = Broker::start();
    // The output shows the expiry instead of the payload.
    let watcher = Watcher::with(&broker, "#", &["-F", "%r|%q|%t|%E"]);
    let options = Options {
        message_expiry: Some(Duration::from_secs(2)),
        ..options(broker.port)
    };
    let gateway = Gateway::start(options, plant(&["p1"]));
    for topic in [
        STATUS,
        STATE,
        "drivegate/hall/drive/p1/point/running",
        "drivegate/hall/bus/line1",
    ] {
        let seen = watcher.wait_count(topic, 5);
        assert!(seen.iter().all(|m| m.payload == "2"), "{seen:?}");
        assert!(broker.retained(topic).is_some(), "{topic}");
    }
    gateway.stop();
    // The status stays offline until a new one is published.
    let offline = wait_for("offline", || {
        broker.retained(STATUS).filter(|status| status == "offline")
    });
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(broker.retained(STATUS), Some(offline));
}

#[test]
fn the_edge_node_looks_for_its_primary_host() {
    let state = TempDir::new().unwrap();
    let (first, second) = (Broker::start(), Broker::start());
    let (on_first, on_second) = (all_of(&first), all_of(&second));
    first.publish(HOST, &host(false, 1_000), &["-r"]);
    second.publish(HOST, &host(true, 1_000), &["-r"]);
    let ports = [first.port, second.port];
    let gateway = Gateway::start(of_ports(&ports, state.path(), "scada"), plant(&["p1"]));
    on_first.wait_payload(STATUS, &hex("online"));
    on_second.wait("the birth", |m| m.topic == BIRTH);
    // The edge node's host is offline at the second broker and online at the first; the plain client stays where it is.
    second.publish(HOST, &host(false, 2_000), &["-r"]);
    on_second.wait("the death", |m| m.topic == DEATH);
    first.publish(HOST, &host(true, 2_000), &["-r"]);
    on_first.wait("the birth", |m| m.topic == BIRTH);
    assert_eq!(on_second.payloads(STATUS), Vec::<String>::new());
    gateway.stop();
}

#[test]
fn a_reload_keeps_the_broker_that_works() {
    let state = TempDir::new().unwrap();
    let mut first = Broker::prepared(TempDir::new().unwrap(), "allow_anonymous true\n");
    let second = Broker::start();
    let on_second = all_of(&second);
    let options = of_ports(&[first.port, second.port], state.path(), "");
    let gateway = Gateway::start(options.clone(), plant(&["p1"]));
    wait_both(&on_second, "the first is dead", Instant::now());
    first.up();
    let on_first = all_of(&first);
    on_second.clear();
    let without = drivegate_mqtt::Options {
        commands: false,
        ..options
    };
    let gateway = gateway.replace(without, |_| ());
    wait_both(&on_second, "after a reload", Instant::now());
    gateway.stop();
    assert_eq!(on_first.all(), []);
}
