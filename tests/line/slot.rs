//! The tool slot with programs that were written elsewhere (pymodbus, pyserial, mbpoll) and with tools that misbehave.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::time::{Duration, Instant};

use drivegate_proto::rtu;

use crate::support::process::{free_port, get, until};
use crate::support::site::{HTTP, LINE1, Site, controlled, drive};
use crate::support::tools::{python, root, run, run_well, tool};

/// Number of requests that each peer sends.
const REQUESTS: &str = "60";

struct SlotSite {
    site: Site,
    raw: u16,
    rfc2217: u16,
}

impl SlotSite {
    /// Two drives and a slot with this access.
    fn new(access: &str) -> SlotSite {
        let (raw, rfc2217) = (free_port(), free_port());
        let slot = format!(
            "[[bus.slot]]\nlisten = \"127.0.0.1:{raw}\"\nrfc2217 = \"127.0.0.1:{rfc2217}\"\npty = \"tool\"\n\
             access = \"{access}\"\n"
        );
        let drives = [
            controlled("pump-1", 1, "limits = { speed_reference = [0.0, 80.0] }"),
            drive("pump-2", 2, ""),
        ];
        let site = Site::of(&[LINE1, "cycle = \"30ms\"\n", &drives.concat(), &slot, HTTP]);
        SlotSite { site, raw, rfc2217 }
    }

    fn connect(&self) -> TcpStream {
        let stream = until("the slot", || TcpStream::connect(("127.0.0.1", self.raw)).ok());
        stream.set_read_timeout(Some(Duration::from_secs(3))).unwrap();
        stream
    }

    fn counted(&self, outcome: &str) -> f64 {
        let (_, text) = get(self.site.http, "/metrics").unwrap();
        let wanted = format!("drivegate_slot_requests_total{{bus=\"line1\",outcome=\"{outcome}\"}} ");
        let line = text.lines().find_map(|line| line.strip_prefix(&wanted));
        line.map_or(0.0, |value| value.parse().unwrap())
    }
}

fn frame(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = Vec::new();
    rtu::encode_frame(address, pdu, &mut frame);
    frame
}

/// Sends a request until it is answered: on a busy machine the gateway may stay silent rather than answer late.
fn ask(stream: &mut TcpStream, request: &[u8]) -> Vec<u8> {
    until("an answer", || {
        stream.write_all(request).unwrap();
        let mut answer = vec![0; 256];
        match stream.read(&mut answer) {
            Ok(count) => {
                answer.truncate(count);
                Some(answer)
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => None,
            Err(error) => panic!("{error}"),
        }
    })
}

#[test]
fn programs_of_others_read_through_the_slot() {
    let rig = SlotSite::new("read");
    let _line = rig.site.line(&[1, 2]);
    let _gateway = rig.site.run_ready();
    let script = root().join("tests/peers/slot_tool.py").display().to_string();
    let pty = rig.site.path("tool");
    for (way, target) in [
        ("raw", format!("127.0.0.1:{}", rig.raw)),
        ("serial", pty.clone()),
        ("rfc2217", format!("127.0.0.1:{}", rig.rfc2217)),
    ] {
        print!("{}", run_well(&python(), &[&script, way, &target, REQUESTS]));
    }
    // mbpoll uses libmodbus; the baud rate and parity given here have no effect.
    let arguments = [
        "-m", "rtu", "-b", "19200", "-P", "even", "-a", "2", "-t", "4", "-0", "-r", "2100", "-c", "3", "-1", "-o", "5",
        &pty,
    ];
    until("mbpoll has its answer", || {
        let output = run(&tool("mbpoll"), &arguments);
        String::from_utf8_lossy(&output.stdout)
            .contains("[2102]:")
            .then_some(())
    });
    assert!(rig.counted("answered") + rig.counted("exception") >= 180.0);
    let mode = std::fs::metadata(&pty).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o660);
}

