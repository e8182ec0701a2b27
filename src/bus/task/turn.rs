//! One turn of the line: what is said, the silence before it, and the answer.

use std::time::{Duration, Instant};

use super::{BABBLE, Worker};
use crate::bus::desk::Job;
use crate::bus::exchange::await_reply;
use crate::bus::transaction::{Ended, Transaction, is_unlike_its_reply};
use crate::codec::{Exception, Reply, Request, RequestPdu};
use crate::command::Urgency;
use crate::drive::plan::WireTime;
use crate::line::{Line, Lost, Woken};

impl Worker {
    /// One turn of the line: the request of `job`, or what has to be said before it, and the answer.
    pub(super) fn work(&mut self, line: &Line, job: Job) -> Result<(), Lost> {
        let (drive, pdu, urgency) = match &job {
            Job::Poll(poll) => (poll.drive, poll.read.pdu(), None),
            Job::Command { index, pdu } => {
                let Some((drive, urgency)) = self.desk.begun(*index) else {
                    return Ok(());
                };
                (drive, pdu.clone(), Some(urgency))
            }
        };
        let Some(spec) = self.handle.image.drives.get(drive).map(|d| &d.spec) else {
            return Ok(());
        };
        let step = self.sessions.before(drive, urgency, Instant::now());
        let request = Request {
            address: spec.address,
            pdu: step.map_or(pdu, RequestPdu::N2),
            n2: spec.profile.n2,
        };
        let mut frame = std::mem::take(&mut self.frame);
        frame.clear();
        self.handle.image.spec.protocol.encode(&request, &mut frame);
        if frame.is_empty() {
            self.frame = frame;
            self.unknown_to_the_protocol(&job);
            return Ok(());
        }
        let clear = self.wait_for_silence(line, urgency == Some(Urgency::Stop));
        let late = matches!(&job, Job::Command { index, .. } if self.desk.is_late(*index, Instant::now()));
        let result = match clear {
            // What came too late while the line fell silent is not sent.
            Ok(true) if late => Ok(None),
            // What was heard meanwhile may be an answer that nobody waits for any more.
            Ok(true) if self.sessions.before(drive, urgency, Instant::now()) != step => Ok(None),
            Ok(true) => self.exchange(line, drive, &request, &frame).map(Some),
            // A command came in meanwhile: what goes next is decided anew.
            Ok(false) => Ok(None),
            Err(lost) => Err(lost),
        };
        self.frame = frame;
        let Some((ended, began, took)) = result? else {
            return Ok(());
        };
        match (job, step) {
            (job, Some(step)) => self.session_went_on(&job, drive, step, ended, began, took),
            (Job::Poll(poll), None) => self.polled(&poll, ended, began, took),
            (Job::Command { index, pdu }, None) => self.commanded(index, &pdu, ended, began, took),
        }
        Ok(())
    }

    /// The protocol has no such request, so that the drive has no such address: it is refused without the line.
    fn unknown_to_the_protocol(&mut self, job: &Job) {
        let now = Instant::now();
        let refused = Ended::Reply(Reply::Exception(Exception::ADDRESS));
        match job {
            Job::Poll(poll) => self.polled(poll, refused, now, Duration::ZERO),
            Job::Command { index, pdu } => {
                let drives = &self.handle.image.drives;
                self.desk.ended(*index, pdu, refused, self.options.retries, drives, now);
            }
        }
    }

    /// Waits until the line was silent for its time. False when a command came in before (never for a stop).
    fn wait_for_silence(&mut self, line: &Line, stop: bool) -> Result<bool, Lost> {
        let now = Instant::now();
        let rest = self.sessions.rest().filter(|_| !stop).unwrap_or(now);
        let give_up = rest.max(now) + self.silence + BABBLE;
        loop {
            let free = rest.max(self.quiet_since + self.silence);
            let wake = (!stop).then(|| self.handle.queue.wake_fd());
            match line.wait(free.min(give_up), wake, true)? {
                Woken::Time if Instant::now() >= give_up => {
                    tracing::warn!(bus = %self.handle.image.spec.name, "the line does not fall silent; speaking all the same");
                    return Ok(true);
                }
                Woken::Time => {
                    // A thread that was held up may not have seen the last bytes.
                    self.hear_noise(line)?;
                    if self.quiet_since + self.silence <= free {
                        return Ok(true);
                    }
                }
                Woken::Readable => self.hear_noise(line)?,
                Woken::Command => {
                    self.handle.queue.clear_wake();
                    return Ok(false);
                }
            }
        }
    }

    /// One request and its answer. Returns how it ended, when it began and how long the line was taken.
    fn exchange(
        &mut self,
        line: &Line,
        drive: usize,
        request: &Request,
        frame: &[u8],
    ) -> Result<(Ended, Instant, Duration), Lost> {
        let spec = &self.handle.image.spec;
        let wire = WireTime::of(spec.protocol, &spec.format, &request.pdu);
        let began = Instant::now();
        line.send(frame)?;
        let mut tap = self.report.tap(drive, request, frame, self.quiet_since, began);
        let sent = began + spec.format.chars(frame.len());
        let mut transaction = Transaction::new(
            spec.protocol,
            request,
            frame,
            sent,
            self.options.response_timeout,
            wire.reply,
            self.echo,
        );
        // A reply cannot be whole before its own time on the wire is over; baud rates are off by 2 % at most.
        let least = spec.format.chars(spec.protocol.least_reply_chars(&request.pdu));
        let earliest = sent + least.mul_f64(0.9);
        let doubtful = self.desk.debts.could_be_doubled(drive, &request.pdu) || !is_unlike_its_reply(&request.pdu);
        if doubtful && !self.untimed {
            transaction.doubt_before(earliest);
        }
        self.quiet_since = sent;
        let quiet_since = &mut self.quiet_since;
        let ended = await_reply(line, &mut transaction, began, |bytes, now| {
            if !bytes.is_empty() {
                *quiet_since = now.max(*quiet_since);
            }
            if let Some(tap) = &mut tap {
                tap.heard(bytes, now);
            }
        })?;
        let came = wire.reply.min(spec.format.chars(transaction.seen().len()));
        let early = !doubtful && Instant::now() < earliest;
        self.learn(drive, &transaction, &ended, early);
        let took = Instant::now().saturating_duration_since(began) + self.silence;
        self.report
            .exchanged(drive, &transaction, &ended, sent + wire.recognition, came, took);
        if matches!(ended, Ended::Reply(_)) && !transaction.rest().is_empty() {
            self.report.foreign();
            self.sessions.strayed();
        }
        if let Some(tap) = tap {
            tap.ended(&ended, Instant::now());
        }
        Ok((ended, began, took))
    }

    /// What an exchange tells of the adapter, and of what the drive still owes. `early`: it ended before its reply could
    /// be whole, and nothing made that doubtful.
    fn learn(&mut self, drive: usize, transaction: &Transaction<'_>, ended: &Ended, early: bool) {
        self.echo = transaction.echoes(ended).unwrap_or(self.echo);
        self.untimed |= match ended {
            Ended::Reply(Reply::Exception(_)) => false,
            Ended::Reply(_) => early,
            Ended::Silent | Ended::Corrupt(_) => transaction.doubted(),
        };
        self.paid = matches!(ended, Ended::Corrupt(_)) && transaction.is_paid();
        // Behind a fence what came instead of the reply may be what was owed, and the reply is still to come.
        let owed = !self.paid || self.sessions.is_fenced();
        if owed && matches!(ended, Ended::Silent | Ended::Corrupt(_)) {
            self.sessions
                .owes(drive, Instant::now() + self.options.response_timeout);
        }
    }
}
