//! Messages between a client and the gateway other than drives, buses and events. Fields are added, never renamed or
//! removed.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value as Json;

use drivegate_core::drill::Kind;
use drivegate_core::parameters::{ParameterFile, Plan, RestoreStage, RestoreStatus, Status, StoredFile, read};
use drivegate_core::process_image::{BusSpec, DriveSpec, value_or_null};
use drivegate_model::drive::why::Explanation;
use drivegate_model::drive::{ModelPoint, Point, Quality, Sample};
pub use drivegate_north::command_json::StopBody;

/// An error reply.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ErrorReply {
    /// The error, and what to do about it.
    pub error: String,
    /// The known names, if one was unknown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub known: Vec<String>,
}

impl ErrorReply {
    /// An error reply without known names.
    pub fn new(error: impl Into<String>) -> ErrorReply {
        ErrorReply {
            error: error.into(),
            known: Vec::new(),
        }
    }
}

/// An action on the hold of a drive.
#[derive(Debug, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct HoldAct {
    /// `take`, `renew`, `release` or `break`.
    pub action: String,
}

/// The requested drill.
#[derive(Debug, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DrillWish {
    /// The drive.
    pub drive: String,
    /// The kinds of messages; all kinds if absent or empty.
    #[serde(default)]
    pub kinds: Vec<Kind>,
    /// Speed at which the motor is stopped, %; `max_speed` of `[drill]` where absent.
    #[serde(default)]
    pub speed: Option<f64>,
}

/// The gateway that a client expects, in the header [`EXPECT`]: another gateway replies 421, one with another
/// configuration 412.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Expected {
    /// The gateway that runs with this configuration file, an absolute path without links.
    Configuration(PathBuf),
    /// The gateway that has this drive.
    Drive(ExpectedDrive),
}

/// Header with an [`Expected`] as JSON, percent-encoded.
pub const EXPECT: &str = "x-drivegate-expect";

/// The client's configuration of gateway and drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExpectedDrive {
    /// Name of the drive.
    pub drive: String,
    /// Name of the gateway.
    pub gateway: String,
    /// Port of the bus, as [`port_of`] gives it.
    pub port: String,
    /// Address on the bus.
    pub address: u8,
    /// Name of the profile.
    pub profile: String,
}

impl ExpectedDrive {
    /// The expectation of a configuration.
    pub fn new(gateway: &str, bus: &BusSpec, drive: &DriveSpec) -> ExpectedDrive {
        ExpectedDrive {
            drive: drive.name.clone(),
            gateway: gateway.to_string(),
            port: port_of(bus),
            address: drive.address,
            profile: drive.profile.name.clone(),
        }
    }
}

/// The port of a bus as one canonical path, whatever directory or link it is named by.
pub fn port_of(bus: &BusSpec) -> String {
    if bus.port.contains("://") {
        return bus.port.clone();
    }
    let path = Path::new(&bus.port);
    let found = path.canonicalize().or_else(|_| std::path::absolute(path));
    found.map_or_else(|_| bus.port.clone(), |path| path.display().to_string())
}

/// Why a drive does not run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Why {
    /// Whether the drive runs, and why not.
    #[serde(flatten)]
    pub explanation: Explanation,
    /// Name of the drive's profile.
    pub profile: String,
    /// Whether the profile was verified on hardware.
    pub profile_verified: bool,
}

/// How the parameters of a drive are to be read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ReadParameters {
    /// Reads every address, regardless of what earlier readings found.
    pub afresh: bool,
    /// Whether the reading may take 18 % of a busy line instead of 1.5 %.
    pub brisk: bool,
}

/// An action on a restore.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RestoreAct {
    /// Reads the drive and prepares what would be written.
    Prepare(RestoreWish),
    /// Writes the prepared restore of that number.
    CarryOut(PreparedRestore),
    /// Resumes an interrupted restore.
    Resume,
    /// An interrupted restore is undone.
    Undo,
    /// An interrupted restore is left as it is.
    Release,
}

