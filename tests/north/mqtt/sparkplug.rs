//! The edge node on Mosquitto, as decoded by Eclipse Tahu (npm `sparkplug-payload`), compared with the rules of the
//! specification (`tck-id-…`, in `tests/peers/sparkplug.js`).

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use drivegate_core::process_image::Link;
use drivegate_model::drive::Value;
use drivegate_mqtt::sparkplug;
use serde_json::{Value as Json, json};

use super::bench::{Broker, CutLine, Gateway, Watcher, plant, wait_for};
use crate::support::tools;

const NODE: &str = "spBv1.0/plant/NCMD/pump-house";
const P1: &str = "spBv1.0/plant/DCMD/pump-house/p1";
const STATE: &str = "spBv1.0/STATE/scada";

fn options(port: u16, state_dir: &Path) -> drivegate_mqtt::Options {
    drivegate_mqtt::Options {
        sparkplug: Some(sparkplug::Options {
            group: "plant".to_string(),
            node: "pump-house".to_string(),
            primary_host: String::new(),
            alias: true,
            history: true,
            state_dir: state_dir.to_path_buf(),
        }),
        ..super::bench::options(port)
    }
}

fn watcher(broker: &Broker) -> Watcher {
    Watcher::with(broker, "spBv1.0/#", &["-F", "%r|%q|%t|%x"])
}

