//! Files of the state directory that cannot be opened, as on a disk that hangs: named pipes without a writer.

use std::path::Path;

use drivegate_sim::statistics::Direction;
use serde_json::{Value as Json, json};

use super::bacnet::free_udp_port;
use crate::support::process::until;
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, USERS, controlled};

const REST: &str = "[mqtt.sparkplug]\ngroup = \"plant\"\n[audit]\nfile = \"audit.jsonl\"\n[drill]\n\
     [authority]\nmode = \"exclusive\"\nlease = \"30s\"\n[[authority.principal]]\nname = \"alice\"\nrank = \"operator\"\nhttp_user = \"alice\"\n";

/// Files of the state directory that are read at a start.
const FILES: [&str; 11] = [
    "events.jsonl",
    "counters.json",
    "starts.json",
    "reservations.json",
    "drills.json",
    "bacnet-priorities.json",
    "sparkplug-bdseq",
    "mqtt-topics",
    "audit.jsonl",
    "recordings/old.dgrec",
    "params/fan-3/restore.journal",
];

/// `pump-1` is guarded, `fan-2` stops with the gateway.
fn site() -> Site {
    let line = LINE1.replace("profile_dirs", "state_dir = \"state\"\nprofile_dirs");
    let drives =
        controlled("pump-1", 1, "guard = { starts_per_hour = 9 }") + &controlled("fan-2", 2, "on_shutdown = \"stop\"");
    let bacnet = format!(
        "[bacnet]\nlisten = \"127.0.0.10:{}\"\ncommands = true\nwrite = [\"127.0.0.16/28\"]\nkeep_priorities = true\n",
        free_udp_port()
    );
    let site = Site::of(&[&line, &drives, MODBUS_TCP, MQTT, REST, HTTP, USERS, &bacnet]);
    site.add_user("alice");
    site
}

fn hang(file: &Path) {
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    let mode = rustix::fs::Mode::from_raw_mode(0o600);
    rustix::fs::mknodat(rustix::fs::CWD, file, rustix::fs::FileType::Fifo, mode, 0).unwrap();
}

/// The answer to a start, once it is not refused for a temporary reason.
fn start(site: &Site, drive: &str) -> Json {
    let path = format!("drives/{drive}/commands");
    until("an answer", || {
        let (_, answer) = site.curl("alice", &path, &["-d", "{\"run\": true}"]);
        let passes = ["offline", "timeout"].iter().any(|word| answer["result"] == *word);
        (!passes).then_some(answer)
    })
}

/// The gateway starts, commands, is reloaded and stops its motor while the files hang.
fn lives_with(files: &[&str]) {
    let site = site();
    for file in files {
        hang(&site.file("state").join(file));
    }
    let line = site.line(&[1, 2]);
    let mut gateway = site.run_ready();
    let guarded = start(&site, "pump-1");
    let why = guarded["error"]["message"].as_str().unwrap_or_default();
    // Whatever a file could forbid is refused until it is read.
    let forbids = [
        ("params/fan-3/restore.journal", "not_allowed"),
        ("reservations.json", "held_by_other"),
        ("bacnet-priorities.json", "held_by_other"),
        ("starts.json", "guarded"),
    ];
    let forbidden = forbids.iter().find(|(file, _)| files.contains(file));
    match forbidden {
        None => assert_eq!(guarded["ok"], true, "{files:?}: {guarded}"),
        Some((_, "not_allowed")) => assert_eq!(guarded["result"], "not_allowed", "{files:?}: {guarded}"),
        Some((file, result)) => {
            assert_eq!(guarded["result"], *result, "{files:?}: {guarded}");
            assert!(why.contains(file) && why.contains("not read yet"), "{why}");
        }
    }
    let free = forbidden.is_none_or(|(file, _)| *file == "starts.json");
    assert_eq!(start(&site, "fan-2")["ok"], free, "{files:?}");
    site.change("response_timeout = \"2s\"", "response_timeout = \"1900ms\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    site.change("state_dir = \"state\"", "state_dir = \"elsewhere\"");
    gateway.signal("HUP");
    until("the second reload", || {
        (gateway.output().matches("configuration reloaded").count() == 2).then_some(())
    });
    let (status, answer) = site.curl("alice", "drives/pump-1/commands", &["-d", "{\"run\": false}"]);
    assert_eq!((status, &answer["ok"]), (200, &json!(true)), "{files:?}: {answer}");
    gateway.signal("TERM");
    let ended = gateway.ended();
    assert!(ended.success(), "{files:?}: {ended}");
    let mut words = line.transcript();
    words.retain(|frame| frame.direction == Direction::ToDrives && frame.bytes.starts_with(&[2, 6]));
    let last = words.last().map(|frame| frame.bytes[5] & 1);
    assert_eq!(last, Some(0), "{files:?}: the motor of fan-2 is stopped");
}

