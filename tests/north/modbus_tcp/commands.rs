//! Writes: what reaches the bus, and when they are answered.

use drivegate_model::drive::PointIndex;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use drivegate_core::event::EventKind;
use drivegate_core::order::{CAPACITY, Order, Outcome, SourceKind};
use drivegate_model::drive::Value;
use drivegate_proto::Table;

use super::rig::{Rig, acknowledge, frame, registers, until, words, write};

/// The points of an order as text.
fn named(rig: &Rig, order: &Order) -> String {
    let profile = rig.drive("pump-1").spec.profile.clone();
    match order {
        Order::Points(values) => {
            let one = |(i, v): &(PointIndex, Value)| format!("{}={v}", profile.points.get(*i).unwrap().name);
            values.iter().map(one).collect::<Vec<_>>().join(" ")
        }
        other => format!("{other:?}"),
    }
}

fn orders(rig: &Rig) -> Vec<String> {
    rig.buses[0].orders().iter().map(|o| named(rig, o)).collect()
}

#[tokio::test]
async fn one_write_is_one_command() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    client.ask(1, &write(0x8100, &[1, 5000, 0xFFFF, 0])).await;
    client.ask(1, &write(0x8101, &[0x8000, 2500])).await;
    client.ask(1, &words(6, &[0x8101, 100])).await;
    assert_eq!(
        orders(&rig),
        [
            "run=true reverse=false speed_reference=50",
            // 25 Hz of 0 to 50 Hz.
            "speed_reference=50",
            "speed_reference=1"
        ]
    );
    rig.end().await;
}

#[tokio::test]
async fn a_stop_in_a_block_is_carried_out_though_the_rest_is_refused() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    for (values, exception) in [
        (&[0, 20_000][..], 3),
        (&[0, 0x8000], 3),
        (&[0, 5000, 2500], 3),
        (&[0, 0x8000, 0xFFFF, 0, 0], 2),
    ] {
        assert_eq!(
            client.ask(1, &write(0x8100, values)).await,
            [0x90, exception],
            "{values:?}"
        );
        assert_eq!(orders(&rig), ["run=false reverse=false"], "{values:?}");
    }
    assert_eq!(client.ask(1, &write(0x8100, &[0, 0x8000, 0xFFFF])).await[0], 16);
    assert_eq!(client.ask(1, &write(0x8100, &[0, 4000])).await[0], 16);
    assert_eq!(
        orders(&rig),
        [
            "run=false reverse=false",
            "run=false reverse=false",
            "speed_reference=40"
        ]
    );
    rig.end().await;
}

#[tokio::test]
async fn fault_reset_is_an_edge_shared_by_all_clients() {
    let rig = Rig::new().await;
    let (mut one, mut other) = (rig.client().await, rig.client().await);
    for (client, word) in [(&mut one, 4), (&mut other, 4)] {
        client.ask(1, &words(6, &[0x8100, word])).await;
    }
    other.ask(1, &words(6, &[0x8100, 0])).await;
    one.ask(1, &words(6, &[0x8100, 5])).await;
    let (reset, plain) = ("fault_reset=true", "run=false reverse=false");
    assert_eq!(
        orders(&rig),
        [plain, reset, plain, plain, "run=true reverse=false fault_reset=true"]
    );
    rig.end().await;
}

#[tokio::test]
async fn every_fault_can_be_reset_by_the_same_word() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    for _ in 0..2 {
        rig.drive("pump-1")
            .update(|s| s.store(Table::Holding, 2100, &[0x0008], Instant::now()));
        client.ask(1, &words(6, &[0x8100, 4])).await;
        rig.drive("pump-1")
            .update(|s| s.store(Table::Holding, 2100, &[0x0001], Instant::now()));
    }
    client.ask(1, &words(6, &[0x8100, 4])).await;
    let (reset, plain) = ("fault_reset=true", "run=false reverse=false");
    assert_eq!(orders(&rig), [plain, reset, plain, reset, plain]);
    rig.end().await;
}

