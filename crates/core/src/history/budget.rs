//! Memory of the rings. Pure.

use std::time::Duration;

use super::RecorderOptions;
use super::packed_ring::{packed_frame, packed_read};
use crate::drive::plan::WireTime;
use crate::drive::{Plan, PlannedRead, PollClass};
use crate::process_image::{BusSpec, DriveSpec};

/// Bytes of events and commands of a drive.
pub const NOTES: usize = 64 << 10;
/// Room beside the planned reads: retries, reads that commands ask for, reads after a fault.
const RESERVE: f64 = 1.25;
/// Rings below that size are not worth while.
const LEAST: usize = 16 << 10;

/// Memory that the recorder takes for a bus at most.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Budget {
    /// Samples of each drive, bytes.
    pub samples: Vec<usize>,
    /// Events and commands of each drive, bytes.
    pub notes: usize,
    /// Frames of the line, bytes.
    pub frames: usize,
}

impl Budget {
    /// What the drives of a bus need so that nothing is left out of a recording: as often as they are to be read or, where the
    /// line cannot carry that, as often as it can at best. A bus whose recorder is off needs nothing.
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
            PollClass::Once | PollClass::Fault => 1.0,
            PollClass::Never => 0.0,
        };
        let of = |plan: &Plan, size: &dyn Fn(&PlannedRead) -> usize| -> usize {
            let reads = plan.reads.iter().chain(&plan.on_fault);
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

    /// All of it, bytes.
    pub fn total(&self) -> usize {
        let drives: usize = self.samples.iter().map(|samples| samples + self.notes).sum();
        drives + self.frames
    }
}

/// Time of an exchange with a drive that answers at once, on a line without silence: no line is faster.
fn least_wire(bus: &BusSpec, read: &PlannedRead) -> Duration {
    WireTime::of(bus.protocol, &bus.format, &read.pdu()).total(Duration::ZERO, Duration::ZERO)
}
