//! The demo broker with clients that were written elsewhere: mosquitto's, and the library of the
//! gateway. They have to be installed; a test that cannot find them fails and says so.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use drivegate::sim::broker::Broker;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{DisconnectReasonCode, Packet, PublishProperties};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions, StateError};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

/// Longest wait for something that has to happen. It is met at once, so this is no timing.
const DEADLINE: Duration = Duration::from_secs(30);

const VERSIONS: [&str; 2] = ["mqttv311", "mqttv5"];

/// A broker on a port of its own.
struct Bench {
    broker: Broker,
    cancel: CancellationToken,
    runtime: Runtime,
}

impl Bench {
    fn new() -> Bench {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let cancel = CancellationToken::new();
        let any_port: SocketAddr = "127.0.0.1:0".parse().unwrap();
        let broker = runtime.block_on(Broker::start(any_port, cancel.clone())).unwrap();
        Bench {
            broker,
            cancel,
            runtime,
        }
    }

    fn port(&self) -> String {
        self.broker.local_addr().port().to_string()
    }

    /// A mosquitto client, with its version and the address of the broker.
    fn command(&self, program: &str, version: &str) -> Command {
        let mut command = Command::new(program);
        command.args(["-V", version, "-h", "127.0.0.1", "-p", &self.port()]);
        command
    }

