//! The commands that a bus has begun: what goes on the line next, and how each one ends. Pure: time is an argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::confirm::{Confirmations, NotConfirmed};
use super::debts::Debts;
use super::execute::{Execution, Next, Shadow};
use super::schedule::{Decision, Poll, Schedule};
use super::transaction::Ended;
use crate::cache::DriveImage;
use crate::codec::RequestPdu;
use crate::command::{CAPACITY, Command, Order, Outcome, Pending, Urgency};
use crate::drive::ModelPoint;

/// Commands begun at one time (a reset pulse is held while others go on), those apart that wait for a late reply.
pub const BEGUN: usize = 8;
/// Begun commands of one drive that wait for a late reply; at that many, no further one that may need one is begun.
const HELD: usize = 2;
/// A status older than this does not tell whether the motor runs.
const FRESH: Duration = Duration::from_secs(2);

/// Who speaks next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Job {
    /// A read of the plan.
    Poll(Poll),
    /// A step of a begun command.
    Command {
        /// Its place among the begun ones.
        index: usize,
        /// What is sent.
        pdu: RequestPdu,
    },
}

/// The begun commands and what is known of the drives' words.
#[derive(Debug, Default)]
pub struct Desk {
    begun: Vec<Execution>,
    /// The drives' own command words.
    pub shadow: Shadow,
    /// Replies that drives may still owe.
    pub debts: Debts,
    confirmations: Confirmations,
}

/// The begun command that goes on next: rank, place, request.
type Ready = (Urgency, usize, RequestPdu);

/// Begun commands that wait for a late reply: they must not hold up the commands of other drives.
#[derive(Debug, Default)]
struct Held {
    /// The drive of each.
    drives: Vec<usize>,
    /// Begun commands that do not wait for one.
    others: usize,
    /// When the first of those that were not admitted for a late reply's sake may be.
    until: Option<Instant>,
}

impl Held {
    /// Whether a command may be begun now. A stop always is.
    fn admits(&mut self, command: &Command, debts: &mut Debts, now: Instant) -> bool {
        if command.urgency == Urgency::Stop {
            return true;
        }
        if let Order::Read(pdu) | Order::Write(pdu) = &command.order
            && let Some(until) = debts.blocks(command.drive, pdu, now)
        {
            self.until = Some(self.until.map_or(until, |at| at.min(until)));
            return false;
        }
        // What else such a command needs, if it is to be asked for first, shows when it is begun.
        let of_drive = self.drives.iter().filter(|drive| **drive == command.drive).count();
        let room = self.others < BEGUN && self.drives.len() < CAPACITY;
        room && (of_drive < HELD || !matches!(command.order, Order::Points(_)))
    }
}

impl Desk {
    /// What goes on the line next, or until when nothing does (`now`: decide anew).
    ///
    /// # Errors
    /// The time until which nothing is to be done; this is no failure.
    pub fn decide(
        &mut self,
        drives: &[Arc<DriveImage>],
        pending: &mut Pending,
        schedule: &mut Schedule,
        now: Instant,
    ) -> Result<Job, Instant> {
        for drive in pending.take_stopped() {
            self.purge(drive, now);
        }
        let (begun, mut held, mut wake_at) = self.begun_next(drives, now);
        let queued = pending.next_urgency(now, |c| held.admits(c, &mut self.debts, now));
        wake_at = [wake_at, held.until].into_iter().flatten().min();
        let waiting = [begun.as_ref().map(|(u, _, _)| *u), queued].into_iter().flatten().min();
        match schedule.next(now, waiting) {
            Decision::Poll(poll) => match self.debts.blocks(poll.drive, &poll.read.pdu(), now) {
                None => Ok(Job::Poll(poll)),
                Some(until) => {
                    schedule.postpone(&poll, until);
                    Err(now)
                }
            },
            Decision::Idle(until) => {
                wake_at = wake_at.map(|at| at.min(until)).or(Some(until));
                Err(wake_at.unwrap_or(until))
            }
            Decision::Command(urgency) => match begun {
                Some((of_begun, index, pdu)) if queued.is_none_or(|q| of_begun <= q) => Ok(Job::Command { index, pdu }),
                _ => {
                    if let Some(command) = pending.pop_of(urgency, now, |c| held.admits(c, &mut self.debts, now)) {
                        let online = schedule.is_online(command.drive);
                        self.begin(command, drives, online, now);
                    }
                    // What was begun is decided on anew: it may wait, or another one may go first.
                    Err(now)
                }
            },
        }
    }

