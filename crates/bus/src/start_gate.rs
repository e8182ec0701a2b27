//! Starts of guarded drives on the line: which were written and which were read; and the stops of interlocks that
//! no longer hold. Pure: time is an argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot::Receiver;
use tokio::sync::oneshot::error::TryRecvError;

use super::command_run::KnownWords;
use super::drive_state::DriveState;
use super::news::News;
use super::supervision::written_run;
use drivegate_core::order::{Answer, DEFAULT_EXPIRY, Intent, Origin, Outcome, SourceKind, written};
use drivegate_core::plant::{BusHandle, turn_away};
use drivegate_core::process_image::{DriveImage, Reading};
use drivegate_core::stalls::Stall;
use drivegate_core::start_guard::BusGuards;
use drivegate_model::drive::{DriveIndex, ModelPoint, PerDrive, Profile, Value};
use drivegate_proto::RequestPdu;

/// First and longest pause before a motor that keeps running after an interlock's stop is stopped again.
const AGAIN: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));
/// Time after a stall of the thread in which a point that was not read since stops no motor.
const FIRST_READ: Duration = Duration::from_secs(10);

/// The guards of the bus, and the stops of their interlocks.
#[derive(Debug)]
pub(super) struct StartGate {
    guards: Arc<BusGuards>,
    /// Until when the thread was last stalled.
    stood: Option<Instant>,
    /// Results that are to be reported.
    told: Vec<News>,
    trips: PerDrive<Trip>,
}

/// The start of a motor that a command causes.
#[derive(Debug, Clone)]
pub(crate) struct Start {
    /// The number of the command.
    pub number: u64,
    /// The client that caused the start.
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
    pub(super) fn of(bus: &BusHandle) -> Option<StartGate> {
        let guards = bus.queue.guards()?.clone();
        let trips = bus.image.drives.iter().map(|_| Trip::default()).collect();
        Some(StartGate {
            guards,
            stood: None,
            told: Vec::new(),
            trips,
        })
    }

    /// The start of this drive that an order of this client causes, if its starts are counted.
    pub(super) fn start_of(&self, intent: &Intent, origin: &Origin, drive: DriveIndex) -> Option<Start> {
        let starts = self.guards.guards(drive) && intent.effects.on(drive).starts();
        starts.then(|| Start {
            number: intent.number,
            client: origin.client().clone(),
        })
    }

    /// Notes that the thread was stalled.
    pub(super) fn after_stall(&mut self, stall: Stall) {
        self.stood = Some(stall.ended);
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

    /// Updates the starts of a drive from a reading.
    pub(super) fn update(&self, index: DriveIndex, drive: &mut DriveState, reading: &Reading<'_>) {
        if let Some(run) = drive.acknowledged.take() {
            self.guards.acknowledged(index, run, reading.now);
        }
        self.guards.update(index, reading);
    }

    /// Whether a drive has to be looked at.
    pub(super) fn guards(&self, index: DriveIndex) -> bool {
        self.guards.guards(index)
    }

    /// Takes the results that are to be reported.
    pub(super) fn take_news(&mut self) -> Vec<News> {
        std::mem::take(&mut self.told)
    }

    /// Stops a motor that runs though an interlock that stops it does not hold.
    pub(super) fn check_interlocks(
        &mut self,
        bus: &BusHandle,
        index: DriveIndex,
        image: &DriveImage,
        words: &KnownWords,
        reading: &Reading<'_>,
    ) {
        let now = reading.now;
        if !self.guards.trips(index) {
            return;
        }
        let trip = self.trips.of_mut(index);
        trip.note_answer(now);
        // The first reading after the stall decides.
        let stood = self.stood.filter(|until| now < *until + FIRST_READ);
        let unmet = self.guards.tripped(index, stood, now);
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
        match bus.own_order(index, reading, stop, origin.clone(), DEFAULT_EXPIRY) {
            Ok(answer) => trip.answer = Some(answer),
            Err(refusal) => {
                turn_away(
                    &bus.command_log,
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
                // The motor may need time to stop.
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
    let commanded = || reading.is_set(ModelPoint::Run) || written_run(&reading.spec.profile, words) == Some(true);
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
