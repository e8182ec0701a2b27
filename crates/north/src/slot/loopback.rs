//! A slot without sockets and runtime, for tests in virtual time.

use std::sync::Arc;
use std::task::{Context, Waker};
use std::time::Instant;

use arc_swap::ArcSwap;

use super::dialogue::Dialogue;
use super::terms::{Terms, Tool};
use super::{Options, Slot, SlotAccess};
use crate::NorthState;
use drivegate_core::order::{Arrival, Connection, Proof};
use drivegate_core::plant::SharedPlant;

/// A tool of a slot without sockets.
#[derive(Debug)]
pub struct Loopback {
    terms: Arc<Terms>,
    dialogue: Dialogue,
    /// The connection over which all bytes arrive, once there are any.
    connection: Option<Connection>,
}

impl Loopback {
    /// The tool with the address `peer`.
    pub fn new(slot: Slot, plant: SharedPlant, stats: Arc<NorthState>, peer: &str) -> Loopback {
        Loopback::of(
            Arc::new(Terms {
                current: Arc::new(ArcSwap::from_pointee(Options {
                    slots: vec![slot.clone()],
                })),
                slot,
                plant,
                stats,
                paces: Arc::default(),
            }),
            peer,
        )
    }

    /// Sets the access of the slot, as a reload does.
    pub fn reload(&self, access: SlotAccess) {
        let slot = Slot {
            access,
            ..self.terms.slot.clone()
        };
        self.terms.current.store(Arc::new(Options { slots: vec![slot] }));
    }

    /// Another tool on this slot.
    pub fn beside(&self, peer: &str) -> Loopback {
        Loopback::of(self.terms.clone(), peer)
    }

    fn of(terms: Arc<Terms>, peer: &str) -> Loopback {
        let tool = Arc::new(Tool::new(terms.clone(), peer, peer, Proof::Nothing));
        Loopback {
            terms,
            dialogue: Dialogue::new(tool),
            connection: None,
        }
    }

    /// Processes bytes of the tool, if any, and returns its answer up to `now`. A request is in the queue of the
    /// bus when this returns, or waits until [`Loopback::wake_at`].
    pub fn receive(&mut self, bytes: &[u8], now: Instant) -> Vec<u8> {
        let connection = self.connection.get_or_insert_with(|| Connection::opened(now));
        let arrival = Arrival::over(connection.clone(), now);
        self.dialogue.received(bytes, arrival, now);
        let mut cx = Context::from_waker(Waker::noop());
        while self.dialogue.poll(&mut cx, now).is_ready() {}
        std::mem::take(&mut self.dialogue.output)
    }

    /// Latest time of the next call.
    pub fn wake_at(&self) -> Option<Instant> {
        self.dialogue.wake_at()
    }

    /// Whether an answer is due.
    pub fn is_waiting(&self) -> bool {
        self.dialogue.is_waiting()
    }
}