fn peer(arguments: &[&str], input: &str) -> String {
    let mut command = Command::new(tools::tool("node"));
    command
        .env("NODE_PATH", tools::root().join(".tools/node/node_modules"))
        .arg(tools::root().join("tests/peers/sparkplug.js"))
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Messages published so far, checked against the rules.
struct Seen(Json);

impl Seen {
    fn of(watcher: &Watcher) -> Seen {
        let line = |m: super::bench::Seen| format!("{}|{}|{}|{}\n", u8::from(m.retain), m.qos, m.topic, m.payload);
        let lines: String = watcher.all().into_iter().map(line).collect();
        Seen(serde_json::from_str(&peer(&["check"], &lines)).unwrap())
    }

    /// Fails if a rule is broken, or if one of these was never checked.
    fn keeps(&self, rules: &[&str]) {
        assert_eq!(self.0["failed"], json!([]));
        for rule in rules {
            assert!(self.0["checked"][*rule].as_u64() > Some(0), "{rule} was not checked");
        }
    }

    fn messages(&self) -> Vec<&Json> {
        self.0["messages"].as_array().unwrap().iter().collect()
    }

    /// Types and devices in order, data left out.
    fn births_and_deaths(&self) -> Vec<String> {
        let all = self.messages().into_iter();
        let word = |m: &Json| format!("{} {}", m["type"].as_str().unwrap(), m["device"].as_str().unwrap_or(""));
        all.map(|m| word(m).trim().to_string())
            .filter(|m| !m.contains("DATA"))
            .collect()
    }

    /// The values of a metric that were published for a device, in order, those of history apart.
    fn values(&self, device: &str, name: &str, historical: bool) -> Vec<Json> {
        let messages = self.messages().into_iter().filter(|m| m["device"] == device);
        let metrics = messages.flat_map(|m| m["metrics"].as_array().unwrap());
        let wanted = metrics.filter(|m| m["name"] == name && m["historical"] == historical);
        wanted.map(|m| m["value"].clone()).collect()
    }

    fn metric(&self, kind: &str, device: &str, name: &str) -> Json {
        let of = |m: &&Json| m["type"] == kind && (device.is_empty() || m["device"] == device);
        let messages = self.messages().into_iter().filter(of);
        let mut metrics = messages.flat_map(|m| m["metrics"].as_array().unwrap());
        let found = metrics.find(|m| m["name"] == name);
        found
            .unwrap_or_else(|| panic!("no {name} in a {kind} of {device}"))
            .clone()
    }

    fn bd_seqs(&self, kind: &str) -> Vec<u64> {
        let messages = self.messages().into_iter().filter(|m| m["type"] == kind);
        let number = |m: &Json| m["metrics"][0]["value"].as_u64().unwrap();
        messages.map(number).collect()
    }
}

/// Waits until the published messages are as wanted.
fn wait_seen(what: &str, watcher: &Watcher, wanted: impl Fn(&Seen) -> bool) -> Seen {
    wait_for(what, || {
        let seen = Seen::of(watcher);
        wanted(&seen).then_some(seen)
    })
}

/// Sends a command as a host.
fn command(broker: &Broker, topic: &str, metrics: Json, more: &[&str]) {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    let payload = json!({ "timestamp": now.as_millis() as u64, "metrics": metrics });
    let hex = peer(&["encode", &payload.to_string()], "");
    let hex = hex.trim();
    let bytes: Vec<u8> = (0..hex.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
        .collect();
    let file = broker.dir.path().join("command");
    std::fs::write(&file, bytes).unwrap();
    let file = file.to_str().unwrap();
    let output = broker.run("mosquitto_pub", &[&["-t", topic, "-f", file], more].concat());
    assert!(output.status.success(), "{output:?}");
}

fn go(gateway: &Gateway, drive: &str, online: bool) {
    gateway.plant.load().drive(drive).unwrap().image.update(|s| {
        s.link = if online {
            Link::Online(SystemTime::now())
        } else {
            Link::Offline(SystemTime::now())
        };
    });
}

fn state_message(online: bool, timestamp: u64) -> String {
    json!({ "online": online, "timestamp": timestamp }).to_string()
}

#[test]
fn a_session_keeps_the_rules_of_the_specification() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1", "m1"]));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/m1");
    gateway.read("p1", 3000);
    watcher.wait("data", |m| m.topic == "spBv1.0/plant/DDATA/pump-house/p1");
    go(&gateway, "m1", false);
    watcher.wait("a death", |m| m.topic == "spBv1.0/plant/DDEATH/pump-house/m1");
    watcher.wait("data of the node", |m| m.topic == "spBv1.0/plant/NDATA/pump-house");
    go(&gateway, "m1", true);
    watcher.wait_count("spBv1.0/plant/DBIRTH/pump-house/m1", 2);
    let asks = json!([{ "name": "Node Control/Rebirth", "type": "Boolean", "value": true }]);
    command(&broker, NODE, asks, &[]);
    watcher.wait_count("spBv1.0/plant/DBIRTH/pump-house/m1", 3);
    gateway.stop();
    watcher.wait("the end", |m| m.topic == "spBv1.0/plant/NDEATH/pump-house");

    let seen = Seen::of(&watcher);
    seen.keeps(&[
        "topic-structure-namespace-a",
        "topics-nbirth-topic",
        "topics-nbirth-mqtt",
        "topics-nbirth-seq-num",
        "topics-nbirth-timestamp",
        "topics-nbirth-bdseq-included",
        "topics-nbirth-bdseq-matching",
        "topics-nbirth-rebirth-metric",
        "topics-nbirth-metric-reqs",
        "topics-dbirth-mqtt",
        "topics-dbirth-metric-reqs",
        "topics-ndata-mqtt",
        "topics-ddata-mqtt",
        "topics-ddeath-mqtt",
        "topics-ndeath-payload",
        "payloads-nbirth-bdseq-repeat",
        "payloads-nbirth-rebirth-req",
        "payloads-nbirth-qos",
        "payloads-nbirth-retain",
        "payloads-dbirth-order",
        "payloads-dbirth-seq-inc",
        "payloads-ndata-seq-inc",
        "payloads-ddata-order",
        "payloads-ddata-seq-inc",
        "payloads-ddeath-seq-inc",
        "payloads-ndeath-seq",
        "payloads-ndeath-bdseq",
        "payloads-ndeath-will-message-qos",
        "payloads-ndeath-will-message-retain",
        "payloads-alias-uniqueness",
        "payloads-alias-birth-requirement",
        "payloads-alias-data-cmd-requirement",
        "payloads-name-birth-data-requirement",
        "payloads-metric-datatype-req",
        "payloads-propertyset-quality-value-type",
        "payloads-propertyset-quality-value-value",
        "operational-behavior-data-commands-rebirth-name",
        "operational-behavior-data-commands-rebirth-name-aliases",
        "operational-behavior-data-commands-rebirth-action-3",
        "operational-behavior-data-publish-nbirth-values",
        "operational-behavior-data-publish-dbirth-values",
        "message-flow-edge-node-birth-publish-nbirth-payload-bdSeq",
        "message-flow-edge-node-birth-publish-nbirth-payload-seq",
        "message-flow-edge-node-birth-publish-will-message-qos",
    ]);
    let expected = [
        "NBIRTH",
        "DBIRTH p1",
        "DBIRTH m1",
        "DDEATH m1",
        "DBIRTH m1",
        "NBIRTH",
        "DBIRTH p1",
        "DBIRTH m1",
        "NDEATH",
    ];
    assert_eq!(seen.births_and_deaths(), expected);
    let frequency = seen.metric("DBIRTH", "p1", "output_frequency");
    assert_eq!(
        (&frequency["value"], &frequency["type"]),
        (&json!(25), &json!("Double"))
    );
    assert_eq!(frequency["properties"], json!({ "Quality": 192, "engUnit": "Hz" }));
    let reference = seen.metric("DBIRTH", "p1", "speed_reference");
    assert_eq!(
        (&reference["properties"]["engLow"], &reference["properties"]["engHigh"]),
        (&json!(0), &json!(80))
    );
    let unknown = seen.metric("DBIRTH", "p1", "heatsink_temperature");
    assert_eq!(
        (&unknown["value"], &unknown["properties"]["Quality"]),
        (&json!(null), &json!(0))
    );
    assert_eq!(seen.values("p1", "output_frequency", false), [25, 30, 30]);
    assert_eq!(seen.metric("NBIRTH", "", "Bus/line1/state")["value"], "up");
    assert_eq!(seen.metric("NDATA", "", "Bus/line1/online")["value"], 1);
}

