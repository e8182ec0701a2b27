//! A broker whose packets the test sends itself, byte by byte, and whose acknowledgements it withholds.

use std::io::Write as _;
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use drivegate_core::event::EventKind;
use drivegate_core::order::{Authority, Order, Origin, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_model::drive::Value;
use drivegate_mqtt::Buffer;
use drivegate_testkit::mqtt as packets;

use super::bench::*;

const SET: &str = "drivegate/hall/drive/p1/set";
/// Size of correlation data that fill the room for results soon.
const LONG: usize = 60_000;
/// Receive maximum of the broker: one message at a time.
const ONE: [u8; 3] = [0x21, 0, 1];

#[derive(Default)]
struct Seen {
    connections: usize,
    /// Topics and payloads of the messages, in order; long ones left out.
    messages: Vec<String>,
    withheld: Vec<[u8; 2]>,
    /// Whether the broker acknowledges messages.
    acknowledges: bool,
}

#[derive(Clone)]
struct Puppet {
    port: u16,
    seen: Arc<Mutex<Seen>>,
    /// Locked for whole packets, since two threads write.
    stream: Arc<Mutex<Option<TcpStream>>>,
}

/// A PUBLISH with QoS 0; with correlation data also with a response topic.
fn publish(topic: &str, correlation: &[u8], payload: &str) -> Vec<u8> {
    let short = |length: usize| u16::try_from(length).unwrap().to_be_bytes();
    let varint = |mut length: usize| {
        let mut bytes = Vec::new();
        loop {
            let more = length > 0x7F;
            bytes.push((length & 0x7F) as u8 | u8::from(more) << 7);
            length >>= 7;
            if !more {
                return bytes;
            }
        }
    };
    let properties = match correlation.len() {
        0 => Vec::new(),
        length => [b"\x08\0\x07answers\x09", &short(length)[..], correlation].concat(),
    };
    let body = [
        &short(topic.len()),
        topic.as_bytes(),
        &varint(properties.len()),
        &properties,
        payload.as_bytes(),
    ]
    .concat();
    [&[0x30][..], &varint(body.len()), &body].concat()
}

impl Puppet {
    fn start() -> Puppet {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let puppet = Puppet {
            port,
            seen: Arc::default(),
            stream: Arc::default(),
        };
        let shared = puppet.clone();
        // The thread lives as long as the process.
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                stream.set_nodelay(true).unwrap();
                stream.set_write_timeout(Some(DEADLINE)).unwrap();
                shared.seen.lock().unwrap().connections += 1;
                *shared.stream.lock().unwrap() = Some(stream.try_clone().unwrap());
                shared.serve(stream);
            }
        });
        puppet
    }

    fn serve(&self, mut stream: TcpStream) {
        while let Some((kind, body)) = packets::read_packet(&mut stream) {
            match kind >> 4 {
                1 => self.send(&[&[0x20, 6, 0, 0, 3][..], &ONE].concat()),
                8 => {
                    let codes = vec![1; packets::filters(&body).len()];
                    let answer = packets::subscribed(&body, &codes);
                    self.send(&[&[0x90, u8::try_from(answer.len()).unwrap()][..], &answer].concat());
                }
                3 => self.message(kind, &body),
                12 => self.send(&[0xD0, 0]),
                _ => {}
            }
        }
    }

    fn message(&self, kind: u8, body: &[u8]) {
        let mut seen = self.seen.lock().unwrap();
        // Long results would be searched again and again.
        if body.len() < LONG {
            seen.messages.push(String::from_utf8_lossy(body).into_owned());
        }
        if kind & 0x06 == 0 {
            return;
        }
        let behind = 2 + usize::from(u16::from_be_bytes([body[0], body[1]]));
        seen.withheld.push([body[behind], body[behind + 1]]);
        let due = if seen.acknowledges {
            std::mem::take(&mut seen.withheld)
        } else {
            Vec::new()
        };
        drop(seen);
        due.into_iter().for_each(|packet| self.acknowledge(packet));
    }

    fn acknowledge(&self, packet: [u8; 2]) {
        self.send(&[0x40, 4, packet[0], packet[1], 0, 0]);
    }

    /// Acknowledges the messages so far, and those to come if `acknowledges`.
    fn acknowledge_all(&self, acknowledges: bool) {
        let mut seen = self.seen.lock().unwrap();
        seen.acknowledges = acknowledges;
        let due = std::mem::take(&mut seen.withheld);
        drop(seen);
        due.into_iter().for_each(|packet| self.acknowledge(packet));
    }

    fn send(&self, bytes: &[u8]) {
        // The gateway may have closed the connection.
        let _ = self.stream.lock().unwrap().as_ref().unwrap().write_all(bytes);
    }

    /// Waits for a message with this text; returns it.
    fn wait(&self, text: &str) -> String {
        wait_for(text, || {
            let seen = self.seen.lock().unwrap();
            seen.messages.iter().find(|message| message.contains(text)).cloned()
        })
    }

    fn connections(&self) -> usize {
        self.seen.lock().unwrap().connections
    }
}

