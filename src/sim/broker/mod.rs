//! A small MQTT broker inside the process, **for the demo and for tests, never for production**: it
//! has no authentication, no TLS, and keeps everything in memory. The gateway in service talks to a
//! broker of its own right (mosquitto and the like).
//!
//! It serves MQTT 3.1.1 and 5.0 side by side, on the packet types of the client library:
//!
//! - QoS 0 and 1 both ways. A message published at QoS 2 is taken with the full handshake, once,
//!   and passed on at QoS 1 at most: every subscription is granted QoS 1 at most.
//! - Retained messages; retain handling, retain as published, no local and subscription identifiers
//!   of v5. Wildcards; no shared subscriptions.
//! - Wills, with delay. Keep alive at one and a half times its period. Take-over by a client with
//!   the same id: its predecessor's will is published first.
//! - The properties of a v5 message pass through. Message expiry counts down and is kept to for
//!   3.1.1 subscribers too. Topic aliases of clients are resolved; none are used to clients.
//! - Sessions that outlive their connection, until they expire or the broker ends: subscriptions,
//!   QoS 1 messages that wait or are unacknowledged (sent again, marked as duplicates), received
//!   QoS 2 identifiers.
//!
//! Everything is bounded, see the constants. A client that does not take its messages loses the
//! oldest QoS 0 ones first, then its connection; so does one that accepts no byte for
//! `STALL_LIMIT`. A malformed packet closes the connection it came from and nothing else.

mod connection;
mod packet;
mod session;
mod state;
mod topic;
mod v311;
mod v5;
mod wire;

use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use state::State;

/// Connections at a time, before CONNECT too; more are closed at once.
const MAX_CONNECTIONS: usize = 128;
/// Largest packet taken from a client, bytes.
const MAX_PACKET_BYTES: usize = 256 * 1024;
/// Sessions, connected or not; the one that was left first gives way. Above [`MAX_CONNECTIONS`].
const MAX_SESSIONS: usize = 256;
/// Longest client id, bytes.
const MAX_CLIENT_ID_BYTES: usize = 256;
/// Subscriptions of one client.
const MAX_SUBSCRIPTIONS: usize = 256;
/// Retained messages. One too many is passed on but not kept, nor is the one it would replace.
const MAX_RETAINED_MESSAGES: usize = 10_000;
/// All retained messages together, bytes.
const MAX_RETAINED_BYTES: usize = 16 * 1024 * 1024;
/// Messages waiting for one client. Above [`MAX_RETAINED_MESSAGES`], so that `#` is served.
const MAX_QUEUE_MESSAGES: usize = 20_000;
/// Messages waiting for one client, bytes. Above [`MAX_RETAINED_BYTES`].
const MAX_QUEUE_BYTES: usize = 32 * 1024 * 1024;
/// QoS 1 messages sent to one client and not acknowledged.
const MAX_INFLIGHT: usize = 64;
/// QoS 2 messages of one client between PUBLISH and PUBREL; QoS 1 is acknowledged at once.
const RECEIVE_MAXIMUM: u16 = 1024;
/// Topic aliases a client may set.
const MAX_TOPIC_ALIAS: u16 = 32;
/// Time a client has for its CONNECT.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// Time a client may accept no byte while there is something to send.
const STALL_LIMIT: Duration = Duration::from_secs(10);
/// Time the last words to a client may take; with it a stop stays below 200 ms.
const FAREWELL_LIMIT: Duration = Duration::from_millis(50);
/// Grain of delayed wills, session ends and retained expiry.
const TICK: Duration = Duration::from_millis(100);
/// Pause after a failed accept, so that a lack of descriptors does not spin.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// A running broker. It ends with [`Broker::stop`], with its token, or when it is dropped.
#[derive(Debug)]
pub struct Broker {
    address: SocketAddr,
    hub: Arc<Hub>,
    tasks: TaskTracker,
    _stop_on_drop: DropGuard,
}

/// What the tasks of the broker share.
#[derive(Debug)]
struct Hub {
    state: Mutex<State>,
    accepting: AtomicBool,
    places: Arc<Semaphore>,
    /// Cuts the connections of now; replaced when it was used.
    cut: Mutex<CancellationToken>,
    stop: CancellationToken,
}

