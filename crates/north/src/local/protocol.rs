//! What is said over the socket: one JSON object a line, a request and its response. Pure.
//!
//! ```text
//! {"v":1,"read":{"drive":"pump-1","points":["output_frequency"]}}
//! {"v":1,"gateway":"plant","read":{"points":[{"point":"output_frequency","value":25.0,"unit":"Hz","quality":"good"}]}}
//! {"v":1,"write":{"drive":"pump-1","points":[{"point":"run","value":false}]}}
//! {"v":1,"why":{"drive":"pump-1"}}
//! {"v":1,"gateway":"plant","why":{"runs":false,"causes":[{"cause":"interlocked","evidence":"…","age_ms":12,"remedy":"…"}],"not_told":[]}}
//! {"v":1,"record":{"drive":"pump-1"}}
//! {"v":1,"gateway":"plant","record":{"id":"20260302T074012.118Z-pump-1","after_s":10.0}}
//! {"v":1,"params":{"drive":"pump-1","begin":true}}
//! {"v":1,"gateway":"plant","params":{"number":3,"done":120,"total":1899,"remaining_s":8.5}}
//! {"v":1,"params_restore":{"drive":"pump-1","act":{"carry_out":{"number":4}}}}
//! {"v":1,"gateway":"plant","params_restore":{"number":4,"stage":"working","done":2,"total":12,"plan":"…"}}
//! {"v":1,"reload":{"config":"/etc/drivegate/drivegate.toml"}}
//! {"v":1,"gateway":"plant","reload":{"errors":[],"warnings":[],"changes":["changed: MQTT"]}}
//! {"v":1,"stop_all":{"bus":"line-1"}}
//! {"v":1,"gateway":"plant","stop_all":{"ok":true,"drives":[{"drive":"pump-1","outcome":"standing","reason":null}]}}
//! {"v":1,"health":{}}
//! {"v":1,"gateway":"plant","health":{"ready":true,"reasons":[]}}
//! {"v":1,"gateway":"plant","write":{"ok":true,"result":"confirmed","message":"…","latency_ms":9.1,"confirmed_ms":31.4}}
//! ```

use std::path::Path;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value as Json;

use crate::command::{Answer, CONFIRMED};
use crate::drive::why::Explanation;
use crate::drive::{ModelPoint, Point, Quality, Sample};
use crate::parameters::{Plan, RestoreStage, RestoreStatus, Status};
use crate::plant::Shown;
use crate::process_image::{BusSpec, DriveSpec, value_or_null};
use crate::stop_all::StopReport;

/// Version of requests and responses. A field that is added does not change it.
pub const VERSION: u64 = 1;
/// Longest request in bytes, with its end of line.
pub const MAX_REQUEST: usize = 64 * 1024;
/// Longest response in bytes, with its end of line.
pub const MAX_RESPONSE: usize = 4 * 1024 * 1024;

/// What a client wants.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Request {
    /// Points of one drive.
    Read(ReadRequest),
    /// Points of one drive set as one command.
    Write(WriteRequest),
    /// Why a drive does not run.
    Why(WhyRequest),
    /// A recording of one drive.
    Record(RecordRequest),
    /// The parameters of one drive.
    Params(ParamsRequest),
    /// Parameters restored to one drive.
    ParamsRestore(RestoreRequest),
    /// All drives are stopped.
    StopAll(StopAllRequest),
    /// The gateway reads its configuration anew.
    Reload(OfGateway),
    /// Whether the gateway is ready.
    Health(OfGateway),
}

/// Which gateway is meant.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OfGateway {
    /// The one that runs with this configuration file, an absolute path without links; absent: whichever answers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub config: Option<String>,
}

/// All drives are stopped, of a bus or of a group where one is named.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StopAllRequest {
    /// As of [`OfGateway`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub config: Option<String>,
    /// Name of a bus.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bus: Option<String>,
    /// Name of a group.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
}

/// Why a drive does not run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WhyRequest {
    /// Name of the drive.
    pub drive: String,
    /// Which configuration the client has in mind; absent: whatever the gateway runs with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expected>,
}

/// A recording of one drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordRequest {
    /// Name of the drive.
    pub drive: String,
    /// Which configuration the client has in mind; absent: whatever the gateway runs with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expected>,
}

/// The parameters of one drive: begin to read them, or say how far that is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParamsRequest {
    /// Name of the drive.
    pub drive: String,
    /// Which configuration the client has in mind; absent: whatever the gateway runs with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expected>,
    /// A reading begins, unless one goes on.
    #[serde(default)]
    pub begin: bool,
    /// The drive is asked for every address, whatever earlier readings found.
    #[serde(default)]
    pub afresh: bool,
    /// It may take 18 % of a busy line in place of 1.5 %.
    #[serde(default)]
    pub brisk: bool,
}

