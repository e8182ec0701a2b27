//! Each rule with a drive on which it alone refuses: which orders, and at which stages.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::*;
use crate::order::{
    Admitted, Arrival, Command, Commanded, Connection, Entry, Proof, Right, SourceKind, Ticket, Urgency, Window,
};
use crate::permit::{AwaitedFiles, DrillLock, KnownRun, Mode, Motor, OnRunning, Principal, Rules, Verb, Wants};
use crate::process_image::{DriveImage, RestoreLock};
use crate::stalls::Stall;
use crate::start_guard::{BusGuards, Guard, Guards, Interlock};
use crate::testkit::{bus_spec, controlled, image, nx, read};
use drivegate_model::drive::{ModelPoint, PointIndex, Value};
use drivegate_proto::RequestPdu;

const SECOND: Duration = Duration::from_secs(1);
const DRIVE: usize = 0;

/// Reason that keeps orders from the drive.
#[derive(Debug, Clone, Copy)]
enum Why {
    Nothing,
    RightLost,
    StoppedSince,
    Expired,
    Restoring,
    FileAwaited,
    Held,
    Protected,
    Drill,
    Interlock,
    Guard,
}

/// The orders that each case tries.
const ORDERS: [&str; 5] = ["start", "reference", "reset", "stop", "read"];

struct Rig {
    gate: Gate,
    image: Arc<DriveImage>,
    right: Arc<AtomicBool>,
    /// What the next word of an order would repeat.
    repeats: Option<Repeats>,
    /// When the orders arrive, and when they are judged.
    asked: Instant,
    now: Instant,
}

impl Facts for Rig {
    fn seen(&self, _: DriveIndex) -> Option<DriveFacts<'_>> {
        let reading = self.image.reading(self.now, 10 * SECOND);
        Some(DriveFacts {
            reading,
            written: None,
            run: None,
            repeats: self.repeats,
        })
    }
}

fn rules() -> Rules {
    let user = |name: &str, rank| Principal {
        http_user: Some(name.to_string()),
        ..Principal::new(name, rank)
    };
    Rules {
        mode: Mode::Exclusive,
        ranks: ["site", "operator"].map(Into::into).to_vec(),
        lease: 30 * SECOND,
        stop_at_local: true,
        principals: vec![user("alice", 1), user("bob", 1)],
    }
}

fn client(name: &str) -> Origin {
    Origin::new(SourceKind::Http, name).proven(Proof::User(name.into()))
}

impl Rig {
    fn new(why: Why) -> Rig {
        let (profile, bus, asked) = (nx(), bus_spec("b"), Instant::now() + 100 * SECOND);
        let mut spec = controlled("d1", "b", 1, &profile);
        let drive = DriveIndex::new(DRIVE);
        match why {
            Why::Guard => {
                spec.guard = Some(Guard {
                    starts_per_hour: Some(1),
                    ..Guard::default()
                });
            }
            Why::Interlock => {
                spec.interlocks = vec![Interlock {
                    drive: "d1".to_string(),
                    point: "ready".to_string(),
                    is: true,
                    trip: false,
                }];
            }
            _ => {}
        }
        let restore_lock = Arc::new(RestoreLock::default());
        let drive_image = image(spec);
        let drive_image = match why {
            Why::Restoring => {
                restore_lock.set(Some("it is being restored".to_string()));
                Arc::new(DriveImage::new(drive_image.spec.clone(), SECOND).with_restore_lock(restore_lock))
            }
            _ => drive_image,
        };
        let mut rig = Rig {
            gate: Gate::default(),
            image: drive_image,
            right: Arc::new(AtomicBool::new(true)),
            repeats: None,
            asked,
            now: asked + Duration::from_millis(10),
        };
        // The motor is at standstill, and the drive is not ready.
        read(&rig.image, 2100, &[0x40, 0, 0, 0], asked);
        let shared = Arc::new(Guards::default());
        if let Some(guards) = BusGuards::of(&shared, &bus, [&rig.image.spec]) {
            guards.begin();
            shared.watch([(bus.machine(&rig.image.spec), rig.image.clone())], 10 * SECOND, asked);
            guards.update(drive, &rig.image.reading(asked, 10 * SECOND));
            rig.gate.set_starts(Some(guards));
        }
        match why {
            Why::Nothing | Why::Expired | Why::Restoring | Why::Interlock => {}
            Why::RightLost => rig.right.store(false, Ordering::Release),
            Why::FileAwaited => {
                let files = AwaitedFiles::default();
                files.slots.begin("state/slots.json".into());
                rig.gate.set_awaited(Arc::new(files));
            }
            Why::StoppedSince => {
                let stop = rig.command("stop", "bob", asked + Duration::from_millis(5));
                rig.gate.accepted(&stop, asked + Duration::from_millis(5));
            }
            Why::Held => {
                rig.gate.set_rules(Some(Arc::new(rules())));
                rig.gate
                    .hold_act(drive, &client("bob"), Verb::Take, asked)
                    .unwrap()
                    .unwrap();
            }
            Why::Protected => {
                let origin = Origin::new(SourceKind::Bacnet, "fire");
                let entry = Entry::new(Value::Bool(false), origin, asked);
                rig.gate.priorities(drive).restore(Commanded::Run, 2, entry);
            }
            Why::Drill => {
                let drill = DrillLock {
                    who: "drill 1".to_string(),
                    quiet_until: None,
                };
                rig.gate.set_drill(drive, Some(drill));
            }
            Why::Guard => {
                // Uses up the one start allowed per hour.
                let first = rig.command("start", "bob", asked);
                let (mut gate, now) = (std::mem::take(&mut rig.gate), asked);
                assert_eq!(gate.judge(Stage::Turn, &first, &rig, now), Verdict::Go);
                let guards = gate.starts().unwrap().clone();
                guards.start_written(drive, first.intent.number, &Arc::from("bob"), now);
                read(&rig.image, 2100, &[0x03, 0, 0, 2500], now + Duration::from_millis(1));
                guards.update(drive, &rig.image.reading(now + Duration::from_millis(1), 10 * SECOND));
                read(&rig.image, 2100, &[0x41, 0, 0, 0], now + Duration::from_millis(2));
                guards.update(drive, &rig.image.reading(now + Duration::from_millis(2), 10 * SECOND));
                rig.gate = gate;
            }
        }
        if matches!(why, Why::Expired) {
            rig.now = asked + 3 * SECOND;
        }
        rig
    }

