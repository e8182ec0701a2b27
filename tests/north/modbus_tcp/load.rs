//! Many clients, clients of all manners at one time, and a machine that runs out of files.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use drivegate_north::{ConnectionRefusal, ServerKind};
use drivegate_proto::Table;
use rand_free::Dice;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::rig::{Client, PATIENCE, Rig, frame, options, registers, until, words};
use crate::support::process::{Running, free_port};

/// Numbers that are random enough to mix the order, and equal in each run.
mod rand_free {
    pub(super) struct Dice(pub(super) u64);

    impl Dice {
        pub(super) fn below(&mut self, end: u64) -> u64 {
            self.0 = self
                .0
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 33) % end
        }
    }
}

/// Raises the limit of open files: this process holds both ends of every connection.
fn allow_files(count: u64) {
    let limit = getrlimit(Resource::Nofile);
    let current = limit.maximum.map_or(count, |most| most.min(count));
    if limit.current.is_some_and(|have| have < current) {
        setrlimit(
            Resource::Nofile,
            Rlimit {
                current: Some(current),
                ..limit
            },
        )
        .unwrap();
    }
}

fn turned_away(rig: &Rig, why: ConnectionRefusal) -> u64 {
    rig.stats
        .refused
        .of(ServerKind::ModbusTcp)
        .find(|(reason, _)| *reason == why)
        .unwrap()
        .1
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_thousand_connections() {
    allow_files(4096);
    let mut options = options();
    options.max_connections = 1000;
    let rig = Rig::with(options).await;
    let mut idle = Vec::new();
    for n in 0..999 {
        let mut client = rig.client().await;
        // Every third client has sent a request.
        if n % 3 == 1 {
            assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
        }
        idle.push(client);
    }
    let mut worker = rig.client().await;
    for value in 0..1000u16 {
        assert_eq!(worker.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
        assert_eq!(worker.ask(1, &words(6, &[2003, value])).await, words(6, &[2003, value]));
    }
    until("all are in", || rig.stats.modbus_tcp.connections() == 1000).await;
    // Every third client is in the middle of a frame, and has ten seconds for the rest.
    for client in idle.iter_mut().skip(2).step_by(3) {
        client.send(&[0, 1, 0]).await;
    }
    let mut beyond = rig.client().await;
    let answer = beyond.ask(1, &words(3, &[2102, 1])).await;
    assert_eq!(answer, registers(3, &[5000]), "in place of one that never asked");
    assert_eq!(turned_away(&rig, ConnectionRefusal::Displaced), 1);
    for client in idle.iter_mut().skip(1).step_by(3) {
        assert_eq!(
            client.ask(1, &words(3, &[2102, 1])).await,
            registers(3, &[5000]),
            "nobody who asked was dropped"
        );
    }
    drop((idle, beyond));
    until("the places are free", || rig.stats.modbus_tcp.connections() == 1).await;
    rig.end().await;
}

#[tokio::test]
async fn places_of_one_address() {
    let mut options = options();
    options.max_connections_per_address = 2;
    let rig = Rig::with(options).await;
    let (mut one, mut two) = (rig.client().await, rig.client().await);
    for client in [&mut one, &mut two] {
        client.ask(1, &words(3, &[2102, 1])).await;
    }
    assert!(rig.client().await.is_closed().await);
    assert_eq!(
        (
            turned_away(&rig, ConnectionRefusal::AddressFull),
            turned_away(&rig, ConnectionRefusal::Full)
        ),
        (1, 0)
    );
    let mut neighbour = Client::connect_from([127, 0, 0, 2], rig.address()).await;
    assert_eq!(neighbour.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    rig.end().await;
}

#[tokio::test]
async fn an_idle_client_makes_room() {
    let mut options = options();
    (options.max_connections, options.idle_timeout) = (1, Some(Duration::from_millis(200)));
    let rig = Rig::with(options).await;
    let mut idle = rig.client().await;
    assert!(idle.is_closed().await);
    until("its place is free", || rig.stats.modbus_tcp.connections() == 0).await;
    loop {
        let mut client = rig.client().await;
        client.request(1, &words(3, &[2102, 1])).await;
        if let Some((_, _, answer)) = client.answer().await {
            assert_eq!(answer, registers(3, &[5000]));
            break;
        }
    }
    rig.end().await;
}

/// All tasks run on one thread, so that the service of one client while another waits can be counted: a request is
/// answered before the flood has had more than a few turns.
#[tokio::test]
async fn a_flood_is_served_fairly() {
    let rig = Rig::new().await;
    let address = rig.address();
    let flooded = Arc::new(AtomicU64::new(0));
    for _ in 0..4 {
        let flood = Client::connect(address).await;
        let (mut reader, mut writer) = flood.stream.into_split();
        let batch: Vec<u8> = (0..700u16).flat_map(|t| frame(t, 1, &words(3, &[2100, 11]))).collect();
        tokio::spawn(async move { while writer.write_all(&batch).await.is_ok() {} });
        let flooded = flooded.clone();
        tokio::spawn(async move {
            let mut answers = vec![0; 31 * 1024];
            while let Ok(count) = reader.read(&mut answers).await
                && count > 0
            {
                flooded.fetch_add(count as u64, Ordering::SeqCst);
            }
        });
    }
    until("the flood is there", || flooded.load(Ordering::SeqCst) > 31 * 10_000).await;
    let mut polite = rig.client().await;
    let mut between = Vec::new();
    for _ in 0..200 {
        let before = flooded.load(Ordering::SeqCst);
        assert_eq!(polite.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
        between.push((flooded.load(Ordering::SeqCst) - before) / 31);
    }
    between.sort_unstable();
    // A turn is 128 requests; with four flooding clients, and the kernel's buffers in between, a request waits for
    // several turns of each.
    assert!(between[100] < 4 * 128 * 8, "{between:?}");
    assert!(between[190] < 4 * 128 * 32, "{between:?}");
    rig.end().await;
}

/// Registers that belong together have values of one poll, while a thread rewrites the image as fast as possible.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_torn() {
    let rig = Rig::new().await;
    let (end, polls) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU32::new(0)));
    let writer = {
        let (image, end, polls) = (rig.drive("pump-1"), end.clone(), polls.clone());
        std::thread::spawn(move || {
            while !end.load(Ordering::Relaxed) {
                // All eleven words, and so both halves of every 32-bit value, contain the number of the poll.
                let n = (polls.fetch_add(1, Ordering::Relaxed) % 10_000) as u16;
                let now = Instant::now();
                image.update(|s| {
                    s.fast_at = Some(now);
                    s.store(Table::Holding, 2100, &[n; 11], now);
                });
            }
        })
    };
    until("it is written", || polls.load(Ordering::Relaxed) > 2).await;
    let mut client = rig.client().await;
    let mut seen = std::collections::BTreeSet::new();
    // Runs until many polls were seen: on a busy machine the writer seldom runs.
    for round in 0.. {
        if round >= 3000 && seen.len() > 100 {
            break;
        }
        assert!(round < 100_000, "only {} polls were seen", seen.len());
        let raw = client.ask(1, &words(3, &[2100, 11])).await;
        let first = [raw[2], raw[3]];
        assert!(raw[2..].chunks(2).all(|word| word == first), "{raw:?}");
        seen.insert(first);
        // The common model: actual_speed in 0.01 %, output_frequency in 0.01 Hz, motor_speed in rpm, all n.
        let model = client.ask(1, &words(3, &[0x8004, 3])).await;
        assert!(model[2..].chunks(2).all(|word| word == &model[2..4]), "{model:?}");
        // The float block: the first float is n / 100 % in two registers, the second n / 100 Hz, the third n rpm.
        let floats = client.ask(1, &words(4, &[0x8200, 6])).await;
        let float = |at: usize| f32::from_be_bytes([floats[at], floats[at + 1], floats[at + 2], floats[at + 3]]);
        let n = float(10);
        assert_eq!((n.fract(), float(2), float(6)), (0.0, n / 100.0, n / 100.0));
    }
    end.store(true, Ordering::Relaxed);
    writer.join().unwrap();
    rig.end().await;
}

/// Clients that connect, send a request or half of one, and leave: by close, by reset, by silence.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn disorder_leaves_nothing_behind() {
    let rig = Rig::new().await;
    let address = rig.address();
    let vandals: Vec<_> = (0..8u64)
        .map(|seed| tokio::task::spawn_blocking(move || vandal(address, Dice(seed))))
        .collect();
    let mut worker = rig.client().await;
    for _ in 0..500 {
        assert_eq!(worker.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
        let answer = worker.ask(1, &words(6, &[2003, 1])).await;
        // The others may have filled the queue, which is reported.
        assert!(answer == words(6, &[2003, 1]) || answer == [0x86, 6], "{answer:?}");
    }
    for vandal in vandals {
        tokio::time::timeout(PATIENCE, vandal).await.unwrap().unwrap();
    }
    until("they are gone", || rig.stats.modbus_tcp.connections() == 1).await;
    until("what was accepted is carried out", || rig.buses[0].waiting() == 0).await;
    rig.end().await;
}

fn vandal(address: SocketAddr, mut dice: Dice) {
    for _ in 0..100 {
        let Ok(mut stream) = std::net::TcpStream::connect(address) else {
            continue;
        };
        let requests: Vec<u8> = (0..dice.below(60) as u16)
            .flat_map(|t| match dice.below(3) {
                0 => frame(t, 1, &words(6, &[2003, t])),
                1 => frame(t, 1, &words(3, &[500, 3])),
                _ => frame(t, 1, &words(3, &[0x8000, 19])),
            })
            .collect();
        let cut = dice.below(requests.len() as u64 + 1) as usize;
        let _ = stream.write_all(&requests[..cut]);
        match dice.below(4) {
            // Unread answers turn the close into a reset.
            0 => {}
            1 => drop(stream.shutdown(Shutdown::Write)),
            2 => drop(stream.shutdown(Shutdown::Read)),
            _ => {
                let _ = stream.set_read_timeout(Some(Duration::from_millis(1)));
                let _ = stream.read(&mut [0; 100]);
            }
        }
    }
}

/// The real daemon with few files: it serves fewer clients, reports that, and has files left for everything else.
#[test]
fn few_files_mean_few_connections() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("drivegate.toml");
    let address = SocketAddr::from(([127, 0, 0, 1], free_port()));
    let text = format!(
        "[gateway]\nname = \"g\"\n[modbus_tcp]\nlisten = [\"{address}\"]\nmax_connections = 400\n\
         max_connections_per_address = 400\n"
    );
    std::fs::write(&file, text).unwrap();
    let script = "ulimit -n 160; exec \"$0\" run --config \"$1\"";
    let (binary, file) = (env!("CARGO_BIN_EXE_drivegate"), file.to_str().unwrap());
    let daemon = Running::start(Path::new("/bin/sh"), &["-c", script, binary, file]);
    daemon.until_printed("drivegate is running");
    let log = daemon.output();
    assert!(
        log.contains("at most 64 instead of 400 connections") && log.contains("raise LimitNOFILE of the service"),
        "{log}"
    );
    let ask = |stream: &mut std::net::TcpStream| {
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(&frame(1, 255, &[43, 14, 4, 0]))?;
        let mut answer = [0; 7 + 9 + 9];
        stream.read_exact(&mut answer).map(|()| answer[6])
    };
    let mut open = Vec::new();
    for _ in 0..200 {
        let mut client = std::net::TcpStream::connect(address).unwrap();
        if ask(&mut client).is_ok() {
            open.push(client);
        }
    }
    assert_eq!(open.len(), 64);
    for client in &mut open {
        assert_eq!(ask(client).unwrap(), 255, "who is in is served");
    }
    let log = daemon.output();
    assert!(log.contains("client refused: 64 connections are open"), "{log}");
    assert!(!log.contains("Too many open files"), "{log}");
    drop(open);
    until_served(address, ask);
}

/// Repeats the request until it is served, because places are freed with a short delay.
fn until_served(address: SocketAddr, ask: impl Fn(&mut std::net::TcpStream) -> std::io::Result<u8>) {
    crate::support::process::until("an answer", || {
        ask(&mut std::net::TcpStream::connect(address).ok()?).ok()
    });
}
