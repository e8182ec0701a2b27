//! Connects the protocol with the drives: waiting writes, slots that wait for a reading, leases, drives that come
//! online again. Has no sockets and no clock: `task` and `loopback` provide both.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::net::SocketAddrV4;
use std::sync::Arc;
use std::time::Instant;

use drivegate_bacnet::{Application as _, Error, Job, Options as ServerOptions, Server};

use super::Options;
use super::rights::HostRights;
use super::view::View;
use super::writes::{self, JobProgress, Waiting};
use drivegate_core::order::{Arrival, Connection, Outcome};
use drivegate_core::permit::Settled;
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_core::process_image::{LeaseAction, Machine};

/// The name of the vendor without an identifier of one's own.
const VENDOR: &str = "drivegate";

/// The address of a server, and the bits of the mask of its network.
pub(super) type At = (SocketAddrV4, u8);

/// How a write to a drive ended.
pub(super) struct Ended {
    token: u64,
    machine: Machine,
    slot: Option<u64>,
    outcome: Outcome,
}

impl Ended {
    pub(super) fn of(token: u64, waiting: Waiting, outcome: Outcome) -> Ended {
        let Waiting { machine, slot, .. } = waiting;
        Ended {
            token,
            machine,
            slot,
            outcome,
        }
    }
}

/// The BACnet protocol, the objects of the plant and the requests that wait for a drive.
#[derive(Debug)]
pub(super) struct Desk {
    plant: SharedPlant,
    pub(super) view: View,
    pub(super) server: Server,
    at: At,
    /// Drives that answered at the last look.
    present: HashSet<u32>,
    /// Leases that expired so far.
    leases: HashMap<Machine, u64>,
    /// Drives with a slot that awaits the next reading.
    uncertain: BTreeSet<Machine>,
    /// When the last batch of datagrams was read, and how they arrived.
    batch: Option<(Instant, Arrival)>,
    /// How the requests arrived whose writes are in progress, by token.
    in_progress: HashMap<u64, Arrival>,
    /// Connection on which the datagrams of [`Desk::receive`] arrive.
    connection: Connection,
}

fn server_options((address, prefix): At, view: &View) -> ServerOptions {
    ServerOptions {
        address,
        prefix,
        network: view.options.network,
        foreign_devices: view.options.foreign_devices,
        vendor: (view.options.vendor, VENDOR.into()),
        version: drivegate_core::version::VERSION.into(),
        bbmd: None,
    }
}

impl Desk {
    pub(super) fn new(options: Arc<Options>, rights: HostRights, plant: SharedPlant, at: At, now: Instant) -> Desk {
        let view = View::new(plant.load_full(), options, rights);
        Desk {
            server: Server::new(server_options(at, &view), view.devices(), now),
            plant,
            view,
            at,
            present: HashSet::new(),
            leases: HashMap::new(),
            uncertain: BTreeSet::new(),
            batch: None,
            in_progress: HashMap::new(),
            connection: Connection::opened(now),
        }
    }

    /// Announces the devices with I-Am.
    pub(super) fn start(&mut self, now: Instant) {
        self.view.set_time(now);
        self.server.start(&self.view, now);
    }

    /// Serves at another address.
    pub(super) fn move_to(&mut self, at: At, now: Instant) {
        self.at = at;
        self.start_anew(now);
    }

    /// Address or numbers have changed: clients start from scratch, apart from their writes.
    fn start_anew(&mut self, now: Instant) {
        let options = server_options(self.at, &self.view);
        self.server.restart(options, self.view.devices(), now);
        self.start(now);
    }

    pub(super) fn newest_plant(&self) -> Arc<Plant> {
        self.plant.load_full()
    }

    /// Shows the present plant, with the options that came with it, if a reload has replaced it: every request is
    /// carried out by what its numbers mean now. Options alone change nothing before the plant does, since numbers follow
    /// from both.
    fn refresh(&mut self, now: Instant) {
        if Arc::ptr_eq(&self.plant.load(), &self.view.plant) {
            return;
        }
        let before = self.view.options.clone();
        let options = self.view.rights.options().unwrap_or_else(|| before.clone());
        let continues = before.continues(&options);
        self.view = View::new(self.plant.load_full(), options, self.view.rights.clone());
        if continues {
            self.server.set_devices(self.view.devices());
        } else {
            self.start_anew(now);
        }
    }

