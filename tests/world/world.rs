//! The world: its clock, which actor is next, and the checks of each step.

mod acts;
mod answers;
mod end;
mod heal;
mod incidents;
mod lines;
mod look;
mod own_timeouts;
mod readers;
mod refreshes;

use std::collections::BTreeMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate_core::event::{EventKind, Events};
use drivegate_core::order::{Authority, CAPACITY, CommandLog, Order, Origin, Outcome, SourceKind, written};
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_core::process_image::{LeaseAction, OnShutdown};
use drivegate_model::drive::{ModelPoint, Quality, RawWrites, Value};
use drivegate_mqtt::Incoming;
use drivegate_proto::{Protocol, Reply, RequestPdu};
use drivegate_sim::random::Random;
use tokio::sync::broadcast;
use tokio::sync::oneshot;

use super::bus::{Asked, NO_DRIVE, Parts, Seen, WorldBus};
use super::clients::{Client, Servers, Waiting, Way, address, answers, write_frame};
use super::drives::{AFTERMATH, Truth};
use super::history::History;
use super::orders::{
    Record, Unique, Wish, converted, is_of_writable_point, order_of, percent_reference, run_command, sets,
};
use super::scenario::{Habit, Scenario};

/// Time after its expiry within which an order is answered: its last transaction, a pulse, a late reply.
const LAST_STEPS: Duration = Duration::from_secs(6);
/// Time limit of a stop, counted from its turn.
const STOP_TIME: Duration = Duration::from_secs(2);
/// Time between the expiry of a lease and its action: a round, and a transaction of another drive.
const ACTION: Duration = Duration::from_millis(1_500);
/// Longest pause between two requests to a drive that does not answer, with the transactions before them.
const PROBED: Duration = Duration::from_millis(11_000);
/// Longest pause between two tries of an action that is not acknowledged: ten times what one took, and a second.
const REPEATED: Duration = Duration::from_secs(8);
/// Interval of the checks of what must hold at any time.
const LOOK: Duration = Duration::from_millis(50);

/// Figures that a world reports at its end.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Figures {
    pub worlds: u64,
    pub bus_time: Duration,
    pub exchanges: u64,
    pub orders: u64,
    pub confirmed: u64,
    pub supervised: u64,
    pub refreshed: u64,
    pub timed_out: u64,
}

impl Figures {
    pub fn add(&mut self, other: &Figures) {
        self.worlds += other.worlds;
        self.bus_time += other.bus_time;
        self.exchanges += other.exchanges;
        self.orders += other.orders;
        self.confirmed += other.confirmed;
        self.supervised += other.supervised;
        self.refreshed += other.refreshed;
        self.timed_out += other.timed_out;
    }
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hours = self.bus_time.as_secs_f64() / 3600.0;
        write!(
            f,
            "{} worlds, {hours:.2} bus-hours, {} exchanges, {} orders, {} confirmed, {} leases ran out, {} refreshes, {} own timeouts",
            self.worlds, self.exchanges, self.orders, self.confirmed, self.supervised, self.refreshed, self.timed_out
        )
    }
}

pub struct World {
    scenario: Scenario,
    dice: Random,
    began: Instant,
    now: Instant,
    plant: SharedPlant,
    events: Events,
    heard_events: broadcast::Receiver<Arc<drivegate_core::event::Event>>,
    command_log: Arc<CommandLog>,
    buses: Vec<WorldBus>,
    truths: Vec<Vec<Truth>>,
    clients: Vec<Client>,
    records: Vec<Record>,
    /// Results that may still arrive for messages that a broker delivered again, by order.
    repeats: BTreeMap<usize, u32>,
    /// Orders without an answer, by bus and drive.
    open: BTreeMap<(usize, usize), Vec<usize>>,
    next_incident: Option<Instant>,
    next_reload: Option<Instant>,
    /// A bus that is restarted when its transaction has ended.
    restarts: Option<usize>,
    next_look: Instant,
    /// Times that a client has read a drive by HTTP.
    readings: usize,
    /// Time until which the port of each bus is away.
    away: Vec<Option<Instant>>,
    /// Bus, address and time of drives that are off until then.
    off: Vec<(usize, u8, Instant)>,
    history: History,
    /// Writes that were answered when answers were last looked for.
    answered: u64,
    figures: Figures,
    stopping: bool,
    /// Set once the faults are over.
    healing: Option<heal::Healing>,
}

