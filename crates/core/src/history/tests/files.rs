//! Files of recordings: complete or absent, and the messages about damaged ones.

use std::fs;
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, SystemTime};

use super::{FAULT, RUNS, Rig, SECOND, options};
use crate::history::recording::{Frame, RecordingError};
use crate::history::store::{self, Store};
use crate::history::{RecorderOptions, Recording, export, pcapng};
use crate::process_image::Verdict;

fn recording() -> Recording {
    let mut rig = Rig::new(options(), 2, &[]);
    let made = rig.polls(15 * SECOND, |rig, n| {
        rig.poll(0, if n == 300 { FAULT } else { RUNS }, 100, 5);
        if n % 100 == 50 {
            rig.fail(1);
        }
    });
    made.into_iter().next().unwrap()
}

fn store_in(dir: &Path) -> Store {
    Store::open(&RecorderOptions {
        dir: dir.to_path_buf(),
        ..options()
    })
}

#[test]
fn a_recording_survives_its_file() {
    let recording = recording();
    assert!(recording.samples.len() > 1000 && !recording.frames.is_empty());
    assert_eq!(Recording::parse(&recording.to_bytes()), Ok(recording));
}

#[test]
fn what_is_broken_is_told_of_with_its_place() {
    let bytes = recording().to_bytes();
    let told = |bytes: &[u8]| Recording::parse(bytes).unwrap_err();
    // The file may be cut off at any place.
    for length in [30, 500, bytes.len() / 2, bytes.len() - 1] {
        let RecordingError { offset, what } = told(&bytes[..length]);
        assert!(what.contains("truncated"), "{what} of {length}");
        assert!(offset <= length);
    }
    // A damaged byte at any place of the file must be noticed.
    for place in (0..bytes.len()).step_by(997) {
        let mut broken = bytes.clone();
        broken[place] = if broken[place] == b'7' { b'8' } else { b'7' };
        let error = told(&broken);
        assert!(
            error.offset <= bytes.len() && error.to_string().contains("at byte"),
            "{error}"
        );
    }
    // Lines that are missing, or too many.
    let second = bytes.iter().position(|b| *b == b'\n').unwrap() + 1;
    let third = second + bytes[second..].iter().position(|b| *b == b'\n').unwrap() + 1;
    let missing = [&bytes[..second], &bytes[third..]].concat();
    assert!(told(&missing).what.contains("some are missing"));
    let more = [&bytes[..], b"{}\n"].concat();
    assert_eq!(
        told(&more).to_string(),
        format!("there is data after the end line, at byte {}", bytes.len())
    );
    // The files are of another kind or of another version.
    for foreign in [
        &b""[..],
        b"\n",
        b"\x7fELF\0\0",
        b"{\"a\":1}\n",
        b"[1]\n",
        b"{\"drivegate_recording\":\"x\"}\n",
    ] {
        let error = told(foreign);
        assert_eq!(error.to_string(), "this is not a recording of drivegate, at byte 0");
    }
    let newer = String::from_utf8(bytes)
        .unwrap()
        .replacen("recording\":1", "recording\":2", 1);
    assert!(told(newer.as_bytes()).what.contains("version 2"));
}

#[test]
fn exports() {
    let mut recording = recording();
    recording.frames.push(Frame {
        t: 0.5,
        drive: Some(0),
        verdict: Verdict::Ok,
        bytes: [1, 3, 2, 0, 1, 0x79, 0x84].into(),
    });
    let csv = export::csv(&recording);
    let mut lines = csv.lines();
    let title: Vec<&str> = lines.next().unwrap().split(',').collect();
    let column = |name: &str| title.iter().position(|t| *t == name).unwrap();
    assert_eq!(lines.clone().count(), recording.samples.len());
    let at_trigger: Vec<&str> = lines.find(|l| l.contains(",0.000000,")).unwrap().split(',').collect();
    assert_eq!(at_trigger.len(), title.len());
    assert_eq!(
        (at_trigger[0], at_trigger[1]),
        ("2026-02-02T02:40:03.000000Z", "0.000000")
    );
    assert_eq!(
        (at_trigger[column("fault")], at_trigger[column("motor_current [A]")]),
        ("true", "10.0")
    );
    let json: serde_json::Value = serde_json::from_str(&export::json(&recording)).unwrap();
    assert_eq!(json["samples"][300]["points"]["fault"], true);
    assert_eq!(
        (&json["trigger"], &json["values"]["dc_link_voltage"]),
        (&"fault".into(), &655.0.into())
    );
    let frames = json["frames"].as_array().unwrap();
    assert_eq!(frames.len(), recording.frames.len());
    let last = frames.last().unwrap();
    assert_eq!(
        (&last["decode"], &last["hex"]),
        (&"address 1, function 3, 1 register".into(), &"01030200017984".into())
    );
    // The file is a chain of pcapng blocks, checked by the lengths at both ends of each.
    let capture = pcapng::pcapng(&recording);
    let word = |at: usize| u32::from_le_bytes(capture[at..at + 4].try_into().unwrap());
    let (mut at, mut kinds) = (0, Vec::new());
    while at < capture.len() {
        let length = word(at + 4) as usize;
        assert_eq!((length % 4, word(at + length - 4) as usize), (0, length));
        kinds.push(word(at));
        at += length;
    }
    assert_eq!(kinds[..3], [0x0A0D_0D0A, 1, 6]);
    assert_eq!(kinds.len(), 2 + recording.frames.len());
    let text = String::from_utf8_lossy(&capture);
    assert!(text.contains("pump-2, timeout"));
    assert!(text.contains("+0.500000 s, pump-1, ok: address 1, function 3, 1 register"));
}

