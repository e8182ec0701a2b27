//! What a request means: points from the process image, commands by the order function of all north sides. No socket: a
//! command line without a gateway asks the same of a bus of its own.

use std::time::{Duration, Instant};

use super::protocol::{
    Expected, Failure, FailureCode, Outcome, ParamsOutcome, ParamsRequest, PointValue, ReadOutcome, ReadRequest,
    RecordOutcome, RecordRequest, Request, RestoreAct, RestoreOutcome, RestoreRequest, Setting, WhyRequest, Word,
    WriteOutcome, WriteRequest, port_of,
};
use crate::codec::{Reply, RequestPdu};
use crate::command::{self, Authority, DEFAULT_EXPIRY, Order, Origin, Pace, Refusal, stop_of};
use crate::command_json::resolve;
use crate::document::nearest;
use crate::drive::why::Explanation;
use crate::drive::{ModelPoint, Point, PollClass, Profile, Quality, RESTART_COMMUNICATION, Raw, Sample, Source, Value};
use crate::parameter_jobs::{Again, How, begin_reading, carry_out, prepare, release, take_up};
use crate::parameters::{Id, ParameterFile, Wishes};
use crate::plant::{DriveHandle, Plant, SharedPlant, Shown};
use crate::process_image::{Link, Reading, Unavailable, public_points};

/// Most points of one request; a profile has some hundred.
const MAX_POINTS: usize = 1024;
/// Time for all points that are not polled and have to be read from the drive.
const FORWARDED: Duration = Duration::from_secs(10);

/// Does what `request` asks for, which came at `asked`, as `origin`; waits for the drive where that is needed.
pub async fn answer(request: &Request, shared: &SharedPlant, origin: Origin, asked: Instant) -> Outcome {
    let plant = &*shared.load_full();
    let answered = match request {
        Request::Read(request) => read(request, plant, &origin).await.map(Outcome::Read),
        Request::Write(request) => write(request, plant, origin, asked).await.map(Outcome::Write),
        Request::Why(request) => why(request, plant).map(Outcome::Why),
        Request::Record(request) => record(request, plant, &origin).await.map(Outcome::Record),
        Request::Params(request) => params(request, plant, origin).map(Outcome::Params),
        Request::ParamsRestore(request) => restore(request, shared, origin).await.map(Outcome::ParamsRestore),
        Request::Reload(_) | Request::Health(_) | Request::StopAll(_) => {
            let message = "this is not a request to a drive";
            Err(Failure::new(FailureCode::BadRequest, message))
        }
    };
    answered.unwrap_or_else(Outcome::Error)
}

/// The drive that is meant.
fn drive_of(plant: &Plant, name: &str, expect: Option<&Expected>) -> Result<DriveHandle, Failure> {
    let drive = plant.drive(name);
    if let Some(expect) = expect {
        is_expected(plant, name, drive.as_ref(), expect)?;
    }
    drive.ok_or_else(|| {
        let names: Vec<String> = plant.drives().map(|drive| drive.image.spec.name.clone()).collect();
        let hint = match nearest(name, names.iter().map(String::as_str)) {
            Some(near) => format!("did you mean `{near}`?"),
            None => format!("known: {}", names.join(", ")),
        };
        Failure::new(FailureCode::UnknownDrive, format!("there is no drive `{name}`; {hint}"))
    })
}

/// Whether gateway and drive are what the client's file says. What owns the file's port is its gateway, or was before the
/// file was edited; any other gateway has nothing to do with it.
fn is_expected(plant: &Plant, name: &str, drive: Option<&DriveHandle>, expect: &Expected) -> Result<(), Failure> {
    let names_differ = (plant.gateway != expect.gateway)
        .then(|| format!("the gateway is `{}`, the file has `{}`", plant.gateway, expect.gateway));
    let fail = |code, message: String| Err(Failure::new(code, message));
    if !plant.buses.iter().any(|bus| port_of(&bus.image.spec) == expect.port) {
        let why = names_differ.unwrap_or_else(|| format!("the gateway has no bus on {}", expect.port));
        return fail(FailureCode::OtherGateway, why);
    }
    if let Some(why) = names_differ {
        return fail(FailureCode::OtherConfiguration, why);
    }
    let Some(drive) = drive else {
        return fail(
            FailureCode::OtherConfiguration,
            format!("the gateway has no drive `{name}`"),
        );
    };
    let runs = Expected::new(&plant.gateway, &drive.bus.image.spec, &drive.image.spec);
    let pairs = [
        ("port", runs.port, &expect.port),
        ("address", runs.address.to_string(), &expect.address.to_string()),
        ("profile", runs.profile, &expect.profile),
    ];
    match pairs.into_iter().find(|(_, runs, wanted)| runs != *wanted) {
        Some((what, runs, wanted)) => fail(
            FailureCode::OtherConfiguration,
            format!("the gateway has `{name}` with the {what} `{runs}`, the file has it with `{wanted}`"),
        ),
        None => Ok(()),
    }
}

