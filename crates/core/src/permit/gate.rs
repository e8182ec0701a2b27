//! The state of the drives of a bus that decides about orders: stops, holders, priorities, drills, starts. Pure: time is an
//! argument.
//!
//! The gate is part of the queue of the bus, so that orders and the changes they make here have one order of acceptance.

mod holds;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use self::holds::HoldNews;
pub use self::holds::Unheld;
use super::awaited_files::AwaitedFiles;
use super::holder::{Claim, Holding, Rules};
use super::judge::{self, Ask, Facts, Stage, Verdict};
use super::priorities::Priorities;
use crate::order::{Command, Connection, Effect, Intent, LastStops, Origin, Outcome, Refusal, Urgency};
use crate::stalls::Stall;
use crate::start_guard::{BusGuards, Clearance};
use drivegate_model::drive::DriveIndex;

/// Maximum number of clients of a drive that are remembered.
const MOST_CLIENTS: usize = 64;

/// A drill in progress on a drive: no other order to the drive is sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DrillLock {
    /// The drill's client, as text.
    pub who: String,
    /// Until this time only stops are sent, so that the drive's own supervision of the fieldbus acts.
    pub quiet_until: Option<Instant>,
}

/// State of one drive that decides about its orders.
#[derive(Debug, Default)]
pub(super) struct DriveGate {
    /// Number of stops accepted so far.
    stops: u64,
    /// The last stops, as far as they invalidate orders that were given earlier.
    pub(super) last_stops: LastStops,
    /// Origin of the last stop.
    stopped_by: Option<Origin>,
    /// The number of the last accepted command that may start the drive; 0 before the first one.
    last_starter: u64,
    /// The login of the client that commanded last; `None` before the first command, or if that client has no login.
    commander: Option<Arc<str>>,
    /// The clients that commanded the drive, the last one last.
    clients: Vec<Arc<str>>,
    /// Clients that commanded another machine under the name or unit that this machine has had since a reload: they
    /// must send a stop, or take the drive, before their run command starts this motor.
    pub(super) must_stop_first: Vec<Arc<str>>,
    pub(super) priorities: Priorities,
    pub(super) holding: Holding,
    pub(super) drill: Option<DrillLock>,
    /// Commands that were carried out, or would have been refused, though another client held the drive.
    unheld: u64,
}

/// State of the drives of a bus that decides about their orders.
#[derive(Debug, Default)]
pub struct Gate {
    /// Rules of `[authority]`; `None` if it is off.
    pub(super) rules: Option<Arc<Rules>>,
    drives: BTreeMap<DriveIndex, DriveGate>,
    /// The last pause of the bus.
    pub(super) paused: Option<Stall>,
    /// The guards of motor starts on the bus.
    pub(super) starts: Option<Arc<BusGuards>>,
    /// Files that may forbid starts and are not read yet.
    pub(super) awaited: Arc<AwaitedFiles>,
    /// Commands in progress whose starts were cleared, with the drives that they start.
    cleared: Vec<(u64, Vec<DriveIndex>)>,
    hold_news: HoldNews,
}

/// State of a drive that one bus passes to the bus that replaces it.
#[derive(Debug)]
pub(crate) struct Inheritance {
    stops: u64,
    last_stops: LastStops,
    stopped_by: Option<Origin>,
    commander: Option<Arc<str>>,
    clients: Vec<Arc<str>>,
    must_stop_first: Vec<Arc<str>>,
    priorities: Priorities,
    holding: Holding,
}

impl DriveGate {
    fn commanded_by(&mut self, client: &Arc<str>) {
        self.clients.retain(|known| known != client);
        if self.clients.len() >= MOST_CLIENTS {
            self.clients.remove(0);
        }
        self.clients.push(client.clone());
    }
}

impl Gate {
    /// The state of the drive, created at the first use.
    pub(super) fn drive(&mut self, drive: DriveIndex) -> &mut DriveGate {
        self.drives.entry(drive).or_default()
    }

