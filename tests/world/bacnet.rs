//! BACnet clients as a source of orders in virtual time: priorities, NULL, stops from other interfaces, silent
//! clients, lost frames and offline drives, through the real server, its datagrams, the real core and a simulated
//! line.
//!
//! `one_by_one` compares every answer, the arrays and the drive itself with the rules in `docs/bacnet.md`;
//! `all_at_once` checks what must always hold: nothing starts after a stop, and no request is answered twice.

use std::net::SocketAddrV4;
use std::time::{Duration, Instant};

use drivegate_bacnet::encoding::{Reader, Writer};
use drivegate_bacnet::npdu::{self, Payload};
use drivegate_bacnet::{Data, Mac, ObjectId, ObjectType, To, bvlc};
use drivegate_core::order::{Outcome, Refusal};
use drivegate_core::plant::Placed;
use drivegate_core::process_image::{LeaseAction, Supervision};
use drivegate_north::bacnet::{Loopback, Options, WhenOffline};
use drivegate_proto::{Protocol, Reply, RequestPdu, Table};
use drivegate_sim::random::Random;

use super::bus::Seen;
use super::orders::{reference_point, run_command};
use super::rig::{Rig, line};
use super::scenario::Line;

/// Seeds of every test run.
const SEEDS: u64 = 60;
/// Number of orders of each seed.
const ORDERS: usize = 60;

const NETWORK: u16 = 1001;
const DRIVE: u8 = 1;
const RUN: ObjectId = ObjectId::new(ObjectType::BINARY_VALUE, 1);
const SPEED: ObjectId = ObjectId::new(ObjectType::ANALOG_VALUE, 1);
const LEASE: Duration = Duration::from_secs(3);

/// Why a write was not carried out, as a client sees it: class and code.
type Why = (u8, u8);
const DENIED: Why = (2, 40);
const REFUSED: Why = (5, 29);

/// A client, with the request whose answer it waits for.
#[derive(Debug, Clone, Default)]
struct Client {
    invoke: u8,
    waits: bool,
    last: Vec<u8>,
    /// Whether the drive was online when the request was sent.
    taken: bool,
    answers: Vec<Vec<u8>>,
}

struct BacnetWorld {
    rig: Rig,
    server: Loopback,
    dice: Random,
    clients: [Client; 3],
    next_poll: Instant,
    /// When a stop from elsewhere was accepted, as long as no run was requested since.
    stopped: Option<Instant>,
    elsewhere: Vec<Placed>,
}

/// The client of that number, from 0.
fn host(client: usize) -> SocketAddrV4 {
    SocketAddrV4::new([127, 0, 0, 20 + client as u8].into(), 47808)
}

fn content(object: ObjectId, write: impl FnOnce(&mut Writer)) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.context_object(0, object);
    write(&mut writer);
    writer.into_bytes()
}

fn write_of(object: ObjectId, value: Option<f64>, priority: u8) -> Vec<u8> {
    content(object, |w| {
        w.context_unsigned(1, 85).open(3);
        match value {
            None => w.null(),
            Some(value) if object == RUN => w.enumerated(u32::from(value != 0.0)),
            Some(value) => w.real(value as f32),
        };
        w.close(3).context_unsigned(4, priority.into());
    })
}

impl BacnetWorld {
    fn new(seed: u64, faults: &str) -> BacnetWorld {
        let line = Line {
            cycle: Duration::from_millis(50),
            faults: faults.to_string(),
            supervision: Some(Supervision {
                timeout: LEASE,
                action: LeaseAction::Stop,
                adopt: false,
            }),
            ..line("vacon-nx", Protocol::ModbusRtu, 38_400, 2)
        };
        let mut rig = Rig::of(&line);
        rig.run(Duration::from_secs(3));
        let everywhere = || vec!["127.0.0.0/8".parse().unwrap()];
        let options = Options {
            listen: "127.0.0.1:47808".parse().unwrap(),
            device: 100,
            network: Some(NETWORK),
            foreign_devices: 0,
            offline: WhenOffline::Silent,
            commands: true,
            allow: everywhere(),
            write: everywhere(),
            keep_priorities: false,
            bbmd: None,
            vendor: 0,
            dcc_password: None,
            buses: None,
            state_dir: "/nonexistent".into(),
        };
        let server = Loopback::new(options, rig.shared_plant(), rig.now);
        let next_poll = rig.now;
        BacnetWorld {
            rig,
            server,
            dice: Random::new(seed ^ 0xBAC0),
            clients: Default::default(),
            next_poll,
            stopped: None,
            elsewhere: Vec::new(),
        }
    }

