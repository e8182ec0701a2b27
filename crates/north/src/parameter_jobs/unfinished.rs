//! Unfinished restores, whose journals are on disk. The machine of such a journal accepts no commands except stops.
//! A journal whose machine is no longer configured is reported by an event, and by `drivegate check`.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use tokio::sync::oneshot;
use tokio::task::spawn_blocking;

use super::restore::blocking;
use crate::patience::{Patience, late};
use drivegate_core::event::{Event, EventKind, Events};
use drivegate_core::files::state::AGAIN;
use drivegate_core::parameters::{Claim, Journal, JournalFile, Owner, Vault, claims};
use drivegate_core::plant::{DriveHandle, SharedPlant};
use drivegate_core::process_image::{Access, BusSpec, DriveSpec, Machine};

/// A journal with its owner, if the owner can be read.
type Found = (JournalFile, Result<Owner, String>);

/// A journal that concerns a drive.
pub(super) struct Concerning {
    pub(super) file: JournalFile,
    owner: Result<Owner, String>,
    claim: Claim,
    text: std::io::Result<Option<String>>,
}

impl Concerning {
    /// The journal, if it belongs to this machine.
    ///
    /// # Errors
    /// If the journal belongs to another machine, or cannot be read.
    pub(super) fn own(self, drive: &DriveHandle) -> Result<(JournalFile, String), String> {
        let spec = &drive.image.spec;
        if let (Claim::Place | Claim::Name, Ok(owner)) = (self.claim, &self.owner) {
            return Err(belongs_elsewhere(&spec.name, &spec.profile.name, self.claim, owner));
        }
        match self.text {
            Ok(Some(text)) => Ok((self.file, text)),
            Ok(None) => Err(format!(
                "no restore of `{}` was interrupted: there is nothing to resume",
                spec.name
            )),
            Err(error) => Err(not_understood(&self.file, &spec.name, &error.to_string())),
        }
    }
}

/// The journal that concerns a drive, as the gateway is configured now.
///
/// # Errors
/// If the journals cannot be searched for.
pub(super) async fn concerning(
    vault: &Vault,
    plant: &SharedPlant,
    drive: &DriveHandle,
) -> Result<Option<Concerning>, String> {
    let store = vault.store();
    let store = store.ok_or("the gateway stores no readings, so there is no place for a journal")?;
    let plant = plant.load_full();
    let (machine, others) = (drive.machine(), vault.others());
    blocking(move || {
        let journals = found(store.dir())?;
        let drives: Vec<(Machine, String)> = plant
            .drives()
            .map(|drive| (drive.machine(), drive.image.spec.name.clone()))
            .chain(others)
            .collect();
        let named: Vec<(Machine, &str)> = drives
            .iter()
            .map(|(machine, name)| (machine.clone(), name.as_str()))
            .collect();
        let place = drives.iter().position(|(other, _)| *other == machine);
        let claimed = place.and_then(|place| claims(&journals, &named).drives.get(place).copied().flatten());
        let concerned = claimed.and_then(|(journal, claim)| {
            let (file, owner) = journals.get(journal)?.clone();
            let text = file.read();
            Some(Concerning {
                file,
                owner,
                claim,
                text,
            })
        });
        Ok(concerned)
    })
    .await
}

/// All journals below a directory of readings.
fn found(params: &Path) -> std::io::Result<Vec<Found>> {
    Ok(read(params)?.into_iter().map(|(found, _)| found).collect())
}

/// All journals below a directory of readings, each with the reason why the disk does not return it, if there is one.
fn read(params: &Path) -> std::io::Result<Vec<(Found, Option<String>)>> {
    let journal = |file: JournalFile| {
        let (owner, unread) = match file.read() {
            Ok(Some(text)) => (Owner::parse(&text), None),
            Ok(None) => return None,
            Err(error) => {
                let why = format!("{}: {error}", file.path().display());
                (Err(error.to_string()), Some(why))
            }
        };
        Some(((file, owner), unread))
    };
    Ok(JournalFile::all(params)?.into_iter().filter_map(journal).collect())
}

/// The journals below a directory of readings that belong to no configured drive, each with the problem and the remedy.
///
/// # Errors
/// If the directory cannot be read.
pub fn orphans<'a>(
    params: &Path,
    drives: impl Iterator<Item = (&'a BusSpec, &'a DriveSpec)>,
) -> std::io::Result<Vec<(PathBuf, String, &'static str)>> {
    let journals = found(params)?;
    let drives: Vec<(Machine, &str)> = drives
        .map(|(bus, drive)| (bus.machine(drive), drive.name.as_str()))
        .collect();
    let orphans = claims(&journals, &drives).orphans.into_iter();
    Ok(orphans
        .filter_map(|orphan| journals.get(orphan))
        .map(orphaned)
        .collect())
}

