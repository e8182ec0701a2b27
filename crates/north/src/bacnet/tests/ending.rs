//! The end of the gateway while a request waits for its drives.

use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate_bacnet::encoding::Writer;
use drivegate_bacnet::npdu::{self, Payload};
use drivegate_bacnet::{ObjectId, ObjectType, bvlc};
use drivegate_core::plant::Plant;
use drivegate_core::process_image::DriveSpec;
use drivegate_testkit::{STALE_AFTER, bus, bus_spec, image, read_all, take_next, up};
use futures_util::FutureExt as _;
use tokio::net::UdpSocket;
use tokio::sync::mpsc;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use super::super::rights::HostRights;
use super::super::sockets::Sockets;
use super::super::task::Task;
use super::{done, options, spec};
use crate::bacnet::Options;

/// The APDU of a request to stop these drives of the single device.
fn stops(units: &[u32]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.raw(&[0x00, 0x05, 1, 16]);
    for unit in units {
        let run = ObjectId::new(ObjectType::BINARY_VALUE, unit * 1000 + 1);
        writer.context_object(0, run).open(1).context_unsigned(0, 85);
        writer.open(2).enumerated(0).close(2).context_unsigned(3, 8).close(1);
    }
    writer.into_bytes()
}

#[tokio::test]
async fn every_stop_of_a_request_is_sent_although_the_gateway_ends_meanwhile() {
    let drive = |unit: u8| {
        let image = image(DriveSpec {
            unit,
            address: unit,
            name: format!("p{unit}"),
            ..spec("vacon-nx")
        });
        read_all(&image, Instant::now(), |_| 0);
        image
    };
    let bus = up(bus(bus_spec("line1"), vec![drive(1), drive(2)]));
    let queue = bus.queue.clone();
    let plant = Arc::new(ArcSwap::from_pointee(Plant::new("hall", STALE_AFTER, vec![bus])));
    let options = Options {
        network: None,
        ..options()
    };
    let sockets = Sockets::bind(options.listen).await.unwrap();
    let server = sockets.address;
    let (_to_task, orders) = mpsc::unbounded_channel();
    let cancel = CancellationToken::new();
    let rights = HostRights::new(&options);
    let task = Task::new(options, sockets, rights, plant, Arc::default(), Arc::default());
    let mut task = Box::pin(task.run(orders, cancel.clone()));
    let client = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let request = npdu::encode(None, None, true, Payload::Application(&stops(&[1, 2])));
    client.send_to(&bvlc::unicast(&request), server).await.unwrap();
    let first = loop {
        assert!(task.as_mut().now_or_never().is_none());
        match take_next(&queue, Instant::now()) {
            Some(order) => break order,
            None => sleep(Duration::from_millis(1)).await,
        }
    };
    // The first stop is on the line.
    cancel.cancel();
    queue.accept_only_stops(Instant::now());
    assert!(task.as_mut().now_or_never().is_none(), "it waits for the drive");
    let of_first = first.drive();
    first.answer(&done(), Instant::now());
    assert!(task.as_mut().now_or_never().is_none(), "it waits for the other drive");
    let second = take_next(&queue, Instant::now()).expect("the second stop");
    assert!(second.is_stop() && second.drive() != of_first, "{second:?}");
    second.answer(&done(), Instant::now());
    task.await;
    let mut answer = [0; 64];
    let length = client.recv(&mut answer).await.unwrap();
    let apdu = answer.get(..length).unwrap();
    assert!(apdu.ends_with(&[0x20, 1, 16]), "an acknowledgement, not {apdu:?}");
}