    /// Runs the next event until `until`; returns false if there is none.
    fn step(&mut self, until: Instant) -> bool {
        let seen = self.rig.step(until.min(self.next_poll));
        let now = self.rig.now;
        for seen in seen.iter().flatten() {
            if let Seen::Sent(asked) = seen {
                self.sent(&asked.pdu, asked.drive, asked.at);
            }
        }
        self.server.collect(now);
        if self.next_poll <= now {
            self.server.poll(now);
            self.next_poll = now + Duration::from_millis(100);
        }
        self.hear();
        self.elsewhere.retain_mut(|placed| placed.answer().is_none());
        seen.is_some() || now < until
    }

    fn sent(&self, pdu: &RequestPdu, drive: usize, at: Instant) {
        let starts = drive == 0 && run_command(&self.rig.bus.profile, pdu) == Some(true);
        assert!(
            !starts || self.stopped.is_none_or(|stopped| at <= stopped),
            "a run command was sent behind a stop, and nobody gave it since: {pdu:?}"
        );
    }

    fn wait(&mut self, time: Duration) {
        let until = self.rig.now + time;
        while self.step(until) {}
    }

    /// Delivers the answers to the clients.
    fn hear(&mut self) {
        while let Some((to, datagram)) = self.server.transmit() {
            let To::Host(to) = to else { continue };
            let bvlc::Bvlc::Unicast(npdu) = bvlc::decode(&datagram).unwrap() else {
                panic!("{datagram:?}")
            };
            let npdu = npdu::decode(npdu).unwrap();
            let Payload::Application(apdu) = npdu.payload else {
                panic!("{datagram:?}")
            };
            assert_eq!(npdu.from, Some((NETWORK, Mac::new(&[DRIVE]).unwrap())));
            let client = &mut self.clients[usize::from(to.ip().octets()[3] - 20)];
            assert_eq!(apdu[1], client.invoke, "an answer to what was given up");
            client.waits = false;
            client.answers.push(apdu.to_vec());
        }
    }

    /// A client sends a request; a write takes the next invoke id, a repetition keeps its id.
    fn ask(&mut self, client: usize, service: u8, content: &[u8], again: bool) {
        let there = self.rig.is_online(0);
        let asking = &mut self.clients[client];
        if !again {
            asking.invoke = asking.invoke.wrapping_add(1);
            asking.answers.clear();
        }
        asking.waits = true;
        let apdu = [&[0x00, 0x05, asking.invoke, service][..], content].concat();
        asking.last = content.to_vec();
        asking.taken = (again && asking.taken) || there;
        let to = Some((NETWORK, Mac::new(&[DRIVE]).unwrap()));
        let datagram = bvlc::unicast(&npdu::encode(to, None, true, Payload::Application(&apdu)));
        self.server.receive(host(client), &datagram, self.rig.now);
        self.rig.bus.command_came(self.rig.now);
        self.hear();
    }

    /// The answer to a client's request; an absent drive sends none.
    fn answer(&mut self, client: usize) -> Option<Vec<u8>> {
        let until = self.rig.now + Duration::from_secs(10);
        while self.clients[client].waits && self.step(until) {}
        self.clients[client].waits = false;
        assert!(self.clients[client].answers.len() < 2, "answered twice");
        self.clients[client].answers.pop()
    }

    /// Writes and waits: done, or why not.
    fn write(&mut self, client: usize, object: ObjectId, value: Option<f64>, priority: u8) -> Result<(), Why> {
        self.ask(client, 15, &write_of(object, value, priority), false);
        let answer = self.answer(client).expect("the drive is there");
        match answer[..] {
            [0x20, ..] => Ok(()),
            [0x50, _, _, 0x91, class, 0x91, code] => Err((class, code)),
            _ => panic!("{answer:?}"),
        }
    }

    /// The values of a property of the drive.
    fn read(&mut self, object: ObjectId, property: u64) -> Vec<Data> {
        let asked = content(object, |w| {
            w.context_unsigned(1, property);
        });
        self.ask(2, 12, &asked, false);
        let answer = self.answer(2).expect("the drive is there");
        assert_eq!(answer[0], 0x30, "{answer:?}");
        let mut reader = Reader::new(&answer[3..]);
        reader.context_object(0).unwrap();
        reader.context_property(1).unwrap();
        reader.open(3).unwrap();
        let mut values = Vec::new();
        while !reader.is_close(3) {
            values.push(reader.data().unwrap().unwrap());
        }
        values
    }

