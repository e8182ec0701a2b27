//! How near the gateway comes to the limit of the wire, beside a bare master on the same simulated line.
//!
//! `cargo bench --bench bus` (options: `-- --seconds 5 --runs 3 --baud 38400`). Ten drives, reads of the eleven process
//! data registers, 8N1, turnaround 0.5 ms, `silence = "chars"`. The gateway runs whole, and its Modbus TCP and HTTP sides
//! are read meanwhile. Bare master and gateway take turns; the figures are medians.

use std::error::Error;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use drivegate::codec::{LineFormat, Request, RequestPdu, Table};
use drivegate::config::Settings;
use drivegate::daemon::Daemon;
use drivegate::sim::bare_master::{self, BareOptions};
use drivegate::sim::drive::DriveOptions;
use drivegate::sim::half_duplex::LineRules;
use drivegate::sim::wire::{SimulatedBus, SimulatedBusOptions};

const DRIVES: std::ops::RangeInclusive<u8> = 1..=10;
const BAUDS: [u32; 5] = [9_600, 19_200, 38_400, 57_600, 115_200];
/// What the bare master reads, and nothing else.
const PROFILE: &str = "name = \"process-data\"\nprotocols = [\"modbus-rtu\"]\n\
    [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 20\nholes = true\n\
    [[point]]\nname = \"fault\"\nat = \"holding 2100.3\"\nclass = \"fast\"\n\
    [[point]]\nname = \"fault_code\"\nat = \"holding 2110\"\nclass = \"fast\"\n";

