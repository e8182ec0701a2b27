//! The state with a clock in the hand of the test.

use std::time::Duration;

use bytes::Bytes;
use proptest::prelude::*;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{PublishProperties, RetainForwardRule};

use super::super::packet::Publish;
use super::super::{MAX_INFLIGHT, MAX_QUEUE_MESSAGES};
use super::*;

/// A state and the time its test has reached.
struct Bench {
    state: State,
    now: Instant,
}

/// One connection of a client in a test.
struct Peer {
    id: String,
    link: u64,
    session_present: bool,
    ended: oneshot::Receiver<Fault>,
}

impl Bench {
    fn new() -> Bench {
        Bench {
            state: State::default(),
            now: Instant::now(),
        }
    }

    fn pass(&mut self, seconds: u64) {
        self.now += Duration::from_secs(seconds);
        self.state.tick(self.now);
    }

    fn connect(&mut self, connect: Connect) -> Peer {
        let (end, ended) = oneshot::channel();
        let attached = self
            .state
            .attach(self.now, &connect, Arc::new(Notify::new()), end)
            .unwrap();
        Peer {
            id: attached.client_id,
            link: attached.link,
            session_present: attached.session_present,
            ended,
        }
    }

    fn lose(&mut self, peer: &Peer) {
        self.state.detach(self.now, &peer.id, peer.link, Leave::Lost, None);
    }

    fn subscribe(&mut self, peer: &Peer, filter: Filter) -> SubscribeReasonCode {
        self.state.subscribe(self.now, &peer.id, peer.link, &[filter], None)[0]
    }

    fn publish(&mut self, publish: Publish) -> PubAckReason {
        self.state
            .publish(self.now, "somebody", Message::new(publish, self.now))
    }

    fn take(&mut self, peer: &Peer) -> Vec<Outbound> {
        self.state.take(self.now, &peer.id, peer.link, usize::MAX)
    }

    /// Topic and payload of all that can be sent, acknowledged at once.
    fn received(&mut self, peer: &Peer) -> Vec<String> {
        let mut received = Vec::new();
        loop {
            let taken = self.take(peer);
            if taken.is_empty() {
                return received;
            }
            for outbound in taken {
                self.state
                    .linked(&peer.id, peer.link)
                    .unwrap()
                    .acknowledge(outbound.pkid);
                let retain = if outbound.retain { " r" } else { "" };
                let payload = String::from_utf8_lossy(&outbound.message.payload).into_owned();
                received.push(format!("{} {payload}{retain}", outbound.message.topic));
            }
        }
    }
}

fn client(id: &str) -> Connect {
    Connect {
        version: Version::V5,
        client_id: id.to_owned(),
        clean_start: true,
        expiry: Expiry::AtOnce,
        keep_alive: Duration::ZERO,
        receive_maximum: u16::MAX,
        max_packet: u32::MAX,
        will: None,
        authentication: false,
    }
}

/// A client that comes back to its session.
fn steady(id: &str) -> Connect {
    Connect {
        clean_start: false,
        expiry: Expiry::After(Duration::from_secs(60)),
        ..client(id)
    }
}

fn with_will(connect: Connect, delay: u64) -> Connect {
    let delay = Duration::from_secs(delay);
    Connect {
        will: Some(Will {
            publish: retained("will", "gone"),
            delay,
        }),
        ..connect
    }
}

fn publish(topic: &str, payload: &str, qos: QoS) -> Publish {
    let payload = Bytes::copy_from_slice(payload.as_bytes());
    Publish {
        topic: topic.to_owned(),
        payload,
        qos,
        retain: false,
        pkid: 0,
        alias: None,
        properties: None,
    }
}

fn retained(topic: &str, payload: &str) -> Publish {
    Publish {
        retain: true,
        ..publish(topic, payload, QoS::AtLeastOnce)
    }
}

fn expiring(publish: Publish, seconds: u32) -> Publish {
    let properties = PublishProperties {
        message_expiry_interval: Some(seconds),
        ..PublishProperties::default()
    };
    Publish {
        properties: Some(properties),
        ..publish
    }
}

fn qos1(filter: &str) -> Filter {
    Filter::new(filter, QoS::AtLeastOnce)
}

#[test]
fn retained_messages_are_set_replaced_and_deleted() {
    let mut bench = Bench::new();
    bench.publish(retained("a/1", "old"));
    bench.publish(retained("a/1", "new"));
    bench.publish(retained("a/2", "x"));
    bench.publish(retained("a/2", ""));
    bench.publish(publish("a/3", "live", QoS::AtMostOnce));
    let peer = bench.connect(client("c"));
    assert_eq!(
        bench.subscribe(&peer, qos1("a/#")),
        SubscribeReasonCode::Success(QoS::AtLeastOnce)
    );
    assert_eq!(bench.received(&peer), ["a/1 new r"]);
    // To those who are there already it comes as an ordinary message, the empty one too.
    bench.publish(retained("a/1", "newer"));
    bench.publish(retained("a/1", ""));
    assert_eq!(bench.received(&peer), ["a/1 newer", "a/1 "]);
    assert_eq!(bench.state.retained_bytes, 0);
}

