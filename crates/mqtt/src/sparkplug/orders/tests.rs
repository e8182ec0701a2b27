use super::*;
use crate::fixture;
use crate::sparkplug::session::Rules;
use crate::sparkplug::topics::Topics;
use drivegate_core::order::{Arrival, Order, Outcome, Urgency};
use drivegate_model::drive::{PointIndex, Value};
use drivegate_north::command_json::REMEMBERED;
use drivegate_proto::Reply;
use drivegate_testkit::{audited, next_command};

struct OrderedDrive {
    orders: Orders,
    plant: Plant,
    session: Session,
    drive: DriveMetrics,
    now: Instant,
}

fn bench() -> OrderedDrive {
    let plant = fixture::plant(&["p1"]);
    let now = Instant::now();
    fixture::read(&plant, "p1", 1, 0, now);
    let (drive, definitions) = DriveMetrics::new(plant.drive("p1").unwrap(), true);
    let mut session = Session::new(Rules {
        topics: Topics::new("plant", "hall", ""),
        alias: true,
        history: true,
        min_interval: Duration::ZERO,
    });
    session.adopt(Vec::new(), vec![("p1".to_string(), definitions)]);
    OrderedDrive {
        orders: Orders::new(SharedMemory::default(), Right::lasting(), None),
        plant,
        session,
        drive,
        now,
    }
}

fn named(name: &str, value: MetricValue) -> Metric {
    Metric {
        name: Some(name.to_string()),
        value: Some(value),
        ..Metric::default()
    }
}

fn message(timestamp: u64, metrics: Vec<Metric>) -> Incoming {
    let payload = Payload {
        timestamp: Some(timestamp),
        metrics,
        seq: None,
    };
    Incoming {
        topic: "spBv1.0/plant/DCMD/hall/p1".to_string(),
        payload: payload.encoded(),
        ..Incoming::default()
    }
}

impl OrderedDrive {
    fn take(&mut self, message: &Incoming, device: &str) -> Option<Finished> {
        let target = (device == "p1").then_some((0, &self.drive));
        self.orders
            .take(message, device, target, &self.session, &self.plant, self.now)
    }

    fn pop(&self) -> Option<drivegate_core::order::Command> {
        let mut queue = self.plant.buses[0].queue.lock();
        next_command(&mut queue, Urgency::Command, self.now)
    }

    fn finish(&mut self) -> Finished {
        match self
            .orders
            .poll_finished(&mut Context::from_waker(std::task::Waker::noop()))
        {
            Poll::Ready(finished) => finished,
            Poll::Pending => panic!("it is not finished"),
        }
    }

    fn index(&self, point: &str) -> PointIndex {
        self.drive.drive.image.spec.profile.point_index(point).unwrap()
    }
}

#[test]
fn a_command_is_one_order() {
    let mut bench = bench();
    let alias = |bench: &OrderedDrive, name| {
        let place = bench.session.metric(0, Some(name), None).unwrap();
        (1..)
            .find(|alias| bench.session.metric(0, None, Some(*alias)) == Some(place))
            .unwrap()
    };
    let by_alias = Metric {
        alias: Some(alias(&bench, "speed_reference")),
        value: Some(MetricValue::Float(33.3)),
        ..Metric::default()
    };
    let metrics = vec![named("run", MetricValue::Boolean(true)), by_alias];
    assert_eq!(bench.take(&message(1, metrics), "p1"), None);
    let command = bench.pop().unwrap();
    let expected = vec![
        (bench.index("run"), Value::Bool(true)),
        (bench.index("speed_reference"), Value::Number(33.3)),
    ];
    assert_eq!(command.intent.order, Order::Points(expected));
    assert_eq!(command.ticket.origin().kind, SourceKind::Sparkplug);
    assert_eq!(command.ticket.origin().who, "spBv1.0/plant/DCMD/hall/p1");
    assert!(!bench.orders.is_idle());
    let receipt = command
        .ticket
        .acknowledge(Outcome::Acknowledged(Reply::Written), bench.now);
    receipt.confirm(bench.now);
    let finished = bench.finish();
    assert_eq!((finished.code, finished.error.as_str()), (CONFIRMED, ""));
    assert_eq!(finished.metrics.len(), 2);
    assert!(bench.orders.is_idle());
}

