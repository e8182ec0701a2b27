//! Moves datagrams between the sockets and the server, and writes between it and the drives.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::future::Future;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use drivegate_bacnet::{Application as _, Options as ServerOptions, Server, To};
use futures_util::StreamExt as _;
use futures_util::stream::FuturesUnordered;
use tokio::net::UdpSocket;
use tokio::sync::{Notify, mpsc};
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use super::kept::{self, KeptSlot};
use super::sockets::Sockets;
use super::view::View;
use super::writes::{self, Begun, Waiting};
use super::{NorthStats, Options};
use crate::command::{Commanded, Outcome, Settled};
use crate::drive::ModelPoint;
use crate::event::{Event, EventKind};
use crate::plant::{Plant, SharedPlant};
use crate::process_image::{LeaseAction, Machine, Snapshot};
use crate::stats::BacnetFigures;

/// How often time is looked at.
const TICK: Duration = Duration::from_millis(100);
/// Changes of the drives are told no more often.
const LOOK: Duration = Duration::from_millis(5);
/// Datagrams that are taken up before anything else is.
const BATCH: usize = 64;
/// How often a BBMD whose name is not found is looked up again.
const RESOLVE: Duration = Duration::from_secs(30);
/// The name of the vendor without an identifier of one's own.
const VENDOR: &str = "drivegate";

/// What the server tells its task.
#[derive(Debug)]
pub(super) enum ToTask {
    /// Other options, and other sockets where the address is another one.
    Apply(Box<Options>, Option<Sockets>),
    /// Take no more from any client.
    Retire,
}

/// How a write ended.
struct Ended {
    token: u64,
    machine: Machine,
    slot: Option<u64>,
    outcome: Outcome,
}

type Ending = Pin<Box<dyn Future<Output = Ended> + Send>>;

/// The task.
pub(super) struct Task {
    options: Arc<Options>,
    sockets: Sockets,
    plant: SharedPlant,
    stats: Arc<NorthStats>,
    busy: Arc<AtomicBool>,
    view: View,
    server: Server,
    writes: FuturesUnordered<Ending>,
    /// Woken by every update of a drive.
    news: Arc<Notify>,
    /// What was seen of each drive to which somebody subscribes.
    seen: HashMap<u32, Arc<Snapshot>>,
    /// Drives that answered when they were looked at last.
    present: HashSet<u32>,
    /// Leases that ran out so far, by device.
    leases: HashMap<u32, u64>,
    /// Devices of which a slot waits for the next reading.
    uncertain: BTreeSet<u32>,
    kept: Vec<KeptSlot>,
    /// Devices with a slot of before the restart against which the motor may run.
    watched: BTreeSet<u32>,
    resolved: Option<Instant>,
    retired: bool,
}

fn server_of(options: &Options, sockets: &Sockets, view: &View, now: Instant) -> Server {
    let options = ServerOptions {
        address: sockets.address,
        prefix: sockets.prefix,
        network: options.network,
        vendor: (options.vendor, VENDOR.into()),
        version: crate::version::VERSION.into(),
        bbmd: None,
    };
    Server::new(options, view.devices(), now)
}

impl Task {
    pub(super) fn new(
        options: Options,
        sockets: Sockets,
        plant: SharedPlant,
        stats: Arc<NorthStats>,
        busy: Arc<AtomicBool>,
    ) -> Task {
        let options = Arc::new(options);
        let view = View::new(plant.load_full(), options.clone());
        let server = server_of(&options, &sockets, &view, Instant::now());
        Task {
            options,
            sockets,
            plant,
            stats,
            busy,
            view,
            server,
            writes: FuturesUnordered::new(),
            news: Arc::default(),
            seen: HashMap::new(),
            present: HashSet::new(),
            leases: HashMap::new(),
            uncertain: BTreeSet::new(),
            kept: Vec::new(),
            watched: BTreeSet::new(),
            resolved: None,
            retired: false,
        }
    }

    pub(super) async fn run(mut self, mut orders: mpsc::UnboundedReceiver<ToTask>, cancel: CancellationToken) {
        self.load();
        self.hear_drives();
        let now = Instant::now();
        self.view.look(now);
        self.server.start(&self.view, now);
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut buffer = vec![0; 2048];
        let mut next_look = Instant::now();
        loop {
            self.flush().await;
            let subscribed = self.stats.bacnet.get().is_some_and(|f| f.counters.subscriptions > 0);
            let waits = !self.writes.is_empty();
            tokio::select! {
                () = cancel.cancelled() => break,
                order = orders.recv() => match order {
                    Some(order) => self.apply(order),
                    None => break,
                },
                _ = ticks.tick() => self.tick(),
                ready = self.sockets.unicast.readable(), if !self.retired => {
                    if ready.is_ok() {
                        self.take(&mut buffer, false);
                    }
                }
                () = heard(self.sockets.broadcast.as_ref()), if !self.retired => self.take(&mut buffer, true),
                Some(ended) = self.writes.next(), if waits => self.ended(ended),
                () = self.news.notified(), if subscribed => {
                    tokio::time::sleep_until(next_look.into()).await;
                    self.look();
                    next_look = Instant::now() + LOOK;
                }
            }
            self.take_up_jobs();
        }
        self.save().await;
        self.stats.bacnet.set(None);
    }

