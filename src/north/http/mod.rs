//! HTTP: status page, Prometheus metrics, health and the JSON interface. GET and HEAD only.
//!
//! hyper serves the connections directly, because axum's own loop gives a client unlimited time to send its request.
//! The cancellation ends everything, including open event streams.

mod api;
mod in_use;
mod offline;
mod page;
mod routes;
mod streams;

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use axum::Router;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::in_use::InUse;
use super::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached, Limits, Newcomer};
use super::listener::{ConnectionHandler, ListenerSpec, Listeners, NewSockets};
use super::refusals::Refusals;
use super::{NorthStats, ServerError, ServerKind};
use crate::command::Authority;
use crate::plant::{DriveHandle, SharedPlant};

pub use self::offline::Offline;

/// Maximum number of open connections. A connection whose request is incomplete, and one between two requests, yields to
/// a newer one.
pub const MAX_CONNECTIONS: usize = 128;

/// Maximum number of open event streams; each occupies a connection for a long time.
pub const MAX_LISTENERS: usize = 32;

/// Maximum number of open event streams of one address.
pub const MAX_LISTENERS_PER_ADDRESS: usize = 16;

/// Connections beyond the limits, which are served `/healthz` and `/readyz` only: whatever the others do, these two answer.
const HEALTH: Limits = Limits {
    total: 8,
    reserved: 0,
    per_address: 4,
};

/// Time limit for the head of a request on such a connection.
const HEALTH_HEAD_TIMEOUT: Duration = Duration::from_secs(5);

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
    /// Maximum number of open connections: [`MAX_CONNECTIONS`], or fewer where the system allows fewer open files.
    pub max_connections: usize,
}

impl Options {
    /// Files that the connections can have open at one time, with those that are being closed.
    pub(crate) fn files(&self) -> usize {
        self.limits().files() + HEALTH.files()
    }

    /// Half of the connections can be those of one address.
    fn limits(&self) -> Limits {
        Limits::new(self.max_connections, self.max_connections.div_ceil(2))
    }
}

/// The running server.
#[derive(Debug)]
pub struct Http {
    listeners: Listeners<HttpConnections>,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    tasks: TaskTracker,
}

/// What [`Http::commit`] needs to apply new options: all that can fail is done.
#[derive(Debug)]
pub struct Change {
    options: Options,
    sockets: NewSockets,
}

impl Http {
    /// The address it listens on, with the port that the system chose if port 0 was configured.
    pub fn address(&self) -> Option<SocketAddr> {
        self.listeners.addresses(false).first().copied()
    }

    /// Prepares other options: binds a new address. Nothing changes for any client.
    ///
    /// # Errors
    /// The address cannot be bound; everything is as before.
    pub async fn prepare(&mut self, options: Options) -> Result<Change, ServerError> {
        let spec = ListenerSpec {
            address: options.listen,
            tls: false,
            section: "[http]".to_string(),
        };
        let sockets = self.listeners.prepare(vec![spec]).await?;
        Ok(Change { options, sockets })
    }

    /// Forgets prepared options.
    pub fn abort(&mut self, change: Change) {
        self.listeners.abort(change.sockets);
    }

    /// Applies prepared options: to the next request of each connection, if the address is the same.
    pub fn commit(&mut self, Change { options, sockets }: Change) {
        let (plant, stats) = (&self.plant, &self.stats);
        self.listeners.commit(sockets, |_, open, cancel| {
            let handler = match open {
                Some(handler) => handler.clone(),
                None => Arc::new(HttpConnections::new(&options, plant, stats, cancel)),
            };
            handler.limit.set_limits(options.limits());
            (handler, Handle::current())
        });
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
    // A reload can replace the listener, so the server ends with the token and not with its last task.
    tasks.spawn(cancel.clone().cancelled_owned());
    tasks.close();
    let mut http = Http {
        listeners: Listeners::new(ServerKind::Http, stats.clone(), tasks.clone(), cancel),
        plant,
        stats,
        tasks,
    };
    let change = http.prepare(options).await?;
    http.commit(change);
    Ok(http)
}

/// Serves the connections of a listener.
#[derive(Debug)]
struct HttpConnections {
    router: ArcSwap<Router>,
    limit: Arc<ConnectionLimit>,
    health: Arc<ConnectionLimit>,
    refusals: Refusals,
    cancel: CancellationToken,
}

/// The place of a connection, and what it is for.
struct HttpPermit {
    permit: ConnectionPermit,
    scope: Scope,
}

/// What a connection is served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scope {
    Everything,
    /// `/healthz` and `/readyz`; the rest is refused with 503.
    Health,
}

