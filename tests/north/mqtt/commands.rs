//! Commands on the set topics.

use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_model::drive::Value;
use drivegate_testkit::rows;

use super::bench::*;

const SET: &str = "drivegate/hall/drive/p1/set";
const RESULT: &str = "drivegate/hall/drive/p1/result";
const EVENT: &str = "drivegate/hall/drive/p1/event";

struct CommandedGateway {
    broker: Broker,
    gateway: Gateway,
    watcher: Watcher,
}

/// Drives `p1`, which may be commanded, and `m1`, which may not; the client is connected.
fn rig() -> CommandedGateway {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "#");
    let gateway = Gateway::start(options(broker.port), plant(&["p1", "m1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    CommandedGateway {
        broker,
        gateway,
        watcher,
    }
}

impl CommandedGateway {
    /// The result of one message.
    fn result(&self, topic: &str, payload: &str, more: &[&str]) -> serde_json::Value {
        self.watcher.clear();
        self.broker.publish(topic, payload, more);
        let result = self.watcher.wait("the result", |m| m.topic.ends_with("/result"));
        assert!(!result.retain && result.qos == 1);
        result.json()
    }
}

#[test]
fn an_object_becomes_one_order() {
    let rig = rig();
    let result = rig.result(SET, r#"{"id": "a7", "run": true, "speed_reference": 50}"#, &[]);
    assert_eq!((&result["id"], &result["ok"]), (&"a7".into(), &true.into()));
    assert_eq!(result["result"], "acknowledged");
    assert!(result["latency_ms"].as_f64().is_some_and(|ms| ms >= 0.0) && result.get("error").is_none());
    let orders = rig.gateway.ordered();
    assert_eq!(orders.len(), 1, "one command: {orders:?}");
    let expected = [
        ("run".to_string(), Value::Bool(true)),
        ("speed_reference".to_string(), Value::Number(50.0)),
    ];
    assert_eq!((orders[0].0, orders[0].1.as_slice()), (0, expected.as_slice()));
    assert!(orders[0].2 <= Duration::from_secs(2), "2 s by default");
    rig.gateway.stop();
}

#[test]
fn bare_values_set_one_point() {
    let rig = rig();
    for (point, payload, value) in [
        ("run", "true", Value::Bool(true)),
        ("run", "0", Value::Bool(false)),
        ("fault_reset", "1", Value::Bool(true)),
        ("speed_reference", "33.3", Value::Number(33.3)),
    ] {
        let result = rig.result(&format!("{SET}/{point}"), payload, &[]);
        assert_eq!((&result["ok"], &result["id"]), (&true.into(), &serde_json::Value::Null));
        assert_eq!(rig.gateway.ordered().last().unwrap().1, [(point.to_string(), value)]);
    }
    rig.gateway.stop();
}

#[test]
fn messages_of_a_topic_keep_their_order() {
    let rig = rig();
    let run = format!("{SET}/run");
    let pairs = ["true", "false"].repeat(40);
    rig.gateway.while_held(|| rig.broker.publish_all(&run, &pairs));
    rig.watcher.wait_count(RESULT, 80);
    let orders: Vec<bool> = rig
        .gateway
        .ordered()
        .iter()
        .map(|order| order.1[0].1.as_bool())
        .collect();
    assert_eq!(
        orders.last(),
        Some(&false),
        "the last one published was a stop: {orders:?}"
    );
    assert!(
        !orders.windows(2).any(|pair| pair == [true, true]),
        "each run had its stop: {orders:?}"
    );
    rig.gateway.stop();
}

#[test]
fn references_of_a_topic_keep_their_order() {
    let rig = rig();
    let values: Vec<String> = (1..=79).map(|percent| percent.to_string()).collect();
    let payloads: Vec<&str> = values.iter().map(String::as_str).collect();
    let topic = format!("{SET}/speed_reference");
    rig.gateway.while_held(|| rig.broker.publish_all(&topic, &payloads));
    rig.watcher.wait_count(RESULT, 79);
    let written: Vec<f64> = rig
        .gateway
        .ordered()
        .iter()
        .filter_map(|order| match order.1[0].1 {
            Value::Number(percent) => Some(percent),
            _ => None,
        })
        .collect();
    assert!(written.is_sorted(), "{written:?}");
    assert_eq!(
        written.last(),
        Some(&79.0),
        "the last one published is the last one written"
    );
    rig.gateway.stop();
}

#[test]
fn a_response_topic_gets_the_result_with_its_correlation() {
    let rig = rig();
    let output = rig.broker.run(
        "mosquitto_rr",
        &[
            "-t",
            SET,
            "-e",
            "clients/7/answers",
            "-m",
            r#"{"id": 9, "run": true}"#,
            "-D",
            "PUBLISH",
            "correlation-data",
            "c-0815",
            "-F",
            "%t|%D|%p",
            "-W",
            "10",
        ],
    );
    let text = String::from_utf8(output.stdout).unwrap();
    let parts: Vec<&str> = text.trim().splitn(3, '|').collect();
    assert_eq!(parts[..2], ["clients/7/answers", "c-0815"], "{text}");
    let result: serde_json::Value = serde_json::from_str(parts[2]).unwrap();
    assert_eq!((&result["id"], &result["ok"]), (&9.into(), &true.into()));
    rig.watcher.wait("the answer", |m| m.topic == "clients/7/answers");
    assert!(rig.watcher.payloads(RESULT).is_empty(), "it goes there, not here");
    rig.gateway.stop();
}

#[test]
fn expiry_by_field_and_by_message() {
    let rig = rig();
    rig.result(SET, r#"{"run": true, "expires_ms": 30000}"#, &[]);
    let life = rig.gateway.ordered().last().unwrap().2;
    assert!(life > Duration::from_secs(3), "{life:?}");
    rig.result(
        SET,
        r#"{"run": true, "expires_ms": 30000}"#,
        &["-D", "PUBLISH", "message-expiry-interval", "3"],
    );
    let life = rig.gateway.ordered().last().unwrap().2;
    assert!(life <= Duration::from_secs(3), "{life:?}");
    rig.gateway.stop();
}

/// Columns: topic below `drivegate/hall/drive`, payload, code of the refusal, and a part of its text.
const REFUSED: &str = r#"p1/set                 | run                             | bad_value    | is not JSON
p1/set                 |                                 | bad_value    | is not JSON
p1/set                 | [true]                          | bad_value    | is not a JSON object
p1/set                 | {}                              | bad_value    | names no point
p1/set                 | {"sped_reference": 10}          | not_writable | did you mean `speed_reference`?
p1/set                 | {"run": true, "ready": true}    | not_writable | `ready` is read-only
p1/set                 | {"speed_reference": "10"}       | bad_value    | remove the quotes
p1/set                 | {"speed_reference": 80.1}       | bad_value    | outside the limits 0 to 80
p1/set                 | {"speed_reference": NaN}        | bad_value    | is not JSON
p1/set                 | {"run": true, "expires_ms": -1} | bad_value    | `expires_ms` = -1
p1/set/speed_reference | nan                             | bad_value    | not true, false or a number
p1/set/spedreference   | 1                               | not_writable | did you mean
m1/set                 | {"run": true}                   | not_allowed  | only monitored"#;

#[test]
fn what_is_wrong_is_refused_and_told_and_nothing_is_written() {
    let rig = rig();
    let long = format!(r#"{{"run": true, "id": "{}"}}"#, "x".repeat(70_000));
    let file = rig.broker.dir.path().join("long");
    std::fs::write(&file, long).unwrap();
    for [topic, payload, code, text] in rows(REFUSED) {
        let topic = &format!("drivegate/hall/drive/{topic}");
        let result = rig.result(topic, payload, &[]);
        assert_eq!(result["ok"], false);
        assert_eq!(result["error"]["code"], code, "{payload}: {result}");
        let message = result["error"]["message"].as_str().unwrap();
        assert!(message.contains(text), "{payload}: {message}");
        let event = rig.watcher.wait("the event", |m| m.topic.ends_with("/event"));
        assert_eq!(event.json()["event"], "refused_command");
        assert!(event.json()["text"].as_str().unwrap().contains(topic));
    }
    let unknown = rig.result("drivegate/hall/drive/p2/set", r#"{"run": true}"#, &[]);
    assert_eq!(
        (&unknown["error"]["code"], &unknown["drive"]),
        (&"unknown_drive".into(), &"p2".into())
    );
    rig.watcher.clear();
    let output = rig
        .broker
        .run("mosquitto_pub", &["-q", "1", "-t", SET, "-f", file.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    let result = rig.watcher.wait("the result", |m| m.topic == RESULT).json();
    assert!(
        result["error"]["message"]
            .as_str()
            .unwrap()
            .contains("65536 are allowed"),
        "{result}"
    );
    assert_eq!(rig.gateway.ordered(), []);
    rig.gateway.stop();
}

#[test]
fn retained_messages_are_never_commands() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "#");
    // The message is retained before the gateway connects.
    broker.publish(SET, r#"{"id": 1, "run": true}"#, &["-r"]);
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    let event = watcher.wait("the first event", |m| m.topic == EVENT).json();
    assert_eq!(event["event"], "refused_command");
    assert!(event["text"].as_str().unwrap().contains("retained"), "{event}");
    // The message is retained while the gateway is connected.
    watcher.clear();
    broker.publish("drivegate/hall/drive/p1/set/run", "true", &["-r"]);
    watcher.wait("the second event", |m| {
        m.topic == EVENT && m.payload.contains("retained")
    });
    // The command is retained when the gateway connects again.
    watcher.clear();
    gateway.stop();
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    wait_for("both to be refused again", || {
        (watcher.payloads(EVENT).len() == 2).then_some(())
    });
    // Clearing a retained message is not a command, either; a real command still works.
    watcher.clear();
    let cleared = broker.run("mosquitto_pub", &["-q", "1", "-t", SET, "-r", "-n"]);
    assert!(cleared.status.success());
    broker.publish("drivegate/hall/drive/p1/set/run", "false", &[]);
    watcher.wait("the result", |m| m.topic == RESULT && m.payload.contains("\"ok\":true"));
    assert_eq!(watcher.payloads(EVENT).len(), 0);
    let orders = gateway.ordered();
    assert_eq!(orders.len(), 1);
    assert_eq!(orders[0].1, [("run".to_string(), Value::Bool(false))]);
    gateway.stop();
}

#[test]
fn without_commands_nothing_is_listened_to() {
    let broker = Broker::start();
    let watcher = Watcher::new(&broker, "#");
    let mut options = options(broker.port);
    options.commands = false;
    let gateway = Gateway::start(options, plant(&["p1"]));
    watcher.wait_payload("drivegate/hall/status", "online");
    broker.publish(SET, r#"{"run": true}"#, &[]);
    broker.publish(&format!("{SET}/run"), "true", &[]);
    // An event published afterwards arrives: an answer to the commands would have arrived before it.
    gateway.publish_event("p1", EventKind::Online, "afterwards");
    watcher.wait("the event", |m| m.payload.contains("afterwards"));
    assert_eq!((gateway.ordered().len(), watcher.payloads(RESULT).len()), (0, 0));
    assert_eq!(watcher.payloads(EVENT).len(), 1);
    gateway.stop();
}

#[test]
fn many_commands_are_all_answered() {
    let rig = rig();
    let lines: String = (0..200).map(|n| format!("{{\"id\": {n}, \"run\": true}}\n")).collect();
    let file = rig.broker.dir.path().join("lines");
    std::fs::write(&file, lines).unwrap();
    let port = rig.broker.port.to_string();
    let mut child = std::process::Command::new("mosquitto_pub")
        .args(["-V", "5", "-h", "127.0.0.1", "-p", &port, "-q", "1", "-t", SET, "-l"])
        .stdin(std::fs::File::open(&file).unwrap())
        .spawn()
        .unwrap();
    assert!(child.wait().unwrap().success());
    let results = rig.watcher.wait_count(RESULT, 200);
    let mut ids: Vec<u64> = results.iter().map(|r| r.json()["id"].as_u64().unwrap()).collect();
    ids.sort_unstable();
    assert_eq!(ids, (0..200).collect::<Vec<_>>());
    let done = results.iter().filter(|r| r.json()["ok"] == true).count();
    assert_eq!(rig.gateway.ordered().len(), done, "one order for each that was taken");
    rig.gateway.stop();
}

#[test]
fn a_flood_of_refused_commands_is_answered_to_the_last() {
    let broker = Broker::with("allow_anonymous true\nmax_queued_messages 0\n");
    let watcher = Watcher::new(&broker, RESULT);
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    gateway.wait_connected(true);
    let payloads: Vec<String> = (0..8000).map(|n| format!("{{\"id\": {n}, \"sped\": 1}}")).collect();
    let payloads: Vec<&str> = payloads.iter().map(String::as_str).collect();
    broker.publish_all(SET, &payloads);
    let results = watcher.wait_count(RESULT, 8000);
    let ids: Vec<u64> = results.iter().map(|r| r.json()["id"].as_u64().unwrap()).collect();
    assert_eq!(ids, (0..8000).collect::<Vec<_>>());
    gateway.stop();
}

#[test]
fn ids_and_commands_that_are_too_large_come_back() {
    let rig = rig();
    let big = "123456789012345678901234567890";
    rig.broker.publish(SET, &format!("{{\"id\": {big}, \"sped\": 1}}"), &[]);
    let seen = rig.watcher.wait("the result", |m| m.topic == RESULT);
    assert!(seen.payload.contains(&format!("\"id\":{big},")), "{seen:?}");
    rig.watcher.clear();
    let file = rig.broker.dir.path().join("large");
    std::fs::write(&file, format!("{{\"id\": 77, \"pad\": \"{}\"}}", "x".repeat(1 << 20))).unwrap();
    let arguments = ["-q", "1", "-t", SET, "-f", file.to_str().unwrap()];
    assert!(rig.broker.run("mosquitto_pub", &arguments).status.success());
    let result = rig.watcher.wait("the result", |m| m.topic == RESULT).json();
    assert_eq!(
        (&result["id"], &result["error"]["code"]),
        (&77.into(), &"bad_value".into())
    );
    rig.gateway.stop();
}
