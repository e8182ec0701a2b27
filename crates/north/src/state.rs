//! State that the servers share.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::kept::Kept;
use super::listener::ListenerStates;
use super::patience::Patience;
use super::stats::{BacnetStats, ModbusTcpStats, MqttStats, RefusalStats, ReloadStats, SlotStats};
use drivegate_core::drill::Drills;
use drivegate_core::history::{History, Recordings};
use drivegate_core::parameters::Vault;
use drivegate_core::permit::AwaitedFiles;
use drivegate_core::stop_all::StopAll;

/// State that the servers share and that survives a reload, which replaces servers: counters, recent commands, and
/// recordings.
#[derive(Debug, Default)]
pub struct NorthState {
    /// Time that starts and reloads wait for the disk.
    pub patience: Patience,
    /// Files that may forbid starts and are not read yet.
    pub awaited: Arc<AwaitedFiles>,
    /// The recordings on disk and in progress.
    pub recordings: Arc<Recordings>,
    /// Readings and restores of parameters.
    pub parameters: Arc<Vault>,
    /// Commands that stop all drives.
    pub stop_all: Arc<StopAll>,
    /// The drills of the gateway.
    pub drills: Arc<Drills>,
    /// Trends, counters and events of the past.
    pub history: Arc<History>,
    /// Figures of the Modbus TCP server.
    pub modbus_tcp: ModbusTcpStats,
    /// Figures of the MQTT client.
    pub mqtt: MqttStats,
    /// Figures of the tool slots.
    pub slots: SlotStats,
    /// Figures of the BACnet server.
    pub bacnet: BacnetStats,
    /// Refused connections of all servers.
    pub refused: RefusalStats,
    /// The listeners of all servers, and whether they listen.
    pub listeners: Arc<ListenerStates>,
    /// The last time the configuration was read.
    pub reload: ReloadStats,
    /// Whether the slots that BACnet clients had before the start were loaded or made void: after that, none is restored.
    pub(super) kept_slots_read: AtomicBool,
    kept: Kept,
}

impl NorthState {
    /// The state of this type that a server keeps for its successors; it begins with the default.
    pub fn kept<T: Default + Send + Sync + 'static>(&self) -> Arc<T> {
        self.kept.get()
    }
}
