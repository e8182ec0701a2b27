use std::io::ErrorKind;

use super::segments::{DAMAGED, SUFFIX};
use super::*;

const BIG: u64 = 64 << 20;

fn event(n: usize) -> Message {
    Message::not_retained("b/hall/drive/p1/event", format!("{{\"n\":{n}}}").into_bytes())
}

fn number(message: &Message) -> usize {
    let text = std::str::from_utf8(&message.payload).unwrap();
    text.trim_matches(|c: char| !c.is_ascii_digit()).parse().unwrap()
}

fn open(dir: &Path, max: u64) -> MessageLog {
    MessageLog::open(dir, "mqtt-events", max).unwrap()
}

fn append(journal: &mut MessageLog, range: std::ops::Range<usize>) {
    for n in range {
        journal.append(event(n), false);
        journal.write().unwrap();
    }
}

fn take_all(journal: &mut MessageLog) -> Vec<(MessageNumber, usize)> {
    let mut all = Vec::new();
    loop {
        let taken = journal.take(usize::MAX);
        if taken.is_empty() {
            return all;
        }
        all.extend(taken.iter().map(|(id, message)| (*id, number(message))));
    }
}

fn numbers(taken: &[(MessageNumber, usize)]) -> Vec<usize> {
    taken.iter().map(|(_, n)| *n).collect()
}

fn files(dir: &Path, ending: &str) -> Vec<PathBuf> {
    let paths = fs::read_dir(dir).unwrap().map(|e| e.unwrap().path());
    let mut found: Vec<_> = paths.filter(|p| p.to_str().unwrap().ends_with(ending)).collect();
    found.sort();
    found
}

#[test]
fn unacknowledged_messages_survive_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let mut journal = open(dir.path(), BIG);
    append(&mut journal, 1..5);
    assert_eq!(numbers(&take_all(&mut journal)), [1, 2, 3, 4]);
    journal.acknowledge(MessageNumber::new(2));
    journal.write().unwrap();
    drop(journal); // nothing is written at the end: the same as a killed process
    let mut journal = open(dir.path(), BIG);
    append(&mut journal, 5..6);
    assert_eq!(journal.waiting(), 3);
    let (_, message) = journal.take(1).pop().unwrap();
    assert_eq!(message, event(3), "topic and payload as they were");
    assert_eq!(numbers(&take_all(&mut journal)), [4, 5]);
    assert_eq!((files(dir.path(), SUFFIX).len(), journal.take_lost()), (1, 0));
}

#[test]
fn an_acknowledged_journal_is_empty_and_forgets_its_numbers() {
    let dir = tempfile::tempdir().unwrap();
    for round in 0..3 {
        let mut journal = open(dir.path(), BIG);
        append(&mut journal, 0..100);
        let taken = take_all(&mut journal);
        assert_eq!((taken.len(), journal.take_lost()), (100, 0), "round {round}");
        journal.acknowledge(journal.last);
        journal.write().unwrap();
        let path = files(dir.path(), SUFFIX).pop().unwrap();
        assert_eq!(fs::metadata(path).unwrap().len(), 0);
        append(&mut journal, 100..101);
        drop(journal);
        let mut journal = open(dir.path(), BIG);
        assert_eq!(numbers(&take_all(&mut journal)), [100]);
        assert_eq!(journal.take_lost(), 0);
        journal.acknowledge(journal.last);
        journal.write().unwrap();
    }
}

#[test]
fn a_message_that_was_taken_at_once_is_kept_until_it_is_acknowledged() {
    let dir = tempfile::tempdir().unwrap();
    let mut journal = open(dir.path(), BIG);
    journal.append(event(1), true);
    journal.append(event(2), true);
    journal.write().unwrap();
    assert_eq!((journal.waiting(), take_all(&mut journal).len()), (0, 0));
    append(&mut journal, 3..4);
    assert_eq!(numbers(&take_all(&mut journal)), [3]);
    drop(journal);
    assert_eq!(numbers(&take_all(&mut open(dir.path(), BIG))), [1, 2, 3]);
}

#[test]
fn what_is_acknowledged_before_it_is_written_is_not_written() {
    let dir = tempfile::tempdir().unwrap();
    let mut journal = open(dir.path(), BIG);
    journal.append(event(1), true);
    journal.acknowledge(MessageNumber::new(1));
    journal.write().unwrap();
    assert_eq!(journal.bytes(), 0);
}

