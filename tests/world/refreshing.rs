//! Drives with a timeout of their own that a gateway with `refresh` feeds, while parameters are restored, drills run,
//! clients stop drives, the configuration is loaded again and the gateway ends: nothing is written again that is no
//! longer in force, and no drive trips whose client is there.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::drill::{DrillOptions, DrillState, Drills, Kind, LOOK};
use drivegate_core::order::{Origin, SourceKind};
use drivegate_core::process_image::{Access, DriveSpec, LeaseAction, OnShutdown, Supervision};
use drivegate_model::drive::ModelPoint;
use drivegate_proto::Protocol;
use drivegate_sim::random::Random;

use super::bus::{Asked, Parts, Seen};
use super::orders::{is_counted, run_command};
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;

/// Seeds of every test run.
const SEEDS: u64 = 30;
const DRIVES: u8 = 3;
const SECOND: Duration = Duration::from_secs(1);
const EVERY: Duration = Duration::from_millis(500);
const OWN_TIMEOUT: Duration = Duration::from_millis(2_500);
const LEASE: Duration = Duration::from_secs(4);
const DRILL: &str = "a drill";
const LIMITS: &str = "other limits";
/// Time in which the gateway notices what ends a refresh: the next round, of a drive that must be found again first.
const SEEN: Duration = Duration::from_secs(3);

/// Families by what is repeated: word and reference, together or apart, or the reference alone.
const FAMILIES: [&str; 6] = [
    "vacon-nx",
    "danfoss-fc",
    "abb-acs580",
    "schneider-altivar",
    "siemens-g120",
    "vacon-cx",
];

type Change = fn(&mut DriveSpec);

/// New settings of the first drive, each of which ends its refresh.
const CHANGES: [(&str, Change); 4] = [
    ("refresh = \"off\"", |spec| of_first(spec, |spec| spec.refresh = None)),
    ("no supervision", |spec| of_first(spec, |spec| spec.supervision = None)),
    ("access = \"monitor\"", |spec| {
        of_first(spec, |spec| spec.access = Access::Monitor)
    }),
    (LIMITS, |spec| {
        of_first(spec, |spec| {
            spec.limits.insert("speed_reference".to_string(), 0.0..=10.0);
        });
    }),
];

fn settings(spec: &mut DriveSpec) {
    // Some drives run on at the end of the gateway, while others get their stops.
    spec.on_shutdown = match spec.address % 2 {
        1 => OnShutdown::Stop,
        _ => OnShutdown::LeaveRunning,
    };
}

fn of_first(spec: &mut DriveSpec, change: impl FnOnce(&mut DriveSpec)) {
    settings(spec);
    if spec.address == 1 {
        change(spec);
    }
}

/// The truth about a drive.
#[derive(Debug, Default)]
struct Truth {
    /// When its own timeout began anew, while its motor runs.
    fed: Option<Instant>,
    /// Whether a client runs it and is there.
    is_wanted: bool,
    /// What ended the refresh for good, until a client's order is acknowledged.
    ended_by: Option<&'static str>,
    /// A stop that is not answered yet.
    stop_waits: bool,
    /// Whether a stop was the last order.
    is_stopped: bool,
    /// Refreshes that were written, in all.
    refreshed: u64,
}

struct World {
    rig: Rig,
    dice: Random,
    drills: Arc<Drills>,
    began: Instant,
    renewed: Instant,
    truths: Vec<Truth>,
    ends: bool,
    about: String,
}

impl World {
    fn new(seed: u64) -> World {
        let mut dice = Random::new(seed);
        let family = FAMILIES[seed as usize % FAMILIES.len()];
        let baud = [9_600, 19_200, 38_400][dice.within(0..=2) as usize];
        let line = Line {
            cycle: Duration::from_millis(dice.within(50..=300)),
            refresh: Some(EVERY),
            own_timeout: Some(OWN_TIMEOUT),
            supervision: Some(Supervision {
                timeout: LEASE,
                action: LeaseAction::Stop,
                adopt: false,
            }),
            spec: settings,
            ..line(family, Protocol::ModbusRtu, baud, DRIVES)
        };
        let mut rig = Rig::new(&line, Parts::of(0, &line, seed));
        rig.until("all are read", PATIENCE, Rig::is_whole);
        let drills = Arc::<Drills>::default();
        drills.set_options(Some(DrillOptions {
            max_speed: 20.0,
            limit: Duration::from_secs(25),
            every: Duration::from_secs(3600),
        }));
        World {
            dice,
            drills,
            began: rig.now,
            renewed: rig.now,
            truths: (0..DRIVES).map(|_| Truth::default()).collect(),
            ends: false,
            about: format!("seed {seed}, {family}"),
            rig,
        }
    }

    fn truth(&mut self, address: u8) -> &mut Truth {
        &mut self.truths[usize::from(address) - 1]
    }

