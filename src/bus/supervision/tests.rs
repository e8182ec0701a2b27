use super::*;
use crate::bus::execute::{Execution, Next, Shadow};
use crate::cache::{Access, BusImage, BusSpec, DriveImage, Link, Supervision};
use crate::codec::n2::Session;
use crate::codec::{Exception, LineFormat, Protocol, Reply, RequestPdu, Table};
use crate::command::{Command, CommandQueue, Urgency, written};
use crate::drive::Profile;
use crate::drive::profile::Profiles;

/// A drive that answers.
fn image(spec: DriveSpec) -> DriveImage {
    let drive = DriveImage::new(spec, Duration::from_secs(1));
    drive.update(|s| s.link = Link::Online(SystemTime::now()));
    drive
}

struct Bench {
    bus: BusHandle,
    leases: Leases,
    now: Instant,
}

impl Bench {
    fn new(action: LeaseAction) -> Bench {
        Bench::of(Profiles::built_in().get("vacon-nx").unwrap(), action)
    }

    fn of(profile: &Arc<Profile>, action: LeaseAction) -> Bench {
        let spec = DriveSpec {
            access: Access::Control,
            supervision: Some(Supervision {
                timeout: Duration::from_secs(5),
                action,
                adopt: false,
            }),
            turnaround: Duration::ZERO,
            ..DriveSpec::new("d", "b", 1, profile.clone())
        };
        let bus = BusSpec {
            name: "b".to_string(),
            port: "none".to_string(),
            protocol: Protocol::ModbusRtu,
            format: LineFormat::new(38_400, "8N1").unwrap(),
            cycle: Duration::from_millis(10),
            slow_cycle: Duration::from_secs(1),
        };
        let drive = image(spec);
        Bench {
            bus: BusHandle {
                image: Arc::new(BusImage::new(bus, vec![Arc::new(drive)])),
                queue: Arc::new(CommandQueue::new().unwrap()),
            },
            leases: Leases::new(Events::default(), Arc::default()),
            now: Instant::now(),
        }
    }

    /// `ms` later the drive says whether it runs, and the leases are looked at: the rank of the action that is
    /// written then, and where its answer goes.
    fn after(&mut self, ms: u64, runs: bool) -> Option<Command> {
        self.now += Duration::from_millis(ms);
        let now = self.now;
        self.tells(ModelPoint::Running, Value::Bool(runs));
        self.leases.look(&self.bus, now);
        assert!(self.bus.queue.lock().len() <= 1, "one at a time");
        self.bus.queue.lock().pop(Urgency::Read, now)
    }

    /// The drive has that value now.
    fn tells(&self, point: ModelPoint, value: Value) {
        self.knows(point.name(), value);
    }

    fn knows(&self, point: &str, value: Value) {
        let drive = &self.bus.image.drives[0];
        let profile = &drive.spec.profile;
        let raw = profile.points[profile.point_index(point).unwrap()].raw().unwrap();
        let words = raw.encode(value, 0).unwrap();
        drive.update(|s| s.store(raw.table, raw.address, &words, self.now));
    }

    /// The bus starts anew with these settings, as in a reload.
    fn reload(&mut self, spec: DriveSpec) {
        self.leases.settle(&self.bus, self.now);
        let before = self.bus.image.drives[0].clone();
        let drive = image(spec);
        drive.take_over_lease(&before);
        self.bus = BusHandle {
            image: Arc::new(BusImage::new(self.bus.image.spec.clone(), vec![Arc::new(drive)])),
            queue: Arc::new(CommandQueue::new().unwrap()),
        };
        self.leases = Leases::new(self.leases.events.clone(), self.leases.stats.clone());
    }

    fn spec(&self) -> DriveSpec {
        self.bus.image.drives[0].spec.clone()
    }

    fn told(&self) -> usize {
        self.leases.events.recent().len()
    }
}

