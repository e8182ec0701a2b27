//! Earlier meanings of the name or the unit id of a drive: an order belongs to the machine that it named when its
//! first byte arrived. Pure: time is an argument.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use super::{BusHandle, DriveHandle};
use crate::order::{Arrival, Order, Parts, Refusal, SourceKind};
use crate::permit::meant_another;
use crate::process_image::{BusImage, DriveImage, DriveSpec, Machine};
use crate::queue::CommandQueue;
use drivegate_model::drive::{DriveIndex, ModelPoint, Value};

/// Time after a reload during which the first bytes of an order may be from before the reload: connections that are
/// silent for longer are closed.
const REMEMBERED: Duration = Duration::from_secs(3600);
/// Changes of meaning that are remembered of one name or unit id.
const MOST: usize = 8;
/// Names and unit ids without a drive that are remembered.
const MOST_UNUSED: usize = 4096;

/// How an order names its drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
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
    until: Instant,
    machine: Option<Machine>,
    /// Where the machine is served now, if it still is.
    served: Option<Served>,
}

/// The machine that an order meant, if its name means another machine now.
#[derive(Debug)]
pub(super) enum FormerMachine {
    /// The machine is served under another name.
    There(Box<DriveHandle>),
    /// No bus serves that machine any more, or there was none.
    Gone,
}

/// Earlier meanings of the names and units of the drives of a bus, oldest first.
#[derive(Debug, Default)]
pub struct EarlierMeanings(Mutex<BTreeMap<(DriveIndex, By), Vec<EarlierMeaning>>>);

impl EarlierMeanings {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<(DriveIndex, By), Vec<EarlierMeaning>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn of(&self, drive: DriveIndex, by: By) -> Vec<EarlierMeaning> {
        self.lock().get(&(drive, by)).cloned().unwrap_or_default()
    }

    /// What the name or unit id of the drive meant at `asked`: the record of the first change after that time.
    fn meaning_at(&self, drive: DriveIndex, by: By, asked: Instant) -> Option<EarlierMeaning> {
        let all = self.lock();
        let mut of_drive = all.get(&(drive, by))?.iter();
        of_drive.find(|former| asked <= former.until).cloned()
    }
}

/// A name or unit id of drives.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Key {
    Name(String),
    Unit(u8),
}

impl Key {
    fn of(by: By, drive: &DriveSpec) -> Key {
        match by {
            By::Name => Key::Name(drive.name.clone()),
            By::Unit => Key::Unit(drive.unit),
        }
    }
}

/// What a name or unit id meant before a reload.
#[derive(Debug, Clone)]
struct Meaning {
    machine: Machine,
    /// What it had meant before that.
    earlier: Vec<EarlierMeaning>,
    /// The clients that commanded under it.
    clients: Vec<Arc<str>>,
    /// When a reload took it from its drive; `None` if a drive has it until the present reload.
    ended: Option<Instant>,
}

/// Names and unit ids that no drive has any more: a drive that gets one of them later is another machine to the clients
/// that commanded under it.
#[derive(Debug, Default)]
pub struct UnusedNames(BTreeMap<Key, Meaning>);

impl UnusedNames {
    /// After a reload: records what the names and units of drives meant until now, and makes clients that commanded
    /// under them take the drive before they start its motor. `before` are all buses before the reload, `after` all
    /// buses now; buses that continue are in both.
    pub fn follow(&mut self, before: &[BusHandle], after: &[BusHandle], now: Instant) {
        let former: BTreeMap<Key, Meaning> = before.iter().flat_map(meanings).collect();
        let mut used: BTreeSet<Key> = BTreeSet::new();
        for bus in after {
            for (index, drive) in bus.image.drives.enumerate() {
                for by in [By::Name, By::Unit] {
                    let key = Key::of(by, &drive.spec);
                    let was = former.get(&key).cloned().or_else(|| self.0.remove(&key));
                    let machine = bus.image.spec.machine(&drive.spec);
                    bus.give_meaning((index, by), &machine, was, after, now);
                    used.insert(key);
                }
            }
        }
        let ended = |meaning: Meaning| Meaning {
            ended: Some(now),
            ..meaning
        };
        let gone = former.into_iter().filter(|(key, _)| !used.contains(key));
        self.0.extend(gone.map(|(key, meaning)| (key, ended(meaning))));
        while self.0.len() > MOST_UNUSED {
            let oldest = self.0.iter().min_by_key(|(_, meaning)| meaning.ended);
            let Some(oldest) = oldest.map(|(key, _)| key.clone()) else {
                break;
            };
            self.0.remove(&oldest);
        }
    }
}

