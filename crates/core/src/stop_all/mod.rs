//! Stop all: stops every controlled drive of the gateway, of a bus or of a group, and watches each until its motor is at
//! standstill.
//!
//! All interfaces use one mechanism: [`StopAll::order`] places the stops before it returns, a task of the gateway
//! calls [`StopAll::look`] while a command is in progress, and [`StopAll::begun`] wakes it. If every drive of a bus
//! is included and known to obey it, one broadcast is sent before the single stops. Pure: time is an argument.

mod one_stop;
mod scope;
pub mod stop_of_line;

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Waker};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::sync::{Notify, oneshot};

pub use self::scope::{NamedDrives, NothingToStop, Scope};

pub(crate) use self::one_stop::OneStop;
use self::stop_of_line::stop_of_line;
use crate::order::{Origin, Outcome, Refusal};
use crate::plant::{BusHandle, DriveHandle, Exchange, Plant, Question, turn_away};
use crate::process_image::{Access, Machine, Standstill};

/// Default time after which a command is answered even if not every drive is at standstill.
pub const WAIT: Duration = Duration::from_secs(10);
/// Longest time that a command may set for its answer.
pub const LONGEST_WAIT: Duration = Duration::from_secs(60);
/// Time between two looks at a command that is in progress.
pub const LOOK: Duration = Duration::from_millis(20);
/// Time within which the broadcast is sent; the stops of the single drives do not wait for it.
const BROADCAST: Duration = Duration::from_millis(500);
/// Maximum number of commands that wait for their answers; beyond that the oldest is answered with what is known.
const MOST_ORDERS: usize = 256;

/// The result of the stop for a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Stopped {
    /// The drive acknowledged its stop, and a later read shows that the motor is at standstill.
    Standing,
    /// The drive acknowledged its stop, and the motor still turns.
    Stopping,
    /// Neither an acknowledgement of the stop nor a standstill is known.
    Unproven,
}

/// A drive in the answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StoppedDrive {
    /// Name of the drive.
    pub drive: String,
    /// The result for this drive.
    pub outcome: Stopped,
    /// Why the drive is not known to stand still.
    #[serde(default)]
    pub reason: Option<String>,
}

/// The single answer to a command to stop all.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StopReport {
    /// Whether every motor is known to stand.
    pub ok: bool,
    /// All drives that were to be stopped, in the order of the configuration; last those that a reload took out of reach.
    pub drives: Vec<StoppedDrive>,
}

impl StopReport {
    fn new(drives: Vec<StoppedDrive>) -> StopReport {
        let ok = drives.iter().all(|drive| drive.outcome == Stopped::Standing);
        StopReport { ok, drives }
    }
}

/// Receivers of the answers to a command. A closed channel means that the process ends.
#[derive(Debug)]
pub struct StopOrder {
    /// Resolves when every stop was acknowledged or failed once: whether none failed.
    pub acknowledged: oneshot::Receiver<bool>,
    /// Resolves when every motor is at standstill, or the time limit has passed.
    pub report: oneshot::Receiver<StopReport>,
}

/// The commands that are in progress.
#[derive(Debug, Default)]
pub struct StopAll {
    state: Mutex<State>,
    begun: Notify,
}

#[derive(Debug, Default)]
struct State {
    /// The stops in progress, one for each machine, shared by all commands that include the machine.
    stops: Vec<OneStop>,
    orders: Vec<UnderWay>,
    /// Broadcasts in progress; dropping one withdraws it if it was not sent yet.
    broadcasts: Vec<(Exchange, Instant)>,
}

/// An order in progress.
#[derive(Debug)]
struct UnderWay {
    machines: Vec<Machine>,
    until: Instant,
    acknowledged: Option<oneshot::Sender<bool>>,
    report: oneshot::Sender<StopReport>,
}

impl StopAll {
    /// Stops all drives of `scope` for `origin`, who may write. When this returns every stop is in the queue of its
    /// bus. If an order in progress has stopped a drive and nothing may have started it since, this order joins
    /// that one; any other drive gets a new stop.
    ///
    /// # Errors
    /// If the bus or group does not exist, or none of its drives is controlled.
    pub fn order(
        &self,
        plant: &Plant,
        scope: &Scope,
        origin: &Origin,
        wait: Duration,
        now: Instant,
    ) -> Result<StopOrder, NothingToStop> {
        let (drives, lost) = (scope.drives(plant)?, scope.lost(plant));
        let of_present = drives.iter().map(DriveHandle::machine);
        let machines = of_present
            .chain(lost.iter().map(|(machine, ..)| machine.clone()))
            .collect();
        let origin = &origin.clone().insisting().lasting();
        let (acknowledged, acknowledgement) = oneshot::channel();
        let (report, reported) = oneshot::channel();
        let mut state = self.state();
        state.place(plant, &drives, origin, now);
        lost.into_iter().for_each(|lost| state.miss(plant, lost, origin, now));
        if state.orders.len() >= MOST_ORDERS {
            let oldest = state.orders.remove(0);
            state.answer(oldest, plant, now);
        }
        state.orders.push(UnderWay {
            machines,
            until: now + wait.min(LONGEST_WAIT),
            acknowledged: Some(acknowledged),
            report,
        });
        drop(state);
        self.begun.notify_one();
        Ok(StopOrder {
            acknowledged: acknowledgement,
            report: reported,
        })
    }

    /// Waits until a command is in progress.
    pub async fn begun(&self) {
        self.begun.notified().await;
    }

