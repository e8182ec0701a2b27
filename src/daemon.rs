//! The gateway as a whole: wiring, reload and the order of stopping.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use tokio_util::sync::CancellationToken;

use crate::bus::BusTask;
use crate::bus::master::Handover;
use crate::bus::supervision::Lease;
use crate::cache::{Access, BusImage, DriveImage, DriveSpec, OnShutdown};
use crate::command::{CommandQueue, WriteStats};
use crate::config::{BusSettings, Settings};
use crate::event::Events;
use crate::north::{NorthStats, http, local, modbus_tcp, mqtt};
use crate::plant::{BusHandle, Plant, SharedPlant};

/// Time beyond that of its stops after which a bus is not waited for any more.
const STOP_SLACK: Duration = Duration::from_millis(300);
/// Time that a server may take to end.
const STOP_SERVER: Duration = Duration::from_secs(2);

/// The gateway cannot start, or cannot take a new configuration: what, where, what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct StartError(pub String);

/// A running gateway.
#[derive(Debug)]
pub struct Daemon {
    settings: Settings,
    plant: SharedPlant,
    buses: Vec<(BusSettings, BusTask)>,
    events: Events,
    writes: Arc<WriteStats>,
    stats: Arc<NorthStats>,
    modbus_tcp: Option<(CancellationToken, modbus_tcp::Server)>,
    mqtt: Option<(CancellationToken, mqtt::Mqtt)>,
    http: Option<(CancellationToken, http::Http)>,
    local: Option<(CancellationToken, local::Local)>,
    beats: BTreeMap<String, u64>,
}

impl Daemon {
    /// Starts all buses and servers. A port that cannot be opened is no error: its bus keeps trying.
    ///
    /// # Errors
    /// When a server cannot listen or the system gives no thread.
    pub async fn start(settings: Settings) -> Result<Daemon, StartError> {
        let (events, writes) = (Events::default(), Arc::new(WriteStats::default()));
        let plant = Plant {
            gateway: settings.gateway.clone(),
            stale_after: settings.stale_after,
            buses: Vec::new(),
            events: events.clone(),
            writes: writes.clone(),
        };
        let mut daemon = Daemon {
            plant: Arc::new(ArcSwap::from_pointee(plant)),
            settings: Settings {
                modbus_tcp: None,
                mqtt: None,
                http: None,
                ..settings.clone()
            },
            buses: Vec::new(),
            events,
            writes,
            stats: Arc::default(),
            modbus_tcp: None,
            mqtt: None,
            http: None,
            local: None,
            beats: BTreeMap::new(),
        };
        // First whoever keeps events, so that none is missed; last the servers that tell whether all is ready.
        daemon.take_mqtt(&settings).await;
        let begins = daemon.prepare_buses(&settings)?;
        daemon.take_buses(&settings, begins);
        daemon.take_servers(&settings).await?;
        daemon.take_local(&settings).await;
        daemon.settings = settings;
        Ok(daemon)
    }

    /// The plant, for whoever wants to look.
    pub fn plant(&self) -> SharedPlant {
        self.plant.clone()
    }

    /// Where the HTTP server listens.
    pub fn http_address(&self) -> Option<std::net::SocketAddr> {
        self.http.as_ref().map(|(_, server)| server.address())
    }

    /// Where the Modbus TCP server listens.
    pub fn modbus_tcp_addresses(&self) -> Vec<std::net::SocketAddr> {
        self.modbus_tcp
            .as_ref()
            .map(|(_, server)| server.addresses().to_vec())
            .unwrap_or_default()
    }

    /// Where the local socket is.
    pub fn socket(&self) -> Option<&std::path::Path> {
        self.local.as_ref().map(|(_, server)| server.path())
    }

    /// Whether every bus has moved since the last call; a bus that hangs must not be hidden by a watchdog that is fed.
    pub fn is_moving(&mut self) -> bool {
        let mut moving = self.buses.len() >= self.settings.buses.len();
        if !moving {
            tracing::error!("not every bus of the configuration runs; the watchdog is not fed");
        }
        for (settings, task) in &self.buses {
            let beats = task.beats();
            if self.beats.insert(settings.spec.name.clone(), beats) == Some(beats) {
                tracing::error!(bus = %settings.spec.name, "the bus hangs; the watchdog is not fed");
                moving = false;
            }
        }
        moving
    }

    /// Takes a new configuration: what is unchanged keeps running without a lost cycle.
    ///
    /// # Errors
    /// When the system gives no thread or no file descriptor for a bus, or a server cannot listen on its new address:
    /// everything is as it was before, the old servers are open again.
    pub async fn reload(&mut self, settings: Settings) -> Result<(), StartError> {
        let before = self.settings.clone();
        // All that can fail comes before anything that runs is ended.
        let begins = self.prepare_buses(&settings)?;
        if let Err(error) = self.take_servers(&settings).await {
            return Err(match self.take_servers(&before).await {
                Ok(()) => error,
                Err(back) => StartError(format!("{error}; the old servers cannot be opened again: {back}")),
            });
        }
        self.take_buses(&settings, begins);
        self.take_mqtt(&settings).await;
        self.take_local(&settings).await;
        self.settings = settings;
        Ok(())
    }