fn main() -> ExitCode {
    match measure(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// What one run of one master gave.
struct Run {
    rate: f64,
    too_early: u64,
    failures: u64,
    late: Duration,
}

fn measure(arguments: &[String]) -> Result<(), Box<dyn Error>> {
    let option = |name: &str| arguments.iter().skip_while(|argument| *argument != name).nth(1);
    let seconds = option("--seconds").map_or(Ok(5), |text| text.parse())?;
    let runs: usize = option("--runs").map_or(Ok(3), |text| text.parse())?;
    let bauds = option("--baud").map_or(Ok(BAUDS.to_vec()), |text| text.parse().map(|baud| vec![baud]))?;
    let time = Duration::from_secs(seconds);
    println!("{runs} runs of {seconds} s each, medians; too early: requests before 3.5 characters of silence");
    println!(
        "{:>7} {:>9} {:>9} {:>8} {:>9} {:>8} {:>8} {:>9} {:>8} {:>10}",
        "baud", "limit/s", "bare/s", "of limit", "gate/s", "of limit", "of bare", "too early", "failures", "sim late"
    );
    for baud in bauds {
        let format = LineFormat::new(baud, "8N1")?;
        let (mut bare, mut gate) = (Vec::new(), Vec::new());
        for _ in 0..runs.max(1) {
            bare.push(run_bare(format, time)?);
            gate.push(run_gateway(format, time)?);
        }
        let limit = bare_master::wire_limit(&rod(format), &request(1), LineRules::new(format).turnaround);
        let (bare_rate, gate_rate) = (median(&bare), median(&gate));
        let too_early: u64 = gate.iter().chain(&bare).map(|r| r.too_early).sum();
        let failures: u64 = gate.iter().map(|r| r.failures).sum();
        let late = gate.iter().map(|r| r.late).max().unwrap_or_default();
        println!(
            "{baud:>7} {limit:>9.2} {bare_rate:>9.2} {:>6.1} % {gate_rate:>9.2} {:>6.1} % {:>6.1} % {too_early:>9} {failures:>8} {:>7.0} us",
            100.0 * bare_rate / limit,
            100.0 * gate_rate / limit,
            100.0 * gate_rate / bare_rate,
            late.as_secs_f64() * 1e6,
        );
    }
    Ok(())
}

fn median(runs: &[Run]) -> f64 {
    let mut rates: Vec<f64> = runs.iter().map(|r| r.rate).collect();
    rates.sort_by(f64::total_cmp);
    rates.get(rates.len() / 2).copied().unwrap_or_default()
}

fn request(address: u8) -> Request {
    let pdu = RequestPdu::Read {
        table: Table::Holding,
        start: 2100,
        count: 11,
    };
    Request { address, pdu }
}

fn rod(format: LineFormat) -> BareOptions {
    let (timeout, spin) = (Duration::from_millis(100), Duration::from_micros(60));
    BareOptions {
        format,
        silence: format.silence_chars(),
        timeout,
        spin,
    }
}

fn line(format: LineFormat) -> std::io::Result<SimulatedBus> {
    let drives = DRIVES.map(DriveOptions::nx).collect();
    SimulatedBus::start(SimulatedBusOptions::new("bench", LineRules::new(format), drives))
}

fn run_bare(format: LineFormat, time: Duration) -> Result<Run, Box<dyn Error>> {
    let line = line(format)?;
    let requests: Vec<Request> = DRIVES.map(request).collect();
    let report = bare_master::run(Path::new(&line.address()), &rod(format), &requests, time)?;
    let late = line.lateness(0.5).unwrap_or_default();
    Ok(Run {
        rate: report.rate(),
        too_early: line.statistics().silence_violations,
        failures: report.failures,
        late,
    })
}

fn run_gateway(format: LineFormat, time: Duration) -> Result<Run, Box<dyn Error>> {
    let line = line(format)?;
    let profiles = tempfile::tempdir()?;
    std::fs::write(profiles.path().join("process-data.toml"), PROFILE)?;
    let source = configuration(&line.address(), format.baud, profiles.path());
    let loaded = Settings::parse("bench.toml", &source, std::iter::empty());
    let settings = loaded.settings.ok_or_else(|| format!("{:?}", loaded.errors))?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()?;
    let daemon = runtime.block_on(Daemon::start(settings))?;
    let readers = Readers::start(&daemon);
    let plant = daemon.plant().load_full();
    let bus = plant.buses.first().ok_or("no bus")?.image.clone();
    let patience = Instant::now() + Duration::from_secs(20);
    while bus.online() < DRIVES.count() && Instant::now() < patience {
        std::thread::sleep(Duration::from_millis(10));
    }
    let (before, began) = (bus.transactions_total(), Instant::now());
    std::thread::sleep(time);
    let rate = (bus.transactions_total() - before) as f64 / began.elapsed().as_secs_f64();
    readers.stop();
    let statistics = line.statistics();
    let late = line.lateness(0.5).unwrap_or_default();
    runtime.block_on(daemon.stop());
    Ok(Run {
        rate,
        too_early: statistics.silence_violations,
        failures: bus.errors_total(),
        late,
    })
}

fn configuration(port: &str, baud: u32, profiles: &Path) -> String {
    let drives: String = DRIVES
        .map(|a| format!("[[bus.drive]]\nname = \"drive-{a}\"\naddress = {a}\nprofile = \"process-data\"\nturnaround = \"0.5ms\"\n"))
        .collect();
    format!(
        "[gateway]\nname = \"bench\"\nprofile_dirs = [\"{}\"]\n\
         [[bus]]\nname = \"line\"\nport = \"{port}\"\nbaud = {baud}\nformat = \"8N1\"\nsilence = \"chars\"\n{drives}\
         [modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\n[http]\nlisten = \"127.0.0.1:0\"\n",
        profiles.display()
    )
}

/// Clients of the north sides: 100 Modbus TCP reads and one scrape of the metrics ten times a second.
struct Readers {
    end: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<()>,
}

impl Readers {
    fn start(daemon: &Daemon) -> Readers {
        let end = Arc::new(AtomicBool::new(false));
        let (modbus, http) = (daemon.modbus_tcp_addresses().first().copied(), daemon.http_address());
        let ended = end.clone();
        let thread = std::thread::spawn(move || {
            while !ended.load(Ordering::Relaxed) {
                if let (Some(modbus), Some(http)) = (modbus, http) {
                    // A read that fails shows as a missing answer in nobody's figures: the bus is what is measured.
                    let _ = read_north(modbus, http);
                }
                std::thread::sleep(Duration::from_millis(100));
            }
        });
        Readers { end, thread }
    }

    fn stop(self) {
        self.end.store(true, Ordering::Relaxed);
        let _ = self.thread.join();
    }
}

fn read_north(modbus: SocketAddr, http: SocketAddr) -> std::io::Result<()> {
    let mut client = TcpStream::connect(modbus)?;
    client.set_read_timeout(Some(Duration::from_secs(1)))?;
    let mut reply = [0u8; 9 + 22];
    for unit in (1..=10).cycle().take(100) {
        client.write_all(&[0, 1, 0, 0, 0, 6, unit, 3, 0x08, 0x34, 0, 11])?;
        client.read_exact(&mut reply)?;
    }
    let mut client = TcpStream::connect(http)?;
    client.write_all(b"GET /metrics HTTP/1.1\r\nHost: bench\r\nConnection: close\r\n\r\n")?;
    std::io::copy(&mut client, &mut std::io::sink()).map(|_| ())
}
