//! The listeners of a TCP server: bind the sockets, accept connections and start a task for each. A reload binds
//! new sockets before old ones are closed, and an unchanged listener keeps its socket and its connections. A server
//! that is starting continues without an address that the machine does not have yet, and listens on it as soon as
//! the address exists.

mod accept;
mod state;

use std::future::Future;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use rustix::io::Errno;
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::{NorthState, ServerError, ServerKind};
use crate::reading::Dated;

use self::accept::{AcceptLoop, ListeningSocket, stop_listening};
pub(crate) use self::state::ListenerState;
pub use self::state::ListenerStates;

/// Handles the connections to one of a server's listeners.
pub trait ConnectionHandler: Send + Sync + 'static {
    /// The place of a connection; dropping it frees the place.
    type Permit: Send;

    /// A place for a connection of this client. `None` refuses the connection; the handler counts and logs that.
    fn admit(&self, client: IpAddr) -> Option<Self::Permit>;

    /// Ends the rights of the clients when the listener is removed from the configuration, unless they have them by
    /// another way.
    fn retire(&self) {}

    /// Serves a connection until it ends.
    fn serve(
        self: Arc<Self>,
        stream: Dated<TcpStream>,
        peer: SocketAddr,
        permit: Self::Permit,
    ) -> impl Future<Output = ()> + Send;
}

/// A listener as configured.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListenerSpec {
    pub address: SocketAddr,
    pub tls: bool,
    /// Section of the configuration, in brackets.
    pub section: String,
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
pub struct Listeners<H> {
    server: ServerKind,
    stats: Arc<NorthState>,
    /// Tracker of the tasks for listeners and connections.
    tasks: TaskTracker,
    cancel: CancellationToken,
    open: Vec<OpenListener<H>>,
}

#[derive(Debug)]
struct OpenListener<H> {
    spec: ListenerSpec,
    /// The bound address; if port 0 was configured, with the port that the system chose.
    bound: SocketAddr,
    handler: Arc<H>,
    runtime: Handle,
    /// Cancelling this ends the connections of the listener.
    cancel: CancellationToken,
    /// Cancelling this closes the socket of the listener.
    stop: CancellationToken,
    stopped: Option<JoinHandle<()>>,
}

/// The source of the socket for a listener of a new configuration.
#[derive(Debug)]
enum Socket {
    /// The socket of the open listener is kept.
    Open,
    New(std::net::TcpListener),
    /// The listener has no socket yet: the machine does not have the address.
    Missing(io::Error),
}

impl Socket {
    fn bound(&self) -> Option<&std::net::TcpListener> {
        match self {
            Socket::New(socket) => Some(socket),
            Socket::Open | Socket::Missing(_) => None,
        }
    }
}

/// Sockets for a new configuration, bound but not accepting yet.
#[derive(Debug, Default)]
pub struct NewSockets {
    /// The listeners in the order of the configuration.
    wanted: Vec<(ListenerSpec, Socket)>,
    /// Indices of open listeners whose sockets were closed because a new one overlaps them.
    released: Vec<usize>,
}

