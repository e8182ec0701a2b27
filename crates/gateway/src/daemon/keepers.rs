//! Writers and readers of the files on disk.

use std::sync::Arc;

use super::server::within;
use super::{Daemon, STOP_AUDIT, StartError, drills, reservations};
use crate::config::{Settings, StateFiles};
use drivegate_core::files::names::STARTS;
use drivegate_core::files::{Keeper, State as _};
use drivegate_core::history::{self, RecorderTask};
use drivegate_core::order::AuditFile;
use drivegate_core::parameters::Store;
use drivegate_core::start_guard::{self, Saved, WhileTaken};
use drivegate_north::parameter_jobs::{hold_unfinished, keep_reading};
use drivegate_north::patience::late;
use drivegate_north::state_file::LATE;

impl Daemon {
    /// Starts the recorder, or replaces it if its configuration differs; the recordings of the replaced one are on
    /// disk by then.
    pub(super) async fn apply_recorder(&mut self, settings: &Settings) -> Result<(), StartError> {
        if self.recorder.is_some() && self.settings.recordings == settings.recordings {
            return Ok(());
        }
        let patience = self.north.patience.clone();
        if let Some(recorder) = self.recorder.take()
            && let Err(why) = patience.read(move || recorder.stop()).await
        {
            tracing::error!(
                target: "drivegate::daemon", "recordings in progress may be lost: {why}; the next recorder starts; check the disk"
            );
        }
        let (recordings, history) = (self.north.recordings.clone(), self.north.history.clone());
        let options = settings.recordings.clone();
        let started = RecorderTask::start(options, recordings, history, self.events.clone(), &self.command_log);
        let (recorder, opened) = started.map_err(StartError::Recorder)?;
        self.recorder = Some(recorder);
        if patience.wait(opened).await.is_none() {
            tracing::error!(
                target: "drivegate::daemon", "cannot list the recordings of earlier runs: {}; they are listed as soon as it answers; \
                                              check the disk of recordings.dir", late()
            );
        }
        Ok(())
    }

    /// Reads parameters at regular intervals, if this is configured.
    pub(super) fn apply_params(&mut self, settings: &Settings) {
        let params = &settings.params;
        let vault = &self.north.parameters;
        vault.configure(Some(Store::new(params.dir.clone())), params.names.clone());
        vault.set_others(params.others.clone());
        if self.reader.is_some() && self.settings.params.every == params.every {
            return;
        }
        if let Some(reader) = self.reader.take() {
            reader.abort();
        }
        let every = params.every;
        self.reader = every.map(|every| tokio::spawn(keep_reading(self.plant.clone(), vault.clone(), every)));
    }

    /// Locks new drives whose parameters may be half restored, before their bus starts: they accept only stops.
    pub(super) async fn hold_unfinished(&self, settings: &Settings) {
        hold_unfinished(
            &self.north.parameters,
            &self.events,
            &self.north.patience,
            settings.drives(),
        )
        .await;
    }

    /// Saves events and counters in the configured directory. If no thread can be started for it, the gateway runs
    /// without this.
    pub(super) async fn apply_keeper(&mut self, settings: &Settings) {
        let same = |keeper: &Keeper| keeper.dir() == settings.state_dir;
        if settings.state_files != StateFiles::Owned || self.keeper.as_ref().is_some_and(same) {
            return;
        }
        let first = self.keeper.is_none();
        self.stop_keeper().await;
        match history::keep(&settings.state_dir, first, self.north.history.clone(), &self.events) {
            Ok((keeper, earlier)) => {
                self.keeper = Some(keeper);
                match self.north.patience.wait(earlier).await {
                    // A thread that panicked has logged that.
                    Some(earlier) => self.events.remember(earlier.unwrap_or_default()),
                    None => tracing::error!(
                        target: "drivegate::daemon",
                        "cannot read the events of earlier runs in {}: {}; they are not shown, and counting goes on \
                         from the file as soon as it answers; check the disk of state_dir", settings.state_dir.display(), late()
                    ),
                }
            }
            Err(error) => {
                tracing::error!(
                    target: "drivegate::daemon", "cannot start the thread that keeps events and counters: {error}; free memory or threads"
                );
            }
        }
    }

