//! When an order arrived, and over which connection. Pure.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::stalls::Stall;

/// A connection through which orders arrive: a TCP connection, a UDP socket, a pseudo-terminal, a connection to a
/// broker. Clones represent the same connection.
#[derive(Debug, Clone)]
pub struct Connection(Arc<ConnectionData>);

#[derive(Debug)]
struct ConnectionData {
    opened: Instant,
    gone: AtomicBool,
}

impl Connection {
    /// A connection that was opened at this time.
    pub fn opened(at: Instant) -> Connection {
        Connection(Arc::new(ConnectionData {
            opened: at,
            gone: AtomicBool::new(false),
        }))
    }

    /// When the connection was opened.
    pub fn opened_at(&self) -> Instant {
        self.0.opened
    }

    /// Marks that the client has closed or reset the connection.
    pub fn hang_up(&self) {
        self.0.gone.store(true, Ordering::Release);
    }

    /// Whether the client has closed or reset the connection.
    pub fn is_gone(&self) -> bool {
        self.0.gone.load(Ordering::Acquire)
    }
}

impl PartialEq for Connection {
    fn eq(&self, other: &Connection) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

/// How and when an order arrived.
#[derive(Debug, Clone, PartialEq)]
pub struct Arrival {
    /// Earliest time at which the first byte of the order may have arrived.
    pub asked: Instant,
    /// The connection over which the order arrived. The order in which clients wrote to several connections is not known.
    pub connection: Connection,
    /// The stall of the reading thread during which the first byte of the order may have arrived.
    pub stall: Option<Stall>,
    /// The last pause of the reading thread, while orders from before that pause may still arrive over old connections.
    pub pause: Option<Stall>,
}

impl Arrival {
    /// An order of the gateway itself, which arrived at `now` over a new connection.
    pub fn now(now: Instant) -> Arrival {
        Arrival::over(Connection::opened(now), now)
    }

    /// An order that arrived at `asked` over this connection, while its reader ran.
    pub fn over(connection: Connection, asked: Instant) -> Arrival {
        Arrival {
            asked,
            connection,
            stall: None,
            pause: None,
        }
    }

    /// This arrival for an order whose last byte arrived as `last`: a client that sends an order in two parts may
    /// have given up in between.
    #[must_use]
    pub fn completed(self, last: &Arrival) -> Arrival {
        Arrival {
            stall: last.stall.or(self.stall),
            pause: last.pause.or(self.pause),
            ..self
        }
    }
}
