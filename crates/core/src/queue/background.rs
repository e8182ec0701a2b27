//! Background transactions: requests of the lowest rank, for work that has time, such as reading all parameters of a
//! drive. Pure: time is an argument.
//!
//! Each request is one transaction, answered exactly once: with the drive's reply, or with the reason why there is
//! none. The bus sends one if the line is idle long enough for it, otherwise within a small share of the line
//! ([`Pace`]). Longer work sends its requests one after the other, and can be interrupted between any two.

use std::collections::VecDeque;
use std::time::Instant;

use crate::order::{BackgroundRequest, Outcome, Pace};

/// Background requests that may wait on one bus.
pub const BACKGROUND_CAPACITY: usize = 32;
/// Background requests of one client that may wait on one bus.
pub const BACKGROUND_PER_CLIENT: usize = 8;

/// The background requests waiting on one bus, in order of arrival.
#[derive(Debug, Default)]
pub struct Background {
    waiting: VecDeque<BackgroundRequest>,
    /// Set while the bus accepts no background work: contains the outcome of each request.
    closed: Option<Outcome>,
}

impl Background {
    /// Adds a request, unless 32 wait, 8 of the same client wait, or the bus accepts none.
    pub fn push(&mut self, request: BackgroundRequest, now: Instant) {
        if let Some(outcome) = &self.closed {
            request.answer(outcome.clone(), now);
            return;
        }
        let client = request.ticket.client();
        let own = self.waiting.iter().filter(|r| r.ticket.client() == client).count();
        if own >= BACKGROUND_PER_CLIENT || self.waiting.len() >= BACKGROUND_CAPACITY {
            request.answer(Outcome::QueueFull, now);
            return;
        }
        self.waiting.push_back(request);
    }

    /// The number of the oldest request of this pace that `may` allows.
    pub fn next(&self, pace: Pace, mut may: impl FnMut(&BackgroundRequest) -> bool) -> Option<usize> {
        self.waiting.iter().position(|r| r.pace == pace && may(r))
    }

    /// The request with this number from [`Background::next`].
    pub fn get(&self, number: usize) -> Option<&BackgroundRequest> {
        self.waiting.get(number)
    }

    /// Removes the request with this number and returns it.
    pub fn take(&mut self, number: usize) -> Option<BackgroundRequest> {
        self.waiting.remove(number)
    }

    /// A request that was taken and not sent waits again, before all others.
    pub fn put_back(&mut self, request: BackgroundRequest, now: Instant) {
        match &self.closed {
            Some(outcome) => request.answer(outcome.clone(), now),
            None => self.waiting.push_front(request),
        }
    }

    /// Ends and removes the requests that `which` selects.
    pub fn remove(&mut self, now: Instant, outcome: &Outcome, which: impl Fn(&BackgroundRequest) -> bool) {
        for request in std::mem::take(&mut self.waiting) {
            if which(&request) {
                request.answer(outcome.clone(), now);
            } else {
                self.waiting.push_back(request);
            }
        }
    }

    /// Ends everything that waits, and everything submitted from now on, with `outcome`.
    pub fn close(&mut self, outcome: &Outcome, now: Instant) {
        self.remove(now, outcome, |_| true);
        self.closed = Some(outcome.clone());
    }

    /// Accepts requests again.
    pub fn open(&mut self) {
        self.closed = None;
    }

    /// Whether a request waits that is not the gateway's own.
    pub fn has_of_others(&self) -> bool {
        self.waiting.iter().any(|request| !request.is_of_gateway())
    }

    /// Waiting requests, in order.
    pub fn iter(&self) -> impl Iterator<Item = &BackgroundRequest> {
        self.waiting.iter()
    }

    /// Whether no request waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
}
