//! The end of the gateway: polling stops, and each drive with `on_shutdown = "stop"` gets its stop.

use std::task::{Context, Waker};
use std::time::{Duration, Instant};

use tokio::sync::oneshot::Receiver;
use tokio::sync::oneshot::error::TryRecvError;

use super::Master;
use crate::drive_state::FRESH;
use crate::stop_of_line::stop_of_line;
use drivegate_core::order::{Answer, Origin, Outcome, SourceKind};
use drivegate_core::plant::{BusHandle, Exchange, Question};
use drivegate_core::process_image::{Access, DriveImage, OnShutdown};
use drivegate_core::queue::{NotStopped, Stopping};
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// How long the stops wait for the broadcast before them: for a transaction on the line, the broadcast, and the
/// time that the drives need to carry it out.
const BROADCAST: Duration = Duration::from_millis(500);
/// Wait before a stop that was not acknowledged is ordered again.
const AGAIN: Duration = Duration::from_millis(20);

/// The end of the gateway, as a bus carries it out.
#[derive(Debug)]
pub(super) enum Shutdown {
    /// The drives get their stops.
    Stops(Stops),
    /// The end was reported; nothing more is ordered.
    Over,
}

/// The stops of a shutdown.
#[derive(Debug)]
pub(super) struct Stops {
    /// The request of the shutdown.
    stopping: Stopping,
    /// The broadcast that goes before all stops, and until when the stops wait for it.
    broadcast: Option<(Exchange, Instant)>,
    stops: Vec<Stop>,
}

#[derive(Debug)]
struct Stop {
    drive: DriveIndex,
    state: State,
    /// Whether the stop was ordered, and not acknowledged.
    in_vain: bool,
    /// Result of the last try, as text.
    last: Option<String>,
}

#[derive(Debug)]
enum State {
    /// The stop is to be ordered at this time.
    Due(Instant),
    /// The stop is ordered, and its answer awaited.
    Ordered(Receiver<Answer>),
    /// The drive acknowledged its stop.
    Acknowledged,
    /// The stop cannot be ordered, for this reason.
    Refused(String),
}

impl State {
    /// A stop that was not acknowledged is ordered again.
    fn due_again(now: Instant) -> State {
        State::Due(now + AGAIN)
    }
}

impl Stop {
    /// Checks the answer; a failed stop is ordered again at `now`.
    fn check_answer(&mut self, now: Instant) {
        let State::Ordered(answer) = &mut self.state else {
            return;
        };
        self.state = match answer.try_recv() {
            Err(TryRecvError::Empty) => return,
            Ok(answer) if answer.outcome.is_ok() => State::Acknowledged,
            Ok(Answer {
                outcome: outcome @ Outcome::Refused(_),
                ..
            }) => State::Refused(outcome.to_string()),
            Ok(answer) => {
                self.last = Some(answer.outcome.to_string());
                State::due_again(now)
            }
            Err(TryRecvError::Closed) => State::due_again(now),
        };
        self.in_vain |= matches!(self.state, State::Due(_));
    }

    fn is_over(&self) -> bool {
        matches!(self.state, State::Acknowledged | State::Refused(_))
    }
}

impl Shutdown {
    /// Reports the drives that were not stopped, unless that was done before.
    pub(super) fn end(&mut self, bus: &BusHandle) {
        if let Shutdown::Stops(stops) = std::mem::replace(self, Shutdown::Over) {
            stops.report(bus);
        }
    }
}

impl Stops {
    fn new(stopping: Stopping, bus: &BusHandle, now: Instant) -> Stops {
        let drives = bus.image.drives.enumerate();
        let wanted = drives.filter(|(_, image)| is_to_stop(image));
        let stop = |(drive, _)| Stop {
            drive,
            state: State::Due(now),
            in_vain: false,
            last: None,
        };
        Stops {
            stopping,
            broadcast: broadcast(bus, now).map(|exchange| (exchange, now + BROADCAST)),
            stops: wanted.map(stop).collect(),
        }
    }

