//! The listeners of a TCP server: binds the sockets, accepts connections and starts a task for each. At a reload new
//! sockets are bound before old ones are closed, and a listener that stays keeps its socket and its connections.

use std::future::Future;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::net::{Shutdown, shutdown};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Handle;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::log_throttle::LogThrottle;
use super::{NorthStats, ServerError, ServerKind};

/// Pause after an accept error of the machine: the usual one, too many open files, does not go away at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// First and longest pause before a lost socket is bound again.
const REBIND: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(5));

/// What a server does with the connections to one of its listeners.
pub(super) trait ConnectionHandler: Send + Sync + 'static {
    /// The place of a connection; it is given back when this is dropped.
    type Permit: Send;

    /// A place for a connection of this client. `None` refuses it; the handler counts and logs that.
    fn admit(&self, client: IpAddr) -> Option<Self::Permit>;

    /// Serves a connection until it ends.
    fn serve(
        self: Arc<Self>,
        stream: TcpStream,
        peer: SocketAddr,
        permit: Self::Permit,
    ) -> impl Future<Output = ()> + Send;
}

/// A listener as configured.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ListenerSpec {
    pub(super) address: SocketAddr,
    pub(super) tls: bool,
    /// Section of the configuration, in brackets.
    pub(super) section: String,
}

impl ListenerSpec {
    /// Whether the socket of a listener can serve `other` too.
    fn shares_socket(&self, other: &ListenerSpec) -> bool {
        (self.address, self.tls) == (other.address, other.tls)
    }

    /// Whether both addresses cannot be bound at one time.
    fn overlaps(&self, address: SocketAddr) -> bool {
        let (own, other) = (self.address.ip(), address.ip());
        self.address.port() == address.port() && (own == other || own.is_unspecified() || other.is_unspecified())
    }
}

/// The listeners of one server.
#[derive(Debug)]
pub(super) struct Listeners<H> {
    server: ServerKind,
    stats: Arc<NorthStats>,
    /// Where listeners and connections run.
    tasks: TaskTracker,
    cancel: CancellationToken,
    open: Vec<OpenListener<H>>,
}

#[derive(Debug)]
struct OpenListener<H> {
    spec: ListenerSpec,
    /// With the port that the system chose if port 0 was configured.
    bound: SocketAddr,
    handler: Arc<H>,
    runtime: Handle,
    /// Ends its connections.
    cancel: CancellationToken,
    /// Closes its socket.
    stop: CancellationToken,
    stopped: Option<JoinHandle<()>>,
}

/// Sockets for a new configuration, bound but not accepting yet.
#[derive(Debug, Default)]
pub(super) struct NewSockets {
    /// In the order of the configuration; without a socket: that of the open listener.
    wanted: Vec<(ListenerSpec, Option<std::net::TcpListener>)>,
    /// Indices of open listeners whose sockets were closed because a new one overlaps them.
    released: Vec<usize>,
}

impl<H: ConnectionHandler> Listeners<H> {
    /// None yet; they run until `cancel`.
    pub(super) fn new(
        server: ServerKind,
        stats: Arc<NorthStats>,
        tasks: TaskTracker,
        cancel: CancellationToken,
    ) -> Listeners<H> {
        Listeners {
            server,
            stats,
            tasks,
            cancel,
            open: Vec::new(),
        }
    }

    /// The bound addresses, with or without TLS, in the order of the configuration.
    pub(super) fn addresses(&self, tls: bool) -> Vec<SocketAddr> {
        let of_kind = self.open.iter().filter(|listener| listener.spec.tls == tls);
        of_kind.map(|listener| listener.bound).collect()
    }

    /// Binds the sockets that are missing. What is open goes on, with one exception: a socket that is no longer wanted is
    /// closed early if a new one overlaps it, because the system does not allow both at one time.
    ///
    /// # Errors
    /// The first address that cannot be bound; everything is open as before.
    pub(super) async fn prepare(&mut self, wanted: Vec<ListenerSpec>) -> Result<NewSockets, ServerError> {
        let mut kept = vec![false; self.open.len()];
        let mut missing = Vec::new();
        let mut new = NewSockets::default();
        for (place, spec) in wanted.into_iter().enumerate() {
            let mut running = self.open.iter().zip(&mut kept);
            match running.find(|(open, kept)| !**kept && open.spec.shares_socket(&spec)) {
                Some((_, kept)) => *kept = true,
                None => missing.push(place),
            }
            new.wanted.push((spec, None));
        }
        for place in missing {
            let Some(spec) = new.wanted.get(place).map(|(spec, _)| spec.clone()) else {
                continue;
            };
            let mut socket = bind(spec.address);
            if matches!(&socket, Err(error) if error.kind() == io::ErrorKind::AddrInUse)
                && self.release(spec.address, &kept, &mut new.released).await
            {
                socket = bind(spec.address);
            }
            match (socket, new.wanted.get_mut(place)) {
                (Ok(socket), Some((_, free))) => *free = Some(socket),
                (Ok(_), None) => {}
                (Err(cause), _) => {
                    self.abort(new);
                    return Err(ServerError::Listen {
                        protocol: self.server.title(),
                        address: spec.address,
                        section: spec.section,
                        cause,
                    });
                }
            }
        }
        Ok(new)
    }

