//! Restores of parameters: prepared, carried out, and where they were cut off taken up again or set aside.
//!
//! What the machine in `parameters::restoration` wants is done here: files by threads that may block, orders by the queue of the
//! bus, one behind the other. While parameters are written the drive takes no orders but stops, and it takes none either while
//! the journal of a restore that did not end is on disk.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::{Looks, read};
use crate::codec::RequestPdu;
use crate::command::{Authority, Order, Origin, Pace, ParameterOrder, may_restore, written};
use crate::drive::Profile;
use crate::drive::plan::WireTime;
use crate::parameters::{
    End, Journal, JournalFile, ParameterFile, Phase, Prepared, Reading, Restoration, RestoreStage, Then, Vault, Wanted,
    Wishes, plan,
};
use crate::plant::{DriveHandle, SharedPlant};
use crate::process_image::{Access, DriveSpec};

/// An order of a restore waits no longer than that for its turn; then it is given anew.
const EXPIRY: Duration = Duration::from_secs(30);
/// Share of the time of a line that the writes of a restore take at most: one part in so many.
const SHARE: u32 = 5;
/// Time for the journals to be read at the start; on a slow disk the drives are held until they are.
const LOOK: Duration = Duration::from_secs(5);

/// What is done with a restore that was cut off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Again {
    /// It goes on.
    Resume,
    /// The former values are written.
    Undo,
}

/// Begins to find out what a restore of `wanted` would write; its number.
///
/// # Errors
/// Why nothing can be restored to the drive now.
pub fn prepare(
    vault: &Arc<Vault>,
    drive: DriveHandle,
    wanted: ParameterFile,
    wishes: Wishes,
    origin: Origin,
) -> Result<u64, String> {
    let spec = &drive.image.spec;
    may_restore(spec)?;
    not_held(&drive)?;
    if spec.profile.parameters.is_empty() {
        return Err(format!(
            "profile `{}` has no parameters that can be read",
            spec.profile.name
        ));
    }
    let number = vault.begin_restore(&spec.name, RestoreStage::Reading)?;
    tokio::spawn(find_out(vault.clone(), drive, wanted, wishes, origin));
    Ok(number)
}

fn not_held(drive: &DriveHandle) -> Result<(), String> {
    match drive.image.hold.why() {
        Some(why) => Err(why.to_string()),
        None => Ok(()),
    }
}

async fn find_out(vault: Arc<Vault>, drive: DriveHandle, wanted: ParameterFile, wishes: Wishes, origin: Origin) {
    let spec = &drive.image.spec;
    let name = &spec.name;
    let names = vault.names(&spec.profile.name);
    // What the file does not have is not written, so it need not be read, unless the drive has another application.
    let known = match wanted.family == spec.profile.name {
        true => Reading::addresses_of(&spec.profile, &wanted),
        false => Default::default(),
    };
    let seen = |looks: Looks| {
        vault.update_restore(name, |restore| {
            (restore.progress, restore.waits) = (looks.progress, looks.waits);
        });
    };
    let stage = match read(&drive, origin, known, (Pace::Brisk, &names), seen).await {
        Err(why) => RestoreStage::Failed(format!(
            "the parameters of `{name}` cannot be read: {why}; nothing was written"
        )),
        Ok(present) => match plan(&spec.profile, &wanted.named(&spec.profile, &names), &present, &wishes) {
            Err(reasons) => RestoreStage::Refused(reasons),
            Ok((plan, risks)) => {
                let risks = risks.into_iter().map(|risk| risk.0).collect();
                let prepared = Arc::new(Prepared { plan, risks });
                vault.update_restore(name, |restore| restore.prepared = prepared);
                RestoreStage::Prepared
            }
        },
    };
    vault.update_restore(name, |restore| (restore.stage, restore.waits) = (stage, None));
}

