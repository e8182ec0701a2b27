//! Rights that a reload removes: they are lost for requests in progress over any interface, and no waiting order
//! starts a motor.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use drivegate_http::basic_authorization;
use drivegate_proto::rtu;
use drivegate_sim::wire::SimulatedBus;

use crate::support::mqtt::client;
use crate::support::process::{PATIENCE, Running, api, free_port, get, local, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, PASSWORD, Site, USERS, controlled, functions};

/// A connection of any kind.
trait Stream: Read + Write {}

impl<S: Read + Write> Stream for S {}

/// A request whose first bytes were sent, and its remaining bytes.
struct Begun {
    stream: Box<dyn Stream>,
    rest: Vec<u8>,
}

impl Begun {
    /// Sends the rest; returns the reply, or nothing if the connection is closed.
    fn finish(mut self) -> Vec<u8> {
        // The connection may be closed already, so an error is ignored.
        let _ = self.stream.write_all(&self.rest);
        let mut reply = vec![0; 4096];
        let count = self.stream.read(&mut reply).unwrap_or(0);
        reply.truncate(count);
        reply
    }
}

/// The head of a start over HTTP; the gateway has judged it, and waits for the body.
fn start_over_http(mut stream: impl Stream + 'static, path: &str, body: &str) -> Begun {
    let login = basic_authorization(&format!("alice:{PASSWORD}"));
    let head = format!(
        "POST {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: {login}\r\nContent-Length: {}\r\nExpect: \
         100-continue\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes()).unwrap();
    let mut reply = [0; 25];
    stream.read_exact(&mut reply).unwrap();
    assert_eq!(&reply, b"HTTP/1.1 100 Continue\r\n\r\n");
    Begun {
        stream: Box::new(stream),
        rest: body.as_bytes().to_vec(),
    }
}

fn tcp(port: u16) -> TcpStream {
    let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

const COMMANDS: &str = "/api/v1/drives/pump-1/commands";
/// A start that is still valid after a login and a reload: an order has the time of its first byte.
const START: &str = "{\"run\": true, \"expires_ms\": 60000}";

fn http(site: &Site) -> Begun {
    start_over_http(tcp(site.http), COMMANDS, START)
}

/// Other requests that change something, each with its body.
const OTHERS: [(&str, &str); 5] = [
    ("/api/v1/stop", "{}"),
    ("/api/v1/drives/pump-1/hold", "{\"action\": \"take\"}"),
    ("/api/v1/drives/pump-1/params/reading", "{}"),
    ("/api/v1/drives/pump-1/params/restore", "{\"action\": \"resume\"}"),
    ("/api/v1/drills", "{\"drive\": \"pump-1\"}"),
];

fn socket(site: &Site) -> Begun {
    let stream = local(site.file("socket"));
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    start_over_http(stream, COMMANDS, START)
}

/// Sends half a frame that would write 1 to 0x8100.
fn modbus(site: &Site) -> Begun {
    let mut stream = tcp(site.modbus);
    stream.write_all(&[0, 1, 0, 0, 0, 6, 1]).unwrap();
    // Waits until the first part has arrived.
    std::thread::sleep(Duration::from_millis(50));
    Begun {
        stream: Box::new(stream),
        rest: vec![6, 0x81, 0, 0, 1],
    }
}

/// The expected answer to a request.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Gets {
    /// The answer has this status.
    Status(&'static str),
    /// Exception 01.
    Exception,
    /// The connection is closed without an answer.
    Nothing,
}

impl Gets {
    fn of(reply: &[u8]) -> Gets {
        match reply {
            [] => Gets::Nothing,
            [.., 0x86, 1] => Gets::Exception,
            _ => {
                let text = String::from_utf8_lossy(reply);
                let known = ["200", "401", "403", "404", "405"];
                let status = known.into_iter().find(|status| text[9..].starts_with(status));
                Gets::Status(status.unwrap_or_else(|| panic!("{text}")))
            }
        }
    }
}

type Way = fn(&Site) -> Begun;

struct Rights {
    site: Site,
    line: SimulatedBus,
    gateway: Running,
}

impl Rights {
    fn new() -> Rights {
        let site = Site::new();
        let line1 = LINE1.replace(
            "[gateway]\n",
            &format!("[gateway]\nsocket = \"{}\"\n", site.path("socket")),
        );
        site.configure(&[&line1, &controlled("pump-1", 1, ""), MODBUS_TCP, HTTP, USERS]);
        site.add_user("alice");
        site.add_user("bob");
        let line = site.line(&[1]);
        let gateway = site.run_ready();
        until("its first values", || {
            (api(site.http, "pump-1")["state"] == "ready").then_some(())
        });
        Rights { site, line, gateway }
    }

    /// Number of requests on the line that write.
    fn writes(&self) -> usize {
        functions(&self.line)
            .into_iter()
            .filter(|function| [5, 6, 15, 16].contains(function))
            .count()
    }
}

#[test]
fn a_right_that_a_reload_took_away_serves_no_request_that_had_begun() {
    let rights = Rights::new();
    let config = std::fs::read_to_string(rights.site.config()).unwrap();
    let users = std::fs::read_to_string(rights.site.file("users")).unwrap();
    let bob = users.lines().find(|line| line.starts_with("bob")).unwrap();
    let others = format!("{bob}\n{}\n", bob.replacen("bob", "alice", 1));
    let only_bob = format!("{bob}\n");
    let same = |text: &str| text.to_string();
    let no_writes = |text: &str| text.replace("write = [\"127.0.0.1/32\"]", "write = []");
    let no_client = |text: &str| text.replace("write = [", "allow = [\"127.0.0.9/32\"]\nwrite = [");
    let no_modbus = |text: &str| {
        text.replace(
            &text[text.find("[modbus_tcp]").unwrap()..text.find("[http]").unwrap()],
            "",
        )
    };
    let no_commands = |text: &str| text.replace("commands = true\nusers_file = \"users\"", "commands = false");
    let no_http = |text: &str| text[..text.find("[http]").unwrap()].to_string();
    let no_socket = |text: &str| {
        let line = text.lines().find(|line| line.starts_with("socket = ")).unwrap();
        text.replace(line, "socket = \"\"")
    };
    let alice = users.lines().find(|line| line.starts_with("alice")).unwrap();
    let only_alice = format!("{alice}\n");
    type Change<'c> = &'c dyn Fn(&str) -> String;
    let (refused, gone) = (Gets::Status("403"), Gets::Nothing);
    let table: [(&str, Way, Change<'_>, &str, Gets); 12] = [
        ("a user is removed", http, &same, &only_bob, refused),
        ("its password is changed", http, &same, &others, refused),
        ("commands = false", http, &no_commands, &users, refused),
        ("no [http]", http, &no_http, &users, gone),
        ("not in `write`", modbus, &no_writes, &users, Gets::Exception),
        ("not in `allow`", modbus, &no_client, &users, gone),
        ("no [modbus_tcp]", modbus, &no_modbus, &users, gone),
        ("no socket", socket, &no_socket, &users, refused),
        // Changes that leave the right unaffected.
        ("another user is removed", http, &same, &only_alice, Gets::Status("200")),
        ("no Modbus TCP for HTTP", http, &no_writes, &users, Gets::Status("200")),
        (
            "no users for Modbus TCP",
            modbus,
            &no_commands,
            &users,
            Gets::Status("modbus"),
        ),
        (
            "no users for the socket",
            socket,
            &no_commands,
            &users,
            Gets::Status("200"),
        ),
    ];
    for (what, way, change, users_then, expected) in table {
        let before = rights.writes();
        let begun = way(&rights.site);
        rights.site.write("users", users_then);
        rights.site.write("drivegate.conf", &change(&config));
        rights.gateway.reload();
        let reply = begun.finish();
        if expected == Gets::Status("modbus") {
            assert_eq!(reply, [0, 1, 0, 0, 0, 6, 1, 6, 0x81, 0, 0, 1], "{what}");
        } else {
            assert_eq!(
                Gets::of(&reply),
                expected,
                "{what}: {}",
                String::from_utf8_lossy(&reply)
            );
        }
        std::thread::sleep(Duration::from_millis(200));
        let started = matches!(expected, Gets::Status("200" | "modbus"));
        assert_eq!(rights.writes() > before, started, "{what}");
        rights.site.write("users", &users);
        rights.site.write("drivegate.conf", &config);
        rights.gateway.reload();
        if started {
            write_registers(rights.site.modbus, 1, 0x8100, &[0]);
            rights.site.until_state("pump-1", "ready");
        }
    }
    for (path, body) in OTHERS {
        let begun = start_over_http(tcp(rights.site.http), path, body);
        rights.site.write("users", &only_bob);
        rights.gateway.reload();
        let reply = begun.finish();
        assert_eq!(Gets::of(&reply), refused, "{path}");
        rights.site.write("users", &users);
        rights.gateway.reload();
    }
    let audit = rights.site.audit();
    let told = audit.iter().filter(|record| {
        let text = record["text"].as_str().unwrap_or_default();
        record["result"] == "not_allowed" && text.contains("a reload removed its right")
    });
    let refused: u64 = told.filter_map(|record| record["count"].as_u64()).sum();
    assert_eq!(refused, 4, "three over HTTP, one by the socket: {audit:?}");
}

/// A reload that is refused has no effect on the rights of clients.
#[test]
fn a_refused_reload_takes_no_right_away() {
    let rights = Rights::new();
    for way in [http as Way, modbus, socket] {
        let begun = way(&rights.site);
        let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let config = rights.site.change(
            &format!("127.0.0.1:{}", rights.site.http),
            &taken.local_addr().unwrap().to_string(),
        );
        rights.site.change("write = [\"127.0.0.1/32\"]", "write = []");
        rights
            .site
            .change("commands = true\nusers_file = \"users\"", "commands = false");
        let refused = || rights.gateway.output().matches("reload rejected").count();
        let before = refused();
        rights.gateway.signal("HUP");
        until("the refusal", || (refused() > before).then_some(()));
        rights.site.write("drivegate.conf", &config);
        begun.finish();
        rights.site.until_state("pump-1", "running");
        write_registers(rights.site.modbus, 1, 0x8100, &[0]);
        rights.site.until_state("pump-1", "ready");
    }
}

/// A tool writes, and its start has to wait for its share of the line; meanwhile a reload removes the right of the slot.
#[test]
fn a_start_of_a_tool_that_waits_is_not_sent_without_its_right() {
    let port = free_port();
    let line = LINE1.replace("38400", "4800");
    let slot = format!("[[bus.slot]]\nlisten = \"127.0.0.1:{port}\"\naccess = \"write\"\n");
    let changes = [
        ("access = \"write\"", "access = \"read\""),
        (
            "access = \"write\"\n",
            "access = \"write\"\nallow = [\"127.0.0.9/32\"]\n",
        ),
        (slot.as_str(), ""),
    ];
    let site = Site::of(&[&line, &controlled("pump-1", 1, ""), &slot, MODBUS_TCP, HTTP]);
    let _drives = site.simulate(&["--addresses", "1", "--baud", "4800"]);
    let gateway = site.run_ready();
    until("its first values", || {
        (api(site.http, "pump-1")["state"] == "ready").then_some(())
    });
    let frame = |register: u16, value: u16| {
        let mut pdu = vec![6];
        pdu.extend(register.to_be_bytes());
        pdu.extend(value.to_be_bytes());
        let mut frame = Vec::new();
        rtu::encode_frame(1, &pdu, &mut frame);
        frame
    };
    for (from, to) in changes {
        // On a busy machine a reload may take longer than the start waits.
        until("a reload in time", || {
            let mut tool = until("the slot", || TcpStream::connect(("127.0.0.1", port)).ok());
            // The slot gives no answer that is older than a second, as after a pause of the machine.
            tool.set_read_timeout(Some(Duration::from_secs(3))).unwrap();
            until("an answer", || {
                tool.write_all(&frame(2002, 1000)).unwrap();
                tool.read_exact(&mut [0; 8]).ok()
            });
            tool.write_all(&frame(2000, 1)).unwrap();
            let asked = Instant::now();
            std::thread::sleep(Duration::from_millis(30));
            let before = site.change(from, to);
            gateway.reload();
            let in_time = asked.elapsed() < Duration::from_millis(400);
            std::thread::sleep(Duration::from_secs(1));
            let runs = site.point("pump-1", "run");
            site.write("drivegate.conf", &before);
            gateway.reload();
            write_registers(site.modbus, 1, 0x8100, &[0]);
            site.until_state("pump-1", "ready");
            assert!(!in_time || runs == false, "the motor started: {to}");
            in_time.then_some(())
        });
    }
}

/// The broker delivers a message while the client is ending because a reload disabled its `commands`.
#[test]
fn a_message_on_its_way_starts_nothing_once_commands_are_off() {
    let site = Site::of(&[LINE1, &controlled("pump-1", 1, ""), MQTT, HTTP]);
    let line = site.line(&[1]);
    let broker = site.broker();
    let gateway = site.run_ready();
    site.until_connected(true);
    until("its first values", || {
        (api(site.http, "pump-1")["state"] == "ready").then_some(())
    });
    for round in 1..=5_u64 {
        broker.signal("STOP");
        let topic = "drivegate/test/drive/pump-1/set";
        let mut publisher = client("mosquitto_pub", site.mqtt)
            .args(["-t", topic, "-m", "{\"run\": true}"])
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(100));
        let before = site.change("commands = true", "commands = false");
        let http = format!("127.0.0.1:{}", site.http);
        site.change(&http, &format!("127.0.0.1:{}", free_port()));
        gateway.signal("HUP");
        // The former address closes once the reload has ended the right.
        until("its rights have ended", || TcpStream::connect(&http).err());
        // The client has half a second for an orderly end, during which it is still subscribed.
        std::thread::sleep(Duration::from_millis(60 * (round - 1)));
        broker.signal("CONT");
        let _ = publisher.wait();
        until("the reload", || {
            (gateway.output().matches("configuration reloaded").count() as u64 == 2 * round - 1).then_some(())
        });
        std::thread::sleep(Duration::from_millis(300));
        assert!(!functions(&line).contains(&6), "round {round}: {}", gateway.output());
        site.write("drivegate.conf", &before);
        gateway.signal("HUP");
        until("the reload", || {
            (gateway.output().matches("configuration reloaded").count() as u64 == 2 * round).then_some(())
        });
        site.until_connected(true);
    }
    assert_eq!(get(site.http, "/readyz").unwrap().0, 200);
}
