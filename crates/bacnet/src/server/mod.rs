//! The server: a device of its own, and a router to the devices behind it.

mod bbmd;
mod cov;
mod discovery;
mod foreign_devices;
mod network;
mod notifying;
mod reading;
mod segments;
mod traffic;
mod writing;

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::Instant;

use crate::object::{Commands, Device, Environment, Port, Sample};
use crate::services::WriteItem;
use crate::types::{Address, DateTime, Mac, ObjectId};

pub use bbmd::Registration;
pub use traffic::To;
pub use writing::Job;

use bbmd::Foreign;
use cov::Cov;
use foreign_devices::ForeignDevices;
use segments::Segments;
use traffic::Traffic;
use writing::Exchanges;

/// An instance that no device has: instances have 22 bits.
const NO_DEVICE: u32 = u32::MAX;

/// The settings of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// UDP address of the server.
    pub address: SocketAddrV4,
    /// Number of bits in the network mask.
    pub prefix: u8,
    /// The number of the virtual network, 1..=65534; `None` if all objects belong to the device of the host.
    pub network: Option<u16>,
    /// Identifier and name of the vendor.
    pub vendor: (u16, Arc<str>),
    /// The program version that the device reports.
    pub version: Arc<str>,
    /// The BBMD at which the server registers as a foreign device.
    pub bbmd: Option<SocketAddrV4>,
    /// Maximum number of foreign devices that the server serves as a BBMD.
    pub foreign_devices: usize,
}

/// The application behind the server.
pub trait Application {
    /// Whether the server accepts messages from this host.
    fn admits(&self, host: Ipv4Addr) -> bool;

    /// Whether this host may write.
    fn may_write(&self, host: Ipv4Addr) -> bool;

    /// The clock of the day, UTC.
    fn clock(&self) -> DateTime;

    /// Whether this device answers.
    fn answers(&self, device: u32) -> bool;

    /// The value of the object with this index.
    fn sample(&self, device: u32, place: usize) -> Sample;

    /// The priority array and the relinquish default of a commandable object.
    fn commands(&self, device: u32, place: usize) -> Option<Commands>;

    /// A host that may not write tried to.
    fn denied(&self, _from: &Address, _device: u32, _write: &WriteItem) {}

    /// Whether a write is a stop, which passes where nothing else does, also one to an object that the devices no longer have.
    fn stops(&self, device: u32, write: &WriteItem) -> bool;

    /// The instance that the device of this station had when the datagram arrived, if no device has the station now.
    fn formerly(&self, _station: Mac) -> Option<u32> {
        None
    }

    /// A counter of the orders to this device by any client, which changes when one is given.
    fn orders(&self, device: u32) -> u64;

    /// Whether `given` is the password; false if no password is configured.
    fn password(&self, given: &str) -> bool;
}

/// Counters of the server's traffic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Datagrams received from admitted hosts.
    pub received: u64,
    /// Datagrams that were not understood, or of hosts that are not admitted.
    pub discarded: u64,
    /// Requests that were answered with an error, a reject or an abort.
    pub refused: u64,
    /// Number of requests that were carried out.
    pub done: u64,
    /// Datagrams that were not sent because the share of their address was used up.
    pub dropped: u64,
    /// Notifications sent.
    pub notifications: u64,
    /// Present number of subscriptions.
    pub subscriptions: u64,
}

/// The server. Datagrams enter by [`Server::receive`] and leave by [`Server::transmit`]; [`Server::poll`] must be
/// called at least ten times a second.
#[derive(Debug)]
pub struct Server {
    options: Options,
    environment: Environment,
    devices: Vec<Arc<Device>>,
    by_instance: BTreeMap<u32, usize>,
    by_station: HashMap<Mac, usize>,
    traffic: Traffic,
    foreign: Foreign,
    foreign_devices: ForeignDevices,
    segments: Segments,
    cov: Cov,
    exchanges: Exchanges,
    /// Increments that clients have set, by device and object.
    increments: HashMap<(u32, ObjectId), f32>,
    /// Devices that must not initiate messages, and until when.
    quiet: HashMap<u32, Instant>,
    jobs: VecDeque<Job>,
    counters: Counters,
}

