//! Measures how close the gateway comes to the limit of the wire, compared with other masters on one simulated line.
//!
//! `cargo bench --bench bus` (options: `-- --seconds 2 --runs 7 --baud 38400`). Ten drives, reads of the eleven process
//! data registers, 8N1, turnaround 0.5 ms, 3.5 characters of silence. The gateway runs whole, and its Modbus TCP and HTTP
//! sides are read meanwhile. The masters take turns, run by run; the figures are medians of the runs, and all are taken
//! from the transcript of the simulated line.

mod common;
mod bus {
    pub(crate) mod bare_master;
    pub(crate) mod gateway;
    pub(crate) mod peers;
}

use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use drivegate_proto::wire::usual_bauds;
use drivegate_proto::{LineFormat, Request, RequestPdu, Table};
use drivegate_sim::half_duplex::LineRules;
use drivegate_sim::statistics::{Direction, Statistics};
use drivegate_sim::wire::SimulatedBus;

use bus::bare_master::{self, BareOptions};
use bus::gateway;
use bus::peers::{self, Libmodbus};
use common::{median, option, rate, starts};

const DRIVES: std::ops::RangeInclusive<u8> = 1..=10;
/// Time limit for a reply.
const TIMEOUT: Duration = Duration::from_millis(100);
/// Last part of a pause in which a master spins on the clock, since the kernel wakes it about ten microseconds late.
const SPIN: Duration = Duration::from_micros(60);

/// The master that polls the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Master {
    Bare,
    Gateway,
    TokioModbus { pause: bool },
    Libmodbus { pause: bool },
}

impl Master {
    const ALL: [Master; 6] = [
        Master::Bare,
        Master::Gateway,
        Master::TokioModbus { pause: true },
        Master::Libmodbus { pause: true },
        Master::TokioModbus { pause: false },
        Master::Libmodbus { pause: false },
    ];

    fn name(self) -> &'static str {
        match self {
            Master::Bare => "bare master",
            Master::Gateway => "gateway",
            Master::TokioModbus { pause: true } => "tokio-modbus, pause",
            Master::TokioModbus { pause: false } => "tokio-modbus",
            Master::Libmodbus { pause: true } => "libmodbus, pause",
            Master::Libmodbus { pause: false } => "libmodbus",
        }
    }

    /// A master that breaks the rules is shown, but not measured with care.
    fn runs(self, wanted: usize) -> usize {
        match self {
            Master::TokioModbus { pause: false } | Master::Libmodbus { pause: false } => 1,
            _ => wanted.max(1),
        }
    }
}

/// Result of one run of one master.
#[derive(Debug, Clone, Copy)]
struct Run {
    /// Replies per second.
    rate: f64,
    requests: u64,
    /// Requests that began before 3.5 characters of silence, or during a reply.
    too_early: u64,
    unanswered: u64,
    /// Median lateness of the simulator itself when it delivers its replies.
    late: Duration,
}

fn main() -> ExitCode {
    common::exit(measure())
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 2.0)?);
    let runs: usize = option("--runs", 7)?;
    let one: u32 = option("--baud", 0)?;
    let bauds = if one == 0 { usual_bauds().collect() } else { vec![one] };
    let libmodbus = Libmodbus::build();
    if let Err(why) = &libmodbus {
        println!("libmodbus is left out: {why}");
    }
    println!(
        "{runs} runs of {} s each in turns, medians; too early: requests without 3.5 characters of silence before them",
        time.as_secs_f64()
    );
    println!(
        "{:>7} {:<20} {:>9} {:>9} {:>8} {:>8} {:>9} {:>10} {:>8}",
        "baud", "master", "limit/s", "replies/s", "of limit", "of bare", "too early", "unanswered", "sim late"
    );
    for baud in bauds {
        let format = LineFormat::new(baud, "8N1")?;
        let mut results: Vec<(Master, Vec<Run>)> = Master::ALL.map(|master| (master, Vec::new())).into();
        for turn in 0..runs.max(1) {
            for (master, done) in results.iter_mut().filter(|(master, _)| turn < master.runs(runs)) {
                match (*master, &libmodbus) {
                    (Master::Libmodbus { .. }, Err(_)) => {}
                    (_, program) => done.push(run(*master, format, time, program.as_ref().ok())?),
                }
            }
        }
        print(format, &results);
    }
    Ok(())
}

