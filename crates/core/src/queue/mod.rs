//! The command queue of a bus: bounded and ordered; newer commands replace older ones, stops remove commands, and
//! commands expire. The gate ([`crate::permit`]), which is part of the queue, decides whether a command may be
//! sent.

mod age;
mod background;
mod handover;
mod passed_on;
mod shared;
mod stops;

pub use background::{BACKGROUND_CAPACITY, BACKGROUND_PER_CLIENT, Background};
use handover::PresentQueue;
pub use shared::CommandQueue;
use stops::BegunStop;
pub use stops::{NotStopped, Stopping};

use std::collections::{BTreeMap, VecDeque};
use std::time::Instant;

use crate::order::{CAPACITY, Command, Order, Origin, Outcome, Refusal, Target, Urgency};
use crate::permit::{Facts, Gate, Stage, Verdict};
use drivegate_model::drive::DriveIndex;

/// Maximum number of clients and drives for which the queue remembers when they were last served.
const SERVED_KEPT: usize = 4 * CAPACITY;
/// Maximum number of commands refused when their turn came that wait to be reported, which happens before the next
/// transaction; the oldest is dropped.
const MOST_DENIED: usize = 256;

/// The waiting commands: pure, time is an argument.
///
/// Commands to one drive are sent in the order in which they were accepted, from whatever client; only a stop goes
/// ahead. A request passed on to several drives is ordered among the commands of each of them. Between drives the
/// clients take turns, and for each client its drives.
#[derive(Debug, Default)]
pub struct Pending {
    waiting: VecDeque<Command>,
    /// The gate that decides whether commands may go.
    pub gate: Gate,
    /// Set once the queue is closed: the outcome that every command gets.
    closed: Option<Outcome>,
    /// The gateway is about to stop: only stops get in.
    stops_only: bool,
    /// Clients and the receivers of their commands in the order in which they were served, the latest one last.
    served: VecDeque<(String, Target)>,
    /// Drives for which a stop arrived since the bus last checked, each once.
    stopped: Vec<DriveIndex>,
    /// The bus is ending and another one replaces it: stops wait for that bus.
    ending: bool,
    /// Drives that no bus serves after this one: their stops are sent before this bus ends.
    last: Vec<DriveIndex>,
    /// Stops that were taken for sending, until the bus reports their end.
    begun_stops: Vec<BegunStop>,
    /// The drives whose stops another queue took over.
    heirs: BTreeMap<DriveIndex, PresentQueue>,
    /// For each drive that was taken over from an earlier queue: how that queue finds the drive.
    found_by: BTreeMap<DriveIndex, PresentQueue>,
    /// The stops that the gateway requires before it ends, until the bus takes them.
    stopping: Option<Stopping>,
    /// Commands that were refused when their turn came, and are not reported yet.
    denied: VecDeque<Denied>,
    /// Drives whose leases are renewed by orders that a pause or a reload kept from them, once each.
    renewed: Vec<DriveIndex>,
}

/// The command that is next to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chosen {
    /// Rank by which the command competes for the line: a redundant stop has the rank of an ordinary command.
    pub rank: Urgency,
    /// The drive of the command does not answer.
    pub is_last: bool,
    number: u64,
}

/// A command that was accepted and refused later; it is reported like a command that was refused at once.
#[derive(Debug, Clone, PartialEq)]
pub struct Denied {
    /// The drive, or one of the drives of the order.
    pub drive: DriveIndex,
    /// Origin of the order.
    pub origin: Origin,
    /// The order as text.
    pub what: String,
    /// Reason of the refusal.
    pub refusal: Refusal,
}

/// State of the drive of a command that has not started, reported by the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ready {
    /// The drive is ready for the command.
    Now,
    /// The command may be sent after those of its rank whose drives are ready: its drive does not answer.
    Last,
    /// The drive is busy with another command.
    No,
    /// The drive is not ready before this time.
    At(Instant),
}

/// The commands that may be sent, and when to check again.
#[derive(Debug, Default)]
pub struct Choice {
    /// The next command that may be sent.
    pub chosen: Option<Chosen>,
    /// When another command may go.
    pub wake_at: Option<Instant>,
}

impl Choice {
    fn wait(&mut self, until: Instant) {
        self.wake_at = Some(self.wake_at.map_or(until, |at| at.min(until)));
    }
}

