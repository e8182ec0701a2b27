//! A broker that refuses, limits and takes over: effects on one topic or connection must not end the gateway's service.

use std::collections::HashMap;
use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use drivegate_core::event::EventKind;
use drivegate_testkit::mqtt as packets;

use super::bench::*;

const EVENT: &str = "drivegate/hall/drive/p1/event";
const STATE: &str = "drivegate/hall/drive/p1/state";

/// The behaviour of the hostile broker.
#[derive(Clone, Default)]
struct Manners {
    /// Properties of the broker's CONNACK.
    properties: Vec<u8>,
    /// Topics that start like this are refused with this reason code, this number of times.
    refused: Option<(&'static str, u8, usize)>,
    /// Whether the broker sends each byte separately.
    piecemeal: bool,
    /// Whether the broker acknowledges two events at a time, the later one first.
    backwards: bool,
    /// The first connection ends with this DISCONNECT after the first event.
    farewell: Option<Vec<u8>>,
    /// Whether the broker does not answer subscriptions.
    deaf: bool,
    /// Whether the broker stops answering at the first ping.
    mute: bool,
    /// Whether the broker refuses a last will with QoS 1, and one that is retained.
    no_will: bool,
    /// Whether the broker refuses filters with wildcards.
    no_wildcards: bool,
    /// Whether the broker takes 6 s to accept a client.
    slow: bool,
}

/// A broker whose CONNACK has these properties.
fn with(properties: Vec<u8>) -> Manners {
    Manners {
        properties,
        ..Manners::default()
    }
}

#[derive(Default)]
struct Seen {
    /// Received messages: topic, QoS, retain flag and payload.
    messages: Vec<(String, u8, bool, Vec<u8>)>,
    connections: usize,
    most_in_flight: usize,
    longest: usize,
    by_alias: usize,
    refusals: usize,
    filters: Vec<String>,
    /// Last messages of the gateway before it disconnects.
    farewells: Vec<Vec<u8>>,
}

struct Hostile {
    port: u16,
    seen: Arc<Mutex<Seen>>,
}

impl Hostile {
    fn start(manners: Manners) -> Hostile {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let seen: Arc<Mutex<Seen>> = Arc::default();
        let shared = seen.clone();
        // The thread lives as long as the process.
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                let first = {
                    let mut seen = shared.lock().unwrap();
                    seen.connections += 1;
                    seen.connections == 1
                };
                let (manners, seen) = (manners.clone(), shared.clone());
                std::thread::spawn(move || Session::new(stream, manners, seen, first).run());
            }
        });
        Hostile { port, seen }
    }

    fn has(&self, which: impl Fn(&(String, u8, bool, Vec<u8>)) -> bool) -> Option<()> {
        self.seen.lock().unwrap().messages.iter().any(which).then_some(())
    }

    fn events(&self) -> Vec<String> {
        let seen = self.seen.lock().unwrap();
        let events = seen.messages.iter().filter(|(topic, ..)| topic == EVENT);
        let text = |payload: &[u8]| {
            let json: serde_json::Value = serde_json::from_slice(payload).unwrap();
            json["text"].as_str().unwrap().to_string()
        };
        events.map(|(.., payload)| text(payload)).collect()
    }
}

struct Session {
    stream: TcpStream,
    manners: Manners,
    seen: Arc<Mutex<Seen>>,
    first: bool,
    aliases: HashMap<u16, String>,
    /// Packet ids of events still to acknowledge, with the reason codes.
    owed: Vec<(u16, u8)>,
    pinged: bool,
}

fn number(bytes: &[u8]) -> usize {
    usize::from(u16::from_be_bytes([bytes[0], bytes[1]]))
}

impl Session {
    fn new(stream: TcpStream, manners: Manners, seen: Arc<Mutex<Seen>>, first: bool) -> Session {
        Session {
            stream,
            manners,
            seen,
            first,
            aliases: HashMap::new(),
            owed: Vec::new(),
            pinged: false,
        }
    }