#[test]
fn a_device_command_is_an_order_like_any_other() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    let plain = Watcher::new(&broker, "drivegate/#");
    let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1", "m1"]));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/m1");
    let run = json!([
        { "name": "run", "type": "Boolean", "value": true },
        { "name": "speed_reference", "type": "Float", "value": 33.3 },
    ]);
    command(&broker, P1, run, &[]);
    let seen = wait_seen("the result", &watcher, |seen| {
        seen.values("p1", "command_result", false).last() == Some(&json!("acknowledged"))
    });
    seen.keeps(&[]);
    let orders = gateway.ordered();
    let expected = [
        ("run".to_string(), Value::Bool(true)),
        ("speed_reference".to_string(), Value::Number(33.3)),
    ];
    assert_eq!((orders.len(), orders[0].1.as_slice()), (1, expected.as_slice()));
    let record = gateway.plant.load().command_log.audit().recent(None).pop().unwrap();
    let record: serde_json::Value = serde_json::from_str(&record).unwrap();
    assert_eq!(
        (&record["source"], &record["client"]),
        (&"sparkplug".into(), &P1.into())
    );

    // Refused: outside the limits, only monitored, retained. The drive's own values are published again.
    let references = seen.values("p1", "speed_reference", false).len();
    command(
        &broker,
        P1,
        json!([{ "name": "speed_reference", "type": "Double", "value": 80.1 }]),
        &[],
    );
    let seen = wait_seen("the refusal", &watcher, |seen| {
        seen.values("p1", "command_result", false).last() == Some(&json!("bad_value"))
    });
    let told = seen.values("p1", "speed_reference", false);
    assert!(told.len() > references && told.last() == told.first(), "{told:?}");
    let why = seen.values("p1", "command_error", false).last().cloned().unwrap();
    assert!(why.as_str().unwrap().contains("outside the limits 0 to 80"), "{why}");
    plain.wait("the event", |m| {
        m.topic == "drivegate/hall/drive/p1/event" && m.payload.contains("refused_command")
    });
    let monitored = P1.replace("p1", "m1");
    command(
        &broker,
        &monitored,
        json!([{ "name": "run", "type": "Boolean", "value": true }]),
        &[],
    );
    wait_seen("the refusal", &watcher, |seen| {
        seen.values("m1", "command_result", false).last() == Some(&json!("not_allowed"))
    });
    command(
        &broker,
        P1,
        json!([{ "name": "run", "type": "Boolean", "value": true }]),
        &["-r"],
    );
    wait_seen("the refusal", &watcher, |seen| {
        seen.values("p1", "command_result", false).last() == Some(&json!("not_allowed"))
    });
    assert_eq!(gateway.ordered().len(), 1);
    gateway.stop();
    Seen::of(&watcher).keeps(&["payloads-ddata-seq-inc"]);
}