impl Broker {
    /// Listens on `listen` and serves until `cancel`, within the runtime of the caller. Port 0 takes
    /// a free one, see [`Broker::local_addr`].
    ///
    /// # Errors
    /// The address cannot be bound: take another port.
    pub async fn start(listen: SocketAddr, cancel: CancellationToken) -> io::Result<Broker> {
        let listener = TcpListener::bind(listen).await?;
        let address = listener.local_addr()?;
        let stop = cancel.child_token();
        let hub = Arc::new(Hub::new(stop.clone()));
        let tasks = TaskTracker::new();
        tasks.spawn(accept(Arc::clone(&hub), listener, tasks.clone()));
        Ok(Broker {
            address,
            hub,
            tasks,
            _stop_on_drop: stop.drop_guard(),
        })
    }

    /// The address clients connect to.
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Closes all connections (v5 clients are told) and the port, within 200 ms.
    pub async fn stop(self) {
        self.hub.stop.cancel();
        self.tasks.close();
        self.tasks.wait().await;
    }

    /// Cuts all connections without a word, as a network that fails would: wills are published,
    /// sessions stay. New connections are taken if [`Broker::set_accepting`] allows.
    pub fn drop_connections(&self) {
        let used = std::mem::take(&mut *lock(&self.hub.cut));
        used.cancel();
    }

    /// Whether new connections are served (true from the start). Otherwise they are closed at once,
    /// before any answer; the port stays bound, so that nobody else takes it. Connections that are
    /// there stay.
    pub fn set_accepting(&self, accepting: bool) {
        self.hub.accepting.store(accepting, Ordering::SeqCst);
    }

    /// Number of clients that are connected, for tests that wait for one.
    pub fn clients(&self) -> usize {
        self.hub.state().clients()
    }

    /// Number of connected clients that are subscribed to the topic name `topic`, for tests that wait
    /// for one.
    pub fn subscribers(&self, topic: &str) -> usize {
        self.hub.state().subscribers(topic)
    }
}

impl Hub {
    fn new(stop: CancellationToken) -> Hub {
        Hub {
            state: Mutex::new(State::default()),
            accepting: AtomicBool::new(true),
            places: Arc::new(Semaphore::new(MAX_CONNECTIONS)),
            cut: Mutex::new(CancellationToken::new()),
            stop,
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Serves a new connection in a task of its own, if there is a place.
    fn admit(self: &Arc<Hub>, stream: TcpStream, peer: SocketAddr, tasks: &TaskTracker) {
        if !self.accepting.load(Ordering::SeqCst) {
            return;
        }
        let Ok(place) = Arc::clone(&self.places).try_acquire_owned() else {
            tracing::warn!(%peer, "connection closed: {MAX_CONNECTIONS} are open already");
            return;
        };
        let cut = lock(&self.cut).clone();
        let hub = Arc::clone(self);
        tasks.spawn(async move {
            connection::serve(&hub, stream, peer, cut).await;
            drop(place);
        });
    }
}

async fn accept(hub: Arc<Hub>, listener: TcpListener, tasks: TaskTracker) {
    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut failing = false;
    let mut resume_at = tokio::time::Instant::now();
    loop {
        let accepted = tokio::select! {
            () = hub.stop.cancelled() => return,
            _ = tick.tick() => {
                hub.state().tick(Instant::now());
                continue;
            }
            accepted = async {
                tokio::time::sleep_until(resume_at).await;
                listener.accept().await
            } => accepted,
        };
        match accepted {
            Ok((stream, peer)) => {
                failing = false;
                hub.admit(stream, peer, &tasks);
            }
            Err(error) => {
                if !failing {
                    tracing::warn!("cannot accept MQTT connections: {error}; trying again");
                }
                failing = true;
                resume_at = tokio::time::Instant::now() + ACCEPT_PAUSE;
            }
        }
    }
}

/// A panic while the lock was held leaves data that is still whole: every change is made of steps
/// that each keep it so.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
