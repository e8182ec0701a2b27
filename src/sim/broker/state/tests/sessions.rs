//! Sessions that outlive their connections, and wills.

use super::*;

#[test]
fn the_will_is_published_when_the_connection_is_lost_and_only_then() {
    let mut bench = Bench::new();
    let watcher = bench.connect(client("w"));
    bench.subscribe(&watcher, qos1("will"));
    let peer = bench.connect(with_will(client("c"), 0));
    bench.state.detach(bench.now, &peer.id, peer.link, Leave::Clean, None);
    assert!(bench.received(&watcher).is_empty());
    let peer = bench.connect(with_will(client("c"), 0));
    bench.lose(&peer);
    bench.lose(&peer);
    assert_eq!(bench.received(&watcher), ["will gone"]);
    let late = bench.connect(client("late"));
    bench.subscribe(&late, qos1("#"));
    assert_eq!(bench.received(&late), ["will gone r"]);
}

#[test]
fn a_delayed_will_waits_and_is_withdrawn_by_a_return() {
    let mut bench = Bench::new();
    let watcher = bench.connect(client("w"));
    bench.subscribe(&watcher, qos1("will"));
    let peer = bench.connect(with_will(steady("c"), 10));
    bench.lose(&peer);
    bench.pass(9);
    assert!(bench.received(&watcher).is_empty());
    let peer = bench.connect(with_will(steady("c"), 10));
    assert!(peer.session_present);
    bench.pass(30);
    assert!(bench.received(&watcher).is_empty(), "withdrawn");
    bench.lose(&peer);
    bench.pass(10);
    assert_eq!(bench.received(&watcher), ["will gone"]);
    // The end of the session comes before the delay.
    let peer = bench.connect(with_will(steady("c"), 1000));
    bench.lose(&peer);
    bench.pass(60);
    assert_eq!(bench.received(&watcher), ["will gone"]);
    // So does a clean start.
    let peer = bench.connect(with_will(steady("c"), 1000));
    bench.lose(&peer);
    bench.connect(client("c"));
    assert_eq!(bench.received(&watcher), ["will gone"]);
}

#[test]
fn a_second_connection_takes_over_after_the_will_of_the_first() {
    let mut bench = Bench::new();
    let watcher = bench.connect(client("w"));
    bench.subscribe(&watcher, qos1("will"));
    let mut first = bench.connect(with_will(client("c"), 0));
    bench.subscribe(&first, qos1("a"));
    let second = bench.connect(client("c"));
    assert_eq!(
        first.ended.try_recv().unwrap().reason,
        DisconnectReasonCode::SessionTakenOver
    );
    assert_eq!(bench.received(&watcher), ["will gone"]);
    assert!(!second.session_present);
    // The first one's task is late: it changes nothing any more.
    bench.lose(&first);
    assert_eq!(bench.state.clients(), 2);
    assert!(bench.take(&first).is_empty());
    assert_eq!(bench.subscribe(&first, qos1("b")), SubscribeReasonCode::Unspecified);
    assert_eq!(bench.state.subscribers("b"), 0);
}

#[test]
fn a_session_keeps_subscriptions_and_qos_1_until_it_expires() {
    let mut bench = Bench::new();
    let peer = bench.connect(steady("c"));
    bench.subscribe(&peer, qos1("a"));
    bench.publish(publish("a", "1", QoS::AtLeastOnce));
    bench.publish(publish("a", "zero", QoS::AtMostOnce));
    bench.publish(publish("a", "2", QoS::AtLeastOnce));
    let sent: Vec<u16> = bench.take(&peer).iter().map(|outbound| outbound.pkid).collect();
    assert_eq!(sent, [1, 0, 2]);
    bench.state.linked(&peer.id, peer.link).unwrap().acknowledge(1);
    bench.publish(publish("a", "not taken", QoS::AtMostOnce));
    bench.lose(&peer);
    bench.publish(publish("a", "3", QoS::AtLeastOnce));
    bench.publish(publish("a", "zero", QoS::AtMostOnce));
    bench.pass(59);
    let peer = bench.connect(steady("c"));
    assert!(peer.session_present);
    let again: Vec<_> = bench
        .take(&peer)
        .iter()
        .map(|o| (o.pkid, o.dup, o.message.payload.clone()))
        .collect();
    assert_eq!(
        again,
        [
            (2, true, Bytes::from_static(b"2")),
            (3, false, Bytes::from_static(b"3"))
        ]
    );
    bench.lose(&peer);
    bench.pass(60);
    let peer = bench.connect(steady("c"));
    assert!(!peer.session_present);
    assert_eq!(
        bench.publish(publish("a", "4", QoS::AtLeastOnce)),
        PubAckReason::NoMatchingSubscribers
    );
    // DISCONNECT with another expiry.
    bench
        .state
        .detach(bench.now, &peer.id, peer.link, Leave::Clean, Some(Expiry::AtOnce));
    assert!(!bench.connect(steady("c")).session_present);
}

