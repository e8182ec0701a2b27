//! The conversation with one client as bytes: what came in, what waits for the bus, what goes out. No sockets, no
//! timer; the connection brings both.

use std::time::Instant;

use futures_util::FutureExt;
use futures_util::stream::{FuturesUnordered, StreamExt};

use super::forwarded_request::{AnsweredRequest, PendingRequest};
use super::frame::{self, MAX_FRAME, NotModbus};
use super::session::ClientSession;

/// Room for input at first: a frame and its successor. A thousand idle clients should cost no memory.
const INPUT_FIRST: usize = 2 * MAX_FRAME;
/// Most input that is kept.
const INPUT_MOST: usize = 32 * MAX_FRAME;
/// Output that is collected before it is written.
const OUTPUT: usize = 32 * 1024;
/// Requests of one connection that may wait for the bus; with so many under way no more are taken.
pub(super) const MOST_WAITING: usize = 16;
/// Requests that are worked off before others get their turn.
const TURN: usize = 128;

/// What one turn took.
#[derive(Debug, Default, Clone, Copy)]
pub(super) struct Consumed {
    pub(super) bytes: usize,
    pub(super) frames: usize,
}

#[derive(Debug)]
pub(super) struct Dialogue {
    session: ClientSession,
    waiting: FuturesUnordered<PendingRequest>,
    input: Vec<u8>,
    /// Bytes in `input` that are not worked off yet.
    filled: usize,
    pub(super) output: Vec<u8>,
}

impl Dialogue {
    pub(super) fn new(session: ClientSession) -> Dialogue {
        Dialogue {
            session,
            waiting: FuturesUnordered::new(),
            input: vec![0; INPUT_FIRST],
            filled: 0,
            output: Vec::new(),
        }
    }

    pub(super) fn session(&self) -> &ClientSession {
        &self.session
    }

    /// The client, for the log.
    pub(super) fn who(&self) -> &str {
        self.session.who()
    }

    /// Where more input goes, and what waits for the bus. There is room after [`Dialogue::work`] while the dialogue is
    /// not full and has no more: a frame is shorter than the input.
    pub(super) fn parts(&mut self) -> (&mut [u8], &mut FuturesUnordered<PendingRequest>) {
        (self.input.get_mut(self.filled..).unwrap_or_default(), &mut self.waiting)
    }

    /// The bus has answered: so the request is answered, or waits for the next part of what it reads.
    pub(super) fn finish(&mut self, answered: AnsweredRequest, now: Instant) {
        self.waiting
            .extend(self.session.finish(answered, now, &mut self.output));
    }

    /// So many bytes were put into the space.
    pub(super) fn received(&mut self, count: usize) {
        self.filled = (self.filled + count).min(self.input.len());
        if self.filled == self.input.len() && self.filled < INPUT_MOST {
            // A client that fills its room sends batches; they are read and answered as a whole.
            self.input.resize(INPUT_MOST, 0);
        }
    }

    /// Works off the frames in the input while there is room for what they cause, a turn at most.
    ///
    /// # Errors
    /// When what follows is no Modbus. What came before it is answered.
    pub(super) fn work(&mut self, now: Instant) -> Result<Consumed, NotModbus> {
        let mut consumed = Consumed::default();
        self.session.refresh();
        let result = loop {
            if self.is_full() || self.output.len() >= OUTPUT || consumed.frames >= TURN {
                break Ok(consumed);
            }
            match frame::decode(self.input.get(consumed.bytes..self.filled).unwrap_or_default()) {
                Ok(Some(frame)) => {
                    consumed.bytes += frame.used;
                    consumed.frames += 1;
                    self.waiting.extend(self.session.take(&frame, now, &mut self.output));
                }
                Ok(None) => break Ok(consumed),
                Err(misfit) => break Err(misfit),
            }
        };
        self.input.copy_within(consumed.bytes..self.filled, 0);
        self.filled -= consumed.bytes;
        result
    }

    /// Whether the input has something to work off: a frame, or what will never become one.
    pub(super) fn has_more(&self) -> bool {
        self.filled > 0
            && !matches!(
                frame::decode(self.input.get(..self.filled).unwrap_or_default()),
                Ok(None)
            )
    }

    /// Whether there is input at all.
    pub(super) fn has_input(&self) -> bool {
        self.filled > 0
    }

    /// Whether so much waits for the bus that nothing more is taken.
    pub(super) fn is_full(&self) -> bool {
        self.waiting.len() >= MOST_WAITING
    }

    /// Whether anything waits for the bus.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Takes the answers that have come in the meantime, to send them together.
    pub(super) fn collect(&mut self, now: Instant) {
        while let Some(Some(answered)) = self.waiting.next().now_or_never() {
            self.finish(answered, now);
        }
    }
}
