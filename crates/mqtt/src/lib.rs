//! MQTT client (`docs/mqtt.md`).
//!
//! ```text
//! process image ──▶ publisher ──▶ ┌────────┐     connection        ┌────────┐
//! events, history ──▶ store ────▶ │ outbox │ ──▶ (rumqttc, a task  │ broker │
//! results ──────────────────────▶ └────────┘     of its own) ────▶ └────────┘
//!                       │ ▲                                            │
//!               message log (a thread, on disk)                        │
//!                commands ◀──────────────────────── set topics ◀──────┘
//! ```
//!
//! `payload`, `publisher`, `rounds`, `history`, `home_assistant`, `commands`, `reply` and `outbox` have no I/O:
//! they decide what is published, when, and in which order; `loopback` drives `commands` without a broker.
//! `broker_limits`, `keep_alive`, `retry` and `takeover` judge the behaviour of the broker, also without I/O;
//! `back_off` chooses the broker. `client` owns all of these. `sparkplug` is a separate client with a separate
//! link. `session` is the loop of both clients: it connects, reconnects, follows reloads and disconnects. `link` is
//! the way to one of the brokers: it owns the `connection`, which wraps rumqttc and keeps no state: every
//! connection is a new rumqttc client with a clean session, and unacknowledged messages are sent again from the
//! outbox. `reasons` has the texts for a lost connection; `LinkStatus` of `drivegate_north` shows them. `handover` keeps the state that a client leaves for the one after a reload.
//! `number` has the number of a message, the same on disk, in the store and in the outbox; packet ids belong to one connection.

mod back_off;
mod broker_limits;
mod client;
mod commands;
mod connection;
mod dial;
mod earlier_names;
#[cfg(test)]
mod fixture;
mod handover;
mod history;
mod home_assistant;
mod keep_alive;
mod link;
mod loopback;
mod message_log;
mod number;
mod outage_log;
mod outbox;
mod password;
mod payload;
mod publisher;
mod rate;
mod reasons;
mod record;
mod reply;
mod request;
mod retry;
mod rights;
mod rounds;
mod session;
pub mod sparkplug;
mod store;
mod takeover;
mod topics;
mod trail;

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout_at};
use tokio_util::sync::CancellationToken;

use drivegate_core::plant::SharedPlant;
use drivegate_north::{NorthState, Server, ServerError};

pub use self::handover::Handover;
pub use self::loopback::{Loopback, Published};
pub use self::record::whole_records;
pub use self::request::Incoming;

pub use self::password::{Password, Secret, SecretFault};

/// Address of a broker.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Broker {
    /// Host; an IPv6 address with or without brackets.
    pub host: String,
    pub port: u16,
    /// Path of MQTT over WebSocket, beginning with `/`; `None` for plain TCP.
    pub path: Option<String>,
}

impl fmt::Display for Broker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.bare_host() {
            host if host.contains(':') => write!(f, "[{host}]:{}", self.port),
            host => write!(f, "{host}:{}", self.port),
        }
    }
}

impl Broker {
    /// The host, an IPv6 address without brackets.
    fn bare_host(&self) -> &str {
        self.host.trim_start_matches('[').trim_end_matches(']')
    }
}

/// Configuration of the MQTT client.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The brokers in the order in which they are tried; at least one.
    pub brokers: Vec<Broker>,
    /// Whether all brokers are reached with TLS (`mqtts://`).
    pub tls: bool,
    pub client_id: String,
    /// User name with its password.
    pub username: Option<String>,
    pub password: Option<Password>,
    /// Host and port of an HTTP proxy, by whose CONNECT all brokers are reached.
    pub proxy: Option<(String, u16)>,
    /// Maximum number of messages per second that each connection publishes; 0 sets no limit.
    pub publish_limit: usize,
    /// CA certificates (PEM) for the broker; if absent, the certificates of the system.
    pub ca: Option<PathBuf>,
    /// Client certificate chain and key (PEM).
    pub identity: Option<(PathBuf, PathBuf)>,
    /// First level of all topics.
    pub base: String,
    /// The telemetry that is published.
    pub telemetry: Telemetry,
    /// Quality of service of telemetry.
    pub telemetry_qos: Qos,
    /// Quality of service of events and history.
    pub event_qos: Qos,
    /// Whether messages are retained. If not, no message is retained, not even the last will.
    pub retain: bool,
    /// Time after which the broker drops telemetry; never if absent.
    pub expiry: Option<Duration>,
    /// Time after which a broker drops the status `online`, and telemetry at the latest, unless it is renewed; never if absent.
    pub message_expiry: Option<Duration>,
    /// Minimum time between two publications of a topic.
    pub min_interval: Duration,
    /// Maximum time between two publications of a topic.
    pub max_interval: Duration,
    /// Whether the set topics are served.
    pub commands: bool,
    /// Commands without an `id` are refused, except stops.
    pub require_id: bool,
    /// Filters of response topics that are allowed in addition to those outside of `base`.
    pub response_topics: Vec<String>,
    /// The topic levels `as/WHO` of principals; `None` if `[authority]` is off.
    pub principals: Option<Vec<String>>,
    /// Disk buffer for events and history while the broker is not connected; in memory only if absent.
    pub buffer: Option<Buffer>,
    /// Discovery prefix of Home Assistant; no discovery if absent.
    pub home_assistant: Option<String>,
    /// The gateway as an edge node of Sparkplug B.
    pub sparkplug: Option<sparkplug::Options>,
}

