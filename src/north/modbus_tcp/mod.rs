//! Modbus TCP server: listeners and connections. What requests mean is decided in `session`; the public register map is
//! in [`super::register_map`].
//!
//! Requests may be pipelined. Answers from the process image are sent in one write. A request that needs the bus does
//! not delay the ones behind it, so replies can overtake one another; each has its transaction id.

mod admission;
mod client;
mod command_words;
mod connection;
mod crl;
mod dialogue;
mod forwarded_request;
pub(crate) mod frame;
pub(crate) mod identify;
mod offline;
mod open_clients;
mod routes;
mod session;
mod tls;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ipnet::IpNet;
use tokio::runtime::{Builder, Handle};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::admission::{Admission, RefusalLogs, WriteAccess};
use self::command_words::CommandWords;
use self::routes::PlantView;
use self::tls::{Requirements, TlsAuthenticator};
use crate::north::connection_limit::ConnectionLimit;
use crate::north::listener::{AcceptLoop, bind};
use crate::north::{IdentityFault, NorthStats, ServerError};
use crate::plant::SharedPlant;

pub use self::offline::Offline;
pub use self::tls::{Identity, Role, Tls};

/// Name in messages.
const PROTOCOL: &str = "Modbus TCP";
/// Files that the gateway needs beside those of the connections: ports, queues, other servers and their clients.
const OTHER_FILES: u64 = 512;

/// Configuration of the Modbus TCP server.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Listeners without TLS, with the rights of their clients.
    pub listeners: Vec<Listener>,
    /// The TLS listener.
    pub tls: Option<Tls>,
    /// Maximum number of open connections to all listeners.
    pub max_connections: usize,
    /// Maximum number of open connections from one address.
    pub max_connections_per_address: Option<usize>,
    /// Time without a request after which a connection is closed; `None` never closes it.
    pub idle_timeout: Option<Duration>,
    /// How raw reads outside the poll plan are handled.
    pub uncached: Uncached,
}

impl Options {
    /// Whether `other` differs only in the content of certificate files and in roles, which a running server can apply.
    pub(crate) fn differs_in_certificates_only(&self, other: &Options) -> bool {
        let mut same = other.clone();
        if let (Some(tls), Some(own)) = (&mut same.tls, &self.tls) {
            tls.identity = own.identity.clone();
            tls.roles = own.roles.clone();
        }
        self != other && *self == same
    }
}

/// A listener without TLS.
#[derive(Debug, Clone, PartialEq)]
pub struct Listener {
    /// Section of the configuration, for messages: `[modbus_tcp]`.
    pub section: String,
    /// Addresses to listen on.
    pub listen: Vec<SocketAddr>,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Networks that may write.
    pub write: Vec<IpNet>,
    /// Names of the visible buses; `None` for all.
    pub buses: Option<Vec<String>>,
}

/// How raw reads outside the poll plan are handled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Uncached {
    /// They are forwarded to the drive.
    #[default]
    Forward,
    /// They are refused with exception 02.
    Refuse,
}

/// A running server.
#[derive(Debug)]
pub struct Server {
    addresses: Vec<SocketAddr>,
    tls_addresses: Vec<SocketAddr>,
    authenticator: Option<Arc<TlsAuthenticator>>,
    tasks: TaskTracker,
}

impl Server {
    /// The addresses without TLS, with the port that the system chose if port 0 was configured.
    pub fn addresses(&self) -> &[SocketAddr] {
        &self.addresses
    }

    /// The addresses with TLS.
    pub fn tls_addresses(&self) -> &[SocketAddr] {
        &self.tls_addresses
    }

