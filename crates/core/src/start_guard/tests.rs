use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use super::*;
use crate::files::State as _;
use crate::order::{
    Arrival, Command, Effect, Effects, Intent, Order, Origin, Outcome, PassedOn, Refusal, SourceKind, Target, Ticket,
    Touched, Window,
};
use crate::permit::{Gate, Stage, Verdict};
use crate::process_image::{BusSpec, DriveImage, DriveSpec, Link};
use crate::testkit::{bus_spec, controlled, image, nx, profile, read};
use drivegate_model::drive::DriveIndex;
use drivegate_proto::{RequestPdu, Table};

mod on_disk;
mod reload;

const SECOND: Duration = Duration::from_secs(1);
const RUN: Effect = Effect {
    stops: false,
    run: Some(true),
    reverse: None,
    reference: false,
    word: false,
};

/// Drives `d1` to `d3` of a family on one bus; `d1` and `d2` have the guard.
struct GuardedDrives {
    shared: Arc<Guards>,
    bus: BusSpec,
    images: Vec<Arc<DriveImage>>,
    guards: Arc<BusGuards>,
    start: Instant,
}

impl GuardedDrives {
    fn of(guard: Guard, interlocks: Vec<Interlock>) -> GuardedDrives {
        let (profile, bus) = (nx(), bus_spec("b"));
        let drive = |address: u8| {
            image(DriveSpec {
                guard: (address < 3).then_some(guard),
                interlocks: if address == 1 { interlocks.clone() } else { Vec::new() },
                staggers: !guard.stagger.is_zero(),
                ..controlled(&format!("d{address}"), "b", address, &profile)
            })
        };
        let images: Vec<Arc<DriveImage>> = (1..=3).map(drive).collect();
        let shared = Arc::new(Guards::default());
        let guards = BusGuards::of(&shared, &bus, images.iter().map(|image| &image.spec)).unwrap();
        guards.begin();
        let rig = GuardedDrives {
            shared,
            bus,
            images,
            guards,
            start: Instant::now(),
        };
        rig.watch(rig.start);
        rig
    }

    fn watch(&self, now: Instant) {
        let drives = self.images.iter();
        let drives = drives.map(|image| (self.bus.machine(&image.spec), image.clone()));
        self.shared.watch(drives, SECOND, now);
    }

    fn at(&self, seconds: f64) -> Instant {
        self.start + Duration::from_secs_f64(seconds)
    }

    /// Reads the drive: the motor runs, or is at standstill.
    fn read(&self, drive: usize, running: bool, seconds: f64) {
        let (image, at) = (&self.images[drive], self.at(seconds));
        // Words of the image: the status word (running, or at zero speed) and the output frequency.
        let words = if running { [0x03, 0, 0, 2500] } else { [0x41, 0, 0, 0] };
        read(image, 2100, &words, at);
        self.guards.update(DriveIndex::new(drive), &image.reading(at, SECOND));
    }

    fn refused(&self, drive: usize, seconds: f64) -> Option<&'static str> {
        match reason(self.asked(Stage::Accept, &[drive], (0, None), seconds)) {
            "go" | "wait" => None,
            reason => Some(reason),
        }
    }

    fn refusal(&self, drive: usize, seconds: f64) -> Option<Refusal> {
        match self.asked(Stage::Accept, &[drive], (0, None), seconds) {
            Verdict::Refuse(Outcome::Refused(refusal)) => Some(refusal),
            _ => None,
        }
    }

    /// A started command that starts the drive writes.
    fn may_write(&self, drive: usize, number: u64, seconds: f64) -> bool {
        self.asked(Stage::Write, &[drive], (number, None), seconds) == Verdict::Go
    }

    /// The verdict on a command that starts these drives, when the command is about to be sent.
    fn clear(&self, drives: &[usize], number: u64, seconds: f64) -> Verdict {
        self.asked(Stage::Turn, drives, (number, None), seconds)
    }

    /// The verdict on a command that may wait for its start until `until`.
    fn clear_waiting(&self, drives: &[usize], number: u64, until: f64, seconds: f64) -> Verdict {
        self.asked(Stage::Turn, drives, (number, Some(until)), seconds)
    }

    fn asked(&self, stage: Stage, drives: &[usize], (number, waits): (u64, Option<f64>), seconds: f64) -> Verdict {
        judged(
            &self.guards,
            stage,
            drives,
            (number, waits.map(|until| self.at(until))),
            self.at(seconds),
        )
    }

    /// Starts a drive and reads that it runs, then stops it and reads its standstill a second later.
    fn start_and_stop(&self, drive: usize, number: u64, seconds: f64) {
        assert_eq!(self.clear(&[drive], number, seconds), Verdict::Go, "at {seconds} s");
        self.guards
            .start_written(DriveIndex::new(drive), number, &Arc::from("c"), self.at(seconds));
        self.read(drive, true, seconds + 0.1);
        self.guards.stop_written(DriveIndex::new(drive), self.at(seconds + 0.5));
        self.read(drive, false, seconds + 1.0);
    }
}