    /// The begun command that can go on, of the highest rank; else when one can.
    fn begun_next(&mut self, drives: &[Arc<DriveImage>], now: Instant) -> (Option<Ready>, Held, Option<Instant>) {
        let mut best: Option<Ready> = None;
        let mut held = Held::default();
        let mut wake_at: Option<Instant> = None;
        let mut index = 0;
        while let Some(execution) = self.begun.get_mut(index) {
            let Some(drive) = drives.get(execution.drive) else {
                self.begun.remove(index).finish(Outcome::Offline, now);
                return self.begun_next(drives, now);
            };
            let reading = drive.reading(now, FRESH);
            // What a faulted drive says of its motor may be from before the fault; it does not run by its run command.
            let running = reading.is_set(ModelPoint::Running) && !reading.is_set(ModelPoint::Fault);
            match execution.next(&self.shadow, &drive.spec.profile, running, now) {
                Next::Send(pdu) => {
                    // A stop waits for nobody: its bits are on the wire at once, whatever may still come back.
                    let blocked = self.debts.blocks(execution.drive, &pdu, now);
                    if let Some(until) = blocked.filter(|_| execution.urgency != Urgency::Stop) {
                        execution.held_up();
                        held.drives.push(execution.drive);
                        wake_at = Some(wake_at.map_or(until, |at| at.min(until)));
                    } else if execution.asks_again() {
                        continue;
                    } else if best.as_ref().is_none_or(|(urgency, _, _)| execution.urgency < *urgency) {
                        best = Some((execution.urgency, index, pdu));
                    }
                }
                Next::Wait(until) => wake_at = Some(wake_at.map_or(until, |at| at.min(until))),
                Next::Done => {
                    let outcome = execution.success();
                    let execution = self.begun.remove(index);
                    self.end(execution, outcome, drives, now);
                    // What was decided so far may rest on words that are not known any more.
                    return self.begun_next(drives, now);
                }
            }
            index += 1;
        }
        held.others = self.begun.len().saturating_sub(held.drives.len());
        (best, held, wake_at)
    }

    /// Begins a command that was taken from the queue.
    fn begin(&mut self, command: Command, drives: &[Arc<DriveImage>], online: bool, now: Instant) {
        let Some(drive) = drives.get(command.drive).filter(|_| online) else {
            command.ticket.answer(Outcome::Offline, now);
            return;
        };
        self.begun.push(Execution::new(command, &drive.spec.profile));
    }

    /// Nothing that was begun for a drive goes on behind a stop.
    fn purge(&mut self, drive: usize, now: Instant) {
        let mut index = 0;
        while let Some(execution) = self.begun.get_mut(index) {
            let over = execution.drive == drive && execution.urgency == Urgency::Command && execution.purge();
            if over {
                let execution = self.begun.remove(index);
                self.end(execution, Outcome::Purged, &[], now);
            } else {
                index += 1;
            }
        }
    }

    /// Drive and rank of a begun command.
    pub fn begun(&self, index: usize) -> Option<(usize, Urgency)> {
        self.begun.get(index).map(|e| (e.drive, e.urgency))
    }

    /// Whether the time of a begun command ran out since it was decided on: nothing is sent then.
    pub fn is_late(&self, index: usize, now: Instant) -> bool {
        self.begun.get(index).is_some_and(|e| e.is_late(now))
    }

    /// The drive answered a step that was sent at `sent`, refusals apart. Whether that is believed: the reply to a stop,
    /// which waits for nobody, may be that to an earlier request (`strayed`: known from elsewhere). The step is done once
    /// more then.
    pub fn believes(&mut self, index: usize, pdu: &RequestPdu, strayed: bool, sent: Instant, now: Instant) -> bool {
        let Some(execution) = self.begun.get_mut(index) else {
            return true;
        };
        let drive = execution.drive;
        let stray = pdu.is_write() && strayed;
        let believed = !stray && !self.debts.proves_nothing(drive, pdu, sent, now);
        if !believed && pdu.is_write() {
            execution.doubted();
        }
        self.debts.answered(drive, pdu, now);
        believed
    }

    /// A step of a begun command is over: with the drive's reply, or without one to be believed.
    pub fn ended(
        &mut self,
        index: usize,
        pdu: &RequestPdu,
        ended: Ended,
        retries: u32,
        drives: &[Arc<DriveImage>],
        now: Instant,
    ) {
        let Some(execution) = self.begun.get_mut(index) else {
            return;
        };
        let outcome = match ended {
            Ended::Reply(reply) => execution.answered(pdu, reply, &mut self.shadow),
            Ended::Silent => execution.failed(pdu, Outcome::TimedOut, retries),
            Ended::Corrupt(_) => execution.failed(pdu, Outcome::Garbled, retries),
        };
        if let Some(outcome) = outcome {
            let execution = self.begun.remove(index);
            self.end(execution, outcome, drives, now);
        }
    }

    fn end(&mut self, execution: Execution, outcome: Outcome, drives: &[Arc<DriveImage>], now: Instant) {
        let drive = execution.drive;
        if execution.in_doubt() {
            // A bit of another command must not bring back what an unanswered stop took away.
            self.shadow.forget(drive);
        }
        let reading = drives.get(drive).map(|d| d.reading(now, FRESH));
        match reading.filter(|_| outcome.is_ok()) {
            Some(reading) => {
                let (effects, receipt) = execution.acknowledge(outcome, now);
                self.confirmations.watch(drive, effects, receipt, &reading, now);
            }
            None => execution.finish(outcome, now),
        }
    }

    /// A drive was read: what shows its effect now is confirmed.
    pub fn look(&mut self, drive: usize, drives: &[Arc<DriveImage>], now: Instant) {
        if let Some(image) = drives.get(drive).filter(|_| !self.confirmations.is_empty()) {
            self.confirmations.look(drive, &image.reading(now, FRESH), now);
        }
    }

    /// Acknowledged commands that showed no effect in time, each told once.
    pub fn not_confirmed(&mut self, drives: &[Arc<DriveImage>], now: Instant) -> Vec<NotConfirmed> {
        let profile = |index: usize| drives.get(index).map(|d| &*d.spec.profile);
        self.confirmations.expire(profile, now)
    }

    /// Answers everything that was begun; what was acknowledged stays so.
    pub fn close(&mut self, outcome: &Outcome, now: Instant) {
        for execution in self.begun.drain(..) {
            execution.finish(outcome.clone(), now);
        }
        self.confirmations.clear();
    }
}

#[cfg(test)]
mod tests;
