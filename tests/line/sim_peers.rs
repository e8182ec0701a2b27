//! Independent masters on the simulated line: mbpoll (libmodbus, without Modbus ASCII) and pymodbus. Their readings
//! prove the simulated drive, and their frames are the worked frames of the reference.

use drivegate_proto::{LineFormat, Protocol};
use drivegate_sim::half_duplex::LineRules;
use drivegate_sim::nx::{NxOptions, StatusBits, UPDATE_PERIOD, status_word};
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};
use std::path::Path;
use std::time::Duration;

use crate::support::process::until;
use crate::support::tools::{python, root, run, run_well, tool};

/// Drives 1 (showing the status bits of the worked frames) and 2 on a line at 38400 8N1.
fn line() -> SimulatedBus {
    line_of(Protocol::ModbusRtu, "8N1")
}

fn line_of(protocol: Protocol, format: &str) -> SimulatedBus {
    let common = NxOptions {
        status: StatusBits::Common,
        ..NxOptions::default()
    };
    let drives = vec![
        DriveOptions {
            address: 1,
            model: ModelOptions::Nx(common),
            autopilot: None,
        },
        DriveOptions::nx(2),
    ];
    let rules = LineRules::of(protocol, LineFormat::new(38_400, format).unwrap());
    let mut options = SimulatedBusOptions::new("peers", rules, drives);
    options.transcript = 1000;
    SimulatedBus::start(options).unwrap()
}

