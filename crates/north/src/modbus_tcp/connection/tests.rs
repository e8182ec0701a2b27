use std::sync::Arc;

use arc_swap::ArcSwap;
use tokio::io::DuplexStream;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::super::client::Client;
use super::super::routes::{PlantView, View};
use super::super::{Options, ServerState, Uncached};
use super::*;
use crate::NorthState;
use crate::connection_limit::{ConnectionLimit, Limits, Newcomer};
use crate::reading::Dated;
use drivegate_core::order::Authority;
use drivegate_core::plant::Plant;

/// Reads input register 0 of unit 255 in a plant without a bus; answered at once with exception 02.
const REQUEST: [u8; 12] = [0, 1, 0, 0, 0, 6, 255, 4, 0, 0, 0, 1];
const ANSWER: [u8; 9] = [0, 1, 0, 0, 0, 3, 255, 0x84, 2];

struct PipedClient {
    client: DuplexStream,
    server: JoinHandle<()>,
    stats: Arc<NorthState>,
    cancel: CancellationToken,
    place: Arc<ConnectionPlace>,
}

/// A connection through a pipe whose buffer has `pipe` bytes in each direction.
fn rig(pipe: usize) -> PipedClient {
    rig_with(pipe, None)
}

fn rig_with(pipe: usize, idle_timeout: Option<Duration>) -> PipedClient {
    let options = Options {
        listeners: Vec::new(),
        tls: None,
        max_connections: 1,
        max_connections_per_address: 1,
        idle_timeout: None,
        uncached: Uncached::Refuse,
    };
    let plant = Plant::new("test", Duration::from_secs(1), Vec::new());
    let stats = Arc::new(NorthState::default());
    let state = ServerState::new(options, stats.clone(), CancellationToken::new());
    let view = PlantView::new(
        0,
        Arc::new(ArcSwap::from_pointee(plant)),
        Arc::default(),
        View::default(),
    );
    let client = Client::new(([127, 0, 0, 1], 502).into(), None, Authority::ReadOnly);
    let session = ClientSession::new(Arc::new(state), Arc::new(view), client);
    let (client, end) = tokio::io::duplex(pipe);
    let cancel = CancellationToken::new();
    let limit = ConnectionLimit::new(Limits::new(1, 1));
    let newcomer = Newcomer {
        address: [127, 0, 0, 1].into(),
        listener: 0,
        cancel: &cancel,
    };
    let (permit, _) = limit
        .acquire(newcomer, Instant::now().into_std(), || Some(Authority::ReadOnly))
        .unwrap();
    let place = permit.place().clone();
    let server = tokio::spawn(async move {
        let reader = Arc::new(Reader::here());
        let stream = Dated::new(end, reader.clone());
        serve(
            (stream, reader),
            session,
            idle_timeout,
            permit.place(),
            &CancellationToken::new(),
        )
        .await;
    });
    PipedClient {
        client,
        server,
        stats,
        cancel,
        place,
    }
}

impl PipedClient {
    async fn send(&mut self, bytes: &[u8]) {
        self.client.write_all(bytes).await.unwrap();
    }

    async fn receive(&mut self, count: usize) -> Vec<u8> {
        let mut bytes = vec![0; count];
        self.client.read_exact(&mut bytes).await.unwrap();
        bytes
    }

    /// All bytes received until the connection is closed.
    async fn rest(&mut self) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.client.read_to_end(&mut bytes).await.unwrap();
        bytes
    }
}

