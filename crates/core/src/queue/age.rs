//! Orders that are no longer valid: too old, from a disconnected client, or superseded by a stop. Pure: time is an
//! argument.

use std::time::{Duration, Instant};

use super::Pending;
use crate::order::{Command, Outcome, Urgency};
use drivegate_model::drive::DriveIndex;

impl Pending {
    /// Ends the orders that have expired. An accepted stop is sent, however long it waits.
    pub(super) fn expire(&mut self, now: Instant) {
        let mut index = 0;
        while let Some(command) = self.waiting.get(index) {
            let is_late = command.intent.window.expires <= now && !command.is_stop();
            match is_late.then(|| self.waiting.remove(index)).flatten() {
                Some(command) => self.end_unwanted(command, &Outcome::Expired, now),
                None => index += 1,
            }
        }
    }

    /// Ends an order that is not sent. Where a pause of the process was the cause, the order still renews the lease of
    /// its client.
    pub(super) fn end_unwanted(&mut self, command: Command, outcome: &Outcome, now: Instant) {
        let arrival = &command.intent.window.arrival;
        let waited = self.gate.paused().is_some_and(|pause| arrival.asked < pause.ended);
        let by_pause = waited || arrival.stall.is_some() || arrival.pause.is_some();
        let unwanted = matches!(outcome, Outcome::Expired | Outcome::Purged);
        if by_pause && unwanted {
            self.renew_by(&command);
        }
        command.answer(outcome, now);
    }

    /// Renews the leases by an order that the gateway itself keeps from its drives: its client is there.
    pub(super) fn renew_by(&mut self, command: &Command) {
        let origin = command.ticket.origin();
        if command.urgency() == Urgency::Read || !origin.kind.is_client() {
            return;
        }
        for drive in command.reach() {
            if self.gate.hold_renews(drive, origin) && !self.renewed.contains(&drive) {
                self.renewed.push(drive);
            }
        }
    }

    /// Whether an order that a pause or a reload kept from this drive renews its lease, once.
    pub fn take_renewed(&mut self, drive: DriveIndex) -> bool {
        let place = self.renewed.iter().position(|renewed| *renewed == drive);
        place.is_some_and(|place| self.renewed.swap_remove(place) == drive)
    }

    /// Ages all waiting commands after the machine was suspended for this time, during which its clock did not advance.
    pub fn slept(&mut self, time: Duration) {
        let earlier = |at: Instant| at.checked_sub(time).unwrap_or(at);
        for command in &mut self.waiting {
            let window = &mut command.intent.window;
            window.expires = earlier(window.expires);
            window.arrival.asked = earlier(window.arrival.asked);
        }
    }
}
