//! The accept loop of every TCP server of the gateway: binds the sockets, accepts connections, applies the connection
//! limit and starts a task for each connection.

use std::future::Future;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::ServerError;
use super::connection_limit::{ConnectionLimit, ConnectionPermit, LimitReached};
use super::log_throttle::LogThrottle;

/// Pause after an accept error of the machine: the usual one, too many open files, does not go away at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// What a server does with the connections to one of its listeners. Refusals are counted and logged here.
pub(super) trait ConnectionHandler: Send + Sync + 'static {
    /// Whether clients at this address may connect.
    fn admits(&self, address: IpAddr) -> bool;

    /// Refuses a connection because a limit is reached; must not block.
    fn refuse(&self, stream: &TcpStream, peer: SocketAddr, reached: LimitReached);

    /// Serves a connection until it ends. The connection counts against the limit until `permit` is dropped.
    fn serve(
        self: Arc<Self>,
        stream: TcpStream,
        peer: SocketAddr,
        permit: ConnectionPermit,
    ) -> impl Future<Output = ()> + Send;
}

/// Accepts the connections to one socket.
pub(super) struct AcceptLoop<H> {
    /// For log messages: `Modbus TCP`.
    pub(super) protocol: &'static str,
    pub(super) handler: Arc<H>,
    pub(super) limit: Arc<ConnectionLimit>,
    /// Where the connections run.
    pub(super) tasks: TaskTracker,
    pub(super) cancel: CancellationToken,
}

impl<H: ConnectionHandler> AcceptLoop<H> {
    /// Accepts until cancelled, whatever errors the system reports.
    pub(super) async fn run(self, mut socket: impl Accept) {
        let log = LogThrottle::default();
        while let Some(accepted) = self.cancel.run_until_cancelled(socket.accept()).await {
            match accepted {
                Ok((stream, peer)) => self.admit(stream, peer),
                Err(error) if concerns_one_client(&error) => {}
                Err(error) => {
                    if let Some(suppressed) = log.permit(Instant::now()) {
                        let protocol = self.protocol;
                        tracing::warn!(suppressed, "{protocol}: cannot accept a connection: {error}; retrying");
                    }
                    self.cancel.run_until_cancelled(tokio::time::sleep(ACCEPT_PAUSE)).await;
                }
            }
        }
    }

    fn admit(&self, stream: TcpStream, peer: SocketAddr) {
        // A listener on [::] sees IPv4 clients as ::ffff:a.b.c.d.
        let peer = SocketAddr::new(peer.ip().to_canonical(), peer.port());
        if !self.handler.admits(peer.ip()) {
            return;
        }
        match self.limit.acquire(peer.ip()) {
            Ok(permit) => {
                self.tasks.spawn(self.handler.clone().serve(stream, peer, permit));
            }
            Err(reached) => self.handler.refuse(&stream, peer, reached),
        }
    }
}

/// A socket that accepts connections.
pub(super) trait Accept: Send {
    /// The next connection; cancel safe.
    fn accept(&mut self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send;
}

impl Accept for TcpListener {
    fn accept(&mut self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send {
        TcpListener::accept(self)
    }
}

/// Errors of a connection that ended before it was accepted (accept(2)).
fn concerns_one_client(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset | io::ErrorKind::Interrupted
    )
}

/// Binds all `addresses` of a `section` of the configuration, or none; each with the address that it really has, where
/// port 0 was configured.
///
/// # Errors
/// The first address that cannot be bound.
pub(super) async fn bind(
    addresses: &[SocketAddr],
    protocol: &'static str,
    section: &str,
) -> Result<Vec<(TcpListener, SocketAddr)>, ServerError> {
    let mut sockets = Vec::with_capacity(addresses.len());
    for address in addresses {
        let failed = |cause| ServerError::Listen {
            protocol,
            address: *address,
            section: section.to_string(),
            cause,
        };
        let socket = TcpListener::bind(address).await.map_err(failed)?;
        let bound = socket.local_addr().map_err(failed)?;
        sockets.push((socket, bound));
    }
    Ok(sockets)
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncReadExt;
    use tokio::sync::mpsc;

    use super::*;

    /// Fails a number of times, then accepts.
    struct Failing(Vec<io::ErrorKind>, TcpListener);

    impl Accept for Failing {
        async fn accept(&mut self) -> io::Result<(TcpStream, SocketAddr)> {
            match self.0.pop() {
                Some(kind) => Err(kind.into()),
                None => self.1.accept().await,
            }
        }
    }

    struct Recorder(mpsc::UnboundedSender<&'static str>);

    impl ConnectionHandler for Recorder {
        fn admits(&self, address: IpAddr) -> bool {
            address.is_loopback()
        }

        fn refuse(&self, _: &TcpStream, _: SocketAddr, reached: LimitReached) {
            assert_eq!(reached, LimitReached::Total(1));
            self.0.send("refused").unwrap();
        }

        async fn serve(self: Arc<Self>, mut stream: TcpStream, _: SocketAddr, permit: ConnectionPermit) {
            self.0.send("served").unwrap();
            // Until the client closes.
            let _ = stream.read(&mut [0]).await;
            drop(permit);
            self.0.send("ended").unwrap();
        }
    }

    #[tokio::test(start_paused = true)]
    async fn accept_errors_do_not_end_a_server() {
        let socket = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = socket.local_addr().unwrap();
        let (sender, mut events) = mpsc::unbounded_channel();
        let cancel = CancellationToken::new();
        let accept = AcceptLoop {
            protocol: "test",
            handler: Arc::new(Recorder(sender)),
            limit: ConnectionLimit::new(1, None),
            tasks: TaskTracker::new(),
            cancel: cancel.clone(),
        };
        let errors = vec![
            io::ErrorKind::Other,
            io::ErrorKind::ConnectionAborted,
            io::ErrorKind::OutOfMemory,
        ];
        let server = tokio::spawn(accept.run(Failing(errors, socket)));
        let first = TcpStream::connect(address).await.unwrap();
        assert_eq!(events.recv().await, Some("served"));
        let _second = TcpStream::connect(address).await.unwrap();
        assert_eq!(events.recv().await, Some("refused"));
        drop(first);
        assert_eq!(events.recv().await, Some("ended"));
        let _third = TcpStream::connect(address).await.unwrap();
        assert_eq!(events.recv().await, Some("served"), "the permit is free again");
        cancel.cancel();
        server.await.unwrap();
    }
}