    /// Judges a command for every drive that it reaches. A refusal is noted by the drive that refused it.
    pub fn judge(&mut self, stage: Stage, command: &Command, facts: &dyn Facts, now: Instant) -> Verdict {
        let (intent, origin) = (&command.intent, command.ticket.origin());
        let drives: Vec<DriveIndex> = command.reach().collect();
        let mut verdict = Verdict::Go;
        for drive in drives {
            let seen = facts.seen(drive);
            let ask = Ask {
                stage,
                now,
                drive,
                intent,
                origin,
                seen: seen.as_ref(),
            };
            match (self.ask(&ask), &verdict) {
                (refused @ Verdict::Refuse(_), _) => return refused,
                (Verdict::Wait(until), Verdict::Wait(before)) => verdict = Verdict::Wait(until.max(*before)),
                (Verdict::Go, _) => {}
                (wait, _) => verdict = wait,
            }
        }
        if stage == Stage::Turn && verdict == Verdict::Go {
            verdict = self.clear(intent, now);
        }
        if stage == Stage::Turn && verdict == Verdict::Go {
            self.hold_turn_came(command, now);
        }
        verdict
    }

    /// Whether every rule would let a command be accepted. Nothing is noted: the command is not accepted for another reason.
    pub(crate) fn would_accept(&self, command: &Command, facts: &dyn Facts, now: Instant) -> bool {
        let nothing_known = DriveGate::default();
        command.reach().all(|drive| {
            let seen = facts.seen(drive);
            let ask = Ask {
                stage: Stage::Accept,
                now,
                drive,
                intent: &command.intent,
                origin: command.ticket.origin(),
                seen: seen.as_ref(),
            };
            let known = self.drives.get(&drive).unwrap_or(&nothing_known);
            !matches!(judge::judge(&ask, known, self), Verdict::Refuse(_))
        })
    }

    /// Judges an order for one drive. A refusal is recorded where that matters.
    pub fn ask(&mut self, ask: &Ask<'_>) -> Verdict {
        let nothing_known = DriveGate::default();
        let drive = self.drives.get(&ask.drive).unwrap_or(&nothing_known);
        let verdict = judge::judge(ask, drive, self);
        if let Verdict::Refuse(Outcome::Refused(refusal)) = &verdict {
            if ask.stage == Stage::Accept {
                self.note_refused_run(ask);
            }
            if let Some(starts) = &self.starts {
                starts.count_refused(ask.drive, refusal);
            }
        }
        verdict
    }

    /// Counts the starts of a command that is about to be sent, and checks whether they are on disk.
    fn clear(&mut self, intent: &Intent, now: Instant) -> Verdict {
        let Some(starts) = self.starts.clone() else {
            return Verdict::Go;
        };
        let started: Vec<DriveIndex> = starts.started_by(&intent.effects).collect();
        if started.is_empty() {
            return Verdict::Go;
        }
        let clearance = starts.clear(&started, intent.number, intent.window.expires, now);
        if !self.cleared.iter().any(|(number, _)| *number == intent.number) {
            self.cleared.push((intent.number, started));
        }
        match clearance {
            Clearance::Go => Verdict::Go,
            Clearance::Wait(until) => Verdict::Wait(until),
            Clearance::Refused(guarded) => {
                let refusal = Refusal::Guarded(Box::new(guarded));
                if let Some(drive) = intent.target.drive() {
                    starts.count_refused(drive, &refusal);
                }
                Verdict::refuse(refusal)
            }
        }
    }

    /// Counts cleared starts as made once their commands have ended, whatever those wrote.
    pub fn settle(&mut self, is_alive: impl Fn(u64) -> bool) {
        let Some(starts) = &self.starts else { return };
        self.cleared.retain(|(number, drives)| {
            let alive = is_alive(*number);
            if !alive {
                drives.iter().for_each(|drive| starts.settle(*drive, *number));
            }
            alive
        });
    }

    /// Whether a start was cleared for a command that is not over.
    pub fn has_cleared(&self) -> bool {
        !self.cleared.is_empty()
    }