/// Parameters restored to one drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RestoreRequest {
    /// Name of the drive.
    pub drive: String,
    /// Which configuration the client has in mind; absent: whatever the gateway runs with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expected>,
    /// What is to be done.
    pub act: RestoreAct,
}

/// What is to be done with a restore.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RestoreAct {
    /// The drive is read, and what would be written is found out.
    Prepare {
        /// The file of parameters.
        file: String,
        /// These alone; empty: all.
        #[serde(default)]
        only: Vec<String>,
        /// What can be forced is a risk, not a refusal.
        #[serde(default)]
        force: bool,
    },
    /// What the restore of that number found out is written.
    CarryOut {
        /// Its number.
        number: u64,
    },
    /// How far it is.
    Look,
    /// One that was cut off goes on.
    Resume,
    /// One that was cut off is taken back.
    Undo,
    /// One that was cut off is left as it is.
    Release,
}

/// Points of one drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReadRequest {
    /// Name of the drive.
    pub drive: String,
    /// Which configuration the client has in mind; absent: whatever the gateway runs with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expected>,
    /// Names of points; none: all that are polled.
    #[serde(default)]
    pub points: Vec<String>,
}

/// Points of one drive set as one command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WriteRequest {
    /// Name of the drive.
    pub drive: String,
    /// Which configuration the client has in mind; absent: whatever the gateway runs with.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expected>,
    /// What is set.
    pub points: Vec<Setting>,
}

/// One value of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setting {
    /// Name of the point.
    pub point: String,
    /// True or false, a number in the unit of the point, or the text of an enumeration.
    pub value: Json,
}

/// What the client's configuration file says of gateway and drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Expected {
    /// Name of the gateway.
    pub gateway: String,
    /// Port of the bus, as [`port_of`] gives it.
    pub port: String,
    /// Address on the bus.
    pub address: u8,
    /// Name of the profile.
    pub profile: String,
}

impl Expected {
    /// What a configuration says.
    pub fn new(gateway: &str, bus: &BusSpec, drive: &DriveSpec) -> Expected {
        Expected {
            gateway: gateway.to_string(),
            port: port_of(bus),
            address: drive.address,
            profile: drive.profile.name.clone(),
        }
    }
}

/// The port of a bus, the same from whatever directory and by whatever link it is named.
pub fn port_of(bus: &BusSpec) -> String {
    if bus.port.contains("://") {
        return bus.port.clone();
    }
    let path = Path::new(&bus.port);
    let found = path.canonicalize().or_else(|_| std::path::absolute(path));
    found.map_or_else(|_| bus.port.clone(), |path| path.display().to_string())
}

/// The gateway's answer to a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Response {
    /// [`VERSION`].
    pub v: u64,
    /// Name of the gateway.
    pub gateway: String,
    /// What came of the request.
    #[serde(flatten)]
    pub result: Outcome,
}

/// What came of a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The points that were asked for, in their order.
    Read(ReadOutcome),
    /// The command was carried out, or refused.
    Write(WriteOutcome),
    /// Whether the drive runs, and why not.
    Why(Explanation),
    /// A recording goes on.
    Record(RecordOutcome),
    /// A reading of parameters goes on, or is over.
    Params(ParamsOutcome),
    /// A restore goes on, or is over.
    ParamsRestore(RestoreOutcome),
    /// What became of the stops.
    StopAll(StopReport),
    /// The configuration was read anew.
    Reload(ReloadOutcome),
    /// The gateway is ready, or not.
    Health(HealthOutcome),
    /// Nothing was read or written.
    Error(Failure),
}

impl Outcome {
    /// The message where another outcome was to be expected.
    pub fn not_asked_for(self) -> String {
        match self {
            Outcome::Error(failure) => failure.message,
            _ => "the response does not fit the request; the local socket; restart the gateway".to_string(),
        }
    }
}

/// The configuration was read anew; it applies unless there are errors.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ReloadOutcome {
    /// What must be mended; the gateway runs as before.
    pub errors: Vec<String>,
    /// What works but probably not as intended.
    pub warnings: Vec<String>,
    /// What changed.
    pub changes: Vec<String>,
}

/// Whether the gateway is ready.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HealthOutcome {
    /// As `/readyz` says.
    pub ready: bool,
    /// Why it is not.
    pub reasons: Vec<String>,
}

/// A recording that goes on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordOutcome {
    /// Its id.
    pub id: String,
    /// Time until it is complete, s.
    pub after_s: f64,
}

/// A reading of parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParamsOutcome {
    /// Its number.
    pub number: u64,
    /// Addresses that were asked.
    pub done: usize,
    /// Addresses to ask in all.
    pub total: usize,
    /// Time that it will still take, s, by what it took so far.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub remaining_s: Option<f64>,
    /// Why it waits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waits: Option<String>,
    /// The file, once it is over.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

