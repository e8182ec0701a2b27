//! Guards of starts with clients that do not know about them, on a line that loses and damages frames, with offline
//! drives, reloads, a disk that hangs, is full or cannot be read, and a process that is killed at any moment: no start by
//! an order on the wire breaks a rule, none is made while the starts of earlier runs are unknown, and stops come as soon as
//! without guards. What could not be written is written as soon as the disk takes it, unasked.

mod state_file;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::order::{Authority, Order, Origin, Outcome, Proof, Reason, Refusal, SourceKind, written};
use drivegate_core::permit::{Mode, Principal, Rules};
use drivegate_core::plant::{OrderRequest, Placed};
use drivegate_core::process_image::DriveSpec;
use drivegate_core::start_guard::{Guard, Guards, Interlock};
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::{Protocol, RequestPdu, Table};
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::random::Random;
use drivegate_sim::simulated_drive::Command;

use self::state_file::{Disk, StateFile};
use super::bus::Seen;
use super::rig::{PATIENCE, Rig, line, write};
use super::scenario::Line;

const SECOND: Duration = Duration::from_secs(1);
const HOUR: Duration = Duration::from_secs(3600);
const GUARD: Guard = Guard {
    starts_per_hour: Some(5),
    min_off: Duration::from_secs(4),
    min_run: Duration::ZERO,
    stagger: Duration::from_secs(2),
};
/// Longest time between the write of a start and the drive's action.
const WIRE: Duration = Duration::from_millis(100);

/// Drives 1 to 3 are guarded, the first also by the fourth.
fn works(family: &'static str) -> Line {
    fn guarded(spec: &mut DriveSpec) {
        spec.staggers = true;
        spec.guard = (spec.address < 4).then_some(GUARD);
        if spec.address == 1 {
            spec.interlocks = vec![Interlock {
                drive: "d0-4".to_string(),
                point: "running".to_string(),
                is: true,
                trip: true,
            }];
        }
    }
    Line {
        cycle: Duration::from_millis(250),
        spec: guarded,
        ..line(family, Protocol::ModbusRtu, 19_200, 4)
    }
}

/// What the drives really did.
#[derive(Default)]
struct Truth {
    running: BTreeMap<u8, bool>,
    stood: BTreeMap<u8, Instant>,
    /// When each drive carried out the last word that starts it.
    acted: BTreeMap<u8, Instant>,
    /// Starts of each drive by orders.
    starts: BTreeMap<u8, Vec<Instant>>,
}

struct Play {
    rig: Rig,
    dice: Random,
    file: StateFile,
    truth: Truth,
    began: Instant,
    stops: Vec<(Placed, Instant)>,
    orders: Vec<Placed>,
    results: BTreeMap<&'static str, u32>,
    longest_stop: Duration,
}

impl Play {
    fn new(family: &'static str, seed: u64) -> Play {
        let rig = Rig::new(&works(family), super::bus::Parts::of(0, &works(family), seed));
        let mut play = Play {
            began: rig.now,
            rig,
            dice: Random::new(seed ^ 0x57A7),
            file: StateFile::default(),
            truth: Truth::default(),
            stops: Vec::new(),
            orders: Vec::new(),
            results: BTreeMap::new(),
            longest_stop: Duration::ZERO,
        };
        play.file.begin(&play.rig.bus.guards, Duration::ZERO, play.rig.now);
        play
    }

