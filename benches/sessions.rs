//! Sessions of many gateways with a broker in one process: the real MQTT and Sparkplug clients, each with a separate plant.
//!
//! `tests/fleet/thousand.py` starts this bench: `cargo bench --bench sessions -- --port 8883 --sessions 900
//! --drives 10 --ca ca.crt --dir DIR`. `--cycle` (s): interval of new values of each drive; `--min-interval` (s) as
//! in `[mqtt.publish]`; `--primary` is the id of the host that births wait for. Ends with its standard input.

mod common;

use std::error::Error;
use std::io::Read;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use arc_swap::ArcSwap;
use drivegate_mqtt::{Options, sparkplug};
use drivegate_north::{NorthState, Server as _};
use tokio_util::sync::CancellationToken;

use common::{option, session};

/// First number of the sessions: the names with lower numbers are used by real processes.
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
        let plant = Arc::new(session::plant(&name, drives)?);
        let shared = Arc::new(ArcSwap::from(plant.clone()));
        let stats = Arc::<NorthState>::default();
        all.push((
            drivegate_mqtt::start(options(&name)?, shared, stats.clone(), cancel.clone()),
            stats,
        ));
        plants.push(plant);
    }
    drop(guard);
    let end = Arc::new(AtomicBool::new(false));
    let ended = end.clone();
    let poller = std::thread::spawn(move || session::poll(&plants, cycle, &ended));
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
        tls: !ca.is_empty(),
        ca: (!ca.is_empty()).then(|| PathBuf::from(ca)),
        min_interval: Duration::from_secs_f64(option("--min-interval", 0.05)?),
        commands: true,
        sparkplug: Some(sparkplug::Options {
            group: "fleet".to_string(),
            node: name.to_string(),
            primary_host: option("--primary", String::new())?,
            alias: true,
            history: true,
            state_dir: dir,
        }),
        ..session::options(&format!("drivegate-{name}"), "localhost", option("--port", 8883)?)
    })
}
