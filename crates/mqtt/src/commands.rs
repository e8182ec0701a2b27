//! The set topics: turns a message into one command, and the answer to that command into one result. Time is an
//! argument; a task only has to wait.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Instant, SystemTime};

use tokio::sync::oneshot;

use super::earlier_names::EarlierNames;
use super::outbox::Message;
use super::reply::{Reply, ResponseTopics};
use super::request::{self, Incoming};
use super::topics::{Target, Topics};
use drivegate_core::order::{Answer, Arrival, Authority, Origin, Outcome, Proof, Refusal, Right, SourceKind};
use drivegate_core::permit::{Stage, Verb, access};
use drivegate_core::plant::{Placed, Plant, Shown};
use drivegate_core::stop_all::{StopAll, StopReport};
use drivegate_north::command_json::{
    HoldReply, Id, Repetition, SharedMemory, excerpt, nothing_to_stop, refuse_stop_all, refuse_unknown, stop_all,
};

/// Limits of the commands that wait for the bus. Beyond them only stops are taken: a stop is executed, but its result is not
/// published.
const WAITING: QueueLimit = QueueLimit {
    most: 4096,
    bytes: 8 << 20,
};
/// Limits of the commands that the drive acknowledged and whose effect has not been read yet.
const CONFIRMING: QueueLimit = QueueLimit {
    most: 1024,
    bytes: 8 << 20,
};
/// Processes MQTT commands and publishes their results.
#[derive(Debug)]
pub(super) struct Commands {
    topics: Topics,
    /// All messages over the connection to the broker count as one client.
    client: Arc<str>,
    /// Accepted commands without an answer, in the order of acceptance.
    waiting: PendingCommands,
    /// Acknowledged commands without a confirmation, in the order of acknowledgement.
    confirming: PendingCommands,
    stopping: Vec<PendingStop>,
    memory: SharedMemory,
    stop_all: Arc<StopAll>,
    earlier_names: Arc<EarlierNames>,
    rules: Rules,
    /// Number of stops whose results are not awaited, since the last [`Commands::take_unfollowed`].
    unfollowed: u64,
}

/// The configuration of commands.
#[derive(Debug, Clone)]
pub(super) struct Rules {
    /// Topics to which results may be sent.
    pub(super) responses: ResponseTopics,
    /// Commands without an `id` are refused, except stops.
    pub(super) require_id: bool,
    /// Right of all clients that publish to the set topics.
    pub(super) right: Right,
}

/// Pending results that a client hands over to its successor at a reload.
#[derive(Debug, Default)]
pub(super) struct OrdersLeft {
    waiting: PendingCommands,
    confirming: PendingCommands,
    stopping: Vec<PendingStop>,
    /// Results that the broker has not acknowledged.
    pub(super) results: Vec<Message>,
}

/// A command that is not answered yet.
#[derive(Debug)]
pub(super) struct PendingCommand {
    number: u64,
    id: Option<Id>,
    reply: Reply,
    placed: Placed,
}

/// A stop of all drives that is not finished.
#[derive(Debug)]
struct PendingStop {
    reply: Reply,
    report: oneshot::Receiver<StopReport>,
}

/// A command whose result is known.
#[derive(Debug)]
pub(super) enum Finished {
    Command(PendingCommand, Answer, Shown),
    /// The result of a stop of all drives.
    StopAll(Reply, StopReport),
}

impl Commands {
    /// `memory` outlives this client, so that a command is recognised after a reload; this client continues with
    /// the commands in `left` from the previous one.
    pub(super) fn new(
        topics: Topics,
        rules: Rules,
        memory: SharedMemory,
        (stop_all, earlier_names): (Arc<StopAll>, Arc<EarlierNames>),
        left: Option<OrdersLeft>,
    ) -> Commands {
        if left.is_none() {
            memory.lock().abandon();
        }
        let left = left.unwrap_or_default();
        Commands {
            topics,
            client: SourceKind::Mqtt.name().into(),
            waiting: left.waiting,
            confirming: left.confirming,
            stopping: left.stopping,
            memory,
            stop_all,
            earlier_names,
            rules,
            unfollowed: 0,
        }
    }

