//! State that a client leaves to the client that replaces it at a reload.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use tokio::sync::broadcast::Receiver;

use super::Broker;
use super::commands::OrdersLeft;
use super::earlier_names::EarlierNames;
use super::rights::BrokerRights;
use super::sparkplug::NodeOrdersLeft;
use super::store::Writer;
use drivegate_core::event::Event;
use drivegate_core::plant::Plant;
use drivegate_north::NorthState;
use drivegate_north::command_json::SharedMemory;

/// State of the clients of a gateway that outlives them.
#[derive(Debug, Default)]
pub struct Handover {
    /// State that the last clients left, until the next clients take it over.
    left: Mutex<Left>,
    /// Rights of clients that publish to the broker.
    pub(super) rights: BrokerRights,
    /// Recent commands that came from the broker, to recognise repetitions.
    pub(super) commands: SharedMemory,
    /// What names meant before reloads.
    pub(super) earlier_names: Arc<EarlierNames>,
}

#[derive(Debug, Default)]
pub(super) struct Left {
    /// The retained topics of the client that runs.
    pub(super) retained: Vec<String>,
    /// The events that were not published yet.
    pub(super) unread: Option<Receiver<Arc<Event>>>,
    /// State of the client with the topics of drivegate.
    pub(super) client: ClientLeft<OrdersLeft>,
    /// State of the Sparkplug edge node.
    pub(super) node: ClientLeft<NodeOrdersLeft>,
    /// The threads that write, or still write, the messages of the clients.
    pub(super) writers: Vec<Writer>,
}

/// State that one of the clients left.
#[derive(Debug)]
pub(super) struct ClientLeft<Orders> {
    /// The commands whose results are not yet published.
    pub(super) orders: Option<Orders>,
    /// The broker that was in use.
    pub(super) broker: Option<Broker>,
}

impl<Orders> Default for ClientLeft<Orders> {
    fn default() -> Self {
        ClientLeft {
            orders: None,
            broker: None,
        }
    }
}

impl Handover {
    /// The state of this gateway's clients.
    pub fn of(north: &NorthState) -> Arc<Handover> {
        north.kept()
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Left> {
        self.left.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Leaves these events to the next client.
    pub fn leave_events(&self, events: Receiver<Arc<Event>>) {
        self.lock().unread = Some(events);
    }

    /// Notes that another plant replaces this one at `now`: what arrived before means what names meant in it.
    pub fn plant_ends(&self, plant: &Plant, now: Instant) {
        self.earlier_names.ended(plant, now);
    }

    /// Discards the state of the last clients if no client takes it over; the retained topics still have to be cleared,
    /// and files that are being written still have to be waited for.
    pub fn discard(&self) {
        let mut left = self.lock();
        let (retained, writers) = (std::mem::take(&mut left.retained), std::mem::take(&mut left.writers));
        *left = Left {
            retained,
            writers,
            ..Left::default()
        };
    }
}