    /// Notes an accepted command: its client, the slots it overrules, and the hold it takes or ends.
    pub(crate) fn accepted(&mut self, command: &Command, now: Instant) {
        if command.urgency() == Urgency::Read {
            return;
        }
        // This happens before the hold records the command word, which may repeat the last one.
        if !command.is_inherited() {
            self.note_stops(command, now);
        }
        self.hold_accepted(command, now);
        let origin = command.ticket.origin();
        for (drive, effect) in command.intent.effects.iter() {
            let of_drive = self.drive(drive);
            if command.may_start() && !effect.stops {
                of_drive.last_starter = command.intent.number;
            }
            if !command.is_inherited() {
                let slot = command.intent.slot.as_ref();
                of_drive.priorities.accepted(origin, effect, slot, now);
            }
            if origin.kind.is_client() {
                of_drive.commander = origin.login().cloned();
                of_drive.commanded_by(origin.client());
                if effect.stops {
                    of_drive.must_stop_first.retain(|client| client != origin.client());
                }
            }
        }
    }

    /// Keeps which drives a command stops, for the orders that were given before.
    fn note_stops(&mut self, command: &Command, now: Instant) {
        let (origin, connection) = (command.ticket.origin(), &command.intent.window.arrival.connection);
        for (drive, _) in command.intent.effects.iter().filter(|(_, effect)| effect.stops) {
            if command.is_stop() {
                let of_drive = self.drive(drive);
                (of_drive.stops, of_drive.stopped_by) = (of_drive.stops + 1, Some(origin.recorded()));
            }
            if !self.repeats_its_word(drive, origin) {
                self.drive(drive).last_stops.note(connection, now);
            }
        }
    }

    /// A stop joined an accepted one, so nothing is written for it.
    pub(crate) fn stop_joined(&mut self, drive: DriveIndex, origin: &Origin, now: Instant) {
        self.hold_stopped(drive, origin, now);
        let effect = Effect {
            stops: true,
            run: Some(false),
            ..Effect::default()
        };
        let of_drive = self.drive(drive);
        (of_drive.stops, of_drive.stopped_by) = (of_drive.stops + 1, Some(origin.recorded()));
        of_drive.last_stops.note(&Connection::opened(now), now);
        of_drive.priorities.accepted(origin, effect, None, now);
    }

    /// The last pause of the bus.
    pub(crate) fn paused(&self) -> Option<Stall> {
        self.paused
    }

    /// Records that the bus did not run for a time.
    pub fn note_pause(&mut self, pause: Stall) {
        self.paused = Some(pause);
    }

    /// Whether a stop waits until its motor has run for `min_run`.
    pub(crate) fn may_be_delayed(&self, stop: &Command) -> bool {
        let origin = stop.ticket.origin();
        let starts = self.starts.as_ref().filter(|_| origin.kind.stops_may_be_delayed());
        starts.zip(stop.drive()).is_some_and(|(starts, drive)| {
            let last = self.drives.get(&drive).and_then(|drive| drive.last_stops.time());
            starts.is_ordinary_stop(drive, origin.client(), last)
        })
    }

    /// Until when `min_run` delays an ordinary stop of the drive.
    pub fn stop_waits(&self, drive: DriveIndex, now: Instant) -> Option<Instant> {
        self.starts.as_ref()?.stop_waits(drive, now)
    }

    /// Number of stops accepted for this drive, including those accepted by the bus before a reload.
    pub fn stops(&self, drive: DriveIndex) -> u64 {
        self.drives.get(&drive).map_or(0, |drive| drive.stops)
    }

    /// Origin of the last accepted stop of the drive.
    pub(crate) fn last_stop_by(&self, drive: DriveIndex) -> Option<&Origin> {
        self.drives.get(&drive)?.stopped_by.as_ref()
    }

    /// The number of the last accepted command that may start the drive; 0 before the first one.
    pub(crate) fn last_starter(&self, drive: DriveIndex) -> u64 {
        self.drives.get(&drive).map_or(0, |drive| drive.last_starter)
    }