    fn array(&mut self, object: ObjectId) -> Vec<Option<f64>> {
        let all = self.read(object, 87).into_iter();
        all.map(|value| match value {
            Data::Null => None,
            Data::Enumerated(state) => Some(f64::from(state)),
            Data::Real(number) => Some(f64::from(number)),
            other => panic!("{other:?}"),
        })
        .collect()
    }

    /// A register of the drive, read directly from the simulated drive.
    fn register(&mut self, table: Table, start: u16) -> u16 {
        let read = RequestPdu::Read { table, start, count: 1 };
        match self.rig.with_drive(DRIVE, |drive, now| drive.answer(&read, now)) {
            Some(Reply::Registers(words)) => words[0],
            other => unreachable!("{other:?}"),
        }
    }

    /// Whether the drive has a run command.
    fn runs(&mut self) -> bool {
        let profile = self.rig.bus.profile.clone();
        let place = profile.run_place().unwrap();
        let word = self.register(place.table, place.address);
        !profile.is_stop(place.table, place.address, word)
    }

    /// The reference in the drive.
    fn speed(&mut self) -> f64 {
        let profile = self.rig.bus.profile.clone();
        let (_, point) = reference_point(&profile);
        let raw = point.raw().unwrap();
        f64::from(self.register(raw.table, raw.address)) * raw.scale
    }

    /// Gives an order over another interface.
    fn order_elsewhere(&mut self, points: &[(&str, f64)]) -> Placed {
        let order = self.rig.points(DRIVE, points);
        self.rig.place_as("cloud", DRIVE, order)
    }

    /// Gives an order over another interface and waits for its outcome.
    fn elsewhere(&mut self, points: &[(&str, f64)]) -> Outcome {
        let mut placed = self.order_elsewhere(points);
        let until = self.rig.now + Duration::from_secs(10);
        loop {
            if let Some(answer) = placed.answer() {
                return answer.outcome;
            }
            assert!(self.step(until), "an order that nobody answers");
        }
    }
}

/// The arrays by the rules: value and client of each slot.
#[derive(Debug, Clone, Default)]
struct Rules {
    run: [Option<(f64, usize)>; 16],
    speed: [Option<(f64, usize)>; 16],
}

type Array = [Option<(f64, usize)>; 16];

/// The governing priority, its value and client.
fn governs(array: &Array) -> Option<(usize, f64, usize)> {
    let occupied = array
        .iter()
        .enumerate()
        .find_map(|(place, slot)| Some((place, (*slot)?)));
    occupied.map(|(place, (value, client))| (place + 1, value, client))
}

fn values(array: &Array) -> Vec<Option<f64>> {
    array.iter().map(|slot| slot.map(|(value, _)| value)).collect()
}

impl Rules {
    /// Whether the slots refuse an order from elsewhere.
    fn protects(&self, starts: bool, sets: bool) -> bool {
        let run = governs(&self.run).is_some_and(|(priority, value, _)| priority <= 5 && value == 0.0);
        let speed = governs(&self.speed).is_some_and(|(priority, ..)| priority <= 5);
        (starts && run) || (sets && speed)
    }

    fn elsewhere(&mut self, run: Option<bool>, sets: bool) {
        if let Some(run) = run {
            let other = |slot: &(f64, usize)| (slot.0 != 0.0) != run;
            // An inactive value that protects people stays after a start, even if an active value governs.
            let protects = |place: usize| run && place < 5;
            for (place, slot) in self.run.iter_mut().enumerate() {
                *slot = slot.filter(|slot| !other(slot) || protects(place));
            }
        }
        if sets {
            self.speed = Default::default();
        }
    }

    /// The client whose slot governs falls silent, and the gateway stops the drive.
    fn silenced(&mut self) {
        if let Some((.., client)) = governs(&self.run).or(governs(&self.speed)) {
            for slot in self.run.iter_mut().chain(&mut self.speed) {
                *slot = slot.filter(|(_, owner)| *owner != client);
            }
        }
        self.elsewhere(Some(false), false);
    }
}

