//! The command queue of a bus: bounded, ordered, with replacing, purging and expiry.

mod handover;
mod holds;
mod passed_on;
mod shared;
mod stops;

pub use holds::Unheld;
pub use shared::CommandQueue;
pub use stops::{NotStopped, Stopping};

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Instant;

use self::holds::Holds;
use super::{Command, Effect, Holder, Order, Origin, Outcome, Priorities, Refusal, Urgency, number};
use crate::drive::DriveIndex;
use crate::start_guard::BusGuards;

/// Commands and forwarded reads that may wait on one bus, in addition to two stops per drive.
pub const CAPACITY: usize = 64;
/// Most clients and drives whose turns are remembered.
const SERVED_KEPT: usize = 4 * CAPACITY;

/// The waiting commands: pure, time is an argument.
///
/// To one drive they go in the order in which they were accepted, from whatever client; only a stop goes ahead. What is
/// passed on to several drives has its place among the commands of each of them. Between drives the clients take turns,
/// and within a client its drives.
#[derive(Debug, Default)]
pub struct Pending {
    waiting: VecDeque<Command>,
    /// Set once the queue is closed: the outcome that every command gets.
    closed: Option<Outcome>,
    /// The gateway is about to stop: only stops get in.
    stops_only: bool,
    /// Clients and their drives in the order in which they were served, the last one last.
    served: VecDeque<(String, DriveIndex)>,
    /// Drives for which a stop arrived since the bus last checked, each once.
    stopped: Vec<DriveIndex>,
    /// Stops taken in so far, by drive.
    stops: BTreeMap<DriveIndex, u64>,
    /// When the last of them arrived.
    stopped_at: BTreeMap<DriveIndex, Instant>,
    /// Who gave the last of them.
    stopped_by: BTreeMap<DriveIndex, Origin>,
    /// The number of the last command taken in that may start the drive.
    starters: BTreeMap<DriveIndex, u64>,
    /// A drive to which nothing but stops is sent until then.
    quiet: Option<(DriveIndex, Instant)>,
    /// The bus ends and another one takes its place: stops wait for that one.
    ending: bool,
    /// The queues that took over the stops of drives, and their places there.
    heirs: BTreeMap<DriveIndex, (Arc<CommandQueue>, DriveIndex)>,
    /// The login of the last client command, by drive; no entry if there was none, or its client has no login.
    commanders: BTreeMap<DriveIndex, Arc<str>>,
    /// Who commands by priorities, by drive.
    priorities: BTreeMap<DriveIndex, Priorities>,
    /// Who holds the drives.
    holds: Holds,
    /// The stops that the gateway wants before it ends, until the bus takes note of it.
    stopping: Option<Stopping>,
    /// The start guards.
    guards: Option<Arc<BusGuards>>,
}

/// The command that has its turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chosen {
    /// Rank with which it competes for the line: a redundant stop has that of a command.
    pub rank: Urgency,
    number: u64,
}

