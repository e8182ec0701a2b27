//! Restores of parameters: preparing, executing, and resuming or setting aside interrupted ones.
//!
//! Carries out the steps of the state machine in `parameters::restoration`: files on blocking threads, commands
//! through the queue of the bus, one after the other. While parameters are written, or the journal of an unfinished
//! restore is on disk, the drive accepts no commands except stops.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::unfinished::{concerning, held_unfinished, not_understood, unfinished_event};
use super::{ReadProgress, identification, read};
use drivegate_core::order::{Authority, Order, Origin, Pace, ParameterOrder, written};
use drivegate_core::parameters::{
    End, Journal, JournalFile, NO_IDENTIFICATION, NOT_KNOWN, Owner, ParameterFile, Phase, Plan, Prepared, Reading,
    Restoration, RestoreNeed, RestoreStage, Then, Vault, Wishes, plan,
};
use drivegate_core::permit::{limits_passed, may_restore};
use drivegate_core::plant::{DriveHandle, OrderRequest, Plant, SharedPlant};
use drivegate_core::process_image::Machine;
use drivegate_model::drive::Profile;
use drivegate_model::drive::plan::WireTime;
use drivegate_proto::RequestPdu;

/// Longest time for which a command of a restore waits for its turn; then it is given again.
const EXPIRY: Duration = Duration::from_secs(30);
/// The writes of a restore take at most one part in this number of a line's time.
const SHARE: u32 = 5;

/// The action on an interrupted restore.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Again {
    /// Resumes the interrupted restore.
    Resume,
    /// Writes the former values back.
    Undo,
}

/// Starts preparing a restore of `wanted` and returns its number.
///
/// # Errors
/// If nothing can be restored to the drive now; contains the reason.
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
    let number = vault.begin_restore(&drive.machine(), &spec.name, RestoreStage::Reading)?;
    tokio::spawn(find_out(vault.clone(), drive, wanted, wishes, origin));
    Ok(number)
}

fn not_held(drive: &DriveHandle) -> Result<(), String> {
    match drive.image.restore_lock.reason() {
        Some(why) => Err(why.to_string()),
        None => Ok(()),
    }
}

async fn find_out(vault: Arc<Vault>, drive: DriveHandle, wanted: ParameterFile, wishes: Wishes, origin: Origin) {
    let spec = &drive.image.spec;
    let (name, machine) = (&spec.name, &drive.machine());
    let names = vault.names(&spec.profile.name);
    // Parameters missing in the file are not written, so they need not be read, unless the drive has another application.
    let known = if wanted.family == spec.profile.name {
        Reading::addresses_of(&spec.profile, &wanted)
    } else {
        Default::default()
    };
    let seen = |looks: ReadProgress| {
        vault.update_restore(machine, |restore| {
            (restore.progress, restore.waits) = (looks.progress, looks.waits);
        });
    };
    let stage = match read(&drive, origin, known, Pace::Brisk, &names, seen).await {
        Err(why) => RestoreStage::Failed(format!(
            "the parameters of `{name}` cannot be read: {why}; nothing was written"
        )),
        Ok(present) => match plan(&spec.profile, &wanted.named(&spec.profile, &names), &present, &wishes) {
            Err(reasons) => RestoreStage::Refused(reasons),
            Ok((plan, risks)) => {
                let passed = passes(&drive, &plan);
                if !passed.is_empty() && !wishes.force {
                    let refused =
                        |what| format!("{what}; restore the others with --only, or take the risk with --force");
                    let stage = RestoreStage::Refused(passed.into_iter().map(refused).collect());
                    vault.update_restore(machine, |restore| (restore.stage, restore.waits) = (stage, None));
                    return;
                }
                let risks = risks.into_iter().map(|risk| risk.0).chain(passed).collect();
                let prepared = Arc::new(Prepared { plan, risks });
                vault.update_restore(machine, |restore| restore.prepared = prepared);
                RestoreStage::Prepared
            }
        },
    };
    vault.update_restore(machine, |restore| (restore.stage, restore.waits) = (stage, None));
}

/// The limits of the drive that carrying out a plan would exceed, as text.
fn passes(drive: &DriveHandle, plan: &Plan) -> Vec<String> {
    let writes = plan.writes.iter().map(|write| (write.address, write.to));
    limits_passed(&drive.reading(Instant::now()), writes)
}