    /// Runs the next event until then.
    fn step(&mut self, until: Instant) {
        let until = until.min(self.rig.now + LOOK);
        for seen in self.rig.step(until).into_iter().flatten() {
            match seen {
                Seen::Sent(asked) if asked.pdu.is_write() => self.sent(&asked),
                Seen::Acted(asked) if is_counted(&self.rig.bus.profile, &asked.pdu) => {
                    let now = self.rig.now;
                    self.truth(asked.acted).fed = Some(now);
                }
                _ => {}
            }
        }
        self.own_timeouts();
        if self.rig.now >= self.renewed + SECOND {
            self.renewed = self.rig.now;
            let wanted = self.truths.iter().enumerate().filter(|(_, truth)| truth.is_wanted);
            for (place, _) in wanted {
                self.rig.bus.handle.image.drives[place].renew_lease(self.rig.now);
            }
            self.rig.bus.command_came(self.rig.now);
        }
    }

    fn run(&mut self, time: Duration) {
        let until = self.rig.now + time;
        while self.rig.now < until {
            self.step(until);
        }
    }

    fn run_periods(&mut self, most: u64) {
        let time = self.dice.within(0..=most * EVERY.as_millis() as u64);
        self.run(Duration::from_millis(time));
    }

    fn sent(&mut self, asked: &Asked) {
        let (about, now, place) = (&self.about, self.rig.now, asked.drive);
        let truth = &mut self.truths[place];
        if !asked.is_refresh {
            truth.ended_by.take_if(|why| *why == DRILL);
            return;
        }
        let handle = &self.rig.bus.handle;
        let about = format!("{about}: drive {} gets {:?} again", place + 1, asked.pdu);
        assert!(!self.ends, "{about} while the gateway ends");
        let is_held = handle.image.drives[place].restore_lock.reason().is_some();
        assert!(!is_held, "{about} while its parameters are restored");
        let is_quiet = handle.queue.quiet(now).is_some_and(|(drive, _)| drive.place() == place);
        assert!(!is_quiet, "{about} while a drill tries its own timeout");
        assert_eq!(truth.ended_by, None, "{about} though that had ended");
        assert!(!truth.stop_waits, "{about} while a stop waits");
        let runs = run_command(&self.rig.bus.profile, &asked.pdu) == Some(true);
        assert!(!runs || !truth.is_stopped, "{about} behind a stop");
        truth.refreshed += 1;
    }

    /// Trips the drives whose motors run and that got no write which their timeout counts.
    fn own_timeouts(&mut self) {
        let now = self.rig.now;
        for address in 1..=DRIVES {
            let runs = self.runs(address);
            let truth = self.truth(address);
            truth.fed = runs.then(|| truth.fed.unwrap_or(now));
            if truth.fed.is_none_or(|fed| now - fed <= OWN_TIMEOUT) {
                continue;
            }
            let is_wanted = truth.is_wanted;
            assert!(
                !is_wanted,
                "{}: drive {address} trips, and its client is there",
                self.about
            );
            self.rig.with_drive(address, |drive, _| drive.trip(1));
        }
    }

    fn runs(&mut self, address: u8) -> bool {
        self.rig.with_drive(address, |drive, _| drive.state().running)
    }

    /// Gives a client's order; whether the drive took it.
    fn order(&mut self, address: u8, points: &[(&str, f64)]) -> bool {
        let order = self.rig.points(address, points);
        let mut placed = self.rig.place(address, order);
        let until = self.rig.now + PATIENCE;
        loop {
            if let Some(answer) = placed.answer() {
                let is_ok = answer.outcome.is_ok();
                self.truth(address).ended_by.take_if(|_| is_ok);
                return is_ok;
            }
            assert!(self.rig.now < until, "{}: an order that nobody answers", self.about);
            self.step(until);
        }
    }

    fn start(&mut self, address: u8) {
        for _ in 0..40 {
            self.run(SECOND);
            let has_fault = self
                .rig
                .good(address, ModelPoint::Fault)
                .is_some_and(|fault| fault.as_bool());
            if has_fault {
                self.order(address, &[("fault_reset", 1.0)]);
                continue;
            }
            self.truth(address).is_stopped = false;
            if self.order(address, &[("speed_reference", 40.0), ("run", 1.0)]) && self.runs(address) {
                self.truth(address).is_wanted = true;
                return;
            }
        }
        panic!("{}: drive {address} does not start", self.about);
    }

    fn stop(&mut self, address: u8) {
        let truth = self.truth(address);
        (truth.is_wanted, truth.stop_waits, truth.is_stopped) = (false, true, true);
        assert!(self.order(address, &[("run", 0.0)]), "{}: no stop", self.about);
        self.truth(address).stop_waits = false;
    }

