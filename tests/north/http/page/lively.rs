//! A plant with a history: an hour of two lines, polled by the test in virtual time, with a trip and its recording.
//! The values are equal in each run; only the times of day differ.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_core::event::{Event, EventKind};
use drivegate_core::history::assemble::assemble;
use drivegate_core::history::recorder::{Note, NoteBody};
use drivegate_core::history::{Clock, Recorder, RecorderOptions, RecorderTask, Store};
use drivegate_core::order::{self, Origin, SourceKind, Ticket};
use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{BusImage, DriveImage, Outcome, TapedFrame, TapedRead, Verdict};
use drivegate_model::drive::profile::Profiles;
use drivegate_north::NorthState;
use drivegate_proto::{Reply, crc16};

use super::super::plant::{self, STALE_AFTER};
use drivegate_model::drive::DriveIndex;

/// Length of the recorded past of the plant.
const PAST: Duration = Duration::from_secs(3900);
/// Interval at which each drive was read recently; before that, every second.
const POLL: Duration = Duration::from_millis(200);
const LATELY: Duration = Duration::from_secs(600);
/// Time before the end of the past at which pump-2 trips.
const TRIP: Duration = Duration::from_secs(75);

/// The behaviour of a drive of the plant.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Play {
    /// Runs with changing references, with that phase.
    Runs(u64),
    /// The drive runs, then trips with an overcurrent.
    Trips,
    /// The drive is ready, and its panel is the control place.
    Local,
    /// The drive answered until a minute ago.
    Gone,
}

/// Columns: name, bus, profile and behaviour.
const DRIVES: [(&str, &str, &str, Play); 7] = [
    ("pump-1", "line1", "vacon-nx", Play::Runs(0)),
    ("pump-2", "line1", "vacon-nx", Play::Trips),
    ("fan-1", "line1", "vacon-nx", Play::Local),
    ("fan-2", "line1", "vacon-nx", Play::Runs(3)),
    ("blower-1", "line2", "vacon-nx", Play::Runs(2)),
    ("blower-2", "line2", "vacon-nx", Play::Gone),
    ("mixer-1", "line2", "vacon-nx", Play::Runs(5)),
];

/// The drive images of a plant with their behaviour.
pub(super) type Cast = Vec<(Arc<DriveImage>, Play)>;

/// The plant, and the task that keeps it moving.
pub(super) struct Lively {
    pub(super) plant: Plant,
    pub(super) stats: Arc<NorthState>,
    pub(super) going_on: GoingOn,
}

/// Lets the drives continue their last behaviour, and their past with it; also owns what must live as long as the plant.
pub(super) struct GoingOn {
    buses: Vec<Arc<BusImage>>,
    cast: Cast,
    recorder: Recorder,
    _dir: tempfile::TempDir,
    _task: RecorderTask,
}

impl GoingOn {
    /// Lets all drives except the missing one answer now.
    pub(super) fn answer(&mut self) {
        let clock = Clock::read();
        answer(&self.cast, clock.now);
        for bus in &self.buses {
            poll(bus, &self.cast, PAST, clock);
            // Number of transactions that a line has in between.
            for image in &bus.drives[..2] {
                (0..33).for_each(|_| image.count(Outcome::Ok));
            }
        }
        assert!(self.recorder.tick(clock).is_empty(), "nothing happens any more");
    }
}

impl Play {
    /// Speed in percent, `t` after the beginning: ramps of 10 % a second from one reference to the next.
    fn speed(self, t: Duration) -> f64 {
        const REFERENCES: [f64; 7] = [45.0, 62.0, 62.0, 84.0, 38.0, 70.0, 0.0];
        let phase = match self {
            Play::Runs(phase) => phase,
            Play::Trips if t >= PAST - TRIP => return 0.0,
            Play::Trips => 1,
            Play::Local | Play::Gone => return 0.0,
        };
        let reference = |minute: u64| {
            REFERENCES
                .get(((minute + phase) % 7) as usize)
                .copied()
                .unwrap_or_default()
        };
        let minute = t.as_secs() / 60;
        let into = t.as_secs_f64() % 60.0;
        let (from, to) = (reference(minute + 6), reference(minute));
        from + (to - from).clamp(-10.0 * into, 10.0 * into)
    }

