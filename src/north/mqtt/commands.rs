//! The set topics: turns a message into one command, and the answer to that command into one result. Time is an
//! argument; a task only has to wait.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant, SystemTime};

use super::outbox::Message;
use super::payload::Topics;
use super::reply::{Reply, ResponseTopics};
use super::request::{self, Incoming};
use crate::command::{Answer, Authority, Order, Origin, Refusal, SourceKind};
use crate::drive::ModelPoint;
use crate::north::command_json::{Id, Repetition, SharedMemory, excerpt, unknown_drive};
use crate::plant::{Placed, Plant};

/// Limits of the commands that wait for the bus. Only stops can be so many: the queues of the buses accept fewer other
/// commands.
const WAITING: QueueLimit = QueueLimit {
    most: 4096,
    bytes: 8 << 20,
};
/// Limits of the commands that the drive acknowledged and whose effect has not been read yet.
const CONFIRMING: QueueLimit = QueueLimit {
    most: 1024,
    bytes: 8 << 20,
};
/// Processes commands and returns their results.
#[derive(Debug)]
pub(super) struct Commands {
    topics: Topics,
    /// Everything from the connection to the broker counts as one client.
    client: Arc<str>,
    /// In the order of acceptance.
    waiting: PendingCommands,
    /// In the order of acknowledgement.
    confirming: PendingCommands,
    memory: SharedMemory,
    rules: Rules,
}

/// What the configuration says about commands.
#[derive(Debug, Clone)]
pub(super) struct Rules {
    /// Where results may go.
    pub(super) responses: ResponseTopics,
    /// Commands without an `id` are refused, except stops.
    pub(super) require_id: bool,
}

/// A command that is not finished.
#[derive(Debug)]
struct PendingCommand {
    number: u64,
    id: Option<Id>,
    reply: Reply,
    placed: Placed,
}

/// A command whose result is known.
#[derive(Debug)]
pub(super) struct FinishedCommand {
    number: u64,
    id: Option<Id>,
    reply: Reply,
    answer: Answer,
    confirmed: Option<Duration>,
}

impl Commands {
    /// `memory` outlives this client, so that a command is recognised after a reload.
    pub(super) fn new(topics: Topics, rules: Rules, memory: SharedMemory) -> Commands {
        memory.lock().abandon();
        Commands {
            topics,
            client: SourceKind::Mqtt.name().into(),
            waiting: PendingCommands::default(),
            confirming: PendingCommands::default(),
            memory,
            rules,
        }
    }

    /// Whether another message may be processed. If not, messages stay with the broker, so that no stop is refused for
    /// lack of room.
    pub(super) fn has_room(&self) -> bool {
        !self.waiting.is_full(WAITING)
    }

    /// Processes a message at `now`, which is `time` on the calendar. Returns its result if that is known at once;
    /// otherwise its command is in the queue of the bus. A repeated command is not executed again, but answered with the
    /// previous result or refused; a stop is always executed. `crowded` says whether too many results wait on a topic: a
    /// command that would be answered there is refused.
    pub(super) fn take(
        &mut self,
        incoming: Incoming,
        plant: &Plant,
        crowded: impl Fn(&str) -> bool,
        now: Instant,
        time: SystemTime,
    ) -> Option<Message> {
        let target = self.topics.parse_set(&incoming.topic)?;
        if incoming.retain && incoming.payload.is_empty() {
            return None; // a retained message was cleared
        }
        let result = self.topics.drive(target.drive, "result");
        let reply = Reply::to(&incoming, result, target.drive, &self.rules.responses);
        let who = incoming.who.as_deref().map(|who| excerpt(who.as_bytes()));
        let who = who
            .as_deref()
            .map_or(incoming.topic.as_str(), |who| who.trim_matches('`'));
        let origin = Origin::of(self.client.clone(), SourceKind::Mqtt, who);
        let what = || excerpt(&incoming.payload);
        let Some(drive) = plant.drive(target.drive) else {
            let name = excerpt(target.drive.as_bytes());
            let why = unknown_drive(target.drive, plant);
            let answer = plant.refuse_unknown(name.trim_matches('`'), &what(), why, origin, now);
            return Some(reply.message(request::id(&incoming, target.point), &answer, None, time));
        };
        let profile = &drive.image.spec.profile;
        let request = request::read(&incoming, target.point, profile);
        let refuse =
            |refusal, id, origin| Some(reply.message(id, &drive.refuse(&what(), refusal, origin, now), None, time));
        let (points, expiry) = match request.order {
            Err(refusal) => return refuse(refusal, request.id, origin),
            Ok(order) => order,
        };
        let run = profile.model_index(ModelPoint::Run);
        let stop = points.iter().any(|(i, v)| Some(*i) == run && !v.as_bool());
        let taken = incoming.taken();
        let print = self
            .memory
            .lock()
            .fingerprint(&taken, request.id.as_ref().map(Id::text));
        let stops = drive.stops();
        if !stop {
            let repeated = self.memory.lock().repeated(&taken, print, stops, now);
            match repeated {
                None => {}
                Some(Repetition::Pending) => return None,
                Some(Repetition::Answered(previous)) => return Some(reply.with(previous.to_vec())),
                Some(Repetition::Outdated(why)) => {
                    let why = format!("it repeats an earlier command, {why}; send it with another `id`");
                    return refuse(Refusal::NotAllowed(why), request.id, origin);
                }
            }
            if let Err(why) = self.may_take(&reply, request.id.as_ref(), crowded, now) {
                return refuse(Refusal::NotAllowed(why), request.id, origin);
            }
        }
        let number = match stop {
            true => 0,
            false => self.memory.lock().remember(&taken, print, stops, now),
        };
        let (order, asked) = (Order::Points(points), incoming.asked.unwrap_or(now));
        let pending = PendingCommand {
            number,
            id: request.id,
            placed: drive.place_asked(order, origin, Authority::Write, expiry, asked, now),
            reply,
        };
        self.follow(pending, time)
    }

