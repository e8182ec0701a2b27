//! Decides which poll is due: the grid of fast rounds, the credit of slow polls, probes.

use std::cmp::Reverse;
use std::time::{Duration, Instant};

use super::drives::{DriveSchedule, Item, Presence};
use super::{FIRST_SHARE, Poll, PollReason, RoundStart, Schedule};
use drivegate_model::drive::{DriveIndex, PollClass};

impl Schedule {
    /// Slow polls earn their share of all time, including idle time: on a nearly full line, idle moments too short
    /// for any of them do not help. Their larger share at first counts only the time that commands leave:
    /// otherwise, with half of the line used by commands, process data would get nothing.
    pub(super) fn earn(&mut self, now: Instant) {
        let passed = now.saturating_duration_since(self.earned_until);
        self.earned_until = now;
        let of_polls = passed.saturating_sub(std::mem::take(&mut self.commanded));
        let earned = if self.drives.iter().any(DriveSchedule::has_unread) {
            of_polls.mul_f64(FIRST_SHARE)
        } else {
            passed.mul_f64(self.slow_share)
        };
        self.slow_credit = (self.slow_credit + earned).min(self.most_credit);
        let of_slow_polls = std::mem::take(&mut self.slow_took);
        self.background.earn(of_polls.saturating_sub(of_slow_polls));
    }

    pub(super) fn start_round(&mut self, now: Instant) {
        if !self.round.is_empty() || now < self.round_due {
            return;
        }
        self.join_again(now);
        // The first reads of all drives come before the second ones, so that a duplicate reply meets a request to
        // another drive.
        let mut reads = std::mem::take(&mut self.sorted);
        for (index, drive) in self
            .drives
            .enumerate()
            .filter(|(_, d)| d.presence == Presence::Online && !d.is_quiet(now))
        {
            // A round has at most one read of each drive that may get no reply.
            let mut mute = 0;
            let due = drive
                .items
                .iter()
                .filter(|i| i.read.class == PollClass::Fast && i.due <= now)
                .filter(|i| {
                    mute += usize::from(i.never_answers);
                    !i.never_answers || mute == 1
                });
            reads.extend(due.enumerate().map(|(place, i)| (place, index, i.read)));
        }
        reads.sort_by_key(|(place, index, _)| (*place, *index));
        self.round.extend(reads.drain(..).map(|(_, index, read)| (index, read)));
        self.sorted = reads;
        if self.round.is_empty() {
            self.round_due = now + self.cadence.fast;
            self.round_started = None;
            return;
        }
        let cycle = self.round_started.map(|before| now.saturating_duration_since(before));
        self.round_started = Some(now);
        self.new_round = Some(RoundStart { at: now, cycle });
        // The grid is kept whatever delayed this round; missed rounds are not made up for.
        let next = self.round_due + self.cadence.fast;
        let missed = now.saturating_duration_since(next).as_nanos() / self.cadence.fast.as_nanos().max(1);
        self.round_due = next + self.cadence.fast * u32::try_from(missed).unwrap_or(0);
    }

    /// Joins parts of a block that was refused long ago, perhaps by mistake, into one read again.
    fn join_again(&mut self, now: Instant) {
        for drive in &mut self.drives {
            let due = |item: &&Item| item.whole_again.is_some_and(|at| at <= now);
            while let Some(origin) = drive.items.iter().find(due).map(|item| item.origin) {
                drive.join(origin, now);
            }
        }
    }

    pub(super) fn due_poll(&mut self, now: Instant) -> Option<Poll> {
        self.turn = PollReason::Due;
        // Many offline drives must not delay the others: a probe without success is followed by a fast poll.
        let hold = self.probed && !self.round.is_empty();
        if let Some(probe) = self.due_probe(now).filter(|_| !hold) {
            return Some(probe);
        }
        let slow = self.due_slow(now);
        // A whole round had no room for the slow poll: the line is saturated.
        let left_out = |due| now.saturating_duration_since(due) > self.cadence.fast;
        let yields = self.round.front().is_some_and(|front| self.state_first.contains(front));
        let on_credit =
            |(due, _, cost): &(Instant, Poll, Duration)| !yields && self.slow_credit >= *cost && left_out(*due);
        if let Some((_, poll, _)) = slow.filter(on_credit) {
            self.turn = PollReason::OnCredit;
            return Some(poll);
        }
        if let Some(&(drive, read)) = self.round.front() {
            return Some(Poll {
                drive,
                read,
                probe: false,
            });
        }
        // A slow poll in the idle time of a round must not delay the next round.
        let fast_active = self.round_started.is_some();
        slow.filter(|(_, _, cost)| !fast_active || now + *cost <= self.round_due)
            .map(|(_, poll, _)| poll)
    }