    /// The word at a PDU address of a Vacon NX, `t` after the beginning.
    fn word(self, address: u16, t: Duration) -> u16 {
        let speed = self.speed(t);
        let runs = speed > 0.0;
        let tripped = self == Play::Trips && t >= PAST - TRIP;
        // A hum that is equal in each run.
        let hum = ((t.as_millis() as f64 / 700.0).sin() + (t.as_millis() as f64 / 1900.0).sin()) / 2.0;
        let to_trip = (PAST - TRIP).saturating_sub(t).as_secs_f64();
        let overload = match self {
            Play::Trips if !tripped && to_trip < 4.0 => (4.0 - to_trip) * 9.0,
            _ => 0.0,
        };
        let load = if runs {
            4.0 + speed * 0.16 + hum * 0.5 + overload
        } else {
            0.0
        };
        let figure = |value: f64| value.round() as i16 as u16;
        match address {
            2100 if tripped => 0b0101_0000_1000,
            2100 if runs => 0b0101_1010_0011,
            2100 => 0b0101_0100_0001,
            2101 if self == Play::Local => 1 << 14,
            2101 => 1 << 13,
            2102 => figure(speed * 100.0),
            2103 => figure(speed * 50.0),
            2104 => figure(speed * 14.6),
            2105 => figure(load * 10.0),
            2106 => figure(load * 42.0),
            2107 => figure(load * speed * 0.4),
            2108 => figure(speed * 40.0),
            2109 => figure(560.0 - load / 4.0 + hum),
            2110 => u16::from(tripped),
            2000 => u16::from(runs || self == Play::Trips),
            2002 => figure(speed * 100.0),
            7 => figure(38.0 + speed / 9.0 + t.as_secs_f64() / 240.0),
            8 => figure(51.0 + speed / 9.0),
            101 => 5000,
            102 | 103 => 100,
            _ => 0,
        }
    }
}

impl Lively {
    pub(super) fn new() -> Lively {
        let nx = Profiles::built_in();
        let image = |address: usize, (name, bus, profile, _): (&str, &str, &str, Play)| {
            let profile = nx.get(profile).expect("built in");
            plant::drive(bus, name, address as u8, profile)
        };
        let on = |bus: &'static str| DRIVES.into_iter().filter(move |(_, of, _, _)| *of == bus);
        let buses: Vec<BusHandle> = ["line1", "line2"]
            .map(|name| plant::bus(name, (1..).zip(on(name)).map(|(at, drive)| image(at, drive)).collect()))
            .into();
        buses.iter().for_each(plant::open);
        let mut plant = plant::plant(buses);
        plant.gateway = "demo".to_string();
        let images = plant.buses.iter().flat_map(|bus| bus.image.drives.to_vec());
        let cast: Cast = images.zip(DRIVES).map(|(image, (.., play))| (image, play)).collect();
        let dir = tempfile::tempdir().expect("a directory");
        let options = RecorderOptions {
            dir: dir.path().to_path_buf(),
            before: Duration::from_secs(30),
            after: Duration::from_secs(10),
            max_bytes: 1 << 28,
            max_count: 100,
            warnings: false,
        };
        let stats = plant::stats();
        let recorder = live_through(&plant, &stats, &cast, &options);
        let task = RecorderTask::start(
            options,
            stats.recordings.clone(),
            Arc::default(),
            plant.events.clone(),
            &plant.command_log,
        );
        tell(&plant);
        let buses = plant.buses.iter().map(|bus| bus.image.clone()).collect();
        let going_on = GoingOn {
            buses,
            cast,
            recorder,
            _dir: dir,
            _task: task.expect("threads").0,
        };
        Lively { plant, stats, going_on }
    }
}

/// Adds events and commands to the past.
fn tell(plant: &Plant) {
    let ago = |seconds: u64| std::time::SystemTime::now() - Duration::from_secs(seconds);
    let events = [
        (1190, EventKind::Online, "line1", "pump-1", "drive pump-1 is online"),
        (1188, EventKind::Started, "line1", "pump-1", "drive pump-1 has started"),
        (
            640,
            EventKind::ControlPlace,
            "line1",
            "fan-1",
            "drive fan-1 is controlled from its panel",
        ),
        (300, EventKind::Warning, "line2", "mixer-1", "drive mixer-1 warns"),
        (
            290,
            EventKind::WarningEnd,
            "line2",
            "mixer-1",
            "drive mixer-1 warns no more",
        ),
        (
            75,
            EventKind::Fault,
            "line1",
            "pump-2",
            "drive pump-2 has fault 1: overcurrent",
        ),
        (75, EventKind::Stopped, "line1", "pump-2", "drive pump-2 has stopped"),
        (
            61,
            EventKind::Offline,
            "line2",
            "blower-2",
            "drive blower-2 does not answer",
        ),
    ];
    for (seconds, kind, bus, drive, text) in events {
        plant.events.publish(Event {
            bus: bus.to_string(),
            drive: Some(drive.to_string()),
            ..Event::new(kind, ago(seconds), text.to_string())
        });
    }
    for (what, outcome) in [
        ("run=true speed_reference=62", order::Outcome::TimedOut),
        ("speed_reference=84", order::Outcome::Acknowledged(Reply::Written)),
    ] {
        let origin = Origin::new(SourceKind::Mqtt, "scada");
        let at = Instant::now();
        let command_log = plant.command_log.clone();
        let (ticket, _answer) = Ticket::new(origin, "pump-2", what.to_string(), true, at, command_log);
        ticket.answer(outcome, at + Duration::from_millis(21));
    }
}