/// What the names and unit ids of a bus mean.
fn meanings(bus: &BusHandle) -> Vec<(Key, Meaning)> {
    let of_drive = |(index, drive): (DriveIndex, &Arc<DriveImage>)| {
        let clients = bus.queue.lock().gate.clients(index);
        [By::Name, By::Unit].map(|by| {
            let meaning = Meaning {
                machine: bus.image.spec.machine(&drive.spec),
                earlier: bus.formerly.of(index, by),
                clients: clients.clone(),
                ended: None,
            };
            (Key::of(by, &drive.spec), meaning)
        })
    };
    bus.image.drives.enumerate().flat_map(of_drive).collect()
}

impl BusHandle {
    /// A drive has its name or unit id since the reload at `now`, or had it before.
    fn give_meaning(
        &self,
        (index, by): (DriveIndex, By),
        machine: &Machine,
        was: Option<Meaning>,
        after: &[BusHandle],
        now: Instant,
    ) {
        let is_same = was.as_ref().is_some_and(|was| was.machine == *machine);
        let ended = was.as_ref().and_then(|was| was.ended);
        let (before, mut all, clients) = match was {
            Some(was) => (Some(was.machine), was.earlier, was.clients),
            None => (None, Vec::new(), Vec::new()),
        };
        let meant = |until: Instant, machine: Option<Machine>| EarlierMeaning {
            until,
            machine,
            served: None,
        };
        match ended {
            // Between two reloads the name meant no drive.
            Some(ended) => all.extend([meant(ended, before), meant(now, None)]),
            None if !is_same => all.push(meant(now, before)),
            None => {}
        }
        all.retain(|former| now < former.until + REMEMBERED);
        all.drain(..all.len().saturating_sub(MOST));
        for former in &mut all {
            let machine = former.machine.as_ref();
            former.served = machine.and_then(|machine| after.iter().find_map(|bus| bus.serves(machine)));
        }
        self.formerly.lock().insert((index, by), all);
        if !is_same {
            self.queue.lock().gate.stop_first(index, clients);
        }
    }

    fn serves(&self, machine: &Machine) -> Option<Served> {
        let place = self
            .image
            .drives
            .position(|drive| self.image.spec.machine(&drive.spec) == *machine)?;
        Some(Served {
            image: Arc::downgrade(&self.image),
            queue: Arc::downgrade(&self.queue),
            formerly: Arc::downgrade(&self.formerly),
            place,
        })
    }
}

impl DriveHandle {
    /// Checks a request that acts on this drive but is not an order to it.
    ///
    /// # Errors
    /// If the name or unit in the request meant another machine when the request began; contains the refusal.
    pub fn is_meant(&self, kind: SourceKind, arrival: &Arrival) -> Result<(), Refusal> {
        self.meant(kind, arrival).map_or(Ok(()), |_| Err(meant_another()))
    }

    /// The machine that an order of this kind meant when it arrived, if its name means another machine now.
    pub(super) fn meant(&self, kind: SourceKind, arrival: &Arrival) -> Option<FormerMachine> {
        let former = self.bus.formerly.meaning_at(self.index, By::of(kind)?, arrival.asked)?;
        let there = former.served.and_then(|served| {
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

#[cfg(test)]
mod tests;
