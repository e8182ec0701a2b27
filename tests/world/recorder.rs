//! The recorder on a bus in virtual time: the cost of a storm of faults for the line, and the completeness of recordings.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use drivegate_core::history::{Clock, Recorder, RecorderOptions, Recording, TriggerKind, assemble::assemble};
use drivegate_model::drive::Value;
use drivegate_proto::{Protocol, RequestPdu, Table};
use drivegate_sim::statistics::Direction;

use super::rig::{Rig, line};

const SECOND: Duration = Duration::from_secs(1);
const TICK: Duration = Duration::from_millis(100);
/// Register of the fault code (ID 99), which is read when a drive has a fault.
const ON_FAULT: u16 = 98;
const PROCESS_DATA: u16 = 2100;

fn options() -> RecorderOptions {
    RecorderOptions {
        dir: "/nowhere".into(),
        before: 30 * SECOND,
        after: 10 * SECOND,
        max_bytes: 1 << 30,
        max_count: 100,
        warnings: false,
    }
}

fn clock(rig: &Rig) -> Clock {
    Clock {
        now: rig.now,
        wall: SystemTime::UNIX_EPOCH + 400 * 86_400 * SECOND,
    }
}

/// Runs the rig; returns the recordings made meanwhile.
fn run(rig: &mut Rig, recorder: Option<&mut Recorder>, time: Duration) -> Vec<Recording> {
    let Some(recorder) = recorder else {
        rig.run(time);
        return Vec::new();
    };
    let mut made = Vec::new();
    for _ in 0..time.as_millis() / TICK.as_millis() {
        rig.run(TICK);
        made.extend(recorder.tick(clock(rig)).iter().map(assemble));
    }
    made
}

/// Number of reads on the line since frame `from`: process data, reads on a fault, all others.
fn reads(rig: &Rig, from: usize) -> [usize; 3] {
    let mut counts = [0; 3];
    for frame in &rig.requests()[from..] {
        let start = u16::from_be_bytes([frame.bytes[2], frame.bytes[3]]);
        counts[match start {
            PROCESS_DATA => 0,
            ON_FAULT => 1,
            _ => 2,
        }] += 1;
    }
    counts
}

#[test]
fn thirty_two_drives_that_trip_at_once_cost_the_line_the_reads_of_their_faults_only() {
    // A line with and without a recorder.
    let storm = |recorded: bool| {
        let mut rig = Rig::of(&line("vacon-nx", Protocol::ModbusRtu, 38_400, 32));
        let mut recorder = recorded.then(|| Recorder::new(options(), Arc::default()));
        let now = clock(&rig);
        recorder
            .iter_mut()
            .for_each(|r| drop(r.adopt(std::slice::from_ref(&rig.bus.handle.image), SECOND, now)));
        run(&mut rig, recorder.as_mut(), 40 * SECOND);
        let before = rig.requests().len();
        run(&mut rig, recorder.as_mut(), 20 * SECOND);
        let quiet = reads(&rig, before);
        let tripped = rig.requests().len();
        (1..=32).for_each(|address| rig.with_drive(address, |drive, _| drive.trip(1)));
        let made = run(&mut rig, recorder.as_mut(), 20 * SECOND);
        (quiet, reads(&rig, tripped), made)
    };
    let (quiet, bare, none) = storm(false);
    let (quiet_recorded, recorded, made) = storm(true);
    println!("20 s before the trips: {quiet:?} and recorded {quiet_recorded:?}; after them: {bare:?} and {recorded:?}");
    assert_eq!(quiet, quiet_recorded, "a recorder costs a line nothing");
    // Without a recorder the fault code is only compared with process data, with one it is recorded: both use one read.
    assert_eq!((bare[1], recorded[1]), (32, 32), "each drive is asked once");
    // The reads use the slow share: process data comes as often, and slow reads are fewer by these.
    let all = |reads: [usize; 3]| reads.iter().sum::<usize>();
    assert!(
        all(bare).abs_diff(all(recorded)) * 100 <= all(bare),
        "{bare:?} {recorded:?}"
    );
    assert!(bare[0].abs_diff(recorded[0]) * 200 <= bare[0], "{bare:?} {recorded:?}");
    assert!(none.is_empty());
    assert_eq!(made.len(), 32);
    for recording in &made {
        assert_eq!(recording.header.trigger, TriggerKind::Fault);
        let own = recording.values_of("fault_code_id99");
        assert!(
            matches!(&own[..], [(t, code)] if *t > 0.0 && code.as_f64() == Some(1.0)),
            "{own:?}"
        );
        assert_eq!(recording.header.lost, 0);
        assert!(
            recording.header.summary.starts_with("fault 1: "),
            "{}",
            recording.header.summary
        );
    }
}

