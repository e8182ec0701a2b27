//! The gateway listens while another master polls simulated drives: only values sent by the drive enter the image,
//! whatever happens on the line to the gateway, and nothing is sent.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_bus::listener::ListenCore;
use drivegate_bus::{BusOptions, Mode};
use drivegate_core::diagnosis::Cause;
use drivegate_core::event::{EventKind, Events};
use drivegate_core::order::{Authority, Order, Origin, Outcome, SourceKind};
use drivegate_core::plant::{BusHandle, OrderRequest, Plant};
use drivegate_core::process_image::{Access, BusImage, DriveImage, DriveSpec, Outcome as Counted};
use drivegate_line::LineOptions;
use drivegate_model::drive::{ModelPoint, Quality, Value};
use drivegate_proto::n2::Session;
use drivegate_proto::{Decoded, Exception, LineFormat, Protocol, Reply, Request, RequestPdu, Silence, Table};
use drivegate_sim::SimTime;
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::half_duplex::{HalfDuplex, LineRules};
use drivegate_sim::random::Random;
use drivegate_sim::slave::Slaves;
use drivegate_sim::statistics::Transcript;

use super::bus::{self, Parts};
use super::rig;
use super::scenario::Line;

/// Time limit of the other master for the first byte of a reply.
const PATIENCE: Duration = Duration::from_millis(100);

/// Faults of the bytes between the line and the gateway: shares of bytes.
#[derive(Debug, Clone, Copy, Default)]
struct Noise {
    garbled: f64,
    lost: f64,
    added: f64,
    /// Maximum number of bytes that are passed to the listener at once; 0 means no limit.
    lumps: usize,
}

/// Another master, its drives, and the gateway that listens.
struct Scene {
    line: Line,
    wire: HalfDuplex,
    core: ListenCore,
    handle: BusHandle,
    events: Events,
    format: LineFormat,
    began: Instant,
    now: SimTime,
    noise: Noise,
    dice: Random,
    /// The last replies of the drives to each read.
    said: BTreeMap<(u8, Table, u16, u16), VecDeque<Vec<u16>>>,
    plans: Vec<RequestPdu>,
    exchanges: u64,
    entered: u64,
}

fn listening(handle: &BusHandle) -> BusHandle {
    let image = |drive: &Arc<DriveImage>| {
        let spec = DriveSpec {
            access: Access::Listen,
            ..drive.spec.clone()
        };
        Arc::new(DriveImage::new(spec, Duration::ZERO))
    };
    let drives = handle.image.drives.iter().map(image).collect();
    let image = Arc::new(BusImage::new(handle.image.spec.clone(), drives));
    BusHandle::new(image, handle.queue.clone(), handle.command_log.clone())
}

impl Scene {
    fn new(line: Line, noise: Noise, seed: u64) -> Scene {
        let format = LineFormat::new(line.baud, line.format).unwrap();
        let parts = Parts::of(0, &line, seed);
        let began = Instant::now();
        let handle = listening(&bus::handle(
            0,
            &line,
            &parts.profile,
            format,
            (&Arc::default(), began),
            &Arc::default(),
        ));
        let mut rules = LineRules::of(line.protocol, format);
        rules.turnaround = line.turnaround;
        let slaves = Slaves::new(parts.drives, Duration::ZERO);
        let mut wire = HalfDuplex::new(rules, slaves, parts.faults, Transcript::new(0));
        wire.take_acts();
        let events = Events::default();
        let options = BusOptions {
            response_timeout: PATIENCE,
            retries: 1,
            silence: Silence::Spec,
            line: LineOptions::default(),
            allow: Vec::new(),
            mode: Mode::Listen,
        };
        let mut core = ListenCore::new(handle.clone(), &options, events.clone(), began);
        core.opened(began);
        let reads = &handle.image.drives[0].plan.reads;
        Scene {
            plans: reads.iter().map(|read| read.pdu()).collect(),
            wire,
            core,
            handle,
            events,
            format,
            began,
            now: Duration::from_millis(50),
            noise,
            dice: Random::new(seed),
            said: BTreeMap::new(),
            exchanges: 0,
            entered: 0,
            line,
        }
    }

