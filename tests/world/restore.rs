//! Restores of parameters in virtual time, on drives with random values, with incidents on the line, at the drive and in the gateway: no
//! parameter is written while the motor is fed, no other client commands the drive meanwhile except by stops, and wherever a restore is
//! interrupted the drive ends up with all new values or all former ones.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use drivegate_core::order::{Authority, Order, Origin, Outcome, ParameterOrder, SourceKind};
use drivegate_core::parameters::{
    End, Journal, NO_IDENTIFICATION, Names, Next, Owner, ParameterFile, Phase, Plan, Reading, Restoration, RestoreNeed,
    Then, Wishes, differences, plan,
};
use drivegate_core::plant::{OrderRequest, Placed};
use drivegate_core::process_image::ParamsAccess;
use drivegate_model::drive::ModelPoint;
use drivegate_proto::{Protocol, Reply, RequestPdu};
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::nx::Command;
use drivegate_sim::random::Random;

use super::bus::Seen;
use super::rig::{Rig, line};
use super::scenario::Line;

/// Address of the drive to which parameters are restored.
const DRIVE: u8 = 1;
const SOURCE: u8 = 2;

/// Seeds of every test run.
const SEEDS: u64 = 100;

const FAMILIES: [(&str, Protocol, u32); 4] = [
    ("vacon-nx", Protocol::ModbusRtu, 38_400),
    ("eaton-svx", Protocol::ModbusRtu, 38_400),
    ("vacon-cx", Protocol::ModbusRtu, 19_200),
    ("teco-7300pa", Protocol::ModbusAscii, 19_200),
];

/// Faults of the line. Every reply that arrives is the drive's own.
const FAULTS: [&str; 5] = [
    "",
    "drop=0.05",
    "deaf=0.05,corrupt=0.05",
    "truncate=0.05",
    "drop=0.1,corrupt=0.1",
];

/// The restore was cut off because the gateway was killed.
struct Cut;

struct RestoreWorld {
    rig: Rig,
    dice: Random,
    /// The content of the journal on disk.
    disk: Option<String>,
    plan: Plan,
    /// Time at which the gateway is killed.
    cut_at: Option<Instant>,
    /// When the next event happens.
    next: Instant,
    /// Whether events disturb the restore.
    troubled: bool,
    /// When a person at the drive last started the motor.
    started: Option<Instant>,
    /// Time at which a person stops the motor, or puts the drive back on the line.
    mended: Option<Instant>,
    /// When the drive reported that its motor is at standstill, if that was the last transaction on the line.
    stands: Option<Instant>,
    stops: Vec<Placed>,
    refused: usize,
    stopped: usize,
    cuts: usize,
    writes: usize,
}

/// All parameters of a drive with their values in the drive.
fn held(rig: &mut Rig, address: u8) -> ParameterFile {
    let profile = rig.drive(address).image.spec.profile.clone();
    let mut reading = Reading::new(profile, BTreeSet::new());
    while let Some(pdu) = reading.request() {
        let outcome = match rig.with_drive(address, |drive, now| drive.answer(&pdu, now)) {
            Some(Reply::Exception(code)) => Outcome::Exception(code),
            Some(reply) => Outcome::Acknowledged(reply),
            None => Outcome::TimedOut,
        };
        assert_eq!(reading.answered(&outcome), Next::Go);
    }
    reading.file("d0", "none", "2026-03-02T07:40:12Z", &Names::default())
}