    /// The state handed over to the next client, in addition to these results.
    pub(super) fn leave(self, results: Vec<Message>) -> OrdersLeft {
        OrdersLeft {
            waiting: self.waiting,
            confirming: self.confirming,
            stopping: self.stopping,
            results,
        }
    }

    /// The number of stops since the last call that have no result because too many commands waited.
    pub(super) fn take_unfollowed(&mut self) -> u64 {
        std::mem::take(&mut self.unfollowed)
    }

    /// Processes a message at `now`, which is `time` on the calendar. Returns its result if it is known at once;
    /// otherwise its command is in the queue of the bus. A repeated command is not executed again, but answered
    /// with the previous result or refused; a stop is always executed, but without the rest of its command.
    /// `crowded` returns whether too many results wait on a topic: a command that would be answered there is
    /// refused.
    pub(super) fn take(
        &mut self,
        incoming: Incoming,
        plant: &Plant,
        crowded: impl Fn(&str) -> bool,
        now: Instant,
        time: SystemTime,
    ) -> Option<Message> {
        let (target, who) = self.topics.parse(&incoming.topic)?;
        let origin = self.origin(&incoming, who);
        let (name, point) = match target {
            Target::StopAll => return self.stop_all(&incoming, &origin, plant, now),
            // A retained message was cleared. An empty one is a stop of all drives, but no other command.
            _ if incoming.retain && incoming.payload.is_empty() => return None,
            Target::Hold(drive) => return self.hold(&incoming, drive, origin, plant, now),
            Target::Set(drive, point) => (drive, point),
        };
        let result = self.topics.drive(name, "result");
        let reply = Reply::to(&incoming, result, name, &self.rules.responses);
        let (id, what) = (request::id(&incoming, point), excerpt(&incoming.payload));
        let Some(drive) = plant.drive(name) else {
            let answer = refuse_unknown(plant, name, &what, origin, now);
            return Some(reply.message(id, &answer, Shown::default(), time));
        };
        let profile = &drive.image.spec.profile;
        let refused = |answer: &Answer, id| Some(reply.message(id, answer, Shown::default(), time));
        let mut asked = match request::order(&incoming, point, profile) {
            Err(refusal) => return refused(&drive.refuse(&what, refusal, origin, now), id),
            Ok(asked) => asked,
        };
        let mut number = 0;
        if asked.does_more(profile) {
            let taken = incoming.taken();
            let print = self.memory.lock().fingerprint(&taken, id.as_ref().map(Id::text));
            let stops = drive.stops();
            let repeated = self.memory.lock().repeated(&taken, print, stops, now);
            let why = match repeated {
                None => self.may_take(&reply, id.as_ref(), crowded, now).err(),
                Some(Repetition::Outdated(why)) => Some(repeats(why)),
                // The stop is carried out again, and answered again.
                Some(Repetition::Pending | Repetition::Answered(_)) if asked.stops(profile) => {
                    Some(repeats("so only its stop is executed again"))
                }
                Some(Repetition::Pending) => return None,
                Some(Repetition::Answered(previous)) => return Some(reply.with(previous.to_vec())),
            };
            match why {
                Some(why) => asked.refused = Some(Refusal::NotAllowed(why)),
                None => number = self.memory.lock().remember(&taken, print, stops, now),
            }
        }
        let arrival = incoming.arrival.clone().unwrap_or_else(|| Arrival::now(now));
        let placed = match asked.place(&drive, &what, origin, arrival, now) {
            Ok(placed) => placed,
            Err(answer) => return refused(&answer, id),
        };
        let pending = PendingCommand {
            number,
            id,
            placed,
            reply,
        };
        self.follow(pending, time)
    }

    fn origin(&self, incoming: &Incoming, as_whom: Option<&str>) -> Origin {
        let proof = as_whom.map_or(Proof::Nothing, |who| Proof::Topic(who.into()));
        let origin = incoming.origin(&self.client, SourceKind::Mqtt).proven(proof);
        origin.with_right(self.rules.right.clone())
    }

