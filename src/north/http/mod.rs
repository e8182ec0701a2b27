//! HTTP: status page, Prometheus metrics, health and the JSON interface. GET and HEAD only.
//!
//! The connections are served by hyper directly, because axum's own loop gives a client unlimited time to
//! send its request. Everything ends on the cancellation token, open event streams included.

mod api;
mod page;
mod routes;
mod streams;

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::NorthStats;
use crate::plant::{DriveHandle, SharedPlant};

/// Connections at one time; a client beyond that is told to come back.
pub const MAX_CONNECTIONS: usize = 128;

/// Listeners of event streams at one time; each holds a connection for long.
pub const MAX_LISTENERS: usize = 32;

/// Time for the head of a request, counted from the connection or from the reply before: bounds slow
/// senders and idle connections.
const HEAD_TIMEOUT: Duration = Duration::from_secs(30);

/// Bytes of the head of a request.
const MAX_HEAD: usize = 16 * 1024;

/// Time until a client that acknowledges nothing, or takes no bytes, is dropped.
const USER_TIMEOUT: Duration = Duration::from_secs(30);

/// Wait after an accept error that does not come from one client, such as no free descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Time that replies under way get when the gateway stops.
const GRACE: Duration = Duration::from_millis(500);

/// What the HTTP server is told.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Address to listen on.
    pub listen: SocketAddr,
}

/// The running server.
#[derive(Debug)]
pub struct Http {
    address: SocketAddr,
    task: JoinHandle<()>,
}

impl Http {
    /// Where it listens; tells the port when port 0 was asked for.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Waits until it has stopped, which takes half a second at most once the token is cancelled.
    pub async fn stopped(self) {
        if let Err(error) = self.task.await {
            tracing::error!(target: "drivegate::http", "the HTTP server ended by itself: {error}; report this");
        }
    }
}

/// Starts the server. It runs until `cancel`, whatever clients do.
///
/// # Errors
/// When the address cannot be listened on; the kind is that of the system (`AddrInUse` and so on).
pub async fn start(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) -> io::Result<Http> {
    let listener = TcpListener::bind(options.listen).await.map_err(|error| {
        let text = format!(
            "cannot listen on {}: {error}; choose another address in [http] listen, or stop what uses it",
            options.listen
        );
        io::Error::new(error.kind(), text)
    })?;
    let address = listener.local_addr()?;
    let router = routes::router(plant, stats, cancel.clone());
    tracing::info!(target: "drivegate::http", %address, "HTTP listens");
    let task = tokio::spawn(accept(listener, router, cancel));
    Ok(Http { address, task })
}

/// What `/api/v1/drives/{name}` says of a drive at `now`, which is `wall` on the calendar. Pure.
///
/// # Errors
/// None is known; a value that JSON cannot express would be one.
pub fn drive_json(drive: &DriveHandle, now: Instant, wall: SystemTime) -> serde_json::Result<serde_json::Value> {
    serde_json::to_value(api::Drive::new(drive, api::Clock::new(now, wall)))
}

/// Takes connections in until `cancel`, then waits for those that are open.
async fn accept(listener: TcpListener, router: Router, cancel: CancellationToken) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let connections = TaskTracker::new();
    let mut failing = false;
    let mut full = false;
    while let Some(accepted) = cancel.run_until_cancelled(listener.accept()).await {
        match accepted {
            Ok((stream, peer)) => {
                failing = false;
                match places.clone().try_acquire_owned() {
                    Ok(place) => {
                        full = false;
                        connections.spawn(serve(stream, router.clone(), cancel.clone(), place));
                    }
                    Err(_) => {
                        if !full {
                            tracing::warn!(target: "drivegate::http", %peer,
                                "{MAX_CONNECTIONS} HTTP connections are open; further clients are turned away");
                        }
                        full = true;
                        turn_away(&stream);
                    }
                }
            }
            Err(error) if is_of_one_client(&error) => {}
            Err(error) => {
                if !failing {
                    tracing::warn!(target: "drivegate::http", "cannot accept HTTP connections: {error}; trying on");
                }
                failing = true;
                cancel.run_until_cancelled(tokio::time::sleep(ACCEPT_PAUSE)).await;
            }
        }
    }
    drop(listener);
    connections.close();
    connections.wait().await;
}

/// Errors of a connection that was gone before it was accepted (accept(2)).
fn is_of_one_client(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset | io::ErrorKind::Interrupted
    )
}

/// Answers a connection there is no place for. What does not fit the socket's buffer at once is let go.
fn turn_away(stream: &TcpStream) {
    const REPLY: &[u8] =
        b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nRetry-After: 5\r\nContent-Length: 0\r\n\r\n";
    let _ = stream.try_write(REPLY);
}

/// Serves one connection to its end; after `cancel` it gets [`GRACE`].
async fn serve(stream: TcpStream, router: Router, cancel: CancellationToken, place: OwnedSemaphorePermit) {
    let peer = stream.peer_addr().ok();
    tune(&stream);
    let service = TowerToHyperService::new(router);
    let mut connection = pin!(
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_TIMEOUT)
            .max_buf_size(MAX_HEAD)
            .serve_connection(TokioIo::new(stream), service)
    );
    let ended = match cancel.run_until_cancelled(connection.as_mut()).await {
        Some(ended) => ended,
        None => {
            connection.as_mut().graceful_shutdown();
            within_grace(connection).await
        }
    };
    // Clients that hang up, send rubbish or nothing at all are everyday, and none of them is served worse.
    if let Err(error) = ended {
        tracing::debug!(target: "drivegate::http", ?peer, "HTTP connection ended: {error}");
    }
    drop(place);
}

async fn within_grace<E>(connection: impl Future<Output = Result<(), E>>) -> Result<(), E> {
    timeout(GRACE, connection).await.unwrap_or(Ok(()))
}

/// Small replies leave at once, and a peer that is gone does not hold its place for long. A socket that
/// refuses either option still works.
fn tune(stream: &TcpStream) {
    let _ = stream.set_nodelay(true);
    let millis = u32::try_from(USER_TIMEOUT.as_millis()).unwrap_or(u32::MAX);
    let _ = rustix::net::sockopt::set_tcp_user_timeout(stream, millis);
}
