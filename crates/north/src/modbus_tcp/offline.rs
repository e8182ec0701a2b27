//! The server without sockets and runtime, for tests, fuzz targets and virtual time.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use tokio_util::sync::CancellationToken;

use super::client::Client;
use super::dialogue::Dialogue;
use super::routes::PlantView;
use super::session::ClientSession;
use super::{Options, ServerState};
use crate::NorthState;
use crate::order::{Arrival, Authority, Connection};
use crate::plant::SharedPlant;

/// One client of a server without sockets. Time is an argument of [`Offline::receive`].
#[derive(Debug)]
pub struct Offline {
    dialogue: Dialogue,
    /// Over which all comes, once something has.
    connection: Option<Connection>,
    /// Input that the dialogue has no room for yet.
    backlog: Vec<u8>,
    closed: bool,
}

impl Offline {
    /// A client at `peer` that sees the whole plant. Of the options only `uncached` is used.
    pub fn new(
        options: Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        peer: SocketAddr,
        authority: Authority,
    ) -> Offline {
        let (state, view) = (
            ServerState::new(options, stats, CancellationToken::new()),
            PlantView::new(plant, Arc::default(), None),
        );
        let client = Client::new(peer, None, authority);
        Offline::of(ClientSession::new(Arc::new(state), Arc::new(view), client))
    }

    /// Another client of the same server, by the `name` in its certificate if it has shown one.
    pub fn beside(&self, peer: SocketAddr, name: Option<&str>, authority: Authority) -> Offline {
        Offline::of(self.dialogue.session().beside(Client::new(peer, name, authority)))
    }

    fn of(session: ClientSession) -> Offline {
        Offline {
            dialogue: Dialogue::new(session),
            connection: None,
            backlog: Vec::new(),
            closed: false,
        }
    }

    /// Processes `bytes` and returns the answers available so far; requests that wait for the bus are answered by a
    /// later call, with or without further input. Commands are in the queue of their bus when this returns.
    pub fn receive(&mut self, bytes: &[u8], now: Instant) -> Vec<u8> {
        self.backlog.extend_from_slice(bytes);
        let mut answers = Vec::new();
        loop {
            if self.closed {
                self.backlog.clear();
            } else if !self.dialogue.is_full() {
                let space = self.dialogue.parts().0;
                let count = self.backlog.len().min(space.len());
                for (place, byte) in space.iter_mut().zip(self.backlog.drain(..count)) {
                    *place = byte;
                }
                let connection = self.connection.get_or_insert_with(|| Connection::opened(now));
                self.dialogue.received(count, Arrival::over(connection.clone(), now));
            }
            self.closed = self.closed || self.dialogue.process(now).1.is_some();
            self.dialogue.collect(now);
            answers.append(&mut self.dialogue.output);
            if self.closed || self.dialogue.is_full() || (self.backlog.is_empty() && !self.dialogue.has_more()) {
                return answers;
            }
        }
    }

    /// Whether the input was not Modbus: a server reads no more of it, and closes the connection when the requests
    /// before it are answered.
    pub fn is_closed(&self) -> bool {
        self.closed
    }

    /// Whether any request waits for the bus.
    pub fn is_waiting(&self) -> bool {
        self.dialogue.is_waiting()
    }
}