    /// Takes, renews, releases or breaks the hold of a drive; answered at once.
    fn hold(&self, incoming: &Incoming, name: &str, origin: Origin, plant: &Plant, now: Instant) -> Option<Message> {
        let result = self.topics.drive(name, "result");
        let reply = Reply::to(incoming, result, name, &self.rules.responses);
        let what = || format!("hold={}", excerpt(&incoming.payload));
        // Strings and numbers can always be serialized.
        let json = |reply: HoldReply<'_>| serde_json::to_vec(&reply).unwrap_or_default();
        let Some(drive) = plant.drive(name) else {
            return match refuse_unknown(plant, name, &what(), origin, now).outcome {
                Outcome::Refused(refusal) => Some(reply.with(json(HoldReply::new(name, Err(refusal), None)))),
                _ => None,
            };
        };
        let text = std::str::from_utf8(&incoming.payload).unwrap_or_default().trim();
        let done = match Verb::of(text) {
            _ if incoming.retain => Err(Refusal::NotAllowed(
                "a retained message is never a command; publish it without the retain flag and clear the topic"
                    .to_string(),
            )),
            None => Err(Refusal::BadValue(
                "the payload must be take, renew, release or break".to_string(),
            )),
            Some(verb) => Ok(verb),
        };
        let done = match done {
            Ok(verb) => {
                let arrival = incoming.arrival.clone().unwrap_or_else(|| Arrival::now(now));
                drive.hold(verb, &origin, Authority::Write, (&arrival, now))
            }
            Err(refusal) => {
                drive.refuse(&what(), refusal.clone(), origin, now);
                Err(refusal)
            }
        };
        let seen = drive.hold_view(None, now).map(|(view, _)| view);
        Some(reply.with(json(HoldReply::new(name, done, seen))))
    }

    /// Processes a stop of all drives. Returns the answer if no stop is sent.
    fn stop_all(&mut self, incoming: &Incoming, origin: &Origin, plant: &Plant, now: Instant) -> Option<Message> {
        let reply = Reply::to(incoming, self.topics.result(), "", &self.rules.responses);
        let refuse = |refusal| Some(reply.with(refused_stop(&refuse_stop_all(plant, refusal, origin, now))));
        if incoming.retain {
            let why = "the message was retained, so no stop was sent; publish it without retain";
            return refuse(Refusal::NotAllowed(why.to_string()));
        }
        let (scope, wait) = match stop_all(&incoming.payload) {
            Ok(wanted) => wanted,
            Err(refusal) => return refuse(refusal),
        };
        // A client whose `commands` a reload disabled is ending, but still receives messages that were on their way.
        if let Err(refusal) = access(Stage::Accept, true, self.rules.right.allows("")) {
            return refuse(refusal);
        }
        // A reload since the first byte may have given the name to other drives.
        let asked = incoming.arrival.as_ref().map(|arrival| arrival.asked);
        let scope = match asked.and_then(|asked| self.earlier_names.at(asked)) {
            Some(earlier) => scope.as_of(&earlier),
            None => Ok(scope),
        };
        match scope.and_then(|scope| self.stop_all.order(plant, &scope, origin, wait, now)) {
            Ok(order) => {
                let report = order.report;
                self.stopping.push(PendingStop { reply, report });
                None
            }
            Err(why) => refuse(nothing_to_stop(&why)),
        }
    }

