//! MQTT client.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

/// A secret that does not show in logs.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(pub String);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("(secret)")
    }
}

/// What the MQTT client is told.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Host of the broker.
    pub host: String,
    /// Port of the broker.
    pub port: u16,
    /// TLS (`mqtts://`).
    pub tls: bool,
    /// Client id.
    pub client_id: String,
    /// User name, with password.
    pub username: Option<String>,
    /// Password.
    pub password: Option<Secret>,
    /// CA certificates (PEM) for the broker; the system's when absent.
    pub ca: Option<PathBuf>,
    /// Client certificate chain and key (PEM).
    pub identity: Option<(PathBuf, PathBuf)>,
    /// First level of all topics.
    pub base: String,
    /// Least time between two publications of a topic.
    pub min_interval: Duration,
    /// Most time between two publications of a topic.
    pub max_interval: Duration,
    /// Whether the set topics are served.
    pub commands: bool,
    /// Where events are kept while the broker is away, and how many bytes; in memory only when absent.
    pub buffer: Option<Buffer>,
}

/// Disk buffer for events.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Buffer {
    /// Directory.
    pub dir: PathBuf,
    /// Most bytes on disk.
    pub max_bytes: u64,
}
