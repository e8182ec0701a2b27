//! The servers, each in a separate process that prints its port and ends with its standard input.

use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_core::plant::{BusHandle, Plant};
use drivegate_core::process_image::{BusImage, DriveImage, Link};
use drivegate_core::queue::CommandQueue;
use drivegate_gateway::config::Settings;
use drivegate_north::Server as _;
use drivegate_north::modbus_tcp;
use drivegate_proto::Table;
use drivegate_sim::statistics::Direction;
use tokio_modbus::prelude::*;
use tokio_modbus::server::tcp::{Server, accept_tcp_connection};
use tokio_util::sync::CancellationToken;

use crate::common::gateway::{Bus, Gateway, line, settings};
use crate::common::{compile, file, median, processor_time, quantile};

/// The process of a server under test.
pub(crate) struct Process {
    pub(crate) name: &'static str,
    pub(crate) address: SocketAddr,
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

    /// Starts one of the servers of this program.
    pub(crate) fn own(name: &'static str) -> Result<Process, Box<dyn Error>> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["--serve", name]);
        Process::start(name, command, None)
    }

    pub(crate) fn libmodbus() -> Result<Process, Box<dyn Error>> {
        let directory = tempfile::tempdir()?;
        let program = directory.path().join("server");
        compile("modbus_tcp/libmodbus_server.c", &program)?;
        Process::start("libmodbus", Command::new(program), Some(directory))
    }

    pub(crate) fn pymodbus() -> Result<Process, Box<dyn Error>> {
        let mut command = Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join(".tools/venv/bin/python"));
        command.arg(file("modbus_tcp/pymodbus_server.py"));
        Process::start("pymodbus", command, None).map_err(|why| format!("{why}; make tools").into())
    }

    /// Processor time so far, s.
    pub(crate) fn cpu(&self) -> f64 {
        processor_time(self.child.id()).unwrap_or_default()
    }

    /// Sends the process a line and returns its answer.
    pub(crate) fn ask(&mut self, what: &str) -> Result<String, Box<dyn Error>> {
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

/// Runs the server `name` in this process until standard input ends.
pub(crate) fn serve(name: &str) -> Result<(), Box<dyn Error>> {
    // The benchmark uses a runtime of the kind that the daemon uses.
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    match name {
        "drivegate" => runtime.block_on(drivegate()),
        "tokio-modbus" => runtime.block_on(tokio_modbus()),
        "line" => rounds(),
        _ => Err(format!("no server `{name}`").into()),
    }
}

async fn until_input_ends() {
    let _ = tokio::task::spawn_blocking(|| std::io::stdin().lines().for_each(drop)).await;
}

/// Settings of a gateway with one drive at 115200 baud behind a server.
fn one_drive(port: &str) -> Result<Settings, Box<dyn Error>> {
    let bus = Bus {
        name: "line",
        port,
        baud: 115_200,
        drives: 1,
        profile: "vacon-nx",
        keys: "cycle = \"10ms\"",
        drive_keys: "turnaround = \"0.5ms\"",
    };
    let server =
        "[modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\nmax_connections = 1000\nmax_connections_per_address = 1000\n";
    settings(&format!("stale_after = \"5s\"\n{}{server}", bus.toml()))
}

/// drivegate's server before an image that is rewritten a hundred times a second, as a bus would.
async fn drivegate() -> Result<(), Box<dyn Error>> {
    let settings = one_drive("/dev/null")?;
    let bus = settings.buses.first().ok_or("no bus")?;
    let drives: Vec<_> = bus
        .drives
        .iter()
        .map(|d| Arc::new(DriveImage::new(d.clone(), bus.spec.slow_cycle)))
        .collect();
    let image = BusImage::new(bus.spec.clone(), drives.clone());
    image.update_health(|health| health.up = true);
    let handle = BusHandle::new(Arc::new(image), Arc::new(CommandQueue::new()?), Arc::default());
    let plant = Plant::new("bench", settings.stale_after.limit, vec![handle]);
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
    let server = modbus_tcp::Server::start(
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

/// The request that is sent in each round.
const ROUND: [u8; 6] = [0x01, 0x03, 0x08, 0x34, 0x00, 0x0B];

/// The whole daemon on a simulated line. A line of input starts a measurement of its rounds, the next one ends it
/// and is answered with median and 99 % of the interval between rounds, both as the daemon gave them to its port
/// and as the drives received them.
fn rounds() -> Result<(), Box<dyn Error>> {
    let line = line(115_200, 1)?;
    let gateway = Gateway::start(one_drive(&line.address())?)?;
    let mut frames = gateway.bus()?.trace.subscribe();
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
    println!(
        "{}",
        gateway
            .daemon
            .modbus_tcp_addresses()
            .first()
            .ok_or("no address")?
            .port()
    );
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
    gateway.stop();
    Ok(())
}

/// Median and 99 % of the times between two, ms.
fn cycles(starts: &[Duration]) -> String {
    let pairs = starts.windows(2).filter_map(|w| w.last()?.checked_sub(*w.first()?));
    let cycles: Vec<f64> = pairs.map(|cycle| cycle.as_secs_f64() * 1e3).collect();
    format!("{:.4} {:.4}", median(&cycles), quantile(&cycles, 0.99))
}
