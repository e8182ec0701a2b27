//! The directory of the recordings. A file is written under another name, synced and renamed, so that only complete
//! ones exist.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use super::RecorderOptions;
use super::recording::{ENDING, Header, Recording, RecordingError};
use super::retention::{Kept, Storm, surplus};
use super::trigger::TriggerKind;
use crate::files::{self, PARTIAL};

/// Longest header that is looked for when a directory is listed.
const MOST_HEADER: u64 = 1 << 20;
/// Largest file that is read.
const MOST_BYTES: u64 = 1 << 30;

/// A recording on disk with its summary.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Entry {
    /// Id of the recording.
    pub id: String,
    /// Time of the trigger, RFC 3339.
    pub time: String,
    /// Name of the drive.
    pub drive: String,
    /// Bus of the drive.
    pub bus: String,
    /// Trigger of the recording.
    #[schema(value_type = String)]
    pub trigger: TriggerKind,
    /// Summary of the recording.
    pub summary: String,
    /// Size of the file.
    pub bytes: u64,
    #[serde(skip)]
    first: bool,
}

impl Entry {
    fn new(header: &Header, bytes: u64) -> Entry {
        Entry {
            id: header.id.clone(),
            time: header.time.clone(),
            drive: header.drive.name.clone(),
            bus: header.bus.name.clone(),
            trigger: header.trigger,
            summary: header.summary.clone(),
            bytes,
            first: header.first,
        }
    }
}

/// Why a recording cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// If the file cannot be read.
    #[error("cannot read {path}: {error}")]
    File {
        /// Path of the file.
        path: String,
        /// Reason why the file cannot be read.
        error: io::Error,
    },
    /// The content of the file is not a recording.
    #[error("{path}: {error}")]
    Content {
        /// Path of the file.
        path: String,
        /// The defect of the recording, and its place in the file.
        error: RecordingError,
    },
}

/// Reads a recording from a file.
///
/// # Errors
/// If the file cannot be read, or is not a recording.
pub fn read(path: &Path) -> Result<Recording, ReadError> {
    let failed = |error| ReadError::File {
        path: path.display().to_string(),
        error,
    };
    let file = File::open(path).map_err(failed)?;
    let mut bytes = Vec::new();
    file.take(MOST_BYTES).read_to_end(&mut bytes).map_err(failed)?;
    Recording::parse(&bytes).map_err(|error| ReadError::Content {
        path: path.display().to_string(),
        error,
    })
}

/// The recordings of a directory, oldest first, and the faults of the others.
///
/// # Errors
/// If the directory cannot be read. A missing directory is not an error: it contains no recordings.
pub fn list(dir: &Path) -> io::Result<(Vec<Entry>, Vec<ReadError>)> {
    let files = match fs::read_dir(dir) {
        Ok(files) => files,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((Vec::new(), Vec::new())),
        Err(error) => return Err(error),
    };
    let (mut entries, mut faults) = (Vec::new(), Vec::new());
    for file in files {
        let path = file?.path();
        if path.extension().is_none_or(|ending| ending != ENDING) {
            continue;
        }
        match entry(&path) {
            Ok(entry) => entries.push(entry),
            Err(error) => faults.push(error),
        }
    }
    entries.sort_by(|a: &Entry, b: &Entry| (&a.time, &a.id).cmp(&(&b.time, &b.id)));
    Ok((entries, faults))
}

fn entry(path: &Path) -> Result<Entry, ReadError> {
    let failed = |error| ReadError::File {
        path: path.display().to_string(),
        error,
    };
    let file = File::open(path).map_err(failed)?;
    let size = file.metadata().map_err(failed)?.len();
    let mut bytes = Vec::new();
    file.take(MOST_HEADER).read_to_end(&mut bytes).map_err(failed)?;
    let header = Header::parse(&bytes).map_err(|error| ReadError::Content {
        path: path.display().to_string(),
        error,
    })?;
    Ok(Entry::new(&header.0, size))
}

/// Path of the file for a recording.
pub fn path_of(dir: &Path, id: &str) -> PathBuf {
    dir.join(format!("{id}.{ENDING}"))
}