/// The message about a journal that belongs to no drive.
fn orphaned((file, owner): &Found) -> (PathBuf, String, &'static str) {
    match owner {
        Ok(owner) => (
            file.path(),
            format!(
                "a restore of parameters was interrupted: its journal belongs to {}, which is not configured; that \
                 drive may be half restored",
                owner.place()
            ),
            "configure that drive again and resume or undo the restore, or move the journal away",
        ),
        Err(why) => (
            file.path(),
            format!("the journal of a restore of parameters cannot be read: {why}"),
            "examine it, then move it away",
        ),
    }
}

/// Text of the reason why a drive is locked after an interrupted restore.
pub(super) fn held_unfinished(name: &str, why: &str) -> String {
    format!(
        "the parameters of `{name}` may be half restored ({why}): the drive accepts only stops until `drivegate \
         params restore --resume {name}` has written the rest, --undo {name} the former values, or --release {name} \
         leaves them as they are"
    )
}

/// Text of the reason why a drive is locked by a journal of a machine that is no longer configured, and why the
/// restore is not resumed.
fn belongs_elsewhere(name: &str, profile: &str, claim: Claim, owner: &Owner) -> String {
    let but = match claim {
        Claim::Own | Claim::Name => "where no drive is configured now".to_string(),
        Claim::Place => format!("and the drive there is now configured with profile `{profile}`"),
    };
    format!(
        "a restore of parameters was interrupted, and its journal belongs to {}, {but}: it is unknown whether \
         `{name}` is the drive that may be half restored; it accepts only stops until that drive is configured as \
         before, or `drivegate params restore --release {name}` sets the journal aside",
        owner.place()
    )
}

pub(super) fn not_understood(file: &JournalFile, name: &str, why: &str) -> String {
    format!(
        "the journal of a restore, {}, cannot be read: {why}; examine it, then set it aside with `drivegate params \
         restore --release {name}`",
        file.path().display()
    )
}

pub(super) fn unfinished_event(bus: &str, drive: Option<&str>, text: String) -> Event {
    Event {
        bus: bus.to_string(),
        drive: drive.map(str::to_string),
        ..Event::new(EventKind::RestoreUnfinished, SystemTime::now(), text)
    }
}

/// A drive as the configuration has it.
struct Configured {
    machine: Machine,
    spec: DriveSpec,
}

/// Locks the drives with a journal of an interrupted restore before any client can command them, and reports
/// journals that belong to no drive. Each machine is checked once, and stays locked until the check is done,
/// however slow the disk is: while it refuses, it is asked again.
pub async fn hold_unfinished<'a>(
    vault: &Arc<Vault>,
    events: &Events,
    patience: &Patience,
    drives: impl Iterator<Item = (&'a BusSpec, &'a DriveSpec)>,
) {
    let configured = |(bus, spec): (&BusSpec, &DriveSpec)| Configured {
        machine: bus.machine(spec),
        spec: spec.clone(),
    };
    let drives = drives.filter(|(_, spec)| spec.access != Access::Listen);
    let search = Search {
        number: vault.begin_search(),
        vault: vault.clone(),
        events: events.clone(),
        drives: drives.map(configured).collect(),
    };
    let Some(store) = vault.store() else { return };
    let mut locks_some = false;
    for drive in search.new_drives() {
        vault.restore_lock(&drive.machine).set(Some(not_read(&drive.spec.name)));
        locks_some = true;
    }
    let (done, looked) = oneshot::channel();
    // Closed when the gateway has ended.
    let (ended, gateway) = oneshot::channel::<()>();
    tokio::spawn(gateway);
    spawn_blocking(move || {
        let first = search.read_journals(store.dir());
        // The receiver does not wait for ever.
        let _ = done.send(());
        search.insist(store.dir(), first, || !ended.is_closed());
    });
    if patience.wait(looked).await.is_none() {
        let meanwhile = if locks_some {
            "; the drives that are new accept only stops until they are read"
        } else {
            ""
        };
        tracing::warn!(
            target: "drivegate::north::parameter_jobs", "cannot look for journals of restores: {}{meanwhile}; check \
                                                         the disk of state_dir", late()
        );
    }
}

/// A search for the journals of these drives.
struct Search {
    number: u64,
    vault: Arc<Vault>,
    events: Events,
    drives: Vec<Configured>,
}

impl Search {
    /// The drives that are locked because their journal was not read yet.
    fn new_drives(&self) -> impl Iterator<Item = &Configured> {
        self.drives.iter().filter(|drive| self.vault.is_new(&drive.machine))
    }

    /// Looks for journals again while the disk refuses, as long as `goes_on` and no later search has begun.
    fn insist(&self, params: &Path, mut found: Result<(), String>, goes_on: impl Fn() -> bool) {
        let mut failing = false;
        while let Err(why) = found {
            if !std::mem::replace(&mut failing, true) {
                tracing::error!(
                    target: "drivegate::north::parameter_jobs",
                    "cannot read the journals of restores: {why}; retrying; {REMEDY}"
                );
                for drive in self.new_drives() {
                    let text = format!("{} ({why}; {REMEDY})", not_read(&drive.spec.name));
                    hold(&self.vault, &self.events, drive, text);
                }
            }
            std::thread::sleep(AGAIN);
            if !goes_on() || !self.vault.is_last_search(self.number) {
                return;
            }
            found = self.read_journals(params);
        }
        if failing && self.vault.is_last_search(self.number) {
            tracing::warn!(target: "drivegate::north::parameter_jobs", "the journals of restores are read");
        }
    }