#[test]
fn the_options_of_a_v5_subscription_are_kept_to() {
    let mut bench = Bench::new();
    bench.publish(retained("a", "kept"));
    let peer = bench.connect(client("c"));
    let never = Filter {
        retain_forward_rule: RetainForwardRule::Never,
        ..qos1("a")
    };
    bench.subscribe(&peer, never);
    assert!(bench.received(&peer).is_empty());
    let once = Filter {
        retain_forward_rule: RetainForwardRule::OnNewSubscribe,
        ..qos1("+")
    };
    bench.subscribe(&peer, once.clone());
    bench.subscribe(&peer, once);
    assert_eq!(bench.received(&peer), ["a kept r"]);

    let as_published = Filter {
        preserve_retain: true,
        ..qos1("#")
    };
    bench.subscribe(&peer, as_published);
    bench.received(&peer);
    bench.publish(retained("a", "now"));
    assert_eq!(
        bench.received(&peer),
        ["a now r"],
        "one copy, retain as published by one of three"
    );

    let own = bench.connect(client("somebody"));
    bench.subscribe(
        &own,
        Filter {
            nolocal: true,
            ..qos1("b")
        },
    );
    assert_eq!(
        bench.publish(publish("b", "mine", QoS::AtLeastOnce)),
        PubAckReason::Success,
        "the other has #"
    );
    assert!(bench.received(&own).is_empty());
}

#[test]
fn overlapping_subscriptions_give_one_copy_with_all_identifiers() {
    let mut bench = Bench::new();
    let peer = bench.connect(client("c"));
    let low = Filter::new("a/+", QoS::AtMostOnce);
    bench.state.subscribe(bench.now, &peer.id, peer.link, &[low], Some(1));
    bench
        .state
        .subscribe(bench.now, &peer.id, peer.link, &[qos1("a/#")], Some(2));
    bench.publish(publish("a/b", "x", QoS::ExactlyOnce));
    let taken = bench.take(&peer);
    assert_eq!(taken.len(), 1);
    assert_eq!(
        (taken[0].qos, taken[0].subscription_ids.as_slice()),
        (QoS::AtLeastOnce, &[1, 2][..])
    );
}

#[test]
fn a_subscription_is_granted_qos_1_at_most_and_refused_with_a_reason() {
    let mut bench = Bench::new();
    let peer = bench.connect(client("c"));
    let granted = bench.subscribe(&peer, Filter::new("a", QoS::ExactlyOnce));
    assert_eq!(granted, SubscribeReasonCode::Success(QoS::AtLeastOnce));
    assert_eq!(
        bench.subscribe(&peer, qos1("a/#/b")),
        SubscribeReasonCode::TopicFilterInvalid
    );
    let shared = bench.subscribe(&peer, qos1("$share/group/a"));
    assert_eq!(shared, SubscribeReasonCode::SharedSubscriptionsNotSupported);
    for number in 1..super::super::MAX_SUBSCRIPTIONS {
        bench.subscribe(&peer, qos1(&format!("n/{number}")));
    }
    assert_eq!(
        bench.subscribe(&peer, qos1("one/more")),
        SubscribeReasonCode::QuotaExceeded
    );
    assert_eq!(
        bench.subscribe(&peer, qos1("a")),
        SubscribeReasonCode::Success(QoS::AtLeastOnce),
        "replaces"
    );
    let unsubscribed = bench
        .state
        .unsubscribe(&peer.id, peer.link, &["a".into(), "none".into()]);
    assert_eq!(
        unsubscribed,
        [UnsubAckReason::Success, UnsubAckReason::NoSubscriptionExisted]
    );
    assert_eq!(
        bench.publish(publish("a", "x", QoS::AtLeastOnce)),
        PubAckReason::NoMatchingSubscribers
    );
}

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
    assert!(
        waiting * 200_000 <= super::super::MAX_QUEUE_BYTES && waiting > 100,
        "{waiting}"
    );
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
fn a_qos_2_message_is_taken_once() {
    let mut bench = Bench::new();
    let peer = bench.connect(steady("c"));
    let session = bench.state.linked(&peer.id, peer.link).unwrap();
    assert_eq!(session.receive(1), Ok(true));
    assert_eq!(session.receive(1), Ok(false));
    bench.lose(&peer);
    let peer = bench.connect(steady("c"));
    let session = bench.state.linked(&peer.id, peer.link).unwrap();
    assert_eq!(session.receive(1), Ok(false), "sent again after a reconnect");
    assert!(session.release(1));
    assert!(!session.release(1));
    assert_eq!(session.receive(1), Ok(true));
    for pkid in 2..=super::super::RECEIVE_MAXIMUM {
        assert_eq!(session.receive(pkid), Ok(true));
    }
    assert_eq!(
        session.receive(5000).unwrap_err().reason,
        DisconnectReasonCode::ReceiveMaximumExceeded
    );
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