/// The request of a restore.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RestoreWish {
    /// The file of parameters.
    pub file: String,
    /// The parameters to be written; empty: all.
    #[serde(default)]
    pub only: Vec<String>,
    /// Treat refusals that can be forced as risks.
    #[serde(default)]
    pub force: bool,
}

/// A restore that is prepared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct PreparedRestore {
    /// The number of the restore.
    pub number: u64,
}

/// Result of reading the configuration again; the configuration applies unless there are errors.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ReloadOutcome {
    /// The errors; the gateway runs as before.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<String>,
    /// Warnings: valid, but probably not as intended.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// The changes.
    #[serde(default)]
    pub changes: Vec<String>,
}

/// Whether the gateway is ready.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Health {
    /// Ready state as in `/readyz`.
    pub ready: bool,
    /// Why the gateway is not healthy.
    pub reasons: Vec<String>,
}

/// A recording in progress.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Recorded {
    /// Id of the recording.
    pub id: String,
    /// Time until the recording is complete, s.
    pub after_s: f64,
}

/// A reading of parameters that is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StoredReading {
    /// Name of the drive.
    pub drive: String,
    /// Path of the file, or only its name if the file is on another machine.
    pub file: String,
    /// When it was made, RFC 3339; this and what follows is `null` where the file cannot be read.
    pub time: Option<String>,
    /// Profile of the drive.
    pub family: Option<String>,
    /// The application that the drive ran.
    pub application: Option<String>,
    /// Parameters that were not read.
    pub missing: Option<usize>,
    /// Why the file cannot be read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

impl StoredReading {
    /// Reads the file of a stored reading; `file` is the path that the list shows.
    pub fn of(kept: &StoredFile, file: String) -> StoredReading {
        let (reading, error) = match read(&kept.path) {
            Ok(reading) => (Some(reading), None),
            Err(why) => (None, Some(why)),
        };
        StoredReading {
            drive: kept.drive.clone(),
            file,
            time: reading.as_ref().map(|reading| reading.time.clone()),
            family: reading.as_ref().map(|reading| reading.family.clone()),
            application: reading.as_ref().map(ParameterFile::application),
            missing: reading.as_ref().map(ParameterFile::missing),
            error,
        }
    }
}

/// A reading of parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ParameterReading {
    /// Number of the reading.
    pub number: u64,
    /// Number of addresses requested so far.
    pub done: usize,
    /// Addresses to ask in all.
    pub total: usize,
    /// Estimated remaining time, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub remaining_s: Option<f64>,
    /// What is read now.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub now: Option<String>,
    /// Why the reading waits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waits: Option<String>,
    /// The file of the reading, once the reading has ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// Why the reading failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

impl ParameterReading {
    pub(crate) fn new(status: &Status) -> ParameterReading {
        let (file, error) = match &status.result {
            None => (None, None),
            Some(Ok(file)) => (Some(file.text()), None),
            Some(Err(why)) => (None, Some(why.clone())),
        };
        ParameterReading {
            number: status.number,
            done: status.progress.0,
            total: status.progress.1,
            remaining_s: status.remaining.map(|time| time.as_secs_f64()),
            now: status.now.clone(),
            waits: status.waits.clone(),
            file,
            error,
        }
    }
}

/// A restore of parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Restore {
    /// Number of the restore.
    pub number: u64,
    /// Stage of the restore.
    pub stage: Stage,
    /// Addresses that were read, or parameters that are done.
    pub done: usize,
    /// Number of all parameters to restore.
    pub total: usize,
    /// Why the restore waits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waits: Option<String>,
    /// The plan, as text; once that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<String>,
    /// The risks the user accepts.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub risks: Vec<String>,
    /// Reasons why the restore may not be carried out.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub reasons: Vec<String>,
    /// How the restore ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
}

