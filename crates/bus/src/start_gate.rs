//! Starts of guarded drives, as the master asks for them: who may go when its turn comes, what was written, what is refused; and
//! the stops of interlocks that do not hold any more. Pure: time is an argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot::Receiver;
use tokio::sync::oneshot::error::TryRecvError;

use super::command_run::KnownWords;
use super::drive_state::{DriveState, Wanted};
use super::news::News;
use super::supervision::written_run;
use crate::codec::RequestPdu;
use crate::command::{
    Answer, Command, DEFAULT_EXPIRY, Origin, Outcome, Pending, Refusal, SourceKind, Urgency, WriteStats, written,
};
use crate::drive::{DriveIndex, ModelPoint, PerDrive, Profile, Value};
use crate::order::Stall;
use crate::plant::{BusHandle, turn_away};
use crate::process_image::{DriveImage, Reading};
use crate::start_guard::{BusGuards, Clearance};

/// First and longest pause before a motor that an interlock stopped and that runs on is stopped again.
const AGAIN: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));
/// After the start of the bus, and after a time in which it stood still, so long a point that was not read since stops no
/// motor.
const FIRST_READ: Duration = Duration::from_secs(10);

/// The guards of the bus, and their starts in progress.
#[derive(Debug)]
pub(super) struct StartGate {
    guards: Arc<BusGuards>,
    began: Instant,
    /// Until when the thread last stood still.
    stood: Option<Instant>,
    /// Commands that were cleared and are not over, with the drives that they start.
    cleared: Vec<(u64, Vec<DriveIndex>)>,
    /// Commands that wait and are to be refused.
    refused: Vec<(u64, DriveIndex, Refusal)>,
    /// News to report.
    told: Vec<News>,
    trips: PerDrive<Trip>,
}

/// The start that a command causes.
#[derive(Debug, Clone)]
pub(crate) struct Start {
    /// Its number in the queue.
    pub number: u64,
    /// The client that gave it.
    pub client: Arc<str>,
}

/// The stop of an interlock that does not hold.
#[derive(Debug, Default)]
struct Trip {
    answer: Option<Receiver<Answer>>,
    next: Option<Instant>,
    pause: Duration,
    is_told: bool,
}

impl StartGate {
    pub(super) fn of(bus: &BusHandle, now: Instant) -> Option<StartGate> {
        let guards = bus.queue.guards()?.clone();
        let trips = bus.image.drives.iter().map(|_| Trip::default()).collect();
        Some(StartGate {
            guards,
            began: now,
            stood: None,
            cleared: Vec::new(),
            refused: Vec::new(),
            told: Vec::new(),
            trips,
        })
    }

    /// The start of that drive that a command causes, if its starts are counted.
    pub(super) fn start_of(&self, command: &Command, drive: DriveIndex) -> Option<Start> {
        let starts = self.guards.guards(drive) && command.effect(drive).run == Some(true);
        starts.then(|| Start {
            number: command.number,
            client: command.ticket.origin().client().clone(),
        })
    }

    /// Whether a command that could start now may start its motor; for a stop, whether it need not wait.
    ///
    /// # Errors
    /// When, if it must wait.
    pub(super) fn may_go(&mut self, command: &Command, now: Instant) -> Result<bool, Instant> {
        match command.urgency {
            Urgency::Read => return Ok(true),
            Urgency::Stop => {
                let waits = command.is_ordinary.then(|| self.guards.stop_waits(command.drive, now));
                return waits.flatten().map_or(Ok(true), Err);
            }
            Urgency::Command => {}
        }
        let reach = command.reach().iter().copied();
        let started: Vec<DriveIndex> = reach.filter(|drive| self.start_of(command, *drive).is_some()).collect();
        let Some(first) = started.first().copied() else {
            return Ok(true);
        };
        let clearance = self.guards.clear(command, now);
        if !self.cleared.iter().any(|(number, _)| *number == command.number) {
            self.cleared.push((command.number, started));
        }
        match clearance {
            Clearance::Go => Ok(true),
            Clearance::Wait(until) => Err(until),
            Clearance::Refused(refusal) => {
                self.refused.push((command.number, first, refusal));
                Ok(false)
            }
        }
    }

    /// The thread stood still.
    pub(super) fn stood(&mut self, stall: Stall) {
        self.stood = Some(stall.ended);
    }

    /// Ends the refused commands. Returns whether there were any.
    pub(super) fn refuse(&mut self, pending: &mut Pending, now: Instant) -> bool {
        let refused = std::mem::take(&mut self.refused);
        let any = !refused.is_empty();
        for (number, drive, refusal) in refused {
            if let Some((origin, what)) = pending.refuse(number, &refusal, now) {
                self.told.push(News::StartRefused {
                    drive,
                    origin,
                    what,
                    refusal,
                });
            }
        }
        any
    }

    /// A started command is about to write: if it would start the motor and may no longer do so, it ends.
    pub(super) fn forbids(&mut self, index: DriveIndex, drive: &mut DriveState, wanted: &Wanted, now: Instant) -> bool {
        let Wanted::Step(Urgency::Command, step) = wanted else {
            return false;
        };
        let Some(refusal) = self.may_not_write(index, drive, &step.pdu, now) else {
            return false;
        };
        let Some(run) = drive.run(Urgency::Command) else {
            return false;
        };
        self.guards.count_refused(index, &refusal);
        if let Some((origin, what)) = run.refuse(refusal.clone()) {
            self.told.push(News::StartRefused {
                drive: index,
                origin,
                what,
                refusal,
            });
        }
        true
    }

