//! Connections: which clients may connect, how many, and how connections end.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use drivegate_north::Server as _;
use drivegate_north::modbus_tcp::{self, Uncached};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use super::rig::{Client, PATIENCE, Rig, frame, listener, options, plant, registers, until, words};

#[tokio::test]
async fn only_allowed_clients() {
    let mut options = options();
    options.listeners[0].allow = vec!["127.0.0.2/32".parse().unwrap()];
    let rig = Rig::with(options).await;
    let mut refused = rig.client().await;
    assert!(refused.is_closed().await);
    let mut allowed = Client::connect_from([127, 0, 0, 2], rig.address()).await;
    assert_eq!(allowed.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    assert_eq!(rig.stats.modbus_tcp.connections(), 1);
    rig.end().await;
}

#[tokio::test]
async fn no_more_than_max_connections() {
    let mut options = options();
    options.max_connections = 2;
    let rig = Rig::with(options).await;
    let (mut one, mut two) = (rig.client().await, rig.client().await);
    for client in [&mut one, &mut two] {
        client.ask(1, &words(3, &[2102, 1])).await;
    }
    assert!(rig.client().await.is_closed().await);
    drop(two);
    until("the place is free", || rig.stats.modbus_tcp.connections() == 1).await;
    // The place is freed a moment after the count changes.
    let mut three = loop {
        let mut client = rig.client().await;
        client.request(1, &words(3, &[2102, 1])).await;
        if client.answer().await.is_some() {
            break client;
        }
    };
    assert_eq!(three.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    assert_eq!(one.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    rig.end().await;
}

/// A client that vanished is detected: the kernel probes a connection that is silent for a minute.
#[tokio::test]
async fn connections_are_kept_alive() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    client.ask(1, &words(3, &[2102, 1])).await;
    let ends = [rig.address(), client.stream.local_addr().unwrap()].map(|end| format!(":{:04X}", end.port()));
    // The timer of the server's socket as in proc(5): its kind (02 is keepalive) and the remaining time in 1/100 s.
    let timer = || {
        let table = std::fs::read_to_string("/proc/net/tcp").unwrap();
        let mut rows = table.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        let row = rows.find(|row| row[1].ends_with(&ends[0]) && row[2].ends_with(&ends[1]));
        // Other connections that come and go can hide a row, and for a moment the timer can be that of an acknowledgement.
        let rest = row.and_then(|row| u64::from_str_radix(row[5].strip_prefix("02:")?, 16).ok());
        rest.filter(|rest| (1..=6000).contains(rest))
    };
    until("the connection is kept alive", || timer().is_some()).await;
    rig.end().await;
}

#[tokio::test]
async fn several_listeners_share_one_server() {
    let mut options = options();
    options.listeners[0].listen = vec![
        SocketAddr::from(([127, 0, 0, 1], 0)),
        SocketAddr::from(([127, 0, 0, 3], 0)),
    ];
    let rig = Rig::with(options).await;
    for address in rig.server.addresses() {
        let mut client = Client::connect(address).await;
        assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    }
    rig.end().await;
}

#[tokio::test]
async fn an_ipv4_client_of_an_ipv6_listener() {
    let mut options = options();
    options.listeners[0].listen = vec!["[::]:0".parse().unwrap()];
    let rig = Rig::with(options).await;
    let port = rig.address().port();
    let mut client = Client::connect(SocketAddr::from(([127, 0, 0, 1], port))).await;
    let request = words(6, &[0x8101, 5000]);
    assert_eq!(
        client.ask(1, &request).await,
        request,
        "allowed and may write by its IPv4 address"
    );
    rig.end().await;
}

/// A runtime that is busy with other work does not delay Modbus TCP clients: this one has a single thread, which is
/// blocked.
#[tokio::test]
async fn nothing_else_keeps_clients_waiting() {
    use std::io::{Read, Write};
    let rig = Rig::new().await;
    let mut client = std::net::TcpStream::connect(rig.address()).unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    client.write_all(&frame(9, 1, &words(3, &[2102, 1]))).unwrap();
    let mut answer = [0; 11];
    client.read_exact(&mut answer).unwrap();
    assert_eq!(answer, frame(9, 1, &registers(3, &[5000]))[..]);
    rig.end().await;
}

#[tokio::test]
async fn a_taken_address_is_told() {
    let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = taken.local_addr().unwrap();
    let mut options = options();
    options.listeners[0].listen = vec![address];
    let plant = Arc::new(ArcSwap::from_pointee(plant()));
    let why = modbus_tcp::Server::start(options, plant, Arc::default(), CancellationToken::new())
        .await
        .unwrap_err()
        .to_string();
    assert!(
        why.starts_with(&format!(
            "cannot listen for Modbus TCP on {address}: Address already in use"
        )),
        "{why}"
    );
    assert!(why.ends_with("in `listen` of [modbus_tcp]"), "{why}");
}

#[tokio::test]
async fn the_end_closes_every_connection() {
    let rig = Rig::new().await;
    let mut clients = Vec::new();
    for _ in 0..10 {
        let mut client = rig.client().await;
        client.ask(1, &words(3, &[2102, 1])).await;
        clients.push(client);
    }
    let address = rig.address();
    rig.end().await;
    for mut client in clients {
        assert!(client.is_closed().await);
    }
    assert!(tokio::net::TcpStream::connect(address).await.is_err());
}

#[tokio::test]
async fn each_listener_has_its_own_rights_and_buses() {
    let mut options = options();
    options.listeners = [("line1", false), ("line2", true)]
        .map(|(bus, may_write)| {
            let mut listener = listener();
            listener.view.buses = Some(vec![bus.to_string()]);
            if !may_write {
                listener.write = Vec::new();
            }
            listener
        })
        .to_vec();
    options.listeners.push(listener());
    options.listeners[2].allow = vec!["127.0.0.2/32".parse().unwrap()];
    let rig = Rig::with(options).await;
    let addresses = rig.server.addresses().to_vec();
    let (mut one, mut two) = (Client::connect(addresses[0]).await, Client::connect(addresses[1]).await);
    assert!(Client::connect(addresses[2]).await.is_closed().await);
    let mut all = Client::connect_from([127, 0, 0, 2], addresses[2]).await;
    let (speed, current, relay) = (words(3, &[2102, 1]), words(4, &[5, 1]), words(5, &[7, 0xFF00]));
    assert_eq!(one.ask(1, &speed).await, registers(3, &[5000]));
    assert_eq!(one.ask(4, &current).await, [0x84, 0x0A]);
    assert_eq!(one.ask(4, &[43, 14, 1, 0]).await, [0xAB, 0x0A]);
    assert_eq!(one.ask(1, &words(6, &[0x8100, 1])).await, [0x86, 1]);
    assert_eq!(two.ask(4, &current).await, registers(4, &[77]));
    assert_eq!(two.ask(1, &speed).await, [0x83, 0x0A]);
    assert_eq!(two.ask(1, &words(6, &[0x8100, 1])).await, [0x86, 0x0A]);
    assert_eq!(two.ask(4, &relay).await, relay);
    assert_eq!(all.ask(1, &speed).await, registers(3, &[5000]));
    assert_eq!(all.ask(4, &current).await, registers(4, &[77]));
    // Unit 255: the blocks keep their addresses, and those of other buses are missing.
    assert_eq!(one.ask(255, &words(4, &[1, 1])).await, registers(4, &[3]));
    assert_eq!(one.ask(255, &words(4, &[17, 1])).await, [0x84, 2]);
    assert_eq!(two.ask(255, &words(4, &[1, 1])).await, [0x84, 2]);
    assert_eq!(two.ask(255, &words(4, &[17, 1])).await, registers(4, &[1]));
    assert_eq!(all.ask(255, &words(4, &[0, 32])).await.len(), 66);
    // A reload of the plant reaches all listeners.
    let mut next = plant();
    next.buses.remove(0);
    rig.plant.store(Arc::new(next));
    assert_eq!(one.ask(1, &speed).await, [0x83, 0x0A]);
    assert_eq!(two.ask(4, &current).await, registers(4, &[77]));
    assert_eq!(
        two.ask(255, &words(4, &[1, 1])).await,
        registers(4, &[1]),
        "line2 is the first bus now"
    );
    rig.end().await;
}

/// The register that only a client with the right may write, with a value.
const WRITE: [u16; 2] = [0x8101, 5000];

async fn may_write(client: &mut Client) -> bool {
    let request = words(6, &WRITE);
    client.ask(1, &request).await == request
}

#[tokio::test]
async fn an_operator_gets_in_whoever_else_is_connected() {
    let mut options = options();
    (options.max_connections, options.max_connections_per_address) = (64, 16);
    options.listeners[0].write = vec!["127.0.0.2/32".parse().unwrap()];
    let rig = Rig::with(options).await;
    let mut open = Vec::new();
    for n in 0..1000u16 {
        // Some clients are silent, some have sent a request, some are in the middle of a frame; from one address, then
        // from many.
        let from = if n < 500 { 1 } else { 3 + (n % 200) as u8 };
        let mut client = Client::connect_from([127, 0, 0, from], rig.address()).await;
        match n % 3 {
            0 => {}
            1 => client.send(&frame(1, 1, &words(3, &[2102, 1]))).await,
            _ => client.send(&[0, 1, 0]).await,
        }
        open.push(client);
        if n % 8 == 0 {
            let mut operator = Client::connect_from([127, 0, 0, 2], rig.address()).await;
            assert!(may_write(&mut operator).await, "with {n} others");
        }
    }
    let mut operators = Vec::new();
    for _ in 0..8 {
        operators.push(Client::connect_from([127, 0, 0, 2], rig.address()).await);
    }
    for _ in 0..100 {
        open.push(Client::connect_from([127, 0, 0, 1], rig.address()).await);
    }
    for operator in &mut operators {
        assert!(may_write(operator).await, "silent as it was, nobody took its place");
    }
    assert!(rig.stats.modbus_tcp.connections() <= 64);
    rig.end().await;
}

#[tokio::test]
async fn a_reload_changes_rights_and_closes_only_who_is_no_longer_allowed() {
    let mut options = options();
    options.listeners[0].write = vec!["127.0.0.2/32".parse().unwrap()];
    let mut rig = Rig::with(options.clone()).await;
    let mut clients = Vec::new();
    for from in 1..=3 {
        let mut client = Client::connect_from([127, 0, 0, from], rig.address()).await;
        assert_eq!(may_write(&mut client).await, from == 2);
        clients.push(client);
    }
    options.listeners[0].write = vec!["127.0.0.1/32".parse().unwrap()];
    options.listeners[0].allow = ["127.0.0.1/32", "127.0.0.2/32"].map(|net| net.parse().unwrap()).into();
    (options.max_connections, options.uncached) = (2, Uncached::Refuse);
    rig.reload(options.clone()).await.unwrap();
    assert!(clients[2].is_closed().await, "no longer in `allow`");
    assert!(may_write(&mut clients[0]).await, "has the right from now on");
    assert_eq!(clients[1].ask(1, &words(6, &WRITE)).await, [0x86, 1], "has lost it");
    assert_eq!(clients[1].ask(1, &words(3, &[500, 1])).await, [0x83, 2], "not polled");
    assert!(
        Client::connect_from([127, 0, 0, 3], rig.address())
            .await
            .is_closed()
            .await
    );
    let address = rig.address();
    options.listeners[0].view.buses = Some(vec!["line2".to_string()]);
    rig.reload(options).await.unwrap();
    assert_eq!(rig.address(), address);
    assert_eq!(
        clients[1].ask(1, &words(3, &[2102, 1])).await,
        [0x83, 0x0A],
        "its bus is no longer shown"
    );
    rig.end().await;
}

#[tokio::test]
async fn a_reload_that_cannot_bind_changes_nothing() {
    let mut rig = Rig::new().await;
    let (mut client, address) = (rig.client().await, rig.address());
    assert!(may_write(&mut client).await);
    let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut refused = options();
    refused.listeners[0].allow = Vec::new();
    refused.listeners[0].listen.push(taken.local_addr().unwrap());
    let why = rig.reload(refused).await.unwrap_err().to_string();
    assert!(why.contains("Address already in use"), "{why}");
    assert!(may_write(&mut client).await);
    assert!(may_write(&mut rig.client().await).await);
    // Another address replaces the first one, whose clients are disconnected.
    let mut moved = options();
    moved.listeners[0].listen = vec![SocketAddr::from(([127, 0, 0, 5], 0))];
    rig.reload(moved).await.unwrap();
    assert!(client.is_closed().await);
    assert!(tokio::net::TcpStream::connect(address).await.is_err());
    assert!(may_write(&mut rig.client().await).await);
    rig.end().await;
}

/// A listener that a reload removes still answers open requests, however long that takes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_write_under_way_is_answered_after_its_listener_was_closed() {
    let mut rig = Rig::new().await;
    let mut client = rig.client().await;
    rig.buses[0].pause(true);
    let transaction = client.request(1, &words(6, &[2000, 0])).await;
    until("the write is queued", || rig.buses[0].waiting() > 0).await;
    let mut moved = options();
    moved.listeners[0].listen = vec![([127, 0, 0, 2], 0).into()];
    rig.reload(moved).await.unwrap();
    // Longer than a gateway that stops waits.
    tokio::time::sleep(Duration::from_secs(1)).await;
    rig.buses[0].pause(false);
    let (answered, unit, pdu) = client.answer().await.expect("an answer");
    assert_eq!((answered, unit, pdu), (transaction, 1, words(6, &[2000, 0])));
    assert!(client.is_closed().await);
    rig.end().await;
}