#[tokio::test]
async fn a_fault_reset_that_failed_can_be_repeated() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    rig.buses[0].answers(|_| Some(Outcome::TimedOut));
    assert_eq!(client.ask(1, &words(6, &[0x8100, 4])).await, [0x86, 0x0B]);
    rig.buses[0].answers(|c| Some(acknowledge(c)));
    assert_eq!(client.ask(1, &words(6, &[0x8100, 4])).await, words(6, &[0x8100, 4]));
    let (reset, plain) = ("fault_reset=true", "run=false reverse=false");
    assert_eq!(orders(&rig), [plain, reset, plain, reset]);
    rig.end().await;
}

#[tokio::test]
async fn a_write_is_answered_after_the_drive_and_holds_nobody_up() {
    let rig = Rig::new().await;
    let (mut writer, mut reader) = (rig.client().await, rig.client().await);
    let acknowledged = Arc::new(AtomicBool::new(false));
    let seen = acknowledged.clone();
    rig.buses[0].answers(move |c| {
        seen.store(true, Ordering::SeqCst);
        Some(acknowledge(c))
    });
    rig.buses[0].pause(true);
    let written = writer.request(1, &words(6, &[0x8101, 5000])).await;
    until("the write waits", || rig.buses[0].waiting() == 1).await;
    // Other clients, and later requests of the same client, are answered meanwhile.
    assert_eq!(reader.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    let read = writer.request(1, &words(3, &[2102, 1])).await;
    assert_eq!(writer.answer().await, Some((read, 1, registers(3, &[5000]))));
    assert!(!acknowledged.load(Ordering::SeqCst));
    rig.buses[0].pause(false);
    assert_eq!(writer.answer().await, Some((written, 1, words(6, &[0x8101, 5000]))));
    assert!(acknowledged.load(Ordering::SeqCst));
    rig.end().await;
}

#[tokio::test]
async fn pipelined_writes_reach_the_bus_in_their_order() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let values: Vec<u16> = (0..500).collect();
    let batch: Vec<u8> = values
        .iter()
        .flat_map(|v| frame(*v, 1, &words(6, &[2003, *v])))
        .collect();
    client.send(&batch).await;
    let mut answered = Vec::new();
    for _ in &values {
        let (transaction, _, pdu) = client.answer().await.unwrap();
        assert_eq!(pdu, words(6, &[2003, transaction]));
        answered.push(transaction);
    }
    answered.sort_unstable();
    assert_eq!(answered, values, "one answer each");
    let written: Vec<Order> = rig.buses[0].orders();
    let wanted = values
        .iter()
        .map(|v| Order::Write(drivegate_proto::RequestPdu::write_register(2003, *v)));
    assert!(written.into_iter().eq(wanted));
    rig.end().await;
}

#[tokio::test]
async fn back_pressure_and_a_full_queue() {
    let rig = Rig::new().await;
    rig.buses[0].pause(true);
    // A connection has at most 16 requests in progress; the rest of its batch stays unread.
    let mut clients = Vec::new();
    for n in 1..=4 {
        let mut client = rig.client().await;
        let batch: Vec<u8> = (0..40u16).flat_map(|t| frame(t, 1, &words(6, &[2003, t]))).collect();
        client.send(&batch).await;
        clients.push(client);
        until("16 more wait", || rig.buses[0].waiting() == 16 * n).await;
    }
    assert_eq!(rig.buses[0].waiting(), CAPACITY);
    let mut late = rig.client().await;
    assert_eq!(late.ask(1, &words(6, &[2003, 1])).await, [0x86, 6], "the queue is full");
    assert_eq!(
        late.ask(255, &words(4, &[10, 1])).await,
        registers(4, &[64]),
        "queued writes"
    );
    assert_eq!(late.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    rig.buses[0].pause(false);
    for client in &mut clients {
        for _ in 0..40 {
            let (transaction, _, pdu) = client.answer().await.unwrap();
            assert_eq!(pdu, words(6, &[2003, transaction]));
        }
    }
    rig.end().await;
}

#[tokio::test]
async fn a_stop_overtakes_and_purges() {
    let rig = Rig::new().await;
    let (mut one, mut two) = (rig.client().await, rig.client().await);
    rig.buses[0].pause(true);
    let reference = one.request(1, &words(6, &[0x8101, 5000])).await;
    until("the reference waits", || rig.buses[0].waiting() == 1).await;
    let stop = two.request(1, &words(6, &[0x8100, 0])).await;
    assert_eq!(
        one.answer().await,
        Some((reference, 1, vec![0x86, 6])),
        "a stop removed it"
    );
    rig.buses[0].pause(false);
    assert_eq!(two.answer().await, Some((stop, 1, words(6, &[0x8100, 0]))));
    assert_eq!(orders(&rig), ["run=false reverse=false"]);
    rig.end().await;
}

#[tokio::test]
async fn heartbeats_of_whoever_may_command_renew_leases() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let (pump, watched) = (rig.drive("pump-1"), rig.drive("pump-2"));
    client.ask(1, &words(6, &[0x8103, 0])).await;
    assert!(pump.take_heartbeat().is_some());
    client.ask(1, &write(0x8101, &[0x8000, 0xFFFF, 7])).await;
    assert!(pump.take_heartbeat().is_some(), "also in a write of several registers");
    client.ask(1, &words(6, &[0x8101, 100])).await;
    assert_eq!(
        pump.take_heartbeat(),
        None,
        "a command renews where it reaches the wire"
    );
    client.ask(1, &words(6, &[0x8101, 20_000])).await;
    assert_eq!(pump.take_heartbeat(), None, "a refused one does not");
    client.ask(2, &words(6, &[0x8103, 0])).await;
    assert_eq!(
        watched.take_heartbeat(),
        None,
        "nor does a heartbeat for a monitored drive"
    );
    assert_eq!(rig.buses[0].orders().len(), 1, "a heartbeat is nothing for the bus");
    rig.end().await;
}