fn answer(cast: &Cast, now: Instant) {
    for (image, play) in cast.iter().filter(|(_, play)| *play != Play::Gone) {
        plant::answer(image, now, |address| play.word(address, PAST));
    }
}

/// Creates the past; returns what must be kept.
fn live_through(plant: &Plant, stats: &NorthState, cast: &Cast, options: &RecorderOptions) -> Recorder {
    let end = Clock::read();
    let begin = Clock {
        now: end.now.checked_sub(PAST).expect("the machine counts far enough back"),
        wall: end.wall - PAST,
    };
    answer(cast, end.now);
    for (image, play) in cast.iter().filter(|(_, play)| *play == Play::Gone) {
        plant::answer(image, end.now - Duration::from_secs(61), |address| {
            play.word(address, PAST)
        });
    }
    let buses: Vec<Arc<BusImage>> = plant.buses.iter().map(|bus| bus.image.clone()).collect();
    let mut recorder = Recorder::new(options.clone(), stats.history.clone());
    assert!(recorder.adopt(&buses, STALE_AFTER, begin).is_empty());
    let mut store = Store::open(options);
    let steps = (0..).map(|step| POLL * step).take_while(|t| *t <= PAST);
    for t in steps.filter(|t| *t > PAST - LATELY || t.subsec_millis() == 0) {
        let clock = Clock {
            now: begin.now + t,
            wall: begin.wall + t,
        };
        for bus in &buses {
            poll(bus, cast, t, clock);
        }
        if t == PAST - TRIP + POLL {
            let body = NoteBody::Event {
                kind: "fault",
                text: "drive pump-2 has fault 1: overcurrent".to_string(),
            };
            let at = clock.now - POLL;
            recorder.note("line1", Some("pump-2"), &Note { at, body });
        }
        for capture in recorder.tick(clock) {
            store
                .write(&mut assemble(&capture), std::time::SystemTime::now())
                .expect("room on disk");
        }
    }
    for (image, _) in cast.iter().filter(|(_, play)| *play == Play::Gone) {
        plant::silence(image);
    }
    recorder
}

/// A round of a line: all reads of each drive, the exchanges of the last two minutes with their frames.
fn poll(bus: &BusImage, cast: &Cast, t: Duration, clock: Clock) {
    let slowly = t.subsec_millis() == 0;
    for (place, image) in bus.drives.enumerate() {
        let play = cast
            .iter()
            .find(|(other, _)| Arc::ptr_eq(other, image))
            .expect("known")
            .1;
        if play == Play::Gone && t > PAST - Duration::from_secs(61) {
            if slowly {
                image.count(Outcome::Timeout);
            }
            continue;
        }
        for read in image.plan.reads.iter().filter(|read| read.start == 2100 || slowly) {
            let words: Arc<[u16]> = (0..read.count).map(|at| play.word(read.start + at, t)).collect();
            let taken = || TapedRead {
                at: clock.now,
                table: read.table,
                start: read.start,
                words: words.clone(),
            };
            bus.tape.read(place, taken);
            image.count(Outcome::Ok);
            let chance =
                (t.as_millis() as u64 / 200 * 7919 + place.place() as u64 * 104_729 + u64::from(read.start)) % 1000;
            image.set_turnaround(Duration::from_micros(
                900 + u64::from(read.count) * 60 + chance.pow(4) / 150_000_000,
            ));
            if t > PAST - Duration::from_secs(120) {
                frames(bus, place, image.spec.address, (read.start, &words), clock.now);
            }
        }
        // A line that is disturbed now and then, and one of its drives more than the others.
        let minute = t.as_secs() / 60;
        let troubled = (minute * 7919 + 31 * place.place() as u64) % 13 < place.place() as u64
            && t.as_secs() % 20 < 1 + minute % 3;
        if slowly && troubled {
            image.count(Outcome::Corrupt);
        }
    }
    if slowly {
        bus.update_health(|health| {
            let wave = (t.as_secs_f64() / 90.0).sin();
            health.load = Some(0.71 + 0.06 * wave);
            health.fast.last = Some(Duration::from_secs_f64(0.0102 + 0.0011 * wave.max(0.0)));
        });
    }
}

fn frames(bus: &BusImage, place: DriveIndex, address: u8, (start, words): (u16, &[u16]), at: Instant) {
    let request = [
        &[address, 3],
        &start.to_be_bytes()[..],
        &(words.len() as u16).to_be_bytes(),
    ]
    .concat();
    let bytes = words.iter().flat_map(|word| word.to_be_bytes());
    let reply = [address, 3, 2 * words.len() as u8].into_iter().chain(bytes).collect();
    let exchange = [(request, Verdict::Sent, 14), (reply, Verdict::Ok, 0)];
    for (mut bytes, verdict, before) in exchange {
        bytes.extend(crc16(&bytes).to_le_bytes());
        bus.tape.frame(|| TapedFrame {
            at: at - Duration::from_millis(before),
            drive: Some(place),
            verdict,
            bytes: bytes.into(),
        });
    }
}
