//! Counters of the north sides, for the metrics.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Counters of all north sides.
#[derive(Debug, Default)]
pub struct NorthStats {
    /// Of the Modbus TCP server.
    pub modbus_tcp: ModbusTcpStats,
    /// Of the MQTT client.
    pub mqtt: MqttStats,
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

/// Why a Modbus TCP client was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConnectionRefusal {
    /// Its address is not in `allow`.
    NotAllowed,
    /// `max_connections` is reached.
    Full,
    /// `max_connections_per_address` is reached.
    AddressFull,
    /// The handshake failed: no certificate, an untrusted or expired one, a malformed role, or no TLS at all.
    Tls,
}

impl ConnectionRefusal {
    /// All reasons.
    pub const ALL: [ConnectionRefusal; 4] = [
        ConnectionRefusal::NotAllowed,
        ConnectionRefusal::Full,
        ConnectionRefusal::AddressFull,
        ConnectionRefusal::Tls,
    ];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            ConnectionRefusal::NotAllowed => "not_allowed",
            ConnectionRefusal::Full => "full",
            ConnectionRefusal::AddressFull => "address_full",
            ConnectionRefusal::Tls => "tls",
        }
    }
}

/// Counters of the Modbus TCP server.
#[derive(Debug, Default)]
pub struct ModbusTcpStats {
    connections: AtomicU64,
    refused_connections: [AtomicU64; ConnectionRefusal::ALL.len()],
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

    /// Counts a refused client.
    pub(crate) fn connection_refused(&self, why: ConnectionRefusal) {
        if let Some(counter) = self.refused_connections.get(why as usize) {
            counter.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Clients refused so far, by reason.
    pub fn refused_connections(&self) -> impl Iterator<Item = (ConnectionRefusal, u64)> {
        let counts = self.refused_connections.iter().map(|c| c.load(Ordering::Relaxed));
        ConnectionRefusal::ALL.into_iter().zip(counts)
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
    /// Whether the client is connected to the broker.
    pub connected: AtomicBool,
    /// Messages that the broker acknowledged.
    pub published: AtomicU64,
    /// Messages waiting for the broker.
    pub buffered: AtomicU64,
    lost: [AtomicU64; MqttLoss::ALL.len()],
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
