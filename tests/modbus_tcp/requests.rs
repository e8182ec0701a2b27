//! One request, one answer: the table of answers and exceptions.

use std::time::{Instant, SystemTime};

use drivegate::cache::Link;
use drivegate::codec::{Exception, RequestPdu, Table};
use drivegate::command::{Order, Outcome};
use drivegate::north::modbus_tcp::Uncached;

use crate::rig::{Client, Rig, options, registers, words, write};

const PROCESS_DATA: [u16; 11] = [0x0023, 0x2000, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 0];

#[tokio::test]
async fn answers_and_exceptions() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let common = [
        0x80A3, 3, 0, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 420, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF, 5000, 2500,
    ];
    let (no_function, no_address, no_value) = (1, 2, 3);
    let refused = |function: u8, code: u8| vec![function | 0x80, code];
    let table: Vec<(&str, u8, Vec<u8>, Vec<u8>)> = vec![
        ("process data", 1, words(3, &[2100, 11]), registers(3, &PROCESS_DATA)),
        (
            "input is holding",
            1,
            words(4, &[2100, 11]),
            registers(4, &PROCESS_DATA),
        ),
        ("part of a poll", 1, words(3, &[2102, 2]), registers(3, &[5000, 2500])),
        ("status, state", 1, words(3, &[0x8000, 2]), registers(3, &common[..2])),
        ("fault code on", 1, words(4, &[0x8003, 16]), registers(4, &common[2..])),
        (
            "command block",
            1,
            words(3, &[0x8100, 4]),
            registers(3, &[1, 5000, 2500, 0]),
        ),
        ("float", 1, words(4, &[0x8200, 2]), registers(4, &[0x4248, 0])),
        ("monitored drive", 2, words(3, &[0x8004, 1]), registers(3, &[5000])),
        ("forwarded", 1, words(3, &[500, 3]), registers(3, &[500, 501, 502])),
        (
            "forwarded, limit",
            1,
            words(3, &[500, 30]),
            registers(3, &(500..530).collect::<Vec<u16>>()),
        ),
        (
            "forwarded, partly polled",
            1,
            words(3, &[7, 3]),
            registers(3, &[7, 8, 9]),
        ),
        ("discrete inputs", 4, words(2, &[3, 2]), vec![2, 1, 0b01]),
        ("coil", 4, words(1, &[7, 1]), vec![1, 1, 1]),
        ("forwarded bits", 4, words(1, &[9, 10]), vec![1, 2, 0b0100_1001, 0b10]),
        ("input", 4, words(4, &[5, 1]), registers(4, &[77])),
        (
            "common model of a meter",
            4,
            words(3, &[0x8000, 1]),
            registers(3, &[0x8002]),
        ),
        ("write coil", 4, words(5, &[7, 0xFF00]), words(5, &[7, 0xFF00])),
        ("write coils", 4, vec![15, 0, 7, 0, 2, 1, 3], words(15, &[7, 2])),
        ("raw write", 1, words(6, &[2002, 5000]), words(6, &[2002, 5000])),
        ("raw writes", 1, write(2000, &[1, 0, 5000]), words(16, &[2000, 3])),
        ("command", 1, words(6, &[0x8100, 1]), words(6, &[0x8100, 1])),
        (
            "commands",
            1,
            write(0x8100, &[1, 2500, 0xFFFF, 9]),
            words(16, &[0x8100, 4]),
        ),
        ("heartbeat", 1, words(6, &[0x8103, 9]), words(6, &[0x8103, 9])),
        ("no such unit", 9, words(3, &[0, 1]), refused(3, 0x0A)),
        ("no such unit 0", 0, words(3, &[0x8000, 1]), refused(3, 0x0A)),
        ("no such unit, nonsense", 254, vec![0x41, 1], refused(0x41, 0x0A)),
        ("unknown function", 1, vec![0x41, 1], refused(0x41, no_function)),
        ("diagnostics", 1, words(8, &[0, 0]), refused(8, no_function)),
        ("exception as function", 1, vec![0x83, 1], refused(0x83, no_function)),
        (
            "coils of a drive without",
            1,
            words(1, &[0, 1]),
            refused(1, no_function),
        ),
        (
            "inputs of a drive without",
            1,
            words(2, &[0, 0]),
            refused(2, no_function),
        ),
        (
            "coil write without coils",
            1,
            words(5, &[0, 0xFF00]),
            refused(5, no_function),
        ),
        ("mask write", 1, words(22, &[2000, 0, 0]), refused(22, no_function)),
        (
            "read and write",
            1,
            vec![23, 8, 0x34, 0, 1, 7, 0xD0, 0, 1, 2, 0, 1],
            refused(23, no_function),
        ),
        ("quantity 0", 1, words(3, &[2100, 0]), refused(3, no_value)),
        ("quantity 126", 1, words(3, &[2100, 126]), refused(3, no_value)),
        ("quantity 65535", 1, words(4, &[0, 65_535]), refused(4, no_value)),
        ("short read", 1, vec![3, 0, 0, 0], refused(3, no_value)),
        ("long read", 1, vec![3, 0, 0, 0, 1, 0], refused(3, no_value)),
        ("function only", 1, vec![3], refused(3, no_value)),
        (
            "past the last address",
            1,
            words(3, &[0xFFFF, 2]),
            refused(3, no_address),
        ),
        ("out of the raw view", 1, words(3, &[0x7FFF, 2]), refused(3, no_address)),
        (
            "out of the common model",
            1,
            words(3, &[0x8012, 2]),
            refused(3, no_address),
        ),
        (
            "after the common model",
            1,
            words(3, &[0x8013, 1]),
            refused(3, no_address),
        ),
        (
            "out of the command block",
            1,
            words(3, &[0x8103, 2]),
            refused(3, no_address),
        ),
        (
            "out of the float block",
            1,
            words(4, &[0x8219, 2]),
            refused(4, no_address),
        ),
        (
            "beyond the drive's limit",
            1,
            words(3, &[500, 31]),
            refused(3, no_value),
        ),
        (
            "beyond the limit of process data",
            1,
            words(3, &[2100, 21]),
            refused(3, no_value),
        ),
        ("beyond the limit of bits", 4, words(1, &[9, 17]), refused(1, no_value)),
        (
            "write to a monitored drive",
            2,
            words(6, &[0x8100, 1]),
            refused(6, no_function),
        ),
        ("same, raw", 2, words(6, &[2000, 1]), refused(6, no_function)),
        (
            "same, wrong address",
            2,
            words(6, &[0x8000, 1]),
            refused(6, no_function),
        ),
        (
            "same, wrong count",
            2,
            vec![16, 0x81, 0, 0, 1, 3, 0, 0, 0],
            refused(16, no_function),
        ),
        ("same, heartbeat", 2, words(6, &[0x8103, 1]), refused(6, no_function)),
        (
            "write to the common model",
            1,
            words(6, &[0x8000, 1]),
            refused(6, no_address),
        ),
        (
            "write to the float block",
            1,
            write(0x8200, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "write past the command block",
            1,
            write(0x8103, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "write into the command block from below",
            1,
            write(0x80FF, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "raw write into the blocks",
            1,
            write(0x7FFF, &[0, 0]),
            refused(16, no_address),
        ),
        (
            "write to the status word",
            1,
            words(6, &[2100, 1]),
            refused(6, no_address),
        ),
        ("write to nowhere", 1, words(6, &[7000, 1]), refused(6, no_address)),
        (
            "wrong address and value",
            1,
            write(2100, &[0xFFFF]),
            refused(16, no_address),
        ),
        (
            "beyond the range, raw",
            1,
            words(6, &[2002, 10_001]),
            refused(6, no_value),
        ),
        ("beyond the range", 1, words(6, &[0x8101, 10_001]), refused(6, no_value)),
        ("two parameters", 1, write(200, &[1, 2]), refused(16, no_value)),
        ("command bits", 1, words(6, &[0x8100, 8]), refused(6, no_value)),
        ("two references", 1, write(0x8101, &[5000, 2500]), refused(16, no_value)),
        (
            "no reference",
            1,
            write(0x8101, &[0x8000, 0xFFFF]),
            refused(16, no_value),
        ),
        ("beyond the band", 1, words(6, &[0x8102, 5001]), refused(6, no_value)),
        ("coil value", 4, words(5, &[7, 1]), refused(5, no_value)),
        (
            "odd byte count",
            1,
            vec![16, 0x81, 0, 0, 1, 3, 0, 0, 0],
            refused(16, no_value),
        ),
        (
            "byte count too small",
            4,
            vec![15, 0, 0, 0, 100, 1, 0],
            refused(15, no_value),
        ),
        (
            "write of quantity 0",
            1,
            vec![16, 0x81, 0, 0, 0, 0],
            refused(16, no_value),
        ),
        (
            "write of 124 registers",
            1,
            vec![16, 0, 0, 0, 124, 248],
            refused(16, no_value),
        ),
        ("gateway", 255, words(4, &[0, 4]), registers(4, &[1, 3, 2, 500])),
        (
            "gateway, holding",
            255,
            words(3, &[16, 4]),
            registers(3, &[1, 1, 1, 500]),
        ),
        (
            "gateway, cycle unknown",
            255,
            words(4, &[4, 2]),
            registers(4, &[0xFFFF, 0xFFFF]),
        ),
        ("after the last bus", 255, words(4, &[32, 1]), refused(4, no_address)),
        (
            "gateway has no blocks",
            255,
            words(4, &[0x8000, 1]),
            refused(4, no_address),
        ),
        (
            "gateway takes no writes",
            255,
            words(6, &[0, 1]),
            refused(6, no_function),
        ),
        ("gateway has no bits", 255, words(1, &[0, 1]), refused(1, no_function)),
        ("gateway, quantity 0", 255, words(4, &[0, 0]), refused(4, no_value)),
    ];
    for (what, unit, request, answer) in &table {
        assert_eq!(client.ask(*unit, request).await, *answer, "{what}");
    }
    let counted: u64 = rig.stats.modbus_tcp.requests().iter().map(|(_, _, n)| n).sum();
    assert_eq!(counted, table.len() as u64);
    rig.end().await;
}

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
    assert!(!rig.drive("pump-1").lease_ran_out(far()), "no lease was taken");
    rig.end().await;
}

fn far() -> Instant {
    Instant::now() + std::time::Duration::from_secs(7200)
}

#[tokio::test]
async fn offline_drives_and_closed_buses() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    // Never answered.
    assert_eq!(client.ask(3, &words(3, &[2100, 11])).await, [0x83, 0x0B]);
    assert_eq!(client.ask(3, &words(3, &[500, 1])).await, [0x83, 0x0B]);
    assert_eq!(client.ask(3, &words(6, &[0x8100, 1])).await, [0x86, 0x0B]);
    assert_eq!(
        client.ask(3, &words(3, &[0x8000, 5])).await,
        registers(3, &[0x4000, 0, 0xFFFF, 0xFFFF, 0x8000])
    );
    // Gone.
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
    // The bus is down: the drives behind it have no path, whatever is known of them.
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
        s.refuse(Table::Holding, 7, 1, Exception(2));
        s.refuse(Table::Holding, 8, 1, Exception(0x21));
    });
    assert_eq!(client.ask(1, &words(3, &[7, 1])).await, [0x83, 2]);
    assert_eq!(
        client.ask(1, &words(3, &[8, 1])).await,
        [0x83, 4],
        "the drive's own code"
    );
    let table = [
        (Outcome::Exception(Exception(1)), 1),
        (Outcome::Exception(Exception(2)), 2),
        (Outcome::Exception(Exception(3)), 3),
        (Outcome::Exception(Exception(0x0B)), 0x0B),
        (Outcome::Exception(Exception(0x21)), 4),
        (Outcome::Exception(Exception(0xFF)), 4),
        (Outcome::TimedOut, 0x0B),
        (Outcome::Expired, 0x0B),
        (Outcome::Offline, 0x0B),
        (Outcome::BusDown, 0x0A),
        (Outcome::ShuttingDown, 0x0A),
        (Outcome::QueueFull, 6),
        (Outcome::Replaced, 6),
        (Outcome::Purged, 6),
        // Not an answer to what was asked.
        (
            Outcome::Acknowledged(drivegate::codec::Reply::Registers(vec![1, 2, 3])),
            4,
        ),
        (Outcome::Acknowledged(drivegate::codec::Reply::Bits(vec![true])), 4),
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
    let read = |table, start, count| Order::Read(RequestPdu::Read { table, start, count });
    assert_eq!(
        rig.buses[0].orders(),
        [read(Table::Input, 500, 2), read(Table::Holding, 20_000, 125)],
        "what no range of the profile names is the drive's to refuse"
    );
    rig.end().await;
}

#[tokio::test]
async fn a_reload_is_seen_by_connected_clients() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    let mut next = crate::rig::plant();
    next.buses.remove(0);
    rig.plant.store(std::sync::Arc::new(next));
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, [0x83, 0x0A]);
    assert_eq!(client.ask(255, &words(4, &[1, 1])).await, registers(4, &[1]));
    rig.end().await;
}
