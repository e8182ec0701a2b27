//! The broker of the demo with clients that were written elsewhere: mosquitto's, paho, and the library of the gateway.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use drivegate_sim::broker::Broker;
use rumqttc::mqttbytes::QoS;
use rumqttc::{
    AsyncClient, ConnectionError, DisconnectReasonCode, Event, EventLoop, MqttOptions, Packet, PublishProperties,
    StateError,
};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

use crate::support::mqtt::{Subscriber, client_of};
use crate::support::process::PATIENCE;
use crate::support::tools::{python, run_well};

/// Longest wait for an event that must happen. Usually it happens at once, so this is not a measurement.
const DEADLINE: Duration = PATIENCE;
const VERSIONS: [&str; 2] = ["mqttv311", "mqttv5"];

/// A demo broker on a separate port.
struct DemoBroker {
    broker: Broker,
    cancel: CancellationToken,
    runtime: Runtime,
}

impl DemoBroker {
    fn new() -> DemoBroker {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let cancel = CancellationToken::new();
        let any_port: SocketAddr = "127.0.0.1:0".parse().unwrap();
        let broker = runtime.block_on(Broker::start(any_port, cancel.clone())).unwrap();
        DemoBroker {
            broker,
            cancel,
            runtime,
        }
    }

    fn port(&self) -> u16 {
        self.broker.local_addr().port()
    }

    fn publish(&self, version: &str, arguments: &[&str]) {
        let published = client_of(version, "mosquitto_pub", self.port())
            .args(arguments)
            .status();
        assert!(published.unwrap().success(), "{arguments:?}");
    }

    /// Starts `mosquitto_sub` and waits until its subscription is active.
    fn subscribe(&self, version: &str, arguments: &[&str]) -> Reader {
        self.subscribe_as(version, "%t q%q r%r %p", arguments)
    }

    fn subscribe_as(&self, version: &str, format: &str, arguments: &[&str]) -> Reader {
        // The retained message of the first topic arrives as soon as all topics are subscribed to.
        self.publish(version, &["-t", "$ready", "-m", "ready", "-r", "-q", "1"]);
        let reader = self.reader(
            "mosquitto_sub",
            version,
            format,
            &[&["-t", "$ready"], arguments].concat(),
        );
        assert!(reader.lines.recv_timeout(DEADLINE).unwrap().ends_with("ready"));
        reader
    }

    fn reader(&self, program: &str, version: &str, format: &str, arguments: &[&str]) -> Reader {
        let mut command = client_of(version, program, self.port());
        let (sender, lines) = channel();
        let client = Subscriber::start(command.args(["-F", format]).args(arguments), move |line| {
            let _ = sender.send(line);
        });
        Reader { _client: client, lines }
    }

    fn connect(&self) -> Raw {
        let stream = TcpStream::connect(self.broker.local_addr()).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        Raw(stream)
    }

    /// A client of the library, which does nothing except in `next`.
    fn library_client(&self, id: &str) -> (AsyncClient, EventLoop) {
        let options = MqttOptions::new(id, ("127.0.0.1", self.port()));
        AsyncClient::builder(options).capacity(10).build()
    }
}

/// A client program whose lines are read.
struct Reader {
    _client: Subscriber,
    lines: Receiver<String>,
}

impl Reader {
    /// The next message that was received.
    fn line(&self) -> String {
        let line = || self.lines.recv_timeout(DEADLINE).expect("the client prints a line");
        std::iter::repeat_with(line)
            .find(|line| !line.ends_with("ready"))
            .unwrap()
    }
}

/// A connection that sends exactly the bytes of a test.
struct Raw(TcpStream);

impl Raw {
    fn send(&mut self, bytes: &[u8]) {
        self.0.write_all(bytes).unwrap();
    }

    fn expect(&mut self, bytes: &[u8]) {
        let mut answer = vec![0; bytes.len()];
        self.0.read_exact(&mut answer).unwrap();
        assert_eq!(answer, bytes);
    }

    /// Reads until the connection is closed, which must happen.
    fn until_closed(&mut self) -> Vec<u8> {
        let mut rest = Vec::new();
        match self.0.read_to_end(&mut rest) {
            Ok(_) => rest,
            Err(error) if error.kind() == ErrorKind::ConnectionReset => rest,
            Err(error) => panic!("not closed: {error}"),
        }
    }

