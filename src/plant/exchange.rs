//! A request that is passed on to the line for a tool: what is asked, and where the answer arrives.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use tokio::sync::oneshot;

use super::BusHandle;
use crate::codec::{RequestPdu, describe};
use crate::command::{Answer, BackgroundRequest, NO_DRIVE, Origin, Outcome, Pace, PassedOn, Ticket, WriteStats};

/// Who on the line is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// The configured drive at that place of the bus.
    Drive(usize),
    /// An address at which no drive is configured; 0 is the broadcast, except on N2.
    Address(u8),
}

/// What a tool asks. Whoever passes on what may write has checked that it is allowed.
#[derive(Debug, Clone)]
pub struct Question {
    /// Who is asked.
    pub target: Target,
    /// What.
    pub pdu: RequestPdu,
    /// Whether it may change anything: then it is counted and audited as a command.
    pub may_write: bool,
    /// Not sent after this.
    pub expires: Instant,
    /// Who asks.
    pub origin: Origin,
}

/// An exchange that was asked for. Dropping it takes it back while it was not sent.
#[derive(Debug)]
pub struct Exchange {
    answer: oneshot::Receiver<Answer>,
    frame: oneshot::Receiver<Vec<u8>>,
}

impl Exchange {
    /// How it ended, and the frame of the reply where there was one.
    pub fn poll(&mut self, cx: &mut Context<'_>) -> Poll<(Outcome, Option<Vec<u8>>)> {
        // The ticket answers even when it is dropped; a lost sender can only mean that the process ends.
        let answer = ready!(Pin::new(&mut self.answer).poll(cx));
        let outcome = answer.map_or(Outcome::ShuttingDown, |answer| answer.outcome);
        let frame = self.frame.try_recv().ok().filter(|frame| !frame.is_empty());
        Poll::Ready((outcome, frame))
    }
}

impl BusHandle {
    /// Passes a request on to the line, in the share of background exchanges. When this returns it is in the queue of the bus, or
    /// answered.
    pub fn ask(&self, question: Question, writes: &Arc<WriteStats>, now: Instant) -> Exchange {
        let (spec, drives) = (&self.image.spec, &self.image.drives);
        let (drive, address, name) = match question.target {
            Target::Drive(index) => {
                let drive = drives.get(index);
                let address = drive.map_or(0, |drive| drive.spec.address);
                (
                    index,
                    address,
                    drive.map_or_else(String::new, |drive| drive.spec.name.clone()),
                )
            }
            Target::Address(address) => (NO_DRIVE, address, format!("address {address} of {}", spec.name)),
        };
        let what = describe::request_on(spec.protocol, &question.pdu);
        let may_write = question.may_write;
        let (ticket, answer) = Ticket::new(question.origin, &name, what, may_write, now, writes.clone());
        let (sender, frame) = oneshot::channel();
        let request = BackgroundRequest {
            drive,
            pdu: question.pdu,
            pace: Pace::Brisk,
            expires: question.expires,
            ticket,
            passed_on: Some(PassedOn {
                address,
                may_write,
                frame: sender,
            }),
        };
        self.queue.submit_background(request, now);
        Exchange { answer, frame }
    }
}
