use super::*;

/// Telemetry with acknowledgements.
fn outbox() -> Outbox {
    Outbox::new(Delivery {
        telemetry: Qos::AtLeastOnce,
        events: Qos::AtLeastOnce,
        expiry: Some(300),
    })
}

fn topic(name: &str) -> Arc<str> {
    Arc::from(name)
}

fn event(name: &str) -> Message {
    Message::not_retained(name, Vec::new())
}

/// Publishes everything allowed; returns topics and payloads.
fn drain(outbox: &mut Outbox, limit: usize) -> Vec<(String, Vec<u8>)> {
    let mut sent = Vec::new();
    while let Some((key, message)) = outbox.next(limit, true) {
        outbox.mark_published(key, message.acknowledged);
        sent.push((message.topic.to_string(), message.payload));
    }
    sent
}

fn lost(outbox: &mut Outbox, kind: MqttKind) -> u64 {
    let (_, count) = outbox.take_lost().into_iter().find(|(of, _)| *of == kind).unwrap();
    count
}

fn names(sent: &[(String, Vec<u8>)]) -> Vec<&str> {
    sent.iter().map(|(t, _)| t.as_str()).collect()
}

#[test]
fn newest_telemetry_wins_and_one_message_per_topic_is_in_flight() {
    let mut outbox = outbox();
    outbox.put(topic("a"), vec![1]);
    outbox.put(topic("b"), vec![1]);
    outbox.put(topic("a"), vec![2]);
    assert_eq!(drain(&mut outbox, 10), [("a".into(), vec![2]), ("b".into(), vec![1])]);
    outbox.put(topic("a"), vec![3]);
    outbox.put(topic("a"), vec![4]);
    assert!(outbox.next(10, true).is_none(), "a is in flight");
    outbox.numbered(1).unwrap();
    outbox.numbered(2).unwrap();
    assert!(outbox.acked(2).is_some(), "acknowledgements come in any order");
    assert_eq!(outbox.acked(1).unwrap().topic.as_ref(), "a");
    assert_eq!(drain(&mut outbox, 10), [("a".into(), vec![4])]);
    assert!(outbox.acked(77).is_none());
}

#[test]
fn the_limit_bounds_what_is_in_flight() {
    let mut outbox = outbox();
    for i in 0..10 {
        outbox.put(topic(&format!("t{i}")), Vec::new());
        outbox.push(MqttKind::Event, event("e"), None);
    }
    assert_eq!(drain(&mut outbox, 3).len(), 3);
    assert_eq!(outbox.in_flight(), 3);
    outbox.numbered(1).unwrap();
    outbox.acked(1);
    assert_eq!(drain(&mut outbox, 3).len(), 1);
}

#[test]
fn leader_first_then_results_events_and_telemetry_in_turn() {
    let mut outbox = outbox();
    for i in 1..=3 {
        outbox.put(topic(&format!("t{i}")), Vec::new());
        outbox.push(MqttKind::Event, event(&format!("e{i}")), None);
        outbox.push(MqttKind::History, event(&format!("h{i}")), None);
    }
    outbox.push_result(event("r1"));
    outbox.push_result(event("r2"));
    outbox.put_first(topic("status"), Vec::new(), None);
    assert!(outbox.next(0, true).is_none());
    let sent = drain(&mut outbox, 100);
    let order = [
        "status", "r1", "e1", "t1", "r2", "e2", "t2", "e3", "t3", "h1", "h2", "h3",
    ];
    assert_eq!(names(&sent), order);
    outbox.push(MqttKind::History, event("h4"), None);
    assert!(outbox.next(100, false).is_none(), "the history has its pace");
}

#[test]
fn after_a_lost_connection_events_are_sent_again_in_order() {
    let mut outbox = outbox();
    outbox.put(topic("t"), Vec::new());
    for name in ["e1", "e2", "e3"] {
        outbox.push(MqttKind::Event, event(name), None);
    }
    assert_eq!(drain(&mut outbox, 3).len(), 3);
    outbox.numbered(1).unwrap();
    outbox.numbered(2).unwrap();
    outbox.numbered(3).unwrap();
    assert_eq!(outbox.acked(1).unwrap().topic.as_ref(), "e1");
    outbox.lost();
    assert_eq!(outbox.waiting(), 2);
    assert_eq!(outbox.in_flight(), 0);
    assert!(
        outbox.acked(3).is_none(),
        "an acknowledgement of the lost connection means nothing"
    );
    assert_eq!(names(&drain(&mut outbox, 10)), ["e2", "e3"]);
}

#[test]
fn a_result_that_breaks_connections_is_dropped() {
    let mut outbox = outbox();
    outbox.push_result(event("bad"));
    for _ in 0..2 {
        assert_eq!(drain(&mut outbox, 10).len(), 1);
        outbox.lost();
    }
    assert_eq!((outbox.waiting(), lost(&mut outbox, MqttKind::Result)), (0, 1));
}

