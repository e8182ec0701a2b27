use drivegate_core::files::PARTIAL;
use drivegate_core::files::names::MQTT_TOPICS;
use flume::Receiver;

use super::super::Qos;
use super::super::outbox::{Delivery, Outbox};
use super::thread::{LOCK_ATTEMPTS, LOCK_WAIT};
use super::*;

fn lost(stats: &NorthState) -> u64 {
    stats.mqtt.losses().map(|(_, count)| count).sum()
}

fn event(n: usize) -> Message {
    Message::not_retained("e", n.to_string().into_bytes())
}

/// A store whose disk works only when the test runs it.
fn stalled() -> (Store, Receiver<Job>, mpsc::Sender<Loaded>, Arc<NorthState>) {
    let (jobs, todo) = flume::bounded(JOBS);
    let (report, loaded) = mpsc::channel(4);
    let lost = Arc::<NorthState>::default();
    let store = Store {
        disk: Some(Disk {
            jobs,
            loaded,
            shared: Shared::new(lost.clone(), MqttKind::Event),
            progress: Progress::Opening(0),
        }),
    };
    (store, todo, report, lost)
}

fn number(n: u64) -> MessageNumber {
    MessageNumber::new(n)
}

/// The report of a disk with the messages 1 to `last` of earlier runs.
fn opened(last: u64) -> Loaded {
    Loaded::Opened {
        through: MessageNumber::NONE,
        last: number(last),
        topics: Vec::new(),
    }
}

#[test]
fn a_disk_that_hangs_delays_nothing() {
    let (mut store, todo, _report, lost) = stalled();
    store.take(opened(0));
    for n in 0..JOBS {
        let sent = store.push(event(n), true).expect("it is sent at once");
        assert_eq!(sent, (Some(number(n as u64 + 1)), event(n)));
    }
    let (unkept, _) = store.push(event(JOBS), true).unwrap();
    assert_eq!(unkept, None, "sent, though nothing keeps it");
    assert_eq!((store.push(event(0), false), self::lost(&lost)), (None, 1), "counted");
    assert_eq!(todo.try_iter().count(), JOBS);
}

#[test]
fn a_disk_that_hangs_costs_no_more_memory_than_that() {
    let (mut store, todo, _report, lost) = stalled();
    store.take(opened(0));
    for n in 0..1000 {
        store.push(Message::not_retained("h", format!("{n:33000}").into_bytes()), false);
    }
    let bytes: usize = todo
        .drain()
        .map(|job| match job {
            Job::Append(message, _) => message.bytes(),
            _ => 0,
        })
        .sum();
    assert!((KEPT_BYTES - 40_000..=KEPT_BYTES).contains(&bytes), "{bytes}");
    assert_eq!(self::lost(&lost) as usize, 1000 - bytes / 33_001);
}

#[test]
fn messages_wait_behind_those_on_disk() {
    let (mut store, todo, _report, _) = stalled();
    assert_eq!(store.push(event(1), true), None, "what is on disk is not known yet");
    store.take(opened(2));
    assert_eq!((store.push(event(2), true), store.waiting()), (None, 4));
    store.load(100);
    store.load(100);
    let jobs: Vec<Job> = todo.try_iter().collect();
    assert!(matches!(
        jobs[..],
        [Job::Append(_, false), Job::Append(_, false), Job::Load(100)]
    ));
    let messages = (1..=4).map(|n| (number(n), event(9))).collect();
    let through = number(4);
    let (loaded, _) = store.take(Loaded::Messages { messages, through });
    assert_eq!((loaded.len(), store.waiting()), (4, 0));
    assert_eq!(store.push(event(3), true).unwrap().0, Some(number(5)));
    store.acknowledge(Some(number(4)));
    store.acknowledge(Some(number(4)));
    store.acknowledge(None);
    let noted = todo.try_iter().filter_map(|job| match job {
        Job::Acknowledge(number) => Some(number),
        _ => None,
    });
    assert_eq!(noted.collect::<Vec<_>>(), [number(3), number(5)]);
}