    fn instant(&self) -> Instant {
        self.began + self.now
    }

    /// Carries bytes from the wire to the gateway, the last byte now.
    fn carry(&mut self, bytes: &[u8]) {
        let mut heard = Vec::with_capacity(bytes.len() + 2);
        for byte in bytes {
            if self.dice.chance(self.noise.lost) {
                continue;
            }
            let garbled = self.dice.chance(self.noise.garbled);
            heard.push(if garbled { self.dice.byte() } else { *byte });
            if self.dice.chance(self.noise.added) {
                heard.push(self.dice.byte());
            }
        }
        let end = self.instant();
        let lump = match self.noise.lumps {
            0 => heard.len().max(1),
            most => self.dice.within(1..=most as u64) as usize,
        };
        let count = heard.len();
        for (place, part) in heard.chunks(lump).enumerate() {
            let behind = count - (place * lump + part.len());
            self.core.on_bytes(part, end - self.format.chars(behind));
        }
    }

    /// A transaction of the other master with `tries` attempts; returns the reply that it accepted.
    fn ask(&mut self, address: u8, pdu: &RequestPdu, tries: u32) -> Option<Reply> {
        (0..tries).find_map(|_| self.try_once(address, pdu))
    }

    fn try_once(&mut self, address: u8, pdu: &RequestPdu) -> Option<Reply> {
        let before = self.times();
        let n2 = self.handle.image.drives[0].spec.profile.n2;
        let request = Request {
            address,
            pdu: pdu.clone(),
            n2,
        };
        let mut frame = Vec::new();
        self.line.protocol.encode(&request, &mut frame);
        self.wire.on_bytes(&frame, self.now);
        self.now += self.format.chars(frame.len());
        self.carry(&frame);
        let limit = self.now + PATIENCE + self.format.chars(self.line.protocol.reply_chars(pdu));
        let (mut reply, mut taken) = (Vec::new(), None);
        while taken.is_none()
            && let Some(wake) = self.wire.wake().filter(|wake| wake.at <= limit)
        {
            self.now = self.now.max(wake.at);
            self.wire.on_time(self.now);
            let mut out = Vec::new();
            self.wire.take_due(self.now, &mut out);
            if !out.is_empty() {
                self.note(&request);
                self.carry(&out);
                reply.extend(out);
                if let Decoded::Reply { reply, .. } = self.line.protocol.decode(&request, &reply) {
                    taken = Some(reply);
                }
            }
        }
        self.note(&request);
        if taken.is_none() {
            self.now = self.now.max(limit);
        }
        let silence = self.line.protocol.silence(Silence::Spec, &self.format);
        self.now += silence + Duration::from_micros(self.dice.within(0..=2000));
        self.core.on_time(self.instant());
        self.exchanges += 1;
        self.check(address, pdu, &before);
        taken
    }

    /// Records the answers of the drives since the last call.
    fn note(&mut self, request: &Request) {
        for act in self.wire.take_acts() {
            let RequestPdu::Read { table, start, count } = request.pdu else {
                continue;
            };
            if let Decoded::Reply { reply, .. } = self.line.protocol.decode(request, &act.reply)
                && let Some(words) = reply.words()
            {
                let said = self.said.entry((act.address, table, start, count)).or_default();
                said.push_back(words);
                if said.len() > 3 {
                    said.pop_front();
                }
            }
        }
    }

    /// When each register of each drive was read last.
    fn times(&self) -> Vec<Option<Instant>> {
        let drives = self.handle.image.drives.iter();
        let of = |drive: &Arc<DriveImage>| -> Vec<Option<Instant>> {
            let snapshot = drive.snapshot();
            let places = places(drive);
            places
                .map(|(table, address)| snapshot.read_at(table, address))
                .collect()
        };
        drives.flat_map(of).collect()
    }