/// Begins to write what the restore of that number found out.
///
/// # Errors
/// Why not; nothing was written.
pub fn carry_out(plant: &SharedPlant, drive: &DriveHandle, number: u64, origin: Origin) -> Result<(), String> {
    let spec = &drive.image.spec;
    may_restore(spec)?;
    not_held(drive)?;
    let vault = plant.load().parameters.clone();
    let prepared = vault.carry_out(&spec.name, number)?;
    let journal = Journal {
        drive: spec.name.clone(),
        family: spec.profile.name.clone(),
        begun: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        by: format!("{} {}", origin.kind.name(), origin.who),
        phase: Phase::Writing,
        done: 0,
        saved: false,
        plan: prepared.plan.clone(),
    };
    if let Some(why) = unmet_need(drive, &journal) {
        vault.update_restore(&spec.name, |restore| restore.stage = RestoreStage::Failed(why));
        return Ok(());
    }
    if prepared.plan.writes.is_empty() {
        let text = format!("`{}` has all of these values; nothing was written", spec.name);
        vault.update_restore(&spec.name, |restore| restore.stage = RestoreStage::Ended(text));
        return Ok(());
    }
    let restoration = Restoration::begin(journal, Instant::now());
    start(plant.clone(), vault, drive, restoration, origin);
    Ok(())
}

/// What the drive wants before it takes a parameter, if it shows that it lacks it.
fn unmet_need(drive: &DriveHandle, journal: &Journal) -> Option<String> {
    let need = journal.plan.handling.needs.as_ref()?;
    let shows = drive.reading(Instant::now()).sample(need.point).good()?.as_bool();
    (shows != need.value).then(|| format!("{}; nothing was written", need.remedy))
}

/// Takes up a restore that was cut off.
///
/// # Errors
/// Why it cannot be.
pub async fn take_up(plant: &SharedPlant, drive: &DriveHandle, again: Again, origin: Origin) -> Result<(), String> {
    let spec = &drive.image.spec;
    may_restore(spec)?;
    let vault = plant.load().parameters.clone();
    let file = journal_of(&vault, spec)?;
    let text = blocking(move || file.read()).await?;
    let text = text.ok_or_else(|| format!("no restore of `{}` was cut off: there is nothing to take up", spec.name))?;
    let journal = Journal::parse(&text, &spec.profile).map_err(|why| not_understood(&vault, spec, &why))?;
    vault.begin_restore(&spec.name, RestoreStage::Working)?;
    let now = Instant::now();
    let restoration = match again {
        Again::Resume => Restoration::resume(journal, now),
        Again::Undo => Restoration::undo(journal, now),
    };
    start(plant.clone(), vault, drive, restoration, origin);
    Ok(())
}

/// Sets the journal of a restore that was cut off aside: the drive stays as it is, and takes all orders. One that goes on
/// ends before its next parameter, and is to be released then.
///
/// # Errors
/// Why not.
pub async fn release(plant: &SharedPlant, drive: &DriveHandle, origin: &Origin) -> Result<(), String> {
    let spec = &drive.image.spec;
    let vault = plant.load().parameters.clone();
    if vault.restore(&spec.name).is_some_and(|restore| restore.goes_on()) {
        vault.update_restore(&spec.name, |restore| restore.is_unwanted = true);
        return Ok(());
    }
    let file = journal_of(&vault, spec)?;
    vault.begin_restore(&spec.name, RestoreStage::Working)?;
    let released = blocking(move || match file.read()? {
        Some(_) => file.release().map(Some),
        None => Ok(None),
    });
    let stage = match released.await {
        Err(why) => RestoreStage::Failed(why),
        Ok(None) if drive.image.hold.why().is_none() => {
            RestoreStage::Failed(format!("no restore of `{}` was cut off: nothing is held", spec.name))
        }
        Ok(None) => {
            drive.image.hold.set(None);
            RestoreStage::Ended(format!(
                "`{}` takes all orders again; there is no journal any more",
                spec.name
            ))
        }
        Ok(Some(aside)) => {
            drive.image.hold.set(None);
            tracing::warn!(
                bus = %spec.bus, drive = %spec.name, source = origin.kind.name(), client = %origin.who,
                "the restore of its parameters was released half done; the journal is {}", aside.display()
            );
            RestoreStage::Ended(format!(
                "`{}` takes all orders again; its parameters are as the restore left them, and the former values are in {}",
                spec.name,
                aside.display()
            ))
        }
    };
    vault.update_restore(&spec.name, |restore| restore.stage = stage);
    Ok(())
}

fn journal_of(vault: &Vault, spec: &DriveSpec) -> Result<JournalFile, String> {
    let file = vault.journal(&spec.name);
    file.ok_or_else(|| "the gateway keeps no readings, so there is no place for a journal".to_string())
}

/// Something with the disk, by a thread that may wait for it.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> std::io::Result<T> + Send + 'static) -> Result<T, String> {
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done.map_err(|error| error.to_string()),
        Err(_) => Err("the gateway stops".to_string()),
    }
}