#[test]
fn an_incomplete_tail_is_kept_aside() {
    for tail in [b"X".repeat(100), vec![0; 4096], {
        let mut bytes = Vec::new();
        record::message(MessageNumber::new(9), &event(9), &mut bytes);
        bytes[..30].to_vec()
    }] {
        let dir = tempfile::tempdir().unwrap();
        append(&mut open(dir.path(), BIG), 1..3);
        let path = files(dir.path(), SUFFIX).pop().unwrap();
        let mut bytes = fs::read(&path).unwrap();
        bytes.extend_from_slice(&tail);
        fs::write(&path, &bytes).unwrap();
        let mut journal = open(dir.path(), BIG);
        append(&mut journal, 3..4);
        assert_eq!(numbers(&take_all(&mut journal)), [1, 2, 3]);
        let kept = files(dir.path(), DAMAGED).pop().unwrap();
        assert_eq!(fs::read(kept).unwrap(), tail);
        assert_eq!(journal.take_lost(), 1);
    }
}

#[test]
fn a_file_of_another_version_is_left_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    append(&mut open(dir.path(), BIG), 1..3);
    let path = files(dir.path(), SUFFIX).pop().unwrap();
    let bytes: Vec<u8> = fs::read(&path).unwrap();
    let later: Vec<u8> = bytes
        .iter()
        .map(|byte| if *byte == b'J' { b'K' } else { *byte })
        .collect();
    assert_ne!(bytes, later);
    fs::write(&path, &later).unwrap();
    for n in 3..5 {
        let mut journal = open(dir.path(), BIG);
        append(&mut journal, n..n + 1);
        assert_eq!(numbers(&take_all(&mut journal)), [n]);
        journal.acknowledge(journal.last);
        journal.write().unwrap();
        assert_eq!(journal.take_lost(), 0);
        assert_eq!(fs::read(&path).unwrap(), later);
    }
    // The version that wrote the file is back.
    fs::write(&path, &bytes).unwrap();
    assert_eq!(numbers(&take_all(&mut open(dir.path(), BIG))), [1, 2]);
}

#[test]
fn one_flipped_bit_costs_one_message() {
    let dir = tempfile::tempdir().unwrap();
    append(&mut open(dir.path(), BIG), 0..1000);
    let path = files(dir.path(), SUFFIX).remove(0);
    let mut bytes = fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs::write(&path, &bytes).unwrap();
    let mut journal = open(dir.path(), BIG);
    assert_eq!(take_all(&mut journal).len(), 999);
    assert_eq!((journal.take_lost(), files(dir.path(), DAMAGED).len()), (1, 1));
    assert!(fs::metadata(&files(dir.path(), DAMAGED)[0]).unwrap().len() < 100);
}

#[test]
fn the_files_of_damage_are_few() {
    let dir = tempfile::tempdir().unwrap();
    for round in 0..2 * QUARANTINED {
        append(&mut open(dir.path(), BIG), 0..1);
        let path = files(dir.path(), SUFFIX).remove(0);
        let mut bytes = fs::read(&path).unwrap();
        bytes.resize(bytes.len() + round + 1, 7);
        fs::write(&path, &bytes).unwrap();
    }
    open(dir.path(), BIG);
    assert_eq!(files(dir.path(), DAMAGED).len(), QUARANTINED);
}

#[test]
fn a_full_buffer_drops_its_oldest_segment() {
    let dir = tempfile::tempdir().unwrap();
    let max = 64 << 10;
    let mut journal = open(dir.path(), max);
    for n in 0..5000 {
        append(&mut journal, n..n + 1);
        assert!(journal.bytes() <= max);
    }
    let on_disk = files(dir.path(), SUFFIX);
    let on_disk: u64 = on_disk.iter().map(|p| fs::metadata(p).unwrap().len()).sum();
    assert!(on_disk <= max);
    let lost = journal.take_lost() as usize;
    let taken = take_all(&mut journal);
    assert_eq!((lost + taken.len(), journal.take_lost()), (5000, 0));
    assert_eq!(
        numbers(&taken),
        (lost..5000).collect::<Vec<_>>(),
        "the newest, in order"
    );
    assert!(journal.bytes() > max * 9 / 10);
    journal.acknowledge(journal.last);
    journal.write().unwrap();
    assert_eq!((journal.bytes(), files(dir.path(), SUFFIX).len()), (0, 1));
}

#[test]
fn a_disk_that_takes_nothing_leaves_the_order_alone() {
    let dir = tempfile::tempdir().unwrap();
    let inner = dir.path().join("buffer");
    let mut journal = open(&inner, 256 << 10);
    append(&mut journal, 0..100);
    // A new segment cannot be created, and the last segment is full.
    let moved = dir.path().join("moved");
    fs::rename(&inner, &moved).unwrap();
    for n in 100..400 {
        journal.append(event(n), false);
        let _ = journal.write();
    }
    assert!(journal.write().is_err() && !journal.unwritten.is_empty());
    let first = journal.take(150);
    assert!(first.iter().map(|(_, m)| number(m)).eq(0..150));
    fs::rename(&moved, &inner).unwrap();
    journal.write().unwrap();
    assert!(journal.unwritten.is_empty());
    append(&mut journal, 400..410);
    assert_eq!(numbers(&take_all(&mut journal)), (150..410).collect::<Vec<_>>());
    drop(journal);
    let mut journal = open(&inner, 256 << 10);
    assert_eq!(numbers(&take_all(&mut journal)), (0..410).collect::<Vec<_>>());
    assert_eq!(journal.take_lost(), 0);
}

