//! Bytes that a Modbus TCP client may send, and answers that the bus may give meanwhile.
//!
//! Input: whether the client may write and whether uncached reads are forwarded; then steps of a kind, a length and
//! as many bytes. A step sends the bytes raw or as the PDU of a frame, or lets the bus answer commands. Every frame
//! must be answered once, with its own transaction id, unit id and function.

use std::collections::HashMap;
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use drivegate_core::process_image::{BusImage, DriveImage, Link};
use drivegate_proto::{Exception, Reply, RequestPdu, Table};
use drivegate_core::order::{Authority, Command, Order, Outcome, Urgency};
use drivegate_core::queue::{Ready, CommandQueue};
use drivegate_gateway::config::Settings;
use drivegate_north::modbus_tcp::{Loopback, Options, Uncached};
use drivegate_core::plant::{BusHandle, Plant, SharedPlant};

/// Unit 1 may be commanded, 2 not, 3 is offline, the bus of 4 is down.
const CONFIGURATION: &str = r#"
[gateway]
name = "fuzz"
[[bus]]
name = "line1"
port = "/dev/null"
drive = [
    { name = "pump-1", address = 1, profile = "vacon-nx", access = "control", supervision = { timeout = "1h", action = "hold" } },
    { name = "pump-2", address = 2, profile = "vacon-nx" },
    { name = "spare", address = 3, profile = "vacon-nx", access = "control" },
]
[[bus]]
name = "line2"
port = "/dev/zero"
drive = [{ name = "fan", address = 4, profile = "vacon-nx", access = "control" }]
[modbus_tcp]
write = ["127.0.0.1"]
"#;
const UNITS: [u8; 8] = [1, 1, 1, 2, 3, 4, 255, 9];

static PLANT: LazyLock<SharedPlant> = LazyLock::new(|| {
    let loaded = Settings::parse("fuzz.toml", CONFIGURATION, std::iter::empty());
    let settings = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors));
    let now = Instant::now();
    let buses = settings.buses.iter().enumerate().map(|(place, bus)| {
        let drives: Vec<Arc<DriveImage>> =
            bus.drives.iter().map(|d| Arc::new(DriveImage::new(d.clone(), bus.spec.slow_cycle))).collect();
        for drive in drives.iter().filter(|d| d.spec.name != "spare") {
            drive.update(|s| {
                s.link = Link::Online(SystemTime::now());
                s.fast_at = Some(now);
                s.store(Table::Holding, 2100, &[0x23, 0x2000, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 0], now);
                s.store(Table::Holding, 7, &[42, 30], now);
                s.store(Table::Holding, 2000, &[1, 0, 5000], now);
                s.store(Table::Holding, 100, &[0, 5000, 30, 30], now);
            });
        }
        let image = BusImage::new(bus.spec.clone(), drives);
        image.update_health(|h| h.up = place == 0);
        BusHandle::new(Arc::new(image), Arc::new(CommandQueue::new().expect("a queue")), Arc::default())
    });
    Arc::new(ArcSwap::from_pointee(Plant::new(&settings.gateway, Duration::from_secs(1_000_000), buses.collect())))
});

static OPTIONS: LazyLock<Options> = LazyLock::new(|| {
    let loaded = Settings::parse("fuzz.toml", CONFIGURATION, std::iter::empty());
    loaded.settings.and_then(|s| s.modbus_tcp).expect("a server")
});

/// Lets the bus answer the oldest command.
fn answer(command: Command, how: u8) {
    let outcome = match how & 7 {
        0 => Outcome::TimedOut,
        1 => Outcome::Exception(Exception::Modbus(how >> 3)),
        2 => Outcome::Acknowledged(Reply::Registers(vec![7; usize::from(how >> 3)])),
        3 => Outcome::BusDown,
        _ => Outcome::Acknowledged(match &command.intent.order {
            Order::Read(RequestPdu::Read { table, count, .. }) if table.is_bits() => {
                Reply::Bits(vec![true; usize::from(*count)])
            }
            Order::Read(RequestPdu::Read { count, .. }) => Reply::Registers(vec![1; usize::from(*count)]),
            _ => Reply::Written,
        }),
    };
    command.answer(&outcome, Instant::now());
}