impl<H: ConnectionHandler> Listeners<H> {
    /// A server without listeners yet; listeners added later run until `cancel`.
    pub(super) fn new(
        server: ServerKind,
        stats: Arc<NorthState>,
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

    /// Binds the missing sockets. Open ones are kept, with one exception: a socket that is no longer configured is
    /// closed early if a new one overlaps it, because the system does not allow both at the same time.
    ///
    /// A starting server accepts an address that the machine does not have yet: the address appears with its
    /// interface, and all other clients are served meanwhile. In a reload such an address is an error, because it
    /// would replace one that works.
    ///
    /// # Errors
    /// If an address cannot be bound: contains the first such address. All listeners stay as before.
    pub(super) async fn prepare(&mut self, wanted: Vec<ListenerSpec>) -> Result<NewSockets, ServerError> {
        let mut kept = vec![false; self.open.len()];
        let mut missing = Vec::new();
        let starts = self.open.is_empty();
        let mut new = NewSockets::default();
        for (place, spec) in wanted.into_iter().enumerate() {
            let mut running = self.open.iter().zip(&mut kept);
            match running.find(|(open, kept)| !**kept && open.spec.shares_socket(&spec)) {
                Some((_, kept)) => *kept = true,
                None => missing.push(place),
            }
            new.wanted.push((spec, Socket::Open));
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
            let socket = match socket {
                Ok(socket) => Socket::New(socket),
                Err(cause) if starts && may_come(&cause) => Socket::Missing(cause),
                Err(cause) => {
                    self.abort(new);
                    return Err(ServerError::Listen {
                        protocol: self.server.title(),
                        address: spec.address,
                        section: spec.section,
                        cause,
                    });
                }
            };
            if let Some((_, place)) = new.wanted.get_mut(place) {
                *place = socket;
            }
        }
        Ok(new)
    }

    /// Closes the sockets that are not `kept` and overlap `address`; returns false if no socket does.
    async fn release(&mut self, address: SocketAddr, kept: &[bool], released: &mut Vec<usize>) -> bool {
        let mut any = false;
        for (index, (listener, kept)) in self.open.iter_mut().zip(kept).enumerate() {
            if !kept && listener.spec.overlaps(address) && !released.contains(&index) {
                listener.stop.cancel();
                if let Some(stopped) = listener.stopped.take() {
                    // If the task panicked, its socket is closed as well.
                    let _ = stopped.await;
                }
                released.push(index);
                any = true;
            }
        }
        any
    }

    /// Closes the new sockets. A listener whose socket was closed for them binds it again, now or as soon as possible.
    pub(super) fn abort(&mut self, new: NewSockets) {
        for socket in new.wanted.iter().filter_map(|(_, socket)| socket.bound()) {
            stop_listening(socket);
        }
        drop(new.wanted);
        for index in new.released {
            let Some(mut listener) = (index < self.open.len()).then(|| self.open.remove(index)) else {
                continue;
            };
            listener.stop = self.cancel.child_token();
            let socket = bind(listener.bound);
            self.accept(&mut listener, socket);
            self.open.insert(index, listener);
        }
    }

    /// Lets the new sockets accept connections and closes those that are no longer configured, with their
    /// connections. `handler` gives the handler of a listener and its runtime: the handler of the open listener,
    /// adapted to the new configuration, or a new one whose connections end with the token.
    pub fn commit(
        &mut self,
        new: NewSockets,
        mut handler: impl FnMut(&ListenerSpec, Option<&Arc<H>>, &CancellationToken) -> (Arc<H>, Handle),
    ) {
        let mut before = std::mem::take(&mut self.open);
        for (spec, socket) in new.wanted {
            let socket = match socket {
                Socket::New(socket) => Ok(socket),
                Socket::Missing(cause) => Err(cause),
                Socket::Open => {
                    if let Some(index) = before.iter().position(|open| open.spec.shares_socket(&spec)) {
                        let mut listener = before.remove(index);
                        (listener.handler, _) = handler(&spec, Some(&listener.handler), &listener.cancel);
                        listener.spec = spec;
                        self.open.push(listener);
                    }
                    continue;
                }
            };
            let cancel = self.cancel.child_token();
            let (handler, runtime) = handler(&spec, None, &cancel);
            let address = socket.as_ref().ok().and_then(|socket| socket.local_addr().ok());
            let bound = address.unwrap_or(spec.address);
            let mut listener = OpenListener {
                spec,
                bound,
                handler,
                runtime,
                cancel,
                stop: self.cancel.child_token(),
                stopped: None,
            };
            let (server, tls) = (self.server.title(), listener.spec.tls);
            match &socket {
                Ok(_) => {
                    tracing::info!(target: "drivegate::north::listener", address = %bound, tls, "{server}: listening")
                }
                Err(why) => tracing::error!(
                    target: "drivegate::north::listener", address = %bound,
                    "{server}: not listening: {why}; the drives are polled, and the address is retried until the \
                     machine has it"
                ),
            }
            self.accept(&mut listener, socket);
            self.open.push(listener);
        }
        for listener in before {
            tracing::info!(target: "drivegate::north::listener", address = %listener.bound, "{}: no longer listening", self.server.title());
            listener.handler.retire();
            listener.stop.cancel();
            listener.cancel.cancel();
        }
    }

    /// Closes all listeners; requests in progress are completed, as after a reload that closes them.
    pub(super) async fn close(&mut self) {
        for mut listener in std::mem::take(&mut self.open) {
            tracing::info!(target: "drivegate::north::listener", address = %listener.bound, "{}: no longer listening", self.server.title());
            listener.handler.retire();
            listener.stop.cancel();
            listener.cancel.cancel();
            if let Some(stopped) = listener.stopped.take() {
                // If the task panicked, its socket is closed as well.
                let _ = stopped.await;
            }
        }
    }

    /// Starts the accept loop of a listener; without a socket, the loop binds one as soon as possible.
    fn accept(&self, listener: &mut OpenListener<H>, socket: io::Result<std::net::TcpListener>) {
        let state = self.stats.listeners.add(self.server, listener.bound);
        state.set(socket.as_ref().err().map(io::Error::to_string));
        let accept = AcceptLoop {
            server: self.server,
            address: listener.bound,
            handler: listener.handler.clone(),
            state,
            tasks: self.tasks.clone(),
            stop: listener.stop.clone(),
        };
        let run = async move {
            // A socket belongs to the runtime that this code runs on.
            let first = socket.ok().and_then(|socket| ListeningSocket::new(socket).ok());
            let address = accept.address;
            accept.run(first, move || ListeningSocket::new(bind(address)?)).await;
        };
        listener.stopped = Some(self.tasks.spawn_on(run, &listener.runtime));
    }
}

/// Whether an address that cannot be bound for this reason may appear later with its interface.
fn may_come(cause: &io::Error) -> bool {
    cause.kind() == io::ErrorKind::AddrNotAvailable || cause.raw_os_error() == Some(Errno::NODEV.raw_os_error())
}

/// A socket that listens; not bound to a runtime yet.
fn bind(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = std::net::TcpListener::bind(address)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

#[cfg(test)]
mod tests;