    /// Connects with 3.1.1 and that keep alive, s.
    fn connect(&mut self, id: u8, keep_alive: u8) {
        self.send(&connect(4, id, keep_alive));
        self.expect(&[0x20, 2, 0, 0]);
    }

    /// Subscribes to the topic `t`.
    fn subscribe(&mut self) {
        self.send(&[0x82, 6, 0, 1, 0, 1, b't', 0]);
        self.expect(&[0x90, 3, 0, 1, 0]);
    }
}

/// A CONNECT of that protocol level, with a client id of one byte.
fn connect(level: u8, id: u8, keep_alive: u8) -> Vec<u8> {
    let properties: &[u8] = if level == 5 { &[0] } else { &[] };
    let length = 13 + properties.len() as u8;
    let head = [0x10, length, 0, 4, b'M', b'Q', b'T', b'T', level, 2, 0, keep_alive];
    [&head, properties, &[0, 1, id]].concat()
}

#[test]
fn messages_reach_subscribers_of_both_versions() {
    let rig = DemoBroker::new();
    // Two filters match and the message arrives once; a wildcard does not match topics that begin with $.
    let readers = VERSIONS.map(|version| rig.subscribe(version, &["-t", "a/+/c", "-t", "#", "-q", "2"]));
    for version in VERSIONS {
        for qos in ["0", "1"] {
            rig.publish(version, &["-t", "$a/b/c", "-m", "x"]);
            rig.publish(version, &["-t", "a/ü/c", "-m", version, "-q", qos]);
            for reader in &readers {
                assert_eq!(reader.line(), format!("a/ü/c q{qos} r0 {version}"));
            }
        }
    }
}

#[test]
fn retained_messages_are_set_replaced_and_deleted() {
    for version in VERSIONS {
        let rig = DemoBroker::new();
        rig.publish(version, &["-t", "s/1", "-m", "old", "-r", "-q", "1"]);
        rig.publish(version, &["-t", "s/1", "-m", "new", "-r", "-q", "1"]);
        rig.publish(version, &["-t", "s/2", "-m", "gone", "-r", "-q", "1"]);
        rig.publish(version, &["-t", "s/2", "-n", "-r"]);
        let reader = rig.subscribe(version, &["-t", "s/#", "-q", "1"]);
        assert_eq!(reader.line(), "s/1 q1 r1 new");
        rig.publish(version, &["-t", "s/1", "-m", "live", "-r"]);
        assert_eq!(reader.line(), "s/1 q0 r0 live");
        rig.publish(version, &["-t", "s/1", "-n", "-r"]);
        assert_eq!(reader.line(), "s/1 q0 r0 ");
    }
}

#[test]
fn the_will_of_a_killed_client_is_published_and_retained() {
    let rig = DemoBroker::new();
    for version in VERSIONS {
        let watcher = rig.subscribe(version, &["-t", version]);
        let will = ["--will-payload", "offline", "--will-retain", "--will-qos", "1"];
        let arguments = [&["-t", "own", "--will-topic", version], &will[..]].concat();
        drop(rig.subscribe(version, &arguments));
        assert_eq!(watcher.line(), format!("{version} q0 r0 offline"));
        let late = rig.subscribe(version, &["-t", version, "-q", "1"]);
        assert_eq!(late.line(), format!("{version} q1 r1 offline"));
    }
}

#[test]
fn v5_properties_pass_through_and_a_request_gets_its_response() {
    let rig = DemoBroker::new();
    let format = "%C|%P|%E|%D|%R|%F|%p";
    let new = rig.subscribe_as("mqttv5", format, &["-t", "request"]);
    let old = rig.subscribe("mqttv311", &["-t", "request"]);
    let mut arguments = vec!["-t", "request", "-e", "answer", "-m", "x"];
    for property in [
        &["content-type", "text/plain"][..],
        &["message-expiry-interval", "60"],
        &["correlation-data", "c"],
        &["payload-format-indicator", "1"],
        &["user-property", "key", "value"],
    ] {
        arguments.extend(["-D", "publish"].iter().chain(property));
    }
    let client = rig.reader("mosquitto_rr", "mqttv5", format, &arguments);
    assert_eq!(new.line(), "text/plain|key:value|60|c|answer|1|x");
    assert_eq!(old.line(), "request q0 r0 x");
    rig.publish(
        "mqttv5",
        &["-t", "answer", "-m", "y", "-D", "publish", "correlation-data", "c"],
    );
    assert_eq!(client.line(), "|||c|||y");
}

