//! Effects of clients without rights on clients that have rights.
//!
//! `cargo bench --bench hostile` (option: `-- --seconds 8`, the time of each attack). One gateway with ten drives;
//! an operator at 127.0.0.2, the only one who may write, opens a connection for each command, one a second; a SCADA
//! client at 127.0.0.3 polls every 20 ms over one connection. Attackers at 127.0.0.9 may only connect. For each
//! attack, the bench prints commands answered, their audit, the latency of the SCADA client and the cadence of the
//! line, next to the figures without an attack.

mod common;

use std::error::Error;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_sim::statistics::{Direction, Recorded};
use drivegate_sim::wire::SimulatedBus;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use common::gateway::{Bus, Gateway, NORTH, line, settings};
use common::{option, quantile, starts};

const OPERATOR: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);
const SCADA: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 3);
const ATTACKER: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 9);
/// Time limit for an answer.
const PATIENCE: Duration = Duration::from_secs(5);
const DRIVES: u8 = 10;

fn main() -> ExitCode {
    common::exit(measure())
}

/// Addresses of the gateway's servers.
#[derive(Clone, Copy)]
struct North {
    modbus: SocketAddr,
    http: SocketAddr,
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 8.0)?);
    let line = line(115_200, DRIVES)?;
    let port = line.address();
    let bus = Bus::commanded(&port, 115_200, DRIVES, "cycle = \"100ms\"");
    let rights = "[modbus_tcp]\nwrite = [\"127.0.0.2/32\"]\n";
    let gateway = Gateway::start(settings(&(bus.toml() + &NORTH.replace("[modbus_tcp]\n", rights)))?)?;
    let modbus = *gateway.daemon.modbus_tcp_addresses().first().ok_or("no Modbus TCP")?;
    let north = North {
        modbus,
        http: gateway.daemon.http_address().ok_or("no HTTP")?,
    };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    println!("attack                      commands  audit   SCADA p50, p99 ms   lost  round p50, p99 ms");
    let mut missing = 0;
    let mut value = 0;
    for attack in ATTACKS {
        missing += runtime.block_on(phase(attack, north, &line, time, &mut value))?;
    }
    gateway.stop();
    match missing {
        0 => Ok(()),
        n => Err(format!("{n} answers or audit entries of the operator are missing").into()),
    }
}

/// Runs one attack while operator and SCADA client work; returns the number of missing answers and audit entries.
async fn phase(
    attack: Attack,
    north: North,
    line: &SimulatedBus,
    time: Duration,
    value: &mut u16,
) -> Result<usize, Box<dyn Error>> {
    let mut attackers = JoinSet::new();
    for number in 0..attack.clients() {
        attackers.spawn(async move {
            loop {
                // A refusal is what an attacker has to expect.
                let _ = attack.run(north, number).await;
                sleep(Duration::from_millis(5)).await;
            }
        });
    }
    sleep(Duration::from_millis(500)).await;
    line.record((time.as_secs_f64() * 2000.0) as usize);
    let first = *value + 1;
    let until = Instant::now() + time;
    let scada = tokio::spawn(poll(north.modbus, until));
    let mut answered = 0;
    let mut asked = 0;
    while Instant::now() < until {
        *value += 1;
        asked += 1;
        answered += usize::from(matches!(
            timeout(PATIENCE, command(north.modbus, *value)).await,
            Ok(Ok(()))
        ));
        sleep(Duration::from_secs(1)).await;
    }
    let (latencies, lost) = scada.await?;
    let rounds = rounds(&line.transcript());
    let audited = audited(north.http, first, *value).await?;
    attackers.shutdown().await;
    println!(
        "{:26} {answered:>4} of {asked:<3} {audited:>4}   {:>8.2} {:>8.2}   {lost:>6}  {:>8.1} {:>8.1}",
        attack.name(),
        quantile(&latencies, 0.5),
        quantile(&latencies, 0.99),
        quantile(&rounds, 0.5),
        quantile(&rounds, 0.99),
    );
    Ok((asked - answered) + (asked - audited.min(asked)))
}

