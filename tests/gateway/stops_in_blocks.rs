//! A stop within a larger write: whatever else the write covers, the motor stops, and the client learns that the
//! rest was refused. Over every interface, with `[authority]` and without. pymodbus, mosquitto, Eclipse Tahu's
//! encoder, curl and bacpypes3.

use std::io::{Read as _, Write as _};
use std::net::{TcpStream, UdpSocket};
use std::time::Duration;

use drivegate_proto::{Protocol, ascii, rtu};
use serde_json::{Value as Json, json};

use crate::support::process::{PATIENCE, Running, drivegate, free_port, until};
use crate::support::site::{HTTP, MODBUS_TCP, MQTT, Site, USERS, curl, nx_in_ascii};
use crate::support::tools::{feed, python, root, run_well, tool};

const AUTHORITY: &str = r#"
[authority]
mode = "exclusive"
lease = "30s"
[[authority.principal]]
name = "plc"
rank = "automation"
modbus_tcp = ["127.0.0.1/32"]
[[authority.principal]]
name = "alice"
rank = "operator"
http_user = "alice"
[[authority.principal]]
name = "cloud"
rank = "remote"
mqtt = "cloud"
[[authority.principal]]
name = "host"
rank = "automation"
sparkplug = true
[[authority.principal]]
name = "building"
rank = "automation"
bacnet = ["127.0.0.16/28"]
"#;

/// The motor runs by one coil among others, none of which can be written.
const COILS: &str = r#"
name = "coils"
protocols = ["modbus-rtu"]
range = [{ table = "coil", first = 4, last = 8, read = 5, write = 5 }]
[control]
at = "coil 5"
run = { bit = 0 }
stop = { bit = 0, is = 0 }
[[point]]
name = "running"
at = "coil 8"
class = "fast"
"#;

/// A drive that is commanded by registers, one by coils, and the first in ASCII; each on a bus with a slot.
struct Plant {
    site: Site,
    slots: Vec<u16>,
    bacnet: u16,
    has_principals: bool,
    _others: Vec<Running>,
}

const DRIVES: [(&str, &str, &str); 3] = [
    ("pump", "vacon-nx", "protocol = \"modbus-rtu\""),
    ("coil", "coils", "protocol = \"modbus-rtu\""),
    ("fan", "nx-ascii", "protocol = \"modbus-ascii\"\nformat = \"7N2\""),
];

fn plant(authority: &str) -> Plant {
    let slots: Vec<u16> = DRIVES.iter().map(|_| free_port()).collect();
    let bacnet = UdpSocket::bind("0.0.0.0:0").unwrap().local_addr().unwrap().port();
    let bus = |(at, slot): (usize, &u16)| {
        let (name, profile, protocol) = DRIVES[at];
        let address = at + 1;
        format!(
            "[[bus]]\nname = \"{name}-line\"\nport = \"{name}-line\"\nbaud = 38400\nresponse_timeout = \"2s\"\n{protocol}\n\
             [[bus.slot]]\nlisten = \"127.0.0.1:{slot}\"\naccess = \"write\"\n\
             [[bus.drive]]\nname = \"{name}\"\naddress = {address}\nprofile = \"{profile}\"\naccess = \"control\"\n"
        )
    };
    let buses: String = slots.iter().enumerate().map(bus).collect();
    let own = format!(
        "[gateway]\nname = \"test\"\nsocket = \"own.sock\"\nstate_dir = \"state\"\nprofile_dirs = [\".\"]\n{buses}\
         [bacnet]\nlisten = \"127.0.0.10:{bacnet}\"\ncommands = true\nwrite = [\"127.0.0.16/28\"]\n"
    );
    let sparkplug = "[mqtt.sparkplug]\ngroup = \"plant\"\nalias = false\n";
    let site = Site::of(&[&own, MODBUS_TCP, MQTT, sparkplug, HTTP, USERS, authority]);
    site.write("coils.toml", COILS);
    site.write("nx-ascii.toml", &nx_in_ascii("nx-ascii"));
    site.add_user("alice");
    let simulated = |(at, (name, profile, _)): (usize, &(&str, &str, &str))| {
        let (link, file, address) = (
            site.path(&format!("{name}-line")),
            site.path(&format!("{profile}.toml")),
            (at + 1).to_string(),
        );
        let profile = if *profile == "vacon-nx" {
            "vacon-nx"
        } else {
            file.as_str()
        };
        let running = Running::drivegate(&[
            "simulate",
            "--link",
            &link,
            "--profile",
            profile,
            "--addresses",
            &address,
            "--baud",
            "38400",
        ]);
        running.until_printed("Ctrl-C ends");
        running
    };
    let mut others: Vec<Running> = DRIVES.iter().enumerate().map(simulated).collect();
    others.push(site.broker());
    others.push(site.run_ready());
    site.until_connected(true);
    Plant {
        site,
        slots,
        bacnet,
        has_principals: !authority.is_empty(),
        _others: others,
    }
}

