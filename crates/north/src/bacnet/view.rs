//! The state of the plant for BACnet at one time: the value of each object, and which device answers.

use std::cell::Cell;
use std::collections::HashMap;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use drivegate_bacnet::services::WriteItem;
use drivegate_bacnet::{
    Address, Application, Commands, Data, DateTime, Datum, Device, Mac, ObjectId, ObjectType, PropertyId, Reliability,
    Sample, Slot, ValueSource,
};
use subtle::ConstantTimeEq as _;

use super::objects::{self, Flat, ListedDevice, Meaning};
use super::rights::HostRights;
use super::{Options, WhenOffline};
use drivegate_core::order::{Commanded, Entry, Origin, Refusal, SourceKind};
use drivegate_core::permit::{self, Priorities};
use drivegate_core::plant::{BusHandle, DriveHandle, DriveKey, Plant};
use drivegate_core::process_image::{Reading, Unavailable};
use drivegate_model::drive::{ModelPoint, PointIndex, Quality, Source, Value};
use drivegate_proto::Table;

/// Object of the run command of each drive.
const RUN: ObjectId = ObjectId::new(ObjectType::BINARY_VALUE, 1);

#[derive(Debug)]
pub(super) struct ShownDrive {
    pub(super) handle: DriveHandle,
    pub(super) shown: ListedDevice,
}

/// The plant, and how it appears to BACnet clients.
#[derive(Debug)]
pub(super) struct View {
    pub(super) plant: Arc<Plant>,
    pub(super) options: Arc<Options>,
    pub(super) rights: HostRights,
    gateway: ListedDevice,
    /// All objects of the plant in a single device.
    flat: Option<Flat>,
    /// Drives by the gateway's instance number plus the unit id; this is also the instance of the drive's device,
    /// if the drive has a device.
    pub(super) drives: HashMap<u32, ShownDrive>,
    buses: Vec<BusHandle>,
    /// The time of this view, by the monotonic clock and by the wall clock.
    now: Cell<(Instant, SystemTime)>,
    /// When the request that is processed arrived.
    asked: Cell<Instant>,
}

impl View {
    pub(super) fn new(plant: Arc<Plant>, options: Arc<Options>, rights: HostRights) -> View {
        let name = plant.gateway.clone();
        let gateway = (name.as_str(), options.device);
        let is_served = |bus: &BusHandle| options.serves(&bus.image.spec.name);
        let buses: Vec<BusHandle> = plant.buses.clone();
        let served = plant.drives().filter(|drive| is_served(&drive.bus));
        let drives = served.map(|handle| {
            let shown = objects::of_drive(&handle.image.spec, gateway);
            (shown.device.instance, ShownDrive { handle, shown })
        });
        let drives: HashMap<u32, ShownDrive> = drives.collect();
        let shown = objects::of_gateway(gateway, buses.iter().map(|bus| &bus.image.spec));
        let flat = options.network.is_none().then(|| {
            let mut all: Vec<&ShownDrive> = drives.values().collect();
            all.sort_by_key(|drive| drive.handle.image.spec.unit);
            let all = all.into_iter().map(|drive| {
                let spec = &drive.handle.image.spec;
                (spec.name.clone(), spec.unit, drive.shown.clone())
            });
            objects::flat(gateway, shown.clone(), all)
        });
        View {
            gateway: shown,
            flat,
            drives,
            buses,
            plant,
            options,
            rights,
            now: Cell::new((Instant::now(), SystemTime::now())),
            asked: Cell::new(Instant::now()),
        }
    }

    /// The devices, that of the gateway first.
    pub(super) fn devices(&self) -> Vec<Arc<Device>> {
        if let Some(flat) = &self.flat {
            return vec![flat.device.clone()];
        }
        let mut drives: Vec<_> = self.drives.values().map(|drive| drive.shown.device.clone()).collect();
        drives.sort_by_key(|device| device.instance);
        [self.gateway.device.clone()].into_iter().chain(drives).collect()
    }

    pub(super) fn set_time(&self, now: Instant) {
        self.now.set((now, SystemTime::now()));
    }

    /// Sets when the request arrived that is processed next.
    pub(super) fn set_asked(&self, asked: Instant) {
        self.asked.set(asked);
    }