/// Starts writing the prepared restore of that number.
///
/// # Errors
/// If the restore is not carried out; contains the reason, and nothing was written.
pub fn carry_out(
    plant: &SharedPlant,
    vault: &Arc<Vault>,
    drive: &DriveHandle,
    number: u64,
    origin: Origin,
) -> Result<(), String> {
    let spec = &drive.image.spec;
    may_restore(spec)?;
    not_held(drive)?;
    drive
        .may_begin_restore(&origin, Instant::now())
        .map_err(|refusal| refusal.to_string())?;
    let machine = drive.machine();
    let prepared = vault.carry_out(&machine, &spec.name, number)?;
    // The drive's reference may have changed since the restore was prepared.
    if let Some(new) = passes(drive, &prepared.plan)
        .into_iter()
        .find(|passed| !prepared.risks.contains(passed))
    {
        let why = format!("{new}; this was not so when the restore was prepared: prepare it again");
        vault.update_restore(&machine, |restore| restore.stage = RestoreStage::Failed(why));
        return Ok(());
    }
    let journal = Journal {
        of: Owner {
            drive: spec.name.clone(),
            bus: spec.bus.clone(),
            family: spec.profile.name.clone(),
            machine: Some(machine.clone()),
            identification: identification(drive),
        },
        begun: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        by: format!("{} {}", origin.kind.name(), origin.who),
        phase: Phase::Writing,
        done: 0,
        saved: false,
        plan: prepared.plan.clone(),
    };
    if let Some(why) = unmet_need(drive, &journal) {
        vault.update_restore(&machine, |restore| restore.stage = RestoreStage::Failed(why));
        return Ok(());
    }
    if prepared.plan.writes.is_empty() {
        let text = format!("`{}` has all of these values; nothing was written", spec.name);
        vault.update_restore(&machine, |restore| restore.stage = RestoreStage::Ended(text));
        return Ok(());
    }
    let file = vault.journal(&spec.name).ok_or_else(no_store)?;
    let restoration = Restoration::begin(journal, Instant::now());
    start(plant.clone(), vault.clone(), drive, file, restoration, origin);
    Ok(())
}

/// The condition that the drive requires before it accepts a parameter, if the drive shows that the condition is not met.
fn unmet_need(drive: &DriveHandle, journal: &Journal) -> Option<String> {
    let need = journal.plan.handling.needs.as_ref()?;
    let shows = drive.reading(Instant::now()).sample(need.point).good()?.as_bool();
    (shows != need.value).then(|| format!("{}; nothing was written", need.remedy))
}

/// Continues a restore that was interrupted.
///
/// # Errors
/// If the restore cannot be continued; contains the reason.
pub async fn take_up(
    plant: &SharedPlant,
    vault: &Arc<Vault>,
    drive: &DriveHandle,
    again: Again,
    origin: Origin,
) -> Result<(), String> {
    let spec = &drive.image.spec;
    may_restore(spec)?;
    let nothing = || {
        format!(
            "no restore of `{}` was interrupted: there is nothing to resume",
            spec.name
        )
    };
    let concerned = concerning(vault, plant, drive).await?.ok_or_else(nothing)?;
    let (file, text) = concerned.own(drive)?;
    let mut journal = Journal::parse(&text, &spec.profile).map_err(|why| not_understood(&file, &spec.name, &why))?;
    if journal.of.machine.is_none() {
        // A journal of an earlier version gets the identity of its machine from now on.
        journal.of = Owner {
            drive: journal.of.drive,
            bus: spec.bus.clone(),
            machine: Some(drive.machine()),
            ..journal.of
        };
    }
    if let Identified::Other(why) = identified(drive, &journal.of) {
        return Err(why);
    }
    vault.begin_restore(&drive.machine(), &spec.name, RestoreStage::Working)?;
    let now = Instant::now();
    let restoration = match again {
        Again::Resume => Restoration::resume(journal, now),
        Again::Undo => Restoration::undo(journal, now),
    };
    start(plant.clone(), vault.clone(), drive, file, restoration, origin);
    Ok(())
}

/// Sets the journal of an interrupted restore aside: the drive keeps its present values and accepts all commands. A
/// restore in progress ends before its next parameter and must be released then.
///
/// # Errors
/// If the drive is not released; contains the reason.
pub async fn release(
    plant: &SharedPlant,
    vault: &Arc<Vault>,
    drive: &DriveHandle,
    origin: &Origin,
) -> Result<(), String> {
    let spec = &drive.image.spec;
    let machine = drive.machine();
    if vault.restore(&machine).is_some_and(|restore| restore.is_in_progress()) {
        vault.update_restore(&machine, |restore| restore.is_unwanted = true);
        return Ok(());
    }
    let concerned = concerning(vault, plant, drive).await?;
    vault.begin_restore(&machine, &spec.name, RestoreStage::Working)?;
    let released = match concerned {
        Some(concerned) => blocking(move || concerned.file.release()).await.map(Some),
        None => Ok(None),
    };
    let stage = match released {
        Err(why) => RestoreStage::Failed(why),
        Ok(None) if drive.image.restore_lock.reason().is_none() => RestoreStage::Failed(format!(
            "no restore of `{}` was interrupted: nothing is held",
            spec.name
        )),
        Ok(None) => {
            vault.looked_for(&machine);
            drive.image.restore_lock.set(None);
            RestoreStage::Ended(format!(
                "`{}` accepts commands again; no journal that can be read belongs to it",
                spec.name
            ))
        }
        Ok(Some(aside)) => {
            vault.looked_for(&machine);
            drive.image.restore_lock.set(None);
            tracing::warn!(
                target: "drivegate::north::parameter_jobs", bus = %spec.bus, drive = %spec.name, source = origin.kind.name(), client = %origin.who,
                "the restore of its parameters was released half done; the journal is {}", aside.display()
            );
            RestoreStage::Ended(format!(
                "`{}` accepts all commands again; its parameters are as the restore left them, and the former values \
                 are in {}",
                spec.name,
                aside.display()
            ))
        }
    };
    vault.update_restore(&machine, |restore| restore.stage = stage);
    Ok(())
}

