//! How long a command waits for the wire on a saturated line.
//!
//! `cargo bench --bench commands` (options: `-- --commands 300 --baud 38400`). Ten drives of profile `vacon-nx`, 8N1, `cycle`
//! far below what the line carries. A command may go as soon as the running transaction is over, so its time from
//! queue to wire (the first byte of its request) is printed beside the time of the transactions.

use std::error::Error;
use std::process::ExitCode;
use std::time::{Duration, Instant, SystemTime};

use drivegate::cache::Direction;
use drivegate::codec::LineFormat;
use drivegate::command::{Authority, DEFAULT_EXPIRY, Order, Origin, SourceKind};
use drivegate::config::Settings;
use drivegate::daemon::Daemon;
use drivegate::drive::Value;
use drivegate::sim::drive::DriveOptions;
use drivegate::sim::half_duplex::LineRules;
use drivegate::sim::wire::{SimulatedBus, SimulatedBusOptions};

const DRIVES: std::ops::RangeInclusive<u8> = 1..=10;

fn main() -> ExitCode {
    match measure(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(arguments: &[String]) -> Result<(), Box<dyn Error>> {
    let option = |name: &str| arguments.iter().skip_while(|argument| *argument != name).nth(1);
    let commands: u16 = option("--commands").map_or(Ok(300), |text| text.parse())?;
    let baud: u32 = option("--baud").map_or(Ok(38_400), |text| text.parse())?;
    let drives = DRIVES.map(DriveOptions::nx).collect();
    let rules = LineRules::new(LineFormat::new(baud, "8N1")?);
    let line = SimulatedBus::start(SimulatedBusOptions::new("bench", rules, drives))?;
    let source = configuration(&line.address(), baud);
    let loaded = Settings::parse("bench.toml", &source, std::iter::empty());
    let settings = loaded.settings.ok_or_else(|| format!("{:?}", loaded.errors))?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()?;
    runtime.block_on(async {
        let daemon = Daemon::start(settings).await?;
        let plant = daemon.plant().load_full();
        let image = plant.buses.first().ok_or("no bus")?.image.clone();
        let patience = Instant::now() + Duration::from_secs(20);
        while image.online() < DRIVES.count() && Instant::now() < patience {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        tokio::time::sleep(Duration::from_secs(2)).await;
        let before = image.transactions.snapshot();
        let mut frames = image.trace.subscribe();
        let mut waits: Vec<Duration> = Vec::new();
        let mut failed = 0;
        for value in 1..=commands.min(9_999) {
            // Not in step with the line.
            tokio::time::sleep(Duration::from_micros(30_000 + u64::from(value) * 7_919 % 17_000)).await;
            let drive = plant.drive(&format!("drive-{}", value % 10 + 1)).ok_or("no drive")?;
            let point = drive
                .image
                .spec
                .profile
                .point_index("speed_reference")
                .ok_or("no point")?;
            let origin = Origin::new(SourceKind::Mqtt, "bench");
            let order = Order::Points(vec![(point, Value::Number(f64::from(value) / 100.0))]);
            while frames.try_recv().is_ok() {}
            let queued = SystemTime::now();
            let mut placed = drive.place(order, origin, Authority::Write, DEFAULT_EXPIRY, Instant::now());
            if !placed.answered().await.outcome.is_ok() {
                failed += 1;
                continue;
            }
            let bytes = value.to_be_bytes();
            let is_it =
                |bytes_on_wire: &[u8]| bytes_on_wire.get(1) == Some(&6) && bytes_on_wire.get(4..6) == Some(&bytes[..]);
            while let Ok(frame) = frames.recv().await {
                if frame.direction == Direction::Request && is_it(&frame.bytes) {
                    waits.push(frame.time.duration_since(queued).unwrap_or_default());
                    break;
                }
            }
        }
        let after = image.transactions.snapshot();
        let mean = (after.sum - before.sum) / (after.count - before.count).max(1) as f64;
        let load = image.health().load;
        waits.sort();
        let at = |share: f64| {
            let place = ((waits.len() as f64 * share).ceil() as usize).saturating_sub(1);
            waits.get(place).copied().unwrap_or_default().as_secs_f64() * 1e3
        };
        println!(
            "{baud} baud, {} drives, load {:.0} %, {} commands, {failed} failed",
            DRIVES.count(),
            load * 100.0,
            waits.len()
        );
        println!(
            "queue to wire: median {:.2} ms, p99 {:.2} ms, longest {:.2} ms",
            at(0.5),
            at(0.99),
            at(1.0)
        );
        println!("one transaction: mean {:.2} ms", mean * 1e3);
        daemon.stop().await;
        Ok(())
    })
}

fn configuration(port: &str, baud: u32) -> String {
    let drives: String = DRIVES
        .map(|a| {
            format!(
                "[[bus.drive]]\nname = \"drive-{a}\"\naddress = {a}\nprofile = \"vacon-nx\"\naccess = \"control\"\n"
            )
        })
        .collect();
    format!(
        "[gateway]\nname = \"bench\"\n[[bus]]\nname = \"line\"\nport = \"{port}\"\nbaud = {baud}\nformat = \"8N1\"\n\
         silence = \"chars\"\ncycle = \"10ms\"\n{drives}"
    )
}