async fn read(request: &ReadRequest, plant: &Plant, origin: &Origin) -> Result<ReadOutcome, Failure> {
    let drive = drive_of(plant, &request.drive, request.expect.as_ref())?;
    let profile = &drive.image.spec.profile;
    let wanted = wanted(profile, &request.points)?;
    let now = Instant::now();
    // One look at the image, so that all values of one poll are of one poll.
    let reading = drive.reading(now);
    let mut points = Vec::with_capacity(wanted.len());
    for one in wanted {
        let index = match one {
            Wanted::Word(word) => {
                points.push(PointValue::word(word, word_of(word, &drive, &reading)));
                continue;
            }
            Wanted::Point(index) => index,
        };
        let Some(point) = profile.points.get(index) else {
            continue;
        };
        points.push(match point.raw().filter(|_| point.class == PollClass::Never) {
            Some(raw) => forwarded(&drive, point, raw, origin.clone(), now + FORWARDED).await,
            None => PointValue::new(point, &reading.sample(index), || why_not_good(&drive, &reading, index)),
        });
    }
    Ok(ReadOutcome { points })
}

/// What is asked for by a name.
#[derive(Debug, Clone, Copy)]
enum Wanted {
    /// A point, by its index.
    Point(usize),
    Word(Word),
}

/// The word, or the quality of what it comes from, and why it is not good.
fn word_of(word: Word, drive: &DriveHandle, reading: &Reading<'_>) -> Result<String, (Quality, String)> {
    let profile = &reading.spec.profile;
    let bad = word
        .sources()
        .iter()
        .filter_map(|point| profile.model_index(*point))
        .find(|index| {
            let sample = reading.sample(*index);
            sample.good().is_none()
        });
    let not_good = || {
        let index = bad.unwrap_or_default();
        (reading.sample(index).quality, why_not_good(drive, reading, index))
    };
    match word {
        Word::State => reading
            .state()
            .map(|state| state.name().to_string())
            .ok_or_else(not_good),
        Word::FaultText if bad.is_some() => Err(not_good()),
        Word::FaultText => Ok(reading.fault_text()),
    }
}

fn wanted(profile: &Profile, names: &[String]) -> Result<Vec<Wanted>, Failure> {
    if names.len() > MAX_POINTS {
        let message = format!("{} points are requested; {MAX_POINTS} are allowed", names.len());
        return Err(Failure::new(FailureCode::BadRequest, message));
    }
    if names.is_empty() {
        let all = public_points(profile).into_iter();
        return Ok(all.map(|(index, _)| Wanted::Point(index)).collect());
    }
    let of = |name: &String| {
        let has = |word: &Word| word.sources().iter().any(|point| profile.model_index(*point).is_some());
        let word = || Word::of(name).filter(has).map(Wanted::Word);
        let shown = |index: &usize| profile.points.get(*index).is_some_and(|point| !point.hidden);
        profile
            .point_index(name)
            .filter(shown)
            .map(Wanted::Point)
            .or_else(word)
            .ok_or_else(|| {
                let message = format!("profile `{}` has no point `{name}`", profile.name);
                Failure::new(FailureCode::UnknownPoint, message)
            })
    };
    names.iter().map(of).collect()
}

