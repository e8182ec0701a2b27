//! Reports of drills, and the file that keeps them. Pure.

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use crate::files::{State, Words};
use crate::process_image::Machine;

/// A way in which a motor must stop, as a drill tests it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Stop by a stop command.
    Order,
    /// The client of the drill stops sending: the lease of the drive's supervision expires.
    Client,
    /// The gateway stops sending: the drive's own fieldbus supervision acts.
    Gateway,
}

impl Kind {
    /// All ways to stop in the order of their tests: after the last one a drive may have a fault.
    pub const ALL: [Kind; 3] = [Kind::Order, Kind::Client, Kind::Gateway];

    /// Name of the way to stop.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Order => "order",
            Kind::Client => "client",
            Kind::Gateway => "gateway",
        }
    }
}

/// The progress or result of a drill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DrillState {
    /// The drill is armed and waits for its start.
    Armed,
    /// The drill is running.
    Running,
    /// The motor stopped in time in each way that was tried.
    Passed,
    /// The motor did not stop in time.
    Failed,
    /// The drill ended early.
    Aborted,
    /// Standstill could not be observed, or the test could not be made.
    NotProven,
}

impl DrillState {
    /// Name of the state.
    pub fn name(self) -> &'static str {
        match self {
            DrillState::Armed => "armed",
            DrillState::Running => "running",
            DrillState::Passed => "passed",
            DrillState::Failed => "failed",
            DrillState::Aborted => "aborted",
            DrillState::NotProven => "not_proven",
        }
    }

    /// Whether the drill has ended.
    pub fn is_over(self) -> bool {
        !matches!(self, DrillState::Armed | DrillState::Running)
    }
}

/// The test of one way to stop, as a step of a drill.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct DrillStep {
    /// The way to stop that is tested.
    pub kind: Kind,
    /// Progress or result of the step; `armed` until the step starts.
    pub state: DrillState,
    /// Time of the cause: the command, or the last sign of life (RFC 3339).
    #[serde(default)]
    pub cause_at: Option<String>,
    /// Time from the cause of the stop to the read that showed the motor standing, ms.
    #[serde(default)]
    pub took_ms: Option<u64>,
    /// `took_ms` is an upper bound: the drive was not read before.
    #[serde(default)]
    pub upper_bound: bool,
    /// What the drill observed.
    #[serde(default)]
    pub seen: String,
}

/// The report of a drill.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct DrillReport {
    /// Id of the drill, and name of its report.
    pub id: String,
    /// Name of the drive.
    pub drive: String,
    /// Bus of the drive.
    pub bus: String,
    /// Port of the machine; with address and profile it identifies the machine under any name.
    pub port: String,
    /// Address on the bus.
    pub address: u8,
    /// Name of the drive's profile.
    pub profile: String,
    /// Client that armed the drill.
    pub who: String,
    /// Progress or result of the drill.
    pub state: DrillState,
    /// The reason for the result, or the current action.
    pub text: String,
    /// Speed at which the motor is stopped, % of its range.
    pub speed: f64,
    /// `max_speed` of `[drill]`, %.
    pub max_speed: f64,
    /// Maximum time to standstill, ms.
    pub limit_ms: u64,
    /// When the drill was armed (RFC 3339).
    pub armed_at: String,
    /// When the motor was started.
    #[serde(default)]
    pub started_at: Option<String>,
    /// When the drill ended.
    #[serde(default)]
    pub ended_at: Option<String>,
    /// The result of the stop with which every drill ends.
    #[serde(default)]
    pub last_stop: Option<String>,
    /// The tests of the drill.
    pub steps: Vec<DrillStep>,
}

impl DrillReport {
    /// The machine on which the drill ran.
    pub fn machine(&self) -> Machine {
        Machine {
            port: self.port.clone(),
            address: self.address,
            profile: self.profile.clone(),
        }
    }
}

/// Result of the last drill for one way to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct StopProof {
    /// Way to stop.
    pub kind: Kind,
    /// Whether the motor stopped in time in the last test; `null` before the first test.
    pub passed: Option<bool>,
    /// Age of the last test, s.
    pub age_s: Option<u64>,
    /// The test failed, was never made, or is older than `every` of `[drill]`.
    pub due: bool,
}

/// The last completed test of one way to stop on one machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Proof {
    /// The machine that was tested.
    #[serde(flatten)]
    pub machine: Machine,
    /// Way to stop.
    pub kind: Kind,
    /// When the test ended, ms since 1970.
    pub at_ms: u64,
    /// Whether the motor stopped in time.
    pub passed: bool,
}

impl Proof {
    pub(super) fn new(machine: &Machine, kind: Kind, at: SystemTime, passed: bool) -> Proof {
        let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        Proof {
            machine: machine.clone(),
            kind,
            at_ms: u64::try_from(since.as_millis()).unwrap_or(u64::MAX),
            passed,
        }
    }

    /// Age of the proof at `time`; 0 if the clock was set back.
    pub fn age(&self, time: SystemTime) -> Duration {
        let at = SystemTime::UNIX_EPOCH + Duration::from_millis(self.at_ms.min(LATEST_MS));
        time.duration_since(at).unwrap_or_default()
    }
}

/// The year 9999, in which no clock is.
const LATEST_MS: u64 = 253_370_764_800_000;
/// Version of the file format.
const VERSION: u32 = 1;

/// State of drills that survives a restart.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedDrills {
    drivegate_drills: u32,
    /// The last reports, oldest first.
    pub reports: Vec<DrillReport>,
    /// The last proofs, for each machine and way to stop.
    pub proofs: Vec<Proof>,
}

impl SavedDrills {
    pub(super) fn new(reports: Vec<DrillReport>, proofs: Vec<Proof>) -> SavedDrills {
        SavedDrills {
            drivegate_drills: VERSION,
            reports,
            proofs,
        }
    }

    /// The ways to stop among `kinds` without a proof for the machine in the period `every` before `time`.
    pub fn unproven(&self, machine: &Machine, kinds: &[Kind], every: Duration, time: SystemTime) -> Vec<Kind> {
        let proven = |kind: &&Kind| {
            let mut proofs = self
                .proofs
                .iter()
                .filter(|proof| proof.kind == **kind && proof.machine == *machine);
            proofs.any(|proof| proof.passed && proof.age(time) <= every)
        };
        kinds.iter().filter(|kind| !proven(kind)).copied().collect()
    }
}

impl State for SavedDrills {
    const WORDS: Words = Words {
        what: "the drills",
        unread: "no drill starts",
        unsaved: "no drill starts",
        lost: "earlier drills are unknown",
    };
    const VERSION_KEY: &'static str = "drivegate_drills";
    const LONGEST: u64 = 16 << 20;
}