    /// The buses that do not run as they are wanted, ready to begin.
    fn prepare_buses(&self, settings: &Settings) -> Result<Vec<(BusSettings, BusTask)>, StartError> {
        let runs = |bus: &BusSettings| self.buses.iter().any(|(before, _)| before == bus);
        let wanted = settings.buses.iter().filter(|bus| !runs(bus));
        wanted.map(|bus| Ok((bus.clone(), self.prepare_bus(bus)?))).collect()
    }

    /// Ends the buses that are wanted no more, and lets those begin that are new.
    fn take_buses(&mut self, settings: &Settings, begins: Vec<(BusSettings, BusTask)>) {
        let (mut kept, ends): (Vec<_>, Vec<_>) = std::mem::take(&mut self.buses)
            .into_iter()
            .partition(|(before, _)| settings.buses.contains(before));
        // Ports are free again before a changed bus opens one of them. A bus that starts anew does not set a running drive
        // free of its supervision.
        let mut leases: BTreeMap<(String, u8), Lease> = BTreeMap::new();
        let mut quiet_until: BTreeMap<String, Instant> = BTreeMap::new();
        for (before, task) in ends {
            tracing::info!(bus = %before.spec.name, "the bus ends");
            let drives = before.drives.iter().map(|d| (d.name.clone(), d.address));
            let left = task.stop();
            leases.extend(drives.zip(left.leases));
            quiet_until.extend(left.quiet_until.map(|until| (before.spec.port.clone(), until)));
        }
        for (bus, mut task) in begins {
            tracing::info!(bus = %bus.spec.name, port = %bus.spec.port, drives = bus.drives.len(), "the bus starts");
            let lease = |d: &DriveSpec| {
                let before = leases.get(&(d.name.clone(), d.address)).copied().unwrap_or_default();
                if d.access == Access::Control {
                    before
                } else {
                    Lease::default()
                }
            };
            task.begin(Handover {
                leases: bus.drives.iter().map(lease).collect(),
                quiet_until: quiet_until.get(&bus.spec.port).copied(),
            });
            kept.push((bus, task));
        }
        for (bus, task) in &kept {
            // Where nobody wrote when process data is stale, three rounds of a slow line are not.
            let floor = match settings.stale_after_written {
                true => Duration::ZERO,
                false => 3 * bus.achievable().0,
            };
            let drives = &task.handle().image.drives;
            drives.iter().for_each(|drive| drive.set_stale_floor(floor));
        }
        let order = |name: &str| settings.buses.iter().position(|b| b.spec.name == name);
        kept.sort_by_key(|(bus, _)| order(&bus.spec.name));
        self.beats.clear();
        self.plant.store(Arc::new(Plant {
            gateway: settings.gateway.clone(),
            stale_after: settings.stale_after,
            buses: kept.iter().map(|(_, task)| task.handle().clone()).collect(),
            events: self.events.clone(),
            writes: self.writes.clone(),
        }));
        self.buses = kept;
    }

    fn prepare_bus(&self, bus: &BusSettings) -> Result<BusTask, StartError> {
        let failed = |error: std::io::Error| {
            StartError(format!(
                "cannot start bus `{}`: {error}; free memory or file descriptors",
                bus.spec.name
            ))
        };
        let (_, slow_cycle) = bus.achievable();
        let image = |spec: &DriveSpec| Arc::new(DriveImage::new(spec.clone(), slow_cycle));
        let drives = bus.drives.iter().map(image).collect();
        let image = Arc::new(BusImage::new(bus.spec.clone(), drives));
        let queue = Arc::new(CommandQueue::new().map_err(failed)?);
        BusTask::prepare(
            BusHandle { image, queue },
            bus.options.clone(),
            self.writes.clone(),
            self.events.clone(),
        )
        .map_err(failed)
    }