    fn time(&self) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000) + (self.rig.now - self.began)
    }

    fn run(&mut self, time: Duration) {
        let until = self.rig.now + time;
        while self.rig.now < until {
            let next = until.min(self.rig.now + Duration::from_millis(10));
            while let Some(seen) = self.rig.step(next) {
                seen.into_iter().for_each(|seen| self.note(seen));
            }
            self.look();
            self.work_the_disk();
        }
    }

    /// Checks that a start is sent only where the interlock holds, as far as the gateway knows.
    fn note(&mut self, seen: Seen) {
        let (asked, acted) = match seen {
            Seen::Sent(asked) => (asked, false),
            Seen::Acted(asked) => (asked, true),
            Seen::Over(_) | Seen::Heard(_) => return,
        };
        let Some((table, items)) = written(&asked.pdu) else {
            return;
        };
        let profile = self.rig.bus.profile.clone();
        let starts = |(address, word): &(u16, u16)| profile.runs_by(table, *address, *word) == Some(true);
        if !items.iter().any(starts) {
            return;
        }
        let address = asked.drive as u8 + 1;
        if acted {
            self.truth.acted.insert(address, self.rig.now);
            return;
        }
        let known = |address| self.rig.good(address, ModelPoint::Running).map(Value::as_bool);
        let guarded = self.rig.drive(address).image.spec.guard.is_some();
        assert!(
            self.file.is_read() || !guarded || known(address) != Some(false),
            "a start of drive {address} on the wire while nobody knows how often it was started"
        );
        if address == 1 && known(1) == Some(false) && !self.rig.drive(1).image.spec.interlocks.is_empty() {
            assert_eq!(known(4), Some(true), "a start on the wire without its interlock");
        }
    }

    fn look(&mut self) {
        let now = self.rig.now;
        for address in 1..=4 {
            let running = self.rig.with_drive(address, |drive, _| drive.state().running);
            let ran = self.truth.running.insert(address, running);
            if ran == Some(true) && !running {
                self.truth.stood.insert(address, now);
            }
            let acted = self.truth.acted.get(&address).copied();
            if ran == Some(false) && running && acted.is_some_and(|at| now - at < SECOND) {
                self.started(address, now);
            }
        }
        let mut results = Vec::new();
        let may_refuse = self.file.may_refuse(now);
        self.orders.retain_mut(|placed| match placed.answer() {
            Some(answer) => {
                results.push(result_of(&answer.outcome, may_refuse));
                false
            }
            None => true,
        });
        for result in results {
            *self.results.entry(result).or_default() += 1;
        }
        let longest = &mut self.longest_stop;
        self.stops.retain_mut(|(placed, at)| match placed.answer() {
            Some(answer) => {
                if answer.outcome.is_ok() {
                    *longest = (*longest).max(now - *at);
                }
                false
            }
            None => true,
        });
    }

    fn started(&mut self, address: u8, now: Instant) {
        let guarded = self.rig.drive(address).image.spec.guard.is_some();
        if guarded {
            let own = self.truth.starts.get(&address).map_or(&[][..], Vec::as_slice);
            let within = own.iter().filter(|at| now - **at < HOUR - WIRE).count();
            assert!(
                within < 5,
                "drive {address} was started {} times within an hour",
                within + 1
            );
            if let Some(stood) = self.truth.stood.get(&address) {
                let stood = now - *stood;
                assert!(
                    stood + WIRE >= GUARD.min_off,
                    "drive {address} stood for {stood:?} only"
                );
            }
            for (other, starts) in &self.truth.starts {
                let apart = starts.last().map(|last| now - *last);
                assert!(
                    apart.is_none_or(|apart| apart + WIRE >= GUARD.stagger),
                    "drives {address} and {other} were started {apart:?} apart"
                );
            }
        }
        self.truth.starts.entry(address).or_default().push(now);
    }

    fn work_the_disk(&mut self) {
        let (now, time) = (self.rig.now, self.time());
        let takes = Duration::from_millis(self.dice.within(0..=60));
        self.file.advance(&self.rig.bus.guards, takes, now, time);
    }

    /// Kills the process. State that was being written may or may not be on disk.
    fn kill(&mut self) {
        self.file.kill(self.dice.chance(0.5));
        let (guards, now) = (Guards::default(), self.rig.now);
        let takes = Duration::from_millis(self.dice.within(0..=60));
        self.file.begin(&guards, takes, now);
        let events = self.rig.plant.events.clone();
        self.rig.bus.kill(guards, &events, now);
        self.rig.plant.buses = vec![self.rig.bus.handle.clone()];
        (self.stops, self.orders) = (Vec::new(), Vec::new());
    }

    fn order(&mut self) {
        let address = self.dice.within(1..=4) as u8;
        let stop = self.dice.chance(0.4);
        let profile = self.rig.bus.profile.clone();
        let place = profile.run_place().unwrap();
        let run = if stop { 0.0 } else { 1.0 };
        let order = match self.dice.within(0..=3) {
            0 if place.table == Table::Holding => write(place.address, run as u16),
            0 => Order::Write(RequestPdu::WriteCoil {
                address: place.address,
                on: !stop,
            }),
            1 if !stop => self.rig.points(address, &[("run", run), ("frequency_reference", 20.0)]),
            _ => self.rig.points(address, &[("run", run)]),
        };
        let kind = [SourceKind::Mqtt, SourceKind::ModbusTcp, SourceKind::Http][self.dice.within(0..=2) as usize];
        let (waits, expiry) = (self.dice.chance(0.3), SECOND * self.dice.within(1..=8) as u32);
        let drive = self.rig.drive(address);
        let placed = drive.place(
            OrderRequest::new(order, Origin::new(kind, "c"), Authority::Write)
                .within(expiry)
                .waiting(waits),
            self.rig.now,
        );
        self.rig.bus.command_came(self.rig.now);
        if stop {
            self.stops.push((placed, self.rig.now))
        } else {
            self.orders.push(placed)
        }
    }

    fn incident(&mut self) {
        match self.dice.within(0..=10) {
            0 | 1 => self.kill(),
            2 | 3 => {
                self.rig.restart_now();
            }
            4 | 10 => {
                let ill = Disk::ILL[self.dice.within(0..=2) as usize];
                self.file.becomes(if self.file.is_sound() { ill } else { Disk::Sound });
            }
            5 | 6 => {
                let address = self.dice.within(1..=4) as u8;
                self.rig.set_alive(address, false);
                self.run(8 * SECOND);
                self.rig.set_alive(address, true);
            }
            7 => {
                self.rig.bus.set_open(false, self.rig.now);
                self.run(3 * SECOND);
                self.rig.bus.set_open(true, self.rig.now);
            }
            _ => {
                let faults = if self.dice.chance(0.5) {
                    "drop=0.1,corrupt=0.1,busy=0.05"
                } else {
                    ""
                };
                let plan = match faults {
                    "" => FaultPlan::default(),
                    faults => FaultPlan::new(faults.parse().unwrap(), self.dice.within(1..=1_000_000)),
                };
                self.rig.set_faults(plan);
            }
        }
    }
}

