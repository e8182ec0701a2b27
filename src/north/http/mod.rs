//! HTTP: status page, Prometheus metrics, health and the JSON interface. GET and HEAD only.
//!
//! hyper serves the connections directly, because axum's own loop gives a client unlimited time to send its request.
//! The cancellation ends everything, including open event streams.

mod access;
mod api;
mod hosts;
mod page;
mod routes;
mod streams;
mod tokens;

use std::net::{IpAddr, SocketAddr};
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use axum::Router;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached};
use super::listener::{AcceptLoop, ConnectionHandler, bind};
use super::log_throttle::LogThrottle;
use super::{NorthStats, ServerError, ServerIdentity};
use crate::plant::{DriveHandle, SharedPlant};

use self::access::Access;
use self::hosts::{Host, Hosts};
use self::routes::Reached;

pub use self::tokens::{Scope, Token, TokenError, Tokens};

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

/// Time limit of a TLS handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);

/// Time for pending replies when the gateway stops.
const GRACE: Duration = Duration::from_millis(500);

/// Configuration of the HTTP server.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Address to listen on.
    pub listen: SocketAddr,
    /// Names and addresses that it answers under, besides its own and those of the loopback.
    pub hosts: Vec<String>,
    /// Who may read what; `None`: everybody everything.
    pub tokens: Option<Tokens>,
    /// Certificate and key; `None`: without TLS.
    pub identity: Option<ServerIdentity>,
}

impl Options {
    /// Listens on that address, open to everybody, without TLS.
    pub fn at(listen: SocketAddr) -> Options {
        Options {
            listen,
            hosts: Vec::new(),
            tokens: None,
            identity: None,
        }
    }
}

/// Whether `text` can stand in [`Options::hosts`]: a host name or an address, without a port.
pub fn is_host(text: &str) -> bool {
    Host::configured(text).is_some()
}

/// The running server.
#[derive(Debug)]
pub struct Http {
    address: SocketAddr,
    terms: Arc<ArcSwap<Terms>>,
    tasks: TaskTracker,
}

impl Http {
    /// The address it listens on, with the port that the system chose if port 0 was configured.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Applies hosts, tokens and certificates of `options`, which were `before`. Open connections end if hosts or tokens
    /// change, as do open streams; with new certificates they stay.
    ///
    /// # Errors
    /// The certificates cannot be used; everything stays as it was.
    pub fn update(&self, before: &Options, options: &Options) -> Result<(), ServerError> {
        self.apply(Terms::new(options)?, before, options);
        Ok(())
    }

    fn apply(&self, mut terms: Terms, before: &Options, options: &Options) {
        let old = self.terms.load_full();
        let same = Options {
            identity: before.identity.clone(),
            ..options.clone()
        };
        let only_certificate = same == *before && before.identity.is_some() == options.identity.is_some();
        if only_certificate {
            terms.replaced = old.replaced.clone();
        }
        self.terms.store(Arc::new(terms));
        if !only_certificate {
            old.replaced.cancel();
        }
    }

    /// Waits until the server has stopped: at most half a second after the token was cancelled.
    pub async fn stopped(self) {
        self.tasks.wait().await;
    }
}

/// What the connections are served by; a reload can replace it.
#[derive(Debug)]
struct Terms {
    access: Arc<Access>,
    tls: Option<Tls>,
    /// Cancelled when others have taken their place.
    replaced: CancellationToken,
}

#[derive(Clone)]
struct Tls(TlsAcceptor);

impl std::fmt::Debug for Tls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Tls")
    }
}

impl Terms {
    fn new(options: &Options) -> Result<Terms, ServerError> {
        let tls = options.identity.as_ref().map(|identity| {
            let mut config = identity.server_config(None)?;
            config.alpn_protocols = vec![b"http/1.1".to_vec()];
            Ok(Tls(TlsAcceptor::from(Arc::new(config))))
        });
        let name = rustix::system::uname();
        Ok(Terms {
            access: Arc::new(Access {
                hosts: Hosts::new(&name.nodename().to_string_lossy(), &options.hosts),
                tokens: options.tokens.clone(),
            }),
            tls: tls.transpose().map_err(|fault| ServerError::Tls("HTTP", fault))?,
            replaced: CancellationToken::new(),
        })
    }
}