/// Judges a command that starts these drives.
fn judged(
    guards: &Arc<BusGuards>,
    stage: Stage,
    drives: &[usize],
    (number, waits): (u64, Option<Instant>),
    now: Instant,
) -> Verdict {
    let mut gate = Gate::default();
    gate.set_starts(Some(guards.clone()));
    let origin = Origin::new(SourceKind::Mqtt, "c");
    let (ticket, _) = Ticket::new(origin, "d", String::new(), true, now, Arc::default());
    let window = Window {
        arrival: Arrival::now(now),
        expires: waits.unwrap_or(now + 2 * SECOND),
        waits: waits.is_some(),
    };
    let effects = drives.iter().map(|drive| (DriveIndex::new(*drive), RUN)).collect();
    let order = Order::Write(RequestPdu::write_register(2000, 1));
    let intent = Intent::new(
        Target::Address(0),
        order,
        Effects::on_all(effects, Touched::Anything),
        window,
    );
    let passed_on = PassedOn {
        may_write: true,
        first: false,
        frame: tokio::sync::oneshot::channel().0,
    };
    let mut command = Command::passed_on(intent, passed_on, ticket);
    command.intent.number = number;
    gate.judge(stage, &command, &(), now)
}

fn reason(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Refuse(Outcome::Refused(Refusal::Guarded(guarded))) => guarded.reason.name(),
        Verdict::Refuse(Outcome::Refused(Refusal::Interlocked(_))) => "interlock",
        Verdict::Refuse(other) => unreachable!("{other}"),
        Verdict::Go | Verdict::LookFirst => "go",
        Verdict::Wait(_) => "wait",
    }
}

fn per_hour(most: u32) -> Guard {
    Guard {
        starts_per_hour: Some(most),
        ..Guard::default()
    }
}

#[test]
fn the_window_of_an_hour_slides() {
    let rig = GuardedDrives::of(per_hour(3), Vec::new());
    rig.read(0, false, 0.0);
    for (number, seconds) in [(1, 10.0), (2, 600.0), (3, 1200.0)] {
        rig.start_and_stop(0, number, seconds);
    }
    assert_eq!(rig.refused(0, 1300.0), Some("starts_per_hour"));
    assert_eq!(rig.refused(1, 1300.0), None, "each drive for itself");
    let Some(Refusal::Guarded(wait)) = rig.refusal(0, 1300.0) else {
        unreachable!()
    };
    assert_eq!(
        wait.retry_after,
        Duration::from_secs(2310),
        "when the first one is an hour old"
    );
    assert_eq!(wait.retry_after_ms(), 2_310_000);
    assert!(
        wait.why.contains("3 starts within the last hour") && wait.why.contains("39 min"),
        "{wait}"
    );
    assert_eq!(rig.refused(0, 3609.9), Some("starts_per_hour"));
    assert_eq!(rig.refused(0, 3610.0), None);
    rig.start_and_stop(0, 4, 3610.0);
    assert_eq!(
        rig.refused(0, 4199.0),
        Some("starts_per_hour"),
        "the second one counts until 4200 s"
    );
    assert_eq!(rig.refused(0, 4200.0), None);
    let counted = rig.guards.refused(DriveIndex::new(0));
    assert_eq!(counted.get(&Reason::StartsPerHour), Some(&4), "{counted:?}");
}

