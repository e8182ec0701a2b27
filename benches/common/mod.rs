//! Parts that the benches share: the gateway under test, clients of its servers, medians, and the evaluation of a
//! transcript.
// Each bench uses only some of these parts.
#![allow(dead_code, unreachable_pub)]

pub mod gateway;
pub mod session;

use std::error::Error;
use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use drivegate_sim::SimTime;
use drivegate_sim::statistics::{Direction, Recorded};

/// The exit code of a bench, whose error is printed.
pub fn exit(outcome: Result<(), Box<dyn Error>>) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Path of a file in this folder.
pub fn file(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("benches").join(name)
}

/// Compiles a C program that uses libmodbus.
pub fn compile(source: &str, program: &Path) -> Result<(), String> {
    let output = Command::new("gcc")
        .args(["-O2", "-I/usr/include/modbus", "-o"])
        .arg(program)
        .arg(file(source))
        .arg("-lmodbus")
        .output();
    match output {
        Ok(output) if output.status.success() => Ok(()),
        _ => Err("it cannot be compiled; apt install gcc libc6-dev libmodbus-dev".to_string()),
    }
}

/// Processor time of a process so far, s.
pub fn processor_time(process: u32) -> Result<f64, Box<dyn Error>> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat"))?;
    // The fields after the name, which may contain anything: utime and stime are the fields 14 and 15.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |index: usize| {
        fields
            .get(index)
            .and_then(|f| f.parse::<f64>().ok())
            .ok_or("no time in stat")
    };
    Ok((ticks(11)? + ticks(12)?) / rustix::param::clock_ticks_per_second() as f64)
}

/// Waits at most two minutes until `there` holds.
///
/// # Errors
/// If the condition is not met in time.
pub fn wait(what: &str, there: impl Fn() -> bool) -> Result<(), Box<dyn Error>> {
    let patience = Instant::now() + Duration::from_secs(120);
    while !there() {
        if Instant::now() > patience {
            return Err(format!("{what} does not come up").into());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// Resident memory of a process, MiB.
///
/// # Errors
/// If the process does not exist.
pub fn resident_memory(process: u32) -> Result<f64, Box<dyn Error>> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status"))?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .ok_or("no VmRSS")?;
    let kilobytes: f64 = line.split_whitespace().next().unwrap_or_default().parse()?;
    Ok(kilobytes / 1024.0)
}

/// The value of the option `name` on the command line of the bench, or `default`.
pub fn option<T: std::str::FromStr>(name: &str, default: T) -> Result<T, String> {
    let given = std::env::args().skip_while(|argument| argument != name).nth(1);
    given.map_or(Ok(default), |text| {
        text.parse()
            .map_err(|_| format!("`{text}` is not a valid value for {name}; write a number"))
    })
}

/// The median of the values; 0 if there are none.
pub fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

/// The value that a share `of` of all does not exceed.
pub fn quantile(values: &[f64], of: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    sorted
        .get((of * last as f64).round() as usize)
        .copied()
        .unwrap_or_default()
}

/// Start times, s, of the frames in that direction.
pub fn starts(frames: &[Recorded], direction: Direction) -> Vec<f64> {
    let wanted = frames.iter().filter(|frame| frame.direction == direction);
    wanted.map(|frame| frame.start.as_secs_f64()).collect()
}

/// Frames per second from the first to the last: an incomplete transaction at either end does not change the result.
pub fn rate(starts: &[f64]) -> f64 {
    match (starts.first(), starts.last()) {
        (Some(first), Some(last)) if last > first => (starts.len() - 1) as f64 / (last - first),
        _ => 0.0,
    }
}

/// Silence before each request, s: from the end of any frame to the start of the next request.
pub fn silences(frames: &[Recorded]) -> Vec<f64> {
    let mut end = SimTime::ZERO;
    let mut silences = Vec::new();
    for frame in frames {
        if frame.direction == Direction::ToDrives && !end.is_zero() {
            silences.push(frame.start.saturating_sub(end).as_secs_f64());
        }
        end = end.max(frame.end);
    }
    silences
}

/// Clients of the servers that continuously make 100 Modbus TCP reads, if there is such a server, and one scrape of
/// the metrics.
pub struct Readers {
    end: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<u64>,
}

impl Readers {
    /// Reads `units` unit ids from 1 on, with a pause before the next round.
    pub fn start(modbus: Option<SocketAddr>, http: SocketAddr, units: u8, pause: Duration) -> Readers {
        let end = Arc::new(AtomicBool::new(false));
        let ended = end.clone();
        let thread = std::thread::spawn(move || {
            let mut answered = 0;
            while !ended.load(Ordering::Relaxed) {
                answered += u64::from(read_north(modbus, http, units).is_ok());
                std::thread::sleep(pause);
            }
            answered
        });
        Readers { end, thread }
    }

    /// Ends the reading clients.
    ///
    /// # Errors
    /// If the servers never answered.
    pub fn stop(self) -> Result<(), String> {
        self.end.store(true, Ordering::Relaxed);
        match self.thread.join() {
            Ok(1..) => Ok(()),
            _ => Err("the north sides of the gateway did not answer".to_string()),
        }
    }
}

fn read_north(modbus: Option<SocketAddr>, http: SocketAddr, units: u8) -> std::io::Result<()> {
    if let Some(modbus) = modbus {
        let mut client = TcpStream::connect(modbus)?;
        client.set_read_timeout(Some(Duration::from_secs(1)))?;
        let mut head = [0u8; 6];
        let mut body = [0u8; 256];
        for unit in (1..=units).cycle().take(100) {
            client.write_all(&[0, 1, 0, 0, 0, 6, unit, 3, 0x08, 0x34, 0, 11])?;
            client.read_exact(&mut head)?;
            let body = body.get_mut(..usize::from(head[5])).unwrap_or_default();
            client.read_exact(body)?;
            // The answer must have function 3 and be no exception.
            if body.get(1) != Some(&3) {
                return Err(std::io::ErrorKind::InvalidData.into());
            }
        }
    }
    scrape(http).map(|_| ())
}

/// The metrics as text.
pub fn scrape(http: SocketAddr) -> std::io::Result<String> {
    let mut client = TcpStream::connect(http)?;
    client.set_read_timeout(Some(Duration::from_secs(5)))?;
    client.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")?;
    let mut text = String::new();
    client.read_to_string(&mut text)?;
    Ok(text)
}
