//! Accepts the connections to one socket despite any errors that the system reports, and binds it again when it is lost.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use rustix::io::Errno;
use rustix::net::{Shutdown, shutdown};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::ConnectionHandler;
use super::state::ListenerState;
use crate::ServerKind;
use crate::log_throttle::LogThrottle;
use crate::reading::{Dated, Reader, is_readable};

/// Pause after an accept error of the machine: the usual one, too many open files, does not disappear at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// First and longest pause before a lost socket is bound again.
const REBIND: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));

/// Frees the address of a socket that is about to be closed, also while a copy of the socket is open: a process that
/// was forked has one until it executes its program.
pub(super) fn stop_listening(socket: &impl AsFd) {
    // The shutdown fails for a lost socket, which no longer listens anyway.
    let _ = shutdown(socket, Shutdown::Both);
}

/// Accepts the connections to one socket.
pub(super) struct AcceptLoop<H> {
    pub(super) server: ServerKind,
    pub(super) address: SocketAddr,
    pub(super) handler: Arc<H>,
    pub(super) state: ListenerState,
    /// The tracker in which the tasks of the connections run.
    pub(super) tasks: TaskTracker,
    pub(super) stop: CancellationToken,
}

impl<H: ConnectionHandler> AcceptLoop<H> {
    /// Accepts until stopped, whatever errors the system reports. A socket that is lost, or missing at first, is bound
    /// again with back-off; meanwhile the gateway is not ready.
    pub(super) async fn run<A: Accept>(self, mut socket: Option<A>, bind: impl Fn() -> io::Result<A> + Send) {
        let accept = async {
            loop {
                let open = match socket.take() {
                    Some(socket) => socket,
                    None => self.rebind(&bind).await,
                };
                let why = self.accept(open).await;
                let (server, address) = (self.server, self.address);
                tracing::error!(target: "drivegate::north::listener", %address, "{}: the listener is lost: {why}; binding it again", server.title());
                self.state.set(Some(why.to_string()));
            }
        };
        self.stop.run_until_cancelled(accept).await;
    }

    async fn rebind<A>(&self, bind: &impl Fn() -> io::Result<A>) -> A {
        let (server, address) = (self.server, self.address);
        let (mut pause, longest) = REBIND;
        loop {
            match bind() {
                Ok(socket) => {
                    tracing::info!(target: "drivegate::north::listener", %address, "{}: listening now", server.title());
                    self.state.set(None);
                    return socket;
                }
                Err(why) => self.state.set(Some(why.to_string())),
            }
            tokio::time::sleep(pause).await;
            pause = (2 * pause).min(longest);
        }
    }

    /// Accepts until the socket is lost; why.
    async fn accept(&self, mut socket: impl Accept) -> io::Error {
        let log = LogThrottle::default();
        // A client may have connected and sent bytes while this runtime was stalled.
        let reader = Reader::here();
        loop {
            let at_once = socket.accept().now_or_never();
            let accepted = match at_once {
                Some(accepted) => accepted,
                None => {
                    reader.nothing(Instant::now(), || socket.has_client());
                    socket.accept().await
                }
            };
            match accepted {
                Ok((stream, peer)) => {
                    reader.note_read(Instant::now(), false, || false);
                    self.admit(Dated::new(stream, Arc::new(reader.accepted())), peer);
                    // Connections that yielded to this one are closed before the next one is accepted.
                    tokio::task::yield_now().await;
                }
                Err(error) if concerns_one_client(&error) => {}
                Err(error) if is_lost(&error) => return error,
                Err(error) => {
                    if let Some(suppressed) = log.permit(Instant::now()) {
                        let server = self.server.title();
                        tracing::warn!(target: "drivegate::north::listener", suppressed, "{server}: cannot accept a connection: {error}; retrying");
                    }
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn admit(&self, stream: Dated<TcpStream>, peer: SocketAddr) {
        // A listener on [::] receives IPv4 clients as ::ffff:a.b.c.d.
        let peer = SocketAddr::new(peer.ip().to_canonical(), peer.port());
        if let Some(permit) = self.handler.admit(peer.ip()) {
            self.tasks.spawn(self.handler.clone().serve(stream, peer, permit));
        }
    }
}

/// A socket that can accept connections.
pub(super) trait Accept: Send {
    /// Accepts the next connection; cancel safe.
    fn accept(&mut self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send;

    /// Whether a client waits to be accepted.
    fn has_client(&self) -> bool;
}

/// A socket that listens until this value is dropped.
pub(super) struct ListeningSocket(TcpListener);

impl ListeningSocket {
    pub(super) fn new(socket: std::net::TcpListener) -> io::Result<ListeningSocket> {
        TcpListener::from_std(socket).map(ListeningSocket)
    }
}

impl Drop for ListeningSocket {
    fn drop(&mut self) {
        stop_listening(&self.0);
    }
}

impl Accept for ListeningSocket {
    fn accept(&mut self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send {
        self.0.accept()
    }

    fn has_client(&self) -> bool {
        is_readable(&self.0)
    }
}

/// Whether the error concerns only a connection that ended before it was accepted (accept(2)).
fn concerns_one_client(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset | io::ErrorKind::Interrupted
    )
}

/// Errors of a socket that does not listen any more (accept(2)).
fn is_lost(error: &io::Error) -> bool {
    let lost = [Errno::INVAL, Errno::BADF, Errno::NOTSOCK, Errno::OPNOTSUPP];
    error
        .raw_os_error()
        .is_some_and(|code| lost.iter().any(|lost| lost.raw_os_error() == code))
}
