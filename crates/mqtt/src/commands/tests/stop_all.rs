//! Stop all over MQTT.

use super::*;
use drivegate_core::plant::Plant;
use drivegate_core::process_image::DriveSpec;
use drivegate_testkit::{STALE_AFTER, bus, bus_spec, controlled, image, nx, take_next, up};

fn stop(payload: &str) -> Incoming {
    Incoming {
        topic: "drivegate/hall/set/stop".to_string(),
        payload: payload.into(),
        packet: 1,
        ..Incoming::default()
    }
}

impl SetTopics {
    /// The drive acknowledges the waiting stop, and a read shows the motor at standstill.
    fn stand(&mut self) {
        let (order, _) = self.take_order().expect("a stop");
        assert!(matches!(order, Order::Points(points) if points[0].1 == Value::Bool(false)));
        self.now += Duration::from_millis(50);
        fixture::read(&self.plant, "p1", 1, 0, self.now);
        self.stop_all.advance(&self.plant, self.now);
    }
}

#[test]
fn is_answered_once_all_stand() {
    for payload in ["", "{}", "{\"bus\": \"line1\"}"] {
        let mut bench = SetTopics::new();
        assert_eq!(bench.take(stop(payload)), None);
        assert!(bench.commands.try_finished().is_none() && !bench.commands.is_idle());
        // A reload in between loses no answer.
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
    bench.stop_all.advance(&bench.plant, bench.now);
    assert!(bench.commands.try_finished().is_none());
    bench.now += Duration::from_millis(100);
    bench.stop_all.advance(&bench.plant, bench.now);
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
fn what_is_not_understood_stops_nothing_and_says_so() {
    let mut bench = SetTopics::new();
    for (message, says) in [
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
    assert_eq!(bench.queued(), 0);
}

/// A command in a retained message is refused with event, result and audit. An empty message clears a topic and is not a
/// command, except where an empty message is one.
#[test]
fn retained_messages_are_refused_and_told() {
    for (topic, payload, drive) in [
        ("set/stop", "", "all drives"),
        ("set/stop", "{}", "all drives"),
        ("set/stop", "{\"bus\": \"line1\"}", "all drives"),
        ("set/stop", "{", "all drives"),
        ("as/cloud/stop", "", "all drives"),
        ("as/cloud/stop", "{}", "all drives"),
        ("drive/p1/set", "{\"run\": false}", "p1"),
        ("drive/p1/set", "{\"run\": true}", "p1"),
        ("drive/p1/set/run", "false", "p1"),
        ("drive/p1/as/cloud/set", "{\"run\": false}", "p1"),
        ("drive/p1/as/cloud/set/run", "false", "p1"),
        ("drive/p1/hold", "take", "p1"),
        ("drive/p1/as/cloud/hold", "take", "p1"),
        ("drive/p9/set", "{\"run\": false}", "p9"),
        ("drive/p9/as/cloud/hold", "take", "p9"),
        ("drive/p1/set", "", ""),
        ("drive/p1/set/run", "", ""),
        ("drive/p1/as/cloud/set/run", "", ""),
        ("drive/p1/hold", "", ""),
        ("drive/p1/as/cloud/hold", "", ""),
    ] {
        let mut bench = SetTopics::new();
        let message = Incoming {
            topic: format!("drivegate/hall/{topic}"),
            payload: payload.into(),
            retain: true,
            ..Incoming::default()
        };
        let result = bench.take(message).as_ref().map(json);
        assert_eq!(
            (bench.queued(), bench.commands.is_idle()),
            (0, true),
            "{topic} {payload}"
        );
        let audit = drivegate_testkit::audited(bench.plant.command_log.audit());
        if drive.is_empty() {
            assert!(result.is_none() && audit.is_empty(), "{topic} was cleared");
            continue;
        }
        let result = result.unwrap_or_else(|| panic!("a result of {topic} {payload}"));
        assert_eq!(result["ok"], false, "{result}");
        let records: Vec<_> = audit
            .iter()
            .map(|record| (&record["drive"], &record["result"]))
            .collect();
        let is_known = drive != "p9";
        let code = if is_known { "not_allowed" } else { "unknown_drive" };
        assert_eq!(records, [(&drive.into(), &code.into())], "{topic} {payload}");
        let event = bench.events.try_recv().ok();
        assert_eq!(event.is_some(), is_known, "{topic} {payload}");
        if let Some(event) = event {
            let of = event.drive.as_deref().unwrap_or("all drives");
            assert_eq!(
                (event.kind, of),
                (drivegate_core::event::EventKind::RefusedCommand, drive)
            );
            assert!(event.text.contains("retained"), "{}", event.text);
        }
    }
}

/// A bus with drives `p1` and `p2` at addresses 1 and 2, in these groups.
fn grouped(groups: [Option<&str>; 2]) -> Plant {
    let profile = nx();
    let drive = |(group, address): (Option<&str>, u8)| {
        image(DriveSpec {
            group: group.map(str::to_string),
            ..controlled(&format!("p{address}"), "line1", address, &profile)
        })
    };
    let drives = groups.into_iter().zip(1..).map(drive);
    Plant::new("hall", STALE_AFTER, vec![up(bus(bus_spec("line1"), drives.collect()))])
}

#[test]
fn a_group_is_what_it_was_when_the_first_byte_came() {
    let (fans, pumps) = (Some("fans"), Some("pumps"));
    let refused = "there is no group `fans`";
    // Groups before and after a reload, when the first byte came in ms from it, and the stopped drive or the refusal.
    for (before, after, came, stopped) in [
        ([fans, None], [None, fans], -1, Ok("p1")),
        ([fans, None], [None, fans], 1, Ok("p2")),
        ([fans, pumps], [pumps, None], -1, Ok("p1")),
        ([fans, pumps], [pumps, None], 1, Err(refused)),
        ([None, pumps], [pumps, fans], -1, Err(refused)),
    ] {
        let mut bench = SetTopics::new();
        let began = bench.now;
        bench.now += Duration::from_millis(10);
        bench.plant = grouped(before);
        bench.commands.earlier_names.ended(&bench.plant, bench.now);
        bench.plant = grouped(after);
        let asked = began + Duration::from_millis(10u64.saturating_add_signed(came));
        bench.now += Duration::from_millis(10);
        let message = Incoming {
            arrival: Some(Arrival::now(asked)),
            ..stop("{\"group\": \"fans\"}")
        };
        let told = bench.take(message).as_ref().map(json);
        let what = format!("{before:?}, then {after:?}, asked at {came}: {told:?}");
        match stopped {
            Ok(name) => {
                assert!(told.is_none() && bench.queued() == 1, "{what}");
                let drive = bench.plant.drive(name).unwrap();
                let order = take_next(&drive.bus.queue, bench.now).expect("a stop");
                assert!(order.is_stop() && order.drive() == Some(drive.index), "{what}");
            }
            Err(why) => {
                let text = told.as_ref().and_then(|told| told["error"].as_str());
                assert!(
                    text.is_some_and(|text| text.contains(why)) && bench.queued() == 0,
                    "{what}"
                );
            }
        }
    }
}
