//! The bus at work: the only place south that does I/O. One thread owns the line.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::BusOptions;
use super::desk::{Desk, Job};
use super::exchange::await_reply;
use super::leases::Leases;
use super::report::Report;
use super::schedule::{Cadence, Change, Poll, Polled, Schedule};
use super::session::{Progress, Sessions};
use super::transaction::{Ended, Transaction, is_unlike_its_reply};
use crate::cache::{Outcome as Counted, Snapshot};
use crate::codec::n2::Session;
use crate::codec::{Exception, Protocol, Reply, Request, RequestPdu};
use crate::command::{Command, Outcome, Urgency, written};
use crate::drive::plan::WireTime;
use crate::drive::{Plan, PlannedRead, PollClass};
use crate::event::Events;
use crate::line::{self, Line, Lost, Woken};
use crate::plant::BusHandle;

/// First and longest pause between two tries to open the port.
const REOPEN: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(3));
/// A line that never falls silent is spoken on after this time: a stop must get out.
const BABBLE: Duration = Duration::from_millis(500);
/// The bus looks around at least this often.
const LOOK_ROUND: Duration = Duration::from_millis(100);

/// A bus that runs.
#[derive(Debug)]
pub struct BusTask {
    handle: BusHandle,
    stop: Arc<AtomicBool>,
    beats: Arc<AtomicU64>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl BusTask {
    /// Starts the bus in a thread of its own.
    ///
    /// # Errors
    /// When the system gives no thread.
    pub fn start(handle: BusHandle, options: BusOptions, leases: Leases, events: Events) -> std::io::Result<BusTask> {
        let stop = Arc::new(AtomicBool::new(false));
        let beats = Arc::new(AtomicU64::new(0));
        let worker = Worker::new(handle.clone(), options, leases, events, stop.clone(), beats.clone());
        let name = format!("bus-{}", handle.image.spec.name);
        let thread = std::thread::Builder::new().name(name).spawn(move || worker.run())?;
        Ok(BusTask {
            handle,
            stop,
            beats,
            thread: Some(thread),
        })
    }

    /// Turns that the bus has taken: it hangs when this stands still for seconds.
    pub fn beats(&self) -> u64 {
        self.beats.load(Ordering::Relaxed)
    }

    /// The bus.
    pub fn handle(&self) -> &BusHandle {
        &self.handle
    }

    /// Ends the bus after the exchange that is running; everything that waits is answered.
    pub fn stop(mut self) {
        self.halt();
    }

    fn halt(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.handle.queue.close(Outcome::ShuttingDown, Instant::now());
        self.handle.queue.wake();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!(bus = %self.handle.image.spec.name, "the bus ended by a panic");
        }
    }
}

impl Drop for BusTask {
    fn drop(&mut self) {
        self.halt();
    }
}

struct Worker {
    handle: BusHandle,
    options: BusOptions,
    silence: Duration,
    schedule: Schedule,
    desk: Desk,
    /// What N2 says to drives beside reading them.
    sessions: Sessions,
    leases: Leases,
    report: Report,
    stop: Arc<AtomicBool>,
    beats: Arc<AtomicU64>,
    /// End of the last character on the line, either direction.
    quiet_since: Instant,
    /// The adapter sends back what it is given.
    echo: bool,
    /// Replies come faster than the wire could carry them: a simulation, or another baud rate behind a device server.
    untimed: bool,
    /// The last exchange ended with the drive's reply, mangled: it owes none.
    paid: bool,
    frame: Vec<u8>,
}

impl Worker {
    fn new(
        handle: BusHandle,
        options: BusOptions,
        leases: Leases,
        events: Events,
        stop: Arc<AtomicBool>,
        beats: Arc<AtomicU64>,
    ) -> Worker {
        let now = Instant::now();
        let spec = handle.image.spec.clone();
        let silence = spec.protocol.silence(options.silence, &spec.format);
        let cadence = Cadence {
            fast: spec.cycle,
            slow: spec.slow_cycle,
            retries: options.retries,
        };
        let plans: Vec<&Plan> = handle.image.drives.iter().map(|d| &d.plan).collect();
        let drives = &handle.image.drives;
        let cost = |index: usize, read: &PlannedRead| {
            let turnaround = drives.get(index).map_or(Duration::ZERO, |d| d.spec.turnaround);
            WireTime::of(spec.protocol, &spec.format, &read.pdu()).total(turnaround, silence)
        };
        let schedule = Schedule::new(cadence, &plans, cost, now);
        let report = Report::new(handle.image.clone(), events);
        let sessions = match spec.protocol {
            Protocol::N2 => Sessions::new(drives.iter().map(|d| d.spec.profile.n2)),
            Protocol::ModbusRtu | Protocol::ModbusAscii => Sessions::default(),
        };
        Worker {
            handle,
            options,
            silence,
            schedule,
            desk: Desk::default(),
            sessions,
            leases,
            report,
            stop,
            beats,
            quiet_since: now,
            echo: false,
            untimed: false,
            paid: false,
            frame: Vec::with_capacity(260),
        }
    }