#[test]
fn the_action_is_written_once_and_again_until_it_is_acknowledged() {
    for (action, urgency) in [
        (LeaseAction::Stop, Urgency::Stop),
        (LeaseAction::SpeedReference(20.0), Urgency::Command),
    ] {
        let mut bench = Bench::new(action);
        assert!(bench.after(60_000, true).is_none(), "nobody commanded it");
        bench.bus.image.drives[0].renew_lease(bench.now);
        assert!(bench.after(4_900, true).is_none());
        for failed in [
            Outcome::TimedOut,
            Outcome::Exception(Exception::BUSY),
            Outcome::QueueFull,
        ] {
            let command = bench.after(1_000, true).expect("the action");
            assert_eq!(command.urgency, urgency);
            assert!(bench.after(10, true).is_none(), "not while its answer is waited for");
            command.ticket.answer(failed, bench.now);
            assert!(bench.after(10, true).is_none(), "a pause first");
        }
        // Also when the drive was seen to stand meanwhile: nobody knows why.
        let command = bench.after(1_000, false).expect("the action");
        command.ticket.answer(Outcome::Acknowledged(Reply::Written), bench.now);
        for _ in 0..20 {
            assert!(bench.after(1_000, true).is_none(), "once");
        }
        assert_eq!(bench.told(), 1);
        assert_eq!(bench.bus.image.drives[0].supervisions(), 1);
    }
}

#[test]
fn a_drive_that_stands_and_one_that_is_held_are_left_alone() {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.bus.image.drives[0].renew_lease(bench.now);
    assert!(bench.after(10_000, false).is_none());
    assert_eq!(bench.told(), 0);
    let mut bench = Bench::new(LeaseAction::Hold);
    bench.bus.image.drives[0].renew_lease(bench.now);
    assert!(bench.after(10_000, true).is_none());
    assert_eq!(bench.told(), 1);
}

/// What a command writes to a drive that has the run command: the point that takes it, and its value there.
fn writes(profile: &Profile, command: Command, now: Instant) -> Vec<(String, Value)> {
    let mut execution = Execution::new(command, profile);
    let (mut shadow, mut now, mut sets) = (Shadow::default(), now, Vec::new());
    for _ in 0..20 {
        let pdu = match execution.next(&shadow, profile, true, now) {
            Next::Done => break,
            Next::Wait(until) => {
                now = until;
                continue;
            }
            Next::Send(pdu) => pdu,
        };
        let reply = match &pdu {
            RequestPdu::Read {
                table: Table::Coil | Table::DiscreteInput,
                count,
                ..
            } => Reply::Bits(vec![true; usize::from(*count)]),
            // The run command is set wherever it is, so that a stop has something to take away.
            RequestPdu::Read { count, .. } => Reply::Registers(vec![0x0003; usize::from(*count)]),
            RequestPdu::N2(Session::Release { .. }) => Reply::Written,
            write => {
                let (table, items) = written(write).unwrap();
                let words: Vec<u16> = items.iter().map(|(_, word)| *word).collect();
                for point in profile.points.iter().filter(|p| p.write) {
                    if let Some(raw) = point.raw().filter(|r| (r.table, r.address) == (table, items[0].0)) {
                        sets.push((point.name.clone(), raw.decode(&words, point.kind()).unwrap()));
                    }
                }
                Reply::Written
            }
        };
        if execution.answered(&pdu, reply, &mut shadow).is_some() {
            break;
        }
    }
    assert!(
        execution.success().is_ok(),
        "{}: {:?}",
        profile.name,
        execution.success()
    );
    sets
}

#[test]
fn every_family_is_written_its_action() {
    for profile in Profiles::built_in().iter() {
        for action in [LeaseAction::Stop, LeaseAction::SpeedReference(20.0)] {
            let stop = action == LeaseAction::Stop;
            let mut bench = Bench::of(profile, action);
            let spec = DriveSpec {
                frequency_range: Some(0.0..=50.0),
                ..bench.spec()
            };
            bench.reload(spec);
            bench.bus.image.drives[0].renew_lease(bench.now);
            let command = bench.after(6_000, true).expect("the action");
            assert_eq!(command.urgency == Urgency::Stop, stop, "{}", profile.name);
            let sets = writes(profile, command, bench.now);
            let wanted: &[(&str, Value)] = if stop {
                &[("run", Value::Bool(false))]
            } else {
                // Whichever of them the drive takes.
                &[
                    ("speed_reference", Value::Number(20.0)),
                    ("frequency_reference", Value::Number(10.0)),
                    ("frequency_command", Value::Number(10.0)),
                ]
            };
            let is_wanted =
                |set: &(String, Value)| wanted.iter().any(|(name, value)| set.0 == *name && set.1 == *value);
            assert!(sets.iter().any(is_wanted), "{}: {sets:?}", profile.name);
        }
    }
}

