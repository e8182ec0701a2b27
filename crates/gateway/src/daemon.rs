//! The gateway as a whole: start, reload and the order of shutdown.

mod changes;
pub mod drills;
mod file_limit;
mod keepers;
mod leases;
mod obeyed_files;
mod pulse;
mod reservations;
mod rights;
mod server;
mod servers;
mod stop_drives;

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use futures_util::future::join5;
use tokio::task::JoinHandle;

use self::leases::RemovedDrives;
pub use self::pulse::BusHeartbeats;
use self::reservations::ReservationsFile;
use self::server::{ServerSlot, within};
use self::servers::{ListeningServers, PreparedServers};
use crate::config::{BusSettings, Settings};
use drivegate_bus::line_state::Learned;
use drivegate_bus::master::Handover;
use drivegate_bus::{BusTask, Mode};
use drivegate_core::event::Events;
use drivegate_core::files::Keeper;
use drivegate_core::history::RecorderTask;
use drivegate_core::order::{CommandLog, Outcome};
use drivegate_core::plant::{BusHandle, Plant, SharedPlant, UnusedNames};
use drivegate_core::process_image::{Access, BusImage, DriveImage, DriveSpec, Machine};
use drivegate_core::queue::CommandQueue;
use drivegate_core::start_guard::{BusGuards, Guards};
use drivegate_core::stop_all::{LOOK, StopAll};
use drivegate_http::local;
use drivegate_http::local::Control;
use drivegate_model::drive::DriveIndex;
use drivegate_north::reading::Watch;
use drivegate_north::{NorthState, ServerError, modbus_tcp};

/// Time limit for the bus threads to end, besides the time for the last stops of clients.
const STOP_BUSES: Duration = Duration::from_secs(2);

/// Time limit for clients of the local socket to receive their last answers.
const STOP_LOCAL: Duration = Duration::from_secs(1);
/// Time limit for the audit file, and for events and counters, to be written.
const STOP_AUDIT: Duration = Duration::from_secs(1);
/// Interval at which refusals are reported whose count is due.
const REFUSALS_REPORTED: Duration = Duration::from_millis(250);

/// Why the gateway cannot start or apply a new configuration.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// A server cannot start.
    #[error(transparent)]
    Server(#[from] ServerError),
    /// The system does not provide a thread or a file descriptor for the bus of that name.
    #[error("cannot start bus `{0}`: {1}; free memory or file descriptors")]
    Bus(String, std::io::Error),
    /// The system does not provide a thread for the recorder.
    #[error("cannot start the recorder: {0}; free memory or threads")]
    Recorder(std::io::Error),
}

impl StartError {
    /// The address of the configuration that another program listens on.
    pub fn address_in_use(&self) -> Option<SocketAddr> {
        match self {
            StartError::Server(ServerError::Listen { address, cause, .. }) if cause.kind() == ErrorKind::AddrInUse => {
                Some(*address)
            }
            _ => None,
        }
    }
}

/// A running gateway.
#[derive(Debug)]
pub struct Daemon {
    settings: Settings,
    plant: SharedPlant,
    buses: Vec<(BusSettings, BusTask)>,
    /// State of drives that reloads have left out.
    parted: RemovedDrives,
    /// Names and unit ids that reloads took from their drives.
    unused_names: UnusedNames,
    events: Events,
    command_log: Arc<CommandLog>,
    north: Arc<NorthState>,
    listening: ListeningServers,
    mqtt: ServerSlot<drivegate_mqtt::Mqtt>,
    local: ServerSlot<local::Local>,
    /// Task that reads parameters at intervals.
    reader: Option<JoinHandle<()>>,
    recorder: Option<RecorderTask>,
    /// Keeps events and counters on disk.
    keeper: Option<Keeper>,
    /// The guards that count the starts of all drives.
    guards: Arc<Guards>,
    /// Keeps the starts of drives on disk.
    starts: Option<Keeper>,
    /// Tasks that run until the buses have ended.
    tasks: Vec<JoinHandle<()>>,
    driller: JoinHandle<()>,
    drills: drills::DrillsFile,
    reservations: ReservationsFile,
    saver: reservations::Saver,
    pulse: BusHeartbeats,
    /// Receiver of reload requests, and the file that the gateway runs with.
    control: Option<Control>,
}

impl Daemon {
    /// Starts all buses and servers. A port that cannot be opened is not an error: its bus keeps trying.
    ///
    /// # Errors
    /// If a server cannot start, or the system does not provide a thread.
    pub async fn start(settings: Settings) -> Result<Daemon, StartError> {
        Daemon::start_with(settings, None).await
    }

