//! Random interleavings of commands, faults, losses, stops and the end, in virtual time: every command is answered
//! exactly once, nothing runs behind a stop, nothing expired is sent, no queue grows without bound.

use std::collections::BTreeMap;

use proptest::prelude::*;
use tokio::sync::oneshot::Receiver;

use super::*;
use crate::bus::schedule::{Cadence, Change, Polled};
use crate::cache::{Access, DriveSpec, Link};
use crate::codec::{Exception, Reply, Table};
use crate::command::{Answer, Authority, CommandQueue, Origin, SourceKind, Ticket, WriteStats, admit, written};
use crate::drive::profile::Profiles;
use crate::drive::{Plan, Profile, Value};

mod scripts;

const DRIVES: usize = 3;
const CONTROL: u16 = 2000;
const REFERENCE: u16 = 2002;
const RETRIES: u32 = 1;

/// How the line treats an exchange.
#[derive(Debug, Clone, Copy)]
enum Line {
    Good,
    Exception,
    /// The drive does as it is told, the answer is lost.
    AnswerLost,
    /// The drive does as it is told; the acknowledgement of a write comes when it is not waited for any more.
    AnswerLate,
    RequestLost,
}

/// An acknowledgement that is under way.
#[derive(Debug)]
struct Late {
    drive: usize,
    pdu: RequestPdu,
    sent: Instant,
    /// It comes before then, or not at all.
    until: Instant,
}

/// Whether both writes are acknowledged by the same bytes.
fn look_alike(a: &RequestPdu, b: &RequestPdu) -> bool {
    match (a, b) {
        (
            RequestPdu::WriteRegisters { start: a, values: of_a },
            RequestPdu::WriteRegisters { start: b, values: of_b },
        ) => a == b && of_a.len() == of_b.len(),
        _ => a == b,
    }
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    Run,
    Stop,
    Reference,
    RunAtReference,
    Reset,
    Reverse,
    RawRun,
    RawStop,
    /// By function 16.
    RawRuns,
    RawStops,
    RawRead,
}

#[derive(Debug, Clone, Copy)]
enum Step {
    Command {
        client: u8,
        drive: usize,
        kind: Kind,
        expires_ms: u64,
    },
    Exchange(Line),
    Wait(u64),
    PortLost,
    PortBack,
    LastStops,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let kind = prop_oneof![
        Just(Kind::Run),
        Just(Kind::Stop),
        Just(Kind::Reference),
        Just(Kind::RunAtReference),
        Just(Kind::Reset),
        Just(Kind::Reverse),
        Just(Kind::RawRun),
        Just(Kind::RawStop),
        Just(Kind::RawRuns),
        Just(Kind::RawStops),
        Just(Kind::RawRead),
    ];
    let command = (0u8..4, 0..DRIVES, kind, 1u64..400);
    let command = command.prop_map(|(client, drive, kind, expires_ms)| Step::Command {
        client,
        drive,
        kind,
        expires_ms,
    });
    let line = prop_oneof![
        8 => Just(Line::Good),
        1 => Just(Line::Exception),
        1 => Just(Line::AnswerLost),
        2 => Just(Line::AnswerLate),
        1 => Just(Line::RequestLost),
    ];
    let step = prop_oneof![
        30 => command,
        60 => line.prop_map(Step::Exchange),
        5 => (1u64..300).prop_map(Step::Wait),
        1 => Just(Step::PortLost),
        3 => Just(Step::PortBack),
        1 => Just(Step::LastStops),
    ];
    proptest::collection::vec(step, 1..400)
}

struct Model {
    profile: Arc<Profile>,
    drives: Vec<Arc<DriveImage>>,
    queue: CommandQueue,
    schedule: Schedule,
    desk: Desk,
    stats: Arc<WriteStats>,
    now: Instant,
    up: bool,
    /// Control word and reference of each drive.
    words: Vec<BTreeMap<u16, u16>>,
    /// Until when a run of each drive may go out; `None` behind a stop.
    may_run: Vec<Option<Instant>>,
    /// Until when each reference may go out: references are told apart by their values.
    references: BTreeMap<u16, Instant>,
    late: Vec<Late>,
    answers: Vec<Receiver<Answer>>,
    writes: u64,
}

