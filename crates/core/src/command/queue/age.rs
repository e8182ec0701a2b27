//! The age of the orders that wait: asked when they are accepted and when their turn comes. Pure: time is an argument.

use std::time::{Duration, Instant};

use super::Pending;
use crate::command::{Command, Outcome, Urgency};
use crate::drive::DriveIndex;
use crate::order::{Arrival, LastStops, Stall};
use crate::permit::rules::age::{Ask, Does, Verdict, age};

impl Pending {
    /// Whether an order is still wanted.
    pub(super) fn age(&self, command: &Command, now: Instant) -> Verdict {
        let Some(arrival) = &command.arrival else {
            let expired = command.expires <= now && command.urgency != Urgency::Stop;
            return if expired { Verdict::Expired } else { Verdict::Go };
        };
        let verdict = |does: Does, stops: Option<&LastStops>| {
            let ask = Ask {
                arrival,
                does,
                expires: command.expires,
                stops,
                waited: self.paused,
            };
            age(ask, now)
        };
        let of = |drive: &DriveIndex| verdict(command.does(*drive), self.last_stops.get(drive));
        let all = command.reach().iter().map(of).reduce(Verdict::and);
        all.unwrap_or_else(|| verdict(Does::Other, None))
    }

    /// Whether a command of that drive which has its turn may be sent.
    pub fn age_at_write(&self, drive: DriveIndex, arrival: &Arrival, (does, expires): (Does, Instant), now: Instant) -> Verdict {
        let ask = Ask {
            arrival,
            does,
            expires,
            stops: self.last_stops.get(&drive),
            waited: self.paused,
        };
        age(ask, now)
    }

    /// Until when an order waits, so that a stop which came during the same stall is read before it is sent.
    pub(super) fn waits_for_reads(&self, command: &Command, now: Instant) -> Option<Instant> {
        command.arrival.as_ref()?.stall?;
        match self.age(command, now) {
            Verdict::Wait(until) => Some(until),
            Verdict::Go | Verdict::Expired | Verdict::Purged => None,
        }
    }

    /// When the first of the orders that wait for that may be sent.
    pub fn reads_end(&self, now: Instant) -> Option<Instant> {
        self.waiting.iter().filter_map(|c| self.waits_for_reads(c, now)).min()
    }

    /// Ends the orders that are no longer wanted. An accepted stop is sent, however long it waits.
    pub(super) fn expire(&mut self, now: Instant) {
        let mut index = 0;
        while let Some(command) = self.waiting.get(index) {
            let refused = self.age(command, now).refused();
            match refused.and_then(|outcome| Some((self.waiting.remove(index)?, outcome))) {
                Some((command, outcome)) => self.end_unwanted(command, &outcome, now),
                None => index += 1,
            }
        }
    }

    /// Ends an order that is no longer wanted. Where a pause made that of it, its client is heard all the same.
    pub(super) fn end_unwanted(&mut self, command: Command, outcome: &Outcome, now: Instant) {
        let by_pause = |arrival: &Arrival| {
            let waited = self.paused.is_some_and(|pause| arrival.asked < pause.ended);
            waited || arrival.stall.is_some() || arrival.pause.is_some()
        };
        let origin = command.ticket.origin();
        let heard = command.urgency != Urgency::Read && origin.kind.is_client();
        if heard && command.arrival.as_ref().is_some_and(by_pause) {
            for drive in command.reach() {
                if self.hold_renews(*drive, origin) && !self.renewed.contains(drive) {
                    self.renewed.push(*drive);
                }
            }
        }
        command.answer(outcome, now);
    }

    /// Whether an order that a pause kept from that drive renews its lease, once.
    pub fn take_renewed(&mut self, drive: DriveIndex) -> bool {
        let place = self.renewed.iter().position(|renewed| *renewed == drive);
        place.is_some_and(|place| self.renewed.swap_remove(place) == drive)
    }

    /// The bus stood still.
    pub fn note_pause(&mut self, pause: Stall) {
        self.paused = Some(pause);
    }

    /// The machine was suspended for that time, in which its clock stood: what waits is older by it.
    pub fn slept(&mut self, time: Duration) {
        let earlier = |at: Instant| at.checked_sub(time).unwrap_or(at);
        for command in &mut self.waiting {
            command.expires = earlier(command.expires);
            if let Some(arrival) = &mut command.arrival {
                arrival.asked = earlier(arrival.asked);
            }
        }
    }
}
