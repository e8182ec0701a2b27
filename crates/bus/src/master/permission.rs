//! The state of the drives that the master reports to the gate, and the check before each frame of a started command.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Master;
use crate::command_run::{CommandRun, Need};
use crate::drive_state::{DriveState, NextNeed};
use crate::supervision::written_run;
use drivegate_core::order::{Outcome, Urgency};
use drivegate_core::permit::{Ask, DriveFacts, Facts, LastWritten, Repeats, Stage, Verdict};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::DriveImage;
use drivegate_core::queue::Denied;
use drivegate_model::drive::{DriveIndex, PerDrive};

/// Maximum age of the frequency range on which a command depends when it is about to be sent. Whether the range was
/// too old for the command was decided when the command was accepted.
const RANGE_AGE: Duration = Duration::from_secs(60);

/// State of the drives when a command is about to be sent.
pub(super) struct AtTurn {
    images: PerDrive<Arc<DriveImage>>,
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
        Some(DriveFacts {
            reading: self.images.of(drive).reading(self.now, RANGE_AGE),
            written: Some(*self.written.of(drive)),
            run: *self.run.of(drive),
            repeats: None,
        })
    }
}

/// State of a drive when a frame of a started command to it is about to be sent.
fn at_write<'a>(drive: &DriveState, image: &'a DriveImage, repeats: Option<Repeats>, now: Instant) -> DriveFacts<'a> {
    DriveFacts {
        reading: image.reading(now, RANGE_AGE),
        written: Some(drive.written),
        run: written_run(&image.spec.profile, &drive.words),
        repeats,
    }
}

/// Whether the next frame of a started command may be sent. A stop and the end of a pulse are always sent.
fn may_write(bus: &BusHandle, index: DriveIndex, run: &CommandRun, seen: &DriveFacts<'_>, now: Instant) -> Verdict {
    if !run.is_judged() {
        return Verdict::Go;
    }
    let ask = Ask {
        stage: Stage::Write,
        now,
        drive: index,
        intent: run.intent(),
        origin: run.ticket().origin(),
        seen: Some(seen),
    };
    bus.queue.lock().gate.ask(&ask)
}

/// The next need of the started commands of a drive, after those that may not continue have ended. Where the gate must know
/// whether the motor runs, the need is the read of that.
pub(super) fn next_need(
    bus: &BusHandle,
    index: DriveIndex,
    drive: &mut DriveState,
    image: &DriveImage,
    want: impl Fn(&mut DriveState) -> Need<NextNeed>,
    now: Instant,
) -> NextNeed {
    loop {
        let (wanted, repeats) = match want(drive) {
            Need::Next(wanted @ NextNeed::Step(Urgency::Command, _)) => (wanted, None),
            Need::Next(wanted) => return wanted,
            Need::Judge(repeats) => (NextNeed::Nothing, Some(repeats)),
        };
        let seen = at_write(drive, image, repeats, now);
        let Some(run) = drive.run(Urgency::Command) else {
            return wanted;
        };
        let verdict = may_write(bus, index, run, &seen, now);
        let is_of_word = repeats.is_some_and(|repeats| repeats.verdict() == verdict);
        match (verdict, repeats) {
            (Verdict::Wait(until), _) => return NextNeed::Wait(until),
            (Verdict::Refuse(outcome), _) if !is_of_word => deny(bus, index, run, outcome),
            // If the state of the drive forbids the word, the result of the command says so; there is no event.
            (verdict, Some(repeats)) => run.judged(repeats, verdict),
            (_, None) => return wanted,
        }
    }
}

/// Ends a started command; its refusal is reported like an immediate one.
fn deny(bus: &BusHandle, drive: DriveIndex, run: &mut CommandRun, outcome: Outcome) {
    if let Outcome::Refused(refusal) = &outcome {
        let denied = Denied {
            drive,
            origin: run.ticket().origin().clone(),
            what: run.ticket().what().to_string(),
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
        let seen = at_write(drive, image, None, now);
        let Some(run) = drive.run(slot).filter(|run| run.is_judged()) else {
            return true;
        };
        // A denied command is refused, or made to wait, at the next choice.
        matches!(
            may_write(&self.bus, index, run, &seen, now),
            Verdict::Go | Verdict::LookFirst
        )
    }
}