const PRIORITIES: [u8; 9] = [1, 3, 5, 6, 7, 8, 10, 12, 16];

/// Runs a seed in which each client waits for its answer.
fn one_by_one(seed: u64) {
    let mut world = BacnetWorld::new(seed, "");
    let mut rules = Rules::default();
    for number in 0..ORDERS {
        let client = world.dice.within(0..=1) as usize;
        let priority = PRIORITIES[world.dice.within(0..=8) as usize];
        let place = usize::from(priority - 1);
        let (ran, had) = (world.runs(), world.speed());
        let leases = world.rig.drive(DRIVE).image.supervisions();
        let what = world.dice.within(0..=13);
        let note = format!("seed {seed}, order {number} ({what}) of client {client} at {priority}: {rules:?}");
        let (mut runs, mut speed) = (ran, had);
        match what {
            0..=6 => {
                let value = [Some(1.0), Some(1.0), Some(0.0), Some(0.0), None, None, None][what as usize];
                let before = governs(&rules.run);
                let done = world.write(client, RUN, value, priority);
                assert_eq!(done, if priority == 6 { Err(DENIED) } else { Ok(()) }, "{note}");
                if priority != 6 {
                    rules.run[place] = value.map(|value| (value, client));
                    let after = governs(&rules.run);
                    runs = match (value, before, after) {
                        (Some(value), _, Some((at, ..))) if at == place + 1 => value != 0.0,
                        (None, Some((at, ..)), after) if at == place + 1 => {
                            after.is_some_and(|(_, value, _)| value != 0.0)
                        }
                        _ => ran,
                    };
                }
            }
            7..=9 => {
                let value = (what != 9).then(|| world.dice.within(1..=80) as f64);
                let before = governs(&rules.speed);
                let done = world.write(client, SPEED, value, priority);
                assert_eq!(done, if priority == 6 { Err(DENIED) } else { Ok(()) }, "{note}");
                if priority != 6 {
                    rules.speed[place] = value.map(|value| (value, client));
                    let own = |slot: Option<(usize, f64, usize)>| slot.is_some_and(|(at, ..)| at == place + 1);
                    let after = governs(&rules.speed);
                    if (value.is_some() && own(after)) || (value.is_none() && own(before)) {
                        speed = after.map_or(had, |(_, value, _)| value);
                    }
                }
            }
            10..=12 => {
                let number = world.dice.within(1..=80) as f64;
                let (points, run, sets) = match what {
                    10 => (vec![("run", 0.0)], Some(false), false),
                    11 => (vec![("run", 1.0)], Some(true), false),
                    _ => (vec![("speed_reference", number)], None, true),
                };
                let held = rules.protects(run == Some(true), sets);
                let outcome = world.elsewhere(&points);
                match (held, outcome) {
                    (true, Outcome::Refused(Refusal::HeldByOther(_))) => {}
                    (false, Outcome::Acknowledged(_)) => {
                        rules.elsewhere(run, sets);
                        runs = run.unwrap_or(ran);
                        speed = if sets { number } else { had };
                    }
                    (_, outcome) => panic!("{note}: {outcome}"),
                }
            }
            _ => {
                // In this step only a client whose slot does not govern acts.
                let own = governs(&rules.run).map(|(.., client)| client);
                let other = usize::from(own == Some(0));
                for _ in 0..10 {
                    world.wait(Duration::from_millis(500));
                    if rules.run[14].is_none() && own.is_some() {
                        world.write(other, RUN, None, 15).unwrap();
                    }
                }
                let ended = world.rig.drive(DRIVE).image.supervisions() > leases;
                assert!(ended || !ran, "{note}: the lease does not end");
            }
        }
        if world.rig.drive(DRIVE).image.supervisions() > leases {
            rules.silenced();
            runs = false;
        }
        assert_eq!((world.runs(), world.speed()), (runs, speed), "{note}");
        assert_eq!(world.array(RUN), values(&rules.run), "{note}");
        let shown: Vec<Option<f64>> = world.array(SPEED);
        assert_eq!(shown, values(&rules.speed), "{note}");
        let governing = governs(&rules.run).map(|(priority, ..)| priority as u64);
        let current = world.read(RUN, 431).remove(0);
        assert_eq!(current, governing.map_or(Data::Null, Data::Unsigned), "{note}");
    }
}

