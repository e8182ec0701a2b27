//! What a client leaves to the one that a reload puts in its place.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::broadcast::Receiver;

use super::Broker;
use super::commands::OrdersLeft;
use super::sparkplug::NodeOrdersLeft;
use crate::event::Event;

/// What the last clients left, until the next ones take it.
#[derive(Debug, Default)]
pub struct Handover(Mutex<Left>);

#[derive(Debug, Default)]
pub(super) struct Left {
    /// The retained topics of the client that runs.
    pub(super) retained: Vec<String>,
    /// The events that were not read.
    pub(super) unread: Option<Receiver<Arc<Event>>>,
    /// The commands whose results are still owed.
    pub(super) orders: Option<OrdersLeft>,
    pub(super) node_orders: Option<NodeOrdersLeft>,
    /// The brokers in use.
    pub(super) broker: Option<Broker>,
    pub(super) node_broker: Option<Broker>,
}

impl Handover {
    pub(super) fn lock(&self) -> MutexGuard<'_, Left> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Leaves these events to the next client.
    pub fn leave_events(&self, events: Receiver<Arc<Event>>) {
        self.lock().unread = Some(events);
    }

    /// Discards what the last clients left, if no client takes it; the retained topics are still to be cleared.
    pub fn discard(&self) {
        let mut left = self.lock();
        let retained = std::mem::take(&mut left.retained);
        *left = Left {
            retained,
            ..Left::default()
        };
    }
}