/// The directory of the recordings with its content.
#[derive(Debug)]
pub struct Store {
    dir: PathBuf,
    max_bytes: u64,
    max_count: usize,
    storm: Storm,
    entries: Vec<Arc<Entry>>,
}

impl Store {
    /// Reads the directory, and removes incomplete files.
    pub fn open(options: &RecorderOptions) -> Store {
        let (entries, faults) = list(&options.dir).unwrap_or_default();
        for fault in faults {
            tracing::warn!(target: "drivegate::history", "{fault}; it is left as it is");
        }
        let mut storm = Storm::default();
        for entry in &entries {
            if let Ok(time) = humantime::parse_rfc3339(&entry.time) {
                storm.is_first(time);
            }
        }
        let files = fs::read_dir(&options.dir).into_iter().flatten().flatten();
        for path in files.map(|file| file.path()) {
            if path.extension().is_some_and(|ending| ending == PARTIAL) {
                // The next start of the gateway tries again to remove the file.
                let _ = fs::remove_file(path);
            }
        }
        Store {
            dir: options.dir.clone(),
            max_bytes: options.max_bytes,
            max_count: options.max_count,
            storm,
            entries: entries.into_iter().map(Arc::new).collect(),
        }
    }

    /// The directory of the recordings.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// The recordings, oldest first.
    pub fn entries(&self) -> &[Arc<Entry>] {
        &self.entries
    }

    /// Writes a recording at the time `now`, then removes the recordings that no longer fit.
    ///
    /// # Errors
    /// If the file cannot be written, or alone exceeds the limit for all recordings; no part of it remains.
    pub fn write(&mut self, recording: &mut Recording, now: SystemTime) -> io::Result<Arc<Entry>> {
        let time = humantime::parse_rfc3339(&recording.header.time).unwrap_or(SystemTime::UNIX_EPOCH);
        // A recording that the disk refuses is written again later, and counts once.
        let mut storm = self.storm;
        recording.header.first = storm.is_first(time);
        let id = recording.header.id.clone();
        let taken = |id: &str| self.entries.iter().any(|entry| entry.id == id);
        // An id is taken twice only after the clock was set back.
        let mut others = (2..).map(|n| format!("{id}-{n}")).filter(|id| !taken(id));
        if taken(&id) {
            recording.header.id = others.next().unwrap_or(id);
        }
        let bytes = recording.to_bytes();
        let size = bytes.len() as u64;
        if size > self.max_bytes {
            let what = format!(
                "it has {size} bytes, and max_bytes of [recordings] is {}",
                self.max_bytes
            );
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, what));
        }
        let path = path_of(&self.dir, &recording.header.id);
        files::replace(&path, &bytes)?;
        self.storm = storm;
        let entry = Arc::new(Entry::new(&recording.header, size));
        let at = self
            .entries
            .partition_point(|other| (&other.time, &other.id) <= (&entry.time, &entry.id));
        self.entries.insert(at, entry.clone());
        self.make_room(&entry, now);
        Ok(entry)
    }

    /// Removes recordings beyond the limits, after `written`, which stays. Recordings with a time in the future, as after the
    /// clock was set back, count as the oldest: nothing would ever be older than they are.
    fn make_room(&mut self, written: &Arc<Entry>, now: SystemTime) {
        let is_to_come = |entry: &Entry| humantime::parse_rfc3339(&entry.time).is_ok_and(|time| time > now);
        let mut order = self.entries.clone();
        order.sort_by_key(|entry| (Arc::ptr_eq(entry, written), !is_to_come(entry)));
        let kept = |entry: &Arc<Entry>| Kept {
            bytes: entry.bytes,
            first: entry.first,
        };
        let all: Vec<Kept> = order.iter().map(kept).collect();
        let gone = surplus(&all, self.max_bytes, self.max_count);
        for entry in gone.into_iter().filter_map(|place| order.get(place)) {
            self.entries.retain(|other| !Arc::ptr_eq(other, entry));
            let path = path_of(&self.dir, &entry.id);
            if let Err(error) = fs::remove_file(&path)
                && error.kind() != io::ErrorKind::NotFound
            {
                tracing::warn!(target: "drivegate::history", "cannot remove {}: {error}; remove it", path.display());
            }
        }
    }
}