    /// Closes the sockets that are not `kept` and overlap `address`; false if there are none.
    async fn release(&mut self, address: SocketAddr, kept: &[bool], released: &mut Vec<usize>) -> bool {
        let mut any = false;
        for (index, (listener, kept)) in self.open.iter_mut().zip(kept).enumerate() {
            if !kept && listener.spec.overlaps(address) && !released.contains(&index) {
                listener.stop.cancel();
                if let Some(stopped) = listener.stopped.take() {
                    // A task that panicked has closed its socket too.
                    let _ = stopped.await;
                }
                released.push(index);
                any = true;
            }
        }
        any
    }

    /// Closes the new sockets. A listener whose socket was closed for them binds it again, now or as soon as it can.
    pub(super) fn abort(&mut self, new: NewSockets) {
        for socket in new.wanted.iter().filter_map(|(_, socket)| socket.as_ref()) {
            stop_listening(socket);
        }
        drop(new.wanted);
        for index in new.released {
            let Some(mut listener) = (index < self.open.len()).then(|| self.open.remove(index)) else {
                continue;
            };
            listener.stop = self.cancel.child_token();
            let socket = bind(listener.bound).ok();
            self.accept(&mut listener, socket);
            self.open.insert(index, listener);
        }
    }

    /// Lets the new sockets accept and closes those that are no longer wanted, with their connections. `handler` gives
    /// the handler of a listener and the runtime it runs on: that of the open listener, adapted to the new
    /// configuration, or a new one whose connections end with the token.
    pub(super) fn commit(
        &mut self,
        new: NewSockets,
        mut handler: impl FnMut(&ListenerSpec, Option<&Arc<H>>, &CancellationToken) -> (Arc<H>, Handle),
    ) {
        let mut before = std::mem::take(&mut self.open);
        for (spec, socket) in new.wanted {
            let Some(socket) = socket else {
                if let Some(index) = before.iter().position(|open| open.spec.shares_socket(&spec)) {
                    let mut listener = before.remove(index);
                    (listener.handler, _) = handler(&spec, Some(&listener.handler), &listener.cancel);
                    listener.spec = spec;
                    self.open.push(listener);
                }
                continue;
            };
            let cancel = self.cancel.child_token();
            let (handler, runtime) = handler(&spec, None, &cancel);
            let bound = socket.local_addr().unwrap_or(spec.address);
            let mut listener = OpenListener {
                spec,
                bound,
                handler,
                runtime,
                cancel,
                stop: self.cancel.child_token(),
                stopped: None,
            };
            tracing::info!(address = %bound, tls = listener.spec.tls, "{}: listening", self.server.title());
            self.accept(&mut listener, Some(socket));
            self.open.push(listener);
        }
        for listener in before {
            tracing::info!(address = %listener.bound, "{}: no longer listening", self.server.title());
            listener.stop.cancel();
            listener.cancel.cancel();
        }
    }

    /// Closes all listeners; what their connections have begun is answered as if a reload closed each of them.
    pub(super) async fn close(&mut self) {
        for mut listener in std::mem::take(&mut self.open) {
            tracing::info!(address = %listener.bound, "{}: no longer listening", self.server.title());
            listener.stop.cancel();
            listener.cancel.cancel();
            if let Some(stopped) = listener.stopped.take() {
                // A task that panicked has closed its socket too.
                let _ = stopped.await;
            }
        }
    }

    /// Starts the accept loop of a listener; without a socket, it binds one as soon as it can.
    fn accept(&self, listener: &mut OpenListener<H>, socket: Option<std::net::TcpListener>) {
        let accept = AcceptLoop {
            server: self.server,
            address: listener.bound,
            handler: listener.handler.clone(),
            stats: self.stats.clone(),
            tasks: self.tasks.clone(),
            stop: listener.stop.clone(),
        };
        let run = async move {
            // A socket belongs to the runtime that this runs on.
            let first = socket.and_then(|socket| ListeningSocket::new(socket).ok());
            let address = accept.address;
            accept.run(first, move || ListeningSocket::new(bind(address)?)).await;
        };
        listener.stopped = Some(self.tasks.spawn_on(run, &listener.runtime));
    }
}

