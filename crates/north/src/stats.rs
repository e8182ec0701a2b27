//! Counters of the north sides, for the metrics.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use crate::link_status::LinkStatus;

/// How the last reload ended; the start of the gateway counts as a reload.
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

    /// Whether the last reload was applied, and when it ended.
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
    Http,
    /// The servers of the tool slots.
    Slot,
    /// The BACnet/IP server.
    Bacnet,
}

impl ServerKind {
    pub const ALL: [ServerKind; 4] = [
        ServerKind::ModbusTcp,
        ServerKind::Http,
        ServerKind::Slot,
        ServerKind::Bacnet,
    ];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            ServerKind::ModbusTcp => "modbus_tcp",
            ServerKind::Http => "http",
            ServerKind::Slot => "slot",
            ServerKind::Bacnet => "bacnet",
        }
    }

    /// Name in messages.
    pub fn title(self) -> &'static str {
        match self {
            ServerKind::ModbusTcp => "Modbus TCP",
            ServerKind::Http => "HTTP",
            ServerKind::Slot => "tool slot",
            ServerKind::Bacnet => "BACnet/IP",
        }
    }
}

/// Why a connection was refused, or closed in favour of another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ConnectionRefusal {
    /// The address of the client is not in `allow`.
    NotAllowed,
    /// The server has its maximum number of connections.
    Full,
    /// The address of the client has its maximum number of connections.
    AddressFull,
    /// The connection was closed in favour of another one.
    Displaced,
    /// The handshake failed: no certificate, an untrusted or expired one, a malformed role, or no TLS at all.
    Tls,
}

impl ConnectionRefusal {
    /// All reasons why a connection is refused.
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

/// Counters of the Modbus TCP server.
#[derive(Debug, Default)]
pub struct ModbusTcpStats {
    connections: AtomicU64,
    requests: [[AtomicU64; OUTCOMES.len() + 1]; FUNCTIONS.len() + 1],
}

impl ModbusTcpStats {
    /// Counts a client that connected.
    pub fn connected(&self) {
        self.connections.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a client that disconnected.
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

/// Figures of the BACnet server, while it runs.
#[derive(Debug, Default)]
pub struct BacnetStats(Mutex<Option<BacnetFigures>>);

/// Counters of the BACnet server, and the result of its registration.
#[derive(Debug, Clone)]
pub struct BacnetFigures {
    /// Counters since the server was started.
    pub counters: drivegate_bacnet::Counters,
    /// The configured BBMD, and whether it accepted the registration for broadcasts.
    pub bbmd: Option<(String, drivegate_bacnet::Registration)>,
}

impl BacnetStats {
    /// Sets the server's figures; `None` when the server ends.
    pub(crate) fn set(&self, figures: Option<BacnetFigures>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = figures;
    }

    /// The last figures of the server.
    pub fn get(&self) -> Option<BacnetFigures> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Why the BACnet server makes the gateway not ready.
    pub(crate) fn reason(&self) -> Option<String> {
        use drivegate_bacnet::Registration;
        let (bbmd, registration) = self.get()?.bbmd?;
        match registration {
            Registration::Refused(code) => Some(format!(
                "BACnet/IP: the BBMD {bbmd} refuses the registration with code {code:#06x}; retrying"
            )),
            Registration::Unanswered => Some(format!("BACnet/IP: the BBMD {bbmd} does not reply; retrying")),
            Registration::None | Registration::Registered => None,
        }
    }
}

/// How a request of a tool ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum SlotOutcome {
    /// The drive's reply was passed on; a broadcast was sent.
    Answered,
    /// The drive refused the request.
    Exception,
    /// The gateway refused the request.
    Refused,
    /// There was no reply to pass on: the drive is silent or offline, or the request was not sent.
    NoAnswer,
    /// The tool sent another request before the reply.
    Abandoned,
    /// No reply arrived within a second.
    Late,
    /// The bytes were not a valid frame.
    Broken,
}

impl SlotOutcome {
    pub const ALL: [SlotOutcome; 7] = [
        SlotOutcome::Answered,
        SlotOutcome::Exception,
        SlotOutcome::Refused,
        SlotOutcome::NoAnswer,
        SlotOutcome::Abandoned,
        SlotOutcome::Late,
        SlotOutcome::Broken,
    ];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            SlotOutcome::Answered => "answered",
            SlotOutcome::Exception => "exception",
            SlotOutcome::Refused => "refused",
            SlotOutcome::NoAnswer => "no_answer",
            SlotOutcome::Abandoned => "abandoned",
            SlotOutcome::Late => "late",
            SlotOutcome::Broken => "broken",
        }
    }
}

/// Counters of the tool slots, by bus.
#[derive(Debug, Default)]
pub struct SlotStats(Mutex<BTreeMap<String, [u64; SlotOutcome::ALL.len()]>>);

impl SlotStats {
    /// Counts a request of a tool.
    pub fn count(&self, bus: &str, outcome: SlotOutcome) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if !all.contains_key(bus) {
            all.insert(bus.to_string(), Default::default());
        }
        if let Some(counter) = all.get_mut(bus).and_then(|counts| counts.get_mut(outcome as usize)) {
            *counter += 1;
        }
    }

    /// Requests so far by bus and outcome, without zeros.
    pub fn requests(&self) -> Vec<(String, SlotOutcome, u64)> {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let of_bus = |(bus, counts): (&String, &[u64; SlotOutcome::ALL.len()])| {
            let named = SlotOutcome::ALL.into_iter().zip(*counts);
            let bus = bus.clone();
            named
                .filter(|(_, count)| *count > 0)
                .map(move |(outcome, count)| (bus.clone(), outcome, count))
        };
        all.iter().flat_map(of_bus).collect()
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
    /// Links of the clients to their brokers.
    pub plain: Arc<LinkStatus>,
    pub sparkplug: Arc<LinkStatus>,
    lost: [AtomicU64; MqttKind::ALL.len()],
}

/// A kind of message that the MQTT client keeps until the broker has received it; dropped messages are counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MqttKind {
    Event,
    /// Results of commands are lost.
    Result,
    /// Values of an outage are lost.
    History,
}

impl MqttKind {
    /// All kinds of kept messages.
    pub const ALL: [MqttKind; 3] = [MqttKind::Event, MqttKind::Result, MqttKind::History];

    /// Name in the metrics.
    pub fn name(self) -> &'static str {
        match self {
            MqttKind::Event => "event",
            MqttKind::Result => "result",
            MqttKind::History => "history",
        }
    }
}

impl MqttStats {
    /// Adds to the count of lost messages.
    pub fn lost(&self, kind: MqttKind, count: u64) {
        if let Some(counter) = self.lost.get(kind as usize) {
            counter.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// Number of messages lost so far, for each kind.
    pub fn losses(&self) -> impl Iterator<Item = (MqttKind, u64)> {
        let counts = self.lost.iter().map(|c| c.load(Ordering::Relaxed));
        MqttKind::ALL.into_iter().zip(counts)
    }
}