/// Connects, subscribes, publishes at QoS 0 and 1 and also retained messages, and disconnects. The will of a second
/// client is published.
const PAHO: &str = r#"
import queue, sys
import paho.mqtt.client as mqtt
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

version = getattr(mqtt, sys.argv[2])
seen, subscribed = queue.Queue(), queue.Queue()

def client(name):
    c = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, name, protocol=version)
    c.on_message = lambda _c, _u, m: seen.put((m.topic, m.payload, m.qos, m.retain, m.properties))
    c.on_subscribe = lambda _c, _u, _m, codes, _p: subscribed.put([code.value for code in codes])
    return c

one, two = client("one"), client("")
two.will_set("status", b"gone", qos=1)
for c in (one, two):
    c.connect("127.0.0.1", int(sys.argv[1]))
    c.loop_start()
one.subscribe([("t/#", 2), ("status", 1)])
assert subscribed.get(timeout=30) == [1, 1]
properties = None
if version == mqtt.MQTTv5:
    properties = Properties(PacketTypes.PUBLISH)
    properties.CorrelationData = b"\x00\xff"
for qos in (0, 1):
    two.publish("t/x", f"m{qos}", qos=qos, properties=properties).wait_for_publish(30)
    topic, payload, got, retain, back = seen.get(timeout=30)
    assert (topic, payload, got, retain) == ("t/x", b"m%d" % qos, qos, False)
    assert properties is None or back.CorrelationData == b"\x00\xff"
two.publish("kept", "k", qos=1, retain=True).wait_for_publish(30)
one.subscribe("kept", 1)
assert seen.get(timeout=30)[:4] == ("kept", b"k", 1, True)
two._sock_close()
assert seen.get(timeout=30)[:3] == ("status", b"gone", 1)
one.disconnect()
"#;

#[test]
fn paho_works_in_both_versions() {
    let rig = DemoBroker::new();
    for version in ["MQTTv311", "MQTTv5"] {
        run_well(&python(), &["-c", PAHO, &rig.port().to_string(), version]);
    }
}

/// The next packet that arrives, or the error that ends the connection.
async fn next(events: &mut EventLoop) -> Result<Packet, ConnectionError> {
    let packet = async {
        loop {
            if let Event::Incoming(packet) = events.poll().await? {
                return Ok(packet);
            }
        }
    };
    tokio::time::timeout(DEADLINE, packet)
        .await
        .expect("a packet comes in or the connection ends")
}

#[test]
fn the_library_of_the_gateway_publishes_and_subscribes_and_is_replaced_by_its_twin() {
    let rig = DemoBroker::new();
    rig.runtime.block_on(async {
        let (client, mut events) = rig.library_client("gateway");
        assert!(matches!(next(&mut events).await, Ok(Packet::ConnAck(_))));
        client.subscribe("gw/#", QoS::AtLeastOnce).await.unwrap();
        assert!(matches!(next(&mut events).await, Ok(Packet::SubAck(_))));
        let properties = PublishProperties {
            response_topic: Some(String::from("gw/result")),
            correlation_data: Some(b"\x01\x00\xFF".to_vec().into()),
            ..PublishProperties::default()
        };
        let published = client.publish_with_properties("gw/set", QoS::AtLeastOnce, false, "50", properties.clone());
        published.await.unwrap();
        let (mut acknowledged, mut received) = (false, false);
        while !(acknowledged && received) {
            match next(&mut events).await.unwrap() {
                Packet::PubAck(_) => acknowledged = true,
                Packet::Publish(publish) => {
                    received = true;
                    assert_eq!((&publish.topic[..], &publish.payload[..]), (&b"gw/set"[..], &b"50"[..]));
                    assert_eq!(publish.qos, QoS::AtLeastOnce);
                    assert_eq!(publish.properties, Some(properties.clone()));
                }
                other => panic!("{other:?}"),
            }
        }
        let (_twin, mut others) = rig.library_client("gateway");
        next(&mut others).await.unwrap();
        let Err(ConnectionError::MqttState(StateError::ServerDisconnect { reason_code, .. })) = next(&mut events).await
        else {
            panic!("the first gets a DISCONNECT")
        };
        assert_eq!(reason_code, DisconnectReasonCode::SessionTakenOver);
    });
}