/// Why the drive takes no orders while parameters are written.
fn held_while_written(name: &str) -> String {
    format!("the parameters of `{name}` are being restored: until that is over the drive takes no orders but stops")
}

/// Why it takes none when that did not come to its end.
fn held_unfinished(name: &str, why: &str) -> String {
    format!(
        "the parameters of `{name}` may be half restored ({why}): the drive takes no orders but stops until \
         `drivegate params restore --resume {name}` has written the rest, --undo {name} the former values, or --release {name} \
         leaves them as they are"
    )
}

fn not_understood(vault: &Vault, spec: &DriveSpec, why: &str) -> String {
    let path = vault.journal(&spec.name).map(|file| file.path().display().to_string());
    format!(
        "the journal of a restore, {}, is not understood: {why}; look at it, then set it aside by `drivegate params restore \
         --release {}`",
        path.unwrap_or_default(),
        spec.name
    )
}

fn start(plant: SharedPlant, vault: Arc<Vault>, drive: &DriveHandle, restoration: Restoration, origin: Origin) {
    let spec = &drive.image.spec;
    vault.hold(&spec.name).set(Some(held_while_written(&spec.name)));
    let run = Run {
        name: spec.name.clone(),
        profile: spec.profile.clone(),
        plant,
        vault,
        restoration,
        origin,
    };
    tokio::spawn(run.carry_on());
}

/// A restore that is carried out.
struct Run {
    name: String,
    profile: Arc<Profile>,
    plant: SharedPlant,
    vault: Arc<Vault>,
    restoration: Restoration,
    origin: Origin,
}

impl Run {
    async fn carry_on(mut self) {
        tracing::warn!(
            drive = %self.name, source = self.origin.kind.name(), client = %self.origin.who,
            "its parameters are being restored: {}", self.restoration.journal().phase.name()
        );
        loop {
            if self
                .vault
                .restore(&self.name)
                .is_some_and(|restore| restore.is_unwanted)
                && self.restoration.end().is_none()
            {
                self.restoration.give_up("it was to be released".to_string());
            }
            match self.restoration.wanted() {
                Wanted::Record => {
                    let text = self.restoration.journal().text(&self.profile);
                    let done = self.with_journal(move |file| file.write(&text)).await;
                    self.restoration.recorded(done, Instant::now());
                }
                Wanted::Set(order) => self.set(order).await,
                Wanted::Remove => {
                    let done = self.with_journal(|file| file.remove()).await;
                    self.restoration.removed(done);
                }
                Wanted::Nothing => break,
            }
        }
        self.over();
    }

    async fn with_journal(
        &self,
        work: impl FnOnce(JournalFile) -> std::io::Result<()> + Send + 'static,
    ) -> Result<(), String> {
        let file = self.vault.journal(&self.name).ok_or("there is no place for it")?;
        let path = file.path();
        let done = blocking(move || work(file)).await;
        done.map_err(|why| format!("{}: {why}; free space or mend its permissions", path.display()))
    }

    /// Gives an order to the drive as it is configured now.
    async fn set(&mut self, order: ParameterOrder) {
        let drive = self.plant.load().drive(&self.name);
        let Some(drive) = drive.filter(|drive| drive.image.spec.profile.name == self.profile.name) else {
            self.restoration
                .give_up("the drive is not configured any more as it was when the restore began".to_string());
            return;
        };
        let (now, write) = (Instant::now(), order.write());
        let pause = pause_after(&drive, &order);
        let mut placed = drive.place(
            Order::Parameter(order),
            self.origin.clone(),
            Authority::Write,
            EXPIRY,
            now,
        );
        let outcome = placed.answered().await.outcome;
        if outcome.is_ok() {
            note_written(&drive, &write, now);
        }
        let (waits, pause) = match self.restoration.answered(&outcome, Instant::now()) {
            Then::Go => (None, pause),
            Then::Pause(pause, why) => (Some(why), pause),
        };
        let progress = self.restoration.progress();
        self.vault.update_restore(&self.name, |restore| {
            (restore.progress, restore.waits) = (progress, waits);
        });
        tokio::time::sleep(pause).await;
    }

