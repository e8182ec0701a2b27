//! A small MQTT broker inside the process, **for the demo only, never for production**: no authentication, no TLS, and
//! everything is kept in memory. In service, and in the tests of the gateway, the broker is a real one such as mosquitto.
//!
//! The broker serves MQTT 3.1.1 and 5.0 together: QoS 0 and 1, retained messages, wills, wildcards, the options of
//! a v5 subscription, keep alive, and take-over by a client with the same id. Response topic, correlation data,
//! content type, payload format and user properties reach the subscribers unchanged; message expiry counts down.
//! Not supported, and reported so to v5 clients: QoS 2 (a subscription is granted QoS 1), sessions that outlive
//! their connection, topic aliases, subscription identifiers, shared subscriptions.
//!
//! Everything in the broker is bounded, see the constants. A client that does not take its messages, or accepts no
//! byte for `STALL_LIMIT`, loses its connection. A malformed packet closes only the connection that it came from.

mod connection;
mod packet;
mod state;
mod topic;

use std::io;
use std::net::SocketAddr;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use state::State;

/// Maximum number of connections at a time, including those that have not sent CONNECT. Further connections are
/// closed at once.
const MAX_CONNECTIONS: usize = 128;
/// Largest packet taken from a client, bytes.
const MAX_PACKET_BYTES: usize = 256 * 1024;
/// Longest client id, bytes.
const MAX_CLIENT_ID_BYTES: usize = 256;
/// Maximum number of subscriptions of one client.
const MAX_SUBSCRIPTIONS: usize = 64;
/// Maximum number of retained messages. A further message is passed on but not retained, and the message that it would
/// replace is deleted.
const MAX_RETAINED_MESSAGES: usize = 5_000;
/// All retained messages together, bytes.
const MAX_RETAINED_BYTES: usize = 8 * 1024 * 1024;
/// Messages waiting for one client. Above [`MAX_RETAINED_MESSAGES`], so that `#` is served.
const MAX_QUEUE_MESSAGES: usize = 10_000;
/// Messages waiting for one client, bytes. Above [`MAX_RETAINED_BYTES`].
const MAX_QUEUE_BYTES: usize = 16 * 1024 * 1024;
/// QoS 1 messages sent to one client and not acknowledged.
const MAX_INFLIGHT: usize = 64;
/// Time limit for the client's CONNECT.
const CONNECT_LIMIT: Duration = Duration::from_secs(5);
/// Time for which a client may accept no byte while there is something to send.
const STALL_LIMIT: Duration = Duration::from_secs(10);
/// Time limit for sending the last packet to a client.
const FAREWELL_LIMIT: Duration = Duration::from_millis(50);
/// Pause after a failed accept, so that a lack of descriptors does not spin.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// A running broker. It ends by [`Broker::stop`], by its token, or when this value is dropped.
#[derive(Debug)]
pub struct Broker {
    address: SocketAddr,
    tasks: TaskTracker,
    stop: DropGuard,
}

/// The state that the tasks of the broker share.
#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    /// Number of connections so far.
    connections: AtomicU64,
    stop: CancellationToken,
}

impl Shared {
    /// Locks the state. A panic while the lock was held leaves consistent state: each step of a change leaves it
    /// consistent.
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Broker {
    /// Listens on `listen` and serves until `cancel`, within the runtime of the caller. Port 0 takes a free port,
    /// see [`Broker::local_addr`].
    ///
    /// # Errors
    /// If the address cannot be bound. The remedy is another port.
    pub async fn start(listen: SocketAddr, cancel: CancellationToken) -> io::Result<Broker> {
        let listener = TcpListener::bind(listen).await?;
        let address = listener.local_addr()?;
        let stop = cancel.child_token();
        let shared = Arc::new(Shared {
            state: Mutex::default(),
            connections: AtomicU64::new(1),
            stop: stop.clone(),
        });
        let tasks = TaskTracker::new();
        tasks.spawn(accept(shared, listener, tasks.clone()));
        Ok(Broker {
            address,
            tasks,
            stop: stop.drop_guard(),
        })
    }

    /// The address that clients connect to.
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Closes all connections, with a DISCONNECT to v5 clients, and the port; within a second.
    pub async fn stop(self) {
        drop(self.stop);
        self.tasks.close();
        self.tasks.wait().await;
    }
}

async fn accept(shared: Arc<Shared>, listener: TcpListener, tasks: TaskTracker) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let accepted = tokio::select! {
            () = shared.stop.cancelled() => return,
            accepted = listener.accept() => accepted,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::debug!(target: "drivegate::sim::broker", "cannot accept an MQTT connection: {error}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
            tracing::warn!(target: "drivegate::sim::broker", %peer, "MQTT connection closed: {MAX_CONNECTIONS} are open already");
            continue;
        };
        let shared = Arc::clone(&shared);
        tasks.spawn(async move {
            connection::serve(&shared, stream, peer).await;
            drop(place);
        });
    }
}