    /// The login that commanded a drive last, unless another client did since.
    pub fn commander(&self, drive: DriveIndex) -> Option<&Arc<str>> {
        self.drives.get(&drive)?.commander.as_ref()
    }

    /// The priority arrays of a drive.
    pub fn priorities(&mut self, drive: DriveIndex) -> &mut Priorities {
        &mut self.drive(drive).priorities
    }

    /// A drill starts, goes silent, or ends on this drive.
    pub(crate) fn set_drill(&mut self, drive: DriveIndex, lock: Option<DrillLock>) {
        self.drive(drive).drill = lock;
    }

    /// The drive to which a drill sends nothing but stops, and until when.
    pub(crate) fn quiet(&self, now: Instant) -> Option<(DriveIndex, Instant)> {
        self.drives.iter().find_map(|(drive, of_drive)| {
            let until = of_drive.drill.as_ref()?.quiet_until.filter(|until| now < *until)?;
            Some((*drive, until))
        })
    }

    /// The start guards, if any drive of the bus has some.
    pub fn starts(&self) -> Option<&Arc<BusGuards>> {
        self.starts.as_ref()
    }

    /// Sets the start guards of the bus.
    pub(crate) fn set_starts(&mut self, starts: Option<Arc<BusGuards>>) {
        self.starts = starts;
    }

    /// Sets the files that may forbid starts until they are read.
    pub(crate) fn set_awaited(&mut self, awaited: Arc<AwaitedFiles>) {
        self.awaited = awaited;
    }

    /// State of the drive for the bus that replaces this one.
    pub(crate) fn inheritance(&mut self, drive: DriveIndex) -> Inheritance {
        let of_drive = self.drive(drive);
        Inheritance {
            stops: of_drive.stops,
            last_stops: of_drive.last_stops.clone(),
            stopped_by: of_drive.stopped_by.clone(),
            commander: of_drive.commander.clone(),
            clients: of_drive.clients.clone(),
            must_stop_first: of_drive.must_stop_first.clone(),
            priorities: of_drive.priorities.clone(),
            holding: of_drive.holding.clone(),
        }
    }

    /// Takes over the state of a machine from the bus before a reload.
    pub(crate) fn inherit(&mut self, drive: DriveIndex, from: Inheritance) {
        let Inheritance {
            stops,
            last_stops,
            stopped_by,
            commander,
            clients,
            must_stop_first,
            priorities,
            mut holding,
        } = from;
        // Local control is not taken over: the next reading reports it again.
        holding.set_local(false, &mut Vec::new());
        let of_drive = self.drive(drive);
        (of_drive.stops, of_drive.last_stops, of_drive.stopped_by) = (stops, last_stops, stopped_by);
        (of_drive.commander, of_drive.clients) = (commander, clients);
        of_drive.must_stop_first = must_stop_first;
        (of_drive.priorities, of_drive.holding) = (priorities, holding);
    }

    /// The clients that commanded a drive, or another machine under its name or unit since which they sent no stop.
    pub(crate) fn clients(&self, drive: DriveIndex) -> Vec<Arc<str>> {
        let of = |drive: &DriveGate| drive.clients.iter().chain(&drive.must_stop_first).cloned().collect();
        self.drives.get(&drive).map_or_else(Vec::new, of)
    }

    /// After a reload a drive has a name or unit under which these clients commanded another machine: they must
    /// send a stop, or take the drive, before they start it.
    pub(crate) fn stop_first(&mut self, drive: DriveIndex, clients: Vec<Arc<str>>) {
        let of_drive = self.drive(drive);
        for client in clients {
            if !of_drive.must_stop_first.contains(&client) {
                of_drive.must_stop_first.push(client);
            }
        }
    }

    /// The stops of a drive that is new count from that number on.
    pub(crate) fn count_stops_from(&mut self, drive: DriveIndex, number: u64) {
        self.drive(drive).stops = number;
    }

    fn claim(&self, origin: &Origin) -> Option<Claim> {
        self.rules.as_ref()?.claim_of(origin)
    }
}
