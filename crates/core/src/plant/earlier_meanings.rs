//! Earlier meanings of the name, the unit id or the address of a drive: an order belongs to the machine that it named when its
//! first byte arrived. Pure: time is an argument.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use super::{BusHandle, DriveHandle, Plant};
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
pub enum NamedBy {
    /// The order uses the name of the drive.
    Name,
    /// The order uses the unit id, or the BACnet device number derived from it.
    Unit,
    /// The order uses the address on the line of a bus, as those of the tools at a slot do.
    Address,
}

/// The name, the unit id or the address of a drive.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum DriveKey {
    /// The name of a drive.
    Name(String),
    /// The Modbus TCP unit id of a drive.
    Unit(u8),
    /// The name of a bus, and the address of a drive on its line.
    Address(String, u8),
}

impl NamedBy {
    /// Selects the clients that may name their drive in this way.
    fn clients_of(self, clients: &[Arc<str>]) -> Vec<Arc<str>> {
        let is_tool = |client: &&Arc<str>| client.starts_with(SourceKind::Slot.name());
        match self {
            NamedBy::Address => clients.iter().filter(is_tool).cloned().collect(),
            NamedBy::Name | NamedBy::Unit => clients.to_vec(),
        }
    }

    /// Every way to name a drive.
    const ALL: [NamedBy; 3] = [NamedBy::Name, NamedBy::Unit, NamedBy::Address];

