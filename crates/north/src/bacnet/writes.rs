//! Turns a client's write into a command, or a waiting slot (`docs/bacnet.md`, Commands).

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_bacnet::{Address, Datum, Error, Job};

use super::objects::Meaning;
use super::rights::HostRights;
use super::view::View;
use drivegate_core::order::{
    Arrival, Authority, Commanded, DEFAULT_EXPIRY, Entry, Order, Origin, Outcome, Proof, Refusal, SlotWrite, SourceKind,
};
use drivegate_core::permit::{self, Follows, Stage, client_access, meant_another};
use drivegate_core::plant::{DriveHandle, FormerMachine, NamedBy, OrderRequest, Placed};
use drivegate_core::process_image::Machine;
use drivegate_model::drive::{PointIndex, Value};

/// The priority that belongs to minimum on and off times.
const MINIMUM_TIMES: u8 = 6;
/// Priority of a write without one.
const LOWEST: u8 = 16;

/// The progress of a job.
#[derive(Debug)]
pub(super) enum JobProgress {
    Answered(Result<(), Error>),
    /// The write waits for its drive.
    Waits(Box<Waiting>),
}

/// A write that waits for the drive.
#[derive(Debug)]
pub(super) struct Waiting {
    pub(super) machine: Machine,
    pub(super) placed: Placed,
    /// The write to a slot from which the order follows.
    pub(super) slot: Option<u64>,
}

/// The origin of a client's writes; the client's port does not matter.
pub(super) fn origin(rights: &HostRights, from: &Address, priority: Option<u8>) -> Origin {
    let client = match &from.remote {
        None => format!("bacnet {}", from.ip()),
        Some(_) => format!("bacnet {} behind {}", from.remote_text(), from.ip()),
    };
    let proof = Proof::Bacnet(from.ip().into(), priority.unwrap_or(LOWEST));
    let origin = Origin::of(Arc::from(client), SourceKind::Bacnet, from.to_string());
    origin.proven(proof).with_right(rights.of(from))
}

/// Starts a write whose request arrived at this time.
pub(super) fn begin(view: &View, job: &Job, arrival: Arrival, now: Instant) -> JobProgress {
    let origin = origin(&view.rights, &job.from, job.priority);
    let Some((handle, meaning)) = view.of_drive(job.device, job.place) else {
        let stop = view.run_formerly(job.device, job.object, arrival.asked);
        let stop = stop.and_then(|drive| stop_formerly(&drive, job, origin, arrival, now));
        return stop.unwrap_or(JobProgress::Answered(Err(Error::UNKNOWN_OBJECT)));
    };
    let expiry = expiry(job);
    // A reload may have happened since the request was received, or between two of its writes.
    if let Err(refusal) = client_access(Stage::Accept, false, &origin, &handle.image.spec.bus) {
        handle.refuse(&described(job), refusal, origin, now);
        return JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED));
    }
    if let Some(former) = handle.former(NamedBy::Unit, arrival.asked) {
        return to_former(handle, &former, meaning, job, origin, arrival, now);
    }
    let order = |point, origin, arrival| {
        let request = OrderRequest::new(Order::Points(vec![point]), origin, Authority::Write);
        waits(handle, handle.place(request.within(expiry).arrived(arrival), now), None)
    };
    match (meaning, &job.value) {
        (Meaning::Point(index), Some(value)) => match value_of(value) {
            Some(value) => order((index, value), origin, arrival),
            None => JobProgress::Answered(Err(Error::INVALID_DATA_TYPE)),
        },
        (Meaning::Reset(_) | Meaning::Slot(..), _) if job.priority == Some(MINIMUM_TIMES) => {
            let text = "priority 6 belongs to minimum on and off times";
            handle.refuse(&described(job), Refusal::NotAllowed(text.to_string()), origin, now);
            JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED))
        }
        (Meaning::Reset(index), Some(Datum::Bool(true))) => order((index, Value::Bool(true)), origin, arrival),
        (Meaning::Reset(_), _) => JobProgress::Answered(Ok(())),
        (Meaning::Slot(what, index), _) => slot(handle, what, index, job, origin, arrival, now),
        _ => JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED)),
    }
}