#[tokio::test(start_paused = true)]
async fn an_incomplete_frame_times_out_after_ten_seconds() {
    let mut rig = rig(1024);
    rig.send(&REQUEST).await;
    assert_eq!(rig.receive(9).await, ANSWER);
    let begin = Instant::now();
    for byte in &REQUEST[..5] {
        // Single bytes do not extend the time limit.
        rig.send(&[*byte]).await;
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    assert_eq!(rig.rest().await, b"");
    assert_eq!(begin.elapsed(), FRAME_TIMEOUT);
    rig.server.await.unwrap();
    assert_eq!(rig.stats.modbus_tcp.connections(), 0);
}

#[tokio::test(start_paused = true)]
async fn silent_and_slow_clients_stay_connected() {
    let mut rig = rig(1024);
    tokio::time::sleep(Duration::from_secs(100_000)).await;
    // The input always ends with an incomplete frame, but each frame is completed in time.
    rig.send(&REQUEST[..5]).await;
    for _ in 0..5 {
        tokio::time::sleep(FRAME_TIMEOUT - Duration::from_secs(1)).await;
        rig.send(&REQUEST[5..]).await;
        rig.send(&REQUEST[..5]).await;
        assert_eq!(rig.receive(9).await, ANSWER);
    }
}

#[tokio::test(start_paused = true)]
async fn a_client_that_reads_no_answers_is_disconnected() {
    let mut rig = rig(64);
    let begin = Instant::now();
    let mut sent = 0usize;
    // The client keeps writing and reads nothing: the server must stop reading, then close.
    while rig.client.write_all(&REQUEST).await.is_ok() {
        sent += 1;
        assert!(sent < 10_000, "the server never stops reading");
    }
    assert_eq!(begin.elapsed(), WRITE_TIMEOUT);
    rig.server.await.unwrap();
    assert_eq!(rig.stats.modbus_tcp.connections(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_stopped_client_does_not_delay_shutdown() {
    let mut rig = rig(16);
    let flood: Vec<u8> = REQUEST.iter().copied().cycle().take(12 * 20).collect();
    let _ = tokio::time::timeout(Duration::from_secs(1), rig.send(&flood)).await;
    let begin = Instant::now();
    rig.cancel.cancel();
    rig.server.await.unwrap();
    assert!(begin.elapsed() <= CLOSE_TIMEOUT, "{:?}", begin.elapsed());
}

#[tokio::test(start_paused = true)]
async fn a_batch_is_answered_however_it_is_segmented() {
    for piece in [1, 2, 5, 7, 11, 12, 13, 100, 4096] {
        let mut rig = rig(4096);
        let requests: Vec<u8> = (0..100u16)
            .flat_map(|n| {
                let mut request = REQUEST;
                request[..2].copy_from_slice(&n.to_be_bytes());
                request
            })
            .collect();
        for bytes in requests.chunks(piece) {
            rig.send(bytes).await;
        }
        for n in 0..100u16 {
            let mut answer = ANSWER;
            answer[..2].copy_from_slice(&n.to_be_bytes());
            assert_eq!(rig.receive(9).await, answer, "pieces of {piece}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn requests_before_invalid_data_are_answered() {
    for nonsense in [
        &b"GET / HTTP/1.1\r\n"[..],
        &[0, 2, 0, 0, 0, 0],
        &[0, 2, 0, 0, 0xFF, 0xFF, 255, 4],
        &[0, 2, 0, 1],
    ] {
        let mut rig = rig(1024);
        rig.send(&[&REQUEST, nonsense, &REQUEST].concat()).await;
        assert_eq!(rig.rest().await, ANSWER);
        rig.server.await.unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn a_half_closed_connection_gets_its_answers() {
    let mut rig = rig(1024);
    rig.send(&REQUEST).await;
    rig.client.shutdown().await.unwrap();
    assert_eq!(rig.rest().await, ANSWER);
    rig.server.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn an_idle_client_is_disconnected() {
    let timeout = Duration::from_secs(60);
    let mut rig = rig_with(1024, Some(timeout));
    for _ in 0..5 {
        tokio::time::sleep(timeout - Duration::from_secs(1)).await;
        rig.send(&REQUEST).await;
        assert_eq!(rig.receive(9).await, ANSWER);
    }
    let begin = Instant::now();
    assert_eq!(rig.rest().await, b"");
    assert_eq!(begin.elapsed(), timeout);
    rig.server.await.unwrap();
    assert_eq!(rig.stats.modbus_tcp.connections(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_connection_is_in_use_once_it_has_asked_and_ends_when_its_place_is_taken() {
    let mut rig = rig(1024);
    rig.send(&REQUEST[..5]).await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert!(!rig.place.is_in_use());
    rig.send(&REQUEST[5..]).await;
    assert_eq!(rig.receive(9).await, ANSWER);
    assert!(rig.place.is_in_use());
    rig.place.close(CloseReason::Displaced);
    assert_eq!(rig.rest().await, b"");
    rig.server.await.unwrap();
    assert_eq!(rig.stats.modbus_tcp.connections(), 0);
}
