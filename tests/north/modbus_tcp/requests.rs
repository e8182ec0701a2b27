//! Each request with its answer: the table of answers and exceptions.

use std::time::SystemTime;

use drivegate_core::order::{Order, Outcome};
use drivegate_core::process_image::Link;
use drivegate_north::modbus_tcp::Uncached;
use drivegate_proto::{Exception, RequestPdu, Table};

use super::rig::{Client, Rig, n2_plant, options, registers, words, write};

#[tokio::test]
async fn device_identification() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    for (unit, product, name) in [
        (1, "vacon-nx", "pump-1"),
        (4, "meter", "meter"),
        (255, "gateway", "pump-house"),
    ] {
        let answer = client.ask(unit, &[43, 14, 1, 0]).await;
        let mut wanted = vec![43, 14, 1, 0x82, 0, 0, 3, 0, 9];
        wanted.extend_from_slice(b"drivegate");
        wanted.extend_from_slice(&[1, product.len() as u8]);
        wanted.extend_from_slice(product.as_bytes());
        wanted.extend_from_slice(&[2, env!("CARGO_PKG_VERSION").len() as u8]);
        wanted.extend_from_slice(env!("CARGO_PKG_VERSION").as_bytes());
        assert_eq!(answer, wanted);
        let answer = client.ask(unit, &[43, 14, 4, 5]).await;
        assert_eq!(answer[9..], *name.as_bytes());
        assert_eq!(client.ask(unit, &[43, 14, 4, 200]).await, [0xAB, 2]);
        assert_eq!(client.ask(unit, &[43, 14, 5, 0]).await, [0xAB, 3]);
        assert_eq!(client.ask(unit, &[43, 13, 1, 0]).await, [0xAB, 1]);
    }
    assert_eq!(client.ask(77, &[43, 14, 1, 0]).await, [0xAB, 0x0A]);
    rig.end().await;
}

#[tokio::test]
async fn a_client_that_may_not_write() {
    let mut options = options();
    options.listeners[0].write = vec!["127.0.0.1/32".parse().unwrap()];
    let rig = Rig::with(options).await;
    let mut client = Client::connect_from([127, 0, 0, 2], rig.address()).await;
    for request in [
        words(6, &[0x8100, 1]),
        words(6, &[9999, 1]),
        words(6, &[0x8103, 1]),
        vec![16, 0],
        vec![5],
    ] {
        assert_eq!(client.ask(1, &request).await, [request[0] | 0x80, 1]);
    }
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    assert_eq!(
        client.ask(1, &words(3, &[500, 1])).await,
        registers(3, &[500]),
        "reads are forwarded for all"
    );
    assert!(rig.buses[0].orders().iter().all(|o| matches!(o, Order::Read(_))));
    assert!(rig.drive("pump-1").take_heartbeat().is_none(), "no lease was taken");
    rig.end().await;
}

#[tokio::test]
async fn offline_drives_and_closed_buses() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    // This drive has never answered.
    assert_eq!(client.ask(3, &words(3, &[2100, 11])).await, [0x83, 0x0B]);
    assert_eq!(client.ask(3, &words(3, &[500, 1])).await, [0x83, 0x0B]);
    assert_eq!(client.ask(3, &words(6, &[0x8100, 1])).await, [0x86, 0x0B]);
    assert_eq!(
        client.ask(3, &words(6, &[0x8102, 2500])).await,
        [0x86, 0x0B],
        "its range is unknown since it does not reply"
    );
    assert_eq!(
        client.ask(3, &words(3, &[0x8000, 5])).await,
        registers(3, &[0x4000, 0, 0xFFFF, 0xFFFF, 0x8000])
    );
    // The drive goes offline.
    rig.drive("pump-1")
        .update(|s| s.link = Link::Offline(SystemTime::now()));
    assert_eq!(client.ask(1, &words(3, &[2100, 11])).await, [0x83, 0x0B]);
    assert_eq!(client.ask(1, &words(6, &[2000, 1])).await, [0x86, 0x0B]);
    assert_eq!(client.ask(1, &words(3, &[0x8000, 2])).await, registers(3, &[0x4000, 0]));
    assert_eq!(client.ask(1, &words(3, &[0x8200, 2])).await, registers(3, &[0x7FC0, 0]));
    assert_eq!(
        client.ask(1, &words(3, &[0x8100, 3])).await,
        registers(3, &[0xFFFF, 0x8000, 0xFFFF])
    );
    // The bus is down: its drives cannot be reached, whatever is known about them.
    let plant = rig.plant.load_full();
    plant.buses[0].image.update_health(|h| h.up = false);
    for unit in [1, 2, 3] {
        assert_eq!(client.ask(unit, &words(3, &[2100, 11])).await, [0x83, 0x0A]);
        assert_eq!(client.ask(unit, &words(3, &[500, 1])).await, [0x83, 0x0A]);
        assert_eq!(
            client.ask(unit, &words(3, &[0x8000, 2])).await,
            registers(3, &[0x4000, 0])
        );
    }
    assert_eq!(client.ask(1, &words(6, &[0x8100, 1])).await, [0x86, 0x0A]);
    assert_eq!(client.ask(3, &words(6, &[0x8102, 2500])).await, [0x86, 0x0A]);
    assert_eq!(
        client.ask(1, &words(6, &[2100, 1])).await,
        [0x86, 2],
        "a bad address stays one"
    );
    assert_eq!(client.ask(255, &words(4, &[0, 4])).await, registers(4, &[0, 3, 0, 0]));
    assert_eq!(
        client.ask(4, &words(4, &[5, 1])).await,
        registers(4, &[77]),
        "the other bus serves on"
    );
    assert!(rig.buses[0].orders().is_empty());
    rig.end().await;
}