    /// Why a started command may not write.
    pub(super) fn may_not_write(
        &self,
        index: DriveIndex,
        drive: &mut DriveState,
        pdu: &RequestPdu,
        now: Instant,
    ) -> Option<Refusal> {
        let run = drive.run(Urgency::Command).filter(|_| pdu.is_write())?;
        let start = run.start.as_ref().filter(|_| run.may_write_on())?;
        self.guards.may_write(index, start.number, now).err()
    }

    /// Whether a command that was not started here may still start that drive.
    pub(super) fn may_still_write(&self, drive: DriveIndex, number: u64, now: Instant) -> bool {
        self.guards.may_write(drive, number, now).is_ok()
    }

    /// A write is sent, of a command that starts the motor or of another one.
    pub(super) fn written(
        &self,
        index: DriveIndex,
        profile: &Profile,
        pdu: &RequestPdu,
        start: Option<&Start>,
        now: Instant,
    ) {
        if stops(profile, pdu) {
            self.guards.stop_written(index, now);
        } else if let Some(start) = start {
            self.guards.start_written(index, start.number, &start.client, now);
        }
    }

    /// Commands that were cleared and have ended count as made, whatever they wrote.
    pub(super) fn settle(&mut self, is_alive: impl Fn(u64) -> bool) {
        let guards = &self.guards;
        self.cleared.retain(|(number, drives)| {
            let alive = is_alive(*number);
            if !alive {
                drives.iter().for_each(|drive| guards.settle(*drive, *number));
            }
            alive
        });
    }

    /// Whether a command was cleared that is not over.
    pub(super) fn has_cleared(&self) -> bool {
        !self.cleared.is_empty()
    }

    /// Updates the state of a drive.
    pub(super) fn look(&self, index: DriveIndex, drive: &mut DriveState, reading: &Reading<'_>) {
        if let Some(run) = drive.acknowledged.take() {
            self.guards.acknowledged(index, run, reading.now);
        }
        self.guards.look(index, reading);
    }

    /// Whether a drive has to be looked at.
    pub(super) fn guards(&self, index: DriveIndex) -> bool {
        self.guards.guards(index)
    }

    /// News to report.
    pub(super) fn take_told(&mut self) -> Vec<News> {
        std::mem::take(&mut self.told)
    }

    /// Stops a motor that runs though an interlock that stops it does not hold.
    pub(super) fn look_at_interlocks(
        &mut self,
        bus: &BusHandle,
        (index, image): (DriveIndex, &Arc<DriveImage>),
        words: &KnownWords,
        reading: &Reading<'_>,
        writes: &Arc<WriteStats>,
    ) {
        let now = reading.now;
        let Some(trip) = self.trips.get_mut(index).filter(|_| self.guards.trips(index)) else {
            return;
        };
        trip.note_answer(now);
        let mut unmet = self.guards.unmet(index, true, now);
        if now < self.began + FIRST_READ {
            unmet.retain(|unmet| unmet.was_read());
        }
        if let Some(until) = self.stood.filter(|until| now < *until + FIRST_READ) {
            // A first reading since decides.
            unmet.retain(|unmet| unmet.met_last().is_none_or(|at| at > until));
        }
        if unmet.is_empty() || !may_run(reading, words) {
            (trip.next, trip.pause, trip.is_told) = (None, AGAIN.0, false);
            return;
        }
        let due = trip.answer.is_none() && trip.next.is_none_or(|at| at <= now);
        if !due || !reading.snapshot.link.is_online() {
            return;
        }
        trip.next = Some(now + trip.pause.max(AGAIN.0));
        let origin = Origin::new(SourceKind::Interlock, "interlock");
        let stop = (ModelPoint::Run, Value::Bool(false));
        match bus.own_order(index, reading, stop, origin.clone(), DEFAULT_EXPIRY, writes) {
            Ok(answer) => trip.answer = Some(answer),
            Err(refusal) => {
                turn_away(
                    writes,
                    &image.spec.name,
                    "run=false",
                    Outcome::Refused(refusal),
                    origin,
                    now,
                );
            }
        }
        if !std::mem::replace(&mut trip.is_told, true) {
            let unmet: Vec<String> = unmet.iter().map(ToString::to_string).collect();
            let why = unmet.join(", ");
            self.told.push(News::Tripped { drive: index, why });
        }
    }
}

impl Trip {
    fn note_answer(&mut self, now: Instant) {
        let Some(answer) = &mut self.answer else { return };
        match answer.try_recv() {
            Err(TryRecvError::Empty) => return,
            Ok(answer) if answer.outcome.is_ok() => {
                // The motor may take its time.
                self.next = Some(now + self.pause);
                self.pause = AGAIN.1.min(2 * self.pause);
            }
            Ok(_) | Err(TryRecvError::Closed) => self.next = Some(now + AGAIN.0),
        }
        self.answer = None;
    }
}

/// Whether the motor runs, or has its run command.
fn may_run(reading: &Reading<'_>, words: &KnownWords) -> bool {
    let commanded = || reading.is_set(ModelPoint::Run) || written_run(reading, words) == Some(true);
    reading.is_set(ModelPoint::Running) || commanded()
}

/// Whether a write takes the run command away.
fn stops(profile: &Profile, pdu: &RequestPdu) -> bool {
    let Some((table, items)) = written(pdu) else {
        return false;
    };
    items
        .iter()
        .any(|(address, word)| profile.is_stop(table, *address, *word))
}
