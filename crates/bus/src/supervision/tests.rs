use drivegate_testkit::{audited, bus_spec, controlled, next_command, nx, online, submit, window};
use std::sync::Arc;
use std::time::SystemTime;

use super::*;
use crate::command_run::{CommandRun, Need, Next, Step};
use crate::drive_state::{DriveState, NextNeed};
use crate::master::supervise;
use crate::n2_late_replies::N2LateReplies;
use drivegate_core::order::{
    Command, DEFAULT_EXPIRY, Interruption, Order, Origin, Outcome, SourceKind, Urgency, written,
};
use drivegate_core::plant::BusHandle;
use drivegate_core::process_image::{Access, BusSpec, DriveImage, DriveSpec, Link, Supervision as Settings};
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{Derived, DriveIndex, Profile, Source};
use drivegate_proto::n2::Session;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

mod begins;
mod chance;
mod found;
mod suspended;
mod unknown;

/// The image of a drive that answers.
fn image(spec: DriveSpec) -> DriveImage {
    let drive = DriveImage::new(spec, Duration::from_secs(1));
    online(&drive);
    drive
}

fn handle(spec: BusSpec, drive: DriveImage) -> BusHandle {
    drivegate_testkit::bus(spec, vec![Arc::new(drive)])
}

fn acknowledged() -> Outcome {
    Outcome::Acknowledged(Reply::Written)
}

/// A drive whose lease is evaluated as the master does.
struct SupervisedDrive {
    bus: BusHandle,
    drive: DriveState,
    news: Vec<News>,
    now: Instant,
}

impl SupervisedDrive {
    fn new(action: LeaseAction) -> SupervisedDrive {
        SupervisedDrive::of(&nx(), action)
    }

    fn of(profile: &Arc<Profile>, action: LeaseAction) -> SupervisedDrive {
        let spec = DriveSpec {
            supervision: Some(Settings {
                timeout: Duration::from_secs(5),
                action,
                adopt: false,
            }),
            turnaround: Duration::ZERO,
            ..controlled("d", "b", 1, profile)
        };
        SupervisedDrive {
            drive: DriveState::new(&spec, Duration::ZERO),
            bus: handle(bus_spec("b"), image(spec)),
            news: Vec::new(),
            now: Instant::now(),
        }
    }

    fn image(&self) -> Arc<DriveImage> {
        self.bus.image.drives[0].clone()
    }

    fn heartbeat(&self) {
        self.image().renew_lease(self.now);
    }

    /// Evaluates the lease.
    fn supervise(&mut self) {
        let (bus, now) = (self.bus.clone(), self.now);
        supervise(
            &bus,
            DriveIndex::new(0),
            &self.image(),
            &mut self.drive,
            now,
            &mut self.news,
        );
    }

    /// Lets the drive show `ms` later whether it runs, and evaluates its lease.
    fn look(&mut self, ms: u64, runs: bool) {
        self.now += Duration::from_millis(ms);
        self.shows(ModelPoint::Running, Value::Bool(runs));
        self.supervise();
    }

    /// Takes the next command of the queue.
    fn take(&self) -> Option<Command> {
        next_command(&mut self.bus.queue.lock(), Urgency::Read, self.now)
    }

    /// Evaluates like [`SupervisedDrive::look`]; returns the action written then, and the receiver of its answer.
    fn after(&mut self, ms: u64, runs: bool) -> Option<Command> {
        self.look(ms, runs);
        assert!(self.bus.queue.lock().len() <= 1, "one at a time");
        let action = self.take();
        assert!(action.as_ref().is_none_or(is_action));
        action
    }

    /// Lets the drive show this value now.
    fn shows(&self, point: ModelPoint, value: Value) {
        self.knows(point.name(), value);
    }

    fn knows(&self, point: &str, value: Value) {
        let drive = self.image();
        let profile = &drive.spec.profile;
        let point = &profile.points.get(profile.point_index(point).unwrap()).unwrap();
        // The state is a bit of a register that is also a point.
        let (raw, value) = match &point.source {
            Source::Derived(Derived::State { any }) => {
                let held = if value.as_bool() {
                    any[0].is
                } else {
                    !any[0].is & any[0].mask
                };
                (
                    profile.points.get(any[0].point).unwrap().raw().unwrap(),
                    Value::Number(held as f64),
                )
            }
            _ => (point.raw().unwrap(), value),
        };
        let words = raw.encode(value, 0).unwrap();
        drive.update(|s| s.store(raw.table, raw.address, &words, self.now));
    }

