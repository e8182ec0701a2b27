//! Modbus TCP server: MBAP framing and connections here, the meaning of requests in `session`, the public
//! register map in [`super::register_map`].
//!
//! Requests may be pipelined. All that the cache answers goes out in one write; what needs the bus is waited
//! for beside it and answered when it is done, so replies can overtake one another and carry their
//! transaction ids.

mod certificate;
mod connection;
mod dialogue;
mod door;
mod errand;
pub(crate) mod frame;
pub(crate) mod identify;
mod lookout;
mod offline;
mod places;
mod session;
mod shared;
mod tls;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ipnet::IpNet;
use tokio::net::TcpListener;
use tokio::runtime::{Builder, Handle};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::door::{Admission, Door};
use self::places::Places;
use self::shared::{Shared, View};
use self::tls::Gatekeeper;
use crate::north::NorthStats;
use crate::plant::SharedPlant;

pub use self::offline::Offline;
pub use self::tls::{Finding, Identity, Role, Tls, TlsFile};

/// Least time between two log lines of one kind.
const LOG_INTERVAL: Duration = Duration::from_secs(10);
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Uncached {
    /// They are asked of the drive.
    #[default]
    Forward,
    /// They are refused with 02.
    Refuse,
}

/// A running server.
#[derive(Debug)]
pub struct Server {
    addresses: Vec<SocketAddr>,
    tls_addresses: Vec<SocketAddr>,
    gatekeeper: Option<Arc<Gatekeeper>>,
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
    pub fn renew_certificates(&self, options: &Options) -> Result<(), String> {
        match (&self.gatekeeper, &options.tls) {
            (Some(gatekeeper), Some(tls)) => gatekeeper.renew(&tls.identity),
            _ => Ok(()),
        }
    }

    /// Waits until every listener and connection has ended, after the token was cancelled.
    pub async fn stopped(&self) {
        self.tasks.wait().await;
    }
}

/// Opens the listeners and serves until `cancel`; then requests under way get half a second to be answered.
///
/// # Errors
/// When an address cannot be listened on: which one, why, what to do. Nothing is left open then.
pub async fn start(
    options: Options,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    cancel: CancellationToken,
) -> io::Result<Server> {
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
) -> io::Result<Server> {
    let gatekeeper = options.tls.as_ref().map(Gatekeeper::new).transpose();
    let gatekeeper = gatekeeper.map_err(io::Error::other)?.map(Arc::new);
    raise_file_limit(options.max_connections);
    let places = Places::new(options.max_connections, options.max_connections_per_address);
    let shared = Arc::new(Shared::new(options, stats));
    let door = |view: &Arc<View>, section: &str, allow: &[IpNet], admission: &Admission| Door {
        section: section.to_string(),
        allow: allow.to_vec(),
        admission: admission.clone(),
        view: view.clone(),
        shared: shared.clone(),
        places: places.clone(),
        tasks: tasks.clone(),
        cancel: cancel.clone(),
    };
    let (own, here) = (own_thread(tasks)?, Handle::current());
    let (mut doors, mut addresses, mut tls_addresses) = (Vec::new(), Vec::new(), Vec::new());
    for listener in &shared.options.listeners {
        let view = Arc::new(View::new(plant.clone(), listener.buses.clone()));
        let admission = Admission::ByAddress(listener.write.clone());
        // Bound there, a socket reports to that thread.
        let sockets = own.spawn(listen(listener.listen.clone(), listener.section.clone()));
        for socket in sockets.await.map_err(io::Error::other)?? {
            addresses.push(socket.local_addr()?);
            let door = door(&view, &listener.section, &listener.allow, &admission);
            doors.push((socket, door, &own));
        }
    }
    if let (Some(tls), Some(gatekeeper)) = (&shared.options.tls, &gatekeeper) {
        let view = Arc::new(View::new(plant.clone(), tls.buses.clone()));
        let (section, admission) = ("[modbus_tcp.tls]", Admission::ByCertificate(gatekeeper.clone()));
        for socket in listen(tls.listen.clone(), section.to_string()).await? {
            tls_addresses.push(socket.local_addr()?);
            doors.push((socket, door(&view, section, &tls.allow, &admission), &here));
        }
    }
    for (address, tls) in addresses
        .iter()
        .map(|a| (a, false))
        .chain(tls_addresses.iter().map(|a| (a, true)))
    {
        tracing::info!(%address, tls, "Modbus TCP: listening");
    }
    for (socket, door, runtime) in doors {
        tasks.spawn_on(door.serve(socket), runtime);
    }
    Ok(Server {
        addresses,
        tls_addresses,
        gatekeeper,
        tasks: tasks.clone(),
    })
}

/// A thread that does nothing but answer the clients without TLS, until all `tasks` have ended. They are not held up by a
/// scrape or a handshake, which compute for a millisecond, and one thread answers more of them than several that give
/// each other work: on two processors, a fifth more with 16 clients (`benches/modbus_tcp`).
fn own_thread(tasks: &TaskTracker) -> io::Result<Handle> {
    let (tell, told) = std::sync::mpsc::sync_channel(1);
    let tasks = tasks.clone();
    let serve = move || match Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => {
            let _ = tell.send(Ok(runtime.handle().clone()));
            runtime.block_on(tasks.wait());
        }
        Err(why) => {
            let _ = tell.send(Err(why));
        }
    };
    let thread = std::thread::Builder::new().name("modbus-tcp".to_string());
    let runtime = thread.spawn(serve).and_then(|_| told.recv().map_err(io::Error::other)?);
    runtime.map_err(|why| {
        let told = format!("cannot start the thread of Modbus TCP: {why}; free memory, threads or file descriptors");
        io::Error::new(why.kind(), told)
    })
}

/// Opens sockets on all addresses of a section, or none.
async fn listen(addresses: Vec<SocketAddr>, section: String) -> io::Result<Vec<TcpListener>> {
    let mut sockets = Vec::with_capacity(addresses.len());
    for address in addresses {
        let socket = TcpListener::bind(address)
            .await
            .map_err(|why| told(address, &section, &why))?;
        sockets.push(socket);
    }
    Ok(sockets)
}

fn told(address: SocketAddr, section: &str, why: &io::Error) -> io::Error {
    let remedy = match why.kind() {
        io::ErrorKind::AddrInUse => "another program has it; stop that one or choose another port",
        io::ErrorKind::PermissionDenied => {
            "ports below 1024 need CAP_NET_BIND_SERVICE; grant it or choose another port"
        }
        io::ErrorKind::AddrNotAvailable => "this machine has no such address; choose one that it has",
        _ => "choose another address",
    };
    io::Error::new(
        why.kind(),
        format!("cannot listen for Modbus TCP on {address}: {why}; {remedy} in `listen` of {section}"),
    )
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

/// Keeps a log readable while something happens again and again.
#[derive(Debug, Default)]
struct Seldom {
    last: Option<Instant>,
    held_back: u64,
}

impl Seldom {
    /// Whether to log now: the number of lines held back since the last one.
    fn tell(&mut self, now: Instant) -> Option<u64> {
        if self
            .last
            .is_some_and(|last| now.saturating_duration_since(last) < LOG_INTERVAL)
        {
            self.held_back += 1;
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.held_back))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_line_in_ten_seconds() {
        let (mut seldom, now) = (Seldom::default(), Instant::now());
        assert_eq!(seldom.tell(now), Some(0));
        assert_eq!(seldom.tell(now), None);
        assert_eq!(seldom.tell(now + Duration::from_secs(9)), None);
        assert_eq!(seldom.tell(now + Duration::from_secs(10)), Some(2));
    }
}
