//! One client with a clock in the hand of the test; the sockets are in `tests/north/broker.rs`.

use std::pin::pin;
use std::task::{Context, Poll, Waker};

use rumqttc::v5::mqttbytes::v5::Filter;

use super::*;

fn connect(keep_alive: u64) -> Connect {
    Connect {
        version: Version::V5,
        client_id: String::from("c"),
        clean_start: true,
        expiry: Expiry::AtOnce,
        keep_alive: Duration::from_secs(keep_alive),
        receive_maximum: 10,
        max_packet: u32::MAX,
        will: None,
        authentication: false,
    }
}

fn client<'a>(hub: &'a Hub, connect: &Connect, now: Instant) -> Client<'a> {
    let (end, _) = oneshot::channel();
    let attached = hub.state().attach(now, connect, Arc::new(Notify::new()), end).unwrap();
    Client::new(hub, connect, attached, BytesMut::new(), now)
}

#[test]
fn a_client_is_given_time_to_speak_and_to_read() {
    let hub = Hub::new(CancellationToken::new());
    let now = Instant::now();
    let mut silent = client(&hub, &connect(20), now);
    silent.output.clear();
    assert_eq!(silent.deadline(), Some(now + Duration::from_secs(30)));
    assert_eq!(silent.overdue(now + Duration::from_millis(29_999)), None);
    let fault = silent.overdue(now + Duration::from_secs(30)).unwrap();
    assert_eq!(fault.reason, DisconnectReasonCode::KeepAliveTimeout);
    drop(silent);

    let mut stuck = client(&hub, &connect(0), now);
    stuck.progress = now;
    assert_eq!(stuck.deadline(), Some(now + STALL_LIMIT));
    assert_eq!(
        stuck.overdue(now + STALL_LIMIT).unwrap().reason,
        DisconnectReasonCode::QuotaExceeded
    );
    stuck.output.clear();
    assert_eq!(stuck.deadline(), None);
    assert_eq!(stuck.overdue(now + Duration::from_secs(1_000_000)), None);
}

#[test]
fn an_alias_stands_for_the_topic_it_was_last_set_to() {
    let hub = Hub::new(CancellationToken::new());
    let mut client = client(&hub, &connect(0), Instant::now());
    let mut resolve = |topic: &str, alias| {
        let mut publish = Publish {
            topic: topic.to_owned(),
            payload: bytes::Bytes::new(),
            qos: QoS::AtMostOnce,
            retain: false,
            pkid: 0,
            alias: Some(alias),
            properties: None,
        };
        client.resolve_alias(&mut publish).map(|()| publish.topic)
    };
    assert!(resolve("", 1).is_err());
    assert_eq!(resolve("a", 1).unwrap(), "a");
    assert_eq!(resolve("b", MAX_TOPIC_ALIAS).unwrap(), "b");
    assert_eq!(resolve("", 1).unwrap(), "a");
    assert_eq!(resolve("c", 1).unwrap(), "c");
    assert_eq!(resolve("", 1).unwrap(), "c");
    assert_eq!(resolve("", MAX_TOPIC_ALIAS).unwrap(), "b");
    assert!(resolve("", 0).is_err());
    assert!(resolve("", MAX_TOPIC_ALIAS + 1).is_err());
}

#[test]
fn a_client_that_is_dropped_in_any_way_leaves_the_state() {
    let hub = Hub::new(CancellationToken::new());
    let client = client(&hub, &connect(0), Instant::now());
    assert_eq!(hub.state().clients(), 1);
    drop(client);
    assert_eq!(hub.state().clients(), 0);
}

#[test]
fn a_disconnect_with_any_reason_but_the_normal_one_publishes_the_will() {
    let hub = Hub::new(CancellationToken::new());
    let client = client(&hub, &connect(0), Instant::now());
    let left = |reason| match client.left(reason, None) {
        End::Left { leave, expiry: None } => leave,
        other => panic!("{other:?}"),
    };
    assert_eq!(left(DisconnectReasonCode::NormalDisconnection), Leave::Clean);
    assert_eq!(left(DisconnectReasonCode::DisconnectWithWillMessage), Leave::Lost);
    assert_eq!(left(DisconnectReasonCode::UnspecifiedError), Leave::Lost);
    // A session that was to end with the connection cannot be prolonged.
    let prolonged = client.left(DisconnectReasonCode::NormalDisconnection, Some(60));
    assert!(matches!(prolonged, End::Closed(_)), "{prolonged:?}");
}

#[test]
fn messages_that_are_too_large_for_the_client_do_not_block_the_others() {
    let hub = Hub::new(CancellationToken::new());
    let now = Instant::now();
    let mut client = client(
        &hub,
        &Connect {
            max_packet: 50,
            ..connect(0)
        },
        now,
    );
    let everything = [Filter::new("#", QoS::AtLeastOnce)];
    hub.state()
        .subscribe(now, &client.client_id, client.link, &everything, None);
    client.output.clear();
    // More than may be under way unacknowledged.
    for length in std::iter::repeat_n(100, 20).chain([10]) {
        let publish = Publish {
            topic: String::from("t"),
            payload: vec![7; length].into(),
            qos: QoS::AtLeastOnce,
            retain: false,
            pkid: 0,
            alias: None,
            properties: None,
        };
        hub.state().publish(now, "other", Message::new(publish, now));
    }
    client.fill(now);
    let sent = client.output.to_vec();
    assert_eq!(sent.len(), 2 + 3 + 2 + 1 + 10, "{sent:?}");
    assert_eq!(sent.get(..5).unwrap(), [0x32, 16, 0, 1, b't']);
}

/// Everything is in memory and polled by hand, so that "nothing moves any more" needs no time.
#[tokio::test]
async fn a_client_that_asks_and_does_not_read_is_heard_no_further() {
    let hub = Hub::new(CancellationToken::new());
    let mut client = client(&hub, &connect(0), Instant::now());
    let connack = client.output.len();
    let (mut ours, theirs) = tokio::io::duplex(4096);
    let (reader, writer) = tokio::io::split(theirs);
    let wake = Notify::new();
    let (_end, ended) = oneshot::channel();
    let mut exchange = pin!(client.exchange(reader, writer, &wake, ended, CancellationToken::new()));
    let mut context = Context::from_waker(Waker::noop());
    let pings = [0xC0, 0].repeat(2048);
    let (mut sent, mut idle) = (0, 0);
    while idle < 100 && sent < 10_000_000 {
        assert!(exchange.as_mut().poll(&mut context).is_pending());
        match pin!(ours.write(&pings)).poll(&mut context) {
            Poll::Ready(written) => {
                sent += written.unwrap();
                idle = 0;
            }
            Poll::Pending => idle += 1,
        }
        // Also renews what the runtime lets a task do at a time.
        tokio::task::yield_now().await;
    }
    assert!(sent < 2 * OUTPUT_BYTES, "{sent} bytes taken");

    // Once it reads, it is heard again, and all was answered.
    let mut answers = 0;
    let mut buffer = [0; 4096];
    while answers < connack + sent {
        assert!(exchange.as_mut().poll(&mut context).is_pending());
        if let Poll::Ready(read) = pin!(ours.read(&mut buffer)).poll(&mut context) {
            answers += read.unwrap();
        }
        tokio::task::yield_now().await;
    }
    assert!(pin!(ours.write(&pings)).poll(&mut context).is_ready());
}
