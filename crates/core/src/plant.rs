//! The plant as the servers use it: images to read, queues to write to. No clock: time is an argument.

mod earlier_meanings;
mod exchange;
mod hold;
mod orders;
mod placed;
mod slots;
mod why;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;

use crate::event::{Event, Events};
use crate::order::{Answer, CommandLog, Origin, Outcome, Refusal};
use crate::permit::Priorities;
use crate::process_image::{Access, BusImage, DriveImage, Machine, Reading};
use crate::queue::CommandQueue;
use drivegate_model::drive::DriveIndex;
use drivegate_model::drive::why::Explanation;

pub use self::earlier_meanings::{DriveKey, EarlierMeanings, FormerMachine, NamedBy, UnusedNames};
pub use self::exchange::{Exchange, Question};
pub use self::orders::{OrderRequest, turn_away};
pub use self::placed::{Placed, Shown};
pub use self::why::explain;
pub use crate::order::Target;

/// The present plant; a reload replaces it.
pub type SharedPlant = Arc<ArcSwap<Plant>>;

/// The first stop number of the next drive that is started or added.
static ADDED: AtomicU64 = AtomicU64::new(STOPS_OF_ONE);
/// More stops than one drive ever gets, yet small enough that the numbers of all drives of a bus can be added after
/// any number of reloads.
const STOPS_OF_ONE: u64 = 1 << 32;

/// A bus with its image and its command queue.
#[derive(Debug, Clone)]
pub struct BusHandle {
    /// The process image of the bus.
    pub image: Arc<BusImage>,
    /// The command queue of the bus.
    pub queue: Arc<CommandQueue>,
    /// Drives that the names and units of the bus meant before reloads.
    pub formerly: Arc<EarlierMeanings>,
    /// The log of commands, the same for all buses of a gateway.
    pub command_log: Arc<CommandLog>,
}

impl BusHandle {
    /// A bus whose names and units have meant no other drives so far.
    pub fn new(image: Arc<BusImage>, queue: Arc<CommandQueue>, command_log: Arc<CommandLog>) -> BusHandle {
        BusHandle {
            image,
            queue,
            formerly: Arc::default(),
            command_log,
        }
    }

    /// Takes over the state of the drives, and their waiting stops, from the buses `before` a reload. A drive is
    /// the same if it is the same machine, whatever its name. The stop counter of an added drive starts at a number
    /// that no drive had before, so that a counter remembered under its name does not match.
    pub fn take_over(&self, before: &[BusHandle], now: Instant) {
        for (index, drive) in self.image.drives.enumerate() {
            let machine = self.image.spec.machine(&drive.spec);
            let known = before.iter().find_map(|bus| {
                let same = |image: &Arc<DriveImage>| bus.image.spec.machine(&image.spec) == machine;
                Some((bus, bus.image.drives.position(same)?))
            });
            let Some((bus, place)) = known else {
                let number = ADDED.fetch_add(STOPS_OF_ONE, Ordering::Relaxed);
                self.queue.lock().gate.count_stops_from(index, number);
                continue;
            };
            if let Some(image) = bus.image.drives.get(place) {
                drive.take_over(image);
            }
            let inheritance = bus.queue.lock().gate.inheritance(place);
            self.queue.lock().gate.inherit(index, inheritance);
            // A drive that is only monitored from now on gets no orders.
            if drive.spec.access == Access::Control {
                bus.queue.hand_over(place, &self.queue, index, now);
            }
        }
    }
}

/// All buses of the gateway.
#[derive(Debug)]
pub struct Plant {
    /// Name of the gateway: topics, metric label.
    pub gateway: String,
    /// Age from which a sample of process data is stale.
    pub stale_after: Duration,
    /// The buses in the order of the file.
    pub buses: Vec<BusHandle>,
    /// The events of the gateway.
    pub events: Events,
    /// The log of commands, which the buses have too.
    pub command_log: Arc<CommandLog>,
}

/// Access to one drive.
#[derive(Debug, Clone)]
pub struct DriveHandle {
    pub bus: BusHandle,
    /// Index of the drive on its bus.
    pub index: DriveIndex,
    /// The process image of the drive.
    pub image: Arc<DriveImage>,
    stale_after: Duration,
    events: Events,
}

impl Plant {
    /// A plant without any events so far. All its buses get the log of the first one.
    pub fn new(gateway: impl Into<String>, stale_after: Duration, buses: Vec<BusHandle>) -> Plant {
        let command_log = buses.first().map(|bus| bus.command_log.clone()).unwrap_or_default();
        let of_plant = |bus| BusHandle {
            command_log: command_log.clone(),
            ..bus
        };
        Plant {
            gateway: gateway.into(),
            stale_after,
            buses: buses.into_iter().map(of_plant).collect(),
            events: Events::default(),
            command_log,
        }
    }