impl RestoreWorld {
    fn new(seed: u64) -> RestoreWorld {
        let mut dice = Random::new(seed);
        let (family, protocol, baud) = FAMILIES[seed as usize % FAMILIES.len()];
        let line = Line {
            cycle: Duration::from_millis(dice.within(20..=500)),
            spec: |spec| spec.params = ParamsAccess::Write,
            ..line(family, protocol, baud, 2)
        };
        let mut rig = Rig::of(&line);
        for address in [DRIVE, SOURCE] {
            let seed = seed * 2 + u64::from(address);
            rig.with_drive(address, |drive, _| {
                drive.fill_parameters(seed);
                drive.set_programming(true);
            });
        }
        rig.until("the drives are read", Duration::from_secs(60), |rig| {
            [DRIVE, SOURCE]
                .iter()
                .all(|drive| rig.good(*drive, ModelPoint::Running).is_some())
        });
        let (wanted, present) = (held(&mut rig, SOURCE), held(&mut rig, DRIVE));
        let wishes = Wishes {
            only: Vec::new(),
            force: true,
        };
        let profile = rig.drive(DRIVE).image.spec.profile.clone();
        let (plan, _) = plan(&profile, &wanted, &present, &wishes).unwrap();
        assert!(plan.writes.len() > 3, "{family}: {}", plan.writes.len());
        let faults = FAULTS[seed as usize / FAMILIES.len() % FAULTS.len()];
        if !faults.is_empty() {
            rig.set_faults(FaultPlan::new(faults.parse().unwrap(), seed));
        }
        let next = rig.now;
        RestoreWorld {
            rig,
            dice,
            disk: None,
            plan,
            cut_at: None,
            next,
            troubled: true,
            started: None,
            mended: None,
            stands: None,
            stops: Vec::new(),
            refused: 0,
            stopped: 0,
            cuts: 0,
            writes: 0,
        }
    }

    fn journal(&self) -> Journal {
        let drive = self.rig.drive(DRIVE);
        let spec = &drive.image.spec;
        Journal {
            of: Owner {
                drive: spec.name.clone(),
                bus: spec.bus.clone(),
                family: spec.profile.name.clone(),
                machine: Some(drive.machine()),
                identification: NO_IDENTIFICATION.to_string(),
            },
            begun: "2026-03-02T07:40:12Z".to_string(),
            by: "test".to_string(),
            phase: Phase::Writing,
            done: 0,
            saved: false,
            plan: self.plan.clone(),
        }
    }

    /// The drive takes no commands but stops from now on, or all again.
    fn hold(&self, held: bool) {
        let why = held.then(|| "a restore".to_string());
        self.rig.drive(DRIVE).image.restore_lock.set(why);
    }

    /// Checks the line: a parameter is written only directly after the reply that the motor is at standstill, and with the
    /// journal on disk.
    fn look(&mut self, seen: Vec<Seen>) {
        let profile = self.rig.drive(DRIVE).image.spec.profile.clone();
        let running = profile
            .model_point(ModelPoint::Running)
            .and_then(|point| point.raw())
            .unwrap()
            .clone();
        let ours = |pdu: &RequestPdu| match pdu {
            RequestPdu::WriteRegister { address, .. } => {
                profile.parameters.id(*address).is_some()
                    || self.plan.handling.save.is_some_and(|save| save.0 == *address)
            }
            _ => false,
        };
        for one in seen {
            match one {
                Seen::Sent(asked) if asked.drive == 0 && ours(&asked.pdu) => {
                    assert!(
                        self.stands.is_some(),
                        "a parameter was written without asking whether the motor runs"
                    );
                    assert!(
                        self.disk.is_some(),
                        "a parameter was written before the journal was on disk"
                    );
                }
                Seen::Acted(asked) if asked.drive == 0 && ours(&asked.pdu) => {
                    let taken = !matches!(asked.reply, Some(Reply::Exception(_)));
                    self.writes += usize::from(taken);
                    let checked = self.stands.take();
                    let fed = self.rig.with_drive(DRIVE, |drive, _| drive.state().running);
                    // A drive updates its reports at intervals: a start by a person at that moment, or later, is
                    // not noticed.
                    let unseen = 2 * profile.update_period;
                    let just_started = self
                        .started
                        .zip(checked)
                        .is_some_and(|(started, checked)| started + unseen >= checked);
                    assert!(
                        !taken || !fed || just_started,
                        "a parameter was written while the motor was fed, {:?} after somebody started it, {:?} after it was asked",
                        self.started.map(|started| self.rig.now - started),
                        checked.map(|checked| self.rig.now - checked)
                    );
                }
                Seen::Over(asked) => {
                    let asks = asked.drive == 0
                        && matches!(&asked.pdu, RequestPdu::Read { table, start, count }
                            if (*table, *start, *count) == (running.table, running.address, running.form.items()));
                    let words = asked.reply.as_ref().and_then(Reply::words).filter(|_| asks);
                    let stands = words
                        .and_then(|words| running.decode(&words, drivegate_model::drive::model::Kind::Bool))
                        .is_some_and(|runs| !runs.as_bool());
                    self.stands = stands.then_some(asked.at);
                }
                Seen::Sent(_) | Seen::Acted(_) | Seen::Heard(_) => {}
            }
        }
    }