    /// Starts like [`Daemon::start`]; `control` receives the commands of local clients to the gateway itself.
    ///
    /// # Errors
    /// If the gateway cannot start; see [`Daemon::start`].
    pub async fn start_with(settings: Settings, control: Option<Control>) -> Result<Daemon, StartError> {
        let settings = file_limit::fit(settings);
        let drives = settings.buses.iter().map(|bus| bus.drives.len()).sum();
        let (events, command_log) = (Events::of_drives(drives), Arc::new(CommandLog::default()));
        let plant = Plant {
            events: events.clone(),
            command_log: command_log.clone(),
            ..Plant::new(&settings.gateway, settings.stale_after.limit, Vec::new())
        };
        let shared: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
        let reservations = ReservationsFile::default();
        let drills_file = drills::DrillsFile::default();
        let north = Arc::<NorthState>::default();
        let tasks = vec![
            tokio::spawn(Watch::of_this_thread().run(events.clone())),
            report_refusals(shared.clone()),
            stop_all(shared.clone(), north.stop_all.clone()),
        ];
        let saver = reservations::Saver::start(shared.clone(), reservations.clone(), north.awaited.clone());
        let mut daemon = Daemon {
            plant: shared.clone(),
            settings: settings.clone(),
            buses: Vec::new(),
            parted: RemovedDrives::default(),
            unused_names: UnusedNames::default(),
            events,
            command_log,
            north: north.clone(),
            listening: ListeningServers::default(),
            mqtt: ServerSlot::default(),
            local: ServerSlot::default(),
            reader: None,
            recorder: None,
            keeper: None,
            guards: Arc::default(),
            starts: None,
            tasks,
            driller: drills::watch(shared, north.drills.clone(), drills_file.clone()),
            drills: drills_file,
            reservations,
            saver,
            pulse: BusHeartbeats::default(),
            control,
        };
        // The keeper starts before anything happens: it has the earlier events.
        daemon.apply_keeper(&settings).await;
        daemon.apply_audit(&settings).await;
        // MQTT starts after the buses; subscribing now lets its first messages include their events.
        drivegate_mqtt::Handover::of(&daemon.north).leave_events(daemon.events.subscribe());
        let buses = daemon.prepare_buses(&settings)?;
        daemon.apply_recorder(&settings).await?;
        daemon.apply(&settings, buses, PreparedServers::default()).await;
        reservations::restore(&daemon.reservations, &daemon.north, &daemon.plant).await;
        daemon.expect_kept_slots(&settings).await;
        daemon.apply_mqtt(&settings).await;
        // The servers that report readiness start last.
        let servers = daemon.prepare_servers(&settings).await?;
        daemon.listening.commit(servers).await;
        daemon.apply_local(&settings).await;
        Ok(daemon)
    }

    /// The plant: all buses with their images and queues.
    pub fn plant(&self) -> SharedPlant {
        self.plant.clone()
    }