impl ParamsOutcome {
    pub(super) fn new(status: &Status) -> ParamsOutcome {
        let (file, error) = match &status.result {
            None => (None, None),
            Some(Ok(file)) => (Some(file.text()), None),
            Some(Err(why)) => (None, Some(why.clone())),
        };
        ParamsOutcome {
            number: status.number,
            done: status.progress.0,
            total: status.progress.1,
            remaining_s: status.remaining.map(|time| time.as_secs_f64()),
            waits: status.waits.clone(),
            file,
            error,
        }
    }
}

/// A restore of parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RestoreOutcome {
    /// Its number.
    pub number: u64,
    /// What it is at.
    pub stage: Stage,
    /// Addresses that were read, or parameters that are done.
    pub done: usize,
    /// All of them.
    pub total: usize,
    /// Why it waits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waits: Option<String>,
    /// What is written, and what is to be known of it, for people; once that is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<String>,
    /// What the user takes upon himself.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub risks: Vec<String>,
    /// Why it may not be done.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub reasons: Vec<String>,
    /// How it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
}

/// What a restore is at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// The drive is read.
    Reading,
    /// What would be written is known.
    Prepared,
    /// It may not be done.
    Refused,
    /// Parameters are written.
    Working,
    /// It is over.
    Done,
    /// It was given up.
    Failed,
    /// One that this version does not know.
    #[serde(other)]
    Other,
}

impl RestoreOutcome {
    pub(crate) fn new(status: &RestoreStatus) -> RestoreOutcome {
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
        RestoreOutcome {
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

/// The points that were asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReadOutcome {
    /// In the order of the request.
    pub points: Vec<PointValue>,
}

/// A point with what is known of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointValue {
    /// Name.
    pub point: String,
    /// `null` unless the quality is good.
    pub value: Json,
    /// What the value of an enumeration means.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// Unit of the value.
    pub unit: String,
    /// `good`, `stale` or `bad`.
    pub quality: String,
    /// Why there is no value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
}

/// The state in one word and the text of the fault. They are no points of a profile; they are read by these names all the
/// same, as over MQTT and HTTP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Word {
    /// `offline`, `not_ready`, `ready`, `running` or `fault`.
    State,
    /// Empty without a fault.
    FaultText,
}

impl Word {
    /// The one of that name.
    pub fn of(name: &str) -> Option<Word> {
        [Word::State, Word::FaultText]
            .into_iter()
            .find(|word| word.name() == name)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Word::State => "state",
            Word::FaultText => "fault_text",
        }
    }

    /// The points that it comes from.
    pub fn sources(self) -> &'static [ModelPoint] {
        match self {
            Word::State => &[ModelPoint::Fault, ModelPoint::Running, ModelPoint::Ready],
            Word::FaultText => &[ModelPoint::FaultCode],
        }
    }
}

impl PointValue {
    /// A word, or the quality of what it comes from, and why it is not good.
    pub(super) fn word(word: Word, value: Result<String, (Quality, String)>) -> PointValue {
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

    /// The point with its sample; `why` is asked only where that is not good.
    pub(super) fn new(point: &Point, sample: &Sample, why: impl FnOnce() -> String) -> PointValue {
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

    /// Whether it has a value.
    pub fn is_good(&self) -> bool {
        !self.value.is_null()
    }
}

/// How a command ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WriteOutcome {
    /// The drive acknowledged it.
    pub ok: bool,
    /// Result code, as over MQTT.
    pub result: String,
    /// The outcome for people.
    pub message: String,
    /// From acceptance to answer, ms.
    pub latency_ms: f64,
    /// From acceptance to the read that showed the effect, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub confirmed_ms: Option<f64>,
    /// What is known of the effect of a command that no read showed, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub known: Option<String>,
}

impl WriteOutcome {
    pub(super) fn new(answer: &Answer, shown: Shown) -> WriteOutcome {
        let millis = |time: Duration| (time.as_secs_f64() * 1e6).round() / 1e3;
        WriteOutcome {
            ok: answer.outcome.is_ok(),
            result: shown.after.map_or(answer.outcome.code(), |_| CONFIRMED).to_string(),
            message: answer.outcome.to_string(),
            latency_ms: millis(answer.latency),
            confirmed_ms: shown.after.map(millis),
            known: shown.unseen,
        }
    }
}

/// Why nothing was read or written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// The kind of reason.
    pub code: FailureCode,
    /// The reason for people.
    pub message: String,
}

