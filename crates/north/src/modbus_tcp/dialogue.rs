//! The byte streams of one client without sockets and timers: input, requests that wait for the bus, output. The
//! connection adds both.

use std::time::Instant;

use futures_util::FutureExt;
use futures_util::stream::{FuturesUnordered, StreamExt};

use super::forwarded_request::{AnsweredRequest, PendingRequest};
use super::frame::{self, MAX_FRAME, NotModbus};
use super::session::ClientSession;
use crate::arrivals::Arrivals;
use drivegate_core::order::Arrival;

/// Initial input buffer: two frames, so that a thousand idle clients use little memory.
const INPUT_FIRST: usize = 2 * MAX_FRAME;
/// Maximum size of the input buffer.
const INPUT_MOST: usize = 32 * MAX_FRAME;
/// Maximum output collected before it is written, bytes.
const OUTPUT: usize = 32 * 1024;
/// Maximum number of requests of one connection that wait for the bus; beyond it no input is processed.
pub(super) const MOST_WAITING: usize = 16;
/// Number of requests processed before other clients are served.
const TURN: usize = 128;

/// The input consumed by one call of [`Dialogue::process`].
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
    /// Bytes in `input` that are not processed yet.
    filled: usize,
    /// Whether any frame has arrived yet.
    begun: bool,
    /// How and when the bytes of the input arrived.
    arrivals: Arrivals,
    pub(super) output: Vec<u8>,
}

impl Dialogue {
    pub(super) fn new(session: ClientSession) -> Dialogue {
        Dialogue {
            session,
            waiting: FuturesUnordered::new(),
            input: vec![0; INPUT_FIRST],
            filled: 0,
            begun: false,
            arrivals: Arrivals::default(),
            output: Vec::new(),
        }
    }

    pub(super) fn session(&self) -> &ClientSession {
        &self.session
    }

    /// Name of the client for the log.
    pub(super) fn who(&self) -> &str {
        self.session.who()
    }

    /// The free part of the input buffer, and the requests that wait for the bus. After [`Dialogue::process`] there is
    /// free space unless the dialogue is full or has more input: a frame is shorter than the buffer.
    pub(super) fn parts(&mut self) -> (&mut [u8], &mut FuturesUnordered<PendingRequest>) {
        (self.input.get_mut(self.filled..).unwrap_or_default(), &mut self.waiting)
    }

    /// Appends the answer to a request that the bus has answered, or requests the next part of a read.
    pub(super) fn finish(&mut self, answered: AnsweredRequest, now: Instant) {
        self.waiting
            .extend(self.session.finish(answered, now, &mut self.output));
    }

    /// Notes that `count` bytes arrived at this time in the free part of the input buffer.
    pub(super) fn received(&mut self, count: usize, arrival: Arrival) {
        self.arrivals.add(count, arrival);
        self.filled = (self.filled + count).min(self.input.len());
        if self.filled == self.input.len() && self.filled < INPUT_MOST {
            // A client that fills the buffer sends requests in batches; with a larger buffer, a whole batch is read
            // and answered at once.
            self.input.resize(INPUT_MOST, 0);
        }
    }

    /// Processes the frames in the input, at most [`TURN`], while there is room for their results. Input that is
    /// not Modbus ends the dialogue: earlier requests are answered or wait for the bus, and nothing after it is
    /// processed.
    pub(super) fn process(&mut self, now: Instant) -> (Consumed, Option<NotModbus>) {
        let mut consumed = Consumed::default();
        self.session.refresh();
        let misfit = loop {
            if self.is_full() || self.output.len() >= OUTPUT || consumed.frames >= TURN {
                break None;
            }
            let bytes = self.input.get(consumed.bytes..self.filled).unwrap_or_default();
            if !self.begun
                && let Some(misfit) = frame::of_serial_line(bytes)
            {
                break Some(misfit);
            }
            match frame::decode(bytes) {
                Ok(Some(frame)) => {
                    self.begun = true;
                    consumed.bytes += frame.used;
                    consumed.frames += 1;
                    let arrival = self.arrivals.take(frame.used).unwrap_or_else(|| Arrival::now(now));
                    let answer = self.session.take(&frame, arrival, now, &mut self.output);
                    self.waiting.extend(answer);
                }
                Ok(None) => break None,
                Err(misfit) => break Some(misfit),
            }
        };
        self.input.copy_within(consumed.bytes..self.filled, 0);
        self.filled -= consumed.bytes;
        (consumed, misfit)
    }

    /// Whether the input begins with a complete frame, or with data that is not Modbus.
    pub(super) fn has_more(&self) -> bool {
        self.filled > 0
            && !matches!(
                frame::decode(self.input.get(..self.filled).unwrap_or_default()),
                Ok(None)
            )
    }

    /// Whether the input holds any bytes.
    pub(super) fn has_input(&self) -> bool {
        self.filled > 0
    }

    /// Whether the maximum number of requests waits for the bus.
    pub(super) fn is_full(&self) -> bool {
        self.waiting.len() >= MOST_WAITING
    }

    /// Whether any request waits for the bus.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Appends all results that have arrived, so that they are sent together.
    pub(super) fn collect(&mut self, now: Instant) {
        while let Some(Some(answered)) = self.waiting.next().now_or_never() {
            self.finish(answered, now);
        }
    }
}