    /// Takes up what came.
    fn take(&mut self, buffer: &mut [u8], broadcast: bool) {
        let now = Instant::now();
        self.view.look(now);
        for _ in 0..BATCH {
            let socket = match (broadcast, &self.sockets.broadcast) {
                (true, Some(socket)) => socket,
                _ => &self.sockets.unicast,
            };
            let Ok((length, SocketAddr::V4(from))) = socket.try_recv_from(buffer) else {
                return;
            };
            if let Some(datagram) = buffer.get(..length) {
                self.server.receive(from, datagram, &self.view, now);
            }
        }
    }

    /// Sends what is to be sent. What the system does not take is lost, as datagrams may be.
    async fn flush(&mut self) {
        while let Some((to, datagram)) = self.server.transmit() {
            let to = match to {
                To::Host(host) => host,
                To::Broadcast => self.sockets.broadcast_to,
            };
            if let Err(error) = self.sockets.unicast.send_to(&datagram, to).await {
                tracing::debug!(target: "drivegate::bacnet", "cannot send to {to}: {error}");
            }
        }
    }

    /// Hands writes to the drives.
    fn take_up_jobs(&mut self) {
        let now = Instant::now();
        self.view.look(now);
        while let Some(job) = self.server.take_job() {
            match writes::begin(&self.view, &job, now) {
                Begun::Answered(result) => self.server.written(job.token, result, &self.view, now),
                Begun::Waits(waiting) => self.writes.push(Box::pin(ending(job.token, waiting))),
            }
        }
        self.busy.store(!self.writes.is_empty(), Ordering::Relaxed);
    }

    fn ended(&mut self, ended: Ended) {
        let now = Instant::now();
        let plant = self.plant.load();
        if let (Some(slot), Some(drive)) = (ended.slot, plant.drive_at(&ended.machine)) {
            let settled = Settled::of(&ended.outcome);
            drive.priorities(|all| all.settle(slot, settled, now));
            if settled == Settled::Unknown {
                let device = self.options.device + u32::from(drive.image.spec.unit);
                self.uncertain.insert(device);
            }
        }
        self.view.look(now);
        let result = writes::error(&ended.outcome);
        self.server.written(ended.token, result, &self.view, now);
    }

    fn tick(&mut self) {
        let now = Instant::now();
        let plant = self.plant.load_full();
        if !Arc::ptr_eq(&plant, &self.view.plant) {
            self.see(plant);
        }
        self.view.look(now);
        self.note_leases();
        self.resolve_slots(now);
        self.watch_kept();
        self.announce(now);
        self.server.poll(&self.view, now);
        self.stats.bacnet.set(Some(BacnetFigures {
            counters: self.server.counters(),
            bbmd: self
                .options
                .bbmd
                .as_ref()
                .map(|(host, port)| (format!("{host}:{port}"), self.server.registration())),
        }));
        self.find_bbmd(now);
        self.keep();
    }

    /// Shows another plant, or the same with other options.
    fn see(&mut self, plant: Arc<Plant>) {
        self.view = View::new(plant, self.options.clone());
        self.server.set_devices(self.view.devices());
        self.seen.clear();
        self.hear_drives();
    }

    fn hear_drives(&self) {
        for drive in self.view.drives.values() {
            drive.handle.image.notify(&self.news);
        }
    }

    /// Tells what changed at drives to which somebody subscribes.
    fn look(&mut self) {
        let now = Instant::now();
        self.view.look(now);
        for device in self.server.subscribed() {
            let Some(drive) = self.view.drives.get(&device) else {
                continue;
            };
            let snapshot = drive.handle.image.snapshot();
            let same = self.seen.get(&device).is_some_and(|seen| Arc::ptr_eq(seen, &snapshot));
            if !same {
                self.seen.insert(device, snapshot);
                self.server.changed(device, &self.view, now);
            }
        }
    }