    /// Checks that every change in the image is a value that the drive sent in answer to this request.
    fn check(&mut self, address: u8, pdu: &RequestPdu, before: &[Option<Instant>]) {
        let after = self.times();
        let drives = self.handle.image.drives.iter();
        let all = drives.flat_map(|drive| places(drive).map(move |place| (drive, place)));
        let mut changed = Vec::new();
        for (((drive, (table, at)), before), after) in all.zip(before).zip(&after) {
            if before != after {
                changed.push((drive.clone(), table, at));
            }
        }
        self.entered += u64::from(!changed.is_empty());
        let Some((first, _, _)) = changed.first() else { return };
        let RequestPdu::Read { table, start, count } = *pdu else {
            panic!("{pdu:?} of {address} changed {changed:?}");
        };
        assert_eq!(first.spec.address, address);
        let said = self.said.get(&(address, table, start, count)).expect("a reply");
        let shown: BTreeMap<u16, u16> = changed
            .iter()
            .map(|(drive, of, at)| {
                let is_same = *of == table || drive.spec.profile.input_is_holding;
                assert!(drive.spec.address == address && is_same, "{address} {of}");
                (*at, drive.snapshot().word(*of, *at).unwrap())
            })
            .collect();
        let is = |words: &VecDeque<Vec<u16>>| {
            words.iter().any(|words| {
                shown.iter().all(|(at, word)| {
                    let place = at.checked_sub(start).map(usize::from);
                    place.and_then(|place| words.get(place)) == Some(word)
                })
            })
        };
        assert!(
            is(said),
            "{address} {pdu:?}: the drive said {said:?}, the image has {shown:?}"
        );
    }

    /// Lets the other master run its cycle for this number of transactions.
    fn cycles(&mut self, exchanges: u64) {
        let end = self.exchanges + exchanges;
        let n2 = self.line.protocol == Protocol::N2;
        let addresses: Vec<u8> = self
            .handle
            .image
            .drives
            .iter()
            .map(|drive| drive.spec.address)
            .collect();
        let mut round = 0;
        while self.exchanges < end {
            for address in &addresses {
                if n2 && round % 50 == 0 {
                    self.ask(*address, &RequestPdu::N2(Session::Identify), 2);
                    self.ask(*address, &RequestPdu::N2(Session::Poll { again: false }), 1);
                }
                for pdu in self.plans.clone() {
                    self.ask(*address, &pdu, 2);
                }
                self.command(*address, round);
            }
            round += 1;
        }
    }

    /// Commands a drive from time to time, so that the values read from it change.
    fn command(&mut self, address: u8, round: u64) {
        if round % 20 != 7 {
            return;
        }
        let drive = self.handle.image.drives[0].clone();
        let profile = &drive.spec.profile;
        let Some(raw) = profile
            .model_point(ModelPoint::SpeedReference)
            .and_then(|point| point.raw())
        else {
            return;
        };
        let percent = self.dice.within(0..=100) as f64;
        let Ok(words) = raw.encode(Value::Number(percent), 0) else {
            return;
        };
        let pdu = match words.as_slice() {
            [value] => RequestPdu::WriteRegister {
                address: raw.address,
                value: *value,
            },
            _ => RequestPdu::WriteRegisters {
                start: raw.address,
                values: words,
            },
        };
        self.ask(address, &pdu, 1);
    }

    fn counted(&self, outcome: Counted) -> u64 {
        self.handle
            .image
            .drives
            .iter()
            .map(|drive| drive.counted(outcome))
            .sum()
    }
}

fn places(drive: &Arc<DriveImage>) -> impl Iterator<Item = (Table, u16)> + '_ {
    let reads = drive.plan.reads.iter();
    reads.flat_map(|read| {
        (read.start..)
            .take(usize::from(read.count))
            .map(|address| (read.table, address))
    })
}

