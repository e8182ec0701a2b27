use std::time::Duration;

use arc_swap::ArcSwap;
use drivegate_core::order::Command;
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_testkit::{STALE_AFTER, bus, bus_spec, controlled, image, nx, read_all, take_next, up};

use super::super::{Loopback, Options};
use super::*;

#[test]
fn a_reset_that_the_drive_took_is_no_change_again_because_the_read_behind_it_failed() {
    let now = Instant::now();
    let drive = image(controlled("p1", "line1", 1, &nx()));
    read_all(&drive, now, |_| 0);
    let bus = up(bus(bus_spec("line1"), vec![drive]));
    let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(Plant::new("hall", STALE_AFTER, vec![bus])));
    let options = Options {
        listeners: Vec::new(),
        tls: None,
        max_connections: 1,
        max_connections_per_address: 1,
        idle_timeout: None,
        uncached: Uncached::Forward,
    };
    let peer = ([127, 0, 0, 1], 4711).into();
    let mut client = Loopback::new(options, plant.clone(), Arc::default(), peer, Authority::Write);
    // Function 23: the word at 0x8100, and one register that is not polled.
    let mut send = |word: u8| {
        client.receive(
            &[0, 1, 0, 0, 0, 13, 1, 23, 0x10, 0, 0, 1, 0x81, 0, 0, 1, 2, 0, word],
            now,
        );
        let next = || take_next(&plant.load().buses[0].queue, now).expect("an order");
        let write: Command = next();
        let resets = match &write.intent.order {
            Order::Points(points) => {
                let reset = nx().model_index(ModelPoint::FaultReset).unwrap();
                points.contains(&(reset, Value::Bool(true)))
            }
            other => panic!("{other:?}"),
        };
        write.answer(&Outcome::Acknowledged(Reply::Written), now);
        client.receive(&[], now);
        let read = next();
        assert!(matches!(read.intent.order, Order::Read(_)), "{read:?}");
        read.answer(&Outcome::TimedOut, now + Duration::from_millis(1));
        let answer = client.receive(&[], now);
        assert_eq!(answer.get(7), Some(&(23 | 0x80)), "{answer:?}");
        resets
    };
    assert!(!send(1));
    assert!(send(5));
    assert!(!send(5), "the drive took the reset");
}
