//! Stop all over MQTT.

use super::*;

fn stop(payload: &str) -> Incoming {
    Incoming {
        topic: "drivegate/hall/set/stop".to_string(),
        payload: payload.into(),
        packet: 1,
        ..Incoming::default()
    }
}

impl SetTopics {
    /// The drive acknowledges the stop that waits, and a read shows the motor standing.
    fn stand(&mut self) {
        let (order, _) = self.take_order().expect("a stop");
        assert!(matches!(order, Order::Points(points) if points[0].1 == Value::Bool(false)));
        self.now += Duration::from_millis(50);
        fixture::read(&self.plant, "p1", 1, 0, self.now);
        self.stop_all.look(&self.plant, self.now);
    }
}

#[test]
fn is_answered_once_all_stand() {
    for payload in ["", "{}", "{\"bus\": \"line1\"}"] {
        let mut bench = SetTopics::new();
        assert_eq!(bench.take(stop(payload)), None);
        assert!(bench.commands.try_finished().is_none() && !bench.commands.is_idle());
        // A reload meanwhile loses no answer.
        bench.succeed_client();
        bench.stand();
        let ended = bench.commands.try_finished().expect("an answer");
        let answer = bench.commands.answer(ended, SystemTime::UNIX_EPOCH);
        assert_eq!(answer.topic.as_ref(), "drivegate/hall/result");
        assert_eq!(
            json(&answer),
            serde_json::json!({ "ok": true, "drives": [{ "drive": "p1", "outcome": "standing", "reason": null }] })
        );
        assert!(bench.commands.is_idle());
    }
}

#[test]
fn a_drive_that_is_not_proven_to_stand_is_named() {
    let mut bench = SetTopics::new();
    assert_eq!(bench.take(stop("{\"wait_s\": 2}")), None);
    drop(bench.take_order().expect("a stop"));
    bench.now += Duration::from_millis(1900);
    bench.stop_all.look(&bench.plant, bench.now);
    assert!(bench.commands.try_finished().is_none());
    bench.now += Duration::from_millis(100);
    bench.stop_all.look(&bench.plant, bench.now);
    let answer = bench.finished().expect("an answer");
    assert_eq!(
        (&answer["ok"], &answer["drives"][0]["outcome"]),
        (&false.into(), &"unproven".into())
    );
    assert!(
        answer["drives"][0]["reason"]
            .as_str()
            .is_some_and(|why| why.contains("not been read since"))
    );
}

#[test]
fn what_is_retained_or_not_understood_stops_nothing_and_says_so() {
    let mut bench = SetTopics::new();
    let retained = Incoming {
        retain: true,
        ..stop("{}")
    };
    for (message, says) in [
        (retained, "retained"),
        (stop("{\"drive\": \"p1\"}"), "no stop was sent"),
        (stop("{\"bus\": \"line9\"}"), "known: line1"),
        (stop("{\"group\": \"fans\"}"), "there is no group `fans`"),
    ] {
        let refused = json(&bench.take(message).expect("an answer at once"));
        assert_eq!(refused["ok"], false);
        assert!(
            refused["error"].as_str().is_some_and(|why| why.contains(says)),
            "{refused}"
        );
    }
    let cleared = Incoming {
        retain: true,
        ..stop("")
    };
    assert_eq!(bench.take(cleared), None);
    assert_eq!(bench.queued(), 0);
}