/// Times between the reads of the process data of drive 1, ms.
fn rounds(frames: &[Recorded]) -> Vec<f64> {
    let reads: Vec<Recorded> = frames
        .iter()
        .filter(|frame| frame.bytes.starts_with(&[0x01, 0x03, 0x08, 0x34]))
        .cloned()
        .collect();
    let starts = starts(&reads, Direction::ToDrives);
    let pairs = starts.iter().zip(starts.iter().skip(1));
    pairs.map(|(start, next)| (next - start) * 1e3).collect()
}

async fn connect(from: Ipv4Addr, to: SocketAddr) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind(SocketAddr::new(IpAddr::V4(from), 0))?;
    let stream = timeout(PATIENCE, socket.connect(to)).await??;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Writes the speed reference of drive 1 over a new connection.
async fn command(modbus: SocketAddr, value: u16) -> io::Result<()> {
    let mut stream = connect(OPERATOR, modbus).await?;
    let [high, low] = value.to_be_bytes();
    let request = [0, 1, 0, 0, 0, 6, 1, 6, 0x81, 0x01, high, low];
    stream.write_all(&request).await?;
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).await?;
    if answer == request {
        Ok(())
    } else {
        Err(io::ErrorKind::InvalidData.into())
    }
}

/// Polls the common model of drive 1: latencies in ms, and connections or answers lost.
async fn poll(modbus: SocketAddr, until: Instant) -> (Vec<f64>, usize) {
    let (mut latencies, mut lost) = (Vec::new(), 0);
    let mut stream = connect(SCADA, modbus).await.ok();
    while Instant::now() < until {
        let asked = Instant::now();
        match &mut stream {
            Some(open) => {
                if timeout(PATIENCE, read_model(open))
                    .await
                    .is_ok_and(|answer| answer.is_ok())
                {
                    latencies.push(asked.elapsed().as_secs_f64() * 1e3);
                } else {
                    lost += 1;
                    stream = None;
                }
            }
            None => stream = connect(SCADA, modbus).await.ok(),
        }
        sleep(Duration::from_millis(20)).await;
    }
    (latencies, lost)
}

async fn read_model(stream: &mut TcpStream) -> io::Result<()> {
    stream.write_all(&[0, 1, 0, 0, 0, 6, 1, 3, 0x80, 0, 0, 19]).await?;
    let mut answer = [0; 9 + 2 * 19];
    stream.read_exact(&mut answer).await.map(|_| ())
}

