use std::fs;

use super::super::chain::Verifier;
use super::super::tests::record;
use super::*;

fn options(dir: &Path) -> AuditFileOptions {
    AuditFileOptions {
        path: dir.join("audit.jsonl"),
        max_bytes: 64 << 10,
    }
}

/// A writer without the thread that runs it.
fn writer(dir: &Path) -> Writer {
    let AuditFileOptions { path, max_bytes } = options(dir);
    Writer::new(Rotated::new(path, max_bytes, FILES), Arc::default(), 0)
}

impl Writer {
    fn push(&self, records: std::ops::Range<usize>, sent: bool) {
        let file = AuditFile {
            options: options(Path::new("")),
            shared: self.shared.clone(),
            ended: watch::channel(()).1,
        };
        records.for_each(|n| file.push(Arc::new(record("operator", n)), sent));
    }
}

/// The content of all files, oldest first.
fn text(dir: &Path) -> Vec<u8> {
    let numbered = |n| dir.join(format!("audit.jsonl.{n}"));
    let mut files: Vec<PathBuf> = (1..10).rev().map(numbered).filter(|path| path.exists()).collect();
    files.push(dir.join("audit.jsonl"));
    files
        .iter()
        .flat_map(|path| fs::read(path).unwrap_or_default())
        .collect()
}

fn lines(dir: &Path) -> Vec<String> {
    String::from_utf8_lossy(&text(dir)).lines().map(String::from).collect()
}

fn faults(dir: &Path) -> Vec<String> {
    let mut verifier = Verifier::new(None);
    let text = text(dir);
    let lines = text.strip_suffix(b"\n").unwrap().split(|byte| *byte == b'\n');
    let mut faults: Vec<String> = lines.filter_map(|line| Some(verifier.line(line).err()?.why)).collect();
    faults.extend(verifier.finish().err());
    faults
}

/// Values of a field in the lines that contain the field.
fn values(dir: &Path, field: &str) -> Vec<serde_json::Value> {
    let json = lines(dir)
        .into_iter()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(&line).ok());
    json.filter_map(|json| json.get(field).cloned()).collect()
}

#[test]
fn records_become_a_chain_that_a_restart_continues() {
    let dir = tempfile::tempdir().unwrap();
    for round in 0..3 {
        let mut writer = writer(dir.path());
        writer.push(0..2, false);
        writer.push(2..4, true);
        writer.work(true).unwrap();
        assert_eq!(writer.chain.map(|chain| chain.seq), Some(4 * round + 4));
    }
    assert_eq!(faults(dir.path()), Vec::<String>::new());
    let commands: Vec<String> = values(dir.path(), "command")
        .iter()
        .map(|v| v.as_str().unwrap().to_string())
        .collect();
    assert_eq!(commands.concat(), "230123012301", "commands that were sent come first");
    assert_eq!(values(dir.path(), "entry")[1..3], ["sent", "not_sent"]);
}

