//! The motors of all buses, their groups, and which of their data is saved. Pure: time is an argument.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;

use super::drives_by_name::DrivesByName;
use super::file::Saved;
use super::motor::{HOUR, Motor, Reserved};
use super::{Guard, Guarded, Reason, shown};
use crate::files::state::AGAIN;
use crate::process_image::{DriveImage, Machine};

/// Longest wait of a start for the disk.
pub(super) const DISK: Duration = Duration::from_secs(1);

/// The starts of the whole gateway, shared by its buses and kept over every reload.
#[derive(Debug, Default)]
pub struct Guards {
    ledger: Mutex<Ledger>,
    changed: Condvar,
    around: ArcSwap<DrivesByName>,
}

#[derive(Debug, Default)]
pub(super) struct Ledger {
    motors: BTreeMap<Machine, Entry>,
    /// Counter of changes that must be saved.
    generation: u64,
    disk: Disk,
}

/// A motor with the group that it belongs to.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) motor: Motor,
    group: Arc<str>,
    /// Starts that were refused, by reason.
    refused: BTreeMap<Reason, u64>,
}

/// Whether and how starts are saved.
#[derive(Debug, Default)]
enum Disk {
    /// Starts are kept in memory only.
    #[default]
    None,
    /// Starts will be kept in a file that is not read yet.
    Unread {
        path: PathBuf,
        /// Why reading it failed, if it did.
        why: Option<String>,
        /// Generation at which the file began to be awaited.
        since: u64,
    },
    /// Starts are kept in a file.
    File {
        /// Newest generation that is in the file.
        written: u64,
        /// The last write, if it failed.
        failed: Option<FailedWrite>,
    },
}

/// A write of the file that failed.
#[derive(Debug)]
struct FailedWrite {
    generation: u64,
    why: String,
    at: Instant,
}

/// Whether a cleared start is on disk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum SaveProgress {
    Yes,
    NotYet,
    Failed(String),
}

impl Guards {
    pub(super) fn lock(&self) -> MutexGuard<'_, Ledger> {
        self.ledger.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn around(&self) -> arc_swap::Guard<Arc<DrivesByName>> {
        self.around.load()
    }

    /// Sets the drives that interlocks look at.
    pub fn watch(
        &self,
        drives: impl IntoIterator<Item = (Machine, Arc<DriveImage>)>,
        stale_after: Duration,
        now: Instant,
    ) {
        let next = self.around.load().follow(drives, stale_after, now);
        self.around.store(Arc::new(next));
    }

    /// The buses of these drives are about to be restarted.
    pub fn expect(&self, drives: &[Arc<DriveImage>], now: Instant) {
        let next = self.around.load().expecting(drives, now);
        self.around.store(Arc::new(next));
    }

    /// Counts starts of these machines, which belong to no bus here, as part of their groups.
    pub fn know(&self, groups: &[(Machine, Arc<str>)]) {
        let mut ledger = self.lock();
        groups
            .iter()
            .for_each(|(machine, group)| ledger.register(machine, group));
    }

    /// Notes a change that must be written to disk.
    pub(super) fn notify_change(&self) {
        self.changed.notify_one();
    }

    /// Announces that starts will be saved in this file; until [`Guards::keep`] has its content, no start is allowed.
    pub fn await_file(&self, path: &Path) {
        let mut ledger = self.lock();
        ledger.disk = Disk::Unread {
            path: path.to_path_buf(),
            why: None,
            since: ledger.generation,
        };
    }

    /// Notes that the file could not be read, for this reason.
    pub fn not_read(&self, why: String) {
        if let Disk::Unread { why: reason, .. } = &mut self.lock().disk {
            *reason = Some(why);
        }
    }

    /// Saves starts in a file from now on: no start is written to a drive before [`Guards::wrote`] reports that it
    /// is on disk. `saved` has the starts of earlier runs; if the clock was set back, none counts as older than
    /// possible.
    pub fn keep(&self, saved: &Saved, now: Instant, time: SystemTime) {
        let mut ledger = self.lock();
        ledger.withdraw_undecided();
        for (machine, starts) in saved.motors() {
            let at = |start: SystemTime| {
                let age = time.duration_since(start).unwrap_or_default();
                now.checked_sub(age).filter(|_| age < HOUR)
            };
            ledger.remember(machine, starts.filter_map(at), now);
        }
        ledger.generation += 1;
        ledger.disk = Disk::File {
            written: 0,
            failed: None,
        };
        drop(ledger);
        self.notify_change();
    }

