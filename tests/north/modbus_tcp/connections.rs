//! Who may connect, how many, and the end of it all.

use std::net::SocketAddr;
use std::sync::Arc;

use arc_swap::ArcSwap;
use drivegate::north::modbus_tcp;
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
    // The place is given back a moment after the count.
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

/// A client that vanished without a word is found out: the kernel asks for it once it is silent for a minute.
#[tokio::test]
async fn connections_are_kept_alive() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    client.ask(1, &words(3, &[2102, 1])).await;
    let ends = [rig.address(), client.stream.local_addr().unwrap()].map(|end| format!(":{:04X}", end.port()));
    // The timer of the server's side as proc(5) has it: which (02 is keepalive), and its rest in 1/100 s.
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
        let mut client = Client::connect(*address).await;
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

/// A runtime that is busy with other things does not hold clients up: this one has a single thread, which waits.
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
    let why = modbus_tcp::start(options, plant, Arc::default(), CancellationToken::new())
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
            listener.buses = Some(vec![bus.to_string()]);
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
    // Unit 255: the blocks keep their addresses, those of other buses are not there.
    assert_eq!(one.ask(255, &words(4, &[1, 1])).await, registers(4, &[3]));
    assert_eq!(one.ask(255, &words(4, &[17, 1])).await, [0x84, 2]);
    assert_eq!(two.ask(255, &words(4, &[1, 1])).await, [0x84, 2]);
    assert_eq!(two.ask(255, &words(4, &[17, 1])).await, registers(4, &[1]));
    assert_eq!(all.ask(255, &words(4, &[0, 32])).await.len(), 66);
    // A reload reaches the listeners as it reaches one.
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
