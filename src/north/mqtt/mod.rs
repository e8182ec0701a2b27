//! MQTT client (`docs/mqtt.md`).
//!
//! ```text
//! process image ──▶ publisher ──▶ ┌────────┐     connection        ┌────────┐
//! events ──▶ journal (on disk) ─▶ │ outbox │ ──▶ (rumqttc, a task  │ broker │
//! results ──────────────────────▶ └────────┘     of its own) ────▶ └────────┘
//!                commands ◀──────────────────────── set topics ◀──────┘
//! ```
//!
//! `payload`, `publisher`, `commands`, `reply` and `outbox` have no I/O: they decide what is published, when, and in which
//! order; `offline` drives `commands` without a broker. `client` is the task that owns them. `connection` wraps rumqttc,
//! which keeps no state: every connection is a new client with a clean session, and unacknowledged messages are sent again
//! from the outbox.

mod client;
mod commands;
mod connection;
#[cfg(test)]
mod fixture;
mod journal;
mod offline;
mod outbox;
mod payload;
mod publisher;
mod reply;
mod request;
mod store;
mod tls;

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::NorthStats;
use crate::plant::SharedPlant;

pub use self::journal::whole_records;
pub use self::offline::{Offline, Published};
pub use self::request::Incoming;
pub(super) use self::request::resolve as point_value;

/// A secret that is not printed in logs.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(pub String);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("(secret)")
    }
}

/// Configuration of the MQTT client.
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
    /// CA certificates (PEM) for the broker; those of the system if absent.
    pub ca: Option<PathBuf>,
    /// Client certificate chain and key (PEM).
    pub identity: Option<(PathBuf, PathBuf)>,
    /// First level of all topics.
    pub base: String,
    /// Minimum time between two publications of a topic.
    pub min_interval: Duration,
    /// Maximum time between two publications of a topic.
    pub max_interval: Duration,
    /// Whether the set topics are served.
    pub commands: bool,
    /// Disk buffer for events while the broker is not connected; in memory only if absent.
    pub buffer: Option<Buffer>,
}

/// Disk buffer for events.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Buffer {
    /// Directory.
    pub dir: PathBuf,
    /// Maximum size on disk, bytes.
    pub max_bytes: u64,
}

/// The running MQTT client.
#[derive(Debug)]
pub struct Mqtt(JoinHandle<()>);

impl Mqtt {
    /// Waits until the client has ended: at most about half a second after the cancellation, in which it publishes
    /// `offline` and disconnects.
    pub async fn stopped(self) {
        if let Err(error) = self.0.await {
            tracing::error!("the MQTT client ended unexpectedly: {error}");
        }
    }
}

/// Starts the MQTT client; must be called within a Tokio runtime. It reconnects until it is cancelled. Events that are
/// raised from now on are published, so start it before the buses.
pub fn start(options: Options, plant: SharedPlant, stats: Arc<NorthStats>, cancel: CancellationToken) -> Mqtt {
    // Subscribed here and not in the task, so that no event after this call is missed.
    let events = plant.load().events.subscribe();
    Mqtt(tokio::spawn(client::run(options, plant, stats, events, cancel)))
}