#[test]
fn queues_are_bounded_and_drop_the_oldest() {
    let mut outbox = outbox();
    for i in 0..KEPT + 2 {
        outbox.push(MqttKind::Event, event(&format!("e{i}")), None);
    }
    assert_eq!((outbox.waiting(), lost(&mut outbox, MqttKind::Event)), (KEPT, 2));
    assert_eq!(outbox.next(1, true).unwrap().1.topic.as_ref(), "e2");
    // Arrays of the history are large.
    let array = |n: usize| Message::not_retained("h", format!("{n:33000}").into_bytes());
    let mut count = 0;
    while outbox.room(MqttKind::History) > 0 {
        outbox.push(MqttKind::History, array(count), None);
        count += 1;
    }
    assert!((30..40).contains(&count), "{count} are loaded at a time");
    (count..2000).for_each(|n| outbox.push(MqttKind::History, array(n), None));
    let queue = outbox.queue(MqttKind::History);
    let (kept, bytes) = (queue.entries.len(), queue.bytes);
    assert!((KEPT_BYTES - 40_000..=KEPT_BYTES).contains(&bytes), "{bytes}");
    let first = &queue.entries.front().unwrap().message;
    assert_eq!(*first, array(2000 - kept), "the newest are kept");
    assert_eq!(lost(&mut outbox, MqttKind::History) as usize, 2000 - kept);
}

#[test]
fn results_beyond_the_bound_push_out_the_oldest_that_are_not_in_flight() {
    let mut outbox = outbox();
    for n in 0..RESULTS {
        assert_eq!(outbox.is_crowded("r"), n >= RESULTS_OF_TOPIC);
        outbox.push_result(event("r"));
    }
    assert_eq!((outbox.waiting(), lost(&mut outbox, MqttKind::Result)), (RESULTS, 0));
    assert!(outbox.is_crowded("r") && !outbox.is_crowded("other"));
    assert_eq!(names(&drain(&mut outbox, 2)), ["r", "r"]);
    (0..RESULTS - 2).for_each(|_| outbox.push_result(event("other")));
    assert_eq!(
        (outbox.waiting(), lost(&mut outbox, MqttKind::Result)),
        (RESULTS, RESULTS as u64 - 2)
    );
    assert!(!outbox.is_crowded("r") && outbox.is_crowded("other"));
    for packet in [1, 2] {
        outbox.numbered(packet).unwrap();
        assert_eq!(outbox.acked(packet).map(|settled| settled.topic), Some(topic("r")));
    }
    assert_eq!(drain(&mut outbox, usize::MAX).len(), RESULTS - 2);

    let mut outbox = self::outbox();
    let long = Message {
        correlation: Some(vec![0; 60_000]),
        ..event("r")
    };
    let most = RESULT_BYTES / 60_001;
    (0..most + 5).for_each(|_| outbox.push_result(long.clone()));
    assert_eq!((outbox.waiting(), lost(&mut outbox, MqttKind::Result)), (most, 5));
}

/// The message that the broker refuses for now was dropped meanwhile: nothing waits for another attempt.
#[test]
fn a_refusal_of_a_dropped_message_holds_up_no_other() {
    let mut outbox = outbox();
    let long = |name: &str| Message {
        correlation: Some(vec![0; RESULT_BYTES / 2 - 10]),
        ..event(name)
    };
    for name in ["one", "two"] {
        outbox.push_result(long(name));
    }
    assert_eq!(names(&drain(&mut outbox, 1)), ["one"]);
    outbox.numbered(1).unwrap();
    assert_eq!(names(&drain(&mut outbox, 2)), ["two"]);
    outbox.push_result(long("three"));
    assert_eq!(
        lost(&mut outbox, MqttKind::Result),
        1,
        "both are in flight, the older one is dropped"
    );
    assert_eq!(outbox.put_back(1, true), None);
    outbox.acked(1);
    assert_eq!(names(&drain(&mut outbox, 2)), ["three"]);
}

#[test]
fn telemetry_without_acknowledgement_passes_a_full_window() {
    let mut outbox = Outbox::new(Delivery {
        telemetry: Qos::AtMostOnce,
        events: Qos::AtLeastOnce,
        expiry: Some(300),
    });
    for (name, number) in [("e1", 7), ("e2", 8)] {
        outbox.push(MqttKind::Event, event(name), Some(MessageNumber::new(number)));
    }
    outbox.put(topic("t"), vec![1]);
    outbox.put_lasting(topic("gone"), Vec::new());
    let sent = drain(&mut outbox, 1);
    assert_eq!(names(&sent), ["e1", "t"]);
    outbox.put(topic("t"), vec![2]);
    let (key, message) = outbox.next(1, true).unwrap();
    assert_eq!(
        (message.acknowledged, message.expiry, message.retain),
        (false, Some(300), true)
    );
    assert!(outbox.mark_published(key, false).is_some());
    assert_eq!(outbox.oldest(MqttKind::Event), Some(MessageNumber::new(7)));
    outbox.numbered(1).unwrap();
    outbox.acked(1);
    let (_, message) = outbox.next(1, true).unwrap();
    assert!(message.acknowledged && message.expiry.is_none());
}

