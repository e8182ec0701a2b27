//! The HTTP API on the local socket. Every user who may open the socket may do everything: no login, no token, any `Host`.

use std::net::{IpAddr, Ipv4Addr};
use std::pin::pin;
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::http::Method;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite, DuplexStream, duplex};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::in_use::InUse;
use super::limits::{ANSWERED_WITHIN, GRACE, HEAD_TIMEOUT, MAX_HEAD};
use super::operating::Operating;
use super::reached::{Client, Coverage, LocalUser, Reached};
use super::routes;
use drivegate_core::order::{Authority, Proof, Right, SourceKind};
use drivegate_core::plant::SharedPlant;
use drivegate_north::NorthState;
use drivegate_north::connection_limit::{ConnectionLimit, ConnectionPlace, Limits, Newcomer};
use drivegate_north::reading::{Dated, Reader};

/// Serves the connections of the local socket that use HTTP.
#[derive(Debug, Clone)]
pub(crate) struct SocketDoor {
    router: Router,
}

impl SocketDoor {
    pub(crate) fn new(plant: &SharedPlant, stats: &Arc<NorthState>, cancel: CancellationToken) -> SocketDoor {
        let operating = Arc::new(Operating::new(stats));
        SocketDoor {
            router: routes::router(plant.clone(), stats.clone(), operating, cancel),
        }
    }

    /// Answers the requests of a client until it disconnects, is idle too long or yields to another client; a reply
    /// in progress is completed.
    pub(crate) async fn serve(
        &self,
        (stream, reader): (impl AsyncRead + AsyncWrite + Unpin, Arc<Reader>),
        user: LocalUser,
        place: &Arc<ConnectionPlace>,
    ) {
        let reached = Reached::within(Some(user), Some(place.clone()));
        let client = Client {
            address: reached.address,
            coverage: Coverage::Everything,
        };
        // Each token stands for a command whose reply is pending.
        let commands = TaskTracker::new();
        let router = TowerToHyperService::new(self.router.clone());
        let service = service_fn(|mut request: hyper::Request<Incoming>| {
            let in_use = InUse::new(place.clone());
            request.extensions_mut().insert(client);
            request.extensions_mut().insert(reached.clone());
            request.extensions_mut().insert(reader.last());
            request.extensions_mut().insert(reader.clone());
            let command = matches!(*request.method(), Method::POST | Method::DELETE).then(|| commands.token());
            let reply = router.call(request);
            async move {
                let reply = reply.await;
                drop(command);
                reply.map(|reply| reply.map(|body| in_use.until_end_of(body)))
            }
        });
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_TIMEOUT)
            .max_buf_size(MAX_HEAD)
            .serve_connection(TokioIo::new(stream), service);
        let mut connection = pin!(connection);
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = place.closing().cancelled() => {
                connection.as_mut().graceful_shutdown();
                commands.close();
                let last = async {
                    // This runs for each cause that ends the wait.
                    let _ = timeout(ANSWERED_WITHIN, commands.wait()).await;
                    tokio::time::sleep(GRACE).await;
                };
                tokio::select! {
                    ended = connection.as_mut() => ended,
                    () = last => Ok(()),
                }
            }
        };
        if let Err(error) = ended {
            tracing::debug!(target: "drivegate::http", "HTTP connection of the local socket ended: {error}");
        }
    }
}

/// Access to the HTTP API for a command in the same process, which serves the buses itself without a socket.
#[derive(Debug)]
pub struct InProcess {
    door: SocketDoor,
    user: LocalUser,
    limit: Arc<ConnectionLimit>,
    cancel: CancellationToken,
}

/// Maximum number of connections of a command, and the buffer size of each.
const CONNECTIONS: usize = 4;
const BUFFER: usize = 64 * 1024;

impl InProcess {
    /// An in-process server for a command started by `who`.
    pub fn new(plant: &SharedPlant, stats: &Arc<NorthState>, who: &str) -> InProcess {
        let cancel = CancellationToken::new();
        let user = LocalUser {
            kind: SourceKind::CommandLine,
            who: who.into(),
            // A user who may open the port has the same identity here as one who opens the socket.
            proof: Proof::Uid(rustix::process::geteuid().as_raw()),
            right: Right::lasting(),
            control: None,
        };
        InProcess {
            door: SocketDoor::new(plant, stats, cancel.clone()),
            user,
            limit: ConnectionLimit::new(Limits::new(CONNECTIONS, CONNECTIONS)),
            cancel,
        }
    }

    /// A new connection; `None` if there are too many.
    pub fn connect(&self) -> Option<DuplexStream> {
        let newcomer = Newcomer {
            address: IpAddr::V4(Ipv4Addr::LOCALHOST),
            listener: 0,
            cancel: &self.cancel,
        };
        let acquired = self.limit.acquire(newcomer, Instant::now(), || Some(Authority::Write));
        let (permit, _) = acquired.ok()?;
        let (client, server) = duplex(BUFFER);
        let (door, user) = (self.door.clone(), self.user.clone());
        tokio::spawn(async move {
            let reader = Arc::new(Reader::here());
            let stream = Dated::new(server, reader.clone());
            door.serve((stream, reader), user, permit.place()).await;
        });
        Some(client)
    }
}

impl Drop for InProcess {
    fn drop(&mut self) {
        self.cancel.cancel();
    }
}
