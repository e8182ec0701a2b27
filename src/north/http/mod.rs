//! HTTP: status page, Prometheus metrics, health and the JSON interface. GET and HEAD only.
//!
//! hyper serves the connections directly, because axum's own loop gives a client unlimited time to send its request.
//! The cancellation ends everything, including open event streams.

mod api;
mod offline;
mod page;
mod routes;
mod streams;

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached};
use super::listener::{AcceptLoop, ConnectionHandler, bind};
use super::log_throttle::LogThrottle;
use super::{NorthStats, ServerError};
use crate::plant::{DriveHandle, SharedPlant};

pub use self::offline::Offline;

/// Maximum number of open connections; further clients get 503.
pub const MAX_CONNECTIONS: usize = 128;

/// Maximum number of open event streams; each occupies a connection for a long time.
pub const MAX_LISTENERS: usize = 32;

/// Time limit for the head of a request, from the connection or from the previous reply on. It bounds slow senders and
/// idle connections.
const HEAD_TIMEOUT: Duration = Duration::from_secs(30);

/// Maximum length of the head of a request, bytes.
const MAX_HEAD: usize = 16 * 1024;

/// Time after which a client that acknowledges nothing or accepts no bytes is disconnected.
const USER_TIMEOUT: Duration = Duration::from_secs(30);

/// Time for pending replies when the gateway stops.
const GRACE: Duration = Duration::from_millis(500);

/// Configuration of the HTTP server.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Address to listen on.
    pub listen: SocketAddr,
}

/// The running server.
#[derive(Debug)]
pub struct Http {
    address: SocketAddr,
    tasks: TaskTracker,
}

impl Http {
    /// The address it listens on, with the port that the system chose if port 0 was configured.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Waits until the server has stopped: at most half a second after the token was cancelled.
    pub async fn stopped(self) {
        self.tasks.wait().await;
    }
}

/// Starts the server. It runs until `cancel`.
///
/// # Errors
/// The address cannot be bound.
pub async fn start(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) -> Result<Http, ServerError> {
    let tasks = TaskTracker::new();
    let mut address = options.listen;
    for (socket, bound) in bind(&[options.listen], "HTTP", "[http]").await? {
        address = bound;
        tracing::info!(target: "drivegate::http", %address, "HTTP: listening");
        let accept = AcceptLoop {
            protocol: "HTTP",
            handler: Arc::new(HttpConnections {
                router: routes::router(plant.clone(), stats.clone(), cancel.clone()),
                cancel: cancel.clone(),
                log: LogThrottle::default(),
            }),
            limit: ConnectionLimit::new(MAX_CONNECTIONS, None),
            tasks: tasks.clone(),
            cancel: cancel.clone(),
        };
        tasks.spawn(accept.run(socket));
    }
    tasks.close();
    Ok(Http { address, tasks })
}

/// Serves the connections of the HTTP server.
struct HttpConnections {
    router: Router,
    cancel: CancellationToken,
    log: LogThrottle,
}

impl ConnectionHandler for HttpConnections {
    fn admits(&self, _: IpAddr) -> bool {
        true
    }

    /// Replies 503; what does not fit the socket's buffer at once is discarded.
    fn refuse(&self, stream: &TcpStream, peer: SocketAddr, _: LimitReached) {
        const REPLY: &[u8] =
            b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nRetry-After: 5\r\nContent-Length: 0\r\n\r\n";
        let _ = stream.try_write(REPLY);
        if let Some(suppressed) = self.log.permit(Instant::now()) {
            tracing::warn!(target: "drivegate::http", %peer, suppressed,
                "HTTP: client refused: {MAX_CONNECTIONS} connections are open");
        }
    }

    /// After the cancellation a connection has [`GRACE`] to finish its reply.
    async fn serve(self: Arc<Self>, stream: TcpStream, peer: SocketAddr, permit: ConnectionPermit) {
        set_socket_options(&stream);
        let service = TowerToHyperService::new(self.router.clone());
        let mut connection = pin!(
            http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEAD_TIMEOUT)
                .max_buf_size(MAX_HEAD)
                .serve_connection(TokioIo::new(stream), service)
        );
        let ended = match self.cancel.run_until_cancelled(connection.as_mut()).await {
            Some(ended) => ended,
            None => {
                connection.as_mut().graceful_shutdown();
                timeout(GRACE, connection).await.unwrap_or(Ok(()))
            }
        };
        // Clients that disconnect or send invalid data are normal operation.
        if let Err(error) = ended {
            tracing::debug!(target: "drivegate::http", %peer, "HTTP connection ended: {error}");
        }
        drop(permit);
    }
}

/// Sends small replies without delay and drops peers that disappeared. A socket works without either option.
fn set_socket_options(stream: &TcpStream) {
    let _ = stream.set_nodelay(true);
    let millis = u32::try_from(USER_TIMEOUT.as_millis()).unwrap_or(u32::MAX);
    let _ = rustix::net::sockopt::set_tcp_user_timeout(stream, millis);
}

/// What `/api/v1/drives/{name}` says of a drive at `now`, which is `wall` on the calendar. Pure.
///
/// # Errors
/// None is known; a value that JSON cannot express would be one.
pub fn drive_json(drive: &DriveHandle, now: Instant, wall: SystemTime) -> serde_json::Result<serde_json::Value> {
    serde_json::to_value(api::Drive::new(drive, api::Clock::new(now, wall)))
}