#[test]
fn messages_that_no_log_keeps_have_their_place_among_the_others() {
    let mut outbox = outbox();
    for (name, number) in [
        ("e1", Some(1)),
        ("e2", None),
        ("e3", None),
        ("e4", Some(2)),
        ("e5", Some(3)),
    ] {
        outbox.push(MqttKind::Event, event(name), number.map(MessageNumber::new));
    }
    assert_eq!(outbox.oldest(MqttKind::Event), Some(MessageNumber::new(1)));
    assert_eq!(outbox.unkept(MqttKind::Event), 2);
    assert_eq!(names(&drain(&mut outbox, 3)), ["e1", "e2", "e3"]);
    (1..=3).for_each(|packet| outbox.numbered(packet).unwrap());
    assert_eq!(outbox.acked(2).unwrap().topic.as_ref(), "e2");
    assert_eq!(outbox.acked(1).unwrap().topic.as_ref(), "e1");
    assert_eq!(outbox.oldest(MqttKind::Event), Some(MessageNumber::new(2)));
    outbox.lost();
    // The disk is full: it has no message up to number 2 any more, and never had e3.
    outbox.drop_gone(MqttKind::Event, MessageNumber::new(2));
    assert_eq!(lost(&mut outbox, MqttKind::Event), 1);
    assert_eq!(names(&drain(&mut outbox, 10)), ["e3", "e5"]);
}

#[test]
fn inconsistent_packet_ids_are_detected() {
    let mut outbox = outbox();
    assert!(outbox.numbered(1).is_err());
    for name in ["a", "b"] {
        outbox.push(MqttKind::Event, event(name), None);
    }
    drain(&mut outbox, 10);
    assert!(outbox.numbered(1).is_ok());
    assert!(outbox.numbered(1).is_err());
}

#[test]
fn messages_that_cannot_be_sent_are_dropped() {
    let mut outbox = outbox();
    outbox.put(topic("big"), vec![0; 10]);
    let (key, _) = outbox.next(1, true).unwrap();
    outbox.give_up(key);
    assert!(outbox.next(1, true).is_none());
    assert!(!outbox.has_telemetry("big"));
}

#[test]
fn what_the_broker_refuses_for_now_is_published_again_in_its_order() {
    let mut outbox = outbox();
    for name in ["e1", "e2", "e3"] {
        outbox.push(MqttKind::Event, event(name), None);
    }
    assert_eq!(drain(&mut outbox, 2).len(), 2);
    (1..=2).for_each(|packet| outbox.numbered(packet).unwrap());
    assert_eq!(outbox.put_back(1, true).unwrap().as_ref(), "e1");
    assert!(outbox.acked(2).is_some() && outbox.acked(1).is_none());
    assert!(
        outbox.next(10, true).is_none(),
        "no event overtakes the one that was refused"
    );
    outbox.push_result(event("r"));
    assert_eq!(names(&drain(&mut outbox, 10)), ["r"], "results go on");
    outbox.retry();
    assert_eq!(names(&drain(&mut outbox, 10)), ["e1", "e3"]);
    outbox.lost();
    assert_eq!(outbox.waiting(), 3);
}

#[test]
fn the_status_is_repeated_whatever_the_reason_and_telemetry_only_for_a_while() {
    let mut outbox = outbox();
    for for_now in [true, false] {
        outbox.put_first(topic("status"), vec![1], None);
        outbox.put(topic("t"), vec![2]);
        assert_eq!(drain(&mut outbox, 10).len(), 2);
        (1..=2).for_each(|packet| outbox.numbered(packet).unwrap());
        assert!(outbox.put_back(1, for_now).is_some());
        assert_eq!(outbox.put_back(2, for_now).is_some(), for_now);
        if !for_now {
            assert!(outbox.acked(2).is_some());
        }
        assert!(outbox.has_telemetry("status") && !outbox.is_under_way("status"));
        assert!(outbox.next(10, true).is_none());
        outbox.put(topic("t"), vec![3]);
        outbox.retry();
        let expected = [("status".to_string(), vec![1]), ("t".to_string(), vec![3])];
        assert_eq!(drain(&mut outbox, 10), expected, "with the latest value");
        (1..=2).for_each(|packet| outbox.numbered(packet).unwrap());
        (1..=2).for_each(|packet| assert!(outbox.acked(packet).is_some()));
        assert!(!outbox.has_telemetry("status"));
    }
}

#[test]
fn a_new_status_does_not_wait_for_the_retry() {
    let mut outbox = outbox();
    outbox.put_first(topic("status"), vec![1], None);
    drain(&mut outbox, 10);
    outbox.numbered(1).unwrap();
    assert!(outbox.put_back(1, true).is_some());
    outbox.put_first(topic("status"), vec![0], None);
    assert_eq!(drain(&mut outbox, 10), [("status".to_string(), vec![0])]);
}