/// A point that is not polled: the drive is asked for it.
async fn forwarded(drive: &DriveHandle, point: &Point, raw: &Raw, origin: Origin, deadline: Instant) -> PointValue {
    let pdu = RequestPdu::Read {
        table: raw.table,
        start: raw.address,
        count: raw.form.items(),
    };
    let now = Instant::now();
    let expiry = deadline.saturating_duration_since(now);
    let mut placed = drive.place(Order::Read(pdu), origin, Authority::ReadOnly, expiry, now);
    let outcome = placed.answered().await.outcome;
    let words: Option<Vec<u16>> = match &outcome {
        command::Outcome::Acknowledged(Reply::Registers(words)) => Some(words.clone()),
        command::Outcome::Acknowledged(Reply::Bits(bits)) => Some(bits.iter().map(|b| u16::from(*b)).collect()),
        _ => None,
    };
    let was_read = words.is_some();
    let value = words.and_then(|words| raw.decode(&words, point.kind()));
    let sample = Sample {
        value,
        quality: if value.is_some() { Quality::Good } else { Quality::Bad },
        at: None,
    };
    PointValue::new(point, &sample, || match was_read {
        true => NO_NUMBER.to_string(),
        false => outcome.to_string(),
    })
}

const NO_NUMBER: &str = "the register does not hold a number";

/// Why a polled or derived point has no good value.
fn why_not_good(drive: &DriveHandle, reading: &Reading<'_>, index: usize) -> String {
    if !drive.bus_up() {
        let reason = drive.bus.image.health().reason;
        return reason.map_or("the bus is down".to_string(), |why| format!("the bus is down: {why}"));
    }
    match reading.snapshot.link {
        Link::Untried => return "the drive has not been polled yet".to_string(),
        Link::Offline(_) => return "the drive does not answer".to_string(),
        Link::Online(_) => {}
    }
    let profile = &reading.spec.profile;
    let point = profile.points.get(index);
    let rests_on = match point.map(|point| &point.source) {
        Some(Source::Derived(derived)) => derived.rests_on(),
        _ => vec![index],
    };
    let sources = rests_on.into_iter().filter_map(|source| profile.points.get(source));
    let because = sources.filter_map(|source| {
        let why = why_no_words(reading, source.raw()?)?;
        let is_itself = point.is_some_and(|point| point.name == source.name);
        Some(if is_itself {
            why
        } else {
            format!("`{}`: {why}", source.name)
        })
    });
    because
        .into_iter()
        .next()
        .unwrap_or_else(|| match point.map(|point| &point.source) {
            Some(Source::Derived(_)) => "it cannot be derived: its range is not known".to_string(),
            _ => NO_NUMBER.to_string(),
        })
}

/// Why the words of a register are not good, if they are not.
fn why_no_words(reading: &Reading<'_>, raw: &Raw) -> Option<String> {
    match reading.words(raw.table, raw.address, raw.form.items()).err()? {
        Unavailable::Refused(code) => Some(format!("the drive refused it with {code}")),
        Unavailable::NotPolled => Some("it is not polled".to_string()),
        Unavailable::Stale => Some(match reading.snapshot.read_at(raw.table, raw.address) {
            Some(at) => {
                let age = reading.now.saturating_duration_since(at).as_secs_f64();
                format!("last read {age:.1} s ago")
            }
            None => "it has not been read yet".to_string(),
        }),
    }
}

async fn write(request: &WriteRequest, plant: &Plant, origin: Origin, asked: Instant) -> Result<WriteOutcome, Failure> {
    let now = Instant::now();
    let drive = match drive_of(plant, &request.drive, request.expect.as_ref()) {
        Err(failure) if failure.code == FailureCode::UnknownDrive => {
            let answer = plant.refuse_unknown(
                &request.drive,
                &described(&request.points),
                failure.message,
                origin,
                now,
            );
            return Ok(WriteOutcome::new(&answer, Shown::default()));
        }
        drive => drive?,
    };
    let profile = &drive.image.spec.profile;
    if profile.counts_messages
        && let [
            Setting {
                point,
                value: serde_json::Value::Bool(true),
            },
        ] = request.points.as_slice()
        && point == RESTART_COMMUNICATION
    {
        return Ok(super::restart::communication(&drive, origin, asked).await);
    }
    let (values, refused) = understood(profile, &request.points);
    let (client, stop) = (Authority::Write, stop_of(&values, profile));
    let mut placed = match (refused, stop) {
        (None, _) => drive.place_asked(Order::Points(values), origin, client, DEFAULT_EXPIRY, asked, now),
        (Some(refusal), Some(stop)) => {
            let what = described(&request.points);
            drive.place_stop(
                Order::Points(stop),
                (&what, refusal),
                origin,
                client,
                DEFAULT_EXPIRY,
                now,
            )
        }
        (Some(refusal), None) => {
            let answer = drive.refuse(&described(&request.points), refusal, origin, now);
            return Ok(WriteOutcome::new(&answer, Shown::default()));
        }
    };
    let answer = placed.answered().await;
    placed.confirmed().await;
    let mut shown = placed.shown();
    let run = ModelPoint::Run.name();
    let runs = |setting: &Setting| setting.point == run && setting.value == serde_json::Value::Bool(true);
    if answer.outcome.is_ok() && shown == Shown::default() && request.points.iter().any(runs) {
        let explanation = drive.why(&drive.reading(Instant::now()));
        shown.unseen = explanation.blocked_by().map(|causes| format!("blocked by {causes}"));
    }
    Ok(WriteOutcome::new(&answer, shown))
}

