//! Readings and frames of a bus for recorder, trends and counters; costs nothing while unused.
//!
//! The bus only appends and the recorder takes all entries at once, so the bus never waits longer than for the swap
//! of two lists.

use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use drivegate_model::drive::DriveIndex;
use drivegate_proto::Table;

/// Maximum number of bytes of entries that wait for the recorder; further entries are counted and dropped.
pub const TAPE_BYTES: usize = 1 << 20;

/// How a transaction ended on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// A request of the gateway.
    Sent,
    /// The drive answered.
    Ok,
    /// The drive answered with an exception.
    Exception,
    /// No reply arrived in time.
    Timeout,
    /// The reply was invalid.
    Corrupt,
    /// Bytes between two transactions.
    Foreign,
}

impl Verdict {
    /// All verdicts.
    pub const ALL: [Verdict; 6] = [
        Verdict::Sent,
        Verdict::Ok,
        Verdict::Exception,
        Verdict::Timeout,
        Verdict::Corrupt,
        Verdict::Foreign,
    ];

    /// Whether the transaction failed.
    pub fn is_error(self) -> bool {
        matches!(self, Verdict::Timeout | Verdict::Corrupt)
    }
}

/// Words from a drive's reply to a planned read.
#[derive(Debug, Clone, PartialEq)]
pub struct TapedRead {
    /// When the words were read.
    pub at: Instant,
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// A word for each item.
    pub words: Arc<[u16]>,
}

/// Bytes on the line: a request, or all bytes received until its transaction ended.
#[derive(Debug, Clone, PartialEq)]
pub struct TapedFrame {
    /// Time of a request: when the port accepted it. Otherwise the time of the last byte, or when the transaction
    /// was given up.
    pub at: Instant,
    /// Index of the drive of the transaction; `None` for bytes between two transactions.
    pub drive: Option<DriveIndex>,
    /// How the transaction of the frame ended.
    pub verdict: Verdict,
    /// The bytes of the frame; empty if nothing arrived.
    pub bytes: Arc<[u8]>,
}

/// An entry of the tape.
#[derive(Debug, Clone, PartialEq)]
pub enum Taped {
    /// The drive at this position was read.
    Read(DriveIndex, TapedRead),
    /// A frame that was on the line.
    Frame(TapedFrame),
}

impl Taped {
    /// Size of the entry in memory, bytes.
    pub fn size(&self) -> usize {
        match self {
            Taped::Read(_, read) => read.size(),
            Taped::Frame(frame) => frame.size(),
        }
    }
}

/// Bytes of the counters that precede shared data.
const SHARED: usize = 16;

impl TapedRead {
    /// Size of the read in memory, bytes.
    pub fn size(&self) -> usize {
        size_of::<TapedRead>() + SHARED + 2 * self.words.len()
    }
}

impl TapedFrame {
    /// Size of the frame in memory, bytes.
    pub fn size(&self) -> usize {
        size_of::<TapedFrame>() + SHARED + self.bytes.len()
    }
}

#[derive(Debug, Default)]
struct Waiting {
    entries: Vec<Taped>,
    bytes: usize,
    lost: u64,
}

/// Which entries a tape records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Taping {
    /// The tape records nothing.
    Off,
    /// Only readings are recorded, for trends and counters.
    Reads,
    /// Readings and frames: also for the recorder.
    Everything,
}

/// The tape of one bus.
#[derive(Debug, Default)]
pub struct Tape {
    /// The present [`Taping`] as a number.
    taping: AtomicU8,
    waiting: Mutex<Waiting>,
}

impl Tape {
    /// Sets what is recorded from now on; with nothing to record, the tape is cleared.
    pub fn switch(&self, taping: Taping) {
        self.taping.store(taping as u8, Ordering::Relaxed);
        if taping == Taping::Off {
            self.take();
        }
    }

    /// Whether the tape records this kind.
    pub fn records(&self, taping: Taping) -> bool {
        self.taping.load(Ordering::Relaxed) >= taping as u8
    }

    /// Records a read of the drive with this index. `read` is called only while the tape is recording. Only the bus
    /// itself may call this.
    pub fn read(&self, drive: DriveIndex, read: impl FnOnce() -> TapedRead) {
        if self.records(Taping::Reads) {
            self.append(Taped::Read(drive, read()));
        }
    }

    /// Records a frame on the line, to be read by [`Tape::read`].
    pub fn frame(&self, frame: impl FnOnce() -> TapedFrame) {
        if self.records(Taping::Everything) {
            self.append(Taped::Frame(frame()));
        }
    }

    fn append(&self, entry: Taped) {
        let size = entry.size();
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.bytes + size > TAPE_BYTES {
            waiting.lost += 1;
        } else {
            waiting.bytes += size;
            waiting.entries.push(entry);
        }
    }

    /// All entries since the previous call, oldest first, and the number of dropped ones.
    pub fn take(&self) -> (Vec<Taped>, u64) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let next = Waiting {
            // About as many entries are expected until the next call.
            entries: Vec::with_capacity(waiting.entries.len()),
            ..Waiting::default()
        };
        let taken = std::mem::replace(&mut *waiting, next);
        (taken.entries, taken.lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tape_that_nobody_takes_is_bounded() {
        let tape = Tape::default();
        let frame = |bytes: usize| TapedFrame {
            at: Instant::now(),
            drive: None,
            verdict: Verdict::Foreign,
            bytes: vec![0; bytes].into(),
        };
        tape.frame(|| unreachable!("it is off"));
        tape.read(DriveIndex::new(0), || unreachable!("it is off"));
        tape.switch(Taping::Everything);
        for _ in 0..2000 {
            tape.frame(|| frame(1000));
        }
        let (entries, lost) = tape.take();
        assert_eq!(entries.len() as u64 + lost, 2000);
        assert_eq!(entries.len(), TAPE_BYTES / frame(1000).size());
        tape.frame(|| frame(1));
        assert_eq!((tape.take().0.len(), tape.take().0.len()), (1, 0));
        tape.switch(Taping::Reads);
        tape.frame(|| unreachable!("nobody records"));
        tape.read(DriveIndex::new(0), || TapedRead {
            at: Instant::now(),
            table: Table::Holding,
            start: 1,
            words: [7].into(),
        });
        assert_eq!(tape.take().0.len(), 1);
        tape.switch(Taping::Everything);
        tape.frame(|| frame(1));
        tape.switch(Taping::Off);
        tape.frame(|| unreachable!("it is off"));
        assert_eq!(tape.take(), (Vec::new(), 0));
    }
}
