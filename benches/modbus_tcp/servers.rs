//! The servers, each a process of its own that prints its port and ends with its standard input.

use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate::cache::{BusImage, DriveImage, Link};
use drivegate::codec::{LineFormat, Table};
use drivegate::command::CommandQueue;
use drivegate::config::Settings;
use drivegate::daemon::Daemon;
use drivegate::north::modbus_tcp;
use drivegate::plant::{BusHandle, Plant};
use drivegate::sim::drive::DriveOptions;
use drivegate::sim::half_duplex::LineRules;
use drivegate::sim::statistics::Direction;
use drivegate::sim::wire::{SimulatedBus, SimulatedBusOptions};
use tokio_modbus::prelude::*;
use tokio_modbus::server::tcp::{Server, accept_tcp_connection};
use tokio_util::sync::CancellationToken;

use super::common::{median, quantile};

/// A server under test.
pub(super) struct Process {
    pub(super) name: &'static str,
    pub(super) address: SocketAddr,
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    _directory: Option<tempfile::TempDir>,
}

impl Process {
    fn start(
        name: &'static str,
        mut command: Command,
        directory: Option<tempfile::TempDir>,
    ) -> Result<Process, Box<dyn Error>> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()?;
        let input = child.stdin.take().ok_or("no input")?;
        let mut output = BufReader::new(child.stdout.take().ok_or("no output")?);
        let mut line = String::new();
        output.read_line(&mut line)?;
        let port: u16 = line
            .trim()
            .parse()
            .map_err(|_| format!("{name} did not start: `{}`", line.trim()))?;
        let address = SocketAddr::from(([127, 0, 0, 1], port));
        Ok(Process {
            name,
            address,
            child,
            input,
            output,
            _directory: directory,
        })
    }

    /// One of the servers of this program.
    pub(super) fn own(name: &'static str) -> Result<Process, Box<dyn Error>> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["--serve", name]);
        Process::start(name, command, None)
    }

    pub(super) fn libmodbus() -> Result<Process, Box<dyn Error>> {
        let directory = tempfile::tempdir()?;
        let (source, program) = (file("libmodbus_server.c"), directory.path().join("server"));
        let output = Command::new("gcc")
            .args(["-O2", "-I/usr/include/modbus", "-o"])
            .arg(&program)
            .arg(source)
            .arg("-lmodbus")
            .output()?;
        if !output.status.success() {
            return Err("it cannot be compiled; apt install gcc libc6-dev libmodbus-dev".into());
        }
        Process::start("libmodbus", Command::new(program), Some(directory))
    }

    pub(super) fn pymodbus() -> Result<Process, Box<dyn Error>> {
        let mut command = Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join(".tools/venv/bin/python"));
        command.arg(file("pymodbus_server.py"));
        Process::start("pymodbus", command, None).map_err(|why| format!("{why}; make tools").into())
    }

    /// Processor time so far, s.
    pub(super) fn cpu(&self) -> f64 {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).unwrap_or_default();
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
        let ticks = |at: usize| fields.get(at).and_then(|f| f.parse::<f64>().ok()).unwrap_or_default();
        (ticks(11) + ticks(12)) / 100.0
    }

    /// Tells it something and gives its answer.
    pub(super) fn ask(&mut self, what: &str) -> Result<String, Box<dyn Error>> {
        writeln!(self.input, "{what}")?;
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        Ok(line.trim().to_string())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn file(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("benches/modbus_tcp")
        .join(name)
}

/// Runs the server `name` in this process until standard input ends.
pub(super) fn serve(name: &str) -> Result<(), Box<dyn Error>> {
    // As the daemon has it.
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    match name {
        "drivegate" => runtime.block_on(drivegate()),
        "tokio-modbus" => runtime.block_on(tokio_modbus()),
        "line" => line(&runtime),
        _ => Err(format!("no server `{name}`").into()),
    }
}

async fn until_input_ends() {
    let _ = tokio::task::spawn_blocking(|| std::io::stdin().lines().for_each(drop)).await;
}

const CONFIGURATION: &str = "[gateway]\nname = \"bench\"\n[[bus]]\nname = \"line\"\nport = \"PORT\"\nbaud = 115200\n\
    cycle = \"10ms\"\nsilence = \"chars\"\n[[bus.drive]]\nname = \"drive\"\naddress = 1\nprofile = \"vacon-nx\"\n\
    turnaround = \"0.5ms\"\n[modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\nmax_connections = 1000\nstale_after = \"5s\"\n";

fn settings(port: &str) -> Result<Settings, String> {
    let loaded = Settings::parse("bench.toml", &CONFIGURATION.replace("PORT", port), std::iter::empty());
    loaded.settings.ok_or_else(|| format!("{:?}", loaded.errors))
}

/// drivegate's server before an image that is rewritten a hundred times a second, as a bus would.
async fn drivegate() -> Result<(), Box<dyn Error>> {
    let settings = settings("/dev/null")?;
    let bus = settings.buses.first().ok_or("no bus")?;
    let drives: Vec<_> = bus
        .drives
        .iter()
        .map(|d| Arc::new(DriveImage::new(d.clone(), bus.spec.slow_cycle)))
        .collect();
    let image = BusImage::new(bus.spec.clone(), drives.clone());
    image.update_health(|health| health.up = true);
    let plant = Plant {
        gateway: "bench".to_string(),
        stale_after: settings.stale_after,
        buses: vec![BusHandle {
            image: Arc::new(image),
            queue: Arc::new(CommandQueue::new()?),
        }],
        events: Default::default(),
        writes: Default::default(),
    };
    let poll = move || {
        for (drive, value) in drives.iter().cycle().zip((0..=u16::MAX).cycle()) {
            let now = Instant::now();
            drive.update(|s| {
                s.link = Link::Online(SystemTime::UNIX_EPOCH);
                s.fast_at = Some(now);
                s.store(Table::Holding, 2100, &[value; 11], now);
            });
            std::thread::sleep(Duration::from_millis(10));
        }
    };
    std::thread::spawn(poll);
    let options = settings.modbus_tcp.clone().ok_or("no server")?;
    let server = modbus_tcp::start(
        options,
        Arc::new(ArcSwap::from_pointee(plant)),
        Arc::default(),
        CancellationToken::new(),
    )
    .await?;
    tokio::time::sleep(Duration::from_millis(50)).await;
    println!("{}", server.addresses().first().ok_or("no address")?.port());
    until_input_ends().await;
    Ok(())
}

struct Registers([u16; 11]);

impl tokio_modbus::server::Service for Registers {
    type Request = SlaveRequest<'static>;
    type Response = Response;
    type Exception = ExceptionCode;
    type Future = std::future::Ready<Result<Response, ExceptionCode>>;

    fn call(&self, request: Self::Request) -> Self::Future {
        std::future::ready(match request.request {
            Request::ReadHoldingRegisters(2100, 11) => Ok(Response::ReadHoldingRegisters(self.0.to_vec())),
            _ => Err(ExceptionCode::IllegalDataAddress),
        })
    }
}

async fn tokio_modbus() -> Result<(), Box<dyn Error>> {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await?;
    println!("{}", listener.local_addr()?.port());
    let service = Arc::new(Registers(std::array::from_fn(|i| 1000 + i as u16)));
    let connected = |stream: tokio::net::TcpStream, peer| {
        let service = service.clone();
        async move {
            stream.set_nodelay(true)?;
            accept_tcp_connection(stream, peer, move |_| Ok(Some(service.clone())))
        }
    };
    let server = Server::new(listener);
    tokio::select! {
        served = server.serve(&connected, |_| {}) => Ok(served?),
        () = until_input_ends() => Ok(()),
    }
}

/// The request of a round.
const ROUND: [u8; 6] = [0x01, 0x03, 0x08, 0x34, 0x00, 0x0B];

/// The whole daemon on a simulated line; a line of input begins a measurement of its rounds, the next ends it and is
/// answered with median and 99 % of the time between two, as the daemon gave them to its port and as the drives heard them.
fn line(runtime: &tokio::runtime::Runtime) -> Result<(), Box<dyn Error>> {
    let rules = LineRules::new(LineFormat::new(115_200, "8N1")?);
    let line = SimulatedBus::start(SimulatedBusOptions::new("bench", rules, vec![DriveOptions::nx(1)]))?;
    let daemon = runtime.block_on(Daemon::start(settings(&line.address())?))?;
    let plant = daemon.plant().load_full();
    let mut frames = plant.buses.first().ok_or("no bus")?.image.trace.subscribe();
    let written: Arc<Mutex<Vec<Duration>>> = Arc::default();
    let writes = written.clone();
    std::thread::spawn(move || {
        while let Ok(frame) = frames.blocking_recv() {
            if frame.bytes.starts_with(&ROUND)
                && let (Ok(time), Ok(mut writes)) = (frame.time.duration_since(SystemTime::UNIX_EPOCH), writes.lock())
            {
                writes.push(time);
            }
        }
    });
    std::thread::sleep(Duration::from_secs(2));
    println!("{}", daemon.modbus_tcp_addresses().first().ok_or("no address")?.port());
    let mut begun = false;
    for input in std::io::stdin().lines() {
        input?;
        begun = !begun;
        let written = std::mem::take(&mut *written.lock().map_err(|_| "the listener has failed")?);
        if begun {
            line.record(200_000);
            println!("begun");
            continue;
        }
        let frames = line.transcript();
        let heard = frames
            .iter()
            .filter(|f| f.direction == Direction::ToDrives && f.bytes.starts_with(&ROUND));
        println!(
            "{} {}",
            cycles(&written),
            cycles(&heard.map(|f| f.start).collect::<Vec<_>>())
        );
    }
    runtime.block_on(daemon.stop());
    Ok(())
}

/// Median and 99 % of the times between two, ms.
fn cycles(starts: &[Duration]) -> String {
    let pairs = starts.windows(2).filter_map(|w| w.last()?.checked_sub(*w.first()?));
    let cycles: Vec<f64> = pairs.map(|cycle| cycle.as_secs_f64() * 1e3).collect();
    format!("{:.4} {:.4}", median(&cycles), quantile(&cycles, 0.99))
}
