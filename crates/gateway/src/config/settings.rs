//! The settings that the loader reads from a configuration.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use super::log::LogSettings;
use super::params::ParamsSettings;
use super::stale::StaleAfter;
use drivegate_bus::predict::{self, Prediction};
use drivegate_bus::{BusOptions, Mode};
use drivegate_core::drill::DrillOptions;
use drivegate_core::history::RecorderOptions;
use drivegate_core::order::AuditFileOptions;
use drivegate_core::permit::Rules;
use drivegate_core::process_image::{BusSpec, DriveSpec, Machine};
use drivegate_http::local::SocketPath;
use drivegate_model::drive::profile::Profiles;
use drivegate_north::{bacnet as bacnet_server, modbus_tcp as modbus_tcp_server, slot as slot_server};

/// Prefix of environment variables: `DRIVEGATE__MQTT__PASSWORD`.
pub(super) const ENVIRONMENT: &str = "DRIVEGATE";

/// A valid configuration. Parts that a reload does not change compare equal.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Name of the gateway.
    pub gateway: String,
    /// Path of the socket by which `drivegate read` and `drivegate write` reach the gateway.
    pub socket: SocketPath,
    /// Directory for stored data.
    pub state_dir: PathBuf,
    /// How this process uses the files of that directory: as configured, [`StateFiles::Owned`].
    pub state_files: StateFiles,
    /// The settings of the recorder.
    pub recordings: RecorderOptions,
    /// How parameters are read and kept.
    pub params: ParamsSettings,
    /// Directories of the user's profiles.
    pub profile_dirs: Vec<PathBuf>,
    /// Built-in profiles and the user's.
    pub profiles: Profiles,
    /// Age from which a sample of process data is stale.
    pub stale_after: StaleAfter,
    /// The buses in the order of the file.
    pub buses: Vec<BusSettings>,
    /// Slots of all buses; absent if no bus has a slot.
    pub slots: Option<slot_server::Options>,
    /// Options of Modbus TCP; absent if it is off.
    pub modbus_tcp: Option<modbus_tcp_server::Options>,
    /// Options of MQTT; absent if it is off.
    pub mqtt: Option<drivegate_mqtt::Options>,
    /// Options of HTTP; absent if it is off.
    pub http: Option<drivegate_http::Options>,
    /// Options of BACnet; absent if it is off.
    pub bacnet: Option<bacnet_server::Options>,
    /// Rules for the holders of drives; absent: off.
    pub authority: Option<Arc<Rules>>,
    /// Options of the proof of stops; absent if drills are off.
    pub drill: Option<DrillOptions>,
    /// File of all commands; absent: not written.
    pub audit: Option<AuditFileOptions>,
    /// The settings of the log.
    pub log: LogSettings,
}

impl Settings {
    /// All drives of all buses, each with its bus.
    pub fn drives(&self) -> impl Iterator<Item = (&BusSpec, &DriveSpec)> {
        let buses = self.buses.iter();
        buses.flat_map(|bus| bus.drives.iter().map(|drive| (&bus.spec, drive)))
    }
}

/// How a process uses the files of the state directory.
#[derive(Debug, Clone, PartialEq)]
pub enum StateFiles {
    /// The gateway reads and writes them.
    Owned,
    /// A command without a gateway obeys what they forbid, and changes only those of its own actions: counted starts,
    /// the audit file and readings of parameters.
    Obeyed(Box<WithoutGateway>),
    /// A trial neither reads nor writes them.
    Unused,
}

/// The rest of the configuration, for a command that runs one drive of it without a gateway.
#[derive(Debug, Clone, PartialEq)]
pub struct WithoutGateway {
    /// Options of BACnet, whose kept priorities bind the command although it serves no BACnet.
    pub bacnet: Option<bacnet_server::Options>,
    /// The group of each drive whose starts the gateway counts on disk.
    pub groups: Vec<(Machine, Arc<str>)>,
    /// Whether the command can start its drive.
    pub starts: bool,
}

impl WithoutGateway {
    /// Whether the gateway counts the starts of this machine on disk.
    pub fn counts(&self, machine: &Machine) -> bool {
        self.groups.iter().any(|(counted, _)| counted == machine)
    }
}

/// A bus with the drives on it.
#[derive(Debug, Clone, PartialEq)]
pub struct BusSettings {
    /// The part of the bus that other crates use.
    pub spec: BusSpec,
    /// The settings that only the bus itself uses.
    pub options: BusOptions,
    /// The drives in the order of the file.
    pub drives: Vec<DriveSpec>,
}

impl BusSettings {
    /// The fast and slow cadence that staleness is measured by: those of the configuration, or the best the line can
    /// carry.
    pub(crate) fn achievable(&self) -> (Duration, Duration) {
        if self.listens() {
            return (Duration::ZERO, Duration::ZERO);
        }
        let prediction = self.predict();
        let spec = &self.spec;
        (
            spec.cycle.max(prediction.fast_cycle.unwrap_or_default()),
            spec.slow_cycle.max(prediction.slow_cycle.unwrap_or_default()),
        )
    }

    /// Expected wire times, cycles and load; empty if the gateway only listens.
    pub fn predict(&self) -> Prediction {
        let asked: &[DriveSpec] = if self.listens() { &[] } else { &self.drives };
        predict::predict(&self.spec, self.options.silence, asked)
    }

    /// Whether another master owns the line.
    pub fn listens(&self) -> bool {
        self.options.mode == Mode::Listen
    }
}

/// A value cannot be used, which has been reported.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unusable;
