//! The state with a clock in the hand of the test.

use std::time::Duration;

use bytes::Bytes;
use proptest::prelude::*;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{PublishProperties, RetainForwardRule};

use super::super::packet::Publish;
use super::super::{MAX_INFLIGHT, MAX_QUEUE_MESSAGES};
use super::*;

mod bounds;
mod sessions;

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
