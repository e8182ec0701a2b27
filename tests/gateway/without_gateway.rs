//! Commands while no gateway runs: they serve nobody, honour what the gateway left on disk, and count their starts.

use std::net::{TcpListener, UdpSocket};
use std::path::PathBuf;

use serde_json::{Value as Json, json};

use super::bacnet::free_udp_port;
use super::drive_access::{Ran, drivegate};
use crate::support::process::{Running, free_port, until};
use crate::support::site::{LINE1, Site, controlled};

/// A site whose state directory is `state`.
fn site(drives: &str, servers: &str) -> Site {
    let line = LINE1.replace("profile_dirs", "state_dir = \"state\"\nprofile_dirs");
    let site = Site::of(&[&line, drives, servers]);
    std::fs::create_dir(site.file("state")).unwrap();
    site
}

/// A command to a drive, repeated while a busy machine lets it expire.
fn write(site: &Site, rest: &[&str]) -> Ran {
    let config = site.config();
    let arguments = [&["write", "--config", &config], rest].concat();
    until("a command in time", || {
        let ran = drivegate(&arguments);
        let late = ["(expired)", "(timeout)", "(unknown)", "(garbled)"];
        (!late.iter().any(|code| ran.err.contains(code))).then_some(ran)
    })
}

fn carried_out(site: &Site, rest: &[&str]) {
    let ran = write(site, rest);
    assert_eq!(ran.code, 0, "{rest:?}: {}{}", ran.out, ran.err);
}

fn refused(site: &Site, rest: &[&str], wanted: &[&str]) {
    let ran = write(site, rest);
    assert_eq!(ran.code, 1, "{rest:?}: {}{}", ran.out, ran.err);
    for wanted in wanted {
        assert!(ran.err.contains(wanted), "{rest:?}: {wanted} is missing in {}", ran.err);
    }
}

fn runs(site: &Site, drive: &str, wanted: bool) {
    until(&format!("{drive} runs: {wanted}"), || {
        let ran = drivegate(&["read", "--json", "--config", &site.config(), drive, "running"]);
        let rows: Json = serde_json::from_str(&ran.out).ok()?;
        (rows[0]["value"] == wanted).then_some(())
    });
}

/// Writes a file of the state directory, as an earlier run of the gateway left it.
fn left(site: &Site, name: &str, content: &Json) -> (PathBuf, Vec<u8>) {
    let (file, bytes) = (site.file("state").join(name), content.to_string().into_bytes());
    std::fs::write(&file, &bytes).unwrap();
    (file, bytes)
}

fn machine(site: &Site, address: u8, more: Json) -> Json {
    let mut machine = json!({"port": site.path("line1"), "address": address, "profile": "vacon-nx"});
    let fields = machine.as_object_mut().unwrap();
    fields.extend(more.as_object().unwrap().clone());
    machine
}