#[tokio::test]
async fn what_is_not_acknowledged_is_there_in_the_next_run() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    };
    let mut store = Store::open(Some(buffer.clone()), "mqtt-events", &Arc::default(), MqttKind::Event);
    for n in 0..10 {
        store.push(event(n), false);
    }
    let report = store.next().await;
    store.take(report);
    store.load(4);
    let report = store.next().await;
    assert_eq!(store.take(report).0.len(), 4);
    store.acknowledge(Some(number(3)));
    store.remember(vec!["a/b".to_string(), "c".to_string()]);
    store.close().await;

    let mut store = Store::open(Some(buffer), "mqtt-events", &Arc::default(), MqttKind::Event);
    let report = store.next().await;
    let (_, topics) = store.take(report);
    assert_eq!(topics, ["a/b", "c"]);
    assert_eq!(store.waiting(), 8);
    store.push(event(10), true);
    store.load(100);
    let report = store.next().await;
    let (messages, _) = store.take(report);
    let numbers: Vec<u64> = messages.iter().map(|(number, _)| number.get()).collect();
    assert_eq!(numbers, (3..=11).collect::<Vec<_>>(), "as they were in the last run");
    assert_eq!(messages[0].1, event(2));
    assert_eq!(store.push(event(11), true).unwrap().0, Some(number(12)));
}

#[tokio::test]
async fn a_directory_that_cannot_be_used_leaves_messages_in_memory() {
    let buffer = Buffer {
        dir: "/proc/drivegate".into(),
        max_bytes: 1 << 20,
    };
    let mut store = Store::open(Some(buffer), "mqtt-events", &Arc::default(), MqttKind::Event);
    store.push(event(0), true);
    let report = store.next().await;
    store.take(report);
    store.load(10);
    let report = store.next().await;
    assert_eq!(store.take(report).0, [(number(1), event(0))]);
    assert_eq!(store.push(event(1), true).unwrap().0, Some(number(2)));
}

/// Waits until the disk has finished all its jobs.
async fn settle(store: &mut Store) {
    // The second answer arrives after the first job is done.
    for _ in 0..2 {
        store.disk.as_ref().unwrap().jobs.send(Job::Load(0)).unwrap();
        let report = store.next().await;
        store.take(report);
    }
}

#[tokio::test]
async fn of_a_full_buffer_each_message_waits_or_is_counted_over_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 64 << 10,
    };
    let counted = Arc::<NorthState>::default();
    let mut store = Store::open(Some(buffer.clone()), "mqtt-events", &counted, MqttKind::Event);
    let report = store.next().await;
    store.take(report);
    let mut outbox = Outbox::new(Delivery {
        telemetry: Qos::AtMostOnce,
        events: Qos::AtLeastOnce,
        expiry: None,
    });
    // The first 1,024 messages enter the outbox at once.
    for n in 0..1240 {
        let message = Message::not_retained("e", format!("{n:200}").into_bytes());
        if let Some((number, message)) = store.push(message, outbox.room(MqttKind::Event) > 0) {
            outbox.push(MqttKind::Event, message, number);
        }
    }
    settle(&mut store).await;
    outbox.drop_gone(MqttKind::Event, store.gone());
    let waiting = outbox.events() as u64 + store.waiting();
    let given_up = lost(&counted) + outbox.take_lost().iter().map(|(_, count)| count).sum::<u64>();
    assert!((150..400).contains(&waiting), "{waiting} in 64 KiB");
    assert_eq!(waiting + given_up, 1240);
    store.close().await;

    let counted = Arc::<NorthState>::default();
    let mut store = Store::open(Some(buffer), "mqtt-events", &counted, MqttKind::Event);
    let report = store.next().await;
    store.take(report);
    assert_eq!(store.waiting(), waiting);
    store.load(usize::MAX);
    let report = store.next().await;
    let (messages, _) = store.take(report);
    let numbers = messages
        .iter()
        .map(|(_, message)| String::from_utf8_lossy(&message.payload).trim().to_string());
    let newest = (1240 - waiting..1240).map(|n| n.to_string());
    assert!(numbers.eq(newest), "the newest, in order");
    assert_eq!(lost(&counted), 0, "they were counted before");
}

