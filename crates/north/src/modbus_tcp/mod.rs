//! Modbus TCP server: listeners and connections. What requests mean is decided in `session`; the public register map is
//! in [`super::register_map`].
//!
//! Requests may be pipelined. Replies from the process image are sent in one write. A request that needs the bus
//! does not delay the ones after it, so replies can overtake one another; each carries its transaction id.

mod admission;
mod client;
mod command_words;
mod connection;
mod dialogue;
mod forwarded_request;
pub(crate) mod frame;
pub(crate) mod identify;
mod loopback;
mod open_clients;
mod routes;
mod session;
mod tls;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use arc_swap::ArcSwap;
use ipnet::IpNet;
use tokio::runtime::{Builder, Handle};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::admission::{Admission, Policy, WriteAccess};
use self::command_words::CommandWords;
use self::routes::PlantView;
use self::tls::{Requirements, TlsAuthenticator};
use crate::connection_limit::{ConnectionLimit, Limits};
use crate::listener::{ListenerSpec, Listeners, NewSockets};
use crate::log_throttle::LogThrottle;
use crate::reading::Watch;
use crate::refusals::Refusals;
use crate::tcp_server::{TcpServer, TcpService};
use crate::tls::certificate;
use crate::{NorthState, ServerError, ServerKind};
use drivegate_core::event::Events;
use drivegate_core::plant::SharedPlant;

pub use self::loopback::Loopback;
pub use self::routes::{Registers, View};
pub use self::tls::{Identity, Role, Tls};

/// The role in a client certificate in DER, for the fuzzer; `None` if the bytes are not a certificate, an error if the
/// role is not accepted.
pub fn certificate_role(der: &[u8]) -> Option<Result<Option<String>, String>> {
    let certificate = certificate::read(der).ok()?;
    Some(certificate.role.map_err(|why| why.to_string()))
}

/// Minimum interval between two log lines about clients that send RTU frames over TCP and reconnect continuously.
const SERIAL_LOGGED: Duration = Duration::from_secs(600);
/// Section of the TLS listener.
const TLS_SECTION: &str = "[modbus_tcp.tls]";
/// Maximum number of simultaneous TLS handshakes, in total and from one address. A slow handshake yields to a newer
/// one, so idle connections do not block new ones.
const HANDSHAKES: Limits = Limits {
    total: 64,
    reserved: 0,
    per_address: 16,
};

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
    pub max_connections_per_address: usize,
    /// Time without a request after which a connection is closed; `None` never closes it.
    pub idle_timeout: Option<Duration>,
    /// How raw reads outside the poll plan are handled.
    pub uncached: Uncached,
}

impl Options {
    /// Files that the connections can have open at one time, with those that are being closed.
    pub fn files(&self) -> usize {
        let handshakes = if self.tls.is_some() {
            self.handshakes().files()
        } else {
            0
        };
        self.limits().files() + handshakes
    }

    fn handshakes(&self) -> Limits {
        Limits {
            total: HANDSHAKES.total.min(self.max_connections.max(8)),
            ..HANDSHAKES
        }
    }

    /// Limits of connections; some places are reserved for clients that may write, if there can be any.
    fn limits(&self) -> Limits {
        let limits = Limits::new(self.max_connections, self.max_connections_per_address);
        let by_address = self.listeners.iter().any(|listener| !listener.write.is_empty());
        let by_role = self
            .tls
            .iter()
            .flat_map(|tls| tls.roles.values())
            .any(|role| *role == Role::Control);
        if by_address || by_role {
            limits.with_reserve()
        } else {
            limits
        }
    }
}

/// A listener without TLS.
#[derive(Debug, Clone, PartialEq)]
pub struct Listener {
    /// Section of the configuration, for messages: `[modbus_tcp]`.
    pub section: String,
    /// Addresses on which the server listens.
    pub listen: Vec<SocketAddr>,
    /// Networks whose clients may connect.
    pub allow: Vec<IpNet>,
    /// Networks whose clients may write.
    pub write: Vec<IpNet>,
    /// The register view that clients see.
    pub view: View,
}

/// How raw reads outside the poll plan are handled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Uncached {
    /// The reads are forwarded to the drive.
    #[default]
    Forward,
    /// The reads are refused with exception 02.
    Refuse,
}

/// The running Modbus TCP server.
pub type Server = TcpServer<ModbusTcp, Options>;

/// The service for the clients of the listeners.
#[derive(Debug)]
pub struct ModbusTcp {
    authenticator: Option<Arc<TlsAuthenticator>>,
    state: Arc<ServerState>,
    plant: SharedPlant,
    /// Runtime that serves clients without TLS.
    own: Handle,
    /// Number of listeners opened so far.
    opened: usize,
}

impl TcpService<Options> for ModbusTcp {
    const NAME: &'static str = "Modbus TCP";
    const KIND: ServerKind = ServerKind::ModbusTcp;
    type Handler = Admission;
    /// Prepared requirements for the clients of the TLS listener, if it is new or its certificates, revocations or
    /// roles have changed.
    type Prepared = Option<Requirements>;

    fn new(
        options: &Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
        tasks: &TaskTracker,
    ) -> Result<ModbusTcp, ServerError> {
        Ok(ModbusTcp {
            authenticator: None,
            state: Arc::new(ServerState::new(options.clone(), stats, cancel)),
            // The thread ends when its tasks have ended.
            own: start_thread(tasks, plant.load().events.clone())?,
            plant,
            opened: 0,
        })
    }

