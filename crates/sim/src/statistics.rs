//! Statistics of a simulated line: counters, lateness of the simulator itself, and a transcript of frames.

use super::SimTime;
use std::collections::VecDeque;
use std::fmt;
use std::time::Duration;

/// Counters of a line since its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Statistics {
    /// Valid requests to drives that answer.
    pub requests: u64,
    /// Reply frames sent, exceptions among them; frames that a fault added do not count.
    pub replies: u64,
    /// Valid broadcasts.
    pub broadcasts: u64,
    /// Valid requests to addresses without a drive that answers.
    pub unanswered: u64,
    /// Requests whose CRC is wrong or that are cut short.
    pub bad_crc: u64,
    /// Requests that began less than 3.5 characters after the last frame on the line.
    pub silence_violations: u64,
    /// Requests that began while a reply was due or on the line.
    pub collisions: u64,
    /// Requests that collided with a frame from fault injection (late, doubled, noise), which is not the master's fault.
    pub provoked_overlaps: u64,
    /// Number of injected faults.
    pub faults: u64,
    /// Bytes from the master.
    pub bytes_in: u64,
    /// Bytes to the master.
    pub bytes_out: u64,
    /// Bytes that the port did not take.
    pub bytes_lost: u64,
}

impl std::iter::Sum for Statistics {
    fn sum<I: Iterator<Item = Statistics>>(all: I) -> Statistics {
        all.fold(Statistics::default(), |a, b| Statistics {
            requests: a.requests + b.requests,
            replies: a.replies + b.replies,
            broadcasts: a.broadcasts + b.broadcasts,
            unanswered: a.unanswered + b.unanswered,
            bad_crc: a.bad_crc + b.bad_crc,
            silence_violations: a.silence_violations + b.silence_violations,
            collisions: a.collisions + b.collisions,
            provoked_overlaps: a.provoked_overlaps + b.provoked_overlaps,
            faults: a.faults + b.faults,
            bytes_in: a.bytes_in + b.bytes_in,
            bytes_out: a.bytes_out + b.bytes_out,
            bytes_lost: a.bytes_lost + b.bytes_lost,
        })
    }
}

/// How much later the simulator delivered bytes than a real line would.
#[derive(Debug, Clone, Default)]
pub struct Lateness {
    recent: VecDeque<Duration>,
}

/// Number of samples kept for the quantiles.
const LATENESS_KEPT: usize = 16_384;

impl Lateness {
    /// Records the lateness of one delivery.
    pub fn record(&mut self, late: Duration) {
        if self.recent.len() >= LATENESS_KEPT {
            self.recent.pop_front();
        }
        self.recent.push_back(late);
    }

    /// The quantile (0.5 is the median) of the last 16,384 deliveries; `None` before the first.
    pub fn quantile(&self, quantile: f64) -> Option<Duration> {
        let mut sorted: Vec<Duration> = self.recent.iter().copied().collect();
        sorted.sort_unstable();
        let last = sorted.len().checked_sub(1)?;
        sorted
            .get((quantile.clamp(0.0, 1.0) * last as f64).round() as usize)
            .copied()
    }
}

/// The sender of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From the master to the drives.
    ToDrives,
    /// Bytes from a drive, or from a fault that replaces a drive.
    FromDrives,
}

/// A frame on the line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recorded {
    /// Sender of the frame.
    pub direction: Direction,
    /// When the first character of the frame began.
    pub start: SimTime,
    /// When the last character of the frame ended.
    pub end: SimTime,
    pub bytes: Vec<u8>,
}

impl fmt::Display for Recorded {
    /// `12.345678 > 01 03 08 34 00 0B 47 A3`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let arrow = match self.direction {
            Direction::ToDrives => '>',
            Direction::FromDrives => '<',
        };
        write!(f, "{:.6} {arrow}", self.start.as_secs_f64())?;
        self.bytes.iter().try_for_each(|byte| write!(f, " {byte:02X}"))
    }
}

/// The last frames of a line, recorded on request.
#[derive(Debug, Clone, Default)]
pub struct Transcript {
    frames: VecDeque<Recorded>,
    limit: usize,
}

impl Transcript {
    /// A transcript of the last `limit` frames; 0 records nothing.
    pub fn new(limit: usize) -> Transcript {
        Transcript {
            frames: VecDeque::new(),
            limit,
        }
    }

    /// Adds a frame; the oldest makes room.
    pub fn record(&mut self, frame: impl FnOnce() -> Recorded) {
        if self.limit == 0 {
            return;
        }
        if self.frames.len() >= self.limit {
            self.frames.pop_front();
        }
        self.frames.push_back(frame());
    }

    /// The frames, oldest first.
    pub fn frames(&self) -> Vec<Recorded> {
        self.frames.iter().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles() {
        let mut lateness = Lateness::default();
        assert_eq!(lateness.quantile(0.5), None);
        (1..=101)
            .rev()
            .for_each(|us| lateness.record(Duration::from_micros(us)));
        assert_eq!(lateness.quantile(0.5), Some(Duration::from_micros(51)));
        assert_eq!(lateness.quantile(0.99), Some(Duration::from_micros(100)));
        assert_eq!(lateness.quantile(1.0), Some(Duration::from_micros(101)));
    }

    #[test]
    fn the_transcript_is_bounded() {
        let frame = |n: u8| {
            let at = Duration::from_millis(n.into());
            move || Recorded {
                direction: Direction::FromDrives,
                start: at,
                end: at,
                bytes: vec![n, 0xAB],
            }
        };
        let mut off = Transcript::new(0);
        off.record(frame(1));
        assert!(off.frames().is_empty());
        let mut transcript = Transcript::new(2);
        (1..=3).for_each(|n| transcript.record(frame(n)));
        let frames = transcript.frames();
        assert_eq!(frames.len(), 2);
        assert_eq!(frames[0].to_string(), "0.002000 < 02 AB");
    }
}