#[test]
fn the_samples_of_a_trip_are_those_on_the_wire_to_the_poll() {
    let mut rig = Rig::of(&line("vacon-nx", Protocol::ModbusRtu, 115_200, 1));
    let mut recorder = Recorder::new(options(), Arc::default());
    let now = clock(&rig);
    recorder.adopt(std::slice::from_ref(&rig.bus.handle.image), SECOND, now);
    run(&mut rig, Some(&mut recorder), 5 * SECOND);
    // The drive accelerates, which needs increasing current, and trips on the way.
    rig.set(1, &[("speed_reference", 100.0), ("run", 1.0)]);
    run(&mut rig, Some(&mut recorder), 2 * SECOND);
    rig.with_drive(1, |drive, _| drive.trip(1));
    let made = run(&mut rig, Some(&mut recorder), 12 * SECOND);
    let [recording] = &made[..] else {
        panic!("{}", made.len())
    };
    // Values that the drive sent, from the reply frames of the process data.
    let frames = rig.bus.wire.transcript().frames();
    let replies = frames.windows(2).filter_map(|pair| {
        let asked = pair[0].direction == Direction::ToDrives && pair[0].bytes[2..4] == PROCESS_DATA.to_be_bytes();
        let words = pair[1].bytes.get(3..25).filter(|_| asked)?;
        let word = |place: usize| u16::from_be_bytes([words[2 * place], words[2 * place + 1]]);
        Some((word(0) & 8 != 0, f64::from(word(5)) / 10.0))
    });
    let said: Vec<(bool, f64)> = replies.collect();
    let faults = recording.values_of("fault");
    let currents = recording.values_of("motor_current");
    let recorded: Vec<(bool, f64)> = faults
        .iter()
        .zip(&currents)
        .map(|((_, fault), (_, current))| (fault.as_bool().unwrap(), current.as_f64().unwrap()))
        .collect();
    let first = said.iter().position(|(fault, _)| *fault).unwrap();
    let trigger = faults.iter().position(|(t, _)| *t == 0.0).unwrap();
    assert_eq!(recorded[..], said[first - trigger..][..recorded.len()]);
    assert!(recorded[trigger].0 && !recorded[trigger - 1].0);
    assert!(
        recorded[trigger - 1].1 > 1.0,
        "it took current: {:?}",
        recorded[trigger - 1]
    );
    println!(
        "{} polls of the recording are those on the wire; {}",
        recorded.len(),
        recording.header.summary
    );
    // The order was recorded with the line.
    let write = recording
        .frames
        .iter()
        .any(|frame| frame.bytes.starts_with(&[1, 6]) || frame.bytes.starts_with(&[1, 16]));
    assert!(write, "its command is among the frames");
}

#[test]
fn a_stop_waits_for_no_read_of_a_fault() {
    let mut rig = Rig::of(&line("vacon-cx", Protocol::ModbusRtu, 19_200, 8));
    let mut recorder = Recorder::new(options(), Arc::default());
    let now = clock(&rig);
    recorder.adopt(std::slice::from_ref(&rig.bus.handle.image), SECOND, now);
    run(&mut rig, Some(&mut recorder), 20 * SECOND);
    (2..=8).for_each(|address| rig.with_drive(address, |drive, _| drive.trip(1)));
    rig.until("the faults", 10 * SECOND, |rig| {
        (2..=8).all(|a| rig.value(a, "fault") == Some(Value::Bool(true)))
    });
    let before = rig.requests().len();
    let outcome = rig.set(1, &[("run", 0.0)]);
    assert!(outcome.is_ok(), "{outcome:?}");
    let asked = rig.requests();
    let stop = RequestPdu::WriteCoil { address: 0, on: false };
    let place = asked[before..]
        .iter()
        .position(|frame| frame.bytes[1] == stop.function())
        .unwrap();
    assert!(place <= 1, "one exchange was on the line: {place}");
    let on_fault = |frame: &drivegate_sim::statistics::Recorded| frame.bytes[1..4] == [4, 0, 14];
    rig.run(30 * SECOND);
    let read = rig.requests()[before..].iter().filter(|frame| on_fault(frame)).count();
    assert!(
        read >= 7,
        "what is read on a fault is read behind it: {read} of {:?}",
        Table::Input
    );
}
