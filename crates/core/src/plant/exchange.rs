//! A request passed on to the line for a tool, and the receiver of its reply.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::BusHandle;
use super::orders::changes;
use crate::order::{
    Answer, Arrival, BackgroundRequest, Command, Effect, Effects, Intent, Order, Origin, Outcome, Pace, PassedOn,
    Target, Ticket, Touched, Window, written,
};
use crate::permit::{Stage, client_access};
use crate::process_image::DriveImage;
use crate::queue::Denied;
use drivegate_model::drive::DriveIndex;
use drivegate_proto::{Protocol, RequestPdu, describe};

/// A tool's request. The caller has checked that a write is allowed.
#[derive(Debug, Clone)]
pub struct Question {
    /// Drives that receive the request.
    pub target: Target,
    /// The request to pass on.
    pub pdu: RequestPdu,
    /// Whether the request may change a value: then it is counted and audited as a command.
    pub may_write: bool,
    /// When and over which connection the request arrived.
    pub arrival: Arrival,
    /// The request is not sent after this time.
    pub expires: Instant,
    /// Origin of the request.
    pub origin: Origin,
}

impl Question {
    /// A broadcast that the gateway sends at `now` for itself or for a client; no drive replies to it.
    pub fn broadcast(pdu: RequestPdu, origin: Origin, now: Instant, within: Duration) -> Question {
        Question {
            target: Target::Address(0),
            pdu,
            may_write: true,
            arrival: Arrival::now(now),
            expires: now + within,
            origin,
        }
    }
}

/// A requested transaction. Dropping it withdraws the request if it was not sent yet.
#[derive(Debug)]
pub struct Exchange {
    answer: oneshot::Receiver<Answer>,
    frame: oneshot::Receiver<Vec<u8>>,
}

impl Exchange {
    /// How the transaction ended, and the frame of the reply where there was one.
    pub fn poll(&mut self, cx: &mut Context<'_>) -> Poll<(Outcome, Option<Vec<u8>>)> {
        // A dropped ticket answers too, so a closed channel can only mean that the process ends.
        let answer = ready!(Pin::new(&mut self.answer).poll(cx));
        let outcome = answer.map_or(Outcome::ShuttingDown, |answer| answer.outcome);
        let frame = self.frame.try_recv().ok().filter(|frame| !frame.is_empty());
        Poll::Ready((outcome, frame))
    }
}

impl BusHandle {
    /// Passes a request on to the line within the share of background transactions. When this returns the request
    /// is in the queue of the bus, or answered. A request that may write counts as a command to every drive that
    /// receives it, and is ordered among their other commands.
    pub fn ask(&self, question: Question, now: Instant) -> Exchange {
        self.pass_on(question, false, now)
    }

    /// Sends a broadcast that stops every drive of the bus, ahead of all waiting commands, stops included.
    pub(crate) fn ask_first(&self, question: Question, now: Instant) -> Exchange {
        self.pass_on(question, true, now)
    }

    fn pass_on(&self, question: Question, first: bool, now: Instant) -> Exchange {
        let (spec, drives) = (&self.image.spec, &self.image.drives);
        let name = match question.target {
            Target::Drive(index) => drives
                .get(index)
                .map_or_else(String::new, |drive| drive.spec.name.clone()),
            Target::Address(address) => format!("address {address} of {}", spec.name),
        };
        let what = describe::request_on(spec.protocol, &question.pdu);
        let may_write = question.may_write;
        let reach: Vec<DriveIndex> = match question.target {
            Target::Drive(index) => vec![index],
            Target::Address(0) if spec.protocol != Protocol::N2 => drives.indexes().collect(),
            Target::Address(_) => Vec::new(),
        };
        let order = Order::Write(question.pdu.clone());
        let heard = || reach.iter().filter_map(|index| Some((*index, drives.get(*index)?)));
        let runs = heard().filter(|_| may_write).filter_map(|(_, drive)| {
            let changes = changes(&drive.reading(now, Duration::ZERO), &order);
            let run = changes.iter().rev().find_map(|change| change.run)?;
            Some((drive.spec.name.clone(), run))
        });
        let (ticket, answer) = Ticket::new(question.origin, &name, what, may_write, now, self.command_log.clone());
        let ticket = ticket.with_runs(runs.collect());
        let (sender, frame) = oneshot::channel();
        let passed_on = PassedOn {
            may_write,
            first,
            frame: sender,
        };
        if !may_write || reach.is_empty() {
            let allowed = client_access(Stage::Accept, false, ticket.origin(), &spec.name);
            if let (true, Err(refusal)) = (may_write, allowed) {
                ticket.answer(Outcome::Refused(refusal), now);
                return Exchange { answer, frame };
            }
            let request = BackgroundRequest {
                target: question.target,
                pdu: question.pdu,
                pace: Pace::Brisk,
                expires: question.expires,
                ticket,
                passed_on: Some(passed_on),
            };
            self.queue.submit_background(request, now);
            return Exchange { answer, frame };
        }
        let effect = |(index, drive): (DriveIndex, &Arc<DriveImage>)| {
            let effect = Effect {
                stops: is_stop(drive, &question.pdu),
                ..Effect::of(&order, &drive.spec.profile)
            };
            (index, effect)
        };
        // A request that cannot be decoded may write anything. Its registers are the same for every drive that receives it.
        let touched = heard().next().map_or(Touched::Anything, |(_, drive)| {
            Touched::of(&order, &[], &drive.spec.profile)
        });
        let effects = Effects::on_all(heard().map(effect).collect(), touched);
        let window = Window {
            arrival: question.arrival,
            expires: question.expires,
            waits: false,
        };
        let intent = Intent::new(question.target, order.clone(), effects, window);
        let facts = self.at_accept(Duration::ZERO, now);
        let (origin, what) = (ticket.origin().clone(), ticket.what().to_string());
        let refusal = self
            .queue
            .submit(Command::passed_on(intent, passed_on, ticket), &facts, now);
        if let (Some(refusal), Some(drive)) = (refusal, reach.first().copied()) {
            self.queue.lock().note_denied(Denied {
                drive,
                origin,
                what,
                refusal,
            });
        }
        Exchange { answer, frame }
    }
}

/// Whether a write takes the run command of a drive away.
fn is_stop(drive: &DriveImage, pdu: &RequestPdu) -> bool {
    written(pdu).is_some_and(|(table, items)| {
        let mut items = items.iter();
        items.any(|(address, value)| drive.spec.profile.is_stop(table, *address, *value))
    })
}