#[test]
fn numbers_come_in_every_type() {
    for (value, datatype, expected) in [
        (MetricValue::Int(50), None, 50.0),
        (MetricValue::Int(u32::MAX), Some(3), -1.0),
        (MetricValue::Int(u32::MAX), Some(7), 4_294_967_295.0),
        (MetricValue::Long(u64::MAX), Some(4), -1.0),
        (MetricValue::Long(7), Some(8), 7.0),
        (MetricValue::Double(0.1), Some(10), 0.1),
        (MetricValue::Float(0.1), Some(9), 0.1),
    ] {
        let metric = Metric {
            datatype,
            value: Some(value.clone()),
            ..Metric::default()
        };
        assert_eq!(
            json(&metric).and_then(|json| json.as_f64()),
            Some(expected),
            "{value:?}"
        );
    }
    for value in [MetricValue::Double(f64::NAN), MetricValue::String("5".to_string())] {
        assert_eq!(json(&named("a", value)), None);
    }
}

#[test]
fn what_is_wrong_is_refused_with_its_reason() {
    let mut bench = bench();
    let retained = Incoming {
        retain: true,
        ..message(1, vec![named("run", MetricValue::Boolean(true))])
    };
    let garbage = Incoming {
        payload: b"run".to_vec(),
        ..message(1, Vec::new())
    };
    let null = Metric {
        is_null: Some(true),
        ..named("run", MetricValue::Boolean(true))
    };
    let unknown = Metric {
        alias: Some(9999),
        value: Some(MetricValue::Boolean(true)),
        ..Metric::default()
    };
    let large = Incoming {
        oversized: Some(70_000),
        ..message(1, Vec::new())
    };
    for (message, code, text) in [
        (retained, "not_allowed", "retained"),
        (garbage, "bad_value", "not Sparkplug B"),
        (large, "bad_value", "70000 bytes"),
        (message(1, vec![unknown.clone(); 65]), "bad_value", "65 metrics"),
        (message(2, Vec::new()), "bad_value", "names no point"),
        (message(3, vec![null]), "bad_value", "null"),
        (message(4, vec![unknown]), "not_writable", "alias 9999"),
        (
            message(5, vec![named("running", MetricValue::Boolean(true))]),
            "not_writable",
            "read-only",
        ),
        (
            message(6, vec![named("sped_reference", MetricValue::Double(5.0))]),
            "not_writable",
            "did you mean",
        ),
        (
            message(7, vec![named("speed_reference", MetricValue::Double(500.0))]),
            "bad_value",
            "outside",
        ),
        (
            message(8, vec![named("command_result", MetricValue::Double(5.0))]),
            "not_writable",
            "no point",
        ),
    ] {
        let finished = bench.take(&message, "p1").unwrap();
        assert_eq!(finished.code, code, "{finished:?}");
        assert!(finished.error.contains(text), "{finished:?}");
        assert!(bench.pop().is_none());
    }
    assert_eq!(
        bench.take(&message(9, Vec::new()), "p2"),
        None,
        "there is no such drive"
    );
    let seen = audited(bench.plant.command_log.audit());
    assert!(seen.iter().all(|record| record["source"] == "sparkplug"));
}

#[test]
fn a_repeated_command_is_refused_and_a_stop_never() {
    let mut bench = bench();
    let run = message(1, vec![named("run", MetricValue::Boolean(true))]);
    let stop = message(1, vec![named("run", MetricValue::Boolean(false))]);
    assert_eq!(bench.take(&run, "p1"), None);
    let again = bench.take(&run, "p1").unwrap();
    assert_eq!(again.code, "not_allowed");
    assert!(again.error.contains("repeats"), "{again:?}");
    assert_eq!((bench.take(&stop, "p1"), bench.take(&stop, "p1")), (None, None));
    bench.orders = Orders::new(bench.orders.memory.clone(), Right::lasting(), None);
    assert_eq!(bench.take(&run, "p1").unwrap().code, "not_allowed", "after a reload");
    let later = message(2, vec![named("run", MetricValue::Boolean(true))]);
    assert_eq!(bench.take(&later, "p1"), None, "with its own time it is a new one");
    bench.now += REMEMBERED;
    fixture::read(&bench.plant, "p1", 1, 0, bench.now);
    assert_eq!(bench.take(&run, "p1"), None);
}

