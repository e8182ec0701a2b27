//! Load of a gateway on a small machine: processor time, wake-ups, memory, and instructions per transaction, with 1 and 4
//! buses of a 10 ms cycle and 4 saturated buses.
//!
//! `cargo bench --bench footprint` (options: `-- --seconds 20 --spin off --program PATH --instructions no`). The
//! daemon and the simulator are separate processes. Instructions are counted by callgrind in a separate run,
//! because they do not depend on how busy the machine is, while the processor time of the other runs does.
//! `--program` names another build of the daemon, such as an older one. `--emulator qemu-aarch64 --program PATH`
//! counts the instructions of a program for ARM under qemu-user 8 or later, for the first plant only: with its log,
//! qemu executes a million blocks a second, too few for the others at their full rate.

mod common;

use std::collections::HashMap;
use std::error::Error;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use common::gateway::Bus;
use common::{option, processor_time, resident_memory, wait};

const PROGRAM: &str = env!("CARGO_BIN_EXE_drivegate");

/// A plant: name, buses, drives of each, baud rate.
const PLANTS: [(&str, usize, u8, u32); 3] = [
    ("1 bus, 10 ms", 1, 1, 115_200),
    ("4 buses, 10 ms", 4, 1, 115_200),
    ("4 buses, saturated", 4, 10, 38_400),
];

fn main() -> ExitCode {
    common::exit(measure())
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 20.0)?);
    let spin: String = option("--spin", "auto".to_string())?;
    let program: PathBuf = option("--program", PathBuf::from(PROGRAM))?;
    let counted: String = option("--instructions", "yes".to_string())?;
    let emulator: String = option("--emulator", String::new())?;
    if !emulator.is_empty() {
        return emulated(&emulator, &program, &spin, time);
    }
    println!(
        "{}, spin = \"{spin}\", {} s each; processors: {}",
        std::env::consts::ARCH,
        time.as_secs_f64(),
        std::thread::available_parallelism()?
    );
    println!(
        "{:<20} {:>11} {:>12} {:>17} {:>9} {:>23}",
        "", "exchanges/s", "% of a core", "wake-ups/exchange", "RSS MiB", "instructions/exchange"
    );
    for (name, buses, drives, baud) in PLANTS {
        let plant = Plant {
            buses,
            drives,
            baud,
            spin: &spin,
        };
        let run = native(&program, &plant, time)?;
        let instructions = match counted.as_str() {
            "yes" => format!("{:.0}", instructions(&program, &plant, time)?),
            _ => "not counted".to_string(),
        };
        println!(
            "{name:<20} {:>11.1} {:>12.2} {:>17.2} {:>9.2} {instructions:>23}",
            run.rate, run.percent, run.wake_ups, run.memory
        );
    }
    Ok(())
}

struct Plant<'a> {
    buses: usize,
    drives: u8,
    baud: u32,
    spin: &'a str,
}

struct Run {
    rate: f64,
    percent: f64,
    wake_ups: f64,
    memory: f64,
}

fn native(program: &Path, plant: &Plant<'_>, time: Duration) -> Result<Run, Box<dyn Error>> {
    let site = Site::start(plant, Command::new(program))?;
    let process = site.daemon.0.id();
    std::thread::sleep(Duration::from_secs(3));
    let before = (
        site.exchanges()?,
        processor_time(process)?,
        switches(process)?,
        Instant::now(),
    );
    std::thread::sleep(time);
    let after = (
        site.exchanges()?,
        processor_time(process)?,
        switches(process)?,
        Instant::now(),
    );
    let (seconds, exchanges) = ((after.3 - before.3).as_secs_f64(), after.0 - before.0);
    Ok(Run {
        rate: exchanges / seconds,
        percent: 100.0 * (after.1 - before.1) / seconds,
        wake_ups: (after.2 - before.2) / exchanges,
        memory: resident_memory(process)?,
    })
}

