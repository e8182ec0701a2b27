//! The server without sockets and runtime, for tests, fuzz targets and virtual time.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Instant;

use tokio_util::sync::CancellationToken;

use super::client::Client;
use super::dialogue::Dialogue;
use super::routes::{PlantView, View};
use super::session::ClientSession;
use super::{Options, ServerState};
use crate::NorthState;
use crate::reading::{Reader, Watch};
use drivegate_core::order::Authority;
use drivegate_core::plant::SharedPlant;

/// A client of a server without sockets. Time is an argument of [`Loopback::receive`].
#[derive(Debug)]
pub struct Loopback {
    dialogue: Dialogue,
    watch: Arc<Watch>,
    /// The reader, from the opening of the connection on.
    reader: Option<Reader>,
    /// Input for which the dialogue has no room yet.
    backlog: Vec<u8>,
    closed: bool,
}

impl Loopback {
    /// A client at `peer` that sees the whole plant. Of the options only `uncached` is used.
    pub fn new(
        options: Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        peer: SocketAddr,
        authority: Authority,
    ) -> Loopback {
        let view = PlantView::new(0, plant, stats.stop_all.clone(), View::default());
        let state = ServerState::new(options, stats, CancellationToken::new());
        let client = Client::new(peer, None, authority);
        let session = ClientSession::new(Arc::new(state), Arc::new(view), client);
        Loopback::of(session, Watch::in_virtual_time())
    }

    /// Another client of the same server, with this `name` in its certificate if it has one.
    pub fn beside(&self, peer: SocketAddr, name: Option<&str>, authority: Authority) -> Loopback {
        let session = self.dialogue.session().beside(Client::new(peer, name, authority));
        Loopback::of(session, self.watch.clone())
    }

    fn of(session: ClientSession, watch: Arc<Watch>) -> Loopback {
        Loopback {
            dialogue: Dialogue::new(session),
            watch,
            reader: None,
            backlog: Vec::new(),
            closed: false,
        }
    }

    /// The watch of the thread that reads the bytes of all clients. A watch that never ran sees no stalls.
    pub fn watch(&self) -> &Arc<Watch> {
        &self.watch
    }

    /// Processes `bytes` and returns the replies available so far; requests that wait for the bus are answered by a
    /// later call, with or without further input. Commands are in the queue of their bus when this returns. The
    /// first call opens the connection.
    pub fn receive(&mut self, bytes: &[u8], now: Instant) -> Vec<u8> {
        self.take(bytes, false, now)
    }

    /// Processes bytes like [`Loopback::receive`], from a client that closed the connection after `bytes`.
    pub fn receive_last(&mut self, bytes: &[u8], now: Instant) -> Vec<u8> {
        let answers = self.take(bytes, true, now);
        if let Some(reader) = &self.reader {
            reader.ended();
        }
        answers
    }

    fn take(&mut self, bytes: &[u8], has_gone: bool, now: Instant) -> Vec<u8> {
        self.backlog.extend_from_slice(bytes);
        let opens = || Reader::new(self.watch.clone(), now);
        let reader = self.reader.get_or_insert_with(opens);
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
                if count > 0 {
                    reader.note_read(now, self.backlog.is_empty(), || has_gone);
                    self.dialogue.received(count, reader.last());
                }
            }
            self.closed = self.closed || self.dialogue.process(now).1.is_some();
            self.dialogue.collect(now);
            answers.append(&mut self.dialogue.output);
            if self.closed || self.dialogue.is_full() || (self.backlog.is_empty() && !self.dialogue.has_more()) {
                break;
            }
        }
        if self.backlog.is_empty() && !self.dialogue.is_full() {
            reader.nothing(now, || false);
        } else {
            reader.ceased();
        }
        answers
    }

    /// Whether the input was not Modbus: a server then reads no more and closes the connection after the earlier
    /// requests are answered.
    pub fn is_closed(&self) -> bool {
        self.closed
    }

    /// Whether any request waits for the bus.
    pub fn is_waiting(&self) -> bool {
        self.dialogue.is_waiting()
    }
}
