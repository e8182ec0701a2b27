//! What `predict` says of a bus, against the bus itself on the simulated line.

mod common;

use std::time::Duration;

use common::Rig;
use drivegate::bus::predict::predict;
use drivegate::codec::wire::Silence;
use drivegate::sim::statistics::{Direction, Recorded};

/// Rounds that are measured; the slow requests that fall into them are part of the cycle.
const ROUNDS: usize = 40;

/// Start times of the fast rounds: the reads of the process data of drive 1.
fn rounds(frames: &[Recorded]) -> Vec<usize> {
    let first = |frame: &Recorded| frame.bytes.starts_with(&[0x01, 0x03, 0x08, 0x34, 0x00, 0x0B]);
    let places = frames
        .iter()
        .enumerate()
        .filter(|(_, f)| f.direction == Direction::ToDrives && first(f));
    places.map(|(place, _)| place).collect()
}

#[tokio::test]
async fn a_saturated_line_has_the_cycle_that_was_predicted() {
    let rig = Rig::start_recorded(&[1, 2, 3], 19_200).await;
    rig.until("all drives answer", |r| r.bus.handle().image.online() == 3)
        .await;
    // The class `once` is read first; it is no part of the prediction.
    tokio::time::sleep(Duration::from_secs(2)).await;
    rig.line.record(10_000);
    rig.until("enough rounds ran", |r| rounds(&r.line.transcript()).len() > ROUNDS)
        .await;
    let image = rig.bus.handle().image.clone();
    let specs: Vec<_> = image.drives.iter().map(|d| d.spec.clone()).collect();
    let predicted = predict(&image.spec, Silence::Chars, &specs).fast_cycle.unwrap();

    let frames = rig.line.transcript();
    let rounds = rounds(&frames);
    let (first, last) = (rounds[0], rounds[ROUNDS]);
    let took = (frames[last].start - frames[first].start).as_secs_f64() / ROUNDS as f64;
    // How late a busy machine sends is no matter of the prediction: what the exchanges themselves took is counted.
    let silence = image.spec.format.silence_chars();
    let exchanges = frames[first..last].chunks(2).map(|exchange| {
        assert_eq!(exchange[1].direction, Direction::FromDrives, "each request is answered");
        exchange[1].end - exchange[0].start + silence
    });
    let busy = exchanges.sum::<Duration>().as_secs_f64() / ROUNDS as f64;
    let off = busy / predicted.as_secs_f64() - 1.0;
    assert!(
        off.abs() < 0.03,
        "{:.3} ms, predicted were {predicted:?}: {:+.2} %",
        busy * 1e3,
        100.0 * off
    );
    assert!(took > 0.97 * predicted.as_secs_f64(), "faster than the wire allows");
    assert!(image.health().fast.last.is_some(), "the achieved cycle is exported");
}
