//! Starts in their file: a start waits until it is on disk, and a file that cannot be read or written hinders starts.

use super::*;

#[test]
fn a_start_waits_until_it_is_on_disk() {
    let rig = GuardedDrives::of(per_hour(3), Vec::new());
    let time = SystemTime::now();
    rig.shared.keep(&Saved::default(), rig.start, time);
    rig.read(0, false, 0.0);
    assert_eq!(reason(rig.clear(&[0], 1, 1.0)), "wait");
    let (generation, saved) = rig.shared.to_write(rig.at(1.0), time).unwrap();
    assert_eq!(reason(rig.clear(&[0], 1, 1.1)), "wait");
    rig.shared.wrote(generation, Ok(()), rig.at(1.1));
    assert_eq!(rig.clear(&[0], 1, 1.2), Verdict::Go);
    assert_eq!(rig.shared.to_write(rig.at(1.2), time), None);
    // If the gateway is killed before it has written the word, the next run knows of the start.
    let next = GuardedDrives::of(per_hour(1), Vec::new());
    let saved = Saved::from_json(&saved.to_json().unwrap()).unwrap();
    next.shared.keep(&saved, next.start, time + 60 * SECOND);
    next.read(0, false, 0.0);
    assert_eq!(
        (next.refused(0, 3500.0), next.refused(0, 3603.0)),
        (Some("starts_per_hour"), None)
    );
    // A clock that was set back makes nothing older.
    let next = GuardedDrives::of(per_hour(1), Vec::new());
    next.shared.keep(&saved, next.start, time - 7200 * SECOND);
    next.read(0, false, 0.0);
    assert_eq!(
        (next.refused(0, 3599.0), next.refused(0, 3600.0)),
        (Some("starts_per_hour"), None)
    );
}

#[test]
fn a_start_waits_a_second_for_a_file_that_is_not_read_and_is_refused_then() {
    let rig = GuardedDrives::of(per_hour(3), Vec::new());
    rig.shared.await_file(std::path::Path::new("state/starts.json"));
    rig.read(0, false, 0.0);
    assert_eq!(reason(rig.clear(&[0], 1, 1.0)), "wait");
    assert_eq!(reason(rig.clear(&[0], 1, 1.9)), "wait");
    let refused = rig.clear(&[0], 1, 2.0);
    let Verdict::Refuse(refusal) = &refused else {
        unreachable!("{refused:?}")
    };
    assert!(
        refusal.to_string().contains("state/starts.json: it is not read yet"),
        "{refusal}"
    );
    assert_eq!(
        rig.shared.to_write(rig.at(2.0), SystemTime::now()),
        None,
        "nothing replaces what is there"
    );
    // The disk answers: the start is counted together with those in the file.
    rig.shared.keep(&Saved::default(), rig.at(3.0), SystemTime::now());
    assert_eq!(reason(rig.clear(&[0], 2, 3.0)), "wait");
    let (generation, _) = rig.shared.to_write(rig.at(3.0), SystemTime::now()).unwrap();
    rig.shared.wrote(generation, Ok(()), rig.at(3.0));
    assert_eq!(rig.clear(&[0], 2, 3.1), Verdict::Go);
}

#[test]
fn a_start_that_cannot_be_counted_is_refused_and_is_none() {
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    let time = SystemTime::now();
    rig.shared.keep(&Saved::default(), rig.start, time);
    rig.read(0, false, 0.0);
    assert_eq!(reason(rig.clear(&[0], 1, 1.0)), "wait");
    let (generation, _) = rig.shared.to_write(rig.at(1.0), time).unwrap();
    rig.shared
        .wrote(generation, Err("starts.json: no space".to_string()), rig.at(1.0));
    let refused = rig.clear(&[0], 1, 1.1);
    let Verdict::Refuse(refusal) = &refused else {
        unreachable!("{refused:?}")
    };
    assert!(refusal.to_string().contains("starts.json: no space"), "{refusal}");
    // A disk that hangs is not waited for.
    assert_eq!(reason(rig.clear(&[0], 2, 2.0)), "wait");
    assert_eq!(reason(rig.clear(&[0], 2, 2.9)), "wait");
    assert_eq!(reason(rig.clear(&[0], 2, 3.0)), "state_file");
    // The disk works again from here on.
    let (generation, _) = rig.shared.to_write(rig.at(4.0), time).unwrap();
    rig.shared.wrote(generation, Ok(()), rig.at(4.0));
    assert_eq!(reason(rig.clear(&[0], 3, 5.0)), "wait");
    let (generation, _) = rig.shared.to_write(rig.at(5.0), time).unwrap();
    rig.shared.wrote(generation, Ok(()), rig.at(5.0));
    assert_eq!(rig.clear(&[0], 3, 5.1), Verdict::Go);
}

#[test]
fn what_a_full_disk_refused_is_written_again_unasked() {
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    let time = SystemTime::now();
    rig.shared.keep(&Saved::default(), rig.start, time);
    rig.read(0, false, 0.0);
    // A person starts the motor at its panel: that counts, and nothing of it waits for the disk.
    rig.read(0, true, 1.0);
    let full = || Err("starts.json: no space".to_string());
    let (generation, saved) = rig.shared.to_write(rig.at(1.0), time).unwrap();
    rig.shared.wrote(generation, full(), rig.at(1.1));
    assert_eq!(rig.shared.to_write(rig.at(2.0), time), None, "too early");
    assert_eq!(
        rig.shared.to_write(rig.at(2.1), time + 11 * SECOND / 10),
        Some((generation, saved))
    );
    rig.shared.wrote(generation, full(), rig.at(2.1));
    assert!(
        rig.shared.last_to_write().is_some(),
        "the last try at the end waits for nothing"
    );
    let (generation, _) = rig.shared.to_write(rig.at(3.1), time).unwrap();
    rig.shared.wrote(generation, Ok(()), rig.at(3.1));
    assert_eq!(rig.shared.to_write(rig.at(9.0), time), None);
    assert_eq!(rig.shared.last_to_write(), None);
}