    fn wall(&self, at: Instant) -> DateTime {
        let (now, wall) = self.now.get();
        let then = wall.checked_sub(now.saturating_duration_since(at)).unwrap_or(wall);
        let since = then.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        DateTime::from_unix_ms(u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
    }

    /// Instance of the device that represents a drive.
    pub(super) fn shown_by(&self, drive: u32) -> u32 {
        match self.flat {
            Some(_) => self.options.device,
            None => drive,
        }
    }

    /// The drive that an object belongs to, and the object's number in that drive.
    fn owner(&self, device: u32, object: ObjectId) -> Option<(&ShownDrive, ObjectId)> {
        if self.flat.is_none() {
            return Some((self.drives.get(&device)?, object));
        }
        let (unit, number) = objects::of_flat(object)?;
        let drive = self.drives.get(&(self.options.device + u32::from(unit)))?;
        Some((drive, ObjectId::new(object.kind, number)))
    }

    /// The drive to whose run command an object belonged at `asked`, if a reload has taken the number from every drive since.
    pub(super) fn run_formerly(&self, device: u32, object: ObjectId, asked: Instant) -> Option<DriveHandle> {
        let (unit, number) = match self.flat {
            Some(_) => objects::of_flat(object)?,
            None => (
                u8::try_from(device.checked_sub(self.options.device)?).ok()?,
                object.instance,
            ),
        };
        let is_run = ObjectId::new(object.kind, number) == RUN;
        is_run.then(|| self.plant.drive_formerly(&DriveKey::Unit(unit), asked))?
    }

    fn meaning(&self, device: u32, place: usize) -> Option<Meaning> {
        if let Some(flat) = &self.flat {
            return flat.places.get(place).map(|(_, meaning)| *meaning);
        }
        let shown = match self.drives.get(&device) {
            Some(drive) => &drive.shown,
            None => &self.gateway,
        };
        shown.meanings.get(place).copied()
    }

    /// The meaning of an object of a drive.
    pub(super) fn of_drive(&self, device: u32, place: usize) -> Option<(&DriveHandle, Meaning)> {
        if let Some(flat) = &self.flat {
            let (unit, meaning) = flat.places.get(place)?;
            let drive = self.drives.get(&(self.options.device + u32::from((*unit)?)))?;
            return Some((&drive.handle, *meaning));
        }
        let drive = self.drives.get(&device)?;
        Some((&drive.handle, drive.shown.meanings.get(place).copied()?))
    }

    fn of_bus(&self, meaning: Meaning) -> Sample {
        let (Meaning::BusUp(place) | Meaning::BusLoad(place)) = meaning else {
            return NOTHING;
        };
        let Some(bus) = self.buses.get(place) else {
            return NOTHING;
        };
        let health = bus.image.health();
        let (value, known) = match meaning {
            Meaning::BusUp(_) => (Datum::Bool(health.up), true),
            _ => {
                let percent = (health.load.unwrap_or(0.0) * 1000.0).round() / 10.0;
                (Datum::Number(percent), health.load.is_some())
            }
        };
        Sample {
            value: Some(value),
            reliability: if known {
                Reliability::NoFault
            } else {
                Reliability::CommunicationFailure
            },
            at: Some(self.clock()),
        }
    }

    fn shows(&self, handle: &DriveHandle, meaning: Meaning) -> Sample {
        let reading = handle.reading(self.now.get().0);
        match meaning {
            Meaning::Point(index) => self.point(&reading, index, |value| match value {
                Value::Bool(on) => Datum::Bool(on),
                Value::Text(text) => Datum::Text(Arc::from(text.shown())),
                value => Datum::Number(value.as_f64()),
            }),
            Meaning::Enumeration(index) => {
                let point = reading.spec.profile.points.get(index);
                let state = |value: Value| point.map_or(1, |point| objects::state_of(point, value.as_f64() as i64));
                self.point(&reading, index, |value| Datum::State(state(value)))
            }
            Meaning::State => self.state(&reading),
            Meaning::FaultText => self.fault_text(&reading),
            Meaning::Slot(what, index) => {
                let sample = self.drive_has(&reading, what, index);
                let slot = handle.priorities(|all| governed(&reading, all, what, index));
                Sample {
                    value: slot.or(sample.value),
                    ..sample
                }
            }
            // A pulse has always ended by the time that a client reads it.
            Meaning::Reset(index) => Sample {
                value: Some(Datum::Bool(false)),
                ..self.point(&reading, index, |value| Datum::Bool(value.as_bool()))
            },
            Meaning::BusUp(_) | Meaning::BusLoad(_) => NOTHING,
        }
    }

    fn drive_has(&self, reading: &Reading<'_>, what: Commanded, index: PointIndex) -> Sample {
        self.point(reading, index, |value| match what {
            Commanded::Run | Commanded::Reverse => Datum::Bool(value.as_bool()),
            _ => Datum::Number(value.as_f64()),
        })
    }

    fn point(&self, reading: &Reading<'_>, index: PointIndex, datum: impl Fn(Value) -> Datum) -> Sample {
        let sample = reading.sample(index);
        let reliability = match sample.quality {
            Quality::Good => Reliability::NoFault,
            Quality::Stale => Reliability::CommunicationFailure,
            Quality::Bad if refused(reading, index) || sample.at.is_some() => Reliability::UnreliableOther,
            Quality::Bad => Reliability::CommunicationFailure,
        };
        Sample {
            value: sample.value.map(datum),
            reliability,
            at: sample.at.map(|at| self.wall(at)),
        }
    }

    fn state(&self, reading: &Reading<'_>) -> Sample {
        use drivegate_model::drive::State;
        let at = reading.snapshot.fast_at.map(|at| self.wall(at));
        let (state, reliability) = match reading.state() {
            Some(State::Offline) => (State::Offline, Reliability::CommunicationFailure),
            Some(state) => (state, Reliability::NoFault),
            // The drive answers but does not report its state.
            None => (State::NotReady, Reliability::UnreliableOther),
        };
        Sample {
            value: Some(Datum::State(u32::from(state.code()) + 1)),
            reliability,
            at,
        }
    }

    fn fault_text(&self, reading: &Reading<'_>) -> Sample {
        let Some(code) = reading.spec.profile.model_index(ModelPoint::FaultCode) else {
            return NOTHING;
        };
        let profile = &reading.spec.profile;
        self.point(reading, code, |value| {
            Datum::Text(Arc::from(profile.fault_text(value.as_f64() as i64)))
        })
    }

    fn source(&self, origin: &Origin) -> ValueSource {
        match origin.kind {
            SourceKind::Bacnet | SourceKind::ModbusTcp => match origin.who.parse::<Address>() {
                Ok(address) => ValueSource::Address(address),
                Err(()) => ValueSource::Device(self.options.device),
            },
            _ => ValueSource::Device(self.options.device),
        }
    }

    fn slot(&self, entry: &Entry) -> Slot {
        Slot {
            value: datum_of(entry.value),
            source: self.source(&entry.origin),
            at: self.wall(entry.at),
        }
    }
}

/// The sample of an object that does not exist.
const NOTHING: Sample = Sample {
    value: None,
    reliability: Reliability::CommunicationFailure,
    at: None,
};

fn datum_of(value: Value) -> Datum {
    match value {
        Value::Bool(on) => Datum::Bool(on),
        value => Datum::Number(value.as_f64()),
    }
}

/// Whether the drive refuses a register of a point.
fn refused(reading: &Reading<'_>, index: PointIndex) -> bool {
    let Some(point) = reading.spec.profile.points.get(index) else {
        return false;
    };
    match &point.source {
        Source::Raw(raw) => {
            let words = |table: Table| reading.words(table, raw.address, raw.form.items());
            matches!(words(raw.table), Err(Unavailable::Refused(_)))
        }
        Source::Derived(derived) => derived
            .sources()
            .any(|source| source != index && refused(reading, source)),
    }
}

/// The value of the slot that governs, in the unit of the point.
fn governed(reading: &Reading<'_>, all: &Priorities, what: Commanded, index: PointIndex) -> Option<Datum> {
    let (of, _, entry) = all.governing(what)?;
    if of == what {
        return Some(datum_of(entry.value));
    }
    let from = reading.spec.profile.model_index(of.point())?;
    permit::converted(reading, (from, entry.value), index).map(datum_of)
}

impl Application for View {
    fn admits(&self, host: Ipv4Addr) -> bool {
        self.options.admits(host)
    }

