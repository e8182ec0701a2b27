//! The file of starts, and the thread that keeps it, on a disk that is full, unreadable or silent at times.

use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::files::State as _;
use drivegate_core::start_guard::{Guards, Saved};

const PATH: &str = "state/starts.json";
/// Pause of the thread before it reads again.
const AGAIN: Duration = Duration::from_secs(1);
/// Time after its end for which trouble of the disk may refuse starts: a failed try, and the next one.
const AFTERMATH: Duration = Duration::from_secs(3);

/// How the disk answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disk {
    Sound,
    /// Reads are answered, writes are not carried out.
    Full,
    /// Neither reads nor writes are carried out.
    Broken,
    /// Nothing is answered, until the disk behaves in another way.
    Hangs,
}

impl Disk {
    pub const ILL: [Disk; 3] = [Disk::Full, Disk::Broken, Disk::Hangs];
}

#[derive(Debug)]
enum Work {
    Read,
    Write(u64, Saved),
}

#[derive(Debug)]
pub struct StateFile {
    holds: Saved,
    disk: Disk,
    /// When the disk was last not sound.
    ill_at: Option<Instant>,
    /// Whether the present process has read the file.
    is_read: bool,
    /// What the thread waits for, and when the disk answers at the earliest.
    work: Option<(Work, Instant)>,
}

impl Default for StateFile {
    fn default() -> StateFile {
        StateFile {
            holds: Saved::default(),
            disk: Disk::Sound,
            ill_at: None,
            is_read: false,
            work: None,
        }
    }
}

impl StateFile {
    /// Begins the thread of a new process.
    pub fn begin(&mut self, guards: &Guards, takes: Duration, now: Instant) {
        guards.await_file(Path::new(PATH));
        (self.is_read, self.work) = (false, Some((Work::Read, now + takes)));
    }

    pub fn becomes(&mut self, disk: Disk) {
        self.disk = disk;
    }

    pub fn is_sound(&self) -> bool {
        self.disk == Disk::Sound
    }

    pub fn is_read(&self) -> bool {
        self.is_read
    }

    /// Whether the file may be the reason of a refusal at `now`.
    pub fn may_refuse(&self, now: Instant) -> bool {
        !self.is_read || self.ill_at.is_some_and(|at| now - at < AFTERMATH)
    }

    /// Whether that reason names the file.
    pub fn is_named(why: &str) -> bool {
        why.contains(PATH) || why.contains("the disk did not take")
    }

    /// The process is killed: what it was writing `reaches` the disk, or does not.
    pub fn kill(&mut self, reaches: bool) {
        if let Some((Work::Write(_, saved), _)) = self.work.take()
            && reaches
            && !matches!(self.disk, Disk::Full | Disk::Broken)
        {
            self.holds = saved;
        }
    }

    /// Does what the thread and the disk do by `now`; a new access `takes` this long on a sound disk.
    pub fn advance(&mut self, guards: &Guards, takes: Duration, now: Instant, time: SystemTime) {
        if !self.is_sound() {
            self.ill_at = Some(now);
        }
        let answers = self.disk != Disk::Hangs;
        if let Some((work, _)) = self.work.take_if(|(_, due)| answers && *due <= now) {
            match (work, self.disk) {
                (Work::Read, Disk::Broken) => {
                    guards.not_read("input/output error".to_string());
                    self.work = Some((Work::Read, now + AGAIN));
                }
                (Work::Read, _) => {
                    self.is_read = true;
                    guards.keep(&self.holds, now, time);
                }
                (Work::Write(generation, saved), Disk::Sound | Disk::Hangs) => {
                    self.holds = saved;
                    guards.wrote(generation, Ok(()), now);
                }
                (Work::Write(generation, _), Disk::Full | Disk::Broken) => {
                    guards.wrote(generation, Err(format!("{PATH}: no space")), now);
                }
            }
        }
        if self.work.is_none()
            && let Some((generation, saved)) = guards.to_write(now, time)
        {
            self.work = Some((Work::Write(generation, saved), now + takes));
        }
    }

    /// Whether the file has a start of the drive at this address that is not older than `since`.
    pub fn has_start(&self, address: u8, since: SystemTime) -> bool {
        let since = since
            .duration_since(SystemTime::UNIX_EPOCH)
            .unwrap_or_default()
            .as_millis();
        let file: serde_json::Value = serde_json::from_slice(&self.holds.to_json().unwrap()).unwrap();
        let motors = file["motors"].as_array().unwrap().iter();
        let mut starts = motors
            .filter(|motor| motor["address"] == address)
            .flat_map(|motor| motor["starts"].as_array().unwrap());
        starts.any(|at| u128::from(at.as_u64().unwrap()) >= since)
    }
}