impl Server {
    /// A server of these devices; the first is its own device and has no station.
    pub fn new(options: Options, devices: Vec<Arc<Device>>, now: Instant) -> Server {
        let (vendor, vendor_name) = options.vendor.clone();
        let port = Port {
            address: options.address,
            prefix: options.prefix,
            bbmd: options.bbmd.map(|bbmd| (bbmd, bbmd::LIFETIME)),
        };
        let environment = Environment {
            vendor,
            vendor_name,
            version: options.version.clone(),
            port,
            network: options.network.unwrap_or_default(),
        };
        let mut server = Server {
            environment,
            devices: Vec::new(),
            by_instance: BTreeMap::new(),
            by_station: HashMap::new(),
            traffic: Traffic::new(now),
            foreign: Foreign::new(options.bbmd, now),
            foreign_devices: ForeignDevices::new(options.foreign_devices),
            segments: Segments::default(),
            cov: Cov::limited(options.network.is_none()),
            exchanges: Exchanges::default(),
            increments: HashMap::new(),
            quiet: HashMap::new(),
            jobs: VecDeque::new(),
            counters: Counters::default(),
            options,
        };
        server.set_devices(devices);
        server
    }

    /// Replaces the devices. Subscriptions to objects that still exist continue.
    pub fn set_devices(&mut self, devices: Vec<Arc<Device>>) {
        let places = || devices.iter().enumerate();
        self.by_instance = places().map(|(place, device)| (device.instance, place)).collect();
        self.by_station = places()
            .filter_map(|(place, device)| Some((device.station?, place)))
            .collect();
        self.devices = devices;
        let (devices, by_instance) = (&self.devices, &self.by_instance);
        let has = |instance: u32, object: ObjectId| {
            let device = by_instance.get(&instance).and_then(|place| devices.get(*place));
            device.is_some_and(|device| device.object_list().any(|id| id == object))
        };
        self.cov
            .retain(|instance, subscription| has(instance, subscription.key.object));
        self.increments.retain(|(instance, object), _| has(*instance, *object));
    }

    /// Serves at another address or under other numbers: clients start from scratch, apart from their writes. A write in
    /// progress is answered, and a late duplicate is still recognised, under the present number of its device. Where that
    /// device is gone, the rest of a request reaches no device, whichever has its number now.
    pub fn restart(&mut self, options: Options, devices: Vec<Arc<Device>>, now: Instant) {
        let bbmd = self.options.bbmd;
        let before = std::mem::replace(self, Server::new(Options { bbmd, ..options }, devices, now));
        let number = |device: &Arc<Device>| {
            let place = match device.station {
                Some(station) => *self.by_station.get(&station)?,
                None => 0,
            };
            Some((device.instance, self.devices.get(place)?.instance))
        };
        let numbers: HashMap<u32, u32> = before.devices.iter().filter_map(number).collect();
        // The number that a device which is gone would have, by which the application knows it.
        let first = |devices: &[Arc<Device>]| devices.first().map(|own| own.instance);
        let (first_before, first_now) = (first(&before.devices), first(&self.devices));
        let gone = |device: u32| {
            let number = device.checked_sub(first_before?)?.checked_add(first_now?)?;
            (!self.by_instance.contains_key(&number)).then_some(number)
        };
        let numbered = |device: u32| {
            numbers
                .get(&device)
                .copied()
                .or_else(|| gone(device))
                .unwrap_or(NO_DEVICE)
        };
        let (mut exchanges, mut jobs) = (before.exchanges, before.jobs);
        for device in exchanges.devices().chain(jobs.iter_mut().map(|job| &mut job.device)) {
            *device = numbered(*device);
        }
        (self.traffic, self.exchanges, self.jobs) = (before.traffic, exchanges, jobs);
    }

