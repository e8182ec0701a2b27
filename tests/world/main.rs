//! The whole gateway in a seeded world in virtual time: the real core of every bus, the real command queue, the real
//! dialogues of Modbus TCP and the real intake of MQTT, simulated drives of all families on simulated half-duplex
//! wires. A seed decides who sends what when, what the wire does to it, and what befalls drives and ports. Every step is
//! checked against what must always hold (see `checks`); a seed that fails prints itself and the end of its history.
//!
//! `make check` runs fixed seeds. `make world SEEDS=n` runs n new ones, `WORLD_SEED=n` one again with its history.

#![allow(
    unreachable_pub,
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::panic,
    clippy::expect_used,
    reason = "a test may panic, its helpers too"
)]

mod bus;
mod clients;
mod cost;
mod drives;
mod families;
mod history;
mod matrix;
mod n2;
mod one_bus;
mod orders;
mod prediction;
mod rig;
mod scenario;
mod world;

use std::time::{Duration, Instant};

use self::scenario::Scenario;
use self::world::{Figures, World};

/// Seeds of every test run.
const FIXED: u64 = 400;

/// One world from its beginning to the end of its gateway.
fn run(seed: u64) -> Figures {
    World::new(Scenario::of(seed)).run()
}

fn run_all(seeds: impl Iterator<Item = u64>) {
    let began = Instant::now();
    let mut all = Figures::default();
    // To see how many seeds meet a fault, and which.
    let goes_on = std::env::var_os("WORLD_GO_ON").is_some();
    let mut failed = Vec::new();
    for seed in seeds {
        let figures = match std::panic::catch_unwind(|| run(seed)) {
            Ok(figures) => figures,
            Err(cause) if !goes_on => std::panic::resume_unwind(cause),
            Err(_) => {
                failed.push(seed);
                continue;
            }
        };
        all.add(&figures);
        if std::env::var_os("WORLD_EACH").is_some() {
            println!("seed {seed}: {figures}");
        }
    }
    let took = began.elapsed();
    let speed = all.bus_time.as_secs_f64() / 60.0 / took.as_secs_f64();
    assert!(failed.is_empty(), "seeds that failed: {failed:?}");
    println!("{all}; in {took:.1?}: {speed:.1} bus-minutes a second");
}

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().expect("a number"))
}

#[test]
fn fixed_seeds() {
    match (number("WORLD_SEED"), number("WORLD_SEEDS")) {
        (Some(seed), _) => run_all(seed..seed + 1),
        (None, Some(count)) => {
            let first = number("WORLD_FROM").unwrap_or_else(|| {
                let since = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap_or(Duration::ZERO);
                since.as_secs() * 1_000_000
            });
            println!("seeds {first} to {}", first + count - 1);
            run_all(first..first + count);
        }
        (None, None) => run_all(0..FIXED),
    }
}

#[test]
fn the_same_seed_is_the_same_world() {
    for seed in [3, 17] {
        assert_eq!(run(seed), run(seed));
    }
}
