//! Requests forwarded for a tool, and the gateway's own broadcasts: when they may be sent, and the sending.

use std::sync::Arc;
use std::time::Instant;

use super::background::Begun;
use super::waits::Waits;
use super::{Master, Turn};
use crate::command::{BackgroundRequest, Chosen, Command, NO_DRIVE, Order, Outcome, Pace, PassedOn, Pending, Refusal};
use crate::drive::PerDrive;
use crate::drive_state::DriveState;
use crate::process_image::DriveImage;
use crate::schedule::Admission;

/// Why what is passed on may not go: a drive that it reaches takes no commands but stops.
fn held(passed_on: &PassedOn, drives: &PerDrive<Arc<DriveImage>>) -> Option<Outcome> {
    let reached = passed_on
        .reach
        .iter()
        .filter(|drive| passed_on.may_write && !passed_on.stops.contains(*drive));
    let why = reached
        .filter_map(|drive| drives.get(*drive))
        .find_map(|image| image.hold.why());
    why.map(|why| Outcome::Refused(Refusal::NotAllowed(why.to_string())))
}

/// Ends passed-on requests that can no longer be sent: unwanted, or not permitted.
pub(super) fn drop_in_vain(pending: &mut Pending, drives: &PerDrive<Arc<DriveImage>>, now: Instant) {
    let unwanted = |passed_on: &PassedOn| passed_on.frame.is_closed();
    pending.remove(now, &Outcome::Replaced, |c| c.passed_on.as_ref().is_some_and(unwanted));
    for why in drives.iter().filter_map(|image| image.hold.why()) {
        let outcome = Outcome::Refused(Refusal::NotAllowed(why.to_string()));
        let is_held = |passed_on: &PassedOn| held(passed_on, drives).as_ref() == Some(&outcome);
        pending.remove(now, &outcome, |c| c.passed_on.as_ref().is_some_and(is_held));
    }
}

impl Master {
    /// The order that is passed on next to drives of the bus, if it may go where nothing is in a hurry.
    pub(super) fn pass_on(&mut self, idle: bool, now: Instant) -> Result<Turn, Option<Instant>> {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        if pending.is_empty() {
            return Err(None);
        }
        let (chosen, blocked) = self.next_passed_on(&mut pending, now);
        let Some((chosen, command)) = chosen.and_then(|chosen| Some((chosen, pending.get(chosen)?))) else {
            return Err(blocked);
        };
        let Order::Write(pdu) = &command.order else {
            return Err(blocked);
        };
        let cost = self.exchange_cost(command.drive, pdu);
        let admission = self.schedule.admits_background(Pace::Brisk, cost, idle, now);
        if let Admission::NotBefore(at) = admission {
            return Err(blocked.into_iter().chain([at]).min());
        }
        let command = pending.take(chosen).ok_or(blocked)?;
        drop(pending);
        self.begin_passed_on(command, Some(admission), now).ok_or(None)
    }

    /// The next request to pass on, and when to check again if one must wait.
    fn next_passed_on(&mut self, pending: &mut Pending, now: Instant) -> (Option<Chosen>, Option<Instant>) {
        let mut blocked: Option<Instant> = None;
        let Master {
            drives,
            schedule,
            waits,
            ..
        } = self;
        let chosen = pending.next_passed_on(now, |command| {
            let online = schedule.is_online(command.drive);
            may_go(command, online, waits, drives, now).unwrap_or_else(|until| {
                blocked = blocked.into_iter().chain([until]).min();
                false
            })
        });
        if let Some(starts) = &mut waits.starts {
            starts.refuse(pending, now);
        }
        (chosen, blocked)
    }

    /// The broadcast of a stop of all drives, which goes before their own stops where it can go at once.
    pub(super) fn broadcast_stop(&mut self, now: Instant) -> Option<Turn> {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        let chosen = pending.first_of_all(now)?;
        let Master { drives, waits, .. } = self;
        waits
            .may_pass_on(pending.get(chosen)?, drives, now)
            .is_ok_and(|may| may)
            .then_some(())?;
        let command = pending.take(chosen)?;
        drop(pending);
        self.begin_passed_on(command, None, now)
    }

    /// The broadcast of the shutdown, if it may go: the line is free for it.
    ///
    /// # Errors
    /// When to look again; none where none waits.
    pub(super) fn stop_the_line(&mut self, now: Instant) -> Result<Turn, Option<Instant>> {
        let queue = self.bus.queue.clone();
        let mut pending = queue.lock();
        let (chosen, blocked) = self.next_passed_on(&mut pending, now);
        let command = chosen.and_then(|chosen| pending.take(chosen)).ok_or(blocked)?;
        drop(pending);
        self.begin_passed_on(command, None, now).ok_or(None)
    }

    /// Begins what is passed on and was taken from the queue.
    pub(super) fn begin_passed_on(
        &mut self,
        command: Command,
        admission: Option<Admission>,
        now: Instant,
    ) -> Option<Turn> {
        let held = command.passed_on.as_ref().and_then(|p| held(p, &self.bus.image.drives));
        let away = command.drive != NO_DRIVE && !self.schedule.is_online(command.drive);
        let lost = || self.bus.judges_turn(&command, now).0.map(Outcome::Refused);
        let in_vain = held.or(away.then_some(Outcome::Offline)).or_else(lost);
        if let Some(outcome) = in_vain {
            command.answer(&outcome, now);
            return None;
        }
        let Command {
            drive,
            order: Order::Write(pdu),
            expires,
            ticket,
            touched,
            passed_on,
            number,
            effects,
            ..
        } = command
        else {
            command.answer(&Outcome::Expired, now);
            return None;
        };
        let request = BackgroundRequest {
            drive,
            pdu,
            pace: Pace::Brisk,
            expires,
            ticket,
            passed_on,
        };
        let begun = self.background.insert(Begun {
            request,
            admission,
            ordered: Some(touched),
            sent: false,
            number,
            effects,
        });
        Some(begun.turn())
    }
}

/// Whether what is passed on, or the stop before it, can go. One drive that is away answers for itself.
pub(super) fn may_go(
    command: &Command,
    online: bool,
    waits: &mut Waits,
    drives: &mut PerDrive<DriveState>,
    now: Instant,
) -> Result<bool, Instant> {
    if let Some((quiet, until)) = waits.quiet
        && command.reaches(quiet)
        && !command.stops(quiet)
    {
        return Err(until);
    }
    let may = match &command.passed_on {
        Some(_) => waits.may_pass_on(command, drives, now)?,
        None => match drives.get_mut(command.drive) {
            Some(drive) => super::choose::may_begin(drive, command, online, now)?,
            None => true,
        },
    };
    // A request to an absent drive is answered, and starts nothing.
    let goes = may && (online || command.passed_on.is_some());
    match waits.starts.as_mut().filter(|_| goes) {
        Some(starts) => starts.may_go(command, now),
        None => Ok(may),
    }
}