    /// The device with this instance.
    fn device(&self, instance: u32) -> Option<Arc<Device>> {
        self.by_instance
            .get(&instance)
            .and_then(|place| self.devices.get(*place))
            .cloned()
    }

    /// Announces the server and its network.
    pub fn start(&mut self, app: &dyn Application, now: Instant) {
        self.announce_network(None, now);
        if let Some(own) = self.devices.first().cloned() {
            self.announce(own.instance, app, now);
        }
    }

    /// Does everything that is due at this time.
    pub fn poll(&mut self, app: &dyn Application, now: Instant) {
        if let Some((bbmd, request)) = self.foreign.poll(now) {
            self.traffic.exempt(bbmd, request);
        }
        self.quiet.retain(|_, until| *until > now);
        let mut out = Vec::new();
        self.segments.poll(now, &mut out);
        self.send_segments(out, now);
        for (to, device, message) in self.cov.poll(now) {
            self.send_exempt(to, device, &message, true);
        }
        for device in self.cov.devices() {
            self.check_changes(device, app, now);
        }
        self.notify(app, now);
        self.exchanges.poll(now);
        self.traffic.poll(now);
    }

    /// Values of that device may have changed.
    pub fn changed(&mut self, device: u32, app: &dyn Application, now: Instant) {
        self.check_changes(device, app, now);
        self.notify(app, now);
    }

    /// The next datagram to send.
    pub fn transmit(&mut self) -> Option<(To, Vec<u8>)> {
        self.traffic.next()
    }

    /// The next write to carry out; its result must be given to [`Server::written`].
    pub fn take_job(&mut self) -> Option<Job> {
        let mut job = self.jobs.pop_front()?;
        // The devices may have been replaced since the write was accepted.
        let place = self.device(job.device).and_then(|device| device.find(job.object));
        job.place = place.unwrap_or(usize::MAX);
        Some(job)
    }

    /// Whether a write is in progress.
    pub fn is_busy(&self) -> bool {
        self.exchanges.is_busy()
    }

    /// Whether the request of a job still waits for its end, and may give out further jobs with the same token.
    pub fn is_running(&self, token: u64) -> bool {
        self.exchanges.is_running(token)
    }

    /// Devices to which a client has subscribed.
    pub fn subscribed(&self) -> Vec<u32> {
        self.cov.devices()
    }

    /// Registers at that BBMD from now on.
    pub fn set_bbmd(&mut self, bbmd: Option<SocketAddrV4>, now: Instant) {
        self.options.bbmd = bbmd;
        self.environment.port.bbmd = bbmd.map(|bbmd| (bbmd, bbmd::LIFETIME));
        self.foreign = Foreign::new(bbmd, now);
    }

    /// The BBMD at which the server registers.
    pub fn bbmd(&self) -> Option<SocketAddrV4> {
        self.options.bbmd
    }

    /// The result of the registration at the BBMD.
    pub fn registration(&self) -> Registration {
        self.foreign.state
    }

    /// The counters of traffic so far.
    pub fn counters(&self) -> Counters {
        Counters {
            dropped: self.traffic.dropped,
            subscriptions: self.cov.len() as u64,
            ..self.counters
        }
    }

    /// The COV increment of an object.
    fn increment(&self, device: u32, object: &crate::object::Object) -> f32 {
        let own = match object.kind {
            crate::object::Kind::Analog { increment, .. } => increment,
            _ => 0.0,
        };
        self.increments.get(&(device, object.id)).copied().unwrap_or(own)
    }
}

/// The sender of a message, and how the message arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Source {
    address: Address,
    way: Delivery,
}

/// How a message was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Delivery {
    /// The message was sent to this host alone.
    Unicast,
    /// The message was sent to all hosts.
    Broadcast,
}

/// The devices that a message is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    /// The device of the host.
    Own,
    /// All devices of the server.
    All,
    /// All devices of the virtual network.
    Network,
    /// The device with this index in the list of the server.
    Device(usize),
}
