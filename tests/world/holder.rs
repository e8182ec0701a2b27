//! Six clients and the holder of a drive, on a line that loses and damages frames, with reloads and kills: no run
//! command or reference of a client that does not hold the drive is on the wire, and every stop is carried out.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::order::{
    Arrival, Authority, DEFAULT_EXPIRY, Order, Origin, Outcome, Proof, Refusal, SourceKind, written,
};
use drivegate_core::permit::{HoldState, Mode, Principal, Rules, Verb};
use drivegate_core::plant::{OrderRequest, Placed};
use drivegate_core::process_image::DriveSpec;
use drivegate_core::start_guard::Guard;
use drivegate_proto::{Protocol, Table};
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::random::Random;

use super::bus::{Parts, Seen};
use super::rig::{PATIENCE, Rig, line};
use super::scenario::Line;
use drivegate_model::drive::DriveIndex;

const SECOND: Duration = Duration::from_secs(1);
const LEASE: Duration = Duration::from_secs(3);
const DRIVES: u8 = 2;
/// The clients, each with a separate interface. A client's reference identifies its frames: 10 % plus its index.
const CLIENTS: [&str; 6] = ["plc", "op", "cloud", "socket:7", "host", "nobody"];
/// Index of the rank of each client; the last client has no rank.
const RANKS: [usize; 6] = [2, 1, 3, 0, 2, usize::MAX];

/// The drives of every second world are guarded as well: that changes who is refused with what, and nothing of who holds.
fn works(guarded: bool) -> Line {
    let spec: fn(&mut DriveSpec) = if guarded {
        |spec| {
            spec.guard = Some(Guard {
                starts_per_hour: Some(60),
                min_off: SECOND,
                min_run: SECOND,
                stagger: Duration::from_millis(500),
            });
            spec.staggers = true;
        }
    } else {
        |_| {}
    };
    Line {
        cycle: Duration::from_millis(100),
        spec,
        ..line("vacon-nx", Protocol::ModbusRtu, 19_200, DRIVES)
    }
}

fn rules() -> Arc<Rules> {
    let principals = vec![
        Principal {
            modbus_tcp: vec!["10.0.0.5/32".parse().unwrap()],
            ..Principal::new("plc", 2)
        },
        Principal {
            http_user: Some("op".to_string()),
            ..Principal::new("op", 1)
        },
        Principal {
            mqtt: Some("cloud".to_string()),
            ..Principal::new("cloud", 3)
        },
        Principal {
            sparkplug: true,
            ..Principal::new("host", 2)
        },
    ];
    Arc::new(Rules {
        mode: Mode::Exclusive,
        ranks: ["site", "operator", "automation", "remote"].map(Into::into).to_vec(),
        lease: LEASE,
        stop_at_local: true,
        principals,
    })
}

fn origin(client: usize) -> Origin {
    let (kind, proof) = match client {
        0 => (SourceKind::ModbusTcp, Proof::Address("10.0.0.5".parse().unwrap())),
        1 => (SourceKind::Http, Proof::User("op".into())),
        2 => (SourceKind::Mqtt, Proof::Topic("cloud".into())),
        3 => (SourceKind::LocalSocket, Proof::Uid(7)),
        4 => (SourceKind::Sparkplug, Proof::Sparkplug),
        _ => (SourceKind::Mqtt, Proof::Nothing),
    };
    Origin::new(kind, CLIENTS[client]).proven(proof)
}

struct Play {
    rig: Rig,
    dice: Random,
    rules: Arc<Rules>,
    began: Instant,
    stops: Vec<(usize, Placed)>,
    /// Orders other than stops, by drive and client.
    orders: Vec<(usize, usize, Placed)>,
    results: BTreeMap<&'static str, u32>,
    frames: u32,
    faulty: bool,
}

impl Play {
    fn new(seed: u64) -> Play {
        let works = works(seed % 2 == 1);
        let rig = Rig::new(&works, Parts::of(0, &works, seed));
        let rules = rules();
        rig.bus.handle.queue.set_authority(Some(rules.clone()));
        Play {
            began: rig.now,
            rig,
            dice: Random::new(seed ^ 0x401D),
            rules,
            stops: Vec::new(),
            orders: Vec::new(),
            results: BTreeMap::new(),
            frames: 0,
            faulty: false,
        }
    }

