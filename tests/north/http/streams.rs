//! Tests of server-sent events.

use std::time::{Duration, UNIX_EPOCH};

use drivegate_core::event::EventKind;
use drivegate_core::process_image::{Direction, FrameRecord};
use drivegate_http::MAX_LISTENERS_PER_ADDRESS;
use serde_json::json;
use tokio::time::timeout;

use super::client::{EventStream, Message, PATIENCE, get, request};
use super::plant::{self, Server, event};

/// A server with two events.
async fn served() -> Server {
    let plant = plant::mixed();
    plant
        .events
        .publish(event(EventKind::Online, "pump-1", "pump-1 answers"));
    plant
        .events
        .publish(event(EventKind::Fault, "saw-4", "fault 7: saturation trip"));
    Server::of(plant).await
}

async fn next(stream: &mut EventStream) -> Message {
    stream.next().await.expect("a message")
}

#[tokio::test]
async fn events_kept_and_new() {
    let server = served().await;
    let mut stream = EventStream::open(server.address, "/api/v1/events", "").await;
    assert!(
        stream
            .head
            .to_ascii_lowercase()
            .contains("content-type: text/event-stream"),
        "{}",
        stream.head
    );
    let first = next(&mut stream).await.json();
    assert_eq!((&first["event"], &first["drive"]), (&json!("online"), &json!("pump-1")));
    assert!(humantime::parse_rfc3339(first["time"].as_str().unwrap()).is_ok());
    let fault = next(&mut stream).await.json();
    assert_eq!(fault["bus"], json!("line1"));
    assert_eq!((&fault["event"], &fault["fault_code"]), (&json!("fault"), &json!(7)));
    server
        .plant()
        .events
        .publish(event(EventKind::FaultEnd, "saw-4", "the fault is gone"));
    let live = next(&mut stream).await.json();
    assert_eq!((&live["id"], &live["event"]), (&json!(3), &json!("fault_end")));
}

#[tokio::test]
async fn a_burst_of_all_drives_is_not_lost() {
    let server = served().await;
    let mut stream = EventStream::open(server.address, "/api/v1/events", "")
        .await
        .opened()
        .await;
    // No event is sent before all are published: the server has one thread, which runs this test.
    for _ in 0..1000 {
        server
            .plant()
            .events
            .publish(event(EventKind::Offline, "pump-1", "pump-1 does not answer"));
    }
    for id in 1..=1002 {
        let heard = next(&mut stream).await;
        assert_eq!((heard.event.as_str(), &heard.json()["id"]), ("", &json!(id)));
    }
    let headers = "Accept: application/json\r\n";
    let kept = request(server.address, "GET", "/api/v1/events", headers).await.json();
    assert_eq!(
        kept["events"].as_array().unwrap().len(),
        1002,
        "and for those that come later"
    );
}

#[tokio::test]
async fn a_client_goes_on_where_it_stopped() {
    let server = served().await;
    let mut stream = EventStream::open(server.address, "/api/v1/events", "").await;
    let id = next(&mut stream).await.id;
    drop(stream);
    let first = async |last: &str| {
        let header = format!("Last-Event-ID: {last}\r\n");
        let mut stream = EventStream::open(server.address, "/api/v1/events", &header).await;
        next(&mut stream).await.json()["id"].as_u64()
    };
    assert_eq!(first(&id).await, Some(2));
    assert_eq!(first("1").await, Some(2));
    assert_eq!(first("another-1").await, Some(1), "an id of another run of the gateway");
    assert_eq!(first("900").await, Some(1), "an id that cannot be of this run");
    assert_eq!(first("rubbish").await, Some(1));
}

#[tokio::test]
async fn events_as_json_for_those_that_ask_now_and_then() {
    let server = served().await;
    let ask = async |last: &str| {
        let headers = format!("Accept: application/json\r\nLast-Event-ID: {last}\r\n");
        request(server.address, "GET", "/api/v1/events", &headers).await.json()
    };
    let all = ask("").await;
    assert_eq!(all["events"].as_array().unwrap().len(), 2);
    assert_eq!(all["events"][0]["event"], json!("online"));
    let last = all["last"].as_str().unwrap();
    assert_eq!(ask(last).await, json!({"last": last, "events": []}));
    server
        .plant()
        .events
        .publish(event(EventKind::FaultEnd, "saw-4", "the fault is gone"));
    assert_eq!(ask(last).await["events"][0]["id"], json!(3));
}

fn frame(direction: Direction, byte: u8) -> FrameRecord {
    FrameRecord {
        time: UNIX_EPOCH + Duration::from_micros(1_700_000_000_123_456),
        gap: (direction == Direction::Reply).then_some(Duration::from_nanos(1_912_345)),
        direction,
        drive: Some("saw-4".to_string()),
        bytes: vec![1, 3, byte],
        decode: "read holding 2100..2110".to_string(),
        verdict: "ok".to_string(),
    }
}