/// A socket that listens; not bound to a runtime yet.
fn bind(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = std::net::TcpListener::bind(address)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

/// Frees the address of a socket that is about to be closed, also while a copy of the socket is open: a process that
/// was forked has one until it executes its program.
fn stop_listening(socket: &impl AsFd) {
    // It fails for a socket that is lost, which listens no longer.
    let _ = shutdown(socket, Shutdown::Both);
}

/// Accepts the connections to one socket.
struct AcceptLoop<H> {
    server: ServerKind,
    address: SocketAddr,
    handler: Arc<H>,
    stats: Arc<NorthStats>,
    /// Where the connections run.
    tasks: TaskTracker,
    stop: CancellationToken,
}

impl<H: ConnectionHandler> AcceptLoop<H> {
    /// Accepts until stopped, whatever errors the system reports. A socket that is lost, or missing at first, is bound
    /// again with back-off; meanwhile the gateway is not ready.
    async fn run<A: Accept>(self, mut socket: Option<A>, bind: impl Fn() -> io::Result<A> + Send) {
        let accept = async {
            loop {
                let open = match socket.take() {
                    Some(socket) => socket,
                    None => self.rebind(&bind).await,
                };
                let why = self.accept(open).await;
                let (server, address) = (self.server, self.address);
                tracing::error!(%address, "{}: the listener is lost: {why}; binding it again", server.title());
                self.stats.lost_listeners.set(server, address, Some(why.to_string()));
            }
        };
        self.stop.run_until_cancelled(accept).await;
        self.stats.lost_listeners.set(self.server, self.address, None);
    }

    async fn rebind<A>(&self, bind: &impl Fn() -> io::Result<A>) -> A {
        let (server, address) = (self.server, self.address);
        let (mut pause, longest) = REBIND;
        loop {
            match bind() {
                Ok(socket) => {
                    tracing::info!(%address, "{}: listening again", server.title());
                    self.stats.lost_listeners.set(server, address, None);
                    return socket;
                }
                Err(why) => self.stats.lost_listeners.set(server, address, Some(why.to_string())),
            }
            tokio::time::sleep(pause).await;
            pause = (2 * pause).min(longest);
        }
    }

    /// Accepts until the socket is lost; why.
    async fn accept(&self, mut socket: impl Accept) -> io::Error {
        let log = LogThrottle::default();
        loop {
            match socket.accept().await {
                Ok((stream, peer)) => {
                    self.admit(stream, peer);
                    // Connections that yielded to this one close before the next comes.
                    tokio::task::yield_now().await;
                }
                Err(error) if concerns_one_client(&error) => {}
                Err(error) if is_lost(&error) => return error,
                Err(error) => {
                    if let Some(suppressed) = log.permit(Instant::now()) {
                        let server = self.server.title();
                        tracing::warn!(suppressed, "{server}: cannot accept a connection: {error}; retrying");
                    }
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn admit(&self, stream: TcpStream, peer: SocketAddr) {
        // A listener on [::] sees IPv4 clients as ::ffff:a.b.c.d.
        let peer = SocketAddr::new(peer.ip().to_canonical(), peer.port());
        if let Some(permit) = self.handler.admit(peer.ip()) {
            self.tasks.spawn(self.handler.clone().serve(stream, peer, permit));
        }
    }
}

/// A socket that accepts connections.
trait Accept: Send {
    /// The next connection; cancel safe.
    fn accept(&mut self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send;
}

/// Listens until it is dropped.
struct ListeningSocket(TcpListener);

impl ListeningSocket {
    fn new(socket: std::net::TcpListener) -> io::Result<ListeningSocket> {
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
}

/// Errors of a connection that ended before it was accepted (accept(2)).
fn concerns_one_client(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset | io::ErrorKind::Interrupted
    )
}

/// Errors of a socket that does not listen any more (accept(2)).
fn is_lost(error: &io::Error) -> bool {
    use rustix::io::Errno;
    let lost = [Errno::INVAL, Errno::BADF, Errno::NOTSOCK, Errno::OPNOTSUPP];
    error
        .raw_os_error()
        .is_some_and(|code| lost.iter().any(|lost| lost.raw_os_error() == code))
}

#[cfg(test)]
mod tests;
