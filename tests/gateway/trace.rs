//! `drivegate trace` against `drivegate run` on a simulated line: lines, times, and the capture as tshark decodes it.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use drivegate_sim::faults::FaultPlan;
use drivegate_sim::statistics::Direction;
use drivegate_sim::wire::SimulatedBus;

use crate::support::process::{Running, get, until};
use crate::support::site::{HTTP, LINE1, Site, drive};
use crate::support::tools::{run, run_well, tool};

const DRIVEGATE: &str = env!("CARGO_BIN_EXE_drivegate");
/// Silence that the gateway keeps, in microseconds.
const SILENCE_US: u64 = 3000;

/// A gateway on a simulated line with the drives 1 and 2.
struct Plant {
    site: Site,
    gateway: Running,
    line: SimulatedBus,
}

impl Plant {
    fn start() -> Plant {
        Plant::with("5s")
    }

    fn with(response_timeout: &str) -> Plant {
        let bus = LINE1
            .replace(
                "silence = \"chars\"",
                &format!("silence = \"{SILENCE_US}us\"\nretries = 0"),
            )
            .replace("\"2s\"", &format!("\"{response_timeout}\""));
        let drives = drive("pump-1", 1, "") + &drive("pump-2", 2, "");
        let site = Site::of(&[&bus, &drives, HTTP]);
        let line = site.line(&[1, 2]);
        let gateway = site.run_ready();
        Plant { site, gateway, line }
    }

    fn url(&self) -> String {
        format!("http://127.0.0.1:{}", self.site.http)
    }

    /// The first `count` frames that the trace prints.
    fn trace(&self, count: usize, more: &[&str]) -> Vec<Shown> {
        let (url, count) = (self.url(), count.to_string());
        let arguments = [&["trace", "--url", &url, "--bus", "line1", "--count", &count], more].concat();
        let output = run(Path::new(DRIVEGATE), &arguments);
        assert!(output.status.success(), "{output:?}");
        shown(&String::from_utf8(output.stdout).unwrap())
    }
}

/// A line of the trace's output.
#[derive(Debug)]
struct Shown {
    micros: u64,
    gap: Option<u64>,
    request: bool,
    drive: String,
    bytes: Vec<u8>,
    meaning: String,
}

fn shown(text: &str) -> Vec<Shown> {
    let mut lines = text.lines();
    let head = lines.next().unwrap();
    assert!(head.starts_with("time"), "{head}");
    lines.map(line).collect()
}

fn line(text: &str) -> Shown {
    let fields: Vec<&str> = text.split_whitespace().collect();
    let clock: Vec<u64> = fields[0].split([':', '.']).map(|n| n.parse().unwrap()).collect();
    // Two spaces separate the bytes from their meaning.
    let (_, rest) = text.split_once(fields[3]).unwrap();
    let (hex, meaning) = rest.trim_start().split_once("  ").unwrap_or(("", rest));
    let bytes = hex
        .split_whitespace()
        .map(|byte| u8::from_str_radix(byte, 16).unwrap())
        .collect();
    Shown {
        micros: ((clock[0] * 60 + clock[1]) * 60 + clock[2]) * 1_000_000 + clock[3],
        gap: fields[1].parse().ok(),
        request: fields[2] == ">",
        drive: fields[3].to_string(),
        meaning: meaning.trim_start().to_string(),
        bytes,
    }
}

#[test]
fn frames_their_times_and_their_meaning() {
    let plant = Plant::start();
    let capture = plant.site.path("line1.pcap");
    let frames = plant.trace(40, &["--pcap", &capture]);
    assert_eq!(frames.len(), 40);
    let transcript = plant.line.transcript();

    // The frames are found in the line's own transcript, one directly after the other.
    let first = transcript
        .windows(frames.len())
        .position(|window| {
            window
                .iter()
                .zip(&frames)
                .all(|(w, f)| w.bytes == f.bytes && (w.direction == Direction::ToDrives) == f.request)
        })
        .unwrap_or_else(|| panic!("these frames were not on the line: {frames:#?}"));
    let wire = &transcript[first..first + frames.len()];
    let mut reads = 0;
    for (place, (frame, on_wire)) in frames.iter().zip(wire).enumerate() {
        assert_eq!(frame.drive, format!("pump-{}", frame.bytes[0]));
        let gap = frame.gap.expect("something came before");
        if frame.request {
            // A request follows no sooner than after the silence, and after a plausible time.
            assert!((SILENCE_US..5_000_000).contains(&gap), "{frame:?}");
            assert!(frame.meaning.starts_with("read "), "{frame:?}");
            reads += usize::from(frame.meaning == "read holding 2100..2110");
        } else {
            // A drive detects the end of a request by 3.5 characters of silence, 911 µs, and then turns around.
            assert!((900..5_000_000).contains(&gap), "{frame:?}");
            assert!(frame.meaning.ends_with(" ok"), "{frame:?}");
            let registers = (frame.bytes.len() - 5) / 2;
            assert!(frame.meaning.starts_with(&format!("{registers} register")), "{frame:?}");
            // The last byte cannot arrive before the line has carried it.
            let request = frames[..place].last();
            if let Some(request) = request.filter(|frame| frame.request) {
                let took = frame.micros.saturating_sub(request.micros);
                let carried = (on_wire.end - wire[place - 1].end).as_micros() as u64;
                assert!(took >= carried / 2, "{took} µs, the line needed {carried} µs");
            }
        }
    }
    assert!(reads >= 5, "{frames:#?}");
    assert!(
        frames.windows(2).all(|pair| pair[0].micros <= pair[1].micros),
        "in order"
    );

    tshark_reads(&capture, &frames);
}