    fn send(&mut self, kind: u8, body: &[u8]) -> Option<()> {
        if self.pinged && self.manners.mute {
            return Some(());
        }
        let packet = [&[kind, u8::try_from(body.len()).unwrap()][..], body].concat();
        if !self.manners.piecemeal {
            return self.stream.write_all(&packet).ok();
        }
        packet.iter().try_for_each(|byte| self.stream.write_all(&[*byte]).ok())
    }

    fn packet(&mut self) -> Option<(u8, Vec<u8>)> {
        let (kind, body) = packets::read_packet(&mut self.stream)?;
        let mut seen = self.seen.lock().unwrap();
        seen.longest = seen.longest.max(body.len() + 5);
        Some((kind, body))
    }

    fn run(mut self) -> Option<()> {
        self.stream.set_nodelay(true).unwrap();
        loop {
            let (kind, body) = self.packet()?;
            match kind >> 4 {
                1 if self.manners.no_will && body[7] & 0x08 != 0 => {
                    self.send(0x20, &[0, 0x9B, 0])?;
                    return None;
                }
                1 if self.manners.no_will && body[7] & 0x20 != 0 => {
                    self.send(0x20, &[0, 0x9A, 0])?;
                    return None;
                }
                1 => {
                    if self.manners.slow {
                        std::thread::sleep(Duration::from_secs(6));
                    }
                    let properties = self.manners.properties.clone();
                    let body = [&[0, 0, u8::try_from(properties.len()).unwrap()][..], &properties].concat();
                    self.send(0x20, &body)?;
                }
                8 if self.manners.deaf => {}
                8 => {
                    let filters = packets::filters(&body);
                    let refused = |filter: &String| self.manners.no_wildcards && filter.contains(['+', '#']);
                    let codes: Vec<u8> = filters
                        .iter()
                        .map(|filter| if refused(filter) { 0xA2 } else { 1 })
                        .collect();
                    self.seen.lock().unwrap().filters.extend(filters);
                    self.send(0x90, &packets::subscribed(&body, &codes))?;
                }
                3 => self.publish(kind, &body)?,
                12 => {
                    self.pinged = true;
                    self.send(0xD0, &[])?;
                }
                14 => {
                    self.seen.lock().unwrap().farewells.push(body);
                    return None;
                }
                _ => {}
            }
        }
    }

    fn publish(&mut self, kind: u8, body: &[u8]) -> Option<()> {
        let (qos, retain) = (kind >> 1 & 3, kind & 1 == 1);
        let (topic, mut rest) = body[2..].split_at(number(body));
        let mut topic = String::from_utf8(topic.to_vec()).unwrap();
        let mut packet = 0;
        if qos > 0 {
            packet = number(rest) as u16;
            rest = &rest[2..];
        }
        let (mut properties, payload) = rest[1..].split_at(usize::from(rest[0]));
        while let Some((property, value)) = properties.split_first() {
            let length = match property {
                0x02 => 4,
                0x23 => {
                    let alias = number(value) as u16;
                    if topic.is_empty() {
                        topic = self.aliases[&alias].clone();
                        self.seen.lock().unwrap().by_alias += 1;
                    }
                    self.aliases.insert(alias, topic.clone());
                    2
                }
                other => panic!("unexpected property {other}"),
            };
            properties = &value[length..];
        }
        let is_event = topic == EVENT;
        self.seen
            .lock()
            .unwrap()
            .messages
            .push((topic.clone(), qos, retain, payload.to_vec()));
        if is_event
            && self.first
            && let Some(farewell) = self.manners.farewell.clone()
        {
            self.send(0xE0, &farewell);
            return None;
        }
        if qos == 0 {
            return Some(());
        }
        let in_flight = self.owed.len() + 1;
        let mut seen = self.seen.lock().unwrap();
        let refused = self
            .manners
            .refused
            .filter(|(below, _, times)| topic.starts_with(below) && seen.refusals < *times);
        seen.refusals += usize::from(refused.is_some());
        let code = refused.map_or(0, |(_, code, _)| code);
        seen.most_in_flight = seen.most_in_flight.max(in_flight);
        drop(seen);
        // An event only waits for another event: telemetry in between does not end the wait, so that no event is left over.
        if self.manners.backwards && is_event && self.owed.is_empty() {
            self.owed.push((packet, code));
            return Some(());
        }
        self.acknowledge(packet, code)?;
        if is_event {
            while let Some((packet, code)) = self.owed.pop() {
                self.acknowledge(packet, code)?;
            }
        }
        Some(())
    }

