//! What the broker takes and keeps is bounded.

use super::*;
use crate::sim::broker::MAX_QUEUE_BYTES;

#[test]
fn a_client_gets_no_more_than_it_can_take_and_in_order() {
    let mut bench = Bench::new();
    let peer = bench.connect(Connect {
        receive_maximum: 2,
        ..client("c")
    });
    bench.subscribe(&peer, qos1("a"));
    for (payload, qos) in [("1", 1), ("2", 1), ("3", 1), ("4", 0)] {
        let qos = if qos == 0 { QoS::AtMostOnce } else { QoS::AtLeastOnce };
        bench.publish(publish("a", payload, qos));
    }
    let payloads = |taken: Vec<Outbound>| -> Vec<_> { taken.iter().map(|o| o.message.payload.clone()).collect() };
    assert_eq!(payloads(bench.take(&peer)), ["1", "2"]);
    bench.state.linked(&peer.id, peer.link).unwrap().acknowledge(2);
    assert_eq!(payloads(bench.take(&peer)), ["3", "4"]);

    let wide = bench.connect(client("wide"));
    bench.subscribe(&wide, qos1("a"));
    for _ in 0..2 * MAX_INFLIGHT {
        bench.publish(publish("a", "x", QoS::AtLeastOnce));
    }
    assert_eq!(bench.take(&wide).len(), MAX_INFLIGHT);
}

#[test]
fn a_full_queue_gives_up_qos_0_then_the_client() {
    let mut bench = Bench::new();
    let mut slow = bench.connect(client("slow"));
    bench.subscribe(&slow, qos1("#"));
    for number in 0..MAX_QUEUE_MESSAGES {
        let qos = if number < 2 { QoS::AtMostOnce } else { QoS::AtLeastOnce };
        bench.publish(publish("a", &number.to_string(), qos));
    }
    bench.publish(publish("a", "more", QoS::AtLeastOnce));
    bench.publish(publish("a", "and more", QoS::AtLeastOnce));
    assert!(slow.ended.try_recv().is_err(), "two QoS 0 messages made room");
    bench.publish(publish("a", "dropped", QoS::AtMostOnce));
    assert!(slow.ended.try_recv().is_err());
    bench.publish(publish("a", "too much", QoS::AtLeastOnce));
    assert_eq!(
        slow.ended.try_recv().unwrap().reason,
        DisconnectReasonCode::QuotaExceeded
    );
    let received = bench.received(&slow);
    assert_eq!(received.len(), MAX_QUEUE_MESSAGES);
    assert_eq!(
        (received[0].as_str(), received.last().unwrap().as_str()),
        ("a 2", "a and more")
    );
}

#[test]
fn what_waits_and_what_is_retained_is_bounded_in_bytes() {
    let mut bench = Bench::new();
    let away = bench.connect(steady("away"));
    bench.subscribe(&away, qos1("#"));
    bench.lose(&away);
    let big = "x".repeat(200_000);
    let mut refused = 0;
    for number in 0..300 {
        let reason = bench.publish(retained(&format!("t/{number}"), &big));
        refused += usize::from(reason == PubAckReason::QuotaExceeded);
    }
    let free = MAX_RETAINED_BYTES.checked_sub(bench.state.retained_bytes).unwrap();
    assert!(free < 210_000 && refused > 200, "{free} bytes free, {refused} refused");
    let back = bench.connect(steady("away"));
    let waiting = bench.received(&back).len();
    assert!(waiting * 200_000 <= MAX_QUEUE_BYTES && waiting > 100, "{waiting}");
}

#[test]
fn the_session_left_longest_gives_way() {
    let mut bench = Bench::new();
    let watcher = bench.connect(client("w"));
    bench.subscribe(&watcher, qos1("will"));
    for number in 0..MAX_SESSIONS + 2 {
        let peer = bench.connect(with_will(
            Connect {
                expiry: Expiry::Never,
                ..steady(&number.to_string())
            },
            9999,
        ));
        bench.lose(&peer);
        bench.now += Duration::from_millis(1);
    }
    assert_eq!(bench.state.sessions.len(), MAX_SESSIONS);
    assert_eq!(bench.received(&watcher).len(), 3, "the wills of those that had to go");
    assert!(!bench.connect(steady("0")).session_present);
    assert!(bench.connect(steady("200")).session_present);
}

#[test]
fn connects_that_cannot_be_served_are_refused_with_a_code() {
    let mut bench = Bench::new();
    let mut refused = |connect: Connect| {
        let (end, _) = oneshot::channel();
        bench
            .state
            .attach(bench.now, &connect, Arc::new(Notify::new()), end)
            .map(|attached| attached.client_id)
    };
    let nameless = Connect {
        clean_start: false,
        version: Version::V311,
        ..client("")
    };
    assert_eq!(refused(nameless), Err(ConnectReturnCode::ClientIdentifierNotValid));
    assert_eq!(
        refused(client(&"x".repeat(300))),
        Err(ConnectReturnCode::ClientIdentifierNotValid)
    );
    let authentication = Connect {
        authentication: true,
        ..client("c")
    };
    assert_eq!(refused(authentication), Err(ConnectReturnCode::BadAuthenticationMethod));
    let first = refused(client("")).unwrap();
    let second = refused(client("")).unwrap();
    assert_ne!(first, second);
}
