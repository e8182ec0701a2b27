//! Background exchanges: when one goes on the line, and what came of it.

use std::time::{Duration, Instant};

use super::{Master, Purpose, Turn, TurnEnd};
use crate::bus::n2_session::Progress;
use crate::bus::news::News;
use crate::bus::schedule::Admission;
use crate::bus::transaction::Ended;
use crate::codec::{Exception, Reply};
use crate::command::{BackgroundRequest, Interruption, Outcome, Pace, Urgency, written};
use crate::drive::PlannedRead;
use crate::drive::plan::WireTime;

/// A background request that has its turn.
#[derive(Debug)]
pub(super) struct Begun {
    request: BackgroundRequest,
    admission: Admission,
    /// Its exchange is on the line, or was.
    sent: bool,
}

impl Begun {
    fn turn(&self) -> Turn {
        Turn {
            drive: self.request.drive,
            purpose: Purpose::Background,
            pdu: self.request.pdu.clone(),
        }
    }
}

impl Master {
    /// The background exchange that goes now, in time that is left over (`idle`) or in place of a poll that is due.
    ///
    /// # Errors
    /// When to look again; none where none waits.
    pub(super) fn background(&mut self, idle: bool, now: Instant) -> Result<Turn, Option<Instant>> {
        // Something of a higher rank went before it: it is chosen anew.
        if let Some(begun) = self.background.take_if(|begun| !begun.sent) {
            self.bus.queue.background().put_back(begun.request, now);
        }
        self.drop_background_in_vain(now);
        let mut again: Option<Instant> = None;
        for pace in Pace::ALL {
            match self.begin_background(pace, idle, now) {
                Ok(turn) => return Ok(turn),
                Err(at) => again = again.into_iter().chain(at).min(),
            }
        }
        Err(again)
    }

    /// What cannot be sent any more is answered: expired, or its drive is away.
    fn drop_background_in_vain(&mut self, now: Instant) {
        let Master { bus, schedule, .. } = self;
        let mut queue = bus.queue.background();
        if !queue.is_empty() {
            queue.remove(now, &Outcome::Expired, |r| r.expires <= now);
            queue.remove(now, &Outcome::Offline, |r| !schedule.is_online(r.drive));
        }
    }

    /// Takes the next request of that pace from the queue, if it may go.
    fn begin_background(&mut self, pace: Pace, idle: bool, now: Instant) -> Result<Turn, Option<Instant>> {
        let queue = self.bus.queue.clone();
        let mut waiting = queue.background();
        if waiting.is_empty() {
            return Err(None);
        }
        let mut blocked: Option<Instant> = None;
        let Master {
            drives,
            sessions,
            n2_late,
            ..
        } = self;
        let may = |request: &BackgroundRequest| {
            // A poll identifies the drive.
            if sessions.before(request.drive, Some(Urgency::Read), now).is_some() {
                blocked = blocked.into_iter().chain([now + super::LOOK_ROUND]).min();
                return false;
            }
            let late = drives.get_mut(request.drive).map(|drive| &mut drive.late);
            let late = late.and_then(|late| late.blocks(&request.pdu, now));
            let until = late.max(n2_late.blocks(&request.pdu, now));
            blocked = blocked.into_iter().chain(until).min();
            until.is_none()
        };
        let Some(number) = waiting.next(pace, may) else {
            return Err(blocked);
        };
        let Some(request) = waiting.get(number) else {
            return Err(blocked);
        };
        let cost = self.background_cost(request);
        let admission = self.schedule.admits_background(pace, cost, idle, now);
        if let Admission::NotBefore(at) = admission {
            return Err(blocked.into_iter().chain([at]).min());
        }
        let Some(request) = waiting.take(number) else {
            return Err(blocked);
        };
        let begun = self.background.insert(Begun {
            request,
            admission,
            sent: false,
        });
        Ok(begun.turn())
    }

    /// What the exchange takes, as far as the profile tells.
    fn background_cost(&self, request: &BackgroundRequest) -> Duration {
        let spec = &self.bus.image.spec;
        let turnaround = self.bus.image.drives.get(request.drive);
        let turnaround = turnaround.map_or(Duration::ZERO, |drive| drive.spec.turnaround);
        WireTime::of(spec.protocol, &spec.format, &request.pdu).total(turnaround, self.silence)
    }

    /// Whether the background exchange that was chosen may still go.
    pub(super) fn background_is_due(&self, now: Instant) -> bool {
        self.background
            .as_ref()
            .is_some_and(|begun| begun.request.expires > now)
    }

    /// The background exchange goes onto the line.
    pub(super) fn background_sent(&mut self) {
        if let Some(begun) = &mut self.background {
            begun.sent = true;
        }
    }

    /// Answers the request that has begun, for which nothing can be done any more.
    pub(super) fn abandon_background(&mut self, unsent: Outcome, why: Interruption, now: Instant) {
        if let Some(begun) = self.background.take() {
            let outcome = if begun.sent { Outcome::Interrupted(why) } else { unsent };
            begun.request.answer(outcome, now);
        }
    }

    /// A background exchange is over: it is answered, whatever came of it.
    pub(super) fn background_over(&mut self, turn: &Turn, end: TurnEnd, now: Instant, news: &mut Vec<News>) {
        let index = turn.drive;
        let heard = self.sessions.heard(index, &end.ended);
        if heard == Progress::Restarted {
            self.restarted(index, now, news);
        }
        let Some(begun) = self.background.take() else {
            return;
        };
        let answered = matches!(end.ended, Ended::Reply(_));
        self.schedule
            .background_done(begun.request.pace, begun.admission, answered, end.took);
        if answered {
            self.schedule.seen(index, now);
        }
        let outcome = self.background_outcome(turn, end, now);
        if turn.pdu.is_write() {
            self.note_background_write(turn, &outcome, now);
        }
        begun.request.answer(outcome, now);
    }

    fn background_outcome(&mut self, turn: &Turn, end: TurnEnd, now: Instant) -> Outcome {
        let reply = match end.ended {
            // The drive did not look at it.
            Ended::Silent | Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => return Outcome::TimedOut,
            Ended::Corrupt(_) => return Outcome::Garbled,
            Ended::Reply(Reply::Exception(code)) => return Outcome::Exception(code),
            Ended::Reply(reply) => reply,
        };
        let Some(drive) = self.drives.get_mut(turn.drive) else {
            return Outcome::Acknowledged(reply);
        };
        let proves_nothing = turn.pdu.is_write() && drive.late.proves_nothing(&turn.pdu, end.began, now);
        // The reply to an earlier try says how it was then.
        let older = drive.late.asked_by(&turn.pdu, now) < end.began;
        drive.late.answered(&turn.pdu, now);
        match proves_nothing || older {
            true => Outcome::Garbled,
            false => Outcome::Acknowledged(reply),
        }
    }

    /// What was written is read back soon where it is polled, and the drive's command words are what it made of them.
    fn note_background_write(&mut self, turn: &Turn, outcome: &Outcome, now: Instant) {
        if let Some(drive) = self.drives.get_mut(turn.drive) {
            match outcome {
                Outcome::Acknowledged(_) => drive.words.written(&turn.pdu),
                Outcome::Exception(_) => {}
                _ => drive.words.forget(),
            }
        }
        if let Some((table, items)) = written(&turn.pdu) {
            let covers = |read: &PlannedRead| items.iter().any(|(address, _)| read.covers(table, *address));
            self.schedule.refresh(turn.drive, covers, now);
        }
    }
}