    /// Restarts the bus with these settings, as a reload does.
    fn reload(&mut self, spec: DriveSpec) {
        self.drive
            .close(&Outcome::ShuttingDown, Interruption::ShuttingDown, self.now);
        let lease = self.drive.supervision.lease();
        self.drive = DriveState::new(&spec, Duration::ZERO);
        self.bus = handle(self.bus.image.spec.clone(), image(spec));
        self.drive.supervision.take_over(lease);
    }

    fn spec(&self) -> DriveSpec {
        self.image().spec.clone()
    }

    /// Number of leases reported to have expired while the drive ran.
    fn reported(&self) -> usize {
        let ran_out = |news: &&News| matches!(news, News::LeaseRanOut(_));
        self.news.iter().filter(ran_out).count()
    }

    /// Audit results of the gateway's own orders.
    fn own_results(&self) -> Vec<serde_json::Value> {
        let audit = audited(self.bus.command_log.audit());
        let own = audit.iter().filter(|r| r["source"] == SourceKind::Supervision.name());
        own.map(|r| r["result"].clone()).collect()
    }

    /// A reference of a client waits from now on.
    fn order(&self) -> Receiver<Answer> {
        self.order_of(ModelPoint::SpeedReference, Value::Number(30.0))
    }

    fn order_of(&self, point: ModelPoint, value: Value) -> Receiver<Answer> {
        let image = self.image();
        let index = image.spec.profile.model_index(point).unwrap();
        let order = Order::Points(vec![(index, value)]);
        let origin = Origin::new(SourceKind::Mqtt, "client");
        let window = window(self.now, DEFAULT_EXPIRY);
        submit(&self.bus, DriveIndex::new(0), origin, order, window, self.now)
    }

    /// Starts the waiting command on the line.
    fn begin(&mut self) {
        let command = self.take().expect("an order");
        self.drive.begin(CommandRun::new(command, &self.image().spec.profile));
    }

    /// Sends the next step of the started command.
    fn send(&mut self) -> (Urgency, Step) {
        let Need::Next(NextNeed::Step(urgency, step)) =
            self.drive.next_need(&self.image(), &N2LateReplies::default(), self.now)
        else {
            panic!("nothing to send")
        };
        self.drive.sent(urgency, &step, self.now);
        (urgency, step)
    }

    fn end(&mut self, outcome: &Outcome) {
        self.drive.end(Urgency::Command, outcome, &self.image(), self.now);
    }
}

fn is_action(command: &Command) -> bool {
    command.ticket.origin().kind == SourceKind::Supervision
}

#[test]
fn the_action_is_written_once_and_again_until_it_is_acknowledged() {
    for (action, urgency) in [
        (LeaseAction::Stop, Urgency::Stop),
        (LeaseAction::SpeedReference(20.0), Urgency::Command),
    ] {
        let mut rig = SupervisedDrive::new(action);
        assert!(rig.after(60_000, true).is_none(), "nobody commanded it");
        rig.heartbeat();
        assert!(rig.after(4_900, true).is_none());
        for failed in [
            Outcome::TimedOut,
            Outcome::Exception(Exception::BUSY),
            Outcome::QueueFull,
        ] {
            let command = rig.after(1_000, true).expect("the action");
            assert_eq!(command.urgency(), urgency);
            assert!(rig.after(10, true).is_none(), "not while its answer is waited for");
            command.answer(&failed, rig.now);
            assert!(rig.after(10, true).is_none(), "a pause first");
        }
        // The action is not repeated, even if the drive was seen standing meanwhile: the cause of the standstill is
        // unknown.
        let command = rig.after(1_000, false).expect("the action");
        command.answer(&acknowledged(), rig.now);
        for _ in 0..20 {
            assert!(rig.after(1_000, true).is_none(), "once");
        }
        assert_eq!(rig.reported(), 1);
    }
}

#[test]
fn a_drive_that_stands_and_one_that_is_held_are_left_alone() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    assert!(rig.after(10_000, false).is_none());
    assert_eq!(rig.reported(), 0);
    let mut rig = SupervisedDrive::new(LeaseAction::LeaveRunning);
    rig.heartbeat();
    assert!(rig.after(10_000, true).is_none());
    assert_eq!(rig.reported(), 1);
}

