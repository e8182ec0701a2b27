//! The Modbus TCP server compared with others: tokio-modbus, libmodbus with epoll, pymodbus.
//!
//! `cargo bench --bench modbus_tcp` (options: `-- --seconds 0.5 --runs 15`). Every server is a process of its own, reads are
//! function 3 with 11 registers. All take turns in short runs, and each figure is the median of the runs; `drivegate ratio`
//! is the median of the ratios turn by turn, so that what slows the machine for a while slows both sides. At the end the
//! rounds of a bus at 115200 baud, without and with that load on the daemon in turns eight times as long, since one round in
//! a hundred counts; `--rounds 15` measures these alone, so often.

mod common;
mod modbus_tcp {
    pub(crate) mod client;
    pub(crate) mod servers;
}

use std::error::Error;
use std::process::ExitCode;
use std::time::Duration;

use common::{median, option};
use modbus_tcp::client::{Load, load};
use modbus_tcp::servers::{self, Process};

/// Loads to measure: connections, and requests in a batch.
const LOADS: [(usize, usize); 3] = [(1, 1), (16, 1), (16, 8)];

fn main() -> ExitCode {
    let serve = std::env::args().skip_while(|argument| argument != "--serve").nth(1);
    common::exit(match serve {
        Some(name) => servers::serve(&name),
        None => measure(),
    })
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 0.5)?);
    let runs: usize = option("--runs", 15)?;
    let alone: usize = option("--rounds", 0)?;
    let stolen = Stolen::begin();
    if alone == 0 {
        speed(time, runs)?;
    }
    rounds(time * 8, if alone == 0 { runs } else { alone })?;
    println!("\nThe host took {:.1} % of the processors' time.", stolen.percent());
    Ok(())
}

/// Result of a server in one turn.
#[derive(Clone, Copy)]
struct Turn {
    load: Load,
    /// Processor time of the server for a request, µs.
    cost: f64,
}

fn speed(time: Duration, runs: usize) -> Result<(), Box<dyn Error>> {
    let mut servers = vec![Process::own("drivegate")?, Process::own("tokio-modbus")?];
    for (name, server) in [("libmodbus", Process::libmodbus()), ("pymodbus", Process::pymodbus())] {
        match server {
            Ok(server) => servers.push(server),
            Err(why) => eprintln!("{name} is left out: {why}"),
        }
    }
    println!(
        "| server | connections × depth | requests/s | batch p50, µs | p99, µs | server µs/request | drivegate ratio |"
    );
    println!("|---|---|---|---|---|---|---|");
    for (connections, depth) in LOADS {
        let mut found: Vec<Vec<Option<Turn>>> = servers.iter().map(|_| vec![None; runs]).collect();
        for run in 0..runs {
            for turn in 0..servers.len() {
                let place = (turn + run) % servers.len();
                let (Some(server), Some(found)) = (servers.get(place), found.get_mut(place)) else {
                    continue;
                };
                // pymodbus answers one request of a batch and drops the others, so one try is enough.
                if found.iter().take(run).any(Option::is_none) {
                    continue;
                }
                let before = server.cpu();
                let load = match load(server.address, connections, depth, time) {
                    Ok(load) => load,
                    Err(_) if place > 0 => continue,
                    Err(why) => return Err(why),
                };
                let cost = (server.cpu() - before) / load.answered.max(1) as f64 * 1e6;
                if let Some(found) = found.get_mut(run) {
                    *found = Some(Turn { load, cost });
                }
            }
        }
        let own = found.first().cloned().unwrap_or_default();
        for (server, turns) in servers.iter().zip(&found) {
            let middle = |of: fn(&Turn) -> f64| median(&turns.iter().flatten().map(of).collect::<Vec<_>>());
            if turns.iter().flatten().next().is_none() {
                println!("| {} | {connections} × {depth} | none | | | | |", server.name);
                continue;
            }
            let pairs = own
                .iter()
                .zip(turns)
                .filter_map(|(own, other)| Some((own.as_ref()?, other.as_ref()?)));
            let ratios: Vec<f64> = pairs.map(|(own, other)| own.load.rate / other.load.rate).collect();
            println!(
                "| {} | {connections} × {depth} | {:.0} | {:.0} | {:.0} | {:.1} | {:.2} |",
                server.name,
                middle(|turn| turn.load.rate),
                middle(|turn| turn.load.p50),
                middle(|turn| turn.load.p99),
                middle(|turn| turn.cost),
                median(&ratios),
            );
        }
    }
    Ok(())
}

/// The rounds of a bus, without and with load, in turns.
fn rounds(time: Duration, runs: usize) -> Result<(), Box<dyn Error>> {
    let mut daemon = Process::own("line")?;
    let mut found = [Vec::new(), Vec::new()];
    let mut rates = Vec::new();
    for run in 0..2 * runs {
        daemon.ask("begin")?;
        match run % 2 {
            0 => std::thread::sleep(time),
            _ => rates.push(load(daemon.address, 16, 1, time)?.rate),
        }
        let figures = daemon.ask("end")?;
        let figures: Result<Vec<f64>, _> = figures.split(' ').map(str::parse).collect();
        if let Some(found) = found.get_mut(run % 2) {
            found.push(figures?);
        }
    }
    println!(
        "\n| load on the daemon | written: cycle p50, ms | p99 | received by the drives: p50 | p99 |\n|---|---|---|---|---|"
    );
    let loaded_row = format!("16 × 1, {:.0} requests/s", median(&rates));
    let column =
        |found: &[Vec<f64>], at: usize| -> Vec<f64> { found.iter().filter_map(|f| f.get(at).copied()).collect() };
    for (load, found) in ["none", &loaded_row].iter().zip(&found) {
        let figures: Vec<String> = (0..4).map(|at| format!("{:.3}", median(&column(found, at)))).collect();
        println!("| {load} | {} |", figures.join(" | "));
    }
    for (at, who) in [(1, "written"), (3, "heard")] {
        let pairs = found.each_ref().map(|found| column(found, at));
        let [quiet, loaded] = pairs.each_ref();
        let ratios: Vec<f64> = quiet.iter().zip(loaded).map(|(quiet, loaded)| loaded / quiet).collect();
        let pairs: Vec<String> = quiet
            .iter()
            .zip(loaded)
            .map(|(q, l)| format!("{q:.2} to {l:.2}"))
            .collect();
        println!(
            "\np99 as {who}, pair by pair: {}; median ratio {:.3}",
            pairs.join(", "),
            median(&ratios)
        );
    }
    Ok(())
}

/// Processor time that the host of a virtual machine gave to others while this one wanted it; 0 on bare metal.
struct Stolen([f64; 2]);

impl Stolen {
    fn begin() -> Stolen {
        Stolen(Self::now())
    }

    /// Share of the requested processor time since then that was stolen.
    fn percent(&self) -> f64 {
        let ([stolen, wanted], [stolen_before, wanted_before]) = (Self::now(), self.0);
        100.0 * (stolen - stolen_before) / (wanted - wanted_before).max(1.0)
    }

    /// Ticks stolen, and all ticks but idle ones.
    fn now() -> [f64; 2] {
        let stat = std::fs::read_to_string("/proc/stat").unwrap_or_default();
        let ticks = stat.lines().next().unwrap_or_default().split_whitespace().skip(1);
        let ticks: Vec<f64> = ticks.take(8).filter_map(|ticks| ticks.parse().ok()).collect();
        let at = |place: usize| ticks.get(place).copied().unwrap_or_default();
        [at(7), ticks.iter().sum::<f64>() - at(3) - at(4)]
    }
}