/// Instructions of the daemon for each exchange, counted by callgrind after the start.
fn instructions(program: &Path, plant: &Plant<'_>, time: Duration) -> Result<f64, Box<dyn Error>> {
    let directory = tempfile::tempdir()?;
    let out = directory.path().join("callgrind");
    let mut command = Command::new("valgrind");
    command
        .args(["--tool=callgrind", "--instr-atstart=no", "--fair-sched=yes"])
        .arg(format!("--callgrind-out-file={}", out.display()))
        .arg(program);
    let site = Site::start(plant, command).map_err(|error| format!("{error}; apt install valgrind"))?;
    let process = site.daemon.0.id().to_string();
    let control = |arguments: &[&str]| -> Result<(), Box<dyn Error>> {
        let done = Command::new("callgrind_control")
            .args(arguments)
            .arg(&process)
            .output()?;
        if done.status.success() {
            Ok(())
        } else {
            Err(format!("callgrind_control: {}", String::from_utf8_lossy(&done.stderr)).into())
        }
    };
    std::thread::sleep(Duration::from_secs(5));
    let before = site.exchanges()?;
    control(&["-i", "on"])?;
    std::thread::sleep(time);
    // Counting is switched off without a reset, which would delete the counts.
    control(&["-d"])?;
    let exchanges = site.exchanges()? - before;
    let dump = fs::read_dir(directory.path())?
        .filter_map(Result::ok)
        .find(|entry| entry.file_name() == "callgrind.1")
        .ok_or("callgrind wrote nothing")?;
    let text = fs::read_to_string(dump.path())?;
    let total = text
        .lines()
        .find_map(|line| line.strip_prefix("summary: ").or_else(|| line.strip_prefix("totals: ")))
        .ok_or("callgrind wrote no total")?;
    Ok(total.trim().parse::<f64>()? / exchanges)
}

/// Prints the instructions of the daemon for each exchange, counted by an emulator of another processor.
fn emulated(emulator: &str, program: &Path, spin: &str, time: Duration) -> Result<(), Box<dyn Error>> {
    println!("{emulator}, spin = \"{spin}\", {} s each", time.as_secs_f64());
    println!("{:<20} {:>11} {:>23}", "", "exchanges/s", "instructions/exchange");
    let (name, buses, drives, baud) = PLANTS[0];
    let plant = Plant {
        buses,
        drives,
        baud,
        spin,
    };
    let mut command = Command::new(emulator);
    command.args(["-d", "in_asm,exec,nochain"]).arg(program);
    let mut site = Site::start_with(&plant, command, Stdio::piped())?;
    let log = site.log.take().ok_or("the daemon has no standard error")?;
    let count = Arc::new(AtomicU64::new(0));
    let counter = count.clone();
    std::thread::spawn(move || Blocks::default().read(BufReader::new(log), &counter));
    wait("the daemon", || site.ready())?;
    std::thread::sleep(Duration::from_secs(10));
    let counts = |site: &Site| -> Result<(f64, f64), Box<dyn Error>> {
        Ok((site.exchanges()?, count.load(Ordering::Relaxed) as f64))
    };
    let (before, began) = (counts(&site)?, Instant::now());
    std::thread::sleep(time);
    let after = counts(&site)?;
    let exchanges = after.0 - before.0;
    println!(
        "{name:<20} {:>11.1} {:>23.0}",
        exchanges / began.elapsed().as_secs_f64(),
        (after.1 - before.1) / exchanges
    );
    Ok(())
}

/// Counts instructions from the log of qemu: qemu lists the instructions of each block when it translates it
/// (`0xADDRESS: ...` below `IN:`), and writes a line each time a block is executed (`Trace 0: ...
/// [.../ADDRESS/...]`).
#[derive(Default)]
struct Blocks {
    lengths: HashMap<u64, u64>,
    listed: Option<u64>,
}

impl Blocks {
    fn read(&mut self, mut log: impl BufRead, count: &AtomicU64) {
        let mut line = Vec::new();
        while log.read_until(b'\n', &mut line).is_ok_and(|bytes| bytes > 0) {
            count.fetch_add(self.line(&line).unwrap_or_default(), Ordering::Relaxed);
            line.clear();
        }
    }

    /// The instructions that were executed, if the line reports any.
    fn line(&mut self, line: &[u8]) -> Option<u64> {
        let address = |text: &[u8]| u64::from_str_radix(std::str::from_utf8(text).ok()?, 16).ok();
        if line.starts_with(b"Trace") {
            let address = address(line.split(|byte| *byte == b'/').nth(1)?)?;
            return self.lengths.get(&address).copied();
        }
        if line.starts_with(b"IN:") {
            self.listed = None;
        } else if let Some(rest) = line.strip_prefix(b"0x") {
            let address = address(rest.split(|byte| *byte == b':').next()?)?;
            if self.listed.is_none() {
                self.lengths.insert(address, 0);
            }
            let first = *self.listed.get_or_insert(address);
            *self.lengths.entry(first).or_default() += 1;
        }
        None
    }
}