#[tokio::test]
async fn a_reload_loses_no_record() {
    let (one, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    // Each reload sets another size, and then another file.
    for dirs in [[&one, &one], [&one, &other]] {
        let at = |round: usize| AuditFileOptions {
            max_bytes: (1 << 20) + round as u64,
            ..options(dirs[round % 2].path())
        };
        let before = lines(one.path()).len() + lines(other.path()).len();
        let mut file = AuditFile::start(at(0)).unwrap();
        for round in 1..=50 {
            (0..20).for_each(|n| file.push(Arc::new(record("operator", n)), true));
            let next = file.succeed(at(round)).unwrap();
            // Holders of the former handle still use it.
            file.push(Arc::new(record("operator", 20)), true);
            file = next;
        }
        file.stop().await;
        // The thread that writes the other file may still be running.
        while Arc::strong_count(&file.shared) > 1 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let after = lines(one.path()).len() + lines(other.path()).len();
        assert_eq!((after - before, file.lost()), (50 * 21, (0, 0)));
    }
    assert_eq!(faults(one.path()), Vec::<String>::new());
}

/// Reloads name A, B, A: the second writer of A begins when the first one, held up by its disk, has ended.
#[test]
fn a_reload_back_to_a_file_that_is_still_written_waits_for_it() {
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let a = AuditFile::start(options(dirs[0].path())).unwrap();
    let first_writer = a.shared.file(&a.options.path);
    let busy = loop {
        // The first writer has locked its file.
        match first_writer.try_lock() {
            Ok(_) => std::thread::sleep(Duration::from_millis(1)),
            Err(_) => break first_writer.clone(),
        }
    };
    let b = a.succeed(options(dirs[1].path())).unwrap();
    let first = busy.lock().unwrap();
    let again = b.succeed(options(dirs[0].path())).unwrap();
    while b.ended.has_changed().is_ok() {
        std::thread::sleep(Duration::from_millis(1));
    }
    again.push(Arc::new(record("operator", 1)), true);
    for _ in 0..50 {
        std::thread::sleep(Duration::from_millis(2));
        assert_eq!(lines(dirs[0].path()).len(), 0, "two threads write one file");
    }
    drop(first);
    tokio::runtime::Runtime::new().unwrap().block_on(again.stop());
    assert_eq!(lines(dirs[0].path()).len(), 1);
    assert_eq!(faults(dirs[0].path()), Vec::<String>::new());
}

#[test]
fn full_files_are_rotated_and_the_oldest_are_removed() {
    let dir = tempfile::tempdir().unwrap();
    let mut writer = writer(dir.path());
    for n in 0..40 {
        writer.push(n * 20..(n + 1) * 20, true);
        writer.work(false).unwrap();
    }
    let sizes: Vec<u64> = fs::read_dir(dir.path())
        .unwrap()
        .map(|e| e.unwrap().metadata().unwrap().len())
        .collect();
    assert_eq!(sizes.len() as u64, FILES);
    assert!(sizes.iter().sum::<u64>() <= 64 << 10);
    let kept = values(dir.path(), "seq");
    assert_eq!(kept.last().unwrap(), 800);
    assert!(kept.len() < 800 && kept.len() > 100);
    assert_eq!(faults(dir.path()), Vec::<String>::new());
    // Imitates a crash between two renames.
    drop(writer);
    fs::rename(dir.path().join("audit.jsonl"), dir.path().join("audit.jsonl.1")).unwrap();
    let mut writer = self::writer(dir.path());
    writer.push(0..1, true);
    writer.work(true).unwrap();
    assert_eq!(
        writer.chain.map(|chain| chain.seq),
        Some(801),
        "it goes on from the file before"
    );
}

#[test]
fn a_crash_inside_a_line_is_named() {
    let reference = tempfile::tempdir().unwrap();
    let mut writer = self::writer(reference.path());
    writer.push(0..3, true);
    writer.work(true).unwrap();
    drop(writer);
    let whole = fs::read(reference.path().join("audit.jsonl")).unwrap();
    let tails = (1..whole.len()).step_by(37).map(|length| whole[..length].to_vec());
    let torn = tails.chain([[&whole[..], &[0; 512]].concat(), [&whole[..], b"\xff\xfe\n"].concat()]);
    for bytes in torn {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("audit.jsonl"), &bytes).unwrap();
        // A crash during the repair is followed by two starts.
        for _ in 0..2 {
            let mut writer = self::writer(dir.path());
            writer.push(0..1, true);
            writer.work(true).unwrap();
        }
        assert!(
            fs::read(dir.path().join("audit.jsonl")).unwrap().starts_with(&bytes),
            "nothing is removed"
        );
        assert_eq!(
            faults(dir.path()),
            Vec::<String>::new(),
            "{}",
            String::from_utf8_lossy(&bytes)
        );
        let whole_lines = bytes.ends_with(b"}\n") || bytes.ends_with(b"\"count\":1}");
        assert_eq!(
            values(dir.path(), "entry").iter().any(|entry| entry == "fragment"),
            !whole_lines
        );
    }
}

#[test]
fn what_is_not_an_audit_file_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("audit.jsonl"), "root:x:0\ndaemon:x:1\n").unwrap();
    let mut writer = writer(dir.path());
    writer.push(0..1, true);
    let error = writer.work(true).unwrap_err().to_string();
    assert!(error.contains("not an audit file"), "{error}");
    assert_eq!(lines(dir.path()), ["root:x:0", "daemon:x:1"]);
}

