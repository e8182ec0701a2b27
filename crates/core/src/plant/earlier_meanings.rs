//! Earlier meanings of the name or the unit id of a drive: an order belongs to the machine that it named when its
//! first byte arrived. Pure: time is an argument.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use super::{BusHandle, DriveHandle};
use crate::order::{Arrival, Order, Parts, SourceKind};
use crate::process_image::BusImage;
use crate::queue::CommandQueue;
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// Time after a reload during which the first bytes of an order may be from before the reload: connections that are
/// silent for longer are closed.
const REMEMBERED: Duration = Duration::from_secs(3600);
/// Changes of meaning that are remembered of one drive.
const MOST: usize = 8;

/// How an order names its drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum By {
    /// The order uses the name of the drive.
    Name,
    /// By the unit id, or by the BACnet device number derived from it.
    Unit,
}

impl By {
    /// How orders of this kind name their drive; `None` if they use the address on the line.
    fn of(kind: SourceKind) -> Option<By> {
        match kind {
            SourceKind::ModbusTcp | SourceKind::Bacnet => Some(By::Unit),
            SourceKind::Mqtt | SourceKind::Sparkplug | SourceKind::Http | SourceKind::LocalSocket => Some(By::Name),
            SourceKind::CommandLine
            | SourceKind::Slot
            | SourceKind::OtherMaster
            | SourceKind::Schedule
            | SourceKind::Supervision
            | SourceKind::Shutdown
            | SourceKind::Interlock => None,
        }
    }
}

/// A machine that a bus serves, as long as the bus exists.
#[derive(Debug, Clone)]
struct Served {
    image: Weak<BusImage>,
    queue: Weak<CommandQueue>,
    formerly: Weak<EarlierMeanings>,
    place: DriveIndex,
}

/// An earlier meaning: until `until` the name or unit id meant another machine, or none.
#[derive(Debug, Clone)]
struct EarlierMeaning {
    by: By,
    until: Instant,
    /// The machine that was meant, if a bus still serves it.
    machine: Option<Served>,
}

/// The machine that an order meant, if its name means another machine now.
#[derive(Debug)]
pub(super) enum FormerMachine {
    /// The machine is served under another name.
    There(Box<DriveHandle>),
    /// No bus serves that machine any more, or there was none.
    Gone,
}

/// Earlier meanings of the names and units of the drives of a bus.
#[derive(Debug, Default)]
pub struct EarlierMeanings(Mutex<BTreeMap<DriveIndex, Vec<EarlierMeaning>>>);

impl EarlierMeanings {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<DriveIndex, Vec<EarlierMeaning>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the name or unit id of the drive meant at `asked`: the record of the first change after that time.
    fn meaning_at(&self, drive: DriveIndex, by: By, asked: Instant) -> Option<EarlierMeaning> {
        let all = self.lock();
        let mut of_drive = all.get(&drive)?.iter();
        of_drive
            .find(|former| former.by == by && asked <= former.until)
            .cloned()
    }

    /// Adds this change, and removes those that no longer matter at `now`.
    fn add(&self, drive: DriveIndex, former: EarlierMeaning, now: Instant) {
        let mut all = self.lock();
        let of_drive = all.entry(drive).or_default();
        of_drive.retain(|former| now < former.until + REMEMBERED);
        if of_drive.len() >= MOST {
            of_drive.remove(0);
        }
        of_drive.push(former);
    }

    /// Takes over the earlier meanings of a machine from the previous bus.
    pub(super) fn take_over(&self, drive: DriveIndex, before: &EarlierMeanings, place: DriveIndex) {
        if let Some(of_drive) = before.lock().get(&place) {
            self.lock().insert(drive, of_drive.clone());
        }
    }
}

/// After a reload: records what the names and units of drives meant until now, and makes clients that commanded
/// under them take the drive before they start its motor. `before` are all buses before the reload, `after` all
/// buses now; buses that continue are in both.
pub fn follow_names(before: &[BusHandle], after: &[BusHandle], now: Instant) {
    for bus in after {
        for (index, drive) in bus.image.drives.enumerate() {
            let machine = bus.image.spec.machine(&drive.spec);
            let (name, unit) = (&drive.spec.name, drive.spec.unit);
            for by in [By::Name, By::Unit] {
                let was = before.iter().find_map(|bus| {
                    let place = bus.image.drives.position(|drive| match by {
                        By::Name => drive.spec.name == *name,
                        By::Unit => drive.spec.unit == unit,
                    })?;
                    let image = bus.image.drives.get(place)?;
                    Some((bus, place, bus.image.spec.machine(&image.spec)))
                });
                if was.as_ref().is_some_and(|(.., was)| *was == machine) {
                    continue;
                }
                let serves = |bus: &BusHandle| {
                    let (.., was) = was.as_ref()?;
                    let place = bus
                        .image
                        .drives
                        .position(|drive| bus.image.spec.machine(&drive.spec) == *was)?;
                    Some(Served {
                        image: Arc::downgrade(&bus.image),
                        queue: Arc::downgrade(&bus.queue),
                        formerly: Arc::downgrade(&bus.formerly),
                        place,
                    })
                };
                let former = EarlierMeaning {
                    by,
                    until: now,
                    machine: after.iter().find_map(serves),
                };
                bus.formerly.add(index, former, now);
                let clients = was.map(|(bus, place, _)| bus.queue.lock().gate.clients(place));
                bus.queue.lock().gate.stop_first(index, clients.unwrap_or_default());
            }
        }
    }
}

impl DriveHandle {
    /// The machine that an order of this kind meant when it arrived, if its name means another machine now.
    pub(super) fn meant(&self, kind: SourceKind, arrival: &Arrival) -> Option<FormerMachine> {
        let former = self.bus.formerly.meaning_at(self.index, By::of(kind)?, arrival.asked)?;
        let there = former.machine.and_then(|served| {
            let bus = BusHandle {
                image: served.image.upgrade()?,
                queue: served.queue.upgrade()?,
                formerly: served.formerly.upgrade()?,
            };
            let index = served.place;
            let image = bus.image.drives.get(index)?.clone();
            Some(DriveHandle {
                bus,
                index,
                image,
                ..self.clone()
            })
        });
        Some(there.map_or(FormerMachine::Gone, |there| FormerMachine::There(Box::new(there))))
    }

    /// The stop for this machine in an order that was parsed for the drive that has its name now; `None` if the
    /// order does not stop.
    pub(super) fn stop_meant(&self, order: &Order, read_for: &DriveHandle) -> Option<Order> {
        let stops = match order {
            Order::Points(_) => is_stop(order.clone(), read_for),
            Order::Write(_) => is_stop(order.clone(), self),
            Order::Read(_) | Order::Parameter(_) => false,
        };
        let run = self.image.spec.profile.model_index(ModelPoint::Run).filter(|_| stops)?;
        Some(Order::Points(vec![(run, Value::Bool(false))]))
    }
}

/// Whether an order takes away the run command of this drive, whatever else it does.
fn is_stop(order: Order, drive: &DriveHandle) -> bool {
    let profile = &drive.image.spec.profile;
    match Parts::of(order, profile) {
        Parts::Two(..) => true,
        Parts::One(Order::Points(values)) => crate::order::stop_of(&values, profile).is_some(),
        Parts::One(Order::Write(pdu)) => crate::order::written(&pdu).is_some_and(|(table, items)| {
            let mut items = items.iter();
            items.any(|(address, word)| profile.is_stop(table, *address, *word))
        }),
        Parts::One(Order::Read(_) | Order::Parameter(_)) => false,
    }
}