#[tokio::test]
async fn refusals_are_counted_and_told() {
    let rig = Rig::new().await;
    let plant = rig.plant.load_full();
    let mut client = rig.client().await;
    client.ask(1, &words(6, &[0x8100, 8])).await;
    client.ask(1, &words(6, &[0x8000, 8])).await;
    client.ask(2, &words(6, &[0x8100, 1])).await;
    client.ask(1, &words(6, &[0x8100, 1])).await;
    let results = plant.command_log.results();
    for (code, count) in [
        ("bad_value", 1),
        ("not_writable", 1),
        ("not_allowed", 1),
        ("acknowledged", 1),
    ] {
        assert_eq!(
            results.get(&(SourceKind::ModbusTcp, code)),
            Some(&count),
            "{code} in {results:?}"
        );
    }
    let reported = plant.events.recent();
    assert_eq!(reported.len(), 3);
    assert!(reported.iter().all(|e| e.kind == EventKind::RefusedCommand));
    let peer = client.stream.local_addr().unwrap().to_string();
    assert!(
        reported[0].text.contains(&peer) && reported[0].text.contains("bits 3 to 15"),
        "{}",
        reported[0].text
    );
    rig.end().await;
}

#[tokio::test]
async fn a_client_that_leaves_does_not_take_its_command_back() {
    let rig = Rig::new().await;
    rig.buses[0].pause(true);
    let mut client = rig.client().await;
    client.request(1, &words(6, &[0x8101, 5000])).await;
    until("the write waits", || rig.buses[0].waiting() == 1).await;
    drop(client);
    rig.buses[0].pause(false);
    until("the write is done", || !rig.buses[0].seen.lock().unwrap().is_empty()).await;
    until("it was counted", || {
        let results = rig.plant.load().command_log.results();
        results.get(&(SourceKind::ModbusTcp, "acknowledged")) == Some(&1)
    })
    .await;
    until("the client is gone", || rig.stats.modbus_tcp.connections() == 0).await;
    rig.end().await;
}

#[tokio::test]
async fn requests_under_way_are_answered_when_the_server_ends() {
    let rig = Rig::new().await;
    rig.buses[0].pause(true);
    let mut client = rig.client().await;
    let written = client.request(1, &words(6, &[0x8101, 5000])).await;
    until("the write waits", || rig.buses[0].waiting() == 1).await;
    rig.cancel.cancel();
    rig.plant.load().buses[0]
        .queue
        .close(Outcome::ShuttingDown, Instant::now());
    assert_eq!(client.answer().await, Some((written, 1, vec![0x86, 0x0A])));
    assert!(client.is_closed().await);
    rig.end().await;
}
