//! Compares the prediction of `predict` for a bus with the bus itself.

use std::time::Duration;

use drivegate_bus::predict::predict;
use drivegate_core::process_image::DriveSpec;
use drivegate_proto::Protocol;
use drivegate_proto::wire::Silence;
use drivegate_sim::statistics::{Direction, Recorded};

use super::bus::Parts;
use super::rig::{Rig, line};

/// Number of measured rounds; the slow requests within them are part of the cycle.
const ROUNDS: usize = 400;

#[test]
fn a_saturated_line_has_the_cycle_that_was_predicted() {
    let line = line("vacon-nx", Protocol::ModbusRtu, 19_200, 3);
    let mut rig = Rig::new(&line, Parts::of(0, &line, 1));
    rig.until("all drives are read", Duration::from_secs(5), Rig::is_whole);
    // The class `once` is read first; the prediction does not include it.
    rig.run(Duration::from_secs(2));
    rig.bus.wire.record(100_000);
    rig.run(Duration::from_secs(60));
    let image = &rig.bus.handle.image;
    let specs: Vec<DriveSpec> = image.drives.iter().map(|drive| drive.spec.clone()).collect();
    let predicted = predict(&image.spec, Silence::Spec, &specs).fast_cycle.unwrap();

    // The process data of drive 1 begins each round.
    let first = |frame: &Recorded| {
        frame.direction == Direction::ToDrives && frame.bytes.starts_with(&[0x01, 0x03, 0x08, 0x34, 0x00, 0x0B])
    };
    let frames = rig.bus.wire.transcript().frames().into_iter();
    let rounds: Vec<Duration> = frames.filter(first).map(|frame| frame.start).take(ROUNDS + 1).collect();
    assert_eq!(rounds.len(), ROUNDS + 1);
    let took = (rounds[ROUNDS] - rounds[0]).as_secs_f64() / ROUNDS as f64;
    let off = took / predicted.as_secs_f64() - 1.0;
    assert!(
        off.abs() < 0.02,
        "{took} s, predicted were {predicted:?}: {:+.2} %",
        100.0 * off
    );
    assert!(image.health().fast.last.is_some(), "the achieved cycle is exported");
}
