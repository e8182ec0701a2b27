//! Commands and heartbeats over HTTP. A command has the same body and the same result as on the MQTT set topics.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use axum::Json;
use axum::extract::{FromRequestParts, Path, State};
use axum::http::{StatusCode, header, request};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::{Value as Json_, json};
use tokio::sync::{OwnedSemaphorePermit, watch};

use super::super::app_state::AppState;
use super::super::body::Payload;
use super::super::replies::{Replied, refused};
use super::asker::{Commander, Viewer};
use super::restart;
use super::state::{Operating, Operator};
use drivegate_core::order::{Answer, Arrival, Origin, Outcome, Refusal, SourceKind};
use drivegate_core::plant::{DriveHandle, DriveKey, Placed, Plant, Shown};
use drivegate_core::process_image::Access;
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{ModelPoint, Point, PointIndex, Profile, RESTART_COMMUNICATION, Value};
use drivegate_north::command_json::{self, CommandResult, Id, Repetition, Taken, excerpt, find_id};
use drivegate_north::reading::Reader;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CommandReply {
    status: StatusCode,
    body: Vec<u8>,
}

/// The reply to a command, possibly still pending, for every client that repeats the command.
pub(crate) type SharedReply = watch::Receiver<Option<CommandReply>>;

/// A command that was understood, or not.
enum Progress {
    /// The reply is known already.
    Known(CommandReply),
    /// The command repeats an earlier one and gets its reply.
    Repeated(SharedReply),
    /// The command is in the queue of the bus.
    Placed(Box<Waiting>),
}

/// A command whose result is pending.
struct Waiting {
    placed: Placed,
    id: Option<Id>,
    drive: DriveHandle,
    /// Whether the command makes the motor run.
    runs: bool,
    /// Lets repetitions of the request share its reply; `None` for a stop, which is always executed.
    shared: Option<(watch::Sender<Option<CommandReply>>, OwnedSemaphorePermit)>,
}

impl CommandReply {
    fn new(id: Option<&Id>, drive: &str, answer: &Answer, shown: Shown, time: SystemTime) -> CommandReply {
        CommandReply {
            status: status(&answer.outcome),
            body: CommandResult::new(id, drive, answer, shown, time).to_json(),
        }
    }
}

impl IntoResponse for CommandReply {
    fn into_response(self) -> Response {
        let json = [(header::CONTENT_TYPE, "application/json")];
        (self.status, json, self.body).into_response()
    }
}

/// The HTTP status of a result (`docs/commands.md`).
fn status(outcome: &Outcome) -> StatusCode {
    match outcome {
        Outcome::Acknowledged(_) => StatusCode::OK,
        Outcome::Refused(Refusal::NotAllowed(_)) => StatusCode::FORBIDDEN,
        Outcome::Refused(Refusal::UnknownDrive(_)) => StatusCode::NOT_FOUND,
        Outcome::Refused(
            Refusal::HeldByOther(_) | Refusal::NeedsTake(_) | Refusal::Guarded(_) | Refusal::Interlocked(_),
        ) => StatusCode::CONFLICT,
        Outcome::Refused(
            Refusal::NotWritable(_)
            | Refusal::NotKnown(_)
            | Refusal::BadValue(_)
            | Refusal::MotorRuns(_)
            | Refusal::OtherValue(_),
        ) => StatusCode::UNPROCESSABLE_ENTITY,
        Outcome::Replaced | Outcome::Purged | Outcome::Withdrawn | Outcome::NotStopped => StatusCode::CONFLICT,
        // The status describes the part that was not carried out.
        Outcome::StopOnly(part) | Outcome::StopFailed(part) => status(part),
        Outcome::Exception(_) | Outcome::Garbled | Outcome::NotTaken(_) => StatusCode::BAD_GATEWAY,
        Outcome::TimedOut | Outcome::Unknown(_) | Outcome::Interrupted(_) => StatusCode::GATEWAY_TIMEOUT,
        Outcome::Expired | Outcome::BusDown | Outcome::Offline | Outcome::QueueFull | Outcome::ShuttingDown => {
            StatusCode::SERVICE_UNAVAILABLE
        }
    }
}

