//! Counters of the north sides, for the metrics.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

/// Counters of all north sides.
#[derive(Debug, Default)]
pub struct NorthStats {
    /// Of the Modbus TCP server.
    pub modbus_tcp: ModbusTcpStats,
    /// Of the MQTT client.
    pub mqtt: MqttStats,
    /// Refused connections of all servers.
    pub refused: RefusalStats,
    /// Listeners that do not work.
    pub lost_listeners: LostListeners,
    /// The last time the configuration was read.
    pub reload: ReloadStats,
}

/// How the last reload ended; the start counts as one.
#[derive(Debug)]
pub struct ReloadStats(Mutex<(bool, SystemTime)>);

impl Default for ReloadStats {
    fn default() -> ReloadStats {
        ReloadStats(Mutex::new((true, SystemTime::now())))
    }
}

impl ReloadStats {
    /// A reload was applied, or refused, at `at`.
    pub fn ended(&self, applied: bool, at: SystemTime) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = (applied, at);
    }

    /// Whether the last one was applied, and when it ended.
    pub fn last(&self) -> (bool, SystemTime) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

const FUNCTIONS: [u8; 11] = [1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 43];
const OUTCOMES: [(u8, &str); 8] = [
    (0x00, "ok"),
    (0x01, "illegal_function"),
    (0x02, "illegal_address"),
    (0x03, "illegal_value"),
    (0x04, "device_failure"),
    (0x06, "busy"),
    (0x0A, "no_path"),
    (0x0B, "no_answer"),
];
const OTHER: &str = "other";

/// The servers that refuse connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerKind {
    /// Modbus TCP, with and without TLS.
    ModbusTcp,
    /// HTTP.
    Http,
}

impl ServerKind {
    /// All servers.
    pub const ALL: [ServerKind; 2] = [ServerKind::ModbusTcp, ServerKind::Http];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            ServerKind::ModbusTcp => "modbus_tcp",
            ServerKind::Http => "http",
        }
    }

    /// Name in messages.
    pub fn title(self) -> &'static str {
        match self {
            ServerKind::ModbusTcp => "Modbus TCP",
            ServerKind::Http => "HTTP",
        }
    }
}

/// Why a connection was refused, or closed in favour of another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConnectionRefusal {
    /// Its address is not in `allow`.
    NotAllowed,
    /// The server has as many connections as it may have.
    Full,
    /// Its address has as many connections as it may have.
    AddressFull,
    /// It was closed in favour of another connection.
    Displaced,
    /// The handshake failed: no certificate, an untrusted or expired one, a malformed role, or no TLS at all.
    Tls,
}

impl ConnectionRefusal {
    /// All reasons.
    pub const ALL: [ConnectionRefusal; 5] = [
        ConnectionRefusal::NotAllowed,
        ConnectionRefusal::Full,
        ConnectionRefusal::AddressFull,
        ConnectionRefusal::Displaced,
        ConnectionRefusal::Tls,
    ];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            ConnectionRefusal::NotAllowed => "not_allowed",
            ConnectionRefusal::Full => "full",
            ConnectionRefusal::AddressFull => "address_full",
            ConnectionRefusal::Displaced => "displaced",
            ConnectionRefusal::Tls => "tls",
        }
    }
}

/// Counters of refused connections.
#[derive(Debug, Default)]
pub struct RefusalStats([[AtomicU64; ConnectionRefusal::ALL.len()]; ServerKind::ALL.len()]);

