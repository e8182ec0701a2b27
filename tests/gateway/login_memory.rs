//! Memory of the gateway while passwords are guessed, for which no account is needed.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::support::process::{Running, drivegate};
use crate::support::site::{HTTP, LINE1, Site, USERS, controlled};
use crate::support::tools::{run, tool};

/// Wrong passwords that are to be compared.
const WRONG: usize = 200;
/// Guesses of each address, which has to wait after five.
const GUESSES: usize = 4;
/// Addresses that may guess: more than are needed, because a busy machine compares no more than sixteen that wait.
const ADDRESSES: usize = 250;
/// Connections that guess at the same time. Each has one guess under way; sixteen may wait.
const AT_ONCE: usize = 8;

/// Resident memory of the process, bytes, without the pages of its program file: those of a build for tests are several
/// times as large as those of a release, for which `check` states the memory.
fn resident(gateway: &Running) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", gateway.pid())).unwrap();
    let bytes = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        let kilobytes: u64 = line.trim().strip_suffix(" kB").unwrap().parse().unwrap();
        kilobytes << 10
    };
    bytes("VmRSS:").saturating_sub(bytes("RssFile:"))
}

/// The memory that `check` states for the configuration, bytes.
fn stated(site: &Site) -> u64 {
    let checked = drivegate(&["check", "--json", "--config", &site.config()])
        .output()
        .unwrap();
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    report["memory_bytes"].as_u64().unwrap()
}

/// Guesses of one address over one connection; returns how many were compared and found wrong.
fn guess(site: &Site, address: usize) -> usize {
    let (from, url) = (
        format!("127.0.1.{}", address + 1),
        format!("http://127.0.0.1:{}/api/v1/drives/pump-1/commands", site.http),
    );
    // Guesses of one user by many addresses are slowed down, so most addresses name a user that does not exist.
    let user = if address.is_multiple_of(10) {
        "alice:guess".to_string()
    } else {
        format!("guest-{address}:guess")
    };
    let mut arguments = vec!["-sS", "--interface", &from, "-u", &user, "-d", "{\"run\": false}"];
    arguments.extend(["-w", "\n%{http_code}\n"]);
    arguments.extend(std::iter::repeat_n(url.as_str(), GUESSES));
    let answers = run(&tool("curl"), &arguments);
    let text = String::from_utf8(answers.stdout).unwrap();
    text.lines().filter(|line| *line == "401").count()
}

#[test]
fn wrong_logins_take_no_more_memory_than_check_states() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, ""), HTTP, USERS]);
    site.add_user("alice");
    let _line = site.line(&[1]);
    let gateway = site.run_ready();
    let stated = stated(&site);
    let (next, wrong) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let mut most = 0;
    std::thread::scope(|scope| {
        let guesser = || {
            while wrong.load(Ordering::Relaxed) < WRONG {
                let address = next.fetch_add(1, Ordering::Relaxed);
                if address >= ADDRESSES {
                    return;
                }
                wrong.fetch_add(guess(&site, address), Ordering::Relaxed);
            }
        };
        let guessers: Vec<_> = (0..AT_ONCE).map(|_| scope.spawn(guesser)).collect();
        while !guessers.iter().all(|guesser| guesser.is_finished()) {
            most = most.max(resident(&gateway));
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    let ended = Instant::now();
    while ended.elapsed() < Duration::from_secs(3) {
        most = most.max(resident(&gateway));
        std::thread::sleep(Duration::from_millis(20));
    }
    let wrong = wrong.into_inner();
    println!("{wrong} guesses: at most {most} bytes resident, {stated} stated");
    assert!(wrong >= WRONG, "{wrong} passwords were compared");
    assert!(most <= stated, "{most} bytes are resident, and check states {stated}");
}