fn no_store() -> String {
    "the gateway stores no readings, so there is no place for a journal".to_string()
}

/// Runs work with the disk in a thread that may block.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> std::io::Result<T> + Send + 'static,
) -> Result<T, String> {
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done.map_err(|error| error.to_string()),
        Err(_) => Err("the gateway is shutting down".to_string()),
    }
}

/// Whether a machine is the one to which a restore belongs, according to their identifications.
enum Identified {
    Same,
    /// The identification has not been read since the drive came back online.
    NotYet(String),
    Other(String),
}

fn identified(drive: &DriveHandle, of: &Owner) -> Identified {
    let (then, now) = (&of.identification, identification(drive));
    let name = &drive.image.spec.name;
    if *then == now || then == NO_IDENTIFICATION || then.contains(NOT_KNOWN) {
        Identified::Same
    } else if now.contains(NOT_KNOWN) {
        Identified::NotYet(format!("`{name}` has not reported its identification yet"))
    } else {
        Identified::Other(format!(
            "`{name}` is not the drive of the restore: it identifies itself as `{now}`, but the journal belongs to \
             `{then}`; put that drive back, or set the journal aside with `drivegate params restore --release {name}`"
        ))
    }
}

/// Text of the reason why the drive accepts no commands while parameters are written.
fn held_while_written(name: &str) -> String {
    format!("the parameters of `{name}` are being restored: until then the drive accepts only stops")
}

fn start(
    plant: SharedPlant,
    vault: Arc<Vault>,
    drive: &DriveHandle,
    file: JournalFile,
    restoration: Restoration,
    origin: Origin,
) {
    let (spec, machine) = (&drive.image.spec, drive.machine());
    vault.restore_lock(&machine).set(Some(held_while_written(&spec.name)));
    let run = Run {
        name: spec.name.clone(),
        machine,
        file,
        profile: spec.profile.clone(),
        plant,
        vault,
        restoration,
        // The rights of the origin are judged at the beginning, so that no reload leaves the restore half done.
        origin: origin.lasting(),
    };
    tokio::spawn(run.carry_on());
}

/// A restore that is being carried out.
struct Run {
    /// The present name of the machine.
    name: String,
    machine: Machine,
    file: JournalFile,
    profile: Arc<Profile>,
    plant: SharedPlant,
    vault: Arc<Vault>,
    restoration: Restoration,
    origin: Origin,
}

impl Run {
    async fn carry_on(mut self) {
        tracing::warn!(
            target: "drivegate::north::parameter_jobs", drive = %self.name, source = self.origin.kind.name(), client = %self.origin.who,
            "its parameters are being restored: {}", self.restoration.journal().phase.name()
        );
        loop {
            if self
                .vault
                .restore(&self.machine)
                .is_some_and(|restore| restore.is_unwanted)
                && self.restoration.end().is_none()
            {
                self.restoration.give_up("it is to be released".to_string());
            }
            match self.restoration.wanted() {
                RestoreNeed::Record => {
                    let journal = self.restoration.journal();
                    let (text, of) = (journal.text(&self.profile), journal.of.clone());
                    let done = self.with_journal(move |file| file.write(&of, &text)).await;
                    self.restoration.recorded(done, Instant::now());
                }
                RestoreNeed::Set(order) => self.set(order).await,
                RestoreNeed::Remove => {
                    let of = self.restoration.journal().of.clone();
                    let done = self.with_journal(move |file| file.remove(&of)).await;
                    self.restoration.removed(done);
                }
                RestoreNeed::Nothing => break,
            }
        }
        self.over();
    }

    async fn with_journal(
        &self,
        work: impl FnOnce(JournalFile) -> std::io::Result<()> + Send + 'static,
    ) -> Result<(), String> {
        let file = self.file.clone();
        let path = file.path();
        let done = blocking(move || work(file)).await;
        done.map_err(|why| format!("{}: {why}; free space or correct its permissions", path.display()))
    }