    /// How orders of this kind name their drive; `None` if no request of a client names it.
    fn of(kind: SourceKind) -> Option<NamedBy> {
        match kind {
            SourceKind::ModbusTcp | SourceKind::Bacnet => Some(NamedBy::Unit),
            SourceKind::Mqtt | SourceKind::Sparkplug | SourceKind::Http | SourceKind::LocalSocket => {
                Some(NamedBy::Name)
            }
            SourceKind::Slot => Some(NamedBy::Address),
            SourceKind::CommandLine
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

/// An earlier meaning: until `until` the name, unit id or address meant another machine, or none.
#[derive(Debug, Clone)]
struct EarlierMeaning {
    until: Instant,
    machine: Option<Machine>,
    /// Where the machine is served now, if it still is.
    served: Option<Served>,
}

/// The machine that an order meant, if its name means another machine now.
#[derive(Debug)]
pub enum FormerMachine {
    /// The machine is served under another name.
    There(Box<DriveHandle>),
    /// No bus serves that machine any more, or there was none.
    Gone,
}

/// A name or unit id that a drive had from `after` to `until`, and that no drive has now.
#[derive(Debug)]
struct DroppedKey {
    drive: DriveIndex,
    key: DriveKey,
    /// `None` if the drive had it from the start.
    after: Option<Instant>,
    until: Instant,
}

#[derive(Debug, Default)]
struct OfBus {
    /// Earlier meanings of names and unit ids, oldest first.
    meanings: BTreeMap<(DriveIndex, NamedBy), Vec<EarlierMeaning>>,
    dropped: Vec<DroppedKey>,
}

/// Earlier meanings of the names and units of the drives of a bus.
#[derive(Debug, Default)]
pub struct EarlierMeanings(Mutex<OfBus>);

impl EarlierMeanings {
    fn lock(&self) -> MutexGuard<'_, OfBus> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn of(&self, drive: DriveIndex, by: NamedBy) -> Vec<EarlierMeaning> {
        self.lock().meanings.get(&(drive, by)).cloned().unwrap_or_default()
    }

    /// What the name or unit id of the drive meant at `asked`: the record of the first change after that time.
    fn meaning_at(&self, drive: DriveIndex, by: NamedBy, asked: Instant) -> Option<EarlierMeaning> {
        let all = self.lock();
        let mut of_drive = all.meanings.get(&(drive, by))?.iter();
        of_drive.find(|former| asked <= former.until).cloned()
    }

    /// The drive that had this name or unit id at `asked`, if a reload has taken it from every drive since.
    fn had_at(&self, key: &DriveKey, asked: Instant) -> Option<DriveIndex> {
        let had = |dropped: &&DroppedKey| {
            dropped.key == *key && asked <= dropped.until && dropped.after.is_none_or(|after| after < asked)
        };
        self.lock().dropped.iter().find(had).map(|dropped| dropped.drive)
    }
}

impl DriveKey {
    fn of(by: NamedBy, drive: &DriveSpec) -> DriveKey {
        match by {
            NamedBy::Name => DriveKey::Name(drive.name.clone()),
            NamedBy::Unit => DriveKey::Unit(drive.unit),
            NamedBy::Address => DriveKey::Address(drive.bus.clone(), drive.address),
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
pub struct UnusedNames(BTreeMap<DriveKey, Meaning>);

impl UnusedNames {
    /// After a reload: records what the names and units of drives meant until now, and makes clients that commanded
    /// under them take the drive before they start its motor. `before` are all buses before the reload, `after` all
    /// buses now; buses that continue are in both.
    pub fn follow(&mut self, before: &[BusHandle], after: &[BusHandle], now: Instant) {
        let mut former: BTreeMap<DriveKey, Vec<(&str, Meaning)>> = BTreeMap::new();
        for bus in before {
            for (key, meaning) in meanings(bus) {
                former.entry(key).or_default().push((&bus.image.spec.name, meaning));
            }
        }
        let mut used: BTreeSet<DriveKey> = BTreeSet::new();
        for bus in after {
            for (index, drive) in bus.image.drives.enumerate() {
                for by in NamedBy::ALL {
                    let key = DriveKey::of(by, &drive.spec);
                    let machine = bus.image.spec.machine(&drive.spec);
                    // Unit ids may repeat on buses of different listeners: the machine itself is meant first, then a
                    // drive of the same bus.
                    let distance = |(of, meaning): &&(&str, Meaning)| {
                        (meaning.machine != machine, *of != bus.image.spec.name.as_str())
                    };
                    let had = former.get(&key).and_then(|all| all.iter().min_by_key(distance));
                    let was = had.map(|(_, meaning)| meaning.clone());
                    let was = was.or_else(|| self.0.remove(&key));
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
        let gone = gone.filter_map(|(key, all)| Some((key, ended(all.into_iter().next()?.1))));
        self.0.extend(gone);
        while self.0.len() > MOST_UNUSED {
            let oldest = self.0.iter().min_by_key(|(_, meaning)| meaning.ended);
            let Some(oldest) = oldest.map(|(key, _)| key.clone()) else {
                break;
            };
            self.0.remove(&oldest);
        }
        for bus in after {
            bus.formerly.lock().dropped = self.dropped_of(bus, now);
        }
    }

    /// The names and unit ids that drives of this bus had before no drive had them any more.
    fn dropped_of(&self, bus: &BusHandle, now: Instant) -> Vec<DroppedKey> {
        let mut dropped = Vec::new();
        for (key, meaning) in &self.0 {
            let Some(ended) = meaning.ended.filter(|ended| now < *ended + REMEMBERED) else {
                continue;
            };
            let earlier = meaning
                .earlier
                .iter()
                .map(|former| (former.until, former.machine.as_ref()));
            let mut after = None;
            for (until, machine) in earlier.chain([(ended, Some(&meaning.machine))]) {
                if let Some(drive) = machine.and_then(|machine| bus.place_of(machine)) {
                    let key = key.clone();
                    dropped.push(DroppedKey {
                        drive,
                        key,
                        after,
                        until,
                    });
                }
                after = Some(until);
            }
        }
        dropped
    }
}

/// What the names and unit ids of a bus mean.
fn meanings(bus: &BusHandle) -> Vec<(DriveKey, Meaning)> {
    let of_drive = |(index, drive): (DriveIndex, &Arc<DriveImage>)| {
        let clients = bus.queue.lock().gate.clients(index);
        NamedBy::ALL.map(|by| {
            let meaning = Meaning {
                machine: bus.image.spec.machine(&drive.spec),
                earlier: bus.formerly.of(index, by),
                clients: by.clients_of(&clients),
                ended: None,
            };
            (DriveKey::of(by, &drive.spec), meaning)
        })
    };
    bus.image.drives.enumerate().flat_map(of_drive).collect()
}

impl BusHandle {
    /// A drive has its name or unit id since the reload at `now`, or had it before.
    fn give_meaning(
        &self,
        (index, by): (DriveIndex, NamedBy),
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
        self.formerly.lock().meanings.insert((index, by), all);
        if !is_same {
            self.queue.lock().gate.stop_first(index, clients);
        }
    }

    fn place_of(&self, machine: &Machine) -> Option<DriveIndex> {
        let drives = &self.image.drives;
        drives.position(|drive| self.image.spec.machine(&drive.spec) == *machine)
    }

    fn serves(&self, machine: &Machine) -> Option<Served> {
        let place = self.place_of(machine)?;
        Some(Served {
            image: Arc::downgrade(&self.image),
            queue: Arc::downgrade(&self.queue),
            formerly: Arc::downgrade(&self.formerly),
            place,
        })
    }
}

impl Plant {
    /// The drive that had this name or unit id at `asked`, if a reload has taken it from every drive since.
    pub fn drive_formerly(&self, key: &DriveKey, asked: Instant) -> Option<DriveHandle> {
        let mut drives = self.drives();
        drives.find(|drive| drive.bus.formerly.had_at(key, asked) == Some(drive.index))
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
        self.former(NamedBy::of(kind)?, arrival.asked)
    }

    /// The machine that the name or unit id of this drive meant at `asked`, if it meant another machine.
    pub fn former(&self, by: NamedBy, asked: Instant) -> Option<FormerMachine> {
        let former = self.bus.formerly.meaning_at(self.index, by, asked)?;
        let there = former.served.and_then(|served| self.at(&served));
        Some(there.map_or(FormerMachine::Gone, |there| FormerMachine::There(Box::new(there))))
    }

    /// Access to this machine, if its bus still exists.
    fn at(&self, served: &Served) -> Option<DriveHandle> {
        let bus = BusHandle {
            image: served.image.upgrade()?,
            queue: served.queue.upgrade()?,
            formerly: served.formerly.upgrade()?,
            command_log: self.bus.command_log.clone(),
        };
        let index = served.place;
        let image = bus.image.drives.get(index)?.clone();
        Some(DriveHandle {
            bus,
            index,
            image,
            ..self.clone()
        })
    }

    /// The stop for this machine in an order that was parsed for the drive that has its name now; `None` if the
    /// order does not stop.
    pub fn stop_meant(&self, order: &Order, read_for: &DriveHandle) -> Option<Order> {
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