#[test]
fn a_message_expires_in_the_queue_and_in_the_store() {
    let mut bench = Bench::new();
    let peer = bench.connect(steady("c"));
    bench.subscribe(&peer, qos1("#"));
    bench.publish(expiring(retained("kept", "x"), 10));
    bench.publish(expiring(publish("short", "x", QoS::AtLeastOnce), 3));
    bench.pass(4);
    let left: Vec<_> = bench
        .take(&peer)
        .iter()
        .map(|o| (o.message.topic.clone(), o.expires_in))
        .collect();
    assert_eq!(left, [(String::from("kept"), Some(6))]);
    let late = bench.connect(client("late"));
    bench.subscribe(&late, qos1("#"));
    assert_eq!(bench.received(&late), ["kept x r"]);
    bench.pass(6);
    bench.subscribe(&late, qos1("#"));
    assert!(bench.received(&late).is_empty());
    assert_eq!((bench.state.retained.len(), bench.state.retained_bytes), (0, 0));
}

#[derive(Debug, Clone)]
enum Step {
    Publish,
    /// Take up to so many, and acknowledge every one of them or none.
    Take(usize, bool),
    /// Acknowledge one of those under way.
    Acknowledge(prop::sample::Index),
    Reconnect,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        3 => Just(Step::Publish),
        2 => (1_usize..6, any::<bool>()).prop_map(|(count, all)| Step::Take(count, all)),
        2 => any::<prop::sample::Index>().prop_map(Step::Acknowledge),
        1 => Just(Step::Reconnect),
    ]
}

proptest! {
    /// At least once, in order of first delivery, with identifiers that are never in use twice.
    #[test]
    fn qos_1_loses_nothing_whatever_happens_to_the_connection(steps in prop::collection::vec(step(), 1..80)) {
        let mut bench = Bench::new();
        let connect = Connect { receive_maximum: 3, ..steady("c") };
        let mut peer = bench.connect(connect.clone());
        bench.subscribe(&peer, qos1("a"));
        let (mut published, mut delivered, mut open) = (0_u32, Vec::<u32>::new(), Vec::<u16>::new());
        let mut note = |taken: Vec<Outbound>, open: &mut Vec<u16>| -> Result<(), TestCaseError> {
            for outbound in taken {
                let number = String::from_utf8_lossy(&outbound.message.payload).parse::<u32>().unwrap();
                prop_assert_eq!(outbound.dup, delivered.contains(&number), "duplicates are marked");
                if !outbound.dup {
                    delivered.push(number);
                }
                prop_assert!(outbound.pkid != 0 && !open.contains(&outbound.pkid));
                open.push(outbound.pkid);
                prop_assert!(open.len() <= 3);
            }
            Ok(())
        };
        for step in steps {
            match step {
                Step::Publish => {
                    bench.publish(publish("a", &published.to_string(), QoS::AtLeastOnce));
                    published += 1;
                }
                Step::Take(count, all) => {
                    for _ in 0..count {
                        let taken = bench.state.take(bench.now, &peer.id, peer.link, 1);
                        note(taken, &mut open)?;
                    }
                    if all {
                        let session = bench.state.linked(&peer.id, peer.link).unwrap();
                        open.drain(..).for_each(|pkid| session.acknowledge(pkid));
                    }
                }
                Step::Acknowledge(_) if open.is_empty() => {}
                Step::Acknowledge(index) => {
                    let pkid = open.remove(index.index(open.len()));
                    bench.state.linked(&peer.id, peer.link).unwrap().acknowledge(pkid);
                }
                Step::Reconnect => {
                    bench.lose(&peer);
                    open.clear();
                    peer = bench.connect(connect.clone());
                }
            }
        }
        loop {
            let session = bench.state.linked(&peer.id, peer.link).unwrap();
            open.drain(..).for_each(|pkid| session.acknowledge(pkid));
            let taken = bench.take(&peer);
            if taken.is_empty() {
                break;
            }
            note(taken, &mut open)?;
        }
        prop_assert_eq!(delivered, (0..published).collect::<Vec<_>>());
    }
}
