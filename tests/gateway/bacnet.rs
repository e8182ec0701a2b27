//! BACnet/IP tested from outside: bacpypes3 and node-bacnet, two independent implementations, against the real
//! gateway with simulated drives; tshark decodes the traffic.

mod layouts;
mod rights;

use std::io::{Read as _, Write as _};
use std::net::{TcpStream, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use drivegate_model::drive::profile::Profiles;
use drivegate_proto::Protocol;
use serde_json::{Value as Json, json};

use crate::support::process::{PATIENCE, Running, api, free_port, get, mbpoll_write, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, controlled, drive};
use crate::support::tools::{python, root, run, tool};

/// A port that no UDP socket of this machine has.
pub(super) fn free_udp_port() -> u16 {
    UdpSocket::bind("0.0.0.0:0").unwrap().local_addr().unwrap().port()
}

/// A gateway with BACnet/IP, at 127.0.0.10.
struct Plant {
    site: Site,
    gateway: Running,
    drives: Running,
    port: u16,
}

/// `parts` are the buses and drives, `keys` further lines of `[bacnet]`.
fn plant(parts: &[&str], keys: &str, simulate: impl Fn(&Site) -> Running) -> Plant {
    let port = free_udp_port();
    let bacnet =
        format!("[bacnet]\nlisten = \"127.0.0.10:{port}\"\ncommands = true\nwrite = [\"127.0.0.16/28\"]\n{keys}\n");
    let site = Site::of(&[&parts.concat(), MODBUS_TCP, HTTP, &bacnet]);
    let drives = simulate(&site);
    let gateway = site.run_ready();
    Plant {
        site,
        gateway,
        drives,
        port,
    }
}

/// Drives 1 and 2 on `line1`; only the first takes commands.
fn pumps(keys: &str) -> Plant {
    let drives = controlled("pump-1", 1, "limits = { speed_reference = [0.0, 80.0] }") + &drive("pump-2", 2, "");
    let line = LINE1.replace("profile_dirs", "state_dir = \"state\"\nprofile_dirs");
    plant(&[&line, &drives], keys, |site| {
        site.simulate(&["--addresses", "1-2", "--baud", "38400"])
    })
}

impl Plant {
    fn address(&self) -> String {
        format!("127.0.0.10:{}", self.port)
    }

    /// The answers of bacpypes3, whose client is at that address.
    fn bacpypes(&self, host: u8, orders: &[Json]) -> Vec<Json> {
        self.bacpypes_as(host, &[], orders)
    }

    /// The answers of bacpypes3 as a client of that kind.
    fn bacpypes_as(&self, host: u8, kind: &[&str], orders: &[Json]) -> Vec<Json> {
        let own = format!("127.0.0.{host}/8:{}", free_udp_port());
        let script = root().join("tests/peers/bacnet_client.py").display().to_string();
        let mut command = Command::new(python());
        command.args([&script, &own, &self.address(), "1001"]).args(kind);
        asked(&mut command, orders)
    }

    /// Runs the orders with node-bacnet, which sends to its own port number, so the gateway must use that number too.
    fn node(&self, host: u8, orders: &[Json]) -> Vec<Json> {
        let script = root().join("tests/peers/bacnet_node.js").display().to_string();
        let mut command = Command::new(tool("node"));
        command.env("NODE_PATH", root().join(".tools/node/node_modules"));
        let (own, port) = (format!("127.0.0.{host}"), self.port.to_string());
        command.args([&script, &own, &port, &self.address(), "1001"]);
        asked(&mut command, orders)
    }

    fn value(&self, object: &str, property: &str) -> Json {
        self.bacpypes(20, &[json!(["read", 1, object, property])]).remove(0)
    }
}

fn started(command: &mut Command, orders: &[Json]) -> Child {
    let mut child = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let lines: String = orders.iter().map(|order| format!("{order}\n")).collect();
    child.stdin.take().unwrap().write_all(lines.as_bytes()).unwrap();
    child
}

fn answers(child: Child, count: usize) -> Vec<Json> {
    let output = child.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let all: Vec<Json> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(all.len(), count, "{text}{}", String::from_utf8_lossy(&output.stderr));
    all
}

fn asked(command: &mut Command, orders: &[Json]) -> Vec<Json> {
    answers(started(command, orders), orders.len())
}

const RUN: &str = "binary-value,1";
const PV: &str = "present-value";

/// A write to `run` of the first drive.
fn run_at(priority: u8, value: impl Into<Json>) -> Json {
    json!(["write", 1, RUN, PV, value.into(), priority])
}

fn slots(plant: &Plant) -> Vec<(usize, Json)> {
    let all = plant.value(RUN, "priority-array");
    let all = all.as_array().unwrap().iter().enumerate();
    all.filter(|(_, value)| !value.is_null())
        .map(|(place, value)| (place + 1, value.clone()))
        .collect()
}

/// Drives of every family that can be simulated, at most eight on a bus, from unit 1 on; returns the profiles in
/// the order of the units.
fn simulated_families() -> (String, Vec<String>) {
    let profiles = Profiles::built_in();
    let (mut text, mut names) = ("[gateway]\nname = \"test\"\n".to_string(), Vec::new());
    for (protocol, baud, format) in [
        (Protocol::ModbusRtu, 19_200, "8N1"),
        (Protocol::ModbusAscii, 19_200, "7N2"),
        (Protocol::N2, 9600, "8N1"),
    ] {
        let of_protocol: Vec<_> = profiles
            .iter()
            .filter(|p| p.simulator.is_some() && p.protocols.contains(&protocol))
            .collect();
        for chunk in of_protocol.chunks(8) {
            let bus = format!("b{}", names.len());
            text += &format!(
                "[[bus]]\nname = \"{bus}\"\nport = \"{bus}\"\nprotocol = \"{}\"\nbaud = {baud}\nformat = \"{format}\"\n\
                 response_timeout = \"2s\"\n",
                protocol.name()
            );
            for profile in chunk {
                names.push(profile.name.clone());
                text += &drive_of(&profile.name, names.len(), names.len());
            }
        }
    }
    (text, names)
}

/// A drive of that profile, address and unit.
fn drive_of(profile: &str, address: usize, unit: usize) -> String {
    format!("[[bus.drive]]\nname = \"d{unit}\"\naddress = {address}\nunit = {unit}\nprofile = \"{profile}\"\n")
}

/// Drives in Python for the other families, each on a separate bus.
fn other_families(first: usize) -> (String, Vec<String>, Vec<Running>) {
    let (mut text, mut names, mut drives) = (String::new(), Vec::new(), Vec::new());
    let program = root().join("tests/peers/families/run.py").display().to_string();
    for (profile, peer) in super::families::peers() {
        let port = free_port();
        let drive = Running::start(&python(), &[&program, peer, &port.to_string()]);
        let unit = first + names.len();
        text += &format!("[[bus]]\nname = \"c{unit}\"\nport = \"tcp://127.0.0.1:{port}\"\nbaud = 19200\n");
        text += &format!(
            "response_timeout = \"1s\"\nretries = 5\ncycle = \"200ms\"\n{}",
            drive_of(profile, 1, unit)
        );
        names.push(profile.to_string());
        drives.push(drive);
    }
    for drive in &drives {
        drive.until_printed("ready");
    }
    (text, names, drives)
}

/// Compares the objects of a drive in BACnet with its points over HTTP; returns the number of objects, or the difference.
fn compared(shown: &Json, told: &Json) -> Result<usize, String> {
    const STATES: [&str; 5] = ["offline", "not_ready", "ready", "running", "fault"];
    let mut count = 0;
    for (id, properties) in shown.as_object().unwrap() {
        let seen = &properties[PV];
        let Some(point) = told["points"].get(properties["object-name"].as_str().unwrap()) else {
            let place = seen.as_u64().unwrap_or(0) as usize;
            if id == "multi-state-input,1" && Some(told["state"].as_str().unwrap()) != STATES.get(place - 1).copied() {
                return Err(format!("{id} {seen}: {}", told["state"]));
            }
            continue;
        };
        let (value, fault) = (&point["value"], point["quality"] != "good");
        let same = match (value, seen) {
            (Json::String(text), Json::String(seen)) => text == seen,
            // A multi-state object shows the place of the code in the enumeration.
            _ if id.starts_with("multi-state") => true,
            _ => {
                let value = value
                    .as_bool()
                    .map_or(value.as_f64().unwrap_or(0.0), |on| f64::from(u8::from(on)));
                (seen.as_f64().unwrap_or(f64::NAN) - value).abs() <= 1e-4 * value.abs().max(1.0)
            }
        };
        let flags = json!([0, u8::from(fault), 0, 0]);
        if !same || (properties["reliability"] != 0) != fault || properties["status-flags"] != flags {
            return Err(format!("{id}: {properties} {point}"));
        }
        count += 1;
    }
    Ok(count)
}

#[test]
fn every_family_shows_what_http_tells() {
    let (buses, mut families) = simulated_families();
    let (others, more, _drives) = other_families(families.len() + 1);
    families.extend(more);
    assert!(families.len() >= 31);
    let plant = plant(&[&buses, &others], "", |site| {
        site.write("simulated.conf", &buses);
        let simulator = Running::drivegate(&["simulate", "--config", &site.path("simulated.conf")]);
        simulator.until_printed("Ctrl-C ends");
        simulator
    });
    for (unit, profile) in (1..).zip(&families) {
        until(&format!("{profile} was read"), || {
            (api(plant.site.http, &format!("d{unit}"))["state"] != "offline").then_some(())
        });
    }
    let units = 1..=families.len();
    let asked = [
        json!(["who_is", null, null, "global"]),
        json!(["who_is", 103, 104, "global"]),
    ];
    // On a busy machine a drive may be offline for a moment.
    let mut seen = std::collections::BTreeSet::new();
    until("each was there", || {
        let heard = plant.bacpypes(20, &asked);
        let ids = |list: &Json| -> Vec<u64> { list.as_array().unwrap().iter().filter_map(Json::as_u64).collect() };
        assert!(ids(&heard[1]).iter().all(|id| [103, 104].contains(id)), "{heard:?}");
        seen.extend(ids(&heard[0]));
        let missing: Vec<u64> = (100..=100 + families.len() as u64)
            .filter(|id| !seen.contains(id))
            .collect();
        eprintln!("not heard yet: {missing:?}");
        missing.is_empty().then_some(())
    });
    assert_eq!(seen.len(), families.len() + 1, "and nobody else");
    let orders: Vec<Json> = units
        .clone()
        .map(|unit| json!(["read", unit, format!("device,{}", 100 + unit), "object-list"]))
        .collect();
    let lists = plant.bacpypes(20, &orders);
    let lists: Vec<Vec<Json>> = lists.iter().map(|list| list.as_array().unwrap().clone()).collect();
    // Values of a motor at standstill do not change, but one may be read for the first time between two comparisons.
    let mut left: Vec<usize> = units.clone().collect();
    let mut objects = 0;
    until("all is as HTTP tells", || {
        let told: Vec<Json> = left
            .iter()
            .map(|unit| api(plant.site.http, &format!("d{unit}")))
            .collect();
        let orders: Vec<Json> = left
            .iter()
            .map(|unit| Json::Array([vec![json!("all"), json!(unit)], lists[unit - 1].clone()].concat()))
            .collect();
        let shown = plant.bacpypes(20, &orders);
        let mut again = Vec::new();
        for ((unit, told), shown) in left.iter().zip(&told).zip(&shown) {
            match compared(shown, told) {
                Ok(count) => {
                    // All objects except the device itself, its port, the state and the text of the fault.
                    let of = lists[unit - 1].len();
                    assert!(count + 4 >= of, "{}: {count} of {of}", families[unit - 1]);
                    objects += count;
                }
                Err(differs) => {
                    eprintln!("{}: {differs}", families[unit - 1]);
                    again.push(*unit);
                }
            }
        }
        left = again;
        left.is_empty().then_some(())
    });
    println!("{} drives, {objects} objects", families.len());
    let orders: Vec<Json> = units
        .flat_map(|unit| {
            [
                json!(["objects", unit]),
                json!(["read", unit, 0, 2, 85]),
                json!(["read", unit, 13, 1, 110]),
            ]
        })
        .collect();
    let numbers = plant.node(21, &orders);
    for ((profile, list), numbers) in families.iter().zip(&lists).zip(numbers.chunks(3)) {
        assert_eq!(numbers[0].as_array().unwrap().len(), list.len(), "{profile}");
        assert!(
            numbers[1][0].is_number() || numbers[1]["error"].is_string(),
            "{profile}: {}",
            numbers[1]
        );
        assert_eq!(numbers[2][4], "fault", "{profile}");
    }
}

#[test]
fn a_write_is_answered_when_the_drive_has_done_it() {
    let plant = pumps("");
    let done = plant.bacpypes(
        20,
        &[
            json!(["write", 1, "analog-value,1", PV, 50.0, 8]),
            run_at(8, true),
            json!(["read", 1, RUN, "current-command-priority"]),
            json!(["read", 1, "analog-value,2", PV]),
        ],
    );
    assert_eq!(done, [json!("done"), json!("done"), json!(8), json!(25.0)]);
    plant.site.until_state("pump-1", "running");
    let ran = until("its record", || {
        let mut audit = plant.site.audit().into_iter();
        audit.find(|r| r["source"] == "bacnet" && r["command"] == "run=true")
    });
    assert!(ran["client"].as_str().unwrap().starts_with("127.0.0.20:"), "{ran}");
    let told = plant.bacpypes(
        20,
        &[
            json!(["cov", 1, "analog-input,2", true, 60, 1]),
            json!(["cov", 1, "binary-input,2", false, 60, 1]),
        ],
    );
    assert!(told[0][0].as_f64().unwrap() > 0.0 && told[1] == json!([1]), "{told:?}");
    let refused = [
        (json!(["write", 1, "analog-value,1", PV, 90.0, 8]), [2, 37]),
        (run_at(6, false), [2, 40]),
        (run_at(17, true), [5, 80]),
        (json!(["write", 1, "analog-input,2", PV, 1.0, 8]), [2, 40]),
        (json!(["write", 1, RUN, "out-of-service", true, 8]), [2, 40]),
        (json!(["write", 2, RUN, PV, true, 8]), [1, 31]),
    ];
    let orders: Vec<Json> = refused.iter().map(|(order, _)| order.clone()).collect();
    for ((order, error), answer) in refused.iter().zip(plant.bacpypes(20, &orders)) {
        assert_eq!(answer, json!({ "error": error }), "{order}");
    }
    let real = plant.node(21, &[json!(["write", 1, 5, 1, 1.5, 8])]).remove(0);
    assert!(real["error"].as_str().unwrap().contains("INVALID_DATA_TYPE"), "{real}");
    // An address that may read but not write; and of several writes a stop is carried out although another one is refused.
    assert_eq!(plant.bacpypes(40, &[run_at(8, false)]), [json!({ "error": [2, 40] })]);
    assert_eq!(plant.site.point("pump-1", "running"), true);
    let several = json!(["several", 1, ["analog-value,1", PV, 500.0, 8], [RUN, PV, false, 8]]);
    assert_eq!(plant.bacpypes(20, &[several]), [json!({ "error": [2, 37] })]);
    plant.site.until_state("pump-1", "ready");
    plant
        .site
        .until_metric("drivegate_writes_total{source=\"bacnet\",result=\"acknowledged\"} 3");
}

#[test]
fn slots_and_other_sides_see_each_other() {
    let plant = pumps("");
    let start = || {
        until("a start by Modbus TCP", || {
            mbpoll_write(plant.site.modbus, 1, 33_024, &[1]).ok()
        })
    };
    assert_eq!(plant.bacpypes(20, &[run_at(8, true)]), [json!("done")]);
    assert_eq!(
        plant.node(21, &[json!(["write", 1, 5, 1, false, 5])]),
        [json!("done")],
        "over the other one's 8"
    );
    assert_eq!(slots(&plant), [(5, json!(0)), (8, json!(1))]);
    plant.site.until_state("pump-1", "ready");
    let refused = mbpoll_write(plant.site.modbus, 1, 33_024, &[1]).unwrap_err();
    assert!(refused.contains("busy"), "{refused}");
    let record = plant
        .site
        .audit()
        .into_iter()
        .find(|r| r["result"] == "held_by_other")
        .unwrap();
    assert!(
        record["text"].as_str().unwrap().contains("127.0.0.21")
            && record["text"].as_str().unwrap().contains("priority 5")
    );
    assert_eq!(plant.node(21, &[json!(["write", 1, 5, 1, null, 5])]), [json!("done")]);
    plant.site.until_state("pump-1", "running");
    mbpoll_write(plant.site.modbus, 1, 33_024, &[0]).unwrap();
    plant.site.until_state("pump-1", "ready");
    assert_eq!(slots(&plant), [], "a stop from elsewhere empties every active");
    start();
    plant.site.until_state("pump-1", "running");
    assert_eq!(plant.value(RUN, PV), 1, "without a slot it is what the drive has");
    assert_eq!(plant.value(RUN, "current-command-priority"), Json::Null);
    assert_eq!(plant.bacpypes(20, &[run_at(16, false)]), [json!("done")]);
    plant.site.until_state("pump-1", "ready");
    start();
    assert_eq!(slots(&plant), [], "a start withdraws the inactives that protect nobody");
    // Inactive values that protect people stay, even if an active value governs.
    let orders = [run_at(1, true), run_at(4, false), run_at(12, false)];
    assert_eq!(
        plant.bacpypes(20, &orders),
        [json!("done"), json!("done"), json!("done")]
    );
    start();
    assert_eq!(slots(&plant), [(1, json!(1)), (4, json!(0))]);
    assert_eq!(plant.bacpypes(20, &[run_at(1, Json::Null)]), [json!("done")]);
    plant.site.until_state("pump-1", "ready");
    let refused = mbpoll_write(plant.site.modbus, 1, 33_024, &[1]).unwrap_err();
    assert!(refused.contains("busy"), "{refused}");
}

#[test]
fn a_drive_that_is_away_is_silent_or_shows_its_fault() {
    let mut plant = pumps("");
    let present = |plant: &Plant| plant.bacpypes(20, &[json!(["who_is", 101, 102, "global"])]).remove(0);
    until("both", || (present(&plant) == json!([101, 102])).then_some(()));
    // The simulator removes its link; otherwise another test might get the same pseudo-terminal.
    plant.drives.signal("TERM");
    plant.drives.ended();
    plant.site.until_state("pump-1", "offline");
    until("silence", || (present(&plant) == json!([])).then_some(()));
    plant.site.change("[bacnet]\n", "[bacnet]\noffline = \"fault\"\n");
    plant.gateway.signal("HUP");
    until("they answer again", || {
        (present(&plant) == json!([101, 102])).then_some(())
    });
    let asked =
        ["status-flags", "reliability", "event-state"].map(|property| json!(["read", 1, "analog-input,2", property]));
    assert_eq!(plant.bacpypes(20, &asked), [json!([0, 1, 0, 0]), json!(12), json!(1)]);
    assert_eq!(plant.value("multi-state-input,1", PV), 1);
}

#[test]
fn a_client_that_falls_silent_loses_its_slots_with_its_lease() {
    let keys = "supervision = { timeout = \"3s\", action = \"stop\" }";
    let drives = controlled("pump-1", 1, keys);
    let plant = plant(&[LINE1, &drives], "", |site| {
        site.simulate(&["--addresses", "1", "--baud", "38400"])
    });
    let orders = [json!(["write", 1, "analog-value,1", PV, 20.0, 8]), run_at(8, true)];
    assert_eq!(plant.bacpypes(20, &orders), [json!("done"), json!("done")]);
    plant
        .site
        .until_metric("drivegate_supervision_actions_total{bus=\"line1\",drive=\"pump-1\"} 1");
    plant.site.until_state("pump-1", "ready");
    assert_eq!(slots(&plant), []);
    assert_eq!(plant.value("analog-value,1", "current-command-priority"), Json::Null);
}

#[test]
fn inactives_that_protect_outlive_a_restart() {
    let mut plant = pumps("keep_priorities = true");
    assert_eq!(
        plant.bacpypes(20, &[run_at(3, false), run_at(9, true)]),
        [json!("done"), json!("done")]
    );
    plant.gateway.signal("TERM");
    assert!(plant.gateway.ended().success());
    plant.gateway = plant.site.run_ready();
    assert_eq!(slots(&plant), [(3, json!(0))]);
    let refused = mbpoll_write(plant.site.modbus, 1, 33_024, &[1]).unwrap_err();
    assert!(refused.contains("busy"), "{refused}");
    assert_eq!(plant.bacpypes(20, &[run_at(3, Json::Null)]), [json!("done")]);
    until("a start", || mbpoll_write(plant.site.modbus, 1, 33_024, &[1]).ok());
}

/// Datagrams as a capture without a link layer: each an IPv4 packet with UDP.
fn capture(file: &Path, datagrams: &[(u8, u8, Vec<u8>)]) {
    let mut bytes = Vec::new();
    bytes.extend(0xA1B2_C3D4_u32.to_le_bytes());
    bytes.extend([2, 0, 4, 0]);
    bytes.extend([0; 8]);
    bytes.extend(65_535_u32.to_le_bytes());
    bytes.extend(228_u32.to_le_bytes());
    for (from, to, datagram) in datagrams {
        let length = u16::try_from(datagram.len() + 28).unwrap();
        bytes.extend([0; 8]);
        bytes.extend(u32::from(length).to_le_bytes());
        bytes.extend(u32::from(length).to_le_bytes());
        bytes.extend([0x45, 0]);
        bytes.extend(length.to_be_bytes());
        bytes.extend([
            0, 0, 0, 0, 64, 17, 0, 0, 127, 0, 0, *from, 127, 0, 0, *to, 0xBA, 0xC0, 0xBA, 0xC0,
        ]);
        bytes.extend((length - 20).to_be_bytes());
        bytes.extend([0, 0]);
        bytes.extend(datagram);
    }
    std::fs::write(file, bytes).unwrap();
}

#[test]
fn tshark_finds_nothing_wrong_with_any_frame() {
    let plant = pumps("");
    let socket = UdpSocket::bind("127.0.0.22:0").unwrap();
    socket.set_read_timeout(Some(Duration::from_millis(700))).unwrap();
    let routed = |apdu: &[u8]| [&[1, 0x24, 3, 0xE9, 1, 1, 0xFF][..], apdu].concat();
    let requests = [
        vec![1, 0x20, 0xFF, 0xFF, 0, 0xFF, 0x10, 8],
        vec![1, 0x80, 0],
        vec![1, 0x80, 6, 0],
        vec![1, 0x20, 0, 77, 0, 0xFF, 0x10, 8],
        vec![1, 0x20, 0xFF, 0xFF, 0, 0xFF, 0x10, 7, 0x3D, 4, 0, b'r', b'u', b'n'],
        // The requests ask for all properties of each kind of object, and of an object that does not exist.
        routed(
            &[
                &[2, 5, 1, 14][..],
                &[0x0C, 2, 0, 0, 101, 0x1E, 0x09, 8, 0x1F],
                &[0x0C, 0, 0, 0, 2, 0x1E, 0x09, 8, 0x1F],
            ]
            .concat(),
        ),
        routed(
            &[
                &[2, 5, 2, 14][..],
                &[0x0C, 1, 0x40, 0, 1, 0x1E, 0x09, 8, 0x1F],
                &[0x0C, 3, 0x40, 0, 1, 0x1E, 0x09, 8, 0x1F],
            ]
            .concat(),
        ),
        routed(
            &[
                &[2, 5, 3, 14][..],
                &[0x0C, 0, 0x80, 0, 1, 0x1E, 0x09, 8, 0x1F],
                &[0x0C, 10, 0, 0, 1, 0x1E, 0x09, 8, 0x1F],
            ]
            .concat(),
        ),
        routed(
            &[
                &[2, 5, 4, 14][..],
                &[0x0C, 14, 0, 0, 1, 0x1E, 0x09, 8, 0x1F],
                &[0x0C, 0, 0, 0, 77, 0x1E, 0x09, 85, 0x1F],
            ]
            .concat(),
        ),
        // Subscriptions, writes, an error, a reject, an abort.
        routed(&[2, 5, 5, 5, 0x09, 7, 0x1C, 0, 0, 0, 2, 0x29, 1, 0x39, 60]),
        routed(&[
            2, 5, 6, 28, 0x09, 7, 0x1C, 0, 0, 0, 2, 0x29, 0, 0x39, 60, 0x4E, 0x09, 85, 0x4F, 0x5C, 0x3F, 0x80, 0, 0,
        ]),
        routed(&[2, 5, 7, 15, 0x0C, 1, 0x40, 0, 1, 0x19, 85, 0x3E, 0x91, 1, 0x3F, 0x49, 8]),
        routed(&[
            2, 5, 8, 16, 0x0C, 0, 0, 0, 2, 0x1E, 0x09, 85, 0x2E, 0x44, 0, 0, 0, 0, 0x2F, 0x1F,
        ]),
        routed(&[2, 5, 9, 14, 0x0C, 1, 0x40, 0, 1, 0x1E, 0x09, 8, 0x1F]),
        routed(&[2, 5, 10, 12, 0x0C, 2, 0, 0, 101, 0x1A, 0, 152]),
        routed(&[2, 5, 11, 17, 0x19, 2]),
        routed(&[2, 5, 12, 99]),
        routed(&[0, 0, 13, 14, 0x0C, 2, 0, 0, 101, 0x1E, 0x09, 8, 0x1F]),
        routed(&[2, 0x70, 14, 14, 0x0C, 2, 0, 0, 101, 0x1E, 0x09, 8, 0x1F]),
        routed(&[0x40, 14, 0, 4]),
        routed(&[0x40, 14, 4, 4]),
    ];
    let mut datagrams = Vec::new();
    for npdu in requests {
        let length = u16::try_from(npdu.len() + 4).unwrap().to_be_bytes();
        let datagram = [&[0x81, 0x0A][..], &length, &npdu].concat();
        socket.send_to(&datagram, plant.address()).unwrap();
        datagrams.push((22, 10, datagram));
        let mut buffer = [0; 2048];
        while let Ok(length) = socket.recv(&mut buffer) {
            datagrams.push((10, 22, buffer[..length].to_vec()));
            socket.set_read_timeout(Some(Duration::from_millis(150))).unwrap();
        }
    }
    let answers = datagrams.iter().filter(|(from, ..)| *from == 10).count();
    assert!(answers > 25, "{answers}");
    let file = plant.site.file("bacnet.pcap");
    capture(&file, &datagrams);
    let file = file.display().to_string();
    let arguments = [
        "-r",
        &file,
        "-T",
        "fields",
        "-e",
        "bvlc.function",
        "-e",
        "_ws.malformed",
        "-e",
        "_ws.expert.message",
        "-e",
        "frame.number",
    ];
    let output = run(&tool("tshark"), &arguments);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(text.lines().count(), datagrams.len(), "{text}");
    for line in text.lines() {
        let fields: Vec<&str> = line.split('\t').collect();
        assert!(
            fields[0].starts_with("0x") && fields[1].is_empty() && fields[2].is_empty(),
            "{line}: {:02x?}",
            datagrams[fields[3].parse::<usize>().unwrap() - 1]
        );
    }
    let metrics = get(plant.site.http, "/metrics").unwrap().1;
    assert!(
        metrics.contains("drivegate_bacnet_datagrams_total{fate=\"discarded\"} "),
        "{metrics}"
    );
}

#[test]
fn every_change_is_reported() {
    let drives: String = (1..=8).map(|n| controlled(&format!("pump-{n}"), n, "")).collect();
    let plant = plant(&[LINE1, &drives], "", |site| {
        site.simulate(&["--addresses", "1-8", "--baud", "38400"])
    });
    let client = UdpSocket::bind("127.0.0.22:0").unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    // SubscribeCOV of `running` of unit 5, not confirmed, without end.
    let apdu = [2, 5, 1, 5, 0x09, 7, 0x1C, 0, 0xC0, 0, 2, 0x29, 0, 0x39, 0];
    let npdu = [&[1, 0x24, 3, 0xE9, 1, 5, 0xFF][..], &apdu].concat();
    let datagram = [&[0x81, 0x0A, 0, npdu.len() as u8 + 4][..], &npdu].concat();
    client.send_to(&datagram, plant.address()).unwrap();
    let mut buffer = [0; 1500];
    let mut heard = || {
        let length = client.recv(&mut buffer).unwrap();
        buffer[..length].to_vec()
    };
    (0..2).for_each(|_| drop(heard()));
    let mut modbus = TcpStream::connect(("127.0.0.1", plant.site.modbus)).unwrap();
    for number in 0..60_u16 {
        // Each write comes at another time of the polling round.
        std::thread::sleep(Duration::from_millis(u64::from(number) * 37 % 113));
        let on = u8::from(number % 2 == 0);
        modbus.write_all(&[0, 1, 0, 0, 0, 6, 5, 6, 0x81, 0, 0, on]).unwrap();
        modbus.read_exact(&mut [0; 12]).unwrap();
        // The value is between the tags 2: ENUMERATED.
        while heard().windows(4).all(|bytes| bytes != [0x2E, 0x91, on, 0x2F]) {}
    }
}