/// tshark sees the same functions, addresses and registers.
fn tshark_reads(capture: &str, frames: &[Shown]) {
    let fields = [
        "rtacser.eventtype",
        "mbrtu.unit_id",
        "modbus.func_code",
        "modbus.reference_num",
        "modbus.regval_uint16",
        "mbrtu.crc16.status",
    ];
    let mut arguments = vec![
        "-r",
        capture,
        "-d",
        "rtacser.data,mbrtu",
        "-o",
        "mbrtu.crc_verification:TRUE",
    ];
    arguments.extend(["-T", "fields", "-E", "separator=;"]);
    arguments.extend(fields.iter().flat_map(|field| ["-e", field]));
    let output = run(&tool("tshark"), &arguments);
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), frames.len(), "{text}");
    let word = |bytes: &[u8]| u16::from_be_bytes([bytes[0], bytes[1]]);
    let mut replies = 0;
    for (line, frame) in lines.iter().zip(frames) {
        let read: Vec<&str> = line.split(';').collect();
        let (event, start, registers) = if frame.request {
            ("0x01", word(&frame.bytes[2..]).to_string(), String::new())
        } else {
            replies += 1;
            let data = &frame.bytes[3..frame.bytes.len() - 2];
            let words: Vec<String> = data.chunks(2).map(|pair| word(pair).to_string()).collect();
            ("0x02", String::new(), words.join(","))
        };
        let (unit, function) = (frame.bytes[0].to_string(), frame.bytes[1].to_string());
        assert_eq!(read, [event, &unit, &function, &start, &registers, "1"], "{line}");
    }
    assert!(replies > 10);
}

#[test]
fn silence_of_a_drive_is_shown() {
    let plant = Plant::with("200ms");
    plant.line.set_alive(2, false);
    let url = plant.url();
    let trace = Running::drivegate(&["trace", "--url", &url]);
    let text = until("a timeout", || {
        trace
            .output()
            .lines()
            .find(|line| line.contains("pump-2") && line.contains("timeout"))
            .map(str::to_string)
    });
    let fields: Vec<&str> = text.split_whitespace().collect();
    assert_eq!(fields[1..], ["-", "line1", "<", "pump-2", "timeout"]);
}

/// Faults on the line are reported as such, and the next transaction is valid again.
#[test]
fn faults_are_told_apart() {
    let plant = Plant::with("200ms");
    let url = plant.url();
    let check = |fault: &str, expected: &[&str]| {
        let trace = Running::drivegate(&["trace", "--url", &url, "--bus", "line1"]);
        trace.until_printed("read holding");
        let rates = format!("{fault}=1").parse().unwrap();
        plant.line.set_faults(FaultPlan::new(rates, 1).only(&[1]));
        // A request to drive 1, and everything between it and the next request.
        until(&format!("{fault}: {expected:?}"), || {
            let output = trace.output();
            let whole = output.rsplit_once('\n').map_or("", |(whole, _)| whole);
            let frames = shown(whole);
            let exchanges = frames.split_inclusive(|frame| frame.request);
            let replies = exchanges.zip(frames.split(|frame| frame.request).skip(1));
            replies
                .filter(|(up_to_request, _)| up_to_request.last().is_some_and(|frame| frame.drive == "pump-1"))
                .any(|(_, replies)| {
                    replies.len() == expected.len()
                        && replies
                            .iter()
                            .zip(expected)
                            .all(|(frame, word)| frame.meaning.contains(word))
                })
                .then_some(())
        });
        plant.line.set_faults(FaultPlan::default());
        until("both drives answer", || {
            let drives = get(plant.site.http, "/api/v1/drives")?.1;
            (drives.matches("\"online\":true").count() == 2).then_some(())
        });
    };
    check("echo", &["the request comes back  echo", "  ok"]);
    check("stray-address", &["foreign: address ", "  ok"]);
    check("exception:2", &["exception 02 (illegal data address)"]);
    check("corrupt", &["no sound frame  corrupt: "]);
    check("truncate", &["corrupt: the reply is incomplete"]);
    check("drop", &["timeout"]);
}