    fn time(&self) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000) + (self.rig.now - self.began)
    }

    fn holder(&self, drive: usize) -> (HoldState, String) {
        let queue = self.rig.bus.handle.queue.lock();
        let (view, _) = queue
            .gate
            .hold_view(DriveIndex::new(drive), None, self.rig.now)
            .unwrap();
        (
            view.state,
            view.holder.map(|holder| holder.to_string()).unwrap_or_default(),
        )
    }

    fn run(&mut self, time: Duration) {
        let until = self.rig.now + time;
        while self.rig.now < until {
            let next = until.min(self.rig.now + Duration::from_millis(10));
            while let Some(seen) = self.rig.step(next) {
                seen.into_iter().for_each(|seen| self.note(seen));
            }
            // Each file of the guards is written at once and successfully.
            let guards = self.rig.bus.guards.clone();
            if let Some((generation, _)) = guards.to_write(self.rig.now, self.time()) {
                guards.wrote(generation, Ok(()), self.rig.now);
            }
        }
    }

    /// Checks the sender of a frame: only the holder, or, while the drive is free, a client whose order was accepted before.
    fn note(&mut self, seen: Seen) {
        let Seen::Sent(asked) = seen else { return };
        let Some((Table::Holding, items)) = written(&asked.pdu) else {
            return;
        };
        let profile = self.rig.bus.profile.clone();
        let reference = profile
            .points
            .get(profile.point_index("speed_reference").unwrap())
            .unwrap()
            .raw()
            .unwrap()
            .address;
        for (address, word) in items {
            let runs = profile.runs_by(Table::Holding, address, word) == Some(true);
            if !runs && address != reference {
                continue;
            }
            self.frames += 1;
            let (state, holder) = self.holder(asked.drive);
            let is_free = state == HoldState::Free;
            assert!(
                is_free || state == HoldState::Held,
                "{:?} while {state:?} for {holder}",
                asked.pdu
            );
            let may = |client: usize| is_free || CLIENTS[client] == holder;
            let ordered = |client: usize| {
                let mut orders = self.orders.iter();
                orders.any(|(drive, of, _)| (*drive, *of) == (asked.drive, client))
            };
            // A reference in the word identifies its client.
            let wrote = |client: usize| runs || usize::from(word) == 1000 + 100 * client;
            let whose = (0..CLIENTS.len()).find(|client| may(*client) && ordered(*client) && wrote(*client));
            assert!(whose.is_some(), "{:?} while {state:?} for {holder}", asked.pdu);
        }
    }

    fn place(&mut self, client: usize, drive: usize, points: &[(&str, f64)]) -> Placed {
        let order: Order = self.rig.points(drive as u8 + 1, points);
        let handle = self.rig.drive(drive as u8 + 1);
        let placed = handle.place(OrderRequest::new(order, origin(client), Authority::Write), self.rig.now);
        self.rig.bus.command_came(self.rig.now);
        placed
    }

    /// Places an order that needs the drive: a client that must be refused is refused at once.
    fn steer(&mut self, client: usize, drive: usize, points: &[(&str, f64)]) {
        let (state, holder) = self.holder(drive);
        let other = CLIENTS
            .iter()
            .position(|name| *name == holder)
            .filter(|other| *other != client);
        let refused = match (state, other) {
            (HoldState::Held, Some(_)) => true,
            (HoldState::Reserved, Some(stopper)) => RANKS[stopper] < RANKS[client],
            _ => client == 5,
        };
        let mut placed = self.place(client, drive, points);
        if !refused {
            self.orders.push((drive, client, placed));
            return;
        }
        let code = placed.answer().map(|answer| answer.outcome.code());
        let expected = if client == 5 { "not_allowed" } else { "held_by_other" };
        assert_eq!(code, Some(expected), "{} while {state:?} for {holder}", CLIENTS[client]);
        *self.results.entry(expected).or_default() += 1;
    }

    /// A stop ends the hold of another client.
    fn stop(&mut self, client: usize, drive: usize) {
        let placed = self.place(client, drive, &[("run", 0.0)]);
        self.stops.push((client, placed));
        let (state, holder) = self.holder(drive);
        let ends = state != HoldState::Held || holder == CLIENTS[client];
        assert!(ends, "{holder} holds it after a stop of {}", CLIENTS[client]);
    }

    fn act(&mut self) {
        let client = self.dice.within(0..=5) as usize;
        let drive = self.dice.within(0..=u64::from(DRIVES) - 1) as usize;
        let reference = 10.0 + client as f64;
        match self.dice.within(0..=11) {
            0..=2 => self.steer(client, drive, &[("run", 1.0), ("speed_reference", reference)]),
            3..=4 => self.steer(client, drive, &[("speed_reference", reference)]),
            5..=6 => self.stop(client, drive),
            7 => self.rig.drive(drive as u8 + 1).heartbeat(&origin(client), self.rig.now),
            place => {
                let verb = Verb::ALL[place as usize - 8];
                let handle = self.rig.drive(drive as u8 + 1);
                let acted = handle.hold(
                    verb,
                    &origin(client),
                    Authority::Write,
                    (&Arrival::now(self.rig.now), self.rig.now),
                );
                self.rig.bus.command_came(self.rig.now);
                let code = acted.as_ref().map_or_else(Refusal::code, |_| verb.name());
                *self.results.entry(code).or_default() += 1;
            }
        }
    }

    fn look(&mut self) {
        let results = &mut self.results;
        let faulty = self.faulty;
        self.stops.retain_mut(|(client, placed)| {
            let Some(answer) = placed.answer() else { return true };
            let refused = matches!(answer.outcome, Outcome::Refused(_) | Outcome::QueueFull);
            assert!(!refused, "the stop of {}: {}", CLIENTS[*client], answer.outcome);
            assert!(
                faulty || answer.outcome.is_ok(),
                "the stop of {}: {}",
                CLIENTS[*client],
                answer.outcome
            );
            *results.entry("stopped").or_default() += 1;
            false
        });
        self.orders.retain_mut(|(_, _, placed)| {
            let Some(answer) = placed.answer() else { return true };
            *results.entry(answer.outcome.code()).or_default() += 1;
            false
        });
    }

    /// A reload of the bus keeps holds; after a kill only the reservations are left.
    fn restart(&mut self, killed: bool) {
        let kept = self.rig.plant.reservations(self.rig.now, self.time());
        let kept: Vec<_> = kept.into_iter().map(|(_, one)| one).collect();
        let before: Vec<_> = (0..usize::from(DRIVES)).map(|drive| self.holder(drive)).collect();
        self.rig.restart_now();
        let queue = self.rig.bus.handle.queue.clone();
        queue.set_authority(Some(self.rules.clone()));
        if killed {
            queue.set_authority(None);
            queue.set_authority(Some(self.rules.clone()));
            self.rig.plant.restore_reservations(&kept, self.rig.now, self.time());
        }
        for (drive, before) in before.into_iter().enumerate() {
            let expected = match before.0 {
                HoldState::Held if killed => (HoldState::Free, String::new()),
                _ => before,
            };
            assert_eq!(self.holder(drive), expected, "killed: {killed}");
        }
    }
}