    /// Runs until the next event, or `until`.
    fn step(&mut self, until: Instant) -> Result<(), Cut> {
        let until = until.min(self.next.max(self.rig.now));
        if let Some(seen) = self.rig.step(until) {
            self.look(seen);
        }
        if self.cut_at.is_some_and(|at| at <= self.rig.now) {
            return Err(Cut);
        }
        if self.rig.now >= self.next {
            self.something_happens();
        }
        Ok(())
    }

    fn run(&mut self, time: Duration) -> Result<(), Cut> {
        let until = self.rig.now + time;
        while self.rig.now < until {
            self.step(until)?;
        }
        Ok(())
    }

    fn start_motor(&mut self, run: bool) {
        let command = Command {
            run,
            reverse: false,
            reference: 3000,
        };
        self.rig.with_drive(DRIVE, |drive, now| {
            drive.set_programming(!run);
            drive.set_reset(run);
            drive.command(command);
            if !run && drive.state().running {
                // The ramp may take an hour, so a trip stops the motor.
                drive.trip(1);
            }
            drive.advance(now);
            drive.set_reset(false);
        });
    }

    fn mend(&mut self) {
        self.mended = None;
        self.start_motor(false);
        self.rig.set_alive(DRIVE, true);
        self.rig.bus.set_open(true, self.rig.now);
    }

    fn something_happens(&mut self) {
        let now = self.rig.now;
        self.next = now + Duration::from_millis(self.dice.within(1..=400));
        self.note_stops();
        if self.mended.is_some_and(|at| at <= now) {
            self.mend();
        }
        if !self.troubled {
            return;
        }
        match self.dice.within(0..=11) {
            0 => {
                self.start_motor(true);
                self.started = Some(now);
                self.mended = Some(now + Duration::from_millis(self.dice.within(10..=3000)));
            }
            1 => {
                self.rig.set_alive(DRIVE, false);
                self.mended = Some(now + Duration::from_millis(self.dice.within(10..=2000)));
            }
            2 => {
                self.rig.bus.set_open(false, now);
                self.mended = Some(now + Duration::from_millis(self.dice.within(10..=500)));
            }
            3 => self.stop_by_a_client(),
            4..=7 => self.order_of_a_client(),
            8 => {
                let order = self.rig.points(SOURCE, &[("frequency_reference", 12.0)]);
                drop(self.rig.place(SOURCE, order));
            }
            _ => {}
        }
    }

    fn note_stops(&mut self) {
        let mut open = std::mem::take(&mut self.stops);
        open.retain_mut(|stop| match stop.answer() {
            Some(answer) => {
                assert!(
                    !matches!(answer.outcome, Outcome::Refused(_)),
                    "a stop was refused: {}",
                    answer.outcome
                );
                self.stopped += usize::from(answer.outcome.is_ok());
                false
            }
            None => true,
        });
        self.stops = open;
    }

    fn stop_by_a_client(&mut self) {
        let order = self.rig.points(DRIVE, &[("run", 0.0)]);
        let placed = self.rig.place(DRIVE, order);
        self.stops.push(placed);
    }

