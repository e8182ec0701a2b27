//! Commands that arrive again, with an unchanged id.

use super::*;

#[test]
fn a_repetition_gets_the_previous_result() {
    let mut bench = SetTopics::new();
    let first = set("p1/set", r#"{"id": 1, "run": true}"#);
    assert_eq!(bench.take(first.clone()), None);
    let repeated = Incoming {
        dup: true,
        ..first.clone()
    };
    assert_eq!(
        bench.take(repeated.clone()),
        None,
        "still running: its result comes once"
    );
    let result = bench.acknowledge();
    assert_eq!(json(&bench.take(repeated.clone()).unwrap()), result);
    assert!(bench.commands.is_idle() && bench.queued() == 0);
    // A client that did not receive the acknowledgement publishes the command again: with an unchanged id, and
    // without the broker's mark.
    let again = Incoming {
        packet: 2,
        ..first.clone()
    };
    assert_eq!(json(&bench.take(again.clone()).unwrap()), result);
    let elsewhere = Incoming {
        response_topic: Some("other".to_string()),
        correlation: Some(vec![1]),
        ..again.clone()
    };
    let to_other = bench.take(elsewhere).unwrap();
    assert_eq!(
        (to_other.topic.as_ref(), to_other.correlation.as_deref()),
        ("other", Some(&[1][..]))
    );
    assert_eq!(json(&to_other), result);
    // Another payload with the same id is a new command. The first command is still not executed a second time.
    let other = set("p1/set", r#"{"id": 1, "run": true, "reverse": true}"#);
    assert_eq!(bench.take(other.clone()), None);
    bench.acknowledge();
    for _ in 0..2 {
        let refused = json(&bench.take(again.clone()).unwrap());
        assert_eq!(refused["error"]["code"], "not_allowed", "{refused}");
        assert!(bench.take(other.clone()).is_some());
        bench.now += REMEMBERED / 3;
    }
    assert_eq!(bench.queued(), 0);
    bench.now += REMEMBERED;
    assert_eq!(bench.take(again.clone()), None, "ten minutes later it is a new command");
    bench.acknowledge();
    bench.now += REMEMBERED;
    let long = Incoming {
        expiry: Some(3600),
        ..again
    };
    assert_eq!(bench.take(long.clone()), None);
    bench.acknowledge();
    bench.now += 2 * REMEMBERED;
    assert!(bench.take(long).is_some(), "it is remembered until it expires");
    // Without an id, only the broker's DUP flag shows a repetition.
    let bare = set("p1/set", r#"{"speed_reference": 5}"#);
    for _ in 0..2 {
        assert_eq!(bench.take(bare.clone()), None);
        bench.acknowledge();
    }
    assert!(bench.take(Incoming { dup: true, ..bare }).is_some());
}

#[test]
fn a_repetition_is_known_after_a_reload() {
    let mut bench = SetTopics::new();
    let run = |id: u32| set("p1/set", &format!(r#"{{"id": {id}, "run": true}}"#));
    assert_eq!(bench.take(run(1)), None);
    let result = bench.acknowledge();
    bench.reload_client();
    assert_eq!(json(&bench.take(run(1)).unwrap()), result);
    // The client that would have published this result no longer exists.
    assert_eq!(bench.take(run(2)), None);
    bench.reload_client();
    assert_eq!(json(&bench.take(run(2)).unwrap())["error"]["code"], "not_allowed");
    assert!(bench.take_order().is_some());
    assert_eq!(bench.take(set("p1/set/run", "false")), None);
    bench.acknowledge();
    bench.reload_bus();
    let refused = json(&bench.take(run(1)).unwrap());
    assert_eq!(refused["error"]["code"], "not_allowed", "{refused}");
    assert_eq!(bench.queued(), 0);
    assert_eq!(bench.take(run(3)), None);
}

#[test]
fn a_repeated_stop_is_executed_again() {
    let mut bench = SetTopics::new();
    let stop = set("p1/set", r#"{"id": 2, "run": false}"#);
    for _ in 0..2 {
        assert_eq!(bench.take(stop.clone()), None);
        bench.acknowledge();
    }
}

#[test]
fn a_repetition_of_what_has_no_result_yet_is_answered_with_that() {
    let mut bench = SetTopics::new();
    let run = set("p1/set", r#"{"id": 1, "run": true}"#);
    assert_eq!(bench.take(run.clone()), None);
    assert_eq!(bench.take(set("p1/set", r#"{"id": 2, "run": false}"#)), None);
    let again = bench.take(Incoming { dup: true, ..run });
    assert_eq!(again, None, "the first one's result is still to come");
}

/// Takes a run command, which is returned, and a stop after it.
fn run_and_stop(bench: &mut SetTopics) -> Incoming {
    let run = set("p1/set", r#"{"id": 1, "run": true}"#);
    for command in [run.clone(), set("p1/set", r#"{"id": 2, "run": false}"#)] {
        assert_eq!(bench.take(command), None);
        bench.acknowledge();
    }
    run
}

#[test]
fn a_repetition_after_a_stop_is_refused() {
    let mut bench = SetTopics::new();
    let run = run_and_stop(&mut bench);
    let again = json(&bench.take(Incoming { dup: true, ..run }).expect("an answer at once"));
    assert_eq!(again["error"]["code"], "not_allowed", "{again}");
    assert_eq!(bench.queued(), 0);
}

#[test]
fn a_repetition_after_the_drive_was_removed_and_added_is_refused() {
    let mut bench = SetTopics::new();
    let run = run_and_stop(&mut bench);
    for _ in 0..2 {
        bench.remove_and_add();
        let again = json(&bench.take(run.clone()).expect("an answer at once"));
        assert_eq!(again["error"]["code"], "not_allowed", "{again}");
        assert_eq!(bench.queued(), 0);
    }
    // A repeated start is not executed, even without a stop in between.
    let start = set("p1/set", r#"{"id": 3, "run": true}"#);
    assert_eq!(bench.take(start.clone()), None);
    bench.acknowledge();
    bench.remove_and_add();
    assert_eq!(json(&bench.take(start).unwrap())["error"]["code"], "not_allowed");
}

#[test]
fn a_loop_of_old_commands_starts_nothing() {
    let mut bench = SetTopics::new();
    let starts: Vec<_> = (0..5000)
        .map(|n| set("p1/set", &format!(r#"{{"id": {n}, "run": true}}"#)))
        .collect();
    for start in &starts {
        assert_eq!(bench.take(start.clone()), None);
        bench.acknowledge();
    }
    for start in &starts {
        assert!(bench.take(start.clone()).is_some());
    }
    assert_eq!(bench.queued(), 0);
}

#[test]
fn a_repetition_to_another_address_is_answered_there_though_the_result_is_to_come() {
    let mut bench = SetTopics::new();
    let run = set("p1/set", r#"{"id": 1, "run": true}"#);
    assert_eq!(bench.take(run.clone()), None);
    let elsewhere = Incoming {
        response_topic: Some("other".to_string()),
        ..run
    };
    let refused = bench.take(elsewhere).unwrap();
    assert_eq!(refused.topic.as_ref(), "other");
    assert_eq!(json(&refused)["error"]["code"], "not_allowed");
}

#[test]
fn of_a_repeated_command_that_stops_and_does_more_only_the_stop_is_repeated() {
    let mut bench = SetTopics::new();
    let payload = r#"{"id": 9, "run": false, "speed_reference": 10}"#;
    assert_eq!(bench.take(set("p1/set", payload)), None);
    assert_eq!(bench.queued(), 2);
    drop(bench.take_order().unwrap());
    assert_eq!(bench.finished(), None, "its rest is to come");
    assert_eq!(bench.acknowledge()["result"], "acknowledged");
    for _ in 0..2 {
        let result = stop_alone(&mut bench, payload);
        assert_eq!(result["rest"], "not_allowed");
        assert!(result["error"]["message"].as_str().unwrap().contains("repeats"));
    }
}
