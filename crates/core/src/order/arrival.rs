//! When an order came, and over which connection. Pure.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// A connection of a client, unique in the life of the process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ConnectionId(u64);

impl ConnectionId {
    /// A connection that no other order came over.
    pub fn next() -> ConnectionId {
        static LAST: AtomicU64 = AtomicU64::new(0);
        ConnectionId(LAST.fetch_add(1, Ordering::Relaxed))
    }
}

/// When an order came, and over which connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// The date of its first byte: no later than the moment at which it came.
    pub asked: Instant,
    /// Over which connection.
    pub connection: ConnectionId,
    /// When that connection was opened.
    pub connected: Instant,
}

impl Arrival {
    /// An order of the gateway itself, or one whose first byte came just now over a connection of its own.
    pub fn now(now: Instant) -> Arrival {
        Arrival {
            asked: now,
            connection: ConnectionId::next(),
            connected: now,
        }
    }

    /// The same order, whose first byte came at `asked`.
    #[must_use]
    pub fn asked(self, asked: Instant) -> Arrival {
        Arrival { asked, ..self }
    }
}