/// The environment that the systemd unit gives the daemon; it controls how memory is kept.
fn unit_environment() -> impl Iterator<Item = (&'static str, &'static str)> {
    include_str!("../systemd/drivegate.service")
        .lines()
        .filter_map(|line| line.strip_prefix("Environment="))
        .flat_map(str::split_ascii_whitespace)
        .filter_map(|part| part.split_once('='))
}

/// A process of this bench; ended when dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A simulator and a gateway at work.
struct Site {
    daemon: Process,
    http: SocketAddr,
    /// Standard error of the daemon, if the bench reads it.
    log: Option<ChildStderr>,
    _simulator: Process,
    _directory: tempfile::TempDir,
}

impl Site {
    fn start(plant: &Plant<'_>, program: Command) -> Result<Site, Box<dyn Error>> {
        let site = Site::start_with(plant, program, Stdio::null())?;
        wait("the daemon", || site.ready())?;
        Ok(site)
    }

    /// Starts the daemon, which may not be ready yet when this returns.
    fn start_with(plant: &Plant<'_>, mut program: Command, log: Stdio) -> Result<Site, Box<dyn Error>> {
        let directory = tempfile::tempdir()?;
        let config = directory.path().join("drivegate.toml");
        let http = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
        let mut text = format!(
            "[gateway]\nname = \"bench\"\nstate_dir = \"{0}\"\nsocket = \"{0}/socket\"\n[http]\nlisten = \"{http}\"\n",
            directory.path().display()
        );
        // An older program does not know the key.
        let spin = match plant.spin {
            "auto" => String::new(),
            other => format!("spin = \"{other}\"\n"),
        };
        for bus in 1..=plant.buses {
            let bus = Bus {
                name: &format!("bus{bus}"),
                port: &directory.path().join(format!("line{bus}")).display().to_string(),
                baud: plant.baud,
                drives: plant.drives,
                profile: "vacon-nx",
                keys: &format!("response_timeout = \"1s\"\n{spin}"),
                drive_keys: "",
            };
            text += &bus.toml();
        }
        fs::write(&config, text)?;
        let quiet = |command: &mut Command, log: Stdio| {
            command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
            command.spawn().map(Process)
        };
        let mut simulate = Command::new(PROGRAM);
        let simulator = quiet(simulate.args(["simulate", "--config"]).arg(&config), Stdio::null())?;
        wait("the simulator", || {
            directory.path().join(format!("line{}", plant.buses)).exists()
        })?;
        let run = program.args(["run", "--config"]).arg(&config).envs(unit_environment());
        let mut daemon = quiet(run, log)?;
        Ok(Site {
            log: daemon.0.stderr.take(),
            daemon,
            http,
            _simulator: simulator,
            _directory: directory,
        })
    }

    /// Whether each drive answers.
    fn ready(&self) -> bool {
        self.get("/readyz").is_ok_and(|reply| reply.starts_with("HTTP/1.1 200"))
    }

    /// Number of transactions so far. The metrics are not used, because valgrind hides what they report about the process.
    fn exchanges(&self) -> Result<f64, Box<dyn Error>> {
        let reply = self.get("/api/v1/buses")?;
        let (_, body) = reply.split_once("\r\n\r\n").ok_or("no body")?;
        let buses: Vec<serde_json::Value> = serde_json::from_str(body)?;
        Ok(buses.iter().filter_map(|bus| bus.get("transactions")?.as_f64()).sum())
    }

    fn get(&self, path: &str) -> std::io::Result<String> {
        let mut client = TcpStream::connect(self.http)?;
        client.set_read_timeout(Some(Duration::from_secs(20)))?;
        write!(
            client,
            "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        )?;
        let mut text = String::new();
        client.read_to_string(&mut text)?;
        Ok(text)
    }
}

/// Number of times that threads of the process went to sleep so far.
fn switches(process: u32) -> Result<f64, Box<dyn Error>> {
    let mut all = 0.0;
    for thread in fs::read_dir(format!("/proc/{process}/task"))? {
        let status = fs::read_to_string(thread?.path().join("status"))?;
        let count = status
            .lines()
            .find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))
            .ok_or("no voluntary_ctxt_switches")?;
        all += count.trim().parse::<f64>()?;
    }
    Ok(all)
}
