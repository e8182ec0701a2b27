//! What a bus read and what was on its line, on the way to the recorder; costs nothing while there is none.
//!
//! The bus only appends and the recorder takes all there is at once, so the bus never waits longer than for the swap of two
//! lists.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use crate::codec::Table;

/// Bytes that wait for the recorder at most; what comes beyond is counted and dropped.
pub const TAPE_BYTES: usize = 1 << 20;

/// How an exchange looked on the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// A request of the gateway.
    Sent,
    /// The drive answered.
    Ok,
    /// The drive answered with an exception.
    Exception,
    /// Nothing, or nothing that belongs to the request, came in time.
    Timeout,
    /// What came cannot be believed.
    Corrupt,
    /// Bytes between two exchanges.
    Foreign,
}

impl Verdict {
    /// Whether the exchange failed.
    pub fn is_error(self) -> bool {
        matches!(self, Verdict::Timeout | Verdict::Corrupt)
    }
}

/// Words that a drive answered to a read of its plan.
#[derive(Debug, Clone, PartialEq)]
pub struct TapedRead {
    /// When they were read.
    pub at: Instant,
    /// Table.
    pub table: Table,
    /// First PDU address.
    pub start: u16,
    /// A word for each item.
    pub words: Arc<[u16]>,
}

/// Bytes on the line: a request, or all that came until its exchange was over.
#[derive(Debug, Clone, PartialEq)]
pub struct TapedFrame {
    /// A request: when it was given to the port. Else when the last of it came, or the exchange was given up.
    pub at: Instant,
    /// Place of the drive that was asked; none for bytes between two exchanges.
    pub drive: Option<usize>,
    /// What it was.
    pub verdict: Verdict,
    /// The bytes; none where nothing came.
    pub bytes: Arc<[u8]>,
}

/// One entry of the tape.
#[derive(Debug, Clone, PartialEq)]
pub enum Taped {
    /// The drive at that place was read.
    Read(usize, TapedRead),
    /// Something was on the line.
    Frame(TapedFrame),
}

impl Taped {
    /// Bytes of memory it takes.
    pub fn size(&self) -> usize {
        match self {
            Taped::Read(_, read) => read.size(),
            Taped::Frame(frame) => frame.size(),
        }
    }
}

/// Counters in front of shared bytes.
const SHARED: usize = 16;

impl TapedRead {
    /// Bytes of memory that a read of so many words takes.
    pub const fn size_of(words: usize) -> usize {
        size_of::<TapedRead>() + SHARED + 2 * words
    }

    /// Bytes of memory it takes.
    pub fn size(&self) -> usize {
        TapedRead::size_of(self.words.len())
    }
}

impl TapedFrame {
    /// Bytes of memory that a frame of so many bytes takes.
    pub const fn size_of(bytes: usize) -> usize {
        size_of::<TapedFrame>() + SHARED + bytes
    }

    /// Bytes of memory it takes.
    pub fn size(&self) -> usize {
        TapedFrame::size_of(self.bytes.len())
    }
}

#[derive(Debug, Default)]
struct Waiting {
    entries: Vec<Taped>,
    bytes: usize,
    lost: u64,
}

/// The tape of one bus.
#[derive(Debug, Default)]
pub struct Tape {
    on: AtomicBool,
    waiting: Mutex<Waiting>,
}

impl Tape {
    /// Lets the tape run from now on, or stops and clears it.
    pub fn switch(&self, on: bool) {
        self.on.store(on, Ordering::Relaxed);
        if !on {
            self.take();
        }
    }

    /// Whether a recorder takes what is appended.
    pub fn is_on(&self) -> bool {
        self.on.load(Ordering::Relaxed)
    }

    /// Appends an entry, which is only built while the tape runs. Only the bus itself may call this.
    pub fn append(&self, entry: impl FnOnce() -> Taped) {
        if !self.is_on() {
            return;
        }
        let entry = entry();
        let size = entry.size();
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.bytes + size > TAPE_BYTES {
            waiting.lost += 1;
        } else {
            waiting.bytes += size;
            waiting.entries.push(entry);
        }
    }

    /// All entries since the last call, oldest first, and how many were dropped.
    pub fn take(&self) -> (Vec<Taped>, u64) {
        let waiting = std::mem::take(&mut *self.waiting.lock().unwrap_or_else(PoisonError::into_inner));
        (waiting.entries, waiting.lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tape_that_nobody_takes_is_bounded() {
        let tape = Tape::default();
        let frame = |bytes: usize| {
            Taped::Frame(TapedFrame {
                at: Instant::now(),
                drive: None,
                verdict: Verdict::Foreign,
                bytes: vec![0; bytes].into(),
            })
        };
        tape.append(|| unreachable!("it is off"));
        tape.switch(true);
        for _ in 0..2000 {
            tape.append(|| frame(1000));
        }
        let (entries, lost) = tape.take();
        assert_eq!(entries.len() as u64 + lost, 2000);
        assert_eq!(entries.len(), TAPE_BYTES / frame(1000).size());
        tape.append(|| frame(1));
        assert_eq!((tape.take().0.len(), tape.take().0.len()), (1, 0));
        tape.append(|| frame(1));
        tape.switch(false);
        tape.append(|| unreachable!("it is off"));
        assert_eq!(tape.take(), (Vec::new(), 0));
    }
}