impl Model {
    fn new() -> Model {
        let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
        let now = Instant::now();
        let drive = |index: usize| {
            let spec = DriveSpec {
                access: Access::Control,
                turnaround: Duration::ZERO,
                ..DriveSpec::new(&format!("d{index}"), "b", 1, profile.clone())
            };
            Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
        };
        let drives: Vec<_> = (0..DRIVES).map(drive).collect();
        let cadence = Cadence {
            fast: Duration::from_millis(10),
            slow: Duration::from_millis(100),
            retries: RETRIES,
        };
        let plans: Vec<&Plan> = drives.iter().map(|d| &d.plan).collect();
        let schedule = Schedule::new(cadence, &plans, |_, _| Duration::from_millis(5), now);
        Model {
            profile,
            schedule,
            queue: CommandQueue::new().unwrap(),
            desk: Desk::default(),
            stats: Arc::default(),
            now,
            up: true,
            words: vec![BTreeMap::from([(CONTROL, 0), (REFERENCE, 0)]); DRIVES],
            may_run: vec![None; DRIVES],
            references: BTreeMap::new(),
            late: Vec::new(),
            answers: Vec::new(),
            writes: 0,
            drives,
        }
    }

    /// One whose drives were found.
    fn found() -> Model {
        let mut model = Model::new();
        model.goes_well(60);
        model
    }

    fn goes_well(&mut self, exchanges: usize) {
        for _ in 0..exchanges {
            self.exchange(Line::Good);
        }
    }

    fn point(&self, name: &str) -> usize {
        self.profile.point_index(name).unwrap()
    }

    fn command(&mut self, client: u8, drive: usize, kind: Kind, expiry: Duration) {
        let expires = self.now + expiry;
        // Within what the profile allows, each but once.
        let word = u16::try_from(self.references.len() % 10_000).unwrap();
        let reference = (self.point("speed_reference"), Value::Number(f64::from(word) / 100.0));
        let run = |on: bool| (self.point("run"), Value::Bool(on));
        let raw = |value: u16| {
            Order::Write(RequestPdu::WriteRegister {
                address: CONTROL,
                value,
            })
        };
        let raws = |value: u16| {
            Order::Write(RequestPdu::WriteRegisters {
                start: CONTROL,
                values: vec![value, 0],
            })
        };
        let order = match kind {
            Kind::Run => Order::Points(vec![run(true)]),
            Kind::Stop => Order::Points(vec![run(false)]),
            Kind::Reference => Order::Points(vec![reference]),
            Kind::RunAtReference => Order::Points(vec![run(true), reference]),
            Kind::Reset => Order::Points(vec![(self.point("fault_reset"), Value::Bool(true))]),
            Kind::Reverse => Order::Points(vec![(self.point("reverse"), Value::Bool(true))]),
            Kind::RawRun => raw(1),
            Kind::RawStop => raw(0),
            Kind::RawRuns => raws(1),
            Kind::RawStops => raws(0),
            Kind::RawRead => Order::Read(RequestPdu::Read {
                table: Table::Holding,
                start: 1500,
                count: 1,
            }),
        };
        let origin = Origin::new(SourceKind::Mqtt, client.to_string());
        let write = !matches!(order, Order::Read(_));
        let (ticket, answer) = Ticket::new(origin, "d", String::new(), write, self.now, self.stats.clone());
        self.answers.push(answer);
        self.writes += u64::from(write);
        if matches!(kind, Kind::Reference | Kind::RunAtReference) {
            self.references.insert(word, expires);
        }
        let reading = self.drives[drive].reading(self.now, Duration::from_secs(1));
        let admitted = admit(order, &reading, Authority::Write).unwrap();
        let offline = !reading.snapshot.link.is_online();
        match kind {
            _ if offline => {}
            Kind::Stop | Kind::RawStop | Kind::RawStops => self.may_run[drive] = None,
            Kind::Run | Kind::RunAtReference | Kind::RawRun | Kind::RawRuns => {
                self.may_run[drive] = self.may_run[drive].max(Some(expires));
            }
            _ => {}
        }
        if offline {
            ticket.answer(Outcome::Offline, self.now);
            return;
        }
        let command = Command {
            drive,
            order: admitted.order,
            urgency: admitted.urgency,
            reference_only: admitted.reference_only,
            expires,
            ticket,
        };
        self.queue.submit(command, self.now);
    }

