//! Background transactions: requests of the lowest rank, for work that has time, such as reading all parameters of a
//! drive. Pure: time is an argument.
//!
//! Each request is one transaction, answered exactly once: with the drive's reply, or with the reason why there is
//! none. The bus sends one where the line rests long enough for it, and else within a small share of the line
//! ([`Pace`]); anyone who waits for a longer work asks again and again, one request behind the other, and so can be
//! interrupted between any two.

use std::collections::VecDeque;
use std::time::Instant;

use tokio::sync::oneshot;

use super::{Command, Effect, Order, Outcome, SourceKind, Ticket, Touched, Urgency};
use crate::codec::RequestPdu;
use crate::drive::DriveIndex;

/// Background requests that may wait on one bus.
pub const BACKGROUND_CAPACITY: usize = 32;
/// Background requests of one client that may wait on one bus.
pub const BACKGROUND_PER_CLIENT: usize = 8;

/// How much of a busy line background transactions take, as shares of the wire time of process data; where the line
/// rests they may have all of the rest. All of both kinds together take no more than a fifth of a busy line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Pace {
    /// 18 %: someone waits for the reply.
    Brisk,
    /// 1.5 %: unnoticeable.
    Slow,
}

impl Pace {
    /// All, in the order in which they have their turn.
    pub const ALL: [Pace; 2] = [Pace::Brisk, Pace::Slow];

    /// The share of a busy line.
    pub const fn share(self) -> f64 {
        match self {
            Pace::Brisk => 0.18,
            Pace::Slow => 0.015,
        }
    }
}

/// The index of no drive: that of a request to an address of the line at which none is configured.
pub const NO_DRIVE: DriveIndex = DriveIndex::new(usize::MAX);

/// A request of the lowest rank: one transaction with one drive.
#[derive(Debug)]
pub struct BackgroundRequest {
    /// Index of the drive on its bus, or [`NO_DRIVE`].
    pub drive: DriveIndex,
    /// The request. The submitter of a write has checked that it is allowed.
    pub pdu: RequestPdu,
    /// How much of a busy line it may take.
    pub pace: Pace,
    /// Not sent after this.
    pub expires: Instant,
    /// Its ticket.
    pub ticket: Ticket,
    /// The extra data of a forwarded request; none for a request of the gateway itself.
    pub passed_on: Option<PassedOn>,
}

/// A request passed on for a tool, which gets the drive's reply.
#[derive(Debug)]
pub struct PassedOn {
    /// The address on the line; 0 is the broadcast, except on N2.
    pub address: u8,
    /// It may change any value of every drive that receives it.
    pub may_write: bool,
    /// The drives of the bus that receive it.
    pub reach: Vec<DriveIndex>,
    /// Those of them whose run command it clears.
    pub stops: Vec<DriveIndex>,
    /// Its effects on the priority arrays of the drives that receive it.
    pub effects: Vec<(DriveIndex, Effect)>,
    /// It stops all drives that receive it, and precedes all waiting commands.
    pub first: bool,
    /// Receives the reply frame, as the drive sent it.
    pub frame: oneshot::Sender<Vec<u8>>,
}

impl PassedOn {
    /// Whether it is a command to drives of the bus, which has its place among their other commands.
    pub(crate) fn is_order(&self) -> bool {
        self.may_write && !self.reach.is_empty()
    }
}

impl BackgroundRequest {
    /// The command that waits among those of its drives, where it is a command to them.
    pub fn into_command(mut self, touched: Touched) -> Command {
        let effects = self
            .passed_on
            .as_mut()
            .map(|passed_on| std::mem::take(&mut passed_on.effects));
        Command {
            drive: self.drive,
            order: Order::Write(self.pdu),
            urgency: Urgency::Command,
            reference_only: false,
            ranges: Vec::new(),
            expires: self.expires,
            ticket: self.ticket,
            joined: Vec::new(),
            behind: None,
            overtaken: 0,
            number: 0,
            asked: None,
            touched,
            passed_on: self.passed_on,
            was_begun: false,
            effects: effects.unwrap_or_default(),
            slot: None,
            waits: false,
            is_ordinary: false,
            is_urgent: false,
        }
    }

    /// Whether the gateway reads something by itself, from time to time: it is left of no command and of no fault.
    pub fn is_of_gateway(&self) -> bool {
        self.ticket.origin().kind == SourceKind::Schedule
    }

    /// Whether the tool that sent it has disconnected, or has sent another request.
    pub fn is_unwanted(&self) -> bool {
        self.passed_on
            .as_ref()
            .is_some_and(|passed_on| passed_on.frame.is_closed())
    }

    /// As [`BackgroundRequest::answer`], with the frame of the reply.
    pub fn answer_with(mut self, outcome: Outcome, frame: Vec<u8>, now: Instant) {
        if let Some(passed_on) = self.passed_on.take() {
            // The tool may have gone.
            let _ = passed_on.frame.send(frame);
        }
        self.answer(outcome, now);
    }

    /// Reports the outcome to the requester.
    pub fn answer(self, outcome: Outcome, now: Instant) {
        self.ticket.answer(outcome, now);
    }
}

/// The background requests waiting on one bus, in order of arrival.
#[derive(Debug, Default)]
pub struct Background {
    waiting: VecDeque<BackgroundRequest>,
    /// Set while the bus accepts none: the outcome that each gets.
    closed: Option<Outcome>,
}

impl Background {
    /// Takes a request in, unless 32 wait, 8 of the same client, or the bus takes none.
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

    /// The number of the oldest request of that pace that `may` go.
    pub fn next(&self, pace: Pace, mut may: impl FnMut(&BackgroundRequest) -> bool) -> Option<usize> {
        self.waiting.iter().position(|r| r.pace == pace && may(r))
    }

    /// The request of that number, as [`Background::next`] gave it.
    pub fn get(&self, number: usize) -> Option<&BackgroundRequest> {
        self.waiting.get(number)
    }

    /// Takes the request of that number.
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

    /// Takes requests again.
    pub fn open(&mut self) {
        self.closed = None;
    }

    /// Whether a request waits that is not the gateway's own.
    pub fn has_of_others(&self) -> bool {
        self.waiting.iter().any(|request| !request.is_of_gateway())
    }

    /// Those that wait, in order.
    pub fn iter(&self) -> impl Iterator<Item = &BackgroundRequest> {
        self.waiting.iter()
    }

    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
}