/// The telemetry that is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Telemetry {
    /// The state of each drive as one object.
    pub state: bool,
    /// Each point as a bare value.
    pub points: bool,
    /// Which values of an outage are published afterwards.
    pub history: History,
}

/// MQTT quality of service of published messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Qos {
    /// QoS 0: sent once, not acknowledged.
    AtMostOnce,
    /// QoS 1: a message is sent until the broker acknowledges it.
    AtLeastOnce,
}

/// Which values of an outage are published afterwards.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum History {
    /// No values of an outage are published.
    #[default]
    Off,
    /// Only values that changed.
    Changes,
    /// The values of every sample are published.
    All,
}

/// Buffer for messages on disk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Buffer {
    /// Directory of the buffer.
    pub dir: PathBuf,
    /// Maximum size on disk, bytes.
    pub max_bytes: u64,
}

impl Buffer {
    /// The default: a buffer in a systemd service with a state directory, elsewhere no buffer.
    fn of_system() -> Option<Buffer> {
        let dirs = std::env::var_os("STATE_DIRECTORY")?;
        let dir = std::env::split_paths(&dirs).next()?;
        Some(Buffer {
            dir,
            max_bytes: 64 << 20,
        })
    }
}

/// Part of [`Server::STOP_TIMEOUT`] for the end of a client that is aborted.
const ABORT: Duration = Duration::from_millis(100);

/// The running MQTT client.
#[derive(Debug, Default)]
pub struct Mqtt {
    tasks: Vec<JoinHandle<()>>,
    /// Options that the client runs with, and where the rights of its clients are.
    rights: Option<(Options, Arc<NorthState>)>,
}

impl Server for Mqtt {
    const NAME: &'static str = "MQTT";
    // The commands in progress are finished first, because the broker would treat the successor as another client.
    const STOP_TIMEOUT: Duration = Duration::from_secs(6);
    type Options = Options;

    async fn start(
        options: Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
    ) -> Result<Mqtt, ServerError> {
        Ok(start(options, plant, stats, cancel))
    }

    fn end_rights(&self, next: Option<&Options>) {
        if let Some((options, stats)) = &self.rights {
            Handover::of(stats).rights.reload(options, next);
        }
    }

    /// Waits for the end of the clients: they finish the commands in progress, publish `offline` and disconnect. A client
    /// that takes too long is aborted, so that it changes nothing when its successor runs.
    async fn stopped(mut self) {
        let until = Instant::now() + Self::STOP_TIMEOUT - ABORT;
        for task in &mut self.tasks {
            match timeout_at(until, &mut *task).await {
                Ok(Ok(())) => {}
                Ok(Err(error)) => {
                    tracing::error!(target: "drivegate::north::mqtt", "the MQTT client ended unexpectedly: {error}");
                }
                Err(_) => {
                    tracing::warn!(target: "drivegate::north::mqtt", "the MQTT client did not end in time and is aborted");
                    task.abort();
                    // The task has ended when this returns.
                    let _ = task.await;
                }
            }
        }
    }
}

impl Drop for Mqtt {
    fn drop(&mut self) {
        self.tasks.iter().for_each(JoinHandle::abort);
    }
}

/// Starts the MQTT client; must be called within a Tokio runtime. The client reconnects until it is cancelled. It
/// publishes the events that are raised from now on or were left by the previous client, so it must be started
/// before the buses.
pub fn start(mut options: Options, plant: SharedPlant, stats: Arc<NorthState>, cancel: CancellationToken) -> Mqtt {
    options.buffer = options.buffer.or_else(Buffer::of_system);
    // The subscription happens here and not in the task, so that no event after this call is missed. Events left by
    // the previous client come first.
    let handover = Handover::of(&stats);
    let (topics, hosts) = handover.rights.begin(&options);
    let kept = options.clone();
    let events = plant.load().events.subscribe();
    // The state is taken over here as well: state that no client has taken when this returns is discarded.
    let (unread, of_client, of_node) = {
        let mut left = handover.lock();
        (
            left.unread.take(),
            std::mem::take(&mut left.client),
            std::mem::take(&mut left.node),
        )
    };
    let events = unread.filter(|unread| unread.same_channel(&events)).unwrap_or(events);
    let node = options.sparkplug.clone().map(|node| {
        let broker = options.clone();
        tokio::spawn(sparkplug::run(
            node,
            (broker, hosts, of_node),
            plant.clone(),
            stats.clone(),
            cancel.clone(),
        ))
    });
    let client = tokio::spawn(client::run(
        options,
        topics,
        of_client,
        plant,
        stats.clone(),
        events,
        cancel,
    ));
    Mqtt {
        tasks: [client].into_iter().chain(node).collect(),
        rights: Some((kept, stats)),
    }
}