#[test]
fn slots_answers_and_the_drive_are_as_the_rules_say() {
    match super::number("WORLD_SEED") {
        Some(seed) => one_by_one(seed),
        None => (0..SEEDS).for_each(one_by_one),
    }
}

/// Runs a seed in which clients do not wait, frames are lost and the drive goes offline.
fn all_at_once(seed: u64) -> (usize, usize) {
    let faults = ["", "drop=0.05", "deaf=0.05,corrupt=0.05"][seed as usize % 3];
    let mut world = BacnetWorld::new(seed, faults);
    let (mut answered, mut refused) = (0, 0);
    for _ in 0..ORDERS * 2 {
        let client = world.dice.within(0..=1) as usize;
        let priority = PRIORITIES[world.dice.within(0..=8) as usize];
        let pause = Duration::from_millis(world.dice.within(0..=200));
        match world.dice.within(0..=15) {
            0..=9 if world.clients[client].waits => {
                // The answer is late, so the client repeats its request. The repetition is not a new order, unless
                // the drive was offline before.
                let content = world.clients[client].last.clone();
                if !world.clients[client].taken {
                    world.stopped = None;
                }
                world.ask(client, 15, &content, true);
            }
            roll @ 0..=9 => {
                answered += world.clients[client].answers.len();
                assert!(world.clients[client].answers.len() < 2, "seed {seed}: answered twice");
                let value = [Some(1.0), Some(0.0), None][roll as usize % 3];
                if value == Some(1.0) {
                    world.stopped = None;
                }
                world.ask(client, 15, &write_of(RUN, value, priority), false);
            }
            10..=12 => {
                let stop = world.order_elsewhere(&[("run", 0.0)]);
                world.stopped = Some(world.rig.now);
                world.elsewhere.push(stop);
            }
            13 => {
                let mut start = world.order_elsewhere(&[("run", 1.0)]);
                match start.answer().map(|answer| answer.outcome) {
                    Some(_) => refused += 1,
                    None => world.stopped = None,
                }
                world.elsewhere.push(start);
            }
            14 => {
                world.rig.set_alive(DRIVE, false);
                let away = Duration::from_millis(world.dice.within(200..=3_000));
                world.wait(away);
                world.rig.set_alive(DRIVE, true);
            }
            _ => world.wait(Duration::from_secs(2)),
        }
        world.wait(pause);
    }
    world
        .rig
        .set_faults(drivegate_sim::faults::FaultPlan::new("".parse().unwrap(), 0));
    world.wait(Duration::from_secs(20));
    for client in &mut world.clients {
        client.waits = false;
    }
    // The world works as at the start: a stop is done, no slot is active, and the motor can be started again.
    assert!(matches!(world.elsewhere(&[("run", 0.0)]), Outcome::Acknowledged(_)));
    assert!(!world.runs() && world.array(RUN).iter().all(|slot| *slot != Some(1.0)));
    for priority in PRIORITIES.into_iter().filter(|priority| *priority != 6) {
        assert_eq!(world.write(0, RUN, None, priority), Ok(()), "seed {seed}");
    }
    world.stopped = None;
    assert_eq!(world.write(1, RUN, Some(1.0), 8), Ok(()), "seed {seed}");
    assert!(world.runs());
    (answered, refused)
}

#[test]
fn nothing_starts_behind_a_stop_and_nobody_is_answered_twice() {
    let all = match super::number("WORLD_SEED") {
        Some(seed) => vec![all_at_once(seed)],
        None => (0..SEEDS).map(all_at_once).collect(),
    };
    let answered: usize = all.iter().map(|(answered, _)| answered).sum();
    let refused: usize = all.iter().map(|(_, refused)| refused).sum();
    assert!(
        all.len() == 1 || (answered > 500 && refused > 20),
        "{answered} {refused}"
    );
}

#[test]
fn a_late_duplicate_starts_nothing() {
    let mut world = BacnetWorld::new(1, "");
    assert_eq!(world.write(0, RUN, Some(1.0), 8), Ok(()));
    let content = world.clients[0].last.clone();
    assert!(matches!(world.elsewhere(&[("run", 0.0)]), Outcome::Acknowledged(_)));
    world.stopped = Some(world.rig.now);
    world.ask(0, 15, &content, true);
    let answer = world.answer(0).unwrap();
    assert_eq!(answer[3..], [0x91, REFUSED.0, 0x91, REFUSED.1]);
    world.wait(Duration::from_secs(3));
    assert!(!world.runs());
}