    /// The probe of the absent drive that waits longest. Among drives whose probes are due at one time, the drive whose probe
    /// was postponed most often goes first.
    fn due_probe(&self, now: Instant) -> Option<Poll> {
        let due = |drive: &DriveSchedule| match drive.presence {
            Presence::Away(at, _) if at <= now && !drive.is_quiet(now) => Some(at),
            _ => None,
        };
        let mut waiting: Vec<(Instant, Reverse<u32>, DriveIndex)> = self
            .drives
            .enumerate()
            .filter_map(|(index, drive)| Some((due(drive)?, Reverse(drive.put_off), index)))
            .collect();
        waiting.sort();
        waiting.into_iter().find_map(|(_, _, index)| {
            let read = self.drives.of(index).probe()?;
            Some(Poll {
                drive: index,
                read,
                probe: true,
            })
        })
    }

    /// The read requested by a command that has waited longest.
    pub(super) fn due_asked(&self, now: Instant) -> Option<Poll> {
        let online = self.drives.enumerate();
        let online = online.filter(|(_, d)| d.presence == Presence::Online && !d.doubted && !d.is_quiet(now));
        let asked = online.flat_map(|(drive, d)| d.items.iter().map(move |item| (drive, item)));
        let due =
            asked.filter_map(|(drive, item)| Some((item.changed_at.filter(|since| *since <= now)?, drive, item.read)));
        let (_, drive, read) = due.min_by_key(|(since, _, _)| *since)?;
        Some(Poll {
            drive,
            read,
            probe: false,
        })
    }

    fn due_slow(&self, now: Instant) -> Option<(Instant, Poll, Duration)> {
        // Points of the class `once` go first when a drive comes online: commands in percent depend on its
        // frequencies. The bits of the status word follow: register 0x8000 is stale until all of them were read.
        let rank = |drive: &DriveSchedule, due: Instant, item: &Item| {
            let sound = item.failures == 0 && !item.refused;
            let first = item.read.class == PollClass::Once && sound;
            let completes = item.unread && sound && drive.behind_status_word.contains(&item.origin);
            (!first, !completes, due)
        };
        let (mut least, mut best) = (None, None);
        for (index, drive) in self
            .drives
            .enumerate()
            .filter(|(_, d)| d.presence == Presence::Online && !d.waits_for_fast() && !d.is_quiet(now))
        {
            let slow = drive.items.iter().filter(|item| item.is_slow());
            for (due, item) in slow.map(|item| (drive.due(item), item)).filter(|(due, _)| *due <= now) {
                if least.is_none_or(|least| rank(drive, due, item) < least) {
                    let poll = Poll {
                        drive: index,
                        read: item.read,
                        probe: false,
                    };
                    least = Some(rank(drive, due, item));
                    best = Some((due, poll, item.cost));
                }
            }
        }
        best
    }

    /// When something is due; a slow poll that is due but does not fit before the round waits for the round.
    pub(super) fn next_due(&self, now: Instant) -> Instant {
        let mut next = self.round_due;
        for drive in &self.drives {
            let due = match drive.presence {
                _ if drive.is_quiet(now) => drive.quiet_until,
                Presence::Away(_, _) if drive.items.is_empty() => None,
                Presence::Away(at, _) => Some(at),
                Presence::Online => {
                    let slow = drive.items.iter().filter(|i| i.is_slow() && !drive.waits_for_fast());
                    let slow = slow.map(|i| drive.due(i));
                    let asked = drive.items.iter().filter_map(|i| i.changed_at);
                    slow.chain(asked).filter(|due| is_ahead(*due, now)).min()
                }
            };
            next = due.map_or(next, |due| next.min(due));
        }
        next
    }

    pub(super) fn note_slow(&mut self, now: Instant) {
        let started = self.slow_started;
        if started.is_none_or(|at| now.saturating_duration_since(at) >= self.cadence.slow.mul_f64(0.5)) {
            let cycle = started.map(|before| now.saturating_duration_since(before));
            self.new_slow = Some(RoundStart { at: now, cycle });
            self.slow_started = Some(now);
        }
    }
}

/// Whether a request is not due yet; a due request only waits to be chosen.
fn is_ahead(due: Instant, now: Instant) -> bool {
    due > now
}