    fn listener_specs(options: &Options) -> Vec<ListenerSpec> {
        let spec = |address: &SocketAddr, tls, section: &str| ListenerSpec {
            address: *address,
            tls,
            section: section.to_string(),
        };
        let plain = options.listeners.iter();
        let plain = plain.flat_map(|l| l.listen.iter().map(move |address| spec(address, false, &l.section)));
        let tls = options.tls.iter().flat_map(|tls| &tls.listen);
        plain
            .chain(tls.map(|address| spec(address, true, TLS_SECTION)))
            .collect()
    }

    fn prepare(&self, options: &Options) -> Result<Option<Requirements>, ServerError> {
        let before = self.state.options.load_full();
        match (&options.tls, &before.tls) {
            (Some(tls), Some(before)) if self.authenticator.is_some() && tls.admits_like(before) => Ok(None),
            (Some(tls), _) => match Requirements::new(tls) {
                Ok(requirements) => Ok(Some(requirements)),
                Err(fault) => Err(ServerError::Tls(ServerKind::ModbusTcp.title(), fault)),
            },
            (None, _) => Ok(None),
        }
    }

    /// Applies prepared options. Unchanged listeners keep their connections as far as the options allow, with the
    /// rights of the new options. TLS clients whose certificate is no longer admitted with the same rights are
    /// disconnected.
    fn commit(
        &mut self,
        options: Options,
        requirements: Option<Requirements>,
        sockets: NewSockets,
        listeners: &mut Listeners<Admission>,
    ) {
        match (&self.authenticator, requirements) {
            (_, None) if options.tls.is_none() => self.authenticator = None,
            (_, None) => {}
            (Some(authenticator), Some(requirements)) => {
                authenticator.renew(requirements);
                tracing::info!(target: "drivegate::north::modbus_tcp", "Modbus TCP: using the new certificates, revocations and roles");
            }
            (None, Some(requirements)) => self.authenticator = Some(Arc::new(TlsAuthenticator::new(requirements))),
        }
        let options = Arc::new(options);
        self.state.connections.set_limits(options.limits());
        self.state.handshakes.set_limits(options.handshakes());
        self.state.options.store(options.clone());
        let (plant, state, own, tls) = (&self.plant, &self.state, &self.own, &self.authenticator);
        let mut plain = options.listeners.iter().flat_map(|l| l.listen.iter().map(move |_| l));
        let opened = &mut self.opened;
        listeners.commit(sockets, |spec, open, cancel| {
            let (policy, view) = match (spec.tls, tls, &options.tls) {
                (true, Some(authenticator), Some(tls)) => (
                    Policy {
                        allow: tls.allow.clone(),
                        write: WriteAccess::ByCertificate(authenticator.clone()),
                    },
                    View {
                        buses: tls.buses.clone(),
                        ..View::default()
                    },
                ),
                // The unencrypted listeners come first, in an unchanged order.
                _ => plain.next().map_or_else(Policy::nobody, |l| {
                    let write = WriteAccess::ByAddress(l.write.clone());
                    let allow = l.allow.clone();
                    (Policy { allow, write }, l.view.clone())
                }),
            };
            let runtime = if spec.tls { Handle::current() } else { own.clone() };
            let admission = match open {
                Some(admission) => {
                    admission.update(policy, view);
                    admission.clone()
                }
                None => {
                    *opened += 1;
                    let view = PlantView::new(*opened, plant.clone(), state.stats.stop_all.clone(), view);
                    Arc::new(Admission::new(*opened, policy, view, state.clone(), cancel.clone()))
                }
            };
            (admission, runtime)
        });
    }

    /// Without the server no client may command over it.
    fn retire(&mut self) {
        let options = self.state.options.load_full();
        self.state.options.store(Arc::new(Options {
            listeners: Vec::new(),
            tls: None,
            ..(*options).clone()
        }));
    }
}

/// The state shared by all connections.
#[derive(Debug)]
struct ServerState {
    options: ArcSwap<Options>,
    stats: Arc<NorthState>,
    command_words: CommandWords,
    connections: Arc<ConnectionLimit>,
    /// Limit of TLS connections that are not admitted yet.
    handshakes: Arc<ConnectionLimit>,
    refusals: Refusals,
    /// Log lines about clients that send RTU frames over TCP.
    serial_clients: LogThrottle,
    /// Token that is cancelled when the server ends; from then on the server does not wait for its clients.
    stopping: CancellationToken,
}

impl ServerState {
    fn new(options: Options, stats: Arc<NorthState>, stopping: CancellationToken) -> ServerState {
        ServerState {
            stopping,
            connections: ConnectionLimit::new(options.limits()),
            handshakes: ConnectionLimit::new(options.handshakes()),
            refusals: Refusals::new(ServerKind::ModbusTcp, stats.clone()),
            serial_clients: LogThrottle::every(SERIAL_LOGGED),
            options: ArcSwap::from_pointee(options),
            stats,
            command_words: CommandWords::default(),
        }
    }
}

/// Starts a thread that only serves clients without TLS, until all `tasks` have ended. Metrics and TLS handshakes,
/// which need a millisecond of computing, then do not delay these clients. A single thread also serves more clients
/// than several that pass work to each other: a fifth more on two processors with 16 clients
/// (`benches/modbus_tcp`).
fn start_thread(tasks: &TaskTracker, events: Events) -> Result<Handle, ServerError> {
    let (sender, receiver) = std::sync::mpsc::sync_channel(1);
    let tasks = tasks.clone();
    let serve = move || match Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => {
            let watch = Watch::new(true);
            watch.enter();
            runtime.spawn(watch.run(events));
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