#[test]
fn without_commands_nothing_is_commanded() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    let options = drivegate_mqtt::Options {
        commands: false,
        ..options(broker.port, state.path())
    };
    let gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p1");
    command(
        &broker,
        P1,
        json!([{ "name": "run", "type": "Boolean", "value": true }]),
        &[],
    );
    // A rebirth requested afterwards shows that the messages before it were received.
    let asks = json!([{ "name": "Node Control/Rebirth", "type": "Boolean", "value": true }]);
    command(&broker, NODE, asks, &[]);
    watcher.wait_count("spBv1.0/plant/DBIRTH/pump-house/p1", 2);
    assert_eq!(gateway.ordered().len(), 0);
    let seen = Seen::of(&watcher);
    assert!(seen.values("p1", "command_result", false).is_empty());
    gateway.stop();
}

#[test]
fn a_killed_gateway_is_declared_dead_and_counts_on() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    for count in 1..=3 {
        let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1"]));
        watcher.wait_count("spBv1.0/plant/DBIRTH/pump-house/p1", count);
        gateway.kill();
        watcher.wait_count("spBv1.0/plant/NDEATH/pump-house", count);
    }
    let seen = Seen::of(&watcher);
    seen.keeps(&["topics-nbirth-bdseq-increment", "payloads-nbirth-bdseq-repeat"]);
    assert_eq!(
        (seen.bd_seqs("NBIRTH"), seen.bd_seqs("NDEATH")),
        (vec![0, 1, 2], vec![0, 1, 2])
    );
}

#[test]
fn what_the_outage_held_comes_afterwards() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let line = CutLine::to(broker.port);
    let watcher = watcher(&broker);
    let gateway = Gateway::start(options(line.port, state.path()), plant(&["p1"]));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p1");
    let mut outages = 0;
    let seen = wait_for("all values of an outage", || {
        outages += 1;
        line.cut();
        watcher.wait_count("spBv1.0/plant/NDEATH/pump-house", outages);
        for frequency in [1000, 2000, 3000] {
            gateway.read("p1", frequency);
            // A change that comes too soon after another one is not recorded; the next outage is slower.
            std::thread::sleep(Duration::from_millis(100) * u32::try_from(outages).unwrap());
        }
        line.mend();
        watcher.wait_count("spBv1.0/plant/DBIRTH/pump-house/p1", outages + 1);
        gateway.read("p1", 4000);
        let seen = wait_seen("the value of now", &watcher, |seen| {
            seen.values("p1", "output_frequency", false).last() == Some(&json!(40))
        });
        let past = seen.values("p1", "output_frequency", true);
        past.ends_with(&[json!(10), json!(20), json!(30)]).then_some(seen)
    });
    seen.keeps(&["topics-nbirth-bdseq-increment", "payloads-ddata-order"]);
    gateway.stop();
}

#[test]
fn a_broker_that_was_killed_gets_a_new_session() {
    let (mut broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1"]));
    gateway.wait_connected(true);
    for _ in 0..2 {
        broker.kill();
        broker.up();
        let watcher = watcher(&broker);
        let asks = json!([{ "name": "Node Control/Rebirth", "type": "Boolean", "value": true }]);
        wait_for("births", || {
            command(&broker, NODE, asks.clone(), &[]);
            let born = watcher
                .all()
                .iter()
                .any(|m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p1");
            born.then_some(())
        });
        Seen::of(&watcher).keeps(&["payloads-nbirth-bdseq"]);
    }
    gateway.stop();
}

#[test]
fn the_primary_host_is_waited_for() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    broker.publish(STATE, &state_message(false, 1_000), &["-r"]);
    let mut options = options(broker.port, state.path());
    if let Some(node) = &mut options.sparkplug {
        node.primary_host = "scada".to_string();
    }
    let gateway = Gateway::start(options, plant(&["p1"]));
    gateway.wait_connected(true);
    // Neither a message for another host nor an older message has an effect.
    broker.publish("spBv1.0/STATE/other", &state_message(true, 2_000), &["-r"]);
    broker.publish(STATE, &state_message(true, 999), &[]);
    assert!(Seen::of(&watcher).messages().is_empty(), "nothing before the host");
    broker.publish(STATE, &state_message(true, 2_000), &["-r"]);
    let seen = wait_seen("births and history", &watcher, |seen| {
        seen.values("p1", "output_frequency", true).contains(&json!(25))
    });
    assert_eq!(seen.births_and_deaths(), ["NBIRTH", "DBIRTH p1"]);
    broker.publish(STATE, &state_message(false, 3_000), &["-r"]);
    watcher.wait("the death", |m| m.topic == "spBv1.0/plant/NDEATH/pump-house");
    gateway.read("p1", 1200);
    broker.publish(STATE, &state_message(true, 4_000), &["-r"]);
    watcher.wait_count("spBv1.0/plant/DBIRTH/pump-house/p1", 2);
    gateway.stop();
    watcher.wait_count("spBv1.0/plant/NDEATH/pump-house", 2);
    let seen = Seen::of(&watcher);
    seen.keeps(&["payloads-nbirth-bdseq-repeat"]);
    assert_eq!(
        seen.births_and_deaths(),
        ["NBIRTH", "DBIRTH p1", "NDEATH", "NBIRTH", "DBIRTH p1", "NDEATH"]
    );
}

#[test]
fn a_reload_bears_the_node_anew() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1", "p2"]));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p2");
    gateway.plant.store(Arc::new(plant(&["p2", "p3"])));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p3");
    gateway.stop();
    watcher.wait("the end", |m| m.topic == "spBv1.0/plant/NDEATH/pump-house");
    let seen = Seen::of(&watcher);
    seen.keeps(&["payloads-alias-uniqueness"]);
    let expected = [
        "NBIRTH",
        "DBIRTH p1",
        "DBIRTH p2",
        "DDEATH p1",
        "NBIRTH",
        "DBIRTH p2",
        "DBIRTH p3",
        "NDEATH",
    ];
    assert_eq!(seen.births_and_deaths(), expected);
}

