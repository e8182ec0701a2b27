//! Costs of many buses: processor time per transaction, memory, and the rate of each bus, compared with a single bus.
//!
//! `cargo bench --bench scale` (options: `-- --seconds 10 --runs 3 --baud 38400 --buses 32`). The daemon
//! (`drivegate run`) and the simulator (`drivegate simulate`) are separate processes, so that the processor time of
//! each is known; the system counts it in hundredths of a second.

mod common;

use std::error::Error;
use std::fs;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use common::gateway::Bus;
use common::{Readers, median, option, processor_time, resident_memory, scrape, wait};

/// Drives of each bus.
const DRIVES: u8 = 31;
/// Pause between two scrapes of the metrics. HTTP is used because there are more drives than Modbus TCP has unit ids.
const SCRAPE: Duration = Duration::from_secs(1);
const PROGRAM: &str = env!("CARGO_BIN_EXE_drivegate");

fn main() -> ExitCode {
    common::exit(measure())
}

/// Result of one measurement.
#[derive(Debug, Clone, Copy)]
struct Run {
    /// Transactions per second on each bus.
    rate: f64,
    /// Rate of the slowest bus.
    slowest: f64,
    /// Processor time of daemon and simulator an exchange, us.
    daemon: f64,
    simulator: f64,
    /// Number of processors that daemon and simulator kept busy.
    busy: f64,
    /// Resident memory of the daemon, MiB.
    memory: f64,
    errors: f64,
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 10.0)?);
    let runs: usize = option("--runs", 3)?;
    let baud: u32 = option("--baud", 38_400)?;
    let most: usize = option("--buses", 32)?;
    println!(
        "{DRIVES} drives a bus, profile vacon-nx, at {baud} baud, {runs} runs of {} s in turns, medians; processors: {}",
        time.as_secs_f64(),
        std::thread::available_parallelism()?
    );
    let mut sizes = vec![(1, Vec::new()), (most.div_ceil(4), Vec::new()), (most, Vec::new())];
    for _ in 0..runs.max(1) {
        for (buses, done) in &mut sizes {
            done.push(run(*buses, baud, time)?);
        }
    }
    println!(
        "{:>6} {:>13} {:>13} {:>16} {:>19} {:>10} {:>9} {:>7}",
        "buses", "rate/bus", "slowest bus", "daemon us/exch.", "simulator us/exch.", "busy cores", "RSS MiB", "errors"
    );
    let of = |runs: &[Run], what: fn(&Run) -> f64| median(&runs.iter().map(what).collect::<Vec<_>>());
    let alone = sizes.first().map(|(_, runs)| runs.clone()).unwrap_or_default();
    for (buses, runs) in &sizes {
        let (rate, slowest, daemon) = (of(runs, |r| r.rate), of(runs, |r| r.slowest), of(runs, |r| r.daemon));
        println!(
            "{buses:>6} {rate:>7.2} {:>3.0} % {slowest:>7.2} {:>3.0} % {daemon:>8.1} x{:>5.2}  {:>19.1} {:>10.2} {:>9.1} {:>7.0}",
            100.0 * rate / of(&alone, |r| r.rate),
            100.0 * slowest / of(&alone, |r| r.rate),
            daemon / of(&alone, |r| r.daemon),
            of(runs, |r| r.simulator),
            of(runs, |r| r.busy),
            of(runs, |r| r.memory),
            of(runs, |r| r.errors),
        );
    }
    Ok(())
}

/// A process of this bench; ended when dropped.
struct Process(Child);

impl Process {
    fn start(arguments: &[&str], config: &Path) -> std::io::Result<Process> {
        let mut command = Command::new(PROGRAM);
        command.args(arguments).arg("--config").arg(config);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command.spawn().map(Process)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run(buses: usize, baud: u32, time: Duration) -> Result<Run, Box<dyn Error>> {
    let directory = tempfile::tempdir()?;
    let config = directory.path().join("drivegate.toml");
    let http = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
    fs::write(&config, configuration(directory.path(), buses, baud, http))?;
    let simulator = Process::start(&["simulate"], &config)?;
    wait("the simulator", || {
        directory.path().join(format!("line{buses}")).exists()
    })?;
    let daemon = Process::start(&["run"], &config)?;
    wait("the daemon", || ready(http))?;
    let readers = Readers::start(None, http, 0, SCRAPE);
    // During this time the class `once` is read, and the clients reach their steady pace.
    std::thread::sleep(Duration::from_secs(4));
    let before = (
        exchanges(http, buses)?,
        processor_time(daemon.0.id())?,
        processor_time(simulator.0.id())?,
        Instant::now(),
    );
    std::thread::sleep(time);
    let after = (
        exchanges(http, buses)?,
        processor_time(daemon.0.id())?,
        processor_time(simulator.0.id())?,
        Instant::now(),
    );
    let seconds = after.3.duration_since(before.3).as_secs_f64();
    let memory = resident_memory(daemon.0.id())?;
    readers.stop()?;
    let rates: Vec<f64> = after
        .0
        .counts
        .iter()
        .zip(&before.0.counts)
        .map(|(after, before)| (after - before) / seconds)
        .collect();
    let all = rates.iter().sum::<f64>() * seconds;
    Ok(Run {
        rate: rates.iter().sum::<f64>() / rates.len().max(1) as f64,
        slowest: rates.iter().copied().fold(f64::INFINITY, f64::min),
        daemon: (after.1 - before.1) * 1e6 / all,
        simulator: (after.2 - before.2) * 1e6 / all,
        busy: (after.1 + after.2 - before.1 - before.2) / seconds,
        memory,
        errors: after.0.errors - before.0.errors,
    })
}

/// Whether each drive answers.
fn ready(http: SocketAddr) -> bool {
    let up = |text: String| {
        let mut drives = text
            .lines()
            .filter(|line| line.starts_with("drivegate_drive_up{"))
            .peekable();
        drives.peek().is_some() && drives.all(|line| line.ends_with(" 1"))
    };
    scrape(http).is_ok_and(up)
}

/// Exchanges of each bus so far, and how many of all failed.
struct Exchanges {
    counts: Vec<f64>,
    errors: f64,
}

fn exchanges(http: SocketAddr, buses: usize) -> Result<Exchanges, Box<dyn Error>> {
    let text = scrape(http)?;
    let mut found = Exchanges {
        counts: vec![0.0; buses],
        errors: 0.0,
    };
    for line in text
        .lines()
        .filter(|line| line.starts_with("drivegate_drive_transactions_total{"))
    {
        let value: f64 = line.rsplit(' ').next().unwrap_or_default().parse()?;
        let bus = line.split("bus=\"bus").nth(1).and_then(|rest| rest.split('"').next());
        let index: usize = bus.ok_or("no label `bus`")?.parse()?;
        if let Some(count) = index.checked_sub(1).and_then(|index| found.counts.get_mut(index)) {
            *count += value;
        }
        if !line.contains("outcome=\"ok\"") {
            found.errors += value;
        }
    }
    Ok(found)
}

fn configuration(directory: &Path, buses: usize, baud: u32, http: SocketAddr) -> String {
    let mut text = format!("[gateway]\nname = \"bench\"\n[http]\nlisten = \"{http}\"\n");
    for bus in 1..=buses {
        let bus = Bus {
            name: &format!("bus{bus}"),
            port: &directory.join(format!("line{bus}")).display().to_string(),
            baud,
            drives: DRIVES,
            profile: "vacon-nx",
            keys: "",
            drive_keys: "",
        };
        text += &bus.toml();
    }
    text
}
