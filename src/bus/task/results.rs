//! What an exchange that is over means: for the drive, its samples, the schedule and the command.

use std::time::{Duration, Instant};

use super::Worker;
use crate::bus::desk::Job;
use crate::bus::schedule::{Change, Poll, Polled};
use crate::bus::session::Progress;
use crate::bus::transaction::Ended;
use crate::cache::Snapshot;
use crate::codec::n2::Session;
use crate::codec::{Exception, Reply, RequestPdu};
use crate::command::{Command, Outcome, Urgency, written};
use crate::drive::PollClass;

impl Worker {
    /// A step that N2 needs before the job is over. The job is decided on anew, or has failed with it.
    pub(super) fn session_went_on(
        &mut self,
        job: &Job,
        drive: usize,
        step: Session,
        ended: Ended,
        began: Instant,
        took: Duration,
    ) {
        let now = Instant::now();
        let progress = self.sessions.done(drive, step, &ended, now);
        match progress {
            Progress::Going | Progress::Failed => {}
            Progress::Unlike(device) => self.report.unlike(drive, device),
            Progress::Changed => self.schedule.read_again(drive, now),
            Progress::Restarted => self.restarted(drive, now),
        }
        match job {
            Job::Poll(poll) if progress == Progress::Failed => {
                self.polled(poll, without_reply(ended), began, took);
            }
            Job::Poll(_) => self.schedule.session_done(),
            Job::Command { index, .. } => {
                if let Some((_, urgency)) = self.desk.begun(*index) {
                    self.schedule.command_done(urgency, took);
                }
                if progress == Progress::Failed {
                    let (pdu, drives) = (RequestPdu::N2(step), &self.handle.image.drives);
                    self.desk
                        .ended(*index, &pdu, without_reply(ended), self.options.retries, drives, now);
                }
            }
        }
    }

    /// The drive has started anew: nothing that is known of it holds.
    fn restarted(&mut self, drive: usize, now: Instant) {
        self.desk.shadow.forget(drive);
        self.schedule.read_again(drive, now);
        if let Some(image) = self.handle.image.drives.get(drive) {
            image.update(Snapshot::outlive);
        }
        self.report.restarted(drive);
    }

    /// Late answers are told apart by what they look like, but on N2, where they look like nothing: sessions see to that.
    fn owes(&mut self, drive: usize, pdu: &RequestPdu, began: Instant, now: Instant) {
        if self.sessions.is_empty() && (!self.paid || self.desk.debts.owes(drive, now)) {
            self.desk.debts.given_up(drive, pdu, began, now);
        }
    }

    /// What a poll that is over tells of the drive.
    pub(super) fn polled(&mut self, poll: &Poll, ended: Ended, began: Instant, took: Duration) {
        let now = Instant::now();
        // Of a step before the poll this was told already.
        let heard = self.sessions.heard(poll.drive, &ended);
        if heard == Progress::Restarted {
            self.restarted(poll.drive, now);
        }
        let polled = match &ended {
            Ended::Reply(_) if heard == Progress::Failed => Polled::Failed,
            Ended::Reply(Reply::Exception(code)) => Polled::Refused(*code),
            Ended::Reply(reply) => {
                self.desk.debts.answered(poll.drive, &poll.read.pdu(), now);
                self.store(poll, reply, now);
                Polled::Ok
            }
            Ended::Silent | Ended::Corrupt(_) => {
                self.owes(poll.drive, &poll.read.pdu(), began, now);
                match ended {
                    Ended::Corrupt(_) => Polled::Garbled,
                    _ => Polled::Failed,
                }
            }
        };
        let change = self.schedule.poll_done(poll, polled, took, now);
        if let Some(round) = self.schedule.take_slow_round() {
            self.report.slow_round(round.cycle);
        }
        match change {
            Change::Online => self.report.online(poll.drive),
            Change::Offline => {
                self.desk.shadow.forget(poll.drive);
                self.sessions.gone(poll.drive);
                self.report.offline(poll.drive, "it does not answer");
                let gone = |c: &Command| c.drive == poll.drive;
                self.handle.queue.lock().remove(now, &Outcome::Offline, gone);
            }
            Change::Unavailable(read, exception) => self.report.unavailable(poll.drive, &read, exception),
            Change::None => {}
        }
        if matches!(ended, Ended::Reply(_)) {
            self.report.look(poll.drive);
            self.report.look_at_supervision(poll.drive);
            self.desk.look(poll.drive, &self.handle.image.drives, now);
        }
    }

    fn store(&mut self, poll: &Poll, reply: &Reply, now: Instant) {
        let read = poll.read;
        let (Some(words), Some(drive)) = (reply.words(), self.handle.image.drives.get(poll.drive)) else {
            return;
        };
        for (address, word) in (read.start..).zip(&words) {
            let commanded = |p: &crate::drive::Point| p.write && p.raw().is_some_and(|r| r.covers(read.table, address));
            if drive.spec.profile.points.iter().any(commanded) {
                self.desk.shadow.learn(poll.drive, read.table, address, *word);
            }
        }
        drive.update(|snapshot: &mut Snapshot| {
            snapshot.store(read.table, read.start, &words, now);
            if read.class == PollClass::Fast {
                snapshot.fast_at = Some(now);
            }
        });
    }

    /// What an exchange of a command tells of the command.
    pub(super) fn commanded(&mut self, index: usize, pdu: &RequestPdu, ended: Ended, began: Instant, took: Duration) {
        let now = Instant::now();
        let Some((drive, urgency)) = self.desk.begun(index) else {
            return;
        };
        self.schedule.command_done(urgency, took);
        let heard = self.sessions.heard(drive, &ended);
        if heard == Progress::Restarted {
            self.restarted(drive, now);
        }
        match &ended {
            // The drive did not look at it: it is said again, once the drive is identified.
            Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => {
                let (pdu, drives) = (RequestPdu::N2(Session::Identify), &self.handle.image.drives);
                self.desk
                    .ended(index, &pdu, Ended::Silent, self.options.retries, drives, now);
                return;
            }
            Ended::Reply(reply) => {
                self.schedule.seen(drive);
                let strayed = urgency == Urgency::Stop && self.sessions.doubts_stop(drive);
                let refused = matches!(reply, Reply::Exception(_));
                if !refused && !self.desk.believes(index, pdu, strayed, began, now) {
                    return;
                }
            }
            Ended::Silent | Ended::Corrupt(_) => self.owes(drive, pdu, began, now),
        }
        let drives = &self.handle.image.drives;
        self.desk.ended(index, pdu, ended, self.options.retries, drives, now);
        if let Some((table, items)) = written(pdu) {
            self.schedule
                .refresh(drive, |read| items.iter().any(|(a, _)| read.covers(table, *a)), now);
        }
    }
}

/// A step before the job has failed, whatever was answered: so has the job.
fn without_reply(ended: Ended) -> Ended {
    match ended {
        Ended::Corrupt(why) => Ended::Corrupt(why),
        Ended::Silent | Ended::Reply(_) => Ended::Silent,
    }
}
