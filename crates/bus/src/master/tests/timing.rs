//! Times of one drive that differ from those of its bus.

use super::*;
use drivegate_core::process_image::Timing;

const SLOW: Timing = Timing {
    response_timeout: Some(Duration::from_millis(400)),
    silence: Some(Duration::from_millis(90)),
    retries: Some(4),
};

/// A rig whose second drive has its own times.
fn rig() -> Rig {
    Rig::with(2, "vacon-nx", Protocol::ModbusRtu, Duration::from_millis(10), |spec| {
        DriveSpec {
            timing: if spec.address == 2 { SLOW } else { Timing::default() },
            supervision: None,
            ..spec
        }
    })
}

fn tries_until_offline(rig: &mut Rig, drive: usize) -> usize {
    rig.drives[drive].silent = true;
    let from = rig.wire.len();
    let is_offline = |rig: &Rig| matches!(rig.bus.image.drives[drive].snapshot().link, Link::Offline(_));
    while !is_offline(rig) {
        rig.step();
    }
    let tries = rig.wire[from..]
        .iter()
        .filter(|(_, turn)| drive_of(turn) == drive)
        .count();
    rig.drives[drive].silent = false;
    tries
}

#[test]
fn a_drive_has_its_own_time_and_silence_and_the_others_have_those_of_the_bus() {
    let mut rig = rig();
    let mut asked = [false; 2];
    for _ in 0..200 {
        let Ok(turn) = rig.master.next(rig.now, &mut Vec::new()) else {
            rig.now += Duration::from_millis(1);
            continue;
        };
        let sending = rig.master.sending(&turn, rig.now);
        let (timeout, silence) = match drive_of(&turn) {
            0 => (options().response_timeout, SILENCE),
            _ => (Duration::from_millis(400), Duration::from_millis(90)),
        };
        assert_eq!((sending.response_timeout, sending.silence), (timeout, silence));
        asked[drive_of(&turn)] = true;
        let end = TurnEnd {
            ended: rig.drives[drive_of(&turn)].answer(turn.pdu()),
            began: rig.now,
            at: rig.now + COST,
            stood: false,
            took: COST,
            mangled: false,
            doubted: false,
            frame: Vec::new(),
        };
        rig.now += COST;
        rig.master.done(&turn, end, rig.now, &mut Vec::new());
    }
    assert_eq!(asked, [true; 2]);
}

#[test]
fn a_drive_is_tried_as_often_as_it_says_before_it_is_offline() {
    let mut rig = rig();
    assert_eq!(tries_until_offline(&mut rig, 0), 1 + 1);
    assert_eq!(tries_until_offline(&mut rig, 1), 4 + 1);
}

/// Drives that are busy get their stops again and again, which fills the line.
#[test]
fn a_stop_does_not_wait_until_other_drives_are_no_longer_busy() {
    let mut rig = Rig::new(12);
    for drive in &mut rig.drives {
        drive.holding.insert(2000, 1);
    }
    rig.run(Duration::from_secs(2));
    let busy = 0..10;
    for drive in busy.clone() {
        rig.drives[drive].to_writes = Some((u32::MAX, Exception::BUSY));
    }
    let _stops: Vec<_> = busy.clone().map(|k| rig.switch(k, "client", false)).collect();
    rig.run(Duration::from_millis(500));
    let (from, asked) = (rig.wire.len(), rig.now);
    let _stops: Vec<_> = [10, 11].map(|k| rig.switch(k, "client", false)).into();
    rig.run(Duration::from_secs(1));
    let writes = |drive: usize| {
        let to = move |(_, turn): &&(Instant, Turn)| turn.pdu().is_write() && turn.target() == DriveIndex::new(drive);
        rig.wire[from..].iter().filter(to).map(|(at, _)| *at - asked)
    };
    for drive in [10, 11] {
        let first = writes(drive).next();
        assert!(first.is_some_and(|after| after <= 5 * COST), "{drive}: {first:?}");
    }
    let tries: Vec<usize> = busy.map(|drive| writes(drive).count()).collect();
    let (least, most) = (tries.iter().min(), tries.iter().max());
    assert!(
        least
            .zip(most)
            .is_some_and(|(least, most)| *least > 0 && most - least <= 1),
        "{tries:?}"
    );
}

/// A drive that does not answer holds the line for its response timeout at each try.
#[test]
fn a_stop_goes_before_those_of_drives_that_do_not_answer() {
    let mut rig = Rig::new(10);
    let silent = 0..5;
    for (index, drive) in rig.drives.iter_mut().enumerate() {
        drive.holding.insert(2000, 1);
        drive.silent = silent.contains(&index);
    }
    rig.run(Duration::from_secs(5));
    let (from, asked) = (rig.wire.len(), rig.now);
    let _stops: Vec<_> = (0..10).map(|k| rig.switch(k, "client", false)).collect();
    rig.run(Duration::from_secs(2));
    let first = |drive: usize| {
        let to = |(_, turn): &&(Instant, Turn)| turn.pdu().is_write() && turn.target() == DriveIndex::new(drive);
        rig.wire[from..].iter().find(to).map(|(at, _)| *at - asked)
    };
    let answering: Vec<_> = (5..10).map(first).collect();
    let others: Vec<_> = silent.map(first).collect();
    assert!(others.iter().all(Option::is_some), "{others:?}");
    assert!(
        answering.iter().all(|sent| sent.is_some_and(|sent| sent <= 12 * COST)),
        "{answering:?}"
    );
    assert!(answering.iter().max() < others.iter().min(), "{answering:?} {others:?}");
}

/// Each stop of a drive that does not answer holds the line for its response timeout, and is given again.
#[test]
fn a_stop_is_repeated_for_a_busy_drive_between_those_of_drives_that_do_not_answer() {
    let mut rig = Rig::new(12);
    for (index, drive) in rig.drives.iter_mut().enumerate() {
        drive.holding.insert(2000, 1);
        drive.silent = index > 0;
    }
    rig.run(Duration::from_secs(5));
    rig.drives[0].to_writes = Some((u32::MAX, Exception::BUSY));
    let from = rig.wire.len();
    let _stops: Vec<_> = (0..12).map(|k| rig.switch(k, "client", false)).collect();
    rig.run(Duration::from_secs(1));
    let is_write = |(_, turn): &&(Instant, Turn)| turn.pdu().is_write();
    let writes: Vec<bool> = rig.wire[from..]
        .iter()
        .filter(is_write)
        .map(|(_, turn)| turn.target() == DriveIndex::new(0))
        .collect();
    let (others, own) = (
        writes.iter().filter(|own| !**own).count(),
        writes.iter().filter(|own| **own).count(),
    );
    assert!(
        others >= 4 && own + 1 >= others,
        "{own} repetitions, {others} stops to the others"
    );
}