    /// Checks that every order of a client is refused while the drive is locked.
    fn order_of_a_client(&mut self) {
        let held = self.rig.drive(DRIVE).image.restore_lock.reason().is_some();
        if !held {
            return;
        }
        let order = match self.dice.within(0..=3) {
            0 => self.rig.points(DRIVE, &[("run", 1.0)]),
            1 => self.rig.points(DRIVE, &[("frequency_reference", 10.0)]),
            2 => self.rig.points(DRIVE, &[("fault_reset", 1.0)]),
            _ => Order::Write(RequestPdu::WriteRegister {
                address: 101,
                value: 4321,
            }),
        };
        let mut placed = self.rig.place(DRIVE, order);
        let outcome = placed.answer().expect("refused at once").outcome;
        assert!(
            matches!(outcome, Outcome::Refused(_) | Outcome::Offline | Outcome::BusDown),
            "an order got through: {outcome}"
        );
        self.refused += usize::from(matches!(outcome, Outcome::Refused(_)));
    }

    fn set(&mut self, order: ParameterOrder) -> Result<Outcome, Cut> {
        let origin = Origin::new(SourceKind::LocalSocket, "test");
        let (order, expiry) = (Order::Parameter(order), Duration::from_secs(30));
        let mut placed = self.rig.drive(DRIVE).place(
            OrderRequest::new(order, origin, Authority::Write).within(expiry),
            self.rig.now,
        );
        self.rig.bus.command_came(self.rig.now);
        let until = self.rig.now + Duration::from_secs(120);
        loop {
            if let Some(answer) = placed.answer() {
                return Ok(answer.outcome);
            }
            assert!(self.rig.now < until, "an order that nobody answers");
            self.step(until)?;
        }
    }

    /// Carries out the steps of a restore until it is over or interrupted.
    fn carry_out(&mut self, mut restoration: Restoration) -> Result<End, Cut> {
        let profile = self.rig.drive(DRIVE).image.spec.profile.clone();
        let disk_takes = |dice: &mut Random| Duration::from_millis(dice.within(0..=60));
        loop {
            match restoration.wanted() {
                RestoreNeed::Record => {
                    let takes = disk_takes(&mut self.dice);
                    self.run(takes)?;
                    self.disk = Some(restoration.journal().text(&profile));
                    restoration.recorded(Ok(()), self.rig.now);
                }
                RestoreNeed::Set(order) => {
                    let outcome = self.set(order)?;
                    if let Then::Pause(time, _) = restoration.answered(&outcome, self.rig.now) {
                        self.run(time)?;
                    }
                }
                RestoreNeed::Remove => {
                    let takes = disk_takes(&mut self.dice);
                    self.run(takes)?;
                    self.disk = None;
                    restoration.removed(Ok(()));
                }
                RestoreNeed::Nothing => return Ok(restoration.end().expect("it is over").clone()),
            }
        }
    }

    /// Starts the gateway again, which holds the drive if a journal exists.
    fn start_anew(&mut self) {
        self.cuts += 1;
        (self.cut_at, self.stands) = (None, None);
        self.stops.clear();
        self.rig.restart();
        self.hold(self.disk.is_some());
        self.next = self.rig.now;
    }

