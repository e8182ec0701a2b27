//! Drills of simulated drives: a drive that stops correctly always passes, each fault is named, every drill ends
//! with a stop, and the other drives of the line are read normally.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::drill::{DrillOptions, DrillReport, DrillState, Drills, Kind, LOOK, SavedDrills};
use drivegate_core::files::State as _;
use drivegate_core::order::{Authority, Origin, Outcome, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_core::process_image::{LeaseAction, Supervision};
use drivegate_model::drive::ModelPoint;
use drivegate_proto::Protocol;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::nx::Command;

use super::bus::Parts;
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

const SECOND: Duration = Duration::from_secs(1);
const LIMIT: Duration = Duration::from_secs(25);
/// PDU address of the Vacon NX parameter for the reaction to a master that was silent for 20 s; 2 is a fault with
/// the stop function, 0 nothing.
const FIELDBUS_FAULT_RESPONSE: u16 = 732;
/// Register of the deceleration time, 0.1 s.
const DECELERATION: u16 = 103;
const OPTIONS: DrillOptions = DrillOptions {
    max_speed: 20.0,
    limit: LIMIT,
    every: Duration::from_secs(3600),
};

/// Families whose standstill can be read.
const FAMILIES: [(&str, Protocol); 8] = [
    ("vacon-nx", Protocol::ModbusRtu),
    ("eaton-svx", Protocol::ModbusRtu),
    ("eaton-hvx", Protocol::ModbusRtu),
    ("vacon-cx", Protocol::ModbusRtu),
    ("teco-7300pa", Protocol::ModbusAscii),
    ("schneider-altivar", Protocol::ModbusRtu),
    ("danfoss-fc", Protocol::ModbusRtu),
    // Only the actual speed shows the standstill of this family.
    ("siemens-g120", Protocol::ModbusRtu),
];

fn works(family: &'static str, protocol: Protocol) -> Line {
    Line {
        supervision: Some(Supervision {
            timeout: SECOND,
            action: LeaseAction::Stop,
            adopt: false,
        }),
        ..line(family, protocol, 19_200, 3)
    }
}

fn who() -> Origin {
    Origin::new(SourceKind::Http, "alice")
}

struct Play {
    rig: Rig,
    drills: Arc<Drills>,
    began: Instant,
}

impl Play {
    fn of(works: &Line, seed: u64) -> Play {
        let mut rig = Rig::new(works, Parts::of(0, works, seed));
        let drills = Arc::<Drills>::default();
        drills.set_options(Some(OPTIONS));
        rig.until("all are read", PATIENCE, Rig::is_whole);
        let began = rig.now;
        Play { rig, drills, began }
    }

    fn time(&self) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000) + (self.rig.now - self.began)
    }

    fn begin(&mut self, kinds: &[Kind], speed: f64) -> String {
        let drills = self.drills.clone();
        let drive = self.rig.drive(1);
        let armed = drills.arm(&drive, (kinds, Some(speed)), &who(), self.rig.now, self.time());
        let id = armed.unwrap().id;
        drills
            .start(&self.rig.plant, &id, &who(), self.rig.now, self.time())
            .unwrap();
        self.rig.bus.command_came(self.rig.now);
        id
    }

    /// Runs a drill to its end; `meanwhile` is called at each step with its report.
    fn drill(&mut self, kinds: &[Kind], mut meanwhile: impl FnMut(&mut Rig, &DrillReport)) -> DrillReport {
        let id = self.begin(kinds, 10.0);
        let drills = self.drills.clone();
        let until = self.rig.now + Duration::from_secs(300);
        loop {
            assert!(self.rig.now < until, "it does not end: {:?}", drills.report(&id));
            self.rig.run(LOOK);
            let report = drills.report(&id).unwrap();
            meanwhile(&mut self.rig, &report);
            let goes_on = drills.advance(&self.rig.plant, self.rig.now, self.time());
            self.rig.bus.command_came(self.rig.now);
            if !goes_on {
                return drills.report(&id).unwrap();
            }
        }
    }

    /// Checks that, however the drill ended, the drive is stopped and takes orders again.
    fn healed(&mut self) {
        self.rig.run(20 * SECOND);
        assert!(
            !self.rig.with_drive(1, |drive, _| drive.state().running),
            "it was left running"
        );
        assert_eq!(self.rig.drive(1).image.restore_lock.reason(), None);
        assert_eq!(self.rig.bus.handle.queue.quiet(self.rig.now), None);
    }
}