    /// Parameters of a drive are restored, usually while its motor is at standstill.
    fn restores(&mut self, address: u8) {
        if self.dice.chance(0.7) {
            self.stop(address);
            self.run_periods(4);
        }
        (self.truth(address).is_wanted, self.truth(address).ended_by) = (false, Some("a restore"));
        let hold = |world: &World, why: Option<&str>| {
            let image = &world.rig.bus.handle.image.drives[usize::from(address) - 1];
            image.restore_lock.set(why.map(str::to_string));
        };
        hold(self, Some("a restore"));
        self.run(SEEN);
        self.run_periods(10);
        hold(self, None);
        self.run_periods(6);
        self.start(address);
    }

    fn drills(&mut self, address: u8) {
        self.stop(address);
        self.run(5 * SECOND);
        let all = [Kind::Order, Kind::Client, Kind::Gateway];
        let kinds = match self.dice.within(0..=3) {
            3 => &all[..],
            one => &all[one as usize..=one as usize],
        };
        let (drills, who) = (self.drills.clone(), Origin::new(SourceKind::Http, "alice"));
        let time = |world: &World| SystemTime::UNIX_EPOCH + 20_000 * 86_400 * SECOND + (world.rig.now - world.began);
        let handle = self.rig.drive(address);
        let armed = drills.arm(&handle, (kinds, Some(10.0)), &who, self.rig.now, time(self));
        let id = armed.unwrap().id;
        (self.truth(address).ended_by, self.truth(address).is_stopped) = (Some(DRILL), false);
        drills
            .start(&self.rig.plant, &id, &who, self.rig.now, time(self))
            .unwrap();
        let until = self.rig.now + Duration::from_secs(300);
        loop {
            self.rig.bus.command_came(self.rig.now);
            assert!(self.rig.now < until, "{}: {:?}", self.about, drills.report(&id));
            self.run(LOOK);
            if !drills.advance(&self.rig.plant, self.rig.now, time(self)) {
                break;
            }
        }
        let report = drills.report(&id).unwrap();
        assert_eq!(report.state, DrillState::Passed, "{}: {report:#?}", self.about);
        self.truth(address).is_stopped = true;
        self.run_periods(6);
        self.start(address);
    }

    /// The configuration is loaded again.
    fn reloads(&mut self, spec: Change) {
        while self.rig.bus.core.asked().is_some() {
            self.step(self.rig.now + SECOND);
        }
        self.rig.bus.line.spec = spec;
        self.rig.restart_now();
    }

    /// A reload changes settings of the first drive, and another one takes that back.
    fn changes(&mut self) {
        let (what, change) = CHANGES[self.dice.within(0..=CHANGES.len() as u64 - 1) as usize];
        // Limits do not concern a stop.
        if self.dice.chance(0.3) && what != LIMITS {
            self.stop(1);
            self.run_periods(3);
        }
        self.reloads(change);
        self.truth(1).is_wanted = false;
        // Limits may rest on readings, which the new bus does not have yet.
        let seen = if what == LIMITS { SEEN } else { Duration::ZERO };
        self.run(seen);
        self.truth(1).ended_by = Some(what);
        self.run(SEEN);
        self.run_periods(10);
        self.reloads(settings);
        self.run_periods(6);
        self.start(1);
    }

    fn moves(&mut self) {
        let address = self.dice.within(1..=u64::from(DRIVES)) as u8;
        match self.dice.within(0..=6) {
            0 | 1 => self.restores(address),
            2 => self.drills(address),
            3 => {
                self.stop(address);
                self.run_periods(5);
                self.start(address);
            }
            4 => self.reloads(settings),
            _ => self.changes(),
        }
        self.run_periods(5);
    }

    /// The gateway ends at any moment, also in the middle of a refresh.
    fn ends(&mut self) {
        let deadline = self.rig.now + 30 * SECOND;
        let mut report = self.rig.bus.handle.queue.begin_shutdown(deadline, self.rig.now);
        self.truths.iter_mut().for_each(|truth| truth.is_wanted = false);
        (self.ends, self.rig.bus.ending) = (true, true);
        self.rig.bus.command_came(self.rig.now);
        while report.try_recv().is_err() {
            assert!(self.rig.now < deadline, "{}: the shutdown does not end", self.about);
            self.step(deadline);
        }
    }

    fn live(&mut self) {
        (1..=DRIVES).for_each(|address| self.start(address));
        self.run(4 * SECOND);
        for truth in &self.truths {
            assert!(truth.refreshed > 0, "{}: nothing is written again", self.about);
        }
        for _ in 0..6 {
            self.moves();
        }
        self.ends();
    }
}

#[test]
fn nothing_is_written_again_that_a_restore_a_drill_a_reload_or_the_end_has_ended() {
    let first = super::number("REFRESHING_FROM").unwrap_or(0);
    let seeds = super::number("REFRESHING_SEEDS").unwrap_or(SEEDS);
    for seed in first..first + seeds {
        World::new(seed).live();
    }
}
