//! Effects of a stall of the thread: on leases, waiting commands, and started commands.

use std::time::{Duration, Instant};

use super::Master;
use drivegate_core::order::Urgency;
use drivegate_core::stalls::Stall;

impl Master {
    /// The thread did not run until `now`. Waiting commands are judged by that when they are chosen again. A command of
    /// several steps that a pause interrupted is not continued, except for the end of a pulse. What a command has read of
    /// its drive is read again: the drive may have restarted during the stall.
    pub(crate) fn after_stall(&mut self, stall: Stall, now: Instant) {
        let slept = stall.slept;
        self.prolong(stall.length());
        if let Some(starts) = &mut self.waits.starts {
            starts.after_stall(stall);
        }
        let mut queue = self.bus.queue.lock();
        if stall.is_pause() {
            queue.gate.note_pause(stall);
        }
        if !slept.is_zero() {
            queue.slept(slept);
        }
        drop(queue);
        for (drive, image) in self.drives.iter_mut().zip(&self.bus.image.drives) {
            if stall.is_pause() {
                drive.refresh.after_stall(stall.length(), now);
            } else {
                drive.refresh.others_go_first(false, &image.spec.profile);
            }
            if let Some(run) = drive.run(Urgency::Command) {
                run.others_go_first();
            }
            for urgency in [Urgency::Command, Urgency::Read] {
                if let Some(run) = drive.run(urgency).filter(|_| stall.is_pause()) {
                    run.interrupted(slept, now);
                }
            }
        }
        if !slept.is_zero() {
            for image in &self.bus.image.drives {
                image.update(|snapshot| snapshot.slept(slept));
            }
        }
    }

    /// Prolongs the leases by a time during which the gateway did not run and received nothing.
    pub(crate) fn prolong(&mut self, time: Duration) {
        for (drive, image) in self.drives.iter_mut().zip(&self.bus.image.drives) {
            if let Some(supervision) = &image.spec.supervision {
                drive.supervision.prolong(time, supervision.timeout);
            }
        }
    }
}
