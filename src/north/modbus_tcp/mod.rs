//! Modbus TCP server: MBAP framing and connections here, the meaning of requests in `session`, the public
//! register map in [`super::register_map`].
//!
//! Requests may be pipelined. All that the cache answers goes out in one write; what needs the bus is waited
//! for beside it and answered when it is done, so replies can overtake one another and carry their
//! transaction ids.

mod admission;
mod certificate;
mod client;
mod command_words;
mod connection;
mod dialogue;
mod forwarded_request;
pub(crate) mod frame;
pub(crate) mod identify;
mod offline;
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
use self::tls::TlsAuthenticator;
use crate::north::connection_limit::ConnectionLimit;
use crate::north::listener::{AcceptLoop, bind};
use crate::north::{NorthStats, ServerError};
use crate::plant::SharedPlant;

pub use self::offline::Offline;
pub use self::tls::{Identity, IdentityFault, IdentityProblem, Role, Tls, TlsFile};

/// Name in messages.
const PROTOCOL: &str = "Modbus TCP";
/// Files that the gateway needs open beside the connections: ports, queues, other servers, their clients.
const OTHER_FILES: u64 = 512;

/// What the Modbus TCP server is told.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Where clients connect without TLS, and what they may do there.
    pub listeners: Vec<Listener>,
    /// Where clients connect with TLS.
    pub tls: Option<Tls>,
    /// Connections at one time, of all listeners together.
    pub max_connections: usize,
    /// Connections at one time from one address.
    pub max_connections_per_address: Option<usize>,
    /// Time without a request after which a connection is closed.
    pub idle_timeout: Option<Duration>,
    /// What happens to raw reads outside the plan.
    pub uncached: Uncached,
}

impl Options {
    /// Whether `other` differs in the content of certificate files only, which a running server can take over.
    pub fn differs_in_certificates_only(&self, other: &Options) -> bool {
        let mut same = other.clone();
        if let (Some(tls), Some(own)) = (&mut same.tls, &self.tls) {
            tls.identity = own.identity.clone();
        }
        self != other && *self == same
    }
}

/// A listener without TLS: who may connect, who may write, what is shown.
#[derive(Debug, Clone, PartialEq)]
pub struct Listener {
    /// Its section of the configuration, for messages: `[modbus_tcp]`.
    pub section: String,
    /// Addresses to listen on.
    pub listen: Vec<SocketAddr>,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Networks that may write.
    pub write: Vec<IpNet>,
    /// Names of the buses whose drives are shown; `None` shows all.
    pub buses: Option<Vec<String>>,
}

/// What happens to raw reads outside the plan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Uncached {
    /// They are asked of the drive.
    Forward,
    /// They are refused with 02.
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
    /// Where it listens without TLS; a port 0 of the options is the real one here.
    pub fn addresses(&self) -> &[SocketAddr] {
        &self.addresses
    }

    /// Where it listens with TLS.
    pub fn tls_addresses(&self) -> &[SocketAddr] {
        &self.tls_addresses
    }

    /// Takes the certificates of `options` for clients that connect from now on; nobody is disconnected.
    ///
    /// # Errors
    /// When they cannot be used; the old ones stay.
    pub fn renew_certificates(&self, options: &Options) -> Result<(), ServerError> {
        match (&self.authenticator, &options.tls) {
            (Some(authenticator), Some(tls)) => Ok(authenticator.renew(&tls.identity)?),
            _ => Ok(()),
        }
    }

    /// Waits until every listener and connection has ended, after the token was cancelled.
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
        .transpose()?
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
    let (own, here) = (own_thread(tasks)?, Handle::current());
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

/// Starts a thread that only serves clients without TLS, until all `tasks` have ended. Metrics and TLS handshakes, which
/// take a millisecond of computing, do not delay these clients; and a single thread serves more of them than several that
/// hand work to each other: a fifth more on two processors with 16 clients (`benches/modbus_tcp`).
fn own_thread(tasks: &TaskTracker) -> Result<Handle, ServerError> {
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

/// Many connections need many files; what the system lets a process have by default is often 1024.
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
        Ok(()) => "the hard limit is in the way".to_string(),
        Err(why) => why.to_string(),
    };
    tracing::warn!(
        "Modbus TCP: {connections} connections want {wanted} open files and only {reached} are granted: {why}; raise \
         LimitNOFILE of the service or lower `max_connections` of [modbus_tcp]"
    );
}
