use drivegate_testkit::{audited, next_command};
use std::time::Duration;

use serde_json::Value as Json;

use super::super::fixture;
use super::*;
use drivegate_core::order::{Arrival, Order, Outcome, Receipt, Urgency};
use drivegate_model::drive::Value;
use drivegate_north::command_json::REMEMBERED;
use drivegate_proto::Reply as BusReply;

struct SetTopics {
    plant: Plant,
    commands: Commands,
    memory: SharedMemory,
    stop_all: Arc<StopAll>,
    now: Instant,
    events: tokio::sync::broadcast::Receiver<Arc<drivegate_core::event::Event>>,
}

impl SetTopics {
    fn new() -> SetTopics {
        let plant = fixture::plant(&["p1"]);
        fixture::read(&plant, "p1", 1, 0, Instant::now());
        let (memory, stop_all) = (SharedMemory::default(), Arc::<StopAll>::default());
        SetTopics {
            events: plant.events.subscribe(),
            commands: commands(&memory, &stop_all),
            memory,
            stop_all,
            now: Instant::now(),
            plant,
        }
    }

    /// Replaces the client, as a reload does.
    fn reload_client(&mut self) {
        self.commands = commands(&self.memory, &self.stop_all);
    }

    /// Replaces the client, as a reload does; the new client continues with the state that the old client left.
    fn succeed_client(&mut self) {
        let earlier_names = self.commands.earlier_names.clone();
        let after = |left| {
            let topics = Topics::new("drivegate", "hall");
            Commands::new(
                topics,
                rules(false),
                self.memory.clone(),
                (self.stop_all.clone(), earlier_names.clone()),
                Some(left),
            )
        };
        let before = std::mem::replace(&mut self.commands, after(OrdersLeft::default()));
        self.commands = after(before.leave(Vec::new()));
    }

    /// Replaces the bus, as a reload does.
    fn reload_bus(&mut self) {
        let stopped = std::mem::replace(&mut self.plant.buses, fixture::plant(&["p1"]).buses);
        self.plant.buses[0].take_over(&stopped, self.now);
        fixture::read(&self.plant, "p1", 1, 0, self.now);
    }

    /// A reload removes the bus, a later one adds it again.
    fn remove_and_add(&mut self) {
        self.plant = fixture::plant(&["p1"]);
        self.plant.buses[0].take_over(&[], self.now);
        fixture::read(&self.plant, "p1", 1, 0, self.now);
    }

    fn take(&mut self, incoming: Incoming) -> Option<Message> {
        self.commands
            .take(incoming, &self.plant, |_| false, self.now, SystemTime::UNIX_EPOCH)
    }

    fn queued(&self) -> usize {
        self.plant.buses.iter().map(|bus| bus.queue.lock().len()).sum()
    }

    fn finished(&mut self) -> Option<Json> {
        let ended = self.commands.try_finished()?;
        Some(json(&self.commands.answer(ended, SystemTime::UNIX_EPOCH)))
    }

    /// Lets the drive acknowledge the next command; no read has shown its effect yet.
    fn take_order(&self) -> Option<(Order, Receipt)> {
        let pop = |bus: &drivegate_core::plant::BusHandle| next_command(&mut bus.queue.lock(), Urgency::Read, self.now);
        let command = self.plant.buses.iter().find_map(pop)?;
        let outcome = Outcome::Acknowledged(BusReply::Written);
        Some((command.intent.order, command.ticket.acknowledge(outcome, self.now)))
    }

    /// The result of the next command, which the drive acknowledges but never shows.
    fn acknowledge(&mut self) -> Json {
        drop(self.take_order().unwrap());
        self.finished().unwrap()
    }
}

fn commands(memory: &SharedMemory, stop_all: &Arc<StopAll>) -> Commands {
    Commands::new(
        Topics::new("drivegate", "hall"),
        rules(false),
        memory.clone(),
        (stop_all.clone(), Arc::default()),
        None,
    )
}

fn rules(require_id: bool) -> Rules {
    Rules {
        responses: ResponseTopics::new("drivegate", "hall", Vec::new()),
        require_id,
        right: Right::lasting(),
    }
}

fn json(message: &Message) -> Json {
    serde_json::from_slice(&message.payload).unwrap()
}