#[test]
fn one_file_that_hangs_holds_up_neither_start_nor_reload_nor_stop() {
    for some in FILES.chunks(4) {
        std::thread::scope(|scope| {
            some.iter().for_each(|file| {
                scope.spawn(|| lives_with(&[file]));
            });
        });
    }
}

#[test]
fn a_disk_that_hangs_holds_up_neither_start_nor_reload_nor_stop() {
    lives_with(&FILES);
}

/// A link to itself cannot be read, not even by root.
#[test]
fn a_drive_is_commanded_as_soon_as_the_disk_returns_its_journal() {
    for unreadable in ["params", "params/fan-2/restore.journal"] {
        let site = site();
        let path = site.file("state").join(unreadable);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::os::unix::fs::symlink(&path, &path).unwrap();
        let _line = site.line(&[1, 2]);
        let gateway = site.run_ready();
        let refused = start(&site, "fan-2");
        assert_eq!(refused["result"], "not_allowed", "{unreadable}: {refused}");
        let why = refused["error"]["message"].as_str().unwrap_or_default();
        assert!(why.contains("until its journal is read"), "{unreadable}: {why}");
        std::fs::remove_file(&path).unwrap();
        until("the drive is free", || {
            (start(&site, "fan-2")["ok"] == true).then_some(())
        });
        gateway.until_printed("the journals of restores are read");
    }
}

/// The gateway was ended while a stop of Alice reserved `pump-1`; the disk returns that only later.
#[test]
fn a_reservation_holds_from_the_start_on_however_late_the_disk_returns_it() {
    let site = site();
    site.change(
        "http_user = \"alice\"\n",
        "http_user = \"alice\"\n[[authority.principal]]\nname = \"bob\"\nrank = \"remote\"\nhttp_user = \"bob\"\n",
    );
    site.change("lease = \"30s\"", "lease = \"1h\"");
    site.add_user("bob");
    let file = site.file("state/reservations.json");
    let _line = site.line(&[1, 2]);
    let mut gateway = site.run_ready();
    site.until_state("pump-1", "ready");
    let stop = |drive: &str| {
        let (status, answer) = site.curl(
            "alice",
            &format!("drives/{drive}/commands"),
            &["-d", "{\"run\": false}"],
        );
        assert_eq!((status, &answer["ok"]), (200, &json!(true)), "{answer}");
    };
    stop("pump-1");
    let saved = until("the reservation on disk", || {
        std::fs::read_to_string(&file)
            .ok()
            .filter(|text| text.contains("alice"))
    });
    gateway.signal("TERM");
    assert!(gateway.ended().success());
    std::fs::remove_file(&file).unwrap();
    hang(&file);
    let _gateway = site.run_ready();
    for drive in ["pump-1", "fan-2"] {
        site.until_state(drive, "ready");
    }
    let by_bob = || {
        let (_, answer) = site.curl("bob", "drives/pump-1/commands", &["-d", "{\"run\": true}"]);
        assert_eq!(answer["result"], "held_by_other", "{answer}");
        answer["error"]["message"].as_str().unwrap_or_default().to_string()
    };
    let why = by_bob();
    assert!(why.contains("reservations.json (not read yet)"), "{why}");
    // This reservation is not written over the file that was not read.
    stop("fan-2");
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert!(std::os::unix::fs::FileTypeExt::is_fifo(
        &std::fs::metadata(&file).unwrap().file_type()
    ));
    std::fs::write(&file, &saved).unwrap();
    until("the reservation of Alice", || {
        by_bob().contains("alice (operator)").then_some(())
    });
    until("both reservations on disk", || {
        // To open the pipe once more, before the gateway has replaced it, would wait for ever.
        std::fs::metadata(&file).ok().filter(std::fs::Metadata::is_file)?;
        let text = std::fs::read_to_string(&file).ok()?;
        (text.matches("alice").count() == 2).then_some(())
    });
}