/// Lines of every protocol, with the exchanges that each has of 100,000.
const LINES: [(&str, Protocol, u32, u64); 8] = [
    ("vacon-nx", Protocol::ModbusRtu, 9600, 15_000),
    ("vacon-nx", Protocol::ModbusRtu, 38_400, 15_000),
    ("vacon-nx", Protocol::ModbusRtu, 115_200, 20_000),
    ("vacon-cx", Protocol::ModbusRtu, 19_200, 10_000),
    ("teco-7300pa", Protocol::ModbusRtu, 57_600, 10_000),
    ("teco-7300pa", Protocol::ModbusAscii, 9600, 10_000),
    ("vacon-nx-n2", Protocol::N2, 9600, 10_000),
    ("teco-7300pa-n2", Protocol::N2, 9600, 10_000),
];

fn scene(family: &'static str, protocol: Protocol, baud: u32, noise: Noise) -> Scene {
    Scene::new(
        rig::line(family, protocol, baud, 3),
        noise,
        u64::from(baud) + family.len() as u64,
    )
}

#[test]
fn every_value_is_what_the_drive_said() {
    let mut all = 0;
    for (family, protocol, baud, exchanges) in LINES {
        for lumps in [0, 16] {
            let noise = Noise {
                lumps,
                ..Noise::default()
            };
            let mut scene = scene(family, protocol, baud, noise);
            scene.cycles(exchanges / 2);
            let what = format!("{family} {baud}");
            let answered = scene.counted(Counted::Ok) + scene.counted(Counted::Exception);
            // The last one may still be open.
            assert!(
                answered + 1 >= scene.exchanges,
                "{what}: {answered} of {}",
                scene.exchanges
            );
            assert!(
                scene.entered * 100 >= scene.exchanges * 85,
                "{what}: {} entered",
                scene.entered
            );
            assert_eq!(scene.handle.image.online(), 3, "{what}");
            for drive in &scene.handle.image.drives {
                let reading = drive.reading(scene.instant(), Duration::from_secs(1));
                assert_eq!(reading.overall(), Quality::Good, "{what}");
            }
            all += scene.exchanges;
        }
    }
    assert!(all >= 100_000, "{all}");
}

#[test]
fn one_percent_of_garbled_bytes_makes_no_wrong_value() {
    let noises = [
        (0.01, 0.0, 0.0),
        (0.0, 0.01, 0.0),
        (0.0, 0.0, 0.01),
        (0.004, 0.003, 0.003),
    ];
    for (family, protocol, baud, exchanges) in LINES {
        for (garbled, lost, added) in noises {
            let noise = Noise {
                garbled,
                lost,
                added,
                lumps: 16,
            };
            let mut scene = scene(family, protocol, baud, noise);
            scene.cycles(exchanges / 4);
            let share = scene.entered as f64 / scene.exchanges as f64;
            assert!(share > 0.2, "{family} {baud} {noise:?}: {share}");
        }
    }
}

#[test]
fn late_lost_doubled_and_foreign_replies_make_no_wrong_value() {
    for (family, protocol, baud) in [
        ("vacon-nx", Protocol::ModbusRtu, 38_400),
        ("teco-7300pa", Protocol::ModbusAscii, 9600),
        ("vacon-nx-n2", Protocol::N2, 9600),
    ] {
        let mut line = rig::line(family, protocol, baud, 3);
        line.faults =
            "drop=0.01,truncate=0.01,corrupt=0.02,late:150ms=0.01,late:400ms=0.01,noise-before=0.01,deaf=0.01"
                .to_string();
        line.dead = vec![3];
        let mut scene = Scene::new(line, Noise::default(), 11);
        scene.cycles(5000);
        assert!(scene.entered > 300, "{family}: {}", scene.entered);
        assert!(!scene.handle.image.drives[2].snapshot().link.is_online(), "{family}");
    }
}