/// Writes of a command to a drive that has its run command on: the point that is written, and its value.
fn writes(profile: &Profile, command: Command, now: Instant) -> Vec<(String, Value)> {
    let mut run = CommandRun::new(command, profile);
    let (mut words, mut now, mut sets) = (KnownWords::default(), now, Vec::new());
    for _ in 0..20 {
        let step = match run.next(&words, profile, true, now) {
            Next::Done => break,
            Next::Wait(until) => {
                now = until;
                continue;
            }
            Next::Send(step) => step,
        };
        let reply = match &step.pdu {
            RequestPdu::Read {
                table: Table::Coil | Table::DiscreteInput,
                count,
                ..
            } => Reply::Bits(vec![true; usize::from(*count)]),
            // The run command reads as set in every register, so that a stop has something to take away.
            RequestPdu::Read { count, .. } => Reply::Registers(vec![0x0003; usize::from(*count)]),
            RequestPdu::N2(Session::Release { .. }) => Reply::Written,
            write => {
                let (table, items) = written(write).unwrap();
                let words: Vec<u16> = items.iter().map(|(_, word)| *word).collect();
                if let Some(run) = profile.runs_by(table, items[0].0, words[0]) {
                    sets.push(("run".to_string(), Value::Bool(run)));
                }
                for point in profile.points.iter().filter(|p| p.write) {
                    if let Some(raw) = point.raw().filter(|r| (r.table, r.address) == (table, items[0].0)) {
                        sets.push((point.name.clone(), raw.decode(&words, point.kind()).unwrap()));
                    }
                }
                Reply::Written
            }
        };
        if run.answered(&step, reply, &mut words).is_some() {
            break;
        }
    }
    assert!(run.success().is_ok(), "{}: {:?}", profile.name, run.success());
    sets
}

#[test]
fn every_family_is_written_its_action() {
    let is_commanded = |profile: &&Arc<Profile>| profile.model_index(ModelPoint::Run).is_some();
    for profile in Profiles::built_in().iter().filter(is_commanded) {
        for action in [LeaseAction::Stop, LeaseAction::SpeedReference(20.0)] {
            let stop = action == LeaseAction::Stop;
            let mut rig = SupervisedDrive::of(profile, action);
            let spec = DriveSpec {
                frequency_range: Some(0.0..=50.0),
                ..rig.spec()
            };
            rig.reload(spec);
            rig.heartbeat();
            let command = rig.after(6_000, true).expect("the action");
            assert_eq!(command.urgency() == Urgency::Stop, stop, "{}", profile.name);
            let sets = writes(profile, command, rig.now);
            let wanted: &[(&str, Value)] = if stop {
                &[("run", Value::Bool(false))]
            } else {
                // A drive takes one of these two references.
                &[
                    ("speed_reference", Value::Number(20.0)),
                    ("frequency_reference", Value::Number(10.0)),
                    ("frequency_command", Value::Number(10.0)),
                ]
            };
            let is_wanted = |set: &(String, Value)| {
                wanted.iter().any(|(name, value)| {
                    // Values are compared within the resolution of the register.
                    set.0 == *name && (set.1.as_f64() - value.as_f64()).abs() < 0.02
                })
            };
            assert!(sets.iter().any(is_wanted), "{}: {sets:?}", profile.name);
        }
    }
}

#[test]
fn a_reference_of_the_action_keeps_the_direction_of_a_signed_reference() {
    for (in_force, age_ms, limit, expected) in [
        (-40.0, 0, -100.0, -20.0),
        (40.0, 0, -100.0, 20.0),
        (-40.0, 5_900, -100.0, -20.0),
        (-40.0, 0, 0.0, 20.0),
    ] {
        let profile = drivegate_testkit::profile("danfoss-fc");
        let mut rig = SupervisedDrive::of(&profile, LeaseAction::SpeedReference(20.0));
        let mut spec = rig.spec();
        spec.limits.insert("speed_reference".to_string(), limit..=100.0);
        rig.reload(spec);
        rig.heartbeat();
        rig.now += Duration::from_millis(5_900 - age_ms);
        rig.shows(ModelPoint::SpeedReference, Value::Number(in_force));
        rig.now += Duration::from_millis(age_ms);
        // Limits that exclude the sign refuse the first try.
        let first = rig.after(100, true);
        let command = first.or_else(|| rig.after(1_000, true)).expect("the action");
        let sets = writes(&profile, command, rig.now);
        let written = sets
            .iter()
            .find(|(name, _)| name == "speed_reference")
            .map(|(_, value)| value.as_f64());
        assert!(
            written.is_some_and(|value| (value - expected).abs() < 0.02),
            "{in_force}, {age_ms} ms: {sets:?}"
        );
    }
}