/// A write of `run` to a number that no drive has any more: a stop by the slots of the machine that had it is carried out
/// there; `None` for anything else.
fn stop_formerly(
    drive: &DriveHandle,
    job: &Job,
    origin: Origin,
    arrival: Arrival,
    now: Instant,
) -> Option<JobProgress> {
    let value = match &job.value {
        None => None,
        Some(Datum::Bool(on)) => Some(*on),
        Some(_) => return None,
    };
    let priority = job.priority.unwrap_or(LOWEST);
    if !drive.priorities(|all| all.stops(priority, value)) {
        return None;
    }
    if let Err(refusal) = client_access(Stage::Accept, true, &origin, &drive.image.spec.bus) {
        drive.refuse(&described(job), refusal, origin, now);
        return Some(JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED)));
    }
    let run = drive.image.spec.profile.model_index(Commanded::Run.point())?;
    let order = Order::Points(vec![(run, Value::Bool(false))]);
    let request = OrderRequest::new(order, origin, Authority::Write).within(expiry(job));
    Some(waits(
        drive,
        drive.place(request.arrived(arrival).resolved(), now),
        None,
    ))
}

/// A write whose device number meant another machine when its request arrived: it enters no slot. What was a stop by the
/// slots of that machine is carried out there, anything else nowhere.
fn to_former(
    handle: &DriveHandle,
    former: &FormerMachine,
    meaning: Meaning,
    job: &Job,
    origin: Origin,
    arrival: Arrival,
    now: Instant,
) -> JobProgress {
    let value = match &job.value {
        None => Some(None),
        Some(Datum::Bool(on)) => Some(Some(*on)),
        Some(_) => None,
    };
    let priority = job.priority.unwrap_or(LOWEST);
    let stop = match (meaning, former, value) {
        (Meaning::Slot(Commanded::Run, run), FormerMachine::There(there), Some(value)) => {
            Some(run).filter(|_| there.priorities(|all| all.stops(priority, value)))
        }
        _ => None,
    };
    let Some(run) = stop else {
        let refusal = meant_another();
        let error = of_refusal(&refusal);
        handle.refuse(&described(job), refusal, origin, now);
        return JobProgress::Answered(Err(error));
    };
    // An order that names the present drive is given to the machine that the number meant.
    let order = Order::Points(vec![(run, Value::Bool(false))]);
    let request = OrderRequest::new(order, origin, Authority::Write).within(expiry(job));
    waits(handle, handle.place(request.arrived(arrival), now), None)
}

/// Time after the request within which a write may be sent. A write that waited for another one of the same request
/// gets more time.
fn expiry(job: &Job) -> Duration {
    DEFAULT_EXPIRY + job.since.saturating_duration_since(job.requested_at)
}

fn waits(handle: &DriveHandle, placed: Placed, slot: Option<u64>) -> JobProgress {
    JobProgress::Waits(Box::new(Waiting {
        machine: handle.machine(),
        placed,
        slot,
    }))
}

fn value_of(datum: &Datum) -> Option<Value> {
    match datum {
        Datum::Number(number) => Some(Value::Number(*number)),
        Datum::Bool(on) => Some(Value::Bool(*on)),
        Datum::State(_) | Datum::Text(_) => None,
    }
}

fn described(job: &Job) -> String {
    let priority = job.priority.unwrap_or(16);
    match &job.value {
        None => format!("{} = NULL at priority {priority}", job.object),
        Some(Datum::Number(number)) => format!("{} = {number} at priority {priority}", job.object),
        Some(Datum::Bool(on)) => format!("{} = {on} at priority {priority}", job.object),
        Some(_) => format!("{} at priority {priority}", job.object),
    }
}

/// Processes a write to a slot of the priority array and the order that results from it.
fn slot(
    handle: &DriveHandle,
    what: Commanded,
    index: PointIndex,
    job: &Job,
    origin: Origin,
    arrival: Arrival,
    now: Instant,
) -> JobProgress {
    let priority = job.priority.unwrap_or(16);
    let value = job.value.as_ref().and_then(value_of);
    if let Some(value) = value
        && let Err(refusal) = possible(handle, index, value, now)
    {
        let error = of_refusal(&refusal);
        handle.refuse(&described(job), refusal, origin, now);
        return JobProgress::Answered(Err(error));
    }
    let entry = value.map(|value| Entry::new(value, origin.clone(), now));
    let mut write = SlotWrite::new(what, priority, entry);
    loop {
        match handle.priorities(|all| all.plan(&write)) {
            // Another server may have withdrawn the governing entry meanwhile.
            Follows::Nothing => match stands(handle, &write, &origin, now) {
                Some(begun) => return begun,
                None => continue,
            },
            Follows::Stop => {
                let Some(run) = handle.image.spec.profile.model_index(Commanded::Run.point()) else {
                    return JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED));
                };
                let order = Order::Points(vec![(run, Value::Bool(false))]);
                let id = write.id;
                let request = OrderRequest::new(order, origin, Authority::Write).within(expiry(job));
                let placed = handle.place(request.arrived(arrival).by_slot(write), now);
                return waits(handle, placed, Some(id));
            }
            Follows::Order(of, entry) => {
                let Some(point) = handle.image.spec.profile.model_index(of.point()) else {
                    return JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED));
                };
                let order = Order::Points(vec![(point, entry.value)]);
                let own = write.entry.is_some();
                // The entry that becomes effective was written long ago, but its order is given now.
                let mut came = arrival.clone();
                let mut expires = expiry(job);
                if !own {
                    (came.asked, expires) = (now, DEFAULT_EXPIRY);
                }
                let as_planned = write.clone().governed_by(&entry);
                let request = OrderRequest::new(order, entry.origin, Authority::Write).within(expires);
                let mut placed = handle.place(request.arrived(came).by_slot(as_planned), now);
                let refused = matches!(placed.answer().map(|answer| answer.outcome), Some(Outcome::Refused(_)));
                let next = handle.priorities(|all| all.successor(&write));
                match next.filter(|_| refused && !own) {
                    // The order of the slot's owner is refused, so the slot is released as well.
                    Some(next) if !write.released_too.contains(&next) => write.released_too.push(next),
                    _ => return waits(handle, placed, Some(write.id)),
                }
            }
        }
    }
}