    /// Keeps starts in the configured directory, where they are counted. Guarded drives are not started without that.
    pub(super) async fn apply_guards(&mut self, settings: &Settings) {
        let same = |keeper: &Keeper| keeper.dir() == settings.state_dir;
        let mut drives = settings.drives();
        let taken = match &settings.state_files {
            StateFiles::Owned if drives.any(|(_, drive)| drive.guard.is_some()) => WhileTaken::Wait,
            StateFiles::Obeyed(rest) if drives.any(|(bus, drive)| rest.counts(&bus.machine(drive))) => {
                self.guards.know(&rest.groups);
                if !rest.starts {
                    return self.observe_starts(settings).await;
                }
                WhileTaken::GiveUp
            }
            _ => return,
        };
        if self.starts.as_ref().is_some_and(same) {
            return;
        }
        self.stop_starts().await;
        match start_guard::keep(&settings.state_dir, self.guards.clone(), taken) {
            Ok((keeper, read)) => {
                self.starts = Some(keeper);
                if self.north.patience.wait(read).await.is_none() {
                    Saved::WORDS.not_read(&settings.state_dir.join(STARTS), &LATE);
                }
            }
            Err(error) => tracing::error!(
                target: "drivegate::daemon",
                "cannot start the thread that counts starts: {error}; drives with a guard are not started; free memory or threads"
            ),
        }
    }

    /// Reads the starts of earlier runs, which are not continued here.
    async fn observe_starts(&self, settings: &Settings) {
        let (dir, guards) = (settings.state_dir.clone(), self.guards.clone());
        // A disk that hangs leaves them unread, and nothing is started.
        let _ = self
            .north
            .patience
            .read(move || start_guard::observe(&dir, &guards))
            .await;
    }

    pub(super) async fn stop_starts(&mut self) {
        if let Some(keeper) = self.starts.take() {
            within(STOP_AUDIT, "the file of starts", keeper.stop()).await;
        }
    }

    pub(super) async fn stop_keeper(&mut self) {
        if let Some(keeper) = self.keeper.take() {
            within(STOP_AUDIT, "the history of events", keeper.stop()).await;
        }
    }

    /// Saves reservations on disk if a state directory is configured.
    pub(super) fn apply_reservations(&self, settings: &Settings) {
        let kept = settings.state_files == StateFiles::Owned && settings.authority.is_some();
        let dir = kept.then_some(settings.state_dir.as_path());
        reservations::keep_in(&self.reservations, dir);
    }

    /// Ends drills on drives that a changed bus no longer has, since the replaced bus sends no stops to them; no
    /// other drill can start there.
    pub(super) async fn end_drill_of_changed_bus(&self, settings: &Settings) {
        let changed = |name: &str| {
            let mut before = self.buses.iter().map(|(bus, _)| bus);
            before.any(|bus| bus.spec.name == name && !settings.buses.contains(bus))
        };
        self.north.drills.set_options(None);
        drills::end(
            &self.plant,
            &self.north.drills,
            &self.drills,
            "a reload of its bus",
            changed,
        )
        .await;
    }

    /// Applies the configured drills, which are saved on disk if a state directory is configured.
    pub(super) async fn apply_drills(&self, settings: &Settings) {
        let drills = &self.north.drills;
        let kept = settings.state_files == StateFiles::Owned && settings.drill.is_some();
        let dir = kept.then_some(settings.state_dir.as_path());
        drills::keep_in(&self.drills, dir, &self.north.patience, drills).await;
        drills.set_options(settings.drill);
    }

    /// Writes the audit to the configured file. If no thread can be started for it, the gateway runs without this.
    pub(super) async fn apply_audit(&self, settings: &Settings) {
        let audit = self.command_log.audit();
        let before = audit.file();
        if before.as_ref().map(|file| file.options()) == settings.audit.as_ref() {
            return;
        }
        let started = match (settings.audit.clone(), before) {
            (Some(options), Some(before)) => before.succeed(options),
            (Some(options), None) => AuditFile::start(options),
            (None, before) => {
                audit.write_to(None);
                if let Some(before) = before {
                    within(STOP_AUDIT, "the audit file", before.stop()).await;
                }
                return;
            }
        };
        match started {
            Ok(file) => audit.write_to(Some(Arc::new(file))),
            Err(error) => tracing::error!(
                target: "drivegate::daemon", "cannot start the thread of the audit file: {error}; the audit file \
                                              stays as before; free memory or threads"
            ),
        }
    }
}