    /// Whether a command that does more than stop may be taken.
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
        if self.waiting.is_full(WAITING) {
            return Err("too many commands wait for the bus; nothing was written".to_string());
        }
        if crowded(reply.topic()) {
            let topic = excerpt(reply.topic().as_bytes());
            return Err(format!(
                "too many results are waiting for the broker on {topic}; wait for them; nothing was written"
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
            Some(answer) => Some(self.result(pending, &answer, Shown::default(), time)),
            None if self.waiting.is_full(WAITING) => {
                self.unfollowed += 1;
                None
            }
            None => {
                self.waiting.push(pending);
                None
            }
        }
    }

    /// The next command that finishes; pending while no command is in progress. Cancel safe.
    pub(super) async fn finished(&mut self) -> Finished {
        poll_fn(|cx| self.poll_finished(cx)).await
    }

    /// A command that has finished, if there is one.
    pub(super) fn try_finished(&mut self) -> Option<Finished> {
        match self.poll_finished(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(finished) => Some(finished),
            Poll::Pending => None,
        }
    }

    /// An acknowledged command no longer occupies the queue for the bus. If too many wait for confirmation, the oldest
    /// finishes as "acknowledged".
    fn poll_finished(&mut self, cx: &mut Context<'_>) -> Poll<Finished> {
        match self.poll_stopped(cx) {
            Poll::Ready((reply, report)) => Poll::Ready(Finished::StopAll(reply, report)),
            Poll::Pending => self.poll_command(cx),
        }
    }

    /// The list holds no more stops than the commands that the gateway keeps.
    fn poll_stopped(&mut self, cx: &mut Context<'_>) -> Poll<(Reply, StopReport)> {
        for (index, stop) in self.stopping.iter_mut().enumerate() {
            if let Poll::Ready(report) = Pin::new(&mut stop.report).poll(cx) {
                // Without a report the process is ending, and no standstill is proven.
                let report = report.unwrap_or_default();
                return Poll::Ready((self.stopping.remove(index).reply, report));
            }
        }
        Poll::Pending
    }

    fn poll_command(&mut self, cx: &mut Context<'_>) -> Poll<Finished> {
        while let Some(mut pending) = self.waiting.take(|r| r.placed.poll_answer(cx).is_ready()) {
            match pending.placed.answer() {
                Some(answer) if !answer.outcome.is_ok() => {
                    return Poll::Ready(Finished::Command(pending, answer, Shown::default()));
                }
                _ => self.confirming.push(pending),
            }
        }
        let settled = |pending: &mut PendingCommand| pending.placed.poll_confirmation(cx).is_ready();
        let next = self.confirming.take(settled).or_else(|| {
            let full = self.confirming.is_full(CONFIRMING);
            full.then(|| self.confirming.take(|_| true)).flatten()
        });
        let finished = next.and_then(|mut pending| {
            let (answer, shown) = (pending.placed.answer()?, pending.placed.shown());
            Some(Finished::Command(pending, answer, shown))
        });
        finished.map_or(Poll::Pending, Poll::Ready)
    }

    /// The answer to a finished command, at `time`.
    pub(super) fn answer(&mut self, finished: Finished, time: SystemTime) -> Message {
        match finished {
            Finished::Command(pending, answer, shown) => self.result(pending, &answer, shown, time),
            // Strings and words can always be serialized.
            Finished::StopAll(reply, report) => reply.with(serde_json::to_vec(&report).unwrap_or_default()),
        }
    }

    /// Publishes the only result of a finished command, at `time`.
    fn result(&mut self, pending: PendingCommand, answer: &Answer, shown: Shown, time: SystemTime) -> Message {
        let message = pending.reply.message(pending.id, answer, shown, time);
        self.memory
            .lock()
            .finished(pending.number, &message.payload.as_slice().into());
        message
    }

    /// Whether all commands are finished.
    pub(super) fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.confirming.is_empty() && self.stopping.is_empty()
    }
}

/// The answer where no stop is sent.
fn refused_stop(why: &str) -> Vec<u8> {
    let answer = serde_json::json!({ "ok": false, "drives": [], "error": why });
    answer.to_string().into_bytes()
}

fn repeats(why: &str) -> String {
    format!("it repeats an earlier command, {why}; send it with another `id`")
}

impl PendingCommand {
    /// Size of what the command keeps from its message.
    fn bytes(&self) -> usize {
        self.reply.bytes() + self.id.as_ref().map_or(0, |id| id.text().len())
    }
}

#[derive(Debug, Clone, Copy)]
struct QueueLimit {
    most: usize,
    bytes: usize,
}

/// Commands in progress, in order.
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