    /// The drive takes a request; what it answers.
    fn drive_does(&mut self, drive: usize, pdu: &RequestPdu) -> Reply {
        match pdu {
            RequestPdu::Read { start, count, .. } => Reply::Registers(
                (0..*count)
                    .map(|i| self.words[drive].get(&(start + i)).copied().unwrap_or(0))
                    .collect(),
            ),
            other => {
                let (_, items) = written(other).expect("a read or a write");
                self.words[drive].extend(items);
                Reply::Written
            }
        }
    }

    /// What must hold of all that goes out.
    fn check(&self, drive: usize, pdu: &RequestPdu) {
        for (address, value) in written(pdu).map(|(_, items)| items).unwrap_or_default() {
            if address == CONTROL && value & 1 == 1 && self.words[drive][&CONTROL] & 1 == 0 {
                let until = self.may_run[drive].expect("a run went out behind a stop");
                assert!(self.now < until, "an expired run went out");
            }
            if address == REFERENCE {
                assert!(self.now < self.references[&value], "an expired reference went out");
            }
        }
    }

    fn exchange(&mut self, line: Line) {
        if !self.up {
            return;
        }
        for _ in 0..100 {
            let decided = self
                .desk
                .decide(&self.drives, &mut self.queue.lock(), &mut self.schedule, self.now);
            assert!(self.desk.begun.len() <= BEGUN + CAPACITY && self.queue.lock().len() <= CAPACITY);
            match decided {
                Err(until) if until <= self.now => {}
                Err(until) => {
                    self.now = until;
                    return;
                }
                Ok(job) => {
                    self.work(job, line);
                    return;
                }
            }
        }
        panic!("the desk does not come to a decision");
    }

    fn work(&mut self, job: Job, line: Line) {
        let (drive, pdu) = match &job {
            Job::Poll(poll) => (poll.drive, poll.read.pdu()),
            Job::Command { index, pdu } => (self.desk.begun(*index).unwrap().0, pdu.clone()),
        };
        self.check(drive, &pdu);
        let began = self.now;
        let reply = self.on_the_line(drive, &pdu, line);
        let took = Duration::from_millis(if reply.is_some() { 5 } else { 50 });
        self.now += took;
        let answered = match &reply {
            None => {
                self.desk.debts.given_up(drive, &pdu, began, self.now);
                false
            }
            Some(reply) => !matches!(reply, Reply::Exception(_)),
        };
        match job {
            Job::Poll(poll) => {
                if answered {
                    self.desk.debts.answered(drive, &pdu, self.now);
                }
                self.polled(&poll, reply, took);
            }
            Job::Command { index, pdu } => {
                let urgency = self.desk.begun(index).unwrap().1;
                self.schedule.command_done(urgency, took);
                if answered && !self.desk.believes(index, &pdu, false, began, self.now) {
                    return;
                }
                for (address, value) in written(&pdu).filter(|_| answered).map(|w| w.1).unwrap_or_default() {
                    assert_eq!(self.words[drive][&address], value, "what was acknowledged was done");
                }
                let ended = reply.map_or(Ended::Silent, Ended::Reply);
                self.desk.ended(index, &pdu, ended, RETRIES, &self.drives, self.now);
            }
        }
        self.desk.look(drive, &self.drives, self.now);
        self.desk.not_confirmed(&self.drives, self.now);
    }