#[test]
fn a_file_that_cannot_be_read_is_read_later_and_stays_as_it_is() {
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    rig.read(0, false, 0.0);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("starts.json");
    // A folder of this name cannot be read as a file.
    std::fs::create_dir(&path).unwrap();
    let (keeper, read) = keep(folder.path(), rig.shared.clone(), WhileTaken::Wait).unwrap();
    let begun = Instant::now();
    let refusal = loop {
        match rig.clear(&[0], 1, 1.0) {
            Verdict::Refuse(refusal) => break refusal.to_string(),
            _ => assert!(begun.elapsed() < 60 * SECOND, "it waits"),
        }
        std::thread::sleep(SECOND / 100);
    };
    assert!(refusal.contains("starts.json: it cannot be read"), "{refusal}");
    assert!(path.is_dir() && !folder.path().join("starts.damaged").exists());
    std::fs::remove_dir(&path).unwrap();
    // The channel closes when the file has been read.
    let _ = read.blocking_recv();
    while !path.is_file() {
        assert!(begun.elapsed() < 60 * SECOND, "it is not written");
        std::thread::sleep(SECOND / 100);
    }
    drop(keeper);
}

#[test]
fn files_of_others_are_refused_with_a_reason() {
    for (text, why) in [
        ("{", "EOF"),
        ("{\"drivegate_starts\": 2, \"motors\": []}", "version 2"),
        ("[]", "invalid length"),
    ] {
        let error = Saved::from_json(text.as_bytes()).unwrap_err();
        assert!(error.contains(why), "{text}: {error}");
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("starts.json");
    std::fs::write(&path, "{").unwrap();
    let (keeper, read) = keep(folder.path(), Arc::default(), WhileTaken::Wait).unwrap();
    // The channel closes when the file has been read.
    let _ = read.blocking_recv();
    assert!(folder.path().join("starts.damaged").exists(), "it is kept aside");
    drop(keeper);
}

#[test]
fn one_process_at_a_time_counts_starts() {
    let folder = tempfile::tempdir().unwrap();
    let (gateway, read) = keep(folder.path(), Arc::default(), WhileTaken::Wait).unwrap();
    // The channel closes when the file has been read, or cannot be.
    let _ = read.blocking_recv();
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    rig.read(0, false, 0.0);
    let (_command, read) = keep(folder.path(), rig.shared.clone(), WhileTaken::GiveUp).unwrap();
    let _ = read.blocking_recv();
    let refused = rig.clear(&[0], 1, 1.0);
    let Verdict::Refuse(refusal) = &refused else {
        unreachable!("{refused:?}")
    };
    assert!(
        refusal.to_string().contains("another drivegate counts starts"),
        "{refusal}"
    );
    let (_next, mut read) = keep(folder.path(), Arc::default(), WhileTaken::Wait).unwrap();
    assert_eq!(read.try_recv(), Err(tokio::sync::oneshot::error::TryRecvError::Empty));
    drop(gateway);
    let _ = read.blocking_recv();
}

#[test]
fn starts_of_drives_that_are_not_here_keep_their_distance() {
    let stagger = Guard {
        stagger: 60 * SECOND,
        ..Guard::default()
    };
    let folder = tempfile::tempdir().unwrap();
    let (rig, time) = (GuardedDrives::of(stagger, Vec::new()), SystemTime::now());
    let machine = crate::process_image::Machine {
        port: "elsewhere".to_string(),
        address: 9,
        profile: "vacon-nx".to_string(),
    };
    let group = rig.images[0].spec.starts_with();
    Saved::new([(machine.clone(), vec![time])].into_iter())
        .save(&folder.path().join("starts.json"))
        .unwrap();
    observe(folder.path(), &rig.shared);
    rig.read(0, false, 0.0);
    assert_eq!(rig.refused(0, 1.0), None, "another group");
    rig.shared.know(&[(machine, group)]);
    assert_eq!(rig.refused(0, 1.0), Some("stagger"));
    let _ = std::fs::write(folder.path().join("starts.json"), "{");
    observe(folder.path(), &rig.shared);
    let refused = rig.clear(&[0], 1, 70.0);
    assert!(matches!(refused, Verdict::Refuse(_)), "{refused:?}");
    assert!(!folder.path().join("starts.damaged").exists(), "a look changes nothing");
}

#[test]
fn a_start_that_waits_for_the_file_is_judged_by_it() {
    let rig = GuardedDrives::of(per_hour(1), Vec::new());
    rig.shared.await_file(std::path::Path::new("state/starts.json"));
    rig.read(0, false, 0.0);
    assert_eq!(reason(rig.clear(&[0], 1, 1.0)), "wait");
    let machine = rig.bus.machine(&rig.images[0].spec);
    let time = SystemTime::now();
    let saved = Saved::new([(machine, vec![time - 60 * SECOND])].into_iter());
    rig.shared.keep(&saved, rig.at(1.5), time);
    let (generation, _) = rig.shared.to_write(rig.at(1.5), time).unwrap();
    rig.shared.wrote(generation, Ok(()), rig.at(1.5));
    assert_eq!(reason(rig.clear(&[0], 1, 1.6)), "starts_per_hour");
}