/// The result of an order to start; a refusal for the file names it, and comes only while the file is not as it should be.
fn result_of(outcome: &Outcome, may_refuse: bool) -> &'static str {
    match outcome {
        Outcome::Refused(Refusal::Guarded(guarded)) if guarded.reason == Reason::StateFile => {
            assert!(StateFile::is_named(&guarded.why), "{}", guarded.why);
            assert!(may_refuse, "the file is as it should be: {}", guarded.why);
            guarded.reason.name()
        }
        outcome => outcome.code(),
    }
}

impl Play {
    /// Ends every fault, and lets all motors stand; then a person starts one at its drive while the disk is ill. After that
    /// has ended, the start is on disk without another order, and starts are commanded as ever.
    fn heal(&mut self, disk: Disk) {
        self.rig.set_faults(FaultPlan::default());
        self.file.becomes(Disk::Sound);
        self.run(15 * SECOND);
        assert!(self.stops.is_empty(), "a stop without an answer");
        assert!(self.file.is_read() && !self.file.may_refuse(self.rig.now));
        for address in 1..=4 {
            assert!(self.rig.set(address, &[("run", 0.0)]).is_ok());
        }
        self.run(30 * SECOND);
        assert_eq!(self.rig.good(2, ModelPoint::Running), Some(Value::Bool(false)));
        self.file.becomes(disk);
        let (time, by_hand) = (
            self.time(),
            Command {
                run: true,
                reverse: false,
                reference: 2_000,
            },
        );
        self.rig.with_drive(2, |drive, _| drive.command(by_hand));
        let ill = Duration::from_millis(self.dice.within(3_000..=20_000));
        self.run(ill);
        assert_eq!(self.rig.state(2), State::Running);
        assert!(!self.file.has_start(2, time), "on a disk that is {disk:?}");
        self.file.becomes(Disk::Sound);
        self.run(2 * SECOND);
        assert!(
            self.file.has_start(2, time),
            "not written though the disk is {disk:?} no more"
        );
        self.run(2 * SECOND);
        for address in [2, 3] {
            assert!(self.rig.set(address, &[("run", 0.0)]).is_ok());
            let order = self.rig.points(address, &[("run", 1.0)]);
            let placed = self.rig.place(address, order);
            self.orders.push(placed);
        }
        self.run(5 * SECOND);
        assert!(self.orders.is_empty(), "an order without an answer");
    }
}