    fn command(&self, what: &str, who: &str, asked: Instant) -> Command {
        let profile = nx();
        let point = |point: ModelPoint| -> PointIndex { profile.model_index(point).unwrap() };
        let (order, urgency) = match what {
            "start" => (
                Order::Points(vec![(point(ModelPoint::Run), Value::Bool(true))]),
                Urgency::Command,
            ),
            "stop" => (
                Order::Points(vec![(point(ModelPoint::Run), Value::Bool(false))]),
                Urgency::Stop,
            ),
            "reset" => (
                Order::Points(vec![(point(ModelPoint::FaultReset), Value::Bool(true))]),
                Urgency::Command,
            ),
            "reference" => {
                let to = Value::Number(20.0);
                (
                    Order::Points(vec![(point(ModelPoint::SpeedReference), to)]),
                    Urgency::Command,
                )
            }
            _ => {
                let read = RequestPdu::Read {
                    table: drivegate_proto::Table::Holding,
                    start: 2100,
                    count: 1,
                };
                (Order::Read(read), Urgency::Read)
            }
        };
        let admitted = Admitted {
            order,
            urgency,
            reference_only: what == "reference",
            ranges: Vec::new(),
        };
        let window = Window {
            arrival: Arrival::over(Connection::opened(asked), asked),
            expires: asked + 2 * SECOND,
            waits: false,
        };
        let origin = client(who).with_right(Right::of(self.right.clone()));
        let (ticket, _) = Ticket::new(origin, "d1", String::new(), true, asked, Arc::default());
        Command::new(DriveIndex::new(DRIVE), admitted, &profile, window, ticket)
    }
}

/// The result of each order of Alice at each stage: the code if it is refused.
fn refused(why: Why) -> Vec<String> {
    let stages = [Stage::Accept, Stage::Turn, Stage::Write];
    let row = |what: &&str| {
        let told = stages.map(|stage| {
            // Each stage gets a new gate that has not judged anything yet.
            let mut rig = Rig::new(why);
            let command = rig.command(what, "alice", rig.asked);
            let (mut gate, now) = (std::mem::take(&mut rig.gate), rig.now);
            match gate.judge(stage, &command, &rig, now) {
                Verdict::Refuse(outcome) => outcome.code().to_string(),
                _ => "-".to_string(),
            }
        });
        format!("{what}: {}", told.join(" "))
    };
    ORDERS.iter().map(row).filter(|row| !row.ends_with(": - - -")).collect()
}

#[test]
fn each_rule_is_asked_at_its_moments_and_of_its_orders() {
    let table: [(Why, &[&str]); 11] = [
        (Why::Nothing, &[]),
        (
            Why::RightLost,
            &[
                "start: not_allowed not_allowed interrupted",
                "reference: not_allowed not_allowed interrupted",
                "reset: not_allowed not_allowed interrupted",
                "stop: not_allowed - -",
            ],
        ),
        (
            Why::StoppedSince,
            &[
                "start: purged purged purged",
                "reference: purged purged purged",
                "reset: purged purged purged",
            ],
        ),
        (
            Why::Expired,
            &[
                "start: expired expired -",
                "reference: expired expired -",
                "reset: expired expired -",
                "read: expired expired -",
            ],
        ),
        (
            Why::Restoring,
            &[
                "start: not_allowed not_allowed not_allowed",
                "reference: not_allowed not_allowed not_allowed",
                "reset: not_allowed not_allowed not_allowed",
            ],
        ),
        (
            Why::Held,
            &[
                "start: held_by_other held_by_other held_by_other",
                "reference: held_by_other held_by_other held_by_other",
                "reset: held_by_other held_by_other held_by_other",
            ],
        ),
        (Why::FileAwaited, &["start: held_by_other - held_by_other"]),
        (Why::Protected, &["start: held_by_other held_by_other held_by_other"]),
        (
            Why::Drill,
            &[
                "start: held_by_other held_by_other held_by_other",
                "reference: held_by_other held_by_other held_by_other",
                "reset: held_by_other held_by_other held_by_other",
            ],
        ),
        (Why::Interlock, &["start: interlocked interlocked interlocked"]),
        (Why::Guard, &["start: guarded guarded guarded"]),
    ];
    for (why, expected) in table {
        assert_eq!(refused(why), expected, "{why:?}");
    }
}