impl World {
    pub fn new(scenario: Scenario) -> World {
        let now = Instant::now();
        let (events, command_log) = (Events::default(), Arc::new(CommandLog::default()));
        let buses: Vec<WorldBus> = scenario
            .buses
            .iter()
            .enumerate()
            .map(|(index, line)| {
                let parts = Parts::of(index, line, scenario.seed);
                WorldBus::new(index, line, parts, &events, &command_log, now)
            })
            .collect();
        let truth = |bus: &mut WorldBus, address: u8| {
            let maximum = bus.maximum_frequency(address, None, now);
            Truth::new(maximum.map(|hertz| (now, hertz)))
        };
        let mut buses = buses;
        let truths = buses
            .iter_mut()
            .map(|bus| (1..=bus.line.drives).map(|address| truth(bus, address)).collect());
        let truths: Vec<Vec<Truth>> = truths.collect();
        let plant = plant_of(&buses, &events, &command_log);
        let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
        let servers = Servers::new(plant.clone());
        let clients = scenario.clients.iter().enumerate();
        let clients = clients
            .map(|(index, habit)| servers.client(index, *habit, now))
            .collect();
        World {
            dice: Random::new(scenario.seed ^ 0x5EED),
            began: now,
            now,
            heard_events: events.subscribe(),
            plant,
            events,
            command_log,
            truths,
            away: vec![None; buses.len()],
            next_incident: scenario.incidents.map(|mean| now + mean + Duration::from_secs(2)),
            next_reload: scenario.reloads.then(|| now + Duration::from_secs(6)),
            restarts: None,
            next_look: now,
            readings: 0,
            buses,
            clients,
            records: Vec::new(),
            repeats: BTreeMap::new(),
            open: BTreeMap::new(),
            off: Vec::new(),
            history: History::default(),
            answered: 0,
            figures: Figures::default(),
            stopping: false,
            healing: None,
            scenario,
        }
    }

    /// The whole life of the gateway; panics with the seed and the end of the history when a check fails.
    pub fn run(mut self) -> Figures {
        let seed = self.scenario.seed;
        match catch_unwind(AssertUnwindSafe(|| self.live())) {
            Ok(figures) => figures,
            Err(cause) => {
                println!("{:#?}", self.scenario);
                println!("{}", self.history.take());
                println!(
                    "FAILED: seed {seed} at {:?} (WORLD_SEED={seed} make world)",
                    self.now - self.began
                );
                resume_unwind(cause)
            }
        }
    }

    fn live(&mut self) -> Figures {
        let end = self.began + self.scenario.time;
        while self.now < end {
            self.step();
        }
        self.heal();
        self.try_own_timeouts();
        self.stop();
        self.figures.worlds = 1;
        self.figures.bus_time = (self.now - self.began) * self.buses.len() as u32;
        self.figures.exchanges = self.buses.iter().map(|bus| bus.exchanges).sum();
        self.figures.orders = self.records.len() as u64;
        self.figures
    }

    fn note(&mut self, words: impl FnOnce() -> String + 'static) {
        self.history.note(self.now - self.began, words);
    }

    /// Whether no client gives orders any more.
    fn is_calm(&self) -> bool {
        self.stopping || self.healing.is_some()
    }

    /// Runs the next event anywhere in the world.
    fn step(&mut self) {
        let wakes: Vec<Instant> = self.buses.iter().map(WorldBus::wake_at).collect();
        let clients = self
            .clients
            .iter()
            .filter(|_| !self.is_calm())
            .map(|client| client.next);
        let others = [self.next_incident, self.next_reload, Some(self.next_look)];
        let off = self.off.iter().map(|(_, _, until)| *until);
        let others = others.into_iter().chain(self.away.iter().copied()).flatten();
        let buses = wakes.iter().copied();
        let next = buses.chain(clients).chain(others).chain(off).min().unwrap();
        assert!(next >= self.now.min(next), "time runs backwards");
        self.now = self.now.max(next);
        for (index, wake) in wakes.into_iter().enumerate() {
            if wake <= self.now {
                self.step_bus(index);
            }
        }
        self.collect_news();
        if !self.is_calm() {
            for index in 0..self.clients.len() {
                if self.clients[index].next <= self.now {
                    self.act(index);
                }
            }
        }
        self.incidents();
        if self.next_look <= self.now {
            self.next_look = self.now + LOOK;
            self.look();
        }
    }
}

fn plant_of(buses: &[WorldBus], events: &Events, command_log: &Arc<CommandLog>) -> Plant {
    Plant {
        gateway: "world".to_string(),
        stale_after: Duration::from_secs(1),
        buses: buses.iter().map(|bus| bus.handle.clone()).collect(),
        events: events.clone(),
        command_log: command_log.clone(),
    }
}