fn stops(gateway: &Gateway) -> usize {
    let stop = [("run".to_string(), Value::Bool(false))];
    gateway.ordered().iter().filter(|order| order.1 == stop).count()
}

#[test]
fn more_results_than_there_is_room_for_cost_results_and_no_connection() {
    let puppet = Puppet::start();
    let gateway = Gateway::start(options(puppet.port), plant(&["p1"]));
    puppet.wait("/status");
    puppet.acknowledge_all(false);
    // Each result repeats the correlation data: together more than 32 MiB.
    let refused = publish(&format!("{SET}/nothing"), &[b'c'; LONG], "1");
    for _ in 0..700 {
        puppet.send(&refused);
        // The thread that answers pings sends over the same stream.
        std::thread::sleep(Duration::from_millis(1));
    }
    puppet.send(&publish(&format!("{SET}/run"), &[], "false"));
    wait_for("the stop", || (stops(&gateway) == 1).then_some(()));
    let lost = || gateway.stats.mqtt.losses().map(|(_, count)| count).sum::<u64>();
    wait_for("the count of lost results", || (lost() > 100).then_some(()));
    puppet.acknowledge_all(true);
    puppet.wait("\"result\":\"acknowledged\"");
    puppet.send(&publish(&format!("{SET}/run"), &[], "false"));
    wait_for("another stop", || (stops(&gateway) == 2).then_some(()));
    assert!(gateway.connected());
    assert_eq!(puppet.connections(), 1);
    gateway.stop();
}

/// A stop over another way in is acknowledged between the two parts of a start.
#[test]
fn a_packet_in_two_parts_is_as_old_as_the_first() {
    let puppet = Puppet::start();
    let gateway = Gateway::start(options(puppet.port), plant(&["p1"]));
    puppet.wait("/status");
    puppet.acknowledge_all(false);
    let first = publish(SET, &[], r#"{"id": "first", "speed_reference": 10}"#);
    let start = publish(SET, &[], r#"{"id": "start", "run": true}"#);
    let (head, rest) = start.split_at(20);
    puppet.send(&[&first, head].concat());
    puppet.wait("\"id\":\"first\"");
    let drive = gateway.plant.load().drive("p1").unwrap();
    let run = drive.image.spec.profile.point_index("run").unwrap();
    let order = Order::Points(vec![(run, Value::Bool(false))]);
    let origin = Origin::new(SourceKind::Http, "alice");
    let mut placed = drive.place(OrderRequest::new(order, origin, Authority::Write), Instant::now());
    let answer = runtime().block_on(placed.answered());
    assert!(answer.outcome.is_ok(), "{answer:?}");
    puppet.send(rest);
    puppet.acknowledge_all(true);
    let result = puppet.wait("\"id\":\"start\"");
    // A pause of the machine lets the start expire.
    let is_old = ["purged", "expired"]
        .iter()
        .any(|why| result.contains(&format!("\"result\":\"{why}\"")));
    assert!(is_old, "{result}");
    assert_eq!(stops(&gateway), 1);
    assert!(gateway.ordered().iter().all(|order| order.1[0].1 != Value::Bool(true)));
    gateway.stop();
}

/// A message without the retain flag clears nothing, so the topics of an earlier run stay on the list.
#[test]
fn without_retained_messages_no_topic_is_cleared_and_none_is_forgotten() {
    let dir = tempfile::tempdir().unwrap();
    let list = dir.path().join("mqtt-topics");
    std::fs::write(&list, "drivegate/hall/drive/gone/state").unwrap();
    let puppet = Puppet::start();
    let mut options = options(puppet.port);
    options.retain = false;
    options.buffer = Some(Buffer {
        dir: dir.path().to_path_buf(),
        max_bytes: 1 << 20,
    });
    let gateway = Gateway::start(options, plant(&["p1"]));
    puppet.wait("/status");
    puppet.acknowledge_all(true);
    let topics = || std::fs::read_to_string(&list).unwrap();
    wait_for("the topics of this run", || topics().contains("p1/state").then_some(()));
    for text in ["first", "second"] {
        gateway.publish_event("p1", EventKind::Fault, text);
        puppet.wait(text);
    }
    gateway.stop();
    let seen = puppet.seen.lock().unwrap();
    assert!(!seen.messages.iter().any(|message| message.contains("gone")));
    assert!(topics().contains("drivegate/hall/drive/gone/state"));
}