    /// A drive that comes back says so.
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
        for (device, drive) in &self.view.drives {
            let image = &drive.handle.image;
            let stops = image
                .spec
                .supervision
                .as_ref()
                .is_none_or(|lease| lease.action == LeaseAction::Stop);
            let count = image.supervisions();
            let before = self.leases.insert(*device, count);
            if !stops && before.is_some_and(|before| before < count) {
                drive.handle.priorities(|all| all.silenced());
            }
        }
    }

    /// Settles what is not known by what the drives show.
    fn resolve_slots(&mut self, now: Instant) {
        let drives = &self.view.drives;
        self.uncertain.retain(|device| {
            let Some(drive) = drives.get(device) else { return false };
            let reading = drive.handle.reading(now);
            drive.handle.priorities(|all| {
                all.resolve(|what, since| {
                    let sample = reading.model(what.point());
                    sample.good().filter(|_| sample.at.is_some_and(|at| at > since))
                });
                all.is_uncertain()
            })
        });
    }

    fn keep_file(&self) -> Option<std::path::PathBuf> {
        self.options
            .keep_priorities
            .then(|| self.options.state_dir.join(kept::FILE))
    }

    fn load(&mut self) {
        let Some(path) = self.keep_file() else { return };
        match kept::load(&path) {
            Ok(slots) => {
                kept::restore(&self.view.plant, &slots, Instant::now());
                self.kept = kept::of_plant(&self.view.plant);
                let protected = |device: &u32| {
                    let drive = self.view.drives.get(device);
                    drive.is_some_and(|drive| drive.handle.priorities(|all| all.kept().next().is_some()))
                };
                self.watched = self.view.drives.keys().copied().filter(protected).collect();
            }
            Err(why) => tracing::error!(
                target: "drivegate::bacnet",
                "cannot read {}: {why}; the slots of before the restart are not kept; write them again, or remove the file", path.display()
            ),
        }
    }

    /// Writes what outlives a restart, where it is another.
    fn keep(&mut self) {
        let Some(path) = self.keep_file() else { return };
        let slots = kept::of_plant(&self.view.plant);
        if slots != self.kept {
            self.kept.clone_from(&slots);
            tokio::task::spawn_blocking(move || {
                if let Err(why) = kept::save(&path, &slots) {
                    tracing::error!(
                        target: "drivegate::bacnet", "cannot write {}: {why}; slots are not kept over a restart", path.display()
                    );
                }
            });
        }
    }

    async fn save(&mut self) {
        let Some(path) = self.keep_file() else { return };
        let slots = self.kept.clone();
        // A thread that panicked has logged that.
        let _ = tokio::task::spawn_blocking(move || kept::save(&path, &slots)).await;
    }

    /// An event tells if a motor runs against a slot of before the restart.
    fn watch_kept(&mut self) {
        let view = &self.view;
        self.watched.retain(|device| {
            let Some(drive) = view.drives.get(device) else { return false };
            let now = Instant::now();
            let Some(running) = drive.handle.reading(now).model(ModelPoint::Running).good() else {
                return true;
            };
            let slot = drive.handle.priorities(|all| {
                let governs = all.governing(Commanded::Run)?;
                Some((governs.1, governs.2.origin.who.clone()))
            });
            if let (true, Some((priority, who))) = (running.as_bool(), slot) {
                let spec = &drive.handle.image.spec;
                let text = format!(
                    "drive {} runs, and BACnet client {who} keeps `run` inactive at priority {priority} since before the restart; \
                     nothing was written; stop it, or give the slot back",
                    spec.name
                );
                drive.handle.publish(Event {
                    bus: spec.bus.clone(),
                    drive: Some(spec.name.clone()),
                    ..Event::new(EventKind::ForeignCommand, SystemTime::now(), text)
                });
            }
            false
        });
    }

    fn apply(&mut self, order: ToTask) {
        match order {
            ToTask::Retire => self.retired = true,
            ToTask::Apply(options, sockets) => {
                let continues = sockets.is_none() && self.options.continues(&options);
                let same_bbmd = self.options.bbmd == options.bbmd;
                self.options = Arc::from(options);
                if let Some(sockets) = sockets {
                    self.sockets = sockets;
                }
                self.see(self.plant.load_full());
                let now = Instant::now();
                self.view.look(now);
                if !continues {
                    self.server = server_of(&self.options, &self.sockets, &self.view, now);
                    self.server.start(&self.view, now);
                }
                if !continues || !same_bbmd {
                    self.server.set_bbmd(None, now);
                    self.resolved = None;
                }
            }
        }
    }

    /// Looks up the BBMD, and again while its name is not found.
    fn find_bbmd(&mut self, now: Instant) {
        use drivegate_bacnet::Registration;
        let Some((host, port)) = self.options.bbmd.clone() else {
            return;
        };
        let due = self
            .resolved
            .is_none_or(|at| now.saturating_duration_since(at) >= RESOLVE);
        if self.server.registration() != Registration::None || !due {
            return;
        }
        self.resolved = Some(now);
        // A short wait twice a minute, while the BBMD is not found.
        let found = std::net::ToSocketAddrs::to_socket_addrs(&(host.as_str(), port));
        let address = found.ok().and_then(|mut all| {
            all.find_map(|address| match address {
                SocketAddr::V4(address) => Some(address),
                SocketAddr::V6(_) => None,
            })
        });
        match address {
            Some(address) => self.server.set_bbmd(Some(address), now),
            None => tracing::warn!(
                target: "drivegate::bacnet", "cannot find the BBMD {host}:{port}; trying again every 30 s; check `bbmd` of [bacnet]"
            ),
        }
    }
}

async fn ending(token: u64, waiting: Waiting) -> Ended {
    let Waiting {
        machine,
        mut placed,
        slot,
    } = waiting;
    let outcome = placed.answered().await.outcome;
    Ended {
        token,
        machine,
        slot,
        outcome,
    }
}

/// Waits for a broadcast.
async fn heard(socket: Option<&UdpSocket>) {
    match socket {
        Some(socket) => {
            // Whatever is wrong shows when it is read.
            let _ = socket.readable().await;
        }
        None => std::future::pending().await,
    }
}