/// Number of the operator's commands with these values in the audit.
async fn audited(http: SocketAddr, first: u16, last: u16) -> Result<usize, Box<dyn Error>> {
    let mut stream = connect(OPERATOR, http).await?;
    let request = format!("GET /api/v1/audit HTTP/1.1\r\nHost: {http}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await?;
    let mut text = String::new();
    timeout(PATIENCE, stream.read_to_string(&mut text)).await??;
    let body = text.split_once("\r\n\r\n").map(|(_, body)| body).unwrap_or_default();
    let has = |value: u16| {
        let written = format!("={}", f64::from(value) / 100.0);
        body.split(['"', ' ', ',']).any(|word| word.ends_with(&written))
    };
    Ok((first..=last).filter(|value| has(*value)).count())
}

/// Kind of an attack.
#[derive(Debug, Clone, Copy)]
enum Attack {
    None,
    SilentConnections,
    RefusedWrites,
    BadHeaders,
    ReadsNothing,
    Floods,
    SlowHttpHeads,
    EventStreams,
    ScrapesWithoutPause,
}

const ATTACKS: [Attack; 9] = [
    Attack::None,
    Attack::SilentConnections,
    Attack::RefusedWrites,
    Attack::BadHeaders,
    Attack::ReadsNothing,
    Attack::Floods,
    Attack::SlowHttpHeads,
    Attack::EventStreams,
    Attack::ScrapesWithoutPause,
];

impl Attack {
    fn name(self) -> &'static str {
        match self {
            Attack::None => "none",
            Attack::SilentConnections => "200 silent connections",
            Attack::RefusedWrites => "refused writes, 4 clients",
            Attack::BadHeaders => "bad headers, 8 clients",
            Attack::ReadsNothing => "reads nothing, 8 clients",
            Attack::Floods => "reads without end, 4",
            Attack::SlowHttpHeads => "200 slow HTTP heads",
            Attack::EventStreams => "64 event streams",
            Attack::ScrapesWithoutPause => "scrapes, 4 clients",
        }
    }

    fn clients(self) -> usize {
        match self {
            Attack::None => 0,
            Attack::RefusedWrites | Attack::Floods | Attack::ScrapesWithoutPause => 4,
            Attack::BadHeaders | Attack::ReadsNothing => 8,
            Attack::EventStreams => 64,
            Attack::SilentConnections | Attack::SlowHttpHeads => 200,
        }
    }

    /// One action of an attacker.
    async fn run(self, north: North, number: usize) -> io::Result<()> {
        match self {
            Attack::None => {}
            Attack::SilentConnections => {
                let mut stream = connect(ATTACKER, north.modbus).await?;
                let _until_closed = stream.read(&mut [0; 1]).await?;
            }
            Attack::RefusedWrites => repeat(north.modbus, &[0, 1, 0, 0, 0, 6, 1, 6, 0x81, 0x01, 0, 7]).await?,
            Attack::BadHeaders => {
                let mut stream = connect(ATTACKER, north.modbus).await?;
                let bytes: Vec<u8> = (0..64).map(|n| (n * 37 + number) as u8 | 0x80).collect();
                stream.write_all(&bytes).await?;
                let _until_closed = stream.read(&mut [0; 1]).await?;
            }
            Attack::ReadsNothing => {
                let mut stream = connect(ATTACKER, north.modbus).await?;
                let many = [0, 1, 0, 0, 0, 6, 1, 3, 0x80, 0, 0, 19].repeat(100);
                // The attacker sends until its own buffers and those of the gateway are full.
                while timeout(PATIENCE, stream.write_all(&many))
                    .await
                    .is_ok_and(|sent| sent.is_ok())
                {}
            }
            Attack::Floods => repeat(north.modbus, &[0, 1, 0, 0, 0, 6, 1, 3, 0x80, 0, 0, 19]).await?,
            Attack::SlowHttpHeads => {
                let mut stream = connect(ATTACKER, north.http).await?;
                for byte in b"GET /api/v1/drives HTTP/1.1\r\nHost: localhost\r\nX-Slow: and so on\r\n" {
                    stream.write_all(&[*byte]).await?;
                    sleep(Duration::from_millis(500)).await;
                }
            }
            Attack::EventStreams => {
                let mut stream = connect(ATTACKER, north.http).await?;
                let request = format!("GET /api/v1/events HTTP/1.1\r\nHost: {}\r\n\r\n", north.http);
                stream.write_all(request.as_bytes()).await?;
                let mut sink = vec![0; 4096];
                while stream.read(&mut sink).await? > 0 {}
            }
            Attack::ScrapesWithoutPause => {
                let mut stream = connect(ATTACKER, north.http).await?;
                let request = format!(
                    "GET /metrics HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
                    north.http
                );
                stream.write_all(request.as_bytes()).await?;
                stream.read_to_end(&mut Vec::new()).await?;
            }
        }
        Ok(())
    }
}

/// Sends `request` repeatedly over one connection, without waiting for answers.
async fn repeat(modbus: SocketAddr, request: &[u8]) -> io::Result<()> {
    let stream = connect(ATTACKER, modbus).await?;
    let (mut read, mut write) = stream.into_split();
    let batch: Arc<[u8]> = request.repeat(8).into();
    let reader = async {
        let mut sink = vec![0; 16 * 1024];
        while read.read(&mut sink).await? > 0 {}
        Ok::<(), io::Error>(())
    };
    let writer = async {
        loop {
            write.write_all(&batch).await?;
        }
    };
    tokio::select! {
        ended = reader => ended,
        ended = writer => ended,
    }
}
