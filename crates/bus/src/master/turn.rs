//! A transaction to send, its purpose, and its result.

use std::time::{Duration, Instant};

use crate::command_run::StepPurpose;
use crate::schedule::Poll;
use crate::transaction::Ended;
use drivegate_core::order::{Target, Urgency};
use drivegate_model::drive::DriveIndex;
use drivegate_proto::RequestPdu;
use drivegate_proto::n2::Session;

/// A transaction to send: purpose and request.
#[derive(Debug, Clone, PartialEq)]
pub struct Turn {
    /// Purpose of the transaction, with its drive.
    pub purpose: Purpose,
    pub(super) pdu: RequestPdu,
}

/// The purpose of a transaction.
#[derive(Debug, Clone, PartialEq)]
pub enum Purpose {
    /// A poll of the drive.
    Poll(Poll),
    /// A step of the started command in that slot, competing with that rank.
    Command {
        /// The drive of the command.
        drive: DriveIndex,
        /// The slot of the drive's started command.
        slot: Urgency,
        /// Rank with which the command competes for the line.
        rank: Urgency,
        /// The purpose of the command's step.
        step: StepPurpose,
    },
    /// The background request that is next to be sent.
    Background(Target),
    /// A step of the refresh of the drive.
    Refresh(DriveIndex),
    /// A step of the N2 session with the drive, needed before a read of the plan or a step of the started command in
    /// that slot.
    Session(DriveIndex, Session, Before),
}

/// Continuation after a step of an N2 session.
#[derive(Debug, Clone, PartialEq)]
pub enum Before {
    /// A poll of the drive.
    Poll(Poll),
    /// A step of a started command: slot and rank.
    Command(Urgency, Urgency),
}

impl Turn {
    /// Receiver of the request.
    pub fn target(&self) -> Target {
        match &self.purpose {
            Purpose::Poll(poll) => poll.drive.into(),
            Purpose::Command { drive, .. } | Purpose::Refresh(drive) | Purpose::Session(drive, ..) => (*drive).into(),
            Purpose::Background(target) => *target,
        }
    }

    /// The drive that receives the request; `None` if none is configured at its address.
    pub fn drive(&self) -> Option<DriveIndex> {
        self.target().drive()
    }

    /// The request to send.
    pub fn pdu(&self) -> &RequestPdu {
        &self.pdu
    }

    /// The rank of the turn's command; `None` for a poll or a background transaction.
    pub fn rank(&self) -> Option<Urgency> {
        match &self.purpose {
            Purpose::Command { rank, .. } | Purpose::Session(_, _, Before::Command(_, rank)) => Some(*rank),
            Purpose::Poll(_) | Purpose::Background(_) | Purpose::Refresh(_) | Purpose::Session(..) => None,
        }
    }
}

/// The result of a turn.
#[derive(Debug)]
pub struct TurnEnd {
    /// Result of the transaction.
    pub ended: Ended,
    /// When the request was given to the line.
    pub began: Instant,
    /// When the transaction ended: no later than a reply can have left the drive.
    pub at: Instant,
    /// Whether the thread was stalled meanwhile: the missing reply may be due to that.
    pub stood: bool,
    /// Time for which the line was in use.
    pub took: Duration,
    /// The invalid bytes were the drive's own reply, damaged.
    pub mangled: bool,
    /// Whether a complete reply was rejected because the line could not have carried it so soon.
    pub doubted: bool,
    /// The reply frame as the drive sent it, for [`Purpose::Background`].
    pub frame: Vec<u8>,
}

/// How a transaction used the line.
#[derive(Debug, Clone, Copy)]
pub(super) struct LineUse {
    /// When the request was given to the line.
    pub(super) began: Instant,
    /// When the transaction ended: no later than a reply can have left the drive.
    pub(super) at: Instant,
    /// Time for which the line was in use.
    pub(super) took: Duration,
    /// Whether the thread was stalled meanwhile.
    pub(super) stood: bool,
}

impl TurnEnd {
    pub(super) fn line_use(&self) -> LineUse {
        LineUse {
            began: self.began,
            at: self.at,
            took: self.took,
            stood: self.stood,
        }
    }
}
