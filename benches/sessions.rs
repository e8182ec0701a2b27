//! Many gateways' sessions with a broker in one process: the real MQTT and Sparkplug clients, each with a plant of its own.
//!
//! `tests/fleet/thousand.py` starts it: `cargo bench --bench sessions -- --port 8883 --sessions 900 --drives 10 --ca ca.crt --dir DIR`.
//! `--cycle` (s): each drive has new values so often; `--min-interval` (s) as in `[mqtt.publish]`; `--primary` is the id of the
//! host that births wait for. Ends with its standard input.

mod common;

use std::error::Error;
use std::io::Read;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate::codec::{LineFormat, Protocol, Table};
use drivegate::command::CommandQueue;
use drivegate::drive::profile::Profiles;
use drivegate::north::NorthState;
use drivegate::north::mqtt::{self, History, Options, Qos, Telemetry, sparkplug};
use drivegate::plant::{BusHandle, Plant};
use drivegate::process_image::{BusImage, BusSpec, DriveImage, DriveSpec, Link};
use tokio_util::sync::CancellationToken;

use common::option;

/// First number of the sessions: the names of those before are taken by processes.
const FIRST: usize = 1000;

fn main() -> ExitCode {
    common::exit(run())
}

fn run() -> Result<(), Box<dyn Error>> {
    if option("--port", 0u16)? == 0 {
        println!("measured by `make fleet-thousand`");
        return Ok(());
    }
    let sessions: usize = option("--sessions", 900)?;
    let drives: u16 = option("--drives", 10)?;
    let cycle = Duration::from_secs_f64(option("--cycle", 10.0)?);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    let guard = runtime.enter();
    let cancel = CancellationToken::new();
    let (mut plants, mut all) = (Vec::new(), Vec::new());
    for number in 0..sessions {
        let name = format!("site-{:04}", FIRST + number);
        let plant = Arc::new(plant(&name, drives)?);
        let shared = Arc::new(ArcSwap::from(plant.clone()));
        let stats = Arc::<NorthState>::default();
        all.push((
            mqtt::start(options(&name)?, shared, stats.clone(), cancel.clone()),
            stats,
        ));
        plants.push(plant);
    }
    drop(guard);
    let end = Arc::new(AtomicBool::new(false));
    let ended = end.clone();
    let poller = std::thread::spawn(move || poll(&plants, cycle, &ended));
    println!("started");
    std::io::stdin().read_to_end(&mut Vec::new())?;
    end.store(true, Ordering::Relaxed);
    poller.join().map_err(|_| "the poller failed")?;
    cancel.cancel();
    let losses = all.iter().flat_map(|(_, stats)| stats.mqtt.losses());
    let lost: u64 = losses.map(|(_, count)| count).sum();
    for (mqtt, _) in all {
        runtime.block_on(mqtt.stopped());
    }
    println!("lost: {lost}");
    Ok(())
}

fn options(name: &str) -> Result<Options, Box<dyn Error>> {
    let ca: String = option("--ca", String::new())?;
    let dir = PathBuf::from(option("--dir", ".".to_string())?).join(name);
    std::fs::create_dir_all(&dir)?;
    Ok(Options {
        brokers: vec![mqtt::Broker {
            host: "localhost".to_string(),
            port: option("--port", 8883)?,
        }],
        tls: !ca.is_empty(),
        client_id: format!("drivegate-{name}"),
        username: None,
        password: None,
        ca: (!ca.is_empty()).then(|| PathBuf::from(ca)),
        identity: None,
        base: "drivegate".to_string(),
        telemetry: Telemetry {
            state: true,
            points: false,
            history: History::Off,
        },
        telemetry_qos: Qos::AtMostOnce,
        event_qos: Qos::AtLeastOnce,
        expiry: Some(Duration::from_secs(300)),
        message_expiry: Some(Duration::from_secs(600)),
        min_interval: Duration::from_secs_f64(option("--min-interval", 0.05)?),
        max_interval: Duration::from_secs(60),
        commands: true,
        require_id: false,
        response_topics: Vec::new(),
        buffer: None,
        home_assistant: None,
        principals: None,
        sparkplug: Some(sparkplug::Options {
            group: "fleet".to_string(),
            node: name.to_string(),
            primary_host: option("--primary", String::new())?,
            alias: true,
            history: true,
            state_dir: dir,
        }),
    })
}

fn plant(name: &str, drives: u16) -> Result<Plant, Box<dyn Error>> {
    let profile = Profiles::built_in().get("vacon-nx").ok_or("no profile")?.clone();
    let image = |n: u16| {
        let spec = DriveSpec::new(&format!("d{n}"), "line", n as u8, profile.clone());
        Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
    };
    let spec = BusSpec {
        name: "line".to_string(),
        port: "/dev/null".to_string(),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(115_200, "8N1")?,
        cycle: Duration::from_millis(10),
        slow_cycle: Duration::from_secs(1),
    };
    let bus = BusHandle {
        image: Arc::new(BusImage::new(spec, (1..=drives).map(image).collect())),
        queue: Arc::new(CommandQueue::new()?),
    };
    bus.image.update_health(|health| health.up = true);
    Ok(Plant {
        gateway: name.to_string(),
        stale_after: Duration::from_secs(60),
        buses: vec![bus],
        events: Default::default(),
        writes: Default::default(),
        stop_all: Arc::default(),
        drills: Arc::default(),
    })
}

/// Updates each drive once a cycle, evenly spread, until the end.
fn poll(plants: &[Arc<Plant>], cycle: Duration, end: &AtomicBool) {
    let drives: Vec<_> = plants
        .iter()
        .flat_map(|plant| plant.drives().map(|drive| drive.image).collect::<Vec<_>>())
        .collect();
    let Ok(count) = u32::try_from(drives.len()) else { return };
    let (step, mut next) = (cycle / count.max(1), Instant::now());
    for (turn, drive) in drives.iter().cycle().enumerate() {
        if end.load(Ordering::Relaxed) {
            return;
        }
        let value = (turn / drives.len() % 50_000) as u16;
        let now = Instant::now();
        drive.update(|snapshot| {
            snapshot.link = Link::Online(SystemTime::UNIX_EPOCH);
            snapshot.fast_at = Some(now);
            let words = [0x0023, 0, value, value, value, 12, 300, 280, 2300, 540, 0];
            snapshot.store(Table::Holding, 2100, &words, now);
        });
        next += step;
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
}
