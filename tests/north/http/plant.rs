//! A plant that the test sets up: no bus runs, and the test fills the process images.

use std::fmt::Write as _;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_core::diagnosis::{Cause, Certainty, Counted, Diagnosis, Verdict};
use drivegate_core::event::{Event, EventKind};
use drivegate_core::order;
use drivegate_core::plant::{BusHandle, Plant, SharedPlant};
use drivegate_core::process_image::{DriveImage, DriveSpec, LeaseAction, Link, Outcome, PollCycle, Supervision};
use drivegate_http::{Http, Options};
use drivegate_model::drive::model::Kind;
use drivegate_model::drive::{ModelPoint, Profile};
use drivegate_north::{NorthState, SlotOutcome};
use drivegate_north::{Reconfigure as _, Server as _};
use drivegate_proto::{Exception, Table};
use drivegate_testkit::{bus_spec, image, monitored, profile, read_all, ticket};
use tokio_util::sync::CancellationToken;

pub(crate) use drivegate_testkit::nx;

pub(crate) const STALE_AFTER: Duration = Duration::from_secs(60);

/// A family that has every point of the model, and one point of its own.
pub(crate) fn everything() -> Arc<Profile> {
    let mut text = "name = \"everything\"\nprotocols = [\"modbus-rtu\"]\n\
        [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 99\nread = 50\n"
        .to_string();
    for (address, point) in ModelPoint::ALL.iter().enumerate() {
        let name = point.name();
        if *point == ModelPoint::FrequencyReference {
            text += "[[point]]\nname = \"frequency_reference\"\nderive = \"band\"\nof = \"speed_reference\"\n\
                minimum = \"minimum_frequency\"\nmaximum = \"maximum_frequency\"\n";
            continue;
        }
        let bit = if point.kind() == Kind::Bool { ".0" } else { "" };
        writeln!(
            text,
            "[[point]]\nname = \"{name}\"\nat = \"holding {address}{bit}\"\nclass = \"fast\""
        )
        .unwrap();
    }
    for (name, address) in [("minimum_frequency", 40), ("maximum_frequency", 41)] {
        writeln!(
            text,
            "[[point]]\nname = \"{name}\"\nat = \"holding {address}\"\nunit = \"Hz\"\nclass = \"once\""
        )
        .unwrap();
    }
    text += "[faults]\n7 = \"saturation trip\"\n";
    Arc::new(Profile::parse("everything.toml", &text, false).expect("a valid profile"))
}

/// The words of the NX family that run at 25 Hz, by PDU address.
pub(crate) fn nx_running(address: u16) -> u16 {
    match address {
        2100 => 0b0010_0011,
        2101 => 1 << 13,
        2102 => 5000,
        2103 => 2500,
        2104 => 1450,
        2105 => 42,
        2106 => 318,
        2107 => 155,
        2108 => 2001,
        2109 => 560,
        2000 => 1,
        2002 => 5000,
        7 => 41,
        8 => 37,
        101 => 5000,
        102 | 103 => 30,
        _ => 0,
    }
}

/// A running NX drive with fault 7.
pub(crate) fn nx_faulted(address: u16) -> u16 {
    match address {
        2100 => 0b1001_1000,
        2102..=2108 => 0,
        2110 => 7,
        other => nx_running(other),
    }
}

pub(crate) fn drive(bus: &str, name: &str, address: u8, profile: &Arc<Profile>) -> Arc<DriveImage> {
    image(monitored(name, bus, address, profile))
}

/// A drive with a lease.
pub(crate) fn supervised(bus: &str, name: &str, address: u8, profile: &Arc<Profile>) -> Arc<DriveImage> {
    image(DriveSpec {
        supervision: Some(Supervision {
            timeout: STALE_AFTER,
            action: LeaseAction::LeaveRunning,
            adopt: false,
        }),
        ..monitored(name, bus, address, profile)
    })
}

pub(crate) fn bus(name: &str, drives: Vec<Arc<DriveImage>>) -> BusHandle {
    drivegate_testkit::bus(bus_spec(name), drives)
}

/// Makes the drive online, with all its points read at `at`.
pub(crate) fn answer(image: &DriveImage, at: Instant, word: impl Fn(u16) -> u16) {
    read_all(image, at, word);
    image.count(Outcome::Ok);
    image.set_turnaround(Duration::from_micros(1900));
}

/// The drive does not answer any more.
pub(crate) fn silence(image: &DriveImage) {
    image.update(|snapshot| snapshot.link = Link::Offline(SystemTime::now()));
    image.count(Outcome::Timeout);
}

/// The port of the bus is open, and rounds were run.
pub(crate) fn open(bus: &BusHandle) {
    bus.image.update_health(|health| {
        health.up = true;
        health.tried = true;
        health.since = Some(SystemTime::now());
        health.load = Some(0.4375);
        health.opened += 1;
        let cycle = |ms, rounds| PollCycle {
            last: Some(Duration::from_micros(ms)),
            rounds,
        };
        health.fast = cycle(12_500, 800);
        health.slow = cycle(1_000_000, 10);
    });
    bus.image.transactions.observe(Duration::from_millis(9));
    bus.image.fast_cycles.observe(Duration::from_micros(12_500));
    bus.image.slow_cycles.observe(Duration::from_secs(1));
}

