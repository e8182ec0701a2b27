//! Time from a command's acknowledgement by the drive to the notification (COV) of the change at a BACnet client.
//!
//! `cargo bench --bench bacnet` (options: `-- --changes 200 --baud 38400`). Eight drives of profile `vacon-nx`, 8N1; the client is
//! subscribed to `running` of one of them, which is started and stopped at another moment of the polling round each time. The drive
//! reports the change in its next poll, so the limit is one round, which is printed beside it.

mod common;

use std::error::Error;
use std::net::UdpSocket;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use drivegate_core::order::{Authority, Order, Origin, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_model::drive::Value;

use common::gateway::{Bus, Gateway, line, settings};
use common::{option, quantile};

const DRIVES: u8 = 8;
/// SubscribeCOV of `running` of unit 5, unconfirmed, without end.
const SUBSCRIBE: [u8; 26] = [
    0x81, 0x0A, 0, 26, 1, 0x24, 3, 0xE9, 1, 5, 0xFF, 2, 5, 1, 5, 0x09, 7, 0x1C, 0, 0xC0, 0, 2, 0x29, 0, 0x39, 0,
];

fn main() -> ExitCode {
    common::exit(measure())
}

fn measure() -> Result<(), Box<dyn Error>> {
    let changes: u64 = option("--changes", 200)?;
    let baud: u32 = option("--baud", 38_400)?;
    let line = line(baud, DRIVES)?;
    let address = line.address();
    let bus = Bus::commanded(&address, baud, DRIVES, "");
    let port = UdpSocket::bind("127.0.0.1:0")?.local_addr()?.port();
    let bacnet = format!("[bacnet]\nlisten = \"127.0.0.1:{port}\"\n");
    let gateway = Gateway::start(settings(&format!("{bacnet}{}", bus.toml()))?)?;
    let client = UdpSocket::bind("127.0.0.22:0")?;
    client.set_read_timeout(Some(Duration::from_secs(5)))?;
    client.send_to(&SUBSCRIBE, ("127.0.0.1", port))?;
    let mut buffer = [0; 1500];
    // The acknowledgement, and the present value.
    for _ in 0..2 {
        client.recv(&mut buffer)?;
    }
    let drive = gateway.plant.drive("line-5").ok_or("no drive")?;
    let run = drive.image.spec.profile.point_index("run").ok_or("no point")?;
    let mut took = Vec::new();
    for number in 0..changes {
        std::thread::sleep(Duration::from_millis(number * 37 % 113));
        let on = number % 2 == 0;
        let order = Order::Points(vec![(run, Value::Bool(on))]);
        let origin = Origin::new(SourceKind::Mqtt, "bench");
        let mut placed = drive.place(OrderRequest::new(order, origin, Authority::Write), Instant::now());
        if !gateway.runtime.block_on(placed.answered()).outcome.is_ok() {
            return Err("a command failed".into());
        }
        let acknowledged = Instant::now();
        // The value is between the tags 2: ENUMERATED.
        loop {
            let length = client.recv(&mut buffer)?;
            let value = [0x2E, 0x91, u8::from(on), 0x2F];
            let received = buffer.get(..length).unwrap_or_default();
            if received.windows(4).any(|bytes| bytes == value) {
                break;
            }
        }
        took.push(acknowledged.elapsed().as_secs_f64() * 1e3);
    }
    let at = |share| quantile(&took, share);
    println!(
        "acknowledgement to notification: median {:.1} ms, p90 {:.1} ms, p99 {:.1} ms, longest {:.1} ms",
        at(0.5),
        at(0.9),
        at(0.99),
        at(1.0)
    );
    let fast = gateway.bus()?.health().fast;
    println!("polling round: {fast:?}");
    gateway.stop();
    Ok(())
}