#[test]
fn a_run_to_a_running_motor_is_no_start_and_one_behind_a_stop_is() {
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    rig.read(0, false, 0.0);
    assert_eq!(rig.clear(&[0], 1, 1.0), Verdict::Go);
    rig.guards
        .start_written(DriveIndex::new(0), 1, &Arc::from("c"), rig.at(1.0));
    assert_eq!(rig.refused(0, 1.05), None, "not seen to run yet: it is the same start");
    rig.read(0, true, 1.1);
    assert_eq!(rig.refused(0, 1.2), None, "it runs");
    assert_eq!(rig.clear(&[0], 2, 1.2), Verdict::Go);
    rig.guards
        .start_written(DriveIndex::new(0), 2, &Arc::from("c"), rig.at(1.2));
    rig.guards.stop_written(DriveIndex::new(0), rig.at(2.0));
    assert_eq!(
        rig.refused(0, 2.01),
        Some("starts_per_hour"),
        "what was read before the stop says nothing"
    );
    // The motor coasts to a stop: it may stand by the time the order reaches it.
    rig.read(0, true, 2.1);
    assert_eq!(rig.refused(0, 2.2), Some("starts_per_hour"));
    // The drive did not take the stop, or was started again from elsewhere.
    rig.images[0].update(|snapshot| snapshot.store(Table::Holding, 2000, &[1, 0, 0], rig.at(2.3)));
    rig.read(0, true, 2.4);
    assert_eq!(rig.refused(0, 2.5), None);
    rig.read(0, false, 3.0);
    assert_eq!(rig.refused(0, 3.1), Some("starts_per_hour"));
    // A run command that was cleared while the motor ran must not start the motor if it has stopped since.
    assert!(!rig.may_write(0, 2, 3.1));
    assert!(rig.may_write(0, 1, 3.1));
}

#[test]
fn starts_at_the_panel_count_and_those_of_orders_count_once() {
    let rig = GuardedDrives::of(per_hour(2), Vec::new());
    rig.read(0, false, 0.0);
    rig.start_and_stop(0, 1, 1.0);
    assert_eq!(rig.refused(0, 5.0), None, "one of two");
    rig.read(0, true, 6.0);
    rig.read(0, false, 7.0);
    assert_eq!(rig.refused(0, 8.0), Some("starts_per_hour"), "the panel started it");
    // A motor that already runs at its first reading was not seen to start.
    rig.read(1, true, 0.0);
    rig.read(1, false, 1.0);
    rig.start_and_stop(1, 2, 2.0);
    assert_eq!(rig.refused(1, 5.0), None);
}

#[test]
fn min_off_counts_from_the_first_reading_that_shows_the_motor_standing() {
    let guard = Guard {
        min_off: 30 * SECOND,
        ..Guard::default()
    };
    let rig = GuardedDrives::of(guard, Vec::new());
    assert_eq!(rig.refused(0, 0.0), Some("min_off"), "never read");
    rig.read(0, false, 1.0);
    rig.read(0, false, 20.0);
    assert_eq!((rig.refused(0, 30.9), rig.refused(0, 31.0)), (Some("min_off"), None));
    rig.start_and_stop(0, 1, 40.0);
    assert_eq!((rig.refused(0, 70.9), rig.refused(0, 71.0)), (Some("min_off"), None));
    // Start and stop happened between two reads, so the motor must be seen standing again.
    assert_eq!(rig.clear(&[0], 2, 71.0), Verdict::Go);
    rig.guards
        .start_written(DriveIndex::new(0), 2, &Arc::from("c"), rig.at(71.0));
    rig.read(0, false, 71.0);
    rig.guards.stop_written(DriveIndex::new(0), rig.at(71.1));
    rig.read(0, false, 71.2);
    rig.read(0, false, 72.5);
    assert_eq!((rig.refused(0, 102.4), rig.refused(0, 102.5)), (Some("min_off"), None));
    // Stops to a motor at standstill change nothing.
    rig.guards.stop_written(DriveIndex::new(0), rig.at(102.6));
    rig.read(0, false, 102.7);
    assert_eq!(rig.refused(0, 102.8), None);
    // While the drive was offline, its motor may have run.
    rig.images[0].update(|snapshot| snapshot.link = Link::Offline(SystemTime::now()));
    rig.guards
        .update(DriveIndex::new(0), &rig.images[0].reading(rig.at(180.0), SECOND));
    assert_eq!(rig.refused(0, 180.0), Some("min_off"));
    rig.read(0, false, 190.0);
    assert_eq!((rig.refused(0, 219.0), rig.refused(0, 220.0)), (Some("min_off"), None));
    // A start that may wait is accepted if its time comes before it expires.
    rig.read(1, false, 200.0);
    let accepted = |until: f64| reason(rig.asked(Stage::Accept, &[1], (0, Some(until)), 220.0));
    assert_eq!((accepted(229.0), accepted(231.0)), ("min_off", "wait"));
    let waits = rig.clear_waiting(&[1], 9, 231.0, 229.0);
    assert_eq!(waits, Verdict::Wait(rig.at(230.0)), "it goes at its time");
    assert_eq!(rig.clear_waiting(&[1], 9, 231.0, 230.0), Verdict::Go);
}

