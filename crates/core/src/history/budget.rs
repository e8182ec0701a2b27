//! Memory for the rings of the recorder. Pure.

use std::time::Duration;

use super::RecorderOptions;
use super::packed_ring::{self, packed_frame, packed_read};
use crate::process_image::{BusSpec, DriveSpec};
use drivegate_model::drive::plan::WireTime;
use drivegate_model::drive::{Plan, PlannedRead, PollClass};

/// Memory that the recorder takes for all buses together at most, bytes.
pub const MOST_BYTES: usize = 20 << 20;
/// Bytes for events and commands of a drive, if the memory allows it.
pub const NOTES: usize = 64 << 10;
/// Room in addition to the planned reads: retries, reads requested by commands, reads after a fault.
const RESERVE: f64 = 1.25;
/// Rings below that size are not worth while.
const LEAST: usize = 16 << 10;

/// Part of [`MOST_BYTES`] that samples and frames may take before the memory for notes is reduced.
const RINGS: usize = MOST_BYTES / 4 * 3;

/// Memory that the recorder takes for a bus at most.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Budget {
    /// Memory for samples of each drive, bytes.
    pub samples: Vec<usize>,
    /// Events and commands of each drive, bytes.
    pub notes: usize,
    /// Memory for frames of the line, bytes.
    pub frames: usize,
}

impl Budget {
    /// The budget of each of these buses: all it needs, or less if the total exceeds [`MOST_BYTES`]. Notes are reduced
    /// first, then all rings in proportion.
    pub fn shared(mut needs: Vec<Budget>) -> Vec<Budget> {
        let total: usize = needs.iter().map(Budget::total).sum();
        if total <= MOST_BYTES {
            return needs;
        }
        let notes: usize = needs.iter().map(|need| need.notes * need.samples.len()).sum();
        let rings = total - notes;
        let left = MOST_BYTES - rings.min(RINGS);
        let (notes_part, rings_part) = (part(left, notes), part(MOST_BYTES - left.min(notes), rings));
        for need in &mut needs {
            need.notes = scaled(need.notes, notes_part);
            need.frames = scaled(need.frames, rings_part);
            for samples in &mut need.samples {
                *samples = scaled(*samples, rings_part);
            }
        }
        needs
    }

    /// Memory that the drives of a bus need for complete recordings, with reads as often as configured or, if the
    /// line cannot carry that, as often as the line allows at best. A bus without a recorder needs none.
    pub fn of(bus: &BusSpec, drives: &[DriveSpec], options: &RecorderOptions) -> Budget {
        if options.max_count == 0 {
            return Budget {
                samples: vec![0; drives.len()],
                notes: 0,
                frames: 0,
            };
        }
        let plans: Vec<Plan> = drives.iter().map(|drive| Plan::of(&drive.profile)).collect();
        let round = |class: PollClass, cadence: Duration| {
            let reads = plans
                .iter()
                .flat_map(|plan| &plan.reads)
                .filter(|read| read.class == class);
            let wire: Duration = reads.map(|read| least_wire(bus, read)).sum();
            options.window().as_secs_f64() / wire.max(cadence).as_secs_f64().max(1e-4)
        };
        let rounds = |class| match class {
            PollClass::Fast => round(PollClass::Fast, bus.cycle),
            PollClass::Slow => round(PollClass::Slow, bus.slow_cycle),
            PollClass::Once | PollClass::Fault | PollClass::Monitor => 1.0,
            PollClass::Never => 0.0,
        };
        let of = |plan: &Plan, size: &dyn Fn(&PlannedRead) -> usize| -> usize {
            let reads = plan.all();
            let bytes: f64 = reads.map(|read| rounds(read.class) * size(read) as f64).sum();
            (bytes * RESERVE) as usize
        };
        let sample = |read: &PlannedRead| packed_read(usize::from(read.count));
        let frames = |read: &PlannedRead| {
            let pdu = read.pdu();
            let (asked, answered) = (bus.protocol.request_chars(&pdu), bus.protocol.reply_chars(&pdu));
            packed_frame(asked) + packed_frame(answered)
        };
        let line: usize = plans.iter().map(|plan| of(plan, &frames)).sum();
        Budget {
            samples: plans.iter().map(|plan| of(plan, &sample).max(LEAST)).collect(),
            notes: NOTES,
            frames: line.max(LEAST),
        }
    }

    /// Memory of all rings of the bus, bytes.
    pub fn total(&self) -> usize {
        let drives: usize = self.samples.iter().map(|samples| samples + self.notes).sum();
        drives + self.frames
    }

    /// Memory of all rings with the room by which they grow, bytes.
    pub fn with_growth(&self) -> usize {
        self.total() / packed_ring::STEPS * (packed_ring::STEPS + 1)
    }
}

/// The part of `wanted` that fits into `room`, in millionths.
fn part(room: usize, wanted: usize) -> usize {
    (room.saturating_mul(1_000_000) / wanted.max(1)).min(1_000_000)
}

fn scaled(bytes: usize, part: usize) -> usize {
    bytes.saturating_mul(part) / 1_000_000
}

/// Shortest possible time of a transaction: the drive answers at once and the line has no silence. No line is faster.
fn least_wire(bus: &BusSpec, read: &PlannedRead) -> Duration {
    WireTime::of(bus.protocol, &bus.format, &read.pdu()).total(Duration::ZERO, Duration::ZERO)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn budget(drives: usize, samples: usize, frames: usize) -> Budget {
        Budget {
            samples: vec![samples; drives],
            notes: NOTES,
            frames,
        }
    }

    #[test]
    fn what_fits_is_left_as_it_is_and_the_rest_is_shared() {
        let few = vec![budget(31, 40 << 10, 300 << 10); 4];
        assert_eq!(Budget::shared(few.clone()), few);
        for (buses, samples, frames) in [
            (32, 16 << 10, 300 << 10),
            (32, 200 << 10, 1 << 20),
            (200, 16 << 10, 16 << 10),
        ] {
            let shared = Budget::shared(vec![budget(31, samples, frames); buses]);
            let total: usize = shared.iter().map(Budget::total).sum();
            assert!(
                (MOST_BYTES / 10 * 9..=MOST_BYTES).contains(&total),
                "{buses} buses take {total}"
            );
            let least = shared.iter().map(|bus| bus.notes.min(bus.samples[0])).min();
            assert!(
                least.is_some_and(|bytes| bytes >= 800),
                "{buses} buses: {least:?} bytes"
            );
        }
    }
}