#[test]
fn an_action_that_cannot_be_written_is_told_once_and_stays_owed() {
    let profiles = Profiles::built_in();
    let mut bench = Bench::of(profiles.get("vacon-cx").unwrap(), LeaseAction::SpeedReference(20.0));
    bench.bus.image.drives[0].renew_lease(bench.now);
    for _ in 0..10 {
        assert!(bench.after(5_000, true).is_none(), "the frequency range is not known");
    }
    let events = bench.leases.events.recent();
    assert_eq!(events.len(), 2, "{events:?}");
    assert!(events[1].text.contains("frequency_range"), "{}", events[1].text);
    assert!(events.iter().all(|e| e.kind == EventKind::Supervision));
    let audit = bench.leases.stats.audit().recent();
    assert_eq!(audit.iter().map(|r| r.result).collect::<Vec<_>>(), ["not_writable"]);
    bench.knows("maximum_frequency", Value::Number(50.0));
    let command = bench.after(1_000, true).expect("the drive tells its range now");
    command.ticket.answer(Outcome::Acknowledged(Reply::Written), bench.now);
    assert!(bench.after(1_000, true).is_none());
    // A client that is back has its own reference.
    let mut bench = Bench::of(profiles.get("vacon-cx").unwrap(), LeaseAction::SpeedReference(20.0));
    bench.bus.image.drives[0].renew_lease(bench.now);
    assert!(bench.after(5_000, true).is_none());
    bench.bus.image.drives[0].renew_lease(bench.now);
    bench.knows("maximum_frequency", Value::Number(50.0));
    assert!(bench.after(2_000, true).is_none(), "it commands the drive");
    assert!(bench.after(4_000, true).is_some(), "until it falls silent again");
}

#[test]
fn an_action_that_is_owed_outlives_the_bus() {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.bus.image.drives[0].renew_lease(bench.now);
    let command = bench.after(5_000, true).expect("the stop");
    command.ticket.answer(Outcome::TimedOut, bench.now);
    bench.reload(bench.spec());
    let command = bench.after(10, true).expect("the stop is owed still");
    assert_eq!(command.urgency, Urgency::Stop);
    // The bus ends while the stop is on its way.
    drop(command);
    bench.reload(bench.spec());
    let command = bench.after(10, false).expect("the stop is owed still");
    command.ticket.answer(Outcome::Acknowledged(Reply::Written), bench.now);
    bench.reload(bench.spec());
    assert!(
        bench.after(5_000, true).is_none(),
        "what was acknowledged last is not owed"
    );
    assert_eq!(bench.told(), 1);
    // Nothing is owed to a drive that is only monitored from now on, nor where nothing is to be written.
    for change in [
        (|spec: &mut DriveSpec| spec.access = Access::Monitor) as fn(&mut DriveSpec),
        |spec| spec.supervision = None,
        |spec| spec.supervision.as_mut().unwrap().action = LeaseAction::Hold,
    ] {
        let mut bench = Bench::new(LeaseAction::Stop);
        bench.bus.image.drives[0].renew_lease(bench.now);
        drop(bench.after(5_000, true).expect("the stop"));
        let mut spec = bench.spec();
        change(&mut spec);
        bench.reload(spec);
        assert!(bench.after(5_000, true).is_none());
    }
}

#[test]
fn an_action_waits_for_a_drive_that_does_not_answer() {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.bus.image.drives[0].renew_lease(bench.now);
    let command = bench.after(5_000, true).expect("the stop");
    command.ticket.answer(Outcome::TimedOut, bench.now);
    let link = |bench: &Bench, link| bench.bus.image.drives[0].update(|s| s.link = link);
    link(&bench, Link::Offline(SystemTime::now()));
    for _ in 0..10 {
        assert!(bench.after(1_000, true).is_none());
    }
    link(&bench, Link::Online(SystemTime::now()));
    assert!(bench.after(1, false).is_some(), "at once when it is back");
}

#[test]
fn a_motor_that_may_start_by_itself_keeps_its_lease() {
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.bus.image.drives[0].renew_lease(bench.now);
    // A fault, with the run command left in the drive's word.
    for _ in 0..10 {
        bench.tells(ModelPoint::Run, Value::Bool(true));
        assert!(bench.after(1_000, false).is_none());
    }
    assert_eq!(bench.told(), 0);
    assert!(bench.after(10, true).is_some(), "it started by it");
    // The run command was taken away.
    let mut bench = Bench::new(LeaseAction::Stop);
    bench.bus.image.drives[0].renew_lease(bench.now);
    bench.tells(ModelPoint::Run, Value::Bool(true));
    assert!(bench.after(6_000, false).is_none());
    bench.tells(ModelPoint::Run, Value::Bool(false));
    assert!(bench.after(10, false).is_none());
    assert!(bench.after(10, true).is_none(), "started by someone else");
    assert_eq!(bench.told(), 0);
}