/// The stage of a restore.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// The drive is read.
    Reading,
    /// The plan is ready.
    Prepared,
    /// The restore may not be carried out.
    Refused,
    /// Parameters are written.
    Working,
    /// The restore has ended.
    Done,
    /// The restore was given up.
    Failed,
    /// A stage that this version does not know.
    #[serde(other)]
    Other,
}

impl Restore {
    pub(crate) fn new(status: &RestoreStatus) -> Restore {
        let plan = &status.prepared.plan;
        let (mut reasons, mut text) = (Vec::new(), None);
        let stage = match &status.stage {
            RestoreStage::Reading => Stage::Reading,
            RestoreStage::Prepared if plan.writes.is_empty() => {
                text = Some("nothing to restore".to_string());
                Stage::Done
            }
            RestoreStage::Prepared => Stage::Prepared,
            RestoreStage::Refused(why) => {
                reasons.clone_from(why);
                Stage::Refused
            }
            RestoreStage::Working => Stage::Working,
            RestoreStage::Ended(how) => {
                text = Some(how.clone());
                Stage::Done
            }
            RestoreStage::Failed(why) => {
                text = Some(why.clone());
                Stage::Failed
            }
        };
        Restore {
            number: status.number,
            stage,
            done: status.progress.0,
            total: status.progress.1,
            waits: status.waits.clone(),
            plan: (*plan != Plan::default()).then(|| plan.to_string()),
            risks: status.prepared.risks.clone(),
            reasons,
            text,
        }
    }
}

/// Why the points of a drive that is offline have no good value.
pub const NO_REPLY: &str = "the drive does not reply";

/// A point with its value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PointValue {
    /// Name.
    pub point: String,
    /// `null` unless the quality is good.
    pub value: Json,
    /// The text of an enumeration's value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// Unit of the value.
    pub unit: String,
    /// `good`, `stale` or `bad`.
    pub quality: String,
    /// Reason why there is no value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
}

/// The state of the drive or the text of its fault. Neither is a point of a profile, but both are read by name like
/// points, as over MQTT and HTTP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Word {
    /// `offline`, `not_ready`, `ready`, `running` or `fault`.
    State,
    /// Empty without a fault.
    FaultText,
}

impl Word {
    pub fn of(name: &str) -> Option<Word> {
        [Word::State, Word::FaultText]
            .into_iter()
            .find(|word| word.name() == name)
    }

    pub fn name(self) -> &'static str {
        match self {
            Word::State => "state",
            Word::FaultText => "fault_text",
        }
    }

    /// The points that the word is made from.
    pub fn sources(self) -> &'static [ModelPoint] {
        match self {
            Word::State => &[ModelPoint::Fault, ModelPoint::Running, ModelPoint::Ready],
            Word::FaultText => &[ModelPoint::FaultCode],
        }
    }
}

impl PointValue {
    /// A text value or, if it is not good, the quality of its source and the reason.
    pub(crate) fn word(word: Word, value: Result<String, (Quality, String)>) -> PointValue {
        let (value, quality, why) = match value {
            Ok(text) => (Json::String(text), Quality::Good, None),
            Err((quality, why)) => (Json::Null, quality, Some(why)),
        };
        PointValue {
            point: word.name().to_string(),
            value,
            text: None,
            unit: String::new(),
            quality: quality.name().to_string(),
            why,
        }
    }

    /// The point with its sample; `why` is called only if the sample is not good.
    pub(crate) fn new(point: &Point, sample: &Sample, why: impl FnOnce() -> String) -> PointValue {
        let value = sample.good();
        PointValue {
            point: point.name.clone(),
            value: value_or_null(value),
            text: value.and_then(|v| point.text_of(v).map(ToString::to_string)),
            unit: point.unit.clone(),
            quality: sample.quality.name().to_string(),
            why: value.is_none().then(why),
        }
    }

    /// Whether the point has a value.
    pub fn is_good(&self) -> bool {
        !self.value.is_null()
    }
}
