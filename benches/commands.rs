//! How long a command waits for the wire on a saturated line.
//!
//! `cargo bench --bench commands` (options: `-- --commands 300 --baud 38400`). Ten drives of profile `vacon-nx`,
//! 8N1, `cycle` far below what the line can carry. A command may be sent as soon as the running transaction is
//! over, so its time from queue to wire (the first byte of its request) is printed next to the duration of the
//! transactions.

mod common;

use std::error::Error;
use std::process::ExitCode;
use std::time::{Duration, Instant, SystemTime};

use drivegate_core::order::{Authority, Order, Origin, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_core::process_image::Direction;
use drivegate_model::drive::Value;

use common::gateway::{Bus, Gateway, line, settings};
use common::{option, quantile};

const DRIVES: u8 = 10;

fn main() -> ExitCode {
    common::exit(measure())
}

fn measure() -> Result<(), Box<dyn Error>> {
    let commands: u16 = option("--commands", 300)?;
    let baud: u32 = option("--baud", 38_400)?;
    let line = line(baud, DRIVES)?;
    let port = line.address();
    let bus = Bus::commanded(&port, baud, DRIVES, "cycle = \"10ms\"");
    let gateway = Gateway::start(settings(&bus.toml())?)?;
    let (plant, image) = (&gateway.plant, gateway.bus()?);
    gateway.runtime.block_on(async {
        tokio::time::sleep(Duration::from_secs(2)).await;
        let before = image.transactions.snapshot();
        let mut frames = image.trace.subscribe();
        let mut waits: Vec<Duration> = Vec::new();
        let mut failed = 0;
        for value in 1..=commands.min(9_999) {
            // The pauses vary, so that they do not synchronise with the line.
            tokio::time::sleep(Duration::from_micros(30_000 + u64::from(value) * 7_919 % 17_000)).await;
            let drive = plant.drive(&format!("line-{}", value % 10 + 1)).ok_or("no drive")?;
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
            let mut placed = drive.place(OrderRequest::new(order, origin, Authority::Write), Instant::now());
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
        let load = image.health().load.unwrap_or(f64::NAN);
        let waits: Vec<f64> = waits.iter().map(|wait| wait.as_secs_f64() * 1e3).collect();
        let at = |share| quantile(&waits, share);
        println!(
            "{baud} baud, {} drives, load {:.0} %, {} commands, {failed} failed",
            DRIVES,
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
        Ok::<(), Box<dyn Error>>(())
    })?;
    gateway.stop();
    Ok(())
}