pub(crate) fn plant(buses: Vec<BusHandle>) -> Plant {
    Plant::new("pump-house", STALE_AFTER, buses)
}

pub(crate) fn event(kind: EventKind, drive: &str, text: &str) -> Event {
    Event {
        bus: "line1".to_string(),
        drive: Some(drive.to_string()),
        fault_code: (kind == EventKind::Fault).then_some(7),
        ..Event::new(kind, SystemTime::now(), text.to_string())
    }
}

/// A plant with every situation: `pump-1` runs, `fan-2` is offline with old values, `mixer-3` was never tried,
/// `saw-4` has a fault on a separate bus.
pub(crate) fn mixed() -> Plant {
    let nx = nx();
    let drives = vec![
        drive("line1", "pump-1", 1, &nx),
        drive("line1", "fan-2", 2, &nx),
        drive("line1", "mixer-3", 3, &nx),
    ];
    let now = Instant::now();
    answer(&drives[0], now, nx_running);
    answer(&drives[1], now, nx_running);
    silence(&drives[1]);
    let saw = drive("line2", "saw-4", 4, &nx);
    answer(&saw, now, nx_faulted);
    let buses = vec![bus("line1", drives), bus("line2", vec![saw])];
    buses.iter().for_each(open);
    plant(buses)
}

/// A drive that answers, is ready and without a fault, but refuses to report whether it runs.
pub(crate) fn secretive() -> Arc<DriveImage> {
    let image = drive("line1", "fan-1", 1, &profile("vacon-cx"));
    answer(&image, Instant::now(), |address| u16::from(address == 1));
    image.update(|s| s.refuse(Table::DiscreteInput, 2, 1, Exception::ADDRESS));
    image
}

/// Adds a command that was answered.
pub(crate) fn count_a_write(plant: &Plant) {
    let (ticket, _answer) = ticket(&plant.command_log, Instant::now());
    ticket.answer(order::Outcome::TimedOut, Instant::now() + Duration::from_millis(20));
}

/// Figures of all servers.
pub(crate) fn stats() -> Arc<NorthState> {
    let stats = NorthState::default();
    stats.slots.count("line1", SlotOutcome::Answered);
    stats.modbus_tcp.connected();
    stats.modbus_tcp.answered(3, 0);
    stats.modbus_tcp.answered(6, 1);
    stats.mqtt.configured.store(true, Ordering::Relaxed);
    stats.mqtt.connected.store(true, Ordering::Relaxed);
    stats.mqtt.published.store(17, Ordering::Relaxed);
    stats.mqtt.buffered.store(2, Ordering::Relaxed);
    Arc::new(stats)
}

/// A server with its plant.
pub(crate) struct Server {
    pub(crate) shared: SharedPlant,
    pub(crate) stats: Arc<NorthState>,
    pub(crate) cancel: CancellationToken,
    pub(crate) address: SocketAddr,
    pub(crate) http: Http,
}

impl Server {
    pub(crate) async fn of(plant: Plant) -> Server {
        Server::showing(plant, stats()).await
    }

    /// A server with these recorded figures.
    pub(crate) async fn showing(plant: Plant, stats: Arc<NorthState>) -> Server {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        Server::start(plant, stats, Options::listening_on(listen)).await
    }

    pub(crate) async fn with(plant: Plant, options: Options) -> Server {
        Server::start(plant, stats(), options).await
    }

    async fn start(plant: Plant, stats: Arc<NorthState>, options: Options) -> Server {
        let shared: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
        let cancel = CancellationToken::new();
        let http = drivegate_http::Http::start(options, shared.clone(), stats.clone(), cancel.clone())
            .await
            .expect("it starts");
        Server {
            shared,
            stats,
            cancel,
            address: http.address().expect("an address"),
            http,
        }
    }

    /// Reloads the server with other options.
    pub(crate) async fn reload(&mut self, options: Options) {
        let change = self.http.prepare(options).await.expect("it is possible");
        self.http.commit(change);
    }

    pub(crate) fn plant(&self) -> Arc<Plant> {
        self.shared.load_full()
    }

    /// The image of the drive with this name, which must exist.
    pub(crate) fn image(&self, name: &str) -> Arc<DriveImage> {
        self.plant().drive(name).expect("a drive").image
    }
}

/// The table of all words in the hand-made drives.
pub(crate) const HOLDING: Table = Table::Holding;

/// A verdict about the line of a bus.
pub(crate) fn diagnose(bus: &BusHandle) {
    let verdict = Verdict {
        verdict: Cause::OneDrive,
        drive: Some(bus.image.drives[0].spec.name.clone()),
        certainty: Certainty::Likely,
        meaning: Cause::OneDrive.meaning().to_string(),
        evidence: "7 of 90 exchanges failed".to_string(),
        remedy: Cause::OneDrive.remedy().to_string(),
        steps: vec!["vacon-nx: green LED (FS) steady: the board has seen no message yet".to_string()],
        since: "2026-03-02T06:11:09.480Z".to_string(),
    };
    let counted = |drive: &Arc<DriveImage>| Counted {
        by_drive: None,
        drive: drive.spec.name.clone(),
        ..Counted::default()
    };
    bus.image.diagnosis.store(Arc::new(Diagnosis {
        at: Some(SystemTime::UNIX_EPOCH),
        verdicts: vec![verdict],
        wrong_address: 0,
        drives: bus.image.drives.iter().map(counted).collect(),
    }));
}