/// Kinds of reasons why nothing was read or written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FailureCode {
    /// It is not a request of this version, or too long.
    BadRequest,
    /// All places for clients are taken.
    Busy,
    /// There is no drive of that name.
    UnknownDrive,
    /// The drive has no point of that name.
    UnknownPoint,
    /// Nothing is recorded.
    NotRecorded,
    /// The parameters of that drive cannot be read.
    NoParameters,
    /// Nothing can be restored to that drive.
    NotRestored,
    /// The client's port is none of this gateway's.
    OtherGateway,
    /// The gateway stops.
    Stopping,
    /// The gateway owns the client's port and runs with another configuration.
    OtherConfiguration,
    /// One that this version does not know.
    #[serde(other)]
    Other,
}

impl Failure {
    pub(super) fn new(code: FailureCode, message: impl Into<String>) -> Failure {
        Failure {
            code,
            message: message.into(),
        }
    }
}

/// Reads a line of a client.
///
/// # Errors
/// What is wrong with it.
pub(super) fn parse(line: &[u8]) -> Result<Request, Failure> {
    let bad = |message: String| Failure::new(FailureCode::BadRequest, message);
    let mut fields: serde_json::Map<String, Json> =
        serde_json::from_slice(line).map_err(|error| bad(format!("expected a JSON object on one line: {error}")))?;
    match fields.remove("v").as_ref().and_then(Json::as_u64) {
        Some(VERSION) => {}
        Some(other) => {
            return Err(bad(format!(
                "version {other} is not supported; this gateway has {VERSION}"
            )));
        }
        None => return Err(bad(format!("expected the version as \"v\":{VERSION}"))),
    }
    // Besides the version there is one field, the name of the request.
    serde_json::from_value(Json::Object(fields)).map_err(|error| bad(format!("expected one request: {error}")))
}

/// A line, with its end.
pub(super) fn line(message: &impl Serialize) -> Vec<u8> {
    // Strings, figures and JSON: this cannot fail.
    let mut line = serde_json::to_vec(message).unwrap_or_default();
    line.push(b'\n');
    line
}

/// A request as a line, with its end.
pub fn request_line(request: &Request) -> Vec<u8> {
    #[derive(Serialize)]
    struct Versioned<'r> {
        v: u64,
        #[serde(flatten)]
        request: &'r Request,
    }
    line(&Versioned { v: VERSION, request })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_survives_its_line() {
        let request = Request::Write(WriteRequest {
            drive: "pump-1".to_string(),
            expect: Some(Expected {
                gateway: "plant".to_string(),
                port: "/dev/ttyUSB0".to_string(),
                address: 1,
                profile: "vacon-nx".to_string(),
            }),
            points: vec![Setting {
                point: "run".to_string(),
                value: true.into(),
            }],
        });
        let line = request_line(&request);
        assert_eq!(line.iter().filter(|byte| **byte == b'\n').count(), 1);
        assert_eq!(parse(&line), Ok(request));
        let short = br#"{"v":1,"read":{"drive":"pump-1"}}"#;
        let read = ReadRequest {
            drive: "pump-1".to_string(),
            expect: None,
            points: Vec::new(),
        };
        assert_eq!(parse(short), Ok(Request::Read(read)));
    }

    #[test]
    fn what_is_not_one_request_is_refused() {
        for (line, why) in [
            ("", "expected a JSON object"),
            ("[]", "expected a JSON object"),
            ("run", "expected a JSON object"),
            (r#"{"read":{"drive":"a"}}"#, "expected the version"),
            (r#"{"v":"1","read":{"drive":"a"}}"#, "expected the version"),
            (r#"{"v":2,"read":{"drive":"a"}}"#, "version 2 is not supported"),
            (r#"{"v":1}"#, "expected one request"),
            (r#"{"v":1,"erase":{}}"#, "unknown variant `erase`"),
            (
                r#"{"v":1,"read":{"drive":"a"},"write":{"drive":"a","points":[]}}"#,
                "expected one request",
            ),
            (r#"{"v":1,"write":{"drive":"a"}}"#, "missing field `points`"),
            (
                r#"{"v":1,"write":{"drive":"a","points":[],"dry_run":true}}"#,
                "unknown field `dry_run`",
            ),
            (
                r#"{"v":1,"write":{"drive":"a","points":{"run":true}}}"#,
                "expected one request",
            ),
        ] {
            let failure = parse(line.as_bytes()).unwrap_err();
            assert_eq!(failure.code, FailureCode::BadRequest);
            assert!(failure.message.contains(why), "{line}: {}", failure.message);
        }
    }

    #[test]
    fn a_reason_of_a_later_version_is_one_too() {
        let text = r#"{"v":1,"gateway":"g","error":{"code":"too_warm","message":"m"},"since":5}"#;
        let response: Response = serde_json::from_str(text).unwrap();
        let Outcome::Error(failure) = response.result else {
            panic!("{response:?}");
        };
        assert_eq!(failure.code, FailureCode::Other);
    }
}