    /// What comes back for a request: its own reply, or an acknowledgement that comes late and looks the same.
    fn on_the_line(&mut self, drive: usize, pdu: &RequestPdu, line: Line) -> Option<Reply> {
        let now = self.now;
        self.late.retain(|late| late.until > now);
        let alike = |late: &Late| late.drive == drive && look_alike(&late.pdu, pdu);
        let older = self.late.iter().position(alike).map(|index| self.late.remove(index));
        let heard = !matches!(line, Line::Exception | Line::RequestLost);
        let own = heard.then(|| self.drive_does(drive, pdu));
        let wait = match (&older, line) {
            // Each reply is as late as the one before.
            (Some(older), Line::Good | Line::AnswerLate) => now - older.sent,
            (_, Line::AnswerLate) => Duration::from_secs(1),
            _ => Duration::ZERO,
        };
        let kept = self
            .late
            .iter()
            .filter(|late| late.drive == drive && late.pdu == *pdu)
            .count();
        if pdu.is_write() && !wait.is_zero() && kept < 3 {
            self.late.push(Late {
                drive,
                pdu: pdu.clone(),
                sent: now,
                until: now + wait.min(Duration::from_secs(1)),
            });
        }
        match line {
            _ if older.is_some() => Some(Reply::Written),
            Line::Good => own,
            Line::Exception => Some(Reply::Exception(Exception::BUSY)),
            Line::AnswerLost | Line::AnswerLate | Line::RequestLost => None,
        }
    }

    fn polled(&mut self, poll: &Poll, reply: Option<Reply>, took: Duration) {
        let now = self.now;
        let polled = match &reply {
            Some(Reply::Registers(words)) => {
                for (address, word) in (poll.read.start..).zip(words) {
                    if (CONTROL..=CONTROL + 10).contains(&address) {
                        self.desk.shadow.learn(poll.drive, Table::Holding, address, *word);
                    }
                }
                let read = poll.read;
                self.drives[poll.drive].update(|s| s.store(read.table, read.start, words, now));
                Polled::Ok
            }
            Some(_) => Polled::Refused(Exception::BUSY),
            None => Polled::Failed,
        };
        let link = match self.schedule.poll_done(poll, polled, took, now) {
            Change::Online => Link::Online(std::time::SystemTime::UNIX_EPOCH),
            Change::Offline => {
                self.desk.shadow.forget(poll.drive);
                let gone = |c: &Command| c.drive == poll.drive;
                self.queue.lock().remove(now, &Outcome::Offline, gone);
                Link::Offline(std::time::SystemTime::UNIX_EPOCH)
            }
            _ => return,
        };
        self.drives[poll.drive].update(|s| s.link = link);
    }

    fn port(&mut self, up: bool) {
        if up == self.up {
            return;
        }
        self.up = up;
        if up {
            self.schedule.reset(self.now);
            self.queue.open();
            return;
        }
        self.queue.close(Outcome::BusDown, self.now);
        self.desk.close(&Outcome::BusDown, self.now);
        let told = self.stats.results().values().sum::<u64>();
        assert_eq!(told, self.writes, "nobody waits for a drive that is away");
        for index in 0..DRIVES {
            self.desk.shadow.forget(index);
            self.drives[index].update(|s| s.link = Link::Offline(std::time::SystemTime::UNIX_EPOCH));
        }
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Command {
                client,
                drive,
                kind,
                expires_ms,
            } => self.command(client, drive, kind, Duration::from_millis(expires_ms)),
            Step::Exchange(line) => self.exchange(line),
            Step::Wait(ms) => self.now += Duration::from_millis(ms),
            Step::PortLost => self.port(false),
            Step::PortBack => self.port(true),
            Step::LastStops => self.queue.stops_only(self.now),
        }
    }

    /// The gateway ends; every command has one answer by then.
    fn end(mut self) {
        self.queue.close(Outcome::ShuttingDown, self.now);
        self.desk.close(&Outcome::ShuttingDown, self.now);
        drop(self.desk);
        for (index, answer) in self.answers.iter_mut().enumerate() {
            assert!(answer.try_recv().is_ok(), "command {index} has no answer");
        }
        assert_eq!(
            self.stats.results().values().sum::<u64>(),
            self.writes,
            "one answer each"
        );
        let kept = crate::command::AUDIT_KEPT;
        let audited = usize::try_from(self.writes).unwrap().min(kept);
        assert_eq!(self.stats.audit().recent().len(), audited, "one record each");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn one_answer_each_and_nothing_runs_behind_a_stop(steps in steps()) {
        let mut model = Model::found();
        for step in steps {
            model.take(step);
        }
        model.end();
    }
}