    /// The state to save, with its generation; `None` if it is already saved, or if saving has just failed.
    pub fn to_write(&self, now: Instant, time: SystemTime) -> Option<(u64, Saved)> {
        self.lock().to_write(now, time)
    }

    /// Waits for a state to save, for at most `most`; returns `None` if there is none.
    pub(super) fn wait_to_write(&self, most: Duration) -> Option<(u64, Saved)> {
        let is_up_to_date = |ledger: &mut Ledger| !ledger.is_behind(Instant::now());
        let waited = self.changed.wait_timeout_while(self.lock(), most, is_up_to_date);
        let (ledger, _) = waited.unwrap_or_else(PoisonError::into_inner);
        ledger.to_write(Instant::now(), SystemTime::now())
    }

    /// The state that is not on disk yet, for a last try, however recently another one failed.
    pub(super) fn last_to_write(&self) -> Option<(u64, Saved)> {
        let ledger = self.lock();
        ledger
            .is_unwritten()
            .then(|| ledger.saved(Instant::now(), SystemTime::now()))
    }

    /// Notes the result of a write to disk that ended at `at`.
    pub fn wrote(&self, generation: u64, done: Result<(), String>, at: Instant) {
        let mut ledger = self.lock();
        if let Disk::File { written, failed } = &mut ledger.disk {
            match done {
                Ok(()) => (*written, *failed) = (generation.max(*written), None),
                Err(why) => *failed = Some(FailedWrite { generation, why, at }),
            }
        }
    }
}

impl Ledger {
    /// Counts the starts of a drive from now on, as part of this group.
    pub(super) fn register(&mut self, machine: &Machine, group: &Arc<str>) {
        self.entry(machine.clone()).group = group.clone();
    }

    fn entry(&mut self, machine: Machine) -> &mut Entry {
        self.motors.entry(machine).or_insert_with(|| Entry {
            motor: Motor::default(),
            group: Arc::from(""),
            refused: BTreeMap::new(),
        })
    }

    fn remember(&mut self, machine: Machine, starts: impl Iterator<Item = Instant>, now: Instant) {
        let starts = starts.map(|at| at.min(now));
        self.entry(machine).motor.remember(starts);
    }

    pub(super) fn motor(&self, machine: &Machine) -> Option<&Motor> {
        self.motors.get(machine).map(|entry| &entry.motor)
    }

    /// Changes the state of a motor; the change is not a start.
    pub(super) fn with<T>(&mut self, machine: &Machine, act: impl FnOnce(&mut Motor) -> T) -> Option<T> {
        self.motors.get_mut(machine).map(|entry| act(&mut entry.motor))
    }

    /// Why a motor must not be started now.
    pub(super) fn hindered(&self, machine: &Machine, guard: &Guard, now: Instant) -> Option<Guarded> {
        let entry = self.motors.get(machine)?;
        let stagger = self.too_close(&entry.group, guard, now);
        entry
            .motor
            .hindered(guard, now)
            .into_iter()
            .chain(stagger)
            .max_by_key(|wait| wait.retry_after)
    }

