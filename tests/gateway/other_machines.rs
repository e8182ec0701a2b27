//! Reloads that give names and units to other machines, or take a machine away: an action in progress, a hold and a waiting
//! order belong to the machine that the client named. Words sent to the drives are read from the line.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use drivegate_sim::statistics::Direction;
use drivegate_sim::wire::SimulatedBus;

use crate::support::process::{PATIENCE, Running, api, free_port, local, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, controlled};

const MS: Duration = Duration::from_millis(1);
/// The register of the control word of a Vacon NX.
const CONTROL_WORD: [u8; 2] = [0x07, 0xD0];

struct Plant {
    site: Site,
    line: SimulatedBus,
    gateway: Running,
}

impl Plant {
    /// Two drives at addresses 1 and 2 with the names and unit ids of these sections.
    fn new(drives: &str) -> Plant {
        let site = Site::new();
        let line = site.line(&[1, 2]);
        configure(&site, drives);
        let gateway = site.run_ready();
        for name in ["pump-1", "pump-2"] {
            site.until_state(name, "ready");
        }
        Plant { site, line, gateway }
    }

    fn reload(&self, drives: &str) {
        configure(&self.site, drives);
        self.gateway.reload();
    }

    /// The control words that the drive at that address was sent.
    fn words(&self, address: u8) -> Vec<u16> {
        let mut frames = self.line.transcript();
        frames.retain(|frame| frame.direction == Direction::ToDrives);
        let words = frames.iter().filter_map(|frame| match *frame.bytes.as_slice() {
            [to, 6, high, low, a, b, ..] if to == address && [high, low] == CONTROL_WORD => Some([a, b]),
            [to, 16, high, low, _, _, _, a, b, ..] if to == address && [high, low] == CONTROL_WORD => Some([a, b]),
            _ => None,
        });
        words.map(u16::from_be_bytes).collect()
    }

    fn runs(&self, address: u8) -> bool {
        self.words(address).last().is_some_and(|word| word & 1 != 0)
    }