#[test]
fn a_killed_trace_leaves_a_readable_capture() {
    let plant = Plant::start();
    let (url, capture) = (plant.url(), plant.site.path("f.pcap"));
    let trace = Running::drivegate(&["trace", "--url", &url, "--pcap", &capture]);
    // Packets are in the file while the trace continues.
    until("packets in the file", || {
        let size = std::fs::metadata(&capture).ok()?.len();
        (size > 24).then_some(())
    });
    trace.signal("KILL");
    let text = run_well(&tool("tshark"), &["-r", &capture, "-d", "rtacser.data,mbrtu"]);
    assert!(text.contains("Read Holding Registers"), "{text}");
    assert!(!text.contains("truncated"), "{text}");
}

#[test]
fn it_ends_as_it_is_told_and_says_why() {
    let mut plant = Plant::start();
    let url = plant.url();

    // The trace is ended by Ctrl-C.
    let mut trace = Running::drivegate(&["trace", "--url", &url]);
    trace.until_printed("read holding");
    trace.signal("INT");
    assert!(trace.ended().success());

    // A reader that closes the pipe.
    let mut child = Command::new(DRIVEGATE)
        .args(["trace", "--url", &url])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdout = BufReader::new(child.stdout.take().unwrap());
    stdout.read_line(&mut String::new()).unwrap();
    drop(stdout);
    let mut reported = String::new();
    child.stderr.take().unwrap().read_to_string(&mut reported).unwrap();
    assert!(child.wait().unwrap().success());
    assert_eq!(reported, "");

    // A bus that does not exist is an error.
    let output = run(Path::new(DRIVEGATE), &["trace", "--url", &url, "--bus", "hall 1"]);
    assert_eq!(output.status.code(), Some(1));
    let reported = String::from_utf8(output.stderr).unwrap();
    assert_eq!(
        reported,
        format!("error: there is no bus `hall 1`; {url}; known: line1\n")
    );

    // A capture that cannot be written.
    let output = run(Path::new(DRIVEGATE), &["trace", "--url", &url, "--pcap", "/dev/null/x"]);
    assert_eq!(output.status.code(), Some(1));
    let reported = String::from_utf8(output.stderr).unwrap();
    assert!(reported.starts_with("error: cannot write the capture: "), "{reported}");

    // The gateway stops while the trace runs.
    let mut trace = Running::drivegate(&["trace", "--url", &url]);
    trace.until_printed("read holding");
    plant.gateway.signal("TERM");
    assert!(plant.gateway.ended().success());
    assert_eq!(trace.ended().code(), Some(1));
    trace.until_printed("error: the gateway ended the stream");

    // The gateway no longer runs.
    let output = run(Path::new(DRIVEGATE), &["trace", "--url", &url]);
    assert_eq!(output.status.code(), Some(1));
    let reported = String::from_utf8(output.stderr).unwrap();
    assert!(
        reported.starts_with("error: cannot reach the gateway: Connection refused"),
        "{reported}"
    );
    assert!(reported.contains(&url) && reported.contains("--url"), "{reported}");

    let output = run(Path::new(DRIVEGATE), &["trace", "--url", "127.0.0.1:9488"]);
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn one_that_is_no_gateway_is_told_from_one() {
    // A listener that does not speak HTTP.
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let answer = std::thread::spawn(move || {
        let (mut socket, _) = listener.accept().unwrap();
        let _ = std::io::Write::write_all(&mut socket, b"220 mail at your service\r\n");
        std::thread::sleep(Duration::from_millis(200));
    });
    let output = run(Path::new(DRIVEGATE), &["trace", "--url", &url]);
    assert_eq!(output.status.code(), Some(1));
    let reported = String::from_utf8(output.stderr).unwrap();
    assert!(reported.starts_with("error: not an HTTP reply"), "{reported}");
    answer.join().unwrap();

    let plant = Plant::start();
    assert_eq!(get(plant.site.http, "/healthz").unwrap().0, 200);
    let url = format!("{}/elsewhere", plant.url());
    let output = run(Path::new(DRIVEGATE), &["trace", "--url", &url]);
    assert_eq!(output.status.code(), Some(1));
}