#[test]
fn stop_cancel_and_drop_close_everything() {
    for how in ["stop", "cancel", "drop"] {
        let DemoBroker {
            broker,
            cancel,
            runtime,
        } = DemoBroker::new();
        let address = broker.local_addr();
        let mut clients: Vec<Raw> = (0..20).map(|_| Raw(TcpStream::connect(address).unwrap())).collect();
        for (client, id) in clients.iter_mut().zip(b'a'..).skip(10) {
            client.connect(id, 0);
        }
        match how {
            "stop" => runtime.block_on(broker.stop()),
            "cancel" => cancel.cancel(),
            _ => drop(broker),
        }
        clients.iter_mut().for_each(|client| drop(client.until_closed()));
        let begin = Instant::now();
        while runtime
            .block_on(Broker::start(address, CancellationToken::new()))
            .is_err()
        {
            assert!(begin.elapsed() < DEADLINE, "the port is not free after {how}");
        }
    }
}

#[test]
fn malformed_packets_close_their_own_connection_only() {
    let rig = DemoBroker::new();
    let mut witness = rig.connect();
    witness.connect(b'w', 0);
    witness.subscribe();
    let connected = |level: u8, packet: &[u8]| [&connect(level, b'x', 0), packet].concat();
    let bad = [
        (b"GET / HTTP/1.1\r\n\r\n".to_vec(), &[][..]),
        (vec![0x00, 0x00], &[]),
        (vec![0x10, 0xFF, 0xFF, 0xFF, 0xFF], &[]),
        (connect(6, b'x', 0), &[0x20, 2, 0, 1]),
        (connected(4, &connect(4, b'x', 0)), &[]),
        (connected(4, &[0x30, 0xFF, 0xFF, 0xFF, 0x7F]), &[]),
        (connected(4, &[0x34, 5, 0, 1, b't', 0, 1]), &[]),
        (connected(4, &[0x82, 2, 0, 1]), &[]),
        (connected(5, &[0x34, 6, 0, 1, b't', 0, 1, 0]), &[0xE0, 2, 0x9B, 0]),
        (connected(5, &[0x30, 4, 0, 1, b'+', 0]), &[0xE0, 2, 0x90, 0]),
    ];
    for (bytes, last) in bad {
        let mut client = rig.connect();
        // The broker may have closed the connection before all is sent.
        let _ = client.0.write_all(&bytes);
        let answer = client.until_closed();
        assert!(answer.ends_with(last), "{bytes:02X?}: {answer:02X?}");
    }
    rig.publish("mqttv5", &["-t", "t", "-m", "ok"]);
    witness.expect(&[0x30, 5, 0, 1, b't', b'o', b'k']);
}

#[test]
fn a_silent_client_is_closed_after_one_and_a_half_keep_alives() {
    let rig = DemoBroker::new();
    let mut client = rig.connect();
    let begin = Instant::now();
    client.connect(b's', 1);
    client.until_closed();
    assert!(
        begin.elapsed() >= Duration::from_millis(1500),
        "closed early, after {:?}",
        begin.elapsed()
    );
}

#[test]
fn connections_are_bounded_and_places_come_free() {
    let rig = DemoBroker::new();
    let mut clients: Vec<Raw> = (0..128).map(|_| rig.connect()).collect();
    clients[127].connect(b'c', 0);
    rig.connect().until_closed();
    drop(clients.pop());
    let begin = Instant::now();
    let served = || {
        let mut client = rig.connect();
        client.0.write_all(&connect(4, b'x', 0)).is_ok() && client.0.read_exact(&mut [0; 4]).is_ok()
    };
    while !served() {
        assert!(begin.elapsed() < DEADLINE, "no place comes free");
    }
}

#[test]
fn a_client_that_does_not_read_stops_nobody_else() {
    let rig = DemoBroker::new();
    let [mut stuck, mut reader, mut publisher] = [b's', b'r', b'p'].map(|id| {
        let mut client = rig.connect();
        client.connect(id, 0);
        client
    });
    stuck.subscribe();
    reader.subscribe();
    // 200 messages of 200 kB: above the bound of a queue and all that sockets hold.
    let mut publish = vec![0x30, 0xC3, 0x9A, 0x0C, 0, 1, b't'];
    publish.resize(7 + 200_000, 7);
    for _ in 0..200 {
        publisher.send(&publish);
        reader.expect(&publish);
    }
    // The stuck client lost its connection after the bytes sent until then.
    assert!(stuck.until_closed().len() < 200 * publish.len());
}
