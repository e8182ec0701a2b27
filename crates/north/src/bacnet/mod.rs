//! The BACnet/IP server: each drive is a separate device behind a virtual network (`docs/bacnet.md`).
//!
//! The protocol is in `drivegate_bacnet`, which does no I/O. `objects` lists the objects of a drive, `view` reads
//! their values from the process image, `writes` converts writes of clients to commands, `desk` combines them,
//! `task` sends and receives datagrams, `bbmd` looks up the BBMD for it, `loopback` does the same without sockets.

mod bbmd;
mod desk;
pub mod ede;
mod kept;
pub mod listing;
mod loopback;
pub mod objects;
mod rights;
mod sockets;
mod task;
mod units;
mod view;
mod writes;

#[cfg(test)]
mod tests;

use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ipnet::IpNet;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

pub use self::kept::{discard as discard_kept_slots, expect as expect_kept_slots, obey as obey_kept_slots};
pub use self::loopback::Loopback;

use self::rights::HostRights;
use self::sockets::Sockets;
use self::task::{Task, ToTask};
use super::{NorthState, ServerError, ServerKind};
use crate::listener::ListenerState;
use crate::server::{self, Reconfigure};
use drivegate_core::plant::SharedPlant;

/// The behaviour of an offline drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum WhenOffline {
    /// An offline drive answers nothing.
    #[default]
    Silent,
    /// An offline drive answers, with the flag fault.
    Fault,
}

/// The options of `[bacnet]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Address of the server.
    pub listen: SocketAddrV4,
    /// Device instance of the gateway; the instance of a drive is this number plus its unit id.
    pub device: u32,
    /// Number of the virtual network of the drives; `None` if all objects belong to the gateway's device (`layout = "flat"`).
    pub network: Option<u16>,
    /// Maximum number of foreign devices that the gateway serves as a BBMD.
    pub foreign_devices: usize,
    /// The behaviour of an offline drive.
    pub offline: WhenOffline,
    /// Whether clients may write at all.
    pub commands: bool,
    /// Networks that may read.
    pub allow: Vec<IpNet>,
    /// Networks that may write.
    pub write: Vec<IpNet>,
    /// Whether inactives that protect people outlive a restart.
    pub keep_priorities: bool,
    /// The BBMD at which the gateway registers.
    pub bbmd: Option<(String, u16)>,
    /// Identifier of the vendor.
    pub vendor: u16,
    /// The password of DeviceCommunicationControl.
    pub dcc_password: Option<Secret>,
    /// The buses whose drives are served; `None` for all buses.
    pub buses: Option<Vec<String>>,
    /// Directory for saved state.
    pub state_dir: PathBuf,
}

/// A text that is never displayed.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    pub fn new(text: String) -> Secret {
        Secret(text)
    }
}

impl std::ops::Deref for Secret {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("***")
    }
}

impl Options {
    /// Whether the drives of that bus are shown.
    pub fn serves(&self, bus: &str) -> bool {
        self.buses
            .as_ref()
            .is_none_or(|buses| buses.iter().any(|name| name == bus))
    }

    /// Whether this host may send requests.
    fn admits(&self, host: Ipv4Addr) -> bool {
        let host = IpAddr::V4(host);
        self.allow.iter().any(|network| network.contains(&host))
    }

    /// Whether this host may write.
    fn may_write(&self, host: Ipv4Addr) -> bool {
        let writes = || self.write.iter().any(|network| network.contains(&IpAddr::V4(host)));
        self.commands && self.admits(host) && writes()
    }

    /// Files that the server has open.
    pub fn files(&self) -> usize {
        4
    }

    /// Whether a server with these options can take over the `other` options without a restart: its device identity is
    /// unchanged.
    fn continues(&self, other: &Options) -> bool {
        let identity = |options: &Options| {
            let Options {
                device,
                network,
                vendor,
                foreign_devices,
                ..
            } = *options;
            (device, network, vendor, foreign_devices)
        };
        identity(self) == identity(other)
    }
}

/// The running server.
#[derive(Debug)]
pub struct Server {
    options: Options,
    address: SocketAddr,
    to_task: mpsc::UnboundedSender<ToTask>,
    rights: HostRights,
    busy: Arc<AtomicBool>,
    stats: Arc<NorthState>,
    _state: ListenerState,
    tasks: TaskTracker,
}

/// A prepared change of options for [`Server::commit`]: everything that can fail is done.
#[derive(Debug)]
pub struct Change {
    options: Options,
    sockets: Option<Sockets>,
}

impl Server {
    /// The address on which the server listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl server::Server for Server {
    const NAME: &'static str = "BACnet/IP";
    type Options = Options;

    /// Binds the address and serves until `cancel`.
    ///
    /// # Errors
    /// If the address cannot be bound.
    async fn start(
        options: Options,
        plant: SharedPlant,
        stats: Arc<NorthState>,
        cancel: CancellationToken,
    ) -> Result<Server, ServerError> {
        let sockets = bind(options.listen).await?;
        let address = SocketAddr::V4(sockets.address);
        tracing::info!(target: "drivegate::bacnet", %address, network = options.network, device = options.device, "BACnet/IP: listening");
        let (to_task, from_server) = mpsc::unbounded_channel();
        let (busy, tasks) = (Arc::new(AtomicBool::new(false)), TaskTracker::new());
        let rights = HostRights::new(&options);
        let task = Task::new(
            options.clone(),
            sockets,
            rights.clone(),
            plant,
            stats.clone(),
            busy.clone(),
        );
        tasks.spawn(task.run(from_server, cancel));
        tasks.close();
        Ok(Server {
            options,
            address,
            to_task,
            rights,
            busy,
            _state: stats.listeners.add(ServerKind::Bacnet, address),
            stats,
            tasks,
        })
    }

    async fn stopped(self) {
        self.tasks.wait().await;
    }
}

impl Reconfigure for Server {
    type Change = Change;

    /// Prepares other options: binds a new address. Nothing changes for any client.
    ///
    /// # Errors
    /// If the address cannot be bound: the server continues as before.
    async fn prepare(&mut self, options: Options) -> Result<Change, ServerError> {
        let sockets = if options.listen == self.options.listen {
            None
        } else {
            Some(bind(options.listen).await?)
        };
        Ok(Change { options, sockets })
    }

    /// Discards prepared options.
    fn abort(&mut self, change: Change) {
        drop(change);
    }

    /// Applies prepared options.
    fn commit(&mut self, change: Change) {
        let Change { options, sockets } = change;
        if let Some(sockets) = &sockets {
            self.address = SocketAddr::V4(sockets.address);
            self._state = self.stats.listeners.add(ServerKind::Bacnet, self.address);
        }
        // The rights change before the task gets the new options, so that writes in progress are judged by them at once.
        self.rights.set(Some(&options));
        self.options = options.clone();
        // A task that has ended ends with the process.
        let _ = self.to_task.send(ToTask::Apply(Box::new(options), sockets));
    }

    /// Accepts no more requests; requests in progress complete.
    async fn retire(&mut self) {
        self.rights.set(None);
        let _ = self.to_task.send(ToTask::Retire);
    }

    /// Whether all requests have completed after the server retired.
    fn is_drained(&self) -> bool {
        !self.busy.load(Ordering::Relaxed)
    }
}

async fn bind(listen: SocketAddrV4) -> Result<Sockets, ServerError> {
    Sockets::bind(listen).await.map_err(|cause| ServerError::Listen {
        protocol: ServerKind::Bacnet.title(),
        address: SocketAddr::V4(listen),
        section: "[bacnet]".to_string(),
        cause,
    })
}