/// When the head of a request arrived, and the reader of its body; comparing the password and waiting for the body
/// happen later.
pub(crate) struct RequestArrival(Arrival, Option<Arc<Reader>>);

impl RequestArrival {
    /// The arrival of the request, after its body was read.
    pub(super) fn complete(self) -> Arrival {
        match self.1 {
            Some(reader) => self.0.completed(&reader.last()),
            None => self.0,
        }
    }
}

impl<S: Sync> FromRequestParts<S> for RequestArrival {
    type Rejection = Infallible;

    async fn from_request_parts(head: &mut request::Parts, _: &S) -> Result<RequestArrival, Infallible> {
        let arrival = head.extensions.get().cloned();
        let arrival = arrival.unwrap_or_else(|| Arrival::now(Instant::now()));
        Ok(RequestArrival(arrival, head.extensions.get().cloned()))
    }
}

/// `POST /api/v1/drives/{name}/commands`
pub(crate) async fn command(
    asked: RequestArrival,
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    // The right is checked again when the command is placed, so that a refusal is audited.
    Commander(operator): Commander,
    Payload(payload): Payload,
) -> Replied<CommandReply> {
    let (plant, arrival) = (app.plant.load_full(), asked.complete());
    if let Some(drive) = restarts(&payload).then(|| plant.drive(&name)).flatten()
        && drive.image.spec.profile.counts_messages
    {
        let (answer, shown) = restart::communication(&drive, operator.origin(), arrival).await;
        return Ok(CommandReply::new(None, &name, &answer, shown, SystemTime::now()));
    }
    let times = (arrival, Instant::now(), SystemTime::now());
    match app.operating.take(&plant, &operator, &name, &payload, times) {
        Progress::Known(reply) => Ok(reply),
        Progress::Repeated(reply) => shared(reply).await,
        Progress::Placed(mut waiting) => match waiting.shared.take() {
            None => Ok(waiting.finished().await),
            // The result is kept for any client that repeats the command, even if the first client has disconnected.
            Some((sender, permit)) => {
                let reply = sender.subscribe();
                tokio::spawn(async move {
                    let reply = waiting.finished().await;
                    sender.send_replace(Some(reply));
                    drop(permit);
                });
                shared(reply).await
            }
        },
    }
}

/// Waits for a reply that several may wait for.
async fn shared(mut reply: SharedReply) -> Replied<CommandReply> {
    let known = reply
        .wait_for(Option::is_some)
        .await
        .ok()
        .and_then(|reply| reply.clone());
    // The task ends without a reply only when the process does.
    known.ok_or(StatusCode::SERVICE_UNAVAILABLE.into())
}

impl Waiting {
    async fn finished(mut self) -> CommandReply {
        let answer = self.placed.answered().await;
        self.placed.confirmed().await;
        let mut shown = self.placed.shown();
        if self.runs && answer.outcome.is_ok() && shown == Shown::default() {
            let explanation = self.drive.why(&self.drive.reading(Instant::now()));
            shown.unseen = explanation.blocked_by().map(|causes| format!("blocked by {causes}"));
        }
        let name = &self.drive.image.spec.name;
        CommandReply::new(self.id.as_ref(), name, &answer, shown, SystemTime::now())
    }
}

/// Whether the payload requests only a restart of the communication.
fn restarts(payload: &[u8]) -> bool {
    let wanted = json!({ RESTART_COMMUNICATION: true });
    serde_json::from_slice::<Json_>(payload).is_ok_and(|asked| asked == wanted)
}

/// Whether the points have the motor run.
fn has_run(points: &[(PointIndex, Value)], profile: &Profile) -> bool {
    let run = profile.model_index(ModelPoint::Run);
    points
        .iter()
        .any(|(index, value)| Some(*index) == run && *value == Value::Bool(true))
}

impl Operator {
    /// The origin for the audit. All requests of a user count as one client.
    pub(crate) fn origin(&self) -> Origin {
        if self.kind != SourceKind::Http {
            let origin = Origin::new(self.kind, self.user.to_string());
            return origin
                .with_login(self.login.clone())
                .proven(self.proof.clone())
                .with_right(self.right.clone());
        }
        let client = format!("{} {}", self.kind.name(), self.user);
        let who = format!("{} {}", self.user, self.address);
        let origin = Origin::of(client.into(), self.kind, who);
        origin
            .with_login(self.login.clone())
            .proven(self.proof.clone())
            .with_right(self.right.clone())
    }
}

