use std::fs::OpenOptions;
use std::os::unix::fs::OpenOptionsExt as _;

use arc_swap::ArcSwap;

use super::super::{Broker, Buffer, Qos, Telemetry, fixture};
use super::*;
use drivegate_core::event::{BURST, EventKind};
use drivegate_core::process_image::{BusImage, BusSpec};

pub(crate) fn options(buffer: Option<Buffer>) -> Options {
    Options {
        retain: true,
        brokers: vec![Broker {
            host: "127.0.0.1".to_string(),
            port: 1,
            path: None,
        }],
        tls: false,
        client_id: "test".to_string(),
        username: None,
        password: None,
        proxy: None,
        publish_limit: 0,
        ca: None,
        identity: None,
        base: "drivegate".to_string(),
        telemetry: Telemetry {
            state: true,
            points: true,
            history: History::Off,
        },
        telemetry_qos: Qos::AtMostOnce,
        event_qos: Qos::AtLeastOnce,
        expiry: None,
        message_expiry: None,
        min_interval: Duration::from_millis(100),
        max_interval: Duration::from_secs(60),
        commands: true,
        require_id: false,
        response_topics: Vec::new(),
        principals: None,
        buffer,
        home_assistant: None,
        sparkplug: None,
    }
}

async fn client(buffer: Option<Buffer>) -> PlainClient {
    client_with(options(buffer)).await
}

async fn client_with(options: Options) -> PlainClient {
    let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(fixture::plant(&["p1"])));
    let events = plant.load().events.subscribe();
    PlainClient::new(
        options,
        Right::lasting(),
        ClientLeft::default(),
        plant,
        Arc::default(),
        events,
    )
}

fn lost_events(client: &mut PlainClient) -> u64 {
    let lost = client.outbox.take_lost().into_iter();
    lost.filter(|(kind, _)| *kind == MqttKind::Event)
        .map(|(_, count)| count)
        .sum()
}

/// Raises events while the client is busy, then lets it receive them.
async fn burst(client: &mut PlainClient, count: usize) {
    for n in 0..count {
        client.common.plant.load().events.publish(Event {
            bus: "line1".to_string(),
            drive: Some("p1".to_string()),
            ..Event::new(EventKind::Offline, SystemTime::UNIX_EPOCH, format!("event {n}"))
        });
    }
    let received = client.events.recv().await;
    client.on_event(received);
}

#[tokio::test]
async fn a_busy_client_loses_no_event_of_a_burst() {
    let mut client = client(None).await;
    burst(&mut client, 1000).await;
    assert_eq!(
        (client.outbox.waiting(), client.missed, lost_events(&mut client)),
        (1000, 0, 0)
    );
    let (_, first) = client.outbox.next(1, true).unwrap();
    assert!(first.payload.windows(8).any(|w| w == b"event 0\""));
    burst(&mut client, BURST - 1000).await;
    assert_eq!(
        (client.outbox.waiting(), client.missed, lost_events(&mut client)),
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

/// Raises a fault and then more refusals than there is room for; returns the number of waiting events and of lost ones.
async fn a_fault_and_a_flood(client: &mut PlainClient, refusals: usize) -> (u64, u64) {
    burst(client, 1).await;
    for n in 0..refusals {
        let event = Event {
            bus: "line1".to_string(),
            drive: Some("p1".to_string()),
            count: Some(1),
            ..Event::new(
                EventKind::RefusedCommand,
                SystemTime::UNIX_EPOCH,
                format!("refused {n}"),
            )
        };
        client.on_event(Ok(Arc::new(event)));
    }
    let (_, lost) = client.common.stats.mqtt.losses().next().unwrap();
    (client.waiting_events(), lost)
}

#[tokio::test]
async fn refusals_push_out_no_event_of_a_drive_in_memory_or_on_disk() {
    let (half, refusals) = (BURST as u64 / 2, BURST as u64);
    let mut in_memory = client(None).await;
    assert_eq!(
        a_fault_and_a_flood(&mut in_memory, BURST).await,
        (half, refusals - (half - 1))
    );
    burst(&mut in_memory, BURST / 2).await;
    assert_eq!(
        in_memory.waiting_events(),
        BURST as u64,
        "events of drives have the rest"
    );
    let (_, first) = in_memory.outbox.next(1, true).unwrap();
    assert!(
        first.payload.windows(8).any(|w| w == b"event 0\""),
        "the fault is there"
    );
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 64 << 10,
    };
    assert_eq!(
        a_fault_and_a_flood(&mut client(Some(buffer)).await, 1000).await,
        (32, 969)
    );
}

/// Imitates a reload: bus `line1` with drive `p1` is removed, `line2` with `p2` is added.
fn reload(client: &PlainClient) {
    let mut plant = Plant {
        events: client.common.plant.load().events.clone(),
        ..fixture::plant(&["p2"])
    };
    let bus = &mut plant.buses[0];
    let spec = BusSpec {
        name: "line2".to_string(),
        ..bus.image.spec.clone()
    };
    bus.image = Arc::new(BusImage::new(spec, bus.image.drives.to_vec()));
    client.common.plant.store(Arc::new(plant));
}

/// The topics of what waits, in order.
fn waiting(client: &mut PlainClient) -> Vec<String> {
    let next = || {
        let (key, message) = client.outbox.next(1, true)?;
        client.outbox.give_up(key);
        Some(message.topic.to_string())
    };
    std::iter::from_fn(next).collect()
}

#[tokio::test]
async fn events_of_a_bus_that_a_reload_removes_or_adds_go_to_its_drives() {
    let mut client = client(None).await;
    reload(&client);
    for bus in ["line1", "line2"] {
        client.common.plant.load().events.publish(Event {
            bus: bus.to_string(),
            ..Event::new(EventKind::BusDown, SystemTime::UNIX_EPOCH, String::new())
        });
    }
    session::follow_plant(&mut client);
    client.take_pending_events();
    assert_eq!(
        waiting(&mut client),
        ["drivegate/hall/drive/p1/event", "drivegate/hall/drive/p2/event"]
    );
}

#[tokio::test]
async fn a_reload_while_the_broker_is_away_keeps_the_history_so_far() {
    let mut options = options(None);
    options.telemetry.history = History::All;
    let mut client = client_with(options).await;
    fixture::read(&client.common.plant.load(), "p1", 0x0023, 2500, Instant::now());
    client.publish_due();
    assert_eq!(waiting(&mut client), [""; 0], "no array is complete");
    reload(&client);
    session::follow_plant(&mut client);
    assert_eq!(waiting(&mut client), ["drivegate/hall/drive/p1/history"]);
}

#[tokio::test]
async fn what_is_in_memory_only_is_counted_when_the_client_ends() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    };
    for (buffer, expected) in [(None, 5), (Some(buffer), 0)] {
        let mut client = client(buffer).await;
        burst(&mut client, 5).await;
        let stats = client.common.stats.clone();
        client.shut_down().await;
        assert_eq!(stats.mqtt.losses().map(|(_, count)| count).sum::<u64>(), expected);
    }
}