    fn acknowledge(&mut self, packet: u16, code: u8) -> Option<()> {
        let packet = packet.to_be_bytes();
        self.send(0x40, &[packet[0], packet[1], code, 0])
    }
}

/// Publishes `count` events and checks that these, the state and the status arrive.
fn serves(broker: &Hostile, gateway: &Gateway, count: usize) {
    wait_for("the status", || {
        broker.has(|(topic, .., payload)| topic == "drivegate/hall/status" && payload == b"online")
    });
    let texts: Vec<String> = (0..count).map(|n| format!("event {n}")).collect();
    for text in &texts {
        gateway.publish_event("p1", EventKind::Fault, text);
    }
    let served = || {
        let mut events = broker.events();
        events.dedup();
        events
    };
    wait_for("the events", || (served().len() >= count).then_some(()));
    assert_eq!(served(), texts);
    wait_for("the buffer to be empty", || (gateway.buffered() == 0).then_some(()));
}

#[test]
fn odd_brokers_are_served() {
    let window = |n: u16| [&[0x21][..], &n.to_be_bytes()].concat();
    let cases: [(&str, Manners); 9] = [
        ("receive maximum 1", with(window(1))),
        (
            "receive maximum 20, acknowledged backwards",
            Manners {
                properties: window(20),
                backwards: true,
                ..Manners::default()
            },
        ),
        ("QoS 0 only", with(vec![0x24, 0])),
        ("no retained messages", with(vec![0x25, 0])),
        ("topic aliases", with(vec![0x22, 0, 5])),
        (
            "no topic aliases, a keep-alive interval of its own",
            with(vec![0x22, 0, 0, 0x13, 0, 60]),
        ),
        (
            "a client id assigned by the broker",
            with(vec![0x12, 0, 3, b'x', b'y', b'z']),
        ),
        (
            "packets in single bytes",
            Manners {
                piecemeal: true,
                ..Manners::default()
            },
        ),
        (
            "the points refused",
            Manners {
                refused: Some(("drivegate/hall/drive/p1/point", 0x87, usize::MAX)),
                ..Manners::default()
            },
        ),
    ];
    for (name, manners) in cases {
        let broker = Hostile::start(manners);
        let mut options = options(broker.port);
        options.telemetry_qos = drivegate_mqtt::Qos::AtLeastOnce;
        let gateway = Gateway::start(options, plant(&["p1"]));
        serves(&broker, &gateway, 40);
        for value in 0..10 {
            gateway.read("p1", 4000 + value);
            let text = format!("{}", f64::from(4000 + value) / 100.0);
            wait_for("the new value", || {
                broker.has(|(topic, .., payload)| topic == STATE && String::from_utf8_lossy(payload).contains(&text))
            });
        }
        let seen = broker.seen.lock().unwrap();
        assert_eq!(seen.connections, 1, "{name}");
        match name {
            "receive maximum 1" => assert_eq!(seen.most_in_flight, 1),
            "QoS 0 only" => {
                assert!(seen.messages.iter().all(|(_, qos, ..)| *qos == 0));
                drop(seen);
                gateway.stop();
                wait_for("the farewell", || {
                    (!broker.seen.lock().unwrap().farewells.is_empty()).then_some(())
                });
                let seen = broker.seen.lock().unwrap();
                assert_eq!(seen.messages.last().unwrap().3, b"offline");
                continue;
            }
            "no retained messages" => assert!(seen.messages.iter().all(|(.., retain, _)| !retain)),
            "topic aliases" => assert!(seen.by_alias > 0),
            "no topic aliases, a keep-alive interval of its own" => assert_eq!(seen.by_alias, 0),
            _ => {}
        }
        drop(seen);
        gateway.stop();
    }
}