impl Pending {
    /// Takes a command in. A stop removes the queued run and reference commands of its drive, or joins the stop that
    /// waits; a newer reference takes the place of an older one. Stops always find room. When 64 other commands and
    /// reads wait, a command takes the place of the youngest of a client that has more waiting than its own client would
    /// have, or of a drive that its client has more waiting for.
    pub fn push(&mut self, mut command: Command, now: Instant) {
        command.number = number();
        if command.urgency == Urgency::Stop
            && let Some((queue, place)) = self.heirs.get(&command.drive)
        {
            let effect = command.effect(command.drive);
            (command.drive, command.effects) = (*place, vec![(*place, effect)]);
            queue.submit(command, now);
            return;
        }
        let waits = self.ending && command.urgency == Urgency::Stop;
        if let Some(outcome) = self.closed.as_ref().filter(|_| !waits) {
            command.answer(&outcome.clone(), now);
            return;
        }
        if self.stops_only && !command.ends_the_gateway() {
            command.answer(&Outcome::ShuttingDown, now);
            return;
        }
        command.is_ordinary = self.is_ordinary(&command);
        if let Some(refusal) = self.hold_refuses_command(&command, now) {
            command.answer(&Outcome::Refused(refusal), now);
            return;
        }
        if command.urgency == Urgency::Stop {
            self.note_stop(command.drive, command.ticket.origin().clone(), now);
            self.push_stop(command, now);
            return;
        }
        if let Some(refusal) = self.refuses(&command, now) {
            command.answer(&Outcome::Refused(refusal), now);
            return;
        }
        if let Some(write) = &command.slot
            && !self.priorities.entry(command.drive).or_default().still_follows(write)
        {
            command.answer(&Outcome::Replaced, now);
            return;
        }
        if self.is_behind_its_stop(&command) {
            command.answer(&Outcome::Purged, now);
            return;
        }
        if let Some(index) = self.replaced_by(&command)
            && let Some(older) = self.waiting.remove(index)
        {
            older.answer(&Outcome::Replaced, now);
            self.note_accepted(&command, now);
            self.waiting.insert(index, command);
            return;
        }
        let others = self.waiting.iter().filter(|c| c.urgency != Urgency::Stop).count();
        if others >= CAPACITY {
            match self.victim(&command).and_then(|index| self.waiting.remove(index)) {
                Some(victim) => victim.answer(&Outcome::QueueFull, now),
                None => {
                    command.answer(&Outcome::QueueFull, now);
                    return;
                }
            }
        }
        self.note_accepted(&command, now);
        self.waiting.push_back(command);
    }

    /// Who blocks a command that starts the motor or sets a reference.
    fn refuses(&self, command: &Command, now: Instant) -> Option<Refusal> {
        let (origin, reach) = (command.ticket.origin(), command.reach());
        let waits = |drive: &DriveIndex| self.held_back(*drive, origin, command.effect(*drive));
        let until = command.waits.then_some(command.expires);
        let guarded = |drive: &DriveIndex| self.guarded(*drive, command.effect(*drive), until, now);
        (command.urgency == Urgency::Command)
            .then(|| reach.iter().find_map(waits).or_else(|| reach.iter().find_map(guarded)))
            .flatten()
    }

    /// Why a command with that effect is refused, if it starts a motor that may not be started yet; it may wait until
    /// `until`.
    pub fn guarded(&self, drive: DriveIndex, effect: Effect, until: Option<Instant>, now: Instant) -> Option<Refusal> {
        self.guards.as_ref()?.refuses(drive, effect, until, now)
    }

    /// Whether that command waits.
    pub fn has(&self, number: u64) -> bool {
        self.waiting.iter().any(|c| c.number == number)
    }

    /// Refuses a waiting command. Returns who sent it, and what it was.
    pub fn refuse(&mut self, number: u64, refusal: &Refusal, now: Instant) -> Option<(Origin, String)> {
        let index = self.waiting.iter().position(|c| c.number == number)?;
        let command = self.waiting.remove(index)?;
        let told = (command.ticket.origin().clone(), command.ticket.what().to_string());
        command.answer(&Outcome::Refused(refusal.clone()), now);
        Some(told)
    }

    /// Why a command of that client with that effect is refused, if another client's slot blocks it.
    pub fn held_back(&self, drive: DriveIndex, origin: &Origin, effect: Effect) -> Option<Refusal> {
        let protects = self.priorities.get(&drive)?.refuses(origin, effect)?;
        let (what, priority) = (protects.what.name(), protects.priority);
        Some(Refusal::HeldByOther(Box::new(Holder {
            who: format!("the BACnet client {}", protects.client),
            rank: format!("priority {priority}"),
            keeps: format!("holds `{what}` until it releases that slot"),
            left_s: None,
        })))
    }

    /// The priority arrays of a drive.
    pub fn priorities(&mut self, drive: DriveIndex) -> &mut Priorities {
        self.priorities.entry(drive).or_default()
    }