#[test]
fn no_start_of_an_order_breaks_a_guard() {
    let mut results: BTreeMap<&str, u32> = BTreeMap::new();
    let mut starts = 0;
    for seed in 0..8 {
        let family = ["vacon-nx", "vacon-cx", "schneider-altivar", "eaton-hvx"][seed as usize % 4];
        let mut play = Play::new(family, seed);
        play.run(5 * SECOND);
        for _ in 0..300 {
            play.order();
            let pause = Duration::from_millis(play.dice.within(1..=4_000));
            play.run(pause);
            if play.dice.chance(0.1) {
                play.incident();
            }
        }
        play.heal(Disk::ILL[seed as usize % 3]);
        starts += play.truth.starts.values().map(Vec::len).sum::<usize>();
        for (result, count) in play.results {
            *results.entry(result).or_default() += count;
        }
    }
    let count = |result: &str| results.get(result).copied().unwrap_or_default();
    assert!(starts > 80, "{starts} starts: {results:?}");
    assert!(count("guarded") > 200 && count("interlocked") > 20, "{results:?}");
    assert!(count("state_file") > 20, "{results:?}");
}

/// Equal clients, line and time, with guards and without: the longest delay of a stop is equal.
#[test]
fn stops_come_as_soon_as_without_guards() {
    let longest = |guarded: bool| {
        let mut play = Play::new("vacon-nx", 77);
        if !guarded {
            let unguarded = Line {
                swapped: false,
                spec: |_| {},
                ..works("vacon-nx")
            };
            play.rig = Rig::new(&unguarded, super::bus::Parts::of(0, &unguarded, 77));
            play.began = play.rig.now;
        }
        // The disk hangs permanently: it delays starts only.
        play.file.becomes(Disk::Hangs);
        play.run(5 * SECOND);
        for _ in 0..300 {
            play.order();
            play.run(Duration::from_millis(200));
        }
        play.longest_stop
    };
    let (with, without) = (longest(true), longest(false));
    assert!(without > Duration::ZERO);
    assert!(
        with.as_secs_f64() <= 1.05 * without.as_secs_f64() + 0.011,
        "{with:?}, without guards {without:?}"
    );
}

#[test]
fn an_interlock_that_fails_stops_the_motor_and_keeps_it_from_starting() {
    let mut play = Play::new("vacon-nx", 3);
    play.run(5 * SECOND);
    let mut events = play.rig.plant.events.subscribe();
    let refused = play.rig.set(1, &[("run", 1.0)]);
    assert!(
        matches!(&refused, Outcome::Refused(Refusal::Interlocked(_))),
        "{refused}"
    );
    let start = |play: &mut Play, address| {
        let order = play.rig.points(address, &[("run", 1.0), ("frequency_reference", 20.0)]);
        let placed = play.rig.place(address, order);
        play.orders.push(placed);
        play.run(3 * SECOND);
        assert_eq!(play.rig.state(address), State::Running, "{:?}", play.results);
    };
    start(&mut play, 4);
    start(&mut play, 1);
    // The other drive goes offline, so its last reading becomes too old after a while.
    play.rig.set_alive(4, false);
    play.run(6 * SECOND);
    assert_eq!(play.rig.state(1), State::Ready);
    let told: Vec<_> = std::iter::from_fn(|| events.try_recv().ok()).collect();
    let tripped = told.iter().find(|event| event.text.contains("is being stopped"));
    let tripped = tripped.unwrap_or_else(|| unreachable!("{told:?}"));
    assert!(
        tripped
            .text
            .contains("an interlock of d0-1 is not satisfied: `running` of d0-4"),
        "{}",
        tripped.text
    );
    let stopped = told.iter().find(|event| event.text.contains("d0-1 has stopped"));
    assert!(
        stopped.unwrap().text.contains("an interlock is not satisfied"),
        "{told:?}"
    );
    let why = play.rig.drive(1).why(&play.rig.drive(1).reading(play.rig.now)).names();
    assert!(why.contains(&"interlocked".to_string()), "{why:?}");
}

