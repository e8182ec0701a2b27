//! Drives and buses as configured, with the rights to read and write them. Pure.

mod guard;

pub use guard::{Guard, Interlock, MOST_STARTS};

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use drivegate_model::drive::{PointIndex, Profile, RawWrites};
use drivegate_proto::{LineFormat, Protocol};

/// Whether a drive may be commanded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Access {
    /// The drive is monitored: every write is refused.
    #[default]
    Monitor,
    /// The drive may be read and commanded.
    Control,
    /// Another master owns the line (`mode = "listen"` of the bus): nothing is ever sent.
    Listen,
}

/// The permitted access to a drive's parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ParamsAccess {
    #[default]
    Read,
    /// Parameters may be read and restored.
    Write,
}

/// The action when a drive's lease expires.
#[derive(Debug, Clone, PartialEq)]
pub enum LeaseAction {
    /// Stop the drive.
    Stop,
    /// An expired lease only raises the event.
    LeaveRunning,
    /// Set the speed reference, percent.
    SpeedReference(f64),
}

/// Lease of a drive, renewed by commands that reach the wire and by accepted heartbeats.
#[derive(Debug, Clone, PartialEq)]
pub struct Supervision {
    /// Time without renewal after which the lease expires.
    pub timeout: Duration,
    /// Action when the lease expires.
    pub action: LeaseAction,
    /// A drive that is running when the gateway starts gets its lease: only the clock starts, nothing is written.
    pub adopt: bool,
}

/// The action for a drive at shutdown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OnShutdown {
    /// Nothing is written at shutdown.
    #[default]
    LeaveRunning,
    /// At shutdown the stop is written and its acknowledgement awaited.
    Stop,
}

/// A drive as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveSpec {
    /// Name, unique in the gateway.
    pub name: String,
    /// Name of the drive's bus.
    pub bus: String,
    /// Address on the bus, 1..=247.
    pub address: u8,
    /// Modbus TCP unit id, 1..=254.
    pub unit: u8,
    /// Profile of the drive.
    pub profile: Arc<Profile>,
    /// Group of drives that are stopped together, and started one after the other.
    pub group: Option<String>,
    /// Limits of the drive's starts (`guard`).
    pub guard: Option<Guard>,
    /// The interlocks for starts of this drive.
    pub interlocks: Vec<Interlock>,
    /// Another drive of the group is guarded by `stagger`, so the starts of this one count.
    pub staggers: bool,
    /// Whether the drive may be commanded.
    pub access: Access,
    /// Limits of commands in engineering units, by point name.
    pub limits: BTreeMap<String, RangeInclusive<f64>>,
    /// Lease of the drive, if there is one.
    pub supervision: Option<Supervision>,
    /// The action at shutdown.
    pub on_shutdown: OnShutdown,
    /// Time the drive takes to begin its answer, for the prediction.
    pub turnaround: Duration,
    /// Minimum and maximum frequency, Hz, where the drive's own parameters cannot be read.
    pub frequency_range: Option<RangeInclusive<f64>>,
    /// Values, in addition to faults, that trigger a recording.
    pub triggers: Vec<PointTrigger>,
    /// The permitted raw writes in addition to writable points.
    pub raw_writes: RawWrites,
    /// The permitted access to the drive's parameters.
    pub params: ParamsAccess,
    /// Interval at which the last order is written again because of the drive's own timeout; `None` if it is not repeated.
    pub refresh: Option<Duration>,
    /// Times of this drive on the line, if they differ from those of its bus.
    pub timing: Timing,
}

/// The times of one drive on the line, if they differ from those of its bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Timing {
    /// Time limit for the first byte of a reply; wire time is added.
    pub response_timeout: Option<Duration>,
    /// Silence before each request to this drive, and after its reply before a request to any other drive.
    pub silence: Option<Duration>,
    /// Number of retries after a failed attempt.
    pub retries: Option<u32>,
}

impl Timing {
    /// Longest silence that an exchange with the drive needs on a line with this silence: the silence before the
    /// request, and the additional time that the next request waits, compared with any other drive.
    pub fn silence_around(&self, of_bus: Duration) -> Duration {
        let own = self.silence.unwrap_or(of_bus);
        own + own.saturating_sub(of_bus)
    }
}