    /// Locks each new drive that a journal concerns, and frees the others.
    ///
    /// # Errors
    /// If the disk does not return all journals; contains the reasons. Every drive without a journal of its own stays new,
    /// because an unread one may belong to it, whatever name it had then.
    fn read_journals(&self, params: &Path) -> Result<(), String> {
        let Search { vault, events, .. } = self;
        let all = read(params).map_err(|error| format!("{}: {error}", params.display()))?;
        let (journals, unread): (Vec<Found>, Vec<Option<String>>) = all.into_iter().unzip();
        if !vault.is_last_search(self.number) {
            return Ok(());
        }
        let others = vault.others();
        let others = others.iter().map(|(machine, name)| (machine.clone(), name.as_str()));
        let named: Vec<(Machine, &str)> = self
            .drives
            .iter()
            .map(|drive| (drive.machine.clone(), drive.spec.name.as_str()))
            .chain(others)
            .collect();
        let claims = claims(&journals, &named);
        let is_known = |claim: Option<(usize, Claim)>| match claim {
            Some((journal, Claim::Own)) => unread.get(journal).is_some_and(Option::is_none),
            Some((_, Claim::Place | Claim::Name)) | None => unread.iter().all(Option::is_none),
        };
        let claimed = self.drives.iter().zip(claims.drives);
        for (drive, claim) in claimed.filter(|(drive, _)| vault.is_new(&drive.machine)) {
            if !is_known(claim) {
                continue;
            }
            vault.looked_for(&drive.machine);
            if vault
                .restore(&drive.machine)
                .is_some_and(|restore| restore.is_in_progress())
            {
                // A restore that was resumed meanwhile has locked the drive, and frees it.
                continue;
            }
            let claimed = claim.and_then(|(journal, claim)| Some((journals.get(journal)?, claim)));
            match claimed {
                Some((journal, claim)) => hold(vault, events, drive, why_held(&drive.spec, journal, claim)),
                None => vault.restore_lock(&drive.machine).set(None),
            }
        }
        self.report_orphans(claims.orphans.into_iter().filter_map(|orphan| journals.get(orphan)));
        let unread: Vec<String> = unread.into_iter().flatten().collect();
        if unread.is_empty() {
            Ok(())
        } else {
            Err(unread.join(", "))
        }
    }

    /// Reports the journals that belong to no drive, each once.
    fn report_orphans<'f>(&self, orphans: impl Iterator<Item = &'f Found>) {
        let orphans: Vec<_> = orphans.map(orphaned).collect();
        let news = self
            .vault
            .new_orphans(orphans.iter().map(|(path, ..)| path.clone()).collect());
        for (path, what, remedy) in orphans.into_iter().filter(|(path, ..)| news.contains(path)) {
            let text = format!("{what}; {}; {remedy}", path.display());
            tracing::error!(target: "drivegate::north::parameter_jobs", "{text}");
            self.events.publish(unfinished_event("", None, text));
        }
    }
}

/// What ends the lock of the drives while journals cannot be read.
const REMEDY: &str = "check the disk of state_dir and the permissions there, or examine the journal and move it away";

/// Text of the reason why a drive is locked whose journal was not read yet.
fn not_read(name: &str) -> String {
    format!(
        "a restore of the parameters of `{name}` may have been interrupted; until its journal is read, the drive accepts only stops"
    )
}

fn hold(vault: &Vault, events: &Events, drive: &Configured, why: String) {
    let spec = &drive.spec;
    tracing::error!(target: "drivegate::north::parameter_jobs", bus = %spec.bus, drive = %spec.name, "{why}");
    events.publish(unfinished_event(&spec.bus, Some(&spec.name), why.clone()));
    vault.restore_lock(&drive.machine).set(Some(why));
}

/// Text of the reason why a drive is locked because of the journal that concerns it.
fn why_held(spec: &DriveSpec, (file, owner): &Found, claim: Claim) -> String {
    let name = &spec.name;
    if let (Claim::Place | Claim::Name, Ok(owner)) = (claim, owner) {
        return belongs_elsewhere(name, &spec.profile.name, claim, owner);
    }
    let parsed = match file.read() {
        Ok(Some(text)) => Journal::parse(&text, &spec.profile),
        Ok(None) => Err("it is gone".to_string()),
        Err(error) => Err(error.to_string()),
    };
    let why = match parsed {
        Ok(journal) => format!(
            "started {} by {}, interrupted while {}, {} of {} parameters done; the journal belongs to {}",
            journal.begun,
            journal.by,
            journal.phase.name(),
            journal.done,
            journal.plan.writes.len(),
            journal.of.place()
        ),
        Err(why) => not_understood(file, name, &why),
    };
    held_unfinished(name, &why)
}

#[cfg(test)]
mod tests;