    /// It is over: the drive takes orders again, or is held for what was left half done.
    fn over(self) {
        let (done, all) = self.restoration.progress();
        let name = &self.name;
        let saved = match self.restoration.journal().plan.handling.save {
            Some(_) => ", and was told to keep them",
            None => "",
        };
        let (stage, held) = match self.restoration.end() {
            Some(End::Done) => (
                RestoreStage::Ended(format!("`{name}` has all {all} values{saved}")),
                None,
            ),
            Some(End::TakenBack) => {
                let text = format!("`{name}` has all {all} former values again");
                (RestoreStage::Ended(text), None)
            }
            Some(End::NothingWritten(why)) => {
                let text = format!("{why}; nothing was written to `{name}`");
                (RestoreStage::Failed(text), None)
            }
            unfinished => {
                let why = match unfinished {
                    Some(End::Unfinished(why)) => why.as_str(),
                    _ => "it did not come to its end",
                };
                let text = held_unfinished(name, &format!("{why}; {done} of {all} are done"));
                (RestoreStage::Failed(text.clone()), Some(text))
            }
        };
        match &stage {
            RestoreStage::Failed(why) => tracing::error!(drive = %name, "its parameters were not restored: {why}"),
            RestoreStage::Ended(text) => tracing::warn!(drive = %name, "the restore of its parameters is over: {text}"),
            _ => {}
        }
        self.vault.hold(name).set(held);
        self.vault.update_restore(name, |restore| {
            (restore.stage, restore.waits) = (stage, None);
        });
    }
}

/// The gateway wrote it: a later reading that shows it tells no change.
fn note_written(drive: &DriveHandle, write: &RequestPdu, now: Instant) {
    if let Some((_, items)) = written(write) {
        drive.image.note_written(&items, now);
    }
}

/// The pause that leaves the line to the others: an order takes four exchanges.
fn pause_after(drive: &DriveHandle, order: &ParameterOrder) -> Duration {
    let line = &drive.bus.image.spec;
    let silence = line.protocol.silence(Default::default(), &line.format);
    let time =
        |pdu: &RequestPdu| WireTime::of(line.protocol, &line.format, pdu).total(drive.image.spec.turnaround, silence);
    (SHARE - 1) * (3 * time(&order.read()) + time(&order.write()))
}

/// Holds the drives whose journal tells of a restore that did not come to its end, before anybody can command them. A drive is
/// looked at once; it is held until that is done, however slow the disk.
pub async fn hold_unfinished(vault: &Arc<Vault>, specs: impl Iterator<Item = &DriveSpec>) {
    let specs: Vec<DriveSpec> = specs.filter(|spec| spec.access != Access::Listen).cloned().collect();
    let names = vault.not_looked_for(specs.iter().map(|spec| spec.name.clone()));
    let specs: Vec<DriveSpec> = specs.into_iter().filter(|spec| names.contains(&spec.name)).collect();
    if specs.is_empty() {
        return;
    }
    for spec in &specs {
        vault.hold(&spec.name).set(Some(format!(
            "whether a restore of the parameters of `{}` was cut off is not known before its journal is read: until then the drive takes \
             no orders but stops",
            spec.name
        )));
    }
    let vault = vault.clone();
    let looked = tokio::task::spawn_blocking(move || {
        for spec in &specs {
            let why = unfinished(&vault, spec);
            if let Some(why) = &why {
                tracing::error!(bus = %spec.bus, drive = %spec.name, "{why}");
            }
            vault.hold(&spec.name).set(why);
        }
    });
    if tokio::time::timeout(LOOK, looked).await.is_err() {
        tracing::warn!(
            "the disk is slow: the drives take no orders but stops before the journals of restores are read"
        );
    }
}

/// Why a drive is held, by its journal.
fn unfinished(vault: &Vault, spec: &DriveSpec) -> Option<String> {
    let text = match vault.journal(&spec.name)?.read() {
        Ok(text) => text?,
        Err(error) => {
            return Some(held_unfinished(
                &spec.name,
                &not_understood(vault, spec, &error.to_string()),
            ));
        }
    };
    let why = match Journal::parse(&text, &spec.profile) {
        Ok(journal) => format!(
            "begun {} by {}, cut off {}, {} of {} parameters done",
            journal.begun,
            journal.by,
            journal.phase.name(),
            journal.done,
            journal.plan.writes.len()
        ),
        Err(why) => not_understood(vault, spec, &why),
    };
    Some(held_unfinished(&spec.name, &why))
}