/// A word that would repeat a run command from memory, by what was read of the motor in the same command.
#[test]
fn a_word_from_memory_is_judged_by_the_motor_right_before_it_is_sent() {
    for (motor, expected) in [
        (None, "go go look"),
        (Some(Motor::Runs), "go go go"),
        (Some(Motor::Stands), "go go not_allowed"),
        (Some(Motor::NotShown), "go go not_allowed"),
    ] {
        for (what, expected) in [("reset", expected), ("stop", "go go go")] {
            let told = [Stage::Accept, Stage::Turn, Stage::Write].map(|stage| {
                let mut rig = Rig::new(Why::Nothing);
                rig.repeats = Some(Repeats {
                    wants: Wants::Others,
                    holds: KnownRun::Run,
                    told: false,
                    motor,
                    on_running: OnRunning::Harmless,
                });
                let command = rig.command(what, "alice", rig.asked);
                let (mut gate, now) = (std::mem::take(&mut rig.gate), rig.now);
                match gate.judge(stage, &command, &rig, now) {
                    Verdict::Go => "go",
                    Verdict::LookFirst => "look",
                    Verdict::Wait(_) => "wait",
                    Verdict::Refuse(outcome) => outcome.code(),
                }
            });
            assert_eq!(told.join(" "), expected, "{what} {motor:?}");
        }
    }
}

/// Orders over a connection from before a pause of the process, which start no motor.
#[test]
fn a_reference_that_turns_the_motor_is_a_start() {
    // The drive's control word, its output frequency in 0.01 Hz, and the results of a reference at each stage.
    for (run, hertz, expected) in [
        (0, 0, "go go go"),
        (1, 0, "expired expired expired"),
        (1, 49, "expired expired expired"),
        (1, 50, "go go go"),
        (0, 50, "go go go"),
    ] {
        let stages = [Stage::Accept, Stage::Turn, Stage::Write].map(|stage| {
            let mut rig = Rig::new(Why::Nothing);
            read(&rig.image, 2100, &[3, 0, 0, hertz], rig.asked);
            let word = |snapshot: &mut crate::process_image::Snapshot| {
                snapshot.store(drivegate_proto::Table::Holding, 2000, &[run, 0, 0], rig.asked);
            };
            rig.image.update(word);
            let mut command = rig.command("reference", "alice", rig.asked);
            command.intent.window.arrival = Arrival {
                pause: Some(Stall::new(rig.asked - 5 * SECOND, rig.asked)),
                ..Arrival::over(Connection::opened(rig.asked - 9 * SECOND), rig.asked)
            };
            let (mut gate, now) = (std::mem::take(&mut rig.gate), rig.now);
            match gate.judge(stage, &command, &rig, now) {
                Verdict::Refuse(outcome) => outcome.code(),
                _ => "go",
            }
        });
        assert_eq!(stages.join(" "), expected, "control word {run}, {hertz}");
    }
}

#[test]
fn a_reservation_that_is_not_read_yet_forbids_starts_where_drives_are_held() {
    for (has_authority, expected) in [(false, &[][..]), (true, &["start: held_by_other - held_by_other"][..])] {
        let row = |what: &&str| {
            let told = [Stage::Accept, Stage::Turn, Stage::Write].map(|stage| {
                let mut rig = Rig::new(Why::Nothing);
                let files = AwaitedFiles::default();
                files.reservations.begin("state/reservations.json".into());
                rig.gate.set_awaited(Arc::new(files));
                rig.gate.set_rules(has_authority.then(|| Arc::new(rules())));
                let command = rig.command(what, "alice", rig.asked);
                let (mut gate, now) = (std::mem::take(&mut rig.gate), rig.now);
                match gate.judge(stage, &command, &rig, now) {
                    Verdict::Refuse(outcome) => outcome.code().to_string(),
                    _ => "-".to_string(),
                }
            });
            format!("{what}: {}", told.join(" "))
        };
        let refused: Vec<String> = ORDERS.iter().map(row).filter(|row| !row.ends_with(": - - -")).collect();
        assert_eq!(refused, expected, "authority {has_authority}");
    }
}