    fn may_write(&self, host: Ipv4Addr) -> bool {
        self.options.may_write(host)
    }

    fn clock(&self) -> DateTime {
        self.wall(self.now.get().0)
    }

    fn answers(&self, device: u32) -> bool {
        let Some(drive) = self.drives.get(&device).filter(|_| self.flat.is_none()) else {
            return device == self.options.device;
        };
        let snapshot = drive.handle.image.snapshot();
        let was_read = snapshot.fast_at.is_some();
        was_read && (snapshot.link.is_online() || self.options.offline == WhenOffline::Fault)
    }

    fn sample(&self, device: u32, place: usize) -> Sample {
        match (self.of_drive(device, place), self.meaning(device, place)) {
            (Some((handle, meaning)), _) => self.shows(handle, meaning),
            (None, Some(meaning)) => self.of_bus(meaning),
            (None, None) => NOTHING,
        }
    }

    fn commands(&self, device: u32, place: usize) -> Option<Commands> {
        let (handle, meaning) = self.of_drive(device, place)?;
        let (what, index) = match meaning {
            Meaning::Slot(what, index) => (what, index),
            Meaning::Reset(_) => {
                return Some(Commands {
                    default: Some(Datum::Bool(false)),
                    ..Commands::default()
                });
            }
            _ => return None,
        };
        let reading = handle.reading(self.now.get().0);
        let has = self.drive_has(&reading, what, index).value;
        Some(handle.priorities(|all| {
            let governs = all.governing(what);
            let last = all.last();
            let of_slot = governs.map(|(.., entry)| (&entry.origin, entry.at));
            let by = of_slot.or(last.map(|(origin, at)| (origin, *at)));
            // Without a command, the motor counts as stopped.
            let is_bit = matches!(what, Commanded::Run | Commanded::Reverse);
            let default = if governs.is_some() && is_bit {
                Some(Datum::Bool(false))
            } else {
                has
            };
            Commands {
                slots: std::array::from_fn(|place| {
                    let priority = u8::try_from(place + 1).unwrap_or(u8::MAX);
                    all.entry(what, priority).map(|entry| self.slot(entry))
                }),
                current: all.shown(what).map(|(priority, _)| priority),
                default,
                source: by.map_or(ValueSource::None, |(origin, _)| self.source(origin)),
                at: by.map(|(_, at)| self.wall(at)),
            }
        }))
    }