/// A reload discards what no client took, before the task of the new client has run.
#[tokio::test]
async fn a_client_takes_what_the_one_before_left_when_it_is_started() {
    let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(fixture::plant(&["p1"])));
    let stats = Arc::<NorthState>::default();
    let handover = Handover::of(&stats);
    handover.lock().client.orders = Some(OrdersLeft::default());
    let cancel = CancellationToken::new();
    let started = crate::start(options(None), plant, stats.clone(), cancel.clone());
    // There was no await yet, so the client's task has not started.
    assert!(handover.lock().client.orders.is_none());
    handover.discard();
    cancel.cancel();
    drivegate_north::Server::stopped(started).await;
    assert!(handover.lock().client.orders.is_some(), "and leaves it to the next one");
}

/// A disk that hangs is imitated by a named pipe, into which nothing is written.
#[tokio::test]
async fn a_password_file_that_hangs_ends_the_attempt_and_delays_no_stop() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("token");
    let mode = rustix::fs::Mode::from_raw_mode(0o600);
    rustix::fs::mknodat(rustix::fs::CWD, &path, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    let mut options = options(None);
    options.username = Some("hall".to_string());
    options.password = Some(crate::Password::File(path.clone()));
    let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(fixture::plant(&["p1"])));
    let (stats, cancel) = (Arc::<NorthState>::default(), CancellationToken::new());
    let started = crate::start(options, plant, stats.clone(), cancel.clone());
    // The pipe opens for writing once somebody reads it.
    let writer = loop {
        let waits_not = rustix::fs::OFlags::NONBLOCK.bits().cast_signed();
        match OpenOptions::new().write(true).custom_flags(waits_not).open(&path) {
            Ok(writer) => break writer,
            Err(_) => tokio::time::sleep(Duration::from_millis(5)).await,
        }
    };
    let error = || stats.mqtt.plain.get().and_then(|state| state.error);
    while error().is_none() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let (_, why) = error().unwrap();
    assert!(why.contains("did not answer in time"), "{why}");
    cancel.cancel();
    drivegate_north::Server::stopped(started).await;
    assert!(!stats.mqtt.configured.load(Ordering::Relaxed));
    drop(writer);
}

#[tokio::test]
async fn a_client_that_does_not_end_is_aborted_before_the_next_one_starts() {
    let (guard, mut ended) = tokio::sync::oneshot::channel::<()>();
    let stuck = tokio::spawn(async move {
        let _guard = guard;
        std::future::pending::<()>().await;
    });
    let stuck = crate::Mqtt {
        tasks: vec![stuck],
        rights: None,
    };
    drivegate_north::Server::stopped(stuck).await;
    assert!(
        ended
            .try_recv()
            .is_err_and(|error| error == tokio::sync::oneshot::error::TryRecvError::Closed)
    );
}