#[test]
fn drives_of_a_group_start_one_after_the_other() {
    let guard = Guard {
        stagger: 5 * SECOND,
        ..Guard::default()
    };
    let rig = GuardedDrives::of(guard, Vec::new());
    (0..3).for_each(|drive| rig.read(drive, false, 0.0));
    assert_eq!(reason(rig.clear(&[0, 1], 1, 1.0)), "stagger", "never two by one order");
    assert_eq!(rig.clear(&[0], 2, 2.0), Verdict::Go);
    // A start that was cleared but not written may be written at any time.
    assert_eq!(reason(rig.clear(&[1], 3, 7.5)), "stagger");
    rig.guards
        .start_written(DriveIndex::new(0), 2, &Arc::from("c"), rig.at(8.0));
    assert_eq!(
        (reason(rig.clear(&[1], 3, 12.9)), rig.clear(&[1], 3, 13.0)),
        ("stagger", Verdict::Go)
    );
    rig.read(0, true, 8.1);
    rig.read(0, false, 9.2);
    // A start that was cleared but not written counts from its clearance.
    rig.guards.settle(DriveIndex::new(1), 3);
    assert_eq!((rig.refused(0, 17.9), rig.refused(0, 18.0)), (Some("stagger"), None));
    // A drive without a guard is not delayed, but its starts count for the others.
    assert_eq!(rig.clear(&[2], 4, 18.0), Verdict::Go);
    rig.guards
        .start_written(DriveIndex::new(2), 4, &Arc::from("c"), rig.at(18.0));
    assert_eq!((rig.refused(0, 22.9), rig.refused(0, 23.0)), (Some("stagger"), None));
}

#[test]
fn only_a_good_point_holds_an_interlock() {
    let interlock = |drive: &str, is| Interlock {
        drive: drive.to_string(),
        point: "running".to_string(),
        is,
        trip: false,
    };
    let rig = GuardedDrives::of(Guard::default(), vec![interlock("d3", true)]);
    rig.read(0, false, 0.0);
    let text = |seconds| match rig.refusal(0, seconds) {
        Some(refusal @ Refusal::Interlocked(_)) => refusal.to_string(),
        other => format!("{other:?}"),
    };
    assert!(
        text(0.0).contains("`running` of d3 must be true, but is unknown: the drive is offline"),
        "{}",
        text(0.0)
    );
    rig.read(2, false, 1.0);
    assert!(text(1.0).contains("must be true, but is false"), "{}", text(1.0));
    rig.read(2, true, 2.0);
    assert_eq!(rig.refused(0, 2.5), None);
    assert!(text(3.5).contains("is stale: read 1.5 s ago"), "{}", text(3.5));
    rig.read(2, true, 4.0);
    assert_eq!(rig.clear(&[0], 1, 4.5), Verdict::Go);
    // The interlock no longer holds when the word is about to be written.
    assert!(rig.may_write(0, 1, 4.9));
    assert!(!rig.may_write(0, 1, 5.5));
    assert_eq!(
        rig.guards.tripped(DriveIndex::new(0), None, rig.at(5.5)),
        [],
        "it stops no motor"
    );
    let rig = GuardedDrives::of(Guard::default(), vec![interlock("d9", true)]);
    rig.read(0, false, 0.0);
    assert_eq!(rig.refused(0, 0.0), Some("interlock"), "no such drive");
    let rig = GuardedDrives::of(Guard::default(), vec![interlock("d3", false)]);
    rig.read(0, false, 0.0);
    assert_eq!(rig.refused(0, 0.0), Some("interlock"), "not known is not false");
    rig.read(2, false, 1.0);
    assert_eq!(rig.refused(0, 1.0), None);
}

