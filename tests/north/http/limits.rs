//! Clients that occupy places: silent ones, slow ones, event streams. Whatever they do, other clients are served.

use std::net::SocketAddr;

use drivegate_http::{MAX_CONNECTIONS, MAX_LISTENERS, MAX_LISTENERS_PER_ADDRESS, Options};
use drivegate_north::{ConnectionRefusal, ServerKind};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::timeout;

use super::client::{EventStream, PATIENCE, get};
use super::plant::{self, Server};

/// A connection from this loopback address.
async fn connect_from(from: [u8; 4], address: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind((from, 0).into()).unwrap();
    socket.connect(address).await.unwrap()
}

/// The status of a request from this loopback address.
async fn status_from(from: [u8; 4], address: SocketAddr, path: &str) -> u16 {
    let mut stream = connect_from(from, address).await;
    let head = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut reply = String::new();
    let read = timeout(PATIENCE, stream.read_to_string(&mut reply)).await;
    read.expect("a reply in time").expect("a reply");
    reply[9..12].parse().unwrap()
}

fn turned_away(server: &Server, why: ConnectionRefusal) -> u64 {
    let mut counts = server.stats.refused.of(ServerKind::Http);
    counts.find(|(reason, _)| *reason == why).unwrap().1
}

/// An event stream from this loopback address, open or refused.
async fn stream_from(from: [u8; 4], address: SocketAddr) -> (TcpStream, u16) {
    let mut stream = connect_from(from, address).await;
    stream
        .write_all(b"GET /api/v1/events HTTP/1.0\r\nHost: localhost\r\n\r\n")
        .await
        .unwrap();
    let mut head = [0; 12];
    timeout(PATIENCE, stream.read_exact(&mut head)).await.unwrap().unwrap();
    (stream, String::from_utf8_lossy(&head[9..]).parse().unwrap())
}

#[tokio::test]
async fn slow_heads_and_idle_connections_keep_nobody_out() {
    let server = Server::of(plant::mixed()).await;
    let mut open = Vec::new();
    for n in 0..3 * MAX_CONNECTIONS {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        let sent = match n % 3 {
            0 => "",
            1 => "GET /healthz HT",
            _ => "GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n",
        };
        stream.write_all(sent.as_bytes()).await.unwrap();
        open.push(stream);
        if n % 16 == 0 {
            for path in ["/healthz", "/api/v1/buses"] {
                assert_eq!(get(server.address, path).await.status, 200, "{n} connections");
                assert_eq!(status_from([127, 0, 0, 2], server.address, path).await, 200);
            }
        }
    }
    assert!(turned_away(&server, ConnectionRefusal::Displaced) > 0);
    assert_eq!(turned_away(&server, ConnectionRefusal::AddressFull), 0);
}

/// An address whose connections are all in use is served the two paths for monitoring only.
#[tokio::test]
async fn health_has_places_of_its_own() {
    let options = Options {
        max_connections: 4,
        ..Options::listening_on(SocketAddr::from(([127, 0, 0, 1], 0)))
    };
    let server = Server::with(plant::mixed(), options).await;
    let mut open = Vec::new();
    for _ in 0..2 {
        let stream = EventStream::open(server.address, "/api/v1/trace", "").await;
        open.push(stream.opened().await);
    }
    let mut silent = Vec::new();
    for _ in 0..20 {
        assert_eq!(get(server.address, "/healthz").await.status, 200);
        assert!(
            get(server.address, "/readyz")
                .await
                .body
                .starts_with("not ready\ndrive")
        );
        let refused = get(server.address, "/api/v1/buses").await;
        assert_eq!((refused.status, refused.header("retry-after")), (503, Some("5")));
        assert_eq!(status_from([127, 0, 0, 2], server.address, "/api/v1/buses").await, 200);
        // Silent connections cannot occupy these places, either.
        silent.push(TcpStream::connect(server.address).await.unwrap());
    }
    assert!(turned_away(&server, ConnectionRefusal::AddressFull) > 0);
    drop(open.pop());
    let again = async {
        // A stream without a reader ends when the server next writes to it.
        while get(server.address, "/api/v1/buses").await.status != 200 {
            tokio::task::yield_now().await;
        }
    };
    timeout(PATIENCE, again).await.expect("a place");
}

#[tokio::test]
async fn streams_of_one_address_leave_places_to_others() {
    let server = Server::of(plant::mixed()).await;
    let mut open = Vec::new();
    for n in 0..MAX_LISTENERS {
        let (stream, status) = stream_from([127, 0, 0, 1], server.address).await;
        assert_eq!(
            status,
            if n < MAX_LISTENERS_PER_ADDRESS { 200 } else { 503 },
            "stream {n}"
        );
        open.push(stream);
    }
    for n in 0..MAX_LISTENERS_PER_ADDRESS as u8 {
        let (stream, status) = stream_from([127, 0, 0, 2 + n % 2], server.address).await;
        assert_eq!(status, 200);
        open.push(stream);
    }
    // If no place is left, an address that has none displaces the oldest connection of the address that has most.
    let (_newcomer, status) = stream_from([127, 0, 0, 4], server.address).await;
    assert_eq!(status, 200);
    let mut rest = Vec::new();
    timeout(PATIENCE, open[0].read_to_end(&mut rest))
        .await
        .unwrap()
        .unwrap();
    assert_eq!(get(server.address, "/api/v1/buses").await.status, 200);
}