    fn run(mut self) {
        line::sharpen_timers();
        let mut pause = REOPEN.0;
        while !self.stopping() {
            let spec = &self.handle.image.spec;
            match Line::open(&spec.port, &spec.format, self.options.rs485) {
                Ok((line, warnings)) => {
                    self.opened(warnings);
                    let opened = Instant::now();
                    let why = self.serve(&line);
                    // A port that goes again at once is opened ever less often.
                    if opened.elapsed() >= REOPEN.1 {
                        pause = REOPEN.0;
                    }
                    if let Err(lost) = why {
                        self.lost(&lost.to_string());
                    }
                }
                Err(error) => self.lost(&error.to_string()),
            }
            self.rest(pause);
            pause = (pause * 2).min(REOPEN.1);
        }
        self.desk.close(&Outcome::ShuttingDown, Instant::now());
    }

    fn stopping(&self) -> bool {
        self.beats.fetch_add(1, Ordering::Relaxed);
        self.stop.load(Ordering::Relaxed)
    }

    fn rest(&self, pause: Duration) {
        let until = Instant::now() + pause;
        while !self.stopping() && Instant::now() < until {
            line::wait_without_port(until.min(Instant::now() + LOOK_ROUND), self.handle.queue.wake_fd());
            self.handle.queue.clear_wake();
        }
    }

    fn opened(&mut self, warnings: Vec<String>) {
        let now = Instant::now();
        for warning in warnings {
            tracing::warn!(bus = %self.handle.image.spec.name, "{warning}");
        }
        self.quiet_since = now;
        self.echo = false;
        self.untimed = false;
        self.schedule.reset(now);
        self.sessions.reset();
        self.handle.queue.open();
        self.report.bus_up();
    }

    /// The port is gone or cannot be opened: everything is stale at once, everybody who waits is answered.
    fn lost(&mut self, why: &str) {
        let now = Instant::now();
        self.handle.queue.close(Outcome::BusDown, now);
        self.desk.close(&Outcome::BusDown, now);
        for index in 0..self.handle.image.drives.len() {
            self.desk.shadow.forget(index);
            self.report.offline(index, "its bus is down");
        }
        self.report.bus_down(why);
    }

    fn serve(&mut self, line: &Line) -> Result<(), Lost> {
        while !self.stopping() {
            let now = Instant::now();
            self.leases.look(&self.handle, now);
            match self.decide(now) {
                Ok(job) => self.work(line, job)?,
                Err(until) => self.idle(line, until.min(now + LOOK_ROUND))?,
            }
            let now = Instant::now();
            for late in self.desk.not_confirmed(&self.handle.image.drives, now) {
                self.report.not_confirmed(&late);
            }
            for drive in self.sessions.neglected(now) {
                self.schedule.ask(drive, now);
            }
            self.report.tick(now);
        }
        Ok(())
    }

    fn idle(&mut self, line: &Line, until: Instant) -> Result<(), Lost> {
        match line.wait(until, Some(self.handle.queue.wake_fd()), true)? {
            Woken::Readable => self.hear_noise(line),
            Woken::Command => {
                self.handle.queue.clear_wake();
                Ok(())
            }
            Woken::Time => Ok(()),
        }
    }

    /// Bytes that nobody asked for; the line is not silent while they come.
    fn hear_noise(&mut self, line: &Line) -> Result<(), Lost> {
        let mut buffer = [0u8; 512];
        let count = line.receive(&mut buffer)?;
        if count > 0 {
            let now = Instant::now();
            self.sessions.strayed();
            self.report
                .noise(buffer.get(..count).unwrap_or_default(), self.quiet_since, now);
            self.quiet_since = now;
        }
        Ok(())
    }

    /// What goes on the line next, or until when nothing does.
    fn decide(&mut self, now: Instant) -> Result<Job, Instant> {
        let drives = &self.handle.image.drives;
        let decided = self
            .desk
            .decide(drives, &mut self.handle.queue.lock(), &mut self.schedule, now);
        if let Some(round) = self.schedule.take_round() {
            self.report.fast_round(round.cycle);
        }
        decided
    }

    fn work(&mut self, line: &Line, job: Job) -> Result<(), Lost> {
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
        let refused = Reply::Exception(Exception::ADDRESS);
        match job {
            Job::Poll(poll) => self.polled(poll, Ended::Reply(refused), now, Duration::ZERO),
            Job::Command { index, pdu } => {
                let drives = &self.handle.image.drives;
                self.desk
                    .ended(*index, pdu, Some(refused), self.options.retries, drives, now);
            }
        }
    }

