//! The clients of a world, as bytes and messages.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate::command::Authority;
use drivegate::north::modbus_tcp::{self, Uncached};
use drivegate::north::{NorthStats, mqtt};
use drivegate::plant::{Placed, SharedPlant};

use super::scenario::Habit;

/// A client with what it waits for.
pub struct Client {
    pub habit: Habit,
    pub next: Instant,
    pub way: Way,
    /// Orders that it waits for.
    pub open: usize,
    /// Nothing comes from it before then.
    pub silent_until: Instant,
}

pub enum Way {
    /// Orders given by the function that all north sides use; the number of each and what it waits with.
    Plain(Vec<(usize, Placed)>),
    /// By the id in the result.
    Mqtt(Box<mqtt::Offline>),
    /// By the id of the transaction.
    ModbusTcp(Box<modbus_tcp::Offline>, BTreeMap<u16, usize>, u16),
}

/// Everything that all clients share.
pub struct Servers {
    plant: SharedPlant,
    modbus_tcp: modbus_tcp::Offline,
}

impl Servers {
    pub fn new(plant: SharedPlant) -> Servers {
        let options = modbus_tcp::Options {
            listeners: Vec::new(),
            tls: None,
            max_connections: 64,
            max_connections_per_address: None,
            idle_timeout: None,
            uncached: Uncached::Forward,
        };
        let stats = Arc::<NorthStats>::default();
        let modbus_tcp = modbus_tcp::Offline::new(options, plant.clone(), stats, address(250), Authority::Write);
        Servers { plant, modbus_tcp }
    }

    pub fn client(&self, index: usize, habit: Habit, now: Instant) -> Client {
        let way = match habit {
            Habit::Mqtt => Way::Mqtt(Box::new(mqtt::Offline::new(
                "b",
                self.plant.clone(),
                now,
                SystemTime::UNIX_EPOCH,
            ))),
            Habit::ModbusTcp | Habit::StopsInALoop => {
                let client = self.modbus_tcp.beside(address(index as u8), Authority::Write);
                Way::ModbusTcp(Box::new(client), BTreeMap::new(), 0)
            }
            Habit::Plain | Habit::Floods | Habit::Steady => Way::Plain(Vec::new()),
        };
        Client {
            habit,
            next: now + Duration::from_millis(1_500 + 37 * index as u64),
            way,
            open: 0,
            silent_until: now,
        }
    }
}

fn address(host: u8) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, host], 40_000))
}

/// The frame of a write of one register.
pub fn write_frame(transaction: u16, unit: u8, address: u16, value: u16) -> Vec<u8> {
    let [t1, t2] = transaction.to_be_bytes();
    let [a1, a2] = address.to_be_bytes();
    let [v1, v2] = value.to_be_bytes();
    vec![t1, t2, 0, 0, 0, 6, unit, 6, a1, a2, v1, v2]
}

/// The transactions that are answered by `bytes`, each with its exception.
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