fn turns(rig: &mut Rig) -> bool {
    rig.with_drive(1, |drive, _| drive.state().running)
}

fn is_at(report: &DrillReport, text: &str) -> bool {
    report.text.contains(text)
}

#[test]
fn drives_that_stop_pass() {
    // An ACS580 reports "not running" as soon as it is stopped: only the actual speed shows when it stands.
    for (family, protocol) in FAMILIES.into_iter().chain([("abb-acs580", Protocol::ModbusRtu)]) {
        let mut play = Play::of(&works(family, protocol), 5);
        let report = play.drill(&[Kind::Order, Kind::Client], |_, _| {});
        assert_eq!(report.state, DrillState::Passed, "{family}: {report:#?}");
        let took: Vec<u64> = report.steps.iter().map(|step| step.took_ms.unwrap()).collect();
        assert!(
            took[1] >= 1_000,
            "{family}: a lease of a second stopped it after {took:?} ms"
        );
        assert_eq!(report.last_stop.as_deref(), Some("acknowledged"), "{family}");
        play.healed();
    }
}

#[test]
fn a_drive_that_stops_by_itself_when_its_gateway_is_silent_passes_and_the_others_are_read_as_ever() {
    let mut play = Play::of(&works("vacon-nx", Protocol::ModbusRtu), 7);
    play.rig.at_the_drive(1, FIELDBUS_FAULT_RESPONSE, 2);
    let cycle = |play: &Play| play.rig.bus.handle.image.health().fast.last.unwrap();
    play.rig.run(10 * SECOND);
    let before = cycle(&play);
    let mut silent = Vec::new();
    let mut frames = 0;
    let report = play.drill(&[Kind::Gateway], |rig, report| {
        if is_at(report, "nothing is sent") {
            silent.push(rig.bus.handle.image.health().fast.last.unwrap());
            let asked = rig.requests();
            frames = asked.iter().filter(|frame| frame.bytes.first() == Some(&1)).count();
            rig.bus.wire.record(10_000);
        } else {
            rig.bus.wire.record(10_000);
        }
    });
    assert_eq!(report.state, DrillState::Passed, "{report:#?}");
    assert!(report.steps[0].upper_bound);
    // The time is that of the first reading after the silence.
    let took = report.steps[0].took_ms.unwrap();
    assert!((25_000..25_300).contains(&took), "{took} ms");
    // One frame is allowed: that of the transaction on the line when the silence began.
    assert!(frames <= 1, "{frames} frames to a drive that is sent nothing");
    let longest = silent[5..].iter().max().unwrap();
    assert!(
        longest.as_secs_f64() <= 1.02 * before.as_secs_f64(),
        "{longest:?}, before {before:?}"
    );
}

/// The drive stops by itself later than it should; the readings that would show it turning are lost.
#[test]
fn a_standstill_that_was_not_read_in_time_is_not_proven() {
    let mut play = Play::of(&works("vacon-nx", Protocol::ModbusRtu), 19);
    play.rig.at_the_drive(1, FIELDBUS_FAULT_RESPONSE, 0);
    let mut silent: Option<Instant> = None;
    let report = play.drill(&[Kind::Gateway], |rig, report| {
        if !is_at(report, "nothing is sent") {
            return;
        }
        let since = *silent.get_or_insert(rig.now);
        let lost = rig.now < since + LIMIT + 3 * SECOND;
        rig.set_faults(if lost {
            FaultPlan::new("drop=1.0".parse().unwrap(), 1)
        } else {
            FaultPlan::default()
        });
        if !lost && turns(rig) {
            rig.with_drive(1, |drive, _| drive.trip(9));
        }
    });
    assert!(silent.is_some());
    assert_eq!(report.state, DrillState::NotProven, "{report:#?}");
    assert!(report.text.contains("after the silence of 25 s"), "{report:#?}");
    play.healed();
}