    /// The address that the HTTP server listens on.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.listening.http.server().and_then(drivegate_http::Http::address)
    }

    /// The addresses that the Modbus TCP server listens on without TLS.
    pub fn modbus_tcp_addresses(&self) -> Vec<SocketAddr> {
        let server = self.listening.modbus_tcp.server();
        server.map(modbus_tcp::Server::addresses).unwrap_or_default()
    }

    /// Path of the local socket if the socket is open.
    pub fn socket(&self) -> Option<&std::path::Path> {
        self.local.server().map(local::Local::path)
    }

    /// Whether the bus threads make progress.
    pub fn pulse(&self) -> BusHeartbeats {
        self.pulse.clone()
    }

    /// Counters of the servers.
    pub fn stats(&self) -> Arc<NorthState> {
        self.north.clone()
    }

    /// Applies a new configuration and returns what changed. Unchanged parts keep running without a lost cycle.
    ///
    /// # Errors
    /// If a bus or a server cannot start: everything runs as before.
    pub async fn reload(&mut self, settings: Settings) -> Result<Vec<String>, StartError> {
        let settings = file_limit::fit(settings);
        // All steps that can fail come before any running part is stopped or changed.
        let buses = self.prepare_buses(&settings)?;
        let servers = self.prepare_servers(&settings).await?;
        if let Err(error) = self.apply_recorder(&settings).await {
            tracing::error!(target: "drivegate::daemon", "{error}; the new configuration applies, without recordings; reload it again");
        }
        self.apply(&settings, buses, servers).await;
        self.apply_mqtt(&settings).await;
        self.apply_local(&settings).await;
        self.apply_audit(&settings).await;
        self.apply_keeper(&settings).await;
        let changes = changes::between(&self.settings, &settings);
        self.settings = settings;
        Ok(changes)
    }

    /// The steps in the middle of a start and of a reload, none of which can fail. A start has no servers yet, which report
    /// readiness.
    async fn apply(&mut self, settings: &Settings, buses: Vec<(BusSettings, BusTask)>, servers: PreparedServers) {
        // The guards must be applied before the first start is counted.
        self.apply_guards(settings).await;
        self.apply_params(settings);
        self.hold_unfinished(settings).await;
        self.end_rights(settings);
        self.listening.commit(servers).await;
        self.end_drill_of_changed_bus(settings).await;
        self.replace_buses(settings, buses).await;
        self.void_slots();
        self.apply_reservations(settings);
        self.apply_drills(settings).await;
    }

    /// Prepares the buses that are new or changed.
    fn prepare_buses(&self, settings: &Settings) -> Result<Vec<(BusSettings, BusTask)>, StartError> {
        let runs = |bus: &BusSettings| self.buses.iter().any(|(before, _)| before == bus);
        let wanted = settings.buses.iter().filter(|bus| !runs(bus));
        wanted.map(|bus| Ok((bus.clone(), self.prepare_bus(bus)?))).collect()
    }

    /// Stops the buses that are removed or changed, and starts the `prepared` ones.
    async fn replace_buses(&mut self, settings: &Settings, prepared: Vec<(BusSettings, BusTask)>) {
        let former: Vec<BusHandle> = self.buses.iter().map(|(_, task)| task.handle().clone()).collect();
        let (mut kept, removed): (Vec<_>, Vec<_>) = std::mem::take(&mut self.buses)
            .into_iter()
            .partition(|(before, _)| settings.buses.contains(before));
        // Ports are closed before a changed bus opens one of them. A bus that restarts keeps the leases of its drives.
        let (mut leases, parted) = self.parted.recall(Instant::now());
        let mut quiet_until: BTreeMap<String, Instant> = BTreeMap::new();
        let mut learned: BTreeMap<String, Learned> = BTreeMap::new();
        self.watch(&kept);
        let stopped: Vec<BusHandle> = removed.iter().map(|(_, task)| task.handle().clone()).collect();
        let removed = removed.into_iter().map(|(bus, task)| {
            let last = unserved(task.handle(), settings);
            (bus, (task, last))
        });
        // Last stops to silent drives may take seconds, in which the other buses go on.
        let (with_stops, others): (Vec<_>, Vec<_>) = removed.partition(|(_, (_, last))| !last.is_empty());
        let make_room = |(task, last): (BusTask, Vec<DriveIndex>)| task.make_room(last);
        let mut ended = Vec::new();
        for buses in [with_stops, others] {
            let leaving = buses
                .iter()
                .flat_map(|(_, (task, _))| task.handle().image.drives.iter().cloned());
            self.guards.expect(&leaving.collect::<Vec<_>>(), Instant::now());
            ended.extend(at_once(buses, make_room).await);
        }
        for (before, left) in ended {
            learned.extend(left.learned.map(|learned| (before.spec.port.clone(), learned)));
            leases.left(&before, left.leases);
            quiet_until.extend(left.quiet_until.map(|until| (before.spec.port.clone(), until)));
        }
        let mut handovers: BTreeMap<String, Handover> = BTreeMap::new();
        let known = [stopped.clone(), parted].concat();
        for (bus, task) in prepared {
            task.handle().take_over(&known, Instant::now());
            task.handle()
                .queue
                .guards()
                .into_iter()
                .for_each(|guards| guards.begin());
            let handover = Handover {
                leases: leases.of(&bus, Instant::now()),
                quiet_until: quiet_until.get(&bus.spec.port).copied(),
                learned: learned.get(&bus.spec.port).copied(),
            };
            handovers.insert(bus.spec.name.clone(), handover);
            kept.push((bus, task));
        }
        let begin: Vec<BusHandle> = kept.iter().map(|(_, task)| task.handle().clone()).collect();
        self.unused_names.follow(&former, &begin, Instant::now());
        self.parted.keep(&leases, &stopped, Instant::now());
        let parted = self.parted.clone();
        tokio::spawn(async move {
            tokio::time::sleep(parted.forget(Instant::now()) + Duration::from_secs(1)).await;
            parted.forget(Instant::now());
        });
        let after: Vec<&BusHandle> = kept.iter().map(|(_, task)| task.handle()).collect();
        for bus in &stopped {
            bus.end_holds(&after, &self.events, Instant::now(), SystemTime::now());
        }
        for event in leases.ended(SystemTime::now()) {
            self.events.publish(event);
        }
        // Ends the stops to drives that no longer exist or are only monitored.
        for bus in &stopped {
            bus.queue.close(Outcome::ShuttingDown, Instant::now());
        }
        for (bus, task) in &kept {
            let floor = settings.stale_after.floor(bus.achievable().0);
            let drives = &task.handle().image.drives;
            drives.iter().for_each(|drive| drive.set_stale_floor(floor));
        }
        for (_, task) in &kept {
            task.handle().queue.set_authority(settings.authority.clone());
        }
        let machines = |handles: &mut dyn Iterator<Item = &BusHandle>| -> BTreeMap<String, Machine> {
            let of_bus = |bus: &BusHandle| {
                let image = bus.image.clone();
                let named = |drive: &Arc<DriveImage>| (drive.spec.name.clone(), image.spec.machine(&drive.spec));
                image.drives.iter().map(named).collect::<Vec<_>>()
            };
            handles.flat_map(of_bus).collect()
        };
        let before = machines(&mut self.plant.load().buses.iter());
        let after = machines(&mut kept.iter().map(|(_, task)| task.handle()));
        self.command_log
            .audit()
            .keep_orders_of(|name| before.get(name) == after.get(name));
        let order = |name: &str| settings.buses.iter().position(|b| b.spec.name == name);
        kept.sort_by_key(|(bus, _)| order(&bus.spec.name));
        self.show(settings, &kept);
        // The buses begin last: a client that is notified of a bus finds it in the plant.
        for (bus, task) in &mut kept {
            if let Some(before) = handovers.remove(&bus.spec.name) {
                tracing::info!(target: "drivegate::daemon", bus = %bus.spec.name, port = %bus.spec.port, drives = bus.drives.len(), "starting the bus");
                task.begin(before);
            }
        }
        self.buses = kept;
    }

    /// Makes these buses the present plant.
    fn show(&self, settings: &Settings, buses: &[(BusSettings, BusTask)]) {
        self.watch(buses);
        drivegate_mqtt::Handover::of(&self.north).plant_ends(&self.plant.load(), Instant::now());
        self.plant.store(Arc::new(Plant {
            gateway: settings.gateway.clone(),
            stale_after: settings.stale_after.limit,
            buses: buses.iter().map(|(_, task)| task.handle().clone()).collect(),
            events: self.events.clone(),
            command_log: self.command_log.clone(),
        }));
        let of_bus = |image: &Arc<BusImage>| {
            let drives = image.drives.iter();
            let named = drives.map(|drive| (image.spec.machine(&drive.spec), drive.clone()));
            named.collect::<Vec<_>>()
        };
        let drives = buses.iter().flat_map(|(_, task)| of_bus(&task.handle().image));
        self.guards.watch(drives, settings.stale_after.limit, Instant::now());
        if let Some(recorder) = &self.recorder {
            let images = buses.iter().map(|(_, task)| task.handle().image.clone());
            recorder.adopt(images.collect(), settings.stale_after.limit);
        }
    }

    fn watch(&self, buses: &[(BusSettings, BusTask)]) {
        let beats = buses
            .iter()
            .map(|(bus, task)| (bus.spec.name.clone(), task.heartbeat_counter()));
        self.pulse.watch(beats);
    }

    fn prepare_bus(&self, bus: &BusSettings) -> Result<BusTask, StartError> {
        let failed = |error| StartError::Bus(bus.spec.name.clone(), error);
        let (_, slow_cycle) = bus.achievable();
        let hold = |spec: &DriveSpec| self.north.parameters.restore_lock(&bus.spec.machine(spec));
        let image =
            |spec: &DriveSpec| Arc::new(DriveImage::new(spec.clone(), slow_cycle).with_restore_lock(hold(spec)));
        let drives = bus.drives.iter().map(image).collect();
        let image = Arc::new(BusImage::new(bus.spec.clone(), drives));
        let guards = BusGuards::of(&self.guards, &bus.spec, &bus.drives);
        let queue = CommandQueue::new().map_err(failed)?.guarded(guards);
        let queue = Arc::new(queue.awaiting(self.north.awaited.clone()));
        BusTask::prepare(
            BusHandle::new(image, queue, self.command_log.clone()),
            bus.options.clone(),
            self.events.clone(),
        )
        .map_err(failed)
    }

    /// Shuts down in order: no new commands of local clients, tools, BACnet and Modbus TCP clients, the configured stop commands, the
    /// buses, the last MQTT messages.
    pub async fn stop(mut self) {
        // Orders received over the local socket are answered when the buses have ended.
        let local = self.local.server().map(local::Local::connections);
        self.local.stop().await;
        let ListeningServers {
            mut modbus_tcp,
            mut slots,
            mut bacnet,
            mut http,
        } = std::mem::take(&mut self.listening);
        // The motors wait for no client that is being served, no disk and no drive of a drill: all of these end meanwhile.
        // The servers come first, so that none of them accepts another order, and the drill orders its last stop.
        let drill = drills::end(
            &self.plant,
            &self.north.drills,
            &self.drills,
            "the end of the gateway",
            |_| true,
        );
        join5(
            slots.stop(),
            bacnet.stop(),
            modbus_tcp.stop(),
            drill,
            self.stop_drives(),
        )
        .await;
        self.driller.abort();
        let buses = std::mem::take(&mut self.buses);
        let recorder = self.recorder.take();
        let last_stops = buses.iter().map(|(_, task)| task.last_stops()).max();
        within(STOP_BUSES + last_stops.unwrap_or_default(), "buses", async {
            at_once(buses, BusTask::stop).await;
            if let Some(recorder) = recorder {
                // If the recorder's thread panicked, the panic was already logged.
                let _ = tokio::task::spawn_blocking(move || recorder.stop()).await;
            }
        })
        .await;
        // No stop is accepted any more, so these are the last reservations.
        within(STOP_AUDIT, "the file of reservations", self.saver.end()).await;
        self.tasks.iter().chain(&self.reader).for_each(JoinHandle::abort);
        // Refusals that are held back are reported now, even those that are due later.
        self.plant
            .load()
            .report_refusals(Instant::now() + Duration::from_secs(60));
        self.mqtt.stop().await;
        http.stop().await;
        if let Some(connections) = local {
            connections.close();
            within(STOP_LOCAL, "local clients", connections.wait()).await;
        }
        self.stop_keeper().await;
        self.stop_starts().await;
        let audit = self.command_log.audit();
        if let Some(file) = audit.file() {
            within(STOP_AUDIT, "the audit file", file.stop()).await;
        }
    }
}

