//! Parameters of drives: read by background transactions, on request of a client and at intervals, and restored
//! (`restore`).

mod restore;
mod unfinished;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

pub use self::restore::{Again, carry_out, prepare, release, take_up};
pub use self::unfinished::{hold_unfinished, orphans};
use drivegate_core::event::{Event, EventKind};
use drivegate_core::order::{Origin, Pace, SourceKind};
use drivegate_core::parameters::{
    Difference, NO_IDENTIFICATION, NOT_KNOWN, Names, Next, ParameterFile, Reading, Store, Vault, differences,
};
use drivegate_core::plant::{DriveHandle, SharedPlant};
use drivegate_core::process_image::{Access, Machine};
use drivegate_model::drive::parameters::RawValue;

/// Longest time for which a request waits for its turn; then it is repeated.
const EXPIRY: Duration = Duration::from_secs(60);
/// Time without an answer after which the reading of a drive ends.
const AWAY: Duration = Duration::from_secs(3600);
/// Maximum number of changes that an event names.
const NAMED_CHANGES: usize = 5;

/// How a drive is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct How {
    /// Reads every address, regardless of what earlier readings found.
    pub afresh: bool,
    /// How much of a busy line the reading takes.
    pub pace: Pace,
}

/// Begins to read a drive, unless a reading is in progress; the number of the reading.
///
/// # Errors
/// If the drive cannot be read; contains the reason.
pub fn begin_reading(vault: &Arc<Vault>, drive: DriveHandle, origin: Origin, how: How) -> Result<u64, String> {
    let spec = &drive.image.spec;
    if spec.profile.parameters.is_empty() {
        return Err(format!(
            "profile `{}` has no parameters that can be read",
            spec.profile.name
        ));
    }
    if spec.access == Access::Listen {
        return Err(format!("bus `{}` only listens: nothing is sent on it", spec.bus));
    }
    match vault.begin(&drive.machine()) {
        Err(number) => Ok(number),
        Ok(number) => {
            tokio::spawn(run(vault.clone(), drive, origin, how));
            Ok(number)
        }
    }
}

async fn run(vault: Arc<Vault>, drive: DriveHandle, origin: Origin, how: How) {
    let (machine, name) = (drive.machine(), drive.image.spec.name.clone());
    let store = vault.store();
    // A reading that the disk did not take is kept in memory.
    let last = match vault.last(&machine) {
        None => latest(store.clone(), name).await.map(Arc::new),
        last => last,
    };
    let names = vault.names(&drive.image.spec.profile.name);
    let begun = Instant::now();
    let spec = &drive.image.spec;
    let known = last
        .as_deref()
        .filter(|last| !how.afresh && last.family == spec.profile.name);
    let known = known
        .map(|last| Reading::addresses_of(&spec.profile, last))
        .unwrap_or_default();
    let result = read(&drive, origin, known, how.pace, &names, |looks| {
        vault.update(&machine, |job| {
            job.waits = looks.waits;
            if job.waits.is_none() {
                (job.progress, job.remaining) = (looks.progress, remaining(looks.progress, looks.worked));
                job.now = looks.reading;
            }
        });
    })
    .await;
    if let Ok(file) = &result {
        if let Some(last) = &last {
            compare(&vault, &drive, last, file, begun);
        }
        drive.image.forget_written(begun);
        if let Some(store) = store {
            keep(store, file.clone()).await;
        }
    }
    vault.end(&machine, result);
}

/// Publishes the progress of a reading.
struct ReadProgress {
    /// Number of addresses requested so far, and of all.
    progress: (usize, usize),
    /// Time spent on the reading, without pauses.
    worked: Duration,
    /// What is read next.
    reading: Option<String>,
    waits: Option<String>,
}

/// Reads the parameters at the `known` addresses, or all if none is known; `seen` receives the progress.
async fn read(
    drive: &DriveHandle,
    origin: Origin,
    known: BTreeSet<u16>,
    pace: Pace,
    names: &Names,
    mut seen: impl FnMut(ReadProgress),
) -> Result<ParameterFile, String> {
    let spec = &drive.image.spec;
    let mut reading = Reading::new(spec.profile.clone(), known);
    let begun = Instant::now();
    let (mut paused, mut away_since): (Duration, Option<Instant>) = (Duration::ZERO, None);
    while let Some(pdu) = reading.request() {
        let now = Instant::now();
        let outcome = drive.read_in_background(pdu, pace, origin.clone(), EXPIRY, now).await;
        let next = reading.answered(&outcome);
        let mut looks = ReadProgress {
            progress: reading.progress(),
            worked: begun.elapsed().saturating_sub(paused),
            reading: reading.now(),
            waits: None,
        };
        match next {
            Next::Go => away_since = None,
            Next::Failed(why) => return Err(why),
            Next::Pause(pause, why) => {
                let since = *away_since.get_or_insert(now);
                if since.elapsed() > AWAY {
                    return Err(format!("{why}, for {} minutes", AWAY.as_secs() / 60));
                }
                looks.waits = Some(why);
                seen(looks);
                tokio::time::sleep(pause).await;
                paused += now.elapsed();
                continue;
            }
        }
        seen(looks);
    }
    let time = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
    Ok(reading.file(&spec.name, &identification(drive), &time, names))
}

