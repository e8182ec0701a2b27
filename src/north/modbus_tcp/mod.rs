//! Modbus TCP server: MBAP framing and connections here, the meaning of requests in `session`, the public
//! register map in [`super::register_map`].
//!
//! Requests may be pipelined. All that the cache answers goes out in one write; what needs the bus is waited
//! for beside it and answered when it is done, so replies can overtake one another and carry their
//! transaction ids.

mod connection;
mod frame;
mod identify;
mod session;
mod shared;

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ipnet::IpNet;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use self::session::Session;
use self::shared::{Authority, Shared};
use crate::north::NorthStats;
use crate::plant::SharedPlant;

/// Pause after a failed accept: the usual reason, too many open files, does not go away at once.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Least time between two log lines of one kind.
const LOG_INTERVAL: Duration = Duration::from_secs(10);
/// A peer that vanished without a word is found out after 60 s + 3 * 10 s.
const KEEPALIVE_IDLE: Duration = Duration::from_secs(60);
const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);
const KEEPALIVE_PROBES: u32 = 3;

/// What the Modbus TCP server is told.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Addresses to listen on.
    pub listen: Vec<SocketAddr>,
    /// Networks that may connect.
    pub allow: Vec<IpNet>,
    /// Networks that may write.
    pub write: Vec<IpNet>,
    /// Connections at one time.
    pub max_connections: usize,
    /// What happens to raw reads outside the plan.
    pub uncached: Uncached,
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
    tasks: TaskTracker,
}

impl Server {
    /// Where it listens; a port 0 of the options is the real one here.
    pub fn addresses(&self) -> &[SocketAddr] {
        &self.addresses
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
    let mut listeners = Vec::with_capacity(options.listen.len());
    let mut addresses = Vec::with_capacity(options.listen.len());
    for address in &options.listen {
        let listener = TcpListener::bind(address).await.map_err(|why| told(*address, &why))?;
        addresses.push(listener.local_addr()?);
        listeners.push(listener);
    }
    let tasks = TaskTracker::new();
    let slots = Arc::new(Semaphore::new(options.max_connections.min(Semaphore::MAX_PERMITS)));
    let shared = Arc::new(Shared::new(options, plant, stats));
    for (listener, address) in listeners.into_iter().zip(&addresses) {
        tracing::info!(%address, "Modbus TCP: listening");
        let door = Door {
            shared: shared.clone(),
            slots: slots.clone(),
            tasks: tasks.clone(),
            cancel: cancel.clone(),
            refused: Seldom::default(),
            full: Seldom::default(),
            failed: Seldom::default(),
        };
        tasks.spawn(door.serve(listener));
    }
    tasks.close();
    Ok(Server { addresses, tasks })
}

fn told(address: SocketAddr, why: &io::Error) -> io::Error {
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
        format!("cannot listen for Modbus TCP on {address}: {why}; {remedy} in `listen` of [modbus_tcp]"),
    )
}

/// A listener: who comes in.
struct Door {
    shared: Arc<Shared>,
    slots: Arc<Semaphore>,
    tasks: TaskTracker,
    cancel: CancellationToken,
    refused: Seldom,
    full: Seldom,
    failed: Seldom,
}

impl Door {
    async fn serve(mut self, listener: TcpListener) {
        loop {
            let accepted = tokio::select! {
                () = self.cancel.cancelled() => return,
                accepted = listener.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => self.admit(stream, peer),
                // The client went away between its knock and the answer.
                Err(why) if why.kind() == io::ErrorKind::ConnectionAborted => {}
                Err(why) => {
                    if let Some(more) = self.failed.tell(Instant::now()) {
                        tracing::warn!(more, "Modbus TCP: cannot accept a connection: {why}; trying on");
                    }
                    tokio::select! {
                        () = self.cancel.cancelled() => return,
                        () = tokio::time::sleep(ACCEPT_PAUSE) => {}
                    }
                }
            }
        }
    }

    /// Starts a task for a client that may connect; else its connection is closed at once.
    fn admit(&mut self, stream: TcpStream, peer: SocketAddr) {
        // A listener on [::] sees IPv4 clients as ::ffff:a.b.c.d.
        let ip = peer.ip().to_canonical();
        let options = &self.shared.options;
        if !contains(&options.allow, ip) {
            if let Some(more) = self.refused.tell(Instant::now()) {
                tracing::warn!(client = %ip, more, "Modbus TCP: client refused: it is not in `allow` of [modbus_tcp]");
            }
            return;
        }
        let Ok(slot) = self.slots.clone().try_acquire_owned() else {
            if let Some(more) = self.full.tell(Instant::now()) {
                let most = options.max_connections;
                tracing::warn!(client = %ip, more,
                    "Modbus TCP: client refused: {most} are connected already; raise `max_connections` of [modbus_tcp]");
            }
            return;
        };
        let authority = Authority {
            may_write: contains(&options.write, ip),
            who: SocketAddr::new(ip, peer.port()).to_string(),
        };
        let (shared, cancel) = (self.shared.clone(), self.cancel.child_token());
        self.tasks.spawn(async move {
            let _slot = slot;
            prepare(&stream);
            connection::serve(stream, Session::new(shared, authority), cancel).await;
        });
    }
}

fn contains(networks: &[IpNet], ip: IpAddr) -> bool {
    networks.iter().any(|n| n.contains(&ip))
}

/// Answers leave at once; a peer that vanished is noticed. Neither is worth refusing a client for.
fn prepare(stream: &TcpStream) {
    use rustix::net::sockopt;
    let told = |what: &str, why: &dyn std::fmt::Display| tracing::debug!("Modbus TCP: cannot set {what}: {why}");
    if let Err(why) = stream.set_nodelay(true) {
        told("TCP_NODELAY", &why);
    }
    let keepalive = sockopt::set_socket_keepalive(stream, true)
        .and_then(|()| sockopt::set_tcp_keepidle(stream, KEEPALIVE_IDLE))
        .and_then(|()| sockopt::set_tcp_keepintvl(stream, KEEPALIVE_INTERVAL))
        .and_then(|()| sockopt::set_tcp_keepcnt(stream, KEEPALIVE_PROBES));
    if let Err(why) = keepalive {
        told("TCP keepalive", &why);
    }
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

    #[test]
    fn networks() {
        let networks = ["127.0.0.0/8".parse().unwrap(), "fd00::/8".parse().unwrap()];
        for (ip, inside) in [
            ("127.9.9.9", true),
            ("10.0.0.1", false),
            ("fd12::1", true),
            ("::1", false),
        ] {
            assert_eq!(contains(&networks, ip.parse().unwrap()), inside, "{ip}");
        }
        let mapped: IpAddr = "::ffff:127.0.0.1".parse().unwrap();
        assert!(contains(&networks, mapped.to_canonical()));
    }
}
