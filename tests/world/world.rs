//! The world: its clock, who acts next, and what is checked at each step.

use std::collections::BTreeMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate::cache::LeaseAction;
use drivegate::codec::{Reply, RequestPdu};
use drivegate::command::{Authority, CAPACITY, Order, Origin, Outcome, SourceKind, WriteStats};
use drivegate::drive::{ModelPoint, Quality, Value};
use drivegate::event::{EventKind, Events};
use drivegate::north::mqtt::Incoming;
use drivegate::plant::{Plant, SharedPlant};
use drivegate::sim::random::Random;
use tokio::sync::broadcast;
use tokio::sync::oneshot;

use super::bus::{Asked, Parts, Seen, WorldBus};
use super::clients::{Client, Servers, Way, answers, write_frame};
use super::drives::{AFTERMATH, Truth};
use super::history::History;
use super::orders::{Record, Wish, order_of, run_command, sets};
use super::scenario::{Habit, Scenario};

/// Time in which an order is answered behind its expiry: its last exchange, a pulse, a late reply.
const LAST_STEPS: Duration = Duration::from_secs(6);
/// Time between a lease that ran out and its action: a round, and an exchange of another drive.
const ACTION: Duration = Duration::from_millis(1_500);
/// How often what must hold at any time is looked at.
const LOOK: Duration = Duration::from_millis(50);

/// What a world was.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Figures {
    pub worlds: u64,
    pub bus_time: Duration,
    pub exchanges: u64,
    pub orders: u64,
    pub confirmed: u64,
    pub supervised: u64,
}

