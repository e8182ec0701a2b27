//! Requests forwarded for a tool, and the gateway's own broadcasts: decides when they may be sent, and sends them.

use std::sync::Arc;
use std::time::Instant;

use super::awaited_direction::waits_for_direction;
use super::background::{ChosenTransaction, Sending};
use super::choose::may_begin;
use super::permission::AtTurn;
use super::waits::Waits;
use super::{Master, Turn};
use crate::drive_state::DriveState;
use crate::schedule::{Admission, Schedule};
use drivegate_core::order::{Command, Order, Outcome, Pace, PassedOn};
use drivegate_core::process_image::DriveImage;
use drivegate_core::queue::{Choice, Pending, Ready};
use drivegate_model::drive::PerDrive;

/// Ends passed-on requests whose tool has disconnected, or has sent another one.
pub(super) fn drop_unwanted(pending: &mut Pending, now: Instant) {
    let unwanted = |passed_on: &PassedOn| passed_on.frame.is_closed();
    pending.remove(now, &Outcome::Replaced, |c| c.as_passed_on().is_some_and(unwanted));
}

impl Master {
    /// The next order to pass on to drives of the bus, if it may be sent while no command is urgent.
    pub(super) fn pass_on(&mut self, idle: bool, now: Instant) -> Result<Turn, Option<Instant>> {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        if pending.is_empty() {
            return Err(None);
        }
        let Choice {
            chosen,
            wake_at: blocked,
        } = self.next_passed_on(&mut pending, now);
        let Some((chosen, command)) = chosen.and_then(|chosen| Some((chosen, pending.get(chosen)?))) else {
            return Err(blocked);
        };
        let Order::Write(pdu) = &command.intent.order else {
            return Err(blocked);
        };
        let cost = self.exchange_cost(command.intent.target, pdu);
        let admission = self.schedule.admits_background(Pace::Brisk, cost, idle, now);
        if let Admission::NotBefore(at) = admission {
            return Err(blocked.into_iter().chain([at]).min());
        }
        let command = pending.take(chosen).ok_or(blocked)?;
        drop(pending);
        self.begin_passed_on(command, Some(admission), now).ok_or(None)
    }

    /// The next request to pass on, and when to check again if one must wait.
    fn next_passed_on(&mut self, pending: &mut Pending, now: Instant) -> Choice {
        let Master {
            drives,
            schedule,
            bus,
            waits,
            ..
        } = self;
        let facts = AtTurn::of(drives, &bus.image.drives, now);
        let ready = |command: &Command| is_ready(command, schedule, waits, drives, &bus.image.drives, now);
        pending.next_passed_on(now, &facts, ready)
    }

    /// The broadcast of a stop of all drives, which is sent before their single stops if that is possible at once.
    pub(super) fn broadcast_stop(&mut self, now: Instant) -> Option<Turn> {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        let chosen = pending.first_of_all(now)?;
        let Master { drives, waits, .. } = self;
        let ready = waits.may_pass_on(pending.get(chosen)?, drives, now);
        (ready == Ready::Now).then_some(())?;
        let command = pending.take(chosen)?;
        drop(pending);
        self.begin_passed_on(command, None, now)
    }

    /// The broadcast for the shutdown, if the line is free for it.
    ///
    /// # Errors
    /// When to check again; `None` if no stop waits.
    pub(super) fn stop_the_line(&mut self, now: Instant) -> Result<Turn, Option<Instant>> {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        let Choice {
            chosen,
            wake_at: blocked,
        } = self.next_passed_on(&mut pending, now);
        let command = chosen.and_then(|chosen| pending.take(chosen)).ok_or(blocked)?;
        drop(pending);
        self.begin_passed_on(command, None, now).ok_or(None)
    }

    /// Starts a passed-on request that was taken from the queue.
    pub(super) fn begin_passed_on(
        &mut self,
        command: Command,
        admission: Option<Admission>,
        now: Instant,
    ) -> Option<Turn> {
        if command.drive().is_some_and(|drive| !self.schedule.is_online(drive)) {
            command.answer(&Outcome::Offline, now);
            return None;
        }
        let begun = self.background.insert(ChosenTransaction {
            sending: Sending::Command(Box::new(command)),
            admission,
            sent: false,
        });
        begun.turn()
    }
}

/// Whether the drives of a queued command are ready for it. A single drive that is offline does not count: the
/// command is answered for it.
pub(super) fn is_ready(
    command: &Command,
    schedule: &mut Schedule,
    waits: &mut Waits,
    drives: &mut PerDrive<DriveState>,
    images: &PerDrive<Arc<DriveImage>>,
    now: Instant,
) -> Ready {
    let drive = command.drive().filter(|_| command.as_passed_on().is_none());
    match drive {
        Some(index) => {
            let (drive, profile) = (drives.of_mut(index), &images.of(index).spec.profile);
            waits_for_direction(command, index, drive, profile, schedule, now)
                .unwrap_or_else(|| may_begin(drive, command, schedule.is_online(index), now))
        }
        None => waits.may_pass_on(command, drives, now),
    }
}