#[test]
fn counters_belong_to_the_machine_over_a_reload() {
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    rig.read(0, false, 0.0);
    rig.start_and_stop(0, 1, 1.0);
    let starts =
        |guards: &Arc<BusGuards>, drive| reason(judged(guards, Stage::Accept, &[drive], (0, None), rig.at(10.0)));
    // The drive was renamed, and has another position on the bus.
    let mut specs: Vec<DriveSpec> = rig.images.iter().map(|image| image.spec.clone()).collect();
    specs[0].name = "other".to_string();
    specs.reverse();
    let after = BusGuards::of(&rig.shared, &rig.bus, &specs).unwrap();
    assert_eq!(starts(&after, 2), "starts_per_hour");
    assert_eq!(starts(&after, 1), "go");
    // Another machine at that address has no starts counted.
    specs[2].profile = profile("vacon-cx");
    let after = BusGuards::of(&rig.shared, &rig.bus, &specs).unwrap();
    assert_eq!(starts(&after, 2), "go");
    specs
        .iter_mut()
        .for_each(|spec| (spec.guard, spec.staggers) = (None, false));
    assert!(
        BusGuards::of(&rig.shared, &rig.bus, &specs).is_none(),
        "nothing to look after"
    );
}

#[test]
fn min_run_delays_the_first_stop_of_the_client_that_started_the_motor() {
    let guard = Guard {
        min_run: 20 * SECOND,
        ..Guard::default()
    };
    let rig = GuardedDrives::of(guard, Vec::new());
    rig.read(0, false, 0.0);
    assert!(!rig.guards.is_ordinary_stop(DriveIndex::new(0), "c", None), "it stands");
    assert_eq!(rig.clear(&[0], 1, 1.0), Verdict::Go);
    rig.guards
        .start_written(DriveIndex::new(0), 1, &Arc::from("c"), rig.at(1.0));
    let waits = |seconds| rig.guards.stop_waits(DriveIndex::new(0), rig.at(seconds));
    assert_eq!(waits(1.5), Some(rig.at(21.0)), "not read since");
    rig.read(0, true, 2.0);
    assert!(rig.guards.is_ordinary_stop(DriveIndex::new(0), "c", None));
    assert!(
        rig.guards.is_ordinary_stop(DriveIndex::new(0), "c", Some(rig.at(0.5))),
        "a stop before the start"
    );
    assert!(
        !rig.guards.is_ordinary_stop(DriveIndex::new(0), "c", Some(rig.at(2.0))),
        "a second stop"
    );
    assert!(!rig.guards.is_ordinary_stop(DriveIndex::new(0), "another", None));
    assert_eq!((waits(10.0), waits(21.0)), (Some(rig.at(21.0)), None));
    // The motor is seen to stand, or is not seen at all: the stop is not delayed.
    rig.read(0, false, 12.0);
    assert_eq!(waits(12.1), None);
    rig.read(1, false, 0.0);
    rig.read(1, true, 5.0);
    assert!(
        !rig.guards.is_ordinary_stop(DriveIndex::new(1), "c", None),
        "the panel started it"
    );
}

#[test]
fn times_for_people_are_never_0() {
    for (millis, text) in [
        (1, "0.1 s"),
        (950, "1.0 s"),
        (9_900, "9.9 s"),
        (12_345, "13 s"),
        (200_000, "4 min"),
    ] {
        assert_eq!(shown(Duration::from_millis(millis)), text);
    }
}

#[test]
fn outcomes_of_guards_are_busy_to_modbus() {
    let refused = Outcome::Refused(Refusal::Interlocked("x".to_string()));
    assert_eq!(refused.exception().map(|exception| exception.code()), Some(6));
}