#[test]
fn a_command_serves_nobody_and_honours_locks_without_touching_them() {
    let (bacnet, slot) = (free_udp_port(), free_port());
    let servers = format!(
        "[bacnet]\nlisten = \"127.0.0.10:{bacnet}\"\ncommands = true\nwrite = [\"127.0.0.16/28\"]\nkeep_priorities = true\n\
         [drill]\n[audit]\nfile = \"audit.jsonl\"\n"
    );
    let slots = format!("[[bus.slot]]\nlisten = \"127.0.0.1:{slot}\"\naccess = \"write\"\n");
    let drives = controlled("pump-1", 1, "") + &controlled("fan-2", 2, "") + &controlled("fan-3", 3, "") + &slots;
    let site = site(&drives, &servers);
    let _line = site.line(&[1, 2, 3]);
    let locked = |address| {
        let more = json!({"priority": 1, "who": "127.0.0.20:47808", "client": "bacnet 127.0.0.20"});
        machine(&site, address, more)
    };
    let (file, bytes) = left(&site, "bacnet-priorities.json", &json!([locked(1), locked(2)]));
    let untouched = |after: &str| {
        let found = std::fs::read(&file).unwrap_or_default();
        let found = String::from_utf8_lossy(&found).into_owned();
        assert_eq!(found, String::from_utf8_lossy(&bytes), "after {after}");
    };
    let read = |drive: &str| drivegate(&["read", "--config", &site.config(), drive, "running"]);
    until("a reading", || (read("pump-1").code == 0).then_some(()));
    untouched("a reading");
    refused(&site, &["fan-2", "run=true"], &["the BACnet client", "(held_by_other)"]);
    carried_out(&site, &["fan-2", "run=false"]);
    carried_out(&site, &["fan-3", "run=true"]);
    untouched("commands");
    let why = drivegate(&["why", "--config", &site.config(), "pump-1"]);
    assert!(why.code == 0, "{}", why.err);
    // Other commands, or another program, may have the ports of the servers: a stop needs none of them.
    let taken = (
        UdpSocket::bind(("127.0.0.10", bacnet)).ok(),
        TcpListener::bind(("127.0.0.1", slot)).ok(),
    );
    carried_out(&site, &["fan-3", "run=false"]);
    runs(&site, "fan-3", false);
    drop(taken);
    // A file that cannot be read may forbid any start, and stays as it is.
    std::fs::write(&file, "[{").unwrap();
    refused(
        &site,
        &["fan-3", "run=true"],
        &["bacnet-priorities.json", "(held_by_other)"],
    );
    carried_out(&site, &["fan-3", "run=false"]);
    assert_eq!(std::fs::read(&file).unwrap(), b"[{");
    // Without `keep_priorities` the gateway will discard the slots, a command does not.
    std::fs::write(&file, &bytes).unwrap();
    site.change("keep_priorities = true\n", "");
    carried_out(&site, &["fan-2", "run=true"]);
    carried_out(&site, &["fan-2", "run=false"]);
    untouched("commands without keep_priorities");
    let mut names: Vec<String> = std::fs::read_dir(site.file("state"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names, ["audit.jsonl", "bacnet-priorities.json"]);
}

#[test]
fn a_reservation_binds_a_command() {
    let uid = rustix::process::geteuid().as_raw();
    let authority = format!(
        "[authority]\nmode = \"exclusive\"\nlease = \"1h\"\n\
         [[authority.principal]]\nname = \"clerk\"\nrank = \"remote\"\nsocket = \"{uid}\"\n"
    );
    let drives = controlled("pump-1", 1, "") + &controlled("fan-2", 2, "");
    let site = site(&drives, &authority);
    let _line = site.line(&[1, 2]);
    let now = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_millis();
    let now = u64::try_from(now).unwrap();
    let more = json!({"who": "alice", "rank": "operator", "stopped_ms": now, "lease_ms": 3_600_000});
    let (file, bytes) = left(&site, "reservations.json", &json!([machine(&site, 1, more)]));
    carried_out(&site, &["fan-2", "run=true"]);
    carried_out(&site, &["fan-2", "run=false"]);
    refused(&site, &["pump-1", "run=true"], &["alice", "(held_by_other)"]);
    carried_out(&site, &["pump-1", "run=false"]);
    assert_eq!(std::fs::read(&file).unwrap(), bytes);
}

/// The starts of a machine that are in the file.
fn counted(site: &Site, address: u8) -> Vec<u64> {
    let text = std::fs::read_to_string(site.file("state/starts.json")).unwrap_or_default();
    let saved: Json = serde_json::from_str(&text).unwrap_or_default();
    let motors = saved["motors"].as_array().cloned().unwrap_or_default();
    let of_machine = motors.iter().filter(|motor| motor["address"] == address);
    of_machine
        .flat_map(|motor| motor["starts"].as_array().unwrap().clone())
        .map(|at| at.as_u64().unwrap())
        .collect()
}

#[test]
fn starts_without_a_gateway_are_counted_for_it() {
    let drives = controlled("pump-1", 1, "guard = { starts_per_hour = 2 }") + &controlled("fan-2", 2, "");
    let site = site(&drives, "");
    let _line = site.line(&[1, 2]);
    let now = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_millis();
    let earlier = u64::try_from(now).unwrap() - 600_000;
    let other = machine(&site, 9, json!({"starts": [earlier]}));
    left(&site, "starts.json", &json!({"drivegate_starts": 1, "motors": [other]}));
    let (start, often) = (&["pump-1", "run=true"], ["2 starts within the last hour", "(guarded)"]);
    // A start that a busy machine held up may count, too.
    let mut done = 0;
    let third = loop {
        let ran = write(&site, start);
        if ran.code != 0 {
            break ran;
        }
        done += 1;
        assert!(done <= 2 && counted(&site, 1).len() >= done, "{done} starts");
        runs(&site, "pump-1", true);
        carried_out(&site, &["pump-1", "run=false"]);
        runs(&site, "pump-1", false);
    };
    assert!(often.iter().all(|wanted| third.err.contains(wanted)), "{}", third.err);
    assert_eq!(counted(&site, 1).len(), 2);
    carried_out(&site, &["pump-1", "run=false"]);
    // The starts of other motors stay in the file; a conversion of clocks may move them by a moment.
    let [kept] = counted(&site, 9)[..] else {
        panic!("{:?}", counted(&site, 9))
    };
    assert!(kept.abs_diff(earlier) < 10_000, "{kept} {earlier}");
    // The gateway knows of them.
    let gateway = Running::drivegate(&["run", "--config", &site.config()]);
    gateway.until_printed("drivegate is running");
    let through = until("the gateway", || {
        let ran = write(&site, start);
        (!ran.err.contains("(offline)") && !ran.err.contains("(bus_down)")).then_some(ran)
    });
    assert!(through.err.contains(often[0]), "{}{}", through.out, through.err);
}

/// A gateway for another line counts starts in this directory.
#[test]
fn starts_that_another_process_counts_are_refused_and_stops_are_not() {
    let guard = "guard = { starts_per_hour = 9 }";
    let site = site(&controlled("pump-1", 1, guard), "");
    let _line = site.line(&[1]);
    let text = std::fs::read_to_string(site.config()).unwrap();
    site.write(
        "other.conf",
        &text.replace("\"line1\"", "\"line9\"").replace("own.sock", "other.sock"),
    );
    let mut other = Running::drivegate(&["run", "--config", &site.path("other.conf")]);
    other.until_printed("drivegate is running");
    until("its file", || site.file("state/starts.json").exists().then_some(()));
    refused(
        &site,
        &["pump-1", "run=true"],
        &["another drivegate counts", "(guarded)"],
    );
    carried_out(&site, &["pump-1", "run=false"]);
    assert!(counted(&site, 1).is_empty());
    // The file is free again as soon as that process is gone, however it ended.
    other.signal("KILL");
    other.ended();
    carried_out(&site, &["pump-1", "run=true"]);
    assert!(!counted(&site, 1).is_empty());
    carried_out(&site, &["pump-1", "run=false"]);
}