impl Operating {
    /// Takes a command whose head arrived at this time; `now` is `time` on the calendar. When this returns the
    /// command is in the queue of its bus, or its reply is known. A repeated command is not executed again: it gets
    /// the reply of the first one, or is refused. A stop is always executed, but if the repeated command contains
    /// more, only its stop.
    fn take(
        &self,
        plant: &Plant,
        operator: &Operator,
        name: &str,
        payload: &[u8],
        (arrival, now, time): (Arrival, Instant, SystemTime),
    ) -> Progress {
        let (id, origin, what) = (find_id(payload), operator.origin(), excerpt(payload));
        let reply =
            |answer: &Answer| Progress::Known(CommandReply::new(id.as_ref(), name, answer, Shown::default(), time));
        let Some(drive) = plant.drive(name) else {
            if let Some(former) = plant.drive_formerly(&DriveKey::Name(name.to_string()), arrival.asked)
                && let Ok(asked) = command_json::order(payload, &former.image.spec.profile)
                && let Some(placed) = asked.place_at_former(&former, &what, origin.clone(), arrival, now)
            {
                return Progress::Placed(Box::new(Waiting {
                    placed,
                    drive: former,
                    runs: false,
                    shared: None,
                    id,
                }));
            }
            let answer = command_json::refuse_unknown(plant, name, &what, origin, now);
            return reply(&answer);
        };
        let profile = &drive.image.spec.profile;
        let mut asked = match command_json::order(payload, profile) {
            Ok(asked) => asked,
            Err(refusal) => return reply(&drive.refuse(&what, refusal, origin, now)),
        };
        let (runs, mut shared) = (has_run(&asked.points, profile), None);
        if asked.does_more(profile) {
            match self.remember(&drive, operator, payload, id.as_ref(), now) {
                Ok(remembered) => shared = Some(remembered),
                Err(SkippedCommand::Reply(reply)) if !asked.stops(profile) => return Progress::Repeated(reply),
                Err(SkippedCommand::Reply(_)) => {
                    let why = "it repeats an earlier command, so only its stop is executed again; send it with \
                               another `id`";
                    asked.refused = Some(Refusal::NotAllowed(why.to_string()));
                }
                Err(SkippedCommand::Refused(why)) => asked.refused = Some(Refusal::NotAllowed(why)),
            }
        }
        let placed = match asked.place(&drive, &what, origin, arrival, now) {
            Ok(placed) => placed,
            Err(answer) => return reply(&answer),
        };
        Progress::Placed(Box::new(Waiting {
            placed,
            drive,
            runs,
            shared,
            id,
        }))
    }

    /// Remembers a command that does more than stop.
    ///
    /// # Errors
    /// If the command must not be executed.
    fn remember(
        &self,
        drive: &DriveHandle,
        operator: &Operator,
        payload: &[u8],
        id: Option<&Id>,
        now: Instant,
    ) -> Result<(watch::Sender<Option<CommandReply>>, OwnedSemaphorePermit), SkippedCommand> {
        let refused = |why: &str| SkippedCommand::Refused(format!("{why}; nothing was written"));
        let busy = || refused("too many commands are waiting for their results");
        let permit = self.in_progress.clone().try_acquire_owned().map_err(|_| busy())?;
        let (sender, reply) = watch::channel(None);
        let Some(id) = id else {
            return Ok((sender, permit));
        };
        let mut memory = self.commands.lock();
        let topic = format!("{}/{}", operator.user, drive.image.spec.name);
        let taken = Taken {
            topic: &topic,
            payload,
            ..Taken::default()
        };
        let (print, stops) = (memory.fingerprint(&taken, Some(id.text())), drive.stops());
        match memory.repeated(&taken, print, stops, now) {
            None => {}
            Some(Repetition::Answered(reply)) => return Err(SkippedCommand::Reply(reply)),
            // A reply is shared from the start, so this state cannot occur.
            Some(Repetition::Pending) => return Err(busy()),
            Some(Repetition::Outdated(why)) => {
                let why = format!("it repeats an earlier command, {why}; send it with another `id`");
                return Err(SkippedCommand::Refused(why));
            }
        }
        if !memory.has_room(now) {
            return Err(refused("too many commands with an `id` within ten minutes"));
        }
        let number = memory.remember(&taken, print, stops, now);
        memory.finished(number, &reply);
        Ok((sender, permit))
    }
}