#[test]
fn an_ordinary_stop_waits_for_min_run_and_a_second_one_does_not() {
    let of = Line {
        spec: |spec| {
            spec.guard = Some(Guard {
                min_run: Duration::from_secs(20),
                ..Guard::default()
            });
        },
        ..line("vacon-nx", Protocol::ModbusRtu, 19_200, 2)
    };
    let mut rig = Rig::of(&of);
    rig.until_state(1, State::Ready);
    let turns = |rig: &mut Rig| rig.with_drive(1, |drive, _| drive.state().running);
    let start = |rig: &mut Rig| {
        let outcome = rig.set(1, &[("run", 1.0), ("speed_reference", 50.0)]);
        assert!(outcome.is_ok(), "{outcome}");
        rig.until_state(1, State::Running);
    };
    start(&mut rig);
    let stop = rig.points(1, &[("run", 0.0)]);
    // A stop over MQTT, from the client that started the motor.
    let mut first = rig.place(1, stop.clone());
    rig.run(10 * SECOND);
    let waits = rig.drive(1).stop_waits(rig.now).unwrap();
    assert!(waits > 5 * SECOND && waits < 11 * SECOND, "{waits:?}");
    assert!(turns(&mut rig) && first.answer().is_none());
    rig.run(12 * SECOND);
    assert!(first.answer().unwrap().outcome.is_ok() && !turns(&mut rig));
    assert_eq!(rig.drive(1).stop_waits(rig.now), None);
    // A second stop of the first client, a stop of another client, and a stop through HTTP are sent at once.
    for (kind, who) in [
        (SourceKind::Mqtt, "test"),
        (SourceKind::Mqtt, "other"),
        (SourceKind::Http, "test"),
    ] {
        rig.until_state(1, State::Ready);
        start(&mut rig);
        let mut first = (who == "test" && kind == SourceKind::Mqtt).then(|| rig.place(1, stop.clone()));
        rig.run(SECOND);
        let waits = rig.drive(1).stop_waits(rig.now);
        assert!(
            turns(&mut rig),
            "{kind:?} {who}: {waits:?} {:?}",
            first.as_mut().and_then(|placed| placed.answer())
        );
        let origin = Origin::new(kind, who);
        let mut second = rig.drive(1).place(
            OrderRequest::new(stop.clone(), origin, Authority::Write).within(SECOND),
            rig.now,
        );
        rig.bus.command_came(rig.now);
        assert!(rig.answered(&mut second).is_ok(), "{who}");
        if let Some(first) = &mut first {
            assert!(rig.answered(first).is_ok(), "it joins");
        }
        // The ramp takes several seconds.
        rig.run(8 * SECOND);
        assert!(!turns(&mut rig), "{who}");
    }
    // After a reload, while it is briefly unknown whether the motor runs, the stop is sent.
    rig.until_state(1, State::Ready);
    start(&mut rig);
    let mut waiting = rig.place(1, stop);
    rig.run(5 * SECOND);
    assert!(turns(&mut rig) && waiting.answer().is_none());
    rig.restart();
    rig.run(20 * SECOND);
    assert!(!turns(&mut rig) && rig.answered(&mut waiting).is_ok());
    rig.until("it stands", PATIENCE, |rig| rig.state(1) == State::Ready);
}

/// A cyclic client writes its stop repeatedly, and none of these counts as a second stop. A stop of another client does.
#[test]
fn repeated_stops_of_a_cyclic_client_wait_for_min_run() {
    let of = Line {
        spec: |spec| {
            spec.guard = Some(Guard {
                min_run: Duration::from_secs(20),
                ..Guard::default()
            });
        },
        ..line("vacon-nx", Protocol::ModbusRtu, 19_200, 2)
    };
    for cyclic in [true, false] {
        let mut rig = Rig::of(&of);
        let principals = vec![Principal {
            cyclic,
            mqtt: Some("plc".to_string()),
            ..Principal::new("plc", 1)
        }];
        let rules = Rules {
            mode: Mode::Exclusive,
            ranks: ["site", "automation"].map(Into::into).to_vec(),
            lease: Duration::from_secs(30),
            stop_at_local: true,
            principals,
        };
        rig.bus.handle.queue.set_authority(Some(Arc::new(rules)));
        rig.until_state(1, State::Ready);
        let turns = |rig: &mut Rig| rig.with_drive(1, |drive, _| drive.state().running);
        let give = |rig: &mut Rig, points: &[(&str, f64)], proof: Proof| {
            let order = rig.points(1, points);
            let origin = Origin::new(SourceKind::Mqtt, "plc").proven(proof);
            let placed = rig.drive(1).place(
                OrderRequest::new(order, origin, Authority::Write).within(SECOND),
                rig.now,
            );
            rig.bus.command_came(rig.now);
            placed
        };
        let plc = || Proof::Topic("plc".into());
        let mut run = give(&mut rig, &[("run", 1.0), ("speed_reference", 50.0)], plc());
        assert!(rig.answered(&mut run).is_ok());
        rig.until_state(1, State::Running);
        let mut stops = Vec::new();
        for _ in 0..8 {
            stops.push(give(&mut rig, &[("run", 0.0)], plc()));
            rig.run(SECOND);
        }
        assert_eq!(turns(&mut rig), cyclic, "cyclic: {cyclic}");
        if cyclic {
            assert!(stops.iter_mut().all(|stop| stop.answer().is_none()));
            assert!(rig.drive(1).stop_waits(rig.now).is_some());
            stops.push(give(&mut rig, &[("run", 0.0)], Proof::Nothing));
            rig.run(8 * SECOND);
            assert!(!turns(&mut rig), "the stop of another client");
        }
        assert!(stops.iter_mut().all(|stop| rig.answered(stop).is_ok()));
    }
}