/// Reports changes since the last reading, except the gateway's own writes.
fn compare(vault: &Vault, drive: &DriveHandle, last: &ParameterFile, file: &ParameterFile, begun: Instant) {
    let spec = &drive.image.spec;
    if last.family != file.family {
        return;
    }
    let changes: Vec<Difference> = differences(last, file)
        .into_iter()
        .filter(|change| change.before.is_some() && change.after.is_some())
        .filter(|change| {
            let address = spec.profile.parameters.address(change.id.name());
            match address.and_then(|address| drive.image.written(address)) {
                // Whether the value was read before or after that write is unknown; the next reading shows it.
                Some((_, at)) if at >= begun => false,
                Some((own, _)) => change.after != Some(RawValue::Word(own)),
                None => true,
            }
        })
        .collect();
    if changes.is_empty() {
        return;
    }
    vault.count_changed(&spec.bus, &spec.name, changes.len() as u64);
    let text = event_text(&spec.name, &last.time, &changes);
    drive.publish(Event {
        bus: spec.bus.clone(),
        drive: Some(spec.name.clone()),
        ..Event::new(EventKind::ParametersChanged, SystemTime::now(), text)
    });
}

/// The text of an event.
fn event_text(drive: &str, since: &str, changes: &[Difference]) -> String {
    let named: Vec<String> = changes.iter().take(NAMED_CHANGES).map(Difference::line).collect();
    let more = match changes.len().saturating_sub(NAMED_CHANGES) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    format!(
        "parameters of {drive} changed since {since}: {}{more}",
        named.join(", ")
    )
}

/// Time that is left, estimated from the time for the work so far.
fn remaining((done, all): (usize, usize), worked: Duration) -> Option<Duration> {
    let left = u32::try_from(all.checked_sub(done)?).ok()?;
    let done = u32::try_from(done).ok().filter(|done| *done > 0)?;
    Some(worked.checked_div(done)?.saturating_mul(left))
}

/// The drive's identification, from the points that its profile defines for this.
fn identification(drive: &DriveHandle) -> String {
    let reading = drive.reading(Instant::now());
    let profile = &drive.image.spec.profile;
    let points = profile.parameters.identification.iter();
    let parts: Vec<String> = points
        .filter_map(|index| {
            let name = &profile.points.get(*index)?.name;
            Some(match reading.sample(*index).good() {
                Some(value) => format!("{name} {value}"),
                None => format!("{name} {NOT_KNOWN}"),
            })
        })
        .collect();
    if parts.is_empty() {
        NO_IDENTIFICATION.to_string()
    } else {
        parts.join(", ")
    }
}

async fn latest(store: Option<Store>, drive: String) -> Option<ParameterFile> {
    let store = store?;
    let read = tokio::task::spawn_blocking(move || store.latest(&drive)).await.ok()?;
    read.unwrap_or_else(|why| {
        tracing::warn!(target: "drivegate::north::parameter_jobs", "the last reading of parameters is skipped: {why}");
        None
    })
}

async fn keep(store: Store, file: ParameterFile) {
    let dir = store.dir().display().to_string();
    let kept = tokio::task::spawn_blocking(move || store.keep(&file)).await;
    if let Ok(Err(error)) = kept {
        tracing::warn!(target: "drivegate::north::parameter_jobs", "a reading of parameters cannot be saved in {dir}: \
                                                                    {error}; free space or correct its permissions");
    }
}

/// A reading that failed is tried again after that time.
const AGAIN: Duration = Duration::from_secs(600);
/// Time between two looks at which drives are due.
const LOOK: Duration = Duration::from_secs(10);

/// Reads the parameters of all drives at regular intervals and never ends; on each bus, one drive at a time.
pub async fn keep_reading(plant: SharedPlant, vault: Arc<Vault>, every: Duration) {
    let mut begun: BTreeMap<Machine, SystemTime> = BTreeMap::new();
    loop {
        let plant_now = plant.load_full();
        for bus in &plant_now.buses {
            let of_bus: Vec<DriveHandle> = plant_now
                .drives()
                .filter(|drive| drive.image.spec.bus == bus.image.spec.name)
                .filter(|drive| !drive.image.spec.profile.parameters.is_empty())
                .filter(|drive| drive.image.spec.access != Access::Listen)
                .collect();
            if of_bus.iter().any(|drive| vault.is_reading(&drive.machine())) {
                continue;
            }
            for drive in of_bus {
                let (machine, name) = (drive.machine(), drive.image.spec.name.clone());
                let online = drive.image.snapshot().link.is_online();
                if !begun.contains_key(&machine) {
                    let last = latest(vault.store(), name).await;
                    begun.extend(read_at(last.as_ref()).map(|at| (machine.clone(), at)));
                }
                let failed = matches!(vault.status(&machine).and_then(|status| status.result), Some(Err(_)));
                let pause = if failed { every.min(AGAIN) } else { every };
                // If the clock was set back, the next reading is postponed by the same time.
                let is_due = |at: &SystemTime| at.elapsed().is_ok_and(|age| age >= pause);
                let is_due = begun.get(&machine).is_none_or(is_due);
                if is_due && online {
                    let origin = Origin::new(SourceKind::Schedule, "every");
                    begun.insert(machine, SystemTime::now());
                    // Only a drive with parameters is read, on a line that the gateway owns.
                    let how = How {
                        afresh: false,
                        pace: Pace::Slow,
                    };
                    let _ = begin_reading(&vault, drive, origin, how);
                    break;
                }
            }
        }
        tokio::time::sleep(LOOK.min(every)).await;
    }
}

/// When a reading was made.
fn read_at(file: Option<&ParameterFile>) -> Option<SystemTime> {
    humantime::parse_rfc3339(&file?.time).ok()
}