    /// Processes a received datagram.
    pub(super) fn receive(&mut self, from: SocketAddrV4, datagram: &[u8], now: Instant) {
        self.refresh(now);
        self.view.set_time(now);
        let of_batch = self.batch.as_ref().filter(|(at, _)| *at == now);
        self.view.set_asked(of_batch.map_or(now, |(_, arrival)| arrival.asked));
        self.server.receive(from, datagram, &self.view, now);
    }

    /// Notes how the datagrams arrived that are processed at `now`.
    pub(super) fn received(&mut self, arrival: Arrival, now: Instant) {
        self.batch = Some((now, arrival));
    }

    /// How the request of a job arrived; all of its writes arrived with it.
    fn arrival(&mut self, job: &Job) -> Arrival {
        let of_request = || match &self.batch {
            Some((at, arrival)) if *at == job.requested_at => arrival.clone(),
            _ => Arrival::over(self.connection.clone(), job.requested_at),
        };
        self.in_progress.entry(job.token).or_insert_with(of_request).clone()
    }

    /// Gives the client the result of a write, or begins the next one of its request.
    fn written(&mut self, token: u64, result: Result<(), Error>, now: Instant) {
        let arrival = self.in_progress.get(&token);
        self.view.set_asked(arrival.map_or(now, |arrival| arrival.asked));
        self.server.written(token, result, &self.view, now);
        if !self.server.is_running(token) {
            self.in_progress.remove(&token);
        }
    }

    /// Values of that device may have changed.
    pub(super) fn changed(&mut self, device: u32, now: Instant) {
        self.refresh(now);
        self.view.set_time(now);
        self.server.changed(device, &self.view, now);
    }

    /// Processes the writes of clients until one of them must wait for its drive.
    pub(super) fn next_order(&mut self, now: Instant) -> Option<(u64, Waiting)> {
        self.refresh(now);
        self.view.set_time(now);
        while let Some(job) = self.server.take_job() {
            let arrival = self.arrival(&job);
            match writes::begin(&self.view, &job, arrival, now) {
                JobProgress::Answered(result) => self.written(job.token, result, now),
                JobProgress::Waits(waiting) => return Some((job.token, *waiting)),
            }
        }
        None
    }

    /// Notes the result of a write to a drive.
    pub(super) fn ended(&mut self, ended: &Ended, now: Instant) {
        self.refresh(now);
        let plant = self.plant.load();
        if let (Some(slot), Some(drive)) = (ended.slot, plant.drive_at(&ended.machine)) {
            let settled = Settled::of(&ended.outcome);
            drive.priorities(|all| all.settle(slot, settled, now));
            if settled == Settled::Unknown {
                self.uncertain.insert(ended.machine.clone());
            }
        }
        self.view.set_time(now);
        let result = writes::error(&ended.outcome);
        self.written(ended.token, result, now);
    }

    /// Does all that is due at `now`.
    pub(super) fn poll(&mut self, now: Instant) {
        self.refresh(now);
        self.view.set_time(now);
        self.note_leases();
        self.resolve_slots(now);
        self.announce(now);
        self.server.poll(&self.view, now);
    }

    /// Announces drives that are online again.
    fn announce(&mut self, now: Instant) {
        let answers: HashSet<u32> = self
            .view
            .drives
            .keys()
            .copied()
            .filter(|device| self.view.answers(*device))
            .collect();
        for device in answers.difference(&self.present) {
            self.server.announce(*device, &self.view, now);
        }
        self.present = answers;
    }

    /// A lease that ended without a stop gives the slots of its client back, too.
    fn note_leases(&mut self) {
        for drive in self.view.drives.values() {
            let image = &drive.handle.image;
            let stops = image
                .spec
                .supervision
                .as_ref()
                .is_none_or(|lease| lease.action == LeaseAction::Stop);
            let count = image.supervisions();
            let before = self.leases.insert(drive.handle.machine(), count);
            if !stops && before.is_some_and(|before| before < count) {
                drive.handle.priorities(|all| all.silenced());
            }
        }
    }

    /// Settles uncertain slots by readings.
    fn resolve_slots(&mut self, now: Instant) {
        let plant = &self.view.plant;
        self.uncertain.retain(|machine| {
            let Some(drive) = plant.drive_at(machine) else {
                return false;
            };
            let reading = drive.reading(now);
            drive.priorities(|all| {
                all.resolve(|what, since| {
                    let sample = reading.model(what.point());
                    sample.good().filter(|_| sample.at.is_some_and(|at| at > since))
                });
                all.is_uncertain()
            })
        });
    }
}