#[test]
fn an_action_that_fails_is_told_once_for_each_reason_and_counted_each_time() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    assert!(rig.after(4_900, true).is_none());
    let refused = Outcome::Exception(Exception::DEVICE_FAILURE);
    for failed in [&refused, &refused, &Outcome::TimedOut, &refused, &Outcome::Purged] {
        let command = rig.after(1_000, true).expect("the stop");
        command.answer(failed, rig.now);
        rig.look(10, true);
    }
    let command = rig.after(1_000, true).expect("the stop");
    command.answer(&acknowledged(), rig.now);
    rig.look(10, true);
    let failed = |why: Option<&Outcome>| News::ActionFailed {
        drive: DriveIndex::new(0),
        why: why.map(Outcome::to_string),
    };
    let taken = News::ActionTaken {
        drive: DriveIndex::new(0),
        failures: 4,
    };
    let expected = [
        News::LeaseRanOut(DriveIndex::new(0)),
        failed(Some(&refused)),
        failed(None),
        failed(Some(&Outcome::TimedOut)),
        failed(None),
        taken,
    ];
    assert_eq!(rig.news, expected, "a client's own stop is no failure");
}

#[test]
fn an_action_that_cannot_be_written_is_told_once_and_stays_due() {
    let profiles = Profiles::built_in();
    let mut rig = SupervisedDrive::of(profiles.get("vacon-cx").unwrap(), LeaseAction::SpeedReference(20.0));
    rig.heartbeat();
    for _ in 0..10 {
        assert!(rig.after(5_000, true).is_none(), "the frequency range is not known");
    }
    let [News::LeaseRanOut(_), News::ActionRefused { refusal, .. }] = &rig.news[..] else {
        panic!("{:?}", rig.news)
    };
    assert!(refusal.to_string().contains("frequency_range"), "{refusal}");
    assert_eq!(rig.own_results(), ["not_writable"]);
    rig.knows("maximum_frequency", Value::Number(50.0));
    let command = rig.after(1_000, true).expect("the drive reports its range now");
    command.answer(&acknowledged(), rig.now);
    assert!(rig.after(1_000, true).is_none());
    // A client that returns has its own reference.
    let mut rig = SupervisedDrive::of(profiles.get("vacon-cx").unwrap(), LeaseAction::SpeedReference(20.0));
    rig.heartbeat();
    assert!(rig.after(5_000, true).is_none());
    rig.heartbeat();
    rig.knows("maximum_frequency", Value::Number(50.0));
    assert!(rig.after(2_000, true).is_none(), "it commands the drive");
    rig.knows("maximum_frequency", Value::Number(50.0));
    assert!(rig.after(3_000, true).is_some(), "until it falls silent again");
}

#[test]
fn an_action_that_is_due_outlives_the_bus() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    let command = rig.after(5_000, true).expect("the stop");
    command.answer(&Outcome::TimedOut, rig.now);
    rig.reload(rig.spec());
    let command = rig.after(10, true).expect("the stop is due still");
    assert_eq!(command.urgency(), Urgency::Stop);
    // The bus ends while the stop is being sent.
    drop(command);
    rig.reload(rig.spec());
    let command = rig.after(10, false).expect("the stop is due still");
    command.answer(&acknowledged(), rig.now);
    rig.reload(rig.spec());
    assert!(
        rig.after(5_000, true).is_none(),
        "what was acknowledged last is not due again"
    );
    assert_eq!(rig.reported(), 1);
    // No action is due for a drive that is only monitored from now on, nor if nothing is to be written.
    for change in [
        (|spec: &mut DriveSpec| spec.access = Access::Monitor) as fn(&mut DriveSpec),
        |spec| spec.supervision = None,
        |spec| spec.supervision.as_mut().unwrap().action = LeaseAction::LeaveRunning,
    ] {
        let mut rig = SupervisedDrive::new(LeaseAction::Stop);
        rig.heartbeat();
        drop(rig.after(5_000, true).expect("the stop"));
        let mut spec = rig.spec();
        change(&mut spec);
        rig.reload(spec);
        assert!(rig.after(5_000, true).is_none());
    }
}

#[test]
fn a_lease_that_runs_outlives_the_bus() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    assert!(rig.after(3_000, true).is_none());
    rig.reload(rig.spec());
    assert!(rig.after(1_900, true).is_none());
    assert!(rig.after(100, true).is_some());
}

#[test]
fn an_action_waits_for_a_drive_that_does_not_answer() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    let command = rig.after(5_000, true).expect("the stop");
    command.answer(&Outcome::TimedOut, rig.now);
    let link = |rig: &SupervisedDrive, link| rig.image().update(|s| s.link = link);
    link(&rig, Link::Offline(SystemTime::now()));
    for _ in 0..10 {
        assert!(rig.after(1_000, true).is_none());
    }
    link(&rig, Link::Online(SystemTime::now()));
    assert!(rig.after(1, false).is_some(), "at once when it is back");
}