/// Number of worlds, each of about a thousand actions: 12, or set by `make world`.
fn worlds() -> u64 {
    super::number("HOLDER_SEEDS").unwrap_or(12)
}

/// How long sixty stops by one client take while another client runs the motor.
fn stops_take(authority: bool, seed: u64) -> Duration {
    let works = works(false);
    let mut rig = Rig::new(&works, Parts::of(0, &works, seed));
    rig.bus.handle.queue.set_authority(authority.then(rules));
    let mut dice = Random::new(seed);
    rig.until("online", PATIENCE, |rig| rig.is_whole());
    let place = |rig: &mut Rig, client: usize, points: &[(&str, f64)]| {
        let order = rig.points(1, points);
        let placed = rig
            .drive(1)
            .place(OrderRequest::new(order, origin(client), Authority::Write), rig.now);
        rig.bus.command_came(rig.now);
        placed
    };
    let mut took = Duration::ZERO;
    for round in 0..60 {
        let mut start = place(&mut rig, 1, &[("run", 1.0), ("speed_reference", 11.0)]);
        let started = rig.answered(&mut start);
        assert!(started.is_ok(), "authority {authority}, {round}: {started}");
        rig.run(Duration::from_millis(dice.within(100..=900)));
        let sent = rig.now;
        let mut stop = place(&mut rig, 2, &[("run", 0.0)]);
        let stopped = rig.answered(&mut stop);
        assert!(stopped.is_ok(), "authority {authority}, {round}: {stopped}");
        took += rig.now - sent;
        rig.run(Duration::from_millis(dice.within(100..=900)));
    }
    took
}

#[test]
fn authority_delays_no_stop() {
    for seed in 0..4 {
        let [without, with] = [false, true].map(|authority| stops_take(authority, seed));
        let ratio = with.as_secs_f64() / without.as_secs_f64();
        assert!(
            (0.95..1.05).contains(&ratio),
            "seed {seed}: {without:?}, with authority {with:?}"
        );
    }
}

