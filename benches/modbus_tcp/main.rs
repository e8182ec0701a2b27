//! The Modbus TCP server beside others: tokio-modbus, libmodbus with epoll, pymodbus.
//!
//! `cargo bench --bench modbus_tcp` (options: `-- --seconds 2 --runs 5`). Every server is a process of its own, reads are
//! function 3 with 11 registers. All take turns in short runs, and each figure is the median of the runs. At the end the
//! rounds of a bus at 115200 baud, without and with that load on the daemon; `--rounds 5` measures these alone, so often.

mod client;
#[path = "../common/mod.rs"]
mod common;
mod servers;

use std::error::Error;
use std::process::ExitCode;
use std::time::Duration;

use client::{Load, load};
use common::{median, option};
use servers::Process;

/// Connections and requests in a batch.
const LOADS: [(usize, usize); 3] = [(1, 1), (16, 1), (16, 8)];

fn main() -> ExitCode {
    let serve = std::env::args().skip_while(|argument| argument != "--serve").nth(1);
    let outcome = match serve {
        Some(name) => servers::serve(&name),
        None => measure(),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure() -> Result<(), Box<dyn Error>> {
    let time = Duration::from_secs_f64(option("--seconds", 2.0)?);
    let runs: usize = option("--runs", 5)?;
    let alone: usize = option("--rounds", 0)?;
    if alone > 0 {
        return rounds(time, alone);
    }
    let mut servers = vec![Process::own("drivegate")?, Process::own("tokio-modbus")?];
    for (name, server) in [("libmodbus", Process::libmodbus()), ("pymodbus", Process::pymodbus())] {
        match server {
            Ok(server) => servers.push(server),
            Err(why) => eprintln!("{name} is left out: {why}"),
        }
    }
    println!("| server | connections × depth | requests/s | batch p50, µs | p99, µs | server µs/request |");
    println!("|---|---|---|---|---|---|");
    for (connections, depth) in LOADS {
        let mut found: Vec<Vec<(Load, f64)>> = servers.iter().map(|_| Vec::new()).collect();
        for run in 0..runs {
            for turn in 0..servers.len() {
                let place = (turn + run) % servers.len();
                let (Some(server), Some(found)) = (servers.get(place), found.get_mut(place)) else {
                    continue;
                };
                let before = server.cpu();
                let load = match load(server.address, connections, depth, time) {
                    Ok(load) => load,
                    // pymodbus answers one request of a batch and forgets the others.
                    Err(why) if place > 0 => {
                        eprintln!("{}, {connections} × {depth}: {why}", server.name);
                        continue;
                    }
                    Err(why) => return Err(why),
                };
                found.push((load, (server.cpu() - before) / load.answered.max(1) as f64 * 1e6));
            }
        }
        let rates: Vec<f64> = found
            .iter()
            .map(|runs| median(&runs.iter().map(|(l, _)| l.rate).collect::<Vec<_>>()))
            .collect();
        for (server, runs) in servers.iter().zip(&found) {
            if runs.is_empty() {
                println!("| {} | {connections} × {depth} | none | | | |", server.name);
                continue;
            }
            let middle = |of: fn(&(Load, f64)) -> f64| median(&runs.iter().map(of).collect::<Vec<_>>());
            println!(
                "| {} | {connections} × {depth} | {:.0} | {:.0} | {:.0} | {:.1} |",
                server.name,
                middle(|(l, _)| l.rate),
                middle(|(l, _)| l.p50),
                middle(|(l, _)| l.p99),
                middle(|(_, cpu)| *cpu),
            );
        }
        let best = rates.iter().skip(1).copied().fold(0.0, f64::max);
        if let Some(own) = rates.first() {
            println!(
                "| drivegate of the best other | {connections} × {depth} | {:.2} | | | |",
                own / best.max(1.0)
            );
        }
    }
    drop(servers);
    rounds(time, runs)
}

/// The rounds of a bus, without and with load, in turns; four times as long, since one in a hundred counts.
fn rounds(time: Duration, runs: usize) -> Result<(), Box<dyn Error>> {
    let mut daemon = Process::own("line")?;
    let mut found = [Vec::new(), Vec::new()];
    let mut rates = Vec::new();
    for run in 0..2 * runs {
        daemon.ask("begin")?;
        match run % 2 {
            0 => std::thread::sleep(time * 4),
            _ => rates.push(load(daemon.address, 16, 1, time * 4)?.rate),
        }
        let figures = daemon.ask("end")?;
        let figures: Result<Vec<f64>, _> = figures.split(' ').map(str::parse).collect();
        if let Some(found) = found.get_mut(run % 2) {
            found.push(figures?);
        }
    }
    println!("\n| load on the daemon | cycle p50, ms | cycle p99, ms | p99 of the runs |\n|---|---|---|---|");
    let told = format!("16 × 1, {:.0} requests/s", median(&rates));
    for (load, found) in ["none", &told].iter().zip(&found) {
        let column = |at: usize| -> Vec<f64> { found.iter().filter_map(|f| f.get(at).copied()).collect() };
        let each: Vec<String> = column(1).iter().map(|p99| format!("{p99:.2}")).collect();
        let (p50, p99) = (median(&column(0)), median(&column(1)));
        println!("| {load} | {p50:.3} | {p99:.3} | {} |", each.join(", "));
    }
    Ok(())
}