#[test]
fn a_disk_that_comes_back_gets_what_waited_and_what_was_lost() {
    let dir = tempfile::tempdir().unwrap();
    let blocked = dir.path().join("state");
    fs::write(&blocked, "a file where the directory should be").unwrap();
    let mut writer = writer(&blocked);
    for _ in 0..3 {
        writer.push(0..1, true);
        let done = writer.work(true);
        assert!(done.is_err());
        writer.report(done, false);
        assert!(writer.failing);
    }
    writer.push(3..WAITING.0 + 5, true);
    writer.push(0..WAITING.1 + 7, false);
    assert_eq!(writer.shared.queues().lost, (5, 7));
    fs::remove_file(&blocked).unwrap();
    let done = writer.work(true);
    assert!(done.is_ok(), "{done:?}");
    writer.report(done, false);
    assert!(!writer.failing);
    let last = lines(&blocked).pop().unwrap();
    let last: serde_json::Value = serde_json::from_str(&last).unwrap();
    assert_eq!(
        (&last["entry"], &last["sent"], &last["not_sent"]),
        (&"lost".into(), &5.into(), &7.into())
    );
    writer.work(true).unwrap();
    assert_eq!(values(&blocked, "not_sent"), [7], "once");
    assert_eq!(faults(&blocked), Vec::<String>::new());
}

/// The number that waits and not the room for it, with which an operator could not tell whether records are being lost.
#[test]
fn the_log_says_how_many_records_wait() {
    let dir = tempfile::tempdir().unwrap();
    let blocked = dir.path().join("state");
    fs::write(&blocked, "a file where the directory should be").unwrap();
    let mut writer = writer(&blocked);
    for (sent, unsent, waits) in [
        (0..3, 0..2, "3 records of commands that were sent and 2 others wait"),
        (3..4, 0..0, "4 records of commands that were sent and 2 others wait"),
        (
            4..WAITING.0 + 5,
            2..WAITING.1 + 5,
            "8192 records of commands that were sent and 1024 others wait",
        ),
    ] {
        writer.push(sent, true);
        writer.push(unsent, false);
        assert!(writer.work(true).is_err());
        let told = writer.shared.waiting();
        assert!(
            told.starts_with(waits) && told.ends_with("8192 and 1024 have room"),
            "{told}"
        );
    }
    fs::remove_file(&blocked).unwrap();
    writer.work(true).unwrap();
    assert!(
        writer
            .shared
            .waiting()
            .starts_with("0 records of commands that were sent and 0 others wait")
    );
}

#[test]
fn a_disk_that_is_full_gets_no_half_line() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("audit.jsonl");
    std::os::unix::fs::symlink("/dev/full", &path).unwrap();
    let mut writer = writer(dir.path());
    writer.push(0..2, true);
    let done = writer.work(true);
    assert_eq!(done.as_ref().unwrap_err().kind(), io::ErrorKind::StorageFull);
    writer.report(done, false);
    fs::remove_file(&path).unwrap();
    writer.work(true).unwrap();
    assert_eq!(values(dir.path(), "seq"), [1, 2]);
    // The file is removed while the thread writes it.
    fs::remove_file(&path).unwrap();
    writer.work(true).unwrap();
    writer.push(0..1, true);
    writer.work(true).unwrap();
    assert_eq!(values(dir.path(), "seq"), [3], "the gap shows");
}

#[test]
fn a_file_belongs_to_one_process() {
    let dir = tempfile::tempdir().unwrap();
    let mut first = writer(dir.path());
    first.work(true).unwrap();
    let error = writer(dir.path()).work(true).unwrap_err().to_string();
    assert!(error.contains("another process"), "{error}");
}

#[tokio::test]
async fn the_thread_writes_what_it_has_when_it_ends() {
    let dir = tempfile::tempdir().unwrap();
    let file = AuditFile::start(options(dir.path())).unwrap();
    file.push(Arc::new(record("operator", 1)), true);
    let written = || fs::read_to_string(dir.path().join("audit.jsonl")).is_ok_and(|text| text.ends_with('\n'));
    while !written() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    (0..100).for_each(|n| file.push(Arc::new(record("flood", n)), false));
    file.stop().await;
    assert_eq!((lines(dir.path()).len(), file.lost()), (101, (0, 0)));
}