/// The gateway ends the connection to a silent broker with a message, so that the broker can distinguish this from
/// a failure.
#[test]
fn a_broker_that_falls_silent_is_told_goodbye() {
    let keep_alive = with(vec![0x13, 0, 2]);
    let broker = Hostile::start(Manners {
        mute: true,
        ..keep_alive
    });
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    wait_for("the farewell", || {
        (!broker.seen.lock().unwrap().farewells.is_empty()).then_some(())
    });
    // The code is "Disconnect with Will Message": clients of this broker must learn that the gateway is away until
    // it is back.
    assert_eq!(
        broker.seen.lock().unwrap().farewells.first().unwrap().first(),
        Some(&0x04)
    );
    wait_for("the next connection", || {
        (broker.seen.lock().unwrap().connections > 1).then_some(())
    });
    gateway.stop();
}

/// A broker that looks up its clients in a database is given ten seconds.
#[test]
fn a_broker_that_accepts_after_six_seconds_is_waited_for() {
    let broker = Hostile::start(Manners {
        slow: true,
        ..Manners::default()
    });
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    wait_for("the connection", || gateway.connected().then_some(()));
    gateway.stop();
}

#[test]
fn refused_messages_concern_their_topic() {
    for code in [0x80, 0x83, 0x87, 0x90, 0x99] {
        let broker = Hostile::start(Manners {
            refused: Some((EVENT, code, usize::MAX)),
            ..Manners::default()
        });
        let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
        serves(&broker, &gateway, 20);
        let lost = || gateway.stats.mqtt.losses().map(|(_, count)| count).sum::<u64>();
        wait_for("the loss to be counted", || (lost() == 20).then_some(()));
        assert_eq!(broker.seen.lock().unwrap().connections, 1, "{code:02X}");
        assert!(gateway.connected());
        gateway.stop();
    }
}

#[test]
fn what_is_refused_for_now_comes_later() {
    // Reason codes: quota exceeded, packet id in use.
    for code in [0x97, 0x91] {
        let broker = Hostile::start(Manners {
            refused: Some((EVENT, code, 3)),
            ..Manners::default()
        });
        let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
        wait_for("the connection", || gateway.connected().then_some(()));
        let texts: Vec<String> = (0..20).map(|n| format!("event {n}")).collect();
        for text in &texts {
            gateway.publish_event("p1", EventKind::Fault, text);
        }
        let missing = || {
            let events = broker.events();
            texts
                .iter()
                .any(|text| events.iter().filter(|event| *event == text).count() < 1)
        };
        wait_for("all events, and the three again", || {
            (broker.events().len() == 23 && !missing() && gateway.buffered() == 0).then_some(())
        });
        assert_eq!(gateway.stats.mqtt.losses().map(|(_, count)| count).sum::<u64>(), 0);
        gateway.stop();
    }
}

#[test]
fn a_status_that_is_refused_is_repeated_until_the_broker_takes_it() {
    for code in [0x97, 0x87, 0x80] {
        let broker = Hostile::start(Manners {
            refused: Some(("drivegate/hall/status", code, 2)),
            ..Manners::default()
        });
        let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
        let statuses = || {
            let seen = broker.seen.lock().unwrap();
            let of_status = seen
                .messages
                .iter()
                .filter(|(topic, ..)| topic == "drivegate/hall/status");
            of_status.map(|(.., payload)| payload.clone()).collect::<Vec<_>>()
        };
        wait_for("the third attempt", || (statuses().len() >= 3).then_some(()));
        assert_eq!(statuses(), [b"online", b"online", b"online"], "{code:02X}");
        assert_eq!(broker.seen.lock().unwrap().connections, 1);
        gateway.stop();
    }
}