/// A rig with one ready drive that has this guard.
fn ready(spec: fn(&mut DriveSpec)) -> Rig {
    let mut rig = Rig::of(&Line {
        spec,
        ..line("vacon-nx", Protocol::ModbusRtu, 19_200, 1)
    });
    rig.until_state(1, State::Ready);
    rig.run(SECOND);
    assert!(rig.set(1, &[("speed_reference", 20.0)]).is_ok());
    rig
}

/// Writes the run word ten times a second for this time, as a PLC does; returns the number of refusals.
fn holds_run(rig: &mut Rig, time: Duration) -> u32 {
    let until = rig.now + time;
    let mut refused = 0;
    while rig.now < until {
        let order = rig.points(1, &[("run", 1.0)]);
        let mut placed = rig.place(1, order);
        rig.run(Duration::from_millis(100));
        let answer = placed.answer().map(|answer| answer.outcome);
        refused += u32::from(matches!(answer, Some(Outcome::Refused(Refusal::Guarded(_)))));
    }
    refused
}

#[test]
fn a_run_word_that_is_held_makes_one_start() {
    let mut rig = ready(|spec| {
        spec.guard = Some(Guard {
            starts_per_hour: Some(2),
            min_off: SECOND / 2,
            ..Guard::default()
        });
    });
    for start in 0..2 {
        assert_eq!(holds_run(&mut rig, 10 * SECOND), 0, "start {start}");
        assert_eq!(rig.state(1), State::Running);
        assert!(rig.set(1, &[("run", 0.0)]).is_ok());
        rig.until_state(1, State::Ready);
        rig.run(SECOND);
    }
    assert!(holds_run(&mut rig, SECOND) > 0, "two of two");
}

#[test]
fn a_run_word_that_is_held_at_a_fault_uses_no_start_up() {
    let mut rig = ready(|spec| {
        spec.guard = Some(Guard {
            starts_per_hour: Some(1),
            ..Guard::default()
        });
    });
    rig.with_drive(1, |drive, _| drive.trip(9));
    rig.until_state(1, State::Fault);
    assert_eq!(holds_run(&mut rig, 10 * SECOND), 0);
    assert_eq!(rig.state(1), State::Fault);
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    assert!(rig.set(1, &[("fault_reset", 1.0)]).is_ok());
    rig.until_state(1, State::Ready);
    rig.run(SECOND);
    assert_eq!(holds_run(&mut rig, 5 * SECOND), 0, "the one start of the hour is left");
    assert_eq!(rig.state(1), State::Running);
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    rig.until_state(1, State::Ready);
    assert!(holds_run(&mut rig, SECOND) > 0, "and it counts once");
}

#[test]
fn the_clearance_of_an_order_ends_with_its_bus() {
    let mut rig = ready(|spec| {
        spec.guard = Some(Guard {
            min_off: Duration::from_secs(8),
            ..Guard::default()
        });
    });
    rig.run(8 * SECOND);
    // This is the first order of its bus.
    assert!(rig.set(1, &[("run", 1.0), ("speed_reference", 20.0)]).is_ok());
    rig.until_state(1, State::Running);
    assert!(rig.set(1, &[("run", 0.0)]).is_ok());
    rig.until_state(1, State::Ready);
    rig.restart();
    rig.until_state(1, State::Ready);
    let order = rig.points(1, &[("run", 1.0)]);
    let origin = Origin::new(SourceKind::Mqtt, "test");
    let request = OrderRequest::new(order, origin, Authority::Write)
        .within(20 * SECOND)
        .waiting(true);
    let mut placed = rig.drive(1).place(request, rig.now);
    rig.bus.command_came(rig.now);
    rig.run(2 * SECOND);
    assert!(placed.answer().is_none(), "it waits for min_off");
    assert!(!rig.with_drive(1, |drive, _| drive.state().running));
    assert!(rig.answered(&mut placed).is_ok());
}