#[test]
fn a_full_disk_gets_no_segment_after_the_first_and_what_waits_can_be_taken() {
    let dir = tempfile::tempdir().unwrap();
    let mut journal = open(dir.path(), 256 << 10);
    let real = journal.place.as_ref().unwrap().create;
    journal.place.as_mut().unwrap().create = |path| {
        let first = path.to_string_lossy().ends_with("1.log");
        assert!(first, "one more segment on a full disk: {}", path.display());
        std::os::unix::fs::symlink("/dev/full", path)?;
        OpenOptions::new().read(true).write(true).open(path)
    };
    for n in 0..100 {
        journal.append(event(n), false);
        assert!(is_full(&journal.write().unwrap_err()));
    }
    assert_eq!(journal.unkept(), 100, "they end with the process");
    assert!(journal.take(30).iter().map(|(_, m)| number(m)).eq(0..30));
    journal.append(event(100), true);
    journal.acknowledge(MessageNumber::new(101));
    assert_eq!(journal.unkept(), 0);
    assert!(
        !journal.write().unwrap(),
        "nothing is left to write: the disk may be full all the same"
    );
    for n in 101..201 {
        journal.append(event(n), false);
    }
    // The disk has free space again.
    let segment = journal.segments.front_mut().unwrap();
    fs::remove_file(&segment.path).unwrap();
    segment.file = real(&segment.path).unwrap();
    journal.place.as_mut().unwrap().create = real;
    assert!(journal.write().unwrap());
    assert_eq!(numbers(&take_all(&mut journal)), (101..201).collect::<Vec<_>>());
    drop(journal);
    let mut journal = open(dir.path(), 256 << 10);
    assert_eq!(numbers(&take_all(&mut journal)), (101..201).collect::<Vec<_>>());
}

/// Property for any behaviour of the disk: each message is taken once, in order, or counted as lost; memory is bounded.
#[test]
fn every_message_is_taken_or_lost_whatever_the_disk_does() {
    let full: fn(&Path) -> io::Result<File> = |_| Err(ErrorKind::StorageFull.into());
    for seed in 0..20_u64 {
        let dir = tempfile::tempdir().unwrap();
        let mut journal = open(dir.path(), 1 << 20);
        let real = journal.place.as_ref().unwrap().create;
        // xorshift64 of Marsaglia.
        let mut state = seed * 2 + 1;
        let mut below = |most: u64| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state % most) as usize
        };
        let (mut appended, mut sent, mut taken, mut lost) = (0, 0, Vec::new(), 0);
        for _ in 0..400 {
            match below(10) {
                0..5 => {
                    let size = [20, 500, 4 << 10, 33 << 10][below(4)];
                    let mut message = event(appended);
                    message.payload.resize(size, b' ');
                    let at_once = below(4) == 0 && journal.waiting() == 0;
                    journal.append(message, at_once);
                    (appended, sent) = (appended + 1, sent + usize::from(at_once));
                }
                5 | 6 => drop(journal.write()),
                7 => {
                    let next = journal.take(below(50));
                    let bytes: usize = next.iter().rev().skip(1).map(|(_, message)| message.bytes()).sum();
                    assert!(bytes < LOADED_BYTES, "seed {seed}");
                    taken.extend(next.into_iter().map(|(id, message)| (id, number(&message))));
                }
                8 => journal.acknowledge(journal.through()),
                _ => journal.place.as_mut().unwrap().create = [real, full][below(2)],
            }
            lost += journal.take_lost() as usize;
            let kept: usize = journal.unwritten.iter().map(|(_, message)| message.bytes()).sum();
            assert!(
                kept == journal.unwritten_bytes && kept <= KEPT_BYTES,
                "seed {seed}: {kept}"
            );
        }
        journal.place.as_mut().unwrap().create = real;
        journal.write().unwrap();
        taken.extend(take_all(&mut journal));
        lost += journal.take_lost() as usize;
        assert_eq!(taken.len() + sent + lost, appended, "seed {seed}");
        assert!(taken.is_sorted_by(|a, b| a.0 < b.0 && a.1 < b.1), "seed {seed}");
    }
}