impl Figures {
    pub fn add(&mut self, other: &Figures) {
        self.worlds += other.worlds;
        self.bus_time += other.bus_time;
        self.exchanges += other.exchanges;
        self.orders += other.orders;
        self.confirmed += other.confirmed;
        self.supervised += other.supervised;
    }
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hours = self.bus_time.as_secs_f64() / 3600.0;
        write!(
            f,
            "{} worlds, {hours:.2} bus-hours, {} exchanges, {} orders, {} confirmed, {} leases ran out",
            self.worlds, self.exchanges, self.orders, self.confirmed, self.supervised
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
    heard_events: broadcast::Receiver<Arc<drivegate::event::Event>>,
    writes: Arc<WriteStats>,
    buses: Vec<WorldBus>,
    truths: Vec<Vec<Truth>>,
    clients: Vec<Client>,
    records: Vec<Record>,
    /// Orders without an answer, by bus and drive.
    open: BTreeMap<(usize, usize), Vec<usize>>,
    next_incident: Option<Instant>,
    next_reload: Option<Instant>,
    /// A bus that is to be started anew when its exchange is over.
    restarts: Option<usize>,
    next_look: Instant,
    /// Buses whose port is away until then.
    away: Vec<Option<Instant>>,
    /// Drives that are off until then.
    off: Vec<(usize, u8, Instant)>,
    history: History,
    figures: Figures,
    stopping: bool,
}

impl World {
    pub fn new(scenario: Scenario) -> World {
        let now = Instant::now();
        let (events, writes) = (Events::default(), Arc::new(WriteStats::default()));
        let buses: Vec<WorldBus> = scenario
            .buses
            .iter()
            .enumerate()
            .map(|(index, line)| {
                let parts = Parts::of(index, line, scenario.seed);
                WorldBus::new(index, line, parts, &events, &writes, now)
            })
            .collect();
        let plant = plant_of(&buses, &events, &writes);
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
            writes,
            truths: buses
                .iter()
                .map(|bus| (0..bus.line.drives).map(|_| Truth::new()).collect())
                .collect(),
            away: vec![None; buses.len()],
            next_incident: scenario.incidents.map(|mean| now + mean + Duration::from_secs(2)),
            next_reload: scenario.reloads.then(|| now + Duration::from_secs(6)),
            restarts: None,
            next_look: now,
            buses,
            clients,
            records: Vec::new(),
            open: BTreeMap::new(),
            off: Vec::new(),
            history: History::default(),
            figures: Figures::default(),
            stopping: false,
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

    /// The next thing that happens anywhere.
    fn step(&mut self) {
        let buses = self.buses.iter().map(WorldBus::wake_at);
        let clients = self.clients.iter().filter(|_| !self.stopping).map(|client| client.next);
        let others = [self.next_incident, self.next_reload, Some(self.next_look)];
        let off = self.off.iter().map(|(_, _, until)| *until);
        let others = others.into_iter().chain(self.away.iter().copied()).flatten();
        let next = buses.chain(clients).chain(others).chain(off).min().unwrap();
        assert!(next >= self.now.min(next), "time runs backwards");
        self.now = self.now.max(next);
        for index in 0..self.buses.len() {
            if self.buses[index].wake_at() <= self.now {
                self.step_bus(index);
            }
        }
        self.collect();
        if !self.stopping {
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

    // ---- the lines ------------------------------------------------------------------------------------------------

    fn step_bus(&mut self, index: usize) {
        let mut seen = Vec::new();
        self.buses[index].step(self.now, &mut seen);
        for one in seen {
            match one {
                Seen::Sent(asked) => self.sent(index, &asked),
                Seen::Acted(asked) => self.acted(index, &asked),
                Seen::Over(asked) => self.over(index, &asked),
                Seen::Heard(bytes) if self.history.is_long() => {
                    self.note(move || format!("line{index} -> {bytes:02X?}"))
                }
                Seen::Heard(_) => {}
            }
        }
        let line = &self.buses[index].wire;
        let statistics = line.statistics();
        assert_eq!(
            statistics.silence_violations, 0,
            "a request came before the line was silent"
        );
        // Behind a late reply that stood for the present one, that is still to come: nobody can know.
        if !self.buses[index].line.is_late() {
            assert_eq!(statistics.collisions, 0, "a request met a reply");
            assert_eq!(statistics.provoked_overlaps, 0, "a request met noise");
        }
    }

    /// A request is on the wire.
    fn sent(&mut self, bus: usize, asked: &Asked) {
        let (drive, pdu, now) = (asked.drive, &asked.pdu, self.now);
        assert!(
            !asked.is_poll || !self.buses[bus].ending,
            "a poll goes out while the gateway stops"
        );
        if !asked.is_poll || self.history.is_long() {
            let text = pdu.clone();
            self.note(move || format!("line{bus} drive {} <- {text:?}", drive + 1));
        }
        if !pdu.is_write() {
            return;
        }
        let profile = self.buses[bus].profile.clone();
        let open = self.open.get(&(bus, drive)).cloned().unwrap_or_default();
        let client_waits = !open.is_empty();
        let truth = &mut self.truths[bus][drive];
        if let Some(run) = run_command(&profile, pdu) {
            // What was read just before the drive lost its supply is not known to be lost.
            let lost = truth.lost_word.is_some_and(|at| now - at < Duration::from_secs(1));
            if run && !truth.run && !lost {
                let until = truth
                    .may_run
                    .unwrap_or_else(|| panic!("a run went out behind a stop, drive {}", drive + 1));
                assert!(now < until, "an expired run went out");
            }
            if !run && truth.run {
                let ours = |id: &usize| {
                    let wish = self.records[*id].wish;
                    // Where the word cannot be read, a motor that was last seen standing is left standing.
                    wish.is_stop() || matches!(wish, Wish::Reset | Wish::Reverse)
                };
                let recently = truth.last_stop_over.is_some_and(|at| now - at < LAST_STEPS);
                if !open.iter().any(ours) && !recently && !self.stopping {
                    self.supervision_stops(bus, drive);
                }
            }
        }
        let truth = &mut self.truths[bus][drive];
        if client_waits {
            truth.maybe_heard(now);
            let certain = open.iter().any(|id| {
                let unique = self.records[*id].unique.as_ref();
                unique.is_some_and(|unique| sets(pdu, unique))
            });
            if certain {
                truth.heard_for_certain(now);
            }
        }
        self.check_unique(bus, drive, pdu);
    }

    /// A stop goes out that no client asked for: the lease must have run out, and no client be back.
    fn supervision_stops(&mut self, bus: usize, drive: usize) {
        let now = self.now;
        // An order that ended in this step waits no more.
        self.collect();
        let supervision = self.buses[bus].line.supervision.clone();
        let supervision = supervision.unwrap_or_else(|| panic!("a stop that nobody ordered, drive {}", drive + 1));
        assert!(
            supervision.action == LeaseAction::Stop,
            "a stop went out where the action is {:?}",
            supervision.action
        );
        let truth = &self.truths[bus][drive];
        if let Some(heard) = truth.heard.0 {
            assert!(
                now - heard >= supervision.timeout,
                "the action came {:?} after the client",
                now - heard
            );
        } else {
            assert!(
                supervision.adopt || truth.heard.1.is_some(),
                "the action came though nobody was ever heard of"
            );
        }
        for id in self.open.get(&(bus, drive)).into_iter().flatten() {
            let record = &self.records[*id];
            // By MQTT the answer of an order that is done waits for its confirmation.
            let by_mqtt = self.clients[record.client].habit == Habit::Mqtt;
            let waits = record.wish != Wish::RawRead && record.expires > now && !by_mqtt;
            assert!(
                !waits || now - record.accepted < Duration::from_millis(2),
                "the action overrides a client that is back: {record:?}"
            );
        }
    }

    /// Words that only one order writes: what may go out of it, and in which order.
    fn check_unique(&mut self, bus: usize, drive: usize, pdu: &RequestPdu) {
        let now = self.now;
        let mine = |record: &Record| {
            record.bus == bus && record.drive == drive && record.unique.as_ref().is_some_and(|unique| sets(pdu, unique))
        };
        // The last order with these words: they come again after some thousands.
        let Some(id) = self.records.iter().rposition(mine) else {
            return;
        };
        let record = &mut self.records[id];
        if let Some((code, at)) = &record.answer {
            panic!(
                "order {id} was answered {code} {:?} ago, and goes out: {record:?}",
                now - *at
            );
        }
        assert!(now < record.expires, "an expired order goes out: {record:?}");
        let first = record.sent.is_none();
        record.sent.get_or_insert(now);
        if first && !record.wish.is_stop() {
            let (place, truth) = (record.place, &mut self.truths[bus][drive]);
            assert!(
                place > truth.last_place,
                "order {id} of place {place} goes out behind place {}",
                truth.last_place
            );
            truth.last_place = place;
        }
    }

    /// A drive acted upon a request.
    fn acted(&mut self, bus: usize, asked: &Asked) {
        let profile = self.buses[bus].profile.clone();
        let refused = matches!(asked.reply, Some(Reply::Exception(_)));
        let words = asked.reply.as_ref().and_then(Reply::words);
        let truth = &mut self.truths[bus][asked.drive];
        if refused {
            return;
        }
        if let Some(run) = run_command(&profile, &asked.pdu) {
            truth.run = run;
        }
        truth.act(self.now, asked.pdu.clone(), words);
    }

    /// An exchange is over: what the image has of it now is what the drive answered to it.
    fn over(&mut self, bus: usize, asked: &Asked) {
        let (Some(RequestPdu::Read { table, start, count }), true) = (Some(asked.pdu.clone()), asked.is_poll) else {
            return;
        };
        let image = &self.buses[bus].handle.image.drives[asked.drive];
        let snapshot = image.snapshot();
        let Some(at) = snapshot.read_at(table, start) else {
            return;
        };
        let untouched = asked.last_read == Some(at);
        if untouched {
            return;
        }
        let stored: Vec<u16> = (0..count)
            .map(|i| snapshot.word(table, start + i).unwrap_or(0))
            .collect();
        // Simulated late replies may overtake each other, which those of a drive do not.
        let slack = if self.buses[bus].line.is_late() {
            Duration::from_secs(1)
        } else {
            Duration::ZERO
        };
        let from = at.min(asked.at).checked_sub(slack).unwrap_or(at);
        let truth = &self.truths[bus][asked.drive];
        // The drive may have said it in answer to an earlier try; the image dates it back then.
        let said = |did: &RequestPdu, words: Option<&Vec<u16>>| *did == asked.pdu && words == Some(&stored);
        assert!(
            truth.did(from, said),
            "drive {} at {table} {start}: it did not say {stored:?} in the last {:?}",
            asked.drive + 1,
            self.now - at
        );
    }

    // ---- the clients ----------------------------------------------------------------------------------------------

    fn act(&mut self, index: usize) {
        let now = self.now;
        let habit = self.clients[index].habit;
        let ms = Duration::from_millis;
        let pause = match habit {
            Habit::StopsInALoop => ms(1),
            Habit::Floods => ms(5),
            Habit::Steady => ms(500),
            _ if self.dice.chance(0.3) => Duration::ZERO,
            _ => ms(self.dice.within(1..=700)),
        };
        self.clients[index].next = now + pause;
        if now < self.clients[index].silent_until {
            return;
        }
        let falls_silent = match habit {
            // It comes back so often that it would be silent most of the time.
            Habit::StopsInALoop => 0.000_3,
            Habit::Floods if self.scenario.floods => 0.000_3,
            _ => 0.01,
        };
        if habit != Habit::Steady && self.dice.chance(falls_silent) {
            self.clients[index].silent_until = now + ms(self.dice.within(500..=6_000));
        }
        if pause.is_zero() && self.clients[index].open > 24 {
            self.clients[index].next = now + ms(20);
            return;
        }
        let (bus, drive) = match habit {
            Habit::StopsInALoop | Habit::Floods => (0, index % usize::from(self.buses[0].line.drives)),
            Habit::Steady => {
                let bus = self.buses.len() - 1;
                (bus, usize::from(self.buses[bus].line.drives) - 1)
            }
            _ => {
                let bus = self.dice.within(0..=self.buses.len() as u64 - 1) as usize;
                (
                    bus,
                    self.dice.within(0..=u64::from(self.buses[bus].line.drives) - 1) as usize,
                )
            }
        };
        match habit {
            Habit::Mqtt => self.by_mqtt(index, bus, drive),
            Habit::ModbusTcp => self.by_modbus_tcp(index, bus, drive),
            Habit::StopsInALoop => {
                if self.clients[index].open == 0 {
                    self.write_word(index, bus, drive, 0x8100, 0, Wish::Stop);
                }
            }
            Habit::Steady => self.plain(index, bus, drive, Wish::Reference, ms(2_000)),
            Habit::Floods if self.clients[index].open > 200 => {}
            Habit::Floods => {
                let wish = Wish::of(&mut self.dice);
                self.plain(index, bus, drive, wish, ms(2_000));
            }
            Habit::Plain => {
                let wish = Wish::of(&mut self.dice);
                let expiry = [ms(2_000), ms(2_000), ms(400), ms(60)][self.dice.within(0..=3) as usize];
                self.plain(index, bus, drive, wish, expiry);
                if self.dice.chance(0.1) {
                    self.heartbeat(bus, drive);
                }
            }
        }
    }

    fn heartbeat(&mut self, bus: usize, drive: usize) {
        if self.buses[bus].line.supervision.is_some() {
            self.buses[bus].handle.image.drives[drive].renew_lease(self.now);
            self.truths[bus][drive].heard_for_certain(self.now);
            self.buses[bus].command_came(self.now);
            self.note(move || format!("heartbeat for line{bus} drive {}", drive + 1));
        }
    }

    /// Takes note of an order that is given now; its number.
    fn record(&mut self, client: usize, bus: usize, drive: usize, wish: Wish, expiry: Duration) -> usize {
        let now = self.now;
        let id = self.records.len();
        let before = self.open.get(&(bus, drive)).map_or(0, Vec::len);
        self.records.push(Record {
            client,
            bus,
            drive,
            wish,
            accepted: now,
            expires: now + expiry,
            unique: None,
            place: id + 1,
            sent: None,
            answer: None,
            read: None,
            before,
            succeeded: false,
        });
        self.note(move || format!("order {id} of client {client}: line{bus} drive {} {wish:?}", drive + 1));
        id
    }

    /// The order is in the queue, or was answered at once.
    fn accepted(&mut self, id: usize, unique: Option<super::orders::Unique>) {
        self.records[id].unique = unique;
        let Record {
            bus,
            drive,
            wish,
            expires,
            ..
        } = self.records[id];
        if self.records[id].answer.is_none() {
            let truth = &mut self.truths[bus][drive];
            if wish.is_stop() {
                truth.may_run = None;
            } else if wish.is_run() {
                truth.may_run = truth.may_run.max(Some(expires));
            }
            self.open.entry((bus, drive)).or_default().push(id);
        }
        self.buses[bus].command_came(self.now);
    }

    fn plain(&mut self, client: usize, bus: usize, drive: usize, wish: Wish, expiry: Duration) {
        let profile = self.buses[bus].profile.clone();
        let Some((order, unique)) = order_of(&profile, wish, self.records.len()) else {
            return;
        };
        let id = self.record(client, bus, drive, wish, expiry);
        if let Order::Read(pdu) = &order {
            self.records[id].read = Some((pdu.clone(), None));
        }
        let name = self.buses[bus].handle.image.drives[drive].spec.name.clone();
        let handle = self.plant.load().drive(&name).unwrap();
        let origin = Origin::new(SourceKind::CommandLine, format!("client {client}"));
        let mut placed = handle.place(order, origin, Authority::Write, expiry, self.now);
        self.replaced();
        if let Some(answer) = placed.answer() {
            self.answered(id, answer.outcome.code(), Some(&answer.outcome));
        }
        self.accepted(id, unique);
        if let Way::Plain(waiting) = &mut self.clients[client].way {
            waiting.push((id, placed));
        }
        self.clients[client].open += usize::from(self.records[id].answer.is_none());
    }

    fn by_mqtt(&mut self, client: usize, bus: usize, drive: usize) {
        for _ in 0..=self.dice.within(0..=1) {
            let wish = loop {
                let wish = Wish::of(&mut self.dice);
                if !matches!(wish, Wish::RawRead | Wish::RawRun | Wish::RawStop | Wish::RawBlock(_)) {
                    break wish;
                }
            };
            let profile = self.buses[bus].profile.clone();
            let Some((Order::Points(points), unique)) = order_of(&profile, wish, self.records.len()) else {
                continue;
            };
            let id = self.record(client, bus, drive, wish, Duration::from_secs(2));
            let field = |(index, value): &(usize, Value)| format!("\"{}\": {value}", profile.points[*index].name);
            let fields: Vec<String> = points.iter().map(field).collect();
            let name = self.buses[bus].handle.image.drives[drive].spec.name.clone();
            let message = Incoming {
                topic: format!("b/world/drive/{name}/set"),
                payload: format!("{{\"id\": {id}, {}}}", fields.join(", ")).into_bytes(),
                packet: id as u16,
                ..Incoming::default()
            };
            let now = self.now;
            if let Way::Mqtt(offline) = &mut self.clients[client].way {
                offline.receive(message, now);
            }
            self.clients[client].open += 1;
            self.replaced();
            self.collect_client(client);
            self.accepted(id, unique);
        }
    }

    fn by_modbus_tcp(&mut self, client: usize, bus: usize, drive: usize) {
        match self.dice.within(0..=5) {
            0 => self.write_word(client, bus, drive, 0x8100, 1, Wish::Run),
            1 | 2 => self.write_word(client, bus, drive, 0x8100, 0, Wish::Stop),
            3 => {
                self.write_word(client, bus, drive, 0x8100, 1, Wish::Run);
                self.write_word(client, bus, drive, 0x8100, 0, Wish::Stop);
            }
            _ => self.heartbeat(bus, drive),
        }
    }

    fn write_word(&mut self, client: usize, bus: usize, drive: usize, address: u16, value: u16, wish: Wish) {
        let id = self.record(client, bus, drive, wish, Duration::from_secs(2));
        let unit = self.buses[bus].handle.image.drives[drive].spec.unit;
        let now = self.now;
        let mut bytes = Vec::new();
        if let Way::ModbusTcp(offline, open, transaction) = &mut self.clients[client].way {
            *transaction = transaction.wrapping_add(1);
            open.insert(*transaction, id);
            bytes = offline.receive(&write_frame(*transaction, unit, address, value), now);
        }
        self.clients[client].open += 1;
        self.replaced();
        self.take_answers(client, &bytes);
        self.accepted(id, None);
    }

    // ---- the answers ----------------------------------------------------------------------------------------------

    fn collect(&mut self) {
        for client in 0..self.clients.len() {
            self.collect_client(client);
        }
    }

    /// Answers of orders that a newer one replaced come before the newer one is taken note of: it takes their place.
    fn replaced(&mut self) {
        self.collect();
        let Some((newest, before)) = self.records.split_last_mut() else {
            return;
        };
        let now = self.now;
        let of_drive = |record: &&mut Record| (record.bus, record.drive) == (newest.bus, newest.drive);
        let just_replaced = |record: &&mut Record| {
            let answer = record.answer.as_ref();
            !record.succeeded
                && record.wish == Wish::Reference
                && answer.is_some_and(|(code, at)| code == "replaced" && *at == now)
        };
        let recent = before.iter_mut().rev().take(1_000);
        let mut replaced = recent.filter(of_drive).filter(just_replaced);
        if newest.wish == Wish::Reference
            && let Some(older) = replaced.next()
        {
            older.succeeded = true;
            newest.place = older.place;
        }
    }

    fn collect_client(&mut self, client: usize) {
        let now = self.now;
        match &mut self.clients[client].way {
            Way::Plain(waiting) => {
                let mut answered = Vec::new();
                waiting.retain_mut(|(id, placed)| match placed.answer() {
                    Some(answer) => {
                        answered.push((*id, answer));
                        false
                    }
                    None => true,
                });
                for (id, answer) in answered {
                    if self.records[id].answer.is_none() {
                        self.answered(id, answer.outcome.code(), Some(&answer.outcome));
                        self.clients[client].open = self.clients[client].open.saturating_sub(1);
                    }
                }
            }
            Way::Mqtt(offline) => {
                for message in offline.poll(now) {
                    let json: serde_json::Value = serde_json::from_slice(&message.payload).unwrap();
                    let id = json["id"].as_u64().expect("the id of an order") as usize;
                    let code = json["result"].as_str().unwrap().to_string();
                    assert!(self.records[id].answer.is_none(), "order {id} was answered twice");
                    self.answered(id, &code, None);
                    self.clients[client].open = self.clients[client].open.saturating_sub(1);
                }
            }
            Way::ModbusTcp(offline, ..) => {
                let bytes = offline.receive(&[], now);
                self.take_answers(client, &bytes);
            }
        }
    }

    fn take_answers(&mut self, client: usize, bytes: &[u8]) {
        for (transaction, exception) in answers(bytes) {
            let Way::ModbusTcp(_, open, _) = &mut self.clients[client].way else {
                return;
            };
            let id = open.remove(&transaction).expect("an answer to a request");
            let code = match exception {
                None => "acknowledged".to_string(),
                Some(code) => format!("exception {code:02X}"),
            };
            self.answered(id, &code, None);
            self.clients[client].open = self.clients[client].open.saturating_sub(1);
        }
    }

    /// An order has its answer: is it true?
    fn answered(&mut self, id: usize, code: &str, outcome: Option<&Outcome>) {
        let now = self.now;
        let text = code.to_string();
        self.note(move || format!("order {id} is answered {text}"));
        assert!(self.records[id].answer.is_none(), "order {id} was answered twice");
        self.records[id].answer = Some((code.to_string(), now));
        let record = self.records[id].clone();
        if let Some(open) = self.open.get_mut(&(record.bus, record.drive)) {
            open.retain(|open| *open != id);
            if open.is_empty() {
                self.open.remove(&(record.bus, record.drive));
            }
        }
        let truth = &mut self.truths[record.bus][record.drive];
        let begun = [
            "acknowledged",
            "confirmed",
            "timeout",
            "garbled",
            "refused_by_drive",
            "interrupted",
        ];
        // By MQTT the answer comes with the confirmation, long after the order ended.
        let writes = record.wish != Wish::RawRead && self.clients[record.client].habit != Habit::Mqtt;
        if writes && (begun.contains(&code) || code.starts_with("exception")) {
            truth.maybe_heard(now);
        }
        if record.wish.is_stop() || record.wish == Wish::Reset {
            truth.last_stop_over = Some(now);
        }
        let unsent = [
            "expired",
            "replaced",
            "purged",
            "queue_full",
            "offline",
            "bus_down",
            "shutting_down",
            "withdrawn",
        ];
        if unsent.contains(&code) {
            assert!(record.sent.is_none(), "order {id} was sent, and its answer is {code}");
        }
        assert!(
            !(code == "queue_full" && record.wish.is_stop()),
            "a stop was refused for want of room"
        );
        let bare_stop = matches!(record.wish, Wish::Stop | Wish::RawStop);
        assert!(
            !(code == "offline" && bare_stop),
            "a stop was refused because the drive was away: it is the probe"
        );
        match code {
            "acknowledged" | "confirmed" => self.check_done(id, &record, code, outcome),
            "expired" => self.check_expired(id, &record),
            _ => {}
        }
        if code == "confirmed" && record.wish == Wish::Stop {
            self.check_stands(id, &record);
        }
        self.figures.confirmed += u64::from(code == "confirmed");
    }

    /// A confirmed stop: the motor stands, or is near zero speed.
    fn check_stands(&mut self, id: usize, record: &Record) {
        let (sim, troubled) = (
            self.now - self.began,
            self.truths[record.bus][record.drive].is_troubled(record.accepted),
        );
        let bus = &mut self.buses[record.bus];
        let late = bus.line.is_late();
        let Some(drive) = bus.wire.slaves().drive(record.drive as u8 + 1) else {
            return;
        };
        drive.advance(sim);
        let state = drive.state();
        assert!(
            troubled || late || !state.running || state.output.abs() < 2.0,
            "order {id}: the stop is confirmed, and the motor turns with {:.1} Hz",
            state.output
        );
    }

    /// What was acknowledged was done.
    fn check_done(&self, id: usize, record: &Record, code: &str, outcome: Option<&Outcome>) {
        let bus = &self.buses[record.bus];
        let (profile, truth) = (&bus.profile, &self.truths[record.bus][record.drive]);
        let since = record.accepted;
        if let Some((pdu, _)) = &record.read {
            let Some(Outcome::Acknowledged(reply)) = outcome else {
                return;
            };
            let words = reply.words();
            let read = |did: &RequestPdu, answered: Option<&Vec<u16>>| did == pdu && answered == words.as_ref();
            assert!(
                truth.did(since, read),
                "order {id} read what the drive did not say: {reply:?}"
            );
            return;
        }
        let run = |on: bool| move |did: &RequestPdu, _: Option<&Vec<u16>>| run_command(profile, did) == Some(on);
        let n2 = profile.name.ends_with("n2");
        if record.wish.is_stop() {
            assert!(
                truth.did(since, run(false)) || !truth.run,
                "order {id}: {code}, but the drive was not told to stop"
            );
        } else if record.wish.is_run() && !n2 {
            assert!(
                truth.did(since, run(true)),
                "order {id}: {code}, but the drive was not told to run"
            );
        }
        if let Some(unique) = record.unique.as_ref().filter(|_| !n2 && profile.name != "vacon-cx") {
            let wrote = |did: &RequestPdu, _: Option<&Vec<u16>>| sets(did, unique);
            let has = |did: &RequestPdu, words: Option<&Vec<u16>>| has_already(did, words, unique);
            let done = truth.did(since, wrote) || truth.did(since, has);
            assert!(done, "order {id}: {code}, but the drive did not take it");
        }
    }

    /// A steady client on a calm line is always served.
    fn check_expired(&self, id: usize, record: &Record) {
        let truth = &self.truths[record.bus][record.drive];
        let calm = self.scenario.incidents.is_none() && self.buses[record.bus].line.faults.is_empty();
        if self.clients[record.client].habit == Habit::Steady && calm && !self.stopping {
            assert!(
                record.before > 4 || truth.is_troubled(record.accepted) || !self.is_alive(record.bus, record.drive),
                "order {id} of a steady client expired behind {} others",
                record.before
            );
        }
    }

    fn is_alive(&self, bus: usize, drive: usize) -> bool {
        !self.buses[bus].line.dead.contains(&(drive as u8 + 1))
    }

    // ---- incidents ------------------------------------------------------------------------------------------------

    fn incidents(&mut self) {
        let now = self.now;
        for bus in 0..self.buses.len() {
            if self.away[bus].is_some_and(|until| until <= now) {
                self.away[bus] = None;
                self.note(move || format!("the port of line{bus} is back"));
                self.buses[bus].set_open(true, now);
            }
        }
        let back: Vec<_> = self.off.iter().filter(|(_, _, until)| *until <= now).copied().collect();
        self.off.retain(|(_, _, until)| *until > now);
        for (bus, address, _) in back {
            self.note(move || format!("line{bus} drive {address} is on again"));
            let sim = now - self.began;
            if let Some(drive) = self.buses[bus].wire.slaves().drive(address) {
                drive.advance(sim);
                drive.power_on(sim);
                drive.set_alive(true);
            }
        }
        if let Some(index) = self.restarts.filter(|index| self.buses[*index].core.asked().is_none()) {
            self.restarts = None;
            self.restart(index);
        }
        if self.next_reload.is_some_and(|at| at <= now) {
            self.next_reload = Some(now + Duration::from_millis(self.dice.within(3_000..=12_000)));
            self.reload();
        }
        if self.next_incident.is_some_and(|at| at <= now) && !self.stopping {
            let mean = self.scenario.incidents.unwrap_or(Duration::from_secs(1));
            self.next_incident = Some(now + mean.mul_f64(0.2 + 1.6 * self.dice.unit()));
            self.incident();
        }
    }

    fn incident(&mut self) {
        let now = self.now;
        let bus = self.dice.within(0..=self.buses.len() as u64 - 1) as usize;
        let address = self.dice.within(1..=u64::from(self.buses[bus].line.drives)) as u8;
        let kind = self.dice.within(0..=7);
        let off = now + Duration::from_millis(self.dice.within(50..=5_000));
        if !self.is_alive(bus, usize::from(address) - 1) || self.off.iter().any(|(b, a, _)| (*b, *a) == (bus, address))
        {
            return;
        }
        let sim = now - self.began;
        let all: Vec<usize> = (0..usize::from(self.buses[bus].line.drives)).collect();
        let befell = |truths: &mut Vec<Truth>, which: &[usize]| {
            which.iter().for_each(|index| truths[*index].trouble(now + AFTERMATH));
        };
        befell(&mut self.truths[bus], &[usize::from(address) - 1]);
        let words = match kind {
            0 => {
                let until = now + Duration::from_millis(self.dice.within(20..=3_000));
                self.away[bus] = Some(until);
                self.buses[bus].set_open(false, now);
                befell(&mut self.truths[bus], &all);
                "the port goes"
            }
            1 => {
                self.off.push((bus, address, off));
                self.truths[bus][usize::from(address) - 1].run = false;
                self.truths[bus][usize::from(address) - 1].lost_word = Some(now);
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                drive.power_off();
                "loses its supply"
            }
            2 => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                let alive = !drive.answers();
                drive.set_alive(alive);
                "comes off the line, or back"
            }
            3 | 4 => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                drive.trip(1);
                "trips"
            }
            _ => {
                let drive = self.buses[bus].wire.slaves().drive(address).unwrap();
                drive.advance(sim);
                let remote = drive.state().remote;
                drive.set_remote(!remote);
                "is switched to its panel, or back"
            }
        };
        self.note(move || format!("line{bus} drive {address} {words}"));
    }

    /// The gateway takes a new configuration, in which a bus has changed.
    fn reload(&mut self) {
        let index = self.dice.within(0..=self.buses.len() as u64 - 1) as usize;
        self.restarts = Some(index);
    }

    /// The bus that a reload has changed is started anew when the exchange on its line is over.
    fn restart(&mut self, index: usize) {
        self.note(move || format!("a reload starts line{index} anew"));
        self.buses[index].restart(index, &self.events, &self.writes, self.now);
        let plant = plant_of(&self.buses, &self.events, &self.writes);
        self.plant.store(Arc::new(plant));
        for truth in &mut self.truths[index] {
            truth.trouble(self.now + AFTERMATH);
        }
        self.collect();
    }

    // ---- what must hold at any time -------------------------------------------------------------------------------

    fn look(&mut self) {
        let now = self.now;
        loop {
            match self.heard_events.try_recv() {
                Ok(event) => self.on_event(&event),
                Err(broadcast::error::TryRecvError::Lagged(_)) => {}
                Err(_) => break,
            }
        }
        for (bus, truths) in self.buses.iter_mut().zip(&mut self.truths) {
            let waiting = bus.handle.queue.lock();
            assert!(
                waiting.len() <= CAPACITY + 2 * bus.handle.image.drives.len(),
                "{} commands wait",
                waiting.len()
            );
            drop(waiting);
            for (index, truth) in truths.iter_mut().enumerate() {
                let sim = now - self.began;
                let Some(drive) = bus.wire.slaves().drive(index as u8 + 1) else {
                    continue;
                };
                drive.advance(sim);
                let image = &bus.handle.image.drives[index];
                let seen = image.reading(now, Duration::from_secs(5)).is_set(ModelPoint::Running);
                let running = drive.state().running && drive.answers() && seen;
                truth.running_since = running.then(|| truth.running_since.unwrap_or(now));
                if running {
                    truth.ran_at = Some(now);
                }
                let online = bus.handle.image.drives[index].snapshot().link.is_online();
                truth.online_since = online.then(|| truth.online_since.unwrap_or(now));
            }
        }
        self.check_answered_in_time();
        if !self.stopping {
            self.check_leases();
            self.check_polls();
        }
        self.check_states();
    }

    fn on_event(&mut self, event: &drivegate::event::Event) {
        let text = format!("event {}: {}", event.kind.name(), event.text);
        self.note(move || text);
        let Some(name) = &event.drive else { return };
        for bus in 0..self.buses.len() {
            let drives = &self.buses[bus].handle.image.drives;
            if let Some(drive) = drives.iter().position(|drive| drive.spec.name == *name) {
                if event.kind == EventKind::Supervision {
                    self.truths[bus][drive].supervised = Some(self.now);
                    self.figures.supervised += 1;
                }
            }
        }
    }

    /// No order waits longer than its time and its last steps.
    fn check_answered_in_time(&self) {
        for id in self.open.values().flatten() {
            let record = &self.records[*id];
            // By MQTT the answer waits for the confirmation, 5 s at most.
            let by_mqtt = self.clients[record.client].habit == Habit::Mqtt;
            let most = if by_mqtt { 2 * LAST_STEPS } else { LAST_STEPS };
            // The end of a reset pulse is tried until the drive takes it.
            let noisy = !self.buses[record.bus].line.faults.is_empty();
            let most = if noisy { 3 * most } else { most };
            assert!(
                self.now < record.expires + most,
                "order {id} has no answer {:?} after its time: {record:?}",
                self.now - record.expires
            );
        }
    }

    /// A drive that runs, whose client fell silent, gets its action.
    fn check_leases(&self) {
        for (index, bus) in self.buses.iter().enumerate() {
            let Some(supervision) = &bus.line.supervision else {
                continue;
            };
            for (drive, truth) in self.truths[index].iter().enumerate() {
                let (Some(heard), Some(running), Some(online)) =
                    (truth.heard.0, truth.running_since, truth.online_since)
                else {
                    continue;
                };
                let last = truth.heard.1.unwrap_or(heard);
                let round = 3 * bus.handle.image.health().fast.last.unwrap_or_default();
                let due = last.max(running).max(online) + supervision.timeout + ACTION + round;
                let waits = self.open.contains_key(&(index, drive));
                // Until the motor was seen to run, the lease of one that stood has ended.
                let armed = running <= last + supervision.timeout;
                let noisy = !bus.line.faults.is_empty();
                let late = if noisy { due + Duration::from_secs(2) } else { due };
                if !waits && bus.open && armed && self.now > late && !truth.is_troubled(last) {
                    assert!(
                        truth.supervised.is_some_and(|at| at + ACTION >= last),
                        "line{index} drive {} runs {:?} after its client fell silent",
                        drive + 1,
                        self.now - last
                    );
                }
            }
        }
    }

    /// On a sound line the process data of a drive that answers stays fresh, whoever commands what.
    fn check_polls(&self) {
        let sound = |bus: &&WorldBus| bus.open && bus.line.faults.is_empty() && self.scenario.incidents.is_none();
        for bus in self.buses.iter().filter(sound) {
            // Until two rounds began, the cycle is the predicted one.
            let round = bus.handle.image.health().fast.last.unwrap_or(bus.round);
            for (drive, truth) in bus.handle.image.drives.iter().zip(&self.truths[bus.index]) {
                let settled = |at: Instant| self.now - at > Duration::from_secs(3);
                let age = drive.snapshot().fast_at.map(|at| self.now - at);
                assert!(
                    !truth.online_since.is_some_and(settled)
                        || age.is_some_and(|age| age < Duration::from_secs(2) + 3 * round),
                    "the process data of {} is {age:?} old",
                    drive.spec.name
                );
            }
        }
    }

    /// A state is known only while all that it rests on is.
    fn check_states(&self) {
        let plant = self.plant.load();
        for drive in plant.drives() {
            let reading = drive.reading(self.now);
            let profile = &drive.image.spec.profile;
            let bad = |point: ModelPoint| {
                profile.model_index(point).is_some() && reading.model(point).quality != Quality::Good
            };
            use drivegate::drive::State;
            match reading.state() {
                Some(State::Running) => assert!(!bad(ModelPoint::Running), "running though nobody knows"),
                Some(State::Ready | State::NotReady) => {
                    let unknown = bad(ModelPoint::Running) || bad(ModelPoint::Fault) || bad(ModelPoint::Ready);
                    assert!(
                        !unknown,
                        "{}: a state that rests on what is not known",
                        drive.image.spec.name
                    );
                }
                _ => {}
            }
        }
    }

    // ---- the end --------------------------------------------------------------------------------------------------

    /// The gateway stops: every online drive that is to be stopped is, and everybody has one answer.
    fn stop(&mut self) {
        self.stopping = true;
        self.note(|| "the gateway stops".to_string());
        let deadline = self.now + Duration::from_secs(30);
        let mut reports: Vec<(usize, oneshot::Receiver<Vec<String>>)> = Vec::new();
        for (index, bus) in self.buses.iter_mut().enumerate() {
            if bus.open {
                reports.push((index, bus.handle.queue.begin_shutdown(deadline, self.now)));
                bus.ending = true;
                bus.command_came(self.now);
            }
        }
        let mut missing: BTreeMap<usize, Vec<String>> = BTreeMap::new();
        let begun = self.now;
        self.next_incident = None;
        self.next_reload = None;
        self.restarts = None;
        while !reports.is_empty() {
            assert!(
                self.now < deadline + Duration::from_secs(1),
                "the shutdown does not end"
            );
            self.step();
            reports.retain_mut(|(index, report)| match report.try_recv() {
                Ok(drives) => {
                    missing.insert(*index, drives);
                    false
                }
                Err(_) => self.away[*index].is_none(),
            });
        }
        for (index, bus) in self.buses.iter_mut().enumerate() {
            let on_shutdown = bus.line.on_shutdown == drivegate::cache::OnShutdown::Stop;
            let Some(missing) = missing.get(&index).filter(|_| on_shutdown) else {
                continue;
            };
            for (drive, truth) in self.truths[index].iter().enumerate() {
                let spec = &bus.handle.image.drives[drive].spec;
                let answers = bus
                    .wire
                    .slaves()
                    .drive(spec.address)
                    .is_some_and(|drive| drive.answers());
                if answers && !truth.is_troubled(begun) {
                    assert!(!truth.run, "{} was not stopped with the gateway", spec.name);
                    assert!(
                        !missing.iter().any(|text| text.contains(&format!("`{}`", spec.name))),
                        "{missing:?}"
                    );
                }
            }
        }
        for bus in &mut self.buses {
            bus.handle.queue.close(Outcome::ShuttingDown, self.now);
            bus.core.ended(self.now);
        }
        self.collect();
        let open: Vec<usize> = self.open.values().flatten().copied().collect();
        assert!(open.is_empty(), "orders without an answer at the end: {open:?}");
        let told: u64 = self.writes.results().values().sum();
        let reads = self.records.iter().filter(|record| record.read.is_some()).count();
        assert!(
            told >= (self.records.len() - reads) as u64,
            "each order is counted once"
        );
    }
}

fn has_already(did: &RequestPdu, words: Option<&Vec<u16>>, (table, address, wanted): &super::orders::Unique) -> bool {
    let (RequestPdu::Read { table: of, start, .. }, Some(words)) = (did, words) else {
        return false;
    };
    let Some(offset) = address.checked_sub(*start).filter(|_| of == table) else {
        return false;
    };
    words.get(usize::from(offset)..usize::from(offset) + wanted.len()) == Some(wanted.as_slice())
}

fn plant_of(buses: &[WorldBus], events: &Events, writes: &Arc<WriteStats>) -> Plant {
    Plant {
        gateway: "world".to_string(),
        stale_after: Duration::from_secs(1),
        buses: buses.iter().map(|bus| bus.handle.clone()).collect(),
        events: events.clone(),
        writes: writes.clone(),
    }
}