#[test]
fn a_cleared_command_is_no_refused_command() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    let run = json!([{ "name": "run", "type": "Boolean", "value": true }]);
    command(&broker, P1, run, &["-r"]);
    let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1"]));
    let results = |seen: &Seen| {
        seen.values("p1", "command_result", false)
            .into_iter()
            .filter(|r| r != "")
            .count()
    };
    wait_seen("the refusal of the retained command", &watcher, |seen| {
        results(seen) == 1
    });
    assert!(broker.run("mosquitto_pub", &["-t", P1, "-r", "-n"]).status.success());
    let stop = json!([{ "name": "run", "type": "Boolean", "value": false }]);
    command(&broker, P1, stop, &[]);
    wait_for("the stop", || (!gateway.ordered().is_empty()).then_some(()));
    let seen = wait_seen("its result", &watcher, |seen| results(seen) >= 2);
    let codes = seen.values("p1", "command_result", false);
    let refused = codes.iter().filter(|code| *code == "not_allowed").count();
    assert_eq!(refused, 1, "{codes:?}");
    gateway.stop();
}

#[test]
fn a_host_of_version_2_is_taken_for_online_too() {
    let (broker, state) = (Broker::start(), tempfile::tempdir().unwrap());
    let watcher = watcher(&broker);
    let mut options = options(broker.port, state.path());
    options.sparkplug.as_mut().unwrap().primary_host = "scada".to_string();
    let gateway = Gateway::start(options, plant(&["p1"]));
    gateway.wait_connected(true);
    broker.publish("STATE/scada", "ONLINE", &["-r"]);
    watcher.wait("the birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p1");
    broker.publish("STATE/scada", "OFFLINE", &["-r"]);
    watcher.wait("the death", |m| m.topic == "spBv1.0/plant/NDEATH/pump-house");
    gateway.stop();
}

#[test]
fn births_that_are_too_large_for_the_broker_lack_their_last_metrics() {
    let broker = Broker::with("allow_anonymous true\nmax_packet_size 600\n");
    let (watcher, state) = (watcher(&broker), tempfile::tempdir().unwrap());
    let gateway = Gateway::start(options(broker.port, state.path()), plant(&["p1"]));
    watcher.wait("a birth", |m| m.topic == "spBv1.0/plant/DBIRTH/pump-house/p1");
    gateway.read("p1", 3000);
    watcher.wait("data", |m| m.topic == "spBv1.0/plant/DDATA/pump-house/p1");
    let seen = Seen::of(&watcher);
    // Data that the birth does not name would break a rule.
    seen.keeps(&[
        "topics-nbirth-metric-reqs",
        "topics-dbirth-metric-reqs",
        "payloads-ddata-seq-inc",
    ]);
    let births = seen.births_and_deaths();
    assert_eq!(births, ["NBIRTH", "DBIRTH p1"], "one connection");
    gateway.stop();
}