    /// Keeps who gave a command that is taken in.
    fn note_accepted(&mut self, command: &Command, now: Instant) {
        self.hold_accepted(command, now);
        let origin = command.ticket.origin();
        if command.urgency != Urgency::Read {
            for drive in command.reach() {
                let (effect, slot) = (command.effect(*drive), command.slot.as_ref());
                self.priorities(*drive).accepted(origin, effect, slot, now);
            }
        }
        if command.urgency != Urgency::Read && origin.kind.is_client() {
            for drive in command.reach() {
                self.set_commander(*drive, origin.login().cloned());
            }
        }
        if command.may_start() {
            let started = command.reach().iter().filter(|drive| !command.stops(**drive));
            started.for_each(|drive| _ = self.starters.insert(*drive, command.number));
        }
    }

    /// The login that commanded a drive last, unless another client did since.
    pub fn commander(&self, drive: DriveIndex) -> Option<&Arc<str>> {
        self.commanders.get(&drive)
    }

    /// Takes over a drive's state from the previous bus: last commander, number of stops, priority arrays.
    pub fn take_over(&mut self, drive: DriveIndex, commander: Option<Arc<str>>, stops: u64, priorities: Priorities) {
        self.set_commander(drive, commander);
        self.priorities.insert(drive, priorities);
        self.stops.insert(drive, stops);
    }

    fn set_commander(&mut self, drive: DriveIndex, login: Option<Arc<str>>) {
        match login {
            Some(login) => self.commanders.insert(drive, login),
            None => self.commanders.remove(&drive),
        };
    }

    /// The queued reference that a newer one replaces: the last of the same points, unless a later command conflicts
    /// with it.
    fn replaced_by(&self, command: &Command) -> Option<usize> {
        let to_drive = |c: &Command| c.urgency != Urgency::Read && c.reaches(command.drive);
        let same = |c: &Command| c.reference_only && same_points(&c.order, &command.order);
        let ends = |c: &Command| same(c) || !c.touched.commutes(&command.touched);
        let last = || self.waiting.iter().rposition(|c| to_drive(c) && ends(c));
        let index = command.reference_only.then(last)??;
        self.waiting.get(index).is_some_and(same).then_some(index)
    }

    /// The command displaced in a full queue: the newest of the client with the most entries, or else, within its own
    /// client, of the drive with the most; neither may have fewer than the new command's client or drive would have.
    fn victim(&self, command: &Command) -> Option<usize> {
        let client = command.ticket.client();
        self.youngest_of_most(|c| Some(c.ticket.client()), client)
            .or_else(|| self.youngest_of_most(|c| (c.ticket.client() == client).then_some(c.drive), command.drive))
    }

    /// The youngest of those with the most of one kind, if they are more than the `own` ones would be with one more.
    fn youngest_of_most<'p, K: PartialEq>(&'p self, kind: impl Fn(&'p Command) -> Option<K>, own: K) -> Option<usize> {
        let others = || {
            self.waiting
                .iter()
                .enumerate()
                .filter(|(_, c)| c.urgency != Urgency::Stop)
        };
        let held = |wanted: &K| others().filter(|(_, c)| kind(c).as_ref() == Some(wanted)).count();
        let counted = others().filter_map(|(index, c)| Some((held(&kind(c)?), index)));
        let (most, index) = counted.max()?;
        (most > held(&own) + 1).then_some(index)
    }

    /// The next command of that rank at `now`; expired ones are removed. `may` decides whether a command can start now:
    /// while the oldest for a drive cannot, later ones for that drive wait. `redundant` decides whether a stop has no
    /// effect on its drive, which gives it the rank of a command.
    pub fn next(
        &mut self,
        rank: Urgency,
        now: Instant,
        mut may: impl FnMut(&Command) -> bool,
        redundant: impl Fn(DriveIndex) -> bool,
    ) -> Option<Chosen> {
        self.expire(now);
        let pressed = self.pressed();
        let passed_on = match pressed.is_empty() || rank != Urgency::Command {
            true => Vec::new(),
            false => self.passed_on(&mut may),
        };
        // Drives whose later commands wait: behind an older one, or behind a stop.
        let mut behind: Vec<DriveIndex> = self.drives_of(Urgency::Stop);
        let mut stopped: Vec<DriveIndex> = Vec::new();
        let mut best = None;
        for (index, command) in self.waiting.iter().enumerate() {
            let drive = command.drive;
            if command.urgency == Urgency::Stop {
                // Of the stops of a drive the oldest goes first, anyone who else its client commands.
                if stopped.contains(&drive) {
                    continue;
                }
                stopped.push(drive);
            }
            let own = match command.urgency {
                Urgency::Command if command.passed_on.is_none() && behind.contains(&drive) => continue,
                Urgency::Stop if redundant(drive) && !self.may_start(drive) => Urgency::Command,
                urgency => urgency,
            };
            if command.urgency == Urgency::Command {
                behind.extend(command.reach());
            }
            let goes = || pressed.contains(&command.number) && passed_on.contains(&command.number);
            if own != rank || (command.passed_on.is_some() && !goes()) || !may(command) {
                continue;
            }
            let (client, of_client) = self.served(command);
            // `None`, never served, comes before any place. What was overtaken often enough comes before all.
            let key = (command.overtaken < CAPACITY, client, of_client, index);
            if best.is_none_or(|(best, _)| key < best) {
                best = Some((key, command.number));
            }
        }
        best.map(|(_, number)| Chosen { rank, number })
    }