#[tokio::test]
async fn what_the_drive_refuses() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    rig.drive("pump-1").update(|s| {
        s.refuse(Table::Holding, 7, 1, Exception::Modbus(2));
        s.refuse(Table::Holding, 8, 1, Exception::Modbus(0x21));
    });
    assert_eq!(client.ask(1, &words(3, &[7, 1])).await, [0x83, 2]);
    assert_eq!(
        client.ask(1, &words(3, &[8, 1])).await,
        [0x83, 4],
        "the drive's own code"
    );
    let table = [
        (Outcome::Exception(Exception::Modbus(1)), 1),
        (Outcome::Exception(Exception::Modbus(2)), 2),
        (Outcome::Exception(Exception::Modbus(3)), 3),
        (Outcome::Exception(Exception::Modbus(0x0B)), 0x0B),
        (Outcome::Exception(Exception::Modbus(0x21)), 4),
        (Outcome::Exception(Exception::Modbus(0xFF)), 4),
        (Outcome::Garbled, 4),
        (Outcome::TimedOut, 0x0B),
        (Outcome::Expired, 0x0B),
        (Outcome::Offline, 0x0B),
        (Outcome::BusDown, 0x0A),
        (Outcome::ShuttingDown, 0x0A),
        (Outcome::QueueFull, 6),
        (Outcome::Replaced, 6),
        (Outcome::Purged, 6),
        // The reply does not answer the request.
        (
            Outcome::Acknowledged(drivegate_proto::Reply::Registers(vec![1, 2, 3])),
            4,
        ),
        (Outcome::Acknowledged(drivegate_proto::Reply::Bits(vec![true])), 4),
    ];
    for (outcome, code) in table {
        let answer = outcome.clone();
        rig.buses[0].answers(move |_| Some(answer.clone()));
        for request in [words(3, &[500, 1]), words(6, &[2000, 1]), write(0x8100, &[1, 5000])] {
            let wanted = [request[0] | 0x80, code];
            assert_eq!(client.ask(1, &request).await, wanted, "{outcome:?}");
        }
    }
    rig.end().await;
}

#[tokio::test]
async fn reads_outside_the_plan_can_be_refused() {
    let mut options = options();
    options.uncached = Uncached::Refuse;
    let rig = Rig::with(options).await;
    let mut client = rig.client().await;
    assert_eq!(client.ask(1, &words(3, &[500, 1])).await, [0x83, 2]);
    assert_eq!(client.ask(1, &words(3, &[2100, 12])).await, [0x83, 2]);
    assert_eq!(client.ask(1, &words(3, &[2100, 1])).await, registers(3, &[0x23]));
    assert!(rig.buses[0].orders().is_empty());
    rig.end().await;
}

#[tokio::test]
async fn forwarded_reads_are_the_clients_own() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    client.ask(1, &words(4, &[500, 2])).await;
    client.ask(1, &words(3, &[20_000, 125])).await;
    let read = |table, start, count| Order::Read(RequestPdu::read(table, start, count));
    assert_eq!(
        rig.buses[0].orders(),
        [read(Table::Input, 500, 2), read(Table::Holding, 20_000, 125)],
        "what no range of the profile names is the drive's to refuse"
    );
    rig.end().await;
}

#[tokio::test]
async fn an_n2_drive_is_asked_object_by_object_for_what_is_not_polled() {
    let rig = Rig::of(n2_plant(), options()).await;
    let mut client = rig.client().await;
    let read = |table, start, count| Order::Read(RequestPdu::read(table, start, count));
    // BI 6 and 7 are polled, BI 8 to 10 never; in the simulated bus every third bit is set.
    assert_eq!(client.ask(1, &words(2, &[5, 5])).await, [2, 1, 0b1_0011]);
    let asked: Vec<Order> = (7..10).map(|at| read(Table::DiscreteInput, at, 1)).collect();
    assert_eq!(rig.buses[0].orders(), asked);
    // Half of AI 1, AI 2 from the process image, half of AI 11.
    assert_eq!(client.ask(1, &words(4, &[2, 2])).await, registers(4, &[0x41C8, 0]));
    assert_eq!(rig.buses[0].orders(), []);
    assert_eq!(client.ask(1, &words(4, &[21, 1])).await, registers(4, &[21]));
    assert_eq!(
        client.ask(1, &words(4, &[201, 4])).await,
        registers(4, &[201, 202, 203, 204])
    );
    let asked = [20, 200, 202, 204].map(|at| read(Table::Input, at, 2));
    assert_eq!(rig.buses[0].orders(), asked);
    assert_eq!(
        client.ask(1, &words(4, &[508, 4])).await,
        [0x84, 2],
        "there is no AI 256"
    );
    assert_eq!(rig.buses[0].orders(), []);
    // The first object that fails ends the request.
    rig.buses[0].answers(|_| Some(Outcome::TimedOut));
    assert_eq!(client.ask(1, &words(2, &[7, 8])).await, [0x82, 0x0B]);
    assert_eq!(rig.buses[0].orders().len(), 1);
    // No request is sent when part of the range is stale.
    rig.drive("fan-1").update(|s| s.link = Link::Offline(SystemTime::now()));
    assert_eq!(client.ask(1, &words(2, &[5, 5])).await, [0x82, 0x0B]);
    assert_eq!(rig.buses[0].orders(), []);
    rig.end().await;
}

#[tokio::test]
async fn a_reload_is_seen_by_connected_clients() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    let mut next = super::rig::plant();
    next.buses.remove(0);
    rig.plant.store(std::sync::Arc::new(next));
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, [0x83, 0x0A]);
    assert_eq!(client.ask(255, &words(4, &[1, 1])).await, registers(4, &[1]));
    rig.end().await;
}
