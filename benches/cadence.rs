//! How well the gateway keeps a cadence that the line carries, and how little a line rests that cannot.
//!
//! `cargo bench --bench cadence` (option: `-- --seconds 60`). Drives of the profile `vacon-nx` with all their poll
//! classes, north sides being read; everything is taken from the transcript of the simulated line. A round starts with
//! the read of the process data (2100, 11 registers) of the first drive.

mod common;

use std::error::Error;
use std::process::ExitCode;
use std::time::Duration;

use drivegate_proto::LineFormat;
use drivegate_sim::statistics::{Direction, Recorded, Statistics};

use common::gateway::{Bus, Gateway, NORTH, line, settings};
use common::{median, option, quantile, silences};

/// Cadence that the gateway should reach, s.
const CYCLE: f64 = 0.010;
/// A read of the process data of drive 1.
const ROUND: [u8; 6] = [0x01, 0x03, 0x08, 0x34, 0x00, 0x0B];

fn main() -> ExitCode {
    common::exit(measure())
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 60.0)?);
    let (frames, too_early) = record(115_200, 1, time)?;
    grid(&frames, time);
    println!("requests too early:          {too_early}");
    for (baud, drives) in [(38_400, 10), (115_200, 10)] {
        let (frames, too_early) = record(baud, drives, time / 6)?;
        saturated(&frames, LineFormat::new(baud, "8N1")?, drives);
        println!("requests too early:          {too_early}");
    }
    Ok(())
}

/// Runs the whole gateway on simulated drives for `time`; returns the frames, and the number of requests that came
/// too early.
fn record(baud: u32, drives: u8, time: Duration) -> Result<(Vec<Recorded>, u64), Box<dyn Error>> {
    let line = line(baud, drives)?;
    let bus = Bus {
        name: "line",
        port: &line.address(),
        baud,
        drives,
        profile: "vacon-nx",
        keys: "cycle = \"10ms\"",
        drive_keys: "",
    };
    let gateway = Gateway::start(settings(&(bus.toml() + NORTH))?)?;
    let readers = gateway.read()?;
    // The class `once` is read first.
    std::thread::sleep(Duration::from_secs(1));
    line.record((time.as_secs_f64() * 2000.0) as usize);
    let before = line.statistics();
    std::thread::sleep(time);
    let (frames, after) = (line.transcript(), line.statistics());
    gateway.stop();
    readers.stop()?;
    let early = |s: Statistics| s.silence_violations + s.collisions;
    Ok((frames, early(after) - early(before)))
}

/// Prints how exactly the rounds keep to their grid.
fn grid(frames: &[Recorded], time: Duration) {
    let rounds: Vec<f64> = frames
        .iter()
        .filter(|frame| frame.direction == Direction::ToDrives && frame.bytes.starts_with(&ROUND))
        .map(|frame| frame.start.as_secs_f64())
        .collect();
    let first = rounds.first().copied().unwrap_or_default();
    // Offset of each start from the grid of the first one, -0.5..0.5 cycles.
    let phase = |at: &f64| ((at - first) / CYCLE + 0.5).rem_euclid(1.0) - 0.5;
    let middle = median(&rounds.iter().map(phase).collect::<Vec<_>>());
    let off: Vec<f64> = rounds
        .iter()
        .map(|at| ((phase(at) - middle + 0.5).rem_euclid(1.0) - 0.5) * CYCLE)
        .collect();
    let distance: Vec<f64> = off.iter().map(|off| off.abs() * 1e6).collect();
    let within = distance.iter().filter(|us| **us <= 1000.0).count();
    let tenth = (off.len() / 10).max(1);
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len().max(1) as f64;
    let drift = mean(off.get(off.len() - tenth..).unwrap_or_default()) - mean(off.get(..tenth).unwrap_or_default());
    println!("One drive at 115200 baud, cycle 10 ms, {} s:", time.as_secs_f64());
    println!(
        "rounds a minute:             {:.1} ({} in all)",
        rounds.len() as f64 * 60.0 / time.as_secs_f64(),
        rounds.len()
    );
    println!(
        "starts within 1 ms of grid:  {:.2} % (off by {:.0} us median, {:.0} us 99 %, {:.0} us at most)",
        100.0 * within as f64 / rounds.len().max(1) as f64,
        median(&distance),
        quantile(&distance, 0.99),
        quantile(&distance, 1.0)
    );
    println!("drift over the time:         {:.1} us", drift * 1e6);
}

/// Prints how little a saturated line rests.
fn saturated(frames: &[Recorded], format: LineFormat, drives: u8) {
    let needed = format.silence_chars().as_secs_f64();
    let gaps = silences(frames);
    let over: Vec<f64> = gaps.iter().map(|gap| (gap - needed) * 1e6).collect();
    let spent = frames.last().map_or(0.0, |last| last.end.as_secs_f64())
        - frames.first().map_or(0.0, |first| first.start.as_secs_f64());
    let idle = gaps.iter().map(|gap| (gap - needed).max(0.0)).sum::<f64>() / spent.max(1e-9);
    println!(
        "\n{drives} drives at {} baud, cycle 10 ms, more than the line carries:",
        format.baud
    );
    println!(
        "silence before a request:    {:.0} us needed; over it {:.0} us median, {:.0} us 99 %, {:.0} us at most",
        needed * 1e6,
        median(&over),
        quantile(&over, 0.99),
        quantile(&over, 1.0)
    );
    println!("line at rest beyond silence: {:.2} % of the time", 100.0 * idle);
}
