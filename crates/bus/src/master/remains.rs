//! What a bus still keeps of past faults and commands: nothing, after a while without faults. Pure.

use std::time::Instant;

use super::Master;
use crate::drive_state::DriveState;

/// State that a bus still keeps of failed transactions and of started commands. On a sound line without commands
/// all of it ends by itself and equals `Default`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Remains {
    /// Requests whose late replies may still arrive.
    pub late_replies: usize,
    /// Addresses without a configured drive from which one may.
    pub strangers: usize,
    /// Commands that were started and are not over.
    pub begun: usize,
    /// Number of waiting commands and forwarded reads; one more if background requests wait.
    pub waiting: usize,
    /// Acknowledged commands whose effect is waited for.
    pub unconfirmed: usize,
    /// Drives to which the next stop waits.
    pub held_stops: usize,
    /// Leases that expired and whose action is not acknowledged.
    pub owed_actions: usize,
    /// Number of drives that do not answer.
    pub away: usize,
    /// Number of reads that wait after failures: a read was not answered, or a command requested it and it is not done.
    pub held_reads: usize,
    /// Parts of reads that a drive refused or left unanswered as a whole, and that are joined again later.
    pub parts: usize,
}

impl Master {
    /// The state left over from faults and commands at `now`.
    pub fn remains(&self, now: Instant) -> Remains {
        let (away, held_reads) = self.schedule.held(now);
        let late = self.drives.iter().map(|drive| drive.late.owed(now));
        let sum = |of: fn(&DriveState) -> bool| self.drives.iter().filter(|drive| of(drive)).count();
        Remains {
            late_replies: late.sum::<usize>() + self.waits.n2_late.owed(now),
            strangers: self.waits.strangers.values().filter(|late| late.may_come(now)).count(),
            begun: sum(DriveState::has_runs) + usize::from(self.background_of_others()),
            waiting: self.bus.queue.lock().len() + usize::from(self.bus.queue.background().has_of_others()),
            unconfirmed: sum(|drive| !drive.confirmations.is_empty()),
            held_stops: self
                .drives
                .iter()
                .filter(|drive| drive.vain_stops.waits_until(now).is_some())
                .count(),
            owed_actions: sum(|drive| drive.supervision.owes_action()),
            away,
            held_reads,
            parts: self.schedule.parts(),
        }
    }
}