#[test]
fn what_does_not_stop_is_named() {
    let of = || Play::of(&works("vacon-nx", Protocol::ModbusRtu), 11);
    let ends = |play: &mut Play, report: &DrillReport, state: DrillState, text: &str| {
        assert_eq!(report.state, state, "{report:#?}");
        assert!(report.text.contains(text), "{text}: {report:#?}");
        play.healed();
    };
    // The drive's own response to a silent master is off.
    let mut play = of();
    play.rig.at_the_drive(1, FIELDBUS_FAULT_RESPONSE, 0);
    let report = play.drill(&[Kind::Gateway], |_, _| {});
    ends(
        &mut play,
        &report,
        DrillState::Failed,
        "after a silence of 25 s the motor still turns",
    );
    // The drive ignores stops: another master keeps it running.
    let mut play = of();
    let report = play.drill(&[Kind::Order], |rig, report| {
        if is_at(report, "a stop command was sent") && !turns(rig) {
            rig.with_drive(1, |drive, _| {
                drive.command(Command {
                    run: true,
                    reverse: false,
                    reference: 1000,
                });
            });
        }
    });
    ends(&mut play, &report, DrillState::Failed, "the motor still turns");
    // The drive takes too long to reach standstill.
    let mut play = of();
    play.rig.at_the_drive(1, DECELERATION, 6000);
    let report = play.drill(&[Kind::Order], |_, _| {});
    play.rig.at_the_drive(1, DECELERATION, 30);
    ends(&mut play, &report, DrillState::Failed, "the motor still turns");
    // The drive is switched to local, gets a fault, is stopped, or gets an order of another client.
    let mut play = of();
    let report = play.drill(&[Kind::Client], |rig, report| {
        if is_at(report, "the client is silent") {
            rig.with_drive(1, |drive, _| drive.set_remote(false));
        }
    });
    ends(&mut play, &report, DrillState::Aborted, "local control");
    let mut play = of();
    let report = play.drill(&[Kind::Order], |rig, report| {
        if is_at(report, "the motor turns at") {
            rig.with_drive(1, |drive, _| drive.trip(9));
        }
    });
    ends(&mut play, &report, DrillState::Aborted, "the drive has a fault");
    for (points, text) in [
        (&[("run", 0.0)][..], "mqtt bob stopped the drive"),
        (&[("speed_reference", 15.0)][..], "mqtt bob sent a command"),
    ] {
        let mut play = of();
        let mut given = false;
        let report = play.drill(&[Kind::Gateway], |rig, report| {
            if is_at(report, "nothing is sent") && !std::mem::replace(&mut given, true) {
                let order = rig.points(1, points);
                let bob = Origin::new(SourceKind::Mqtt, "bob");
                let mut placed = rig
                    .drive(1)
                    .place(OrderRequest::new(order, bob, Authority::Write), rig.now);
                rig.bus.command_came(rig.now);
                let refused = matches!(placed.answer().map(|answer| answer.outcome), Some(Outcome::Refused(_)));
                assert_eq!(refused, points[0].0 != "run", "only stops pass");
            }
        });
        ends(&mut play, &report, DrillState::Aborted, text);
    }
    // The motor never begins to turn.
    let mut play = of();
    let report = play.drill(&[Kind::Order], |rig, _| {
        rig.with_drive(1, |drive, _| drive.set_alive(false))
    });
    assert!(
        matches!(report.state, DrillState::Aborted | DrillState::NotProven),
        "{report:#?}"
    );
    play.rig.set_alive(1, true);
    play.healed();
}

/// The trouble during a drill.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Trouble {
    /// Another master keeps the drive running.
    IgnoresStops,
    /// Another master keeps the drive running for three seconds, which is still in time.
    StopsLate,
    Local,
    Fault,
    PowerLoss,
    StopOfAnother,
    CommandOfAnother,
    /// The commands reach the motor of another drive.
    WrongMotor,
    /// The gateway goes silent, and the drive reacts as it does without its master.
    SilentGateway,
}

impl Trouble {
    const ALL: [Trouble; 9] = [
        Trouble::IgnoresStops,
        Trouble::StopsLate,
        Trouble::Local,
        Trouble::Fault,
        Trouble::PowerLoss,
        Trouble::StopOfAnother,
        Trouble::CommandOfAnother,
        Trouble::WrongMotor,
        Trouble::SilentGateway,
    ];

