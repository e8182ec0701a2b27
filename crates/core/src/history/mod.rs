//! The history of the drives. Trends: values of the last day, in memory. Trip recorder: samples, commands and
//! frames from some time before a trigger until some time after it, in one file per recording.
//!
//! - [`trigger`]: what makes a recording, seen in the samples of a drive and on its line.
//! - [`trend`]: least, greatest and last values in steps of time; [`counters`]: starts and run time; [`line`]: the last hour of a
//!   line. [`drives`]: those of all drives and buses, as the rest of the gateway sees them.
//! - [`recorder`]: the rings in memory and the recordings in progress. Pure: time is an argument.
//! - [`capture`]: reads captures of lines, its own and others, for `drivegate replay`.
//! - [`budget`]: how much memory the rings take at most.
//! - [`assemble`]: the raw words of a ring as points, and what they show in one sentence (`summary`).
//! - [`recording`]: the form of a file, its parts and its faults; [`export`] and [`pcapng`] turn one into other forms.
//! - [`store`]: the directory of the recordings; [`retention`] decides which of them go.
//! - `keeper`: the thread that writes events and counters, so that they survive a restart.
//! - `task`: the two threads of the recorder: one takes what the buses taped, the other writes files. [`Recordings`] is how the rest of the
//!   gateway sees them.

pub mod assemble;
mod buckets;
pub mod budget;
pub mod capture;
pub mod counters;
mod decoded;
pub mod drives;
pub mod export;
mod keeper;
pub mod line;
mod packed_ring;
pub mod pcapng;
pub mod recorder;
pub mod recording;
pub mod retention;
mod ring;
pub mod store;
mod summary;
mod task;
pub mod trend;
pub mod trigger;

use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

pub use drives::{DriveHistory, History};
pub use export::RecordingObject;
pub use keeper::keep;
pub use recorder::{Capture, Recorder};
pub use recording::{Recording, RecordingError};
pub use store::{Entry, Store};
pub use task::{NotRecorded, RecorderTask, Recordings};
pub use trigger::{Trigger, TriggerKind};

/// The settings of the recorder.
#[derive(Debug, Clone, PartialEq)]
pub struct RecorderOptions {
    /// Directory of the recordings.
    pub dir: PathBuf,
    /// Time recorded before the trigger.
    pub before: Duration,
    /// Time recorded after the trigger.
    pub after: Duration,
    /// Size of all recordings on disk at most, bytes.
    pub max_bytes: u64,
    /// Maximum number of recordings on disk; with 0, no recordings are made.
    pub max_count: usize,
    /// Whether a warning of a drive makes a recording.
    pub warnings: bool,
}

impl RecorderOptions {
    /// Whether the recorder is on.
    pub fn is_on(&self) -> bool {
        self.max_count > 0
    }

    /// Time that a ring must cover: the whole recording, and the delay until the recording is taken out.
    pub(crate) fn window(&self) -> Duration {
        self.before + self.after + Duration::from_secs(1)
    }
}

/// An instant and the time of day at that instant.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    pub now: Instant,
    /// The time of day at the instant.
    pub wall: SystemTime,
}

impl Clock {
    /// Reads both clocks now.
    pub fn read() -> Clock {
        Clock {
            now: Instant::now(),
            wall: SystemTime::now(),
        }
    }

    /// The time of day at an instant.
    pub(crate) fn wall_at(&self, at: Instant) -> SystemTime {
        match self.now.checked_duration_since(at) {
            Some(ago) => self.wall.checked_sub(ago).unwrap_or(SystemTime::UNIX_EPOCH),
            None => self.wall + at.saturating_duration_since(self.now),
        }
    }

    /// The instant of a time of day.
    pub fn instant_at(&self, wall: SystemTime) -> Instant {
        match self.wall.duration_since(wall) {
            Ok(ago) => self.now.checked_sub(ago).unwrap_or(self.now),
            Err(ahead) => self.now + ahead.duration(),
        }
    }
}

#[cfg(test)]
mod tests;
