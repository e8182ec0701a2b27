//! HTTP: status page, Prometheus metrics, health and the JSON interface; with commands by users, if they are enabled.
//!
//! hyper serves the connections directly, because axum's own loop gives a client unlimited time to send its request.
//! The cancellation ends everything, including open event streams.

mod access;
mod api;
mod app_state;
mod body;
mod credentials;
mod documents;
mod event_log;
mod expect;
mod hosts;
mod in_use;
mod limits;
mod line;
pub mod local;
mod loopback;
pub mod messages;
mod mqtt;
mod openapi;
mod operating;
mod options;
mod page;
mod params;
mod points;
mod query;
mod reached;
mod recordings;
mod replies;
mod routes;
mod socket_door;
mod streams;
mod terms;
mod tokens;
mod trend;
mod users;
mod views;

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use arc_swap::ArcSwap;
use axum::Router;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::hosts::Host;
use self::in_use::InUse;
use self::limits::{ANSWERED_WITHIN, GRACE, HANDSHAKE, HEALTH, MAX_HEAD, USER_TIMEOUT};
pub use self::limits::{MAX_CONNECTIONS, MAX_LISTENERS, MAX_LISTENERS_PER_ADDRESS};
use self::operating::Operating;
pub use self::operating::basic_authorization;
pub use self::options::Options;
use self::reached::LocalUser;
use self::reached::{Client, Coverage, Reached};
pub use self::socket_door::InProcess;
use self::socket_door::SocketDoor;
use self::terms::{Terms, Tls};
use drivegate_core::history::History;
use drivegate_core::plant::{DriveHandle, SharedPlant};
use drivegate_north::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached, Newcomer};
use drivegate_north::listener::{ConnectionHandler, ListenerSpec, Listeners, NewSockets};
use drivegate_north::log_throttle::LogThrottle;
use drivegate_north::reading::{Dated, Reader};
use drivegate_north::refusals::Refusals;
use drivegate_north::tcp_server::{TcpServer, TcpService};
use drivegate_north::tls::{self, Peer};
use drivegate_north::{NorthState, ServerError, ServerKind};

pub use self::credentials::{Credential, CredentialError, Credentials};
pub use self::loopback::Loopback;
pub use self::tokens::{Scope, Token, Tokens};
pub use self::users::{MAX_PASSWORD, MIN_PASSWORD, User, Users};

/// Whether `text` is valid in [`Options::hosts`]: a host name or an address, without a port.
pub fn is_host(text: &str) -> bool {
    Host::configured(text).is_some()
}

/// The running HTTP server.
pub type Http = TcpServer<HttpService, Options>;

/// The service for the clients of the listener.
#[derive(Debug)]
pub struct HttpService {
    terms: Arc<ArcSwap<Terms>>,
    plant: SharedPlant,
    stats: Arc<NorthState>,
    operating: Arc<Operating>,
    /// Token that is cancelled when the server ends.
    stopping: CancellationToken,
}

impl TcpService<Options> for HttpService {
    const NAME: &'static str = "HTTP";
    const KIND: ServerKind = ServerKind::Http;
    type Handler = HttpConnections;
    type Prepared = Terms;

    fn new(
        options: &Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
        _: &TaskTracker,
    ) -> Result<HttpService, ServerError> {
        Ok(HttpService {
            stopping: cancel,
            terms: Arc::new(ArcSwap::from_pointee(Terms::new(options)?)),
            plant,
            operating: Arc::new(Operating::new(&stats)),
            stats,
        })
    }

    fn listener_specs(options: &Options) -> Vec<ListenerSpec> {
        vec![ListenerSpec {
            address: options.listen,
            tls: options.identity.is_some(),
            section: "[http]".to_string(),
        }]
    }

    fn prepare(&self, options: &Options) -> Result<Terms, ServerError> {
        Terms::new(options)
    }

    /// Applies the new options. If hosts or tokens change, or the listener is replaced, connections and streams
    /// end; a connection with a command in progress ends after its reply. New certificates apply to new
    /// connections.
    fn commit(
        &mut self,
        options: Options,
        terms: Terms,
        sockets: NewSockets,
        listeners: &mut Listeners<HttpConnections>,
    ) {
        terms.replace(&self.terms);
        self.operating.set_users(options.users.clone());
        let (plant, stats, terms, operating) = (&self.plant, &self.stats, &self.terms, &self.operating);
        let stopping = &self.stopping;
        listeners.commit(sockets, |_, open, cancel| {
            let handler = match open {
                Some(handler) => handler.clone(),
                None => Arc::new(HttpConnections::new(
                    &options, plant, stats, terms, operating, cancel, stopping,
                )),
            };
            handler.limit.set_limits(options.limits());
            (handler, Handle::current())
        });
    }

    /// Revokes the right to command of all HTTP clients when the server is removed, including requests still being
    /// received.
    fn retire(&mut self) {
        self.operating.set_users(None);
    }
}

/// Serves the connections of a listener.
#[derive(Debug)]
pub struct HttpConnections {
    router: Router,
    terms: Arc<ArcSwap<Terms>>,
    limit: Arc<ConnectionLimit>,
    health: Arc<ConnectionLimit>,
    refusals: Refusals,
    /// Limits the log of requests without access.
    no_access: Arc<LogThrottle>,
    operating: Arc<Operating>,
    cancel: CancellationToken,
    stopping: CancellationToken,
}

/// The place of a connection, and which requests it may send.
pub struct HttpPermit {
    permit: ConnectionPermit,
    coverage: Coverage,
}