    /// A step that N2 needs before the job is over. The job is decided on anew, or has failed with it.
    fn session_went_on(
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
                let ended = match ended {
                    Ended::Corrupt(why) => Ended::Corrupt(why),
                    Ended::Silent | Ended::Reply(_) => Ended::Silent,
                };
                self.polled(poll, ended, began, took);
            }
            Job::Poll(_) => self.schedule.session_done(),
            Job::Command { index, .. } => {
                if let Some((_, urgency)) = self.desk.begun(*index) {
                    self.schedule.command_done(urgency, took);
                }
                if progress == Progress::Failed {
                    let (pdu, drives) = (RequestPdu::N2(step), &self.handle.image.drives);
                    self.desk.ended(*index, &pdu, None, self.options.retries, drives, now);
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
        self.echo = transaction.echoes(&ended).unwrap_or(self.echo);
        self.untimed |= match &ended {
            Ended::Reply(Reply::Exception(_)) => false,
            Ended::Reply(_) => !doubtful && Instant::now() < earliest,
            Ended::Silent | Ended::Corrupt(_) => transaction.doubted(),
        };
        self.paid = matches!(ended, Ended::Corrupt(_)) && transaction.is_paid();
        // Behind a fence what came instead of the reply may be what was owed, and the reply is still to come.
        let owed = !self.paid || self.sessions.is_fenced();
        if owed && matches!(ended, Ended::Silent | Ended::Corrupt(_)) {
            self.sessions
                .owes(drive, Instant::now() + self.options.response_timeout);
        }
        let took = Instant::now().saturating_duration_since(began) + self.silence;
        let came = wire.reply.min(spec.format.chars(transaction.seen().len()));
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

    fn polled(&mut self, poll: &Poll, ended: Ended, began: Instant, took: Duration) {
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
            self.report.look(poll.drive, began);
            self.report.look_at_supervision(poll.drive);
            self.desk.look(poll.drive, &self.handle.image.drives, now);
        }
    }

    fn store(&mut self, poll: &Poll, reply: &Reply, now: Instant) {
        let read = poll.read;
        let words: Vec<u16> = match reply {
            Reply::Registers(words) => words.clone(),
            Reply::Bits(bits) => bits.iter().map(|b| u16::from(*b)).collect(),
            _ => return,
        };
        let Some(drive) = self.handle.image.drives.get(poll.drive) else {
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

    fn commanded(&mut self, index: usize, pdu: &RequestPdu, ended: Ended, began: Instant, took: Duration) {
        let now = Instant::now();
        let Some((drive, urgency)) = self.desk.begun(index) else {
            return;
        };
        self.schedule.command_done(urgency, took);
        let heard = self.sessions.heard(drive, &ended);
        if heard == Progress::Restarted {
            self.restarted(drive, now);
        }
        let reply = match ended {
            // The drive did not look at it: it is said again, once the drive is identified.
            Ended::Reply(Reply::Exception(Exception::N2_RESTARTED)) => {
                let (pdu, drives) = (RequestPdu::N2(Session::Identify), &self.handle.image.drives);
                self.desk.ended(index, &pdu, None, self.options.retries, drives, now);
                return;
            }
            Ended::Reply(reply) => {
                self.schedule.seen(drive);
                let acknowledged = !matches!(reply, Reply::Exception(_));
                let late = urgency == Urgency::Stop && self.sessions.doubts_stop(drive);
                let late = late || self.desk.debts.proves_nothing(drive, pdu, began);
                if acknowledged && pdu.is_write() && late {
                    // It goes out once more.
                    self.desk.doubted(index);
                    self.desk.debts.answered(drive, pdu, now);
                    return;
                }
                if acknowledged {
                    self.desk.debts.answered(drive, pdu, now);
                }
                Some(reply)
            }
            Ended::Silent | Ended::Corrupt(_) => {
                self.owes(drive, pdu, began, now);
                None
            }
        };
        let drives = &self.handle.image.drives;
        self.desk.ended(index, pdu, reply, self.options.retries, drives, now);
        if let Some((table, items)) = written(pdu) {
            self.schedule
                .refresh(drive, |read| items.iter().any(|(a, _)| read.covers(table, *a)), now);
        }
    }
}

/// What the counters call an exchange that ended so.
pub(super) fn counted(ended: &Ended) -> Counted {
    match ended {
        Ended::Reply(Reply::Exception(_)) => Counted::Exception,
        Ended::Reply(_) => Counted::Ok,
        Ended::Silent => Counted::Timeout,
        Ended::Corrupt(_) => Counted::Corrupt,
    }
}