#[test]
fn a_motor_that_may_start_by_itself_gets_its_action() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    // A fault, or a status that never changes, with the run command left in the drive's word.
    rig.shows(ModelPoint::Run, Value::Bool(true));
    assert!(rig.after(4_900, false).is_none());
    rig.shows(ModelPoint::Run, Value::Bool(true));
    assert!(rig.after(100, false).is_some(), "it may start by it, or run");
    assert_eq!(rig.reported(), 1);
    // For a family that does not report its run command, the command that was written counts.
    let profiles = Profiles::built_in();
    for (word, acts) in [(Some(1), true), (Some(0), false), (None, false)] {
        let mut rig = SupervisedDrive::of(profiles.get("eaton-hvx").unwrap(), LeaseAction::Stop);
        let raw = rig.image();
        let raw = raw
            .spec
            .profile
            .model_point(ModelPoint::Run)
            .and_then(|point| point.raw())
            .unwrap();
        assert!(rig.image().spec.profile.model_point(ModelPoint::Run).is_some());
        rig.heartbeat();
        if let Some(word) = word {
            rig.drive.words.learn(raw.table, raw.address, word);
        }
        let acted = (0..100).any(|_| rig.after(100, false).is_some());
        assert_eq!(acted, acts, "{word:?}");
    }
    // The run command was taken away at the drive.
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    rig.shows(ModelPoint::Run, Value::Bool(true));
    assert!(rig.after(4_900, false).is_none());
    rig.shows(ModelPoint::Run, Value::Bool(false));
    assert!(rig.after(100, false).is_none());
    assert!(rig.after(10, true).is_none(), "started by someone else");
    assert_eq!(rig.reported(), 0);
}

#[test]
fn a_drive_that_runs_without_a_lease_is_told_once_and_adopted_where_that_is_wanted() {
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    assert!(rig.after(100, false).is_none());
    assert_eq!(rig.news, [], "it stands");
    for _ in 0..100 {
        assert!(rig.after(1_000, true).is_none(), "nobody commanded it");
    }
    assert_eq!(rig.news, [News::RunsUnsupervised(DriveIndex::new(0), Adopted::No)]);
    assert!(rig.image().is_unsupervised());
    rig.reload(rig.spec());
    assert!(rig.after(1_000, true).is_none());
    assert!(rig.image().is_unsupervised(), "after a reload too");
    assert_eq!(rig.news.len(), 1, "reported once");
    rig.heartbeat();
    assert!(rig.after(4_900, true).is_none());
    assert!(!rig.image().is_unsupervised());
    assert!(rig.after(100, true).is_some());

    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    let mut spec = rig.spec();
    spec.supervision.as_mut().unwrap().adopt = true;
    rig.reload(spec);
    assert!(rig.after(10_000, false).is_none());
    assert!(rig.after(100, true).is_none(), "the clock only");
    assert!(rig.after(4_900, true).is_none());
    assert_eq!(rig.news, [News::RunsUnsupervised(DriveIndex::new(0), Adopted::Yes)]);
    assert_eq!(rig.after(100, true).expect("the stop").urgency(), Urgency::Stop);
    // A client that commands the drive before it is seen running has a lease of its own.
    let mut rig = SupervisedDrive::new(LeaseAction::Stop);
    rig.heartbeat();
    assert!(rig.after(100, true).is_none());
    assert_eq!(rig.news, []);
}

/// The drive refuses to report whether it runs, and whether it took the run command is not known: what its command word was
/// before says nothing.
#[test]
fn a_run_command_in_doubt_counts_as_set_where_the_drive_does_not_show_its_motor() {
    for (known, acts) in [(None, true), (Some(0), false), (Some(1), true)] {
        let mut rig = SupervisedDrive::new(LeaseAction::Stop);
        let image = rig.image();
        let raw = |point| image.spec.profile.model_point(point).and_then(|point| point.raw());
        let (run, running) = (raw(ModelPoint::Run).unwrap(), raw(ModelPoint::Running).unwrap());
        image.update(|s| {
            s.link = Link::Online(SystemTime::now());
            s.refuse(running.table, running.address, 1, Exception::ADDRESS);
        });
        rig.shows(ModelPoint::Run, Value::Bool(false));
        rig.now += Duration::from_millis(100);
        rig.heartbeat();
        if let Some(word) = known {
            rig.drive.words.learn(run.table, run.address, word);
        }
        let acted = (0..80).any(|_| {
            rig.now += Duration::from_millis(100);
            rig.supervise();
            rig.take().is_some()
        });
        assert_eq!(acted, acts, "{known:?}");
    }
}
