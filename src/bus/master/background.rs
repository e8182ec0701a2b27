//! Background exchanges: when one goes on the line, and what came of it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Master, Purpose, Turn, TurnEnd};
use crate::bus::n2_session::Progress;
use crate::bus::news::News;
use crate::bus::schedule::Admission;
use crate::bus::transaction::{CONNECTION_CLOSED, Ended};
use crate::codec::rtu::LONGEST;
use crate::codec::{Exception, Reply, RequestPdu, Table};
use crate::command::{BackgroundRequest, Interruption, NO_DRIVE, Outcome, Pace, Refusal, Urgency, written};
use crate::drive::plan::WireTime;
use crate::drive::{PlannedRead, PollClass};
use crate::process_image::DriveImage;

/// Time of an exchange whose request is not decoded, at most.
const LONGEST_UNCHECKED: Duration = Duration::from_millis(500);
/// Time that drives have to carry out a broadcast before the next request (MODBUS over Serial Line 1.02, 2.4.1).
const BROADCAST_PAUSE: Duration = Duration::from_millis(100);

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

/// Whether a request may write to a drive that takes no orders but stops; a broadcast reaches all.
fn is_held(request: &BackgroundRequest, drives: &[Arc<DriveImage>]) -> bool {
    let passed_on = request.passed_on.as_ref().filter(|passed_on| passed_on.may_write);
    let stops = |image: &DriveImage| {
        let stop = |(table, items): (Table, Vec<(u16, u16)>)| {
            items
                .iter()
                .any(|(address, value)| image.spec.profile.is_stop(table, *address, *value))
        };
        written(&request.pdu).is_some_and(stop)
    };
    passed_on.is_some_and(|passed_on| {
        let reached = |(index, _): &(usize, &Arc<DriveImage>)| *index == request.drive || passed_on.address == 0;
        let mut reached = drives.iter().enumerate().filter(reached);
        reached.any(|(_, image)| image.hold.why().is_some() && !stops(image))
    })
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
            queue.remove(now, &Outcome::Replaced, BackgroundRequest::is_unwanted);
            queue.remove(now, &Outcome::Offline, |r| {
                r.drive != NO_DRIVE && !schedule.is_online(r.drive)
            });
            let drives = &bus.image.drives;
            if let Some(why) = drives.iter().find_map(|image| image.hold.why()) {
                let held = Outcome::Refused(Refusal::NotAllowed(why.to_string()));
                queue.remove(now, &held, |r| is_held(r, drives));
            }
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
            strangers,
            ..
        } = self;
        let may = |request: &BackgroundRequest| {
            // A poll identifies the drive.
            if sessions.before(request.drive, Some(Urgency::Read), now).is_some() {
                blocked = blocked.into_iter().chain([now + super::LOOK_ROUND]).min();
                return false;
            }
            let late = match (&request.passed_on, drives.get_mut(request.drive)) {
                (_, Some(drive)) => Some(&mut drive.late),
                (Some(passed_on), None) => strangers.get_mut(&passed_on.address),
                (None, None) => None,
            };
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
    pub(super) fn background_over(&mut self, turn: &Turn, mut end: TurnEnd, now: Instant, news: &mut Vec<News>) {
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
        let frame = std::mem::take(&mut end.frame);
        let outcome = match self.is_broadcast_of(&begun.request) && end.ended == Ended::Silent {
            true => Outcome::Acknowledged(Reply::Written),
            false => self.background_outcome(turn, end, now),
        };
        if begun
            .request
            .passed_on
            .as_ref()
            .is_some_and(|passed_on| passed_on.may_write)
        {
            self.unchecked_write(&begun.request, &outcome, now);
        } else if turn.pdu.is_write() {
            self.note_background_write(turn, &outcome, now);
        }
        if let Outcome::Acknowledged(reply) = &outcome {
            self.note_background_read(turn, reply, now, news);
        }
        begun.request.answer_with(outcome, frame, now);
    }

    /// What was read fills the process image, too. A drive that was identified, or asked for its changes, may have started
    /// anew or told what the gateway has not heard: it is read again.
    fn note_background_read(&mut self, turn: &Turn, reply: &Reply, now: Instant, news: &mut Vec<News>) {
        match (&turn.pdu, reply) {
            (RequestPdu::Read { table, start, count }, reply) => {
                let read = PlannedRead {
                    class: PollClass::Slow,
                    table: *table,
                    start: *start,
                    count: *count,
                    wide: 0,
                };
                if let Some(words) = reply.words() {
                    self.learn(turn.drive, read, words, now, news);
                }
            }
            (_, Reply::Identified(_)) => {
                if let Some(drive) = self.drives.get_mut(turn.drive) {
                    drive.restarted();
                }
                self.schedule.read_again(turn.drive, now);
            }
            (_, Reply::Changes(digits)) if !digits.is_empty() => self.schedule.read_again(turn.drive, now),
            _ => {}
        }
    }

    /// What may have written anything: nothing that is known of the command words of those who heard it holds.
    fn unchecked_write(&mut self, request: &BackgroundRequest, outcome: &Outcome, now: Instant) {
        if matches!(outcome, Outcome::Exception(_)) {
            return;
        }
        let broadcast = self.is_broadcast_of(request);
        for (index, drive) in self.drives.iter_mut().enumerate() {
            if broadcast || index == request.drive {
                drive.restarted();
                self.schedule.read_again(index, now);
            }
        }
    }

    /// The address that a turn asks where no drive is configured at it.
    pub fn stranger(&self, turn: &Turn) -> Option<u8> {
        let begun = self
            .background
            .as_ref()
            .filter(|_| turn.purpose == Purpose::Background)?;
        let passed_on = begun.request.passed_on.as_ref()?;
        (turn.drive == NO_DRIVE).then_some(passed_on.address)
    }

    /// Whether a turn asks everybody, and nobody answers.
    pub(super) fn is_broadcast(&self, turn: &Turn) -> bool {
        self.stranger(turn) == Some(0) && self.sessions.is_empty()
    }

    fn is_broadcast_of(&self, request: &BackgroundRequest) -> bool {
        let address = request.passed_on.as_ref().map(|passed_on| passed_on.address);
        address == Some(0) && request.drive == NO_DRIVE && self.sessions.is_empty()
    }

    /// How long the first byte of the reply is waited for where that is not as with the gateway's own requests: after a broadcast
    /// the drives have time to carry it out, and a request that is not decoded takes no more of the line than
    /// [`LONGEST_UNCHECKED`].
    pub(super) fn passed_on_timeout(&self, turn: &Turn) -> Option<Duration> {
        if self.is_broadcast(turn) {
            return Some(BROADCAST_PAUSE);
        }
        let RequestPdu::Other(_) = &turn.pdu else { return None };
        let spec = &self.bus.image.spec;
        let wire = WireTime::of(spec.protocol, &spec.format, &turn.pdu);
        // How long the reply is shows only when it is there.
        let patient = self.response_timeout + spec.format.chars(LONGEST);
        Some(patient.min(LONGEST_UNCHECKED.saturating_sub(wire.request + wire.reply)))
    }

    fn background_outcome(&mut self, turn: &Turn, end: TurnEnd, now: Instant) -> Outcome {
        let reply = match end.ended {
            // The drive did not look at it.
            Ended::Silent
            | Ended::Corrupt(CONNECTION_CLOSED)
            | Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => return Outcome::TimedOut,
            Ended::Corrupt(_) => return Outcome::Garbled,
            Ended::Reply(Reply::Exception(code)) if turn.pdu.is_write() => return Outcome::of_exception(code),
            Ended::Reply(Reply::Exception(code)) => return Outcome::Exception(code),
            Ended::Reply(reply) => reply,
        };
        let Some(drive) = self.drives.get_mut(turn.drive) else {
            return Outcome::Acknowledged(reply);
        };
        let proves_nothing = turn.pdu.is_write() && drive.late.proves_nothing(&turn.pdu, end.began, now);
        // The reply to an earlier try says how it was then.
        let older = drive.late.asked_by(&turn.pdu, now) < end.began;
        drive.late.answered(&turn.pdu, end.began, now);
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
            let image = self.bus.image.drives.get(turn.drive);
            if let Some(image) = image.filter(|_| outcome.is_ok() && table == Table::Holding) {
                image.note_written(&items, now);
            }
            self.note_write(turn.drive, table, &items, now);
        }
    }
}