    fn kind(self) -> Kind {
        match self {
            Trouble::SilentGateway => Kind::Gateway,
            _ => Kind::Order,
        }
    }

    /// Causes the trouble at the step in which `report` calls for it.
    fn look(self, rig: &mut Rig, report: &DrillReport, happened: &mut Option<Instant>) {
        let steady = is_at(report, "the motor turns at");
        let stopping = is_at(report, "a stop command was sent");
        let runs = |rig: &mut Rig, address: u8, run: bool| {
            let command = Command {
                run,
                reverse: false,
                reference: 1000,
            };
            rig.with_drive(address, |drive, _| drive.command(command));
        };
        let began = match self {
            Trouble::IgnoresStops | Trouble::StopsLate => stopping,
            Trouble::WrongMotor => is_at(report, "waiting until the motor turns"),
            Trouble::SilentGateway => is_at(report, "nothing is sent"),
            _ => steady,
        };
        if !began {
            return;
        }
        let first = happened.is_none();
        let since = *happened.get_or_insert(rig.now);
        match self {
            Trouble::IgnoresStops if !turns(rig) => runs(rig, 1, true),
            Trouble::StopsLate if rig.now < since + 3 * SECOND && !turns(rig) => runs(rig, 1, true),
            Trouble::StopsLate if rig.now >= since + 3 * SECOND && turns(rig) => runs(rig, 1, false),
            Trouble::WrongMotor if turns(rig) => {
                runs(rig, 1, false);
                runs(rig, 2, true);
            }
            Trouble::Local if first => rig.with_drive(1, |drive, _| drive.set_remote(false)),
            Trouble::Fault if first => rig.with_drive(1, |drive, _| drive.trip(9)),
            Trouble::PowerLoss if first => rig.with_drive(1, |drive, _| drive.power_off()),
            Trouble::StopOfAnother | Trouble::CommandOfAnother if first => {
                let points: &[(&str, f64)] = match self {
                    Trouble::StopOfAnother => &[("run", 0.0)],
                    _ => &[("speed_reference", 15.0)],
                };
                let order = rig.points(1, points);
                let bob = Origin::new(SourceKind::Mqtt, "bob");
                drop(
                    rig.drive(1)
                        .place(OrderRequest::new(order, bob, Authority::Write), rig.now),
                );
                rig.bus.command_came(rig.now);
            }
            _ => {}
        }
    }

    /// The result that the drill must have.
    fn expected(self) -> (DrillState, &'static str) {
        match self {
            Trouble::IgnoresStops => (DrillState::Failed, "the motor still turns"),
            Trouble::StopsLate => (DrillState::Passed, "in time"),
            Trouble::Local => (DrillState::Aborted, "local control"),
            Trouble::Fault => (DrillState::Aborted, "the drive has a fault"),
            Trouble::PowerLoss => (DrillState::Aborted, "the drive went offline"),
            Trouble::StopOfAnother => (DrillState::Aborted, "mqtt bob stopped the drive"),
            Trouble::CommandOfAnother => (DrillState::Aborted, "mqtt bob sent a command"),
            Trouble::WrongMotor => (DrillState::NotProven, "the motor"),
            Trouble::SilentGateway => (DrillState::Failed, "after a silence of 25 s the motor still turns"),
        }
    }
}

#[test]
fn whatever_goes_wrong_is_named_with_every_family() {
    for (number, (family, protocol)) in FAMILIES.into_iter().enumerate() {
        for trouble in Trouble::ALL {
            // Without supervision, so that only the drill stops the drive.
            let works = Line {
                supervision: None,
                ..works(family, protocol)
            };
            let mut play = Play::of(&works, number as u64);
            let has_remote = play.rig.good(1, ModelPoint::Remote).is_some();
            if trouble == Trouble::Local && !has_remote {
                // The drive does not report its control place, so this trouble cannot be detected.
                continue;
            }
            let (mut happened, mut turned) = (None, false);
            let report = play.drill(&[trouble.kind()], |rig, report| {
                trouble.look(rig, report, &mut happened);
                if is_at(report, "nothing is sent") {
                    turned = turns(rig);
                }
            });
            let about = format!("{family}, {trouble:?}: {report:#?}");
            assert!(happened.is_some(), "it did not happen: {about}");
            if trouble == Trouble::SilentGateway && !turned {
                assert_eq!(report.state, DrillState::Passed, "it stood: {about}");
            } else {
                let (state, text) = trouble.expected();
                assert_eq!(report.state, state, "{about}");
                assert!(report.text.contains(text), "{text}: {about}");
            }
            if trouble == Trouble::StopsLate {
                assert!(report.steps[0].took_ms.is_some_and(|took| took >= 3_000), "{about}");
            }
            play.rig.with_drive(1, |drive, at| {
                drive.set_remote(true);
                if trouble == Trouble::PowerLoss {
                    drive.power_on(at);
                }
            });
            play.healed();
        }
    }
}