/// Handles a write that leads to no order: the write is in force at once. The lease of the drive belongs to the
/// client whose slot governs.
fn stands(handle: &DriveHandle, write: &SlotWrite, origin: &Origin, now: Instant) -> Option<JobProgress> {
    let governs = handle.priorities(|all| {
        if all.plan(write) != Follows::Nothing {
            return None;
        }
        all.ask(write);
        all.settle(write.id, permit::Settled::Done, now);
        Some(all.client() == Some(origin.client()))
    })?;
    if governs {
        handle.heartbeat(origin, now);
    }
    let stops = write.entry.as_ref().is_none_or(|entry| !entry.value.as_bool());
    if write.what == Commanded::Run && stops {
        handle.said_stop(origin);
    }
    let (drive, priority) = (&handle.image.spec.name, write.priority);
    let value = write
        .entry
        .as_ref()
        .map_or("NULL".to_string(), |entry| entry.value.to_string());
    tracing::info!(
        target: "drivegate::bacnet", drive, priority, client = %origin.who,
        "{} = {value} is in its slot; nothing is sent", write.what.point().name()
    );
    Some(JobProgress::Answered(Ok(())))
}

/// Whether the drive can accept this value at all; anything unknown at this time is checked when the write becomes
/// a command.
fn possible(handle: &DriveHandle, index: PointIndex, value: Value, now: Instant) -> Result<(), Refusal> {
    let order = Order::Points(vec![(index, value)]);
    match permit::admit(order, &handle.reading(now), Authority::Write) {
        Err(refusal @ (Refusal::BadValue(_) | Refusal::NotWritable(_))) => Err(refusal),
        _ => Ok(()),
    }
}

/// The BACnet result for an outcome.
pub(super) fn error(outcome: &Outcome) -> Result<(), Error> {
    Err(match outcome {
        Outcome::Acknowledged(_) => return Ok(()),
        Outcome::Exception(_) | Outcome::NotTaken(_) => Error::OPERATIONAL_PROBLEM,
        Outcome::Refused(refusal) => of_refusal(refusal),
        Outcome::Replaced | Outcome::Purged | Outcome::Withdrawn | Outcome::QueueFull => Error::SERVICE_REQUEST_DENIED,
        Outcome::StopOnly(part) | Outcome::StopFailed(part) => return error(part).and(Err(Error::TIMEOUT)),
        Outcome::Unknown(_)
        | Outcome::TimedOut
        | Outcome::Garbled
        | Outcome::Expired
        | Outcome::Interrupted(_)
        | Outcome::NotStopped
        | Outcome::BusDown
        | Outcome::Offline
        | Outcome::ShuttingDown => Error::TIMEOUT,
    })
}

fn of_refusal(refusal: &Refusal) -> Error {
    match refusal {
        Refusal::NotWritable(_) | Refusal::UnknownDrive(_) | Refusal::NotAllowed(_) => Error::WRITE_ACCESS_DENIED,
        Refusal::BadValue(_) => Error::VALUE_OUT_OF_RANGE,
        Refusal::NotKnown(_)
        | Refusal::MotorRuns(_)
        | Refusal::OtherValue(_)
        | Refusal::HeldByOther(_)
        | Refusal::NeedsTake(_)
        | Refusal::Guarded(_)
        | Refusal::Interlocked(_) => Error::SERVICE_REQUEST_DENIED,
    }
}