    /// The machine as it is configured now, under any name.
    ///
    /// # Errors
    /// If the plant has no drive with this name, or the name now belongs to another machine.
    fn bound(&mut self, plant: &Plant) -> Result<DriveHandle, String> {
        let of = self.restoration.journal().of.place();
        let drive = plant.drive_at(&self.machine).ok_or_else(|| {
            format!("the new configuration has no drive there: the restore and its journal belong to {of}")
        })?;
        let name = &drive.image.spec.name;
        if *name != self.name {
            if plant.drive(&self.name).is_some() {
                return Err(format!(
                    "in the new configuration `{}` is another drive: the restore and its journal belong to {of}, \
                     which is now `{name}`",
                    self.name
                ));
            }
            self.name.clone_from(name);
        }
        Ok(drive)
    }

    /// Gives an order to the drive with its present configuration.
    async fn set(&mut self, order: ParameterOrder) {
        let plant = self.plant.load_full();
        let drive = match self.bound(&plant) {
            Ok(drive) => drive,
            Err(why) => return self.restoration.give_up(why),
        };
        match identified(&drive, &self.restoration.journal().of) {
            Identified::Same => {}
            Identified::Other(why) => return self.restoration.give_up(why),
            Identified::NotYet(why) => {
                let then = self.restoration.put_off(&why, Instant::now());
                return self.rest(then, Duration::ZERO).await;
            }
        }
        let (now, write) = (Instant::now(), order.write());
        let pause = pause_after(&drive, &order);
        let request = OrderRequest::new(Order::Parameter(order), self.origin.clone(), Authority::Write);
        let mut placed = drive.place(request.within(EXPIRY), now);
        let outcome = placed.answered().await.outcome;
        if outcome.is_ok() {
            note_written(&drive, &write, now);
        }
        let then = self.restoration.answered(&outcome, Instant::now());
        self.rest(then, pause).await;
    }

    /// Waits before the next step.
    async fn rest(&self, then: Then, pause: Duration) {
        let (waits, pause) = match then {
            Then::Go => (None, pause),
            Then::Pause(pause, why) => (Some(why), pause),
        };
        let progress = self.restoration.progress();
        self.vault.update_restore(&self.machine, |restore| {
            (restore.progress, restore.waits) = (progress, waits);
        });
        tokio::time::sleep(pause).await;
    }

    /// The restore has ended: the drive accepts commands again, or is held because it is half restored.
    fn over(self) {
        let (done, all) = self.restoration.progress();
        // A reload may have given the drive another name, under which the restore is resumed.
        let drive = self.plant.load().drive_at(&self.machine);
        let name = drive.as_ref().map_or(&self.name, |drive| &drive.image.spec.name);
        let saved = match self.restoration.journal().plan.handling.save {
            Some(_) => ", and has saved them",
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
                    _ => "it was interrupted",
                };
                let text = held_unfinished(name, &format!("{why}; {done} of {all} done"));
                (RestoreStage::Failed(text.clone()), Some(text))
            }
        };
        match &stage {
            RestoreStage::Failed(why) => {
                tracing::error!(target: "drivegate::north::parameter_jobs", drive = %name, "its parameters were not restored: {why}")
            }
            RestoreStage::Ended(text) => {
                tracing::warn!(target: "drivegate::north::parameter_jobs", drive = %name, "the restore of its \
                                                                                           parameters has ended: \
                                                                                           {text}")
            }
            _ => {}
        }
        if let Some(why) = &held {
            // If the drive is no longer configured, an event has reported its remaining journal.
            if let Some(drive) = &drive {
                let spec = &drive.image.spec;
                drive.publish(unfinished_event(&spec.bus, Some(&spec.name), why.clone()));
            }
        }
        self.vault.restore_lock(&self.machine).set(held);
        self.vault.update_restore(&self.machine, |restore| {
            (restore.stage, restore.waits) = (stage, None);
        });
    }
}

/// Records a write of the gateway: a later reading with this value is not a change at the drive.
fn note_written(drive: &DriveHandle, write: &RequestPdu, now: Instant) {
    if let Some((_, items)) = written(write) {
        drive.image.note_written(&items, now);
    }
}

/// The pause that leaves the line to the others: a command takes four transactions.
fn pause_after(drive: &DriveHandle, order: &ParameterOrder) -> Duration {
    let line = &drive.bus.image.spec;
    let silence = line.protocol.silence(Default::default(), &line.format);
    let time =
        |pdu: &RequestPdu| WireTime::of(line.protocol, &line.format, pdu).total(drive.image.spec.turnaround, silence);
    (SHARE - 1) * (3 * time(&order.read()) + time(&order.write()))
}