    async fn take_servers(&mut self, settings: &Settings) -> Result<(), StartError> {
        if let (Some(old), Some(new), Some((_, server))) =
            (&self.settings.modbus_tcp, &settings.modbus_tcp, &self.modbus_tcp)
            && new.differs_in_certificates_only(old)
        {
            server.renew_certificates(new).map_err(StartError)?;
            tracing::info!("Modbus TCP: new certificates for clients that connect from now on");
            self.settings.modbus_tcp = settings.modbus_tcp.clone();
        }
        if settings.modbus_tcp != self.settings.modbus_tcp {
            self.settings.modbus_tcp = None;
            if let Some((cancel, server)) = self.modbus_tcp.take() {
                cancel.cancel();
                within(STOP_SERVER, "Modbus TCP", server.stopped()).await;
            }
            if let Some(options) = settings.modbus_tcp.clone() {
                let cancel = CancellationToken::new();
                let server = modbus_tcp::start(options, self.plant.clone(), self.stats.clone(), cancel.clone()).await;
                self.modbus_tcp = Some((cancel, server.map_err(|e| StartError(e.to_string()))?));
            }
            self.settings.modbus_tcp = settings.modbus_tcp.clone();
        }
        if settings.http != self.settings.http {
            self.settings.http = None;
            if let Some((cancel, server)) = self.http.take() {
                cancel.cancel();
                within(STOP_SERVER, "HTTP", server.stopped()).await;
            }
            if let Some(options) = settings.http.clone() {
                let cancel = CancellationToken::new();
                let server = http::start(options, self.plant.clone(), self.stats.clone(), cancel.clone()).await;
                self.http = Some((cancel, server.map_err(|e| StartError(e.to_string()))?));
            }
            self.settings.http = settings.http.clone();
        }
        Ok(())
    }

    async fn take_mqtt(&mut self, settings: &Settings) {
        if settings.mqtt == self.settings.mqtt && settings.gateway == self.settings.gateway {
            return;
        }
        // Client id and buffer are free again before the new client takes them.
        self.stop_mqtt().await;
        if let Some(options) = settings.mqtt.clone() {
            let cancel = CancellationToken::new();
            let client = mqtt::start(options, self.plant.clone(), self.stats.clone(), cancel.clone());
            self.mqtt = Some((cancel, client));
        }
        self.settings.mqtt = settings.mqtt.clone();
        self.settings.gateway = settings.gateway.clone();
    }

    async fn stop_mqtt(&mut self) {
        if let Some((cancel, client)) = self.mqtt.take() {
            cancel.cancel();
            within(STOP_SERVER, "MQTT", client.stopped()).await;
        }
    }

    /// Opens the local socket where it is wanted. The gateway runs without it where it cannot be had; a reload tries again.
    async fn take_local(&mut self, settings: &Settings) {
        if self.local.is_some() && settings.socket == self.settings.socket {
            return;
        }
        self.stop_local().await;
        let cancel = CancellationToken::new();
        match local::start(&settings.socket, self.plant.clone(), cancel.clone()).await {
            Ok(server) => self.local = server.map(|server| (cancel, server)),
            Err(error) => tracing::warn!(
                target: "drivegate::local",
                "{error}; `drivegate read` and `drivegate write` cannot go through this gateway; set `socket` of [gateway], \
                 or socket = \"\" to do without"
            ),
        }
    }

    async fn stop_local(&mut self) {
        if let Some((cancel, server)) = self.local.take() {
            cancel.cancel();
            within(STOP_SERVER, "the local socket", server.stopped()).await;
        }
    }

    /// Stops in order: no new commands, the stops that are configured, the buses, the last messages.
    pub async fn stop(mut self) {
        self.stop_local().await;
        if let Some((cancel, server)) = self.modbus_tcp.take() {
            cancel.cancel();
            within(STOP_SERVER, "Modbus TCP", server.stopped()).await;
        }
        self.stop_drives().await;
        let buses = std::mem::take(&mut self.buses);
        let ended = tokio::task::spawn_blocking(move || {
            for (_, task) in buses {
                task.stop();
            }
        });
        within(STOP_SERVER, "buses", async {
            // A panic of a bus was told by the bus itself.
            let _ = ended.await;
        })
        .await;
        self.stop_mqtt().await;
        if let Some((cancel, server)) = self.http.take() {
            cancel.cancel();
            within(STOP_SERVER, "HTTP", server.stopped()).await;
        }
    }

    /// Lets each bus stop the drives that are configured so, as long as that takes on its line.
    async fn stop_drives(&self) {
        let now = Instant::now();
        let stops = self.buses.iter().map(|(settings, task)| {
            let time = settings.shutdown_time().unanswered;
            let missing = task.handle().queue.begin_shutdown(now + time, now);
            async move {
                // A bus whose port is closed cannot say what became of its drives.
                let missing = tokio::time::timeout(time + STOP_SLACK, missing).await;
                missing.ok().and_then(Result::ok).unwrap_or_else(|| {
                    let stop = |d: &&DriveSpec| d.on_shutdown == OnShutdown::Stop && d.access == Access::Control;
                    let wanted = settings.drives.iter().filter(stop);
                    wanted.map(|d| format!("`{}` was not told to stop", d.name)).collect()
                })
            }
        });
        let missing: Vec<String> = futures_util::future::join_all(stops)
            .await
            .into_iter()
            .flatten()
            .collect();
        if !missing.is_empty() {
            tracing::error!(
                "not every drive acknowledged its stop in time; the gateway stops all the same: {}",
                missing.join(", ")
            );
        }
    }
}

async fn within(time: Duration, what: &str, end: impl Future<Output = ()>) {
    if tokio::time::timeout(time, end).await.is_err() {
        tracing::warn!("{what} did not end within {time:?}; going on without it");
    }
}
