//! Output while lines are being simulated.

use std::io::{self, IsTerminal, Write};
use std::time::{Duration, Instant};

use tokio::signal::unix::{SignalKind, signal};

use drivegate_sim::simulated_drive::SimulatedDrive;
use drivegate_sim::statistics::Statistics;
use drivegate_sim::wire::SimulatedBus;

/// Prints the lines and, once a second on a terminal, their counters; ends on Ctrl-C and SIGTERM.
pub(super) fn serve(lines: &[SimulatedBus]) -> io::Result<()> {
    let mut out = io::stdout();
    for line in lines {
        writeln!(out, "{}", line.description())?;
    }
    writeln!(out, "Ctrl-C ends the simulation.")?;
    out.flush()?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(watch(lines))?;
    writeln!(out, "{}", summary(&total(lines)))
}

async fn watch(lines: &[SimulatedBus]) -> io::Result<()> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut trip = signal(SignalKind::user_defined1())?;
    let mut panel = signal(SignalKind::user_defined2())?;
    let mut second = tokio::time::interval(Duration::from_secs(1));
    let live = io::stdout().is_terminal();
    let (mut before, mut then) = (total(lines), Instant::now());
    loop {
        tokio::select! {
            _ = interrupt.recv() => break,
            _ = terminate.recv() => break,
            _ = trip.recv() => every_drive(lines, |drive| drive.trip(1)),
            _ = panel.recv() => every_drive(lines, |drive| {
                let remote = drive.state().remote;
                drive.set_remote(!remote);
            }),
            _ = second.tick(), if live => {
                let (now, at) = (total(lines), Instant::now());
                let seconds = at.duration_since(then).as_secs_f64().max(0.001);
                let rate = (now.requests - before.requests) as f64 / seconds;
                print!("\r\x1b[K{rate:7.1} requests/s   {}", summary(&now));
                io::stdout().flush()?;
                (before, then) = (now, at);
            }
        }
    }
    if live {
        println!();
    }
    Ok(())
}

fn every_drive(lines: &[SimulatedBus], act: impl Fn(&mut SimulatedDrive)) {
    for line in lines {
        for address in 0..=u8::MAX {
            line.with_drive(address, |drive, _| act(drive));
        }
    }
}

fn total(lines: &[SimulatedBus]) -> Statistics {
    lines.iter().map(|line| line.statistics()).sum()
}

/// The counters that distinguish a good master from a bad one; rare ones only when they are not 0.
fn summary(s: &Statistics) -> String {
    let mut text = format!(
        "{} requests, {} replies, {} too early",
        s.requests, s.replies, s.silence_violations
    );
    let rare = [
        (s.collisions, "collisions"),
        (s.bad_crc, "bad frames"),
        (s.unanswered, "unanswered"),
        (s.broadcasts, "broadcasts"),
        (s.faults, "faults injected"),
        (s.bytes_lost, "bytes not read"),
    ];
    for (count, name) in rare.into_iter().filter(|(count, _)| *count > 0) {
        text.push_str(&format!(", {count} {name}"));
    }
    text
}