#[tokio::test]
async fn deleted_files_and_topics_are_written_again() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().join("buffer"),
        max_bytes: 1 << 20,
    };
    let mut store = Store::open(Some(buffer.clone()), "mqtt-events", &Arc::default(), MqttKind::Event);
    store.remember(vec!["a/b".to_string()]);
    (0..5).for_each(|n| drop(store.push(event(n), false)));
    let report = store.next().await;
    store.take(report);
    settle(&mut store).await;
    // The disk thread may write deleted files again while the folder is emptied.
    while buffer.dir.exists() {
        let _ = std::fs::remove_dir_all(&buffer.dir);
    }
    store.push(event(5), false);
    store.close().await;
    let mut store = Store::open(Some(buffer), "mqtt-events", &Arc::default(), MqttKind::Event);
    let report = store.next().await;
    let (_, topics) = store.take(report);
    assert_eq!((store.waiting(), topics), (6, vec!["a/b".to_string()]));
}

#[tokio::test]
async fn a_list_of_topics_that_finds_no_room_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    };
    let new = dir.path().join(MQTT_TOPICS).with_extension(PARTIAL);
    std::os::unix::fs::symlink("/dev/full", &new).unwrap();
    let store = Store::open(Some(buffer), "mqtt-events", &Arc::default(), MqttKind::Event);
    store.remember(vec!["a/b".to_string()]);
    store.close().await;
    assert!(new.symlink_metadata().is_err(), "it would take the room of messages");
    let topics = std::fs::read_to_string(dir.path().join(MQTT_TOPICS)).unwrap();
    assert_eq!(topics, "a/b", "they are offered again");
}

fn open(buffer: &Buffer, stats: &Arc<NorthState>) -> Store {
    Store::open(Some(buffer.clone()), "mqtt-events", stats, MqttKind::Event)
}

/// Waits for the first report of the disk; returns the topics of the last run.
async fn opened_with(store: &mut Store) -> Vec<String> {
    let report = store.next().await;
    assert!(matches!(report, Loaded::Opened { .. }), "{report:?}");
    store.take(report).1
}

/// Another gateway would clear the topics of the one to which the directory belongs.
#[tokio::test]
async fn without_the_lock_the_topics_of_the_owner_are_neither_read_nor_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    };
    let mut owner = open(&buffer, &Arc::default());
    opened_with(&mut owner).await;
    owner.remember(vec!["hall-a/status".to_string()]);
    settle(&mut owner).await;
    let mut other = open(&buffer, &Arc::default());
    assert_eq!(opened_with(&mut other).await, Vec::<String>::new());
    other.remember(vec!["hall-b/status".to_string()]);
    settle(&mut other).await;
    other.close().await;
    let kept = || std::fs::read_to_string(dir.path().join(MQTT_TOPICS)).unwrap();
    assert_eq!(kept(), "hall-a/status");
    owner.close().await;
    assert_eq!(kept(), "hall-a/status");
}

/// The store of the client before a reload still writes when that of the next client begins.
#[tokio::test]
async fn a_store_follows_the_one_before_however_long_that_writes() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    };
    let stats = Arc::<NorthState>::default();
    let mut before = open(&buffer, &stats);
    opened_with(&mut before).await;
    (0..3).for_each(|n| drop(before.push(event(n), false)));
    before.remember(vec!["a/b".to_string()]);
    // A thread that is waiting for the disk has its jobs, like this one.
    let writing = before.disk.as_ref().map(|disk| disk.jobs.clone());
    drop(before);
    let mut store = open(&buffer, &stats);
    store.push(event(3), true);
    // A lock that somebody else has is waited for as long as this, at most.
    tokio::time::sleep(LOCK_WAIT * (LOCK_ATTEMPTS + 10)).await;
    drop(writing);
    assert_eq!(opened_with(&mut store).await, ["a/b"]);
    assert_eq!(store.waiting(), 4);
    store.close().await;
    let mut store = open(&buffer, &stats);
    opened_with(&mut store).await;
    assert_eq!(store.waiting(), 4, "all are on disk");
}