#[test]
fn values_are_good_while_the_other_master_reads_them() {
    let mut scene = scene("vacon-nx", Protocol::ModbusRtu, 38_400, Noise::default());
    let drive = scene.handle.image.drives[0].clone();
    let stale_after = Duration::from_secs(1);
    let fast = scene.plans[0].clone();
    // A value polled once in ten seconds is good in between, as soon as its interval is known.
    for _ in 0..6 {
        scene.ask(1, &fast, 1);
        scene.now += Duration::from_secs(10);
        scene.core.on_time(scene.instant());
    }
    let quality = |scene: &Scene| drive.reading(scene.instant(), stale_after).overall();
    assert_eq!(quality(&scene), Quality::Good);
    assert!(drive.snapshot().link.is_online());
    // The other master stops polling.
    scene.now += Duration::from_secs(40);
    scene.core.on_time(scene.instant());
    assert_eq!(quality(&scene), Quality::Stale);
    assert!(!drive.snapshot().link.is_online());
    scene.ask(1, &fast, 1);
    assert!(drive.snapshot().link.is_online());
}

#[test]
fn commands_of_the_other_master_are_told_when_they_change() {
    let mut scene = scene("vacon-nx", Protocol::ModbusRtu, 38_400, Noise::default());
    let run = |word: u16, reference: u16| RequestPdu::WriteRegisters {
        start: 2000,
        values: vec![word, 0, reference],
    };
    // The other master repeats its words a hundred times, then stops the drive.
    for _ in 0..100 {
        scene.ask(1, &run(1, 5000), 1);
    }
    scene.ask(1, &run(0, 5000), 1);
    let told = |scene: &Scene| -> Vec<String> {
        let events = scene.events.recent();
        let foreign = events.iter().filter(|event| event.kind == EventKind::ForeignCommand);
        foreign.map(|event| event.text.clone()).collect()
    };
    let texts = told(&scene);
    assert_eq!(texts.len(), 2, "{texts:?}");
    assert!(
        texts[0].contains("run=true") && texts[0].contains("speed_reference=50"),
        "{texts:?}"
    );
    assert!(texts[1].contains("run=false"), "{texts:?}");
    let audited = scene.handle.command_log.audit().recent(None);
    assert_eq!(audited.len(), 2);
    assert!(audited[0].contains(r#""source":"other_master""#) && audited[0].contains(r#""result":"acknowledged""#));
    assert!(
        audited[1].contains(r#""points":[{"point":"run","old":true,"new":false}]"#),
        "{}",
        audited[1]
    );
    // A reference that moves in every cycle is reported once a second.
    for step in 0..600 {
        scene.ask(1, &run(0, 1000 + step), 1);
        scene.now += Duration::from_millis(5);
        scene.core.on_time(scene.instant());
    }
    scene.now += Duration::from_secs(2);
    scene.core.on_time(scene.instant());
    let texts = told(&scene);
    let seconds = scene.now.as_secs() as usize;
    assert!((4..=seconds + 3).contains(&texts.len()), "{texts:?}");
    assert!(texts.last().unwrap().contains("speed_reference=15.99"), "{texts:?}");
}

#[test]
fn drives_come_and_go_with_what_is_heard() {
    let mut line = rig::line("vacon-nx", Protocol::ModbusRtu, 38_400, 2);
    line.dead = vec![2];
    let mut scene = Scene::new(line, Noise::default(), 5);
    let fast = scene.plans[0].clone();
    scene.ask(1, &fast, 2);
    scene.ask(2, &fast, 3);
    scene.ask(1, &fast, 2);
    let online = |scene: &Scene, drive: usize| scene.handle.image.drives[drive].snapshot().link.is_online();
    assert!(online(&scene, 0) && !online(&scene, 1));
    // Two requests in a row get no answer.
    scene.wire.slaves().drive(1).unwrap().set_alive(false);
    scene.ask(1, &fast, 3);
    scene.ask(2, &fast, 1);
    assert!(!online(&scene, 0));
    let texts: Vec<String> = scene.events.recent().iter().map(|event| event.text.clone()).collect();
    assert!(texts.iter().any(|text| text.contains("unanswered")), "{texts:?}");
}

#[test]
fn whatever_clients_try_nothing_goes_out_for_an_hour() {
    let mut scene = scene("vacon-nx", Protocol::ModbusRtu, 38_400, Noise::default());
    scene.cycles(50);
    let plant = Plant {
        gateway: "world".to_string(),
        stale_after: Duration::from_secs(1),
        buses: vec![scene.handle.clone()],
        events: scene.events.clone(),
        command_log: scene.handle.command_log.clone(),
    };
    let profile = scene.handle.image.drives[0].spec.profile.clone();
    let index = |point: ModelPoint| profile.model_index(point).unwrap();
    let read = RequestPdu::Read {
        table: Table::Holding,
        start: 5000,
        count: 1,
    };
    let orders = [
        Order::Points(vec![(index(ModelPoint::Run), Value::Bool(false))]),
        Order::Points(vec![(index(ModelPoint::Run), Value::Bool(true))]),
        Order::Points(vec![(index(ModelPoint::SpeedReference), Value::Number(30.0))]),
        Order::Points(vec![(index(ModelPoint::FaultReset), Value::Bool(true))]),
        Order::Write(RequestPdu::WriteRegister {
            address: 2000,
            value: 0,
        }),
        Order::Write(RequestPdu::WriteRegisters {
            start: 101,
            values: vec![7],
        }),
        Order::Read(read),
    ];
    let kinds = [SourceKind::ModbusTcp, SourceKind::Mqtt, SourceKind::LocalSocket];
    let (before, end) = (scene.wire.statistics(), scene.now + Duration::from_secs(3600));
    let mut tried = 0;
    while scene.now < end {
        let order = orders[tried % orders.len()].clone();
        let is_read = matches!(order, Order::Read(_));
        let origin = Origin::new(kinds[tried % kinds.len()], "a client");
        let drive = plant.drives().nth(tried % 3).unwrap();
        let now = scene.instant();
        let mut placed = drive.place(OrderRequest::new(order, origin, Authority::Write), now);
        let answer = placed.answer().expect("at once");
        let exception = if is_read {
            Exception::ADDRESS
        } else {
            Exception::FUNCTION
        };
        assert!(matches!(&answer.outcome, Outcome::Refused(_)), "{answer:?}");
        assert_eq!(answer.outcome.exception(), Some(exception));
        assert!(
            answer.outcome.to_string().contains("mode = \"listen\""),
            "{}",
            answer.outcome
        );
        assert!(scene.handle.queue.lock().is_empty());
        scene.core.on_time(now);
        scene.now += Duration::from_millis(500);
        tried += 1;
    }
    // The core has no way to send; the only bytes on the line are those of the other master.
    assert_eq!((scene.wire.statistics().bytes_in, tried), (before.bytes_in, 7200));
}

/// Verdicts about a line that another master polls, after a minute and a half.
fn verdicts(line: Line, faults: FaultPlan) -> Vec<Cause> {
    let mut scene = Scene::new(line, Noise::default(), 7);
    scene.wire.set_faults(faults);
    while scene.now < Duration::from_secs(90) {
        scene.cycles(20);
    }
    let diagnosis = scene.handle.image.diagnosis.load();
    assert!(diagnosis.at.is_some());
    diagnosis.verdicts.iter().map(|verdict| verdict.verdict).collect()
}

#[test]
fn what_is_wrong_with_a_line_shows_to_a_listener() {
    let plan = |rates: &str| FaultPlan::new(rates.parse().unwrap(), 3);
    for (family, protocol, baud) in [
        ("vacon-nx", Protocol::ModbusRtu, 38_400),
        ("teco-7300pa", Protocol::ModbusAscii, 19_200),
        ("vacon-nx-n2", Protocol::N2, 9600),
    ] {
        let line = || rig::line(family, protocol, baud, 4);
        assert_eq!(verdicts(line(), plan("")), [], "{family}");
        let bad = plan("corrupt=0.15,drop=0.15").only(&[2]);
        assert_eq!(verdicts(line(), bad), [Cause::OneDrive], "{family}");
        assert_eq!(
            verdicts(line(), plan("reply-start=0.2")),
            [Cause::ReplyStartLost],
            "{family}"
        );
    }
}