    /// Logs and publishes the refusals that were held back for their count and are due at `now`; to be called several
    /// times a second.
    pub fn report_refusals(&self, now: Instant) {
        self.events.publish_due(now);
        self.command_log.audit().record_due(now);
    }

    /// Refuses a command to an unknown drive; audited and counted. `why` names the nearest one.
    pub fn refuse_unknown(&self, drive: &str, what: &str, why: String, origin: Origin, now: Instant) -> Answer {
        let outcome = Outcome::Refused(Refusal::UnknownDrive(why));
        turn_away(&self.command_log, drive, what, outcome, origin, now)
    }

    /// All drives of the plant, bus by bus in the order of the file.
    pub fn drives(&self) -> impl Iterator<Item = DriveHandle> {
        self.buses.iter().flat_map(move |bus| {
            bus.image
                .drives
                .enumerate()
                .map(move |(index, image)| self.handle(bus, index, image))
        })
    }

    pub fn drive(&self, name: &str) -> Option<DriveHandle> {
        self.buses.iter().find_map(|bus| {
            let index = bus.image.drives.position(|drive| drive.spec.name == name)?;
            Some(self.handle(bus, index, bus.image.drives.get(index)?))
        })
    }

    pub fn drive_at(&self, machine: &Machine) -> Option<DriveHandle> {
        self.drives().find(|drive| drive.machine() == *machine)
    }

    fn handle(&self, bus: &BusHandle, index: DriveIndex, image: &Arc<DriveImage>) -> DriveHandle {
        DriveHandle {
            bus: bus.clone(),
            index,
            image: image.clone(),
            stale_after: self.stale_after,
            events: self.events.clone(),
        }
    }
}

impl DriveHandle {
    /// Time for which a stop of the drive still waits because of `min_run`.
    pub fn stop_waits(&self, now: Instant) -> Option<Duration> {
        let until = self.bus.queue.lock().stop_waits(self.index, now)?;
        Some(until.saturating_duration_since(now))
    }

    /// The machine that is meant, under any name.
    pub fn machine(&self) -> Machine {
        self.bus.image.spec.machine(&self.image.spec)
    }

    /// The state of the drive at the time `now`.
    pub fn reading(&self, now: Instant) -> Reading<'_> {
        self.image.reading(now, self.stale_after)
    }

    /// Counter of the stops accepted for the drive, from any first number; the counter changes when a reload
    /// removed and added the drive, or changed its address.
    pub fn stops(&self) -> u64 {
        self.bus.queue.lock().gate.stops(self.index)
    }

    /// The number of the last command taken in that may start the drive.
    pub(crate) fn last_starter(&self) -> u64 {
        self.bus.queue.lock().gate.last_starter(self.index)
    }

    /// See [`Pending::joins_stop`](crate::queue::Pending::joins_stop).
    pub(crate) fn joins_stop(&self, last_starter: u64, by: &Origin, now: Instant) -> bool {
        let joins = self.bus.queue.lock().joins_stop(self.index, last_starter, by, now);
        self.bus.queue.wake();
        joins
    }

    /// Origin of the last accepted stop; `None` before the first stop.
    pub(crate) fn last_stop_by(&self) -> Option<Origin> {
        self.bus.queue.lock().gate.last_stop_by(self.index).cloned()
    }

    /// The login that commanded the drive last, unless another client did since.
    pub fn commander(&self) -> Option<Arc<str>> {
        self.bus.queue.lock().gate.commander(self.index).cloned()
    }

    /// Whether the drive of `reading` runs, and why not.
    pub fn why(&self, reading: &Reading<'_>) -> Explanation {
        let explanation = explain(reading, &self.bus.image, &self.bus.command_log);
        let mut explanation = self.with_reservation(explanation, reading.now);
        let guards = self.bus.queue.guards().filter(|_| explanation.runs == Some(false));
        if let Some(hindrance) = guards.and_then(|guards| guards.hindrance(self.index, reading.now)) {
            explanation.add(why::guarded(&hindrance));
        }
        explanation
    }

    /// Whether the port of the bus is open.
    pub fn bus_up(&self) -> bool {
        self.bus.image.is_up()
    }

    /// Calls `with` for the priority arrays of the drive.
    pub fn priorities<T>(&self, with: impl FnOnce(&mut Priorities) -> T) -> T {
        with(self.bus.queue.lock().gate.priorities(self.index))
    }

    /// Publishes an event of the drive.
    pub fn publish(&self, event: Event) {
        self.events.publish(event);
    }

    /// Passes a request on to the line of the drive; see [`BusHandle::ask`].
    pub fn ask_line(&self, question: Question, now: Instant) -> Exchange {
        self.bus.ask(question, now)
    }
}