    /// Whether a command that is no stop may be taken.
    fn may_take(
        &mut self,
        reply: &Reply,
        id: Option<&Id>,
        crowded: impl Fn(&str) -> bool,
        now: Instant,
    ) -> Result<(), String> {
        if id.is_none() && self.rules.require_id {
            return Err("commands need an `id` here (mqtt.require_id), except stops; nothing was written".to_string());
        }
        if crowded(reply.topic()) {
            let topic = excerpt(reply.topic().as_bytes());
            return Err(format!(
                "too many results wait for the broker on {topic}; wait for them; nothing was written"
            ));
        }
        if id.is_some() && !self.memory.lock().has_room(now) {
            return Err("too many commands with an `id` within ten minutes; nothing was written".to_string());
        }
        Ok(())
    }

    /// Returns the result of a refused command; any other waits.
    fn follow(&mut self, mut pending: PendingCommand, time: SystemTime) -> Option<Message> {
        match pending.placed.answer().filter(|answer| !answer.outcome.is_ok()) {
            Some(answer) => Some(self.result(pending.end(answer, None), time)),
            None => {
                self.waiting.push(pending);
                None
            }
        }
    }

    /// The next command that finishes; pending while there is none. Cancel safe.
    pub(super) async fn finished(&mut self) -> FinishedCommand {
        poll_fn(|cx| self.poll_finished(cx)).await
    }

    /// A command that has finished, if there is one.
    pub(super) fn try_finished(&mut self) -> Option<FinishedCommand> {
        match self.poll_finished(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(finished) => Some(finished),
            Poll::Pending => None,
        }
    }

    /// An acknowledged command no longer occupies the queue for the bus. If too many wait for confirmation, the oldest
    /// finishes as "acknowledged".
    fn poll_finished(&mut self, cx: &mut Context<'_>) -> Poll<FinishedCommand> {
        while let Some(mut pending) = self.waiting.take(|r| r.placed.poll_answer(cx).is_ready()) {
            match pending.placed.answer() {
                Some(answer) if !answer.outcome.is_ok() => return Poll::Ready(pending.end(answer, None)),
                _ => self.confirming.push(pending),
            }
        }
        let settled = |pending: &mut PendingCommand| pending.placed.poll_confirmation(cx).is_ready();
        let next = self.confirming.take(settled).or_else(|| {
            let full = self.confirming.is_full(CONFIRMING);
            full.then(|| self.confirming.take(|_| true)).flatten()
        });
        let finished = next.and_then(|mut pending| {
            let (answer, confirmed) = (pending.placed.answer()?, pending.placed.confirmation().flatten());
            Some(pending.end(answer, confirmed))
        });
        finished.map_or(Poll::Pending, Poll::Ready)
    }

    /// The one result of a finished command, at `time`.
    pub(super) fn result(&mut self, finished: FinishedCommand, time: SystemTime) -> Message {
        let message = finished
            .reply
            .message(finished.id, &finished.answer, finished.confirmed, time);
        self.memory
            .lock()
            .finished(finished.number, &message.payload.as_slice().into());
        message
    }

    /// Whether all commands are finished.
    pub(super) fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.confirming.is_empty()
    }
}

impl PendingCommand {
    fn end(self, answer: Answer, confirmed: Option<Duration>) -> FinishedCommand {
        FinishedCommand {
            number: self.number,
            id: self.id,
            reply: self.reply,
            answer,
            confirmed,
        }
    }

    /// Number of bytes whose length the client controls.
    fn bytes(&self) -> usize {
        self.reply.bytes() + self.id.as_ref().map_or(0, |id| id.text().len())
    }
}

/// Limits of a queue.
#[derive(Debug, Clone, Copy)]
struct QueueLimit {
    most: usize,
    bytes: usize,
}

/// Commands in order.
#[derive(Debug, Default)]
struct PendingCommands {
    commands: VecDeque<PendingCommand>,
    bytes: usize,
}

impl PendingCommands {
    fn push(&mut self, pending: PendingCommand) {
        self.bytes += pending.bytes();
        self.commands.push_back(pending);
    }

    /// Removes the first command for which `is_it` holds.
    fn take(&mut self, is_it: impl FnMut(&mut PendingCommand) -> bool) -> Option<PendingCommand> {
        let place = self.commands.iter_mut().position(is_it)?;
        let pending = self.commands.remove(place)?;
        self.bytes -= pending.bytes();
        Some(pending)
    }

    fn is_full(&self, bound: QueueLimit) -> bool {
        self.commands.len() >= bound.most || self.bytes >= bound.bytes
    }

    fn is_empty(&self) -> bool {
        self.commands.is_empty()
    }
}

#[cfg(test)]
mod tests;