#[test]
fn messages_beyond_the_memory_are_lost_and_counted_once() {
    let dir = tempfile::tempdir().unwrap();
    let inner = dir.path().join("buffer");
    let mut journal = open(&inner, 256 << 10);
    append(&mut journal, 0..100);
    let moved = dir.path().join("moved");
    fs::rename(&inner, &moved).unwrap();
    let many = UNWRITTEN + 1000;
    for n in 100..many {
        journal.append(event(n), false);
        if n % 100 == 0 {
            let _ = journal.write();
        }
    }
    let lost = journal.take_lost() as usize;
    assert!(lost > 0);
    let taken = take_all(&mut journal);
    assert_eq!((taken.len() + lost, journal.take_lost()), (many, 0));
    assert!(taken.is_sorted());
    // Arrays of the history are large.
    for n in 0..1000 {
        journal.append(Message::not_retained("h", format!("{n:33000}").into_bytes()), false);
    }
    let kept = journal.unwritten_bytes;
    assert!((KEPT_BYTES - 40_000..=KEPT_BYTES).contains(&kept), "{kept}");
    assert_eq!(journal.take_lost() as usize, 1000 - kept / 33_001);
    let taken = take_all(&mut journal);
    assert!(taken.iter().map(|(_, n)| *n).eq(1000 - kept / 33_001..1000));
}

#[test]
fn without_a_disk_messages_wait_in_memory() {
    let mut journal = MessageLog::in_memory();
    append(&mut journal, 0..10);
    assert_eq!((journal.waiting(), journal.unkept()), (10, 10));
    assert_eq!(numbers(&take_all(&mut journal)), (0..10).collect::<Vec<_>>());
    assert_eq!((journal.waiting(), journal.unwritten.len()), (0, 0));
    for n in 0..UNWRITTEN + 5 {
        journal.append(event(n), false);
    }
    assert_eq!((journal.take_lost(), take_all(&mut journal).len()), (5, UNWRITTEN));
    assert_eq!(journal.take_lost(), 0);
}

#[test]
fn a_directory_belongs_to_one_process() {
    let dir = tempfile::tempdir().unwrap();
    let _journal = open(dir.path(), BIG);
    let error = MessageLog::open(dir.path(), "mqtt-events", BIG).unwrap_err();
    assert!(error.to_string().contains("another process"), "{error}");
    MessageLog::open(dir.path(), "mqtt-history", BIG).unwrap();
}

#[test]
fn files_that_somebody_deletes_are_written_again() {
    let dir = tempfile::tempdir().unwrap();
    let inner = dir.path().join("buffer");
    let mut journal = open(&inner, 64 << 10);
    append(&mut journal, 0..200);
    assert!(files(&inner, SUFFIX).len() > 1);
    let number_of = |path: &PathBuf| path.file_name().map(ToOwned::to_owned);
    let before: Vec<_> = files(&inner, SUFFIX).iter().map(number_of).collect();
    for wipe in [
        (|dir| fs::remove_dir_all(dir).unwrap()) as fn(&Path),
        |dir| fs::remove_file(&files(dir, SUFFIX)[0]).unwrap(),
        |dir| fs::remove_file(dir.join("mqtt-events.lock")).unwrap(),
    ] {
        wipe(&inner);
        assert!(!journal.write().unwrap(), "nothing new");
        assert!(journal.take_wiped() && !journal.take_wiped());
        let after: Vec<_> = files(&inner, SUFFIX).iter().map(number_of).collect();
        assert_eq!(after, before);
        let error = MessageLog::open(&inner, "mqtt-events", BIG).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::WouldBlock, "it is locked again");
    }
    append(&mut journal, 200..210);
    drop(journal);
    let mut journal = open(&inner, 64 << 10);
    assert_eq!(numbers(&take_all(&mut journal)), (0..210).collect::<Vec<_>>());
    assert_eq!(journal.take_lost(), 0);
}

#[test]
fn what_a_full_disk_left_of_a_file_does_not_keep_the_others_from_being_read() {
    let dir = tempfile::tempdir().unwrap();
    append(&mut open(dir.path(), 64 << 10), 0..200);
    let last = files(dir.path(), SUFFIX).len() + 1;
    let torn = dir.path().join(format!("mqtt-events-{last:012}{SUFFIX}"));
    fs::write(&torn, [7; 100]).unwrap();
    // The disk has no space for a copy.
    let copy = dir.path().join(format!("mqtt-events-{last:012}-0{DAMAGED}"));
    std::os::unix::fs::symlink("/dev/full", copy.with_extension(files::PARTIAL)).unwrap();
    let mut journal = open(dir.path(), 64 << 10);
    append(&mut journal, 200..201);
    assert_eq!(numbers(&take_all(&mut journal)), (0..201).collect::<Vec<_>>());
    assert_eq!(journal.take_lost(), 1);
    assert!(!copy.exists(), "no part of it takes the room of messages");
}