fn print(format: LineFormat, results: &[(Master, Vec<Run>)]) {
    let limit = bare_master::wire_limit(&rod(format), &request(1), LineRules::new(format).turnaround);
    let rates = |runs: &[Run]| runs.iter().map(|run| run.rate).collect::<Vec<f64>>();
    let bare = results.first().map(|(_, runs)| rates(runs)).unwrap_or_default();
    for (master, runs) in results.iter().filter(|(_, runs)| !runs.is_empty()) {
        let all = rates(runs);
        // The masters take turns, so that a temporary slowdown of the machine affects both.
        let of_bare: Vec<f64> = all.iter().zip(&bare).map(|(rate, bare)| 100.0 * rate / bare).collect();
        let share = |of: fn(&Run) -> u64| {
            let requests: u64 = runs.iter().map(|run| run.requests).sum();
            100.0 * runs.iter().map(of).sum::<u64>() as f64 / requests.max(1) as f64
        };
        let late: Vec<f64> = runs.iter().map(|run| run.late.as_secs_f64() * 1e6).collect();
        println!(
            "{:>7} {:<20} {limit:>9.2} {:>9.2} {:>6.1} % {:>6.1} % {:>7.2} % {:>8.2} % {:>5.0} us",
            format.baud,
            master.name(),
            median(&all),
            100.0 * median(&all) / limit,
            median(&of_bare),
            share(|run| run.too_early),
            share(|run| run.unanswered),
            median(&late),
        );
    }
}

fn request(address: u8) -> Request {
    let pdu = RequestPdu::Read {
        table: Table::Holding,
        start: 2100,
        count: 11,
    };
    Request::new(address, pdu)
}

fn rod(format: LineFormat) -> BareOptions {
    BareOptions {
        format,
        silence: format.silence_chars(),
        timeout: TIMEOUT,
        spin: SPIN,
    }
}

fn run(
    master: Master,
    format: LineFormat,
    time: Duration,
    libmodbus: Option<&Libmodbus>,
) -> Result<Run, Box<dyn Error>> {
    let line = common::gateway::line(format.baud, *DRIVES.end())?;
    let port = line.address();
    let pause = |wanted: bool| if wanted { format.silence_chars() } else { Duration::ZERO };
    let before = match master {
        Master::Gateway => {
            let before = gateway::run(&line, format, time)?;
            return Ok(result(&line, before));
        }
        _ => record(&line, time, format),
    };
    match master {
        Master::Gateway => {}
        Master::Bare => {
            let requests: Vec<Request> = DRIVES.map(request).collect();
            // A separate thread is used, whose raised priority ends with it.
            let measured =
                std::thread::spawn(move || bare_master::run(Path::new(&port), &rod(format), &requests, time));
            measured.join().map_err(|_| "the bare master panicked")??;
        }
        Master::TokioModbus { pause: wanted } => peers::tokio_modbus(&port, format.baud, pause(wanted), time)?,
        Master::Libmodbus { pause: wanted } => {
            libmodbus
                .ok_or("libmodbus is not there")?
                .run(&port, format.baud, pause(wanted), time)?;
        }
    }
    Ok(result(&line, before))
}

/// Begins to record the line for `time`; returns the counters before that.
fn record(line: &SimulatedBus, time: Duration, format: LineFormat) -> Statistics {
    // A frame cannot be shorter than its characters, so this capacity is enough for all frames.
    let frames = 2.0 * time.as_secs_f64() / format.chars(8).as_secs_f64();
    line.record(frames as usize + 100);
    line.statistics()
}

fn result(line: &SimulatedBus, before: Statistics) -> Run {
    let (after, frames) = (line.statistics(), line.transcript());
    let replies = starts(&frames, Direction::FromDrives);
    let requests = starts(&frames, Direction::ToDrives).len() as u64;
    Run {
        rate: rate(&replies),
        requests,
        too_early: after.silence_violations + after.collisions - before.silence_violations - before.collisions,
        unanswered: requests.saturating_sub(replies.len() as u64),
        late: line.lateness(0.5).unwrap_or_default(),
    }
}
