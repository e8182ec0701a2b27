//! Worlds in which threads stall, names and units move to other machines, and drives restart between two polls.
//!
//! The clients are bytes on connections that a thread must read: bytes sent while the reading thread is stalled
//! wait, and a client may close the connection before they are read. A shadow model (`promised`) records which
//! orders each client gave to which machine, and when. Every run command to a drive, and every start of a motor, must
//! result from an order that its client has not withdrawn.

mod clients;
mod incidents;
mod own_timeouts;
mod promised;
mod resets;
mod silence;

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate_bus::core::Action;
use drivegate_core::event::Events;
use drivegate_core::order::{Authority, CommandLog, Order, Origin, SourceKind};
use drivegate_core::plant::{OrderRequest, Placed, Plant, SharedPlant, UnusedNames};
use drivegate_core::process_image::{LeaseAction, Supervision};
use drivegate_core::stalls::{Heartbeat, TICK};
use drivegate_model::drive::profile::Profiles;
use drivegate_model::drive::{ModelPoint, Value};
use drivegate_north::modbus_tcp::Loopback;
use drivegate_proto::Protocol;
use drivegate_sim::random::Random;
use drivegate_sim::simulated_drive::{Command, ModelOptions};

use self::promised::{Does, Promised};
use super::bus::{Asked, Parts, Seen, WorldBus};
use super::clients::{Servers, answers, write_frame};
use super::history::History;
use super::rig::line;
use super::scenario::{Habit, Line};

/// Seeds of every test run.
const FIXED: u64 = 240;
/// Longest interval at which a running thread shows that it runs.
const BEAT: Duration = Duration::from_millis(100);
/// Interval in which the motors are checked.
const LOOK: Duration = Duration::from_millis(50);
/// Longest time of a request with its reply on the slowest wire.
const ON_THE_WIRE: Duration = Duration::from_millis(250);
/// Time in which everything is well again.
const HEALED: Duration = Duration::from_secs(20);

/// A connection of a client, as the operating system keeps it.
struct Connection {
    /// Number that identifies the connection.
    number: usize,
    offline: Loopback,
    /// Whether the gateway has accepted the connection.
    open: bool,
    /// Unread bytes, each with the order whose first or last byte is among them.
    inbox: VecDeque<(Instant, Vec<u8>, Option<usize>)>,
    /// When the client closed the connection.
    closed: Option<Instant>,
    /// The rest of a request that the client sends later.
    rest: Option<(Instant, Vec<u8>, usize)>,
    transactions: Vec<(u16, usize)>,
    next: Instant,
}

/// Which threads are stalled, and until when.
#[derive(Debug, Clone, Copy, Default)]
struct Standing {
    readers: Option<Instant>,
    bus: Option<Instant>,
}

struct World {
    seed: u64,
    dice: Random,
    began: Instant,
    now: Instant,
    /// Whether there is one client and only hiccups occur: then no order may be lost.
    healthy: bool,
    bus: WorldBus,
    plant: SharedPlant,
    servers: Servers,
    beat: Heartbeat,
    next_tick: Instant,
    bus_ran: Instant,
    connections: Vec<Connection>,
    /// Number of connections opened so far.
    clients: usize,
    /// Number of the last transaction.
    number: u16,
    placed: Vec<Placed>,
    standing: Standing,
    next_stall: Instant,
    /// Length of the last stall.
    stalled_for: Duration,
    next_incident: Instant,
    reloads: bool,
    wants_reload: bool,
    unused_names: UnusedNames,
    promised: Promised,
    history: History,
    calm: bool,
    own: own_timeouts::Own,
    resets: resets::Resets,
}

fn families() -> Vec<String> {
    let built_in = Profiles::built_in();
    let can = |profile: &&Arc<drivegate_model::drive::Profile>| {
        profile.protocols.contains(&Protocol::ModbusRtu)
            && profile.run_place().is_some()
            && ModelOptions::of_profile(profile).is_some()
    };
    built_in
        .iter()
        .filter(can)
        .map(|profile| profile.name.clone())
        .collect()
}

