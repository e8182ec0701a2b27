//! The state of the drives that the master reports to the gate, and the check before each frame of a started command.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Master;
use crate::command_run::CommandRun;
use crate::drive_state::{DriveState, NextNeed};
use crate::supervision::written_run;
use drivegate_core::order::{Outcome, Urgency};
use drivegate_core::permit::{Ask, DriveFacts, Facts, LastWritten, Stage, Verdict};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::DriveImage;
use drivegate_core::queue::Denied;
use drivegate_model::drive::{DriveIndex, PerDrive};

/// Maximum age of the frequency range on which a command depends when it is about to be sent. Whether the range was
/// too old for the command was decided when the command was accepted.
const RANGE_AGE: Duration = Duration::from_secs(60);

/// State of the drives when a command is about to be sent.
pub(super) struct AtTurn {
    images: Vec<Arc<DriveImage>>,
    written: PerDrive<LastWritten>,
    run: PerDrive<Option<bool>>,
    now: Instant,
}

impl AtTurn {
    pub(super) fn of(drives: &PerDrive<DriveState>, images: &PerDrive<Arc<DriveImage>>, now: Instant) -> AtTurn {
        AtTurn {
            images: images.iter().cloned().collect(),
            written: drives.iter().map(|drive| drive.written).collect(),
            run: drives
                .iter()
                .zip(images)
                .map(|(drive, image)| written_run(&image.spec.profile, &drive.words))
                .collect(),
            now,
        }
    }
}

impl Facts for AtTurn {
    fn seen(&self, drive: DriveIndex) -> Option<DriveFacts<'_>> {
        let reading = self.images.get(drive.place())?.reading(self.now, RANGE_AGE);
        let written = self.written.get(drive).copied();
        let run = self.run.get(drive).copied().flatten();
        Some(DriveFacts { reading, written, run })
    }
}

/// Whether the next frame of a started command may be sent. A stop and the end of a pulse are always sent.
pub(super) fn may_write(
    bus: &BusHandle,
    index: DriveIndex,
    image: &DriveImage,
    (run, written, commanded): (&CommandRun, LastWritten, Option<bool>),
    now: Instant,
) -> Verdict {
    if run.urgency() != Urgency::Command || !run.may_write_on() {
        return Verdict::Go;
    }
    let Some(origin) = run.origins().next() else {
        return Verdict::Go;
    };
    let seen = DriveFacts {
        reading: image.reading(now, RANGE_AGE),
        written: Some(written),
        run: commanded,
    };
    let ask = Ask {
        stage: Stage::Write,
        now,
        drive: index,
        intent: run.intent(),
        origin,
        seen: Some(&seen),
    };
    bus.queue.lock().gate.ask(&ask)
}

/// The next need of the started commands of a drive, after those that may not continue have ended.
pub(super) fn next_need(
    bus: &BusHandle,
    index: DriveIndex,
    (drive, image): (&mut DriveState, &DriveImage),
    want: impl Fn(&mut DriveState) -> NextNeed,
    now: Instant,
) -> NextNeed {
    loop {
        let wanted = want(drive);
        let NextNeed::Step(slot @ Urgency::Command, _) = wanted else {
            return wanted;
        };
        let (written, commanded) = (drive.written, written_run(&image.spec.profile, &drive.words));
        let Some(run) = drive.run(slot) else { return wanted };
        match may_write(bus, index, image, (run, written, commanded), now) {
            Verdict::Go | Verdict::LookFirst => return wanted,
            Verdict::Wait(until) => return NextNeed::Wait(until),
            Verdict::Refuse(outcome) => deny(bus, index, run, outcome),
        }
    }
}

/// Ends a started command; its refusal is reported like an immediate one.
fn deny(bus: &BusHandle, drive: DriveIndex, run: &mut CommandRun, outcome: Outcome) {
    if let (Outcome::Refused(refusal), Some(ticket)) = (&outcome, run.first_ticket()) {
        let denied = Denied {
            drive,
            origin: ticket.origin().clone(),
            what: ticket.what().to_string(),
            refusal: refusal.clone(),
        };
        bus.queue.lock().note_denied(denied);
    }
    run.denied(outcome);
}

impl Master {
    /// Whether a chosen frame of a started command may still be sent.
    pub(super) fn may_still_write(&mut self, index: DriveIndex, slot: Urgency, now: Instant) -> bool {
        let (drive, image) = (self.drives.of_mut(index), self.bus.image.drives.of(index));
        let (written, commanded) = (drive.written, written_run(&image.spec.profile, &drive.words));
        let Some(run) = drive.run(slot) else { return true };
        // A denied command is refused, or made to wait, at the next choice.
        matches!(
            may_write(&self.bus, index, image, (run, written, commanded), now),
            Verdict::Go | Verdict::LookFirst
        )
    }
}
