use arc_swap::ArcSwap;

use super::super::{Buffer, fixture};
use super::*;
use crate::event::{BURST, EventKind};

fn options(buffer: Option<Buffer>) -> Options {
    Options {
        host: "127.0.0.1".to_string(),
        port: 1,
        tls: false,
        client_id: "test".to_string(),
        username: None,
        password: None,
        ca: None,
        identity: None,
        base: "drivegate".to_string(),
        min_interval: Duration::from_millis(100),
        max_interval: Duration::from_secs(60),
        commands: true,
        buffer,
    }
}

async fn client(buffer: Option<Buffer>) -> Client {
    let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(fixture::plant(&["p1"])));
    let events = plant.load().events.subscribe();
    Client::new(options(buffer), plant, Arc::default(), events).await
}

/// Raises events while the client is busy, then lets it receive them.
async fn burst(client: &mut Client, count: usize) {
    for n in 0..count {
        client.plant.load().events.publish(Event {
            id: 0,
            time: SystemTime::UNIX_EPOCH,
            kind: EventKind::Offline,
            bus: "line1".to_string(),
            drive: Some("p1".to_string()),
            fault_code: None,
            text: format!("event {n}"),
            recording: None,
        });
    }
    let received = client.events.recv().await;
    client.on_event(received);
}

#[tokio::test]
async fn a_busy_client_loses_no_event_of_a_burst() {
    let mut client = client(None).await;
    burst(&mut client, 1000).await;
    assert_eq!((client.outbox.waiting(), client.missed, client.dropped()), (1000, 0, 0));
    let (_, first) = client.outbox.next(1).unwrap();
    assert!(first.payload.windows(8).any(|w| w == b"event 0\""));
    burst(&mut client, BURST - 1000).await;
    assert_eq!(
        (client.outbox.waiting(), client.missed, client.dropped()),
        (BURST, 0, 0)
    );
}

#[tokio::test]
async fn a_burst_goes_to_the_disk_where_there_is_a_buffer() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 64 << 20,
    };
    let mut client = client(Some(buffer)).await;
    burst(&mut client, 1000).await;
    assert_eq!((client.store.waiting(), client.missed), (1000, 0));
}

#[tokio::test]
async fn lost_events_are_counted() {
    let mut client = client(None).await;
    burst(&mut client, BURST + 10).await;
    assert_eq!((client.outbox.waiting(), client.missed), (BURST, 10));
}
