//! Commands that must not reach a drive, over both protocols; the recorded line proves that nothing reached it.

use std::io::{Read, Write};
use std::net::TcpStream;

use drivegate_sim::statistics::Direction;
use drivegate_sim::wire::SimulatedBus;
use drivegate_testkit::rows;

use crate::support::process::{PATIENCE, Running, api, until};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, MQTT, Site, controlled, drive, functions};

/// A drive that runs or is at standstill, and has neither references nor a second direction.
const PLAIN: &str = r#"
name = "plain"
protocols = ["modbus-rtu"]
[[range]]
table = "holding"
first = 2000
last = 2010
read = 11
write = 1
[[range]]
table = "holding"
first = 2100
last = 2110
read = 11
[[point]]
name = "running"
at = "holding 2100.1"
class = "fast"
[[point]]
name = "run"
at = "holding 2000.0"
class = "slow"
write = true
"#;

struct RecordedSite {
    site: Site,
    line: SimulatedBus,
    _others: [Running; 2],
}

/// Drives `pump` and `plain`, which may be commanded, `watched`, which may not, and `gone`, which does not exist on
/// the line.
fn rig() -> RecordedSite {
    let drives = [
        controlled("pump", 1, ""),
        controlled("plain", 2, "").replace("\"vacon-nx\"", "\"plain\""),
        drive("watched", 3, ""),
        controlled("gone", 9, ""),
    ];
    // The drive that does not answer does not occupy the line for long.
    let bus = LINE1.replace("\"2s\"", "\"1s\"");
    let site = Site::of(&[&bus, &drives.concat(), MODBUS_TCP, MQTT, HTTP]);
    site.write("plain.toml", PLAIN);
    let line = site.line(&[1, 2, 3]);
    let others = [site.broker(), site.run()];
    site.until_connected(true);
    let is_number = |name| site.point("pump", name).is_number();
    until("the frequency range", || is_number("frequency_reference").then_some(()));
    until("the plain drive", || {
        site.point("plain", "run").is_boolean().then_some(())
    });
    until("the drive that is gone to be tried", || {
        let tried = &api(site.http, "gone")["transactions"]["timeout"];
        (tried.as_u64() >= Some(2)).then_some(())
    });
    line.record(100_000);
    RecordedSite {
        site,
        line,
        _others: others,
    }
}

impl RecordedSite {
    /// The PDU that answers one.
    fn ask(&self, unit: u8, pdu: &[u8]) -> Vec<u8> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.site.modbus)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut frame = vec![0, 1, 0, 0, 0, pdu.len() as u8 + 1, unit];
        frame.extend_from_slice(pdu);
        stream.write_all(&frame).unwrap();
        let mut head = [0u8; 7];
        stream.read_exact(&mut head).unwrap();
        let mut answer = vec![0u8; usize::from(head[5]) - 1];
        stream.read_exact(&mut answer).unwrap();
        answer
    }

    fn writes(&self) -> usize {
        functions(&self.line).iter().filter(|f| **f != 3).count()
    }
}

/// Functions 6 and 16.
fn write(start: u16, values: &[u16]) -> Vec<u8> {
    let words: Vec<u8> = values.iter().flat_map(|v| v.to_be_bytes()).collect();
    let start = start.to_be_bytes();
    match values {
        [_] => [&[6], &start[..], &words].concat(),
        _ => [&[16], &start[..], &[0, values.len() as u8, words.len() as u8], &words].concat(),
    }
}

/// Columns: topic below `drivegate/test/drive`, payload, code of the refusal, and a part of its text.
const SET_TOPICS: &str = r#"pump/set                      | {"speed_reference": NaN}                                        | bad_value     | not JSON
pump/set                      | {"speed_reference": -Infinity}                                  | bad_value     | not JSON
pump/set                      | {"speed_reference": 1e999}                                      | bad_value     | not JSON
pump/set                      | {"speed_reference": "50"}                                       | bad_value     | quotes
pump/set                      | {"speed_reference": null}                                       | bad_value     | speed_reference
pump/set                      | {"speed_reference": [50]}                                       | bad_value     | speed_reference
pump/set                      | {"run": "true"}                                                 | bad_value     | not true or false
pump/set                      | {"run": 2}                                                      | bad_value     | not true or false
pump/set                      | {"run": true, "run": false}                                     | bad_value     | twice
pump/set                      | {"run": true, "speed_reference": 50, "frequency_reference": 30} | bad_value     | twice
pump/set                      | {"run": true, "speed_reference": 1000}                          | bad_value     | outside the limits
pump/set                      | {"run": true, "ready": true}                                    | not_writable  | read-only
pump/set/speed_reference      | nan                                                             | bad_value     | number
pump/set/speed_reference      | inf                                                             | bad_value     | number
plain/set                     | {"run": true, "reverse": true}                                  | not_writable  | reverse
plain/set                     | {"run": true, "speed_reference": 10}                            | not_writable  | speed_reference
plain/set/frequency_reference | 10                                                              | not_writable  | frequency_reference
watched/set                   | {"run": true}                                                   | not_allowed   | only monitored
gone/set                      | {"run": true}                                                   | offline       | not sent
nobody/set                    | {"run": true}                                                   | unknown_drive | nobody"#;