    fn members<'a>(&'a self, group: &'a Arc<str>) -> impl Iterator<Item = &'a Entry> + 'a {
        self.motors.values().filter(move |entry| entry.group == *group)
    }

    /// Whether a cleared start in this group has not been sent yet.
    fn awaits_word(&self, group: &Arc<str>) -> bool {
        self.members(group).any(|entry| entry.motor.reserved.is_some())
    }

    fn too_close(&self, name: &Arc<str>, guard: &Guard, now: Instant) -> Option<Guarded> {
        if guard.stagger.is_zero() {
            return None;
        }
        let retry_after = if self.awaits_word(name) {
            // The cleared start may be sent at any time, so the full interval applies.
            guard.stagger
        } else {
            let last = self
                .members(name)
                .filter_map(|entry| entry.motor.starts().max())
                .max()?;
            (last + guard.stagger).saturating_duration_since(now)
        };
        (!retry_after.is_zero()).then(|| Guarded {
            reason: Reason::Stagger,
            why: format!(
                "drives of {name} must start {} apart (guard.stagger); it may start in {}",
                shown(guard.stagger),
                shown(retry_after)
            ),
            retry_after,
        })
    }

    /// Reserves a cleared start: it counts from now on, and must be on disk before it is written to the drive.
    pub(super) fn reserve(&mut self, machine: &Machine, number: u64, until: Instant, now: Instant) {
        self.settle(machine, None);
        self.generation += 1;
        let generation = self.generation;
        self.with(machine, |motor| {
            motor.reserve(Reserved {
                number,
                at: now,
                until,
                generation,
            });
        });
    }

    /// Counts decided starts that will not be written as made; with a number, only that command's.
    pub(super) fn settle(&mut self, machine: &Machine, number: Option<u64>) {
        let of = |reserved: Reserved| number.is_none_or(|number| reserved.number == number);
        self.with(machine, |motor| {
            if motor.reserved.is_some_and(of) {
                motor.settle();
            }
        });
    }

    /// A start that could not be counted on disk is not made, and does not count.
    pub(super) fn withdraw(&mut self, machine: &Machine) {
        if self.with(machine, |motor| motor.reserved.take()).flatten().is_some() {
            self.generation += 1;
        }
    }

    /// Withdraws the starts that were cleared without the file, none of which was written: they are judged again.
    fn withdraw_undecided(&mut self) {
        let Disk::Unread { since, .. } = self.disk else { return };
        for entry in self.motors.values_mut() {
            entry.motor.reserved.take_if(|reserved| reserved.generation > since);
        }
    }

    /// Whether a start that is decided is on disk.
    pub(super) fn kept(&self, reserved: &Reserved, now: Instant) -> SaveProgress {
        match &self.disk {
            Disk::None => SaveProgress::Yes,
            Disk::Unread {
                path, why: Some(why), ..
            } => SaveProgress::Failed(format!("{}: it cannot be read: {why}", path.display())),
            Disk::Unread { path, .. } if now >= reserved.at + DISK => SaveProgress::Failed(format!(
                "{}: it is not read yet: the disk does not answer",
                path.display()
            )),
            Disk::File { written, .. } if *written >= reserved.generation => SaveProgress::Yes,
            Disk::File {
                failed: Some(failed), ..
            } if failed.generation >= reserved.generation => SaveProgress::Failed(failed.why.clone()),
            Disk::File { .. } if now >= reserved.at + DISK => {
                SaveProgress::Failed(format!("the disk did not take them within {}", shown(DISK)))
            }
            Disk::Unread { .. } | Disk::File { .. } => SaveProgress::NotYet,
        }
    }

    /// Notes that a word of a command that would start a motor at standstill is being sent.
    pub(super) fn start_written(&mut self, machine: &Machine, number: u64, client: &Arc<str>, now: Instant) {
        if self.with(machine, |motor| motor.start_written(number, client, now)) == Some(true) {
            self.generation += 1;
        }
    }

    /// A motor was read. Whether that changed what belongs on disk.
    pub(super) fn seen(&mut self, machine: &Machine, seen: super::MotorReading) -> bool {
        let changed = self.with(machine, |motor| motor.seen(seen)) == Some(true);
        self.generation += u64::from(changed);
        changed
    }

    /// Counts a refused start.
    pub(super) fn count_refused(&mut self, machine: &Machine, reason: Reason) {
        if let Some(entry) = self.motors.get_mut(machine) {
            *entry.refused.entry(reason).or_default() += 1;
        }
    }

    pub(super) fn refused(&self, machine: &Machine) -> BTreeMap<Reason, u64> {
        self.motors
            .get(machine)
            .map(|entry| entry.refused.clone())
            .unwrap_or_default()
    }

    /// Whether something is to be written now. A state that could not be written is tried again after a while, also if nothing
    /// changed since.
    fn is_behind(&self, now: Instant) -> bool {
        match &self.disk {
            Disk::None | Disk::Unread { .. } => false,
            Disk::File {
                failed: Some(failed), ..
            } => self.generation > failed.generation || now >= failed.at + AGAIN,
            Disk::File { failed: None, .. } => self.is_unwritten(),
        }
    }

    fn is_unwritten(&self) -> bool {
        matches!(&self.disk, Disk::File { written, .. } if self.generation > *written)
    }

    fn to_write(&self, now: Instant, time: SystemTime) -> Option<(u64, Saved)> {
        self.is_behind(now).then(|| self.saved(now, time))
    }

    /// The state with its generation.
    fn saved(&self, now: Instant, time: SystemTime) -> (u64, Saved) {
        let at = |at: Instant| match at.checked_duration_since(now) {
            Some(later) => time + later,
            None => time
                .checked_sub(now.saturating_duration_since(at))
                .unwrap_or(SystemTime::UNIX_EPOCH),
        };
        let known = self.motors.iter().filter(|(_, entry)| !entry.motor.is_forgotten(now));
        let motors = known.map(|(machine, entry)| {
            let starts = entry.motor.starts_to_keep().filter(|start| *start + HOUR > now);
            (machine.clone(), starts.map(at).collect())
        });
        (self.generation, Saved::new(motors))
    }
}