#[test]
fn a_stop_among_too_many_metrics_or_bad_ones_is_one() {
    let unknown = |count: u64| {
        (0..count).map(|alias| Metric {
            alias: Some(5000 + alias),
            value: Some(MetricValue::Double(1.0)),
            ..Metric::default()
        })
    };
    let bad = || named("speed_reference", MetricValue::Double(f64::NAN));
    for (before, after, text) in [
        (0, 64, "65 metrics, at most 64"),
        (64, 0, "66 metrics, at most 64"),
        (40, 40, "81 metrics, at most 64"),
        (1, 1, "alias 5000"),
    ] {
        let mut bench = bench();
        let place = bench.session.metric(0, Some("run"), None).unwrap();
        let by_alias = Metric {
            alias: bench.session.alias(0, place),
            value: Some(MetricValue::Boolean(false)),
            ..Metric::default()
        };
        for (time, run) in [(1, named("run", MetricValue::Boolean(false))), (2, by_alias)] {
            let metrics = unknown(before).chain([run, bad()]).chain(unknown(after.max(1) - 1));
            assert_eq!(
                bench.take(&message(time, metrics.collect()), "p1"),
                None,
                "{before} {after}"
            );
            let mut queue = bench.plant.buses[0].queue.lock();
            let stop = next_command(&mut queue, Urgency::Stop, bench.now).unwrap();
            drop(queue);
            let stopped = Order::Points(vec![(bench.index("run"), Value::Bool(false))]);
            assert_eq!(stop.intent.order, stopped);
            drop(
                stop.ticket
                    .acknowledge(Outcome::Acknowledged(Reply::Written), bench.now),
            );
            let finished = bench.finish();
            assert_eq!(finished.code, "stop_only");
            let told = finished.error.contains(text) || before + after < 64;
            assert!(told && finished.metrics.len() <= METRICS, "{finished:?}");
            assert!(bench.pop().is_none());
        }
    }
}

#[test]
fn a_start_that_came_before_a_stop_and_is_taken_behind_it_is_not_executed() {
    let mut bench = bench();
    let run = |value| vec![named("run", MetricValue::Boolean(value))];
    let mut start = message(1, run(true));
    start.arrival = Some(Arrival::now(bench.now));
    bench.now += Duration::from_millis(20);
    assert_eq!(bench.take(&message(2, run(false)), "p1"), None);
    assert_eq!(bench.take(&start, "p1").unwrap().code, "purged");
}

#[test]
fn an_empty_name_counts_for_nothing_and_a_contradiction_is_refused() {
    let mut bench = bench();
    let alias = |name: &str| {
        let place = bench.session.metric(0, Some(name), None).unwrap();
        bench.session.alias(0, place).unwrap()
    };
    let (run, reference) = (alias("run"), alias("speed_reference"));
    let metric = |name: &str, alias: u64| Metric {
        alias: Some(alias),
        ..named(name, MetricValue::Double(40.0))
    };
    for (time, name, alias) in [
        (1, "", reference),
        (2, "speed_reference", reference),
        (3, "speed_reference", 0),
    ] {
        assert_eq!(
            bench.take(&message(time, vec![metric(name, alias)]), "p1"),
            None,
            "{name} {alias}"
        );
        let expected = vec![(bench.index("speed_reference"), Value::Number(40.0))];
        assert_eq!(bench.pop().unwrap().intent.order, Order::Points(expected));
    }
    for wrong in [run, 9999] {
        let finished = bench
            .take(&message(4, vec![metric("speed_reference", wrong)]), "p1")
            .unwrap();
        assert_eq!(finished.code, "bad_value");
        assert!(finished.error.contains(&format!("not {wrong}")), "{}", finished.error);
        assert!(bench.pop().is_none());
    }
}