#[test]
fn nothing_of_a_bad_command_reaches_a_drive() {
    let rig = rig();
    let mut wrong: Vec<String> = Vec::new();
    for [topic, payload, code, text] in rows(SET_TOPICS) {
        let result = rig.site.ask(topic, payload);
        let message = result["error"]["message"].as_str().unwrap_or_default();
        if result["ok"] != false || result["error"]["code"] != code || !message.contains(text) {
            wrong.push(format!("{topic} {payload}: {result}"));
        }
    }
    for (unit, pdu, exception) in [
        (1, write(0x8100, &[0x0100]), 3),         // a bit that means nothing
        (1, write(0x8100, &[1, 20_000]), 3),      // run at 200 %
        (1, write(0x8100, &[1, 5000, 3000]), 3),  // run at two references
        (1, write(0x8101, &[5000, 3000]), 3),     // two references
        (1, write(0x8101, &[0x8000]), 3),         // -327.68 %
        (1, write(2002, &[10_001]), 3),           // 100.01 % in the drive's own register
        (1, write(0x8200, &[0x7FC0, 0]), 2),      // NaN where floats are read
        (1, write(0x8208, &[0x41A0, 0]), 2),      // 20.0 there
        (1, write(0x8004, &[100]), 2),            // a value that is read
        (1, write(2100, &[1]), 2),                // the status word
        (2, write(0x8100, &[3]), 3),              // run reverse, no such direction
        (2, write(0x8101, &[1000]), 2),           // no reference
        (2, write(0x8102, &[1000]), 2),           // no reference
        (2, write(0x8100, &[1, 1000]), 2),        // run at a reference
        (3, write(0x8100, &[1]), 1),              // only monitored
        (9, write(0x8100, &[1]), 0x0B),           // offline
        (99, write(0x8100, &[1]), 0x0A),          // nobody
        (1, vec![22, 0x07, 0xD0, 0, 1, 0, 1], 1), // mask write, which the drive does not have
    ] {
        let answer = rig.ask(unit, &pdu);
        if answer != [pdu[0] | 0x80, exception] {
            wrong.push(format!("unit {unit} {pdu:02X?}: {answer:02X?}"));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert_eq!(rig.writes(), 0, "only reads are on the line");
    // Each request that names a drive (with Modbus, if the drive has the function) is audited; refusals of one kind
    // are counted.
    until("all refusals in the audit", || {
        let audit = rig.site.audit();
        let of = |source: &str| {
            let own = audit.iter().filter(|r| r["source"] == source);
            own.filter_map(|r| r["count"].as_u64()).sum::<u64>()
        };
        ((of("mqtt"), of("modbus_tcp")) == (20, 16)).then_some(())
    });

    // A valid command that arrives again, as QoS 1 allows, is not written again and gets the same result.
    let (again, first) = (1..)
        .map(|id| format!(r#"{{"id": "order-{id}", "speed_reference": 12.5}}"#))
        .map(|order| (order.clone(), rig.site.ask("pump/set", &order)))
        .find(|(_, result)| result["ok"] == true && result["result"] == "confirmed")
        .unwrap();
    let written = rig.writes();
    assert_eq!(rig.site.ask("pump/set", &again), first, "from memory");
    assert_eq!(rig.writes(), written);

    // Two clients that set different bits must not undo each other's changes.
    let control_words = || {
        let frames = rig.line.transcript();
        let to_drives = frames.iter().filter(|f| f.direction == Direction::ToDrives);
        let words = to_drives.filter(|f| f.bytes.starts_with(&[1, 6, 0x07, 0xD0]));
        // A word that is not acknowledged in time is written again.
        let mut words: Vec<u8> = words.map(|f| f.bytes[5]).collect();
        words.dedup();
        words
    };
    rig.site.order("pump/set/run", "true");
    rig.site.order("pump/set/reverse", "true");
    assert_eq!(control_words(), [1, 3]);
    let word = write(2000, &[1]);
    until("the word as a whole", || (rig.ask(1, &word) == word).then_some(()));
    rig.site.order("pump/set", r#"{"reverse": true}"#);
    assert_eq!(control_words(), [1, 3, 1, 3], "a raw write is known to the next bit");
    rig.site.order("pump/set/run", "false");
    assert_eq!(control_words().last(), Some(&2));
}
