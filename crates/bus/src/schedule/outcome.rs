//! Applies the result of a poll: presence, retries, back-off. The pauses between probes of a silent drive and between
//! attempts of a refused block are in `drives`; commands are retried by `command_run`.

use std::time::{Duration, Instant};

use super::drives::{MUTE_PAUSE, Presence};
use super::{Change, Poll, Polled, Schedule};
use drivegate_model::drive::{DriveIndex, PollClass};

/// Garbled answers in a row after which a drive counts as offline: something is present but cannot be read.
const MOST_GARBLED: u32 = 8;

impl Schedule {
    pub(super) fn answered(&mut self, poll: &Poll, polled: Polled, now: Instant) -> Change {
        let slow = self.cadence.slow;
        let drive = self.drives.of_mut(poll.drive);
        drive.failures = 0;
        drive.garbled = 0;
        drive.unanswered = false;
        drive.tried = true;
        drive.doubted = false;
        let came = drive.presence != Presence::Online;
        if came {
            drive.presence = Presence::Online;
            drive.early.answers_again(now);
            drive.probes = 0;
            // The drive answers again, but not the read whose failure made it offline.
            if let Some(vain) = drive.failed_read.take().filter(|vain| *vain != poll.read) {
                drive.in_vain(vain, Duration::ZERO, now);
                drive.set_apart(poll.read, now);
            }
            if self.round_started.is_none() {
                self.round_due = self.round_due.min(now);
            }
            for item in &mut drive.items {
                item.is_pending = item.read.class != PollClass::Fault;
                item.due = now;
                item.is_answered = false;
                if !item.never_answers {
                    item.failures = 0;
                }
            }
        }
        let mut change = Change::None;
        if let Polled::Refused(exception) = polled {
            change = drive.refused(poll.read, exception, now);
        } else if let Some(item) = drive.items.iter_mut().find(|i| i.read == poll.read) {
            item.failures = 0;
            item.unread = false;
            item.is_answered = true;
            (item.refusals, item.busy) = (0, 0);
            let was_in_vain = [&mut item.refused, &mut item.never_answers].map(std::mem::take);
            if was_in_vain.contains(&true) {
                // The bad point is readable again, so it is read together with its neighbours.
                item.whole_again = Some(now);
            }
            item.is_pending = matches!(item.read.class, PollClass::Fast | PollClass::Slow);
            if item.read.class == PollClass::Slow {
                let next = item.due + slow;
                // A slow read made early for a command is due a whole cycle later.
                let early = item.due > now;
                item.due = if next < now || early { now + slow } else { next };
            }
        }
        if came {
            self.state_first(poll.drive, Some(poll.read));
            return Change::Online;
        }
        change
    }

    pub(super) fn failed(&mut self, poll: &Poll, took: Duration, now: Instant) -> Change {
        let drive = self.drives.of_mut(poll.drive);
        let retries = drive.retries;
        if let Presence::Away(_, pause) = drive.presence {
            drive.failures += 1;
            drive.probes += usize::from(drive.tried);
            // A drive that has just answered another request is present, so the request is repeated at once.
            if (!drive.tried || drive.heard) && drive.failures <= retries {
                drive.presence = Presence::Away(now, pause);
                return Change::None;
            }
            let first = !drive.tried;
            drive.tried = true;
            if first {
                (drive.failed_read, drive.probes) = (Some(poll.read), 0);
            }
            drive.probe_failed(now, took);
            return if first { Change::Offline } else { Change::None };
        }
        drive.unanswered = true;
        if !drive.shows_presence(&poll.read) {
            // A request that is never answered must not make the drive offline while its process data is received.
            let mut in_vain = false;
            if let Some(item) = drive.items.iter_mut().find(|i| i.read == poll.read) {
                item.failures += 1;
                item.failed_at = Some(now);
                item.due = now;
                in_vain = item.failures > retries;
            }
            if in_vain {
                drive.in_vain(poll.read, took, now);
            }
            self.ask_whether_it_answers(poll.drive, now);
            return Change::None;
        }
        drive.failures += 1;
        drive.troubled = Some(now);
        // While this request is retried, the drive gets no other request; a damaged reply shows that the drive is present.
        drive.doubted &= drive.failures <= retries && poll.read.class == PollClass::Fast;
        if drive.failures <= retries {
            if poll.read.class == PollClass::Fast {
                self.round.push_front((poll.drive, poll.read));
            }
            return Change::None;
        }
        drive.probe_failed(now, took);
        (drive.failed_read, drive.probes) = (Some(poll.read), 0);
        drive.failures = 0;
        drive.garbled = 0;
        self.round.retain(|(index, _)| *index != poll.drive);
        self.state_first.retain(|(index, _)| *index != poll.drive);
        Change::Offline
    }

    /// Reads the process data of a drive now that did not answer another request, although its round is not due:
    /// slow reads wait for the result.
    fn ask_whether_it_answers(&mut self, index: DriveIndex, now: Instant) {
        if !self.round.is_empty() {
            return;
        }
        let fast = self.drives.of(index).items.iter();
        let fast = fast.filter(|item| item.is_process_data() && item.due <= now);
        self.round.extend(fast.map(|item| (index, item.read)));
    }

    pub(super) fn garbled(&mut self, poll: &Poll, took: Duration, now: Instant) -> Change {
        let drive = self.drives.of_mut(poll.drive);
        let retries = drive.retries;
        let counts = drive.shows_presence(&poll.read);
        if drive.presence != Presence::Online || !counts || drive.garbled >= MOST_GARBLED.max(retries) {
            return self.failed(poll, took, now);
        }
        drive.garbled += 1;
        drive.doubted = false;
        drive.troubled = Some(now);
        if poll.read.class == PollClass::Fast {
            if drive.garbled <= retries {
                self.round.push_front((poll.drive, poll.read));
            }
        } else if let Some(item) = drive.items.iter_mut().find(|i| i.read == poll.read) {
            item.due = if drive.garbled <= retries {
                now
            } else {
                now + MUTE_PAUSE.0
            };
        }
        Change::None
    }
}