/// On a line that loses and damages frames a drill may end with any result except a wrong one: a drill that passed
/// was seen to stop the motor, and all end with a stop.
#[test]
fn a_thousand_drills_and_a_noisy_line() {
    let mut play = Play::of(&works("vacon-nx", Protocol::ModbusRtu), 13);
    for round in 0..1000 {
        let report = play.drill(&[Kind::Order], |_, _| {});
        assert_eq!(report.state, DrillState::Passed, "round {round}: {report:#?}");
    }
    let mut passed = 0;
    for seed in 0..20 {
        let mut play = Play::of(&works("vacon-nx", Protocol::ModbusRtu), seed);
        let noise = "drop=0.03,corrupt=0.02,late:60ms=0.02".parse().unwrap();
        play.rig.set_faults(FaultPlan::new(noise, seed));
        let mut stood = true;
        let report = play.drill(&[Kind::Order, Kind::Client], |rig, report| {
            if report.steps.iter().any(|step| step.state == DrillState::Passed) && is_at(report, "standstill after") {
                stood &= !turns(rig);
            }
        });
        passed += u32::from(report.state == DrillState::Passed);
        assert!(stood, "{report:#?}");
        play.rig.set_faults(FaultPlan::default());
        play.healed();
    }
    assert!(passed >= 10, "{passed} of 20");
}

#[test]
fn one_at_a_time_by_who_armed_it_and_within_a_minute() {
    let mut play = Play::of(&works("vacon-nx", Protocol::ModbusRtu), 17);
    let drills = play.drills.clone();
    let (now, time) = (play.rig.now, play.time());
    let drive = play.rig.drive(1);
    let arm = |kinds: &[Kind], speed| drills.arm(&drive, (kinds, speed), &who(), now, time);
    for (kinds, speed, why) in [
        (&Kind::ALL[..], Some(20.5), "allowed are more than 0 to 20 %"),
        (&Kind::ALL[..], Some(f64::NAN), "allowed are"),
        (&[][..], None, "name at least one"),
    ] {
        let refused = arm(kinds, speed).unwrap_err().to_string();
        assert!(refused.contains(why), "{refused}");
    }
    let id = arm(&Kind::ALL, None).unwrap().id;
    assert!(
        arm(&Kind::ALL, None)
            .unwrap_err()
            .to_string()
            .contains("one drill at a time")
    );
    let bob = Origin::new(SourceKind::Http, "bob");
    let by_another = drills.start(&play.rig.plant, &id, &bob, now, time).unwrap_err();
    assert!(
        by_another.to_string().contains("was armed by http alice"),
        "{by_another}"
    );
    play.rig.run(61 * SECOND);
    let late = drills.start(&play.rig.plant, &id, &who(), play.rig.now, play.time());
    assert!(late.unwrap_err().to_string().contains("is aborted"));
    assert_eq!(
        play.rig.good(1, ModelPoint::Running).map(|value| value.as_bool()),
        Some(false)
    );
}

/// The file of drills on a slow disk, written `looks` steps after it was due.
struct Disk {
    on_disk: Option<SavedDrills>,
    writing: Option<(u32, u64, SavedDrills)>,
    looks: u32,
}