    fn modbus(&self) -> TcpStream {
        let stream = TcpStream::connect(("127.0.0.1", self.site.modbus)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream
    }
}

fn configure(site: &Site, drives: &str) {
    let socket = format!("[gateway]\nsocket = \"{}\"\n", site.path("socket"));
    let line = LINE1.replace("[gateway]\n", &socket);
    site.configure(&[&line, drives, MODBUS_TCP, HTTP]);
}

fn pair(one: &str, other: &str) -> String {
    controlled(one, 1, "unit = 11") + &controlled(other, 2, "unit = 12")
}

/// Unchanged names with swapped units.
fn swapped_units() -> String {
    controlled("pump-1", 1, "unit = 12") + &controlled("pump-2", 2, "unit = 11")
}

/// Writes that word to 0x8100 of a unit; the reply.
fn write(stream: &mut TcpStream, unit: u8, word: u16) -> Vec<u8> {
    let [high, low] = word.to_be_bytes();
    stream
        .write_all(&[0, 1, 0, 0, 0, 6, unit, 6, 0x81, 0, high, low])
        .unwrap();
    reply(stream)
}

/// Starts the motor of this unit. After a pause of the machine a start is refused, and given again.
fn start(stream: &mut TcpStream, unit: u8) {
    until("a start", || (write(stream, unit, 1)[7] == 6).then_some(()));
}

fn reply(stream: &mut impl Read) -> Vec<u8> {
    let mut reply = vec![0; 4096];
    let count = stream.read(&mut reply).unwrap();
    reply.truncate(count);
    reply
}

/// The head of a command over HTTP at the local socket; the gateway waits for the body.
fn begin_over_http(site: &Site, drive: &str, body: &str) -> UnixStream {
    begin_post(site, &format!("drives/{drive}/commands"), body)
}

/// The head of any request that changes something.
fn begin_post(site: &Site, path: &str, body: &str) -> UnixStream {
    let mut stream = local(site.file("socket"));
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let head = format!(
        "POST /api/v1/{path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {}\r\nExpect: 100-continue\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes()).unwrap();
    let mut reply = [0; 25];
    stream.read_exact(&mut reply).unwrap();
    stream
}

/// The head of an order arrives, a reload gives its name to the other machine, and the rest arrives.
#[test]
fn an_order_belongs_to_the_machine_that_its_first_byte_named() {
    let plant = Plant::new(&pair("pump-1", "pump-2"));
    let mut names = [pair("pump-2", "pump-1"), pair("pump-1", "pump-2")].into_iter().cycle();
    let stop = "{\"run\": false}";
    for body in ["{\"run\": true}", "{\"reverse\": true}", "{\"speed_reference\": 20}"] {
        let mut begun = begin_over_http(&plant.site, "pump-1", body);
        plant.reload(&names.next().unwrap());
        begun.write_all(body.as_bytes()).unwrap();
        let reply = reply(&mut begun);
        let text = String::from_utf8_lossy(&reply);
        assert!(text.starts_with("HTTP/1.1 404"), "{body}: {text}");
        assert!(text.contains("meant another machine"), "{text}");
        std::thread::sleep(200 * MS);
        assert_eq!((plant.words(1), plant.words(2)), (vec![], vec![]), "{body}");
        plant.reload(&names.next().unwrap());
    }
    // Half a frame, and a reload that swaps the units.
    for rest in [[6, 0x81, 0, 0, 1], [6, 0x81, 1, 7, 0xD0]] {
        let mut stream = plant.modbus();
        stream.write_all(&[0, 1, 0, 0, 0, 6, 11]).unwrap();
        std::thread::sleep(50 * MS);
        plant.reload(&swapped_units());
        stream.write_all(&rest).unwrap();
        assert_eq!(reply(&mut stream), [0, 1, 0, 0, 0, 3, 11, 0x86, 0x0A], "{rest:?}");
        std::thread::sleep(200 * MS);
        assert_eq!((plant.words(1), plant.words(2)), (vec![], vec![]), "{rest:?}");
        plant.reload(&pair("pump-1", "pump-2"));
    }
    // A stop goes to the machine that was meant, and to no other.
    for name in ["pump-1", "pump-2"] {
        plant.site.until_state(name, "ready");
    }
    let mut plc = plant.modbus();
    for unit in [11, 12] {
        assert_eq!(write(&mut plc, unit, 1)[7], 6, "unit {unit}");
    }
    let mut begun = begin_over_http(&plant.site, "pump-1", stop);
    plant.reload(&pair("pump-2", "pump-1"));
    begun.write_all(stop.as_bytes()).unwrap();
    reply(&mut begun);
    assert_eq!((plant.runs(1), plant.runs(2)), (false, true));
    let mut half = plant.modbus();
    half.write_all(&[0, 1, 0, 0, 0, 6, 12]).unwrap();
    std::thread::sleep(50 * MS);
    plant.reload(&swapped_units());
    half.write_all(&[6, 0x81, 0, 0, 0]).unwrap();
    reply(&mut half);
    assert_eq!((plant.runs(1), plant.runs(2)), (false, false));
}

/// The head of a request that is not an order arrives, a reload gives its name to the other machine, and the rest arrives.
#[test]
fn a_hold_a_restore_and_a_drill_belong_to_the_machine_that_was_named() {
    let plant = Plant::new(&pair("pump-1", "pump-2"));
    let mut names = [pair("pump-2", "pump-1"), pair("pump-1", "pump-2")].into_iter().cycle();
    for (path, body) in [
        ("drives/pump-1/hold", "{\"action\": \"take\"}"),
        ("drives/pump-1/params/restore", "\"resume\""),
        ("drills", "{\"drive\": \"pump-1\"}"),
    ] {
        let mut begun = begin_post(&plant.site, path, body);
        plant.reload(&names.next().unwrap());
        begun.write_all(body.as_bytes()).unwrap();
        let reply = reply(&mut begun);
        let text = String::from_utf8_lossy(&reply);
        assert!(
            text.starts_with("HTTP/1.1 4") && text.contains("meant another machine"),
            "{path}: {text}"
        );
        plant.reload(&names.next().unwrap());
    }
    // A heartbeat renews no lease of another machine.
    let mut half = plant.modbus();
    half.write_all(&[0, 1, 0, 0, 0, 6, 11]).unwrap();
    std::thread::sleep(50 * MS);
    plant.reload(&swapped_units());
    half.write_all(&[6, 0x81, 3, 0, 1]).unwrap();
    assert_eq!(reply(&mut half), [0, 1, 0, 0, 0, 3, 11, 0x86, 0x0A]);
}

/// Sections of two drives, and a listener whose units 0 and 255 are the drive `default`.
fn with_default(drives: String, port: u16, default: &str) -> String {
    drives + &format!("[[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:{port}\"]\ndefault_drive = \"{default}\"\n")
}

/// The first bytes of a write to 0x8100 of this unit; the gateway has read them.
fn half_a_write(port: u16, unit: u8) -> TcpStream {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(&[0, 1, 0, 0, 0, 6, unit, 6, 0x81]).unwrap();
    std::thread::sleep(50 * MS);
    stream
}

/// Units 0 and 255 mean a drive by its name, whatever the units of the drives are.
#[test]
fn an_order_to_the_default_drive_belongs_to_the_machine_that_had_its_name() {
    let port = free_port();
    let with = |drives: String, default: &str| with_default(drives, port, default);
    let before = with(pair("pump-1", "pump-2"), "pump-1");
    let changes = [
        (with(pair("pump-2", "pump-1"), "pump-1"), ["pump-1", "pump-2"], false),
        (with(swapped_units(), "pump-1"), ["pump-1", "pump-2"], true),
        (with(pair("pump-1", "pump-2"), "pump-2"), ["pump-1", "pump-2"], false),
        (with(pair("pump-3", "pump-2"), "pump-2"), ["pump-3", "pump-2"], false),
    ];
    for (after, names, is_same) in changes {
        // On a busy machine the order may expire meanwhile.
        let (plant, answer) = until("a reload in time", || {
            let plant = Plant::new(&before);
            let (mut order, asked) = (half_a_write(port, 0), Instant::now());
            plant.reload(&after);
            // A bus that was started anew reads its drives before it starts one.
            names.iter().for_each(|name| plant.site.until_state(name, "ready"));
            order.write_all(&[0, 0, 1]).unwrap();
            let answer = reply(&mut order);
            (asked.elapsed() < 1500 * MS).then_some((plant, answer))
        });
        assert_eq!(answer[7] == 6, is_same, "{after}: {answer:?}");
        let begun = if is_same { vec![1] } else { vec![] };
        assert_eq!((plant.words(1), plant.words(2)), (begun, vec![]), "{after}");
        drop(plant);
        let plant = Plant::new(&before);
        let mut plc = plant.modbus();
        for unit in [11, 12] {
            start(&mut plc, unit);
        }
        let mut stop = half_a_write(port, 0);
        plant.reload(&after);
        stop.write_all(&[0, 0, 0]).unwrap();
        reply(&mut stop);
        assert_eq!((plant.runs(1), plant.runs(2)), (false, true), "{after}");
    }
}

/// No drive has the name and the unit id any more that the stop names, or one that is only monitored has them.
#[test]
fn a_stop_reaches_its_machine_whatever_became_of_the_name() {
    let renamed = controlled("pump-3", 1, "unit = 13") + &controlled("pump-2", 2, "unit = 12");
    let monitored = controlled("pump-2", 1, "unit = 12")
        + &controlled("pump-1", 2, "unit = 11").replace("\"control\"", "\"monitor\"");
    for after in [renamed, monitored] {
        for over_http in [false, true] {
            let plant = Plant::new(&pair("pump-1", "pump-2"));
            start(&mut plant.modbus(), 11);
            let body = "{\"run\": false}";
            let mut http = begin_over_http(&plant.site, "pump-1", body);
            let mut half = half_a_write(plant.site.modbus, 11);
            plant.reload(&after);
            if over_http {
                http.write_all(body.as_bytes()).unwrap();
                reply(&mut http);
            } else {
                half.write_all(&[0, 0, 0]).unwrap();
                reply(&mut half);
            }
            assert!(!plant.runs(1), "HTTP {over_http}: {after}");
        }
    }
}

/// The head of a stop of a group arrives, a reload gives the name to other drives, and the rest arrives.
#[test]
fn a_stop_of_a_group_reaches_the_drives_that_the_name_meant() {
    let grouped = |one: &str, other: &str| {
        let group = |unit: u8, group: &str| format!("unit = {unit}\ngroup = \"{group}\"");
        controlled("pump-1", 1, &group(11, one)) + &controlled("pump-2", 2, &group(12, other))
    };
    let plant = Plant::new(&grouped("left", "right"));
    for unit in [11, 12] {
        assert_eq!(write(&mut plant.modbus(), unit, 1)[7], 6);
    }
    let body = "{\"group\": \"left\"}";
    let mut stop = begin_post(&plant.site, "stop", body);
    plant.reload(&grouped("right", "left"));
    assert!(plant.runs(1) && plant.runs(2));
    stop.write_all(body.as_bytes()).unwrap();
    until("the stop", || (!plant.runs(1)).then_some(()));
    let report = reply(&mut stop);
    assert!(plant.runs(2), "{}", String::from_utf8_lossy(&report));
}

/// Two lines with a listener each, on which the same unit id is another drive.
#[test]
fn a_reload_changes_no_unit_id_that_another_listener_uses_too() {
    let (second, other) = (free_port(), Site::new());
    let line2 = format!(
        "[[bus]]\nname = \"line2\"\nport = \"{}\"\nbaud = 38400\nresponse_timeout = \"2100ms\"\n",
        other.path("line1")
    );
    let listener = |port: u16, bus: &str| {
        format!(
            "[[modbus_tcp.listener]]\nlisten = [\"127.0.0.1:{port}\"]\nbuses = [\"{bus}\"]\n\
             write = [\"127.0.0.1/32\"]\n"
        )
    };
    let site = Site::new();
    let listeners = listener(site.modbus, "line1") + &listener(second, "line2");
    let (pump, fan) = (controlled("pump-1", 1, "unit = 1"), controlled("fan-1", 1, "unit = 1"));
    site.configure(&[LINE1, &pump, &line2, &fan, &listeners, HTTP]);
    let (_pumps, fans) = (site.line(&[1]), other.line(&[1]));
    let gateway = site.run_ready();
    for name in ["pump-1", "fan-1"] {
        site.until_state(name, "ready");
    }
    let plant = Plant {
        site,
        line: fans,
        gateway,
    };
    for port in [plant.site.modbus, second] {
        let mut plc = TcpStream::connect(("127.0.0.1", port)).unwrap();
        start(&mut plc, 1);
    }
    let mut half = half_a_write(second, 1);
    plant
        .site
        .change("response_timeout = \"2s\"", "response_timeout = \"1900ms\"");
    plant.gateway.reload();
    half.write_all(&[0, 0, 0]).unwrap();
    assert_eq!(reply(&mut half)[7], 6, "the stop of the fan");
    assert!(!plant.runs(1));
    assert_eq!(write(&mut half, 1, 1)[7], 6, "the fan is the drive that it was");
    plant.site.until_point("pump-1", "running", true);
}

/// A controller keeps run and reset bit set at a unit id; a reload puts another drive there.
#[test]
fn a_bit_that_a_controller_holds_is_no_edge_at_another_machine() {
    let plant = Plant::new(&pair("pump-1", "pump-2"));
    let mut plc = plant.modbus();
    assert_eq!(write(&mut plc, 12, 1)[7], 6);
    assert_eq!(write(&mut plc, 11, 5)[7], 6);
    let before = plant.words(2).len();
    assert!(plant.line.with_drive(2, |drive, _| drive.trip(9)).is_some());
    plant.site.until_state("pump-2", "fault");
    plant.reload(&swapped_units());
    plant.site.until_state("pump-2", "fault");
    for _ in 0..3 {
        write(&mut plc, 11, 5);
        std::thread::sleep(100 * MS);
    }
    let sent = plant.words(2).split_off(before);
    assert_eq!(sent, Vec::<u16>::new(), "no reset, and no start");
    assert_eq!(api(plant.site.http, "pump-2")["state"], "fault");
    // After a stop from this controller, the bit counts as an edge again.
    assert_eq!(write(&mut plc, 11, 0)[7], 6);
    assert_eq!(write(&mut plc, 11, 4)[7], 6);
    plant.site.until_state("pump-2", "ready");
}

/// A stop waits until the motor has run for `min_run`; then no bus sends anything to the drive any more.
#[test]
fn a_stop_that_waits_is_sent_before_its_machine_is_given_up() {
    let guard = "unit = 11\nguard = { min_run = \"60s\" }";
    let both = controlled("pump-1", 1, guard) + &controlled("pump-2", 2, "unit = 12");
    let only_other = controlled("pump-2", 2, "unit = 12");
    let monitored = controlled("pump-1", 1, "unit = 11").replace("control", "monitor") + &only_other;
    let moved = controlled("pump-1", 3, guard) + &only_other;
    let listening = both
        .replace("guard = { min_run = \"60s\" }", "")
        .replace("control", "monitor");
    let table = [
        ("removed", only_other, false),
        ("only monitored", monitored, false),
        ("at another address", moved, false),
        ("on a line of another master", listening, true),
    ];
    for (what, after, listens) in table {
        let plant = Plant::new(&both);
        let mut plc = plant.modbus();
        assert_eq!(write(&mut plc, 11, 1)[7], 6, "{what}");
        plant.site.until_state("pump-1", "running");
        plc.write_all(&[0, 1, 0, 0, 0, 6, 11, 6, 0x81, 0, 0, 0]).unwrap();
        until("the stop waits", || {
            api(plant.site.http, "pump-1")["stop_waits_ms"].as_u64()
        });
        assert!(plant.runs(1), "{what}");
        configure(&plant.site, &after);
        if listens {
            plant.site.change("[[bus]]\n", "[[bus]]\nmode = \"listen\"\n");
        }
        plant.gateway.reload();
        assert!(!plant.runs(1), "{what}");
        assert_eq!(reply(&mut plc)[7], 6, "{what}: its client is told so");
    }
}