#[test]
fn packets_beyond_the_limit_are_not_sent() {
    let broker = Hostile::start(with(vec![0x27, 0, 0, 1, 0]));
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    serves(&broker, &gateway, 5);
    wait_for("a point", || {
        broker.has(|(topic, ..)| topic.ends_with("point/output_frequency"))
    });
    let seen = broker.seen.lock().unwrap();
    assert!(seen.longest <= 256, "{}", seen.longest);
    let states = seen.messages.iter().filter(|(topic, ..)| topic == STATE);
    let states: Vec<serde_json::Value> = states
        .map(|(.., state)| serde_json::from_slice(state).unwrap())
        .collect();
    assert!(!states.is_empty() && states.iter().all(|state| state["omitted"].as_u64() > Some(0)));
    drop(seen);
    wait_log(broker.port, "the state of drive p1 is too large");
    gateway.stop();
}

#[test]
fn a_session_taken_over_loses_no_event() {
    // DISCONNECT with different reasons: session taken over, server shutting down, quota exceeded; and none at all.
    for farewell in [vec![0x8E, 0], vec![0x8B, 0], vec![0x97, 0], vec![0xFF; 40]] {
        let broker = Hostile::start(Manners {
            farewell: Some(farewell),
            ..Manners::default()
        });
        let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
        serves(&broker, &gateway, 20);
        assert!(broker.seen.lock().unwrap().connections > 1);
        gateway.stop();
    }
}

#[test]
fn a_connection_that_is_given_up_ends_with_a_word() {
    let broker = Hostile::start(Manners {
        deaf: true,
        ..Manners::default()
    });
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    wait_for("the gateway to give up", || {
        let seen = broker.seen.lock().unwrap();
        (!seen.farewells.is_empty()).then_some(())
    });
    // Normal, without the last will: the gateway was not online.
    let reason = broker.seen.lock().unwrap().farewells[0].first().copied().unwrap_or(0);
    assert_eq!(reason, 0x00);
    wait_for("another attempt", || {
        (broker.seen.lock().unwrap().connections > 1).then_some(())
    });
    gateway.stop();
}

#[test]
fn a_broker_that_refuses_the_last_will_gets_a_lesser_one() {
    let broker = Hostile::start(Manners {
        no_will: true,
        properties: vec![0x24, 0, 0x25, 0],
        ..Manners::default()
    });
    let gateway = Gateway::start(options(broker.port), plant(&["p1"]));
    serves(&broker, &gateway, 10);
    assert_eq!(broker.seen.lock().unwrap().connections, 3, "refused twice");
    wait_log(broker.port, "no QoS 1");
    gateway.stop();
}

#[test]
fn without_wildcards_the_gateway_subscribes_drive_by_drive() {
    // The broker announces that it has no wildcards, or refuses the subscription.
    for (properties, no_wildcards) in [(vec![0x28, 0], false), (vec![], true)] {
        let broker = Hostile::start(Manners {
            properties,
            no_wildcards,
            ..Manners::default()
        });
        let gateway = Gateway::start(options(broker.port), plant(&["p1", "p2"]));
        serves(&broker, &gateway, 5);
        let seen = broker.seen.lock().unwrap();
        for filter in ["p1/set", "p2/set", "p1/set/run", "p2/set/speed_reference"] {
            let filter = format!("drivegate/hall/drive/{filter}");
            assert!(seen.filters.contains(&filter), "{filter} is not in {:?}", seen.filters);
        }
        assert_eq!(seen.filters.iter().any(|filter| filter.contains('+')), no_wildcards);
        assert_eq!(seen.connections, 1);
        drop(seen);
        gateway.stop();
    }
}

#[test]
fn two_gateways_with_one_client_id_are_told_apart_from_a_broken_broker() {
    // Mosquitto 2.0 closes the connection of the first client without stating a reason.
    let broker = Broker::with("allow_anonymous true\n");
    let first = Gateway::start(options(broker.port), plant(&["p1"]));
    let second = Gateway::start(options(broker.port), plant(&["p1"]));
    wait_log(broker.port, "uses the client id `drivegate-hall`");
    first.stop();
    second.stop();
}