impl Disk {
    fn look(&mut self, drills: &Drills, now: Instant) {
        match self.writing.take() {
            Some((0, generation, saved)) => {
                // The drills as the next process reads them.
                let bytes = saved.to_json().unwrap();
                self.on_disk = Some(SavedDrills::from_json(&bytes).unwrap());
                drills.kept(generation, now);
            }
            Some((left, generation, saved)) => self.writing = Some((left - 1, generation, saved)),
            None => {
                let due = drills.to_keep();
                self.writing = due.map(|(generation, saved)| (self.looks, generation, saved));
            }
        }
    }

    fn knows(&self, id: &str) -> bool {
        let saved = self.on_disk.as_ref();
        saved.is_some_and(|saved| saved.reports.iter().any(|report| report.id == id))
    }
}

/// The gateway is killed at any moment of a drill and returns: the motor then stands. The motor never turned before
/// the drill was on disk.
#[test]
fn a_kill_at_any_moment_leaves_no_motor_running() {
    let mut stopped = 0;
    for kill in 0..60_u32 {
        // Without supervision, so that only the drill stops the drive.
        let works = Line {
            supervision: None,
            ..works("vacon-nx", Protocol::ModbusRtu)
        };
        let mut play = Play::of(&works, u64::from(kill));
        play.drills.keep(true);
        let mut disk = Disk {
            on_disk: None,
            writing: None,
            looks: kill % 7,
        };
        let id = play.begin(&[Kind::Order, Kind::Gateway], 10.0);
        for look in 0..=kill * 10 {
            play.rig.run(LOOK);
            disk.look(&play.drills, play.rig.now);
            play.drills.advance(&play.rig.plant, play.rig.now, play.time());
            play.rig.bus.command_came(play.rig.now);
            assert!(
                !turns(&mut play.rig) || disk.knows(&id),
                "the motor turns at look {look} and nothing of its drill is on disk"
            );
        }
        let turned = turns(&mut play.rig);
        // The killed process leaves only its file.
        play.rig.killed();
        play.drills = Arc::default();
        play.drills.set_options(Some(OPTIONS));
        if let Some(saved) = disk.on_disk {
            play.drills.restore(saved);
        }
        for _ in 0..500 {
            play.rig.run(LOOK);
            play.drills.advance(&play.rig.plant, play.rig.now, play.time());
            play.rig.bus.command_came(play.rig.now);
        }
        play.healed();
        let report = play.drills.report(&id);
        assert!(
            report.as_ref().is_none_or(|report| report.state.is_over()),
            "{report:#?}"
        );
        if turned {
            stopped += 1;
            let report = report.unwrap();
            assert_eq!(report.last_stop.as_deref(), Some("acknowledged"), "{report:#?}");
        }
    }
    assert!(stopped >= 20, "{stopped} motors turned at the kill");
}

/// The disk returns the file of a drill that was cut off only after a client has started the motor: it runs on.
#[test]
fn a_drill_that_is_read_late_stops_no_motor_that_a_client_has_started_since() {
    for starts in [false, true] {
        // Without supervision, so that only the drill stops the drive.
        let works = Line {
            supervision: None,
            ..works("vacon-nx", Protocol::ModbusRtu)
        };
        let mut play = Play::of(&works, 3);
        let id = play.begin(&[Kind::Order], 10.0);
        while !turns(&mut play.rig) {
            play.rig.run(LOOK);
            play.drills.advance(&play.rig.plant, play.rig.now, play.time());
            play.rig.bus.command_came(play.rig.now);
        }
        let (_, saved) = play.drills.to_keep().unwrap();
        play.rig.killed();
        play.drills = Arc::default();
        play.rig.until("it is read", PATIENCE, Rig::is_whole);
        if starts {
            let started = play.rig.set(1, &[("run", 1.0), ("speed_reference", 30.0)]);
            assert!(started.is_ok(), "{started:?}");
        }
        play.drills.restore(saved);
        for _ in 0..200 {
            play.rig.run(LOOK);
            play.drills.advance(&play.rig.plant, play.rig.now, play.time());
            play.rig.bus.command_came(play.rig.now);
        }
        assert_eq!(turns(&mut play.rig), starts);
        let report = play.drills.report(&id).unwrap();
        assert!(report.state.is_over(), "{report:#?}");
        assert_eq!(
            report.text.contains("a client has started the motor since"),
            starts,
            "{report:#?}"
        );
    }
}