/// A limit of a value that starts a recording when it was exceeded for some time.
#[derive(Debug, Clone, PartialEq)]
pub struct PointTrigger {
    /// Index of the point in the profile.
    pub point: PointIndex,
    pub limit: TriggerLimit,
    /// Time for which the condition must hold without interruption.
    pub lasts: Duration,
}

/// Which side of a limit starts the recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TriggerLimit {
    /// The trigger is a value above this one.
    Above(f64),
    /// The trigger is a value below this one.
    Below(f64),
}

/// A bus as configured.
#[derive(Debug, Clone, PartialEq)]
pub struct BusSpec {
    /// Name, unique in the gateway.
    pub name: String,
    /// Path of the serial port, or the address of a device server: `tcp://`, `rfc2217://`, `modbus-tcp://`, `udp://` or
    /// `tcp-listen://`.
    pub port: String,
    pub protocol: Protocol,
    /// Baud rate and character format.
    pub format: LineFormat,
    /// Cadence aimed at for process data.
    pub cycle: Duration,
    /// Cadence aimed at for the slow class.
    pub slow_cycle: Duration,
}

/// Identity of a machine, as far as the configuration defines one: leases, holds and journals belong to it. The
/// name of a drive, and that of its bus, may later mean another machine.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Machine {
    /// The port of the bus.
    pub port: String,
    /// Address of the drive on the bus.
    pub address: u8,
    /// Name of the drive's profile.
    pub profile: String,
}

impl std::fmt::Display for Machine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Machine { port, address, profile } = self;
        write!(f, "address {address} on {port}, profile `{profile}`")
    }
}

impl BusSpec {
    /// Whether the port is a Modbus TCP device on the network: without a serial line known to the gateway, baud
    /// rate or broadcast.
    pub fn is_modbus_tcp(&self) -> bool {
        is_modbus_tcp(&self.port)
    }

    /// Whether a late or duplicate reply cannot be mistaken for the reply to another request, because transaction
    /// ids or sockets distinguish them. Requests may still overtake each other in the network.
    pub fn tells_replies_apart(&self) -> bool {
        self.is_modbus_tcp() || self.port.starts_with("udp://")
    }

    /// The machine that a drive of this bus is.
    pub fn machine(&self, drive: &DriveSpec) -> Machine {
        Machine {
            port: self.port.clone(),
            address: drive.address,
            profile: drive.profile.name.clone(),
        }
    }
}

/// Whether the port is one of Modbus TCP.
pub fn is_modbus_tcp(port: &str) -> bool {
    port.starts_with("modbus-tcp://")
}

impl DriveSpec {
    /// A drive with only address and profile configured: it is monitored, and its unit id is its address.
    pub fn new(name: &str, bus: &str, address: u8, profile: Arc<Profile>) -> DriveSpec {
        DriveSpec {
            name: name.to_string(),
            bus: bus.to_string(),
            address,
            unit: address,
            turnaround: profile.turnaround,
            profile,
            group: None,
            guard: None,
            interlocks: Vec::new(),
            staggers: false,
            access: Access::Monitor,
            limits: BTreeMap::new(),
            supervision: None,
            on_shutdown: OnShutdown::LeaveRunning,
            frequency_range: None,
            triggers: Vec::new(),
            raw_writes: RawWrites::Points,
            params: ParamsAccess::Read,
            refresh: None,
            timing: Timing::default(),
        }
    }

    /// Whether starts of the drive are counted, for its own guard or for those of others.
    pub fn counts_starts(&self) -> bool {
        self.guard.is_some() || self.staggers || !self.interlocks.is_empty()
    }

    /// The name under which drives share `stagger`: the group of the drive, otherwise its bus.
    pub fn starts_with(&self) -> Arc<str> {
        match &self.group {
            Some(group) => format!("group `{group}`").into(),
            None => format!("bus `{}`", self.bus).into(),
        }
    }

    /// Limits of a command to that point: the configured ones, else the profile's.
    pub fn limits_of(&self, point: PointIndex) -> Option<RangeInclusive<f64>> {
        let point = self.profile.points.get(point)?;
        self.limits.get(&point.name).cloned().or_else(|| point.range.clone())
    }
}