impl RefusalStats {
    /// Counts a refused connection.
    pub(crate) fn add(&self, server: ServerKind, why: ConnectionRefusal) {
        if let Some(counter) = self.0.get(server as usize).and_then(|row| row.get(why as usize)) {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Connections to `server` that were refused so far, by reason.
    pub fn of(&self, server: ServerKind) -> impl Iterator<Item = (ConnectionRefusal, u64)> {
        let row = self.0.get(server as usize).into_iter().flatten();
        ConnectionRefusal::ALL
            .into_iter()
            .zip(row.map(|c| c.load(Ordering::Relaxed)))
    }
}

/// Listeners whose socket is lost, by server and address, with the reason.
#[derive(Debug, Default)]
pub struct LostListeners(Mutex<BTreeMap<(&'static str, SocketAddr), String>>);

impl LostListeners {
    /// The listener of `server` at `address` is lost for this reason, or works again.
    pub(crate) fn set(&self, server: ServerKind, address: SocketAddr, reason: Option<String>) {
        let mut lost = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (server.title(), address);
        match reason {
            Some(reason) => drop(lost.insert(key, reason)),
            None => drop(lost.remove(&key)),
        }
    }

    /// One line per lost listener.
    pub fn reasons(&self) -> Vec<String> {
        let lost = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let line = |((server, address), why): (&(&str, SocketAddr), &String)| {
            format!("{server} does not listen on {address}: {why}; retrying")
        };
        lost.iter().map(line).collect()
    }
}

/// Counters of the Modbus TCP server.
#[derive(Debug, Default)]
pub struct ModbusTcpStats {
    connections: AtomicU64,
    requests: [[AtomicU64; OUTCOMES.len() + 1]; FUNCTIONS.len() + 1],
}

impl ModbusTcpStats {
    /// A client connected.
    pub fn connected(&self) {
        self.connections.fetch_add(1, Ordering::Relaxed);
    }

    /// A client disconnected.
    pub(crate) fn disconnected(&self) {
        self.connections.fetch_sub(1, Ordering::Relaxed);
    }

    /// Clients connected now.
    pub fn connections(&self) -> u64 {
        self.connections.load(Ordering::Relaxed)
    }

    /// Counts an answer; `exception` is 0 for a regular one.
    pub fn answered(&self, function: u8, exception: u8) {
        let row = FUNCTIONS.iter().position(|f| *f == function).unwrap_or(FUNCTIONS.len());
        let column = OUTCOMES
            .iter()
            .position(|(code, _)| *code == exception)
            .unwrap_or(OUTCOMES.len());
        if let Some(counter) = self.requests.get(row).and_then(|r| r.get(column)) {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Answers so far by function and outcome, without zeros.
    pub fn requests(&self) -> Vec<(String, &'static str, u64)> {
        let functions = FUNCTIONS.iter().map(u8::to_string).chain([OTHER.to_string()]);
        let mut all = Vec::new();
        for (function, row) in functions.zip(&self.requests) {
            let outcomes = OUTCOMES.iter().map(|(_, name)| *name).chain([OTHER]);
            for (outcome, counter) in outcomes.zip(row) {
                let count = counter.load(Ordering::Relaxed);
                if count > 0 {
                    all.push((function.clone(), outcome, count));
                }
            }
        }
        all
    }
}

/// Counters of the MQTT client.
#[derive(Debug, Default)]
pub struct MqttStats {
    /// Whether a broker is configured: a client runs.
    pub configured: AtomicBool,
    /// Whether the client is connected to the broker.
    pub connected: AtomicBool,
    /// Messages that the broker acknowledged.
    pub published: AtomicU64,
    /// Messages waiting for the broker.
    pub buffered: AtomicU64,
    lost: [AtomicU64; MqttLoss::ALL.len()],
    /// The retained topics of the client that runs, for the one that a reload puts in its place.
    retained: Mutex<Vec<String>>,
}

/// What the MQTT client lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MqttLoss {
    /// Events.
    Event,
    /// Results of commands.
    Result,
    /// Values of an outage.
    History,
}

impl MqttLoss {
    /// All kinds.
    pub const ALL: [MqttLoss; 3] = [MqttLoss::Event, MqttLoss::Result, MqttLoss::History];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            MqttLoss::Event => "event",
            MqttLoss::Result => "result",
            MqttLoss::History => "history",
        }
    }
}

impl MqttStats {
    /// Keeps the retained topics that are published; returns those kept before.
    pub(crate) fn keep_retained(&self, topics: Vec<String>) -> Vec<String> {
        let mut kept = self.retained.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut kept, topics)
    }

    /// Counts lost messages.
    pub(crate) fn lost(&self, kind: MqttLoss, count: u64) {
        if let Some(counter) = self.lost.get(kind as usize) {
            counter.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// Messages lost so far, by kind.
    pub fn losses(&self) -> impl Iterator<Item = (MqttLoss, u64)> {
        let counts = self.lost.iter().map(|c| c.load(Ordering::Relaxed));
        MqttLoss::ALL.into_iter().zip(counts)
    }
}