/// Stops buses simultaneously and outside the runtime, because each may take seconds. Returns the state that
/// the buses hand over.
async fn at_once<B: Send + 'static, T: Send + 'static>(
    buses: Vec<(BusSettings, B)>,
    end: fn(B) -> T,
) -> Vec<(BusSettings, T)> {
    let stop = |(settings, task): (BusSettings, B)| {
        tracing::info!(target: "drivegate::daemon", bus = %settings.spec.name, "stopping the bus");
        tokio::task::spawn_blocking(move || (settings, end(task)))
    };
    let stopping: Vec<_> = buses.into_iter().map(stop).collect();
    // A bus thread that panicked has ended the process.
    let stopped = futures_util::future::join_all(stopping).await;
    stopped.into_iter().filter_map(Result::ok).collect()
}

/// The drives of a bus that no bus sends a stop to with these settings: removed, moved, only monitored, or on a line that another
/// master owns.
fn unserved(bus: &BusHandle, settings: &Settings) -> Vec<DriveIndex> {
    let image = &bus.image;
    let is_served = |drive: &DriveImage| {
        let machine = image.spec.machine(&drive.spec);
        let of_bus = |bus: &BusSettings| {
            let mut drives = bus.drives.iter().filter(|drive| drive.access == Access::Control);
            bus.options.mode == Mode::Master && drives.any(|drive| bus.spec.machine(drive) == machine)
        };
        settings.buses.iter().any(of_bus)
    };
    let drives = image.drives.enumerate();
    drives
        .filter(|(_, drive)| !is_served(drive))
        .map(|(index, _)| index)
        .collect()
}

/// Watches the commands that stop all drives.
fn stop_all(plant: SharedPlant, orders: Arc<StopAll>) -> JoinHandle<()> {
    tokio::spawn(async move {
        loop {
            orders.begun().await;
            while orders.advance(&plant.load(), Instant::now()) {
                tokio::time::sleep(LOOK).await;
            }
        }
    })
}

/// Reports refusals of the plant whose count is due.
fn report_refusals(plant: SharedPlant) -> JoinHandle<()> {
    tokio::spawn(async move {
        let mut ticks = tokio::time::interval(REFUSALS_REPORTED);
        loop {
            ticks.tick().await;
            let plant = plant.load();
            plant.report_refusals(Instant::now());
            plant.publish_holds(Instant::now(), SystemTime::now());
        }
    })
}

#[cfg(test)]
mod tests;