/// Output of a program, stdout first, whatever its exit code is.
fn printed(program: &Path, arguments: &[&str]) -> String {
    let output = run(program, arguments);
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

/// Output of mbpoll; values to write follow `--`.
fn mbpoll(line: &SimulatedBus, arguments: &str) -> String {
    let (options, values) = arguments.split_once(" -- ").unwrap_or((arguments, ""));
    let line = line.address();
    let always = ["-m", "rtu", "-b", "38400", "-P", "none", "-0", "-1", "-o", "5"];
    let words = always.into_iter().chain(options.split_whitespace());
    let words: Vec<&str> = words.chain([line.as_str()]).chain(values.split_whitespace()).collect();
    printed(&tool("mbpoll"), &words)
}

/// The values that mbpoll printed, as `[2100]: 35`.
fn values(text: &str) -> Vec<u16> {
    let value = |line: &str| {
        line.split_once("]:")
            .and_then(|(_, rest)| rest.split_whitespace().next()?.parse().ok())
    };
    text.lines().filter_map(value).collect()
}

fn frames(line: &SimulatedBus) -> Vec<String> {
    let frame = |frame: &drivegate_sim::statistics::Recorded| {
        frame
            .to_string()
            .split_once(' ')
            .map(|(_, rest)| rest.to_string())
            .unwrap_or_default()
    };
    line.transcript().iter().map(frame).collect()
}

/// Waits until drive 1 has reached its reference, and the torque of the ramp has disappeared.
fn until_at_reference(line: &SimulatedBus) {
    let status = || line.with_drive(1, |drive, _| drive.as_nx().unwrap().state().status);
    until("the reference", || {
        (status()? & status_word::AT_REFERENCE != 0).then_some(())
    });
    std::thread::sleep(2 * UPDATE_PERIOD);
}

#[test]
fn mbpoll_runs_the_start_up_test() {
    let line = line();
    let text = mbpoll(&line, "-a 1 -r 2100 -c 11");
    assert_eq!(values(&text), [1, 0x2000, 0, 0, 0, 0, 0, 0, 0, 560, 0], "{text}");
    let text = mbpoll(&line, "-a 1 -r 2000 -- 1 0 5000");
    assert!(text.contains("Written 3 references"), "{text}");
    until_at_reference(&line);
    let text = mbpoll(&line, "-a 1 -r 2100 -c 11");
    assert_eq!(
        values(&text),
        [0x23, 0x2000, 5000, 2500, 750, 12, 105, 53, 2000, 560, 0],
        "{text}"
    );
    let text = mbpoll(&line, "-a 1 -r 2102 -c 2 -t 3");
    assert_eq!(values(&text), [5000, 2500], "{text}");
    let text = mbpoll(&line, "-a 1 -r 6000 -c 5 -t 3");
    assert!(text.contains("Illegal data address"), "{text}");

    let worked = [
        "> 01 10 07 D0 00 03 06 00 01 00 00 13 88 C8 CB",
        "< 01 10 07 D0 00 03 80 85",
        "> 01 03 08 34 00 0B 47 A3",
        "< 01 03 16 00 23 20 00 13 88 09 C4 02 EE 00 0C 00 69 00 35 07 D0 02 30 00 00 11 05",
        "> 01 04 08 36 00 02 93 A5",
        "< 01 04 04 13 88 09 C4 78 E9",
        "> 01 04 17 70 00 05 34 66",
        "< 01 84 02 C2 C1",
    ];
    let frames = frames(&line);
    assert_eq!(frames.get(2..), Some(worked.map(str::to_string).as_slice()));
    let s = line.statistics();
    assert_eq!((s.silence_violations, s.collisions, s.bad_crc), (0, 0, 0));
}

#[test]
fn mbpoll_resets_a_fault_and_meets_a_dead_drive() {
    let line = line();
    line.with_drive(1, |drive, _| drive.trip(53));
    let text = mbpoll(&line, "-a 1 -r 98 -c 1");
    assert_eq!(values(&text), [53], "{text}");
    mbpoll(&line, "-a 1 -r 2000 -- 4");
    std::thread::sleep(Duration::from_millis(50));
    mbpoll(&line, "-a 1 -r 2000 -- 0");
    let text = mbpoll(&line, "-a 1 -r 98 -c 1");
    assert_eq!(values(&text), [0], "{text}");
    assert_eq!(
        frames(&line).get(..2),
        Some(
            ["> 01 03 00 62 00 01 25 D4", "< 01 03 02 00 35 78 53"]
                .map(str::to_string)
                .as_slice()
        )
    );

    line.set_alive(1, false);
    let text = mbpoll(&line, "-a 1 -r 98 -c 1 -o 0.2");
    assert!(text.contains("timed out"), "{text}");
    let text = mbpoll(&line, "-a 2 -r 2100 -c 1");
    assert_eq!(values(&text), [0x541], "{text}");
}

#[test]
fn pymodbus_commands_a_drive() {
    pymodbus_commands(&line(), "rtu");
}

/// The pseudo-terminal carries 8 bits whatever the format; only the time that a character takes differs.
#[test]
fn pymodbus_commands_a_drive_in_ascii() {
    for format in ["8N1", "7E1", "7N2"] {
        let line = line_of(Protocol::ModbusAscii, format);
        pymodbus_commands(&line, "ascii");
        let s = line.statistics();
        assert_eq!((s.silence_violations, s.collisions, s.bad_crc), (0, 0, 0), "{format}");
        let first: Vec<String> = line.transcript().iter().take(2).map(as_text).collect();
        assert_eq!(first, [":020408340002BC\r\n", ":0204040541200090\r\n"]);
    }
}

fn as_text(frame: &drivegate_sim::statistics::Recorded) -> String {
    String::from_utf8(frame.bytes.clone()).unwrap()
}

fn pymodbus_commands(line: &SimulatedBus, framer: &str) {
    let script = root().join("tests/peers/simulated_line.py").display().to_string();
    let text = run_well(&python(), &[&script, &line.address(), framer]);
    let minus = |value: i16| (value as u16).to_string();
    let running = format!(
        "1959 8192 {} {} {} 12 {} 53 2000 560 0",
        minus(-5000),
        minus(-2500),
        minus(-750),
        minus(-105)
    );
    let actual = format!("{} {} 12 {} 53 2000 560 ", minus(-2500), minus(-750), minus(-105));
    let seen: Vec<&str> = text.lines().collect();
    assert_eq!(seen.len(), 12, "{text}");
    assert_eq!(seen[..3], ["1345 8192", "", running.as_str()]);
    assert!(seen[3].starts_with(&actual), "{} and then two temperatures", seen[3]);
    assert_eq!(
        seen[4..9],
        [
            "exception 2",
            "exception 3",
            "exception 2",
            "exception 3",
            "exception 1"
        ]
    );
    assert_eq!(seen[9], "0 0 5000", "the broadcast was obeyed");
    assert_eq!(seen[10..], ["2", "2"]);
    assert_eq!(line.statistics().broadcasts, 1);
}

/// A simulated drive 1 of this model, and the values that pymodbus reads from it.
fn pymodbus(name: &str, protocol: Protocol, format: &str) -> (SimulatedBus, Vec<String>) {
    let drive = DriveOptions::new(1, ModelOptions::by_name(name).unwrap());
    let rules = LineRules::of(protocol, LineFormat::new(19_200, format).unwrap());
    let line = SimulatedBus::start(SimulatedBusOptions::new(name, rules, vec![drive])).unwrap();
    let script = root().join("tests/peers/simulated_drives.py").display().to_string();
    let text = run_well(&python(), &[&script, name, &line.address()]);
    (line, text.lines().map(str::to_string).collect())
}

#[test]
fn pymodbus_runs_a_vacon_cx() {
    let (line, seen) = pymodbus("cx", Protocol::ModbusRtu, "8N2");
    let expected = [
        "idle: 11000000",
        "reference: 1000",
        "run: 1",
        "running: 11100000",
        "variables: 1000 300",
        "par 1.2: 50",
        "above it: exception 3",
        "no coil: exception 2",
        "no function: exception 1",
        "no parameter: exception 2",
        "broadcast: 00000000",
        "echo: ",
        "listened only: 00000000",
    ];
    assert_eq!(seen, expected);
    let s = line.statistics();
    assert_eq!((s.bad_crc, s.silence_violations, s.broadcasts), (0, 0, 1));
    assert_eq!(
        s.requests - s.replies,
        3,
        "silence to Listen Only Mode, in it, and to its end"
    );
}

#[test]
fn pymodbus_runs_a_teco() {
    let (line, seen) = pymodbus("teco", Protocol::ModbusAscii, "7E1");
    let expected = [
        "idle: 68 0",
        "run: ",
        "running: 165 0",
        "frequencies: 3000 3000",
        "17 registers: exception 3",
        "Cn-02 in DRIVE: exception 34",
        "Bn-01: 40",
        "beyond it: exception 33",
        "no register: exception 2",
        "no function: exception 1",
        "save while running: exception 34",
        "save: 0",
    ];
    assert_eq!(seen, expected);
    assert_eq!(line.statistics().bad_crc, 0);
}

#[test]
fn mbpoll_reads_a_vacon_cx() {
    let drive = DriveOptions::new(1, ModelOptions::by_name("cx").unwrap());
    let rules = LineRules::new(LineFormat::new(38_400, "8N1").unwrap());
    let line = SimulatedBus::start(SimulatedBusOptions::new("cx", rules, vec![drive])).unwrap();
    let text = mbpoll(&line, "-a 1 -t 1 -r 0 -c 5");
    assert_eq!(values(&text), [1, 1, 0, 0, 0], "{text}");
    line.with_drive(1, |drive, _| drive.trip(1));
    let text = mbpoll(&line, "-a 1 -t 3 -r 100 -c 1");
    assert_eq!(values(&text), [1], "{text}");
    mbpoll(&line, "-a 1 -t 0 -r 2 -- 1");
    let text = mbpoll(&line, "-a 1 -t 3 -r 100 -c 1");
    assert_eq!(values(&text), [0], "{text}");
    let text = mbpoll(&line, "-a 1 -t 3 -r 0 -c 20");
    assert_eq!(values(&text).len(), 20, "{text}");
    let text = mbpoll(&line, "-a 1 -t 4 -r 9900 -c 2");
    assert_eq!(values(&text), [0, 0], "{text}");
}
