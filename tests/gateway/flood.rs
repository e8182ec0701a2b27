//! A client that writes a thousand times a second: what it leaves to the polls and to another client.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::commands::Plant;
use crate::process::{get, until};

/// A register write: function 6.
fn write_register(transaction: u16, unit: u8, address: u16, value: u16) -> [u8; 12] {
    let ([t0, t1], [a0, a1], [v0, v1]) = (transaction.to_be_bytes(), address.to_be_bytes(), value.to_be_bytes());
    [t0, t1, 0, 0, 0, 6, unit, 6, a0, a1, v0, v1]
}

/// A thousand references a second to drive 1 until it is dropped.
struct Flood {
    end: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    threads: Vec<std::thread::JoinHandle<()>>,
}

impl Flood {
    fn start(port: u16) -> Flood {
        let (end, sent) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        let mut answers = stream.try_clone().unwrap();
        let reader = std::thread::spawn(move || {
            let mut buffer = [0u8; 4096];
            while answers.read(&mut buffer).is_ok_and(|count| count > 0) {}
        });
        let (over, count) = (end.clone(), sent.clone());
        let writer = std::thread::spawn(move || {
            let began = Instant::now();
            while !over.load(Ordering::Relaxed) {
                let due = began.elapsed().as_millis() as u64;
                while count.load(Ordering::Relaxed) < due {
                    let number = count.fetch_add(1, Ordering::Relaxed);
                    let frame = write_register(number as u16, 1, 0x8101, (number % 8000) as u16);
                    if stream.write_all(&frame).is_err() {
                        return;
                    }
                }
                std::thread::sleep(Duration::from_millis(2));
            }
            let _ = stream.shutdown(std::net::Shutdown::Both);
        });
        Flood {
            end,
            sent,
            threads: vec![writer, reader],
        }
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// A connection from another address: another client to the gateway.
fn another_client(port: u16) -> TcpStream {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let stream = runtime.block_on(async {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.bind("127.0.0.2:0".parse().unwrap()).unwrap();
        let stream = socket.connect(([127, 0, 0, 1], port).into()).await.unwrap();
        stream.into_std().unwrap()
    });
    stream.set_nonblocking(false).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    stream
}

/// Sum of the samples of a metric whose labels contain `labels`.
fn metric(http: u16, name: &str, labels: &str) -> f64 {
    let text = get(http, "/metrics").unwrap().1;
    let samples = text
        .lines()
        .filter(|l| l.starts_with(&format!("{name}{{")) && l.contains(labels));
    samples.filter_map(|l| l.rsplit(' ').next()?.parse::<f64>().ok()).sum()
}

#[test]
fn a_flood_leaves_half_of_the_line_to_polls_and_its_turn_to_another_client() {
    let plant = Plant::start(38_400);
    plant.until_state("pump-2", "ready");
    let flood = Flood::start(plant.modbus);
    until("the flood to be under way", || {
        (metric(plant.http, "drivegate_writes_total", "\"replaced\"") > 500.0).then_some(())
    });
    let seen = || {
        (
            metric(plant.http, "drivegate_bus_cycle_seconds_count", "fast"),
            metric(plant.http, "drivegate_writes_total", "\"acknowledged\""),
            flood.sent.load(Ordering::Relaxed),
        )
    };
    let (rounds, writes, sent) = seen();

    // Another client commands the other drive: each is carried out, in its order.
    let mut other = another_client(plant.modbus);
    let values: Vec<u16> = (1..=20).map(|n| n * 100).collect();
    let frames: Vec<u8> = (0u16..)
        .zip(&values)
        .flat_map(|(n, v)| write_register(n, 2, 2002, *v))
        .collect();
    other.write_all(&frames).unwrap();
    let mut answers = vec![0u8; frames.len()];
    other.read_exact(&mut answers).unwrap();
    for answer in answers.chunks(12) {
        assert_eq!(answer[7], 6, "carried out: {answer:?}");
    }
    std::thread::sleep(Duration::from_secs(4));

    let (rounds, writes, sent) = {
        let now = seen();
        (now.0 - rounds, now.1 - writes, now.2 - sent)
    };
    assert!(
        writes > 20.0 && sent as f64 > 3.0 * writes,
        "a flood: {sent} sent, {writes} carried out"
    );
    // Time on the line: a poll of 11 registers 11.4 ms, a write 6.8 ms.
    let (polls, commands) = (rounds * 2.0 * 11.4, writes * 6.8);
    assert!(
        polls > 0.9 * commands,
        "{rounds} rounds of two polls beside {writes} writes"
    );

    drop(flood);
    let of_other: Vec<i64> = plant
        .audit()
        .into_iter()
        .filter(|r| r["client"].as_str().unwrap().starts_with("127.0.0.2:"))
        .filter_map(|r| r["points"][0]["new"].as_i64())
        .collect();
    let mut wanted: Vec<i64> = values.iter().map(|v| i64::from(*v)).collect();
    let newest_first = of_other.first() > of_other.last();
    if newest_first {
        wanted.reverse();
    }
    assert_eq!(of_other, wanted, "in the order in which they were sent");
}