/// A command that is not executed, and why.
enum SkippedCommand {
    /// The command was executed before, with this reply.
    Reply(SharedReply),
    Refused(String),
}

/// `GET /api/v1/drives/{name}/commands`: the points that can be commanded, and their limits.
pub(crate) async fn commands_of(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Viewer(operator): Viewer,
) -> Replied {
    let drive = app.drive(&name)?;
    Ok(Json(description(&drive, &operator)).into_response())
}

/// The points of a drive that can be commanded.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(crate) struct Commandable<'d> {
    drive: &'d str,
    points: Vec<CommandablePoint<'d>>,
    /// `null` without `supervision`.
    lease_ms: Option<u64>,
    /// Whether this login commanded the drive last.
    commanded_last: bool,
    /// Name of the client in `[authority]`.
    principal: Option<String>,
    /// The ranks below the rank of this client.
    outranks: Option<Vec<String>>,
}

#[derive(Debug, Serialize, utoipa::ToSchema)]
struct CommandablePoint<'d> {
    name: &'d str,
    /// `bool` or `number`.
    kind: &'static str,
    unit: &'d str,
    minimum: Option<f64>,
    maximum: Option<f64>,
}

fn description<'d>(drive: &'d DriveHandle, operator: &Operator) -> Commandable<'d> {
    let spec = &drive.image.spec;
    let controlled = spec.access == Access::Control;
    let writable = spec
        .profile
        .points
        .enumerate()
        .filter(|(_, point)| controlled && point.write);
    let point = |(index, point): (PointIndex, &'d Point)| {
        let limits = spec.limits_of(index).map(std::ops::RangeInclusive::into_inner);
        CommandablePoint {
            name: &point.name,
            kind: if point.kind() == Kind::Bool { "bool" } else { "number" },
            unit: &point.unit,
            minimum: limits.map(|(low, _)| low).filter(|low| low.is_finite()),
            maximum: limits.map(|(_, high)| high).filter(|high| high.is_finite()),
        }
    };
    let lease = spec.supervision.as_ref().map(|lease| lease.timeout.as_millis());
    let rank = drive.rank_of(&operator.origin());
    let (principal, outranks) = rank.unzip();
    Commandable {
        drive: &spec.name,
        points: writable.map(point).collect(),
        lease_ms: lease.map(|lease| u64::try_from(lease).unwrap_or(u64::MAX)),
        commanded_last: drive.commander().as_ref() == Some(&operator.login),
        principal,
        outranks,
    }
}

/// `POST /api/v1/drives/{name}/heartbeat`: renews the lease of a drive that this login commanded last.
pub(crate) async fn heartbeat(
    State(app): State<Arc<AppState>>,
    Path(name): Path<String>,
    Commander(operator): Commander,
) -> Replied<StatusCode> {
    let drive = app.drive(&name)?;
    renew(&drive, &operator, Instant::now()).map_err(|why| refused(StatusCode::CONFLICT, why))?;
    Ok(StatusCode::NO_CONTENT)
}

/// Renews the lease of a drive if this login gave the drive its last command.
///
/// # Errors
/// If the lease is not renewed; contains the reason.
fn renew(drive: &DriveHandle, operator: &Operator, now: Instant) -> Result<(), &'static str> {
    let spec = &drive.image.spec;
    if spec.access != Access::Control {
        return Err("the drive is only monitored; nothing was renewed");
    }
    let origin = operator.origin();
    if drive.hold_view(Some(&origin), now).is_some_and(|(_, own)| own) {
        drive.heartbeat(&origin, now);
        return Ok(());
    }
    if spec.supervision.is_none() {
        return Err("the drive has no `supervision`, so there is no lease to renew");
    }
    match drive.commander() {
        Some(login) if login == operator.login => {
            drive.heartbeat(&origin, now);
            Ok(())
        }
        _ => Err("this login was not the last to command the drive; nothing was renewed"),
    }
}

#[cfg(test)]
mod tests;