impl World {
    fn new(seed: u64) -> World {
        let mut dice = Random::new(seed);
        let all = families();
        let family = all[seed as usize % all.len()].clone().leak();
        // Each family with and without a timeout of its own.
        let repeats = Profiles::built_in()
            .get(family)
            .is_some_and(|profile| profile.repeats().is_ok());
        let trips = (seed as usize / all.len()).is_multiple_of(2) && repeats;
        let own_timeout = trips.then_some(Duration::from_millis(2_500));
        let drives = if dice.chance(0.6) { 2 } else { dice.within(1..=3) as u8 };
        let baud = [9_600, 19_200, 38_400, 115_200][dice.within(0..=3) as usize];
        let line = Line {
            supervision: own_timeout.map(|timeout| Supervision {
                timeout: 2 * timeout,
                action: LeaseAction::Stop,
                adopt: false,
            }),
            refresh: own_timeout.map(|timeout| timeout / 5),
            own_timeout,
            spec: |spec| {
                spec.frequency_range = spec
                    .profile
                    .point_index("maximum_frequency")
                    .is_none()
                    .then_some(0.0..=60.0)
            },
            // A cycle that leaves room on the line, so that slow polls come in time, too.
            cycle: Duration::from_millis(200),
            ..line(family, Protocol::ModbusRtu, baud, drives)
        };
        let now = Instant::now();
        let (events, command_log) = (Events::default(), Arc::new(CommandLog::default()));
        let bus = WorldBus::new(0, &line, Parts::of(0, &line, seed), &events, &command_log, now);
        let beat = events.pauses().reader(now);
        let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(Plant {
            gateway: "world".to_string(),
            stale_after: Duration::from_secs(1),
            buses: vec![bus.handle.clone()],
            events,
            command_log,
        }));
        let healthy = dice.chance(0.25);
        let mut world = World {
            seed,
            healthy,
            began: now,
            now,
            servers: Servers::new(plant.clone()),
            plant,
            beat,
            next_tick: now,
            bus_ran: now,
            connections: Vec::new(),
            clients: 0,
            number: 0,
            placed: Vec::new(),
            standing: Standing::default(),
            next_stall: now + Duration::from_secs(3),
            stalled_for: Duration::ZERO,
            next_incident: now + Duration::from_secs(4),
            reloads: !healthy && dice.chance(0.5),
            wants_reload: false,
            unused_names: UnusedNames::default(),
            promised: Promised::new(drives),
            history: History::default(),
            calm: false,
            own: own_timeouts::Own::new(drives),
            resets: resets::Resets::default(),
            bus,
            dice,
        };
        let clients = if healthy { 1 } else { world.dice.within(1..=3) };
        (0..clients).for_each(|_| world.connect());
        world
    }

    /// Runs the world to its end; the plant must then be freed.
    fn run(mut self) {
        let plant = Arc::downgrade(&self.plant);
        if let Err(cause) = catch_unwind(AssertUnwindSafe(|| self.live())) {
            println!("{:#?}", self.bus.line.family);
            println!("{}", self.history.take());
            println!(
                "FAILED: seed {} at {:?} (STALLS_SEED={})",
                self.seed,
                self.now - self.began,
                self.seed
            );
            resume_unwind(cause)
        }
        let seed = self.seed;
        drop(self);
        assert!(
            plant.upgrade().is_none(),
            "seed {seed}: something keeps the plant in memory"
        );
    }

    fn live(&mut self) {
        let end = self.began + Duration::from_millis(self.dice.within(20_000..=60_000));
        while self.now < end {
            self.step();
        }
        self.fall_silent();
        self.heal();
    }

    /// Checks that after the last fault stops are carried out and all values are good.
    fn heal(&mut self) {
        self.calm = true;
        let quiet = self
            .standing
            .readers
            .max(self.standing.bus)
            .unwrap_or(self.now)
            .max(self.now);
        self.run_until(quiet + Duration::from_secs(2));
        self.connect();
        let last = self.connections.len() - 1;
        let stops: Vec<usize> = (1..=self.bus.line.drives)
            .map(|unit| self.write(last, unit, 0x8100, 0, false))
            .collect();
        self.run_until(self.now + HEALED);
        for id in stops {
            let answer = self.promised.orders[id].answer;
            assert!(
                matches!(answer, Some((_, None))),
                "the stop {id} behind it all is answered {answer:?}"
            );
        }
        let plant = self.plant.load();
        for drive in plant.drives() {
            let reading = drive.reading(self.now);
            let running = reading.model(ModelPoint::Running);
            assert_eq!(
                running.good(),
                Some(Value::Bool(false)),
                "{}: {running:?}",
                drive.image.spec.name
            );
        }
    }

    fn run_until(&mut self, until: Instant) {
        while self.now < until {
            self.step();
        }
    }

    fn note(&mut self, words: impl FnOnce() -> String + 'static) {
        self.history.note(self.now - self.began, words);
    }

    fn chance(&mut self, share: f64) -> bool {
        self.dice.chance(share)
    }

    fn ms(&mut self, range: std::ops::RangeInclusive<u64>) -> Duration {
        Duration::from_millis(self.dice.within(range))
    }

    /// Runs the next event.
    fn step(&mut self) {
        self.now = self.now.max(self.next());
        let now = self.now;
        for standing in [&mut self.standing.readers, &mut self.standing.bus] {
            *standing = standing.filter(|until| *until > now);
        }
        let mut seen = Vec::new();
        self.bus.wire_runs(now, &mut seen);
        for what in seen {
            self.check_line(&what);
        }
        // After a pause of both threads either may run first.
        let bus_first = self.chance(0.5);
        if bus_first {
            self.run_bus();
        }
        self.run_readers();
        self.run_bus();
        self.check_motors();
        self.own_timeouts();
        self.incidents();
        for index in 0..self.connections.len() {
            self.act(index);
        }
    }

    fn next(&self) -> Instant {
        let bus = self
            .bus
            .wake_at()
            .min(self.bus_ran + BEAT)
            .max(self.standing.bus.unwrap_or(self.now));
        let inbox = self
            .connections
            .iter()
            .filter_map(|connection| connection.inbox.front().map(|(at, ..)| *at));
        let reads = inbox
            .chain([self.next_tick])
            .min()
            .unwrap_or(self.now)
            .max(self.standing.readers.unwrap_or(self.now));
        let acts = |connection: &&Connection| connection.open && connection.closed.is_none() && !self.calm;
        let clients = self.connections.iter().filter(acts).map(|connection| connection.next);
        let rests = self
            .connections
            .iter()
            .filter_map(|connection| connection.rest.as_ref().map(|(at, ..)| *at));
        // Bytes that have already arrived wait for the bus.
        let wire = self.bus.wire_wakes().filter(|at| *at > self.now);
        clients
            .chain(rests)
            .chain(wire)
            .chain([bus, reads, self.next_stall, self.next_incident, self.now + LOOK])
            .min()
            .unwrap_or(bus)
    }

    /// Runs the thread of the bus, if it is not stalled.
    fn run_bus(&mut self) {
        let now = self.now;
        if self.standing.bus.is_some() || self.bus.wake_at().min(self.bus_ran + BEAT) > now {
            return;
        }
        self.bus_ran = now;
        let (mut seen, mut stands) = (Vec::new(), false);
        let stood = self.bus.core.note_run(now, Duration::ZERO);
        self.bus.deliver(now, stood, &mut seen);
        while self.bus.open {
            match self.bus.core.poll(now) {
                // The thread may pause just before it sends.
                Action::Send if !self.calm && !self.healthy && self.dice.chance(0.000_5) => {
                    stands = true;
                    break;
                }
                Action::Send => self.bus.send(now, &mut seen),
                Action::Wait { until, commands, .. } => {
                    assert!(until > now, "idle until a time that is past");
                    self.bus.waits(until, commands, &mut seen);
                    break;
                }
            }
        }
        if stands {
            let time = self.ms(100..=4_000);
            self.standing.bus = Some(now + time);
            self.note(move || format!("the bus stands still for {time:?} before it sends"));
        }
        for what in seen {
            self.check_line(&what);
        }
    }

    fn check_line(&mut self, seen: &Seen) {
        let (now, began) = (self.now, self.began);
        match seen {
            Seen::Sent(asked) if !asked.is_poll => {
                let (drive, pdu) = (asked.drive, asked.pdu.clone());
                self.note(move || format!("sent to place {drive}: {pdu:?}"));
            }
            Seen::Acted(asked) => self.check_acted(asked),
            Seen::Over(asked) if asked.is_poll => {
                let image = self
                    .bus
                    .handle
                    .image
                    .drives
                    .get(drivegate_model::drive::DriveIndex::new(asked.drive));
                let read = image
                    .zip(first_word(asked))
                    .and_then(|(image, (table, at))| image.snapshot().read_at(table, at));
                if let Some(read) = read.filter(|read| asked.last_read != Some(*read)) {
                    let latest = asked.at + self.bus.line.response_timeout + ON_THE_WIRE;
                    assert!(
                        read <= now.min(latest),
                        "a value is dated {:?}, and was asked for at {:?}; it is {:?} now",
                        read - began,
                        asked.at - began,
                        now - began
                    );
                }
            }
            _ => {}
        }
    }

    /// A drive has carried a request out.
    fn check_acted(&mut self, asked: &Asked) {
        if !asked.pdu.is_write() {
            return;
        }
        self.own.wrote(&self.bus.profile, asked.acted, &asked.pdu, self.now);
        self.resets.check(&self.bus.profile, asked.acted, &asked.pdu);
        self.promised.told(asked.acted, asked.at);
    }

    /// Checks that no motor starts by itself.
    fn check_motors(&mut self) {
        let (now, sim) = (self.now, self.bus.sim(self.now));
        for machine in 1..=self.bus.line.drives {
            let drive = self.bus.wire.slaves().drive(machine).unwrap();
            drive.advance(sim);
            let running = drive.state().running;
            if self.promised.runs(machine, running, now) {
                self.note(move || {
                    format!(
                        "the motor of drive {machine} {}",
                        if running { "starts" } else { "stands" }
                    )
                });
                let control = self.bus.profile.control.as_ref();
                let hides_word = control.is_some_and(|control| !control.is_read());
                self.promised.must_want_start(machine, hides_word, now);
            }
        }
    }

    /// Runs the thread that reads the connections, if it is not stalled.
    fn run_readers(&mut self) {
        let now = self.now;
        if self.standing.readers.is_some() {
            return;
        }
        let ticks_first = self.chance(0.5);
        if ticks_first {
            self.tick();
        }
        for index in 0..self.connections.len() {
            self.read(index);
        }
        self.tick();
        for index in 0..self.connections.len() {
            let connection = &mut self.connections[index];
            connection.open = true;
            let answered = connection.offline.receive(&[], now);
            self.answered(index, &answered);
        }
        self.connections.retain(|connection| {
            connection
                .closed
                .is_none_or(|closed| closed + Duration::from_secs(5) > now)
        });
        self.placed.retain_mut(|placed| placed.answer().is_none());
    }

    fn tick(&mut self) {
        if self.next_tick <= self.now {
            self.next_tick = self.now + TICK;
            self.beat.note_run(self.now);
            self.servers.watch().runs(self.now);
        }
    }

    /// Reads bytes that a client has sent.
    fn read(&mut self, index: usize) {
        let now = self.now;
        let connection = &mut self.connections[index];
        let is_there = connection.inbox.front().is_some_and(|(at, ..)| *at <= now);
        if !is_there {
            return;
        }
        let mut bytes = Vec::new();
        for (_, of, order) in connection.inbox.drain(..) {
            bytes.extend(of);
            if let Some(id) = order {
                self.promised.read(id, now);
            }
        }
        let answered = match connection.closed {
            Some(_) => connection.offline.receive_last(&bytes, now),
            None => connection.offline.receive(&bytes, now),
        };
        self.bus.command_came(now);
        self.answered(index, &answered);
    }

    fn answered(&mut self, index: usize, bytes: &[u8]) {
        for (transaction, exception) in answers(bytes) {
            let open = &mut self.connections[index].transactions;
            let place = open
                .iter()
                .position(|(number, _)| *number == transaction)
                .expect("an answer to a request");
            let (_, id) = open.remove(place);
            self.note(move || format!("order {id} is answered {exception:02X?}"));
            self.promised.answered(id, self.now, exception);
            let order = &self.promised.orders[id];
            // A slow line has no recent frequency range; this has nothing to do with stalls.
            let not_known = order.does == Does::Other && exception == Some(2);
            assert!(
                !self.healthy || exception.is_none() || not_known,
                "order {id} of a healthy client was lost in a hiccup: {exception:02X?}, {order:?}"
            );
        }
    }
}

/// The table and the address of the first word of a read.
fn first_word(asked: &Asked) -> Option<(drivegate_proto::Table, u16)> {
    match asked.pdu {
        drivegate_proto::RequestPdu::Read { table, start, .. } => Some((table, start)),
        _ => None,
    }
}

#[test]
fn no_motor_starts_that_nobody_wants_to_run() {
    let seeds = match super::number("STALLS_SEED") {
        Some(seed) => seed..seed + 1,
        None => {
            let first = super::number("STALLS_FROM").unwrap_or(0);
            first..first + super::number("STALLS_SEEDS").unwrap_or(FIXED)
        }
    };
    for seed in seeds {
        World::new(seed).run();
    }
}