#[test]
fn writes_are_decoded_limited_and_audited() {
    let rig = SlotSite::new("write");
    let line = rig.site.line(&[1, 2]);
    let _gateway = rig.site.run_ready();
    let mut stream = rig.connect();
    let reference = |value: u16| {
        let [high, low] = value.to_be_bytes();
        [6, 0x07, 0xD2, high, low]
    };
    let within = frame(1, &reference(5000));
    assert_eq!(ask(&mut stream, &within), within, "the drive's own acknowledgement");
    assert_eq!(
        ask(&mut stream, &frame(1, &reference(9000))),
        frame(1, &[0x86, 3]),
        "beyond the limits"
    );
    assert_eq!(
        ask(&mut stream, &frame(2, &reference(5000))),
        frame(2, &[0x86, 1]),
        "a drive that is only monitored"
    );
    assert_eq!(
        ask(&mut stream, &frame(1, &[0x41, 7])),
        frame(1, &[0xC1, 1]),
        "a function that cannot be checked"
    );
    let audit = until("the records", || {
        Some(rig.site.audit()).filter(|audit| audit.len() >= 4)
    });
    let results: Vec<_> = audit
        .iter()
        .map(|record| (record["source"].as_str().unwrap(), record["result"].as_str().unwrap()))
        .collect();
    for wanted in [("slot", "bad_value"), ("slot", "not_allowed")] {
        assert!(results.contains(&wanted), "{results:?}");
    }
    let written = audit
        .iter()
        .find(|record| record["command"] == "write holding 2002 = 0x1388" && record["drive"] == "pump-1");
    assert!(
        written.is_some_and(|record| record["result"] == "acknowledged" || record["result"] == "confirmed"),
        "{audit:?}"
    );
    drop(line);
}

#[test]
fn tools_that_misbehave_harm_nobody() {
    let rig = SlotSite::new("read");
    let _line = rig.site.line(&[1, 2]);
    let _gateway = rig.site.run_ready();
    let request = frame(1, &[3, 0x08, 0x34, 0, 3]);
    let answered =
        |answer: &[u8]| rtu::open_frame(answer).is_some_and(|(address, pdu)| address == 1 && pdu[..2] == [3, 6]);
    let mut sound = rig.connect();
    assert!(answered(&ask(&mut sound, &request)));
    // One tool floods and never reads, another sends half a frame and goes silent.
    let mut flood = rig.connect();
    flood.set_nonblocking(true).unwrap();
    let all = request.repeat(4000);
    let begun = Instant::now();
    for _ in 0..20 {
        let _ = flood.write(&all);
    }
    let mut half = rig.connect();
    half.write_all(&request[..5]).unwrap();
    assert!(
        answered(&ask(&mut sound, &request)),
        "the others are answered meanwhile"
    );
    // A broken request, directly followed by a whole one; then a request byte by byte.
    let mut broken = request.clone();
    broken[4] ^= 0x55;
    assert!(answered(&ask(&mut sound, &[broken, request.clone()].concat())));
    until("an answer to what came in pieces", || {
        for byte in &request {
            sound.write_all(&[*byte]).unwrap();
            std::thread::sleep(Duration::from_millis(15));
        }
        let mut answer = [0; 64];
        sound.read(&mut answer).ok().filter(|count| answered(&answer[..*count]))
    });
    assert!(answered(&ask(&mut half, &request)), "behind half a frame");
    until("what was broken is counted", || {
        (rig.counted("broken") >= 1.0).then_some(())
    });
    let abandoned = rig.counted("abandoned");
    assert!(abandoned >= 1.0, "the flood gave its own requests up");
    // The gateway accepts no more bytes from the tool than a fast line carries, 50,000 a second, plus the bytes of
    // one read.
    let most = (begun.elapsed().as_secs_f64() * 50_000.0 + 1024.0) / request.len() as f64;
    assert!(abandoned <= most, "{abandoned} of {most}");
    rig.site.until_state("pump-1", "ready");
}

#[test]
fn a_reload_changes_slots_and_leaves_the_bus_alone() {
    let rig = SlotSite::new("read");
    let _line = rig.site.line(&[1, 2]);
    let mut gateway = rig.site.run_ready();
    let pty = rig.site.file("tool");
    until("the link", || pty.is_symlink().then_some(()));
    let write = frame(1, &[6, 0x07, 0xD2, 0x13, 0x88]);
    let mut stream = rig.connect();
    assert_eq!(ask(&mut stream, &write), frame(1, &[0x86, 1]));
    rig.site.change("access = \"read\"", "access = \"write\"");
    gateway.signal("HUP");
    gateway.until_printed("configuration reloaded");
    // Connected tools must connect again after the reload.
    let mut rest = [0; 16];
    until("the connection of the old slot ends", || {
        matches!(stream.read(&mut rest), Ok(0)).then_some(())
    });
    assert_eq!(ask(&mut rig.connect(), &write), write);
    assert!(!gateway.output().contains("stopping the bus"), "{}", gateway.output());
    gateway.signal("TERM");
    assert!(gateway.ended().success());
    assert!(!pty.is_symlink(), "the link is removed");
}