    fn denied(&self, from: &Address, device: u32, write: &WriteItem) {
        let Some((drive, _)) = self.owner(device, write.object) else {
            return;
        };
        let why = if self.options.commands {
            "the address is not in `write` of [bacnet]"
        } else {
            "`commands` of [bacnet] is off"
        };
        let (what, now) = (write.object.to_string(), self.now.get().0);
        let refusal = Refusal::NotAllowed(why.to_string());
        // The client gets no details beyond this error.
        drive
            .handle
            .refuse(&what, refusal, super::writes::origin(&self.rights, from, None), now);
    }

    fn stops(&self, device: u32, write: &WriteItem) -> bool {
        let former = || Some((self.run_formerly(device, write.object, self.asked.get())?, RUN));
        let owner = self.owner(device, write.object);
        let owner = owner.map(|(drive, object)| (drive.handle.clone(), object));
        let Some((drive, object)) = owner.or_else(former) else {
            return false;
        };
        let is_run = object == RUN && write.property.property == PropertyId::PRESENT_VALUE;
        let value = match write.value {
            Some(Data::Enumerated(0)) => Some(false),
            Some(Data::Null) => None,
            _ => return false,
        };
        let priority = write.priority.unwrap_or(16);
        u8::try_from(priority).is_ok_and(|priority| is_run && drive.priorities(|all| all.stops(priority, value)))
    }

    fn formerly(&self, station: Mac) -> Option<u32> {
        let [unit] = station.octets() else { return None };
        self.plant.drive_formerly(&DriveKey::Unit(*unit), self.asked.get())?;
        Some(self.options.device + u32::from(*unit))
    }

    fn orders(&self, device: u32) -> u64 {
        let of = |drive: &ShownDrive| drive.handle.priorities(|all| all.orders());
        match self.flat {
            Some(_) => self.drives.values().map(of).sum(),
            None => self.drives.get(&device).map_or(0, of),
        }
    }

    fn password(&self, given: &str) -> bool {
        let wanted = self.options.dcc_password.as_deref();
        wanted.is_some_and(|wanted| !wanted.is_empty() && wanted.as_bytes().ct_eq(given.as_bytes()).into())
    }
}