    /// Takes the command that [`Pending::next`] chose, unless it was removed since.
    pub fn take(&mut self, chosen: Chosen) -> Option<Command> {
        let index = self.waiting.iter().position(|c| c.number == chosen.number)?;
        let command = self.waiting.remove(index)?;
        for older in self.waiting.iter_mut().take(index) {
            if older.urgency >= command.urgency {
                older.overtaken += 1;
            }
        }
        let of = (command.ticket.client().to_string(), command.drive);
        self.served.retain(|served| *served != of);
        // Only clients that wait are counted: there are never more of them than waiting commands.
        if self.served.len() >= SERVED_KEPT {
            self.served.pop_front();
        }
        self.served.push_back(of);
        Some(command)
    }

    /// When the client of that command was served last, and when its drive for it: places in order.
    fn served(&self, command: &Command) -> (Option<usize>, Option<usize>) {
        let client = command.ticket.client();
        let last = self.served.iter().rposition(|(of, _)| of == client);
        let of_drive = self
            .served
            .iter()
            .position(|(of, drive)| of == client && *drive == command.drive);
        (last, of_drive)
    }

    fn drives_of(&self, urgency: Urgency) -> Vec<DriveIndex> {
        let of_rank = self.waiting.iter().filter(|c| c.urgency == urgency);
        of_rank.map(|c| c.drive).collect()
    }

    /// Whether a command waits that may start the drive.
    fn may_start(&self, drive: DriveIndex) -> bool {
        let starts = |c: &Command| c.reaches(drive) && c.may_start() && !c.stops(drive);
        self.waiting.iter().any(starts)
    }

    /// The latest expiry of a client's waiting command or stop for that drive; none if none waits.
    pub fn client_waits_until(&self, drive: DriveIndex) -> Option<Instant> {
        let commands = self
            .waiting
            .iter()
            .filter(|c| c.reaches(drive) && c.urgency != Urgency::Read);
        commands.filter_map(Command::client_waits_until).max()
    }

    /// Ends expired commands. An accepted stop is sent, however long it waits.
    fn expire(&mut self, now: Instant) {
        self.remove(now, &Outcome::Expired, |c| {
            c.expires <= now && c.urgency != Urgency::Stop
        });
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

    /// Commands that wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Commands that wait to write, forwarded reads left out.
    pub fn writes(&self) -> usize {
        self.waiting.iter().filter(|c| c.urgency < Urgency::Read).count()
    }

    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
}

impl Command {
    /// Whether it may start a drive that it does not stop.
    fn may_start(&self) -> bool {
        self.urgency == Urgency::Command && !self.reference_only
    }

    /// Until when a client waits for it; none for the gateway's own.
    fn client_waits_until(&self) -> Option<Instant> {
        let joined = self.joined.iter().map(|(ticket, expires)| (ticket, *expires));
        let tickets = std::iter::once((&self.ticket, self.expires)).chain(joined);
        let of_clients = tickets.filter(|(ticket, _)| ticket.origin().kind.is_client());
        of_clients.map(|(_, expires)| expires).max()
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
