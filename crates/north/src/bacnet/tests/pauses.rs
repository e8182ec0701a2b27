//! Requests that arrived behind a pause of the process.

use arc_swap::ArcSwap;
use drivegate_bacnet::encoding::Writer;
use drivegate_bacnet::npdu::{self, Payload};
use drivegate_bacnet::{Mac, bvlc};
use drivegate_core::order::Connection;
use drivegate_core::stalls::Stall;

use super::super::desk::{Desk, Ended};
use super::*;

/// A WritePropertyMultiple at priority 8: a reference, then a start.
fn reference_and_start() -> Vec<u8> {
    let mut writer = Writer::default();
    for object in [SPEED, RUN] {
        writer.context_object(0, object).open(1).context_unsigned(0, 85).open(2);
        if object == RUN {
            writer.enumerated(1);
        } else {
            writer.real(20.0);
        }
        writer.close(2).context_unsigned(3, 8).close(1);
    }
    let apdu = [&[0x00, 0x05, 1, 16][..], &writer.into_bytes()].concat();
    let to = Some((1001, Mac::new(&[1]).unwrap()));
    bvlc::unicast(&npdu::encode(to, None, true, Payload::Application(&apdu)))
}

/// The later writes of a request arrived with the first one, however much arrives while that waits for its drive.
#[test]
fn a_start_behind_another_write_is_as_old_as_its_request() {
    let rig = ControlledDrive::new();
    let plant = Arc::new(ArcSwap::from(rig.view.plant.clone()));
    let at = (options().listen, 8);
    let connection = Connection::opened(rig.now);
    let ended = rig.now + Duration::from_secs(3);
    let behind_pause = Arrival {
        pause: Some(Stall::new(rig.now, ended)),
        ..Arrival::over(connection.clone(), ended)
    };
    for (arrival, starts) in [(Arrival::over(connection.clone(), ended), true), (behind_pause, false)] {
        let mut desk = Desk::new(
            Arc::new(options()),
            HostRights::new(&options()),
            plant.clone(),
            at,
            rig.now,
        );
        let mut now = ended;
        read_all(&rig.drive().image, now, |_| 0);
        desk.received(arrival, now);
        desk.receive("127.0.0.5:47808".parse().unwrap(), &reference_and_start(), now);
        let (token, waiting) = desk.next_order(now).expect("the reference");
        assert!(desk.next_order(now).is_none());
        for _ in 0..100 {
            now += Duration::from_millis(1);
            desk.received(Arrival::over(connection.clone(), now), now);
        }
        let outcome = done();
        take_next(&rig.drive().bus.queue, now)
            .expect("the reference")
            .answer(&outcome, now);
        desk.ended(&Ended::of(token, waiting, outcome), now);
        let (_, mut start) = desk.next_order(now).expect("the start");
        let refused = start.placed.answer().map(|answer| answer.outcome);
        assert_eq!(refused, (!starts).then_some(Outcome::Expired));
        while let Some(command) = take_next(&rig.drive().bus.queue, now) {
            command.answer(&done(), now);
        }
    }
}