/// A controller that writes reference and run by turns does not start the motor that an operator stopped.
#[test]
fn a_reference_does_not_let_a_run_go_on_behind_a_stop() {
    let mut play = Play::new(0);
    play.rig.until("online", PATIENCE, |rig| rig.is_whole());
    let run = [("run", 1.0), ("speed_reference", 10.0)];
    let mut started = play.place(0, 0, &run);
    assert!(play.rig.answered(&mut started).is_ok());
    play.rig.run(SECOND);
    let mut stopped = play.place(1, 0, &[("run", 0.0)]);
    assert!(play.rig.answered(&mut stopped).is_ok());
    // After the reservation has ended.
    for _ in 0..100 {
        let mut reference = play.place(0, 0, &[("speed_reference", 10.0)]);
        play.rig.run(Duration::from_millis(50));
        let mut again = play.place(0, 0, &run);
        play.rig.run(Duration::from_millis(50));
        let _ = (reference.answer(), again.answer());
    }
    assert!(!play.rig.with_drive(1, |drive, _| drive.state().running));
    let handle = play.rig.drive(1);
    handle
        .hold(
            Verb::Take,
            &origin(0),
            Authority::Write,
            (&Arrival::now(play.rig.now), play.rig.now),
        )
        .unwrap();
    let mut taken = play.place(0, 0, &run);
    assert!(play.rig.answered(&mut taken).is_ok());
}

/// A cyclic client that repeats an acknowledged stop leaves the motor of another alone, when the hold of that has lapsed too.
#[test]
fn a_repeated_stop_of_a_cyclic_client_is_not_on_the_wire() {
    let mut play = Play::new(0);
    let mut cyclic = (*rules()).clone();
    cyclic.principals[0].cyclic = true;
    play.rig.bus.handle.queue.set_authority(Some(Arc::new(cyclic)));
    play.rig.until("online", PATIENCE, |rig| rig.is_whole());
    let mut first = play.place(0, 0, &[("run", 0.0)]);
    assert!(play.rig.answered(&mut first).is_ok());
    play.rig.run(SECOND);
    let mut started = play.place(1, 0, &[("run", 1.0), ("speed_reference", 11.0)]);
    assert!(play.rig.answered(&mut started).is_ok());
    play.rig.bus.wire.record(100_000);
    let stop = [6, 0x07, 0xD0];
    for _ in 0..100 {
        let mut again = play.place(0, 0, &[("run", 0.0)]);
        play.rig.run(Duration::from_millis(100));
        let answer = again.answer().map(|answer| answer.outcome.code());
        assert_eq!(answer, Some("held_by_other"));
    }
    assert_eq!(play.holder(0).0, HoldState::Free, "the lease has ended");
    let stops = play.rig.requests();
    let stops = stops.iter().filter(|frame| frame.bytes.get(1..4) == Some(&stop[..]));
    assert_eq!(stops.count(), 0);
    assert!(play.rig.with_drive(1, |drive, _| drive.state().running));
    // A stop after a new run counts as a new one.
    let _run = play.place(0, 0, &[("run", 1.0)]);
    let mut new = play.place(0, 0, &[("run", 0.0)]);
    assert!(play.rig.answered(&mut new).is_ok());
    play.rig.run(10 * SECOND);
    assert!(!play.rig.with_drive(1, |drive, _| drive.state().running));
}

#[test]
fn only_the_holder_is_on_the_wire_and_every_stop() {
    let mut all = BTreeMap::new();
    let mut frames = 0;
    for seed in 0..worlds() {
        let mut play = Play::new(seed);
        play.rig.until("online", PATIENCE, |rig| rig.is_whole());
        play.faulty = seed % 3 == 2;
        if play.faulty {
            let faults = "drop=0.15,corrupt=0.1,late:60ms=0.1,busy=0.1";
            play.rig.set_faults(FaultPlan::new(faults.parse().unwrap(), seed));
        }
        for round in 0..400 {
            let pause = play.dice.within(1..=180);
            play.run(Duration::from_millis(pause));
            let many = play.dice.within(1..=4);
            for _ in 0..many {
                play.act();
            }
            if round % 67 == 66 && !play.faulty {
                // Orders in progress when a bus restarts may end with any result.
                play.run(DEFAULT_EXPIRY + SECOND);
                play.look();
                let killed = play.dice.chance(0.5);
                play.restart(killed);
            }
            play.look();
        }
        play.run(10 * SECOND);
        play.look();
        assert!(play.stops.is_empty(), "a stop that nobody answers");
        for drive in 0..usize::from(DRIVES) {
            assert_eq!(play.holder(drive).0, HoldState::Free, "its lease has ended");
        }
        play.rig.plant.publish_holds(play.rig.now, play.time());
        frames += play.frames;
        for (code, count) in play.results {
            *all.entry(code).or_insert(0) += count;
        }
    }
    // Every kind of event happened.
    for code in [
        "acknowledged",
        "held_by_other",
        "needs_take",
        "guarded",
        "not_allowed",
        "stopped",
        "take",
        "break",
        "release",
    ] {
        assert!(all.get(code).is_some_and(|count| *count > 5), "{code}: {all:?}");
    }
    assert!(frames > 200, "{frames} frames; {all:?}");
}