/// A write to a drive, and the answer that its client reads.
enum Way {
    /// Function 16 by pymodbus: unit, first register, values, exception.
    Registers(u8, u16, Vec<u16>, u8),
    /// Function 15: unit, first coil, states, exception.
    Coils(u8, u16, Vec<bool>, u8),
    /// A message to a topic below the gateway's, and the code of the rest.
    Mqtt(&'static str, &'static str, &'static str),
    /// Names and values of Sparkplug metrics.
    Sparkplug(&'static [(&'static str, f64)]),
    /// The body, and the status of the reply.
    Http(&'static str, u16),
    Socket(&'static str, u16),
    /// Arguments of `drivegate write`, and a word that the error must contain.
    CommandLine(&'static [&'static str], &'static str),
    /// Object, value and priority of writes, and class and code of the error.
    Bacnet(&'static [(&'static str, f64)], [u8; 2]),
    /// A PDU that is sent to the slot of the bus with this index, and the exception.
    Slot(usize, Vec<u8>, u8),
}

/// The stop word with this number of other words before and after it.
fn around(before: usize, stop: u16, after: usize) -> Vec<u16> {
    [vec![77; before], vec![stop], vec![77; after]].concat()
}

/// Function 16 or 15 as a PDU.
fn block(function: u8, start: u16, count: u16, bytes: &[u8]) -> Vec<u8> {
    let (start, count) = (start.to_be_bytes(), count.to_be_bytes());
    [&[function], &start[..], &count, &[bytes.len() as u8], bytes].concat()
}

fn registers(start: u16, values: &[u16]) -> Vec<u8> {
    let words: Vec<u8> = values.iter().flat_map(|value| value.to_be_bytes()).collect();
    block(16, start, values.len() as u16, &words)
}

fn coils(start: u16, states: &[bool]) -> Vec<u8> {
    let mut bytes = vec![0; states.len().div_ceil(8)];
    for (at, _) in states.iter().enumerate().filter(|(_, on)| **on) {
        bytes[at / 8] |= 1 << (at % 8);
    }
    block(15, start, states.len() as u16, &bytes)
}