    /// Uses the certificates, revocations and roles of `options`. Open connections whose certificate they do not admit
    /// with the same rights end; the others stay.
    ///
    /// # Errors
    /// The certificates cannot be used; the previous ones stay in use.
    pub fn renew_certificates(&self, options: &Options) -> Result<(), ServerError> {
        match (&self.authenticator, &options.tls) {
            (Some(authenticator), Some(tls)) => {
                authenticator.renew(Requirements::new(tls).map_err(unusable)?);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Waits until all listeners and connections have ended, after the cancellation.
    pub async fn stopped(&self) {
        self.tasks.wait().await;
    }
}

/// What all connections share.
#[derive(Debug)]
struct ServerState {
    options: Options,
    stats: Arc<NorthStats>,
    command_words: CommandWords,
}

impl ServerState {
    fn new(options: Options, stats: Arc<NorthStats>) -> ServerState {
        ServerState {
            options,
            stats,
            command_words: CommandWords::default(),
        }
    }
}

/// Opens the listeners and serves until `cancel`; then pending requests have half a second to be answered.
///
/// # Errors
/// An address cannot be bound, the certificates cannot be used, or there is no thread. No socket stays open then.
pub async fn start(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) -> Result<Server, ServerError> {
    let tasks = TaskTracker::new();
    let opened = open(options, plant, stats, &cancel, &tasks).await;
    tasks.close();
    opened
}

async fn open(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: &CancellationToken,
    tasks: &TaskTracker,
) -> Result<Server, ServerError> {
    let authenticator = options
        .tls
        .as_ref()
        .map(TlsAuthenticator::new)
        .transpose()
        .map_err(unusable)?
        .map(Arc::new);
    raise_file_limit(options.max_connections);
    let limit = ConnectionLimit::new(options.max_connections, options.max_connections_per_address);
    let state = Arc::new(ServerState::new(options, stats));
    let accept_loop = |section: &str, allow: &[IpNet], write: WriteAccess, buses: &Option<Vec<String>>| {
        let handler = Arc::new(Admission {
            section: section.to_string(),
            allow: allow.to_vec(),
            write,
            view: Arc::new(PlantView::new(plant.clone(), buses.clone())),
            state: state.clone(),
            cancel: cancel.clone(),
            logs: RefusalLogs::default(),
        });
        let limit = limit.clone();
        move || AcceptLoop {
            protocol: PROTOCOL,
            handler: handler.clone(),
            limit: limit.clone(),
            tasks: tasks.clone(),
            cancel: cancel.clone(),
        }
    };
    let (own, here) = (start_thread(tasks)?, Handle::current());
    let (mut loops, mut addresses, mut tls_addresses) = (Vec::new(), Vec::new(), Vec::new());
    for listener in &state.options.listeners {
        let write = WriteAccess::ByAddress(listener.write.clone());
        let accept = accept_loop(&listener.section, &listener.allow, write, &listener.buses);
        // A socket belongs to the runtime in which it is bound.
        let Listener { listen, section, .. } = listener.clone();
        let sockets = own.spawn(async move { bind(&listen, PROTOCOL, &section).await });
        for (socket, address) in sockets.await.map_err(|error| ServerError::Thread(error.into()))?? {
            addresses.push(address);
            loops.push((socket, accept(), &own));
        }
    }
    if let (Some(tls), Some(authenticator)) = (&state.options.tls, &authenticator) {
        let (section, write) = ("[modbus_tcp.tls]", WriteAccess::ByCertificate(authenticator.clone()));
        let accept = accept_loop(section, &tls.allow, write, &tls.buses);
        for (socket, address) in bind(&tls.listen, PROTOCOL, section).await? {
            tls_addresses.push(address);
            loops.push((socket, accept(), &here));
        }
    }
    for (addresses, tls) in [(&addresses, false), (&tls_addresses, true)] {
        for address in addresses {
            tracing::info!(%address, tls, "Modbus TCP: listening");
        }
    }
    for (socket, accept, runtime) in loops {
        tasks.spawn_on(accept.run(socket), runtime);
    }
    Ok(Server {
        addresses,
        tls_addresses,
        authenticator,
        tasks: tasks.clone(),
    })
}

fn unusable(fault: IdentityFault) -> ServerError {
    ServerError::Tls(PROTOCOL, fault)
}

/// Starts a thread that only serves clients without TLS, until all `tasks` have ended. Metrics and TLS handshakes,
/// which take a millisecond of computing, do not delay these clients; and a single thread serves more of them than
/// several that hand work to each other: a fifth more on two processors with 16 clients (`benches/modbus_tcp`).
fn start_thread(tasks: &TaskTracker) -> Result<Handle, ServerError> {
    let (sender, receiver) = std::sync::mpsc::sync_channel(1);
    let tasks = tasks.clone();
    let serve = move || match Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => {
            let _ = sender.send(Ok(runtime.handle().clone()));
            runtime.block_on(tasks.wait());
        }
        Err(error) => {
            let _ = sender.send(Err(error));
        }
    };
    let thread = std::thread::Builder::new().name("modbus-tcp".to_string());
    let runtime = thread
        .spawn(serve)
        .and_then(|_| receiver.recv().map_err(io::Error::other)?);
    runtime.map_err(ServerError::Thread)
}

/// Raises the limit of open files, which is often 1024 by default, as far as `connections` require.
fn raise_file_limit(connections: usize) {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let wanted = connections as u64 + OTHER_FILES;
    let limit = getrlimit(Resource::Nofile);
    if limit.current.is_none_or(|current| current >= wanted) {
        return;
    }
    let reached = limit.maximum.map_or(wanted, |most| most.min(wanted));
    let raised = Rlimit {
        current: Some(reached),
        maximum: limit.maximum,
    };
    let why = match setrlimit(Resource::Nofile, raised) {
        Ok(()) if reached == wanted => return,
        Ok(()) => "the hard limit is lower".to_string(),
        Err(why) => why.to_string(),
    };
    tracing::warn!(
        "Modbus TCP: {connections} connections require {wanted} open files, but the limit is {reached}: {why}; raise \
         LimitNOFILE of the service or lower `max_connections` of [modbus_tcp]"
    );
}
