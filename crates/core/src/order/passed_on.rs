//! Requests passed on to the line unchanged: for a tool, as a broadcast, or for background work of the gateway.

use std::time::Instant;

use tokio::sync::oneshot;

use super::{Outcome, SourceKind, Target, Ticket};
use drivegate_proto::RequestPdu;

/// How much of a busy line background transactions may take, as shares of the wire time of process data; an idle
/// line is theirs. All of them together take at most a fifth of a busy line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Pace {
    /// 18 %: someone waits for the reply.
    Brisk,
    /// Slow pace: 1.5 % of a busy line, which is unnoticeable.
    Slow,
}

impl Pace {
    /// All paces, in the order in which they take turns.
    pub const ALL: [Pace; 2] = [Pace::Brisk, Pace::Slow];

    /// The share of a busy line.
    pub const fn share(self) -> f64 {
        match self {
            Pace::Brisk => 0.18,
            Pace::Slow => 0.015,
        }
    }
}

/// A request passed on for a tool, which gets the drive's reply, or a broadcast.
#[derive(Debug)]
pub struct PassedOn {
    /// Whether the request may change a value of any drive that receives it.
    pub may_write: bool,
    /// Whether the request stops all drives that receive it, and precedes all waiting commands.
    pub first: bool,
    /// Receives the reply frame, as the drive sent it.
    pub frame: oneshot::Sender<Vec<u8>>,
}

/// A request of the lowest rank: one transaction with one drive that is not a command.
#[derive(Debug)]
pub struct BackgroundRequest {
    /// Receiver of the request.
    pub target: Target,
    /// The request to send.
    pub pdu: RequestPdu,
    /// Share of a busy line that the request may take.
    pub pace: Pace,
    /// The request is not sent after this time.
    pub expires: Instant,
    /// Ticket of the request.
    pub ticket: Ticket,
    /// Receiver of the reply's frame, for a tool; `None` for a request of the gateway itself.
    pub passed_on: Option<PassedOn>,
}

impl BackgroundRequest {
    /// Whether the gateway itself reads at intervals, so that neither a command nor a fault is the reason.
    pub fn is_of_gateway(&self) -> bool {
        self.ticket.origin().kind == SourceKind::Schedule
    }

    /// Whether the tool of the request has disconnected, or has sent another request.
    pub fn is_unwanted(&self) -> bool {
        self.passed_on
            .as_ref()
            .is_some_and(|passed_on| passed_on.frame.is_closed())
    }

    /// Reports the outcome to the requester.
    pub fn answer(self, outcome: Outcome, now: Instant) {
        self.ticket.answer(outcome, now);
    }
}