fn why(request: &WhyRequest, plant: &Plant) -> Result<Explanation, Failure> {
    let drive = drive_of(plant, &request.drive, request.expect.as_ref())?;
    Ok(drive.why(&drive.reading(Instant::now())))
}

async fn record(request: &RecordRequest, plant: &Plant, origin: &Origin) -> Result<RecordOutcome, Failure> {
    let drive = drive_of(plant, &request.drive, request.expect.as_ref())?;
    let name = &drive.image.spec.name;
    match plant.recordings.record(name, &origin.who).await {
        Ok((id, after)) => Ok(RecordOutcome {
            id,
            after_s: after.as_secs_f64(),
        }),
        Err(why) => Err(Failure::new(FailureCode::NotRecorded, why.to_string())),
    }
}

fn params(request: &ParamsRequest, plant: &Plant, origin: Origin) -> Result<ParamsOutcome, Failure> {
    let drive = drive_of(plant, &request.drive, request.expect.as_ref())?;
    let (vault, machine) = (&plant.parameters, drive.machine());
    let fail = |why: String| Failure::new(FailureCode::NoParameters, why);
    if request.begin {
        let how = How {
            afresh: request.afresh,
            pace: if request.brisk { Pace::Brisk } else { Pace::Slow },
        };
        begin_reading(vault, drive, origin, how).map_err(fail)?;
    }
    let status = vault.status(&machine);
    let status = status.ok_or_else(|| fail(format!("the parameters of `{}` were not read yet", request.drive)))?;
    Ok(ParamsOutcome::new(&status))
}

async fn restore(request: &RestoreRequest, shared: &SharedPlant, origin: Origin) -> Result<RestoreOutcome, Failure> {
    let plant = shared.load_full();
    let drive = drive_of(&plant, &request.drive, request.expect.as_ref())?;
    let (vault, machine) = (&plant.parameters, drive.machine());
    let fail = |why: String| Failure::new(FailureCode::NotRestored, why);
    match &request.act {
        RestoreAct::Prepare { file, only, force } => {
            let wanted =
                ParameterFile::parse(file).map_err(|why| fail(format!("the file is not understood: {why}")))?;
            let wishes = Wishes {
                only: only.iter().map(|id| Id::new(id)).collect(),
                force: *force,
            };
            prepare(vault, drive, wanted, wishes, origin).map_err(fail)?;
        }
        RestoreAct::CarryOut { number } => carry_out(shared, &drive, *number, origin).map_err(fail)?,
        RestoreAct::Resume => take_up(shared, &drive, Again::Resume, origin).await.map_err(fail)?,
        RestoreAct::Undo => take_up(shared, &drive, Again::Undo, origin).await.map_err(fail)?,
        RestoreAct::Release => release(shared, &drive, &origin).await.map_err(fail)?,
        RestoreAct::Look => {}
    }
    let status = vault.restore(&machine);
    let none = || {
        fail(format!(
            "no parameters of `{}` were restored since the gateway started",
            request.drive
        ))
    };
    Ok(RestoreOutcome::new(&status.ok_or_else(none)?))
}

/// The points that are understood, and why another one is not.
fn understood(profile: &Profile, settings: &[Setting]) -> (Vec<(usize, Value)>, Option<Refusal>) {
    let (mut values, mut refused) = (Vec::new(), None);
    for setting in settings {
        match resolve(profile, &setting.point, &setting.value) {
            Ok(value) => values.push(value),
            Err(refusal) => refused = refused.or(Some(refusal)),
        }
    }
    (values, refused)
}

/// A command that was not understood, for the audit.
fn described(points: &[Setting]) -> String {
    let one = |setting: &Setting| format!("{}={}", setting.point, setting.value);
    let all: Vec<String> = points.iter().take(16).map(one).collect();
    all.join(" ").chars().take(200).collect()
}
