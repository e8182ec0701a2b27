//! The clients of a world, as bytes and messages.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::order::Authority;
use drivegate_core::plant::{Placed, SharedPlant};
use drivegate_mqtt::Incoming;
use drivegate_north::NorthState;
use drivegate_north::modbus_tcp::{self, Uncached};
use drivegate_north::reading::Watch;

use super::scenario::Habit;

/// A client with the orders for which it waits.
pub struct Client {
    pub habit: Habit,
    pub next: Instant,
    pub way: Way,
    /// Number of orders that the client waits for.
    pub open: usize,
    /// Time before which the client sends nothing.
    pub silent_until: Instant,
    /// Bus and drive that the client commands for a while, and with how many more orders.
    pub burst: (usize, usize, u64),
}

pub enum Way {
    /// Orders given by the function that all north sides use.
    Plain(Vec<Waiting>),
    /// Over MQTT; the id in the result identifies the order.
    Mqtt(Box<drivegate_mqtt::Loopback>, Broker),
    /// Over Modbus TCP; the id of the transaction identifies the order.
    ModbusTcp(Box<modbus_tcp::Loopback>, BTreeMap<u16, usize>, u16),
}

/// An order that a client waits for.
pub struct Waiting {
    pub id: usize,
    pub placed: Placed,
    pub is_read: bool,
}

/// The broker between a client and the gateway, whose session outlives the connection.
#[derive(Default)]
pub struct Broker {
    /// Time until which the gateway is not connected.
    pub away_until: Option<Instant>,
    /// The last messages delivered, with the time and the number of the order: the broker repeats unacknowledged ones.
    pub delivered: VecDeque<(Instant, usize, Incoming)>,
    /// Messages that wait for the gateway to be back.
    pub waiting: u64,
}

impl Broker {
    /// Messages that may not be acknowledged when the connection breaks, and for how long.
    const UNACKNOWLEDGED: (usize, Duration) = (6, Duration::from_millis(300));

    pub fn deliver(&mut self, id: usize, message: &Incoming, now: Instant) {
        self.delivered.push_back((now, id, message.clone()));
        if self.delivered.len() > Broker::UNACKNOWLEDGED.0 {
            self.delivered.pop_front();
        }
    }

    /// Breaks the connection.
    pub fn lose(&mut self, now: Instant, until: Instant) {
        self.delivered.retain(|(at, ..)| now - *at < Broker::UNACKNOWLEDGED.1);
        self.away_until = Some(until);
    }

    /// Resumes the session; returns the messages that are delivered once more, marked as repetitions.
    pub fn resume(&mut self) -> Vec<(usize, Incoming)> {
        self.away_until = None;
        let again = |(_, id, message)| (id, Incoming { dup: true, ..message });
        self.delivered.drain(..).map(again).collect()
    }
}

/// The servers that all clients share.
pub struct Servers {
    plant: SharedPlant,
    modbus_tcp: modbus_tcp::Loopback,
}

impl Servers {
    pub fn new(plant: SharedPlant) -> Servers {
        let options = modbus_tcp::Options {
            listeners: Vec::new(),
            tls: None,
            max_connections: 64,
            max_connections_per_address: 64,
            idle_timeout: None,
            uncached: Uncached::Forward,
        };
        let stats = Arc::<NorthState>::default();
        let modbus_tcp = modbus_tcp::Loopback::new(options, plant.clone(), stats, address(250, 0), Authority::Write);
        Servers { plant, modbus_tcp }
    }

    /// Shows whether the thread runs that reads the connections.
    pub fn watch(&self) -> &Arc<Watch> {
        self.modbus_tcp.watch()
    }

    /// A connection of a Modbus TCP client. Connections of [`Habit::Shares`] belong to two clients, one of them
    /// with a certificate.
    pub fn connection(&self, habit: Habit, index: usize) -> modbus_tcp::Loopback {
        let (host, name) = match habit {
            Habit::Shares if index.is_multiple_of(2) => (251, Some("press")),
            Habit::Shares => (252, None),
            _ => (index as u8, None),
        };
        self.modbus_tcp
            .beside(address(host, index as u16), name, Authority::Write)
    }

    pub fn client(&self, index: usize, habit: Habit, now: Instant) -> Client {
        let way = match habit {
            Habit::Mqtt => {
                let gateway = drivegate_mqtt::Loopback::new("b", self.plant.clone(), now, SystemTime::UNIX_EPOCH);
                Way::Mqtt(Box::new(gateway), Broker::default())
            }
            Habit::ModbusTcp | Habit::StopsInALoop | Habit::Shares => {
                let client = self.connection(habit, index);
                Way::ModbusTcp(Box::new(client), BTreeMap::new(), 0)
            }
            Habit::Plain | Habit::Floods | Habit::Crowds | Habit::Duels | Habit::Operates | Habit::Steady => {
                Way::Plain(Vec::new())
            }
        };
        Client {
            habit,
            next: now + Duration::from_millis(1_500 + 37 * index as u64),
            way,
            open: 0,
            silent_until: now,
            burst: (0, 0, 0),
        }
    }
}

pub fn address(host: u8, connection: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, host], 40_000 + connection))
}

/// The frame of a write of one register.
pub fn write_frame(transaction: u16, unit: u8, address: u16, value: u16) -> Vec<u8> {
    let [t1, t2] = transaction.to_be_bytes();
    let [a1, a2] = address.to_be_bytes();
    let [v1, v2] = value.to_be_bytes();
    vec![t1, t2, 0, 0, 0, 6, unit, 6, a1, a2, v1, v2]
}

/// The transactions that `bytes` answer, each with its exception.
pub fn answers(mut bytes: &[u8]) -> Vec<(u16, Option<u8>)> {
    let mut answers = Vec::new();
    while bytes.len() > 7 {
        let length = usize::from(u16::from_be_bytes([bytes[4], bytes[5]])) + 6;
        let transaction = u16::from_be_bytes([bytes[0], bytes[1]]);
        let exception = (bytes[7] & 0x80 != 0).then(|| bytes[8]);
        answers.push((transaction, exception));
        bytes = &bytes[length..];
    }
    answers
}