fn set(topic: &str, payload: &str) -> Incoming {
    Incoming {
        topic: format!("drivegate/hall/drive/{topic}"),
        payload: payload.into(),
        packet: 1,
        ..Incoming::default()
    }
}

#[test]
fn a_command_is_executed_and_answered() {
    let mut bench = SetTopics::new();
    assert_eq!(bench.take(set("p1/set", r#"{"id": 5, "run": true}"#)), None);
    let result = bench.acknowledge();
    assert_eq!(result["id"], 5);
    assert_eq!(
        (&result["ok"], &result["result"]),
        (&true.into(), &"acknowledged".into())
    );
    assert!(result["latency_ms"].is_number() && result.get("error").is_none());
    assert!(bench.commands.is_idle());
}

/// A client whose `commands` a reload disabled still receives messages that were on their way.
#[test]
fn what_was_on_its_way_when_the_right_went_is_refused() {
    use std::sync::atomic::{AtomicBool, Ordering};
    let mut bench = SetTopics::new();
    let right = Arc::new(AtomicBool::new(true));
    bench.commands.rules.right = Right::of(right.clone());
    assert_eq!(bench.take(set("p1/set", r#"{"id": 1, "speed_reference": 20}"#)), None);
    assert_eq!(bench.queued(), 1);
    right.store(false, Ordering::Release);
    for payload in [
        r#"{"id": 2, "run": true}"#,
        r#"{"id": 3, "speed_reference": 9}"#,
        r#"{"id": 4, "run": false}"#,
    ] {
        let result = json(&bench.take(set("p1/set", payload)).unwrap());
        assert_eq!(result["error"]["code"], "not_allowed", "{result}");
    }
    let stop_all = Incoming {
        topic: "drivegate/hall/set/stop".to_string(),
        ..Incoming::default()
    };
    let refused = json(&bench.take(stop_all).unwrap());
    assert!(
        refused["error"]
            .as_str()
            .unwrap()
            .contains("a reload removed its right"),
        "{refused}"
    );
    assert_eq!(bench.queued(), 1);
}

#[test]
fn a_response_topic_gets_the_result_and_the_correlation() {
    let mut bench = SetTopics::new();
    let request = Incoming {
        response_topic: Some("client/7".to_string()),
        correlation: Some(vec![1, 0, 255]),
        ..set("p1/set", "no")
    };
    let result = bench.take(request.clone()).unwrap();
    assert_eq!(
        (result.topic.as_ref(), result.correlation),
        ("client/7", Some(vec![1, 0, 255]))
    );
    for bad in ["", "a/+", "#", "a\0b"] {
        let request = Incoming {
            response_topic: Some(bad.to_string()),
            ..request.clone()
        };
        let result = bench.take(request).unwrap();
        assert_eq!(result.topic.as_ref(), "drivegate/hall/drive/p1/result", "{bad:?}");
        assert_eq!(result.correlation, None);
    }
}

#[test]
fn refusals_are_reported_audited_and_answered_and_nothing_is_queued() {
    let mut bench = SetTopics::new();
    for (incoming, code) in [
        (set("p1/set", "{"), "bad_value"),
        (set("p1/set", r#"{"ready": true}"#), "not_writable"),
        (
            Incoming {
                retain: true,
                ..set("p1/set", r#"{"run": true}"#)
            },
            "not_allowed",
        ),
    ] {
        let result = json(&bench.take(incoming).unwrap());
        assert_eq!((&result["ok"], &result["error"]["code"]), (&false.into(), &code.into()));
        assert!(!result["error"]["message"].as_str().unwrap().is_empty());
        let event = bench.events.try_recv().unwrap();
        assert_eq!(event.kind, drivegate_core::event::EventKind::RefusedCommand);
    }
    assert_eq!(bench.queued(), 0);
    assert_eq!(bench.plant.command_log.results().values().sum::<u64>(), 3);
    let result = json(&bench.take(set("p11/set", r#"{"id": 21, "run": true}"#)).unwrap());
    assert_eq!(
        (&result["error"]["code"], &result["id"]),
        (&"unknown_drive".into(), &21.into())
    );
    let unknown = (drivegate_core::order::SourceKind::Mqtt, "unknown_drive");
    assert_eq!(bench.plant.command_log.results().get(&unknown), Some(&1));
    let record = audited(bench.plant.command_log.audit()).pop().unwrap();
    assert_eq!(
        (&record["result"], &record["drive"]),
        (&"unknown_drive".into(), &"p11".into())
    );
    assert!(
        result["error"]["message"]
            .as_str()
            .unwrap()
            .contains("did you mean `p1`?")
    );
    let cleared = Incoming {
        retain: true,
        ..set("p1/set", "")
    };
    assert_eq!(bench.take(cleared), None, "clears the retained message");
    assert!(bench.events.try_recv().is_err());
}

#[test]
fn commands_outside_the_limits_are_refused() {
    let mut bench = SetTopics::new();
    let result = json(&bench.take(set("p1/set/speed_reference", "101")).unwrap());
    assert_eq!(result["error"]["code"], "bad_value");
    let result = json(&bench.take(set("p1/set", "{}")).unwrap());
    assert!(result["error"]["message"].as_str().unwrap().contains("names no point"));
    assert!(bench.commands.is_idle());
    assert_eq!(bench.queued(), 0);
}

#[test]
fn a_command_that_waits_over_a_reload_is_answered_once_by_the_client_that_comes_after() {
    let mut bench = SetTopics::new();
    let run = |id: u32| set("p1/set", &format!(r#"{{"id": {id}, "run": true}}"#));
    assert_eq!(bench.take(run(1)), None);
    bench.succeed_client();
    assert_eq!(bench.take(run(1)), None, "it is still to come");
    assert_eq!(bench.queued(), 1);
    let result = bench.acknowledge();
    assert_eq!((&result["id"], &result["ok"]), (&1.into(), &true.into()));
    assert_eq!(bench.finished(), None);
    assert_eq!(json(&bench.take(run(1)).unwrap()), result, "and remembered");
    // A command that was acknowledged, and whose effect has not been read yet.
    assert_eq!(bench.take(run(2)), None);
    let confirmation = bench.take_order().unwrap();
    assert!(bench.commands.try_finished().is_none());
    bench.succeed_client();
    drop(confirmation);
    assert_eq!(bench.finished().unwrap()["id"], 2);
}

#[test]
fn commands_are_queued_in_the_order_of_their_messages() {
    let mut bench = SetTopics::new();
    let set_points = [
        ("run", "1"),
        ("reverse", "0"),
        ("run", "0"),
        ("run", "true"),
        ("fault_reset", "1"),
    ];
    let taken = |bench: &SetTopics| bench.take_order().map(|(order, _)| order);
    for (point, value) in set_points {
        assert_eq!(bench.take(set(&format!("p1/set/{point}"), value)), None);
    }
    let index = |name: &str| {
        let drive = bench.plant.drive("p1").unwrap();
        drive.image.spec.profile.point_index(name).unwrap()
    };
    let bool_of = |name, on| Order::Points(vec![(index(name), drivegate_model::drive::Value::Bool(on))]);
    // The stop is sent first and has removed the commands before it; nothing was polled in between.
    assert_eq!(taken(&bench), Some(bool_of("run", false)));
    assert_eq!(taken(&bench), Some(bool_of("run", true)));
    assert_eq!(taken(&bench), Some(bool_of("fault_reset", true)));
    assert_eq!(taken(&bench), None);
}

#[test]
fn topics_of_one_broker_are_one_client() {
    let mut bench = SetTopics::new();
    for point in ["speed_reference", "run"] {
        bench.take(set(&format!("p1/set/{point}"), "1"));
        let command = next_command(&mut bench.plant.buses[0].queue.lock(), Urgency::Read, bench.now).unwrap();
        assert_eq!(command.ticket.client(), "mqtt");
        assert_eq!(
            command.ticket.origin().who,
            format!("drivegate/hall/drive/p1/set/{point}")
        );
    }
}

/// `buses` lines with 40 drives each that were read.
fn halls(buses: usize) -> (SetTopics, Vec<String>) {
    let names: Vec<String> = (0..buses * 40).map(|i| format!("d{i}")).collect();
    let mut bench = SetTopics::new();
    bench.plant.buses = names
        .chunks(40)
        .flat_map(|chunk| fixture::plant(&chunk.iter().map(String::as_str).collect::<Vec<_>>()).buses)
        .collect();
    for name in &names {
        fixture::read(&bench.plant, name, 1, 0, bench.now);
    }
    (bench, names)
}

#[test]
fn a_thousand_drives_are_stopped_at_once() {
    let (mut bench, names) = halls(25);
    for name in &names {
        assert_eq!(bench.take(set(&format!("{name}/set/run"), "false")), None, "{name}");
    }
    assert_eq!(bench.queued(), 1000);
    while bench.take_order().is_some() {}
    for _ in 0..1000 {
        assert_eq!(bench.finished().unwrap()["result"], "acknowledged");
    }
    assert!(bench.finished().is_none() && bench.commands.is_idle());
}

#[test]
fn commands_waiting_for_confirmation_do_not_block_others() {
    let (mut bench, names) = halls(10);
    let mut receipts = VecDeque::new();
    let mut early = Vec::new();
    for round in 0..4 {
        for (i, name) in names.iter().enumerate() {
            let payload = format!(r#"{{"id": {}, "run": true}}"#, round * names.len() + i);
            assert_eq!(bench.take(set(&format!("{name}/set"), &payload)), None);
            receipts.extend(bench.take_order().map(|(_, receipt)| receipt));
            early.extend(bench.finished());
        }
    }
    let surplus = 4 * names.len() - CONFIRMING.most + 1;
    assert_eq!(early.len(), surplus, "only what goes beyond the bound");
    for (id, result) in early.iter().enumerate() {
        assert_eq!((&result["id"], &result["result"]), (&id.into(), &"acknowledged".into()));
    }
    receipts.drain(..surplus);
    receipts.into_iter().for_each(|receipt| receipt.confirm(bench.now));
    for id in surplus..4 * names.len() {
        let result = bench.finished().unwrap();
        assert_eq!((&result["id"], &result["result"]), (&id.into(), &"confirmed".into()));
    }
    assert!(bench.commands.is_idle());
}

#[test]
fn stops_beyond_the_limit_are_executed_without_a_result() {
    let (mut bench, names) = halls(25);
    let stop = |name: &String| Incoming {
        response_topic: Some("a".repeat(60_000)),
        correlation: Some(vec![0; 60_000]),
        ..set(&format!("{name}/set/run"), "false")
    };
    let all = &names[..200];
    all.iter().for_each(|name| assert_eq!(bench.take(stop(name)), None));
    let executed = std::iter::from_fn(|| bench.take_order()).count();
    let answered = std::iter::from_fn(|| bench.finished()).count();
    let unfollowed = bench.commands.take_unfollowed();
    assert_eq!((executed, answered as u64 + unfollowed), (all.len(), all.len() as u64));
    assert!((50..100).contains(&answered), "{answered}");
    assert!(bench.commands.is_idle());
}

#[test]
fn a_refusal_of_the_queue_has_its_reason() {
    let mut bench = SetTopics::new();
    let results: Vec<Json> = (0..drivegate_core::order::CAPACITY + 2)
        .filter_map(|_| bench.take(set("p1/set/run", "1")))
        .map(|message| json(&message))
        .collect();
    assert_eq!(results.len(), 2);
    assert_eq!(results[0]["error"]["code"], "queue_full");
    let text = results[0]["error"]["message"].as_str().unwrap();
    assert!(text.starts_with("64 commands are already waiting"), "{text}");
    assert_eq!(bench.queued(), drivegate_core::order::CAPACITY);
}

#[test]
fn where_an_id_is_required_only_stops_do_without() {
    let mut bench = SetTopics::new();
    bench.commands.rules.require_id = true;
    for (topic, payload) in [("p1/set", r#"{"run": true}"#), ("p1/set/run", "1")] {
        let refused = json(&bench.take(set(topic, payload)).unwrap());
        assert_eq!(refused["error"]["code"], "not_allowed");
    }
    for (topic, payload) in [
        ("p1/set", r#"{"run": false}"#),
        ("p1/set/run", "0"),
        ("p1/set", r#"{"id": 1, "run": true}"#),
    ] {
        assert_eq!(bench.take(set(topic, payload)), None);
        bench.acknowledge();
    }
}

#[test]
fn commands_whose_results_find_no_room_are_refused_and_stops_are_not() {
    let mut bench = SetTopics::new();
    let mut crowded = |payload: &str| {
        let crowded = |topic: &str| topic == "drivegate/hall/drive/p1/result";
        let incoming = set("p1/set", payload);
        bench
            .commands
            .take(incoming, &bench.plant, crowded, bench.now, SystemTime::UNIX_EPOCH)
    };
    assert!(
        json(&crowded(r#"{"run": true}"#).unwrap())["error"]["message"]
            .as_str()
            .unwrap()
            .contains("results")
    );
    assert_eq!(crowded(r#"{"run": false}"#), None);
}

#[test]
fn the_audit_names_the_client_that_the_broker_names() {
    let mut bench = SetTopics::new();
    let run = Incoming {
        who: Some("alice\n".to_string()),
        ..set("p1/set/run", "1")
    };
    assert_eq!(bench.take(run), None);
    let command = next_command(&mut bench.plant.buses[0].queue.lock(), Urgency::Read, bench.now).unwrap();
    assert_eq!(command.ticket.origin().who, "alice\\n");
    assert_eq!(command.ticket.client(), "mqtt");
}

/// Lets the drive acknowledge the stop of a command, which must be its only queued part; returns the result.
fn stop_alone(bench: &mut SetTopics, payload: &str) -> Json {
    assert_eq!(bench.take(set("p1/set", payload)), None, "{payload}");
    assert_eq!(bench.queued(), 1, "{payload}");
    let (order, receipt) = bench.take_order().unwrap();
    let run = bench.plant.drive("p1").unwrap().image.spec.profile.point_index("run");
    assert_eq!(order, Order::Points(vec![(run.unwrap(), Value::Bool(false))]));
    drop(receipt);
    let result = bench.finished().unwrap();
    assert_eq!((&result["ok"], &result["result"]), (&false.into(), &"stop_only".into()));
    assert_eq!(bench.finished(), None, "one result");
    result
}

#[test]
fn a_stop_is_carried_out_whatever_becomes_of_the_rest() {
    let mut bench = SetTopics::new();
    for (payload, code, text) in [
        (
            r#"{"id": 1, "run": false, "speed_reference": 1000}"#,
            "bad_value",
            "outside",
        ),
        (
            r#"{"id": 2, "run": false, "sped_reference": 10}"#,
            "not_writable",
            "speed_reference",
        ),
        (r#"{"id": 3, "run": false, "expires_ms": 0}"#, "bad_value", "expires_ms"),
    ] {
        let result = stop_alone(&mut bench, payload);
        assert_eq!(result["rest"], code, "{result}");
        let message = result["error"]["message"].as_str().unwrap();
        assert!(
            message.starts_with("the drive acknowledged the stop") && message.contains(text),
            "{message}"
        );
    }
    bench.commands.rules.require_id = true;
    let result = stop_alone(&mut bench, r#"{"run": false, "speed_reference": 10}"#);
    assert_eq!(result["rest"], "not_allowed");
    assert!(result["error"]["message"].as_str().unwrap().contains("require_id"));
    let audit = audited(bench.plant.command_log.audit());
    let results: Vec<_> = audit.iter().map(|record| record["result"].as_str().unwrap()).collect();
    assert_eq!(
        results.iter().filter(|result| **result == "acknowledged").count(),
        4,
        "{results:?}"
    );
    assert!(results.contains(&"bad_value") && results.contains(&"not_writable") && results.contains(&"not_allowed"));
}

#[test]
fn a_start_that_came_before_a_stop_and_is_taken_behind_it_is_not_executed() {
    let mut bench = SetTopics::new();
    let mut start = set("p1/set", r#"{"id": 1, "run": true}"#);
    start.arrival = Some(Arrival::now(bench.now));
    bench.now += Duration::from_millis(20);
    assert_eq!(bench.take(set("p1/set/run", "false")), None);
    bench.now += Duration::from_millis(20);
    let result = json(&bench.take(start).unwrap());
    assert_eq!((&result["ok"], &result["result"]), (&false.into(), &"purged".into()));
    assert_eq!(bench.queued(), 1, "the stop");
}

mod repetitions;
mod stop_all;