fn next_command(plant: &SharedPlant) -> Option<Command> {
    let plant = plant.load();
    let now = Instant::now();
    plant.buses.iter().find_map(|bus| {
        let mut pending = bus.queue.lock();
        let ranks = [Urgency::Stop, Urgency::Command, Urgency::Read];
        let chosen = ranks.into_iter().find_map(|rank| pending.next(rank, now, &(), |_| Ready::Now, |_| false).chosen)?;
        pending.take(chosen)
    })
}

/// The frames of a client up to the first invalid one, decoded strictly by the specification.
fn frames(mut bytes: &[u8]) -> Vec<(u16, u8, u8)> {
    let mut found = Vec::new();
    while let [t1, t2, 0, 0, l1, l2, rest @ ..] = bytes {
        let length = usize::from(u16::from_be_bytes([*l1, *l2]));
        if !(2..=254).contains(&length) || rest.len() < length {
            break;
        }
        found.push((u16::from_be_bytes([*t1, *t2]), rest[0], rest[1]));
        bytes = &rest[length..];
    }
    found
}

pub(crate) fn run(data: &[u8]) {
    let Some((flags, mut data)) = data.split_first() else { return };
    let mut options = OPTIONS.clone();
    if flags & 2 == 2 {
        options.uncached = Uncached::Refuse;
    }
    let plant = PLANT.clone();
    let authority = if flags & 1 == 0 { Authority::Write } else { Authority::ReadOnly };
    let mut client = Loopback::new(options, plant.clone(), Arc::default(), ([127, 0, 0, 1], 502).into(), authority);
    let (mut sent, mut answers) = (Vec::new(), Vec::new());
    let mut transaction = 0u16;
    while let [kind, length, rest @ ..] = data {
        let (bytes, rest) = rest.split_at(usize::from(*length).min(rest.len()));
        data = rest;
        let piece = match kind >> 6 {
            // Sends raw bytes.
            0 => bytes.to_vec(),
            1 => {
                for how in bytes {
                    if let Some(command) = next_command(&plant) {
                        answer(command, *how);
                    }
                }
                Vec::new()
            }
            _ if bytes.is_empty() => continue,
            _ => {
                transaction = transaction.wrapping_add(1);
                let pdu = &bytes[..bytes.len().min(253)];
                let mut frame = transaction.to_be_bytes().to_vec();
                frame.extend_from_slice(&[0, 0, 0, pdu.len() as u8 + 1, UNITS[usize::from(kind & 7)]]);
                frame.extend_from_slice(pdu);
                frame
            }
        };
        sent.extend_from_slice(&piece);
        answers.extend(client.receive(&piece, Instant::now()));
    }
    // The bus answers the remaining commands; otherwise the commands of all clients would fill the queue.
    loop {
        while let Some(command) = next_command(&plant) {
            answer(command, 7);
        }
        answers.extend(client.receive(&[], Instant::now()));
        let empty = plant.load().buses.iter().all(|bus| bus.queue.lock().is_empty());
        if empty && (client.is_closed() || !client.is_waiting()) {
            break;
        }
    }
    let (asked, answered) = (frames(&sent), frames(&answers));
    let mut open: HashMap<(u16, u8, u8), i64> = HashMap::new();
    for frame in &asked {
        *open.entry((frame.0, frame.1, frame.2 & 0x7F)).or_default() += 1;
    }
    for frame in &answered {
        let left = open.entry((frame.0, frame.1, frame.2 & 0x7F)).or_default();
        *left -= 1;
        assert!(*left >= 0, "an answer to nothing: {frame:?}");
    }
    // On a connection that is closed because of invalid input, requests that wait for the bus are not answered.
    assert!(client.is_closed() || asked.len() == answered.len(), "{asked:?} {answered:?}");
    let whole: usize = answers.len();
    let mut length = 0;
    while length + 6 <= whole {
        length += 6 + usize::from(u16::from_be_bytes([answers[length + 4], answers[length + 5]]));
    }
    assert_eq!(length, whole, "whole frames only");
}