impl HttpConnections {
    fn new(
        options: &Options,
        plant: &SharedPlant,
        stats: &Arc<NorthStats>,
        cancel: &CancellationToken,
    ) -> HttpConnections {
        HttpConnections {
            router: ArcSwap::from_pointee(routes::router(plant.clone(), stats.clone(), cancel.clone())),
            limit: ConnectionLimit::new(options.limits()),
            health: ConnectionLimit::new(HEALTH),
            refusals: Refusals::new(ServerKind::Http, stats.clone()),
            cancel: cancel.clone(),
        }
    }
}

impl ConnectionHandler for HttpConnections {
    type Permit = HttpPermit;

    fn admit(&self, address: IpAddr) -> Option<HttpPermit> {
        let newcomer = Newcomer {
            address,
            listener: 0,
            cancel: &self.cancel,
        };
        let (limits, now) = (
            [(&self.limit, Scope::Everything), (&self.health, Scope::Health)],
            Instant::now(),
        );
        limits.into_iter().find_map(|(limit, scope)| {
            let permit = self
                .refusals
                .acquire(limit, newcomer, remedy, || Some(Authority::ReadOnly))?;
            permit.place().use_at(now, false);
            Some(HttpPermit { permit, scope })
        })
    }

    /// After the cancellation a connection has [`GRACE`] to finish its reply.
    async fn serve(self: Arc<Self>, stream: TcpStream, peer: SocketAddr, HttpPermit { permit, scope }: HttpPermit) {
        set_socket_options(&stream);
        let place = permit.place();
        let service = service_fn(|mut request: hyper::Request<hyper::body::Incoming>| {
            let in_use = InUse::new(place.clone());
            request.extensions_mut().insert(routes::Client {
                address: peer.ip(),
                scope,
            });
            let reply = TowerToHyperService::new(self.router.load().as_ref().clone()).call(request);
            async move {
                // Other clients have a turn between two pipelined requests.
                tokio::task::yield_now().await;
                reply.await.map(|reply| reply.map(|body| in_use.until_end_of(body)))
            }
        });
        let head_timeout = match scope {
            Scope::Everything => HEAD_TIMEOUT,
            Scope::Health => HEALTH_HEAD_TIMEOUT,
        };
        let mut connection = pin!(
            http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(head_timeout)
                .keep_alive(scope == Scope::Everything)
                .max_buf_size(MAX_HEAD)
                .serve_connection(TokioIo::new(stream), service)
        );
        let ended = match place.closing().run_until_cancelled(connection.as_mut()).await {
            Some(ended) => ended,
            // There is no reply to finish.
            None if !place.is_in_use() => Ok(()),
            None => {
                connection.as_mut().graceful_shutdown();
                timeout(GRACE, connection).await.unwrap_or(Ok(()))
            }
        };
        // Clients that disconnect or send invalid data are normal operation.
        if let Err(error) = ended {
            tracing::debug!(target: "drivegate::http", %peer, "HTTP connection ended: {error}");
        }
    }
}

fn remedy(reached: LimitReached) -> String {
    match reached {
        LimitReached::Total(_) => "close unused connections".to_string(),
        LimitReached::Address(_) => "close unused connections of this address".to_string(),
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