fn ways() -> Vec<(&'static str, Way)> {
    use Way::{Bacnet, Coils, CommandLine, Http, Mqtt, Registers, Slot, Socket, Sparkplug};
    let states = |before: usize, after: usize| [vec![true; before], vec![false], vec![true; after]].concat();
    let mut ways = Vec::new();
    // A block of the common model across the register of the hold with any value, across missing registers, and
    // across bad values.
    for hold in [0, 1, 2, 3, 0xFFFF] {
        ways.push(("pump", Registers(1, 0x8100, vec![0, 0, 0, 0, hold], 2)));
    }
    ways.push(("pump", Registers(1, 0x80C0, around(64, 0, 40), 2)));
    ways.push(("pump", Registers(1, 0x80FF, around(1, 0, 0), 2)));
    ways.push(("pump", Registers(1, 0x8100, around(0, 2, 122), 2)));
    ways.push(("pump", Registers(1, 0x8100, vec![0, 0x8000], 3)));
    ways.push(("pump", Registers(1, 0x8100, vec![0, 20_000, 0xFFFF], 3)));
    ways.push(("coil", Registers(2, 0x8100, vec![0, 0, 0, 0, 0], 2)));
    ways.push(("fan", Registers(3, 0x80F0, around(16, 0, 9), 2)));
    // Registers and coils of the drives themselves.
    ways.push(("pump", Registers(1, 1990, around(10, 0, 0), 2)));
    ways.push(("pump", Registers(1, 2000, around(0, 0, 100), 2)));
    ways.push(("pump", Registers(1, 1950, around(50, 0, 70), 2)));
    ways.push(("pump", Registers(1, 2000, vec![0, 0, 20_000], 3)));
    ways.push(("fan", Registers(3, 1999, around(1, 0, 3), 2)));
    ways.push(("coil", Coils(2, 3, states(2, 4), 2)));
    ways.push(("coil", Coils(2, 0, states(5, 0), 2)));
    ways.push(("coil", Coils(2, 5, states(0, 200), 2)));
    // Registers by which all drives are stopped.
    ways.push(("pump", Registers(255, 0x0100, vec![1, 7], 2)));
    ways.push(("pump", Registers(255, 0x00FE, vec![7, 0, 1, 0], 2)));
    // Writes of BACnet objects.
    let (unknown, bad) = ("not_writable", "bad_value");
    ways.push((
        "pump",
        Mqtt("set", r#"{"nonsense": 5, "run": false, "more": true}"#, unknown),
    ));
    ways.push((
        "pump",
        Mqtt("as/cloud/set", r#"{"run": false, "ready": true}"#, unknown),
    ));
    ways.push((
        "pump",
        Mqtt("set", r#"{"speed_reference": "x", "run": false, "expires_ms": 0}"#, bad),
    ));
    ways.push((
        "pump",
        Mqtt("as/cloud/set", r#"{"speed_reference": NaN, "run": false}"#, bad),
    ));
    ways.push((
        "pump",
        Mqtt("set", r#"{"run": false, "speed_reference": 1e999, "id": 7}"#, bad),
    ));
    ways.push(("pump", Mqtt("set", r#"{"run": false, "speed_reference": 900}"#, bad)));
    ways.push((
        "pump",
        Sparkplug(&[("nonsense", 1.0), ("run", 0.0), ("speed_reference", 900.0)]),
    ));
    ways.push((
        "pump",
        Http(r#"{"nonsense": 5, "run": false, "speed_reference": 900}"#, 422),
    ));
    ways.push(("pump", Http(r#"{"speed_reference": Infinity, "run": 0}"#, 422)));
    ways.push(("pump", Socket(r#"{"nonsense": 5, "run": false, "wait": 3}"#, 422)));
    ways.push((
        "pump",
        CommandLine(&["nonsense=5", "run=false", "speed_reference=x"], "nonsense"),
    ));
    let many: &[(&str, f64)] = &[
        ("analog-value,99", 5.0),
        ("binary-value,1", 0.0),
        ("analog-value,1", 900.0),
    ];
    ways.push(("pump", Bacnet(many, [1, 31])));
    // Writes through tool slots.
    ways.push(("pump", Slot(0, registers(1990, &around(10, 0, 5)), 2)));
    ways.push(("pump", Slot(0, registers(2000, &[0, 0, 20_000]), 3)));
    ways.push(("coil", Slot(1, coils(3, &states(2, 4)), 2)));
    ways.push(("fan", Slot(2, registers(1999, &around(1, 0, 3)), 2)));
    ways.push(("fan", Slot(2, registers(2000, &[0, 0, 20_000]), 3)));
    ways
}

impl Plant {
    fn start(&self, drive: &str) {
        let path = format!("drives/{drive}");
        until("a start", || {
            self.site
                .curl("alice", &format!("{path}/hold"), &["-d", r#"{"action": "take"}"#]);
            let (status, _) = self
                .site
                .curl("alice", &format!("{path}/commands"), &["-d", r#"{"run": true}"#]);
            (status == 200).then_some(())
        });
        self.site.until_point(drive, "running", true);
    }

    /// Answer to the client.
    fn ask(&self, drive: &str, way: &Way) -> String {
        match way {
            Way::Registers(unit, start, values, _) => {
                let script = root().join("tests/peers/pymodbus_once.py").display().to_string();
                let numbers = [
                    self.site.modbus.to_string(),
                    "127.0.0.1".to_string(),
                    unit.to_string(),
                    start.to_string(),
                ];
                let arguments = numbers.into_iter().chain(values.iter().map(u16::to_string));
                let arguments: Vec<String> = [script].into_iter().chain(arguments).collect();
                run_well(&python(), &arguments.iter().map(String::as_str).collect::<Vec<_>>())
                    .trim()
                    .to_string()
            }
            Way::Coils(unit, start, states, _) => {
                let pdu = coils(*start, states);
                let head = [0, 1, 0, 0, 0, pdu.len() as u8 + 1, *unit];
                let answer = exchange(self.site.modbus, &[&head[..], &pdu].concat(), 9);
                format!("exception {}", answer[8])
            }
            Way::Mqtt(topic, payload, _) => {
                // Without principals the topic names no client.
                let topic = if self.has_principals {
                    *topic
                } else {
                    topic.trim_start_matches("as/cloud/")
                };
                let answer = self.site.ask(&format!("{drive}/{topic}"), payload);
                format!("{} {}", answer["result"], answer["rest"])
            }
            Way::Sparkplug(metrics) => self.dcmd(drive, metrics),
            Way::Http(body, _) => {
                let (status, answer) = self
                    .site
                    .curl("alice", &format!("drives/{drive}/commands"), &["-d", body]);
                format!("{status} {}", answer["result"])
            }
            Way::Socket(body, _) => {
                let (socket, url) = (
                    self.site.path("own.sock"),
                    format!("http://gateway/api/v1/drives/{drive}/commands"),
                );
                let (status, answer) = curl(&["--unix-socket", &socket, "-d", body, &url]);
                format!("{status} {}", answer["result"])
            }
            Way::CommandLine(values, word) => {
                let config = self.site.config();
                let arguments = [&["write", "--config", &config, drive][..], values].concat();
                let output = drivegate(&arguments).output().unwrap();
                let errors = String::from_utf8_lossy(&output.stderr).into_owned();
                if errors.contains(word) && !output.status.success() {
                    (*word).to_string()
                } else {
                    format!("{output:?}")
                }
            }
            Way::Bacnet(writes, _) => self.bacpypes(writes),
            Way::Slot(at, pdu, _) => {
                let (address, protocol) = (
                    *at as u8 + 1,
                    if *at == 2 {
                        Protocol::ModbusAscii
                    } else {
                        Protocol::ModbusRtu
                    },
                );
                let mut request = Vec::new();
                protocol.encode_frame(address, pdu, &mut request);
                let most = if *at == 2 { 11 } else { 5 };
                let answer = exchange(self.slots[*at], &request, most);
                let opened = match protocol {
                    Protocol::ModbusAscii => ascii::open_frame(&answer).map(|(_, pdu)| pdu),
                    _ => rtu::open_frame(&answer).map(|(_, pdu)| pdu.to_vec()),
                };
                match opened.as_deref() {
                    Some([function, code]) if *function == pdu[0] | 0x80 => format!("exception {code}"),
                    other => format!("{other:02X?} {answer:02X?}"),
                }
            }
        }
    }

    /// The audit's record about the rest of a host's command.
    fn dcmd(&self, drive: &str, metrics: &[(&str, f64)]) -> String {
        let metric = |(name, value): &(&str, f64)| match *name {
            "run" => json!({"name": name, "type": "Boolean", "value": *value != 0.0}),
            _ => json!({"name": name, "type": "Double", "value": value}),
        };
        let payload = json!({"timestamp": 1, "metrics": metrics.iter().map(metric).collect::<Vec<_>>()});
        let script = root().join("tests/peers/sparkplug.js").display().to_string();
        let modules = format!("NODE_PATH={}", root().join(".tools/node/node_modules").display());
        let node = tool("node").display().to_string();
        let hex = run_well(
            &tool("env"),
            &[&modules, &node, &script, "encode", &payload.to_string()],
        );
        let hex = hex
            .trim()
            .as_bytes()
            .chunks(2)
            .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap());
        std::fs::write(self.site.file("payload"), hex.collect::<Vec<u8>>()).unwrap();
        let own = |record: &Json| record["source"] == "sparkplug" && record["result"] == "not_writable";
        let count = || self.site.audit().into_iter().filter(own).count();
        let before = count();
        let topic = format!("spBv1.0/plant/DCMD/test/{drive}");
        self.site.publish(&["-t", &topic, "-f", &self.site.path("payload")]);
        until("the refusal of the rest", || (count() > before).then_some(()));
        "not_writable".to_string()
    }

    fn bacpypes(&self, writes: &[(&str, f64)]) -> String {
        let script = root().join("tests/peers/bacnet_client.py").display().to_string();
        let own = format!(
            "127.0.0.20/8:{}",
            UdpSocket::bind("0.0.0.0:0").unwrap().local_addr().unwrap().port()
        );
        let gateway = format!("127.0.0.10:{}", self.bacnet);
        let write = |(object, value): &(&str, f64)| {
            if object.starts_with("binary") {
                json!([object, "present-value", *value != 0.0, 8])
            } else {
                json!([object, "present-value", value, 8])
            }
        };
        let mut order = vec![json!("several"), json!(1)];
        order.extend(writes.iter().map(write));
        let output = feed(
            &python(),
            &[&script, &own, &gateway, "1001"],
            &format!("{}\n", Json::from(order)),
        );
        String::from_utf8(output.stdout).unwrap().trim().to_string()
    }
}

/// Reads at most this many bytes of the answer.
fn exchange(port: u16, request: &[u8], most: usize) -> Vec<u8> {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream
        .set_read_timeout(Some(PATIENCE.min(Duration::from_secs(5))))
        .unwrap();
    stream.write_all(request).unwrap();
    let mut answer = vec![0; most];
    let mut got = 0;
    while got < most {
        match stream.read(&mut answer[got..]) {
            Ok(count) if count > 0 => got += count,
            _ => break,
        }
    }
    answer.truncate(got);
    answer
}

impl Way {
    fn expected(&self) -> String {
        match self {
            Way::Registers(.., code) | Way::Coils(.., code) | Way::Slot(.., code) => format!("exception {code}"),
            Way::Mqtt(.., code) => format!("\"stop_only\" \"{code}\""),
            Way::Sparkplug(_) => "not_writable".to_string(),
            Way::CommandLine(_, word) => (*word).to_string(),
            Way::Http(_, status) | Way::Socket(_, status) => format!("{status} \"stop_only\""),
            Way::Bacnet(_, [class, code]) => format!("{{\"error\": [{class}, {code}]}}"),
        }
    }
}

fn stops_by_every_way(authority: &str) {
    let plant = plant(authority);
    let mut wrong = Vec::new();
    for (at, (drive, way)) in ways().into_iter().enumerate() {
        plant.start(drive);
        let told = plant.ask(drive, &way);
        if told != way.expected() {
            wrong.push(format!("{at}: {told} instead of {}", way.expected()));
        }
        // The word is with the drive when the client is answered.
        let stands = (0..100).any(|_| {
            std::thread::sleep(Duration::from_millis(50));
            plant.site.point(drive, "running") == false
        });
        if !stands {
            wrong.push(format!("{at}: the motor runs on"));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_stop_is_carried_out_whatever_else_its_write_covers() {
    stops_by_every_way("");
}

#[test]
fn so_it_is_where_clients_hold_drives() {
    stops_by_every_way(AUTHORITY);
}
