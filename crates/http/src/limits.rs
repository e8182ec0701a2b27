//! How many connections there are, and for how long.

use std::time::Duration;

use drivegate_north::connection_limit::Limits;

/// Maximum number of open connections. A connection whose request is incomplete, and one between two requests, yields to
/// a newer one.
pub const MAX_CONNECTIONS: usize = 128;

/// Maximum number of open event streams; each occupies a connection for a long time.
pub const MAX_LISTENERS: usize = 32;

/// Maximum number of open event streams of one address.
pub const MAX_LISTENERS_PER_ADDRESS: usize = 16;

/// Connections beyond the limits, which only serve `/healthz` and `/readyz`: these two answer whatever the other
/// connections do.
pub(super) const HEALTH: Limits = Limits {
    total: 8,
    reserved: 0,
    per_address: 4,
};

/// Time limit for the head of a request on a connection reserved for health checks.
pub(super) const HEALTH_HEAD_TIMEOUT: Duration = Duration::from_secs(5);

/// Time limit for the head of a request, counted from the start of the connection or from the previous reply. The
/// limit bounds slow senders and idle connections.
pub(super) const HEAD_TIMEOUT: Duration = Duration::from_secs(30);

/// Maximum length of the head of a request, bytes.
pub(super) const MAX_HEAD: usize = 16 * 1024;

/// Time after which a client that acknowledges nothing or accepts no bytes is disconnected.
pub(super) const USER_TIMEOUT: Duration = Duration::from_secs(30);

/// Time limit of a TLS handshake.
pub(super) const HANDSHAKE: Duration = Duration::from_secs(10);

/// Time for pending replies when the gateway stops, and for streams when a reload ends their connection.
pub(super) const GRACE: Duration = Duration::from_millis(500);

/// Time for the replies to commands after a reload has ended their connection: longer than any command waits for the bus.
pub(super) const ANSWERED_WITHIN: Duration = Duration::from_secs(60);
