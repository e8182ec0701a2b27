//! The set topics: turns a message into one command, and the answer to that command into one result. Time is an
//! argument; a task only has to wait.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant, SystemTime};

use serde_json::Value as Json;

use super::outbox::Message;
use super::payload::Topics;
use super::reply::Reply;
use super::request::{self, Incoming, MAX_NAME, excerpt};
use crate::command::{Answer, Authority, Order, Origin, Refusal, SourceKind};
use crate::document::nearest;
use crate::drive::ModelPoint;
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
/// Number of recent commands in which a repetition is recognised.
const REMEMBERED: usize = 256;
/// Time for which a command with an `id` is recognised when it is repeated.
const REPLAYED: Duration = Duration::from_secs(60);

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
    hasher: RandomState,
    /// Accepted commands, oldest first.
    recent: VecDeque<RecentCommand>,
    /// Number of commands accepted so far.
    taken: u64,
}

/// A command that is not finished.
#[derive(Debug)]
struct PendingCommand {
    number: u64,
    id: Option<Json>,
    reply: Reply,
    placed: Placed,
}

/// A command whose result is known.
#[derive(Debug)]
pub(super) struct FinishedCommand {
    number: u64,
    id: Option<Json>,
    reply: Reply,
    answer: Answer,
    confirmed: Option<Duration>,
}

/// An accepted command.
#[derive(Debug)]
struct RecentCommand {
    number: u64,
    fingerprint: u64,
    packet: u16,
    /// Hash of topic and `id`, if it has one.
    identity: Option<u64>,
    /// Number of stops of the drive at that time.
    stops: u64,
    at: Instant,
    /// `None` until it is finished.
    result: Option<Message>,
}

impl Commands {
    pub(super) fn new(topics: Topics) -> Commands {
        Commands {
            topics,
            client: SourceKind::Mqtt.name().into(),
            waiting: PendingCommands::default(),
            confirming: PendingCommands::default(),
            hasher: RandomState::new(),
            recent: VecDeque::new(),
            taken: 0,
        }
    }

    /// Whether another message may be processed. If not, messages stay with the broker, so that no stop is refused for
    /// lack of room.
    pub(super) fn has_room(&self) -> bool {
        !self.waiting.is_full(WAITING)
    }

    /// Processes a message at `now`, which is `time` on the calendar. Returns its result if that is known at once;
    /// otherwise its command is in the queue of the bus. A repeated command is answered with the previous result and
    /// not executed again: one that the broker marks as repeated, or the same message with the same `id` within a
    /// minute. A stop is always executed.
    pub(super) fn take(
        &mut self,
        incoming: Incoming,
        plant: &Plant,
        now: Instant,
        time: SystemTime,
    ) -> Option<Message> {
        let target = self.topics.parse_set(&incoming.topic)?;
        if incoming.retain && incoming.payload.is_empty() {
            return None; // a retained message was cleared
        }
        let reply = Reply::to(&incoming, self.topics.drive(target.drive, "result"), target.drive);
        let origin = Origin::of(self.client.clone(), SourceKind::Mqtt, incoming.topic.as_str());
        let what = || excerpt(&incoming.payload);
        let Some(drive) = plant.drive(target.drive) else {
            let name = excerpt(target.drive.as_bytes());
            let why = unknown_drive(target.drive, plant);
            let answer = plant.refuse_unknown(name.trim_matches('`'), &what(), why, origin, now);
            return Some(reply.message(request::id(&incoming, target.point), &answer, None, time));
        };
        let profile = &drive.image.spec.profile;
        let request = request::read(&incoming, target.point, profile);
        let (points, expiry) = match request.order {
            Err(refusal) => {
                let answer = drive.refuse(&what(), refusal, origin, now);
                return Some(reply.message(request.id, &answer, None, time));
            }
            Ok(order) => order,
        };
        let run = profile.model_index(ModelPoint::Run);
        let stop = points.iter().any(|(i, v)| Some(*i) == run && !v.as_bool());
        let fingerprint = self.fingerprint(&incoming);
        let id = request.id.as_ref().map(Json::to_string);
        let identity = id.map(|id| self.hasher.hash_one((&incoming.topic, id)));
        if !stop && let Some(known) = self.repeated(&incoming, fingerprint, identity, now) {
            if known.stops == drive.stops() || known.result.is_none() {
                return known.result.clone(); // none yet: it is still to come
            }
            // The motor was stopped since: the previous result is no longer true, and a repetition would start it
            // again.
            let why = "it repeats an earlier command, but a stop was received since; send it with another `id`";
            let answer = drive.refuse(&what(), Refusal::NotAllowed(why.to_string()), origin, now);
            return Some(reply.message(request.id, &answer, None, time));
        }
        let stops = drive.stops();
        let pending = PendingCommand {
            number: self.remember(fingerprint, &incoming, identity, stops, now),
            id: request.id,
            reply,
            placed: drive.place(Order::Points(points), origin, Authority::Write, expiry, now),
        };
        self.follow(pending, time)
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

    fn fingerprint(&self, incoming: &Incoming) -> u64 {
        let Incoming {
            topic,
            payload,
            response_topic,
            correlation,
            ..
        } = incoming;
        self.hasher.hash_one((topic, payload, response_topic, correlation))
    }

    /// The command that a message repeats. An `id` that has been used for another command since does not count.
    fn repeated(
        &self,
        incoming: &Incoming,
        fingerprint: u64,
        identity: Option<u64>,
        now: Instant,
    ) -> Option<&RecentCommand> {
        let newest_first = || self.recent.iter().rev();
        let same = |known: &&RecentCommand| known.fingerprint == fingerprint;
        let marked = newest_first().find(|known| incoming.dup && known.packet == incoming.packet && same(known));
        let by_id = || {
            let last = newest_first().find(|known| identity.is_some() && known.identity == identity);
            last.filter(|known| now.saturating_duration_since(known.at) < REPLAYED && same(known))
        };
        marked.or_else(by_id)
    }

    fn remember(
        &mut self,
        fingerprint: u64,
        incoming: &Incoming,
        identity: Option<u64>,
        stops: u64,
        now: Instant,
    ) -> u64 {
        if self.recent.len() == REMEMBERED {
            self.recent.pop_front();
        }
        self.taken += 1;
        self.recent.push_back(RecentCommand {
            number: self.taken,
            fingerprint,
            packet: incoming.packet,
            identity,
            stops,
            at: now,
            result: None,
        });
        self.taken
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
        if let Some(known) = self.recent.iter_mut().find(|known| known.number == finished.number) {
            known.result = Some(message.clone());
        }
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
        self.reply.bytes() + self.id.as_ref().and_then(Json::as_str).map_or(0, str::len)
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

fn unknown_drive(name: &str, plant: &Plant) -> String {
    let drives: Vec<_> = plant.drives().map(|d| d.image.spec.name.clone()).collect();
    let near = (name.len() <= MAX_NAME).then(|| nearest(name, drives.iter().map(String::as_str)));
    let hint = near
        .flatten()
        .map_or(String::new(), |near| format!("; did you mean `{near}`?"));
    format!("there is no drive {}{hint}", excerpt(name.as_bytes()))
}

#[cfg(test)]
mod tests;