    /// Checks the results of the stops, repeats those that failed, and answers completed commands. Returns whether
    /// a command is still in progress.
    pub fn advance(&self, plant: &Plant, now: Instant) -> bool {
        let mut state = self.state();
        state.advance(plant, now);
        !state.orders.is_empty()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn place(&mut self, plant: &Plant, drives: &[DriveHandle], origin: &Origin, now: Instant) {
        let machines: Vec<Machine> = drives.iter().map(DriveHandle::machine).collect();
        let mut joins: Vec<Machine> = Vec::new();
        for (drive, machine) in drives.iter().zip(&machines) {
            let stop = self.stops.iter().find(|stop| stop.machine == *machine);
            if stop.is_some_and(|stop| stop.is_joined(drive, origin, now)) {
                note_joined(plant, drive, origin, now);
                joins.push(machine.clone());
            }
        }
        self.stops
            .retain(|stop| joins.contains(&stop.machine) || !machines.contains(&stop.machine));
        for bus in &plant.buses {
            let is_of_bus = |machine: &&Machine| machine.port == bus.image.spec.port;
            let concerned = machines.iter().filter(is_of_bus).count();
            let new = machines
                .iter()
                .filter(is_of_bus)
                .any(|machine| !joins.contains(machine));
            if new && concerned == bus.image.drives.len() {
                let exchange = broadcast(bus, origin, now);
                self.broadcasts
                    .extend(exchange.map(|exchange| (exchange, now + BROADCAST)));
            }
        }
        for (drive, machine) in drives.iter().zip(machines) {
            if !joins.contains(&machine) {
                self.stops.push(OneStop::place(drive, machine, origin, now));
            }
        }
    }

    /// Notes a machine that was to be stopped and is out of reach, so that the report names it.
    fn miss(&mut self, plant: &Plant, lost: (Machine, String, Refusal), origin: &Origin, now: Instant) {
        let (machine, name, refusal) = lost;
        let outcome = Outcome::Refused(refusal.clone());
        turn_away(&plant.command_log, &name, "run=false", outcome, origin.clone(), now);
        if !self.stops.iter().any(|stop| stop.machine == machine) {
            self.stops.push(OneStop::refused(machine, name, origin, &refusal));
        }
    }

    fn advance(&mut self, plant: &Plant, now: Instant) {
        let mut cx = Context::from_waker(Waker::noop());
        self.broadcasts
            .retain_mut(|(exchange, until)| exchange.poll(&mut cx).is_pending() && now < *until);
        self.stops.iter_mut().for_each(|stop| stop.advance(plant, now));
        for mut order in std::mem::take(&mut self.orders) {
            let concerned = || self.stops.iter().filter(|stop| order.machines.contains(&stop.machine));
            let is_answered = concerned().all(|stop| stop.is_acknowledged() || stop.has_failed());
            let all = concerned().all(OneStop::is_acknowledged);
            let stands = concerned().all(|stop| stop.outcome(plant, now).outcome == Stopped::Standing);
            let over = stands || now >= order.until;
            if let Some(acknowledged) = order.acknowledged.take_if(|_| is_answered || over) {
                // The client may have disconnected, so an error is ignored.
                let _ = acknowledged.send(all);
            }
            if over {
                self.answer(order, plant, now)
            } else {
                self.orders.push(order)
            }
        }
        let orders = &self.orders;
        self.stops
            .retain(|stop| orders.iter().any(|order| order.machines.contains(&stop.machine)));
    }

    fn answer(&self, order: UnderWay, plant: &Plant, now: Instant) {
        let of = |machine: &Machine| {
            let stop = self.stops.iter().find(|stop| stop.machine == *machine)?;
            Some(stop.outcome(plant, now))
        };
        let report = StopReport::new(order.machines.iter().filter_map(of).collect());
        // The client may have disconnected, so an error is ignored.
        let _ = order.report.send(report);
    }
}

/// Adds a stop that joins another one to the audit.
fn note_joined(plant: &Plant, drive: &DriveHandle, origin: &Origin, now: Instant) {
    let text = "a stop is already in progress and now counts for this client too; nothing more was written";
    let what = (drive.image.spec.name.as_str(), "run=false");
    plant
        .command_log
        .audit()
        .note(origin, what, ("acknowledged", text), now);
}

/// The broadcast that stops every drive of the bus, if they are known to obey it and at least one of them answers.
fn broadcast(bus: &BusHandle, origin: &Origin, now: Instant) -> Option<Exchange> {
    let drives = &bus.image.drives;
    let online = drives.iter().any(|image| image.snapshot().link.is_online());
    let specs = drives.iter().map(|image| &image.spec);
    let pdu = stop_of_line(&bus.image.spec, specs).filter(|_| online && bus.image.is_up())?;
    let question = Question::broadcast(pdu, origin.clone(), now, BROADCAST);
    Some(bus.ask_first(question, now))
}

/// Number of controlled drives among these that are not known to stand still.
pub fn not_standing<'d>(drives: impl IntoIterator<Item = &'d DriveHandle>, now: Instant) -> usize {
    let controlled = drives
        .into_iter()
        .filter(|drive| drive.image.spec.access == Access::Control);
    let stands = |drive: &&DriveHandle| drive.reading(now).standstill(None) == Standstill::Stands;
    controlled.filter(|drive| !stands(drive)).count()
}

#[cfg(test)]
mod tests;