    fn publish(&self, version: &str, arguments: &[&str]) {
        let output = self.command("mosquitto_pub", version).args(arguments).output();
        let output = output.unwrap_or_else(|error| not_installed("mosquitto_pub", &error));
        assert!(
            output.status.success(),
            "mosquitto_pub {arguments:?}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
    }

    /// Starts `mosquitto_sub` and waits until it is subscribed to `topic`. No other subscriber of the
    /// topic may go away in the meantime.
    fn subscribe(&self, version: &str, topic: &str, arguments: &[&str]) -> Reader {
        let before = self.broker.subscribers(topic);
        let reader = Reader::start(self.command("mosquitto_sub", version).args(arguments));
        eventually("mosquitto_sub is subscribed", || {
            self.broker.subscribers(topic) == before + 1
        });
        reader
    }

    fn connect(&self) -> Raw {
        Raw(TcpStream::connect(self.broker.local_addr()).unwrap())
    }

    /// A client of the library with everything in its hands: nothing happens but by `next`.
    fn library_client(&self, id: &str) -> (AsyncClient, EventLoop) {
        let mut options = MqttOptions::new(id, "127.0.0.1", self.broker.local_addr().port());
        options.set_keep_alive(Duration::from_secs(5));
        AsyncClient::new(options, 10)
    }
}

fn not_installed(program: &str, error: &std::io::Error) -> ! {
    panic!("cannot run {program}: {error}; these tests need it, install Debian's package mosquitto-clients")
}

/// Waits until `condition` holds.
fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !condition() {
        assert!(begin.elapsed() < DEADLINE, "still not after {DEADLINE:?}: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// A client program whose lines are read. It is killed (SIGKILL) when dropped.
struct Reader {
    child: Child,
    lines: Receiver<String>,
}

impl Reader {
    fn start(command: &mut Command) -> Reader {
        let program = command.get_program().to_string_lossy().into_owned();
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn();
        let mut child = child.unwrap_or_else(|error| not_installed(&program, &error));
        let output = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in output.lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Reader { child, lines }
    }

    /// The next line of its output.
    fn line(&self) -> String {
        self.lines.recv_timeout(DEADLINE).expect("the client prints a line")
    }

    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A connection that says exactly what a test wants.
struct Raw(TcpStream);

impl Raw {
    fn send(&mut self, bytes: &[u8]) {
        self.0.write_all(bytes).unwrap();
    }

    /// Sends, whether or not the broker still listens.
    fn try_send(&mut self, bytes: &[u8]) {
        let _ = self.0.write_all(bytes);
    }

    fn expect(&mut self, bytes: &[u8]) {
        self.0.set_read_timeout(Some(DEADLINE)).unwrap();
        let mut answer = vec![0; bytes.len()];
        self.0.read_exact(&mut answer).unwrap();
        assert_eq!(answer, bytes);
    }

    /// Reads to the end, which has to come.
    fn until_closed(&mut self) -> Vec<u8> {
        self.0.set_read_timeout(Some(DEADLINE)).unwrap();
        let mut rest = Vec::new();
        match self.0.read_to_end(&mut rest) {
            Ok(_) => rest,
            Err(error) if error.kind() == ErrorKind::ConnectionReset => rest,
            Err(error) => panic!("not closed: {error}"),
        }
    }

    /// Connects with 3.1.1, a clean session and `keep_alive` seconds.
    fn connect(&mut self, id: &str, keep_alive: u8) {
        let mut packet = vec![
            0x10,
            12 + id.len() as u8,
            0,
            4,
            b'M',
            b'Q',
            b'T',
            b'T',
            4,
            2,
            0,
            keep_alive,
        ];
        packet.extend_from_slice(&[0, id.len() as u8]);
        packet.extend_from_slice(id.as_bytes());
        self.send(&packet);
        self.expect(&[0x20, 2, 0, 0]);
    }
}

/// What `mosquitto_sub` prints for a message: topic, QoS, retain, payload.
const FORMAT: [&str; 2] = ["-F", "%t q%q r%r %p"];

#[test]
fn messages_reach_subscribers_of_both_versions() {
    let bench = Bench::new();
    let readers =
        VERSIONS.map(|version| bench.subscribe(version, "a/b/c", &["-t", "a/+/c", "-q", "1", FORMAT[0], FORMAT[1]]));
    for version in VERSIONS {
        for (qos, arrives) in [("0", "0"), ("1", "1"), ("2", "1")] {
            bench.publish(version, &["-t", "a/not/this", "-m", "x"]);
            bench.publish(version, &["-t", "$a/b/c", "-m", "x"]);
            bench.publish(version, &["-t", "a/b/c", "-m", version, "-q", qos]);
            for reader in &readers {
                assert_eq!(reader.line(), format!("a/b/c q{arrives} r0 {version}"));
            }
        }
    }
}

#[test]
fn wildcards_leave_dollar_topics_alone() {
    for version in VERSIONS {
        let bench = Bench::new();
        let all = bench.subscribe(version, "x", &["-t", "#", "-t", "+/x", FORMAT[0], FORMAT[1]]);
        let dollar = bench.subscribe(version, "$own/x", &["-t", "$own/#", FORMAT[0], FORMAT[1]]);
        bench.publish(version, &["-t", "$own/x", "-m", "1"]);
        bench.publish(version, &["-t", "ü/x", "-m", "2"]);
        assert_eq!(dollar.line(), "$own/x q0 r0 1");
        assert_eq!(all.line(), "ü/x q0 r0 2", "and only once, though two filters match");
        bench.publish(version, &["-t", "end", "-m", "3"]);
        assert_eq!(all.line(), "end q0 r0 3");
    }
}

#[test]
fn retained_messages_are_set_replaced_and_deleted() {
    for version in VERSIONS {
        let bench = Bench::new();
        bench.publish(version, &["-t", "s/1", "-m", "old", "-r"]);
        bench.publish(version, &["-t", "s/1", "-m", "new", "-r", "-q", "1"]);
        bench.publish(version, &["-t", "s/2", "-m", "gone", "-r"]);
        bench.publish(version, &["-t", "s/2", "-n", "-r"]);
        let reader = bench.subscribe(version, "s/3", &["-t", "s/#", "-q", "1", FORMAT[0], FORMAT[1]]);
        assert_eq!(reader.line(), "s/1 q1 r1 new");
        bench.publish(version, &["-t", "s/1", "-m", "live", "-r"]);
        assert_eq!(reader.line(), "s/1 q0 r0 live");
        bench.publish(version, &["-t", "s/1", "-n", "-r"]);
        assert_eq!(reader.line(), "s/1 q0 r0 ");
    }
}

#[test]
fn the_will_of_a_killed_client_is_published_and_retained() {
    let bench = Bench::new();
    for (version, status) in VERSIONS.into_iter().zip(["status/1", "status/2"]) {
        let watcher = bench.subscribe(version, status, &["-t", status, FORMAT[0], FORMAT[1]]);
        let will = [
            "--will-topic",
            status,
            "--will-payload",
            "offline",
            "--will-retain",
            "--will-qos",
            "1",
        ];
        let mut client = bench.subscribe(version, "own", &[["-t", "own"].as_slice(), &will].concat());
        bench.publish(version, &["-t", status, "-m", "online", "-r"]);
        assert_eq!(watcher.line(), format!("{status} q0 r0 online"));
        client.kill();
        assert_eq!(watcher.line(), format!("{status} q0 r0 offline"));
        let late = bench.subscribe(version, status, &["-t", status, "-q", "1", FORMAT[0], FORMAT[1]]);
        assert_eq!(late.line(), format!("{status} q1 r1 offline"));
    }
}

#[test]
fn a_request_gets_its_response_by_topic_and_correlation() {
    let bench = Bench::new();
    let server = bench.subscribe("mqttv5", "request", &["-t", "request", "-F", "%R|%D|%p"]);
    let mut request = bench.command("mosquitto_rr", "mqttv5");
    request.args([
        "-t",
        "request",
        "-e",
        "answers/7",
        "-m",
        "question",
        "-D",
        "publish",
        "correlation-data",
        "c-42",
    ]);
    let client = Reader::start(request.args(["-F", "%D|%p"]));
    assert_eq!(server.line(), "answers/7|c-42|question");
    bench.publish(
        "mqttv5",
        &[
            "-t",
            "answers/7",
            "-m",
            "answer",
            "-D",
            "publish",
            "correlation-data",
            "c-42",
        ],
    );
    assert_eq!(client.line(), "c-42|answer");
}

#[test]
fn v5_properties_pass_through() {
    let bench = Bench::new();
    let format = "%C|%P|%E|%D|%R|%F|%p";
    let new = bench.subscribe("mqttv5", "p", &["-t", "p", "-F", format]);
    let old = bench.subscribe("mqttv311", "p", &["-t", "p", FORMAT[0], FORMAT[1]]);
    let properties = [
        ["content-type", "text/plain"],
        ["message-expiry-interval", "60"],
        ["correlation-data", "c"],
        ["response-topic", "r"],
        ["payload-format-indicator", "1"],
        ["topic-alias", "5"],
    ];
    let mut arguments = vec!["-t", "p", "-m", "x", "-D", "publish", "user-property", "key", "value"];
    for property in &properties {
        arguments.extend(["-D", "publish"].iter().chain(property));
    }
    bench.publish("mqttv5", &arguments);
    assert_eq!(new.line(), "text/plain|key:value|60|c|r|1|x");
    assert_eq!(old.line(), "p q0 r0 x");
    bench.publish("mqttv311", &["-t", "p", "-m", "plain"]);
    assert_eq!(new.line(), "||||||plain");
}

#[test]
fn a_session_keeps_qos_1_for_a_client_that_is_away() {
    let bench = Bench::new();
    for (version, expiry) in [("mqttv311", &[][..]), ("mqttv5", &["-x", "60"])] {
        let arguments = [
            &["-t", version, "-i", version, "-c", "-q", "1", FORMAT[0], FORMAT[1]],
            expiry,
        ]
        .concat();
        let mut reader = bench.subscribe(version, version, &arguments);
        bench.publish(version, &["-t", version, "-m", "1", "-q", "1"]);
        assert_eq!(reader.line(), format!("{version} q1 r0 1"));
        reader.kill();
        eventually("the broker saw it go", || bench.broker.clients() == 0);
        bench.publish(version, &["-t", version, "-m", "zero", "-q", "0"]);
        bench.publish(version, &["-t", version, "-m", "2", "-q", "1"]);
        bench.publish(version, &["-t", version, "-m", "3", "-q", "1"]);
        let reader = bench.subscribe(version, version, &arguments);
        // The first may come again: its acknowledgement may have died with the client.
        let mut line = reader.line();
        if line.ends_with(" 1") {
            line = reader.line();
        }
        assert_eq!(line, format!("{version} q1 r0 2"));
        assert_eq!(reader.line(), format!("{version} q1 r0 3"));
        drop(reader);
        eventually("the broker saw it go", || bench.broker.clients() == 0);
    }
}

/// The next packet that comes in, answers to pings aside, or the error that ends the connection.
async fn next(events: &mut EventLoop) -> Result<Packet, ConnectionError> {
    let packet = async {
        loop {
            match events.poll().await? {
                Event::Outgoing(_) | Event::Incoming(Packet::PingResp(_)) => {}
                Event::Incoming(packet) => return Ok(packet),
            }
        }
    };
    tokio::time::timeout(DEADLINE, packet)
        .await
        .expect("a packet comes in or the connection ends")
}

#[test]
fn the_library_of_the_gateway_publishes_and_subscribes_at_qos_1() {
    let bench = Bench::new();
    bench.runtime.block_on(async {
        let (client, mut events) = bench.library_client("gateway");
        let Packet::ConnAck(ack) = next(&mut events).await.unwrap() else {
            panic!("no CONNACK")
        };
        assert!(!ack.session_present);
        client.subscribe("gw/#", QoS::ExactlyOnce).await.unwrap();
        let Packet::SubAck(_) = next(&mut events).await.unwrap() else {
            panic!("no SUBACK")
        };
        let properties = PublishProperties {
            response_topic: Some(String::from("gw/result")),
            correlation_data: Some(b"\x01\x00\xFF".to_vec().into()),
            ..PublishProperties::default()
        };
        client
            .publish_with_properties("gw/set", QoS::AtLeastOnce, false, "50", properties.clone())
            .await
            .unwrap();
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
        client.unsubscribe("gw/#").await.unwrap();
        let Packet::UnsubAck(_) = next(&mut events).await.unwrap() else {
            panic!("no UNSUBACK")
        };
        client.disconnect().await.unwrap();
        while next(&mut events).await.is_ok() {}
    });
    eventually("the client is gone", || bench.broker.clients() == 0);
}

#[test]
fn a_second_client_with_the_same_id_takes_over() {
    let bench = Bench::new();
    bench.runtime.block_on(async {
        let (_first, mut events) = bench.library_client("twin");
        next(&mut events).await.unwrap();
        let (_second, mut others) = bench.library_client("twin");
        next(&mut others).await.unwrap();
        let Err(ConnectionError::MqttState(StateError::ServerDisconnect { reason_code, .. })) = next(&mut events).await
        else {
            panic!("the first is told")
        };
        assert_eq!(reason_code, DisconnectReasonCode::SessionTakenOver);
        assert_eq!(bench.broker.clients(), 1);
    });
}

#[test]
fn cut_connections_come_back_when_the_broker_accepts_again() {
    let bench = Bench::new();
    let watcher = bench.subscribe(
        "mqttv5",
        "status",
        &["-t", "status", "-i", "w", "-c", "-x", "60", "-q", "1"],
    );
    bench.runtime.block_on(async {
        let mut options = MqttOptions::new("gateway", "127.0.0.1", bench.broker.local_addr().port());
        let will = rumqttc::v5::mqttbytes::v5::LastWill::new("status", "offline", QoS::AtLeastOnce, true, None);
        options.set_last_will(will);
        let (_client, mut events) = AsyncClient::new(options, 10);
        next(&mut events).await.unwrap();
        bench.broker.set_accepting(false);
        bench.broker.drop_connections();
        assert!(next(&mut events).await.is_err(), "cut");
        assert!(next(&mut events).await.is_err(), "not taken");
        eventually("all are gone", || bench.broker.clients() == 0);
        bench.broker.set_accepting(true);
        let Ok(Packet::ConnAck(_)) = next(&mut events).await else {
            panic!("taken again")
        };
    });
    // mosquitto_sub comes back by itself, and its session kept the will of the gateway.
    assert_eq!(watcher.line(), "offline");
}

#[test]
fn the_older_client_of_the_library_works_too() {
    let bench = Bench::new();
    bench.runtime.block_on(async {
        let options = rumqttc::MqttOptions::new("old", "127.0.0.1", bench.broker.local_addr().port());
        let (client, mut events) = rumqttc::AsyncClient::new(options, 10);
        client.subscribe("t", rumqttc::QoS::ExactlyOnce).await.unwrap();
        client
            .publish("t", rumqttc::QoS::ExactlyOnce, false, "x")
            .await
            .unwrap();
        let (mut completed, mut received) = (false, false);
        while !(completed && received) {
            let event = tokio::time::timeout(DEADLINE, events.poll())
                .await
                .expect("something happens")
                .unwrap();
            match event {
                rumqttc::Event::Incoming(rumqttc::Packet::PubComp(_)) => completed = true,
                rumqttc::Event::Incoming(rumqttc::Packet::Publish(publish)) => {
                    received = true;
                    assert_eq!((publish.topic.as_str(), publish.qos), ("t", rumqttc::QoS::AtLeastOnce));
                }
                _ => {}
            }
        }
    });
}

/// Stops a broker with 20 connections, half of them silent.
#[test]
fn stop_and_cancel_close_everything() {
    for by_token in [false, true] {
        let Bench {
            broker,
            cancel,
            runtime,
        } = Bench::new();
        let address = broker.local_addr();
        let mut clients: Vec<Raw> = (0..20).map(|_| Raw(TcpStream::connect(address).unwrap())).collect();
        for (number, client) in clients.iter_mut().enumerate().skip(10) {
            client.connect(&format!("c{number}"), 0);
        }
        if by_token {
            cancel.cancel();
        } else {
            runtime.block_on(broker.stop());
        }
        for client in &mut clients {
            client.until_closed();
        }
        eventually("the port is free again", || {
            runtime
                .block_on(Broker::start(address, CancellationToken::new()))
                .is_ok()
        });
    }
}

#[test]
fn a_dropped_broker_stops() {
    let Bench { broker, runtime, .. } = Bench::new();
    let mut client = Raw(TcpStream::connect(broker.local_addr()).unwrap());
    client.connect("c", 0);
    drop(broker);
    client.until_closed();
    drop(runtime);
}

#[test]
fn malformed_packets_close_their_own_connection_only() {
    let bench = Bench::new();
    let mut witness = bench.connect();
    witness.connect("witness", 0);
    witness.send(&[0x82, 6, 0, 1, 0, 1, b't', 0]);
    witness.expect(&[0x90, 3, 0, 1, 0]);

    let connect = [0x10, 13, 0, 4, b'M', b'Q', b'T', b'T', 4, 2, 0, 0, 0, 1, b'x'];
    let bad: [&[u8]; 12] = [
        b"GET / HTTP/1.1\r\n\r\n",
        &[0x00],
        &[0x10, 0x00],
        &[0x30, 3, 0, 1, b't'],
        &[0x10, 0xFF, 0xFF, 0xFF, 0xFF],
        &[0x10, 12, 0, 4, b'M', b'Q', b'T', b'T', 4, 2, 0, 0, 0, 9],
        &[&connect[..], &connect[..]].concat(),
        &[&connect[..], &[0x30, 0xFF, 0xFF, 0xFF, 0x7F]].concat(),
        &[&connect[..], &[0x36, 5, 0, 1, b't', 0, 1]].concat(),
        &[&connect[..], &[0x30, 4, 0, 1, 0xFF, 0]].concat(),
        &[&connect[..], &[0x82, 2, 0, 1]].concat(),
        &[&connect[..], &[0xF0, 0]].concat(),
    ];
    for bytes in bad {
        let mut client = bench.connect();
        client.try_send(bytes);
        client.until_closed();
    }
    // One of an unknown level is told, one that names no fault of its own gets a reason.
    let mut future = bench.connect();
    future.send(&[0x10, 13, 0, 4, b'M', b'Q', b'T', b'T', 6, 2, 0, 0, 0, 1, b'x']);
    assert_eq!(future.until_closed(), [0x20, 2, 0, 1]);
    let mut new = bench.connect();
    new.send(&[0x10, 14, 0, 4, b'M', b'Q', b'T', b'T', 5, 2, 0, 0, 0, 0, 1, b'x']);
    new.send(&[0x30, 4, 0, 1, b'+', 0]);
    assert!(
        new.until_closed()
            .ends_with(&[0xE0, 2, DisconnectReasonCode::TopicNameInvalid as u8, 0])
    );

    bench.publish("mqttv5", &["-t", "t", "-m", "ok"]);
    witness.expect(&[0x30, 5, 0, 1, b't', b'o', b'k']);
    eventually("the witness is the only one left", || bench.broker.clients() == 1);
}

#[test]
fn a_silent_client_is_closed_after_one_and_a_half_keep_alives() {
    let bench = Bench::new();
    let mut client = bench.connect();
    let begin = Instant::now();
    client.connect("silent", 1);
    client.until_closed();
    assert!(
        begin.elapsed() >= Duration::from_millis(1500),
        "closed early, after {:?}",
        begin.elapsed()
    );
}

#[test]
fn connections_are_bounded_and_places_come_free() {
    let bench = Bench::new();
    let mut clients: Vec<Raw> = (0..128).map(|_| bench.connect()).collect();
    for (number, client) in clients.iter_mut().enumerate() {
        client.connect(&number.to_string(), 0);
    }
    let mut one_more = bench.connect();
    one_more.until_closed();
    drop(clients.pop());
    eventually("a place is free", || {
        let mut client = bench.connect();
        client.try_send(&[0x10, 13, 0, 4, b'M', b'Q', b'T', b'T', 4, 2, 0, 0, 0, 1, b'x']);
        client.0.set_read_timeout(Some(DEADLINE)).unwrap();
        client.0.read_exact(&mut [0; 4]).is_ok()
    });
}

#[test]
fn a_client_that_does_not_read_stops_nobody_else() {
    let bench = Bench::new();
    let subscribe = [0x82, 6, 0, 1, 0, 1, b't', 0];
    let mut stuck = bench.connect();
    stuck.connect("stuck", 0);
    stuck.send(&subscribe);
    let mut reader = bench.connect();
    reader.connect("reader", 0);
    reader.send(&subscribe);
    eventually("both are subscribed", || bench.broker.subscribers("t") == 2);
    reader.expect(&[0x90, 3, 0, 1, 0]);

    // 300 messages of 200 kB: above the bound of a queue and all that sockets hold.
    let mut publish = vec![0x30, 0xC3, 0x9A, 0x0C, 0, 1, b't'];
    publish.resize(7 + 200_000, 7);
    let mut publisher = bench.connect();
    publisher.connect("publisher", 0);
    for _ in 0..300 {
        publisher.send(&publish);
        reader.expect(&publish);
    }
    drop(stuck);
}