#[test]
fn the_directory_keeps_its_limits_over_restarts() {
    let dir = tempfile::tempdir().unwrap();
    let mut recording = recording();
    let size = recording.to_bytes().len() as u64;
    let limits = RecorderOptions {
        dir: dir.path().join("recordings"),
        max_bytes: 10 * size + size / 2,
        ..options()
    };
    for n in 0..30 {
        // The recordings are an hour apart.
        recording.header.time = format!("2026-02-{:02}T{:02}:00:00.000000Z", 1 + n / 24, n % 24);
        recording.header.id = format!("r{n:02}");
        let entry = Store::open(&limits).write(&mut recording, SystemTime::now()).unwrap();
        assert_eq!(entry.id, recording.header.id);
    }
    fs::write(limits.dir.join(".x.partial"), "half").unwrap();
    fs::write(limits.dir.join("foreign.dgrec"), "half").unwrap();
    let (entries, faults) = store::list(&limits.dir).unwrap();
    assert_eq!((entries.len(), faults.len()), (10, 1));
    assert_eq!(entries.last().unwrap().id, "r29");
    Store::open(&limits);
    let files: Vec<_> = fs::read_dir(&limits.dir)
        .unwrap()
        .map(|f| f.unwrap().file_name())
        .collect();
    assert_eq!(files.len(), 11, "{files:?}");
    // After the clock was set back, an id may occur twice.
    assert_eq!(
        Store::open(&limits)
            .write(&mut recording, SystemTime::now())
            .unwrap()
            .id,
        "r29-2"
    );
    let small = RecorderOptions {
        max_bytes: 100,
        ..limits
    };
    let error = Store::open(&small)
        .write(&mut recording, SystemTime::now())
        .unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
}

#[test]
fn after_the_clock_was_set_back_what_is_yet_to_come_goes_and_what_was_made_stays() {
    let dir = tempfile::tempdir().unwrap();
    let mut recording = recording();
    let mut store = Store::open(&RecorderOptions {
        dir: dir.path().to_path_buf(),
        max_count: 3,
        ..options()
    });
    let mut made = |id: &str, hour: u32| {
        recording.header.time = format!("2026-02-03T{hour:02}:00:00.000000Z");
        recording.header.id = id.to_string();
        let now = humantime::parse_rfc3339(&recording.header.time).unwrap() + Duration::from_secs(10);
        store.write(&mut recording, now).unwrap();
        let (entries, _) = store::list(dir.path()).unwrap();
        let shown: Vec<String> = store.entries().iter().map(|entry| entry.id.clone()).collect();
        let ids: Vec<String> = entries.into_iter().map(|entry| entry.id).collect();
        assert_eq!(shown, ids, "what is shown is what is there");
        ids.join(" ")
    };
    for hour in 1..20 {
        made(&format!("r{hour}"), hour);
    }
    assert_eq!(made("r20", 20), "r18 r19 r20");
    // The clock is set back by two hours.
    assert_eq!(made("b1", 18), "b1 r18 r20");
    assert_eq!(made("b2", 19), "b1 r18 b2");
    assert_eq!(made("b3", 20), "r18 b2 b3");
    // The clock is set back to a time before all recordings.
    assert_eq!(made("c1", 1), "c1 b2 b3");
    assert_eq!(made("c2", 2), "c1 c2 b3");
}

#[test]
fn an_unwritable_directory_costs_the_recording_only() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("file"), "").unwrap();
    let error = store_in(&dir.path().join("file"))
        .write(&mut recording(), SystemTime::now())
        .unwrap_err();
    assert!(
        matches!(
            error.kind(),
            io::ErrorKind::AlreadyExists | io::ErrorKind::NotADirectory
        ),
        "{error}"
    );
    // To the file system, the disk seems full.
    assert!(
        store_in(Path::new("/proc/none"))
            .write(&mut recording(), SystemTime::now())
            .is_err()
    );
    assert!(store::list(Path::new("/proc/none")).unwrap().0.is_empty());
}

/// Set in the process that the test below starts and kills.
const WRITES_TO: &str = "DRIVEGATE_TEST_WRITES_TO";

#[test]
fn a_process_that_is_killed_leaves_only_whole_recordings() {
    if let Some(dir) = std::env::var_os(WRITES_TO) {
        let (mut store, mut recording) = (store_in(Path::new(&dir)), recording());
        for n in 0.. {
            recording.header.id = format!("{}-{n}", std::process::id());
            store.write(&mut recording, SystemTime::now()).unwrap();
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let test = "history::tests::files::a_process_that_is_killed_leaves_only_whole_recordings";
    let whole = || store::list(dir.path()).unwrap();
    for round in 0..8 {
        let before = whole().0.len();
        let mut same = Command::new(std::env::current_exe().unwrap());
        same.args([test, "--exact"]).env(WRITES_TO, dir.path());
        let mut child = same.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let deadline = std::time::Instant::now() + Duration::from_secs(60);
        while whole().0.len() < before + 2 {
            assert!(std::time::Instant::now() < deadline, "it writes nothing");
            std::thread::sleep(Duration::from_millis(1));
        }
        // Each time, the process is killed at another moment of a write.
        std::thread::sleep(Duration::from_micros(700 * round));
        child.kill().unwrap();
        assert_eq!(child.wait().unwrap().signal(), Some(9));
        let (entries, faults) = whole();
        assert!(faults.is_empty(), "{faults:?}");
        for entry in &entries {
            store::read(&store::path_of(dir.path(), &entry.id)).unwrap();
        }
    }
    let partial = |file: &fs::DirEntry| file.path().extension().is_some_and(|ending| ending == "partial");
    let left = || fs::read_dir(dir.path()).unwrap().flatten().filter(partial).count();
    let entries = whole().0.len();
    store_in(dir.path());
    assert_eq!((left(), whole().0.len()), (0, entries));
}