#[tokio::test]
async fn frames_of_one_bus() {
    let server = served().await;
    let plant = server.plant();
    assert!(!plant.buses[0].image.trace.has_listener());
    let mut stream = EventStream::open(server.address, "/api/v1/trace?bus=line1", "")
        .await
        .opened()
        .await;
    assert!(plant.buses[0].image.trace.has_listener() && !plant.buses[1].image.trace.has_listener());
    plant.buses[0].image.trace.publish(|| frame(Direction::Request, 0xAB));
    plant.buses[1].image.trace.publish(|| frame(Direction::Request, 0xCD));
    plant.buses[0].image.trace.publish(|| frame(Direction::Reply, 0xEF));
    assert_eq!(
        next(&mut stream).await.json(),
        json!({"bus": "line1", "time": "2023-11-14T22:13:20.123456Z", "gap_us": null, "direction": "request",
            "drive": "saw-4", "hex": "01 03 AB", "decode": "read holding 2100..2110", "verdict": "ok"})
    );
    let reply = next(&mut stream).await.json();
    assert_eq!((&reply["gap_us"], &reply["direction"]), (&json!(1912), &json!("reply")));
    assert_eq!(reply["hex"], json!("01 03 EF"));
    drop(stream);
    let unwanted = async {
        while plant.buses[0].image.trace.has_listener() {
            plant.buses[0].image.trace.publish(|| frame(Direction::Request, 0));
            tokio::task::yield_now().await;
        }
    };
    timeout(PATIENCE, unwanted).await.expect("nobody listens any more");
}

#[tokio::test]
async fn frames_of_all_buses() {
    let server = served().await;
    let plant = server.plant();
    let mut stream = EventStream::open(server.address, "/api/v1/trace", "")
        .await
        .opened()
        .await;
    for bus in &plant.buses {
        bus.image.trace.publish(|| frame(Direction::Request, 1));
    }
    let mut buses = vec![
        next(&mut stream).await.json()["bus"].clone(),
        next(&mut stream).await.json()["bus"].clone(),
    ];
    buses.sort_by_key(ToString::to_string);
    assert_eq!(buses, [json!("line1"), json!("line2")]);
}

#[tokio::test]
async fn unknown_buses_are_told() {
    let server = served().await;
    let reply = get(server.address, "/api/v1/trace?bus=hall%201").await;
    assert_eq!(reply.status, 404);
    assert_eq!(
        reply.json(),
        json!({"error": "there is no bus `hall 1`", "known": ["line1", "line2"]})
    );
    let reply = get(server.address, "/api/v1/trace?line=line1").await;
    assert_eq!(reply.status, 400);
    assert_eq!(
        reply.json(),
        json!({"error": "unknown parameter `line`", "known": ["bus"]})
    );
}

#[tokio::test]
async fn a_slow_listener_is_told_what_it_lost() {
    let server = served().await;
    let plant = server.plant();
    let mut stream = EventStream::open(server.address, "/api/v1/trace?bus=line1", "")
        .await
        .opened()
        .await;
    // On one thread the server cannot send in between, so the number of lost events is certain.
    for count in 0..2000_u32 {
        plant.buses[0]
            .image
            .trace
            .publish(|| frame(Direction::Request, (count % 256) as u8));
    }
    let lagged = next(&mut stream).await;
    assert_eq!(
        (lagged.event.as_str(), lagged.json()),
        ("lagged", json!({"lost": 2000 - 1024}))
    );
    assert_eq!(
        next(&mut stream).await.json()["hex"],
        json!(format!("01 03 {:02X}", (2000 - 1024) % 256))
    );
}

#[tokio::test]
async fn listeners_are_bounded_and_places_come_back() {
    let server = served().await;
    let mut open = Vec::new();
    for _ in 0..MAX_LISTENERS_PER_ADDRESS {
        open.push(
            EventStream::open(server.address, "/api/v1/trace", "")
                .await
                .opened()
                .await,
        );
    }
    for place in ["/api/v1/events", "/api/v1/trace"] {
        let reply = get(server.address, place).await;
        assert_eq!((reply.status, reply.header("retry-after")), (503, Some("5")), "{place}");
    }
    assert_eq!(get(server.address, "/healthz").await.status, 200);
    drop(open);
    let again = async {
        // A stream without a reader ends when the server next writes to it.
        while EventStream::open(server.address, "/api/v1/events", "")
            .await
            .head
            .contains(" 503 ")
        {
            server.plant().buses[0]
                .image
                .trace
                .publish(|| frame(Direction::Request, 0));
        }
    };
    timeout(PATIENCE, again).await.expect("a place");
}

#[tokio::test]
async fn a_stream_ends_when_its_source_is_gone() {
    let server = served().await;
    let mut stream = EventStream::open(server.address, "/api/v1/trace?bus=line1", "")
        .await
        .opened()
        .await;
    server.shared.store(std::sync::Arc::new(plant::plant(Vec::new())));
    assert_eq!(stream.next().await, None);
}