impl Pending {
    /// Adds a command. A stop removes the queued run and reference commands of its drive, or joins a waiting stop;
    /// a newer reference replaces an older one. There is always room for a stop. If 64 other commands and reads
    /// wait, a command displaces the newest of a client that has more waiting than its own client would have, or of
    /// a drive for which its client has more waiting.
    ///
    /// If the gate refuses the command, its refusal; the command is answered by then.
    pub fn push(&mut self, mut command: Command, facts: &dyn Facts, now: Instant) -> Option<Refusal> {
        let is_stop = command.is_stop();
        let heir = || self.heirs.get(&command.drive()?)?.served_by();
        if is_stop && let Some((queue, place)) = heir() {
            command.move_to(place);
            return queue.submit(command, facts, now);
        }
        let waits = self.ending && is_stop;
        if let Some(outcome) = self.closed.clone().filter(|_| !waits) {
            // The last stops of a reload may take longer than a lease.
            if self.ending && self.gate.would_accept(&command, facts, now) {
                self.renew_by(&command);
            }
            command.answer(&outcome, now);
            return None;
        }
        if self.stops_only && !command.ends_the_gateway() {
            command.answer(&Outcome::ShuttingDown, now);
            return None;
        }
        self.delay(&mut command);
        if let Verdict::Refuse(outcome) = self.gate.judge(Stage::Accept, &command, facts, now) {
            self.end_unwanted(command, &outcome, now);
            return match outcome {
                Outcome::Refused(refusal) => Some(refusal),
                _ => None,
            };
        }
        if is_stop {
            self.push_stop(command, now);
        } else {
            self.take_other(command, now);
        }
        None
    }

    /// Adds a command that is not a stop.
    fn take_other(&mut self, command: Command, now: Instant) {
        if let Some(index) = self.replaced_by(&command)
            && let Some(older) = self.waiting.remove(index)
        {
            older.answer(&Outcome::Replaced, now);
            self.accept(command, Some(index), now);
            return;
        }
        if self.is_full() {
            match self.victim(&command).and_then(|index| self.waiting.remove(index)) {
                Some(victim) => victim.answer(&Outcome::QueueFull, now),
                None => {
                    command.answer(&Outcome::QueueFull, now);
                    return;
                }
            }
        }
        self.accept(command, None, now);
    }

    /// Adds a command to the waiting ones: at the place of the one that it replaces, or behind all others.
    fn accept(&mut self, command: Command, place: Option<usize>, now: Instant) {
        self.gate.accepted(&command, now);
        self.waiting.insert(place.unwrap_or(self.waiting.len()), command);
    }

    /// Whether a command must displace another one. Stops never do.
    fn is_full(&self) -> bool {
        self.waiting.iter().filter(|c| !c.is_stop()).count() >= CAPACITY
    }