/// Starts the server. It runs until `cancel`.
///
/// # Errors
/// The address cannot be bound, or the certificates cannot be used.
pub async fn start(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) -> Result<Http, ServerError> {
    let tasks = TaskTracker::new();
    let mut address = options.listen;
    let terms = Arc::new(ArcSwap::from_pointee(Terms::new(&options)?));
    for (socket, bound) in bind(&[options.listen], "HTTP", "[http]").await? {
        address = bound;
        let tls = options.identity.is_some();
        tracing::info!(target: "drivegate::http", %address, tls, "HTTP: listening");
        let accept = AcceptLoop {
            protocol: "HTTP",
            handler: Arc::new(HttpConnections {
                router: routes::router(plant.clone(), stats.clone(), cancel.clone()),
                terms: terms.clone(),
                cancel: cancel.clone(),
                log: LogThrottle::default(),
                refusals: Arc::default(),
            }),
            limit: ConnectionLimit::new(MAX_CONNECTIONS, None),
            tasks: tasks.clone(),
            cancel: cancel.clone(),
        };
        tasks.spawn(accept.run(socket));
    }
    tasks.close();
    Ok(Http { address, terms, tasks })
}

/// Serves the connections of the HTTP server.
struct HttpConnections {
    router: Router,
    terms: Arc<ArcSwap<Terms>>,
    cancel: CancellationToken,
    log: LogThrottle,
    refusals: Arc<LogThrottle>,
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

    async fn serve(self: Arc<Self>, stream: TcpStream, peer: SocketAddr, permit: ConnectionPermit) {
        set_socket_options(&stream);
        let terms = self.terms.load_full();
        let local = stream.local_addr();
        match (&terms.tls, local) {
            (None, Ok(local)) => self.serve_requests(stream, peer, local.ip(), &terms).await,
            (Some(Tls(acceptor)), Ok(local)) => {
                let handshake = timeout(HANDSHAKE, acceptor.accept(stream));
                match self.cancel.run_until_cancelled(handshake).await {
                    Some(Ok(Ok(stream))) => self.serve_requests(stream, peer, local.ip(), &terms).await,
                    Some(Ok(Err(error))) => {
                        tracing::debug!(target: "drivegate::http", %peer, "HTTP: TLS handshake failed: {error}");
                    }
                    Some(Err(_)) | None => {}
                }
            }
            // The client is gone.
            (_, Err(_)) => {}
        }
        drop(permit);
    }
}

impl HttpConnections {
    /// Answers the requests of a client that connected to the address `local` of this machine. After the cancellation,
    /// or when the terms are replaced, the connection has [`GRACE`] to finish its reply.
    async fn serve_requests(
        &self,
        stream: impl AsyncRead + AsyncWrite + Unpin,
        peer: SocketAddr,
        local: IpAddr,
        terms: &Terms,
    ) {
        let reached = Reached {
            address: local,
            peer,
            refusals: self.refusals.clone(),
            access: terms.access.clone(),
        };
        let router = TowerToHyperService::new(self.router.clone());
        let service = service_fn(move |mut request: hyper::Request<Incoming>| {
            request.extensions_mut().insert(reached.clone());
            router.call(request)
        });
        let mut connection = pin!(
            http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(HEAD_TIMEOUT)
                .max_buf_size(MAX_HEAD)
                .serve_connection(TokioIo::new(stream), service)
        );
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = ended(&self.cancel, &terms.replaced) => {
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

async fn ended(server: &CancellationToken, terms: &CancellationToken) {
    tokio::select! {
        () = server.cancelled() => {}
        () = terms.cancelled() => {}
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