    /// Carries out a restore that is cut off `cuts` times; returns whether the drive then has the new values.
    fn restore(&mut self, mut cuts: u64) -> bool {
        for _ in 0..50 {
            let parsed = self.disk.as_deref().map(|text| {
                let profile = self.rig.drive(DRIVE).image.spec.profile.clone();
                Journal::parse(text, &profile).expect("a journal that was cut is whole")
            });
            self.troubled = cuts > 0 || self.dice.chance(0.5);
            if cuts > 0 {
                cuts -= 1;
                let at = self.dice.within(0..=100 * self.plan.writes.len() as u64);
                self.cut_at = Some(self.rig.now + Duration::from_millis(at));
            }
            if !self.troubled {
                self.mend();
            }
            let now = self.rig.now;
            let (restoration, back) = match parsed {
                None => {
                    // An earlier order is carried out before, or refused.
                    let order = self.rig.points(DRIVE, &[("frequency_reference", 11.0)]);
                    drop(self.rig.place(DRIVE, order));
                    self.hold(true);
                    (Restoration::begin(self.journal(), now), false)
                }
                Some(journal) if self.dice.chance(0.5) => (Restoration::resume(journal, now), false),
                Some(journal) => (Restoration::undo(journal, now), true),
            };
            match self.carry_out(restoration) {
                Err(Cut) => {
                    // The restore may have been complete except for the journal.
                    self.start_anew();
                }
                Ok(End::Done) => {
                    assert!(!back && self.disk.is_none());
                    return true;
                }
                Ok(End::TakenBack) => {
                    assert!(back && self.disk.is_none());
                    return false;
                }
                Ok(End::NothingWritten(_)) => {
                    self.hold(false);
                    self.mend();
                }
                Ok(End::Unfinished(why)) => unreachable!("{why}"),
            }
        }
        unreachable!("it does not come to its end");
    }
}

fn one(seed: u64, cuts: u64) -> (usize, usize, usize, usize) {
    let mut world = RestoreWorld::new(seed);
    let before = held(&mut world.rig, DRIVE);
    let done = world.restore(cuts);
    world.troubled = false;
    world.mend();
    let after = held(&mut world.rig, DRIVE);
    for write in &world.plan.writes {
        let expected = if done { write.to } else { write.from };
        assert_eq!(
            after.values[&write.id].value,
            Ok(expected),
            "seed {seed}: {}",
            write.line
        );
    }
    let written: BTreeSet<_> = world.plan.writes.iter().map(|write| &write.id).collect();
    let others = differences(&before, &after);
    let others: Vec<_> = others.iter().filter(|one| !written.contains(&one.id)).collect();
    assert_eq!(
        others,
        Vec::<&drivegate_core::parameters::Difference>::new(),
        "seed {seed}"
    );
    if done {
        let source = held(&mut world.rig, SOURCE);
        let left_out: BTreeSet<_> = world.plan.left_out.iter().map(|(id, _)| id.clone()).collect();
        let differ = differences(&source, &after);
        assert!(
            differ.iter().all(|one| left_out.contains(&one.id)),
            "seed {seed}: {differ:?}"
        );
    }
    let records = world.rig.with_drive(DRIVE, |drive, _| drive.parameter_writes());
    let sound = FAULTS[seed as usize / FAMILIES.len() % FAULTS.len()].is_empty();
    for (address, record) in records {
        // A person who starts the motor in between is noticed above.
        assert!(
            record.while_fed == 0 || world.started.is_some(),
            "seed {seed}: {address} {record:?}"
        );
        if cuts == 0 && sound {
            assert!(
                record.taken <= 1,
                "seed {seed}: {address} was written {} times",
                record.taken
            );
        }
    }
    (world.cuts, world.refused, world.stopped, world.writes)
}

#[test]
fn wherever_it_is_cut_off_the_drive_comes_to_have_all_values_or_the_former_ones() {
    let first = super::number("RESTORE_FROM").unwrap_or(0);
    let seeds = super::number("RESTORE_SEEDS").unwrap_or(SEEDS);
    let (mut cuts, mut refused, mut stopped, mut writes) = (0, 0, 0, 0);
    for seed in first..first + seeds {
        let figures = one(seed, 2 + seed % 3);
        cuts += figures.0;
        refused += figures.1;
        stopped += figures.2;
        writes += figures.3;
    }
    println!(
        "{seeds} restores, {cuts} cuts, {writes} writes taken, {refused} orders refused, {stopped} stops carried out"
    );
    assert!(cuts as u64 >= 2 * seeds && refused > 0 && stopped > 0);
}

#[test]
fn each_parameter_is_written_once() {
    for seed in 0..FAMILIES.len() as u64 {
        let (cuts, ..) = one(seed, 0);
        assert_eq!(cuts, 0);
    }
}