    /// The numbers of the commands that wait.
    pub fn numbers(&self) -> impl Iterator<Item = u64> + '_ {
        self.waiting.iter().map(|c| c.intent.number)
    }

    /// The commands refused since the previous call when their turn came.
    pub fn take_denied(&mut self) -> VecDeque<Denied> {
        std::mem::take(&mut self.denied)
    }

    /// The queued reference that a newer one replaces: the last one of the same points, unless a later command
    /// conflicts with it.
    fn replaced_by(&self, command: &Command) -> Option<usize> {
        let drive = command.drive()?;
        let to_drive = |c: &Command| c.urgency() != Urgency::Read && c.reaches(drive);
        let same = |c: &Command| c.is_reference_only() && same_points(&c.intent.order, &command.intent.order);
        let touches = &command.intent.effects.touches;
        let ends = |c: &Command| same(c) || !c.intent.effects.touches.commutes(touches);
        let last = || self.waiting.iter().rposition(|c| to_drive(c) && ends(c));
        let index = command.is_reference_only().then(last)??;
        self.waiting.get(index).is_some_and(same).then_some(index)
    }

    /// The command that is displaced in a full queue: the newest of the client with the most entries or, within the
    /// client of the new command, of the drive with the most; neither may have fewer than the new command's client
    /// or drive would have.
    fn victim(&self, command: &Command) -> Option<usize> {
        let (client, target) = (command.ticket.client(), command.intent.target);
        let of_client = |c: &Command| (c.ticket.client() == client).then_some(c.intent.target);
        self.youngest_of_most(|c| Some(c.ticket.client()), client)
            .or_else(|| self.youngest_of_most(of_client, target))
    }

    /// The newest command of the group with the most commands, if that group has more than the `own` group would
    /// have with one more.
    fn youngest_of_most<'p, K: PartialEq>(&'p self, kind: impl Fn(&'p Command) -> Option<K>, own: K) -> Option<usize> {
        let others = || self.waiting.iter().enumerate().filter(|(_, c)| !c.is_stop());
        let held = |wanted: &K| others().filter(|(_, c)| kind(c).as_ref() == Some(wanted)).count();
        let counted = others().filter_map(|(index, c)| Some((held(&kind(c)?), index)));
        let (most, index) = counted.max()?;
        (most > held(&own) + 1).then_some(index)
    }

    /// The next command of this rank at `now`; expired and refused ones are removed. `ready` returns whether the
    /// drive of a command is ready for it: if the oldest command for a drive cannot be sent, later ones for that
    /// drive wait. `redundant` decides whether a stop has no effect on its drive, which gives it the rank of an
    /// ordinary command.
    pub fn next(
        &mut self,
        rank: Urgency,
        now: Instant,
        facts: &dyn Facts,
        mut ready: impl FnMut(&Command) -> Ready,
        redundant: impl Fn(DriveIndex) -> bool,
    ) -> Choice {
        self.expire(now);
        let mut choice = Choice::default();
        let mut passed_over: Vec<u64> = Vec::new();
        while let Some((number, is_last)) = self.best(rank, &passed_over, &mut ready, &redundant, &mut choice) {
            match self.judge_turn(number, facts, now) {
                Verdict::Go => {
                    choice.chosen = Some(Chosen { rank, is_last, number });
                    break;
                }
                Verdict::Wait(until) => {
                    choice.wait(until);
                    passed_over.push(number);
                }
                Verdict::LookFirst => passed_over.push(number),
                // Another command may be sent instead of the refused one.
                Verdict::Refuse(_) => choice.wait(now),
            }
        }
        choice
    }

    /// The command of this rank that is next by order and fairness, without those `passed_over`, and whether its drive does
    /// not answer.
    fn best(
        &self,
        rank: Urgency,
        passed_over: &[u64],
        ready: &mut impl FnMut(&Command) -> Ready,
        redundant: &impl Fn(DriveIndex) -> bool,
        choice: &mut Choice,
    ) -> Option<(u64, bool)> {
        let mut readiness = |command: &Command| match ready(command) {
            Ready::At(until) => {
                choice.wait(until);
                Ready::No
            }
            _ if passed_over.contains(&command.intent.number) => Ready::No,
            ready => ready,
        };
        let pressed = self.pressed();
        let passed_on = if pressed.is_empty() || rank != Urgency::Command {
            Vec::new()
        } else {
            self.passed_on(&mut |command: &Command| readiness(command) != Ready::No)
        };
        // Drives whose later commands must wait: for an older command, or for a stop.
        let mut behind: Vec<DriveIndex> = self.drives_of(Urgency::Stop);
        let mut stopped: Vec<Target> = Vec::new();
        let mut best = None;
        for (index, command) in self.waiting.iter().enumerate() {
            let (target, urgency) = (command.intent.target, command.urgency());
            if urgency == Urgency::Stop {
                // The oldest stop of a drive is sent first, regardless of what else its client commands.
                if stopped.contains(&target) {
                    continue;
                }
                stopped.push(target);
            }
            let is_passed_on = command.as_passed_on().is_some();
            let own = match (urgency, target) {
                (Urgency::Command, Target::Drive(drive)) if !is_passed_on && behind.contains(&drive) => continue,
                (Urgency::Stop, Target::Drive(drive)) if redundant(drive) && !self.may_start(drive) => Urgency::Command,
                _ => urgency,
            };
            keep_order(command, &mut behind);
            let number = command.intent.number;
            let goes = || pressed.contains(&number) && passed_on.contains(&number);
            if own != rank || (is_passed_on && !goes()) {
                continue;
            }
            let ready = readiness(command);
            if ready == Ready::No {
                continue;
            }
            let (client, of_client) = self.served(command);
            // A client that was never served sorts first (`None`). A command that was overtaken often enough goes
            // before all others.
            let is_last = ready == Ready::Last;
            let key = (command.overtaken < CAPACITY, is_last, client, of_client, index);
            if best.is_none_or(|(best, _)| key < best) {
                best = Some((key, number));
            }
        }
        best.map(|((_, is_last, ..), number)| (number, is_last))
    }

    /// Judges a waiting command that is about to be sent. A refused command is answered and reported.
    fn judge_turn(&mut self, number: u64, facts: &dyn Facts, now: Instant) -> Verdict {
        let Some(index) = self.waiting.iter().position(|c| c.intent.number == number) else {
            return Verdict::Go;
        };
        let Some(command) = self.waiting.get(index) else {
            return Verdict::Go;
        };
        if command.is_delayed_stop()
            && let Some(until) = command.drive().and_then(|drive| self.gate.stop_waits(drive, now))
        {
            return Verdict::Wait(until);
        }
        let verdict = self.gate.judge(Stage::Turn, command, facts, now);
        if let Verdict::Refuse(outcome) = &verdict
            && let Some(command) = self.waiting.remove(index)
        {
            self.deny(command, outcome, now);
        }
        verdict
    }

    /// Keeps the refusal of an accepted command to be reported.
    pub fn note_denied(&mut self, denied: Denied) {
        if self.denied.len() >= MOST_DENIED {
            self.denied.pop_front();
        }
        self.denied.push_back(denied);
    }

    /// Answers an accepted command that is refused, and keeps the refusal to be reported.
    fn deny(&mut self, command: Command, outcome: &Outcome, now: Instant) {
        if let (Outcome::Refused(refusal), Some(drive)) = (outcome, command.reach().next()) {
            self.note_denied(Denied {
                drive,
                origin: command.ticket.origin().clone(),
                what: command.ticket.what().to_string(),
                refusal: refusal.clone(),
            });
        }
        self.end_unwanted(command, outcome, now);
    }

    /// Removes the chosen command from the queue and returns it, unless it was removed meanwhile.
    pub fn take(&mut self, chosen: Chosen) -> Option<Command> {
        let index = self.waiting.iter().position(|c| c.intent.number == chosen.number)?;
        let command = self.waiting.remove(index)?;
        self.begun_stops.extend(BegunStop::of(&command));
        for older in self.waiting.iter_mut().take(index) {
            if older.urgency() >= command.urgency() {
                older.overtaken += 1;
            }
        }
        let of = (command.ticket.client().to_string(), command.intent.target);
        self.served.retain(|served| *served != of);
        // Clients without waiting commands need no entry, so the list stays as short as the queue.
        if self.served.len() >= SERVED_KEPT {
            self.served.pop_front();
        }
        self.served.push_back(of);
        Some(command)
    }

    /// When the client of this command was last served, and when its drive was served for that client, as places in
    /// the order.
    fn served(&self, command: &Command) -> (Option<usize>, Option<usize>) {
        let client = command.ticket.client();
        let last = self.served.iter().rposition(|(of, _)| of == client);
        let of_drive = self
            .served
            .iter()
            .position(|(of, target)| of == client && *target == command.intent.target);
        (last, of_drive)
    }

    fn drives_of(&self, urgency: Urgency) -> Vec<DriveIndex> {
        let of_rank = self.waiting.iter().filter(|c| c.urgency() == urgency);
        of_rank.filter_map(Command::drive).collect()
    }

    /// Whether a command waits that may start the drive.
    fn may_start(&self, drive: DriveIndex) -> bool {
        let starts = |c: &Command| c.reaches(drive) && c.may_start() && !c.stops(drive);
        self.waiting.iter().any(starts)
    }

    /// The latest expiry of a client's waiting command or stop for this drive; `None` if no client waits.
    pub fn client_waits_until(&self, drive: DriveIndex) -> Option<Instant> {
        let commands = self
            .waiting
            .iter()
            .filter(|c| c.reaches(drive) && c.urgency() != Urgency::Read);
        commands.filter_map(Command::client_waits_until).max()
    }

    /// Whether an order to that drive waits, a stop that `min_run` delays apart.
    pub fn awaits(&self, drive: DriveIndex) -> bool {
        let waits = |c: &Command| c.reaches(drive) && c.urgency() != Urgency::Read && !c.is_delayed_stop();
        self.stopped.contains(&drive) || self.waiting.iter().any(waits)
    }

    /// Ends and removes the commands that `which` selects.
    pub fn remove(&mut self, now: Instant, outcome: &Outcome, which: impl Fn(&Command) -> bool) {
        let mut index = 0;
        while let Some(command) = self.waiting.get(index) {
            if which(command) {
                if let Some(command) = self.waiting.remove(index) {
                    command.answer(outcome, now);
                }
            } else {
                index += 1;
            }
        }
    }

    /// Number of waiting commands.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Commands that wait to write, forwarded reads left out.
    pub fn writes(&self) -> usize {
        self.waiting.iter().filter(|c| c.urgency() < Urgency::Read).count()
    }

    /// Whether no command waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
}

/// Makes later commands to the drives of this command wait behind it.
fn keep_order(command: &Command, behind: &mut Vec<DriveIndex>) {
    if command.is_command() {
        behind.extend(command.reach());
    }
}

fn same_points(older: &Order, newer: &Order) -> bool {
    match (older, newer) {
        (Order::Points(a), Order::Points(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|((left, _), (right, _))| left == right)
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests;