    /// Whether the stops still wait for the broadcast.
    fn waits_for_broadcast(&mut self, now: Instant) -> bool {
        let Some((exchange, until)) = &mut self.broadcast else {
            return false;
        };
        let over = exchange.poll(&mut Context::from_waker(Waker::noop())).is_ready();
        if over || now >= *until {
            // Dropping the broadcast withdraws it if it was not sent yet.
            self.broadcast = None;
        }
        self.broadcast.is_some()
    }

    /// Reports the drives that were not stopped, in words.
    fn report(self, bus: &BusHandle) {
        let name = |index: DriveIndex| bus.image.drives.of(index).spec.name.as_str();
        let missing = self.stops.iter().filter_map(|stop| {
            let why = match (&stop.state, &stop.last) {
                (State::Acknowledged, _) => return None,
                (State::Refused(why), _) => format!("was not sent its stop command ({why})"),
                (State::Due(_) | State::Ordered(_), Some(last)) => format!("did not acknowledge its stop ({last})"),
                (State::Due(_) | State::Ordered(_), None) => "did not acknowledge its stop".to_string(),
            };
            let drive = name(stop.drive).to_string();
            Some(NotStopped { drive, why })
        });
        self.stopping.report(missing.collect());
    }
}

impl Master {
    /// Starts a requested shutdown; orders due stops, and ends when all are done or the time has ended.
    pub(super) fn check_shutdown(&mut self, now: Instant) {
        // The lock on the queue must be free again when the broadcast is added.
        let stopping = self.bus.queue.lock().take_stopping();
        if let Some(stopping) = stopping {
            self.shutdown = Some(Shutdown::Stops(Stops::new(stopping, &self.bus, now)));
        }
        let Master {
            shutdown,
            bus,
            schedule,
            ..
        } = self;
        let Some(Shutdown::Stops(stops)) = shutdown else { return };
        let deadline = stops.stopping.deadline();
        if stops.waits_for_broadcast(now) {
            return;
        }
        stops.stops.iter_mut().for_each(|stop| stop.check_answer(now));
        if stops.stops.iter().all(Stop::is_over) || now >= deadline {
            if let Some(shutdown) = shutdown {
                shutdown.end(bus);
            }
            return;
        }
        // Silent drives come last, because each of them costs a whole timeout. Without polls, a drive that was
        // online before it went silent keeps counting as online.
        let answers = |stop: &Stop| schedule.is_online(stop.drive) && !stop.in_vain;
        let others_first = stops.stops.iter().any(|stop| !stop.is_over() && answers(stop));
        for stop in &mut stops.stops {
            let due = matches!(stop.state, State::Due(at) if at <= now);
            if due && (schedule.is_online(stop.drive) || !others_first) {
                stop.state = order(bus, stop.drive, deadline, now);
            }
        }
    }
}

/// Whether the drive is to be stopped with the gateway.
fn is_to_stop(image: &DriveImage) -> bool {
    image.spec.on_shutdown == OnShutdown::Stop && image.spec.access == Access::Control
}

/// The broadcast that stops all drives of the bus, if all of them are to be stopped and at least one of them answers.
fn broadcast(bus: &BusHandle, now: Instant) -> Option<Exchange> {
    let drives = &bus.image.drives;
    let all = drives
        .iter()
        .all(|image| matches!(image.spec.on_shutdown, OnShutdown::Stop));
    let online = drives.iter().any(|image| image.snapshot().link.is_online());
    let pdu = stop_of_line(&bus.image.spec, drives.iter().map(|image| &image.spec)).filter(|_| all && online)?;
    let question = Question::broadcast(pdu, Origin::new(SourceKind::Shutdown, "on_shutdown"), now, BROADCAST);
    Some(bus.ask(question, now))
}

fn order(bus: &BusHandle, drive: DriveIndex, deadline: Instant, now: Instant) -> State {
    let image = bus.image.drives.of(drive);
    let origin = Origin::new(SourceKind::Shutdown, "on_shutdown");
    let reading = image.reading(now, FRESH);
    let expiry = deadline.saturating_duration_since(now);
    let stop = Value::Bool(false);
    match bus.own_order(drive, &reading, (ModelPoint::Run, stop), origin, expiry) {
        Ok(answer) => State::Ordered(answer),
        Err(refusal) => State::Refused(refusal.to_string()),
    }
}
