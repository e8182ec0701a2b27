//! What is said of a drill, and the form in which drills are kept. Pure.

use std::time::{Duration, SystemTime};

use serde::{Deserialize, Serialize};

use crate::process_image::Machine;

/// A way by which a motor is to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// An order to stop.
    Order,
    /// Its client falls silent: the lease of its supervision runs out.
    Client,
    /// The gateway falls silent: the drive's own supervision of its fieldbus acts.
    Gateway,
}

impl Kind {
    /// All, in the order in which they are tried: behind the last one a drive may have a fault.
    pub const ALL: [Kind; 3] = [Kind::Order, Kind::Client, Kind::Gateway];

    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Order => "order",
            Kind::Client => "client",
            Kind::Gateway => "gateway",
        }
    }
}

/// How far a drill is, or how it ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DrillState {
    /// It waits for its start.
    Armed,
    /// It is under way.
    Running,
    /// The motor stood in time in each way.
    Passed,
    /// It did not.
    Failed,
    /// Somebody or something ended it.
    Aborted,
    /// Whether the motor stood could not be seen, or it could not be tried.
    NotProven,
}

impl DrillState {
    /// The word for it.
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

    /// Whether it has ended.
    pub fn is_over(self) -> bool {
        !matches!(self, DrillState::Armed | DrillState::Running)
    }
}

/// One way that is tried.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct DrillStep {
    /// Which.
    pub kind: Kind,
    /// How far it is; `armed` until its turn.
    pub state: DrillState,
    /// When the cause was given: the order, or the last sign of life (RFC 3339).
    #[serde(default)]
    pub cause_at: Option<String>,
    /// From the cause to the read that showed the motor standing, ms.
    #[serde(default)]
    pub took_ms: Option<u64>,
    /// The motor stood by then at the latest: it was not asked before.
    #[serde(default)]
    pub upper_bound: bool,
    /// What was seen.
    #[serde(default)]
    pub seen: String,
}

/// A drill.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct DrillReport {
    /// Its name.
    pub id: String,
    /// The drive.
    pub drive: String,
    /// Its bus.
    pub bus: String,
    /// Port, address and profile: whose proof it is, whatever it is called.
    pub port: String,
    /// Address on the bus.
    pub address: u8,
    /// Name of its profile.
    pub profile: String,
    /// Who armed it.
    pub who: String,
    /// How far it is.
    pub state: DrillState,
    /// Why it ended so, or what happens now.
    pub text: String,
    /// Speed at which the motor is stopped, % of its range.
    pub speed: f64,
    /// `max_speed` of `[drill]`, %.
    pub max_speed: f64,
    /// Time in which the motor has to stand, ms.
    pub limit_ms: u64,
    /// When it was armed (RFC 3339).
    pub armed_at: String,
    /// When the motor was started.
    #[serde(default)]
    pub started_at: Option<String>,
    /// When it was over.
    #[serde(default)]
    pub ended_at: Option<String>,
    /// What became of the stop with which every drill ends.
    #[serde(default)]
    pub last_stop: Option<String>,
    /// The ways that are tried.
    pub steps: Vec<DrillStep>,
}

impl DrillReport {
    /// Which machine it is of.
    pub fn machine(&self) -> Machine {
        Machine {
            port: self.port.clone(),
            address: self.address,
            profile: self.profile.clone(),
        }
    }
}

/// What drills have proven of a way by which a motor is to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct StopProof {
    /// Which way.
    pub kind: Kind,
    /// Whether the motor stood in time the last time; `null` where it was never tried.
    pub passed: Option<bool>,
    /// How long ago that was, s.
    pub age_s: Option<u64>,
    /// It failed, was never tried, or is older than `every` of `[drill]`.
    pub due: bool,
}

/// The last time that a way was tried to its end on a machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Proof {
    port: String,
    address: u8,
    profile: String,
    /// Which way.
    pub kind: Kind,
    /// When it ended, ms since 1970.
    pub at_ms: u64,
    /// Whether the motor stood in time.
    pub passed: bool,
}

impl Proof {
    pub(super) fn new(machine: &Machine, kind: Kind, at: SystemTime, passed: bool) -> Proof {
        let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        Proof {
            port: machine.port.clone(),
            address: machine.address,
            profile: machine.profile.clone(),
            kind,
            at_ms: u64::try_from(since.as_millis()).unwrap_or(u64::MAX),
            passed,
        }
    }

    /// Whether it is of that machine.
    pub fn is_of(&self, machine: &Machine) -> bool {
        self.port == machine.port && self.address == machine.address && self.profile == machine.profile
    }

    /// How long ago it was at `time`; none of a clock that stands before it.
    pub fn age(&self, time: SystemTime) -> Duration {
        let at = SystemTime::UNIX_EPOCH + Duration::from_millis(self.at_ms.min(LATEST_MS));
        time.duration_since(at).unwrap_or_default()
    }
}

/// The year 9999, in which no clock is.
const LATEST_MS: u64 = 253_370_764_800_000;
/// Form of the file.
const VERSION: u32 = 1;

/// What is kept of drills over a restart.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SavedDrills {
    drivegate_drills: u32,
    /// The last ones, the oldest first.
    pub reports: Vec<DrillReport>,
    /// By machine and way.
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

    /// Of these ways those that were not proven on that machine within `every` before `time`.
    pub fn unproven(&self, machine: &Machine, kinds: &[Kind], every: Duration, time: SystemTime) -> Vec<Kind> {
        let proven = |kind: &&Kind| {
            let mut proofs = self
                .proofs
                .iter()
                .filter(|proof| proof.kind == **kind && proof.is_of(machine));
            proofs.any(|proof| proof.passed && proof.age(time) <= every)
        };
        kinds.iter().filter(|kind| !proven(kind)).copied().collect()
    }

    /// Reads the file.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn from_json(bytes: &[u8]) -> Result<SavedDrills, String> {
        let saved: SavedDrills = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
        match saved.drivegate_drills {
            VERSION => Ok(saved),
            other => Err(format!("version {other} of the file is not known")),
        }
    }
}
