//! A server whose clients connect over TCP. Its listeners, its tasks and a reload in two steps are common to Modbus
//! TCP, HTTP and the tool slots; each [`TcpService`] defines what its options mean for a connection.

use std::fmt::Debug;
use std::net::SocketAddr;
use std::sync::Arc;

use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::listener::{ConnectionHandler, ListenerSpec, Listeners, NewSockets};
use super::server::{Reconfigure, Server};
use super::{NorthState, ServerError, ServerKind};
use drivegate_core::plant::SharedPlant;

/// Differences of one TCP server from the others.
pub trait TcpService<Options>: Debug + Sized {
    /// Name of the server in messages.
    const NAME: &'static str;
    /// The server's kind in metrics.
    const KIND: ServerKind;
    /// Handles the connections to a listener.
    type Handler: ConnectionHandler + Debug;
    /// Prepared parts of a change apart from the sockets, such as certificates.
    type Prepared;

    /// A service without listeners; `tasks` end with `cancel`.
    ///
    /// # Errors
    /// If a certificate cannot be used, or a thread cannot be started.
    fn new(
        options: &Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
        tasks: &TaskTracker,
    ) -> Result<Self, ServerError>;

    /// The listeners, in the order of the configuration.
    fn listener_specs(options: &Options) -> Vec<ListenerSpec>;

    /// Does everything that can fail, except binding; changes nothing for any client.
    ///
    /// # Errors
    /// If the certificates cannot be used.
    fn prepare(&self, options: &Options) -> Result<Self::Prepared, ServerError>;

    /// Applies prepared options: gives each listener its handler.
    fn commit(
        &mut self,
        options: Options,
        prepared: Self::Prepared,
        sockets: NewSockets,
        listeners: &mut Listeners<Self::Handler>,
    );

    /// Ends what serves clients without a listener, and the rights of all clients.
    fn retire(&mut self) {}
}

/// A running TCP server.
#[derive(Debug)]
pub struct TcpServer<S: TcpService<O>, O> {
    service: S,
    listeners: Listeners<S::Handler>,
    tasks: TaskTracker,
}

/// A prepared change of options for [`Reconfigure::commit`]: everything that can fail is done.
#[derive(Debug)]
pub struct Change<S: TcpService<O>, O> {
    options: O,
    sockets: NewSockets,
    prepared: S::Prepared,
}

impl<S: TcpService<O>, O> TcpServer<S, O> {
    /// The first address, with TLS or without.
    pub fn address(&self) -> Option<SocketAddr> {
        [self.addresses(), self.tls_addresses()].into_iter().flatten().next()
    }

    /// The addresses without TLS, with the port that the system chose if port 0 was configured.
    pub fn addresses(&self) -> Vec<SocketAddr> {
        self.listeners.addresses(false)
    }

    /// The addresses of the listeners with TLS.
    pub fn tls_addresses(&self) -> Vec<SocketAddr> {
        self.listeners.addresses(true)
    }
}

impl<S: TcpService<O>, O: Clone + PartialEq + Debug> Server for TcpServer<S, O> {
    const NAME: &'static str = S::NAME;
    type Options = O;

    /// Opens the listeners and serves until `cancel`. No socket stays open on an error.
    async fn start(
        options: O,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
    ) -> Result<TcpServer<S, O>, ServerError> {
        let cancel = cancel.child_token();
        // The server ends with the token, not with its last task: a reload can replace every listener.
        let tasks = TaskTracker::new();
        tasks.spawn(cancel.clone().cancelled_owned());
        tasks.close();
        let on_error = cancel.clone().drop_guard();
        let mut server = TcpServer {
            listeners: Listeners::new(S::KIND, stats.clone(), tasks.clone(), cancel.clone()),
            service: S::new(&options, plant, stats, cancel, &tasks)?,
            tasks,
        };
        // The first options are prepared and committed like all later ones.
        let change = server.prepare(options).await?;
        server.commit(change);
        on_error.disarm();
        Ok(server)
    }

    async fn stopped(self) {
        self.tasks.wait().await;
    }
}

impl<S: TcpService<O>, O: Clone + PartialEq + Debug> Reconfigure for TcpServer<S, O> {
    type Change = Change<S, O>;

    async fn prepare(&mut self, options: O) -> Result<Change<S, O>, ServerError> {
        Ok(Change {
            prepared: self.service.prepare(&options)?,
            sockets: self.listeners.prepare(S::listener_specs(&options)).await?,
            options,
        })
    }

    fn commit(&mut self, change: Change<S, O>) {
        let Change {
            options,
            sockets,
            prepared,
        } = change;
        self.service.commit(options, prepared, sockets, &mut self.listeners);
    }

    fn abort(&mut self, change: Change<S, O>) {
        self.listeners.abort(change.sockets);
    }

    /// Closes the listeners and their connections; requests that wait for the bus are answered.
    async fn retire(&mut self) {
        self.service.retire();
        self.listeners.close().await;
    }

    fn is_drained(&self) -> bool {
        self.tasks.len() <= 1
    }
}