impl HttpConnections {
    fn new(
        options: &Options,
        plant: &SharedPlant,
        stats: &Arc<NorthState>,
        terms: &Arc<ArcSwap<Terms>>,
        operating: &Arc<Operating>,
        cancel: &CancellationToken,
        stopping: &CancellationToken,
    ) -> HttpConnections {
        HttpConnections {
            router: routes::router(plant.clone(), stats.clone(), operating.clone(), cancel.clone()),
            operating: operating.clone(),
            terms: terms.clone(),
            limit: ConnectionLimit::new(options.limits()),
            health: ConnectionLimit::new(HEALTH),
            refusals: Refusals::new(ServerKind::Http, stats.clone()),
            no_access: Arc::default(),
            cancel: cancel.clone(),
            stopping: stopping.clone(),
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
            [(&self.limit, Coverage::Everything), (&self.health, Coverage::Health)],
            Instant::now(),
        );
        limits.into_iter().find_map(|(limit, coverage)| {
            let permit = self.refusals.acquire(limit, newcomer, remedy, || {
                Some(self.operating.authority_at(address, now))
            })?;
            permit.place().use_at(now, false);
            Some(HttpPermit { permit, coverage })
        })
    }

    async fn serve(self: Arc<Self>, stream: Dated<TcpStream>, peer: SocketAddr, place: HttpPermit) {
        set_socket_options(stream.stream());
        let reader = stream.reader().clone();
        let terms = self.terms.load_full();
        // If the local address is unknown, the client has disconnected.
        let Ok(local) = stream.stream().local_addr() else {
            return;
        };
        let local = local.ip();
        let Some(Tls(acceptor)) = &terms.tls else {
            return self.serve_requests((stream, reader), peer, local, &terms, &place).await;
        };
        let handshake = timeout(HANDSHAKE.min(place.coverage.head_timeout()), acceptor.accept(stream));
        let closing = place.permit.place().closing();
        match closing.run_until_cancelled(handshake).await {
            Some(Ok(Ok(stream))) => {
                self.serve_requests((stream, reader), peer, local, &terms, &place).await;
            }
            Some(Ok(Err(error))) => {
                let why = tls::in_words(&error, Peer::Client);
                tracing::debug!(target: "drivegate::http", %peer, "HTTP: TLS handshake failed: {why}");
            }
            Some(Err(_)) | None => {}
        }
    }
}

impl HttpConnections {
    /// Answers the requests of a client that connected to this machine's address `local`. After the cancellation,
    /// or when the terms are replaced, the connection has [`GRACE`] to finish its reply; the reply to a command is
    /// completed first, unless the whole server ends.
    async fn serve_requests(
        &self,
        (stream, reader): (impl AsyncRead + AsyncWrite + Unpin, Arc<Reader>),
        peer: SocketAddr,
        local: IpAddr,
        terms: &Terms,
        permit: &HttpPermit,
    ) {
        let (place, coverage) = (permit.permit.place(), permit.coverage);
        let reached = Reached {
            address: local,
            peer,
            refusals: self.no_access.clone(),
            access: terms.access.clone(),
            tls: terms.tls.is_some(),
            local: None,
            place: Some(place.clone()),
        };
        let client = Client {
            address: peer.ip(),
            coverage,
        };
        // Each token stands for a command whose reply is pending.
        let commands = TaskTracker::new();
        let router = TowerToHyperService::new(self.router.clone());
        let service = service_fn(|mut request: hyper::Request<Incoming>| {
            let in_use = InUse::new(place.clone());
            // A user may have logged in or out since the connection was opened.
            place
                .rights()
                .set(self.operating.authority_at(peer.ip(), Instant::now()));
            request.extensions_mut().insert(client);
            request.extensions_mut().insert(reached.clone());
            // The head of the request has just been read.
            request.extensions_mut().insert(reader.last());
            request.extensions_mut().insert(reader.clone());
            let command =
                matches!(*request.method(), hyper::Method::POST | hyper::Method::DELETE).then(|| commands.token());
            let reply = router.call(request);
            async move {
                // Lets other clients run between two pipelined requests.
                tokio::task::yield_now().await;
                let reply = reply.await;
                drop(command);
                reply.map(|reply| reply.map(|body| in_use.until_end_of(body)))
            }
        });
        let mut connection = pin!(
            http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(coverage.head_timeout())
                .keep_alive(coverage == Coverage::Everything)
                .max_buf_size(MAX_HEAD)
                .serve_connection(TokioIo::new(stream), service)
        );
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = ended(place.closing(), &terms.replaced) => if place.is_in_use() {
                connection.as_mut().graceful_shutdown();
                commands.close();
                let last = async {
                    let answered = timeout(ANSWERED_WITHIN, commands.wait());
                    // The wait has ended by cancellation or by new terms; both are handled here.
                    let _ = self.stopping.run_until_cancelled(answered).await;
                    tokio::time::sleep(GRACE).await;
                };
                tokio::select! {
                    ended = connection => ended,
                    () = last => Ok(()),
                }
            } else {
                // No request is in progress, so there is no reply to finish.
                Ok(())
            }
        };
        // Clients that disconnect or send invalid data are normal operation.
        if let Err(error) = ended {
            tracing::debug!(target: "drivegate::http", %peer, "HTTP connection ended: {error}");
        }
    }
}

async fn ended(server: &CancellationToken, terms: &CancellationToken) {
    tokio::select! {
        () = server.cancelled() => {}
        () = terms.cancelled() => {}
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

/// The JSON of `/api/v1/drives/{name}` for a drive at `now`, which is `wall` on the calendar. Pure.
///
/// # Errors
/// If a value cannot be expressed in JSON; no such value is known.
pub fn drive_json(
    drive: &DriveHandle,
    history: &History,
    now: Instant,
    wall: SystemTime,
) -> serde_json::Result<serde_json::Value> {
    serde_json::to_value(api::Drive::new(drive, history, api::Clock::new(now, wall)))
}
